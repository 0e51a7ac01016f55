"""The common behaviour of all commands: help, exit codes, errors on one line."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Callable

import pytest

from maxq import ScenarioError
from maxq.tools import simdesign, simreplay, simrun, simvehicle, simverify
from maxq.tools.cli import frame
from maxq.tools.cli.frame import CommandError, Interruption
from maxq.tools.cli.terminal import Progress

Printed = pytest.CaptureFixture[str]
COMMANDS = {
    "simrun": simrun,
    "simdesign": simdesign,
    "simverify": simverify,
    "simreplay": simreplay,
    "simvehicle": simvehicle,
}


@pytest.mark.parametrize("name", COMMANDS)
def test_help_lists_every_exit_code(name: str, capsys: Printed) -> None:
    with pytest.raises(SystemExit) as end:
        COMMANDS[name].main(["--help"])
    assert end.value.code == 0
    text = capsys.readouterr().out
    assert all(f"\n  {code:>3}  " in text for code in (0, 1, 2, 70, 130))


@pytest.mark.parametrize("name", COMMANDS)
def test_wrong_options_are_one_line(name: str, capsys: Printed) -> None:
    with pytest.raises(SystemExit) as end:
        COMMANDS[name].main(["--hlep"])
    assert end.value.code == 2
    assert capsys.readouterr().err == f"{name}: unknown option --hlep; did you mean --help? See {name} --help\n"


def raising(error: BaseException) -> Callable[[], int]:
    def body() -> int:
        raise error

    return body


@pytest.mark.parametrize(
    ("error", "code", "says"),
    [
        (ScenarioError("a.toml", "is wrong", "x.y"), 2, "a.toml: x.y: is wrong"),
        (CommandError("no viewer\nis there"), 2, "no viewer is there"),
        (MemoryError(), 2, "not enough memory; fly less"),
        (PermissionError(13, "Permission denied", "out/x"), 2, "out/x: permission denied"),
        (ModuleNotFoundError("No module named 'rerun'", name="rerun"), 2, "a package is missing or broken: "),
        (ImportError("cannot import name 'x'", name="maxq.sim"), 70, "internal error: ImportError: "),
        (ZeroDivisionError("two\nlines"), 70, "internal error: ZeroDivisionError: two lines (test_usage_commands.py, "),
        (KeyboardInterrupt(), 130, "stopped; nothing written"),
    ],
    ids=lambda value: type(value).__name__ if isinstance(value, BaseException) else "",
)
def test_every_error_is_one_line_with_its_exit_code(
    error: BaseException, code: int, says: str, capsys: Printed, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("MAXQ_TRACEBACK", raising=False)
    assert frame.run("sim", raising(error), "stopped; nothing written", "fly less") == code
    out, err = capsys.readouterr()
    assert (out, err.count("\n")) == ("", 1)
    assert err.startswith(f"sim: {says}")
    assert ("MAXQ_TRACEBACK" in err) == (code == 70)


def test_the_traceback_is_shown_on_request(capsys: Printed, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MAXQ_TRACEBACK", "1")
    assert frame.run("sim", raising(ZeroDivisionError())) == 70
    assert capsys.readouterr().err.startswith("Traceback (most recent call last):")


@pytest.mark.parametrize(
    "number", [getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)]
)
def test_the_first_signal_is_a_request_the_second_interrupts(number: signal.Signals) -> None:
    ignored = signal.getsignal(number) == signal.SIG_IGN  # SIGHUP under nohup, which the commands leave alone
    if ignored:
        signal.signal(number, signal.SIG_DFL)
    before = signal.getsignal(number)
    with Interruption() as interruption:
        signal.raise_signal(number)
        assert interruption.requested
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(number)
    after = signal.getsignal(number)
    if ignored:
        signal.signal(number, signal.SIG_IGN)
    assert after is before


def test_sigterm_ends_a_process_like_ctrl_c() -> None:
    code = (
        "import os, signal\nfrom maxq.tools.cli.frame import process, run\n"
        "process(lambda: run('sim', lambda: os.kill(os.getpid(), signal.SIGTERM), 'stopped'))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False, env=os.environ)
    assert (done.returncode, done.stdout, done.stderr) == (130, "", "sim: stopped\n")


def test_progress_is_silent_without_a_terminal_unless_lines_are_wanted(capsys: Printed) -> None:
    with Progress() as quiet, Progress(log_every_s=0.0) as lines:
        quiet.show("flying", 1, 2)
        lines.show("flying", 1, 2, "12 left")
    assert capsys.readouterr().err == "flying: 1 of 2; 12 left\n"


def _ended_by(number: signal.Signals, ignored: bool) -> tuple[int, str]:
    """Return the exit code and the output of a forked command that receives a signal after its terminal has closed."""
    controller, terminal = os.openpty()
    read, write = os.pipe()
    child = os.fork()
    if child == 0:
        os.setsid()
        os.dup2(terminal, 1)
        os.dup2(write, 2)
        for stream in (controller, terminal, read, write):
            os.close(stream)
        signal.signal(number, signal.SIG_IGN if ignored else signal.SIG_DFL)
        sys.stdout, sys.stderr = open(1, "w", closefd=False), open(2, "w", closefd=False)  # noqa: SIM115  # to the end

        def body() -> int:
            with Interruption() as stop:
                signal.raise_signal(number)
                print("a summary", flush=True)  # fails on a closed terminal
            return 130 if stop.requested else 0

        frame.process(lambda: frame.run("sim", body, "stopped"))
    for stream in (terminal, controller, write):
        os.close(stream)
    with open(read) as said:
        text = said.read()
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]), text


def test_a_closed_terminal_ends_a_command_in_an_orderly_way_unless_it_is_ignored() -> None:
    """SIGHUP ends a command as Ctrl-C does. With `nohup`, which ignores it, the command runs on."""
    assert _ended_by(signal.SIGHUP, ignored=False) == (130, "")
    code, said = _ended_by(signal.SIGHUP, ignored=True)
    assert (code, said.strip()) == (2, "sim: a file: input/output error")  # no terminal, and no file in its place


def test_a_job_of_the_shell_ignores_ctrl_c() -> None:
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        with Interruption() as interruption:
            signal.raise_signal(signal.SIGINT)
            assert not interruption.requested
    finally:
        signal.signal(signal.SIGINT, before)
