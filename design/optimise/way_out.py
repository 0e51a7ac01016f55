"""Ways out of a case whose limits cannot be met together.

`conflict` lists the limits that determine the least violation, and the gain by relaxing each of them. The gains are
multipliers of the minimax problem (`sqp.optimality`), hence derivatives that are exact for small changes. `tried`
carries out short searches with wider filter bounds, a filter of the next order, or a computer that samples twice as
fast. A trial begins at the best effort and continues from the law's own starts until it has used its share of the
evaluations. A failed trial does not prove that a change is insufficient.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

from threadpoolctl import threadpool_limits

from maxq.control.kernel.records import Array
from maxq.control.structures import MAX_SECTIONS, STRUCTURES
from maxq.design.case.schema import Case, LoadedCase
from maxq.design.model.node import Node, flown_point
from maxq.design.optimise.at_nodes import LEAST_EVALUATIONS, MORE_STARTS, closes_stably, make_problem, meet_limits
from maxq.design.optimise.plants import Plants, make_plant, make_plants, nodes_of
from maxq.design.optimise.problem import Problem, ProblemAtPoint
from maxq.design.optimise.robust import Ranges, dispersed_nodes, ranges_of
from maxq.design.optimise.search import SearchProgress
from maxq.design.optimise.solution import MET_DB, Constraint, Solution, Trial

WIDER = {
    "zero_hz": (1.0, 100.0), "zero_zeta": (0.1, 2.0), "pole_hz": (1.0, 100.0), "pole_zeta": (0.05, 2.0),
    "first_order_zero_hz": (1.0, 200.0), "first_order_pole_hz": (1.0, 200.0),
}  # fmt: skip  # a table
"""The bounds of the filter's variables in a trial, by key of `filter.bounds`. Wider bounds of a case are kept."""
FASTER = 2  # factor on the sample rate
LEAST_SHARE = 1e-3  # smallest multiplier that is reported


@dataclass(frozen=True)
class Relief:
    """A limit that determines the least violation, or the objective of a feasible design.

    Relaxing the limit by 1 dB lowers this by `gains_db`. For a violation, the sum of all `gains_db` is 1. `by` is 1 dB
    in the unit of the limit. `points` are the operating points at which the limit is active, in decreasing order of
    their share.
    """

    what: str
    dispersed: bool
    gains_db: float
    by: str
    points: tuple[Constraint, ...]

    @property
    def name(self) -> str:
        """Return the name of the limit, with a remark if it applies to dispersed plants."""
        return f"{self.what}{' of dispersed plants' if self.dispersed else ''}"


def conflict(solution: Solution) -> tuple[Relief, ...]:
    """Return the limits that determine the violation of an infeasible but stable design, the largest share first."""
    if solution.status != "infeasible" or not solution.certificate.stable:
        return ()
    return _reliefs(solution)


def prices(solution: Solution) -> tuple[Relief, ...]:
    """Return the limits that determine the objective of a feasible design, the most costly first.

    Relaxing such a limit by 1 dB improves the objective by `gains_db`, for small changes.
    """
    return _reliefs(solution) if solution.feasible else ()


def _reliefs(solution: Solution) -> tuple[Relief, ...]:
    by_limit = defaultdict[tuple[str, bool], list[Constraint]](list)
    for c in solution.constraints:
        if c.multiplier > LEAST_SHARE and c.limit is not None and not c.objective:
            by_limit[c.what, c.dispersed].append(c)
    found = []
    for (what, dispersed), points in by_limit.items():
        points.sort(key=lambda c: -c.multiplier)
        gains_db = sum(c.multiplier for c in points)
        found.append(Relief(what, dispersed, gains_db, _a_db(solution.case, points[0]), tuple(points)))
    return tuple(sorted(found, key=lambda relief: -relief.gains_db))


def _a_db(case: Case, at: Constraint) -> str:
    """Return, as text, the change of a limit that corresponds to 1 dB, in the unit of the limit.

    Phases are converted as in the optimiser; for other units, the change is a percentage of the limit.
    """
    if at.unit == "dB":
        return "1 dB"
    if at.unit == "deg":
        limits = case.robust.limits if at.dispersed and case.robust is not None else case.limits
        return f"{limits.phase_margin_deg / limits.gain_margin_db:.3g} deg"
    assert at.limit is not None
    share = 10.0 ** (1.0 / 20.0) - 1.0 if at.value > at.limit else 1.0 - 10.0 ** (-1.0 / 20.0)
    return f"{100.0 * share:.0f} %"


@dataclass(frozen=True)
class TriedChange:
    """A change to be tried: its description, its settings, and the case and operating points after the change."""

    about: str
    settings: tuple[str, ...]
    case: Case
    nodes: Sequence[Node]


def changes_of(case: Case, nodes: Sequence[Node]) -> list[TriedChange]:
    """Return the changes that can be tried on a case."""
    found, bounds = [], case.filter.bounds
    wider = {
        key: (min(low, ends[0]), max(high, ends[1]))
        for key, (low, high) in WIDER.items()
        if _in_use(case, key) and not ((ends := getattr(bounds, key))[0] <= low and high <= ends[1])
    }
    if wider:
        changed = _with_filter(case, bounds=bounds.model_copy(update=wider))
        settings = tuple(f"filter.bounds.{key}=[{low:g},{high:g}]" for key, (low, high) in wider.items())
        said = [
            f"{name} from {wider[key][0]:g}{unit}"
            for key, name, unit in (("pole_hz", "roots", " Hz"), ("pole_zeta", "pole damping", ""))
            if key in wider and wider[key][0] < getattr(bounds, key)[0]
        ]
        about = f"wider filter bounds ({', '.join(said)})" if said else "wider filter bounds"
        found.append(TriedChange(about, settings, changed, nodes))
    if (higher := _higher(case)) is not None:
        found.append(TriedChange(*higher, nodes))
    faster = [_faster(node) for node in nodes]
    sample_s, before_s = (some[0].instruments.sample_s for some in (faster, nodes))
    setting = (f"vehicle.computer.sample_s={sample_s:g}",)
    found.append(
        TriedChange(f"a sample every {1e3 * sample_s:g} instead of {1e3 * before_s:g} ms", setting, case, faster)
    )
    return found


def _in_use(case: Case, key: str) -> bool:
    """Return True if the filters of the case have sections with the variable."""
    each = (case.filter.sections, *case.loop_filters.each)
    return any(sections[1 if key.startswith("first_order") else 0] > 0 for sections in each)


def _with_filter(case: Case, **changes: object) -> Case:
    return case.model_copy(update={"filter": case.filter.model_copy(update=changes)})


def _higher(case: Case) -> tuple[str, tuple[str, ...], Case] | None:
    """Return the case with the bending filter of the next order, with its description and settings.

    Returns None if the filter would exceed the flight computer's capacity.
    """
    names = [name for name, sections in STRUCTURES.items() if sum(sections)]
    before = case.filter.structure
    if before in names[:-1]:
        name = names[names.index(before) + 1]
        return f"{name} instead of {before}", (f"filter.structure={name}",), _with_filter(case, structure=name)
    quadratic, first_order = case.filter.sections
    if quadratic + first_order >= MAX_SECTIONS:
        return None
    form = {"structure": "sections", "quadratic": quadratic, "first_order": first_order + 1}
    settings = tuple(f"filter.{key}={value}" for key, value in form.items())
    return "one more first-order section", settings, _with_filter(case, **form)


def _faster(node: Node) -> Node:
    """Return the operating point with a computer that samples faster. Sensor latencies keep their duration."""
    own = node.instruments
    sample_s = own.sample_s / FASTER
    sensors = tuple((name, dynamics, FASTER * late) for name, dynamics, late in own.sensors)
    timing = replace(own, sample_s=sample_s, delay_s=min(own.delay_s, sample_s), sensors=sensors)
    return replace(node, instruments=timing)


def case_as_searched(solution: Solution) -> Case:
    """Return the case with its filter prewarped at the frequency of the best effort's filter."""
    prewarp_hz = getattr(solution.law, "prewarp_hz", None)
    return solution.case if prewarp_hz is None else _with_filter(solution.case, prewarp_hz=prewarp_hz)


def plants_of(case: Case, nodes: Sequence[Node], solution: Solution, ranges: Ranges | None) -> Plants:
    """Return the plants of a solution: those at the operating points, and the dispersed ones that its search added."""
    nominal = [make_plant(node, case) for node in nodes]
    dispersed = dispersed_nodes(ranges, nodes, solution.constraints)
    return make_plants([*nominal, *(make_plant(node, case, dispersed=True) for node in dispersed)])


def tried(
    loaded: LoadedCase, solution: Solution, progress: SearchProgress | None = None
) -> tuple[tuple[Trial, ...], bool]:
    """Return the trials from an infeasible solution, and True if they were interrupted.

    `loaded` is the case of the stage, along the flight of its search. All trials together use about as many evaluations
    as the search. After a KeyboardInterrupt, the completed trials are returned.
    """
    if solution.status != "infeasible":
        return (), False
    out: list[Trial] = []
    try:
        with threadpool_limits(limits=1, user_api="blas"):
            nodes = [flown_point(node) for node in nodes_of(loaded, [node.time_s for node in solution.nodes])]
            certificate, ranges = solution.certificate, ranges_of(loaded, nodes)
            changes = changes_of(case_as_searched(solution), nodes)
            most = max(LEAST_EVALUATIONS, certificate.evaluations // len(changes))
            for number, change in enumerate(changes):
                shown = None if progress is None else partial(progress, number, len(changes))
                trial = _tried(change, solution, ranges, most, shown)
                out.append(trial)
                if trial.interrupted:
                    return tuple(out), True
    except KeyboardInterrupt:
        return tuple(out), True
    return tuple(out), False


def _tried(
    change: TriedChange,
    solution: Solution,
    ranges: Ranges | None,
    most: int,
    progress: Callable[[float, str], None] | None,
) -> Trial:
    """Return the trial of a change, with at most `most` evaluations."""
    best: ProblemAtPoint | None = None
    problem: Problem | None = None
    unstable, interrupted, refused = 0, False, ""

    def watch(so_far: ProblemAtPoint) -> None:
        nonlocal best
        best = so_far
        if progress is not None:
            progress(best.violation_db if best.unstable == 0 else float("nan"), f"trial: {change.about}")

    try:
        plants = plants_of(change.case, change.nodes, solution, ranges)
        problem = make_problem(change.case, plants)
        best = meet_limits(problem, starts_of(problem, change.case, solution), most, watch)
        unstable = best.unstable or int(not closes_stably(plants, problem, best.variables))
    except KeyboardInterrupt:
        interrupted = True
        if best is None:
            raise
        unstable = best.unstable
    except ValueError as error:
        refused = str(error)
    missing_db = float("nan") if best is None else best.violation_db
    missing_db = 0.0 if missing_db <= MET_DB else missing_db
    count = 0 if problem is None else problem.evaluations
    return Trial(change.about, change.settings, missing_db, unstable, count, interrupted, refused)


def starts_of(problem: Problem, case: Case, solution: Solution) -> list[Array]:
    """Return the best effort, followed by the law's own starts."""
    warm = problem.law.variables_of(solution.law)
    return [*([] if warm is None else [warm]), *problem.law.starts(MORE_STARTS * case.search.starts, case.search.seed)]
