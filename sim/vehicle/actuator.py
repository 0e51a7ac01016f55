"""Thrust-vector actuator of one axis: the paper's sixth-order transfer function (28) in state space, with limits.

    delta / command = H1 H2 H3,   H_i = w_i^2 / (s^2 + 2 z_i w_i s + w_i^2) for i = 1, 2,
    H3 = (w_3^2 / w_4^2) (s^2 + 2 z_4 w_4 s + w_4^2) / (s^2 + 2 z_3 w_3 s + w_3^2)

H1 is the servo: position error -> rate command -> rate. Written as a loop, the rate *command* saturates and so does
the rate, with no wind-up; in its linear range the loop is H1 exactly. The position command is limited before it.
H2 and H3 follow as linear sections: their resonances may carry the engine slightly past both limits.
States: servo position, servo rate; H2 position, rate; w_3^2-scaled states of H3 and its rate.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated, Any, NamedTuple

from maxq.control.kernel.jit import kernel
from maxq.control.kernel.records import Array
from maxq.control.kernel.rows import DEG, PitchYaw
from maxq.sim.vehicle.block import StateBlock
from maxq.sim.vehicle.workspace import ENGINE_PITCH, ENGINE_YAW

ACTUATORS = StateBlock(
    {f"actuator_{{}}_{k}": "rad" if k % 2 else "rad/s" for k in range(1, 7)},  # positions and rates
    parts=("pitch", "yaw"),
)


@dataclass(frozen=True)
class Actuator:
    """`omega_radps` and zeta of the sections 1, 2, 3 (pole), 4 (zero); limits in rad and rad/s."""

    omega_1_radps: float
    omega_2_radps: float
    omega_3_radps: float
    omega_4_radps: float
    zeta_1: float
    zeta_2: float
    zeta_3: float
    zeta_4: float
    angle_limit_rad: float
    rate_limit_radps: float
    bias_rad: float
    backlash_rad: float
    ideal: int  # 1: the angle is the command, at rest between commands


def pack_actuators(given: Any, kind: str) -> tuple[Actuator, Actuator]:
    """Pitch and yaw from the stage's section `actuator` (or None) and the scenario's switch of that name."""
    bias_deg = given.bias_deg if given else (0.0, 0.0)
    if given is None or kind == "ideal":
        pitch, yaw = (
            Actuator(1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, math.inf, math.inf, math.radians(bias), 0.0, 1)
            for bias in bias_deg
        )
    else:
        axes = zip(given.axes, bias_deg, strict=True)
        pitch, yaw = (_pack_axis(axis, bias, kind == "linear") for axis, bias in axes)
    return pitch, yaw


def _pack_axis(given: Any, bias_deg: float, linear: bool) -> Actuator:
    omega, zeta = [2.0 * math.pi * f for f in given.omega_hz], list(given.zeta)
    if given.exchange_a3_a4:
        omega[2], omega[3], zeta[2], zeta[3] = omega[3], omega[2], zeta[3], zeta[2]
    return Actuator(
        omega_1_radps=omega[0],
        omega_2_radps=omega[1],
        omega_3_radps=omega[2],
        omega_4_radps=omega[3],
        zeta_1=zeta[0],
        zeta_2=zeta[1],
        zeta_3=zeta[2],
        zeta_4=zeta[3],
        angle_limit_rad=math.inf if linear else math.radians(given.angle_limit_deg),
        rate_limit_radps=math.inf if linear else math.radians(given.rate_limit_degps),
        bias_rad=math.radians(bias_deg),
        backlash_rad=0.0 if linear else math.radians(given.backlash_deg),
        ideal=0,
    )


@kernel
def actuator_output(a: Actuator, y: Array, i: int, command: float) -> tuple[float, float, float]:
    """Engine angle, rate and acceleration (rad, rad/s, rad/s2) from the states at y[i:i+6].

    Three orders of differentiation lie between command and angle at least, so that all three are functions of the
    state and no derivative of the command is needed.
    """
    if a.ideal == 1:
        return command + a.bias_rad, 0.0, 0.0
    w2, w3, w4 = a.omega_2_radps, a.omega_3_radps, a.omega_4_radps
    x, x_rate, z, z_rate = y[i + 2], y[i + 3], y[i + 4], y[i + 5]
    x_accel = w2 * w2 * (y[i] - x) - 2.0 * a.zeta_2 * w2 * x_rate
    damp_3, damp_4 = 2.0 * a.zeta_3 * w3, 2.0 * a.zeta_4 * w4
    z_2 = w3 * w3 * (x - z) - damp_3 * z_rate
    z_3 = w3 * w3 * (x_rate - z_rate) - damp_3 * z_2
    z_4 = w3 * w3 * (x_accel - z_2) - damp_3 * z_3
    k = 1.0 / (w4 * w4)
    angle = k * (z_2 + damp_4 * z_rate) + z + a.bias_rad
    rate = k * (z_3 + damp_4 * z_2) + z_rate
    accel = k * (z_4 + damp_4 * z_3) + z_2
    return angle, rate, accel


@kernel
def actuator_derivative(a: Actuator, y: Array, i: int, command: float, dy: Array) -> None:
    """Time derivative of the states at y[i:i+6] under a held command (rad)."""
    if a.ideal == 1:
        for j in range(6):
            dy[i + j] = 0.0
        return
    w1, w2, w3 = a.omega_1_radps, a.omega_2_radps, a.omega_3_radps
    target = min(max(command, -a.angle_limit_rad), a.angle_limit_rad)
    damp_1 = 2.0 * a.zeta_1 * w1
    rate_command = w1 * w1 / damp_1 * (target - y[i])
    rate_command = min(max(rate_command, -a.rate_limit_radps), a.rate_limit_radps)
    dy[i] = y[i + 1]
    dy[i + 1] = damp_1 * (rate_command - y[i + 1])
    dy[i + 2] = y[i + 3]
    dy[i + 3] = w2 * w2 * (y[i] - y[i + 2]) - 2.0 * a.zeta_2 * w2 * y[i + 3]
    dy[i + 4] = y[i + 5]
    dy[i + 5] = w3 * w3 * (y[i + 2] - y[i + 4]) - 2.0 * a.zeta_3 * w3 * y[i + 5]


@kernel
def after_backlash(a: Actuator, played: float, command: float) -> float:
    """Command that reaches the servo through a play of `backlash_rad` (total), given what reached it before."""
    half = 0.5 * a.backlash_rad
    return min(max(played, command - half), command + half)


class ActuatorRow(NamedTuple):
    gimbal_axis_command_deg: Annotated[PitchYaw, "deg", "command to the actuator"]
    gimbal_axis_angle_deg: Annotated[PitchYaw, "deg", "engine angle"]
    gimbal_axis_rate_degps: Annotated[PitchYaw, "deg/s", "engine rate"]
    gimbal_axis_accel_degps2: Annotated[PitchYaw, "deg/s2", "engine acceleration"]


@kernel
def actuator_row(command_pitch_rad: float, command_yaw_rad: float, aux: Array) -> ActuatorRow:
    return ActuatorRow(
        gimbal_axis_command_deg=PitchYaw(DEG * command_pitch_rad, DEG * command_yaw_rad),
        gimbal_axis_angle_deg=PitchYaw(DEG * aux[ENGINE_PITCH], DEG * aux[ENGINE_YAW]),
        gimbal_axis_rate_degps=PitchYaw(DEG * aux[ENGINE_PITCH + 1], DEG * aux[ENGINE_YAW + 1]),
        gimbal_axis_accel_degps2=PitchYaw(DEG * aux[ENGINE_PITCH + 2], DEG * aux[ENGINE_YAW + 2]),
    )
