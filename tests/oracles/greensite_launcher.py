"""Greensite's launcher at one instant, in python-control, by the equations of the courses that publish it.

States z, z', theta, theta', q, q'; inputs are the gimbal angle and the angle of attack of the wind. No code of maxq.
The loop is opened at the gimbal angle, with filter, actuator and the exact delay. The signs of the law are those
published: delta = -(k_theta theta + k_thetad theta' + k_z z + k_zd z').
"""

from __future__ import annotations

import csv
import math
from dataclasses import dataclass
from pathlib import Path

import control
import numpy as np
from scipy.optimize import brentq

SCENARIOS = Path(__file__).parents[2] / "scenarios" / "points"


@dataclass(frozen=True)
class Law:
    """The published gains, and a filter (zeros and poles at one frequency, rad/s, with these damping ratios)."""

    k_theta: float
    k_thetad: float
    k_z: float = 0.0
    k_zd: float = 0.0
    notch: tuple[float, float, float] | None = None

    @property
    def gains(self) -> np.ndarray:
        return np.array([self.k_theta, self.k_thetad, self.k_z, self.k_zd])


def coefficients(time_s: float) -> dict[str, float]:
    """The numbers of both files at a time, linear between rows."""
    out: dict[str, float] = {}
    for name in ("greensite.csv", "greensite-mode.csv"):
        lines = [x for x in (SCENARIOS / name).read_text().splitlines() if not x.startswith("#")]
        rows = list(csv.DictReader(lines))
        at = [float(row["time_s"]) for row in rows]
        out |= {key: float(np.interp(time_s, at, [float(row[key]) for row in rows])) for key in rows[0]}
    return out


def plant(p: dict[str, float], zeta: float = 0.005, turn: float = 0.0) -> control.StateSpace:
    """From gimbal angle and angle of attack of the wind to the measured theta, theta', z, z', then alpha.

    `turn` is the rotational acceleration per modal displacement of a thrust line that follows the bent body.
    """
    v, w = p["V_mps"], p["omega_radps"]
    a = np.zeros((6, 6))
    a[0, 1] = a[2, 3] = a[4, 5] = 1.0
    a[1, 1], a[1, 2] = p["a1_1ps"], p["a1_1ps"] * v + p["a4_mps2"]
    a[3, 1], a[3, 2], a[3, 4] = p["A6_1ps2"] / v, p["A6_1ps2"], turn
    a[5, 4], a[5, 5] = -w * w, -2.0 * zeta * w
    b = np.zeros((6, 2))
    b[1], b[3] = (p["a3_mps2"], -p["a1_1ps"] * v), (p["K1_1ps2"], -p["A6_1ps2"])
    b[5, 0] = -p["phi_gimbal_1pkg"] * p["control_thrust_N"]
    sigma, phi = p["slope_gyro_1pm"], p["phi_gyro"]
    c = np.array([[0, 0, 1, 0, sigma, 0], [0, 0, 0, 1, 0, sigma], [1, 0, 0, 0, -phi, 0], [0, 1, 0, 0, 0, -phi]])
    c = np.vstack([c, [0, 1 / v, 1, 0, 0, 0]])
    return control.ss(a, b, c, np.vstack([np.zeros((4, 2)), [[0.0, -1.0]]]))


def before(law: Law, delay_s: float = 0.02, order: int = 0) -> control.TransferFunction:
    """Filter and actuator, and the delay as a Pade approximation of that order; without it for 0."""
    out = control.tf([4900.0], [1.0, 98.0, 4900.0])
    if law.notch is not None:
        w, zero, pole = law.notch
        out *= control.tf([1.0, 2.0 * zero * w, w * w], [1.0, 2.0 * pole * w, w * w])
    return out if order == 0 else out * control.tf(*control.pade(delay_s, order))


def loop(p: dict[str, float], law: Law, radps: np.ndarray, delay_s: float = 0.02, **of: float) -> np.ndarray:
    """L at angular frequencies, with the exact delay."""
    s = 1j * np.atleast_1d(radps)
    way = plant(p, **of)(s, squeeze=False)[:4, 0]
    return (law.gains @ way) * before(law)(s, squeeze=False)[0, 0] * np.exp(-delay_s * s)


def closed_poles(p: dict[str, float], law: Law, order: int = 4, **of: float) -> np.ndarray:
    """The poles of the closed loop, with a Pade delay of that order."""
    whole = control.ss(before(law, order=order)) * control.ss([], [], [], law.gains[None]) * plant(p, **of)[:4, 0]
    return np.asarray(control.feedback(whole, 1).poles())


@dataclass(frozen=True)
class RigidMargins:
    """As HM3 classifies them: below, at and above the last crossover of the rigid body."""

    lower_db: float
    phase_deg: float
    upper_db: float
    crossover_radps: float
    lower_radps: float


def margins(p: dict[str, float], law: Law, **of: float) -> RigidMargins:
    """The margins from 0.3 rad/s to 0.8 of the mode's frequency."""
    radps = np.geomspace(0.3, 0.8 * p["omega_radps"], 600)
    found = loop(p, law, radps, **of)

    def zero(f, k: int) -> float:
        return float(brentq(f, radps[k], radps[k + 1], xtol=1e-12))

    size = np.abs(found) - 1.0
    crossover = zero(lambda w: abs(loop(p, law, w, **of)[0]) - 1.0, int(np.flatnonzero(size[:-1] * size[1:] < 0)[-1]))
    turn = np.flatnonzero((found.imag[:-1] * found.imag[1:] < 0) & (found.real[:-1] < 0))
    edges = [zero(lambda w: loop(p, law, w, **of)[0].imag, int(k)) for k in turn]
    db = [-20.0 * math.log10(abs(loop(p, law, w, **of)[0])) for w in edges]
    phase = abs(math.degrees(np.angle(-loop(p, law, crossover, **of)[0])))
    below = [k for k, w in enumerate(edges) if w < crossover][-1]
    above = next(k for k, w in enumerate(edges) if w > crossover)
    return RigidMargins(-db[below], phase, db[above], crossover, edges[below])
