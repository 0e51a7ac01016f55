"""Text for terminals and files: tables and sentences that fit the width, coloured verdicts, a progress bar.

On a terminal, no line is wider than the terminal and no word is cut. Pipes and files get whole lines. The environment
variable COLUMNS sets another width for all of them. Colours are used on terminals only, and not if the environment
contains NO_COLOR.
"""

from __future__ import annotations

import math
import os
import re
import shutil
import sys
import textwrap
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from typing import Any, Self, TextIO

_PATIENCE_S = 1.0  # faster tasks show no progress
_BAR, _CLOCK, _EDGE = 12, 7, 3  # columns of a progress bar, of its clock, and of the margin after the line
_GOOD = "met|MET|BUILT|PASSED|ACCEPTED|accepted|DESIGNED|SAME|pass"
_BAD = "MISSED|missed|FAILED|FAIL|REJECTED|rejected|TOO WEAK|INFEASIBLE|UNSTABLE|DIFFERENT|NONE ACCEPTED|NO RUNS"
_OPEN = "ACCEPTED WITH WAIVERS|UNDECIDED|undecided|INTERRUPTED|warning"
_TONES = {"32": _GOOD, "1;31": _BAD, "33": _OPEN}  # green, bold red, yellow
_VERDICTS = re.compile(  # as a cell of a table, or at the beginning of a line
    "|".join(rf"(?:(?<=  )|^)(?P<t{code.replace(';', '_')}>{words})(?=  |$|:| \()" for code, words in _TONES.items())
)
_COMMAND = re.compile(r"\s*(sim(run|design|verify|replay|vehicle) |/|\S+$)")  # a command to copy, or one word


def printable(text: str) -> str:
    """Return `text` on one line, without control characters."""
    return "".join(c if c.isprintable() else " " for c in " ".join(text.split()))


def columns(stream: TextIO | None = None) -> int:
    """Return the width of a stream (None: stdout) in columns, at least 40.

    Pipes and files have no width: a million is returned for them, unless the environment contains COLUMNS.
    """
    if not (os.environ.get("COLUMNS", "").isdecimal() or (stream or sys.stdout).isatty()):
        return 1_000_000
    return max(shutil.get_terminal_size().columns, 40)


def aligned(
    rows: Sequence[Sequence[str]],
    indent: str = "",
    right: Sequence[int] = (),
    drop: Sequence[int] = (),
    width: int | None = None,
) -> list[str]:
    """Return rows of cells as lines with aligned columns. The columns in `right` are right-aligned.

    If a line is wider than `width` (None: that of the terminal), the columns in `drop` are omitted, in their order. If
    this is not sufficient, columns of text are wrapped at spaces, with the number of omitted columns that gives the
    fewest lines. As a last resort, columns follow each other in blocks that repeat the first column.
    """
    if not rows:
        return []
    room = (columns() if width is None else width) - len(indent)
    stages = [[i for i in range(len(rows[0])) if i not in drop[:n]] for n in range(len(drop) + 1)]
    for wrap in (False, True):
        fit = []
        for shown in stages:
            widths = _fitted(rows, shown, right, room if wrap else 1_000_000)
            if sum(widths) + 2 * len(widths) - 2 <= room:
                fit.append(_lines(rows, shown, widths, indent, right))
        if fit:
            return min(fit, key=len)  # of equal lengths, the first has more columns
    blocks, used = [[shown[0]]], widths[0]
    for i, w in zip(shown[1:], widths[1:], strict=True):
        if used + 2 + w > room and len(blocks[-1]) > 1:
            blocks.append([shown[0]])
            used = widths[0]
        blocks[-1].append(i)
        used += 2 + w
    lines: list[str] = []
    for block in blocks:
        lines += [""] * bool(lines) + _lines(rows, block, _fitted(rows, block, right, room), indent, right)
    return lines


def _fitted(rows: Sequence[Sequence[str]], shown: Sequence[int], right: Sequence[int], room: int) -> list[int]:
    """Return the widths of the columns `shown`, in total at most `room` where possible.

    Columns of text are narrowed where this adds the fewest lines, down to their longest words.
    """
    widths = [max(len(row[i]) for row in rows) for i in shown]
    least = [
        w if i in right else max((len(word) for row in rows for word in row[i].split()), default=0)
        for i, w in zip(shown, widths, strict=True)
    ]
    lengths = [[len(row[i]) for i in shown] for row in rows]

    def lines_without(k: int) -> int:
        tried = [max(w - (n == k), 1) for n, w in enumerate(widths)]
        return sum(max(-(-length // w) for length, w in zip(row, tried, strict=True)) for row in lengths)

    while sum(widths) + 2 * len(widths) - 2 > room and widths != least:
        can = [k for k in range(len(widths)) if widths[k] > least[k]]
        widths[min(can, key=lambda k: (lines_without(k), -widths[k]))] -= 1
    return widths


def _lines(
    rows: Sequence[Sequence[str]], shown: Sequence[int], widths: Sequence[int], indent: str, right: Sequence[int]
) -> list[str]:
    lines = []
    for row in rows:
        cells = [_wrapped(row[i], w) for i, w in zip(shown, widths, strict=True)]
        for n in range(max(len(cell) for cell in cells)):
            parts = [cell[n] if n < len(cell) else "" for cell in cells]
            parts = [p.rjust(w) if i in right else p.ljust(w) for i, p, w in zip(shown, parts, widths, strict=True)]
            lines.append((indent + "  ".join(parts)).rstrip())
    return lines


def _wrapped(text: str, width: int) -> list[str]:
    if len(text) <= width:
        return [text]
    return textwrap.wrap(text, max(width, 1), break_long_words=False, break_on_hyphens=False) or [""]


def folded(text: str, width: int | None = None) -> str:
    """Return `text` with its long lines broken at spaces and indented.

    Commands remain whole so that they can be copied.
    """
    room, lines = columns() if width is None else width, []
    for line in text.split("\n"):
        if len(line) <= room or _COMMAND.match(line):
            lines.append(line)
            continue
        indent = line[: len(line) - len(line.lstrip())]
        lines += textwrap.wrap(
            line.lstrip(),
            room,
            initial_indent=indent,
            subsequent_indent=indent + "    ",
            drop_whitespace=True,
            break_long_words=False,
            break_on_hyphens=False,
            replace_whitespace=False,
        )
    return "\n".join(lines)


def painted(text: str, stream: TextIO | None = None) -> str:
    """Return `text` with its verdicts in colour if the stream is a terminal with colours."""
    if os.environ.get("NO_COLOR") or os.environ.get("TERM") == "dumb" or not (stream or sys.stdout).isatty():
        return text
    return "\n".join(_VERDICTS.sub(_paint, line) for line in text.split("\n"))


def _paint(found: re.Match[str]) -> str:
    return f"\x1b[{(found.lastgroup or 't0')[1:].replace('_', ';')}m{found[0]}\x1b[0m"


_announced = False  # True while a stage is on the terminal, which must be erased before other output


def announce(stage: str) -> None:
    """Show the current stage of a command on stderr, if this is a terminal, until the next stage or other output."""
    global _announced  # noqa: PLW0603  # there is one terminal
    if sys.stderr.isatty() and os.environ.get("TERM") != "dumb":
        wipe()
        sys.stderr.write(printable(stage)[: columns(sys.stderr) - 3])
        sys.stderr.flush()
        _announced = True


def wipe() -> None:
    """Erase the announced stage from the terminal."""
    global _announced  # noqa: PLW0603  # there is one terminal
    if _announced:
        sys.stderr.write("\r\x1b[2K")
        sys.stderr.flush()
        _announced = False


def tell(*texts: object) -> None:
    """Print lines for the user, folded to the width of the terminal and with coloured verdicts."""
    wipe()
    print(painted(folded("\n".join(str(text) for text in texts))))


class Progress:
    """A progress bar on stderr that disappears at the end of its block. Any thread may advance it.

    The name of a stage appears immediately. The bar, which also shows compilations, appears after a second, or
    immediately with `at_once`. If stderr is not a terminal, no bar is shown. `log_every_s` then prints a line at this
    interval, for the logs of batch systems.
    """

    def __init__(self, log_every_s: float | None = None, *, at_once: bool = False) -> None:
        self._terminal = sys.stderr.isatty()  # evaluated once: a system call would yield to the log's thread
        self._log_every_s = log_every_s
        self._last_s = -math.inf if at_once else time.monotonic()
        self._bar: Any = None  # rich is imported when it is needed
        self._task: Any = None
        self._lock = threading.RLock()
        self._shown: dict[str, Any] = {"what": "preparing", "total": None, "count": ""}
        self._listening = ExitStack()
        self._open = False
        self._compiling = False
        self._compiling_s = math.inf  # start of the compilation, on the monotonic clock

    def __enter__(self) -> Self:
        self._open = True
        if self._terminal and "maxq.control.kernel.progress" in sys.modules:
            self._listening.enter_context(_listening(self))
        return self

    def __exit__(self, *error: object) -> None:
        with self._lock:
            self._open = False
            self._listening.close()
            if self._bar is not None:
                self._bar.stop()

    def show(self, what: str, done: float, of: float, note: str = "", count: str | None = None) -> None:
        """Show `done` of `of` steps of the stage `what`, followed by `note`.

        `count` replaces the text "3 of 8". An `of` of 0 means that the number of steps is unknown. A single step has no
        number either.
        """
        with self._lock:
            if not self._open:
                return
            of = 0.0 if of == 1.0 and done in (0.0, 1.0) else of
            count = count if count is not None else f"{done:g} of {of:g}" if of else ""
            another, shown = what != self._shown["what"], {"what": what, "total": of or None, "count": count}
            if self._bar is None and not self._due():
                if another and self._terminal:
                    self._shown = shown
                    announce(what)
                return
            wipe()
            if not self._terminal:
                print(f"{what}: {count}{'; ' if note else ''}{printable(note)}", file=sys.stderr, flush=True)
                return
            self._shown = shown
            if self._bar is None:
                self._begin()
            elif another:
                self._bar.reset(self._task)  # so that the clock next to it is that of this stage
            done = min(done, 0.999 * of) if of else done  # a complete bar would stop the clock
            self._bar.update(self._task, **shown, completed=done, note=self._fitting(what, count, note))

    def _fitting(self, what: str, count: str, note: str) -> str:
        """Return the leading parts of a note (separated by semicolons) that fit on the line, as the text after the
        count.
        """
        before = "; " if count and note else ""
        space = self._bar.console.width - _EDGE - len(what) - len(count) - len(before) - _BAR - _CLOCK - 3
        parts = printable(note).split("; ")
        while parts and len("; ".join(parts)) > space:
            parts.pop()
        return before + "; ".join(parts) if parts else ""

    def compiling(self, name: str, share: float) -> None:
        """Show the finished share (0 to 1) of a compilation; 1 ends the display.

        `name` is the vehicle or scenario for which code is compiled. The first second of a compilation is not shown.
        """
        with self._lock:
            if share >= 1.0:
                if self._compiling and self._bar is not None and self._open:
                    self._bar.reset(self._task)
                    self._bar.update(self._task, completed=0, **self._shown, note="")
                self._compiling, self._compiling_s = False, math.inf
                return
            now_s = time.monotonic()
            self._compiling_s = min(self._compiling_s, now_s)
            if not self._open or now_s - self._compiling_s < _PATIENCE_S:
                return
            wipe()
            if self._bar is None:
                self._begin()
            if not self._compiling:
                self._bar.reset(self._task)
            self._compiling = True
            what = f"compiling for {printable(name)}, once" if name else "compiling maxq, once"
            self._bar.update(self._task, what=what, count=f"{share:.0%}", completed=share, total=1.0, note="")

    def _due(self) -> bool:
        wait_s = _PATIENCE_S if self._terminal else self._log_every_s
        if wait_s is None or time.monotonic() - self._last_s < wait_s:
            return False
        self._last_s = time.monotonic()
        return True

    def _begin(self) -> None:
        from rich.console import Console, RenderableType  # noqa: PLC0415  # lazy: most work ends before it is loaded
        from rich.constrain import Constrain  # noqa: PLC0415  # lazy
        from rich.progress import BarColumn, TextColumn, TimeElapsedColumn  # noqa: PLC0415  # lazy
        from rich.progress import Progress as Bar  # noqa: PLC0415  # lazy
        from rich.table import Column  # noqa: PLC0415  # lazy

        console = Console(stderr=True)

        class Narrow(Bar):
            """A bar followed by space for the "^C" that a terminal prints, which would otherwise break the line."""

            def get_renderable(self) -> RenderableType:
                return Constrain(super().get_renderable(), max(console.width - _EDGE, 20))

        def text(form: str, ratio: int | None = None) -> TextColumn:
            column = Column(no_wrap=True, overflow="ellipsis", ratio=ratio)
            return TextColumn(form, markup=False, table_column=column)

        numbers = text("{task.fields[count]}{task.fields[note]}", 1)
        shown = (text("{task.fields[what]}"), BarColumn(_BAR), TimeElapsedColumn(), numbers)
        self._bar = Narrow(*shown, console=console, transient=True, expand=True)
        self._task = self._bar.add_task("", completed=0, **self._shown, note="")
        self._bar.start()


@contextmanager
def _listening(progress: Progress) -> Iterator[None]:
    """Report compilations to `progress` within the block. Loading stored machine code is not reported."""
    from maxq.control.kernel import progress as compilations  # noqa: PLC0415  # lazy: loaded already when it is called

    compilations.watchers.append(progress.compiling)
    try:
        yield
    finally:
        compilations.watchers.remove(progress.compiling)
