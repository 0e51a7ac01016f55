"""The processes that fly external flight code, so that a crash or an endless loop ends a single flight only.

A worker is forked with shared memory, in which it flies the flight. After a flight, the worker is reused for the next
flight with the same code, because a fork takes as long as a third of a flight. A library is unloaded in between, so
that each flight begins as in a fresh process. If a part of the code would remain (Python modules, a library that cannot
be unloaded or has started threads or processes), the worker ends with its flight.

A worker and the processes that its code starts form a process group. It is killed when the worker ends, and by the
Linux kernel when the simulator ends for any reason.
"""

from __future__ import annotations

import atexit
import contextlib
import ctypes
import gc
import mmap
import os
import pickle
import select
import signal
import sys
import threading
import time
from collections.abc import Sequence
from multiprocessing.connection import Pipe
from types import ModuleType
from typing import Any, NoReturn

import numpy as np
from numpy.typing import NDArray

from maxq.control.external import (
    ABORTED,
    BAD_SEPARATION,
    BAD_THROTTLE,
    BAD_THRUSTER,
    BAD_TURN,
    CRASHED,
    EARLY,
    NO_SEPARATION,
    NOT_FINITE,
    OVERWROTE,
    SEPARATIONS,
    STUCK,
    THROTTLE,
    TOO_MANY,
)
from maxq.sim.flight.loop import advance
from maxq.sim.flight.parameters import MAX_IGNITIONS
from maxq.sim.input.errors import printable
from maxq.sim.run.hashed_reads import only_hashed_reads
from maxq.sim.run.held_code import CodeWindows, HeldCode
from maxq.sim.run.instances import Instance, Setup, Unusable, end_name, ended, started
from maxq.sim.run.protection import (
    GUARD,
    OVERWROTE_TEXT,
    MemoryRanges,
    make_inaccessible,
    make_read_only,
    make_writable,
    own_floating_point,
    whole_pages,
)
from maxq.sim.run.watched import watched_ranges
from maxq.sim.scenario.schema_vehicle import ComputerSection

fcntl: ModuleType | None
try:
    import fcntl
except ImportError:  # Windows
    fcntl = None

Arrays = tuple[NDArray[Any], ...]
"""The arguments of `loop.advance` in order, except `until_ns`."""
FORKS = hasattr(os, "fork")
"""False on Windows, where no process can guard a flight."""
MEMORY = 2  # index of the flight's memory in Arrays

STARTING, ENDING = 2, 3  # values of `inside` while an instance is made and closed
STOPPED = 1  # value of `code` if a process that does not return is stopped
_SMALLEST = 1 << 24  # least shared memory of a worker, bytes; the unused part takes no memory
IMPORT_S = 30.0  # additional time limit for the start of Python code, which each process imports
_SOCKET_S = 5.0  # additional time limit for a socket, which has a separate time limit
_POLL_S = 0.05
_MORE_IGNORED = ("SIGHUP", "SIGTTIN", "SIGTTOU")
_IGNORED = (signal.SIGINT, signal.SIGTERM, *(getattr(signal, s) for s in _MORE_IGNORED if hasattr(signal, s)))
"""The signals that the parent process handles, or that stop a process in the background."""
_FORK = threading.RLock()  # reentrant, because a garbage collection may release a worker while the lock is held
_idle: list[Worker] = []
_lines: dict[Any, int] = {}  # the connections to workers, and the process at the other end of each
_lives: dict[Any, int] = {}  # the pipe of each connection whose end kills the worker
_leaving: dict[int, int] = {}  # ids of processes that are ending, and the pipe of each


class Worker:
    """A process that flies the code of `computer` on arrays of the types `kinds` in `size` bytes of shared memory."""

    def __init__(self, computer: ComputerSection, kinds: list[np.dtype[Any]], size: int) -> None:
        self.computer, self.kinds, self.size = computer, kinds, size
        self._room = mmap.mmap(-1, size + 2 * GUARD)
        with _FORK:
            self._line, theirs = Pipe()
            parent_lives, _lives[self._line] = os.pipe()
            _lines[self._line] = 0  # closed in the other process
            for stream in (sys.stdout, sys.stderr):  # otherwise, both processes would write the buffered output
                with contextlib.suppress(OSError, ValueError, AttributeError):
                    stream.flush()
            self._pid = os.fork()
            if self._pid == 0:
                _Flying(theirs, self._room, computer, kinds).serve(parent_lives)
            with contextlib.suppress(OSError):  # both processes set it, because either may be first
                os.setpgid(self._pid, self._pid)
            theirs.close()
            os.close(parent_lives)
            _lines[self._line] = self._pid
        self._answers = select.poll()
        self._answers.register(self._line.fileno(), select.POLLIN)

    def start(self, arrays: Arrays, setup: Setup, held: CodeWindows | None = None) -> tuple[Arrays, bool, str]:
        """Copy `arrays` into shared memory, and start the code of a flight.

        Returns the shared arrays, True if the code was started, and the message of an error.
        """
        shapes = [array.shape for array in arrays]
        placed = _placed(self._room, self.kinds, shapes)
        for room, array in zip(placed, arrays, strict=True):
            room.reshape(-1).view("u1")[:] = array.reshape(-1).view("u1")
        state = placed[MEMORY]["computer"]["external"]
        self._seen = {name: state[name] for name in ("calls", "inside", "fault", "code")}
        self._seen["inside"][0] = STARTING
        return placed, *self._done(b"S" + pickle.dumps((shapes, bytes(setup), held)))

    def advance(self, until_ns: int) -> tuple[bool, str]:
        """Advance the flight to `until_ns`.

        Returns True and the message of the code. If the process ends, the fault is written into the memory of the
        flight, and the result is False with an empty message.
        """
        return self._done(b"A" + until_ns.to_bytes(8, sys.byteorder, signed=True))

    def release(self) -> str:
        """End the flight: close the code, and keep the worker for the next flight if no part of the code remains.

        Returns the message of an error of the code, or an empty string.
        """
        if self._pid <= 0:
            self.end()
            return ""
        self._seen["inside"][0] = ENDING  # otherwise, closing would have no time limit
        self._seen["fault"][0] = 0
        clean, said = self._done(b"C")
        fault, code, inside = (int(self._seen[name][0]) for name in ("fault", "code", "inside"))
        text = complaint(self.computer, said, fault, code, inside)
        self._seen.clear()
        if not clean:
            self.end()
            return text
        with _FORK:
            _idle.append(self)
            oldest = _idle.pop(0) if len(_idle) > 2 * (os.cpu_count() or 1) else None
        if oldest is not None:
            oldest.end()
        return text

    def end(self) -> None:
        """Close the connection, which ends the process."""
        _lines.pop(self._line, None)
        self._line.close()
        if self._pid > 0:
            _leaving[self._pid] = _lives.pop(self._line)
        elif self._line in _lives:
            os.close(_lives.pop(self._line))
        _reap()

    def _done(self, order: bytes) -> tuple[bool, str]:
        """Send an order to the process, and return its answer: success and a message.

        If the process ends, or exceeds its time limit and is killed, the fault is written into the flight's memory.
        """
        calls = int(self._seen["calls"][0])
        limit_s = time_limit_s(self.computer, int(self._seen["inside"][0])) + _SOCKET_S * bool(self.computer.address)
        with contextlib.suppress(OSError):
            self._line.send_bytes(order)
        since, stopped = time.monotonic(), False
        while True:
            if self._answers.poll(1000.0 * _POLL_S):
                try:
                    answer = self._line.recv_bytes()
                    return answer[:1] == b"1", answer[1:].decode(errors="replace")
                except (EOFError, OSError):
                    time.sleep(_POLL_S)  # the process is ending, or its code has closed the connection
            pid, status = os.waitpid(self._pid, os.WNOHANG | os.WUNTRACED | os.WCONTINUED)
            if pid != 0 and (os.WIFEXITED(status) or os.WIFSIGNALED(status)):
                self._seen["fault"][0], self._seen["code"][0] = CRASHED, os.waitstatus_to_exitcode(status)
                _kill_group(self._pid)
                break
            stopped = os.WIFSTOPPED(status) if pid != 0 else stopped
            before, calls, inside = calls, int(self._seen["calls"][0]), int(self._seen["inside"][0])
            if calls != before or inside == 0:
                since = time.monotonic()
            elif time.monotonic() - since > limit_s:
                _kill_group(self._pid)
                os.waitpid(self._pid, 0)
                self._seen["fault"][0], self._seen["code"][0] = STUCK, STOPPED if stopped else 0
                break
        self._pid = 0
        _lines[self._line] = 0
        return False, ""


def _kill_group(pid: int) -> None:
    """Kill a worker, if it has not ended, and the processes that its code has started."""
    with contextlib.suppress(ProcessLookupError, PermissionError):
        os.killpg(pid, signal.SIGKILL)


_COMMANDS = ("gimbal_rad[0], pitch", "gimbal_rad[1], yaw", "roll_gimbal_rad", "cutoff_delay_s", "commanded_q_BR")
_RANGES = ("not a finite number, or beyond 1e6 rad",) * 3 + ("not from 0 to 1000 s", "not finite, or beyond 1e6")
_TEXTS = {
    BAD_THRUSTER: "gave roll_thruster = {}: allowed is -1, 0 or 1",
    BAD_TURN: "gave turn_thruster = {}: allowed is -1, 0 or 1",
    BAD_THROTTLE: f"gave throttle: allowed is 0, or {THROTTLE[0]:g} to {THROTTLE[1]:g}",
    ABORTED: "aborted the flight with abort = {}",
    TOO_MANY: f"commanded more than {MAX_IGNITIONS} ignitions",
    OVERWROTE: OVERWROTE_TEXT,
}
_DURING = {0: "between two samples", 1: "in its step", STARTING: "at its start", ENDING: "at its end"}


def complaint(
    computer: ComputerSection,
    said: str,
    fault: int,
    code: int,
    inside: int,
    separation: tuple[int, int] = (0, NO_SEPARATION),
) -> str:
    """Return the description of a fault of flight code, without control characters; without a fault, `said`.

    `said` is the message of the code. `fault`, `code` and `inside` are the fields of ExternalState. `separation` is the
    number of the stage, from 0, and the separation that ends it, an index into SEPARATIONS.
    """
    during = _DURING.get(inside, "")
    if fault in _TEXTS:
        said = _TEXTS[fault].format(code)
    elif fault == NOT_FINITE and 0 <= code < len(_COMMANDS):
        said = f"gave {_COMMANDS[code]}: {_RANGES[code]}"
    elif fault in (BAD_SEPARATION, EARLY):
        said = _separation_text(fault, code, *separation)
    elif fault == CRASHED:
        said = _end_text(code, during)
    elif fault == STUCK:
        stopped = "its process is stopped; it " if code == STOPPED else ""
        said = f"{stopped}did not return within {time_limit_s(computer, inside):g} s {during}"
    elif fault != 0:
        said = said or f"its step returned {code}"
    return printable(said)


def _separation_text(fault: int, code: int, stage: int, ends: int) -> str:
    """Return the description of a separation that the vehicle does not allow at this time."""
    due = SEPARATIONS[ends] or "no separation"
    if fault == BAD_SEPARATION and 0 <= code < len(SEPARATIONS):
        return f"commanded {SEPARATIONS[code]} in stage {stage + 1}: allowed is {due}"
    return f"commanded {due} in stage {stage + 1} before the tables of stage {stage + 2} begin"


def _end_text(code: int, during: str) -> str:
    """Return the description of the end of a process from its exit code or, if negative, its signal."""
    name = end_name(code)
    if code >= 0:
        return f"crashed {during}: its process ended with {name}"
    if name in ("SIGSEGV", "SIGBUS"):
        return f"crashed {during}: {name}, access to memory that is not its own"
    return f"its process was killed {during}: {name}" if name in ("SIGKILL", "SIGTERM") else f"crashed {during}: {name}"


def time_limit_s(computer: ComputerSection, inside: int) -> float:
    """Return the time limit for a call of flight code, s. `inside` is the field of ExternalState."""
    return computer.timeout_s + (IMPORT_S if computer.python is not None and inside == STARTING else 0.0)


def worker_for(computer: ComputerSection, arrays: Arrays) -> Worker:
    """Return an idle worker with the same code and sufficient memory, or a new worker."""
    kinds, size = [array.dtype for array in arrays], _places([array.nbytes for array in arrays])[-1]
    _reap()
    with _FORK:
        for worker in _idle:
            if _code(worker.computer) == _code(computer) and worker.kinds == kinds and worker.size >= size:
                _idle.remove(worker)
                return worker
    return Worker(computer, kinds, max(2 * size, _SMALLEST))


def _code(computer: ComputerSection) -> tuple[Any, ...]:
    """Return the keys of the computer that must be equal for a worker; the others are set for each flight."""
    return computer.library, computer.python, computer.data, computer.address, computer.timeout_s, computer.sandbox


def _reap() -> None:
    """Collect the exit status of processes that have ended."""
    for pid, life in tuple(_leaving.items()):
        with contextlib.suppress(ChildProcessError):
            if os.waitpid(pid, os.WNOHANG)[0] == 0:
                continue
        if _leaving.pop(pid, None) is not None:
            os.close(life)


def _end_idle() -> None:
    while _idle:
        _idle.pop().end()


def end_workers() -> None:
    """End all idle workers, and wait for their processes."""
    _end_idle()
    while _leaving:
        _reap()
        time.sleep(1e-3)


def kill_workers() -> None:
    """Kill all worker processes, because this process is about to end without the usual cleanup."""
    for pid in filter(None, (*_lines.values(), *_leaving)):
        _kill_group(pid)


def _forget() -> None:
    """Discard the workers in a forked process, because they belong to its parent."""
    for line in _lines:
        line.close()
    for life in (*_lives.values(), *_leaving.values()):
        os.close(life)
    _lines.clear()
    _lives.clear()
    _idle.clear()
    _leaving.clear()


if FORKS:
    os.register_at_fork(after_in_child=_forget)
    atexit.register(_end_idle)


def _places(sizes: Sequence[int]) -> list[int]:
    """Return the offsets of arrays of these sizes in shared memory, in whole pages, and the end of the last."""
    ends = [0]
    for size in sizes:
        ends.append(ends[-1] + whole_pages(size))
    return ends


def _placed(room: mmap.mmap, kinds: Sequence[np.dtype[Any]], shapes: Sequence[tuple[int, ...]]) -> Arrays:
    """Return arrays in shared memory, the parameters first."""
    counts = [int(np.prod(shape)) for shape in shapes]
    starts = _places([kind.itemsize * count for kind, count in zip(kinds, counts, strict=True)])
    return tuple(
        np.frombuffer(room, kind, count, GUARD + start).reshape(shape)
        for kind, count, shape, start in zip(kinds, counts, shapes, starts[:-1], strict=True)
    )


class _Flying:
    """The worker's end of the connection, which carries out orders."""

    def __init__(self, line: Any, room: mmap.mmap, computer: ComputerSection, kinds: list[np.dtype[Any]]) -> None:
        self._line, self._room, self._computer, self._kinds = line, room, computer, kinds
        self._arrays: Arrays = ()
        self._instance: Instance | None = None
        self._restricted = False
        self._first = ctypes.addressof(ctypes.c_char.from_buffer(room))
        self._read_only = 0  # bytes after the first guard

    def serve(self, parent_lives: int) -> NoReturn:
        """Carry out orders until the connection ends, and exit. `parent_lives` is a pipe that ends with the parent."""
        code = 1
        try:
            _end_with(parent_lives)
            if hasattr(mmap, "MADV_DONTFORK"):  # processes of the code do not share the memory of the flight
                self._room.madvise(mmap.MADV_DONTFORK)
            make_inaccessible(self._first)
            make_inaccessible(self._first + len(self._room) - GUARD)
            for number in _IGNORED:
                signal.signal(number, signal.SIG_IGN)
        except ValueError:
            pass  # forked by a thread, which is now the main thread
        try:
            gc.freeze()
            while True:
                order = self._line.recv_bytes()
                good, said = {b"S": self._start, b"A": self._advance, b"C": self._close}[order[:1]](order[1:])
                self._line.send_bytes((b"1" if good else b"0") + said.encode())
        except (EOFError, OSError):
            code = 0
        finally:
            with contextlib.suppress(Exception):
                sys.stdout.flush()
                sys.stderr.flush()
                ctypes.CDLL(None).fflush(None)
            if code == 0:
                _kill_group(os.getpid())
            os._exit(code)

    def _start(self, order: bytes) -> tuple[bool, str]:
        shapes, setup, held = pickle.loads(order)
        self._arrays = _placed(self._room, self._kinds, shapes)
        parameters = _places([array.nbytes for array in self._arrays[:MEMORY]])[-1]
        if parameters != self._read_only:
            make_writable(self._first + GUARD, self._read_only)
            make_read_only(self._first + GUARD, parameters)
            self._read_only = parameters
        state = self._arrays[MEMORY][0].computer.external
        if self._computer.python is not None and not self._restricted:  # before it is imported
            self._restricted = True
            only_hashed_reads(self._computer.hashed_files.values())
        try:
            watched = watched_ranges(self._arrays[0], *self._arrays[MEMORY : MEMORY + 2])
            self._instance = instance_for(self._computer, Setup.from_buffer_copy(setup), held, state, watched)
        except Unusable as error:
            return False, str(error) or type(error).__name__
        state.inside = 0
        return True, ""

    def _advance(self, order: bytes) -> tuple[bool, str]:
        advance_to(int.from_bytes(order, sys.byteorder, signed=True), self._arrays)
        return True, self._instance.error if self._instance is not None else ""

    def _close(self, _: bytes) -> tuple[bool, str]:
        instance, self._instance = self._instance, None
        if instance is None:
            return False, ""
        said = ended(instance)
        with own_floating_point():
            return instance.unload() and not _has_processes(), said


def _end_with(parent_lives: int) -> None:
    """Make this process the leader of a group, which the kernel kills at the end of the pipe `parent_lives`.

    A parent-death signal would not do: Linux sends it when the thread that has forked ends. Elsewhere, only the group
    is made.
    """
    os.setpgid(0, 0)
    if fcntl is None or not hasattr(fcntl, "F_SETSIG"):
        return
    fcntl.fcntl(parent_lives, fcntl.F_SETOWN, -os.getpid())
    fcntl.fcntl(parent_lives, fcntl.F_SETSIG, signal.SIGKILL)
    fcntl.fcntl(parent_lives, fcntl.F_SETFL, fcntl.fcntl(parent_lives, fcntl.F_GETFL) | os.O_ASYNC)
    if select.select([parent_lives], [], [], 0.0)[0]:  # the parent has ended in the meantime
        os._exit(1)


def _has_processes() -> bool:
    """Return True if flight code has started processes that have not ended."""
    with contextlib.suppress(ChildProcessError):
        while os.waitpid(-1, os.WNOHANG)[0] != 0:
            pass
        return True
    return False


def instance_for(
    computer: ComputerSection, setup: Setup, held: CodeWindows | None, state: Any, watched: MemoryRanges = ()
) -> Instance:
    """Return a started instance of the code for a flight, or for a held flight if `held` is given.

    `state` is the ExternalState. It receives the call of the code, and its counter shows that a held flight is
    progressing. `watched` is the memory that the code must not change. Raises Unusable.
    """

    def alive() -> None:
        state.calls += 1

    inputs, outputs = (record.__array_interface__["data"][0] for record in (state.inputs, state.outputs))
    if held is not None:  # its instances are watched, but not its own code, which writes to `state`
        instance: Instance = HeldCode(computer, held, alive, watched)
        instance.connect(state.call, (inputs, outputs))
    else:
        instance = started(computer, setup)
        instance.connect(state.call, (inputs, outputs), watched)
    return instance


def advance_to(until_ns: int, arrays: Arrays) -> None:
    parameters, pool, memory, state, arena, *logged_rows = arrays
    advance(parameters, pool, memory, state, arena, until_ns, *logged_rows)
