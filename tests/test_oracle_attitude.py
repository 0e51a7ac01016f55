"""Attitude in the computer and its error equal SciPy's rotations and quadrature of the body rates.

| case | oracle |
|---|---|
| strapdown over a coning motion | product of ten thousand small SciPy rotations |
| attitude error at any attitude | SciPy: Euler angle of the roll, angle and axis between the noses |
| a flight that rolls by 90 deg | attitude of the programme's rates by `solve_ivp`; heading by its nose |
| a free body that spins and nutates, in flight | closed form of its motion, SciPy's rotations of the exact increments |
| metric of truth, gyro with a bias | bias times time |
"""

from __future__ import annotations

import math

import numpy as np
import pytest
from flightkit import Parts, load, scenario_of
from scipy.integrate import quad, solve_ivp
from scipy.spatial.transform import Rotation

from maxq.control.attitude import Strapdown, start_strapdown, turn
from maxq.control.computer import ComputerState, build_computer, computer_tick, start_computer
from maxq.control.kernel.jit import from_python
from maxq.control.kernel.records import Array, blank, pack
from maxq.control.kernel.tables import Pool
from maxq.sim.run.fly import fly
from maxq.sim.scenario.loader import load_scenario

turn_py, start_py = from_python(turn), from_python(start_strapdown)
SAMPLE_S = 0.01


def scipy_of(q: Array) -> Rotation:
    return Rotation.from_quat([q[1], q[2], q[3], q[0]])


def coning(sample_s: float, end_s: float) -> tuple[float, float]:
    """Return the strapdown error, rad, over rates linear in time within a few samples, with and without coning term."""
    rate = np.array([0.4, -0.7, 0.3]), np.array([1.1, 0.5, -0.9])

    def angle(t: float) -> Array:
        return np.array([a / 3.0 * math.sin(3.0 * t) + 0.5 * b * t * t for a, b in zip(*rate, strict=True)])

    state, plain = blank(Strapdown)[0], Rotation.identity()
    start_py(state)
    steps = round(end_s / sample_s)
    state.last_rad[:] = angle(0.0) - angle(-sample_s)
    for k in range(steps):
        increment = angle((k + 1) * sample_s) - angle(k * sample_s)
        turn_py(state, increment)
        plain = plain * Rotation.from_rotvec(increment)
    fine = 20_000
    exact = Rotation.identity()
    for rotation in Rotation.from_rotvec(np.diff([angle(t) for t in np.linspace(0.0, end_s, fine + 1)], axis=0)):
        exact = exact * rotation
    assert abs(np.linalg.norm(state.q) - 1.0) < 1e-14
    return tuple(float((exact.inv() * r).magnitude()) for r in (scipy_of(state.q), plain))


@pytest.mark.slow
def test_strapdown_with_its_coning_term_is_of_higher_order() -> None:
    coarse, fine = coning(0.02, 1.0), coning(0.01, 1.0)
    assert fine[0] < 0.02 * fine[1]  # the term takes off all of second order
    assert coarse[1] / fine[1] == pytest.approx(4.0, rel=0.05)
    assert coarse[0] / fine[0] == pytest.approx(8.0, rel=0.05)


def error_of(turned: Rotation) -> Array:
    """Return the roll error and the rotation vector in B that takes the commanded nose to the measured one."""
    nose, tilted = turned.inv().apply([1.0, 0.0, 0.0]), np.array([1.0, 0.0, 0.0])
    axis = np.cross(nose, tilted)
    tilt = axis / np.linalg.norm(axis) * math.acos(np.clip(nose @ tilted, -1.0, 1.0))
    unrolled = turned * Rotation.from_rotvec(tilt).inv()
    assert np.abs(unrolled.apply(tilted) - tilted).max() < 1e-7  # what is left is a roll
    return np.array([unrolled.as_rotvec()[0], *tilt[1:]])


def test_error_is_roll_and_tilt_from_commanded_to_measured() -> None:
    rng = np.random.default_rng(3)
    pool = Pool()
    computer = pack([build_computer(pool, sample_ns=10_000_000, angle_error_limit_rad=0.5)])[0]
    state = blank(ComputerState)[0]
    start_computer(computer, pool.array(), state, 0.0)
    measured, commanded, last_m, last_c = Rotation.identity(), Rotation.identity(), np.zeros(3), np.zeros(3)
    large = 0
    for k in range(400):
        m, c = rng.normal(scale=0.05, size=(2, 3))
        computer_tick(
            computer,
            pool.array(),
            state,
            SAMPLE_S * k,
            m,
            c / SAMPLE_S,
            np.zeros(3, np.int64),
            np.zeros(2),
            np.zeros(2, np.int64),
        )
        measured *= Rotation.from_rotvec(m + np.cross(last_m, m) / 12.0)
        commanded *= Rotation.from_rotvec(c + np.cross(last_c, c) / 12.0)
        last_m, last_c = m, c
        wanted = error_of(commanded.inv() * measured)
        if np.linalg.norm(wanted[1:]) < 3.1 and abs(wanted[0]) < 3.1:  # at 180 deg two are right
            large += np.linalg.norm(wanted) > 1.5
            assert np.abs(state.attitude.error_rad - wanted).max() < 1e-7  # of acos
            assert np.abs(state.attitude.theta_e_rad - np.clip(wanted, -0.5, 0.5)).max() < 1e-7
    assert large > 50


ROLL = (
    "run.duration_s=50",
    "vehicle.computer.attitude='quaternion'",
    'injection=[{kind = "step", at = "rate_command", axis = "roll", amplitude_degps = 9.0, start_s = 3, stop_s = 13}]',
)


@pytest.mark.slow
@pytest.mark.parametrize("axes", ["unrolled", "body"])
def test_a_roll_of_90_deg_ends_where_its_rates_mean(axes: str) -> None:
    flight = fly(load_scenario("nominal", (*ROLL, f"guidance.axes={axes}")))
    programme = load_scenario("nominal").scenario.guidance.programme
    assert programme is not None

    def pitch_radps(t: float) -> float:
        return float(np.interp(t, programme["time_s"], np.radians(programme["pitch_rate_degps"])))

    def derivative(t: float, q: Array) -> Array:
        w, p, r = q[0], q[1:], np.array([math.radians(9.0) * (3.0 <= t < 13.0), pitch_radps(t), 0.0])
        return 0.5 * np.concatenate([[-p @ r], w * r + np.cross(p, r)])

    if axes == "body":
        q, at_s = np.array([1.0, 0.0, 0.0, 0.0]), 0.0
        for until in (3.0, 13.0, 50.0):
            q, at_s = solve_ivp(derivative, (at_s, until), q, rtol=1e-10, atol=1e-12, max_step=0.1).y[:, -1], until
        turned = scipy_of(q / np.linalg.norm(q))
    else:
        pitch = quad(pitch_radps, 0.0, 50.0, limit=500, points=[5.0])[0]
        turned = Rotation.from_euler("YX", [pitch, math.pi / 2])
    start, true = (scipy_of(np.array([flight[f"q_BI_{c}"][k] for c in "wxyz"])) for k in (0, -1))
    error = np.degrees(error_of((start * turned).inv() * true))
    logged = [flight[f"attitude_error_{axis}_deg"][-1] for axis in ("roll", "pitch", "yaw")]
    assert np.abs(error - logged).max() < 2e-3  # rounding of the gyro's pulses and of the samples
    assert np.abs(error - [flight[f"error_{axis}_deg"][-1] for axis in ("roll", "pitch", "yaw")]).max() < 0.02
    if axes == "unrolled":  # the heading is what it is without a roll
        straight = fly(load_scenario("nominal", ROLL[:2]))
        assert flight["yaw_deg"][-1] == pytest.approx(straight["yaw_deg"][-1], abs=0.01)


@pytest.mark.slow
def test_requirements_see_what_the_computer_does_not() -> None:
    flight = fly(load_scenario("nominal", ("run.duration_s=50", "vehicle.stage.0.gyro.bias_degph=[0, 2000, 0]")))
    drift = 2000.0 / 3600.0 * 50.0
    assert flight.metrics["max_computer_attitude_error_deg"] < 4.0
    assert flight.metrics["max_attitude_error_deg"] == pytest.approx(drift, abs=4.0)


# --- a body that spins and nutates
SPIN, NUTATION, CONE_SAMPLE_S, CONE_S = 6.0, 0.5, 0.02, 6.0  # rad/s, s
INERTIA_KGM2 = 9.0e4, 5.0e4  # about x, about y and z
BODY_RADPS = SPIN * (INERTIA_KGM2[0] - INERTIA_KGM2[1]) / INERTIA_KGM2[1]  # of the transverse rate in body axes


def cone_angles(t: float) -> Array:
    """Return the integral of the body rates (p, w cos(n t), w sin(n t)) of a symmetric body without torque."""
    n = BODY_RADPS
    return np.array([SPIN * t, NUTATION / n * math.sin(n * t), NUTATION / n * (1.0 - math.cos(n * t))])


def test_the_computer_follows_a_body_that_cones() -> None:
    """The true attitude follows the closed form; the attitude in the computer follows equation (9.2).

    The drift in the computer is less than a tenth of that without the correction for coning.
    """
    around, across = INERTIA_KGM2
    parts = Parts(
        engine=False, core_inertia=((around, 0.0, 0.0), (0.0, across, 0.0), (0.0, 0.0, across)), core_cg=(7.0, 0.0, 0.0)
    )
    flight = fly(
        load(
            scenario_of(
                parts,
                vehicle={"computer": {"sample_s": CONE_SAMPLE_S, "delay_s": 0.0}},
                initial={"rate_BI_radps": [SPIN, NUTATION, 0.0]},
                switches={"gyro": "ideal", "converter": "ideal"},
                run={"duration_s": CONE_S + 0.5 * CONE_SAMPLE_S},  # half a sample after the last one
            )
        )
    )
    momentum = np.array([around * SPIN, across * NUTATION, 0.0]) / across
    exact = Rotation.from_rotvec(momentum * CONE_S) * Rotation.from_rotvec([-BODY_RADPS * CONE_S, 0.0, 0.0])
    at = int(np.searchsorted(flight.time_s("q_BI_x"), CONE_S - 1e-9))
    true = Rotation.from_quat([float(flight[f"q_BI_{name}"][at]) for name in "xyzw"])
    start = Rotation.from_quat([float(flight[f"q_BI_{name}"][0]) for name in "xyzw"])
    assert ((start * exact).inv() * true).magnitude() < 1e-8
    times = CONE_SAMPLE_S * np.arange(round(CONE_S / CONE_SAMPLE_S) + 1)
    angles = np.diff([cone_angles(t) for t in times], axis=0)
    ours, plain, before = Rotation.identity(), Rotation.identity(), np.zeros(3)
    for angle in angles:
        ours = ours * Rotation.from_rotvec(angle + np.cross(before, angle) / 12.0)
        plain, before = plain * Rotation.from_rotvec(angle), angle
    measured = Rotation.from_quat([float(flight[f"q_BR_measured_{name}"][-1]) for name in "xyzw"])
    assert (ours.inv() * measured).magnitude() < 1e-8
    assert (exact.inv() * measured).magnitude() < 0.1 * (exact.inv() * plain).magnitude()
