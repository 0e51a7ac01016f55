"""Lobes: the loops that lightly damped poles draw in the Nyquist plane, each found, named and judged by itself.

Near a pole at p = -sigma + j w0 the response is R / (s - p) plus what the rest of the loop contributes. The second
difference over the half width, u = 2 L(w0) - L(w0 + sigma) - L(w0 - sigma), is R / sigma up to the curvature of the
rest. The lobe is where that term is larger than SHARE times the rest, at least LEAST half widths to either side. It
ends where another lobe's term is larger, and in the valleys of |L| on both sides of its peak.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from maxq.control.kernel.records import Array
from maxq.design.loop.resonance import Resonance
from maxq.design.margins.curve import Curve, GainCrossings, PhaseCrossings
from maxq.design.margins.solving import DB, from_minus_one_deg, sample
from maxq.design.model.state_space import ComplexArray

SHARE = 0.5
VALLEY = 0.5  # a minimum of |L| below this share of the peak ends a lobe
LEAST = 2.0
LIGHT = 0.1  # damping ratio below which an unnamed pole makes a lobe
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
    term = strength[:, None] / (1.0 + 1j * (f - centre[:, None]) / width[:, None])
    share = np.abs(strength) / np.maximum(np.abs(at_pole), 1e-300)
    shown = [k for k in range(len(poles)) if resonances is not None or share[k] > VISIBLE]
    size = np.abs(term[shown])
    inside = (size > SHARE * np.abs(loop - term[shown])) & (size >= size.max(axis=0, initial=0.0))
    out = []
    for j, k in enumerate(shown):
        ends = _around(f, inside[j] & ~_valleys(loop, f, centre[k]), centre[k], LEAST * width[k])
        out.append(_judge(curve, poles[k], ends, float(share[k]), gain, phase, limit_db))
    return tuple(out)


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


def _valleys(loop: ComplexArray, f: Array, centre: float) -> NDArray[np.bool_]:
    """Deep minima of |L|."""
    size = np.abs(loop)
    k = int(np.argmin(np.abs(f - centre)))
    low = np.append(True, size[1:] <= size[:-1]) & np.append(size[:-1] <= size[1:], True)
    return np.asarray(low & (size < VALLEY * size[k]))


def _around(f: Array, inside: NDArray[np.bool_], centre: float, least: float) -> tuple[float, float]:
    """Ends of the run of `inside` that holds the centre, at least `least` away from it."""
    k = int(np.argmin(np.abs(f - centre)))
    low = high = centre
    if inside[k]:
        outside = np.flatnonzero(~inside)
        left, right = outside[outside < k], outside[outside > k]
        low = float(f[left[-1] + 1] if len(left) else f[0])
        high = float(f[right[0] - 1] if len(right) else f[-1])
    return max(min(low, centre - least), float(f[0])), min(max(high, centre + least), float(f[-1]))


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
    lag, lead = (np.inf, np.inf) if stabilised == "gain" else _turns(gain, loop, ends)
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


def _turns(gain: GainCrossings, loop: ComplexArray, ends: tuple[float, float]) -> tuple[float, float]:
    """Least lag and lead that turn a crossing, or without one a point above 0 dB or the peak, to the phase of -1."""
    at = (gain.frequency_hz >= ends[0]) & (gain.frequency_hz <= ends[1])
    if at.any():
        lag = gain.lag_deg[at]
    else:
        size = np.abs(loop)
        above = size >= min(1.0, float(size.max()))
        lag = np.mod(from_minus_one_deg(loop[above]), 360.0)
    return float(lag.min()), float((360.0 - lag).min())
