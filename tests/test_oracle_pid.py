"""The PID law agrees with SciPy's filters, its state matrix and complex-step gradients.

| quantity | oracle |
|---|---|
| command of the computer, no limit reached | cumulative sums, `scipy.signal.lfilter` of the bending filter |
| standing error under a constant torque | final value: none with an integral, torque / (M_delta k_p) without |
| sum while the command is limited | closed loop without anti-windup, which overshoots more |
| response of the loop | (zI - A)^-1 of its state matrix; margins' stability against closed poles |
| gradient by the law's parameters | complex step on ln|L| and arg L in pairs of real numbers |
| least and largest corner of the integral | k_i / (2 pi k_p) at all operating points of the optimum |
"""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
import optimise_kit as kit
import pytest
from complex_step import Pair, filter_f3
from design_nodes import design, node_at
from scipy.signal import lfilter

from maxq import Loop, margins
from maxq.control.computer import ComputerState, build_computer, computer_tick, start_computer
from maxq.control.filters import BendingFilter, FirstOrderSection, QuadraticSection
from maxq.control.kernel.records import Array, blank, pack
from maxq.control.kernel.tables import Pool
from maxq.control.laws.pd import GainSchedule, gains_table
from maxq.design.laws.pd import Pd
from maxq.design.loop.fixed_path import SampledFixedPath, fixed_path
from maxq.design.loop.loop import close_loop
from maxq.design.loop.multiloop import Multiloop
from maxq.design.optimise.at_nodes import make_problem
from maxq.design.optimise.plants import make_plants
from maxq.design.optimise.solve import solve

T = 0.01
GAINS = GainSchedule([0.0, 10.0], [1.2, 0.8], [0.5, 0.4], [0.3, 0.6])
F3 = BendingFilter((QuadraticSection(9.0, 0.3, 7.0, 0.7),), (FirstOrderSection(30.0, 5.0),))


class Ticked:
    def __init__(self, gains: GainSchedule, **more: Any) -> None:
        pool = Pool()
        computer = build_computer(
            pool,
            sample_ns=10_000_000,
            law="pid" if gains.k_i_ps else "pd",
            gains=gains_table(gains),
            attitude="rate-integral",
            **more,
        )
        self.computer, self.pool, self.state = pack([computer])[0], pool.array(), blank(ComputerState)[0]
        start_computer(self.computer, self.pool, self.state, 0.0)
        self.n = 0

    def __call__(self, increment_rad: Array) -> Array:
        self.n += 1
        none3, none2 = np.zeros(3, np.int64), np.zeros(2, np.int64)
        computer_tick(
            self.computer, self.pool, self.state, T * self.n, increment_rad, np.zeros(3), none3, np.zeros(2), none2
        )
        return np.array(self.state.command_rad)


def test_command_is_the_sum_of_three_terms_behind_the_filter() -> None:
    discrete = F3.discretize(T, "prewarped", 9.0)
    ticked = Ticked(GAINS, pitch_filter=discrete)
    increments = np.random.default_rng(1).normal(scale=1e-3, size=(500, 3))
    flown = np.array([ticked(i) for i in increments])
    time_s = T * np.arange(1, 501)
    k_p, k_d, k_i = (np.interp(time_s, GAINS.at, k) for k in (GAINS.k_p, GAINS.k_d_s, GAINS.k_i_ps))
    for gimbal in range(2):
        angle = np.cumsum(increments[:, gimbal + 1])
        wanted = -k_p * angle - k_d * increments[:, gimbal + 1] / T - np.cumsum(T * k_i * angle)
        for b0, b1, b2, a1, a2 in discrete.sections:
            wanted = lfilter([b0, b1, b2], [1.0, a1, a2], wanted)
        np.testing.assert_allclose(flown[:, gimbal], wanted, rtol=1e-9, atol=1e-12)
    assert ticked.state.law.pid.k_i_ps[0] == pytest.approx(k_i[-1])


def closed(gains: GainSchedule, torque: Any, **more: Any) -> Array:
    """Return the angle of q' = 9 delta + torque(t) at the samples."""
    ticked, rate, angle, delta, angles = Ticked(gains, **more), 0.0, 0.0, 0.0, []
    for n in range(6000):
        accel = 9.0 * delta + torque(T * n)
        increment = rate * T + 0.5 * accel * T * T
        rate, angle = rate + accel * T, angle + increment
        delta = ticked(np.array([0.0, increment, 0.0]))[0]
        angles.append(angle)
    return np.array(angles)


@pytest.mark.slow
def test_a_constant_torque_leaves_no_error_standing() -> None:
    one = GainSchedule([0.0], [1.2], [0.5], [0.4])
    assert abs(closed(one, lambda _: 0.2)[-1]) < 1e-6
    plain = closed(GainSchedule([0.0], [1.2], [0.5]), lambda _: 0.2)[-1]
    assert plain == pytest.approx(0.2 / (9.0 * 1.2), rel=1e-6)
    # a limit on the sum below what the torque asks for leaves the rest standing
    limited = closed(one, lambda _: 0.2, integral_limit_rad=0.01)[-1]
    assert limited == pytest.approx((0.2 / 9.0 - 0.01) / 1.2, rel=1e-4)


def wound_up(gains: GainSchedule, torque: Any, limit_rad: float) -> Array:
    """Return the same closed loop with a sum that continues while the command is limited."""
    rate, angle, delta, total, angles = 0.0, 0.0, 0.0, 0.0, []
    for n in range(6000):
        accel = 9.0 * delta + torque(T * n)
        increment = rate * T + 0.5 * accel * T * T
        rate, angle = rate + accel * T, angle + increment
        total += T * gains.k_i_ps[0] * angle
        wanted = -gains.k_p[0] * angle - gains.k_d_s[0] * increment / T - total
        delta = min(max(wanted, -limit_rad), limit_rad)
        angles.append(angle)
    return np.array(angles)


def test_a_command_at_its_limit_winds_nothing_up() -> None:
    one = GainSchedule([0.0], [1.2], [0.8], [0.8])

    def pulse(t: float) -> float:
        return 0.19 * (1.0 <= t < 3.0)  # a little more than 0.02 rad of gimbal can hold

    np.testing.assert_allclose(closed(one, pulse), wound_up(one, pulse, np.inf), atol=1e-12)
    flown, naive = closed(one, pulse, command_limit_rad=0.02), wound_up(one, pulse, 0.02)
    assert flown.max() == pytest.approx(naive.max(), rel=1e-9)
    assert flown.min() > 0.3 * naive.min()  # the undershoot is what the sum has gathered
    assert abs(flown[-1]) < 1e-4
    ticked = Ticked(one, command_limit_rad=0.02)
    for _ in range(3000):  # an error that only grows: the sum stops where the limit is reached
        ticked(np.array([0.0, 1e-4, 0.0]))
    assert 0.0 < ticked.state.law.pid.integral_rad[0] < 0.02


def loop_of(kind: str, k_i_ps: float) -> Loop:
    path = fixed_path(node_at(40.0), kind)
    found = close_loop(path, design()).law
    assert isinstance(found, Pd)
    return Loop(path, Pd(found.k_p, found.k_d_s, found.filter, k_i_ps))


@pytest.mark.parametrize("kind", ["pade", "sampled"])
def test_its_loop_is_one_in_every_form(kind: str) -> None:
    f = np.geomspace(0.02, 45.0, 60)
    loop, without = loop_of(kind, 0.3), loop_of(kind, 0.0)
    s = loop.state_space()
    at = 2j * np.pi * f if loop.sample_s is None else np.exp(2j * np.pi * f * T)
    direct = [(s.c @ np.linalg.solve(z * np.eye(len(s.a)) - s.a, s.b) + s.d)[0, 0] for z in at]
    np.testing.assert_allclose(loop.response(f), direct, rtol=1e-6)
    integral = 1.0 / at if loop.sample_s is None else T * at / (at - 1.0)
    share = 0.3 * integral**2 * loop.law.filter_response(f) * loop.fixed.response(f)
    np.testing.assert_allclose(loop.response(f) - without.response(f), share, rtol=1e-9)
    for k_i in (0.3, 60.0):
        tried = loop_of(kind, k_i)
        assert margins(tried).stable == bool((tried.closed_poles().real < 0.0).all()) == (k_i < 1.0)


def test_loops_of_two_axes_together_are_the_same() -> None:
    one = loop_of("sampled", 0.3)
    path = one.fixed
    assert isinstance(path, SampledFixedPath)
    both = Multiloop(40.0, ("pitch",), path.sampled, (one.law,))
    f = np.geomspace(0.02, 45.0, 30)
    np.testing.assert_allclose(both.response(f)[:, 0, 0], one.response(f), rtol=1e-9)
    s, z = both.state_space, np.exp(2j * np.pi * f * T)
    direct = [(s.c @ np.linalg.solve(at * np.eye(len(s.a)) - s.a, s.b) + s.d)[0, 0] for at in z]
    np.testing.assert_allclose(direct, one.response(f), rtol=1e-6)


CASE = ("law=pid", "filter.structure=F3", "search.starts=3", "search.leaps=2", "nodes_s=[15.0, 45.0]")


@cache
def pid_case(loop: str) -> Any:
    loaded = kit.case(*CASE, f"loop={loop}", "limits.integral_hz=0.08", "limits.most_integral_hz=0.3")
    return loaded, kit.plants(*CASE, f"loop={loop}", "limits.integral_hz=0.08", "limits.most_integral_hz=0.3")


def log_abs_and_phase(own: Any, s: complex, paths: list[complex]) -> tuple[Any, Any]:
    """Return ln|L| and arg L of F3 with PID; own = one quadratic, one first-order section, ln of gains."""
    terms = [Pair(p.real, p.imag) * np.exp(k) for p, k in zip(paths, own[6:], strict=True)]
    return ((terms[0] + terms[1] + terms[2]) * filter_f3(own, s)).log()


@pytest.mark.parametrize("loop", ["pade", "sampled"])
def test_gradients_by_the_complex_step(loop: str) -> None:
    loaded, plants = pid_case(loop)
    law = make_problem(loaded.case, plants).law
    own = np.array([np.log(9.0), 0.3, np.log(6.5), 0.5, np.log(20.0), np.log(9.0), 0.1, -0.8, -0.6])
    x = np.log(np.geomspace(0.1, 30.0, 7))
    path = plants.each[0].path
    ratios = np.stack([path.ratio(name, np.exp(x)) for name in law.inputs], axis=1)
    axis = law.axis(x)
    gains = np.exp(own[6:])
    given = law.gradient(np.tile(own, (7, 1)), axis, ratios / (ratios @ gains)[:, None])
    for point in range(7):
        for k in range(len(own)):
            stepped = own.astype(complex)
            stepped[k] += 1e-30j
            amplitude, phase = log_abs_and_phase(stepped, complex(axis[0][point]), list(ratios[point]))
            wanted = complex(amplitude.imag, phase.imag) * 1e30
            assert given[point, k] == pytest.approx(wanted, rel=1e-9, abs=1e-12)
    many = np.tile(own, (len(plants), 1))
    for values in law.limit_values(many):
        for k in range(len(own)):
            moved = many.copy()
            moved[:, k] += 1e-6
            by = next(v for v in law.limit_values(moved) if v.number == values.number)
            assert (by.excess_db - values.excess_db) / 1e-6 == pytest.approx(values.gradient[:, k], abs=1e-4)


@pytest.mark.slow
def test_the_optimum_holds_its_limits_with_an_integral() -> None:
    loaded, plants = pid_case("sampled")
    found = solve(loaded, plants)
    assert found.status == "optimal"
    for plant in plants.each:
        law = found.law.at(plant.node.time_s, "pitch", T)
        loop = Loop(fixed_path(plant.node, "sampled"), law)
        assert (loop.closed_poles().real < 0.0).all()
        assert 0.08 * (1.0 - 1e-6) < law.gains["k_i_ps"] / law.gains["k_p"] / (2.0 * np.pi) < 0.3 * (1.0 + 1e-6)
        assert margins(loop).stable


def test_plants_offer_what_the_law_takes() -> None:
    _, plants = pid_case("sampled")
    assert set(plants.curves.ratio) == {"angle_rad", "angle_integral_rads"}
    assert set(make_plants([*kit.plants().each[:1]]).curves.ratio) == {"angle_rad"}
