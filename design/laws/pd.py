"""The proportional-derivative law with its bending filter, linear side (Lee, Ahn & Roh eqs 33, 37 to 41).

    C = F(s) (k_p, k_d, k_i)  on  (angle_rad, rate_radps, angle_integral_rads)

with k_i = 0 here; with an integral it is the law of pid.py. Its kernel is control/laws/pd.py.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, fields, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.stats import qmc

from maxq.control.filters import BendingFilter, Discretization
from maxq.control.kernel.records import Array, IntArray
from maxq.control.kernel.tables import Cubics
from maxq.control.laws.pd import GainSchedule, gains_table
from maxq.control.structures import structure_of
from maxq.design.case.schema import Case
from maxq.design.laws.bending_filter import (
    AnyFilter,
    FilterVariables,
    check_period,
    drawn_filters,
    filter_poles,
    filter_state_space,
    laplace_axis,
    lifted,
    random_ranges,
)
from maxq.design.laws.law import MEASUREMENTS, Axis, Controller, DesignedLaw, LawLimit, LimitValues, LogResponse
from maxq.design.laws.schedule import (
    LARGEST_GAIN,
    LEAST_GAIN,
    GainSchedules,
    UnsolvableError,
    interpolation_weights,
    lowest_above,
)
from maxq.design.laws.task import DB, Rigid, Task
from maxq.design.model.state_space import ComplexArray, StateSpace, chain
from maxq.design.model.vehicle_at import Plane
from maxq.sim.packing.computer import bending_filter, gain_schedules
from maxq.sim.scenario.schema_design import Design
from maxq.sim.scenario.tables_csv import CsvTable


@dataclass(frozen=True)
class Pd:
    """The law at one instant (`law.Controller`); `filter` None is 1. Raises ValueError for gains not finite."""

    k_p: float
    k_d_s: float
    filter: AnyFilter = None
    k_i_ps: float = 0.0

    def __post_init__(self) -> None:
        if not np.isfinite(list(self.gains.values())).all():
            raise ValueError(", ".join(f"{k} = {v}" for k, v in self.gains.items()) + ": allowed are finite numbers")

    @property
    def inputs(self) -> tuple[str, ...]:
        return tuple(n for n in MEASUREMENTS if n == "rate_radps" or self.static_gain(n) != 0.0)

    @property
    def gains(self) -> Mapping[str, float]:
        integral = {"k_i_ps": self.k_i_ps} if self.k_i_ps != 0.0 else {}
        return {"k_p": self.k_p, "k_d_s": self.k_d_s, **integral}

    def check(self, sample_s: float | None) -> None:
        check_period(self.filter, sample_s)

    def response(self, frequencies_hz: ArrayLike) -> ComplexArray:
        return np.asarray(self.filter_response(frequencies_hz)[..., None] * self._gains())

    def filter_response(self, frequencies_hz: ArrayLike) -> ComplexArray:
        f = np.asarray(frequencies_hz, float)
        if self.filter is None:
            return np.ones(f.shape, np.complex128)
        return self.filter.frequency_response(2.0 * np.pi * f)

    def at(self, s: ComplexArray) -> ComplexArray:
        out = np.ones(np.shape(s), np.complex128)
        for n, d in () if not isinstance(self.filter, BendingFilter) else self.filter.polynomials():
            out = out * (n[0] + s * (n[1] + s * n[2])) / (d[0] + s * (d[1] + s * d[2]))
        return np.asarray(out[..., None] * self._gains())

    def static_gain(self, name: str) -> float:
        return dict(zip(MEASUREMENTS, (self.k_p, self.k_d_s, self.k_i_ps), strict=True)).get(name, 0.0)

    def poles(self) -> ComplexArray:
        return filter_poles(self.filter)

    def state_space(self) -> StateSpace:
        n = len(self.inputs)
        gains = StateSpace(
            np.zeros((0, 0)), np.zeros((0, n)), np.zeros((1, 0)), self._gains()[None], (), self.inputs, ("law_rad",)
        )
        return chain(gains, filter_state_space(self.filter))

    def scaled(self, factor: float) -> Pd:
        return Pd(factor * self.k_p, factor * self.k_d_s, self.filter, factor * self.k_i_ps)

    def _gains(self) -> np.ndarray:
        return np.array([self.static_gain(name) for name in self.inputs])


@dataclass(frozen=True)
class PdDesign:
    """The law of a design file (`law.DesignedLaw`): schedules of the gains in pitch and yaw, continuous filter."""

    pitch: GainSchedule
    yaw: GainSchedule
    filter: BendingFilter
    discretization: Discretization = "prewarped"
    prewarp_hz: float | None = None
    name: str = "pd"

    @staticmethod
    def of(design: Design) -> PdDesign:
        """From a design file."""
        form, filter_ = design.filter, bending_filter(design)
        return PdDesign(*gain_schedules(design.gains), filter_, form.discretization, form.prewarp_hz, design.law)

    @cached_property
    def _table(self) -> Cubics:
        """As the flight computer interpolates the gains."""
        return gains_table(self.pitch, self.yaw)

    @staticmethod
    def frozen(design: Design, time_s: float) -> Design:
        """The design with the gains of one instant at all times."""
        law = PdDesign.of(design)
        laws = [law.at(time_s, "pitch", None), law.at(time_s, "yaw", None)]
        names = law.pitch.columns
        pitch, yaw = (
            CsvTable("", {"time_s": np.array([time_s]), **{name: np.array([getattr(x, name)]) for name in names}})
            for x in laws
        )
        gains = design.gains.model_copy(update={"table": pitch, "yaw": None, "yaw_table": yaw})
        return design.model_copy(update={"gains": gains})

    def at(self, time_s: float, plane: Plane, sample_s: float | None) -> Pd:
        names = self.pitch.columns
        first = 0 if plane == "pitch" else len(names)
        gains = self._table(time_s)[first : first + len(names)].tolist()
        return Pd(**dict(zip(names, gains, strict=True)), filter=self.filter_at(sample_s))

    def filter_at(self, sample_s: float | None) -> AnyFilter:
        """The filter, continuous or as the flight computer runs it at a period."""
        if sample_s is None:
            return self.filter
        return self.filter.discretize(sample_s, self.discretization, self.prewarp_hz)

    def tables(self) -> dict[str, Any]:
        def rows(schedule: GainSchedule) -> tuple[dict[str, float], ...]:
            names = ("time_s", *schedule.columns)
            columns = [[float(x) for x in getattr(schedule, name)] for name in names]
            return tuple(dict(zip(names, row, strict=True)) for row in zip(*columns, strict=True))

        gains: dict[str, Any] = {"table": rows(self.pitch)}
        gains |= {"yaw": "pitch"} if self.yaw is self.pitch else {"yaw_table": rows(self.yaw)}
        quadratic, first_order = self.filter.quadratic, self.filter.first_order
        filter_: dict[str, Any] = {
            "structure": structure_of(len(quadratic), len(first_order)),
            "discretization": self.discretization,
            "quadratic": tuple(asdict(q) for q in quadratic),
            "first_order": tuple(asdict(f) for f in first_order),
        }
        if self.prewarp_hz is not None and filter_["structure"] != "none":
            filter_["prewarp_hz"] = self.prewarp_hz
        return {"law": self.name, "gains": gains, "filter": filter_}

    def record(self) -> dict[str, Any]:
        gains = {n: [float(x) for x in getattr(self.pitch, n)] for n in ("time_s", *self.pitch.columns)}
        return {"gains": gains, "filter": asdict(self.filter) | {"prewarp_hz": self.prewarp_hz}}


LEAPS = ((0.3, 0.0), (0.2, 0.1), (0.03, 0.15))
"""Sizes of leaps, taken in turn: of the filter's variables and of the gains'. Of sixteen leaps of each kind from the
second-best end of F3 with free gains, 6, 5 and 3 found the best."""
START_HZ, START_ZETA = 0.3, 0.5  # of the rigid body with its aerodynamics, where no limit asks for more
GAIN_FACTOR = 1.02  # of starting gains over the least that meet the limits
HERTZ, ZETA, AT_INFINITY = range(3)  # numbers of `PdVariables.limits`


class PdVariables:
    """`law.LawVariables` of PD: the filter's variables (bending_filter.py), then ln k_p and ln k_d at the gain nodes.

    Own parameters of a plant: the filter's variables, ln k_p, ln k_d.
    """

    inputs: tuple[str, ...] = MEASUREMENTS[:2]
    keys: tuple[str, ...] = ("k_p", "k_d_s")
    poles_at_zero = 0

    def __init__(self, task: Task, like: PdVariables | None = None, schedule: str | None = None) -> None:
        """`like`: take over what another one of the same case has found out, the gains of a two-phase design.

        `schedule` in place of the case's.
        """
        case = task.case
        self.task = task
        self.schedule = schedule or case.gains.schedule
        self.filter = FilterVariables(*case.filter.sections)
        self.prewarp_hz = case.filter.prewarp_hz or round(task.first_mode_hz, 1)
        if task.sample_s is not None and self.prewarp_hz >= 0.5 / task.sample_s:
            raise UnsolvableError(
                f"filter.prewarp_hz = {self.prewarp_hz:g}: lies above half the sample rate; "
                f"allowed are frequencies below {0.5 / task.sample_s:g} Hz"
            )
        self.full = case.limits.rigid_body == "aerodynamic"
        linear = not self.full
        self.limits: tuple[LawLimit, ...] = (
            LawLimit("rigid-body frequency", "Hz", linear),
            LawLimit("rigid-body damping", "", linear),
            LawLimit("|F(j inf)|", "", True),
        )
        nodes = _gain_nodes(case, self.schedule)
        weights = interpolation_weights(task.times_s, nodes)
        self.rigid_hz, self.rigid_zeta = task.limits["rigid_hz"], task.limits["rigid_zeta"]
        fixed: Array | None = None
        if self.schedule == "two-phase":
            wanted, own = case.reference, ~task.dispersed
            # a nominal plant is held to the reference, and a dispersed one to its own limits
            self.rigid_hz = np.where(own | (case.robust is None), wanted.rigid_hz, self.rigid_hz)
            self.rigid_zeta = np.where(own | (case.robust is None), wanted.rigid_zeta, self.rigid_zeta)
            fixed = None if like is None else like.gains.fixed
            if fixed is None:
                few = Rigid(*(getattr(task.rigid, f.name)[own] for f in fields(Rigid)))
                fixed = least_gains(few, weights[own], wanted.rigid_hz, wanted.rigid_zeta, self.full)
        self.gains: GainSchedules = GainSchedules(self.keys, nodes, weights, fixed)
        self.own_size = self.filter.size + len(self.keys)
        self.lower, self.upper = self._bounds(0), self._bounds(1)

    def _bounds(self, end: int) -> Array:
        """(49) and (50), `end` 0 lower and 1 upper."""
        b = self.task.case.filter.bounds
        quadratic = [math.log(b.zero_hz[end]), b.zero_zeta[end], math.log(b.pole_hz[end]), b.pole_zeta[end]]
        first_order = [math.log(b.first_order_zero_hz[end]), math.log(b.first_order_pole_hz[end])]
        gain = math.log((LEAST_GAIN, LARGEST_GAIN)[end])
        filter_ = quadratic * self.filter.quadratic + first_order * self.filter.first_order
        return np.array(filter_ + [gain] * self.gains.size)

    @property
    def names(self) -> tuple[str, ...]:
        return (*self.filter.names, *self.gains.names)

    def split(self, variables: Array) -> tuple[Array, Array]:
        """Variables of the filter, and of the gains."""
        return variables[: self.filter.size], variables[self.filter.size :]

    # --- own parameters
    def own(self, variables: Array) -> Array:
        y, u = self.split(variables)
        gains = np.log(self.gains.at_plants(u)).T
        return np.concatenate([np.broadcast_to(y, (len(gains), len(y))), gains], axis=1)

    def jacobian(self, variables: Array) -> Array:
        n, by = self.filter.size, self.gains.log_gradients(self.split(variables)[1])
        out = np.zeros((by.shape[1], self.own_size, len(variables)))
        out[:, :n, :n] = np.eye(n)
        out[:, n:, n:] = by.transpose(1, 0, 2)
        return out

    def bend(self, variables: Array, slopes: Array) -> Array:
        n, out = self.filter.size, np.zeros((len(variables), len(variables)))
        out[n:, n:] = self.gains.log_curvature(self.split(variables)[1], slopes[:, n:].T)
        return out

    # --- response
    def axis(self, x: Array) -> Axis:
        sample_s = self.task.sample_s
        return laplace_axis(x, sample_s, None if sample_s is None else self.prewarp_hz)

    def response(self, variables: Array, plant: IntArray, axis: Axis) -> tuple[ComplexArray, Array]:
        y, u = self.split(variables)
        return self.filter.response(y, axis[0]), self.gains.at_plants(u).T[plant]

    def log_response(self, own: Array, axis: Axis) -> LogResponse:
        n = self.filter.size
        s, s1, s2 = axis
        f0, f1, f2 = self.filter.slopes(own[:, :n], s)
        return LogResponse((f0, f1 * s1, f2 * s1 * s1 + f1 * s2), (np.exp(own[:, n:]), None, None))

    def gradient(self, own: Array, axis: Axis, weights: ComplexArray) -> ComplexArray:
        n = self.filter.size
        return np.concatenate([self.filter.gradient(own[:, :n], axis[0]), np.exp(own[:, n:]) * weights], axis=1)

    # --- limits that belong to no frequency
    def limit_values(self, own: Array) -> list[LimitValues]:
        """(47), (48) and (46)."""
        n = self.filter.size
        k_p, k_d = np.exp(own[:, n : n + 2]).T
        omega, zeta, by_omega, by_zeta = self._rigid_body(k_p, k_d)
        out = []
        for number, value, least, by in (
            (HERTZ, omega / (2.0 * math.pi), self.rigid_hz, by_omega),
            (ZETA, zeta, self.rigid_zeta, by_zeta),
        ):
            k = np.flatnonzero(least > 0.0)
            out.append(LimitValues(number, k, value[k], least[k], DB * np.log(least[k] / value[k]), -DB * by[k]))
        limits = self.task.case.limits
        if "filter_gain_at_infinity" not in limits.without and n > 0:
            most, slope = limits.filter_gain_at_infinity, self.filter.log_gain_at_infinity()
            gain = np.array([math.exp(float(slope @ own[0, :n]))])
            excess, by = DB * np.log(gain / most), np.concatenate([DB * slope, np.zeros(len(self.keys))])[None]
            out.append(LimitValues(AT_INFINITY, np.array([-1]), gain, np.array([most]), excess, by))
        return out

    def _rigid_body(self, k_p: Array, k_d: Array) -> tuple[Array, Array, Array, Array]:
        """omega (rad/s) and zeta, (plants,), and gradients of their logarithms by the own parameters.

        "paper": (35) and (36), s2 + M_delta k_d s + M_delta k_p. "aerodynamic" (erratum 12):
        s2 + (M_delta k_d - M_q) s + M_delta k_p - M_alpha.
        """
        r, n = self.task.rigid, self.filter.size
        spring, damper = r.m_delta * k_p, r.m_delta * k_d
        stiffness = np.maximum(spring - (r.m_alpha if self.full else 0.0), 1e-9)
        damping = np.maximum(damper - (r.m_q if self.full else 0.0), 1e-9)
        omega = np.sqrt(stiffness)
        by_omega, by_zeta = np.zeros((2, len(k_p), self.own_size))
        by_omega[:, n] = 0.5 * spring / stiffness
        by_zeta[:, n], by_zeta[:, n + 1] = -by_omega[:, n], damper / damping
        return omega, damping / (2.0 * omega), by_omega, by_zeta

    # --- laws
    def controllers(self, variables: Array) -> list[Controller]:
        y, u = self.split(variables)
        flown: AnyFilter = self.filter.filter(y)
        if self.task.sample_s is not None:
            flown = self.filter.filter(y).discretize(self.task.sample_s, "prewarped", self.prewarp_hz)
        named = [dict(zip(self.keys, gains, strict=True)) for gains in self.gains.at_plants(u).T.tolist()]
        return [Pd(**gains, filter=flown) for gains in named]

    def designed(self, variables: Array) -> PdDesign:
        y, u = self.split(variables)
        gains = GainSchedule(self.gains.nodes_s.tolist(), *self.gains.at_nodes(u).tolist())
        return PdDesign(gains, gains, self.filter.filter(y), "prewarped", self.prewarp_hz, self.task.case.law)

    def variables_of(self, law: DesignedLaw) -> Array | None:
        if not isinstance(law, PdDesign):
            return None
        filter_ = lifted(law.filter, self.filter, self.task.first_mode_hz)
        if filter_ is None:
            return None
        if law.pitch.columns != self.keys:
            return None
        given = np.array([getattr(law.pitch, key) for key in self.keys])
        known = self.gains.from_nodes(np.asarray(law.pitch.time_s), given)
        return self._clipped(np.concatenate([self.filter.variables(filter_), known]))

    def _clipped(self, variables: Array) -> Array:
        return np.asarray(np.clip(variables, self.lower, self.upper))

    # --- search
    def starts(self, count: int, seed: int) -> list[Array]:
        """Drawn filters first, half of all at most, then Sobol points: every fourth in the bounds, others a notch."""
        mode_hz, gains, n = self.task.first_mode_hz, self._start_gains(), self.filter.size
        filters = [self.filter.variables(f) for f in drawn_filters(self.filter, mode_hz)][: (count + 1) // 2]
        count -= len(filters)
        if count > 0:
            lower, upper = self.lower[:n], self.upper[:n]
            everywhere, likely = random_ranges(self.filter, lower, upper, mode_hz)
            points = qmc.Sobol(n, seed=seed).random_base2(max(1, math.ceil(math.log2(count))))[:count]
            fourth = (np.arange(count) % 4 == 3)[:, None]
            low, high = (np.where(fourth, everywhere[end], likely[end]) for end in (0, 1))
            filters += list(low + points * (high - low))
        return [self._clipped(np.concatenate([y, gains])) for y in filters]

    def _start_gains(self) -> Array:
        """The gain variables a little above the least that meet the limits, those of (47) and (48) as printed.

        And above what an unstable body needs to be as fast as `START_HZ` with M_alpha and M_q in it (erratum 12); the
        help of a stable one is not counted on, for without gains its path diverges slowly.
        """
        if self.gains.size == 0:
            return np.zeros(0)
        hz, zeta = (float(np.nanmax(np.append(x, low))) for x, low in ((self.rigid_hz, 0.1), (self.rigid_zeta, 0.3)))
        asked = least_gains(self.task.rigid, self.gains.weights, hz, zeta, False)
        rigid = replace(self.task.rigid, m_alpha=np.maximum(self.task.rigid.m_alpha, 0.0))
        needed = least_gains(rigid, self.gains.weights, START_HZ, START_ZETA, True)
        return self._with_more_gains(np.log(GAIN_FACTOR * np.maximum(asked, needed))).ravel()

    def _with_more_gains(self, log_gains: Array) -> Array:
        """Logarithms of all starting gains (keys, nodes) from those of k_p and k_d."""
        return log_gains

    def leap_size(self, number: int) -> Array:
        by_filter, by_gains = LEAPS[number % len(LEAPS)]
        return np.concatenate([np.full(self.filter.size, by_filter), np.full(self.gains.size, by_gains)])

    def simpler(self) -> tuple[PdVariables, Callable[[Array], Array]] | None:
        """Linear gains in place of many nodes."""
        if self.schedule not in ("free", "nodes") or len(self.gains.nodes_s) <= 2:
            return None
        small = type(self)(self.task, schedule="linear")

        def wider(x: Array) -> Array:
            y, u = small.split(x)
            return np.concatenate([y, self.gains.from_nodes(small.gains.nodes_s, small.gains.at_nodes(u))])

        return small, wider


def _gain_nodes(case: Case, schedule: str) -> Array:
    """Vehicle times of the gain table."""
    if schedule == "nodes":
        return np.array(case.gains.nodes_s, float)
    times = np.array(case.times_s, float)
    return times if schedule == "free" or len(times) == 1 else times[[0, -1]]


def least_gains(rigid: Rigid, weights: Array, rigid_hz: float, rigid_zeta: float, with_air: bool) -> Array:
    """(2, nodes): the least k_p, then the least k_d, at all plants in sum, that meet (47) and (48).

    Phase 1 of the paper's two-phase design (5.1). k_d suffices for the damping ratio with the k_p in force, not just
    with the least one. `with_air`: with M_alpha and M_q (erratum 12).
    """
    omega = 2.0 * math.pi * rigid_hz
    m_alpha, m_q = (rigid.m_alpha, rigid.m_q) if with_air else (0.0, 0.0)
    k_p = lowest_above(weights, (omega**2 + m_alpha) / rigid.m_delta)
    actual = np.sqrt(rigid.m_delta * (weights @ k_p) - m_alpha)
    return np.array([k_p, lowest_above(weights, (2.0 * rigid_zeta * actual + m_q) / rigid.m_delta)])
