"""Navigation errors equal closed forms and one-dimensional equations.

A cutoff is extrapolated over at most 1.5 samples of 10 ms. The error of a speed is at most 1.5^2 samples^2 / 2 times
its second derivative, which is zero where the speed grows uniformly.
"""

from __future__ import annotations

import math

import numpy as np
import pytest
from flightkit import load, merged
from scipy.integrate import quad, solve_ivp
from scipy.optimize import brentq
from test_oracle_cutoff import ACCEL, CONSTANT, SPACE, THRUST_N, TREE, FLOW_kgps, MASS_kg, in_space

from maxq import ScenarioError
from maxq.sim.run.fly import fly

MU = 3.986004418e14


@pytest.mark.parametrize("alignment_deg", [(0.0, 0.0, 20.0), (35.0, 0.0, 20.0), (0.0, -25.0, 0.0)])
@pytest.mark.parametrize("error", [(5.0, 0.0, 0.0), (0.0, 30.0, -20.0)])
def test_cutoff_is_where_the_navigated_speed_has_its_value(
    error: tuple[float, ...], alignment_deg: tuple[float, ...]
) -> None:
    """The computed attitude is the true one turned by the alignment error, and so is the gained velocity."""
    flight = in_space(
        500.0, {"navigation": {"velocity_error_mps": list(error), "alignment_error_deg": list(alignment_deg)}}
    )
    psi = np.radians(alignment_deg)
    angle = float(np.linalg.norm(psi))
    axis = psi / angle
    along = math.cos(angle) * np.eye(3)[0] + math.sin(angle) * np.cross(axis, np.eye(3)[0])
    along = along + (1.0 - math.cos(angle)) * axis[0] * axis  # Rodrigues
    start = np.array([100.0, 0.0, 0.0]) + error
    gained = brentq(lambda g: float(np.linalg.norm(start + g * along)) - 500.0, 0.0, 600.0)
    assert flight.event_s("burnout") == pytest.approx(gained / ACCEL, abs=2e-5)
    assert flight.metrics["cutoff_inertial_speed_mps"] == pytest.approx(100.0 + gained, abs=4e-4)


def test_a_drifting_gyro_turns_what_is_navigated() -> None:
    """The velocity is the integral of a thrust that turns with a drift of 0.5 deg/s about y."""
    drift = math.radians(0.5)
    gyro = {"station_m": 1.0, "omega_hz": 20.0, "zeta": 0.7, "bias_degph": [0.0, 1800.0, 0.0]}
    flight = in_space(500.0, {"navigation": {"alignment_error_deg": [0.0, 10.0, 0.0]}}, gyro=gyro)

    def speed(t: float) -> float:
        turned = [quad(lambda s, f=f: f(math.radians(10.0) + drift * s), 0.0, t)[0] for f in (math.cos, math.sin)]
        return math.hypot(100.0 + ACCEL * turned[0], ACCEL * turned[1])

    at_s = brentq(lambda t: speed(t) - 500.0, 1.0, 40.0)
    assert flight.event_s("burnout") == pytest.approx(at_s, abs=2e-3)  # half a sample of drift turns it by 4e-5
    assert at_s > 20.0 + 0.1  # without the errors it would be 20 s


def test_navigation_feels_gravitation_where_it_believes_to_be() -> None:
    """Gravitation is that of the navigated position, 900 m too high and 30 m/s too fast, on a vertical ascent."""
    errors = {"position_error_m": [0.0, 0.0, -900.0], "velocity_error_mps": [0.0, 0.0, -30.0]}
    wanted_m = 200e3
    tree = merged(TREE, {"run": {"duration_s": 150.0, "stop_at": ["burnout"]}, "navigation": errors})
    tree["earth"] = {"shape": "sphere", "rotating": False, "gravity": "inverse_square"}
    tree["guidance"] = {"cutoff": {"apogee_altitude_m": wanted_m}}
    flight = fly(load(tree))
    radius = float(np.linalg.norm([flight[f"r_I_{axis}_m"][0] for axis in "xyz"]))

    def rates(t: float, x: np.ndarray) -> list[float]:
        accel = THRUST_N / (MASS_kg - FLOW_kgps * t)
        return [x[1], accel - MU / x[0] ** 2, x[3], accel - MU / x[2] ** 2]

    def reached(_: float, x: np.ndarray) -> float:
        energy = 0.5 * x[3] ** 2 - MU / x[2]
        return -MU / energy - radius - wanted_m

    reached.terminal = True  # type: ignore[attr-defined]  # SciPy's way
    start = [radius, 0.0, radius + 900.0, 30.0]
    found = solve_ivp(rates, (0.0, 149.0), start, "DOP853", events=reached, rtol=1e-11, atol=1e-6)
    assert flight.event_s("burnout") == pytest.approx(float(found.t[-1]), abs=2e-4)
    assert flight.metrics["cutoff_inertial_speed_mps"] == pytest.approx(float(found.y[1, -1]), abs=5e-3)


def test_errors_do_not_grow_in_hold_down() -> None:
    """On a flat Earth with a release at 5 s and the computed thrust 15 deg off, errors begin at the release."""
    tree = merged(
        TREE,
        {
            "vehicle": {"stage": [CONSTANT]},
            "holddown": {"release": "time", "release_s": 5.0},
            "guidance": {"cutoff": {"inertial_speed_mps": 200.0}},
            "navigation": {"alignment_error_deg": [0.0, 15.0, 0.0]},
        },
    )
    g, psi = 9.80665, math.radians(15.0)
    per_s = math.hypot(ACCEL * math.sin(psi), ACCEL * math.cos(psi) - g)
    assert fly(load(tree)).event_s("burnout") == pytest.approx(5.0 + 200.0 / per_s, abs=2e-3)


def test_the_computer_sees_its_alignment_as_attitude_error() -> None:
    computer = {
        "sample_s": 0.01,
        "delay_s": 0.0,
        "count_rad": 0.0,
        "angle_error_limit_deg": 20.0,
        "command_limit_deg": 6.0,
    }
    tree = merged(SPACE, {"vehicle": {"computer": computer}, "run": {"duration_s": 0.1}})
    tree["navigation"] = {"alignment_error_deg": [1.0, 2.0, -3.0]}
    tree["initial"] = {"euler_deg": [0.0, 0.0, 0.0], "ned_mps": [100.0, 0.0, 0.0]}
    flight = fly(load(tree))
    got = [flight[f"error_{axis}_deg"][-1] for axis in ("roll", "pitch", "yaw")]
    np.testing.assert_allclose(got, [1.0, 2.0, -3.0], atol=0.06)  # half the products of the angles
    tree["vehicle"]["computer"]["attitude"] = "rate-integral"
    with pytest.raises(ScenarioError, match=r"navigation.alignment_error_deg.*no attitude"):
        load(tree)
