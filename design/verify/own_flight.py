"""The design of a case along the flight of the design itself. Design and flight are repeated until they agree.

Operating points require a flight, and a flight requires a design. The first flight is that of the scenario with its own
design. Design and flight agree if all limits that the design meets in the search are also met at the same times of its
own flight. The tolerance is 5e-4 dB or deg (`quantities.violation`). Stages that disagree are designed again along the
flight of the last design, starting from its values. If limits must hold between the operating points, they are assessed
there at the instants of `simdesign analyse`. An instant that misses a limit becomes an operating point of the next
round.

The search applies the limits to the loop of one plane. The command `simdesign analyse` applies the same limits to each
axis with the other loops closed, which reduces the margins slightly. If a stage misses limits for this reason, the
limits of the next round's search are raised by the missing amount. The design file states the limits of the case. If no
design meets the raised limits, the last design is kept. The roll loop is assessed too, but the search does not affect
it. The search also does not affect slow roots of a vehicle whose roll rate no linear loop controls. Stability with all
axes is therefore left to `simdesign analyse`.

A flight that is lost provides operating points up to the loss only. A short search then makes a preliminary design for
these. Its own flight remains controlled for longer, and provides the points of the next round.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace

from maxq.design.case.schema import LoadedCase
from maxq.design.model.node import Node, flown_point
from maxq.design.model.powered import loss_text, powered_flight
from maxq.design.optimise.at_nodes import make_problem
from maxq.design.optimise.over_time import burns_of, gains_at_nodes, instants_beside, with_nodes
from maxq.design.optimise.plants import Plants, make_plant, make_plants, nodes_of
from maxq.design.optimise.search import SearchProgress
from maxq.design.optimise.solution import Solution
from maxq.design.optimise.solve import each_stage, nominal_plants, solve
from maxq.design.quantities import QUANTITIES, TOLERANCE
from maxq.design.verify.judging import judge, margins_of_all_axes, multiloop_checks, stage_checks, worst_times_s
from maxq.design.verify.names import stage_name
from maxq.design.verify.outcome import DesignOutcome, judge_solution, make_design
from maxq.design.verify.uncovered import Uncovered, uncovered
from maxq.sim.run.flight import Event
from maxq.sim.scenario.loader import LoadedScenario
from maxq.sim.scenario.schema_design import Design

ROUNDS = 8
COUPLED = ("gain_margin_db", "phase_margin_deg")
BEYOND = 2.0 * TOLERANCE  # added to the shortfall with the other axes closed, dB or deg
LEAST_GAIN_S = 0.05  # least extension of the flight by a preliminary design


@dataclass(frozen=True)
class Round:
    """The summary of a round: the flight along which the design was made, and the outcome of its own flight."""

    number: int
    points: int
    first_s: float
    last_s: float
    loss: Event | None  # loss of the flight along which the design was made
    own_loss: Event | None
    missed: tuple[str, ...]  # limits that the search met and the own flight misses
    interrupted: bool
    tightened: tuple[str, ...] = ()  # limits that the search raised above those of the case, as text

    @property
    def text(self) -> str:
        """Return the round as one line of text."""
        flight = "the scenario's flight" if self.number == 1 else f"the flight of round {self.number - 1}"
        lost = f", which is lost ({loss_text(self.loss)})" if self.loss is not None else ""
        kind = "a preliminary design" if self.loss is not None else "a design"
        made = f"{kind} for {self.points} operating points from {self.first_s:.4g} to {self.last_s:.4g} s of {flight}"
        made += f" ({', '.join(self.tightened)})" if self.tightened else ""
        if self.interrupted:
            return f"round {self.number}: {made}{lost}; interrupted"
        own = "its own flight agrees"
        if self.own_loss is not None:
            own = f"its own flight is lost: {loss_text(self.own_loss)}"
        elif self.loss is not None:
            own = "its own flight keeps control"
        elif self.missed:
            own = f"along its own flight {self.missed[0]}"
        return f"round {self.number}: {made}{lost}; {own}"


@dataclass(frozen=True)
class CaseDesign:
    """The design of a case, and the assessment of each stage along the design's own flight.

    `loss` is the loss of this flight, or None if it remains controlled. `stages` and `plants` are those of all stages
    with operating points, including those not designed because of an interruption. `uncovered` contains the intervals
    of this flight without operating points.
    """

    design: Design
    results: tuple[tuple[DesignOutcome, Solution], ...]
    stages: tuple[LoadedCase, ...]
    plants: tuple[Plants, ...]
    rounds: tuple[Round, ...]
    loss: Event | None
    interrupted: bool
    uncovered: tuple[Uncovered, ...]

    @property
    def feasible(self) -> bool:
        """Return True if all limits are met, the flight remains controlled, and no interruption left a part undone."""
        met = all(outcome.feasible and solution.feasible for outcome, solution in self.results)
        return met and self.loss is None and not self.interrupted

    @property
    def claim(self) -> str:
        """Return a statement of where limits are met, and of the parts that were not checked or not designed."""
        count = sum(len(solution.nodes) for _, solution in self.results)
        met = all(outcome.feasible for outcome, _ in self.results)
        said = [f"it meets all limits at its {count} operating points" if met else "it misses limits"]
        if self.rounds[-1].loss is not None:
            said.append(f"these end where the flight was lost ({loss_text(self.rounds[-1].loss)})")
        said += dict.fromkeys(solution.unchecked for _, solution in self.results if solution.unchecked)
        vehicle = self.results[0][0].loaded.scenario.vehicle
        if names := [stage_name(vehicle, n) for n in self.not_designed]:
            own = self.results[0][0].loaded.scenario.design is not None
            keeps = "as in the scenario's own design" if own else "with the gains of the first stage"
            said.append(f"not designed: {', '.join(names)}, which {'fly' if len(names) > 1 else 'flies'} {keeps}")
        return "; ".join(said)

    @property
    def not_designed(self) -> tuple[int, ...]:
        """Return the stages, from 0, that should have been designed and fly with the scenario's own design."""
        done = {solution.nodes[0].stage for _, solution in self.results}
        return tuple(n for p in self.plants if (n := p.each[0].node.stage) not in done)


def design_case(
    loaded: LoadedCase,
    progress: Callable[[int, int], SearchProgress] = lambda stage, number: lambda *_: None,
    check: Callable[[], None] = lambda: None,
    *,
    rounds_most: int = ROUNDS,
) -> CaseDesign:
    """Design all stages of a case along the flight of the design itself.

    `progress` is called with a stage, from 0, and a round. `check` may raise KeyboardInterrupt before the first search.
    `rounds_most` is the largest number of rounds after the first flight that is not lost. Raises ValueError if there is
    no operating point or no solution. Raises KeyboardInterrupt if no design has been found yet.
    """
    flight, (_, loss) = loaded.scenario, powered_flight(loaded.scenario)
    also_s: dict[int, set[float]] = {}  # further instants of each stage, at which a limit was missed
    stages, plants = _problems(loaded, flight, loss, also_s)
    check()
    found: dict[int, Solution] = {}
    again: set[int] | None = None  # stages in which the last design misses limits, from round 2 on
    more: dict[int, dict[str, float]] = {}  # increases of the limits of each stage, dB or deg
    in_vain: set[int] = set()  # stages without a design that meets limits raised by `more`
    rounds: list[Round] = []
    watch: SearchProgress = lambda *_: None  # noqa: E731  # replaced by the progress of a search
    while True:
        number = len(rounds) + 1
        interrupted = False
        try:
            for stage, mine in zip(stages, plants, strict=True):
                n = mine.each[0].node.stage
                if again is None or n in again:
                    before = [found[n].law] if n in found else []
                    tight = _tightened(_searched(stage, loss, again), more.get(n, {}))
                    watch = progress(n, number)
                    solution = solve(tight, mine, before, watch)
                    if more.get(n) and solution.status == "infeasible":
                        in_vain.add(n)
                    else:
                        found[n] = _with_limits(solution, stage)
                    if interrupted := solution.status == "interrupted":
                        break
            watch(0, 0, math.nan, "flight of the design")
            judged = _judged(loaded, stages, plants, found)
        except KeyboardInterrupt:
            if not found:
                raise
            interrupted, judged = True, _judged(loaded, stages, plants, found)
        points = [p.node.time_s for mine in plants for p in mine.each]
        missed = {n: o.missed for n, (o, s) in judged.by_stage.items() if s.feasible and _can_do_better(o)}
        said = tuple(text for texts in missed.values() for text in texts)
        missed = {n: texts for n, texts in missed.items() if n not in in_vain}
        held_to = _texts(more, in_vain)
        rounds.append(
            Round(number, len(points), min(points), max(points), loss, judged.loss, said, interrupted, held_to)
        )
        longer = loss is not None and (judged.loss is None or judged.loss.time_s > loss.time_s + LEAST_GAIN_S)
        agreeing = sum(made.loss is None for made in rounds)
        ended = number == ROUNDS or agreeing >= rounds_most
        if interrupted or ended or not (longer or (missed and judged.loss is None)):
            break
        again = None if loss is not None else set(missed)
        for n in missed if judged.loss is None else ():
            known, short = more.get(n, {}), _short(judged.by_stage[n][0])
            more[n] = known | {key: known.get(key, 0.0) + by + BEYOND for key, by in short.items()}
            outcome, solution = judged.by_stage[n]
            missed_s = worst_times_s(check for check in outcome.found if not check.passed)
            also_s.setdefault(n, set()).update(missed_s.difference(node.time_s for node in solution.nodes))
        flight, loss = judged.flight, judged.loss
        stages, plants = _problems(loaded, flight, loss, also_s)
    return CaseDesign(
        judged.design,
        tuple(judged.by_stage.values()),
        tuple(stages),
        tuple(plants),
        tuple(rounds),
        judged.loss,
        interrupted,
        _uncovered(judged, loaded),
    )


def _problems(
    loaded: LoadedCase, flight: LoadedScenario, loss: Event | None, also_s: Mapping[int, Collection[float]]
) -> tuple[list[LoadedCase], list[Plants]]:
    """Return the case of each stage along the controlled part of a flight, and its plants.

    `also_s` contains the times (s) of additional operating points, by stage. They are between the first and the last
    point of the case.
    """
    try:
        stages = each_stage(replace(loaded, flight=flight), math.inf if loss is None else loss.time_s)
    except ValueError as problem:
        lost = "" if loss is None else f"; the flight is lost: {loss_text(loss)}"
        raise ValueError(f"{problem}{lost}") from None
    plants = [nominal_plants(stage) for stage in stages]
    for k, mine in enumerate(plants):
        if more_s := also_s.get(mine.each[0].node.stage):
            stages[k] = with_nodes(gains_at_nodes(stages[k], mine), more_s)
            plants[k] = nominal_plants(stages[k])
    return stages, plants


def _searched(stage: LoadedCase, loss: Event | None, again: set[int] | None) -> LoadedCase:
    """Return the case of a search.

    The search is short for a preliminary design. From round 2 on, it begins at the last design alone.
    """
    if loss is None and again is None:
        return stage
    few = {"starts": min(4, stage.case.search.starts) if loss is not None else 1, "leaps": 0}
    changes: dict[str, object] = {"search": stage.case.search.model_copy(update=few)}
    if loss is not None:
        changes |= {"between_nodes": "ignore", "robust": None}
    return replace(stage, case=stage.case.model_copy(update=changes))


def _can_do_better(outcome: DesignOutcome) -> bool:
    """Return True if a limit is missed that the search can affect, which excludes those of the roll loop."""
    alone = (*outcome.found, *outcome.dispersed_found)
    return bool(_short(outcome)) or any(not check.passed for check in alone)


def _short(outcome: DesignOutcome) -> dict[str, float]:
    """Return the shortfall (dB or deg) of each limit that is missed with the other axes closed, by key."""
    out: dict[str, float] = {}
    for key in COUPLED:
        mine = [c for c in outcome.coupled_found if c.key in (f"coupled_{axis}_{key}" for axis in ("pitch", "yaw"))]
        missing = max((c.wanted - float(c.values[c.worst]) for c in mine if not c.passed), default=0.0)
        out |= {key: missing} if missing > 0.0 else {}
    return out


def _tightened(stage: LoadedCase, more: Mapping[str, float]) -> LoadedCase:
    """Return the case with its limits raised by `more`."""
    limits = stage.case.limits
    raised = limits.model_copy(update={key: getattr(limits, key) + by for key, by in more.items()})
    return replace(stage, case=stage.case.model_copy(update={"limits": raised}))


def _with_limits(solution: Solution, stage: LoadedCase) -> Solution:
    """Return a solution with the limits of its case in place of those of the search."""
    return replace(solution, case=solution.case.model_copy(update={"limits": stage.case.limits}))


def _texts(more: Mapping[int, Mapping[str, float]], in_vain: Collection[int]) -> tuple[str, ...]:
    """Return the largest increases of the searches' limits over those of the case, as text."""
    most = {key: max((by.get(key, 0.0) for by in more.values()), default=0.0) for key in COUPLED}
    named = ((QUANTITIES[key], by) for key, by in most.items() if by > 0.0)
    texts = [f"limit on {about.label} raised by {by:.4f} {about.unit}" for about, by in named]
    return (*texts, *["without a design that meets this, so that the last one stays"] * bool(in_vain))


@dataclass(frozen=True)
class _Judged:
    design: Design
    flight: LoadedScenario
    loss: Event | None
    by_stage: dict[int, tuple[DesignOutcome, Solution]]


def _judged(
    loaded: LoadedCase, stages: Sequence[LoadedCase], plants: Sequence[Plants], found: dict[int, Solution]
) -> _Judged:
    """Fly the design of the solutions, and assess it along that flight.

    If that flight is lost, the design is assessed along the flight of the search.
    """
    design, by_stage = make_design(loaded, *found.values()), {}
    flight = with_design(loaded.scenario, design)
    loss = powered_flight(flight)[1]
    for stage, mine in zip(stages, plants, strict=True):
        if (n := mine.each[0].node.stage) in found:
            own = stage if loss is not None else replace(stage, flight=flight)
            solution = found[n] if loss is not None else along(own, found[n])
            between = _worst_between(own, solution, design) if loss is None else []
            outcome = judge_solution(own, solution, design, between)
            if loss is None:
                times_s = [j.time_s for j in outcome.judged]
                together = [m for m in margins_of_all_axes(flight, design, times_s, own.case) if m.stable]
                outcome = replace(outcome, coupled_found=multiloop_checks(together, outcome.wanted))
            by_stage[n] = outcome, solution
    missed = [n for n, (outcome, _) in by_stage.items() if not outcome.feasible]
    return _Judged(make_design(loaded, *found.values(), missed=missed), flight, loss, by_stage)


def _worst_between(loaded: LoadedCase, solution: Solution, design: Design) -> list[Node]:
    """Return the instants between the operating points at which limits have their least margins.

    The list is empty if limits need not hold between the operating points.
    """
    case, points_s = loaded.case, tuple(node.time_s for node in solution.nodes)
    if case.between_nodes != "hold":
        return []
    nodes = [*solution.nodes, *nodes_of(loaded, instants_beside(points_s, burns_of(loaded, points_s)))]
    found = stage_checks(judge(nodes, design, case.loop), design, case.basis("", points_s), case.loop)
    worst_s = worst_times_s(found).difference(points_s)
    return [flown_point(node) for node in nodes if node.time_s in worst_s]


def _uncovered(judged: _Judged, loaded: LoadedCase) -> tuple[Uncovered, ...]:
    """Return the intervals of the design's flight in which its limits were not checked."""
    points_s = {n: sorted({node.time_s for node in s.nodes}) for n, (_, s) in judged.by_stage.items()}
    alone = [n for n, (_, solution) in judged.by_stage.items() if solution.certificate.instants == 0]
    return uncovered(judged.flight, points_s, loaded.case.plane, alone)


def along(loaded: LoadedCase, solution: Solution) -> Solution:
    """Return a solution with the operating points of another flight of its case, and its objective at these points.

    The objective of a robust case remains that of the search.
    """
    nodes = nodes_of(loaded, [node.time_s for node in solution.nodes])
    if solution.case.robust is not None:
        return replace(solution, nodes=tuple(nodes))
    plants = make_plants([make_plant(node, solution.case) for node in nodes])
    there = make_problem(solution.case, plants).evaluate(solution.variables)
    return replace(solution, nodes=tuple(nodes), levels_db=there.levels_db, nominal_objective_db=there.objective_db)


def with_design(scenario: LoadedScenario, design: Design) -> LoadedScenario:
    """Return the scenario with a design in place of its own."""
    return replace(scenario, scenario=scenario.scenario.model_copy(update={"design": design}))
