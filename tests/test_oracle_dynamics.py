"""The derivative of the flight equals independently derived equations of motion, at random states.

| case | against |
|---|---|
| all coupled: modes in two planes, tanks, moving engine, full inertia, CG off the axis | Lagrange |
| with thrust: follower, softening, slosh damping, displaced engine under load | Lagrange plus loads |
| without bending | MuJoCo |
| injected force and torque, uniform gravitation | Lagrange |

Vehicles pass through loader and packing, so that the subtraction of the sloshing masses from the core is tested too.
"""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest
from flightkit import (
    Mode,
    Parts,
    Rig,
    Tank,
    accelerations,
    composed,
    oracle_vehicle,
    rig,
    scenario_of,
    to_oracle,
    to_simulator,
)
from oracles import multibody_mujoco, multibody_sympy
from oracles.multibody_system import Load, State, rotation_from_quaternion, thrust_direction
from scipy.integrate import quad
from scipy.interpolate import CubicHermiteSpline

from maxq.control.kernel.records import Array

STATIONS = (0.0, 3.0, 5.0, 10.0, 12.0, 14.0)  # 5 and 10: hinges, 12: gimbal


def slopes_of(phi: Array | list[float]) -> Array:
    """Return the smallest slopes whose mean between stations is the difference of the shape."""
    means = 0.5 * (np.eye(len(STATIONS))[:-1] + np.eye(len(STATIONS))[1:])
    return np.asarray(np.linalg.lstsq(means, np.diff(phi) / np.diff(STATIONS), rcond=None)[0])


def a_mode(rng: np.random.Generator, frequency_hz: float, zeta: float = 0.0) -> Mode:
    phi = rng.normal(0.0, 0.8, len(STATIONS))
    slope = slopes_of(phi) + rng.normal(0.0, 0.05, len(STATIONS))
    return Mode(frequency_hz, rng.uniform(300.0, 900.0), tuple(phi), tuple(slope), zeta)


def same_at_hinges(mode: Mode, partner: Mode) -> Mode:
    """Return `partner` with the displacements of `mode` at the hinges, as in a body of revolution."""
    phi = list(partner.phi)
    for k, station in enumerate(STATIONS):
        if station in (5.0, 10.0):
            phi[k] = mode.phi[k]
    return replace(partner, phi=tuple(phi), slope_pm=tuple(slopes_of(phi)))


def random_parts(rng: np.random.Generator, modes: int = 2, zeta: float = 0.0, alike: bool = True) -> Parts:
    """Return random parts. `alike`: both planes displace the hinges equally, as in a body of revolution."""
    a = rng.normal(size=(3, 3))
    inertia = np.diag([8.0e3, 5.0e4, 5.2e4]) + 100.0 * (a + a.T)
    pitch = tuple(a_mode(rng, 6.0 + 5.0 * k, zeta) for k in range(modes))
    yaw = tuple(a_mode(rng, 6.5 + 5.5 * k, zeta) for k in range(modes))
    if alike:
        yaw = tuple(same_at_hinges(p, y) for p, y in zip(pitch, yaw, strict=True))
    return Parts(
        core_mass_kg=4000.0,
        core_cg=(7.0, 0.04, -0.07),
        core_inertia=tuple(map(tuple, inertia)),
        tanks=(Tank(400.0, 0.5, 5.0, 0.03), Tank(700.0, 0.7, 10.0, 0.02)),
        pitch=pitch,
        yaw=yaw,
        gimbal_offset_m=(0.02, -0.03),
        engine_mass_kg=250.0,
        engine_cg_m=0.6,
        engine_inertia_kgm2=60.0,
    )


def random_state(rng: np.random.Generator, modes: int, bent_m: float = 0.1, moving: bool = True) -> State:
    u = rng.normal(size=(2, 3))
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    u_dot = rng.normal(size=(2, 3))
    u_dot -= np.sum(u * u_dot, axis=1, keepdims=True) * u
    return State(
        C_IB=rotation_from_quaternion(rng.normal(size=4)),
        w_BI_B_radps=rng.normal(size=3),
        r_I_m=rng.normal(0.0, 100.0, 3),
        v_I_mps=rng.normal(0.0, 20.0, 3),
        eta_m=bent_m * rng.normal(size=modes),
        etadot_mps=rng.normal(size=modes),
        xi_m=bent_m * rng.normal(size=modes),
        xidot_mps=rng.normal(size=modes),
        u_B=u,
        udot_B_1ps=u_dot,
        deflection_rad=rng.normal(0.0, 0.3, 2),
        deflection_radps=float(moving) * rng.normal(size=2),
        deflection_radps2=float(moving) * rng.normal(0.0, 10.0, 2),
    )


def worst(ours: dict[str, Array], theirs: dict[str, Array]) -> float:
    """Return the largest difference; each quantity is relative to its largest component."""
    errors = [
        float(np.max(np.abs(ours[key] - theirs[key])) / np.max(np.abs(theirs[key]))) for key in ours if theirs[key].size
    ]
    assert errors
    return max(errors)


def seen(made: Rig, state: State) -> tuple[Array, State]:
    """Return the simulator's state vector, and the oracle's state converted from it, so that both have its rounding."""
    y = to_simulator(made, state)
    return y, to_oracle(made, y)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(6))
def test_free_multibody_system_agrees_with_lagrange(seed: int) -> None:
    rng = np.random.default_rng(seed)
    parts = random_parts(rng, zeta=0.01)
    made = rig(scenario_of(parts))
    wanted = random_state(rng, 2)
    y, state = seen(made, wanted)
    assert np.allclose(state.deflection_radps2, wanted.deflection_radps2, rtol=1e-6)  # the way there works
    assert np.allclose(state.etadot_mps, wanted.etadot_mps, atol=1e-12)
    theirs = multibody_sympy.accelerations(oracle_vehicle(parts), state)
    assert worst(accelerations(made, y), theirs) < 1e-10


@pytest.mark.parametrize("seed", range(3))
def test_tension_at_hinges_that_the_planes_displace_differently(seed: int) -> None:
    """In a vehicle without rotational symmetry, the hinge's velocity is that of the displaced point, including roll."""
    rng = np.random.default_rng(100 + seed)
    parts = random_parts(rng, alike=False)
    made = rig(scenario_of(parts))
    y, state = seen(made, random_state(rng, 2))
    theirs = multibody_sympy.accelerations(oracle_vehicle(parts), state)
    assert worst(accelerations(made, y), theirs) < 1e-10


def test_tanks_off_the_axis_agree_with_lagrange() -> None:
    rng = np.random.default_rng(200)
    parts = random_parts(rng)
    front, rear = parts.tanks
    tanks = (replace(front, place_m=(0.4, -0.25)), replace(rear, place_m=(-0.3, 0.5)))
    parts = replace(parts, tanks=tanks)
    made = rig(scenario_of(parts))
    y, state = seen(made, random_state(rng, 2))
    theirs = multibody_sympy.accelerations(oracle_vehicle(parts), state)
    assert worst(accelerations(made, y), theirs) < 1e-10


@pytest.mark.parametrize("seed", range(4))
def test_rigid_body_with_pendulums_and_engine_agrees_with_mujoco(seed: int) -> None:
    rng = np.random.default_rng(10 + seed)
    parts = random_parts(rng, modes=0)
    made = rig(scenario_of(parts))
    y, state = seen(made, random_state(rng, 0))
    theirs = multibody_mujoco.accelerations(oracle_vehicle(parts), state)
    assert worst(accelerations(made, y), theirs) < 1e-8


@pytest.mark.parametrize("seed", range(2))
def test_uniform_gravitation_and_injected_loads_agree_with_lagrange(seed: int) -> None:
    rng = np.random.default_rng(20 + seed)
    parts = random_parts(rng)
    force, torque = rng.normal(0.0, 5.0e4, 3), rng.normal(0.0, 2.0e4, 3)
    injections = [
        {"at": "body_force", "axis": axis, "kind": "step", "amplitude_N": value}
        for axis, value in zip("xyz", force, strict=True)
    ] + [
        {"at": "body_torque", "axis": axis, "kind": "step", "amplitude_Nm": value}
        for axis, value in zip("xyz", torque, strict=True)
    ]
    earth = {"gravity": "uniform", "uniform_mps2": 9.3}
    made = rig(scenario_of(parts, earth=earth, injection=injections))
    y, state = seen(made, random_state(rng, 2))
    gravitation = np.array([0.0, 0.0, 9.3])
    load = Load(force, torque, gravitation_I_mps2=gravitation)
    theirs = multibody_sympy.accelerations(oracle_vehicle(parts), state, load)
    assert worst(accelerations(made, y, gravitation), theirs) < 1e-10


def softening(parts: Parts, modes: tuple[Mode, ...]) -> Array:
    """Return the integral of mass_forward phi_i' phi_j' up to the gimbal, less the engine's term (kg/m)."""
    x = np.array(parts.stations_m)
    shapes = [CubicHermiteSpline(x, mode.phi, mode.slope_pm) for mode in modes]
    out = np.zeros((len(modes), len(modes)))
    inside = [float(s) for s in x if s <= parts.gimbal_station_m]
    at = parts.gimbal_station_m
    for i, a in enumerate(shapes):
        for j, b in enumerate(shapes):
            for start, end in itertools.pairwise(inside):
                out[i, j] += quad(
                    lambda s, a=a, b=b: float(np.interp(s, x, parts.mass_forward_kg)) * a(s, 1) * b(s, 1),
                    start,
                    end,
                    epsabs=0.0,
                    epsrel=1e-13,
                )[0]
            out[i, j] -= parts.engine_mass_kg * parts.engine_cg_m * a(at, 1) * b(at, 1)
    return out


def thrust_load(parts: Parts, state: State, follower: bool) -> tuple[Load, float]:
    """Return the load of thrust written out by hand (docs/model.md, section 4), and the axial specific force, m/s2.

    A force on the bent body does work on the velocity of the displaced point. The oracle's modal forces do work on
    etadot and xidot at fixed body rates, so every lateral modal force that turns with the body adds its roll moment.
    """
    vehicle = oracle_vehicle(parts)
    assert vehicle.engine is not None
    g = parts.stations_m.index(parts.gimbal_station_m)
    phi_z, phi_y = np.array([m.phi[g] for m in parts.pitch]), np.array([m.phi[g] for m in parts.yaw])
    slope_z, slope_y = (np.array([m.slope_pm[g] for m in parts.pitch]), np.array([m.slope_pm[g] for m in parts.yaw]))
    turning = np.array([0.0, slope_z @ state.eta_m, -slope_y @ state.xi_m])
    moved = np.array([0.0, phi_y @ state.xi_m, phi_z @ state.eta_m])
    straight = thrust_direction(*state.deflection_rad)
    axis = straight + np.cross(turning, straight) if follower else straight
    force = parts.thrust_N * axis
    load = force[0] / composed(parts)[0]
    mass, arm = parts.engine_mass_kg, parts.engine_cg_m
    displaced = -arm * (straight - np.array([1.0, 0.0, 0.0]))
    # moments about y and z on the gimbal: thrust line off the axis, and the displaced engine's weight
    # under load
    bend_y = parts.gimbal_offset_m[1] * force[0] - mass * load * displaced[2]
    bend_z = -parts.gimbal_offset_m[0] * force[0] + mass * load * displaced[1]
    on_z, on_y = phi_z * force[2] + slope_z * bend_y, phi_y * force[1] - slope_y * bend_z
    moment = np.cross(vehicle.engine.gimbal_B_m, force)
    moment += np.array([0.0, moved[2] * force[0], -moved[1] * force[0]])
    moment[0] += state.xi_m @ on_z - state.eta_m @ on_y
    soft_z = load * softening(parts, parts.pitch) @ state.eta_m
    soft_y = load * softening(parts, parts.yaw) @ state.xi_m
    return Load(force, moment, on_z + soft_z, on_y + soft_y), load


@pytest.mark.parametrize("follower", [True, False])
@pytest.mark.parametrize("seed", range(3))
def test_thrust_softening_and_slosh_damping_agree_with_lagrange(seed: int, follower: bool) -> None:
    rng = np.random.default_rng(30 + seed)
    parts = replace(random_parts(rng, zeta=0.02, alike=seed > 0), thrust_N=1.2e5)
    made = rig(scenario_of(parts, switches={"follower_thrust": follower}))
    y, state = seen(made, random_state(rng, 2))
    load, axial = thrust_load(parts, state, follower)
    damping = tuple(2.0 * t.damping_ratio * np.sqrt(abs(axial) / t.length_m) for t in parts.tanks)
    theirs = multibody_sympy.accelerations(oracle_vehicle(parts, damping), state, load)
    assert worst(accelerations(made, y), theirs) < 1e-10


def test_switches_take_away_what_they_name() -> None:
    """With softening and engine inertia off, the result is the oracle's without them."""
    rng = np.random.default_rng(40)
    parts = replace(random_parts(rng), thrust_N=1.2e5)
    made = rig(scenario_of(parts, switches={"bending_softening": False}))
    y, state = seen(made, random_state(rng, 2))
    load, axial = thrust_load(parts, state, True)
    soft = (axial * softening(parts, parts.pitch) @ state.eta_m, axial * softening(parts, parts.yaw) @ state.xi_m)
    assert load.modal_z_N is not None
    assert load.modal_y_N is not None
    load = replace(load, modal_z_N=load.modal_z_N - soft[0], modal_y_N=load.modal_y_N - soft[1])
    damping = tuple(2.0 * t.damping_ratio * np.sqrt(abs(axial) / t.length_m) for t in parts.tanks)
    theirs = multibody_sympy.accelerations(oracle_vehicle(parts, damping), state, load)
    assert worst(accelerations(made, y), theirs) < 1e-10

    made = rig(scenario_of(replace(parts, thrust_N=0.0), switches={"engine_inertia": False}))
    y, state = seen(made, random_state(rng, 2))
    still = replace(state, deflection_rad=np.zeros(2), deflection_radps=np.zeros(2), deflection_radps2=np.zeros(2))
    theirs = multibody_sympy.accelerations(oracle_vehicle(replace(parts, thrust_N=0.0)), still)
    assert worst(accelerations(made, y), theirs) < 1e-10


def test_kinematics_of_attitude_and_pendulums() -> None:
    """The first-order parts of the derivative equal finite rotations over a short time."""
    rng = np.random.default_rng(50)
    made = rig(scenario_of(random_parts(rng)))
    y, state = seen(made, random_state(rng, 2))
    h = 1e-6
    dy = made.derivative(y)
    after = to_oracle(made, y + h * dy)
    before = to_oracle(made, y - h * dy)
    w = state.w_BI_B_radps
    skew = np.array([[0.0, -w[2], w[1]], [w[2], 0.0, -w[0]], [-w[1], w[0], 0.0]])
    assert np.allclose((after.C_IB - before.C_IB) / (2 * h), state.C_IB @ skew, atol=1e-8)
    assert np.allclose((after.r_I_m - before.r_I_m) / (2 * h), state.v_I_mps, atol=1e-7)
    assert np.allclose((after.eta_m - before.eta_m) / (2 * h), state.etadot_mps, atol=1e-8)
    assert np.allclose((after.xi_m - before.xi_m) / (2 * h), state.xidot_mps, atol=1e-8)
    assert np.allclose((after.u_B - before.u_B) / (2 * h), state.udot_B_1ps, atol=1e-8)
    rate = (after.deflection_rad - before.deflection_rad) / (2 * h)
    accel = (after.deflection_radps - before.deflection_radps) / (2 * h)
    assert np.allclose(rate, state.deflection_radps, rtol=1e-6)
    assert np.allclose(accel, state.deflection_radps2, rtol=1e-4)
