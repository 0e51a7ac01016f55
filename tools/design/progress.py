"""A progress bar for what takes a while; on a terminal only."""

from __future__ import annotations

import sys
import time
from types import TracebackType
from typing import Any

_PATIENCE_S = 0.5  # what is done sooner shows nothing


class Progress:
    """Call `show` now and then; the bar goes to stderr and disappears at the end."""

    def __init__(self) -> None:
        self._start_s = time.monotonic()
        self._bar: Any = None  # rich is imported when it is needed
        self._task: Any = None

    def __enter__(self) -> Progress:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._bar is not None:
            self._bar.stop()

    def show(self, what: str, done: int, of: int, note: str = "") -> None:
        """`done` steps `of` so many of `what`; a note behind the bar."""
        if not sys.stderr.isatty() or time.monotonic() - self._start_s < _PATIENCE_S:
            return
        if self._bar is None:
            self._open()
        self._bar.update(self._task, completed=done, total=of, what=what, note=note)

    def _open(self) -> None:
        from rich.console import Console  # noqa: PLC0415  # lazy: most work is done before it is loaded
        from rich.progress import BarColumn, MofNCompleteColumn, TextColumn  # noqa: PLC0415  # lazy
        from rich.progress import Progress as Bar  # noqa: PLC0415  # lazy

        columns = (
            TextColumn("{task.fields[what]}"),
            BarColumn(),
            MofNCompleteColumn(),
            TextColumn("{task.fields[note]}"),
        )
        self._bar = Bar(*columns, console=Console(stderr=True), transient=True)
        self._task = self._bar.add_task("", total=1, what="", note="")
        self._bar.start()
