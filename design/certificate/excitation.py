"""What is injected at the gimbal command to measure a loop: sums of sines, as loud as linearity allows.

A periodic signal that fits the record exactly needs no window and leaks nothing: at its own lines the discrete Fourier
transform of a period is the response, and what shows between them is noise (Pintelon & Schoukens, System
Identification, ch. 2).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from maxq.control.kernel.records import Array
from maxq.design.model.state_space import ComplexArray
from maxq.sim.scenario.schema_injection import Injection

MOST_LEVELS, MOST_TONES = 16, 64  # of the simulator: signals at a time, tones of each
DITHER_HZ = (0.525, 0.825)  # off the slosh of the vehicles that we have, where a loop answers and does not ring


@dataclass(frozen=True)
class Band:
    """Lines (Hz), every one an even multiple of 1 / `period_s`, and for how long they are played.

    The odd multiples stay silent: what shows there is noise. One long period tells more than many short ones: what
    the converter's rounding adds repeats with the signal, and is spread over all bins of the period.

    `dithered`: too quiet at the gyro for the converter, which carries its remainder over: a signal of less than a pulse
    a sample then vanishes or comes out as whole pulses, by where the remainder stands, and has no gain that a linear
    loop would know (tests/test_invariants_certificate.py). Slow tones that make many pulses a sample are played along;
    under them rounding is noise.
    """

    lines_hz: Array
    period_s: float
    settle_s: float
    periods: int
    dithered: bool = False

    @property
    def duration_s(self) -> float:
        """With something to spare: the last command takes effect after the last sample."""
        return self.settle_s + self.period_s * self.periods + 1.0

    @property
    def dither_hz(self) -> Array:
        """Tones at odd multiples of 1 / `period_s`, so that rounding errors are spread over odd and even ones alike."""
        odd = 2.0 * np.round(0.5 * (np.array(DITHER_HZ) * self.period_s - 1.0)) + 1.0
        return np.asarray(odd / self.period_s) if self.dithered else np.zeros(0)


def band(
    low_hz: float, high_hz: float, lines: int, period_s: float, settle_s: float, periods: int, dithered: bool = False
) -> Band:  # fmt: skip
    """About `lines` lines from low to high, evenly on a logarithmic scale.

    Raises ValueError if the lowest line does not fit the period.
    """
    if low_hz * period_s < 2.0 - 1e-9:
        raise ValueError(f"low_hz = {low_hz}: allowed is at least {2.0 / period_s:g}, two turns a period")
    wanted = np.geomspace(low_hz, high_hz, lines)
    even = 2.0 * np.unique(np.round(wanted * period_s / 2.0))
    return Band(even / period_s, period_s, settle_s, periods, dithered)


def grouped(amplitude_rad: Array, lines_hz: Array) -> list[tuple[float, Array]]:
    """Amplitudes in at most half of `MOST_LEVELS` levels, each with its lines: amplitude, lines (Hz).

    Levels are geometric; a level's amplitude is the largest not above any of its lines'.
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


def phasors(groups: list[tuple[float, Array]]) -> tuple[Array, ComplexArray]:
    """Lines (Hz) and phasors (rad) of the sum that the simulator will play: Im sum a exp(j 2 pi f t)."""
    lines, out = [np.zeros(0)], [np.zeros(0, np.complex128)]
    for amplitude, members in groups:
        number = np.arange(1, len(members) + 1)  # phases as sim/packing/computer.py gives them
        out.append(amplitude * np.exp(-1j * np.pi * number * (number - 1) / len(members)))
        lines.append(members)
    return np.concatenate(lines), np.concatenate(out)


def injections(groups: list[tuple[float, Array]], axis: str) -> tuple[Injection, ...]:
    """The same as the scenario says it."""
    return tuple(
        Injection.model_validate(
            {
                "at": "gimbal_command", "axis": axis, "kind": "multisine",
                "amplitude_deg": math.degrees(amplitude), "frequencies_hz": tuple(float(f) for f in lines),
            }
        )
        for amplitude, lines in groups
    )  # fmt: skip
