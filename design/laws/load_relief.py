"""The linear model of load relief: the PD law with feedback of the lateral acceleration through a lag (pd.py).

    C = F(z) (k_p, k_d, -k_a H(z))  on  (angle_rad, rate_radps, accel_mps2),    H = g / (1 - (1 - g) / z)

with g = 1 - exp(-2 pi f T), the lag of control/laws/load_relief.py. The continuous lag is 1 / (1 + s / 2 pi f). The
acceleration is positive in the direction in which a positive command pushes the vehicle. Its gain in C is therefore
negative, and the command yields to the disturbing force. Frequency and damping ratio of the rigid body (47, 48) are
those of the law without load relief. With feedback of the angle of attack, the law is

    C = F(z) (k_p, k_d - k_alpha p / b H D, k_alpha / b H),    D = (1 - 1 / z) / T

where the angle of attack is estimated from acceleration and rate.
"""

from __future__ import annotations

import math

import numpy as np

from maxq.control.kernel.records import Array
from maxq.design.laws.law import MEASUREMENTS
from maxq.design.laws.pd_variables import PdVariables
from maxq.design.model.instruments import ACCELERATION

START_S2PM = 3e-3  # starting acceleration gain, about a tenth of mass / thrust


class LoadReliefVariables(PdVariables):
    """The variables (`law.LawVariables`) of load relief.

    The PD variables are followed by ln k_a at the gain nodes.
    """

    inputs = (*MEASUREMENTS[:2], ACCELERATION)
    keys = ("k_p", "k_d_s", "k_a_s2pm")

    def _with_more_gains(self, log_gains: Array) -> Array:
        return np.vstack([log_gains, np.full(log_gains.shape[1], math.log(START_S2PM))])


class IncidenceReliefVariables(PdVariables):
    """The variables (`law.LawVariables`) of load relief by angle of attack.

    The PD variables are followed by ln k_alpha at the gain nodes.
    """

    inputs = (*MEASUREMENTS[:2], ACCELERATION)
    keys = ("k_p", "k_d_s", "k_alpha")

    def _with_more_gains(self, log_gains: Array) -> Array:
        return np.vstack([log_gains, np.log(START_S2PM * np.abs(self.air[1]))])
