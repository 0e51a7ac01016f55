"""The Rerun viewer as a program of its own: on the desktop, in a browser, or without any display.

It listens on 127.0.0.1 only and reports nothing to anyone: it is run with a configuration folder of our own, in which
its collection of usage data is switched off.
"""

from __future__ import annotations

import contextlib
import functools
import importlib.util
import os
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING

from maxq.tools.replay.error import ReplayError
from maxq.tools.replay.viewer_process import bound_process, end, run_bound
from maxq.tools.replay.web_page import LOCAL, LocalPage

if TYPE_CHECKING:
    from rerun.experimental import ViewerClient

WINDOW = "1920x1080"
_START_S, _STEADY_S = 30.0, 120.0
_LAYOUTS, _LAYOUT_S = 10, 0.02
_INSTALL = "pip install 'rerun-sdk==0.41.*'"


def executable() -> Path:
    """The viewer that came with the Python package. Raises ReplayError where it is missing."""
    found = importlib.util.find_spec("rerun_cli")
    folders = list(found.submodule_search_locations or []) if found is not None else []
    for folder in folders:
        for name in ("rerun", "rerun.exe"):
            if (Path(folder) / name).is_file():
                return Path(folder) / name
    raise ReplayError(f"the Rerun viewer is missing; install it with: {_INSTALL}")


def environment() -> dict[str, str]:
    """Environment of the viewer: no usage data, no chatter, a run-time folder even where there is none."""
    env = dict(os.environ)
    env.setdefault("RUST_LOG", "error")
    if sys.platform.startswith("linux"):
        if not env.get("XDG_RUNTIME_DIR"):
            env["XDG_RUNTIME_DIR"] = tempfile.gettempdir()
        env["XDG_CONFIG_HOME"] = str(_own_config())
    _switch_off_analytics(env)
    return env


def _own_config() -> Path:
    """Beside the kernels of `control/kernel/jit.py`, a module that takes a quarter of a second to load."""
    user = os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")
    folder = Path(os.environ.get("MAXQ_CACHE") or os.path.join(user, "maxq")) / "viewer"
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError:
        folder = Path(tempfile.mkdtemp(prefix="maxq-viewer-"))
    return folder


def _switch_off_analytics(env: dict[str, str]) -> None:
    done = Path(env.get("XDG_CONFIG_HOME", tempfile.gettempdir())) / "rerun" / "analytics.json"
    if done.is_file() and '"analytics_enabled": false' in done.read_text(encoding="utf-8"):
        return
    command = [str(executable()), "analytics", "disable"]
    try:
        subprocess.run(command, env=env, check=False, timeout=10, capture_output=True)
    except (OSError, subprocess.TimeoutExpired) as error:
        raise ReplayError(f"the Rerun viewer cannot be run: {error}") from error


def port_is_free(port: int) -> bool:
    with socket.socket() as probe:
        if sys.platform != "win32":
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((LOCAL, port))
        except OSError:
            return False
    return True


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind((LOCAL, 0))
        return int(probe.getsockname()[1])


def check_port(port: int) -> None:
    """Raise ReplayError where someone else listens already."""
    if not 0 < port < 65536:
        raise ReplayError(f"--port {port}: a port is a number from 1 to 65535")
    if not port_is_free(port):
        raise ReplayError(f"port {port} is in use on {LOCAL}; choose another one with --port")


def check_display() -> None:
    """Raise ReplayError where no window can be opened."""
    if sys.platform.startswith("linux") and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        raise ReplayError(
            "there is no display to open a window on; use --web (then open the address in a browser), "
            "--screenshot FILE --at S, --plots DIR or --summary"
        )


def show(rrd: Path) -> int:
    """Open a recording in a window and wait until it is closed; returns the viewer's exit code."""
    command = [str(executable()), str(rrd), "--bind", LOCAL, "--port", str(free_port())]
    return run_bound([*command, "--hide-welcome-screen"], environment())


def window(port: int) -> subprocess.Popen[bytes]:
    """A window that waits for a flight on `port`; it stays open when we are gone. Raises ReplayError."""
    command = [str(executable()), "--bind", LOCAL, "--port", str(port), "--hide-welcome-screen", "--expect-data-soon"]
    process = subprocess.Popen(
        command, env=environment(), stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, start_new_session=True
    )
    _wait_for(process, port)
    return process


@contextlib.contextmanager
def served(rrd: Path, port: int) -> Iterator[tuple[subprocess.Popen[bytes], str]]:
    """Serve a recording to browsers of this machine; gives the server, which answers already, and the address.

    Raises ReplayError where it cannot be started.
    """
    grpc, inner = free_port(), free_port()
    command = [str(executable()), str(rrd), "--serve-web", "--bind", LOCAL]
    command += ["--web-viewer-port", str(inner), "--port", str(grpc)]
    server = bound_process(command, environment())
    page = None
    try:
        _wait_for(server, inner)
        _wait_for(server, grpc)
        page = LocalPage(port, inner, grpc)
        yield server, f"http://{LOCAL}:{port}/?url=rerun%2Bhttp%3A%2F%2F{LOCAL}%3A{grpc}%2Fproxy"
    finally:
        if page is not None:
            page.close()
        end(server)


def _wait_for(process: subprocess.Popen[bytes], port: int) -> None:
    deadline = time.monotonic() + _START_S
    while time.monotonic() < deadline:
        if process.poll() is not None:
            raise ReplayError(f"the Rerun viewer has stopped at once: {_last_words(process)}")
        with socket.socket() as probe:
            probe.settimeout(1.0)
            if probe.connect_ex((LOCAL, port)) == 0:
                return
        time.sleep(0.02)
    process.terminate()
    raise ReplayError(f"the Rerun viewer does not answer on port {port}")


def _last_words(process: subprocess.Popen[bytes]) -> str:
    said = process.stderr.read().decode(errors="replace") if process.stderr is not None else ""
    if "wgpu" in said or "adapter" in said.lower() or "graphics" in said.lower():
        return _NO_DRIVER
    lines = [line.strip() for line in said.splitlines() if line.strip()]
    error = next((line for line in lines if line.startswith("Error:")), lines[-1] if lines else "without a word")
    return error[:300]


_NO_DRIVER = (
    "no driver to draw with; where there is no graphics card, install software Vulkan "
    "(Debian, Ubuntu: apt install mesa-vulkan-drivers)"
)


class Headless:
    """A viewer without a window. It starts at once, and beside whatever the caller does before `client`.

    Ends with its block, and with the thread that made it. Raises ReplayError where it cannot run.
    """

    def __init__(self, window: str = WINDOW) -> None:
        self._port = free_port()
        command = [str(executable()), "--headless", "--bind", LOCAL, "--port", str(self._port)]
        command += ["--window-size", window, "--hide-welcome-screen"]
        self._process = bound_process(command, environment())

    def __enter__(self) -> Headless:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            if isinstance(error, RuntimeError | ConnectionError | TimeoutError):
                raise self._explained(error) from error
        finally:
            end(self._process)

    @functools.cached_property
    def client(self) -> ViewerClient:
        """Drives it; waits until it answers."""
        from rerun.experimental import ViewerClient  # noqa: PLC0415  # lazy: a quarter of a second

        _wait_for(self._process, self._port)
        return ViewerClient.connect(f"rerun+http://{LOCAL}:{self._port}/proxy")

    def _explained(self, error: BaseException) -> ReplayError:
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(timeout=2)  # the connection breaks before the program has ended
        if self._process.returncode is not None:
            return ReplayError(f"the Rerun viewer has stopped: {_last_words(self._process)}")
        return ReplayError(f"the Rerun viewer does not do as it is told: {error}")


@contextlib.contextmanager
def headless(window: str = WINDOW) -> Iterator[ViewerClient]:
    """A viewer without a window, to be driven. Raises ReplayError where it cannot run."""
    with Headless(window) as viewer:
        yield viewer.client


def steady_picture(viewer: ViewerClient, view_id: str | None = None) -> bytes:
    """A PNG once two pictures in a row are equal and everything is loaded. Raises ReplayError if that never happens.

    Painting takes half a second without a graphics card. What views need is fetched when they are laid out for the
    first time, painted or not, and each question after the viewer's state lays them out: so it is asked a few times
    before the first picture, which then is the last but one as a rule.
    """
    for _ in range(_LAYOUTS):
        viewer.get_state()
        time.sleep(_LAYOUT_S)
    deadline = time.monotonic() + _STEADY_S
    last = b""
    while time.monotonic() < deadline:
        try:
            picture = viewer.take_screenshot(view_id)
        except TimeoutError:  # the client waits 15 s: too short for a hundred flights on a busy machine
            continue
        if picture == last and not viewer.get_state().loading:
            return picture
        last = picture
    raise ReplayError("the picture does not come to rest")


def open_whole(viewer: ViewerClient, rrd: Path) -> None:
    """Open a recording and wait until it is there. Raises ReplayError if that never happens."""
    viewer.open(str(rrd.resolve()))
    deadline = time.monotonic() + _STEADY_S
    while time.monotonic() < deadline:
        state = viewer.get_state()
        if not state.loading and any(recording.timelines for recording in state.recordings):
            return
        time.sleep(_LAYOUT_S)
    raise ReplayError("the viewer does not finish loading")


def pictures(viewer: Headless, rrd: Path, times_s: Sequence[float]) -> tuple[list[bytes], list[str]]:
    """Pictures (PNG) of the whole window at these times, and what views complained of."""
    client = viewer.client
    open_whole(client, rrd)
    shots, complaints = [], []
    for time_s in times_s:
        client.set_time("sim_time", duration=time_s, play_state="paused")
        shots.append(steady_picture(client))
        complaints += complaints_of(client)
    return shots, list(dict.fromkeys(complaints))


def complaints_of(viewer: ViewerClient) -> list[str]:
    """What the views of the viewer report: a mapping that is broken, data that cannot be drawn."""
    return [
        f"{view.name}: {report.severity}: {report.summary}{f' ({report.details})' if report.details else ''}"
        for view in viewer.get_state().views
        for report in view.reports
    ]
