"""The written pitch programme flown by a rigid body and the bare PD law: does it still meet the paper's Table 1?

Same Earth and air as the point mass, ideal actuator and gyro, no filter, no slosh, no bending. Angles in rad, attitude
above the launch site's horizontal.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from oracles.pitch_plane import read_rows
from scipy.integrate import cumulative_trapezoid, solve_ivp

from maxq.control.kernel.records import Array
from maxq.tools.dev.ksr3 import assumptions as a
from maxq.tools.dev.ksr3.mass_model import mass_properties
from maxq.tools.dev.ksr3.trajectory import forces, gravity_turn_rate
from maxq.tools.dev.ksr3.write_files import Reconstruction

GIMBAL_LIMIT = np.radians(6.0)


class PlanarFlight:
    """The equations; state = range m, altitude m, speed m/s, path angle, attitude, pitch rate."""

    def __init__(self, made: Reconstruction, programme: Path) -> None:
        self.made = made
        times, rates = np.array(read_rows(programme)).T
        self._fine = np.linspace(0.0, times[-1], 6001)
        rate: Array = np.radians(np.interp(self._fine, times, rates))
        self._commanded = np.pi / 2 + np.asarray(cumulative_trapezoid(rate, self._fine, initial=0))

    def gimbal(self, t: float, attitude: float, rate: float) -> float:
        k_p, k_d = self.made.gains.at(t)
        error = attitude - float(np.interp(t, self._fine, self._commanded))
        return float(np.clip(-k_p * error - k_d * rate, -GIMBAL_LIMIT, GIMBAL_LIMIT))

    def incidence(self, state: Array) -> float:
        return float(state[4] - (state[3] - state[0] / a.EARTH_RADIUS_M))

    def derivative(self, t: float, state: Array) -> list[float]:
        _, altitude, speed, path_angle, attitude, rate = state
        ascent, lift = self.made.flight.ascent, self.made.lift
        f = forces(ascent, t, altitude, speed)
        props = mass_properties(ascent.burn, t)
        alpha, delta = self.incidence(state), self.gimbal(t, attitude, rate)
        if speed < 10.0:  # leaving the pad: straight up
            alpha = delta = 0.0
        slope, centre = lift.total(f.mach)
        pressure_area = f.dynamic_pressure_Pa * a.AREA_M2
        normal = pressure_area * slope * alpha
        damping = lift.pitch_damping(f.mach, props.x_cg_m) * pressure_area * a.CHORD_M**2 / (2 * max(speed, 1.0))
        moment = (
            f.thrust_N * np.sin(delta) * (a.GIMBAL_STATION_M - props.x_cg_m)
            - normal * (centre - props.x_cg_m)
            + damping * rate
        )
        along = f.thrust_N * np.cos(alpha - delta) - f.drag_N * np.cos(alpha) - normal * np.sin(alpha)
        across = f.thrust_N * np.sin(alpha - delta) - f.drag_N * np.sin(alpha) + normal * np.cos(alpha)
        radius = a.EARTH_RADIUS_M + altitude
        turn = across / (f.mass_kg * max(speed, 1.0)) + gravity_turn_rate(speed, path_angle, f.gravity_mps2, radius)
        return [
            speed * np.cos(path_angle) * a.EARTH_RADIUS_M / radius,
            speed * np.sin(path_angle),
            along / f.mass_kg - f.gravity_mps2 * np.sin(path_angle),
            turn,
            rate,
            moment / props.pitch_inertia_kgm2,
        ]

    def fly(self) -> tuple[Array, Array]:
        """Times (n,) and states (n, 6) from release to burn-out."""
        flight = self.made.flight
        start = np.array([0.0, a.PAD_ALTITUDE_M, 0.0, np.pi / 2, np.pi / 2, 0.0])
        end = flight.ascent.burn.end_s
        grid = np.linspace(flight.release_s, end, 1200)
        out = solve_ivp(self.derivative, (grid[0], end), start, t_eval=grid, rtol=1e-7, atol=1e-8, max_step=0.05)
        return out.t, out.y.T
