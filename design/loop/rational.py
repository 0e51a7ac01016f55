"""Rational functions of s, and those with which the paper approximates the flight computer (eqs 30 to 32)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.polynomial import polynomial

from maxq.control.kernel.records import Array
from maxq.design.model.state_space import ComplexArray, StateSpace


@dataclass(frozen=True)
class Rational:
    """A rational function: numerator and denominator in rising powers of tau s, both of the denominator's length."""

    name: str
    tau_s: float
    numerator: tuple[float, ...]
    denominator: tuple[float, ...]

    def at(self, s: ComplexArray) -> ComplexArray:
        x = self.tau_s * np.asarray(s)
        return np.asarray(polynomial.polyval(x, self.numerator) / polynomial.polyval(x, self.denominator))

    def poles(self) -> ComplexArray:
        return np.asarray(polynomial.polyroots(self.denominator), np.complex128) / self.tau_s

    def state_space(self) -> StateSpace:
        """Return the controllable canonical form in units of tau, so that its entries are of similar size."""
        n = len(self.denominator) - 1
        d, p = np.array(self.denominator), np.array(self.numerator)
        through = p[n] / d[n]
        a = np.eye(n, k=1)
        a[-1] = -d[:n] / d[n]
        c: Array = (p[:n] - through * d[:n]) / d[n]
        states = tuple(f"{self.name}_{k + 1}" for k in range(n))
        b = np.eye(n)[:, -1:]
        return StateSpace(
            a / self.tau_s,
            b / self.tau_s,
            c[None],
            np.array([[through]]),
            states,
            (f"{self.name}_in",),
            (f"{self.name}_out",),
        )


def converter_pade(tau_s: float) -> Rational:
    """Return H_VF (30). The paper prints no coefficients. These are the Pade approximant [3/3] of (1 - e^-x) / x.

    The function is the average over the sample, which is equivalent to counting pulses. It is the only such set with
    the printed signs (erratum 14). The error is 0.02 dB and 0.1 deg up to the Nyquist frequency.
    """
    return Rational("converter", tau_s, (1.0, -1 / 14, 1 / 42, -1 / 840), (1.0, 3 / 7, 1 / 14, 1 / 210))


def delay_pade(tau_s: float) -> Rational:
    """Return H_D (31)."""
    return Rational("delay", tau_s, (1.0, -1 / 2, 1 / 12), (1.0, 1 / 2, 1 / 12))


def hold_pade(tau_s: float) -> Rational:
    """Return H_DZ (32): the Pade approximant [0/2] of (1 - e^-x) / x."""
    return Rational("hold", tau_s, (1.0, 0.0, 0.0), (1.0, 1 / 2, 1 / 12))


def average(s: ComplexArray, tau_s: float) -> ComplexArray:
    """Return (1 - e^-x) / x with x = tau s: the running average over tau, and the zero-order hold."""
    x = tau_s * np.asarray(s, np.complex128)
    safe = np.where(np.abs(x) < 1e-5, 1.0, x)
    return np.where(np.abs(x) < 1e-5, 1.0 - x / 2 + x * x / 6, -np.expm1(-safe) / safe)
