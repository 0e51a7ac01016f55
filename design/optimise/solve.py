"""The solution of a case: its stages, and the method that robustness and the time between nodes require."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

from threadpoolctl import threadpool_limits

from maxq.design.case.schema import Case, LoadedCase, VariableSection
from maxq.design.laws.freedom import in_units, selected
from maxq.design.laws.law import DesignedLaw
from maxq.design.laws.registry import designed_law
from maxq.design.model.node_times import node_times
from maxq.design.model.powered import powered_spans
from maxq.design.optimise.at_nodes import make_problem, solve_at_nodes
from maxq.design.optimise.over_time import solve_over_time
from maxq.design.optimise.plants import Plants, make_plant, make_plants, nodes_of
from maxq.design.optimise.robust import solve_robust
from maxq.design.optimise.search import SearchProgress
from maxq.design.optimise.solution import Solution
from maxq.sim.scenario.schema_design import Design


def each_stage(loaded: LoadedCase, before_s: float = math.inf) -> list[LoadedCase]:
    """Return the case of each stage to be designed, with its operating points.

    `before_s` is the time of the loss of the flight; later times of the case are omitted. Raises ValueError if no
    operating point remains.
    """
    case = loaded.case
    if loaded.points is not None:
        return [replace(loaded, case=case.of_stage(0, case.nodes_s or loaded.points.times_s))]
    count = len(loaded.scenario.vehicle.stage)
    wanted = None if case.stages is None else {n - 1 for n in case.stages}
    if wanted is not None and not wanted <= set(range(count)):
        raise ValueError(f"stages = {list(case.stages or ())}: the vehicle has {count}; allowed are numbers from 1")
    times = tuple(t for t in case.nodes_s or node_times(loaded.along, case.nodes_per_stage) if t < before_s)
    if not times:
        raise ValueError(f"nodes_s: no time before {before_s:.4g} s")
    if case.nodes_s is not None and count == 1:
        return [replace(loaded, case=case.of_stage(0, times))]
    spans = powered_spans(loaded.along)
    by_stage: dict[int, list[float]] = {}
    for t in times:
        # a time outside all spans is assigned to the first stage, whose operating point reports the error
        by_stage.setdefault(next((s.stage for s in spans if s.holds(t)), spans[0].stage if spans else 0), []).append(t)
    chosen = sorted(by_stage if wanted is None else wanted & set(by_stage))
    if not chosen:
        raise ValueError("no operating point is in a stage to be designed")
    return [replace(loaded, case=case.of_stage(n, tuple(by_stage[n]))) for n in chosen]


def nominal_plants(loaded: LoadedCase) -> Plants:
    """Return the plants at the operating points of a case with one stage.

    Raises ValueError, with the operating point, if a plant does not exist.
    """
    return make_plants([make_plant(node, loaded.case) for node in nodes_of(loaded, loaded.case.times_s)])


def solve(
    loaded: LoadedCase,
    plants: Plants | None = None,
    also_from: Sequence[DesignedLaw] = (),
    progress: SearchProgress | None = None,
) -> Solution:
    """Return the best design found for a case.

    `plants` replaces the nominal plants of the case. `also_from` contains laws of similar cases as additional starts.
    If their filters have a lower order, or their gains less freedom, the result is guaranteed to be no worse. Raises
    ValueError for a case without a problem (no such operating point, no first mode). Raises KeyboardInterrupt if no
    point has been found yet.
    """
    # for matrices of forty rows, threads of the linear-algebra library double the CPU time
    with threadpool_limits(limits=1, user_api="blas"):
        plants = nominal_plants(loaded) if plants is None else plants
        if loaded.start is not None:
            start = _named_start(loaded.case, loaded.start, plants)
            loaded, also_from = _with_start_values(loaded, start, plants), (*also_from, start)
        if loaded.case.robust is not None:
            return solve_robust(loaded, plants, also_from, progress)
        method = solve_over_time if loaded.case.between_nodes == "hold" else solve_at_nodes
        return method(loaded, plants, also_from, progress)


def _with_start_values(loaded: LoadedCase, start: DesignedLaw, plants: Plants) -> LoadedCase:
    """Return the case with the values of the start design in place of `from_start`.

    A filter with such values is discretised as in the start design.
    """
    case = loaded.case
    if not any(one.from_start for one in case.variable):
        return loaded
    law = make_problem(_free(case), plants).law
    values = law.variables_of(start, clipped=False)
    assert values is not None  # `_named_start` has checked this
    fixed = list[VariableSection]()
    for one in case.variable:
        mine = selected(one.name, law.names) if one.from_start else ()
        fixed += [VariableSection(name=law.names[k], value=in_units(law.names[k], float(values[k]))) for k in mine]
        fixed += [] if one.from_start else [one]
    prewarp_hz = case.filter.prewarp_hz or getattr(start, "prewarp_hz", None)
    filter_ = case.filter.model_copy(update={"prewarp_hz": prewarp_hz})
    return replace(loaded, case=case.model_copy(update={"variable": tuple(fixed), "filter": filter_}))


def _free(case: Case) -> Case:
    """Return the case without fixed and bounded variables."""
    return case.model_copy(update={"variable": ()})


def _named_start(case: Case, design: Design, plants: Plants) -> DesignedLaw:
    law = designed_law(design.of_stage(plants.each[0].node.stage))
    if make_problem(_free(case), plants).law.variables_of(law) is None:
        raise ValueError(
            f"search.start_design = {case.search.start_design!r}: has another law, gains over another quantity, or "
            f"more filter than the case; allowed is a design of the law {case.law} over {case.gains.over}"
        )
    return law
