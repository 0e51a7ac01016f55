"""Impact points: where a body would reach the ground, if thrust ended at a logged or recorded state.

In vacuum, the body moves on the Kepler ellipse of its inertial state (closed form, without J2). With drag, its motion
is integrated with J2, the air and the wind of the scenario, and a constant ballistic coefficient m / (C_D A). Neither
kind includes lift, breakup or turbulence. The ground is a surface of constant geodetic altitude.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from maxq.control.kernel.records import Array, Records, pack
from maxq.sim.packing.flight import Packed
from maxq.sim.vehicle.environment import air_over_altitude
from maxq.sim.world.earth import FLAT, INVERSE_SQUARE, J2, Earth, geodetic_places, gravitations

_ITERATIONS, _CLOSE_m = 60, 1e-4
_TOP_m, _LAYER_m = 120e3, 500.0  # air is neglected above
_LONGEST_STEP_s, _DRAG_STEP = 2.0, 0.1  # step of the integration, s, and at most this share of the time v / (drag)
_MOST_STEPS, _BISECTIONS = 20_000, 32


@dataclass(frozen=True)
class Impacts:
    """Impact points (n,): geodetic latitude, longitude (east positive), and time of the fall; nan without impact."""

    latitude_deg: Array
    longitude_deg: Array
    fall_s: Array


@dataclass(frozen=True)
class AirColumn:
    """Air over altitude (k,): logarithm of the density, kg/m3 (-inf: none), and wind north, east, down (k, 3), m/s."""

    altitude_m: Array
    log_density: Array
    wind_N_mps: Array


def has_impacts(earth: Earth) -> bool:
    """Return True if impact points are defined: on a round Earth with gravitation towards its centre."""
    return bool(earth.figure != FLAT and earth.gravity in (INVERSE_SQUARE, J2))


def vacuum_impacts(earth: Earth, time_s: Array, r_I_m: Array, v_I_mps: Array, ground_m: float = 0.0) -> Impacts:
    """Return the impact points of states (n, 3) in I at flight times `time_s` (n,), on Kepler ellipses.

    `ground_m` is the geodetic altitude of the ground. The ellipse is intersected with the ellipsoid by iteration of
    the radius at the impact point, to 0.1 mm of altitude. The result is nan for an orbit above the ground, for an
    escape, and on an Earth without `has_impacts`; a state below the ground is its own impact point. J2 is neglected:
    it moves the point by up to about 0.5 % of the inertial path (tests/test_oracle_impact.py).
    """
    if not has_impacts(earth):
        return Impacts(*np.full((3, len(time_s)), math.nan))
    mu, globe = float(earth.mu_m3ps2), pack([earth])
    radius = np.linalg.norm(r_I_m, axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        axis = 1.0 / (2.0 / radius - np.sum(v_I_mps**2, axis=1) / mu)
        motion = np.sqrt(mu / axis**3)
        e_cos = 1.0 - radius / axis
        e_sin = np.sum(r_I_m * v_I_mps, axis=1) / np.sqrt(mu * axis)
        eccentricity, anomaly = np.hypot(e_cos, e_sin), np.arctan2(e_sin, e_cos)
        below = _geodetic(globe, r_I_m)[2] <= ground_m
        end_m = np.full(len(radius), float(earth.equatorial_radius_m) + ground_m)
        for _ in range(_ITERATIONS):
            turned = (2.0 * math.pi - np.arccos(np.clip((1.0 - end_m / axis) / eccentricity, -1.0, 1.0))) - anomaly
            turned = np.where(below, 0.0, np.mod(turned, 2.0 * math.pi))
            then = anomaly + turned
            fall_s = (turned - eccentricity * np.sin(then) + e_sin) / motion
            f = 1.0 - axis / radius * (1.0 - np.cos(turned))
            g = fall_s - (turned - np.sin(turned)) / motion
            place = f[:, None] * r_I_m + g[:, None] * v_I_mps
            latitude, azimuth, altitude = _geodetic(globe, place)
            miss_m = np.where(below, 0.0, altitude - ground_m)
            if not (np.abs(miss_m) > _CLOSE_m).any():
                break
            end_m = end_m - miss_m
        falls = (axis > 0.0) & (axis * (1.0 - eccentricity) < end_m) & (np.abs(miss_m) <= _CLOSE_m)
    return _impacts(earth, time_s, np.where(below, 0.0, np.where(falls, fall_s, math.nan)), latitude, azimuth)


def falling_impacts(
    earth: Earth,
    column: AirColumn,
    ballistic_kgpm2: float,
    time_s: Array,
    r_I_m: Array,
    v_I_mps: Array,
    ground_m: float = 0.0,
) -> Impacts:
    """Return the impact points of states (n, 3) in I with drag: m / (C_D A) = `ballistic_kgpm2`.

    Method: classical Runge-Kutta of fourth order; all bodies are advanced together, each with its own step. States
    whose vacuum ellipse does not meet the ground give nan.
    """
    globe = pack([earth])
    todo = np.flatnonzero(np.isfinite(vacuum_impacts(earth, time_s, r_I_m, v_I_mps, ground_m).fall_s))
    fall_s, last = np.full(len(time_s), math.nan), np.hstack([r_I_m, v_I_mps])  # states before the step to the ground
    y, t, last_step_s = last[todo], np.zeros(len(todo)), np.zeros(len(time_s))
    for _ in range(_MOST_STEPS):
        if not len(todo):
            break
        step_s = _step_s(globe, column, ballistic_kgpm2, y)
        after = _stepped(globe, column, ballistic_kgpm2, y, step_s)
        flies = _geodetic(globe, after[:, :3])[2] > ground_m
        landed = todo[~flies]
        fall_s[landed], last[landed], last_step_s[landed] = t[~flies], y[~flies], step_s[~flies]
        todo, y, t = todo[flies], after[flies], (t + step_s)[flies]
    low, high = np.zeros(len(time_s)), last_step_s
    for _ in range(_BISECTIONS):
        middle = 0.5 * (low + high)
        flies = _geodetic(globe, _stepped(globe, column, ballistic_kgpm2, last, middle)[:, :3])[2] > ground_m
        low, high = np.where(flies, middle, low), np.where(flies, high, middle)
    latitude, azimuth, _ = _geodetic(globe, _stepped(globe, column, ballistic_kgpm2, last, high)[:, :3])
    return _impacts(earth, time_s, fall_s + high, latitude, azimuth)


def air_column(packed: Packed, ground_m: float) -> AirColumn:
    """Return the air of a packed scenario from the ground up, with wind profile and gusts. Turbulence is omitted.

    `packed` may be at its start or in flight.
    """
    altitudes = np.concatenate(
        [
            np.arange(math.floor(ground_m / _LAYER_m) * _LAYER_m, 20e3, _LAYER_m),
            np.arange(20e3, _TOP_m + 1.0, 4.0 * _LAYER_m),
        ]
    )
    table = np.empty((len(altitudes), 4))
    air_over_altitude(packed.parameters["environment"][:1].copy(), packed.pool, altitudes, table)
    with np.errstate(divide="ignore"):
        return AirColumn(altitudes, np.log(table[:, 0]), table[:, 1:])


def _impacts(earth: Earth, time_s: Array, fall_s: Array, latitude: Array, azimuth: Array) -> Impacts:
    """Return the impact points from the latitude and the azimuth in I of the places of impact, rad."""
    longitude = np.degrees(azimuth - float(earth.rate_radps) * (time_s + fall_s))
    known = np.where(np.isfinite(fall_s), 0.0, math.nan)
    return Impacts(np.degrees(latitude) + known, np.mod(longitude + 180.0, 360.0) - 180.0 + known, fall_s)


def _geodetic(earth: Records, r_m: Array) -> Array:
    """Return latitude, azimuth about the polar axis (rad) and altitude (m), (3, n), of places (n, 3)."""
    out = np.empty(r_m.shape)
    geodetic_places(earth, np.ascontiguousarray(r_m), out)
    return out.T


def _rates(earth: Records, column: AirColumn, ballistic_kgpm2: float, y: Array) -> tuple[Array, Array]:
    """Return the derivative (n, 6) of states in I, and the drag over the speed relative to the air (n,), 1/s."""
    r, v = y[:, :3], y[:, 3:]
    latitude, azimuth, altitude = _geodetic(earth, r)
    wind = np.stack([np.interp(altitude, column.altitude_m, column.wind_N_mps[:, k]) for k in range(3)])
    s, c, sine, cosine = np.sin(latitude), np.cos(latitude), np.sin(azimuth), np.cos(azimuth)
    outward = -s * wind[0] - c * wind[2]
    spin = float(earth["rate_radps"][0])
    air = np.stack(
        [
            cosine * outward - sine * wind[1] - spin * r[:, 1],
            sine * outward + cosine * wind[1] + spin * r[:, 0],
            c * wind[0] - s * wind[2],
        ],
        axis=1,
    )
    past = v - air
    density = np.exp(np.interp(altitude, column.altitude_m, column.log_density, right=-math.inf))
    drag = 0.5 * density * np.linalg.norm(past, axis=1) / ballistic_kgpm2
    return np.hstack([v, _gravitation(earth, r) - drag[:, None] * past]), drag


def _gravitation(earth: Records, r_m: Array) -> Array:
    """Return the gravitation (n, 3), m/s2, at places (n, 3)."""
    out = np.empty(r_m.shape)
    gravitations(earth, np.ascontiguousarray(r_m), out)
    return out


def _step_s(earth: Records, column: AirColumn, ballistic_kgpm2: float, y: Array) -> Array:
    drag = _rates(earth, column, ballistic_kgpm2, y)[1]
    return np.minimum(_LONGEST_STEP_s, _DRAG_STEP / np.maximum(drag, 1e-9))


def _stepped(earth: Records, column: AirColumn, ballistic_kgpm2: float, y: Array, step_s: Array) -> Array:
    h = step_s[:, None]
    k1 = _rates(earth, column, ballistic_kgpm2, y)[0]
    k2 = _rates(earth, column, ballistic_kgpm2, y + 0.5 * h * k1)[0]
    k3 = _rates(earth, column, ballistic_kgpm2, y + 0.5 * h * k2)[0]
    k4 = _rates(earth, column, ballistic_kgpm2, y + h * k3)[0]
    return np.asarray(y + h / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4))
