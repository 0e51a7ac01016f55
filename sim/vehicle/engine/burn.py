"""The burn of a stage: its begin and end, the share of thrust of each engine, and the propellant spent over time.

Tables over the stage clock are tables over the propellant spent: mass, tanks, modes and thrust belong to what is left.
An engine that is throttled, off or weak spends less, and the clock s of the tables runs slower than the stage clock t:

    ds/dt = sum_i w_i(s) m_i(t),   w_i = share of engine i in the nominal mass flow, m_i = its throttle times faults

With shares that do not change (engines of one table) and m_i constant, s(t) is exact; ramps of m_i are followed in
steps of `_RAMP_S`, changing shares in steps of `_SHARES_S` by the classical Runge-Kutta method. It is assumed that all
engines are fed alike: what the vehicle has left, and where, depends on how much was spent and not on who spent it.

A table with one row is constant and covers everything. `mass_flow_factor` makes the tables' clock run faster.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from maxq.sim.input.tables_csv import CsvTable
from maxq.sim.vehicle.engine.section import EngineSection

if TYPE_CHECKING:
    from maxq.sim.scenario.schema_fault import Fault
    from maxq.sim.scenario.schema_vehicle import Stage

BurnNumbers = NDArray[np.float64]

_RAMP_S, _SHARES_S, _BUILD_UP_S = 0.1, 0.5, 2.0


def thrust_end_s(stage: Stage) -> float:
    """Time of the stage's tables from which on there is no thrust; 0 without an engine or with constant
    thrust.

    When the thrust table does not end at zero, its last time.
    """
    if any(len(engine.table) == 1 for engine in stage.engines):
        return 0.0
    return max((_table_end_s(engine.table) for engine in stage.engines), default=0.0)


def _table_end_s(table: CsvTable) -> float:
    time, burning = table["time_s"], np.flatnonzero(table["thrust_vacuum_N"] > 0.0)
    if len(burning) == 0:
        return 0.0
    return float(time[min(int(burning[-1]) + 1, len(time) - 1)])


def burn_rate(stage: Stage) -> float:
    """Seconds of the tables' clock per second of the stage clock."""
    rates = {engine.mass_flow_factor for engine in stage.engines}
    if len(rates) < 2:
        return rates.pop() if rates else 1.0
    peak_N = [float(engine.table["thrust_vacuum_N"].max()) for engine in stage.engines]
    burnt = sum(peak * engine.mass_flow_factor for peak, engine in zip(peak_N, stage.engines, strict=True))
    return burnt / sum(peak_N)


def stage_end_s(stage: Stage) -> float:
    """When the stage separates, on its clock; infinite for the last one."""
    if stage.separation_s is not None:
        return stage.separation_s
    if stage.separation_after_burnout_s is not None:
        return thrust_end_s(stage) / burn_rate(stage) + stage.separation_after_burnout_s
    return math.inf


@dataclass(frozen=True)
class EngineFault:
    """On the stage clock. `loss`: share of the thrust that is lost at once; a tail-off gives what is left instead."""

    fault: Fault
    at_s: float
    until_s: float

    def affects(self, number: int) -> bool:
        """Return True if an engine of this number fails."""
        return self.fault.engine in (None, number)

    def left(self, time_s: float, before: bool) -> float:
        """Share of thrust and flow that is left at an instant, or just before it."""
        on = self.at_s < time_s <= self.until_s if before else self.at_s <= time_s < self.until_s
        if not on:
            return 1.0
        if self.fault.tail_off is not None:
            table = self.fault.tail_off
            return float(np.interp(time_s, self.at_s + table["time_s"], table["share"]))  # as `instants`, to the bit
        return 0.0 if self.fault.loss is None else 1.0 - self.fault.loss

    def instants(self) -> list[float]:
        tail = [] if self.fault.tail_off is None else list(self.at_s + self.fault.tail_off["time_s"])
        return [t for t in (self.at_s, self.until_s, *tail) if math.isfinite(t)]


@dataclass(frozen=True)
class TableClock:
    """The clock of the stage's tables over the stage clock: from each of `time_s` to the next a parabola.

    `table_s` (n,); `rate` (n, 2): ds/dt after an instant, and just before the next; the last goes on for ever. `share`
    (engines, n, 2): throttle and faults of each engine, linear between.
    """

    time_s: BurnNumbers
    table_s: BurnNumbers
    rate: BurnNumbers
    share: BurnNumbers

    def at(self, time_s: BurnNumbers) -> tuple[NDArray[np.int64], BurnNumbers, BurnNumbers]:
        """Interval, clock of the tables and its rate at instants of the stage clock."""
        k = np.clip(np.searchsorted(self.time_s, time_s, side="right") - 1, 0, len(self.time_s) - 1)
        into = time_s - self.time_s[k]
        slope = self.slopes()[k]
        return k, self.table_s[k] + into * (self.rate[k, 0] + 0.5 * slope * into), self.rate[k, 0] + slope * into

    def when(self, table_s: BurnNumbers) -> BurnNumbers:
        """First instants at which the tables' clock stands at `table_s`; infinite for what is never reached."""
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
        """Return the slopes of the rate in each interval; the last rate is held."""
        lengths = np.append(np.diff(self.time_s), np.inf)
        return np.asarray((self.rate[:, 1] - self.rate[:, 0]) / lengths)


@dataclass(frozen=True)
class Burn:
    """A stage's burn: its zero on the vehicle clock; burnout and end on its own clock; None where the tables' clock is
    the stage clock times `burn_rate`.
    """

    start_s: float
    burnout_s: float
    end_s: float
    clock: TableClock | None
    faults: tuple[EngineFault, ...]


NOMINAL = Burn(0.0, 0.0, math.inf, None, ())
"""A stage by itself: all engines burn by their tables."""


def stage_burns(stages: Sequence[Stage], faults: Sequence[Fault], liftoff_s: float = math.inf) -> tuple[Burn, ...]:
    """Return the burn of each stage, with the faults of its engines.

    `liftoff_s`: on the vehicle clock; faults timed from liftoff occur only where it is finite.
    """
    out: list[Burn] = []
    start_s = 0.0
    for n, stage in enumerate(stages):
        own = [(f, (liftoff_s if f.since == "liftoff" else 0.0) - start_s) for f in faults if f.of_engines]
        mine = tuple(
            EngineFault(f, max(zero_s + f.at_s, 0.0), math.inf if f.until_s is None else zero_s + f.until_s)
            for f, zero_s in own
            if f.stage in (None, n) and math.isfinite(zero_s) and (f.until_s is None or zero_s + f.until_s > 0.0)
        )
        clock, burnout_s, end_s = None, thrust_end_s(stage) / burn_rate(stage), stage_end_s(stage)
        unlike = len({e.mass_flow_factor for e in stage.engines}) > 1
        if mine or unlike or any(e.throttle is not None for e in stage.engines):
            clock = table_clock(stage, mine)
            burnout_s = _burnout_s(stage, clock)
            if stage.separation_after_burnout_s is not None:
                end_s = burnout_s + stage.separation_after_burnout_s
        out.append(Burn(start_s, burnout_s, end_s, clock, mine))
        start_s += end_s
    return tuple(out)


def table_time_s(stage: Stage, burn: Burn, time_s: float) -> float:
    """Return the clock of a stage's tables, the propellant spent, at an instant of its own clock."""
    return burn_rate(stage) * time_s if burn.clock is None else float(burn.clock.at(np.array([time_s]))[1][0])


def when_spent_s(stage: Stage, burn: Burn, table_s: float) -> float:
    """Return the instant of a stage's clock at which that of its tables is `table_s`; infinite if it never is."""
    return table_s / burn_rate(stage) if burn.clock is None else float(burn.clock.when(np.array([table_s]))[0])


def _burnout_s(stage: Stage, clock: TableClock) -> float:
    """When the last thrust ends: 0 with constant thrust, as `thrust_end_s`."""
    end_s = thrust_end_s(stage)
    spent_s = float(clock.when(np.array([end_s]))[0]) if end_s > 0.0 else math.inf
    working = np.flatnonzero(clock.share.max(axis=(0, 2)) > 0.0)
    off_s = math.inf if len(working) == 0 or working[-1] == len(clock.time_s) - 1 else clock.time_s[working[-1] + 1]
    last_s = min(spent_s, float(off_s))
    return last_s if math.isfinite(last_s) else 0.0


def table_clock(stage: Stage, faults: Sequence[EngineFault]) -> TableClock:
    """The clock of the tables of a stage whose engines are throttled, or fail."""
    engines = stage.engines
    instants = {0.0, *(t for fault in faults for t in fault.instants())}
    instants |= {float(t) for e in engines if e.throttle is not None for t in e.throttle["time_s"]}
    alike = all(e.table == engines[0].table for e in engines)
    if not alike:  # while the thrust builds up, shares change fast
        instants |= set(np.arange(0.0, _BUILD_UP_S, _RAMP_S / 5.0).tolist())
    coarse = np.array(sorted(t for t in instants if t >= 0.0))
    times: list[float] = []
    for begin, end in zip(coarse, [*coarse[1:], coarse[-1]], strict=True):
        ends = [(_share(e, n, faults, begin, False), _share(e, n, faults, end, True)) for n, e in enumerate(engines)]
        ramps = any(a != b for a, b in ends)
        step = _RAMP_S if ramps else math.inf if alike else _SHARES_S
        pieces = max(1, math.ceil((end - begin) / step)) if math.isfinite(step) else 1
        times += [begin + (end - begin) * j / pieces for j in range(pieces)]
    if not alike:  # to the end of the tables, slowly as they may be read
        last = max(float(e.table["time_s"][-1]) for e in engines)
        times += list(np.arange(times[-1] + _SHARES_S, 4.0 * last, _SHARES_S))
    time = np.array(times)
    share = np.array(
        [
            [[_share(e, n, faults, a, False), _share(e, n, faults, b, True)] for a, b in pairwise(time)]
            + [[_share(e, n, faults, time[-1], False)] * 2]
            for n, e in enumerate(engines)
        ]
    )
    return _integrated(stage, time, share)


def _share(engine: EngineSection, number: int, faults: Sequence[EngineFault], time_s: float, before: bool) -> float:
    """Throttle times faults of an engine."""
    out = 1.0
    if engine.throttle is not None:
        out = float(np.interp(time_s, engine.throttle["time_s"], engine.throttle["throttle"]))
    for fault in faults:
        if fault.affects(number):
            out *= fault.left(time_s, before)
    return out


def _integrated(stage: Stage, time: BurnNumbers, share: BurnNumbers) -> TableClock:
    """ds/dt = 1 - sum of w_i (1 - m_i f_i), which is exactly 1 while all engines burn as they should."""
    factor = np.array([e.mass_flow_factor for e in stage.engines])
    missing = 1.0 - share * factor[:, None, None]
    table, rate = np.zeros(len(time)), np.zeros((len(time), 2))

    def slope(k: int, s: float, part: float) -> float:
        """Within interval k, `part` of the way."""
        lost = missing[:, k, 0] + part * (missing[:, k, 1] - missing[:, k, 0])
        return 1.0 - float(np.sum(flow_shares(stage, s) * lost))

    for k in range(len(time)):
        s = table[k]
        rate[k] = slope(k, s, 0.0)
        if k + 1 < len(time):
            h = time[k + 1] - time[k]
            k_2 = slope(k, s + 0.5 * h * rate[k, 0], 0.5)
            k_3 = slope(k, s + 0.5 * h * k_2, 0.5)
            k_4 = slope(k, s + h * k_3, 1.0)
            table[k + 1] = s + h / 6.0 * (rate[k, 0] + 2.0 * (k_2 + k_3) + k_4)
            rate[k, 1] = 2.0 * (table[k + 1] - s) / h - rate[k, 0]  # the parabola that ends there
    return TableClock(time, table, rate, share)


def flow_shares(stage: Stage, table_s: float) -> BurnNumbers:
    """Share of each engine in the nominal mass flow; that at the largest thrust where nothing flows."""
    flows = np.array([_flow(e, table_s) for e in stage.engines])
    if flows.sum() == 0.0:
        flows = np.array([float(_column(e).max()) for e in stage.engines])
    return np.asarray(flows / flows.sum())


def _column(engine: EngineSection) -> BurnNumbers:
    return engine.table["mass_flow_kgps" if "mass_flow_kgps" in engine.table else "thrust_vacuum_N"]


def _flow(engine: EngineSection, table_s: float) -> float:
    return float(np.interp(table_s, engine.table["time_s"], _column(engine)))
