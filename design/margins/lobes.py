"""Lobes: the loops in the Nyquist plane that lightly damped poles cause.

Each lobe is found, named and assessed separately. Near a pole at p = -sigma + j w0, the response is R / (s - p) plus
the contribution of the rest of the loop. The second difference over the half width, u = 2
L(w0) - L(w0 + sigma) - L(w0 - sigma), is R / sigma up to the curvature of the rest. For a bending mode, the first term
is known (`resonance.Resonance.part`).

The lobe is the range in which the term exceeds SHARE times the rest, and at least LEAST half widths on either side. It
ends where the term of another lobe is larger, and in the valleys of |L| on both sides of its peak. If the own part of a
bending mode at its frequency is smaller than the rest, its lobe consists of that frequency alone. The peaks of bending
modes are defined in own_part.py.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from maxq.control.kernel.jit import routine
from maxq.control.kernel.records import Array
from maxq.design.loop.own_part import LEAST, NEAREST_NYQUIST, attribution, dominance, peak_band
from maxq.design.loop.resonance import Resonance
from maxq.design.margins import solving
from maxq.design.margins.crossings import Crossings
from maxq.design.margins.curve import Trace, merged
from maxq.design.margins.response import LoopResponse, values_at
from maxq.design.margins.solving import DB, LAG_DEG, LOBE, TINY, angle, lag_of, lobe_excess, log_abs, objective
from maxq.design.model.state_space import ComplexArray

VALLEY = 0.5  # a minimum of |L| below this fraction of the peak ends a lobe
LIGHT = 0.1  # damping ratio below which an unnamed pole has a lobe
VISIBLE = 0.01  # smallest |term| / |L| for which an unnamed pole has a lobe
ROUNDING_DB = 1e-9  # tolerance for a crossing of |L| = 1 at the end of a lobe

Stabilised = Literal["gain", "phase"]


@dataclass(frozen=True)
class Lobe:
    """A resonance in the loop, with the margins of this lobe alone. A margin without a bound in the lobe is infinite.

    `stabilised` is "gain" if the peak is below 0 dB by at least the limit, whatever its phase, and "phase" otherwise.
    Lag and lead margins of a phase-stabilised lobe are the least over its crossings of |L| = 1. Without a crossing,
    they are the least over its points above 0 dB. Those of a gain-stabilised lobe are infinite. The crossings of a
    bending mode count only where its own part exceeds SHARE times the rest and the own parts of all other modes.
    `conditional` is True if a lower gain would destabilise the loop, because the lobe crosses the negative real axis
    beyond -1.
    """

    label: str
    kind: str  # kind of the resonance, "bending" or "slosh"; empty for an unnamed pole
    frequency_hz: float  # frequency of the pole
    damping_ratio: float
    low_hz: float
    high_hz: float
    peak_db: float  # lower than |L| for a bending mode that is weak relative to the rest
    peak_hz: float
    peak_phase_deg: float  # phase of L at the peak relative to the nearest -180 + 360 k, in (-180, 180]
    stabilised: Stabilised
    gain_up_db: float  # from the largest crossing of the negative real axis between -1 and 0
    gain_down_db: float
    lag_deg: float
    lead_deg: float
    modulus: float  # least |1 + L|
    contribution: float  # contribution of the resonance at its pole, |u| / |L| or |part|

    @property
    def conditional(self) -> bool:
        return bool(np.isfinite(self.gain_down_db))

    @property
    def phase_deg(self) -> float:
        """Return the lesser of lag and lead margin."""
        return min(self.lag_deg, self.lead_deg)


COLUMNS = (
    "low_hz",
    "high_hz",
    "peak_db",
    "peak_hz",
    "peak_phase_deg",
    "gain_stabilised",
    "gain_up_db",
    "gain_down_db",
    "lag_deg",
    "lead_deg",
    "modulus",
    "contribution",
    "number",
)
"""The columns of a table of lobes. `number` is the index of the pole."""
(LOW, HIGH, PEAK_DB, PEAK_HZ, PEAK_PHASE, GAIN_STABILISED, UP, DOWN, LAG, LEAD, MODULUS, CONTRIBUTION, NUMBER) = range(
    len(COLUMNS)
)


def lobes_of(table: Array, poles: list[Resonance]) -> tuple[Lobe, ...]:
    """Return the lobes of a table (lobes, COLUMNS), with the names of their poles."""
    out = []
    for row in table.tolist():
        pole = poles[int(row[NUMBER])]
        values = dict(zip(COLUMNS[:-1], row, strict=False))
        stabilised: Stabilised = "gain" if values.pop("gain_stabilised") else "phase"
        label = pole.label or f"{pole.frequency_hz:.3g} Hz"
        out.append(Lobe(label, pole.kind, pole.frequency_hz, pole.damping_ratio, stabilised=stabilised, **values))
    return tuple(out)


def lightly_damped(open_poles: ComplexArray, lowest_radps: float) -> list[Resonance]:
    """Return the poles of L with a damping ratio below LIGHT, as unnamed resonances in rising order of frequency."""
    p = open_poles[open_poles.imag > lowest_radps]
    p = p[np.abs(p.real) < LIGHT * np.abs(p)]
    return [Resonance("", 0, float(x.imag / (2.0 * np.pi)), complex(x)) for x in p[np.argsort(p.imag)]]


@routine
def find_lobes(
    t: Trace,
    every: Crossings,
    centre: Array,
    width: Array,
    part: ComplexArray,
    least_share: float,
    limit_db: float,
    on_axis: Array,
    source: LoopResponse,
) -> Array:
    """Return the lobes of resonances, (lobes, COLUMNS).

    `centre` and `width` are the frequencies and half widths of the poles, Hz. `part` contains their own parts, NaN for
    all but bending modes. Poles with a fraction of L below `least_share` have no lobe. `on_axis` contains the
    frequencies at which L is infinite, Hz. `limit_db` is the distance below 0 dB at which a lobe is gain-stabilised.
    The curve `t` must contain extremes and crossings.
    """
    f, loop = t.frequency_hz, t.loop
    last = len(f) - 1
    top = f[last] * NEAREST_NYQUIST if t.finite_end else f[last]
    kept = np.flatnonzero((centre > f[0]) & (centre < f[last]))
    strength, share = _strengths(t, centre[kept], width[kept], part[kept], on_axis, source)
    shown = np.flatnonzero(share > least_share)
    kept, strength, share = kept[shown], strength[shown], share[shown]
    centre, width, part, n = centre[kept], width[kept], part[kept], len(kept)
    out = np.empty((n, len(COLUMNS)))
    if n == 0:
        return out
    terms = np.stack((strength.real, strength.imag, centre, width), axis=1)
    ends = _ends(t, terms, source)
    borders, bands = np.empty((n, 2)), np.empty((n, 2))
    for j in range(n):
        known = not np.isnan(part[j].real)
        gap = np.inf
        for i in range(n):
            if i != j and not np.isnan(part[i].real):
                gap = min(gap, abs(centre[i] - centre[j]))
        bands[j, 0], bands[j, 1] = centre[j], centre[j]
        if known:
            bands[j, 0], bands[j, 1] = peak_band(centre[j], width[j], part[j], gap, top)
        if known and dominance(part[j]) <= 1.0:
            borders[j, 0] = borders[j, 1] = centre[j]
        else:
            borders[j, 0] = max(min(ends[j, 0], centre[j] - LEAST * width[j]), f[0])
            borders[j, 1] = min(max(ends[j, 1], centre[j] + LEAST * width[j]), f[last])
    added = np.concatenate((borders.ravel(), bands.ravel(), centre))
    f, loop, _ = merged(f, loop, added, source)
    modes = np.flatnonzero(~np.isnan(part.real))
    for j in range(n):
        _judge(f, loop, every, centre[j], borders[j, 0], borders[j, 1], limit_db, out[j], source)
        if not np.isnan(part[j].real):
            place = int(np.searchsorted(modes, j))
            _judge_mode(f, loop, every, terms[modes], part[j], place, bands[j], limit_db, out[j])
        out[j, CONTRIBUTION], out[j, NUMBER] = share[j], kept[j]
    return out


@routine
def _strengths(
    t: Trace, centre: Array, width: Array, part: ComplexArray, on_axis: Array, source: LoopResponse
) -> tuple[ComplexArray, Array]:
    """Return the second difference u, or the own part, of each pole, and its magnitude relative to L.

    L is that at the frequency of the pole. Points above the Nyquist frequency are folded, where L is the complex
    conjugate.
    """
    n, top, low = len(centre), t.frequency_hz[len(t.frequency_hz) - 1], t.frequency_hz[0]
    f = np.concatenate((centre, centre + width, centre - width))
    at, mirrored = np.empty(3 * n), np.zeros(3 * n, np.bool_)
    for k in range(3 * n):
        mirrored[k] = t.finite_end and f[k] > top
        at[k] = max(2.0 * top - f[k] if mirrored[k] else f[k], low)
        for exact in on_axis:
            if exact == f[k]:
                at[k] *= 1.0 + 1e-9
    values = values_at(at, source)
    u, share = np.empty(n, np.complex128), np.empty(n)
    for k in range(3 * n):
        values[k] = values[k].conjugate() if mirrored[k] else values[k]
    for k in range(n):
        u[k] = 2.0 * values[k] - values[n + k] - values[2 * n + k]
        if not np.isnan(part[k].real):
            u[k] = part[k] * values[k]
        share[k] = abs(u[k]) / max(abs(values[k]), TINY)
    return u, share


@routine
def _valley(loop: ComplexArray, k: int, deep: float) -> bool:
    """Return True for a minimum of |L| among the points of the curve that is below `deep`."""
    here, n = abs(loop[k]), len(loop)
    return here < deep and (k == 0 or here <= abs(loop[k - 1])) and (k == n - 1 or here <= abs(loop[k + 1]))


@routine
def _ends(t: Trace, terms: Array, source: LoopResponse) -> Array:
    """Return the ends of the range of each lobe in Hz, (lobes, 2), or the centre twice without such a range.

    The range contains the centre and is bounded by valleys of |L|. In the range, the term is large relative to the rest
    and is the largest of all terms.
    """
    f, loop, n, last = t.frequency_hz, t.loop, len(terms), len(t.frequency_hz) - 1
    out = np.empty((n, 2))
    deep, borders = (
        np.zeros(2 * n, np.int64),
        np.zeros(2 * n, np.int64),
    )  # index of a valley; 1 + index of the first point outside
    for j in range(n):
        centre = terms[j, 2]
        out[j, 0] = out[j, 1] = centre
        after = min(max(np.searchsorted(f, centre), 1), last)
        nearest = after if f[after] - centre < centre - f[after - 1] else after - 1
        depth = VALLEY * abs(loop[nearest])
        if _valley(loop, nearest, depth) or lobe_excess(j, f[nearest], loop[nearest], terms) < 0.0:
            continue
        for side in range(2):
            way, k = 2 * side - 1, nearest
            while True:
                if k == (last if side else 0):
                    out[j, side] = f[k]
                    break
                k += way
                if _valley(loop, k, depth):
                    out[j, side] = f[k]
                    deep[2 * j + side] = k if 0 < k < last else 0
                    break
                if lobe_excess(j, f[k], loop[k], terms) < 0.0:
                    borders[2 * j + side] = k + 1
                    break
    which = np.flatnonzero(deep)
    if len(which) > 0:
        points, values = np.empty((len(which), 3)), np.empty((len(which), 3))
        for i in range(len(which)):
            for p in range(3):
                k = deep[which[i]] - 1 + p
                points[i, p], values[i, p] = f[k], log_abs(loop[k])
        kind = np.full(len(which), solving.LOG_SIZE, np.int64)
        found = solving.minima(kind, points, values, source, np.zeros((0, 3)))
        for i in range(len(which)):
            out[which[i] // 2, which[i] % 2] = found[i]
    which = np.flatnonzero(borders)
    across, ends, values = which // 2 + LOBE, np.empty((len(which), 2)), np.empty((len(which), 2))
    for i in range(len(which)):
        for p in range(2):  # p is 0 outside and 1 inside the lobe
            k = borders[which[i]] - 1 + p * (1 - 2 * (which[i] % 2))
            ends[i, p], values[i, p] = f[k], lobe_excess(which[i] // 2, f[k], loop[k], terms)
    found = solving.roots(across, ends, values, source, terms)
    for i in range(len(which)):
        out[which[i] // 2, which[i] % 2] = found[i]
    return out


@routine
def _judge(
    f: Array,
    loop: ComplexArray,
    every: Crossings,
    centre: float,
    low: float,
    high: float,
    limit_db: float,
    out: Array,
    source: LoopResponse,
) -> None:
    begin, stop = np.searchsorted(f, low), np.searchsorted(f, high, side="right")
    size, distance = np.abs(loop[begin:stop]), np.abs(1.0 + loop[begin:stop])
    top = int(np.argmax(size))
    if top in (0, stop - begin - 1):  # without a peak inside, the lobe is a bump on a slope and its centre counts
        top = 0
        for k in range(stop - begin):
            if abs(f[begin + k] - centre) < abs(f[begin + top] - centre):
                top = k
    up = down = lag = lead = np.inf
    for k in range(len(every.phase_hz)):
        if low <= every.phase_hz[k] <= high:
            db = -DB * log_abs(every.phase_loop[k])
            if db >= 0.0:
                up = min(up, db)
            else:
                down = min(down, -db)
    by_gain = DB * np.log(max(size.max(), TINY)) <= ROUNDING_DB - limit_db
    if not by_gain:
        lag, lead = _turns(f[begin:stop].copy(), loop[begin:stop].copy(), every, low, high, source)
    out[LOW], out[HIGH], out[PEAK_DB], out[PEAK_HZ] = low, high, DB * np.log(max(size[top], TINY)), f[begin + top]
    out[PEAK_PHASE], out[GAIN_STABILISED] = np.degrees(angle(-loop[begin + top])), 1.0 if by_gain else 0.0
    out[UP], out[DOWN], out[LAG], out[LEAD], out[MODULUS] = up, down, lag, lead, distance.min()


@routine
def _judge_mode(
    f: Array,
    loop: ComplexArray,
    every: Crossings,
    modes: Array,
    part: complex,
    j: int,
    band: Array,
    limit_db: float,
    out: Array,
) -> None:
    """Enter peak, lag and lead of bending mode number j of all `modes` into `out`.

    The peak is the maximum in its band. Lag and lead are those of the crossings at which the mode's term is large
    relative to the rest and the largest of all modes.
    """
    begin, stop = np.searchsorted(f, band[0]), np.searchsorted(f, band[1], side="right")
    top = begin + int(np.argmax(np.abs(loop[begin:stop])))
    out[PEAK_DB] = DB * (log_abs(loop[top]) + attribution(part))
    out[PEAK_HZ], out[PEAK_PHASE] = f[top], np.degrees(angle(-loop[top]))
    lag = lead = np.inf
    if dominance(part) > 1.0:
        for k in range(len(every.gain_hz)):
            if lobe_excess(j, every.gain_hz[k], every.gain_loop[k], modes) > 0.0:
                turn = lag_of(every.gain_loop[k])
                lag, lead = min(lag, turn), min(lead, 360.0 - turn)
    elif out[PEAK_DB] <= ROUNDING_DB - limit_db:
        out[GAIN_STABILISED] = 1.0
    out[LAG], out[LEAD] = lag, lead


@routine
def _turns(
    f: Array, loop: ComplexArray, every: Crossings, low: float, high: float, source: LoopResponse
) -> tuple[float, float]:
    """Return the least lag and lead in deg that turn a point of a lobe to the phase of -1.

    The points are the crossings of |L| = 1. Without a crossing, they are the points above 0 dB, or else the peak.
    """
    lag = lead = np.inf
    for k in range(len(every.gain_hz)):
        if low <= every.gain_hz[k] <= high:
            turn = lag_of(every.gain_loop[k])
            lag, lead = min(lag, turn), min(lead, 360.0 - turn)
    if np.isfinite(lag):
        return lag, lead
    size, m, none = np.abs(loop), 0, np.zeros((0, 3))
    level, best = min(1.0, size.max()), np.full(2, np.inf)
    kinds, points, values = np.empty(2, np.int64), np.empty((2, 3)), np.empty((2, 3))
    for side in range(2):
        kind, least = LAG_DEG + side, 0
        for k in range(len(f)):
            value = objective(kind, f[k], loop[k], none)
            if size[k] >= level and value < best[side]:
                best[side], least = value, k
        if 0 < least < len(f) - 1 and min(size[least - 1], size[least + 1]) >= level:
            kinds[m] = kind
            for p in range(3):
                k = least - 1 + p
                points[m, p], values[m, p] = f[k], objective(kind, f[k], loop[k], none)
            m += 1
    found = solving.minima(kinds[:m], points[:m], values[:m], source, none)
    there = values_at(found, source)
    for i in range(m):
        side = kinds[i] - LAG_DEG
        best[side] = min(best[side], objective(kinds[i], found[i], there[i], none))
    return best[0], best[1]


@routine
def in_lobes(hz: float, table: Array, chosen: NDArray[np.bool_]) -> bool:
    """Return True for a frequency inside one of the chosen lobes of a table."""
    for j in range(len(table)):  # noqa: SIM110  # Numba compiles no generators
        if chosen[j] and table[j, LOW] <= hz <= table[j, HIGH]:
            return True
    return False
