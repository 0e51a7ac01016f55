"""Excitation of a loop at the gimbal command: its lines, and its level.

A periodic signal that fits the record exactly needs no window and leaks nothing: at its own lines the discrete Fourier
transform of a period is the response, and what shows between them is noise (Pintelon & Schoukens, System
Identification, ch. 2).

The level is high against the converter's counts and low against every limit. The linear loop predicts what the injected
lines do to engine, angle of attack and gyro. Lines are shaped for equal response at the gyro, within bounds, then
scaled so that gimbal command, servo rate and angle of attack stay at a stated share of where the simulator stops being
linear.
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from maxq.control.kernel.records import Array
from maxq.design.certificate.held_flight import HeldFlight, linear_limits
from maxq.design.loop.fixed_path import FixedPath
from maxq.design.model.held import OUTPUTS
from maxq.design.model.instruments import actuator, per_actuator_angle
from maxq.design.model.node import Node
from maxq.design.model.state_space import ComplexArray
from maxq.sim.scenario.schema_scenario import Injection

MOST_LEVELS, MOST_TONES = 16, 64  # of the simulator: signals at a time, tones of each
DITHER_HZ = (0.525, 0.825)  # off the slosh of the built-in vehicles, where a loop responds and does not ring
SHARE_OF_LIMITS = 0.85
SHARE_OF_BURST = 0.4
INCIDENCE_RAD = 0.004  # small against the angle of attack at which cross-flow lift adds a tenth to the slope
SPREAD = 20.0  # between the strongest and the weakest line
DITHER_COUNTS = 6.0  # largest increment of a sample by each dither tone, in pulses
LOWEST_BURST_HZ = 0.05

Groups = list[tuple[float, Array]]
"""Amplitudes (rad), each with its lines (Hz)."""


class Excited(Protocol):
    """The known parts of a loop that is excited: the vehicle's part, and L, as a linear model or as measured before."""

    @property
    def fixed(self) -> FixedPath: ...

    def response(self, frequencies_hz: Array) -> ComplexArray: ...


@dataclass(frozen=True)
class LineBand:
    """Lines (Hz), each an even multiple of 1 / `period_s`, and how long they are played.

    The odd multiples stay silent: what shows there is noise. One long period is better than many short ones: the
    converter's rounding repeats with the signal, and is spread over all bins of the period.

    `dithered`: too weak at the gyro for the converter, which carries its remainder over: a signal of less than a pulse
    a sample then vanishes or comes out as whole pulses, depending on the remainder, and has no gain that a linear loop
    could predict (tests/test_invariants_certificate.py). Slow tones that make many pulses a sample are played along;
    with them rounding is noise.
    """

    lines_hz: Array
    period_s: float
    settle_s: float
    periods: int
    dithered: bool = False

    @property
    def duration_s(self) -> float:
        """With a second to spare: the last command takes effect after the last sample."""
        return self.settle_s + self.period_s * self.periods + 1.0

    @property
    def dither_hz(self) -> Array:
        """Tones at odd multiples of 1 / `period_s`, so that rounding errors are spread over odd and even ones alike."""
        odd = 2.0 * np.round(0.5 * (np.array(DITHER_HZ) * self.period_s - 1.0)) + 1.0
        return np.asarray(odd / self.period_s) if self.dithered else np.zeros(0)


def band(
    low_hz: float, high_hz: float, lines: int, period_s: float, settle_s: float, periods: int, dithered: bool = False
) -> LineBand:
    """About `lines` lines from low to high, evenly on a logarithmic scale.

    Raises ValueError if the lowest line does not fit the period.
    """
    if low_hz * period_s < 2.0 - 1e-9:
        raise ValueError(f"low_hz = {low_hz}: allowed is at least {2.0 / period_s:g}, two turns a period")
    wanted = np.geomspace(low_hz, high_hz, lines)
    even = 2.0 * np.unique(np.round(wanted * period_s / 2.0))
    return LineBand(even / period_s, period_s, settle_s, periods, dithered)


def below(bands: tuple[LineBand, ...], highest_hz: float) -> tuple[LineBand, ...]:
    """With the lines that a computer of this sample rate can send."""
    kept = (dataclasses.replace(band, lines_hz=band.lines_hz[band.lines_hz < 0.995 * highest_hz]) for band in bands)
    return tuple(band for band in kept if len(band.lines_hz))


@dataclass(frozen=True)
class ExcitationLevel:
    """Amplitudes with their lines, and the largest gimbal command and servo rate that the linear loop predicts.

    `servo_radps` is the rate that the servo commands, which is what the actuator limits. `dither` is played along, at
    its own amplitudes.
    """

    groups: Groups
    command_rad: float
    servo_radps: float
    dither: Groups


def excitation_level(held: HeldFlight, loop: Excited, band: LineBand, scale: float = 1.0) -> ExcitationLevel:
    """Amplitudes for a band; `scale` below 1 plays the same at a lower level."""
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
    command, servo, _ = (factor * peak + by_dither for peak, by_dither in zip(peaks, taken, strict=True))
    return ExcitationLevel([(factor * amplitude, members) for amplitude, members in groups], command, servo, added)


def dither(held: HeldFlight, loop: Excited, tones_hz: Array) -> Groups:
    """Slow tones that each make `DITHER_COUNTS` pulses a sample at the gyro, within limits; none without rounding."""
    count = float(held.packed.parameters[0].computer.converter.count_rad)
    if not len(tones_hz) or count == 0.0:
        return []
    increment = held.sample_s * np.abs(loop.fixed.response(tones_hz)) / np.abs(1.0 + loop.response(tones_hz))
    limits = (*(0.2 * limit for limit in linear_limits(held)), 0.5 * INCIDENCE_RAD)
    out = []
    for a, hz in zip((DITHER_COUNTS * count / increment).tolist(), tones_hz, strict=True):
        line = np.array([hz])
        peaks = _peaks(held, loop, [(a, line)], LineBand(line, 2.0 / float(hz), 0.0, 1))
        out.append((a * min(1.0, *(limit / p for limit, p in zip(limits, peaks, strict=True))), line))
    return out


def grouped(amplitude_rad: Array, lines_hz: Array) -> Groups:
    """Amplitudes in at most half of `MOST_LEVELS` levels.

    Levels are geometric; a level's amplitude is the least of its lines'.
    """
    if len(amplitude_rad) == 0:
        return []
    low, high = float(amplitude_rad.min()), float(amplitude_rad.max())
    steps = max(math.log(high / low), 1e-12) / (MOST_LEVELS // 2)
    level = np.minimum(np.floor(np.log(amplitude_rad / low) / steps), MOST_LEVELS // 2 - 1).astype(int)
    out = []
    for k in np.unique(level):
        members = lines_hz[level == k]
        for first in range(0, len(members), MOST_TONES):
            out.append((float(amplitude_rad[level == k].min()), members[first : first + MOST_TONES]))
    return out


def phasors(groups: Groups) -> tuple[Array, ComplexArray]:
    """Lines (Hz) and phasors (rad) of the sum that the simulator will play: Im sum a exp(j 2 pi f t)."""
    lines, out = [np.zeros(0)], [np.zeros(0, np.complex128)]
    for amplitude, members in groups:
        number = np.arange(1, len(members) + 1)  # phases as sim/packing/computer.py gives them
        out.append(amplitude * np.exp(-1j * np.pi * number * (number - 1) / len(members)))
        lines.append(members)
    return np.concatenate(lines), np.concatenate(out)


def gimbal_injection(axis: str, kind: str, amplitude_rad: float, **more: Any) -> Injection:
    """A signal added to the gimbal command, as a scenario has it; `more` fields by its kind."""
    given = {"at": "gimbal_command", "axis": axis, "kind": kind, "amplitude_deg": math.degrees(amplitude_rad)}
    return Injection.model_validate(given | more)


def injections(groups: Groups, axis: str) -> tuple[Injection, ...]:
    """The groups as multisines."""
    return tuple(
        gimbal_injection(axis, "multisine", amplitude, frequencies_hz=tuple(float(f) for f in lines))
        for amplitude, lines in groups
    )


def sine_burst(held: HeldFlight, frequency_hz: float, scale: float = 1.0) -> Injection:
    """Three turns of a sine at `scale` times the amplitude of `burst_rad`; at least LOWEST_BURST_HZ."""
    hz = max(frequency_hz, LOWEST_BURST_HZ)
    return sine(held, hz, scale * burst_rad(held, frequency_hz), 3.0 / hz)


def sine(held: HeldFlight, frequency_hz: float, amplitude_rad: float, stop_s: float) -> Injection:
    """A sine from the beginning on, for so long. Near half the sample rate it begins a quarter turn late: at half of it
    all samples of a sine that begins at one are 0."""
    late_s = 0.25 / frequency_hz if frequency_hz > 0.45 / held.sample_s else 0.0
    times = {"start_s": round(late_s, 9), "stop_s": round(stop_s, 6)}
    return gimbal_injection(held.plane, "sine", amplitude_rad, frequency_hz=frequency_hz, **times)


def burst_rad(held: HeldFlight, frequency_hz: float, growth: float = 1.0) -> float:
    """Amplitude of a burst at one frequency, far from every limit even after the loop has amplified it by `growth`."""
    return SHARE_OF_BURST * min(linear_room(held, frequency_hz)) / growth


def linear_room(held: HeldFlight, frequency_hz: float) -> tuple[float, float]:
    """Amplitudes (rad) of the gimbal command at a frequency: those that reach a share of the limits beyond which the
    actuator or the computer is not linear, and INCIDENCE_RAD."""
    line = np.array([max(frequency_hz, LOWEST_BURST_HZ)])
    servo, incidence = (float(np.abs(x[..., 0]).max()) for x in _servo_and_incidence(held.node, line))
    angle, rate = linear_limits(held)
    return SHARE_OF_LIMITS * min(angle, rate / servo), INCIDENCE_RAD / incidence


def _peaks(held: HeldFlight, loop: Excited, groups: Groups, band: LineBand) -> tuple[float, float, float]:
    """Largest command (rad), servo rate (rad/s) and angle of attack (rad) over a period, by the linear loop."""
    lines, injected = phasors(groups)
    command = injected / (1.0 + loop.response(lines))
    servo, incidence = _servo_and_incidence(held.node, lines)
    # one long transform instead of a sum of sines: the bins are the multiples of 1 / period
    bins = np.round(lines * band.period_s).astype(int)
    samples = 2 * max(round(band.period_s / held.sample_s), int(bins.max()) + 1)

    def peak(gain: ComplexArray) -> float:
        spectrum = np.zeros(samples // 2 + 1, np.complex128)
        spectrum[bins] = -0.5j * samples * command * gain
        return float(np.abs(np.fft.irfft(spectrum, samples)).max())

    return peak(np.ones_like(incidence)), max(peak(one) for one in servo), peak(incidence)


def _servo_and_incidence(node: Node, lines_hz: Array) -> tuple[ComplexArray, ComplexArray]:
    """Rate that each drive's servo commands, (drives, lines) in 1/s as if all had the lowest limit of it
    (sim/vehicle/actuator/kernel.py), and angle of attack w / U, per gimbal command.
    """
    s = np.asarray(2j * np.pi * lines_hz, np.complex128)
    records, inputs = node.instruments.actuators, node.plant.inputs
    per_engine = node.plant.response(lines_hz)[:, OUTPUTS.index("w_mps"), :] / max(node.condition.airspeed_mps, 1.0)
    if records[0].ideal:
        angles = [k for k, name in enumerate(inputs) if name.startswith("delta_rad")]
        return np.ones_like(s)[None], np.asarray(per_engine[:, angles].sum(axis=1))
    lowest = min(record.rate_limit_radps for record in records)
    servos, incidence = [], np.zeros_like(s)
    turned = per_actuator_angle(s, np.asarray(per_engine, np.complex128), inputs)
    for record, gain, per_angle in zip(records, node.gains, turned, strict=True):
        x = s / record.omega_1_radps
        angle = actuator(record).channel("delta_rad", "command_rad", lines_hz)
        followed = 1.0 / (1.0 + x * (2.0 * record.zeta_1 + x))
        commanded = record.omega_1_radps / (2.0 * record.zeta_1) * (1.0 - followed)
        ahead = angle / followed if record.limits_on_engine else np.ones_like(s)  # sections that come before the servo
        share = 1.0 if math.isinf(lowest) else lowest / record.rate_limit_radps
        servos.append(gain * share * ahead * commanded)
        incidence = incidence + angle * per_angle
    return np.stack(servos), incidence
