"""DAVE-ML (AIAA S-119-2011, Flight Dynamic Model Exchange Standard): aerodynamic models as coefficient tables.

Variables are constants, inputs, calculations (MathML), or functions of one to several variables by gridded tables with
linear interpolation. The table of coefficients is the model at the breakpoints of its angles and Mach number; the
derivatives by body rates are its slopes. Angles on which calculations depend have points between their breakpoints.
Inputs without a place in the tables, such as control surfaces, are at their
initial value or 0.

The check data of a file (`staticShot`) are evaluated, and a file that misses them is refused. Ungridded tables, moments
in other units, and calculations other than arithmetic, elementary functions and `piecewise` are refused by name.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any
from xml.etree.ElementTree import Element

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import RegularGridInterpolator

from maxq.sim.input.xml_tree import XmlError, xml_tree

Array = NDArray[np.float64]
MACH_AXES = {"mach": "mach", "machnumber": "mach"}
_AXES = {"angleofattack": "alpha_deg", "angleofsideslip": "beta_deg", **MACH_AXES}
_RATES = {"bodyangularrate_roll": 0, "bodyangularrate_pitch": 1, "bodyangularrate_yaw": 2}
_SPEED = ("trueairspeed",)
_COEFFICIENTS = {
    "lift": "CL",
    "drag": "CD",
    "sideforce": "CY",
    "rollingmoment": "Cl",
    "pitchingmoment": "Cm",
    "yawingmoment": "Cn",
}
_BODY = {
    "aerobodyforcecoefficient_x": "CX",
    "aerobodyforcecoefficient_y": "CY",
    "aerobodyforcecoefficient_z": "CZ",
    "aerobodymomentcoefficient_roll": "Cl",
    "aerobodymomentcoefficient_pitch": "Cm",
    "aerobodymomentcoefficient_yaw": "Cn",
    "totalcoefficientoflift": "CL",
    "totalcoefficientofdrag": "CD",
}
_LENGTHS = (("referencewingspan", "lateralreferencelength"), ("referencewingchord", "longitudinalreferencelength"))
_BY_RATE = {
    "Cl": ("Clp", None, "Clr"),
    "Cm": (None, "Cmq", None),
    "Cn": ("Cnp", None, "Cnr"),
    "CY": ("CYp", None, "CYr"),
}
_NORMAL_BY_RATE = {"CZ": ("CNq", -1.0), "CL": ("CNq", 1.0)}
_TO_DEG = {"deg": 1.0, "d": 1.0, "rad": math.degrees(1.0), "r": math.degrees(1.0)}
_SPEED_VALUE = 100.0  # true airspeed of the table in its unit; the derivatives do not depend on it
_FINER = 4  # parts of an interval between breakpoints of an angle, if calculations depend on it
_ANGLES_deg = (-20.0, -10.0, 0.0, 10.0, 20.0)  # breakpoints of an angle without any
_LINEAR = 1e-6  # largest share by which a coefficient may depart from a line over a rate


class DaveError(ValueError):
    """A model that cannot be read. The message names the element."""


def _plus(*terms: Array) -> Array:
    return sum(terms[1:], terms[0])


def _times(*factors: Array) -> Array:
    return np.asarray(np.prod(np.broadcast_arrays(*factors), axis=0))


_OPERATIONS: Mapping[str, Callable[..., Any]] = {
    "plus": _plus,
    "minus": lambda a, b=None: -a if b is None else a - b,
    "times": _times,
    "divide": np.divide,
    "power": np.power,
    "root": np.sqrt,
    "abs": np.abs,
    "exp": np.exp,
    "ln": np.log,
    "sin": np.sin,
    "cos": np.cos,
    "tan": np.tan,
    "arcsin": np.arcsin,
    "arccos": np.arccos,
    "arctan": np.arctan,
    "min": lambda *a: np.minimum.reduce(np.broadcast_arrays(*a)),
    "max": lambda *a: np.maximum.reduce(np.broadcast_arrays(*a)),
    "lt": np.less,
    "leq": np.less_equal,
    "gt": np.greater,
    "geq": np.greater_equal,
    "eq": np.equal,
    "neq": np.not_equal,
    "and": np.logical_and,
    "or": np.logical_or,
    "not": np.logical_not,
}
_UNARY = ("root", "abs", "exp", "ln", "sin", "cos", "tan", "arcsin", "arccos", "arctan", "not")
_BINARY = ("divide", "power", "lt", "leq", "gt", "geq", "eq", "neq")
_CONSTANTS = {"pi": math.pi, "exponentiale": math.e}


@dataclass
class _Variable:
    """A variable: its name, unit and initial value, and the function of other variables that gives it."""

    key: str
    name: str
    units: str
    initial: float | None
    inputs: tuple[str, ...] = ()
    compute: Callable[[Mapping[str, Array]], Array] | None = None
    least: float = -math.inf
    most: float = math.inf
    calculated: bool = False  # by MathML


@dataclass(frozen=True)
class CheckShot:
    """A result of the check data: the shot, the signal, the expected value, the value found, and the tolerance."""

    shot: str
    signal: str
    expected: float
    found: float
    tolerance: float

    @property
    def missed(self) -> bool:
        return not abs(self.found - self.expected) <= self.tolerance


@dataclass
class DaveModel:
    """A DAVE-ML model whose variables can be computed."""

    variables: dict[str, _Variable]
    breaks: dict[str, list[Array]] = field(default_factory=dict)  # breakpoints by the variables that tables use
    checks: tuple[Element, ...] = ()

    def by_name(self, names: Iterable[str]) -> _Variable | None:
        """Return the first variable with one of these names, in lower case."""
        wanted = set(names)
        return next((v for v in self.variables.values() if v.name.lower() in wanted), None)

    def values(self, wanted: Iterable[str], given: Mapping[str, Array]) -> dict[str, Array]:
        """Return the values of variables by their keys, for given inputs; others have their initial value or 0."""
        found, pending = dict(given), set[str]()

        def value(key: str) -> Array:
            if key in found:
                return found[key]
            variable = self.variables.get(key)
            if variable is None or key in pending:
                raise DaveError(f"variable {key} {'is not defined' if variable is None else 'depends on itself'}")
            pending.add(key)
            if variable.compute is None:
                out = np.asarray(0.0 if variable.initial is None else variable.initial)
            else:
                with np.errstate(all="ignore"):
                    out = np.asarray(variable.compute({k: value(k) for k in variable.inputs}), dtype=np.float64)
            found[key] = np.clip(out, variable.least, variable.most)
            return found[key]

        return {key: value(key) for key in wanted}

    def depends_on(self, key: str) -> set[str]:
        """Return all variables on which a variable depends, directly or not, and the variable itself."""
        found, pending = set[str](), [key]
        while pending:
            if (one := pending.pop()) not in found:
                found.add(one)
                pending += self.variables[one].inputs if one in self.variables else ()
        return found

    def check(self) -> list[CheckShot]:
        """Return the results of the check data. Units of signals are those of their variables."""
        out = list[CheckShot]()
        for shot in self.checks:
            given = {v.key: np.asarray(x) for v, x, _ in self._signals(shot, "checkInputs")}
            inside = [each for each in self._signals(shot, "internalValues") if each[2] is not None]
            expected = [*inside, *self._signals(shot, "checkOutputs")]
            found = self.values([v.key for v, _, _ in expected], given)
            for variable, value, tolerance in expected:
                bound = 1e-9 * max(abs(value), 1.0) if tolerance is None else tolerance
                out.append(CheckShot(shot.get("name", ""), variable.name, value, float(found[variable.key]), bound))
        return out

    def _signals(self, shot: Element, part: str) -> list[tuple[_Variable, float, float | None]]:
        out = []
        for signal in shot.iterfind(f"{part}/signal"):
            key = (signal.findtext("varID") or signal.findtext("signalID") or "").strip()
            name = (signal.findtext("signalName") or "").strip()
            variable = self.variables.get(key) or self.by_name([name.lower()])
            if variable is None:
                raise DaveError(f"staticShot {shot.get('name')}: signal {name or key} is not a variable")
            tolerance = signal.findtext("tol")
            value = _number(signal.findtext("signalValue"), f"signalValue of {name or key}")
            out.append((variable, value, None if tolerance is None else _number(tolerance, f"tol of {name or key}")))
        return out


def read_model(text: str) -> DaveModel:
    """Return the model of a DAVE-ML file. Raises DaveError."""
    try:
        root = xml_tree(text, doctype=True)
    except XmlError as error:
        raise DaveError(f"line {error.line}: {error}" if error.line else str(error)) from None
    if root.tag != "DAVEfunc":
        raise DaveError(f"holds <{root.tag}>, not <DAVEfunc>")
    variables = {v.key: v for v in map(_variable, root.iterfind("variableDef"))}
    model = DaveModel(variables, checks=tuple(root.iterfind("checkData/staticShot")))
    points = {
        e.get("bpID", ""): _numbers(e.findtext("bpVals"), f"bpVals of {e.get('bpID')}")
        for e in root.iter("breakpointDef")
    }
    grids = {e.get("gtID", ""): e for e in root.iter("griddedTableDef")}
    for function in root.iterfind("function"):
        _add_function(model, function, points, grids)
    for variable in variables.values():
        if unknown := [name for name in variable.inputs if name not in variables]:
            raise DaveError(f"calculation of {variable.key}: variable {unknown[0]} is not defined")
    return model


def _variable(e: Element) -> _Variable:
    key = e.get("varID") or ""
    initial = e.get("initialValue")
    out = _Variable(key, e.get("name") or key, e.get("units") or "", None if initial is None else _number(initial, key))
    out.least = _number(e.get("minValue"), f"minValue of {key}") if e.get("minValue") else -math.inf
    out.most = _number(e.get("maxValue"), f"maxValue of {key}") if e.get("maxValue") else math.inf
    if (math_element := e.find("calculation/math")) is not None:
        operands = list(math_element)
        if len(operands) != 1:
            raise DaveError(f"calculation of {key}: holds {len(operands)} expressions, not one")
        names = set[str]()
        out.compute = _expression(operands[0], key, names)
        out.inputs, out.calculated = tuple(sorted(names)), True
    elif e.find("calculation") is not None:
        raise DaveError(f"calculation of {key}: is not MathML")
    return out


def _expression(e: Element, key: str, names: set[str]) -> Callable[[Mapping[str, Array]], Array]:
    """Return a MathML expression as a function of the values of variables, whose keys are added to `names`."""
    if e.tag == "cn":
        number = np.asarray(_number(e.text, f"cn of {key}"))
        return lambda _: number
    if e.tag == "ci":
        name = (e.text or "").strip()
        names.add(name)
        return lambda values: values[name]
    if e.tag in _CONSTANTS:
        constant = np.asarray(_CONSTANTS[e.tag])
        return lambda _: constant
    if e.tag == "piecewise":
        return _piecewise(e, key, names)
    operation = _OPERATIONS.get(e[0].tag) if e.tag == "apply" and len(e) > 1 else None
    if operation is None:
        what = e[0].tag if e.tag == "apply" and len(e) else e.tag
        raise DaveError(
            f"calculation of {key}: <{what}> is not supported; of MathML: {', '.join(_OPERATIONS)}, piecewise"
        )
    operands = [_expression(each, key, names) for each in e[1:]]
    most = 1 if e[0].tag in _UNARY else 2 if e[0].tag in (*_BINARY, "minus") else len(operands)
    if len(operands) > most or (e[0].tag in _BINARY and len(operands) < 2):
        raise DaveError(f"calculation of {key}: <{e[0].tag}> has {len(operands)} operand{'s' * (len(operands) != 1)}")
    return lambda values: operation(*(each(values) for each in operands))


def _piecewise(e: Element, key: str, names: set[str]) -> Callable[[Mapping[str, Array]], Array]:
    pieces = [tuple(_expression(x, key, names) for x in piece) for piece in e.iterfind("piece")]
    last = e.find("otherwise")
    otherwise = _expression(last[0], key, names) if last is not None and len(last) else None
    if any(len(piece) != 2 for piece in pieces):
        raise DaveError(f"calculation of {key}: a piece is not a value and a condition")

    def compute(values: Mapping[str, Array]) -> Array:
        out = np.asarray(math.nan) if otherwise is None else otherwise(values)
        for value, condition in reversed(pieces):
            out = np.where(condition(values), value(values), out)
        return out

    return compute


def _add_function(
    model: DaveModel, function: Element, points: Mapping[str, Array], grids: Mapping[str, Element]
) -> None:
    """Add a function by gridded table to its dependent variable."""
    name = function.get("name") or ""
    over, dependent = function.findall("independentVarRef"), function.find("dependentVarRef")
    if dependent is None:  # points in the function itself
        axes = [(e.get("varID") or "", e) for e in function.findall("independentVarPts")]
        dependent = function.find("dependentVarPts")
        breaks = [_numbers(e.text, f"independentVarPts of {name}") for _, e in axes]
        data = _numbers(dependent.text if dependent is not None else None, f"dependentVarPts of {name}")
    else:
        axes = [(e.get("varID") or "", e) for e in over]
        grid = function.find("functionDefn/griddedTableDef")
        if grid is None:
            grid = function.find("functionDefn/griddedTable")
        if grid is None and (reference := function.find("functionDefn/griddedTableRef")) is not None:
            grid = grids.get(reference.get("gtID") or "")
        if grid is None:
            raise DaveError(f"function {name}: holds no gridded table; ungridded tables are not supported")
        names = [e.get("bpID") or "" for e in grid.iterfind("breakpointRefs/bpRef")]
        if missing := [each for each in names if each not in points]:
            raise DaveError(f"function {name}: breakpoints {missing[0]} are not defined")
        breaks = [points[each] for each in names]
        data = _numbers(grid.findtext("dataTable"), f"dataTable of {name}")
    key = "" if dependent is None else dependent.get("varID") or ""
    shape = tuple(len(b) for b in breaks)
    if (
        not axes
        or len(breaks) != len(axes)
        or key not in model.variables
        or any(v not in model.variables for v, _ in axes)
    ):
        raise DaveError(f"function {name}: its variables and breakpoints do not fit")
    if data.size != math.prod(shape):
        raise DaveError(f"function {name}: the table has {data.size} values, not {' x '.join(map(str, shape))}")
    if any(len(b) < 2 or (np.diff(b) <= 0.0).any() for b in breaks):
        raise DaveError(f"function {name}: its breakpoints do not increase")
    for (variable, _), b in zip(axes, breaks, strict=True):
        model.breaks.setdefault(variable, []).append(b)
    table = RegularGridInterpolator(breaks, data.reshape(shape), bounds_error=False, fill_value=None)
    bounds = [_bounds(e, b) for (_, e), b in zip(axes, breaks, strict=True)]
    order = [variable for variable, _ in axes]

    def compute(values: Mapping[str, Array]) -> Array:
        at = np.broadcast_arrays(*(np.clip(values[v], *bound) for v, bound in zip(order, bounds, strict=True)))
        return np.asarray(table(np.stack([each.ravel() for each in at], axis=-1))).reshape(at[0].shape)

    target = model.variables[key]
    target.inputs, target.compute = tuple(order), compute


def _bounds(e: Element, breaks: Array) -> tuple[float, float]:
    """Return the range within which an independent variable is used; extrapolation is limited by `min` and `max`."""
    how = e.get("extrapolate") or "neither"
    low = float(breaks[0]) if how in ("neither", "max") else -math.inf
    high = float(breaks[-1]) if how in ("neither", "min") else math.inf
    if e.get("min"):
        low = max(low, _number(e.get("min"), "min"))
    if e.get("max"):
        high = min(high, _number(e.get("max"), "max"))
    return low, high


def _numbers(text: str | None, where: str) -> Array:
    try:
        out = np.array([float(word) for word in (text or "").replace(",", " ").split()])
    except ValueError as error:
        raise DaveError(f"{where}: {error}") from None
    if not out.size or not np.isfinite(out).all():
        raise DaveError(f"{where}: holds no numbers" if not out.size else f"{where}: is not finite")
    return out


def _number(text: str | None, where: str) -> float:
    found = _numbers(text, where)
    if found.size != 1:
        raise DaveError(f"{where}: is not one number")
    return float(found[0])


def coefficient_columns(model: DaveModel) -> dict[str, Array]:
    """Return the columns of a table of coefficients (`sim/vehicle/air/tables.py`). Raises DaveError."""
    for result in model.check():
        if result.missed:
            raise DaveError(
                f"misses its check data: {result.shot}: {result.signal} = {result.found:.9g} instead of "
                f"{result.expected:g} within {result.tolerance:g}"
            )
    outputs = _outputs(model)
    if not outputs:
        raise DaveError("holds no coefficient of force or moment by the names of AIAA S-119")
    needed = set[str]().union(*(model.depends_on(key) for key in outputs.values()))
    axes = _axes(model, needed)
    grid = np.meshgrid(*(values for _, _, values in axes), indexing="ij")
    given = {v.key: g.ravel() / _degrees(v, name) for (name, v, _), g in zip(axes, grid, strict=True)}
    if (speed := model.by_name(_SPEED)) is not None:
        given[speed.key] = np.asarray(_SPEED_VALUE)
    rates = _rate_inputs(model, needed)
    size = grid[0].size
    columns = {name: g.ravel() for (name, _, _), g in zip(axes, grid, strict=True)}
    found = model.values(outputs.values(), given)
    columns |= {name: np.broadcast_to(found[key], (size,)).copy() for name, key in outputs.items()}
    for number, (variable, rate) in rates.items():
        _add_slopes(model, outputs, given, (number, variable, rate), columns)
    for name, column in columns.items():
        if not np.isfinite(column).all():
            raise DaveError(f"{name} is not finite at the breakpoints")
    return columns


def _outputs(model: DaveModel) -> dict[str, str]:
    """Return the keys of the coefficients' variables by the names of maxq."""
    out = dict[str, str]()
    for variable in model.variables.values():
        name = variable.name.lower()
        found = _BODY.get(name)
        if found is None and name.endswith("coefficient"):
            found = _COEFFICIENTS.get(name.removesuffix("coefficient"))
        if found is not None and (variable.compute is not None or variable.initial is not None):
            out.setdefault(found, variable.key)
    return out


def _degrees(variable: _Variable, axis: str) -> float:
    """Return the degrees in a unit of an angle, or 1 for a Mach number."""
    if axis == "mach":
        return 1.0
    if variable.units not in _TO_DEG:
        raise DaveError(f"variable {variable.key}: unit {variable.units} is not deg or rad")
    return _TO_DEG[variable.units]


def _axes(model: DaveModel, needed: set[str]) -> list[tuple[str, _Variable, Array]]:
    """Return the axes of the table: their names, variables, and breakpoints in deg."""
    out = list[tuple[str, _Variable, Array]]()
    for variable in model.variables.values():
        axis = _AXES.get(variable.name.lower())
        if axis is None or variable.key not in needed:
            continue
        own = [b * _degrees(variable, axis) for b in model.breaks.get(variable.key, ())]
        values = np.unique(np.concatenate(own or _indirect(model, needed, variable.key, axis)))
        if axis != "mach" and any(
            model.variables[k].calculated and variable.key in model.depends_on(k) for k in needed
        ):
            shares = np.arange(_FINER) / _FINER
            values = np.append((values[:-1, None] + np.diff(values)[:, None] * shares).ravel(), values[-1])
        limit = 90.0 if axis == "beta_deg" else 180.0
        values = values[values >= 0.0] if axis == "mach" else values[np.abs(values) <= limit]
        out.append((axis, variable, values))
    if not out:
        out.append(("mach", _Variable("", "mach", "nd", None), np.array([0.0])))
    return sorted(out, key=lambda each: ("mach", "alpha_deg", "beta_deg").index(each[0]))


def _indirect(model: DaveModel, needed: set[str], key: str, axis: str) -> list[Array]:
    """Return the breakpoints of the variables calculated from an input, in deg and for both signs of an angle."""
    if axis == "mach":
        return [b for k in needed for b in model.breaks.get(k, ()) if key in model.depends_on(k)] or [
            np.array([0.0, 1.0])
        ]
    found = [
        b * _TO_DEG[model.variables[k].units]
        for k in needed
        for b in model.breaks.get(k, ())
        if key in model.depends_on(k) and model.variables[k].units in _TO_DEG
    ]
    return [*found, *(-b for b in found)] or [np.array(_ANGLES_deg)]


def _rate_inputs(model: DaveModel, needed: set[str]) -> dict[int, tuple[_Variable, float]]:
    """Return the variables of body rates by their axes, each with the rate 2 V / length at the speed of the table."""
    speed, out = model.by_name(_SPEED), dict[int, tuple[_Variable, float]]()
    for name, number in _RATES.items():
        variable = model.by_name([name])
        if variable is None or variable.key not in needed:
            continue
        length = model.by_name(_LENGTHS[1 if number == 1 else 0])
        if speed is None or length is None or not length.initial:
            raise DaveError(f"variable {variable.key}: needs the true airspeed and a reference length")
        if variable.units not in ("rad_s", "rps"):
            raise DaveError(f"variable {variable.key}: unit {variable.units} is not rad_s")
        out[number] = variable, 2.0 * _SPEED_VALUE / length.initial
    return out


def _add_slopes(
    model: DaveModel,
    outputs: Mapping[str, str],
    given: Mapping[str, Array],
    by: tuple[int, _Variable, float],
    columns: dict[str, Array],
) -> None:
    """Add the derivatives of the coefficients by a body rate. Raises DaveError for one that is not linear in it."""
    number, variable, rate = by
    shares = (0.0, 0.005, 0.01)
    steps = [model.values(outputs.values(), {**given, variable.key: np.asarray(share * rate)}) for share in shares]
    for name, key in outputs.items():
        if not all(np.isfinite(found[key]).all() for found in steps):
            raise DaveError(f"variable {key}: is not finite over {variable.key}")
        low, middle, high = (np.broadcast_to(found[key], columns[name].shape) for found in steps)
        slope = (high - low) / shares[2]
        curved = np.abs(high - 2.0 * middle + low).max()
        if curved > _LINEAR * shares[2] * max(float(np.abs(slope).max()), 1.0):
            raise DaveError(f"variable {key}: is not linear in {variable.key}")
        target, sign = (_BY_RATE.get(name, (None, None, None))[number], 1.0)
        if number == 1 and name in _NORMAL_BY_RATE:
            target, sign = _NORMAL_BY_RATE[name]
        if target is not None:
            columns[target] = sign * slope
        elif np.abs(slope).max() > _LINEAR:
            raise DaveError(f"variable {key}: depends on {variable.key}, for which there is no derivative in maxq")


def reference_lengths(model: DaveModel) -> Sequence[tuple[str, float, str]]:
    """Return the names, values and units of reference area and lengths that the model states."""
    names = ("referencearea", "referencewingarea", *_LENGTHS[0], *_LENGTHS[1])
    found = [v for v in model.variables.values() if v.name.lower() in names and v.initial is not None]
    return [(v.name, float(v.initial or 0.0), v.units) for v in found]
