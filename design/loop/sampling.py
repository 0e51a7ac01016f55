"""A continuous plant as a computer sees it: a held command that comes late goes in, counted angles come out."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import scipy.linalg

from maxq.control.kernel.records import Array
from maxq.design.model.state_space import ComplexArray, Resolvent, StateSpace

_TERMS = 16  # of the series for a norm of a half: 2^-17 / 17! is 2e-20


@dataclass(frozen=True)
class SampledPlant:
    """Command u_k, which takes effect at k T + delay and is held -> mean of the plant's output over the last period.

        x_k+1    = phi x_k + late u_(k-m) + early u_(k-m-1)
        rate_k+1 = (psi x_k + rate_late u_(k-m) + rate_early u_(k-m-1)) / T,

    exactly: between samples the plant runs freely under constant commands. The delay is m whole periods and a rest;
    without a rest `early` and `rate_early` are zero. The mean rate over a period is the increment of the counted
    angle over T: integrate and dump, quantisation left out.
    """

    sample_s: float
    whole_periods: int
    rest_s: float
    states: tuple[str, ...]
    phi: Array  # (n, n)
    late: Array  # (n,)
    early: Array  # (n,)
    psi: Array  # (n,)
    rate_late: float
    rate_early: float

    @property
    def stored(self) -> int:
        """Commands that are on their way at a sample: u_(k-1) and before."""
        return self.whole_periods + (1 if self.rest_s > 0.0 else 0)

    def state_space(self) -> StateSpace:
        """In z: the plant's states, the commands on their way, and the mean rate as it is read."""
        n, m = len(self.states), self.stored
        a, b = np.zeros((n + m + 1, n + m + 1)), np.zeros((n + m + 1, 1))
        a[:n, :n], a[-1, :n] = self.phi, self.psi / self.sample_s
        for ago, x, rate in (
            (self.whole_periods, self.late, self.rate_late),
            (self.whole_periods + 1, self.early, self.rate_early),
        ):
            column = b[:, 0] if ago == 0 else a[:, n + ago - 1] if ago <= m else None
            if column is not None:
                column[:n] += x
                column[-1] += rate / self.sample_s
        if m > 0:
            b[n, 0] = 1.0
            a[n + 1 : n + m, n : n + m - 1] = np.eye(m - 1)
        states = (*self.states, *(f"command_{k + 1}_ago_rad" for k in range(m)), "mean_rate_radps")
        c = np.zeros((1, n + m + 1))
        c[0, -1] = 1.0
        return StateSpace(a, b, c, np.zeros((1, 1)), states, ("command_rad",), ("mean_rate_radps",))

    def resolvent(self) -> Resolvent:
        return Resolvent(self.phi, np.stack([self.late, self.early], axis=1), self.psi[None])

    def at(self, z: ComplexArray, resolvent: Resolvent) -> ComplexArray:
        """Transfer function at z."""
        way = resolvent(z)[..., 0, :] + np.array([self.rate_late, self.rate_early])
        late = 1.0 / z
        out = (way[..., 0] + way[..., 1] * late) * late / self.sample_s
        for _ in range(self.whole_periods):
            out = out * late
        return np.asarray(out)


def sample(plant: StateSpace, sample_s: float, delay_s: float) -> SampledPlant:
    """Sample a continuous system of one input and one output.

    Raises ValueError for a period that is not positive or a delay that is negative.
    """
    if not (sample_s > 0.0 and 0.0 <= delay_s < math.inf):
        raise ValueError(f"sample_s = {sample_s}, delay_s = {delay_s}: allowed are a period above 0, a delay from 0")
    n = len(plant.states)
    a, (scale, _) = scipy.linalg.matrix_balance(plant.a, permute=False, separate=True) if n else (plant.a, (1.0, None))
    b, c, through = plant.b[:, 0] / scale, plant.c[0] * scale, float(plant.d[0, 0])
    whole = int(delay_s / sample_s * (1.0 + 1e-12))
    rest = delay_s - whole * sample_s
    rest = 0.0 if rest < 1e-9 * sample_s else rest
    # x, integral of the output, constant command
    augmented = np.zeros((n + 2, n + 2))
    augmented[:n, :n], augmented[:n, n + 1], augmented[n, :n], augmented[n, n + 1] = a, b, c, through
    before, after = exponential(augmented * rest), exponential(augmented * (sample_s - rest))
    free = (after[:, : n + 1] @ before[: n + 1, : n + 1])[: n + 1]
    early = (after[:, : n + 1] @ before[: n + 1, n + 1])[: n + 1]
    late = after[: n + 1, n + 1]
    return SampledPlant(
        sample_s=sample_s,
        whole_periods=whole,
        rest_s=rest,
        states=plant.states,
        phi=np.asarray(free[:n, :n]),
        late=np.asarray(late[:n]),
        early=np.asarray(early[:n]),
        psi=np.asarray(free[n, :n]),
        rate_late=float(late[n]),
        rate_early=float(early[n]),
    )


def exponential(a: Array) -> Array:
    """exp(A) by scaling, Taylor series and squaring (Moler & Van Loan, SIAM Review 45(1), 2003, method 3).

    As exact as SciPy's for the small, balanced matrices here, of which a robust design takes thousands. SciPy's rouses
    the threads of the linear-algebra library for each, which then wait longer than they work.
    """
    halvings = max(0, math.ceil(math.log2(max(float(np.abs(a).sum(axis=0).max(initial=0.0)), 1e-300) / 0.5)))
    x = a / 2.0**halvings
    eye = np.eye(len(a))
    out = eye.copy()
    for k in range(_TERMS, 0, -1):
        out = eye + x @ out / k
    for _ in range(halvings):
        out = out @ out
    return out
