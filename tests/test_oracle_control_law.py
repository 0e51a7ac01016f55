"""The PD law in closed loop with a double integrator agrees with closed forms.

| quantity | oracle |
|---|---|
| command of given angle and rate | eq 33 by hand |
| sampled flight, every sample | powers of the closed loop's matrix, written down separately |
| sampled flight, sample towards 0 | response of s² + 2 ζ ω s + ω², eqs 35-36, approached at first order |
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from maxq.control.computer import ComputerState, build_computer, computer_tick, start_computer
from maxq.control.kernel.records import Array, blank, pack
from maxq.control.kernel.tables import Pool
from maxq.control.laws.pd import GainSchedule, gains_table

M_DELTA, K_P, K_D_S = 9.0, 1.1, 0.45  # of the order of Table 2
PITCH, YAW = 1, 2


def computer_of(sample_ns: int, gains: GainSchedule, yaw: GainSchedule | None = None, **more: Any) -> Any:
    pool = Pool()
    computer = pack([build_computer(pool, sample_ns=sample_ns, gains=gains_table(gains, yaw), **more)])[0]
    state = blank(ComputerState)[0]
    start_computer(computer, pool.array(), state, 0.0)
    return computer, pool.array(), state


def constant(k_p: float = K_P, k_d_s: float = K_D_S) -> GainSchedule:
    return GainSchedule([0.0], [k_p], [k_d_s])


def tick(flown: Any, time_s: float, increment_rad: Array, gimbal_rad: Array | None = None) -> Array:
    computer, pool, state = flown
    zero3, none3, none2 = np.zeros(3), np.zeros(3, np.int64), np.zeros(2, np.int64)
    injected = np.zeros(2) if gimbal_rad is None else gimbal_rad
    computer_tick(computer, pool, state, time_s, increment_rad, zero3, none3, injected, none2)
    return np.array(state.command_rad)


def fly(axis: int, sample_ns: int, duration_s: float, **more: Any) -> Array:
    """Return the angles, rad, at the samples of q' = M_delta delta with held commands, from 0 rad and 0.1 rad/s."""
    flown = computer_of(sample_ns, constant(), **more)
    sample_s = sample_ns / 1e9
    angle, rate, delta, angles = 0.0, 0.1, 0.0, [0.0]
    for k in range(1, round(duration_s / sample_s) + 1):
        increment = np.zeros(3)
        increment[axis] = rate * sample_s + 0.5 * M_DELTA * delta * sample_s**2
        angle += increment[axis]
        rate += M_DELTA * delta * sample_s
        delta = tick(flown, k * sample_s, increment)[axis - 1]
        angles.append(angle)
    return np.array(angles)


@pytest.mark.slow
@pytest.mark.parametrize("axis", [PITCH, YAW])
def test_sampled_closed_loop(axis: int) -> None:
    """The state is z_k = (theta, q, previous theta); delta_k = -k_p theta - k_d (theta - previous theta)/T."""
    t = 0.01
    feedback = np.array([-K_P - K_D_S / t, 0.0, K_D_S / t])
    free = np.array([[1.0, t, 0.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]])
    # The first sample passes without a command.
    z, expected = np.array([0.1 * t, 0.1, 0.0]), [0.0, 0.1 * t]
    loop = free + np.outer([0.5 * M_DELTA * t**2, M_DELTA * t, 0.0], feedback)
    for _ in range(399):
        z = loop @ z
        expected.append(z[0])
    np.testing.assert_allclose(fly(axis, 10_000_000, 4.0), expected, rtol=0, atol=1e-14)


@pytest.mark.slow
def test_closed_loop_approaches_equations_35_and_36() -> None:
    omega = math.sqrt(M_DELTA * K_P)  # eq 35
    zeta = 0.5 * K_D_S * math.sqrt(M_DELTA / K_P)  # eq 36
    damped = omega * math.sqrt(1 - zeta**2)
    instants = np.arange(0, 3.0001, 0.1)
    exact = 0.1 / damped * np.exp(-zeta * omega * instants) * np.sin(damped * instants)
    flown = {ms: fly(PITCH, 1_000_000 * ms, 3.0)[:: 100 // ms] for ms in (1, 2)}
    error = {ms: float(np.abs(flown[ms] - exact).max()) for ms in flown}
    assert error[2] / error[1] == pytest.approx(2.0, rel=0.02)
    extrapolated = 2 * flown[1] - flown[2]
    assert np.abs(extrapolated - exact).max() < 3e-5 * np.abs(exact).max()


@pytest.mark.parametrize("axis", [PITCH, YAW])
def test_positive_error_gives_negative_command(axis: int) -> None:
    for gains in (constant(1.0, 0.0), constant(0.0, 0.1)):
        increment = np.zeros(3)
        increment[axis] = 0.01
        command = tick(computer_of(10_000_000, gains), 0.01, increment)
        assert command[axis - 1] < 0
        assert command[2 - axis] == 0


def test_command_is_equation_33_with_gains_of_the_moment() -> None:
    pitch = GainSchedule([5.0, 55.0], [1.2, 0.7], [0.5, 0.3])
    yaw = GainSchedule([0.0, 30.0, 40.0], [2.0, 1.0, 3.0], [0.1, 0.2, 0.6])
    for time_s in (0.0, 5.0, 30.0, 37.5, 80.0):
        flown = computer_of(10_000_000, pitch, yaw)
        command = tick(flown, time_s, np.array([0.0, 0.002, -0.003]))
        for gimbal, (gains, angle) in enumerate(((pitch, 0.002), (yaw, -0.003))):
            k_p = np.interp(time_s, gains.at, gains.k_p)
            k_d = np.interp(time_s, gains.at, gains.k_d_s)
            assert command[gimbal] == pytest.approx(-k_p * angle - k_d * angle / 0.01, rel=1e-12)
            assert flown[2].law.pd.k_p[gimbal] == pytest.approx(k_p, rel=1e-12)
            assert flown[2].law.pd.k_d_s[gimbal] == pytest.approx(k_d, rel=1e-12)


@pytest.mark.parametrize("attitude", ["quaternion", "rate-integral"])
def test_the_limit_of_the_error_moves_no_reference(attitude: str) -> None:
    assert np.abs(fly(PITCH, 10_000_000, 0.5, attitude=attitude, angle_error_limit_rad=0.01)).max() > 0.015
    assert fly(PITCH, 10_000_000, 20.0, attitude=attitude, angle_error_limit_rad=0.01)[-1] == pytest.approx(0, abs=1e-6)
    flown = computer_of(10_000_000, constant(1.0, 0.0), attitude=attitude, angle_error_limit_rad=0.3)
    for increment, error, theta_e in ((0.2, 0.2, 0.2), (0.3, 0.5, 0.3), (-0.1, 0.4, 0.3), (-0.9, -0.5, -0.3)):
        tick(flown, 0.0, np.array([0.0, increment, 0.0]))
        assert flown[2].attitude.error_rad[PITCH] == pytest.approx(error, abs=1e-15)
        assert flown[2].attitude.theta_e_rad[PITCH] == pytest.approx(theta_e, abs=1e-15)


@pytest.mark.slow
@pytest.mark.parametrize("limit_rad", [0.1, 0.1003])
def test_command_keeps_to_limit_and_dac_steps(limit_rad: float) -> None:
    step_rad = 0.001
    flown = computer_of(10_000_000, constant(), command_limit_rad=limit_rad, dac_step_rad=step_rad)
    for requested in np.linspace(-0.15, 0.15, 1001):
        command = tick(flown, 0.0, np.zeros(3), np.array([requested, -requested]))
        assert command[0] == -command[1]
        assert abs(command[0]) <= limit_rad * (1 + 1e-12)
        assert abs(command[0] / step_rad - round(command[0] / step_rad)) < 1e-9
        within = min(max(requested, -limit_rad), limit_rad)
        assert abs(command[0] - within) <= 0.5 * step_rad * (1 + 1e-9)
        assert flown[2].command_limited[0] == (abs(requested) > limit_rad)
    assert command[0] == pytest.approx(0.1, rel=1e-12)


def test_refused_gains() -> None:
    with pytest.raises(ValueError, match="gains of pitch: k_p has 1 values: allowed is 2"):
        gains_table(GainSchedule([0.0, 1.0], [1.0], [1.0, 1.0]))
    with pytest.raises(ValueError, match="gains of yaw: k_d_s has 2 values: allowed is 1"):
        gains_table(constant(), GainSchedule([0.0], [1.0], [1.0, 2.0]))
    with pytest.raises(ValueError, match="finite"):
        gains_table(constant(math.nan))
