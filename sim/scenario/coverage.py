"""The checks that tables over time cover the powered flight."""

from __future__ import annotations

from collections.abc import Sequence

from pydantic_core import PydanticCustomError

from maxq.sim.input.errors import Path, refuse
from maxq.sim.input.tables_csv import CsvTable
from maxq.sim.scenario.schema_booster import Booster
from maxq.sim.scenario.schema_vehicle import Stage
from maxq.sim.vehicle.engine.burn import burn_rate, nominal_burnout_s, stage_spans, thrust_end_s

_SAME_S = 1e-9
"""The difference below which two times are the same instant, s."""


def check_stages(stages: Sequence[Stage], flight_end_s: float, thrust_must_end: bool) -> float:
    """Reject tables that end before the thrust of their stage does, and return the end of the powered flight, s.

    `flight_end_s` and the result are on the vehicle clock; the result is 0 without thrust. With `thrust_must_end`, a
    thrust table that does not end at zero is rejected if the flight continues after it.
    """
    powered_end_s = 0.0
    for n, (stage, (start_s, end_s)) in enumerate(zip(stages, stage_spans(stages), strict=True)):
        key: Path = ("vehicle", "stage", n)
        _check_stage_tables(stage, end_s, key)
        for k, booster in enumerate(stage.booster):
            _check_body_tables(booster, end_s - booster.ignition_s, (*key, "booster", k))
        if thrust_must_end and not stage.gated:
            _check_thrust_ends(stage, min(flight_end_s - start_s, end_s), key)
        burn_end_s = min(nominal_burnout_s(stage), end_s)
        if burn_end_s > 0.0:
            powered_end_s = start_s + burn_end_s
    return powered_end_s


def _check_body_tables(body: Stage | Booster, ends_s: float, key: Path) -> float:
    """Reject tables of a body that end before its thrust does, and return the end of thrust on the tables' clock, s.

    `ends_s` is the end of the body's flight with the stage, on the body's clock.
    """
    end = min(thrust_end_s(body), ends_s * burn_rate(body))
    tables: list[tuple[Path, CsvTable | None]] = [(("mass", "table"), body.mass.table)]
    tables += [(("tank", n, "table"), tank.table) for n, tank in enumerate(body.tank)]
    _check_ends(tables, end, key)
    mass = body.mass
    if mass.burn_s is not None and mass.mass_flow_kgps and mass.burn_s < end:
        raise refuse("mass flow ends before the thrust does", f"at least {end:g}", (*key, "mass", "burn_s"))
    return end


def _check_stage_tables(stage: Stage, ends_s: float, key: Path) -> None:
    """Reject tables of a stage that end before its thrust does, and an ignition after the end of thrust.

    `ends_s` is the end of the stage on its own clock.
    """
    end = _check_body_tables(stage, ends_s, key)
    tables: list[tuple[Path, CsvTable | None]] = [(("mass", "rate_damping"), stage.mass.rate_damping)]
    if stage.aero is not None:
        tables.append((("aero", "moment_reference_over_time"), stage.aero.moment_reference_over_time))
    if stage.spatial_modes is not None:
        tables.append((("spatial_modes", "table"), stage.spatial_modes.table))
    if stage.bending is not None:
        tables += [(("bending", "pitch"), stage.bending.pitch), (("bending", "yaw"), stage.bending.yaw)]
    _check_ends(tables, end, key)
    if stage.own_engines and end > 0.0 and stage.ignition_s * burn_rate(stage) >= end:
        raise refuse("ignition comes after the end of thrust", f"less than {end:g}", (*key, "ignition_s"))


def _check_ends(tables: Sequence[tuple[Path, CsvTable | None]], end: float, key: Path) -> None:
    for place, table in tables:
        if table is not None and table["time_s"][0] < table["time_s"][-1] < end:
            raise _ends_too_early(table, "the table ends before the thrust does", end, key + place)


def _ends_too_early(table: CsvTable, problem: str, end_s: float, key: Path) -> PydanticCustomError:
    return table.refusal(problem, f"a last time_s >= {end_s:g}", "time_s", len(table) - 1, at=key)


def _check_thrust_ends(stage: Stage, ends_s: float, key: Path) -> None:
    """Reject a thrust table that does not end at zero if the stage flies on until `ends_s` on its clock.

    A table may end with positive thrust at the instant at which the propellant is spent.
    """
    column, spent_s = "thrust_vacuum_N", stage.mass.spent_s(stage.ignition_s)
    burns_out = abs(thrust_end_s(stage) - spent_s) < _SAME_S
    for n, table in enumerate(engine.table for engine in stage.own_engines):
        last = float(table["time_s"][-1]) / burn_rate(stage)
        spent = burns_out and abs(table["time_s"][-1] - spent_s) < _SAME_S
        if len(table) > 1 and table[column][-1] > 0.0 and ends_s > last and not spent:
            problem = f"thrust does not end at zero, and the flight goes on after {last:g} s"
            at = (*key, *stage.engine_key(n), "table")
            allowed = f"0 in the last row, or the end of the mass flow ({spent_s:g} s) as the last time"
            raise table.refusal(problem, allowed, column, len(table) - 1, at=at)


def check_programme(table: CsvTable, start: float, end: float) -> None:
    """Reject a guidance programme that does not cover the powered flight from `start` to `end`, s.

    A programme that ends early is allowed if all rates of its last row are zero.
    """
    key: Path = ("guidance", "programme")
    if len(table) == 1:
        return
    if table["time_s"][0] > start:
        raise table.refusal("the programme begins too late", f"a first time_s <= {start:g}", "time_s", 0, at=key)
    commands_nothing = all(column[-1] == 0.0 for name, column in table.columns.items() if name != "time_s")
    if table["time_s"][-1] < end and not commands_nothing:  # the last row holds, and a rate that persists is an error
        raise _ends_too_early(table, "the programme ends before the thrust does", end, key)


def check_gains(table: CsvTable, key: Path, end: float) -> None:
    """Reject a gain table that is entirely outside the powered flight, which ends at `end`, s.

    Beyond the ends of the table, the gains are held.
    """
    if len(table) == 1:
        return
    for wrong, problem, allowed in (
        (table["time_s"][0] > end, "all gains lie after the powered flight", f"a first time_s <= {end:g}"),
        (table["time_s"][-1] < 0.0, "all gains lie before the flight", "a last time_s >= 0"),
    ):
        if wrong:
            raise table.refusal(problem, allowed, "time_s", 0, at=key)
