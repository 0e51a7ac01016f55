"""The simulator's derivative and its by-products at a given state and time, apart from a flight."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from maxq.control.kernel.jit import bare_pointer, entry
from maxq.control.kernel.records import Array, Records, blank
from maxq.control.kernel.tables import find_interval
from maxq.sim.flight.loop import begin
from maxq.sim.flight.step import evaluate, read_schedule, schedule_clock
from maxq.sim.packing.flight import Packed
from maxq.sim.vehicle.loads import MAX_LOAD_COLUMNS, SECTION_WIDTH, evaluate_sections
from maxq.sim.vehicle.outputs import Aux, Evaluation
from maxq.sim.vehicle.state import MAX_STATE
from maxq.sim.vehicle.workspace import PROPERTIES_SIZE, WORK_SIZE


class Instant(NamedTuple):
    """An evaluation of the simulator: derivative (MAX_STATE,), auxiliary outputs and section loads (stations, 5):
    axial force, shear along y and z (N), bending moment about y and z (N m), as sim/vehicle/loads.py signs them.
    """

    rate: Array
    aux: Aux
    sections: Array


def evaluate_at(packed: Packed, y: Array, time_s: float) -> Instant:
    """The simulator's derivative and loads at a state (MAX_STATE,) and flight time, gimbal commands as held.

    `packed` may be at its start or in mid-flight (its stage, and whether it burns or is held down, count); it is not
    changed.
    """
    memory = packed.memory.copy()
    if memory[0].clock.started == 0:
        begin(packed.parameters, packed.pool, memory, packed.state.copy())
    properties, dy, work, columns = (np.zeros(n) for n in (PROPERTIES_SIZE, MAX_STATE, WORK_SIZE, MAX_LOAD_COLUMNS))
    now_ns, aux = round(1e9 * time_s), blank(Aux)
    evaluate_into(packed.parameters, packed.pool, memory, y, now_ns, 0.0, properties, dy, work, aux, columns)
    stations = int(packed.parameters[int(memory[0].clock.stage)].loads.stations)
    return Instant(dy, aux[0], memory[0].sections.section.reshape(-1, SECTION_WIDTH)[:stations].copy())


@entry
def evaluate_into(
    P: Records, pool: Array, state: Records, y: Array, now_ns: int, elapsed_s: float, properties: Array, dy: Array,
    work: Array, aux: Records, columns: Array,
) -> None:  # fmt: skip  # twelve lines otherwise
    """Derivative of `y` and its by-products `elapsed_s` into a step that starts at the instant `now_ns`, with section
    loads where there are stations; `P` of Parameters, `state` of Memory, `aux` (1,) of Aux.
    """
    memory = state[0]
    p = P[memory.clock.stage]
    pool, y, properties = bare_pointer(pool), bare_pointer(y), bare_pointer(properties)
    dy, work = bare_pointer(dy), bare_pointer(work)
    # a step lies in one interval of the schedule; breakpoints are met to the nanosecond
    within_s = schedule_clock(p, memory.clock, now_ns, 1e-9)
    memory.clock.interval = find_interval(pool, p.vehicle.schedule, within_s)
    read_schedule(p, pool, memory, now_ns, elapsed_s, properties)
    at = Evaluation(properties, y, dy, aux[0])
    evaluate(p, pool, memory, now_ns, elapsed_s, at, work)
    if p.loads.stations > 0:
        columns = bare_pointer(columns)
        clock_s = schedule_clock(p, memory.clock, now_ns, elapsed_s)
        evaluate_sections(p.loads, p.vehicle, memory.inputs, pool, clock_s, at, work, columns, memory.sections)
