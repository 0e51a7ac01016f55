"""`simreplay` once its command line has been read: open the logs, show them, say what went wrong."""

from __future__ import annotations

import argparse
import contextlib
import ctypes
import os
import sys
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from maxq.tools.cli.frame import Exit, say
from maxq.tools.replay.collect import find_logs, open_flights
from maxq.tools.replay.error import ReplayError
from maxq.tools.replay.flight import ReplayFlight
from maxq.tools.replay.web_page import LOCAL

if TYPE_CHECKING:
    from maxq.tools.replay.viewer import Headless

_WEB_PORT = 9090


def execute(given: argparse.Namespace) -> int:
    """Do what the command line asks for; returns the exit code."""
    _check_before(given)
    with _headless(given) as viewer:
        flights, complaints = open_flights(given.logs, in_turn=not (given.plots or given.summary))
        for complaint in complaints:
            say("simreplay", complaint)
        done = _show(flights, given, viewer)
    return done or (Exit.FAILED if complaints else Exit.OK)


def _check_before(given: argparse.Namespace) -> None:
    """What can be known before the logs are read, which may take seconds."""
    if given.plots or given.summary or given.save:
        return
    from maxq.tools.replay import viewer  # noqa: PLC0415  # lazy: not needed for plots

    viewer.executable()
    if given.web:
        viewer.check_port(_WEB_PORT if given.port is None else given.port)
    elif given.screenshot:
        _check_writable(Path(given.screenshot))
    else:
        viewer.check_display()


@contextlib.contextmanager
def _headless(given: argparse.Namespace) -> Iterator[Headless | None]:
    """The viewer for a picture: it starts beside the reading of the logs."""
    if not given.screenshot:
        yield None
        return
    from maxq.tools.replay import viewer  # noqa: PLC0415  # lazy

    find_logs(given.logs)  # nothing is started for a name that was mistyped
    with viewer.Headless(given.size or viewer.WINDOW) as running:
        yield running


def _show(flights: list[ReplayFlight], given: argparse.Namespace, viewer: Headless | None) -> int:
    if given.summary:
        from maxq.tools.replay.summary import summary_text  # noqa: PLC0415  # lazy

        print("\n\n".join(summary_text(flight) for flight in flights))
        return Exit.OK
    if given.plots:
        from maxq.tools.replay.sheets import write_sheets  # noqa: PLC0415  # lazy: matplotlib

        for path in write_sheets(flights, Path(given.plots)):
            print(path)
        return Exit.OK
    if given.save:
        path = Path(given.save)
        if path.is_dir():
            raise ReplayError(f"{path}: is a folder; --save needs the name of a file")
        _convert(flights, given, path)
        print(f"{path}   {path.stat().st_size / 1e6:.1f} MB")
        return Exit.OK
    with _temporary() as path:
        _convert(flights, given, path)
        flights.clear()  # the viewer has what it needs: the memory of the logs is free for it
        _give_back_memory()
        if viewer is not None:
            return _screenshot(viewer, path, given)
        if given.web:
            return _web(path, _WEB_PORT if given.port is None else given.port)
        return _window(path)


def _give_back_memory() -> None:
    """glibc keeps a hundred megabytes of what was freed unless it is asked."""
    if sys.platform.startswith("linux") and (trim := getattr(ctypes.CDLL(None), "malloc_trim", None)) is not None:
        trim(0)


def window_of(flights: Sequence[ReplayFlight]) -> None:
    """Show flights in a window and wait until it is closed. Raises ReplayError."""
    from maxq.tools.replay.convert import Options, save  # noqa: PLC0415  # lazy: loads rerun

    with _temporary() as path:
        save(flights, Options(), path)
        _window(path)


def _convert(flights: Sequence[ReplayFlight], given: argparse.Namespace, path: Path) -> None:
    from maxq.tools.replay.convert import Options, save  # noqa: PLC0415  # lazy: loads rerun

    options = Options(given.rate, given.bend_factor, given.slosh_factor, given.side_by_side, given.tab)
    _check_writable(path)
    save(flights, options, path)


def _check_writable(path: Path) -> None:
    folder = path.parent
    if not folder.is_dir():
        raise ReplayError(f"{path}: there is no folder {folder}")
    if not os.access(path if path.exists() else folder, os.W_OK):
        raise ReplayError(f"{path}: cannot be written: permission denied")


@contextlib.contextmanager
def _temporary() -> Iterator[Path]:
    """A file for the viewer that is gone afterwards."""
    with tempfile.TemporaryDirectory(prefix="maxq-replay-") as folder:
        yield Path(folder) / "replay.rrd"


def _screenshot(viewer: Headless, rrd: Path, given: argparse.Namespace) -> int:
    from maxq.tools.replay.viewer import pictures  # noqa: PLC0415  # lazy

    target = Path(given.screenshot)
    shots, complaints = pictures(viewer, rrd, given.at)
    for complaint in complaints:
        say("simreplay", complaint)
    for time_s, shot in zip(given.at, shots, strict=True):
        path = target if len(shots) == 1 else target.with_name(f"{target.stem}-{time_s:g}{target.suffix or '.png'}")
        path.write_bytes(shot)
        print(path)
    return Exit.FAILED if complaints else Exit.OK


def _web(rrd: Path, port: int) -> int:
    from maxq.tools.replay import viewer  # noqa: PLC0415  # lazy

    with viewer.served(rrd, port) as (server, url):
        print(f"open {url}\n(served on {LOCAL} only; Ctrl-C ends it)", flush=True)
        try:
            return Exit.OK if server.wait() == 0 else Exit.BAD_INPUT
        except KeyboardInterrupt:
            return Exit.OK


def _window(rrd: Path) -> int:
    from maxq.tools.replay import viewer  # noqa: PLC0415  # lazy

    code = viewer.show(rrd)
    if code:
        raise ReplayError(f"the Rerun viewer ended with code {code}; --web or --screenshot may do instead")
    return Exit.OK
