"""Text for terminals and files: tables with aligned columns, messages on one line, a progress bar."""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from typing import Any, Self

_PATIENCE_S = 1.0  # what is done sooner shows no progress


def printable(text: str) -> str:
    """`text` on one line, without control characters."""
    return "".join(c if c.isprintable() else " " for c in " ".join(text.split()))


def aligned(rows: Sequence[Sequence[str]], indent: str = "", right: Sequence[int] = ()) -> list[str]:
    """Rows of cells as lines with aligned columns; the columns in `right` are right-aligned."""
    widths = [max(len(row[i]) for row in rows) for i in range(len(rows[0]))] if rows else []
    lines = []
    for row in rows:
        cells = [c.rjust(w) if i in right else c.ljust(w) for i, (c, w) in enumerate(zip(row, widths, strict=True))]
        lines.append((indent + "  ".join(cells)).rstrip())
    return lines


class Progress:
    """A progress bar on stderr that disappears at the end of its block. Nothing is shown in the first second, nor
    where stderr is not a terminal; there `log_every_s` prints a line at this interval, for the logs of batch systems.
    """

    def __init__(self, log_every_s: float | None = None) -> None:
        self._terminal = sys.stderr.isatty()  # asked once: a system call lets the log's thread go first
        self._log_every_s = log_every_s
        self._last_s = time.monotonic()
        self._bar: Any = None  # rich is imported when it is needed
        self._task: Any = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        if self._bar is not None:
            self._bar.stop()

    def show(self, what: str, done: float, of: float, note: str = "", count: str | None = None) -> None:
        """`done` of `of` steps of `what`; `note` follows behind. `count` replaces the text "done of of"."""
        if self._bar is None and not self._due():
            return
        count = f"{done:g} of {of:g}" if count is None else count
        if not self._terminal:
            print(f"{what}: {count}{'; ' if note else ''}{printable(note)}", file=sys.stderr, flush=True)
            return
        if self._bar is None:
            self._open()
        self._bar.update(self._task, completed=done, total=of, what=what, count=count, note=printable(note))

    def _due(self) -> bool:
        wait_s = _PATIENCE_S if self._terminal else self._log_every_s
        if wait_s is None or time.monotonic() - self._last_s < wait_s:
            return False
        self._last_s = time.monotonic()
        return True

    def _open(self) -> None:
        from rich.console import Console  # noqa: PLC0415  # lazy: most work is done before it is loaded
        from rich.progress import BarColumn, TextColumn  # noqa: PLC0415  # lazy
        from rich.progress import Progress as Bar  # noqa: PLC0415  # lazy
        from rich.table import Column  # noqa: PLC0415  # lazy

        def text(field: str) -> TextColumn:
            column = Column(no_wrap=True, overflow="ellipsis")
            return TextColumn(f"{{task.fields[{field}]}}", markup=False, table_column=column)

        columns = (text("what"), BarColumn(), text("count"), text("note"))
        self._bar = Bar(*columns, console=Console(stderr=True), transient=True)
        self._task = self._bar.add_task("", total=1, what="", count="", note="")
        self._bar.start()
