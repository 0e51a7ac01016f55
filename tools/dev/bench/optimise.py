"""The benchmark of the optimiser: its time, and a comparison with global searches without gradients.

    python -m maxq.tools.dev.bench.optimise [--seconds 20] [--seeds 1] [--workers 2] [--only F4/free,...]

The module prints JSON. It contains the times of:

- an F6 design with free gains, also at four times the operating points
- the fifteen optima of one table of docs/case-study
- robust designs of KSR-III, and of the three stages of the built-in layout petrel
- the first answer of a new case in a new process: from its start to the first optimised design.

F2 to F4 with all three gain schedules are compared with two searches without gradients from random populations:
differential evolution (SciPy) and CMA-ES with restarts (pycma). These share only the exact responses of the fixed paths
with the optimiser. Limits are a penalty, and crossings between grid points are interpolated linearly. A search exploits
the interpolation error: in F2, a margin missed by 0.01 dB gains 0.08 dB. Its best point is therefore judged after a
descent to a point that meets the limits exactly. The long run uses `--seconds 1800`.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import Bounds, OptimizeResult, differential_evolution

from maxq.control.kernel.records import Array
from maxq.design.case.schema import Case, read_case
from maxq.design.laws.pd_variables import PdVariables
from maxq.design.optimise.at_nodes import make_problem
from maxq.design.optimise.plants import Plants
from maxq.design.optimise.problem import Problem
from maxq.design.optimise.solve import each_stage, nominal_plants, solve
from maxq.design.optimise.sqp import descend
from maxq.sim.input.values import at_time
from maxq.tools.design.run_case import order_cases, solve_orders

CASE = "ksr3-identical"
STRUCTURES, SCHEDULES = ("F2", "F3", "F4", "F5", "F6"), ("two-phase", "linear", "free")
RIVALS = tuple((structure, schedule) for structure in STRUCTURES[:3] for schedule in SCHEDULES)
PENALTY = 50.0  # dB of the objective for each dB of violation
HIGHEST_HZ = 60.0
GAIN_BOUNDS = (0.1, 3.0)  # wider than those of the optimiser, in favour of the rival
MET_DB = 1e-6
FIRST = """
import time
from maxq.design.case.schema import read_case
from maxq.design.optimise.solve import nominal_plants, solve
loaded = read_case("ksr3-relaxed", ["search.starts=1", "search.leaps=0", "limits.rigid_hz=0.45"])
solve(loaded, nominal_plants(loaded))
print(time.process_time())
"""
STEP = 0.25  # first standard deviation of CMA-ES, as a share of the bounds


class Rival:
    """The cost of a design, dB, for a search without gradients: the peak of mode 1 and a penalty for missed limits."""

    def __init__(self, case: Case, plants: Plants, problem: Problem) -> None:
        assert isinstance(problem.law, PdVariables)
        self.case, self.law = case, problem.law
        below = plants.curves.frequency_hz < HIGHEST_HZ
        f, at = plants.curves.frequency_hz[below], plants.curves.plant[below]
        self.s, self.plant = 2j * np.pi * f, at
        self.path, self.integrator = (
            np.concatenate([getattr(x.path, part)(f[at == p]) for p, x in enumerate(plants.each)])
            for part in ("response", "integrator")
        )
        self.same = at[1:] == at[:-1]
        self.first = np.flatnonzero(np.append(True, ~self.same))
        self.bands = [
            (mode, np.flatnonzero((at == p) & (f >= low) & (f <= high)))
            for p, x in enumerate(plants.each)
            for mode, low, high in x.bands_hz
        ]
        self.m_delta = plants.rigid.m_delta
        self.unstable = plants.unstable_open
        self.count = 0

    def __call__(self, x: Array) -> float:
        self.count += 1
        limits, law = self.case.limits, self.law
        y, u, *_ = law.split(x)
        k_p, k_d = law.gains.at_plants(u)
        filter_ = law.filter.filter(y)
        missing = max(0.0, float(law.filter.log_gain_at_infinity() @ y))
        if law.gains.size > 0:
            omega, zeta = np.sqrt(self.m_delta * k_p), 0.5 * k_d * np.sqrt(self.m_delta / k_p)
            least_hz, least_zeta = (at_time(x, law.task.times_s) for x in (limits.rigid_hz, limits.rigid_zeta))
            missing += 9.0 * float(np.maximum(np.log(2 * np.pi * least_hz / omega), 0.0).sum())
            missing += 9.0 * float(np.maximum(np.log(least_zeta / zeta), 0.0).sum())
        gains = k_p[self.plant] * self.integrator + k_d[self.plant]
        loop = filter_.frequency_response(self.s.imag) * gains * self.path
        size, beside = 20 * np.log10(np.abs(loop)), np.degrees(np.angle(-loop))
        peak = max(float(size[at].max(initial=-200.0)) for mode, at in self.bands if mode == 1)
        for mode, at in self.bands:
            if mode == 2:
                missing += max(0.0, float(size[at].max(initial=-200.0)) - limits.second_mode_db)
        gain, phase = limits.gain_margin_db, limits.phase_margin_deg
        near = np.abs(beside) < 60.0
        at_axis = interpolated(beside, size, self.same & near[1:] & near[:-1])
        missing += float(np.maximum(gain - np.abs(at_axis), 0.0).sum())
        missing += float(np.maximum(gain - np.abs(size[self.first]), 0.0).sum())
        at_unity = interpolated(size, beside, self.same)
        missing += float(np.maximum(phase - np.abs(at_unity), 0.0).sum()) * gain / phase
        distance = 1 + loop
        step = np.append(np.where(self.same, np.angle(distance[1:] * np.conj(distance[:-1])), 0.0), 0.0)
        turned = np.add.reduceat(step, self.first) / np.pi
        missing += 10.0 * float(np.abs(np.rint(turned - self.unstable)).sum())
        return peak + PENALTY * missing


def interpolated(zero: Array, value: Array, where: NDArray[np.bool_]) -> Array:
    """Return `value` at the sign changes of `zero` between neighbouring points, by linear interpolation.

    Only intervals for which `where` is True are used.
    """
    k = np.flatnonzero((np.sign(zero[1:]) != np.sign(zero[:-1])) & where)
    share = zero[k] / (zero[k] - zero[k + 1])
    return np.asarray(value[k] + share * (value[k + 1] - value[k]))


def evolve(
    cost: Callable[[Array], float], lower: Array, upper: Array, seconds: float, seed: int
) -> tuple[Array, float]:
    """Run differential evolution for this CPU time, with restarts after convergence. Return the best point and its
    cost.
    """
    begun, rng = time.process_time(), np.random.default_rng(seed)
    best: tuple[Array, float] = (lower, np.inf)

    def stop(intermediate_result: OptimizeResult) -> None:
        if time.process_time() - begun > seconds:
            raise StopIteration

    while time.process_time() - begun < seconds:
        found = differential_evolution(
            cost, Bounds(lower, upper), rng=rng, maxiter=100000, popsize=10, tol=1e-8, polish=False, callback=stop
        )
        if float(found.fun) < best[1]:
            best = np.asarray(found.x), float(found.fun)
    return best


def adapt(cost: Callable[[Array], float], lower: Array, upper: Array, seconds: float, seed: int) -> tuple[Array, float]:
    """Run CMA-ES for this CPU time, with restarts with twice the population. Return the best point and its cost."""
    import cma  # noqa: PLC0415  # needed here only; comes with the extra "test"

    begun, rng, generation = time.process_time(), np.random.default_rng(seed), 0
    size, span = 4 + int(3 * np.log(len(lower))), upper - lower
    best: tuple[Array, float] = (lower, np.inf)
    while time.process_time() - begun < seconds:
        options = {
            "bounds": [0, 1],
            "seed": seed + 1000 * generation + 1,
            "verbose": -9,
            "popsize": size * 2**generation,
        }
        search = cma.CMAEvolutionStrategy(rng.random(len(lower)), STEP, options)
        while not search.stop() and time.process_time() - begun < seconds:
            points = search.ask()
            search.tell(points, [cost(lower + span * point) for point in points])
        if search.result.fbest < best[1]:
            best = lower + span * search.result.xbest, float(search.result.fbest)
        generation = (generation + 1) % 5
    return best


METHODS = {"differential evolution": evolve, "CMA-ES": adapt}


def compare(structure: str, schedule: str, method: str, seconds: float, seed: int) -> dict[str, Any]:
    """Return the results of a search without gradients for `seconds` of CPU time, and of the optimiser on the same
    problem.
    """
    loaded = read_case(CASE, [f"filter.structure={structure}", f"gains.schedule={schedule}"])
    plants = nominal_plants(loaded)
    begun = time.process_time()
    ours = solve(loaded, plants)
    took = time.process_time() - begun
    problem = make_problem(loaded.case, plants)
    cost = Rival(loaded.case, plants, problem)
    own_cost = cost(ours.variables)
    lower, upper = problem.lower.copy(), problem.upper.copy()
    n = cost.law.filter.size
    lower[n:], upper[n:] = np.log(GAIN_BOUNDS[0]), np.log(GAIN_BOUNDS[1])
    begun, cost.count = time.process_time(), 0
    x, best = METHODS[method](cost, lower, upper, seconds, seed)
    spent, evaluations = time.process_time() - begun, cost.count
    there = problem.evaluate(x)
    exact = descend(problem, x, 150, 1e-8)
    met = exact.unstable == 0 and exact.violation_db < MET_DB
    return {
        "structure": structure,
        "schedule": schedule,
        "method": method,
        "seed": seed,
        "ours_db": ours.objective_db,
        "ours_by_its_cost_db": own_cost,
        "ours_s": took,
        "found_db": best,
        "found_violation_db": there.violation_db,
        "found_unstable": there.unstable,
        "exact_db": exact.objective_db if met else None,
        "seconds": spent,
        "evaluations": evaluations,
    }


def cpu_s() -> float:
    """Return the CPU time of this process and of its ended children, s."""
    each = (resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    return sum(one.ru_utime + one.ru_stime for one in each)


def one_table() -> tuple[float, float, list[dict[str, Any]]]:
    """Return the wall-clock time and the CPU time (s) for the fifteen optima of one table on all cores, and a record
    of each optimum.
    """
    loaded = read_case(CASE)
    begun, spent = time.perf_counter(), cpu_s()
    found = solve_orders(order_cases(loaded), nominal_plants(loaded), lambda _done, _of: None)
    rows = [
        {
            "structure": structure,
            "schedule": schedule,
            "objective_db": s.objective_db,
            "status": s.status,
            "near_best": s.certificate.near_best,
            "starts": s.certificate.starts,
            "leaps_back": s.certificate.leaps_back,
            "leaps": s.certificate.leaps,
            "kkt_residual": s.certificate.kkt_residual,
            "seconds": s.certificate.seconds,
        }
        for (structure, schedule), (_, s) in found.items()
    ]
    return time.perf_counter() - begun, cpu_s() - spent, rows


def single() -> dict[str, Any]:
    """Return the time of F6 with free gains alone: 34 variables, eleven operating points."""
    loaded = read_case(CASE, ["filter.structure=F6", "gains.schedule=free"])
    begun, clock = time.process_time(), time.perf_counter()
    plants = nominal_plants(loaded)
    made, s = time.process_time(), solve(loaded, plants)
    return {
        "objective_db": s.objective_db,
        "variables": len(s.variables),
        "statement": s.certificate.statement(),
        "seconds_plants": made - begun,
        "seconds": time.process_time() - made,
        "seconds_by_the_clock": time.perf_counter() - clock,
    }


def more_nodes() -> float:
    """Return the CPU time of F6 with free gains at 44 operating points relative to that at 11, including the
    flights.
    """
    seconds = []
    for nodes in (11, 44):
        times_s = np.linspace(5.0, 55.0, nodes).round(3).tolist()
        loaded = read_case(CASE, ["filter.structure=F6", "gains.schedule=free", f"nodes_s={times_s}"])
        begun = time.process_time()
        solve(loaded, nominal_plants(loaded))
        seconds.append(time.process_time() - begun)
    return seconds[1] / seconds[0]


def robust() -> float:
    """Return the wall-clock time (s) of the robust design, including its searches for the worst plants."""
    begun, loaded = time.perf_counter(), read_case("ksr3-robust")
    solve(loaded, nominal_plants(loaded))
    return time.perf_counter() - begun


def petrel() -> tuple[float, float]:
    """Return the wall-clock time and the CPU time (s) of the robust design of petrel, without building the vehicle."""
    with tempfile.TemporaryDirectory() as folder:
        made = [str(Path(sys.executable).with_name("simvehicle")), "petrel", "--out", f"{folder}/petrel"]
        subprocess.run(made, check=True, stdout=subprocess.DEVNULL)
        loaded = read_case("petrel-robust", [f'scenario="{folder}/petrel/scenario.toml"'])
        begun, spent = time.perf_counter(), cpu_s()
        for stage in each_stage(loaded):
            solve(stage, nominal_plants(stage))
        return time.perf_counter() - begun, cpu_s() - spent


def first_answer() -> dict[str, float]:
    """Return the times (s) from the start of a new process to the first optimised design of a case new to it."""
    begun = time.perf_counter()
    done = subprocess.run([sys.executable, "-c", FIRST], check=True, capture_output=True, text=True)
    return {"first_s": time.perf_counter() - begun, "first_cpu_s": float(done.stdout)}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=20.0, help="CPU time of each search without gradients")
    parser.add_argument("--seeds", type=int, default=1, help="searches of each kind for each problem")
    parser.add_argument("--workers", type=int, default=2, help="searches at a time")
    parser.add_argument("--only", default="", help="comma-separated problems such as F4/free; nothing else is done")
    options = parser.parse_args()
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # inherited by the search processes
    rivals = [tuple(name.split("/")) for name in options.only.split(",") if name] or RIVALS
    tasks = [
        (structure, schedule, method, options.seconds, seed)
        for structure, schedule in rivals
        for method in METHODS
        for seed in range(1, options.seeds + 1)
    ]
    result: dict[str, Any] = {"single": {}, "table": []}
    if not options.only:
        single()  # excludes imports and first calls from the measurement
        one = single() | {"nodes_ratio": more_nodes(), "robust_s": robust()} | first_answer()
        one["petrel_s"], one["petrel_cpu_s"] = petrel()
        one["table_s"], one["table_cpu_s"], table = one_table()
        result = {"single": one, "table": table}
    result["search_s"], result["searches"] = options.seconds, []
    with ProcessPoolExecutor(options.workers) as pool:
        for task in [pool.submit(compare, *task) for task in tasks]:
            row = task.result()
            result["searches"].append(row)
            print(json.dumps(row), file=sys.stderr, flush=True)  # the long run takes hours
    print(json.dumps(result, indent=1))


if __name__ == "__main__":
    main()
