"""Reads the written vehicle back and evaluates it at a time of the fitted flight, for the linear model."""

from __future__ import annotations

import csv
import tomllib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.interpolate import CubicHermiteSpline

from maxq.control.kernel.records import Array
from maxq.control.kernel.tables import Cubics, fit
from maxq.tools.dev.studies.ksr3.assumptions import STANDARD_GRAVITY_MPS2


@dataclass(frozen=True)
class Pendulum:
    mass_kg: float
    length_m: float
    hinge_m: float  # forward of the CG of the non-sloshing mass
    damping: float
    phi: Array  # of each mode at the hinge
    slope_pm: Array


@dataclass(frozen=True)
class Surface:
    slope_pr: float
    arm_m: float  # forward of the CG of the non-sloshing mass
    phi: Array
    slope_pm: Array


@dataclass(frozen=True)
class Bending:
    omega_radps: Array
    zeta: Array
    generalized_mass_kg: Array
    gimbal_slope_pm: Array
    gyro_slope_pm: Array
    softening: Array  # (modes, modes): integral of mass forward * phi_j' * phi_k', kg/m; times a_x it is a stiffness


@dataclass(frozen=True)
class Snapshot:
    """The vehicle at one time; core means the mass that does not slosh."""

    time_s: float
    thrust_N: float
    mass_kg: float
    core_mass_kg: float
    core_inertia_kgm2: float
    gimbal_arm_m: float  # core CG forward of the gimbal
    speed_mps: float
    lateral_gravity_mps2: float  # g sin(gamma): weight's share across the axis per radian of attitude
    axial_mps2: float  # sensed
    pressure_area_N: float  # dynamic pressure times S_ref
    pitch_damping_Nms: float  # moment per rad/s
    engine_first_moment_kgm: float
    engine_inertia_kgm2: float
    pendulums: tuple[Pendulum, ...]
    surfaces: tuple[Surface, ...]
    bending: Bending
    m_alpha_ps2: float  # with the total mass, as in the paper's Table 2
    m_delta_ps2: float


class VehicleFolder:
    """The tables of a vehicle folder, and of the point-mass flight in it."""

    def __init__(self, folder: Path) -> None:
        self.description: dict[str, Any] = tomllib.loads((folder / "vehicle.toml").read_text(encoding="utf-8"))
        self.stage = self.description["stage"][0]
        self.mass = table(folder / "mass.csv")
        self.flight = table(folder / "point_mass_flight.csv")
        self.aero = table(folder / "aero.csv")
        self.tanks = [table(folder / tank["table"]) for tank in self.stage["tank"]]
        self.surfaces = [table(folder / surface["table"]) for surface in self.stage["aero"]["surface"]]
        self.modes = ModeShapes(folder / self.stage["bending"]["pitch"])


class ModeShapes:
    """modes.csv: everything about the modes over time, shapes at the stations of the file."""

    def __init__(self, path: Path) -> None:
        rows = np.array(read_rows(path))
        times, numbers, stations = (np.unique(rows[:, k]) for k in (0, 1, 4))
        grid = rows.reshape(len(times), len(numbers), len(stations), -1)
        self.stations_m = stations
        self._shape = grid.shape
        self._table = fit(times, grid.reshape(len(times), -1))

    def at(self, t: float) -> Array:
        """(modes, stations, columns of the file)."""
        return self._table(t).reshape(self._shape[1:])


def read_rows(path: Path) -> list[list[float]]:
    with path.open(encoding="utf-8") as file:
        return [[float(v) for v in row] for row in list(csv.reader(file))[1:]]


def table(path: Path) -> Cubics:
    rows = np.array(read_rows(path))
    return fit(rows[:, 0], rows[:, 1:])


def snapshot(vehicle: VehicleFolder, t: float) -> Snapshot:
    """The vehicle at time t on the point-mass flight, wind still."""
    mass, x_cg, _, inertia, _ = vehicle.mass(t)
    _, altitude, speed, path_angle, _, thrust, drag, pressure, mach = vehicle.flight(t)
    tanks = [
        (*row(t)[:3], tank["damping_ratio"]) for row, tank in zip(vehicle.tanks, vehicle.stage["tank"], strict=True)
    ]
    tanks = [tank for tank in tanks if tank[0] > 0.1]  # kg: an empty tank only makes the matrix singular
    core_mass, core_cg, core_inertia = _without_bobs(mass, x_cg, inertia, tanks)
    grid = vehicle.modes.at(t)
    shape = _Shape(vehicle.modes.stations_m, grid[:, :, 5], grid[:, :, 6])
    gravity = STANDARD_GRAVITY_MPS2 * (6371e3 / (6371e3 + altitude)) ** 2
    area = vehicle.description["reference"]["area_m2"]
    chord = vehicle.description["reference"]["chord_m"]
    engine, gyro = vehicle.stage["engine"], vehicle.stage["gyro"]
    surfaces = [surface(mach) for surface in vehicle.surfaces]
    moment = sum(slope * (station - x_cg) for slope, station in surfaces)
    return Snapshot(
        time_s=t,
        thrust_N=thrust,
        mass_kg=mass,
        core_mass_kg=core_mass,
        core_inertia_kgm2=core_inertia,
        gimbal_arm_m=engine["gimbal_station_m"] - core_cg,
        speed_mps=speed,
        lateral_gravity_mps2=float(gravity * np.sin(np.radians(path_angle))),
        axial_mps2=(thrust - drag) / mass,
        pressure_area_N=pressure * area,
        pitch_damping_Nms=vehicle.aero(mach)[2] * chord**2 * pressure * area / (2 * speed),
        engine_first_moment_kgm=engine["gimballed_mass_kg"] * engine["cg_from_gimbal_m"],
        engine_inertia_kgm2=engine["inertia_about_gimbal_kgm2"],
        pendulums=tuple(
            Pendulum(m, length, core_cg - hinge, zeta, shape.phi(hinge), shape.slope(hinge))
            for m, length, hinge, zeta in tanks
        ),
        surfaces=tuple(
            Surface(slope, core_cg - station, shape.phi(station), shape.slope(station)) for slope, station in surfaces
        ),
        bending=_bending(vehicle, grid, shape, gyro["station_m"]),
        m_alpha_ps2=-pressure * area * moment / inertia,
        m_delta_ps2=thrust * (engine["gimbal_station_m"] - x_cg) / inertia,
    )


def _without_bobs(
    mass: float, x_cg: float, inertia: float, tanks: list[tuple[float, ...]]
) -> tuple[float, float, float]:
    """Mass, CG station and transverse inertia left when the bobs are taken out of the frozen vehicle."""
    core = mass - sum(m for m, *_ in tanks)
    cg = (mass * x_cg - sum(m * (hinge + length) for m, length, hinge, _ in tanks)) / core
    about_nose = inertia + mass * x_cg**2 - sum(m * (hinge + length) ** 2 for m, length, hinge, _ in tanks)
    return core, cg, about_nose - core * cg**2


class _Shape:
    """Mode shapes between stations, by the cubics that the beam's own elements use."""

    def __init__(self, stations_m: Array, phi: Array, slope_pm: Array) -> None:
        self._phi = CubicHermiteSpline(stations_m, phi, slope_pm, axis=1)
        self._slope = self._phi.derivative()

    def phi(self, station_m: float) -> Array:
        return np.asarray(self._phi(station_m))

    def slope(self, station_m: float) -> Array:
        return np.asarray(self._slope(station_m))


def _bending(vehicle: VehicleFolder, grid: Array, shape: _Shape, gyro_station_m: float) -> Bending:
    stations, forward = vehicle.modes.stations_m, grid[0, :, 7]
    slopes = grid[:, :, 6]
    softening = np.trapezoid(forward * slopes[:, None] * slopes[None], stations, axis=2)
    return Bending(
        omega_radps=2 * np.pi * grid[:, 0, 2],
        zeta=np.array(vehicle.stage["bending"]["damping_ratio"]),
        generalized_mass_kg=grid[:, 0, 3],
        gimbal_slope_pm=slopes[:, -1],
        gyro_slope_pm=shape.slope(gyro_station_m),
        softening=softening,
    )
