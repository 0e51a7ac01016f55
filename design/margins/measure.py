"""Margins of a loop: gain, phase, delay and disk margins, zones and lobes, with stability counted twice."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from maxq.control.kernel.records import Array
from maxq.design.loop.loop import OpenLoop
from maxq.design.loop.resonance import Resonance
from maxq.design.margins import curve as curves
from maxq.design.margins.bounds import separated
from maxq.design.margins.curve import Curve, GainCrossings, PhaseCrossings, lowest_hz_of, unstable
from maxq.design.margins.distances import NO_DISKS, Clearance, Disks, Zone, find_clearances, find_disks
from maxq.design.margins.lobes import Lobe, find_lobes

DIAMOND = Zone("diamond", 30.0, 6.0)
BENDING_KINDS = ("bending", "slosh")


@dataclass(frozen=True)
class Bound:
    """The least of several values and its frequency: infinite at NaN if nothing bounds; NaN for an unstable loop."""

    value: float
    frequency_hz: float

    def __float__(self) -> float:
        return self.value


NOTHING = Bound(np.nan, np.nan)


@dataclass(frozen=True, kw_only=True)
class Margins:
    """Margins of a stable loop: positive numbers, infinite where nothing bounds them.

    The rigid body's own: `rigid_phase` is the least over the crossings outside bending lobes (slosh may lie on them),
    `crossover_hz` the last of those where |L| falls; `rigid_gain` and `aero_gain` are the gain margins, up and down,
    of the crossings in no lobe above and below it. Unnamed lobes are taken for bending.

    Those of an unstable loop are all NaN, so that no comparison with a limit can pass; `stable`, `unstable_poles` and
    `growth_1ps` say how far it is from stability. The crossings and `curve` describe L and are always there.

    A bound is a value and its frequency (zero and infinity being limits). `gain_up` is the gain that may be added
    before the loop meets -1, `gain_down` that which may be removed; over all crossings, lobes included, they are
    exact: between them the loop is stable. `phase` is the least turn either way over all
    crossings of |L| = 1. `delay` is the least delay in s that brings a crossing to -1; of a sampled loop it is exact
    for whole periods, and the turn of phase alone in between. A continuous loop that stays above 1 has none: 0.
    """

    stable: bool
    unstable_poles: int  # zeros of 1 + L to the right of the axis, from their list
    encircled_poles: int  # the same from the curve's encirclements; a disagreement makes the loop count as unstable
    growth_1ps: float  # greatest real part of the closed loop's poles: growth, or minus the slowest decay
    growth_hz: float  # of that pole
    gain_crossings: GainCrossings
    phase_crossings: PhaseCrossings
    curve: Curve
    clearances: tuple[Clearance, ...]
    gain_up_db: Bound = NOTHING
    gain_down_db: Bound = NOTHING
    phase_deg: Bound = NOTHING
    delay_s: Bound = NOTHING
    aero_gain_db: Bound = NOTHING
    rigid_gain_db: Bound = NOTHING
    rigid_phase_deg: Bound = NOTHING
    crossover_hz: float = np.nan  # 0 without one
    disks: Disks = NO_DISKS
    lobes: tuple[Lobe, ...] = ()

    @property
    def modulus(self) -> float:
        """min |1 + L|."""
        return self.disks.sensitivity.size

    @property
    def gain_db(self) -> float:
        """The lesser of gain up and gain down over all crossings; NaN if unstable."""
        return float(np.minimum(self.gain_up_db.value, self.gain_down_db.value))

    @property
    def growth_time_s(self) -> float:
        """Time in which an unstable loop grows e-fold; infinite for a stable one."""
        return 1.0 / self.growth_1ps if self.growth_1ps > 0.0 else np.inf


def margins(
    loop: OpenLoop,
    *,
    resonances: Sequence[Resonance] | None = None,
    zones: Sequence[Zone] = (DIAMOND,),
    gain_stabilised_db: float = 0.0,
    lowest_hz: float | None = None,
) -> Margins:
    """Measure a loop. Crossings and distances are solved for: 1e-8 dB and degrees where L itself is as good.

    No crossing is missed where the loop's zeros and poles are known (`OpenLoop.factors`; of the negative real axis
    above -80 dB), however close to each other two of them lie (bounds.py); of the kind `exact` the grid decides.

    `resonances` name the lobes; of those only bending and slosh are looked at. Without them every open-loop pole
    with a damping ratio below 0.1 that shows in L is a lobe. A lobe that peaks below minus `gain_stabilised_db` is
    gain-stabilised. Poles slower than `lowest_hz` (integrators among them; default: `curve.lowest_hz_of`) are drift:
    they neither count as unstable nor are looked for in L.
    Raises ValueError for a response that is not finite, and for an improper loop.
    """
    curve = curves.trace(loop, lowest_hz_of(np.asarray(loop.open_poles())) if lowest_hz is None else lowest_hz)
    gain, phase, curve = curves.find_crossings(separated(curves.refine_extremes(curve)))
    growing = unstable(curve.closed_poles, curve.lowest_radps)
    encircled = curves.encirclement_count(curve, phase)
    slow = curve.closed_poles[np.abs(curve.closed_poles) > curve.lowest_radps]
    slowest = slow[np.argmax(slow.real)] if len(slow) else complex(-np.inf, 0.0)
    stable = len(growing) == 0 and encircled == 0
    facts: dict[str, Any] = {
        "stable": stable, "unstable_poles": len(growing), "encircled_poles": encircled,
        "growth_1ps": float(slowest.real), "growth_hz": float(abs(slowest.imag) / (2.0 * np.pi)),
        "gain_crossings": gain, "phase_crossings": phase, "curve": curve,
    }  # fmt: skip  # five more lines otherwise
    if not stable:
        nothing = complex(np.nan, np.nan)
        return Margins(**facts, clearances=tuple(Clearance(zone, np.nan, np.nan, nothing) for zone in zones))
    named = None if resonances is None else [r for r in resonances if r.kind in BENDING_KINDS]
    lobes = find_lobes(curve, gain, phase, named, gain_stabilised_db)
    bending = [lobe for lobe in lobes if lobe.kind != "slosh"]
    rigid, free = ~_inside(gain.frequency_hz, bending), ~_inside(phase.frequency_hz, lobes)
    crossover = float(gain.frequency_hz[rigid & ~gain.rising].max(initial=0.0))
    db, f = phase.gain_margin_db, phase.frequency_hz
    turn = np.abs(gain.phase_margin_deg)
    stays_above_1 = not curve.finite_end and curve.slope_at_end == 0 and abs(curve.loop[-1]) >= 1.0
    return Margins(
        **facts,
        gain_up_db=least(db, f, db >= 0.0),
        gain_down_db=least(-db, f, db < 0.0),
        phase_deg=least(turn, gain.frequency_hz),
        delay_s=Bound(0.0, np.inf) if stays_above_1 else least(gain.delay_s, gain.frequency_hz),
        aero_gain_db=least(-db, f, (db < 0.0) & free & (f <= crossover)),
        rigid_gain_db=least(db, f, (db >= 0.0) & free & (f >= crossover)),
        rigid_phase_deg=least(turn, gain.frequency_hz, rigid),
        crossover_hz=crossover,
        disks=find_disks(curve),
        clearances=find_clearances(curve, tuple(zones), gain, phase),
        lobes=lobes,
    )


def _inside(f: Array, lobes: Sequence[Lobe]) -> NDArray[np.bool_]:
    out = np.zeros(len(f), bool)
    for lobe in lobes:
        out |= (f >= lobe.low_hz) & (f <= lobe.high_hz)
    return out


def least(values: Array, frequency_hz: Array, among: NDArray[np.bool_] | None = None) -> Bound:
    """The least of the values, or of those `among` selects."""
    k = np.arange(len(values)) if among is None else np.flatnonzero(among)
    if not len(k):
        return Bound(np.inf, np.nan)
    i = int(k[np.argmin(values[k])])
    return Bound(float(values[i]), float(frequency_hz[i]))
