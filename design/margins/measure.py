"""The margins of a loop: gain, phase, delay and disk margins, zones and lobes. Stability is determined in two ways."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from maxq.control.kernel.jit import entry, routine
from maxq.control.kernel.records import Array
from maxq.design.loop.loop import OpenLoop
from maxq.design.loop.resonance import Resonance
from maxq.design.margins import crossings
from maxq.design.margins import curve as curves
from maxq.design.margins.bounds import ZerosAndPoles, factors_of, separated
from maxq.design.margins.crossings import Crossings, GainCrossings, PhaseCrossings
from maxq.design.margins.curve import LoopCurve, Trace
from maxq.design.margins.distances import (
    NO_DISKS,
    Clearance,
    Disks,
    Zone,
    as_rows,
    disks_of,
    find_clearances,
    least_distances,
)
from maxq.design.margins.lobes import NUMBER, VISIBLE, Lobe, find_lobes, in_lobes, lightly_damped, lobes_of
from maxq.design.margins.packed import packed
from maxq.design.margins.response import LoopResponse, asking
from maxq.design.margins.solving import DB, lag_of, log_abs
from maxq.design.model.state_space import ComplexArray

DIAMOND = Zone("diamond", 30.0, 6.0)
BENDING_KINDS = ("bending", "slosh")


@dataclass(frozen=True)
class LeastValue:
    """The least of several values and its frequency.

    Without a value, it is infinite at a frequency of NaN. For an unstable loop, it is NaN.
    """

    value: float
    frequency_hz: float

    def __float__(self) -> float:
        return self.value


NOTHING = LeastValue(np.nan, np.nan)


@dataclass(frozen=True, kw_only=True)
class Margins:
    """The margins of a stable loop as positive numbers. A margin without a bound is infinite.

    A bound consists of a value and its frequency, where zero and infinity denote limits. `gain_up` is the increase and
    `gain_down` the decrease of gain at which the loop reaches -1. Both include all crossings and lobes and are exact:
    between them the loop is stable. `phase` is the least turn in either direction over all crossings of `|L|` = 1.
    `delay` is the least delay in s that moves a crossing to -1. For a sampled loop it is exact for whole periods; in
    between, it includes the change of phase only. A continuous loop whose gain remains above 1 has a delay margin of 0.

    For the rigid body, `rigid_phase` is the least over the crossings outside bending lobes; crossings in slosh lobes
    are included. `crossover_hz` is the highest frequency of those crossings at which `|L|` falls. `rigid_gain` and
    `aero_gain` are the upper and lower gain margins at the crossings outside all lobes, above and below the crossover.
    Unnamed lobes count as bending.

    The margins of an unstable loop are all NaN, so that no comparison with a limit can pass. `stable`, `unstable_poles`
    and `growth_1ps` describe its distance from stability. Crossings, lobes and `curve` describe L and are always
    present.
    """

    stable: bool
    unstable_poles: int  # zeros of 1 + L in the right half plane, from the list of poles
    encircled_poles: int  # the same number from the curve's encirclements; the loop is stable only if both are 0
    growth_1ps: float  # greatest real part of the closed-loop poles: growth rate, or minus the slowest decay rate
    growth_hz: float  # frequency of that pole
    gain_crossings: GainCrossings
    phase_crossings: PhaseCrossings
    curve: LoopCurve
    clearances: tuple[Clearance, ...]
    gain_up_db: LeastValue = NOTHING
    gain_down_db: LeastValue = NOTHING
    phase_deg: LeastValue = NOTHING
    delay_s: LeastValue = NOTHING
    aero_gain_db: LeastValue = NOTHING
    rigid_gain_db: LeastValue = NOTHING
    rigid_phase_deg: LeastValue = NOTHING
    crossover_hz: float = np.nan  # 0 without a crossover
    disks: Disks = NO_DISKS
    lobes: tuple[Lobe, ...] = ()

    @property
    def modulus(self) -> float:
        """Return the modulus margin, the least `|1 + L|`."""
        return self.disks.sensitivity.size

    @property
    def gain_db(self) -> float:
        """Return the lesser of upper and lower gain margin over all crossings, or NaN if the loop is unstable."""
        return float(np.minimum(self.gain_up_db.value, self.gain_down_db.value))

    @property
    def growth_time_s(self) -> float:
        """Return the e-folding time of an unstable loop, or infinity for a stable loop."""
        return 1.0 / self.growth_1ps if self.growth_1ps > 0.0 else np.inf


def margins(
    loop: OpenLoop,
    *,
    resonances: Sequence[Resonance] | None = None,
    zones: Sequence[Zone] = (DIAMOND,),
    gain_stabilised_db: float = 0.0,
    lowest_hz: float | None = None,
) -> Margins:
    """Compute the margins of a loop. Crossings and distances are accurate to 1e-8 dB and degrees if L itself is.

    `resonances` name the lobes; only bending and slosh are examined. Without them, every open-loop pole with a damping
    ratio below 0.1 that is visible in L has a lobe. A lobe with its peak below minus `gain_stabilised_db` is
    gain-stabilised. Poles slower than `lowest_hz` (including integrators, default `curve.lowest_hz_of`) are drift: they
    do not count as unstable, and L is not examined there.

    If the zeros and poles of the loop are known (`OpenLoop.factors`), no crossing is missed, however close two
    crossings are (bounds.py). For the negative real axis this holds above -80 dB. For the kind `exact`, the grid limits
    the resolution. Raises ValueError for a response that is not finite, and for an improper loop.
    """
    open_poles = curves.finite(loop.open_poles(), "open")
    lowest_hz = curves.lowest_hz_of(open_poles) if lowest_hz is None else lowest_hz
    end = float(loop.highest_hz)
    if not 0.0 < lowest_hz < end:
        raise ValueError(f"lowest_hz is {lowest_hz:g}: must be between 0 and the loop's end at {end:g} Hz")
    closed_poles = curves.finite(loop.closed_poles(), "closed")
    named = None if resonances is None else [r for r in resonances if r.kind in BENDING_KINDS]
    known = lightly_damped(open_poles, 2.0 * np.pi * lowest_hz) if named is None else named
    centre, part = np.array([r.centre_hz for r in known], float), np.array([r.part for r in known], complex)
    width = np.maximum(
        np.array([r.half_width_hz for r in known], float), 1e-9 * centre
    )  # an undamped pole has the width of the grid
    slosh = np.array([r.kind == "slosh" for r in known], bool)
    numbers = packed(loop)
    with asking(loop) if numbers is None else nullcontext(numbers) as source:
        t = _trace(open_poles, closed_poles, float(lowest_hz), end, factors_of(loop), source)
        if t.problem == curves.IMPROPER:
            top = f"{abs(t.loop[-1]):.3g} at {t.frequency_hz[-1]:.3g} Hz"
            raise ValueError(f"the loop is improper: |L| grows without bound, {top}")
        if t.problem == curves.WINDING:
            said = f"{len(t.loop)} points up to {t.frequency_hz[-1]:.3g} Hz"
            raise ValueError(f"the loop's phase turns too often to be followed: {said}")
        rows, share = as_rows(tuple(zones)), VISIBLE if named is None else -1.0
        found = _measure(
            t, open_poles, closed_poles, centre, width, part, slosh, share, gain_stabilised_db, rows, source
        )
    every, after, bounds, table = found.crossings, found.trace, found.bounds, found.lobes
    clearances, at = found.nearest
    curve = LoopCurve(
        loop,
        after.frequency_hz,
        after.loop,
        open_poles,
        closed_poles,
        t.slope_at_zero,
        t.at_zero,
        t.slope_at_end,
        t.finite_end,
    )
    slow = closed_poles[np.abs(closed_poles) > curve.lowest_radps]
    slowest = slow[np.argmax(slow.real)] if len(slow) else complex(-np.inf, 0.0)
    stable = found.growing == 0 and found.encircled == 0
    facts: dict[str, Any] = {
        "stable": stable,
        "unstable_poles": found.growing,
        "encircled_poles": found.encircled,
        "growth_1ps": float(slowest.real),
        "growth_hz": float(abs(slowest.imag) / (2.0 * np.pi)),
        "gain_crossings": GainCrossings(every.gain_hz, every.gain_loop, every.gain_way > 0),
        "phase_crossings": PhaseCrossings(every.phase_hz, every.phase_loop, every.phase_way),
        "curve": curve,
        "lobes": lobes_of(table, known),
    }
    if not stable:
        nothing = complex(np.nan, np.nan)
        return Margins(**facts, clearances=tuple(Clearance(zone, np.nan, np.nan, nothing) for zone in zones))
    facts |= {
        name: LeastValue(value, hz) for name, (value, hz) in zip(BOUNDS, bounds[:CROSSOVER].tolist(), strict=True)
    }
    clear = zip(zones, clearances.tolist(), at.tolist(), strict=True)
    return Margins(
        **facts,
        crossover_hz=float(bounds[CROSSOVER, 1]),
        disks=disks_of(found.distances),
        clearances=tuple(Clearance(zone, value, hz, complex(there)) for zone, (value, hz), there in clear),
    )


BOUNDS = ("gain_up_db", "gain_down_db", "phase_deg", "delay_s", "aero_gain_db", "rigid_gain_db", "rigid_phase_deg")
"""The fields of `Margins` in the rows of `bounds_of`, which end with the crossover frequency."""
GAIN_UP, GAIN_DOWN, PHASE, DELAY, AERO_GAIN, RIGID_GAIN, RIGID_PHASE, CROSSOVER = range(len(BOUNDS) + 1)


class LoopResults(NamedTuple):
    """The results of the compiled functions for one loop."""

    trace: Trace
    crossings: Crossings
    growing: int
    encircled: int
    lobes: Array
    bounds: Array
    distances: Array
    nearest: tuple[Array, ComplexArray]


@entry
def _trace(
    open_: ComplexArray, closed: ComplexArray, lowest: float, end: float, factors: ZerosAndPoles, source: LoopResponse
) -> Trace:
    t = curves.traced(open_, closed, lowest, end, source)
    f, loop = curves.with_extremes(t.frequency_hz, t.loop, 3, source)
    if t.problem == 0:
        f, loop = separated(f, loop, factors, source)
    return Trace(f, loop, t.slope_at_zero, t.at_zero, t.slope_at_end, t.finite_end, t.problem)


@entry
def _measure(
    t: Trace,
    open_: ComplexArray,
    closed: ComplexArray,
    centre: Array,
    width: Array,
    part: ComplexArray,
    slosh: NDArray[np.bool_],
    least_share: float,
    limit_db: float,
    zones: Array,
    source: LoopResponse,
) -> LoopResults:
    every, after, growing, encircled = counted(t, open_, closed, source)
    on_axis = open_.imag[open_.real == 0.0] / (2.0 * np.pi)
    table = find_lobes(after, every, centre, width, part, least_share, limit_db, on_axis, source)
    bounds, nearest = bounds_of(after, every, table, slosh), find_clearances(after, every, zones, source)
    return LoopResults(after, every, growing, encircled, table, bounds, least_distances(after), nearest)


@routine
def counted(
    t: Trace, open_: ComplexArray, closed: ComplexArray, source: LoopResponse
) -> tuple[Crossings, Trace, int, int]:
    """Return the crossings of a curve, the curve with the crossings added, and two counts of unstable poles.

    The curve `t` must contain its turning points. The counts are those from the list of poles and from the
    encirclements.
    """
    past = crossings.steps_past_poles(t.frequency_hz, open_, closed)
    every, f, loop = crossings.crossings(t, past, source)
    after = Trace(f, loop, t.slope_at_zero, t.at_zero, t.slope_at_end, t.finite_end, 0)
    growing = crossings.growing_count(closed, 2.0 * np.pi * f[0])
    return every, after, growing, crossings.encirclement_count(after, every, past, t, open_)


@routine
def bounds_of(t: Trace, every: Crossings, table: Array, slosh: NDArray[np.bool_]) -> Array:
    """Return the least value of each margin and its frequency in Hz, (BOUNDS and the crossover, 2).

    A margin without a bound is infinite at a frequency of NaN.
    """
    out = np.full((CROSSOVER + 1, 2), np.nan)
    out[:, 0] = np.inf
    out[CROSSOVER, 1] = 0.0
    bending = np.ones(len(table), np.bool_)
    for j in range(len(table)):
        bending[j] = not slosh[int(table[j, NUMBER])]
    for k in range(len(every.gain_hz)):
        hz, lag = every.gain_hz[k], lag_of(every.gain_loop[k])
        turn = min(lag, 360.0 - lag)
        _lower(out[PHASE], turn, hz)
        _lower(out[DELAY], lag / (360.0 * hz), hz)
        if not in_lobes(hz, table, bending):
            _lower(out[RIGID_PHASE], turn, hz)
            if every.gain_way[k] < 0:
                out[CROSSOVER, 1] = max(out[CROSSOVER, 1], hz)
    if not t.finite_end and t.slope_at_end == 0 and abs(t.loop[len(t.loop) - 1]) >= 1.0:
        out[DELAY, 0], out[DELAY, 1] = 0.0, np.inf
    for k in range(len(every.phase_hz)):
        hz, db = every.phase_hz[k], -DB * log_abs(every.phase_loop[k])
        free = not in_lobes(hz, table, np.ones(len(table), np.bool_))
        if db >= 0.0:
            _lower(out[GAIN_UP], db, hz)
            if free and hz >= out[CROSSOVER, 1]:
                _lower(out[RIGID_GAIN], db, hz)
        else:
            _lower(out[GAIN_DOWN], -db, hz)
            if free and hz <= out[CROSSOVER, 1]:
                _lower(out[AERO_GAIN], -db, hz)
    return out


@routine
def _lower(out: Array, value: float, hz: float) -> None:
    if value < out[0]:
        out[0], out[1] = value, hz
