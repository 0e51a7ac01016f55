"""An independent search confirms the shipped design petrel-robust of an unstable vehicle.

| claim | expected |
|---|---|
| corners of its case's ranges, by another search, at and between operating points | its stated least distance from -1 |
| vehicles within three sigma together, every deviation of a suite | farther than 0.5; the first gains: 0.4 |
| limits of the case in both planes | met |
"""

from __future__ import annotations

from pathlib import Path

import petrelkit as petrel
import pytest

import maxq
from maxq.design.case.schema import read_case
from maxq.design.model.spread import Spread, campaign_of
from maxq.design.verify.judging import Wanted, checks, judge
from maxq.design.verify.suite import WorstWanted
from maxq.design.verify.worst import search_node
from maxq.sim.scenario.schema_design import Design

STATED = (0.58, 0.71, 0.71)  # of each stage, in the design's own description
NODES_S = ((0.5, 111.0), (125.0, 130.0), (163.5, 400.0))


def shipped() -> Design:
    design = petrel.scenario("design='designs/petrel-robust.toml'").design
    assert design is not None
    return design


@pytest.mark.long
@pytest.mark.parametrize("stage", [0, 1, 2])
def test_no_worse_corner_is_found_of_the_ranges_it_was_made_for(
    stage: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "petrel").symlink_to(petrel.folder())
    monkeypatch.chdir(tmp_path)
    ranges, design = read_case("petrel-robust").case.robust, shipped()
    assert ranges is not None
    campaign, every = (campaign_of(spread, petrel.scenario()) for spread in (ranges, Spread()))
    corners = WorstWanted(region="box", sigmas=ranges.corner_sigmas, starts=2, seed=77)
    found = [search_node(node, design, campaign, corners)[0] for node in petrel.nodes(*NODES_S[stage])]
    assert min(found) == pytest.approx(STATED[stage], abs=0.02)
    within = [search_node(n, design, every, WorstWanted(starts=2, seed=77))[0] for n in petrel.nodes(*NODES_S[stage])]
    assert min(within) > 0.5


@pytest.mark.long
def test_the_first_gains_come_nearer() -> None:
    plain = petrel.scenario().design
    assert plain is not None
    (node,) = petrel.nodes(3.0)
    every = campaign_of(Spread(), petrel.scenario())
    nearest = [search_node(node, d, every, WorstWanted(starts=2, seed=77))[0] for d in (plain, shipped())]
    assert nearest[0] < 0.45
    assert nearest[1] > 0.55


@pytest.mark.long
def test_it_meets_its_limits_in_both_planes() -> None:
    design = shipped()
    for stage, times_s in enumerate(NODES_S):
        own = design.of_stage(stage)
        for plane in ("pitch", "yaw"):
            judged = judge(maxq.nodes(petrel.scenario(), times_s, plane=plane), own, "sampled")
            for check in checks(judged, own, Wanted.stated_by(design, stage)):
                slack = check.values[check.worst] - check.limit
                assert check.passed or abs(slack) < {"dB": 0.05, "deg": 0.3}.get(check.unit, 0.002), check.text
