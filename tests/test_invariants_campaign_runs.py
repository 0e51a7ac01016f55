"""Serial, parallel, resumed, extended and repeated runs are bit-identical, and records are of flown values."""

from __future__ import annotations

import os
import shutil
from dataclasses import replace
from pathlib import Path

import campaignkit
import numpy as np
import pyarrow.parquet as pq
import pytest

import maxq
from maxq import LoadedCampaign
from maxq.sim.campaign import runner
from maxq.sim.campaign.analysis import DataSet, finer_runs, finer_text, summary_of, unfounded
from maxq.sim.campaign.error import CampaignError
from maxq.sim.campaign.investigation import refly
from maxq.sim.campaign.runner import run_campaign
from maxq.sim.campaign.runs import fly_rows, fly_scenario
from maxq.sim.campaign.schema import Envelope
from maxq.sim.campaign.store import open_store
from maxq.sim.flight.metric_table import METRIC_NAMES
from maxq.sim.run.fly import fly, with_half_step
from maxq.sim.scenario.loader import load_scenario_text
from maxq.tools.campaign_report import report


@pytest.fixture(scope="module")
def campaign(tmp_path_factory: pytest.TempPathFactory) -> LoadedCampaign:
    return campaignkit.small(tmp_path_factory.mktemp("file"))


@pytest.fixture(scope="module")
def serial(campaign: LoadedCampaign, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("serial") / "out"
    run_campaign(campaign, folder, workers=1)
    return folder


def test_parallel(campaign: LoadedCampaign, serial: Path, tmp_path: Path) -> None:
    run_campaign(campaign, tmp_path / "out", workers=4)
    assert campaignkit.same(campaignkit.data_set(tmp_path / "out"), campaignkit.data_set(serial))
    ours, theirs = (sorted((folder / "runs").iterdir()) for folder in (tmp_path / "out", serial))
    assert [p.name for p in ours] == [p.name for p in theirs]
    assert [p.read_bytes() for p in ours] == [p.read_bytes() for p in theirs]


@pytest.mark.parametrize("chunk", [1, 3])
def test_chunks_of_any_size(
    campaign: LoadedCampaign, serial: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, chunk: int
) -> None:
    """The other runs of a chunk change nothing in a run."""
    monkeypatch.setattr(runner, "CHUNK", chunk)
    run_campaign(campaign, tmp_path / "out", workers=1)
    assert campaignkit.same(campaignkit.data_set(tmp_path / "out"), campaignkit.data_set(serial))


def test_cancelled_within_a_chunk(campaign: LoadedCampaign) -> None:
    """After a cancellation, completed flights remain and the current flight is dropped."""
    asked = iter([False] * 3 + [True])
    rows = fly_rows(campaign, [(campaign.plan.draw(0, 8), run) for run in range(8)], lambda: next(asked))
    assert [row.run for row in rows] == [0, 1, 2]
    assert all(row.outcome == "duration" for row in rows)


def test_stopped_and_resumed(campaign: LoadedCampaign, serial: Path, tmp_path: Path) -> None:
    asked = [0]

    def stop() -> bool:
        asked[0] += 1
        return asked[0] > 5

    first = run_campaign(campaign, tmp_path / "out", workers=2, stop=stop)
    assert first.stopped
    assert 0 < len(campaignkit.data_set(tmp_path / "out")) < 20
    second = run_campaign(campaign, tmp_path / "out", workers=2)
    assert not second.stopped
    assert campaignkit.same(campaignkit.data_set(tmp_path / "out"), campaignkit.data_set(serial))


@pytest.mark.slow
def test_extended(campaign: LoadedCampaign, serial: Path, tmp_path: Path) -> None:
    run_campaign(campaign.with_campaign(runs=3), tmp_path / "out", workers=2)
    run_campaign(campaign.with_campaign(runs=11), tmp_path / "out", workers=2)
    done = run_campaign(campaign, tmp_path / "out", workers=2)
    assert done.flown == 9
    assert campaignkit.same(campaignkit.data_set(tmp_path / "out"), campaignkit.data_set(serial))
    assert run_campaign(campaign, tmp_path / "out").flown == 0


def test_two_processes_share_the_runs_of_a_folder(campaign: LoadedCampaign, serial: Path, tmp_path: Path) -> None:
    """The later process waits for the earlier one, reports its name, and flies only the remaining runs."""
    rows = campaignkit.data_set(serial)
    folder = tmp_path / "out"
    other, _ = open_store(folder, campaign)
    other.write(fly_rows(campaign, [(campaign.plan.draw(0, 8), run) for run in range(8)]))
    asked = []

    def wait(who: str) -> None:
        asked.append(who)
        if len(asked) == 2:
            other.write(fly_rows(campaign, [(campaign.plan.draw(8, 8), run) for run in range(8, 16)]))
            other.unlock()

    with pytest.raises(CampaignError, match=rf"out: process {os.getpid()} is flying this campaign; wait for it, or gi"):
        run_campaign(campaign, folder)
    done = run_campaign(campaign, folder, wait=wait)
    assert asked == [f"process {os.getpid()}"] * 2
    assert (done.flown, done.missing) == (4, ((16, 4),))
    assert campaignkit.same(campaignkit.data_set(folder), rows)


def test_success_that_does_not_follow_from_the_metrics_is_named(tmp_path: Path) -> None:
    """Every row whose success contradicts its metrics is reported, also where its metrics were not edited."""
    slosh = '[[requirement]]\nname = "slosh"\nmetric = "max_slosh_deg"\nlimit = 0.0050\n'
    campaign = campaignkit.small(tmp_path, rest=slosh)
    run_campaign(campaign, tmp_path / "out", workers=1)
    assert unfounded(DataSet(tmp_path / "out", campaign)) == []
    (part,) = [path for path in (tmp_path / "out/runs").iterdir() if "0000000000-" in path.name]
    table = pq.read_table(part)
    passed = table["passed"].to_pylist()
    assert 0 < sum(passed) < 8
    columns = {
        "passed": [True] * 8,
        "step_error_slosh_deg": [*table["step_error_slosh_deg"].to_pylist()[:7], 0.9],
        "lost_s": [0.2, *table["lost_s"].to_pylist()[1:]],
    }
    for name, values in columns.items():
        at = table.schema.get_field_index(name)
        table = table.set_column(at, table.schema.field(at), [values])
    pq.write_table(table, part)
    wrong = [run for run in range(8) if not passed[run]]
    assert unfounded(DataSet(tmp_path / "out", campaign)) == [
        "run 0: control is lost without a cause",
        "run 7: its integration errors are too large for 0 halvings",
        *(f"run {run}: `passed` does not follow from its metrics and requirements" for run in wrong),
    ]


def test_flown_again_alone_from_the_folder_alone(serial: Path, tmp_path: Path) -> None:
    moved = tmp_path / "elsewhere"
    shutil.copytree(serial, moved)
    for run in (0, 13, 19):
        again = refly(moved, run)
        assert again.same
        assert not again.differences
        assert (again.folder / "flight.mcap").exists()


def test_a_difference_is_seen(serial: Path, tmp_path: Path) -> None:
    """The comparison can fail: another seed gives a different data set."""
    other = maxq.read(serial).campaign.with_campaign(seed=6)
    again = refly(serial, 4, tmp_path / "out", campaign=other, log=False)
    assert again.same is False
    assert any(text.startswith("state_hash") for text in again.differences)


def test_what_is_recorded_is_what_was_flown(campaign: LoadedCampaign, serial: Path) -> None:
    row = campaignkit.data_set(serial).slice(7, 1).to_pylist()[0]
    loaded = campaign.scenario_of(7)
    stage, nominal = loaded.vehicle.stage[0], campaign.base.vehicle.stage[0]
    assert stage.engine is not None
    assert stage.engine.thrust_factor == row["vehicle.stage.0.engine.thrust_factor"] != 1.0
    assert stage.mass.table is not None
    assert nominal.mass.table is not None
    shift = row["vehicle.stage.0.mass.table.x_cg_m"]
    assert (stage.mass.table["x_cg_m"] == nominal.mass.table["x_cg_m"] + shift).all()
    assert stage.tank[1].damping_ratio == row["vehicle.stage.0.tank.1.damping_ratio"]
    assert loaded.vehicle.computer is not None
    assert loaded.vehicle.computer.delay_s == row["vehicle.computer.delay_s"]
    assert loaded.scenario.run.seed == row["run.seed"]
    flight = fly(loaded, log=False)
    assert flight.state_hash == row["state_hash"]
    for name in METRIC_NAMES:
        assert np.array_equal([flight.metrics[name]], [row[name]], equal_nan=True)


@pytest.fixture(scope="module")
def inexact() -> LoadedCampaign:
    """Return a campaign whose run 931 has an integration error of 0.045 mm at a bending of 0.68 mm."""
    return maxq.load("campaigns/ksr3-ringed").with_campaign(runs=8, envelope=Envelope(runs=0))


def test_an_inexact_run_is_flown_again_with_half_the_step(inexact: LoadedCampaign, tmp_path: Path) -> None:
    drawn = inexact.plan.draw(930, 3)
    rows = fly_rows(inexact, [(drawn, run) for run in (930, 931)])
    assert [(row.halvings, row.passed, row.cause) for row in rows] == [(0, True, ""), (1, True, "")]
    assert rows[1].metrics["step_error_bending_m"] == pytest.approx(1.7e-6, rel=0.1)
    assert rows[1].metrics["max_bending_m"] == pytest.approx(6.824e-4, rel=1e-3)  # as with a sixteenth of the step

    alone = fly(inexact.scenario_of(931), log=False)
    assert alone.inexact
    assert not alone.passed
    assert alone.failures[0].endswith("3.4e-05 m; set run.halvings = 1")
    finer = with_half_step(alone)
    assert finer is not None
    flights = [fly_scenario(inexact.scenario_of(931)), fly(load_scenario_text(finer.as_flown, (), "finer"), log=False)]
    assert [flight.state_hash for flight in flights] == [rows[1].state_hash] * 2
    assert [flight.passed for flight in flights] == [True, True]

    store, _ = open_store(tmp_path, inexact)
    store.write(rows)
    store.unlock()
    again = refly(tmp_path, 931, log=False)
    assert again.same, again.differences
    data = DataSet(tmp_path, inexact)
    assert finer_runs(data) == {931: 1}
    text = "run flown again with a share of the step, to reduce integration errors: 931 (1/2)"
    assert finer_text(finer_runs(data)) == text
    assert any(text in line for line in report(data, [], []))
    assert summary_of(data, [], [], 2, {})["finer_runs"] == {"931": 1}


def test_a_run_that_stays_inexact_fails_at_the_finest_step(
    inexact: LoadedCampaign, monkeypatch: pytest.MonkeyPatch
) -> None:
    allowed = iter([1e-9] * 4)
    monkeypatch.setattr("maxq.sim.run.fly.step_failure", lambda *_: f"integration: {next(allowed)}")
    small = inexact.with_campaign(runs=8)
    run = small.base.scenario.run.model_copy(update={"duration_s": 0.2})
    base = replace(small.base, scenario=small.base.scenario.model_copy(update={"run": run}))
    (row,) = fly_rows(replace(small, base=base), [(small.plan.draw(0, 1), 0)])
    assert (row.halvings, row.passed, row.cause) == (3, False, "integration: 1e-09")
    assert next(allowed, None) is None


def test_a_repetition_with_half_the_step_can_be_cancelled(inexact: LoadedCampaign) -> None:
    asked = iter([False] * 1 + [True] * 9)
    assert fly_rows(inexact, [(inexact.plan.draw(931, 1), 931)], lambda: next(asked)) == []


def test_an_envelope_changes_no_flight(serial: Path, tmp_path: Path) -> None:
    file = campaignkit.write_campaign(tmp_path)
    file.write_text(
        file.read_text().replace("[campaign.envelope]\nruns = 0", "[campaign.envelope]\nruns = 20\nrate_hz = 50.0")
    )

    run_campaign(maxq.load(file), tmp_path / "out", workers=2)
    assert campaignkit.same(campaignkit.data_set(tmp_path / "out"), campaignkit.data_set(serial))
    assert len(list((tmp_path / "out" / "histories").iterdir())) == 3
