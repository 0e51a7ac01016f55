"""DAVE-ML models: the tables of NASA's two-stage rocket and brick (NASA/TM-2015-218675), and faults by name.

The texts below have the numbers and calculations of the published models `twostage_aero.dml` and `brick_aero.dml`,
without their headers. The check data are worked out by hand from the tables.
"""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
from scipy.interpolate import RegularGridInterpolator

from maxq import ScenarioError
from maxq.sim.input.dave_ml import DaveError, coefficient_columns, read_model
from maxq.sim.input.files import scenarios_folder
from maxq.sim.scenario.loader import load_scenario
from maxq.sim.vehicle.air.tables import grid_table

_NAMES = {
    "CL": "liftCoefficient",
    "CD": "dragCoefficient",
    "CY": "aeroBodyForceCoefficient_Y",
    "Cm": "aeroBodyMomentCoefficient_Pitch",
    "Cn": "aeroBodyMomentCoefficient_Yaw",
}
_TEN = "-10., -8., -6., -4., -2., 0., 2., 4., 6., 8., 10."
_LIFT = [-1.6, -1.0, -0.73, -0.49, -0.24, 0.0, 0.24, 0.49, 0.73, 1.0, 1.6]
_DRAG = [0.48, 0.38, 0.31, 0.25, 0.23, 0.21, 0.23, 0.25, 0.31, 0.38, 0.48]


def _apply(operation: str, *operands: str) -> str:
    return f"<apply><{operation}/>{''.join(operands)}</apply>"


def _variable(key: str, name: str, units: str = "nd", inside: str = "", initial: str = "") -> str:
    value = f' initialValue="{initial}"' if initial else ""
    return f'<variableDef varID="{key}" name="{name}" units="{units}"{value}>{inside}</variableDef>'


def _calculation(expression: str) -> str:
    return f'<calculation><math xmlns="http://www.w3.org/1998/Math/MathML">{expression}</math></calculation>'


def _function(of: str, over: str, points: str, values: list[float]) -> str:
    return f"""<function name="{of}_fcn"><independentVarRef varID="{over}" extrapolate="neither"/>
<dependentVarRef varID="{of}"/><functionDefn name="{of}_fn"><griddedTableDef><breakpointRefs><bpRef bpID="{points}"/>
</breakpointRefs><dataTable><!-- values -->{", ".join(map(str, values))}</dataTable></griddedTableDef></functionDefn>
</function>"""


def _shot(inputs: dict[str, float], outputs: dict[str, float], tolerance: float = 1e-9) -> str:
    def signals(values: dict[str, float], more: str = "") -> str:
        return "".join(
            f"<signal><signalName>{n}</signalName><signalValue>{v}</signalValue>{more}</signal>"
            for n, v in values.items()
        )

    tol = f"<tol>{tolerance}</tol>"
    return f"""<staticShot name="by hand"><checkInputs>{signals(inputs)}</checkInputs>
<checkOutputs>{signals(outputs, tol)}</checkOutputs></staticShot>"""


HEAD = """<?xml version="1.0" standalone="no"?>
<!DOCTYPE DAVEfunc PUBLIC "-//AIAA//DTD for Flight Dynamic Models - Functions 2.0//EN"
 "http://www.daveml.org/DTDs/2p0/DAVEfunc.dtd">
<DAVEfunc xmlns="http://daveml.org/2010/DAVEML">"""
_SQUARES = [_apply("power", f"<ci>{v}</ci>", "<cn>2.</cn>") for v in ("alpha", "beta")]
_TOTAL = _calculation(_apply("power", _apply("plus", *_SQUARES), "<cn>0.5</cn>"))


def two_stage(shots: str = "", total: str = _TOTAL) -> str:
    """Return the aerodynamic model of the two-stage rocket."""
    variables = [
        _variable("alpha", "angleOfAttack", "deg", "<isInput/>"),
        _variable("beta", "angleOfSideslip", "deg", "<isInput/>"),
        _variable("alphaT", "totalAlpha", "deg", total),
        *(_variable(key, name) for key, name in _NAMES.items()),
    ]
    points = "".join(
        f'<breakpointDef bpID="{key}"><bpVals>{values}</bpVals></breakpointDef>'
        for key, values in (("TEN", _TEN), ("TWENTY", "-20., 0., 20."))
    )
    functions = [
        _function("CL", "alpha", "TEN", _LIFT),
        _function("CD", "alphaT", "TEN", _DRAG),
        _function("CY", "beta", "TEN", [-v for v in _LIFT]),
        _function("Cm", "alpha", "TWENTY", [0.6, 0.0, -0.6]),
        _function("Cn", "beta", "TWENTY", [-0.6, 0.0, 0.6]),
    ]
    return f"{HEAD}{''.join(variables)}{points}{''.join(functions)}<checkData>{shots}</checkData></DAVEfunc>"


def brick() -> str:
    """Return the aerodynamic model of the brick: a constant drag and damping by body rates."""
    rates = {"p": ("Roll", "BSPAN"), "q": ("Pitch", "CBAR"), "r": ("Yaw", "BSPAN")}
    variables = [
        _variable("BSPAN", "referenceWingSpan", "ft", initial="0.33333"),
        _variable("CBAR", "referenceWingChord", "ft", initial="0.66667"),
        _variable("V", "trueAirspeed", "ft_s", "<isInput/>"),
        *(_variable(key, f"bodyAngularRate_{axis}", "rad_s", "<isInput/>") for key, (axis, _) in rates.items()),
    ]
    for key, (_, length) in rates.items():
        above, below = (
            _apply("times", *pair)
            for pair in ((f"<ci>{key}</ci>", f"<ci>{length}</ci>"), ("<cn>2.0</cn>", "<ci>V</ci>"))
        )
        variables.append(_variable(f"{key}2V", f"{key}2V", inside=_calculation(_apply("divide", above, below))))
    for of, (axis, slope, rate) in {
        "Cl": ("Roll", -1.0, "p2V"),
        "Cm": ("Pitch", -1.5, "q2V"),
        "Cn": ("Yaw", -2.0, "r2V"),
    }.items():
        product = _calculation(_apply("times", f"<cn>{slope}</cn>", f"<ci>{rate}</ci>"))
        variables.append(_variable(of, f"aeroBodyMomentCoefficient_{axis}", inside=product))
    variables.append(_variable("CD", "totalCoefficientOfDrag", initial="0.01"))
    return f"{HEAD}{''.join(variables)}</DAVEfunc>"


def test_the_two_stage_rocket_flies_by_its_published_model(tmp_path: Path) -> None:
    """The vehicle of check case 17 with its DAVE-ML model has the coefficients of its tables along the axes."""
    folder = tmp_path / "two-stage"
    shutil.copytree(scenarios_folder() / "vehicles" / "nesc-two-stage", folder)
    text = (folder / "vehicle.toml").read_text()
    begin, end = text.index("coefficients = ["), text.index("]\n", text.index("coefficients = ["))
    tables = text[begin : end + 1]
    (folder / "vehicle.toml").write_text(
        text.replace(tables, 'coefficients = [{table = "two-stage.dml", axes = "body"}]')
    )
    (folder / "two-stage.dml").write_text(two_stage())
    loaded = load_scenario("checkcases/nesc-17", [f'vehicle="{folder}"']).scenario.vehicle
    given = load_scenario("checkcases/nesc-17").scenario.vehicle
    for stage, of_csv in zip(loaded.stage, given.stage, strict=True):
        assert stage.aero is not None
        assert of_csv.aero is not None
        grid = grid_table(stage.aero.coefficients[0].table)
        assert grid.axes == ("alpha_deg", "beta_deg")
        middle = [int(np.flatnonzero(b == 0.0)[0]) for b in grid.breaks]
        for table in of_csv.aero.coefficients:
            other = grid_table(table.table)
            axis = 1 if other.axes[0] == "beta_deg" else 0
            line = grid.values[:, middle[1]] if axis == 0 else grid.values[middle[0]]
            for k, name in enumerate(other.names):
                at = np.abs(grid.breaks[axis]) if other.axes[0] == "total_deg" else grid.breaks[axis]
                np.testing.assert_allclose(
                    line[:, grid.names.index(name)], np.interp(at, other.breaks[0], other.values[:, k]), atol=1e-14
                )


def test_tables_and_calculations_have_the_values_of_the_check_data() -> None:
    """Linear between the rows: CL(3), CD at hypot(3, 4) = 5 deg, CY(-4), Cm(3) and Cn(-4)."""
    values = dict(zip(_NAMES.values(), (0.365, 0.28, 0.49, -0.09, -0.12), strict=True))
    inputs = {"angleOfAttack": 3.0, "angleOfSideslip": -4.0}
    found = read_model(two_stage(_shot(inputs, values))).check()
    assert [r.signal for r in found] == list(values)
    assert not any(r.missed for r in found)
    outside = {"angleOfAttack": 14.0, "angleOfSideslip": 30.0}  # the end values hold
    held = {"liftCoefficient": 1.6, "dragCoefficient": 0.48, "aeroBodyMomentCoefficient_Yaw": 0.6}
    assert not any(r.missed for r in read_model(two_stage(_shot(outside, held))).check())
    wrong = read_model(two_stage(_shot(inputs, values | {"dragCoefficient": 0.29}, 0.001)))
    with pytest.raises(DaveError, match=r"misses its check data: by hand: dragCoefficient = 0\.28 instead of 0\.29"):
        coefficient_columns(wrong)


def test_pieces_and_functions_of_calculations_are_evaluated() -> None:
    """alphaT = |alpha| for alpha < 0, max(alpha, sin(pi / 2)) else: CD is that of 6, 1 and 8 deg."""
    negative = f"<piece>{_apply('minus', '<ci>alpha</ci>')}{_apply('lt', '<ci>alpha</ci>', '<cn>0</cn>')}</piece>"
    one = _apply("sin", _apply("divide", "<pi/>", "<cn>2</cn>"))
    otherwise = f"<otherwise>{_apply('max', '<ci>alpha</ci>', one)}</otherwise>"
    model = read_model(two_stage(total=_calculation(f"<piecewise>{negative}{otherwise}</piecewise>")))
    found = model.values(["CD"], {"alpha": np.array([-6.0, 0.5, 8.0])})["CD"]
    assert found == pytest.approx([0.31, 0.22, 0.38], rel=1e-12)


def test_a_calculation_between_breakpoints_is_close_to_the_model() -> None:
    """Bilinear in steps of 0.5 deg, the drag is within 0.006 of that at hypot(alpha, beta), which has kinks."""
    model = read_model(two_stage())
    columns = coefficient_columns(model)
    breaks = [np.unique(columns[name]) for name in ("alpha_deg", "beta_deg")]
    table = RegularGridInterpolator(breaks, columns["CD"].reshape(*(len(b) for b in breaks)))
    at = np.random.default_rng(1).uniform(-10.0, 10.0, (2000, 2))
    true = model.values(["CD"], {"alpha": at[:, 0], "beta": at[:, 1]})["CD"]
    assert np.abs(table(at) - true).max() < 0.0065


def test_a_table_over_the_size_of_an_angle_covers_both_signs() -> None:
    """CD over |beta| = 0, 4, 8 deg is 0.1, 0.3 and 0.2 on both sides."""
    text = HEAD + _variable("beta", "angleOfSideslip", "rad", "<isInput/>")
    size = _calculation(_apply("times", _apply("abs", "<ci>beta</ci>"), _apply("divide", "<cn>180</cn>", "<pi/>")))
    text += _variable("size", "size", "deg", size) + _variable("CD", "totalCoefficientOfDrag")
    text += '<breakpointDef bpID="B"><bpVals>0 4 8</bpVals></breakpointDef>'
    columns = coefficient_columns(read_model(text + _function("CD", "size", "B", [0.1, 0.3, 0.2]) + "</DAVEfunc>"))
    found = np.interp([-8.0, -6.0, -4.0, 0.0, 4.0, 8.0], columns["beta_deg"], columns["CD"])
    assert found == pytest.approx([0.2, 0.25, 0.3, 0.1, 0.3, 0.2], rel=1e-9)


def test_damping_by_body_rates_is_that_of_the_brick() -> None:
    columns = coefficient_columns(read_model(brick()))
    assert columns["CD"] == pytest.approx([0.01])
    expected = {"Clp": -1.0, "Clr": 0.0, "Cmq": -1.5, "Cnp": 0.0, "Cnr": -2.0}
    for name, value in expected.items():
        assert columns[name] == pytest.approx([value], rel=1e-9, abs=1e-12)
    assert columns["Cl"] == pytest.approx([0.0])


def test_a_grid_of_two_variables_is_in_the_order_of_its_breakpoints() -> None:
    """The last variable changes fastest (AIAA S-119, gridded tables); between the points it is bilinear."""
    text = two_stage().replace("</DAVEfunc>", "")
    text += _variable("Cl", "aeroBodyMomentCoefficient_Roll") + _variable("M", "mach", inside="<isInput/>")
    text += '<breakpointDef bpID="MACH"><bpVals>0.5 2.0</bpVals></breakpointDef>'
    text += """<griddedTableDef gtID="roll"><breakpointRefs><bpRef bpID="MACH"/><bpRef bpID="TWENTY"/></breakpointRefs>
<dataTable>1 2 3 4 5 6</dataTable></griddedTableDef><function name="roll"><independentVarRef varID="M"/>
<independentVarRef varID="beta"/><dependentVarRef varID="Cl"/>
<functionDefn><griddedTableRef gtID="roll"/></functionDefn>
</function></DAVEfunc>"""
    model = read_model(text)
    found = model.values(["Cl"], {"M": np.array(1.25), "beta": np.array(-10.0)})
    assert float(found["Cl"]) == pytest.approx(0.25 * (1 + 2 + 4 + 5), rel=1e-12)
    columns = coefficient_columns(model)
    assert sorted(set(columns["mach"])) == [0.5, 2.0]
    row = (columns["mach"] == 2.0) & (columns["alpha_deg"] == 4.0) & (columns["beta_deg"] == 20.0)
    assert (columns["Cl"][row], columns["CL"][row]) == (6.0, 0.49)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("<DAVEfunc/>", "holds no coefficient of force or moment"),
        ("<other/>", "holds <other>, not <DAVEfunc>"),
        ("<DAVEfunc>", "line 1: is not XML (no element found)"),
        ('<!DOCTYPE DAVEfunc [<!ENTITY a "b">]><DAVEfunc>&a;</DAVEfunc>', "line 1: declares the entity a"),
        (
            two_stage(total=_calculation(_apply("factorial", "<ci>alpha</ci>"))),
            "calculation of alphaT: <factorial> is not",
        ),
        (two_stage(total=_calculation("<ci>gamma</ci>")), "variable gamma is not defined"),
        (two_stage(total=_calculation("<ci>alphaT</ci>")), "variable alphaT depends on itself"),
        (two_stage().replace("0.6, 0.0, -0.6", "0.6, 0.0"), "function Cm_fcn: the table has 2 values, not 3"),
        (two_stage().replace("-20., 0., 20.", "-20., 20., 0."), "function Cm_fcn: its breakpoints do not increase"),
        (two_stage().replace("griddedTableDef", "ungriddedTableDef"), "function CL_fcn: holds no gridded table"),
        (two_stage().replace("-1.6, -1.0,", "-1.6, x,"), "dataTable of CL_fcn: could not convert string to float"),
        (two_stage(total=_calculation(_apply("power", "<ci>alpha</ci>"))), "alphaT: <power> has 1 operand"),
        (brick().replace('"0.33333"', '"0"'), "variable p: needs the true airspeed and a reference length"),
        (brick().replace('units="rad_s"', 'units="deg_s"'), "variable p: unit deg_s is not rad_s"),
        (
            brick().replace("<ci>p2V</ci>", _apply("power", "<ci>p2V</ci>", "<cn>2</cn>")),
            "variable Cl: is not linear in p",
        ),
    ],
)
def test_models_that_cannot_be_read_are_named(text: str, said: str) -> None:
    with pytest.raises(DaveError) as error:
        coefficient_columns(read_model(text))
    assert said in str(error.value)


def test_a_wrong_model_is_one_line_with_its_file(tmp_path: Path) -> None:
    (tmp_path / "a.dml").write_text("<DAVEfunc/>")
    overrides = [f'vehicle.stage.0.aero.coefficients=[{{table="{tmp_path}/a.dml"}}]']
    with pytest.raises(ScenarioError, match=r"a\.dml: holds no coefficient of force or moment"):
        load_scenario("checkcases/nesc-17", overrides)
