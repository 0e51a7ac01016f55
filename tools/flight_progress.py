"""A progress bar for flights that take a while; on a terminal only."""

from __future__ import annotations

import sys
import time
from types import TracebackType
from typing import Any

from maxq.sim.run.fly import FlightRun

_PATIENCE_S = 1.0  # shorter flights show nothing


class FlightProgress:
    """Call `show` after every segment; the bar goes to stderr and disappears at the end.

    Its end is the longest that the flight may take: most flights end before, by impact.
    """

    def __init__(self) -> None:
        self._start_s = time.monotonic()
        self._wanted = sys.stderr.isatty()  # asked once: a call to the system lets the log's thread go first
        self._bar: Any = None  # rich is imported when it is needed
        self._task: Any = None

    def __enter__(self) -> FlightProgress:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._bar is not None:
            self._bar.stop()

    def show(self, run: FlightRun) -> None:
        if not self._wanted or time.monotonic() - self._start_s < _PATIENCE_S:
            return
        scenario = run.loaded.scenario
        if self._bar is None:
            self._open(scenario.run.start_s, scenario.run.duration_s)
        self._bar.update(self._task, completed=run.now_s - scenario.run.start_s, now=run.now_s)

    def _open(self, start_s: float, duration_s: float) -> None:
        from rich.console import Console  # noqa: PLC0415  # lazy: most flights are over before it is loaded
        from rich.progress import BarColumn, Progress, TextColumn  # noqa: PLC0415  # lazy

        until = f"{start_s + duration_s:g}"
        self._bar = Progress(
            TextColumn("flying"),
            BarColumn(),
            TextColumn(f"{{task.fields[now]:.1f}} s of at most {until} s"),
            console=Console(stderr=True),
            transient=True,
        )
        self._task = self._bar.add_task("", total=duration_s, now=start_s)
        self._bar.start()
