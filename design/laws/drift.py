"""The linear model of the laws with drift feedback: PD or PID, with drift velocity and displacement (pd.py).

    C = F(z) (k_p, k_d, [k_i,] -k_zd, -k_z)  on  (angle_rad, rate_radps, [angle_integral_rads,] drift_mps, drift_m)

Drift velocity and displacement are positive in the direction in which a positive command pushes the vehicle. Their
gains in C are therefore negative, and the command opposes the drift. Frequency and damping ratio of the rigid body (47,
48) are those of the law without drift feedback. The kernel of the law is control/laws/drift.py.

**Steady wind.** The vehicle (given.py) flies in a steady lateral wind v with the law delta = -k_p theta - k_alpha
alpha + k_zd z'. Its steady angle of attack alpha and drift velocity z' satisfy

    N alpha = -k_zd v,    z' = v + V (1 + c) alpha,    N = A6 / K1 - k_alpha + k_p c + k_zd V (1 + c),
    c = (a1 V - a3 A6 / K1) / a4,

since delta = -A6 alpha / K1 balances the moment and theta = -c alpha the lateral force (`in_steady_wind`). Stable loops
can therefore meet one of two conditions (Greensite, NASA CR-820, 1967, ch. 3; Hoelker, NASA TR R-92, 1961):

- minimum load: alpha = 0 for k_zd = 0. The vehicle drifts with the wind.
- minimum drift: z' = 0 for k_alpha = A6 / K1 + k_p c (`minimum_drift_k_alpha`). Without k_alpha, the drift decreases
  with k_zd. It is the fraction p of the wind for k_zd V (1 + c) = (1 / p - 1) (A6 / K1 + k_p c) (`drift_k_zd`).

With k_z > 0, z' = 0 in every steady wind, and the displacement settles instead.
"""

from __future__ import annotations

import math

import numpy as np

from maxq.control.kernel.records import Array
from maxq.design.laws.law import DRIFTS, MEASUREMENTS
from maxq.design.laws.pd_variables import PdVariables
from maxq.design.laws.pid import PidVariables
from maxq.design.model.given import PlaneCoefficients

START_RADSPM, START_RADPM = 3e-4, 1e-5  # starting gains, of the order of Zavoli's published schedule


def _with_drift(log_gains: Array) -> Array:
    columns = log_gains.shape[1]
    return np.vstack([log_gains, np.full(columns, math.log(START_RADSPM)), np.full(columns, math.log(START_RADPM))])


class DriftVariables(PdVariables):
    """The variables (`law.LawVariables`) of PD with drift feedback.

    The PD variables are followed by ln k_zd and ln k_z at the gain nodes.
    """

    inputs = (*MEASUREMENTS[:2], *DRIFTS)
    keys = ("k_p", "k_d_s", "k_zd_radspm", "k_z_radpm")

    def _with_more_gains(self, log_gains: Array) -> Array:
        return _with_drift(log_gains)


class PidDriftVariables(PidVariables):
    """The variables (`law.LawVariables`) of PID with drift feedback.

    The PID variables are followed by ln k_zd and ln k_z at the gain nodes.
    """

    inputs = (*MEASUREMENTS, *DRIFTS)
    keys = ("k_p", "k_d_s", "k_i_ps", "k_zd_radspm", "k_z_radpm")

    def _with_more_gains(self, log_gains: Array) -> Array:
        return _with_drift(super()._with_more_gains(log_gains))


def path_factor(given: PlaneCoefficients) -> float:
    """Return the ratio c, such that the attitude in a steady state is -c times the angle of attack."""
    return (given.a1_1ps * given.V_mps - given.a3_mps2 * given.A6_1ps2 / given.K1_1ps2) / given.a4_mps2


def in_steady_wind(
    given: PlaneCoefficients, k_p: float, k_zd_radspm: float, k_alpha: float = 0.0, wind_mps: float = 1.0
) -> tuple[float, float]:
    """Return the angle of attack, rad, and the drift velocity, m/s, in a steady lateral wind, for k_z = 0.

    Valid for a stable loop of the rigid vehicle. Raises ValueError if the loop has no steady state.
    """
    c = path_factor(given)
    span = given.V_mps * (1.0 + c)
    total = given.A6_1ps2 / given.K1_1ps2 - k_alpha + k_p * c + k_zd_radspm * span
    if total == 0.0:
        raise ValueError("the gains leave a pole at zero: there is no steady state in a wind")
    alpha = -k_zd_radspm * wind_mps / total
    return alpha, wind_mps + span * alpha


def minimum_drift_k_alpha(given: PlaneCoefficients, k_p: float) -> float:
    """Return the angle-of-attack gain k_alpha for which a steady wind causes no drift, for any k_zd above 0."""
    return given.A6_1ps2 / given.K1_1ps2 + k_p * path_factor(given)


def drift_k_zd(given: PlaneCoefficients, k_p: float, share: float) -> float:
    """Return the gain k_zd, rad s/m, for a drift velocity of the fraction `share` of a steady wind.

    The law has no k_alpha. Raises ValueError for a share outside 0 to 1.
    """
    if not 0.0 < share <= 1.0:
        raise ValueError(f"share = {share:g}: allowed is above 0, at most 1")
    return (1.0 / share - 1.0) * minimum_drift_k_alpha(given, k_p) / (given.V_mps * (1.0 + path_factor(given)))
