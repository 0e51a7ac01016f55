"""A continuous plant in discrete time: its inputs are delayed and held commands, and its outputs are counted angles."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import scipy.linalg

from maxq.control.kernel.records import Array
from maxq.design.model.state_space import ComplexArray, Resolvent, StateSpace

_TERMS = 16  # of the series, for a matrix with norm 0.5; the remainder is 2^-17 / 17! = 2e-20


@dataclass(frozen=True)
class SampledPlant:
    """The exact map from commands u_k to the means of the plant's outputs over the last period.

        x_k+1    = phi x_k + late u_(k-m) + early u_(k-m-1)
        rate_k+1 = (psi x_k + rate_late u_(k-m) + rate_early u_(k-m-1)) / T

    Commands take effect at k T + delay and are held. Between samples, the plant moves freely under constant commands.
    The delay consists of m whole periods and a remainder. Without a remainder, `early` and `rate_early` are zero. The
    mean rate over a period is the increment of the counted angle over T (integrate and dump, without quantisation).
    """

    sample_s: float
    whole_periods: int
    rest_s: float
    states: tuple[str, ...]
    phi: Array  # (n, n)
    late: Array  # (n, inputs)
    early: Array  # (n, inputs)
    psi: Array  # (outputs, n)
    rate_late: Array  # (outputs, inputs)
    rate_early: Array
    scale: Array  # (n,): powers of two; a state times its scale is that of the continuous plant

    def state_space(self) -> StateSpace:
        """Return the discrete state space.

        Its states are those of the plant, the pending commands and the mean rates.
        """
        (n, inputs), outputs = self.late.shape, len(self.psi)
        m = self.whole_periods + (
            1 if self.rest_s > 0.0 else 0
        )  # pending commands at a sample: u_(k-1) and earlier ones
        size = n + m * inputs + outputs
        a, b = np.zeros((size, size)), np.zeros((size, inputs))
        a[:n, :n], a[-outputs:, :n] = self.phi, self.psi / self.sample_s
        for ago, x, rate in (
            (self.whole_periods, self.late, self.rate_late),
            (self.whole_periods + 1, self.early, self.rate_early),
        ):
            columns = b if ago == 0 else a[:, n + (ago - 1) * inputs : n + ago * inputs] if ago <= m else None
            if columns is not None:
                columns[:n] += x
                columns[-outputs:] += rate / self.sample_s
        if m > 0:
            b[n : n + inputs] = np.eye(inputs)
            a[n + inputs : n + m * inputs, n : n + (m - 1) * inputs] = np.eye((m - 1) * inputs)
        commands, rates = (
            tuple(f"{what}{i}" for i in ("", *(f"_{k}" for k in range(2, count + 1))))
            for what, count in (("command_rad", inputs), ("mean_rate_radps", outputs))
        )
        on_their_way = (name.replace("_rad", f"_{k + 1}_ago_rad") for k in range(m) for name in commands)
        c, d = np.eye(size)[-outputs:], np.zeros((outputs, inputs))
        return StateSpace(a, b, c, d, (*self.states, *on_their_way, *rates), commands, rates)

    def resolvent(self) -> Resolvent:
        return Resolvent(self.phi, np.concatenate([self.late, self.early], axis=1), self.psi)

    def at(self, z: ComplexArray, resolvent: Resolvent) -> ComplexArray:
        """Return the transfer functions at z, (*z.shape, outputs, inputs). `resolvent` belongs to this plant."""
        way = resolvent(z) + np.concatenate([self.rate_late, self.rate_early], axis=1)
        late, inputs = (1.0 / z)[..., None, None], self.late.shape[1]
        out = (way[..., :inputs] + way[..., inputs:] * late) * late / self.sample_s
        for _ in range(self.whole_periods):
            out = out * late
        return np.asarray(out)


def sample(plant: StateSpace, sample_s: float, delay_s: float) -> SampledPlant:
    """Return the sampled form of a continuous system, with the period and the command delay in s.

    Raises ValueError for a period that is not positive, and for a delay that is negative or infinite.
    """
    if not (sample_s > 0.0 and 0.0 <= delay_s < math.inf):
        raise ValueError(f"sample_s = {sample_s}, delay_s = {delay_s}: allowed are a period above 0, a delay from 0")
    n, inputs, outputs = len(plant.states), len(plant.inputs), len(plant.outputs)
    a, (scale, _) = (
        scipy.linalg.matrix_balance(plant.a, permute=False, separate=True) if n else (plant.a, (np.ones(0), None))
    )
    whole = int(delay_s / sample_s * (1.0 + 1e-12))
    rest = delay_s - whole * sample_s
    rest = 0.0 if rest < 1e-9 * sample_s else rest
    # blocks: states, integrals of the outputs, constant commands
    k, size = n + outputs, n + outputs + inputs
    augmented = np.zeros((size, size))
    augmented[:n, :n], augmented[:n, k:] = a, (plant.b.T / scale).T
    augmented[n:k, :n], augmented[n:k, k:] = plant.c * scale, plant.d
    before, after = exponential(augmented * rest), exponential(augmented * (sample_s - rest))
    free, early, late = after[:k, :k] @ before[:k, :k], after[:k, :k] @ before[:k, k:], after[:k, k:]
    return SampledPlant(
        sample_s=sample_s,
        whole_periods=whole,
        rest_s=rest,
        states=plant.states,
        phi=np.asarray(free[:n, :n]),
        late=np.asarray(late[:n]),
        early=np.asarray(early[:n]),
        psi=np.asarray(free[n:, :n]),
        rate_late=np.asarray(late[n:]),
        rate_early=np.asarray(early[n:]),
        scale=np.asarray(scale, float),
    )


def exponential(a: Array) -> Array:
    """Return exp(A) by scaling, Taylor series and squaring (Moler & Van Loan, SIAM Review 45(1), 2003, method 3).

    For the small, balanced matrices of this module, the result is as accurate as that of SciPy. A robust design needs
    thousands of exponentials. SciPy starts the threads of the linear-algebra library for each matrix, which takes
    longer than the computation.
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
