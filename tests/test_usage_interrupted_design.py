"""An interrupted `simdesign CASE` of several stages or of dispersed vehicles claims only what it checked."""

from __future__ import annotations

import json
import math
import re
import tomllib
from collections.abc import Callable
from pathlib import Path

import optimise_kit as kit
import petrelkit as petrel
import pytest

import maxq
from maxq.design.case.schema import read_case
from maxq.design.verify.judging import judge
from maxq.design.verify.own_flight import design_case, with_design
from maxq.tools import simdesign
from maxq.tools.design import run_case

STAGES = """
schema = 2
scenario = "scenario.toml"
nodes_s = [40.0, 42.0, 140.0, 142.0, 165.0, 167.0]
gains = {schedule = "linear"}
objective = {kind = "least-margin"}
filter = {structure = "F2"}
limits = {rigid_body = "aerodynamic", rigid_hz = 0.3, rigid_zeta = 0.5, without = ["second_mode_db"]}
search = {starts = 2, leaps = 0}
"""
Stop = Callable[[int, str, int], bool]
"""Asked with stage, from 0, what is searched, and the number of calls about it."""


def interrupted(loaded, stop: Stop):
    """Return the design of a case that is interrupted where `stop` raises."""
    calls: list[tuple[int, str]] = []

    def progress(stage: int, number: int):
        def show(done: int, of: int, best_db: float, what: str) -> None:
            calls.append((stage, what))
            if stop(stage, what, calls.count((stage, what))):
                raise KeyboardInterrupt

        return show

    return design_case(loaded, progress)


SAID = (
    "it meets all limits at its 7 operating points; the instants between them were not checked; "
    "not designed: stage 3 (second, fairing off), which flies as in the scenario's own design"
)


@pytest.mark.long
def test_stages_that_were_not_designed_are_named(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """The design of petrel's three stages, interrupted in the second, names the stages without a design.

    The first stage meets its limits between its operating points; the second was not checked there; both meet them at
    their points. This is a single test, because the design takes a minute.
    """
    path = petrel.folder() / "interrupted.toml"
    path.write_text(STAGES)
    made = interrupted(read_case(path), lambda stage, what, calls: stage == 1)
    assert (made.interrupted, made.feasible, made.not_designed) == (True, False, (2,))
    assert made.claim == SAID
    assert [solution.certificate.instants for _, solution in made.results] == [9, 0]
    assert [solution.status for _, solution in made.results] == ["optimal", "interrupted"]
    own = petrel.scenario().design
    assert own is not None
    assert made.design.of_stage(2).filter == own.of_stage(2).filter
    assert made.design.of_stage(1).filter != own.of_stage(1).filter
    along = with_design(petrel.scenario(), made.design)
    found = judge(maxq.nodes(along, [40.0, 42.0, 140.0, 142.0]), made.design)
    assert min(j.gain_margin_db for j in found) > 6.0 - 5e-4
    assert min(j.margins.phase_deg.value for j in found) > 30.0 - 5e-4

    monkeypatch.setattr(run_case, "design_case", lambda *_: made)
    words = [str(path), "--no-pictures", "--out", str(tmp_path)]
    assert simdesign.main(words) == 130
    assert capsys.readouterr().out.splitlines()[-1] == f"INTERRUPTED: the best so far is kept; {SAID}"
    text = (tmp_path / "design.toml").read_text()
    head = [line for line in text.splitlines() if line.startswith("#")]
    assert f"# INTERRUPTED: the best so far; {SAID}." in head
    between = "between the operating points, where no limit was checked"
    assert f"# not covered: stage 2 (second), 140 to 142 s: {between}" in head
    # the fairing leaves at 163.34 or 163.35 s: the ascent of the layout is found by a search
    last = r"# not covered: stage 3 \(second, fairing off\), 163\.[34] to 465 s: under thrust, no operating point"
    assert re.fullmatch(last, head[-1])
    assert "# All limits met" not in text
    told = json.loads((tmp_path / "design.json").read_text())
    assert (told["feasible"], told["not_designed"]) == (False, [3])
    assert [stage["feasible"] for stage in told["stages"]] == [True, False]
    written = tomllib.loads(text)
    first, second = written["description"].split(". ")
    assert first.endswith("all limits met")
    assert second.endswith("limits met at the operating points; the instants between them were not checked")
    rows = own.of_stage(2).gains.table["k_p"].tolist()
    assert [row["k_p"] for row in written["stage"][2]["gains"]["table"]] == rows


FEW = [
    f"robust.{name}=0.0"
    for name in (
        "slosh_frequency",
        "slosh_mass",
        "slosh_damping",
        "actuator_frequency",
        "thrust",
        "normal_force",
        "centre_of_pressure_m",
        "inertia",
    )
]
ROBUST = (
    "nodes_s=[45.0, 47.0]",
    "filter.structure=F2",
    "search.starts=1",
    "search.leaps=0",
    "between_nodes='hold'",
    *FEW,
)


@pytest.mark.long
def test_a_robust_design_names_what_was_not_searched() -> None:
    """The message is right before the first search of worst vehicles, and after one that added vehicles."""
    loaded = kit.case(*ROBUST, name="ksr3-robust")
    searches = {
        "worst plants, round 1": lambda stage, what, calls: what == "worst plants, round 1",
        "worst plants, round 2": lambda stage, what, calls: what == "worst plants, round 2",
    }
    for what, stop in searches.items():
        made = interrupted(loaded, stop)
        ((_, solution),) = made.results
        assert made.claim.endswith(
            "; the instants between them were not checked; the worst dispersed vehicles were not searched"
        ), what
        assert (solution.status, made.feasible) == ("interrupted", False)
        assert math.isnan(solution.certificate.worst_found_db)
        assert (solution.certificate.searched > 0) == what.endswith("2")
    whole = design_case(loaded)
    ((_, solution),) = whole.results
    assert not solution.unchecked
    assert solution.certificate.worst_found_db <= 0.01
    assert solution.certificate.instants >= 5
    times_s = [node.time_s for node in solution.nodes]
    assert times_s == sorted(times_s)
