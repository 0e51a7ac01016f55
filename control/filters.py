"""Bending filters: continuous form, discretisation, and the kernel that computes one sample.

A filter is a product of quadratic sections (s²/ω_z² + 2 ζ_z s/ω_z + 1)/(s²/ω_p² + 2 ζ_p s/ω_p + 1) and first-order
sections (s/z + 1)/(s/p + 1). It has one of the structures F2 to F6 of Lee, Ahn & Roh, eqs 37-41, or any numbers of
sections, at most `MAX_SECTIONS` in total. Every filter has unit DC gain, and every discretisation preserves it.

The flight computer runs the discrete filter as a cascade of biquads in transposed direct form II.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from maxq.control.kernel.jit import kernel
from maxq.control.kernel.records import Array
from maxq.control.structures import MAX_SECTIONS

Discretization = Literal["prewarped", "bilinear", "matched", "zoh"]
ComplexArray = NDArray[np.complex128]


@dataclass(frozen=True)
class QuadraticSection:
    """The section (s²/ω_z² + 2 ζ_z s/ω_z + 1)/(s²/ω_p² + 2 ζ_p s/ω_p + 1) with ω = 2π times the frequency in Hz.

    The poles must be stable. The zeros may be in either half plane (`zero_zeta` of any sign).
    """

    zero_hz: float
    zero_zeta: float
    pole_hz: float
    pole_zeta: float

    def polynomials(self) -> Array:
        """Return [[1, n1, n2], [1, d1, d2]]: numerator and denominator in rising powers of s."""
        w_z, w_p = 2 * math.pi * self.zero_hz, 2 * math.pi * self.pole_hz
        return np.array([[1.0, 2 * self.zero_zeta / w_z, w_z**-2], [1.0, 2 * self.pole_zeta / w_p, w_p**-2]])


@dataclass(frozen=True)
class FirstOrderSection:
    """The section (s/z + 1)/(s/p + 1) with z = 2π zero_hz, p = 2π pole_hz; `zero_hz` < 0 is in the right half plane."""

    zero_hz: float
    pole_hz: float

    def polynomials(self) -> Array:
        """Return [[1, n1, 0], [1, d1, 0]]: numerator and denominator in rising powers of s."""
        return np.array([[1.0, 1 / (2 * math.pi * self.zero_hz), 0.0], [1.0, 1 / (2 * math.pi * self.pole_hz), 0.0]])


@dataclass(frozen=True)
class BendingFilter:
    """The continuous filter: the product of its sections, or 1 without sections.

    Raises ValueError with key, value and allowed values for values that are not finite, unstable poles, a zero at the
    origin, and more than `MAX_SECTIONS` sections.
    """

    quadratic: tuple[QuadraticSection, ...] = ()
    first_order: tuple[FirstOrderSection, ...] = ()

    def __post_init__(self) -> None:
        for i, q in enumerate(self.quadratic):
            for key in ("zero_hz", "pole_hz", "pole_zeta"):
                value = getattr(q, key)
                _refuse_unless(value > 0, f"quadratic[{i}].{key}", value, "a finite number above 0")
            _refuse_unless(True, f"quadratic[{i}].zero_zeta", q.zero_zeta, "a finite number")
        for i, f in enumerate(self.first_order):
            _refuse_unless(f.pole_hz > 0, f"first_order[{i}].pole_hz", f.pole_hz, "a finite number above 0")
            _refuse_unless(f.zero_hz != 0, f"first_order[{i}].zero_hz", f.zero_hz, "a finite number other than 0")
        n = len(self.quadratic) + len(self.first_order)
        _refuse_unless(n <= MAX_SECTIONS, "number of filter sections", n, f"at most {MAX_SECTIONS}")

    @property
    def structure(self) -> tuple[int, int]:
        """Return the numbers of quadratic and of first-order sections."""
        return len(self.quadratic), len(self.first_order)

    @property
    def gain_at_infinity(self) -> float:
        """Return |F(j inf)|."""
        gain = math.prod((q.pole_hz / q.zero_hz) ** 2 for q in self.quadratic)
        return float(gain * math.prod(f.pole_hz / abs(f.zero_hz) for f in self.first_order))

    def polynomials(self) -> Array:
        """Return numerator and denominator of each section in rising powers of s, (sections, 2, 3).

        Quadratic sections are first.
        """
        rows = [q.polynomials() for q in self.quadratic] + [f.polynomials() for f in self.first_order]
        return np.array(rows).reshape(-1, 2, 3)

    def frequency_response(self, omega_radps: ArrayLike) -> ComplexArray:
        """Return F(jω) in the shape of `omega_radps`, which may be complex."""
        s = 1j * np.asarray(omega_radps)
        response = np.ones(s.shape, complex)
        for n, d in self.polynomials():
            response *= (n[0] + s * (n[1] + s * n[2])) / (d[0] + s * (d[1] + s * d[2]))
        return response

    def discretize(
        self, sample_s: float, method: Discretization = "prewarped", prewarp_hz: float | None = None
    ) -> DiscreteFilter:
        """Return the discrete filter at the period `sample_s`.

        - `prewarped`: bilinear, s = c (z - 1)/(z + 1), with one constant c = ω0/tan(ω0 T/2) for all sections, so that
          the response at ω0 = 2π `prewarp_hz` equals the continuous response.
        - `bilinear`: c = 2/T (Tustin).
        - `matched`: poles and zeros are mapped by exp(sT), with a DC gain of 1. A pole or zero beyond the Nyquist
          frequency is rejected, because it would alias.
        - `zoh`: step-invariant for the cascade as a whole, so that the discrete sections do not correspond to the
          continuous sections.

        A filter without sections is 1 by any method and needs no `prewarp_hz`. Raises ValueError with key, value and
        allowed values.
        """
        _refuse_unless(sample_s > 0, "sample_s", sample_s, "a finite number above 0")
        if method not in get_args(Discretization):
            raise ValueError(f"discretization = {method!r}: allowed is {', '.join(get_args(Discretization))}")
        if method == "prewarped" and self.polynomials().size > 0:
            nyquist_hz = 0.5 / sample_s
            if prewarp_hz is None or not 0 < prewarp_hz < nyquist_hz:
                raise ValueError(
                    f"prewarp_hz = {prewarp_hz}: allowed is above 0 and below the Nyquist frequency {nyquist_hz:g} Hz"
                )
        if method in ("bilinear", "prewarped"):
            sections = [_bilinear(n, d, bilinear_constant(sample_s, method, prewarp_hz)) for n, d in self.polynomials()]
        elif method == "matched":
            sections = [_matched(n, d, sample_s) for n, d in self.polynomials()]
        else:
            sections = _step_invariant(self.polynomials(), sample_s)
        return DiscreteFilter(np.array(sections).reshape(-1, 5), sample_s)


def bilinear_constant(sample_s: float, method: Discretization, prewarp_hz: float | None) -> float:
    """Return the constant c of the transform s = c (z - 1)/(z + 1), 1/s."""
    if method == "bilinear" or prewarp_hz is None:
        return 2.0 / sample_s
    return 2.0 * math.pi * prewarp_hz / math.tan(math.pi * prewarp_hz * sample_s)


@dataclass(frozen=True)
class DiscreteFilter:
    """The discrete filter, a cascade of biquads: `sections` (n, 5) of b0, b1, b2, a1, a2 with a0 = 1, in powers of z⁻¹.

    Raises ValueError for a section that is unstable or not finite, and for more than `MAX_SECTIONS` sections.
    """

    sections: Array
    sample_s: float

    def __post_init__(self) -> None:
        _refuse_unless(len(self.sections) <= MAX_SECTIONS, "sections", len(self.sections), f"at most {MAX_SECTIONS}")
        for i, section in enumerate(self.sections):
            a1, a2 = section[3:]
            stable = np.isfinite(section).all() and abs(a2) < 1 and abs(a1) < 1 + a2  # Jury
            if not stable:
                raise ValueError(f"sections[{i}] = {section.tolist()}: allowed are finite numbers and stable poles")

    @property
    def n_sections(self) -> int:
        return len(self.sections)

    def padded(self) -> Array:
        """Return the sections followed by zeros, (MAX_SECTIONS, 5), as in a parameter record."""
        out = np.zeros((MAX_SECTIONS, 5))
        out[: self.n_sections] = self.sections
        return out

    def frequency_response(self, omega_radps: ArrayLike) -> ComplexArray:
        """Return F(exp(jωT)) in the shape of `omega_radps`."""
        z1 = np.exp(-1j * np.asarray(omega_radps, float) * self.sample_s)
        response = np.ones(z1.shape, complex)
        for b0, b1, b2, a1, a2 in self.sections:
            response *= (b0 + z1 * (b1 + z1 * b2)) / (1 + z1 * (a1 + z1 * a2))
        return response


def _refuse_unless(holds: bool, key: str, value: float, allowed: str) -> None:
    if not (holds and math.isfinite(value)):
        raise ValueError(f"{key} = {value}: allowed is {allowed}")


def _bilinear(numerator: Array, denominator: Array, c: float) -> Array:
    """Return the section [b0, b1, b2, a1, a2] under s = c (z - 1)/(z + 1)."""
    rows = []
    for p0, p1, p2 in (numerator, denominator):
        if numerator[2] == denominator[2] == 0:  # first order: without the common factor (z + 1)
            rows.append((p0 + c * p1, p0 - c * p1, 0.0))
        else:
            rows.append((p0 + c * p1 + c * c * p2, 2 * (p0 - c * c * p2), p0 - c * p1 + c * c * p2))
    return _normalised(np.array(rows[0]), np.array(rows[1]))


def _matched(numerator: Array, denominator: Array, sample_s: float) -> Array:
    """Return the section [b0, b1, b2, a1, a2] with poles and zeros at exp(sT)."""
    rows = []
    for name, polynomial in (("zero", numerator), ("pole", denominator)):
        roots = np.polynomial.polynomial.polyroots(np.trim_zeros(polynomial, "b"))
        highest_hz, nyquist_hz = float(np.abs(np.imag(roots)).max()) / (2 * math.pi), 0.5 / sample_s
        if highest_hz >= nyquist_hz:
            raise ValueError(
                f"a {name} at {highest_hz:g} Hz: allowed with discretization matched is below "
                f"the Nyquist frequency {nyquist_hz:g} Hz"
            )
        row = np.zeros(3)
        row[: len(roots) + 1] = np.real(np.poly(np.exp(roots * sample_s)))
        rows.append(row)
    return _normalised(rows[0], rows[1])


def _step_invariant(polynomials: Array, sample_s: float) -> list[Array]:
    """Return the sections of the zero-order-hold equivalent of the whole cascade.

    It differs from the product of the equivalents of the sections, because the signal between two sections is not a
    staircase.
    """
    from scipy.linalg import expm  # noqa: PLC0415  # lazy: scipy.signal takes 0.4 s to import, most flights
    from scipy.signal import zpk2sos  # noqa: PLC0415  # do not need it

    if len(polynomials) == 0:
        return []
    a, b, c, d = np.zeros((0, 0)), np.zeros(0), np.zeros(0), 1.0
    poles: list[complex] = []
    for n, q in polynomials:
        order = 2 if q[2] != 0 else 1
        through = n[order] / q[order]
        # Controllable canonical form of this section, connected in series after the previous sections.
        a_i = np.eye(order, k=1)
        a_i[-1] = -q[:order] / q[order]
        b_i = np.eye(order)[-1]
        c_i = (n[:order] - through * q[:order]) / q[order]
        a = np.block([[a, np.zeros((len(b), order))], [np.outer(b_i, c), a_i]])
        b, c, d = np.concatenate([b, b_i * d]), np.concatenate([through * c, c_i]), d * through
        poles.extend(np.polynomial.polynomial.polyroots(q[: order + 1]))
    size = len(b)
    augmented = np.zeros((size + 1, size + 1))
    augmented[:size, :size], augmented[:size, size] = a, b
    held = expm(augmented * sample_s)
    # The feed-through d is never 0 here, so the zeros are the poles of the inverse system.
    zeros = np.linalg.eigvals(held[:size, :size] - np.outer(held[:size, size], c) / d)
    rows = np.asarray(zpk2sos(zeros.astype(complex), np.exp(np.array(poles) * sample_s), d))
    return [_normalised(row[:3], row[3:]) for row in rows]


def _normalised(b: Array, a: Array) -> Array:
    """Return [b0, b1, b2, a1, a2] for a0 = 1 and unit DC gain."""
    with np.errstate(all="ignore"):  # DiscreteFilter rejects values that are not finite
        b = b * (a.sum() / b.sum())
    return np.concatenate([b / a[0], a[1:] / a[0]])


@kernel
def filter_sample(sections: Array, n_sections: int, memory: Array, value: float) -> float:
    """Return the output of the cascade for the next input `value`, in transposed direct form II.

    `sections` (>= n, 5): b0, b1, b2, a1, a2. `memory` (>= n, 2) is advanced in place. Without sections, the output is
    `value`.
    """
    for i in range(n_sections):
        out = sections[i, 0] * value + memory[i, 0]
        memory[i, 0] = sections[i, 1] * value - sections[i, 3] * out + memory[i, 1]
        memory[i, 1] = sections[i, 2] * value - sections[i, 4] * out
        value = out
    return value


@kernel
def settle_filter(sections: Array, n_sections: int, memory: Array, value: float) -> None:
    """Set `memory` (>= n, 2) to the steady state at the constant input `value`, so that no transient follows."""
    for i in range(n_sections):
        b0, b1, b2 = sections[i, 0], sections[i, 1], sections[i, 2]
        a1, a2 = sections[i, 3], sections[i, 4]
        out = value * (b0 + b1 + b2) / (1.0 + a1 + a2)
        memory[i, 1] = b2 * value - a2 * out
        memory[i, 0] = b1 * value - a1 * out + memory[i, 1]
        value = out
