"""The optimiser handles infeasible, interrupted and limiting cases, and its designs fly."""

from __future__ import annotations

import dataclasses
import math
from itertools import pairwise

import numpy as np
import optimise_kit as kit
import pytest
from design_nodes import without

from maxq.design.case.schema import read_case
from maxq.design.laws.bending_filter import FilterVariables, lifted
from maxq.design.optimise import search as search_module
from maxq.design.optimise.plants import make_plant, make_plants
from maxq.design.optimise.solve import nominal_plants, solve
from maxq.design.verify.outcome import make_design
from maxq.sim.scenario.loader import to_toml


@pytest.mark.long
def test_more_freedom_is_never_worse() -> None:
    """With a smaller problem's solution among the starts, two-phase to free and F2 to F4 are never worse."""
    plants, order = kit.all_nodes(), [("F2", "two-phase"), ("F2", "linear"), ("F3", "linear"), ("F4", "linear")]
    order.append(("F4", "free"))
    peaks: list[float] = []
    before = []
    for structure, schedule in order:  # each contains the one before
        loaded = kit.case(f"filter.structure={structure}", f"gains.schedule={schedule}", "search.starts=1")
        before = [solve(loaded, plants, before)]
        assert before[0].feasible
        peaks.append(before[0].objective_db)
    assert all(later <= earlier + 1e-6 for earlier, later in pairwise(peaks))
    assert peaks[-1] < peaks[0] - 10.0


@pytest.mark.long
def test_a_filter_of_higher_order_can_be_the_same() -> None:
    s = kit.solution("filter.structure=F2", "gains.schedule=linear")
    (second,) = kit.designed(s).filter.filters
    omega = 2 * np.pi * np.geomspace(0.1, 60.0, 50)
    third = lifted(second, FilterVariables(1, 1), 9.7)
    assert third is not None
    for form in (FilterVariables(1, 1), FilterVariables(2, 0), FilterVariables(3, 2)):
        same = lifted(second, form, 9.7)
        assert same is not None
        assert (len(same.quadratic), len(same.first_order)) == (form.quadratic, form.first_order)
        np.testing.assert_allclose(same.frequency_response(omega), second.frequency_response(omega), rtol=1e-12)
    fourth = lifted(
        dataclasses.replace(third, first_order=(dataclasses.replace(third.first_order[0], pole_hz=9.0),)),
        FilterVariables(2, 0),
        9.7,
    )
    assert fourth is not None
    assert lifted(second, FilterVariables(0, 2), 9.7) is None


@pytest.mark.long
def test_infeasible_limits_are_named() -> None:
    """F2 cannot meet both 10 dB and 60 deg; the message names the limits in conflict, the place and the violation."""
    loaded = kit.case("filter.structure=F2", "limits.gain_margin_db=10", "limits.phase_margin_deg=60")
    s = solve(loaded, kit.all_nodes())
    assert s.status == "infeasible"
    assert not s.feasible
    assert s.violation_db > 0.1
    blamed = s.in_the_way
    assert {c.what for c in blamed[:2]} <= {
        "gain margin",
        "phase margin",
        "rigid-body frequency",
        "rigid-body damping ratio",
    }
    assert blamed[0].excess_db == pytest.approx(s.violation_db, abs=1e-4)
    assert sum(c.multiplier for c in s.constraints) == pytest.approx(1.0, abs=1e-6)
    text = s.explanation()
    assert "cannot be met together" in text
    assert "\n" not in text
    assert "limits are missed" in make_design(loaded, s).description


def test_ctrl_c_keeps_the_best_so_far(monkeypatch: pytest.MonkeyPatch) -> None:
    loaded, plants = kit.case("filter.structure=F2"), kit.all_nodes()
    seen: list[tuple[int, int]] = []

    def stop(done: int, total: int, best_db: float, what: str) -> None:
        seen.append((done, total))
        if done == 2:
            raise KeyboardInterrupt

    s = solve(loaded, plants, progress=stop)
    assert s.status == "interrupted"
    assert seen == [(1, 16), (2, 16)]  # eight starts, eight leaps
    assert s.certificate.starts == 2
    assert math.isfinite(s.objective_db)

    def at_once(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(search_module, "descend", at_once)
    with pytest.raises(KeyboardInterrupt):
        solve(loaded, plants)


HELD = (
    "nodes_s=[45.0, 50.0, 55.0]",
    "filter.structure=F2",
    "search.starts=1",
    "search.leaps=1",
    "between_nodes='hold'",
)


@pytest.mark.long
def test_a_design_that_was_not_interrupted_claims_its_instants() -> None:
    whole = solve(kit.case(*HELD))
    assert (whole.certificate.instants > 40, whole.certificate.worst_instant_db < 0.02) == (True, True)


@pytest.mark.slow
@pytest.mark.parametrize("stop_at", [1, 3])
def test_a_design_that_was_interrupted_claims_no_instants(stop_at: int) -> None:
    """Interrupted in the first search, or in the second with added instants, the design claims no untested instants."""
    loaded, calls = kit.case(*HELD), []

    def stop(done: int, total: int, best_db: float, what: str) -> None:
        calls.append(done)
        if len(calls) == stop_at:
            raise KeyboardInterrupt

    s = solve(loaded, progress=stop)
    assert s.status == "interrupted"
    assert len(calls) == stop_at
    assert s.certificate.instants == 0
    assert (len(s.nodes) > 3) == (stop_at > 2)


@pytest.mark.long
def test_the_same_seed_gives_the_same_design() -> None:
    loaded, plants = kit.case("filter.structure=F2", "search.starts=2"), kit.all_nodes()
    first, second = solve(loaded, plants), solve(loaded, plants)
    assert (first.variables == second.variables).all()
    assert first.certificate.ends_db == second.certificate.ends_db or any(map(math.isnan, first.certificate.ends_db))


def test_nodes_outside_the_powered_flight_are_refused() -> None:
    for nodes, said in (("[5.0, 80.0]", "operating point at 80 s"), ("[-1.0, 5.0]", "operating point at -1 s")):
        with pytest.raises(ValueError, match=said):
            nominal_plants(read_case("ksr3-identical", [f"nodes_s={nodes}"]))


@pytest.mark.slow
def test_one_node_and_gain_nodes_anywhere() -> None:
    one = kit.case("nodes_s=[40.0]", "filter.structure=F2", "gains.schedule=free", "search.starts=2")
    s = solve(one)
    assert s.feasible
    assert len(kit.designed(s).pitch.k_p) == 1
    anywhere = kit.case(
        "nodes_s=[10.0, 30.0, 50.0]",
        "filter.structure=F2",
        "gains.schedule=nodes",
        "gains.nodes_s=[0.0, 22.5, 60.0]",
        "search.starts=2",
    )
    s = solve(anywhere)
    assert s.feasible
    assert kit.designed(s).pitch.at == [0.0, 22.5, 60.0]


@pytest.mark.slow
def test_filter_of_sections() -> None:
    loaded = kit.case(
        "filter.structure=sections",
        "filter.quadratic=3",
        "filter.first_order=1",
        "search.starts=1",
        "nodes_s=[5.0, 30.0, 55.0]",
    )
    s = solve(loaded)
    assert s.feasible
    design = make_design(loaded, s)
    assert design.filter.structure == "sections"
    assert len(design.filter.quadratic) == 3


def test_without_a_bending_mode_there_is_a_least_margin_but_no_peak() -> None:
    node = kit.all_nodes().each[6].node
    stiff = without(node, modes=True)
    with pytest.raises(ValueError, match="no first bending mode"):
        make_plant(stiff, kit.case().case)
    loaded = kit.case("objective.kind=least-margin", "filter.structure=F2", "nodes_s=[35.0]", "search.starts=2")
    s = solve(loaded, make_plants([make_plant(stiff, loaded.case)]))
    assert s.feasible
    assert s.objective_db < 6.0


@pytest.mark.long
def test_two_modes_at_one_frequency() -> None:
    node = kit.all_nodes().each[6].node
    omega = node.vehicle.omega_radps
    twins = node.with_(bending_frequency=(1.0, omega[0] / omega[1]))
    loaded = kit.case("filter.structure=F4", "nodes_s=[35.0]", "search.starts=2")
    s = solve(loaded, make_plants([make_plant(twins, loaded.case)]))
    # both modes in one band: the first one's objective and the second one's limit are the same peak
    assert s.status in ("optimal", "infeasible")
    assert math.isfinite(s.objective_db)
    assert (s.explanation() == "") == s.feasible


def test_variables_that_are_no_numbers_are_refused() -> None:
    p = kit.problem("filter.structure=F2")
    with pytest.raises(ValueError, match="not finite"):
        p.evaluate(np.full(p.size, np.nan))


@pytest.mark.slow
def test_a_design_document_is_what_simrun_reads() -> None:
    order = ("filter.structure=F4", "gains.schedule=linear", "loop=sampled")
    s = kit.solution(*order)
    design = make_design(kit.case(*order), s)
    assert design.filter.prewarp_hz == kit.designed(s).prewarp_hz
    np.testing.assert_allclose(design.gains.table["k_p"], kit.designed(s).pitch.k_p)
    assert "zero_hz" in to_toml(design)


@pytest.mark.long
def test_a_robust_design_holds_where_the_nominal_one_does_not() -> None:
    changes = ("filter.structure=F4", "nodes_s=[5.0, 50.0]", "search.starts=3")
    s = solve(kit.case(*changes, "robust.rounds=20", name="ksr3-robust"))
    assert s.feasible
    assert s.certificate.worst_found_db < 0.05
    assert s.certificate.plants > 6
    nominal = solve(kit.case(*changes[:2], "search.starts=3", "loop=sampled"))
    robust_plants = [c for c in s.constraints if c.dispersed]
    assert len(robust_plants) > 0
    assert nominal.objective_db < 0.0
