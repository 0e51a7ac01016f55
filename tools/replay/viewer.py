"""The Rerun viewer as a separate program: on the desktop, in a browser, or without a display.

The viewer listens on 127.0.0.1 only. It runs with a separate configuration folder in which the collection of usage data
is disabled. A viewer without a window that outlives its command would occupy memory and a port unnoticed. `finally`
ends it, except after SIGKILL; in that case, Linux kills the child. On other systems, a parent that is killed leaves its
viewer running.
"""

from __future__ import annotations

import contextlib
import functools
import http.client
import importlib.metadata
import importlib.util
import os
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import TYPE_CHECKING, Any

from maxq.control.kernel.machine import own_cache
from maxq.tools.cli import system
from maxq.tools.cli.frame import CommandError
from maxq.tools.cli.system import linux_function

if TYPE_CHECKING:
    from maxq.tools.replay.viewer_control import ViewerControl

LOCAL = "127.0.0.1"
WINDOW = "1920x1080"
_START_S, _STEADY_S, _END_S = 30.0, 120.0, 5.0
_LAYOUTS, _LAYOUT_S = 10, 0.02
_NO_DRIVER = (
    "no driver to draw with; where there is no graphics card, install software Vulkan "
    "(Debian, Ubuntu: apt install mesa-vulkan-drivers)"
)
_SET_PARENT_DEATH_SIGNAL = 1  # PR_SET_PDEATHSIG of <linux/prctl.h>
_KEPT_HEADERS = ("content-type", "content-encoding", "cache-control", "etag")


class ReplayError(CommandError):
    """An error that prevents the display of flights. Its text gives the reason and the remedy."""


def check_installed() -> None:
    """Raise ReplayError if rerun-sdk is not installed. No other part of maxq needs it."""
    if importlib.util.find_spec("rerun") is None:
        raise _not_installed()


def executable() -> Path:
    """Return the path of the viewer's program in the Python package. Raises ReplayError if it is missing."""
    found = importlib.util.find_spec("rerun_cli")
    for folder in (found.submodule_search_locations or ()) if found is not None else ():
        for path in (Path(folder) / "rerun", Path(folder) / "rerun.exe"):
            if path.is_file():
                return path
    raise _not_installed()


def _not_installed() -> ReplayError:
    """Return the error for a missing viewer, which states the versions that this installation of maxq requires."""
    wanted = next(line for line in importlib.metadata.requires("maxq") or () if line.startswith("rerun-sdk"))
    return ReplayError(f"the Rerun viewer is not installed; install it with: pip install '{wanted}'")


def environment() -> dict[str, str]:
    """Return the environment of the viewer: without usage data and log output, and with a run-time folder.

    Raises ReplayError if the viewer cannot be run.
    """
    env = dict(os.environ)
    env.setdefault("RUST_LOG", "error")
    if system.LINUX:
        if not env.get("XDG_RUNTIME_DIR"):
            env["XDG_RUNTIME_DIR"] = tempfile.gettempdir()
        env["XDG_CONFIG_HOME"] = str(_own_config())
    done = Path(env.get("XDG_CONFIG_HOME", tempfile.gettempdir())) / "rerun" / "analytics.json"
    if done.is_file() and '"analytics_enabled": false' in done.read_text(encoding="utf-8"):
        return env
    command = [str(executable()), "analytics", "disable"]
    try:
        subprocess.run(command, env=env, check=False, timeout=10, capture_output=True)
    except (OSError, subprocess.TimeoutExpired) as error:
        raise ReplayError(f"the Rerun viewer cannot be run: {error}") from error
    return env


def _own_config() -> Path:
    """Return the viewer's configuration folder in the cache folder of maxq, or else a temporary one."""
    with contextlib.suppress(OSError):  # also for a folder that others may write to
        folder = own_cache("viewer")
        if os.access(folder, os.W_OK):
            return folder
    return Path(tempfile.mkdtemp(prefix="maxq-viewer-"))


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
    """Raise ReplayError if the port is not valid or if another program listens on it."""
    if not 0 < port < 65536:
        raise ReplayError(f"--port {port}: a port is a number from 1 to 65535")
    if not port_is_free(port):
        raise ReplayError(f"port {port} is in use on {LOCAL}; choose another one with --port")


def check_display() -> None:
    """Raise ReplayError if no window can be opened."""
    if system.LINUX and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        raise ReplayError(
            "there is no display to open a window on; use --web (then open the address in a browser), "
            "--screenshot FILE --at S, --plots DIR or --summary"
        )


# -- processes -------------------------------------------------------------------------------------------------------
def _bind_to(parent: int) -> Callable[[], None] | None:
    """Return a function for a child to run between fork and exec, so that Linux kills it with its parent; None
    elsewhere.

    prctl is looked up in advance, since few calls are safe between fork and exec.
    """
    if (prctl := linux_function("prctl")) is None:
        return None

    def bind() -> None:
        prctl(_SET_PARENT_DEATH_SIGNAL, signal.SIGKILL)
        if os.getppid() != parent:  # the parent has ended in the meantime
            os._exit(1)

    return bind


@contextlib.contextmanager
def _viewer(*options: str, quiet: bool = True) -> Iterator[subprocess.Popen[bytes]]:
    """Run a viewer with these options. It ends with the block, the calling thread or its process.

    With `quiet`, its stderr can be read; otherwise its output goes to that of the command. Raises ReplayError and
    OSError.
    """
    process = subprocess.Popen(
        [str(executable()), *options, "--bind", LOCAL],
        env=environment(),
        stdout=subprocess.DEVNULL if quiet else None,
        stderr=subprocess.PIPE if quiet else None,
        preexec_fn=_bind_to(os.getpid()),  # noqa: PLW1509  # calls C only and takes no lock
    )
    try:
        yield process
    finally:
        process.terminate()
        try:
            process.wait(timeout=_END_S)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
        if process.stderr is not None:
            process.stderr.close()


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
    if any(word in said.lower() for word in ("wgpu", "adapter", "graphics", "render context")):
        return _NO_DRIVER
    lines = [line.strip() for line in said.splitlines() if line.strip()]
    error = next((line for line in lines if line.startswith("Error:")), lines[-1] if lines else "without a message")
    return error[:300]


# -- ways to show something ------------------------------------------------------------------------------------------
def show(rrd: Path) -> None:
    """Open a recording in a window and wait until the window is closed. Raises ReplayError if the viewer fails."""
    with _viewer(str(rrd), "--port", str(free_port()), "--hide-welcome-screen", quiet=False) as process:
        if code := process.wait():
            raise ReplayError(f"the Rerun viewer ended with code {code}; --web or --screenshot may do instead")


def listening(port: int | None) -> int | None:
    """Return `port` if a viewer listens on it, or None if a new window (`port` None) can be opened.

    Raises ReplayError otherwise.
    """
    if port is None:
        executable()
        check_display()
    elif port_is_free(port):
        raise ReplayError(f"no viewer listens on port {port} of {LOCAL}")
    return port


def window(port: int) -> subprocess.Popen[bytes]:
    """Open a window that waits for a flight on `port`, and return its process. It stays open after the command ends.

    Raises ReplayError.
    """
    command = [str(executable()), "--bind", LOCAL, "--port", str(port), "--hide-welcome-screen", "--expect-data-soon"]
    process = subprocess.Popen(
        command, env=environment(), stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, start_new_session=True
    )
    _wait_for(process, port)
    return process


@contextlib.contextmanager
def served(rrd: Path, port: int) -> Iterator[tuple[subprocess.Popen[bytes], str]]:
    """Serve a recording to browsers of this machine. Yield the process of the server, which is ready, and the address.

    Raises ReplayError if it cannot be started.
    """
    grpc, inner = free_port(), free_port()
    options = ("--serve-web", "--web-viewer-port", str(inner), "--port", str(grpc))
    with _viewer(str(rrd), *options) as server:
        _wait_for(server, inner)
        _wait_for(server, grpc)
        with _local_page(port, inner, grpc):
            yield server, f"http://{LOCAL}:{port}/?url=rerun%2Bhttp%3A%2F%2F{LOCAL}%3A{grpc}%2Fproxy"


@contextlib.contextmanager
def _local_page(port: int, inner_port: int, grpc_port: int) -> Iterator[None]:
    """Serve the page of the viewer's server on `port` to this machine alone. `inner_port` is that of the viewer's
    server.

    The viewer's page would request a font from other machines, and notify its makers that it was opened. Here it is
    sent with a content security policy that only allows its own scripts and the flight from `grpc_port`.
    """
    here = "'self' data: blob:"
    policy = (
        f"default-src {here}; script-src {here} 'unsafe-inline' 'wasm-unsafe-eval'; style-src {here} 'unsafe-inline'; "
        f"connect-src {here} http://{LOCAL}:{grpc_port}"
    )

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            connection = http.client.HTTPConnection(LOCAL, inner_port, timeout=30)
            try:
                connection.request("GET", self.path, headers={"Accept-Encoding": "identity"})
                answer = connection.getresponse()
                body = answer.read()
            except OSError:
                self.send_error(502, "the viewer's server does not answer")
                return
            finally:
                connection.close()
            self.send_response(answer.status)
            for name, value in answer.getheaders():
                if name.lower() in _KEPT_HEADERS:
                    self.send_header(name, value)
            self.send_header("Content-Length", str(len(body)))
            self.send_header("Content-Security-Policy", policy)
            self.send_header("Referrer-Policy", "no-referrer")
            self.end_headers()
            self.wfile.write(body)

        def log_message(self, format: str, *args: Any) -> None:  # its name in the base class
            """Suppress the message."""

    with ThreadingHTTPServer((LOCAL, port), Handler) as server:
        server.daemon_threads = True
        threading.Thread(target=server.serve_forever, name="page", daemon=True).start()
        try:
            yield
        finally:
            server.shutdown()


@contextlib.contextmanager
def headless(window: str = WINDOW) -> Iterator[Callable[[], ViewerControl]]:
    """Run a viewer without a window. It starts immediately, and ends with the block and the calling thread.

    Yield a function that waits until the viewer responds and returns its control. Raises ReplayError if the viewer
    fails.
    """
    port = free_port()
    options = ("--headless", "--port", str(port), "--window-size", window, "--hide-welcome-screen")
    with _viewer(*options) as process:

        @functools.cache
        def client() -> ViewerControl:
            from maxq.tools.replay.viewer_control import ViewerControl  # noqa: PLC0415  # lazy: loads rerun

            _wait_for(process, port)
            return ViewerControl(f"rerun+http://{LOCAL}:{port}/proxy")

        try:
            yield client
        except (RuntimeError, ConnectionError, TimeoutError) as error:
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(timeout=2)  # the connection breaks before the program ends
            if process.returncode is not None:
                raise ReplayError(f"the Rerun viewer has stopped: {_last_words(process)}") from error
            raise ReplayError(f"the Rerun viewer does not answer as expected: {error}") from error


def steady_picture(viewer: ViewerControl, view_id: str | None = None) -> bytes:
    """Return a PNG once two successive pictures are equal and all data are loaded.

    Painting takes half a second without a graphics card. The data of a view are fetched at its first layout, and each
    query of the viewer's state causes a layout without painting. Therefore, the state is queried a few times before the
    first picture, so that usually two pictures suffice. Raises ReplayError if the picture does not settle.
    """
    for _ in range(_LAYOUTS):
        viewer.get_state()
        time.sleep(_LAYOUT_S)
    deadline = time.monotonic() + _STEADY_S
    last = b""
    while time.monotonic() < deadline:
        try:
            picture = viewer.take_screenshot(view_id)
        except TimeoutError:  # the client waits for 15 s, too short for a hundred flights on a busy machine
            continue
        if picture == last and not viewer.get_state().loading:
            return picture
        last = picture
    raise ReplayError(f"the picture did not settle within {_STEADY_S:g} s")


def open_whole(viewer: ViewerControl, rrd: Path) -> None:
    """Open a recording and wait until it is loaded. Raises ReplayError if it does not load within two minutes."""
    viewer.open(str(rrd.resolve()))
    deadline = time.monotonic() + _STEADY_S
    while time.monotonic() < deadline:
        state = viewer.get_state()
        if not state.loading and any(recording.timelines for recording in state.recordings):
            return
        time.sleep(_LAYOUT_S)
    raise ReplayError(f"the viewer did not finish loading within {_STEADY_S:g} s")


def pictures(client: ViewerControl, rrd: Path, times_s: Sequence[float]) -> tuple[list[bytes], list[str]]:
    """Return PNG pictures of the whole window at these times, and the error messages of its views."""
    open_whole(client, rrd)
    shots, complaints = [], []
    for time_s in times_s:
        client.pause_at("sim_time", duration=time_s)
        shots.append(steady_picture(client))
        complaints += complaints_of(client)
    return shots, list(dict.fromkeys(complaints))


def complaints_of(viewer: ViewerControl) -> list[str]:
    """Return the error messages of the viewer's views, such as those on data that cannot be drawn."""
    return [
        f"{view.name}: {report.severity}: {report.summary}{f' ({report.details})' if report.details else ''}"
        for view in viewer.get_state().views
        for report in view.reports
    ]
