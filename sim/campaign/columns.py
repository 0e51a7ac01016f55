"""The data set's columns: rows to Arrow tables and back."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
import pyarrow as pa

from maxq.sim.campaign.flying import Row
from maxq.sim.campaign.loaded import LoadedCampaign
from maxq.sim.campaign.plan import SEED_KEY
from maxq.sim.campaign.wind import WIND_KEY
from maxq.sim.run.metrics import METRIC_NAMES

RUN, OUTCOME, PASSED, CAUSE, LOST, END, STEPS, REDRAWS, HASH = (
    "run", "outcome", "passed", "cause", "lost_s", "end_s", "steps", "redraws", "state_hash",
)  # fmt: skip
TIME_OF = "{}.time_s"
_NUMBERS = {pa.float64(): "f8", pa.int64(): "i8", pa.int32(): "i4", pa.bool_(): "?"}
_FIXED = (
    pa.field(RUN, pa.int64(), False),
    pa.field(OUTCOME, pa.string(), False),
    pa.field(PASSED, pa.bool_(), False),
    pa.field(CAUSE, pa.string(), False),
    pa.field(LOST, pa.float64()),
    pa.field(END, pa.float64()),
    pa.field(STEPS, pa.int64(), False),
    pa.field(REDRAWS, pa.int32(), False),
    pa.field(HASH, pa.string(), False),
)


def input_types(campaign: LoadedCampaign) -> dict[str, pa.DataType]:
    """Columns of what was drawn, in the order of the file."""
    plan = campaign.plan
    out = {d.name: pa.string() if d.is_text else pa.float64() for d in plan.draws}
    if plan.own_noise:
        out[SEED_KEY] = pa.int64()
    if plan.wind is not None:
        for name, value in plan.wind.recorded(plan.wind.scores(0, 0, 1)[0]).items():
            out[name] = pa.string() if name == WIND_KEY else pa.float64()
            assert isinstance(value, str | float)
    return out


def schema_of(campaign: LoadedCampaign) -> pa.Schema:
    """One row for each run: how it went, what was drawn (null where nothing could be), metrics and their times."""
    inputs = [pa.field(name, kind) for name, kind in input_types(campaign).items()]
    metrics = [pa.field(name, pa.float64()) for name in METRIC_NAMES]
    times = [pa.field(TIME_OF.format(name), pa.float64()) for name in METRIC_NAMES]
    return pa.schema([*_FIXED, *inputs, *metrics, *times])


def table_of(rows: Sequence[Row], schema: pa.Schema) -> pa.Table:
    """The rows in order of their runs."""
    rows = sorted(rows, key=lambda row: row.run)
    known = {
        RUN: [r.run for r in rows],
        OUTCOME: [r.outcome for r in rows],
        PASSED: [r.passed for r in rows],
        CAUSE: [r.cause for r in rows],
        LOST: [r.lost_s for r in rows],
        END: [r.end_s for r in rows],
        STEPS: [r.steps for r in rows],
        REDRAWS: [r.redraws for r in rows],
        HASH: [r.state_hash for r in rows],
    }
    for name in METRIC_NAMES:
        known[name] = [r.metrics[name] for r in rows]
        known[TIME_OF.format(name)] = [r.times_s[name] for r in rows]
    columns: list[Any] = [known[f.name] if f.name in known else [r.inputs.get(f.name) for r in rows] for f in schema]
    return _table(columns, schema)


def history_schema(channels: Iterable[str]) -> pa.Schema:
    """Histories: one row for each run, a list of numbers for each channel, over `time_s`."""
    lists = [pa.field(name, pa.list_(pa.float32())) for name in ("time_s", *channels)]
    return pa.schema([pa.field(RUN, pa.int64(), False), *lists])


def history_table(rows: Sequence[Row], channels: Sequence[str]) -> pa.Table:
    """Histories of the rows that have one."""
    rows = sorted((row for row in rows if row.history is not None), key=lambda row: row.run)
    columns: list[Any] = [[r.run for r in rows], [r.history.time_s for r in rows if r.history]]
    for n in range(len(channels)):
        columns.append([r.history.values[n] for r in rows if r.history])
    return _table(columns, history_schema(channels))


def _table(columns: Sequence[Sequence[Any]], schema: pa.Schema) -> pa.Table:
    return pa.Table.from_arrays([array_of(c, f.type) for c, f in zip(columns, schema, strict=True)], schema=schema)


def array_of(values: Sequence[Any], kind: pa.DataType) -> pa.Array:
    """Numbers, flags, texts (None: null), or lists of single-precision numbers, as Arrow holds them.

    pa.array gives the same, but where pandas is installed it imports it first: 0.3 s of every campaign.
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


def numbers(column: Any) -> np.ndarray:
    """A column of numbers as an array; null is nan."""
    return np.asarray(column.to_numpy(), dtype=float)
