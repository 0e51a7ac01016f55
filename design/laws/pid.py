"""The linear model of the proportional-integral-derivative law: the PD law with a third gain (pd.py).

    C = F(z) (k_p, k_d, k_i)  on  (angle_rad, rate_radps, angle_integral_rads)

The integral is the sum over samples, T z / (z - 1), as the flight computer forms it while its limit is not reached.
`limits.integral_hz` is the lower bound of the integral's corner frequency, and `limits.most_integral_hz` the upper
bound. Without the upper bound, an optimum may have a much higher corner than required (ksr3-relaxed with F3: 0.4 to
1.5 Hz). Frequency and damping ratio of the rigid body (47, 48) are those of the law without its integral. They are
meaningful only if the corner frequency is far below that of the rigid body. Stability and margins are those of the
whole loop. The kernel of the law is control/laws/pid.py.
"""

from __future__ import annotations

import math

import numpy as np

from maxq.control.kernel.records import Array
from maxq.design.laws.law import MEASUREMENTS, LawLimit, LimitValues
from maxq.design.laws.pd_variables import GAIN_FACTOR, PdVariables
from maxq.design.laws.task import DB, Task


class PidVariables(PdVariables):
    """The variables (`law.LawVariables`) of PID.

    The PD variables are followed by ln k_i at the gain nodes.
    """

    inputs: tuple[str, ...] = MEASUREMENTS
    keys: tuple[str, ...] = ("k_p", "k_d_s", "k_i_ps")

    def __init__(self, task: Task, like: PdVariables | None = None, schedule: str | None = None) -> None:
        super().__init__(task, like, schedule)
        given = task.case.limits
        self.integral_hz = task.case.integral_hz(task.times_s)
        self.corners = [(self.integral_hz, 1.0)]  # bound in Hz, and 1 for a lower or -1 for an upper bound
        if given.most_integral_hz is not None:
            self.corners.append((given.most_integral_hz, -1.0))
        keys = ("integral_hz", "most_integral_hz")[: len(self.corners)]
        self.limits = (*self.limits, *(LawLimit.on(key, True) for key in keys))

    def limit_values(self, own: Array) -> list[LimitValues]:
        """Return the limit values of PD, and those of the integral's corner frequency k_i / (2 pi k_p)."""
        n, plants = self.filter.size, len(own)
        corner_hz = np.exp(own[:, n + 2] - own[:, n]) / (2.0 * math.pi)
        out, first = super().limit_values(own), len(self.limits) - len(self.corners)
        for number, (bound_hz, sign) in enumerate(self.corners, start=first):
            bound, by = np.full(plants, bound_hz), np.zeros((plants, self.own_size))
            by[:, n], by[:, n + 2] = sign * DB, -sign * DB
            excess_db = sign * DB * np.log(bound / corner_hz)
            out.append(LimitValues(number, np.arange(plants), corner_hz, bound, excess_db, by))
        return out

    def _with_more_gains(self, log_gains: Array) -> Array:
        log_k_i = log_gains[0] + math.log(2.0 * math.pi * GAIN_FACTOR * self.integral_hz)
        return np.vstack([log_gains, log_k_i])
