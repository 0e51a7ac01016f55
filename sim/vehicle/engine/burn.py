"""The burn of a stage: its start and end, the thrust share of each engine, and the propellant consumed over time.

Tables over the stage clock are treated as tables over the propellant consumed, because mass, tanks, modes and thrust
depend on the remaining propellant. An engine that is throttled, off or weak consumes less, and the clock s of the
tables runs slower than the stage clock t:

    ds/dt = sum_i w_i(s) m_i(t),   w_i = share of engine i in the nominal mass flow, m_i = its throttle times faults

If the shares are constant (engines of one table) and m_i is constant, s(t) is exact. Ramps of m_i are integrated in
steps of `_RAMP_S`, and changing shares in steps of `_SHARES_S`, by the classical Runge-Kutta method. All engines of a
body, the core or a booster, are assumed to draw from its tanks. Hence the remaining propellant and its distribution
depend on the amount consumed, not on the engine that consumed it. Every body has its own clock.

A table with one row is constant and covers all times. `burn_factor` multiplies the rate of the tables' clock.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import TYPE_CHECKING, TypeAlias

import numpy as np
from numpy.typing import NDArray

from maxq.sim.input.tables_csv import CsvTable
from maxq.sim.vehicle.engine.section import EngineSection

if TYPE_CHECKING:
    from maxq.sim.scenario.schema_booster import Booster
    from maxq.sim.scenario.schema_fault import Fault
    from maxq.sim.scenario.schema_vehicle import Stage

    Body: TypeAlias = "Stage | Booster"

BurnNumbers = NDArray[np.float64]

_RAMP_S, _SHARES_S, _BUILD_UP_S = 0.1, 0.5, 2.0


def thrust_end_s(body: Body) -> float:
    """Return the time of a body's tables from which on it has no thrust, s.

    It is 0 without an engine or with constant thrust, and the last time of a thrust table that does not end at zero.
    """
    if burns_for_ever(body):
        return 0.0
    return max((_table_end_s(engine.table) for engine in body.own_engines), default=0.0)


def burns_for_ever(body: Body) -> bool:
    """Return True if the thrust table of an engine has one row."""
    return any(len(engine.table) == 1 for engine in body.own_engines)


def _table_end_s(table: CsvTable) -> float:
    time, burning = table["time_s"], np.flatnonzero(table["thrust_vacuum_N"] > 0.0)
    if len(burning) == 0:
        return 0.0
    return float(time[min(int(burning[-1]) + 1, len(time) - 1)])


def burn_rate(body: Body) -> float:
    """Return the rate of the tables' clock relative to the stage clock without throttling and faults."""
    engines = body.own_engines
    rates = {engine.burn_factor for engine in engines}
    if len(rates) < 2:
        return rates.pop() if rates else 1.0
    peak_N = [float(engine.table["thrust_vacuum_N"].max()) for engine in engines]
    burnt = sum(peak * engine.burn_factor for peak, engine in zip(peak_N, engines, strict=True))
    return burnt / sum(peak_N)


def stage_spans(stages: Sequence[Stage], ends_s: Sequence[float] = ()) -> list[tuple[float, float]]:
    """Return the zero of each stage's clock on the vehicle clock, and the end of the stage on its own clock, s.

    The ends are those of the nominal tables, or `ends_s`. The end of the last stage is inf.
    """
    out: list[tuple[float, float]] = []
    start_s = end_s = 0.0
    for n, stage in enumerate(stages):
        if stage.clock == "own":
            start_s += end_s
        end_s = ends_s[n] if n < len(ends_s) else _nominal_end_s(stages, n)
        out.append((start_s, end_s))
    return out


def _nominal_end_s(stages: Sequence[Stage], n: int) -> float:
    stage = stages[n]
    if stage.separation_s is not None:
        return stage.separation_s
    if stage.separation_after_burnout_s is None:
        return math.inf
    leave = leaving(stages, n)
    ends = [b.ignition_s + thrust_end_s(b) / burn_rate(b) for b in leave] if leave else [nominal_burnout_s(stage)]
    return max(ends) + stage.separation_after_burnout_s


def nominal_burnout_s(stage: Stage) -> float:
    """Return the end of the last thrust of a stage by its tables, on its clock, s; 0 with constant thrust."""
    if any(burns_for_ever(body) for body in stage.bodies):
        return 0.0
    ends = [b.ignition_s + thrust_end_s(b) / burn_rate(b) for b in stage.booster]
    return max([thrust_end_s(stage) / burn_rate(stage), *ends])


def leaving(stages: Sequence[Stage], n: int) -> tuple[Booster, ...]:
    """Return the boosters that separate at the end of stage n; none if the core separates too."""
    return stages[n].leaving(stages[n + 1]) if n + 1 < len(stages) else ()


@dataclass(frozen=True)
class EngineFault:
    """A fault of engines, with its times on the stage clock.

    The engine immediately loses the share `fault.loss` of its thrust, by default all of it. A tail-off specifies the
    remaining share over time instead.
    """

    fault: Fault
    at_s: float
    until_s: float

    def affects(self, number: int) -> bool:
        """Return True if the engine of this number fails."""
        return self.fault.engine in (None, number)

    def left(self, time_s: float, before: bool) -> float:
        """Return the remaining share of thrust and flow at an instant, or with `before` immediately before it."""
        on = self.at_s < time_s <= self.until_s if before else self.at_s <= time_s < self.until_s
        if not on:
            return 1.0
        if self.fault.tail_off is not None:
            table = self.fault.tail_off
            return float(np.interp(time_s, self.at_s + table["time_s"], table["share"]))  # bit-identical to `instants`
        return 0.0 if self.fault.loss is None else 1.0 - self.fault.loss

    def instants(self) -> list[float]:
        tail = [] if self.fault.tail_off is None else list(self.at_s + self.fault.tail_off["time_s"])
        return [t for t in (self.at_s, self.until_s, *tail) if math.isfinite(t)]


@dataclass(frozen=True)
class TableClock:
    """The clock of the stage's tables over the stage clock: a parabola between consecutive `time_s`.

    - `time_s` (n,), `table_s` (n,): stage clock, and clock of the tables at these times.
    - `rate` (n, 2): ds/dt at the start of an interval and at its end; the last rate applies indefinitely.
    - `share` (engines, n, 2): throttle times faults of each engine at the start and the end, linear between.
    """

    time_s: BurnNumbers
    table_s: BurnNumbers
    rate: BurnNumbers
    share: BurnNumbers

    def at(self, time_s: BurnNumbers) -> tuple[NDArray[np.int64], BurnNumbers, BurnNumbers]:
        """Return the interval, the clock of the tables and its rate at instants of the stage clock."""
        k = np.clip(np.searchsorted(self.time_s, time_s, side="right") - 1, 0, len(self.time_s) - 1)
        into = time_s - self.time_s[k]
        slope = self.slopes()[k]
        return k, self.table_s[k] + into * (self.rate[k, 0] + 0.5 * slope * into), self.rate[k, 0] + slope * into

    def when(self, table_s: BurnNumbers) -> BurnNumbers:
        """Return the first instants at which the tables' clock reaches `table_s`; inf for values never reached."""
        out = np.full(len(table_s), np.inf)
        slopes = self.slopes()
        ends = np.append(self.table_s[1:], np.inf if self.rate[-1, 0] > 0.0 else self.table_s[-1])
        for n, wanted in enumerate(table_s):
            if wanted <= self.table_s[0]:
                out[n] = self.time_s[0] + wanted - self.table_s[0]
                continue
            k = int(np.searchsorted(ends, wanted, side="left"))
            if k < len(ends):
                gap, rate = wanted - self.table_s[k], self.rate[k, 0]
                root = math.sqrt(max(rate * rate + 2.0 * slopes[k] * gap, 0.0))
                out[n] = self.time_s[k] + (2.0 * gap / (rate + root) if rate + root > 0.0 else 0.0)
        return out

    def slopes(self) -> BurnNumbers:
        """Return the slope of the rate in each interval; the last rate is constant."""
        lengths = np.append(np.diff(self.time_s), np.inf)
        return np.asarray((self.rate[:, 1] - self.rate[:, 0]) / lengths)


@dataclass(frozen=True)
class Burn:
    """A stage's burn: its zero on the vehicle clock, and burnout and end on its own clock.

    `clock` is None if the tables' clock is the stage clock times `burn_rate`. `bodies` contains the burns of the core
    and of each booster on the clock of the stage; it is empty without boosters.
    """

    start_s: float
    burnout_s: float
    end_s: float
    clock: TableClock | None
    faults: tuple[EngineFault, ...]
    bodies: tuple[Burn, ...] = ()
    ignition_s: float = 0.0

    def of(self, body: int) -> Burn:
        """Return the burn of a body of the stage: 0 for the core, then the boosters from 1."""
        return self.bodies[body] if self.bodies else self

    def over(self, table_s: BurnNumbers) -> BurnNumbers:
        """Return the clock of this body's tables at values of the core's clock, if all bodies burn nominally."""
        return np.maximum(table_s - self.ignition_s, 0.0)


NOMINAL = Burn(0.0, 0.0, math.inf, None, ())
"""The burn of a stage without faults: all engines burn by their tables."""


def stage_burns(stages: Sequence[Stage], faults: Sequence[Fault], liftoff_s: float = math.inf) -> tuple[Burn, ...]:
    """Return the burn of each stage, with the faults of its engines.

    `liftoff_s`: time of liftoff on the vehicle clock; faults timed from liftoff occur only if it is finite.
    """
    out: list[Burn] = []
    first = 0  # stage at whose start the clock of this stage begins
    for n, stage in enumerate(stages):
        start_s, end_s = stage_spans(stages[: n + 2], [burn.end_s for burn in out])[n]
        first = n if stage.clock == "own" else first
        ends_s = [0.0, *(burn.end_s for burn in out[first:n]), math.inf]
        flown_s = dict(zip(range(first, n + 1), pairwise(ends_s), strict=True))
        own = [(f, (liftoff_s if f.since == "liftoff" else 0.0) - start_s) for f in faults if f.of_engines]
        mine = []
        for f, zero_s in own:
            begin_s, last_s = flown_s.get(n if f.stage is None else f.stage, (math.inf, math.inf))
            begin_s = 0.0 if f.stage is None else begin_s
            until_s = math.inf if f.until_s is None else zero_s + f.until_s
            if math.isfinite(begin_s) and math.isfinite(zero_s) and until_s > begin_s:
                mine.append(EngineFault(f, max(zero_s + f.at_s, begin_s), min(until_s, last_s)))
        found = tuple(mine)
        bodies = _body_burns(stage, found) if stage.booster else ()
        core = bodies[0] if bodies else _body_burn(stage, found, 0, clocked=False)
        burnout_s = core.burnout_s
        if bodies:
            ends = [burn.burnout_s for body, burn in zip(stage.bodies, bodies, strict=True) if body.own_engines]
            unending = any(burns_for_ever(body) for body in stage.bodies) and min(ends) == 0.0
            burnout_s = 0.0 if unending else max(ends, default=0.0)
        if stage.separation_after_burnout_s is not None and (bodies or core.clock is not None):
            names = {booster.name for booster in leaving(stages, n)}
            last = [burn.burnout_s for b, burn in zip(stage.booster, bodies[1:], strict=False) if b.name in names]
            end_s = max(last, default=burnout_s) + stage.separation_after_burnout_s
        out.append(Burn(start_s, burnout_s, end_s, core.clock, found, bodies))
    return tuple(out)


def _body_burns(stage: Stage, faults: tuple[EngineFault, ...]) -> tuple[Burn, ...]:
    """Return the burns of the core and of each booster, on the clock of the stage."""
    out: list[Burn] = []
    first = 0
    for body in stage.bodies:
        ignition_s = body.ignition_s if out else 0.0  # the tables of the core are over the stage clock
        own = tuple(
            replace(fault, at_s=max(fault.at_s - ignition_s, 0.0), until_s=fault.until_s - ignition_s)
            for fault in faults
            if fault.until_s > ignition_s
        )
        burn = _body_burn(body, own, first, clocked=True)
        assert burn.clock is not None
        clock = replace(burn.clock, time_s=burn.clock.time_s + ignition_s)
        end_s = burn.burnout_s + ignition_s if burn.burnout_s > 0.0 else 0.0
        out.append(replace(burn, clock=clock, burnout_s=end_s, ignition_s=body.ignition_s))
        first += len(body.own_engines)
    return tuple(out)


def _body_burn(body: Body, faults: tuple[EngineFault, ...], first: int, *, clocked: bool) -> Burn:
    """Return the burn of a body on its own clock; `first` is the number of its first engine in the stage.

    With `clocked`, the burn has a `TableClock` in all cases.
    """
    engines = body.own_engines
    unlike = len({e.burn_factor for e in engines}) > 1
    if clocked or faults or unlike or any(e.throttle is not None for e in engines):
        clock = table_clock(body, faults, first)
        return Burn(0.0, _burnout_s(body, clock), math.inf, clock, faults)
    return Burn(0.0, thrust_end_s(body) / burn_rate(body), math.inf, None, faults)


def table_time_s(stage: Stage, burn: Burn, time_s: float) -> float:
    """Return the clock of a stage's tables (the propellant consumed) at an instant of the stage clock, s."""
    return burn_rate(stage) * time_s if burn.clock is None else float(burn.clock.at(np.array([time_s]))[1][0])


def when_spent_s(stage: Stage, burn: Burn, table_s: float) -> float:
    """Return the instant of the stage clock at which the tables' clock reaches `table_s`; inf if it never does."""
    return table_s / burn_rate(stage) if burn.clock is None else float(burn.clock.when(np.array([table_s]))[0])


def _burnout_s(body: Body, clock: TableClock) -> float:
    """Return the end of the last thrust, s; 0 with constant thrust, as in `thrust_end_s`, and without thrust."""
    end_s = thrust_end_s(body)
    if len(clock.share) == 0:
        return 0.0
    spent_s = float(clock.when(np.array([end_s]))[0]) if end_s > 0.0 else math.inf
    working = np.flatnonzero(clock.share.max(axis=(0, 2)) > 0.0)
    off_s = math.inf if len(working) == 0 or working[-1] == len(clock.time_s) - 1 else clock.time_s[working[-1] + 1]
    last_s = min(spent_s, float(off_s))
    return last_s if math.isfinite(last_s) else 0.0


def table_clock(body: Body, faults: Sequence[EngineFault], first: int = 0) -> TableClock:
    """Return the clock of the tables of a body whose engines are throttled or fail.

    `first`: number of its first engine in the stage.
    """
    engines = body.own_engines
    if not engines:
        return TableClock(np.zeros(1), np.zeros(1), np.ones((1, 2)), np.zeros((0, 1, 2)))
    instants = {0.0, *(t for fault in faults for t in fault.instants())}
    instants |= {float(t) for e in engines if e.throttle is not None for t in e.throttle["time_s"]}
    alike = all(e.table == engines[0].table for e in engines)
    if not alike:  # shares change rapidly during the build-up of thrust
        instants |= set(np.arange(0.0, _BUILD_UP_S, _RAMP_S / 5.0).tolist())
    coarse = np.array(sorted(t for t in instants if t >= 0.0))
    times: list[float] = []
    for begin, end in zip(coarse, [*coarse[1:], coarse[-1]], strict=True):
        ends = [
            (_share(e, first + n, faults, begin, False), _share(e, first + n, faults, end, True))
            for n, e in enumerate(engines)
        ]
        ramps = any(a != b for a, b in ends)
        step = _RAMP_S if ramps else math.inf if alike else _SHARES_S
        pieces = max(1, math.ceil((end - begin) / step)) if math.isfinite(step) else 1
        times += [begin + (end - begin) * j / pieces for j in range(pieces)]
    if not alike:  # up to the end of the tables, even at the slowest rate
        last = max(float(e.table["time_s"][-1]) for e in engines)
        times += list(np.arange(times[-1] + _SHARES_S, 4.0 * last, _SHARES_S))
    time = np.array(times)
    share = np.array(
        [
            [[_share(e, n, faults, a, False), _share(e, n, faults, b, True)] for a, b in pairwise(time)]
            + [[_share(e, n, faults, time[-1], False)] * 2]
            for n, e in enumerate(engines, start=first)
        ]
    )
    return _integrated(body, time, share)


def _share(engine: EngineSection, number: int, faults: Sequence[EngineFault], time_s: float, before: bool) -> float:
    """Return throttle times faults of an engine at an instant, or with `before` immediately before it."""
    out = 1.0
    if engine.throttle is not None:
        out = float(np.interp(time_s, engine.throttle["time_s"], engine.throttle["throttle"]))
    for fault in faults:
        if fault.affects(number):
            out *= fault.left(time_s, before)
    return out


def _integrated(body: Body, time: BurnNumbers, share: BurnNumbers) -> TableClock:
    """Integrate ds/dt = 1 - sum of w_i (1 - m_i f_i), which is exactly 1 while all engines burn nominally.

    f_i is the burn factor of engine i.
    """
    factor = np.array([e.burn_factor for e in body.own_engines])
    missing = 1.0 - share * factor[:, None, None]
    table, rate = np.zeros(len(time)), np.zeros((len(time), 2))

    def slope(k: int, s: float, part: float) -> float:
        """Return ds/dt at the fraction `part` of interval k, for the tables' clock `s`."""
        lost = missing[:, k, 0] + part * (missing[:, k, 1] - missing[:, k, 0])
        return 1.0 - float(np.sum(flow_shares(body, s) * lost))

    for k in range(len(time)):
        s = table[k]
        rate[k] = slope(k, s, 0.0)
        if k + 1 < len(time):
            h = time[k + 1] - time[k]
            k_2 = slope(k, s + 0.5 * h * rate[k, 0], 0.5)
            k_3 = slope(k, s + 0.5 * h * k_2, 0.5)
            k_4 = slope(k, s + h * k_3, 1.0)
            table[k + 1] = s + h / 6.0 * (rate[k, 0] + 2.0 * (k_2 + k_3) + k_4)
            rate[k, 1] = 2.0 * (table[k + 1] - s) / h - rate[k, 0]  # the parabola through these values and this end
    return TableClock(time, table, rate, share)


def flow_shares(body: Body, table_s: float) -> BurnNumbers:
    """Return the share of each engine in the nominal mass flow of its body.

    If the flow is zero, the shares are those of the largest flows or thrusts.
    """
    flows = np.array([_flow(e, table_s) for e in body.own_engines])
    if flows.sum() == 0.0:
        flows = np.array([float(_column(e).max()) for e in body.own_engines])
    return np.asarray(flows / flows.sum()) if flows.sum() > 0.0 else flows


def _column(engine: EngineSection) -> BurnNumbers:
    return engine.table["mass_flow_kgps" if "mass_flow_kgps" in engine.table else "thrust_vacuum_N"]


def _flow(engine: EngineSection, table_s: float) -> float:
    return float(np.interp(table_s, engine.table["time_s"], _column(engine)))
