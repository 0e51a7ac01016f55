"""The crossings of a loop's curve with the unit circle and the real axis, and its encirclements of -1.

Unstable poles of the closed loop are counted in two ways: from the list of poles, and by the argument principle from L.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from maxq.control.kernel.jit import formula, routine
from maxq.control.kernel.records import Array, IntArray
from maxq.design.margins import solving
from maxq.design.margins.curve import NARROW, ON_AXIS, Trace, course, merged, round_
from maxq.design.margins.response import TWO_PI, LoopResponse, values_at
from maxq.design.margins.solving import LOG_SIZE, SINE, angle, objective
from maxq.design.model.state_space import ComplexArray

FARTHEST = 1e9  # a sign change of Im L with |L| above this, or below 1 / this, is a pole or zero on the axis
REAL = 1e-6  # |Im L| / |L| below which the end of the curve counts as real


@dataclass(frozen=True)
class GainCrossings:
    """The crossings of |L| = 1, (n,) each, in rising order of frequency."""

    frequency_hz: Array
    loop: ComplexArray
    rising: NDArray[np.bool_]  # True where |L| increases with frequency

    @property
    def phase_margin_deg(self) -> Array:
        """Return the phase margins in (-180, 180], deg.

        A positive value is the lag that moves the point to -1, and a negative value the lead, if that is smaller.
        """
        return solving.from_minus_one_deg(self.loop)

    @property
    def lag_deg(self) -> Array:
        """Return the lag in [0, 360) that moves the point to -1, deg."""
        return np.asarray(np.mod(self.phase_margin_deg, 360.0))

    @property
    def delay_s(self) -> Array:
        """Return the delay that causes this lag, s."""
        return np.asarray(self.lag_deg / (360.0 * self.frequency_hz))


@dataclass(frozen=True)
class PhaseCrossings:
    """The crossings of the negative real axis, (n,) each.

    Frequencies of 0 and infinity denote limits of L, and the highest frequency of a sampled loop is Nyquist. The `turn`
    of a crossing from above to below (anticlockwise about the origin) is +1, and otherwise -1. It is 0 at the ends,
    where the curve reaches the axis but does not cross it.
    """

    frequency_hz: Array
    loop: ComplexArray
    turn: IntArray

    @property
    def gain_margin_db(self) -> Array:
        """Return the gain margins, dB.

        A positive value is the increase of gain that moves the point to -1, and a negative value the decrease.
        """
        return np.asarray(-solving.DB * solving.log_size(self.loop))


class Crossings(NamedTuple):
    """All crossings, first of |L| = 1, then of the negative real axis.

    `gain_way` is 1 where |L| rises and -1 where it falls. `phase_way` is `PhaseCrossings.turn`.
    """

    gain_hz: Array
    gain_loop: ComplexArray
    gain_way: IntArray
    phase_hz: Array
    phase_loop: ComplexArray
    phase_way: IntArray


@formula
def steps_past_poles(f: Array, open_: ComplexArray, closed: ComplexArray) -> IntArray:
    """Return the number of poles of L on the imaginary axis that each interval of the curve contains, (points - 1,).

    A pole that is in both lists at the same frequency cancels in L.
    """
    count, lowest = np.zeros(len(f) - 1, np.int64), TWO_PI * f[0]
    for which in range(2):
        for p in open_ if which == 0 else closed:
            if p.imag > lowest and abs(p.real) <= ON_AXIS * abs(p):
                k = np.searchsorted(f, p.imag / TWO_PI) - 1
                if 0 <= k < len(f) - 1:
                    count[k] += 1 if which == 0 else -1
    return np.maximum(count, 0)


@routine
def crossings(t: Trace, past: IntArray, source: LoopResponse) -> tuple[Crossings, Array, ComplexArray]:
    """Return all crossings, and the frequencies and values of the curve with the crossings added.

    `past` is the result of `steps_past_poles`.
    """
    f, loop, zones = t.frequency_hz, t.loop, np.zeros((0, 3))
    n, m, gains = len(f), 0, 0
    kinds, ends, values, way = np.empty(2 * n, np.int64), np.empty((2 * n, 2)), np.empty((2 * n, 2)), np.empty(2 * n)
    for kind in (LOG_SIZE, SINE):
        rising, level = course(kind, loop), 1.0 if kind == LOG_SIZE else 0.0
        for k in range(n - 1):
            # the exact objective decides only if both ends are near the level
            if min(rising[k], rising[k + 1]) > level + NARROW or max(rising[k], rising[k + 1]) < level - NARROW:
                continue
            a, b = objective(kind, 0.0, loop[k], zones), objective(kind, 0.0, loop[k + 1], zones)
            if (a >= 0.0) == (b >= 0.0):
                continue
            if kind == SINE:
                # the sign of Im L at Nyquist is a rounding error
                at_end = t.finite_end and k == n - 2 and abs(b) < REAL
                if at_end or past[k] > 0 or not (loop[k].real < 0.0 or loop[k + 1].real < 0.0):
                    continue
            kinds[m], ends[m, 0], ends[m, 1], values[m, 0], values[m, 1] = kind, f[k], f[k + 1], a, b
            way[m] = (1.0 if b >= 0.0 else -1.0) if kind == LOG_SIZE else (1.0 if a >= 0.0 else -1.0)
            m += 1
        if kind == LOG_SIZE:
            gains = m
    found = solving.roots(kinds[:m], ends[:m], values[:m], source, zones)
    there = values_at(found, source)
    hz, at, turn = np.empty(m - gains + 2), np.empty(m - gains + 2, np.complex128), np.empty(m - gains + 2, np.int64)
    # the limits at zero frequency and at the end are real and are included if negative
    count, first, last = 0, loop[0], loop[n - 1]
    if t.slope_at_zero == 0 and t.at_zero < 0.0 and abs(first.imag) < 0.1 * abs(first):
        hz[count], at[count], turn[count] = 0.0, complex(t.at_zero, 0.0), 0
        count += 1
    for k in range(gains, m):
        if there[k].real < 0.0 and 1.0 / FARTHEST < abs(there[k]) < FARTHEST:
            hz[count], at[count], turn[count] = found[k], there[k], int(way[k])
            count += 1
    if t.slope_at_end == 0 and last.real < 0.0 and abs(last.imag) < (REAL if t.finite_end else 0.1) * abs(last):
        hz[count], at[count], turn[count] = f[n - 1] if t.finite_end else np.inf, complex(last.real, 0.0), 0
        count += 1
    every = Crossings(
        found[:gains].copy(), there[:gains].copy(), way[:gains].astype(np.int64), hz[:count], at[:count], turn[:count]
    )
    f, loop, _ = merged(f, loop, found, source)
    return every, f, loop


@formula
def growing_count(closed: ComplexArray, lowest_radps: float) -> int:
    """Return the number of closed-loop poles in the right half plane or on the axis.

    Poles slower than `lowest_radps` are drift and are excluded.
    """
    count = 0
    for p in closed:
        if abs(p) > lowest_radps and p.real >= -ON_AXIS * abs(p):
            count += 1
    return count


@routine
def _wrapped(turn: float) -> float:
    return float((turn + 0.5 * TWO_PI) % TWO_PI - 0.5 * TWO_PI)


@routine
def _real_angle(x: complex) -> float:
    return 0.0 if x.real >= 0.0 else 0.5 * TWO_PI


@routine
def encirclement_count(t: Trace, every: Crossings, past: IntArray, before: Trace, open_: ComplexArray) -> int:
    """Return the number of unstable zeros of 1 + L, from the turns of the curve about -1.

    Unstable zeros are in the right half plane (outside the unit circle):

        zeros = poles - turn of 1 + L over the upper half / pi

    Each solved crossing of the real axis beyond -1 moves the argument to the next branch, so that the number is exact.
    The path follows the axis upwards from a quarter circle about s = 0 (z = 1). It passes poles on the axis on their
    right, and ends at the real limit of L at infinity (z = -1). `before` is the curve without its crossings, and `past`
    contains the number of poles in each of its intervals.
    """
    loop, lowest, right, branches = t.loop, TWO_PI * t.frequency_hz[0], 0, 0
    for p in open_:
        right += 1 if abs(p) > lowest and p.real > ON_AXIS * abs(p) else 0
    for i in range(len(every.phase_hz)):
        branches += int(every.phase_way[i]) if abs(every.phase_loop[i]) > 1.0 else 0
    # half circles around poles on the axis: number of clockwise crossings of the branch cut
    for k in np.flatnonzero(past):
        here, there = angle(1.0 + before.loop[k]), angle(1.0 + before.loop[k + 1])
        clockwise = past[k] * 0.5 * TWO_PI + _wrapped(here - there - past[k] * 0.5 * TWO_PI)
        branches -= round_((clockwise - (here - there)) / TWO_PI)
    # the sign of Im L at Nyquist is a rounding error, so the last step takes the short way to the real axis
    last = len(loop) - (2 if t.finite_end else 1)
    turn = _first_turn(loop[0], t.slope_at_zero) + angle(1.0 + loop[last]) - angle(1.0 + loop[0])
    turn += TWO_PI * branches
    turn += _wrapped(_real_angle(1.0 + loop[len(loop) - 1]) - angle(1.0 + loop[last]))
    return round_(right - turn / (0.5 * TWO_PI))


@routine
def _first_turn(first: complex, slope_at_zero: int) -> float:
    """Return the turn of 1 + L (rad) from the real axis to the first point, on a small quarter circle about s = 0."""
    order = -slope_at_zero if abs(first) > 1.0 else 0
    if order == 0:
        return _wrapped(angle(1.0 + first) - _real_angle(1.0 + first))
    # L = K / s^n begins real and large compared with 1; for n < 0, zeros of L and slow zeros of 1 + L are below
    unit = 1.0 + 0j
    for _ in range(abs(order)):
        unit = unit * (1j if order > 0 else -1j)
    begin = _real_angle(first * unit)
    arrived = begin - order * 0.25 * TWO_PI
    return arrived - begin + _wrapped(angle(1.0 + first) - arrived)
