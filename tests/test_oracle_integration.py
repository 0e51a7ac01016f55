"""The Runge-Kutta method's own damping: its closed form, a method applied to a matrix, and the simulator itself."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest
from flightkit import Mode, Parts, flown, rig, scenario_of

from maxq.sim.api import FlightRun, fly, load_scenario, record
from maxq.sim.run.integration import Oscillation, method_error, oscillations, worst_error
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
    """Eigenvalues of a step of y' = A y, worked out stage by stage."""
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
    """One undamped mode of 100 Hz in empty space, left alone for 0.5 s."""
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
