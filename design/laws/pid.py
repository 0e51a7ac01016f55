"""The proportional-integral-derivative law, linear side: PD's with a third gain (pd.py).

    C = F(z) (k_p, k_d, k_i)  on  (angle_rad, rate_radps, angle_integral_rads)

The integral is the sum over samples, T z / (z - 1), as the computer forms it below its limit. `limits.integral_hz`
bounds its corner from below only: an optimum may take far more (ksr3-relaxed with F3: 0.4 to 1.5 Hz). Frequency and
damping ratio of the rigid body (47, 48) are those of the law without its integral, and mean what
they say only while its corner lies well below them; stability and margins are those of the whole loop. Its kernel is
control/laws/pid.py.
"""

from __future__ import annotations

import math

import numpy as np

from maxq.control.kernel.records import Array
from maxq.design.laws.law import MEASUREMENTS, LawLimit, LimitValues
from maxq.design.laws.pd import GAIN_FACTOR, PdVariables
from maxq.design.laws.task import DB, Task

CORNER = 0.1  # of the rigid body's least frequency: corner of the integral where the case does not say


class PidVariables(PdVariables):
    """`law.LawVariables` of PID: those of PD, then ln k_i at the gain nodes."""

    inputs = MEASUREMENTS
    keys = ("k_p", "k_d_s", "k_i_ps")

    def __init__(self, task: Task, like: PdVariables | None = None, schedule: str | None = None) -> None:
        super().__init__(task, like, schedule)
        self.limits = (*self.limits, LawLimit("corner of the integral", "Hz", True))
        given = task.case.limits.integral_hz
        self.integral_hz = CORNER * task.case.limits.rigid_hz if given is None else given

    def limit_values(self, own: Array) -> list[LimitValues]:
        """Those of PD, and k_i / (2 pi k_p)."""
        n, plants = self.filter.size, len(own)
        corner_hz = np.exp(own[:, n + 2] - own[:, n]) / (2.0 * math.pi)
        least, by = np.full(plants, self.integral_hz), np.zeros((plants, self.own_size))
        by[:, n], by[:, n + 2] = DB, -DB
        excess_db = DB * np.log(least / corner_hz)
        number = len(self.limits) - 1
        return [*super().limit_values(own), LimitValues(number, np.arange(plants), corner_hz, least, excess_db, by)]

    def _with_more_gains(self, log_gains: Array) -> Array:
        log_k_i = log_gains[0] + math.log(2.0 * math.pi * GAIN_FACTOR * self.integral_hz)
        return np.vstack([log_gains, log_k_i])
