"""What is made small or zero along the curve, as real functions of L."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from maxq.control.kernel.records import Array, IntArray
from maxq.design.loop.open_loop import OpenLoop
from maxq.design.margins.curve import sample
from maxq.design.margins.solving import Function
from maxq.design.model.state_space import ComplexArray

Objective = Callable[[ComplexArray], Array]

TINY = 1e-300  # instead of nothing, where a logarithm is taken
DB = 20.0 / np.log(10.0)  # dB per neper


def log_size(loop: ComplexArray) -> Array:
    """ln |L|."""
    return np.asarray(np.log(np.maximum(np.abs(loop), TINY)))


def minus_log_size(loop: ComplexArray) -> Array:
    return -log_size(loop)


def sine(loop: ComplexArray) -> Array:
    """Sine of L's phase: zero on the real axis."""
    return np.asarray(loop.imag / np.maximum(np.abs(loop), TINY))


def minus_sine(loop: ComplexArray) -> Array:
    return -sine(loop)


def sensitivity(loop: ComplexArray) -> Array:
    """ln of 1/|S| = |1 + L|."""
    return log_size(1.0 + loop)


def complementary(loop: ComplexArray) -> Array:
    """ln of 1/|T| = |1 + 1/L|."""
    return np.asarray(log_size(1.0 + loop) - log_size(loop))


def symmetric(loop: ComplexArray) -> Array:
    """ln of |1 + L| / |1 - L|."""
    return np.asarray(log_size(1.0 + loop) - log_size(1.0 - loop))


def from_minus_one_deg(loop: ComplexArray) -> Array:
    """Phase beyond the nearest -180 + 360 k degrees, in (-180, 180]."""
    return np.asarray(np.degrees(np.angle(-loop)))


def along(loop: OpenLoop, objectives: Sequence[Objective], kind: IntArray) -> Function:
    """For the solvers: problem i is about `objectives[kind[i]]`."""

    def function(frequency_hz: Array, which: IntArray) -> Array:
        values, kinds = sample(loop, frequency_hz), kind[which]
        out = np.empty(len(which))
        for k, objective in enumerate(objectives):
            chosen = kinds == k
            if chosen.any():
                out[chosen] = objective(values[chosen])
        return out

    return function
