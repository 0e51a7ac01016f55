"""Tables that kernels interpolate: piecewise cubics of many columns over one shared set of breakpoints.

All tables of a flight are in one flat array, the *pool*: mass over time, coefficients over Mach number, wind over
altitude, gains over time. A `TableRef` in the parameter record gives the place of a table. In the pool a table is

    breaks[n_breaks]  then  coefficients[n_breaks - 1][4][n_columns],

and column c on interval k is  sum_p coefficients[k][p][c] * (x - breaks[k])**p. Linear and stepwise tables are cubics
with zero coefficients, so that kernels need only one kind of table.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from maxq.control.kernel.jit import entry, kernel
from maxq.control.kernel.records import Array, IntArray

Method = Literal["pchip", "linear", "step"]


@dataclass(frozen=True)
class TableRef:
    """The place of a table in the pool."""

    offset: int
    n_breaks: int
    n_columns: int


@dataclass(frozen=True)
class Cubics:
    """Piecewise cubics of several columns.

    `breaks` (n,) increases strictly. `coefficients` (n - 1, 4, columns) are in rising powers.
    """

    breaks: Array
    coefficients: Array

    @property
    def n_columns(self) -> int:
        return int(self.coefficients.shape[2])

    def __call__(self, x: float) -> Array:
        """Return all columns (columns,) at `x`; end values apply outside the breakpoints."""
        return np.asarray(self.at(x)[0])

    def at(self, xs: ArrayLike) -> Array:
        """Return all columns at each of `xs` (n,), in shape (n, columns)."""
        k, s = _located(self.breaks.tobytes(), np.atleast_1d(np.asarray(xs, float)).tobytes())
        c = self.coefficients[k]
        return np.asarray(c[:, 0] + s * (c[:, 1] + s * (c[:, 2] + s * c[:, 3])))

    def slope(self, x: float) -> Array:
        """Return the derivatives of all columns at `x`, which are zero outside the breakpoints."""
        if not self.breaks[0] <= x <= self.breaks[-1]:
            return np.zeros(self.coefficients.shape[2])
        (k,), s = _located(self.breaks.tobytes(), np.array([x], float).tobytes())
        _, c1, c2, c3 = self.coefficients[k]
        return np.asarray(c1 + s[0] * (2.0 * c2 + 3.0 * s[0] * c3))


@lru_cache(maxsize=128)  # a campaign changes the values of tables, and rarely their breakpoints
def _located(breaks: bytes, xs: bytes) -> tuple[IntArray, Array]:
    """Return the interval (n,) of each of `xs`, and its distance from the interval's start (n, 1), clamped."""
    b, x = np.frombuffer(breaks), np.frombuffer(xs)
    k = np.clip(np.searchsorted(b, x, side="right") - 1, 0, len(b) - 2)
    return k, (np.clip(x, b[0], b[-1]) - b[k])[:, None]


def fit(x: ArrayLike, columns: ArrayLike, method: Method = "pchip") -> Cubics:
    """Return piecewise cubics through `columns` (n, m) at `x` (n,).

    `pchip` is C1 and monotone between points (Fritsch & Carlson 1980), `linear` is C0, and `step` holds each value up
    to the next point. A single point gives a constant. Raises ValueError unless `x` increases strictly and all values
    are finite.
    """
    x = np.atleast_1d(np.asarray(x, float))
    y = np.asarray(columns, float).reshape(len(x), -1)
    return _fitted(x.tobytes(), y.tobytes(), y.shape[1], method)


@lru_cache(maxsize=128)  # a campaign packs the same tables thousands of times; they take about 2 MB
def _fitted(x_bytes: bytes, y_bytes: bytes, columns: int, method: Method) -> Cubics:
    """Return the cached result of `fit`. The arrays are read-only, because callers share them."""
    x = np.frombuffer(x_bytes)
    y = np.frombuffer(y_bytes).reshape(len(x), columns)
    if not (np.isfinite(x).all() and np.isfinite(y).all()):
        raise ValueError("a table must hold finite numbers only")
    if (np.diff(x) <= 0).any():
        raise ValueError("a table's first column must increase strictly")
    if len(x) == 1:
        x, y = np.array([x[0], x[0] + 1.0]), np.repeat(y, 2, axis=0)
    if method == "pchip" and len(x) > 2:
        c = hermite(x, y, monotone_slopes(x, y)).coefficients
    else:
        c = np.zeros((len(x) - 1, 4, columns))
        c[:, 0] = y[:-1]
        if method != "step":
            c[:, 1] = np.diff(y, axis=0) / np.diff(x)[:, None]
    x.flags.writeable = c.flags.writeable = False
    return Cubics(x, c)


def hermite(x: Array, y: Array, slopes: Array) -> Cubics:
    """Return piecewise cubics with values `y` and derivatives `slopes`, both (n, m), at strictly increasing `x` (n,).

    This function and `monotone_slopes` repeat SciPy's CubicHermiteSpline and PchipInterpolator in the same order of
    operations. Importing SciPy's classes takes longer than a flight (0.5 s, measured by python -X importtime).
    """
    h = np.diff(x)[:, None]
    secant = np.diff(y, axis=0) / h
    bend = (slopes[:-1] + slopes[1:] - 2.0 * secant) / h
    return Cubics(x, np.stack([y[:-1], slopes[:-1], (secant - slopes[:-1]) / h - bend, bend / h], axis=1))


def monotone_slopes(x: Array, y: Array) -> Array:
    """Return the derivatives (n, m) of `y` (n, m) at `x` (n,), n >= 3, for which the cubics do not overshoot.

    Source: Fritsch & Butland 1984.
    """
    slopes = np.empty(y.shape)
    _monotone_into(_shared(x), _shared(y), slopes)
    return slopes


def _shared(array: Array) -> Array:
    """Return a contiguous read-only view of an array, so that compiled functions receive one type only."""
    view = np.ascontiguousarray(array).view()
    view.flags.writeable = False
    return view


@entry
def _monotone_into(x: Array, y: Array, slopes: Array) -> None:
    last = len(x) - 1
    for j in range(y.shape[1]):
        h_0, secant_0 = x[1] - x[0], (y[1, j] - y[0, j]) / (x[1] - x[0])
        for i in range(1, last):
            h_1, secant_1 = x[i + 1] - x[i], (y[i + 1, j] - y[i, j]) / (x[i + 1] - x[i])
            if i == 1:
                slopes[0, j] = _end_slope(h_0, h_1, secant_0, secant_1)
            if i == last - 1:
                slopes[last, j] = _end_slope(h_1, h_0, secant_1, secant_0)
            slopes[i, j] = 0.0
            if _both_rise_or_fall(secant_0, secant_1):
                before, after = 2.0 * h_1 + h_0, h_1 + 2.0 * h_0
                slopes[i, j] = 1.0 / ((before / secant_0 + after / secant_1) / (before + after))
            h_0, secant_0 = h_1, secant_1


@kernel
def _end_slope(h_0: float, h_1: float, secant_0: float, secant_1: float) -> float:
    """Return the derivative at an end from three points, limited to prevent an overshoot.

    The points are counted inwards from the end.
    """
    slope = ((2.0 * h_0 + h_1) * secant_0 - h_0 * secant_1) / (h_0 + h_1)
    if not _both_rise_or_fall(slope, secant_0):
        return 0.0
    if not _both_rise_or_fall(secant_0, secant_1) and abs(slope) > 3.0 * abs(secant_0):
        return 3.0 * secant_0
    return slope


@kernel
def _both_rise_or_fall(a: float, b: float) -> bool:
    return (a > 0.0 and b > 0.0) or (a < 0.0 and b < 0.0)  # their product may underflow


def merge(tables: Sequence[Cubics]) -> Cubics:
    """Return one table with the columns of several, on the union of their breakpoints, without resampling.

    Outside its own breakpoints, a table keeps its end values.
    """
    breaks = union(*tables)
    coefficients = np.empty((len(breaks) - 1, 4, sum(table.n_columns for table in tables)))
    _merge_into(tables, breaks, coefficients)
    return Cubics(breaks, coefficients)


def _merge_into(tables: Sequence[Cubics], breaks: Array, out: Array) -> None:
    first = 0
    for table in tables:
        if len(table.breaks) == len(breaks):
            out[:, :, first : first + table.n_columns] = table.coefficients
        else:
            _carry(_shared(table.breaks), _shared(table.coefficients), breaks, out, first)
        first += table.n_columns


@entry
def _carry(breaks: Array, coefficients: Array, finer: Array, out: Array, first: int) -> None:
    """Write the coefficients of a table, re-centred on the `finer` breakpoints, into columns from `first` on.

    The finer breakpoints include those of the table.
    """
    k, last = 0, len(breaks) - 1
    for i in range(len(finer) - 1):
        x = finer[i]
        while k < last - 1 and breaks[k + 1] <= x:
            k += 1
        s = min(max(x, breaks[0]), breaks[last]) - breaks[k]
        inside = breaks[0] <= x < breaks[last]
        for j in range(coefficients.shape[2]):
            c0, c1, c2, c3 = coefficients[k, 0, j], coefficients[k, 1, j], coefficients[k, 2, j], coefficients[k, 3, j]
            steeper = s * 3 * c3
            out[i, 0, first + j] = c0 + s * (c1 + s * (c2 + s * c3))
            out[i, 1, first + j] = c1 + s * (2 * c2 + steeper) if inside else 0.0
            out[i, 2, first + j] = c2 + steeper if inside else 0.0
            out[i, 3, first + j] = c3 if inside else 0.0


def union(*tables: Cubics) -> Array:
    """Return the breakpoints of all tables in increasing order, read-only."""
    return _union(tuple(t.breaks.tobytes() for t in tables))


@lru_cache(maxsize=128)  # as `_located`
def _union(breaks: tuple[bytes, ...]) -> Array:
    out = np.unique(np.concatenate([np.frombuffer(b) for b in breaks]))
    out.flags.writeable = False
    return out


class Pool:
    """A collector of tables that packs them into the flat array for kernels."""

    def __init__(self) -> None:
        self._parts: list[tuple[slice, Array | tuple[Cubics, ...]]] = []  # with their places
        self._size = 0

    def add(self, *tables: Cubics) -> TableRef:
        """Add one table, or several merged into one, and return its place.

        Tables are merged when the pool is packed, because a merged schedule takes almost a megabyte.
        """
        breaks, columns = union(*tables), sum(table.n_columns for table in tables)
        offset = self.put(breaks)
        self._append(tables, 4 * (len(breaks) - 1) * columns)
        return TableRef(offset, len(breaks), columns)

    def _append(self, part: Array | tuple[Cubics, ...], size: int) -> None:
        self._parts.append((slice(self._size, self._size + size), part))
        self._size += size

    def put(self, *parts: Array) -> int:
        """Append arrays and return the offset of the first array."""
        offset = self._size
        for part in parts:
            self._append(part, part.size)
        return offset

    def array(self) -> Array:
        out = np.empty(self._size) if self._size > 0 else np.zeros(1)
        for where, part in self._parts:
            if isinstance(part, tuple):
                breaks = union(*part)
                _merge_into(part, breaks, out[where].reshape(len(breaks) - 1, 4, -1))
            else:
                out[where] = part.ravel()
        return out


NO_TABLE = TableRef(0, 0, 0)


def table_in(pool: Array, ref: TableRef) -> Cubics:
    """Return the table at `ref` as views of the pool."""
    n, columns, at = int(ref.n_breaks), int(ref.n_columns), int(ref.offset)
    coefficients = pool[at + n : at + n + 4 * columns * (n - 1)]
    return Cubics(pool[at : at + n], coefficients.reshape(n - 1, 4, columns))


@kernel
def find_interval(pool: Array, ref: TableRef, x: float) -> int:
    """Return the index k of the interval with breaks[k] <= x < breaks[k+1], clamped to the table."""
    low, high = 0, ref.n_breaks - 1
    while high - low > 1:
        middle = (low + high) >> 1
        if pool[ref.offset + middle] <= x:
            low = middle
        else:
            high = middle
    return low


@kernel
def interpolate_into(pool: Array, ref: TableRef, k: int, x: float, out: Array, at: int) -> None:
    """Write all columns at `x`, by the cubics of interval `k`, into `out[at:]`; end values apply outside the table."""
    first, last = pool[ref.offset], pool[ref.offset + ref.n_breaks - 1]
    s = min(max(x, first), last) - pool[ref.offset + k]
    n = ref.n_columns
    c = ref.offset + ref.n_breaks + 4 * n * k
    for j in range(n):
        i = c + j
        out[at + j] = pool[i] + s * (pool[i + n] + s * (pool[i + 2 * n] + s * pool[i + 3 * n]))


@kernel
def interpolate(pool: Array, ref: TableRef, k: int, x: float, column: int) -> float:
    """Return one column at `x`, by the cubic of interval `k`; end values apply outside the table."""
    first, last = pool[ref.offset], pool[ref.offset + ref.n_breaks - 1]
    s = min(max(x, first), last) - pool[ref.offset + k]
    n = ref.n_columns
    i = ref.offset + ref.n_breaks + 4 * n * k + column
    value: float = pool[i] + s * (pool[i + n] + s * (pool[i + 2 * n] + s * pool[i + 3 * n]))
    return value


@kernel
def look_up(pool: Array, ref: TableRef, x: float, column: int) -> float:
    """Return one column at `x`, after a search of the interval."""
    return interpolate(pool, ref, find_interval(pool, ref, x), x, column)
