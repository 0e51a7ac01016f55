"""The external flight code of a held flight, which receives the inputs of an ascent in addition to deviations.

A held flight (design/certificate/held_flight.py) remains at an operating point for minutes. Flight code could detect
the test from its clock, mass, speed and attitude. The code therefore receives the inputs of a flight through the
operating point, plus the deviations of the held flight (control/held_inputs.py). The held vehicle receives the code's
commands minus those of that flight. Without deviations, the code receives the inputs of that flight, bit for bit.

The clock of the code cannot remain at an operating point for minutes. The held flight is therefore divided into windows
of at most `WINDOW_S` about the time of the operating point, each with a new instance of the code:

1. The instance receives all inputs of the flight from its start. Its commands must equal those of the flight, bit for
   bit.
2. During the last seconds before the window, the deviations of the held flight are added gradually. The instance thus
   reaches the state that belongs to the motion of the vehicle, which the preceding instance has commanded.
3. In the window, the instance commands the vehicle, while its clock, mass and speed advance as in the flight.

Scheduled gains thus vary within a window, in the same way in every window. Their mean is that of the operating point,
so that a growth rate or response changes only to second order. The lengths of the windows differ, which spreads the
lines at multiples of their rate.

The integral of an instance does not contain the deviations before step 2. The command of a linear law therefore differs
by a constant from that of the preceding instance. This constant follows from both commands for the same deviations
(`command_offset`), and is added in the window.
"""

from __future__ import annotations

import ctypes
import math
import sys
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from maxq.control.external import FswInputs, FswOutputs, ProtectedCall, call_once
from maxq.control.held_inputs import Superposition, superpose
from maxq.control.kernel.records import Array, Records, blank, dtype_of
from maxq.sim.run.instances import Instance, Outputs, Setup, StepFunction, ended, started
from maxq.sim.run.protection import OVERWROTE_TEXT, FloatingPoint, MemoryRanges
from maxq.sim.scenario.python_file import described, imported
from maxq.sim.scenario.schema_vehicle import ComputerSection

WINDOW_S, SHORTEST_S, SHORTER = 5.0, 2.0, 0.3
LISTENED_S, LEAST_LISTENED_S, GRADUAL_S = 6.0, 1.5, 2.0
UNEXPLAINED_SHARE = 0.05
DIFFERS = "gives other commands for the same inputs"
"""The beginning of the error message for flight code that fails the replay check."""

_IN, _OUT = dtype_of(FswInputs), dtype_of(FswOutputs)
_COMMANDS = ("gimbal_rad[0]", "gimbal_rad[1]", "roll_gimbal_rad", "roll_thruster")


@dataclass(frozen=True)
class Tape:
    """The inputs and outputs (samples,) of flight code at all samples of a flight, and the setup at its start.

    `start_q_BR`: attitude in the computer before the first sample, which contains its error of alignment.
    """

    setup: bytes
    inputs: Records
    outputs: Records
    start_q_BR: tuple[float, ...] = (1.0, 0.0, 0.0, 0.0)

    @property
    def commands(self) -> Array:
        return commands_of(self.outputs)


def commands_of(outputs: Records) -> Array:
    """Return the commands (samples, 4): gimbal angles in pitch, yaw and roll, rad, and the roll thruster."""
    return np.column_stack([outputs["gimbal_rad"], outputs["roll_gimbal_rad"], outputs["roll_thruster"]])


@dataclass(frozen=True)
class CodeWindows:
    """The windows of a held flight, as ranges of rows of the code's tape about the row of the operating point, `row`.

    - `first`, `last`: first and last row of the stage.
    - `rounded`: True if the gyro angles of the held flight are rounded to pulses, as on the tape.
    - `method`, `limit_rad`: method and limit of the attitude error.
    """

    tape: Tape
    row: int
    first: int
    last: int
    sample_s: float
    count_rad: float
    rounded: bool
    method: int
    limit_rad: float

    def rows(self, time_s: float) -> int:
        return round(time_s / self.sample_s)

    def window(self, number: int) -> tuple[int, int]:
        """Return the first row of window `number`, from 0, and the row after its last."""
        least = self.first + self.rows(LEAST_LISTENED_S)
        room = 2 * min(self.row - least, self.last - self.row)
        share = 1.0 - SHORTER * ((number * 0.5 * (math.sqrt(5.0) - 1.0)) % 1.0)
        length = round(share * min(max(room, self.rows(SHORTEST_S)), self.rows(WINDOW_S)))
        begin = min(max(self.row - length // 2, least), max(self.last - length, self.first))
        return begin, begin + length

    @property
    def span_s(self) -> tuple[float, float]:
        """Return the times of the first and last row of the longest window, s."""
        begin, end = self.window(0)
        times = self.tape.inputs["time_s"]
        return float(times[begin]), float(times[end - 1])


class HeldCode(Instance):
    """The flight code that a held flight calls: a sequence of instances, each for a window.

    `alive` is called regularly while an instance receives the tape. `watched` is the memory that the code must not
    change. The constructor raises Unusable.
    """

    def __init__(
        self, computer: ComputerSection, held: CodeWindows, alive: Callable[[], None], watched: MemoryRanges = ()
    ) -> None:
        self.floating_point = FloatingPoint()
        self._calls, self._watched = blank(ProtectedCall), watched
        self._function = StepFunction(self._called)
        self.step = ctypes.cast(self._function, ctypes.c_void_p).value or 0
        self._computer, self._held, self._alive = computer, held, alive
        self._inputs, self._commands = held.tape.inputs.copy(), held.tape.commands
        flown = self._inputs[held.first :]
        self._blended = not np.array_equal(flown["rate_radps"], flown["delta_angle_rad"] / held.sample_s)
        self._state, self._out, self._given = blank(Superposition), blank(FswInputs), blank(FswInputs)
        self._answer = Outputs()
        self._received = self._given.ctypes.data
        self._structs = self._out.ctypes.data, ctypes.addressof(self._answer)
        self._heard: deque[tuple[bytes, tuple[float, ...]]] = deque(maxlen=held.rows(LISTENED_S))
        self._presented: list[bytes] = []
        self._answered: list[tuple[float, ...]] = []
        self._offset, self._number = [0.0, 0.0, 0.0], -1
        self._instance: Instance | None = None
        self._next_window()

    def _called(self, _: Any, inputs: Any, outputs: Any) -> int:
        try:
            return self._step(inputs, Outputs.from_address(outputs))
        except BaseException as error:  # an exception cannot pass through the compiled flight
            self.error = self.error or described(error)
            return 1

    def _step(self, address: int, outputs: Any) -> int:
        if self._row == self._end and not self.error:
            if self._number == 0:
                self._replay_window()
            self._next_window()
        if self.error:
            return 1
        ctypes.memmove(self._received, address, _IN.itemsize)
        superpose(self._inputs, self._row, self._given, 0, 1.0, self._state, self._out)
        commands = self._ask()
        if commands is None:
            return 1
        if self._number == 0:
            self._presented.append(self._out.tobytes())
            self._answered.append(commands)
        flown = self._commands[self._row].tolist()
        added = tuple(a - b + c for a, b, c in zip(commands, flown, self._offset, strict=False))
        outputs.gimbal_rad[0], outputs.gimbal_rad[1], outputs.roll_gimbal_rad = added
        thruster = self._answer.roll_thruster
        outputs.roll_thruster = max(-1, min(1, thruster - int(flown[3]))) if abs(thruster) <= 1 else thruster
        outputs.monitor = self._answer.monitor
        self._heard.append((self._given.tobytes(), added))
        self._row += 1
        return 0

    def _ask(self) -> tuple[float, ...] | None:
        """Return the commands of the instance for the present inputs, or None if its step fails."""
        assert self._instance is not None
        ctypes.memmove(self._structs[1], self._blank, len(self._blank))
        if self._fails(*self._structs):
            return None
        a = self._answer
        return a.gimbal_rad[0], a.gimbal_rad[1], a.roll_gimbal_rad, float(a.roll_thruster)

    def _fails(self, inputs: int, outputs: int) -> bool:
        """Call the instance with the structs at these addresses. If it fails, set `error` and return True."""
        assert self._instance is not None
        call = self._calls[0]
        call.given_from, call.taken_to = inputs, outputs
        code, changed = call_once(self._calls)
        if changed:
            self.error = OVERWROTE_TEXT
        elif code:
            self.error = self._instance.error or f"its step returned {code}"
        return bool(self.error)

    def _next_window(self) -> None:
        """Start the next instance, and take it to the beginning of its window."""
        held, self._number = self._held, self._number + 1
        begin, self._end = held.window(self._number)
        count = min(begin - held.first, len(self._heard))
        start, heard = begin - count, list(self._heard)[len(self._heard) - count :]
        self._restart()
        self._check(self._answers(self._inputs[:start]), self._commands[:start], "its flight")
        self._start_deviations(start)
        gradual = min(held.rows(GRADUAL_S), count // 3)
        given, answers = np.frombuffer(bytearray(b"".join(inputs for inputs, _ in heard)), _IN), []
        for k in range(count):
            share = 0.5 - 0.5 * math.cos(math.pi * (k + 1) / gradual) if k < gradual else 1.0
            superpose(self._inputs, start + k, given, k, share, self._state, self._out)
            answer = self._ask()
            if answer is None:
                return
            answers.append(answer[:3])
        if count:
            before, after = np.array([added for _, added in heard]), np.array(answers) - self._commands[start:begin, :3]
            settled = slice(gradual + (count - gradual) // 2, None)
            self._offset = [command_offset(before[settled, i], after[settled, i]) for i in range(3)]
        self._row = begin

    def _start_deviations(self, row: int) -> None:
        """Set the state of the superposition to that of the flight before `row`."""
        held, self._state[:] = self._held, blank(Superposition)
        state = self._state[0]
        state.sample_s, state.count_rad, state.rounded = held.sample_s, held.count_rad, int(held.rounded)
        state.method, state.limit_rad, state.blended = held.method, held.limit_rad, int(self._blended)
        state.attitude.measured.q[:] = held.tape.start_q_BR
        if row > 0:
            before = self._inputs[row - 1]
            state.total_counts[:] = np.round(before.angle_rad / held.count_rad) if held.count_rad > 0.0 else 0
            state.attitude.measured.q[:], state.attitude.measured.last_rad[:] = before.q_BR, before.delta_angle_rad

    def _restart(self) -> None:
        """End the instance and start a new one; modules or a library are loaded again as far as a process allows."""
        if self._instance is not None:
            ended(self._instance)
            self._instance.unload()
        if self._computer.python is not None:
            _forget_modules(Path(self._computer.python.file).parent)
        self._instance = started(self._computer, Setup.from_buffer_copy(self._held.tape.setup))
        self.version = self._instance.version
        self._instance.connect(self._calls[0], self._structs, self._watched)
        self._blank = bytes(Outputs(bytes=self._answer.bytes))

    def _answers(self, inputs: Records) -> Array:
        """Return the commands (n, 4) of the instance for consecutive inputs, up to the first failure."""
        given, taken = np.array(inputs), np.frombuffer(bytearray(self._blank * len(inputs)), _OUT)
        first_in, first_out = given.ctypes.data, taken.ctypes.data
        for k in range(len(given)):
            if k % 256 == 0:
                self._alive()
            if self._fails(first_in + k * _IN.itemsize, first_out + k * _OUT.itemsize):
                return commands_of(taken[:k])
        return commands_of(taken)

    def _replay_window(self) -> None:
        """Repeat the inputs of the first window with a new instance, and check that its commands are the same."""
        begin, _ = self._held.window(0)
        self._restart()
        presented = np.frombuffer(b"".join(self._presented), _IN)
        answers = self._answers(np.concatenate([self._inputs[:begin], presented]))
        self._check(answers[begin:], np.array(self._answered), "a held flight", begin)

    def _check(self, found: Array, wanted: Array, where: str, first: int = 0) -> None:
        """Set `error` if the commands `found` and `wanted`, both (n, 4), differ.

        `first` is the row of the recorded inputs that belongs to row 0; `where` names the run in the error.
        """
        same = (found == wanted[: len(found)]) | (np.isnan(found) & np.isnan(wanted[: len(found)]))
        if self.error or (same.all() and len(found) == len(wanted)):
            return
        row, column = np.argwhere(~same)[0] if not same.all() else (len(found), 0)
        time_s = float(self._inputs["time_s"][first + row])
        values = " and ".join(f"{x[row, column]:.9g}" for x in (wanted, found) if row < len(x))
        self.error = f"{DIFFERS} of {where}: {_COMMANDS[column]} at {time_s:.3f} s is {values}"

    def close(self) -> None:
        if self._instance is not None:
            self._instance.close()

    def unload(self) -> bool:
        return self._instance is not None and self._instance.unload()


@lru_cache(maxsize=1)
def load_kernels() -> None:
    """Load or compile the entries that a held flight calls.

    Their compilation would otherwise count towards the code's time limit.
    """
    tape, outs = blank(FswInputs), blank(FswInputs)
    superpose(tape, 0, blank(FswInputs), 0, 1.0, blank(Superposition), outs)
    call_once(blank(ProtectedCall))


def command_offset(before: Array, after: Array) -> float:
    """Return the constant by which the command of an instance exceeds that of its successor, rad.

    `before` and `after` (samples,) are their commands for the same deviations. A difference proportional to the command
    results from a gain schedule, which averages out over the windows. If the remaining difference is at most
    `UNEXPLAINED_SHARE` of the command, the result is 0. Otherwise, an integral that began later has caused a constant,
    which is fitted by least squares.
    """
    difference, power = before - after, float(after @ after)
    left = difference - (float(difference @ after) / power if power > 0.0 else 0.0) * after
    if len(before) < 8 or float(left @ left) <= UNEXPLAINED_SHARE**2 * max(power, float(before @ before)):
        return 0.0
    columns = np.column_stack([np.ones_like(after), after])
    return float(np.linalg.lstsq(columns, difference, rcond=None)[0][0])


def _forget_modules(folder: Path) -> None:
    """Remove the modules in a folder from this process, so that the next import executes them again."""
    imported.cache_clear()
    for name, module in list(sys.modules.items()):
        file = getattr(module, "__file__", None)
        if file and folder in Path(file).parents:
            del sys.modules[name]
