"""Gain schedules as a vector of variables: the logarithm of each gain at the gain nodes (eq. 51).

The gains are linear between the nodes.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy  # its submodules are imported at first use

from maxq.control.kernel.records import Array

GAIN_BOUNDS = 1e-4, 1e3  # (49); the lower bound is positive because ln k is the variable


class UnsolvableError(ValueError):
    """A case without a solution. The message states the keys, the reason and the permitted values."""


def interpolation_weights(at: Array, nodes: Array) -> Array:
    """Return the weights (points, nodes) of linear interpolation between nodes, held constant outside the nodes."""
    return np.column_stack([np.interp(at, nodes, row) for row in np.eye(len(nodes))])


@dataclass(frozen=True)
class GainSchedules:
    """The schedules of the positive gains `keys`, on common nodes.

    `weights` (plants, nodes) interpolate the gains of each plant. If `fixed` (gains, nodes) is given, the gains are
    constant and there are no variables.
    """

    keys: tuple[str, ...]
    nodes: Array
    weights: Array
    fixed: Array | None = None
    unit: str = " s"

    @property
    def size(self) -> int:
        return 0 if self.fixed is not None else len(self.keys) * len(self.nodes)

    @property
    def names(self) -> tuple[str, ...]:
        if self.fixed is not None:
            return ()
        return tuple(f"{key} at {at:g}{self.unit}" for key in self.keys for at in self.nodes)

    def at_nodes(self, u: Array) -> Array:
        """Return the gains at the nodes, (gains, nodes)."""
        return self.fixed if self.fixed is not None else np.exp(u.reshape(len(self.keys), -1))

    def at_plants(self, u: Array) -> Array:
        """Return the gains at the plants, (gains, plants)."""
        return np.asarray(self.at_nodes(u) @ self.weights.T)

    def log_gradients(self, u: Array) -> Array:
        """Return the gradient d ln k / d u, (gains, plants, size)."""
        n = len(self.nodes)
        out = np.zeros((len(self.keys), len(self.weights), self.size))
        if self.size > 0:
            part = self.weights[None] * self.at_nodes(u)[:, None, :]
            part /= part.sum(axis=2, keepdims=True)
            for g in range(len(self.keys)):
                out[g, :, g * n : (g + 1) * n] = part[g]
        return out

    def log_curvature(self, u: Array, slopes: Array) -> Array:
        """Return the sum of d2 ln k / d u2 over gains and plants, weighted with `slopes` (gains, plants).

        The shape is (size, size). With ln k = ln(sum of weights times exp(u)), each second derivative is diag(share) -
        share share'.
        """
        out = np.zeros((self.size, self.size))
        for by, slope in zip(self.log_gradients(u), slopes, strict=True):
            out += np.diag(slope @ by) - (by.T * slope) @ by
        return out

    def from_nodes(self, nodes: Array, gains: Array) -> Array:
        """Return the variables interpolated from gains (gains, nodes) at other nodes; empty for fixed gains."""
        if self.size == 0:
            return np.zeros(0)
        return np.concatenate([np.log(np.interp(self.nodes, nodes, k)) for k in gains])


def lowest_above(weights: Array, floor: Array) -> Array:
    """Return the node values of the lowest schedule that is at least `floor` (plants,) at every plant.

    The sum over the plants is minimised. Raises UnsolvableError if no schedule within the gain bounds exists.
    """
    floor, cost = np.maximum(floor, GAIN_BOUNDS[0]), weights.sum(axis=0)
    found = None
    if np.isfinite(floor).all():  # infinite if an engine has no control authority
        found = scipy.optimize.linprog(cost, A_ub=-weights, b_ub=-floor, bounds=GAIN_BOUNDS, method="highs-ds")
    if found is None or found.x is None:
        raise UnsolvableError(
            f"rigid_hz, rigid_zeta: no schedule of gains up to {GAIN_BOUNDS[1]:g} is above {floor.max():.4g} at the "
            "operating point that needs most; allowed are limits, or operating points, that such gains can meet"
        )
    # above the limit by more than a rounding error
    return np.asarray(found.x) * (1.0 + 1e-12)
