"""Objective and limits at a point of the variables: one row each, in decibels, with its gradient."""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from maxq.control.kernel.records import Array
from maxq.design.optimise.curves import Indices
from maxq.design.optimise.features import Mask


class What(IntEnum):
    """What a row is about."""

    FIRST_MODE = 0  # peak of mode 1: objective or limit
    SECOND_MODE = 1
    HIGHER_MODES = 2
    GAIN_MARGIN = 3
    PHASE_MARGIN = 4
    MODULUS = 5
    ZONE = 6
    FIRST_MODE_PHASE = 7
    RIGID_FREQUENCY = 8
    RIGID_DAMPING = 9
    FILTER_AT_INFINITY = 10


NAMES = {
    What.FIRST_MODE: "peak of mode 1",
    What.SECOND_MODE: "peak of mode 2",
    What.HIGHER_MODES: "peak of modes 3 and above",
    What.GAIN_MARGIN: "gain margin",
    What.PHASE_MARGIN: "phase margin",
    What.MODULUS: "modulus margin",
    What.ZONE: "Nichols zone",
    What.FIRST_MODE_PHASE: "phase margin at mode 1",
    What.RIGID_FREQUENCY: "rigid-body frequency",
    What.RIGID_DAMPING: "rigid-body damping",
    What.FILTER_AT_INFINITY: "|F(j inf)|",
}
UNITS = {
    What.FIRST_MODE: "dB",
    What.SECOND_MODE: "dB",
    What.HIGHER_MODES: "dB",
    What.GAIN_MARGIN: "dB",
    What.PHASE_MARGIN: "deg",
    What.MODULUS: "dB",
    What.ZONE: "",
    What.FIRST_MODE_PHASE: "deg",
    What.RIGID_FREQUENCY: "Hz",
    What.RIGID_DAMPING: "",
    What.FILTER_AT_INFINITY: "",
}


@dataclass(frozen=True)
class Rows:
    """`excess_db` of a limit is 0 or less where it is met; that of an objective row is its value.

    `own` is the gradient by the filter's variables and ln k_p, ln k_d of the row's own plant. Features carry what
    it takes to find them again after a small change: `feature` is the kind (-1: none), `cell`, `x`, `fixed`.
    """

    what: NDArray[np.int8]
    plant: Indices  # -1: of the filter
    value: Array  # in the limit's own unit: dB, deg, Hz, ratio
    limit: Array  # nan: none of its own
    excess_db: Array
    objective: Mask
    own: Array
    feature: NDArray[np.int8]
    cell: Indices
    x: Array  # ln f
    fixed: Mask

    def __len__(self) -> int:
        return len(self.what)

    def taken(self, which: Indices | Mask) -> Rows:
        return Rows(*(getattr(self, f.name)[which] for f in fields(self)))

    @property
    def frequency_hz(self) -> Array:
        """nan where there is none."""
        return np.where(self.feature >= 0, np.exp(self.x), np.nan)


@dataclass
class Collected:
    """Rows in the making."""

    parts: list[Rows] = field(default_factory=list)

    def add(self, rows: Rows) -> None:
        if len(rows) > 0:
            self.parts.append(rows)

    def joined(self) -> Rows:
        """Raises ValueError where there is nothing at all: a problem without rows is none."""
        if not self.parts:
            raise ValueError("the problem has neither an objective nor limits")
        return Rows(*(np.concatenate([getattr(p, f.name) for p in self.parts]) for f in fields(Rows)))


def plain_rows(what: What, plant: Indices, value: Array, limit: Array, excess_db: Array, own: Array) -> Rows:
    """Limits that belong to no frequency."""
    n = len(value)
    return Rows(
        np.full(n, what, np.int8), plant, value, limit, excess_db, np.zeros(n, bool), own,
        np.full(n, -1, np.int8), np.zeros(n, np.int64), np.zeros(n), np.ones(n, bool),
    )  # fmt: skip
