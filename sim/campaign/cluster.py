"""A campaign on a dask.distributed cluster: batches as tasks, written once, here.

    from distributed import Client
    from maxq.sim.campaign.cluster import run_on_cluster

    run_on_cluster(load_campaign("campaigns/ksr3"), Path("runs/ksr3"), Client("tcp://head:8786"))

A task gets the whole campaign, so that it can be repeated by any worker at any time; workers may come and go. What it
returns is the batch as it will be written, bit for bit what threads on this machine give. Needs maxq[dask].
"""

from __future__ import annotations

import json
import time
import zlib
from collections.abc import Callable, Iterator
from functools import lru_cache
from pathlib import Path
from typing import Any

import pyarrow as pa

from maxq.control.kernel.jit import source_hash
from maxq.sim.campaign import columns
from maxq.sim.campaign.error import CampaignError
from maxq.sim.campaign.flying import fly_rows
from maxq.sim.campaign.loaded import LoadedCampaign
from maxq.sim.campaign.read import campaign_from, description_of
from maxq.sim.campaign.runner import HANDFUL, Outcome, Progress
from maxq.sim.campaign.standing import Standing
from maxq.sim.campaign.store import Store, open_store
from maxq.sim.run.record import versions

_LOOK_S = 0.2
_TRIES = 5  # of a batch whose workers die; Dask itself tries each one several times
_SHARES = 4  # batches for each thread, at least
_AHEAD = 2  # batches for each thread of the cluster that are handed out
_EXTRA = "a cluster needs dask.distributed: pip install 'maxq[dask]'"

Tables = tuple[pa.Table, pa.Table]


def fly_batch(packed: bytes, first: int, count: int) -> dict[str, Any]:
    """The task: fly runs `first` .. `first + count - 1`. Returns tables as bytes, and what flew them."""
    campaign = _unpacked(packed)
    inputs = campaign.batch(first, count)
    orders = [(inputs, run) for run in range(first, first + count)]
    rows = [row for k in range(0, count, HANDFUL) for row in fly_rows(campaign, orders[k : k + HANDFUL])]
    table = columns.table_of(rows, columns.schema_of(campaign))
    histories = columns.history_table(rows, campaign.campaign.envelope.channels)
    return {"runs": _bytes(table), "histories": _bytes(histories), "simulator": _simulator()}


@lru_cache(maxsize=2)
def _unpacked(packed: bytes) -> LoadedCampaign:
    """The campaign of a task; a worker makes it once."""
    return campaign_from(json.loads(zlib.decompress(packed)))


def _bytes(table: pa.Table) -> bytes:
    sink = pa.BufferOutputStream()
    with pa.ipc.new_stream(sink, table.schema) as stream:
        stream.write_table(table)
    return bytes(sink.getvalue())


def _table(content: bytes) -> pa.Table:
    with pa.ipc.open_stream(content) as stream:
        return stream.read_all()


def _simulator() -> dict[str, str]:
    return {"kernels": source_hash(), **versions()}


def run_on_cluster(
    campaign: LoadedCampaign,
    folder: Path,
    cluster: Any,
    *,
    watch: Callable[[Progress], None] = lambda _: None,
    stop: Callable[[], bool] = lambda: False,
    until_settled: bool = False,
) -> Outcome:
    """As `run_campaign`, on the workers of a scheduler: its address, or a dask Client. Raises CampaignError."""
    try:
        from distributed import Client  # noqa: PLC0415  # an extra
    except ImportError:
        raise CampaignError(_EXTRA) from None
    store, batch = open_store(folder, campaign)
    try:
        if not isinstance(cluster, str):
            return _Cluster(campaign, store, cluster).run(batch, watch, stop, until_settled)
        try:
            client = Client(cluster, timeout=20, set_as_default=False)
        except (OSError, ValueError) as error:
            raise CampaignError(f"--dask {cluster}: no scheduler answers there: {error}") from None
        with client:
            return _Cluster(campaign, store, client).run(batch, watch, stop, until_settled)
    finally:
        store.unlock()


class _Cluster:
    """Batches that are out on the cluster."""

    def __init__(self, campaign: LoadedCampaign, store: Store, client: Any) -> None:
        self._campaign, self._store, self._client = campaign, store, client
        self._packed = zlib.compress(json.dumps(description_of(campaign)).encode())
        self._out: dict[Any, tuple[int, int, int]] = {}  # future -> first run, count, tries

    def run(
        self, batch: int, watch: Callable[[Progress], None], stop: Callable[[], bool], until_settled: bool
    ) -> Outcome:
        runs = self._campaign.campaign.runs
        if self._campaign.campaign.batch is None:  # no thread of a large cluster is to wait for want of a batch
            batch = min(batch, max(runs // (_SHARES * max(self._threads, 1)), 1))
        gaps = list(self._store.missing(runs, batch))
        standing = Standing.of(self._store, self._campaign, runs)
        progress = Progress(runs, runs - sum(count for _, count in gaps), standing=standing)
        waiting = iter(gaps)
        stopped, settled = False, until_settled and standing.settled()
        watch(progress)
        try:
            while not settled and self._go_on(waiting, progress):
                if stop():
                    stopped = True
                    break
                settled = until_settled and standing.settled()
                watch(progress)
        finally:
            if self._out:
                self._client.cancel(list(self._out))
        watch(progress)
        return Outcome(progress.flown, runs, stopped, settled, progress.elapsed_s, tuple(self._store.notes))

    @property
    def _threads(self) -> int:
        return sum(self._client.nthreads().values())

    def _go_on(self, waiting: Iterator[tuple[int, int]], progress: Progress) -> bool:
        """Hand out batches, write those that came back. False when all is done."""
        while len(self._out) < max(_AHEAD * self._threads, 2):
            order = next(waiting, None)
            if order is None:
                break
            self._submit(*order, 1)
        if not self._out:
            return False
        back = [future for future in self._out if future.done()]
        if not back:
            time.sleep(_LOOK_S / 10.0)
        for future in back:
            first, count, tries = self._out.pop(future)
            if future.status == "finished":
                self._enter(future.result(), progress)
            else:
                self._try_again(future, first, count, tries)
        return True

    def _submit(self, first: int, count: int, tries: int) -> None:
        future = self._client.submit(fly_batch, self._packed, first, count, pure=False, retries=2, priority=-first)
        self._out[future] = (first, count, tries)

    def _try_again(self, future: Any, first: int, count: int, tries: int) -> None:
        error = future.exception() if future.status == "error" else None
        if isinstance(error, CampaignError):
            raise error
        if tries >= _TRIES:
            raise CampaignError(
                f"runs {first} to {first + count - 1} failed {tries} times on the cluster ({error!r}); "
                "whole batches are safe, the same command goes on"
            )
        self._submit(first, count, tries + 1)

    def _enter(self, result: dict[str, Any], progress: Progress) -> None:
        if result["simulator"] != _simulator():
            theirs = {k: v for k, v in result["simulator"].items() if _simulator().get(k) != v}
            raise CampaignError(f"a worker has another simulator ({theirs}): install the same maxq everywhere")
        table = _table(result["runs"])
        self._store.write_tables(table, _table(result["histories"]))
        progress.flown += len(table)
        progress.standing.add_table(table)
