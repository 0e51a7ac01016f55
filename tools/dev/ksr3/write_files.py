"""Writes the vehicle's tables. Numbers carry enough digits that thrust and mass agree to round-off."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from maxq.control.kernel.records import Array
from maxq.tools.dev.ksr3 import assumptions as a
from maxq.tools.dev.ksr3 import beam, pitch_programme, slosh
from maxq.tools.dev.ksr3.aerodynamics import Lift, cross_flow
from maxq.tools.dev.ksr3.drag import MACH as DRAG_MACH
from maxq.tools.dev.ksr3.gains import LinearGains
from maxq.tools.dev.ksr3.mass_model import dry_parts, engine_part, fills, mass_properties
from maxq.tools.dev.ksr3.trajectory import Flight, forces

SHAPE_STATIONS_M = np.append(beam.NODES_M[::3], a.GIMBAL_STATION_M)  # nodes of the beam: nothing is interpolated
LOAD_STATIONS_M = (1.0, 2.0, 3.0, 3.6, 4.5, 5.4, 6.0, 6.8, 7.6, 8.1, 9.0, 10.0, 11.0, 11.6, 12.2, 12.6)
MODE_TIMES_S = np.arange(0.0, 58.0, 2.5)
LIFT_MACH = np.array(
    [0.0, 0.25, 0.5, 0.65, 0.8, 0.875, 0.95, 1.025, 1.1, 1.175, 1.25, 1.375, 1.5, 1.625, 1.75, 2.0, 2.25, 2.5, 3.0, 5.0]
)


@dataclass(frozen=True)
class Reconstruction:
    """All that the fits gave."""

    flight: Flight
    lift: Lift
    stiffness_scale: float
    gains: LinearGains


def write_table(path: Path, header: str, rows: ArrayLike, digits: int = 9) -> None:
    lines = [",".join(f"{v:.{digits}g}" for v in row) for row in np.asarray(rows, float)]
    path.write_text("\n".join([header, *lines]) + "\n", encoding="utf-8")


def write_tables(folder: Path, made: Reconstruction) -> None:
    """All the csv files of the vehicle, into an existing folder."""
    _write_mass_and_thrust(folder, made)
    _write_tanks(folder, made)
    _write_line_mass(folder, made)
    _write_modes(folder, made)
    _write_aero(folder, made)
    _write_programme(folder, made)
    _write_flight(folder, made)


def _write_mass_and_thrust(folder: Path, made: Reconstruction) -> None:
    burn = made.flight.ascent.burn
    thrust = np.column_stack([burn.times_s, burn.thrust_vacuum_N])
    write_table(folder / "thrust.csv", "time_s,thrust_vacuum_N", thrust, digits=12)
    rows = []
    for t in burn.times_s:
        p = mass_properties(burn, t)
        rows.append(
            (t, float(burn.mass_kg(t)), p.x_cg_m, p.roll_inertia_kgm2, p.pitch_inertia_kgm2, p.pitch_inertia_kgm2)
        )
    header = "time_s,mass_kg,x_cg_m,Ixx_kgm2,Iyy_kgm2,Izz_kgm2"
    write_table(folder / "mass.csv", header, rows, digits=13)


def _tank_times_s(burn_times_s: Array) -> Array:
    """The mass rows, and finer ones where the slosh mass fades."""
    end = burn_times_s[-1]
    return np.unique(np.round(np.concatenate([burn_times_s, np.arange(np.floor(end) - 6.0, end, 0.1)]), 6))


def _write_tanks(folder: Path, made: Reconstruction) -> None:
    burn = made.flight.ascent.burn
    tables: list[list[tuple[float, ...]]] = [[] for _ in a.TANKS]
    for t in _tank_times_s(burn.times_s):
        for table, fill in zip(tables, fills(burn, t), strict=True):
            p = slosh.pendulum(fill)
            table.append((t, p.mass_kg, p.length_m, p.hinge_station_m, fill.height_m))
    for tank, table in zip(a.TANKS, tables, strict=True):
        header = "time_s,slosh_mass_kg,pendulum_length_m,hinge_station_m,liquid_height_m"
        write_table(folder / f"tank_{tank.name}.csv", header, table, digits=12)


def _write_line_mass(folder: Path, made: Reconstruction) -> None:
    burn = made.flight.ascent.burn
    parts = sorted((*dry_parts(burn), engine_part()), key=lambda part: (part.front_station_m, part.rear_station_m))
    rows = [(part.front_station_m, part.rear_station_m, part.mass_kg) for part in parts]
    write_table(folder / "line_mass.csv", "front_station_m,rear_station_m,mass_kg", rows)
    for k, tank in enumerate(a.TANKS):
        table = [(t, fills(burn, t)[k].mass_kg, fills(burn, t)[k].surface_station_m) for t in burn.times_s]
        write_table(folder / f"liquid_{tank.name}.csv", "time_s,mass_kg,front_station_m", table, digits=12)
    strength = [(x, a.DIAMETER_M / 2, beam.shell_strength_N(made.stiffness_scale, x)) for x in LOAD_STATIONS_M]
    write_table(folder / "section_limits.csv", "station_m,radius_m,equivalent_compression_N", strength, digits=4)


def _write_modes(folder: Path, made: Reconstruction) -> None:
    burn = made.flight.ascent.burn
    nodes = np.searchsorted(beam.NODES_M, SHAPE_STATIONS_M - 1e-9)
    rows = []
    for t in np.append(MODE_TIMES_S, burn.end_s):
        forward = beam.mass_forward_kg(burn, t)
        for number, mode in enumerate(beam.modes(burn, t, made.stiffness_scale), start=1):
            for n in nodes:
                point = (beam.NODES_M[n], mode.phi[n], mode.slope_pm[n], forward[n])
                rows.append((t, number, mode.frequency_hz, mode.generalized_mass_kg, *point))
    header = "time_s,mode,frequency_hz,generalized_mass_kg,station_m,phi,slope_pm,mass_forward_kg"
    write_table(folder / "modes.csv", header, rows, digits=8)


def cg_station_over_mach(made: Reconstruction, machs: Sequence[float] | Array) -> Array:
    """CG at the time the Mach number occurs in the ascent; the burn-out CG above the highest."""
    flight, burn = made.flight, made.flight.ascent.burn
    times = np.arange(1.0, burn.tail_off_s, 0.25)
    states = [flight.state_at(t) for t in times]
    flown = [forces(flight.ascent, t, y[1], y[2]).mach for t, y in zip(times, states, strict=True)]
    return np.interp(machs, flown, [mass_properties(burn, t).x_cg_m for t in times])


def _write_aero(folder: Path, made: Reconstruction) -> None:
    drag, lift = made.flight.ascent.drag, made.lift
    machs = np.union1d(DRAG_MACH, LIFT_MACH)
    across = cross_flow().coefficient
    rows = []
    for mach, cg in zip(machs, cg_station_over_mach(made, machs), strict=True):
        axial = [drag.coefficient(mach, engine_on=on) for on in (True, False)]
        rows.append((mach, *axial, lift.pitch_damping(mach, cg), lift.roll_damping(mach), across))
    write_table(folder / "aero.csv", "mach,CA,CA_coast,Cmq,Clp,C_crossflow", rows, digits=8)
    for name, surface in (("nose", lift.nose), ("fins", lift.fins)):
        table = [(mach, *surface(mach)) for mach in LIFT_MACH]
        write_table(folder / f"aero_{name}.csv", "mach,CN_alpha_pr,station_m", table, digits=8)


def _write_programme(folder: Path, made: Reconstruction) -> None:
    times, rates = pitch_programme.commanded_rate(made.flight, made.lift, made.gains)
    rows = np.column_stack([times, np.round(np.degrees(rates), 5)])
    write_table(folder / "pitch_programme.csv", "time_s,pitch_rate_degps", rows + 0.0)


def _write_flight(folder: Path, made: Reconstruction) -> None:
    flight = made.flight
    end = flight.ascent.burn.end_s
    powered = np.append(np.arange(0.0, 59.0), [flight.ascent.burn.tail_off_s, end])
    coast = np.append(np.arange(60.0, flight.times_s[-1], 2.0), flight.times_s[-1])
    rows = []
    for t in np.concatenate([powered, coast]):
        reach, altitude, speed, angle = flight.state_at(t)
        f = forces(flight.ascent, t, altitude, speed)
        state = (t, reach, altitude, speed, np.degrees(angle))
        rows.append((*state, f.mass_kg, f.thrust_N, f.drag_N, f.dynamic_pressure_Pa, f.mach))
    header = "time_s,range_m,altitude_m,speed_mps,path_angle_deg,mass_kg,thrust_N,drag_N,dynamic_pressure_Pa,mach"
    write_table(folder / "point_mass_flight.csv", header, rows)
