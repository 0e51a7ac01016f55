"""Separation, dropped mass, laws and computers of stages, and orbits agree with closed forms."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import petrelkit as petrel
import pytest
import tomli_w
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from maxq import Flight, FlightRun, LoadedScenario, ScenarioError
from maxq.sim.run.fly import fly
from maxq.sim.run.metrics import orbit_metrics
from maxq.sim.scenario.loader import load_scenario, load_scenario_text, to_toml
from maxq.sim.vehicle.state import Q_BI, R_I, V_I, W_BI_B
from maxq.sim.world.earth import flat, wgs84

TWO = "checkcases/two-stage"  # burns 40 s, separates at 45 s; 1500 kg before, 900 kg after


def at(loaded: LoadedScenario, time_s: float) -> np.ndarray:
    run = FlightRun(loaded, log=False)
    run.fly_segment(round(time_s * 1e9))
    return np.array(run.packed.state)


def test_springs_and_impulse_share_energy_and_momentum() -> None:
    """Momentum m_1 v_1 = m_2 v_2 and energy m_1 v_1^2 / 2 + m_2 v_2^2 / 2 = E hold, and tip-off rates are added."""
    energy, impulse, tip = 5000.0, 300.0, (0.5, -1.0, 2.0)
    key = "vehicle.stage.0.separation"
    plain = load_scenario(TWO)
    pushed = load_scenario(
        TWO, [f"{key}.spring_J={energy}", f"{key}.impulse_Ns={impulse}", f"{key}.tip_off_degps={list(tip)}"]
    )
    before, after = (at(x, 45.001) for x in (plain, pushed))
    assert (at(plain, 45.0) == at(pushed, 45.0)).all()
    w, x, y, z = before[Q_BI : Q_BI + 4]
    forward = np.array([1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)])
    gained = (after - before)[V_I : V_I + 3]
    upper, lower = 900.0, 600.0
    by_springs = float(gained @ forward) - impulse / upper
    recoil = by_springs * upper / lower
    assert 0.5 * (upper * by_springs**2 + lower * recoil**2) == pytest.approx(energy, rel=1e-4)
    assert np.linalg.norm(gained) == pytest.approx(float(gained @ forward), rel=1e-4)
    assert np.degrees((after - before)[W_BI_B : W_BI_B + 3]) == pytest.approx(tip, abs=2e-3)


def test_what_stays_is_where_it_was_and_moves_as_it_did() -> None:
    """Over the millisecond of the separation, the upper stage's nose does not jump, although the CG moves by 1.9 m."""
    run = FlightRun(load_scenario(TWO), log=False)
    run.fly_segment(45_000_000_000)
    run.packed.state[W_BI_B : W_BI_B + 3] = 0.1, -0.5, 0.4
    before = run.packed.state.copy()
    run.fly_segment(1_000_000)
    after = run.packed.state
    first, second = ((5.3, 0.008, -0.005), (3.4, 0.003, 0.001))  # CG: station, y, z

    def nose(y: np.ndarray, cg: tuple[float, float, float]) -> tuple[np.ndarray, np.ndarray]:
        turn = Rotation.from_quat([*y[Q_BI + 1 : Q_BI + 4], y[Q_BI]])
        arm = np.array([cg[0], -cg[1], -cg[2]])
        return y[R_I : R_I + 3] + turn.apply(arm), y[V_I : V_I + 3] + turn.apply(np.cross(y[W_BI_B : W_BI_B + 3], arm))

    (place, velocity), (later, moved) = nose(before, first), nose(after, second)
    np.testing.assert_allclose(later - place, 1e-3 * 0.5 * (velocity + moved), atol=1e-5)
    np.testing.assert_allclose(moved, velocity, atol=0.02)


def test_thrust_ends_at_burn_out_and_begins_again_at_ignition() -> None:
    """Burnout is at 40 s, separation at 45 s, and ignition exactly 3 s later."""
    flight = fly(load_scenario(TWO, ["run.duration_s=49.0"]))
    t, thrust_N = flight.time_s("thrust_N"), flight["thrust_N"]
    off = (t > 40.0) & (t < 48.0)
    assert off.sum() == 79
    assert not thrust_N[off].any()
    assert (thrust_N[t < 39.9] > 5e4).all()
    assert (thrust_N[t > 48.0] > 1e4).all()


def test_burn_out_and_separation_at_one_instant_are_both_events() -> None:
    flight = fly(
        load_scenario(TWO, ["vehicle.stage.0.separation_after_burnout_s=0.0", "run.duration_s=41.0"]), log=False
    )
    assert [(e.name, e.time_s, e.stage) for e in flight.events if e.name in ("burnout", "separation")] == [
        ("burnout", 40.0, 1),
        ("separation", 40.0, 1),
    ]
    stopped = fly(load_scenario(TWO, ["vehicle.stage.0.separation_after_burnout_s=0.0", "run.stop_at=['burnout']"]))
    t = stopped.time_s("altitude_m")
    np.testing.assert_allclose(t, 0.1 * np.arange(631), atol=1e-9)  # the row of 63 s, which is the end, is there once
    assert (stopped.outcome, stopped.end_s) == ("burnout", 63.0)  # the last stage's: the first one's ends nothing
    assert [(e.time_s, e.stage) for e in stopped.events if e.name == "burnout"] == [(40.0, 1), (63.0, 2)]


def split(pieces: tuple[float, ...], continues: bool = True) -> Flight:
    """Return a vehicle with a tank, an actuator and a mode, flown as one stage or cut into several at these times."""
    ends = (*pieces, 20.0)

    def stage(begin: float, end: float, last: bool) -> dict[str, Any]:
        times = [0.0, end - begin]
        modes = [
            {
                "time_s": t,
                "mode": 1,
                "frequency_hz": 8.0,
                "generalized_mass_kg": 250.0,
                "station_m": x,
                "phi": (x / 5.0 - 1.0) ** 2 - 0.4,
                "slope_pm": 0.4 * (x / 5.0 - 1.0),
                "mass_forward_kg": 100.0 * x,
            }
            for t in times
            for x in (0.0, 5.0, 10.0)
        ]
        constant = {"mass_kg": 1000.0, "x_cg_m": 6.0, "Ixx_kgm2": 90.0, "Iyy_kgm2": 8000.0, "Izz_kgm2": 8000.0}
        rows = {"time_s": times} | {key: [value, value] for key, value in constant.items()}
        out: dict[str, Any] = {
            "interpolation": "linear",
            "mass": {"table": rows},
            "engine": {
                "table": {"time_s": times, "thrust_vacuum_N": [2e4, 2e4]},
                "exit_area_m2": 0.0,
                "gimbal_station_m": 9.5,
                "exit_station_m": 10.0,
                "gimballed_mass_kg": 20.0,
                "cg_from_gimbal_m": 0.2,
                "inertia_about_gimbal_kgm2": 2.0,
            },
            "actuator": {
                "model": "second-order",
                "omega_hz": [5.0],
                "zeta": [0.7],
                "angle_limit_deg": 6.0,
                "rate_limit_degps": 60.0,
            },
            "tank": [
                {
                    "table": {
                        "time_s": times,
                        "slosh_mass_kg": [100.0, 100.0],
                        "pendulum_length_m": [0.5, 0.5],
                        "hinge_station_m": [4.0, 4.0],
                    },
                    "damping_ratio": 0.01,
                }
            ],
            "bending": {"pitch": modes, "yaw": modes, "damping_ratio": [0.01]},
        }
        if not last:
            out["separation_s"] = end - begin
        if begin > 0.0:
            out["continues"] = continues
        return out

    begins = (0.0, *pieces)
    stages = [stage(a, b, b == 20.0) for a, b in zip(begins, ends, strict=True)]
    document = {
        "schema": 1,
        "vehicle": {"name": "cut", "reference": {"length_m": 10.0, "diameter_m": 1.0, "area_m2": 0.8}, "stage": stages},
        "run": {"duration_s": 19.0, "stop_at": []},
        "initial": {"ned_mps": [0.0, 0.0, -100.0]},
        "switches": {"moving_cg": False, "jet_damping": False},
        "injection": [
            {"at": "gimbal_command", "axis": "pitch", "kind": "sine", "amplitude_deg": 0.5, "frequency_hz": 0.7}
        ],
        "log": {"fast_hz": 10.0, "slow_hz": 10.0, "transform_hz": 1.0},
    }
    return fly(load_scenario_text(tomli_w.dumps(document)))


def test_a_vehicle_cut_into_stages_that_continue_flies_as_if_it_were_not() -> None:
    """Engine, bob and mode keep their states, and nothing drops, so the flight is unchanged.

    A start at rest gives a different flight.
    """
    whole, cut, at_rest = split(()), split((7.0, 12.3)), split((7.0, 12.3), continues=False)
    assert cut.state[:13] == pytest.approx(whole.state[:13], rel=1e-9, abs=1e-9)
    for channel in ("gimbal_pitch_angle_deg", "pitch_deg"):
        assert cut[channel] == pytest.approx(whole[channel], abs=1e-8)
    assert np.abs(at_rest["gimbal_pitch_angle_deg"] - whole["gimbal_pitch_angle_deg"]).max() > 0.05
    assert [e.name for e in cut.events] == ["ignition", "separation", "separation"]


LAW = "design.stage=[{},{filter={structure='none'},gains={table=[{time_s=0.0,k_p=0.25,k_d_s=0.125}]}}]"


@pytest.fixture(scope="module")
def upper() -> float:
    """Return a time at which petrel's second stage burns."""
    return next(
        e.time_s
        for e in fly(petrel.scenario("run.duration_s=140.0"), log=False).events
        if e.title == "ignition (stage 2)"
    )


@pytest.mark.slow
def test_a_stage_flies_its_own_law_and_its_own_computer(upper: float) -> None:
    """Gains, filter, sample period and limit of the second stage are as logged; no angle is lost at the change."""
    until = [f"run.duration_s={math.ceil(upper) + 8.0}", "log.fast_hz=100.0", "log.slow_hz=10.0"]
    own = fly(petrel.scenario(*until, LAW, "vehicle.stage.1.computer={sample_s=0.02,command_limit_deg=0.05}"))
    plain = fly(petrel.scenario(*until))
    time_s = own.time_s("k_p_pitch")
    later = time_s > upper + 0.1
    assert own["k_p_pitch"][later] == pytest.approx(0.25)
    assert own["filtered_pitch_deg"][later] == pytest.approx(own["law_pitch_deg"][later], abs=1e-12)
    assert (own["k_p_pitch"][~later] == plain["k_p_pitch"][~later])[time_s[~later] < upper - 4.0].all()
    assert np.abs(own["gimbal_pitch_command_deg"][later]).max() <= 0.05 + 1e-9
    held = np.abs(np.diff(own["measured_pitch_rate_degps"][later])) < 1e-12  # a sample of 20 ms is two rows
    assert held.mean() >= 0.5
    turned = [f.final["pitch_deg"] for f in (own, plain)]
    counted = [f.final["pitch_measured_deg"] for f in (own, plain)]
    assert abs(turned[0] - turned[1]) > 0.01
    assert counted[0] - counted[1] == pytest.approx(turned[0] - turned[1], abs=0.02)


@pytest.mark.parametrize(
    ("override", "said"),
    [
        ("design.stage=[{},{},{},{}]", "design.stage = [{}, {}, {}, {}]: has 4 stages; allowed: 3"),
        ("vehicle.stage.1.computer={delay_s=0.5}", "vehicle.stage.1.computer.delay_s = 0.5: is longer than the sample"),
        ("vehicle.stage.1.continues=true", "vehicle.stage.1.continues = true: there is no stage before"),
        (
            "vehicle.stage.2.separation={spring_J=1.0}",
            "vehicle.stage.2.separation = {spring_J = 1.0}: the last stage does not separate",
        ),
        ("vehicle.stage.0.separation={spring_J=-1.0}", "vehicle.stage.0.separation.spring_J = -1.0"),
    ],
)
def test_what_does_not_fit_the_stages_is_said(override: str, said: str) -> None:
    with pytest.raises(ScenarioError) as e:
        petrel.scenario(override)
    assert said in str(e.value)


def test_a_design_of_another_vehicle_has_to_be_asked_for() -> None:
    mine = petrel.folder() / "design.toml"
    with pytest.raises(ScenarioError, match='the design was made for "petrel", and the scenario flies "KSR-III'):
        load_scenario("nominal", [f'design="{mine}"'])
    asked = load_scenario("nominal", [f'design="{mine}"', f'vehicle="{petrel.folder() / "vehicle"}"'])
    assert asked.vehicle.name == "petrel"
    assert load_scenario_text(to_toml(asked.scenario)).design == asked.design  # a log is flown again without a question


def test_without_a_design_no_attitude_is_judged() -> None:
    loaded = load_scenario("nominal", ["design=", "run.duration_s=20.0"])
    assert any(r.metric == "max_attitude_error_deg" for r in loaded.scenario.requirement)
    flight = fly(loaded, log=False)
    assert math.isnan(flight.metrics["max_attitude_error_deg"])
    assert all(v.requirement.metric != "max_attitude_error_deg" for v in flight.verdicts)
    assert all(e.name != "control_lost" for e in flight.events)


MU, RADIUS = 3.986004418e14, 6378137.0


@pytest.mark.parametrize(
    ("a", "e", "i", "node", "perigee", "anomaly"),
    [
        (7.0e6, 0.02, 51.6, 30.0, 70.0, 200.0),
        (2.6e7, 0.74, 63.4, 300.0, 270.0, 10.0),
        (6.5e6, 0.5, 97.0, 120.0, 5.0, 181.0),
    ],
)
def test_orbital_elements_are_those_that_an_orbit_was_made_of(
    a: float, e: float, i: float, node: float, perigee: float, anomaly: float
) -> None:
    """Position and velocity come from rotations of the orbit plane; perigee and apogee also from integration."""

    def turn(axis: int, degrees: float) -> np.ndarray:
        c, s = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
        return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]] if axis == 2 else [[1, 0, 0], [0, c, -s], [0, s, c]])

    f, p = math.radians(anomaly), a * (1.0 - e * e)
    plane = turn(2, node) @ turn(0, i) @ turn(2, perigee)
    r = plane @ (p / (1.0 + e * math.cos(f)) * np.array([math.cos(f), math.sin(f), 0.0]))
    v = plane @ (math.sqrt(MU / p) * np.array([-math.sin(f), e + math.cos(f), 0.0]))
    found = orbit_metrics(wgs84(), tuple(r), tuple(v))
    given = (a * (1 - e) - RADIUS, a * (1 + e) - RADIUS, a, e, i, node, perigee, anomaly)
    assert tuple(found) == pytest.approx(given, rel=1e-7)
    path = solve_ivp(
        lambda t, y: np.concatenate([y[3:], -MU * y[:3] / np.linalg.norm(y[:3]) ** 3]),
        (0.0, 2.0 * math.pi * math.sqrt(a**3 / MU)),
        np.concatenate([r, v]),
        rtol=1e-9,
        atol=1e-3,
        max_step=4.0,
    )
    distance = np.linalg.norm(path.y[:3], axis=0)
    assert distance.min() - RADIUS == pytest.approx(found.perigee_altitude_m, abs=100.0)
    assert distance.max() - RADIUS == pytest.approx(found.apogee_altitude_m, abs=100.0)


def test_orbits_that_escape_or_have_no_centre() -> None:
    r, v = np.array([7.0e6, 0.0, 0.0]), np.array([0.0, 12000.0, 0.0])
    found = orbit_metrics(wgs84(), tuple(r), tuple(v))
    assert found.apogee_altitude_m == math.inf
    assert found.orbit_semimajor_m < 0.0
    assert found.perigee_altitude_m == pytest.approx(7.0e6 - RADIUS)
    assert math.isnan(orbit_metrics(flat(), tuple(r), tuple(v)).perigee_altitude_m)
