"""Margins of many vehicles at one node: those of `measure.margins`, compiled, of the curves of many_curve.py.

Encirclements and lobes are those of curve.py and lobes.py; disks, zones and the bounds of bounds.py are left out: two
crossings that lie closer to each other than the grid's points can be missed. Vehicles that these formulae do not serve
(repeated poles, poles on the axis, zeros that do not converge) are handed back for `measure.margins`.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from maxq.control.kernel.jit import entry, routine
from maxq.control.kernel.records import Array, IntArray
from maxq.design.margins import curve, lobes, many_curve, solving
from maxq.design.model.state_space import ComplexArray

DONE, UNSTABLE, HANDED_BACK = 0, 1, 2
MINIMA = 8
MEASURES = np.dtype([
    ("gain_up_db", float), ("gain_down_db", float), ("rigid_phase_deg", float), ("delay_s", float),
    ("slosh_phase_deg", float), ("first_mode_phase_deg", float), ("second_and_higher_modes_db", float),
    ("distance", float, MINIMA), ("distance_hz", float, MINIMA),
])  # fmt: skip  # a line for each otherwise
"""The measures of one loop. Margins are infinite where nothing bounds them and NaN for an unstable loop.

`distance` holds the lowest minima of |1 + L|, of an unstable loop too, and `distance_hz` their frequencies; NaN behind
the last."""

_LIGHT = 0.3  # damping ratio of what `FixedPath.resonances` names


@routine
def _nearest(f: Array, loop: ComplexArray, at: many_curve.At, distance: Array, distance_hz: Array) -> None:
    """The lowest minima of |1 + L| and their frequencies."""
    n = len(f)
    value = np.abs(1.0 + loop)
    low = np.ones(n, np.bool_)
    for k in range(n):
        low[k] = (k == 0 or value[k] <= value[k - 1]) and (k == n - 1 or value[k] < value[k + 1])
    for place in range(MINIMA):
        best = -1
        for k in range(n):
            if low[k] and (best < 0 or value[k] < value[best]):
                best = k
        if best < 0:
            break
        hz = f[best]
        if 0 < best < n - 1 and value[best] < 2.0 * value.min():
            a, c, b = np.log(value[best - 1]), np.log(value[best]), np.log(value[best + 1])
            hz = many_curve.least_of(4, f[best - 1], f[best], f[best + 1], a, c, b, at)
        distance[place], distance_hz[place] = abs(1.0 + many_curve.value_at(hz, at)), hz
        low[best] = False


@routine
def _one(
    poles: ComplexArray, residues: ComplexArray, owner: IntArray, sample_s: float, whole: int, rest_s: float, zeros:
    ComplexArray, law_poles: ComplexArray, gain: float, law_hz: ComplexArray, integrates: bool, start: ComplexArray,
    out: Any, peak_db: float,
) -> int:  # fmt: skip  # one line for each otherwise
    """Margins of one vehicle into `out`; DONE, UNSTABLE or HANDED_BACK."""
    n = len(poles)
    mu, alpha, beta = np.empty(n, np.complex128), np.empty(n, np.complex128), np.empty(n, np.complex128)
    direct = np.zeros(2)
    many_curve.terms(poles, residues, sample_s, rest_s, mu, alpha, beta, direct)
    periods = whole + 1
    swings = 0
    for i in range(n):
        swings += 1 if poles[i].imag > 0.0 else 0
    pairs, singles = np.empty((swings, 6)), np.empty((n - 2 * swings, 3))
    a = b = 0
    for i in range(n):
        if poles[i].imag > 0.0:
            pairs[a, 0], pairs[a, 1] = 2.0 * alpha[i].real, -2.0 * (alpha[i] * mu[i].conjugate()).real
            pairs[a, 2], pairs[a, 3] = 2.0 * beta[i].real, -2.0 * (beta[i] * mu[i].conjugate()).real
            pairs[a, 4], pairs[a, 5] = -2.0 * mu[i].real, mu[i].real ** 2 + mu[i].imag ** 2
            a += 1
        elif poles[i].imag == 0.0:
            singles[b, 0], singles[b, 1], singles[b, 2] = alpha[i].real, beta[i].real, mu[i].real
            b += 1
    gain = gain / sample_s
    at = (sample_s, pairs, singles, direct, zeros, law_poles, gain, periods)

    # poles of 1 + L times its denominator: those of the path, of the law, and of the delay
    late = periods + (1 if rest_s > 0.0 else 0)
    every, m = np.empty(n + len(law_poles) + late, np.complex128), n
    every[:n] = mu
    cancelled = integrates  # a path that rests has a zero where the first integrator has its pole
    for p in law_poles:
        if abs(p) > 1e-9 or cancelled:
            every[m] = p
            m += 1
        else:
            cancelled = True
    for _ in range(late):
        every[m] = -1.0
        m += 1
    if m != len(start):
        return HANDED_BACK
    roots = start.copy()
    if not many_curve.zeros_of_one_plus(roots, mu, alpha, beta, every[:m], at):
        return HANDED_BACK
    closed, m = np.empty(len(roots), np.complex128), 0
    for w in roots:
        if abs(1.0 + w) > many_curve.FASTEST:
            closed[m] = (
                np.log(1.0 + w) / sample_s
                if abs(w) > 0.1
                else complex(
                    0.5 * np.log1p(2.0 * w.real + w.real * w.real + w.imag * w.imag), np.arctan2(w.imag, 1.0 + w.real)
                )
                / sample_s
            )
            if abs(closed[m].imag) < 1e-7 * abs(closed[m]):
                closed[m] = complex(closed[m].real, 0.0)
            m += 1
    closed = closed[:m]
    fold = many_curve.TWO_PI / sample_s
    open_ = np.empty(n + len(law_hz), np.complex128)
    for i in range(n):
        open_[i] = complex(poles[i].real, poles[i].imag - fold * np.round(poles[i].imag / fold))
    open_[n:] = law_hz

    # where the curve begins
    low = curve.LOWEST_HZ
    for size in np.sort(np.abs(open_)) / many_curve.TWO_PI:
        if low / curve.ASYMPTOTIC < size < curve.ASYMPTOTIC * low:
            low = curve.ASYMPTOTIC * size
    if low > curve.DRIFT_UP_TO_HZ:
        low = curve.LOWEST_HZ
    end = 0.5 / sample_s
    growing = 0
    for p in closed:
        if abs(p) > many_curve.TWO_PI * low and p.real >= -curve.ON_AXIS * abs(p):
            growing += 1
    first = many_curve.value_at(low, at)
    second = many_curve.value_at(2.0 * low, at)
    slope_at_zero = int(np.round(np.log2(abs(second) / abs(first))))
    at_zero = (4.0 * first.real - second.real) / 3.0

    f = many_curve.grid(open_, closed, low, end)
    if len(f) == 0:
        return HANDED_BACK
    loop = np.empty(len(f), np.complex128)
    for k in range(len(f)):
        loop[k] = many_curve.value_at(f[k], at)
        if not (np.isfinite(loop[k].real) and np.isfinite(loop[k].imag)):
            return HANDED_BACK
    f, loop = many_curve.refined(f, loop, at)
    if len(f) == 0:
        return HANDED_BACK
    f, loop, m = many_curve.merged(f, loop, len(f), many_curve.extremes(f, loop, at), at)
    places, kinds, ways = many_curve.crossings(f, loop, at)
    values = np.empty(len(places), np.complex128)
    for k in range(len(places)):
        values[k] = many_curve.value_at(places[k], at)
    f, loop, m = many_curve.merged(f, loop, m, places, at)

    _nearest(f, loop, at, out.distance, out.distance_hz)

    # encirclements
    right = 0
    for p in open_:
        right += 1 if abs(p) > many_curve.TWO_PI * low and p.real > curve.ON_AXIS * abs(p) else 0
    branches = 0
    for k in range(len(places)):
        if kinds[k] == 1 and values[k].real < 0.0 and 1.0 < abs(values[k]) < curve.FARTHEST:
            branches += ways[k]
    start_loop = loop[0]
    order = -slope_at_zero if abs(start_loop) > 1.0 else 0
    if order == 0:
        begin = 0.0 if (1.0 + start_loop).real >= 0.0 else 0.5 * many_curve.TWO_PI
        turn = many_curve.wrapped(many_curve.angle(1.0 + start_loop) - begin)
    else:
        unit = 1.0 + 0j
        for _ in range(abs(order)):
            unit = unit * (1j if order > 0 else -1j)
        begin = 0.0 if (start_loop * unit).real >= 0.0 else 0.5 * many_curve.TWO_PI
        arrived = begin - order * 0.25 * many_curve.TWO_PI
        turn = arrived - begin + many_curve.wrapped(many_curve.angle(1.0 + start_loop) - arrived)
    turn += many_curve.angle(1.0 + loop[m - 2]) - many_curve.angle(1.0 + loop[0]) + many_curve.TWO_PI * branches
    ended = 0.0 if (1.0 + loop[m - 1]).real >= 0.0 else 0.5 * many_curve.TWO_PI
    turn += many_curve.wrapped(ended - many_curve.angle(1.0 + loop[m - 2]))
    encircled = int(np.round(right - turn / (0.5 * many_curve.TWO_PI)))
    if growing > 0 or encircled != 0:
        return UNSTABLE if growing > 0 and encircled > 0 else HANDED_BACK
    return _judged(f, loop, places, kinds, values, poles, owner, slope_at_zero, at_zero, at, out, peak_db)


@routine
def _judged(
    f: Array, loop: ComplexArray, places: Array, kinds: IntArray, values: ComplexArray, poles: ComplexArray, owner:
    IntArray, slope_at_zero: int, at_zero: float, at: many_curve.At, out: Any, peak_db: float,
) -> int:  # fmt: skip  # one line for each otherwise
    """Gain, phase and delay margins, and lobes, as measure.margins and lobes.find_lobes."""
    m, end = len(f), f[-1]
    up = down = phase = delay = np.inf
    for k in range(len(places)):
        if kinds[k] == 1 and values[k].real < 0.0 and 1.0 / curve.FARTHEST < abs(values[k]) < curve.FARTHEST:
            db = -solving.DB * many_curve.log_size(values[k])
            if db >= 0.0:
                up = min(up, db)
            else:
                down = min(down, -db)
        elif kinds[k] == 0:
            lag = np.degrees(many_curve.angle(-values[k])) % 360.0
            delay = min(delay, lag / (360.0 * places[k]))
    if slope_at_zero == 0 and at_zero < 0.0 and abs(loop[0].imag) < 0.1 * abs(loop[0]):
        db = -solving.DB * np.log(abs(at_zero))
        up, down = (min(up, db), down) if db >= 0.0 else (up, min(down, -db))
    last = loop[m - 1]
    if last.real < 0.0 and abs(last.imag) < curve.REAL * abs(last):
        db = -solving.DB * np.log(abs(last.real))
        up, down = (min(up, db), down) if db >= 0.0 else (up, min(down, -db))

    # lobes, in rising order of frequency
    centre, width, whose = np.empty(len(poles)), np.empty(len(poles)), np.zeros(len(poles), np.int64)
    n, fold = 0, 1.0 / at[0]
    for i in range(len(poles)):
        p = poles[i]
        if owner[i] == 0 or p.imag <= 0.0 or -p.real >= _LIGHT * abs(p):
            continue
        hz = abs(p.imag / many_curve.TWO_PI - np.round(p.imag / many_curve.TWO_PI / fold) * fold)
        if f[0] < hz < f[m - 1]:
            centre[n], width[n], whose[n] = hz, max(abs(p.real) / many_curve.TWO_PI, 1e-9 * hz), owner[i]
            n += 1
    strength = np.empty(n, np.complex128)
    for j in range(n):
        total = 0j
        for part in range(3):
            hz = centre[j] + (0.0 if part == 0 else width[j] if part == 1 else -width[j])
            mirrored = hz > end
            x = max(2.0 * end - hz if mirrored else hz, f[0])
            value = many_curve.value_at(x, at)
            value = value.conjugate() if mirrored else value
            total += 2.0 * value if part == 0 else -value
        strength[j] = total
    slosh_deg = first_deg = np.inf
    higher_db = -np.inf
    in_bending = np.zeros(len(places), np.bool_)
    for j in range(n):
        nearest = 0
        for k in range(m):
            if abs(f[k] - centre[j]) < abs(f[nearest] - centre[j]):
                nearest = k
        deep = lobes.VALLEY * abs(loop[nearest])
        low = high = centre[j]
        if _in_lobe(f[nearest], loop[nearest], strength, centre, width, j) and not _valley(loop, nearest, deep):
            low = _end_of_lobe(f, loop, strength, centre, width, j, nearest, deep, -1, at)
            high = _end_of_lobe(f, loop, strength, centre, width, j, nearest, deep, 1, at)
        low = max(min(low, centre[j] - lobes.LEAST * width[j]), f[0])
        high = min(max(high, centre[j] + lobes.LEAST * width[j]), f[m - 1])
        low_loop = many_curve.value_at(low, at)
        high_loop = many_curve.value_at(high, at)
        begin = np.searchsorted(f, low)
        stop = np.searchsorted(f, high, side="right")
        greatest, top = 0.0, begin
        for k in range(begin, stop):
            if abs(loop[k]) > greatest:
                greatest, top = abs(loop[k]), k
        at_end = max(abs(low_loop), abs(high_loop))
        if at_end >= greatest or f[top] == low or f[top] == high:
            greatest = max(greatest, at_end)
            top = begin
            for k in range(begin, stop):
                if abs(f[k] - centre[j]) < abs(f[top] - centre[j]):
                    top = k
        level = solving.DB * np.log(max(greatest, 1e-300))
        shown = solving.DB * many_curve.log_size(loop[top])
        lag = lead = np.inf
        if level > lobes.ROUNDING_DB:
            crossed = False
            for k in range(len(places)):
                if kinds[k] == 0 and low <= places[k] <= high:
                    turn = np.degrees(many_curve.angle(-values[k])) % 360.0
                    lag, lead, crossed = min(lag, turn), min(lead, 360.0 - turn), True
            if not crossed:
                least = most = begin
                for k in range(begin - 1, stop + 1):
                    value = low_loop if k < begin else high_loop if k == stop else loop[k]
                    if abs(value) >= min(1.0, greatest):
                        turn = np.degrees(many_curve.angle(-value)) % 360.0
                        if turn < lag:
                            lag, least = turn, k
                        if 360.0 - turn < lead:
                            lead, most = 360.0 - turn, k
                lag = min(lag, _least_turn(f, low, high, least, begin, stop, 1.0, lag, at))
                lead = min(lead, _least_turn(f, low, high, most, begin, stop, -1.0, lead, at))
        if whose[j] < 0:
            if shown > peak_db:
                slosh_deg = min(slosh_deg, lag, lead)
            continue
        for k in range(len(places)):
            in_bending[k] = in_bending[k] or low <= places[k] <= high
        if whose[j] == 1:
            if shown > 0.0:
                first_deg = min(first_deg, lag, lead)
        else:
            higher_db = max(higher_db, shown)
    for k in range(len(places)):
        if kinds[k] == 0 and not in_bending[k]:
            phase = min(phase, abs(np.degrees(many_curve.angle(-values[k]))))
    out.gain_up_db, out.gain_down_db, out.rigid_phase_deg, out.delay_s = up, down, phase, delay
    out.slosh_phase_deg, out.first_mode_phase_deg, out.second_and_higher_modes_db = slosh_deg, first_deg, higher_db
    return DONE


@routine
def _least_turn(
    f: Array, low: float, high: float, k: int, begin: int, stop: int, way: float, found: float, at: many_curve.At
) -> float:
    """Least lag (`way` 1) or lead (-1) beside point number k of those from `begin` to `stop`, deg."""
    a = low if k - 1 < begin else f[k - 1]
    b = high if k + 1 >= stop else f[k + 1]
    for _ in range(6):
        place = 0
        step = (b - a) / 16.0
        for i in range(1, 16):
            value = many_curve.value_at(a + i * step, at)
            turn = np.degrees(many_curve.angle(-value)) % 360.0
            turn = turn if way > 0.0 else 360.0 - turn
            if abs(value) >= 1.0 and turn <= found:
                found, place = turn, i
        if place == 0:
            break
        a, b = a + (place - 1) * step, a + (place + 1) * step
    return found


@routine
def _valley(loop: ComplexArray, k: int, deep: float) -> bool:
    """A deep minimum of |L| among the points of the curve."""
    here, n = abs(loop[k]), len(loop)
    return here < deep and (k == 0 or here <= abs(loop[k - 1])) and (k == n - 1 or here <= abs(loop[k + 1]))


@routine
def _in_lobe(hz: float, value: complex, strength: ComplexArray, centre: Array, width: Array, j: int) -> bool:
    """Whether a point belongs to a lobe: its term is large against the rest, and the largest of all."""
    term = strength[j] * many_curve.over(complex(1.0, (hz - centre[j]) / width[j]))
    size = abs(term)
    if size <= lobes.SHARE * abs(value - term):
        return False
    for other in range(len(strength)):
        if abs(strength[other] * many_curve.over(complex(1.0, (hz - centre[other]) / width[other]))) > size:
            return False
    return True


@routine
def _end_of_lobe(
    f: Array, loop: ComplexArray, strength: ComplexArray, centre: Array, width: Array, j: int, k: int, deep: float,
    way: int, at: many_curve.At,
) -> float:  # fmt: skip  # one line for each otherwise
    """Where the run of points about number k ends, up or down, as lobes._solved_ends."""
    last = len(f) - 1 if way > 0 else 0
    while True:
        if k == last:
            return float(f[k])
        k += way
        if _valley(loop, k, deep):
            if k in (0, len(f) - 1):
                return float(f[k])
            a, c, b = many_curve.log_size(loop[k - 1]), many_curve.log_size(loop[k]), many_curve.log_size(loop[k + 1])
            return many_curve.least_of(0, f[k - 1], f[k], f[k + 1], a, c, b, at)
        if not _in_lobe(f[k], loop[k], strength, centre, width, j):
            break
    outer, inner = f[k], f[k - way]
    for _ in range(22):
        x = 0.5 * (outer + inner)
        value = many_curve.value_at(x, at)
        if _in_lobe(x, value, strength, centre, width, j):
            inner = x
        else:
            outer = x
    return float(inner)


@entry
def measure_many(
    poles: ComplexArray, residues: ComplexArray, owner: IntArray, sample_s: float, whole: IntArray, rest_s: Array,
    zeros: ComplexArray, law_poles: ComplexArray, gain: float, law_radps: ComplexArray, integrates: bool, start:
    ComplexArray, peak_db: float, values: Any, status: IntArray,
) -> None:  # fmt: skip  # one line for each otherwise
    """Margins of vehicles into `values` (vehicles,) of MEASURES, `status` (vehicles,): DONE, UNSTABLE or HANDED_BACK.

    `poles` (vehicles, n) of the continuous path, rad/s, both of each pair, and its residues; `owner` of each: +k mode
    k, -k tank k, 0 nothing. Delay of each: `whole` periods and `rest_s`. The law from mean rate to command: `zeros`,
    `law_poles` in w = z - 1, `gain`, and its poles besides integrators, rad/s. `integrates`: no zero of the path takes
    the integrator's pole away. `start`: zeros of 1 + L of a vehicle like these, in w. `status` may come as HANDED_BACK:
    such a vehicle is left out.
    """
    for v in range(len(poles)):
        if status[v] != HANDED_BACK:
            status[v] = _one(
                poles[v], residues[v], owner[v], sample_s, whole[v], rest_s[v], zeros, law_poles, gain, law_radps,
                integrates, start, values[v], peak_db,
            )  # fmt: skip  # sixteen lines otherwise
