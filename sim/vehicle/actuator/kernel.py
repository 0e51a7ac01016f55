"""The thrust-vector actuator of one axis, of order two, four or six, with limits and a hard stop.

    delta / command = H1, H1 H2 or H1 H2 H3,   H_i = w_i^2 / (s^2 + 2 z_i w_i s + w_i^2) for i = 1, 2,
    H3 = (w_3^2 / w_4^2) (s^2 + 2 z_4 w_4 s + w_4^2) / (s^2 + 2 z_3 w_3 s + w_3^2)

Order six is that of Lee, Ahn & Roh (28), with the zero w_4. H1 is the servo: position error -> rate command -> rate. In
this loop the rate *command* saturates, and hence the rate, without wind-up. In its linear range the loop equals H1. The
position command is limited upstream of the servo.

The limits act on the servo or on the engine. If they act on the servo, H2 and H3 follow as linear sections, whose
resonances may carry the engine past both limits (for example 36 deg/s with a limit of 30). If they act on the engine,
H2 and H3 precede the servo, whose rate is that of the engine. Linear sections in series may be exchanged, so below the
limits both are the same actuator. A play follows all sections: the engine rests until the actuator has crossed the
play, and then takes on its rate. With a TVC load the play is a gap of the load's spring instead. A hard stop limits the
engine's own angle: the engine rests there, without rate and acceleration, as long as the sections would carry it
further. With a TVC load and a stall torque M_s, the rate limit v depends on the resisting torque M, like flow through a
fully open valve. It is v sqrt(1 - M / M_s) against the torque, and v sqrt(1 + M / M_s) with it. A larger torque drives
the actuator back at v sqrt(M / M_s - 1).

States: servo position, servo rate; H2 position, rate; w_3^2-scaled states of H3 and its rate.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, NamedTuple

from maxq.control.kernel.jit import kernel
from maxq.control.kernel.records import Array
from maxq.control.kernel.rows import DEG, PitchYaw
from maxq.sim.vehicle.block import StateBlock
from maxq.sim.vehicle.engine.kernel import GimbalMotion
from maxq.sim.vehicle.faults import ACTUATOR_ANGLE, ACTUATOR_FAULT, ANY_FAULT, FLOATING, HARD_OVER, STUCK

if TYPE_CHECKING:
    from maxq.sim.vehicle.actuator.section import ActuatorAxis, ActuatorSection

ACTUATORS = StateBlock(
    {f"actuator_{{}}_{k}": "rad" if k % 2 else "rad/s" for k in range(1, 7)},  # positions and rates
    parts=("pitch", "yaw"),
)
FURTHER_ACTUATORS = StateBlock(  # actuators of every further group: pitch, then yaw
    {f"group_{{}}_{name.format(axis)}": unit for axis in ("pitch", "yaw") for name, unit in ACTUATORS.states.items()},
    "further_groups",
)


ORDERS = {"second-order": 2, "fourth-order": 4, "sixth-order": 6}


@dataclass(frozen=True)
class Actuator:
    """The parameters of one actuator: sections 1, 2, 3 (poles) and 4 (zeros) up to its order, and its limits."""

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
    ideal: int  # 1: the angle equals the command, at rest between commands
    order: int  # 2, 4 or 6
    limits_on_engine: int  # 1: the servo with its limits is the last section
    stop_rad: float  # hard stop of the engine's own angle
    stall_torque_Nm: float = math.inf  # of one engine


def pack_actuators(given: ActuatorSection | None, kind: str) -> tuple[Actuator, Actuator]:
    """Return the pitch and yaw actuators of a stage.

    `given`: section `actuator` of the stage, or None. `kind`: value of the scenario's switch `actuator`.
    """
    bias_deg = given.bias_deg if given else (0.0, 0.0)
    if given is None or kind == "ideal":
        pitch, yaw = (
            Actuator(
                1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, math.inf, math.inf, math.radians(bias), 0.0, 1, 2, 0, math.inf
            )
            for bias in bias_deg
        )
    else:
        axes = zip(given.axes, bias_deg, strict=True)
        pitch, yaw = (_pack_axis(axis, bias, kind == "linear") for axis, bias in axes)
    return pitch, yaw


def _pack_axis(given: ActuatorAxis, bias_deg: float, linear: bool) -> Actuator:
    omega, zeta = [2.0 * math.pi * f for f in given.omega_hz], list(given.zeta)
    count = len(omega)
    omega, zeta = omega + [1.0] * (4 - count), zeta + [1.0] * (4 - count)
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
        order=ORDERS[given.model],
        limits_on_engine=int(given.limits_act_on == "engine"),
        stop_rad=math.inf if linear or given.stop_deg is None else math.radians(given.stop_deg),
        stall_torque_Nm=math.inf if linear or given.stall_torque_Nm is None else given.stall_torque_Nm,
    )


@kernel
def actuator_output(a: Actuator, y: Array, i: int, command: float, before: float) -> tuple[float, float, float]:
    """Return engine angle, rate and acceleration (rad, rad/s, rad/s2) from the states at y[i:i+6].

    `before` is the angle at the start of the step, the memory of the play. It is exact unless the actuator reverses
    within the step; in that case the error is smaller than the motion in one step. At least two integrations separate
    command and angle, so that no derivative of the command is needed.
    """
    if a.ideal == 1:
        angle, rate, accel = command, 0.0, 0.0
    elif a.limits_on_engine == 1 or a.order == 2:
        angle, rate = y[i], y[i + 1]
        accel = _servo_acceleration(a, _servo_target(a, y, i, command), angle, rate)
    elif a.order == 4:
        angle, rate = y[i + 2], y[i + 3]
        accel = _section_acceleration(a.omega_2_radps, a.zeta_2, y[i], angle, rate)
    else:
        angle, rate, accel = _third_section(a, y, i, y[i])
    angle += a.bias_rad
    if a.backlash_rad > 0.0:
        low, high = angle - 0.5 * a.backlash_rad, angle + 0.5 * a.backlash_rad
        if not ((low >= before and rate > 0.0) or (high <= before and rate < 0.0)):
            rate, accel = 0.0, 0.0
        angle = min(max(before, low), high)
    if abs(angle) > a.stop_rad:
        return math.copysign(a.stop_rad, angle), 0.0, 0.0
    return angle, rate, accel


@kernel
def _section_acceleration(omega: float, zeta: float, drive: float, x: float, x_rate: float) -> float:
    accel: float = omega * omega * (drive - x) - 2.0 * zeta * omega * x_rate
    return accel


@kernel
def _third_section(a: Actuator, y: Array, i: int, into_second: float) -> tuple[float, float, float]:
    """Return the output of H3 and its first two time derivatives; `into_second` is the input of the preceding H2."""
    w3, w4 = a.omega_3_radps, a.omega_4_radps
    x, x_rate, z, z_rate = y[i + 2], y[i + 3], y[i + 4], y[i + 5]
    x_accel = _section_acceleration(a.omega_2_radps, a.zeta_2, into_second, x, x_rate)
    damp_3, damp_4 = 2.0 * a.zeta_3 * w3, 2.0 * a.zeta_4 * w4
    z_2 = w3 * w3 * (x - z) - damp_3 * z_rate
    z_3 = w3 * w3 * (x_rate - z_rate) - damp_3 * z_2
    z_4 = w3 * w3 * (x_accel - z_2) - damp_3 * z_3
    k = 1.0 / (w4 * w4)
    return k * (z_2 + damp_4 * z_rate) + z, k * (z_3 + damp_4 * z_2) + z_rate, k * (z_4 + damp_4 * z_3) + z_2


@kernel
def _servo_target(a: Actuator, y: Array, i: int, command: float) -> float:
    """Return the position command of the servo, within its limit."""
    if a.limits_on_engine == 1 and a.order == 6:
        command = _third_section(a, y, i, command)[0]
    elif a.limits_on_engine == 1 and a.order == 4:
        command = y[i + 2]
    target: float = min(max(command, -a.angle_limit_rad), a.angle_limit_rad)
    return target


@kernel
def _servo_acceleration(a: Actuator, target: float, angle: float, rate: float) -> float:
    w1 = a.omega_1_radps
    damp_1 = 2.0 * a.zeta_1 * w1
    rate_command = w1 * w1 / damp_1 * (target - angle)
    rate_command = min(max(rate_command, -a.rate_limit_radps), a.rate_limit_radps)
    accel: float = damp_1 * (rate_command - rate)
    return accel


@kernel
def actuator_derivative(a: Actuator, y: Array, i: int, command: float, dy: Array) -> None:
    """Write the time derivative of the states at y[i:i+6] under a held command (rad)."""
    if a.ideal == 1:
        for j in range(6):
            dy[i + j] = 0.0
        return
    dy[i] = y[i + 1]
    dy[i + 1] = _servo_acceleration(a, _servo_target(a, y, i, command), y[i], y[i + 1])
    into_second = command if a.limits_on_engine == 1 else y[i]
    for j in range(2, 6):
        dy[i + j] = 0.0
    if a.order >= 4:
        dy[i + 2] = y[i + 3]
        dy[i + 3] = _section_acceleration(a.omega_2_radps, a.zeta_2, into_second, y[i + 2], y[i + 3])
    if a.order == 6:
        dy[i + 4] = y[i + 5]
        dy[i + 5] = _section_acceleration(a.omega_3_radps, a.zeta_3, y[i + 2], y[i + 4], y[i + 5])


@kernel
def linear_sections(a: Actuator, out: Array, at: int) -> None:
    """Write the system matrix (order, order) of the states below all limits, row by row, into out[at:]."""
    n = a.order
    for i in range(n * n):
        out[at + i] = 0.0
    drives = (0, 0, 2)  # index of the position that drives each section; the command drives a section without an index
    for section in range(n >> 1):
        w, zeta = a.omega_1_radps, a.zeta_1
        if section == 1:
            w, zeta = a.omega_2_radps, a.zeta_2
        elif section == 2:
            w, zeta = a.omega_3_radps, a.zeta_3
        row = at + n * (2 * section + 1)
        out[at + n * 2 * section + 2 * section + 1] = 1.0
        out[row + 2 * section], out[row + 2 * section + 1] = -w * w, -2.0 * zeta * w
        if section == 2 or (section == 1 and a.limits_on_engine == 0):
            out[row + drives[section]] = w * w
    if a.limits_on_engine == 1 and n > 2:  # the servo follows the last section
        square = a.omega_1_radps * a.omega_1_radps
        if n == 4:
            out[at + n + 2] = square
        else:
            w3, k = a.omega_3_radps, 1.0 / (a.omega_4_radps * a.omega_4_radps)
            out[at + n + 2], out[at + n + 4] = square * k * w3 * w3, square * (1.0 - k * w3 * w3)
            out[at + n + 5] = square * k * 2.0 * (a.zeta_4 * a.omega_4_radps - a.zeta_3 * w3)


@kernel
def actuator_motion(
    a: Actuator, faults: Array, channel: int, y: Array, i: int, command: Array, before: Array
) -> tuple[float, float, float]:
    """Return `actuator_output` with the faults of this actuator.

    `channel` is twice its group, plus one in yaw. `command` and `before` contain all channels.
    """
    if faults[ANY_FAULT] == 0.0:
        return actuator_output(a, y, i, command[channel], before[channel])
    faulty = _faulty_command(faults, channel, command[channel])
    angle, rate, accel = actuator_output(a, y, i, faulty, before[channel])
    if faults[ACTUATOR_FAULT + channel] == STUCK and (a.order == 2 or a.limits_on_engine == 1):
        return angle, 0.0, 0.0
    return angle, rate, accel


@kernel
def actuator_rates(a: Actuator, faults: Array, channel: int, y: Array, i: int, command: float, dy: Array) -> None:
    """Write `actuator_derivative` with the faults of this actuator.

    A stuck servo keeps its position, and its rate state decays.
    """
    if faults[ANY_FAULT] == 0.0:
        actuator_derivative(a, y, i, command, dy)
        return
    actuator_derivative(a, y, i, _faulty_command(faults, channel, command), dy)
    if faults[ACTUATOR_FAULT + channel] == STUCK:
        dy[i], dy[i + 1] = 0.0, -2.0 * a.zeta_1 * a.omega_1_radps * y[i + 1]


@kernel
def resisted_acceleration(
    a: Actuator, faults: Array, channel: int, y: Array, i: int, command: float, resistance: float
) -> float:
    """Return the acceleration of a servo against `resistance`, a torque relative to the stall torque, rad/s2."""
    if faults[ANY_FAULT] > 0.0:
        command = _faulty_command(faults, channel, command)
    w1, angle, rate = a.omega_1_radps, y[i], y[i + 1]
    damp_1 = 2.0 * a.zeta_1 * w1
    wanted = w1 * w1 / damp_1 * (_servo_target(a, y, i, command) - angle)
    lowest = -a.rate_limit_radps * math.copysign(math.sqrt(abs(1.0 + resistance)), 1.0 + resistance)
    highest = a.rate_limit_radps * math.copysign(math.sqrt(abs(1.0 - resistance)), 1.0 - resistance)
    accel: float = damp_1 * (min(max(wanted, lowest), highest) - rate)
    return accel


@kernel
def _faulty_command(faults: Array, channel: int, command: float) -> float:
    if faults[ACTUATOR_FAULT + channel] == HARD_OVER:
        command = faults[ACTUATOR_ANGLE + channel]
    if faults[ACTUATOR_FAULT + channel] == FLOATING:
        command = 0.0
    return command


class ActuatorRow(NamedTuple):
    gimbal_axis_command_deg: Annotated[PitchYaw, "deg", "command to the actuator"]
    gimbal_axis_angle_deg: Annotated[PitchYaw, "deg", "gimbal angle"]
    gimbal_axis_rate_degps: Annotated[PitchYaw, "deg/s", "gimbal rate"]
    gimbal_axis_accel_degps2: Annotated[PitchYaw, "deg/s2", "gimbal acceleration"]


@kernel
def actuator_row(
    command_pitch_rad: float, command_yaw_rad: float, pitch: GimbalMotion, yaw: GimbalMotion
) -> ActuatorRow:
    return ActuatorRow(
        gimbal_axis_command_deg=PitchYaw(DEG * command_pitch_rad, DEG * command_yaw_rad),
        gimbal_axis_angle_deg=PitchYaw(DEG * pitch.angle_rad, DEG * yaw.angle_rad),
        gimbal_axis_rate_degps=PitchYaw(DEG * pitch.rate_radps, DEG * yaw.rate_radps),
        gimbal_axis_accel_degps2=PitchYaw(DEG * pitch.accel_radps2, DEG * yaw.accel_radps2),
    )
