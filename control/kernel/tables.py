"""Tables that kernels interpolate: piecewise cubics of many columns over one shared set of breakpoints.

Every table of a flight (mass over time, coefficients over Mach number, wind over altitude, gains over time) lies in
one flat array, the *pool*; a `TableRef` in the parameter record says where. In the pool a table is

    breaks[n_breaks]  then  coefficients[n_breaks - 1][4][n_columns],

and column c on interval k is  sum_p coefficients[k][p][c] * (x - breaks[k])**p. Linear and stepwise tables are
cubics with zero coefficients, so that kernels handle one kind of table only.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from maxq.control.kernel.jit import kernel
from maxq.control.kernel.records import Array, IntArray

Method = Literal["pchip", "linear", "step"]


@dataclass(frozen=True)
class TableRef:
    """Where a table lies in the pool."""

    offset: int
    n_breaks: int
    n_columns: int


@dataclass(frozen=True)
class Cubics:
    """Piecewise cubics: `breaks` (n,), strictly increasing; `coefficients` (n - 1, 4, columns), rising powers."""

    breaks: Array
    coefficients: Array

    @property
    def n_columns(self) -> int:
        return int(self.coefficients.shape[2])

    def __call__(self, x: float) -> Array:
        """All columns at `x`; outside the breakpoints the end values hold."""
        return np.asarray(self.at(x)[0])

    def at(self, xs: ArrayLike) -> Array:
        """Rows of all columns at each of `xs`."""
        k, s = _located(self.breaks.tobytes(), np.atleast_1d(np.asarray(xs, float)).tobytes())
        c = self.coefficients[k]
        return np.asarray(c[:, 0] + s * (c[:, 1] + s * (c[:, 2] + s * c[:, 3])))

    def slope(self, x: float) -> Array:
        """Derivatives of all columns at `x`; outside the breakpoints zero."""
        if not self.breaks[0] <= x <= self.breaks[-1]:
            return np.zeros(self.coefficients.shape[2])
        (k,), s = _located(self.breaks.tobytes(), np.array([x], float).tobytes())
        _, c1, c2, c3 = self.coefficients[k]
        return np.asarray(c1 + s[0] * (2.0 * c2 + 3.0 * s[0] * c3))


@lru_cache(maxsize=128)  # a campaign's tables change in value, and hardly ever in breakpoints
def _located(breaks: bytes, xs: bytes) -> tuple[IntArray, Array]:
    """Interval (n,) of each of `xs`, and how far into it they lie (n, 1); clamped to the table."""
    b, x = np.frombuffer(breaks), np.frombuffer(xs)
    k = np.clip(np.searchsorted(b, x, side="right") - 1, 0, len(b) - 2)
    return k, (np.clip(x, b[0], b[-1]) - b[k])[:, None]


def fit(x: ArrayLike, columns: ArrayLike, method: Method = "pchip") -> Cubics:
    """Piecewise cubics through `columns` (n, m) at `x` (n,).

    `pchip` is C1 and monotone between points (Fritsch & Carlson 1980), `linear` is C0, `step` holds each value up to
    the next point. One point gives a constant. Raises ValueError unless `x` rises strictly and all is finite.
    """
    x = np.atleast_1d(np.asarray(x, float))
    y = np.asarray(columns, float).reshape(len(x), -1)
    return _fitted(x.tobytes(), y.tobytes(), y.shape[1], method)


@lru_cache(maxsize=128)  # a campaign packs the same tables thousands of times: 2 MB or so for KSR-III
def _fitted(x_bytes: bytes, y_bytes: bytes, columns: int, method: Method) -> Cubics:
    """As `fit`; read-only, because it is shared."""
    x = np.frombuffer(x_bytes)
    y = np.frombuffer(y_bytes).reshape(len(x), columns)
    if not (np.isfinite(x).all() and np.isfinite(y).all()):
        raise ValueError("a table must hold finite numbers only")
    if (np.diff(x) <= 0).any():
        raise ValueError("a table's first column must rise strictly")
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
    """Piecewise cubics with values `y` and derivatives `slopes`, both (n, m), at `x` (n,), which rises strictly.

    This and `monotone_slopes` do what SciPy's CubicHermiteSpline and PchipInterpolator do, in the same order of
    operations: importing them takes longer than flying (0.5 s, measured by python -X importtime).
    """
    h = np.diff(x)[:, None]
    secant = np.diff(y, axis=0) / h
    bend = (slopes[:-1] + slopes[1:] - 2.0 * secant) / h
    return Cubics(x, np.stack([y[:-1], slopes[:-1], (secant - slopes[:-1]) / h - bend, bend / h], axis=1))


def monotone_slopes(x: Array, y: Array) -> Array:
    """Derivatives (n, m) at three points or more with which the cubics do not overshoot (Fritsch & Butland 1984)."""
    h = np.diff(x)[:, None]
    secant = np.diff(y, axis=0) / h
    turns = (np.sign(secant[1:]) != np.sign(secant[:-1])) | (secant[1:] == 0.0) | (secant[:-1] == 0.0)
    before, after = 2.0 * h[1:] + h[:-1], h[1:] + 2.0 * h[:-1]
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):  # where it turns or is flat: not used, or 0
        inside = 1.0 / ((before / secant[:-1] + after / secant[1:]) / (before + after))
    slopes = np.zeros_like(y)
    slopes[1:-1] = np.where(turns, 0.0, inside)
    slopes[0] = _end_slope(h[0], h[1], secant[0], secant[1])
    slopes[-1] = _end_slope(h[-1], h[-2], secant[-1], secant[-2])
    return slopes


def _end_slope(h_0: Array, h_1: Array, secant_0: Array, secant_1: Array) -> Array:
    """Derivative at an end from three points, changed where it would overshoot; counted inwards from the end."""
    slope = ((2.0 * h_0 + h_1) * secant_0 - h_0 * secant_1) / (h_0 + h_1)
    steep = (np.sign(secant_0) != np.sign(secant_1)) & (np.abs(slope) > 3.0 * np.abs(secant_0))
    return np.where(np.sign(slope) != np.sign(secant_0), 0.0, np.where(steep, 3.0 * secant_0, slope))


def merge(tables: Sequence[Cubics]) -> Cubics:
    """The columns of several tables side by side on the union of their breakpoints: exact, nothing is resampled.

    Outside its own breakpoints a table holds its end values.
    """
    breaks = union(*tables)
    groups: dict[bytes, dict[int, Cubics]] = {}  # tables on the same breakpoints are carried over together, each once
    for table in tables:
        groups.setdefault(table.breaks.tobytes(), {})[id(table)] = table
    place: dict[int, Array] = {}
    for group in groups.values():
        alike = list(group.values())
        joined = alike[0].coefficients
        if len(alike) > 1:
            joined = np.concatenate([table.coefficients for table in alike], axis=2)
        carried, at = _on(Cubics(alike[0].breaks, joined), breaks), 0
        for table in alike:
            place[id(table)] = carried[:, :, at : at + table.n_columns]
            at += table.n_columns
    return Cubics(breaks, np.concatenate([place[id(table)] for table in tables], axis=2))


def union(*tables: Cubics) -> Array:
    """Breakpoints of all tables, rising; read-only."""
    return _union(tuple(t.breaks.tobytes() for t in tables))


@lru_cache(maxsize=128)  # as `_located`
def _union(breaks: tuple[bytes, ...]) -> Array:
    out = np.unique(np.concatenate([np.frombuffer(b) for b in breaks]))
    out.flags.writeable = False
    return out


def _on(table: Cubics, breaks: Array) -> Array:
    """Coefficients of `table` re-centred on finer `breaks`."""
    if len(breaks) == len(table.breaks) and (breaks == table.breaks).all():
        return table.coefficients
    x = breaks[:-1]
    k, s = _located(table.breaks.tobytes(), x.tobytes())
    c = table.coefficients.take(k, axis=0)
    c[:, 0] += s * (c[:, 1] + s * (c[:, 2] + s * c[:, 3]))
    steeper = s * 3 * c[:, 3]
    c[:, 1] += s * (2 * c[:, 2] + steeper)
    c[:, 2] += steeper
    c[(x < table.breaks[0]) | (x >= table.breaks[-1]), 1:] = 0.0
    return c


class Pool:
    """Collects tables into the flat array that kernels read."""

    def __init__(self) -> None:
        self._parts: list[Array] = []
        self._size = 0

    def add(self, table: Cubics) -> TableRef:
        return TableRef(self.put(table.breaks, table.coefficients), len(table.breaks), table.n_columns)

    def put(self, *parts: Array) -> int:
        """Append arrays; returns where the first one begins."""
        offset = self._size
        for part in parts:
            self._parts.append(np.ascontiguousarray(part, dtype=float).ravel())
            self._size += part.size
        return offset

    def array(self) -> Array:
        return np.concatenate(self._parts) if self._parts else np.zeros(1)


NO_TABLE = TableRef(0, 0, 0)


def table_in(pool: Array, ref: TableRef) -> Cubics:
    """The table at `ref`: views of the pool."""
    n, columns, at = int(ref.n_breaks), int(ref.n_columns), int(ref.offset)
    coefficients = pool[at + n : at + n + 4 * columns * (n - 1)]
    return Cubics(pool[at : at + n], coefficients.reshape(n - 1, 4, columns))


@kernel
def find_interval(pool: Array, ref: TableRef, x: float) -> int:
    """Index k of the interval with breaks[k] <= x < breaks[k+1], clamped to the table."""
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
    """All columns at `x`, by the cubics of interval `k`, into `out[at:]`; end values hold outside the table."""
    first, last = pool[ref.offset], pool[ref.offset + ref.n_breaks - 1]
    s = min(max(x, first), last) - pool[ref.offset + k]
    n = ref.n_columns
    c = ref.offset + ref.n_breaks + 4 * n * k
    for j in range(n):
        i = c + j
        out[at + j] = pool[i] + s * (pool[i + n] + s * (pool[i + 2 * n] + s * pool[i + 3 * n]))


@kernel
def interpolate(pool: Array, ref: TableRef, k: int, x: float, column: int) -> float:
    """One column at `x`, by the cubic of interval `k`; end values hold outside the table."""
    first, last = pool[ref.offset], pool[ref.offset + ref.n_breaks - 1]
    s = min(max(x, first), last) - pool[ref.offset + k]
    n = ref.n_columns
    i = ref.offset + ref.n_breaks + 4 * n * k + column
    value: float = pool[i] + s * (pool[i + n] + s * (pool[i + 2 * n] + s * pool[i + 3 * n]))
    return value


@kernel
def look_up(pool: Array, ref: TableRef, x: float, column: int) -> float:
    """One column at `x`, searching the interval."""
    return interpolate(pool, ref, find_interval(pool, ref, x), x, column)
