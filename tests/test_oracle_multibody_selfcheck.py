"""The multibody oracles agree with each other, closed forms and conservation laws.

| item | against |
|---|---|
| Lagrange (SymPy), no bending | MuJoCo: accelerations, actuator torque, energy, momenta |
| Lagrange (SymPy), bending, pendulums, engine acceleration | a core of particles by Kane's method |
| derivation | itself in other charts, other inertial frames, other uniform gravitation |
| pendulum | closed form of two bodies; elliptic integral at 120 degrees |
| engine | tail-wags-dog reaction on core and modes |
| core | Euler's equations with the flexible angular momentum about x |
| whole system in flight | energy, linear and angular momentum; actuators' work; damping's power |
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from oracles import multibody_mujoco, multibody_particles, multibody_sympy
from oracles.multibody_flight import fly
from oracles.multibody_system import (
    Engine,
    Floats,
    Load,
    ModePair,
    Pendulum,
    State,
    Vehicle,
    quaternion_from_rotation,
    rotation_from_quaternion,
    rotation_taking,
    thrust_direction,
)
from scipy.special import ellipk

INERTIA = np.array([[3.0e3, 50.0, -80.0], [50.0, 6.0e4, 120.0], [-80.0, 120.0, 6.2e4]])
ENGINE = Engine(300.0, 80.0, 0.9, np.array([-6.0, 0.05, -0.03]))
X_HAT = np.array([1.0, 0.0, 0.0])


def random_pairs(rng: np.random.Generator, symmetric: bool = False) -> tuple[ModePair, ...]:
    pairs = []
    for omega in (40.0, 75.0):
        mass_z, mass_y = rng.uniform(300.0, 900.0, 2)
        phi_z, phi_y, sigma_z, sigma_y = rng.normal(0.0, 0.8, 4)
        if symmetric:
            mass_y, phi_y, sigma_y = mass_z, phi_z, sigma_z
        omega_y = omega if symmetric else 1.1 * omega
        pairs.append(ModePair(mass_z, mass_y, omega, omega_y, 0.01, 0.02, phi_z, phi_y, sigma_z, sigma_y))
    return tuple(pairs)


def random_vehicle(rng: np.random.Generator, pairs: tuple[ModePair, ...] = ()) -> Vehicle:
    pendulums = tuple(
        Pendulum(
            mass_kg=rng.uniform(200.0, 600.0),
            length_m=rng.uniform(0.3, 0.8),
            hinge_B_m=np.array([station, *rng.normal(0.0, 0.1, 2)]),
            damping_1ps=rng.uniform(0.1, 0.5),
            phi_z=rng.normal(size=len(pairs)),
            phi_y=rng.normal(size=len(pairs)),
        )
        for station in (2.5, -3.0)
    )
    return Vehicle(6000.0, INERTIA, ENGINE, pairs, pendulums)


def random_state(rng: np.random.Generator, vehicle: Vehicle, bent_m: float = 0.1) -> State:
    n, k = len(vehicle.pairs), len(vehicle.pendulums)
    u = rng.normal(size=(k, 3))
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    u_dot = rng.normal(size=(k, 3))
    u_dot -= np.sum(u * u_dot, axis=1, keepdims=True) * u
    return State(
        C_IB=rotation_from_quaternion(rng.normal(size=4)),
        w_BI_B_radps=rng.normal(size=3),
        r_I_m=rng.normal(0.0, 5.0, 3),
        v_I_mps=rng.normal(0.0, 20.0, 3),
        eta_m=bent_m * rng.normal(size=n),
        etadot_mps=rng.normal(size=n),
        xi_m=bent_m * rng.normal(size=n),
        xidot_mps=rng.normal(size=n),
        u_B=u,
        udot_B_1ps=u_dot,
        deflection_rad=rng.normal(0.0, 0.3, 2),
        deflection_radps=rng.normal(size=2),
        deflection_radps2=rng.normal(0.0, 10.0, 2),
    )


def random_load(rng: np.random.Generator, n_pairs: int = 0) -> Load:
    return Load(
        force_B_N=rng.normal(0.0, 5.0e4, 3),
        moment_B_Nm=rng.normal(0.0, 2.0e4, 3),
        modal_z_N=rng.normal(0.0, 2.0e3, n_pairs),
        modal_y_N=rng.normal(0.0, 2.0e3, n_pairs),
        gravitation_I_mps2=rng.normal(0.0, 9.8, 3),
    )


def worst(a: dict[str, Floats], b: dict[str, Floats]) -> float:
    """Return the largest difference over the common quantities; each is relative to its largest component."""
    errors = [
        float(np.max(np.abs(a[key] - b[key])) / np.max(np.abs(a[key])))
        for key in a.keys() & b.keys()
        if a[key].size and np.any(a[key])
    ]
    assert errors
    return max(errors)


# --- helpers ---


def test_quaternion_and_rotation_are_inverse() -> None:
    rng = np.random.default_rng(11)
    for q in (*rng.normal(size=(20, 4)), np.array([0.0, 1.0, 0.0, 0.0]), np.array([0.0, 0.0, 0.0, 1.0])):
        unit = q / np.linalg.norm(q)
        rotation = rotation_from_quaternion(q)
        assert np.linalg.det(rotation) == pytest.approx(1.0, abs=1e-14)
        back = quaternion_from_rotation(rotation)
        assert abs(back @ unit) == pytest.approx(1.0, abs=1e-14)


def test_quaternion_turns_body_components_into_inertial_ones() -> None:
    quarter = np.array([np.cos(np.pi / 4), 0.0, 0.0, np.sin(np.pi / 4)])
    np.testing.assert_allclose(rotation_from_quaternion(quarter) @ X_HAT, [0.0, 1.0, 0.0], atol=1e-15)


@pytest.mark.parametrize("b", [X_HAT, -X_HAT, np.array([0.6, 0.0, 0.8])])
def test_rotation_taking_one_vector_into_another(b: Floats) -> None:
    rotation = rotation_taking(X_HAT, b)
    np.testing.assert_allclose(rotation @ X_HAT, b, atol=1e-15)
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-15)
    assert np.linalg.det(rotation) == pytest.approx(1.0)


# --- oracle against oracle ---


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(6))
def test_lagrange_agrees_with_mujoco(seed: int) -> None:
    rng = np.random.default_rng(seed)
    vehicle = random_vehicle(rng)
    state, load = random_state(rng, vehicle), random_load(rng)
    ours = multibody_sympy.accelerations(vehicle, state, load)
    assert worst(ours, multibody_mujoco.accelerations(vehicle, state, load)) < 2e-11


@pytest.mark.parametrize("seed", range(3))
def test_difference_from_mujoco_is_the_bob_inertia(seed: int) -> None:
    rng = np.random.default_rng(100 + seed)
    vehicle = random_vehicle(rng)
    state, load = random_state(rng, vehicle), random_load(rng)
    ours = multibody_sympy.accelerations(vehicle, state, load)
    coarse, fine = (
        worst(ours, multibody_mujoco.accelerations(vehicle, state, load, bob_inertia_ratio=ratio))
        for ratio in (1e-4, 1e-6)
    )
    assert coarse / fine == pytest.approx(100.0, rel=0.01)
    assert fine < 1e-5


def test_two_hinge_gimbal_adds_the_roll_of_the_engine_and_nothing_else() -> None:
    """A cardan rolls the engine at k = dpdot sin(dy); its reaction on the core is -(H' + w x H), H = I_t k d."""
    rng = np.random.default_rng(8)
    vehicle = random_vehicle(rng)
    state, load = random_state(rng, vehicle), random_load(rng)
    (dp, dy), (p, y), (pp, _) = state.deflection_rad, state.deflection_radps, state.deflection_radps2
    d = thrust_direction(dp, dy)
    d_dot = np.array(
        [
            -np.sin(dp) * np.cos(dy) * p - np.cos(dp) * np.sin(dy) * y,
            -np.cos(dy) * y,
            np.cos(dp) * np.cos(dy) * p - np.sin(dp) * np.sin(dy) * y,
        ]
    )
    roll, roll_dot = p * np.sin(dy), pp * np.sin(dy) + p * y * np.cos(dy)
    reaction = -ENGINE.inertia_kgm2 * (roll_dot * d + roll * d_dot + np.cross(state.w_BI_B_radps, roll * d))
    cardan = multibody_mujoco.accelerations(vehicle, state, load, roll_free_gimbal=False)
    del cardan["actuator_torque_Nm"]
    defined = multibody_sympy.accelerations(vehicle, state, load)
    pushed = multibody_sympy.accelerations(vehicle, state, replace(load, moment_B_Nm=load.moment_B_Nm + reaction))
    assert worst(cardan, pushed) < 2e-11
    assert worst(cardan, defined) > 1e-6


def test_actuator_torque_agrees_with_mujoco() -> None:
    """At zero yaw angle and rate, where a cardan does not turn the engine about its own axis."""
    rng = np.random.default_rng(7)
    vehicle = random_vehicle(rng)
    state = replace(
        random_state(rng, vehicle),
        deflection_rad=np.array([0.4, 0.0]),
        deflection_radps=np.array([1.5, 0.0]),
        deflection_radps2=np.array([20.0, 7.0]),
    )
    load = random_load(rng)
    ours = multibody_sympy.accelerations(vehicle, state, load)
    theirs = multibody_mujoco.accelerations(vehicle, state, load, roll_free_gimbal=False)
    assert (
        abs(ENGINE.inertia_kgm2 * 1.5 * (state.w_BI_B_radps @ thrust_direction(0.4, 0.0))) > 1.0
    )  # gyroscopic, in yaw
    assert worst(ours, theirs) < 2e-11


@pytest.mark.parametrize("seed", range(3))
def test_energy_and_momenta_agree_with_mujoco(seed: int) -> None:
    rng = np.random.default_rng(200 + seed)
    vehicle = random_vehicle(rng)
    state = random_state(rng, vehicle)
    gravitation = rng.normal(0.0, 9.8, 3)
    ours = multibody_sympy.energy(vehicle, state, gravitation)
    theirs = multibody_mujoco.energy(vehicle, state, gravitation)
    for key, value in ours.items():
        assert value == pytest.approx(theirs[key], rel=1e-11)
    ours_p, theirs_p = multibody_sympy.momentum(vehicle, state), multibody_mujoco.momentum(vehicle, state)
    for key, vector in ours_p.items():
        np.testing.assert_allclose(vector, theirs_p[key], rtol=0.0, atol=1e-12 * np.max(np.abs(vector)) * 10.0)


def particle_vehicle(rng: np.random.Generator) -> tuple[multibody_particles.Beam, Vehicle]:
    beam = multibody_particles.free_free_beam(
        rng.uniform(200.0, 600.0, 15),
        np.linspace(7.0, -7.0, 15),
        2,
        np.array([[2000.0, 50.0, -20.0], [50.0, 300.0, 30.0], [-20.0, 30.0, 400.0]]),
    )
    length = 0.9
    pairs = multibody_particles.mode_pairs(
        beam,
        omega_radps=np.array([60.0, 170.0]),
        zeta=np.array([0.005, 0.006]),
        engine_particle=14,
        engine_length_m=length,
        slope_1pm=np.array([0.4, -0.9]),
    )
    engine = Engine(150.0, 0.0, length, np.array([beam.x_B_m[-1] + length, 0.0, 0.0]))
    pendulums = random_vehicle(rng, pairs).pendulums
    return beam, Vehicle(float(beam.mass_kg.sum()), multibody_particles.inertia(beam), engine, pairs, pendulums)


@pytest.mark.parametrize("seed", range(5))
def test_lagrange_agrees_with_particles_while_straight(seed: int) -> None:
    """For any rates, pendulum angles and engine accelerations from the locked position, the results are equal."""
    rng = np.random.default_rng(300 + seed)
    beam, vehicle = particle_vehicle(rng)
    state = replace(random_state(rng, vehicle, bent_m=0.0), deflection_rad=np.zeros(2), deflection_radps=np.zeros(2))
    load = random_load(rng, 2)
    ours = multibody_sympy.accelerations(vehicle, state, load)
    assert worst(ours, multibody_particles.accelerations(beam, vehicle, state, load)) < 1e-12


@pytest.mark.parametrize("seed", range(3))
def test_what_bending_drops_is_the_axial_velocity_alone(seed: int) -> None:
    """At q = r = 0, M (q eta - r xi)^2 / 2 adds only to the core's inertia."""
    rng = np.random.default_rng(310 + seed)
    beam, vehicle = particle_vehicle(rng)
    state = replace(
        random_state(rng, vehicle, bent_m=0.5),
        w_BI_B_radps=np.array([3.0, 0.0, 0.0]),
        deflection_rad=np.zeros(2),
        deflection_radps=np.zeros(2),
    )
    load = random_load(rng, 2)
    axial = np.stack((np.zeros(2), state.eta_m, -state.xi_m))
    mass = np.array([pair.mass_z_kg for pair in vehicle.pairs])
    # The cross terms between modes vanish with their orthogonality.
    added = replace(vehicle, inertia_B_kgm2=vehicle.inertia_B_kgm2 + (axial * mass) @ axial.T)
    exact = multibody_particles.accelerations(beam, vehicle, state, load)
    assert worst(exact, multibody_sympy.accelerations(added, state, load)) < 1e-12
    assert worst(exact, multibody_sympy.accelerations(vehicle, state, load)) > 1e-4


# --- the derivation against itself ---


@pytest.mark.parametrize(
    ("euler_chart", "pendulum_chart"),
    [((0.0, 0.0, 0.0), (0.0, 0.0)), ((-2.0, 1.0, 2.5), (-1.2, 0.8)), ((0.3, -1.1, -3.0), (2.5, -0.9))],
)
def test_answer_does_not_depend_on_the_coordinates(
    euler_chart: tuple[float, float, float], pendulum_chart: tuple[float, float]
) -> None:
    rng = np.random.default_rng(20)
    vehicle = random_vehicle(rng, random_pairs(rng))
    state, load = random_state(rng, vehicle), random_load(rng, 2)
    one = multibody_sympy.accelerations(vehicle, state, load)
    other = multibody_sympy.accelerations(vehicle, state, load, euler_chart=euler_chart, pendulum_chart=pendulum_chart)
    assert worst(one, other) < 1e-11


def test_answer_does_not_depend_on_gravitation_or_on_the_inertial_frame() -> None:
    """The results are independent of uniform gravitation, position, velocity and the axes of I."""
    rng = np.random.default_rng(21)
    vehicle = random_vehicle(rng, random_pairs(rng))
    state, load = random_state(rng, vehicle), random_load(rng, 2)
    here = multibody_sympy.accelerations(vehicle, state, load)
    elsewhere = replace(
        state,
        C_IB=rotation_from_quaternion(rng.normal(size=4)),
        r_I_m=rng.normal(0.0, 1e3, 3),
        v_I_mps=rng.normal(0.0, 1e3, 3),
    )
    there = multibody_sympy.accelerations(vehicle, elsewhere, replace(load, gravitation_I_mps2=np.zeros(3)))
    assert worst(here, there) < 1e-9  # rounding of 1 km/s squared against the accelerations


def energy_by_hand(vehicle: Vehicle, state: State) -> float:
    """Return the kinetic energy, written a second time without SymPy, matrices or pieces."""
    w, v = state.w_BI_B_radps, state.C_IB.T @ state.v_I_mps
    nu_eta, nu_xi = state.etadot_mps + w[0] * state.xi_m, state.xidot_mps - w[0] * state.eta_m
    total = 0.5 * vehicle.mass_kg * (v @ v) + 0.5 * (w @ vehicle.inertia_B_kgm2 @ w)
    flexible, leaning = np.zeros(3), np.zeros(3)
    assert vehicle.engine is not None
    engine = vehicle.engine
    for i, pair in enumerate(vehicle.pairs):
        total += 0.5 * (pair.mass_z_kg * nu_eta[i] ** 2 + pair.mass_y_kg * nu_xi[i] ** 2)
        flexible[1] += (pair.phi_gimbal_y + engine.length_m * pair.sigma_gimbal_y_1pm) * nu_xi[i]
        flexible[2] += (pair.phi_gimbal_z + engine.length_m * pair.sigma_gimbal_z_1pm) * nu_eta[i]
        leaning[1] += pair.sigma_gimbal_z_1pm * nu_eta[i]
        leaning[2] -= pair.sigma_gimbal_y_1pm * nu_xi[i]
    for pendulum, u, u_dot in zip(vehicle.pendulums, state.u_B, state.udot_B_1ps, strict=True):
        shift = np.array([0.0, pendulum.phi_y @ state.xi_m, pendulum.phi_z @ state.eta_m])
        hinge_rate = np.array([0.0, pendulum.phi_y @ state.xidot_mps, pendulum.phi_z @ state.etadot_mps])
        bob = (
            v + np.cross(w, pendulum.hinge_B_m + shift + pendulum.length_m * u) + hinge_rate + pendulum.length_m * u_dot
        )
        total += 0.5 * pendulum.mass_kg * (bob @ bob)

    step = 1e-6  # d's rate by central difference, exact to 1e-11
    rate = state.deflection_radps
    ahead, behind = (thrust_direction(*(state.deflection_rad + s * step * rate)) for s in (1.0, -1.0))
    d, d_dot = thrust_direction(*state.deflection_rad), (ahead - behind) / (2.0 * step)
    offset, offset_rate = -engine.length_m * (d - X_HAT), -engine.length_m * d_dot
    locked = v + np.cross(w, engine.gimbal_B_m - engine.length_m * X_HAT)
    moved = locked + offset_rate + np.cross(w, offset)
    rolled = offset_rate + np.cross([w[0], 0.0, 0.0], offset)
    total += engine.mass_kg * (0.5 * (moved @ moved - locked @ locked) + rolled @ flexible)
    mount = w + leaning
    turning = mount + np.cross(d, d_dot)
    return float(total + 0.5 * engine.inertia_kgm2 * (turning @ turning - mount @ mount))


@pytest.mark.parametrize("seed", range(3))
def test_kinetic_energy_is_the_definition(seed: int) -> None:
    rng = np.random.default_rng(25 + seed)
    vehicle = random_vehicle(rng, random_pairs(rng))
    state = replace(random_state(rng, vehicle), v_I_mps=rng.normal(size=3))
    kinetic = multibody_sympy.energy(vehicle, state)["kinetic_J"]
    assert kinetic == pytest.approx(energy_by_hand(vehicle, state), rel=1e-10)


# --- closed forms ---


@pytest.mark.parametrize("seed", range(3))
def test_pendulum_hinged_at_the_cg_is_a_two_body_problem(seed: int) -> None:
    """The rod tension is s = mu (L |udot|^2 - F.u / m0) with the reduced mass mu; the core turns as if alone."""
    rng = np.random.default_rng(30 + seed)
    pendulum = Pendulum(700.0, 0.6, np.zeros(3))
    vehicle = Vehicle(2000.0, INERTIA, None, (), (pendulum,))
    state = random_state(rng, vehicle)
    load = random_load(rng)
    answer = multibody_sympy.accelerations(vehicle, state, load)

    w, u, u_dot = state.w_BI_B_radps, state.u_B[0], state.udot_B_1ps[0]
    force = load.force_B_N
    u_rate = u_dot + np.cross(w, u)  # inertial, in B
    reduced = vehicle.mass_kg * pendulum.mass_kg / (vehicle.mass_kg + pendulum.mass_kg)
    tension = reduced * (pendulum.length_m * (u_rate @ u_rate) - force @ u / vehicle.mass_kg)
    core = (force + tension * u) / vehicle.mass_kg
    w_dot = np.linalg.solve(INERTIA, load.moment_B_Nm - np.cross(w, INERTIA @ w))
    u_second = (-tension * u / pendulum.mass_kg - core) / pendulum.length_m  # inertial, in B
    seen = u_second - np.cross(w_dot, u) - 2.0 * np.cross(w, u_dot) - np.cross(w, np.cross(w, u))

    np.testing.assert_allclose(answer["specific_force_B_mps2"], core, rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(answer["wdot_B_radps2"], w_dot, rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(answer["uddot_B_1ps2"][0], seen, rtol=1e-12, atol=1e-11)


def test_pendulum_in_free_fall_turns_evenly() -> None:
    vehicle = Vehicle(2000.0, INERTIA, None, (), (Pendulum(700.0, 0.6, np.zeros(3)),))
    state = State(u_B=np.array([[0.0, 0.6, -0.8]]), udot_B_1ps=np.array([[1.5, 0.0, 0.0]]))
    answer = multibody_sympy.accelerations(vehicle, state, Load(gravitation_I_mps2=np.array([0.0, 0.0, 9.8])))
    np.testing.assert_allclose(answer["uddot_B_1ps2"], -2.25 * state.u_B, atol=1e-13)


def test_damping_force_acts_on_the_velocity_seen_from_the_body() -> None:
    rng = np.random.default_rng(33)
    vehicle = Vehicle(2000.0, INERTIA, None, (), (Pendulum(700.0, 0.6, np.zeros(3), damping_1ps=0.4),))
    state = random_state(rng, vehicle)
    damped = multibody_sympy.accelerations(vehicle, state)
    still = multibody_sympy.accelerations(
        replace(vehicle, pendulums=(replace(vehicle.pendulums[0], damping_1ps=0.0),)), state
    )
    pull = 0.4 * 700.0 * 0.6 * state.udot_B_1ps[0]
    u = state.u_B[0]
    # The reaction acts on the core where the bob is: a force, and a moment about the hinge, here C0.
    moment = np.cross(0.6 * u, pull)
    np.testing.assert_allclose(
        INERTIA @ (damped["wdot_B_radps2"] - still["wdot_B_radps2"]), moment, rtol=1e-10, atol=1e-9
    )
    np.testing.assert_allclose(
        damped["specific_force_B_mps2"] - still["specific_force_B_mps2"], pull / 2000.0, atol=1e-12
    )


def test_period_of_a_large_swing_under_acceleration() -> None:
    """From 120 degrees the quarter period is sqrt(L / a) K(sin^2(60 deg)) for any core with the hinge at C0."""
    acceleration, length = 15.0, 0.6
    vehicle = Vehicle(2000.0, INERTIA, None, (), (Pendulum(700.0, length, np.zeros(3)),))
    amplitude = np.deg2rad(120.0)
    start = State(u_B=np.array([[-np.cos(amplitude), 0.0, np.sin(amplitude)]]), udot_B_1ps=np.zeros((1, 3)))
    quarter = np.sqrt(length / acceleration) * ellipk(np.sin(amplitude / 2.0) ** 2)
    load = Load(force_B_N=np.array([acceleration * vehicle.mass_kg, 0.0, 0.0]))
    states, _ = fly(multibody_sympy.accelerations, vehicle, start, quarter, load=load)
    np.testing.assert_allclose(states[-1].u_B[0], -X_HAT, atol=1e-9)


def test_tail_wags_dog() -> None:
    """From rest, J qdot = (I_E + m_E l_E l_C) D, m0 a_z = m_E l_E D, M etaddot = (m_E l_E phi_E + I_t s) D."""
    gimbal = 5.0
    engine = Engine(300.0, 80.0, 0.9, np.array([-gimbal, 0.0, 0.0]))
    pair = ModePair(500.0, 400.0, 40.0, 44.0, 0.0, 0.0, -0.7, -0.6, 0.3, 0.2)
    vehicle = Vehicle(6000.0, np.diag([3e3, 6e4, 6.2e4]), engine, (pair,))
    rest = State(eta_m=np.zeros(1), etadot_mps=np.zeros(1), xi_m=np.zeros(1), xidot_mps=np.zeros(1))
    pull, turn = 300.0 * 0.9, 80.0 + 300.0 * 0.9**2 + 300.0 * 0.9 * gimbal

    pitch = multibody_sympy.accelerations(vehicle, replace(rest, deflection_radps2=np.array([10.0, 0.0])))
    assert pitch["wdot_B_radps2"] == pytest.approx([0.0, turn * 10.0 / 6e4, 0.0])
    assert pitch["specific_force_B_mps2"] == pytest.approx([0.0, 0.0, pull * 10.0 / 6000.0])
    assert pitch["etaddot_mps2"] == pytest.approx([(pull * (-0.7 + 0.9 * 0.3) + 80.0 * 0.3) * 10.0 / 500.0])
    assert pitch["xiddot_mps2"] == pytest.approx([0.0])

    yaw = multibody_sympy.accelerations(vehicle, replace(rest, deflection_radps2=np.array([0.0, 10.0])))
    assert yaw["wdot_B_radps2"] == pytest.approx([0.0, 0.0, turn * 10.0 / 6.2e4])
    assert yaw["specific_force_B_mps2"] == pytest.approx([0.0, -pull * 10.0 / 6000.0, 0.0])
    assert yaw["xiddot_mps2"] == pytest.approx([-(pull * (-0.6 + 0.9 * 0.2) + 80.0 * 0.2) * 10.0 / 400.0])
    assert yaw["etaddot_mps2"] == pytest.approx([0.0])


def test_deflected_engine_under_acceleration_turns_the_core_the_way_of_its_thrust() -> None:
    """The engine's CG off the axis lags behind: J qdot = m_E l_E a_x sin(dp) adds to M_delta (erratum 8)."""
    engine = Engine(300.0, 80.0, 0.9, np.array([-5.0, 0.0, 0.0]))
    vehicle = Vehicle(6000.0, np.diag([3e3, 6e4, 6e4]), engine)
    state = State(deflection_rad=np.array([1e-6, 2e-6]))
    answer = multibody_sympy.accelerations(vehicle, state, Load(force_B_N=np.array([30.0 * 6000.0, 0.0, 0.0])))
    expected = 300.0 * 0.9 * 30.0 / 6e4 * np.array([1e-6, 2e-6])
    np.testing.assert_allclose(answer["wdot_B_radps2"][1:], expected, rtol=1e-5)


@pytest.mark.parametrize("symmetric", [True, False])
def test_core_and_modes_alone_obey_euler_with_the_flexible_momentum(symmetric: bool) -> None:
    """J wdot + w x (J w + h x) + hdot x = M and Mz nudot_eta + p My nu_xi = Qz (eta); likewise in yaw."""
    rng = np.random.default_rng(40)
    vehicle = Vehicle(6000.0, INERTIA, None, random_pairs(rng, symmetric))
    state, load = random_state(rng, vehicle), random_load(rng, 2)
    assert load.modal_z_N is not None
    assert load.modal_y_N is not None
    answer = multibody_sympy.accelerations(vehicle, state, load)
    w, p = state.w_BI_B_radps, state.w_BI_B_radps[0]
    mass_z, mass_y = (np.array([getattr(s, f"mass_{a}_kg") for s in vehicle.pairs]) for a in "zy")
    omega_z, omega_y = (np.array([getattr(s, f"omega_{a}_radps") for s in vehicle.pairs]) for a in "zy")
    zeta_z, zeta_y = (np.array([getattr(s, f"zeta_{a}") for s in vehicle.pairs]) for a in "zy")
    eta, xi, eta_dot, xi_dot = state.eta_m, state.xi_m, state.etadot_mps, state.xidot_mps
    nu_eta, nu_xi = eta_dot + p * xi, xi_dot - p * eta
    force_z = load.modal_z_N - mass_z * omega_z * (omega_z * eta + 2.0 * zeta_z * eta_dot)
    force_y = load.modal_y_N - mass_y * omega_y * (omega_y * xi + 2.0 * zeta_y * xi_dot)

    h = np.sum(mass_z * xi * nu_eta - mass_y * eta * nu_xi)
    h_dot = np.sum((mass_z - mass_y) * nu_eta * nu_xi + xi * force_z - eta * force_y)
    momentum = INERTIA @ w + h * X_HAT
    w_dot = np.linalg.solve(INERTIA, load.moment_B_Nm - h_dot * X_HAT - np.cross(w, momentum))
    np.testing.assert_allclose(answer["wdot_B_radps2"], w_dot, rtol=1e-11, atol=1e-12)
    np.testing.assert_allclose(multibody_sympy.momentum(vehicle, state)["angular_C0_B_Nms"], momentum)

    p_dot = w_dot[0]
    nu_eta_dot = answer["etaddot_mps2"] + p_dot * xi + p * xi_dot
    nu_xi_dot = answer["xiddot_mps2"] - p_dot * eta - p * eta_dot
    np.testing.assert_allclose(mass_z * nu_eta_dot + p * mass_y * nu_xi, force_z, rtol=1e-11)
    np.testing.assert_allclose(mass_y * nu_xi_dot - p * mass_z * nu_eta, force_y, rtol=1e-11)


def test_torque_free_core_obeys_euler() -> None:
    w = np.array([0.7, -0.4, 1.1])
    answer = multibody_sympy.accelerations(Vehicle(6000.0, INERTIA), State(w_BI_B_radps=w))
    np.testing.assert_allclose(answer["wdot_B_radps2"], np.linalg.solve(INERTIA, -np.cross(w, INERTIA @ w)))
    np.testing.assert_allclose(answer["specific_force_B_mps2"], 0.0, atol=1e-13)


# --- flown ---


def undamped(vehicle: Vehicle) -> Vehicle:
    return replace(
        vehicle,
        pairs=tuple(replace(pair, zeta_z=0.0, zeta_y=0.0) for pair in vehicle.pairs),
        pendulums=tuple(replace(pendulum, damping_1ps=0.0) for pendulum in vehicle.pendulums),
    )


def full_system(seed: int) -> tuple[Vehicle, State]:
    rng = np.random.default_rng(seed)
    vehicle = random_vehicle(rng, random_pairs(rng))
    state = random_state(rng, vehicle)
    fixed = np.zeros(2)
    return vehicle, replace(state, deflection_radps=fixed, deflection_radps2=fixed)


def assert_momenta_kept(vehicle: Vehicle, states: list[State]) -> None:
    first, last = (multibody_sympy.momentum(vehicle, state) for state in (states[0], states[-1]))
    for key in ("linear_I_Ns", "angular_I_Nms"):
        scale = np.max(np.abs(first[key]))
        np.testing.assert_allclose(last[key], first[key], rtol=0.0, atol=1e-9 * scale, err_msg=key)


@pytest.mark.slow
def test_energy_and_momenta_are_kept_without_damping() -> None:
    vehicle, start = full_system(50)
    vehicle = undamped(vehicle)
    states, _ = fly(multibody_sympy.accelerations, vehicle, start, 0.5)
    energies = [multibody_sympy.energy(vehicle, state)["total_J"] for state in states]
    assert np.ptp(energies) < 1e-9 * energies[0]
    assert_momenta_kept(vehicle, states)
    # Something must have moved for this to mean anything.
    assert np.max(np.abs(states[-1].w_BI_B_radps - states[0].w_BI_B_radps)) > 0.1
    assert np.min(np.sum(states[-1].u_B * states[0].u_B, axis=1)) < 0.9


@pytest.mark.long
def test_energy_is_kept_under_uniform_gravitation() -> None:
    vehicle, start = full_system(51)
    vehicle = undamped(vehicle)
    gravitation = np.array([3.0, -8.0, 5.0])
    states, _ = fly(multibody_sympy.accelerations, vehicle, start, 0.5, load=Load(gravitation_I_mps2=gravitation))
    energies = [multibody_sympy.energy(vehicle, state, gravitation) for state in states]
    kinetic = [energy["kinetic_J"] for energy in energies]
    assert np.ptp([energy["total_J"] for energy in energies]) < 1e-9 * max(kinetic)
    assert np.ptp(kinetic) > 1e-3 * max(kinetic)


@pytest.mark.long
def test_damping_keeps_momenta_and_takes_energy() -> None:
    vehicle, start = full_system(52)
    states, _ = fly(multibody_sympy.accelerations, vehicle, start, 0.5)
    assert_momenta_kept(vehicle, states)
    energies = [multibody_sympy.energy(vehicle, state)["total_J"] for state in states]
    assert np.all(np.diff(energies) < 0.0)


@pytest.mark.long
def test_moving_engine_keeps_momenta_and_adds_the_work_of_its_actuators() -> None:
    vehicle, start = full_system(53)
    vehicle = undamped(vehicle)
    amplitude, rate = np.array([0.2, -0.3]), np.array([12.0, 9.0])

    def deflection(time: float) -> tuple[Floats, Floats, Floats]:
        phase = rate * time + np.array([0.3, 1.0])
        return (amplitude * np.sin(phase), amplitude * rate * np.cos(phase), -amplitude * rate**2 * np.sin(phase))

    states, work = fly(multibody_sympy.accelerations, vehicle, start, 0.5, deflection=deflection)
    assert_momenta_kept(vehicle, states)
    energies = np.array([multibody_sympy.energy(vehicle, state)["total_J"] for state in states])
    gained = energies - energies[0]
    assert np.max(np.abs(gained)) > 100.0
    np.testing.assert_allclose(gained, work, rtol=0.0, atol=1e-9 * energies[0])


def test_thrust_direction_gives_positive_moments() -> None:
    arm = np.array([-5.0, 0.0, 0.0])
    assert np.cross(arm, thrust_direction(0.1, 0.0))[1] > 0.0
    assert np.cross(arm, thrust_direction(0.0, 0.1))[2] > 0.0


def test_mujoco_oracle_refuses_bending() -> None:
    rng = np.random.default_rng(60)
    with pytest.raises(ValueError, match="no bending"):
        multibody_mujoco.model_text(random_vehicle(rng, random_pairs(rng)))


def test_particle_oracle_refuses_an_engine_with_inertia() -> None:
    rng = np.random.default_rng(61)
    beam, vehicle = particle_vehicle(rng)
    assert vehicle.engine is not None
    vehicle = replace(vehicle, engine=replace(vehicle.engine, inertia_kgm2=1.0))
    with pytest.raises(ValueError, match="no inertia about its own CG"):
        multibody_particles.accelerations(beam, vehicle, random_state(rng, vehicle))
