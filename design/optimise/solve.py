"""`solve(case)`: from a case file to a design."""

from __future__ import annotations

import time
from collections.abc import Sequence

import numpy as np
from threadpoolctl import threadpool_limits

from maxq.control.kernel.records import Array
from maxq.design import api
from maxq.design.case.read import LoadedCase
from maxq.design.case.schema import Case
from maxq.design.laws.pd import Pd
from maxq.design.loop.fixed_path import ExactFixedPath
from maxq.design.loop.loop import Loop
from maxq.design.optimise import starts
from maxq.design.optimise.plants import Plants, make_plant, make_plants
from maxq.design.optimise.problem import Problem
from maxq.design.optimise.search import Found, Progress, search
from maxq.design.optimise.setup import Form, form_of, make_problem, prewarp_hz
from maxq.design.optimise.solution import Solution, make_solution


def nominal_plants(loaded: LoadedCase) -> Plants:
    """The case's plants at its nodes. Raises ValueError, naming the node, where there is none."""
    case = loaded.case
    nodes = api.nodes(loaded.scenario, case.nodes_s, plane=case.plane, errata=case.errata, plant=case.plant)
    return make_plants([make_plant(node, case) for node in nodes])


def solve(
    loaded: LoadedCase,
    plants: Plants | None = None,
    also_from: Sequence[Solution] = (),
    progress: Progress | None = None,
) -> Solution:
    """The best design found for a case.

    `plants`: where they have been made already. `also_from`: solutions of like cases from which to start, too; with a
    filter of lower order, or less freedom in the gains, they guarantee a result that is no worse. Raises ValueError
    for a case without a problem (no such node, no first mode), KeyboardInterrupt where nothing is found yet.
    """
    # with matrices of forty rows, threads of the linear-algebra library only wait for each other: twice the CPU time
    with threadpool_limits(limits=1, user_api="blas"):
        return _solve(loaded, plants, also_from, progress)


def _solve(
    loaded: LoadedCase, plants: Plants | None, also_from: Sequence[Solution], progress: Progress | None
) -> Solution:
    begun = time.perf_counter()
    plants = nominal_plants(loaded) if plants is None else plants
    if loaded.case.robust is not None:
        from maxq.design.optimise.robust import solve_robust  # noqa: PLC0415  # it needs this module

        return solve_robust(loaded, plants, also_from, progress)
    problem, found = search_form(loaded.case, plants, form_of(loaded.case), also_from, progress)
    return finished(loaded.case, plants, problem, found, begun)


def finished(case: Case, plants: Plants, problem: Problem, found: Found, begun: float) -> Solution:
    """The solution at a search's best point, its stability checked by poles."""
    prewarp = prewarp_hz(case, plants)
    return make_solution(
        case,
        plants,
        problem,
        found,
        prewarp,
        time.perf_counter() - begun,
        closes_stably(plants, problem, found, prewarp),
    )


def search_form(
    case: Case, plants: Plants, form: Form, also_from: Sequence[Solution] = (), progress: Progress | None = None
) -> tuple[Problem, Found]:
    """Search with some form of filter and gains, whatever the case's own."""
    problem = make_problem(case, plants, form)
    given = _starts_from(problem, form, also_from, plants.first_mode_hz)
    leaps, seed = case.search.leaps, case.search.seed
    if form.schedule not in ("free", "nodes") or len(problem.loops.gains.nodes_s) <= 2:
        fresh = _fresh(problem, form, plants, case)
        return problem, search(problem, [*given, *fresh], progress=progress, leaps=leaps, seed=seed)
    # one with each node's own least gains; the others cheaply, as filters for linear gains
    own = list(starts.drawn(problem, form, plants.first_mode_hz))[:1]
    small_form = Form(form.quadratic, form.first_order, "linear")
    small = make_problem(case, plants, small_form)
    fresh = _fresh(small, small_form, plants, case)
    rough = (small, lambda x: _wider(small, problem, x))
    return problem, search(problem, [*given, *own], rough, fresh[: case.search.starts - 1], progress, leaps, seed)


def _fresh(problem: Problem, form: Form, plants: Plants, case: Case) -> list[Array]:
    """As many starts as the case asks for: drawn ones first, half of them at most, then random ones."""
    mode_hz, count = plants.first_mode_hz, case.search.starts
    drawn = list(starts.drawn(problem, form, mode_hz))[: (count + 1) // 2]
    return [*drawn, *starts.random(problem, form, mode_hz, count - len(drawn), case.search.seed)]


def _starts_from(problem: Problem, form: Form, also_from: Sequence[Solution], mode_hz: float) -> list[Array]:
    out = []
    for s in also_from:
        filter_ = starts.lifted(s.filter, form, mode_hz)
        if filter_ is not None:
            out.append(starts.from_design(problem, filter_, s.nodes_s, s.k_p, s.k_d_s))
    return out


def _wider(small: Problem, problem: Problem, x: Array) -> Array:
    """The same design in variables with more gain nodes."""
    y, u = small.loops.split(x)
    k_p, k_d = small.loops.gains.at_nodes(u)
    nodes, more = small.loops.gains.nodes_s, problem.loops.gains.nodes_s
    return np.concatenate([y, np.log(np.interp(more, nodes, k_p)), np.log(np.interp(more, nodes, k_d))])


def closes_stably(plants: Plants, problem: Problem, found: Found, prewarp: float) -> bool:
    """Whether every closed loop's poles lie where they must: eigenvalues, nothing that the optimiser has used."""
    y, u = problem.loops.split(found.best.variables)
    filter_ = problem.loops.filter.filter(y)
    k_p, k_d = problem.loops.gains.at_plants(u)
    for plant, p, d in zip(plants.each, k_p, k_d, strict=True):
        period = plant.path.sample_s
        flown = filter_ if period is None else filter_.discretize(period, "prewarped", prewarp)
        poles = Loop(plant.path, Pd(float(p), float(d), flown)).closed_poles()
        if isinstance(plant.path, ExactFixedPath):
            poles = poles[np.abs(poles) < 1e3]
        if len(poles) > 0 and float(poles.real.max()) >= 0.0:
            return False
    return True
