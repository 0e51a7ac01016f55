"""The parameter records of a stage's feed lines."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from maxq.control.kernel.limits import MAX_FEED_LINES
from maxq.control.kernel.tables import NO_TABLE, Pool, fit
from maxq.sim.vehicle.engine.burn import Burn
from maxq.sim.vehicle.engine.kernel import Engine
from maxq.sim.vehicle.engine.packing import on_clock
from maxq.sim.vehicle.feed.kernel import FeedLine

if TYPE_CHECKING:
    from maxq.sim.scenario.schema_vehicle import Stage

_COLUMNS = (
    "head_kgpm2",
    "inertance_Pas2pkg",
    "resistance_Paspkg",
    "mass_flow_gain_s",
    "pump_gain",
    "discharge_inertance_Pas2pkg",
    "discharge_resistance_Paspkg",
    "chamber_gain_Paspkg",
)


def pack_feed_lines(stage: Stage, burn: Burn, engine: Engine, pool: Pool) -> tuple[FeedLine, ...]:
    """Return the feed lines of a stage, padded with unused ones, and add their tables to `pool`."""
    out = []
    for line in stage.feed_line:
        table = line.table
        compliance = table["compliance_kgpPa"] + table.get("accumulator_kgpPa")
        columns = np.stack([*(table.get(name) for name in _COLUMNS), compliance], axis=1)
        out.append(
            FeedLine(
                chamber=line.engine,
                engine=int(engine.taken_as[line.engine]),
                table=pool.add(on_clock(fit(table["time_s"], columns, stage.interpolation), burn)),
                chamber_lag_s=line.chamber_lag_s,
                thrust_gain_m2=line.thrust_gain_m2,
                area_m2=line.line_area_m2,
            )
        )
    return (*out, *[FeedLine(0, 0, NO_TABLE, 1.0, 0.0, 0.0)] * (MAX_FEED_LINES - len(out)))
