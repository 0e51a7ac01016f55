"""The blocks of an array that kernels share are consecutive, and as wide as their comments state."""

from __future__ import annotations

import ast
import inspect
import re
from itertools import pairwise
from types import ModuleType

import pytest

from maxq.sim.vehicle import schedule


def blocks(module: ModuleType, first: str, last: str) -> list[tuple[str, int, int]]:
    """Return name, start and width of constants from `first` to `last`: `NAME = ... # description, unit (width)`."""
    lines, out = inspect.getsource(module).split("\n"), []
    for node in ast.parse("\n".join(lines)).body:
        if isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Name):
            name = node.targets[0].id
            if name == first or out:
                width = re.search(r"#.*\((\d+)\)(;.*)?$", lines[(node.end_lineno or 0) - 1])
                out.append((name, getattr(module, name), int(width[1]) if width else 1))
                if name == last:
                    break
    return [block for block in out if not block[0].endswith(("_WIDTH", "MAX_UNKNOWNS", "_PART"))]


@pytest.mark.parametrize(
    ("module", "first", "last", "end"),
    [
        (schedule, "TANK_MASS", "TANK_WAVE", schedule.TANK_WIDTH),
        (schedule, "MODE_OMEGA", "MODE_FIRST", None),
        (schedule, "INVERSE_CORE_MASS", "RATE_DAMPING", schedule.N_DERIVED),
    ],
)
def test_no_block_begins_before_the_last_one_ends(module: ModuleType, first: str, last: str, end: int | None) -> None:
    found = blocks(module, first, last)
    assert len(found) > 5
    for (_, at, width), (name, following, _) in pairwise(found):
        assert at + width <= following, name
    assert end is None or sum(found[-1][1:]) <= end
