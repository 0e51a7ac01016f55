"""Unstable poles of the closed loop, counted twice: from their list, and by the argument principle from L alone."""

from __future__ import annotations

import numpy as np

from maxq.design.margins.crossings import PhaseCrossings
from maxq.design.margins.curve import ON_AXIS, Curve
from maxq.design.model.state_space import ComplexArray


def unstable(poles: ComplexArray, lowest_radps: float) -> ComplexArray:
    """Poles to the right of the axis, and on it. Those slower than `lowest_radps` are drift and left out."""
    size = np.abs(poles)
    return np.asarray(poles[(size > lowest_radps) & (poles.real >= -ON_AXIS * size)])


def encirclement_count(curve: Curve, crossings: PhaseCrossings) -> int:
    """Zeros of 1 + L in the right half plane (outside the unit circle), from the curve's turns about -1.

    Each solved crossing of the real axis beyond -1 moves the argument from one branch to the next, so the number is
    exact. The path goes up the axis from a quarter circle about s = 0 (z = 1), passes poles on the axis on their
    right, and ends at the real limit of L at infinity (z = -1):

        zeros = poles - turn of 1 + L over the upper half / pi.
    """
    poles = curve.open_poles
    size = np.abs(poles)
    right = (size > curve.lowest_radps) & (poles.real > ON_AXIS * size)
    distance = 1.0 + curve.loop
    beyond = (np.abs(crossings.loop) > 1.0) & (crossings.turn != 0)
    branches = int(crossings.turn[beyond].sum()) - _past_axis_poles(curve)
    # at Nyquist the sign of Im L is rounding: the last step is the short way to the real axis
    last = -2 if curve.finite_end else -1
    turn = _start(curve) + np.angle(distance[last]) - np.angle(distance[0]) + 2.0 * np.pi * branches
    end = np.angle(complex((1.0 + curve.loop[-1]).real))
    turn += _short(float(end - np.angle(distance[last])))
    return round(float(right.sum() - turn / np.pi))


def _start(curve: Curve) -> float:
    """Turn of 1 + L from the positive real axis to the first point, on a small quarter circle about the origin."""
    first = curve.loop[0]
    order = max(-curve.slope_at_zero, 0) if abs(first) > 1.0 else 0
    if order == 0:
        begin = float(np.angle(complex((1.0 + first).real)))
        return _short(float(np.angle(1.0 + first)) - begin)
    # L = K / s^n is real at the beginning, and large against 1
    begin = float(np.angle(complex((first * 1j**order).real)))
    arrived = begin - order * np.pi / 2.0
    return arrived - begin + _short(float(np.angle(1.0 + first)) - arrived)


def _past_axis_poles(curve: Curve) -> int:
    """How often the half circles to the right of poles on the axis cross from -pi to pi (clockwise)."""
    count = 0
    for k, order in curve.steps_past_poles():
        before, after = (float(np.angle(1.0 + curve.loop[j])) for j in (k, k + 1))
        clockwise = order * np.pi + _short(before - after - order * np.pi)
        count += round((clockwise - (before - after)) / (2.0 * np.pi))
    return count


def _short(angle: float) -> float:
    """The same angle in [-pi, pi)."""
    return float((angle + np.pi) % (2.0 * np.pi) - np.pi)
