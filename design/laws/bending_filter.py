"""The bending filter (paper, eqs 37 to 41) as a linear system: state space and poles."""

from __future__ import annotations

import numpy as np

from maxq.control.filters import BendingFilter, DiscreteFilter
from maxq.control.kernel.records import Array
from maxq.design.model.state_space import ComplexArray, StateSpace, chain

AnyFilter = BendingFilter | DiscreteFilter | None
"""Continuous, discrete at the flight computer's period, or none: 1."""

FASTEST = 1e-6  # |z| below it is a pole that a delay has left out, or as good as


def check_period(filter_: AnyFilter, sample_s: float | None) -> None:
    """Raises ValueError for a continuous filter in a sampled loop, and for a discrete one of another period."""
    if isinstance(filter_, BendingFilter) and sample_s is not None:
        raise ValueError("a sampled loop needs a discrete filter: BendingFilter.discretize makes one")
    if isinstance(filter_, DiscreteFilter) and (sample_s is None or abs(filter_.sample_s / sample_s - 1) > 1e-9):
        raise ValueError(f"filter of sample_s = {filter_.sample_s}: the loop's period is {sample_s}")


def filter_state_space(filter_: AnyFilter) -> StateSpace:
    """The filter as a cascade of its sections; discrete ones in transposed direct form II, as they are flown."""
    one = StateSpace(
        np.zeros((0, 0)), np.zeros((0, 1)), np.zeros((1, 0)), np.ones((1, 1)), (), ("law_rad",), ("command_rad",)
    )
    if filter_ is None:
        return one
    sections = []
    if isinstance(filter_, DiscreteFilter):
        for k, (b0, b1, b2, a1, a2) in enumerate(filter_.sections):
            a = np.array([[-a1, 1.0], [-a2, 0.0]])
            b = np.array([[b1 - a1 * b0], [b2 - a2 * b0]])
            sections.append(_section(a, b, np.array([[1.0, 0.0]]), b0, k))
    else:
        for k, (p, q) in enumerate(filter_.polynomials()):
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


def filter_poles(filter_: AnyFilter) -> ComplexArray:
    """Poles in rad/s; those of a discrete filter as log(z) / T."""
    if filter_ is None:
        return np.zeros(0, np.complex128)
    found: list[complex] = []
    if isinstance(filter_, DiscreteFilter):
        for a1, a2 in filter_.sections[:, 3:]:
            roots = np.roots([1.0, a1, a2]).astype(np.complex128)
            found += list(np.log(roots[np.abs(roots) > FASTEST]) / filter_.sample_s)
    else:
        for _, q in filter_.polynomials():
            found += list(np.polynomial.polynomial.polyroots(np.trim_zeros(q, "b")).astype(np.complex128))
    return np.array(found, np.complex128)
