"""Every stage of petrel has operating points from its flight, loops and held flights."""

from __future__ import annotations

import json
from itertools import pairwise
from pathlib import Path

import numpy as np
import petrelkit as petrel
import pytest
from scipy.interpolate import PchipInterpolator

import maxq
from maxq import margins
from maxq.design.case.schema import read_case
from maxq.design.certificate import held_flight
from maxq.design.certificate.certificate import MarginRow, certify_node
from maxq.design.certificate.held_flight import hold
from maxq.design.certificate.measured_margins import alter, altered, build_up_rate, burst_test, measured_growth
from maxq.design.certificate.response import BANDS
from maxq.design.laws.design_file import design_text
from maxq.design.model.node import at_same_propellant_s, node_of, nodes_along
from maxq.design.model.node_times import node_times
from maxq.design.model.powered import Span, flown_run, flown_to, powered_spans, spans_of
from maxq.design.optimise.pareto import aims_of, trade_off
from maxq.design.optimise.solve import each_stage, nominal_plants, solve
from maxq.design.verify.outcome import judge_solution, make_design
from maxq.design.verify.suite import read_suite
from maxq.sim.packing.flight import Packed
from maxq.sim.run.flight import Event
from maxq.sim.scenario.loader import load_scenario
from maxq.sim.vehicle.engine.burn import stage_burns
from maxq.tools import simdesign
from maxq.tools.design import run_case
from maxq.tools.design.trade import StageTrade, trade_table, write_trade


@pytest.fixture(scope="module")
def spans() -> tuple[Span, ...]:
    return powered_spans(petrel.scenario())


@pytest.mark.slow
def test_spans_and_nodes_lie_under_full_thrust_of_every_stage(spans: tuple[Span, ...]) -> None:
    """Spans and operating points are under full thrust of every stage, by the thrust tables on each stage's clock."""
    stages = petrel.scenario().vehicle.stage
    burns = stage_burns(stages, petrel.scenario().scenario.fault)
    assert [span.stage for span in spans] == list(range(len(stages)))
    assert all(a.end_s <= b.begin_s for a, b in pairwise(spans))  # and coast in none
    times = np.array(node_times(petrel.scenario(), 5))
    assert len(times) == 5 * len(stages)
    for span, mine in zip(spans, times.reshape(-1, 5), strict=True):
        table = stages[span.stage].engines[0].table
        thrust = np.interp(mine - burns[span.stage].start_s, table["time_s"], table["thrust_vacuum_N"])
        assert (thrust >= 0.5 * table["thrust_vacuum_N"].max()).all()
        assert span.begin_s < mine[0]
        assert mine[-1] < span.end_s
        assert mine[-1] - mine[0] > 0.8 * (span.end_s - span.begin_s)


def test_spans_begin_off_the_pad_and_need_thrust() -> None:
    events = [
        Event("ignition", 0, 1),
        Event("liftoff", 2 * 10**9),
        Event("burnout", 9 * 10**9, 1),
        Event("separation", 10 * 10**9, 1),
        Event("ignition", 12 * 10**9, 2),
    ]
    assert spans_of(events, 2, 20.0) == (Span(0, 2.0, 9.0), Span(1, 12.0, 20.0))
    assert spans_of(events[:1], 2, 20.0) == (Span(0, 0.0, 20.0),)
    assert spans_of([], 1, 5.0) == ()
    # what still burns at the separation continues without an ignition, what has burnt out does not
    assert spans_of([events[0], events[3]], 2, 20.0) == (Span(0, 0.0, 10.0), Span(1, 10.0, 20.0))
    assert spans_of([events[0], *events[2:4]], 2, 20.0) == (Span(0, 0.0, 9.0),)


def test_nodes_in_the_coast_are_refused_with_the_times_under_thrust(spans: tuple[Span, ...]) -> None:
    coast = 0.5 * (spans[0].end_s + spans[1].begin_s)
    with pytest.raises(ValueError, match="the engine does not burn; allowed are times under thrust: liftoff to") as e:
        nodes_along(petrel.scenario(), [coast])
    assert str(e.value).count("allowed") == 1
    assert f"{spans[1].begin_s:.6g} s to" in str(e.value)


def test_held_flight_of_a_later_stage_is_that_stage_frozen(spans: tuple[Span, ...]) -> None:
    """Mass and CG are those of the stage's table; the loop equals the flown one except for gravity (slowest root)."""
    time_s = round(0.4 * spans[1].begin_s + 0.6 * spans[1].end_s, 3)
    (node,) = petrel.nodes(time_s)
    assert node.stage == 1
    held = hold(petrel.scenario(), node)
    table = petrel.scenario().vehicle.stage[1].mass.table
    assert table is not None
    clock = time_s - stage_burns(petrel.scenario().vehicle.stage, petrel.scenario().scenario.fault)[1].start_s
    mass, cg = (float(PchipInterpolator(table["time_s"], table[key])(clock)) for key in ("mass_kg", "x_cg_m"))
    for mine in (node.vehicle, held.node.vehicle):
        assert mine.total_mass_kg == pytest.approx(mass, rel=1e-12)
        assert mine.total_cg_station_m == pytest.approx(cg, rel=1e-6)
    design = petrel.scenario().design
    assert design is not None
    flown, stood = (loop.response([0.3, 1.0, 7.0, 20.0]) for loop in maxq.loops([node, held.node], design))
    assert stood == pytest.approx(flown, rel=1e-3)


@pytest.mark.slow
def test_loops_in_thin_air_are_stable_by_encirclements_as_by_poles(spans: tuple[Span, ...]) -> None:
    """In thin air, path and attitude have open-loop roots of hours; curves that began among them counted wrongly."""
    last = spans[-1]
    nodes = petrel.nodes(*(round(last.begin_s + x * (last.end_s - last.begin_s), 3) for x in (0.05, 0.35, 0.65, 0.95)))
    assert nodes[1].condition.dynamic_pressure_Pa < 1.0
    design = petrel.scenario().design
    assert design is not None
    for loop in maxq.loops(nodes, design):
        found, slow = margins(loop), np.abs(loop.closed_poles()) < 1e-4
        assert (loop.closed_poles()[~slow].real < 0.0).all()
        assert found.stable
        assert found.encircled_poles == found.unstable_poles == 0


@pytest.mark.slow
def test_certificate_of_a_later_stage_agrees(spans: tuple[Span, ...]) -> None:
    """The gain margin of the second stage in the nonlinear simulator equals the linear loop's."""
    (node,) = petrel.nodes(round(0.5 * (spans[1].begin_s + spans[1].end_s), 3))
    found = certify_node(petrel.scenario(), node, bands=(), names=("gain_up",))
    assert found.stable
    assert found.unexplained == ()
    assert abs(found.margins[0].difference) < 0.2


@pytest.mark.slow
def test_a_sine_of_a_hundredth_of_a_hertz_neither_grows_nor_decays_on_its_boundary() -> None:
    """In thin air, under the dither of the gimbal output, the tones contribute less than the burst at 0.014 Hz."""
    (node,) = petrel.nodes(125.6)
    held, design = hold(petrel.scenario(), node), petrel.scenario().design
    assert design is not None
    loop = maxq.loops([held.node], design)[0]
    bound = margins(loop).gain_down_db
    assert bound.frequency_hz < 0.02
    test = burst_test(bound.frequency_hz, build_up_rate(altered(loop, "gain_down", bound.value), bound.frequency_hz))
    growth = measured_growth(held, loop, test, lambda packed: alter(packed, held, "gain_down", bound.value))
    assert abs(growth) < 3e-3  # 1/s: 0.03 dB, at 0.1 1/s a dB


CASE = """
schema = 2
scenario = "scenario.toml"
nodes_per_stage = 2
between_nodes = "ignore"
gains = {schedule = "linear"}
objective = {kind = "least-margin"}
filter = {structure = "F2"}
limits = {rigid_body = "aerodynamic", rigid_hz = 0.3, rigid_zeta = 0.5, without = ["second_mode_db"]}
search = {starts = 1, leaps = 0}
[[stage]]
[[stage]]
limits = {rigid_hz = 0.25}
"""


@pytest.fixture(scope="module")
def case():
    path = petrel.folder() / "two-nodes.toml"
    path.write_text(CASE)
    return read_case(path)


@pytest.mark.slow
def test_a_case_is_a_case_of_each_stage(case, spans: tuple[Span, ...]) -> None:
    found = [loaded.case for loaded in each_stage(case)]
    assert len(found) == len(spans)
    for one, span in zip(found, spans, strict=True):
        assert len(one.times_s) == 2
        assert all(span.holds(t) for t in one.times_s)
    assert [one.limits.rigid_hz for one in found[:2]] == [0.3, 0.25]
    assert found[1].limits.rigid_zeta == 0.5  # what is not said stays
    assert found[1].limits.rigid_body == "aerodynamic"
    second = read_case(petrel.folder() / "two-nodes.toml", ["stages=[2]"])
    assert [loaded.case.times_s for loaded in each_stage(second)] == [found[1].times_s]
    with pytest.raises(ValueError, match=r"stages = \[9\]|stages = \[8\]"):
        each_stage(read_case(petrel.folder() / "two-nodes.toml", ["stages=[8]"]))


@pytest.mark.long
def test_the_trade_off_of_a_stage_keeps_the_others(case, tmp_path: Path) -> None:
    """Every design of the curve of stage 2 has stage 1 as optimised, and the table is that of the points."""
    one, two, _ = each_stage(case)
    aims, plants = aims_of("peak,margin"), nominal_plants(two)
    first, points = solve(one), trade_off(two, plants, aims, count=3)
    trade = StageTrade(points, aims, 2, (first,))
    files = write_trade(tmp_path, case, trade)
    assert [file.relative_to(tmp_path).as_posix() for file in files] == [
        *(f"pareto-stage-2-{n:02d}/design.toml" for n in range(1, len(points) + 1)),
        "pareto-stage-2.json",
    ]
    record = json.loads(files[-1].read_text())
    assert record["stage"] == 2
    for file, point, kept in zip(files, points, record["points"], strict=False):
        design = petrel.scenario(f'design="{file}"').design
        assert design is not None
        expected = make_design(case, point.solution, first)
        for n in range(2):
            mine, wanted = design.of_stage(n).gains.table, expected.of_stage(n).gains.table
            assert all((mine[key] == wanted[key]).all() for key in ("time_s", "k_p", "k_d_s"))
        least = min(margins(loop).modulus for loop in maxq.loops(point.solution.nodes, design))
        assert kept["values"][1] == pytest.approx(least, rel=1e-4)
    assert f"pareto{trade.suffix}-01" in "".join(trade_table(trade))


@pytest.mark.slow
def test_a_design_of_one_stage_leaves_the_others_as_they_were(case) -> None:
    (second,) = each_stage(read_case(petrel.folder() / "two-nodes.toml", ["stages=[2]"]))
    solution = solve(second)
    design, own = make_design(second, solution), petrel.scenario().design
    assert own is not None
    assert solution.feasible
    assert [law.filter for law in design.stage][::2] == [own.of_stage(0).filter, own.of_stage(2).filter]
    assert design.of_stage(1).filter != own.of_stage(1).filter
    assert design.of_stage(1).gains.table["time_s"].tolist() == list(second.case.times_s)
    outcome = judge_solution(second, solution, design)
    assert outcome.feasible
    path = petrel.folder() / "made.toml"
    path.write_text(design_text(design))
    again = petrel.scenario(f'design="{path}"').design
    assert again is not None
    assert again.model_dump(exclude={"gains", "stage"}) == design.model_dump(exclude={"gains", "stage"})
    for n in range(3):
        mine, read = design.of_stage(n).gains.table, again.of_stage(n).gains.table
        assert all((mine[key] == read[key]).all() for key in ("time_s", "k_p", "k_d_s"))
        assert design.of_stage(n).filter == again.of_stage(n).filter


@pytest.mark.long
def test_orders_of_several_stages(
    case, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Each stage is designed alone and all together; the report shows the gains of each stage."""
    monkeypatch.setattr(run_case, "STRUCTURES", ("F2",))
    words = [str(petrel.folder() / "two-nodes.toml"), "--orders", "--no-pictures", "--out", str(tmp_path)]
    assert simdesign.main([*words, "--set", "stages=[2,3]", "--set", "stage=[]"]) == 0
    text = capsys.readouterr().out
    made = maxq.load_design(tmp_path / "design.toml", petrel.scenario())
    for n, part in zip((1, 2), text.split("--- ")[1:], strict=True):
        rows = made.of_stage(n).gains.table
        shown = part.split("gains\n")[1].split("\n")[1:3]
        expected = zip(rows["time_s"], rows["k_p"], rows["k_d_s"], strict=True)
        assert [line.split() for line in shown] == [[f"{t:g}", f"{k_p:.4f}", f"{k_d:.4f}"] for t, k_p, k_d in expected]
        assert "over the filter's order, dB" in part
    for schedule in ("linear", "free"):
        each = maxq.load_design(tmp_path / f"F2-{schedule}" / "design.toml", petrel.scenario())
        assert [law.filter.structure for law in each.stage[1:]] == ["F2", "F2"]
        assert each.stage[0].filter == petrel.scenario().design.of_stage(0).filter
    stages = json.loads((tmp_path / "design.json").read_text())["stages"]
    assert [len(stage["orders"]) for stage in stages] == [3, 3]


def test_a_suite_finds_its_scenario_beside_itself() -> None:
    """The scenario next to the suite is found from another folder; other names are looked up as usual."""
    suite = read_suite(petrel.folder() / "suite.toml").suite
    assert load_scenario(suite.scenario).vehicle.name == "petrel"
    assert read_suite("standard").suite.scenario == "nominal"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("time_s", "slowest_hz"),
    [*(pytest.param(*at, marks=pytest.mark.long) for at in ((40.0, 0.04), (126.0, 0.004))), (240.0, 0.0)],
)
def test_gain_that_slow_roots_need_is_found_in_flight(time_s: float, slowest_hz: float) -> None:
    """The gain is found for a fast unstable body in dense air, a slow oscillation in thin air, a drift in none.

    With the centre of pressure a tenth of the CG station farther forward in flight, the first is not the loop's.
    """
    node = petrel.nodes(time_s)[0]

    def farther(packed: Packed) -> None:
        packed.parameters[0].vehicle.aero.centre_shift_m -= 0.1 * node.vehicle.total_cg_station_m

    def gain_down(fault=None) -> MarginRow:
        return certify_node(petrel.scenario(), node, fault=fault, bands=(), names=("gain_down",)).margins[0]

    sound = gain_down()
    assert sound.agrees
    assert slowest_hz < sound.frequency_hz < 0.12
    if slowest_hz > 0.0:
        assert abs(sound.difference) < 0.1
    else:
        assert sound.reason == "grows too slowly to be seen"
    if slowest_hz > 0.01:
        assert not gain_down(farther).agrees


@pytest.mark.long
def test_a_mode_that_aliases_is_held_with_a_finer_step(monkeypatch: pytest.MonkeyPatch) -> None:
    """Late in the burn, mode 4 (79 Hz) appears at 21 Hz, where the integrator's detuning, (w h)^4 / 120, is visible."""
    (node,) = petrel.nodes(118.0)
    modes = node.vehicle
    highest, zeta = float(modes.omega_radps.max()), float(modes.damping_ratio.min())
    assert abs(100.0 - highest / (2.0 * np.pi)) == pytest.approx(20.6, abs=0.5)

    def detuned() -> float:
        held = hold(petrel.scenario(), node)
        step_s = held.loaded.scenario.run.step_s
        root = 1j * highest * step_s
        factor = 1.0 + root + root**2 / 2.0 + root**3 / 6.0 + root**4 / 24.0  # of the classical Runge-Kutta method
        return float(1.0 - np.angle(factor) / abs(root)) / zeta

    assert detuned() < 0.02
    sound = certify_node(petrel.scenario(), node, names=())
    assert sound.unexplained == ()
    monkeypatch.setattr(held_flight, "DETUNED", 1.0)
    assert detuned() > 0.09
    coarse = certify_node(petrel.scenario(), node, bands=BANDS[2:], names=())
    assert any(" at 20.6" in said for said in coarse.unexplained)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("stage", "changes"),
    [
        (0, [f"vehicle.stage.0.engine.{k}.mass_flow_factor={1.06 if k < 3 else 1.0}" for k in range(9)]),
        (1, ["vehicle.stage.1.engine.mass_flow_factor=0.97"]),
    ],
)
def test_a_node_is_met_with_its_propellant(stage: int, changes: list[str]) -> None:
    """For unlike engines under throttle and for a slow burn, the mass is that of the operating point.

    The tolerance is one step of the flight, with a mass flow of under 1 % of the mass per second.
    """
    base = petrel.scenario()
    time_s = (60.0, 150.0)[stage]
    (node,) = petrel.nodes(time_s)
    assert node.stage == stage
    run = flown_run(petrel.scenario(*changes), faults=False)
    at_s = at_same_propellant_s(run, base.scenario, node)
    assert abs(at_s - time_s) > 0.5
    met = node_of(run.packed, flown_to(run, at_s) / 1e9, stage)
    step_s = 1e-9 * float(run.packed.parameters[0].timeline.step_ns)
    assert met.vehicle.total_mass_kg == pytest.approx(node.vehicle.total_mass_kg, rel=0.01 * step_s)
