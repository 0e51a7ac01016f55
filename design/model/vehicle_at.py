"""The properties of a held stage (masses, modes, pendulums, derivatives), and stages with parts removed."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np

from maxq.control.kernel.records import Array
from maxq.design.model.held import Drives, FlightCondition, HeldStage, Trim
from maxq.design.model.instruments import ACCELERATION, Plane, sensed
from maxq.sim.vehicle import schedule
from maxq.sim.vehicle.air import kernel as aero


@dataclass(frozen=True)
class Pendulums:
    """The slosh modes, tank by tank, as arrays (pendulums,)."""

    mass_kg: Array
    length_m: Array
    hinge_station_m: Array
    damping_ratio: Array
    viscous: Array  # damping by a smooth wall times the fourth root of the axial load, (m/s2)^(1/4)
    ring: Array  # damping by ring baffles per root of the swing, rad^(-1/2)
    swing_rad: Array  # swing in a flight (node.with_swings), or 0 without a flight

    def small_wave_damping(self, load_mps2: float) -> Array:
        """Return the damping ratio for small waves, where baffles have no effect, under an axial load."""
        return np.asarray(self.damping_ratio + self.viscous * np.maximum(load_mps2, 1e-9) ** -0.25)

    def damping(self, load_mps2: float) -> Array:
        """Return the damping ratio for the amplitude `swing_rad`.

        The damping of rings is their describing function (docs/model.md, 5.9).
        """
        return np.asarray(self.small_wave_damping(load_mps2) + self.ring * np.sqrt(self.swing_rad))

    @property
    def bob_station_m(self) -> Array:
        return np.asarray(self.hinge_station_m + self.length_m)


@dataclass(frozen=True)
class VehicleAt:
    """The properties of a stage at one instant, in one plane.

    Stations are in m aft of the nose. CG and inertia are those with frozen liquid.
    """

    total_mass_kg: float
    total_cg_station_m: float
    total_inertia_kgm2: float  # about y (pitch) or z (yaw)
    core_inertia_kgm2: float  # about the core's CG, without the sloshing masses
    omega_radps: Array  # of the modes, spatial modes first
    damping_ratio: Array
    pendulums: Pendulums
    sensors: tuple[tuple[str, float], ...] = ()  # further sensors: name of the measurement and station, m
    cut_stations_m: tuple[float, ...] = ()  # stations of active section loads


def vehicle_at(held: HeldStage, plane: Plane) -> VehicleAt:
    """Return the properties of the first vehicle of a held stage."""
    p, vehicle, sizes = held.properties[0], held.parameters[0].vehicle, held.sizes
    _, cg, inertia = total_of(held)
    pitch = plane == "pitch"
    n, s = int(sizes.pitch_modes if pitch else sizes.yaw_modes), int(sizes.spatial_modes)
    first = int(schedule.mode_column(sizes, int(not pitch), schedule.MODE_OMEGA))
    spatial = int(schedule.spatial_column(sizes, schedule.SPATIAL_OMEGA))
    omega = [vehicle.spatial_modes.frequency_factor[:s] * p[spatial : spatial + s]]
    omega.append(vehicle.bending.frequency_factor[:n] * p[first : first + n])
    zeta = vehicle.bending.zeta_pitch if pitch else vehicle.bending.zeta_yaw
    sensors = vehicle.sensors[: int(sizes.sensors)]
    return VehicleAt(
        total_mass_kg=float(p[schedule.TOTAL_MASS]),
        total_cg_station_m=float(cg[0]),
        total_inertia_kgm2=float(inertia[0, int(not pitch)]),
        core_inertia_kgm2=float(p[schedule.CORE_INERTIA + (1 if pitch else 2)]),
        omega_radps=np.concatenate(omega),
        damping_ratio=np.concatenate([vehicle.spatial_modes.zeta[:s], zeta[:n]]),
        pendulums=pendulums_of(held),
        sensors=tuple(zip(sensed(sensors), (float(each.station_m) for each in sensors), strict=True)),
        cut_stations_m=tuple(held.parameters[0].loads.station_m[: int(held.parameters[0].loads.stations)].tolist()),
    )


def pendulums_of(held: HeldStage) -> Pendulums:
    """Return the pendulums of the first vehicle of a held stage."""
    slosh, n = held.vehicle["slosh"], len(held.swing_rad)
    return Pendulums(
        mass_kg=held.tank(schedule.TANK_MASS)[0],
        length_m=held.tank(schedule.TANK_LENGTH)[0],
        hinge_station_m=held.tank(schedule.TANK_HINGE)[0],
        damping_ratio=slosh["damping_ratio"][0, :n].copy(),
        viscous=slosh["law_factor"][0, :n] * held.tank(schedule.TANK_VISCOUS)[0],
        ring=held.rings[0],
        swing_rad=held.swing_rad,
    )


def total_of(held: HeldStage) -> tuple[Array, Array, Array]:
    """Return mass (vehicles,), CG station (vehicles,) and inertia about y and z (vehicles, 2), with frozen liquid."""
    p = held.properties
    core, station = p[:, schedule.CORE_MASS], p[:, schedule.CORE_CG]
    mass, bob = held.tank(schedule.TANK_MASS), held.tank(schedule.TANK_HINGE) + held.tank(schedule.TANK_LENGTH)
    total = core + mass.sum(axis=1)
    cg = (core * station + (mass * bob).sum(axis=1)) / total
    added = core * (station - cg) ** 2 + (mass * (bob - cg[:, None]) ** 2).sum(axis=1)
    slosh, n = held.vehicle["slosh"], len(held.swing_rad)  # tanks of boosters are off the axis
    added_by_place = [(mass * slosh[f"place_{axis}_m"][:, :n] ** 2).sum(axis=1) for axis in "zy"]
    own = p[:, schedule.CORE_INERTIA + 1 : schedule.CORE_INERTIA + 3]
    return total, cg, own + (added[:, None] + np.stack(added_by_place, axis=1))


def axial_load_mps2(held: HeldStage, condition: FlightCondition, trim: Trim) -> float:
    """Return the axial specific force on modes and pendulums of the first vehicle, (thrust - drag) / mass.

    Between the rows of the tables, the total mass differs slightly from the sum of core and bobs.
    """
    one = dataclasses.replace(held, parameters=held.parameters[:1], properties=held.properties[:1])
    one, y = one.without_sections().copied().prepared(dataclasses.replace(condition, gravity_mps2=0.0), trim)
    rate, _ = one.differentiated(y, np.zeros(0, np.int64), np.zeros(0), np.zeros(0, np.int64))
    forward = float(rate[0, list(held.coordinates).index("u_mps")])
    return forward * float(total_of(one)[0][0] / one.properties[0, schedule.TOTAL_MASS])


# --- with parts absent
def without_bending(held: HeldStage) -> HeldStage:
    """Return a stage whose modes are decoupled from all other motion."""
    held, sizes = held.without_sections().copied(), held.sizes
    for plane in (schedule.PITCH, schedule.YAW):
        first = int(schedule.mode_column(sizes, plane, schedule.MODE_PHI_GIMBAL))
        held.properties[:, first : int(schedule.mode_column(sizes, plane + 1, 0))] = 0.0
    first = int(schedule.spatial_column(sizes, schedule.SPATIAL_FIRST))
    last = int(schedule.spatial_column(sizes, schedule.turning_row(sizes, int(sizes.spatial_modes))))
    held.properties[:, first:last] = 0.0
    return held


def without_engine_inertia(held: HeldStage) -> HeldStage:
    """Return a stage whose engines have no mass and follow their actuators."""
    held = held.copied()
    engine = held.vehicle["engine"]
    engine["gimballed_mass_kg"], engine["inertia_kgm2"], engine["swings"] = 0.0, 0.0, -1
    held.vehicle["sizes"]["tvc_loads"] = 0
    return held


def with_frozen_liquid(held: HeldStage) -> HeldStage:
    """Return a stage whose bobs are fixed to the core."""
    mass, cg, inertia = total_of(held)
    held = held.copied()
    p = held.properties
    p[:, schedule.CORE_MASS], p[:, schedule.CORE_CG] = mass, cg
    p[:, schedule.CORE_INERTIA + 1 : schedule.CORE_INERTIA + 3] = inertia
    for k in range(len(held.swing_rad)):
        column = schedule.tank_column(k)
        p[:, column + schedule.TANK_MASS], p[:, column + schedule.TANK_MASS_RATE] = 0.0, 0.0
    return held


def without_lateral_air(held: HeldStage) -> HeldStage:
    """Return a stage on which the air exerts axial forces only."""
    held = held.copied()
    aerodynamics = held.vehicle["aero"]
    aerodynamics["force_factor"], aerodynamics["damping_factor"] = 0.0, 0.0
    table = held.parameters[0].vehicle.aero.table
    first, intervals, columns = int(table.offset) + int(table.n_breaks), int(table.n_breaks) - 1, int(table.n_columns)
    pool = held.pool.copy()
    if columns > aero.CD:  # at zero angle of attack, drag is an axial force; a vehicle without air has no columns
        rows = pool[first : first + intervals * 4 * columns].reshape(-1, columns)
        rows[:, aero.CA] += rows[:, aero.CD]
        rows[:, aero.CD] = 0.0
    return dataclasses.replace(held, pool=pool)


# --- derivatives
@dataclass(frozen=True)
class StabilityDerivatives:
    """The coefficients of alpha' = Z and q' = M, as defined in the paper (4 to 8).

    They apply to the rigid body with its whole mass and frozen liquid. Z_alpha and M_alpha are negative for a
    statically stable vehicle with lift.
    """

    z_alpha_1ps: float  # (4), including the drag along the wind
    m_alpha_1ps2: float  # (6)
    z_delta_1ps: float  # (5)
    m_delta_1ps2: float  # (8), without the axial load of the engine's mass (erratum 8: +0.2 to 0.4 %)
    m_q_1ps: float  # (7), aerodynamic


def stability_derivatives(
    held: HeldStage, condition: FlightCondition, trim: Trim, plane: Plane, drives: Drives
) -> StabilityDerivatives:
    """Return the stability derivatives at a flight condition.

    Raises ValueError for zero airspeed, since eqs 4 and 5 divide by it.
    """
    if condition.airspeed_mps <= 0.0:
        raise ValueError("stability derivatives are defined for positive airspeed only")
    rigid = with_frozen_liquid(without_engine_inertia(without_bending(held)))
    rigid.vehicle["jet_damping"], rigid.vehicle["rate_damping"]["n_columns"] = 0, 0
    rigid.vehicle["slosh"]["exchange"] = 0
    rigid.properties[:, schedule.CG_RATE : schedule.CG_RATE + 3] = 0.0
    a, b, _, _, (_, inputs, _) = rigid.plants(condition, trim, plane, drives)
    by_angle = sum(b[0, :2, k] for k, name in enumerate(inputs) if name.startswith("delta_rad"))
    speed = condition.airspeed_mps
    scale = float(rigid.properties[0, schedule.CORE_MASS] / rigid.properties[0, schedule.TOTAL_MASS])
    (z_w, _), (m_w, m_q) = a[0, :2, :2]
    z_delta, m_delta = np.asarray(by_angle, float)
    return StabilityDerivatives(
        z_alpha_1ps=float(z_w * scale),
        m_alpha_1ps2=float(m_w * speed),
        z_delta_1ps=float(z_delta * scale / speed),
        m_delta_1ps2=float(m_delta),
        m_q_1ps=float(m_q),
    )


def incidence_by_acceleration(
    vehicle: VehicleAt, derivatives: StabilityDerivatives, speed_mps: float
) -> tuple[float, float]:
    """Return the coefficients for an estimate of the angle of attack from accelerometer and pitch acceleration.

    They are `percussion_m` and `accel_per_incidence_mps2` of the rigid body (control/laws/load_relief.py). Raises
    ValueError without an accelerometer, without air, and without an engine that exerts a moment.
    """
    station_m = next((at for name, at in vehicle.sensors if name == ACCELERATION), None)
    d = derivatives
    if station_m is None or d.z_alpha_1ps == 0.0 or d.m_delta_1ps2 == 0.0:
        missing = "an accelerometer" if station_m is None else "air" if d.m_delta_1ps2 != 0.0 else "an engine"
        raise ValueError(f"no angle of attack can be estimated without {missing}")
    # from the CG to the centre of percussion, m forward; the accelerometer may be on either side of it
    centre_m = d.z_delta_1ps * speed_mps / d.m_delta_1ps2
    forward_m = vehicle.total_cg_station_m - station_m
    return centre_m - forward_m, d.z_alpha_1ps * speed_mps - centre_m * d.m_alpha_1ps2
