"""`simdesign CASE`: optimise a case, judge and draw the design, write it."""

from __future__ import annotations

import sys
from dataclasses import dataclass


@dataclass(frozen=True)
class Order:
    """What the command line asks for."""

    case: str
    overrides: tuple[str, ...] = ()
    out: str | None = None
    starts: int | None = None
    seed: int | None = None
    pictures: bool = True


def execute(order: Order) -> int:
    """Do it; returns the exit code."""
    print(f"simdesign: {order.case}: the optimiser is not here yet", file=sys.stderr)
    return 2
