"""Many runs of a campaign at once on a GPU: prepared and judged on the CPU, flown side by side."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor

from maxq.sim.campaign.flying import Begun, GivenUp, Order, Row, fly_rows, prepared, row_of
from maxq.sim.campaign.loaded import LoadedCampaign
from maxq.sim.packing.flight import pack_flight
from maxq.sim.run.batch import batch_of, fly_batch, hand_back

MOST = 1024
"""Runs flown side by side: their tables take a megabyte each of this machine's memory, twice."""


def fly_side_by_side(
    loaded: LoadedCampaign, orders: Sequence[Order], threads: ThreadPoolExecutor, stop: Callable[[], bool]
) -> list[Row]:
    """Fly these runs on the GPU; the rows in their order. Runs that keep channels for an envelope fly on the CPU.

    Raises GivenUp when `stop` says so, DeviceError, and CampaignError where the file refuses the draws.
    """
    every = list(threads.map(lambda order: _prepared(loaded, order, stop), orders))
    packed = [run.flight.packed for run in every if isinstance(run, Begun)]
    if packed:
        batch = batch_of(packed)
        if not fly_batch(batch, "cuda", stop):
            raise GivenUp
        hand_back(batch, packed)
    return list(threads.map(row_of, every))


def _prepared(loaded: LoadedCampaign, order: Order, stop: Callable[[], bool]) -> Begun | Row:
    envelope = loaded.campaign.envelope
    if not (order[1] < envelope.runs and envelope.channels):
        return prepared(loaded, order, pack_flight)
    rows = fly_rows(loaded, [order], stop)
    if not rows:
        raise GivenUp
    return rows[0]
