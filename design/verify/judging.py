"""The assessment of a design at operating points: margins, peaks and rigid-body motion, and the limits on them.

`DesignOutcome` is the result of a case, with its design assessed as written to the file.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Literal

import numpy as np

from maxq.control.kernel.records import Array
from maxq.design.case.basis import Basis, LoadLimits, limit_of, stated_basis
from maxq.design.case.schema import Case, LoadedCase
from maxq.design.laws.design_file import design_of
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
from maxq.design.model.node import flown_point
from maxq.design.model.operating_point import OperatingPoint
from maxq.design.optimise.criteria import OBJECTIVES
from maxq.design.optimise.plants import wind_of
from maxq.design.optimise.robust import dispersed_nodes, ranges_of
from maxq.design.optimise.solution import Solution
from maxq.design.quantities import MEASURED, QUANTITIES, Convention, Quantity, ZoneName, violation
from maxq.design.verify.memory import counted
from maxq.sim.input.errors import ScenarioError
from maxq.sim.input.tables_csv import CsvTable
from maxq.sim.input.values import OverTime, at_time
from maxq.sim.packing.computer import bending_filter
from maxq.sim.scenario.loader import LoadedScenario
from maxq.sim.scenario.schema_design import AdaptiveSection, Design, LoopFiltersSection, StageLaw

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


@dataclass(frozen=True)
class DesignOutcome:
    """The assessment of a design by its case.

    It covers the case's own loop, the loop as flown, and dispersed plants of a robust case.
    """

    loaded: LoadedCase
    design: Design
    judged: Sequence[JudgedLoop]
    found: Sequence[Check]
    flown_found: Sequence[Check]  # on the sampled loop; equal to `found` if the case's loop is sampled
    dispersed_found: Sequence[Check]  # at the worst plants of a robust case
    wanted: Wanted
    in_wind: Sequence[InWind] = ()  # at `judged`
    coupled_found: Sequence[Check] = ()  # for each axis with the other loops closed, along the design's own flight

    @property
    def flies_otherwise(self) -> bool:
        """Return True if the flight computer is sampled but the loop of the case is not."""
        return self.loaded.case.loop != "sampled" and self.judged[0].node.instruments.sample_s > 0.0

    @property
    def feasible(self) -> bool:
        """Return True if all limits of the case are met. Checks on the sampled loop are for information only."""
        return all(check.passed for check in (*self.found, *self.coupled_found, *self.dispersed_found))

    @property
    def missed(self) -> list[str]:
        """Return a line for each missed limit, with the amount."""
        out = []
        for where, found in (("", (*self.found, *self.coupled_found)), (" of dispersed plants", self.dispersed_found)):
            for check in (c for c in found if not c.passed):
                value, time_s = check.values[check.worst], check.time_s[check.worst]
                by = "" if np.isnan(value) else f" by {abs(value - check.wanted):.3g} {check.unit}".rstrip()
                at = "" if np.isnan(time_s) else f" at {time_s:g} s"
                out.append(f"{check.text}{where} missed{by}{at}")
        return out


def make_design(loaded: LoadedCase, *solutions: Solution, missed: Sequence[int] = ()) -> Design:
    """Return the design to be written, from one solution per stage.

    The description begins with that of the case and continues with the form and the result of each stage. Roll control,
    and stages that were not designed, are taken from the scenario's own design. `missed` contains the stages, from 0,
    that miss limits along the design's own flight.
    """
    case, points, base = loaded.case, loaded.points, loaded.base
    own, stages = (None, 1) if base is None else (base.design, len(base.vehicle.stage))
    forms, results = list[tuple[str, str, str]](), list[str]()  # of each stage
    for n, solution in sorted((s.nodes[0].stage, s) for s in solutions):
        mine, where = solution.case, f"stage {n + 1}: " if stages > 1 else ""
        met = solution.feasible and n not in missed
        forms.append((mine.filter.structure, mine.gains.schedule, mine.loop))
        results.append(f"{where}{objective_text(solution)}; {solution.met if met else 'limits are missed'}")
    text = described(case.description, forms, results)

    def alone(solution: Solution) -> Design:
        stage, at_s = solution.nodes[0].stage, tuple(node.time_s for node in solution.nodes)
        rolls = own.of_stage(stage) if own else None
        designed = design_of(
            name=loaded.name,
            description=text,
            vehicle=points.name if points is not None else loaded.scenario.vehicle.name,
            law=solution.law,
            roll=rolls.roll if rolls else None,
            basis=solution.case.basis("" if base is None else base.name, at_s).as_table(),
        )
        return designed.model_copy(update={"roll_gimbal": rolls.roll_gimbal if rolls else None})

    designs = {solution.nodes[0].stage: alone(solution) for solution in solutions}
    first = designs[min(designs)]
    if stages == 1:
        return first
    names = StageLaw.model_fields
    flown = [designs.get(n) or (with_law(own.of_stage(n), first) if own else first) for n in range(stages)]
    # states the absence of loop filters if another stage has some
    none = LoopFiltersSection() if any(d.loop_filters is not None for d in flown) else None
    laws = []
    for n, d in enumerate(flown):
        said = {k: getattr(d, k) for k in names if k != "fade_s"} | {"loop_filters": d.loop_filters or none}
        laws.append(StageLaw(**said, fade_s=own.stage[n].fade_s if own and n < len(own.stage) else None))
    return first.model_copy(update={"stage": tuple(laws), "basis": None})


def with_law(own: Design, other: Design) -> Design:
    """Return a stage's design expressed in the law of another design, with additional gains of 0.

    Raises ScenarioError if the design has gains that the other law does not have.
    """
    if own.law == other.law:
        return own
    if not set(own.gain_names) <= set(other.gain_names):
        raise ScenarioError(
            own.name or "design",
            "flies in stages that the case does not design",
            "law",
            value=own.law,
            allowed=f"a scenario whose design is of the law {other.law}, or of pd",
        )
    tables = {
        key: CsvTable(
            "",
            {
                **table.columns,
                **{
                    k: np.full(len(table), -1.0 if k == "accel_per_incidence_mps2" else 0.0)
                    for k in other.gain_names
                    if k not in table
                },
            },
        )
        for key in ("table", "yaw_table")
        if (table := getattr(own.gains, key)) is not None
    }
    return own.model_copy(update={"gains": own.gains.model_copy(update=tables), "load_relief": other.load_relief})


def described(purpose: str, forms: Sequence[tuple[str, str, str]], results: Sequence[str]) -> str:
    """Return the description of a design: its purpose, and the form and the result of each stage.

    A form is the names of the filter, the gain schedule and the loop model. Equal names of gains or loops are not
    repeated.
    """
    filters, gains, kinds = zip(*forms, strict=True)
    form = f"filter {'/'.join(filters)}, {'/'.join(dict.fromkeys(gains))} gains, {'/'.join(dict.fromkeys(kinds))} loop"
    first = f"{purpose.rstrip('.')} ({form})" if purpose else form
    return ". ".join([first, *(text[0].upper() + text[1:] for text in results)])


def objective_text(solution: Solution) -> str:
    """Return the name and the value reached of the objective.

    For a robust case, the values of the worst plant found and of the nominal plants are given.
    """
    reached = OBJECTIVES[solution.case.objective.kind].reached
    text = reached(solution.objective_db)
    if solution.case.robust is None:
        return text
    return f"{text} at the worst plant found ({reached(solution.nominal_objective_db)} nominal)"


def wanted_of(case: Case) -> Wanted:
    """Return the limits that a case with one stage imposes."""
    return Wanted.of(case.basis("", case.times_s).limits)


def stage_checks(judged: Sequence[JudgedLoop], design: Design, basis: Basis, kind: LoopKind) -> list[Check]:
    """Return the checks of all limits in a stage's basis, including those in wind."""
    nodes, here = [j.node for j in judged], basis.model_copy(update={"loop": kind})
    found = checks(judged, design, Wanted.of(basis.limits))
    return found + wind_checks(in_wind(here, nodes, design, None), basis.limits, nodes)


def worst_times_s(found: Iterable[Check]) -> set[float]:
    """Return the times (s) at which limits have their least margins, one for each limit."""
    return {time_s for check in found if not math.isnan(time_s := float(check.time_s[check.worst]))}


def judge_solution(
    loaded: LoadedCase, solution: Solution, design: Design | None = None, between: Sequence[OperatingPoint] = ()
) -> DesignOutcome:
    """Assess the design as written, at the operating points of the search.

    The dispersed plants of a robust search are included. `design` is the design of all stages, if the solution is one
    of several. `between` contains additional operating points.
    """
    design, case = design or make_design(loaded, solution), loaded.case
    nodes = sorted((*solution.nodes, *between), key=lambda node: node.time_s)
    wanted = wanted_of(case)

    judged = judge(nodes, design, case.loop)
    as_flown = case.loop == "sampled" or not nodes[0].instruments.sample_s > 0.0
    flown = checks(judged if as_flown else judge(nodes, design, "sampled"), design, wanted)
    winds = in_wind(case, nodes, design, None if loaded.base is None else loaded.base.design)
    found = [*(flown if as_flown else checks(judged, design, wanted))]
    found += wind_checks(winds, case.limits, nodes)
    if case.robust is None:
        return DesignOutcome(loaded, design, judged, found, flown, [], wanted, winds)
    vehicles = [flown_point(node) for node in nodes]
    dispersed = dispersed_nodes(ranges_of(loaded, vehicles), vehicles, solution.constraints)
    off = checks(judge(dispersed, design, case.loop), design, Wanted.of(case.robust.limits)) if dispersed else []
    if dispersed:
        off += wind_checks(in_wind(case, dispersed, design, None), case.robust.limits, dispersed)
    return DesignOutcome(loaded, design, judged, found, flown, off, wanted, winds)


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
