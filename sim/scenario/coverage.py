"""Whether tables over time cover the powered flight.

A table with one row is constant and covers everything. Times are on the clock of the tables; the burn-rate
factor `mass_flow_factor` makes that clock run faster than the stage clock.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
from pydantic_core import PydanticCustomError

from maxq.sim.scenario.errors import Path, refuse
from maxq.sim.scenario.schema_vehicle import Stage
from maxq.sim.scenario.tables_csv import CsvTable

if TYPE_CHECKING:
    from maxq.sim.scenario.schema_scenario import Scenario


def thrust_end_s(stage: Stage) -> float:
    """Time of the stage's tables from which on there is no thrust; 0 without an engine or with constant
    thrust.

    When the thrust table does not end at zero, its last time.
    """
    if any(len(engine.table) == 1 for engine in stage.engines):
        return 0.0
    return max((_table_end_s(engine.table) for engine in stage.engines), default=0.0)


def _table_end_s(table: CsvTable) -> float:
    time, burning = table["time_s"], np.flatnonzero(table["thrust_vacuum_N"] > 0.0)
    if len(burning) == 0:
        return 0.0
    return float(time[min(int(burning[-1]) + 1, len(time) - 1)])


def burn_rate(stage: Stage) -> float:
    """Seconds of the tables' clock per second of the stage clock."""
    rates = {engine.mass_flow_factor for engine in stage.engines}
    if len(rates) < 2:
        return rates.pop() if rates else 1.0
    peak_N = [float(engine.table["thrust_vacuum_N"].max()) for engine in stage.engines]
    burnt = sum(peak * engine.mass_flow_factor for peak, engine in zip(peak_N, stage.engines, strict=True))
    return burnt / sum(peak_N)


def stage_end_s(stage: Stage) -> float:
    """When the stage separates, on its clock; infinite for the last one."""
    if stage.separation_s is not None:
        return stage.separation_s
    if stage.separation_after_burnout_s is not None:
        return thrust_end_s(stage) / burn_rate(stage) + stage.separation_after_burnout_s
    return math.inf


def check_coverage(scenario: Scenario) -> None:
    """Refuse tables of vehicle, design and guidance that end before the powered flight does."""
    start = scenario.run.start_s
    flight_end = start + scenario.run.duration_s
    stage_start, powered_end = 0.0, 0.0
    for n, stage in enumerate(scenario.vehicle.stage):
        key: Path = ("vehicle", "stage", n)
        _check_stage(stage, key)
        if scenario.switches.thrust and scenario.run.freeze_vehicle_at_s is None:
            _check_thrust_ends(stage, min(flight_end - stage_start, stage_end_s(stage)), key)
        burn_end = min(thrust_end_s(stage) / burn_rate(stage), stage_end_s(stage))
        if burn_end > 0.0:
            powered_end = stage_start + burn_end
        stage_start += stage_end_s(stage)
    if powered_end == 0.0 or not scenario.switches.thrust:
        return
    programme, design = scenario.guidance.programme, scenario.design
    if programme is not None and scenario.switches.guidance and start < powered_end:
        _check_programme(programme, start, min(powered_end, flight_end))
    if design is not None:
        for name, table in (("table", design.gains.table), ("yaw_table", design.gains.yaw_table)):
            if table is not None and design.gains.over == "time_s":
                _check_gains(table, ("design", "gains", name), powered_end)


def _check_stage(stage: Stage, key: Path) -> None:
    end = min(thrust_end_s(stage), stage_end_s(stage) * burn_rate(stage))
    tables: list[tuple[Path, CsvTable | None]] = [(("mass", "table"), stage.mass.table)]
    tables += [(("tank", n, "table"), tank.table) for n, tank in enumerate(stage.tank)]
    tables.append((("mass", "rate_damping"), stage.mass.rate_damping))
    if stage.aero is not None:
        tables.append((("aero", "moment_reference_over_time"), stage.aero.moment_reference_over_time))
    if stage.spatial_modes is not None:
        tables.append((("spatial_modes", "table"), stage.spatial_modes.table))
    if stage.bending is not None:
        tables += [(("bending", "pitch"), stage.bending.pitch), (("bending", "yaw"), stage.bending.yaw)]
    for place, table in tables:
        if table is not None and table["time_s"][0] < table["time_s"][-1] < end:
            raise _ends_too_early(table, "the table ends before the thrust does", end, key + place)
    if stage.engines and end > 0.0 and stage.ignition_s * burn_rate(stage) >= end:
        raise refuse("ignition comes after the end of thrust", f"less than {end:g}", (*key, "ignition_s"))
    mass = stage.mass
    if mass.burn_s is not None and mass.mass_flow_kgps and mass.burn_s < end:
        raise refuse("mass flow ends before the thrust does", f"at least {end:g}", (*key, "mass", "burn_s"))


def _ends_too_early(table: CsvTable, problem: str, end_s: float, key: Path) -> PydanticCustomError:
    return table.refusal(problem, f"a last time_s >= {end_s:g}", "time_s", len(table) - 1, at=key)


def _check_thrust_ends(stage: Stage, ends_s: float, key: Path) -> None:
    column = "thrust_vacuum_N"
    for n, table in enumerate(engine.table for engine in stage.engines):
        last = float(table["time_s"][-1]) / burn_rate(stage)
        if len(table) > 1 and table[column][-1] > 0.0 and ends_s > last:
            problem = f"thrust does not end at zero, and the flight goes on after {last:g} s"
            at = (*key, *stage.engine_key(n), "table")
            raise table.refusal(problem, "0 in the last row", column, len(table) - 1, at=at)


def _check_programme(table: CsvTable, start: float, end: float) -> None:
    key: Path = ("guidance", "programme")
    if len(table) == 1:
        return
    if table["time_s"][0] > start:
        raise table.refusal("the programme begins too late", f"a first time_s <= {start:g}", "time_s", 0, at=key)
    commands_nothing = all(column[-1] == 0.0 for name, column in table.columns.items() if name != "time_s")
    if table["time_s"][-1] < end and not commands_nothing:  # its last row holds: a rate that goes on is a mistake
        raise _ends_too_early(table, "the programme ends before the thrust does", end, key)


def _check_gains(table: CsvTable, key: Path, end: float) -> None:
    """Gains are held outside their table, but some of it must lie in the powered flight."""
    if len(table) == 1:
        return
    for wrong, problem, allowed in (
        (table["time_s"][0] > end, "all gains lie after the powered flight", f"a first time_s <= {end:g}"),
        (table["time_s"][-1] < 0.0, "all gains lie before the flight", "a last time_s >= 0"),
    ):
        if wrong:
            raise table.refusal(problem, allowed, "time_s", 0, at=key)
