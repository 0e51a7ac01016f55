"""How loud a measurement may be: loud against the converter's counts, quiet against every limit.

The linear loop tells what the injected lines do to engine, incidence and gyro. Every line is given the amplitude that
makes the same stir at the gyro, within bounds; then all are scaled so that gimbal command, the rate that the servo asks
for and the vehicle's incidence stay at a stated fraction of where the simulator stops being linear.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from maxq.control.kernel.records import Array
from maxq.design.certificate.excitation import Band, grouped, phasors
from maxq.design.certificate.held_flight import HeldFlight, linear_limits
from maxq.design.loop.loop import Loop
from maxq.design.model.instruments import actuator
from maxq.design.model.node import Node
from maxq.design.model.plant import OUTPUTS
from maxq.design.model.state_space import ComplexArray

SHARE_OF_LIMITS = 0.85
SHARE_OF_BURST = 0.4
INCIDENCE_RAD = 0.004  # small against the incidence at which cross-flow lift adds a tenth to the slope
SPREAD = 20.0  # between the loudest and the quietest line
DITHER_COUNTS = 6.0  # largest increment of a sample by each dither tone, in pulses


@dataclass(frozen=True)
class Loudness:
    """Amplitudes by level (rad) with their lines (Hz), and what they are predicted to do at most.

    `servo_radps` is the rate that the servo asks for, which is what the actuator limits. `dither` is played along, at
    its own amplitudes.
    """

    groups: list[tuple[float, Array]]
    command_rad: float
    servo_radps: float
    incidence_rad: float
    dither: list[tuple[float, Array]]


def loudness(held: HeldFlight, loop: Loop, band: Band, scale: float = 1.0) -> Loudness:
    """Amplitudes for a band; `scale` below 1 plays the same more quietly."""
    lines = band.lines_hz
    at_gyro = np.abs(loop.fixed.response(lines)) / np.abs(1.0 + loop.response(lines))
    wanted = 1.0 / np.sqrt(np.maximum(at_gyro, at_gyro.max() * 1e-12))
    groups = grouped(np.minimum(wanted, SPREAD * wanted.min()), lines)
    added = dither(held, loop, band.dither_hz)
    taken = _peaks(held, loop, added, band) if added else (0.0, 0.0, 0.0)
    peaks = _peaks(held, loop, groups, band)
    limits = (*(SHARE_OF_LIMITS * limit for limit in linear_limits(held)), INCIDENCE_RAD)
    room = [max(limit - by_dither, 0.1 * limit) for limit, by_dither in zip(limits, taken, strict=True)]
    factor = scale * min(r / peak for r, peak in zip(room, peaks, strict=True))
    reached = [factor * peak + by_dither for peak, by_dither in zip(peaks, taken, strict=True)]
    return Loudness(
        [(factor * amplitude, members) for amplitude, members in groups], reached[0], reached[1], reached[2], added
    )  # fmt: skip


def dither(held: HeldFlight, loop: Loop, tones_hz: Array) -> list[tuple[float, Array]]:
    """Amplitudes (rad) of slow tones, so that each makes `DITHER_COUNTS` pulses a sample at the gyro; none without."""
    count = float(held.packed.parameters[0].computer.converter.count_rad)
    if not len(tones_hz) or count == 0.0:
        return []
    increment = held.sample_s * np.abs(loop.fixed.response(tones_hz)) / np.abs(1.0 + loop.response(tones_hz))
    amplitude = DITHER_COUNTS * count / increment
    line = [np.array([f]) for f in tones_hz]
    limits = (*(0.2 * limit for limit in linear_limits(held)), 0.5 * INCIDENCE_RAD)
    out = []
    for a, f in zip(amplitude, line, strict=True):
        band_of_one = Band(f, 2.0 / float(f[0]), 0.0, 1)
        peaks = _peaks(held, loop, [(float(a), f)], band_of_one)
        out.append((float(a) * min(1.0, *(limit / p for limit, p in zip(limits, peaks, strict=True))), f))
    return out


def _peaks(
    held: HeldFlight, loop: Loop, groups: list[tuple[float, Array]], band: Band
) -> tuple[float, float, float]:  # fmt: skip
    """Largest command (rad), servo rate asked for (rad/s), incidence (rad) over a period, by the linear loop."""
    lines, injected = phasors(groups)
    command = injected / (1.0 + loop.response(lines))
    servo, sideways = _servo_and_incidence(held.node, lines)
    # one long transform instead of a sum of sines: the bins are the multiples of 1 / period
    bins = np.round(lines * band.period_s).astype(int)
    samples = 2 * max(round(band.period_s / held.sample_s), int(bins.max()) + 1)

    def peak(gain: ComplexArray) -> float:
        spectrum = np.zeros(samples // 2 + 1, np.complex128)
        spectrum[bins] = -0.5j * samples * command * gain
        return float(np.abs(np.fft.irfft(spectrum, samples)).max())

    return peak(np.ones_like(servo)), peak(servo), peak(sideways)


def _servo_and_incidence(node: Node, lines_hz: Array) -> tuple[ComplexArray, ComplexArray]:
    """Rate that the servo asks for (1/s; sim/vehicle/actuator.py), and incidence w / U, per command."""
    s = 2j * np.pi * lines_hz
    record = node.instruments.actuator
    per_engine = node.plant.response(lines_hz)[:, OUTPUTS.index("w_mps"), :] / max(node.condition.airspeed_mps, 1.0)
    if record.ideal:
        return np.ones_like(s), np.asarray(per_engine[:, 0])
    x = s / record.omega_1_radps
    angle = actuator(record).channel("delta_rad", "command_rad", lines_hz)
    followed = 1.0 / (1.0 + x * (2.0 * record.zeta_1 + x))
    asked = record.omega_1_radps / (2.0 * record.zeta_1) * (1.0 - followed)
    return np.asarray(asked), np.asarray(angle * (per_engine[:, 0] + s * s * per_engine[:, 1]))


def linear_command_rad(held: HeldFlight, frequency_hz: float) -> float:
    """Amplitude of the gimbal command at one frequency beyond which the actuator or the computer is not linear."""
    line = np.array([max(frequency_hz, 0.05)])
    servo, _ = (float(np.abs(x[0])) for x in _servo_and_incidence(held.node, line))
    angle, rate = linear_limits(held)
    return float(SHARE_OF_LIMITS * min(angle, rate / servo))


def burst_rad(held: HeldFlight, frequency_hz: float, growth: float = 1.0) -> float:
    """Amplitude of a burst at one frequency that stays far from every limit, although the loop makes `growth` of it."""
    line = np.array([max(frequency_hz, 0.05)])
    _, sideways = (float(np.abs(x[0])) for x in _servo_and_incidence(held.node, line))
    room = min(linear_command_rad(held, frequency_hz), INCIDENCE_RAD / sideways)
    return SHARE_OF_BURST * float(room) / growth
