"""Provide loops small enough for margins in closed form, or by a second method."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import mpmath
import numpy as np
import scipy.linalg
from numpy.typing import ArrayLike

from maxq.control.kernel.records import Array


@dataclass(frozen=True)
class TransferLoop:
    """A loop numerator / denominator, in falling powers of s (of z with `sample_s`), times a pure delay.

    With a delay, the closed loop has infinitely many poles, and `rightmost` contains those to report. `exact` contains
    the roots of the denominator if they are more accurate than its coefficients.
    """

    numerator: Sequence[float]
    denominator: Sequence[float]
    sample_s: float | None = None
    delay_s: float = 0.0
    rightmost: Sequence[complex] = field(default=())
    exact: Sequence[complex] = field(default=())

    @property
    def highest_hz(self) -> float:
        return np.inf if self.sample_s is None else 0.5 / self.sample_s

    def response(self, frequencies_hz: ArrayLike) -> np.ndarray:
        s = 2j * np.pi * np.asarray(frequencies_hz, float)
        x = s if self.sample_s is None else np.exp(s * self.sample_s)
        below = np.polyval(self.denominator, x)
        if len(self.exact):
            from_one = s if self.sample_s is None else np.expm1(s * self.sample_s)
            at_one = 0.0 if self.sample_s is None else 1.0
            below = np.prod([from_one + (at_one - pole) for pole in self.exact], axis=0)
        return np.polyval(self.numerator, x) / below * np.exp(-s * self.delay_s)

    def open_poles(self) -> np.ndarray:
        return self._poles(self.exact if len(self.exact) else np.roots(self.denominator))

    def closed_poles(self) -> np.ndarray:
        if self.delay_s > 0.0:
            return np.asarray(self.rightmost, complex)
        return self._poles(np.roots(np.polyadd(self.numerator, self.denominator)))

    def _poles(self, x: ArrayLike) -> np.ndarray:
        values = np.asarray(x, complex)
        if self.sample_s is None:
            return values
        return np.log(values[values != 0.0]) / self.sample_s

    def factors(self) -> tuple[np.ndarray, np.ndarray] | None:
        poles = self.exact if len(self.exact) else np.roots(self.denominator)
        return None if self.delay_s > 0.0 else (np.roots(self.numerator).astype(complex), np.asarray(poles, complex))

    def scaled(self, gain: float) -> TransferLoop:
        return TransferLoop(np.asarray(self.numerator) * gain, self.denominator, self.sample_s, self.delay_s)


@dataclass(frozen=True)
class ModalLoop:
    """A sum of partial fractions, c^T (s - A)^-1 b with A of blocks one or two wide, exact at any damping ratio."""

    a: Array
    b: Array
    c: Array

    highest_hz = np.inf
    sample_s = None

    @classmethod
    def of(
        cls, real: Sequence[tuple[float, float]], pairs: Sequence[tuple[float, float, float, float]], gain: float = 1.0
    ) -> ModalLoop:
        """Return the loop of `real` (pole, residue) and `pairs` (omega, zeta, weights) in omega (r s + p omega).

        The weights r and p are those of rate and place.
        """
        n = len(real) + 2 * len(pairs)
        a, b, c = np.zeros((n, n)), np.zeros(n), np.zeros(n)
        for k, (pole, residue) in enumerate(real):
            a[k, k], b[k], c[k] = pole, 1.0, gain * residue
        for k, (omega, zeta, rate, place) in enumerate(pairs):
            i = len(real) + 2 * k
            a[i, i + 1], a[i + 1, i], a[i + 1, i + 1] = omega, -omega, -2.0 * zeta * omega
            b[i + 1], c[i], c[i + 1] = omega, gain * place, gain * rate
        return cls(a, b, c)

    def response(self, frequencies_hz: ArrayLike) -> np.ndarray:
        s = 2j * np.pi * np.asarray(frequencies_hz, float)
        out = np.zeros(s.shape, complex)
        i = 0
        while i < len(self.a):
            if i + 1 < len(self.a) and self.a[i, i + 1] != 0.0:
                w, d = self.a[i, i + 1], -self.a[i + 1, i + 1]
                out += self.b[i + 1] * (self.c[i] * w + self.c[i + 1] * s) / (w * w + s * (d + s))
                i += 2
            else:
                out += self.b[i] * self.c[i] / (s - self.a[i, i])
                i += 1
        return out

    def open_poles(self) -> np.ndarray:
        return np.linalg.eigvals(self.a).astype(complex)

    def closed_poles(self) -> np.ndarray:
        return self.poles_with(1.0)

    def factors(self) -> tuple[np.ndarray, np.ndarray]:
        n = len(self.a)
        left, right = np.zeros((n + 1, n + 1)), np.diag(np.append(np.ones(n), 0.0))
        left[:n, :n], left[:n, n], left[n, :n] = self.a, self.b, self.c
        zeros = scipy.linalg.eigvals(left, right)
        return zeros[np.isfinite(zeros)], self.open_poles()

    def poles_with(self, gain: float) -> np.ndarray:
        return np.linalg.eigvals(self.a - gain * np.outer(self.b, self.c)).astype(complex)

    def gain_crossings_hz(self) -> np.ndarray:
        """Return the eigenvalues / 2 pi j of the Hamiltonian; the real ones are frequencies of |L| = 1."""
        h = np.block([[self.a, np.outer(self.b, self.b)], [-np.outer(self.c, self.c), -self.a.T]])
        return np.linalg.eigvals(h) / (2j * np.pi)

    def real_crossings_hz(self) -> np.ndarray:
        """Return the zeros / 2 pi j of L(s) - L(-s); the real ones are frequencies of real L."""
        n = len(self.a)
        zero = np.zeros((n, n))
        a = np.block([[self.a, zero], [zero, -self.a]])
        b, c = np.append(self.b, self.b), np.append(self.c, self.c)
        left = np.block([[a, b[:, None]], [c[None], np.zeros((1, 1))]])
        right = np.zeros_like(left)
        right[: 2 * n, : 2 * n] = np.eye(2 * n)
        found = scipy.linalg.eigvals(left, right)
        return found[np.isfinite(found)] / (2j * np.pi)


@dataclass(frozen=True)
class ZpkLoop:
    """The loop gain times prod(x - zeros) / prod(x - poles), exact at any damping ratio.

    Zeros and poles are in rad/s; those of a sampled loop are mapped to z = exp(p T).
    """

    zeros: np.ndarray
    poles: np.ndarray
    gain: float = 1.0
    sample_s: float | None = None

    @property
    def highest_hz(self) -> float:
        return np.inf if self.sample_s is None else 0.5 / self.sample_s

    def _mapped(self, roots: np.ndarray) -> np.ndarray:
        return np.asarray(roots if self.sample_s is None else np.exp(roots * self.sample_s))

    def _from(self, s: np.ndarray, roots: np.ndarray) -> np.ndarray:
        away = s[..., None] - roots
        return away if self.sample_s is None else np.exp(roots * self.sample_s) * np.expm1(away * self.sample_s)

    def response(self, frequencies_hz: ArrayLike) -> np.ndarray:
        s = 2j * np.pi * np.asarray(frequencies_hz, float)
        return self.gain * self._from(s, self.zeros).prod(axis=-1) / self._from(s, self.poles).prod(axis=-1)

    def open_poles(self) -> np.ndarray:
        return self.poles

    def factors(self) -> tuple[np.ndarray, np.ndarray]:
        return self._mapped(self.zeros), self._mapped(self.poles)

    def closed_poles(self) -> np.ndarray:
        """Return the roots of the polynomial in 60-digit arithmetic."""
        with mpmath.workdps(60):
            t = self.sample_s
            zeros, poles = (
                [
                    mpmath.mpmathify(complex(x)) if t is None else mpmath.exp(mpmath.mpmathify(complex(x)) * t)
                    for x in roots
                ]
                for roots in (self.zeros, self.poles)
            )

            def polynomial(roots: list[mpmath.mpc]) -> list[mpmath.mpc]:
                out = [mpmath.mpf(1)]
                for root in roots:
                    out = [x - root * y for x, y in zip([*out, 0], [0, *out], strict=True)]
                return out

            below, above = polynomial(poles), polynomial(zeros)
            above = [mpmath.mpf(0)] * (len(below) - len(above)) + above
            sums = [mpmath.re(x + mpmath.mpf(self.gain) * y) for x, y in zip(below, above, strict=True)]
            found = mpmath.polyroots(sums, maxsteps=400, extraprec=400)
            return np.array([complex(x if t is None else mpmath.log(x) / t) for x in found])
