"""Rate gyros at separate stations and the accelerometer agree in simulator, computer, linear model and loop.

| quantity | oracle |
|---|---|
| rate and specific force of a turning, bent vehicle | velocity and attitude there, differentiated along its motion |
| outputs of the linear model, both planes | the simulator, linearised numerically |
| sampled path of each sensor | sum over the images of the continuous response |
| counts, latency, lost samples, blended rate | NumPy, on random samples |
| state matrices of a law with blending and load relief | its frequency response |
| commands after a kick in flight, pitch and yaw | the loop's state matrices |
"""

from __future__ import annotations

import dataclasses
from functools import cache
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from design_nodes import agrees_with_a_kick, frozen
from flightkit import Mode, Parts, Rig, Tank, rig, scenario_of, with_stage
from scipy.spatial.transform import Rotation
from zero_incidence import zero_incidence

import maxq
from maxq import Loop, Node
from maxq.control.computer import ComputerState, build_computer, computer_tick, hand_sensors, start_computer
from maxq.control.filters import BendingFilter, QuadraticSection
from maxq.control.kernel.records import Array, blank, pack
from maxq.control.kernel.tables import Pool
from maxq.control.sensors import make_sensors
from maxq.design.laws.bending_filter import Lag
from maxq.design.laws.pd import Pd
from maxq.design.loop.fixed_path import ExactFixedPath, PadeFixedPath, SampledFixedPath, fixed_path
from maxq.design.loop.multiloop import multiloop
from maxq.design.model.held import OUTPUTS
from maxq.design.model.instruments import actuator, lag
from maxq.design.model.linearised import linearise
from maxq.sim.packing.flight import pack_flight
from maxq.sim.run.fly import fly
from maxq.sim.vehicle import state as layout

SENSORS = (
    "vehicle.stage.0.rate_gyro=[{station_m=8.0, omega_hz=60, zeta=0.65}, "
    "{station_m=11.5, omega_hz=50, zeta=0.7, latency_samples=2}]",
    "vehicle.stage.0.accelerometer={station_m=4.0, omega_hz=80, zeta=0.7, latency_samples=1}",
)
NODE_S = 40.0
FREQUENCIES_HZ = np.array([0.05, 0.3, 1.1, 3.0, 9.0, 12.0, 27.0, 44.0])

# --- the simulator
STATIONS = (0.0, 3.0, 5.0, 10.0, 12.0, 14.0)
PITCH = (Mode(4.0, 900.0, (1.0, 0.3, -0.2, -0.1, 0.6, 1.0), (-0.3, -0.2, -0.1, 0.2, 0.3, 0.3), 0.01),)
YAW = (Mode(4.4, 800.0, (0.9, 0.4, -0.1, -0.2, 0.5, 1.0), (-0.25, -0.22, -0.1, 0.2, 0.3, 0.3), 0.01),)
PARTS = Parts(
    core_cg=(7.0, 0.05, -0.03),
    tanks=(Tank(300.0, 0.8, 5.0, 0.02), Tank(500.0, 0.9, 10.0, 0.03)),
    pitch=PITCH,
    yaw=YAW,
    engine_mass_kg=200.0,
    engine_cg_m=0.4,
    engine_inertia_kgm2=20.0,
    thrust_N=9.0e4,
)
AT = 1  # index of the sensors' station


def turning() -> Rig:
    """Return a vehicle that turns about all axes, bent, with liquid and engine in motion."""
    sensor = {"station_m": STATIONS[AT], "omega_hz": 60.0, "zeta": 0.65}
    made = rig(with_stage(scenario_of(PARTS), rate_gyro=[sensor], accelerometer=sensor))
    rng = np.random.default_rng(5)
    y, n = made.y, int(layout.pendulum_index(made.sizes, 0))
    y[layout.Q_BI : layout.Q_BI + 4] = np.roll(Rotation.from_rotvec([0.3, -0.5, 0.8]).as_quat(), 1)
    y[layout.W_BI_B : layout.W_BI_B + 3] = 0.7, -0.4, 0.5
    y[layout.ACTUATOR : layout.GYRO] = 1e-2 * rng.normal(size=layout.GYRO - layout.ACTUATOR)
    y[layout.N_FIXED : n] = 2e-4 * rng.normal(size=n - layout.N_FIXED)
    for k in range(2):
        i = n + layout.N_PENDULUM * k
        u = np.array([-1.0, *(0.1 * rng.normal(size=2))])
        u /= np.linalg.norm(u)
        kappa = 0.3 * rng.normal(size=3)
        y[i : i + 3], y[i + 3 : i + 6] = u, kappa - (kappa @ u) * u
    return made


def sensor_motion(y: Array) -> tuple[Array, Rotation]:
    """Return the velocity of the sensor in I and the attitude of its axes, from the state alone."""
    body = Rotation.from_quat(np.roll(y[layout.Q_BI : layout.Q_BI + 4], -1))
    w = y[layout.W_BI_B : layout.W_BI_B + 3]
    eta, nu, xi, nu_yaw = y[layout.N_FIXED : layout.N_FIXED + 4]
    p = w[0]
    moved = np.array([0.0, YAW[0].phi[AT] * xi, PITCH[0].phi[AT] * eta])
    speed = np.array([0.0, YAW[0].phi[AT] * (nu_yaw + p * eta), PITCH[0].phi[AT] * (nu - p * xi)])
    station, across, below = PARTS.core_cg
    place = np.array([station - STATIONS[AT], -across, -below]) + moved
    tilt = Rotation.from_rotvec([0.0, PITCH[0].slope_pm[AT] * eta, -YAW[0].slope_pm[AT] * xi])
    return y[layout.V_I : layout.V_I + 3] + body.apply(np.cross(w, place) + speed), body * tilt


def felt(made: Rig, rate: Array, sensor: int) -> Array:
    """Return the input of a sensor at rest at zero, from the derivative of its lag."""
    i, omega = int(layout.sensor_index(made.sizes, sensor)), 2.0 * np.pi * 60.0
    return np.asarray(rate[i + 1 : i + 6 : 2] / omega**2)


def test_sensor_feels_its_own_motion() -> None:
    made, step = turning(), 2e-5
    y, rate = made.y.copy(), made.derivative(made.y)
    (before, old), (after, new), (_, axes) = (sensor_motion(y + h * rate) for h in (-step, step, 0.0))
    force = axes.inv().apply((after - before) / (2.0 * step))
    np.testing.assert_allclose(felt(made, rate, 1), force, atol=2e-6)
    assert np.abs(force).min() > 0.3
    turn = (old.inv() * new).as_rotvec() / (2.0 * step)
    # the quasi-velocities leave out what the roll rate does to a slope that differs between the planes
    p, (eta, _, xi, _) = y[layout.W_BI_B], y[layout.N_FIXED : layout.N_FIXED + 4]
    apart = PITCH[0].slope_pm[AT] - YAW[0].slope_pm[AT]
    assert abs(p * apart) * max(abs(eta), abs(xi)) < 2e-5
    np.testing.assert_allclose(felt(made, rate, 0), turn, atol=3e-4)


# --- the linear model
@cache
def node(plane: str = "pitch") -> Node:
    return frozen(NODE_S, *SENSORS, plane=plane)[1]


@pytest.mark.slow
@pytest.mark.parametrize("plane", ["pitch", "yaw"])
def test_outputs_of_the_linear_model_are_the_linearised_simulators(plane: str) -> None:
    packed = pack_flight(frozen(NODE_S, *SENSORS)[0].scenario)
    model, body = linearise(packed, zero_incidence(packed, packed.state), NODE_S), node(plane).plant
    pitch, row = plane == "pitch", packed.parameters[0].vehicle
    motion, bend = (["w_mps", "q_radps", "theta_rad"], "eta") if pitch else (["v_mps", "r_radps", "psi_rad"], "xi")
    names = motion + [f"{bend}_{i + 1}{what}" for what in ("_m", "_rate_mps") for i in range(3)]
    names += [f"slosh_{k + 1}_{plane}{what}" for what in ("_rad", "_rate_radps") for k in range(2)]
    states = [model.states.index(name) for name in names]
    drives = [model.states.index(f"actuator_{plane}_{k + 1}") for k in range(6)]
    sign = np.where(np.isin(names, ["r_radps", "psi_rad"]), -1.0, 1.0)
    moves = actuator(row.actuator_pitch if pitch else row.actuator_yaw)
    engine = moves.c[[moves.outputs.index(name) for name in body.inputs]]
    for k, (name, _) in enumerate(node(plane).vehicle.sensors):
        force = name == "accel_mps2"
        axis, side = ("z" if pitch == force else "y"), (1.0 if pitch else -1.0)
        sensed = model.a[model.states.index(f"sensor_{k + 1}_{axis}_rate")] / row.sensors[k].triad.omega_radps ** 2
        out = 1.0 if force else side
        c, d = body.c[len(OUTPUTS) + k], body.d[len(OUTPUTS) + k] @ engine
        np.testing.assert_allclose(out * sensed[states] * sign, c, rtol=1e-8, atol=1e-9 * np.abs(c).max())
        np.testing.assert_allclose(out * side * sensed[drives], d, rtol=1e-8, atol=1e-9 * max(np.abs(d).max(), 1.0))
        assert (np.abs(d).max() > 1e-3) == force  # the engine's reaction reaches the accelerometer at once


# --- the loop
def test_sampled_path_of_each_sensor_is_the_sum_over_its_images() -> None:
    timing, body, one = node().instruments, node().plant, node()
    path = fixed_path(one, "sampled", senses=True)
    assert isinstance(path, SampledFixedPath)
    t = timing.sample_s

    def continuous(f: Array) -> Array:
        s = 2j * np.pi * f
        moved = actuator(one.actuator).response(f)[:, :, 0]
        moves = {name: moved[:, k] for k, name in enumerate(actuator(one.actuator).outputs)}
        drive = np.stack([moves[name] for name in body.inputs], axis=-1)
        out = (body.response(f) @ drive[..., None])[..., 0]
        wanted = [1, *range(len(OUTPUTS), len(OUTPUTS) + 3)]
        lags = [(timing.gyro, 0), *((g, late) for _, g, late in timing.sensors)]
        held = ((1.0 - np.exp(-s * t)) / (s * t)) ** 2 * np.exp(-s * timing.delay_s)
        ways = [lag(s, g.omega_radps, g.zeta) * np.exp(-s * t * late) for g, late in lags]
        return np.asarray(out[:, wanted] * np.stack(ways, axis=-1) * held[:, None])

    f = FREQUENCIES_HZ
    above, below = (
        sum(continuous(n / t + side * f) for n in range(first, 61)) for side, first in ((1.0, 0), (-1.0, 1))
    )
    summed = above + np.conj(below)
    ours = path.responses(FREQUENCIES_HZ)
    np.testing.assert_allclose(ours, summed, rtol=2e-5, atol=2e-6 * np.abs(summed).max(axis=0).max())


def test_a_sensor_without_dynamics_is_one_that_is_very_fast() -> None:
    one, found = node(), []
    for change in ({"ideal": 1}, {"omega_radps": 1e6, "zeta": 0.7}):
        sensors = tuple((name, dataclasses.replace(g, **change), late) for name, g, late in one.instruments.sensors)
        changed = dataclasses.replace(one, instruments=dataclasses.replace(one.instruments, sensors=sensors))
        path = fixed_path(changed, "sampled", senses=True)
        found.append(path.responses(FREQUENCIES_HZ))
    np.testing.assert_allclose(found[0], found[1], rtol=1e-3, atol=1e-4 * np.abs(found[0]).max(axis=0).max())
    assert np.abs(found[0]).min(axis=0).min() > 0.0


def relieving(sample_s: float | None) -> Pd:
    shape = BendingFilter((QuadraticSection(9.0, 0.3, 7.0, 0.7),), ())
    given = shape if sample_s is None else shape.discretize(sample_s, "prewarped", 9.0)
    return Pd(0.9, 0.5, given, 0.0, 0.012, (0.5, 0.3, 0.2), Lag(1.5, sample_s))


@pytest.mark.parametrize("kind", [SampledFixedPath, PadeFixedPath])
def test_state_matrices_give_the_response(kind: type[Any]) -> None:
    one = node()
    if kind is PadeFixedPath:  # refuses the latency of single sensors
        with pytest.raises(ValueError, match="latency"):
            kind(one, senses=True)
        late = tuple((name, g, 0) for name, g, _ in one.instruments.sensors)
        one = dataclasses.replace(one, instruments=dataclasses.replace(one.instruments, sensors=late))
    path = kind(one)
    loop = Loop(path, relieving(path.sample_s))
    s, f = loop.state_space(), FREQUENCIES_HZ
    at = 2j * np.pi * f if path.sample_s is None else np.exp(2j * np.pi * f * path.sample_s)
    wanted = [(s.c @ np.linalg.solve(z * np.eye(len(s.a)) - s.a, s.b) + s.d)[0, 0] for z in at]
    np.testing.assert_allclose(loop.response(f), wanted, rtol=1e-7)
    assert len(loop.open_poles()) <= len(s.a)
    if path.sample_s is None:
        exact = Loop(ExactFixedPath(one), relieving(None)).response(f[:4])
        np.testing.assert_allclose(loop.response(f[:4]), exact, rtol=1e-3)


# --- the computer
@pytest.mark.slow
def test_counts_latency_lost_samples_and_blend() -> None:
    rng, n, unit = np.random.default_rng(2), 200, (3e-4, 0.0, 5e-3)
    sensors = make_sensors(unit, (0, 2, 1), 1, ((0.5, 0.2, 0.3), (0.7, 0.4, -0.1)))
    pool = Pool()
    computer = pack([build_computer(pool, sample_ns=10_000_000, sensors=sensors)])[0]
    state, tables = blank(ComputerState)[0], pool.array()
    start_computer(computer, tables, state, 0.0)
    first, given = 1e-3 * rng.normal(size=(n, 3)), rng.normal(size=(n, 3, 3)) * np.array([1e-3, 1e-3, 0.1])[:, None]
    lost = rng.random((n, 3)) < 0.2
    got, rates, none3, none2 = [], [], np.zeros(3, np.int64), np.zeros(2, np.int64)
    for k in range(n):
        state.sensors.increment[:3], state.sensors.lost[:3] = given[k], lost[k]
        computer_tick(computer, tables, state, 0.01 * (k + 1), first[k], np.zeros(3), none3, np.zeros(2), none2)
        got.append(state.sensors.value[:3].copy())
        rates.append(state.attitude.rate_radps.copy())
    counted = given.copy()
    for k in (0, 2):  # what is counted so far is the true sum, rounded
        sums = np.round(np.cumsum(given[:, k], axis=0) / unit[k]) * unit[k]
        counted[:, k] = np.diff(sums, axis=0, prepend=0.0)
    wanted = np.zeros((n, 3, 3))
    for s, late in enumerate((0, 2, 1)):
        for k in range(n):
            fresh = counted[k - late, s] / 0.01 if k >= late else np.zeros(3)
            wanted[k, s] = (wanted[k - 1, s] if k > 0 else 0.0) if lost[k, s] else fresh
    np.testing.assert_allclose(got, wanted, atol=1e-9)
    for axis, (a, b, c) in ((1, (0.5, 0.2, 0.3)), (2, (0.7, 0.4, -0.1))):
        blended = a * first[:, axis] / 0.01 + b * wanted[:, 0, axis] + c * wanted[:, 1, axis]
        np.testing.assert_allclose(np.array(rates)[:, axis], blended, atol=1e-9)
    np.testing.assert_allclose(np.array(rates)[:, 0], first[:, 0] / 0.01, rtol=1e-12)


@pytest.mark.parametrize("lost", [(0, 0, 0), (0, 1, 0), (0, 0, 1)])
def test_flight_code_gets_each_sensor_in_its_own_place(lost: tuple[int, int, int]) -> None:
    """Two gyros and an accelerometer keep their indices in plain Python, where an index beyond an array is an error."""
    value, delta = np.arange(9.0).reshape(3, 3), 10.0 + np.arange(9.0).reshape(3, 3)
    inputs = SimpleNamespace(health=1, delta_velocity_mps=np.zeros(3), further_rate_radps=np.zeros((2, 3)))
    inputs.imu_health, inputs.imu_delta_angle_rad, inputs.imu_delta_velocity_mps = 1, np.zeros((3, 3)), np.zeros((3, 3))
    state = SimpleNamespace(
        external=SimpleNamespace(inputs=inputs), sensors=SimpleNamespace(lost=lost, value=value, delta=delta)
    )
    computer = SimpleNamespace(sensors=SimpleNamespace(count=3, gyros=2, accelerometer=2))
    getattr(hand_sensors, "py_func", hand_sensors)(computer, state)
    np.testing.assert_array_equal(inputs.further_rate_radps, value[:2])
    np.testing.assert_array_equal(inputs.delta_velocity_mps, delta[2])
    gyros, accelerometer = not any(lost[:2]), not lost[2]
    assert inputs.health == 1 + 2 * accelerometer + 4 * gyros
    np.testing.assert_array_equal(inputs.imu_delta_angle_rad[1:], delta[:2])
    np.testing.assert_array_equal(inputs.imu_delta_velocity_mps[0], delta[2])
    assert inputs.imu_health == (0 if lost[2] else 1)


@pytest.mark.parametrize(
    ("latency", "blend", "why"), [((0,), ((0.5, 0.4),) * 2, "sums to 0.9"), ((0,), ((1.0,),) * 2, "1 weights")]
)
def test_wrong_weights_are_refused(latency: tuple[int], blend: Any, why: str) -> None:
    with pytest.raises(ValueError, match=why):
        make_sensors((0.0,), latency, blend=blend)


# --- in flight
RELIEF = (
    'design.law="load-relief"',
    "design.load_relief.corner_hz=1.5",
    "design.gains={table=[{time_s=0.0, k_p=0.9, k_d_s=0.5, k_a_s2pm=0.012}], yaw='pitch'}",
    "design.blend.pitch=[0.5, 0.3, 0.2]",
)


@pytest.mark.slow  # four flights of a second
@pytest.mark.parametrize("plane", ["pitch", "yaw"])
def test_a_kick_in_flight_moves_the_computer_as_the_loop_says(plane: str) -> None:
    """With all sensors in the law, the loop predicts the commands as in tests/test_oracle_design_loop.py.

    In yaw the sign of the acceleration changes.
    """
    given, kick_deg = (*SENSORS, *RELIEF), 0.01
    window = f"start_s={NODE_S + 0.005:.3f}, stop_s={NODE_S + 0.015:.3f}"
    injection = f'[{{at="gimbal_command", axis="{plane}", kind="step", amplitude_deg={kick_deg}, {window}}}]'
    loaded, flown = frozen(NODE_S, *given, plane=plane)
    plain, kicked = fly(loaded), fly(frozen(NODE_S, *given, f"injection={injection}")[0])
    assert loaded.design is not None
    loop = maxq.loop(flown, loaded.design, kind="sampled")
    assert set(loop.law.inputs) == {"angle_rad", "rate_radps", "rate_2_radps", "rate_3_radps", "accel_mps2"}
    agrees_with_a_kick(loop, plain, kicked, f"gimbal_{plane}_command_deg", NODE_S, kick_deg)


def test_loops_of_all_axes_hold_each_plane_by_itself() -> None:
    loaded, _ = frozen(NODE_S, *SENSORS, *RELIEF)
    packed = pack_flight(loaded.scenario)
    packed.state[:] = zero_incidence(packed, packed.state)
    assert loaded.design is not None
    whole = multiloop(packed, loaded.design, NODE_S)
    planes: tuple[str, ...] = ("pitch", "yaw")
    for axis, plane in enumerate(planes):
        one = maxq.loop(node(plane), loaded.design, kind="sampled").response(FREQUENCIES_HZ)
        np.testing.assert_allclose(whole.response(FREQUENCIES_HZ)[:, axis, axis], one, rtol=1e-5)
    s, z = whole.state_space, np.exp(2j * np.pi * FREQUENCIES_HZ * whole.path.sample_s)
    matrices = [s.c @ np.linalg.solve(x * np.eye(len(s.a)) - s.a, s.b) + s.d for x in z]
    np.testing.assert_allclose(whole.response(FREQUENCIES_HZ), matrices, rtol=1e-6, atol=1e-9)
