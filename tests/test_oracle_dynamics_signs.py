"""Each coupling path alone has the right direction in pitch and yaw, and the right size.

The signs are those of docs/model.md: x forward, y right, z down; positive gimbal angles give positive moments. A mode
moves to +z (pitch) and +y (yaw). Its slope turns the body by +sigma eta about y and by -sigma xi about z.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from flightkit import Mode, Parts, Rig, Tank, Tree, engine_states, flown, merged, rig, scenario_of, with_stage
from oracles.multibody_system import rotation_from_quaternion

from maxq.control.kernel.records import Array
from maxq.sim.vehicle import state as layout

W, V = layout.W_BI_B, layout.V_I
PITCH, YAW = 0, 1
PLANES = pytest.mark.parametrize("plane", [PITCH, YAW], ids=["pitch", "yaw"])
ALONG = (2, 1)  # lateral axis of the plane: z, y
ABOUT = (1, 2)  # turning axis of the plane: y, z
SIGN = (1.0, -1.0)  # direction along that axis which goes with a positive turn of the thrust axis
STIFFNESS = (2.0 * math.pi * 7.0) ** 2
SLOPED = Mode(7.0, 500.0, (0.0,) * 6, (0.2,) * 6)  # turns without moving: slope alone
MOVED = Mode(7.0, 500.0, (0.6,) * 6, (0.0,) * 6)  # moves without turning


def answer(made: Rig, y: Array | None = None) -> tuple[Array, Array]:
    """Return the specific force at the core CG and the angular acceleration, both in B."""
    made.derivative(made.y if y is None else y)
    return made.aux.specific_force_B_mps2.copy(), made.aux.alpha_BI_B_radps2.copy()


def ideal(parts: Parts, **sections: object) -> Tree:
    return merged(scenario_of(parts, switches={"actuator": "ideal"}), dict(sections))


def mode_index(made: Rig, plane: int) -> int:
    return int(layout.eta_index(made.sizes) if plane == PITCH else layout.xi_index(made.sizes))


def planes(mode: Mode) -> dict[str, tuple[Mode, ...]]:
    return {"pitch": (mode,), "yaw": (mode,)}


# --- thrust
@PLANES
def test_deflected_thrust_pushes_and_turns(plane: int) -> None:
    parts = Parts(thrust_N=1.0e5)
    made = rig(ideal(parts))
    angle = 0.05
    made.held["command_rad"][plane] = angle
    felt, alpha = answer(made)
    assert np.isclose(felt[ALONG[plane]], SIGN[plane] * 1.0e5 * math.sin(angle) / 4000.0, rtol=1e-12)
    assert np.isclose(alpha[ABOUT[plane]], 1.0e5 * math.sin(angle) * 5.0 / 5.0e4, rtol=1e-12)
    assert np.isclose(felt[0], 25.0 * math.cos(angle), rtol=1e-12)
    assert abs(felt[ALONG[1 - plane]]) + abs(alpha[ABOUT[1 - plane]]) + abs(alpha[0]) < 1e-12


@PLANES
def test_misaligned_thrust_acts_as_a_deflection(plane: int) -> None:
    turned = [0.0, 0.0]
    turned[plane] = 2.0
    made = rig(with_stage(ideal(Parts(thrust_N=1.0e5)), engine={"misalignment_deg": turned}))
    _, alpha = answer(made)
    assert np.isclose(alpha[ABOUT[plane]], 1.0e5 * math.sin(math.radians(2.0)) * 5.0 / 5.0e4, rtol=1e-12)


def test_offset_thrust_turns_about_the_other_axis() -> None:
    """A gimbal to the right (y > 0) turns the nose left; one below (z > 0) turns the nose up."""
    right = rig(ideal(Parts(thrust_N=1.0e5, gimbal_offset_m=(0.02, 0.0))))
    assert np.allclose(answer(right)[1], [0.0, 0.0, -2000.0 / 5.0e4], rtol=0.0, atol=1e-12)
    below = rig(ideal(Parts(thrust_N=1.0e5, gimbal_offset_m=(0.0, 0.02))))
    assert np.allclose(answer(below)[1], [0.0, 2000.0 / 5.0e4, 0.0], rtol=0.0, atol=1e-12)


def test_ambient_pressure_takes_thrust() -> None:
    tree = ideal(Parts(thrust_N=1.0e5), atmosphere={"model": "constant", "density_kgpm3": 0.0})
    made = rig(with_stage(tree, engine={"exit_area_m2": 0.25}))
    assert np.isclose(answer(made)[0][0], (1.0e5 - 0.25 * 101325.0) / 4000.0, rtol=1e-12)
    weak = rig(with_stage(merged(tree, {}), engine={"exit_area_m2": 2.0}))
    assert answer(weak)[0][0] == 0.0


@PLANES
def test_follower_thrust_turns_with_the_gimbal(plane: int) -> None:
    """A positive slope times displacement turns the nozzle: force to -z (pitch) or -y (yaw), nose down or right."""
    parts = Parts(thrust_N=1.0e5, **planes(SLOPED))
    for follower in (True, False):
        made = rig(ideal(parts, switches={"follower_thrust": follower}))
        y = made.y.copy()
        y[mode_index(made, plane)] = 0.01
        felt, alpha = answer(made, y)
        turn = 0.2 * 0.01 if follower else 0.0
        assert np.isclose(felt[ALONG[plane]], -25.0 * turn, rtol=0.0, atol=1e-12)
        assert np.isclose(alpha[ABOUT[plane]], -SIGN[plane] * 1.0e5 * turn * 5.0 / 5.0e4, rtol=0.0, atol=1e-12)


@PLANES
def test_displaced_gimbal_gives_thrust_an_arm(plane: int) -> None:
    parts = Parts(thrust_N=1.0e5, **planes(MOVED))
    made = rig(ideal(parts))
    y = made.y.copy()
    y[mode_index(made, plane)] = 0.01
    _, alpha = answer(made, y)
    assert np.isclose(alpha[ABOUT[plane]], SIGN[plane] * 1.0e5 * 0.6 * 0.01 / 5.0e4, rtol=1e-12)


@PLANES
def test_deflected_thrust_bends_the_body(plane: int) -> None:
    parts = Parts(thrust_N=1.0e5, **planes(MOVED))
    made = rig(ideal(parts))
    made.held["command_rad"][plane] = 0.05
    dy = made.derivative(made.y)
    wanted = SIGN[plane] * 0.6 * 1.0e5 * math.sin(0.05) / 500.0
    assert np.isclose(dy[mode_index(made, plane) + 1], wanted, rtol=1e-12)


# --- engine inertia
@PLANES
def test_swinging_engine_pushes_the_vehicle_back(plane: int) -> None:
    """Without thrust, the engine's CG accelerates to -z (pitch) or +y (yaw) and the vehicle in the opposite direction.

    The vehicle turns with the engine's angle.
    """
    parts = Parts(engine_mass_kg=200.0, engine_cg_m=0.5, engine_inertia_kgm2=30.0)
    made = rig(scenario_of(parts))
    y = made.y.copy()
    pick = np.eye(2)[plane]
    y[layout.ACTUATOR : layout.ACTUATOR + 12] = engine_states(made, 0.0 * pick, 0.0 * pick, 40.0 * pick)
    felt, alpha = answer(made, y)
    assert np.isclose(felt[ALONG[plane]], SIGN[plane] * 200.0 * 0.5 * 40.0 / 4000.0, rtol=1e-9)
    wanted = (30.0 + 200.0 * 0.5 * (5.0 + 0.5)) * 40.0 / 5.0e4
    assert np.isclose(alpha[ABOUT[plane]], wanted, rtol=1e-9)
    without = rig(scenario_of(parts, switches={"engine_inertia": False}))
    assert np.all(np.abs(np.concatenate(answer(without, y))) < 1e-15)


# --- axial load
@PLANES
def test_compression_softens_and_tension_stiffens(plane: int) -> None:
    parts = Parts(thrust_N=1.0e5, **planes(SLOPED))
    switches = {"actuator": "ideal", "follower_thrust": False}
    start = {"ned_mps": [300.0, 0.0, 0.0]}
    air = {"model": "constant", "density_kgpm3": 1.0, "pressure_Pa": 0.0}
    drag = {"table": [{"mach": 0.0, "CA": 1.0}]}

    def stiffness(tree: Tree) -> float:
        made = rig(tree)
        i = mode_index(made, plane)
        y = made.y.copy()
        y[i] = 0.01
        return -float(made.derivative(y)[i + 1]) / 0.01

    alone = stiffness(scenario_of(replace(parts, thrust_N=0.0), switches=switches))
    pushed = stiffness(scenario_of(parts, switches=switches))
    off = stiffness(scenario_of(parts, switches=switches | {"bending_softening": False}))
    braked = stiffness(
        with_stage(
            scenario_of(replace(parts, thrust_N=0.0), switches=switches, initial=start, atmosphere=air), aero=drag
        )
    )
    assert np.isclose(alone, STIFFNESS, rtol=1e-12)
    assert np.isclose(off, STIFFNESS, rtol=1e-12)
    assert pushed < alone * (1.0 - 1e-4)
    assert braked > alone * (1.0 + 1e-4)


# --- slosh
AT_FIVE = Tank(300.0, 0.5, 5.0)  # two metres ahead of the core CG


def hanging(plane: int, angle_rad: float, **sections: object) -> tuple[Rig, Array, int]:
    parts = Parts(thrust_N=1.0e5, tanks=(AT_FIVE,))
    made = rig(ideal(parts, **sections))
    y = made.y.copy()
    i = int(layout.pendulum_index(made.sizes, 0))
    y[i] = -math.cos(angle_rad)
    y[i + ALONG[plane]] = math.sin(angle_rad)
    return made, y, i


@PLANES
def test_slosh_pulls_the_body_towards_the_bob(plane: int) -> None:
    made, y, _ = hanging(plane, 0.1)
    felt, alpha = answer(made, y)
    tension = made.aux.tension_N[0]
    assert tension > 0.0
    assert np.isclose(felt[ALONG[plane]], tension * math.sin(0.1) / 4000.0, rtol=1e-9)
    # a pull to +z ahead of the CG lowers the nose, a pull to +y turns it right
    assert np.isclose(alpha[ABOUT[plane]], -SIGN[plane] * 2.0 * tension * math.sin(0.1) / 5.0e4, rtol=1e-9)


@PLANES
def test_slosh_falls_back_towards_the_axis_under_thrust(plane: int) -> None:
    made, y, i = hanging(plane, 0.1)
    assert made.derivative(y)[i + 3 + ALONG[plane]] < -1.0


@PLANES
def test_slosh_lags_behind_an_accelerated_body(plane: int) -> None:
    axis = "z" if plane == PITCH else "y"
    push = [{"at": "body_force", "axis": axis, "kind": "step", "amplitude_N": 2.0e4}]
    made, y, i = hanging(plane, 0.0, injection=push)
    dy = made.derivative(y)
    assert answer(made, y)[0][ALONG[plane]] > 1.0
    assert dy[i + 3 + ALONG[plane]] < -1.0
    turn = [{"at": "body_torque", "axis": "xyz"[ABOUT[plane]], "kind": "step", "amplitude_Nm": 2.0e4}]
    made, y, i = hanging(plane, 0.0, injection=turn)
    assert answer(made, y)[1][ABOUT[plane]] > 0.1
    # nose up lifts a hinge ahead of the CG (to -z), nose right moves it right (to +y): the bob stays behind
    assert SIGN[plane] * made.derivative(y)[i + 3 + ALONG[plane]] > 0.1


@PLANES
def test_slosh_and_bending_meet_at_the_hinge(plane: int) -> None:
    """An accelerating hinge leaves the bob behind; a deflected bob pulls on the mode."""
    parts = Parts(thrust_N=1.0e5, tanks=(AT_FIVE,), **planes(MOVED))
    made = rig(ideal(parts, switches={"follower_thrust": False}))
    i, m = int(layout.pendulum_index(made.sizes, 0)), mode_index(made, plane)
    y = made.y.copy()
    y[m] = -0.01  # springs back to +z, +y
    dy = made.derivative(y)
    assert dy[m + 1] > 10.0
    assert dy[i + 3 + ALONG[plane]] < -5.0
    y = made.y.copy()
    y[i], y[i + ALONG[plane]] = -math.cos(0.1), math.sin(0.1)
    dy = made.derivative(y)
    wanted = 0.6 * made.aux.tension_N[0] * math.sin(0.1) / 500.0
    assert np.isclose(dy[m + 1], wanted, rtol=1e-9)


# --- what the gyro sees
@PLANES
def test_gyro_reads_the_turning_of_the_bent_body(plane: int) -> None:
    """The gyro measures q + sum(sigma d(eta)/dt) in pitch and r - sum(sigma d(xi)/dt) in yaw."""
    made = rig(ideal(Parts(**planes(SLOPED))))
    y = made.y.copy()
    y[mode_index(made, plane) + 1] = 0.3
    dy = made.derivative(y)
    i = layout.GYRO + 2 * ABOUT[plane]
    assert np.isclose(dy[i + 1], (2.0 * math.pi * 60.0) ** 2 * SIGN[plane] * 0.2 * 0.3, rtol=1e-12)
    others = [layout.GYRO + 2 * k + 1 for k in range(3) if k != ABOUT[plane]]
    assert np.all(dy[others] == 0.0)


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_gyro_reads_the_body_rate_on_its_own_axis(axis: int) -> None:
    rate = np.zeros(3)
    rate[axis] = 0.1
    made = rig(ideal(Parts(), initial={"rate_BI_radps": rate}))
    made.y[layout.GYRO : layout.GYRO + 9] = 0.0
    dy = made.derivative(made.y)
    wanted = np.zeros(3)
    wanted[axis] = (2.0 * math.pi * 60.0) ** 2 * 0.1
    assert np.allclose(dy[layout.GYRO + 1 : layout.GYRO + 6 : 2], wanted, rtol=1e-12)
    biased = {"bias_degph": [0.0] * 3, "scale_factor": [0.0] * 3, "misalignment_deg": [0.0] * 3}
    biased["bias_degph"][axis], biased["scale_factor"][axis] = 3600.0, 0.01
    made = rig(with_stage(ideal(Parts(), initial={"rate_BI_radps": rate}), gyro=biased))
    y = made.y.copy()
    flown(made, 0.5)
    assert np.isclose(made.y[layout.GYRO + 2 * axis], 1.01 * 0.1 + math.radians(1.0), rtol=1e-9)
    assert y[W + axis] == 0.1


def test_gyro_turned_about_x_mixes_pitch_and_yaw() -> None:
    """Sensor axes turned by +a about x have their y axis towards z and their z axis towards -y."""
    tree = with_stage(
        ideal(Parts(), initial={"rate_BI_radps": [0.0, 0.1, 0.0]}), gyro={"misalignment_deg": [1.0, 0, 0]}
    )
    made = rig(tree)
    flown(made, 0.5)
    gyro = made.y[layout.GYRO : layout.GYRO + 6 : 2]
    assert np.allclose(gyro, [0.0, 0.1, -0.1 * math.radians(1.0)], rtol=0.0, atol=1e-9)


# --- air
AIR = {"model": "constant", "density_kgpm3": 1.2}
SPEED = 100.0


def wing(station_m: float, **coefficients: float) -> Tree:
    return {
        "table": [{"mach": 0.0, **coefficients}],
        "surface": [{"table": [{"mach": 0.0, "CN_alpha_pr": 3.0, "station_m": station_m}]}],
    }


def through_air(aero: Tree, velocity_B: list[float], parts: Parts | None = None, **sections: object) -> Rig:
    tree = ideal(parts or Parts(), atmosphere=AIR, initial={"ned_mps": velocity_B}, **sections)
    return rig(with_stage(tree, aero=aero))


@PLANES
@pytest.mark.parametrize("station_m", [3.0, 11.0])
def test_normal_force_opposes_cross_flow_and_turns(plane: int, station_m: float) -> None:
    """A surface ahead of the CG turns the nose away from the wind (unstable), and one behind it into the wind."""
    velocity = [SPEED, 0.0, 0.0]
    velocity[ALONG[plane]] = 2.0
    made = through_air(wing(station_m), velocity)
    felt, alpha = answer(made)
    force = 0.5 * 1.2 * 0.8 * 3.0 * SPEED * 2.0
    assert np.isclose(felt[ALONG[plane]], -force / 4000.0, rtol=1e-12)
    arm = 7.0 - station_m
    assert np.isclose(alpha[ABOUT[plane]], SIGN[plane] * arm * force / 5.0e4, rtol=1e-12)


@PLANES
def test_local_incidence_by_slope_and_by_motion(plane: int) -> None:
    """A surface turned into the flow has the force of a body at that angle of attack; a moving one is damped."""
    for mode, index, cross_flow in ((SLOPED, 0, SPEED * 0.2 * 0.01), (MOVED, 1, 0.6 * 0.5)):
        made = through_air(wing(3.0), [SPEED, 0.0, 0.0], Parts(**planes(mode)))
        y = made.y.copy()
        m = mode_index(made, plane)
        y[m + index] = (0.01, 0.5)[index]
        force = 0.5 * 1.2 * 0.8 * 3.0 * SPEED * cross_flow
        dy = made.derivative(y)
        assert np.isclose(made.aux.aero_force_B_N[ALONG[plane]], -force, rtol=1e-9)
        bent = -STIFFNESS * y[m] - mode.phi[1] * force / 500.0
        assert np.isclose(dy[m + 1], bent, rtol=1e-9)
        assert np.isclose(dy[W + ABOUT[plane]], SIGN[plane] * 4.0 * force / 5.0e4, rtol=1e-9)
        off = through_air(wing(3.0), [SPEED, 0.0, 0.0], Parts(**planes(mode)), switches={"local_incidence": False})
        off.derivative(y)
        assert off.aux.aero_force_B_N[ALONG[plane]] == 0.0


@PLANES
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_cross_flow_drag_opposes_sideways_motion(plane: int, sign: float) -> None:
    velocity = [0.0, 0.0, 0.0]
    velocity[ALONG[plane]] = sign * 20.0
    aero = {"table": [{"mach": 0.0, "C_crossflow": 5.0}], "crossflow_station_m": 9.0}
    made = through_air(aero, velocity)
    felt, alpha = answer(made)
    force = 0.5 * 1.2 * 0.8 * 5.0 * 20.0**2
    assert np.isclose(felt[ALONG[plane]], -sign * force / 4000.0, rtol=1e-12)
    assert np.isclose(alpha[ABOUT[plane]], -SIGN[plane] * sign * 2.0 * force / 5.0e4, rtol=1e-12)
    assert abs(felt[0]) < 1e-15


@pytest.mark.parametrize(("coefficient", "axis"), [("Clp", 0), ("Cmq", 1), ("Cnr", 2)])
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_rate_damping_damps(coefficient: str, axis: int, sign: float) -> None:
    rate = np.zeros(3)
    rate[axis] = sign * 0.2
    aero = {"table": [{"mach": 0.0, coefficient: -40.0}]}
    tree = ideal(Parts(), atmosphere=AIR, initial={"ned_mps": [SPEED, 0.0, 0.0], "rate_BI_radps": rate})
    tree = with_stage(tree, aero=aero)
    tree = merged(tree, {"vehicle": {"reference": {"chord_m": 1.5, "span_m": 2.0, "yaw_chord_m": 1.7}}})
    _, alpha = answer(rig(tree))
    length = (2.0, 1.5, 1.7)[axis]
    moment = 0.5 * 1.2 * SPEED**2 * 0.8 * length * -40.0 * rate[axis] * length / (2.0 * SPEED)
    wanted = np.zeros(3)
    wanted[axis] = moment / (700.0, 5.0e4, 5.0e4)[axis]
    assert np.allclose(alpha, wanted, rtol=1e-12, atol=0.0)


@pytest.mark.parametrize("coefficient", ["CA", "CD"])
def test_axial_force_and_drag_oppose_motion(coefficient: str) -> None:
    for speed in (SPEED, -SPEED):
        made = through_air({"table": [{"mach": 0.0, coefficient: 0.5}]}, [speed, 0.0, 0.0])
        wanted = -math.copysign(0.5 * 1.2 * SPEED**2 * 0.8 * 0.5 / 4000.0, speed)
        assert np.allclose(answer(made)[0], [wanted, 0.0, 0.0], rtol=1e-12)


def test_drag_acts_along_the_wind_and_axial_force_along_the_body() -> None:
    velocity = np.array([60.0, 30.0, -20.0])
    drag = answer(through_air({"table": [{"mach": 0.0, "CD": 0.5}]}, list(velocity)))[0]
    assert np.allclose(drag, -0.5 * 1.2 * np.linalg.norm(velocity) * velocity * 0.8 * 0.5 / 4000.0, rtol=1e-12)
    axial = answer(through_air({"table": [{"mach": 0.0, "CA": 0.5}]}, list(velocity)))[0]
    assert np.allclose(axial, [-0.5 * 1.2 * 60.0**2 * 0.8 * 0.5 / 4000.0, 0.0, 0.0], rtol=1e-12)


def test_drag_beside_a_cg_off_the_axis() -> None:
    """The aerodynamic axis is the body axis: with the CG at +z, drag acts above it and lifts the nose."""
    down = Parts(core_cg=(7.0, 0.0, 0.1), core_inertia=tuple(map(tuple, np.diag([2000.0, 5.0e4, 5.0e4]))))
    made = through_air({"table": [{"mach": 0.0, "CA": 0.5}]}, [SPEED, 0.0, 0.0], down)
    force = 0.5 * 1.2 * SPEED**2 * 0.8 * 0.5
    assert np.allclose(answer(made)[1], [0.0, 0.1 * force / 5.0e4, 0.0], rtol=1e-12)
    right = replace(down, core_cg=(7.0, 0.1, 0.0))
    made = through_air({"table": [{"mach": 0.0, "CA": 0.5}]}, [SPEED, 0.0, 0.0], right)
    assert np.allclose(answer(made)[1], [0.0, 0.0, -0.1 * force / 5.0e4], rtol=1e-12)


@pytest.mark.parametrize(
    ("from_deg", "wanted"), [(270.0, [0.0, 1.0]), (180.0, [1.0, 0.0]), (90.0, [0.0, -1.0]), (0.0, [-1.0, 0.0])]
)
def test_wind_blows_from_where_it_is_said_to(from_deg: float, wanted: list[float]) -> None:
    """At rest, with the nose at the zenith and body z north, drag acts along the wind."""
    aero = {"table": [{"mach": 0.0, "CD": 1.0}]}
    tree = ideal(
        Parts(),
        atmosphere=AIR,
        initial={"dcm_BI": [[0.0, 0.0, -1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]]},
        wind={"speed_mps": 10.0, "from_deg": from_deg},
    )
    del tree["initial"]["euler_deg"]
    made = rig(with_stage(tree, aero=aero))
    accel = made.derivative(made.y)[V : V + 3]
    assert np.allclose(accel[:2] / np.linalg.norm(accel), wanted, rtol=0.0, atol=1e-12)
    assert np.isclose(np.linalg.norm(accel), 0.5 * 1.2 * 10.0**2 * 0.8 / 4000.0, rtol=1e-12)


# --- gravity gradient and roll
def tidal(inertia: Array, attitude: list[float]) -> tuple[Array, Array]:
    """Return the angular acceleration at rest over a round Earth, and the moment 3 mu / r^3 (n x J n) in B."""
    radius, mu = 7.0e6, 3.986004418e14
    tree = scenario_of(
        Parts(engine=False, core_inertia=tuple(map(tuple, inertia))),
        earth={"shape": "sphere", "gravity": "inverse_square", "mu_m3ps2": mu, "gravity_gradient": True},
        initial={"inertial_m": [radius, 0.0, 0.0], "q_BI": attitude, "rate_BI_radps": [0.0, 0.0, 0.0]},
    )
    del tree["initial"]["euler_deg"]
    made = rig(tree)
    alpha = made.derivative(made.y)[W : W + 3]
    n = rotation_from_quaternion(np.array(attitude)).T @ np.array([1.0, 0.0, 0.0])
    return alpha, 3.0 * mu / radius**3 * np.cross(n, inertia @ n)


def unit(*q: float) -> list[float]:
    return list(np.array(q) / np.linalg.norm(q))


def test_gravity_gradient_turns_the_long_axis_to_the_vertical() -> None:
    """With the nose 45 degrees above the horizon, a slender vehicle turns upright."""
    attitude = unit(math.cos(math.pi / 8), 0.0, 0.0, math.sin(math.pi / 8))  # x axis turned from the zenith about z
    inertia = np.diag([2000.0, 5.0e4, 5.0e4])
    alpha, moment = tidal(inertia, attitude)
    assert alpha[2] < 0.0  # back towards the zenith
    assert np.allclose(inertia @ alpha, moment, rtol=1e-9, atol=1e-9 * np.linalg.norm(moment))


def test_gravity_gradient_knows_products_of_inertia() -> None:
    inertia = np.array([[2.0e4, 3.0e3, -4.0e3], [3.0e3, 5.0e4, 6.0e3], [-4.0e3, 6.0e3, 5.5e4]])
    alpha, moment = tidal(inertia, unit(0.4, -0.3, 0.8, 0.33))
    assert np.allclose(inertia @ alpha, moment, rtol=1e-9, atol=1e-9 * np.linalg.norm(moment))


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_roll_thrusters_fire_against_the_roll(sign: float) -> None:
    tree = scenario_of(Parts(), initial={"rate_BI_degps": [sign * 10.0, 0.0, 0.0]})
    tree = with_stage(tree, roll_thrusters={"torque_Nm": 150.0})
    tree["design"] = {
        "gains": {"table": [{"time_s": 0.0, "k_p": 1.0, "k_d_s": 0.5}]},
        "roll": {"k_rate_s": 0.5, "dead_band_deg": 1.0},
    }
    made = rig(tree)
    flown(made, 0.05)
    dy = made.derivative(made.y)
    assert np.isclose(dy[W], -sign * 150.0 / 700.0, rtol=1e-12)


@PLANES
def test_control_turns_against_a_body_rate(plane: int) -> None:
    """In the whole loop, a positive rate gives a negative gimbal angle and so a negative moment."""
    rate = np.zeros(3)
    rate[ABOUT[plane]] = 0.02
    tree = scenario_of(Parts(thrust_N=1.0e5), initial={"rate_BI_radps": rate})
    tree["design"] = {"gains": {"table": [{"time_s": 0.0, "k_p": 1.0, "k_d_s": 0.5}]}}
    made = rig(tree)
    flown(made, 3.0)
    assert abs(made.y[W + ABOUT[plane]]) < 0.004
