"""A design for many plants: made for some, then the worst others are searched and added, until none is worse.

The plants that a case's ranges allow are too many to take all: some twenty deviations each way at eleven nodes. So at
every node the corner (or middle) of the ranges that is worst for the present design is sought, one deviation after
the other being put to whichever end is worse, from several beginnings; what is worse than the design's own worst
joins its plants, and the design is made anew (a cutting-plane method: Blankenship & Falk, J. Optim. Theory Appl. 19,
1976). With `between_nodes = "hold"` time is one deviation more: where no node has a worse plant, those of its
neighbours are tried at the instants between, and an instant that is worse becomes a node.
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Iterable, Sequence

import numpy as np

from maxq.control.kernel.records import Array
from maxq.design.case.schema import Case, LoadedCase
from maxq.design.laws.law import DesignedLaw
from maxq.design.model.deviations import acting_at, deviations_of
from maxq.design.model.node import Node, disperse
from maxq.design.model.spread import campaign_of
from maxq.design.optimise.at_nodes import finished, make_problem, search_best
from maxq.design.optimise.over_time import COARSE, UNSTABLE_DB, Instants, gains_at_nodes, instants_along, peaks
from maxq.design.optimise.plants import Plant, Plants, make_plant, make_plants
from maxq.design.optimise.problem import Problem
from maxq.design.optimise.search import Found, Progress, search
from maxq.design.optimise.solution import Constraint, Solution
from maxq.sim.campaign.read import LoadedCampaign

WORSE_DB = 0.01  # plants that are worse by less are let be
BEGINNINGS = 4
INSTANTS_S, FINE_S = 0.5, 0.05  # apart, all along and beside the worst of those
ROUNDS = 12  # more, where instants between the nodes are added too
AT_ONCE = 100  # plants that are judged together


Ends = tuple[int, ...]
"""Of each place that deviates, an end (-1, +1) or the middle (0) of its range."""


@dataclasses.dataclass(frozen=True)
class Ranges:
    """The campaign whose draws deviate, and how many sigma the end of each is away."""

    campaign: LoadedCampaign
    sigmas: float


def ranges_of(loaded: LoadedCase, nodes: Sequence[Node]) -> Ranges | None:
    """Return the ranges of a case with [robust]; None without.

    Raises ScenarioError for a campaign that changes nothing at the first of `nodes`.
    """
    robust = loaded.case.robust
    if robust is None:
        return None
    campaign = campaign_of(robust, loaded.scenario)
    for node in nodes[:1]:
        acting_at(campaign, robust, node)
    return Ranges(campaign, robust.corner_sigmas)


def deviated(node: Node, ranges: Ranges, ends: Sequence[int]) -> Node:
    """Return the node with the score of each deviation at an end or in the middle of its range."""
    letters = "".join({-1: "-", 0: "0", 1: "+"}[end] for end in ends)
    scores = np.array(ends) * (ranges.sigmas / 3.0)
    return disperse(node, deviations_of(ranges.campaign, node).at(scores, f"[{letters}]"))


def dispersed_nodes(ranges: Ranges | None, nodes: Sequence[Node], constraints: Iterable[Constraint]) -> list[Node]:
    """Return the dispersed vehicles of a robust search, made again at `nodes` from the labels of its constraints."""
    if ranges is None:
        return []
    by_label, out = {node.label: node for node in nodes}, []
    for label in dict.fromkeys(c.plant for c in constraints if c.dispersed and c.plant is not None):
        name, _, letters = label.removesuffix("]").rpartition(" [")
        out.append(deviated(by_label[name], ranges, [{"-": -1, "0": 0, "+": 1}[letter] for letter in letters]))
    return out


def modes_off(node: Node, ranges: Ranges, end: int) -> Ends:
    """All modes at one end of their frequency and the large one of their slope, the rest as it is."""
    wanted = {"bending_frequency": end, "bending_slope": 1}
    return tuple(wanted.get(field, 0) for field in deviations_of(ranges.campaign, node).fields)


@dataclasses.dataclass
class _Worst:
    """Search for the worst plant of each node, for one design."""

    case: Case
    ranges: Ranges
    problem: Problem
    found: Found
    rng: np.random.Generator
    tried: int = 0

    def at(self, node: Node, taken: set[tuple[float, Ends]]) -> tuple[float, Ends]:
        """By how many dB the worst plant of a node misses the design's objective or a limit, and what it is.

        The search begins at the plants `taken` there and beside it too.
        """
        both = [modes_off(node, self.ranges, end) for end in (-1, 1)]
        count = len(both[0])
        beginnings = [*map(np.array, both), *(self.rng.choice([-1, 1], count) for _ in range(BEGINNINGS - 2))]
        beginnings += map(np.array, corners_beside(node.time_s, taken))
        known: dict[tuple[int, ...], float] = {}

        def score(ends: Array) -> float:
            key = tuple(int(e) for e in ends)
            if key not in known:
                known[key] = self._score(node, key)
            return known[key]

        best = max(beginnings, key=score)
        improved = True
        while improved:
            improved = False
            for k in self.rng.permutation(count):
                for end in (-1, 0, 1):
                    trial = best.copy()
                    trial[k] = end
                    if end != best[k] and score(trial) > score(best) + 1e-9:
                        best, improved = trial, True
        self.tried += len(known)
        return score(best), tuple(int(e) for e in best)

    def _score(self, node: Node, ends: Ends) -> float:
        return float(self.scores([make_plant(deviated(node, self.ranges, ends), self.case, dispersed=True)])[0])

    def scores(self, each: Sequence[Plant]) -> Array:
        """By how many dB each plant misses the design's objective or a limit, (plants,)."""
        problem = make_problem(self.case, make_plants(each, COARSE), self.problem.law)
        there = problem.evaluate(self.found.best.variables, complete=True)
        rows, out = there.rows, np.zeros(len(each))
        missed = rows.excess_db - np.where(rows.objective, self.found.best.objective_db, 0.0)
        of_plant = rows.plant >= 0
        np.maximum.at(out, rows.plant[of_plant], missed[of_plant])
        if there.unstable:
            out[problem.loops.unstable_poles(problem.loops.response(there.variables)) > 0] += UNSTABLE_DB
        return out

    def between(self, instants: Instants, taken: set[tuple[float, Ends]]) -> list[tuple[float, Node]]:
        """Instants at which the nominal plant, or one taken at a node beside, is worst and worse than WORSE_DB."""
        times_s = sorted({t for t, _ in taken})

        def worst_at(at_s: Sequence[float]) -> Array:
            plants, of = [], []
            for k, plant in enumerate(instants.plants(at_s)):
                corners = corners_beside(at_s[k], taken)
                plants += [plant] + [
                    make_plant(deviated(plant.node, self.ranges, ends), self.case, dispersed=True) for ends in corners
                ]
                of += [k] * (1 + len(corners))
            self.tried += len(plants)
            out = np.zeros(len(at_s))
            for first in range(0, len(plants), AT_ONCE):
                np.maximum.at(out, of[first : first + AT_ONCE], self.scores(plants[first : first + AT_ONCE]))
            return out

        grid = instants_along(times_s[0], times_s[-1], INSTANTS_S)
        found = []
        for k in peaks(worst_at(grid)[None], WORSE_DB):
            fine = [t for t in (grid[k] + FINE_S * np.arange(-9, 10)).round(9) if times_s[0] <= t <= times_s[-1]]
            score = worst_at(fine)
            j = int(np.argmax(score))
            found.append((float(score[j]), instants.plants(fine)[j].node))
        return found


def corners_beside(time_s: float, taken: set[tuple[float, Ends]]) -> list[Ends]:
    """Plants taken at a time, and at the nearest ones before and after it."""
    times_s = sorted({t for t, _ in taken})
    first, last = np.searchsorted(times_s, time_s), np.searchsorted(times_s, time_s, side="right")
    beside = times_s[max(int(first) - 1, 0) : int(last) + 1]
    return sorted({ends for t, ends in taken if t in beside})


def solve_robust(
    loaded: LoadedCase, nominal: Plants, also_from: Sequence[DesignedLaw] = (), progress: Progress | None = None
) -> Solution:
    """The best design for the nominal plants and all that the case's ranges allow, as far as searched.

    KeyboardInterrupt ends it with the best so far, marked as interrupted.
    """
    begun = time.perf_counter()
    instants = None
    if loaded.case.between_nodes == "hold":
        loaded = gains_at_nodes(loaded, nominal)
        instants = Instants(loaded, {p.node.time_s: p for p in nominal.each})
    case = loaded.case
    nodes = [p.node for p in nominal.each]
    ranges = ranges_of(loaded, nodes)
    assert case.robust is not None
    assert ranges is not None
    taken = {(node.time_s, modes_off(node, ranges, end)) for node in nodes for end in (-1, 1)}

    def dispersed(few: Sequence[tuple[Node, Ends]]) -> list[Plant]:
        return [make_plant(deviated(node, ranges, ends), case, dispersed=True) for node, ends in few]

    plants = nominal.and_also(dispersed([(n, modes_off(n, ranges, end)) for n in nodes for end in (-1, 1)]))
    problem, found = search_best(case, plants, also_from, progress)
    rng, tried, worst_db, instant_db = np.random.default_rng(case.search.seed), 0, np.nan, np.nan
    interrupted = found.interrupted
    rounds = case.robust.rounds + (0 if instants is None else ROUNDS)
    try:
        for number in range(rounds + 1 if not interrupted else 0):  # the last one judges the last design
            worst = _Worst(case, ranges, problem, found, rng)
            results = []
            for k, node in enumerate(nodes):
                if progress is not None:
                    progress(k, len(nodes), found.best.objective_db, f"worst plants, round {number + 1}")
                results.append((node, *worst.at(node, taken)))
            worst_db = max(score for _, score, _ in results)
            new = [
                (node, ends) for node, score, ends in results if score > WORSE_DB and (node.time_s, ends) not in taken
            ]
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
            taken.update((node.time_s, ends) for node, ends in new)
            plants = plants.and_also([*(make_plant(node, case) for node in fresh), *dispersed(new)])
            problem = make_problem(case, plants, problem.law)
            found, worst_db, instant_db = _again(problem, found), np.nan, np.nan  # nothing is known of the new design
            if found.interrupted:
                interrupted = True
                break
    except KeyboardInterrupt:
        interrupted = True
    found = dataclasses.replace(found, interrupted=interrupted)
    solution = finished(case, plants, problem, found, begun)
    certificate = dataclasses.replace(
        solution.certificate, searched=tried, worst_found_db=float(worst_db),
        worst_instant_db=float(np.nan_to_num(instant_db)),
        instants=0 if instants is None or np.isnan(instant_db) else len(instants.known),
    )  # fmt: skip  # two more lines otherwise
    return dataclasses.replace(solution, certificate=certificate)


def _again(problem: Problem, found: Found) -> Found:
    """The design for more plants, from the design for fewer."""
    again = search(problem, [found.best.variables])
    return dataclasses.replace(
        again,
        ends_db=np.where(
            np.abs(found.ends_db - found.best.objective_db) < 0.05, again.best.objective_db, found.ends_db
        ),
        evaluations=found.evaluations + again.evaluations,
    )
