"""The evaluation of the simulator's derivative and loads at a given state and time, without a flight."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, NamedTuple

from maxq.control.kernel.jit import bare_pointer, entry
from maxq.control.kernel.records import Array, Records, blank, duplicate
from maxq.control.kernel.tables import find_interval
from maxq.sim.flight.loop import begin
from maxq.sim.flight.step import evaluate, read_schedule, schedule_clock
from maxq.sim.packing.flight import Packed
from maxq.sim.vehicle.loads.columns import MAX_LOAD_COLUMNS, SECTION_WIDTH
from maxq.sim.vehicle.loads.kernel import evaluate_sections
from maxq.sim.vehicle.state import MAX_STATE
from maxq.sim.vehicle.workspace import PROPERTIES_SIZE, Aux, Evaluation, Work


@dataclass
class Space:
    """The work memory of an evaluation."""

    properties: Annotated[Array, (PROPERTIES_SIZE,)]
    rate: Annotated[Array, (MAX_STATE,)]
    work: Work
    aux: Aux
    columns: Annotated[Array, (MAX_LOAD_COLUMNS,)]  # columns of section loads


class Instant(NamedTuple):
    """An evaluation of the simulator: derivative (MAX_STATE,), auxiliary outputs and section loads (stations, 5).

    The section loads are axial force, shear along y and z (N), bending moment about y and z (N m), with the signs of
    sim/vehicle/loads/kernel.py.
    """

    rate: Array
    aux: Aux
    sections: Array


def evaluate_at(packed: Packed, y: Array, time_s: float) -> Instant:
    """Return the simulator's derivative and loads at a state `y` (MAX_STATE,) and a flight time, s.

    `packed` may be at its start or in flight; it is not changed. Its memory gives the stage, the gimbal commands, and
    the states of burn and hold-down.
    """
    memory = duplicate(packed.memory)
    if memory[0].clock.started == 0:
        begin(packed.parameters, packed.pool, memory, packed.state.copy())
    space = blank(Space)
    evaluate_into(packed.parameters, packed.pool, memory, y, round(1e9 * time_s), 0.0, space)
    stations = int(packed.parameters[int(memory[0].clock.stage)].loads.stations)
    return Instant(space[0].rate, space[0].aux, memory[0].sections.section.reshape(-1, SECTION_WIDTH)[:stations].copy())


@entry
def evaluate_into(
    P: Records, pool: Array, state: Records, y: Array, now_ns: int, elapsed_s: float, space: Records
) -> None:
    """Evaluate the derivative of `y` and the auxiliary outputs at `elapsed_s` after `now_ns`, the start of a step.

    Section loads are evaluated if there are stations. `P` is of Parameters, `state` of Memory, and `space` of Space.
    The results are written into `space` and `state`.
    """
    memory, room = state[0], space[0]
    p = P[memory.clock.stage]
    pool, y, properties = bare_pointer(pool), bare_pointer(y), room.properties
    # a step is within an interval of the schedule, and breakpoints are exact to the nanosecond
    within_s = schedule_clock(p, memory.clock, now_ns, 1e-9)
    memory.clock.interval = find_interval(pool, p.vehicle.schedule, within_s)
    read_schedule(p, pool, memory, now_ns, elapsed_s, properties)
    at = Evaluation(properties, y, room.rate, room.aux)
    evaluate(p, pool, memory, now_ns, elapsed_s, at, room.work)
    if p.loads.stations > 0:
        columns = room.columns
        clock_s = schedule_clock(p, memory.clock, now_ns, elapsed_s)
        evaluate_sections(p.loads, p.vehicle, memory.inputs, pool, clock_s, at, room.work, columns, memory.sections)
