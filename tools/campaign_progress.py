"""How a campaign gets on: a line that is written anew on a terminal, and a line now and then elsewhere."""

from __future__ import annotations

import math
import shutil
import sys
import time

from maxq.sim.campaign.runner import Progress
from maxq.tools.cli.terminal import printable

_ANEW_S, _LINE_S = 0.25, 30.0


class CampaignProgress:
    """Call `show` as often as you like; it writes to stderr."""

    def __init__(self) -> None:
        self._terminal = sys.stderr.isatty()
        self._last_s = -math.inf if self._terminal else time.monotonic()
        self._wide = 0

    def show(self, progress: Progress) -> None:
        now_s = time.monotonic()
        if now_s - self._last_s < (_ANEW_S if self._terminal else _LINE_S):
            return
        self._last_s = now_s
        line = progress_line(progress)
        if self._terminal:
            line = line[: shutil.get_terminal_size().columns - 1]
            print("\r" + line.ljust(self._wide), end="", file=sys.stderr, flush=True)
            self._wide = len(line)
        else:
            print(line, file=sys.stderr, flush=True)

    def end(self) -> None:
        """Take the line away."""
        if self._terminal and self._wide:
            print("\r" + " " * self._wide + "\r", end="", file=sys.stderr, flush=True)


def progress_line(progress: Progress) -> str:
    """Runs, rate, time left, failures, and the worst of each requirement."""
    standing = progress.standing
    left = (
        f", {duration(progress.left_s)} left"
        if math.isfinite(progress.left_s) and progress.done < progress.total
        else ""
    )
    failed = "none failed" if standing.failed == 0 else f"{standing.failed} failed"
    parts = [f"{progress.done} of {progress.total} runs, {progress.rate:.1f}/s{left}; {failed}"]
    for tally in standing.tallies:
        if tally.requirement is not None and not math.isnan(tally.worst):
            bound = tally.requirement.limit if tally.requirement.limit is not None else tally.requirement.minimum
            parts.append(f"{printable(tally.name)} {tally.worst:.4g} of {bound:.4g}")
    return "; ".join(parts)


def duration(seconds: float) -> str:
    """A time span for people."""
    whole = round(seconds)
    if whole < 100:
        return f"{whole} s"
    if whole < 5400:
        return f"{whole // 60} min {whole % 60} s" if whole < 600 else f"{round(whole / 60)} min"
    return f"{whole // 3600} h {whole % 3600 // 60} min"
