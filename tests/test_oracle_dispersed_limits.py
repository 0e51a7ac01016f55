"""The limits of dispersed vehicles in `simdesign analyse` agree with sampling, exhaustive search and single loops."""

from __future__ import annotations

import json
from functools import cache
from itertools import product
from pathlib import Path
from typing import Any

import design_nodes
import numpy as np
import pytest

import maxq
from maxq import LoadedCampaign, Loop, Node
from maxq.design.case.basis import Basis, DispersedLimits, Robust, stated_basis
from maxq.design.loop.fixed_path import fixed_path
from maxq.design.loop.loop import law_at
from maxq.design.margins.measured_loop import measure_loop
from maxq.design.model.deviations import deviations_of
from maxq.design.model.node import disperse
from maxq.design.model.spread import campaign_of
from maxq.design.optimise.descent import Region, to_corner
from maxq.design.quantities import MEASURED, Convention
from maxq.design.verify.dispersed_limits import guides, rooms, worst_of_basis
from maxq.sim.input.files import builtin_files
from maxq.sim.scenario.loader import load_scenario
from maxq.tools import simdesign

NONE = dict.fromkeys(
    (
        "bending_slope",
        "slosh_mass",
        "slosh_damping",
        "actuator_frequency",
        "normal_force",
        "inertia",
        "thrust",
        "centre_of_pressure_m",
    ),
    0.0,
)
FEW = Robust(bending_frequency=(0.08,), slosh_frequency=0.1, delay_s=0.004, corner_sigmas=3.0, **NONE)
"""Of modes and tanks, and the delay."""


@cache
def few() -> LoadedCampaign:
    return campaign_of(FEW, design_nodes.nominal())


def single(node: Node, u: np.ndarray) -> dict[str, float]:
    """Return the quantities of a vehicle of `FEW` measured alone; empty where it is unstable."""
    vehicle = disperse(node, deviations_of(few(), node).at(u))
    found = measure_loop(Loop(fixed_path(vehicle), law_at(design_nodes.design(), vehicle)))
    return found.quantities(Convention()) if found.margins.stable else {}


def left(found: dict[str, float], wanted: dict[str, float]) -> float:
    """Return the least remaining share of a limit; -1 for an unstable loop."""
    signs = {key: 1.0 if MEASURED[key].sense == ">=" else -1.0 for key in wanted}
    each = [signs[key] * (found[key] - limit) / abs(limit) for key, limit in wanted.items()] if found else [-1.0]
    return float(np.clip(min(each), -1.0, 10.0))


def test_limits_of_a_design_as_those_of_the_sweep() -> None:
    limits = DispersedLimits(gain_margin_db=3.0, phase_margin_deg=15.0, second_mode_db=-3.0, modes_from_3_db=-4.0)
    assert guides(limits) == {
        "gain_up_db": 3.0, "gain_down_db": 3.0, "rigid_phase_deg": 15.0, "first_mode_phase_deg": 15.0,
        "modes_from_2_db": -4.0,
    }  # fmt: skip  # a table
    assert "modes_from_2_db" not in guides(limits.model_copy(update={"modes_from_3_db": None, "second_mode_db": None}))


def test_what_is_searched_is_what_single_loops_have() -> None:
    node, wanted = design_nodes.flown()[6], guides(DispersedLimits())
    rng = np.random.default_rng(7)
    every = list(rng.uniform(-9.0, 9.0, (12, len(deviations_of(few(), node).places))))
    found = rooms(node, design_nodes.design(), few(), wanted)(every)
    expected = [left(single(node, u), wanted) for u in every]
    assert min(expected) == -1.0, "some are unstable"
    assert max(expected) > 0.1
    np.testing.assert_allclose(found, expected, atol=1e-5)


def test_no_corner_and_no_random_vehicle_is_worse() -> None:
    """No corner of the box and none of 400 vehicles inside is worse.

    The descent leaves the corner where a mode is worst between the ends.
    """
    node, wanted = design_nodes.flown()[6], guides(DispersedLimits())
    look = rooms(node, design_nodes.design(), few(), wanted)
    count = len(deviations_of(few(), node).places)
    corners = look([np.array(ends) for ends in product((-1.0, 1.0), repeat=count)])
    inside = look(list(np.random.default_rng(8).uniform(-1.0, 1.0, (400, count))))
    found = worst_of_basis([node], [], design_nodes.design(), FEW, few())
    (worst,) = found.nodes
    value = left(measure(worst), wanted)
    assert value <= min(*corners, *inside) + 1e-6
    assert found.loops < 0.7 * 2**count + 1500
    assert found.instants == 0


def measure(node: Node) -> dict[str, float]:
    """Return the quantities of the loop of an operating point."""
    return measure_loop(Loop(fixed_path(node), law_at(design_nodes.design(), node))).quantities(Convention())


def test_the_corner_of_a_known_function() -> None:
    """For separable steps the worst corner is the sum of all signs; its value is counted by hand."""
    weights = np.array([3.0, -1.0, 2.0, 0.5])
    u, value = to_corner(lambda every: [float(x @ weights) for x in every], np.zeros(4), Region("box", 0.5))
    assert u.tolist() == [-0.5, 0.5, -0.5, -0.5]
    assert value == -0.5 * 6.5
    known = {(1, 1): 0.0, (-1, 1): -1.0, (1, -1): -2.0, (-1, -1): 5.0}  # each flip lowers it, both together raise it
    u, value = to_corner(
        lambda every: [known[int(np.sign(x[0])), int(np.sign(x[1]))] for x in every], np.zeros(2), Region("box", 0.5)
    )
    assert (u.tolist(), value) == ([0.5, -0.5], -2.0)
    u, value = to_corner(lambda every: [1.0] * len(every), np.zeros(0), Region("box", 0.5))
    assert (len(u), value) == (0, 1.0)


def analysed(
    capsys: pytest.CaptureFixture[str], changes: dict[str, str], *words: str
) -> tuple[int, str, dict[str, Any]]:
    """Analyse ksr3-robust-ascent with changes of its text at few points; return exit code, report and record."""
    text = builtin_files("design")["ksr3-robust-ascent"].read_text()
    for old, new in changes.items():
        head, found, tail = text.rpartition(old)
        assert found
        text = head + new + tail
    Path("mine.toml").write_text(text)
    code = simdesign.main(["analyse", "mine.toml", "--no-pictures", "--out", "out", *words])
    return code, capsys.readouterr().out, json.loads(Path("out/analysis.json").read_text())


FEW_POINTS = {"nodes_s = [0.3, 5.0, 10.0, 20.0, 30.0, 35.0, 40.0, 45.0, 50.0, 55.0, 58.0]": "nodes_s = [44.0, 45.0]"}


@pytest.mark.slow
def test_analyse_judges_the_dispersed_vehicles(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The values are those of single loops; a limit missed by the worst vehicle fails the design."""
    monkeypatch.chdir(tmp_path)
    code, said, record = analysed(capsys, FEW_POINTS)
    found = {c["key"]: c for c in record["limits"] if c["key"].startswith("dispersed")}
    assert code == 0
    keys = ("unstable_poles", "gain_margin_db", "phase_margin_deg", "second_mode_db")
    assert [*found] == [f"dispersed_{key}" for key in keys]
    assert "also for the worst dispersed vehicles found" in said
    extent = f"the worst of each point in a search of {record['dispersed'][0]['loops']} loops for stability, "
    assert f"limits of dispersed vehicles: {extent}" in said
    gain_db = found["dispersed_gain_margin_db"]["worst"]
    assert 3.0 < gain_db < 5.0, "nominal: 6.05"

    limit = {"gain_margin_db = 3.0": f"gain_margin_db = {gain_db + 0.1:.3f}"}
    code, said, record = analysed(capsys, FEW_POINTS | limit | {'between_nodes = "ignore"': 'between_nodes = "hold"'})
    assert code == 1
    assert said.rstrip().endswith("FAILED: gain margin, dispersed missed")
    assert record["dispersed"][0]["instants"] == 3
    again = next(c for c in record["limits"] if c["key"] == "dispersed_gain_margin_db")
    assert again["worst"] <= gain_db + 1e-9
    assert "the worst of each point and 3 instants between in a search of " in said

    _, said, record = analysed(capsys, FEW_POINTS, "--kind", "pade")
    assert "for the nominal vehicle only" in said
    assert record["dispersed"] == []


@pytest.mark.long
def test_vehicles_of_a_shipped_basis_are_the_worst_of_2000() -> None:
    """At two operating points, no corner of 1,000 and no vehicle of 1,000 inside the box is worse."""
    scenario = load_scenario("nominal", ["design='designs/ksr3-robust-ascent.toml'"])
    assert scenario.design is not None
    basis: Basis | None = stated_basis(scenario.design)
    assert basis is not None
    assert basis.robust is not None
    wanted, rng = guides(basis.robust.limits), np.random.default_rng(9)
    nodes = maxq.nodes(scenario, [10.0, 45.0])
    campaign = campaign_of(basis.robust, scenario)
    found = worst_of_basis(nodes, [], scenario.design, basis.robust, campaign)
    for node, worst in zip(nodes, found.nodes, strict=True):
        count, reach = len(deviations_of(campaign, node).places), basis.robust.corner_sigmas / 3.0
        every = [*rng.choice([-reach, reach], (1000, count)), *rng.uniform(-reach, reach, (1000, count))]
        lowest = min(rooms(node, scenario.design, campaign, wanted)(every))
        loop = measure_loop(Loop(fixed_path(worst), law_at(scenario.design, worst)))
        value = left(loop.quantities(Convention()), wanted)
        assert value < lowest
        assert 0.0 < value < 1.0
