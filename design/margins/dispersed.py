"""The margins of many dispersed vehicles at one operating point.

The poles and residues of all vehicles are computed together, and the compiled functions of many.py evaluate the
margins.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy  # its submodules are imported at first use
from numpy.typing import NDArray

from maxq.control.kernel.records import Array, IntArray
from maxq.design.laws.law import MEASUREMENTS, Controller
from maxq.design.loop.fixed_path import SampledFixedPath, image_points, sampled_computer
from maxq.design.loop.loop import Loop
from maxq.design.loop.resonance import owner_of
from maxq.design.margins import many
from maxq.design.margins.packed import controller_factors
from maxq.design.model.dispersion import Dispersion, deviated, section_factors, stacked, unlike_drives
from maxq.design.model.instruments import DERIVATIVES, actuator_poles, lag, of_drive
from maxq.design.model.node import Node, with_drives_apart
from maxq.design.model.state_space import ComplexArray

_WORST_BASIS = 1e7  # condition number of the eigenvectors above which residues lose more than half their digits
LEVELS = 4  # levels of the extrapolation of each vehicle's derivatives
_AT_ONCE = 250  # vehicles per batch, so that their matrices fit into the processor's cache
_SAME = 1e-9  # relative tolerance of the law's response from its zeros and poles
_KINDS = {"bending": 1, "slosh": -1}


class NotServedError(ValueError):
    """A loop that the compiled margins do not support. `measure.margins` supports every loop."""


@dataclass(frozen=True)
class ManyLoops:
    """The sampled loops of dispersed vehicles at an operating point, with one law.

    The dispersed parameters are those of `spread.Spread`. Raises NotServedError for a law with sensors other than the
    first gyro, and for plants of the published equations.
    """

    node: Node
    law: Controller

    def __post_init__(self) -> None:
        node = self.node
        if any(name not in MEASUREMENTS for name in self.law.inputs):
            raise NotServedError("allowed are laws on the first gyro")
        if type(node) is not Node:
            raise NotServedError("allowed are the plants of the simulator")
        try:
            _ = self._controller
        except ValueError as error:
            raise NotServedError(str(error)) from None

    @cached_property
    def _nominal(self) -> Loop:
        return Loop(SampledFixedPath(self.node), self.law)

    @cached_property
    def _apart(self) -> ManyLoops:
        """Return the same loops for a vehicle with a separate drive for each group of engines."""
        node = with_drives_apart(self.node)
        return self if node is self.node else ManyLoops(node, self.law)

    @cached_property
    def _controller(self) -> tuple[ComplexArray, ComplexArray, float]:
        """Return the zeros, poles and gain of the law (`controller_factors`)."""
        loop = self._nominal
        return controller_factors(loop.law, self.node.instruments.sample_s, loop.controller)

    def measure(
        self, every: Sequence[Dispersion], peak_db: float, flight: Node | None = None, *, distances: bool = False
    ) -> tuple[NDArray[np.void], IntArray]:
        """Return the margins of vehicles, (vehicles,) of many.MEASURES, and the status of each, (vehicles,).

        If `distances` is True, only the distances are computed, and all other values are NaN. `flight` is the same
        operating point in another flight of the stage, with the same instruments.
        """
        values, status = np.zeros(len(every), many.MEASURES), np.zeros(len(every), np.int64)
        values.view(float)[:] = np.nan
        unlike = np.array([unlike_drives(by) for by in every], bool)
        if unlike.any() and self._apart is not self:
            there = with_drives_apart(flight or self.node)
            for loops, which, met in ((self._apart, unlike, there), (self, ~unlike, flight)):
                mine = [every[k] for k in np.flatnonzero(which).tolist()]
                values[which], status[which] = loops.measure(mine, peak_db, met, distances=distances)
            return values, status
        for first in range(0, len(every), _AT_ONCE):
            part = slice(first, first + _AT_ONCE)
            self._measure(stacked(every[part]), peak_db, flight or self.node, distances, values[part], status[part])
        return values, status

    def _measure(
        self, by: Dispersion, peak_db: float, node: Node, distances: bool, values: NDArray[np.void], status: IntArray
    ) -> None:
        period = self.node.instruments.sample_s
        delay = np.broadcast_to(np.maximum(node.instruments.delay_s + by.delay_s, 0.0), status.shape)
        poles, residues, owner, own_part, good = self._modes(node, by, delay)
        status[~good] = many.HANDED_BACK
        whole = (delay / period * (1.0 + 1e-12)).astype(np.int64)
        rest = delay - whole * period
        rest[rest < 1e-9 * period] = 0.0
        zeros, law_poles, gain = self._controller
        alike = np.unique(np.stack([whole, rest > 0.0]), axis=1).T
        for periods, rests in alike.tolist():
            which = (whole == periods) & ((rest > 0.0) == bool(rests))
            found, stated = values[which], status[which]
            many.measure_many(
                poles[which],
                residues[which],
                owner[which],
                own_part[which],
                period,
                whole[which],
                rest[which],
                zeros,
                law_poles,
                gain,
                np.asarray(self.law.poles()).astype(np.complex128),
                not self._nominal.fixed.rests_at_dc,
                self._start(periods, bool(rests)),
                peak_db,
                distances,
                found,
                stated,
            )
            values[which], status[which] = found, stated

    def _start(self, periods: int, rests: bool) -> ComplexArray:
        """Return the zeros of 1 + L of the nominal vehicle in w = z - 1, as starting values.

        `periods` is the number of whole samples of delay, and `rests` is True for a remaining fraction.
        """
        key = periods, rests
        if key not in self._starts:
            period = self.node.instruments.sample_s
            delay = (periods + (0.3 if rests else 0.0)) * period - self.node.instruments.delay_s
            same = int(self.node.instruments.delay_s / period) == periods and rests == (
                self.node.instruments.delay_s % period > 0.0
            )
            node = self.node if same else self.node.with_(delay_s=delay)
            loop = Loop(SampledFixedPath(node), self.law).state_space()
            roots = np.linalg.eigvals(loop.a - np.outer(loop.b[:, 0], loop.c[0])).astype(np.complex128) - 1.0
            # moved off the real axis and apart, since real zeros of the nominal vehicle may be pairs of another
            tilt = np.exp(0.7j * np.arange(1, len(roots) + 1))
            apart = np.where(np.abs(1.0 + roots) < 1e-5, 1e-6, 1e-3 * np.minimum(np.abs(roots), np.abs(1.0 + roots)))
            self._starts[key] = roots + np.maximum(apart, 1e-12) * tilt
        return self._starts[key]

    @cached_property
    def _starts(self) -> dict[tuple[int, bool], ComplexArray]:
        return {}

    @cached_property
    def _kept(self) -> tuple[IntArray, IntArray, IntArray, Array, int]:
        """Return the indices of the vehicle's states and inputs that are on the path, and data of their owners.

        The data are the code of each owner of states (owners,), its membership of states (owners, states), and the row
        of the output.
        """
        body, plant = self._nominal.fixed.vehicle, self.node.plant
        states = np.array([plant.states.index(name) for name in body.states])
        inputs = np.array([plant.inputs.index(name) for name in body.inputs])
        owner = [owner_of(name) for name in body.states]
        owners = list(dict.fromkeys(owner))
        code = np.array([_KINDS.get(kind, 0) * number for kind, number in owners])
        member = np.array([[one == o for one in owner] for o in owners], float)
        return states, inputs, code, member, plant.outputs.index("local_rate_radps")

    def _modes(
        self, node: Node, by: Dispersion, delay_s: Array
    ) -> tuple[ComplexArray, ComplexArray, IntArray, ComplexArray, NDArray[np.bool_]]:
        """Return the poles of the continuous path of each vehicle, (vehicles, poles), with residues and owners.

        The own part of each mode (`resonance.Resonance.part` times the path) and a flag for exact results (vehicles,)
        follow.
        """
        n = len(delay_s)
        states, inputs, code, member, row = self._kept
        drives, orders = self._drives
        held = deviated(node.held, node.plane, by, n)
        a, b, c, _, _ = held.plants(node.condition, node.trim, node.plane, node.drives, levels=LEVELS, in_place=True)
        a, b, c = a[:, states[:, None], states], b[:, states[:, None], inputs], c[:, row, states]
        # balances states of different magnitudes with the scaling of the nominal vehicle
        nominal = self._nominal.fixed.vehicle.a
        scale = scipy.linalg.matrix_balance(nominal, permute=False, separate=True)[1][0]
        a, b, c = a / scale[:, None] * scale, b / scale[:, None], c * scale
        poles, vectors = np.linalg.eig(a)
        left = np.linalg.inv(vectors)
        good = np.linalg.norm(vectors, axis=(1, 2)) * np.linalg.norm(left, axis=(1, 2)) < _WORST_BASIS
        per_input = np.einsum("vs,vsp->vp", c, vectors)[..., None] * (left @ b)
        groups = 1 + max(group for mine in node.instruments.groups for group in mine)
        factors = section_factors(by, groups, n)[..., None]
        pairs, zeros = [], []
        for record, (group, *_) in zip(node.actuators, node.instruments.groups, strict=True):
            mine = factors[:, group]
            poles_of = [] if record.ideal else actuator_poles(record)
            pairs.append([(w * mine[k], z * mine[4 + k]) for k, (w, z) in enumerate(poles_of)])
            with_zero = record.order == 6 and not record.ideal
            zeros.append((record.omega_4_radps * mine[3], record.zeta_4 * mine[7]) if with_zero else None)
        sensed = node.instruments.gyro
        gyro_pair = None if sensed.ideal else (sensed.omega_radps * _column(by.gyro_frequency), sensed.zeta)

        def actuator(drive: int, s: ComplexArray, without: int = -1) -> ComplexArray:
            out = np.ones(s.shape, np.complex128)
            for k, (omega, zeta) in enumerate(pairs[drive]):
                out = out if k == without else out * lag(s, omega, zeta)
            zero = zeros[drive]
            return out if zero is None else out / lag(s, *zero)

        def body(drive: int, s: ComplexArray) -> ComplexArray:
            """Return the response of the vehicle from a drive's angle to the rate, (vehicles, points)."""
            out = np.zeros(s.shape, np.complex128)
            for k in np.flatnonzero(drives == drive):
                out = out + s ** orders[k] * (per_input[:, None, :, k] / (s[..., None] - poles[:, None, :])).sum(axis=2)
            return out

        def gyro(s: ComplexArray) -> ComplexArray | float:
            return 1.0 if gyro_pair is None else lag(s, *gyro_pair)

        own = sum(per_input[..., k] * poles ** orders[k] * actuator(int(drives[k]), poles) for k in range(len(drives)))
        all_poles, residues = [poles.astype(np.complex128)], [own * gyro(poles)]
        for drive, its_pairs in enumerate(pairs):
            for k, (omega, zeta) in enumerate(its_pairs):
                at, residue = _pair_of(omega, zeta, n)
                all_poles.append(at)
                residues.append(residue * actuator(drive, at, k) * body(drive, at) * gyro(at))
        if gyro_pair is not None:
            at, residue = _pair_of(*gyro_pair, n)
            whole = sum(body(d, at) * actuator(d, at) for d in range(len(pairs)))
            all_poles.append(at)
            residues.append(residue * whole)
        owner = np.zeros((n, sum(p.shape[1] for p in all_poles)), np.int64)
        owner[:, : poles.shape[1]] = _owners(code, member, poles, vectors, left)
        own_part = np.full(owner.shape, complex(np.nan, np.nan))
        swings = np.where(poles.imag > 0.0, owner[:, : poles.shape[1]], 0)
        timing, every = node.instruments, np.arange(n)
        for mode in np.unique(swings[swings > 0]).tolist():
            which = (swings == mode).argmax(axis=1)
            pole, residue = poles[every, which, None, None], per_input[every, which, None]
            s = image_points(pole[:, 0, 0], timing.sample_s)
            at = s[..., None]
            way = residue / (at - pole) + residue.conj() / (at - pole.conj())
            through = sum(way[..., k] * s ** orders[k] * actuator(int(drives[k]), s) for k in range(len(drives)))
            own = (through * gyro(s) * sampled_computer(s, timing.sample_s, delay_s[:, None])).sum(axis=1)
            own_part[every, which] = np.where(swings[every, which] == mode, own, own_part[every, which])
        found, parts = np.concatenate(all_poles, axis=1), np.concatenate(residues, axis=1)
        finite = np.isfinite(parts).all(axis=1)
        return found, np.where(finite[:, None], parts, 0.0), owner, own_part, good & finite

    @cached_property
    def _drives(self) -> tuple[IntArray, IntArray]:
        """Return the drive of each input of the path, and the order of that input's derivative of the drive angle."""
        names = self._nominal.fixed.vehicle.inputs
        known = {of_drive(d, k): (k, o) for k in range(len(self.node.actuators)) for o, d in enumerate(DERIVATIVES)}
        drives, orders = zip(*(known[name] for name in names), strict=True)
        return np.array(drives), np.array(orders)


def _column(value: Array | float) -> Array | float:
    return value[:, None] if np.ndim(value) else value  # type: ignore[index]  # an array


def _pair_of(omega: Array | float, zeta: Array | float, n: int) -> tuple[ComplexArray, ComplexArray]:
    """Return the poles of omega^2 / (s^2 + 2 zeta omega s + omega^2), (n, 2), and their residues, (n, 2)."""
    root = np.sqrt(np.asarray(zeta, np.complex128) ** 2 - 1.0)
    both = np.stack(np.broadcast_arrays(omega * (-zeta + root), omega * (-zeta - root)), axis=-1).reshape(-1, 2)
    at = np.broadcast_to(both, (n, 2))
    square = np.broadcast_to(np.asarray(omega, float) ** 2, (n, 1) if np.ndim(omega) else ())
    return at, np.stack([square[..., 0] if np.ndim(square) else square] * 2, -1) / (at - at[:, ::-1])


def _owners(code: IntArray, member: Array, poles: ComplexArray, vectors: ComplexArray, left: ComplexArray) -> IntArray:
    """Return the mode (+k), tank (-k) or other owner (0) of each pole, (vehicles, poles).

    The assignment is that of `resonance.vehicle_poles`. `code` is the number of each owner (owners,), and `member` its
    states (owners, states).
    """
    share = np.abs(vectors * left.transpose(0, 2, 1))
    per_owner = np.einsum("os,vsp->vop", member, share)
    swinging = poles.imag > 0.0
    best = per_owner.argmax(axis=1)
    out = np.where(swinging, code[best], 0)
    taken = ((best[:, None, :] == np.arange(len(code))[:, None]) & swinging[:, None, :]).sum(axis=2)
    for v in np.flatnonzero(
        (taken > 1).any(axis=1)
    ):  # owners claimed by two poles: the assignment with the largest total participation
        at = np.flatnonzero(swinging[v])
        rows, which = scipy.optimize.linear_sum_assignment(per_owner[v][:, at].T, maximize=True)
        out[v] = 0
        out[v, at[rows]] = code[which]
    return out
