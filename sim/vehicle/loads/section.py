"""The schema of a stage's section loads: stations, mass along the body, and limits of the sections."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from maxq.control.kernel.limits import MAX_LOAD_STATIONS, MAX_PENDULUMS, MAX_SURFACES
from maxq.sim.input.errors import Path, refuse
from maxq.sim.input.tables_csv import Columns, CsvTable
from maxq.sim.input.values import Fraction, Period, Section, optional
from maxq.sim.vehicle.body.section import Mass

LINE_MASS_COLUMNS = Columns(
    "front_station_m", sets=(("rear_station_m", "mass_kg"),), not_negative=("mass_kg",), repeats=True
)
LIQUID_COLUMNS = Columns("time_s", sets=(("mass_kg", "front_station_m"),), not_negative=("mass_kg",), begins_by=0.0)
BORNE = (
    "compression_N",
    "tension_N",
    "shear_N",
    "bending_moment_Nm",
    "equivalent_compression_N",
    "equivalent_tension_N",
)
LIMIT_COLUMNS = Columns(
    "station_m", optional=("time_s", "radius_m", *BORNE), positive=("radius_m", *BORNE), repeats=True
)
SHARE_COLUMNS = Columns("station_m", sets=(("share",),), not_negative=("share",), repeats=True)

SECTION_PREFIX = "max_section_"
"""The prefix of the names of metrics that need section loads."""


class Liquid(Section):
    """The liquid of a tank: a column of uniform density from the bottom to the surface."""

    tank: str = optional("name or number of the tank in which it sloshes (default: none)", "")
    table: Annotated[CsvTable, LIQUID_COLUMNS] = Field(
        description="mass (with the slosh mass) and station of the surface over the stage clock"
    )
    bottom_station_m: float = Field(description="aft end of the column, where its weight acts on the body, m")


class SectionStations(Section):
    """The stations of section loads, and the points at which the axial aerodynamic force acts."""

    stations_m: tuple[float, ...] = Field(
        min_length=1,
        max_length=MAX_LOAD_STATIONS,
        description="stations, ascending, m aft of the nose, up to the gimbal",
    )
    axial_force: Annotated[CsvTable, SHARE_COLUMNS] | None = optional(
        "distribution of the axial aerodynamic force, with sum 1 (default: all at the nose)"
    )

    def _check(self) -> None:
        if any(b <= a for a, b in zip(self.stations_m, self.stations_m[1:], strict=False)):
            raise refuse("must increase strictly", "increasing numbers", "stations_m")
        shares = self.axial_force
        if shares is not None:
            if len(shares) > MAX_SURFACES:
                raise shares.refusal(f"has {len(shares)} rows", f"at most {MAX_SURFACES}", at=("axial_force",))
            total = float(shares["share"].sum())
            if abs(total - 1.0) > 1e-6:
                raise shares.refusal(f"the shares add up to {total:g}", "a sum of 1", "share", at=("axial_force",))


class LoadsSection(SectionStations):
    """The section loads by summation of forces, evaluated with switches.section_loads."""

    line_mass: Annotated[CsvTable, LINE_MASS_COLUMNS] = Field(
        description="all masses except the liquid, including the engine: uniform between two stations, or points"
    )
    liquid: tuple[Liquid, ...] = optional("liquids of all tanks, sloshing or not", (), max_length=MAX_PENDULUMS)
    limits: Annotated[CsvTable, LIMIT_COLUMNS] | None = optional(
        "limit loads of the sections, linear between stations (with the same time_s at each, on the stage clock); "
        "equivalent axial loads are N +- 2 M / radius_m"
    )
    nose_station_m: float = optional("forward end of the body, m aft of the nose", 0.0)
    period_s: Period = optional("time between evaluations for the extremes, s, whole ns", 0.002)
    coast: bool = optional("also record extremes without thrust", False)
    tolerance: Fraction = optional(
        "largest relative difference between these masses and the stage's: mass, CG / length, transverse radius of "
        "gyration; a campaign draws other vehicles again",
        0.05,
    )

    def _check(self) -> None:
        super()._check()
        line = self.line_mass
        backwards = line["rear_station_m"] < line["front_station_m"]
        line.refuse_where(backwards, "rear_station_m", "lies before the front", ">= front_station_m", at=("line_mass",))
        for n, liquid in enumerate(self.liquid):
            table = liquid.table
            liquid.table.refuse_where(
                table["front_station_m"] > liquid.bottom_station_m,
                "front_station_m",
                "lies behind the tank's bottom",
                f"at most bottom_station_m = {liquid.bottom_station_m:g}",
                at=("liquid", n, "table"),
            )
        if self.limits is not None:
            self._check_limits(self.limits)

    def _check_limits(self, table: CsvTable) -> None:
        at = ("limits",)
        if not any(kind in table for kind in BORNE):
            raise table.refusal("bounds nothing", f"one or more of {', '.join(BORNE)}", at=at)
        if "radius_m" not in table and any(kind in table for kind in BORNE[4:]):
            raise table.refusal("an equivalent axial load needs a radius", "a column radius_m", at=at)
        times = limit_times_s(table)
        stations = np.unique(table["station_m"])
        found = {(x, t) for x, t in zip(table["station_m"], table.get("time_s"), strict=True)}
        if len(found) != len(table) or len(found) != len(times) * len(stations):
            raise table.refusal("stations and times are not a grid", "each time once at each station", at=at)


def limit_times_s(table: CsvTable) -> NDArray[np.float64]:
    """Return the times of a table of limits in increasing order."""
    return np.unique(table.get("time_s"))


def check_stations(loads: SectionStations | None, gimbal_station_m: float | None) -> None:
    """Reject stations aft of the foremost gimbal, which is None for a stage without engines."""
    if loads is None:
        return
    if gimbal_station_m is not None and loads.stations_m[-1] > gimbal_station_m:
        raise refuse(
            "is behind the gimbal, where only the engine is",
            f"at most {gimbal_station_m:g}",
            ("loads", "stations_m", len(loads.stations_m) - 1),
            value=loads.stations_m[-1],
        )


def check_liquids(loads: LoadsSection, tanks: Sequence[str]) -> None:
    """Reject liquids that do not match the stage's tanks by name."""
    given = [liquid.tank for liquid in loads.liquid if liquid.tank]
    for n, liquid in enumerate(loads.liquid):
        if liquid.tank and (liquid.tank not in tanks or given.count(liquid.tank) > 1):
            problem = "names no tank" if liquid.tank not in tanks else "is named twice"
            raise refuse(problem, ", ".join(tanks), ("loads", "liquid", n, "tank"), value=liquid.tank)
    for name in tanks:
        if name not in given:
            raise refuse(f"has no entry for tank {name}", "a liquid for each tank", ("loads", "liquid"))


def check_line_mass(loads: LoadsSection, mass: Mass, key: Path) -> None:
    """Reject line masses and liquids whose sum, CG or transverse inertia differs from that of the stage at any instant.

    The check applies only if section loads are switched on: a campaign without them may disperse the mass of a stage
    freely. `key`: key of the stage, for the message.
    """
    known, columns = _mass_over_time(mass)
    times = np.unique(np.concatenate([known, *(liquid.table["time_s"] for liquid in loads.liquid)]))
    given = [np.interp(times, known, column) for column in columns]
    total, first, second = moments(loads, times)
    cg, line = first / total, np.sqrt(second / total - (first / total) ** 2)
    mass_kg, x_cg_m = given[0], given[1]
    gyration = np.sqrt(0.5 * (given[2] + given[3]) / mass_kg)
    length = max(float(loads.line_mass["rear_station_m"].max()) - loads.nose_station_m, 1e-9)
    for name, unit, here, there, scale in (
        ("mass", "kg", total, mass_kg, mass_kg),
        ("CG", "m", cg, x_cg_m, np.full_like(cg, length)),
        ("transverse radius of gyration", "m", line, gyration, gyration),
    ):
        apart = np.abs(here - there) / scale
        worst = int(np.argmax(apart))
        if apart[worst] > loads.tolerance:
            raise refuse(
                f"at {times[worst]:g} s line mass and liquids have a {name} of {here[worst]:.6g} {unit}, the stage "
                f"{there[worst]:.6g} {unit}: {100 * apart[worst]:.2g} % apart",
                f"at most tolerance = {loads.tolerance:g}",
                (*key, "loads", "line_mass"),
            )


def _mass_over_time(mass: Mass) -> tuple[NDArray[np.float64], list[NDArray[np.float64]]]:
    """Return times, and the mass, CG station, Iyy and Izz of the stage at these times."""
    table = mass.table
    if table is not None:
        return table["time_s"], [table[name] for name in ("mass_kg", "x_cg_m", "Iyy_kgm2", "Izz_kgm2")]
    flow, burn = mass.mass_flow_kgps or 0.0, mass.burn_s or 0.0
    inertia = np.array(mass.inertia_kgm2)
    times = np.array([0.0, burn]) if burn > 0.0 else np.zeros(1)
    columns = [(mass.mass_kg or 0.0) - flow * times, mass.x_cg_m or 0.0, inertia[1, 1], inertia[2, 2]]
    return times, [np.broadcast_to(np.asarray(column, float), times.shape) for column in columns]


def moments(loads: LoadsSection, times: NDArray[np.float64]) -> tuple[NDArray[np.float64], ...]:
    """Return mass (kg), first (kg m) and second moment (kg m2) about station 0 of line mass and liquids at `times`."""
    line = loads.line_mass
    parts = [(line["mass_kg"][:, None], line["front_station_m"][:, None], line["rear_station_m"][:, None])]
    for liquid in loads.liquid:
        mass, front = (
            np.interp(times, liquid.table["time_s"], liquid.table[c]) for c in ("mass_kg", "front_station_m")
        )
        parts.append((mass[None], front[None], np.full((1, len(times)), liquid.bottom_station_m)))
    total, first, second = np.zeros((3, len(times)))
    for mass, front, rear in parts:
        middle, length = 0.5 * (front + rear), rear - front
        total = total + mass.sum(axis=0)
        first = first + (mass * middle).sum(axis=0)
        second = second + (mass * (middle * middle + length * length / 12.0)).sum(axis=0)
    return total, first, second
