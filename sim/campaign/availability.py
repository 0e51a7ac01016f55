"""The launch availability: the share of flights that meet all requirements, by the month of their winds."""

from __future__ import annotations

import calendar
import math
from dataclasses import dataclass

import numpy as np

from maxq.sim.campaign.analysis import DataSet
from maxq.sim.campaign.plan import MONTH_KEY
from maxq.sim.campaign.runs import input_types
from maxq.sim.campaign.statistics import Shown, failure_lower, failure_upper, judge_failures


@dataclass(frozen=True)
class Month:
    """The flights with the winds of a month, of which `missed` flights miss a requirement or fail.

    `least` and `most` bound the availability with the joint `confidence`, each with half of the risk (Clopper &
    Pearson, Biometrika 26, 1934). The winds are regarded as a random sample of the population to which the bounds
    refer.
    """

    month: int
    runs: int
    missed: int
    least: float
    most: float
    confidence: float
    first_missed: int | None

    @property
    def name(self) -> str:
        return calendar.month_abbr[self.month]

    @property
    def share(self) -> float:
        return 1.0 - self.missed / self.runs

    def judged(self, wanted: float, confidence: float, fixed: bool) -> Shown:
        """Return the verdict on an availability of at least `wanted`.

        `fixed` is True if the number of runs was recorded before the first run.
        """
        return judge_failures(self.missed, self.runs, wanted, confidence, self.runs if fixed else None)


def availability(data: DataSet) -> list[Month]:
    """Return the availability of each month with runs, from the runs before the first gap.

    The result is empty for a campaign without months. Runs whose wind has no date are omitted.
    """
    if MONTH_KEY not in input_types(data.campaign):
        return []
    n, confidence = data.in_order, data.campaign.campaign.confidence
    months = data.numbers(MONTH_KEY)[:n]
    out = []
    for month in np.unique(months[np.isfinite(months)]).astype(int).tolist():
        mine = np.flatnonzero(months == month)
        bad = mine[~data.passed[mine]]
        least, most = clopper_pearson(len(mine) - len(bad), len(mine), confidence)
        first = int(data.runs[bad[0]]) if len(bad) else None
        out.append(Month(month, len(mine), len(bad), least, most, confidence, first))
    return out


def clopper_pearson(successes: int, runs: int, confidence: float) -> tuple[float, float]:
    """Return the lower and upper bound of the probability of success with the joint `confidence`; nan without runs."""
    if not runs:
        return math.nan, math.nan
    each = 0.5 * (1.0 + confidence)
    return 1.0 - failure_upper(runs - successes, runs, each), 1.0 - failure_lower(runs - successes, runs, each)
