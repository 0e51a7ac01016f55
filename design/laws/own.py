"""The linear model of the law of a user, whose Python file a case or a design names (sim/packing/own_law.py).

    C = -F(z) (C_o (z I - A)^-1 B + D)  on  (angle_rad, rate_radps)

A to D are the matrices of the file at the values of its variables, and F is the bending filter. Frequency and damping
ratio of the rigid body (47, 48) are those of PD with the gains of C at zero frequency. The rate may be blended, and
the loops may have separate filters, as in PD (pd.py). The kernel of the law is control/laws/own.py.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from maxq.control.kernel.records import Array
from maxq.control.laws.pd import GainSchedule
from maxq.design.laws.bending_filter import AnyFilter, check_period, filter_poles, filter_state_space
from maxq.design.laws.law import Axis, Controller
from maxq.design.laws.pd import PdDesign, on_axis
from maxq.design.laws.pd_variables import PdVariables, ValueAndSlopes, product
from maxq.design.laws.schedule import GainSchedules
from maxq.design.laws.task import Task
from maxq.design.model.instruments import Plane, further_rate
from maxq.design.model.state_space import ComplexArray, StateSpace, chain
from maxq.sim.packing.own_law import LawMatrices, OwnCode, check_step, own_code
from maxq.sim.scenario.schema_design import Design


@dataclass(frozen=True)
class Own:
    """The law at one instant (`law.Controller`), discrete with the period `sample_s`, or continuous if it is None.

    `system` contains A to D as flown, `values` the variables by column, and `factor` a gain.
    """

    system: LawMatrices
    values: Mapping[str, float]
    sample_s: float | None
    filter: AnyFilter = None
    blend: tuple[float, ...] = (1.0,)
    loops: tuple[AnyFilter, ...] = (None, None, None)
    factor: float = 1.0

    @property
    def inputs(self) -> tuple[str, ...]:
        return ("angle_rad", *self._weights)

    @property
    def _weights(self) -> dict[str, float]:
        """Return the blending weight of each rate measurement by its name."""
        return {"rate_radps": self.blend[0], **{further_rate(k): w for k, w in enumerate(self.blend[1:], 2)}}

    @property
    def gains(self) -> Mapping[str, float]:
        return self.values if self.factor == 1.0 else {**self.values, "factor": self.factor}

    def check(self, sample_s: float | None) -> None:
        own = self.sample_s
        same = own == sample_s if own is None or sample_s is None else abs(own / sample_s - 1.0) <= 1e-9
        if not same:
            raise ValueError(f"law own of sample_s = {self.sample_s}: the loop's period is {sample_s}")
        for each in (self.filter, *self.loops):
            check_period(each, sample_s)

    def response(self, frequencies_hz: ArrayLike) -> ComplexArray:
        f = np.asarray(frequencies_hz)
        angle, rate = np.moveaxis(-self.factor * _at(self.system, self._axis(f)), -1, 0)
        attitude, turning = (on_axis(each, f) for each in self.loops[:2])
        found = [angle * attitude, *(weight * rate * turning for weight in self._weights.values())]
        return np.asarray(self.filter_response(f)[..., None] * np.stack(found, axis=-1))

    def _axis(self, frequencies_hz: Array) -> ComplexArray:
        """Return s, or z of a discrete law, at frequencies in Hz."""
        s = 2j * np.pi * frequencies_hz
        return np.asarray(s if self.sample_s is None else np.exp(s * self.sample_s))

    def filter_response(self, frequencies_hz: ArrayLike) -> ComplexArray:
        return on_axis(self.filter, np.asarray(frequencies_hz))

    def static_gain(self, name: str) -> float:
        angle, rate = (-self.factor * _at(self.system, self._axis(np.zeros(1))).real)[0]
        return float(angle) if name == "angle_rad" else float(rate) * self._weights.get(name, 0.0)

    def poles(self) -> ComplexArray:
        own: ComplexArray = np.linalg.eigvals(self.system[0]).astype(np.complex128)
        if self.sample_s is not None:
            kept = own[np.abs(own) > 1e-6]  # others act as pure delays
            own = np.asarray(np.log(kept) / self.sample_s, np.complex128)
        return np.concatenate([own, *(filter_poles(each) for each in (self.filter, *self.loops[:2]))])

    def state_space(self) -> StateSpace:
        a, b, c, d = self.system
        states = tuple(f"law_{k}" for k in range(len(a)))
        two = StateSpace(a, b, -self.factor * c, -self.factor * d, states, ("angle", "rate"), ("law_rad",))
        attitude, rate = (filter_state_space(each) for each in self.loops[:2])
        weights, (n, m) = list(self._weights.values()), (len(attitude.a), len(rate.a))
        joined = np.zeros((n + m, n + m))
        joined[:n, :n], joined[n:, n:] = attitude.a, rate.a
        into, out = np.zeros((n + m, 1 + len(weights))), np.zeros((2, n + m))
        into[:n, :1], into[n:, 1:] = attitude.b, rate.b * weights
        out[:1, :n], out[1:, n:] = attitude.c, rate.c
        through = np.zeros((2, 1 + len(weights)))
        through[0, 0], through[1, 1:] = attitude.d[0, 0], rate.d[0, 0] * np.array(weights)
        named = tuple(f"loop_{k}" for k in range(n + m))
        loops = StateSpace(joined, into, out, through, named, self.inputs, ("angle", "rate"))
        return chain(loops, two, filter_state_space(self.filter))

    def scaled(self, factor: float) -> Own:
        return replace(self, factor=factor * self.factor)


def bilinear(system: LawMatrices, sample_s: float) -> LawMatrices:
    """Return A to D of a discrete law in continuous time, with z = (1 + s T / 2) / (1 - s T / 2)."""
    a, b, c, d = system
    one, h = np.eye(len(a)), 2.0 / sample_s
    q = np.linalg.inv(one + a)
    return h * q @ (a - one), np.sqrt(2.0 * h) * q @ b, np.sqrt(2.0 * h) * c @ q, d - c @ q @ b


def _at(system: LawMatrices, z: ComplexArray) -> ComplexArray:
    """Return C (z I - A)^-1 B + D at points z (...), of shape (..., 2)."""
    a, b, c, d = system
    resolvent = z[..., None, None] * np.eye(len(a)) - a
    return np.asarray((c @ np.linalg.solve(resolvent, np.broadcast_to(b, (*z.shape, *b.shape))))[..., 0, :] + d[0])


@dataclass(frozen=True)
class OwnDesign(PdDesign):
    """The law of a design file with a plug-in (`law.DesignedLaw`)."""

    code: OwnCode | None = None
    plug_in: Any = field(default=None, compare=False)

    @staticmethod
    def of(design: Design) -> OwnDesign:
        """Return the law of a design file. Raises ScenarioError if the plug-in cannot be used."""
        assert design.plug_in is not None  # a check of the section
        pd = PdDesign.of(design)
        given = {name: getattr(pd, name) for name in PdDesign.__dataclass_fields__}
        return OwnDesign(**given, code=own_code(design.plug_in), plug_in=design.plug_in)

    def at(self, at: float, plane: Plane, sample_s: float | None) -> Own:  # type: ignore[override]  # another controller
        if sample_s is None:
            raise ValueError("the law own has no continuous form without a period; allowed is continuous_at")
        assert self.code is not None
        values = self.gains_at(at, plane)
        filter_, blend, loops = self.parts_at(at, plane, sample_s)
        system = self.code.system(np.array(list(values.values())), sample_s)
        return Own(system, values, sample_s, filter_, blend, loops)

    def continuous_at(self, at: float, plane: Plane, sample_s: float) -> Own:  # type: ignore[override]  # as above
        """Return the law mapped to continuous time by the bilinear transform."""
        law, (filter_, _, loops) = self.at(at, plane, sample_s), self.parts_at(at, plane, None)
        return replace(law, system=bilinear(law.system, sample_s), sample_s=None, filter=filter_, loops=loops)

    def tables(self) -> dict[str, Any]:
        kept = {key: getattr(self.plug_in, key) for key in ("file", "sha256", "member", "files")}
        return {**super().tables(), "plug_in": {key: value for key, value in kept.items() if value not in ("", ())}}


@dataclass(frozen=True)
class OwnSchedules(GainSchedules):
    """Schedules of which those of the keys `constant` have the same value at all nodes, and one variable."""

    constant: tuple[str, ...] = ()

    @cached_property
    def _spread(self) -> Array:
        """Return the matrix (all nodes of all keys, variables) from variables to logarithms of the gains."""
        n, columns = len(self.nodes), list[Array]()
        for k, key in enumerate(self.keys):
            block = np.zeros((len(self.keys) * n, 1 if key in self.constant else n))
            block[k * n : (k + 1) * n] = 1.0 if key in self.constant else np.eye(n)
            columns.append(block)
        return np.concatenate(columns, axis=1)

    @cached_property
    def _whole(self) -> GainSchedules:
        return GainSchedules(self.keys, self.nodes, self.weights, None, self.unit)

    @property
    def size(self) -> int:
        return int(self._spread.shape[1])

    @property
    def names(self) -> tuple[str, ...]:
        each = (
            ((key,) if key in self.constant else tuple(f"{key} at {at:g}{self.unit}" for at in self.nodes))
            for key in self.keys
        )
        return tuple(name for names in each for name in names)

    def at_nodes(self, u: Array) -> Array:
        return self._whole.at_nodes(self._spread @ u)

    def log_gradients(self, u: Array) -> Array:
        return np.asarray(self._whole.log_gradients(self._spread @ u) @ self._spread)

    def log_curvature(self, u: Array, slopes: Array) -> Array:
        return np.asarray(self._spread.T @ self._whole.log_curvature(self._spread @ u, slopes) @ self._spread)

    def from_nodes(self, nodes: Array, gains: Array) -> Array:
        """Return the variables interpolated from gains at other nodes; the mean logarithm of a constant one."""
        whole = self._whole.from_nodes(nodes, gains)
        return np.asarray((self._spread.T @ whole) / self._spread.sum(axis=0))


class OwnVariables(PdVariables):
    """The variables (`law.LawVariables`) of a law of a user.

    They are those of PD, with the logarithms of the law's variables in place of ln k_p and ln k_d.
    """

    def __init__(self, task: Task, like: PdVariables | None = None, schedule: str | None = None) -> None:
        assert task.case.plug_in is not None  # as the next line: a check of the case
        assert task.sample_s is not None
        self.code, self.sample_s = own_code(task.case.plug_in), task.sample_s
        self.code.check_slopes(self.sample_s)
        check_step(task.case.plug_in, tuple(self.code.start.tolist()), self.sample_s)
        self.keys = self.code.columns
        self._known: dict[bytes, tuple[LawMatrices, list[LawMatrices]]] = {}
        super().__init__(task, like, schedule)

    def _schedules(self, nodes: Array, weights: Array, fixed: Array | None, unit: str) -> GainSchedules:
        constant = tuple(
            key for key, name in zip(self.keys, self.code.names, strict=True) if name in self.code.constant
        )
        return OwnSchedules(self.keys, nodes, weights, fixed, unit, constant)

    def _gain_bounds(self, end: int) -> list[float]:
        by_key = dict(zip(self.keys, np.log((self.code.lower, self.code.upper)[end]).tolist(), strict=True))
        return [by_key[name.split(" at ", maxsplit=1)[0]] for name in self.gains.names]

    def _start_gains(self) -> Array:
        every = np.repeat(self.code.start[:, None], len(self.gains.nodes), axis=1)
        return self.gains.from_nodes(self.gains.nodes, every)

    @property
    def _plain(self) -> bool:
        return False

    def _matrices(self, log_values: Array) -> tuple[LawMatrices, list[LawMatrices]]:
        """Return A to D, and their derivatives with respect to the logarithm of each variable."""
        key = log_values.tobytes()
        if key not in self._known:
            if len(self._known) >= 256:
                self._known.clear()
            values = np.exp(log_values)
            slopes = self.code.slopes(values, self.sample_s)
            scaled = [(v * a, v * b, v * c, v * d) for v, (a, b, c, d) in zip(values, slopes, strict=True)]
            self._known[key] = self.code.system(values, self.sample_s), scaled
        return self._known[key]

    def _terms(self, own: Array, axis: Axis) -> tuple[ValueAndSlopes, ComplexArray]:
        """Return C without filters on attitude error and rate (points, 2), with both derivatives, and its gradients."""
        n, turn, z = self.filter.size, axis[-2], axis[-1]  # dz / dx = z * turn
        if len(own) == 0:
            none = np.zeros((0, 2), np.complex128)
            return (none, none, none), np.zeros((0, 2, len(self.keys)), np.complex128)
        rows = np.ascontiguousarray(own[:, n : n + len(self.keys)])
        changes = np.any(rows[1:] != rows[:-1], axis=1)
        of = np.concatenate([[0], np.cumsum(changes)])  # points of a plant follow each other
        each = [self._matrices(rows[k]) for k in (0, *(np.flatnonzero(changes) + 1))]
        a, b, c, d = (np.stack([system[m] for system, _ in each])[of] for m in range(4))
        da, db, dc, dd = (np.stack([[slope[m] for slope in slopes] for _, slopes in each])[of] for m in range(4))
        r = np.linalg.inv(z[:, None, None] * np.eye(a.shape[1]) - a)
        left, right = c @ r, r @ b
        first, second = -(left @ right)[:, 0], 2.0 * (left @ r @ right)[:, 0]
        dz = (z * turn)[:, None]
        dzz = dz * (turn + 1.0)[:, None]
        moved = dc @ right[:, None] + left[:, None] @ (da @ right[:, None] + db) + dd
        out = -((c @ right) + d)[:, 0], -first * dz, -(second * dz * dz + first * dzz)
        return out, -moved[:, :, 0].transpose(0, 2, 1)

    def _on_measurements(self, own: Array, axis: Axis) -> tuple[ValueAndSlopes, ComplexArray]:
        n, count, first = self.filter.size, len(self.keys), self.filter.size + len(self.keys) + self.further
        (value, by_x, by_xx), by = self._terms(own, axis)
        shape, weights = (len(own), len(self.inputs)), own[:, n + count : first]
        out = tuple(np.zeros(shape, np.complex128) for _ in range(3))
        slopes = np.zeros((*shape, self.own_size - n), np.complex128)
        at_loops = np.cumsum([first, *(loop.size for loop in self.loops)])
        for i, name in enumerate(self.inputs):
            bank = 0 if name == "angle_rad" else 1
            share = np.ones(len(own))
            if bank == 1:
                share = 1.0 - weights.sum(axis=1) if name == "rate_radps" else weights[:, self._gyro(name)]
            whole: ValueAndSlopes = (value[:, bank], by_x[:, bank], by_xx[:, bank])
            mine = by[:, bank]
            loop, y = self.loops[bank], own[:, at_loops[bank] : at_loops[bank + 1]]
            if loop.size > 0:
                f0, f1, f2 = loop.slopes(y, axis[0])
                of_x, of_xx = f1 * axis[1], f2 * axis[1] ** 2 + f1 * axis[2]
                filter_ = np.exp(f0)
                whole = product(whole, (filter_, filter_ * of_x, filter_ * (of_x * of_x + of_xx)))
                mine = mine * filter_[:, None]
            for d in range(3):
                out[d][:, i] = share * whole[d]
            slopes[:, i, :count] = share[:, None] * mine
            if bank == 1 and self.further > 0:
                if name == "rate_radps":
                    slopes[:, i, count : count + self.further] = -whole[0][:, None]
                else:
                    slopes[:, i, count + self._gyro(name)] = whole[0]
            if loop.size > 0:
                at = slice(at_loops[bank] - n, at_loops[bank + 1] - n)
                slopes[:, i, at] = out[0][:, i, None] * loop.gradient(y, axis[0])
        return out, slopes  # type: ignore[return-value]  # three of them

    def _rigid_gains(self, own: Array) -> tuple[Array, Array]:
        n, count = self.filter.size, len(self.keys)
        still = np.zeros(len(own), np.complex128)
        (value, _, _), by = self._terms(own, (still, np.exp(still)))
        out = np.zeros((2, len(own), self.own_size))
        gains = np.maximum(value.real.T, 1e-9)  # a law without stiffness or damping misses the limits
        out[:, :, n : n + count] = by.real.transpose(1, 0, 2) / gains[:, :, None]
        return gains, out

    def _controller(
        self, gains: dict[str, float], filter_: AnyFilter, blend: tuple[float, ...], loops: tuple[AnyFilter, ...]
    ) -> Controller:
        system = self.code.system(np.array(list(gains.values())), self.sample_s)
        return Own(system, gains, self.sample_s, filter_, blend, loops)

    def _schedule(self, at: list[float], columns: dict[str, list[float]]) -> GainSchedule:
        return GainSchedule(at, over=self.task.case.gains.over, own=columns)

    def designed(self, variables: Array) -> OwnDesign:
        pd = super().designed(variables)
        given = {name: getattr(pd, name) for name in PdDesign.__dataclass_fields__}
        return OwnDesign(**given, code=self.code, plug_in=self.task.case.plug_in)

    def axis(self, x: Array) -> Axis:
        turn = 2j * np.pi * np.exp(x) * self.sample_s
        return (*super().axis(x), turn, np.exp(turn))
