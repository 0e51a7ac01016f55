"""The rate gyro of three axes: errors, second-order dynamics (Lee, Ahn & Roh eq. 29), and the angle to be counted.

The gyro is mounted on the bent body and measures the local angular rate (docs/model.md, section 2). It is q + sum(slope
nu_pitch) in pitch and r - sum(slope nu_yaw) in yaw.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, NamedTuple

from maxq.control.kernel.jit import kernel
from maxq.control.kernel.records import Array
from maxq.control.kernel.rows import DEG, PitchYaw, RollPitchYaw
from maxq.control.kernel.vectors import Vector
from maxq.sim.vehicle.block import W_BI_B, StateBlock
from maxq.sim.vehicle.faults import ANY_FAULT, GYRO_ADDED, GYRO_LOST

if TYPE_CHECKING:
    from maxq.sim.vehicle.sensor.section import GyroSection

_AXES = ("roll", "pitch", "yaw")
GYROS = StateBlock({"gyro_{}_radps": "rad/s", "gyro_{}_rate_radps2": "rad/s2"}, parts=_AXES)
GYRO_ANGLES = StateBlock({"gyro_{}_rad": "rad"}, parts=_AXES)  # integral of the output since the last sample
GYRO_STREAM = 16  # streams of the noise generator: one sequence per axis, 16 to 18


@dataclass(frozen=True)
class Gyro:
    station_m: float
    omega_radps: float
    zeta: float
    bias_x_radps: float
    bias_y_radps: float
    bias_z_radps: float
    scale_x: float  # relative error
    scale_y: float
    scale_z: float
    misalignment_x_rad: float  # small rotation of the sensor axes about x, y, z of B
    misalignment_y_rad: float
    misalignment_z_rad: float
    random_walk_rad_rts: float  # angle random walk, rad / sqrt(s)
    ideal: int


def pack_gyro(given: GyroSection | None, ideal: bool) -> Gyro:
    """Return the parameters from the stage's section `gyro`; None (no gyro in the vehicle) gives an ideal gyro."""
    if given is None or ideal:
        station_m = given.station_m if given else 0.0
        return Gyro(station_m, 1.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1)
    bias = [math.radians(1.0) / 3600.0 * each for each in given.bias_degph]
    scale, misalignment = given.scale_factor, [math.radians(each) for each in given.misalignment_deg]
    return Gyro(
        station_m=given.station_m,
        omega_radps=2.0 * math.pi * given.omega_hz,
        zeta=given.zeta,
        bias_x_radps=bias[0],
        bias_y_radps=bias[1],
        bias_z_radps=bias[2],
        scale_x=scale[0],
        scale_y=scale[1],
        scale_z=scale[2],
        misalignment_x_rad=misalignment[0],
        misalignment_y_rad=misalignment[1],
        misalignment_z_rad=misalignment[2],
        random_walk_rad_rts=math.radians(given.noise_deg_rt_h) / 60.0,
        ideal=0,
    )


@kernel
def sensed_rate(g: Gyro, rate: Vector) -> Vector:
    """Return the steady-state output, rad/s, for the local angular rate in B: misalignment, scale factor, bias."""
    x, y, z = rate
    a, b, c = g.misalignment_x_rad, g.misalignment_y_rad, g.misalignment_z_rad
    return (
        (1.0 + g.scale_x) * (x + c * y - b * z) + g.bias_x_radps,
        (1.0 + g.scale_y) * (y - c * x + a * z) + g.bias_y_radps,
        (1.0 + g.scale_z) * (z + b * x - a * y) + g.bias_z_radps,
    )


@kernel
def after_fault(faults: Array, lost: int, output: float) -> float:
    """Return the output of a sensor's axis under faults, rad/s or m/s2.

    `output`: output of the healthy sensor. `lost`: first slot of its faults.
    """
    if faults[ANY_FAULT] == 0.0:
        return output
    faulty: float = (1.0 - faults[lost]) * output + faults[lost + GYRO_ADDED - GYRO_LOST]
    return faulty


@kernel
def outputs_after_fault(faults: Array, lost: int, y: Array, first: int) -> Vector:
    """Return the three outputs of a sensor under faults; its states begin at y[first] and its slots at `lost`."""
    return (
        after_fault(faults, lost, y[first]),
        after_fault(faults, lost + 1, y[first + 2]),
        after_fault(faults, lost + 2, y[first + 4]),
    )


@kernel
def gyro_derivative(g: Gyro, y: Array, first: int, sensed: Vector, faults: Array, dy: Array) -> None:
    """Write the derivatives of the gyro states (two per axis, from y[first] on) and of the angle integrals."""
    for axis in range(3):
        output = lagged(g, y, first + 2 * axis, sensed[axis], dy)
        dy[first + 6 + axis] = output if g.ideal == 1 else after_fault(faults, GYRO_LOST + axis, output)


@kernel
def lagged(g: Gyro, y: Array, i: int, sensed: float, dy: Array) -> float:
    """Write the derivatives of the two states of one axis, from y[i] on, and return its output."""
    if g.ideal == 1:
        dy[i], dy[i + 1] = 0.0, 0.0
        return sensed
    dy[i] = y[i + 1]
    dy[i + 1] = g.omega_radps * g.omega_radps * (sensed - y[i]) - 2.0 * g.zeta * g.omega_radps * y[i + 1]
    output: float = y[i]
    return output


@kernel
def gyro_start(y: Array, first: int, rate: Vector) -> None:
    """Set the states to the steady state at the angular rate of the body (B, rad/s), without errors.

    The angle integrals are not changed.
    """
    for axis in range(3):
        y[first + 2 * axis] = rate[axis]


class GyroRow(NamedTuple):
    gyro_axis_rate_degps: Annotated[RollPitchYaw, "deg/s", "gyro output"]
    body_axis_rate_degps: Annotated[RollPitchYaw, "deg/s", "true body rate"]
    bending_axis_rate_degps: Annotated[PitchYaw, "deg/s", "rotation rate by bending at the gyro"]


@kernel
def gyro_row(y: Array, first: int, faults: Array, bending_radps: Array) -> GyroRow:
    roll, pitch, yaw = outputs_after_fault(faults, GYRO_LOST, y, first)
    return GyroRow(
        gyro_axis_rate_degps=RollPitchYaw(DEG * roll, DEG * pitch, DEG * yaw),
        body_axis_rate_degps=RollPitchYaw(DEG * y[W_BI_B], DEG * y[W_BI_B + 1], DEG * y[W_BI_B + 2]),
        bending_axis_rate_degps=PitchYaw(DEG * bending_radps[0], DEG * bending_radps[1]),
    )
