"""The loop as it is: a continuous plant seen and driven by a computer every 10 ms. No Pade, aliasing
included.

At sample k the computer has the exact integral of the gyro rate (the sum of the V/F counts) and its
increment; the command it computes reaches the hold a compute delay later.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import expm
from scipy.signal import bilinear, tf2ss

from maxq.control.kernel.records import Array
from maxq.tools.dev.studies.ksr3.linear_model import Linear
from maxq.tools.dev.studies.ksr3.margins import Response


@dataclass(frozen=True)
class Quadratic:
    """(s^2/wz^2 + 2 zz s/wz + 1) / (s^2/wp^2 + 2 zp s/wp + 1)."""

    zero_hz: float
    zero_zeta: float
    pole_hz: float
    pole_zeta: float


@dataclass(frozen=True)
class Discrete:
    """x[k+1] = a x[k] + b u[k], y = c x[k] + d u[k]."""

    a: Array
    b: Array
    c: Array
    d: float


def sampled_plant(plant: Linear, period_s: float, delay_s: float) -> Discrete:
    """Plant with delay and hold at the samples; the last state is the command of the sample before."""
    n = len(plant.a)
    augmented = np.zeros((n + 1, n + 1))
    augmented[:n, :n], augmented[:n, n] = plant.a, plant.b
    late, early = expm(augmented * (period_s - delay_s)), expm(augmented * delay_s)
    a = np.zeros((n + 1, n + 1))
    a[:n, :n] = late[:n, :n] @ early[:n, :n]
    a[:n, n] = late[:n, :n] @ early[:n, n]
    b = np.append(late[:n, n], 1.0)
    return Discrete(a, b, np.append(plant.c, 0.0), 0.0)


def filter_polynomials(sections: list[Quadratic], period_s: float, prewarp_hz: float) -> tuple[Array, Array]:
    """Numerator and denominator in z of the bending filter, bilinear, exact at `prewarp_hz`."""
    numerator: Array = np.ones(1)
    denominator: Array = np.ones(1)
    for q in sections:
        wz, wp = 2 * np.pi * q.zero_hz, 2 * np.pi * q.pole_hz
        numerator = np.asarray(np.polymul(numerator, [1 / wz**2, 2 * q.zero_zeta / wz, 1.0]), float)
        denominator = np.asarray(np.polymul(denominator, [1 / wp**2, 2 * q.pole_zeta / wp, 1.0]), float)
    w = 2 * np.pi * prewarp_hz
    b, a = bilinear(numerator, denominator, fs=w / (2 * np.tan(w * period_s / 2)))
    return np.asarray(b), np.asarray(a)


def law_polynomials(k_p: float, k_d_s: float, period_s: float) -> tuple[Array, Array]:
    """k_p on the angle, k_d on its increment over the period, in z."""
    return np.array([k_p + k_d_s / period_s, -k_d_s / period_s]), np.array([1.0, 0.0])


def controller(k_p: float, k_d_s: float, sections: list[Quadratic], period_s: float, prewarp_hz: float) -> Discrete:
    """Angle in, minus the gimbal command out."""
    fb, fa = filter_polynomials(sections, period_s, prewarp_hz)
    lb, la = law_polynomials(k_p, k_d_s, period_s)
    a, b, c, d = tf2ss(np.polymul(fb, lb), np.polymul(fa, la))
    return Discrete(np.asarray(a), np.asarray(b)[:, 0], np.asarray(c)[0], float(np.asarray(d)[0, 0]))


def closed_loop_poles(plant: Discrete, control: Discrete) -> Array:
    """Eigenvalues z of the closed loop; stable if all lie inside the unit circle."""
    corner = plant.a - np.outer(plant.b, control.d * plant.c)
    a = np.block([[corner, -np.outer(plant.b, control.c)], [np.outer(control.b, plant.c), control.a]])
    return np.asarray(np.linalg.eigvals(a))


def response(system: Discrete, frequency_hz: Array, period_s: float) -> Response:
    """Frequency response at z = exp(j w T)."""
    z = np.exp(2j * np.pi * frequency_hz * period_s)
    eye = np.eye(len(system.a))
    matrices = z[:, None, None] * eye - system.a
    return np.asarray(np.linalg.solve(matrices, system.b[:, None].astype(complex))[:, :, 0] @ system.c + system.d)


def frequency_grid(plant: Discrete, period_s: float) -> Array:
    """Nearly 0 to Nyquist, thickened around every lightly damped pole."""
    grid = [np.array([1e-5]), np.geomspace(2e-4, 0.5 / period_s, 800)]
    spread = np.concatenate([-np.geomspace(30, 0.05, 25), [0.0], np.geomspace(0.05, 30, 25)])
    for pole in np.log(plant_poles(plant)) / (2 * np.pi * period_s):
        if pole.imag > 0.05 and abs(pole.real) < 0.1 * pole.imag:
            grid.append(pole.imag + abs(pole.real) * spread)
    joined = np.unique(np.concatenate(grid))
    return joined[(joined >= 1e-5) & (joined <= 0.5 / period_s)]


def plant_poles(plant: Discrete) -> Array:
    """Poles z without those at the origin (the stored command)."""
    poles = np.linalg.eigvals(plant.a).astype(complex)
    return np.asarray(poles[np.abs(poles) > 1e-6])
