"""The parameter record of a stage's aerodynamics from its section in the vehicle file."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from maxq.control.kernel.grids import Extension, Grid, GridRefs, fit_grid
from maxq.control.kernel.limits import MAX_SURFACES
from maxq.control.kernel.records import Array
from maxq.control.kernel.tables import NO_TABLE, Cubics, Method, Pool, fit, merge
from maxq.sim.input.remembered import cached_by_identity
from maxq.sim.input.tables_csv import CsvTable
from maxq.sim.vehicle.air import incidence
from maxq.sim.vehicle.air import section as schema
from maxq.sim.vehicle.air.incidence import N_ROLES, ROLES, IncidenceTables
from maxq.sim.vehicle.air.kernel import CA, CA_COAST, FIRST_SURFACE, FIXED, OVER_MASS, OVER_TIME, Aero
from maxq.sim.vehicle.air.section import AeroSurface
from maxq.sim.vehicle.air.tables import grid_table
from maxq.sim.vehicle.body.section import Reference
from maxq.sim.vehicle.engine.burn import Burn
from maxq.sim.vehicle.engine.packing import on_clock

if TYPE_CHECKING:
    from maxq.sim.scenario.schema_booster import Booster
    from maxq.sim.scenario.schema_scenario import Scenario
    from maxq.sim.scenario.schema_vehicle import Stage

_MOVES = {"": FIXED, "time_s": OVER_TIME, "mass_kg": OVER_MASS}
_POWER = {"always": incidence.ALWAYS, "on": incidence.POWER_ON, "off": incidence.POWER_OFF}
_AXES = {
    "mach": incidence.MACH_AXIS,
    "total_deg": incidence.TOTAL,
    "roll_deg": incidence.ROLL,
    "alpha_deg": incidence.ALPHA,
    "beta_deg": incidence.BETA,
}
_ROLE_OF = {name: (role, 1.0) for role, name in enumerate(ROLES)} | {
    "CA": (incidence.CX, -1.0), "CN": (incidence.CZ, -1.0), "CD": (incidence.CX, -1.0), "CL": (incidence.CZ, -1.0),
}  # fmt: skip  # a table: role and sign of each column
_EXTENSIONS: dict[str, Extension] = {"total_deg": "mirror", "roll_deg": "periodic"}
_ACROSS = (incidence.CY, incidence.CZ, incidence.CM, incidence.CN)


def pack_aero(scenario: Scenario, stage: Stage, burn: Burn, pool: Pool) -> Aero:
    """Return the stage's aerodynamics with the scenario's switches, and add its tables to `pool`."""
    reference: Reference = scenario.vehicle.reference
    aero = stage.aero or schema.AeroSection.model_construct()  # the defaults, without a table
    on = stage.aero is not None and scenario.switches.aerodynamics
    lifting, increments = _boosters(stage)
    moves, table = aero.moment_reference
    mach_table, moving, remainder = NO_TABLE, NO_TABLE, -1
    stations = np.zeros(MAX_SURFACES + 1)
    given = surface_stations(stage)
    stations[: len(given)] = given
    if on:
        fixed_m = 0.0 if moves else aero.moment_reference_m
        mach_table = pool.add(
            _mach_table(aero.table, aero.surface, aero.interpolation, fixed_m, reference.chord_m, increments)
        )
        joined = fit(table[moves], table["station_m"], stage.interpolation if moves else "linear")
        moving = pool.add(on_clock(joined, burn) if moves == "time_s" else joined)
        if moves and has_remainder(aero.table) and "x_cp_m" not in aero.table:
            remainder = len(aero.surface)
    station = aero.crossflow_station_m
    places = np.zeros((2, MAX_SURFACES + 1))
    behind = len(given) - len(aero.coefficients) - len(lifting)
    for k, booster in enumerate(lifting, start=behind):
        places[:, k] = booster.position_m
    return Aero(
        on=int(on),
        table=mach_table,
        area_m2=reference.area_m2,
        chord_m=reference.chord_m,
        yaw_chord_m=reference.yaw_chord_m,
        span_m=reference.span_m,
        crossflow_station_m=0.5 * reference.length_m if station is None else station,
        earth_rates=int(aero.rate_reference == "earth"),
        lag_m=aero.lag_m or math.inf,
        local_incidence=int(scenario.switches.local_incidence),
        penetration=int(scenario.switches.gust_penetration),
        force_factor=aero.force_factor,
        axial_factor=aero.axial_factor,
        damping_factor=aero.damping_factor,
        centre_shift_m=aero.centre_shift_m,
        airspeed_floor_mps=aero.airspeed_floor_mps,
        tables=_incidence_tables(aero, pool if on else Pool()),
        station_m=stations,
        place_y_m=places[0],
        place_z_m=places[1],
        off_axis=FIRST_SURFACE + 2 * (behind + len(lifting)) if increments else -1,
        reference=moving,
        reference_moves=_MOVES[moves],
        remainder=remainder,
    )


def _incidence_tables(aero: schema.AeroSection, pool: Pool) -> IncidenceTables:
    grids, axis = np.zeros((MAX_SURFACES, 6), np.int64), np.zeros((MAX_SURFACES, 3), np.int64)
    role = np.zeros((MAX_SURFACES, N_ROLES), np.int64)
    axes, along_wind, power, rates = np.zeros((4, MAX_SURFACES), np.int64)
    first_roll = np.zeros(MAX_SURFACES)
    for j, given in enumerate(aero.coefficients):
        made, names = _fitted(given.table, given.aeroballistic, given.interpolation or aero.interpolation)
        sizes = [len(breaks) for breaks in made.breaks]
        grids[j] = pool.put(*made.breaks, made.nodes), *sizes, len(names), made.nodes.shape[3]
        axis[j, : len(given.grid.axes)] = [_AXES[name] for name in given.grid.axes]
        role[j, : len(names)] = [_ROLE_OF[name][0] for name in names]
        axes[j] = incidence.AEROBALLISTIC if given.aeroballistic else incidence.BODY_AXES
        along_wind[j] = int("CD" in names or "CL" in names)
        power[j], rates[j] = _POWER[given.power], int(role[j].max() >= incidence.CLP)
        if "roll_deg" in given.grid.axes:
            first_roll[j] = made.breaks[given.grid.axes.index("roll_deg")][0]
    return IncidenceTables(GridRefs(grids), axis, role, axes, along_wind, power, first_roll, rates)


@cached_by_identity
def _fitted(table: CsvTable, aeroballistic: bool, method: str) -> tuple[Grid, tuple[str, ...]]:
    """Return the grid of a table for `incidence.py`, with angles in rad, and the names of its columns."""
    given = grid_table(table)
    missing = 3 - len(given.axes)
    breaks = [b if name == "mach" else np.radians(b) for name, b in zip(given.axes, given.breaks, strict=True)]
    signs = np.array([_ROLE_OF[name][1] for name in given.names])
    across = np.array([aeroballistic and _ROLE_OF[name][0] in _ACROSS for name in given.names])
    values: Array = given.values * signs
    beyond: list[Extension] = [_EXTENSIONS.get(name, "open") for name in given.axes] + ["open"] * missing
    made = fit_grid(
        [*breaks, *[np.zeros(1)] * missing],
        values.reshape(*values.shape[:-1], *[1] * missing, len(signs)),
        method == "pchip",
        beyond,
        np.where(across, -1.0, 1.0),
    )
    return made, given.names


@cached_by_identity
def _mach_table(
    table: CsvTable,
    surfaces: tuple[schema.AeroSurface, ...],
    method: Method,
    reference_m: float,
    chord_m: float,
    boosters: tuple[tuple[CsvTable, tuple[float, float]], ...],
) -> Cubics:
    """Return the columns of vehicle/air/kernel.py over Mach number.

    `boosters`: table of increments and position (y, z in m) of each booster with increments.

    The normal force is stored as slope and slope times station. Hence a moment about a fixed reference is transferred
    exactly to a moving CG, even where the slope is zero.
    """
    coast = table["CA_coast"] if "CA_coast" in table else table.get("CA")
    columns = [table.get("CA"), coast, table.get("CD"), table.get("Cmq")]
    columns += [table["Cnr"] if "Cnr" in table else table.get("Cmq"), table.get("Clp")]
    columns += [table.get("C_crossflow"), table.get("Cm0")]
    assert len(columns) == FIRST_SURFACE
    parts = [fit(table["mach"], np.stack(columns, axis=1), method)]
    for surface in surfaces:
        slope, place = surface.table["CN_alpha_pr"], surface.table["station_m"]
        parts.append(fit(surface.table["mach"], np.stack([slope, slope * place], axis=1), method))
    if has_remainder(table):
        parts.append(_remainder(table, parts[1:], method, reference_m, chord_m))
    if not boosters:
        return merge(parts)
    axial = []
    for increments, (y, z) in boosters:
        mach = increments["mach"]
        if "CN_alpha_pr" in increments:
            slope = increments["CN_alpha_pr"]
            parts.append(fit(mach, np.stack([slope, slope * increments["station_m"]], axis=1), method))
        force = increments.get("CA")
        axial.append(fit(mach, np.stack([force, y * force, z * force], axis=1), method))
    merged = merge([*parts, *axial])
    c, first = merged.coefficients, sum(part.n_columns for part in parts)
    added = c[:, :, first:].reshape(*c.shape[:2], len(axial), 3).sum(axis=2)
    out = np.concatenate([c[:, :, :first], added[:, :, 1:]], axis=2)
    out[:, :, CA : CA_COAST + 1] += added[:, :, :1]
    return Cubics(merged.breaks, out)


def _boosters(stage: Stage) -> tuple[tuple[Booster, ...], tuple[tuple[CsvTable, tuple[float, float]], ...]]:
    """Return the boosters with a normal force, and table and position of all boosters with increments."""
    given = [(booster, booster.aero.table) for booster in stage.booster if booster.aero is not None]
    lifting = tuple(booster for booster, table in given if "CN_alpha_pr" in table)
    return lifting, tuple((table, booster.position_m) for booster, table in given)


def _remainder(table: CsvTable, surfaces: list[Cubics], method: Method, reference_m: float, chord_m: float) -> Cubics:
    """Return the normal force of the table of coefficients minus the sum over the surfaces."""
    slope = table.get("CN_alpha_pr")
    if "x_cp_m" in table:
        moment = slope * table["x_cp_m"]
    else:
        moment = slope * reference_m - chord_m * table.get("Cm_alpha_pr")
    total = fit(table["mach"], np.stack([slope, moment], axis=1), method)
    if not surfaces:
        return total
    together = merge([total, *surfaces])
    c = together.coefficients
    for k in range(1, len(surfaces) + 1):
        c[:, :, :2] -= c[:, :, 2 * k : 2 * k + 2]
    return Cubics(together.breaks, c[:, :, :2].copy())


def surface_stations(stage: Stage) -> tuple[float, ...]:
    """Return the stations, m, at which mode shapes and wind are evaluated, one for each lifting surface.

    The station of a surface is the mean over its Mach table. Three groups follow: one station for the normal force in
    excess of the surfaces' sum, then those of the boosters, and of the tables over angle of attack.
    """
    aero = stage.aero
    if aero is None:
        return ()
    reference_m = float(aero.moment_reference[1]["station_m"].mean())
    tables = (reference_m if table.station_m is None else table.station_m for table in aero.coefficients)
    boosters = (float(b.aero.table["station_m"].mean()) for b in _boosters(stage)[0] if b.aero is not None)
    return (*_stations(aero.table, aero.surface, reference_m), *boosters, *tables)


def surface_bodies(stage: Stage) -> tuple[int, ...]:
    """Return the body of each of `surface_stations`: 0 for the core, then the boosters from 1."""
    lifting = _boosters(stage)[0]
    tables = len(stage.aero.coefficients) if stage.aero is not None else 0
    own = len(surface_stations(stage)) - len(lifting) - tables
    return (*(0,) * own, *(stage.booster.index(b) + 1 for b in lifting), *(0,) * tables)


@cached_by_identity
def _stations(table: CsvTable, surfaces: tuple[AeroSurface, ...], reference_m: float) -> tuple[float, ...]:
    stations = [float(surface.table["station_m"].mean()) for surface in surfaces]
    if has_remainder(table):
        place = table["x_cp_m"] if "x_cp_m" in table else np.array([reference_m])
        stations.append(float(place.mean()))
    return tuple(stations)


def has_remainder(table: CsvTable) -> bool:
    """Return True for a table of coefficients with a normal force in addition to that of the surfaces."""
    return "CN_alpha_pr" in table or "Cm_alpha_pr" in table
