"""Thrust and mass over time: ignition ramp, linear droop of a pressure-fed chamber, tail-off.

The rows themselves, joined by monotone cubics as the simulator joins them, *are* the thrust history; its
integral divided by the exhaust velocity is the mass expelled. Thrust and mass tables therefore agree to
round-off.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike
from scipy.interpolate import PchipInterpolator
from scipy.optimize import brentq

from maxq.control.kernel.records import Array
from maxq.tools.dev.ksr3 import assumptions as a

SEA_LEVEL_PRESSURE_PA = 101325.0


@dataclass(frozen=True)
class Burn:
    """Vacuum thrust rows of a burn and what they imply. Times in s from the ignition signal."""

    times_s: Array
    thrust_vacuum_N: Array
    exhaust_velocity_mps: float  # vacuum specific impulse times standard gravity
    exit_area_m2: float

    @cached_property
    def _thrust(self) -> PchipInterpolator:
        return PchipInterpolator(self.times_s, self.thrust_vacuum_N)

    @cached_property
    def _impulse(self) -> PchipInterpolator:
        return self._thrust.antiderivative()

    @property
    def end_s(self) -> float:
        return float(self.times_s[-1])

    @property
    def tail_off_s(self) -> float:
        """When the thrust begins to fall."""
        return self.end_s - a.TAIL_OFF_S

    def vacuum_thrust_N(self, t: ArrayLike) -> Array:
        inside = (np.asarray(t) >= 0) & (np.asarray(t) < self.end_s)
        return np.where(inside, self._thrust(np.clip(t, 0.0, self.end_s)), 0.0)

    def thrust_N(self, t: float, pressure_Pa: float) -> float:
        """Thrust against an ambient pressure; a chamber that cannot overcome it gives none."""
        return max(float(self.vacuum_thrust_N(t)) - pressure_Pa * self.exit_area_m2, 0.0)

    def mass_kg(self, t: ArrayLike) -> Array:
        """Vehicle mass; the burn-out mass after the end."""
        return a.LIFTOFF_MASS_KG - self._impulse(np.clip(t, 0.0, self.end_s)) / self.exhaust_velocity_mps

    def mass_flow_kgps(self, t: ArrayLike) -> Array:
        return self.vacuum_thrust_N(t) / self.exhaust_velocity_mps

    @property
    def burnout_mass_kg(self) -> float:
        return float(self.mass_kg(self.end_s))

    def propellant_left(self, t: ArrayLike) -> Array:
        """Share of the propellant still aboard, 1 to exactly 0."""
        left = self.mass_kg(t) - self.burnout_mass_kg
        return np.clip(left / (a.LIFTOFF_MASS_KG - self.burnout_mass_kg), 0.0, 1.0)


def make_burn(droop_end: float, vacuum_isp_s: float, exit_area_m2: float) -> Burn:
    """A burn with the impulse of one that starts and ends abruptly and lasts 59 s.

    `droop_end` is the chamber pressure at 59 s over that at ignition. The steady part is 129 kN at sea level
    at t = 0. The ramps cost impulse; the tail-off begins as much later as it takes to give it back.
    """
    start_N = a.SEA_LEVEL_THRUST_N + SEA_LEVEL_PRESSURE_PA * exit_area_m2
    wanted_Ns = start_N * a.BURN_S * (1 + droop_end) / 2
    velocity = vacuum_isp_s * a.STANDARD_GRAVITY_MPS2

    def burn(tail_off_s: float) -> Burn:
        times, shape = _rows(tail_off_s)
        droop = 1 - (1 - droop_end) * times / a.BURN_S
        return Burn(times, np.round(start_N * droop * shape, 4), velocity, exit_area_m2)

    def excess_Ns(tail_off_s: float) -> float:
        trial = burn(tail_off_s)
        return float(trial._impulse(trial.end_s)) - wanted_Ns

    return burn(round(float(brentq(excess_Ns, a.BURN_S - 0.5, a.BURN_S + 0.5, xtol=1e-9)), 6))


def _rows(tail_off_s: float) -> tuple[Array, Array]:
    """Times of the rows, and the share of the drooping thrust there (smooth steps up and down)."""
    ignition = np.linspace(0.0, a.IGNITION_RAMP_S, 11)
    steady = np.concatenate([[0.3, 0.5], np.arange(1.0, np.floor(tail_off_s - 0.2) + 0.5), [tail_off_s - 0.1]])
    tail = tail_off_s + np.linspace(0.0, a.TAIL_OFF_S, 13)
    times = np.round(np.concatenate([ignition, steady, tail]), 6)
    rise = _smooth_step(times / a.IGNITION_RAMP_S)
    fall = _smooth_step((times[-1] - times) / a.TAIL_OFF_S)
    return times, rise * fall


def _smooth_step(x: Array) -> Array:
    """0 to 1 with level ends, 3 x^2 - 2 x^3."""
    x = np.clip(x, 0.0, 1.0)
    return np.asarray(x * x * (3 - 2 * x))
