"""How loud a measurement may be: loud against the converter's counts, quiet against every limit.

The linear loop tells what the injected lines do to engine, incidence and gyro. Every line is given the amplitude that
makes the same stir at the gyro, within bounds; then all are scaled so that engine angle and rate and the vehicle's
incidence stay at a stated fraction of where the simulator stops being linear.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from maxq.control.records import Array
from maxq.design.certificate.excitation import Band, grouped, phasors
from maxq.design.certificate.held_flight import HeldFlight, linear_limits
from maxq.design.loop.loop import Loop
from maxq.design.model.instruments import actuator
from maxq.design.model.node import Node
from maxq.design.model.plant import OUTPUTS
from maxq.design.model.state_space import ComplexArray

SHARE_OF_LIMITS = 0.5
SHARE_OF_BURST = 0.1
INCIDENCE_RAD = 0.004  # small against the incidence at which cross-flow lift adds a tenth to the slope
SPREAD = 20.0  # between the loudest and the quietest line


@dataclass(frozen=True)
class Loudness:
    """Amplitudes by level (rad) with their lines (Hz), and what they are predicted to do at most."""

    groups: list[tuple[float, Array]]
    command_rad: float
    rate_radps: float
    incidence_rad: float


def loudness(held: HeldFlight, loop: Loop, band: Band, scale: float = 1.0) -> Loudness:
    """Amplitudes for a band; `scale` below 1 plays the same more quietly."""
    lines = band.lines_hz
    at_gyro = np.abs(loop.fixed.response(lines)) / np.abs(1.0 + loop.response(lines))
    wanted = 1.0 / np.sqrt(np.maximum(at_gyro, at_gyro.max() * 1e-12))
    groups = grouped(np.minimum(wanted, SPREAD * wanted.min()), lines)
    angle, rate = linear_limits(held)
    command, servo_rate, incidence = _peaks(held, loop, groups, band)
    limit = min(
        SHARE_OF_LIMITS * angle / command, SHARE_OF_LIMITS * rate / servo_rate, INCIDENCE_RAD / incidence
    ) * scale  # fmt: skip
    return Loudness(
        [(limit * amplitude, members) for amplitude, members in groups],
        limit * command, limit * servo_rate, limit * incidence,
    )  # fmt: skip


def _peaks(
    held: HeldFlight, loop: Loop, groups: list[tuple[float, Array]], band: Band
) -> tuple[float, float, float]:  # fmt: skip
    """Largest command (rad), servo rate (rad/s) and incidence (rad) over a period, by the linear loop."""
    lines, injected = phasors(groups)
    command = injected / (1.0 + loop.response(lines))
    servo, sideways = _servo_and_incidence(held.node, lines)
    times = np.arange(0.0, band.period_s, held.sample_s / 2.0)
    turning = np.exp(2j * np.pi * np.outer(times, lines))

    def peak(gain: ComplexArray) -> float:
        return float(np.abs((turning @ (command * gain)).imag).max())

    return peak(np.ones_like(servo)), peak(servo * 2j * np.pi * lines), peak(sideways)


def _servo_and_incidence(node: Node, lines_hz: Array) -> tuple[ComplexArray, ComplexArray]:
    """Angle of the actuator's first section, whose rate is the limited one, and incidence w / U, per command."""
    s = 2j * np.pi * lines_hz
    record = node.instruments.actuator
    per_engine = node.plant.response(lines_hz)[:, OUTPUTS.index("w_mps"), :] / max(node.condition.airspeed_mps, 1.0)
    if record.ideal:
        return np.ones_like(s), np.asarray(per_engine[:, 0])
    x = s / record.omega_1_radps
    angle = actuator(record).channel("delta_rad", "command_rad", lines_hz)
    servo = 1.0 / (1.0 + x * (2.0 * record.zeta_1 + x))
    return np.asarray(servo), np.asarray(angle * (per_engine[:, 0] + s * s * per_engine[:, 1]))


def burst_rad(held: HeldFlight, frequency_hz: float) -> float:
    """Amplitude of a short burst at one frequency that stays far from every limit even where the loop rings with it."""
    line = np.array([max(frequency_hz, 0.05)])
    servo, sideways = (float(np.abs(x[0])) for x in _servo_and_incidence(held.node, line))
    angle, rate = linear_limits(held)
    rooms = (angle, rate / (2.0 * np.pi * line[0] * servo), INCIDENCE_RAD / sideways)
    return SHARE_OF_BURST * float(min(rooms))
