"""What has happened in a flight so far: its events, stage by stage, read from the flight's memory."""

from __future__ import annotations

import math
from dataclasses import dataclass

from maxq.sim.flight.parameters import (
    BURNOUT,
    CAUSES,
    CONTROL_LOST,
    DIVERGED,
    EVENT_NAMES,
    NEVER,
    SEPARATION,
)
from maxq.sim.packing.flight import CONTROL_LOST_RAD, Packed
from maxq.sim.scenario.nanoseconds import to_ns

IGNITION_NAME = "ignition"
BURNOUT_NAME, SEPARATION_NAME = EVENT_NAMES[BURNOUT], EVENT_NAMES[SEPARATION]
CONTROL_LOST_NAME, DIVERGED_NAME = EVENT_NAMES[CONTROL_LOST], EVENT_NAMES[DIVERGED]
CONTROL_LOST_CAUSE = f"the attitude error exceeds {math.degrees(CONTROL_LOST_RAD):.3g} deg under thrust"


@dataclass(frozen=True)
class Event:
    """`stage` counts from 1 on a vehicle of several stages; 0 where it is not a matter of stages."""

    name: str
    time_ns: int
    stage: int = 0

    @property
    def time_s(self) -> float:
        return self.time_ns / 1e9


def events_so_far(packed: Packed, start_s: float) -> tuple[Event, ...]:
    """All events in order of time: one ignition, burn-out and separation for each stage that had it."""
    clock = packed.memory[0].clock
    stages = len(packed.parameters)
    found = []
    for index in range(int(clock.stage) + 1):
        number = index + 1 if stages > 1 else 0
        ignition_ns = int(packed.parameters[index].timeline.burn_start_ns)
        if to_ns(start_s) <= ignition_ns <= int(clock.now_ns) and ignition_ns < NEVER:
            found.append(Event(IGNITION_NAME, ignition_ns, number))
        for name, times_ns in (
            (BURNOUT_NAME, clock.stage_burnout_ns),
            (SEPARATION_NAME, clock.stage_separation_ns),
        ):
            if times_ns[index] >= 0:
                found.append(Event(name, int(times_ns[index]), number))
    for name, time_ns in zip(EVENT_NAMES, clock.event_ns, strict=True):
        if time_ns >= 0 and name not in (BURNOUT_NAME, SEPARATION_NAME):
            found.append(Event(name, int(time_ns)))
    return tuple(sorted(found, key=lambda event: event.time_ns))


def outcome_so_far(packed: Packed) -> str:
    """`diverged`, the event of run.stop_at that ended the flight, `duration`, or `interrupted`."""
    clock = packed.memory[0].clock
    stop_mask = int(packed.parameters[int(clock.stage)].timeline.stop_mask)
    events_ns, now_ns = clock.event_ns.tolist(), int(clock.now_ns)
    if events_ns[DIVERGED] >= 0:
        return DIVERGED_NAME
    if not clock.finished:
        return "interrupted"
    for index, (name, time_ns) in enumerate(zip(EVENT_NAMES, events_ns, strict=True)):
        if (stop_mask >> index) & 1 and time_ns == now_ns:
            return name
    return "duration"


def cause_of(event: Event, packed: Packed) -> str:
    """Why something went wrong; empty for an event that is no fault."""
    if event.name == DIVERGED_NAME:
        return CAUSES[int(packed.memory[0].clock.cause)]
    return CONTROL_LOST_CAUSE if event.name == CONTROL_LOST_NAME else ""
