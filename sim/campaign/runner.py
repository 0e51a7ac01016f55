"""The runner of a campaign, on threads or on a Dask cluster.

Threads run in parallel, because the compiled kernel releases the interpreter's lock.

    result = run_campaign(load_campaign("campaigns/first"), Path("runs/first"), workers=2)
    result = run_campaign(load_campaign("campaigns/ksr3"), Path("runs/ksr3"), cluster=Client("tcp://head:8786"))

Runs are submitted in order, over several batches. This process writes a batch as soon as its last run is complete.
Memory therefore contains only the batches in progress for any number of runs, and workers are not idle between batches.
With `shard`, only a part of the runs is flown (shards.py).
"""

from __future__ import annotations

import json
import math
import threading
import time
import zlib
from bisect import bisect_right
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field
from functools import lru_cache
from itertools import count, islice, takewhile
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import Any

from maxq.control.kernel.machine import cores
from maxq.sim.campaign.analysis import requirements_of
from maxq.sim.campaign.error import CampaignError
from maxq.sim.campaign.objects import ObjectFolder
from maxq.sim.campaign.own_kernels import OwnKernels
from maxq.sim.campaign.read import LoadedCampaign, campaign_from, description_of
from maxq.sim.campaign.runs import VOID, Packing, Row, fly_rows, schema_of
from maxq.sim.campaign.shards import Shard
from maxq.sim.campaign.statistics import OPEN, judge_failures
from maxq.sim.campaign.store import PartFiles, Store, Wait, files_of, open_store, parts_in, read_part, simulator
from maxq.sim.run.fly import refuse_unstable_steps
from maxq.sim.run.metrics import judge
from maxq.sim.scenario.schema_scenario import RequirementSection

CHUNK = 8  # runs that a thread prepares, flies and judges together; fewer near the end, so that all end together
AHEAD = 2  # tasks submitted for each worker, including those in progress
_COUNT_S = 1.0  # interval at which the threads of a cluster are counted
_POLL_S = 0.2  # interval of progress reports and of calls of `stop`
_TRIES = 5  # attempts at a batch whose workers die; Dask makes several attempts for each of them
_SHARES = 4  # least number of batches for each thread of a cluster

Gap = tuple[int, int]
"""Missing runs that are flown and written together: the first run, and their number."""


Count = tuple[int, float]
"""The number of misses of a requirement in a set of runs, and the worst value of its metric there (nan: none)."""


@dataclass
class Tally:
    """The tally of a requirement (None for CONTROL_KEPT). `worst` is nan until a run has a value."""

    name: str
    requirement: RequirementSection | None
    failures: int = 0
    failures_in_order: int = 0  # failures in the runs before the first gap
    worst: float = math.nan

    def judge(self, outcome: str, cause: str, metrics: Mapping[str, Any]) -> Count:
        """Return the result of a single run, which misses the requirement if it has no usable metrics."""
        void = outcome in VOID
        if self.requirement is None:
            return int(void or bool(cause)), math.nan
        missed = void or not judge(self.requirement, metrics, metrics).met
        return int(missed), math.nan if void else metrics[self.requirement.metric]

    def add(self, counted: Count) -> None:
        missed, value = counted
        self.failures += missed
        if self.requirement is not None:
            worse = max if self.requirement.bound[0] == "limit" else min
            self.worst = value if math.isnan(self.worst) else worse(self.worst, value)


class Interim:
    """The tallies of all completed runs, and of the runs before the first gap, on which interim verdicts are based.

    The order of completion depends on the duration of runs, and thus on their failures. A verdict on all completed runs
    would therefore be biased.
    """

    def __init__(self, campaign: LoadedCampaign, first: int = 0) -> None:
        self.tallies = [Tally(name, requirement) for name, requirement in requirements_of(campaign)]
        self.failed = 0
        self._level = campaign.campaign.success, campaign.campaign.confidence
        self._first = self._in_order = first
        self._failed_in_order = 0
        self._ahead: dict[int, tuple[int, int, list[int]]] = {}  # by first run: runs, failed, misses of each

    def read(self, folder: Path, runs: int) -> None:
        """Count the runs below `runs` in a campaign's folder."""
        metrics = dict.fromkeys(t.requirement.metric for t in self.tallies if t.requirement)
        wanted = ["run", "outcome", "passed", "cause", *metrics]
        for part in parts_in(folder):
            if part.first < runs:
                table = read_part(part.path, wanted).slice(0, runs - part.first)
                for row in table.to_pylist():
                    self.add(row["run"], row["outcome"], row["passed"], row["cause"], row)

    def add(self, run: int, outcome: str, passed: bool, cause: str, metrics: Mapping[str, Any]) -> None:
        self.enter(run, 1, int(not passed), [tally.judge(outcome, cause, metrics) for tally in self.tallies])

    def enter(self, first: int, size: int, failed: int, counts: Sequence[Count]) -> None:
        """Count `size` runs from `first` on, `failed` of which failed, with the counts of each requirement."""
        self.failed += failed
        for tally, counted in zip(self.tallies, counts, strict=True):
            tally.add(counted)
        self._ahead[first] = size, failed, [missed for missed, _ in counts]
        while self._in_order in self._ahead:
            size, failed, each = self._ahead.pop(self._in_order)
            for tally, missed in zip(self.tallies, each, strict=True):
                tally.failures_in_order += missed
            self._failed_in_order += failed
            self._in_order += size

    def settled(self) -> bool:
        """Return True if the verdicts on each requirement and on all requirements together are settled.

        The verdicts are those of the any-time test, which is valid under any stopping rule.
        """
        n, counts = self._in_order - self._first, [*(t.failures_in_order for t in self.tallies), self._failed_in_order]
        return n > 0 and all(judge_failures(count, n, *self._level).judgement != OPEN for count in counts)


@dataclass
class CampaignProgress:
    """The progress of a campaign, passed to `watch` a few times a second."""

    total: int
    before: int  # runs that existed at the beginning
    interim: Interim
    flown: int = 0  # runs completed since then
    started_s: float = field(default_factory=time.monotonic)

    @property
    def done(self) -> int:
        return self.before + self.flown

    @property
    def elapsed_s(self) -> float:
        return time.monotonic() - self.started_s

    @property
    def rate(self) -> float:
        """Return the number of flights per second."""
        return self.flown / self.elapsed_s if self.flown else 0.0

    @property
    def left_s(self) -> float:
        return (self.total - self.done) / self.rate if self.flown else math.inf


@dataclass(frozen=True)
class Outcome:
    """The result of `run_campaign`.

    - `flown`, `total`: number of runs flown in this call, and of all runs of the campaign.
    - `stopped`: True if `stop` ended the call.
    - `settled`: True if settled verdicts ended the call.
    - `notes`: findings and repairs in the folder.
    - `missing`: runs that were not in the data set at the beginning.
    """

    flown: int
    total: int
    stopped: bool
    settled: bool
    wall_s: float
    notes: tuple[str, ...]
    missing: tuple[Gap, ...]


def run_campaign(
    campaign: LoadedCampaign,
    folder: Path,
    *,
    workers: int | None = None,
    cluster: Any = None,
    watch: Callable[[CampaignProgress], None] = lambda _: None,
    stop: Callable[[], bool] = lambda: False,
    until_settled: bool = False,
    elsewhere: str = "give another --out",
    wait: Wait | None = None,
    shard: Shard | None = None,
    sync: str | None = None,
) -> Outcome:
    """Fly the missing runs of a campaign on `workers` threads (default: one for each core), and write them to `folder`.

    - `cluster`: address of a Dask scheduler, or a dask Client, whose workers are used instead of threads (maxq[dask]).
    - `watch`: called with the progress a few times a second.
    - `stop`: called with the same frequency. If it returns True, completed runs are written, and the call ends.
    - `until_settled`: end as soon as all verdicts are settled.
    - `elsewhere`: advice in the message for a folder that is in use or contains other data.
    - `wait`: called with the name of another process that uses the folder, until the folder is free. The runs of that
      process are not flown again.
    - `shard`: fly the runs of this shard only, into a folder of its own, for `merge` (shards.py).
    - `sync`: address of a copy of the folder in object storage, from which the campaign also continues (objects.py).

    Raises CampaignError.
    """
    if until_settled and campaign.campaign.test == "fixed":
        raise CampaignError(f"{campaign.name}: --until-settled looks at any time; campaign.test = 'fixed' does not")
    runs = range(campaign.campaign.runs) if shard is None else shard.runs(campaign.campaign.runs)
    if shard is not None and until_settled:
        raise CampaignError(f"{campaign.name}: verdicts are settled by all runs, not by shard {shard}")
    refuse_unstable_steps(campaign.base)
    with ExitStack() as stack:
        flyers: Threads | DaskCluster
        if cluster is None:
            flyers = Threads(campaign, workers or cores())
        else:
            client = stack.enter_context(_connected(cluster)) if isinstance(cluster, str) else cluster
            flyers = DaskCluster(campaign, client)
        copy = None if sync is None else ObjectFolder(sync)
        part = None if shard is None else str(shard)
        store, usual = open_store(folder, campaign, elsewhere, wait, part, copy)
        stack.callback(store.unlock)
        try:
            return _flown(campaign, runs, flyers, store, usual, watch, stop, until_settled)
        except Exception:  # such as draws that all lie outside their bounds
            store.discard()
            raise


def _flown(
    campaign: LoadedCampaign,
    runs: range,
    flyers: Threads | DaskCluster,
    store: Store,
    usual: int,
    watch: Callable[[CampaignProgress], None],
    stop: Callable[[], bool],
    until_settled: bool,
) -> Outcome:
    """Fly the runs of `runs` that are missing in the store of a campaign; `usual` is its usual size of batches."""
    gaps = list(store.missing(runs, flyers.batch(usual, len(runs))))
    tasks = flyers.begin(gaps)
    interim = Interim(campaign, runs.start)
    interim.read(store.folder, runs.stop)
    progress = CampaignProgress(len(runs), len(runs) - sum(size for _, size in gaps), interim)
    batches = _Batches(store, gaps, progress)
    stopped, settled = _fly(flyers, tasks, batches, progress, watch, stop, until_settled)
    batches.write_begun()
    watch(progress)
    return Outcome(progress.flown, len(runs), stopped, settled, progress.elapsed_s, tuple(store.notes), tuple(gaps))


def _fly(
    workers: Threads | DaskCluster,
    tasks: Iterator[Future[Any]],
    batches: _Batches,
    progress: CampaignProgress,
    watch: Callable[[CampaignProgress], None],
    stop: Callable[[], bool],
    until_settled: bool,
) -> tuple[bool, bool]:
    """Fly the tasks, and return two flags: True if `stop` returned True, and True if all verdicts were settled."""
    stopped, settled = False, until_settled and progress.interim.settled()
    flying: set[Future[Any]] = set()
    landed: SimpleQueue[Future[Any]] = SimpleQueue()

    def begun(task: Future[Any]) -> None:
        flying.add(task)
        task.add_done_callback(landed.put)  # faster than a search of all tasks of a large cluster

    watch(progress)
    try:
        while not (settled or stopped):
            for task in islice(tasks, max(workers.ahead - len(flying), 0)):
                begun(task)
            if not flying:
                break
            arrived: list[Future[Any]] = []
            with suppress(Empty):
                arrived.append(landed.get(timeout=_POLL_S))
                arrived.extend(landed.get() for _ in range(landed.qsize()))
            for task in arrived:
                flying.remove(task)
                got = workers.collect(task)
                if isinstance(got, Future):
                    begun(got)
                else:
                    batches.enter(got)
            stopped = stop()
            settled = not stopped and until_settled and progress.interim.settled()
            watch(progress)
    finally:
        workers.end()
    for task in flying:
        if task.done() and not task.cancelled() and task.exception() is None:
            got = workers.collect(task)
            if not isinstance(got, Future):
                batches.enter(got)
    return stopped, settled


class _Batches:
    """The completed rows of batches that are not yet complete."""

    def __init__(self, store: Store, gaps: list[Gap], progress: CampaignProgress) -> None:
        self._store, self._gaps, self._progress = store, gaps, progress
        self._rows: dict[int, dict[int, Row]] = {}  # by the batch's first run and by run

    def enter(self, flown: Sequence[Row] | FlownBatch) -> None:
        if isinstance(flown, FlownBatch):
            part = flown.part
            size = part.last - part.first + 1
            self._progress.flown += size
            self._progress.interim.enter(part.first, size, flown.failed, flown.counts)
            self._store.write_files(part)
            return
        for row in flown:
            first, size = self._gaps[bisect_right(self._gaps, row.run, key=lambda gap: gap[0]) - 1]
            batch = self._rows.setdefault(first, {})
            batch[row.run] = row
            self._progress.flown += 1
            self._progress.interim.add(row.run, row.outcome, row.passed, row.cause, row.metrics)
            if len(batch) == size:
                self._store.write(list(batch.values()))
                del self._rows[first]

    def write_begun(self) -> None:
        """Write the completed runs of each batch in progress up to its first gap."""
        for first, batch in self._rows.items():
            whole = [batch[run] for run in takewhile(batch.__contains__, count(first))]
            if whole:
                self._store.write(whole)


class Threads:
    """The workers of a campaign that are threads of this process."""

    def __init__(self, campaign: LoadedCampaign, workers: int) -> None:
        self._campaign, self._workers = campaign, workers
        self._stop = threading.Event()
        self._own: OwnKernels | None = None
        self._pool = ThreadPoolExecutor(workers, thread_name_prefix="run")
        self.ahead = AHEAD * workers

    def batch(self, usual: int, runs: int) -> int:
        return usual

    def begin(self, gaps: list[Gap]) -> Iterator[Future[list[Row]]]:
        """Load the kernels if there are gaps, and return an iterator that submits the next task."""
        if not gaps:
            return iter(())
        self._own = OwnKernels(self._campaign, sum(size for _, size in gaps))
        return self._tasks(gaps, self._own.pack)

    def _tasks(self, gaps: list[Gap], pack: Packing) -> Iterator[Future[list[Row]]]:
        batches = ((self._campaign.plan.draw(first, size), first, size) for first, size in gaps)
        orders = ((drawn, run) for drawn, first, size in batches for run in range(first, first + size))
        left = sum(size for _, size in gaps)
        while chunk := list(islice(orders, min(max(left // (2 * self.ahead), 1), CHUNK))):
            left -= len(chunk)
            yield self._pool.submit(fly_rows, self._campaign, chunk, self._stop.is_set, pack)

    def collect(self, task: Future[list[Row]]) -> list[Row]:
        return task.result()

    def end(self) -> None:
        """Cancel the tasks that have not begun, and stop the others after their present segment."""
        self._stop.set()
        self._pool.shutdown(cancel_futures=True)
        if self._own is not None:
            self._own.end()


def _connected(address: str) -> Any:
    """Return a Dask client of the scheduler at an address. Raises CampaignError."""
    try:
        from distributed import Client  # noqa: PLC0415  # an extra

        return Client(address, timeout=20, set_as_default=False)
    except ImportError:
        raise CampaignError("a cluster needs dask.distributed: pip install 'maxq[dask]'") from None
    except (OSError, ValueError) as error:
        raise CampaignError(f"no Dask scheduler answers at {address}: {error}") from None


class DaskCluster:
    """The workers of a campaign that belong to a Dask client.

    A task receives the whole campaign, flies a batch, counts its failures, and returns the content of its files. The
    client writes these as they are, which takes less than a hundredth of the time of handling each row. Any worker can
    repeat a task at any time, and workers may join and leave. The rows equal those of a local campaign, bit for bit.
    """

    def __init__(self, campaign: LoadedCampaign, client: Any) -> None:
        self._given = campaign.campaign.batch is not None
        self._packed = zlib.compress(json.dumps(description_of(campaign)).encode())
        self._simulator = simulator()
        self._client, self._executor = client, client.get_executor(pure=False, retries=2)
        self._counted, self._counted_s = 0, -math.inf
        self._out: dict[Future[Any], tuple[int, int, int]] = {}  # first run, size, tries

    @property
    def _threads(self) -> int:
        """Return the number of threads of all workers, which the scheduler reports now and then."""
        if (now := time.monotonic()) - self._counted_s > _COUNT_S:
            self._counted, self._counted_s = sum(self._client.nthreads().values()), now
        return self._counted

    @property
    def ahead(self) -> int:
        return max(AHEAD * self._threads, 2)

    def batch(self, usual: int, runs: int) -> int:
        """Return the given batch size, or a batch size with which each thread of a large cluster has work."""
        return usual if self._given else min(usual, max(runs // (_SHARES * max(self._threads, 1)), 1))

    def begin(self, gaps: list[Gap]) -> Iterator[Future[Any]]:
        return (self._submit(first, size, 1) for first, size in gaps)

    def _submit(self, first: int, size: int, tries: int) -> Future[Any]:
        task: Future[Any] = self._executor.submit(fly_batch, self._packed, first, size, priority=-first)
        self._out[task] = first, size, tries
        return task

    def collect(self, task: Future[Any]) -> FlownBatch | Future[Any]:
        """Return the batch of a completed task, or a new task if the task failed and was submitted again.

        Raises CampaignError if the task failed _TRIES times, or if a worker has a different simulator.
        """
        first, size, tries = self._out.pop(task)
        try:
            flown: FlownBatch = task.result()
        except CampaignError:
            raise
        except Exception as error:  # from Dask: workers died, or the task was lost
            if tries < _TRIES:
                return self._submit(first, size, tries + 1)
            raise CampaignError(
                f"runs {first} to {first + size - 1} failed {tries} times on the cluster ({error!r}); "
                "whole batches are safe, the same command continues"
            ) from None
        if flown.simulator != self._simulator:
            others = {name: value for name, value in flown.simulator.items() if self._simulator.get(name) != value}
            raise CampaignError(f"a worker has another simulator ({others}): install the same maxq everywhere")
        return flown

    def end(self) -> None:
        self._executor.shutdown(wait=False)


@dataclass(frozen=True)
class FlownBatch:
    """A batch flown and evaluated by a worker of a cluster."""

    part: PartFiles
    failed: int  # number of runs that failed
    counts: list[Count]  # of each requirement
    simulator: dict[str, str]


def fly_batch(packed: bytes, first: int, size: int) -> FlownBatch:
    """Fly the runs `first` to `first + size - 1` on a worker of a cluster."""
    campaign, kernels = _unpacked(packed)
    drawn = campaign.plan.draw(first, size)
    orders = [(drawn, run) for run in range(first, first + size)]
    parts = (fly_rows(campaign, orders[k : k + CHUNK], pack=kernels.pack) for k in range(0, size, CHUNK))
    return evaluated(campaign, [row for rows in parts for row in rows])


def evaluated(campaign: LoadedCampaign, rows: Sequence[Row]) -> FlownBatch:
    """Return the files and the counts of consecutive runs."""
    part = files_of(rows, schema_of(campaign), campaign.campaign.envelope.channels)
    interim = Interim(campaign, part.first)
    for row in rows:
        interim.add(row.run, row.outcome, row.passed, row.cause, row.metrics)
    return FlownBatch(part, interim.failed, [(t.failures, t.worst) for t in interim.tallies], simulator())


@lru_cache(maxsize=2)
def _unpacked(packed: bytes) -> tuple[LoadedCampaign, OwnKernels]:
    """Return the campaign of a task, which a worker creates once, and its kernels, which the worker may compile."""
    campaign = campaign_from(json.loads(zlib.decompress(packed)))
    return campaign, OwnKernels(campaign, campaign.campaign.runs)
