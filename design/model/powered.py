"""Flights that provide operating points: their powered spans, their loss, and the flight up to an operating point."""

from __future__ import annotations

import dataclasses
import math
from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from maxq.control.kernel.records import duplicate
from maxq.sim.flight.parameters import EVENT_NAMES, NEVER, TUMBLE
from maxq.sim.packing.flight import Packed, pack_flight
from maxq.sim.run.flight import Event, LoggedRows
from maxq.sim.run.fly import CONTROL_LOST_NAME, CUTOFF_NAME, DIVERGED_NAME, IGNITION_NAME, RESTART_NAME, FlightRun
from maxq.sim.scenario.loader import LoadedScenario


@dataclass(frozen=True)
class Span:
    """A part of the flight (s on the vehicle clock) in which a stage is under thrust and off the pad.

    A stage has one span for each burn.
    """

    stage: int  # from 0
    begin_s: float
    end_s: float
    idle_s: float = 0.0  # sum of the preceding coasts before restarts, in which the tables of the stage stand still

    def holds(self, time_s: float) -> bool:
        """Return True for a time within the span."""
        return self.begin_s <= time_s <= self.end_s


LOSSES = (CONTROL_LOST_NAME, EVENT_NAMES[TUMBLE], DIVERGED_NAME)
"""The events after which a flight provides no operating points."""


def loss_of(events: Iterable[Event]) -> Event | None:
    """Return the first event that ends a flight as lost (control lost, tumble or divergence), or None."""
    return min((e for e in events if e.name in LOSSES), key=lambda e: e.time_ns, default=None)


def loss_text(loss: Event) -> str:
    """Return a loss and its time as text, such as "control lost at 23.140 s"."""
    return f"{loss.name.replace('_', ' ')} at {loss.time_s:.3f} s"


@dataclass
class _Ascent:
    """A flight of a scenario, with the states at the ends of its segments, from which further flights continue."""

    scenario: LoadedScenario
    faults: bool
    flown: LoadedScenario
    packed: Packed
    reached: dict[int, list[NDArray[np.uint8]]] = field(default_factory=dict)  # `_Resumed._carried` by time, ns
    answer: tuple[tuple[Span, ...], Event | None] | None = None  # of `powered_flight`


_LATEST: deque[_Ascent] = deque(maxlen=4)
_MOST_REACHED = 300  # states of an ascent, 0.1 MB each


def _ascent(scenario: LoadedScenario, faults: bool) -> _Ascent:
    """Return the flight of a scenario on the grid of run.step_s, one of the latest if it is among them."""
    faults = faults and bool(scenario.scenario.fault)
    for known in tuple(_LATEST):
        if known.scenario is scenario and known.faults == faults:
            return known
    flown = _on_grid(scenario, faults)
    found = _Ascent(scenario, faults, flown, pack_flight(flown.scenario))
    _LATEST.append(found)
    return found


def _on_grid(scenario: LoadedScenario, faults: bool) -> LoadedScenario:
    run = scenario.scenario.run.model_copy(update={"accuracy": None})
    flown = scenario.scenario.model_copy(update={"run": run} | ({} if faults else {"fault": ()}))
    return dataclasses.replace(scenario, scenario=flown)


class _Resumed(FlightRun):
    """A flight without a log that continues from the states of its ascent, and adds its own to them.

    It is bit-identical to a flight from the start.
    """

    def __init__(self, ascent: _Ascent) -> None:
        packed = ascent.packed
        own = dataclasses.replace(packed, memory=duplicate(packed.memory), state=packed.state.copy())
        super().__init__(ascent.flown, own, log=False)
        self._reached = ascent.reached

    @property
    def _carried(self) -> list[NDArray[np.uint8]]:
        """Return the bytes of all that a step of fixed length takes over from the step before."""
        of_arena = (self._arena[name] for name in ("start_properties", "start_aux", "work"))
        return [each.view(np.uint8) for each in (self.packed.memory, self.packed.state, *of_arena)]

    def fly_segment(self, length_ns: int | None = None) -> LoggedRows:
        now_ns, length_ns = int(self.memory.clock.now_ns), length_ns or self.segment_ns
        until_ns = (now_ns // length_ns + 1) * length_ns
        known_ns = max((t for t in tuple(self._reached) if now_ns < t <= until_ns), default=now_ns)
        if known_ns > now_ns:
            for mine, known in zip(self._carried, self._reached[known_ns], strict=True):
                mine[:] = known
            if known_ns == until_ns or self.finished:
                return {}
        rows = super().fly_segment(length_ns)
        if len(self._reached) < _MOST_REACHED:
            self._reached[int(self.memory.clock.now_ns)] = [each.copy() for each in self._carried]
        return rows


def powered_flight(scenario: LoadedScenario, faults: bool = False) -> tuple[tuple[Span, ...], Event | None]:
    """Return the powered spans and the loss, from a flight to the burnout or cutoff of the last burn, or to the loss.

    The flight is simulated without a log. The latest results are cached, since callers request spans, times and loss of
    one flight in turn.
    """
    ascent = _ascent(scenario, faults)
    if ascent.answer is None:
        ascent.answer = _powered_flight(scenario, faults)
    return ascent.answer


def _powered_flight(scenario: LoadedScenario, faults: bool) -> tuple[tuple[Span, ...], Event | None]:
    run, loss = flown_run(scenario, faults), None
    last = len(run.packed.parameters) - 1
    burnout_ns = -1
    while not run.finished and loss is None and burnout_ns < 0:
        run.fly_segment()
        burnout_ns = -1 if run.awaits_restart else int(run.memory.clock.stage_burnout_ns[last])
        loss = loss_of(run.events)
    if loss is not None and 0 <= burnout_ns < loss.time_ns:
        loss = None  # the loss belongs to the coast after burnout
    spans = spans_of(run.events, len(run.packed.parameters), run.now_s)
    return _as_commanded(run, spans), loss


def _as_commanded(run: FlightRun, spans: tuple[Span, ...]) -> tuple[Span, ...]:
    """Add to `idle_s` the delay of the ignitions that flight code has commanded, relative to those of the scenario."""
    timelines, late_s = run.packed.parameters["timeline"], 0.0
    if timelines["sequenced"][0] == 0:
        return spans
    lit_s = {max(e.stage - 1, 0): e.time_s for e in run.events if e.name == IGNITION_NAME}
    out = []
    for span in spans:
        if span.stage in lit_s:  # the first burn of this stage; a stage that continues the burn has no ignition
            late_s = lit_s.pop(span.stage) - 1e-9 * int(timelines["burn_start_ns"][span.stage]) - span.idle_s
        out.append(dataclasses.replace(span, idle_s=span.idle_s + late_s))
    return tuple(out)


def powered_spans(scenario: LoadedScenario) -> tuple[Span, ...]:
    """Return the powered spans of a flight without faults.

    The spans end at a loss of the flight.
    """
    return powered_flight(scenario)[0]


def by_burn(scenario: LoadedScenario, times_s: Iterable[float]) -> list[list[float]]:
    """Return the given times within each powered span, in rising order. Spans without any of them are omitted."""
    wanted = sorted(set(times_s))
    return [mine for span in powered_spans(scenario) if (mine := [t for t in wanted if span.holds(t)])]


def spans_of(events: Iterable[Event], stages: int, now_s: float) -> tuple[Span, ...]:
    """Return the powered spans up to `now_s`, derived from the events of a flight with `stages` stages.

    No span contains a time after the loss of the flight.
    """
    found = list(events)
    loss = loss_of(found)
    now_s = now_s if loss is None else min(now_s, loss.time_s)
    lift_off_s = next((e.time_s for e in found if e.name == "liftoff"), -math.inf)
    out, begin_s, cut_off_s, idle_s = list[Span](), math.inf, math.nan, 0.0
    for n in range(stages):
        mine = sorted((e for e in found if e.stage == (n + 1 if stages > 1 else 0)), key=lambda e: e.time_ns)
        named = [(event.name, event.time_s) for event in mine]
        if "separation" not in (name for name, _ in named):
            named.append(("", now_s))
        for name, time_s in named:
            if name in ("", "burnout", "separation", CUTOFF_NAME):
                if max(begin_s, lift_off_s) < min(time_s, now_s):
                    out.append(Span(n, max(begin_s, lift_off_s), min(time_s, now_s), idle_s))
                # after a separation, the next stage continues the burn
                begin_s = time_s if name == "separation" and math.isfinite(begin_s) else math.inf
            if name == CUTOFF_NAME:
                cut_off_s = time_s
            elif name == RESTART_NAME:
                idle_s += time_s - cut_off_s
            if name in (IGNITION_NAME, RESTART_NAME):
                begin_s = time_s
    return tuple(out)


def flown_run(scenario: LoadedScenario, faults: bool, log: bool = False) -> FlightRun:
    """Return a flight at its start, by default without a log.

    The grid is that of run.step_s, which contains the operating points. `faults` of False removes the failures. Flights
    of one scenario without a log compute each part of the flight once.
    """
    computer = scenario.vehicle.computer
    if log or (computer is not None and computer.law == "external"):
        return FlightRun(_on_grid(scenario, faults), log=log)
    return _Resumed(_ascent(scenario, faults))


def step_at_ns(time_s: float, step_ns: int) -> int:
    """Return the time (ns) of the integrator's step nearest to a vehicle time, for steps of equal length."""
    return round(time_s * 1e9 / step_ns) * step_ns


def flown_to(run: FlightRun, time_s: float) -> int:
    """Continue the flight to the integrator's step nearest to a vehicle time, and return the time of that step in ns.

    Raises ValueError if no engine burns at that time, and after the loss of the flight.
    """
    at_ns = step_at_ns(time_s, int(run.packed.parameters[0].timeline.step_ns))
    begins_s = run.now_s
    if at_ns < round(begins_s * 1e9):
        raise ValueError(f"operating point at {time_s:g} s: the flight begins at {begins_s:g} s; {_allowed(run)}")
    if round(run.now_s * 1e9) < at_ns:
        run.fly_segment(at_ns)
    if round(run.now_s * 1e9) != at_ns:
        events = ", ".join(f"{e.title} at {e.time_s:.4g} s" for e in run.events)
        end = f"the flight ends at {run.now_s:.6g} s ({events or 'no events'})"
        raise ValueError(f"operating point at {time_s:g} s: {end}")
    if (loss := loss_of(run.events)) is not None:
        raise ValueError(
            f"operating point at {time_s:g} s: the flight is lost before ({loss_text(loss)}); "
            "allowed are times before the loss"
        )
    held = run.memory.held
    if held.on_pad == 1 or held.burning == 0:
        why = "the vehicle is held down" if held.on_pad == 1 else "the engine does not burn"
        raise ValueError(f"operating point at {time_s:g} s: {why}; {_allowed(run)}")
    return at_ns


def _allowed(run: FlightRun) -> str:
    """Return the times under thrust according to the stage timelines, as text for a message."""
    spans: list[str] = []
    for row in run.packed.parameters:
        begin_ns, end_ns = int(row.timeline.burn_start_ns), int(row.timeline.burnout_ns)
        if begin_ns < end_ns:
            begin = f"{max(begin_ns, 0) / 1e9:.6g} s" if spans else "liftoff"
            spans.append(f"{begin} to {f'{end_ns / 1e9:.6g} s' if end_ns < NEVER else 'the end'}")
    return f"allowed are times under thrust: {', '.join(spans) or 'there are none'}"
