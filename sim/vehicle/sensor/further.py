"""Sensors after the first gyro: rate gyros and accelerometers, triads at their own stations on the bent body.

A rate gyro is modelled as the first gyro (gyro.py). An accelerometer measures the specific force at its place, in its
own axes, which rotate with the bent body (docs/model.md, section 2):

    f = a_C + alpha x rho + w x (w x rho) + 2 w x d' + d'',    f_sensor = f - theta x f,

where a_C is the specific force of the body at the core CG. The vector rho leads from this CG to the displaced sensor; d
is the sensor's displacement by bending, and theta its rotation. Engines and liquid act through a_C, alpha and the modal
accelerations, which include their reactions. Both kinds of sensor have errors and second-order dynamics, and the
computer counts the integral of their output over a sample.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

from maxq.control.kernel.jit import kernel, routine
from maxq.control.kernel.limits import MAX_SENSORS
from maxq.control.kernel.records import Array
from maxq.control.kernel.rows import DEG, RollPitchYaw, Xyz
from maxq.control.kernel.vectors import Vector, add, cross, scaled, vector_at
from maxq.sim.vehicle.block import Counts, StateBlock
from maxq.sim.vehicle.faults import SENSOR_FAULT, SENSOR_SLOTS
from maxq.sim.vehicle.modes.planar import Modes, motion_at, of_plane
from maxq.sim.vehicle.modes.spatial import roll_defect, spatial_motion
from maxq.sim.vehicle.schedule import CORE_CG, PITCH, YAW, gimbal_place
from maxq.sim.vehicle.sensor.gyro import Gyro, after_fault, lagged, outputs_after_fault, pack_gyro, sensed_rate

if TYPE_CHECKING:
    from maxq.sim.scenario.schema_vehicle import Stage

SENSORS = StateBlock(
    {
        **{f"sensor_{{}}_{axis}{rate}": "" for axis in "xyz" for rate in ("", "_rate")},
        **{f"sensor_{{}}_{axis}_integral": "" for axis in "xyz"},
    },
    "sensors",
)
SENSOR_STREAM = 32  # streams of the noise generator: four sequences per sensor, for three axes and dropouts
RATE_GYRO, ACCELEROMETER = 0, 1  # kinds
_ROOT_HOUR = 60.0


@dataclass(frozen=True)
class Sensor:
    """A sensor after the first gyro.

    `triad`: errors and dynamics; the bias of an accelerometer is in m/s2, its noise in (m/s)/sqrt(s). `dropout`:
    probability that a sample does not reach the computer.
    """

    kind: int
    station_m: float
    dropout: float
    triad: Gyro


def pack_sensors(stage: Stage, ideal: bool) -> tuple[Sensor, ...]:
    """Return the sensors of a stage: its rate gyros, then its accelerometers, padded with unused sensors."""
    none = Sensor(RATE_GYRO, 0.0, 0.0, pack_gyro(None, ideal=True))
    out = [Sensor(RATE_GYRO, each.station_m, each.dropout, pack_gyro(each, ideal)) for each in stage.rate_gyro]
    for given in stage.accelerometers:
        turned = [math.radians(angle) for angle in given.misalignment_deg]
        errors: tuple[Any, ...] = (*given.bias_mps2, *given.scale_factor, *turned, given.noise_mps_rt_h / _ROOT_HOUR)
        triad = Gyro(*(given.station_m, 2.0 * math.pi * given.omega_hz, given.zeta, *errors, 0))
        triad = replace(pack_gyro(None, ideal=True), station_m=given.station_m) if ideal else triad
        out.append(Sensor(ACCELEROMETER, given.station_m, given.dropout, triad))
    return (*out, *[none] * (MAX_SENSORS - len(out)))


@routine
def sense(
    sensors: Any,
    sizes: Counts,
    rate: Vector,
    specific_force: Vector,
    alpha: Vector,
    properties: Array,
    faults: Array,
    y: Array,
    first: int,
    dy: Array,
    modes: Modes,
) -> None:
    """Write the derivatives of the sensors' states, from y[first] on, once all accelerations are known."""
    for k in range(sizes.sensors):
        sensor, i, place = sensors[k], first + 9 * k, sizes.gimbals - sizes.sensors + k
        if sensor.kind == ACCELEROMETER:
            motion = force_at(sizes, place, sensor.station_m, rate, specific_force, alpha, properties, modes)
        else:
            motion = rate_at(sizes, place, rate, properties, modes)
        sensed = sensed_rate(sensor.triad, motion)
        for axis in range(3):
            output = lagged(sensor.triad, y, i + 2 * axis, sensed[axis], dy)
            dy[i + 6 + axis] = after_fault(faults, sensor_slots(k) + axis, output)


@kernel
def sensor_slots(k: int) -> int:
    """Return the first fault slot of sensor k."""
    return SENSOR_FAULT + SENSOR_SLOTS * k


@kernel
def rate_at(sizes: Counts, place: int, rate: Vector, properties: Array, modes: Modes) -> Vector:
    """Return the angular rate of the bent body at a sensor, B, rad/s."""
    _, _, about_y, about_z = motion_at(sizes, properties, place, modes.planar.nu_mps, of_plane(PITCH), of_plane(YAW))
    turned = (rate[0], rate[1] + about_y, rate[2] + about_z)
    if sizes.spatial_modes > 0:
        there, spatial = gimbal_place(sizes, place), modes.spatial
        of_modes = spatial_motion(sizes, properties, there, spatial.nu_mps)
        more = roll_defect(sizes, properties, there, spatial.eta_m, spatial.turned_m)
        bent = (of_modes[3] + rate[0] * more[3], of_modes[4] + rate[0] * more[4], of_modes[5] + rate[0] * more[5])
        turned = add(turned, bent)
    return turned


@kernel
def force_at(
    sizes: Counts,
    place: int,
    station_m: float,
    rate: Vector,
    specific_force: Vector,
    alpha: Vector,
    properties: Array,
    modes: Modes,
) -> Vector:
    """Return the specific force at a sensor, in axes that rotate with the bent body, m/s2.

    With nu = d(eta)/dt + p A eta, the second derivative of eta is nu' - p' A eta - p A d(eta)/dt.
    """
    pitch, yaw, p, p_dot = of_plane(PITCH), of_plane(YAW), rate[0], alpha[0]
    planar, spatial = modes.planar, modes.spatial
    moved_y, moved_z, about_y, about_z = motion_at(sizes, properties, place, planar.eta_m, pitch, yaw)
    speed_y, speed_z, _, _ = motion_at(sizes, properties, place, planar.rate_mps, pitch, yaw)
    accel_y, accel_z, _, _ = motion_at(sizes, properties, place, planar.accel_mps2, pitch, yaw)
    # A eta: the 90 deg rotation of a mode in pitch is a mode in yaw.
    turned_y, turned_z, _, _ = motion_at(sizes, properties, place, planar.eta_m, yaw, pitch)
    turning_y, turning_z, _, _ = motion_at(sizes, properties, place, planar.rate_mps, yaw, pitch)
    moved, speed, tilt = (0.0, moved_y, moved_z), (0.0, speed_y, speed_z), (0.0, about_y, about_z)
    accel = (0.0, accel_y + p_dot * turned_y + p * turning_y, accel_z - p_dot * turned_z - p * turning_z)
    if sizes.spatial_modes > 0:
        there = gimbal_place(sizes, place)
        at = spatial_motion(sizes, properties, there, spatial.eta_m)
        moves = spatial_motion(sizes, properties, there, spatial.rate_mps)
        gains = spatial_motion(sizes, properties, there, spatial.accel_mps2)
        turned = spatial_motion(sizes, properties, there, spatial.turned_m)
        turns = spatial_motion(sizes, properties, there, spatial.turned_rate_mps)
        moved, speed = add(moved, (at[0], at[1], at[2])), add(speed, (moves[0], moves[1], moves[2]))
        tilt = add(tilt, (at[3], at[4], at[5]))
        accel = add(accel, (gains[0], gains[1], gains[2]))
        accel = add(accel, scaled(-p_dot, (turned[0], turned[1], turned[2])))
        accel = add(accel, scaled(-p, (turns[0], turns[1], turns[2])))
    cg = vector_at(properties, CORE_CG)
    rho = (cg[0] - station_m + moved[0], moved[1] - cg[1], moved[2] - cg[2])
    force = add(add(specific_force, cross(alpha, rho)), cross(rate, cross(rate, rho)))
    force = add(add(force, scaled(2.0, cross(rate, speed))), accel)
    return add(force, scaled(-1.0, cross(tilt, force)))


class RateGyroRow(NamedTuple):
    """The logged values of a rate gyro after the first."""

    gyro_number_axis_rate_degps: Annotated[RollPitchYaw, "deg/s", "output of the gyro"]
    gyro_number_axis_counted_degps: Annotated[RollPitchYaw, "deg/s", "computer input: mean over a sample"]


class AccelerometerRow(NamedTuple):
    """The log row of the first accelerometer."""

    accelerometer_axis_mps2: Annotated[Xyz, "m/s2", "output of the accelerometer: specific force at its station"]
    accelerometer_axis_counted_mps2: Annotated[Xyz, "m/s2", "computer input: mean over a sample"]


class FurtherAccelerometerRow(NamedTuple):
    """The log row of an accelerometer after the first."""

    accelerometer_number_axis_mps2: Annotated[Xyz, "m/s2", "output of the accelerometer"]
    accelerometer_number_axis_counted_mps2: Annotated[Xyz, "m/s2", "computer input: mean over a sample"]


@kernel
def rate_gyro_row(faults: Array, k: int, y: Array, first: int, counted: Vector) -> RateGyroRow:
    roll, pitch, yaw = outputs_after_fault(faults, sensor_slots(k), y, first)
    return RateGyroRow(
        gyro_number_axis_rate_degps=RollPitchYaw(DEG * roll, DEG * pitch, DEG * yaw),
        gyro_number_axis_counted_degps=RollPitchYaw(DEG * counted[0], DEG * counted[1], DEG * counted[2]),
    )


@kernel
def accelerometer_row(faults: Array, k: int, y: Array, first: int, counted: Vector) -> AccelerometerRow:
    along, right, down = outputs_after_fault(faults, sensor_slots(k), y, first)
    return AccelerometerRow(
        accelerometer_axis_mps2=Xyz(along, right, down),
        accelerometer_axis_counted_mps2=Xyz(counted[0], counted[1], counted[2]),
    )


@kernel
def further_accelerometer_row(faults: Array, k: int, y: Array, first: int, counted: Vector) -> FurtherAccelerometerRow:
    row = accelerometer_row(faults, k, y, first, counted)
    return FurtherAccelerometerRow(row.accelerometer_axis_mps2, row.accelerometer_axis_counted_mps2)
