"""The faults of a scenario in flight: values and times of their writes into the array that the components read.

The instants are known in advance, or once the vehicle has lifted off, so that no step extends beyond such an instant.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from maxq.control.kernel.jit import kernel, routine
from maxq.control.kernel.limits import MAX_FAULT_WRITES
from maxq.control.kernel.records import Array, IntArray
from maxq.sim.vehicle.faults import ANY_FAULT, N_FAULT_SLOTS


@dataclass(frozen=True)
class Faults:
    """The writes into slots (sim/vehicle/faults.py), one per row.

    If two active rows write to the same slot, the later row applies.
    """

    count: int
    stage: Annotated[IntArray, (MAX_FAULT_WRITES,)]  # stage in which the row applies; -1: any
    start_ns: Annotated[IntArray, (MAX_FAULT_WRITES,)]
    stop_ns: Annotated[IntArray, (MAX_FAULT_WRITES,)]
    since_liftoff: Annotated[IntArray, (MAX_FAULT_WRITES,)]  # 1: both times count from liftoff
    slot: Annotated[IntArray, (MAX_FAULT_WRITES,)]
    value: Annotated[Array, (MAX_FAULT_WRITES,)]
    # index of a state whose value at the start of the fault is written; -1 for none; -2 minus the index among the
    # states of the sensors after the gyro, whose place differs between stages
    state: Annotated[IntArray, (MAX_FAULT_WRITES,)]


@dataclass
class FaultMemory:
    """The state of the faults by row: 1 if the fault is active, and its value."""

    next_ns: int  # next instant at which a fault begins or ends; initially the first instant of the flight
    on: Annotated[IntArray, (MAX_FAULT_WRITES,)]
    written: Annotated[Array, (MAX_FAULT_WRITES,)]


@kernel
def fault_instant(instant_ns: int, since_liftoff: int, liftoff_ns: int, never_ns: int) -> int:
    """Return the flight time of an instant, which may count from liftoff; `liftoff_ns` is negative before liftoff."""
    if since_liftoff == 0 or instant_ns == never_ns:
        return instant_ns
    return never_ns if liftoff_ns < 0 else liftoff_ns + instant_ns


@routine
def switch_faults(
    faults: Faults,
    memory: FaultMemory,
    now_ns: int,
    liftoff_ns: int,
    never_ns: int,
    stage: int,
    sensors: int,
    y: Array,
    slots: Array,
) -> None:
    """Write the current values into `slots`, and the instant of the next change into `memory`.

    `sensors`: index of the first state of the sensors after the gyro.
    """
    for slot in range(N_FAULT_SLOTS):
        slots[slot] = 0.0
    memory.next_ns = never_ns
    for row in range(faults.count):
        start_ns = fault_instant(faults.start_ns[row], faults.since_liftoff[row], liftoff_ns, never_ns)
        stop_ns = fault_instant(faults.stop_ns[row], faults.since_liftoff[row], liftoff_ns, never_ns)
        on = start_ns <= now_ns < stop_ns
        if start_ns > now_ns:
            memory.next_ns = min(memory.next_ns, start_ns)
        elif on:
            memory.next_ns = min(memory.next_ns, stop_ns)
        if not on or (faults.stage[row] >= 0 and faults.stage[row] != stage):
            memory.on[row] = 0
            continue
        if memory.on[row] == 0:
            memory.on[row] = 1
            state = faults.state[row] if faults.state[row] >= -1 else sensors - 2 - faults.state[row]
            memory.written[row] = y[state] if state >= 0 else faults.value[row]
        slots[ANY_FAULT] = 1.0
        slots[faults.slot[row]] = memory.written[row]
