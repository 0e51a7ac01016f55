"""The running instances of external flight code.

For all kinds of code, the flight calls a C function with the records of control/external.py:

| key | function | sign of an error |
|---|---|---|
| `library` | `maxq_fsw_step` of the library | return value |
| `python` | ctypes callback that calls the method `step` | exception |
| `address` | ctypes callback that sends a message and receives the answer | broken connection, timeout |
| `sandbox` | as for `address`, to a process in a sandbox | the code's own, or the end of the process |
"""

from __future__ import annotations

import _ctypes
import contextlib
import ctypes
import operator
import os
import signal
import socket
import struct
import sys
import time
from abc import ABC, abstractmethod
from multiprocessing.connection import Pipe
from typing import Any, NoReturn
from urllib.parse import urlsplit

from maxq.control.external import ABI, FIRST_OF_VERSION_2, FswInputs, FswOutputs
from maxq.control.kernel.records import dtype_of
from maxq.sim.run.protection import FloatingPoint, GuardedMemory, MemoryRanges, Protection, own_floating_point
from maxq.sim.run.sandbox import confine, sandbox_problem
from maxq.sim.scenario.flight_code import SETTINGS_BYTES, CodeFile
from maxq.sim.scenario.python_file import ImportFailure, described, imported
from maxq.sim.scenario.schema_vehicle import ComputerSection

_FUNCTIONS = ("maxq_fsw_abi", "maxq_fsw_bytes", "maxq_fsw_init", "maxq_fsw_step", "maxq_fsw_close")
_ALIGNMENT = 64
_MOST_BYTES = 1 << 30  # largest size of an instance
_BEYOND_INT = 1 << 63
StepFunction = ctypes.CFUNCTYPE(ctypes.c_int, ctypes.c_void_p, ctypes.c_void_p, ctypes.c_void_p)


def _structure(name: str, schema: type) -> Any:
    """Return a ctypes.Structure with the fields of the record `schema`, for Python code."""
    kinds = {"f": ctypes.c_double, "i": ctypes.c_int64}
    fields: list[tuple[str, Any]] = []
    for field, (kind, _) in (dtype_of(schema).fields or {}).items():  # type: ignore[misc]  # a triple only with a title
        base: Any = kinds[kind.base.kind]
        for length in reversed(kind.shape):
            base *= length
        fields.append((field, base))
    return type(name, (ctypes.Structure,), {"_fields_": fields, "__doc__": schema.__doc__})


Inputs, Outputs = _structure("Inputs", FswInputs), _structure("Outputs", FswOutputs)


class Setup(ctypes.Structure):
    """The struct `maxq_fsw_setup` of maxq_fsw.h."""

    _fields_ = [
        *((name, ctypes.c_int64) for name in ("bytes", "abi", "sample_ns", "delay_ns", "start_ns", "groups")),
        *(
            (name, ctypes.c_double)
            for name in ("count_rad", "dac_step_rad", "command_limit_rad", "angle_error_limit_rad")
        ),
        ("settings", ctypes.c_char * (SETTINGS_BYTES + 1)),
        *((name, ctypes.c_int64) for name in ("sequencing", "stages")),
        ("start_q_RI", ctypes.c_double * 4),
        *((name, ctypes.c_double * 3) for name in ("start_r_I_m", "start_v_I_mps", "gnss_lever_B_m")),
        *((name, ctypes.c_double) for name in ("earth_rate_radps", "mu_m3ps2", "j2", "equator_m")),
    ]


_OF_VERSION_1 = {
    Setup: Setup.sequencing.offset,
    Inputs: getattr(Inputs, FIRST_OF_VERSION_2["inputs"]).offset,
    Outputs: getattr(Outputs, FIRST_OF_VERSION_2["outputs"]).offset,
}


def size_of(struct: Any, version: int) -> int:
    """Return the size of a struct in a version of maxq_fsw.h, bytes."""
    return ctypes.sizeof(struct) if version == ABI else _OF_VERSION_1[struct]


def setup_for(setup: Setup, version: int) -> Setup:
    """Return the setup for code of a version of maxq_fsw.h."""
    out = Setup.from_buffer_copy(setup)
    out.bytes, out.abi = size_of(Setup, version), version
    return out


class Unusable(Exception):
    """The error of flight code that cannot be started."""


class Instance(ABC):
    """A running instance of flight code.

    `step` is the address of the C function that the flight calls, and `address` that of its first argument. `error` is
    the message of the first error, or empty. `floating_point` is the environment of the code after its start. `version`
    is that of maxq_fsw.h which the code uses. `sizes` are those of the inputs that `step` reads and of the outputs that
    it writes, bytes.
    """

    step: int
    address = 0
    error = ""
    floating_point: FloatingPoint
    version = ABI
    sizes: tuple[int, int] = (ctypes.sizeof(Inputs), ctypes.sizeof(Outputs))

    def connect(self, call: Any, structs: tuple[int, int], watched: MemoryRanges = ()) -> None:
        """Write into the ProtectedCall `call` how the code is called, and into the structs their sizes in its version.

        `structs` are the addresses of the simulator's inputs and outputs. `watched` is the memory that the code must
        not change.
        """
        for kind, address in zip((Inputs, Outputs), structs, strict=True):
            kind.from_address(address).bytes = size_of(kind, self.version)
        self._protection = Protection(self.floating_point, *self.sizes)
        self._protection.bind(call, self.step, self.address, *structs)
        self._protection.watch(call, watched)

    @abstractmethod
    def close(self) -> None:
        """End the instance at the end of the flight."""

    def unload(self) -> bool:
        """Unload the code after `close`, and return True if no part of it remains in this process."""
        return False


class _Library(Instance):
    """An instance of a shared library, in memory that the simulator provides."""

    def __init__(self, code: CodeFile, setup: Setup) -> None:
        self._file, self._threads = code.file, _threads()
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
        if not 1 <= made_for <= ABI:
            raise Unusable(f"is made for version {made_for} of maxq_fsw.h, allowed are versions 1 to {ABI}")
        self.version, self.sizes = made_for, (size_of(Inputs, made_for), size_of(Outputs, made_for))
        if not 0 <= size <= _MOST_BYTES:
            raise Unusable(f"wants {size} bytes for an instance, allowed are 0 to {_MOST_BYTES}")
        self._library = library
        self._memory = GuardedMemory(-(-size // _ALIGNMENT) * _ALIGNMENT)
        self._setup = GuardedMemory(size_of(Setup, made_for))
        self.address = self._memory.address
        ctypes.memmove(self._setup.address, ctypes.byref(setup_for(setup, made_for)), self._setup.size)
        refused = library.maxq_fsw_init(ctypes.c_void_p(self.address), ctypes.c_void_p(self._setup.address))
        if refused:
            raise Unusable(f"maxq_fsw_init returned {refused}")
        self.step = ctypes.cast(library.maxq_fsw_step, ctypes.c_void_p).value or 0

    def close(self) -> None:
        self._library.maxq_fsw_close(ctypes.c_void_p(self.address))

    def unload(self) -> bool:
        if not _threads() or _threads() > self._threads:  # a thread of the library may still run in it
            return False
        _ctypes.dlclose(self._library._handle)
        try:
            ctypes.CDLL(self._file, os.RTLD_NOLOAD)
        except OSError:
            return True
        return False


def _threads() -> int:
    """Return the number of threads of this process, or 0 if the system does not provide it."""
    try:
        return len(os.listdir("/proc/self/task"))
    except OSError:
        return 0


class _InPython(Instance):
    """The base class of instances whose step is a Python method behind a C function."""

    def __init__(self) -> None:
        self._function = StepFunction(self._called)
        self.step = ctypes.cast(self._function, ctypes.c_void_p).value or 0

    @abstractmethod
    def answer(self, inputs: Any, outputs: Any) -> int:
        """Fill `outputs` for `inputs`, and return the code of the step; any code except 0 ends the flight."""

    def _called(self, _: Any, inputs: Any, outputs: Any) -> int:
        try:
            return self.answer(Inputs.from_buffer_copy(Inputs.from_address(inputs)), Outputs.from_address(outputs))
        except BaseException as error:  # an exception cannot pass through the compiled flight
            self.error = self.error or described(error)
            return 1


class _PythonClass(_InPython):
    """An instance of a Python class with the method `step(inputs)`, which returns outputs by name."""

    def __init__(self, code: CodeFile, setup: Setup) -> None:
        super().__init__()
        try:
            found = getattr(imported(code.file, code.sha256), code.member, None)
            if found is None:
                raise Unusable(f"has no class {code.member}")
            if not callable(getattr(found, "step", None)):
                raise Unusable(f"{code.member} has no method step")
            self._object = found(setup)
            self.version = int(getattr(self._object, "interface", 1))
        except Unusable:
            raise
        except ImportFailure as failure:
            raise Unusable(str(failure)) from None
        except BaseException as error:
            raise Unusable(described(error)) from None

    def answer(self, inputs: Any, outputs: Any) -> int:
        for name, value in self._object.step(inputs).items():
            room = getattr(outputs, name)
            if isinstance(room, ctypes.Array):
                whole = room._type_ is ctypes.c_int64
                room[:] = [_whole(name, item) if whole else float(item) for item in value]
            else:
                setattr(outputs, name, _whole(name, value) if isinstance(room, int) else value)
        return 0

    def close(self) -> None:
        if hasattr(self._object, "close"):
            self._object.close()


def _whole(name: str, value: Any) -> int:
    """Return an output as an integer; ctypes would take it modulo 2**64. Raises TypeError and ValueError."""
    try:
        number = operator.index(value)
    except TypeError:
        raise TypeError(f"{name} is {value!r}: allowed is an integer") from None
    if not -_BEYOND_INT <= number < _BEYOND_INT:
        raise ValueError(f"{name} is an integer beyond 64 bits")
    return number


HEADER = struct.Struct("=4sIq")
"""The header of a message: MAGIC, the kind, and the number of the message, which the answer repeats.

The byte order is that of this machine.
"""
MAGIC, SETUP, STEP, CLOSE = b"MAXQ", 1, 2, 3
_CODE = struct.Struct("=q")
_HEAD = HEADER.size + _CODE.size  # of an answer


class _Remote(_InPython):
    """A computer behind a socket, in lockstep: each message contains a struct, and its answer a code and a struct.

    Over UDP, a message is a datagram. Answers to earlier messages, which are duplicates or late, are ignored, and lost
    messages are not sent again. Any other answer than that to the last message is an error.
    """

    def __init__(self, address: str, timeout_s: float, setup: Setup, version: int) -> None:
        super().__init__()
        self.version = version
        parts, self._number, self._timeout_s, self._address = urlsplit(address), 0, timeout_s, address
        self._stream, self._ignored = parts.scheme == "tcp", 0
        place = (parts.hostname or "", parts.port or 0)
        try:
            if self._stream:
                self._socket = socket.create_connection(place, timeout_s)
                self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            else:
                family = socket.AF_INET6 if ":" in place[0] else socket.AF_INET
                self._socket = socket.socket(family, socket.SOCK_DGRAM)
                self._socket.connect(place)
            code, _ = self._ask(SETUP, bytes(setup_for(setup, version))[: size_of(Setup, version)], 0)
        except OSError as error:
            raise Unusable(self._said(error)) from None
        if code:
            raise Unusable(f"answered its setup with code {code}")

    def answer(self, inputs: Any, outputs: Any) -> int:
        try:
            given = bytes(inputs)[: size_of(Inputs, self.version)]
            code, content = self._ask(STEP, given, size_of(Outputs, self.version))
        except OSError as error:
            self.error = self._said(error)
            return 1
        ctypes.memmove(ctypes.addressof(outputs), content, len(content))
        if code:
            self.error = f"{self._address}: its step returned {code}"
        return int(code != 0)

    def close(self) -> None:
        with contextlib.suppress(OSError):
            self._socket.sendall(HEADER.pack(MAGIC, CLOSE, self._number + 1))
            self._socket.close()

    def _said(self, error: OSError) -> str:
        said = error.strerror.lower() if error.strerror else str(error)
        if isinstance(error, TimeoutError):
            lost = "" if self._stream else ", or a datagram was lost"
            late = f" (ignored answers to earlier messages: {self._ignored})" if self._ignored else ""
            said = f"no answer within {self._timeout_s:g} s{late}; its process may be stopped, or too slow{lost}"
        elif isinstance(error, ConnectionError) and self._number > 1:
            said = "the connection was closed; its process has ended"
        return f"{self._address}: {said}"

    def _ask(self, kind: int, content: bytes, expected: int) -> tuple[int, bytes]:
        """Send a message, and return the code of its answer and the content, of `expected` bytes. Raises OSError."""
        self._number += 1
        until = time.monotonic() + self._timeout_s
        self._socket.settimeout(self._timeout_s)
        self._socket.sendall(HEADER.pack(MAGIC, kind, self._number) + content)
        while True:
            answer = self._received(_HEAD, until)
            if answer[:4] != MAGIC:
                raise OSError("an answer that does not begin with MAXQ")
            if len(answer) < _HEAD:
                raise OSError(f"an answer of {len(answer)} bytes, without a header and code of {_HEAD} bytes")
            _, of, number = HEADER.unpack_from(answer)
            if not self._stream and 0 < number < self._number:
                self._ignored += 1
                continue
            if (of, number) != (kind, self._number):
                due = f"that to message {self._number}, of kind {kind}"
                raise OSError(f"an answer to message {number}, of kind {of}; expected is {due}")
            return _CODE.unpack_from(answer, HEADER.size)[0], self._struct(answer[_HEAD:], expected, until)

    def _struct(self, content: bytes, expected: int, until: float) -> bytes:
        """Return the struct of an answer, or raise OSError if it does not belong to this version of maxq_fsw.h.

        `content` follows the code of the answer; from a stream, it is received here. The struct may begin with 0 in
        place of its size.
        """
        if self._stream and expected:
            content = self._received(_CODE.size, until)
        found = len(content)
        if expected and found >= _CODE.size and (self._stream or found == expected):
            found = _CODE.unpack_from(content)[0] or expected
        if found != expected:
            of = [f", of version {version}" for version in range(1, ABI + 1) if found == size_of(Outputs, version)]
            wanted = f"{expected}, of version {self.version} (key interface)" if expected else "none"
            raise OSError(f"an answer with {found} bytes of outputs{''.join(of[:1])}; expected are {wanted}")
        return content + self._received(expected - len(content), until) if self._stream and expected else content

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
                raise ConnectionError
            out += part
        return out


class _Sandboxed(_InPython):
    """Flight code in a process of its own in a sandbox, which shares no memory with the flight."""

    def __init__(self, computer: ComputerSection, setup: Setup) -> None:
        super().__init__()
        if problem := sandbox_problem():
            raise Unusable(problem)
        self._line, theirs = Pipe()
        self._pid = os.fork()
        if self._pid == 0:
            _serve_sandbox(theirs, computer)
        theirs.close()
        self.version, _, error = self._ask(bytes(setup))
        if error:
            raise Unusable(error)

    def answer(self, inputs: Any, outputs: Any) -> int:
        code, content, self.error = self._ask(bytes(inputs))
        ctypes.memmove(ctypes.addressof(outputs), content, len(content))
        return code

    def close(self) -> None:
        _, _, error = self._ask(b"")
        if error:
            raise Unusable(error)

    def _ask(self, message: bytes) -> tuple[int, bytes, str]:
        """Send a struct to the process, and return the code, the outputs and the error of its answer.

        The code of the answer to the setup is the version of maxq_fsw.h.
        """
        try:
            self._line.send_bytes(message)
            answer = self._line.recv_bytes()
        except (EOFError, OSError):
            code = os.waitstatus_to_exitcode(os.waitpid(self._pid, 0)[1])
            return 1, b"", f"its process in the sandbox ended: {end_name(code)}"
        size = _CODE.size + ctypes.sizeof(Outputs)
        return _CODE.unpack_from(answer)[0], answer[_CODE.size : size], answer[size:].decode(errors="replace")


def _serve_sandbox(line: Any, computer: ComputerSection) -> NoReturn:
    """Run flight code in this process, a fork, which answers the structs of a connection."""
    try:
        keep = line.fileno()
        os.closerange(3, keep)
        os.closerange(keep + 1, os.sysconf("SC_OPEN_MAX"))
        sys.dont_write_bytecode = True
        confine()
        instance, error, taken, given = None, "", Outputs(), Inputs()
        while message := line.recv_bytes():
            code = 0
            if instance is None:
                try:
                    instance = started(computer.model_copy(update={"sandbox": False}), Setup.from_buffer_copy(message))
                    step, code = StepFunction(instance.step), instance.version
                except Unusable as problem:
                    code, error = 1, str(problem) or "cannot be started"
            else:
                ctypes.memmove(ctypes.addressof(given), message, len(message))
                ctypes.memset(ctypes.addressof(taken), 0, ctypes.sizeof(taken))
                taken.bytes = size_of(Outputs, instance.version)
                code = step(instance.address, ctypes.addressof(given), ctypes.addressof(taken))
                error = (instance.error or f"its step returned {code}") if code else ""
            line.send_bytes(_CODE.pack(code) + bytes(taken) + error.encode())
        error = ended(instance) if instance is not None else ""
        line.send_bytes(_CODE.pack(0) + bytes(taken) + error.encode())
    except (EOFError, OSError):
        pass
    finally:
        with contextlib.suppress(Exception):
            sys.stdout.flush()
            ctypes.CDLL(None).fflush(None)
        os._exit(0)


def end_name(code: int) -> str:
    """Return the signal that ended a process, or its exit code, for a code of os.waitstatus_to_exitcode."""
    if code >= 0:
        return f"exit code {code}"
    try:
        return signal.Signals(-code).name
    except ValueError:
        return f"signal {-code}"


def started(computer: ComputerSection, setup: Setup) -> Instance:
    """Return a running instance of the flight code of `computer`. Raises Unusable if it cannot be started."""
    with own_floating_point() as of_code:
        instance = _started(computer, setup)
    instance.floating_point = of_code
    return instance


def ended(instance: Instance) -> str:
    """Close an instance, and return the message of an error, or an empty string."""
    try:
        with own_floating_point():
            instance.close()
    except BaseException as error:  # of the code, whose flight has ended
        return described(error)
    return ""


def _started(computer: ComputerSection, setup: Setup) -> Instance:
    found: Instance
    if computer.sandbox:
        found = _Sandboxed(computer, setup)
    elif computer.library is not None:
        found = _Library(computer.library, setup)
    elif computer.python is not None:
        found = _PythonClass(computer.python, setup)
    else:
        found = _Remote(computer.address or "", computer.timeout_s, setup, computer.interface or 1)
    if computer.sequences and found.version < 2:
        found.close()
        raise Unusable(f"is made for version {found.version} of maxq_fsw.h: sequencing = 'flight-code' needs version 2")
    return found
