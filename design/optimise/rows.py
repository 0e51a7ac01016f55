"""Objective and limits at a point of the variables: one row each, in decibels, with its gradient."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from maxq.control.kernel.records import Array
from maxq.design.laws.law import LimitValues
from maxq.design.optimise.curves import Indices
from maxq.design.optimise.features import Mask


@dataclass(frozen=True)
class Rows:
    """`excess_db` of a limit is 0 or less where it is met; that of an objective row is its value.

    `what` is the row's number in `Problem.kinds`; `own` its gradient by the own parameters of its plant. Features carry
    what it takes to find them again after a small change: `feature` is the kind (-1: none), `cell`, `x`, `fixed`.
    """

    what: NDArray[np.int8]
    plant: Indices  # -1: of the law itself
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


def law_rows(what: int, of: LimitValues, objective: bool = False) -> Rows:
    """Limits of the law, which belong to no frequency, or the objective where it is one of them."""
    n = len(of.value)
    return Rows(
        what=np.full(n, what, np.int8), plant=of.plant, value=of.value, limit=of.limit, excess_db=of.excess_db,
        objective=np.full(n, objective), own=of.gradient, feature=np.full(n, -1, np.int8), cell=np.zeros(n, np.int64),
        x=np.zeros(n), fixed=np.ones(n, bool),
    )  # fmt: skip  # eight more lines otherwise
