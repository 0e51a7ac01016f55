"""Provide the common parts of the replay's tests: a stored log of schema 1, and a viewer without a window."""

from __future__ import annotations

import os
import socket
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from maxq.tools.replay import viewer
from maxq.tools.replay.viewer import ReplayError

OLD_LOG = Path(__file__).parent / "data" / "logs" / "schema-1" / "flight.mcap"
"""14 s of `nominal` in wind that loses control at 9.66 s (tests/data/logs/NOTES.md): schema 1, for ever."""


@contextmanager
def headless_viewer(window: str = "1280x720") -> Iterator:
    """Yield a viewer to control. Without a graphics driver, skip the test, or fail it in CI."""
    try:
        with viewer.headless(window) as connected:
            client = connected()
            client.take_screenshot()  # without a driver it stops here at the latest
            yield client
    except ReplayError as error:
        no_driver(error)


def free_port() -> int:
    """Return a port of this machine on which nothing listens."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def no_driver(error: ReplayError) -> None:
    if "no driver" in str(error) and not os.environ.get("CI"):
        pytest.skip(str(error))
    raise error
