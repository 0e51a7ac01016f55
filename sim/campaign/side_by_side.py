"""Many runs of a campaign at once on a GPU: prepared and judged on the CPU, flown side by side."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

from maxq.sim.campaign.flying import REFUSED, GivenUp, Row, failed_row, fly_row, row_of, void_row
from maxq.sim.campaign.plan import BatchInputs, Inputs, LoadedCampaign
from maxq.sim.campaign.targets import Refused
from maxq.sim.flight.batch import batch_of, fly_batch, hand_back
from maxq.sim.flight.fly import FlightRun

MOST = 1024
"""Runs flown side by side: their tables take a megabyte each of this machine's memory, twice."""

Order = tuple[BatchInputs, int]


@dataclass(frozen=True)
class _Begun:
    made: Inputs
    flight: FlightRun


def fly_rows(
    loaded: LoadedCampaign, orders: Sequence[Order], threads: ThreadPoolExecutor, stop: Callable[[], bool]
) -> list[Row]:
    """Fly these runs on the GPU; the rows in their order. Runs that keep channels for an envelope fly on the CPU.

    Raises GivenUp when `stop` says so, DeviceError, and CampaignError where the file refuses the draws.
    """
    prepared = list(threads.map(lambda order: _prepared(loaded, order, stop), orders))
    begun = [p for p in prepared if isinstance(p, _Begun)]
    packed = [p.flight.packed for p in begun]
    if begun:
        batch = batch_of(packed)
        if not fly_batch(batch, "cuda", stop):
            raise GivenUp
        hand_back(batch, packed)
    return list(threads.map(_row, prepared))


def _prepared(loaded: LoadedCampaign, order: Order, stop: Callable[[], bool]) -> _Begun | Row:
    inputs, run = order
    envelope = loaded.campaign.envelope
    if run < envelope.runs and envelope.channels:
        return fly_row(loaded, inputs, run, stop)
    try:
        made = inputs.inputs(run)
    except Refused as refused:
        return void_row(run, REFUSED, f"no such scenario: {refused}")
    try:
        return _Begun(made, FlightRun(made.loaded, log=False))
    except MemoryError:
        raise
    except Exception as error:  # one run in ten thousand must not end a campaign: the row says what happened
        return failed_row(made, error)


def _row(prepared: _Begun | Row) -> Row:
    if isinstance(prepared, Row):
        return prepared
    made = prepared.made
    try:
        return row_of(made.run, prepared.flight.result(), made.recorded, made.redraws)
    except MemoryError:
        raise
    except Exception as error:  # as above
        return failed_row(made, error)
