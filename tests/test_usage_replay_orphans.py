"""No viewer outlives the command that started it, even after SIGKILL."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import psutil
import pytest
from replaykit import OLD_LOG, free_port

from maxq.tools.replay import viewer

PATIENCE_S = 60.0
QUICK = (("screenshot", signal.SIGKILL), ("web", signal.SIGINT))
"""Each way and each signal once."""

pytestmark = pytest.mark.skipif(
    not sys.platform.startswith("linux"), reason="only Linux kills a child whose parent was killed"
)


def viewers_of(process: subprocess.Popen[bytes]) -> list[psutil.Process]:
    """Return the viewers of a process. Wait for them, and fail if the process ends without any."""
    deadline = time.monotonic() + PATIENCE_S
    while time.monotonic() < deadline and process.poll() is None:
        if found := [c for c in psutil.Process(process.pid).children(recursive=True) if is_viewer(c)]:
            return found
        time.sleep(0.01)
    raise AssertionError("no viewer was started")


def is_viewer(process: psutil.Process) -> bool:
    """Return True for the viewer, but not for its short set-up process."""
    try:
        return process.name().startswith("rerun") and "--bind" in process.cmdline()
    except psutil.Error:
        return False


def gone(processes: list[psutil.Process]) -> bool:
    _, alive = psutil.wait_procs(processes, timeout=10.0)
    return not alive


@pytest.mark.slow
@pytest.mark.parametrize(
    ("way", "by"),
    [
        pytest.param(way, by, id=f"{way}-{by.name}", marks=[] if (way, by) in QUICK else pytest.mark.long)
        for way in ("screenshot", "web")
        for by in (signal.SIGKILL, signal.SIGTERM, signal.SIGINT)
    ],
)
def test_a_viewer_ends_with_its_command(way: str, by: signal.Signals, tmp_path: Path) -> None:
    options = {"screenshot": ["--screenshot", str(tmp_path / "a.png"), "--at", "3"], "web": ["--web", "--port"]}[way]
    if way == "web":
        options.append(str(free_port()))
    command = [sys.executable, "-m", "maxq.tools.simreplay", str(OLD_LOG), *options]
    env = os.environ | {"TMPDIR": str(tmp_path)}
    with subprocess.Popen(command, env=env, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as process:
        viewers = viewers_of(process)
        process.send_signal(by)
        try:
            process.wait(timeout=PATIENCE_S)
        finally:
            process.kill()  # one that goes on would keep the test waiting
        assert gone(viewers), f"{viewers} outlived {by.name} of its command"
    if by != signal.SIGKILL:
        assert [path.name for path in tmp_path.glob("maxq-replay-*")] == [], "a temporary folder was left"


def test_a_viewer_ends_with_a_killed_test() -> None:
    """A viewer ends when pytest is killed inside a `with` block."""
    code = "import time; from maxq.tools.replay import viewer\nwith viewer.headless(): time.sleep(600)"
    with subprocess.Popen([sys.executable, "-c", code]) as process:
        viewers = viewers_of(process)
        process.kill()
        process.wait()
        assert gone(viewers)


def test_a_viewer_ends_with_its_block() -> None:
    def fail() -> None:
        with viewer.headless():
            running.extend(c for c in psutil.Process().children() if is_viewer(c))
            raise ZeroDivisionError

    running: list[psutil.Process] = []
    with pytest.raises(ZeroDivisionError):
        fail()
    assert running
    assert gone(running)
