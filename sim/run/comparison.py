"""The comparison of a flight or its log with measured series: time shift, residuals, and their statistics.

The time shift is that with the least sum of squares. Its standard error is that of least squares with correlated
residuals: the long-run variance of the scores (Newey and West, Econometrica 55, 1987; bandwidth sqrt(n)) over the
square of the information. A model error that lasts as long as the series is not included.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from maxq.control.kernel.records import Array
from maxq.sim.log.tabular import Tabular
from maxq.sim.run.measured import MeasuredChannel, MeasuredSeries
from maxq.sim.run.quantities import meets

MOST_SHIFT_S = 10.0
_FEWEST, _MOST_TRIALS, _MOST_POINTS, _ITERATIONS = 3, 2001, 1000, 30
_TURN = {"deg": 360.0}
STATISTICS = {"rms": "RMS", "largest": "largest residual", "bias": "bias"}


class ComparisonError(Exception):
    """The error of series that cannot be compared, in one line."""


class Modelled:
    """A channel of a flight as a continuous function of time: linear between its rows, with angles unwrapped."""

    def __init__(self, time_s: Array, values: Array, unit: str) -> None:
        known = np.isfinite(values)
        self.time_s, self.values, self.unit = time_s[known], unwrapped(values[known], unit), unit

    @classmethod
    def of(cls, source: Tabular, name: str) -> Modelled:
        """Return a channel of a flight or its log."""
        return cls(source.time_s(name), source[name], source.table.channel(name).unit)

    @property
    def span_s(self) -> tuple[float, float]:
        """Return the first and the last time, s; an empty span without values."""
        return (float(self.time_s[0]), float(self.time_s[-1])) if len(self.time_s) else (math.inf, -math.inf)

    def inside(self, time_s: Array) -> np.ndarray:
        """Return a mask of the times within the span of the channel, apart from rounding."""
        first, last = self.span_s
        return np.asarray((time_s >= first - 1e-9) & (time_s <= last + 1e-9))

    def at(self, time_s: Array) -> Array:
        return np.asarray(np.interp(time_s, self.time_s, self.values))

    def slope(self, time_s: Array) -> Array:
        """Return the central difference over two rows, per second."""
        h = float(np.median(np.diff(self.time_s)))
        first, last = self.span_s
        ahead, behind = np.minimum(time_s + h, last), np.maximum(time_s - h, first)
        return np.asarray((self.at(ahead) - self.at(behind)) / np.maximum(ahead - behind, 1e-12))


def unwrapped(values: Array, unit: str) -> Array:
    """Return values over time without jumps by a full turn, if they are angles."""
    return np.unwrap(values, period=_TURN[unit]) if unit in _TURN else values


def difference(measured: Array, modelled: Array, unit: str) -> Array:
    """Return measured minus modelled values; of angles, the difference within half a turn."""
    out = measured - modelled
    return out - _TURN[unit] * np.rint(out / _TURN[unit]) if unit in _TURN else out


@dataclass(frozen=True)
class ResidualLimit:
    """A limit of a comparison: of a channel's RMS, largest residual, or bias, all as absolute values."""

    channel: str
    statistic: str
    bound: float


@dataclass(frozen=True)
class Residuals:
    """A channel in the comparison, at its measured times within the flight: times, both values, and the residual.

    Times are those of the flight. The residual is measured minus modelled. `share` is the RMS over the range of the
    measured values (nan if it is 0), and `outside` the number of measured values outside the flight.
    """

    measured: MeasuredChannel
    time_s: Array
    modelled: Array
    residual: Array
    outside: int

    @property
    def name(self) -> str:
        return self.measured.name

    @property
    def values(self) -> Array:
        """Return the measured values (n,)."""
        return self.modelled + self.residual

    @property
    def rms(self) -> float:
        return float(np.sqrt(np.mean(self.residual**2)))

    @property
    def bias(self) -> float:
        return float(np.mean(self.residual))

    @property
    def worst(self) -> int:
        """Return the index of the residual with the largest absolute value."""
        return int(np.argmax(np.abs(self.residual)))

    @property
    def largest(self) -> float:
        return float(self.residual[self.worst])

    @property
    def share(self) -> float:
        extent = float(np.ptp(self.values))
        return self.rms / extent if extent > 0.0 else math.nan

    def value_of(self, statistic: str) -> float:
        """Return the absolute value of one of STATISTICS."""
        return abs(float(getattr(self, statistic)))

    def as_json(self) -> dict[str, Any]:
        return {
            "channel": self.name,
            "heading": self.measured.heading,
            "unit": self.measured.unit,
            "values": len(self.residual),
            "outside_flight": self.outside,
            "gaps": self.measured.gaps,
            "rms": self.rms,
            "bias": self.bias,
            "largest": self.largest,
            "largest_at_s": float(self.time_s[self.worst]),
            "rms_over_range": None if math.isnan(self.share) else self.share,
        }


@dataclass(frozen=True)
class SeriesComparison:
    """The residuals of all channels for a time shift, s: flight time = measured time + shift.

    `shift_sigma_s` is its standard error, nan for a given shift. `at_end` is True if the best shift is the largest
    allowed.
    """

    shift_s: float
    shift_sigma_s: float
    at_end: bool
    channels: tuple[Residuals, ...]

    def violated(self, limits: Sequence[ResidualLimit]) -> list[ResidualLimit]:
        """Return the limits that are exceeded."""
        known = {each.name: each for each in self.channels}
        return [m for m in limits if not meets(known[m.channel].value_of(m.statistic), "limit", m.bound)]


def compare(
    source: Tabular, measured: MeasuredSeries, shift_s: float | None = None, most_shift_s: float = MOST_SHIFT_S
) -> SeriesComparison:
    """Return the comparison for a given shift, s, or for the best shift within `most_shift_s`.

    Raises ComparisonError if no channel overlaps in time, or if no channel changes, so that no shift is the best.
    """
    models = {each.name: Modelled.of(source, each.name) for each in measured.channels}
    pairs = [(each, models[each.name]) for each in measured.channels]
    sigma_s, at_end = math.nan, False
    if shift_s is None:
        shift_s, sigma_s, at_end = _estimated(pairs, most_shift_s)
    found = []
    for each, model in pairs:
        time_s = each.time_s + shift_s
        inside = model.inside(time_s)
        if inside.sum() >= _FEWEST:
            modelled, values = model.at(time_s[inside]), unwrapped(each.values, each.unit)[inside]
            residual = difference(values, modelled, each.unit)
            found.append(Residuals(each, time_s[inside], modelled, residual, int(len(inside) - inside.sum())))
    if not found:
        raise ComparisonError(no_overlap(pairs, shift_s))
    return SeriesComparison(shift_s, sigma_s, at_end, tuple(found))


def no_overlap(pairs: Sequence[tuple[MeasuredChannel, Modelled]], shift_s: float) -> str:
    """Return a message on series that do not overlap."""
    first, last = pairs[0][1].span_s
    measured = pairs[0][0].time_s + shift_s
    text = f"the times do not overlap: flight {first:g} to {last:g} s, measured {measured[0]:g} to {measured[-1]:g} s"
    return text + (f" with a shift of {shift_s:g} s" if shift_s else "") + "; give the shift by --shift"


def _estimated(pairs: Sequence[tuple[MeasuredChannel, Modelled]], most_s: float) -> tuple[float, float, bool]:
    """Return the best shift within +-`most_s`, its standard error, and True if it is at an end of this range."""
    scales = [each.sigma for each, _ in pairs]
    if not np.isfinite(scales).all():
        scales = [float(np.ptp(each.values)) or 1.0 for each, _ in pairs]
    series = [
        (each.time_s, unwrapped(each.values, each.unit), model, scale)
        for (each, model), scale in zip(pairs, scales, strict=True)
    ]
    thin = [(t[:: (k := len(t) // _MOST_POINTS + 1)], y[::k], model, scale) for t, y, model, scale in series]
    step_s = max(0.5 * min(float(np.median(np.diff(t))) for t, *_ in series), 2.0 * most_s / (_MOST_TRIALS - 1))
    count = max(math.ceil(most_s / step_s), 1)
    trials = np.linspace(-most_s, most_s, 2 * count + 1)
    weights = [sum(int(model.inside(t + trial).sum()) for t, _, model, _ in thin) for trial in trials]
    if max(weights) < _FEWEST:
        raise ComparisonError(no_overlap(pairs, 0.0))
    costs = np.full(len(trials), math.inf)
    for k, (trial, weight) in enumerate(zip(trials, weights, strict=True)):
        if 2 * weight >= max(weights):  # a short overlap may fit by chance
            costs[k] = sum(float(np.sum(r**2)) for r, _ in _scores(thin, trial)) / weight
    k = int(np.argmin(costs))
    start, width = float(trials[k]), float(trials[1] - trials[0])
    shift = start
    for _ in range(_ITERATIONS):
        parts = _scores(series, shift)
        information = sum(float(np.sum(slope**2)) for _, slope in parts)
        if not information > 0.0:
            raise ComparisonError("no measured channel changes, so that no time shift is the best; give it by --shift")
        move = sum(float(np.sum(r * slope)) for r, slope in parts) / information
        before, shift = shift, float(np.clip(shift + move, start - 2.0 * width, start + 2.0 * width))
        if abs(shift - before) < 1e-9:
            break
    parts = _scores(series, shift)
    information = sum(float(np.sum(slope**2)) for _, slope in parts)
    variance = sum(_long_run(r * slope) for r, slope in parts)
    at_end = len(trials) > 1 and k in (0, len(trials) - 1)
    return shift, math.sqrt(max(variance, 0.0)) / information, at_end


def _scores(series: Sequence[tuple[Array, Array, Modelled, float]], shift: float) -> list[tuple[Array, Array]]:
    """Return residuals and slopes over their scales, (n,) each, of each series inside the flight."""
    out = []
    for t, y, model, scale in series:
        inside = model.inside(t + shift)
        at = t[inside] + shift
        out.append((difference(y[inside], model.at(at), model.unit) / scale, model.slope(at) / scale))
    return out


def _long_run(scores: Array) -> float:
    """Return n times the long-run variance of scores (n,) with mean 0: Bartlett's weights up to sqrt(n)."""
    n = len(scores)
    most = math.isqrt(n)
    total = float(scores @ scores)
    for lag in range(1, most + 1):
        total += 2.0 * (1.0 - lag / (most + 1.0)) * float(scores[lag:] @ scores[:-lag])
    return total
