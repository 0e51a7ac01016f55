"""Rational functions of s, and the paper's approximations of the flight computer (eqs 30 to 32)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.polynomial import polynomial

from maxq.control.kernel.records import Array
from maxq.design.model.state_space import ComplexArray, StateSpace


@dataclass(frozen=True)
class Rational:
    """A rational function of tau s: coefficients of numerator and denominator in rising powers, of equal number."""

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
        """Return the controllable canonical form, scaled by tau so that its entries are of similar size."""
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
    """Return H_VF (30), the Padé approximant [3/3] of (1 - e^-x) / x with x = tau s.

    The function is the average over a sample, which is equivalent to counting pulses. The paper prints no coefficients;
    of the possible sets, only this one has the printed signs (erratum 14). The error is 0.02 dB and 0.1 deg up to the
    Nyquist frequency.
    """
    return Rational("converter", tau_s, (1.0, -1 / 14, 1 / 42, -1 / 840), (1.0, 3 / 7, 1 / 14, 1 / 210))


def delay_pade(tau_s: float) -> Rational:
    """Return H_D (31), the Padé approximant [2/2] of e^-x with x = tau s."""
    return Rational("delay", tau_s, (1.0, -1 / 2, 1 / 12), (1.0, 1 / 2, 1 / 12))


def hold_pade(tau_s: float) -> Rational:
    """Return H_DZ (32), the Padé approximant [0/2] of (1 - e^-x) / x with x = tau s."""
    return Rational("hold", tau_s, (1.0, 0.0, 0.0), (1.0, 1 / 2, 1 / 12))


def average(s: ComplexArray, tau_s: float) -> ComplexArray:
    """Return (1 - e^-x) / x with x = tau s, the response of a running average over tau and of a zero-order hold."""
    x = tau_s * np.asarray(s, np.complex128)
    safe = np.where(np.abs(x) < 1e-5, 1.0, x)
    return np.where(np.abs(x) < 1e-5, 1.0 - x / 2 + x * x / 6, -np.expm1(-safe) / safe)
