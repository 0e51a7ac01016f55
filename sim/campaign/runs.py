"""The runs of a campaign, each of which is flown and recorded in a row of the data set, even after an error."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from itertools import takewhile
from typing import Any

import numpy as np
import pyarrow as pa

from maxq.control.kernel.records import Array
from maxq.sim.campaign.drops import drop_columns, drops_of
from maxq.sim.campaign.plan import SEED_KEY, Drawn
from maxq.sim.campaign.read import Inputs, LoadedCampaign
from maxq.sim.campaign.schema import Envelope
from maxq.sim.campaign.targets import Refused
from maxq.sim.flight.metric_table import METRIC_NAMES
from maxq.sim.flight.telemetry import SLOW
from maxq.sim.input.values import NS_PER_S
from maxq.sim.packing.flight import Packed, pack_flight
from maxq.sim.run.flight import Flight, LoggedRows
from maxq.sim.run.fly import CONTROL_LOST_NAME, DIVERGED_NAME, SOFTWARE_NAME, FlightRun, with_half_step
from maxq.sim.scenario.loader import LoadedScenario
from maxq.sim.scenario.schema_scenario import Scenario

REFUSED, ERROR = "refused", "error"
"""The outcomes in addition to those of a flight: draws that give no valid scenario, and an error of this program."""
VOID = (DIVERGED_NAME, SOFTWARE_NAME, REFUSED, ERROR)
"""The outcomes without usable metrics. A run with such an outcome misses every requirement."""
TIME_OF = "{}.time_s"
"""The name of the column with the time of a metric."""

RunOrder = tuple[Drawn, int]
"""The draws of the batch of a run, and the number of the run."""
Packing = Callable[[Scenario], Packed]

_SEGMENT_NS = 100 * NS_PER_S  # a tenth of a second of computing; a flight can be cancelled between two segments


@dataclass
class Row:
    """The record of a run. The fields of `_COLUMNS` are columns of the data set with the same names."""

    run: int
    outcome: str
    passed: bool
    cause: str
    lost_s: float  # time of loss of control or divergence, nan if neither occurred
    end_s: float
    steps: int
    halvings: int  # number of halvings of the step that the integration errors required, at most MOST_HALVINGS
    redraws: int
    state_hash: str
    inputs: dict[str, Any]
    metrics: dict[str, float]
    times_s: dict[str, float]
    drops: dict[str, float] = field(default_factory=dict)  # columns of `drop_columns`
    history: tuple[Array, Array] | None = field(default=None, repr=False)  # times (n,), s, and values (channels, n)


def fly_rows(
    loaded: LoadedCampaign,
    orders: Iterable[RunOrder],
    stop: Callable[[], bool] = lambda: False,
    pack: Packing = pack_flight,
) -> list[Row]:
    """Fly consecutive runs, and return in order the rows of the runs completed before `stop` returned True.

    An error in a run is recorded in its row. A run whose integration errors are too large is flown again with half the
    step. All runs are prepared before the first is flown, and judged after the last. A flight displaces Python's code
    and data from the processor's caches, and reloading them for each run would take as long as the preparation. Only
    external flight code is started for each run in turn, because it flies in a separate process, one for each thread.
    Raises CampaignError if the campaign rejects the draws.
    """
    computer = loaded.base.scenario.vehicle.computer
    runs = [_Run(loaded, drawn, run) for drawn, run in orders]
    for run in runs:
        run.pack(pack)
    if computer is None or computer.law != "external":
        for run in runs:
            run.begin()
    flown = list(takewhile(lambda run: run.fly(stop), runs))
    rows = (run.recorded(pack, stop) for run in flown)
    return [row for row in takewhile(lambda row: row is not None, rows) if row is not None]


class _Run:
    """A run that is drawn, packed, flown and recorded. If a step fails, `row` is set and contains the reason."""

    def __init__(self, loaded: LoadedCampaign, drawn: Drawn, run: int) -> None:
        wanted = loaded.campaign.envelope
        self.envelope = wanted if run < wanted.runs and wanted.channels else None
        self.kept: list[tuple[Array, Array]] = []  # times and values of the envelope's channels, by segment
        self.flight: FlightRun | None = None
        self.row: Row | None = None
        try:
            self.made = loaded.inputs(run, drawn)
        except Refused as refused:
            self.row = _void_row(run, REFUSED, f"no such scenario: {refused}")

    def pack(self, pack: Packing) -> None:
        if self.row is None:
            with self._errors_recorded():
                self.packed = pack(self.made.loaded.scenario)

    def begin(self) -> None:
        """Create the flight at its start, which also starts external flight code."""
        if self.row is None and self.flight is None:
            with self._errors_recorded():
                self.flight = _begun_flight(self.made.loaded, self.envelope, self.packed)

    @contextmanager
    def _errors_recorded(self) -> Iterator[None]:
        """Record an exception in the row of the run, so that a single run does not end a campaign.

        MemoryError concerns the machine and is raised.
        """
        try:
            yield
        except MemoryError:
            raise
        except Exception as error:
            self.row = _void_row(self.made.run, ERROR, f"{type(error).__name__}: {error}")
            self.row.inputs, self.row.redraws = self.made.recorded, self.made.redraws

    def fly(self, stop: Callable[[], bool]) -> bool:
        """Fly the run to its end, and return True; return False if `stop` returned True before the end."""
        self.begin()
        if self.flight is None:
            return True
        with self._errors_recorded():
            table, wanted = self.flight.table, self.envelope.channels if self.envelope is not None else ()
            columns = [(table.topic(channel).group, table.index(channel)) for channel in wanted]
            while not self.flight.finished:
                if stop():
                    return False
                rows = self.flight.fly_segment()
                if self.envelope is not None:
                    self.kept.append(_on_grid(rows, columns, self.envelope.rate_hz))
        return True

    def recorded(self, pack: Packing, stop: Callable[[], bool]) -> Row | None:
        """Return the row of a completed run, after repetitions with a finer step if its integration errors require it.

        The result is None if `stop` returned True during a repetition.
        """
        while self.row is None and self.flight is not None:
            with self._errors_recorded():
                flight = self.flight.result()
                finer = with_half_step(flight)
                if finer is not None:
                    self.made, self.flight, self.kept = replace(self.made, loaded=finer), None, []
                    self.packed = pack(finer.scenario)
                    if not self.fly(stop):
                        return None
                    continue
                row = recorded_row(self.made, flight)
                row.drops = drops_of(flight, self.packed)
                if self.envelope is not None:
                    times, values = zip(*self.kept, strict=True)
                    row.history = np.concatenate(times), np.concatenate(values, axis=-1)
                self.row = row
        assert self.row is not None
        return self.row


def _on_grid(rows: LoggedRows, columns: Sequence[tuple[str, int]], rate_hz: float) -> tuple[Array, Array]:
    """Return the times (n,), s, and values (channels, n) of a segment on the grid of `rate_hz`.

    The last instant of a flight is usually not on the grid.
    """
    times = rows[SLOW][0] / NS_PER_S
    on_grid = np.flatnonzero(np.abs(times * rate_hz - np.rint(times * rate_hz)) < 1e-6)
    return times[on_grid], np.array([rows[group][1][on_grid, column] for group, column in columns])


def fly_scenario(loaded: LoadedScenario) -> Flight:
    """Return the flight of a scenario without a log, repeated with half the step while integration errors are large."""
    run = _begun_flight(loaded, None, pack_flight(loaded.scenario))
    while not run.finished:
        run.fly_segment()
    flight = run.result()
    finer = with_half_step(flight)
    return flight if finer is None else fly_scenario(finer)


def fly_histories(
    loaded: LoadedScenario, channels: tuple[str, ...], rate_hz: float, stop: Callable[[], bool] = lambda: False
) -> tuple[Flight, Array, Array] | None:
    """Return a flight, and times (n,), s, and values (channels, n) of channels at about `rate_hz`.

    The flight is repeated with half the step while integration errors are large. The result is None if `stop` returned
    True before the end.
    """
    run = _begun_flight(loaded, Envelope(channels=channels, rate_hz=min(rate_hz, 100.0)), pack_flight(loaded.scenario))
    groups = [(run.table.topic(channel).group, run.table.index(channel)) for channel in channels]
    times, values = [], []
    while not run.finished:
        if stop():
            return None
        rows = run.fly_segment()
        times.append(rows[SLOW][0] / NS_PER_S)
        values.append(np.array([rows[group][1][:, column] for group, column in groups]))
    flight = run.result()
    finer = with_half_step(flight)
    if finer is not None:
        return fly_histories(finer, channels, rate_hz, stop)
    return flight, np.concatenate(times), np.concatenate(values, axis=1)


def _begun_flight(loaded: LoadedScenario, envelope: Envelope | None, packed: Packed) -> FlightRun:
    """Return a flight at its start, with log rows at the rate of the envelope, or without rows if it is None."""
    timeline = packed.parameters[0].timeline
    step_ns = 1 if timeline.even == 1 else int(timeline.step_ns)  # step of the grid of the rows
    if envelope is not None:
        period_ns = max(round(NS_PER_S / envelope.rate_hz / step_ns), 1) * step_ns
        packed.parameters["timeline"]["fast_ns"] = period_ns
        packed.parameters["timeline"]["slow_ns"] = period_ns
    segment_ns = max(_SEGMENT_NS // step_ns, 1) * step_ns
    return FlightRun(loaded, packed, log=envelope is not None, segment_ns=segment_ns)


def recorded_row(made: Inputs, flight: Flight) -> Row:
    lost = [event.time_s for event in flight.events if event.name in (CONTROL_LOST_NAME, DIVERGED_NAME)]
    return Row(
        run=made.run,
        outcome=flight.outcome,
        passed=flight.passed,
        cause="; ".join(flight.failures),
        lost_s=min(lost, default=math.nan),
        end_s=flight.end_s,
        steps=flight.steps,
        halvings=flight.scenario.scenario.run.halvings,
        redraws=made.redraws,
        state_hash=flight.state_hash,
        inputs=made.recorded,
        metrics=flight.metrics,
        times_s=flight.metric_times_s,
    )


def _void_row(run: int, outcome: str, cause: str) -> Row:
    nothing = dict.fromkeys(METRIC_NAMES, math.nan)
    return Row(run, outcome, False, cause, math.nan, math.nan, 0, 0, 0, "", {}, nothing, dict(nothing))


# the data set's columns

_COLUMNS = (
    pa.field("run", pa.int64(), False),
    pa.field("outcome", pa.string(), False),
    pa.field("passed", pa.bool_(), False),
    pa.field("cause", pa.string(), False),
    pa.field("lost_s", pa.float64()),
    pa.field("end_s", pa.float64()),
    pa.field("steps", pa.int64(), False),
    pa.field("halvings", pa.int32(), False),
    pa.field("redraws", pa.int32(), False),
    pa.field("state_hash", pa.string(), False),
)
_NUMBERS = {pa.float64(): "f8", pa.int64(): "i8", pa.int32(): "i4", pa.bool_(): "?"}


def input_types(campaign: LoadedCampaign) -> dict[str, pa.DataType]:
    """Return the types of the columns of all draws, by name: [[disperse]], then noise and wind."""
    plan = campaign.plan
    out = {d.name: pa.string() if d.is_text else pa.float64() for d in plan.draws}
    if plan.own_noise:
        out[SEED_KEY] = pa.int64()
    if plan.wind is not None:
        recorded = plan.wind.recorded(plan.wind.scores(0, 0, 1)[0])
        out |= {k: pa.string() if isinstance(value, str) else pa.float64() for k, value in recorded.items()}
    return out


def schema_of(campaign: LoadedCampaign) -> pa.Schema:
    """Return the schema of the data set, which has a row for each run.

    Its columns are the outcome, the draws (null for a run that could not be drawn), the metrics and their times, and
    the drop points of vehicles with separations.
    """
    inputs = [pa.field(name, kind) for name, kind in input_types(campaign).items()]
    metrics = [pa.field(name, pa.float64()) for name in (*METRIC_NAMES, *map(TIME_OF.format, METRIC_NAMES))]
    drops = [pa.field(name, pa.float64()) for name in drop_columns(campaign.base.scenario)]
    return pa.schema([*_COLUMNS, *inputs, *metrics, *drops])


def table_of(rows: Sequence[Row], schema: pa.Schema) -> pa.Table:
    """Return a table of the rows in order of their runs."""
    rows = sorted(rows, key=lambda row: row.run)
    known = {column.name: [getattr(row, column.name) for row in rows] for column in _COLUMNS}
    for name in METRIC_NAMES:
        known[name] = [row.metrics[name] for row in rows]
        known[TIME_OF.format(name)] = [row.times_s[name] for row in rows]
    others = [row.inputs | row.drops for row in rows]
    columns = [known[f.name] if f.name in known else [other.get(f.name) for other in others] for f in schema]
    return _table(columns, schema)


def history_table(rows: Sequence[Row], channels: Sequence[str]) -> pa.Table:
    """Return a table of the rows with a history, with columns for `run` and lists of `time_s` and channel values."""
    lists = [pa.field(name, pa.list_(pa.float32())) for name in ("time_s", *channels)]
    schema = pa.schema([pa.field("run", pa.int64(), False), *lists])
    kept = sorted(((r.run, r.history) for r in rows if r.history is not None), key=lambda item: item[0])
    columns: list[Any] = [[run for run, _ in kept], [times_s for _, (times_s, _) in kept]]
    return _table([*columns, *([values[n] for _, (_, values) in kept] for n in range(len(channels)))], schema)


def _table(columns: Sequence[Sequence[Any]], schema: pa.Schema) -> pa.Table:
    return pa.Table.from_arrays([array_of(c, f.type) for c, f in zip(columns, schema, strict=True)], schema=schema)


def array_of(values: Sequence[Any], kind: pa.DataType) -> pa.Array:
    """Return numbers, flags, texts or lists of single-precision numbers as an Arrow array, with None as null.

    pa.array would give the same result, but imports pandas if it is installed, which takes 0.3 s in every campaign.
    """
    if pa.types.is_list(kind):
        ends = np.cumsum([0, *map(len, values)], dtype=np.int32)
        flat = np.concatenate(values, dtype=np.float32) if len(values) else np.zeros(0, np.float32)
        return pa.ListArray.from_arrays(_filled(ends, pa.int32()), _filled(flat, pa.float32()))
    missing = np.array([value is None for value in values], bool)
    known = None if not missing.any() else pa.py_buffer(np.packbits(~missing, bitorder="little"))
    if pa.types.is_string(kind):
        texts = [(value or "").encode() for value in values]
        ends = np.cumsum([0, *map(len, texts)], dtype=np.int32)
        return pa.Array.from_buffers(kind, len(texts), [known, pa.py_buffer(ends), pa.py_buffer(b"".join(texts))])
    numbers = np.array([0 if value is None else value for value in values], _NUMBERS[kind])
    if pa.types.is_boolean(kind):
        numbers = np.packbits(numbers, bitorder="little")
    return _filled(numbers, kind, len(values), known)


def _filled(numbers: np.ndarray, kind: pa.DataType, count: int | None = None, known: pa.Buffer | None = None) -> Any:
    count = len(numbers) if count is None else count
    return pa.Array.from_buffers(kind, count, [known, pa.py_buffer(np.ascontiguousarray(numbers))])
