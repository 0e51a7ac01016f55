"""The memory of a flight that external flight code must not change, compared before and after each call.

Parts that a flight does not use are left out, because no part of the simulator reads them. Section loads, log rows and
work memory are not compared: they are larger than all the rest.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields
from functools import lru_cache
from typing import Any

from maxq.control.kernel.records import Records, dtype_of
from maxq.sim.flight.parameters import Memory
from maxq.sim.vehicle.state import Sizes, state_names

_LOOPS = "computer.loops"
_UNUSED: dict[tuple[str, str], Callable[[Records], bool]] = {
    ("sections", ""): lambda _: True,
    ("computer.sensors", ""): lambda p: not p["computer"]["sensors"]["count"].any(),
    (_LOOPS, "memory"): lambda p: len(p) == 1 and not p["computer"]["loops"]["on"].any(),
    ("faults", "on"): lambda p: not p["faults"]["count"].any(),
    ("history", ""): lambda p: not p["environment"]["penetration"].any(),
}
"""The parts of Memory that a flight with these Parameters (stages,) may not use: path, and the first field in it.

A part extends from this field to the end of its record; without a name, it is the whole record.
"""


def _place(path: str, first: str) -> tuple[int, int]:
    """Return the offsets of the first and past the last byte of a part of Memory."""
    layout, offset = dtype_of(Memory), 0
    for name in path.split("."):
        layout, at = dict(layout.fields or {})[name][:2]
        offset += at
    begin = dict(layout.fields or {})[first][1] if first else 0
    return offset + begin, offset + layout.itemsize


@lru_cache(maxsize=16)
def _number_of_states(*counts: int) -> int:
    return len(state_names(Sizes(*counts)))


def watched_ranges(parameters: Records, memory: Records, y: Any) -> list[tuple[int, int]]:
    """Return the addresses and sizes of the watched memory of a flight: its states, and its used memory."""
    sizes = parameters["vehicle"]["sizes"]
    counts = zip(*(sizes[each.name].tolist() for each in fields(Sizes) if each.init), strict=True)
    states = max(_number_of_states(*each) for each in counts)
    start, out, at = memory.ctypes.data, [(y.ctypes.data, states * y.itemsize)], 0
    unused = sorted(_place(*part) for part, test in _UNUSED.items() if test(parameters))
    for begin, end in [*unused, (memory.itemsize, memory.itemsize)]:
        if begin > at:
            out.append((start + at, begin - at))
        at = end
    return out
