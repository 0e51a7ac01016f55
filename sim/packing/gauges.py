"""The record of a stage's gauges: chamber pressures and tank levels for flight code."""

from __future__ import annotations

import numpy as np

from maxq.control.kernel.limits import MAX_ENGINES, MAX_PENDULUMS
from maxq.control.kernel.tables import NO_TABLE, Pool, fit
from maxq.sim.scenario.schema_vehicle import Stage
from maxq.sim.vehicle.engine.burn import Burn
from maxq.sim.vehicle.engine.packing import on_clock
from maxq.sim.vehicle.sensor.gauges import Gauges


def pack_gauges(stage: Stage, burn: Burn, pool: Pool) -> Gauges:
    """Return the gauges of a stage, and add its tables to `pool`; a tank without a table of its liquid has zeros."""
    peaks = np.ones(MAX_ENGINES)
    for k, engine in enumerate(stage.engines):
        peaks[k] = max(float(engine.table["thrust_vacuum_N"].max()), 1e-300)
    liquid = []
    for body, _, tank in stage.tanks[:MAX_PENDULUMS]:
        table = tank.table
        if "liquid_mass_kg" not in table:
            liquid.append(NO_TABLE)
            continue
        mass = fit(table["time_s"], table["liquid_mass_kg"][:, None], stage.interpolation)
        liquid.append(pool.add(on_clock(mass, burn.of(body))))
    padded = (*liquid, *[NO_TABLE] * (MAX_PENDULUMS - len(liquid)))
    return Gauges(len(stage.engines), peaks, len(liquid), padded)
