"""Bode, Nichols, sensitivity, step, gust and root locus of a loop equal those of python-control, SLICOT and SciPy."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import control
import matplotlib.pyplot as plt
import numpy as np
import pytest
import scipy.io
import scipy.linalg
import scipy.optimize
from matplotlib.axes import Axes
from test_usage_given_points import PD, SMALL

import maxq
from maxq import AnalysedLoop
from maxq.design.loop.fixed_path import KINDS
from maxq.design.model.state_space import StateSpace

HZ = np.geomspace(0.02, 49.0, 80)


@pytest.fixture(scope="module")
def loops() -> dict[str, AnalysedLoop]:
    """Return the loop of a shipped design in yaw at 40 s, of each kind."""
    design = maxq.load_design("designs/ksr3-default")
    node = maxq.nodes("nominal", [40.0], plane="yaw")
    return {kind: maxq.loops(node, design, kind=kind)[0] for kind in KINDS}


def of_control(system: StateSpace, dt: float | None) -> Any:
    """Return a system for python-control, balanced: without scaling, its solution loses a digit at the slosh."""
    a, (scale, _) = scipy.linalg.matrix_balance(system.a, permute=False, separate=True)
    return control.StateSpace(a, (system.b.T / scale).T, system.c * scale, system.d, dt or 0)


def whole(loop: AnalysedLoop) -> Any:
    given = loop.to_control()
    return of_control(
        StateSpace(given.A, given.B, given.C, given.D, *map(tuple, (given.state_labels, "u", "y"))), given.dt
    )


def halves(loop: AnalysedLoop) -> tuple[Any, Any]:
    """Return path (command to angle and rate) and law (angle and rate to command) as systems of python-control."""
    path = of_control(loop.fixed.measured(loop.law.inputs), loop.sample_s)
    return path, of_control(loop.law.state_space(), loop.sample_s)


def at(system: Any, hz: np.ndarray) -> np.ndarray:
    return np.asarray(system(np.exp(2j * np.pi * hz * system.dt) if system.dt else 2j * np.pi * hz))


def exact_parts(loop: AnalysedLoop, s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the path to the mean rate and the law on it at complex s, from plant matrices and the printed formulas."""
    timing, plant = loop.fixed.node.instruments, of_control(loop.fixed.continuous, None)
    mean = (1.0 - np.exp(-s * timing.sample_s)) / (s * timing.sample_s)
    path = plant(s) * mean**2 * np.exp(-s * timing.delay_s)
    law = loop.law.gains["k_p"] / s + loop.law.gains["k_d_s"]
    for zero, pole in ((f.zero_hz, f.pole_hz) for f in loop.law.filter.first_order):
        law = law * (1.0 + s / (2.0 * np.pi * zero)) / (1.0 + s / (2.0 * np.pi * pole))
    for q in loop.law.filter.quadratic:
        z, p = s / (2.0 * np.pi * q.zero_hz), s / (2.0 * np.pi * q.pole_hz)
        law = law * (z * z + 2.0 * q.zero_zeta * z + 1.0) / (p * p + 2.0 * q.pole_zeta * p + 1.0)
    return path, law


def inverted(transform: Any, t: np.ndarray, shift: float) -> np.ndarray:
    """Return the inverse Laplace transform at times by a Fourier series (Dubner & Abate, J. ACM 15, 1968)."""
    period, count = 2.0 * t[-1], 12_000
    s = shift + 1j * np.pi * np.arange(count) / period
    values = transform(s)
    values[0] *= 0.5
    turns = np.exp(1j * np.pi * np.outer(t, np.arange(count)) / period)
    return np.asarray(np.exp(shift * t) / period * (turns * values).real.sum(axis=1))


def test_bode_and_nichols_are_those_of_python_control(loops: dict[str, AnalysedLoop]) -> None:
    for kind, loop in loops.items():
        if kind == "exact":
            path, law = exact_parts(loop, 2j * np.pi * HZ)
            wanted = path * law
        else:
            wanted = at(whole(loop), HZ)
            np.testing.assert_allclose(at(loop.to_control(), HZ), wanted, rtol=1e-8)
        bode, nichols = loop.bode(HZ), loop.nichols(HZ)
        np.testing.assert_allclose(bode.response, wanted, rtol=1e-9)
        np.testing.assert_allclose(bode.magnitude_db, 20.0 * np.log10(np.abs(wanted)), atol=1e-8)
        turned = np.degrees(np.unwrap(np.angle(wanted)))
        whole_turns = 360.0 * round((bode.phase_deg[0] - turned[0]) / 360.0)
        np.testing.assert_allclose(bode.phase_deg - turned, whole_turns, atol=1e-7)
        assert ((nichols.phase_deg >= -360.0) & (nichols.phase_deg <= 0.0)).all()
        np.testing.assert_allclose(
            10.0 ** (nichols.magnitude_db / 20.0) * np.exp(1j * np.radians(nichols.phase_deg)), wanted, rtol=1e-9
        )
        every = loop.bode().response
        steps = np.abs(np.diff(np.unwrap(np.angle(every))))[np.abs(every[1:]) > 0.01]
        assert steps.max() < np.radians(4.1), "every resonance is resolved"
    frd = loops["exact"].to_control(HZ)
    np.testing.assert_allclose(frd.complex.ravel(), wanted, rtol=1e-9)


def test_sensitivities_are_those_of_python_control_and_their_peaks_of_slicot(loops: dict[str, AnalysedLoop]) -> None:
    for kind in ("sampled", "pade"):
        loop = loops[kind]
        path, law = halves(loop)
        found, system = loop.sensitivity(HZ), whole(loop)
        s = control.feedback(1, system)
        np.testing.assert_allclose(found.s, at(s, HZ), rtol=1e-9)
        np.testing.assert_allclose(found.t, at(control.feedback(system, 1), HZ), rtol=1e-8)
        rate = np.asarray(path(np.exp(2j * np.pi * HZ * path.dt) if path.dt else 2j * np.pi * HZ))[:, 0]
        angle, mean = rate[loop.law.inputs.index("angle_rad")], rate[loop.law.inputs.index("rate_radps")]
        np.testing.assert_allclose(found.ps, mean * at(s, HZ), rtol=1e-8)
        axis = np.exp(2j * np.pi * HZ * law.dt) if law.dt else 2j * np.pi * HZ
        by_angle, by_rate = np.asarray(law(axis))[0]
        np.testing.assert_allclose(found.cs, (by_angle * angle / mean + by_rate) * at(s, HZ), rtol=1e-8)
        if kind == "pade":
            pytest.importorskip("slycot")
            assert found.peak_s == pytest.approx(control.linfnorm(s)[0], rel=1e-7)
            assert found.peak_t == pytest.approx(control.linfnorm(control.feedback(system, 1))[0], rel=1e-7)
    assert loops["exact"].sensitivity().peak_s == pytest.approx(1.0 / loops["exact"].margins().modulus, rel=1e-12)


def test_steps_are_those_of_python_control(loops: dict[str, AnalysedLoop]) -> None:
    """The response has no step error, so that only rounding remains: 1e-9 of the largest value."""
    for kind in ("sampled", "pade"):
        loop = loops[kind]
        path, law = halves(loop)
        found = loop.step(4.0)
        commanded = law * control.StateSpace([], [], [], np.array([[1.0], [0.0]]), law.dt)
        closed = control.feedback(path, law) * commanded
        wanted = control.step_response(closed, found.time_s).outputs[0, 0]
        np.testing.assert_allclose(found.attitude_rad, wanted, atol=1e-9)
        disturbed = loop.step(4.0, of="gimbal")
        s = control.feedback(1, loop.to_control())
        np.testing.assert_allclose(disturbed.gimbal_rad, control.step_response(s, disturbed.time_s).outputs, atol=1e-9)
        assert found.attitude_rad[-1] != pytest.approx(wanted[-1] * 1.001, abs=1e-5)


def test_a_step_of_the_exact_kind_is_the_inverse_laplace_transform(loops: dict[str, AnalysedLoop]) -> None:
    loop = loops["exact"]
    found = loop.step(4.0)
    k = np.arange(40, len(found.time_s), 60)

    def transform(s: np.ndarray) -> np.ndarray:
        path, law = exact_parts(loop, s)
        by_angle = law * loop.law.gains["k_p"] / (loop.law.gains["k_p"] / s + loop.law.gains["k_d_s"])
        return np.asarray(by_angle * path / s / (1.0 + law * path) / s)

    np.testing.assert_allclose(found.attitude_rad[k], inverted(transform, found.time_s[k], 2.5), atol=2e-6)


def test_a_gust_is_that_of_a_plant_integrated_between_the_samples(tmp_path: Path) -> None:
    """A simulation in small steps of gust and plant, with the law at each sample, gives the same motion."""
    (tmp_path / "small.toml").write_text(SMALL)
    (point,) = maxq.given_points(tmp_path / "small.toml", [20.0])
    (tmp_path / "pd.toml").write_text(PD)
    loop = maxq.loop(point, tmp_path / "pd.toml")
    found = loop.gust(6.0, 450.0, duration_s=4.0)
    plant, timing, speed = point.plant_in_wind(), point.instruments, point.condition.airspeed_mps
    fine, end_s = 40, 450.0 / speed
    h = timing.sample_s / fine
    both = np.zeros((6, 6))
    both[:3, :3], both[:3, 3:5] = plant.a, plant.b
    both[:3, 5], both[3:5, 5] = 0.0, 0.0
    step = scipy.linalg.expm(both * h)
    x, u, waiting, angle, last_theta = np.zeros(3), 0.0, [], 0.0, 0.0
    theta, q = plant.states.index("theta_rad"), plant.states.index("q_radps")
    attitude, gimbal, alpha = [], [], []
    assert q == 1
    for n in range(len(found.time_s)):
        rate = (x[theta] - last_theta) / timing.sample_s  # mean over the past sample
        angle, last_theta = angle + x[theta] - last_theta, x[theta]
        command = -(1.0 * angle + 0.6 * rate)
        attitude.append(angle)
        gimbal.append(command)
        waiting.append((n * fine + round(timing.delay_s / h), command))
        across = 0.0
        for k in range(fine):
            while waiting and waiting[0][0] <= n * fine + k:
                u = waiting.pop(0)[1]
            t = (n * fine + k + 0.5) * h
            wind = 3.0 * (1.0 - np.cos(2.0 * np.pi * t / end_s)) if t < end_s else 0.0
            before, x = x, (step @ np.concatenate([x, [u, wind, 0.0]]))[:3]
            across += (0.5 * (before[0] + x[0]) - wind) / fine
        alpha.append(across / speed)
    size = np.abs(attitude).max()
    np.testing.assert_allclose(found.attitude_rad, attitude, atol=2e-4 * size)
    np.testing.assert_allclose(found.gimbal_rad, gimbal, atol=5e-4 * np.abs(gimbal).max())
    np.testing.assert_allclose(found.alpha_rad[1:], alpha[:-1], atol=5e-4 * np.abs(alpha).max())
    continuous = maxq.loop(point, tmp_path / "pd.toml", kind="exact").gust(6.0, 450.0, duration_s=4.0)
    there = np.interp(found.time_s - 0.5 * timing.sample_s, continuous.time_s, continuous.alpha_rad)
    np.testing.assert_allclose(found.alpha_rad, there, atol=2e-3 * np.abs(there).max())  # sums lead


def test_a_gust_of_each_continuous_kind_is_the_same_within_the_approximants(loops: dict[str, AnalysedLoop]) -> None:
    exact, pade = (loops[kind].gust(duration_s=6.0) for kind in ("exact", "pade"))
    np.testing.assert_allclose(pade.alpha_rad, exact.alpha_rad, atol=2e-4 * np.abs(exact.alpha_rad).max())


def test_the_root_locus_is_that_of_python_control(loops: dict[str, AnalysedLoop]) -> None:
    gains = np.array([0.0, 0.1, 0.5, 1.0, 2.0, 5.0])
    for kind in ("sampled", "pade"):
        loop = loops[kind]
        found, system = loop.rlocus(gains), whole(loop)
        wanted = [control.feedback(gain * system, 1).poles() for gain in gains]
        mine = np.exp(found.poles * loop.sample_s) if loop.sample_s else found.poles
        for ours, theirs in zip(mine, wanted, strict=True):
            ours = np.nan_to_num(ours)  # noqa: PLW2901  # a pure delay is the pole z = 0
            cost = np.abs(ours[:, None] - theirs[None, :]) / (1.0 + np.abs(theirs))
            rows, columns = scipy.optimize.linear_sum_assignment(cost)
            assert cost[rows, columns].max() < 1e-7
        closest = [np.abs(found.at(1.0) - p).min() / abs(p) for p in loop.closed_poles()]
        assert max(closest) < 1e-6
    exact = loops["exact"].rlocus(gains[1:])
    for gain, row in zip(exact.gains, exact.poles, strict=True):
        path, law = exact_parts(loops["exact"], row[np.isfinite(row)])
        np.testing.assert_allclose(gain * path * law, -1.0, atol=1e-5)
    with pytest.raises(ValueError, match="allowed is a list of finite numbers from 0"):
        loops["pade"].rlocus([-1.0])


def test_a_mat_file_has_the_same_loop(loops: dict[str, AnalysedLoop], tmp_path: Path) -> None:
    for kind, loop in loops.items():
        path = loop.to_mat(tmp_path / f"{kind}.mat", HZ)
        node = scipy.io.loadmat(path, squeeze_me=True, struct_as_record=False)["nodes"]
        assert (node.axis, node.kind, node.time_s) == ("yaw", kind, 40.0)
        np.testing.assert_allclose(node.response, loop.response(HZ), rtol=1e-12)
        if kind != "exact":
            own = node.loop
            system = control.StateSpace(own.A, own.B[:, None], own.C[None], own.D, own.sample_time_s or 0)
            np.testing.assert_allclose(at(system, HZ), node.response, rtol=1e-8)
        assert hasattr(node, "loop") == (kind != "exact")


def test_every_analysis_draws_into_given_axes(loops: dict[str, AnalysedLoop]) -> None:
    loop = loops["exact"]
    figure, places = plt.subplots(4, 2)
    drawn = [*loop.bode().plot(places[0]), loop.nichols().plot(places[1, 0]), loop.sensitivity(HZ).plot(places[1, 1])]
    drawn += [*loop.step(1.0).plot(places[2]), loop.rlocus([0.5, 1.0]).plot(places[3, 0])]
    assert [place in figure.axes for place in drawn] == [True] * len(drawn)
    assert all(isinstance(place, Axes) and place.lines for place in drawn)
    plt.close(figure)
    assert len(loop.gust(duration_s=1.0).plot()) == 3
    with pytest.raises(ValueError, match="axes: 1 given; allowed are 2"):
        loop.bode().plot([places[3, 1]])
    with pytest.raises(ValueError, match="outside the loop; allowed is a list above 0 to 50 Hz"):
        loops["sampled"].bode([60.0])
    with pytest.raises(ValueError, match="allowed are attitude, gimbal"):
        loop.step(of="wind")  # type: ignore[arg-type]  # wrong input


def test_an_operating_point_without_wind_says_so() -> None:
    point = maxq.point_of_matrices([[0.0, 1.0], [2.0, 0.0]], [[0.0], [4.0]], [[0.0, 1.0]], sample_s=0.01)
    with pytest.raises(ValueError, match="operating point at 0 s: a gust needs an airspeed above 0"):
        maxq.loop(point, "ksr3-default").gust()
