"""Slender-body and fin aerodynamics over Mach number: first estimates, to be replaced by wind-tunnel data.

The normal force follows slender-body theory for the nose and changes of diameter (2 / rad on the area gained), and
Barrowman's method for fins with body interference (J. S. Barrowman, NARAM-8, 1966). Both are multiplied by an assumed
function of Mach number that peaks at Mach 1.1. The cross-flow drag coefficient is 1.2 on the planform area. Rate
damping is the sum over the lifting parts. The axial force is an assumed curve of a clean launcher.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from scipy.interpolate import PchipInterpolator

from maxq.control.kernel.records import Array
from maxq.sim.input.tables_csv import CsvTable
from maxq.sim.vehicle.air.section import AeroSection
from maxq.sim.vehicle.air.tables import GridTable
from maxq.tools.vehicle.layout import LayoutFins
from maxq.tools.vehicle.masses import Stack

MACH = np.array([0.0, 0.5, 0.8, 0.95, 1.1, 1.25, 1.5, 1.75, 2.0, 2.5, 3.0, 5.0, 8.0])
_FIN_LIFT = np.array([1.0, 1.02, 1.08, 1.13, 1.16, 1.13, 1.02, 0.91, 0.81, 0.67, 0.56, 0.33, 0.21])
_FIN_SHIFT = 0.25 * np.array([0.0, 0.0, 0.0, 0.1, 0.4, 0.8, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0])  # chords
_BODY_LIFT = 1.0 + 0.15 * np.exp(-(((MACH - 1.1) / 0.5) ** 2))
_AXIAL = np.array([0.30, 0.29, 0.31, 0.45, 0.55, 0.54, 0.49, 0.44, 0.40, 0.33, 0.28, 0.21, 0.18])
_BASE = np.interp(MACH, [0.0, 0.9, 1.1, 2.0, 5.0], [0.10, 0.13, 0.18, 0.10, 0.02])  # without a jet that fills the base
CROSSFLOW = 1.2
NOSE_CENTRE = {"ogive": 0.466, "cone": 2.0 / 3.0}  # share of the nose's length


@dataclass(frozen=True)
class Surface:
    """A lifting part: its normal force slope (1/rad, on the reference area) and station (m aft of the nose), each over
    the Mach numbers of its `Aerodynamics`.
    """

    name: str
    slope_pr: Array
    station_m: Array


@dataclass(frozen=True)
class Aerodynamics:
    """The aerodynamics of a stack over `mach`. The reference length is the largest diameter of the whole vehicle.

    Coefficients are arrays over `mach`, on `area_m2` and `diameter_m`. `axial` applies under thrust, `axial_coast`
    without a jet.
    """

    mach: Array
    diameter_m: float
    surfaces: tuple[Surface, ...]
    crossflow: float
    crossflow_station_m: float
    roll_damping: Array
    axial: Array
    axial_coast: Array
    damping: Array | None = None  # pitch damping Cmq, if given
    boosters: tuple[tuple[Surface, Array], ...] = ()  # normal and axial force of each set, per booster

    @property
    def area_m2(self) -> float:
        return 0.25 * math.pi * self.diameter_m**2

    def normal(self, mach: float) -> tuple[float, float]:
        """Return the normal force slope (1/rad) and the centre of pressure (m aft of the nose) at a Mach number.

        The centre is NaN if the slope is zero.
        """
        slopes = [float(np.interp(mach, self.mach, s.slope_pr)) for s in self.surfaces]
        stations = [float(np.interp(mach, self.mach, s.station_m)) for s in self.surfaces]
        return sum(slopes), float(np.dot(slopes, stations)) / (sum(slopes) or math.nan)

    def pitch_damping(self, x_cg_m: float) -> Array:
        """Return Cmq about a CG at `x_cg_m` over the Mach numbers, for the rate normalised as q d / (2 U)."""
        if self.damping is not None:
            return self.damping
        moment = sum((s.slope_pr * (s.station_m - x_cg_m) ** 2 for s in self.surfaces), np.zeros(len(self.mach)))
        return np.asarray(-2.0 * moment / self.diameter_m**2)


def aerodynamics(stack: Stack) -> Aerodynamics:
    """Return the estimated or given aerodynamics of the stack that flies while a stage burns."""
    layout, stages = stack.layout, list(reversed(stack.layout.stage[stack.number :]))
    diameter = max(s.diameter_m for s in layout.stage)
    nose = body_lift(
        "nose", 2.0 * (stages[0].diameter_m / diameter) ** 2, NOSE_CENTRE[layout.nose] * layout.nose_length_m
    )
    surfaces = [nose]
    for ahead, behind in pairwise(stages):
        gained = (behind.diameter_m**2 - ahead.diameter_m**2) / diameter**2
        if gained != 0.0:
            surfaces.append(body_lift(f"step_{behind.name}", 2.0 * gained, behind.front_station_m))
    planform = [(2.0 / 3.0 * layout.nose_length_m * stages[0].diameter_m, 0.6 * layout.nose_length_m)]
    for stage in stages:
        front = max(stage.front_station_m, layout.nose_length_m)
        planform.append((stage.diameter_m * (stage.rear_station_m - front), 0.5 * (stage.rear_station_m + front)))
    roll = np.zeros(len(MACH))
    for stage in stages:
        if stage.fins is not None:
            name, radius_m = f"fins_{stage.name}", 0.5 * stage.diameter_m
            fins, roll_damping, area = fin_lift(stage.fins, name, radius_m, diameter)
            surfaces.append(fins)
            roll = roll + roll_damping
            planform.append((2.0 * area, float(fins.station_m[0])))
    total = sum(a for a, _ in planform)
    share = (max(s.diameter_m for s in stages) / diameter) ** 2
    axial = layout.axial_factor * share * _AXIAL
    found = Aerodynamics(
        MACH,
        diameter,
        tuple(surfaces),
        CROSSFLOW * total / (0.25 * math.pi * diameter**2),
        sum(a * x for a, x in planform) / total,
        roll,
        axial,
        axial + share * _BASE,
    )
    if stack.stage.aero is not None:
        return _with_given(found, stack.stage.aero)
    return _with_boosters(found, stack)


def _with_boosters(core: Aerodynamics, stack: Stack) -> Aerodynamics:
    """Return the aerodynamics with the noses and the axial force of the attached boosters added, without
    interference.
    """
    surfaces, boosters, axial, coast = [*core.surfaces], [], core.axial, core.axial_coast
    for strapped in stack.boosters:
        b, count = strapped.booster, len(strapped.booster.positions_m)
        share = (b.diameter_m / core.diameter_m) ** 2
        nose_m = NOSE_CENTRE[stack.layout.nose] * (b.nose_length_m or 2.0 * b.diameter_m)
        one = Surface(b.name, 2.0 * share * _BODY_LIFT, np.full(len(MACH), b.front_station_m + nose_m))
        along = b.axial_factor * share * _AXIAL
        boosters.append((one, along))
        surfaces.append(replace(one, slope_pr=count * one.slope_pr))
        axial, coast = axial + count * along, coast + count * (along + share * _BASE)
    return replace(core, surfaces=tuple(surfaces), axial=axial, axial_coast=coast, boosters=tuple(boosters))


def _with_given(estimate: Aerodynamics, given: AeroSection) -> Aerodynamics:
    """Return the estimate with the values of a vehicle file's section in place of its own.

    The values are those at a small angle of attack and under thrust.
    """
    tables = [given.table, *(s.table for s in given.surface)]
    grids = [c.grid for c in given.coefficients]
    machs = [*(t["mach"] for t in tables), *(g.breaks[0] for g in grids if g.axes[0] == "mach")]
    mach = np.unique(np.concatenate([estimate.mach, *machs]))

    def of(table: CsvTable, name: str) -> Array:
        smooth = len(table) > 1 and given.interpolation == "pchip"
        at = np.clip(mach, table["mach"][0], table["mach"][-1])
        return np.asarray(
            PchipInterpolator(table["mach"], table[name])(at) if smooth else np.interp(at, table["mach"], table[name])
        )

    def either(name: str, other: Array) -> Array:
        return of(given.table, name) if name in given.table else np.interp(mach, estimate.mach, other)

    surfaces = [
        Surface(s.name or str(n + 1), of(s.table, "CN_alpha_pr"), of(s.table, "station_m"))
        for n, s in enumerate(given.surface)
    ]
    if "CN_alpha_pr" in given.table and not given.surface:
        slope = of(given.table, "CN_alpha_pr")
        turned = given.moment_reference_m - estimate.diameter_m * either("Cm_alpha_pr", 0.0 * estimate.mach) / slope
        surfaces.append(Surface("body", slope, of(given.table, "x_cp_m") if "x_cp_m" in given.table else turned))
    axial = coast = np.zeros(len(mach))
    for n, (table, grid) in enumerate(zip(given.coefficients, grids, strict=True)):
        force, moment, along = _small_incidence(grid, mach)
        coast = coast + along * (table.power != "on")
        if table.power == "off":
            continue
        axial = axial + along
        station = given.moment_reference_m - estimate.diameter_m * moment / np.where(force == 0.0, np.inf, force)
        surfaces.append(Surface(table.name or f"table {n + 1}", force, station))
    if "CA" in given.table or "CD" in given.table:
        power_on = sum((of(given.table, name) for name in ("CA", "CD") if name in given.table), np.zeros(len(mach)))
        base = of(given.table, "CA_coast") - of(given.table, "CA") if "CA_coast" in given.table else 0.0
        axial, coast = axial + power_on, coast + power_on + base
    elif not axial.any():
        axial, coast = either("", estimate.axial), either("", estimate.axial_coast)
    lifting = surfaces or [
        replace(s, slope_pr=either("", s.slope_pr), station_m=either("", s.station_m)) for s in estimate.surfaces
    ]
    across = given.crossflow_station_m
    return Aerodynamics(
        mach,
        estimate.diameter_m,
        tuple(lifting),
        float(given.table["C_crossflow"][0]) if "C_crossflow" in given.table else estimate.crossflow,
        estimate.crossflow_station_m if across is None else across,
        either("Clp", estimate.roll_damping),
        axial,
        coast,
        of(given.table, "Cmq") if "Cmq" in given.table else None,
    )


def _small_incidence(grid: GridTable, mach: Array) -> tuple[Array, Array, Array]:
    """Return the slopes of normal force and pitch moment (1/rad) and the axial force coefficient at zero angle of
    attack.

    Each is an array over `mach`.
    """
    values = grid.values
    for axis in reversed(range(len(grid.axes))):
        if grid.axes[axis] not in ("mach", "total_deg", "alpha_deg"):
            values = np.take(values, int(np.argmin(np.abs(grid.breaks[axis]))), axis)
    if grid.axes[0] != "mach":
        values = values[None]
    columns = {name: values[..., k] for k, name in enumerate(grid.names)}
    breaks = grid.breaks[0] if grid.axes[0] == "mach" else np.zeros(1)
    angles = next((grid.breaks[k] for k, a in enumerate(grid.axes) if a in ("total_deg", "alpha_deg")), None)

    def over_mach(column: Array) -> Array:
        return np.interp(mach, breaks, column)

    if angles is None:
        return 0.0 * mach, 0.0 * mach, over_mach(sum((columns[n] for n in ("CA", "CD") if n in columns), 0.0 * breaks))
    k = int(np.argmin(np.abs(angles)))
    low, high = max(k - 1, 0), min(k + 1, len(angles) - 1)
    step = math.radians(float(angles[high] - angles[low])) or math.inf
    at_zero = {name: column[:, k] for name, column in columns.items()}
    slope = {name: (column[:, high] - column[:, low]) / step for name, column in columns.items()}
    none = np.zeros(len(breaks))
    along = at_zero.get("CA", none) - at_zero.get("CX", none) + at_zero.get("CD", none)
    force = slope.get("CN", none) - slope.get("CZ", none)
    if "CL" in slope:
        force = slope["CL"] + at_zero.get("CD", none)
    return over_mach(force), over_mach(slope.get("Cm", none)), over_mach(along)


def body_lift(name: str, slope_pr: float, station_m: float) -> Surface:
    """Return a part of the body by its normal force slope of slender-body theory, 1/rad, and its station."""
    return Surface(name, slope_pr * _BODY_LIFT, np.full(len(MACH), station_m))


def fin_lift(fins: LayoutFins, name: str, radius_m: float, reference_m: float) -> tuple[Surface, Array, float]:
    """Return the lifting part and Clp of a set of fins, and the planform area of one fin.

    The method is that of Barrowman (equations 3-57 and 3-31), with strip theory in roll. `radius_m` is the radius of
    the body.
    """
    s, root, tip = fins.semispan_m, fins.root_chord_m, fins.tip_chord_m
    middle = math.hypot(s, fins.sweep_m + 0.5 * (tip - root))  # length of the mid-chord line
    interference = 1.0 + radius_m / (s + radius_m)
    alone = 4.0 * fins.count * (s / reference_m) ** 2 / (1.0 + math.sqrt(1.0 + (2.0 * middle / (root + tip)) ** 2))
    centre = fins.sweep_m / 3.0 * (root + 2.0 * tip) / (root + tip)
    centre += (root + tip - root * tip / (root + tip)) / 6.0
    y = np.linspace(radius_m, radius_m + s, 201)
    chord = np.interp(y, [radius_m, radius_m + s], [root, tip])
    square = float(np.trapezoid(chord * y * y, y) / np.trapezoid(chord, y))
    # the normal force of the set is that of count / 2 fins; in roll, all fins act
    roll = -2.0 * 2.0 * alone * _FIN_LIFT * square / reference_m**2
    shift = _FIN_SHIFT * 0.5 * (root + tip)
    surface = Surface(name, interference * alone * _FIN_LIFT, fins.leading_edge_station_m + centre + shift)
    return surface, roll, 0.5 * (root + tip) * s
