"""The optimiser: how long it takes, and whether a global search without gradients ever finds better.

    python -m maxq.tools.bench.optimise [--seconds 60] [--seeds 1]

prints as JSON: seconds for one F6 with free gains, for each of the fifteen optima of one table of
docs/case-study.md, and for the two beside each other differential evolution (SciPy) on the same problems: what it has
found after a given time, and by how much the optimiser's answer is better. Its cost shares with the optimiser the
exact responses of the fixed paths and nothing else: limits as a penalty, crossings between grid points by linear
interpolation.
"""

from __future__ import annotations

import argparse
import json
import time
from concurrent.futures import ProcessPoolExecutor
from typing import Any

import numpy as np
from scipy.optimize import Bounds, OptimizeResult, differential_evolution

from maxq.control.records import Array
from maxq.design.case.read import read_case
from maxq.design.case.schema import Case
from maxq.design.optimise.plants import Plants
from maxq.design.optimise.problem import Problem
from maxq.design.optimise.setup import form_of, make_problem
from maxq.design.optimise.solution import Solution
from maxq.design.optimise.solve import nominal_plants, solve

CASE = "ksr3-identical"
STRUCTURES, SCHEDULES = ("F2", "F3", "F4", "F5", "F6"), ("two-phase", "linear", "free")
RIVALS = (("F2", "linear"), ("F4", "two-phase"), ("F4", "linear"), ("F6", "two-phase"))
PENALTY = 50.0  # dB of the objective for each dB that is missed
HIGHEST_HZ = 60.0


class Rival:
    """Cost of a design for a search without gradients."""

    def __init__(self, case: Case, plants: Plants, problem: Problem) -> None:
        self.case, self.problem = case, problem
        f, at = plants.curves.frequency_hz, plants.curves.plant
        self.grids = [f[(at == p) & (f < HIGHEST_HZ)] for p in range(len(plants))]
        self.paths = [(x.path.response(g), x.path.integrator(g)) for x, g in zip(plants.each, self.grids, strict=True)]
        self.bands = [x.bands_hz for x in plants.each]
        self.m_delta = plants.rigid.m_delta
        self.unstable = plants.unstable_open
        self.count = 0

    def __call__(self, x: Array) -> float:
        self.count += 1
        limits, loops = self.case.limits, self.problem.loops
        y, u = loops.split(x)
        k_p, k_d = loops.gains.at_plants(u)
        filter_ = loops.filter.filter(y)
        peak, missing = -np.inf, max(0.0, float(loops.filter.log_gain_at_infinity() @ y))
        if loops.gains.size > 0:
            omega, zeta = np.sqrt(self.m_delta * k_p), 0.5 * k_d * np.sqrt(self.m_delta / k_p)
            missing += 9.0 * float(np.maximum(np.log(2 * np.pi * limits.rigid_hz / omega), 0.0).sum())
            missing += 9.0 * float(np.maximum(np.log(limits.rigid_zeta / zeta), 0.0).sum())
        for p, (f, (path, integrator)) in enumerate(zip(self.grids, self.paths, strict=True)):
            loop = filter_.frequency_response(2 * np.pi * f) * (k_p[p] * integrator + k_d[p]) * path
            size, beside = 20 * np.log10(np.abs(loop)), np.degrees(np.angle(-loop))
            for mode, low, high in self.bands[p]:
                largest = float(size[(f >= low) & (f <= high)].max(initial=-200.0))
                if mode == 1:
                    peak = max(peak, largest)
                elif mode == 2:
                    missing += max(0.0, largest - limits.second_mode_db)
            gain, phase = limits.gain_margin_db, limits.phase_margin_deg
            at_axis = interpolated(beside, size, np.abs(beside) < 60.0)
            missing += float(np.maximum(gain - np.abs(at_axis), 0.0).sum()) + max(0.0, gain - abs(float(size[0])))
            at_unity = interpolated(size, beside, np.ones(len(size), bool))
            missing += float(np.maximum(phase - np.abs(at_unity), 0.0).sum()) * gain / phase
            turned = np.unwrap(np.angle(1 + loop))
            missing += 10.0 * abs(round(float(turned[-1] - turned[0]) / np.pi - float(self.unstable[p])))
        return peak + PENALTY * missing


def interpolated(zero: Array, value: Array, where: Any) -> Array:
    """`value` where `zero` changes its sign among neighbours of `where`, linearly in between."""
    k = np.flatnonzero((np.sign(zero[1:]) != np.sign(zero[:-1])) & where[1:] & where[:-1])
    share = zero[k] / (zero[k] - zero[k + 1])
    return np.asarray(value[k] + share * (value[k + 1] - value[k]))


def evolve(structure: str, schedule: str, seconds: float, seed: int) -> dict[str, Any]:
    """Differential evolution for a time, and the optimiser on the same problem."""
    loaded = read_case(CASE, [f"filter.structure={structure}", f"gains.schedule={schedule}"])
    plants = nominal_plants(loaded)
    begun = time.process_time()
    ours = solve(loaded, plants)
    took = time.process_time() - begun
    problem = make_problem(loaded.case, plants, form_of(loaded.case))
    cost = Rival(loaded.case, plants, problem)
    lower, upper = problem.lower.copy(), problem.upper.copy()
    n = problem.loops.filter.size
    lower[n:], upper[n:] = np.log(0.1), np.log(3.0)  # wide enough, and kinder than the optimiser's own bounds
    begun = time.process_time()

    def stop(intermediate_result: OptimizeResult) -> None:
        if time.process_time() - begun > seconds:
            raise StopIteration

    found = differential_evolution(
        cost, Bounds(lower, upper), rng=seed, maxiter=100000, popsize=10, tol=1e-10, polish=False, callback=stop
    )  # fmt: skip
    there = problem.evaluate(np.asarray(found.x))
    return {
        "structure": structure,
        "schedule": schedule,
        "seed": seed,
        "ours_db": ours.objective_db,
        "ours_by_its_cost_db": cost(ours.variables),
        "ours_s": took,
        "evolution_db": float(found.fun),
        "evolution_violation_db": there.violation_db,
        "evolution_s": time.process_time() - begun,
        "evolution_evaluations": cost.count,
        "better_by_db": float(found.fun) - ours.objective_db,
    }


def one_table() -> list[dict[str, Any]]:
    """The fifteen optima of one table; CPU seconds each, nodes and curves made once."""
    found: dict[tuple[str, str], Solution] = {}
    out, plants = [], None
    for i, structure in enumerate(STRUCTURES):
        for j, schedule in enumerate(SCHEDULES):
            loaded = read_case(CASE, [f"filter.structure={structure}", f"gains.schedule={schedule}"])
            begun = time.process_time()
            plants = nominal_plants(loaded) if plants is None else plants
            contained = [found[STRUCTURES[i - 1], schedule]] if i > 0 else []
            contained += [found[structure, SCHEDULES[j - 1]]] if j > 0 else []
            s = solve(loaded, plants, contained)
            found[structure, schedule] = s
            out.append({
                "structure": structure, "schedule": schedule, "objective_db": s.objective_db, "status": s.status,
                "near_best": s.certificate.near_best, "starts": s.certificate.starts,
                "kkt_residual": s.certificate.kkt_residual, "seconds": time.process_time() - begun,
            })  # fmt: skip
    return out


def single() -> dict[str, Any]:
    """F6 with free gains by itself: 34 variables, eleven nodes."""
    loaded = read_case(CASE, ["filter.structure=F6", "gains.schedule=free"])
    begun, clock = time.process_time(), time.perf_counter()
    plants = nominal_plants(loaded)
    made, s = time.process_time(), solve(loaded, plants)
    return {
        "objective_db": s.objective_db,
        "variables": len(s.variables),
        "seconds_plants": made - begun,
        "seconds": time.process_time() - made,
        "seconds_by_the_clock": time.perf_counter() - clock,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=60.0, help="CPU time of each differential evolution")
    parser.add_argument("--seeds", type=int, default=1, help="differential evolutions of each problem")
    options = parser.parse_args()
    single()  # imports and first calls are not what is measured
    tasks = [(s, g, options.seconds, seed) for s, g in RIVALS for seed in range(1, options.seeds + 1)]
    result = {"single": single(), "table": one_table()}
    with ProcessPoolExecutor(2) as pool:
        result["evolution"] = list(pool.map(_evolve, tasks))
    print(json.dumps(result, indent=1))


def _evolve(task: tuple[str, str, float, int]) -> dict[str, Any]:
    return evolve(*task)


if __name__ == "__main__":
    main()
