"""Compute the aerodynamic coefficients of a stage at one instant, in one plane, from its packed tables."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any

import numpy as np
from oracles.planar.incidence import reference_station_m, table_slopes

from maxq.control.kernel.records import Array
from maxq.control.kernel.tables import table_in
from maxq.sim.vehicle import schedule
from maxq.sim.vehicle.air import kernel as aero


@dataclass(frozen=True)
class Aerodynamics:
    """The coefficients at one Mach number, referred to `area_m2` and `chord_m`."""

    area_m2: float
    chord_m: float
    axial: float  # CA + CD
    drag: float  # CD: the part that acts along the wind; its slope across
    rate_damping: float  # Cmq, or Cnr in yaw; per rate times chord / (2 U)
    slope_pr: (
        Array  # CN_alpha of each surface, then of each table over angle of attack at the trim, 1/rad; then `beyond`
    )
    moment_slope_mpr: Array  # CN_alpha times station of each of them, m/rad
    rate_slope_m: Array  # the same by the turning rate: normal force per rho U S / 2, m
    rate_moment_m2: Array  # and times station, m2
    couple_station_m: Array  # where tables load the modes, also by their moment about that; nan of a surface
    local_incidence: bool
    beyond: tuple[int, ...] = ()  # parts that see the flow at the CG alone; which surface's modes they load, -1: none
    forward: float = 1.0  # share of the airspeed along the body axis
    cross_slope_pr: Array = dataclasses.field(default_factory=lambda: np.zeros(0))  # of each part by the other plane's
    cross_moment_mpr: Array = dataclasses.field(default_factory=lambda: np.zeros(0))  # flow; empty: none

    def met_by_modes(self, part: int) -> tuple[int, bool]:
        """Return the surface whose modes a part of `slope_pr` loads (-1: none); True if bending changes its flow."""
        first = len(self.slope_pr) - len(self.beyond)
        return (part, self.local_incidence) if part < first else (self.beyond[part - first], False)

    def modal_couples(self) -> tuple[Array, Array]:
        """Return the moments about `couple_station_m` that rotate the modes' slopes.

        They are per angle of attack (m/rad) and per pitch or yaw rate (m2).
        """
        at = np.nan_to_num(self.couple_station_m)
        acts = np.isfinite(self.couple_station_m)
        by_flow = acts * (self.slope_pr * at - self.moment_slope_mpr)
        return by_flow, acts * (self.rate_slope_m * at - self.rate_moment_m2)

    def cross_couples(self) -> Array:
        """Return the first of `modal_couples` due to the flow in the other plane."""
        stations = self.couple_station_m[: len(self.cross_slope_pr)]
        turns = self.cross_slope_pr * np.nan_to_num(stations) - self.cross_moment_mpr
        return np.asarray(np.isfinite(stations) * turns)


def aerodynamics_at(
    pool: Array, vehicle: Any, props: Array, clock_s: float, mach: float, plane: str, trim: tuple[float, float]
) -> Aerodynamics:
    a, tables = vehicle.aero, int(vehicle.sizes.tables)
    surfaces = int(vehicle.sizes.surfaces) - tables
    if a.on == 0:
        none = np.zeros(surfaces + tables)
        return Aerodynamics(0.0, 1.0, 0.0, 0.0, 0.0, none, none, none, none, none, local_incidence=False)
    row = table_in(pool, a.table)(mach)
    slope = row[aero.FIRST_SURFACE : aero.FIRST_SURFACE + 2 * surfaces : 2]
    moment = row[aero.FIRST_SURFACE + 1 : aero.FIRST_SURFACE + 2 * surfaces : 2].copy()
    if a.remainder >= 0:
        moment[a.remainder] += slope[a.remainder] * reference_station_m(pool, a, props, clock_s)
    moment = a.force_factor * (moment + slope * float(a.centre_shift_m))
    parts = np.stack([a.force_factor * slope, moment, 0.0 * slope, 0.0 * slope, np.full_like(slope, np.nan)])
    over = table_slopes(pool, vehicle, props, clock_s, mach, *trim)
    more = np.array([(*table.plane(plane), table.station_m) for table in over]).reshape(-1, 5)
    of_parts, beyond, forward = np.concatenate([parts, more.T], axis=1), (), 1.0
    axial, drag = row[aero.CA] + row[aero.CD], row[aero.CD]
    crossed: Array = np.zeros((2, 0))
    if tables > 0 and any(trim):  # without tables angle of attack is taken as zero
        forward, side, down = np.cos(trim[0]) * np.cos(trim[1]), np.sin(trim[1]), np.sin(trim[0]) * np.cos(trim[1])
        own, other = (down, side) if plane == "pitch" else (side, down)
        of_parts[:2, :surfaces] *= forward
        per_mach = mach * table_in(pool, a.table).slope(mach)
        by_mach, across = own * per_mach, other * per_mach
        more = _beyond(a, row, by_mach, (forward, own, other), plane)
        aside = _beyond(a, row, across, (forward, own, other), plane, across=True)
        aside[:, -1] += (
            a.axial_factor * own * (other * drag + across[aero.CD]) * np.array([1.0, props[schedule.CORE_CG]])
        )
        if a.remainder >= 0:
            reference_m = reference_station_m(pool, a, props, clock_s)
            for slopes in (more, aside):
                slopes[1, a.remainder] += slopes[0, a.remainder] * reference_m
        by_other = np.array([table.across(plane) for table in over]).T
        none = np.zeros((2, surfaces))
        crossed = np.concatenate([none, by_other[:2], aside[:, :surfaces], by_other[2:], aside[:, surfaces:]], axis=1)
        by_tables = np.array([table.plane_by_mach(plane) for table in over]).T
        more = np.concatenate([more[:, :surfaces], by_tables, more[:, surfaces:]], axis=1)
        stations = np.append(of_parts[4], np.nan)
        none = np.zeros_like(stations)
        of_parts = np.concatenate([of_parts, [*more, none, none, stations]], axis=1)
        beyond = (*range(surfaces + tables), -1)
        axial, drag = forward * (forward * row[aero.CA] + drag), drag + own * (own * drag + by_mach[aero.CD])
    return Aerodynamics(
        area_m2=float(a.area_m2),
        chord_m=float(a.chord_m if plane == "pitch" else a.yaw_chord_m),
        axial=float(a.axial_factor * axial) - sum(float(table.force[0]) for table in over),
        drag=float(a.axial_factor * drag),
        rate_damping=float(a.damping_factor * row[aero.CMQ if plane == "pitch" else aero.CNR]),
        slope_pr=of_parts[0],
        moment_slope_mpr=of_parts[1],
        rate_slope_m=of_parts[2],
        rate_moment_m2=of_parts[3],
        couple_station_m=of_parts[4],
        local_incidence=bool(a.local_incidence),
        beyond=beyond,
        forward=float(forward),
        cross_slope_pr=crossed[0],
        cross_moment_mpr=crossed[1],
    )


def _beyond(
    a: Any, row: Array, by_mach: Array, flow: tuple[float, float, float], plane: str, across: bool = False
) -> Array:
    """Return the slopes and slopes times stations, (2, surfaces and one), added by the angle of attack.

    They are of surfaces under a Mach number that changes with the flow, and of the body's cross-flow and Cm0.
    `by_mach`: change of the columns `row` of the Mach table per radian. `flow`: unit vector of the velocity through the
    air, forward, in the plane, across it. `across`: slopes due to the flow across the plane.
    """
    forward, own, other = flow
    moved = other if across else own
    ends = len(row) - (len(row) - aero.FIRST_SURFACE) % 2
    slope, moment = (forward * own * by_mach[aero.FIRST_SURFACE + k : ends : 2] for k in (0, 1))
    lateral = np.hypot(own, other)
    cross = row[aero.CROSSFLOW] * (own * moved / lateral + (0.0 if across else lateral))
    cross += by_mach[aero.CROSSFLOW] * lateral * own
    couple = a.chord_m * (2.0 * moved * row[aero.CM0] + by_mach[aero.CM0]) if plane == "pitch" else 0.0
    moment = a.force_factor * np.append(moment + slope * float(a.centre_shift_m), cross * a.crossflow_station_m)
    moment[-1] -= couple
    return np.array([a.force_factor * np.append(slope, cross), moment])
