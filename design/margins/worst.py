"""A bound: the least of several values, and where it is met."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from maxq.control.kernel.records import Array


@dataclass(frozen=True)
class Bound:
    """Infinite, at no frequency (NaN), where nothing bounds; NaN for an unstable loop."""

    value: float
    frequency_hz: float

    def __float__(self) -> float:
        return self.value


NOTHING = Bound(np.nan, np.nan)


def least(values: Array, frequency_hz: Array, among: NDArray[np.bool_] | None = None) -> Bound:
    """The least of the values, or of those `among` selects."""
    k = np.arange(len(values)) if among is None else np.flatnonzero(among)
    if not len(k):
        return Bound(np.inf, np.nan)
    i = int(k[np.argmin(values[k])])
    return Bound(float(values[i]), float(frequency_hz[i]))
