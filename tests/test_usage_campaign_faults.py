"""Real faults around a campaign lose or duplicate no run, and the message names the next step."""

from __future__ import annotations

import contextlib
import html
import json
import os
import resource
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import campaignkit
import pytest

import maxq
from maxq import CampaignError, FlightRun, LoadedCampaign, ScenarioError
from maxq.sim.campaign.runner import run_campaign
from maxq.sim.campaign.store import Store, open_store
from maxq.tools import simrun

TESTS = Path(__file__).resolve().parent


@pytest.fixture
def campaign(tmp_path: Path) -> LoadedCampaign:
    return campaignkit.small(tmp_path)


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("undisturbed")
    run_campaign(campaignkit.small(folder), folder / "out")
    return folder / "out"


@pytest.mark.slow
@pytest.mark.parametrize(("kills", "runs"), [(12, 96), pytest.param(50, 400, marks=pytest.mark.long)])
def test_kills_and_then_the_same_data_set(tmp_path: Path, kills: int, runs: int) -> None:
    """SIGKILL between runs, while writing or renaming a part, or opening the folder loses no data."""
    file = campaignkit.write_campaign(tmp_path, runs=runs)
    command = [sys.executable, str(TESTS / "killing.py"), str(file), str(tmp_path / "out"), str(kills), "1", "0.25"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode == 0, done.stderr
    assert int(done.stdout) == kills
    run_campaign(campaignkit.small(tmp_path, runs=runs), tmp_path / "whole")
    assert campaignkit.same(campaignkit.data_set(tmp_path / "out"), campaignkit.data_set(tmp_path / "whole"))
    left = [p.name for p in (tmp_path / "out" / "runs").iterdir() if not p.name.startswith("runs-")]
    assert left == []


@pytest.mark.slow
def test_ctrl_c_and_what_a_batch_system_sends(tmp_path: Path) -> None:
    """The command stops within seconds with a message, and the next one continues."""
    file = campaignkit.write_campaign(tmp_path, runs=499)  # 500 would compile kernels for this vehicle alone
    file.write_text(file.read_text().replace("duration_s = 0.3", "duration_s = 2.0"))
    command = [sys.executable, "-m", "maxq.tools.simrun", str(file), "--out", str(tmp_path / "out"), "--no-report"]
    for number in (signal.SIGINT, signal.SIGTERM):
        process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=tmp_path)
        before = len(list((tmp_path / "out" / "runs").glob("*"))) if (tmp_path / "out").exists() else 0
        deadline = time.monotonic() + 120.0
        while time.monotonic() < deadline and process.poll() is None:
            time.sleep(0.05)
            if len(list((tmp_path / "out" / "runs").glob("runs-*"))) > before + 1:
                break
        process.send_signal(number)
        out, errors = process.communicate(timeout=60)
        assert process.returncode == 130, errors
        assert "INTERRUPTED" in out
        assert "same command resumes the campaign" in out
        assert "next: " not in out  # such as more runs than are wanted
    runs = campaignkit.data_set(tmp_path / "out")["run"].to_pylist()
    assert len(set(runs)) == len(runs) > 16


@pytest.mark.parametrize("runs", [0, 1])
def test_no_run_and_one_run(tmp_path: Path, runs: int, capsys: pytest.CaptureFixture[str]) -> None:
    file = campaignkit.write_campaign(tmp_path, runs=runs)
    code = simrun.main([str(file), "--out", str(tmp_path / "out")])
    out = capsys.readouterr().out
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert (code, summary["runs"]) == (3, runs)
    assert out.splitlines()[-1].startswith("NO RUNS" if runs == 0 else "UNDECIDED: ")
    word, reason = out.splitlines()[-1].split(": ", 1)
    shown = f'<div class="outcome open"><b>{word}</b><p>{reason[0].upper()}{reason[1:]}.</p></div>'
    assert shown in html.unescape((tmp_path / "out" / "report.html").read_text())


@pytest.mark.slow
@pytest.mark.parametrize("damage", ["cut", "flipped", "empty", "text", "another's"])
def test_a_corrupt_part_is_set_aside_and_flown_again(
    campaign: LoadedCampaign, undisturbed: Path, tmp_path: Path, damage: str
) -> None:
    out = tmp_path / "out"
    shutil.copytree(undisturbed, out)
    part = sorted((out / "runs").iterdir())[1]
    content = bytearray(part.read_bytes())
    if damage == "cut":
        part.write_bytes(content[: len(content) // 2])
    elif damage == "flipped":
        content[200] ^= 0xFF
        part.write_bytes(content)
    elif damage == "empty":
        part.write_bytes(b"")
    elif damage == "text":
        part.write_text("run,passed\n")
    else:
        shutil.copy(sorted((out / "runs").iterdir())[0], part)
    done = run_campaign(campaign, out)
    assert done.flown == 8
    assert "set aside" in done.notes[0]
    assert (out / "runs" / f"{part.name}.corrupt").exists()
    assert campaignkit.same(campaignkit.data_set_of(out), campaignkit.data_set(undisturbed))


def test_a_part_that_stands_twice_is_counted_once(campaign: LoadedCampaign, undisturbed: Path, tmp_path: Path) -> None:
    import pyarrow.parquet as pq  # noqa: PLC0415  # only here

    out = tmp_path / "out"
    shutil.copytree(undisturbed, out)
    overlapping = campaignkit.data_set(undisturbed).slice(4, 3)
    pq.write_table(overlapping, out / "runs" / "runs-0000000004-0000000006.parquet")
    done = run_campaign(campaign, out)
    assert "another part already contains" in done.notes[0]
    assert campaignkit.data_set_of(out)["run"].to_pylist() == list(range(20))


@pytest.mark.slow
def test_two_processes_on_one_folder(campaign: LoadedCampaign, tmp_path: Path) -> None:
    store, _ = open_store(tmp_path / "out", campaign)
    script = (
        "import sys; from pathlib import Path; import maxq;"
        "from maxq.sim.campaign.runner import run_campaign; from maxq.sim.campaign.error import CampaignError\n"
        "try: run_campaign(maxq.load(sys.argv[1]), Path(sys.argv[2]))\n"
        "except CampaignError as error: print(error)"
    )
    command = [sys.executable, "-c", script, str(tmp_path / "small.toml"), str(tmp_path / "out")]
    said = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    assert f"process {os.getpid()} is flying this campaign" in said
    assert "another --out" in said
    store.unlock()
    assert run_campaign(campaign, tmp_path / "out").flown == 20


@pytest.mark.slow
def test_another_campaign_in_the_folder(campaign: LoadedCampaign, undisturbed: Path, tmp_path: Path) -> None:
    for changes, said in (
        ({"seed": 9}, "campaign.seed was 5, is 9"),
        ({"sampling": "sobol"}, 'campaign.sampling was "random", is "sobol"'),
    ):
        with pytest.raises(CampaignError, match=said):
            run_campaign(campaign.with_campaign(**changes), undisturbed)
    other = campaignkit.small(tmp_path, "other", inputs=campaignkit.INPUTS.replace("0.03", "0.04"))
    with pytest.raises(CampaignError, match=r"disperse.0.three_sigma was 0.03, is 0.04; give another --out"):
        run_campaign(other, undisturbed)


def test_a_folder_with_other_files(campaign: LoadedCampaign, tmp_path: Path) -> None:
    (tmp_path / "thesis.tex").write_text("")
    with pytest.raises(CampaignError, match="holds other files"):
        run_campaign(campaign, tmp_path)
    with pytest.raises(CampaignError, match="is a file"):
        run_campaign(campaign, tmp_path / "thesis.tex")


@contextlib.contextmanager
def mounted(folder: Path, options: str) -> Iterator[None]:
    """Mount a small file system, or skip the test without permission to mount."""
    folder.mkdir()
    done = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", options, "tmpfs", str(folder)], capture_output=True, check=False
    )
    if done.returncode != 0:
        pytest.skip("may not mount a file system here")
    try:
        yield
    finally:
        subprocess.run(["umount", str(folder)], check=True)


def test_a_disk_that_fills(campaign: LoadedCampaign, undisturbed: Path, tmp_path: Path) -> None:
    with mounted(tmp_path / "disk", "size=1m"):
        ballast = tmp_path / "disk" / "ballast"
        out = tmp_path / "disk" / "out"
        run_campaign(campaign.with_campaign(runs=0), out)
        ballast.write_bytes(
            bytes(os.statvfs(tmp_path / "disk").f_bavail * os.statvfs(tmp_path / "disk").f_frsize - 50_000)
        )
        with pytest.raises(CampaignError, match="no space left on device; make room and start the same command again"):
            run_campaign(campaign, out)
        assert not [p for p in (out / "runs").iterdir() if p.name.startswith(".")]
        ballast.unlink()
        run_campaign(campaign, out)
        assert campaignkit.same(campaignkit.data_set(out), campaignkit.data_set(undisturbed))


@pytest.mark.slow
def test_files_that_may_not_grow(campaign: LoadedCampaign, undisturbed: Path, tmp_path: Path) -> None:
    """The system's limit on file sizes acts like a full disk, where mounting is not permitted."""
    run_campaign(campaign.with_campaign(runs=0), tmp_path / "out")
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (10_000, before[1]))
    try:
        with pytest.raises(CampaignError, match="file too large; make room"):
            run_campaign(campaign, tmp_path / "out")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    run_campaign(campaign, tmp_path / "out")
    assert campaignkit.same(campaignkit.data_set(tmp_path / "out"), campaignkit.data_set(undisturbed))


def test_a_read_only_folder(campaign: LoadedCampaign, tmp_path: Path) -> None:
    with mounted(tmp_path / "disk", "ro"), pytest.raises(CampaignError, match="read-only file system; give a folder"):
        run_campaign(campaign, tmp_path / "disk" / "out")


def test_a_clock_that_jumps(
    campaign: LoadedCampaign, undisturbed: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Neither the data nor the list of completed runs depends on the time of day."""
    run_campaign(campaign.with_campaign(runs=11), tmp_path / "out")
    for path in (tmp_path / "out").rglob("*"):
        os.utime(path, (0, 0))
    monkeypatch.setattr(time, "time", lambda: -1e9)
    done = run_campaign(campaign, tmp_path / "out")
    assert done.flown == 9
    assert done.wall_s >= 0.0
    assert campaignkit.same(campaignkit.data_set(tmp_path / "out"), campaignkit.data_set(undisturbed))


@pytest.mark.parametrize("where", ["__init__", "fly_segment", "result"])
def test_a_run_that_breaks_is_a_row(
    campaign: LoadedCampaign, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, where: str
) -> None:
    """A run that fails in preparation, in flight or in judgement is a row, and the other runs are flown."""
    plain = getattr(FlightRun, where)

    def breaks(self: FlightRun, *rest: Any, **more: Any) -> Any:
        loaded = rest[0] if where == "__init__" else self.loaded
        if loaded.scenario.run.seed == campaign.scenario_of(5).scenario.run.seed:
            raise ZeroDivisionError("of ours")
        return plain(self, *rest, **more)

    monkeypatch.setattr(FlightRun, where, breaks)
    run_campaign(campaign, tmp_path / "out")
    rows = campaignkit.data_set(tmp_path / "out").to_pylist()
    assert [row["outcome"] for row in rows].count("error") == 1
    assert (rows[5]["outcome"], rows[5]["cause"], rows[5]["passed"]) == ("error", "ZeroDivisionError: of ours", False)
    assert rows[5]["run.seed"] == campaign.scenario_of(5).scenario.run.seed


def test_runs_that_diverge_are_results(tmp_path: Path) -> None:
    rest = '[[injection]]\nat = "body_torque"\naxis = "y"\nkind = "step"\namplitude_Nm = 1.0\nstart_s = 0.12\n'
    inputs = '[[disperse]]\nkey = "injection.0.amplitude_Nm"\ndistribution = "choice"\nvalues = [0.0, 1e9]\n'
    campaign = campaignkit.small(tmp_path, rest=rest, inputs=inputs)
    run_campaign(campaign, tmp_path / "out")
    rows = campaignkit.data_set(tmp_path / "out").to_pylist()
    broken = [row for row in rows if row["injection.0.amplitude_Nm"] > 0.0]
    assert 0 < len(broken) < 20
    for row in broken:
        assert (row["outcome"], row["passed"]) == ("diverged", False)
        assert "turns faster than 1000 rad/s" in row["cause"]
        assert 0.12 <= row["lost_s"] <= 0.3
    assert all(row["passed"] for row in rows if row not in broken)


BOUNDED = """\
[[disperse]]
key = "vehicle.stage.0.tank.0.damping_ratio"
distribution = "normal"
mean = 0.0
sigma = 0.01
"""
EXCLUSIVE = """\
[[disperse]]
key = "vehicle.stage.0.engine.gimballed_mass_kg"
distribution = "uniform"
low = 100.0
high = 400.0
"""


def test_draws_out_of_bounds_are_drawn_again_and_counted(tmp_path: Path) -> None:
    campaign = campaignkit.small(tmp_path, runs=200, inputs=BOUNDED)
    drawn = campaign.plan.draw(0, 200)
    assert (drawn.draws["vehicle.stage.0.tank.0.damping_ratio"] >= 0.0).all()
    assert 60 < (drawn.redraws > 0).sum() < 140  # half of them, within five standard deviations
    alone = campaign.plan.draw(77, 1)
    assert (
        alone.draws["vehicle.stage.0.tank.0.damping_ratio"] == drawn.draws["vehicle.stage.0.tank.0.damping_ratio"][77]
    )
    run_campaign(campaign.with_campaign(runs=8), tmp_path / "out")
    assert campaignkit.data_set(tmp_path / "out")["redraws"].to_pylist() == drawn.redraws[:8].tolist()


def test_draws_out_of_bounds_are_refused_where_the_file_says_so(tmp_path: Path) -> None:
    campaign = campaignkit.small(tmp_path, inputs=BOUNDED, campaign='outside = "refuse"')
    with pytest.raises(CampaignError, match=r"run \d+: vehicle.stage.0.tank.0.damping_ratio = -0.0\d+ is outside"):
        run_campaign(campaign, tmp_path / "out")


def test_values_that_exclude_each_other_are_drawn_again(tmp_path: Path) -> None:
    """An engine mass above 46/0.38^2 = 318 kg contradicts its inertia, and is drawn again or rejected."""
    campaign = campaignkit.small(tmp_path, inputs=EXCLUSIVE, runs=40)
    inputs = [campaign.inputs(run, campaign.plan.draw(0, 40)) for run in range(40)]
    masses = [i.recorded["vehicle.stage.0.engine.gimballed_mass_kg"] for i in inputs]
    assert max(masses) <= 318.6
    assert sum(i.redraws > 0 for i in inputs) > 3
    assert campaign.inputs(9).recorded == inputs[9].recorded
    refusing = campaignkit.small(tmp_path, "refusing", inputs=EXCLUSIVE, campaign='outside = "refuse"')
    with pytest.raises(CampaignError, match="no rigid body has this inertia about the gimbal"):
        run_campaign(refusing, tmp_path / "out")


def test_bounds_that_nothing_meets(tmp_path: Path) -> None:
    campaign = campaignkit.small(tmp_path, inputs=BOUNDED + "at_least = 2.0\n")
    with pytest.raises(CampaignError, match=r"1000 draws of .* are all outside its bounds"):
        campaign.plan.draw(0, 1)


def test_a_refused_campaign_leaves_no_folder(tmp_path: Path) -> None:
    """A folder that was there stays, as does one with completed runs."""
    refused = campaignkit.small(tmp_path, inputs=BOUNDED + "at_least = 2.0\n")
    (tmp_path / "made").mkdir()
    for name in ("made", "out"):
        with pytest.raises(CampaignError, match="are all outside its bounds"):
            run_campaign(refused, tmp_path / name)
    assert (tmp_path / "made").exists()
    assert not (tmp_path / "out").exists()
    inputs = BOUNDED.replace("mean = 0.0", "mean = 0.01")
    late = campaignkit.small(tmp_path, inputs=inputs, campaign='outside = "refuse"')
    run_campaign(late.with_campaign(runs=1), tmp_path / "out")
    with pytest.raises(CampaignError, match=r"run [1-9]\d*: .* is outside its bounds"):
        run_campaign(late, tmp_path / "out")
    assert len(list((tmp_path / "out" / "runs").iterdir())) >= 1


def test_a_step_with_which_the_integrator_is_unstable_is_refused_before_the_folder_is_made(tmp_path: Path) -> None:
    campaign = maxq.load(
        campaignkit.write_campaign(tmp_path),
        "run.step_s=0.01",
        "vehicle.computer.sample_s=0.02",
        "vehicle.stage.0.bending.frequency_factor=[1.0,1.0,4.0]",
    )
    with pytest.raises(ScenarioError, match=r"run.step_s = 0.01: the integrator is unstable for pitch mode 3 "):
        run_campaign(campaign, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_as_many_draws_are_tried_as_the_message_says(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    campaign = campaignkit.small(tmp_path, runs=60, inputs=BOUNDED)
    redraws = campaign.plan.draw(0, 60).redraws.tolist()
    monkeypatch.setattr("maxq.sim.campaign.plan.MOST_ATTEMPTS", 2)
    assert campaign.plan.draw(redraws.index(2), 1).redraws.tolist() == [2]
    with pytest.raises(CampaignError, match=r"2 draws of .* are all outside its bounds \(at least 0 and at most 1\)"):
        campaign.plan.draw(redraws.index(3), 1)


@pytest.mark.parametrize(
    ("inputs", "says"),
    [
        ('key = "vehicle.stage.0.engine.thrust_facto"', "did you mean vehicle.stage.0.engine.thrust_factor?"),
        ('key = "vehicle.stage.7.engine"', "vehicle.stage has no element 7"),
        ('key = "vehicle.stage.0.engine"', "is not a single value"),
        ('key = "vehicle.stage.0.mass.table.x_cg"', "no column x_cg; did you mean x_cg_m?"),
        ('key = "vehicle.stage.0.mass.table.x_cg_m"', "mean: required key is missing"),
        ('key = "switches.slosh"\ndistribution = "choice"\nvalues = [1.0]', "is true or false"),
        ('key = "switches.gyro"', "switches.gyro holds no number"),
        ('key = "wind.factor"\ndistribution = "normal"', "needs one of sigma, three_sigma"),
        ('key = "wind.factor"\ndistribution = "gauss"', "is not one of the choices"),
        ('key = "wind.factor"\ndistribution = "uniform"\nlow = 2.0\nhigh = 1.0', "low is above high"),
        ('key = "wind.factor"\ndistribution = "normal"\nsigma = 1.0\nhigh = 1.0', "has no meaning here"),
        (
            'key = "wind.factor"\ndistribution = "normal"\nsigma = 1.0\nat_least = 2.0\nat_most = 1.0',
            "disperse.0.at_least = 2.0: is above at_most; allowed: at most 1",
        ),
        ('keys = ["wind.factor"]\ndistribution = "normal"\ncovariance = [[1.0, 0.0]]', "is not a matrix of 1 by 1"),
        ('distribution = "samples"\nkey = "wind.factor"\nfile = "none.csv"', "no such file"),
        ('key = "run.seed"\ndistribution = "uniform"\nlow = 0.0\nhigh = 9.0', "run.seed is dispersed"),
        ('name = "none"', "needs one of key, keys"),
    ],
)
def test_mistakes_in_a_campaign_are_said_in_one_line(tmp_path: Path, inputs: str, says: str) -> None:
    law = "" if "distribution" in inputs else '\ndistribution = "normal"\nsigma = 1.0'
    file = campaignkit.write_campaign(tmp_path, inputs=f"[[disperse]]\n{inputs}{law}\n")
    with pytest.raises(ScenarioError) as caught:
        maxq.load(file)
    assert says in str(caught.value)
    assert "small.toml" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_one_key_twice(tmp_path: Path) -> None:
    with pytest.raises(ScenarioError, match="is dispersed twice"):
        campaignkit.small(tmp_path, inputs=BOUNDED + BOUNDED)


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (
            ["nominal", "--runs", "5"],
            "--runs is an option of simrun campaign, search or rare, not of simrun fly; see simrun fly --help",
        ),
        (["campaigns/first", "--run", "5"], "--run is an option of simrun refly or shrink, not of simrun campaign"),
        (["campaigns/first", "--keep", "best"], "--keep: best: allowed: worst:5"),
        (["campaigns/first", "--runs", "-1"], "is not a whole number"),
        (["campaigns/firs"], "did you mean campaigns/first?"),
        (["--from", ".", "--run", "3"], "holds no campaign"),
        (["--from", ".", "--shrink"], "give a --run, e.g. simrun shrink runs/first --run 17"),
        (
            ["--from", ".", "--runs", "3", "--set", "a=1"],
            "--runs is an option of simrun campaign, search or rare, not of simrun report",
        ),
    ],
)
def test_mistakes_on_the_command_line(
    arguments: list[str], says: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    try:
        code = simrun.main(arguments)
    except SystemExit as end:
        code = int(str(end.code))
    assert code == 2
    assert says in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_missing_runs_are_cut_at_batches(campaign: LoadedCampaign, tmp_path: Path) -> None:
    store = Store(tmp_path, campaign)
    (tmp_path / "runs").mkdir()
    (tmp_path / "runs" / "runs-0000000003-0000000004.parquet").touch()
    (tmp_path / "runs" / "runs-0000000016-0000000029.parquet").touch()
    assert list(store.missing(20, 8)) == [(0, 3), (5, 3), (8, 8)]
    assert list(store.missing(0, 8)) == []
