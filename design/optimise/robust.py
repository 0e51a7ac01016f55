"""A design for many plants: made for some, then the worst others are searched and added, until none is worse.

The plants that a case's ranges allow are too many to take all: eleven deviations each way at eleven nodes. So at
every node the corner (or middle) of the ranges that is worst for the present design is sought, one deviation after
the other being put to whichever end is worse, from several beginnings; what is worse than the design's own worst
joins its plants, and the design is made anew (a cutting-plane method: Blankenship & Falk, J. Optim. Theory Appl. 19,
1976).
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Sequence

import numpy as np

from maxq.control.kernel.records import Array
from maxq.design.case.schema import Case, LoadedCase, Robust
from maxq.design.model.dispersion import for_each
from maxq.design.model.node import Node
from maxq.design.optimise.plants import Plant, Plants, make_plant, make_plants
from maxq.design.optimise.problem import Problem
from maxq.design.optimise.search import Found, Progress, search
from maxq.design.optimise.solution import Solution
from maxq.design.optimise.solve import finished, make_problem, search_best

DEVIATIONS = (
    "bending_frequency", "bending_slope", "slosh_frequency", "slosh_mass", "slosh_damping", "actuator_frequency",
    "delay_s", "thrust", "normal_force", "centre_of_pressure_m", "inertia",
)  # fmt: skip  # nine more lines otherwise
WORSE_DB = 0.01  # plants that are worse by less are let be
BEGINNINGS = 4
COARSE = 1e-4  # tolerance of the curves in the search for the worst: 1e-3 dB
UNSTABLE_DB = 1e3


def deviated(node: Node, ranges: Robust, ends: Sequence[int]) -> Node:
    """The node with each deviation at an end (-1, +1) or in the middle (0) of its range, in the order of DEVIATIONS."""
    at = dict(zip(DEVIATIONS, ends, strict=True))
    factors: dict[str, float | tuple[float, ...]] = {}
    for name in DEVIATIONS:
        end, size = at[name], getattr(ranges, name)
        if name == "bending_frequency":
            factors[name] = tuple(1.0 + end * share for share in for_each(size, len(node.vehicle.modes.omega_radps)))
        elif name == "delay_s":
            factors[name] = max(end, 0) * size  # no computer is faster than the nominal one
        elif name == "centre_of_pressure_m":
            factors[name] = end * size
        else:
            factors[name] = 1.0 + end * size
    letters = "".join({-1: "-", 0: "0", 1: "+"}[end] for end in ends)
    return dataclasses.replace(node.with_(**factors), label=f"{node.label} [{letters}]")


@dataclasses.dataclass
class _Worst:
    """Search for the worst plant of each node, for one design."""

    case: Case
    ranges: Robust
    problem: Problem
    found: Found
    rng: np.random.Generator
    tried: int = 0

    def at(self, node: Node) -> tuple[float, tuple[int, ...]]:
        """By how many dB the worst plant of a node misses the design's objective or a limit, and what it is."""
        count = len(DEVIATIONS)
        frequency, slope = DEVIATIONS.index("bending_frequency"), DEVIATIONS.index("bending_slope")
        beginnings = [np.zeros(count, int) for _ in range(2)] + [
            self.rng.choice([-1, 1], count) for _ in range(BEGINNINGS - 2)
        ]
        for k, end in enumerate((-1, 1)):
            beginnings[k][frequency], beginnings[k][slope] = end, 1
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

    def _score(self, node: Node, ends: tuple[int, ...]) -> float:
        plant = make_plant(deviated(node, self.ranges, ends), self.case, dispersed=True)
        few = make_plants([plant], COARSE)
        problem = make_problem(self.case, few, self.problem.law)
        there = problem.evaluate(self.found.best.variables)
        worse = max(there.objective_db - self.found.best.objective_db, there.violation_db)
        return worse + UNSTABLE_DB * there.unstable


def solve_robust(
    loaded: LoadedCase, nominal: Plants, also_from: Sequence[Solution] = (), progress: Progress | None = None
) -> Solution:
    """The best design for the nominal plants and all that the case's ranges allow, as far as searched.

    KeyboardInterrupt ends it with the best so far, marked as interrupted.
    """
    case, begun = loaded.case, time.perf_counter()
    ranges = case.robust
    assert ranges is not None
    nodes = [p.node for p in nominal.each]
    frequency, slope = DEVIATIONS.index("bending_frequency"), DEVIATIONS.index("bending_slope")
    first: list[Plant] = []
    taken: set[tuple[float, tuple[int, ...]]] = set()
    for node in nodes:
        for end in (-1, 1):
            ends = [0] * len(DEVIATIONS)
            ends[frequency], ends[slope] = end, 1
            first.append(make_plant(deviated(node, ranges, ends), case, dispersed=True))
            taken.add((node.time_s, tuple(ends)))
    plants = nominal.and_also(first)
    problem, found = search_best(case, plants, also_from, progress)
    rng, tried, worst_db = np.random.default_rng(case.search.seed), 0, np.inf
    interrupted = found.interrupted
    try:
        for number in range(ranges.rounds if not interrupted else 0):
            worst = _Worst(case, ranges, problem, found, rng)
            results = []
            for k, node in enumerate(nodes):
                if progress is not None:
                    progress(k, len(nodes), found.best.objective_db, f"worst plants, round {number + 1}")
                results.append((node, *worst.at(node)))
            tried += worst.tried
            worst_db = max(score for _, score, _ in results)
            new = [
                (node, ends) for node, score, ends in results if score > WORSE_DB and (node.time_s, ends) not in taken
            ]
            if not new:
                break
            taken.update((node.time_s, ends) for node, ends in new)
            plants = plants.and_also([make_plant(deviated(n, ranges, e), case, dispersed=True) for n, e in new])
            problem = make_problem(case, plants, problem.law)
            found = _again(problem, found)
            if found.interrupted:
                interrupted = True
                break
    except KeyboardInterrupt:
        interrupted = True
    found = dataclasses.replace(found, interrupted=interrupted)
    solution = finished(case, plants, problem, found, begun)
    certificate = dataclasses.replace(solution.certificate, searched=tried, worst_found_db=float(worst_db))
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
