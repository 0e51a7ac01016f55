"""The optimisation of a design for many plants. The worst plants are added until none is worse than the design.

The ranges of a case permit too many plants to use them all: some twenty deviations in both directions at eleven
operating points. A search at every operating point finds the worst plant for the present design. Plants that are worse
than the worst of the design are added, and the design is repeated (a cutting-plane method: Blankenship & Falk, J.
Optim. Theory Appl. 19, 1976). With `between_nodes = "hold"`, time is one more parameter. If no operating point has a
worse plant, the plants of neighbouring operating points are evaluated at the instants between them. An instant that is
worse becomes an operating point.

The search at an operating point has two parts. The first finds the loop nearest to -1 by the compiled margins, if they
support the loop. It starts from several corners of the ranges, moves to a corner that no single deviation makes worse,
and continues with a descent inside the ranges (descent.py). The second part evaluates the objective and the limits of
the case. It starts from the worst of that point and the same corners, and sets one deviation after the other to the
worst of both ends and the middle. It is omitted if none of these plants misses a limit, since the limits then give no
direction.
"""

from __future__ import annotations

import dataclasses
import re
import time
from collections.abc import Iterable, Sequence

import numpy as np

from maxq.control.kernel.records import Array
from maxq.design.case.schema import Case, LoadedCase
from maxq.design.laws.law import DesignedLaw
from maxq.design.margins.dispersed import ManyLoops, NotServedError
from maxq.design.margins.many import DONE, HANDED_BACK
from maxq.design.model.deviations import acting_at, deviations_of
from maxq.design.model.node import Node, disperse
from maxq.design.model.spread import campaign_of
from maxq.design.optimise.at_nodes import finished, make_problem, search_best, search_on
from maxq.design.optimise.descent import Region, descend, to_corner
from maxq.design.optimise.over_time import (
    COARSE,
    UNSTABLE_DB,
    Instants,
    burns_of,
    gains_at_nodes,
    instants_in,
    peaks,
    within,
)
from maxq.design.optimise.plants import Plant, Plants, make_plant, make_plants
from maxq.design.optimise.problem import Problem, level_of
from maxq.design.optimise.search import BestPoint, SearchProgress, search
from maxq.design.optimise.solution import Constraint, Solution
from maxq.sim.campaign.read import LoadedCampaign

WORSE_DB = 0.01  # smallest excess of the objective for which a plant is added
BEGINNINGS = 8
INSTANTS_S, FINE_S = 0.5, 0.05  # spacing along the flight, and next to the worst instants
ROUNDS = 12  # additional rounds if instants between the operating points are added
AT_ONCE = 100  # plants per evaluation

Deviation = tuple[float, ...]
"""The deviations of a vehicle, each from -1 to +1 over its range, with 0 in the middle."""
_SIGNS = {-1.0: "-", 0.0: "0", 1.0: "+"}
_OF_POINT = re.compile(r"[-0+]|\(([^()]*)\)")


@dataclasses.dataclass(frozen=True)
class Ranges:
    """The campaign whose draws deviate, and the distance of the ends of each range from the middle, in sigma."""

    campaign: LoadedCampaign
    sigmas: float


def ranges_of(loaded: LoadedCase, nodes: Sequence[Node]) -> Ranges | None:
    """Return the ranges of a case with [robust], or None without this section.

    Raises ScenarioError for a campaign that changes nothing at the first of `nodes`.
    """
    robust = loaded.case.robust
    if robust is None:
        return None
    campaign = campaign_of(robust, loaded.scenario)
    for node in nodes[:1]:
        acting_at(campaign, robust, node)
    return Ranges(campaign, robust.corner_sigmas)


def deviated(node: Node, ranges: Ranges, point: Sequence[float]) -> Node:
    """Return the operating point with the deviations `point`, labelled like "[+0-(0.24)]"."""
    letters = "".join(_SIGNS.get(at, f"({at:g})") for at in point)
    scores = np.array(point) * (ranges.sigmas / 3.0)
    return disperse(node, deviations_of(ranges.campaign, node).at(scores, f"[{letters}]"))


def dispersed_nodes(ranges: Ranges | None, nodes: Sequence[Node], constraints: Iterable[Constraint]) -> list[Node]:
    """Return the dispersed vehicles of a robust search, recreated at `nodes` from the labels of its constraints."""
    if ranges is None:
        return []
    by_label, out, ends = {node.label: node for node in nodes}, [], {text: at for at, text in _SIGNS.items()}
    for label in dict.fromkeys(c.plant for c in constraints if c.dispersed and c.plant is not None):
        name, _, letters = label.removesuffix("]").rpartition(" [")
        point = [float(found[1]) if found[1] else ends[found[0]] for found in _OF_POINT.finditer(letters)]
        out.append(deviated(by_label[name], ranges, point))
    return out


def modes_off(node: Node, ranges: Ranges, end: int) -> Deviation:
    """Return the deviation with all modes at one end (`end`) of their frequency and at the upper end of their slope."""
    wanted = {"bending_frequency": float(end), "bending_slope": 1.0}
    return tuple(wanted.get(field, 0.0) for field in deviations_of(ranges.campaign, node).fields)


@dataclasses.dataclass
class _Worst:
    """The search for the worst plant of each operating point, for one design."""

    case: Case
    ranges: Ranges
    problem: Problem
    found: BestPoint
    rng: np.random.Generator
    tried: int = 0

    def at(self, node: Node, taken: set[tuple[float, Deviation]]) -> tuple[float, Deviation]:
        """Return the worst plant at an operating point, preceded by its excess (dB).

        The excess is that over the objective or a limit of the design. The search also begins at the plants `taken` at
        this and at the neighbouring operating points.
        """
        both = [modes_off(node, self.ranges, end) for end in (-1, 1)]
        count = len(both[0])
        corners = [np.array(both[0]), np.array(both[1])]
        corners += [self.rng.choice([-1.0, 1.0], count) for _ in range(BEGINNINGS - 2)]
        corners += [np.array(point) for point in points_beside(node.time_s, taken)]
        known: dict[Deviation, float] = {}

        def score(at: Array) -> float:
            point = tuple(at.tolist())
            if point not in known:
                known[point] = self._score(node, point)
            return known[point]

        best = max([*self.nearest(node, corners), *corners], key=score)
        improved = score(best) > 0.0
        while improved:
            improved = False
            for k in self.rng.permutation(count):
                for end in (-1.0, 0.0, 1.0):
                    trial = best.copy()
                    trial[k] = end
                    if end != best[k] and score(trial) > score(best) + 1e-9:
                        best, improved = trial, True
        self.tried += len(known)
        return score(best), tuple(best.tolist())

    def nearest(self, node: Node, corners: Sequence[Array]) -> list[Array]:
        """Return the loop nearest to -1 in a search from `corners`, before and after the final descent.

        The list is empty if the compiled margins do not support the loop.
        """
        if self.case.loop != "sampled" or not len(corners[0]):
            return []
        alone = make_problem(self.case, make_plants([make_plant(node, self.case)], COARSE), self.problem.law)
        try:
            loops = ManyLoops(node, alone.law.controllers(self.found.best.variables)[0])
        except NotServedError:
            return []
        deviations = deviations_of(self.ranges.campaign, node)

        def distances(every: Sequence[Array]) -> list[float]:
            self.tried += len(every)
            scores = [u * (self.ranges.sigmas / 3.0) for u in every]
            values, status = loops.measure(deviations.of_scores(scores), 0.0, distances=True)
            near = np.where(status == DONE, 1.0, -1.0) * values["distance"][:, 0]
            return list(np.where(status == HANDED_BACK, np.inf, near))

        box = Region("box", 1.0)
        ends = [to_corner(distances, corner, box) for corner in corners]
        u, value = min(ends, key=lambda end: end[1])
        if not np.isfinite(value):
            return []
        return [u, descend(distances, u, value, box)[0].round(2) + 0.0]

    def _score(self, node: Node, point: Deviation) -> float:
        return float(self.scores([make_plant(deviated(node, self.ranges, point), self.case, dispersed=True)])[0])

    def scores(self, each: Sequence[Plant]) -> Array:
        """Return the excess (dB) of each plant over the objective or a limit, (plants,), or 0 if it does not matter."""
        problem = make_problem(self.case, make_plants(each, COARSE), self.problem.law)
        there = problem.evaluate(self.found.best.variables, complete=True)
        rows, out = there.rows, np.zeros(len(each))
        missed = rows.excess_db - level_of(rows, self.found.best.levels_db)
        matters = (rows.plant >= 0) & (missed > problem.matters_db(WORSE_DB)[rows.what])
        np.maximum.at(out, rows.plant[matters], missed[matters])
        if there.unstable:
            out[problem.loops.unstable_poles(problem.loops.response(there.variables)) > 0] += UNSTABLE_DB
        return out

    def between(self, instants: Instants, taken: set[tuple[float, Deviation]]) -> list[tuple[float, Node]]:
        """Return the worst instants between operating points, with their excess (dB) and operating point.

        The plants are the nominal one and those of the neighbouring operating points.
        """
        times_s = sorted({t for t, _ in taken})

        def worst_at(at_s: Sequence[float]) -> Array:
            plants, of = [], []
            for k, plant in enumerate(instants.plants(at_s)):
                points = points_beside(at_s[k], taken)
                plants += [plant] + [
                    make_plant(deviated(plant.flown, self.ranges, point), self.case, dispersed=True) for point in points
                ]
                of += [k] * (1 + len(points))
            self.tried += len(plants)
            out = np.zeros(len(at_s))
            for first in range(0, len(plants), AT_ONCE):
                np.maximum.at(out, of[first : first + AT_ONCE], self.scores(plants[first : first + AT_ONCE]))
            return out

        burns = burns_of(instants.loaded, times_s)
        grid = instants_in(burns, INSTANTS_S)
        found = []
        for k in peaks(worst_at(grid)[None], np.zeros(1)):
            fine = [t for t in (grid[k] + FINE_S * np.arange(-9, 10)).round(9) if within(burns, t)]
            score = worst_at(fine)
            j = int(np.argmax(score))
            found.append((float(score[j]), instants.plants(fine)[j].flown))
        return found


def points_beside(time_s: float, taken: set[tuple[float, Deviation]]) -> list[Deviation]:
    """Return the deviations that were taken at a time, and those at the nearest times before and after it."""
    times_s = sorted({t for t, _ in taken})
    first, last = np.searchsorted(times_s, time_s), np.searchsorted(times_s, time_s, side="right")
    beside = times_s[max(int(first) - 1, 0) : int(last) + 1]
    return sorted({point for t, point in taken if t in beside})


def solve_robust(
    loaded: LoadedCase, nominal: Plants, also_from: Sequence[DesignedLaw] = (), progress: SearchProgress | None = None
) -> Solution:
    """Return the best design for the nominal plants and for the worst plants found in the ranges of the case.

    KeyboardInterrupt ends the search with the best design so far, marked as interrupted.
    """
    begun = time.perf_counter()
    instants = None
    if loaded.case.between_nodes == "hold":
        loaded = gains_at_nodes(loaded, nominal)
        instants = Instants(loaded, {p.node.time_s: p for p in nominal.each})
    case = loaded.case
    nodes = [p.flown for p in nominal.each]
    ranges = ranges_of(loaded, nodes)
    assert case.robust is not None
    assert ranges is not None
    taken = {(node.time_s, modes_off(node, ranges, end)) for node in nodes for end in (-1, 1)}

    def dispersed(few: Sequence[tuple[Node, Deviation]]) -> list[Plant]:
        return [make_plant(deviated(node, ranges, point), case, dispersed=True) for node, point in few]

    plants = nominal.and_also(dispersed([(n, modes_off(n, ranges, end)) for n in nodes for end in (-1, 1)]))
    problem, found = search_best(case, plants, also_from, progress)
    rng, tried, worst_db, instant_db = np.random.default_rng(case.search.seed), 0, np.nan, np.nan
    interrupted = found.interrupted
    rounds = case.robust.rounds + (0 if instants is None else ROUNDS)
    try:
        for number in range(rounds + 1 if not interrupted else 0):  # the last round assesses the last design
            worst = _Worst(case, ranges, problem, found, rng)
            results = []
            for k, node in enumerate(nodes):
                if progress is not None:
                    progress(k, len(nodes), found.best.objective_db, f"worst plants, round {number + 1}")
                results.append((node, *worst.at(node, taken)))
            worst_db = max(score for _, score, _ in results)
            new = [(node, at) for node, score, at in results if score > 0.0 and (node.time_s, at) not in taken]
            fresh: list[Node] = []
            if not new and instants is not None:
                between = worst.between(instants, taken)
                instant_db = max((score for score, _ in between), default=0.0)
                known = {node.time_s for node in nodes}
                fresh = [node for _, node in between if node.time_s not in known]
                new = [(node, worst.at(node, taken)[1]) for node in fresh]
            tried += worst.tried
            if not new or number == rounds:
                break
            nodes += fresh
            taken.update((node.time_s, point) for node, point in new)
            plants = plants.and_also([*(make_plant(node, case) for node in fresh), *dispersed(new)])
            problem = make_problem(case, plants, problem.law)
            found = _again(case, problem, found)
            worst_db, instant_db = np.nan, np.nan  # the new design has not been assessed
            if found.interrupted:
                interrupted = True
                break
    except KeyboardInterrupt:
        interrupted = True
    found = dataclasses.replace(found, interrupted=interrupted)
    solution = finished(case, plants, problem, found, begun)
    certificate = dataclasses.replace(
        solution.certificate,
        searched=tried,
        worst_found_db=float(worst_db),
        worst_instant_db=float(np.nan_to_num(instant_db)),
        instants=0 if instants is None or np.isnan(instant_db) else len(instants.known),
    )
    return dataclasses.replace(solution, certificate=certificate)


def _again(case: Case, problem: Problem, found: BestPoint) -> BestPoint:
    """Return the design for more plants, starting from the design for fewer plants.

    If the previous design met the limits and the new one does not, further starts are used.
    """
    again = search_on(case, problem, search(problem, [found.best.variables]), also_settled=found.feasible)
    return dataclasses.replace(
        again,
        ends_db=np.where(
            np.abs(found.ends_db - found.best.objective_db) < 0.05, again.best.objective_db, found.ends_db
        ),
        evaluations=found.evaluations + again.evaluations,
    )
