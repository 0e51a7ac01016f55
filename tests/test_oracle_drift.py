"""Feedback of the lateral drift (kernel, loop, optimiser, steady states) agrees with independent calculations.

| quantity | oracle |
|---|---|
| command of the computer, with and without an integral, in pitch and yaw | cumulative sums |
| commands with the names of the laws in another order | the same oracles |
| drift of a given plant: response, state space, sampling with a delay of several samples | its own states, exact kind |
| a kick in flight; the lower gain margin of a held flight | the sampled loop |
| loops of all axes | the loops of both planes |
| gradient by the law's parameters | the response itself, by differences; the law at one instant |
| steady wind: angle of attack, drift, conditions of minimum load and drift | the closed system's matrices |
"""

from __future__ import annotations

import os
import subprocess
import sys
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from design_nodes import agrees_with_a_kick, frozen
from scipy.signal import lfilter
from zero_incidence import zero_incidence

import maxq
from maxq.control.computer import ComputerState, build_computer, computer_tick, start_computer
from maxq.control.filters import BendingFilter, QuadraticSection
from maxq.control.kernel.records import blank, pack
from maxq.control.kernel.tables import Pool
from maxq.control.laws.pd import GainSchedule, gains_table
from maxq.control.sensors import make_sensors
from maxq.design.case.schema import read_case
from maxq.design.certificate.certificate import certify_node
from maxq.design.laws.drift import drift_k_zd, in_steady_wind, minimum_drift_k_alpha
from maxq.design.laws.pd import Pd
from maxq.design.loop.fixed_path import fixed_path
from maxq.design.loop.loop import Loop
from maxq.design.loop.multiloop import multiloop
from maxq.design.model.given import GivenPoint
from maxq.design.model.given_file import read_points
from maxq.design.optimise.at_nodes import make_problem
from maxq.design.optimise.solve import nominal_plants
from maxq.sim.packing.flight import pack_flight
from maxq.sim.run.fly import fly
from maxq.sim.scenario.loader import load_scenario

T = 0.01
F2 = BendingFilter((QuadraticSection(9.0, 0.3, 7.0, 0.7),))
PLAIN = GainSchedule([0.0, 10.0], [1.2, 0.8], [0.5, 0.4], k_zd_radspm=[0.02, 0.01], k_z_radpm=[0.003, 0.006])
WITH_INTEGRAL = GainSchedule(
    [0.0, 10.0], [1.2, 0.8], [0.5, 0.4], [0.3, 0.2], k_zd_radspm=[0.02, 0.01], k_z_radpm=[0.003, 0.006]
)


# --- the computer
@pytest.mark.parametrize(("law", "gains"), [("drift", PLAIN), ("pid-drift", WITH_INTEGRAL)])
def test_command_is_pd_and_the_integrated_acceleration_behind_the_filter(law: Any, gains: GainSchedule) -> None:
    """The command is the filtered sum of PD (or PID) and the integrated acceleration.

    The axial force turns with the attitude error, which the clamp of the law's input does not limit.
    """
    discrete, pool, clamp_rad = F2.discretize(T, "prewarped", 9.0), Pool(), 0.004
    built = build_computer(
        pool,
        sample_ns=10_000_000,
        law=law,
        gains=gains_table(gains),
        attitude="rate-integral",
        angle_error_limit_rad=clamp_rad,
        pitch_filter=discrete,
        sensors=make_sensors((0.0,), (0,), accelerometers=1),
    )
    computer, state, tables = pack([built])[0], blank(ComputerState)[0], pool.array()
    start_computer(computer, tables, state, 0.0)
    rng = np.random.default_rng(1)
    turns, pushes = rng.normal(scale=1e-3, size=(200, 3)), rng.normal(scale=2e-2, size=(200, 3))
    pushes[:, 0] += 15.0 * T
    flown, none3, none2 = [], np.zeros(3, np.int64), np.zeros(2, np.int64)
    for n in range(200):
        state.sensors.increment[0] = pushes[n]
        computer_tick(computer, tables, state, T * (n + 1), turns[n], np.zeros(3), none3, np.zeros(2), none2)
        flown.append(state.command_rad.copy())
    time_s = T * np.arange(1, 201)
    of = {name: np.interp(time_s, gains.at, getattr(gains, name)) for name in gains.columns}
    for gimbal, side in ((0, pushes[:, 2]), (1, -pushes[:, 1])):
        angle = np.cumsum(turns[:, gimbal + 1])
        assert np.abs(angle).max() > 2.0 * clamp_rad
        drift_mps = np.cumsum(side - pushes[:, 0] * angle)
        error = np.clip(angle, -clamp_rad, clamp_rad)
        wanted = -of["k_p"] * error - of["k_d_s"] * turns[:, gimbal + 1] / T
        wanted += of["k_zd_radspm"] * drift_mps + of["k_z_radpm"] * T * np.cumsum(drift_mps)
        if law == "pid-drift":
            wanted -= T * np.cumsum(of["k_i_ps"] * error)
        for b0, b1, b2, a1, a2 in discrete.sections:
            wanted = lfilter([b0, b1, b2], [1.0, a1, a2], wanted)
        np.testing.assert_allclose(np.array(flown)[:, gimbal], wanted, rtol=1e-9, atol=1e-12)


@pytest.mark.slow
def test_the_order_of_the_laws_names_decides_nothing() -> None:
    """Repeat the commands of all kinds of laws with the list of their names reversed."""
    script = """
from maxq.control import structures
structures.LAWS = structures.LAWS[::-1]
import test_oracle_drift as drift, test_oracle_load_relief as relief, test_oracle_pid as pid
drift.test_command_is_pd_and_the_integrated_acceleration_behind_the_filter("drift", drift.PLAIN)
drift.test_command_is_pd_and_the_integrated_acceleration_behind_the_filter("pid-drift", drift.WITH_INTEGRAL)
relief.test_command_is_pd_and_the_filtered_acceleration_behind_the_filter()
pid.test_command_is_the_sum_of_three_terms_behind_the_filter()
"""
    environment = os.environ | {"NUMBA_DISABLE_JIT": "1", "PYTHONPATH": os.pathsep.join(sys.path)}
    command, folder = [sys.executable, "-c", script], Path(__file__).parent
    ran = subprocess.run(command, cwd=folder, env=environment, capture_output=True, check=False, text=True)
    assert ran.returncode == 0, ran.stderr


# --- the path of a given plant
LAW = Pd(1.2, 0.5, F2, k_i_ps=0.1, k_zd_radspm=2e-3, k_z_radpm=4e-4)
HZ = np.geomspace(0.02, 4.0, 25)


@cache
def point(*overrides: str) -> GivenPoint:
    return read_points("greensite", overrides).point(72.0)


def across(at: GivenPoint, hz: np.ndarray) -> np.ndarray:
    """Return the drift velocity at the instruments per gimbal angle, z' - phi eta', from the states of the plant."""
    plant, mode = at.plant, at.coefficients.modes[0]  # type: ignore[union-attr]  # it has some
    of_states = np.array([1.0, 0.0, -at.condition.airspeed_mps, 0.0, -mode.phi_gyro])
    s = 2j * np.pi * hz
    return np.array([of_states @ np.linalg.solve(x * np.eye(5) - plant.a, plant.b[:, 0]) for x in s])


def test_navigation_finds_the_drift_of_the_states() -> None:
    at, s = point("computer.delay_s=0.0"), 2j * np.pi * HZ
    path = fixed_path(at, "exact").with_inputs(LAW.inputs)
    ours = path.response(HZ) * path.ratio("drift_mps", HZ)
    actuator = 4900.0 / (s * s + 98.0 * s + 4900.0)
    np.testing.assert_allclose(ours, across(at, HZ) * actuator, rtol=1e-9)
    np.testing.assert_allclose(path.response(HZ) * path.ratio("drift_m", HZ), ours / s, rtol=1e-12)


def test_the_drift_velocity_of_a_plant_adds_no_pole_and_the_displacement_one() -> None:
    loop = Loop(fixed_path(point("computer.delay_s=0.0"), "pade"), Pd(1.2, 0.5, k_zd_radspm=2e-3))
    assert len(loop.closed_poles()) == 7  # actuator 2, plant 5
    both = Loop(loop.fixed, Pd(1.2, 0.5, k_zd_radspm=2e-3, k_z_radpm=4e-4))
    assert len(both.closed_poles()) == len(both.open_poles()) == 8
    assert np.abs(loop.open_poles()).min() > 1e-3
    assert np.abs(both.open_poles()).min() == 0.0


@pytest.mark.parametrize("kind", ["sampled", "pade"])
def test_matrices_have_the_response_of_the_path(kind: Any) -> None:
    law = replace(LAW, filter=F2.discretize(0.008, "prewarped", 9.0)) if kind == "sampled" else LAW
    loop = Loop(fixed_path(point("computer.sample_s=0.008", "computer.delay_s=0.02"), kind), law)
    s = loop.state_space()
    x = np.exp(2j * np.pi * HZ * 0.008) if kind == "sampled" else 2j * np.pi * HZ
    matrices = [(s.c @ np.linalg.solve(z * np.eye(len(s.a)) - s.a, s.b) + s.d)[0, 0] for z in x]
    np.testing.assert_allclose(loop.response(HZ), matrices, rtol=1e-8)


def test_a_delay_of_several_samples_is_that_of_the_exact_loop() -> None:
    """For 8 ms samples with a delay of 20 ms, the exact loop differs by the aliasing of the images only."""
    at = point("computer.sample_s=0.008", "computer.delay_s=0.02")
    loops = [Loop(fixed_path(at, kind), Pd(1.2, 0.5, k_zd_radspm=2e-3)) for kind in ("sampled", "exact")]  # type: ignore[arg-type]  # kinds
    sampled, exact = (loop.response(HZ) for loop in loops)
    turned = np.exp(-2j * np.pi * HZ * 0.004)  # a sum is half a sample later than the integral of the mean
    assert np.abs(np.angle(sampled / (exact * turned))).max() > 0.05  # of the rate's part, which has no sum
    np.testing.assert_allclose(sampled, exact_of_sums(loops[0]), rtol=2e-4)


def exact_of_sums(loop: Loop) -> np.ndarray:
    """Return the continuous path without images, with the computer's sums instead of integrals."""
    node, s = loop.fixed.node, 2j * np.pi * HZ
    exact = fixed_path(node, "exact").with_inputs(loop.law.inputs)
    summed = 0.008 / (1.0 - np.exp(-0.008 * s))
    rate, push = exact.response(HZ), exact.response(HZ) * exact.ratio("accel_mps2", HZ)
    drift = (push - node.axial_load_mps2 * summed * rate) * summed
    return 1.2 * summed * rate + 0.5 * rate - 2e-3 * drift


# --- in flight
ACCELEROMETER = "vehicle.stage.0.accelerometer={station_m=4.0, omega_hz=80, zeta=0.7, latency_samples=1}"
DRIFT = (
    ACCELEROMETER,
    'design.law="pid-drift"',
    "design.gains={table=[{time_s=0.0, k_p=0.9, k_d_s=0.5, k_i_ps=0.2, k_zd_radspm=0.5, k_z_radpm=0.3}], yaw='pitch'}",
)


@cache
def still() -> tuple[str, ...]:
    """Return an upright attitude in gravity equal to the axial load, so that the axial acceleration is zero."""
    at = frozen(40.0, *DRIFT)[1]
    return (
        "initial.euler_deg=[0, 90, 0]",
        f"initial.ned_mps=[0, 0, {-at.condition.airspeed_mps!r}]",
        f"earth.uniform_mps2={at.axial_load_mps2!r}",
    )


@pytest.mark.slow  # four flights of a second
@pytest.mark.parametrize("plane", ["pitch", "yaw"])
def test_a_kick_in_flight_moves_the_computer_as_the_loop_says(plane: str) -> None:
    """A kick in flight moves the command as in tests/test_oracle_sensors.py, with drift gains that act in 0.5 s."""
    given, kick_deg = (*DRIFT, *still()), 0.01
    window = "start_s=40.005, stop_s=40.015"
    injection = f'[{{at="gimbal_command", axis="{plane}", kind="step", amplitude_deg={kick_deg}, {window}}}]'
    loaded, flown = frozen(40.0, *given, plane=plane)
    plain, kicked = fly(loaded), fly(frozen(40.0, *given, f"injection={injection}")[0])
    assert loaded.design is not None
    loop = maxq.loop(flown, loaded.design, kind="sampled")
    assert loop.law.inputs == ("angle_rad", "rate_radps", "angle_integral_rads", "drift_mps", "drift_m")
    assert not loop.fixed.drift_rests_at_dc  # the bent body tilts the accelerometer and the gyro differently
    agrees_with_a_kick(loop, plain, kicked, f"gimbal_{plane}_command_deg", 40.0, kick_deg)
    share = f"drift_share_{plane}_deg"
    assert np.abs(kicked[share] - plain[share]).max() > 0.0005


def test_loops_of_all_axes_hold_each_plane_by_itself() -> None:
    loaded, flown = frozen(40.0, *DRIFT, *still())
    packed = pack_flight(loaded.scenario)
    packed.state[:] = zero_incidence(packed, packed.state)
    assert loaded.design is not None
    whole, hz = multiloop(packed, loaded.design, 40.0), np.array([0.05, 0.3, 1.1, 3.0, 9.0, 27.0])
    one = maxq.loop(flown, loaded.design, kind="sampled").response(hz)
    np.testing.assert_allclose(whole.response(hz)[:, 0, 0], one, rtol=1e-4)
    s, z = whole.state_space, np.exp(2j * np.pi * hz * whole.path.sample_s)
    matrices = [s.c @ np.linalg.solve(x * np.eye(len(s.a)) - s.a, s.b) + s.d for x in z]
    np.testing.assert_allclose(whole.response(hz), matrices, rtol=1e-6, atol=1e-7)


# --- the optimiser
@pytest.mark.parametrize("law", ["drift", "pid-drift"])
def test_gradients_are_those_of_the_response(law: str) -> None:
    """d ln L by each parameter equals central differences of C and of the path; C is that of the law's controllers."""
    changes = (f"law={law}", "filter.structure=F2", "nodes_s=[60.0, 72.0]", "gains.schedule=linear")
    loaded = read_case("greensite", changes)
    plants = nominal_plants(loaded)
    variables = make_problem(loaded.case, plants).law
    x, u = np.log(np.geomspace(0.05, 3.0, 5)), variables.starts(1, 1)[0]
    axis, own = variables.axis(x), np.repeat(variables.own(u)[:1], len(x), axis=0)
    path = plants.each[0].path
    ways = np.stack([path.response(np.exp(x)) * path.ratio(name, np.exp(x)) for name in variables.inputs], axis=1)

    def log_loop(at: np.ndarray) -> np.ndarray:
        given = variables.log_response(at, axis)
        return given.common[0] + np.log((given.gains[0] * ways).sum(axis=1))

    whole = (variables.controllers(u)[0].response(np.exp(x)) * ways).sum(axis=1)
    np.testing.assert_allclose(np.exp(log_loop(own)), whole, rtol=1e-12)
    gains = variables.log_response(own, axis).gains[0]
    ours = variables.gradient(own, axis, ways / (gains * ways).sum(axis=1)[:, None])
    for k, step in enumerate(1e-5 * np.eye(variables.own_size)):
        np.testing.assert_allclose(ours[:, k], (log_loop(own + step) - log_loop(own - step)) / 2e-5, atol=1e-7)
    assert np.abs(ours[:, -2:]).max() > 1e-4  # of both gains of the drift


# --- steady wind
def settled(at: GivenPoint, k_p: float, k_alpha: float, k_zd: float) -> tuple[float, float]:
    """Return angle of attack and drift in a steady wind of 1 m/s, from the closed loop of the rigid plant."""
    plant, speed = dict(at.parts)["aerodynamics"], at.condition.airspeed_mps
    # w, q, theta; alpha = (w - v) / V, z' = w - V theta
    law = np.array([-k_alpha / speed + k_zd, -0.4, -k_p - k_zd * speed])
    a = plant.a + np.outer(plant.b[:, 0], law)
    b = plant.b[:, 1] + plant.b[:, 0] * k_alpha / speed
    w, _, theta = np.linalg.solve(a, -b)
    return (w - 1.0) / speed, w - speed * theta


@pytest.mark.parametrize(("k_alpha", "k_zd"), [(0.0, 1e-3), (0.0, 0.0), (0.4, 5e-4), (-0.2, 3e-3)])
def test_steady_wind_is_that_of_the_closed_matrices(k_alpha: float, k_zd: float) -> None:
    at = point()
    assert at.coefficients is not None
    found = in_steady_wind(at.coefficients, 1.7, k_zd, k_alpha)
    np.testing.assert_allclose(found, settled(at, 1.7, k_alpha, k_zd), rtol=1e-9, atol=1e-12)


def test_conditions_of_minimum_load_and_minimum_drift() -> None:
    at = point()
    given = at.coefficients
    assert given is not None
    assert settled(at, 1.7, 0.0, 0.0) == pytest.approx((0.0, 1.0), abs=1e-9)
    least = minimum_drift_k_alpha(given, 1.7)
    assert least == pytest.approx(2.5942, abs=1e-4)
    assert settled(at, 1.7, least, 1e-3)[1] == pytest.approx(0.0, abs=1e-9)
    k_zd = drift_k_zd(given, 1.7, 0.25)
    assert k_zd == pytest.approx(3.971e-3, rel=1e-3)
    assert settled(at, 1.7, 0.0, k_zd)[1] == pytest.approx(0.25, rel=1e-9)
    with pytest.raises(ValueError, match=r"share = 0: allowed is above 0, at most 1"):
        drift_k_zd(given, 1.7, 0.0)


# --- certificate
CERTIFIED = """
schema = 2
law = "drift"
[gains]
table = [{time_s = 40.0, k_p = 0.8, k_d_s = 0.4, k_zd_radspm = 0.003, k_z_radpm = 2e-4}]
"""


@pytest.mark.long
def test_the_lower_gain_margin_of_the_drift_is_measured_in_flight(tmp_path: Path) -> None:
    """At 0.007 Hz the drift alone is fed back; the gain is reduced until the vehicle diverges from its path."""
    (tmp_path / "drift.toml").write_text(CERTIFIED)
    loaded = load_scenario("load-relief", [f'design="{tmp_path / "drift.toml"}"'])
    (node,) = maxq.nodes(loaded, [40.0])
    found = certify_node(loaded, node, bands=(), names=("gain_down",))
    (row,) = found.margins
    assert row.frequency_hz == pytest.approx(0.007, abs=0.001)
    assert row.measured == pytest.approx(row.held, abs=0.05)
    assert row.agrees
