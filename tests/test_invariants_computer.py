"""The flight computer has causality, mirror symmetry, exact sums, injections, switches and checks of faulty inputs.

Run as a program, this module prints the bytes of a flight: the same source without Numba must print the same.
"""

from __future__ import annotations

import os
import subprocess
import sys
from fractions import Fraction
from typing import Any

import numpy as np
import pytest

from maxq.control.computer import ComputerState, build_computer, computer_tick, start_computer
from maxq.control.filters import BendingFilter, FirstOrderSection, QuadraticSection
from maxq.control.guidance import rate_programme
from maxq.control.kernel.records import Array, blank, pack
from maxq.control.kernel.tables import Pool
from maxq.control.laws.pd import GainSchedule, gains_table
from maxq.control.roll import make_roll

SAMPLE_NS = 10_000_000
SAMPLE_S = SAMPLE_NS / 1e9
ROLL, PITCH, YAW = 0, 1, 2
F3 = BendingFilter((QuadraticSection(9.0, 0.3, 7.0, 0.7),), (FirstOrderSection(30.0, 5.0),))


class Flown:
    """A computer with tables and state, ticked from Python."""

    def __init__(self, start_s: float = 0.0, **changed: Any) -> None:
        pool = Pool()
        settings: dict[str, Any] = {
            "sample_ns": SAMPLE_NS,
            "delay_ns": 3_000_000,
            "count_rad": 1e-5,
            "dac_step_rad": 1e-5,
            "attitude": "rate-integral",  # sums are exact, mirror images too
            "angle_error_limit_rad": 0.35,
            "command_limit_rad": 0.1,
            "gains": gains_table(GainSchedule([5.0, 55.0], [1.2, 0.7], [0.5, 0.3])),
            "programme": rate_programme([0.0, 3.0, 9.0], [0.0, -0.02, 0.01], 0.003, 0.01, "pchip"),
            "pitch_filter": F3.discretize(SAMPLE_S, "prewarped", 9.2),
            "roll": make_roll(SAMPLE_NS, 0.5, 0.017, 0.003, 0.02),
        }
        self.computer = pack([build_computer(pool, **settings | changed)])[0]
        self.pool = pool.array()
        self.state = blank(ComputerState)[0]
        self.start_s, self.samples = start_s, 0
        start_computer(self.computer, self.pool, self.state, start_s)

    def tick(
        self,
        increment_rad: Any = (0.0, 0.0, 0.0),
        rate_radps: Any = (0.0, 0.0, 0.0),
        rate_replaces: Any = (0, 0, 0),
        gimbal_rad: Any = (0.0, 0.0),
        gimbal_replaces: Any = (0, 0),
    ) -> Array:
        """Return the command of pitch and yaw, and the roll demand."""
        self.samples += 1
        computer_tick(
            self.computer,
            self.pool,
            self.state,
            self.start_s + self.samples * SAMPLE_S,
            np.array(increment_rad, float),
            np.array(rate_radps, float),
            np.array(rate_replaces, np.int64),
            np.array(gimbal_rad, float),
            np.array(gimbal_replaces, np.int64),
        )
        return np.array([*self.state.command_rad, self.state.roll.demand])

    def fly(self, increments_rad: Array) -> Array:
        return np.array([self.tick(increment_rad) for increment_rad in increments_rad])


def noise(seed: int = 1, samples: int = 400) -> Array:
    return np.random.default_rng(seed).normal(scale=3e-3, size=(samples, 3))


@pytest.mark.slow
@pytest.mark.parametrize("k", [pytest.param(1, marks=pytest.mark.long), 50, 399])
def test_a_command_depends_on_no_later_increment(k: int) -> None:
    first, second = noise(1), noise(2)
    second[:k] = first[:k]
    one, other = Flown().fly(first), Flown().fly(second)
    np.testing.assert_array_equal(one[:k], other[:k])
    assert (one[k:] != other[k:]).any()


def test_a_command_depends_on_the_increment_of_its_own_sample() -> None:
    changed = noise()
    changed[200, PITCH] += 0.01
    assert Flown().fly(noise())[200, 0] != Flown().fly(changed)[200, 0]


def test_start_forgets_everything() -> None:
    flown = Flown()
    before = flown.state.tobytes()
    first = flown.fly(noise())
    start_computer(flown.computer, flown.pool, flown.state, 0.0)
    assert flown.state.tobytes() == before
    flown.samples = 0
    np.testing.assert_array_equal(flown.fly(noise()), first)


def test_a_mirrored_flight_gives_mirrored_commands() -> None:
    upright = Flown(programme=rate_programme([0.0, 9.0], [0.01, -0.02], [0.0, 0.03], 0.01))
    mirrored = Flown(programme=rate_programme([0.0, 9.0], [-0.01, 0.02], [0.0, -0.03], -0.01))
    np.testing.assert_array_equal(upright.fly(noise()), -mirrored.fly(-noise()))


def test_pitch_and_yaw_are_alike() -> None:
    flown = Flown(programme=None)
    same = noise()
    same[:, YAW] = same[:, PITCH]
    commands = flown.fly(same)
    np.testing.assert_array_equal(commands[:, 0], commands[:, 1])


def test_yaw_may_have_its_own_filter() -> None:
    none = BendingFilter().discretize(SAMPLE_S)
    flown = Flown(programme=None, yaw_filter=none)
    for increment_rad in noise():
        flown.tick(increment_rad)
        assert flown.state.law.pd.filtered_rad[1] == flown.state.law.pd.pd_rad[1]
    assert flown.state.law.pd.filtered_rad[0] != flown.state.law.pd.pd_rad[0]


@pytest.mark.slow
def test_angle_error_is_the_exact_sum() -> None:
    """After 10,000 samples, counted less commanded angle is exact to the rounding of one subtraction."""
    flown = Flown(angle_error_limit_rad=np.inf, programme=rate_programme([0.0, 9.0], [0.02, -0.01]), pitch_filter=None)
    total = 0
    for increment_rad in np.tile(noise(samples=1000), (10, 1)):
        flown.tick(increment_rad)
        total += int(flown.state.converter.counts[PITCH])
    commanded = Fraction(45, 1000) - Fraction(1, 100) * (Fraction(10_000, 100) - 9)
    exact = float(total * Fraction(1e-5) - commanded)
    assert flown.state.attitude.theta_e_rad[PITCH] == pytest.approx(exact, abs=1e-13)


def test_law_sees_counts_only() -> None:
    """Rate and error are whole pulses: the law gets no fraction of a pulse."""
    flown = Flown(programme=None, angle_error_limit_rad=np.inf)
    for increment_rad in noise(samples=50):
        flown.tick(increment_rad)
        converter, attitude = flown.state.converter, flown.state.attitude
        np.testing.assert_array_equal(attitude.rate_radps, converter.counts * 1e-5 / SAMPLE_S)
        np.testing.assert_array_equal(attitude.theta_e_rad, converter.total_counts * 1e-5)
        assert (converter.residual_rad != 0).all()


def test_programme_starts_with_the_flight() -> None:
    """In a flight that starts during the burn, the commanded angle is the integral of the programme from there."""
    flown = Flown(start_s=4.0, programme=rate_programme([0.0, 10.0], [0.0, 0.1]))
    for _ in range(100):
        flown.tick()
    assert flown.state.guidance.angle_rad[PITCH] == pytest.approx(0.005 * (25.0 - 16.0), rel=1e-12)
    assert flown.state.guidance.rate_radps[PITCH] == pytest.approx(0.01 * 4.995, rel=1e-9)


def test_injected_rate_adds_to_or_replaces_the_programme() -> None:
    programme = rate_programme([0.0], [0.02], 0.03)
    flown = Flown(programme=programme)
    for _ in range(100):
        flown.tick(rate_radps=(0.1, 0.1, 0.1), rate_replaces=(0, 0, 1))
    assert flown.state.guidance.angle_rad == pytest.approx([0.1, 0.12, 0.1], rel=1e-12)
    assert flown.state.guidance.rate_radps == pytest.approx([0.1, 0.12, 0.1], rel=1e-9)
    for _ in range(100):
        flown.tick()
    assert flown.state.guidance.angle_rad == pytest.approx([0.1, 0.14, 0.13], rel=1e-12)
    assert flown.state.attitude.theta_e_rad == pytest.approx([-0.1, -0.14, -0.13], rel=1e-12)


def test_injected_gimbal_command_adds_or_replaces_before_limit_and_dac() -> None:
    flown = Flown(programme=None, dac_step_rad=0.001)
    flown.tick((0.0, 0.002, 0.002), gimbal_rad=(0.05, 0.05), gimbal_replaces=(0, 1))
    state = flown.state
    assert state.requested_rad[0] == state.law.pd.filtered_rad[0] + 0.05
    assert state.requested_rad[1] == 0.05
    assert flown.state.command_rad[1] == pytest.approx(0.05, abs=1e-15)
    assert abs(flown.state.command_rad[0] - state.requested_rad[0]) <= 0.0005
    assert list(flown.tick(gimbal_rad=(9.0, -9.0), gimbal_replaces=(1, 1))[:2]) == pytest.approx([0.1, -0.1])
    assert list(state.command_limited) == [1, 1]


def test_filter_goes_on_while_its_output_is_replaced() -> None:
    plain, replaced = Flown(), Flown()
    for increment_rad in noise(samples=50):
        plain.tick(increment_rad)
        replaced.tick(increment_rad, gimbal_rad=(0.01, 0.01), gimbal_replaces=(1, 1))
    np.testing.assert_array_equal(plain.tick(), replaced.tick())


def test_switches() -> None:
    off = Flown(control_on=False)
    commands = off.fly(noise())
    assert (commands[:, :2] == 0).all()
    assert off.tick(gimbal_rad=(0.01, 0.0))[0] == pytest.approx(0.01)
    assert off.state.attitude.theta_e_rad[PITCH] != 0

    off = Flown(guidance_on=False)
    off.fly(noise())
    assert (off.state.guidance.angle_rad == 0).all()
    off.tick(rate_radps=(0.0, 1.0, 0.0))
    assert off.state.guidance.angle_rad[PITCH] == SAMPLE_S

    turning = np.tile([0.01, 0.0, 0.0], (100, 1))
    assert (Flown(roll_on=False).fly(turning)[:, 2] == 0).all()
    assert (Flown(roll=None).fly(turning)[:, 2] == 0).all()
    assert (Flown().fly(turning)[5:, 2] == -1).all()


def test_without_a_design_the_command_is_zero() -> None:
    flown = Flown(gains=None, pitch_filter=None, roll=None)
    assert (flown.fly(noise()) == 0).all()


@pytest.mark.parametrize("fault", [np.nan, np.inf, -np.inf, 1e300])
def test_a_faulty_input_counts_as_zero(fault: float) -> None:
    flown, sound = Flown(), Flown()
    flown.fly(noise(samples=20))
    sound.fly(noise(samples=20))
    flown.tick((fault, 0.001, fault), (fault, 0.0, 0.0), gimbal_rad=(0.0, fault))
    sound.tick((0.0, 0.001, 0.0))
    assert flown.state.invalid_inputs == 4
    assert sound.state.invalid_inputs == 0
    np.testing.assert_array_equal(flown.fly(noise(3)), sound.fly(noise(3)))


def flight_bytes() -> str:
    """Return the commands and final state of a flight with all components active, as hexadecimal digits."""
    flown = Flown(command_limit_rad=0.02, angle_error_limit_rad=0.05)
    out = []
    for k, increment_rad in enumerate(noise(5)):
        out.append(flown.tick(increment_rad, (0.01, 0, 0.02), (0, 0, k % 2), (1e-3, 0), (0, k > 300)))
    return (np.array(out).tobytes() + flown.state.tobytes()).hex()


@pytest.mark.slow
def test_plain_python_gives_the_same_bits() -> None:
    done = subprocess.run(
        [sys.executable, __file__],
        env={**os.environ, "NUMBA_DISABLE_JIT": "1"},
        capture_output=True,
        text=True,
        check=True,
    )
    assert done.stdout.strip() == flight_bytes()


if __name__ == "__main__":
    print(flight_bytes())
