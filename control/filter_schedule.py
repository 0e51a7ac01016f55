"""A bending filter that changes over the flight: its schedule, and the kernel that runs it.

The frequencies and damping ratios of each section are linear between the values of a schedule, so that all intermediate
filters are stable. The kernel computes the coefficients of each sample from these parameters.

A section is a state-variable filter: two trapezoidal integrators in a loop. With constant parameters, its response is
that of the bilinear filter (filters.py). With p the poles, z the zeros, g = w_p / c and r = w_p / w_z:

    e = u - 2 zeta_p x1 - x2,    x1 = integral of w_p e,    x2 = integral of w_p x1,    y = r^2 e + 2 zeta_z r x1 + x2

Two properties of this structure hold for any change of the parameters, in contrast to the direct forms:

- At a constant input, x1 = 0 and x2 = u for all parameters, so that a change does not alter the output.
- Without an input, x1^2 + x2^2 does not grow: a step is the Cayley transform of g A with A + A' <= 0, a contraction.

A first-order section has one such integrator. Source of the structure: Zavalishin, The Art of VA Filter Design, 2012,
chapters 3 and 4.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Annotated

import numpy as np

from maxq.control.filters import BendingFilter, Discretization, FirstOrderSection, QuadraticSection, bilinear_constant
from maxq.control.kernel.jit import kernel
from maxq.control.kernel.records import Array
from maxq.control.kernel.tables import NO_TABLE, Cubics, Pool, TableRef, find_interval, fit, interpolate_into
from maxq.control.structures import MAX_SECTIONS

QUADRATIC, FIRST_ORDER = 4, 2  # parameters of a section
SCHEDULED_METHODS: tuple[Discretization, ...] = ("prewarped", "bilinear")
"""The discretisation methods of a filter that changes; they need no exponentials in the kernel."""


@dataclass(frozen=True)
class FilterSchedule:
    """Filters of equal structure at increasing values `at` (n,) of a scheduling variable; a single filter is constant.

    The frequencies and damping ratios are linear between these values; the end values apply outside. Raises ValueError
    for filters of different structures, and for a first-order zero that changes its half plane.
    """

    at: tuple[float, ...]
    filters: tuple[BendingFilter, ...]

    def __post_init__(self) -> None:
        first = self.filters[0]
        for one in self.filters[1:]:
            if one.structure != first.structure:
                raise ValueError(f"sections {one.structure} after {first.structure}: allowed are equal numbers")
            for i, (a, b) in enumerate(zip(first.first_order, one.first_order, strict=True)):
                if (a.zero_hz > 0.0) != (b.zero_hz > 0.0):
                    raise ValueError(f"first_order[{i}].zero_hz = {b.zero_hz}: allowed is the sign of {a.zero_hz}")

    @staticmethod
    def constant(filter_: BendingFilter) -> FilterSchedule:
        return FilterSchedule((0.0,), (filter_,))

    @property
    def moves(self) -> bool:
        """Return True if the schedule has more than one filter."""
        return len(self.filters) > 1

    @property
    def structure(self) -> tuple[int, int]:
        """Return the numbers of quadratic and of first-order sections."""
        return self.filters[0].structure

    @cached_property
    def table(self) -> Cubics:
        """Return the parameters over the scheduling variable, in the order of `parameters_of`."""
        return fit(self.at, np.array([parameters_of(one) for one in self.filters]), "linear")

    def __call__(self, at: float) -> BendingFilter:
        """Return the filter at a value of the scheduling variable."""
        return filter_of(self.table(at), *self.structure) if self.moves else self.filters[0]

    def slope(self, at: float) -> Array:
        """Return the derivatives of the parameters with respect to the variable; right derivatives at breakpoints."""
        return self.table.slope(at) if self.moves else 0.0 * parameters_of(self.filters[0])


def parameters_of(filter_: BendingFilter) -> Array:
    """Return the parameters: zero_hz, zero_zeta, pole_hz, pole_zeta of quadratic sections, then zero_hz, pole_hz."""
    quadratic = [(q.zero_hz, q.zero_zeta, q.pole_hz, q.pole_zeta) for q in filter_.quadratic]
    first_order = [(f.zero_hz, f.pole_hz) for f in filter_.first_order]
    return np.array([value for section in (*quadratic, *first_order) for value in section], float)


def filter_of(parameters: Array, quadratic: int, first_order: int) -> BendingFilter:
    """Return the filter with these parameters, in the order of `parameters_of`, and these numbers of sections."""
    split = QUADRATIC * quadratic
    assert len(parameters) == split + FIRST_ORDER * first_order
    return BendingFilter(
        tuple(QuadraticSection(*row) for row in parameters[:split].reshape(-1, QUADRATIC).tolist()),
        tuple(FirstOrderSection(*row) for row in parameters[split:].reshape(-1, FIRST_ORDER).tolist()),
    )


@dataclass(frozen=True)
class MovingFilter:
    """The parameters of a filter that changes.

    `table`: physical parameters over the variable of the gain schedule (`FilterSchedule.table`); `NO_TABLE` if no
    filter changes. `g_per_hz`: 2 pi / c of the bilinear transform s = c (z - 1)/(z + 1).
    """

    table: TableRef = NO_TABLE
    n_quadratic: int = 0
    n_first_order: int = 0
    g_per_hz: float = 0.0


@dataclass
class MovingFilterState:
    """The state of a filter that changes: its parameters at this sample, and the integrators per gimbal axis."""

    parameters: Annotated[Array, (QUADRATIC * MAX_SECTIONS,)]
    memory: Annotated[Array, (2, MAX_SECTIONS, 2)]


def make_moving_filter(
    pool: Pool, schedule: FilterSchedule, sample_s: float, method: Discretization, prewarp_hz: float | None
) -> MovingFilter:
    """Return the parameters of a filter with at least two points, and add its table to `pool`.

    The other arguments are those of `BendingFilter.discretize`. Raises ValueError for a method outside
    `SCHEDULED_METHODS`, and as `BendingFilter.discretize` does.
    """
    if method not in SCHEDULED_METHODS:
        raise ValueError(f"discretization = {method!r} of a schedule: allowed is {', '.join(SCHEDULED_METHODS)}")
    for one in schedule.filters:
        one.discretize(sample_s, method, prewarp_hz)  # for its checks
    return MovingFilter(
        pool.add(schedule.table), *schedule.structure, 2.0 * math.pi / bilinear_constant(sample_s, method, prewarp_hz)
    )


@kernel
def start_moving_filter(state: MovingFilterState) -> None:
    for k in range(QUADRATIC * MAX_SECTIONS):
        state.parameters[k] = 1.0
    for gimbal in range(2):
        for k in range(MAX_SECTIONS):
            state.memory[gimbal, k, 0], state.memory[gimbal, k, 1] = 0.0, 0.0


@kernel
def move_filter(moving: MovingFilter, pool: Array, state: MovingFilterState, at: float) -> None:
    """Set the parameters to those at `at`, the variable of the gain schedule."""
    table = moving.table
    interpolate_into(pool, table, find_interval(pool, table, at), at, state.parameters, 0)


@kernel
def quadratic_sample(p: Array, at: int, g_per_hz: float, memory: Array, value: float) -> float:
    """Return the output of a quadratic section with the parameters `p[at:]` for the next input."""
    g, r = p[at + 2] * g_per_hz, p[at + 2] / p[at]
    damping = 2.0 * p[at + 3]
    x1 = (memory[0] + g * (value - memory[1])) / (1.0 + g * (damping + g))
    x2 = memory[1] + g * x1
    e = value - damping * x1 - x2
    memory[0], memory[1] = 2.0 * x1 - memory[0], 2.0 * x2 - memory[1]
    out: float = r * r * e + 2.0 * p[at + 1] * r * x1 + x2
    return out


@kernel
def first_order_sample(p: Array, at: int, g_per_hz: float, memory: Array, value: float) -> float:
    """Return the output of a first-order section with the parameters `p[at:]` for the next input."""
    g, r = p[at + 1] * g_per_hz, p[at + 1] / p[at]
    x = memory[0] + g * (value - memory[0]) / (1.0 + g)
    memory[0] = 2.0 * x - memory[0]
    out: float = x + r * (value - x)
    return out


@kernel
def moving_sample(moving: MovingFilter, state: MovingFilterState, gimbal: int, value: float) -> float:
    """Return the output of an axis's cascade for the next input, with the parameters set by `move_filter`."""
    n, memory = moving.n_quadratic, state.memory[gimbal]
    for i in range(n):
        value = quadratic_sample(state.parameters, QUADRATIC * i, moving.g_per_hz, memory[i], value)
    for i in range(moving.n_first_order):
        at = QUADRATIC * n + FIRST_ORDER * i
        value = first_order_sample(state.parameters, at, moving.g_per_hz, memory[n + i], value)
    return value


@kernel
def settle_moving(moving: MovingFilter, state: MovingFilterState, gimbal: int, value: float) -> None:
    """Set the integrators of an axis to the steady state at the constant input `value`, for any parameters."""
    memory = state.memory[gimbal]
    for i in range(moving.n_quadratic):
        memory[i, 0], memory[i, 1] = 0.0, value
    for i in range(moving.n_quadratic, moving.n_quadratic + moving.n_first_order):
        memory[i, 0], memory[i, 1] = value, 0.0


@kernel
def freeze_moving(moving: MovingFilter, state: MovingFilterState, gimbal: int, sections: Array, memory: Array) -> None:
    """Write the filter with its present parameters as biquads, and its state as their memory (`filter_sample`).

    `sections` (>= n, 5), `memory` (>= n, 2). The integrators of the filter are overwritten. A biquad in transposed
    direct form II has the same output for every input if its first two outputs y0, y1 without input are equal. Its
    memory is then y0 and y1 + a1 y0.
    """
    p, g_per_hz, n = state.parameters, moving.g_per_hz, moving.n_quadratic
    for i in range(n + moving.n_first_order):
        own, row = state.memory[gimbal][i], sections[i]
        if i < n:
            at = QUADRATIC * i
            g, r = p[at + 2] * g_per_hz, p[at + 2] / p[at]
            zero, pole = 2.0 * p[at + 1] * r * g, 2.0 * p[at + 3] * g
            a0 = 1.0 + pole + g * g
            row[0], row[1], row[2] = (
                (r * r + zero + g * g) / a0,
                2.0 * (g * g - r * r) / a0,
                (r * r - zero + g * g) / a0,
            )
            row[3], row[4] = 2.0 * (g * g - 1.0) / a0, (1.0 - pole + g * g) / a0
            y0 = quadratic_sample(p, at, g_per_hz, own, 0.0)
            y1 = quadratic_sample(p, at, g_per_hz, own, 0.0)
        else:
            at = QUADRATIC * n + FIRST_ORDER * (i - n)
            g, r = p[at + 1] * g_per_hz, p[at + 1] / p[at]
            row[0], row[1], row[2] = (g + r) / (1.0 + g), (g - r) / (1.0 + g), 0.0
            row[3], row[4] = (g - 1.0) / (1.0 + g), 0.0
            y0 = first_order_sample(p, at, g_per_hz, own, 0.0)
            y1 = first_order_sample(p, at, g_per_hz, own, 0.0)
        memory[i, 0], memory[i, 1] = y0, y1 + row[3] * y0
