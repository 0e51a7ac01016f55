"""External flight code: its inputs and outputs at each sample, and its call.

Inputs and outputs are the C structs of `maxq_fsw.h`, field by field. All fields have eight bytes, and a later version
only adds fields at the end. tests/test_oracle_flight_software.py compares both structs with the layout of a C compiler.
The code is a C function at an address, which the compiled flight calls. For Python code and code behind a socket,
ctypes makes such a C function (sim/run/flight_software.py).
"""

from __future__ import annotations

import ctypes
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, NamedTuple

from llvmlite import ir
from numba import types
from numba.extending import intrinsic, overload

from maxq.control.kernel.jit import entry, kernel
from maxq.control.kernel.limits import MAX_ENGINES, MAX_PENDULUMS, MAX_SENSORS, MAX_UNITS
from maxq.control.kernel.records import Array, IntArray, Records
from maxq.control.kernel.vectors import Quaternion, quaternion_at

HEADER = Path(__file__).with_name("maxq_fsw.h")
ABI = 2
MONITORS = 8
LARGEST_RAD = 1.0e6  # limit of a command's magnitude, far below overflow
LONGEST_DELAY_S = 1000.0
THROTTLE = (0.1, 1.2)  # allowed range; 0 keeps the present throttle

HEALTH_GYRO, HEALTH_ACCELEROMETER, HEALTH_RATE_GYROS = 1, 2, 4  # bits of `FswInputs.health`
HEALTH_GNSS, HEALTH_BAROMETER, HEALTH_MAGNETOMETER = 8, 16, 32
LIFTOFF_SWITCH, FIRST_SEPARATION_SWITCH = 1, 2  # bits of `FswInputs.discretes`

OWN_ERROR, NOT_FINITE, BAD_THRUSTER, CRASHED, STUCK, OVERWROTE = range(1, 7)
ABORTED, BAD_SEPARATION, EARLY, BAD_THROTTLE, BAD_TURN, TOO_MANY = range(7, 13)
"""The faults of flight code that end a flight.

- OWN_ERROR: a return value other than 0.
- CRASHED, STUCK: detected in sim/run/guard.py.
- OVERWROTE: a change of the simulator's memory.
- ABORTED: the code has commanded an abort, whose number is `code`.
- BAD_SEPARATION, EARLY: a separation (SEPARATIONS) that is not the next one, or before the tables of the next stage.
- TOO_MANY: more ignitions than the record has room for.
"""
SEPARATIONS = ("", "stage_separation", "booster_separation", "fairing_separation")
NO_SEPARATION, STAGE_SEPARATION, BOOSTER_SEPARATION, FAIRING_SEPARATION = range(len(SEPARATIONS))


@dataclass
class FswInputs:
    """The struct `maxq_fsw_inputs`; triples are per body axis x, y, z (roll, pitch, yaw).

    - `bytes`: size of the struct.
    - `time_ns`, `time_s`: vehicle clock at the end of the sample.
    - `tick`: number of earlier samples.
    - `stage`: number of the stage, from 0.
    - `health`: bit 0 is set if all gyro increments were valid, bit 1 if the accelerometer's sample has arrived, and bit
      2 if the samples of all further rate gyros have arrived.
    - `counts`, `delta_angle_rad`: gyro pulses of the sample and the corresponding angle; without quantisation, counts
      are 0.
    - `angle_rad`: sum of `delta_angle_rad`.
    - `rate_radps`: rate in the control law: angle of the sample divided by its period, blended with further rate gyros.
    - `commanded_angle_rad`, `commanded_rate_radps`: angle and rate of the guidance programme, with injected rates.
    - `attitude_error_rad`: input of the built-in law.
    - `q_BR`, `commanded_q_BR`: measured and commanded attitude, B to R (the body at its start), scalar first.
    - `delta_velocity_mps`: specific force integrated over the sample by the accelerometer; 0 without an accelerometer.
    - `further_rate_radps`: rates of the gyros after the first.
    - `speed_mps`, `mass_kg`, `dynamic_pressure_Pa`: variables of the gain schedules (structures.py).

    Version 2:

    - `discretes`: bit 0 is set after liftoff, bit 1 + n after the separation of stage n.
    - `gnss_number`: number of GNSS solutions received so far; the last one is `gnss_r_E_m` and `gnss_v_E_mps` of the
      antenna, Earth-fixed, valid at `gnss_time_s`.
    - `pressure_Pa`: barometer. `magnetic_B_T`: magnetometer.
    - `chamber_pressure`: chamber pressure of each engine of the stage, relative to that at its largest thrust.
    - `tank_kg`: liquid in each tank with a pendulum.
    - `target_perigee_m`, `target_apogee_m`: altitudes of the target orbit; 0 without a target.
    - `target_inclination_rad`: inclination of the target orbit; -1 for the plane of flight.
    - `imu_count`: number of inertial units: gyro n and accelerometer n, from 1.
    - `imu_health`: bit n - 1 is set if both samples of unit n have arrived; a lost one leaves the previous values.
    - `imu_delta_angle_rad`, `imu_delta_velocity_mps`: increments of each unit over the sample.
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
    discretes: int
    gnss_number: int
    gnss_time_s: float
    gnss_r_E_m: Annotated[Array, (3,)]
    gnss_v_E_mps: Annotated[Array, (3,)]
    pressure_Pa: float
    magnetic_B_T: Annotated[Array, (3,)]
    chamber_pressure: Annotated[Array, (MAX_ENGINES,)]
    tank_kg: Annotated[Array, (MAX_PENDULUMS,)]
    target_perigee_m: float
    target_apogee_m: float
    target_inclination_rad: float
    imu_count: int
    imu_health: int
    imu_delta_angle_rad: Annotated[Array, (MAX_UNITS, 3)]
    imu_delta_velocity_mps: Annotated[Array, (MAX_UNITS, 3)]


@dataclass
class FswOutputs:
    """The struct `maxq_fsw_outputs`, set to 0 before each call.

    - `gimbal_rad`: commands in pitch and yaw, before the limit and the DAC, which are hardware.
    - `roll_gimbal_rad`: roll command to several groups of engines (allocation.py).
    - `roll_thruster`: demand on the roll thrusters, -1, 0 or 1.
    - `monitor`: values for the log.

    Version 2; commands of the sequence act when they change from 0 (sim/flight/sequence.py):

    - `ignition`, `cutoff`: of the engines. The cutoff takes effect `cutoff_delay_s` later than other commands.
    - `throttle`: of all engines; 0 keeps the present throttle, which is 1 at an ignition.
    - `stage_separation`, `booster_separation`, `fairing_separation`: end of the stage.
    - `abort`: a number that ends the flight.
    - `turn_thruster`: demand on the thrusters in pitch and yaw, -1, 0 or 1.
    - `commanded_q_BR`: attitude that the code commands, for the attitude error in the log; zero for that of the
      programme.
    """

    bytes: int
    gimbal_rad: Annotated[Array, (2,)]
    roll_gimbal_rad: float
    roll_thruster: int
    monitor: Annotated[Array, (MONITORS,)]
    ignition: int
    cutoff: int
    cutoff_delay_s: float
    throttle: float
    stage_separation: int
    booster_separation: int
    fairing_separation: int
    abort: int
    turn_thruster: Annotated[IntArray, (2,)]
    commanded_q_BR: Annotated[Array, (4,)]


FIRST_OF_VERSION_2 = {"inputs": "discretes", "outputs": "ignition"}
"""The first fields that version 1 lacks."""


@dataclass
class ProtectedCall:
    """The addresses with which flight code is called (sim/run/protection.py), so that it affects its outputs only.

    - `step`, `instance`: the function and its instance.
    - `given`, `given_from`, `given_bytes`: the inputs that the code receives, and those of the simulator.
    - `taken`, `taken_to`, `taken_bytes`: the outputs that the code writes, and those of the simulator.
    - `watched`: table of the simulator's memory that the code must not change, or 0. It contains the number of ranges,
      address and size of each, and room for a copy of all. It is not in shared memory.
    - `own_mode`, `code_mode`: floating-point modes of the simulator and of the code.
    - `copies`, `compares`: the functions memcpy and memcmp.
    - `get_mode`, `set_mode`: the functions fegetmode and fesetmode, else fegetenv and fesetenv, or 0.
    """

    step: int
    instance: int
    given: int
    given_from: int
    given_bytes: int
    taken: int
    taken_to: int
    taken_bytes: int
    watched: int
    own_mode: int
    code_mode: int
    copies: int
    compares: int
    get_mode: int
    set_mode: int


@dataclass
class ExternalState:
    """The state of external flight code.

    - `call`: the addresses of the code and of its memory; `step` is 0 before its start.
    - `inside`: 1 while the function runs.
    - `calls`: number of calls.
    - `invalid_before`: number of invalid inputs up to the previous sample.
    - `fault`: 0, or the fault that ends the flight.
    - `code`: return value of the function, or the invalid output (its index, or the roll demand).
    - `health`: bits of the sensors for navigation, written by the caller.
    - `gyro_lost`: 1 if the sample of the first gyro did not arrive, written by the caller.
    """

    call: ProtectedCall
    inside: int
    calls: int
    invalid_before: int
    fault: int
    code: int
    health: int
    gyro_lost: int
    inputs: FswInputs
    outputs: FswOutputs


def call_c(function: int, first: int, second: int, third: int) -> int:
    """Call the C function at an address with three integers or pointers, and return its result, an int."""
    code: int = ctypes.CFUNCTYPE(ctypes.c_int, *[ctypes.c_void_p] * 3)(int(function))(
        int(first), int(second), int(third)
    )
    return code


@intrinsic  # type: ignore[untyped-decorator]  # Numba has no types
def _call(context: Any, function: Any, first: Any, second: Any, third: Any) -> Any:
    """Call a C function without the overhead of ctypes (Numba intrinsic)."""

    def build(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        kind = ir.FunctionType(ir.IntType(32), [ir.IntType(64)] * 3)
        code = builder.call(builder.inttoptr(arguments[0], kind.as_pointer()), arguments[1:])
        return builder.sext(code, ir.IntType(64))

    return types.int64(*[types.int64] * 4), build


@overload(call_c, target="cpu")
def _call_c(function, first, second, third):  # type: ignore[no-untyped-def]  # Numba compares both signatures
    return lambda function, first, second, third: _call(function, first, second, third)  # noqa: PLW0108  # as in jit.py


def word_at(address: int) -> int:
    """Return the integer of eight bytes at an address."""
    return ctypes.c_int64.from_address(int(address)).value


@intrinsic  # type: ignore[untyped-decorator]  # Numba has no types
def _word(context: Any, address: Any) -> Any:
    """Load an integer from an address (Numba intrinsic)."""

    def build(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.load(builder.inttoptr(arguments[0], ir.IntType(64).as_pointer()))

    return types.int64(types.int64), build


@overload(word_at, target="cpu")
def _word_at(address):  # type: ignore[no-untyped-def]  # Numba compares both signatures
    return lambda address: _word(address)  # noqa: PLW0108  # as in jit.py


@kernel
def call_protected(call: ProtectedCall) -> tuple[int, int]:
    """Call flight code on a copy of its inputs, in its own floating-point environment, and copy its outputs.

    Returns the result of the code, and 1 if the code has changed watched memory, which is then restored. Without a
    function, the result is 0.
    """
    if call.step == 0:
        return 0, 0
    copy, compare, get_mode, set_mode = call.copies, call.compares, call.get_mode, call.set_mode
    own_mode, code_mode, watched = call.own_mode, call.code_mode, call.watched
    taken, taken_to, taken_bytes = call.taken, call.taken_to, call.taken_bytes
    call_c(copy, call.given, call.given_from, call.given_bytes)
    call_c(copy, taken, taken_to, taken_bytes)
    ranges = word_at(watched) if watched != 0 else 0
    kept = watched + 8 + 16 * ranges
    for k in range(ranges):
        size = word_at(watched + 16 + 16 * k)
        call_c(copy, kept, word_at(watched + 8 + 16 * k), size)
        kept += size
    if set_mode != 0:
        call_c(set_mode, code_mode, 0, 0)
    code = call_c(call.step, call.instance, call.given, taken)
    if set_mode != 0:
        call_c(get_mode, code_mode, 0, 0)
        call_c(set_mode, own_mode, 0, 0)
    changed, kept = 0, watched + 8 + 16 * ranges
    for k in range(ranges):
        place, size = word_at(watched + 8 + 16 * k), word_at(watched + 16 + 16 * k)
        if call_c(compare, kept, place, size) != 0:
            call_c(copy, place, kept, size)
            changed = 1
        kept += size
    call_c(copy, taken_to, taken, taken_bytes)
    return code, changed


@entry
def call_once(calls: Records) -> tuple[int, int]:
    """Call flight code from Python: `call_protected` of calls[0], a ProtectedCall."""
    return call_protected(calls[0])


@kernel
def clear_outputs(outputs: FswOutputs) -> None:
    for gimbal in range(2):
        outputs.gimbal_rad[gimbal] = 0.0
    outputs.roll_gimbal_rad = 0.0
    outputs.roll_thruster = 0
    for i in range(MONITORS):
        outputs.monitor[i] = 0.0
    outputs.ignition, outputs.cutoff, outputs.cutoff_delay_s, outputs.throttle = 0, 0, 0.0, 0.0
    outputs.stage_separation, outputs.booster_separation, outputs.fairing_separation, outputs.abort = 0, 0, 0, 0
    outputs.turn_thruster[0], outputs.turn_thruster[1] = 0, 0
    for i in range(4):
        outputs.commanded_q_BR[i] = 0.0


@kernel
def step_external(state: ExternalState) -> None:
    """Call the code on `state.inputs`. After a fault, record it and set all outputs to 0."""
    outputs = state.outputs
    clear_outputs(outputs)
    if state.fault != 0 or state.call.step == 0:
        return
    state.inside = 1
    state.code, changed = call_protected(state.call)
    state.inside = 0
    state.calls += 1
    if changed != 0:
        state.fault = OVERWROTE
    elif state.code != 0:
        state.fault = OWN_ERROR
    elif not -1 <= outputs.roll_thruster <= 1:
        state.fault, state.code = BAD_THRUSTER, outputs.roll_thruster
    for k in range(2):
        if state.fault == 0 and not -1 <= outputs.turn_thruster[k] <= 1:
            state.fault, state.code = BAD_TURN, outputs.turn_thruster[k]
    if state.fault == 0 and outputs.throttle != 0.0 and not THROTTLE[0] <= outputs.throttle <= THROTTLE[1]:
        state.fault, state.code = BAD_THROTTLE, 0
    if state.fault == 0 and not 0.0 <= outputs.cutoff_delay_s <= LONGEST_DELAY_S:
        state.fault, state.code = NOT_FINITE, 3
    for i in range(4):
        if state.fault == 0 and not abs(outputs.commanded_q_BR[i]) < LARGEST_RAD:
            state.fault, state.code = NOT_FINITE, 4
    for i in range(3):
        command_rad = outputs.roll_gimbal_rad if i == 2 else outputs.gimbal_rad[i]
        if state.fault == 0 and not abs(command_rad) < LARGEST_RAD:
            state.fault, state.code = NOT_FINITE, i
    if state.fault != 0:
        clear_outputs(outputs)


@kernel
def commanded_attitude(outputs: FswOutputs, programme: Quaternion) -> Quaternion:
    """Return the attitude that the code commands, of unit length, or that of the programme if the code gives none."""
    q = quaternion_at(outputs.commanded_q_BR, 0)
    length = math.sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3])
    if length == 0.0:
        return programme
    return q[0] / length, q[1] / length, q[2] / length, q[3] / length


class MonitorRow(NamedTuple):
    """The log row of the values that external flight code writes to `monitor`."""

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
