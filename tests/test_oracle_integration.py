"""The integrator has the numerical damping of its closed form, and chooses its steps by accuracy."""

from __future__ import annotations

import json
import math
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from flightkit import Array, Mode, Parts, flown, rig, scenario_of
from scipy.linalg import expm

import maxq
from maxq import Flight, FlightRun, ScenarioError, record
from maxq.control.kernel.records import pack
from maxq.sim.flight.oscillators import put_functions, put_oscillator
from maxq.sim.packing.integration import Oscillation, method_error, oscillations, unstable, worst_error
from maxq.sim.packing.vehicle import pack_actuators
from maxq.sim.run.fly import fly
from maxq.sim.run.metrics import step_failure
from maxq.sim.scenario.loader import load_scenario
from maxq.sim.vehicle.actuator.kernel import actuator_derivative, linear_sections
from maxq.sim.vehicle.state import eta_index
from maxq.tools.flight_report import report


@pytest.mark.parametrize(("hz", "added"), [(100.0, 6.5e-4), (150.0, 4.6e-3)])
def test_leading_order_and_the_figures_of_the_documents(hz: float, added: float) -> None:
    error = method_error(Oscillation("", hz, 0.0), 1e-3)
    x = 2.0 * math.pi * hz * 1e-3
    assert error.added_damping_ratio == pytest.approx(x**5 / 144.0, rel=0.25 * x * x)
    assert error.frequency_error == pytest.approx(-(x**4) / 120.0, rel=0.5 * x * x)
    assert error.added_damping_ratio == pytest.approx(added, rel=0.01)


@pytest.mark.parametrize("zeta", [0.0, 0.01, 0.15, 0.7])
@pytest.mark.parametrize("x", [0.05, 0.4, 1.2, 2.5, 2.9])
def test_against_the_method_applied_to_a_matrix(x: float, zeta: float) -> None:
    """The eigenvalues of a step of y' = A y equal those worked out stage by stage."""
    a = np.array([[0.0, 1.0], [-1.0, -2.0 * zeta]])
    k_1 = a
    k_2 = a @ (np.eye(2) + 0.5 * x * k_1)
    k_3 = a @ (np.eye(2) + 0.5 * x * k_2)
    k_4 = a @ (np.eye(2) + x * k_3)
    factor = np.linalg.eigvals(np.eye(2) + x / 6.0 * (k_1 + 2.0 * k_2 + 2.0 * k_3 + k_4))[0]
    growth, turn = math.log(abs(factor)) / x, abs(np.angle(factor)) / x
    error = method_error(Oscillation("", 1.0 / (2.0 * math.pi), zeta), x)
    assert error.added_damping_ratio + zeta == pytest.approx(-growth / math.hypot(growth, turn), abs=1e-12)
    assert error.frequency_error + 1.0 == pytest.approx(math.hypot(growth, turn), rel=1e-12)


def test_the_simulator_damps_a_fast_mode_as_told() -> None:
    """An undamped mode of 100 Hz in empty space, undisturbed for 0.5 s, decays by the closed form."""
    mode = Mode(100.0, 500.0, (1.0, 0.4, -0.2, -0.4, 0.5, 1.1), (-0.3, -0.3, -0.2, 0.2, 0.3, 0.3), 0.0)
    made = rig(scenario_of(Parts(pitch=(mode,)), run={"step_s": 0.001}))
    eta = int(eta_index(made.sizes))
    made.y[eta] = 1e-3
    states = flown(made, 0.5, 0.001)
    amplitude = np.hypot(states[:, eta], states[:, eta + 1] / (2.0 * math.pi * 100.0))
    rate = np.polyfit(np.arange(501) * 1e-3, np.log(amplitude), 1)[0]
    expected = method_error(Oscillation("", 100.0, 0.0), 1e-3).added_damping_ratio * 2.0 * math.pi * 100.0
    assert -rate == pytest.approx(expected, rel=0.02)


def test_what_oscillates_in_ksr3() -> None:
    scenario = load_scenario("nominal").scenario
    names = [o.name for o in oscillations(scenario)]
    assert {"pitch mode 1", "yaw mode 1", "pitch actuator, a3", "gyro"} <= set(names)
    assert "pitch actuator, a4" not in names
    error = worst_error(scenario)
    assert error is not None
    assert error.text == ""
    ideal = load_scenario("nominal", ["switches.bending=false", "switches.actuator=ideal", "switches.gyro=ideal"])
    assert worst_error(ideal.scenario) is None


def test_a_mode_that_is_too_fast_for_the_step_is_said(tmp_path: Path) -> None:
    fast = ["run.duration_s=0.05", "vehicle.stage.0.bending.frequency_factor=[1.0,1.0,3.0]"]
    flight = record(FlightRun(load_scenario("nominal", fast)), tmp_path, log=False)
    told = json.loads((tmp_path / "summary.json").read_text())["integration"]
    assert told["name"] == "pitch mode 3"
    assert told["added_damping_ratio"] > 0.1 * told["damping_ratio"]
    assert "the integrator adds" in told["warning"]
    assert f"warning: {told['warning']}" in report(flight, [], 0.0)
    usual = fly(load_scenario("nominal", fast[:1]), log=False)
    assert "integrator" not in report(usual, [], 0.0)


@pytest.mark.parametrize("zeta", [1e-6, 0.15, 0.9, 1.0, 2.0])
def test_a_step_with_which_the_integrator_is_unstable_is_refused(zeta: float) -> None:
    """The limit is that of the method applied to a matrix: 2.83 on the imaginary axis, 2.79 on the real one."""
    w = 2.0 * math.pi * 30.0
    a = np.array([[0.0, 1.0], [-w * w, -2.0 * zeta * w]])

    def grows(h: float) -> bool:
        z = a * h
        step = np.eye(2) + z @ (np.eye(2) + z @ (np.eye(2) + z @ (np.eye(2) + z / 4.0) / 3.0) / 2.0)
        return bool(np.abs(np.linalg.eigvals(step)).max() > 1.0)

    low, high = 0.1 / w, 4.0 / w
    while high - low > 1e-9:
        middle = 0.5 * (low + high)
        low, high = (low, middle) if grows(middle) else (middle, high)
    slow = ["run.duration_s=1.0", "vehicle.computer.sample_s=0.03", "switches.bending=false", "switches.actuator=ideal"]
    gyro = ["vehicle.stage.0.gyro.omega_hz=30.0", f"vehicle.stage.0.gyro.zeta={zeta}"]

    def largest(factor: float) -> list[str]:
        return [*slow, *gyro, f"run.step_s={round(factor * low, 7)}"]

    assert unstable(load_scenario("nominal", largest(0.999)).scenario) is None
    refused = load_scenario("nominal", largest(1.001))
    assert unstable(refused.scenario) == Oscillation("gyro", 30.0, zeta)
    with pytest.raises(ScenarioError, match=r"run\.step_s = 0\.0\d+: the integrator is unstable for gyro \(30 Hz\)"):
        FlightRun(refused)
    sampled = load_scenario("nominal", [*slow[:1], *slow[2:], *gyro, "run.step_s=1.0"])  # steps end at samples
    assert (unstable(sampled.scenario) is None) == (zeta <= 1.0)
    assert unstable(load_scenario("nominal", [*slow, *gyro, "run.accuracy=0.05"]).scenario) is None


# --- steps by run.accuracy

_put_oscillator, _put_functions, _linear_sections, _actuator_derivative = (  # few numbers: not worth a compiler
    getattr(f, "py_func", f) for f in (put_oscillator, put_functions, linear_sections, actuator_derivative)
)
ACCURATE = "run.accuracy=0.01"
IDEAL = (  # converters, DAC and roll thrusters know steps only: their scatter would hide what is compared
    "run.duration_s=20", "switches.converter=ideal", "switches.roll_control=false",
    "vehicle.computer.dac_step_deg=0.0",
)  # fmt: skip  # a table


def expected(d: Array, h: float) -> list[Array]:
    """Return the matrices of a block from the exponential of a larger matrix (Sidje, ACM TOMS 24, 1998, 130)."""
    n = len(d)

    def phi(t: float) -> list[Array]:
        big = np.zeros((4 * n, 4 * n))
        big[:n, :n] = t * d
        for k in range(3):
            big[k * n : (k + 1) * n, (k + 1) * n : (k + 2) * n] = np.eye(n)
        whole = expm(big)
        return [whole[:n, k * n : (k + 1) * n] for k in range(4)]

    whole, half = phi(h), phi(0.5 * h)
    return [
        d, 0.5 * h * half[1], h * half[2], h * whole[1], 2.0 * h * whole[2],
        h * (2.0 * whole[2] - 4.0 * whole[3]), h * (4.0 * whole[3] - whole[2]),
    ]  # fmt: skip  # a table


@pytest.mark.parametrize(("hz", "zeta", "h"), [(0.5, 0.0, 1e-3), (50.0, 0.005, 3.5e-3), (60.0, 1.7, 0.01)])
def test_matrices_of_an_oscillator(hz: float, zeta: float, h: float) -> None:
    w = 2.0 * math.pi * hz
    kept = np.zeros(4 * 7)
    _put_oscillator(kept, 0, w * w, 2.0 * zeta * w, h)
    for got, wanted in zip(
        kept.reshape(7, 2, 2), expected(np.array([[0.0, 1.0], [-w * w, -2.0 * zeta * w]]), h), strict=True
    ):
        assert got == pytest.approx(wanted, rel=1e-9, abs=1e-12 * np.abs(wanted).max())


@pytest.mark.parametrize("act_on", ["servo", "engine"])
@pytest.mark.parametrize("model", ["second-order", "fourth-order", "sixth-order"])
def test_matrices_of_an_actuator(model: str, act_on: str) -> None:
    """D equals the derivative of the states with respect to themselves, by differences."""
    given = load_scenario("nominal").vehicle.stage[0].actuator
    assert not isinstance(given, tuple)
    count = {"second-order": 1, "fourth-order": 2, "sixth-order": 4}[model]
    change = {"model": model, "limits_act_on": act_on, "omega_hz": given.omega_hz[:count], "zeta": given.zeta[:count]}
    a = pack([pack_actuators(given.model_copy(update=change), "full")[0]])[0]
    n, kept = a.order, np.zeros(7 * 36 + 72)
    _linear_sections(a, kept, 0)
    d = np.zeros((n, n))
    for j in range(n):
        y, dy = np.zeros(6), np.zeros(6)
        y[j] = 1e-6
        _actuator_derivative(a, y, 0, 0.0, dy)
        d[:, j] = 1e6 * dy[:n]
    assert kept[: n * n].reshape(n, n) == pytest.approx(d, rel=1e-9, abs=1e-9)
    for got, wanted in zip(functions_of(kept[: n * n].reshape(n, n), 0.0035), expected(d, 0.0035), strict=True):
        assert got == pytest.approx(wanted, rel=1e-9, abs=1e-12 * np.abs(wanted).max())


def functions_of(d: Array, h: float) -> Array:
    """Return the seven matrices of a block, computed by the simulator."""
    n, kept = len(d), np.zeros(7 * 36 + 72)
    kept[: n * n] = d.ravel()
    _put_functions(kept, 0, n, h, 7 * 36)
    return kept[: 7 * n * n].reshape(7, n, n)


@pytest.mark.parametrize("h", [1.0, 2.0])
def test_matrices_of_a_turn_by_a_radian(h: float) -> None:
    """exp(t D) of D = [[0, 1], [-1, 0]] turns by t, and forced motion is (sin t, 1 - cos t), for any t."""
    d = np.array([[0.0, 1.0], [-1.0, 0.0]])
    ours = functions_of(d, h)
    assert ours[3] == pytest.approx(math.sin(h) * np.eye(2) + (1.0 - math.cos(h)) * d, abs=1e-14)  # h phi_1
    for got, wanted in zip(ours, expected(d, h), strict=True):
        assert got == pytest.approx(wanted, abs=1e-13)


LONG = """
import json
import sys
import numpy as np
from flightkit import Mode, Parts, rig, scenario_of
from maxq.sim.flight import oscillators as o
mode = Mode(20.0, 500.0, (1.0, 0.4, -0.2, -0.4, 0.5, 1.1), (-0.3, -0.3, -0.2, 0.2, 0.3, 0.3), 0.01)
made = rig(scenario_of(Parts(pitch=(mode,), yaw=(mode,)), run={"accuracy": 0.05}, switches={"actuator": sys.argv[1]}))
run = made.run()
run.fly_segment(600_000_000)
kept = run._arena[0].kept
found = []
for slot in np.arange(o.LENGTHS) * o.LENGTH_WIDTH:
    blocks = kept[slot + o.HEAD :][: 4 * int(kept[slot + o.COUNT])].reshape(-1, 4).astype(int)
    covered = [int(first + stride * k) for first, stride, states, _ in blocks for k in range(states)]
    if kept[slot + o.STEP_NS] > 0:
        found.append([int(kept[slot + o.STEP_NS]), len(blocks), covered])
print(json.dumps([found, int(run.memory.clock.steps)]))
"""


@pytest.mark.slow
@pytest.mark.parametrize(("actuator", "drives"), [pytest.param("full", 2, marks=pytest.mark.long), ("ideal", 0)])
def test_each_length_of_step_has_its_matrices_once_and_for_all_that_swings(actuator: str, drives: int) -> None:
    """Each step length has its matrices once, also after those of the modes are renewed.

    The vehicle has a mode in each plane, actuators of order six and three gyros.
    """
    environment = os.environ | {"NUMBA_DISABLE_JIT": "1", "PYTHONPATH": os.pathsep.join(sys.path)}
    done = subprocess.run(
        [sys.executable, "-c", LONG, actuator], env=environment, capture_output=True, text=True, check=True, timeout=300
    )
    found, steps = json.loads(done.stdout)
    lengths = [length for length, _, _ in found]
    assert steps > 2 * len(lengths)
    assert len(set(lengths)) == len(lengths)
    for _, blocks, covered in found:
        assert blocks == 2 + drives + 3
        assert len(set(covered)) == len(covered) == 2 * 2 + drives * 6 + 3 * 2


@pytest.mark.slow
def test_a_fast_mode_is_not_damped_by_steps_of_its_accuracy() -> None:
    """An undamped mode of 100 Hz, undisturbed for 0.5 s, is exact for every step."""
    mode = Mode(100.0, 500.0, (1.0, 0.4, -0.2, -0.4, 0.5, 1.1), (-0.3, -0.3, -0.2, 0.2, 0.3, 0.3), 0.0)
    made = rig(scenario_of(Parts(pitch=(mode,)), run={"accuracy": 0.05}))
    eta = int(eta_index(made.sizes))
    made.y[eta] = 1e-3
    states = flown(made, 0.5, 0.01)
    assert states[:, eta] == pytest.approx(1e-3 * np.cos(200.0 * math.pi * 0.01 * np.arange(51)), abs=1e-9)
    assert made.run().memory.clock.steps < 250


@pytest.fixture(scope="module")
def by_accuracy() -> Flight:
    return fly(load_scenario("nominal", [*IDEAL, ACCURATE]))


def test_pieces_between_two_instants_are_equal(by_accuracy: Flight) -> None:
    """Commands take effect 3 ms after samples every 10 ms; the steps are 3, 3.5 and 3.5 ms."""
    assert by_accuracy.steps == pytest.approx(3 * 2000, abs=80)  # the schedule's breakpoints are instants, too


def test_rows_between_steps_are_those_of_a_finer_flight(by_accuracy: Flight) -> None:
    finer = fly(load_scenario("nominal", IDEAL))
    for channel, room in (
        ("altitude_m", 5e-4), ("gimbal_pitch_angle_deg", 2e-4), ("eta_pitch_1_m", 1e-8), ("q_BI_y", 1e-7),
        ("gyro_pitch_rate_degps", 1e-3),
    ):  # fmt: skip  # a table
        assert (by_accuracy.time_s(channel) == finer.time_s(channel)).all()
        assert by_accuracy[channel] == pytest.approx(finer[channel], abs=room), channel
    for name, value in finer.metrics.items():
        if math.isfinite(value) and abs(value) > 1e-6:
            assert by_accuracy.metrics[name] == pytest.approx(value, rel=3e-3), name


def test_where_a_segment_ends_changes_no_flight_of_long_steps(by_accuracy: Flight) -> None:
    run = FlightRun(load_scenario("nominal", [*IDEAL, ACCURATE]), log=False)
    while not run.finished:
        run.fly_segment(7_000_000)
    assert run.result().state_hash == by_accuracy.state_hash


def test_local_errors_are_recorded_where_steps_follow_from_accuracy(by_accuracy: Flight) -> None:
    for name in ("step_error_bending_m", "step_error_slosh_deg", "step_error_position_m"):
        assert 0.0 < by_accuracy.metrics[name] < 1e-3, name
    assert not by_accuracy.failures
    fixed = fly(load_scenario("nominal", ["run.duration_s=0.1"]), log=False)
    assert math.isnan(fixed.metrics["step_error_attitude_deg"])


def test_a_tank_that_runs_empty_within_the_step_is_no_error_of_the_integration() -> None:
    """In run 397 the LOX tank empties in a step that is repeated as two halves, and no error is reported.

    A pendulum without mass counted with 0.96 deg.
    """
    found = fly(maxq.load("campaigns/ksr3").scenario_of(397), log=False)
    assert not [f for f in found.failures if "integration" in f]
    assert 0.0 < found.metrics["step_error_slosh_deg"] < 0.02


def test_what_an_actuators_play_does_to_steps_is_estimated_as_large_as_it_is() -> None:
    """The estimated effect of a play of 0.045 deg in run 886 equals the difference from a flight in steps of 0.5 ms.

    Estimates in which crossings never cancel are 20 times as large and would fail it.
    """
    by_accuracy, finer = (
        fly(maxq.load("campaigns/ksr3", *overrides).scenario_of(886), log=False)
        for overrides in ([], ["run.step_s=0.0005"])
    )
    assert not [f for f in by_accuracy.failures if "integration" in f]
    error = abs(by_accuracy.metrics["max_bending_m"] - finer.metrics["max_bending_m"])
    assert error < by_accuracy.metrics["step_error_bending_m"] < 10.0 * error


def test_an_error_beyond_the_accuracy_is_a_failure(by_accuracy: Flight) -> None:
    required = by_accuracy.scenario.scenario.requirement
    run = by_accuracy.scenario.scenario.run
    assert run.accuracy == 0.01
    assert step_failure(run, by_accuracy.metrics, required) == ""
    worse = by_accuracy.metrics | {"step_error_slosh_deg": 0.11}
    assert "0.11 deg exceeds run.accuracy = 0.01" in step_failure(run, worse, required)  # 10 deg are allowed
    assert step_failure(run.model_copy(update={"accuracy": 0.02}), worse, required) == ""

    coarsest = step_failure(run.model_copy(update={"halvings": 3}), worse, required)
    assert [m.rpartition("; ")[2] for m in (step_failure(run, worse, required), coarsest)] == [
        "set run.halvings = 1",
        "set run.step_s instead of run.accuracy",
    ]


def test_errors_that_no_sensor_resolves_fail_no_quiet_flight(by_accuracy: Flight) -> None:
    """Without a requirement, 5e-4 deg and 0.01 mm are allowed, however little the vehicle moves."""
    run = by_accuracy.scenario.scenario.run
    quiet = by_accuracy.metrics | {"max_slosh_deg": 1e-6, "step_error_slosh_deg": 4.9e-4}
    assert step_failure(run, quiet, ()) == ""
    assert "slosh" in step_failure(run, quiet | {"step_error_slosh_deg": 5.1e-4}, ())
    quiet = by_accuracy.metrics | {"max_bending_m": 1e-9, "step_error_bending_m": 0.9e-5}
    assert step_failure(run, quiet, ()) == ""
    assert "bending" in step_failure(run, quiet | {"step_error_bending_m": 1.1e-5}, ())


def test_each_halving_halves_the_longest_step() -> None:
    """A projectile without fast components has steps of 10 ms, and each halving halves them."""
    changes = ("run.step_s=", "run.accuracy=0.1", "run.duration_s=0.4")
    flights = [
        fly(load_scenario("checkcases/shot-north", [*changes, f"run.halvings={n}"]), log=False) for n in range(4)
    ]
    assert [flight.steps for flight in flights] == [40, 80, 160, 320]


def test_accuracy_or_step() -> None:
    with pytest.raises(ScenarioError, match=r"run\.halvings.*0 without run\.accuracy"):
        load_scenario("nominal", ["run.halvings=1"])
    with pytest.raises(ScenarioError, match="one of step_s, accuracy"):
        load_scenario("nominal", [ACCURATE, "run.step_s=0.002"])
