"""Faults of the scenario: what they write into the array that the components read, and when.

Their instants are known beforehand, or once the vehicle has lifted off, so that no step reaches over one.
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
    """Writes into slots (sim/vehicle/faults.py), a row each; of two into one slot the later row holds."""

    count: int
    stage: Annotated[IntArray, (MAX_FAULT_WRITES,)]  # -1: whichever flies
    start_ns: Annotated[IntArray, (MAX_FAULT_WRITES,)]
    stop_ns: Annotated[IntArray, (MAX_FAULT_WRITES,)]
    since_liftoff: Annotated[IntArray, (MAX_FAULT_WRITES,)]  # 1: both count from liftoff
    slot: Annotated[IntArray, (MAX_FAULT_WRITES,)]
    value: Annotated[Array, (MAX_FAULT_WRITES,)]
    # of the state whose value as the fault begins is written: its number, -1 for none, or -2 less its number among
    # those of the sensors beyond the gyro, which have another place in each stage
    state: Annotated[IntArray, (MAX_FAULT_WRITES,)]


@dataclass
class FaultMemory:
    """By row: whether it holds at present, and what it writes."""

    next_ns: int  # when a fault begins or ends; the first instant of the flight is one
    on: Annotated[IntArray, (MAX_FAULT_WRITES,)]
    written: Annotated[Array, (MAX_FAULT_WRITES,)]


@kernel
def fault_instant(instant_ns: int, since_liftoff: int, liftoff_ns: int, never_ns: int) -> int:
    """Flight time of an instant that may count from liftoff, which may not have come (negative)."""
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
    """Write into `slots` what holds from now on, and into the memory when that changes next.

    `sensors`: where the states of the sensors beyond the gyro begin.
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
