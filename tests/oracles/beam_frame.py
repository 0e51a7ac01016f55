"""Model a free-free beam by finite elements, an oracle of section loads without modes or summed forces.

The Euler-Bernoulli elements have cubic shapes, consistent mass, and geometric stiffness of a given axial force. The
section moments and shears are the nodal forces of the *stiffness*, EI w'' of the shape functions.

Frame: station x aft of the nose, deflection w and rotation w' = dw/dx at every node, force along +w. Section loads act
on the part forward of the node: shear along +w; a positive moment turns the nose towards -w (about +y if w is along
body z) and equals -EI w''.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import eigh

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Beam:
    """A beam: nodes `x` (n + 1,) with point masses; bending stiffness, mass per length and tension of elements (n,)."""

    x: Array
    stiffness_Nm2: Array
    density_kgpm: Array
    point_kg: Array
    axial_N: Array

    def matrices(self) -> tuple[Array, Array]:
        """Return the stiffness (including that of the axial force) and mass matrices over (w, w') of every node."""
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
        """Return frequencies (rad/s), generalised masses, shapes and slopes (count, nodes), without axial force.

        Shapes are 1 at the tail.
        """
        free = Beam(self.x, self.stiffness_Nm2, self.density_kgpm, self.point_kg, np.zeros_like(self.axial_N))
        k, m = free.matrices()
        squares, shapes = eigh(k, m, subset_by_index=[2, 1 + count])
        shapes = shapes / shapes[-2]
        return np.sqrt(squares), np.einsum("im,ij,jm->m", shapes, m, shapes), shapes[0::2].T, shapes[1::2].T

    def harmonic(self, force_N: Array, omega_radps: float) -> Array:
        """Return the amplitude (w, w' of every node) under nodal forces (n + 1,) at a frequency above 0, undamped."""
        k, m = self.matrices()
        load = np.zeros(len(k))
        load[0::2] = force_N
        return np.asarray(np.linalg.solve(k - omega_radps**2 * m, load))

    def in_free_fall(self, force_N: Array) -> Array:
        """Return the deflection under constant nodal forces in the frame that accelerates with the beam.

        Inertia relief: the rigid-body accelerations due to the forces are subtracted. The result has no rigid-body
        motion in the mass-weighted mean.
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
        """Return the section moment (n + 1,) of the bending stiffness alone: at a node, the mean of both elements."""
        ends: list[list[float]] = [[] for _ in self.x]
        for e in range(len(self.x) - 1):
            h = self.x[e + 1] - self.x[e]
            w_0, s_0, w_1, s_1 = motion[2 * e : 2 * e + 4]
            ends[e].append(-self.stiffness_Nm2[e] * (6 * (w_1 - w_0) / h**2 - (4 * s_0 + 2 * s_1) / h))
            ends[e + 1].append(-self.stiffness_Nm2[e] * (-6 * (w_1 - w_0) / h**2 + (2 * s_0 + 4 * s_1) / h))
        return np.array([np.mean(end) for end in ends])
