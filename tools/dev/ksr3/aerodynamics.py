"""Lift of nose and fins over Mach number, fitted to the ends of Table 2, and what follows by strip theory."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from math import exp

import numpy as np
from scipy.interpolate import PchipInterpolator
from scipy.optimize import least_squares

from maxq.control.kernel.records import Array
from maxq.tools.dev.ksr3 import assumptions as a
from maxq.tools.dev.ksr3.mass_model import mass_properties
from maxq.tools.dev.ksr3.trajectory import Flight, forces

NOSE_STATION_M = 2.0  # nose and forebody
MACH = np.array([0.0, 0.5, 0.8, 0.95, 1.1, 1.25, 1.5, 1.75, 2.0, 2.25, 2.5, 3.0, 5.0])
FIN_LIFT = np.array([1.0, 1.02, 1.08, 1.13, 1.16, 1.13, 1.02, 0.91, 0.81, 0.73, 0.67, 0.56, 0.33])
FIN_SHIFT_M = 0.40 * np.array([0.0, 0.0, 0.0, 0.12, 0.38, 0.75, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0])


@dataclass(frozen=True)
class Lift:
    """Normal-force slopes (1/rad, area S_ref) and stations of nose and fins (with their interference)."""

    fin_slope_pr: float  # at Mach 0
    fin_station_m: float  # at Mach 0
    mach_sensitivity: float  # exponent-like stretch of the assumed Mach shape
    shift_scale: float  # of the assumed rearward travel above Mach 1

    @cached_property
    def _fin_slope(self) -> PchipInterpolator:
        return PchipInterpolator(MACH, self.fin_slope_pr * (1 + (FIN_LIFT - 1) * self.mach_sensitivity))

    @cached_property
    def _fin_station(self) -> PchipInterpolator:
        return PchipInterpolator(MACH, self.fin_station_m + self.shift_scale * FIN_SHIFT_M)

    def nose(self, mach: float) -> tuple[float, float]:
        """Slope 1/rad and station m."""
        return 3.0 + 0.4 * exp(-(((mach - 1.2) / 0.5) ** 2)), NOSE_STATION_M

    def fins(self, mach: float) -> tuple[float, float]:
        """Slope 1/rad and station m."""
        mach = min(mach, MACH[-1])
        return float(self._fin_slope(mach)), float(self._fin_station(mach))

    def total(self, mach: float) -> tuple[float, float]:
        """Slope 1/rad and centre of pressure m."""
        (nose, nose_station), (fins, fin_station) = self.nose(mach), self.fins(mach)
        return nose + fins, (nose * nose_station + fins * fin_station) / (nose + fins)

    def pitch_damping(self, mach: float, x_cg_m: float) -> float:
        """Cmq by strips: each surface sees the incidence that its arm about the CG makes; per q c / (2 V)."""
        moment = sum(slope * (station - x_cg_m) ** 2 for slope, station in (self.nose(mach), self.fins(mach)))
        return -2 * moment / a.CHORD_M**2

    def roll_damping(self, mach: float) -> float:
        """Clp by strips over four trapezoidal fins, per p b / (2 V), b = 1 m; body interference taken out."""
        interference = 1 + a.FIN_ROOT_RADIUS_M / a.FIN_TIP_RADIUS_M
        return -4 * self.fins(mach)[0] / interference * _fin_mean_square_radius_m2() / a.DIAMETER_M**2


def _fin_mean_square_radius_m2() -> float:
    """Chord-weighted mean of the squared distance from the axis over a fin."""
    radius = np.linspace(a.FIN_ROOT_RADIUS_M, a.FIN_TIP_RADIUS_M, 401)
    chord = np.interp(radius, radius[[0, -1]], [a.FIN_ROOT_CHORD_M, a.FIN_TIP_CHORD_M])
    return float(np.trapezoid(chord * radius**2, radius) / np.trapezoid(chord, radius))


@dataclass(frozen=True)
class CrossFlow:
    """Drag across the axis: a coefficient on S_ref and the station where it acts."""

    coefficient: float
    station_m: float


def cross_flow() -> CrossFlow:
    """1.2 times the planform of body and one pair of fins; ogive nose of 2.5 m, cylinder to the gimbal."""
    nose, cylinder = 2 / 3 * 2.5 * a.DIAMETER_M, (a.GIMBAL_STATION_M - 2.5) * a.DIAMETER_M
    fins = (a.FIN_TIP_RADIUS_M - a.FIN_ROOT_RADIUS_M) * (a.FIN_ROOT_CHORD_M + a.FIN_TIP_CHORD_M)
    area = nose + cylinder + fins
    station = (nose * 1.56 + cylinder * (2.5 + a.GIMBAL_STATION_M) / 2 + fins * 12.0) / area
    return CrossFlow(1.2 * area / a.AREA_M2, station)


def fit_to_table_2(flight: Flight) -> Array:
    """Parameters of `Lift`: four to the extremes of Z_alpha (-0.1, -0.55 1/s) and M_alpha (-1, -40 1/s2), 5 to 55 s."""
    times = np.arange(5.0, 55.01, 1.0)
    points = []
    for t in times:
        _, altitude, speed, _ = flight.state_at(t)
        f = forces(flight.ascent, t, altitude, speed)
        points.append((f, speed, mass_properties(flight.ascent.burn, t)))

    def residuals(p: Array) -> list[float]:
        lift = Lift(*(float(v) for v in p))
        z, m = [], []
        for f, speed, props in points:
            slope, station = lift.total(f.mach)
            force = slope * f.dynamic_pressure_Pa * a.AREA_M2
            z.append(-force / (props.mass_kg * speed))
            m.append(-force * (station - props.x_cg_m) / props.pitch_inertia_kgm2)
        return [
            (z[0] + 0.097) / 0.003,
            (min(z) + 0.55) / 0.01,
            (m[0] + 1.0) / 0.02,
            (min(m) + 40) / 0.5,
            (p[2] - 0.85) / 0.05,
            (p[3] - 1) / 0.3,
        ]

    fit = least_squares(residuals, [16.0, 11.0, 0.85, 1.0])
    return np.asarray(fit.x)
