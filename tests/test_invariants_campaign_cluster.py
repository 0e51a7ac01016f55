"""A campaign on a scheduler with worker processes, one of which is killed, gives the same data set bit for bit."""

from __future__ import annotations

import threading
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import campaignkit
import pytest
from dask_cluster import machines

import maxq
from maxq import CampaignError
from maxq.sim.campaign.runner import DaskCluster, run_campaign

distributed = pytest.importorskip("distributed")


@pytest.mark.parametrize("threads", [1, 3, 64])
@pytest.mark.parametrize("runs", [1, 5, 64, 200, 10_000])
def test_batches_leave_no_thread_without_one(threads: int, runs: int) -> None:
    """Every thread gets a batch unless there are fewer runs than threads; no batch is larger than usual."""
    flyers: Any = SimpleNamespace(_given=False, _threads=threads)
    size = DaskCluster.batch(flyers, 32, runs)
    assert 1 <= size <= 32
    assert -(-runs // size) >= min(runs, threads)
    flyers._given = True
    assert DaskCluster.batch(flyers, 32, runs) == 32


@pytest.mark.parametrize(
    ("runs", "parts"), [pytest.param(48, 2, marks=pytest.mark.slow), pytest.param(300, 5, marks=pytest.mark.long)]
)
def test_workers_that_come_and_go(tmp_path: Path, runs: int, parts: int) -> None:
    whole = campaignkit.small(tmp_path, runs=runs)
    run_campaign(whole, tmp_path / "local")
    with machines(tmp_path, 2) as cluster:
        victim = cluster.processes[1]
        killed = threading.Event()

        def kill() -> None:
            deadline = time.monotonic() + 120.0
            while time.monotonic() < deadline and len(list((tmp_path / "out" / "runs").glob("runs-*"))) < parts:
                time.sleep(0.02)
            victim.kill()
            cluster.worker()
            killed.set()

        thread = threading.Thread(target=kill)
        thread.start()
        done = run_campaign(whole, tmp_path / "out", cluster=cluster.address)
        thread.join()
        assert killed.is_set()
        assert done.flown == runs
        assert victim.wait(10) == -9
        with distributed.Client(cluster.address, set_as_default=False) as client:
            maxq.campaign(whole, tmp_path / "public", cluster=client)
            assert client.status == "running"
    files = {name: sorted((tmp_path / name / "runs").iterdir()) for name in ("local", "out", "public")}
    for ours in (files["out"], files["public"]):
        assert [p.name for p in ours] == [p.name for p in files["local"]]
        assert [p.read_bytes() for p in ours] == [p.read_bytes() for p in files["local"]]
    assert run_campaign(whole, tmp_path / "out").flown == 0  # and threads find it finished


def test_no_scheduler(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    class Nobody:
        def __init__(self, *_: object, **__: object) -> None:
            raise OSError("timed out")

    monkeypatch.setattr(distributed, "Client", Nobody)
    with pytest.raises(CampaignError, match=r"no Dask scheduler answers at tcp://127.0.0.1:1: timed out"):
        maxq.campaign(campaignkit.small(tmp_path), tmp_path / "out", cluster="tcp://127.0.0.1:1")
    with pytest.raises(ValueError, match="workers = 2 is the number of threads of this process"):
        maxq.campaign("campaigns/first", tmp_path / "out", workers=2, cluster="tcp://127.0.0.1:1")
