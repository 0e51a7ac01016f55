"""Check bending with a core made of particles on the x axis, by Kane's method.

Every velocity of every particle is exact, and no modal energy is assumed. The shapes are orthogonal to 1, to x and to
each other under the particles' masses, as free-free modes are. The kinetic energy of this core is therefore the defined
one plus exactly M (q eta - r xi)^2 / 2 per pair, from the axial velocity that the definition omits. At eta = xi = 0
this term has no effect on the equations of motion, and both agree to rounding at any rates.

A moving engine is one more particle (its own inertia must be zero). The definition also omits m_E (0, q, r) x Delta .
(flexible velocity) and the rotation of Delta with the bent mount. The first vanishes where the deflection and its rate
are zero; the second is absent unless `mount_turns_engine` is set.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from oracles.multibody_system import Engine, Floats, Load, ModePair, State, Vehicle, rotation_taking, thrust_direction

# (phi_z, phi_y) of a point -> its flexible shift, the rate of that shift, its partial velocities; all in B.
Flexible = Callable[[Floats, Floats], tuple[Floats, Floats, Floats]]


@dataclass(frozen=True)
class Beam:
    """Particles: masses (N,), x_B (N,) with CG at zero, shapes (n_pairs, N); and a rotor of pure inertia."""

    mass_kg: Floats
    x_B_m: Floats
    phi: Floats
    rotor_kgm2: Floats


def free_free_beam(mass_kg: Floats, x_B_m: Floats, n_pairs: int, rotor_kgm2: Floats) -> Beam:
    """Return a beam whose shapes are mass-orthogonalised powers of x (Gram-Schmidt), each 1 at the last particle."""
    x = x_B_m - mass_kg @ x_B_m / mass_kg.sum()
    span = np.ptp(x)
    basis: list[Floats] = []
    for power in range(n_pairs + 2):
        shape = (x / span) ** power
        for _ in range(2):  # a second pass removes what rounding left in the first
            for other in basis:
                shape = shape - other * (mass_kg @ (shape * other)) / (mass_kg @ (other * other))
        basis.append(shape / shape[-1])
    return Beam(mass_kg, x, np.array(basis[2:]), rotor_kgm2)


def inertia(beam: Beam) -> Floats:
    """Return J about C0 of the particles and the rotor, (3, 3)."""
    along = float(beam.mass_kg @ beam.x_B_m**2)
    total: Floats = np.diag([0.0, along, along]) + beam.rotor_kgm2
    return total


def mode_pairs(
    beam: Beam, *, omega_radps: Floats, zeta: Floats, engine_particle: int, engine_length_m: float, slope_1pm: Floats
) -> tuple[ModePair, ...]:
    """Return symmetric pairs whose gimbal shape puts phi_E = phi_gimbal + l_E * slope on the engine's particle."""
    pairs = []
    for shape, omega, damping, slope in zip(beam.phi, omega_radps, zeta, slope_1pm, strict=True):
        mass = float(beam.mass_kg @ shape**2)
        gimbal = shape[engine_particle] - engine_length_m * slope
        pairs.append(ModePair(mass, mass, omega, omega, damping, damping, gimbal, gimbal, slope, slope))
    return tuple(pairs)


def _skew(r: Floats) -> Floats:
    return np.array([[0.0, -r[2], r[1]], [r[2], 0.0, -r[0]], [-r[1], r[0], 0.0]])


@dataclass(frozen=True)
class _Particle:
    """A particle: position in B, its rates in B, and partial velocities in the speeds beyond v0 and w."""

    mass: float
    position: Floats
    rate: Floats
    rest: Floats  # second rate of the position at zero generalised acceleration
    partial: Floats  # (3, speeds - 6)


def accelerations(
    beam: Beam, vehicle: Vehicle, state: State, load: Load | None = None, *, mount_turns_engine: bool = False
) -> dict[str, Floats]:
    """Return the accelerations with keys and units of `multibody_sympy.accelerations`, without the actuators' torque.

    `vehicle` must describe the same core: mass, `inertia(beam)`, `mode_pairs(beam, ...)`, engine on the axis. Raises
    ValueError for an engine with inertia about its own CG.
    """
    load = load or Load()
    n, k = len(vehicle.pairs), len(vehicle.pendulums)
    speeds = 6 + 2 * n + 2 * k
    tangents = [rotation_taking(np.array([1.0, 0.0, 0.0]), u)[:, 1:] for u in state.u_B]

    def flexible(phi_z: Floats, phi_y: Floats) -> tuple[Floats, Floats, Floats]:
        shift = np.array([0.0, phi_y @ state.xi_m, phi_z @ state.eta_m])
        rate = np.array([0.0, phi_y @ state.xidot_mps, phi_z @ state.etadot_mps])
        partial = np.zeros((3, speeds - 6))
        partial[2, :n] = phi_z
        partial[1, n : 2 * n] = phi_y
        return shift, rate, partial

    particles = []
    for mass, x, phi in zip(beam.mass_kg, beam.x_B_m, beam.phi.T, strict=True):
        shift, rate, partial = flexible(phi, phi)
        particles.append(_Particle(mass, np.array([x, 0.0, 0.0]) + shift, rate, np.zeros(3), partial))
    if vehicle.engine is not None:
        particles += _engine(vehicle, vehicle.engine, state, flexible, mount_turns_engine)
    for index, pendulum in enumerate(vehicle.pendulums):
        shape = (pendulum.phi_z, pendulum.phi_y) if len(pendulum.phi_z) else (np.zeros(n), np.zeros(n))
        shift, rate, partial = flexible(*shape)
        u, u_dot = state.u_B[index], state.udot_B_1ps[index]
        partial[:, 2 * n + 2 * index : 2 * n + 2 * index + 2] = pendulum.length_m * tangents[index]
        particles.append(
            _Particle(
                pendulum.mass_kg,
                pendulum.hinge_B_m + shift + pendulum.length_m * u,
                rate + pendulum.length_m * u_dot,
                -pendulum.length_m * (u_dot @ u_dot) * u,
                partial,
            )
        )

    w = state.w_BI_B_radps
    mass_matrix, right = np.zeros((speeds, speeds)), np.zeros(speeds)
    for particle in particles:
        partial = np.hstack((np.eye(3), -_skew(particle.position), particle.partial))
        rest = np.cross(w, np.cross(w, particle.position)) + 2.0 * np.cross(w, particle.rate) + particle.rest
        mass_matrix += particle.mass * partial.T @ partial
        right -= particle.mass * partial.T @ rest
    mass_matrix[3:6, 3:6] += beam.rotor_kgm2
    right[3:6] -= np.cross(w, beam.rotor_kgm2 @ w)

    right[:3] += load.force_B_N
    right[3:6] += load.moment_B_Nm
    for i, pair in enumerate(vehicle.pairs):
        for row, coordinate, rate_of, damping, omega, modal_mass in (
            (6 + i, state.eta_m, state.etadot_mps, pair.zeta_z, pair.omega_z_radps, pair.mass_z_kg),
            (6 + n + i, state.xi_m, state.xidot_mps, pair.zeta_y, pair.omega_y_radps, pair.mass_y_kg),
        ):
            right[row] -= modal_mass * omega * (omega * coordinate[i] + 2.0 * damping * rate_of[i])
    if load.modal_z_N is not None:
        right[6 : 6 + n] += load.modal_z_N
    if load.modal_y_N is not None:
        right[6 + n : 6 + 2 * n] += load.modal_y_N
    for index, pendulum in enumerate(vehicle.pendulums):
        start = 6 + 2 * n + 2 * index
        drag = -pendulum.damping_1ps * pendulum.mass_kg * pendulum.length_m * state.udot_B_1ps[index]
        right[start : start + 2] += pendulum.length_m * tangents[index].T @ drag

    scale = 1.0 / np.sqrt(np.diag(mass_matrix))
    answer = scale * np.linalg.solve(mass_matrix * np.outer(scale, scale), scale * right)
    uddot = [
        tangents[index] @ answer[6 + 2 * n + 2 * index : 8 + 2 * n + 2 * index]
        - (state.udot_B_1ps[index] @ state.udot_B_1ps[index]) * state.u_B[index]
        for index in range(k)
    ]
    # Uniform gravitation pulls on every particle alike, so the solution is already relative to free fall.
    return {
        "specific_force_B_mps2": answer[:3],
        "wdot_B_radps2": answer[3:6],
        "etaddot_mps2": answer[6 : 6 + n],
        "xiddot_mps2": answer[6 + n : 6 + 2 * n],
        "uddot_B_1ps2": np.array(uddot).reshape(k, 3),
    }


def _engine_offset(engine: Engine, state: State) -> tuple[Floats, Floats, Floats]:
    """Return delta and its first and second rates in B, by the chain rule on the angles of d."""
    (dp, dy), (p, y), (pp, yy) = state.deflection_rad, state.deflection_radps, state.deflection_radps2
    cp, sp_, cy, sy = np.cos(dp), np.sin(dp), np.cos(dy), np.sin(dy)
    d_p, d_y = np.array([-sp_ * cy, 0.0, cp * cy]), np.array([-cp * sy, -cy, -sp_ * sy])
    d_pp, d_py = np.array([-cp * cy, 0.0, -sp_ * cy]), np.array([sp_ * sy, 0.0, -cp * sy])
    d_yy = np.array([-cp * cy, sy, -sp_ * cy])
    length = engine.length_m
    return (
        -length * (thrust_direction(dp, dy) - np.array([1.0, 0.0, 0.0])),
        -length * (d_p * p + d_y * y),
        -length * (d_p * pp + d_y * yy + d_pp * p * p + 2.0 * d_py * p * y + d_yy * y * y),
    )


def _engine(vehicle: Vehicle, engine: Engine, state: State, flexible: Flexible, mount_turns: bool) -> list[_Particle]:
    """Return the engine's particle, and a negative one that removes it from its undeflected place in the beam."""
    if engine.inertia_kgm2 != 0.0:
        raise ValueError("the particle oracle's engine has no inertia about its own CG; set inertia_kgm2 to zero")
    phi_z = np.array([s.phi_gimbal_z + engine.length_m * s.sigma_gimbal_z_1pm for s in vehicle.pairs])
    phi_y = np.array([s.phi_gimbal_y + engine.length_m * s.sigma_gimbal_y_1pm for s in vehicle.pairs])
    shift, rate, partial = flexible(phi_z, phi_y)
    locked = engine.gimbal_B_m - engine.length_m * np.array([1.0, 0.0, 0.0]) + shift
    delta, delta_dot, delta_ddot = _engine_offset(engine, state)
    moved = locked + delta
    moved_rate, moved_rest, moved_partial = rate + delta_dot, delta_ddot, partial
    if mount_turns:
        turn = np.array([[0.0, s.sigma_gimbal_z_1pm, 0.0] for s in vehicle.pairs]).T
        lean = np.array([[0.0, 0.0, -s.sigma_gimbal_y_1pm] for s in vehicle.pairs]).T
        angle = turn @ state.eta_m + lean @ state.xi_m
        angle_rate = turn @ state.etadot_mps + lean @ state.xidot_mps
        moved = moved + np.cross(angle, delta)
        moved_rate = moved_rate + np.cross(angle_rate, delta) + np.cross(angle, delta_dot)
        moved_rest = moved_rest + 2.0 * np.cross(angle_rate, delta_dot) + np.cross(angle, delta_ddot)
        n = len(vehicle.pairs)
        moved_partial = partial.copy()
        moved_partial[:, :n] -= _skew(delta) @ turn
        moved_partial[:, n : 2 * n] -= _skew(delta) @ lean
    return [
        _Particle(-engine.mass_kg, locked, rate, np.zeros(3), partial),
        _Particle(engine.mass_kg, moved, moved_rate, moved_rest, moved_partial),
    ]
