"""The excitation of a loop at the gimbal command: its lines and its level.

A periodic signal that fits the record exactly needs no window and causes no leakage. At its own lines, the discrete
Fourier transform of a period is the response. The content between the lines is noise (Pintelon & Schoukens, System
Identification, ch. 2).

The level is high relative to the converter's counts and low relative to every limit. The linear loop predicts the
response of engine, angle of attack and gyro to the injected lines. The lines are shaped for equal response at the gyro,
within bounds. They are then scaled so that gimbal command, servo rate and angle of attack remain at a stated fraction
of the simulator's limits of linearity.
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

MOST_LEVELS, MOST_TONES = 16, 64  # limits of the simulator: simultaneous signals, tones per signal
DITHER_HZ = (0.525, 0.825, 1.275, 1.925)  # candidates of the two dither tones, the preferred ones first
DITHER_APART = 0.15  # least relative distance of a dither tone from slosh frequencies
SHARE_OF_LIMITS = 0.85
SHARE_OF_BURST = 0.4
INCIDENCE_RAD = 0.004  # small relative to the angle of attack at which cross-flow lift adds a tenth to the slope
SPREAD = 20.0  # largest ratio of the strongest to the weakest line
DITHER_COUNTS = 6.0  # largest increment per sample of each dither tone, in pulses
LOWEST_BURST_HZ = 0.05

Groups = list[tuple[float, Array]]
"""Amplitudes (rad), each with its lines (Hz)."""


class Excited(Protocol):
    """An excited loop: the response of its vehicle, and L from a linear model or an earlier measurement."""

    @property
    def fixed(self) -> FixedPath: ...

    def response(self, frequencies_hz: Array) -> ComplexArray: ...


@dataclass(frozen=True)
class LineBand:
    """The lines (Hz) of an excitation, each an even multiple of 1 / `period_s`, and its duration.

    The odd multiples are not excited and contain only noise. One long period is better than many short ones: the
    rounding of the converter repeats with the signal, and is spread over all bins of the period.

    `dithered` marks lines that are too weak at the gyro for the converter, which carries its remainder over. A signal
    of less than one pulse per sample then vanishes or appears as whole pulses, depending on the remainder. A linear
    loop cannot predict its gain (tests/test_invariants_certificate.py). Slow tones of many pulses per sample are added,
    so that the rounding becomes noise. `tones_hz` are these tones before they are fitted to the period.
    """

    lines_hz: Array
    period_s: float
    settle_s: float
    periods: int
    dithered: bool = False
    tones_hz: tuple[float, ...] = DITHER_HZ[:2]

    @property
    def duration_s(self) -> float:
        """Return the duration (s).

        It includes a margin of one second, because the last command takes effect after the last sample.
        """
        return self.settle_s + self.period_s * self.periods + 1.0

    @property
    def dither_hz(self) -> Array:
        """Return dither tones (Hz) at odd multiples of 1 / `period_s`.

        They spread rounding errors equally over odd and even multiples.
        """
        odd = 2.0 * np.round(0.5 * (np.array(self.tones_hz) * self.period_s - 1.0)) + 1.0
        return np.asarray(odd / self.period_s) if self.dithered else np.zeros(0)


def band(
    low_hz: float, high_hz: float, lines: int, period_s: float, settle_s: float, periods: int, dithered: bool = False
) -> LineBand:
    """Return a band of about `lines` lines from low to high, evenly spaced on a logarithmic scale.

    Raises ValueError if the period is too short for the lowest line.
    """
    if low_hz * period_s < 2.0 - 1e-9:
        raise ValueError(f"low_hz = {low_hz}: allowed is at least {2.0 / period_s:g}, two turns a period")
    wanted = np.geomspace(low_hz, high_hz, lines)
    even = 2.0 * np.unique(np.round(wanted * period_s / 2.0))
    return LineBand(even / period_s, period_s, settle_s, periods, dithered)


def below(bands: tuple[LineBand, ...], highest_hz: float) -> tuple[LineBand, ...]:
    """Return the bands with only those lines that are sufficiently below the Nyquist frequency `highest_hz`."""
    kept = (dataclasses.replace(band, lines_hz=band.lines_hz[band.lines_hz < 0.995 * highest_hz]) for band in bands)
    return tuple(band for band in kept if len(band.lines_hz))


def dither_tones_hz(path: FixedPath) -> tuple[float, ...]:
    """Return the first two dither tones (Hz) that are away from the slosh frequencies, or the two farthest from them.

    A tone at a slosh frequency swings the liquid by tens of degrees. At such angles, the pendulum is nonlinear and
    changes the response near lightly damped modes by up to 2 dB.
    """
    slosh_hz = [r.frequency_hz for r in path.resonances() if r.kind == "slosh"]

    def apart(hz: float) -> float:
        return min((abs(math.log(hz / f)) for f in slosh_hz), default=math.inf)

    free = [hz for hz in DITHER_HZ if apart(hz) >= DITHER_APART]
    return tuple(free[:2]) if len(free) > 1 else tuple(sorted(sorted(DITHER_HZ, key=apart)[-2:]))


def away_from_slosh(bands: tuple[LineBand, ...], path: FixedPath) -> tuple[LineBand, ...]:
    """Return the bands with dither tones for the slosh frequencies of a path."""
    tones_hz = dither_tones_hz(path)
    return tuple(dataclasses.replace(band, tones_hz=tones_hz) for band in bands)


@dataclass(frozen=True)
class ExcitationLevel:
    """The amplitudes with their lines, and the largest gimbal command and servo rate that the linear loop predicts.

    `servo_radps` is the commanded servo rate, which the actuator limits. `dither` is added at its own amplitudes.
    """

    groups: Groups
    command_rad: float
    servo_radps: float
    dither: Groups


def excitation_level(held: HeldFlight, loop: Excited, band: LineBand, scale: float = 1.0) -> ExcitationLevel:
    """Return the amplitudes for a band. A `scale` below 1 lowers the level of the same signal."""
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
    """Return slow tones that each cause `DITHER_COUNTS` pulses per sample at the gyro, within limits.

    The result is empty without rounding.
    """
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
    """Return the amplitudes, grouped into at most half of `MOST_LEVELS` levels.

    The levels are geometric. The amplitude of a level is the least amplitude of its lines.
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
    """Return the lines (Hz) and phasors (rad) of the injected sum Im sum a exp(j 2 pi f t)."""
    lines, out = [np.zeros(0)], [np.zeros(0, np.complex128)]
    for amplitude, members in groups:
        number = np.arange(1, len(members) + 1)  # phases as in sim/packing/computer.py
        out.append(amplitude * np.exp(-1j * np.pi * number * (number - 1) / len(members)))
        lines.append(members)
    return np.concatenate(lines), np.concatenate(out)


def gimbal_injection(axis: str, kind: str, amplitude_rad: float, **more: Any) -> Injection:
    """Return a signal added to the gimbal command, as in a scenario. `more` contains the fields of its kind."""
    given = {"at": "gimbal_command", "axis": axis, "kind": kind, "amplitude_deg": math.degrees(amplitude_rad)}
    return Injection.model_validate(given | more)


def injections(groups: Groups, axis: str) -> tuple[Injection, ...]:
    """Return the groups as multisine signals about an axis."""
    return tuple(
        gimbal_injection(axis, "multisine", amplitude, frequencies_hz=tuple(float(f) for f in lines))
        for amplitude, lines in groups
    )


def sine_burst(held: HeldFlight, frequency_hz: float, scale: float = 1.0) -> Injection:
    """Return three periods of a sine at `scale` times the amplitude of `burst_rad`, at LOWEST_BURST_HZ or above."""
    hz = max(frequency_hz, LOWEST_BURST_HZ)
    return sine(held, hz, scale * burst_rad(held, frequency_hz), 3.0 / hz)


def sine(held: HeldFlight, frequency_hz: float, amplitude_rad: float, stop_s: float) -> Injection:
    """Return a sine that starts immediately and has the given duration.

    Close to half the sample rate, it starts a quarter period late. At half the sample rate, all samples of a sine with
    zero phase are 0.
    """
    late_s = 0.25 / frequency_hz if frequency_hz > 0.45 / held.sample_s else 0.0
    times = {"start_s": round(late_s, 9), "stop_s": round(stop_s, 6)}
    return gimbal_injection(held.plane, "sine", amplitude_rad, frequency_hz=frequency_hz, **times)


def burst_rad(held: HeldFlight, frequency_hz: float, growth: float = 1.0) -> float:
    """Return the amplitude (rad) of a burst at one frequency.

    The burst remains far below every limit, even if the loop amplifies it by `growth`.
    """
    return SHARE_OF_BURST * min(linear_room(held, frequency_hz)) / growth


def linear_room(held: HeldFlight, frequency_hz: float) -> tuple[float, float]:
    """Return the amplitudes (rad) of the gimbal command at a frequency at which limits are reached.

    The first limit is a fraction of the linear range of actuator and computer, and the second is INCIDENCE_RAD.
    """
    line = np.array([max(frequency_hz, LOWEST_BURST_HZ)])
    servo, incidence = (float(np.abs(x[..., 0]).max()) for x in _servo_and_incidence(held.node, line))
    angle, rate = linear_limits(held)
    return SHARE_OF_LIMITS * min(angle, rate / servo), INCIDENCE_RAD / incidence


def _peaks(held: HeldFlight, loop: Excited, groups: Groups, band: LineBand) -> tuple[float, float, float]:
    """Return the largest command (rad), servo rate (rad/s) and angle of attack (rad) over a period.

    They are predicted by the linear loop.
    """
    lines, injected = phasors(groups)
    command = injected / (1.0 + loop.response(lines))
    servo, incidence = _servo_and_incidence(held.node, lines)
    # a single long transform replaces a sum of sines; its bins are the multiples of 1 / period
    bins = np.round(lines * band.period_s).astype(int)
    samples = 2 * max(round(band.period_s / held.sample_s), int(bins.max()) + 1)

    def peak(gain: ComplexArray) -> float:
        spectrum = np.zeros(samples // 2 + 1, np.complex128)
        spectrum[bins] = -0.5j * samples * command * gain
        return float(np.abs(np.fft.irfft(spectrum, samples)).max())

    return peak(np.ones_like(incidence)), max(peak(one) for one in servo), peak(incidence)


def _servo_and_incidence(node: Node, lines_hz: Array) -> tuple[ComplexArray, ComplexArray]:
    """Return the servo rate and the angle of attack per gimbal command.

    The servo rate of each drive has the shape (drives, lines), in 1/s. It is scaled as if all drives had the lowest
    rate limit (sim/vehicle/actuator/kernel.py). The angle of attack is w / U.
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
        ahead = angle / followed if record.limits_on_engine else np.ones_like(s)  # sections before the servo
        share = 1.0 if math.isinf(lowest) else lowest / record.rate_limit_radps
        servos.append(gain * share * ahead * commanded)
        incidence = incidence + angle * per_angle
    return np.stack(servos), incidence
