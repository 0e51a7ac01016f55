"""The closed-loop poles of a loop over a factor on its gain (Evans, Trans. AIEE 67, 1948)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy  # its submodules are imported at first use

from maxq.control.kernel.records import Array
from maxq.design.laws.bending_filter import FASTEST
from maxq.design.loop.fixed_path import ExactFixedPath
from maxq.design.loop.loop import Loop
from maxq.design.model.state_space import ComplexArray

GAINS: Array = np.concatenate([[0.0], np.geomspace(0.05, 20.0, 53)])
"""The factors on the present gain in a root locus: 0 and -26 dB to 26 dB in steps of 1 dB."""


@dataclass(frozen=True)
class RootLocus:
    """The zeros of 1 + k L in rad/s over the factors k on the gain.

    A pole z of a sampled loop is converted to log(z) / T. Each column of `poles` (gains, poles) follows one branch; NaN
    denotes a pure delay (z = 0), and a pole that the kind `exact` does not follow at this gain.
    """

    gains: Array
    poles: ComplexArray
    open_poles: ComplexArray

    def at(self, gain: float) -> ComplexArray:
        """Return the poles at the factor of the locus that is nearest to `gain`, rad/s."""
        return np.asarray(self.poles[int(np.argmin(np.abs(self.gains - gain)))])


def root_locus(loop: Loop, gains: Sequence[float] | Array = GAINS) -> RootLocus:
    """Return the root locus of a loop. Raises ValueError for factors that are not finite or not 0 and above."""
    k = np.asarray(gains, float)
    if k.ndim != 1 or not len(k) or not np.isfinite(k).all() or (k < 0.0).any():
        raise ValueError(f"gains = {gains}: allowed is a list of finite numbers from 0")
    if isinstance(loop.fixed, ExactFixedPath):
        return RootLocus(k, _of_each(loop, k), loop.open_poles())
    s = loop.state_space()
    effective = k / (1.0 + k * float(s.d[0, 0]))
    values = np.linalg.eigvals(s.a - effective[:, None, None] * np.outer(s.b[:, 0], s.c[0])).astype(np.complex128)
    followed = _followed(values)
    if loop.sample_s is not None:
        with np.errstate(divide="ignore", invalid="ignore"):
            followed = np.where(np.abs(followed) > FASTEST, np.log(followed) / loop.sample_s, np.nan)
    return RootLocus(k, np.asarray(followed), loop.open_poles())


def _of_each(loop: Loop, gains: Array) -> ComplexArray:
    """Return the closed-loop poles at each gain, separately computed and then followed."""
    each = [loop.open_poles() if g == 0.0 else replace(loop, law=loop.law.scaled(g)).closed_poles() for g in gains]
    size = max(map(len, each))
    padded = np.full((len(each), size), np.nan + 0j, np.complex128)
    for row, found in zip(padded, each, strict=True):
        row[: len(found)] = found
    return _followed(padded)


def _followed(values: ComplexArray) -> ComplexArray:
    """Return the values (gains, poles) with each row reordered to follow the previous row."""
    out = values.copy()
    for n in range(1, len(out)):
        cost = np.abs(out[n - 1][:, None] - out[n][None, :])
        cost = np.where(np.isfinite(cost), cost / (1.0 + np.abs(np.nan_to_num(out[n - 1]))[:, None]), 1e3)
        _, order = scipy.optimize.linear_sum_assignment(cost)
        out[n] = out[n][order]
    return out
