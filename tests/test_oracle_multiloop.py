"""Loops of several axes equal Euler's equations with sums of images, closed forms and exhaustive searches."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable
from functools import cache
from types import SimpleNamespace

import numpy as np
import pytest
import scipy.linalg
import scipy.optimize
from flightkit import Parts, rig, scenario_of

from maxq import margins, multiloop_margins
from maxq.control.kernel.records import Array
from maxq.design.loop.multiloop import Multiloop, OneLoop, multiloop
from maxq.design.loop.sampling import sample
from maxq.design.margins import measure, packed
from maxq.design.margins import multiloop as multi
from maxq.design.margins.multiloop import structured_singular_value
from maxq.design.model.state_space import StateSpace, channels

LOWEST_HZ = 1e-3  # slower roots are drift

SPIN_RADPS, THRUST_N, PERIOD_S, DELAY_S = 0.8, 3.0e4, 0.01, 0.003
INERTIA = np.array([[900.0, 60.0, -150.0], [60.0, 5.2e4, 400.0], [-150.0, 400.0, 5.21e4]])
PLACES = ((12.0, 0.6, 0.1), (12.0, -0.6, -0.1), (12.0, 0.0, 0.5))  # station, y, z
CG = (7.0, 0.02, -0.03)
GAINS = {"pitch": (0.9, 0.6), "yaw": (0.9, 0.6), "roll": (0.02, 0.03)}
GYRO, ACTUATOR = (60.0, 0.65), (7.0, 0.7)


@cache
def spinning() -> Multiloop:
    """Return a spinning rigid vehicle in empty space with three engines whose gimbals control roll."""
    engines = [
        {
            "table": [{"time_s": 0.0, "thrust_vacuum_N": THRUST_N}],
            "gimbal_station_m": x,
            "exit_station_m": x,
            "offset_m": [y, z],
            "group": group,
        }
        for (x, y, z), group in zip(PLACES, "abc", strict=True)
    ]
    tree = scenario_of(Parts(core_inertia=tuple(map(tuple, INERTIA)), core_cg=CG))
    stage = tree["vehicle"]["stage"][0]
    stage["engine"] = engines
    stage["actuator"] = {
        "model": "second-order",
        "omega_hz": [ACTUATOR[0]],
        "zeta": [ACTUATOR[1]],
        "angle_limit_deg": 45.0,
        "rate_limit_degps": 1000.0,
    }
    tree["initial"]["rate_BI_degps"] = [float(np.degrees(SPIN_RADPS)), 0.0, 0.0]
    (p, d), (roll_p, roll_d) = GAINS["pitch"], GAINS["roll"]
    tree["design"] = {
        "gains": {"table": [{"time_s": 0.0, "k_p": p, "k_d_s": d}], "yaw": "pitch"},
        "roll_gimbal": {"k_p": roll_p, "k_d_s": roll_d, "limit_deg": 5.0},
    }
    made = rig(tree)
    design = made.loaded.scenario.design
    assert design is not None
    return multiloop(made.packed, design, 0.0)


def images(frequencies_hz: Array, spin_radps: float = SPIN_RADPS) -> np.ndarray:
    """Return L of the same vehicle from Euler's equations and the sum over the images of the sampled signal."""
    arms = [np.array([CG[0] - x, y - CG[1], z - CG[2]]) for x, y, z in PLACES]
    # a positive pitch angle turns the thrust to +z, a positive yaw angle to -y
    columns = [np.cross(r, THRUST_N * np.array(side)) for r in arms for side in ((0, 0, 1), (0, -1, 0))]
    turning = np.array(columns).T[[1, 2, 0]]  # pitch, yaw, roll
    authority = np.diag(np.abs(turning).sum(axis=1))
    allocation = np.linalg.pinv(turning) @ authority
    w, j = np.array([spin_radps, 0.0, 0.0]), INERTIA
    euler = -np.linalg.solve(j, cross(w) @ j - cross(j @ w))
    inputs = np.linalg.solve(j, np.array(columns).T)

    def plant(s: np.ndarray) -> np.ndarray:
        body = np.linalg.solve(s[..., None, None] * np.eye(3) - euler, inputs @ allocation)[..., [1, 2, 0], :]
        lag = [1.0 / ((s / (2 * np.pi * f)) ** 2 + 2 * z * s / (2 * np.pi * f) + 1.0) for f, z in (GYRO, ACTUATOR)]
        held = (1.0 - np.exp(-s * PERIOD_S)) / (s * PERIOD_S)
        return np.asarray((lag[0] * lag[1] * held**2 * np.exp(-s * DELAY_S))[..., None, None] * body)

    f = np.asarray(frequencies_hz)
    summed = sum(plant(2j * np.pi * (f + n / PERIOD_S)) for n in range(-300, 301))
    z = np.exp(2j * np.pi * f * PERIOD_S)
    gains = np.array([p * PERIOD_S * z / (z - 1.0) + d for p, d in GAINS.values()]).T
    return np.asarray(gains[..., None] * summed)


def cross(v: Array) -> Array:
    return np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])


FREQUENCIES_HZ = np.array([0.02, 0.11, 0.4, 1.3, 4.0, 9.0, 21.0, 47.0])


def test_spinning_vehicle_is_eulers_equations() -> None:
    ours, theirs = spinning().response(FREQUENCIES_HZ), images(FREQUENCIES_HZ)
    np.testing.assert_allclose(ours, theirs, rtol=2e-6, atol=2e-6 * np.abs(theirs).max(axis=(1, 2)).min())
    still = images(FREQUENCIES_HZ, 0.0)  # the spin is no small term here
    assert (np.abs(still - theirs).max(axis=(1, 2)) > 1e-2 * np.abs(theirs).max(axis=(1, 2)))[:4].all()


def test_one_loop_with_the_others_closed_is_the_determinants_ratio() -> None:
    """1 + L_i = det(1 + L) / det(1 + L of the others), by Schur's formula."""
    whole, eye = images(FREQUENCIES_HZ), np.eye(3)
    for k, axis in enumerate(GAINS):
        others = np.delete(np.delete(whole + eye, k, 1), k, 2)
        expected = np.linalg.det(whole + eye) / np.linalg.det(others) - 1.0
        np.testing.assert_allclose(spinning().one(axis).response(FREQUENCIES_HZ), expected, rtol=5e-6, atol=1e-6)


@pytest.mark.parametrize("axes", [2, 3])
def test_compiled_response_is_that_of_resolvents_and_laws(axes: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """The reference computes z - p, and loses digits near slow poles and the undamped one of the spin.

    Margins are those of the reference, which compiled code calls back.
    """
    whole = spinning()
    if axes == 2:
        laws, names = whole.laws[:2], whole.axes[:2]
        assert whole.plant is not None
        plant = channels(whole.plant, whole.plant.outputs[:2], whole.plant.inputs[:2])
        path = sample(plant, whole.path.sample_s, DELAY_S)
        whole = dataclasses.replace(whole, axes=names, laws=laws, plant=plant, path=path)
    hz = np.geomspace(LOWEST_HZ, 49.9, 2000)
    for axis in whole.axes:
        numbers = packed.packed(whole.one(axis))
        assert numbers is not None
        assert numbers.axes == axes
        known = whole.one(axis).response(hz)
        assert (np.abs(packed._values(hz, numbers) / known - 1.0) < 1e-9).all()
    every, known = packed.matrix_response(whole)(hz), whole.response(hz)
    assert (np.abs(every - known).max(axis=(1, 2)) < 1e-9 * np.abs(known).max(axis=(1, 2))).all()
    found = multiloop_margins(whole)
    monkeypatch.setattr(measure, "packed", lambda loop: None)
    monkeypatch.setattr(multi, "matrix_response", lambda loop: loop.response)
    wanted = multiloop_margins(whole)
    assert found.disk.size == pytest.approx(wanted.disk.size, rel=1e-9)
    for mine, other in zip(found.each, wanted.each, strict=True):
        for name in ("gain_up_db", "gain_down_db", "phase_deg"):
            assert getattr(mine, name).value == pytest.approx(getattr(other, name).value, rel=1e-9, abs=1e-9)
        assert mine.disks.symmetric.size == pytest.approx(other.disks.symmetric.size, rel=1e-9)


def test_gain_margins_of_each_axis_are_where_the_closed_loop_loses_stability() -> None:
    s = spinning().state_space
    for k, (axis, m) in enumerate(zip(GAINS, multiloop_margins(spinning()).each, strict=True)):
        assert m.stable
        for change, inside in ((0.999, True), (1.001, False)):
            factor = np.ones(3)
            factor[k] = 10.0 ** (change * m.gain_up_db.value / 20.0)
            radius = np.abs(np.linalg.eigvals(s.a - s.b @ np.diag(factor) @ s.c))
            assert (radius[radius < 1.5].max() < 1.0 + 1e-9) == inside, axis


@pytest.mark.slow
def test_disk_of_all_loops_by_brute_force_over_complex_factors() -> None:
    """No factors inside the disks destabilise, and some at the rim do, found by minimising |det| over their phases."""
    loop, rng = spinning(), np.random.default_rng(3)
    disk, s = multiloop_margins(loop).disk, loop.state_space

    def factors(d: np.ndarray) -> np.ndarray:
        return np.asarray((1.0 + 0.5 * d) / (1.0 - 0.5 * d))

    for _ in range(400):
        d = 0.999 * disk.size * np.sqrt(rng.uniform(size=3)) * np.exp(2j * np.pi * rng.uniform(size=3))
        assert np.abs(np.linalg.eigvals(s.a - s.b @ np.diag(factors(d)) @ s.c)).max() < 1.0 + 1e-9
    at = loop.response(np.array([disk.frequency_hz]))[0]

    def distance(turns: Array, size: float) -> float:
        return float(abs(np.linalg.det(np.eye(3) + np.diag(factors(size * np.exp(1j * turns))) @ at)))

    def least(size: float) -> float:
        starts = rng.uniform(-np.pi, np.pi, (20, 3))
        found = (scipy.optimize.minimize(distance, x, (size,), method="Nelder-Mead", tol=1e-12).fun for x in starts)
        return float(min(found))

    assert least(disk.size) < 1e-5
    assert least(0.99 * disk.size) > 1e-3
    one = min(margins(loop.one(axis), zones=()).disks.symmetric.size for axis in GAINS)
    assert disk.size < 0.999 * one  # together they are worse than one at a time


class Satellite:
    """The spinning satellite of Blight, Dailey & Gangsaas (Int. J. Control 59(1), 1994) with a gain at its input.

    x' = a J x + u, y = C x: rates about two axes of a spinning body and their coupling. There is an `OpenLoop` per
    axis.
    """

    axes, time_s, highest_hz, path = ("pitch", "yaw"), 0.0, float("inf"), SimpleNamespace(sample_s=None)

    def __init__(self, c: list[list[float]], gain: list[list[float]]) -> None:
        self.a, self.b, self.c = 10.0 * np.array([[0.0, 1.0], [-1.0, 0.0]]), np.array(gain, float), np.array(c, float)

    @property
    def state_space(self) -> StateSpace:
        return StateSpace(self.a, self.b, self.c, np.zeros((2, 2)), ("p", "q"), self.axes, self.axes)

    def response(self, frequencies_hz: Array) -> np.ndarray:
        s = 2j * np.pi * np.asarray(frequencies_hz)
        return self.c @ np.linalg.solve(s[..., None, None] * np.eye(2) - self.a, self.b)

    def poles(self, closed: Iterable[int]) -> np.ndarray:
        i = list(closed)
        return np.linalg.eigvals(self.a - self.b[:, i] @ self.c[i]).astype(np.complex128)

    def one(self, axis: str) -> OneLoop:
        return OneLoop(self, self.axes.index(axis))


def test_spinning_satellite() -> None:
    """Each loop has unlimited gain and 90 deg with the other one closed, and 0.87 dB in both.

    L is normal with the eigenvalues (1 + 10j) / (s - 10j) and its conjugate, so that mu is the greatest |eigenvalue| of
    S - 1/2 = (s - 1 - 20j) / (2 (s + 1)), at w^2 + 20 w = 1.
    """
    found = multiloop_margins(Satellite([[1, 10], [-10, 1]], [[1, 0], [0, 1]]))
    for m in found.each:
        assert (m.stable, m.gain_up_db.value, m.gain_down_db.value) == (True, np.inf, np.inf)
        assert m.phase_deg.value == pytest.approx(90.0, abs=1e-6)
    w = np.sqrt(101.0) - 10.0
    assert found.disk.frequency_hz == pytest.approx(w / (2.0 * np.pi), rel=1e-4)
    assert found.disk.size == pytest.approx(2.0 * np.sqrt((1.0 + w * w) / (1.0 + (w + 20.0) ** 2)), rel=1e-9)


@pytest.mark.parametrize(("across", "size", "at_radps"), [(8.0, 0.4890, 0.2250), (10.0, 0.3754, 0.0)])
def test_published_margins_of_the_satellite_behind_an_uneven_gain(across: float, size: float, at_radps: float) -> None:
    """The margins are those in the documentation of MATLAB's diskmargin (The MathWorks), with bounds 0.2 % apart."""
    found = multiloop_margins(Satellite([[1, across], [-10, 1]], [[1, -2], [0, 1]]))
    assert found.disk.size == pytest.approx(size, rel=2.5e-3)
    assert 2.0 * np.pi * found.disk.frequency_hz == pytest.approx(at_radps, abs=0.03)
    assert all(m.gain_up_db.value == np.inf for m in found.each)


@pytest.mark.parametrize("share", [0.3, 0.9, 0.99, 1.0, 1.01, 2.0, 3.9])
def test_a_slow_root_beside_the_beginning_of_the_curve_is_no_instability(share: float) -> None:
    """Two axes of L = 1 / (s - a) with a slow root a are stable: S - 1/2 = (s - a - 1) / (2 (s - a + 1))."""
    slow = Satellite([[1, 0], [0, 1]], [[1, 0], [0, 1]])
    a = 2.0 * np.pi * LOWEST_HZ * share
    slow.a = a * np.eye(2)
    found = multiloop_margins(slow)
    assert found.stable
    assert found.disk.size == pytest.approx(2.0 * (1.0 - a) / (1.0 + a), rel=2e-3)


def test_structured_singular_value_by_brute_force() -> None:
    """mu is the greatest spectral radius of U M over diagonal unitary U; for triangular M, a diagonal entry."""
    rng = np.random.default_rng(7)
    for n in (2, 3):
        for _ in range(4):
            matrix = rng.normal(size=(n, n)) + 1j * rng.normal(size=(n, n))

            def smaller(turns: Array, matrix: np.ndarray = matrix) -> float:
                unitary = np.exp(1j * np.append(0.0, turns))
                return -float(np.abs(np.linalg.eigvals(unitary[:, None] * matrix)).max())

            starts = rng.uniform(-np.pi, np.pi, (12, n - 1))
            least = min(scipy.optimize.minimize(smaller, x, method="Nelder-Mead", tol=1e-12).fun for x in starts)
            assert structured_singular_value(matrix) == pytest.approx(-least, rel=1e-9)
    upper: np.ndarray = np.triu(rng.normal(size=(3, 3))) + 0j
    assert structured_singular_value(upper) == pytest.approx(np.abs(np.diag(upper)).max(), rel=1e-5)
