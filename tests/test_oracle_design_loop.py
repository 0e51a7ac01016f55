"""The loop in the frequency domain agrees with other methods.

| quantity | against |
|---|---|
| sampled path | the continuous one with exact factors and all its images, summed (Poisson) |
| sampled path | the difference equation solved frequency by frequency; python-control's zero-order hold |
| sampled loop, closed | the flight computer's kernels with a plant integrated between samples |
| sampled loop | the simulator's numerically linearised equations under the same computer |
| sampled loop, closed | a flight of the simulator with a kick at the gimbal, less one without |
| Pade loop | the product of its factors as printed; python-control |
| closed-loop poles | python-control's feedback; L there is -1; the encirclements of -1 |
| response at a resonance of damping 0.005 | 50-digit arithmetic |
"""

from __future__ import annotations

import dataclasses

import control
import mpmath
import numpy as np
import pytest
import scipy.linalg
import scipy.signal
from design_nodes import TIMES_S, agrees_with_a_kick, design, flown, frozen, ideal, node_at

import maxq
from maxq import Loop, Node
from maxq.control.computer import ComputerState, build_computer, computer_tick, start_computer
from maxq.control.kernel.records import Array, blank, pack
from maxq.control.kernel.tables import Pool
from maxq.control.laws.pd import GainSchedule, gains_table
from maxq.design.loop.fixed_path import ExactFixedPath, PadeFixedPath, SampledFixedPath
from maxq.design.loop.rational import average, converter_pade, delay_pade, hold_pade
from maxq.design.loop.sampling import exponential, sample
from maxq.design.model.linearised import linearise
from maxq.design.model.state_space import StateSpace, zeros_and_poles
from maxq.sim.packing.flight import pack_flight
from maxq.sim.run.fly import fly
from maxq.sim.scenario.loader import load_scenario

CUTS = "gimbal_command", "rate_command_to_q", "rate_command_to_q_m"

EVERY_NODE = pytest.mark.parametrize("time_s", TIMES_S)
SOME_NODES = pytest.mark.parametrize("time_s", [5.0, 40.0, 55.0])
FREQUENCIES_HZ = np.unique(np.concatenate([np.geomspace(1e-3, 50.0, 60), [9.9, 9.97, 44.5, 49.3565]]))


def images(node: Node, cut: str, count: int) -> np.ndarray:
    """Return the sum of the exact path's response over the images of each frequency."""
    path, turn = ExactFixedPath(node, cut), 2.0 * np.pi / node.instruments.sample_s
    if cut != "gimbal_command":  # the sampled path ends in a converter all the same
        s_of = lambda s: path.at(s) * average(s, node.instruments.sample_s)  # noqa: E731  # read once
    else:
        s_of = path.at
    s = 2j * np.pi * FREQUENCIES_HZ
    return np.asarray(sum(s_of(s + 1j * k * turn) for k in range(-count, count + 1)))


@pytest.mark.slow
@pytest.mark.parametrize("delay_s", [0.0, 0.003, 0.01, 0.0237])
@pytest.mark.parametrize("cut", CUTS)
@SOME_NODES
def test_sampled_path_is_the_continuous_one_with_its_images(time_s: float, cut: str, delay_s: float) -> None:
    node = node_at(time_s)
    node = dataclasses.replace(node, instruments=dataclasses.replace(node.instruments, delay_s=delay_s))
    # images fall with the fourth power of their number at least
    np.testing.assert_allclose(SampledFixedPath(node, cut).response(FREQUENCIES_HZ), images(node, cut, 60), rtol=2e-7)


@pytest.mark.parametrize("scale", [0.0, 1e-3, 0.3, 5.0, 40.0])
def test_exponential_is_scipys(scale: float) -> None:
    generator = np.random.default_rng(3)
    for size in (0, 1, 2, 20):
        a = scale * generator.standard_normal((size, size)) / max(size, 1) ** 0.5
        expected = scipy.linalg.expm(a) if size else a
        np.testing.assert_allclose(exponential(a), expected, rtol=0.0, atol=1e-12 * np.abs(expected).max(initial=1.0))


def test_sampled_path_without_dynamics_of_actuator_and_gyro() -> None:
    node = ideal(node_at(40.0), actuator=True, gyro=True)
    ours = SampledFixedPath(node).response(FREQUENCIES_HZ)
    # the images fall with the third power only: what is left out after n goes with n^-2
    np.testing.assert_allclose(ours, images(node, "gimbal_command", 3000), rtol=3e-6)


@EVERY_NODE
def test_sampled_path_solves_its_difference_equation(time_s: float) -> None:
    path = SampledFixedPath(node_at(time_s))
    s, z = path.state_space(), path.z(FREQUENCIES_HZ)
    eye = np.eye(len(s.a))
    direct = np.array([(s.c @ np.linalg.solve(zk * eye - s.a, s.b))[0, 0] for zk in z])
    np.testing.assert_allclose(path.response(FREQUENCIES_HZ), direct, rtol=1e-8)


def test_sampling_without_delay_is_the_zero_order_hold() -> None:
    """Increments of the sampled integral over T equal differences of python-control's integrated, sampled path."""
    node = node_at(40.0)
    chain, period = SampledFixedPath(node).continuous, node.instruments.sample_s
    plant = control.StateSpace(chain.a, chain.b, chain.c, chain.d)
    angle = control.sample_system(control.series(plant, control.ss(0, 1, 1, 0)), period, "zoh")
    z = np.exp(2j * np.pi * FREQUENCIES_HZ * period)
    expected = angle(z) * (1.0 - 1.0 / z) / period
    sampled = sample(chain, period, 0.0)
    np.testing.assert_allclose(sampled.at(z, sampled.resolvent())[:, 0, 0], expected, rtol=1e-7)


@EVERY_NODE
def test_pade_path_is_the_product_of_what_is_printed(time_s: float) -> None:
    node = node_at(time_s)
    s, path = 2j * np.pi * FREQUENCIES_HZ, PadeFixedPath(node)
    computer = converter_pade(0.01).at(s) * delay_pade(0.003).at(s) * hold_pade(0.01).at(s)
    x = 0.003 * s  # eq. 31
    np.testing.assert_allclose(delay_pade(0.003).at(s), (1 - x / 2 + x**2 / 12) / (1 + x / 2 + x**2 / 12), rtol=1e-14)
    chain = path.continuous.response(FREQUENCIES_HZ)[:, 0, 0]
    np.testing.assert_allclose(path.response(FREQUENCIES_HZ), chain * computer, rtol=1e-7)
    whole = path.state_space().response(FREQUENCIES_HZ)[:, 0, 0]
    np.testing.assert_allclose(path.response(FREQUENCIES_HZ), whole, rtol=1e-6)


def test_pade_converter_is_within_the_stated_error() -> None:
    f = np.linspace(0.1, 50.0, 500)
    ratio = converter_pade(0.01).at(2j * np.pi * f) / average(2j * np.pi * f, 0.01)
    assert np.abs(20 * np.log10(np.abs(ratio))).max() < 0.02
    assert np.degrees(np.abs(np.angle(ratio))).max() < 0.1


@pytest.mark.parametrize("kind", ["sampled", "pade"])
@EVERY_NODE
def test_python_control_agrees(time_s: float, kind: str) -> None:
    loop = maxq.loop(node_at(time_s), design(), kind=kind)
    theirs = loop.to_state_space()
    s = 2j * np.pi * FREQUENCIES_HZ
    there = s if loop.sample_s is None else np.exp(s * loop.sample_s)
    np.testing.assert_allclose(theirs(there), loop.response(FREQUENCIES_HZ), rtol=1e-6)
    frd = loop.to_frd(FREQUENCIES_HZ)
    np.testing.assert_allclose(frd.eval(2 * np.pi * FREQUENCIES_HZ[7]), loop.response(FREQUENCIES_HZ[7]))
    closed = control.feedback(theirs, 1).poles().astype(complex)
    if loop.sample_s is not None:
        closed = np.log(closed[np.abs(closed) > 1e-6]) / loop.sample_s
    ours = loop.closed_poles()
    distance = np.abs(ours[:, None] - closed[None, :])
    assert len(ours) == len(closed)
    assert (distance.min(axis=1) < 1e-6 * np.abs(ours)).all()


@pytest.mark.parametrize("kind", ["sampled", "pade", "exact"])
@SOME_NODES
def test_closed_poles_are_where_the_loop_is_minus_one(time_s: float, kind: str) -> None:
    """L is -1 at the closed-loop poles, and the number of unstable ones equals the encirclements of -1."""
    node = node_at(time_s)
    loop = maxq.loop(node, design(), kind=kind)
    poles = loop.closed_poles()
    if kind == "exact":
        assert np.abs(1.0 + loop._at(loop.fixed, poles)).max() < 1e-6  # type: ignore[arg-type]  # of the exact kind
    else:
        s = loop.state_space()
        at = poles if loop.sample_s is None else np.exp(poles * loop.sample_s)
        slow = np.abs(poles) < 400.0
        value = [(s.c @ np.linalg.solve(p * np.eye(len(s.a)) - s.a, s.b) + s.d)[0, 0] for p in at[slow]]
        np.testing.assert_allclose(value, -1.0, rtol=1e-5)
    for factor in (1.0, 3.0, 0.2):
        changed = dataclasses.replace(loop, law=loop.law.scaled(factor))
        assert encirclement_count(changed) == int((changed.closed_poles().real > 0.0).sum())


def encirclement_count(loop: Loop) -> int:
    """Return the unstable closed-loop poles from the winding of 1 + L and the unstable open-loop poles."""
    highest = min(loop.highest_hz, 2000.0)
    grid = [np.geomspace(1e-5, highest, 4000)]
    for r in loop.fixed.resonances():
        near = r.frequency_hz + r.half_width_hz * np.sinh(np.linspace(-6.0, 6.0, 601))
        grid.append(near[(near > 1e-5) & (near < highest)])
    turned = np.unwrap(np.angle(1.0 + loop.response(np.unique(np.concatenate(grid)))))
    open_unstable = int((loop.open_poles().real > 0.0).sum())
    count = open_unstable - (turned[-1] - turned[0]) / np.pi
    assert abs(count - round(count)) < 0.02
    return round(count)


@SOME_NODES
def test_open_poles_are_those_of_the_state_matrix(time_s: float) -> None:
    for kind in ("pade", "sampled"):
        loop = maxq.loop(node_at(time_s), design(), kind=kind)  # type: ignore[arg-type]  # a Literal, from parametrize
        values = np.linalg.eigvals(loop.state_space().a).astype(complex)
        if loop.sample_s is not None:
            values = np.log(values[np.abs(values) > 1e-3]) / loop.sample_s
        ours = loop.open_poles()
        assert len(ours) == len(values)
        assert (np.abs(ours[:, None] - values).min(axis=1) < 1e-6 * np.abs(ours)).all()


@pytest.mark.parametrize("time_s", [5.0, 55.0])
def test_resonances_are_exact(time_s: float) -> None:
    """At the peak of every mode, the response equals arithmetic with 50 digits on the same vehicle."""
    path = PadeFixedPath(node_at(time_s))
    body = path.vehicle
    mpmath.mp.dps = 50
    for r in path.resonances():
        f = r.frequency_hz
        s = mpmath.mpc(0, 2 * mpmath.pi * mpmath.mpf(f))
        x = mpmath.lu_solve(
            s * mpmath.eye(len(body.a)) - mpmath.matrix(body.a.tolist()),
            mpmath.matrix(body.b.tolist()) * mpmath.matrix([1, s * s]),
        )
        expected = complex((mpmath.matrix(body.c.tolist()) * x)[0])
        ours = path.plant_at(np.array(2j * np.pi * f)) / _instruments_at(path, 2j * np.pi * f)
        assert abs(ours / expected - 1.0) < 1e-10


def _instruments_at(path: PadeFixedPath, s: complex) -> complex:
    i = path.node.instruments
    out = 1.0 + 0.0j
    for omega, zeta, power in (
        (i.actuator.omega_1_radps, i.actuator.zeta_1, -1),
        (i.actuator.omega_2_radps, i.actuator.zeta_2, -1),
        (i.actuator.omega_3_radps, i.actuator.zeta_3, -1),
        (i.actuator.omega_4_radps, i.actuator.zeta_4, 1),
        (i.gyro.omega_radps, i.gyro.zeta, -1),
    ):
        out *= (1.0 + 2.0 * zeta * s / omega + (s / omega) ** 2) ** power
    return out


# --- the flight computer itself
@pytest.mark.parametrize("delay_s", [0.0, 0.003, 0.01])
@SOME_NODES
def test_closed_loop_is_that_of_the_flight_computer(time_s: float, delay_s: float) -> None:
    """The closed loop equals the computer's kernels with a plant that is integrated exactly between samples."""
    node = node_at(time_s)
    node = dataclasses.replace(node, instruments=dataclasses.replace(node.instruments, delay_s=delay_s))
    loop = maxq.loop(node, design(), kind="sampled")
    kick, samples = 1e-3, 400
    flown_commands = _fly_computer(node, loop, samples, kick)
    # the same from the loop's matrices: d = kick at the first sample, u = d - L u
    s = loop.state_space()
    x, ours = np.zeros(len(s.a)), np.zeros(samples)
    for k in range(samples):
        through = (kick if k == 0 else 0.0) - s.c[0] @ x
        ours[k] = through / (1.0 + s.d[0, 0])
        x = s.a @ x + s.b[:, 0] * ours[k]
    np.testing.assert_allclose(flown_commands, ours, rtol=0.0, atol=1e-8 * np.abs(ours[1:]).max())


def _fly_computer(node: Node, loop: Loop, samples: int, kick: float) -> Array:
    """Return the commands in pitch (samples,) after an impulse on the first one."""
    plant, timing = SampledFixedPath(node).continuous, node.instruments
    pool = Pool()
    gains = gains_table(GainSchedule([0.0], *([gain] for gain in loop.law.gains.values())))
    built = build_computer(
        pool,
        sample_ns=round(1e9 * timing.sample_s),
        gains=gains,
        pitch_filter=loop.law.filter,  # type: ignore[attr-defined]  # a Pd
    )
    computer, tables, state = pack([built])[0], pool.array(), blank(ComputerState)[0]
    start_computer(computer, tables, state, 0.0)
    n = len(plant.states)
    # plant, angle and a constant command, over the stretches before and after a command takes effect
    a = np.zeros((n + 2, n + 2))
    a[:n, :n], a[:n, n + 1], a[n, :n] = plant.a, plant.b[:, 0], plant.c[0]
    before, after = scipy.linalg.expm(a * timing.delay_s), scipy.linalg.expm(a * (timing.sample_s - timing.delay_s))
    x, out, held = np.zeros(n + 2), np.zeros(samples), 0.0
    still, zeros = np.zeros(3), np.zeros(2, np.int64)
    for k in range(samples):
        increment = np.array([0.0, x[n], 0.0])
        gimbal = np.array([kick if k == 0 else 0.0, 0.0])
        time_s = k * timing.sample_s
        computer_tick(computer, tables, state, time_s, increment, still, np.zeros(3, np.int64), gimbal, zeros)
        command = float(state.command_rad[0])
        out[k] = command
        x[n], x[n + 1] = 0.0, held
        x = before @ x
        x[n + 1] = command
        x = after @ x
        held = command
    return out


# --- the simulator
@SOME_NODES
def test_sampled_path_of_the_linearised_simulator(time_s: float) -> None:
    """The path equals that of the simulator's derivative, linearised numerically."""
    loaded, node = frozen(time_s)
    packed = pack_flight(loaded.scenario)
    model = linearise(packed, packed.state, time_s)
    names = [name for name in model.states if "pitch" in name or name in ("w_mps", "q_radps", "theta_rad")]
    names = [name for name in names if name != "gyro_pitch_rad"] + [n for n in model.states if n.startswith("eta_")]
    i = [model.states.index(name) for name in names]
    c = np.zeros((1, len(i)))
    c[0, names.index("gyro_pitch_radps")] = 1.0
    simulated = StateSpace(
        model.a[np.ix_(i, i)], model.b[np.ix_(i, [0])], c, np.zeros((1, 1)), tuple(names), ("command",), ("gyro",)
    )
    sampled = sample(simulated, node.instruments.sample_s, node.instruments.delay_s)
    z = np.exp(2j * np.pi * FREQUENCIES_HZ * node.instruments.sample_s)
    ours = SampledFixedPath(node).response(FREQUENCIES_HZ)
    np.testing.assert_allclose(sampled.at(z, sampled.resolvent())[:, 0, 0], ours, rtol=1e-6)


@pytest.mark.parametrize("time_s", [40.0])
def test_a_kick_in_flight_moves_the_computer_as_the_loop_says(time_s: float) -> None:
    """A kick of one sample at the gimbal changes the commands of a flight as the loop predicts.

    In half a second the flight accelerates by some 4 %, which the tolerance covers.
    """
    _, node = frozen(time_s)
    kick_deg = 0.01
    window = f"start_s={time_s + 0.005:.3f}, stop_s={time_s + 0.015:.3f}"
    injection = f'[{{at="gimbal_command", axis="pitch", kind="step", amplitude_deg={kick_deg}, {window}}}]'
    plain, kicked = (fly(frozen(time_s, *extra)[0]) for extra in ((), (f"injection={injection}",)))
    loop = maxq.loop(node, design(), kind="sampled")
    agrees_with_a_kick(loop, plain, kicked, "gimbal_pitch_command_deg", time_s, kick_deg)


def test_yaw_loop_of_a_symmetric_vehicle_is_the_pitch_loop() -> None:
    for pitch, yaw in zip(flown("pitch")[::5], flown("yaw")[::5], strict=True):
        ours = maxq.loop(pitch, design()).response(FREQUENCIES_HZ)
        # sides differ in inertia about y and z by 1e-3 at most where the data do; here they do not
        np.testing.assert_allclose(maxq.loop(yaw, design()).response(FREQUENCIES_HZ), ours, rtol=1e-9)


def test_scenario_names_and_files_give_the_same_loop() -> None:
    ours = maxq.loop("nominal", "designs/ksr3-robust", 40.0).response(FREQUENCIES_HZ)
    np.testing.assert_array_equal(ours, maxq.loop("nominal", None, 40.0).response(FREQUENCIES_HZ))
    np.testing.assert_array_equal(ours, maxq.loop(load_scenario("nominal"), None, 40.0).response(FREQUENCIES_HZ))


def test_zeros_are_those_of_the_transfer_function() -> None:
    """The zeros are exact for a system with direct transmission and inputs and outputs scaled a million times apart."""
    rng = np.random.default_rng(8)
    a, b, c = rng.normal(size=(4, 4)), rng.normal(size=(4, 1)), rng.normal(size=(1, 4))
    names = tuple("abcd")
    for d in (0.3, 0.7):
        made = StateSpace(a, 1e6 * b, 1e-2 * c, np.array([[1e4 * d]]), names, ("u",), ("y",))
        zeros, poles = zeros_and_poles(made)
        wanted, of_a, _ = scipy.signal.ss2zpk(a, b, c, np.array([[d]]))
        assert np.sort_complex(zeros) == pytest.approx(np.sort_complex(wanted), rel=1e-9)
        assert np.sort_complex(poles) == pytest.approx(np.sort_complex(of_a), rel=1e-9)
