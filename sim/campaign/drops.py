"""The drop points of a campaign: the impact points of separated stages, boosters and fairings."""

from __future__ import annotations

import numpy as np

from maxq.sim.packing.environment import pack_earth
from maxq.sim.packing.flight import Packed
from maxq.sim.run.flight import Flight
from maxq.sim.run.impact import air_column, has_impacts
from maxq.sim.run.impact_channels import drop_point, dropped_body
from maxq.sim.scenario.schema_scenario import Scenario

DROP_COLUMNS = ("drop_{}_latitude_deg", "drop_{}_longitude_deg", "drop_{}_fall_s")


def drop_columns(scenario: Scenario) -> list[str]:
    """Return the columns of the data set for the drop points of a scenario, numbered by separation from 1."""
    if not has_impacts(pack_earth(scenario.earth)):
        return []
    return [name.format(n) for n in range(1, len(scenario.vehicle.stage)) for name in DROP_COLUMNS]


def drops_of(flight: Flight, packed: Packed) -> dict[str, float]:
    """Return the columns of `drop_columns` for a run flown as `packed`; empty without recorded separations."""
    scenario = flight.scenario.scenario
    if not flight.separations or not drop_columns(scenario):
        return {}
    earth, stages = pack_earth(scenario.earth), scenario.vehicle.stage
    ground_m = min(scenario.site.altitude_m, 0.0)
    bodies = [
        dropped_body(stages, s.stage, s.time_ns / 1e9, np.array(s.r_I_m), np.array(s.v_I_mps))
        for s in flight.separations
    ]
    air = air_column(packed, ground_m) if any(body.ballistic_kgpm2 is not None for body in bodies) else None
    out: dict[str, float] = {}
    for body in bodies:
        point = drop_point(earth, body, air, ground_m)
        values = point.latitude_deg, point.longitude_deg, point.fall_s
        out |= {name.format(body.number): value for name, value in zip(DROP_COLUMNS, values, strict=True)}
    return out
