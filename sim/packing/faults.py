"""Faults of the scenario as writes into the array that the components read: one entry for each kind."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np

from maxq.control.kernel.limits import MAX_FAULT_WRITES
from maxq.sim.flight.faults import Faults
from maxq.sim.flight.parameters import NEVER
from maxq.sim.scenario.schema_fault import Fault, FaultKind
from maxq.sim.scenario.schema_scenario import Scenario
from maxq.sim.scenario.schema_values import to_ns
from maxq.sim.vehicle.faults import (
    ACTUATOR_ANGLE,
    ACTUATOR_FAULT,
    FLOATING,
    GYRO_ADDED,
    GYRO_LOST,
    GYRO_WALK,
    HARD_OVER,
    STUCK,
)
from maxq.sim.vehicle.state import GYRO

_AXIS = {"roll": 0, "pitch": 1, "yaw": 2}


class Write(NamedTuple):
    """`value`, or that of `state` as the fault begins, into a slot."""

    slot: int
    value: float = 1.0
    state: int = -1


def _gyro_stuck(fault: Fault, axis: int) -> tuple[Write, ...]:
    return Write(GYRO_LOST + axis), Write(GYRO_ADDED + axis, state=GYRO + 2 * axis)


def _gyro_dead(fault: Fault, axis: int) -> tuple[Write, ...]:
    return (Write(GYRO_LOST + axis),)


def _gyro_bias(fault: Fault, axis: int) -> tuple[Write, ...]:
    return (Write(GYRO_ADDED + axis, math.radians(fault.bias_degps or 0.0)),)


def _gyro_noisy(fault: Fault, axis: int) -> tuple[Write, ...]:
    return (Write(GYRO_WALK + axis, math.radians(fault.noise_deg_rt_h or 0.0) / 60.0),)


def _nothing(fault: Fault, axis: int) -> tuple[Write, ...]:
    """What an engine does over time is known beforehand, and stands in the stage's tables (packing/schedule.py)."""
    return ()


def _actuator(fault: Fault, axis: int) -> tuple[Write, ...]:
    channel = 2 * (fault.group or 0) + axis - 1
    state = {"actuator-stuck": STUCK, "actuator-hard-over": HARD_OVER, "actuator-floating": FLOATING}[fault.kind]
    angle = math.radians(fault.angle_deg or 0.0)
    return Write(ACTUATOR_FAULT + channel, state), Write(ACTUATOR_ANGLE + channel, angle)


WRITES: dict[FaultKind, Callable[[Fault, int], tuple[Write, ...]]] = {
    "engine-off": _nothing,
    "thrust-loss": _nothing,
    "gyro-stuck": _gyro_stuck,
    "gyro-dead": _gyro_dead,
    "gyro-bias": _gyro_bias,
    "gyro-noisy": _gyro_noisy,
    "actuator-stuck": _actuator,
    "actuator-hard-over": _actuator,
    "actuator-floating": _actuator,
}
"""What a kind of fault does on an axis (0 roll, 1 pitch, 2 yaw; 0 where the kind has no axes)."""


def pack_faults(scenario: Scenario) -> Faults:
    rows = [row for fault in scenario.fault for row in _rows(fault)]
    assert len(rows) <= MAX_FAULT_WRITES
    columns = [np.zeros(MAX_FAULT_WRITES, float if k == 5 else np.int64) for k in range(7)]
    for column, given in zip(columns, zip(*rows, strict=True), strict=False):
        column[: len(rows)] = given
    return Faults(len(rows), *columns)


def _rows(fault: Fault) -> Iterator[tuple[float, ...]]:
    """Columns of `Faults` in their order."""
    start_ns, stop_ns = to_ns(fault.at_s), NEVER if fault.until_s is None else to_ns(fault.until_s)
    stage, since_liftoff = -1 if fault.stage is None else fault.stage, int(fault.since == "liftoff")
    for axis in fault.axes or ("roll",):
        for write in WRITES[fault.kind](fault, _AXIS[axis]):
            yield stage, start_ns, stop_ns, since_liftoff, *write
