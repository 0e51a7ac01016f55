"""Nodes with deviating parameters: each deviation changes the packed parameters or properties of the held stage."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from maxq.control.kernel.records import Array
from maxq.design.model.held import FlightCondition, HeldStage, Trim
from maxq.design.model.instruments import Instruments, Plane
from maxq.design.model.vehicle_at import axial_load_mps2, total_of
from maxq.sim.vehicle import schedule

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
    """Many deviations as one, with the vehicles along the last axis of what differs (`deviated`)."""
    out = {}
    for f in dataclasses.fields(Dispersion):
        if f.name != "label":
            column = np.array([getattr(one, f.name) for one in every], float).T
            alike = column.size > 0 and bool((column == column.flat[0]).all())
            out[f.name] = float(column.flat[0]) if alike else column
    return Dispersion(**out)  # type: ignore[arg-type]  # floats and arrays


def deviated(
    held: HeldStage, condition: FlightCondition, trim: Trim, plane: Plane, by: Dispersion, count: int = 1
) -> HeldStage:
    """Return the held stages of `count` deviations at once, changes of the packed parameters and properties.

    Each number of `by` may be one, one for each part, or have the vehicles along its last axis (`stacked`). Raises
    ValueError for too many factors, and where no core is left.
    """
    nominal, held = held, held.repeated(count)
    vehicle, sizes = held.vehicle, held.sizes
    spatial, planar = int(sizes.spatial_modes), int(sizes.pitch_modes if plane == "pitch" else sizes.yaw_modes)
    n, m = spatial + planar, len(held.swing_rad)

    def each(name: str, parts: int) -> Array:
        """Factors, (vehicles, parts)."""
        return _each(getattr(by, name), parts, name, count).T

    def one(name: str) -> Array:
        return np.broadcast_to(np.asarray(getattr(by, name), float), (count,))

    frequency, damping = each("bending_frequency", n), each("bending_damping", n)
    vehicle["spatial_modes"]["frequency_factor"][:, :spatial] *= frequency[:, :spatial]
    vehicle["spatial_modes"]["zeta"][:, :spatial] *= damping[:, :spatial]
    vehicle["bending"]["frequency_factor"][:, :planar] *= frequency[:, spatial:]
    for axis in ("pitch", "yaw"):
        vehicle["bending"][f"zeta_{axis}"][:, :planar] *= damping[:, spatial:]
    _scale_shapes(held, each("bending_shape", n), each("bending_slope", n))
    _deviate_liquid(held, each("slosh_mass", m), each("slosh_frequency", m))
    liquid = each("slosh_damping", m)
    for name in ("damping_ratio", "law_factor", "ring_damping"):
        vehicle["slosh"][name][:, :m] *= liquid
    about = slice(schedule.CORE_INERTIA + 1, schedule.CORE_INERTIA + 3)
    held.properties[:, about] *= one("inertia")[:, None]
    vehicle["aero"]["force_factor"] *= one("normal_force")
    vehicle["aero"]["centre_shift_m"] += one("centre_of_pressure_m")
    engines = int(np.sum(vehicle["engine"]["parts"][0] > 0.0))
    thrust = _each(by.thrust, engines, "thrust", count).T
    if (thrust != 1.0).any():
        load = axial_load_mps2(nominal, condition, trim)
        _deviate_thrust(held, condition, load, thrust)
    return held


def _scale_shapes(held: HeldStage, shape: Array, slope: Array) -> None:
    """Scale the modes' shapes at the first gimbal, and their slopes at the gyro and all at other sensors, in place."""
    sizes, p = held.sizes, held.properties
    spatial, gimbals, sensors = int(sizes.spatial_modes), int(sizes.gimbals), int(sizes.sensors)
    for plane in (schedule.PITCH, schedule.YAW):
        planar = min(shape.shape[1] - spatial, int(sizes.yaw_modes if plane else sizes.pitch_modes))
        rows = [
            (schedule.MODE_PHI_GIMBAL, shape),
            (schedule.MODE_SLOPE_GIMBAL, shape),
            (schedule.MODE_SLOPE_GYRO, slope),
        ]
        for k in range(gimbals - sensors, gimbals):
            row = int(schedule.gimbal_row(sizes, k))
            rows += [(row, slope), (row + 1, slope)]
        for row, factor in rows:
            first = int(schedule.mode_column(sizes, plane, row))
            p[:, first : first + planar] *= factor[:, spatial : spatial + planar]
    places = [(schedule.GYRO_PLACE, (4, 5), slope), (int(schedule.gimbal_place(sizes, 0)), (1, 2, 4, 5), shape)]
    places += [(int(schedule.gimbal_place(sizes, k)), (1, 2, 4, 5), slope) for k in range(gimbals - sensors, gimbals)]
    for place, components, factor in places if spatial else []:
        for component in components:
            first = int(schedule.place_column(sizes, place, component))
            p[:, first : first + spatial] *= factor[:, :spatial]


def _deviate_liquid(held: HeldStage, mass: Array, frequency: Array) -> None:
    """Scale the sloshing masses and the pendulums' frequencies in place; the core makes up the difference.

    Total mass, CG and inertia with the liquid frozen stay. Raises ValueError where no core is left.
    """
    if (mass == 1.0).all() and (frequency == 1.0).all():
        return
    total, centre, inertia = total_of(held)
    p = held.properties
    for k in range(mass.shape[1]):
        column = schedule.tank_column(k)
        p[:, column + schedule.TANK_MASS] *= mass[:, k]
        p[:, column + schedule.TANK_MASS_RATE] *= mass[:, k]
        p[:, column + schedule.TANK_LENGTH] /= frequency[:, k] ** 2
    bobs, places = held.tank(schedule.TANK_MASS), held.tank(schedule.TANK_HINGE) + held.tank(schedule.TANK_LENGTH)
    core = total - bobs.sum(axis=1)
    if core.min() <= 0.0:
        raise ValueError(f"sloshing masses of {bobs.sum(axis=1).max():g} kg in a vehicle of {total.max():g} kg")
    station = (total * centre - (bobs * places).sum(axis=1)) / core
    apart = (bobs * (places - centre[:, None]) ** 2).sum(axis=1)
    own = inertia - (apart + core * (station - centre) ** 2)[:, None]
    if own.min() <= 0.0:
        raise ValueError(f"bobs of {apart.max():g} kg m2 in a vehicle of {inertia.max():g} kg m2")
    p[:, schedule.CORE_MASS], p[:, schedule.CORE_CG] = core, station
    p[:, schedule.CORE_INERTIA + 1 : schedule.CORE_INERTIA + 3] = own


def _deviate_thrust(held: HeldStage, condition: FlightCondition, load_mps2: float, factor: Array) -> None:
    """Scale the thrust of each engine of the vehicle (vehicles, engines) in place; drag makes up for it, so that the
    axial load stays. Where there is no air the axial load changes with the thrust.
    """
    engine, more, axial = held.vehicle["engine"], np.zeros(len(factor)), 0.0
    parts, taken_as = engine["parts"][0], engine["taken_as"][0]
    for k in range(int(held.sizes.engines)):
        vacuum = held.properties[0, int(schedule.thrust_column(held.sizes, int(engine["curve"][0, k])))]
        before = float(engine["thrust_factor"][0, k]) * vacuum
        strength = max(before - condition.pressure_Pa * float(engine["exit_area_m2"][0, k]), 0.0)
        mine = factor[:, [j for j in range(factor.shape[1]) if parts[j] > 0.0 and taken_as[j] == k]].mean(axis=1)
        added = (mine - 1.0) * strength
        if vacuum > 0.0:
            engine["thrust_factor"][:, k] = (before + added) / vacuum
        more = more + float(engine["rest_x"][0, k]) * added
        axial += float(engine["rest_x"][0, k]) * strength
    if condition.dynamic_pressure_Pa * float(held.vehicle["aero"]["area_m2"][0]) > 0.0:
        drag_N = axial - load_mps2 * float(held.properties[0, schedule.TOTAL_MASS])
        held.vehicle["aero"]["axial_factor"] *= 1.0 + more / drag_N


def disperse_instruments(instruments: Instruments, by: Dispersion) -> Instruments:
    """Actuators, gyro and delay with the deviations applied."""
    g = instruments.gyro
    count = 1 + max(group for groups in instruments.groups for group in groups)
    frequency = _each(by.actuator_frequency, count, "actuator_frequency")[:, 0]
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


def for_each(values: Sequence[float], count: int) -> tuple[float, ...]:
    """One value each: those given, the last for all beyond them; zeros where none is."""
    given = (*values, *([values[-1] if values else 0.0] * count))
    return tuple(given[:count])


def _each(factors: Factors | Array, parts: int, name: str, count: int = 1) -> Array:
    """Factors of parts, (parts, vehicles)."""
    given = np.asarray(factors, float)
    if given.ndim == 0:
        return np.full((parts, count), float(given))
    given = given.reshape(len(given), -1) if given.ndim > 1 or count == 1 else np.repeat(given[None], parts, axis=0)
    if len(given) > parts:
        raise ValueError(f"{name} has {len(given)} factors: allowed are {parts}, or one number for all")
    given = np.concatenate([given, np.ones((parts - len(given), given.shape[1]))])
    return np.array(np.broadcast_to(given, (parts, count)))
