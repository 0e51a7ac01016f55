"""Model Greensite's launcher at one instant with python-control, from the equations of the published courses.

States z, z', theta, theta', q, q'; inputs are the gimbal angle and the angle of attack of the wind. No code of maxq is
used. The loop is opened at the gimbal angle, with filter, actuator and the exact delay. The law has the published
signs: delta = -(k_theta theta + k_thetad theta' + k_z z + k_zd z').
"""

from __future__ import annotations

import csv
import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import control
import numpy as np
from scipy.linalg import expm
from scipy.optimize import brentq

SCENARIOS = Path(__file__).parents[2] / "scenarios" / "points"


@dataclass(frozen=True)
class Law:
    """The published gains, and a filter: zeros and poles at one frequency (rad/s) with these damping ratios."""

    k_theta: float
    k_thetad: float
    k_z: float = 0.0
    k_zd: float = 0.0
    notch: tuple[float, float, float] | None = None

    @property
    def gains(self) -> np.ndarray:
        return np.array([self.k_theta, self.k_thetad, self.k_z, self.k_zd])


def coefficients(time_s: float) -> dict[str, float]:
    """Return the values of both files at a time, interpolated linearly between rows."""
    out: dict[str, float] = {}
    for name in ("greensite.csv", "greensite-mode.csv"):
        lines = [x for x in (SCENARIOS / name).read_text().splitlines() if not x.startswith("#")]
        rows = list(csv.DictReader(lines))
        at = [float(row["time_s"]) for row in rows]
        out |= {key: float(np.interp(time_s, at, [float(row[key]) for row in rows])) for key in rows[0]}
    return out


def plant(p: dict[str, float], zeta: float = 0.005, turn: float = 0.0) -> control.StateSpace:
    """Return the plant from gimbal angle and angle of attack of the wind to measured theta, theta', z, z', and alpha.

    `turn` is the rotational acceleration per modal displacement due to a thrust line that follows the bent body.
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
    """Return the filter and actuator with the delay as a Pade approximation of an order; 0: no delay."""
    out = control.tf([4900.0], [1.0, 98.0, 4900.0])
    if law.notch is not None:
        w, zero, pole = law.notch
        out *= control.tf([1.0, 2.0 * zero * w, w * w], [1.0, 2.0 * pole * w, w * w])
    return out if order == 0 else out * control.tf(*control.pade(delay_s, order))


def loop(p: dict[str, float], law: Law, radps: np.ndarray, delay_s: float = 0.02, **of: float) -> np.ndarray:
    """Return L at angular frequencies, with the exact delay."""
    s = 1j * np.atleast_1d(radps)
    way = plant(p, **of)(s, squeeze=False)[:4, 0]
    return (law.gains @ way) * before(law)(s, squeeze=False)[0, 0] * np.exp(-delay_s * s)


def closed_poles(p: dict[str, float], law: Law, order: int = 4, **of: float) -> np.ndarray:
    """Return the poles of the closed loop with a Pade delay of an order."""
    whole = control.ss(before(law, order=order)) * control.ss([], [], [], law.gains[None]) * plant(p, **of)[:4, 0]
    return np.asarray(control.feedback(whole, 1).poles())


@dataclass(frozen=True)
class RigidMargins:
    """The margins as HM3 classifies them: below, at and above the last crossover of the rigid body."""

    lower_db: float
    phase_deg: float
    upper_db: float
    crossover_radps: float
    lower_radps: float


def margins(p: dict[str, float], law: Law, **of: float) -> RigidMargins:
    """Return the margins between 0.3 rad/s and 0.8 of the mode's frequency."""
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


def flown(
    law_at: Callable[[float], Law],
    span_s: tuple[float, float],
    start: np.ndarray,
    wind_mps: Callable[[float], float] = lambda _: 0.0,
    step_s: float = 0.02,
) -> tuple[np.ndarray, np.ndarray]:
    """Fly the linear system with time-varying coefficients and law.

    Returns the times, and z, z', theta, theta', q, q', alpha. `start` contains the first six. The filter is a pair of
    integrators with its frequency; the delay is a Pade approximation of order 4. Each step is exact for the
    coefficients at its middle.
    """
    times = np.linspace(*span_s, round((span_s[1] - span_s[0]) / step_s) + 1)
    middles = 0.5 * (times[:-1] + times[1:])
    late = control.ss(control.tf(*control.pade(0.02, 4)))
    closed = np.zeros((len(middles), 15, 15))  # the last state is one
    seconds = np.arange(math.floor(span_s[0]), math.ceil(span_s[1]) + 1.0)
    speeds = np.array([coefficients(t)["V_mps"] for t in seconds])
    models = [plant(coefficients(t)) for t in seconds]
    tables = [np.stack([getattr(model, name) for model in models]) for name in "ABC"]
    for m, t in zip(closed, middles, strict=True):
        k, law = int(t - seconds[0]), law_at(t)
        a, b, c = ((1.0 - t + seconds[k]) * table[k] + (t - seconds[k]) * table[k + 1] for table in tables)
        assert law.notch is not None
        w, zero, pole = law.notch
        error = np.concatenate([-law.gains @ c[:4], [-2.0 * pole, -1.0], np.zeros(7)])
        filtered = error + np.concatenate([np.zeros(6), [2.0 * zero, 1.0], np.zeros(7)])
        delayed = late.D[0, 0] * filtered
        delayed[10:14] += late.C[0]
        m[:6, :6], m[:6, 8], m[:6, 14] = a, b[:, 0], b[:, 1] * wind_mps(t) / np.interp(t, seconds, speeds)
        m[6], m[7, 6] = w * error, w
        m[8, 9], m[9] = 1.0, 4900.0 * delayed
        m[9, 8] -= 4900.0
        m[9, 9] -= 98.0
        m[10:14] = late.B * filtered
        m[10:14, 10:14] += late.A
    states = [np.concatenate([start, np.zeros(8), [1.0]])]
    for step in expm(closed * (times[1] - times[0])):
        states.append(step @ states[-1])
    found = np.array(states)[:, :6]
    wind = np.array([wind_mps(t) for t in times])
    return times, np.column_stack([found, found[:, 2] + (found[:, 1] - wind) / np.interp(times, seconds, speeds)])
