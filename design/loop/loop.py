"""A loop: fixed path, gains and bending filter."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from maxq.control.filters import BendingFilter, DiscreteFilter
from maxq.control.kernel.records import Array
from maxq.design.loop.fixed_path import ExactFixedPath, FixedPath, PadeFixedPath
from maxq.design.model.state_space import ComplexArray, StateSpace, chain, closed

_FAST_ENOUGH = 1e-6  # |z| below it is a pole that a delay has left out, or as good as


@dataclass(frozen=True)
class Loop:
    """Open loop L = F (k_p integrator + k_d) fixed, closed on 1 + L = 0 (design/loop/open_loop.py).

    `filter` is continuous with a continuous path, discrete at the path's period with a sampled one; None is 1.
    Raises ValueError where they do not fit, or a gain is not finite.
    """

    fixed: FixedPath
    k_p: float
    k_d_s: float
    filter: BendingFilter | DiscreteFilter | None = None

    def __post_init__(self) -> None:
        if not (np.isfinite(self.k_p) and np.isfinite(self.k_d_s)):
            raise ValueError(f"k_p = {self.k_p}, k_d_s = {self.k_d_s}: allowed are finite numbers")
        period = self.fixed.sample_s
        if isinstance(self.filter, BendingFilter) and period is not None:
            raise ValueError("a sampled loop needs a discrete filter: BendingFilter.discretize makes one")
        if isinstance(self.filter, DiscreteFilter) and (
            period is None or abs(self.filter.sample_s / period - 1) > 1e-9
        ):
            raise ValueError(f"filter of sample_s = {self.filter.sample_s}: the loop's period is {period}")

    @property
    def highest_hz(self) -> float:
        return self.fixed.highest_hz

    @property
    def sample_s(self) -> float | None:
        """Period of a sampled loop, None for a continuous one."""
        return self.fixed.sample_s

    def response(self, frequencies_hz: ArrayLike) -> ComplexArray:
        """L, same shape as `frequencies_hz`, each above 0 and at most `highest_hz`."""
        f = np.asarray(frequencies_hz, float)
        return np.asarray(self.controller(f) * self.fixed.response(f))

    def controller(self, frequencies_hz: ArrayLike) -> ComplexArray:
        """F (k_p integrator + k_d), same shape."""
        f = np.asarray(frequencies_hz, float)
        law = self.k_p * self.fixed.integrator(f) + (self.k_d_s if self.fixed.takes_rate else 0.0)
        return np.asarray(law * self.filter_response(f))

    def filter_response(self, frequencies_hz: ArrayLike) -> ComplexArray:
        """F, same shape."""
        f = np.asarray(frequencies_hz, float)
        if self.filter is None:
            return np.ones(f.shape, np.complex128)
        return self.filter.frequency_response(2.0 * np.pi * f)

    def open_poles(self) -> ComplexArray:
        """Poles of L in rad/s, of a sampled loop log(z) / T."""
        parts = [self.fixed.poles(), _filter_poles(self.filter)]
        if self.k_p != 0.0 and not self.fixed.rests_at_dc:
            parts.append(np.zeros(1, np.complex128))
        return np.concatenate(parts)

    def closed_poles(self) -> ComplexArray:
        """Zeros of 1 + L in rad/s, of a sampled loop log(z) / T; from the state matrix.

        Those of the kind `exact`, which are infinitely many: from the Pade loop's, refined by Newton's method, up to
        twice the Nyquist frequency of the computer.
        """
        if isinstance(self.fixed, ExactFixedPath):
            return self._refined_poles(self.fixed)
        values = np.linalg.eigvals(closed(self.state_space())).astype(np.complex128)
        if self.sample_s is None:
            return values
        return np.asarray(np.log(values[np.abs(values) > _FAST_ENOUGH]) / self.sample_s)

    def state_space(self) -> StateSpace:
        """L, from the gimbal command round to minus itself; in z for a sampled loop. The kind `exact` has none."""
        return chain(self._with_law(self.fixed.state_space()), filter_state_space(self.filter))

    def _with_law(self, path: StateSpace) -> StateSpace:
        """(k_p integrator + k_d) times the path."""
        k_d = self.k_d_s if self.fixed.takes_rate else 0.0
        period = self.fixed.sample_s
        n = len(path.states)
        if period is None:
            rate_gain, drift, per_rate = k_d, path.a, path.c[0]
        else:  # the law sees the angle with this sample's increment in it
            rate_gain, drift, per_rate = k_d + self.k_p * period, path.a - np.eye(n), period * path.c[0]
        if self.k_p == 0.0:
            angle = StateSpace(path.a, path.b, rate_gain * path.c, path.d, path.states, path.inputs, ("law_rad",))
        elif self.fixed.rests_at_dc:
            # the angle is known from the path's states: `known` times their rate of change is the measured rate
            known = np.linalg.lstsq(drift.T, per_rate, rcond=None)[0]
            c = rate_gain * path.c + self.k_p * known
            angle = StateSpace(path.a, path.b, c, path.d, path.states, path.inputs, ("law_rad",))
        else:
            a, b = np.zeros((n + 1, n + 1)), np.zeros((n + 1, 1))
            a[:n, :n], a[n, :n], a[n, n] = path.a, per_rate, 0.0 if period is None else 1.0
            b[:n] = path.b
            c = np.append(rate_gain * path.c[0], self.k_p)[None]
            angle = StateSpace(a, b, c, path.d, (*path.states, "angle_rad"), path.inputs, ("law_rad",))
        return angle

    def to_state_space(self) -> Any:
        """L as a `control.StateSpace` of python-control, which must be installed; sampled loops with their dt.

        Raises ValueError for the kind `exact`.
        """
        import control  # noqa: PLC0415  # optional: nothing here needs it

        s = self.state_space()
        return control.StateSpace(s.a, s.b, s.c, s.d, self.sample_s or 0, states=list(s.states))

    def to_frd(self, frequencies_hz: ArrayLike) -> Any:
        """L at `frequencies_hz` as a `control.FRD` of python-control, which must be installed."""
        import control  # noqa: PLC0415  # optional: nothing here needs it

        f = np.atleast_1d(np.asarray(frequencies_hz, float))
        return control.FRD(self.response(f), 2.0 * np.pi * f, dt=self.sample_s or 0)

    def _refined_poles(self, exact: ExactFixedPath) -> ComplexArray:
        start = Loop(PadeFixedPath(exact.node, exact.cut), self.k_p, self.k_d_s, self.filter).closed_poles()
        s = start[np.abs(start) < 2.0 * np.pi / exact.node.instruments.sample_s]
        for _ in range(60):
            step = 1e-6 * (np.abs(s) + 1e-3)
            slope = (self._at(exact, s + step) - self._at(exact, s - step)) / (2.0 * step)
            move = (1.0 + self._at(exact, s)) / slope
            # no farther than a tenth at a time: neighbours must not be drawn to the same zero
            move *= np.minimum(1.0, 0.1 * (np.abs(s) + 1e-3) / np.maximum(np.abs(move), 1e-300))
            s = s - move
            if (np.abs(move) < 1e-12 * np.abs(s)).all():
                break
        s = s[np.abs(1.0 + self._at(exact, s)) < 1e-6]
        # a zero that two starts have found is one zero
        again = np.tril(np.abs(s[:, None] - s[None, :]) < 1e-7 * np.abs(s), -1).any(axis=1)
        return np.asarray(s[~again])

    def _at(self, exact: ExactFixedPath, s: ComplexArray) -> ComplexArray:
        law = self.k_p / s + (self.k_d_s if exact.takes_rate else 0.0)
        for n, d in () if not isinstance(self.filter, BendingFilter) else self.filter.polynomials():
            law = law * (n[0] + s * (n[1] + s * n[2])) / (d[0] + s * (d[1] + s * d[2]))
        return np.asarray(law * exact.at(s))


def filter_state_space(bending_filter: BendingFilter | DiscreteFilter | None) -> StateSpace:
    """The filter as a cascade of its sections; discrete ones in transposed direct form II, as they are flown."""
    one = StateSpace(
        np.zeros((0, 0)), np.zeros((0, 1)), np.zeros((1, 0)), np.ones((1, 1)), (), ("law_rad",), ("command_rad",)
    )
    if bending_filter is None:
        return one
    sections = []
    if isinstance(bending_filter, DiscreteFilter):
        for k, (b0, b1, b2, a1, a2) in enumerate(bending_filter.sections):
            a = np.array([[-a1, 1.0], [-a2, 0.0]])
            b = np.array([[b1 - a1 * b0], [b2 - a2 * b0]])
            sections.append(_section(a, b, np.array([[1.0, 0.0]]), b0, k))
    else:
        for k, (p, q) in enumerate(bending_filter.polynomials()):
            order = 2 if q[2] != 0.0 else 1
            through = p[order] / q[order]
            # states in units of the pole's period
            unit = abs(q[0] / q[order]) ** (1.0 / order)
            row = np.array([q[i] / q[order] * unit ** (i - order) for i in range(order)])
            top = np.array([p[i] / q[order] * unit ** (i - order) for i in range(order)])
            a = np.eye(order, k=1) * unit
            a[-1] = -row * unit
            b = np.eye(order)[:, -1:] * unit
            sections.append(_section(a, b, (top - through * row)[None], through, k))
    return chain(one, *sections)


def _section(a: Array, b: Array, c: Array, through: float, k: int) -> StateSpace:
    states = tuple(f"filter_{k + 1}_{i + 1}" for i in range(len(a)))
    return StateSpace(a, b, c, np.array([[through]]), states, ("law_rad",), ("command_rad",))


def _filter_poles(bending_filter: BendingFilter | DiscreteFilter | None) -> ComplexArray:
    if bending_filter is None:
        return np.zeros(0, np.complex128)
    found: list[complex] = []
    if isinstance(bending_filter, DiscreteFilter):
        for a1, a2 in bending_filter.sections[:, 3:]:
            roots = np.roots([1.0, a1, a2]).astype(np.complex128)
            found += list(np.log(roots[np.abs(roots) > _FAST_ENOUGH]) / bending_filter.sample_s)
    else:
        for _, q in bending_filter.polynomials():
            found += list(np.polynomial.polynomial.polyroots(np.trim_zeros(q, "b")).astype(np.complex128))
    return np.array(found, np.complex128)
