"""A law that the package does not contain passes through loops, margins and the optimiser.

| part | check |
|---|---|
| loop | response equals that of its state matrix; closed poles are zeros of 1 + L and agree with encirclements |
| law name | the registry finds it and rejects others |
| gradients, curvature | differences of values, of gradients |
| optimum | conditions of optimality, and the limits on a loop built again |
| objectives | the names allowed in a case are those of the table |
"""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import get_args

import numpy as np
import optimise_kit as kit
import pytest
from design_nodes import design, node_at, without
from pid_law import PID, Pid

from maxq import Loop, margins
from maxq.design.case.schema import ObjectiveName
from maxq.design.laws import registry
from maxq.design.loop.fixed_path import fixed_path
from maxq.design.loop.loop import close_loop
from maxq.design.optimise.at_nodes import make_problem
from maxq.design.optimise.criteria import OBJECTIVES
from maxq.design.optimise.plants import make_plant, make_plants
from maxq.design.optimise.solve import solve

F = np.geomspace(0.01, 45.0, 60)
KINDS = pytest.mark.parametrize("kind", ["pade", "sampled"])


@pytest.fixture(autouse=True)
def second_law(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(registry.LAWS, "tried", PID)


@cache
def case_of(kind: str):
    loaded = kit.case(
        "objective.kind=least-margin",
        "limits.modulus_db=-6",
        f"loop={kind}",
        "search.starts=3",
        "search.leaps=2",
        "nodes_s=[20.0, 40.0]",
    )
    return replace(loaded, case=loaded.case.model_copy(update={"law": "tried"}))


@cache
def plants_of(kind: str):
    """Return plants without bending modes, for which this law has no filter."""
    case = case_of(kind).case
    return make_plants([make_plant(without(node_at(t), modes=True), case) for t in case.nodes_s])


def problem_of(kind: str):
    return make_problem(case_of(kind).case, plants_of(kind))


@KINDS
def test_its_loop_is_one_in_every_form(kind: str) -> None:
    node = without(node_at(40.0), modes=True)
    loop = close_loop(fixed_path(node, kind), design().model_copy(update={"law": "tried"}))
    assert isinstance(loop.law, Pid)
    s = loop.state_space()
    at = 2j * np.pi * F if loop.sample_s is None else np.exp(2j * np.pi * F * loop.sample_s)
    direct = [(s.c @ np.linalg.solve(z * np.eye(len(s.a)) - s.a, s.b) + s.d)[0, 0] for z in at]
    np.testing.assert_allclose(loop.response(F), direct, rtol=1e-6)
    measured = margins(loop)
    assert measured.stable == bool((loop.closed_poles().real < 0.0).all())
    assert not margins(replace(loop, law=loop.law.scaled(30.0))).stable
    with pytest.raises(ValueError, match="the loop's period"):
        Loop(loop.fixed, replace(loop.law, sample_s=0.5))


def test_the_registry_knows_its_laws_only() -> None:
    with pytest.raises(ValueError, match="law = 'lqr': allowed is pd, pid"):
        registry.law_kind("lqr")


@KINDS
def test_gradients_and_curvature_are_differences(kind: str) -> None:
    p = problem_of(kind)
    x, step = p.law.starts(1, 1)[0], 1e-6
    here = p.evaluate(x)
    weights = np.random.default_rng(2).uniform(0.0, 1.0, len(here.rows))
    curvature = p.curvature(here, weights)
    for j in range(p.size):
        ahead, back = (p.evaluate(x + side * step * np.eye(p.size)[j]) for side in (1.0, -1.0))
        assert (ahead.rows.what == here.rows.what).all()
        assert (back.rows.what == here.rows.what).all()
        values = (ahead.rows.excess_db - back.rows.excess_db) / (2 * step)
        np.testing.assert_allclose(here.gradient[:, j], values, rtol=1e-5, atol=2e-5)
        slopes = weights @ (ahead.gradient - back.gradient) / (2 * step)
        np.testing.assert_allclose(curvature[:, j], slopes, rtol=1e-3, atol=1e-3 * np.abs(curvature).max())


@KINDS
def test_unstable_poles_are_counted_as_they_are(kind: str) -> None:
    p, seen = problem_of(kind), set()
    rng = np.random.default_rng(4)
    for _ in range(8):
        x = rng.uniform(p.lower, p.upper)
        counted = p.loops.unstable_poles(p.loops.response(x))
        for i, (plant, law) in enumerate(zip(plants_of(kind).each, p.law.controllers(x), strict=True)):
            assert counted[i] == (Loop(plant.path, law).closed_poles().real > 0.0).sum()
            seen.add(int(counted[i]))
    assert len(seen) > 1


@pytest.mark.slow
@KINDS
def test_it_is_optimised_like_any_other(kind: str) -> None:
    loaded, plants = case_of(kind), plants_of(kind)
    s = solve(loaded, plants)
    assert s.status == "optimal"
    assert s.feasible
    assert s.certificate.kkt_residual < 1e-6
    limits, nearest = loaded.case.limits, []
    for plant in plants.each:
        found = margins(Loop(plant.path, s.law.at(plant.node.time_s, "pitch", plant.path.sample_s)))
        assert found.stable
        assert found.gain_up_db.value > limits.gain_margin_db - 1e-3
        assert found.phase_deg.value > limits.phase_margin_deg - 1e-3
        nearest.append(-20.0 * np.log10(found.modulus))
    assert max(nearest) == pytest.approx(s.objective_db, abs=1e-3)
    again = solve(loaded, plants, [s])
    assert again.objective_db == pytest.approx(s.objective_db, abs=1e-4)


def test_a_case_may_name_the_objectives_of_the_table() -> None:
    assert get_args(ObjectiveName) == tuple(OBJECTIVES)
