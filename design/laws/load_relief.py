"""Load relief, linear side: PD's law with the lateral acceleration fed back through a lag (pd.py).

    C = F(z) (k_p, k_d, -k_a H(z))  on  (angle_rad, rate_radps, accel_mps2),    H = g / (1 - (1 - g) / z)

with g = 1 - exp(-2 pi f T), the lag of control/laws/load_relief.py; continuous 1 / (1 + s / 2 pi f). The acceleration
is that to the side of a positive command, which is why its part of C is negative: the command gives way to what pushes.
Frequency and damping ratio of the rigid body (47, 48) are those of the law without it. By angle of attack

    C = F(z) (k_p, k_d - k_alpha p / b H D, k_alpha / b H),    D = (1 - 1 / z) / T
"""

from __future__ import annotations

import math

import numpy as np

from maxq.control.kernel.records import Array
from maxq.design.laws.law import MEASUREMENTS
from maxq.design.laws.pd_variables import PdVariables
from maxq.design.model.instruments import ACCELERATION

START_S2PM = 3e-3  # of the acceleration's gain: a tenth of what thrust over mass gives back, roughly


class LoadReliefVariables(PdVariables):
    """`law.LawVariables` of load relief: those of PD, then ln k_a at the gain nodes."""

    inputs = (*MEASUREMENTS[:2], ACCELERATION)
    keys = ("k_p", "k_d_s", "k_a_s2pm")

    def _with_more_gains(self, log_gains: Array) -> Array:
        return np.vstack([log_gains, np.full(log_gains.shape[1], math.log(START_S2PM))])


class IncidenceReliefVariables(PdVariables):
    """`law.LawVariables` of load relief by angle of attack: those of PD, then ln k_alpha at the gain nodes."""

    inputs = (*MEASUREMENTS[:2], ACCELERATION)
    keys = ("k_p", "k_d_s", "k_alpha")

    def _with_more_gains(self, log_gains: Array) -> Array:
        return np.vstack([log_gains, np.log(START_S2PM * np.abs(self.air[1]))])
