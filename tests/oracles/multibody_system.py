"""Define the multibody system of the oracles: parameters, state and loads, without equations of motion.

Core (rigid and bending), spherical pendulums and a gimballed engine; every parameter is frozen in time. Axes: B is x
forward, y right, z down with its origin at C0, the CG of the core with the engine locked straight and without the
sloshing masses. `C_IB` turns B components into I components.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


def _zeros(*shape: int) -> Floats:
    return np.zeros(shape)


@dataclass(frozen=True)
class ModePair:
    """A pitch-plane mode (z, coordinate eta) and its yaw-plane partner (y, coordinate xi).

    Masses in kg, frequencies in rad/s, damping ratios; shape and slope d(phi)/d(x_n) (x_n aft) at the gimbal.
    """

    mass_z_kg: float
    mass_y_kg: float
    omega_z_radps: float
    omega_y_radps: float
    zeta_z: float = 0.0
    zeta_y: float = 0.0
    phi_gimbal_z: float = 0.0
    phi_gimbal_y: float = 0.0
    sigma_gimbal_z_1pm: float = 0.0
    sigma_gimbal_y_1pm: float = 0.0


@dataclass(frozen=True)
class Pendulum:
    """A point bob on a massless rod whose hinge moves with the core and the modes.

    `damping_1ps` c: force on the bob = -c * mass * (velocity relative to the coincident core point). `phi_z`, `phi_y`:
    shape of every mode pair at the hinge, shape (n_pairs,).
    """

    mass_kg: float
    length_m: float
    hinge_B_m: Floats
    damping_1ps: float = 0.0
    phi_z: Floats = field(default_factory=lambda: _zeros(0))
    phi_y: Floats = field(default_factory=lambda: _zeros(0))


@dataclass(frozen=True)
class Engine:
    """A gimballed engine with isotropic inertia about its own CG, which is `length_m` behind the gimbal."""

    mass_kg: float
    inertia_kgm2: float
    length_m: float
    gimbal_B_m: Floats


@dataclass(frozen=True)
class Vehicle:
    """A vehicle. The mass and inertia of the core include the engine locked straight and exclude the pendulums."""

    mass_kg: float
    inertia_B_kgm2: Floats
    engine: Engine | None = None
    pairs: tuple[ModePair, ...] = ()
    pendulums: tuple[Pendulum, ...] = ()


@dataclass(frozen=True)
class State:
    """A state in the simulator's quantities. Pendulum arrays have shape (n_pendulums, 3); deflections are (pitch, yaw).

    `u_B`: unit vectors from hinge to bob; `udot_B_1ps`: rates of their B components (relative to the body).
    """

    C_IB: Floats = field(default_factory=lambda: np.eye(3))
    w_BI_B_radps: Floats = field(default_factory=lambda: _zeros(3))
    r_I_m: Floats = field(default_factory=lambda: _zeros(3))
    v_I_mps: Floats = field(default_factory=lambda: _zeros(3))
    eta_m: Floats = field(default_factory=lambda: _zeros(0))
    etadot_mps: Floats = field(default_factory=lambda: _zeros(0))
    xi_m: Floats = field(default_factory=lambda: _zeros(0))
    xidot_mps: Floats = field(default_factory=lambda: _zeros(0))
    u_B: Floats = field(default_factory=lambda: _zeros(0, 3))
    udot_B_1ps: Floats = field(default_factory=lambda: _zeros(0, 3))
    deflection_rad: Floats = field(default_factory=lambda: _zeros(2))
    deflection_radps: Floats = field(default_factory=lambda: _zeros(2))
    deflection_radps2: Floats = field(default_factory=lambda: _zeros(2))


@dataclass(frozen=True)
class Load:
    """A load: force at C0, moment, generalised force on every mode, and uniform gravitation on all masses.

    The modal forces do work on etadot and xidot at fixed body rates. The caller must add to `moment_B_Nm` the roll
    moment about C0 of a force on a displaced station.
    """

    force_B_N: Floats = field(default_factory=lambda: _zeros(3))
    moment_B_Nm: Floats = field(default_factory=lambda: _zeros(3))
    modal_z_N: Floats | None = None
    modal_y_N: Floats | None = None
    gravitation_I_mps2: Floats = field(default_factory=lambda: _zeros(3))


def rotation_from_quaternion(q_BI: Floats) -> Floats:
    """Return C_IB (3, 3) of the scalar-first quaternion from B to I, of any norm except zero."""
    w, x, y, z = np.asarray(q_BI) / np.linalg.norm(q_BI)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def quaternion_from_rotation(C_IB: Floats) -> Floats:
    """Return the scalar-first q_BI (4,) of a proper rotation, by the eigenvector of Bar-Itzhack's symmetric matrix."""
    c = np.asarray(C_IB)
    k = np.array(
        [
            [c[0, 0] + c[1, 1] + c[2, 2], c[2, 1] - c[1, 2], c[0, 2] - c[2, 0], c[1, 0] - c[0, 1]],
            [0.0, c[0, 0] - c[1, 1] - c[2, 2], c[0, 1] + c[1, 0], c[0, 2] + c[2, 0]],
            [0.0, 0.0, c[1, 1] - c[0, 0] - c[2, 2], c[1, 2] + c[2, 1]],
            [0.0, 0.0, 0.0, c[2, 2] - c[0, 0] - c[1, 1]],
        ]
    )
    vectors = np.linalg.eigh(k, UPLO="U")[1]
    q: Floats = vectors[:, -1]
    return q if q[0] >= 0.0 else -q


def rotation_taking(a: Floats, b: Floats) -> Floats:
    """Return a rotation (3, 3) that takes the direction of a into that of b, also for opposite directions."""
    a, b = np.asarray(a) / np.linalg.norm(a), np.asarray(b) / np.linalg.norm(b)
    # One helper axis, far from both, completes a right-handed frame on each of them.
    helper = np.eye(3)[np.argmin(np.abs(a) + np.abs(b))]

    def frame(first: Floats) -> Floats:
        second = helper - first * (first @ helper)
        second /= np.linalg.norm(second)
        return np.column_stack((first, second, np.cross(first, second)))

    rotation: Floats = frame(b) @ frame(a).T
    return rotation


def thrust_direction(pitch_rad: float, yaw_rad: float) -> Floats:
    """Return the thrust direction d (3,) in B as docs/model.md defines it: positive angles make positive moments."""
    return np.array([np.cos(pitch_rad) * np.cos(yaw_rad), -np.sin(yaw_rad), np.sin(pitch_rad) * np.cos(yaw_rad)])
