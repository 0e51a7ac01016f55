"""The progress of a compilation, as the finished share of its estimated cost in all processes.

The cost is estimated before the compilation begins. Kernels call each other by global names, so the bytecode of an
entry names all kernels that it needs.
"""

from __future__ import annotations

import contextlib
import dis
import functools
import mmap
from collections.abc import Callable, Iterator
from types import ModuleType
from typing import Any

import numpy as np

_OPTIMISED = 0.19
"""The cost of optimising and emitting one byte of bytecode, relative to that of its translation to LLVM IR.

The bytes of an inlined kernel count at each call. Measured for the four parts of a flight's kernels: 0.17 to 0.22.
"""

watchers: list[Callable[[str, float], None]] = []
"""The functions called with the name of a compilation ("" for a part of maxq) and its finished share, 0 to 1.

The compiling thread calls them.
"""


def called_kernels(function: Any) -> list[Any]:
    """Return the kernels that a function names, once per occurrence in its code, including attributes of modules."""
    found, owner = list[Any](), None
    for step in dis.get_instructions(function):
        if step.opname.startswith("LOAD_GLOBAL"):
            owner = function.__globals__.get(step.argval)
        elif step.opname in ("LOAD_ATTR", "LOAD_METHOD") and isinstance(owner, ModuleType):
            owner = getattr(owner, step.argval, None)
        else:
            continue
        if hasattr(owner, "is_inlined"):
            found.append(owner)
    return found


class _Part:
    """The code that one process can compile: an entry or a routine, with all kernels that it calls."""

    def __init__(self, function: Any) -> None:
        self.apart = list[Any]()  # routines that other processes can compile
        self.left = {function: len(function.__code__.co_code)}  # bytecode sizes of the functions not translated yet
        calls = {function: called_kernels(function)}
        open_ = [function]
        while open_:
            for kernel in calls[open_.pop()]:
                called = kernel.py_func
                if kernel.is_apart:
                    self.apart.append(called)
                elif called not in calls:
                    self.left[called], calls[called] = len(called.__code__.co_code), called_kernels(called)
                    open_.append(called)
        sizes, whole = dict(self.left), dict[Any, int]()

        def inlined(of: Any) -> int:
            if of not in whole:
                whole[of] = sizes[of] + sum(inlined(k.py_func) for k in calls[of] if k.is_inlined)
            return whole[of]

        bodies = {k.py_func for called in calls.values() for k in called if not k.is_inlined and not k.is_apart}
        self.translation = float(sum(sizes.values()))
        self.cost = self.translation + _OPTIMISED * sum(map(inlined, {function, *bodies}))


class Compilation:
    """The compilation of the entries `functions`, such as those of a first flight; `name` is used in reports."""

    def __init__(self, name: str, functions: list[Any]) -> None:
        self.name, self._functions = name, functions
        self._inside, self._loaded = list[Any](), set[Any]()
        self._reported = False

    @functools.cached_property
    def _parts(self) -> dict[Any, _Part]:
        """Return the parts by function; a process that loads all machine code does not compute them."""
        parts, functions = dict[Any, _Part](), list(self._functions)
        while functions:
            function = functions.pop()
            if function not in parts:
                parts[function] = _Part(function)
                functions += parts[function].apart
        return parts

    @functools.cached_property
    def _done(self) -> dict[Any, Any]:
        """Return the finished cost of each part, in memory shared with forked processes."""
        shared = np.frombuffer(mmap.mmap(-1, 8 * len(self._parts)), np.float64)
        done = {function: shared[place : place + 1] for place, function in enumerate(self._parts)}
        for function in self._loaded & done.keys():
            done[function][0] = self._parts[function].cost
        return done

    @property
    def share(self) -> float:
        """Return the finished share of the estimated cost, 0 to 1."""
        return float(sum(done[0] for done in self._done.values()) / sum(part.cost for part in self._parts.values()))

    def report(self, share: float | None = None) -> None:
        self._reported = True
        for watch in watchers:
            watch(self.name, self.share if share is None else share)

    def close(self) -> None:
        """Report the full share, if any progress has been reported."""
        if self._reported:
            self.report(1.0)

    def loaded(self, function: Any) -> None:
        """Count a part as finished, because its machine code was loaded from disk."""
        self._loaded.add(function)
        if self._reported and function in self._done:
            self._done[function][0] = self._parts[function].cost

    @contextlib.contextmanager
    def part(self, function: Any) -> Iterator[None]:
        """Count the code compiled within this block as the part `function`, unless it is not in this compilation."""
        known = function in self._parts
        self._inside += [function] * known
        try:
            yield
        finally:
            del self._inside[len(self._inside) - known :]
        if known:
            self._done[function][0] = self._parts[function].cost
            self.report()

    def translated(self, function: Any = None) -> None:
        """Count `function` as translated in the part being compiled; without an argument, count all functions.

        The functions that remain at the end of a part are not called, or were translated with another part.
        """
        if self._inside:
            part, done = self._parts[self._inside[-1]], self._done[self._inside[-1]]
            part.left = {each: size for each, size in part.left.items() if function not in (None, each)}
            done[0] = max(done[0], part.translation - sum(part.left.values()))
            self.report()


_open: list[Compilation] = []
"""The compilation in progress, in a list of at most one element."""


def current() -> Compilation:
    """Return the compilation in progress, or an empty compilation."""
    return _open[0] if _open else Compilation("", [])


@contextlib.contextmanager
def compilation(name: str, *entries: Any) -> Iterator[None]:
    """Report all code compiled within this block as one compilation of `entries`, called `name`.

    Within another compilation, in this thread or another, the block has no effect.
    """
    if _open:
        yield
        return
    made = Compilation(name, [getattr(entry, "py_func", entry) for entry in entries])
    _open.append(made)
    try:
        yield
    finally:
        _open.remove(made)
        made.close()
