"""How far all named deviations may go at once before the loop of one plane is unstable: a bound from inside.

The search for the worst vehicle (worst.py) knows of vehicles; this says up to where none is unstable, by the structured
singular value over the deviations v, each a real number:

    L(f, v) = C(f) P(f, v),      [x' y] = ([A B, C D] + sum_k v_k dP_k) [x p],

dP_k being half the difference of actuator, vehicle and gyro at both ends of a deviation, as large as that to the
farther end, and the delay a factor 1 - j v sin(2 pi f t). The law with all that sampling adds is what it is at f
without deviations. So it is exact to first order in each deviation; what two of them do to each other, and how a
change turns between the ends, is not in it; nor is what happens between the frequencies that are tried. Deviations
that go together do so.
Aliases stay as they are without deviations: of a mode beyond the Nyquist frequency the bound says nothing.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import scipy.linalg
from threadpoolctl import threadpool_limits

from maxq.control.kernel.records import Array
from maxq.design import api
from maxq.design.laws.law import MEASUREMENTS
from maxq.design.loop.fixed_path import FixedPath, fixed_path
from maxq.design.loop.loop import Loop
from maxq.design.margins.real_mu import Scaling, real_mu_upper
from maxq.design.model.dispersion import disperse, with_drives_apart
from maxq.design.model.node import Node
from maxq.design.model.spread import Spread, places_of, root_of_correlation, vehicle_at_places
from maxq.design.model.state_space import ComplexArray
from maxq.sim.scenario.schema_design import Design

_RANK = 1e-7  # relative, of singular values that count
_GRID, _LOWEST_HZ = 60, 0.01
_WIDTHS = np.array([-4.0, -1.0, 0.0, 1.0, 4.0])
_AROUND = (1.0 + 0.02 * np.arange(-3, 4), 1.0 + 0.005 * np.arange(-3, 4))  # the largest, once and again


@dataclass(frozen=True)
class Uncertain:
    """What deviates in a plane, [A B, C D] (n + 1, n + 1) and its changes by 1 of each, balanced; delays (s) by 1.

    `farther` (deviations,): what a change to the farther end is to that change, at least 1.
    """

    whole: Array
    changes: tuple[Array, ...]
    late_s: Array
    farther: Array

    @property
    def blocks(self) -> tuple[Array, Array, Array, Array]:
        """A, B, C, D."""
        n = len(self.whole) - 1
        return self.whole[:n, :n], self.whole[:n, n:], self.whole[n:, :n], self.whole[n:, n:]

    def matrix(self, hz: float, back: complex) -> tuple[ComplexArray, list[int]]:
        """M from what the deviations put out to what they take up, where p = -back y, and their ranks."""
        n, s = len(self.whole) - 1, 2j * np.pi * hz
        left, right, ranks, direct = [], [], [], list[complex]()
        for change, late_s in zip(self.changes, self.late_s, strict=True):
            u, size, v = np.linalg.svd(change)
            rank = int(np.count_nonzero(size > _RANK * max(size[0], 1e-300))) if size[0] > 0.0 else 0
            root = np.sqrt(size[:rank])
            left.append(u[:, :rank] * root)
            right.append(v[:rank].T * root)
            direct += [0.0] * rank
            if late_s:  # acts on the command: p = -back y + w, taken up 1 - j sin of the command
                left.append(np.zeros((n + 1, 1)))
                right.append(np.zeros((n + 1, 1)))
                direct.append(-1j * math.sin(2.0 * np.pi * hz * late_s))
                rank += 1
            ranks.append(rank)
        into, out = np.concatenate(left, axis=1), np.concatenate(right, axis=1).astype(np.complex128)
        late = np.array(direct) != 0.0
        # of x and p: s x = A x + B p + U_x w,  p = -back (C x + D p + U_y w) + w_late
        a, b, c, d = self.blocks
        closed = np.block([[s * np.eye(n) - a, -b], [back * c, 1.0 + back * d]])
        driven = np.concatenate([into[:n], -back * into[n:] + late[None]])
        out[n, late] = np.array(direct)[late]
        m = out.T @ np.linalg.solve(closed, driven)
        m[late] -= np.diag(np.array(direct))[late]
        return m, ranks


def uncertain(node: Node, spread: Spread) -> Uncertain:
    """Of a node's deviations, each from -1 to 1 (three sigma) where they are independent."""
    places, node = places_of(node), with_drives_apart(node)
    root = root_of_correlation(spread, node, places)

    def whole(u: Array) -> Array:
        path = fixed_path(disperse(node, vehicle_at_places(spread, node, places, u))).continuous
        return np.block([[path.a, path.b], [path.c[:1], path.d[:1]]])

    middle = whole(np.zeros(len(places)))
    ends = np.array([[whole(root @ unit) - middle, middle - whole(-root @ unit)] for unit in np.eye(len(places))])
    changes = 0.5 * ends.sum(axis=1)
    sizes = np.abs(middle) + np.abs(changes).sum(axis=0)
    scale = scipy.linalg.matrix_balance(sizes, permute=False, separate=True)[1][0]
    scale[-1] = 1.0
    changes, ends = changes / scale[:, None] * scale, ends / scale[:, None] * scale
    size = np.linalg.norm(changes, axis=(1, 2))
    farther = np.linalg.norm(ends, axis=(2, 3)).max(axis=1) / np.where(size > 0.0, size, 1.0)
    late_s = spread.delay_s * root[[name for name, _ in places].index("delay_s")]
    return Uncertain(middle / scale[:, None] * scale, tuple(changes), late_s, np.maximum(farther, 1.0))


@dataclass(frozen=True)
class Within:
    """Up to `sigmas` each no vehicle is unstable, by mu at `tried` frequencies, the largest at `at_hz`."""

    sigmas: float
    at_hz: float
    tried: int


def stable_within(node: Node, design: Design, spread: Spread) -> Within | None:
    """Of the deviations at a node; None for a law that takes more than the gyro."""
    law = api.law_at(design, node)
    if any(name not in MEASUREMENTS for name in law.inputs):
        return None
    loop, every = Loop(fixed_path(node), law), uncertain(node, spread)
    scaling, values = dict[float, Scaling](), dict[float, float]()

    def bound(hz: float, enough: float) -> None:
        a, b, c, d = every.blocks
        path = (c @ np.linalg.solve(2j * np.pi * hz * np.eye(len(a)) - a, b) + d)[0, 0]
        m, ranks = every.matrix(hz, complex(loop.response(np.array([hz]))[0] / path))
        near = min(scaling, key=lambda f: abs(f - hz), default=None)
        m = m * np.repeat(every.farther, ranks)
        values[hz], scaling[hz] = real_mu_upper(m, ranks, None if near is None else scaling[near], enough)

    with threadpool_limits(1, "blas"):  # small matrices: threads wait for each other
        for hz in _frequencies(loop, loop.fixed):
            bound(hz, max(values.values(), default=0.0))
        for around in _AROUND:
            for hz in np.unique(max(values, key=lambda f: values[f]) * around):
                if hz < loop.highest_hz:
                    bound(float(hz), max(values.values()))
    peak = max(values, key=lambda f: values[f])
    return Within(3.0 / values[peak], peak, len(values))


def _frequencies(loop: Loop, path: FixedPath) -> list[float]:
    hz = [np.geomspace(_LOWEST_HZ, 0.999 * loop.highest_hz, _GRID)]
    hz += [r.frequency_hz + max(r.half_width_hz, 1e-3) * _WIDTHS for r in path.resonances()]
    grid = np.unique(np.concatenate(hz))
    return [float(f) for f in grid[(grid >= _LOWEST_HZ) & (grid < loop.highest_hz)]]
