"""Tables of up to three variables, in the same pool as the tables of one variable (tables.py).

The interpolation is multilinear or C1. Multilinear interpolation is usual for wind-tunnel databases, but its slope
jumps at every breakpoint. Hence a linear model at a breakpoint, such as a trim at zero angle of attack, is one-sided,
and a Runge-Kutta step across a breakpoint loses its order. The C1 interpolation uses Hermite polynomials in every
variable. Its slopes follow the monotone rule of the tables of one variable (Fritsch & Butland 1984), and its mixed
derivatives are second-order differences of these slopes. Outside the grid, each variable is clamped to its range.

In the pool a grid is  breaks_1, breaks_2, breaks_3  then  nodes[n_1][n_2][n_3][term][column].  The terms of a node are
its value alone (multilinear), or value, d/d1, d/d2, d2/d1d2, d/d3, ... (C1; bit i of the term: variable i).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Annotated, Literal

import numpy as np

from maxq.control.kernel.jit import kernel
from maxq.control.kernel.limits import MAX_SURFACES
from maxq.control.kernel.records import Array, IntArray
from maxq.control.kernel.tables import monotone_slopes

OFFSET, N_1, N_2, N_3, N_COLUMNS, N_TERMS = range(6)  # columns of a row of `GridRefs.at`
Extension = Literal["open", "mirror", "periodic"]
"""The extension of a variable beyond its ends: none, mirrored at zero and at pi, or periodic."""


@dataclass(frozen=True)
class GridRefs:
    """The places of grids in the pool."""

    at: Annotated[IntArray, (MAX_SURFACES, 6)]


@dataclass(frozen=True)
class Grid:
    """A table of values over up to three variables.

    `breaks`: breakpoints of the three variables, a single number for an unused variable. `nodes` (n_1, n_2, n_3, terms,
    columns): values and derivatives at the breakpoints.
    """

    breaks: tuple[Array, Array, Array]
    nodes: Array

    def __call__(self, x: Sequence[float], order: Sequence[int] = (0, 0, 0)) -> Array:
        """Return all columns at `x` (3,), differentiated `order` times (0 or 1) with respect to each variable."""
        weights, where = [], []
        for breaks, value, derivative in zip(self.breaks, x, order, strict=True):
            k, weight = self._weights(breaks, float(value), derivative)
            weights.append(weight)
            where.append(slice(k, k + 2))
        corners = self.nodes[tuple(where)]
        n_1, n_2, n_3, terms, columns = corners.shape
        total = np.zeros(columns)
        for i, j, m, term in np.ndindex(n_1, n_2, n_3, terms):
            share = (
                weights[0][i + 2 * (term & 1)] * weights[1][j + 2 * (term >> 1 & 1)] * weights[2][m + 2 * (term >> 2)]
            )
            total += share * corners[i, j, m, term]
        return total

    def _weights(self, breaks: Array, x: float, derivative: int) -> tuple[int, Array]:
        """Return the index of the interval, and the weights of the values (2) and slopes (2) at its ends."""
        if len(breaks) == 1:
            return 0, np.array([0.0 if derivative else 1.0, 0.0, 0.0, 0.0])
        k = int(np.clip(np.searchsorted(breaks, x, side="right") - 1, 0, len(breaks) - 2))
        h = breaks[k + 1] - breaks[k]
        t = (np.clip(x, breaks[0], breaks[-1]) - breaks[k]) / h
        if derivative and not breaks[0] <= x <= breaks[-1]:
            return k, np.zeros(4)
        if self.nodes.shape[3] == 1:
            return k, np.array([-1.0 / h, 1.0 / h, 0.0, 0.0] if derivative else [1.0 - t, t, 0.0, 0.0])
        if derivative:
            rise = 6.0 * t * (1.0 - t) / h
            return k, np.array([-rise, rise, 1.0 + t * (3.0 * t - 4.0), t * (3.0 * t - 2.0)])
        up = t * t * (3.0 - 2.0 * t)
        return k, np.array([1.0 - up, up, h * t * (1.0 - t) ** 2, -h * t * t * (1.0 - t)])


def fit_grid(
    breaks: Sequence[Array], values: Array, smooth: bool, extensions: Sequence[Extension], parity: Array
) -> Grid:
    """Return the grid with `values` (n_1, n_2, n_3, columns) at three strictly increasing arrays of breakpoints.

    `smooth` selects the C1 interpolation. `parity` (columns,) is 1 for a column that keeps its sign when a variable is
    mirrored, and -1 for a column that changes it.
    """
    terms = [values]
    for axis in range(3) if smooth else ():
        for known in list(terms):
            terms.append(_slopes(breaks[axis], known, axis, extensions[axis], parity, monotone=known is values))
    first, second, third = (np.asarray(b, float) for b in breaks)
    return Grid((first, second, third), np.stack(terms, axis=3))


def _slopes(x: Array, y: Array, axis: int, extension: Extension, parity: Array, *, monotone: bool) -> Array:
    """Return the derivative of `y` (n_1, n_2, n_3, columns) along an axis, in the same shape."""
    if len(x) == 1:
        return np.zeros_like(y)
    rows = np.moveaxis(y, axis, 0)
    none, turn = (x[:0], rows[:0]), 2.0 * np.pi
    before, after = none, none
    if extension == "periodic":
        before, after = (x[-2:-1] - turn, rows[-2:-1]), (x[1:2] + turn, rows[1:2])
    elif extension == "mirror":
        before = (-x[1:2], parity * rows[1:2]) if x[0] == 0.0 else none
        after = (turn - x[-2:-1], parity * rows[-2:-1]) if abs(x[-1] - np.pi) < 1e-12 else none
    longer, values = (np.concatenate([before[i], (x, rows)[i], after[i]]) for i in range(2))
    flat = values.reshape(len(longer), -1)
    if len(longer) == 2:
        found = np.repeat(np.diff(flat, axis=0) / np.diff(longer)[:, None], 2, axis=0)
    elif monotone:
        found = monotone_slopes(longer, flat)
    else:
        found = np.gradient(flat, longer, axis=0, edge_order=2)
    found = found.reshape(values.shape)[len(before[0]) : len(before[0]) + len(x)]
    return np.moveaxis(found, 0, axis)


def grid_in(pool: Array, ref: IntArray) -> Grid:
    """Return the grid described by `ref`, a row of `GridRefs.at`, as views of the pool."""
    offset, *points, columns, terms = (int(number) for number in ref)
    ends = np.cumsum([offset, *points])
    breaks = [pool[low:high] for low, high in pairwise(ends)]
    shape = (*points, terms, columns)
    return Grid((breaks[0], breaks[1], breaks[2]), pool[ends[-1] : ends[-1] + int(np.prod(shape))].reshape(shape))


Weights = tuple[float, float, float, float]


@kernel
def interpolate_grid(
    pool: Array, refs: GridRefs, which: int, x_1: float, x_2: float, x_3: float, out: Array, at: int
) -> None:
    """Write all columns of grid `which` at (x_1, x_2, x_3) into `out[at:]`."""
    ref = refs.at
    offset, n_1, n_2, n_3 = ref[which, OFFSET], ref[which, N_1], ref[which, N_2], ref[which, N_3]
    columns, terms = ref[which, N_COLUMNS], ref[which, N_TERMS]
    k_1, of_1 = _located(pool, offset, n_1, terms, x_1)
    k_2, of_2 = _located(pool, offset + n_1, n_2, terms, x_2)
    k_3, of_3 = _located(pool, offset + n_1 + n_2, n_3, terms, x_3)
    first = offset + n_1 + n_2 + n_3
    for c in range(columns):
        out[at + c] = 0.0
    corners = 8  # also the number of terms: unused variables come last
    if n_3 == 1:
        corners = 4 if n_2 > 1 else 2
    for corner in range(corners):
        i, j, m = corner & 1, (corner >> 1) & 1, corner >> 2
        for term in range(min(terms, corners)):
            weight = of_1[i + 2 * (term & 1)] * of_2[j + 2 * ((term >> 1) & 1)] * of_3[m + 2 * (term >> 2)]
            if weight != 0.0:
                node = (((k_1 + i) * n_2 + k_2 + j) * n_3 + k_3 + m) * terms + term
                for c in range(columns):
                    out[at + c] += weight * pool[first + node * columns + c]


@kernel
def _located(pool: Array, first: int, n: int, terms: int, x: float) -> tuple[int, Weights]:
    """Return the interval of `x`, and the weights of the values (2) and slopes (2) at its ends.

    With a single breakpoint, the weight of its value is 1 and all others are zero.
    """
    if n == 1:
        return 0, (1.0, 0.0, 0.0, 0.0)
    low, high = 0, n - 1
    while high - low > 1:
        middle = (low + high) >> 1
        if pool[first + middle] <= x:
            low = middle
        else:
            high = middle
    h = pool[first + low + 1] - pool[first + low]
    t = (min(max(x, pool[first]), pool[first + n - 1]) - pool[first + low]) / h
    if terms == 1:
        return low, (1.0 - t, t, 0.0, 0.0)
    up = t * t * (3.0 - 2.0 * t)
    return low, (1.0 - up, up, h * t * (1.0 - t) * (1.0 - t), -h * t * t * (1.0 - t))
