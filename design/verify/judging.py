"""The assessment of a design at operating points: margins, peaks and rigid-body motion, and the limits on them."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Literal

import numpy as np

from maxq.control.kernel.records import Array
from maxq.design.case.basis import Basis, LoadLimits, limit_of, stated_basis
from maxq.design.case.goals import GoalSection
from maxq.design.laws.wind import WIND_LIMITS, Key, quantity
from maxq.design.loop.filter_motion import MOST_MOTION, motion_shares
from maxq.design.loop.fixed_path import LoopKind
from maxq.design.loop.loop import loops
from maxq.design.loop.multiloop import multiloops
from maxq.design.margins.budget import Budget, crossing_budgets
from maxq.design.margins.distances import Zone
from maxq.design.margins.measure import Margins, margins
from maxq.design.margins.measured_loop import LoopAtPoint, measure_loop
from maxq.design.margins.multiloop import MultiloopMargins, multiloop_margins
from maxq.design.model.operating_point import OperatingPoint
from maxq.design.quantities import MEASURED, QUANTITIES, Convention, Quantity, ZoneName, violation
from maxq.design.verify.goal_checks import goal_limit, goal_value, hard_goals
from maxq.design.verify.memory import counted
from maxq.sim.input.values import OverTime, at_time
from maxq.sim.packing.computer import bending_filter
from maxq.sim.scenario.loader import LoadedScenario
from maxq.sim.scenario.schema_design import AdaptiveSection, Design

JUDGED = (*MEASURED, "filter_gain_at_infinity", "integral_hz", "most_integral_hz")
"""The keys of the limits on a design at its operating points, in the order of reports."""
ZONE = "clear of the {0.shape} {0.gain_db:g} dB, {0.phase_deg:g} deg"


@dataclass(frozen=True)
class Wanted:
    """The limits on a design, by key of `QUANTITIES`."""

    limits: Mapping[str, float | OverTime] = field(default_factory=dict)
    zone: Zone | None = None
    by: Convention = field(default_factory=Convention)

    @staticmethod
    def of(limits: Any) -> Wanted:
        """Return the limits of a section of a case or a design, except those in its `without`. None has no limits."""
        left_out = getattr(limits, "without", ())
        asked = {key: getattr(limits, key, None) for key in JUDGED if key not in left_out}
        known = {key: value for key, value in asked.items() if value is not None}
        shape: ZoneName = getattr(limits, "zone", None) or "none"
        zone = None if shape == "none" else Zone(shape, limits.phase_margin_deg, limits.gain_margin_db)
        return Wanted(known, zone, Convention(rigid_body=getattr(limits, "rigid_body", None) or "paper"))

    @staticmethod
    def stated_by(design: Design, stage: int = 0) -> Wanted:
        """Return the limits in the basis of a design. Without a basis there are none. Raises ScenarioError."""
        basis = stated_basis(design, stage)
        return Wanted.of(None if basis is None else basis.limits)

    def constant(self, key: str) -> float | None:
        """Return a limit that is constant over time, or None if it varies or is not set."""
        limit = self.limits.get(key)
        return None if isinstance(limit, OverTime) else limit


@dataclass(frozen=True)
class JudgedLoop(LoopAtPoint):
    """A loop at an operating point, with the adaptation of its design."""

    adaptive: AdaptiveSection | None = None

    @cached_property
    def budgets(self) -> dict[str, Budget]:
        """Return the margin budget at each crossing that determines a margin. There is none for an unstable loop."""
        return crossing_budgets(self.loop, self.margins)

    @property
    def gain_margin_db(self) -> float:
        """Return the lesser of upper and lower gain margin over all crossings, or NaN for an unstable loop."""
        return self.margins.gain_db

    @cached_property
    def at_total_gains(self) -> dict[float, Margins]:
        """Return the margins at the limits of the total gain of adaptive control; empty without it."""
        ends = () if self.adaptive is None else (self.adaptive.least_gain, self.adaptive.most_gain)
        loops = {gain: replace(self.loop, law=self.loop.law.scaled(gain)) for gain in ends}
        return {gain: margins(loop, resonances=self.loop.fixed.resonances()) for gain, loop in loops.items()}


@dataclass(frozen=True)
class Check:
    """A limit and the values to which it applies: one for each operating point, or a single one for the filter."""

    key: str
    text: str
    unit: str
    sense: Literal[">=", "<="]
    limit: float | Array  # one for each value, if the limit varies over time
    values: Array
    time_s: Array  # NaN for the filter
    short: str = ""  # heading of a column, if `QUANTITIES` has none

    @property
    def heading(self) -> str:
        """Return the heading of the column."""
        return QUANTITIES[self.key].heading if self.key in QUANTITIES else self.short or self.text

    def met(self) -> np.ndarray:
        """Return True for each value that meets the limit. NaN, for an unstable loop, does not meet it."""
        return np.asarray(violation(self.values, self.limit, self.sense, self.unit) <= 0.0)

    @property
    def passed(self) -> bool:
        return bool(self.met().all())

    @property
    def worst(self) -> int:
        """Return the index of the value with the least margin to the limit. An unstable loop has priority."""
        margin = self.values - self.limit if self.sense == ">=" else self.limit - self.values
        margin = margin / self.limit if np.ndim(self.limit) else margin
        bad = np.isnan(self.values) & ~self.met()
        return int(np.argmax(bad)) if bad.any() else int(np.nanargmin(margin)) if np.isfinite(margin).any() else 0

    @property
    def wanted(self) -> float:
        """Return the limit at the worst value."""
        return float(np.broadcast_to(self.limit, self.values.shape)[self.worst])


def judge(
    nodes: Sequence[OperatingPoint],
    design: Design,
    kind: LoopKind = "sampled",
    tell: Callable[[int], None] | None = None,
) -> list[JudgedLoop]:
    """Return the loops of the design at all operating points, with margins.

    `tell` is called with the number of completed points.
    """
    out = []
    for n, loop in enumerate(loops(nodes, design, kind=kind)):
        found = measure_loop(loop)
        adaptive = design.of_stage(found.node.stage).adaptive
        out.append(JudgedLoop(found.loop, found.margins, adaptive))
        if tell is not None:
            tell(n + 1)
    return out


def checks(judged: Sequence[JudgedLoop], design: Design, wanted: Wanted) -> list[Check]:
    """Return the checks of all limits that are set, with stability first."""
    time_s = np.array([j.time_s for j in judged])
    unstable = np.array([float(max(j.margins.unstable_poles, not j.margins.stable)) for j in judged])
    out = [Check("unstable_poles", "unstable poles", "", "<=", 0.0, unstable, time_s)]
    for end in ("least_gain", "most_gain"):
        held = [(j.time_s, getattr(j.adaptive, end)) for j in judged if j.adaptive is not None]
        poles = [float(not j.at_total_gains[getattr(j.adaptive, end)].stable) for j in judged if j.adaptive is not None]
        if held:
            text = f"unstable at a total gain of {held[0][1]:g}"
            out.append(Check(f"total_{end}", text, "", "<=", 0.0, np.array(poles), np.array([t for t, _ in held])))
    if wanted.zone is not None:
        text = ZONE.format(wanted.zone)
        out.append(Check("zone", text, "", ">=", 0.0, np.array([_clearance(j, wanted.zone) for j in judged]), time_s))
    out += motion_checks(judged, design)
    for key, asked in wanted.limits.items():
        about = QUANTITIES[key]
        if about.value is None:
            continue
        limit = at_time(asked, time_s) if isinstance(asked, OverTime) else float(asked)
        values = np.array([about.value(j, wanted.by) for j in judged])
        out.append(Check(key, about.label, about.unit, about.sense, limit, values, time_s))
    most = wanted.constant("filter_gain_at_infinity")
    if most is not None:
        gains, about = [], QUANTITIES["filter_gain_at_infinity"]
        for stage in sorted({j.node.stage for j in judged}):
            own = design.of_stage(stage)
            flown, mine = bending_filter(own), [j.node for j in judged if j.node.stage == stage]
            gains.append(
                max(flown(node.scheduled(own.gains.over) if flown.moves else 0.0).gain_at_infinity for node in mine)
            )
        never = np.full(len(gains), np.nan)
        out.append(Check("filter_gain_at_infinity", about.label, "", about.sense, most, np.array(gains, float), never))
    return out


def goal_checks(judged: Sequence[JudgedLoop], goals: Sequence[GoalSection], dispersed: bool = False) -> list[Check]:
    """Return the checks of the hard goals of a case or a basis; for a template, of the largest excess over it."""
    out = []
    for k, goal in enumerate(hard_goals(goals, dispersed), 1):
        mine, about = [j for j in judged if goal.applies(j.time_s, dispersed)], goal.about
        values, at = np.array([goal_value(j, goal) for j in mine]), np.array([j.time_s for j in mine])
        if mine:
            limit, key = goal_limit(goal), f"goal_{k}"
            out.append(Check(key, about.label, about.unit, about.sense, limit, values, at, about.heading))
    return out


def motion_checks(judged: Sequence[LoopAtPoint], design: Design) -> list[Check]:
    """Return the check of the motion of scheduled filters (design/loop/filter_motion.py); empty without them."""
    values, times_s = list[float](), list[float]()
    for stage, plane in sorted({(j.node.stage, j.node.plane) for j in judged}):
        mine = [j for j in judged if (j.node.stage, j.node.plane) == (stage, plane)]
        shares = motion_shares([j.loop for j in mine], design.of_stage(stage))
        values += shares
        times_s += [j.time_s for j in mine] if shares else []
    about = QUANTITIES["filter_motion"]
    at = np.array(times_s)
    found = Check("filter_motion", about.label, about.unit, about.sense, MOST_MOTION, np.array(values), at)
    return [found] if values else []


def flies_as_measured(kind: str, errata: str, plant: str) -> bool:
    """Return True for the simulator's own loop and plant.

    Measurements of all axes and of dispersed vehicles require them.
    """
    return (kind, errata, plant) == ("sampled", "corrected", "flown")


def margins_of_all_axes(
    flight: LoadedScenario,
    design: Design,
    times_s: Sequence[float],
    basis: Basis,
    watch: Callable[[int, int], None] = lambda done, of: None,
) -> list[MultiloopMargins]:
    """Return the margins of each axis with the other loops closed, at vehicle times (s) of a flight.

    The result is empty if `basis` refers to a loop or plant other than that of the simulator.
    """
    if not flies_as_measured(basis.loop, basis.errata, basis.plant):
        return []
    return list(map(counted(multiloop_margins, watch, len(set(times_s))), multiloops(flight, design, times_s)))


def multiloop_checks(found: Sequence[MultiloopMargins], wanted: Wanted) -> list[Check]:
    """Return the checks of stability, and of gain and phase margin of each axis with the other loops closed."""
    if not found:
        return []
    time_s = np.array([m.time_s for m in found])
    unstable = np.array([float(not m.stable) for m in found])
    out = [Check("coupled_unstable", "unstable with all axes", "", "<=", 0.0, unstable, time_s)]
    measures: dict[str, Callable[[Margins], float]] = {
        "gain_margin_db": lambda m: m.gain_db, "phase_margin_deg": lambda m: m.phase_deg.value,
    }  # fmt: skip  # a table
    for key, measure in measures.items():
        limit, about = wanted.constant(key), QUANTITIES[key]
        for k, axis in enumerate(found[0].axes if limit is not None else ()):
            assert limit is not None
            values, text = np.array([measure(m.each[k]) for m in found]), f"{about.label}, {axis}, other axes closed"
            out.append(Check(f"coupled_{axis}_{key}", text, about.unit, about.sense, limit, values, time_s))
    return out


def _clearance(j: JudgedLoop, zone: Zone) -> float:
    known = j.margins.clearances
    if j.margins.stable and all(c.zone != zone for c in known):
        known = margins(j.loop, resonances=(), zones=(zone,)).clearances
    return next((c.value for c in known if c.zone == zone), math.nan)


@dataclass(frozen=True)
class InWind:
    """A quantity in wind at the operating points, for a design and for the default design of the scenario."""

    key: Key
    rms: Array  # (nodes,), nan if the loop is unstable
    before: Array | None  # None if the scenario has no design

    @property
    def name(self) -> str:
        return self.key if isinstance(self.key, str) else f"bending_moment_{self.key:g}_m"

    @property
    def about(self) -> Quantity:
        return quantity(self.key)


def stage_checks(judged: Sequence[JudgedLoop], design: Design, basis: Basis, kind: LoopKind) -> list[Check]:
    """Return the checks of all limits in a stage's basis, including those in wind."""
    nodes, here = [j.node for j in judged], basis.model_copy(update={"loop": kind})
    found = [*checks(judged, design, Wanted.of(basis.limits)), *goal_checks(judged, basis.goal)]
    return found + wind_checks(in_wind(here, nodes, design, None), basis.limits, nodes)


def worst_times_s(found: Iterable[Check]) -> set[float]:
    """Return the times (s) at which limits have their least margins, one for each limit."""
    return {time_s for check in found if not math.isnan(time_s := float(check.time_s[check.worst]))}


def in_wind(case: Basis, nodes: Sequence[OperatingPoint], design: Design, before: Design | None) -> list[InWind]:
    """Return the quantities in wind that a case or a basis can limit, at its stations; empty without wind."""
    if case.wind is None:
        return []
    keys, rms = _rms(case, nodes, design)
    own = None if before is None else _rms(case, nodes, before)[1]
    return [InWind(key, rms[k], None if own is None else own[k]) for k, key in enumerate(keys)]


def _rms(case: Basis, nodes: Sequence[OperatingPoint], design: Design) -> tuple[list[Key], Array]:
    """Return the keys of the quantities in wind, and their rms values (quantities, nodes)."""
    found, keys = [], list[Key](WIND_LIMITS)
    from maxq.design.optimise.plants import wind_of  # noqa: PLC0415  # lazy: with a wind only

    for loop in loops(nodes, design, kind=case.loop):
        path = loop.fixed
        path.measurements = loop.law.inputs
        wind = wind_of(path, case)
        keys = [*WIND_LIMITS, *wind.stations_m]
        law = loop.law.response(np.exp(wind.x))
        values = wind.rms(range(len(keys)), law, np.zeros((*law.shape, 0)))[0]
        found.append(values if margins(loop, resonances=()).stable else np.full(len(keys), np.nan))
    return keys, np.array(found).T


def wind_checks(found: Sequence[InWind], limits: LoadLimits, nodes: Sequence[OperatingPoint]) -> list[Check]:
    """Return the checks of the limits in wind."""
    time_s, out = np.array([node.time_s for node in nodes]), []
    for one in found:
        limit, about = limit_of(limits, one.key), one.about
        if limit is not None:
            out.append(
                Check(f"wind_{one.name}", about.label, about.unit, about.sense, limit, one.rms, time_s, about.heading)
            )
    return out
