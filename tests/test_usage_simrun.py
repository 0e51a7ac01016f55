"""`simrun` writes, prints and returns its results, here for shortened built-in scenarios."""

from __future__ import annotations

import json
import shutil
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import maxq
from maxq import Flight, FlightRun, LogError, record
from maxq.sim.log.messages import Level
from maxq.sim.run import record as recording
from maxq.sim.run.fly import fly
from maxq.sim.scenario.loader import load_scenario
from maxq.tools import simrun
from maxq.tools.cli.terminal import Progress

SHORT = ["nominal", "--set", "run.duration_s=1.5", "--set", "requirement="]
LOSES_CONTROL = [
    "nominal",
    *("--set", "requirement=", "--set", "run.duration_s=15.0"),
    "--set",
    'injection=[{at="body_torque",axis="y",kind="step",amplitude_Nm=3e5,start_s=10.0}]',
]
DIVERGES = [
    "nominal",
    *("--set", "requirement=", "--set", "run.duration_s=3.0"),
    "--set",
    'injection=[{at="body_torque",axis="y",kind="step",amplitude_Nm=1e9,start_s=1.0}]',
]

Printed = pytest.CaptureFixture[str]


@pytest.fixture(autouse=True)
def _in_an_empty_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


def run(*arguments: str) -> int:
    """Run the command and return its exit code, also when argparse ends it."""
    try:
        return simrun.main(list(arguments))
    except SystemExit as end:
        return int(str(end.code))


def summary(folder: str = "out") -> dict[str, Any]:
    content: dict[str, Any] = json.loads((Path(folder) / "summary.json").read_text())
    return content


# flown


def test_a_flight_leaves_log_and_summary_and_says_what_happened(capsys: Printed) -> None:
    assert run(*SHORT, "--set", 'requirement=[{metric="max_speed_mps",limit=100}]', "--out", "out") == 0
    printed = capsys.readouterr()
    assert printed.err == ""
    lines = printed.out.splitlines()
    assert lines[0].startswith("nominal: KSR-III")
    assert any(line.split() == ["liftoff", "0.107", "s"] for line in lines)
    assert any(line.startswith("  largest gimbal ") and "deg" in line.split() for line in lines)
    assert any(line.split()[:2] == ["max_speed_mps", "met"] for line in lines)
    assert lines.index("requirements") < lines.index("events") < lines.index("metrics")
    assert lines[-1].startswith("PASSED: 1 requirement met; tightest: max_speed_mps, ")
    assert sorted(path.name for path in Path("out").iterdir()) == ["flight.mcap", "summary.json"]
    told = summary()
    assert (told["outcome"], told["passed"], told["end_s"], told["log"]) == ("duration", True, 1.5, "flight.mcap")
    assert [event["name"] for event in told["events"]] == ["ignition", "liftoff"]
    assert told["metrics"]["max_speed_mps"]["unit"] == "m/s"
    assert told["metrics"]["max_speed_mps"]["time_s"] == 1.5
    assert told["metrics"]["saturation_time_s"] == {"value": 0.0, "unit": "s", "time_s": None}
    assert told["requirements"][0]["limit"] == 100.0
    assert told["requirements"][0]["value"] == told["metrics"]["max_speed_mps"]["value"]
    assert told["steps"] > 1500
    assert set(told["versions"]) == {"maxq", "python", "numpy", "numba"}
    assert set(told["timing"]) == {"load_s", "prepare_s", "flight_s", "total_s"}
    log = maxq.read("out/flight.mcap")
    assert log.complete
    assert log.end["state_hash"] == told["state_hash"]
    assert told["final"]["altitude_m"] == log["altitude_m"][-1]


def test_the_default_folder_is_named_after_the_scenario(capsys: Printed) -> None:
    Path("short.toml").write_text("extends = 'nominal.toml'\nrun = {duration_s = 0.2}\nrequirement = []\n")
    assert run("short.toml", "--no-log") == 0
    assert Path("runs/short/summary.json").is_file()
    assert run("short.toml", "--no-log", "--set", "name=../../x/y") == 0
    assert sorted(path.name for path in Path("runs").iterdir()) == ["short", "x-y"]
    capsys.readouterr()
    assert run(*SHORT, "--no-log", "--set", "name=x\u001b[31my") == 2
    out, err = capsys.readouterr()
    assert "holds a control character" in err
    assert "\x1b" not in out + err


def test_without_a_log_the_flight_is_the_same() -> None:
    assert run(*SHORT, "--out", "logged") == 0
    assert run(*SHORT, "--out", "out", "--no-log") == 0
    assert [path.name for path in Path("out").iterdir()] == ["summary.json"]
    with_log, without = summary("logged"), summary()
    assert without["log"] is None
    for key in ("state_hash", "metrics", "final", "events", "steps"):
        assert with_log[key] == without[key]


def test_a_missed_requirement_is_exit_1(capsys: Printed) -> None:
    requirement = 'requirement=[{metric="max_speed_mps",limit=1.0,name="crawl"},{metric="range_m",minimum=-1}]'
    assert run(*SHORT, "--set", requirement, "--out", "out") == 1
    out = capsys.readouterr().out.splitlines()
    assert out[-1].startswith("FAILED: crawl ")
    assert out[-1].endswith(" m/s > 1 m/s at 1.500 s; 1 of 2 requirements met")
    assert [r["met"] for r in summary()["requirements"]] == [False, True]
    assert summary()["passed"] is False


def test_a_value_that_does_not_exist_meets_no_requirement() -> None:
    flat = ["--set", "earth.shape=flat", "--set", "earth.rotating=false", "--set", "earth.gravity=uniform"]
    requirement = 'requirement=[{metric="final_latitude_deg",minimum=-90}]'
    assert run(*SHORT, *flat, "--set", requirement, "--out", "out", "--no-log") == 1
    assert summary()["requirements"][0]["value"] is None


def test_lost_control_is_exit_1_with_cause_and_time(capsys: Printed) -> None:
    assert run(*LOSES_CONTROL, "--out", "out") == 1
    (failure,) = summary()["failures"]
    assert failure.startswith("control lost at 10.")
    assert "45 deg" in failure
    assert capsys.readouterr().out.splitlines()[-1].startswith(f"FAILED: {failure}; the vehicle tumbles from 11.")
    assert "control_lost" in [event["name"] for event in summary()["events"]]
    (event,) = (e for e in maxq.read("out/flight.mcap").events if e.text.startswith("control_lost"))
    assert event.level is Level.ERROR


def test_a_diverged_flight_says_why_and_when_and_keeps_its_log(capsys: Printed) -> None:
    assert run(*DIVERGES, "--out", "out") == 1
    out = capsys.readouterr().out
    told = summary()
    assert told["outcome"] == "diverged"
    assert told["cause"] == "the vehicle turns faster than 1000 rad/s"
    assert told["failures"][-1] == f"diverged at {told['end_s']:.3f} s: {told['cause']}"
    assert told["failures"][-1] in out.splitlines()[-1]
    assert f"state at {told['end_s']:.3f} s, before it diverged" in out
    assert "body_pitch_rate_degps" in out
    assert 1.0 < told["end_s"] < 1.2
    log = maxq.read("out/flight.mcap")
    assert log.complete
    assert log.events[-1].level is Level.FATAL
    assert log.events[-1].text == f"diverged: {told['cause']}"
    assert log.time_s("gimbal_pitch_angle_deg")[-1] == told["end_s"]
    assert np.isfinite(log["w_BI_B_y_radps"]).all()
    assert abs(log["w_BI_B_y_radps"][-1]) > 100.0


# flown again


def test_a_log_alone_flies_again_and_is_the_same(capsys: Printed) -> None:
    run(*SHORT, "--set", "run.seed=5", "--out", "out")
    capsys.readouterr()
    assert run("--from", "out/flight.mcap") == 0
    assert capsys.readouterr().out.splitlines()[-1].startswith("SAME as out/flight.mcap: ")
    assert [path.name for path in Path().iterdir()] == ["out"]  # and nothing was written
    assert run("--from", "out/flight.mcap", "--out", "again") == 0
    assert Path("again/flight.mcap").read_bytes() == Path("out/flight.mcap").read_bytes()


def test_a_log_is_not_overwritten_by_flying_it_again(capsys: Printed) -> None:
    run(*SHORT, "--out", "out")
    before = Path("out/flight.mcap").read_bytes()
    assert run("--from", "out/flight.mcap", "--out", "./out") == 2
    assert "choose another folder" in capsys.readouterr().err
    assert Path("out/flight.mcap").read_bytes() == before


def test_a_changed_scenario_is_not_compared(capsys: Printed) -> None:
    run(*SHORT, "--out", "out")
    capsys.readouterr()
    assert run("--from", "out/flight.mcap", "--set", "run.step_s=0.0005") == 0
    assert "not compared" in capsys.readouterr().out.splitlines()[-1]


def test_a_different_flight_is_exit_1(capsys: Printed, monkeypatch: pytest.MonkeyPatch) -> None:
    honest = recording.result_record
    with monkeypatch.context() as lie:
        lie.setattr(recording, "result_record", lambda flight: honest(flight) | {"state_hash": "0" * 64})
        run(*SHORT, "--out", "out")
    capsys.readouterr()
    assert run("--from", "out/flight.mcap") == 1
    last = capsys.readouterr().out.splitlines()[-1]
    assert last.startswith("DIFFERENT from out/flight.mcap: state hash ")
    assert "there 0000000000000000" in last


def test_a_log_that_was_cut_off_flies_again_but_is_no_proof(capsys: Printed) -> None:
    run(*SHORT, "--out", "out")
    log = Path("out/flight.mcap")
    log.write_bytes(log.read_bytes()[:-2000])
    capsys.readouterr()
    assert run("--from", "out/flight.mcap") == 1
    assert "cut off" in capsys.readouterr().out.splitlines()[-1]


@pytest.mark.slow
def test_equal_flights_give_equal_bytes_in_another_process_too() -> None:
    run(*SHORT, "--out", "out")
    command = [sys.executable, "-m", "maxq.tools.simrun", *SHORT, "--out", "other"]
    subprocess.run(command, check=True, capture_output=True)
    assert Path("other/flight.mcap").read_bytes() == Path("out/flight.mcap").read_bytes()


# interrupted


def test_ctrl_c_closes_the_log_and_the_flight_can_be_compared(capsys: Printed, monkeypatch: pytest.MonkeyPatch) -> None:
    with monkeypatch.context() as press:
        press.setattr(Progress, "show", lambda *_, **__: signal.raise_signal(signal.SIGINT))
        assert run(*SHORT, "--out", "out") == 130
    assert capsys.readouterr().out.splitlines()[-1] == "INTERRUPTED at 1.000 s of flight"
    assert (summary()["outcome"], summary()["passed"]) == ("interrupted", False)
    log = maxq.read("out/flight.mcap")
    assert log.notes == ("the run was aborted: Interrupted: at 1.000 s",)
    assert log.time_s("altitude_m")[-1] == 0.99
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    assert run("--from", "out/flight.mcap") == 0
    assert "at 1.000 s, where that ends" in capsys.readouterr().out.splitlines()[-1]


def test_ctrl_c_before_the_flight_leaves_nothing(capsys: Printed, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(FlightRun, "__init__", interrupted)
    assert run(*SHORT) == 130
    assert capsys.readouterr().err == "simrun: interrupted before the flight began; nothing written\n"
    assert list(Path().iterdir()) == []


# bad input

WRONG = {
    "nothing to do": ([], "give a SCENARIO|CAMPAIGN, e.g. simrun nominal"),
    "two scenarios": (["nominal", "other"], "one SCENARIO at a time: what is 'other'?"),
    "misspelt option": (["--hlep"], "unknown option --hlep; did you mean --help?"),
    "unlike any option": (["nominal", "--bogus"], "unknown option --bogus; see"),
    "option without value": (["nominal", "--set"], "--set: expected one argument"),
    "no key": (["nominal", "--set", "foo"], "--set"),
    "unknown key": (["nominal", "--set", "run.stop=1"], "did you mean stop_at?"),
    "wrong type": (["nominal", "--set", "run.step_s=abc"], "allowed: a number"),
    "misspelt scenario": (["nominl"], "did you mean nominal?"),
    "no such file": (["nope.toml"], "nope.toml: no such file"),
    "a folder": (["."], "is a folder"),
    "binary": (["binary.toml"], "binary.toml: is not text"),
    "unknown metric": (
        ["nominal", "--set", 'requirement=[{metric="max_gimble_deg",limit=1}]'],
        "unknown metric; did you mean max_gimbal_deg?",
    ),
    "two orders": (["nominal", "--list"], "--list stands alone: simrun --list"),
    "scenario and log": (["nominal", "--from", "x.mcap"], "one LOG|DIR at a time: what is 'nominal'?"),
    "option of another order": (
        ["--list", "--out", "x"],
        "--out is an option of simrun fly, refly, campaign, merge, compare, calibrate or winds, not of simrun",
    ),
    "no log": (["--from", "nothing.mcap"], "nothing.mcap: the log cannot be read"),
    "not a log": (["--from", "binary.toml"], "binary.toml: this is not a log"),
    "copy of nothing": (["--copy", "nominl", "x"], "did you mean nominal?"),
    "copy without folder": (["--copy", "nominal"], "give a DIR, e.g. simrun copy nominal mine"),
    "empty folder name": ([*SHORT, "--out", ""], "--out needs the name of a folder"),
    "folder is a file": ([*SHORT, "--out", "binary.toml"], "binary.toml: is a file"),
    "folder below a file": ([*SHORT, "--out", "binary.toml/x"], "binary.toml: is a file"),
    "folder that cannot be made": ([*SHORT, "--out", "/proc/x/y"], "/proc/x/y: cannot be written"),
    "name too long": ([*SHORT, "--out", 300 * "x"], "cannot be written: file name too long"),
    "line end in a name": (["no\nsuch"], "no such file"),
}


@pytest.mark.parametrize("case", WRONG)
def test_bad_input_is_one_line_and_nothing_is_written(case: str, capsys: Printed) -> None:
    Path("binary.toml").write_bytes(b"\x00\xff\x00")
    arguments, wanted = WRONG[case]
    assert run(*arguments) == 2
    printed = capsys.readouterr()
    assert printed.out == ""
    assert printed.err.startswith("simrun: ")
    assert printed.err.count("\n") == 1
    assert wanted in printed.err
    assert "Traceback" not in printed.err
    assert [path.name for path in Path().iterdir()] == ["binary.toml"]


@pytest.mark.parametrize("name", ["flight.mcap", "summary.json"])
def test_a_folder_in_the_way_of_a_file(name: str, capsys: Printed) -> None:
    (Path("out") / name).mkdir(parents=True)
    assert run(*SHORT, "--out", "out") == 2
    assert f"out/{name}: " in capsys.readouterr().err
    assert [path.name for path in Path("out").iterdir()] == [name]


def test_folders_made_for_nothing_are_taken_away(monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object) -> None:
        raise LogError("out: no space left")

    monkeypatch.setattr(recording, "LogWriter", full)
    Path("there").mkdir()
    assert run(*SHORT, "--out", "there/new/newer") == 2
    assert list(Path("there").iterdir()) == []


def test_a_summary_of_another_flight_does_not_stay_beside_a_new_log() -> None:
    run(*SHORT, "--out", "out")
    loaded = load_scenario("nominal", ["run.duration_s=1.5"])
    seen = []
    record(FlightRun(loaded), Path("out"), watch=lambda _: seen.append(Path("out/summary.json").exists()))
    assert seen == [False, False]
    assert summary()["end_s"] == 1.5


def test_a_full_disk_is_one_line(capsys: Printed, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(self: object, *_: object) -> None:
        raise LogError("out/flight.mcap: the log cannot be written: No space left on device")

    monkeypatch.setattr(recording.LogWriter, "write_block", full)
    assert run(*SHORT, "--out", "out") == 2
    assert capsys.readouterr().err.count("\n") == 1
    assert not Path("out/summary.json").exists()
    assert "aborted" in maxq.read("out/flight.mcap").notes[0]


# built-in scenarios


def test_the_list_names_and_describes(capsys: Printed) -> None:
    assert run("--list") == 0
    lines = capsys.readouterr().out.splitlines()
    assert any(line.split()[:1] == ["nominal"] and "KSR-III" in line for line in lines)
    assert all(len(line.split()) > 1 for line in lines if line)


def test_a_copy_flies_the_same(capsys: Printed) -> None:
    assert run("--copy", "nominal", "mine") == 0
    assert capsys.readouterr().out == "copied; fly it with: simrun mine/nominal.toml\n"
    assert run("mine/nominal.toml", *SHORT[1:], "--out", "out", "--no-log") == 0
    assert run(*SHORT, "--out", "built-in", "--no-log") == 0
    assert summary()["state_hash"] == summary("built-in")["state_hash"]
    assert run("--copy", "nominal", "mine") == 2
    assert "not overwritten" in capsys.readouterr().err


def test_version(capsys: Printed) -> None:
    assert run("--version") == 0
    assert capsys.readouterr().out.startswith("maxq ")


@pytest.mark.parametrize("option", ["--help", "--list", "--version"])
def test_nothing_heavy_is_imported_without_need(option: str) -> None:
    code = (
        "import sys\nfrom maxq.tools.simrun import main\n"
        f"try:\n    main(['{option}'])\nexcept SystemExit:\n    pass\n"
        "print([m for m in ('numpy', 'numba', 'scipy', 'pydantic', 'rich', 'mcap') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True)
    assert done.stdout.splitlines()[-1] == "[]"


@pytest.mark.slow
def test_a_flight_needs_nothing_of_scipy() -> None:
    """A flight does not import SciPy, whose interpolators take longer to import than the flight."""
    code = (
        "import sys\nfrom maxq.tools.simrun import command\n"
        f"command.alone = True\ncommand.main({[*SHORT, '--no-log']})\n"
        "print([m for m in sys.modules if m.startswith(('scipy.interpolate', 'scipy.special', 'scipy.linalg'))])"
    )
    done = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True)
    assert done.stdout.splitlines()[-1] == "[]"


def test_a_fault_of_ours_has_its_own_exit_code_and_asks_for_a_report(
    capsys: Printed, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(*_: object, **__: object) -> int:
        raise ZeroDivisionError("two\nlines")

    monkeypatch.setattr("maxq.tools.simrun_fly.execute", broken)
    monkeypatch.delenv("MAXQ_TRACEBACK", raising=False)
    assert run("nominal") == 70
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("simrun: internal error: ZeroDivisionError: two lines (test_usage_simrun.py, line ")
    assert "please report it" in line
    assert "MAXQ_TRACEBACK" in line
    monkeypatch.setenv("MAXQ_TRACEBACK", "1")
    assert run("nominal") == 70
    lines = capsys.readouterr().err.splitlines()
    assert lines[0] == "Traceback (most recent call last):"
    assert lines[-1].startswith("simrun: internal error: ")


# the library


def test_a_flight_from_python_equals_the_one_in_the_log(tmp_path: Path) -> None:
    loaded = load_scenario("nominal", ["run.duration_s=0.1", "run.step_s=0.01"])  # short: it is flown uncompiled, too
    flight: Flight = fly(loaded)
    recorded = record(FlightRun(loaded), tmp_path / "out")
    log = maxq.read(tmp_path / "out" / "flight.mcap")
    assert flight.state_hash == recorded.state_hash
    assert log.table == flight.table
    for name in flight.table.names:
        np.testing.assert_array_equal(flight[name], log[name])
        np.testing.assert_array_equal(flight.time_s(name), log.time_s(name))
        assert flight.final[name] == flight[name][-1] or np.isnan(flight.final[name])


@pytest.mark.slow
def test_the_example_in_the_documentation_runs(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MPLBACKEND", "agg")
    page = (Path(__file__).resolve().parents[1] / "docs" / "python.md").read_text(encoding="utf-8")
    example = page.split("```python\n")[1].split("```")[0]
    assert len(example.splitlines()) <= 10
    code = compile(example, "docs/python.md", "exec")
    exec(code, {})
    shutil.rmtree("runs", ignore_errors=True)
