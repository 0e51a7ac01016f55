"""Fly a rigid body from first principles with SciPy's DOP853, without any code of maxq.

All formulations differ from maxq's. The oracle has Newton's law in the frame that rotates with the Earth (Coriolis and
centrifugal terms), and the attitude as direction cosines from body to Earth. Gravitation is the derivative of its
potential by a complex step. Geodetic latitude follows by iteration, the standard atmosphere by its layers. SI units.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import solve_ivp

Vector = NDArray[np.float64]

MU, RADIUS, FLATTENING, RATE, J2 = 3.986004418e14, 6378137.0, 1 / 298.257223563, 7.292115e-5, 1.08262982e-3
SPIN = np.array([0.0, 0.0, RATE])
GAS = 8314.32 / 28.9644
LAYERS = ((0.0, -6.5e-3), (11e3, 0.0), (20e3, 1e-3), (32e3, 2.8e-3), (47e3, 0.0), (51e3, -2.8e-3), (71e3, -2e-3))


@dataclass(frozen=True)
class Air:
    """The air around a body at an instant; `flow_B` is the body's velocity relative to the air, in B."""

    altitude_m: float
    density: float
    pressure: float
    sound_speed: float
    flow_B: Vector
    rate_BI_B: Vector
    rate_BE_B: Vector

    @property
    def speed(self) -> float:
        return float(np.linalg.norm(self.flow_B))

    @property
    def mach(self) -> float:
        return self.speed / self.sound_speed


@dataclass(frozen=True)
class Body:
    """The properties of a body about its CG, in B: mass and inertia over time; force and moment over time and air."""

    mass: Callable[[float], float]
    inertia: Callable[[float], Vector]
    loads: Callable[[float, Air], tuple[Vector, Vector]]


@dataclass(frozen=True)
class State:
    """A state: position and velocity relative to the Earth in E; `attitude` turns B into E; inertial rate in B."""

    position: Vector
    velocity: Vector
    attitude: Vector
    rate: Vector


def cross(a: Vector, b: Vector) -> Vector:
    """Return the cross product of two vectors; five times as fast as np.cross."""
    return np.array([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])


def gravitation(position: Vector) -> Vector:
    """Return the gradient of mu/r (1 - J2 (a/r)^2 (3 sin^2 - 1) / 2) by a complex step, exact to rounding."""
    out = np.zeros(3)
    for axis in range(3):
        r = position.astype(complex)
        r[axis] += 1e-20j
        length = np.sqrt((r * r).sum())
        sine = r[2] / length
        out[axis] = (MU / length * (1 - J2 * (RADIUS / length) ** 2 * (3 * sine**2 - 1) / 2)).imag / 1e-20
    return out


def geodetic(position: Vector) -> tuple[float, float, float]:
    """Return latitude, longitude and altitude by iteration until they are constant (not at the poles)."""
    e2 = FLATTENING * (2 - FLATTENING)
    p = float(np.hypot(position[0], position[1]))
    latitude, altitude = np.arctan2(position[2], p * (1 - e2)), 0.0
    for _ in range(20):
        normal = RADIUS / np.sqrt(1 - e2 * np.sin(latitude) ** 2)
        altitude = p / np.cos(latitude) - normal
        before, latitude = latitude, np.arctan2(position[2], p * (1 - e2 * normal / (normal + altitude)))
        if abs(latitude - before) < 1e-16:
            break
    return float(latitude), float(np.arctan2(position[1], position[0])), float(altitude)


def earth_fixed(latitude_deg: float, longitude_deg: float, altitude_m: float) -> Vector:
    e2 = FLATTENING * (2 - FLATTENING)
    latitude, longitude = np.radians([latitude_deg, longitude_deg])
    normal = RADIUS / np.sqrt(1 - e2 * np.sin(latitude) ** 2)
    across = (normal + altitude_m) * np.cos(latitude)
    return np.array(
        [across * np.cos(longitude), across * np.sin(longitude), (normal * (1 - e2) + altitude_m) * np.sin(latitude)]
    )


def ned_axes(latitude: float, longitude: float) -> Vector:
    """Return the axes north, east, down in E as columns, from the vertical."""
    up = np.array([np.cos(latitude) * np.cos(longitude), np.cos(latitude) * np.sin(longitude), np.sin(latitude)])
    east = np.array([-np.sin(longitude), np.cos(longitude), 0.0])
    return np.stack([cross(up, east), east, -up], axis=1)


def about(axis: int, angle_deg: float) -> Vector:
    """Return the rotation about a coordinate axis; a 3-2-1 attitude is a product of three."""
    angle = np.radians(angle_deg)
    i, j = (axis + 1) % 3, (axis + 2) % 3
    out = np.eye(3)
    out[i, i] = out[j, j] = np.cos(angle)
    out[j, i], out[i, j] = np.sin(angle), -np.sin(angle)
    return out


def standard_air(altitude_m: float) -> tuple[float, float, float]:
    """Return density, pressure and speed of sound of the US Standard Atmosphere 1976 up to 80 km, by layers."""
    h = 6356766.0 * altitude_m / (6356766.0 + altitude_m)
    temperature, pressure = 288.15, 101325.0
    for (base, lapse), (top, _) in zip(LAYERS, (*LAYERS[1:], (84e3, 0.0)), strict=True):
        rise = min(h, top) - base
        after = temperature + lapse * rise
        if lapse == 0.0:
            pressure *= np.exp(-9.80665 * rise / (GAS * temperature))
        else:
            pressure *= (temperature / after) ** (9.80665 / (GAS * lapse))
        temperature = after
        if h <= top:
            break
    return pressure / (GAS * temperature), pressure, float(np.sqrt(1.4 * GAS * temperature))


def start(
    place: tuple[float, float, float],
    velocity_ned: Sequence[float],
    euler_deg: tuple[float, float, float],
    rate_degps: Sequence[float],
    rate_is_inertial: bool,
) -> State:
    """Return the state at t = 0 (E = I) from geodetic place, NED velocity, yaw, pitch, roll and body rates."""
    position = earth_fixed(*place)
    axes = ned_axes(*geodetic(position)[:2])
    yaw, pitch, roll = euler_deg
    attitude = axes @ about(2, yaw) @ about(1, pitch) @ about(0, roll)
    rate = np.radians(rate_degps)
    if not rate_is_inertial:
        rate = rate + attitude.T @ SPIN
    return State(position, axes @ np.array(velocity_ned), attitude, rate)


def no_wind(altitude_m: float) -> Vector:
    return np.zeros(3)


def integrate(
    body: Body,
    state: State,
    times: Vector,
    kinks: Sequence[float] = (),
    wind_ned: Callable[[float], Vector] = no_wind,
    longest_step_s: float = np.inf,
) -> list[State]:
    """Return the states at `times` (rising; the first is the start). The integration restarts at each of `kinks`.

    `longest_step_s` is for loads with kinks at unknown times, such as tables over angle of attack: the error estimate
    of a long step does not detect them.
    """

    def derivative(t: float, y: Vector, last: float) -> Vector:
        t = min(t, last)
        position, velocity, attitude, rate = y[:3], y[3:6], y[6:15].reshape(3, 3), y[15:18]
        latitude, longitude, altitude = geodetic(position)
        density, pressure, sound_speed = standard_air(altitude)
        relative = velocity - ned_axes(latitude, longitude) @ wind_ned(altitude)
        turning = rate - attitude.T @ SPIN
        air = Air(altitude, density, pressure, sound_speed, attitude.T @ relative, rate, turning)
        force, moment = body.loads(t, air)
        accel = gravitation(position) + attitude @ force / body.mass(t)
        accel = accel - 2 * cross(SPIN, velocity) - cross(SPIN, cross(SPIN, position))
        inertia = body.inertia(t)
        spin_up = np.linalg.solve(inertia, moment - cross(rate, inertia @ rate))
        # each row e of the attitude is a vector fixed in E and seen in B: de/dt = e x turning
        rows = [cross(row, turning) for row in attitude]
        return np.concatenate([velocity, accel, *rows, spin_up])

    y = np.concatenate([state.position, state.velocity, state.attitude.ravel(), state.rate])
    out = [state]
    now, end = float(times[0]), float(times[-1])
    for until in [*(k for k in sorted(kinks) if now < k < end), end]:
        wanted = times[(times > now) & (times <= until)]
        grid = np.unique(np.append(wanted, until))
        last = float(np.nextafter(until, now))  # a jump at the end of a stretch belongs to the next one
        solution = solve_ivp(
            derivative, (now, until), y, "DOP853", grid, rtol=1e-12, atol=1e-13, args=(last,), max_step=longest_step_s
        )
        assert solution.success, solution.message
        out += [_state(column) for t, column in zip(grid, solution.y.T, strict=True) if t in wanted]
        now, y = until, solution.y[:, -1]
    return out


def _state(y: Vector) -> State:
    return State(y[:3], y[3:6], y[6:15].reshape(3, 3), y[15:18])
