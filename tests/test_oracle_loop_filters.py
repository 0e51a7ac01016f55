"""Filters per loop, filters that fade out after a separation, and load relief by angle of attack agree with oracles.

| quantity | oracle |
|---|---|
| command with a filter in each loop, both laws of load relief | SciPy's `lfilter`, differences |
| filters of two stages, one fading out | `lfilter` on both with separate memories |
| response of the law | (zI - A)^-1 of its state space; closed form |
| gradient by the parameters | complex step on ln|L| and arg L in pairs of real numbers |
| first and second derivative by frequency | differences |
| centre of percussion, acceleration per angle of attack | the linear plant: response to gimbal angle and wind |
| |F(j inf)| of each loop | the filters at 1e9 Hz |
| estimated angle of attack in flight | the true one after the same lag |
"""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import optimise_kit as kit
import pytest
from complex_step import Pair, filter_f3
from scipy.signal import lfilter

import maxq
from maxq.control.computer import ComputerState, build_computer, computer_tick, start_computer, take_over
from maxq.control.filters import BendingFilter, DiscreteFilter, FirstOrderSection, QuadraticSection
from maxq.control.kernel.records import Array, blank, pack
from maxq.control.kernel.tables import Pool
from maxq.control.laws.pd import GainSchedule, gains_table
from maxq.control.loop_filters import make_loop_filters
from maxq.control.sensors import make_sensors
from maxq.control.structures import GAINS
from maxq.design.laws.pd import Pd
from maxq.design.laws.pd_variables import PdVariables
from maxq.design.model.vehicle_at import incidence_by_acceleration
from maxq.design.optimise.at_nodes import make_problem
from maxq.design.verify.judging import judge
from maxq.sim.run.fly import fly
from maxq.sim.scenario.loader import load_scenario

T = 0.01
F3 = BendingFilter((QuadraticSection(9.0, 0.3, 7.0, 0.7),), (FirstOrderSection(30.0, 5.0),))
OF_LOOPS = tuple(
    BendingFilter((QuadraticSection(zero, 0.2, pole, 0.6),)).discretize(T, "prewarped", 9.0)
    for zero, pole in ((12.0, 11.0), (8.0, 6.0), (5.0, 4.0))
)
RELIEF = GainSchedule([0.0, 10.0], [1.2, 0.8], [0.5, 0.4], k_a_s2pm=[0.01, 0.03])
INCIDENCE = GainSchedule(
    [0.0, 10.0],
    [1.2, 0.8],
    [0.5, 0.4],
    k_alpha=[0.3, 0.9],
    percussion_m=[4.0, 6.0],
    accel_per_incidence_mps2=[-30.0, -50.0],
)

LAW_OF = {columns: law for law, columns in GAINS.items()}


def run_through(discrete: DiscreteFilter, given: Array) -> Array:
    for b0, b1, b2, a1, a2 in discrete.sections:
        given = lfilter([b0, b1, b2], [1.0, a1, a2], given)
    return given


class Ticked:
    """A computer with an accelerometer, ticked sample by sample."""

    def __init__(self, gains: GainSchedule, **more: Any) -> None:
        self.pool = Pool()
        self.state = blank(ComputerState)[0]
        self.computer = self.built(gains, **more)
        start_computer(self.computer, self.pool.array(), self.state, 0.0)

    def built(self, gains: GainSchedule, **more: Any) -> Any:
        built = build_computer(
            self.pool,
            sample_ns=10_000_000,
            law=LAW_OF[gains.columns],
            gains=gains_table(gains),
            attitude="rate-integral",
            sensors=make_sensors((0.0,), (0,), accelerometers=1),
            **more,
        )
        return pack([built])[0]

    def __call__(self, turns: Array, pushes: Array) -> Array:
        out, none3, none2 = [], np.zeros(3, np.int64), np.zeros(2, np.int64)
        for turn, push in zip(turns, pushes, strict=True):
            self.state.sensors.increment[0] = push
            time_s = T * (self.state.ticks + 1)
            computer_tick(
                self.computer, self.pool.array(), self.state, time_s, turn, np.zeros(3), none3, np.zeros(2), none2
            )
            out.append(self.state.command_rad.copy())
        return np.array(out)


def shaken(n: int) -> tuple[Array, Array]:
    rng = np.random.default_rng(1)
    return rng.normal(scale=1e-3, size=(n, 3)), rng.normal(scale=2e-2, size=(n, 3))


@pytest.mark.parametrize("gains", [RELIEF, INCIDENCE], ids=["acceleration", "incidence"])
def test_each_loop_has_its_filter_before_the_law(gains: GainSchedule) -> None:
    corner_hz, discrete = 1.5, F3.discretize(T, "prewarped", 9.0)
    ticked = Ticked(gains, relief_hz=corner_hz, pitch_filter=discrete, loops=make_loop_filters(OF_LOOPS))
    turns, pushes = shaken(400)
    flown, time_s = ticked(turns, pushes), T * np.arange(1, 401)
    k_p, k_d = (np.interp(time_s, gains.at, k) for k in (gains.k_p, gains.k_d_s))
    kept = np.exp(-2.0 * np.pi * corner_hz * T)
    for gimbal, side in ((0, pushes[:, 2] / T), (1, -pushes[:, 1] / T)):
        signals = (np.cumsum(turns[:, gimbal + 1]), turns[:, gimbal + 1] / T, side)
        angle, rate, felt = (run_through(own, each) for own, each in zip(OF_LOOPS, signals, strict=True))
        if gains is INCIDENCE:
            lever, slope = (
                np.interp(time_s, gains.at, k) for k in (gains.percussion_m, gains.accel_per_incidence_mps2)
            )
            there = felt - lever * np.diff(rate, prepend=0.0) / T
            alpha = lfilter([1.0 - kept], [1.0, -kept], there) / slope
            relief = -np.interp(time_s, gains.at, gains.k_alpha) * alpha
            assert ticked.state.law.relief.incidence_rad[gimbal] == pytest.approx(alpha[-1])
        else:
            relief = np.interp(time_s, gains.at, gains.k_a_s2pm) * lfilter([1.0 - kept], [1.0, -kept], felt)
        wanted = run_through(discrete, -k_p * angle - k_d * rate + relief)
        np.testing.assert_allclose(flown[:, gimbal], wanted, rtol=1e-9, atol=1e-12)


def steady_memory(b: list[float], a: list[float], value: float) -> Array:
    """Return the memory of transposed direct form II in steady state at one input."""
    out = value * sum(b) / sum(a)
    last = b[2] * value - a[2] * out
    return np.array([b[1] * value - a[1] * out + last, last])


def test_filters_of_the_stage_before_fade_out_on_the_same_input() -> None:
    """Rate loop and bending filter change over 25 samples after the separation: the new ones have the share k / 26."""
    first, later = F3.discretize(T, "prewarped", 9.0), BendingFilter((QuadraticSection(20.0, 0.3, 15.0, 0.8),))
    second, n, cut = later.discretize(T, "prewarped", 9.0), 25, 200
    gains = GainSchedule([0.0], [1.2], [0.5])
    ticked = Ticked(gains, pitch_filter=first, loops=make_loop_filters((None, OF_LOOPS[0])))
    turns, pushes = shaken(300)
    flown = ticked(turns[:cut], pushes[:cut])
    after = ticked.built(gains, pitch_filter=second, loops=make_loop_filters((None, OF_LOOPS[1]), n))
    take_over(ticked.computer, after, ticked.state)
    ticked.computer = after
    flown = np.concatenate([flown, ticked(turns[cut:], pushes[cut:])])
    share = np.clip(np.arange(1, len(turns) - cut + 1) / (n + 1.0), 0.0, 1.0)

    def over(old: DiscreteFilter, new: DiscreteFilter, given: Array) -> Array:
        whole, settled = run_through(old, given), given[cut - 1]
        out, value = given[cut:], settled
        for b0, b1, b2, a1, a2 in new.sections:
            b, a = [b0, b1, b2], [1.0, a1, a2]
            out, value = lfilter(b, a, out, zi=steady_memory(b, a, value))[0], value * sum(b) / sum(a)
        return np.concatenate([whole[:cut], whole[cut:] + share * (out - whole[cut:])])

    for gimbal in range(2):
        angle, rate = np.cumsum(turns[:, gimbal + 1]), turns[:, gimbal + 1] / T
        law = -1.2 * angle - 0.5 * over(OF_LOOPS[0], OF_LOOPS[1], rate)
        np.testing.assert_allclose(flown[:, gimbal], over(first, second, law), rtol=1e-9, atol=1e-12)
    assert ticked.state.loops.fading == 0


# --- design
@cache
def problem(loop: str) -> Any:
    given = (
        "filter.structure=F3",
        "nodes_s=[25.0, 45.0]",
        "gains.nodes_s=[25.0, 45.0]",
        "law=incidence-relief",
        "loop_filters.attitude.structure=F2",
        "loop_filters.rate.structure=F3",
        "loop_filters.acceleration={structure='sections', quadratic=0, first_order=1}",
        "limits.q_alpha_Padeg=3000",
        "limits.drift_mps=5",
        f"loop={loop}",
    )
    plants = kit.plants(*given, name="ksr3-load-relief")
    return make_problem(kit.case(*given, name="ksr3-load-relief").case, plants), plants


VARIABLES = np.array(
    [
        np.log(9.0),
        0.3,
        np.log(6.5),
        0.5,
        np.log(20.0),
        np.log(9.0),  # bending filter
        0.1,
        0.2,
        -0.8,
        -0.9,
        -1.5,
        -1.2,
        0.35,  # ln k_p, ln k_d, ln k_alpha at two nodes; weight of the second gyro
        np.log(12.0),
        0.4,
        np.log(11.0),
        0.6,  # attitude
        np.log(15.0),
        0.5,
        np.log(13.0),
        0.7,
        np.log(21.0),
        np.log(25.0),  # rate
        np.log(6.0),
        np.log(5.0),  # acceleration
    ]
)


def quadratic(own: Any, s: complex) -> Pair:
    at = Pair(s.real, s.imag)
    z, p = (2.0 * np.pi * np.exp(own[k]) for k in (0, 2))
    above = Pair(1.0) + at * (2.0 * own[1] / z) + at * at * (1.0 / z**2)
    return above * (Pair(1.0) + at * (2.0 * own[3] / p) + at * at * (1.0 / p**2)).inverse()


def first_order(own: Any, s: complex) -> Pair:
    at = Pair(s.real, s.imag)
    above, below = (Pair(1.0) + at * (1.0 / (2.0 * np.pi * np.exp(x))) for x in own)
    return above * below.inverse()


def log_abs_and_phase(own: Any, s: complex, paths: list[complex], lag: complex, change: complex) -> tuple[Any, Any]:
    """Return ln|L| and arg L; own = bending filter, ln gains, weight, attitude, rate, acceleration, 1 / b, -p / b."""
    k_p, k_d, k_alpha = (np.exp(x) for x in own[6:9])
    angle, rate, accel, second = (Pair(p.real, p.imag) for p in paths)
    turning = (Pair(k_d) + Pair(change.real, change.imag) * (k_alpha * own[23])) * filter_f3(own[14:20], s)
    rates = rate * (1.0 - own[9]) + second * own[9]
    pushed = accel * Pair(lag.real, lag.imag) * (k_alpha * own[22]) * first_order(own[20:22], s)
    whole = angle * quadratic(own[10:14], s) * k_p + rates * turning + pushed
    return (whole * filter_f3(own, s)).log()


@pytest.mark.parametrize("loop", ["pade", "sampled"])
def test_gradients_by_the_complex_step(loop: str) -> None:
    made, plants = problem(loop)
    law, path = made.law, plants.each[0].path
    assert law.inputs == ("angle_rad", "rate_radps", "accel_mps2", "rate_2_radps")
    assert len(law.names) == len(VARIABLES)
    x = np.log(np.geomspace(0.1, 30.0, 7))
    f, axis, own = np.exp(x), law.axis(x), law.own(VARIABLES)[:1]
    ratios = np.stack([path.ratio(name, f) for name in law.inputs], axis=1)
    kept, z = np.exp(-2.0 * np.pi * T), np.exp(-2j * np.pi * f * T)
    lags = (1.0 - kept) / (1.0 - kept * z) if loop == "sampled" else 1.0 / (1.0 + 1j * f)
    changes = lags * ((1.0 - z) / T if loop == "sampled" else 2j * np.pi * f)
    out = law.log_response(np.tile(own, (7, 1)), axis)
    gains = out.gains[0]
    given = law.gradient(np.tile(own, (7, 1)), axis, ratios / (ratios * gains).sum(axis=1)[:, None])
    for point in range(7):
        here = complex(axis[0][point]), list(ratios[point]), lags[point], changes[point]
        whole = np.exp(complex(*log_abs_and_phase(own[0].astype(complex), *here)))
        mine = np.exp(out.common[0][point]) * (gains[point] @ ratios[point])
        assert min(abs(whole / mine - 1.0), abs(whole / mine + 1.0)) < 1e-9  # arctan knows half a turn
        for k in range(own.shape[1] - 2):
            stepped = own[0].astype(complex)
            stepped[k] += 1e-30j
            amplitude, phase = log_abs_and_phase(stepped, *here)
            wanted = complex(amplitude.imag, phase.imag) * 1e30
            assert given[point, k] == pytest.approx(wanted, rel=1e-8, abs=1e-11)
    h = 1e-4
    ahead, behind = (law.log_response(np.tile(own, (7, 1)), law.axis(x + side * h)).gains[0] for side in (1.0, -1.0))
    np.testing.assert_allclose(out.gains[1], (ahead - behind) / (2 * h), rtol=1e-4, atol=1e-6)
    np.testing.assert_allclose(out.gains[2], (ahead - 2.0 * gains + behind) / h**2, rtol=1e-3, atol=1e-4)


def test_limits_have_the_gradient_of_differences() -> None:
    """Limits in wind and on |F(j inf)| of each loop's filter have the gradient of differences.

    |F(j inf)| is that of the filters at 1e9 Hz.
    """
    law = problem("sampled")[0].law
    own = law.own(VARIABLES)
    for values in law.limit_values(own):
        for k in range(own.shape[1] - 2):
            ends = []
            for side in (1e-6, -1e-6):
                moved = own.copy()
                moved[:, k] += side
                ends.append(next(v for v in law.limit_values(moved) if v.number == values.number).excess_db)
            assert (ends[0] - ends[1]) / 2e-6 == pytest.approx(values.gradient[:, k], rel=1e-5, abs=2e-6)
    designed = law.designed(VARIABLES)
    texts = [limit.text for limit in law.limits]
    for loop, bank in zip(designed.loops, ("attitude", "rate", "acceleration"), strict=True):
        far = abs(designed.filter.filters[0].frequency_response(1e9) * loop[0].frequency_response(1e9))
        number = texts.index(f"|F(j inf)| with that of {bank}")
        assert next(v for v in law.limit_values(own) if v.number == number).value[0] == pytest.approx(far, rel=1e-6)


@pytest.mark.parametrize("loop", ["pade", "sampled"])
def test_the_law_is_one_in_every_form(loop: str) -> None:
    """The law is the same as variables, as a controller, as a state space, and read back from the design's tables."""
    made, plants = problem(loop)
    law, f = made.law, np.geomspace(0.05, 40.0, 25)
    assert isinstance(law, PdVariables)
    controllers = law.controllers(VARIABLES)
    designed = law.designed(VARIABLES)
    for k, one in enumerate(controllers):
        assert isinstance(one, Pd)
        axis, plant = law.axis(np.log(f)), np.full(len(f), k)
        common, gains = law.response(VARIABLES, plant, axis)
        direct = one.response(f)[:, [one.inputs.index(name) for name in law.inputs]]
        np.testing.assert_allclose(common[:, None] * gains, direct, rtol=1e-9)
        period = plants.each[k].path.sample_s
        s = one.state_space()
        at = 2j * np.pi * f if period is None else np.exp(2j * np.pi * f * period)
        solved = np.array([(s.c @ np.linalg.solve(z * np.eye(len(s.a)) - s.a, s.b) + s.d)[0] for z in at])
        np.testing.assert_allclose(solved, one.response(f), rtol=1e-8)
        if period is None:  # off the axis, too
            off = f * np.exp(0.3j)
            solved = [(s.c @ np.linalg.solve(2j * np.pi * x * np.eye(len(s.a)) - s.a, s.b) + s.d)[0] for x in off]
            np.testing.assert_allclose(solved, one.response(off), rtol=1e-8)
        again = designed.at(plants.each[k].node.time_s, "pitch", period)
        np.testing.assert_allclose(again.response(f), one.response(f), rtol=1e-9)
        for name in one.inputs:
            low = one.response(1e-7)[..., one.inputs.index(name)]
            assert low == pytest.approx(one.static_gain(name), rel=1e-5, abs=1e-6)
    np.testing.assert_allclose(law.variables_of(designed), VARIABLES, rtol=1e-12)


def test_damping_of_the_rigid_body_counts_all_gyros() -> None:
    """The damping (36) uses the gain of all rate gyros in the verdict and the optimiser, not the first gyro's share."""
    node = problem("sampled")[1].each[0].node
    law = maxq.load_design("designs/ksr3-load-relief.toml", "load-relief")
    k_p, k_d = (np.interp(node.time_s, law.gains.table["time_s"], law.gains.table[k]) for k in ("k_p", "k_d_s"))
    m_delta = node.derivatives.m_delta_1ps2
    zeta = judge([node], law, "sampled")[0].rigid("paper")[1]
    assert zeta == pytest.approx(0.5 * k_d * np.sqrt(m_delta / k_p), rel=1e-9)


def test_the_centre_of_percussion_feels_the_air_and_no_gimbal_angle() -> None:
    """Without modes and slosh, the acceleration there is 0 per gimbal angle and b per angle of attack."""
    rigid = load_scenario("load-relief", ["switches.bending=false", "switches.slosh=false"])
    for node in maxq.nodes(rigid, (15.0, 40.0)):
        lever_m, slope = incidence_by_acceleration(node.vehicle, node.derivatives, node.condition.airspeed_mps)
        plant = node.plant
        felt, turned = plant.outputs.index("accel_mps2"), plant.states.index("q_radps")
        delta, w = plant.inputs.index("delta_rad"), plant.states.index("w_mps")
        left = plant.d[felt, delta] - lever_m * plant.b[turned, delta]
        # the engine's own weight turns the vehicle as well: 0.3 and 0.4 %
        assert left == pytest.approx(0.0, abs=5e-3 * abs(plant.d[felt, delta]))
        there = plant.c[felt, w] - lever_m * plant.a[turned, w]
        assert there * node.condition.airspeed_mps == pytest.approx(slope, rel=1e-9)
        assert abs(plant.d[felt, delta]) > 1.0


@pytest.mark.slow  # a flight
def test_the_estimate_is_the_incidence_that_is_flown(tmp_path: Path) -> None:
    """In a side wind, the linear model's estimate equals the true angle of attack after the same lag."""
    rows = []
    for node in maxq.nodes(load_scenario("load-relief"), (5.0, 15.0, 25.0, 35.0, 45.0, 55.0)):
        lever_m, slope = incidence_by_acceleration(node.vehicle, node.derivatives, node.condition.airspeed_mps)
        gains = f"k_p=1.0, k_d_s=0.45, k_alpha=0.1, percussion_m={lever_m}, accel_per_incidence_mps2={slope}"
        rows.append(f"{{time_s={node.time_s}, {gains}}}")
    text = (
        f"schema = 2\nlaw = 'incidence-relief'\n[gains]\ntable = [{', '.join(rows)}]\n[load_relief]\ncorner_hz = 1.0\n"
    )
    (tmp_path / "d.toml").write_text(text)
    changes = ["run.duration_s=55", "requirement=", "wind.speed_mps=12.0", "wind.from_deg=200"]
    flight = fly(load_scenario("load-relief", [f"design={tmp_path / 'd.toml'}", *changes]))
    time_s, late = flight.time_s("incidence_estimate_pitch_deg"), np.exp(-2.0 * np.pi * T)
    for estimate, truth in (("pitch", "alpha_deg"), ("yaw", "beta_deg")):
        told = flight[f"incidence_estimate_{estimate}_deg"]
        true = lfilter([1.0 - late], [1.0, -late], np.interp(time_s, flight.time_s(truth), flight[truth]))
        late_enough = time_s > 8.0
        error, size = (told - true * (1 if estimate == "pitch" else -1))[late_enough], np.abs(true[late_enough]).max()
        assert np.sqrt(np.mean(error**2)) < 0.1 * size
