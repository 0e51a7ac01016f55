"""Runs of a campaign: their scenarios are flown, what became of each is one row."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from maxq.control.kernel.records import Array
from maxq.sim.campaign.loaded import BatchInputs, Inputs, LoadedCampaign
from maxq.sim.campaign.schema import Envelope
from maxq.sim.campaign.targets import Refused
from maxq.sim.flight.telemetry import FAST, SLOW
from maxq.sim.packing.flight import Packed, pack_flight, pack_for_one_vehicle
from maxq.sim.packing.schedule import stage_sizes
from maxq.sim.run.fly import CONTROL_LOST_NAME, DIVERGED_NAME, Flight, FlightRun, Rows, logged_channels
from maxq.sim.run.metrics import METRIC_NAMES
from maxq.sim.scenario.loader import LoadedScenario
from maxq.sim.scenario.nanoseconds import NS_PER_S
from maxq.sim.scenario.schema_scenario import Scenario

REFUSED, ERROR = "refused", "error"
"""Outcomes beside those of a flight: no scenario came of the draws; our own fault."""
VOID = (DIVERGED_NAME, REFUSED, ERROR)
"""Outcomes whose metrics say nothing: such a run misses every requirement."""

OWN_KERNELS_FROM = 500  # runs

Order = tuple[BatchInputs, int]
"""A run, and where its draws are."""
Packing = Callable[[Scenario], Packed]

_SEGMENT_NS = 60 * NS_PER_S  # of a flight, a tenth of a second's work: between two of them it can be given up


class GivenUp(Exception):
    """The campaign is to end: the flight is dropped."""


@dataclass
class Row:
    """What is recorded of one run."""

    run: int
    outcome: str
    passed: bool
    cause: str
    lost_s: float  # control lost or diverged; nan: neither
    end_s: float
    steps: int
    redraws: int
    state_hash: str
    inputs: dict[str, Any]
    metrics: dict[str, float]
    times_s: dict[str, float]
    history: History | None = field(default=None, repr=False)


@dataclass(frozen=True)
class History:
    """Thinned-out channels of one run: `time_s` (n,), `values` (channels, n)."""

    time_s: NDArray[np.float32]
    values: NDArray[np.float32]


@dataclass
class Begun:
    """A run that is prepared, under way or flown: its draws and its flight."""

    made: Inputs
    flight: FlightRun
    envelope: Envelope | None  # whose channels it keeps
    kept: list[tuple[Array, Array]] = field(default_factory=list, repr=False)


def fly_rows(
    loaded: LoadedCampaign, orders: Iterable[Order], stop: Callable[[], bool] = lambda: False
) -> list[Row]:  # fmt: skip
    """Fly these runs, one after the other; the rows of those that were flown before `stop` said so, in their order.

    Whatever happens in a run becomes its row. All are prepared before the first is flown, and judged after the last:
    a flight drives Python's code and data out of the processor's caches, and to fetch them again for each run costs as
    much as the preparation itself. Raises CampaignError where the file refuses the draws.
    """
    flown: list[Begun | Row] = []
    pack = packer(loaded)
    for run in [prepared(loaded, order, pack) for order in orders]:
        try:
            flown.append(run if isinstance(run, Row) else _flown(run, stop))
        except GivenUp:
            break
    return [row_of(run) for run in flown]


def prepared(loaded: LoadedCampaign, order: Order, pack: Packing) -> Begun | Row:
    """A run at its start, or the row of one that cannot be flown. Raises CampaignError."""
    batch, run = order
    try:
        made = batch.inputs(run)
    except Refused as refused:
        return void_row(run, REFUSED, f"no such scenario: {refused}")
    wanted = loaded.campaign.envelope
    envelope = wanted if run < wanted.runs and wanted.channels else None
    try:
        return Begun(made, _begun_flight(made.loaded, envelope, pack), envelope)
    except Exception as error:  # one run in ten thousand must not end a campaign: the row says what happened
        return _failed(made, error)


def _flown(run: Begun, stop: Callable[[], bool]) -> Begun | Row:
    """Fly it to its end. Raises GivenUp."""
    try:
        _fly_on(run.flight, run.envelope, run.kept, stop)
    except GivenUp:
        raise
    except Exception as error:  # as above
        return _failed(run.made, error)
    return run


def row_of(run: Begun | Row) -> Row:
    """The row of a run that has been flown."""
    if isinstance(run, Row):
        return run
    try:
        return recorded_row(run.made, run.flight.result(), _history(run.envelope, run.kept))
    except Exception as error:  # as above
        return _failed(run.made, error)


def packer(loaded: LoadedCampaign) -> Packing:
    """Many runs are worth kernels of their own; few are flown by the common ones. Their results are the same bits."""
    return pack_for_one_vehicle if loaded.campaign.runs >= OWN_KERNELS_FROM else pack_flight


def fly_scenario(loaded: LoadedScenario) -> Flight:
    """Fly without a log."""
    flight = _begun_flight(loaded, None, pack_flight)
    while not flight.finished:
        flight.fly_segment()
    return flight.result()


def _begun_flight(loaded: LoadedScenario, envelope: Envelope | None, pack: Packing) -> FlightRun:
    """A flight at its start, without a log; with the channels of an envelope where one is given."""
    packed = pack(loaded.scenario)
    step_ns = int(packed.parameters[0].timeline.step_ns)
    if envelope is not None:
        period_ns = max(round(NS_PER_S / envelope.rate_hz / step_ns), 1) * step_ns
        packed.parameters["timeline"]["fast_ns"] = period_ns
        packed.parameters["timeline"]["slow_ns"] = period_ns
    segment_ns = max(_SEGMENT_NS // step_ns, 1) * step_ns
    return FlightRun(loaded, packed, log=envelope is not None, segment_ns=segment_ns)


def _fly_on(
    flight: FlightRun, envelope: Envelope | None, kept: list[tuple[Array, Array]], stop: Callable[[], bool]
) -> None:  # fmt: skip
    """To the end; into `kept` the times and values of an envelope's channels, segment by segment."""
    wanted = envelope.channels if envelope is not None else ()
    columns = [(flight.table.topic(channel).group, flight.table.index(channel)) for channel in wanted]
    while not flight.finished:
        if stop():
            raise GivenUp
        rows = flight.fly_segment()
        if envelope is not None:
            kept.append(_picked(rows, columns, envelope.rate_hz))


def _history(envelope: Envelope | None, kept: list[tuple[Array, Array]]) -> History | None:
    if envelope is None:
        return None
    times, values = (np.concatenate([part[i] for part in kept], axis=-1) for i in (0, 1))
    return History(times.astype(np.float32), values.astype(np.float32))


def _picked(rows: Rows, columns: Sequence[tuple[str, int]], rate_hz: float) -> tuple[Array, Array]:
    """Times (n,) and values (channels, n) of the segment; the flight's last instant falls outside the grid."""
    times = rows[SLOW][0] / NS_PER_S
    on_grid = np.abs(times * rate_hz - np.rint(times * rate_hz)) < 1e-6
    return times[on_grid], np.array([rows[group][1][: len(times), column][on_grid] for group, column in columns])


def recorded_row(made: Inputs, flight: Flight, history: History | None = None) -> Row:
    lost = [event.time_s for event in flight.events if event.name in (CONTROL_LOST_NAME, DIVERGED_NAME)]
    return Row(
        run=made.run,
        outcome=flight.outcome,
        passed=flight.passed,
        cause="; ".join(flight.failures),
        lost_s=min(lost, default=math.nan),
        end_s=flight.end_s,
        steps=flight.steps,
        redraws=made.redraws,
        state_hash=flight.state_hash,
        inputs=made.recorded,
        metrics=flight.metrics,
        times_s=flight.metric_times_s,
        history=history,
    )


def void_row(run: int, outcome: str, cause: str) -> Row:
    nothing = dict.fromkeys(METRIC_NAMES, math.nan)
    return Row(run, outcome, False, cause, math.nan, math.nan, 0, 0, "", {}, nothing, dict(nothing))


def _failed(made: Inputs, error: Exception) -> Row:
    """A run that met a fault of ours. Memory that is short is the machine's: raised again."""
    if isinstance(error, MemoryError):
        raise error
    row = void_row(made.run, ERROR, f"{type(error).__name__}: {error}")
    row.inputs, row.redraws = made.recorded, made.redraws
    return row


def channel_units(loaded: LoadedScenario) -> dict[str, str]:
    """Log channels that an envelope may ask for, with their units."""
    stages = loaded.vehicle.stage
    widest = max((stage_sizes(stage, loaded.scenario.switches) for stage in stages), key=lambda s: s.tanks)
    table = logged_channels(loaded.vehicle, widest)
    return {channel.name: channel.unit for group in (FAST, SLOW) for channel in table.columns(group)}
