"""The faults of a scenario as writes into the array of slots that the components read."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np

from maxq.control.kernel.limits import MAX_FAULT_WRITES
from maxq.sim.flight.faults import Faults
from maxq.sim.flight.parameters import NEVER
from maxq.sim.input.values import to_ns
from maxq.sim.scenario.schema_fault import KINDS, Fault
from maxq.sim.scenario.schema_scenario import Scenario
from maxq.sim.vehicle.faults import (
    ACTUATOR_ANGLE,
    ACTUATOR_FAULT,
    BAROMETER_ADDED,
    BAROMETER_DEAD,
    BAROMETER_STUCK,
    FLOATING,
    GNSS_ADDED,
    GNSS_OUTAGE,
    GNSS_STUCK,
    GYRO_ADDED,
    GYRO_LOST,
    GYRO_WALK,
    HARD_OVER,
    LIFTOFF_SWITCH_STUCK,
    MAGNETOMETER_ADDED,
    MAGNETOMETER_DEAD,
    MAGNETOMETER_STUCK,
    SAMPLE_LOST,
    SENSOR_FAULT,
    SENSOR_SLOTS,
    SEPARATION_SWITCH_STUCK,
    STUCK,
)
from maxq.sim.vehicle.state import GYRO, N_SENSOR

_AXIS = {"roll": 0, "pitch": 1, "yaw": 2, "x": 0, "y": 1, "z": 2}


class Write(NamedTuple):
    """A write into a slot of the fault array.

    `value` is written if `state` is -1. Otherwise, the state with the index `state` at the beginning of the fault is
    written. Indices of -2 and less denote states of sensors other than the first gyro.
    """

    slot: int
    value: float = 1.0
    state: int = -1


def _sensor(fault: Fault, axis: int, gyros: int) -> tuple[Write, ...]:
    """Return the writes for lost output, added signal or added noise of a sensor's axis."""
    # sensors other than the first gyro are counted from 0, with the accelerometers after the gyros
    number = (fault.gyro or 1) - 2 if KINDS[fault.kind].part == "gyro" else gyros - 2 + (fault.accelerometer or 1)
    if fault.kind.endswith("-lost"):
        return (Write(SAMPLE_LOST + 1 + number),)
    first = GYRO_LOST if number < 0 else SENSOR_FAULT + SENSOR_SLOTS * number
    lost, added, walk = (first + slot - GYRO_LOST + axis for slot in (GYRO_LOST, GYRO_ADDED, GYRO_WALK))
    if fault.kind.endswith("-stuck"):
        own = GYRO + 2 * axis if number < 0 else -2 - N_SENSOR * number - 2 * axis
        return Write(lost), Write(added, state=own)
    if fault.kind.endswith("-dead"):
        return (Write(lost),)
    if fault.kind.endswith("-bias"):
        return (Write(added, fault.bias_mps2 or math.radians(fault.bias_degps or 0.0)),)
    return (Write(walk, (fault.noise_mps_rt_h or math.radians(fault.noise_deg_rt_h or 0.0)) / 60.0),)


def _actuator(fault: Fault, axis: int, gyros: int) -> tuple[Write, ...]:
    channel = 2 * (fault.group or 0) + axis - 1
    state = {"actuator-stuck": STUCK, "actuator-hard-over": HARD_OVER, "actuator-floating": FLOATING}[fault.kind]
    angle = math.radians(fault.angle_deg or 0.0)
    return Write(ACTUATOR_FAULT + channel, state), Write(ACTUATOR_ANGLE + channel, angle)


def _gnss(fault: Fault, axis: int, gyros: int) -> tuple[Write, ...]:
    if fault.kind == "gnss-bias":
        assert fault.position_bias_m is not None
        return tuple(Write(GNSS_ADDED + k, added_m) for k, added_m in enumerate(fault.position_bias_m))
    return (Write(GNSS_OUTAGE if fault.kind == "gnss-outage" else GNSS_STUCK),)


def _barometer(fault: Fault, axis: int, gyros: int) -> tuple[Write, ...]:
    if fault.kind == "barometer-bias":
        return (Write(BAROMETER_ADDED, fault.bias_Pa or 0.0),)
    return (Write(BAROMETER_STUCK if fault.kind == "barometer-stuck" else BAROMETER_DEAD),)


def _magnetometer(fault: Fault, axis: int, gyros: int) -> tuple[Write, ...]:
    if fault.kind == "magnetometer-bias":
        return (Write(MAGNETOMETER_ADDED + axis, 1e-9 * (fault.bias_nT or 0.0)),)
    return (Write(MAGNETOMETER_STUCK if fault.kind == "magnetometer-stuck" else MAGNETOMETER_DEAD),)


def _switch(fault: Fault, axis: int, gyros: int) -> tuple[Write, ...]:
    return (Write(LIFTOFF_SWITCH_STUCK if fault.switch == "liftoff" else SEPARATION_SWITCH_STUCK),)


WRITES: dict[str, Callable[[Fault, int, int], tuple[Write, ...]]] = {
    "engine": lambda *_: (),  # the effect over time is known in advance: packing/schedule.py
    "gyro": _sensor,
    "accelerometer": _sensor,
    "actuator": _actuator,
    "gnss": _gnss,
    "barometer": _barometer,
    "magnetometer": _magnetometer,
    "computer": _switch,
}
"""The functions that return the writes of a fault, by failed part.

Their arguments are the fault, its axis (0 roll or x, 1 pitch or y, 2 yaw or z; 0 for a part without axes) and the
number of gyros.
"""


def pack_faults(scenario: Scenario) -> Faults:
    gyros = 1 + len(scenario.vehicle.stage[0].rate_gyro)
    rows = [row for fault in scenario.fault for row in _rows(fault, gyros)]
    assert len(rows) <= MAX_FAULT_WRITES
    columns = [np.zeros(MAX_FAULT_WRITES, float if k == 5 else np.int64) for k in range(7)]
    for column, given in zip(columns, zip(*rows, strict=True), strict=False):
        column[: len(rows)] = given
    return Faults(len(rows), *columns)


def _rows(fault: Fault, gyros: int) -> Iterator[tuple[float, ...]]:
    """Yield a row of `Faults` for each write of a fault, with the columns in order."""
    start_ns, stop_ns = to_ns(fault.at_s), NEVER if fault.until_s is None else to_ns(fault.until_s)
    stage, since_liftoff = -1 if fault.stage is None else fault.stage, int(fault.since == "liftoff")
    for axis in fault.axes or ("roll",):
        for write in WRITES[KINDS[fault.kind].part](fault, _AXIS[axis], gyros):
            yield stage, start_ns, stop_ns, since_liftoff, *write
