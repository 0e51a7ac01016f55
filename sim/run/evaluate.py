"""The simulator's derivative and its by-products at a given state and time, apart from a flight."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from maxq.control.kernel.jit import bare_pointer, entry
from maxq.control.kernel.records import Array, Records
from maxq.control.kernel.tables import find_interval
from maxq.sim.flight.loop import begin
from maxq.sim.flight.step import evaluate, read_schedule, schedule_clock
from maxq.sim.packing.flight import Packed
from maxq.sim.vehicle.state import MAX_STATE
from maxq.sim.vehicle.workspace import AUX_SIZE, PROPERTIES_SIZE, WORK_SIZE, Evaluation


class Instant(NamedTuple):
    """An evaluation of the simulator: derivative (MAX_STATE,) and `aux` (AUX_SIZE,)."""

    rate: Array
    aux: Array


def evaluate_at(packed: Packed, y: Array, time_s: float) -> Instant:
    """The simulator's derivative and loads at a state (MAX_STATE,) and flight time, gimbal commands as held.

    `packed` may be at its start or in mid-flight (its stage, and whether it burns or is held down, count); it is not
    changed.
    """
    memory = packed.memory.copy()
    if memory[0].clock.started == 0:
        begin(packed.parameters, packed.pool, memory, packed.state.copy())
    properties, dy, work, aux = (np.zeros(n) for n in (PROPERTIES_SIZE, MAX_STATE, WORK_SIZE, AUX_SIZE))
    _evaluate(packed.parameters, packed.pool, memory, y, round(1e9 * time_s), properties, dy, work, aux)
    return Instant(dy, aux)


@entry
def _evaluate(
    P: Records,
    pool: Array,
    state: Records,
    y: Array,
    now_ns: int,
    properties: Array,
    dy: Array,
    work: Array,
    aux: Array,
) -> None:
    """Derivative of `y` and its by-products at the instant `now_ns`; `P` of Parameters, `state` of Memory."""
    memory = state[0]
    p = P[memory.clock.stage]
    pool, y, properties = bare_pointer(pool), bare_pointer(y), bare_pointer(properties)
    dy, work, aux = bare_pointer(dy), bare_pointer(work), bare_pointer(aux)
    memory.clock.interval = find_interval(pool, p.vehicle.schedule, schedule_clock(p, now_ns, 0.0))
    read_schedule(p, pool, memory, now_ns, 0.0, properties)
    evaluate(p, pool, memory, now_ns, 0.0, Evaluation(properties, y, dy, aux), work)
