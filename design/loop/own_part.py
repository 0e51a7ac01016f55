"""The own part of a bending mode in L, and the fraction of L that is attributed to the mode.

The own part of a bending mode is the response through its pole pair alone: a term of the vehicle's partial fractions,
in series with actuators, sensor and flight computer. At the mode's frequency it is `part` times the whole response. A
law with one gyro multiplies the own part and the whole response by the same factor. The ratio is then a property of the
plant and not of the design.

| own part | peak of the mode |
|---|---|
| larger than the rest | max abs(L) in `peak_band`: near the frequency, where the own part exceeds half the rest |
| half the rest or less | the own part at the frequency |
| between | max abs(L) in that band, times abs(part) to a power from 0 to 1 |
"""

from __future__ import annotations

import math
from typing import TypeVar

import numpy as np

from maxq.control.kernel.jit import formula
from maxq.control.kernel.records import Array

Real = TypeVar("Real", float, Array)

BAND = 0.03  # half width of the band that contains the peak, relative to the mode's frequency
LEAST = 2.0  # smallest half width of the band, in half widths of the resonance
POINT = 1e-4  # relative half width below which the band is a single frequency
SHARE = 0.5  # ratio of own part to the rest above which a crossing belongs to the mode
NEAREST_NYQUIST = 1.0 - 1e-6


@formula
def folded_hz(frequency_hz: Real, rate_hz: float) -> Real:
    """Return the frequency at which a pole appears in a loop sampled at `rate_hz`."""
    folded: Real = np.abs(frequency_hz - np.round(frequency_hz / rate_hz) * rate_hz)
    return folded


@formula
def centre_of(frequency_hz: Real, half_width_hz: Real, highest_hz: float) -> Real:
    """Return the frequency (Hz) at which a mode is examined.

    It is the magnitude of the folded pole, limited to the Nyquist frequency. The result differs from `frequency_hz`
    only if damping makes the resonance indistinct.
    """
    centre: Real = np.minimum(np.hypot(frequency_hz, half_width_hz), NEAREST_NYQUIST * highest_hz)
    return centre


@formula
def dominance(part: complex) -> float:
    """Return the ratio of a mode's own part to the rest of the response, at the mode's frequency."""
    return float(abs(part) / max(abs(1.0 - part), 1e-9))


@formula
def attribution(part: complex) -> float:
    """Return ln of the factor by which the peak of a mode differs from |L| at its frequency; 0 for a dominant mode."""
    power = min(max(2.0 * (1.0 - dominance(part)), 0.0), 1.0)
    return float(power * math.log(max(abs(part), 1e-30)))


@formula
def peak_band(
    centre_hz: float, half_width_hz: float, part: complex, gap_hz: float, top_hz: float
) -> tuple[float, float]:
    """Return the lower and upper frequency (Hz) of the band that contains a mode's peak.

    They are equal for a single point. The rest of the response is taken as constant over the band. `gap_hz` is the
    distance to the nearest other mode, and `top_hz` is the highest frequency of the loop.
    """
    strong = half_width_hz * (dominance(part) / SHARE - 1.0)
    half = min(max(BAND * centre_hz, LEAST * half_width_hz), 0.5 * gap_hz, strong)
    if half < POINT * centre_hz:
        return centre_hz, centre_hz
    return max(centre_hz - half, 0.5 * centre_hz), min(centre_hz + half, top_hz)
