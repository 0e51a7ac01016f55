"""The bending filter as a vector of variables, and ln F with its derivatives (paper, eqs 37 to 41).

Each quadratic section brings ln(zero_hz), zero_zeta, ln(pole_hz), pole_zeta, then each first-order section brings
ln(zero_hz), ln(pole_hz). In these ln|F(j inf)| is linear, and a trust region means the same everywhere.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from maxq.control.filters import BendingFilter, FirstOrderSection, QuadraticSection
from maxq.control.kernel.records import Array
from maxq.design.model.state_space import ComplexArray

QUADRATIC, FIRST_ORDER = 4, 2  # variables of a section
TWO_PI = 2.0 * np.pi


@dataclass(frozen=True)
class FilterVariables:
    """Layout of the vector: `quadratic` sections of four variables, then `first_order` of two."""

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
        """n1, n2 of every polynomial 1 + n1 s + n2 s^2, (..., polynomials), quadratics first, and their signs.

        The sign is +1 for zeros, -1 for poles. `y` (..., size).
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
        """F, same shape as `s`; `y` (size,)."""
        first, second, sign = self._coefficients(y)
        above, below = np.ones_like(s), np.ones_like(s)
        for a, b, side in zip(first, second, sign, strict=True):
            polynomial = 1.0 + s * (a + s * b) if b != 0.0 else 1.0 + s * a
            if side > 0:
                above *= polynomial
            else:
                below *= polynomial
        return np.asarray(above / below)

    def slopes(self, y: Array, s: ComplexArray) -> tuple[ComplexArray, ComplexArray, ComplexArray]:
        """ln F (principal sum), and its first and second derivative by s; each (points,).

        `y` (size,), or (points, size) where each point has variables of its own.
        """
        first, second, sign = self._coefficients(y)
        n = 1.0 + s[:, None] * (first + s[:, None] * second)
        d1 = (first + 2.0 * s[:, None] * second) / n
        d2 = 2.0 * second / n - d1 * d1
        return _complex(np.log(n) @ sign), _complex(d1 @ sign), _complex(d2 @ sign)

    def gradient(self, y: Array, s: ComplexArray) -> ComplexArray:
        """d ln F / d y (points, size); `y` as in `slopes`."""
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
        """Coefficients (size,) of ln|F(j inf)|, which is linear in the variables."""
        out = np.zeros(self.size)
        split = QUADRATIC * self.quadratic
        out[:split:QUADRATIC], out[2:split:QUADRATIC] = -2.0, 2.0
        out[split::FIRST_ORDER], out[split + 1 :: FIRST_ORDER] = -1.0, 1.0
        return out

    def filter(self, y: Array) -> BendingFilter:
        """The filter that these variables mean."""
        split = QUADRATIC * self.quadratic
        q, f = y[:split].reshape(-1, QUADRATIC), np.exp(y[split:].reshape(-1, FIRST_ORDER))
        return BendingFilter(
            tuple(QuadraticSection(float(np.exp(r[0])), float(r[1]), float(np.exp(r[2])), float(r[3])) for r in q),
            tuple(FirstOrderSection(float(r[0]), float(r[1])) for r in f),
        )

    def variables(self, filter_: BendingFilter) -> Array:
        """The vector of a filter with these numbers of sections and zeros in the left half plane."""
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


def _complex(values: NDArray[Any]) -> ComplexArray:
    return np.asarray(values, np.complex128)
