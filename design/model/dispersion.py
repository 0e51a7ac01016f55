"""Nodes with altered parameters: dispersed, or with stability derivatives imposed on them.

Imposing spans the paper's Table 2 exactly. No plausible arrangement of masses reaches the ends of Table 2's M_delta
(scenarios/vehicles/ksr3/NOTES.md), so a node keeps its mass, speed, pendulums, modes and instruments, and five
parameters are changed until eqs 4 to 8 give the derivatives that are wanted; what is coupled to them follows:

- thrust, for Z_delta (5); drag makes up for it, so that the axial load and with it the slosh frequencies stay
- inertia of the core, for M_delta (8); Cmq, so that M_q (7) stays
- CN_alpha of all surfaces by one factor, for Z_alpha (4); their stations by one shift, for M_alpha (6).
"""

from __future__ import annotations

import csv
import dataclasses
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.interpolate import PchipInterpolator

from maxq.control.kernel.records import Array
from maxq.design.model.instruments import Instruments
from maxq.design.model.vehicle_at import VehicleAt, stability_derivatives, with_pendulums
from maxq.sim.scenario.files import scenarios_folder

if TYPE_CHECKING:
    from maxq.design.model.node import Node  # which imports this module

Factors = float | Sequence[float]
"""One for all modes, tanks, engines or groups of engines, or one each; 1 for those beyond the last."""


@dataclass(frozen=True)
class Dispersion:
    """Factors unless a unit is named; the default changes nothing.

    `slosh_*` keep the vehicle with its liquid frozen as it is (the core makes up the difference) and the hinges in
    place. `actuator_frequency` multiplies the poles of (28), not the zero. `inertia` is that of the core.
    """

    bending_frequency: Factors = 1.0  # per mode
    bending_damping: Factors = 1.0
    bending_slope: Factors = 1.0  # at the gyro and other sensors
    bending_shape: Factors = 1.0  # displacement and slope at the gimbal: what excites the mode
    slosh_frequency: Factors = 1.0  # per tank
    slosh_mass: Factors = 1.0
    slosh_damping: Factors = 1.0
    actuator_frequency: Factors = 1.0  # per group of engines
    actuator_damping: float = 1.0
    gyro_frequency: float = 1.0
    delay_s: float = 0.0  # on top of the computer's; below zero less, down to none
    thrust: Factors = 1.0  # per engine: its lateral authority; the axial load stays
    normal_force: float = 1.0
    centre_of_pressure_m: float = 0.0  # moved aft
    inertia: float = 1.0
    label: str = ""

    def __post_init__(self) -> None:
        for f in dataclasses.fields(self):
            if f.name == "label":
                continue
            value = np.atleast_1d(np.asarray(getattr(self, f.name), float))
            signed = f.name in ("bending_slope", "bending_shape", "centre_of_pressure_m", "normal_force", "delay_s")
            floor = -np.inf if signed else 0.0
            positive = f.name.endswith(("frequency", "inertia", "thrust"))
            if not np.isfinite(value).all() or (value < floor).any() or (positive and (value <= 0.0).any()):
                bound = "" if signed else " above 0" if positive else " from 0"
                raise ValueError(f"{f.name} = {getattr(self, f.name)}: allowed are finite numbers{bound}")


NOMINAL = Dispersion()


def stacked(every: Sequence[Dispersion]) -> Dispersion:
    """Many deviations as one, with the vehicles along the last axis of what differs (`dispersed_many`)."""
    out = {}
    for f in dataclasses.fields(Dispersion):
        if f.name != "label":
            column = np.array([getattr(one, f.name) for one in every], float).T
            alike = column.size > 0 and bool((column == column.flat[0]).all())
            out[f.name] = float(column.flat[0]) if alike else column
    return Dispersion(**out)  # type: ignore[arg-type]  # floats and arrays


def disperse(node: Node, by: Dispersion) -> Node:
    """The node with the deviations applied (`Node.with_`: by keywords). Raises ValueError for too many factors."""
    if by == NOMINAL:
        return node
    label = f"{node.label} {by.label}".strip() if by.label else node.label
    if unlike_drives(by):
        node = with_drives_apart(node)
    return dataclasses.replace(
        node, vehicle=_vehicle(node, by), instruments=disperse_instruments(node.instruments, by), label=label
    )


def dispersed_many(node: Node, by: Dispersion) -> VehicleAt:
    """The vehicles of many deviations at once: each number of `by` (vehicles,), or (modes or tanks, vehicles).

    What deviates, and every array, has the vehicles along its last axis (`plant.vehicle_plants`).
    """
    each = {f.name: getattr(by, f.name) for f in dataclasses.fields(by) if f.name.startswith(("bending", "slosh"))}
    alike = {name: np.full((1, 1), value) for name, value in each.items() if np.ndim(value) == 0}
    counts = {"bending": len(node.vehicle.modes.omega_radps), "slosh": len(node.vehicle.pendulums.mass_kg)}
    alike = {name: np.repeat(value, counts[name.partition("_")[0]], axis=0) for name, value in alike.items()}
    if np.ndim(by.thrust) == 1:
        alike["thrust"] = np.asarray(by.thrust)[None]
    by = dataclasses.replace(by, **alike)  # type: ignore[arg-type]  # arrays for each mode, tank or engine
    vehicle = dataclasses.replace(node.vehicle, cuts=None)  # nobody asks for theirs
    return _vehicle(dataclasses.replace(node, vehicle=_with_an_axis(vehicle)), by)


def _with_an_axis(thing: Any) -> Any:
    """Its arrays with one axis more, of length 1."""
    if isinstance(thing, np.ndarray):
        return thing[..., None]
    if isinstance(thing, tuple):
        return tuple(_with_an_axis(part) for part in thing)
    if dataclasses.is_dataclass(thing):
        fields = {f.name: _with_an_axis(getattr(thing, f.name)) for f in dataclasses.fields(thing)}
        return dataclasses.replace(thing, **fields)  # type: ignore[type-var]  # an instance
    return thing


def _vehicle(node: Node, by: Dispersion) -> VehicleAt:
    vehicle = node.vehicle
    modes, bobs, air = vehicle.modes, vehicle.pendulums, vehicle.aerodynamics
    n, m = len(modes.omega_radps), len(bobs.mass_kg)
    shape, slope = _each(by.bending_shape, n, "bending_shape"), _each(by.bending_slope, n, "bending_slope")
    modes = dataclasses.replace(
        modes,
        omega_radps=modes.omega_radps * _each(by.bending_frequency, n, "bending_frequency"),
        damping_ratio=modes.damping_ratio * _each(by.bending_damping, n, "bending_damping"),
        slope_gyro_pm=modes.slope_gyro_pm * slope,
        sensors=tuple((phi * slope, turn * slope) for phi, turn in modes.sensors),
        phi_gimbal=modes.phi_gimbal * shape,
        slope_gimbal_pm=modes.slope_gimbal_pm * shape,
    )
    mass = _each(by.slosh_mass, m, "slosh_mass")
    changed = dataclasses.replace(
        bobs,
        mass_kg=bobs.mass_kg * mass,
        mass_rate_kgps=bobs.mass_rate_kgps * mass,
        length_m=bobs.length_m / _each(by.slosh_frequency, m, "slosh_frequency") ** 2,
        damping_ratio=bobs.damping_ratio * _each(by.slosh_damping, m, "slosh_damping"),
        viscous=bobs.viscous * _each(by.slosh_damping, m, "slosh_damping"),
        ring=bobs.ring * _each(by.slosh_damping, m, "slosh_damping"),
    )
    if np.any(mass != 1.0) or np.any(changed.length_m != bobs.length_m):
        vehicle = with_pendulums(vehicle, changed)
    body = dataclasses.replace(vehicle.body, core_inertia_kgm2=vehicle.body.core_inertia_kgm2 * by.inertia)
    air = dataclasses.replace(
        air,
        slope_pr=air.slope_pr * by.normal_force,
        moment_slope_mpr=by.normal_force * (air.moment_slope_mpr + air.slope_pr * by.centre_of_pressure_m),
        rate_moment_m2=air.rate_moment_m2 + air.rate_slope_m * by.centre_of_pressure_m,
    )
    if vehicle.across is not None:
        across = _vehicle(dataclasses.replace(node, vehicle=vehicle.across), by)
        vehicle = dataclasses.replace(vehicle, across=across)
    out = dataclasses.replace(vehicle, body=body, modes=modes, pendulums=changed, aerodynamics=air)
    return with_lateral_thrust(out, node, by.thrust)


def with_lateral_thrust(vehicle: VehicleAt, node: Node, factor: Factors) -> VehicleAt:
    """The vehicle with `factor` times the thrust, of all engines or each; drag makes up for it, so that the axial load
    stays. Where there is no air the axial load changes with the thrust.
    """
    if np.all(np.asarray(factor) == 1.0):
        return vehicle
    air, condition = vehicle.aerodynamics, node.condition
    given = np.asarray(factor, float)
    if given.shape[:1] != (1,):
        given = _each(given, 1 + max(n for e in vehicle.engines for n in e.numbers), "thrust")
    alike = len(given) == 1
    factors = [given[0] if alike else given[list(e.numbers)].mean(axis=0) for e in vehicle.engines]
    own = [(f - 1.0) * e.thrust_N(condition.pressure_Pa) for f, e in zip(factors, vehicle.engines, strict=True)]
    pushed = list(zip(vehicle.engines, own, strict=True))
    more = sum(e.rest[0] * push for e, push in pushed)
    engines = tuple(dataclasses.replace(e, vacuum_thrust_N=e.vacuum_thrust_N + push) for e, push in pushed)
    if condition.dynamic_pressure_Pa * air.area_m2 > 0.0:
        air = dataclasses.replace(air, axial=air.axial + more / (condition.dynamic_pressure_Pa * air.area_m2))
    return dataclasses.replace(vehicle, engines=engines, aerodynamics=air)


def disperse_instruments(instruments: Instruments, by: Dispersion) -> Instruments:
    """Actuators, gyro and delay with the deviations applied."""
    g = instruments.gyro
    count = 1 + max(group for groups in instruments.groups for group in groups)
    frequency = _each(by.actuator_frequency, count, "actuator_frequency")
    actuators = []
    for a, groups in zip(instruments.actuators, instruments.groups, strict=True):
        factors = {"omega_{}_radps": float(frequency[groups[0]]), "zeta_{}": by.actuator_damping}
        poles = [(name.format(k), factor) for name, factor in factors.items() for k in (1, 2, 3)]
        actuators.append(dataclasses.replace(a, **{name: getattr(a, name) * factor for name, factor in poles}))
    return dataclasses.replace(
        instruments,
        actuators=tuple(actuators),
        gyro=dataclasses.replace(g, omega_radps=g.omega_radps * by.gyro_frequency),
        sensors=tuple(
            (name, dataclasses.replace(lag, omega_radps=lag.omega_radps * by.gyro_frequency), late)
            for name, lag, late in instruments.sensors
        ),
        delay_s=max(instruments.delay_s + by.delay_s, 0.0),
    )


def unlike_drives(by: Dispersion) -> bool:
    """Whether the actuators of a vehicle's groups of engines deviate from each other."""
    return np.size(by.actuator_frequency) > 1 and bool(np.ptp(np.asarray(by.actuator_frequency)) > 0.0)


def with_drives_apart(node: Node) -> Node:
    """The node with a drive for each group of engines that moves in its plane, alike as their actuators may be."""
    kept, vehicle = node.instruments, node.vehicle
    moved = sorted({e.group for e in vehicle.engines if e.gain != 0.0})
    if all(len(groups) == 1 for groups in kept.groups) or not moved:
        return node
    drive = {group: number for number, group in enumerate(moved)}
    engines = tuple(dataclasses.replace(e, drive=drive.get(e.group, 0)) for e in vehicle.engines)
    by_group = {group: a for a, groups in zip(kept.actuators, kept.groups, strict=True) for group in groups}
    actuators, groups = tuple(by_group[group] for group in moved), tuple((group,) for group in moved)
    return dataclasses.replace(
        node,
        vehicle=dataclasses.replace(vehicle, engines=engines),
        instruments=dataclasses.replace(kept, actuators=actuators, groups=groups),
    )


def for_each(values: Sequence[float], count: int) -> tuple[float, ...]:
    """One value each: those given, the last for all beyond them; zeros where none is."""
    given = (*values, *([values[-1] if values else 0.0] * count))
    return tuple(given[:count])


def _each(factors: Factors | Array, count: int, name: str) -> Array:
    given = np.asarray(factors, float)
    if given.ndim == 0:
        return np.full(count, float(given))
    if len(given) > count:
        raise ValueError(f"{name} has {len(given)} factors: allowed are {count}, or one number for all")
    return np.concatenate([given, np.ones((count - len(given), *given.shape[1:]))])


COLUMNS = ("z_alpha_1ps", "m_alpha_1ps2", "z_delta_1ps", "m_delta_1ps2")
TABLE_2_FILE = "vehicles/ksr3-table2/derivatives.csv"


@dataclass(frozen=True)
class DerivativeTable:
    """Derivatives over vehicle time: `values` (times, 4) in the order of COLUMNS; monotone cubics between."""

    time_s: Array
    values: Array
    source: str = ""

    def at(self, time_s: float) -> dict[str, float]:
        """Raises ValueError outside the table."""
        first, last = float(self.time_s[0]), float(self.time_s[-1])
        if not first <= time_s <= last:
            raise ValueError(f"node at {time_s:g} s: {self.source or 'the table'} holds {first:g} s to {last:g} s")
        row = self.values[0] if len(self.time_s) == 1 else PchipInterpolator(self.time_s, self.values)(time_s)
        return dict(zip(COLUMNS, (float(x) for x in row), strict=True))


def read_derivatives(file: str | Path = TABLE_2_FILE) -> DerivativeTable:
    """A CSV file with columns time_s and COLUMNS; a relative name is also looked for among the built-in scenarios.

    Raises ValueError, naming the file, if it is not such a table.
    """
    path = Path(file) if Path(file).exists() else scenarios_folder() / file
    lines = [line for line in path.read_text(encoding="utf-8").splitlines() if line and not line.startswith("#")]
    rows = list(csv.DictReader(lines))
    wanted = ("time_s", *COLUMNS)
    try:
        numbers = np.array([[float(row[name]) for name in wanted] for row in rows]).reshape(-1, len(wanted))
    except (KeyError, TypeError, ValueError) as problem:
        raise ValueError(f"{path}: allowed are columns {', '.join(wanted)} of numbers ({problem})") from problem
    if not len(numbers) or not np.isfinite(numbers).all() or (np.diff(numbers[:, 0]) <= 0.0).any():
        raise ValueError(f"{path}: allowed are one row or more of finite numbers, time_s rising")
    return DerivativeTable(numbers[:, 0], numbers[:, 1:], str(file))


def imposed(nodes: Iterable[Node], table: DerivativeTable) -> list[Node]:
    """Each node with the table's derivatives at its time. Raises ValueError outside the table and where impossible."""
    return [impose(node, **table.at(node.time_s)) for node in nodes]


def impose(node: Node, z_alpha_1ps: float, m_alpha_1ps2: float, z_delta_1ps: float, m_delta_1ps2: float) -> Node:
    """The node with these `stability_derivatives` and its own M_q."""
    condition = node.condition
    before = stability_derivatives(node.vehicle, condition)
    if min(before.z_delta_1ps, before.m_delta_1ps2, -before.z_alpha_1ps, z_delta_1ps, m_delta_1ps2) <= 0.0:
        raise ValueError(f"node at {node.time_s:g} s: derivatives can be imposed on a thrusting vehicle with lift only")
    vehicle = with_lateral_thrust(node.vehicle, node, z_delta_1ps / before.z_delta_1ps)
    old = vehicle.total_inertia_kgm2
    arm = vehicle.engine.gimbal_station_m - vehicle.total_cg_station_m
    inertia = vehicle.engine.thrust_N(condition.pressure_Pa) * arm / m_delta_1ps2
    core = vehicle.body.core_inertia_kgm2 + inertia - old
    if core <= 0.0:
        raise ValueError(f"node at {node.time_s:g} s: M_delta = {m_delta_1ps2:g} leaves the core no inertia")
    air = vehicle.aerodynamics
    slope = air.slope_pr * (z_alpha_1ps / before.z_alpha_1ps)
    moment = air.moment_slope_mpr * (z_alpha_1ps / before.z_alpha_1ps)
    force_area = condition.dynamic_pressure_Pa * air.area_m2
    wanted = float(slope.sum()) * vehicle.total_cg_station_m - m_alpha_1ps2 * inertia / force_area
    shift = (wanted - float(moment.sum())) / float(slope.sum())
    return dataclasses.replace(
        node,
        vehicle=dataclasses.replace(
            vehicle,
            body=dataclasses.replace(vehicle.body, core_inertia_kgm2=core),
            aerodynamics=dataclasses.replace(
                air,
                slope_pr=slope,
                moment_slope_mpr=moment + slope * shift,
                rate_damping=air.rate_damping * inertia / old,
                rate_slope_m=air.rate_slope_m * inertia / old,
                rate_moment_m2=air.rate_moment_m2 * inertia / old,
            ),
        ),
    )
