"""Model a rolling vehicle with gimballed engines, bending modes and bobs as particles.

The model is a list of functions for the places of particles in inertial axes over generalised coordinates. Velocities
and Coriolis and centrifugal accelerations follow by differentiation, the equations of motion from d'Alembert's
principle, sum m J' (J q'' + J' q') = Q. No energy is defined, no quasi-velocity used, and no rotation linearised.

Core: particles on the x axis, which the modes displace, and particles that the modes do not move. An engine: its mass
where gimbal and bent section carry it, less the same mass at its locked position, because the core contains the locked
engine. An engine consists of six equal particles about its CG, of isotropic inertia. Its gimbal has two axes. The outer
one is -y of its section, the inner one turns the engine in yaw.

Coordinates: place of the CG (3), rotation vector (3), modes (n), pitch and yaw angle of each engine, y and z components
of each bob's unit vector. The rotation vector is zero at the present instant, so that its derivatives are w and w'.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Numbers = NDArray[np.complex128]

STENCIL = np.array([-1.0, 9.0, -45.0, 0.0, 45.0, -9.0, 1.0]) / 60.0  # first derivative, of the sixth order
SPACING_S = 0.02
TINY = 1e-30


@dataclass(frozen=True)
class PointEngine:
    """Six particles behind a gimbal at `section` of the axis, displaced from it by `offset_m` (y, z).

    `inertia_kgm2` is that about any axis through their CG.
    """

    mass_kg: float
    length_m: float
    section: int
    offset_m: tuple[float, float]
    inertia_kgm2: float = 0.0

    @property
    def particles_m(self) -> Floats:
        """Return the places (6, 3) of its particles behind the gimbal, at rest."""
        reach = np.sqrt(1.5 * self.inertia_kgm2 / self.mass_kg)
        return np.array([-self.length_m, 0.0, 0.0]) + reach * np.concatenate([np.eye(3), -np.eye(3)])


@dataclass(frozen=True)
class Bob:
    """A point mass on a massless rod behind a hinge at `section` of the axis."""

    mass_kg: float
    length_m: float
    section: int


@dataclass(frozen=True)
class Particles:
    """A vehicle at rest.

    `axis_kg`, `axis_m` (n,): particles of the axis; `shapes`, `slopes` (modes, n, 3): displacement and rotation there.
    `hull_kg` (k,), `hull_m` (k, 3): particles that the modes do not move.
    """

    axis_kg: Floats
    axis_m: Floats
    shapes: Floats
    slopes: Floats
    hull_kg: Floats
    hull_m: Floats
    engines: tuple[PointEngine, ...]
    bobs: tuple[Bob, ...]

    @property
    def size(self) -> int:
        return 6 + len(self.shapes) + 2 * len(self.engines) + 2 * len(self.bobs)

    @property
    def masses_kg(self) -> Floats:
        """Return the masses of the particles, in the order of `places`."""
        moved = [sign * engine.mass_kg / 6.0 for engine in self.engines for sign in [1.0] * 6 + [-1.0] * 6]
        return np.concatenate([self.axis_kg, self.hull_kg, moved, [bob.mass_kg for bob in self.bobs]])

    def places(self, q: Numbers) -> Numbers:
        """Return the places (particles, 3) in inertial axes at the coordinates q; complex numbers are allowed."""
        n = len(self.shapes)
        eta, at = q[6 : 6 + n], 6 + n
        axis = np.tensordot(eta, self.shapes, axes=1)
        axis[:, 0] = axis[:, 0] + self.axis_m
        out = [*axis, *self.hull_m.astype(complex)]
        for engine in self.engines:
            pitch, yaw = q[at : at + 2]
            at += 2
            mount = rotation(eta @ self.slopes[:, engine.section])
            (sp, cp), (sy, cy), no = (np.sin(pitch), np.cos(pitch)), (np.sin(yaw), np.cos(yaw)), 0.0 * pitch
            outer = np.array([[cp, no, -sp], [no, no + 1.0, no], [sp, no, cp]])
            turned = outer @ np.array([[cy, sy, no], [-sy, cy, no], [no, no, no + 1.0]])
            for turn in (turned, np.eye(3)):
                arms = np.array([0.0, *engine.offset_m]) + engine.particles_m @ turn.T
                out += [axis[engine.section] + mount @ arm for arm in arms]
        for bob in self.bobs:
            y, z = q[at : at + 2]
            at += 2
            out.append(axis[bob.section] + bob.length_m * np.array([-np.sqrt(1.0 - y * y - z * z), y, z]))
        return q[:3] + np.array(out) @ rotation(q[3:6]).T

    def velocities(self, q: Floats, rate: Floats) -> Floats:
        """Return the velocities (particles, 3) in inertial axes, by a complex step along the rates."""
        return np.asarray(self.places(q + 1j * TINY * rate).imag / TINY)

    def accelerations(self, q: Floats, rate: Floats, force: Floats, given: dict[int, float]) -> Floats:
        """Return the second derivatives of the coordinates under generalised forces (size,) and `given` ones."""
        mass = np.repeat(self.masses_kg, 3)
        jacobian = np.stack([self.velocities(q, unit).ravel() for unit in np.eye(self.size)], axis=1)
        steps = SPACING_S * np.arange(-3, 4)
        bias = sum(c * self.velocities(q + t * rate, rate) for c, t in zip(STENCIL, steps, strict=True)) / SPACING_S
        matrix = jacobian.T @ (mass[:, None] * jacobian)
        right = force - jacobian.T @ (mass * np.ravel(bias))
        free = [k for k in range(self.size) if k not in given]
        out = np.zeros(self.size)
        out[list(given)] = list(given.values())
        right = right - matrix @ out
        scale = 1.0 / np.sqrt(np.diag(matrix))[free]
        inner = matrix[np.ix_(free, free)] * np.outer(scale, scale)
        out[free] = scale * np.linalg.solve(inner, scale * right[free])
        return out


def rotation(vector: Numbers) -> Numbers:
    """Return the matrix of a rotation vector by its power series, for angles well below one, real or complex."""
    x, y, z = vector
    skew = np.array([[0.0 * x, -z, y], [z, 0.0 * x, -x], [-y, x, 0.0 * x]])
    out, term = np.eye(3, dtype=complex), np.eye(3, dtype=complex)
    for k in range(1, 15):
        term = term @ skew / k
        out = out + term
    return out


def jacobian_of(function: Callable[[Floats], Floats], size: int, amplitude: float) -> Floats:
    """Return the derivatives (values, size) of a function at zero by central differences."""
    return np.stack(
        [(function(amplitude * e) - function(-amplitude * e)) / (2.0 * amplitude) for e in np.eye(size)], axis=1
    )
