"""Plants of the user, as matrices, systems and files: their margins, worst deviations and optimum."""

from __future__ import annotations

import itertools
from pathlib import Path
from typing import Any

import control
import numpy as np
import pytest
import scipy.io
from test_usage_given_points import PD, SMALL

import maxq
from maxq import GivenPoint

A6, K1, MODE, LAG = 2.0, 5.0, 20.0, 40.0
CASE = """
schema = 2
name = "own plant"
loop = "exact"
nodes_s = [10.0]
between_nodes = "ignore"
[gains]
schedule = "linear"
[filter]
structure = "sections"
first_order = 1
[objective]
kind = "least-margin"
[limits]
gain_margin_db = 6.0
phase_margin_deg = 30.0
rigid_hz = 0.2
rigid_zeta = 0.4
[search]
starts = 2
leaps = 1
"""


def launcher(a6: float = A6, k1: float = K1, omega: float = MODE) -> Any:
    """Return a textbook launcher: an unstable rigid body, one bending mode at the gyro, and a first-order actuator."""
    s = control.tf("s")
    rate = k1 * s / (s * s - a6) - 0.8 * s / (s * s + 0.02 * omega * s + omega**2)
    return rate * LAG / (s + LAG)


def matrices() -> tuple[np.ndarray, ...]:
    """Return the same launcher in state-space form: theta, q, eta, eta', and the actuator angle."""
    a = np.zeros((5, 5))
    a[0, 1], a[1, 0], a[1, 4], a[2, 3] = 1.0, A6, K1, 1.0
    a[3, [2, 3, 4]] = -(MODE**2), -0.02 * MODE, -0.8
    a[4, 4] = -LAG
    b, c = np.array([[0.0], [0.0], [0.0], [0.0], [LAG]]), np.array([[0.0, 1.0, 0.0, 1.0, 0.0]])
    return a, b, c, np.zeros((1, 1))


STATES = ("theta_rad", "q_radps", "eta_1_m", "eta_1_rate_mps", "actuator_1")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    place = tmp_path_factory.mktemp("own")
    for name, text in (("small.toml", SMALL), ("pd.toml", PD), ("case.toml", CASE)):
        (place / name).write_text(text)
    return place


def own_point(**more: Any) -> GivenPoint:
    da = np.zeros((5, 5))
    da[1, 0] = 1.0
    dk, dw = np.zeros((5, 5)), np.zeros((5, 5))
    dk[1, 4] = 1.0
    dw[3, 2], dw[3, 3] = -2.0 * MODE, -0.02
    return maxq.point_of_matrices(
        *matrices(),
        states=STATES,
        time_s=10.0,
        delay_s=0.02,
        m_delta_1ps2=K1,
        m_alpha_1ps2=A6,
        deviations={"a6": {"a": da}, "k1": {"a": dk}, "omega": {"a": dw}},
        **more,
    )


def test_matrices_systems_and_files_are_one_plant(folder: Path) -> None:
    a, b, c, d = matrices()
    scipy.io.savemat(folder / "plain.mat", {"A": a, "B": b, "C": c, "D": d, "state_names": np.array(STATES, object)})
    scipy.io.savemat(folder / "struct.mat", {"plant": {"A": a, "B": b, "C": c, "D": d}})
    named = control.ss(a, b, c, d, inputs=["delta_rad"], outputs=["local_rate_radps"], states=list(STATES))
    points = [
        own_point(),
        maxq.point_of_system(launcher(), delay_s=0.02),
        maxq.point_of_system(named, delay_s=0.02),
        maxq.point_of_system(folder / "plain.mat", delay_s=0.02),
        maxq.point_of_system(str(folder / "struct.mat"), variable="plant", delay_s=0.02),
    ]
    hz = np.geomspace(0.05, 10.0, 40)
    s = 2j * np.pi * hz
    wanted = launcher()(s) * np.exp(-0.02 * s) * (1.0 / s + 0.6)
    for point in points:
        loop = maxq.loop(point, folder / "pd.toml", kind="exact")
        np.testing.assert_allclose(loop.response(hz), wanted, rtol=1e-9)
    assert [p.given.states[2] for p in points] == ["eta_1_m", "x[2]", "eta_1_m", "eta_1_m", "x_3"]
    assert [lobe.label for lobe in maxq.loop(points[0], folder / "pd.toml", kind="exact").margins().lobes] == [
        "bending 1"
    ]


def test_sampled_and_delayed_margins_are_those_of_python_control(folder: Path) -> None:
    """The delay is a whole number of samples; python-control then has the same sampled loop, without the converter."""
    point = own_point(sample_s=0.02)
    loop = maxq.loop(point, folder / "pd.toml")
    a, b, c, _ = matrices()
    angle = np.vstack([c @ np.linalg.inv(a), [[0.0] * 5]])[:1]  # its derivative is the rate
    counted = control.ss(a, b, angle, angle @ np.linalg.solve(a, b) * 0.0, 0)
    held = control.c2d(counted, 0.02, "zoh")
    z = control.tf([1.0, 0.0], [1.0], 0.02)
    law = 1.0 + 0.6 * (1.0 - 1.0 / z) / 0.02
    whole = control.ss(held) * control.ss(law / z)
    hz = np.geomspace(0.05, 24.0, 60)
    np.testing.assert_allclose(loop.response(hz), whole(np.exp(2j * np.pi * hz * 0.02)), rtol=1e-9)
    z = np.exp(0.04j * np.pi * np.linspace(0.01, 24.999, 30_001))
    angles = np.linalg.solve(z[:, None, None] * np.eye(5) - held.A, held.B)[..., 0] @ held.C[0]
    values, found = angles / z * (1.0 + 0.6 * (1.0 - 1.0 / z) / 0.02), loop.margins()
    crossed = np.flatnonzero(np.diff(np.sign(values.imag)) * (values.real[1:] < 0.0))
    share = values.imag[crossed] / (values.imag[crossed] - values.imag[crossed + 1])
    real = values.real[crossed] + share * (values.real[crossed + 1] - values.real[crossed])
    assert found.gain_up_db.value == pytest.approx(min(-20.0 * np.log10(-real[real > -1.0])), abs=1e-4)
    assert found.gain_down_db.value == pytest.approx(20.0 * np.log10(K1 / A6 + 0.8 / MODE**2), abs=1e-6)
    assert found.modulus == pytest.approx(np.abs(1.0 + values).min(), rel=1e-4)  # of the grid
    assert loop.step(3.0).attitude_rad[-1] == pytest.approx(loop.step(8.0).attitude_rad[150], rel=1e-12)


def test_deviations_are_those_of_the_plant(folder: Path) -> None:
    s = 2j * np.pi * np.geomspace(0.05, 10.0, 30)
    point = own_point().with_(a6=0.5, k1=-1.0, omega=0.1, gain=1.2, delay_s=0.005)
    a, b, c, _ = matrices()
    a[1, 0], a[1, 4], a[3, 2], a[3, 3] = A6 + 0.5, K1 - 1.0, -(MODE**2) - 4.0, -0.02 * MODE - 0.002
    wanted = np.array([(c @ np.linalg.solve(x * np.eye(5) - a, b))[0, 0] for x in s]) * 1.2 * np.exp(-0.025 * s)
    loop = maxq.loop(point, folder / "pd.toml", kind="exact")
    np.testing.assert_allclose(loop.fixed.response(s.imag / 2.0 / np.pi), wanted, rtol=1e-9)
    (greensite,) = maxq.given_points("greensite", [72.0])
    moved = greensite.with_(mode_1_omega_radps=1.1, A6_1ps2=0.9)
    assert moved.omega_radps[0] == pytest.approx(1.1 * greensite.omega_radps[0])
    assert moved.derivatives.m_alpha_1ps2 == pytest.approx(0.9 * greensite.derivatives.m_alpha_1ps2)
    for wrong, said in (
        ({"k2": 1.0}, "k2 = 1 is no deviation; allowed: gain, delay_s, a6, k1, omega"),
        ({"delay_s": -0.03}, "delay_s = -0.01"),
    ):
        with pytest.raises(ValueError, match=said):
            own_point().with_(**wrong)


def test_the_worst_deviation_is_that_of_a_search_over_all_corners(folder: Path) -> None:
    design, point = maxq.load_design(folder / "pd.toml"), own_point()
    ranges = {"k1": 0.8, "omega": 0.3, "delay_s": 0.005}
    found = maxq.worst_point(point, design, ranges, kind="pade", starts=1)
    omega = np.sort(np.append(np.geomspace(0.05, 100.0, 2000), np.linspace(19.0, 21.0, 8000)))
    s, least = 1j * omega, np.inf
    for signs in itertools.product((-1.0, 0.0, 1.0), repeat=3):
        k1, w, late = (sign * half for sign, half in zip(signs, ranges.values(), strict=True))
        square, damping = MODE**2 + 2.0 * MODE * w, 0.02 * MODE + 0.02 * w
        rate = (K1 + k1) * s / (s * s - A6) - 0.8 * s / (s * s + damping * s + square)
        x = (0.02 + late) * s
        delay = (1.0 - x / 2.0 + x * x / 12.0) / (1.0 + x / 2.0 + x * x / 12.0)
        loop = rate * LAG / (s + LAG) * delay * (1.0 / s + 0.6)
        least = min(least, np.abs(1.0 + loop).min())
    assert found.modulus <= least + 1e-6
    assert found.modulus == pytest.approx(least, rel=2e-3)
    assert maxq.loop(found.point, design, kind="pade").margins().modulus == found.modulus
    assert found.modulus < maxq.loop(point, design, kind="pade").margins().modulus - 0.02
    small = maxq.given_points(folder / "small.toml", [20.0])[0]
    assert maxq.worst_point(small, design, {"K1_1ps2": 0.3, "gain": 0.1}, starts=1).tried > 5
    with pytest.raises(ValueError, match="ranges: thrust = 1; allowed are numbers above 0 for gain, delay_s, a6"):
        maxq.worst_point(point, design, {"thrust": 1.0})


def test_the_optimum_of_an_own_plant_is_not_improved_by_a_search_with_numpy(folder: Path) -> None:
    made = maxq.optimise(folder / "case.toml", points=[own_point()])
    assert made.meets_limits
    loop = made.loop()
    margins = loop.margins()
    assert (margins.gain_db >= 6.0 - 1e-3, margins.phase_deg.value >= 30.0 - 1e-3) == (True, True)
    omega = np.geomspace(0.05, 200.0, 3000)
    s = 1j * omega
    plant = launcher()(s) * np.exp(-0.02 * s)
    first = loop.law.filter.first_order[0]
    k_p, k_d = loop.law.gains["k_p"], loop.law.gains["k_d_s"]

    def least(p: float, d: float, zero: float, pole: float) -> float:
        lag = (1.0 + s / (2.0 * np.pi * zero)) / (1.0 + s / (2.0 * np.pi * pole))
        return float(np.abs(1.0 + plant * (p / s + d) * lag).min())

    mine = least(k_p, k_d, first.zero_hz, first.pole_hz)
    assert mine == pytest.approx(margins.modulus, rel=1e-4)
    rng, factors = np.random.default_rng(1), np.linspace(0.85, 1.15, 7)
    for p, d in itertools.product(factors, factors):
        zero, pole = (
            min(max(x * f, 2.0), 200.0)
            for x, f in zip((first.zero_hz, first.pole_hz), rng.uniform(0.7, 1.4, 2), strict=True)
        )
        stiff = (2.0 * np.pi * 0.2) ** 2 <= K1 * k_p * p
        damped = K1 * k_d * d / 2.0 / np.sqrt(K1 * k_p * p) >= 0.4
        bounded = zero >= pole  # no gain above 1 at infinity
        if stiff and damped and bounded:
            assert 20.0 * np.log10(least(k_p * p, k_d * d, zero, pole) / mine) < 0.05
    with pytest.raises(ValueError, match="matrices have no stability derivatives; give m_delta_1ps2"):
        maxq.optimise(folder / "case.toml", points=[maxq.point_of_matrices(*matrices(), time_s=10.0, delay_s=0.02)])


def test_wrong_plants_are_one_line(folder: Path) -> None:
    scipy.io.savemat(folder / "less.mat", {"A": [[0.0]], "B": [[1.0]]})
    (folder / "text.mat").write_text("not a file of MATLAB " * 20)
    discrete = control.ss([[0.5]], [[1.0]], [[1.0]], [[0.0]], 0.1)
    for system, more, said in (
        (folder / "less.mat", {}, "less.mat: has no C, D; allowed are A, B, C, D, or a struct of them"),
        (folder / "less.mat", {"variable": "plant"}, "variable = 'plant' is no struct; in the file: none"),
        (folder / "text.mat", {}, "text.mat: not a MATLAB file up to version 7.2"),
        (discrete, {}, "dt = 0.1: allowed is a continuous system"),
    ):
        with pytest.raises(ValueError, match=said):
            maxq.point_of_system(system, **more)
    with pytest.raises(FileNotFoundError):
        maxq.point_of_system(folder / "absent.mat")
    with pytest.raises(ValueError, match=r"deviations: k.a has the shape \(1, 1\); allowed are numbers of \(5, 5\)"):
        maxq.point_of_matrices(*matrices(), deviations={"k": {"a": [[1.0]]}})
    with pytest.raises(ValueError, match="points: 2 given; allowed are points of one plane with rising time_s"):
        maxq.optimise(folder / "case.toml", points=[own_point(), own_point()])
