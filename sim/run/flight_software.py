"""Flight code from outside at work: loaded, given its memory, called by the compiled flight, and kept apart from it.

Whatever it is, the flight calls a C function with the records of control/external.py:

| key | function | where an error shows |
|---|---|---|
| `library` | `maxq_fsw_step` of the library itself | return value |
| `python` | ctypes around the method `step` | exception |
| `address` | ctypes around a message and its answer | broken connection, timeout |

A guarded flight is flown by a forked process on memory that both share: where the code crashes or does not return, this
process ends the flight, and log and summary are closed as always. It costs a fork a flight and a message a segment.
Flights on several threads so run Python code on several processors. Without `os.fork` nothing is guarded.
"""

from __future__ import annotations

import contextlib
import ctypes
import gc
import hashlib
import importlib.util
import logging
import math
import mmap
import os
import select
import signal
import socket
import struct
import sys
import threading
import time
import weakref
from collections.abc import Callable
from functools import lru_cache
from pathlib import Path
from types import ModuleType
from typing import Any, NoReturn, Protocol
from urllib.parse import urlsplit

import numpy as np
from numpy.typing import NDArray

from maxq.control.external import ABI, BAD_THRUSTER, CRASHED, NOT_FINITE, STUCK, FswInputs, FswOutputs
from maxq.control.kernel.records import dtype_of
from maxq.sim.packing.flight import Packed
from maxq.sim.scenario.errors import ScenarioError
from maxq.sim.scenario.flight_code import SETTINGS_BYTES, CodeFile
from maxq.sim.scenario.loader import LoadedScenario
from maxq.sim.scenario.schema_vehicle import Computer

KEY = "vehicle.computer"

_FUNCTIONS = ("maxq_fsw_abi", "maxq_fsw_bytes", "maxq_fsw_init", "maxq_fsw_step", "maxq_fsw_close")
_ALIGNMENT = 64
_MOST_BYTES = 1 << 30  # of an instance
_TEXT_BYTES = 2000
_POLL_S = 0.05
_COMMANDS = ("gimbal_rad[0], pitch", "gimbal_rad[1], yaw", "roll_gimbal_rad")
_STARTING = 2  # of `inside`: while an instance is made
_forking = threading.Lock()  # or another flight's process would keep the ends of this one's pipes open
_StepFunction = ctypes.CFUNCTYPE(ctypes.c_int, ctypes.c_void_p, ctypes.c_void_p, ctypes.c_void_p)


def _structure(name: str, schema: type) -> Any:
    """The record as a ctypes.Structure, for Python code."""
    kinds = {"f": ctypes.c_double, "i": ctypes.c_int64}
    fields: list[tuple[str, Any]] = []
    for field, (kind, _) in (dtype_of(schema).fields or {}).items():  # type: ignore[misc]  # a triple only with a title
        base: Any = kinds[kind.base.kind]
        fields.append((field, base * kind.shape[0] if kind.shape else base))
    return type(name, (ctypes.Structure,), {"_fields_": fields, "__doc__": schema.__doc__})


Inputs, Outputs = _structure("Inputs", FswInputs), _structure("Outputs", FswOutputs)


class Setup(ctypes.Structure):
    """`maxq_fsw_setup` of maxq_fsw.h."""

    _fields_ = [
        *((name, ctypes.c_int64) for name in ("bytes", "abi", "sample_ns", "delay_ns", "start_ns", "groups")),
        *(
            (name, ctypes.c_double)
            for name in ("count_rad", "dac_step_rad", "command_limit_rad", "angle_error_limit_rad")
        ),
        ("settings", ctypes.c_char * (SETTINGS_BYTES + 1)),
    ]


class Unusable(Exception):
    """Why flight code cannot be started."""


class Instance(Protocol):
    """Flight code that has been started: what the flight calls, and what else there is to say of the last call."""

    step: int
    address: int
    error: str

    def close(self) -> None: ...


class _Library:
    """An instance of a shared library, in memory of ours."""

    error = ""

    def __init__(self, code: CodeFile, setup: Setup) -> None:
        try:
            library = ctypes.CDLL(code.file)
        except OSError as error:
            raise Unusable(f"cannot be loaded: {error}") from None
        for name in _FUNCTIONS:
            if not hasattr(library, name):
                raise Unusable(f"has no function {name}")
        library.maxq_fsw_abi.restype = library.maxq_fsw_init.restype = ctypes.c_int32
        library.maxq_fsw_bytes.restype = ctypes.c_int64
        library.maxq_fsw_close.restype = None
        made_for, size = library.maxq_fsw_abi(), library.maxq_fsw_bytes()
        if made_for != ABI:
            raise Unusable(f"is made for version {made_for} of maxq_fsw.h, this is version {ABI}")
        if not 0 <= size <= _MOST_BYTES:
            raise Unusable(f"wants {size} bytes for an instance, allowed are 0 to {_MOST_BYTES}")
        self._library = library
        self._memory = ctypes.create_string_buffer(size + _ALIGNMENT)
        start = ctypes.addressof(self._memory)
        self.address = start + -start % _ALIGNMENT
        refused = library.maxq_fsw_init(ctypes.c_void_p(self.address), ctypes.byref(setup))
        if refused:
            raise Unusable(f"maxq_fsw_init returned {refused}")
        self.step = ctypes.cast(library.maxq_fsw_step, ctypes.c_void_p).value or 0

    def close(self) -> None:
        self._library.maxq_fsw_close(ctypes.c_void_p(self.address))


class _InPython:
    """Flight code in Python behind a C function: a subclass answers inputs with outputs."""

    address = 0

    def __init__(self) -> None:
        self.error = ""
        self._function = _StepFunction(self._called)
        self.step = ctypes.cast(self._function, ctypes.c_void_p).value or 0

    def answer(self, inputs: Any, outputs: Any) -> int:
        raise NotImplementedError

    def close(self) -> None:
        pass

    def _called(self, _: Any, inputs: Any, outputs: Any) -> int:
        try:
            return self.answer(Inputs.from_buffer_copy(Inputs.from_address(inputs)), Outputs.from_address(outputs))
        except BaseException as error:  # an exception cannot pass through the compiled flight
            self.error = self.error or described(error)
            return 1


class _PythonClass(_InPython):
    """An instance of a class with the method `step(inputs)`, which returns outputs by name."""

    def __init__(self, code: CodeFile, setup: Setup) -> None:
        super().__init__()
        try:
            self._object = getattr(_module(code.file, code.sha256), code.member)(setup)
        except Unusable:
            raise
        except BaseException as error:
            raise Unusable(described(error)) from None

    def answer(self, inputs: Any, outputs: Any) -> int:
        for name, value in self._object.step(inputs).items():
            room = getattr(outputs, name)
            if isinstance(room, ctypes.Array):
                room[:] = [float(item) for item in value]
            else:
                setattr(outputs, name, value)
        return 0

    def close(self) -> None:
        if hasattr(self._object, "close"):
            self._object.close()


@lru_cache(maxsize=8)
def _module(file: str, sha256: str) -> ModuleType:
    """The module in a Python file, which may import what lies beside it."""
    spec = importlib.util.spec_from_file_location(f"maxq_flight_code_{sha256[:12]}", file)
    if spec is None or spec.loader is None:
        raise Unusable("is no Python file")
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    beside = str(Path(file).parent)
    sys.path.insert(0, beside)
    try:
        spec.loader.exec_module(module)
    except BaseException as error:
        del sys.modules[spec.name]
        raise Unusable(described(error)) from None
    finally:
        sys.path.remove(beside)
    return module


HEADER = struct.Struct("=4sIq")
"""Of a message, in the order of bytes of this machine: MAGIC, kind, number of the message, which the answer repeats."""
MAGIC, SETUP, STEP, CLOSE = b"MAXQ", 1, 2, 3
_CODE = struct.Struct("=q")


class _Remote(_InPython):
    """A computer behind a socket, in lock-step: a message with a struct, an answer with a code and a struct.

    Over UDP a message is a datagram; answers to earlier messages are passed over, lost ones are not sent again.
    """

    def __init__(self, address: str, timeout_s: float, setup: Setup) -> None:
        super().__init__()
        parts, self._number, self._timeout_s = urlsplit(address), 0, timeout_s
        self._stream = parts.scheme == "tcp"
        place = (parts.hostname or "", parts.port or 0)
        try:
            if self._stream:
                self._socket = socket.create_connection(place, timeout_s)
                self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            else:
                family = socket.AF_INET6 if ":" in place[0] else socket.AF_INET
                self._socket = socket.socket(family, socket.SOCK_DGRAM)
                self._socket.connect(place)
            code, _ = self._ask(SETUP, bytes(setup), 0)
        except OSError as error:
            raise Unusable(self._said(error)) from None
        if code:
            raise Unusable(f"answered its setup with code {code}")

    def answer(self, inputs: Any, outputs: Any) -> int:
        try:
            code, content = self._ask(STEP, bytes(inputs), ctypes.sizeof(Outputs))
        except OSError as error:
            self.error = self._said(error)
            return 1
        ctypes.memmove(ctypes.addressof(outputs), content, len(content))
        return code

    def close(self) -> None:
        with contextlib.suppress(OSError):
            self._socket.sendall(HEADER.pack(MAGIC, CLOSE, self._number + 1))
            self._socket.close()

    def _said(self, error: OSError) -> str:
        if isinstance(error, TimeoutError):
            return f"no answer within {self._timeout_s:g} s"
        return error.strerror.lower() if error.strerror else str(error)

    def _ask(self, kind: int, content: bytes, expected: int) -> tuple[int, bytes]:
        """Code and content of the answer."""
        self._number += 1
        until = time.monotonic() + self._timeout_s
        self._socket.settimeout(self._timeout_s)
        self._socket.sendall(HEADER.pack(MAGIC, kind, self._number) + content)
        size = HEADER.size + _CODE.size + expected
        while True:
            answer = self._received(size, until)
            if answer[:4] != MAGIC:
                raise OSError("an answer that does not begin with MAXQ")
            if len(answer) != size:
                raise OSError(f"an answer of {len(answer)} bytes, not the {size} of maxq_fsw.h")
            if HEADER.unpack_from(answer) == (MAGIC, kind, self._number):
                return _CODE.unpack_from(answer, HEADER.size)[0], answer[HEADER.size + _CODE.size :]
            if self._stream:
                raise OSError("an answer to another message")

    def _received(self, size: int, until: float) -> bytes:
        out = b""
        while len(out) < size:
            left_s = until - time.monotonic()
            if left_s <= 0.0:
                raise TimeoutError
            self._socket.settimeout(left_s)
            part = self._socket.recv(size - len(out) if self._stream else 65536)
            if not self._stream:
                return part
            if not part:
                raise ConnectionError("the connection was closed")
            out += part
        return out


def described(error: BaseException) -> str:
    """An exception of flight code on one line, with the place in it."""
    trace, at = error.__traceback__, ""
    while trace is not None:
        file = trace.tb_frame.f_code.co_filename
        if not file.startswith(str(Path(__file__).parents[2])) and "importlib" not in file:
            at = f" ({Path(file).name}, line {trace.tb_lineno})"
        trace = trace.tb_next
    return " ".join(f"{type(error).__name__}: {error}".split()) + at


def title(computer: Computer) -> str:
    """The flight code, for people."""
    found = computer.library or computer.python
    return found.title if found is not None else computer.address or ""


@lru_cache(maxsize=64)
def _announce(code: str, sha256: str) -> None:
    """Say, once a process, that code from outside is run: a log or a scenario of others may name some."""
    mark = f" (sha256 {sha256[:16]})" if sha256 else ""
    logging.getLogger("maxq").warning("maxq: flies flight code from outside: %s%s", code, mark)


def checked(loaded: LoadedScenario) -> Computer:
    """The computer, once its code is there and is what the scenario says. Raises ScenarioError."""
    computer = loaded.vehicle.computer
    assert computer is not None
    code = computer.library or computer.python
    if code is not None:
        where = f"{KEY}.{computer.code_keys[0]}"
        try:
            content = Path(code.file).read_bytes()
        except OSError as error:
            problem = f"cannot be read: {(error.strerror or str(error)).lower()}"
            raise ScenarioError(loaded.label, problem, where, value=code.title) from None
        if hashlib.sha256(content).hexdigest() != code.sha256:
            allowed = f"that with sha256 {code.sha256[:16]}, or --set {where}=FILE for what is there now"
            raise ScenarioError(
                loaded.label, "is not the flight code that was flown", where, value=code.title, allowed=allowed
            )
    _announce(title(computer), code.sha256 if code is not None else "")
    if code is not None and computer.python is not None:
        _class_of(loaded, code, f"{KEY}.python")
    return computer


def _class_of(loaded: LoadedScenario, code: CodeFile, where: str) -> None:
    """Import it: a mistake shows here, before anything flies."""
    try:
        found = getattr(_module(code.file, code.sha256), code.member, None)
    except Unusable as error:
        raise ScenarioError(loaded.label, str(error), where, value=code.title) from None
    if not callable(getattr(found, "step", None)):
        problem = f"has no class {code.member}" if found is None else f"{code.member} has no method step"
        raise ScenarioError(loaded.label, problem, where, value=code.title)


def started(computer: Computer, setup: Setup) -> Instance:
    """An instance of the flight code. Raises Unusable."""
    if computer.library is not None:
        return _Library(computer.library, setup)
    if computer.python is not None:
        return _PythonClass(computer.python, setup)
    return _Remote(computer.address or "", computer.timeout_s, setup)


def setup_of(computer: Computer, packed_computer: Any, start_ns: int) -> Setup:
    return Setup(
        ctypes.sizeof(Setup), ABI, int(packed_computer.sample_ns), int(packed_computer.delay_ns), start_ns,
        int(packed_computer.allocation.groups), float(packed_computer.converter.count_rad),
        float(packed_computer.dac_step_rad), float(packed_computer.command_limit_rad),
        float(packed_computer.angle_error_limit_rad), computer.settings.encode(),
    )  # fmt: skip  # ten lines otherwise


def shared(array: NDArray[Any]) -> NDArray[Any]:
    """A copy in memory that a forked process shares."""
    out = np.frombuffer(mmap.mmap(-1, max(array.nbytes, 1)), array.dtype, array.size).reshape(array.shape)
    out[:] = array
    return out


class FlightSoftware:
    """The flight code of one flight; where it is guarded, all of `packed` that changes is in shared memory."""

    def __init__(self, loaded: LoadedScenario, packed: Packed) -> None:
        self._label, self._computer, self._guarded = loaded.label, checked(loaded), self.guards(loaded)
        self._memory = packed.memory
        start_ns = int(packed.memory[0].clock.now_ns)
        self._setup = setup_of(self._computer, packed.parameters[0].computer, start_ns)
        self._text = shared(np.zeros(_TEXT_BYTES, "u1"))
        self._instance: Instance | None = None
        self._end: Callable[[], object] = lambda: None
        state = self._memory[0].computer.external
        state.inputs.bytes, state.outputs.bytes = ctypes.sizeof(Inputs), ctypes.sizeof(Outputs)

    @staticmethod
    def guards(loaded: LoadedScenario) -> bool:
        computer = loaded.vehicle.computer
        return computer is not None and computer.guard and hasattr(os, "fork")

    def start(self, fly: Callable[[int], None]) -> None:
        """Start the code; `fly` advances the flight to an instant. Raises ScenarioError where it cannot be started."""
        if not self._guarded:
            try:
                self._begin()
            except Unusable as error:
                raise self._refusal(str(error)) from None
            self._fly = fly
            self._end = weakref.finalize(self, self._instance.close) if self._instance else self._end
            return
        state = self._memory[0].computer.external
        state.inside = _STARTING
        with _forking:
            ask, asked = os.pipe()
            answered, answer = os.pipe()
            for stream in (sys.stdout, sys.stderr):  # or both processes would write what waits there
                with contextlib.suppress(OSError, ValueError, AttributeError):
                    stream.flush()
            pid = os.fork()
            if pid == 0:
                os.close(asked)
                os.close(answered)
                self._serve(fly, ask, answer)
            os.close(ask)
            os.close(answer)
        self._pid, self._asked, self._answered = pid, asked, answered
        self._end = weakref.finalize(self, _ended, pid, asked, answered, self._computer.timeout_s)
        self._fly = self._ordered
        if not self._waited(b""):
            self.close()
            raise self._refusal(self.complaint or "cannot be started")

    def advance(self, until_ns: int) -> None:
        self._fly(until_ns)
        if self._instance is not None:
            self._note(self._instance.error)

    def close(self) -> None:
        """End of the flight; a second call does nothing."""
        self._end()

    @property
    def complaint(self) -> str:
        """Why the flight code ended the flight; empty as long as it has not."""
        state = self._memory[0].computer.external
        said = self._text.tobytes().rstrip(b"\0").decode(errors="replace")
        fault, code = int(state.fault), int(state.code)
        if fault == 0:
            return said
        during = {0: "between two samples", 1: "in its step", _STARTING: "at its start"}[int(state.inside)]
        if fault == NOT_FINITE:
            return f"gave {_COMMANDS[code]}: not a finite number, or beyond 1e6 rad"
        if fault == BAD_THRUSTER:
            return f"gave roll_thruster = {code}: allowed is -1, 0 or 1"
        if fault == CRASHED:
            return f"crashed {during}: {_signal_name(code)}"
        if fault == STUCK:
            return f"did not return within {self._computer.timeout_s:g} s {during}"
        return said or f"its step returned {code}"

    @property
    def title(self) -> str:
        return title(self._computer)

    def _refusal(self, problem: str) -> ScenarioError:
        return ScenarioError(self._label, problem, f"{KEY}.{self._computer.code_keys[0]}", value=self.title)

    def _begin(self) -> None:
        self._instance = started(self._computer, self._setup)
        state = self._memory[0].computer.external
        state.step, state.instance, state.inside = self._instance.step, self._instance.address, 0

    def _note(self, error: str) -> None:
        text = error.encode()[: _TEXT_BYTES - 1]
        self._text[: len(text)] = np.frombuffer(text, "u1")

    # in the process that flies

    def _serve(self, fly: Callable[[int], None], ask: int, answer: int) -> NoReturn:
        """Start the code, then fly as asked until there is nobody to ask."""
        code = 1
        try:
            for number in (signal.SIGINT, signal.SIGTERM):  # the process that asks sees to these
                signal.signal(number, signal.SIG_IGN)
        except ValueError:
            pass  # forked by a thread, which is now the main thread
        try:
            gc.freeze()
            try:
                self._begin()
            except Unusable as error:
                self._note(str(error) or type(error).__name__)
            os.write(answer, b"0" if self._instance is None else b"1")
            while self._instance is not None and (order := os.read(ask, 8)):
                fly(int.from_bytes(order, sys.byteorder, signed=True))
                self._note(self._instance.error)
                os.write(answer, b"1")
            if self._instance is not None:
                self._instance.close()
            code = 0
        finally:
            with contextlib.suppress(Exception):
                sys.stdout.flush()
                sys.stderr.flush()
                ctypes.CDLL(None).fflush(None)
            os._exit(code)

    # in the process that asks

    def _ordered(self, until_ns: int) -> None:
        if not self._waited(until_ns.to_bytes(8, sys.byteorder, signed=True)):
            self._memory[0].clock.finished = 1

    def _waited(self, order: bytes) -> bool:
        """Whether the other process has done what was asked; otherwise the fault is noted."""
        state = self._memory[0].computer.external
        limit_s = self._computer.timeout_s + (5.0 if self._computer.address else 0.0)  # a socket has its own timeout
        with contextlib.suppress(BrokenPipeError):
            if order:
                os.write(self._asked, order)
        calls, since = int(state.calls), time.monotonic()
        while True:
            if select.select([self._answered], [], [], _POLL_S)[0]:
                done = os.read(self._answered, 1)
                if done:
                    return done == b"1"
                _, status = os.waitpid(self._pid, 0)
                state.fault, state.code = CRASHED, os.waitstatus_to_exitcode(status)
                return False
            if int(state.calls) != calls or int(state.inside) == 0:
                calls, since = int(state.calls), time.monotonic()
            elif time.monotonic() - since > limit_s:
                os.kill(self._pid, signal.SIGKILL)
                state.fault = STUCK
                return False


def _signal_name(code: int) -> str:
    """How a process ended, from its exit code."""
    if code >= 0:
        return f"its process ended with exit code {code}"
    try:
        return signal.Signals(-code).name
    except ValueError:
        return f"signal {-code}"


def _ended(pid: int, asked: int, answered: int, patience_s: float) -> None:
    """Let the other process close its code and end; one that does not is killed."""
    os.close(asked)
    until = time.monotonic() + patience_s
    with contextlib.suppress(ChildProcessError):
        while os.waitpid(pid, os.WNOHANG)[0] == 0:
            if time.monotonic() > until:
                os.kill(pid, signal.SIGKILL)
                until = math.inf
            time.sleep(0.001)
    os.close(answered)
