"""Crossings of the unit circle and of the negative real axis, all solved for, and the encirclements of -1 they count.

Unstable poles of the closed loop are counted twice: from their list, and by the argument principle from L alone.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from maxq.control.kernel.records import Array, IntArray
from maxq.design.margins.curve import ON_AXIS, Curve
from maxq.design.margins.solving import DB, along, from_minus_one_deg, log_size, roots, sample, sine, wrapped
from maxq.design.model.state_space import ComplexArray

FARTHEST = 1e9  # a sign change of Im L where |L| is beyond this, or below its inverse, is a pole or zero on the axis
REAL = 1e-6  # |Im L| / |L| below which the end of the curve is real


@dataclass(frozen=True)
class GainCrossings:
    """|L| = 1, in rising order of frequency, (n,) each."""

    frequency_hz: Array
    loop: ComplexArray
    rising: NDArray[np.bool_]  # |L| grows with frequency

    @property
    def phase_margin_deg(self) -> Array:
        """In (-180, 180]: above 0 the lag that reaches -1, below 0 (its size) the lead that does so sooner."""
        return from_minus_one_deg(self.loop)

    @property
    def lag_deg(self) -> Array:
        """Lag in [0, 360) that turns the point on to -1."""
        return np.asarray(np.mod(self.phase_margin_deg, 360.0))

    @property
    def delay_s(self) -> Array:
        """Delay that does."""
        return np.asarray(self.lag_deg / (360.0 * self.frequency_hz))


@dataclass(frozen=True)
class PhaseCrossings:
    """L on the negative real axis, (n,) each; frequency 0 and infinity are limits, the highest one Nyquist.

    `turn` is +1 where the curve crosses from above to below (anticlockwise about the origin), -1 the other way, 0
    at the ends, which it only reaches.
    """

    frequency_hz: Array
    loop: ComplexArray
    turn: IntArray

    @property
    def gain_margin_db(self) -> Array:
        """Above 0 the increase of gain that reaches -1, below 0 (its size) the decrease that does."""
        return np.asarray(-DB * log_size(self.loop))


def find_crossings(curve: Curve) -> tuple[GainCrossings, PhaseCrossings, Curve]:
    """All of them, and the curve with them added."""
    f, loop = curve.frequency_hz, curve.loop
    size, angle = log_size(loop), sine(loop)
    gain = np.flatnonzero((size[1:] >= 0.0) != (size[:-1] >= 0.0))
    change = (angle[1:] >= 0.0) != (angle[:-1] >= 0.0)
    if curve.finite_end and abs(angle[-1]) < REAL:  # at Nyquist the sign of Im L is rounding
        change[-1] = False
    for step, _ in curve.steps_past_poles():
        change[step] = False
    phase = np.flatnonzero(change & ((loop.real[1:] < 0.0) | (loop.real[:-1] < 0.0)))
    k = np.concatenate([gain, phase])
    kind = np.concatenate([np.zeros(len(gain), int), np.ones(len(phase), int)])
    ends = np.stack([np.where(kind == 0, size[k + j], angle[k + j]) for j in (0, 1)])
    found = roots(along(curve.source, (log_size, sine), kind), f[k], f[k + 1], ends[0], ends[1])
    values = sample(curve.source, found)
    at_gain, at_phase = _gain(found, values, kind, size[k + 1] >= 0.0), _phase(found, values, kind, angle[k] >= 0.0)
    return at_gain, _with_ends(at_phase, curve), curve.with_points(found, values)


def _gain(f: Array, loop: ComplexArray, kind: IntArray, rising: NDArray[np.bool_]) -> GainCrossings:
    chosen = kind == 0
    return GainCrossings(f[chosen], loop[chosen], rising[chosen])


def _phase(f: Array, loop: ComplexArray, kind: IntArray, from_above: NDArray[np.bool_]) -> PhaseCrossings:
    size = np.abs(loop)
    chosen = (kind == 1) & (loop.real < 0.0) & (size > 1.0 / FARTHEST) & (size < FARTHEST)
    return PhaseCrossings(f[chosen], loop[chosen], np.where(from_above[chosen], 1, -1))


def _with_ends(inner: PhaseCrossings, curve: Curve) -> PhaseCrossings:
    """The limits at zero frequency and at the end are real: they count where they are negative."""
    f, loop, turn = inner.frequency_hz, inner.loop, inner.turn
    first, last = curve.loop[0], curve.loop[-1]
    if curve.slope_at_zero == 0 and curve.at_zero < 0.0 and abs(first.imag) < 0.1 * abs(first):
        f, loop, turn = np.append(0.0, f), np.append(curve.at_zero + 0j, loop), np.append(0, turn)
    real = REAL if curve.finite_end else 0.1
    if curve.slope_at_end == 0 and last.real < 0.0 and abs(last.imag) < real * abs(last):
        end = curve.frequency_hz[-1] if curve.finite_end else np.inf
        f, loop, turn = np.append(f, end), np.append(loop, last.real + 0j), np.append(turn, 0)
    return PhaseCrossings(f, loop, turn.astype(np.int64))


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
    turn += wrapped(float(end - np.angle(distance[last])), np.pi)
    return round(float(right.sum() - turn / np.pi))


def _start(curve: Curve) -> float:
    """Turn of 1 + L from the positive real axis to the first point, on a small quarter circle about the origin."""
    first = curve.loop[0]
    order = max(-curve.slope_at_zero, 0) if abs(first) > 1.0 else 0
    if order == 0:
        begin = float(np.angle(complex((1.0 + first).real)))
        return wrapped(float(np.angle(1.0 + first)) - begin, np.pi)
    # L = K / s^n is real at the beginning, and large against 1
    begin = float(np.angle(complex((first * 1j**order).real)))
    arrived = begin - order * np.pi / 2.0
    return arrived - begin + wrapped(float(np.angle(1.0 + first)) - arrived, np.pi)


def _past_axis_poles(curve: Curve) -> int:
    """How often the half circles to the right of poles on the axis cross from -pi to pi (clockwise)."""
    count = 0
    for k, order in curve.steps_past_poles():
        before, after = (float(np.angle(1.0 + curve.loop[j])) for j in (k, k + 1))
        clockwise = order * np.pi + wrapped(before - after - order * np.pi, np.pi)
        count += round((clockwise - (before - after)) / (2.0 * np.pi))
    return count
