"""Flight code from outside: what it is given at each sample, what it gives back, and the call.

Inputs and outputs are the C structs of `maxq_fsw.h`, field for field: all fields have eight bytes, and a later version
only adds fields at the end (tests/test_oracle_flight_software.py compares both with a C compiler's view). The code is a
C function at an address, called from the compiled flight; Python code and code behind a socket are C functions that
ctypes makes (sim/run/flight_software.py).
"""

from __future__ import annotations

import ctypes
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, NamedTuple

from llvmlite import ir
from numba import types
from numba.extending import intrinsic, overload

from maxq.control.kernel.jit import kernel
from maxq.control.kernel.limits import MAX_SENSORS
from maxq.control.kernel.records import Array, IntArray

HEADER = Path(__file__).with_name("maxq_fsw.h")
ABI = 1
MONITORS = 8
LARGEST_RAD = 1.0e6  # of a command: far from what arithmetic cannot hold

HEALTH_ACCELEROMETER, HEALTH_RATE_GYROS = 2, 4  # bits of `FswInputs.health`

OWN_ERROR, NOT_FINITE, BAD_THRUSTER, CRASHED, STUCK = range(1, 6)
"""Faults with which flight code ends a flight. Crashed, stuck: seen from outside (sim/run/flight_software.py)."""


@dataclass
class FswInputs:
    """`maxq_fsw_inputs`. Triples are per body axis x, y, z (roll, pitch, yaw).

    `bytes`: size of the struct. `time_ns`, `time_s`: vehicle clock at the end of the sample. `tick`: samples before
    this one. `stage`: from 0. `health`: bit 0, all gyro increments were valid; bits 1 and 2, the accelerometer's and
    all further rate gyros' samples have arrived.

    `counts`, `delta_angle_rad`: gyro pulses of the sample and the angle that they mean; without quantisation counts are
    0. `angle_rad`: sum of the angles. `rate_radps`: angle of the sample over its period. `commanded_angle_rad`,
    `commanded_rate_radps`: of the guidance programme, with injected rates. `attitude_error_rad`: what the built-in law
    works on. `q_BR`, `commanded_q_BR`: attitude by the counts and of the guidance, B to R (the body
    at its start), scalar first.

    `delta_velocity_mps`: specific force over the sample, by the accelerometer; 0 without one. `further_rate_radps`: of
    rate gyros beyond the first, as `rate_radps`. `speed_mps`, `mass_kg`, `dynamic_pressure_Pa`: as gains may be
    scheduled over (structures.py).
    """

    bytes: int
    time_ns: int
    tick: int
    stage: int
    health: int
    time_s: float
    counts: Annotated[IntArray, (3,)]
    delta_angle_rad: Annotated[Array, (3,)]
    angle_rad: Annotated[Array, (3,)]
    rate_radps: Annotated[Array, (3,)]
    commanded_angle_rad: Annotated[Array, (3,)]
    commanded_rate_radps: Annotated[Array, (3,)]
    attitude_error_rad: Annotated[Array, (3,)]
    q_BR: Annotated[Array, (4,)]
    commanded_q_BR: Annotated[Array, (4,)]
    delta_velocity_mps: Annotated[Array, (3,)]
    further_rate_radps: Annotated[Array, (MAX_SENSORS - 1, 3)]
    speed_mps: float
    mass_kg: float
    dynamic_pressure_Pa: float


@dataclass
class FswOutputs:
    """`maxq_fsw_outputs`; all 0 before each call.

    `gimbal_rad`: commands in pitch and yaw before limit and DAC, which are hardware. `roll_gimbal_rad`: command in roll
    to several groups of engines (allocation.py). `roll_thruster`: -1, 0 or 1. `monitor`: for the log.
    """

    bytes: int
    gimbal_rad: Annotated[Array, (2,)]
    roll_gimbal_rad: float
    roll_thruster: int
    monitor: Annotated[Array, (MONITORS,)]


@dataclass
class ExternalState:
    """`step`, `instance`: addresses of the function and of its instance. `inside`: 1 while it runs. `calls`: so far.

    `invalid_before`: invalid inputs up to the sample before. `fault`: 0, or why the flight ends; `code`: what the
    function returned, or which output is wrong.
    """

    step: int
    instance: int
    inside: int
    calls: int
    invalid_before: int
    fault: int
    code: int
    inputs: FswInputs
    outputs: FswOutputs


def _address_of(record: Any) -> int:
    address: int = record.__array_interface__["data"][0]
    return address


def call_step(step: int, instance: int, inputs: FswInputs, outputs: FswOutputs) -> int:
    """Return the value that the C function at the address `step` returns for an instance."""
    function = ctypes.CFUNCTYPE(ctypes.c_int, *[ctypes.c_void_p] * 3)(step)
    code: int = function(instance, _address_of(inputs), _address_of(outputs))
    return code


@intrinsic  # type: ignore[untyped-decorator]  # Numba has no types
def _call(context: Any, step: Any, instance: Any, inputs: Any, outputs: Any) -> Any:
    """Numba intrinsic: records are addresses, so that the call costs what it costs in C."""

    def build(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        pointer = ir.IntType(8).as_pointer()
        kind = ir.FunctionType(ir.IntType(32), [pointer] * 3)
        function = builder.inttoptr(arguments[0], kind.as_pointer())
        records = [builder.bitcast(argument, pointer) for argument in arguments[2:]]
        code = builder.call(function, [builder.inttoptr(arguments[1], pointer), *records])
        return builder.sext(code, ir.IntType(64))

    return types.int64(step, instance, inputs, outputs), build


@overload(call_step, target="cpu")
def _call_step(step, instance, inputs, outputs):  # type: ignore[no-untyped-def]  # Numba compares both signatures
    return lambda step, instance, inputs, outputs: _call(step, instance, inputs, outputs)  # noqa: PLW0108  # as in jit.py


@kernel
def clear_outputs(outputs: FswOutputs) -> None:
    for gimbal in range(2):
        outputs.gimbal_rad[gimbal] = 0.0
    outputs.roll_gimbal_rad = 0.0
    outputs.roll_thruster = 0
    for i in range(MONITORS):
        outputs.monitor[i] = 0.0


@kernel
def step_external(state: ExternalState) -> None:
    """Call the code on `state.inputs`. Outputs that cannot be used become 0 and a fault."""
    inputs, outputs = state.inputs, state.outputs
    clear_outputs(outputs)
    if state.fault != 0 or state.step == 0:
        return
    state.inside = 1
    state.code = call_step(state.step, state.instance, inputs, outputs)
    state.inside = 0
    state.calls += 1
    if state.code != 0:
        state.fault = OWN_ERROR
    elif not -1 <= outputs.roll_thruster <= 1:
        state.fault, state.code = BAD_THRUSTER, outputs.roll_thruster
    for i in range(3):
        command_rad = outputs.roll_gimbal_rad if i == 2 else outputs.gimbal_rad[i]
        if state.fault == 0 and not abs(command_rad) < LARGEST_RAD:
            state.fault, state.code = NOT_FINITE, i
    if state.fault != 0:
        clear_outputs(outputs)


class MonitorRow(NamedTuple):
    """The values that external flight code passes to the log."""

    monitor_1: Annotated[float, "1", "monitor[0] of the flight code"]
    monitor_2: Annotated[float, "1", "monitor[1] of the flight code"]
    monitor_3: Annotated[float, "1", "monitor[2] of the flight code"]
    monitor_4: Annotated[float, "1", "monitor[3] of the flight code"]
    monitor_5: Annotated[float, "1", "monitor[4] of the flight code"]
    monitor_6: Annotated[float, "1", "monitor[5] of the flight code"]
    monitor_7: Annotated[float, "1", "monitor[6] of the flight code"]
    monitor_8: Annotated[float, "1", "monitor[7] of the flight code"]


@kernel
def monitor_row(state: ExternalState) -> MonitorRow:
    m = state.outputs.monitor
    return MonitorRow(m[0], m[1], m[2], m[3], m[4], m[5], m[6], m[7])
