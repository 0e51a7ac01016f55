"""A lost flight gives no operating points after the loss, in nodes, `simdesign` and measured margins."""

from __future__ import annotations

import contextlib
import io
import json
from pathlib import Path

import layoutkit
import pytest

import maxq
from maxq.design.model.node import nodes_along
from maxq.design.model.node_times import node_times
from maxq.design.model.powered import loss_of, loss_text, powered_flight, spans_of
from maxq.design.verify.judging import judge
from maxq.design.verify.suite import read_suite
from maxq.design.verify.verify import flight_of, flight_requirement
from maxq.sim.run.flight import Event
from maxq.sim.run.fly import fly
from maxq.sim.scenario.loader import load_scenario
from maxq.tools import simdesign


def test_spans_end_at_the_loss_that_the_flight_reports() -> None:
    scenario = layoutkit.lost_scenario()
    flight = fly(scenario, log=False)
    lost_s = flight.event_s("control_lost")
    assert 10.0 < lost_s < flight.event_s("burnout")
    (span,), loss = powered_flight(scenario)
    assert loss is not None
    assert (loss.name, loss.time_s) == ("control_lost", lost_s)
    assert span.end_s == lost_s
    times = node_times(scenario)
    assert len(times) == 11
    assert max(times) < lost_s
    assert loss_text(loss) == f"control lost at {lost_s:.3f} s"


@pytest.mark.parametrize("name", ["control_lost", "tumble", "diverged"])
def test_each_loss_ends_all_spans(name: str) -> None:
    """A loss during a burn ends its span; a loss before an ignition leaves only the spans of earlier stages."""
    flown = [
        Event("ignition", 0, 1),
        Event("liftoff", 0),
        Event("burnout", int(10e9), 1),
        Event("ignition", int(12e9), 2),
    ]
    for lost_s, ends in ((4.0, [4.0]), (11.0, [10.0]), (15.0, [10.0, 15.0])):
        loss = Event(name, int(lost_s * 1e9))
        assert [span.end_s for span in spans_of([loss, *flown], 2, 30.0)] == ends
        assert loss_of([*flown, loss]) == loss


def test_a_node_after_the_loss_is_refused() -> None:
    scenario = layoutkit.lost_scenario()
    loss = powered_flight(scenario)[1]
    assert loss is not None
    assert nodes_along(scenario, [loss.time_s - 1.0])[0].time_s == pytest.approx(loss.time_s - 1.0, abs=1e-3)
    lost = rf"the flight is lost before \({loss_text(loss)}\); allowed are times before the loss"
    said = rf"^operating point at 24 s: {lost}$"
    for take in (nodes_along, lambda s, t: maxq.multiloops(s, s.design, t)):
        with pytest.raises(ValueError, match=said):
            take(scenario, [10.0, 24.0])


# limits that are met with some margin: 4 dB and 20 deg are at the edge of what the law can do, where a short search
# finds a design or none by its seed
LIMITS = (
    "limits.gain_margin_db=3.0",
    "limits.phase_margin_deg=15",
    "limits.rigid_hz={time_s=[0.0, 5.0, 25.0], value=[0.3, 0.3, 1.2]}",
)
SHORT = ("search.starts=2", "search.leaps=0", "between_nodes=ignore", "nodes_per_stage=6")


@pytest.fixture(scope="module")
def designed(tmp_path_factory: pytest.TempPathFactory) -> tuple[int, Path, str]:
    """Return the exit code, folder and output of the case of a vehicle whose first flight is lost."""
    out, shown = tmp_path_factory.mktemp("designed"), io.StringIO()
    words = [str(layoutkit.lost() / "case.toml"), "--out", str(out), "--no-pictures"]
    with contextlib.redirect_stdout(shown):
        code = simdesign.main([*words, *(x for change in (*LIMITS, *SHORT) for x in ("--set", change))])
    return code, out, shown.getvalue()


@pytest.mark.long
def test_a_case_is_designed_along_the_flight_of_its_own_design(designed: tuple[int, Path, str]) -> None:
    """The points extend to burnout although the first flight does not, and every limit holds along them."""
    code, out, text = designed
    assert code == 0, text
    loss = powered_flight(layoutkit.lost_scenario())[1]
    assert loss is not None
    rounds = [line.strip() for line in text.splitlines() if line.startswith("  round ")]
    assert f"the scenario's flight, which is lost ({loss_text(loss)})" in rounds[0]
    assert rounds[-1].endswith("its own flight agrees")
    own = load_scenario(layoutkit.lost() / "scenario.toml", [f'design="{out.as_posix()}/design.toml"'])
    assert fly(own, log=False).failures == ()
    times = json.loads((out / "design.json").read_text())["nodes"]
    assert max(node["time_s"] for node in times) > loss.time_s + 4.0
    assert own.design is not None
    judged = judge(nodes_along(own, [node["time_s"] for node in times]), own.design)
    assert min(j.gain_margin_db for j in judged) > 3.0 - 5e-4
    assert min(j.margins.phase_deg.value for j in judged) > 15.0 - 5e-4


def test_an_analysis_of_a_lost_flight_says_so(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    scenario, design = layoutkit.lost() / "scenario.toml", layoutkit.lost() / "design.toml"
    loss = powered_flight(layoutkit.lost_scenario())[1]
    assert loss is not None
    words = ["analyse", str(design), "--scenario", str(scenario), "--no-pictures"]
    assert simdesign.main([*words, "--out", str(tmp_path)]) == 1
    lines = capsys.readouterr().out.splitlines()
    assert lines[3] == f"the flight is lost: {loss_text(loss)}; no operating point is after that"
    assert lines[-1].startswith(f"FAILED: {loss_text(loss)}")
    told = json.loads((tmp_path / "analysis.json").read_text())
    assert (told["passed"], told["lost"]) == (False, loss_text(loss))
    assert max(node["time_s"] for node in told["nodes"]) < loss.time_s
    assert simdesign.main([*words, "--at", "24"]) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    assert "operating point at 24 s: the flight is lost before" in said


@pytest.mark.long
def test_a_verification_takes_its_nodes_from_the_flight_of_the_design(designed: tuple[int, Path, str]) -> None:
    """The suite's scenario is lost, so the operating points are on the flight of the judged design."""
    suite = read_suite(layoutkit.lost() / "suite.toml").suite
    along = flight_of(suite, (designed[1] / "design.toml").as_posix(), None)
    assert powered_flight(along)[1] is None
    assert flight_requirement(along) == []


@pytest.mark.slow
def test_a_verification_takes_no_nodes_from_a_lost_flight() -> None:
    suite = read_suite(layoutkit.lost() / "suite.toml").suite
    bad = (layoutkit.lost() / "design.toml").as_posix()
    (rejected,) = flight_requirement(flight_of(suite, bad, None))
    assert (rejected.judgement, rejected.name) == ("rejected", "flight of the operating points")
    assert rejected.found.startswith("control lost at ")
