"""A campaign's folder has a copy in object storage, from which another machine continues."""

from __future__ import annotations

import ast
import re
import shutil
from pathlib import Path
from typing import Any

import campaignkit
import duckdb
import fsspec
import numpy as np
import polars
import pyarrow.parquet as pq
import pytest
from fsspec.implementations.memory import MemoryFile, MemoryFileSystem

from maxq import CampaignError, LoadedCampaign
from maxq.sim.campaign.runner import run_campaign
from maxq.tools import simrun

ROOT = Path(__file__).resolve().parents[1]
RUNS = 20
STORE: Any = fsspec.filesystem("memory")


def stop_at(calls: int) -> Any:
    asked: list[bool] = []

    def stop() -> bool:
        asked.append(True)
        return len(asked) > calls

    return stop


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> tuple[LoadedCampaign, Path]:
    folder = tmp_path_factory.mktemp("objects")
    campaign = campaignkit.small(folder, runs=RUNS)
    run_campaign(campaign, folder / "whole")
    return campaign, folder / "whole"


def stored(address: str) -> list[str]:
    return sorted(name.removeprefix(f"/{address}/") for name in STORE.find(f"/{address}"))


def test_a_campaign_continues_on_another_machine(whole: tuple[LoadedCampaign, Path], tmp_path: Path) -> None:
    campaign, reference = whole
    address = "memory://bucket/first"
    begun = run_campaign(campaign, tmp_path / "one", workers=1, stop=stop_at(2), sync=address)
    assert begun.stopped
    assert 0 < begun.flown < RUNS
    shutil.rmtree(tmp_path / "one")  # the machine is lost
    STORE.pipe_file("/bucket/first/runs/runs-0000000016-0000000019.parquet", b"PAR1 damaged")
    rest = run_campaign(campaign, tmp_path / "two", workers=2, sync=address)
    assert rest.flown == RUNS - begun.flown
    assert "set aside" in rest.notes[0]
    names = [f"runs/{path.name}" for path in (tmp_path / "two" / "runs").glob("*.parquet")]
    assert stored("bucket/first") == sorted(["campaign.json", *names])
    for name in names:
        assert STORE.cat_file(f"/bucket/first/{name}") == (tmp_path / "two" / name).read_bytes()
    assert campaignkit.same(campaignkit.data_set_of(tmp_path / "two"), campaignkit.data_set(reference))
    with pytest.raises(
        CampaignError, match=r"memory://bucket/first: another campaign was flown here: campaign\.seed was 5"
    ):
        run_campaign(campaign.with_campaign(seed=6), tmp_path / "three", sync=address)
    assert not (tmp_path / "three" / "runs").exists()


class Flaky(MemoryFileSystem):
    """A storage whose third file of rows cannot be written."""

    protocol = "flaky"
    written = 0

    def _open(self, path: str, mode: str = "rb", **given: Any) -> MemoryFile:
        if mode == "wb" and "/runs/" in path:
            Flaky.written += 1
            if Flaky.written == 3:
                raise RuntimeError("SlowDown\nreduce your request rate")
        return super()._open(path, mode, **given)


def test_a_storage_that_fails_ends_the_campaign_which_continues(
    whole: tuple[LoadedCampaign, Path], tmp_path: Path
) -> None:
    campaign, reference = whole
    fsspec.register_implementation("flaky", Flaky, clobber=True)
    with pytest.raises(CampaignError) as caught:
        run_campaign(campaign, tmp_path / "out", workers=1, sync="flaky://bucket/second")
    assert str(caught.value) == "flaky://bucket/second: cannot be written: SlowDown; the same command continues"
    assert len(list((tmp_path / "out" / "runs").iterdir())) == 3
    done = run_campaign(campaign, tmp_path / "out", sync="flaky://bucket/second")
    assert done.flown == 0  # the third file was on the disk, and is copied first
    assert Flaky.written == 4
    assert campaignkit.same(campaignkit.data_set(tmp_path / "out"), campaignkit.data_set(reference))


def test_the_commands(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]) -> None:
    monkeypatch.chdir(tmp_path)
    campaignkit.write_campaign(tmp_path, runs=4)
    for k in (1, 2):
        arguments = ["small.toml", "--shard", f"{k}/2", "--out", f"p{k}", "--sync", f"memory://shared/part-{k}"]
        assert simrun.main(arguments) == 0
    assert simrun.main(["merge", "memory://shared/part-*", "--out", "all", "--no-report"]) == 3
    assert "4 runs of 2 shards merged in all" in capfd.readouterr().out
    assert len(campaignkit.data_set(Path("all"))) == 4
    for address, says in (
        ("nosuch://x", "nosuch://x: cannot be opened: Protocol not known: nosuch"),
        ("memory://shared/none-*", "memory://shared/none-*: there is no such folder"),
    ):
        assert simrun.main(["merge", address]) == 2
        assert says in capfd.readouterr().err


def test_a_large_data_set_is_queried_without_loading_it(whole: tuple[LoadedCampaign, Path], tmp_path: Path) -> None:
    """The queries of docs/howto/parquet.md give the results of NumPy."""
    page = (ROOT / "docs" / "howto" / "parquet.md").read_text()
    [code] = [block for block in re.findall(r"```python\n(.*?)```", page, re.DOTALL) if "scan_parquet" in block]
    for copy in range(5):
        for part in (whole[1] / "runs").iterdir():
            shutil.copy(part, tmp_path / f"{copy}-{part.name}")
    known: dict[str, Any] = {"duckdb": duckdb, "polars": polars}
    found = []
    for statement in ast.parse(code.replace("runs/ksr3/runs", str(tmp_path))).body:
        if isinstance(statement, ast.Expr):
            found.append(eval(compile(ast.Expression(statement.value), "page", "eval"), known))
        else:
            exec(compile(ast.Module([statement], []), "page", "exec"), known)
    values = np.concatenate([pq.read_table(p)["max_alpha_deg"].to_numpy() for p in tmp_path.iterdir()])
    wanted = 5 * RUNS, values.max(), pytest.approx(np.quantile(values, 0.9973), rel=1e-12)
    assert found[0].fetchall() == [("duration", *wanted)]
    assert found[1].row(0) == wanted
