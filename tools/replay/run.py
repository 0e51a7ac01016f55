"""The execution of `simreplay` after its command line has been parsed: read the logs and show them.

Matplotlib and Rerun are imported only when they are needed. A summary in the terminal needs neither.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import tempfile
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from maxq.tools.cli.frame import Exit, say
from maxq.tools.cli.system import linux_function
from maxq.tools.cli.terminal import Progress, tell, wipe
from maxq.tools.replay import viewer
from maxq.tools.replay.flight import ReplayFlight, find_logs, open_flights
from maxq.tools.replay.viewer import ReplayError

if TYPE_CHECKING:
    from maxq.tools.replay.viewer_control import ViewerControl

_WEB_PORT = 9090


def execute(given: argparse.Namespace) -> int:
    """Execute the command with the parsed options. Return the exit code. Raises ReplayError if nothing can be shown."""
    find_logs(given.logs)  # report a mistyped name first
    _check_before(given)
    with contextlib.ExitStack() as stack:
        client = None
        if given.screenshot:  # the viewer starts while the logs are read
            client = stack.enter_context(viewer.headless(given.size or viewer.WINDOW))
        with Progress(at_once=True) as bar:
            flights, complaints = open_flights(given.logs, in_turn=not (given.plots or given.summary), watch=bar.show)
        _complain(complaints)
        done = _show(flights, given, client)
    return done or (Exit.FAILED if complaints else Exit.OK)


def _complain(complaints: Sequence[str]) -> None:
    for complaint in complaints:
        say("simreplay", complaint)


def _check_before(given: argparse.Namespace) -> None:
    """Check all conditions that do not depend on the logs, since reading these may take seconds. Raises ReplayError."""
    if given.plots or given.summary:
        return
    viewer.check_installed()
    if given.save:
        return
    viewer.executable()
    if given.web:
        viewer.check_port(_WEB_PORT if given.port is None else given.port)
    elif given.screenshot:
        _check_writable(Path(given.screenshot))
    else:
        viewer.check_display()


def _show(flights: list[ReplayFlight], given: argparse.Namespace, client: Callable[[], ViewerControl] | None) -> int:
    if given.summary:
        from maxq.tools.replay.text import summary_text  # noqa: PLC0415  # lazy

        wipe()
        print("\n\n".join(summary_text(flight) for flight in flights))
        return Exit.OK
    if given.plots:
        from maxq.tools.replay.sheets import write_sheets  # noqa: PLC0415  # lazy: matplotlib

        with Progress() as bar:
            files = write_sheets(flights, Path(given.plots), watch=bar.show)
        tell(*files)
        return Exit.OK
    if given.save:
        path = Path(given.save)
        if path.is_dir():
            raise ReplayError(f"{path}: is a folder; --save needs the name of a file")
        if path.exists() and not path.is_file():  # which the new file would replace
            raise ReplayError(f"{path}: is no regular file; --save needs the name of a file")
        _convert(flights, given, path)
        tell(f"{path}   {path.stat().st_size / 1e6:.1f} MB")
        return Exit.OK
    with temporary_recording() as path:
        _convert(flights, given, path)
        flights.clear()  # the viewer has its data, and needs the memory
        _give_back_memory()
        if client is not None:
            return _screenshot(client(), path, given)
        if given.web:
            return _web(path, _WEB_PORT if given.port is None else given.port)
        viewer.show(path)
        return Exit.OK


def _give_back_memory() -> None:
    """Return freed memory to the system. Otherwise, glibc keeps a hundred megabytes."""
    if (trim := linux_function("malloc_trim")) is not None:
        trim(0)


def _convert(flights: Sequence[ReplayFlight], given: argparse.Namespace, path: Path) -> None:
    from maxq.tools.replay.convert import Options, save  # noqa: PLC0415  # lazy: loads rerun

    names = Options.__dataclass_fields__.keys() & vars(given).keys()
    options = Options(bare=bool(given.screenshot), **{name: getattr(given, name) for name in names})
    _check_writable(path)
    with Progress(at_once=True) as bar:
        bar.show("preparing the replay", 0, 0)
        save(flights, options, path)


def _check_writable(path: Path) -> None:
    folder = path.parent
    if not folder.is_dir():
        raise ReplayError(f"{path}: there is no folder {folder}")
    if not os.access(path if path.exists() else folder, os.W_OK):
        raise ReplayError(f"{path}: cannot be written: permission denied")


@contextlib.contextmanager
def temporary_recording() -> Iterator[Path]:
    """Yield the path of a file for the viewer, which is deleted at the end of the block."""
    with tempfile.TemporaryDirectory(prefix="maxq-replay-") as folder:
        yield Path(folder) / "replay.rrd"


def _screenshot(client: ViewerControl, rrd: Path, given: argparse.Namespace) -> int:
    target = Path(given.screenshot)
    with Progress(at_once=True) as bar:
        bar.show("drawing", 0, 0)
        shots, complaints = viewer.pictures(client, rrd, given.at)
    _complain(complaints)
    for time_s, shot in zip(given.at, shots, strict=True):
        path = target if len(shots) == 1 else target.with_name(f"{target.stem}-{time_s:g}{target.suffix or '.png'}")
        path.write_bytes(shot)
        tell(path)
    return Exit.FAILED if complaints else Exit.OK


def _web(rrd: Path, port: int) -> int:
    with viewer.served(rrd, port) as (server, url):
        wipe()
        print(f"open {url}\n(served on {viewer.LOCAL} only; Ctrl-C ends it)", flush=True)
        try:
            return Exit.OK if server.wait() == 0 else Exit.BAD_INPUT
        except KeyboardInterrupt:
            return Exit.OK
