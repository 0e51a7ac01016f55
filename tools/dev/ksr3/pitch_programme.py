"""The commanded pitch rate that makes the vehicle fly the point-mass path.

The attitude wanted is path angle plus the incidence that turns the path, with the gimbal angle that holds
that incidence counted. The law delta = -k_p (theta - theta_c) - k_d q has no integral and damps the whole
rate, so it holds neither a gimbal angle nor a turn without an attitude error; the programme leads by that
error for the default gains.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from maxq.control.kernel.records import Array
from maxq.tools.dev.ksr3 import assumptions as a
from maxq.tools.dev.ksr3.aerodynamics import Lift
from maxq.tools.dev.ksr3.gains import LinearGains
from maxq.tools.dev.ksr3.mass_model import mass_properties
from maxq.tools.dev.ksr3.trajectory import Flight, forces, gravity_turn_rate, turn_rate

ROW_SPACING_S = 0.5


@dataclass(frozen=True)
class Wanted:
    """Attitude and trim along the path at one time."""

    path_angle: float  # above the launch site's horizontal: attitude is inertial
    alpha: float
    gimbal: float
    gimbal_per_pitch_rate: float  # s, trims the pitch damping


def wanted(flight: Flight, lift: Lift, t: float) -> Wanted:
    """Static trim at time t; rad. Rotational acceleration along the path is neglected."""
    burn = flight.ascent.burn
    reach, altitude, speed, path_angle = flight.state_at(t)
    f = forces(flight.ascent, t, altitude, speed)
    props = mass_properties(burn, t)
    if f.thrust_N == 0:
        return Wanted(path_angle - reach / a.EARTH_RADIUS_M, 0.0, 0.0, 0.0)
    slope, centre = lift.total(f.mach)
    normal = slope * f.dynamic_pressure_Pa * a.AREA_M2  # N per rad of incidence
    arm = a.GIMBAL_STATION_M - props.x_cg_m
    gimbal_per_alpha = normal * (centre - props.x_cg_m) / (f.thrust_N * arm)
    radius = a.EARTH_RADIUS_M + altitude
    free = gravity_turn_rate(speed, path_angle, f.gravity_mps2, radius)
    turn = turn_rate(flight.ascent, t, free)
    if t < a.PITCH_OVER_START_S:
        turn = free  # straight up on the pad: no incidence
    alpha = props.mass_kg * speed * (turn - free) / (f.thrust_N * (1 - gimbal_per_alpha) + normal)
    damping = lift.pitch_damping(f.mach, props.x_cg_m) * a.CHORD_M**2 * f.dynamic_pressure_Pa * a.AREA_M2
    per_rate = -damping / (2 * max(speed, 1.0)) / (f.thrust_N * arm)
    return Wanted(path_angle - reach / a.EARTH_RADIUS_M, alpha, gimbal_per_alpha * alpha, per_rate)


def commanded_rate(flight: Flight, lift: Lift, gains: LinearGains) -> tuple[Array, Array]:
    """Times s and pitch rates rad/s of the programme; zero before the pitch-over and after burn-out."""
    end = flight.ascent.burn.tail_off_s
    fine = np.linspace(0.0, end, 2401)
    points = [wanted(flight, lift, float(t)) for t in fine]
    theta = np.array([p.path_angle + p.alpha for p in points])
    rate = np.gradient(theta, fine)
    gimbal = np.array([p.gimbal + p.gimbal_per_pitch_rate * q for p, q in zip(points, rate, strict=True)])
    k_p, k_d = np.array([gains.at(float(t)) for t in fine]).T
    command = theta + (gimbal + k_d * rate) / k_p
    rows = np.append(np.arange(0.0, end - ROW_SPACING_S, ROW_SPACING_S), end)
    # Mean slope over a row's spacing: what linear rates between the rows integrate back to.
    half = ROW_SPACING_S / 2
    ahead, behind = np.interp(rows + half, fine, command), np.interp(rows - half, fine, command)
    span = np.minimum(rows + half, end) - np.maximum(rows - half, 0.0)
    rates = (ahead - behind) / span
    rates[rows < a.PITCH_OVER_START_S] = 0.0
    return np.append(rows, flight.ascent.burn.end_s), np.append(rates, 0.0)
