"""Floating-point operations of a flight, counted: the Python source of the kernels flies on numbers that
count.

The kernels run uncompiled (NUMBA_DISABLE_JIT=1) on stand-ins for their arrays and records, which hand out
floats of a class that counts its own arithmetic by the file that does it. So what is counted is what the
source says is done, for every branch that is really taken; what the compiler saves (a subexpression used
twice, a factor of zero) is not taken off. Vector algebra and table look-up count for the file that calls
them.
"""

from __future__ import annotations

import json
import math
import os
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from types import FrameType
from typing import Any

from maxq.sim.run import fly
from maxq.tools.dev.bench.midflight import restore

COUNTED_STEPS = 100  # ten samples of the flight computer
SHARED = {"vectors.py", "tables.py"}  # what these do is done for their caller
TRANSCENDENTAL = (
    "sin",
    "cos",
    "tan",
    "asin",
    "acos",
    "atan",
    "atan2",
    "exp",
    "log",
    "pow",
    "degrees",
    "radians",
)
KINDS = ("add", "multiply", "divide", "sqrt", "function")

_counts: Counter[tuple[str, str]] = Counter()


def _file(frame: FrameType | None) -> str:
    """File that the operation counts for: the first up the stack that is not shared."""
    name = "?"
    while frame is not None:
        name = Path(frame.f_code.co_filename).name
        if name not in SHARED and name != Path(__file__).name:
            return name
        frame = frame.f_back
    return name


def _count(kind: str) -> None:
    _counts[_file(sys._getframe(2)), kind] += 1


class Counting(float):
    """A float that counts what is done with it. Signs and comparisons are free."""

    __slots__ = ()

    def __neg__(self) -> Counting:
        return Counting(float.__neg__(self))

    def __abs__(self) -> Counting:
        return Counting(float.__abs__(self))


def _arithmetic(name: str, kind: str) -> None:
    plain: Callable[[float, float], float] = getattr(float, name)

    def counted(self: float, other: float) -> Any:
        result = plain(self, other)
        if result is NotImplemented:
            return result
        _count(kind)
        return Counting(result)

    setattr(Counting, name, counted)


for _name, _kind in (
    ("add", "add"), ("sub", "add"), ("mul", "multiply"), ("truediv", "divide"), ("pow", "function"),
):  # fmt: skip
    _arithmetic(f"__{_name}__", _kind)
    _arithmetic(f"__r{_name}__", _kind)


def _count_functions() -> None:
    """From here on `math`'s functions count too."""

    def counted(plain: Callable[..., float], kind: str) -> Callable[..., Counting]:
        def function(*arguments: float) -> Counting:
            _count(kind)
            return Counting(plain(*arguments))

        return function

    math.sqrt = counted(math.sqrt, "sqrt")
    for name in TRANSCENDENTAL:
        kind = "multiply" if name in ("degrees", "radians") else "function"
        setattr(math, name, counted(getattr(math, name), kind))


class CountedArray:
    """An array whose elements count; views of it, and records in it, do so too."""

    def __init__(self, array: Any) -> None:
        self._array = array

    def __len__(self) -> int:
        return len(self._array)

    def __getitem__(self, index: Any) -> Any:
        return _counted(self._array[index])

    def __setitem__(self, index: Any, value: Any) -> None:
        self._array[index] = value


class CountedRecord:
    """A record whose fields count."""

    def __init__(self, record: Any) -> None:
        object.__setattr__(self, "_record", record)

    def __getattr__(self, name: str) -> Any:
        return _counted(self._record[name])

    def __getitem__(self, name: str) -> Any:
        return _counted(self._record[name])

    def __setattr__(self, name: str, value: Any) -> None:
        self._record[name] = value


def _counted(value: Any) -> Any:
    kind = getattr(value, "dtype", None)
    if kind is None:
        return value
    if getattr(value, "shape", ()):
        return CountedArray(value)
    if kind.names is not None:
        return CountedRecord(value)
    return Counting(value) if kind.kind == "f" else int(value)


def count(path: Path) -> dict[str, Any]:
    """Operations of `COUNTED_STEPS` steps from the flight saved at `path`: `steps`, `files`: file -> kind
    -> count.
    """
    run = restore(path)
    before = int(run.memory.clock.steps)
    plain: Callable[..., None] = getattr(fly, "advance")  # noqa: B009 - fly imports it and does not export it

    def advance(*arguments: Any) -> None:
        plain(*(CountedArray(a) if hasattr(a, "dtype") else a for a in arguments))

    setattr(fly, "advance", advance)  # noqa: B010 - the same
    _count_functions()
    run.fly_segment(COUNTED_STEPS * int(run.packed.parameters[0].course.step_ns))
    files: dict[str, dict[str, int]] = {}
    for (file, kind), number in _counts.items():
        files.setdefault(file, dict.fromkeys(KINDS, 0))[kind] = number
    return {"steps": int(run.memory.clock.steps) - before, "files": files}


def measure() -> dict[str, Any]:
    """The count, in processes of their own: one flies there compiled, one counts uncompiled."""
    with tempfile.TemporaryDirectory() as scratch:
        path = Path(scratch) / "flight.npz"
        subprocess.run([sys.executable, "-m", "maxq.tools.dev.bench.midflight", str(path)], check=True)
        counting = subprocess.run(
            [sys.executable, "-m", "maxq.tools.dev.bench.operations", str(path)],
            env={**os.environ, "NUMBA_DISABLE_JIT": "1"},
            check=True,
            stdout=subprocess.PIPE,
        )
    result: dict[str, Any] = json.loads(counting.stdout)
    return result


if __name__ == "__main__":
    print(json.dumps(count(Path(sys.argv[1])) if len(sys.argv) > 1 else measure()))
