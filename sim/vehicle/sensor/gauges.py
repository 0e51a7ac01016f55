"""The gauges of engines and tanks, for flight code: chamber pressures and masses of liquid, without error.

The chamber pressure is proportional to the vacuum thrust, as for a nozzle with a constant thrust coefficient. It is
given relative to that at the largest thrust of the engine's table.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated

import numpy as np

from maxq.control.kernel.jit import routine
from maxq.control.kernel.limits import MAX_ENGINES, MAX_PENDULUMS
from maxq.control.kernel.records import Array
from maxq.control.kernel.tables import NO_TABLE, TableRef, look_up
from maxq.sim.vehicle.block import Counts
from maxq.sim.vehicle.engine.kernel import Engine
from maxq.sim.vehicle.schedule import thrust_column


@dataclass(frozen=True)
class Gauges:
    """The parameters of the gauges of a stage; `liquid` has one column per tank, over the schedule's clock, kg."""

    engines: int = 0
    peak_N: Annotated[Array, (MAX_ENGINES,)] = field(default_factory=lambda: np.ones(MAX_ENGINES))
    tanks: int = 0
    liquid: Annotated[tuple[TableRef, ...], (MAX_PENDULUMS,)] = (NO_TABLE,) * MAX_PENDULUMS


@routine
def read_gauges(
    g: Gauges, e: Engine, sizes: Counts, pool: Array, clock_s: float, properties: Array, chamber: Array, tanks: Array
) -> None:
    """Write the chamber pressures of all engines, relative, and the liquid of all tanks, kg; unused places are 0."""
    for k in range(MAX_ENGINES):
        chamber[k] = 0.0
        if k < g.engines:
            curve = e.curve[e.taken_as[k]]
            chamber[k] = properties[thrust_column(sizes, curve)] / g.peak_N[k]
    for k in range(MAX_PENDULUMS):
        tanks[k] = 0.0
        if k < g.tanks and g.liquid[k].n_breaks > 0:
            tanks[k] = look_up(pool, g.liquid[k], clock_s, 0)
