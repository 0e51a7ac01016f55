"""The variables of the proportional-derivative law (pd.py) for the optimiser.

They are the gains at nodes and the parameters of the bending filter, the gyro weights, and the loop filters. The
integral adds variables in pid.py, load relief in load_relief.py, and drift feedback in drift.py.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import fields, replace

import numpy as np

from maxq.control.filters import BendingFilter
from maxq.control.kernel.records import Array, IntArray
from maxq.control.laws.pd import GainSchedule
from maxq.control.structures import Over
from maxq.design.laws import bending_filter
from maxq.design.laws.bending_filter import AnyFilter, FilterNodes, FilterVariables, Lag, lifted
from maxq.design.laws.freedom import bounded
from maxq.design.laws.law import (
    ANGLES,
    DRIFTS,
    MEASUREMENTS,
    Axis,
    Controller,
    DesignedLaw,
    LawLimit,
    LimitValues,
    LogResponse,
)
from maxq.design.laws.pd import BANKS, LoopFilter, Pd, PdDesign, as_flown
from maxq.design.laws.schedule import GAIN_BOUNDS, GainSchedules, UnsolvableError, interpolation_weights, lowest_above
from maxq.design.laws.task import DB, Rigid, Task
from maxq.design.laws.wind import WIND_LIMITS, Key, quantity
from maxq.design.model.instruments import ACCELERATION, further_rate
from maxq.design.model.state_space import ComplexArray

LEAPS = ((0.3, 0.0), (0.2, 0.1), (0.03, 0.15))
"""The sizes of random steps in the filter variables and in the gains, used in turn.

From the second-best optimum of F3 with free gains, 6, 5 and 3 of sixteen steps of each kind reached the best optimum.
"""
START_HZ, START_ZETA = 0.3, 0.5  # of the rigid body with aerodynamics at the start, if no limit requires more
GAIN_FACTOR = 1.02  # starting gains relative to the lowest gains that meet the limits
HERTZ, ZETA, AT_INFINITY = range(3)  # indices in `PdVariables.limits`
GAIN_OF = {"angle_rad": "k_p", "angle_integral_rads": "k_i_ps"}
GAIN_OF |= {"drift_mps": "k_zd_radspm", "drift_m": "k_z_radpm"}
BOUNDS_OF = {"k_zd_radspm": (1e-7, 1.0), "k_z_radpm": (1e-9, 1.0)}  # others: GAIN_BOUNDS
AIR = ("percussion_m", "accel_per_incidence_mps2")
ValueAndSlopes = tuple[ComplexArray, ComplexArray, ComplexArray]
"""The values at points with their first and second derivatives with respect to x = ln f."""


def product(a: ValueAndSlopes, b: ValueAndSlopes) -> ValueAndSlopes:
    """Return the product of two functions, with its derivatives."""
    return a[0] * b[0], a[1] * b[0] + a[0] * b[1], a[2] * b[0] + 2.0 * a[1] * b[1] + a[0] * b[2]


UNIT_OF: dict[Over, str] = {"time_s": " s", "speed_mps": " m/s", "mass_kg": " kg", "dynamic_pressure_Pa": " Pa"}


class PdVariables:
    """The variables of the PD law (`law.LawVariables`).

    The variables are, in this order:

    1. the filter variables (bending_filter.py), at each node of a scheduled filter
    2. ln k_p and ln k_d at the gain nodes
    3. the weights of the further gyros if the rate is blended, equal for all plants; the first weight makes the sum 1
    4. the variables of the separate filters of the loops

    The own parameters of one plant are the variables of its filter, ln k_p, ln k_d, the weights and the loop filters.
    Load relief by angle of attack adds two fixed parameters, 1 / b and -p / b (control/laws/load_relief.py).
    """

    inputs: tuple[str, ...] = MEASUREMENTS[:2]
    keys: tuple[str, ...] = ("k_p", "k_d_s")
    poles_at_zero = 0

    def __init__(self, task: Task, like: PdVariables | None = None, schedule: str | None = None) -> None:
        """Set up the variables of a task.

        `like` is another instance of the same case. The gains of a two-phase design and the prewarping frequency of the
        filter are taken from it. `schedule` replaces the gain schedule of the case. Raises UnsolvableError if the
        prewarping frequency is not below half the sample rate.
        """
        case = task.case
        self.task = task
        self.schedule = schedule or case.gains.schedule
        self.filter = FilterVariables(*case.filter.sections)
        own_hz = round(task.first_mode_hz, 1) if like is None else like.prewarp_hz
        self.prewarp_hz: float = case.filter.prewarp_hz or own_hz
        if task.sample_s is not None and self.prewarp_hz >= 0.5 / task.sample_s:
            raise UnsolvableError(
                f"filter.prewarp_hz = {self.prewarp_hz:g}: is above half the sample rate; "
                f"allowed are frequencies below {0.5 / task.sample_s:g} Hz"
            )
        self.loops = tuple(FilterVariables(*sections) for sections in case.loop_filters.each)
        self.in_loops = sum(loop.size for loop in self.loops)
        self.full = case.limits.rigid_body == "aerodynamic"
        linear = not self.full
        self.limits: tuple[LawLimit, ...] = (
            LawLimit.on("rigid_hz", linear),
            LawLimit.on("rigid_zeta", linear),
            LawLimit.on("filter_gain_at_infinity", True),
            *(LawLimit(f"|F(j inf)| with that of {bank}", "", True) for bank, loop in self._in_use),
        )
        nodes = _gain_nodes(task, self.schedule)
        weights = interpolation_weights(task.at, nodes)
        points = case.filter.nodes_s if case.gains.over == "time_s" else case.filter.nodes
        at = np.array(points or (0.0,), float)
        self.filter_nodes = FilterNodes(self.filter, at, interpolation_weights(task.at, at), UNIT_OF[case.gains.over])
        self.rigid_hz, self.rigid_zeta = task.limits["rigid_hz"], task.limits["rigid_zeta"]
        fixed: Array | None = None
        if self.schedule == "two-phase":
            wanted, own = case.reference, ~task.dispersed
            # nominal plants follow the reference, dispersed plants meet their own limits
            self.rigid_hz = np.where(own | (case.robust is None), wanted.rigid_hz, self.rigid_hz)
            self.rigid_zeta = np.where(own | (case.robust is None), wanted.rigid_zeta, self.rigid_zeta)
            fixed = None if like is None else like.gains.fixed
            if fixed is None:
                few = Rigid(*(getattr(task.rigid, f.name)[own] for f in fields(Rigid)))
                fixed = least_gains(few, weights[own], wanted.rigid_hz, wanted.rigid_zeta, self.full)
        self.gains: GainSchedules = self._schedules(nodes, weights, fixed, UNIT_OF[case.gains.over])
        self.further = task.further_gyros
        self.inputs = (*type(self).inputs, *(further_rate(k + 2) for k in range(self.further)))
        self.lag = Lag(case.load_relief.corner_hz, task.sample_s) if ACCELERATION in self.inputs else None
        self.by_incidence = "k_alpha" in self.keys
        self.air = np.zeros((2, len(nodes)))  # percussion_m, accel_per_incidence_mps2 at the gain nodes
        if self.by_incidence:
            order = np.argsort(task.at)
            self.air = np.array([np.interp(nodes, task.at[order], of[order]) for of in task.incidence.T])
        self.own_size = self.filter.size + len(self.keys) + self.further + self.in_loops + 2 * self.by_incidence
        stations = task.winds[0].stations_m if task.winds else ()
        known: list[Key] = [*WIND_LIMITS, *stations] if task.winds else []
        load = case.objective.kind == "load"
        small: tuple[Key, ...] = ("q_alpha_Padeg",) if load else case.objective_stations_m(stations)
        soft = {one.quantity: (case.term_of(k), one) for k, one in case.soft_goals.items()}
        small = (*small, *(key for key in WIND_LIMITS if key in soft))
        self._targets: dict[Key, float | None] = {key: one.limit for key, (_, one) in soft.items()}
        parts: dict[Key, tuple[int, float]] = {key: (term, one.weight or 1.0) for key, (term, one) in soft.items()}
        self._of_wind = [key for key in known if task.limits.asked(key) or key in small]
        self._first_of_wind = len(self.limits)
        self.limits = (
            *self.limits,
            *(LawLimit.of(quantity(key), False, key in small, *parts.get(key, (0, 1.0))) for key in self._of_wind),
        )
        self.lower, self.upper = bounded(case.variable, self.names, self._bounds(0), self._bounds(1))

    @property
    def _in_use(self) -> list[tuple[str, FilterVariables]]:
        """Return the loops that have a separate filter, with their names."""
        return [(bank, loop) for bank, loop in zip(BANKS, self.loops, strict=True) if loop.size > 0]

    def _bounds(self, end: int) -> Array:
        """Return the lower (`end` 0) or upper (`end` 1) bounds of the variables, (49) and (50)."""
        b = self.task.case.filter.bounds
        quadratic = [math.log(b.zero_hz[end]), b.zero_zeta[end], math.log(b.pole_hz[end]), b.pole_zeta[end]]
        first_order = [math.log(b.first_order_zero_hz[end]), math.log(b.first_order_pole_hz[end])]
        filter_ = quadratic * self.filter.quadratic + first_order * self.filter.first_order
        filter_ *= len(self.filter_nodes.nodes)
        weight = (self.task.case.blend or (0.0, 0.0))[end]
        of_loops = [x for loop in self.loops for x in quadratic * loop.quadratic + first_order * loop.first_order]
        return np.array(filter_ + self._gain_bounds(end) + [weight] * self.further + of_loops)

    def _schedules(self, nodes: Array, weights: Array, fixed: Array | None, unit: str) -> GainSchedules:
        """Return the schedules of the gains."""
        return GainSchedules(self.keys, nodes, weights, fixed, unit)

    def _gain_bounds(self, end: int) -> list[float]:
        """Return the bounds of the variables of the gain schedules, as `_bounds` does."""
        per_key = self.gains.size // len(self.keys)  # 0 if the gains are not variables
        return [math.log(BOUNDS_OF.get(key, GAIN_BOUNDS)[end]) for key in self.keys for _ in range(per_key)]

    @property
    def names(self) -> tuple[str, ...]:
        weights = (f"weight of gyro {k + 2}" for k in range(self.further))
        loops = (f"{bank}.{name}" for bank, loop in zip(BANKS, self.loops, strict=True) for name in loop.names)
        return (*self.filter_nodes.names, *self.gains.names, *weights, *loops)

    def split(self, variables: Array) -> list[Array]:
        """Return the variables of the filter, of the gains, of the further gyros' weights, and of the loop filters."""
        return np.split(variables, np.cumsum([self.filter_nodes.size, self.gains.size, self.further]))

    # --- own parameters
    def own(self, variables: Array) -> Array:
        y, u, *more = self.split(variables)
        gains = np.log(self.gains.at_plants(u)).T
        last = [np.broadcast_to(part, (len(gains), len(part))) for part in more]
        parts = [self.filter_nodes.at_plants(y), gains, *last]
        if self.by_incidence:
            percussion_m, slope = self.air @ self.gains.weights.T
            parts.append(np.column_stack([1.0 / slope, -percussion_m / slope]))
        return np.concatenate(parts, axis=1)

    def jacobian(self, variables: Array) -> Array:
        y, u, *_ = self.split(variables)
        n, m, by = self.filter.size, self.filter_nodes.size, self.gains.log_gradients(u)
        out = np.zeros((by.shape[1], self.own_size, len(variables)))
        out[:, :n, :m] = self.filter_nodes.gradients(y)
        k, g = n + len(self.keys), m + self.gains.size
        out[:, n:k, m:g] = by.transpose(1, 0, 2)
        rest = self.further + self.in_loops
        out[:, k : k + rest, g:] = np.eye(rest)
        return out

    def bend(self, variables: Array, slopes: Array) -> Array:
        n, m, out = self.filter.size, self.filter_nodes.size, np.zeros((len(variables), len(variables)))
        k, g = n + len(self.keys), m + self.gains.size
        y, u, *_ = self.split(variables)
        out[:m, :m] = self.filter_nodes.curvature(y, slopes[:, :n])
        out[m:g, m:g] = self.gains.log_curvature(u, slopes[:, n:k].T)
        return out

    # --- response
    def axis(self, x: Array) -> Axis:
        sample_s = self.task.sample_s
        axis = bending_filter.laplace_axis(x, sample_s, None if sample_s is None else self.prewarp_hz)
        if self.lag is None:
            return axis
        change = self.lag.change_with_slopes(x) if self.by_incidence else ()
        return (*axis, *self.lag.with_slopes(x), *change)

    @property
    def _plain(self) -> bool:
        """Return True if each gain acts on one measurement only and is constant over frequency."""
        signed = any(name in DRIFTS for name in self.inputs)
        return self.further == 0 and self.lag is None and self.in_loops == 0 and not signed

    def response(self, variables: Array, plant: IntArray, axis: Axis) -> tuple[ComplexArray, ComplexArray | Array]:
        y, u, *_ = self.split(variables)
        form = self.filter_nodes.at_plants(y)[plant] if self.filter_nodes.moves else y
        if self._plain:
            return self.filter.response(form, axis[0]), self.gains.at_plants(u).T[plant]
        return self.filter.response(form, axis[0]), self._on_measurements(self.own(variables)[plant], axis)[0][0]

    def at_points(self, own: Array, axis: Axis) -> tuple[ComplexArray, ComplexArray | Array]:
        n, mine = self.filter.size, np.broadcast_to(own, (len(axis[0]), len(own)))
        gains = np.exp(mine[:, n:]) if self._plain else self._on_measurements(mine, axis)[0][0]
        return self.filter.response(own[:n], axis[0]), gains

    def log_response(self, own: Array, axis: Axis) -> LogResponse:
        n = self.filter.size
        s, s1, s2 = axis[:3]
        f0, f1, f2 = self.filter.slopes(own[:, :n], s)
        common = (f0, f1 * s1, f2 * s1 * s1 + f1 * s2)
        if self._plain:
            return LogResponse(common, (np.exp(own[:, n:]), None, None))
        return LogResponse(common, self._on_measurements(own, axis)[0])

    def _on_measurements(self, own: Array, axis: Axis) -> tuple[ValueAndSlopes, ComplexArray]:
        """Return the gains at own parameters, with both derivatives with respect to x, and their gradients.

        `own` has the shape (points, own), and the gains (points, inputs). The gradients (points, inputs, own parameters
        after those of the filter) are those of the gains themselves.
        """
        n, keys, points = self.filter.size, self.keys, len(own)
        k, weights = np.exp(own[:, n : n + len(keys)]), own[:, n + len(keys) : n + len(keys) + self.further]
        first_loop = n + len(keys) + self.further
        at_loops = np.cumsum([first_loop, *(loop.size for loop in self.loops)])
        shape = points, len(self.inputs)
        out = tuple(np.zeros(shape, np.complex128) for _ in range(3))
        slopes = np.zeros((*shape, self.own_size - n), np.complex128)
        one: ValueAndSlopes = (np.ones(points, complex), np.zeros(points, complex), np.zeros(points, complex))
        lag: ValueAndSlopes = axis[3:6] if self.lag is not None else one  # type: ignore[assignment]  # three of them
        change: ValueAndSlopes = axis[6:9] if self.by_incidence else one  # type: ignore[assignment]  # three of them
        for i, name in enumerate(self.inputs):
            if name in DRIFTS:
                j = keys.index(GAIN_OF[name])
                out[0][:, i] = slopes[:, i, j] = -k[:, j]
                continue
            bank = 0 if name in ANGLES else 2 if name == ACCELERATION else 1
            loop, y = self.loops[bank], own[:, at_loops[bank] : at_loops[bank + 1]]
            # terms: index of the gain's key, factor of each point, factor over frequency
            if bank == 0:
                terms = [(keys.index(GAIN_OF[name]), np.ones(points), one)]
            elif bank == 1:
                share = 1.0 - weights.sum(axis=1) if name == "rate_radps" else weights[:, self._gyro(name)]
                terms = [(1, share, one)]
                if self.by_incidence:
                    terms.append((2, share * own[:, -1], change))
            else:
                terms = [(2, own[:, -2] if self.by_incidence else -np.ones(points), lag)]
            filter_ = one
            if loop.size > 0:
                f0, f1, f2 = loop.slopes(y, axis[0])
                value, first, second = np.exp(f0), f1 * axis[1], f2 * axis[1] ** 2 + f1 * axis[2]
                filter_ = value, value * first, value * (first * first + second)
            for j, factor, curve in terms:
                whole = product(curve, filter_)
                for d in range(3):
                    out[d][:, i] += k[:, j] * factor * whole[d]
                slopes[:, i, j] += k[:, j] * factor * whole[0]
                if bank == 1 and self.further > 0:
                    by_weight = k[:, j] * whole[0] * (1.0 if j == 1 else own[:, -1])
                    at = slice(len(keys), len(keys) + self.further)
                    if name == "rate_radps":
                        slopes[:, i, at] -= by_weight[:, None]
                    else:
                        slopes[:, i, len(keys) + self._gyro(name)] += by_weight
            if loop.size > 0:
                at = slice(at_loops[bank] - n, at_loops[bank + 1] - n)
                slopes[:, i, at] = out[0][:, i, None] * loop.gradient(y, axis[0])
        return out, slopes  # type: ignore[return-value]  # three of them

    def _gyro(self, name: str) -> int:
        """Return the index of a further gyro among the weights."""
        return next(k for k in range(self.further) if further_rate(k + 2) == name)

    def gradient(self, own: Array, axis: Axis, weights: ComplexArray) -> ComplexArray:
        n = self.filter.size
        if self._plain:
            return np.concatenate([self.filter.gradient(own[:, :n], axis[0]), np.exp(own[:, n:]) * weights], axis=1)
        slopes = self._on_measurements(own, axis)[1]
        by_gains = np.einsum("pi,pij->pj", weights, slopes)
        return np.concatenate([self.filter.gradient(own[:, :n], axis[0]), by_gains], axis=1)

    def _in_wind(self, own: Array) -> list[LimitValues]:
        """Return the load, drift and bending moments in wind, for all plants with limits on them."""
        if not self._of_wind:
            return []
        n, axis = self.filter.size, self.axis(self.task.winds[0].x)
        value, by = np.zeros((len(self._of_wind), len(own))), np.zeros((len(self._of_wind), *own.shape))
        first = self._first_of_wind
        held = np.array(
            [~np.isnan(self.task.limits[key]) | self.limits[first + k].objective for k, key in enumerate(self._of_wind)]
        )
        for plant in np.flatnonzero(held.any(axis=0)):
            wind = self.task.winds[int(plant)]
            mine = np.broadcast_to(own[plant], (len(axis[0]), self.own_size))
            common = self.filter.response(own[plant, :n], axis[0])[:, None]
            (gains, _, _), by_gains = self._on_measurements(mine, axis)
            law = common * gains
            slopes = [law[..., None] * self.filter.gradient(mine[:, :n], axis[0])[:, None, :]]
            whole = np.concatenate([*slopes, common[..., None] * by_gains], axis=2)
            value[:, plant], by[:, plant] = wind.rms([wind.output(key) for key in self._of_wind], law, whole)
        out = []
        for k, key in enumerate(self._of_wind):
            i = np.flatnonzero(held[k])
            most = self.task.limits[key][i]
            if (target := self._targets.get(key)) is not None:
                most = np.full(len(i), target)
            excess_db = DB * np.log(value[k, i] / np.where(np.isnan(most), 1.0, most))
            out.append(LimitValues(first + k, i, value[k, i], most, excess_db, by[k, i] * DB / value[k, i, None]))
        return out

    # --- limits that are independent of frequency
    def limit_values(self, own: Array) -> list[LimitValues]:
        """Return the values of the limits (46) to (48) and of those on the wind response.

        (46) limits the filter gain, (47) the rigid-body frequency, and (48) its damping ratio.
        """
        n = self.filter.size
        omega, zeta, by_omega, by_zeta = self._rigid_body(own)
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
            plants = np.arange(len(own)) if self.filter_nodes.moves else np.array([-1])
            gain = np.exp(own[plants, :n] @ slope)
            by = np.tile(np.concatenate([DB * slope, np.zeros(self.own_size - n)]), (len(plants), 1))
            bound = np.full(len(plants), most)
            out.append(LimitValues(AT_INFINITY, plants, gain, bound, DB * np.log(gain / most), by))
            at = n + len(self.keys) + self.further
            for number, (_, loop) in enumerate(self._in_use, AT_INFINITY + 1):
                both, mine = by.copy(), slice(at, at + loop.size)
                both[:, mine] = DB * loop.log_gain_at_infinity()
                with_loop = gain * np.exp(own[plants, mine] @ loop.log_gain_at_infinity())
                missed = DB * np.log(with_loop / most)
                out.append(LimitValues(number, plants, with_loop, bound, missed, both))
                at += loop.size
        return [*out, *self._in_wind(own)]

    def _rigid_gains(self, own: Array) -> tuple[Array, Array]:
        """Return k_p and k_d (2, plants), and the gradients of their logarithms (2, plants, own)."""
        n, by = self.filter.size, np.zeros((2, len(own), self.own_size))
        by[0, :, n] = by[1, :, n + 1] = 1.0
        return np.exp(own[:, n : n + 2]).T, by

    def _rigid_body(self, own: Array) -> tuple[Array, Array, Array, Array]:
        """Return omega (rad/s) and zeta of the rigid body, (plants,), and the gradients of their logarithms.

        The gradients are with respect to the own parameters. The characteristic polynomial for "paper" is (35) and
        (36), s2 + M_delta k_d s + M_delta k_p. For "aerodynamic" (erratum 12) it is s2 + (M_delta k_d - M_q)
        s + M_delta k_p - M_alpha.
        """
        r, ((k_p, k_d), (by_k_p, by_k_d)) = self.task.rigid, self._rigid_gains(own)
        spring, damper = r.m_delta * k_p, r.m_delta * k_d
        stiffness = np.maximum(spring - (r.m_alpha if self.full else 0.0), 1e-9)
        damping = np.maximum(damper - (r.m_q if self.full else 0.0), 1e-9)
        omega = np.sqrt(stiffness)
        by_omega = (0.5 * spring / stiffness)[:, None] * by_k_p
        return omega, damping / (2.0 * omega), by_omega, (damper / damping)[:, None] * by_k_d - by_omega

    # --- laws
    def controllers(self, variables: Array) -> list[Controller]:
        y, u, *_ = self.split(variables)
        rows = self.filter_nodes.at_plants(y) if self.filter_nodes.moves else y[None]
        flown: list[AnyFilter] = [
            as_flown((self.filter.filter(row), "prewarped", self.prewarp_hz), self.task.sample_s) for row in rows
        ]
        named = [dict(zip(self.keys, gains, strict=True)) for gains in self.gains.at_plants(u).T.tolist()]
        if self.by_incidence:
            for gains, air in zip(named, (self.air @ self.gains.weights.T).T.tolist(), strict=True):
                gains |= dict(zip(AIR, air, strict=True))
        loops = tuple(own and as_flown(own, self.task.sample_s) for own in self._loop_filters(variables))
        blend = self._blend(variables)
        each = flown if self.filter_nodes.moves else flown * len(named)
        return [self._controller(gains, filter_, blend, loops) for gains, filter_ in zip(named, each, strict=True)]

    def _controller(
        self, gains: dict[str, float], filter_: AnyFilter, blend: tuple[float, ...], loops: tuple[AnyFilter, ...]
    ) -> Controller:
        """Return the law at a plant."""
        return Pd(**gains, filter=filter_, blend=blend, lag=self.lag, loops=loops)

    def _loop_filters(self, variables: Array) -> tuple[LoopFilter | None, ...]:
        ends = np.cumsum([loop.size for loop in self.loops])
        parts = zip(self.loops, np.split(self.split(variables)[3], ends[:-1]), strict=True)
        return tuple((loop.filter(y), "prewarped", self.prewarp_hz) if loop.size > 0 else None for loop, y in parts)

    def _blend(self, variables: Array) -> tuple[float, ...]:
        weights = self.split(variables)[2].tolist()
        return (1.0 - sum(weights), *weights)

    def designed(self, variables: Array) -> PdDesign:
        y, u, *_ = self.split(variables)
        of_key = dict(zip(self.keys, self.gains.at_nodes(u).tolist(), strict=True))
        of_key |= dict(zip(AIR, self.air.tolist(), strict=True)) if self.by_incidence else {}
        gains = self._schedule(self.gains.nodes.tolist(), of_key)
        blend, relief_hz = self._blend(variables), None if self.lag is None else self.lag.corner_hz
        form, case = self.filter_nodes.schedule(y), self.task.case
        loops = self._loop_filters(variables)
        return PdDesign(gains, gains, form, "prewarped", self.prewarp_hz, case.law, (blend, blend), relief_hz, loops)

    def _schedule(self, at: list[float], columns: dict[str, list[float]]) -> GainSchedule:
        """Return the gain schedule of a design with the values of its columns."""
        return GainSchedule(at, over=self.task.case.gains.over, **columns)  # type: ignore[arg-type]  # gains only

    def variables_of(self, law: DesignedLaw, clipped: bool = True) -> Array | None:
        if not isinstance(law, PdDesign):
            return None
        form = self.filter_nodes.variables_of(law.filter, self.task.first_mode_hz)
        if form is None:
            return None
        if law.pitch.columns[: len(self.keys)] != self.keys or law.over != self.task.case.gains.over:
            return None
        given = np.array([law.pitch[key] for key in self.keys])
        if len(law.blend[0]) > 1 + self.further:
            return None
        weights = np.zeros(self.further)
        weights[: len(law.blend[0]) - 1] = law.blend[0][1:]
        known = self.gains.from_nodes(np.asarray(law.pitch.at), given)
        loops = self._lifted_loops([own and own[0] for own in law.loops])
        if loops is None:
            return None
        found = np.concatenate([form, known, weights, loops])
        return self._clipped(found) if clipped else found

    def _lifted_loops(self, filters: Sequence[BendingFilter | None]) -> Array | None:
        """Return the variables of the given loop filters, where None is a filter of 1.

        Returns None if a filter does not fit the layout of its loop.
        """
        parts: list[Array] = []
        for loop, own in zip(self.loops, filters, strict=True):
            as_wide = lifted(own or BendingFilter(), loop, self.task.first_mode_hz)
            if as_wide is None:
                return None
            parts.append(loop.variables(as_wide))
        return np.concatenate(parts)

    def _clipped(self, variables: Array) -> Array:
        return np.asarray(np.clip(variables, self.lower, self.upper))

    # --- search
    def starts(self, count: int, seed: int) -> list[Array]:
        """Return drawn filters, at most half of all starts, followed by Sobol points.

        Every fourth Sobol point is drawn from the bounds, and the others are notch-like.
        """
        mode_hz, gains, n = self.task.first_mode_hz, self._start_gains(), self.filter.size
        filters = [self.filter.variables(f) for f in bending_filter.drawn_filters(self.filter, mode_hz)][
            : (count + 1) // 2
        ]
        count -= len(filters)
        if count > 0:
            from scipy.stats import qmc  # noqa: PLC0415  # lazy: half a second to import, for searches only

            lower, upper = self.lower[:n], self.upper[:n]
            everywhere, likely = bending_filter.random_ranges(self.filter, lower, upper, mode_hz)
            points = qmc.Sobol(n, seed=seed).random_base2(max(1, math.ceil(math.log2(count))))[:count]
            fourth = (np.arange(count) % 4 == 3)[:, None]
            low, high = (np.where(fourth, everywhere[end], likely[end]) for end in (0, 1))
            filters += list(low + points * (high - low))
        loops = self._lifted_loops([None] * len(self.loops))
        assert loops is not None
        count, rest = len(self.filter_nodes.nodes), (gains, np.zeros(self.further), loops)
        return [self._clipped(np.concatenate([np.tile(y, count), *rest])) for y in filters]

    def _start_gains(self) -> Array:
        """Return gain variables slightly above the lowest gains that meet the limits (47) and (48) as printed.

        The gains also give an unstable body at least the frequency `START_HZ` with M_alpha and M_q included (erratum
        12). The restoring moment of a stable body is not credited, since its path diverges slowly without gains.
        """
        if self.gains.size == 0:
            return np.zeros(0)
        hz, zeta = (float(np.nanmax(np.append(x, low))) for x, low in ((self.rigid_hz, 0.1), (self.rigid_zeta, 0.3)))
        asked = least_gains(self.task.rigid, self.gains.weights, hz, zeta, False)
        rigid = replace(self.task.rigid, m_alpha=np.maximum(self.task.rigid.m_alpha, 0.0))
        needed = least_gains(rigid, self.gains.weights, START_HZ, START_ZETA, True)
        return self._with_more_gains(np.log(GAIN_FACTOR * np.maximum(asked, needed))).ravel()

    def _with_more_gains(self, log_gains: Array) -> Array:
        """Return the logarithms of all starting gains (keys, nodes), given those of k_p and k_d."""
        return log_gains

    def beside(self, variables: Array, lost: IntArray) -> Array | None:
        uses = self.gains.weights > 0.0
        kept = np.delete(uses, lost, axis=0).any(axis=0) & ~uses[lost].any(axis=0)
        if self.gains.size == 0 or not kept.any():
            return None
        y, u, *more = self.split(variables)
        gains = self.gains.from_nodes(self.gains.nodes[kept], self.gains.at_nodes(u)[:, kept])
        return np.concatenate([y, gains, *more])

    def leap_size(self, number: int) -> Array:
        by_filter, by_gains = LEAPS[number % len(LEAPS)]
        rest = (self.gains.size + self.further, by_gains), (self.in_loops, by_filter)
        sizes = (self.filter_nodes.size, by_filter), *rest
        return np.concatenate([np.full(count, size) for count, size in sizes])

    def simpler(self) -> tuple[PdVariables, Callable[[Array], Array]] | None:
        """Return a family with linear gains instead of many nodes, and with a constant filter instead of a schedule.

        A case that fixes or bounds variables by name has none.
        """
        if self.task.case.variable:
            return None
        many = self.schedule in ("free", "nodes") and len(self.gains.nodes) > 2
        if not many and not self.filter_nodes.moves:
            return None
        form = self.task.case.filter.model_copy(update={"nodes_s": None, "nodes": None})
        task = replace(self.task, case=self.task.case.model_copy(update={"filter": form}))
        small = type(self)(task, self, schedule="linear" if many else self.schedule)
        points = len(self.filter_nodes.nodes)

        def wider(x: Array) -> Array:
            y, u, *more = small.split(x)
            gains = self.gains.from_nodes(small.gains.nodes, small.gains.at_nodes(u))
            return np.concatenate([np.tile(y, points), gains, *more])

        return small, wider


def _gain_nodes(task: Task, schedule: str) -> Array:
    """Return the nodes of the gain table, in the unit of the scheduling quantity."""
    gains = task.case.gains
    if schedule == "nodes":
        return np.array(gains.nodes_s if gains.over == "time_s" else gains.nodes, float)
    at = np.array(task.case.times_s, float) if gains.over == "time_s" else np.unique(task.at)
    return at if schedule == "free" or len(at) == 1 else at[[0, -1]]


def least_gains(rigid: Rigid, weights: Array, rigid_hz: float, rigid_zeta: float, with_air: bool) -> Array:
    """Return the lowest schedules of k_p and then of k_d, (2, nodes), that meet (47) and (48) at all plants.

    The sum over all plants is minimised. This is phase 1 of the paper's two-phase design (5.1). The gain k_d gives the
    required damping ratio with the scheduled k_p, which may exceed the minimum. `with_air` includes M_alpha and M_q
    (erratum 12). Raises UnsolvableError.
    """
    omega = 2.0 * math.pi * rigid_hz
    m_alpha, m_q = (rigid.m_alpha, rigid.m_q) if with_air else (0.0, 0.0)
    k_p = lowest_above(weights, (omega**2 + m_alpha) / rigid.m_delta)
    actual = np.sqrt(rigid.m_delta * (weights @ k_p) - m_alpha)
    return np.array([k_p, lowest_above(weights, (2.0 * rigid_zeta * actual + m_q) / rigid.m_delta)])
