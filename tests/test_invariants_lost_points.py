"""A search recovers an operating point with an unstable loop, and no proposed change contradicts the verdict.

KSR-III at three operating points with free gains has an optimum with a least |1 + L| of 0.602. From gains far off at
one point, a descent ends with that loop unstable at 0.521, and every limit appears met.

| case | expected |
|---|---|
| one search, one start with a lost point | ends at the optimum |
| gains of lost points | are interpolated between those of the others |
| a search that ends unstable or misses limits | continues for the limits alone, from other starts |
| a round of a robust search | likewise, from the design of the round before |
| a trial with unstable poles | does not meet all limits |
"""

from __future__ import annotations

from typing import Any

import numpy as np
import optimise_kit as kit
import pytest

from maxq.control.kernel.records import Array
from maxq.design.optimise import at_nodes, robust, search, way_out
from maxq.design.optimise.at_nodes import search_on
from maxq.design.optimise.solve import solve
from maxq.design.optimise.sqp import descend

CASE = (
    "nodes_s=[25.0, 35.0, 45.0]",
    "gains.schedule=free",
    "objective.kind=least-margin",
    "loop=sampled",
    "filter.structure=F2",
    "search.starts=1",
    "search.leaps=0",
)
BEST_DB = 4.40203
FAR_OFF = 20.0, 0.45  # k_p, k_d


def problem() -> Any:
    return kit.problem(*CASE, on=kit.plants(*CASE))


def with_gains(p: Any, variables: Array, point: int | slice, k_p: float, k_d: float) -> Array:
    """Return variables with other gains at one operating point, or at all."""
    y, u, *_ = kit.pd(p).split(variables)
    gains = u.reshape(2, -1).copy()
    gains[:, point] = np.log([[k_p], [k_d]] if isinstance(point, slice) else [k_p, k_d])
    return np.concatenate([y, gains.ravel()])


def lost_start(p: Any) -> Array:
    """Return a start of the law with the gains at 35 s far off."""
    return with_gains(p, p.law.starts(1, 1)[0], 1, *FAR_OFF)


@pytest.fixture
def unmended(monkeypatch: pytest.MonkeyPatch) -> None:
    """Disable the recovery of lost points within a search."""
    monkeypatch.setattr(search, "_mended", lambda problem, at: None)


def test_a_descent_from_an_unstable_loop_leads_away() -> None:
    p = problem()
    end = descend(p, lost_start(p), 150, 1e-8)
    assert (end.unstable, p.unstable_plants(end.variables).tolist()) == (2, [1])
    assert (end.violation_db, end.objective_db) == (0.0, pytest.approx(5.6726, abs=1e-3))


@pytest.mark.parametrize("point", [0, 1, 2])
def test_a_lost_point_is_found_again(point: int) -> None:
    p = problem()
    found = search.search(p, [with_gains(p, p.law.starts(1, 1)[0], point, *FAR_OFF)])
    assert found.feasible
    assert found.best.objective_db == pytest.approx(BEST_DB, abs=1e-4)
    assert found.ends_db == pytest.approx([BEST_DB], abs=1e-3)


def test_gains_of_lost_points_are_those_of_their_neighbours() -> None:
    p = problem()
    x = p.law.starts(1, 1)[0]
    beside = p.law.beside(with_gains(p, x, 1, *FAR_OFF), np.array([1]))
    before, after = (kit.pd(p).gains.at_nodes(kit.pd(p).split(v)[1]) for v in (x, beside))
    np.testing.assert_allclose(after[:, [0, 2]], before[:, [0, 2]])
    np.testing.assert_allclose(after[:, 1], before[:, [0, 2]].mean(axis=1))
    assert p.law.beside(x, np.arange(3)) is None


def test_a_point_of_linear_gains_has_no_neighbours() -> None:
    case = (*CASE, "gains.schedule=linear")
    p = kit.problem(*case, on=kit.plants(*case))
    assert p.law.beside(p.law.starts(1, 1)[0], np.array([1])) is None


def test_a_lost_search_goes_on_from_other_starts(unmended: None) -> None:
    p, case = problem(), kit.case(*CASE).case
    lost = search.search(p, [lost_start(p)])
    assert (lost.feasible, lost.settled) == (False, False)
    found = search_on(case, p, lost)
    assert found.feasible
    assert found.best.objective_db == pytest.approx(BEST_DB, abs=1e-4)
    assert found.evaluations == p.evaluations


def test_a_round_of_a_robust_search_does_so_too(unmended: None) -> None:
    p, case = problem(), kit.case(*CASE).case
    lost = search.search(p, [lost_start(p)])
    found = robust._again(case, problem(), lost)
    assert found.feasible
    assert found.best.objective_db == pytest.approx(BEST_DB, abs=1e-4)


def test_a_case_that_can_be_designed_needs_no_way_out(unmended: None, monkeypatch: pytest.MonkeyPatch) -> None:
    """All starts of the search lose a point, and those of a search for the limits alone do not."""

    def search_from(case: Any, plants: Any, *_: Any) -> tuple[Any, Any]:
        p = at_nodes.make_problem(case, plants)
        return p, search.search(p, [lost_start(p)])

    monkeypatch.setattr(at_nodes, "_search_from", search_from)
    loaded = kit.case(*CASE)
    s = solve(loaded)
    assert s.feasible
    assert way_out.tried(loaded, s) == ((), False)


@pytest.mark.slow
def test_a_trial_that_is_unstable_by_its_poles_meets_no_limits(monkeypatch: pytest.MonkeyPatch) -> None:
    loaded = kit.case(*CASE, "limits.gain_margin_db=25")
    s = solve(loaded)
    assert s.status == "infeasible"
    monkeypatch.setattr(way_out, "closes_stably", lambda *_: False)
    trials, _ = way_out.tried(loaded, s)
    assert {t.unstable for t in trials} == {1}
    assert all(t.text == f"{t.change}: reached no stable design" for t in trials)
