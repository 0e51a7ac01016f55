"""The bending filter (paper, eqs 37 to 41): state space, poles, and representation as a vector of variables.

Each quadratic section has the variables ln(zero_hz), zero_zeta, ln(pole_hz), pole_zeta. The first-order sections follow
with ln(zero_hz), ln(pole_hz) each. The gain ln|F(j inf)| is linear in these variables. A step of given size in a
frequency variable is the same relative change at every frequency, which suits a trust region.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from maxq.control.filter_schedule import FilterSchedule
from maxq.control.filters import BendingFilter, DiscreteFilter, FirstOrderSection, QuadraticSection
from maxq.control.kernel.records import Array
from maxq.control.laws.load_relief import lag_share
from maxq.design.model.state_space import ComplexArray, StateSpace, chain

FrequencyAndDamping = tuple[float, float]
AnyFilter = BendingFilter | DiscreteFilter | None
"""A continuous filter, a discrete filter at the flight computer's period, or None for a response of 1."""

QUADRATIC, FIRST_ORDER = 4, 2  # variables per section
TWO_PI = 2.0 * np.pi
SPAN = 2.0  # random frequencies are at most this factor squared above or below that of the first mode

FASTEST = 1e-6  # discrete poles with |z| below this value act as pure delays and are omitted


def check_period(filter_: AnyFilter, sample_s: float | None) -> None:
    """Check that a filter is valid for a loop with the period `sample_s`, or for a continuous loop if that is None.

    Raises ValueError for a continuous filter in a sampled loop, and for a discrete filter of another period.
    """
    if isinstance(filter_, BendingFilter) and sample_s is not None:
        raise ValueError("a sampled loop needs a discrete filter: BendingFilter.discretize makes one")
    if isinstance(filter_, DiscreteFilter) and (sample_s is None or abs(filter_.sample_s / sample_s - 1) > 1e-9):
        raise ValueError(f"filter of sample_s = {filter_.sample_s}: the loop's period is {sample_s}")


def filter_state_space(filter_: AnyFilter) -> StateSpace:
    """Return the state space of a filter from `law_rad` to `command_rad`, as a cascade of its sections.

    Discrete sections are in transposed direct form II, as in the flight computer.
    """
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
            # scales the states by the pole's frequency, for a well-conditioned matrix
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
    """Return the poles of a filter, rad/s. A pole z of a discrete filter is converted to log(z) / T."""
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


@dataclass(frozen=True)
class FilterVariables:
    """The layout of the vector of variables.

    `quadratic` sections of four variables precede `first_order` sections of two.
    """

    quadratic: int
    first_order: int

    @property
    def size(self) -> int:
        return QUADRATIC * self.quadratic + FIRST_ORDER * self.first_order

    @property
    def names(self) -> tuple[str, ...]:
        keys = ("zero_hz", "zero_zeta", "pole_hz", "pole_zeta")
        out = [f"quadratic[{i}].{key}" for i in range(self.quadratic) for key in keys]
        return (*out, *(f"first_order[{i}].{key}" for i in range(self.first_order) for key in ("zero_hz", "pole_hz")))

    def _coefficients(self, y: Array) -> tuple[Array, Array, Array]:
        """Return the coefficients n1 and n2 and the sign of every polynomial 1 + n1 s + n2 s^2, (..., polynomials).

        Quadratic sections come first. The sign is +1 for zeros and -1 for poles. `y` has the shape (..., size).
        """
        split, lead = QUADRATIC * self.quadratic, y.shape[:-1]
        q = y[..., :split].reshape(*lead, 2 * self.quadratic, 2)
        w = TWO_PI * np.exp(q[..., 0])
        v = TWO_PI * np.exp(y[..., split:])
        first = np.concatenate([2.0 * q[..., 1] / w, 1.0 / v], axis=-1)
        second = np.concatenate([w**-2.0, np.zeros(v.shape)], axis=-1)
        return first, second, self._sign

    @cached_property
    def _sign(self) -> Array:
        return np.array([1.0, -1.0] * (self.quadratic + self.first_order))

    def response(self, y: Array, s: ComplexArray) -> ComplexArray:
        """Return the response F, in the shape of `s` (rad/s).

        `y` has the shape (size,), or (points, size) for `s` of shape (points,).
        """
        first, second, sign = self._coefficients(y)
        above, below = np.ones_like(s), np.ones_like(s)
        for k, side in enumerate(sign):
            a, b = first[..., k], second[..., k]
            polynomial = 1.0 + s * (a + s * b) if k < 2 * self.quadratic else 1.0 + s * a
            if side > 0:
                above *= polynomial
            else:
                below *= polynomial
        return np.asarray(above / below)

    def slopes(self, y: Array, s: ComplexArray) -> tuple[ComplexArray, ComplexArray, ComplexArray]:
        """Return ln F and its first and second derivatives with respect to s, each (points,).

        ln F is the sum of the principal logarithms of the polynomials. `y` has the shape (size,), or (points, size) if
        each point has its own variables.
        """
        first, second, sign = self._coefficients(y)
        n = 1.0 + s[:, None] * (first + s[:, None] * second)
        d1 = (first + 2.0 * s[:, None] * second) / n
        d2 = 2.0 * second / n - d1 * d1
        return _complex(np.log(n) @ sign), _complex(d1 @ sign), _complex(d2 @ sign)

    def gradient(self, y: Array, s: ComplexArray) -> ComplexArray:
        """Return the gradient d ln F / d y, (points, size). `y` has the same shape as in `slopes`."""
        first, second, sign = self._coefficients(y)
        column = s[:, None]
        n = 1.0 + column * (first + column * second)
        linear, square = column * first / n, column * column * second / n
        out = np.empty((len(s), self.size), complex)
        k, split = 2 * self.quadratic, QUADRATIC * self.quadratic
        w = TWO_PI * np.exp(y[..., :split:2])
        out[:, :split:2] = -sign[:k] * (linear[:, :k] + 2.0 * square[:, :k])
        out[:, 1:split:2] = sign[:k] * (2.0 * column / w) / n[:, :k]
        out[:, split:] = -sign[k:] * linear[:, k:]
        return out

    def log_gain_at_infinity(self) -> Array:
        """Return the coefficients (size,) of ln|F(j inf)|, a linear function of the variables."""
        out = np.zeros(self.size)
        split = QUADRATIC * self.quadratic
        out[:split:QUADRATIC], out[2:split:QUADRATIC] = -2.0, 2.0
        out[split::FIRST_ORDER], out[split + 1 :: FIRST_ORDER] = -1.0, 1.0
        return out

    def filter(self, y: Array) -> BendingFilter:
        """Return the filter that these variables represent."""
        split = QUADRATIC * self.quadratic
        q, f = y[:split].reshape(-1, QUADRATIC), np.exp(y[split:].reshape(-1, FIRST_ORDER))
        return BendingFilter(
            tuple(QuadraticSection(float(np.exp(r[0])), float(r[1]), float(np.exp(r[2])), float(r[3])) for r in q),
            tuple(FirstOrderSection(float(r[0]), float(r[1])) for r in f),
        )

    def variables(self, filter_: BendingFilter) -> Array:
        """Return the variables of a filter, (size,).

        Raises ValueError if the numbers of sections differ from this layout, or if a first-order zero is not in the
        left half plane.
        """
        if (len(filter_.quadratic), len(filter_.first_order)) != (self.quadratic, self.first_order):
            raise ValueError(
                f"the filter has {len(filter_.quadratic)} quadratic and {len(filter_.first_order)} first-order "
                f"sections: allowed are {self.quadratic} and {self.first_order}"
            )
        parts = [[np.log(q.zero_hz), q.zero_zeta, np.log(q.pole_hz), q.pole_zeta] for q in filter_.quadratic]
        for i, f in enumerate(filter_.first_order):
            if f.zero_hz <= 0.0:
                raise ValueError(f"first_order[{i}].zero_hz = {f.zero_hz}: allowed is a number above 0")
            parts.append([np.log(f.zero_hz), np.log(f.pole_hz)])
        return np.array([value for part in parts for value in part])


@dataclass(frozen=True)
class FilterNodes:
    """The variables of a filter at each of `nodes` (m,), node by node in the order of `layout`.

    A single node gives a constant filter. Frequencies and damping ratios are linear between the nodes. `weights`
    (plants, m) are the interpolation weights of each plant.
    """

    layout: FilterVariables
    nodes: Array
    weights: Array
    unit: str = " s"

    @property
    def moves(self) -> bool:
        return len(self.nodes) > 1

    @property
    def size(self) -> int:
        return len(self.nodes) * self.layout.size

    @property
    def names(self) -> tuple[str, ...]:
        if not self.moves:
            return self.layout.names
        return tuple(f"{name} at {at:g}{self.unit}" for at in self.nodes for name in self.layout.names)

    @cached_property
    def _logarithmic(self) -> NDArray[np.bool_]:
        return np.array([name.endswith("_hz") for name in self.layout.names], bool)

    def at_nodes(self, y: Array) -> Array:
        """Return the variables of the filter at each node, (m, layout.size)."""
        return y.reshape(len(self.nodes), -1)

    def at_plants(self, y: Array) -> Array:
        """Return the variables of each plant's filter, (plants, layout.size)."""
        if not self.moves:
            return np.broadcast_to(y, (len(self.weights), len(y)))
        rows = self.at_nodes(y)
        value = self.weights @ np.where(self._logarithmic, np.exp(rows), rows)
        return np.where(self._logarithmic, np.log(np.where(self._logarithmic, value, 1.0)), value)

    def _shares(self, y: Array) -> Array:
        """Return the derivative of each plant's filter variables with respect to the same variable at each node.

        The shape is (plants, m, layout.size).
        """
        rows = self.at_nodes(y)
        part = self.weights[:, :, None] * np.where(self._logarithmic, np.exp(rows), 1.0)
        return np.where(self._logarithmic, part / part.sum(axis=1, keepdims=True), part)

    def gradients(self, y: Array) -> Array:
        """Return the derivative of each plant's filter variables with respect to `y`, (plants, layout.size, size)."""
        n, m = self.layout.size, len(self.nodes)
        out = np.zeros((len(self.weights), n, m, n))
        every = np.arange(n)
        out[:, every, :, every] = self._shares(y).transpose(2, 0, 1) if self.moves else 1.0
        return out.reshape(len(self.weights), n, m * n)

    def curvature(self, y: Array, slopes: Array) -> Array:
        """Return the weighted sum of the second derivatives of the filter variables by `y`, (size, size).

        The sum covers all plants. The weights are `slopes` (plants, layout.size). The second derivative of the
        logarithm of a weighted sum of exponentials is diag(share) - share share'.
        """
        n, m = self.layout.size, len(self.nodes)
        out = np.zeros((m, n, m, n))
        if self.moves:
            shares = self._shares(y)
            for k in np.flatnonzero(self._logarithmic):
                mine = shares[:, :, k]
                out[:, k, :, k] = np.diag(slopes[:, k] @ mine) - (mine.T * slopes[:, k]) @ mine
        return out.reshape(m * n, m * n)

    def schedule(self, y: Array) -> FilterSchedule:
        """Return the filter schedule that these variables represent."""
        return FilterSchedule(tuple(self.nodes.tolist()), tuple(map(self.layout.filter, self.at_nodes(y))))

    def variables_of(self, schedule: FilterSchedule, mode_hz: float) -> Array | None:
        """Return the variables of a filter schedule, or None if the schedule has more freedom than this layout.

        A filter with fewer sections is extended by cancelling pairs (`lifted`).
        """
        if schedule.moves and not (self.moves and np.isin(schedule.at, self.nodes).all()):
            return None
        each = [lifted(schedule(at), self.layout, mode_hz) for at in self.nodes]
        return np.concatenate([self.layout.variables(one) for one in each if one is not None]) if all(each) else None


def _complex(values: NDArray[Any]) -> ComplexArray:
    return np.asarray(values, np.complex128)


def laplace_axis(x: Array, sample_s: float | None, prewarp_hz: float | None) -> tuple[ComplexArray, ...]:
    """Return the Laplace variable s (rad/s) at x = ln f, and its first and second derivatives with respect to x.

    A filter discretised by the bilinear transform has the response of the continuous filter on a warped axis, s = j c
    tan(pi f T). The constant c makes s exact at `prewarp_hz`. Without a period or a prewarping frequency, s = 2 pi j f.
    """
    if sample_s is None or prewarp_hz is None:
        s = 2j * np.pi * np.exp(x)
        return s, s, s
    c = 2.0 * np.pi * prewarp_hz / math.tan(math.pi * prewarp_hz * sample_s)
    angle = np.pi * np.exp(x) * sample_s
    tangent = np.tan(angle)
    secant = 1.0 + tangent**2
    rise = c * secant * angle
    bend = rise * (1.0 + 2.0 * tangent * angle)
    return (1j * c * tangent).astype(complex), (1j * rise).astype(complex), (1j * bend).astype(complex)


@dataclass(frozen=True)
class Lag:
    """A first-order lag of a measurement, continuous or discretised exactly (control/laws/load_relief.py)."""

    corner_hz: float
    sample_s: float | None

    @property
    def share(self) -> float:
        """Return the coefficient g of the sampled lag, in y = (1 - g) y + g u."""
        assert self.sample_s is not None
        return lag_share(self.corner_hz, self.sample_s)

    def with_slopes(self, x: Array) -> tuple[ComplexArray, ComplexArray, ComplexArray]:
        """Return the response at x = ln f, and its first and second derivatives with respect to x."""
        s = 2j * np.pi * np.exp(x)
        if self.sample_s is None:
            a = 2.0 * math.pi * self.corner_hz
            return a / (s + a), -a * s / (s + a) ** 2, -a * s / (s + a) ** 2 + 2.0 * a * s**2 / (s + a) ** 3
        u = s * self.sample_s
        left = (1.0 - self.share) * np.exp(-u)
        gain, rest = self.share, 1.0 - left
        first = -gain * u * left / rest**2
        return np.asarray(gain / rest), first, first * (1.0 - u - 2.0 * u * left / rest)

    def change_with_slopes(self, x: Array) -> tuple[ComplexArray, ComplexArray, ComplexArray]:
        """Return the response of the lag and a differentiator in series, 1/s, and its first two derivatives.

        The derivatives are with respect to x = ln f. The differentiator is s, or (1 - 1/z) / T in a sampled loop.
        """
        (h, h1, h2), s = self.with_slopes(x), np.asarray(2j * np.pi * np.exp(x), np.complex128)
        parts: list[ComplexArray] = [s, s, s]
        if self.sample_s is not None:
            u, late = s * self.sample_s, np.exp(-s * self.sample_s)
            parts = [np.asarray(part / self.sample_s) for part in (1.0 - late, u * late, u * (1.0 - u) * late)]
        d, d1, d2 = parts
        return h * d, h1 * d + h * d1, h2 * d + 2.0 * h1 * d1 + h * d2

    def with_change(self, direct: float, change: float) -> StateSpace:
        """Return the state space of `direct` plus `change` times lag and differentiation in series.

        It maps a rate to the output of the law.
        """
        if self.sample_s is None:
            a = -self.pole_radps
            parts = np.array([[-a]]), np.array([[-a * a * change]]), np.eye(1), np.array([[direct + a * change]])
        else:
            kept, jump = 1.0 - self.share, change * self.share / self.sample_s
            parts = np.array([[kept]]), np.array([[-self.share * jump]]), np.eye(1), np.array([[direct + jump]])
        return StateSpace(*parts, ("lag_radps",), ("rate_radps",), ("law_rad",))

    @property
    def pole_radps(self) -> float:
        return -2.0 * math.pi * self.corner_hz

    def state_space(self) -> StateSpace:
        """Return the state space of the lag, with the filtered acceleration as its only state.

        The state of a sampled lag is the filtered value of the previous sample.
        """
        if self.sample_s is None:
            a = self.pole_radps
            parts = np.array([[a]]), np.array([[-a]]), np.eye(1), np.zeros((1, 1))
        else:
            kept = 1.0 - self.share
            parts = np.array([[kept]]), np.array([[self.share]]), np.array([[kept]]), np.array([[self.share]])
        return StateSpace(*parts, ("lag_mps2",), ("accel_mps2",), ("accel_mps2",))


def drawn_filters(layout: FilterVariables, mode_hz: float) -> Iterator[BendingFilter]:
    """Yield filters of a form typical of optimal ones, as starting points of a search.

    Each has notches at the first mode with poles below it, and leads or lags around it.
    """
    lead, lag, mild, roll_off = (0.5, 5.0), (0.3, 0.22), (4.0, 2.0), (1.2, 20.0)
    notch, shelf = (1.0, 0.1, 0.5, 0.3), (0.65, 0.7, 0.5, 0.3)
    shapes: tuple[tuple[tuple[tuple[float, ...], ...], tuple[tuple[float, float], ...]], ...] = (
        # zero, zeta, pole, zeta of the quadratic sections, zero, pole of the first-order ones; relative to the mode
        ((notch, notch), (lead, lag)),
        ((notch, shelf), (lead, mild)),
        ((notch, notch), (roll_off, lag)),
        (((1.0, 0.12, 0.45, 0.35), (0.95, 1.1, 2.0, 1.0)), (mild, mild)),
        (((1.0, 0.2, 0.65, 0.3), (2.5, 0.4, 2.0, 0.7)), (lead, lead)),
    )
    seen: set[tuple[object, ...]] = set()
    for quadratic, first_order in shapes:
        q = [*quadratic, *[(2.0 + k, 0.7, 2.0 + k, 0.7) for k in range(layout.quadratic)]][: layout.quadratic]
        f = [*first_order, *[(4.0 + k, 4.0 + k) for k in range(layout.first_order)]][: layout.first_order]
        if (*q, *f) not in seen:
            seen.add((*q, *f))
            yield BendingFilter(
                tuple(QuadraticSection(z * mode_hz, a, p * mode_hz, b) for z, a, p, b in q),
                tuple(FirstOrderSection(z * mode_hz, p * mode_hz) for z, p in f),
            )


def random_ranges(layout: FilterVariables, lower: Array, upper: Array, mode_hz: float) -> tuple[Array, Array]:
    """Return the ranges of random starting points, general and notch-like, as lower and upper ends (2, size) each.

    General starts use the bounds, with frequencies limited to a factor of `SPAN` squared above or below the first mode.
    Notch-like starts have a notch at the mode with poles below it as their first section, and leads, lags or notches at
    any frequency as the others. With gains linear in time, half of the notch-like starts and a tenth of the general
    starts reach the best optimum of F3 to F5.
    """
    low, high = lower.copy(), upper.copy()
    frequency = np.array([name.endswith("_hz") for name in layout.names], bool)
    centre, reach = math.log(mode_hz), 2.0 * math.log(SPAN)
    low[frequency] = np.clip(centre - reach, low[frequency], high[frequency])
    high[frequency] = np.clip(centre + reach, low[frequency], high[frequency])

    def ranges(
        zero: FrequencyAndDamping,
        zero_zeta: FrequencyAndDamping,
        pole: FrequencyAndDamping,
        pole_zeta: FrequencyAndDamping,
    ) -> list[FrequencyAndDamping]:
        hz = [tuple(math.log(x * mode_hz) for x in pair) for pair in (zero, pole)]
        return [(hz[0][0], hz[0][1]), zero_zeta, (hz[1][0], hz[1][1]), pole_zeta]

    notch = ranges((0.9, 1.1), (0.1, 0.3), (0.4, 0.8), (0.3, 0.6))
    other = ranges((0.5, 3.0), (0.1, 0.8), (0.35, 3.0), (0.3, 1.0))
    first_order = (math.log(0.2 * mode_hz), math.log(8.0 * mode_hz))
    sections = [*notch, *other * layout.quadratic][: QUADRATIC * layout.quadratic]
    likely = np.array([*sections, *[first_order, first_order] * layout.first_order]).reshape(-1, 2).T
    return np.array([low, high]), likely


def lifted(filter_: BendingFilter, layout: FilterVariables, mode_hz: float) -> BendingFilter | None:
    """Return a filter of `layout` with the same response, extended by cancelling pairs of poles and zeros.

    A surplus first-order section becomes a quadratic section with a cancelling pair. Returns None if the filter still
    does not fit the layout.
    """
    quadratic, first_order = list(filter_.quadratic), list(filter_.first_order)
    while len(first_order) > layout.first_order and len(quadratic) < layout.quadratic:
        f = first_order.pop()
        pair = math.sqrt(f.zero_hz * f.pole_hz)
        zero, pole = math.sqrt(f.zero_hz * pair), math.sqrt(f.pole_hz * pair)
        quadratic.append(QuadraticSection(zero, 0.5 * (f.zero_hz + pair) / zero, pole, 0.5 * (f.pole_hz + pair) / pole))
    while len(quadratic) < layout.quadratic:
        quadratic.append(QuadraticSection(2.0 * mode_hz, 0.7, 2.0 * mode_hz, 0.7))
    while len(first_order) < layout.first_order:
        first_order.append(FirstOrderSection(2.0 * mode_hz, 2.0 * mode_hz))
    if (len(quadratic), len(first_order)) != (layout.quadratic, layout.first_order):
        return None
    return BendingFilter(tuple(quadratic), tuple(first_order))
