"""The task of a design: a case, its plants, and the limits of each plant."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from maxq.control.kernel.records import Array
from maxq.design.case.basis import MarginLimits, limit_of
from maxq.design.laws.wind import Winds
from maxq.sim.input.values import at_time

if TYPE_CHECKING:
    from maxq.design.case.schema import Case

DB = 20.0 / math.log(10.0)  # dB of a change of a natural logarithm


@dataclass(frozen=True)
class Rigid:
    """The rigid-body derivatives of the plants, (plants,): M_delta and M_alpha (1/s2), M_q (1/s)."""

    m_delta: Array
    m_alpha: Array
    m_q: Array


class PlantLimits:
    """The limits of all plants by name, or by station (m) for a bending moment.

    Each limit has the shape (plants,) and is nan where it is not set. `times_s` are the vehicle times of the plants,
    since limits may change over time.
    """

    def __init__(self, each: Sequence[MarginLimits], times_s: Array) -> None:
        self._each, self._times_s = each, times_s
        self._columns: dict[str | float, Array] = {}

    def __getitem__(self, name: str | float) -> Array:
        if name not in self._columns:
            values = [limit_of(limits, name) for limits in self._each]
            self._columns[name] = np.array(
                [
                    math.nan if value is None else at_time(value, time_s)
                    for value, time_s in zip(values, self._times_s, strict=True)
                ],
                float,
            )
        return self._columns[name]

    def axes(self, name: str) -> Array:
        """Return the values of a margin for the half axes around -1, also where the limit is omitted."""
        return np.array([getattr(limits, name) for limits in self._each], float)

    def asked(self, name: str | float) -> bool:
        """Return True if at least one plant has the limit."""
        return not bool(np.isnan(self[name]).all())


@dataclass(frozen=True)
class Task:
    """A case and its plants.

    `sample_s` is the period of sampled loops, or None for continuous loops. `first_mode_hz` is the mean frequency of
    the first bending mode.
    """

    case: Case
    times_s: Array  # (plants,)
    dispersed: NDArray[np.bool_]  # (plants,)
    rigid: Rigid
    limits: PlantLimits
    sample_s: float | None
    first_mode_hz: float
    further_gyros: int = 0  # further gyros, whose weights in the blended rate are variables
    at: Array = field(default_factory=lambda: np.zeros(0))  # (plants,): values of the scheduling quantity
    incidence: Array = field(default_factory=lambda: np.zeros((0, 2)))
    """The coefficients `incidence_by_acceleration` (plants, 2), for a law with feedback of the angle of attack."""
    winds: Winds = ()  # one for each plant, if the case defines wind
