"""Lobes: the loops that lightly damped poles draw in the Nyquist plane, each found, named and judged by itself.

Near a pole at p = -sigma + j w0 the response is R / (s - p) plus what the rest of the loop contributes. The second
difference over the half width, u = 2 L(w0) - L(w0 + sigma) - L(w0 - sigma), is R / sigma up to the curvature of the
rest. The lobe is where that term is larger than SHARE times the rest, at least LEAST half widths to either side. It
ends where another lobe's term is larger, and in the valleys of |L| on both sides of its peak.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from maxq.control.kernel.records import Array, IntArray
from maxq.design.loop.resonance import Resonance
from maxq.design.margins.curve import Curve, GainCrossings, PhaseCrossings
from maxq.design.margins.solving import DB, along, from_minus_one_deg, log_size, minima, sample
from maxq.design.model.state_space import ComplexArray

SHARE = 0.5
VALLEY = 0.5  # a minimum of |L| below this share of the peak ends a lobe
LEAST = 2.0
LIGHT = 0.1  # damping ratio below which an unnamed pole makes a lobe
SECTION, SECTIONS = 16, 5  # a lobe's end is searched among so many parts of a step, so many times: a millionth of it
VISIBLE = 0.01  # an unnamed pole whose term is a smaller share of |L| than this makes none
ROUNDING_DB = 1e-9  # of a crossing of |L| = 1 at the end of a lobe

Stabilised = Literal["gain", "phase"]


@dataclass(frozen=True)
class Lobe:
    """One resonance in the loop. Margins are those of the lobe alone: infinite where nothing in it bounds them.

    `stabilised` is "gain" where the peak lies at least the limit below 0 dB, whatever its phase, else "phase". Lag and
    lead margins of a phase-stabilised lobe are the least over its crossings of |L| = 1, or, without one inside it, over
    its points above 0 dB; those of a gain-stabilised one are infinite. `conditional`: less gain would destabilise, for
    the lobe crosses the negative real axis beyond -1.
    """

    label: str
    kind: str  # as the resonance says: "bending", "slosh"; empty for an unnamed pole
    frequency_hz: float  # of the pole
    damping_ratio: float
    low_hz: float
    high_hz: float
    peak_db: float
    peak_hz: float
    peak_phase_deg: float  # of L at the peak, beyond the nearest -180 + 360 k, in (-180, 180]
    stabilised: Stabilised
    gain_up_db: float  # to the crossing of the negative real axis nearest to -1 from inside
    gain_down_db: float
    lag_deg: float
    lead_deg: float
    modulus: float  # least |1 + L|
    contribution: float  # |u| / |L| at the pole: how much of the response there is the resonance

    @property
    def conditional(self) -> bool:
        return bool(np.isfinite(self.gain_down_db))

    @property
    def phase_deg(self) -> float:
        """The lesser of lag and lead."""
        return min(self.lag_deg, self.lead_deg)


def find_lobes(
    curve: Curve, gain: GainCrossings, phase: PhaseCrossings, resonances: Sequence[Resonance] | None, limit_db: float
) -> tuple[Lobe, ...]:
    """Lobes of the named resonances, or of every lightly damped pole that shows; `curve` holds extremes, crossings."""
    f, loop = curve.frequency_hz, curve.loop
    known = _lightly_damped(curve) if resonances is None else resonances
    poles = [r for r in known if f[0] < r.frequency_hz < f[-1]]
    if not poles:
        return ()
    centre = np.array([p.frequency_hz for p in poles])
    width = np.maximum([p.half_width_hz for p in poles], 1e-9 * centre)  # an undamped one: the grid's there
    strength, at_pole = _strengths(curve, centre, width)
    share = np.abs(strength) / np.maximum(np.abs(at_pole), 1e-300)
    shown = np.array([k for k in range(len(poles)) if resonances is not None or share[k] > VISIBLE], int)
    terms = (strength[shown], centre[shown], width[shown])
    inside = _inside(f, loop, *terms)
    runs = [_run(f, loop, inside[j], centre[k]) for j, k in enumerate(shown)]
    ends = _solved_ends(curve, runs, *terms)
    reach = LEAST * width[shown]
    low, high = np.minimum(ends[:, 0], centre[shown] - reach), np.maximum(ends[:, 1], centre[shown] + reach)
    low, high = np.clip(low, f[0], None), np.clip(high, None, f[-1])
    borders = np.unique(np.append(low, high))
    curve = curve.with_points(borders, sample(curve.source, borders)) if len(borders) else curve
    return tuple(
        _judge(curve, poles[k], (float(low[j]), float(high[j])), float(share[k]), gain, phase, limit_db)
        for j, k in enumerate(shown)
    )


def _inside(f: Array, loop: ComplexArray, strength: ComplexArray, centre: Array, width: Array) -> NDArray[np.bool_]:
    """Whether each lobe's term is large against the rest and the largest of all, (lobes, *f.shape)."""
    each = (-1, *(1,) * f.ndim)
    term = strength.reshape(each) / (1.0 + 1j * (f - centre.reshape(each)) / width.reshape(each))
    size = np.abs(term)
    return np.asarray((size > SHARE * np.abs(loop - term)) & (size >= size.max(axis=0, initial=0.0)))


def _lightly_damped(curve: Curve) -> list[Resonance]:
    """Unnamed poles of L."""
    p = curve.open_poles[curve.open_poles.imag > curve.lowest_radps]
    p = p[np.abs(p.real) < LIGHT * np.abs(p)]
    return [Resonance("", 0, float(x.imag / (2.0 * np.pi)), complex(x)) for x in p[np.argsort(p.imag)]]


def _strengths(curve: Curve, centre: Array, width: Array) -> tuple[ComplexArray, ComplexArray]:
    """u, and L at the pole's frequency. A fold at Nyquist mirrors L into its conjugate."""
    f = np.concatenate([centre, centre + width, centre - width])
    top = curve.frequency_hz[-1]
    mirrored = f > top if curve.finite_end else np.zeros(len(f), bool)
    inside = np.clip(np.where(mirrored, 2.0 * top - f, f), curve.frequency_hz[0], None)
    exact = np.isin(f, curve.open_poles.imag[np.abs(curve.open_poles.real) == 0.0] / (2.0 * np.pi))
    values = sample(curve.source, np.where(exact, inside * (1.0 + 1e-9), inside))
    values = np.where(mirrored, np.conj(values), values)
    here, above, below = values.reshape(3, -1)
    return np.asarray(2.0 * here - above - below), here


def _run(
    f: Array, loop: ComplexArray, inside: NDArray[np.bool_], centre: float
) -> tuple[tuple[int, bool] | None, tuple[int, bool] | None] | None:
    """The points before and after the run of `inside` between valleys that holds the centre, and whether they are
    valleys, deep minima of |L|; None where the curve ends, and for no run.
    """
    k, size = int(np.argmin(np.abs(f - centre))), np.abs(loop)
    low = np.append(True, size[1:] <= size[:-1]) & np.append(size[:-1] <= size[1:], True)
    valley = low & (size < VALLEY * size[k])
    outside = np.flatnonzero(~inside | valley)
    if k in outside:
        return None
    left, right = outside[outside < k], outside[outside > k]
    return (
        (int(left[-1]), bool(valley[left[-1]])) if len(left) else None,
        (int(right[0]), bool(valley[right[0]])) if len(right) else None,
    )


def _solved_ends(curve: Curve, runs: Sequence[Any], strength: ComplexArray, centre: Array, width: Array) -> Array:
    """Where the runs end between two points of the curve, (lobes, 2): no matter how dense its points are."""
    f = curve.frequency_hz
    out = np.repeat(centre[:, None], 2, axis=1)
    deep, borders = [], []
    for j, run in enumerate(runs):
        for side, end in enumerate(run or ()):
            if end is None:
                out[j, side] = f[-side]
                continue
            k, valley = end
            out[j, side] = f[k]
            if not valley:
                borders.append((j, side, f[k], f[k + 1 - 2 * side]))
            elif 0 < k < len(f) - 1:
                deep.append((j, side, k))
    if deep:
        k = np.array([place for _, _, place in deep])[:, None] + np.arange(-1, 2)
        kind = np.zeros(len(k), np.int64)
        found = minima(along(curve.source, (log_size,), kind), f[k], log_size(curve.loop[k]))
        for (j, side, _), place in zip(deep, found, strict=True):
            out[j, side] = place
    if borders:
        lobe, sides = (np.array([b[i] for b in borders]) for i in (0, 1))
        outer, inner = (np.array([b[i] for b in borders]) for i in (2, 3))
        for _ in range(SECTIONS):
            x = outer[:, None] + (inner - outer)[:, None] * np.arange(1, SECTION) / SECTION
            there = _inside(x, sample(curve.source, x.ravel()).reshape(x.shape), strength, centre, width)
            there = there[lobe, np.arange(len(lobe))]
            first = np.where(there.any(axis=1), there.argmax(axis=1), SECTION - 1)  # the first that is inside
            x = np.concatenate([outer[:, None], x, inner[:, None]], axis=1)
            each = np.arange(len(lobe))
            outer, inner = x[each, first], x[each, first + 1]
        out[lobe, sides] = inner
    return out


def _judge(
    curve: Curve,
    pole: Resonance,
    ends: tuple[float, float],
    share: float,
    gain: GainCrossings,
    phase: PhaseCrossings,
    limit_db: float,
) -> Lobe:
    low, high = ends
    f = curve.frequency_hz
    points = np.flatnonzero((f >= low) & (f <= high))
    loop = curve.loop[points]
    size = np.abs(loop)
    top = int(np.argmax(size))
    if top in (0, len(points) - 1):  # no peak of its own: a bump on a slope
        top = int(np.argmin(np.abs(f[points] - pole.frequency_hz)))
    peak_db = float(DB * np.log(max(size.max(), 1e-300)))
    at = (phase.frequency_hz >= low) & (phase.frequency_hz <= high)
    db = phase.gain_margin_db[at]
    stabilised: Stabilised = "gain" if peak_db <= ROUNDING_DB - limit_db else "phase"
    lag, lead = (np.inf, np.inf) if stabilised == "gain" else _turns(curve, points, gain, ends)
    return Lobe(
        label=pole.label or f"{pole.frequency_hz:.3g} Hz",
        kind=pole.kind,
        frequency_hz=pole.frequency_hz,
        damping_ratio=pole.damping_ratio,
        low_hz=low,
        high_hz=high,
        peak_db=float(DB * np.log(max(size[top], 1e-300))),
        peak_hz=float(f[points[top]]),
        peak_phase_deg=float(from_minus_one_deg(loop[top : top + 1])[0]),
        stabilised=stabilised,
        gain_up_db=float(db[db >= 0.0].min(initial=np.inf)),
        gain_down_db=float((-db[db < 0.0]).min(initial=np.inf)),
        lag_deg=lag,
        lead_deg=lead,
        modulus=float(np.abs(1.0 + loop).min()),
        contribution=share,
    )


def _turns(curve: Curve, points: IntArray, gain: GainCrossings, ends: tuple[float, float]) -> tuple[float, float]:
    """Least lag and lead that turn a crossing, or without one a point above 0 dB or the peak, to the phase of -1."""
    loop = curve.loop[points]
    at = (gain.frequency_hz >= ends[0]) & (gain.frequency_hz <= ends[1])
    if at.any():
        lag = gain.lag_deg[at]
    else:
        f = curve.frequency_hz[points]
        for _ in range(SECTIONS):
            size = np.abs(loop)
            above = np.flatnonzero(size >= min(1.0, float(size.max())))
            lag = np.mod(from_minus_one_deg(loop[above]), 360.0)
            least = above[[int(lag.argmin()), int(lag.argmax())]]
            steps = np.unique(np.clip(np.append(least, least - 1), 0, len(f) - 2))
            if not len(steps):
                break
            x = f[steps, None] + (f[steps + 1] - f[steps])[:, None] * np.arange(1, SECTION) / SECTION
            x = x.ravel()
            order = np.argsort(np.append(f, x), kind="stable")
            f, loop = np.append(f, x)[order], np.append(loop, sample(curve.source, x))[order]
    return float(lag.min()), float((360.0 - lag).min())
