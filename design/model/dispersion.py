"""Operating points with deviating parameters. Each deviation changes packed parameters or properties of the stage."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from maxq.control.kernel.records import Array
from maxq.control.kernel.tables import table_in
from maxq.design.model.held import HeldStage
from maxq.design.model.instruments import Instruments, Plane
from maxq.sim.packing.schedule import without_bobs
from maxq.sim.vehicle import schedule

Factors = float | Sequence[float]
"""A value for all modes, tanks, engines or engine groups, or one value each. The factor is 1 beyond the last value."""


@dataclass(frozen=True)
class Dispersion:
    """The deviations of a vehicle, as factors unless a unit is given. The defaults change nothing.

    Each deviation acts on packed parameters and properties in the same way as packing a changed scenario. `slosh_*`,
    `inertia` and `centre_of_gravity_m` leave the hinges and the other properties of the whole vehicle unchanged, and
    the core absorbs the difference. A changed slosh frequency changes the length of the pendulum.
    """

    bending_frequency: Factors = 1.0  # per mode, spatial modes first
    bending_damping: Factors = 1.0
    bending_slope: Factors = 1.0  # at the gyro and other sensors
    bending_shape: Factors = 1.0  # displacement and slope at the gimbals, which excite the mode
    slosh_frequency: Factors = 1.0  # per pendulum
    slosh_mass: Factors = 1.0
    slosh_damping: Factors = 1.0  # all damping, including walls and rings
    slosh_damping_ratio: Factors = 1.0  # damping ratio without walls and rings
    actuator_frequency: Factors = 1.0  # of the poles but not of the zero, per group of engines
    actuator_damping: float = 1.0
    actuator_sections: Factors = (
        1.0  # eight factors per group: frequencies of three pole pairs and of the zeros, then damping ratios
    )
    gyro_frequency: float = 1.0
    delay_s: float = 0.0  # added to the computer's delay, whose sum is at least zero
    thrust: Factors = 1.0  # per engine, at unchanged mass flow
    mass_flow: Factors = 1.0  # per engine, with proportional thrust: the burn rate
    normal_force: float = 1.0
    axial_force: float = 1.0
    rate_damping: float = 1.0  # aerodynamic damping of body rates
    centre_of_pressure_m: float = 0.0  # moved aft
    inertia: Factors = 1.0  # of the whole vehicle about y and z
    roll_inertia: float = 1.0
    mass: float = 1.0  # of the whole vehicle, at unchanged inertia
    mass_kg: float = 0.0  # added to the mass of the whole vehicle, at unchanged inertia
    centre_of_gravity_m: float = 0.0  # of the whole vehicle, moved aft
    centre_of_gravity_y_m: float = 0.0
    centre_of_gravity_z_m: float = 0.0
    label: str = ""

    def __post_init__(self) -> None:
        for f in dataclasses.fields(self):
            if f.name == "label":
                continue
            value = np.atleast_1d(np.asarray(getattr(self, f.name), float))
            signed = f.name in SIGNED
            floor = -np.inf if signed else 0.0
            positive = f.name in POSITIVE
            if not np.isfinite(value).all() or (value < floor).any() or (positive and (value <= 0.0).any()):
                bound = "" if signed else " above 0" if positive else " from 0"
                raise ValueError(f"{f.name} = {getattr(self, f.name)}: allowed are finite numbers{bound}")


ADDED = (
    "delay_s",
    "centre_of_pressure_m",
    "mass_kg",
    "centre_of_gravity_m",
    "centre_of_gravity_y_m",
    "centre_of_gravity_z_m",
)
"""The fields that are increments. All others are factors."""
SIGNED = (*ADDED, "bending_slope", "bending_shape", "normal_force")
POSITIVE = (
    "bending_frequency",
    "slosh_frequency",
    "actuator_frequency",
    "actuator_sections",
    "gyro_frequency",
    "thrust",
    "mass_flow",
    "inertia",
    "roll_inertia",
    "mass",
)
_RATE_STEP_S = 1e-3
SECTIONS = 8
"""The number of elements per actuator in `Dispersion.actuator_sections`."""

NOMINAL = Dispersion()


def stacked(every: Sequence[Dispersion]) -> Dispersion:
    """Return many deviations as one, with the vehicles along the last axis of fields that differ (see `deviated`)."""
    out = {}
    for f in dataclasses.fields(Dispersion):
        if f.name != "label":
            column = np.array([getattr(one, f.name) for one in every], float).T
            alike = column.size > 0 and bool((column == column.flat[0]).all())
            out[f.name] = float(column.flat[0]) if alike else column
    return Dispersion(**out)  # type: ignore[arg-type]  # floats and arrays


def deviated(held: HeldStage, plane: Plane, by: Dispersion, count: int = 1) -> HeldStage:
    """Return `count` copies of a held stage with the deviations applied to packed parameters and properties.

    Each field of `by` is a scalar, one value for each part, or an array with the vehicles along its last axis
    (`stacked`). Raises ValueError for too many factors, and for a core without positive mass and inertia.
    """
    held = held.repeated(count)
    vehicle, sizes = held.vehicle, held.sizes
    spatial, planar = int(sizes.spatial_modes), int(sizes.pitch_modes if plane == "pitch" else sizes.yaw_modes)
    n, m = spatial + planar, len(held.swing_rad)

    def each(name: str, parts: int) -> Array:
        """Return the factors of a field, (vehicles, parts)."""
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
    liquid = each("slosh_damping", m)
    vehicle["slosh"]["damping_ratio"][:, :m] *= each("slosh_damping_ratio", m)
    for name in ("damping_ratio", "law_factor", "ring_damping"):
        vehicle["slosh"][name][:, :m] *= liquid
    for name, field in (("force", "normal_force"), ("axial", "axial_force"), ("damping", "rate_damping")):
        vehicle["aero"][f"{name}_factor"] *= one(field)
    vehicle["aero"]["centre_shift_m"] += one("centre_of_pressure_m")
    moved = [one(f"centre_of_gravity{axis}_m") for axis in ("", "_y", "_z")]
    inertia = np.concatenate([one("roll_inertia")[:, None], each("inertia", 2)], axis=1)
    _deviate_masses(
        held,
        one("mass"),
        one("mass_kg"),
        np.stack(moved, axis=1),
        inertia,
        each("slosh_mass", m),
        each("slosh_frequency", m),
    )
    engines = int(np.sum(vehicle["engine"]["parts"][0] > 0.0))
    _deviate_engines(held, each("thrust", engines), each("mass_flow", engines))
    return held


def _scale_shapes(held: HeldStage, shape: Array, slope: Array) -> None:
    """Scale the mode shapes at the gimbals, the slopes at the gyro and all components at other sensors, in place."""
    sizes, p = held.sizes, held.properties
    spatial, gimbals, sensors = int(sizes.spatial_modes), int(sizes.gimbals), int(sizes.sensors)
    engines, given = int(schedule.first_acted(sizes)), np.ones_like(shape)
    by_gimbal = [shape] * engines + [given] * (gimbals - sensors - engines) + [slope] * sensors
    for plane in (schedule.PITCH, schedule.YAW):
        planar = min(shape.shape[1] - spatial, int(sizes.yaw_modes if plane else sizes.pitch_modes))
        rows = [(schedule.MODE_SLOPE_GYRO, slope)]
        for k, factor in enumerate(by_gimbal):
            row = int(schedule.gimbal_row(sizes, k))
            rows += [(row, factor), (row + 1, factor)]
        for row, factor in rows:
            first = int(schedule.mode_column(sizes, plane, row))
            p[:, first : first + planar] *= factor[:, spatial : spatial + planar]
    places = [(schedule.GYRO_PLACE, range(3, 6), slope)]
    places += [(int(schedule.gimbal_place(sizes, k)), range(6), by_gimbal[k]) for k in range(gimbals)]
    for place, components, factor in places if spatial else []:
        for component in components:
            first = int(schedule.place_column(sizes, place, component))
            p[:, first : first + spatial] *= factor[:, :spatial]


def _deviate_masses(
    held: HeldStage, mass: Array, mass_kg: Array, moved_m: Array, inertia: Array, slosh_mass: Array, frequency: Array
) -> None:
    """Change mass, CG (aft, y, z) and inertia (x, y, z) of the whole vehicle, and its pendulums, in place.

    The core is the vehicle without the bobs, as in `sim/packing/schedule.py` at each row of its tables. Packing
    interpolates the cores between rows, so that the results differ there by the interpolation error. Rates change by
    finite differences over the clock of the tables. Raises ValueError if the core has no positive mass or inertia.
    """
    alike = all((factor == 1.0).all() for factor in (mass, inertia, slosh_mass, frequency))
    if alike and not mass_kg.any() and not moved_m.any():
        return
    p, row = held.properties, held.parameters[0]
    columns = np.array([schedule.tank_column(k) for k in range(slosh_mass.shape[1])], int)
    slosh, n = row.vehicle.slosh, len(columns)
    places = list(zip(slosh.place_y_m[:n].tolist(), slosh.place_z_m[:n].tolist(), strict=True))
    tank = np.stack(
        [slosh_mass, frequency**-2.0, np.ones_like(slosh_mass)], axis=-1
    )  # factors of mass, length and hinge

    def deviated_at(rows: Array) -> tuple[Array, Array]:
        """Return the core (vehicles, 10) and the bobs (tanks, vehicles, 3) of rows of the schedule."""
        bobs = [rows[:, c + schedule.TANK_MASS : c + schedule.TANK_HINGE + 1] for c in columns]
        total = without_bobs(
            rows[:, : schedule.CG_RATE], [bob * (-1.0, 1.0, 1.0) for bob in bobs], places
        )  # adds the bobs to the core
        total[:, 0] = total[:, 0] * mass + mass_kg
        total[:, 1:4] += moved_m
        total[:, 4:7] *= inertia
        bobs = [bob * tank[:, k] for k, bob in enumerate(bobs)]
        sloshing = sum((bob[:, 0] for bob in bobs), np.zeros(len(total)))
        if (total[:, 0] - sloshing).min() <= 0.0:
            raise ValueError(f"sloshing masses of {sloshing.max():g} kg in a vehicle of {total[:, 0].max():g} kg")
        core = without_bobs(total, bobs, places)
        if core[:, 4:7].min() <= 0.0:
            least = total[:, 4:7].min()
            raise ValueError(f"bobs of {least - core[:, 4:7].min():g} kg m2 in a vehicle of {least:g} kg m2")
        return core, np.array(bobs)

    core, bobs = deviated_at(p)
    table, clock_s = table_in(held.pool, row.vehicle.schedule), float(row.timeline.frozen_s)
    ends = [np.broadcast_to(table(clock_s + at), (len(p), table.n_columns)) for at in (-_RATE_STEP_S, _RATE_STEP_S)]
    (core_0, bobs_0), (core_1, bobs_1) = (deviated_at(end) for end in ends)
    per_s = float(row.timeline.burn_rate) / (2.0 * _RATE_STEP_S)
    if p[:, schedule.CG_RATE : schedule.TOTAL_MASS].any():  # the rates may be switched off
        before = (ends[1] - ends[0])[:, 1 : schedule.CG_RATE]
        p[:, schedule.CG_RATE : schedule.TOTAL_MASS] += ((core_1 - core_0)[:, 1:] - before) * per_s
    for k, c in enumerate(columns):
        if p[:, c + schedule.TANK_TRAVEL].any():
            before = (ends[1] - ends[0])[:, c + schedule.TANK_LENGTH : c + schedule.TANK_HINGE + 1]
            p[:, c + schedule.TANK_TRAVEL] += ((bobs_1 - bobs_0)[k, :, 1:] - before).sum(axis=1) * per_s
        p[:, c + schedule.TANK_MASS_RATE] *= slosh_mass[:, k]
        p[:, c + schedule.TANK_MASS : c + schedule.TANK_HINGE + 1] = bobs[k]
    p[:, schedule.TOTAL_MASS] = p[:, schedule.TOTAL_MASS] * mass + mass_kg
    p[:, schedule.MASS_FLOW] *= mass
    p[:, : schedule.CG_RATE] = core


def _deviate_engines(held: HeldStage, thrust: Array, mass_flow: Array) -> None:
    """Scale thrust and mass flow of each engine (vehicles, engines), and the rates of the masses, in place.

    Equal engines share one entry of the record, with the mean of their factors.
    """
    if (thrust == 1.0).all() and (mass_flow == 1.0).all():
        return
    engine, p, rates = held.vehicle["engine"], held.properties, []
    parts, taken_as = engine["parts"][0], engine["taken_as"][0]
    for k in range(int(held.sizes.engines)):
        mine = [j for j in range(thrust.shape[1]) if parts[j] > 0.0 and taken_as[j] == k]
        vacuum = float(p[0, int(schedule.thrust_column(held.sizes, int(engine["curve"][0, k])))])
        rates += [(vacuum, mass_flow[:, j]) for j in mine]
        engine["thrust_factor"][:, k] *= (thrust * mass_flow)[:, mine].mean(axis=1)
        engine["flow_weight"][:, k] *= mass_flow[:, mine].mean(axis=1)
    whole = sum(vacuum for vacuum, _ in rates)
    pace = sum((vacuum * flow for vacuum, flow in rates), np.zeros(len(p))) / whole if whole > 0.0 else mass_flow[:, 0]
    p[:, schedule.CG_RATE : schedule.TOTAL_MASS] *= pace[:, None]
    p[:, schedule.MASS_FLOW] *= pace
    for k in range(len(held.swing_rad)):
        column = schedule.tank_column(k)
        p[:, [column + schedule.TANK_MASS_RATE, column + schedule.TANK_TRAVEL]] *= pace[:, None]


def disperse_instruments(instruments: Instruments, by: Dispersion) -> Instruments:
    """Return the instruments with the deviations of actuators, sensors and delay applied."""
    g = instruments.gyro
    count = 1 + max(group for groups in instruments.groups for group in groups)
    factors = section_factors(by, count)[..., 0]
    actuators = []
    for a, groups in zip(instruments.actuators, instruments.groups, strict=True):
        values = {name: getattr(a, name) * float(factors[k, groups[0]]) for k, name in enumerate(_SECTION_FIELDS)}
        actuators.append(dataclasses.replace(a, **values))
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


_SECTION_FIELDS = (*(f"omega_{k}_radps" for k in range(1, 5)), *(f"zeta_{k}" for k in range(1, 5)))


def section_factors(by: Dispersion, groups: int, count: int = 1) -> Array:
    """Return the factors of each actuator's frequencies and damping ratios, (SECTIONS, groups, vehicles)."""
    out = _each(by.actuator_sections, SECTIONS * groups, "actuator_sections", count)
    out = out.reshape(groups, SECTIONS, count).transpose(1, 0, 2).copy()
    out[:3] *= _each(by.actuator_frequency, groups, "actuator_frequency", count)
    out[4:7] *= np.asarray(by.actuator_damping, float)
    return out


def unlike_drives(by: Dispersion) -> bool:
    """Return True if the actuators of the vehicle's engine groups deviate from each other."""
    sections = np.asarray(by.actuator_sections, float)
    apart = sections.ndim > 0 and bool(np.ptp(sections.reshape(-1, SECTIONS), axis=0).any())
    return apart or (np.size(by.actuator_frequency) > 1 and bool(np.ptp(np.asarray(by.actuator_frequency)) > 0.0))


def _each(factors: Factors | Array, parts: int, name: str, count: int = 1) -> Array:
    """Return the factors of each part, (parts, vehicles). Raises ValueError for more factors than parts."""
    given = np.asarray(factors, float)
    if given.ndim == 0:
        return np.full((parts, count), float(given))
    given = given.reshape(len(given), -1) if given.ndim > 1 or count == 1 else np.repeat(given[None], parts, axis=0)
    if len(given) > parts:
        raise ValueError(f"{name} has {len(given)} factors: allowed are {parts}, or one number for all")
    given = np.concatenate([given, np.ones((parts - len(given), given.shape[1]))])
    return np.array(np.broadcast_to(given, (parts, count)))
