"""The protection of the simulator from external flight code that runs in the same process.

- The code receives copies of its inputs and outputs. These copies, its setup and the memory of an instance end at pages
  that cannot be accessed: writing beyond them is a crash of the code.
- The memory and state vector of the flight are compared before and after each call (watched.py, control/external.py),
  and its parameters can only be read.
- The code has its own floating-point modes (rounding, flush to zero, traps).

Without `mprotect` (Windows), the pages can be accessed; without `fegetenv`, the modes are shared.
"""

from __future__ import annotations

import contextlib
import ctypes
import mmap
from collections.abc import Iterator, Sequence
from functools import cache
from typing import Any

MemoryRanges = Sequence[tuple[int, int]]
"""Addresses and sizes of memory, bytes."""
GUARD = 1 << 20
"""The length of each range of inaccessible pages, bytes."""
OVERWROTE_TEXT = "overwrote memory of the simulator in its step"
_NONE, _READ, _WRITE = 0, 1, 2  # PROT_NONE, PROT_READ and PROT_WRITE of <sys/mman.h>
_MODE_BYTES = 256  # at least the size of fenv_t and femode_t on all platforms
_LIBRARIES = (None, "libm.so.6", "ucrtbase")


@cache
def _function(name: str) -> Any:
    """Return a function of the C library, or None if the platform has none."""
    for library in _LIBRARIES:
        with contextlib.suppress(OSError, AttributeError, TypeError):
            return getattr(ctypes.CDLL(library), name)
    return None


@cache
def _address_of(name: str) -> int:
    function = _function(name)
    return (ctypes.cast(function, ctypes.c_void_p).value or 0) if function is not None else 0


@cache
def _mode_functions() -> tuple[str, str]:
    """Return the names of the functions that get and set floating-point modes; those of C23 are faster."""
    modes, environment = ("fegetmode", "fesetmode"), ("fegetenv", "fesetenv")
    return modes if all(map(_function, modes)) else environment


def _restrict(address: int, size: int, access: int) -> None:
    protect = _function("mprotect")
    if protect is not None and size > 0:
        protect(ctypes.c_void_p(address), ctypes.c_size_t(size), access)


def make_inaccessible(address: int, size: int = GUARD) -> None:
    """Exclude whole pages of this process from reading and writing."""
    _restrict(address, size, _NONE)


def make_read_only(address: int, size: int) -> None:
    """Exclude whole pages of this process from writing."""
    _restrict(address, size, _READ)


def make_writable(address: int, size: int) -> None:
    """Permit this process again to write to whole pages."""
    _restrict(address, size, _READ | _WRITE)


def whole_pages(size: int) -> int:
    """Return a size rounded up to whole pages, bytes."""
    return -(-size // mmap.PAGESIZE) * mmap.PAGESIZE


class GuardedMemory:
    """Zeroed memory of `size` bytes at `address`, which ends at an inaccessible page. A range of these precedes it."""

    def __init__(self, size: int) -> None:
        span = whole_pages(max(size, 1))
        private = {"flags": mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS} if hasattr(mmap, "MAP_PRIVATE") else {}
        self._map = mmap.mmap(-1, span + 2 * GUARD, **private)
        first = ctypes.addressof(ctypes.c_char.from_buffer(self._map))
        make_inaccessible(first)
        make_inaccessible(first + GUARD + span)
        self.size, self.address = size, first + GUARD + span - size


class FloatingPoint:
    """The floating-point modes (`femode_t`, or `fenv_t`) of the calling thread at construction."""

    def __init__(self) -> None:
        self._room = ctypes.create_string_buffer(_MODE_BYTES)
        self.address = ctypes.addressof(self._room)
        self.store()

    def store(self) -> None:
        if (get := _function(_mode_functions()[0])) is not None:
            get(ctypes.c_void_p(self.address))

    def restore(self) -> None:
        if (put := _function(_mode_functions()[1])) is not None:
            put(ctypes.c_void_p(self.address))


@contextlib.contextmanager
def own_floating_point() -> Iterator[FloatingPoint]:
    """Restore the floating-point modes at the end of a block, and store those of the block in the result."""
    own, of_block = FloatingPoint(), FloatingPoint()
    try:
        yield of_block
    finally:
        of_block.store()
        own.restore()


class Protection:
    """The memory behind a ProtectedCall (control/external.py), for inputs and outputs of these sizes, bytes."""

    def __init__(self, code_mode: FloatingPoint, given_bytes: int, taken_bytes: int) -> None:
        self._given, self._taken = GuardedMemory(given_bytes), GuardedMemory(taken_bytes)
        self._own_mode, self._code_mode = FloatingPoint(), code_mode
        self._table: Any = None

    def bind(self, call: Any, step: int, instance: int, inputs: int, outputs: int) -> None:
        """Write into the record `call` the addresses with which the function `step` of an instance is called.

        `inputs` and `outputs` are the addresses of the simulator's structs.
        """
        call.given, call.given_from, call.given_bytes = self._given.address, inputs, self._given.size
        call.taken, call.taken_to, call.taken_bytes = self._taken.address, outputs, self._taken.size
        call.own_mode, call.code_mode = self._own_mode.address, self._code_mode.address
        call.copies, call.compares = _address_of("memcpy"), _address_of("memcmp")
        both = tuple(map(_address_of, _mode_functions()))
        call.get_mode, call.set_mode = both if all(both) else (0, 0)
        call.step, call.instance = step, instance

    def watch(self, call: Any, ranges: MemoryRanges) -> None:
        """Compare these ranges of memory before and after each call."""
        words = [len(ranges), *(word for one in ranges for word in one)]
        self._table = (ctypes.c_int64 * (len(words) + -(-sum(size for _, size in ranges) // 8)))(*words)
        call.watched = ctypes.addressof(self._table) if ranges else 0
