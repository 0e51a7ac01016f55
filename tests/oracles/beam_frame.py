"""A free-free beam of finite elements as an oracle of section loads: no modes, no summation of forces.

Euler-Bernoulli elements with cubic shapes, consistent mass, and geometric stiffness of a given axial force. Its section
moments and shears are the nodal forces of its *stiffness*: EI w'' of the shape functions in the nodes' own terms.

Frame: station x aft of the nose, deflection w and rotation w' = dw/dx at every node, a force along +w. Section loads
are those of the part forward of the node: shear along +w; moment positive where it turns the nose towards -w (with w
along body z: about +y), which is -EI w''.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import eigh

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Beam:
    """Nodes `x` (n + 1,) with points of mass; bending stiffness, mass per length and tension of the elements (n,)."""

    x: Array
    stiffness_Nm2: Array
    density_kgpm: Array
    point_kg: Array
    axial_N: Array

    def matrices(self) -> tuple[Array, Array]:
        """Return the stiffness (with that of the axial force) and mass, over (w, w') of every node."""
        size = 2 * len(self.x)
        k, m = np.zeros((size, size)), np.zeros((size, size))
        for e in range(len(self.x) - 1):
            span = slice(2 * e, 2 * e + 4)
            k[span, span] += self._element(e)
            h = self.x[e + 1] - self.x[e]
            m[span, span] += self.density_kgpm[e] * h / 420.0 * np.array(
                [[156, 22 * h, 54, -13 * h], [22 * h, 4 * h * h, 13 * h, -3 * h * h],
                 [54, 13 * h, 156, -22 * h], [-13 * h, -3 * h * h, -22 * h, 4 * h * h]]
            )  # fmt: skip  # a matrix
        m[range(0, size, 2), range(0, size, 2)] += self.point_kg
        return k, m

    def _element(self, e: int) -> Array:
        h = self.x[e + 1] - self.x[e]
        bending = self.stiffness_Nm2[e] / h**3 * np.array(
            [[12, 6 * h, -12, 6 * h], [6 * h, 4 * h * h, -6 * h, 2 * h * h],
             [-12, -6 * h, 12, -6 * h], [6 * h, 2 * h * h, -6 * h, 4 * h * h]]
        )  # fmt: skip  # a matrix
        geometric = self.axial_N[e] / (30.0 * h) * np.array(
            [[36, 3 * h, -36, 3 * h], [3 * h, 4 * h * h, -3 * h, -h * h],
             [-36, -3 * h, 36, -3 * h], [3 * h, -h * h, -3 * h, 4 * h * h]]
        )  # fmt: skip  # a matrix
        return bending + geometric

    def modes(self, count: int) -> tuple[Array, Array, Array, Array]:
        """Frequencies (rad/s), generalised masses, phi and slope (count, nodes); no axial force, 1 at the tail."""
        free = Beam(self.x, self.stiffness_Nm2, self.density_kgpm, self.point_kg, np.zeros_like(self.axial_N))
        k, m = free.matrices()
        squares, shapes = eigh(k, m, subset_by_index=[2, 1 + count])
        shapes = shapes / shapes[-2]
        return np.sqrt(squares), np.einsum("im,ij,jm->m", shapes, m, shapes), shapes[0::2].T, shapes[1::2].T

    def harmonic(self, force_N: Array, omega_radps: float) -> Array:
        """Amplitude (w, w' of every node) under nodal forces (n + 1,) at a frequency; 0 < omega, no damping."""
        k, m = self.matrices()
        load = np.zeros(len(k))
        load[0::2] = force_N
        return np.asarray(np.linalg.solve(k - omega_radps**2 * m, load))

    def in_free_fall(self, force_N: Array) -> Array:
        """Return the deflection under constant nodal forces in the frame that accelerates with the beam.

        The force's rigid accelerations are taken off (inertia relief); of the rigid motions, which are arbitrary, the
        answer has none in the mean over the mass.
        """
        k, m = self.matrices()
        load = np.zeros(len(k))
        load[0::2] = force_N
        rigid = np.zeros((len(k), 2))
        rigid[0::2, 0], rigid[0::2, 1], rigid[1::2, 1] = 1.0, self.x, 1.0
        of_rigid = m @ rigid
        bordered = np.block([[k, of_rigid], [of_rigid.T, np.zeros((2, 2))]])
        return np.asarray(np.linalg.solve(bordered, np.concatenate([load, np.zeros(2)]))[: len(k)])

    def moment_Nm(self, motion: Array) -> Array:
        """Return the section moment (n + 1,) of the bending stiffness alone: the mean of both elements at a node."""
        ends: list[list[float]] = [[] for _ in self.x]
        for e in range(len(self.x) - 1):
            h = self.x[e + 1] - self.x[e]
            w_0, s_0, w_1, s_1 = motion[2 * e : 2 * e + 4]
            ends[e].append(-self.stiffness_Nm2[e] * (6 * (w_1 - w_0) / h**2 - (4 * s_0 + 2 * s_1) / h))
            ends[e + 1].append(-self.stiffness_Nm2[e] * (-6 * (w_1 - w_0) / h**2 + (2 * s_0 + 4 * s_1) / h))
        return np.array([np.mean(end) for end in ends])
