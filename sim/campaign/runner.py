"""Flies a campaign on this machine: threads over the compiled kernel, which lets go of the interpreter.

    result = run_campaign(load_campaign("campaigns/first"), Path("runs/first"), workers=2)

Runs are handed out in order, a handful at a time, over several batches; a batch is written as soon as its last run has
landed. So memory holds the batches under way, however many runs there are, and no worker waits for another.
"""

from __future__ import annotations

import gc
import os
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from dataclasses import dataclass, field
from itertools import islice, takewhile
from pathlib import Path

from maxq.sim.campaign.error import CampaignError
from maxq.sim.campaign.flying import GivenUp, Order, Row, fly_rows, packer
from maxq.sim.campaign.loaded import LoadedCampaign
from maxq.sim.campaign.standing import Standing
from maxq.sim.campaign.store import Store, open_store
from maxq.sim.run.fly import FlightRun

HANDFUL = 8  # runs of a handful; towards the end fewer, so that all workers end together
_AHEAD = 2  # handfuls for each worker that are handed out before they are needed
_LOOK_S = 0.2  # how often the caller is told, and asked whether to stop


@dataclass
class Progress:
    """How a campaign stands; `watch` gets it a few times a second."""

    total: int
    before: int  # runs that were there when this began
    flown: int = 0  # since then
    started_s: float = field(default_factory=time.monotonic)
    standing: Standing = field(default_factory=Standing)

    @property
    def done(self) -> int:
        return self.before + self.flown

    @property
    def elapsed_s(self) -> float:
        return time.monotonic() - self.started_s

    @property
    def rate(self) -> float:
        """Flights a second."""
        return self.flown / self.elapsed_s if self.flown else 0.0

    @property
    def left_s(self) -> float:
        return (self.total - self.done) / self.rate if self.flown else float("inf")


@dataclass(frozen=True)
class Outcome:
    """What became of a call: `stopped` by the caller, `settled` before all runs were needed, or all flown."""

    flown: int
    total: int
    stopped: bool
    settled: bool
    wall_s: float
    notes: tuple[str, ...]


def cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def run_campaign(
    campaign: LoadedCampaign,
    folder: Path,
    *,
    workers: int | None = None,
    watch: Callable[[Progress], None] = lambda _: None,
    stop: Callable[[], bool] = lambda: False,
    until_settled: bool = False,
) -> Outcome:
    """Fly what is missing of a campaign into its folder.

    `watch` is told how it stands a few times a second; when `stop` then says True, whole runs of the batch under way
    are written and it ends. Raises CampaignError.
    """
    store, batch = open_store(folder, campaign)
    try:
        return _run(campaign, store, batch, workers or cores(), watch, stop, until_settled)
    finally:
        store.unlock()


def _run(
    campaign: LoadedCampaign,
    store: Store,
    batch: int,
    workers: int,
    watch: Callable[[Progress], None],
    stop: Callable[[], bool],
    until_settled: bool,
) -> Outcome:
    runs = campaign.campaign.runs
    gaps = list(store.missing(runs, batch))
    before = runs - sum(count for _, count in gaps)
    if gaps:
        load_kernels(campaign)
    progress = Progress(runs, before, standing=Standing.of(store, campaign, runs))
    flight = _Local(campaign, store, gaps, workers, progress)
    settled = until_settled and progress.standing.settled()
    stopped = False
    watch(progress)
    gc.freeze()  # what is there already stays: searching it for garbage took a hundredth of a campaign's time
    try:
        while not settled and flight.go_on():
            if stop():
                stopped = True
                break
            settled = until_settled and progress.standing.settled()
            watch(progress)
    except BaseException:
        flight.end()
        raise
    finally:
        gc.unfreeze()
    flight.end()
    flight.write_begun()
    watch(progress)
    return Outcome(progress.flown, runs, stopped, settled, progress.elapsed_s, tuple(store.notes))


def load_kernels(campaign: LoadedCampaign) -> None:
    """Load the compiled kernels, or compile them, before the clock starts and threads wait for each other."""
    FlightRun(campaign.base, packer(campaign)(campaign.base.scenario), log=False).result()


@dataclass
class _Open:
    """A batch under way."""

    first: int
    count: int
    rows: dict[int, Row] = field(default_factory=dict)


class _Local:
    """Threads, the runs that they fly, and the batches that are not whole yet."""

    def __init__(
        self, campaign: LoadedCampaign, store: Store, gaps: list[tuple[int, int]], workers: int, progress: Progress
    ) -> None:
        self._campaign, self._store, self._progress = campaign, store, progress
        self._stop = threading.Event()
        self._workers, self._left = workers, sum(count for _, count in gaps)
        self._next = self._orders(gaps)
        self._flying: set[Future[list[Row]]] = set()
        self._open: dict[int, _Open] = {}
        self._batch_of: dict[int, _Open] = {}
        self._switch_s = sys.getswitchinterval()
        sys.setswitchinterval(min(self._switch_s, 5e-4))  # a thread that comes back from the kernel waits no longer
        self._pool = ThreadPoolExecutor(workers, thread_name_prefix="run")

    def _orders(self, gaps: list[tuple[int, int]]) -> Iterator[Order]:
        for first, count in gaps:
            inputs = self._campaign.batch(first, count)
            opened = _Open(first, count)
            self._open[first] = opened
            for run in range(first, first + count):
                self._batch_of[run] = opened
                yield inputs, run

    def go_on(self) -> bool:
        """Hand out runs, collect those that have landed, write whole batches. False when all is done."""
        while len(self._flying) < _AHEAD * self._workers:
            orders = list(islice(self._next, self._handful()))
            if not orders:
                break
            self._left -= len(orders)
            self._flying.add(self._pool.submit(fly_rows, self._campaign, orders, self._stop.is_set))
        if not self._flying:
            return False
        landed, _ = wait(self._flying, timeout=_LOOK_S, return_when=FIRST_COMPLETED)
        for future in landed:
            self._flying.remove(future)
            self._enter(future.result())
        return True

    def _handful(self) -> int:
        return min(max(self._left // (2 * _AHEAD * self._workers), 1), HANDFUL)

    def end(self) -> None:
        """End the threads: runs that have not begun are dropped, those under way are given up."""
        self._stop.set()
        self._pool.shutdown(cancel_futures=True)
        sys.setswitchinterval(self._switch_s)

    def write_begun(self) -> None:
        """Write what has landed of the batches under way, as far as it has no gap."""
        for future in self._flying:
            if not future.cancelled() and future.exception() is None:
                self._enter(future.result())
        self._flying.clear()
        for opened in list(self._open.values()):
            runs = range(opened.first, opened.first + opened.count)
            whole = [opened.rows[run] for run in takewhile(opened.rows.__contains__, runs)]
            if whole:
                self._store.write(whole)

    def _enter(self, rows: Iterable[Row]) -> None:
        """Rows that have landed; a batch that they make whole is written."""
        for row in rows:
            opened = self._batch_of.pop(row.run)
            opened.rows[row.run] = row
            self._progress.flown += 1
            self._progress.standing.add(row)
            if len(opened.rows) == opened.count:
                self._store.write(list(opened.rows.values()))
                del self._open[opened.first]


__all__ = ["CampaignError", "GivenUp", "Outcome", "Progress", "cores", "run_campaign"]
