"""The control of a running viewer. Rerun 0.41 renamed most of the methods of 0.40.

This module imports rerun, which is not needed to open a window or to serve a page (`viewer`).
"""

from __future__ import annotations

import tempfile
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rerun.experimental import ViewerClient

if TYPE_CHECKING:
    from rerun.experimental import ViewerState

_SAVE_S = 15.0  # the time for which Rerun 0.41 waits


class ViewerControl:
    """A connection to the viewer at `url` on this machine. Its methods have the names of Rerun 0.41."""

    def __init__(self, url: str) -> None:
        self.url = url
        self._client: Any = ViewerClient.connect(url)
        self._renamed = hasattr(ViewerClient, "take_screenshot")

    def open(self, recording: str) -> None:
        """Start loading a recording to show it, and return before it is complete."""
        (self._client.open if self._renamed else self._client.open_url)(recording)

    def close_recordings(self) -> None:
        """Close all recordings."""
        (self._client.close if self._renamed else self._client.close_recordings)("all")

    def get_state(self) -> ViewerState:
        """Return the recordings and views that the viewer shows, with their error messages."""
        state: ViewerState = (self._client.get_state if self._renamed else self._client.viewer_state)()
        return state

    def pause_at(self, timeline: str, **time_s: float) -> None:
        """Move the cursor of a timeline to a `duration` or a `timestamp` (s), and pause there."""
        self._client.set_time(timeline, **time_s, **({"play_state": "paused"} if self._renamed else {}))

    def take_screenshot(self, view_id: str | None = None) -> bytes:
        """Return a PNG of one view (None: of the whole window). Raises TimeoutError after 15 s."""
        if self._renamed:
            png: bytes = self._client.take_screenshot(view_id)
            return png
        with tempfile.TemporaryDirectory(prefix="maxq-picture-") as folder:
            path = Path(folder) / "picture.png"
            self._client.save_screenshot(str(path), view_id)
            return _saved(path)


def _saved(path: Path) -> bytes:
    """Return the content of a PNG file once the viewer has written it completely. Raises TimeoutError."""
    end = b"IEND\xaeB`\x82"  # the last chunk of a PNG and its checksum
    deadline = time.monotonic() + _SAVE_S
    while time.monotonic() < deadline:
        if path.is_file() and (content := path.read_bytes()).endswith(end):
            return content
        time.sleep(0.01)
    raise TimeoutError(f"no picture within {_SAVE_S:g} s")
