"""The data set's columns: rows to Arrow tables and back."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
import pyarrow as pa

from maxq.sim.campaign.flying import Row
from maxq.sim.campaign.plan import SEED_KEY, LoadedCampaign
from maxq.sim.campaign.wind import WIND_KEY
from maxq.sim.flight.judgement import METRIC_NAMES

RUN, OUTCOME, PASSED, CAUSE, LOST, END, STEPS, REDRAWS, HASH = (
    "run", "outcome", "passed", "cause", "lost_s", "end_s", "steps", "redraws", "state_hash",
)  # fmt: skip
TIME_OF = "{}.time_s"
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
    columns = [known[f.name] if f.name in known else [r.inputs.get(f.name) for r in rows] for f in schema]
    return pa.table([pa.array(c, f.type) for c, f in zip(columns, schema, strict=True)], schema=schema)


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
    schema = history_schema(channels)
    return pa.table([pa.array(c, f.type) for c, f in zip(columns, schema, strict=True)], schema=schema)


def numbers(column: Any) -> np.ndarray:
    """A column of numbers as an array; null is nan."""
    return np.asarray(column.to_numpy(), dtype=float)
