"""Shards of a campaign, merged, are the campaign: bit for bit, after interruptions, and only if they are complete."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import campaignkit
import pyarrow.parquet as pq
import pytest

import maxq
from maxq import CampaignError, LoadedCampaign
from maxq.sim.campaign.analysis import DataSet, judged
from maxq.sim.campaign.runner import run_campaign
from maxq.sim.campaign.shards import Shard, checked_shards, merge
from maxq.tools import simrun

RUNS, SHARDS = 20, 3
AWS_BATCH = {"AWS_BATCH_JOB_ARRAY_INDEX": "6", "MAXQ_SHARDS": "9", "MAXQ_OUT": "/y"}
CLUSTER = Path(__file__).resolve().parents[1] / "examples" / "cluster"


def files(folder: Path) -> list[Path]:
    return sorted(path.relative_to(folder) for path in folder.rglob("*"))


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> tuple[LoadedCampaign, Path]:
    """Return a campaign, and a folder with `whole` and `part-1` to `part-3`; part 2 was interrupted and resumed.

    The draws are of a Latin hypercube, whose strata depend on the number of runs of the whole campaign.
    """
    folder = tmp_path_factory.mktemp("shards")
    path = campaignkit.write_campaign(folder, runs=RUNS, campaign='sampling = "latin-hypercube"')
    kept = "campaign.envelope.runs=9", 'campaign.envelope.channels=["alpha_deg"]', "campaign.envelope.rate_hz=10"
    campaign: Any = maxq.load(path, *kept)
    run_campaign(campaign, folder / "whole", workers=2)
    for number in (3, 1, 2):
        part, shard = folder / f"part-{number}", Shard(number, SHARDS)
        if number == 2:
            asked: list[bool] = []

            def stop(asked: list[bool] = asked) -> bool:  # before the second of its chunks
                asked.append(True)
                return len(asked) > 1

            begun = run_campaign(campaign, part, workers=1, stop=stop, shard=shard)
            assert begun.stopped
            assert 0 < begun.flown < begun.total
            rest = run_campaign(campaign, part, workers=2, shard=shard)
            assert rest.flown == rest.total - begun.flown
        else:
            assert run_campaign(campaign, part, shard=shard).flown == len(shard.runs(RUNS))
    return campaign, folder


def test_shards_are_all_runs_in_order() -> None:
    for total, of in ((20, 3), (7, 7), (1000, 32)):
        parts = [Shard(k, of).runs(total) for k in range(1, of + 1)]
        assert [run for part in parts for run in part] == list(range(total))
        assert max(map(len, parts)) - min(map(len, parts)) <= 1
    with pytest.raises(CampaignError, match="shard 2/8: the campaign has 7 runs; at most 7 shards are possible"):
        Shard(2, 8).runs(7)


def test_merged_shards_are_one_campaign(flown: tuple[LoadedCampaign, Path], tmp_path: Path) -> None:
    campaign, folder = flown
    loaded, parts = checked_shards([folder / f"part-{k}" for k in (2, 3, 1)])
    (tmp_path / "merged" / "runs").mkdir(parents=True)
    shutil.copy(folder / "part-1" / "campaign.json", tmp_path / "merged" / "lock")  # of an interrupted merging
    for _ in range(2):
        merge(loaded, parts, tmp_path / "merged")
    whole = campaignkit.data_set(folder / "whole")
    assert len(whole) == RUNS
    assert campaignkit.same(campaignkit.data_set(tmp_path / "merged"), whole)
    both = tmp_path / "merged", folder / "whole"
    ours, theirs = (pq.read_table(place / "histories").sort_by("run") for place in both)
    assert ours.to_pylist() == theirs.to_pylist()
    assert len(theirs) == 9
    verdicts = [judged(DataSet(place, of)) for place, of in zip(both, (loaded, campaign), strict=True)]
    assert repr(verdicts[0]) == repr(verdicts[1])  # from Python 3.13 on, records that contain nan are not equal
    manifests = [json.loads((place / "campaign.json").read_text()) for place in both]
    assert manifests[0] == manifests[1]
    assert run_campaign(campaign, tmp_path / "merged").flown == 0


def _lose_a_file(folder: Path) -> None:
    sorted((folder / "part-2" / "runs").iterdir())[0].unlink()


def _damage(folder: Path) -> None:
    path = sorted((folder / "part-3" / "runs").iterdir())[0]
    content = bytearray(path.read_bytes())
    content[len(content) // 3] ^= 0xFF
    path.write_bytes(bytes(content))


def _fly_elsewhere(folder: Path, **changes: Any) -> None:
    shutil.rmtree(folder / "part-3")
    campaign = campaignkit.small(folder, "other", runs=6, campaign='sampling = "latin-hypercube"')
    run_campaign(campaign.with_campaign(**changes), folder / "part-3", shard=Shard(3, SHARDS))


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda f: shutil.rmtree(f / "part-2"), "shard 2/3 is missing among the 2 folders"),
        (
            lambda f: shutil.copytree(f / "part-2", f / "part-9"),
            "part-9: is shard 2/3, as .*part-2 is; give each shard",
        ),
        (
            lambda f: _fly_elsewhere(f, seed=6),
            "part-3: is no shard of the campaign in .*part-1: campaign.runs was 20, is 6",
        ),
        (lambda f: _fly_elsewhere(f, runs=20), "part-3: is no shard of the campaign in .*part-1: .* was .*, is "),
        (_lose_a_file, "part-2: run 6 of runs 6 to 12 is missing; the same command as before completes shard 2/3"),
        (_damage, r"part-3/runs/runs-.*parquet: it cannot be read .*; the same command as before completes shard 3/3"),
        (lambda f: shutil.copytree(f / "whole", f / "part-0"), "part-0: holds a whole campaign, not a shard of one"),
        (lambda f: (f / "part-4").mkdir(), r"part-4: holds no campaign \(campaign.json is missing\)"),
    ],
    ids=["missing", "doubled", "foreign", "other-draws", "incomplete", "damaged", "whole", "empty"],
)
def test_shards_that_are_not_one_campaign(
    flown: tuple[LoadedCampaign, Path], tmp_path: Path, change: Callable[[Path], None], says: str
) -> None:
    folder = tmp_path / "all"
    shutil.copytree(flown[1], folder)
    change(folder)
    before = files(folder)
    with pytest.raises(CampaignError, match=says) as caught:
        checked_shards(sorted(folder.glob("part-*")))
    assert "\n" not in str(caught.value)
    assert files(folder) == before


def test_a_folder_belongs_to_one_shard(flown: tuple[LoadedCampaign, Path], tmp_path: Path) -> None:
    campaign, folder = flown
    for shard, runs, says in (
        (Shard(2, 3), RUNS, "shard was 1/3, is 2/3; give another --out"),
        (None, RUNS, "shard was 1/3, is the whole campaign; give another --out"),
        (Shard(1, 3), 21, "campaign.runs was 20, is 21; give another --out"),
    ):
        with pytest.raises(CampaignError, match=says):
            run_campaign(campaign.with_campaign(runs=runs), folder / "part-1", shard=shard)
    with pytest.raises(CampaignError, match="shard was the whole campaign, is 1/3"):
        run_campaign(campaign, folder / "whole", shard=Shard(1, 3))
    loaded, parts = checked_shards([folder / f"part-{k}" for k in (1, 2, 3)])
    shutil.copytree(folder / "whole", tmp_path / "whole")
    with pytest.raises(CampaignError, match=r"whole: has runs of its own \(runs-0000000000-0000000007.parquet\)"):
        merge(loaded, parts, tmp_path / "whole")


def test_the_commands(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]) -> None:
    monkeypatch.chdir(tmp_path)
    campaignkit.write_campaign(tmp_path, runs=5)
    for k in (1, 2):
        assert simrun.main(["small.toml", "--shard", f"{k}/2"]) == 0
    said = capfd.readouterr().out
    assert "shard 2/2: all 3 runs are in runs/small-2-of-2/runs; 3 runs flown" in said
    assert "requirement" not in said
    assert simrun.main(["report", "runs/small-1-of-2"]) == 2
    assert "holds shard 1/2 of a campaign; simrun merge makes the report" in capfd.readouterr().err
    assert simrun.main(["merge", "runs/small-2-of-2"]) == 2
    assert capfd.readouterr().err == "simrun: shard 1/2 is missing among the 1 folders\n"
    assert not Path("runs/small").exists()
    parts = sorted(map(str, Path("runs").glob("small-*")))
    assert simrun.main(["merge", *parts, "--no-report"]) == 3  # undecided, like the campaign flown at once
    assert "5 runs of 2 shards merged in runs/small" in capfd.readouterr().out
    assert Path("runs/small/summary.json").exists()
    for word in ("0/2", "3/2", "1", "1/2/3"):
        with pytest.raises(SystemExit, match="2"):
            simrun.main(["small.toml", "--shard", word])
        assert f"'{word}' is not K/N with K from 1 to N, e.g. 3/8" in capfd.readouterr().err


@pytest.mark.parametrize(
    ("name", "variables", "arguments", "asked"),
    [
        ("slurm.sh", {"SLURM_ARRAY_TASK_ID": "7"}, ["my.toml", "/x"], "my.toml 7/32 /x/part-7"),
        ("aws-batch.sh", AWS_BATCH, [], "campaigns/ksr3 7/9 /y/part-7"),
        ("kubernetes.yaml", {"JOB_COMPLETION_INDEX": "31"}, [], "campaigns/ksr3 32/32 /data/part-32"),
    ],
)
def test_the_examples_ask_for_their_shard(
    tmp_path: Path, name: str, variables: dict[str, str], arguments: list[str], asked: str
) -> None:
    """The scripts of job arrays call `simrun`, here a stand-in that prints its arguments, with their shard."""
    bash, script = shutil.which("bash"), CLUSTER / name
    if bash is None:
        pytest.skip("there is no bash")
    if name.endswith(".yaml"):
        yaml = pytest.importorskip("yaml")
        job = yaml.safe_load(script.read_text())["spec"]
        pod = job["template"]["spec"]["containers"][0]
        assert (job["completionMode"], job["completions"]) == ("Indexed", 32)
        command = [*pod["command"], *pod["args"]]
    else:
        subprocess.run([bash, "-n", str(script)], check=True)
        command = [bash, str(script), *arguments]
    stand_in = tmp_path / "simrun"
    stand_in.write_text('#!/bin/sh\necho "$2 $4 $6"\n')
    stand_in.chmod(0o755)
    environment = {"PATH": f"{tmp_path}{os.pathsep}{os.environ['PATH']}", **variables}
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    assert done.stdout.strip() == asked
