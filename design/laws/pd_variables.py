"""The variables of the proportional-derivative law (pd.py) for the optimiser: gains at nodes, bending filter, gyro
weights, filters of each loop.

With an integral they are those of pid.py, with load relief those of load_relief.py, with the drift those of drift.py.
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
from maxq.design.laws.bending_filter import AnyFilter, FilterVariables, Lag, lifted
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
"""The sizes of random steps, used in turn: of the filter's variables and of the gains. Of sixteen steps of each
kind from the second-best end of F3 with free gains, 6, 5 and 3 found the best.
"""
START_HZ, START_ZETA = 0.3, 0.5  # of the rigid body with its aerodynamics, if no limit requires more
GAIN_FACTOR = 1.02  # of the starting gains relative to the least that meet the limits
HERTZ, ZETA, AT_INFINITY = range(3)  # numbers of `PdVariables.limits`
GAIN_OF = {"angle_rad": "k_p", "angle_integral_rads": "k_i_ps"}
GAIN_OF |= {"drift_mps": "k_zd_radspm", "drift_m": "k_z_radpm"}
BOUNDS_OF = {"k_zd_radspm": (1e-7, 1.0), "k_z_radpm": (1e-9, 1.0)}  # others: GAIN_BOUNDS
AIR = ("percussion_m", "accel_per_incidence_mps2")
ValueAndSlopes = tuple[ComplexArray, ComplexArray, ComplexArray]
"""The values at points with their first and second derivatives by x = ln f."""


def _product(a: ValueAndSlopes, b: ValueAndSlopes) -> ValueAndSlopes:
    return a[0] * b[0], a[1] * b[0] + a[0] * b[1], a[2] * b[0] + 2.0 * a[1] * b[1] + a[0] * b[2]


UNIT_OF: dict[Over, str] = {"time_s": " s", "speed_mps": " m/s", "mass_kg": " kg", "dynamic_pressure_Pa": " Pa"}


class PdVariables:
    """The variables of the law PD (`law.LawVariables`): those of the filter, then ln k_p and ln k_d at the gain nodes.

    The filter is in bending_filter.py. If the rate is blended, the weights of the further gyros follow, equal for
    all plants; the first weight makes the sum 1. The variables of the loops' own filters are last. The parameters
    of one plant are the filter's variables, ln k_p, ln k_d, the weights and the loops' filters. Load relief by angle of
    attack adds two parameters that no variable changes: 1 / b and -p / b (control/laws/load_relief.py).
    """

    inputs: tuple[str, ...] = MEASUREMENTS[:2]
    keys: tuple[str, ...] = ("k_p", "k_d_s")
    poles_at_zero = 0

    def __init__(self, task: Task, like: PdVariables | None = None, schedule: str | None = None) -> None:
        """Set up the variables.

        `like` is another instance of the same case; its results are reused: the gains of a two-phase design, and the
        frequency at which its filter is prewarped.

        `schedule` replaces that of the case.
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
        self.rigid_hz, self.rigid_zeta = task.limits["rigid_hz"], task.limits["rigid_zeta"]
        fixed: Array | None = None
        if self.schedule == "two-phase":
            wanted, own = case.reference, ~task.dispersed
            # a nominal plant must follow the reference, and a dispersed one must meet its own limits
            self.rigid_hz = np.where(own | (case.robust is None), wanted.rigid_hz, self.rigid_hz)
            self.rigid_zeta = np.where(own | (case.robust is None), wanted.rigid_zeta, self.rigid_zeta)
            fixed = None if like is None else like.gains.fixed
            if fixed is None:
                few = Rigid(*(getattr(task.rigid, f.name)[own] for f in fields(Rigid)))
                fixed = least_gains(few, weights[own], wanted.rigid_hz, wanted.rigid_zeta, self.full)
        self.gains: GainSchedules = GainSchedules(self.keys, nodes, weights, fixed, UNIT_OF[case.gains.over])
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
        self._of_wind = [key for key in known if task.limits.asked(key) or key in small]
        self._first_of_wind = len(self.limits)
        self.limits = (*self.limits, *(LawLimit.of(quantity(key), False, key in small) for key in self._of_wind))
        self.lower, self.upper = self._bounds(0), self._bounds(1)

    @property
    def _in_use(self) -> list[tuple[str, FilterVariables]]:
        """Return the loops that have their own filter."""
        return [(bank, loop) for bank, loop in zip(BANKS, self.loops, strict=True) if loop.size > 0]

    def _bounds(self, end: int) -> Array:
        """Return the bounds (49) and (50). `end` 0 selects the lower and 1 the upper bounds."""
        b = self.task.case.filter.bounds
        quadratic = [math.log(b.zero_hz[end]), b.zero_zeta[end], math.log(b.pole_hz[end]), b.pole_zeta[end]]
        first_order = [math.log(b.first_order_zero_hz[end]), math.log(b.first_order_pole_hz[end])]
        gains = [math.log(BOUNDS_OF.get(key, GAIN_BOUNDS)[end]) for key in self.keys]
        per_key = self.gains.size // len(self.keys)  # 0 where the gains are no variables
        filter_ = quadratic * self.filter.quadratic + first_order * self.filter.first_order
        weight = (self.task.case.blend or (0.0, 0.0))[end]
        of_loops = [x for loop in self.loops for x in quadratic * loop.quadratic + first_order * loop.first_order]
        return np.array(filter_ + [gain for gain in gains for _ in range(per_key)] + [weight] * self.further + of_loops)

    @property
    def names(self) -> tuple[str, ...]:
        weights = (f"weight of gyro {k + 2}" for k in range(self.further))
        loops = (f"{bank}.{name}" for bank, loop in zip(BANKS, self.loops, strict=True) for name in loop.names)
        return (*self.filter.names, *self.gains.names, *weights, *loops)

    def split(self, variables: Array) -> list[Array]:
        """Return the variables of the filter, of the gains, of the weights of further rate gyros, and of the loops'
        filters.
        """
        return np.split(variables, np.cumsum([self.filter.size, self.gains.size, self.further]))

    # --- own parameters
    def own(self, variables: Array) -> Array:
        y, u, *more = self.split(variables)
        gains = np.log(self.gains.at_plants(u)).T
        first, *last = (np.broadcast_to(part, (len(gains), len(part))) for part in (y, *more))
        parts = [first, gains, *last]
        if self.by_incidence:
            percussion_m, slope = self.air @ self.gains.weights.T
            parts.append(np.column_stack([1.0 / slope, -percussion_m / slope]))
        return np.concatenate(parts, axis=1)

    def jacobian(self, variables: Array) -> Array:
        n, by = self.filter.size, self.gains.log_gradients(self.split(variables)[1])
        out = np.zeros((by.shape[1], self.own_size, len(variables)))
        out[:, :n, :n] = np.eye(n)
        k, g = n + len(self.keys), n + self.gains.size
        out[:, n:k, n:g] = by.transpose(1, 0, 2)
        rest = self.further + self.in_loops
        out[:, k : k + rest, g:] = np.eye(rest)
        return out

    def bend(self, variables: Array, slopes: Array) -> Array:
        n, out = self.filter.size, np.zeros((len(variables), len(variables)))
        k, g = n + len(self.keys), n + self.gains.size
        out[n:g, n:g] = self.gains.log_curvature(self.split(variables)[1], slopes[:, n:k].T)
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
        """Return True if each gain belongs to one measurement and is constant over frequency."""
        signed = any(name in DRIFTS for name in self.inputs)
        return self.further == 0 and self.lag is None and self.in_loops == 0 and not signed

    def response(self, variables: Array, plant: IntArray, axis: Axis) -> tuple[ComplexArray, ComplexArray | Array]:
        y, u, *_ = self.split(variables)
        if self._plain:
            return self.filter.response(y, axis[0]), self.gains.at_plants(u).T[plant]
        return self.filter.response(y, axis[0]), self._on_measurements(self.own(variables)[plant], axis)[0][0]

    def log_response(self, own: Array, axis: Axis) -> LogResponse:
        n = self.filter.size
        s, s1, s2 = axis[:3]
        f0, f1, f2 = self.filter.slopes(own[:, :n], s)
        common = (f0, f1 * s1, f2 * s1 * s1 + f1 * s2)
        if self._plain:
            return LogResponse(common, (np.exp(own[:, n:]), None, None))
        return LogResponse(common, self._on_measurements(own, axis)[0])

    def _on_measurements(self, own: Array, axis: Axis) -> tuple[ValueAndSlopes, ComplexArray]:
        """Return the gains (points, inputs) at own parameters (points, own), with both derivatives by x, and their
        slopes. The slopes are with respect to the own parameters that follow those of the filter.
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
            # terms: gain, index of the key, a factor of the point and one of frequency
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
                whole = _product(curve, filter_)
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
        """Return the number of a further gyro among the weights."""
        return next(k for k in range(self.further) if further_rate(k + 2) == name)

    def gradient(self, own: Array, axis: Axis, weights: ComplexArray) -> ComplexArray:
        n = self.filter.size
        if self._plain:
            return np.concatenate([self.filter.gradient(own[:, :n], axis[0]), np.exp(own[:, n:]) * weights], axis=1)
        slopes = self._on_measurements(own, axis)[1]
        by_gains = np.einsum("pi,pij->pj", weights, slopes)
        return np.concatenate([self.filter.gradient(own[:, :n], axis[0]), by_gains], axis=1)

    def _in_wind(self, own: Array) -> list[LimitValues]:
        """Return the load, drift and moments of all plants that have such limits."""
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
            excess_db = DB * np.log(value[k, i] / np.where(np.isnan(most), 1.0, most))
            out.append(LimitValues(first + k, i, value[k, i], most, excess_db, by[k, i] * DB / value[k, i, None]))
        return out

    # --- limits that are independent of frequency
    def limit_values(self, own: Array) -> list[LimitValues]:
        """Return the values of the limits (47), (48) and (46)."""
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
            excess, by = DB * np.log(gain / most), np.concatenate([DB * slope, np.zeros(self.own_size - n)])[None]
            out.append(LimitValues(AT_INFINITY, np.array([-1]), gain, np.array([most]), excess, by))
            at = n + len(self.keys) + self.further
            for number, (_, loop) in enumerate(self._in_use, AT_INFINITY + 1):
                both, mine = by.copy(), slice(at, at + loop.size)
                both[0, mine] = DB * loop.log_gain_at_infinity()
                with_loop = gain * math.exp(float(both[0, mine] @ own[0, mine]) / DB)
                missed = DB * np.log(with_loop / most)
                out.append(LimitValues(number, np.array([-1]), with_loop, np.array([most]), missed, both))
                at += loop.size
        return [*out, *self._in_wind(own)]

    def _rigid_body(self, k_p: Array, k_d: Array) -> tuple[Array, Array, Array, Array]:
        """Return omega (rad/s) and zeta, (plants,), and the gradients of their logarithms by the own parameters.

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
        y, u, *_ = self.split(variables)
        flown: AnyFilter = self.filter.filter(y)
        if self.task.sample_s is not None:
            flown = self.filter.filter(y).discretize(self.task.sample_s, "prewarped", self.prewarp_hz)
        named = [dict(zip(self.keys, gains, strict=True)) for gains in self.gains.at_plants(u).T.tolist()]
        if self.by_incidence:
            for gains, air in zip(named, (self.air @ self.gains.weights.T).T.tolist(), strict=True):
                gains |= dict(zip(AIR, air, strict=True))
        loops = tuple(own and as_flown(own, self.task.sample_s) for own in self._loop_filters(variables))
        return [Pd(**gains, filter=flown, blend=self._blend(variables), lag=self.lag, loops=loops) for gains in named]

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
        gains = GainSchedule(self.gains.nodes.tolist(), over=self.task.case.gains.over, **of_key)
        blend, relief_hz = self._blend(variables), None if self.lag is None else self.lag.corner_hz
        form, case = self.filter.filter(y), self.task.case
        loops = self._loop_filters(variables)
        return PdDesign(gains, gains, form, "prewarped", self.prewarp_hz, case.law, (blend, blend), relief_hz, loops)

    def variables_of(self, law: DesignedLaw) -> Array | None:
        if not isinstance(law, PdDesign):
            return None
        filter_ = lifted(law.filter, self.filter, self.task.first_mode_hz)
        if filter_ is None:
            return None
        if law.pitch.columns[: len(self.keys)] != self.keys or law.over != self.task.case.gains.over:
            return None
        given = np.array([getattr(law.pitch, key) for key in self.keys])
        if len(law.blend[0]) > 1 + self.further:
            return None
        weights = np.zeros(self.further)
        weights[: len(law.blend[0]) - 1] = law.blend[0][1:]
        known = self.gains.from_nodes(np.asarray(law.pitch.at), given)
        loops = self._lifted_loops([own and own[0] for own in law.loops])
        if loops is None:
            return None
        return self._clipped(np.concatenate([self.filter.variables(filter_), known, weights, loops]))

    def _lifted_loops(self, filters: Sequence[BendingFilter | None]) -> Array | None:
        """Return the variables of the loops' filters from these, where None means a filter of 1.

        Return None if they do not fit.
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
        """Return drawn filters, at most half of all starts, then Sobol points: every fourth in the bounds, the others
        notches.
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
        return [self._clipped(np.concatenate([y, gains, np.zeros(self.further), loops])) for y in filters]

    def _start_gains(self) -> Array:
        """Return gain variables slightly above the least that meet the limits (47) and (48) as printed.

        The gains also give an unstable body at least the frequency `START_HZ` with M_alpha and M_q included (erratum
        12). A stable body's restoring moment is not credited, since without gains its path diverges slowly.
        """
        if self.gains.size == 0:
            return np.zeros(0)
        hz, zeta = (float(np.nanmax(np.append(x, low))) for x, low in ((self.rigid_hz, 0.1), (self.rigid_zeta, 0.3)))
        asked = least_gains(self.task.rigid, self.gains.weights, hz, zeta, False)
        rigid = replace(self.task.rigid, m_alpha=np.maximum(self.task.rigid.m_alpha, 0.0))
        needed = least_gains(rigid, self.gains.weights, START_HZ, START_ZETA, True)
        return self._with_more_gains(np.log(GAIN_FACTOR * np.maximum(asked, needed))).ravel()

    def _with_more_gains(self, log_gains: Array) -> Array:
        """Return the logarithms of all starting gains (keys, nodes) from those of k_p and k_d."""
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
        sizes = (self.filter.size, by_filter), (self.gains.size + self.further, by_gains), (self.in_loops, by_filter)
        return np.concatenate([np.full(count, size) for count, size in sizes])

    def simpler(self) -> tuple[PdVariables, Callable[[Array], Array]] | None:
        """Return linear gains that replace many nodes."""
        if self.schedule not in ("free", "nodes") or len(self.gains.nodes) <= 2:
            return None
        small = type(self)(self.task, schedule="linear")

        def wider(x: Array) -> Array:
            y, u, *more = small.split(x)
            return np.concatenate([y, self.gains.from_nodes(small.gains.nodes, small.gains.at_nodes(u)), *more])

        return small, wider


def _gain_nodes(task: Task, schedule: str) -> Array:
    """Return the rows of the gain table, in the unit of the quantity over which it is scheduled."""
    gains = task.case.gains
    if schedule == "nodes":
        return np.array(gains.nodes_s if gains.over == "time_s" else gains.nodes, float)
    at = np.array(task.case.times_s, float) if gains.over == "time_s" else np.unique(task.at)
    return at if schedule == "free" or len(at) == 1 else at[[0, -1]]


def least_gains(rigid: Rigid, weights: Array, rigid_hz: float, rigid_zeta: float, with_air: bool) -> Array:
    """Return the least k_p, then the least k_d, (2, nodes), in sum over all plants, that meet (47) and (48).

    This is phase 1 of the paper's two-phase design (5.1). The gain k_d gives the required damping ratio with the k_p in
    force, not only with the least one. `with_air` includes M_alpha and M_q (erratum 12).
    """
    omega = 2.0 * math.pi * rigid_hz
    m_alpha, m_q = (rigid.m_alpha, rigid.m_q) if with_air else (0.0, 0.0)
    k_p = lowest_above(weights, (omega**2 + m_alpha) / rigid.m_delta)
    actual = np.sqrt(rigid.m_delta * (weights @ k_p) - m_alpha)
    return np.array([k_p, lowest_above(weights, (2.0 * rigid_zeta * actual + m_q) / rigid.m_delta)])
