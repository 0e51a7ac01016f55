"""A campaign on a dask.distributed cluster: batches as tasks, written once, here.

    from distributed import Client
    from maxq.sim.campaign.cluster import run_on_cluster

    run_on_cluster(load_campaign("campaigns/ksr3"), Path("runs/ksr3"), Client("tcp://head:8786"))

A task gets the whole campaign, so that it can be repeated by any worker at any time; workers may come and go. It
returns the rows of a batch, bit for bit what threads on this machine give. Needs maxq[dask].
"""

from __future__ import annotations

import json
import zlib
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from contextlib import ExitStack
from functools import lru_cache
from pathlib import Path
from typing import Any

from maxq.sim.campaign.error import CampaignError
from maxq.sim.campaign.read import LoadedCampaign, campaign_from, description_of
from maxq.sim.campaign.runner import AHEAD, CHUNK, Gap, Outcome, Progress, fly_missing
from maxq.sim.campaign.runs import Row, fly_rows
from maxq.sim.campaign.store import simulator

_TRIES = 5  # of a batch whose workers die; Dask itself tries each one several times
_SHARES = 4  # batches for each thread, at least


def fly_batch(packed: bytes, first: int, size: int) -> tuple[list[Row], dict[str, str]]:
    """The task: fly runs `first` .. `first + size - 1`. Returns their rows, and what flew them."""
    campaign = _unpacked(packed)
    drawn = campaign.batch(first, size)
    orders = [(drawn, run) for run in range(first, first + size)]
    return [row for k in range(0, size, CHUNK) for row in fly_rows(campaign, orders[k : k + CHUNK])], simulator()


@lru_cache(maxsize=2)
def _unpacked(packed: bytes) -> LoadedCampaign:
    """The campaign of a task; a worker makes it once."""
    return campaign_from(json.loads(zlib.decompress(packed)))


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
        raise CampaignError("a cluster needs dask.distributed: pip install 'maxq[dask]'") from None
    with ExitStack() as stack:
        if isinstance(cluster, str):
            try:
                client = stack.enter_context(Client(cluster, timeout=20, set_as_default=False))
            except (OSError, ValueError) as error:
                raise CampaignError(f"--dask {cluster}: no scheduler answers there: {error}") from None
        else:
            client = cluster
        return fly_missing(campaign, folder, _Cluster(campaign, client), watch, stop, until_settled)


class _Cluster:
    """The workers of a Dask client: tasks are whole batches."""

    def __init__(self, campaign: LoadedCampaign, client: Any) -> None:
        self._given = campaign.campaign.batch is not None
        self._packed = zlib.compress(json.dumps(description_of(campaign)).encode())
        self._client, self._executor = client, client.get_executor(pure=False, retries=2)
        self._out: dict[Future[Any], tuple[int, int, int]] = {}  # first run, size, tries

    @property
    def _threads(self) -> int:
        return sum(self._client.nthreads().values())

    @property
    def ahead(self) -> int:
        return max(AHEAD * self._threads, 2)

    def batch(self, usual: int, runs: int) -> int:
        """Small enough that no thread of a large cluster is left without one."""
        return usual if self._given else min(usual, max(runs // (_SHARES * max(self._threads, 1)), 1))

    def begin(self, gaps: list[Gap]) -> Iterator[Future[Any]]:
        return (self._submit(first, size, 1) for first, size in gaps)

    def _submit(self, first: int, size: int, tries: int) -> Future[Any]:
        task: Future[Any] = self._executor.submit(fly_batch, self._packed, first, size, priority=-first)
        self._out[task] = first, size, tries
        return task

    def collect(self, task: Future[Any]) -> list[Row] | Future[Any]:
        first, size, tries = self._out.pop(task)
        try:
            rows, theirs = task.result()
        except CampaignError:
            raise
        except Exception as error:  # of Dask: its workers died, or it lost the task
            if tries < _TRIES:
                return self._submit(first, size, tries + 1)
            raise CampaignError(
                f"runs {first} to {first + size - 1} failed {tries} times on the cluster ({error!r}); "
                "whole batches are safe, the same command continues"
            ) from None
        ours = simulator()
        if theirs != ours:
            others = {name: value for name, value in theirs.items() if ours.get(name) != value}
            raise CampaignError(f"a worker has another simulator ({others}): install the same maxq everywhere")
        return list(rows)

    def end(self) -> None:
        self._executor.shutdown(wait=False)
