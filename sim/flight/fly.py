"""Flying a scenario from Python: one call, arrays by channel name, events and metrics."""

from __future__ import annotations

import hashlib
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from maxq.control.records import Array, IntArray, pack
from maxq.sim.dynamics.state import state_size
from maxq.sim.flight.loop import ARENA_SIZE, Logged, advance, begin
from maxq.sim.flight.metrics import METRICS
from maxq.sim.flight.parameters import CAUSES, CONTROL_LOST, DIVERGED, EVENT_NAMES, IMPACT
from maxq.sim.flight.telemetry import FAST, SLOW, channel_table
from maxq.sim.log.channels import ChannelTable
from maxq.sim.packing.flight import Packed, pack_flight
from maxq.sim.scenario.loader import LoadedScenario
from maxq.sim.scenario.schema_scenario import Requirement

SEGMENT_NS = 1_000_000_000  # one log chunk; also how often a flight can be interrupted

Rows = dict[str, tuple[IntArray, Array]]


@dataclass(frozen=True)
class Event:
    name: str
    time_s: float


@dataclass(frozen=True)
class Verdict:
    """A requirement and what the flight made of it."""

    requirement: Requirement
    value: float
    met: bool


@dataclass(frozen=True)
class Flight:
    """A flight that has been flown.

    `flight["alpha_deg"]` is a channel, `flight.time_s("alpha_deg")` its times; `metrics` and `metric_times_s` go by
    metric name. `outcome`: "impact", "stopped", "diverged", ... ; `cause` says why where it diverged.
    """

    scenario: LoadedScenario
    table: ChannelTable
    rows: Rows = field(repr=False)
    events: tuple[Event, ...]
    metrics: dict[str, float]
    metric_times_s: dict[str, float]
    verdicts: tuple[Verdict, ...]
    outcome: str
    cause: str
    end_s: float
    steps: int
    state: Array = field(repr=False)
    state_hash: str
    wall_s: float

    def __getitem__(self, channel: str) -> Array:
        """Values of a channel; KeyError for an unknown name."""
        group = self.table.topic(channel).group
        return self.rows[group][1][:, self.table.index(channel)]

    def time_s(self, channel: str) -> Array:
        """Times of a channel's values, s."""
        return 1e-9 * self.rows[self.table.topic(channel).group][0]

    def event_s(self, name: str) -> float:
        """Time of an event; nan if it has not happened."""
        return next((e.time_s for e in self.events if e.name == name), float("nan"))

    @property
    def passed(self) -> bool:
        """All requirements met, control never lost, nothing diverged."""
        lost = any(e.name in (EVENT_NAMES[CONTROL_LOST], EVENT_NAMES[DIVERGED]) for e in self.events)
        return not lost and all(v.met for v in self.verdicts)


class FlightRun:
    """A flight under way: `fly_segment` until `finished`, then `result`."""

    def __init__(self, loaded: LoadedScenario, packed: Packed | None = None, log: bool = True) -> None:
        self.loaded = loaded
        self.packed = packed or pack_flight(loaded.scenario)
        tanks = max((stage.tank for stage in loaded.vehicle.stage), key=len)
        names = tuple(tank.name or str(i + 1) for i, tank in enumerate(tanks[: self.packed.sizes.tanks]))
        self.table = channel_table(self.packed.sizes, names)
        self._logged = pack([Logged(int(log), self.packed.sizes)])
        self._arena = np.zeros(ARENA_SIZE)
        self._rows = np.zeros(2, np.int64)
        course = self.packed.parameters[0].course
        self._buffers: dict[str, tuple[IntArray, Array]] = {}
        for group, period in ((FAST, course.fast_ns), (SLOW, course.slow_ns)):
            room = SEGMENT_NS // int(period) + 4 if log else 1
            self._buffers[group] = (np.zeros(room, np.int64), np.zeros((room, len(self.table.columns(group)))))
        self.wall_s = 0.0
        begin(self.packed.parameters, self.packed.pool, self.packed.memory, self.packed.state)

    @property
    def memory(self) -> Any:
        return self.packed.memory[0]

    @property
    def finished(self) -> bool:
        return int(self.memory.clock.finished) == 1

    @property
    def now_s(self) -> float:
        return 1e-9 * int(self.memory.clock.now_ns)

    def fly_segment(self, length_ns: int = SEGMENT_NS) -> Rows:
        """Fly on for a segment; returns its log rows (views that the next segment overwrites), in logged units."""
        until = (int(self.memory.clock.now_ns) // length_ns + 1) * length_ns
        (fast_ns, fast), (slow_ns, slow) = self._buffers[FAST], self._buffers[SLOW]
        self._rows[:] = 0
        start = time.perf_counter()
        advance(
            self.packed.parameters, self.packed.pool, self.packed.memory, self.packed.state, self._arena, until,
            self._logged, fast_ns, fast, slow_ns, slow, self._rows,
        )  # fmt: skip
        self.wall_s += time.perf_counter() - start
        n, m = self._rows
        fast[:n] *= self.table.scales(FAST)
        slow[:m] *= self.table.scales(SLOW)
        return {FAST: (fast_ns[:n], fast[:n]), SLOW: (slow_ns[:m], slow[:m])}

    def result(self, rows: Rows | None = None) -> Flight:
        """The flight so far; `rows` are the log rows that the caller has kept."""
        clock, extremes = self.memory.clock, self.memory.extremes
        events = [Event(n, 1e-9 * int(t)) for n, t in zip(EVENT_NAMES, clock.event_ns, strict=True) if t >= 0]
        metrics = {m.name: float(v) for m, v in zip(METRICS, extremes.value, strict=True)}
        times = {m.name: 1e-9 * int(t) for m, t in zip(METRICS, extremes.time_ns, strict=True)}
        metrics |= _landing(events, self.packed)
        verdicts = tuple(_judge(r, metrics) for r in self.loaded.scenario.requirement)
        return Flight(
            scenario=self.loaded,
            table=self.table,
            rows=rows or {},
            events=tuple(sorted(events, key=lambda e: e.time_s)),
            metrics=metrics,
            metric_times_s=times,
            verdicts=verdicts,
            outcome=_outcome(clock),
            cause=CAUSES[int(clock.cause)],
            end_s=self.now_s,
            steps=int(clock.steps),
            state=self.packed.state.copy(),
            state_hash=self.state_hash(),
            wall_s=self.wall_s,
        )

    def state_hash(self) -> str:
        """SHA-256 over state, time and metrics: equal for equal flights, bit by bit."""
        memory = self.memory
        sizes = self.packed.parameters[int(memory.clock.stage)].vehicle.sizes
        digest = hashlib.sha256(self.packed.state[: state_size(sizes)].tobytes())
        digest.update(np.array([memory.clock.now_ns, memory.clock.steps]).tobytes())
        digest.update(memory.extremes.value.tobytes())
        digest.update(np.asarray(memory.clock.event_ns).tobytes())
        return digest.hexdigest()


def fly(
    loaded: LoadedScenario, *, log: bool = True, watch: Callable[[FlightRun, Rows], None] | None = None
) -> Flight:
    """Fly a scenario to its end. `log=False` keeps no channels and is fastest.

    `watch` is called after every simulated second with the run and that second's rows. A flight that diverges is a
    result (`outcome`, `cause`), no exception.
    """
    run = FlightRun(loaded, log=log)
    kept: list[Rows] = []
    while not run.finished:
        rows = run.fly_segment()
        if log:
            kept.append({group: (t.copy(), values.copy()) for group, (t, values) in rows.items()})
        if watch is not None:
            watch(run, rows)
    return run.result(joined(kept) if log else None)


def joined(segments: list[Rows]) -> Rows:
    """Rows of all segments in one."""
    if not segments:
        return {}
    return {
        group: (
            np.concatenate([s[group][0] for s in segments]),
            np.concatenate([s[group][1] for s in segments]),
        )
        for group in segments[0]
    }


def _outcome(clock: Any) -> str:
    if clock.event_ns[DIVERGED] >= 0:
        return EVENT_NAMES[DIVERGED]
    if clock.event_ns[IMPACT] >= 0:
        return EVENT_NAMES[IMPACT]
    return "ended" if clock.finished else "interrupted"


def _judge(requirement: Requirement, metrics: dict[str, float]) -> Verdict:
    value = metrics[requirement.metric]
    if requirement.limit is not None:
        met = value <= requirement.limit
    else:
        assert requirement.minimum is not None
        met = value >= requirement.minimum
    return Verdict(requirement, value, met)


def _landing(events: list[Event], packed: Packed) -> dict[str, float]:
    """Flight time and ground range, from the state at the flight's end."""
    return {}


__all__ = ["Event", "Flight", "FlightRun", "NDArray", "Verdict", "fly"]
