"""The largest simultaneous deviation of all named parameters for which the loop is stable, as a lower bound.

The search for the worst vehicle (worst.py) finds individual vehicles. This module computes the deviation up to which no
vehicle is unstable, by the structured singular value over the deviations v, each a real number:

    L(f, v) = C(f) P(f, v),      [x' y] = ([A B, C D] + sum_k v_k dP_k) [x p],

dP_k is half the difference of actuator, vehicle and gyro between both ends of a deviation, scaled to the size of the
change to the farther end. The delay is a factor 1 - j v sin(2 pi f t). P is the linear model of one plane. For pitch,
yaw and roll together, it is the linearised simulator (design/loop/multiloop.py) of the scenario with the deviation. The
law and the effects of sampling are those at f without deviations.

The result is thus exact to first order in each deviation. It does not include the interaction of two deviations,
nonlinear changes between the ends, and the response between the evaluated frequencies. Correlated deviations change
together. Aliases are those without deviations, so that the bound does not apply to a mode above the Nyquist frequency.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.linalg
from threadpoolctl import threadpool_limits

from maxq.control.kernel.records import Array, duplicate
from maxq.design.laws.law import MEASUREMENTS, Controller
from maxq.design.loop.fixed_path import fixed_path
from maxq.design.loop.loop import Loop, law_at
from maxq.design.loop.multiloop import Multiloop, multiloop
from maxq.design.margins.real_mu import Scaling, real_mu_upper
from maxq.design.model.deviations import Deviations, deviations_of
from maxq.design.model.node import Node, disperse, with_drives_apart
from maxq.design.model.powered import flown_run, flown_to
from maxq.design.model.state_space import ComplexArray
from maxq.sim.campaign.read import LoadedCampaign
from maxq.sim.packing.flight import Packed, pack_flight
from maxq.sim.scenario.loader import LoadedScenario
from maxq.sim.scenario.schema_design import Design
from maxq.sim.vehicle.state import state_size

_RANK, _RANK_TOGETHER = 1e-7, 1e-5  # smallest relative change that counts; differences of the simulator contain noise
_GRID, _LOWEST_HZ = 60, 0.01
_WIDTHS, _LIGHT, _SAME = np.array([-4.0, -2.0, -1.0, -0.5, 0.0, 0.5, 1.0, 2.0, 4.0]), 0.5, 1e-6
_HALVINGS = 6  # of the intervals on both sides of the largest value


@dataclass(frozen=True)
class Uncertain:
    """The deviating system [A B, C D] (n + axes, n + axes), balanced, and its change by 1 of each deviation.

    `late_s` are the changes of delay (s) by 1. `farther` (deviations,) is the ratio, at least 1, of the change to the
    farther end to that change.
    """

    whole: Array
    changes: tuple[Array, ...]
    late_s: Array
    farther: Array
    axes: int = 1
    rank: float = _RANK

    @property
    def blocks(self) -> tuple[Array, Array, Array, Array]:
        """Return the blocks A, B, C and D."""
        n = len(self.whole) - self.axes
        return self.whole[:n, :n], self.whole[:n, n:], self.whole[n:, :n], self.whole[n:, n:]

    def response(self, hz: float) -> ComplexArray:
        """Return the response of P without deviations, (axes, axes)."""
        a, b, c, d = self.blocks
        return np.asarray(c @ np.linalg.solve(2j * np.pi * hz * np.eye(len(a)) - a, b) + d)

    @cached_property
    def _factors(self) -> list[tuple[Array, Array]]:
        """Return the low-rank factors of each change: rows of the equations, and columns of states and commands."""
        out = []
        for change in self.changes:
            u, size, v = np.linalg.svd(change)
            rank = int(np.count_nonzero(size > self.rank * max(size[0], 1e-300))) if size[0] > 0.0 else 0
            out.append((u[:, :rank] * np.sqrt(size[:rank]), v[:rank].T * np.sqrt(size[:rank])))
        return out

    def matrix(self, hz: float, back: ComplexArray) -> tuple[ComplexArray, list[int]]:
        """Return M from the outputs of the deviations to their inputs, and the rank of each deviation.

        The loop is closed by p = -back y.
        """
        m, s = self.axes, 2j * np.pi * hz
        n, back = len(self.whole) - m, np.reshape(back, (m, m))
        left, right, ranks, direct = [], [], [], list[complex]()
        for (u, v), late_s in zip(self._factors, self.late_s, strict=True):
            left.append(u)
            right.append(v)
            direct += [0.0] * u.shape[1]
            if late_s:  # a delay acts on the commands: p = -back y + w
                left.append(np.zeros((n + m, m)))
                right.append(np.zeros((n + m, m)))
                direct += [-1j * math.sin(2.0 * np.pi * hz * late_s)] * m
            ranks.append(u.shape[1] + (m if late_s else 0))
        into, out = np.concatenate(left, axis=1), np.concatenate(right, axis=1).astype(np.complex128)
        late = np.array(direct) != 0.0
        # unknowns x and p: s x = A x + B p + U_x w,  p = -back (C x + D p + U_y w) + w_late
        a, b, c, d = self.blocks
        closed = np.block([[s * np.eye(n) - a, -b], [back @ c, np.eye(m) + back @ d]])
        driven = np.concatenate([into[:n], -back @ into[n:]])
        for k, column in enumerate(np.flatnonzero(late)):
            driven[n + k % m, column] += 1.0
            out[n + k % m, column] = direct[column]
        taken = out.T @ np.linalg.solve(closed, driven)
        taken[late] -= np.diag(np.array(direct))[late]
        return taken, ranks


def uncertain(node: Node, campaign: LoadedCampaign) -> Uncertain:
    """Return the plant of an operating point about the middle of its deviations.

    Scores of -1 and 1 correspond to 3 sigma.
    """
    deviations, node = deviations_of(campaign, node), with_drives_apart(node)

    def whole(u: Array) -> Array:
        path = fixed_path(disperse(node, deviations.at(u))).continuous
        return np.block([[path.a, path.b], [path.c[:1], path.d[:1]]])

    return _balanced(whole, deviations, 1, _RANK)


def uncertain_together(
    flown: Packed, base: LoadedScenario, design: Design, node: Node, campaign: LoadedCampaign
) -> Uncertain:
    """Return the plant of pitch, yaw and roll together about the middle of its deviations.

    Each deviation is applied to the scenario and evaluated at `flown`. Raises ValueError if a deviated vehicle has
    other states, as for different engines of a group on TVC loads.
    """
    deviations = deviations_of(campaign, node)

    def whole(u: Array) -> Array:
        there = flown_as(deviations, base, flown, node.stage, u)
        plant = multiloop(there, design, node.time_s).plant
        assert plant is not None
        n = plant.b.shape[1]
        return np.block([[plant.a, plant.b], [plant.c[:n], plant.d[:n]]])

    axes = len(multiloop(flown, design, node.time_s).axes)
    return _balanced(whole, deviations, axes, _RANK_TOGETHER)


def flown_as(deviations: Deviations, base: LoadedScenario, flown: Packed, stage: int, u: Array) -> Packed:
    """Return the packed flight `flown` with the vehicle of scores `u`, at the same state and time.

    Raises ValueError if that vehicle has other states.
    """
    packed = pack_flight(deviations.scenario(base, u).scenario)
    parameters = duplicate(packed.parameters)
    parameters["timeline"] = flown.parameters["timeline"]
    mine, other = (int(state_size(p[stage].vehicle.sizes)) for p in (parameters, flown.parameters))
    if mine != other:
        raise ValueError(f"{mine} states of a deviated vehicle: allowed are as many as of the nominal, {other}")
    return dataclasses.replace(flown, parameters=parameters, pool=packed.pool)


def _balanced(whole: Callable[[Array], Array], deviations: Deviations, axes: int, rank: float) -> Uncertain:
    units = np.eye(len(deviations.places))
    middle = whole(np.zeros(len(units)))
    ends = np.array([[whole(unit) - middle, middle - whole(-unit)] for unit in units])
    changes = 0.5 * ends.sum(axis=1)
    sizes = np.abs(middle) + np.abs(changes).sum(axis=0)
    scale = scipy.linalg.matrix_balance(sizes, permute=False, separate=True)[1][0]
    scale[-axes:] = 1.0
    changes, ends = changes / scale[:, None] * scale, ends / scale[:, None] * scale
    size = np.linalg.norm(changes, axis=(1, 2))
    late_s = np.array([0.5 * (deviations.at(unit).delay_s - deviations.at(-unit).delay_s) for unit in units])
    farther = np.linalg.norm(ends, axis=(2, 3)).max(axis=1) / np.where(size > 0.0, size, 1.0)
    return Uncertain(middle / scale[:, None] * scale, tuple(changes), late_s, np.maximum(farther, 1.0), axes, rank)


@dataclass(frozen=True)
class Within:
    """The bound `sigmas` of each deviation up to which no vehicle is unstable.

    It follows from mu at `tried` frequencies, with the largest value at `at_hz`.
    """

    sigmas: float
    at_hz: float
    tried: int


def stable_within(node: Node, design: Design, campaign: LoadedCampaign) -> Within | None:
    """Return the bound of the deviations at an operating point, or None for a law with further inputs.

    A law is supported if its only sensor is the first gyro.
    """
    return stable_with(node, law_at(design, node), campaign)


def stable_with(node: Node, law: Controller, campaign: LoadedCampaign) -> Within | None:
    """Return the bound of the deviations at an operating point with a given law, as `stable_within` does."""
    if any(name not in MEASUREMENTS for name in law.inputs):
        return None
    deviations = deviations_of(campaign, node)
    loop = Loop(fixed_path(disperse(node, deviations.at(np.zeros(len(deviations.places))))), law)
    return _within(uncertain(node, campaign), loop, loop.closed_poles())


def stable_together(base: LoadedScenario, design: Design, node: Node, campaign: LoadedCampaign) -> Within | None:
    """Return the bound of the deviations at an operating point with coupled loops of pitch, yaw and roll.

    The coupling is that of the simulator. Returns None for a law with inputs other than the first gyro, and if engines
    of a group are on TVC loads.
    """
    law, run = law_at(design, node), flown_run(base, faults=False)
    if any(name not in MEASUREMENTS for name in law.inputs):
        return None
    flown_to(run, node.time_s)
    deviations = deviations_of(campaign, node)
    try:
        middle = flown_as(deviations, base, run.packed, node.stage, np.zeros(len(deviations.places)))
        every = uncertain_together(run.packed, base, design, node, campaign)
    except ValueError:
        return None
    loop = multiloop(middle, design, node.time_s)
    return _within(every, loop, loop.poles(range(len(loop.axes))))


def _within(every: Uncertain, loop: Loop | Multiloop, closed_poles: ComplexArray) -> Within:
    scaling, values = dict[float, Scaling](), dict[float, float]()

    def bound(hz: float, enough: float) -> None:
        back = np.reshape(loop.response(np.array([hz])), (every.axes, every.axes)) @ np.linalg.inv(every.response(hz))
        m, ranks = every.matrix(hz, back)
        near = min(scaling, key=lambda f: abs(f - hz), default=None)
        m = m * np.repeat(every.farther, ranks)
        values[hz], scaling[hz] = real_mu_upper(m, ranks, None if near is None else scaling[near], enough)

    with threadpool_limits(1, "blas"):  # threads are slower for small matrices
        for hz in _frequencies(closed_poles, loop.highest_hz):
            bound(hz, max(values.values(), default=0.0))
        for _ in range(_HALVINGS):
            tried = sorted(values)
            k = tried.index(max(values, key=lambda f: values[f]))
            for near in {max(k - 1, 0), min(k + 1, len(tried) - 1)} - {k}:
                bound(0.5 * (tried[k] + tried[near]), max(values.values()))
    peak = max(values, key=lambda f: values[f])
    return Within(3.0 / values[peak], peak, len(values))


def _frequencies(closed_poles: ComplexArray, highest_hz: float) -> list[float]:
    """Return frequencies (Hz) over the whole range, and about oscillatory closed-loop poles.

    A loop near instability is so only in a narrow band.
    """
    swings = closed_poles[(closed_poles.imag > 0.0) & (np.abs(closed_poles.real) < _LIGHT * closed_poles.imag)]
    hz = [np.geomspace(_LOWEST_HZ, 0.999 * highest_hz, _GRID)]
    hz += [(p.imag + p.real * _WIDTHS) / (2.0 * np.pi) for p in swings]
    grid = np.unique(np.concatenate(hz))
    grid = grid[
        np.append(True, np.diff(grid) > _SAME * grid[1:])
    ]  # removes duplicates from similar poles of the planes
    return [float(f) for f in grid[(grid >= _LOWEST_HZ) & (grid < highest_hz)]]
