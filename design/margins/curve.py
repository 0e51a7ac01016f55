"""The frequency response of a loop, its crossings of the unit circle and the real axis, and its turns about -1.

The response is computed on a grid adapted to its poles, so that no narrow feature lies between two points.

Each pole of L and each zero of 1 + L is surrounded by points at offsets that grow from a fraction of its half
width (its real part) in steps of 1 + sqrt(2), so a resonance's circle is drawn with some twenty points whether its
damping ratio is 0.05 or 1e-6. Zeros of L, which the protocol does not give, turn its phase: intervals over which
the phase of L or of 1 + L turns by more than TURN_RAD are halved until none is left. `refine_extremes` adds the turning
points: peaks of |L|, least distances, and near misses between two points of the grid.

Unstable poles of the closed loop are counted twice: from their list, and by the argument principle from L alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from maxq.control.kernel.records import Array, IntArray
from maxq.design.loop.loop import OpenLoop
from maxq.design.margins import solving
from maxq.design.model.state_space import ComplexArray

LOWEST_HZ = 1e-5  # a root slower than this (4 hours) is drift and not part of the loop's dynamics
PER_DECADE = 16
PER_DECADE_FLAT = 6  # below the slowest and above the fastest pole
TURN_RAD = 0.6
FLOOR = 1e-4  # where |L| is below this (-80 dB) its phase is of no interest
NARROW = 1e-12  # relative: an interval that is not halved any more
MOST_POINTS = 200_000
FARTHEST = 1e9  # a sign change of Im L where |L| is beyond this, or below its inverse, is a pole or zero on the axis
REAL = 1e-6  # |Im L| / |L| below which the end of the curve is real
ASYMPTOTIC, DRIFT_UP_TO_HZ = 4.0, 1e-3  # a factor in frequency; a quarter of an hour
ON_AXIS = 1e-9  # |Re p| / |p| below which a pole lies on the axis
OSCILLATING = 0.5  # damping ratio below which a pole gets points of its own

LOWEST_PEAK = np.log(1e-3)  # peaks below -60 dB are not refined
REACH = 4.0  # a minimum may lie lower than its parabola by this many times the parabola's drop

_DISTANCES = (solving.sensitivity, solving.complementary, solving.symmetric)
_OBJECTIVES = (*_DISTANCES, solving.minus_log_size, solving.log_size, solving.sine, solving.minus_sine)
_STEPS = (1.0 + np.sqrt(2.0)) ** np.arange(-1.0, 24.0)
_OFFSETS = np.concatenate([-_STEPS[::-1], [0.0], _STEPS])


@dataclass(frozen=True)
class Curve:
    """L at rising frequencies, and the poles (rad/s) that the grid is made of; `finite_end`: it ends at Nyquist.

    `at_zero` is the limit of L at zero frequency where `slope_at_zero` is 0 (there L is real and even in f).
    `slope_at_zero` and `slope_at_end` are n of the asymptotes L ~ (j f)^n; that at the end is 0 at Nyquist.
    """

    source: OpenLoop
    frequency_hz: Array
    loop: ComplexArray
    open_poles: ComplexArray
    closed_poles: ComplexArray
    slope_at_zero: int
    at_zero: float
    slope_at_end: int
    finite_end: bool

    def with_points(self, frequency_hz: Array, loop: ComplexArray) -> Curve:
        """The same with points added; those that are there already are left out."""
        f, values = np.append(self.frequency_hz, frequency_hz), np.append(self.loop, loop)
        order = np.argsort(f, kind="stable")
        f, values = f[order], values[order]
        new = np.append(True, np.diff(f) > 0.0)
        return replace(self, frequency_hz=f[new], loop=values[new])

    def steps_past_poles(self) -> list[tuple[int, int]]:
        """Steps (index of the point before) that pass poles of L on the axis, and how many.

        A pole that is in both lists at the same place cancels in L.
        """
        count = self._on_axis(self.open_poles)
        for k, hidden in self._on_axis(self.closed_poles).items():
            count[k] = count.get(k, 0) - hidden
        return [(k, n) for k, n in count.items() if n > 0]

    def _on_axis(self, p: ComplexArray) -> dict[int, int]:
        chosen = (p.imag > self.lowest_radps) & (np.abs(p.real) <= ON_AXIS * np.abs(p))
        step = np.searchsorted(self.frequency_hz, p[chosen].imag / (2.0 * np.pi)) - 1
        inside = step[(step >= 0) & (step < len(self.frequency_hz) - 1)]
        return {int(k): int(n) for k, n in zip(*np.unique(inside, return_counts=True), strict=True)}

    @property
    def limits(self) -> list[tuple[complex, float]]:
        """L at zero frequency, 1e150 for an infinite one, and of a continuous loop at infinity, with the frequency."""
        at_zero = self.at_zero if self.slope_at_zero == 0 else 0.0 if self.slope_at_zero > 0 else 1e150
        at_end = self.loop[-1].real if self.slope_at_end == 0 else 0.0
        return [(complex(at_zero), 0.0), *([] if self.finite_end else [(complex(at_end), np.inf)])]

    @property
    def lowest_radps(self) -> float:
        """Poles slower than this are drift."""
        return float(2.0 * np.pi * self.frequency_hz[0])


def lowest_hz_of(open_poles: ComplexArray) -> float:
    """Where the curve of a loop with these poles (rad/s) begins: LOWEST_HZ, or above drift that it would begin amid.

    In thin air path and attitude have slow roots of a few hours, beside which L has no asymptote to begin on.
    """
    low = LOWEST_HZ
    for hz in np.sort(np.abs(open_poles[np.isfinite(open_poles)])) / (2.0 * np.pi):
        if low / ASYMPTOTIC < hz < ASYMPTOTIC * low:
            low = ASYMPTOTIC * float(hz)
    return low if low <= DRIFT_UP_TO_HZ else LOWEST_HZ


def trace(loop: OpenLoop, lowest_hz: float = LOWEST_HZ) -> Curve:
    """Compute the curve. Raises ValueError for a response that is not finite, an improper loop, a bad `lowest_hz`."""
    end = float(loop.highest_hz)
    if not 0.0 < lowest_hz < end:
        raise ValueError(f"lowest_hz is {lowest_hz:g}: must lie between 0 and the loop's end at {end:g} Hz")
    open_poles, closed_poles = _finite(loop.open_poles(), "open"), _finite(loop.closed_poles(), "closed")
    poles = np.concatenate([open_poles, closed_poles])
    poles = poles[(poles.imag >= 0.0) & (np.abs(poles) > 2.0 * np.pi * lowest_hz)]
    slope_at_zero, at_zero = _start(loop, lowest_hz, end)
    finite_end = bool(np.isfinite(end))
    end, at_end = (end, 0) if finite_end else _end(loop, poles, lowest_hz)
    grid = _grid(poles, lowest_hz, end, finite_end)
    f, values = _refine(loop, grid, solving.sample(loop, grid))
    return Curve(loop, f, values, open_poles, closed_poles, slope_at_zero, at_zero, at_end, finite_end)


def _finite(poles: ComplexArray, kind: str) -> ComplexArray:
    """Poles without those at minus infinity (a sampled loop's z = 0)."""
    p = np.atleast_1d(np.asarray(poles, np.complex128))
    p = p[np.abs(p.real) != np.inf]
    if not np.isfinite(p).all():
        raise ValueError(f"{kind}-loop poles are not numbers: {p[~np.isfinite(p)][0]}")
    return np.asarray(p)


def _start(loop: OpenLoop, lowest_hz: float, end: float) -> tuple[int, float]:
    """Slope at the beginning, and the limit at zero frequency."""
    values = solving.sample(loop, np.minimum(lowest_hz * np.array([1.0, 2.0]), end))
    size = np.abs(values)
    if size.min() == 0.0:
        return 0, float(values.real[0])
    return round(float(np.log2(size[1] / size[0]))), float((4.0 * values.real[0] - values.real[1]) / 3.0)


def _end(loop: OpenLoop, poles: ComplexArray, lowest_hz: float) -> tuple[float, int]:
    """Where a continuous loop has reached its asymptote or is too small to matter, and the asymptote's slope."""
    fastest = max(float(np.abs(poles).max()) / (2.0 * np.pi) if len(poles) else 1.0, 100.0 * lowest_hz)
    f = 30.0 * fastest * 10.0 ** np.arange(7.0)
    values = solving.sample(loop, np.concatenate([f, 1.1 * f]))
    size, later = np.abs(values[:7]), np.abs(values[7:])
    with np.errstate(all="ignore"):
        slope = np.log(later / size) / np.log(1.1)
    quarter = np.angle(values[:7]) / (0.5 * np.pi)
    level = np.round(slope) == 0.0  # then the end may lie near -1, otherwise it is far away
    settled = np.abs(slope - np.round(slope)) < np.where(level, 1e-4, 0.01)
    settled &= np.abs(quarter - np.round(quarter)) < np.where(level, 1e-4, 0.02)
    small = size < FLOOR
    k = int(np.argmax(settled | small)) if (settled | small).any() else 6
    n = round(float(slope[k])) if np.isfinite(slope[k]) else -1
    if n > 0 and size[k] > 0.0 and (settled[k] or not small[k]):
        raise ValueError(f"the loop is improper: |L| grows without bound, {size[k]:.3g} at {f[k]:.3g} Hz")
    # a pure delay keeps turning: small from here on, or level
    return float(f[k]), min(n, 0) if settled[k] else -1 if small[k] else 0


def _grid(poles: ComplexArray, lowest_hz: float, end: float, finite_end: bool) -> Array:
    size = np.abs(poles) / (2.0 * np.pi)
    slow, fast = (float(size.min()), float(size.max())) if len(size) else (1.0, 1.0)
    slow, fast = (min(max(x, 2.0 * lowest_hz), 0.5 * end) for x in (0.3 * slow, 3.0 * fast))
    parts = [
        _decades(lowest_hz, slow, PER_DECADE_FLAT),
        _decades(slow, fast, PER_DECADE),
        _decades(fast, end, PER_DECADE_FLAT),
    ]
    swinging = poles[(poles.imag > 0.0) & (np.abs(poles.real) < OSCILLATING * np.abs(poles))]
    if len(swinging):
        # a pole on the axis: L is infinite there
        width = np.maximum(np.abs(swinging.real), ON_AXIS * np.abs(swinging))
        near = swinging.imag[:, None] + width[:, None] * _OFFSETS
        exact = np.abs(swinging.real) < ON_AXIS * np.abs(swinging)
        near[exact, len(_STEPS)] = lowest_hz * 2.0 * np.pi
        inside = np.abs(width[:, None] * _OFFSETS) < 0.7 * swinging.imag[:, None]
        parts.append(near[inside] / (2.0 * np.pi))
    parts.append(np.array([lowest_hz, end]))
    if finite_end:
        parts.append(np.array([end * (1.0 - 1e-6)]))
    f = np.sort(np.concatenate(parts))
    f = f[(f >= lowest_hz) & (f <= end)]
    return np.asarray(f[np.append(True, np.diff(f) > NARROW * f[1:])])


def _decades(low: float, high: float, density: int) -> Array:
    n = max(2, int(np.ceil(density * np.log10(max(high / low, 1.001)))))
    return np.asarray(np.geomspace(low, high, n, endpoint=False))


def _refine(loop: OpenLoop, f: Array, values: ComplexArray) -> tuple[Array, ComplexArray]:
    """Halve intervals over which L or 1 + L turns too far, and much wider ones beside them."""
    fresh = np.ones(len(f) - 1, bool)
    for _ in range(40):
        coarse = fresh & (_turn(values) > TURN_RAD) & (np.maximum(np.abs(values[1:]), np.abs(values[:-1])) > FLOOR)
        coarse |= fresh & (_turn(1.0 + values) > TURN_RAD)
        width = np.diff(f)
        coarse &= width > 1e3 * NARROW * f[1:]
        if not coarse.any():
            break
        # a turn by a multiple of 2 pi looks like none: refine beside intervals that turn
        wide = np.where(coarse, 0.5 * width, np.inf)
        beside = np.minimum(np.append(wide[1:], np.inf), np.append(np.inf, wide[:-1]))
        coarse |= width > 4.0 * beside
        k = np.flatnonzero(coarse)
        if len(f) + len(k) > MOST_POINTS:
            raise ValueError(f"the loop's phase turns too often to be followed: {len(f)} points up to {f[-1]:.3g} Hz")
        middle = 0.5 * (f[k] + f[k + 1])
        f, values = np.insert(f, k + 1, middle), np.insert(values, k + 1, solving.sample(loop, middle))
        fresh = np.zeros(len(f) - 1, bool)
        first = k + np.arange(len(k))
        fresh[first] = fresh[first + 1] = True
    return f, values


def _turn(values: ComplexArray) -> Array:
    return np.asarray(np.abs(np.angle(values[1:] * np.conj(values[:-1]))))


def refine_extremes(curve: Curve) -> Curve:
    """The curve with its turning points solved for and added.

    They are the minima of |1 + L|, |1 + 1/L| and |1 + L|/|1 - L| that may be the least of all, the maxima of |L|,
    and those of |L| and of the phase that may reach 1 and 180 degrees where the points of the grid do not.
    """
    return with_minima(curve, _OBJECTIVES, [_candidates(curve, k) for k in range(len(_OBJECTIVES))])


def with_minima(
    curve: Curve, objectives: Sequence[solving.Objective], found: Sequence[tuple[IntArray, Array]]
) -> Curve:
    """The curve with minima solved for and added, from `brackets` of each objective (their numbers, the values)."""
    kind = np.concatenate([np.full(len(middle), k) for k, (middle, _) in enumerate(found)])
    middle, values = (np.concatenate(parts) for parts in zip(*found, strict=True))
    if not len(middle):
        return curve
    points = curve.frequency_hz[middle[:, None] + np.arange(-1, 2)]
    lowest = solving.minima(solving.along(curve.source, objectives, kind), points, values)
    return curve.with_points(lowest, solving.sample(curve.source, lowest))


def _candidates(curve: Curve, k: int) -> tuple[IntArray, Array]:
    """Middle points of brackets worth refining for an objective, and the values (brackets, 3) there."""
    objective = _OBJECTIVES[k]
    value = objective(curve.loop)
    middle, around = brackets(value)
    here, f = around[:, 1], curve.frequency_hz
    _, drop = solving.vertex(f[middle - 1], f[middle], f[middle + 1], *around.T)
    reachable = here - REACH * drop
    if objective in _DISTANCES:
        worth = reachable <= value.min()
    elif objective is solving.minus_log_size:
        worth = here < -LOWEST_PEAK
    elif objective is solving.log_size:
        worth = (here > 0.0) & (reachable < 0.0)
    else:
        worth = (here > 0.0) & (reachable < 0.0) & (curve.loop.real[middle] < 0.0)
    return middle[worth], around[worth]


def brackets(value: Array) -> tuple[IntArray, Array]:
    """Inner points that are not above either neighbour and below one: their numbers, and the three values."""
    left, here, right = value[:-2], value[1:-1], value[2:]
    middle = 1 + np.flatnonzero((here <= left) & (here <= right) & ((here < left) | (here < right)))
    return middle, value[middle[:, None] + np.arange(-1, 2)]


@dataclass(frozen=True)
class GainCrossings:
    """|L| = 1, in rising order of frequency, (n,) each."""

    frequency_hz: Array
    loop: ComplexArray
    rising: NDArray[np.bool_]  # |L| grows with frequency

    @property
    def phase_margin_deg(self) -> Array:
        """In (-180, 180]: above 0 the lag that reaches -1, below 0 (its size) the lead that does so sooner."""
        return solving.from_minus_one_deg(self.loop)

    @property
    def lag_deg(self) -> Array:
        """Lag in [0, 360) that turns the point on to -1."""
        return np.asarray(np.mod(self.phase_margin_deg, 360.0))

    @property
    def delay_s(self) -> Array:
        """Delay that does."""
        return np.asarray(self.lag_deg / (360.0 * self.frequency_hz))


@dataclass(frozen=True)
class PhaseCrossings:
    """L on the negative real axis, (n,) each; frequency 0 and infinity are limits, the highest one Nyquist.

    `turn` is +1 where the curve crosses from above to below (anticlockwise about the origin), -1 the other way, 0
    at the ends, which it only reaches.
    """

    frequency_hz: Array
    loop: ComplexArray
    turn: IntArray

    @property
    def gain_margin_db(self) -> Array:
        """Above 0 the increase of gain that reaches -1, below 0 (its size) the decrease that does."""
        return np.asarray(-solving.DB * solving.log_size(self.loop))


def find_crossings(curve: Curve) -> tuple[GainCrossings, PhaseCrossings, Curve]:
    """All of them, and the curve with them added."""
    f, loop = curve.frequency_hz, curve.loop
    size, angle = solving.log_size(loop), solving.sine(loop)
    gain = np.flatnonzero((size[1:] >= 0.0) != (size[:-1] >= 0.0))
    change = (angle[1:] >= 0.0) != (angle[:-1] >= 0.0)
    if curve.finite_end and abs(angle[-1]) < REAL:  # at Nyquist the sign of Im L is rounding
        change[-1] = False
    for step, _ in curve.steps_past_poles():
        change[step] = False
    phase = np.flatnonzero(change & ((loop.real[1:] < 0.0) | (loop.real[:-1] < 0.0)))
    k = np.concatenate([gain, phase])
    kind = np.concatenate([np.zeros(len(gain), int), np.ones(len(phase), int)])
    ends = np.stack([np.where(kind == 0, size[k + j], angle[k + j]) for j in (0, 1)])
    along = solving.along(curve.source, (solving.log_size, solving.sine), kind)
    found = solving.roots(along, f[k], f[k + 1], ends[0], ends[1])
    values = solving.sample(curve.source, found)
    at_gain, from_above = kind == 0, angle[k] >= 0.0
    magnitude = np.abs(values)
    at_phase = ~at_gain & (values.real < 0.0) & (magnitude > 1.0 / FARTHEST) & (magnitude < FARTHEST)
    turns = np.where(from_above[at_phase], 1, -1)
    inner = PhaseCrossings(found[at_phase], values[at_phase], turns)
    crossed = GainCrossings(found[at_gain], values[at_gain], (size[k + 1] >= 0.0)[at_gain])
    return crossed, _with_ends(inner, curve), curve.with_points(found, values)


def _with_ends(inner: PhaseCrossings, curve: Curve) -> PhaseCrossings:
    """The limits at zero frequency and at the end are real: they count where they are negative."""
    f, loop, turn = inner.frequency_hz, inner.loop, inner.turn
    first, last = curve.loop[0], curve.loop[-1]
    if curve.slope_at_zero == 0 and curve.at_zero < 0.0 and abs(first.imag) < 0.1 * abs(first):
        f, loop, turn = np.append(0.0, f), np.append(curve.at_zero + 0j, loop), np.append(0, turn)
    real = REAL if curve.finite_end else 0.1
    if curve.slope_at_end == 0 and last.real < 0.0 and abs(last.imag) < real * abs(last):
        end = curve.frequency_hz[-1] if curve.finite_end else np.inf
        f, loop, turn = np.append(f, end), np.append(loop, last.real + 0j), np.append(turn, 0)
    return PhaseCrossings(f, loop, turn.astype(np.int64))


def unstable(poles: ComplexArray, lowest_radps: float) -> ComplexArray:
    """Poles to the right of the axis, and on it. Those slower than `lowest_radps` are drift and left out."""
    size = np.abs(poles)
    return np.asarray(poles[(size > lowest_radps) & (poles.real >= -ON_AXIS * size)])


def encirclement_count(curve: Curve, crossings: PhaseCrossings) -> int:
    """Zeros of 1 + L in the right half plane (outside the unit circle), from the curve's turns about -1.

    Each solved crossing of the real axis beyond -1 moves the argument from one branch to the next, so the number is
    exact. The path goes up the axis from a quarter circle about s = 0 (z = 1), passes poles on the axis on their
    right, and ends at the real limit of L at infinity (z = -1):

        zeros = poles - turn of 1 + L over the upper half / pi.
    """
    poles = curve.open_poles
    size = np.abs(poles)
    right = (size > curve.lowest_radps) & (poles.real > ON_AXIS * size)
    distance = 1.0 + curve.loop
    beyond = (np.abs(crossings.loop) > 1.0) & (crossings.turn != 0)
    branches = int(crossings.turn[beyond].sum()) - _past_axis_poles(curve)
    # at Nyquist the sign of Im L is rounding: the last step is the short way to the real axis
    last = -2 if curve.finite_end else -1
    turn = _first_turn(curve) + np.angle(distance[last]) - np.angle(distance[0]) + 2.0 * np.pi * branches
    end = np.angle(complex((1.0 + curve.loop[-1]).real))
    turn += solving.wrapped(float(end - np.angle(distance[last])), np.pi)
    return round(float(right.sum() - turn / np.pi))


def _first_turn(curve: Curve) -> float:
    """Turn of 1 + L from the positive real axis to the first point, on a small quarter circle about the origin."""
    first = curve.loop[0]
    order = -curve.slope_at_zero if abs(first) > 1.0 else 0
    if order == 0:
        begin = float(np.angle(complex((1.0 + first).real)))
        return solving.wrapped(float(np.angle(1.0 + first)) - begin, np.pi)
    # L = K / s^n is real at the beginning, and large against 1; with n < 0 it has zeros, and 1 + L drift, below
    begin = float(np.angle(complex((first * 1j**order).real)))
    arrived = begin - order * np.pi / 2.0
    return arrived - begin + solving.wrapped(float(np.angle(1.0 + first)) - arrived, np.pi)


def _past_axis_poles(curve: Curve) -> int:
    """How often the half circles to the right of poles on the axis cross from -pi to pi (clockwise)."""
    count = 0
    for k, order in curve.steps_past_poles():
        before, after = (float(np.angle(1.0 + curve.loop[j])) for j in (k, k + 1))
        clockwise = order * np.pi + solving.wrapped(before - after - order * np.pi, np.pi)
        count += round((clockwise - (before - after)) / (2.0 * np.pi))
    return count
