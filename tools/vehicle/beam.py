"""The free-free bending modes of a stack, from Euler-Bernoulli elements with cubic (Hermite) shape functions.

The locked engines are a rigid mass behind the last node, and the sloshing masses are removed.

Shear, the rotary inertia of the sections, and the compliance of joints beyond EI are neglected. Shapes are 1 at the
gimbal; the slope is d(phi)/d(station). Source: Przemieniecki, Theory of Matrix Structural Analysis, sections 5.6 and
11.5.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import eigh

from maxq.control.kernel.records import Array
from maxq.tools.vehicle.masses import Rod, Stack, line_density_kgpm

ELEMENTS = 120
_LEAST_SHARE = 1e-4  # share of the mean mass per length: an element without mass would make the mass matrix singular


@dataclass(frozen=True)
class BeamMode:
    """A bending mode: frequency, generalised mass, and shape `phi` with its slope (1/m) at stations (m aft of the
    nose).
    """

    station_m: Array
    frequency_hz: float
    generalized_mass_kg: float
    phi: Array
    slope_pm: Array


@dataclass(frozen=True)
class RigidLoad:
    """The masses of a rigid booster that is clamped at one station of the beam or attached at two stations."""

    attachments_m: tuple[float, ...]
    rods: Sequence[Rod]


@dataclass(frozen=True)
class Beam:
    """The structure of a stack: equally spaced nodes, and the bending stiffness of the elements between them."""

    nodes_m: Array
    stiffness_Nm2: Array

    @staticmethod
    def of(stack: Stack) -> Beam:
        """Return the beam from the nose to the gimbal of the burning engines."""
        nodes = np.linspace(0.0, stack.tail_m, ELEMENTS + 1)
        middles, stiffness = 0.5 * (nodes[1:] + nodes[:-1]), np.zeros(ELEMENTS)
        for stage in reversed(stack.layout.stage[stack.number :]):
            for s in stage.shell:
                for k in np.flatnonzero((middles >= s.front_station_m) & (middles <= s.rear_station_m)):
                    stiffness[k] = s.stiffness_Nm2(float(middles[k]), 0.5 * stage.diameter_m)
        return Beam(nodes, stiffness)

    def modes(
        self, rods: Sequence[Rod], count: int, carried: Sequence[RigidLoad] = (), *, clamped: bool = False
    ) -> list[BeamMode]:
        """Return the first `count` bending modes of the beam with the masses `rods` and the rigid boosters `carried`.

        Shapes are scaled to 1 at the gimbal. If `clamped`, the aft end is fixed, as on the pad, and the shapes are 1 at
        the nose.
        """
        density, behind = line_density_kgpm(rods, self.nodes_m)
        k, m = self._matrices(np.maximum(density, _LEAST_SHARE * density.mean()))
        m[-2:, -2:] += np.array([[behind[0], behind[1]], [behind[1], behind[2]]])
        for each in carried:
            m += self._mass_of(each)
        free, first = (slice(0, -2), 0) if clamped else (slice(None), 2)  # 0 and 1 of a free body are its rigid modes
        squares, vectors = eigh(k[free, free], m[free, free], subset_by_index=[first, first + count - 1])
        out = []
        for square, vector in zip(squares, vectors.T, strict=True):
            whole = np.append(vector, [0.0, 0.0]) if clamped else vector
            shape = whole / whole[0 if clamped else -2]
            hz = math.sqrt(square) / (2.0 * math.pi)
            out.append(BeamMode(self.nodes_m, hz, float(shape @ m @ shape), shape[::2], shape[1::2]))
        return out

    def _matrices(self, density_kgpm: Array) -> tuple[Array, Array]:
        """Return the stiffness and consistent mass matrices for the displacement and slope of each node,
        alternating.
        """
        h = float(self.nodes_m[1] - self.nodes_m[0])
        k_unit = (
            np.array(
                [
                    [12, 6 * h, -12, 6 * h],
                    [6 * h, 4 * h * h, -6 * h, 2 * h * h],
                    [-12, -6 * h, 12, -6 * h],
                    [6 * h, 2 * h * h, -6 * h, 4 * h * h],
                ]
            )
            / h**3
        )
        m_unit = (
            np.array(
                [
                    [156, 22 * h, 54, -13 * h],
                    [22 * h, 4 * h * h, 13 * h, -3 * h * h],
                    [54, 13 * h, 156, -22 * h],
                    [-13 * h, -3 * h * h, -22 * h, 4 * h * h],
                ]
            )
            * h
            / 420.0
        )
        size = 2 * len(self.nodes_m)
        k, m = np.zeros((size, size)), np.zeros((size, size))
        for e in range(len(density_kgpm)):
            span = slice(2 * e, 2 * e + 4)
            k[span, span] += self.stiffness_Nm2[e] * k_unit
            m[span, span] += density_kgpm[e] * m_unit
        return k, m

    def mass_forward_kg(self, rods: Sequence[Rod], carried: Sequence[RigidLoad] = ()) -> Array:
        """Return the mass ahead of each node. Its product with the axial acceleration is the compression at the node.

        The first attachment of a booster carries its axial load.
        """
        density, _ = line_density_kgpm(rods, self.nodes_m)
        forward = np.concatenate([[0.0], np.cumsum(density * np.diff(self.nodes_m))])
        for each in carried:
            forward += sum(rod.mass_kg for rod in each.rods) * (self.nodes_m >= each.attachments_m[0])
        return forward

    def _mass_of(self, carried: RigidLoad) -> Array:
        """Return the mass matrix of a rigid booster that moves with its attachments."""
        first, last = carried.attachments_m[0], carried.attachments_m[-1]
        moved, turned = self._field(first)
        if first != last:
            turned = (self._field(last)[0] - moved) / (last - first)
        mass = sum(rod.mass_kg for rod in carried.rods)
        moment = sum(rod.mass_kg * (rod.station_m - first) for rod in carried.rods)
        inertia = sum(rod.inertia_kgm2 + rod.mass_kg * (rod.station_m - first) ** 2 for rod in carried.rods)
        both = np.outer(moved, turned)
        return np.asarray(mass * np.outer(moved, moved) + moment * (both + both.T) + inertia * np.outer(turned, turned))

    def _field(self, station_m: float) -> tuple[Array, Array]:
        """Return the displacement and slope at a station per unit of each degree of freedom of the nodes."""
        h = float(self.nodes_m[1] - self.nodes_m[0])
        k = min(max(int(station_m / h), 0), len(self.nodes_m) - 2)
        x = (station_m - float(self.nodes_m[k])) / h
        value, slope = np.zeros((2, 2 * len(self.nodes_m)))
        at = slice(2 * k, 2 * k + 4)
        value[at] = [
            1.0 - 3.0 * x**2 + 2.0 * x**3,
            h * (x - 2.0 * x**2 + x**3),
            3.0 * x**2 - 2.0 * x**3,
            h * (x**3 - x**2),
        ]
        slope[at] = [6.0 * (x**2 - x) / h, 1.0 - 4.0 * x + 3.0 * x**2, 6.0 * (x - x**2) / h, 3.0 * x**2 - 2.0 * x]
        return value, slope
