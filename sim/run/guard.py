"""The processes that fly external flight code, so that a crash or an endless loop ends a single flight only.

A worker is forked with shared memory, in which it flies the flight. After a flight, the worker is reused for the next
flight with the same code, because a fork takes as long as a third of a flight. A library is unloaded in between, so
that each flight begins as in a fresh process. If a part of the code would remain (Python modules, a library that cannot
be unloaded or has started threads), the worker ends with its flight.
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
from typing import Any, NoReturn

import numpy as np
from numpy.typing import NDArray

from maxq.control.external import CRASHED, STUCK
from maxq.sim.flight.loop import advance
from maxq.sim.run.hashed_reads import only_hashed_reads
from maxq.sim.run.held_code import CodeWindows, HeldCode
from maxq.sim.run.instances import Instance, Setup, Unusable, started
from maxq.sim.scenario.schema_vehicle import ComputerSection

Arrays = tuple[NDArray[Any], ...]
"""The arguments of `loop.advance` in order, except `until_ns`."""
MEMORY = 2  # index of the flight's memory in Arrays

STARTING = 2  # value of `inside` while an instance is made
_SMALLEST = 1 << 24  # least shared memory of a worker, bytes; the unused part takes no memory
IMPORT_S = 30.0  # additional time limit for the start of Python code, which each process imports
_SOCKET_S = 5.0  # additional time limit for a socket, which has a separate time limit
_POLL_S = 0.05
_FORK = threading.RLock()  # reentrant, because a garbage collection may release a worker while the lock is held
_idle: list[Worker] = []
_lines: dict[Any, int] = {}  # the connections to workers, and the process at the other end of each
_leaving: set[int] = set()  # ids of processes that are ending


class Worker:
    """A process that flies the code of `computer` on arrays of the types `kinds` in `size` bytes of shared memory."""

    def __init__(self, computer: ComputerSection, kinds: list[np.dtype[Any]], size: int) -> None:
        self.computer, self.kinds, self.size = computer, kinds, size
        self._room = mmap.mmap(-1, size)
        with _FORK:
            self._line, theirs = Pipe()
            _lines[self._line] = 0  # closed in the other process
            for stream in (sys.stdout, sys.stderr):  # otherwise, both processes would write the buffered output
                with contextlib.suppress(OSError, ValueError, AttributeError):
                    stream.flush()
            self._pid = os.fork()
            if self._pid == 0:
                _Flying(theirs, self._room, computer, kinds).serve()
            theirs.close()
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

    def release(self) -> None:
        """End the flight: close the code, and keep the worker for the next flight if no part of the code remains."""
        self._seen["inside"][0] = 1  # otherwise, closing would have no time limit
        clean = self._pid > 0 and self._done(b"C")[0]
        self._seen.clear()
        if not clean:
            self.end()
            return
        with _FORK:
            _idle.append(self)
            oldest = _idle.pop(0) if len(_idle) > 2 * (os.cpu_count() or 1) else None
        if oldest is not None:
            oldest.end()

    def end(self) -> None:
        """Close the connection, which ends the process."""
        _lines.pop(self._line, None)
        self._line.close()
        if self._pid > 0:
            _leaving.add(self._pid)
        _reap()

    def _done(self, order: bytes) -> tuple[bool, str]:
        """Send an order to the process, and return its answer: success and a message.

        If the process ends, or exceeds its time limit and is killed, the fault is written into the flight's memory.
        """
        calls = int(self._seen["calls"][0])
        limit_s = time_limit_s(self.computer, int(self._seen["inside"][0])) + _SOCKET_S * bool(self.computer.address)
        with contextlib.suppress(OSError):
            self._line.send_bytes(order)
        since = time.monotonic()
        while True:
            if self._answers.poll(1000.0 * _POLL_S):
                try:
                    answer = self._line.recv_bytes()
                except (EOFError, OSError):
                    _, status = os.waitpid(self._pid, 0)
                    self._seen["fault"][0], self._seen["code"][0] = CRASHED, os.waitstatus_to_exitcode(status)
                    break
                return answer[:1] == b"1", answer[1:].decode(errors="replace")
            before, calls, inside = calls, int(self._seen["calls"][0]), int(self._seen["inside"][0])
            if calls != before or inside == 0:
                since = time.monotonic()
            elif time.monotonic() - since > limit_s:
                os.kill(self._pid, signal.SIGKILL)
                os.waitpid(self._pid, 0)
                self._seen["fault"][0] = STUCK
                break
        self._pid = 0
        _lines[self._line] = 0
        return False, ""


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
    return computer.library, computer.python, computer.data, computer.address, computer.timeout_s


def _reap() -> None:
    """Collect the exit status of processes that have ended."""
    for pid in tuple(_leaving):
        with contextlib.suppress(ChildProcessError):
            if os.waitpid(pid, os.WNOHANG)[0] == 0:
                continue
        _leaving.discard(pid)


def _end_idle() -> None:
    while _idle:
        _idle.pop().end()


def kill_workers() -> None:
    """Kill all worker processes, because this process is about to end without the usual cleanup."""
    for pid in filter(None, (*_lines.values(), *_leaving)):
        with contextlib.suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)


def _forget() -> None:
    """Discard the workers in a forked process, because they belong to its parent."""
    for line in _lines:
        line.close()
    _lines.clear()
    _idle.clear()
    _leaving.clear()


if hasattr(os, "fork"):
    os.register_at_fork(after_in_child=_forget)
    atexit.register(_end_idle)


def _places(sizes: Sequence[int]) -> list[int]:
    """Return the offsets of arrays of these sizes in shared memory, aligned to 64 bytes, and the end of the last."""
    ends = [0]
    for size in sizes:
        ends.append(ends[-1] + -(-size // 64) * 64)
    return ends


def _placed(room: mmap.mmap, kinds: Sequence[np.dtype[Any]], shapes: Sequence[tuple[int, ...]]) -> Arrays:
    counts = [int(np.prod(shape)) for shape in shapes]
    starts = _places([kind.itemsize * count for kind, count in zip(kinds, counts, strict=True)])
    return tuple(
        np.frombuffer(room, kind, count, start).reshape(shape)
        for kind, count, start, shape in zip(kinds, counts, starts, shapes, strict=False)
    )


class _Flying:
    """The worker's end of the connection, which carries out orders."""

    def __init__(self, line: Any, room: mmap.mmap, computer: ComputerSection, kinds: list[np.dtype[Any]]) -> None:
        self._line, self._room, self._computer, self._kinds = line, room, computer, kinds
        self._arrays: Arrays = ()
        self._instance: Instance | None = None
        self._restricted = False

    def serve(self) -> NoReturn:
        """Carry out orders until the connection ends, and exit."""
        code = 1
        try:
            for number in (signal.SIGINT, signal.SIGTERM):  # the parent process handles these signals
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
            os._exit(code)

    def _start(self, order: bytes) -> tuple[bool, str]:
        shapes, setup, held = pickle.loads(order)
        self._arrays = _placed(self._room, self._kinds, shapes)
        state = self._arrays[MEMORY][0].computer.external
        if self._computer.python is not None and not self._restricted:  # before it is imported
            self._restricted = True
            only_hashed_reads(self._computer.hashed_files.values())
        try:
            self._instance = instance_for(self._computer, Setup.from_buffer_copy(setup), held, state)
        except Unusable as error:
            return False, str(error) or type(error).__name__
        self._instance.connect(state)
        return True, ""

    def _advance(self, order: bytes) -> tuple[bool, str]:
        advance_to(int.from_bytes(order, sys.byteorder, signed=True), self._arrays)
        return True, self._instance.error if self._instance is not None else ""

    def _close(self, _: bytes) -> tuple[bool, str]:
        instance, self._instance = self._instance, None
        if instance is None:
            return False, ""
        instance.close()
        return instance.unload(), ""


def instance_for(computer: ComputerSection, setup: Setup, held: CodeWindows | None, state: Any) -> Instance:
    """Return a started instance of the code for a flight, or for a held flight if `held` is given.

    `state` is the ExternalState, whose counter shows that a held flight is progressing. Raises Unusable.
    """
    if held is None:
        return started(computer, setup)

    def alive() -> None:
        state.calls += 1

    return HeldCode(computer, held, alive)


def advance_to(until_ns: int, arrays: Arrays) -> None:
    parameters, pool, memory, state, arena, *logged_rows = arrays
    advance(parameters, pool, memory, state, arena, until_ns, *logged_rows)
