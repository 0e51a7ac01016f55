"""The gain schedules as a vector of variables: ln k_p and ln k_d at gain nodes, linear in between (paper, eq. 51)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from maxq.control.kernel.records import Array


def interpolation_weights(at_s: Array, nodes_s: Array) -> Array:
    """(times, nodes): what linear interpolation, held outside, makes of the values at the nodes."""
    return np.column_stack([np.interp(at_s, nodes_s, row) for row in np.eye(len(nodes_s))])


@dataclass(frozen=True)
class GainVariables:
    """`weights` (plants, nodes) give the gains of each plant. With `fixed` (2, nodes) gains there is no variable."""

    nodes_s: Array
    weights: Array
    fixed: Array | None = None

    @property
    def size(self) -> int:
        return 0 if self.fixed is not None else 2 * len(self.nodes_s)

    @property
    def names(self) -> tuple[str, ...]:
        if self.fixed is not None:
            return ()
        return tuple(f"{key} at {t:g} s" for key in ("k_p", "k_d_s") for t in self.nodes_s)

    def at_nodes(self, u: Array) -> Array:
        """(2, nodes): k_p and k_d_s of the schedule."""
        return self.fixed if self.fixed is not None else np.exp(u.reshape(2, -1))

    def at_plants(self, u: Array) -> tuple[Array, Array]:
        """k_p and k_d_s, (plants,) each."""
        k_p, k_d = self.at_nodes(u) @ self.weights.T
        return k_p, k_d

    def log_gradients(self, u: Array) -> tuple[Array, Array]:
        """d ln k_p / d u and d ln k_d / d u, (plants, size) each."""
        n = len(self.nodes_s)
        by_p, by_d = np.zeros((len(self.weights), self.size)), np.zeros((len(self.weights), self.size))
        if self.size > 0:
            values = self.at_nodes(u)
            part = self.weights[None] * values[:, None, :]
            part /= part.sum(axis=2, keepdims=True)
            by_p[:, :n], by_d[:, n:] = part
        return by_p, by_d
