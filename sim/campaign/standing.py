"""How a campaign stands while it flies: failures and the worst of each requirement so far."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

import pyarrow as pa
import pyarrow.parquet as pq

from maxq.sim.campaign import columns
from maxq.sim.campaign.flying import VOID, Row
from maxq.sim.campaign.loaded import LoadedCampaign
from maxq.sim.campaign.statistics import OPEN, judge_any_time
from maxq.sim.campaign.store import Store
from maxq.sim.run.metrics import judge
from maxq.sim.scenario.schema_scenario import Requirement

FLOWN_WELL = "control kept"
"""The requirement that every campaign has: no run diverges, loses control or is impossible."""


@dataclass
class Tally:
    """One requirement so far. `worst` is nan while no run has a value, `worst_run` -1."""

    name: str
    requirement: Requirement | None
    failures: int = 0
    worst: float = math.nan
    worst_run: int = -1

    def misses(self, outcome: str, kept: bool, metrics: Mapping[str, float]) -> bool:
        """Whether a run misses the requirement. A run that came to nothing misses all of them."""
        if self.requirement is None:
            return not kept
        return outcome in VOID or not judge(self.requirement, metrics, metrics).met

    def add(self, run: int, outcome: str, kept: bool, metrics: Mapping[str, float]) -> bool:
        missed = self.misses(outcome, kept, metrics)
        self.failures += missed
        if self.requirement is not None and outcome not in VOID:
            value = metrics[self.requirement.metric]
            if self._worse(value):
                self.worst, self.worst_run = value, run
        return missed

    def _worse(self, value: float) -> bool:
        if math.isnan(value) or math.isnan(self.worst):
            return not math.isnan(value)
        assert self.requirement is not None
        return value > self.worst if self.requirement.limit is not None else value < self.worst


@dataclass
class Standing:
    """Tallies of all runs, and of the runs without a gap from the first one on, which verdicts under way are taken on.

    Runs land in an order that depends on how long they take, and so on whether they fail: a verdict on whatever has
    landed would be biased.
    """

    tallies: list[Tally] = field(default_factory=list)
    runs: int = 0
    failed: int = 0
    success: float = 0.9973
    confidence: float = 0.90
    prefix_runs: int = 0
    prefix_failures: list[int] = field(default_factory=list)
    _ahead: dict[int, list[bool]] = field(default_factory=dict)

    @classmethod
    def of(cls, store: Store, campaign: LoadedCampaign, runs: int) -> Standing:
        """How a folder stands, for the first `runs` runs."""
        made = cls(tallies_of(campaign), success=campaign.campaign.success, confidence=campaign.campaign.confidence)
        made.prefix_failures = [0] * len(made.tallies)
        metrics = list(dict.fromkeys(t.requirement.metric for t in made.tallies if t.requirement))
        wanted = [columns.RUN, columns.OUTCOME, columns.PASSED, columns.CAUSE, *metrics]
        for part in store.parts():
            if part.first >= runs:
                break
            table = pq.read_table(part.path, columns=wanted, partitioning=None)
            made.add_table(table.slice(0, runs - part.first))
        return made

    def add_table(self, table: pa.Table) -> None:
        """All rows of a part."""
        metrics = [t.requirement.metric for t in self.tallies if t.requirement]
        wanted = [columns.RUN, columns.OUTCOME, columns.PASSED, columns.CAUSE, *dict.fromkeys(metrics)]
        for row in table.select(wanted).to_pylist():
            self._enter(row[columns.RUN], row[columns.OUTCOME], row[columns.PASSED], row[columns.CAUSE], row)

    def add(self, row: Row) -> None:
        self._enter(row.run, row.outcome, row.passed, row.cause, row.metrics)

    def _enter(self, run: int, outcome: str, passed: bool, cause: str, metrics: Mapping[str, float]) -> None:
        self.runs += 1
        self.failed += not passed
        kept = not cause and outcome not in VOID
        self._ahead[run] = [tally.add(run, outcome, kept, metrics) for tally in self.tallies]
        while self.prefix_runs in self._ahead:
            for n, missed in enumerate(self._ahead.pop(self.prefix_runs)):
                self.prefix_failures[n] += missed
            self.prefix_runs += 1

    def settled(self) -> bool:
        """Whether the verdict on every requirement stands, however often one has looked."""
        return self.prefix_runs > 0 and all(
            judge_any_time(k, self.prefix_runs, self.success, self.confidence) != OPEN for k in self.prefix_failures
        )


def tallies_of(campaign: LoadedCampaign) -> list[Tally]:
    """The requirements of a campaign: that control is kept, then those of the scenario."""
    requirements = campaign.base.scenario.requirement
    return [Tally(FLOWN_WELL, None), *(Tally(r.name or r.metric, r) for r in requirements)]
