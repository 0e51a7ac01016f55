"""Second-order terms of a moving engine on a bending body (docs/model.md, sections 3 and 4) agree with particles.

| term | | against |
|---|---|---|
| roll moment of the displaced engine on the bent mount | contained in the equations | Kane's method |
| force of the engine's own inertia on a mode under p r | omitted, as large as I_t sigma p r | six particles |
"""

from __future__ import annotations

import numpy as np
import pytest
from oracles import multibody_particles, multibody_sympy
from oracles.multibody_system import Engine, Floats, Load, State, Vehicle, thrust_direction

ENGINE_KG, ARM_M = 150.0, 0.9


def particle_vehicle(rng: np.random.Generator) -> tuple[multibody_particles.Beam, Vehicle]:
    beam = multibody_particles.free_free_beam(
        rng.uniform(200.0, 600.0, 15), np.linspace(7.0, -7.0, 15), 2, np.diag([900.0, 0.0, 0.0])
    )
    pairs = multibody_particles.mode_pairs(
        beam,
        omega_radps=np.array([60.0, 170.0]),
        zeta=np.zeros(2),
        engine_particle=14,
        engine_length_m=ARM_M,
        slope_1pm=np.array([0.4, 0.9]),
    )
    engine = Engine(ENGINE_KG, 0.0, ARM_M, np.array([beam.x_B_m[-1] + ARM_M, 0.0, 0.0]))
    return beam, Vehicle(float(beam.mass_kg.sum()), multibody_particles.inertia(beam), engine, pairs)


def roll_moments(angle_deg: float, bent_m: float, seed: int) -> tuple[float, float]:
    """Return the roll moment missing in Lagrange's equations, and that of the displaced engine on the bent mount, N m.

    Both modes are bent and the engine deflected, at rest.
    """
    beam, vehicle = particle_vehicle(np.random.default_rng(seed))
    angle = np.radians(angle_deg)
    state = State(
        eta_m=np.array([bent_m, -0.6 * bent_m]),
        etadot_mps=np.zeros(2),
        xi_m=np.array([-0.5 * bent_m, bent_m]),
        xidot_mps=np.zeros(2),
        deflection_rad=np.array([angle, -0.7 * angle]),
    )
    load = Load(np.zeros(3), np.zeros(3), np.zeros(2), np.zeros(2), np.zeros(3))
    exact = multibody_particles.accelerations(beam, vehicle, state, load)
    model = multibody_sympy.accelerations(vehicle, state, load)
    inertia = vehicle.inertia_B_kgm2[0, 0]
    missed = inertia * float(exact["wdot_B_radps2"][0] - model["wdot_B_radps2"][0])
    at_engine = np.array([p.phi_gimbal_z + ARM_M * p.sigma_gimbal_z_1pm for p in vehicle.pairs])
    delta = -ARM_M * (thrust_direction(*state.deflection_rad) - [1.0, 0.0, 0.0])
    moving: Floats = np.array([0.0, at_engine @ exact["xiddot_mps2"], at_engine @ exact["etaddot_mps2"]])
    return missed, -ENGINE_KG * float(np.cross(delta, moving)[0])


@pytest.mark.parametrize("seed", range(4))
def test_roll_moment_of_the_displaced_engine_is_in_the_equations(seed: int) -> None:
    """The second-order moment is contained; the fourth-order rest is an axial velocity absent from modal energy."""
    missed, moment = roll_moments(6.0, 0.01, seed)
    assert abs(moment) > 5e3
    assert abs(missed) < 1e-4 * abs(moment)
    assert abs(roll_moments(0.6, 0.001, seed)[0]) < 2e-4 * abs(missed)


def test_inertia_of_the_engine_drives_a_mode_by_p_r() -> None:
    """The force equals d(T)/d(eta) of particles at rest in the modes: a beam and an isotropic rotor behind it."""
    rng = np.random.default_rng(2)
    mass, x = rng.uniform(200.0, 600.0, 12), np.linspace(6.0, -5.0, 12)
    each, radius, slope, station = 40.0, 0.8, 0.3, -6.0
    rotor = np.concatenate([np.eye(3), -np.eye(3)]) * radius  # six particles: inertia 4 m a^2 about each axis
    inertia = 4.0 * each * radius**2
    places = np.concatenate([np.stack([x, 0 * x, 0 * x], axis=1), np.array([station, 0.0, 0.0]) + rotor])
    masses = np.concatenate([mass, np.full(6, each)])
    places[:, 0] -= masses @ places[:, 0] / masses.sum()
    # a shape with the rotor turning as a rigid body about y: z falls by slope times what lies forward of its centre
    shape = np.zeros((18, 3))
    shape[:12, 2] = rng.normal(size=12)
    shape[12:, 2] = 0.7 - slope * rotor[:, 0]
    shape[12:, 0] = slope * rotor[:, 2]
    # orthogonal to displacement and rotation: changed on the beam alone
    rows = np.stack([np.ones(12), places[:12, 0]]) * mass
    lacks = [masses @ shape[:, 2], masses @ (places[:, 0] * shape[:, 2] - places[:, 2] * shape[:, 0])]
    shape[:12, 2] -= np.linalg.lstsq(rows, np.array(lacks), rcond=None)[0]
    w = np.array([0.7, 0.2, -0.9])

    def energy(eta: float) -> float:
        moved = places + eta * shape
        return 0.5 * float(masses @ (np.cross(w, moved) ** 2).sum(axis=1))

    force = (energy(1e-4) - energy(-1e-4)) / 2e-4
    assert force == pytest.approx(-inertia * slope * w[0] * w[2], rel=1e-6)
