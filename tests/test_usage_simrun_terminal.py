"""`simrun` as a process handles terminals, pipes, signals and system limits."""

from __future__ import annotations

import json
import os
import pty
import resource
import select
import shlex
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

import maxq
from maxq.sim.run.fly import fly
from maxq.sim.scenario.loader import load_scenario

SIMRUN = [sys.executable, "-m", "maxq.tools.simrun"]
SHORT = ["nominal", "--set", "run.duration_s=1.5", "--set", "requirement="]
LONG = ["nominal", "--set", "run.step_s=0.00002", "--set", "requirement="]  # eleven million steps


@pytest.fixture(autouse=True)
def _in_an_empty_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


@pytest.fixture(scope="module", autouse=True)
def _compiled() -> None:
    """Compile the simulator in advance for all processes of these tests."""
    fly(load_scenario("nominal", ["run.duration_s=0.01"]), log=False)


def wait_for(path: Path, size: int, process: subprocess.Popen[str]) -> None:
    """Wait until a growing file has this size."""
    end = time.monotonic() + 60.0
    while not (path.exists() and path.stat().st_size > size):
        assert process.poll() is None, "ended by itself"
        assert time.monotonic() < end, "no log"
        time.sleep(0.02)


@pytest.mark.slow
def test_ctrl_c_ends_the_flight_soon_and_properly() -> None:
    process = subprocess.Popen(
        [*SIMRUN, *LONG, "--out", "out"], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    log_path = Path("out/flight.mcap")
    wait_for(log_path, 1_000_000, process)
    before = time.monotonic()
    process.send_signal(signal.SIGINT)
    out, err = process.communicate(timeout=60.0)
    took_s = time.monotonic() - before
    assert process.returncode == 130
    assert err == ""
    told = json.loads(Path("out/summary.json").read_text())
    assert told["outcome"] == "interrupted"
    assert out.splitlines()[-1] == f"INTERRUPTED at {told['end_s']:.3f} s of flight"
    log = maxq.read(log_path)
    assert log.notes == (f"the run was aborted: Interrupted: at {told['end_s']:.3f} s",)
    assert log.time_s("mach")[-1] == pytest.approx(told["end_s"], abs=0.0101)
    assert took_s < 3.0  # a segment, the summary and the end of the process, on a busy machine


@pytest.mark.slow
def test_a_killed_flight_leaves_a_log_that_can_be_read() -> None:
    process = subprocess.Popen(
        [*SIMRUN, *LONG, "--out", "out"], stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True
    )
    wait_for(Path("out/flight.mcap"), 1_500_000, process)
    process.kill()
    process.wait()
    log = maxq.read("out/flight.mcap")
    assert not log.complete
    assert len(log["mach"]) >= 100
    assert not Path("out/summary.json").exists()


@pytest.mark.slow
def test_into_a_pipe_there_is_plain_text_only() -> None:
    """Letters that the encoding of the pipe lacks are replaced."""
    command = [*SIMRUN, *SHORT, "--out", "out", "--set", "description=Überflug"]
    environment = os.environ | {"PYTHONIOENCODING": "ascii"}
    done = subprocess.run(command, check=True, capture_output=True, env=environment)
    assert done.stderr == b""
    assert all(byte >= 0x20 or byte == 0x0A for byte in done.stdout)
    lines = done.stdout.splitlines(keepends=True)
    assert (lines[0], lines[-1]) == (b"nominal: ?berflug\n", b"PASSED: no requirements\n")


@pytest.mark.slow
def test_a_reader_that_leaves_early_sees_no_traceback() -> None:
    reading, writing = os.pipe()
    os.close(reading)
    done = subprocess.run(
        [*SIMRUN, *SHORT, "--out", "out"], stdout=writing, stderr=subprocess.PIPE, text=True, check=False
    )
    os.close(writing)
    assert done.stderr == ""
    assert Path("out/summary.json").exists()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("arguments", "code"),
    [
        ([*SHORT, "--no-log", "--set", 'requirement=[{metric="max_speed_mps",limit=1}]'], 1),
        (["nominla"], 2),
        (["--nolog"], 2),
        (["--list"], 0),
    ],
)
def test_the_process_ends_with_the_commands_exit_code_and_all_its_words(arguments: list[str], code: int) -> None:
    """The quick exit of the process (tools/simrun.py, `command`) loses no output and keeps the exit code."""
    simrun = Path(sys.executable).with_name("simrun")
    for how in ([str(simrun)], SIMRUN):
        done = subprocess.run([*how, *arguments], capture_output=True, text=True, check=False)
        assert done.returncode == code, done.stderr
        assert done.stdout.endswith("\n") if code < 2 else done.stderr.count("\n") == 1


def test_a_reader_that_leaves_before_the_end_changes_nothing_on_stderr() -> None:
    done = subprocess.run(
        f"{shlex.join([*SIMRUN, '--list'])} | head -n 1", shell=True, capture_output=True, text=True, check=False
    )
    assert done.stderr == ""
    assert len(done.stdout.splitlines()) == 1


def on_a_terminal(arguments: list[str]) -> tuple[str, int]:
    """Return the terminal output of a command, and its exit code."""
    ours, theirs = pty.openpty()
    process = subprocess.Popen(
        [*SIMRUN, *arguments], stdin=theirs, stdout=theirs, stderr=theirs, env=os.environ | {"TERM": "xterm"}
    )
    os.close(theirs)
    shown = b""
    while True:
        select.select([ours], [], [], 120.0)
        try:
            piece = os.read(ours, 65536)
        except OSError:  # Linux's way of saying that the other side is closed
            break
        if not piece:
            break
        shown += piece
    os.close(ours)
    return shown.decode(), process.wait()


@pytest.mark.slow
def test_a_long_flight_shows_its_progress_on_a_terminal() -> None:
    steps = ["--set", "run.step_s=0.00005", "--set", "run.duration_s=30.0"]
    shown, code = on_a_terminal([*SHORT, *steps, "--no-log"])
    assert code == 0
    assert " s of at most 30 s" in shown
    assert shown.rindex("of at most 30 s") < shown.index("events")
    assert shown.rstrip().splitlines()[-1] == "\x1b[32mPASSED\x1b[0m: no requirements"


@pytest.mark.slow
def test_a_short_flight_shows_none() -> None:
    shown, code = on_a_terminal([*SHORT, "--no-log"])
    assert code == 0
    assert "at most" not in shown


@pytest.mark.slow
def test_a_full_disk_is_one_line_and_the_log_is_readable() -> None:
    def little_room() -> None:
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        resource.setrlimit(resource.RLIMIT_FSIZE, (2_000_000, 2_000_000))

    done = subprocess.run(
        [*SIMRUN, "nominal", "--set", "run.duration_s=20.0", "--out", "out"],
        preexec_fn=little_room,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 2
    assert done.stderr == "simrun: out/flight.mcap: the log cannot be written: File too large\n"
    assert done.stdout == ""
    assert not Path("out/summary.json").exists()
    assert len(maxq.read("out/flight.mcap")["mach"]) > 100
