"""Linearise KSR-III's pitch plane at a frozen time, independently of maxq.sim and maxq.design.

The module reads the written vehicle, evaluates it at a time of the fitted point-mass flight, and builds the paper's eqs
1 to 29 with the corrections of its errata: sloshing masses taken out of the core, pendulum reaction and damping at the
hinge, a gyro that measures d(eta)/dt, thrust that follows the bent tail, axial softening, engine inertia at the gimbal.
"""

from __future__ import annotations

import csv
import tomllib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.interpolate import CubicHermiteSpline

from maxq.control.kernel.records import Array
from maxq.control.kernel.tables import fit


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
    """The vehicle at one time; the core excludes the sloshing masses."""

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
    """The tables of a vehicle folder, and of its point-mass flight."""

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
    """The contents of modes.csv: modes over time, with shapes at the stations of the file."""

    def __init__(self, path: Path) -> None:
        rows = np.array(read_rows(path))
        times, numbers, stations = (np.unique(rows[:, k]) for k in (0, 1, 4))
        grid = rows.reshape(len(times), len(numbers), len(stations), -1)
        self.stations_m = stations
        self._shape = grid.shape
        self._table = fit(times, grid.reshape(len(times), -1))

    def at(self, t: float) -> Array:
        """Return the shapes (modes, stations, columns of the file) at a time, s."""
        return self._table(t).reshape(self._shape[1:])


def read_rows(path: Path) -> list[list[float]]:
    with path.open(encoding="utf-8") as file:
        return [[float(v) for v in row] for row in list(csv.reader(file))[1:]]


def table(path: Path):
    rows = np.array(read_rows(path))
    return fit(rows[:, 0], rows[:, 1:])


def snapshot(vehicle: VehicleFolder, t: float) -> Snapshot:
    """Return the vehicle at time t on the point-mass flight, without wind."""
    mass, x_cg, _, inertia, _ = vehicle.mass(t)
    _, altitude, speed, path_angle, _, thrust, drag, pressure, mach = vehicle.flight(t)
    tanks = [
        (*row(t)[:3], tank["damping_ratio"]) for row, tank in zip(vehicle.tanks, vehicle.stage["tank"], strict=True)
    ]
    tanks = [tank for tank in tanks if tank[0] > 0.1]  # kg: an empty tank only makes the matrix singular
    core_mass, core_cg, core_inertia = _without_bobs(mass, x_cg, inertia, tanks)
    grid = vehicle.modes.at(t)
    shape = _Shape(vehicle.modes.stations_m, grid[:, :, 5], grid[:, :, 6])
    gravity = 9.80665 * (6371e3 / (6371e3 + altitude)) ** 2
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
    """Return the mass, CG station and transverse inertia of the frozen vehicle without the bobs."""
    core = mass - sum(m for m, *_ in tanks)
    cg = (mass * x_cg - sum(m * (hinge + length) for m, length, hinge, _ in tanks)) / core
    about_nose = inertia + mass * x_cg**2 - sum(m * (hinge + length) ** 2 for m, length, hinge, _ in tanks)
    return core, cg, about_nose - core * cg**2


class _Shape:
    """A mode shape between stations, by the cubics of the beam elements."""

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


@dataclass(frozen=True)
class Linear:
    """The linear system dx/dt = a x + b u with output c x."""

    a: Array
    b: Array
    c: Array


def actuator(omega_hz: list[float], zeta: list[float]) -> Linear:
    """Return the actuator of eq 28, command to gimbal angle: three blocks in series, states (value, rate) each."""
    w1, w2, w3, w4 = 2 * np.pi * np.array(omega_hz)
    z1, z2, z3, z4 = zeta
    a = np.zeros((6, 6))
    for k, (w, z) in enumerate(((w1, z1), (w2, z2), (w3, z3))):
        i = 2 * k
        a[i, i + 1] = 1.0
        a[i + 1, i : i + 2] = -w * w, -2 * z * w
        if k:
            a[i + 1, i - 2] = w * w
    b = np.zeros(6)
    b[1] = w1 * w1
    # The zero pair of the third block: (v'' + 2 z4 w4 v' + w4^2 v) / w4^2.
    c = a[5] / w4**2
    c[4] += 1.0
    c[5] += 2 * z4 / w4
    return Linear(a, b, c)


def gyro(omega_hz: float, zeta: float) -> Linear:
    """Return the gyro of eq 29, from the angle at the gyro to the integral of its output (the same filter for both)."""
    w = 2 * np.pi * omega_hz
    a = np.array([[0.0, 1.0], [-w * w, -2 * zeta * w]])
    return Linear(a, np.array([0.0, w * w]), np.array([1.0, 0.0]))


def vehicle(s: Snapshot) -> tuple[Array, Array, Array]:
    """Return the state matrix (n, n), inputs (n, 2) for gimbal angle and acceleration, and gyro angle (n,).

    State: w (m/s, body z), theta, q, pendulum angles, eta, pendulum rates, d(eta)/dt. Angles are
    perturbations in rad.
    """
    np_, nb = len(s.pendulums), len(s.bending.omega_radps)
    layout = _Layout(np_, nb)
    mass, force = _mass_matrix(s, layout), _forces(s, layout)
    # mass @ [A_z, q', Gamma'', eta''] = force @ [state, delta, delta'']; A_z is the body's lateral
    # acceleration.
    accelerations = np.linalg.solve(mass, force)
    n = layout.size
    rows = np.zeros((n, n + 2))
    rows[0] = accelerations[0]
    rows[0, 2] += s.speed_mps  # w' = A_z + U q - g sin(gamma) theta
    rows[0, 1] -= s.lateral_gravity_mps2
    rows[1, 2] = 1.0
    rows[2] = accelerations[1]
    flexible = np_ + nb
    rows[3 : 3 + flexible, 3 + flexible : 3 + 2 * flexible] = np.eye(flexible)
    rows[3 + flexible :] = accelerations[2:]
    angle = np.zeros(n)
    angle[1] = 1.0
    angle[layout.eta] = s.bending.gyro_slope_pm
    return rows[:, :n], rows[:, n:], angle


class _Layout:
    """The indices of the states."""

    def __init__(self, pendulums: int, modes: int) -> None:
        first = 3
        self.gamma = slice(first, first + pendulums)
        self.eta = slice(first + pendulums, first + pendulums + modes)
        self.gamma_rate = slice(self.eta.stop, self.eta.stop + pendulums)
        self.eta_rate = slice(self.gamma_rate.stop, self.gamma_rate.stop + modes)
        self.size = self.eta_rate.stop
        self.pendulums, self.modes = pendulums, modes


def _mass_matrix(s: Snapshot, layout: _Layout) -> Array:
    """Return the mass matrix; rows: lateral force, pitch moment, each pendulum (per unit mass), each mode."""
    count = 2 + layout.pendulums + layout.modes
    m = np.diag(np.concatenate([[s.core_mass_kg, s.core_inertia_kgm2], np.ones(count - 2)]))
    for k, p in enumerate(s.pendulums):
        row = 2 + k
        m[row, 0] = 1.0
        m[row, 1] = p.length_m - p.hinge_m
        m[row, row] = p.length_m
        m[row, 2 + layout.pendulums :] = p.phi
    modal = range(2 + layout.pendulums, count)
    m[modal, modal] = s.bending.generalized_mass_kg
    return m


def _forces(s: Snapshot, layout: _Layout) -> Array:
    """Return the forces: (rows of the mass matrix) x (states, delta, delta'')."""
    f = np.zeros((2 + layout.pendulums + layout.modes, layout.size + 2))
    modal = slice(2 + layout.pendulums, None)
    _add_engine(f, modal, s, layout)
    _add_stiffness(f, modal, s, layout)
    for k in range(layout.pendulums):
        _add_pendulum(f, s, layout, k)
    _add_air(f, modal, s, layout)
    return f


def _add_engine(f: Array, modal: slice, s: Snapshot, layout: _Layout) -> None:
    """Add thrust along the deflected, locally bent axis, and the reaction to the engine's motion."""
    thrust, arm, slope, delta = s.thrust_N, s.gimbal_arm_m, s.bending.gimbal_slope_pm, layout.size
    f[0, delta] = thrust
    f[0, layout.eta] -= thrust * slope
    f[1, delta] = thrust * arm + s.engine_first_moment_kgm * s.axial_mps2  # the engine's weight moves off the axis
    f[1, layout.eta] += thrust * (1.0 - arm * slope)  # phi(gimbal) = 1
    f[modal, delta] = thrust + slope * s.engine_first_moment_kgm * s.axial_mps2
    f[modal, layout.eta] -= thrust * slope  # every mode has phi(gimbal) = 1: the same row for each
    f[0, delta + 1] = s.engine_first_moment_kgm
    f[1, delta + 1] = s.engine_inertia_kgm2 + s.engine_first_moment_kgm * arm
    f[modal, delta + 1] = s.engine_first_moment_kgm + slope * s.engine_inertia_kgm2


def _add_stiffness(f: Array, modal: slice, s: Snapshot, layout: _Layout) -> None:
    b = s.bending
    f[modal, layout.eta] += s.axial_mps2 * b.softening - np.diag(b.generalized_mass_kg * b.omega_radps**2)
    f[modal, layout.eta_rate] -= np.diag(2 * b.generalized_mass_kg * b.zeta * b.omega_radps)


def _add_pendulum(f: Array, s: Snapshot, layout: _Layout, k: int) -> None:
    """Add a pendulum's restoring force and its reaction on core and modes through the hinge."""
    p = s.pendulums[k]
    modal = slice(2 + layout.pendulums, None)
    angle, rate = layout.gamma.start + k, layout.gamma_rate.start + k
    damping = 2 * p.damping * np.sqrt(s.axial_mps2 * p.length_m)  # m/s: force per unit mass and angular rate
    f[2 + k, angle] = -s.axial_mps2
    f[2 + k, rate] = -damping
    pull, drag = p.mass_kg * s.axial_mps2, p.mass_kg * damping
    couple = drag * p.length_m  # the damper's own reaction on the tank
    f[0, angle] += pull
    f[0, rate] += drag
    f[1, angle] -= p.hinge_m * pull
    f[1, rate] += couple - p.hinge_m * drag
    f[1, layout.eta] -= pull * p.phi  # the axial pull of the bob on a hinge that has moved sideways
    f[modal, angle] += p.phi * pull
    f[modal, rate] += p.phi * drag + p.slope_pm * couple


def _add_air(f: Array, modal: slice, s: Snapshot, layout: _Layout) -> None:
    """Add the normal force of each surface at its local angle of attack, and pitch damping as one moment."""
    f[1, 2] += s.pitch_damping_Nms
    for surface in s.surfaces:
        incidence = np.zeros(layout.size + 2)
        incidence[0] = 1.0 / s.speed_mps
        incidence[layout.eta] = surface.slope_pm
        incidence[layout.eta_rate] = surface.phi / s.speed_mps
        normal = -s.pressure_area_N * surface.slope_pr * incidence
        f[0] += normal
        f[1] -= surface.arm_m * normal
        f[modal] += surface.phi[:, None] * normal


def plant(s: Snapshot, actuator_: Linear, gyro_: Linear) -> Linear:
    """Return the plant from gimbal command (rad) to the integral of the gyro's output (rad)."""
    a, b, angle = vehicle(s)
    n, na, ng = len(a), len(actuator_.a), len(gyro_.a)
    full = np.zeros((n + na + ng, n + na + ng))
    full[:n, :n] = a
    full[:n, n : n + na] = np.outer(b[:, 0], actuator_.c)
    full[:n, n : n + na] += np.outer(b[:, 1], actuator_.c @ actuator_.a @ actuator_.a)  # four more poles than zeros
    full[n : n + na, n : n + na] = actuator_.a
    full[n + na :, :n] = np.outer(gyro_.b, angle)
    full[n + na :, n + na :] = gyro_.a
    command = np.concatenate([np.zeros(n), actuator_.b, np.zeros(ng)])
    return Linear(full, command, np.concatenate([np.zeros(n + na), gyro_.c]))


def quantities(vehicle: VehicleFolder, t: float) -> dict[str, float]:
    """Return maxq's values at time t under the names of the other table."""
    s = snapshot(vehicle, t)
    mass, x_cg, roll, pitch, _ = vehicle.mass(t)
    _, altitude, speed, path_angle, _, thrust, _, pressure, mach = vehicle.flight(t)
    aero = vehicle.aero(mach)
    lift = [surface(mach) for surface in vehicle.surfaces]
    slope = sum(row[0] for row in lift)
    values = {
        "h": altitude,
        "U": speed,
        "mach": mach,
        "qbar": pressure,
        "gamma_deg": path_angle,
        "T": thrust,
        "m": mass,
        "x_cg": x_cg,
        "Iyy": pitch,
        "Ixx": roll,
        "CA": aero[0],
        "CNa": slope,
        "x_cp": sum(row[0] * row[1] for row in lift) / slope,
        "Cmq": aero[2],
        "Za": -slope * s.pressure_area_N / (mass * speed),
        "Ma": s.m_alpha_ps2,
        "Zd": thrust / (mass * speed),
        "Md": s.m_delta_ps2,
        "Mq": s.pitch_damping_Nms / pitch,
        "m_rigid": s.core_mass_kg,
        "Iyy_rigid": s.core_inertia_kgm2,
        "ax_sensed": s.axial_mps2,
    }
    for name, tank, pendulum in zip(("lox", "fuel"), vehicle.tanks, s.pendulums, strict=True):
        row = tank(t)
        values |= {f"m_s_{name}": row[0], f"L_p_{name}": row[1], f"x_hinge_{name}": row[2]}
        values[f"f_s_{name}"] = float(np.sqrt(s.axial_mps2 / row[1]) / (2 * np.pi))
        values |= {f"phi{k + 1}_{name}": phi for k, phi in enumerate(pendulum.phi)}
    return values | _bending_quantities(s)


def _bending_quantities(s: Snapshot) -> dict[str, float]:
    b, values = s.bending, {}
    for k in range(len(b.omega_radps)):
        values[f"f_b{k + 1}"] = b.omega_radps[k] / (2 * np.pi)
        values[f"M_G{k + 1}"] = b.generalized_mass_kg[k]
        values[f"sig{k + 1}_gim"] = b.gimbal_slope_pm[k]
        values[f"sig{k + 1}_gyro"] = b.gyro_slope_pm[k]
        values[f"kg{k + 1}"] = s.axial_mps2 * b.softening[k, k]
    return values
