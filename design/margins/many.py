"""The margins of many vehicles at one operating point, with L from poles and residues (response.py).

The margins are those of `measure.margins` without disks and zones. The bounds of bounds.py are not applied, so that two
crossings that are closer than the points of the grid can be missed. A vehicle that these formulae do not support
(repeated poles, zeros that do not converge) is handed back for `measure.margins`.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from maxq.control.kernel.jit import entry, routine
from maxq.control.kernel.records import Array, IntArray
from maxq.design.loop.own_part import centre_of, folded_hz
from maxq.design.margins import curve, lobes, measure, response, solving
from maxq.design.margins.response import FASTEST, TWO_PI, LoopResponse, values_at
from maxq.design.model.state_space import ComplexArray

DONE, UNSTABLE, HANDED_BACK = 0, 1, 2
MINIMA = 8
MEASURES = np.dtype(
    [
        ("gain_up_db", float),
        ("gain_down_db", float),
        ("rigid_phase_deg", float),
        ("delay_s", float),
        ("slosh_phase_deg", float),
        ("first_mode_phase_deg", float),
        ("modes_from_2_db", float),
        ("distance", float, MINIMA),
        ("distance_hz", float, MINIMA),
    ]
)
"""The measures of one loop. A margin without a bound is infinite, and the margins of an unstable loop are NaN.

`distance` contains the lowest minima of |1 + L|, also for an unstable loop, and `distance_hz` their frequencies. Unused
elements are NaN."""

_LIGHT = 0.3  # largest damping ratio of the poles in `FixedPath.resonances`


@routine
def _nearest(f: Array, loop: ComplexArray, source: LoopResponse, distance: Array, distance_hz: Array) -> None:
    """Enter the lowest minima of |1 + L| and their frequencies in Hz into `distance` and `distance_hz`."""
    n = len(f)
    value, none = np.abs(1.0 + loop), np.zeros((0, 3))
    low = np.ones(n, np.bool_)
    for k in range(n):
        low[k] = (k == 0 or value[k] <= value[k - 1]) and (k == n - 1 or value[k] < value[k + 1])
    m, least = 0, value.min()
    kind = np.full(MINIMA, solving.SENSITIVITY, np.int64)
    points, around = np.empty((MINIMA, 3)), np.full((MINIMA, 3), np.nan)
    for place in range(MINIMA):
        best = -1
        for k in range(n):
            if low[k] and (best < 0 or value[k] < value[best]):
                best = k
        if best < 0:
            break
        low[best] = False
        points[place] = f[best]
        if 0 < best < n - 1 and value[best] < 2.0 * least:
            points[place], around[place] = f[best - 1 : best + 2], np.log(value[best - 1 : best + 2])
        m += 1
    hz = solving.minima(kind[:m], points[:m], around[:m], source, none)  # NaN values are left unchanged
    near = np.abs(1.0 + values_at(hz, source))
    for k in range(m):
        distance[k], distance_hz[k] = near[k], hz[k]


@routine
def margins_of_vehicle(
    poles: ComplexArray,
    residues: ComplexArray,
    owner: IntArray,
    own_part: ComplexArray,
    sample_s: float,
    whole: int,
    rest_s: float,
    zeros: ComplexArray,
    law_poles: ComplexArray,
    gain: float,
    law_radps: ComplexArray,
    integrates: bool,
    start: ComplexArray,
    out: Any,
    peak_db: float,
    distances: bool,
) -> int:
    """Enter the measures of one vehicle into `out`. Return DONE, UNSTABLE or HANDED_BACK.

    The arguments are those of `measure_many` for one vehicle.
    """
    n = len(poles)
    mu, alpha, beta = np.empty(n, np.complex128), np.empty(n, np.complex128), np.empty(n, np.complex128)
    direct = np.zeros(2)
    response.terms(poles, residues, sample_s, rest_s, mu, alpha, beta, direct)
    pairs, singles = response.by_pairs(poles, mu, alpha, beta)
    source = LoopResponse(sample_s, pairs, singles, direct, zeros, law_poles, gain / sample_s, whole + 1, 0, 0, 1)
    roots = start.copy()
    every = _every_pole(mu, law_poles, whole + (2 if rest_s > 0.0 else 1), integrates)
    if len(every) != len(roots) or not response.zeros_of_one_plus(roots, mu, alpha, beta, every, source):
        return HANDED_BACK
    closed = _in_radps(roots, sample_s)
    fold = TWO_PI / sample_s
    open_ = np.empty(n + len(law_radps), np.complex128)
    for i in range(n):
        open_[i] = complex(poles[i].real, poles[i].imag - fold * np.round(poles[i].imag / fold))
    open_[n:] = law_radps

    t = curve.traced(open_, closed, curve.lowest_hz_of(open_), 0.5 / sample_s, source)
    if t.problem != 0 or not np.isfinite(np.abs(t.loop).sum()):
        return HANDED_BACK
    # `_nearest` finds the minima of |1 + L| separately
    f, loop = curve.with_extremes(t.frequency_hz, t.loop, 0, source)
    t = curve.Trace(f, loop, t.slope_at_zero, t.at_zero, t.slope_at_end, t.finite_end, 0)
    every_crossing, after, growing, encircled = measure.counted(t, open_, closed, source)
    if distances:
        _nearest(after.frequency_hz, after.loop, source, out.distance, out.distance_hz)
    if growing > 0 or encircled != 0:
        return UNSTABLE if growing > 0 and encircled > 0 else HANDED_BACK
    if distances:
        return DONE
    centre, width, own, whose = _resonances(poles, owner, own_part, 1.0 / sample_s)
    none = np.zeros(0, np.complex128)
    path = LoopResponse(sample_s, pairs, singles, direct, none, none, 1.0 / sample_s, whole + 1, 0, 0, 1)
    part = own / values_at(centre, path)
    table = lobes.find_lobes(after, every_crossing, centre, width, part, -1.0, 0.0, np.zeros(0), source)
    bounds = measure.bounds_of(after, every_crossing, table, whose < 0)
    out.gain_up_db, out.gain_down_db = bounds[measure.GAIN_UP, 0], bounds[measure.GAIN_DOWN, 0]
    out.rigid_phase_deg, out.delay_s = bounds[measure.RIGID_PHASE, 0], bounds[measure.DELAY, 0]
    out.slosh_phase_deg = out.first_mode_phase_deg = np.inf
    out.modes_from_2_db = -np.inf
    for lobe in table:
        number, peak, turn = whose[int(lobe[lobes.NUMBER])], lobe[lobes.PEAK_DB], min(lobe[lobes.LAG], lobe[lobes.LEAD])
        if number < 0 and peak > peak_db:
            out.slosh_phase_deg = min(out.slosh_phase_deg, turn)
        elif number == 1:  # infinite for a gain-stabilised mode
            out.first_mode_phase_deg = min(out.first_mode_phase_deg, turn)
        elif number > 1:
            out.modes_from_2_db = max(out.modes_from_2_db, peak)
    return DONE


@routine
def _every_pole(mu: ComplexArray, law_poles: ComplexArray, late: int, integrates: bool) -> ComplexArray:
    """Return the poles of 1 + L in w = z - 1, which are those of the path, the law and the delay."""
    every, m = np.full(len(mu) + len(law_poles) + late, -1.0 + 0j), len(mu)
    every[:m] = mu
    cancelled = integrates  # a path with zero rate at constant command cancels the first integrator's pole
    for p in law_poles:
        if abs(p) > 1e-9 or cancelled:
            every[m] = p
            m += 1
        else:
            cancelled = True
    return every[: m + late]


@routine
def _in_radps(roots: ComplexArray, sample_s: float) -> ComplexArray:
    """Return log(1 + w) / T for zeros of 1 + L, except those of pure delays."""
    closed, m = np.empty(len(roots), np.complex128), 0
    for w in roots:
        if abs(1.0 + w) > FASTEST:
            size = 0.5 * np.log1p(2.0 * w.real + w.real * w.real + w.imag * w.imag)
            near = complex(size, np.arctan2(w.imag, 1.0 + w.real))
            p = (np.log(1.0 + w) if abs(w) > 0.1 else near) / sample_s
            closed[m] = complex(p.real, 0.0) if abs(p.imag) < 1e-7 * abs(p) else p
            m += 1
    return closed[:m].copy()


@routine
def _resonances(
    poles: ComplexArray, owner: IntArray, own_part: ComplexArray, fold: float
) -> tuple[Array, Array, ComplexArray, IntArray]:
    """Return the frequency (Hz), half width (Hz), own part and owner of the lightly damped poles of modes and tanks."""
    centre, width, whose, n = np.empty(len(poles)), np.empty(len(poles)), np.zeros(len(poles), np.int64), 0
    own = np.empty(len(poles), np.complex128)
    for i in range(len(poles)):
        p = poles[i]
        if owner[i] != 0 and p.imag > 0.0 and -p.real < _LIGHT * abs(p):
            hz = folded_hz(p.imag / TWO_PI, fold)
            if owner[i] > 0:
                hz = centre_of(hz, abs(p.real) / TWO_PI, 0.5 * fold)
            centre[n], width[n], whose[n] = hz, max(abs(p.real) / TWO_PI, 1e-9 * hz), owner[i]
            own[n] = own_part[i]
            n += 1
    return centre[:n].copy(), width[:n].copy(), own[:n].copy(), whose[:n].copy()


@entry
def measure_many(
    poles: ComplexArray,
    residues: ComplexArray,
    owner: IntArray,
    own_part: ComplexArray,
    sample_s: float,
    whole: IntArray,
    rest_s: Array,
    zeros: ComplexArray,
    law_poles: ComplexArray,
    gain: float,
    law_radps: ComplexArray,
    integrates: bool,
    start: ComplexArray,
    peak_db: float,
    distances: bool,
    values: Any,
    status: IntArray,
) -> None:
    """Enter the margins of vehicles into `values` (vehicles,) of MEASURES and their outcome into `status` (vehicles,).

    The status is DONE, UNSTABLE or HANDED_BACK. If `distances` is True, only the distances are computed. `poles`
    (vehicles, n) are those of the continuous path, rad/s, both of each pair, with their `residues`. `owner` is +k for
    mode k, -k for tank k and 0 otherwise. `own_part` is that of the path at each mode's frequency
    (`own_part.centre_of`), and NaN for other poles. The delay of each vehicle is `whole` periods and `rest_s`. The law
    from mean rate to command has `zeros` and `law_poles` in w = z - 1 and the factor `gain`; `law_radps` are its poles
    except integrators, rad/s. `integrates` is True if no zero of the path cancels the integrator's pole. `start`
    contains the zeros of 1 + L of a similar vehicle, in w. Vehicles whose `status` is HANDED_BACK on entry are omitted.
    """
    for v in range(len(poles)):
        if status[v] != HANDED_BACK:
            status[v] = margins_of_vehicle(
                poles[v],
                residues[v],
                owner[v],
                own_part[v],
                sample_s,
                whole[v],
                rest_s[v],
                zeros,
                law_poles,
                gain,
                law_radps,
                integrates,
                start,
                values[v],
                peak_db,
                distances,
            )
