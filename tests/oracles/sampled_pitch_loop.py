"""Compute the sampled loop of a design at an operating point of KSR-III, opened at the gimbal command.

Aliasing is included, and no Pade approximation is used. At sample k the computer has the exact integral of the gyro
rate (the sum of the V/F counts) and its increment. The computed command reaches the hold after the compute delay.
Stability is judged by the closed-loop poles and by encirclements, and the two must agree, with bending frequencies as
they are and 10 % off.
"""

from __future__ import annotations

import tomllib
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from oracles import pitch_plane
from oracles.pitch_plane import Linear, Snapshot, VehicleFolder, snapshot
from scipy.linalg import expm
from scipy.signal import bilinear, tf2ss

from maxq.control.kernel.records import Array
from maxq.sim.input.files import scenarios_folder

VEHICLE_FOLDER = scenarios_folder() / "vehicles" / "ksr3"
NODES_S = tuple(float(t) for t in range(5, 56, 5))

Response = NDArray[np.complex128]


@dataclass(frozen=True)
class Margins:
    """The margins of a loop; infinite where it has no crossing. `modulus` is the least distance of L from -1."""

    gain_up_db: float  # least increase that reaches -1
    gain_down_db: float  # least decrease that reaches -1
    phase_deg: float  # least turn, either way, over all crossings of |L| = 1
    modulus: float


def margins(loop: Response) -> Margins:
    """Return margins from L on a grid fine enough for its resonances; crossings are interpolated linearly."""
    up, down = np.inf, np.inf
    for size in _negative_axis_crossings(loop):
        gain = -20 * np.log10(size)
        up, down = (min(up, gain), down) if gain > 0 else (up, min(down, -gain))
    return Margins(float(up), float(down), _phase_margin_deg(loop), float(np.abs(1 + loop).min()))


def _negative_axis_crossings(loop: Response) -> Array:
    """Return |L| where L meets the negative real axis, including the ends of the grid."""
    y0, y1 = loop.imag[:-1], loop.imag[1:]
    k = np.flatnonzero(np.signbit(y0) != np.signbit(y1))
    share = y0[k] / (y0[k] - y1[k])
    real = loop.real[k] + share * (loop.real[k + 1] - loop.real[k])
    ends = loop.real[[0, -1]]  # the response is real at zero frequency and at Nyquist
    real = np.append(real, ends[np.abs(loop.imag[[0, -1]]) < 1e-2 * np.abs(ends)])
    return np.asarray(-real[real < 0])


def _phase_margin_deg(loop: Response) -> float:
    size = np.abs(loop) - 1
    k = np.flatnonzero(np.signbit(size[:-1]) != np.signbit(size[1:]))
    share = size[k] / (size[k] - size[k + 1])
    point = loop[k] + share * (loop[k + 1] - loop[k])
    return float(np.degrees(np.abs(np.angle(-point))).min()) if len(point) else float("inf")


def unstable_closed_loop_poles(loop: Response, unstable_open: int) -> float:
    """Return the number of closed-loop poles outside the unit circle, by the argument principle.

    `loop` extends from zero frequency to Nyquist. Over the upper half of the unit circle, 1 + L turns by pi for every
    unstable pole of the open loop less one of the closed loop. The result is not an integer when the grid is too
    coarse.
    """
    angle = np.unwrap(np.angle(1 + loop))
    return unstable_open - float(angle[-1] - angle[0]) / np.pi


@dataclass(frozen=True)
class Quadratic:
    """The section (s^2/wz^2 + 2 zz s/wz + 1) / (s^2/wp^2 + 2 zp s/wp + 1)."""

    zero_hz: float
    zero_zeta: float
    pole_hz: float
    pole_zeta: float


@dataclass(frozen=True)
class Discrete:
    """The system x[k+1] = a x[k] + b u[k], y = c x[k] + d u[k]."""

    a: Array
    b: Array
    c: Array
    d: float


def sampled_plant(plant: Linear, period_s: float, delay_s: float) -> Discrete:
    """Return the sampled plant with delay and hold; its last state is the previous command."""
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
    """Return the numerator and denominator in z of the bending filter, bilinear, exact at `prewarp_hz`."""
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
    """Return the law in z: k_p on the angle and k_d on its increment per period."""
    return np.array([k_p + k_d_s / period_s, -k_d_s / period_s]), np.array([1.0, 0.0])


def controller(k_p: float, k_d_s: float, sections: list[Quadratic], period_s: float, prewarp_hz: float) -> Discrete:
    """Return the controller, from the angle to minus the gimbal command."""
    fb, fa = filter_polynomials(sections, period_s, prewarp_hz)
    lb, la = law_polynomials(k_p, k_d_s, period_s)
    a, b, c, d = tf2ss(np.polymul(fb, lb), np.polymul(fa, la))
    return Discrete(np.asarray(a), np.asarray(b)[:, 0], np.asarray(c)[0], float(np.asarray(d)[0, 0]))


def closed_loop_poles(plant: Discrete, control: Discrete) -> Array:
    """Return the eigenvalues z of the closed loop, which is stable if all are inside the unit circle."""
    corner = plant.a - np.outer(plant.b, control.d * plant.c)
    a = np.block([[corner, -np.outer(plant.b, control.c)], [np.outer(control.b, plant.c), control.a]])
    return np.asarray(np.linalg.eigvals(a))


def response(system: Discrete, frequency_hz: Array, period_s: float) -> Response:
    """Return the frequency response at z = exp(j w T)."""
    z = np.exp(2j * np.pi * frequency_hz * period_s)
    eye = np.eye(len(system.a))
    matrices = z[:, None, None] * eye - system.a
    return np.asarray(np.linalg.solve(matrices, system.b[:, None].astype(complex))[:, :, 0] @ system.c + system.d)


def frequency_grid(plant: Discrete, period_s: float) -> Array:
    """Return frequencies from nearly 0 to Nyquist, denser around lightly damped poles."""
    grid = [np.array([1e-5]), np.geomspace(2e-4, 0.5 / period_s, 800)]
    spread = np.concatenate([-np.geomspace(30, 0.05, 25), [0.0], np.geomspace(0.05, 30, 25)])
    for pole in np.log(plant_poles(plant)) / (2 * np.pi * period_s):
        if pole.imag > 0.05 and abs(pole.real) < 0.1 * pole.imag:
            grid.append(pole.imag + abs(pole.real) * spread)
    joined = np.unique(np.concatenate(grid))
    return joined[(joined >= 1e-5) & (joined <= 0.5 / period_s)]


def plant_poles(plant: Discrete) -> Array:
    """Return the poles z except those at the origin (the stored command)."""
    poles = np.linalg.eigvals(plant.a).astype(complex)
    return np.asarray(poles[np.abs(poles) > 1e-6])


BENDING_FACTORS = (1.0, 0.9, 1.1)


@dataclass(frozen=True)
class Case:
    """A plant with its frequency response on its own grid."""

    time_s: float
    bending_factor: float
    snapshot: Snapshot
    plant: Discrete
    frequency_hz: Array
    response: Response
    unstable_poles: int
    period_s: float


def make_case(vehicle: VehicleFolder, t: float, bending_factor: float) -> Case:
    s = snapshot(vehicle, t)
    bending = replace(s.bending, omega_radps=s.bending.omega_radps * bending_factor)
    s = replace(s, bending=bending)
    stage, computer = vehicle.stage, vehicle.description["computer"]
    actuator = pitch_plane.actuator(stage["actuator"]["omega_hz"], stage["actuator"]["zeta"])
    gyro = pitch_plane.gyro(stage["gyro"]["omega_hz"], stage["gyro"]["zeta"])
    period = computer["sample_s"]
    plant = sampled_plant(pitch_plane.plant(s, actuator, gyro), period, computer["delay_s"])
    grid = frequency_grid(plant, period)
    unstable = int((np.abs(plant_poles(plant)) > 1).sum())
    return Case(t, bending_factor, s, plant, grid, response(plant, grid, period), unstable, period)


def all_cases(folder: Path, times_s: tuple[float, ...] = NODES_S) -> list[Case]:
    vehicle = VehicleFolder(folder)
    return [make_case(vehicle, t, factor) for factor in BENDING_FACTORS for t in times_s]


DESIGN_FILE = VEHICLE_FOLDER.parents[1] / "designs" / "ksr3-default.toml"


@dataclass(frozen=True)
class Verdict:
    """A judged case. `unstable` counts closed-loop poles outside the unit circle; `encircled` is the count from L.

    `slowest_per_s` is the decay rate of the slowest pole, `bending_peak_db` the largest |L| from 7 Hz to 13 Hz, and
    `high_peak_db` that above 13 Hz.
    """

    case: Case
    margins: Margins
    unstable: int
    encircled: float
    slowest_per_s: float
    bending_peak_db: float
    high_peak_db: float
    rigid_hz: float
    rigid_zeta: float


class Design:
    """The gains over time and the filter of a design file of structure F2 or F4."""

    def __init__(self, path: Path) -> None:
        data: dict[str, Any] = tomllib.loads(path.read_text(encoding="utf-8"))
        self._rows = np.array([[r["time_s"], r["k_p"], r["k_d_s"]] for r in data["gains"]["table"]])
        if data["filter"].get("first_order"):
            raise ValueError(f"{path}: only quadratic sections are handled here")
        self.sections = [Quadratic(**section) for section in data["filter"]["quadratic"]]
        self.prewarp_hz: float = data["filter"]["prewarp_hz"]

    def gains_at(self, t: float) -> tuple[float, float]:
        k_p, k_d = (float(np.interp(t, self._rows[:, 0], column)) for column in self._rows.T[1:])
        return k_p, k_d


def judge(case: Case, design: Design) -> Verdict:
    k_p, k_d = design.gains_at(case.time_s)
    control = controller(k_p, k_d, design.sections, case.period_s, design.prewarp_hz)
    loop = case.response * response(control, case.frequency_hz, case.period_s)
    poles = closed_loop_poles(case.plant, control)
    peak = 20 * np.log10(np.abs(loop))
    bending = (case.frequency_hz > 7) & (case.frequency_hz < 13)
    m_delta = case.snapshot.m_delta_ps2
    return Verdict(
        case=case,
        margins=margins(loop),
        unstable=int((np.abs(poles) >= 1).sum()),
        encircled=unstable_closed_loop_poles(loop, case.unstable_poles),
        slowest_per_s=float(-np.log(np.abs(poles).max()) / case.period_s),
        bending_peak_db=float(peak[bending].max()),
        high_peak_db=float(peak[case.frequency_hz >= 13].max()),
        rigid_hz=float(np.sqrt(m_delta * k_p) / (2 * np.pi)),
        rigid_zeta=float(k_d / 2 * np.sqrt(m_delta / k_p)),
    )
