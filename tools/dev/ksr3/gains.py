"""Smallest gains, linear in time, that give 0.5 Hz and 0.7 (the paper's eqs 35, 36) at every node."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import linprog

from maxq.control.kernel.records import Array
from maxq.tools.dev.ksr3 import assumptions as a


@dataclass(frozen=True)
class LinearGains:
    """Values at the first and the last node; the end values hold outside."""

    k_p: tuple[float, float]
    k_d_s: tuple[float, float]

    def at(self, t: float) -> tuple[float, float]:
        ends = (a.NODES_S[0], a.NODES_S[-1])
        return float(np.interp(t, ends, self.k_p)), float(np.interp(t, ends, self.k_d_s))


def least_gains(m_delta_ps2: Array) -> LinearGains:
    """From M_delta (11,) at the nodes. k_d suffices for 0.7 with the k_p in force, not just the least k_p."""
    omega = 2 * np.pi * a.RIGID_HZ
    k_p = _lowest_line_above(omega**2 / m_delta_ps2)
    k_p_nodes = np.interp(a.NODES_S, (a.NODES_S[0], a.NODES_S[-1]), k_p)
    k_d = _lowest_line_above(2 * a.RIGID_ZETA * np.sqrt(k_p_nodes / m_delta_ps2))
    return LinearGains(k_p, k_d)


def _lowest_line_above(floor: Array) -> tuple[float, float]:
    """The line over the nodes, least in sum, that is nowhere below `floor`; rounded up to 0.001."""
    late = (np.array(a.NODES_S) - a.NODES_S[0]) / (a.NODES_S[-1] - a.NODES_S[0])
    weights = np.column_stack([1 - late, late])
    solution = linprog(weights.sum(axis=0), A_ub=-weights, b_ub=-floor)
    if solution.x is None:
        raise RuntimeError(f"no line above the floor: {solution.message}")
    first, last = np.ceil(solution.x * 1000 - 1e-6) / 1000
    return float(first), float(last)
