"""Serial = parallel = resumed = extended = flown again alone, bit by bit; and what is recorded is what was flown."""

from __future__ import annotations

import shutil
from pathlib import Path

import campaignkit
import numpy as np
import pytest

import maxq
from maxq import LoadedCampaign
from maxq.sim.campaign import runner
from maxq.sim.campaign.investigation import refly
from maxq.sim.campaign.runner import run_campaign
from maxq.sim.campaign.runs import fly_rows
from maxq.sim.flight.metric_table import METRIC_NAMES
from maxq.sim.run.fly import fly


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
    """Check that the other runs of a chunk change nothing in a run."""
    monkeypatch.setattr(runner, "CHUNK", chunk)
    run_campaign(campaign, tmp_path / "out", workers=1)
    assert campaignkit.same(campaignkit.data_set(tmp_path / "out"), campaignkit.data_set(serial))


def test_cancelled_within_a_chunk(campaign: LoadedCampaign) -> None:
    """Check that earlier flights stay and that the flight under way is dropped."""
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


def test_flown_again_alone_from_the_folder_alone(serial: Path, tmp_path: Path) -> None:
    moved = tmp_path / "elsewhere"
    shutil.copytree(serial, moved)
    for run in (0, 13, 19):
        again = refly(moved, run)
        assert again.same
        assert not again.differences
        assert (again.folder / "flight.mcap").exists()


def test_a_difference_is_seen(serial: Path, tmp_path: Path) -> None:
    """The comparison can fail: the data set of another seed is not the same flight."""
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


def test_an_envelope_changes_no_flight(serial: Path, tmp_path: Path) -> None:
    file = campaignkit.write_campaign(tmp_path)
    file.write_text(
        file.read_text().replace("[campaign.envelope]\nruns = 0", "[campaign.envelope]\nruns = 20\nrate_hz = 50.0")
    )

    run_campaign(maxq.load(file), tmp_path / "out", workers=2)
    assert campaignkit.same(campaignkit.data_set(tmp_path / "out"), campaignkit.data_set(serial))
    assert len(list((tmp_path / "out" / "histories").iterdir())) == 3
