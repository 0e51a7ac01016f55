"""Actuator, gyro and engine reaction agree with closed forms.

The actuator is built here again from the transfer function that the paper prints (28). Its step response follows from
the matrix exponential.
"""

from __future__ import annotations

import math
from types import SimpleNamespace

import numpy as np
import pytest
from flightkit import Mode, Parts, Rig, composed, engine_states, flown, merged, rig, scenario_of, to_oracle, with_stage
from scipy.linalg import expm
from scipy.signal import tf2ss

from maxq.control.kernel.records import Array
from maxq.sim.vehicle import state as layout
from maxq.sim.vehicle.tvc_load.kernel import link_moment

STEP_DEG = 2.0
EFFECT_S = 0.013  # first sample after 10 ms, plus 3 ms of computing


def command(axis: str, amplitude_deg: float) -> list[dict[str, object]]:
    return [{"at": "gimbal_command", "axis": axis, "kind": "step", "amplitude_deg": amplitude_deg}]


def moving(axis: str, amplitude_deg: float, step_s: float = 0.00025, **actuator: object) -> Rig:
    tree = scenario_of(Parts(), injection=command(axis, amplitude_deg), run={"step_s": step_s})
    tree = merged(tree, {"vehicle": {"computer": {"command_limit_deg": 45.0}}})
    return rig(with_stage(tree, actuator=actuator))


def printed_actuator(omega_hz: list[float], zeta: list[float]) -> tuple[Array, Array, Array]:
    """Return A, B and the rows of output, its rate and acceleration of H1 H2 H3 (zero pair 4, pole pair 3)."""
    w = 2.0 * np.pi * np.array(omega_hz)
    quadratics = [np.array([1.0, 2.0 * z * x, x * x]) for x, z in zip(w, zeta, strict=True)]
    below = np.polymul(np.polymul(quadratics[0], quadratics[1]), quadratics[2])
    above = quadratics[3] * (w[0] * w[1] * w[2] / w[3]) ** 2
    a, b, c, d = tf2ss(above, below)
    assert np.all(d == 0.0)
    return a, b[:, 0], np.vstack((c[0], c[0] @ a, c[0] @ a @ a))


def balanced_step(a: Array, b: Array, time_s: float) -> Array:
    """Return the state after a unit step; time in units of 1/100 s conditions the companion matrix well."""
    n = len(b)
    scale = np.diag(100.0 ** np.arange(n - 1, -1, -1.0))
    block = np.zeros((n + 1, n + 1))
    block[:n, :n], block[:n, n] = np.linalg.solve(scale, a @ scale), np.linalg.solve(scale, b)
    return np.asarray(scale @ expm(block * time_s)[:n, n])


@pytest.mark.parametrize("axis", [0, 1])
@pytest.mark.parametrize("exchanged", [False, True])
def test_step_response_against_the_matrix_exponential(axis: int, exchanged: bool) -> None:
    """Angle, rate and acceleration agree; with a3 and a4 exchanged, the zero is at 52.6 Hz and the pole at 15.6 Hz."""
    omega, zeta = [5.8, 7.2, 52.6, 15.6], [0.87, 0.49, 0.15, 0.042]
    if exchanged:
        omega, zeta = [5.8, 7.2, 15.6, 52.6], [0.87, 0.49, 0.042, 0.15]
    a, b, rows = printed_actuator(omega, zeta)
    made = moving("pitch" if axis == 0 else "yaw", STEP_DEG, exchange_a3_a4=exchanged)
    states = flown(made, 0.4, 0.001)
    size = math.radians(STEP_DEG) * np.array([1.0, 50.0, 5000.0])
    for k in range(13, 401, 9):
        state = to_oracle(made, states[k])
        ours = [x[axis] for x in (state.deflection_rad, state.deflection_radps, state.deflection_radps2)]
        wanted = math.radians(STEP_DEG) * rows @ balanced_step(a, b, 0.001 * k - EFFECT_S)
        assert np.allclose(ours, wanted, rtol=0.0, atol=2e-7 * size)
        others = to_oracle(made, states[k]).deflection_rad[1 - axis]
        assert others == 0.0
    assert np.all(states[:14, layout.ACTUATOR : layout.ACTUATOR + 12] == 0.0)  # nothing moves before the command


MODELS = {"second-order": 1, "fourth-order": 2, "sixth-order": 4}


def modelled(model: str, **more: object) -> dict[str, object]:
    """Return the keys of an actuator of this order with the paper's first frequencies."""
    n = MODELS[model]
    return {"model": model, "omega_hz": [5.8, 7.2, 52.6, 15.6][:n], "zeta": [0.87, 0.49, 0.15, 0.042][:n], **more}


@pytest.mark.parametrize("limits_act_on", ["servo", "engine"])
@pytest.mark.parametrize("model", MODELS)
def test_step_response_of_each_model(model: str, limits_act_on: str) -> None:
    """Below the limits, the response is that of the product of the sections, wherever the limits act."""
    w, z = 2.0 * np.pi * np.array([5.8, 7.2, 52.6, 15.6]), [0.87, 0.49, 0.15, 0.042]
    quadratics = [np.array([1.0, 2.0 * d * x, x * x]) for x, d in zip(w, z, strict=True)]
    below, above = np.array([1.0]), np.array([1.0])
    for k in range(min(MODELS[model], 3)):
        below, above = np.polymul(below, quadratics[k]), above * w[k] ** 2
    if model == "sixth-order":
        above = above * quadratics[3] / w[3] ** 2
    a, b, c, d = tf2ss(above, below)
    assert np.all(d == 0.0)
    made = moving("pitch", STEP_DEG, **modelled(model, limits_act_on=limits_act_on))
    states = flown(made, 0.4, 0.001)
    size, step = math.radians(STEP_DEG), math.radians(STEP_DEG)
    for k in range(14, 401, 9):
        x = balanced_step(a, b[:, 0], 0.001 * k - EFFECT_S)
        accel = c[0] @ a @ a @ x + c[0] @ a @ b[:, 0]  # the command is there: order two has it in its acceleration
        state = to_oracle(made, states[k])
        assert np.isclose(state.deflection_rad[0], step * c[0] @ x, rtol=0.0, atol=2e-7 * size)
        assert np.isclose(state.deflection_radps[0], step * c[0] @ a @ x, rtol=0.0, atol=1e-5 * size)
        assert np.isclose(state.deflection_radps2[0], step * accel, rtol=0.0, atol=1e-3 * size)


@pytest.mark.parametrize("model", ["fourth-order", "sixth-order"])
def test_where_the_limits_act(model: str) -> None:
    """With 30 deg/s at the servo, the following sections overshoot to 36 deg/s in order six; at the engine, none do."""
    rates = {}
    for where in ("servo", "engine"):
        made = moving(
            "pitch", 20.0, **modelled(model, angle_limit_deg=30.0, rate_limit_degps=30.0, limits_act_on=where)
        )
        swept = [to_oracle(made, y) for y in flown(made, 1.5, 0.002)]
        rates[where] = max(abs(math.degrees(state.deflection_radps[0])) for state in swept)
        assert np.isclose(math.degrees(swept[-1].deflection_rad[0]), 20.0, rtol=1e-3)
    assert rates["engine"] <= 30.0 * (1.0 + 1e-12)
    assert rates["servo"] > 31.0


def test_engine_rests_on_its_stop() -> None:
    made = moving("yaw", -8.0, angle_limit_deg=6.0, stop_deg=5.5, limits_act_on="engine")
    states = flown(made, 1.0, 0.001)
    angles = np.degrees([to_oracle(made, y).deflection_rad[1] for y in states])
    assert angles.min() == -5.5
    last = to_oracle(made, states[-1])
    assert last.deflection_radps[1] == last.deflection_radps2[1] == 0.0


def failing(fault: dict[str, object], **actuator: object) -> Rig:
    """Return a step of 2 deg at the start with a fault of the pitch actuator."""
    keys = {"angle_limit_deg": 6.0, "rate_limit_degps": 30.0, **actuator}
    tree = scenario_of(Parts(), injection=command("pitch", STEP_DEG), run={"step_s": 0.0005}, fault=[fault])
    return rig(with_stage(tree, actuator=keys))


@pytest.mark.parametrize("limits_act_on", ["servo", "engine"])
def test_stuck_servo_stands_until_it_works_again(limits_act_on: str) -> None:
    made = failing(
        {"kind": "actuator-stuck", "at_s": 0.05, "until_s": 1.0, "axis": "pitch"}, limits_act_on=limits_act_on
    )
    servo = flown(made, 2.0, 0.05)[:, layout.ACTUATOR]
    assert 0.0 < servo[1] < math.radians(STEP_DEG)
    assert np.all(servo[1:20] == servo[1])
    assert np.isclose(servo[-1], math.radians(STEP_DEG), rtol=1e-6)


def test_hard_over_goes_to_its_angle_at_the_limit_of_the_rate() -> None:
    made = failing({"kind": "actuator-hard-over", "at_s": 0.0, "angle_deg": -8.0}, limits_act_on="engine")
    states = flown(made, 1.0, 0.005)
    engine = [to_oracle(made, y) for y in states]
    rates = np.degrees([state.deflection_radps for state in engine])
    assert np.all(np.abs(rates) <= 30.0 * (1.0 + 1e-12))
    assert np.allclose(rates.min(axis=0), -30.0, rtol=1e-3)  # both axes, and whatever the computer commands
    assert np.allclose(np.degrees(engine[-1].deflection_rad), -6.0, rtol=1e-6)


def test_floating_servo_goes_to_its_middle() -> None:
    made = failing({"kind": "actuator-floating", "at_s": 0.5, "axis": "pitch"})
    angles = np.degrees([to_oracle(made, y).deflection_rad[0] for y in flown(made, 1.5, 0.5)])
    assert np.isclose(angles[1], STEP_DEG, rtol=1e-3)
    assert abs(angles[-1]) < 1e-4


def test_dc_gain_is_one_and_bias_adds() -> None:
    made = moving("yaw", STEP_DEG, bias_deg=[0.3, -0.2])
    flown(made, 3.0)
    angle = np.degrees(to_oracle(made, made.y).deflection_rad)
    assert np.allclose(angle, [0.3, STEP_DEG - 0.2], rtol=0.0, atol=1e-9)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_angle_limit_stops_the_position_command(sign: float) -> None:
    made = moving("pitch", sign * 20.0, angle_limit_deg=6.0)
    states = flown(made, 3.0, 0.01)
    assert np.max(np.abs(states[:, layout.ACTUATOR])) <= math.radians(6.0) * 1.01  # servo: its own small overshoot
    assert np.isclose(math.degrees(to_oracle(made, made.y).deflection_rad[0]), sign * 6.0, rtol=1e-9)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_rate_limit_holds_while_slewing_and_leaves_no_wind_up(sign: float) -> None:
    limit = math.radians(10.0)
    made = moving("pitch", sign * 20.0, angle_limit_deg=30.0, rate_limit_degps=10.0)
    states = flown(made, 4.0, 0.001)
    servo = sign * states[:, layout.ACTUATOR]
    rates = sign * states[:, layout.ACTUATOR + 1]
    assert np.max(np.abs(rates)) <= limit * (1.0 + 1e-12)
    slewing = (servo > 0.1 * math.radians(20.0)) & (servo < 0.8 * math.radians(20.0))
    assert np.allclose(rates[slewing], limit, rtol=1e-3)
    assert np.max(servo) < math.radians(20.0) * 1.01  # no more overshoot than the linear servo's (zeta 0.87: 0.4 %)
    assert np.isclose(math.degrees(to_oracle(made, made.y).deflection_rad[0]), sign * 20.0, rtol=1e-6)


def test_limits_do_nothing_below_them() -> None:
    wide = moving("pitch", STEP_DEG, angle_limit_deg=45.0, rate_limit_degps=1000.0)
    near = moving("pitch", STEP_DEG, angle_limit_deg=2.1, rate_limit_degps=60.0)
    assert np.array_equal(flown(wide, 0.3), flown(near, 0.3))


def engine_and_servo(made: Rig, duration_s: float, step_s: float) -> tuple[Array, Array]:
    """Return the angles (samples, 2) of the pitch engine and its servo at the start of each step, rad."""
    run, out = made.run(), []
    for _ in range(round(duration_s / step_s)):
        servo = float(made.y[layout.ACTUATOR])
        run.fly_segment(round(1e9 * step_s))
        out.append((float(made.packed.memory[0].held.engine_rad[0]), servo))
    engine, servo_rad = np.array(out).T
    return engine, servo_rad


def test_backlash_is_a_play_behind_the_servo() -> None:
    """After a step of 2 deg the servo is at 2 deg, and the engine 0.2 deg behind the servo's farthest angle.

    The servo's overshoot is exp(-pi zeta / (1 - zeta^2)^1/2).
    """
    farthest = 2.0 * (1.0 + math.exp(-math.pi * 0.87 / math.sqrt(1.0 - 0.87**2)))
    for sign in (1.0, -1.0):
        made = moving("pitch", sign * 2.0, backlash_deg=0.4, **modelled("second-order"))
        flown(made, 3.0)
        state = to_oracle(made, made.y)
        assert np.isclose(math.degrees(state.deflection_rad[0]), sign * (farthest - 0.2), rtol=1e-6)
        assert state.deflection_radps[0] == state.deflection_radps2[0] == 0.0
        assert np.isclose(math.degrees(made.y[layout.ACTUATOR]), sign * 2.0, rtol=1e-9)


@pytest.mark.parametrize("share", [0.2, 0.5])
def test_describing_function_of_the_backlash(share: float) -> None:
    """For a sine, engine over servo is the describing function of play (Gelb & Vander Velde, 1968).

    With half the play h and the servo amplitude X, it is (1/pi) (pi/2 + asin u + u sqrt(1 - u^2)) in phase, where
    u = 1 - 2 h/X, and -(4/pi) (h/X) (1 - h/X) in quadrature: the engine lags.
    """
    hz, step_s = 2.0, 0.001
    signal = [{"at": "gimbal_command", "axis": "pitch", "kind": "sine", "amplitude_deg": 2.0, "frequency_hz": hz}]
    tree = scenario_of(Parts(), injection=signal, run={"step_s": step_s})
    servo_deg = 2.0 / abs(complex(1.0 - (hz / 5.8) ** 2, 2.0 * 0.87 * hz / 5.8))
    half = math.radians(share * servo_deg)
    made = rig(with_stage(tree, actuator=modelled("second-order", backlash_deg=2.0 * math.degrees(half))))
    engine, servo = engine_and_servo(made, 2.0, step_s)
    turn = np.exp(-2j * np.pi * hz * step_s * np.arange(1000))  # the second second: whole periods
    x, e = (2.0 * np.mean(turn * angle[1000:]) for angle in (servo, engine))
    u = 1.0 - 2.0 * half / abs(x)
    in_phase = (math.pi / 2.0 + math.asin(u) + u * math.sqrt(1.0 - u * u)) / math.pi
    wanted = complex(in_phase, -4.0 / math.pi * half / abs(x) * (1.0 - half / abs(x)))
    assert abs(e / x - wanted) < 0.005  # the hold's harmonics
    by_hand = 0.0
    for k, angle in enumerate(servo):
        by_hand = angle - half if by_hand < angle - half else angle + half if by_hand > angle + half else by_hand
        assert abs(engine[k] - by_hand) < 1e-12


def test_play_of_a_tvc_load_is_a_gap_of_its_spring() -> None:
    """The hinge moment is zero in the gap, then that of the spring; the damper never pulls."""
    load = SimpleNamespace(stiffness_Nmprad=[1e5], damping_Nmsprad=[300.0])
    at = getattr(link_moment, "py_func", link_moment)

    def moment(deflection: float, rate: float) -> float:
        return -float(at(load, 0, np.array([0.02 + deflection, rate, 0.0]), 0, 0.02, 0.0, 0.004))

    for side in (1.0, -1.0):
        assert moment(side * 0.0019, side * 1.0) == 0.0
        assert moment(side * 0.005, 0.0) == pytest.approx(-side * 1e5 * 0.003)
        assert moment(side * 0.005, side * 0.5) == pytest.approx(-side * (300.0 + 150.0))
        assert moment(side * 0.005, -side * 2.0) == 0.0  # leaving faster than the spring follows


def test_ideal_actuator_is_its_command() -> None:
    tree = scenario_of(Parts(), injection=command("pitch", 2.0), switches={"actuator": "ideal"})
    made = rig(tree)
    flown(made, 0.02)
    state = to_oracle(made, made.y)
    assert np.allclose(np.degrees(state.deflection_rad), [2.0, 0.0], rtol=1e-14, atol=0.0)
    assert np.all(state.deflection_radps == 0.0)


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_gyro_step_response(axis: int) -> None:
    """A step of the body rate gives the second-order step response, and its integral is the converter's input."""
    rate = np.zeros(3)
    rate[axis] = 0.05
    made = rig(scenario_of(Parts(), initial={"rate_BI_radps": rate}, run={"step_s": 0.0001}))
    made.y[layout.GYRO : layout.GYRO + 9] = 0.0
    omega, zeta = 2.0 * math.pi * 60.0, 0.65
    damped = omega * math.sqrt(1.0 - zeta**2)
    i = layout.GYRO + 2 * axis
    for k, y in enumerate(flown(made, 0.009, 0.001)):  # up to the first sample
        t = 0.001 * k
        decay, c, s = math.exp(-zeta * omega * t), math.cos(damped * t), math.sin(damped * t)
        wanted = 0.05 * (1.0 - decay * (c + zeta * omega / damped * s))
        assert abs(y[i] - wanted) < 1e-9
        # integral: t - 2 zeta / omega + the decaying part
        tail = decay * (2.0 * zeta / omega * c + (2.0 * zeta**2 - 1.0) / damped * s)
        assert abs(y[layout.GYRO_ANGLE + axis] - 0.05 * (t - 2.0 * zeta / omega + tail)) < 1e-11


# --- engine reaction
ENGINE = Parts(core_cg=(7.0, 0.0, 0.0), engine_mass_kg=180.0, engine_cg_m=0.4, engine_inertia_kgm2=20.0, thrust_N=1.2e5)


def moment_per_angle(made: Rig, axis: int) -> tuple[float, float]:
    """Return the angular acceleration about y or z per engine angle and acceleration, at zero angle and rate."""
    out = []
    for angle, accel in ((1e-5, 0.0), (0.0, 1e-3)):
        y = made.y.copy()
        y[layout.ACTUATOR : layout.ACTUATOR + 12] = swing(made, axis, angle, accel)
        out.append(float(made.derivative(y)[layout.W_BI_B + 1 + axis] / max(angle, accel)))
    return out[0], out[1]


def swing(made: Rig, axis: int, angle_rad: float, accel_radps2: float) -> Array:
    """Return the actuator states of one axis at an angle and acceleration with zero rate."""
    pick = np.eye(2)[axis]
    return engine_states(made, angle_rad * pick, 0.0 * pick, accel_radps2 * pick)


@pytest.mark.parametrize("axis", [0, 1])
def test_tail_wags_dog_zero(axis: int) -> None:
    """omega^2 = T l_c / (I_E + m_E l_E l_c), I_E about the gimbal (erratum 8).

    Here thrust acts past the CG that the displaced engine shifts: T l_c + m_E l_E a_x.
    """
    made = rig(scenario_of(ENGINE))
    still, swinging = moment_per_angle(made, axis)
    assert still > 0.0
    assert swinging > 0.0
    arm = ENGINE.gimbal_station_m - ENGINE.core_cg[0]
    mass, length = ENGINE.engine_mass_kg, ENGINE.engine_cg_m
    inertia = ENGINE.engine_inertia_kgm2 + mass * length**2
    wagging = inertia + mass * length * arm
    accel = ENGINE.thrust_N / composed(ENGINE)[0]
    exact = (ENGINE.thrust_N * arm + mass * length * accel) / wagging
    assert np.isclose(still / swinging, exact, rtol=1e-6)
    assert np.isclose(math.sqrt(still / swinging), math.sqrt(ENGINE.thrust_N * arm / wagging), rtol=5e-3)
    assert np.isclose(swinging * ENGINE.core_inertia[1][1], wagging, rtol=1e-6)


def test_tail_wags_dog_bends_the_body() -> None:
    """Engine acceleration excites a mode with m_E l_E (phi + l_E sigma) + I sigma at the gimbal, to +z and to -y."""
    mode = Mode(7.0, 500.0, (1.0, 0.4, -0.2, -0.4, 0.5, 1.1), (-0.3, -0.3, -0.2, 0.2, 0.3, 0.3))
    parts = Parts(pitch=(mode,), yaw=(mode,), engine_mass_kg=180.0, engine_cg_m=0.4, engine_inertia_kgm2=20.0)
    made = rig(scenario_of(parts))
    wanted = (180.0 * 0.4 * (0.5 + 0.4 * 0.3) + 20.0 * 0.3) / 500.0
    for axis, sign, first in ((0, 1.0, layout.eta_index(made.sizes)), (1, -1.0, layout.xi_index(made.sizes))):
        y = made.y.copy()
        y[layout.ACTUATOR : layout.ACTUATOR + 12] = swing(made, axis, 0.0, 1.0)
        dy = made.derivative(y)
        assert np.isclose(dy[int(first) + 1], sign * wanted, rtol=1e-9)


def test_play_keeps_the_loop_in_a_limit_cycle() -> None:
    """Period and peak rate of a rigid body under PD with play equal those of a short simulation in Python.

    Every 1 ms the servo is propagated exactly, the play is applied, and the body moves under the mean of the angle.
    """
    k_p, k_d, sample_s, delay_s, step_s, half, end_s = 1.0, 1.2, 0.005, 0.001, 0.001, math.radians(0.1), 60.0
    parts = Parts(thrust_N=2.0e4)
    effect = 2.0e4 * (parts.gimbal_station_m - parts.core_cg[0]) / parts.core_inertia[1][1]  # 1/s2
    tree = scenario_of(
        parts,
        design={"schema": 2, "gains": {"table": {"time_s": [0.0], "k_p": [k_p], "k_d_s": [k_d]}}},
        vehicle={"computer": {"sample_s": sample_s, "delay_s": delay_s}},
        initial={"rate_BI_radps": [0.0, 0.01, 0.0]},
        switches={"converter": "ideal", "gyro": "ideal"},
    )
    made = rig(with_stage(tree, actuator=modelled("second-order", backlash_deg=2.0 * math.degrees(half))))
    flight = flown(made, end_s, 0.01)[:, layout.W_BI_B + 1]
    omega, zeta = 2.0 * math.pi * 5.8, 0.87
    a = np.array([[0.0, 1.0], [-omega * omega, -2.0 * zeta * omega]])
    onwards = expm(a * step_s)
    (p11, p12), (p21, p22) = onwards.tolist()
    theta, rate, servo, servo_rate, engine, command_rad, waiting, last = 0.0, 0.01, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    rates = []
    for k in range(round(end_s / step_s)):
        if k % 10 == 0:
            rates.append(rate)
        if k % 5 == 0:
            waiting = -k_p * theta - k_d * (theta - last) / sample_s
            last = theta
        elif k % 5 == 1:
            command_rad = waiting
        off = servo - command_rad
        servo, servo_rate = command_rad + p11 * off + p12 * servo_rate, p21 * off + p22 * servo_rate
        before, engine = engine, min(max(engine, servo - half), servo + half)
        theta += step_s * rate + step_s**2 * effect * (before / 3.0 + engine / 6.0)
        rate += step_s * effect * 0.5 * (before + engine)
    ours, theirs = cycle(np.array(rates), 0.01), cycle(flight, 0.01)
    assert ours == pytest.approx((7.14, 1.58e-3), rel=3e-3)
    assert theirs == pytest.approx(ours, rel=1e-3)


def cycle(rates: Array, every_s: float) -> tuple[float, float]:
    """Return the mean period and amplitude of the last three cycles."""
    up = np.flatnonzero((rates[:-1] < 0.0) & (rates[1:] >= 0.0))[-4:]
    times = every_s * (up - rates[up] / (rates[up + 1] - rates[up]))
    return float(times[-1] - times[0]) / 3.0, float(np.abs(rates[up[0] : up[-1]]).max())
