"""What a campaign's data set says: verdicts, quantiles, worst flights. Read column by column, in little memory."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from maxq.control.kernel.records import Array
from maxq.sim.campaign import columns
from maxq.sim.campaign.flying import VOID
from maxq.sim.campaign.loaded import LoadedCampaign
from maxq.sim.campaign.standing import tallies_of
from maxq.sim.campaign.statistics import OPEN, Judgement, Shown, judge_any_time, judge_failures, tolerance_bound
from maxq.sim.campaign.store import parts_in
from maxq.sim.run.metrics import unit_of
from maxq.sim.scenario.schema_scenario import Requirement

SUMMARY_SCHEMA = 1
_KEPT_RUNS = 100_000  # 80 MB or so with a hundred columns
WORST = 10  # flights that are named for each requirement


@dataclass(frozen=True)
class Worst:
    run: int
    value: float
    time_s: float


@dataclass(frozen=True)
class Judged:
    """A requirement and what the campaign says of it."""

    name: str
    metric: str  # empty: that control is kept
    unit: str
    kind: str  # limit or minimum; empty as well
    bound: float
    shown: Shown
    any_time: Judgement  # verdict that holds however often one looked
    median: float
    quantile: float  # of the share `success`, by the samples alone
    tolerance: float  # bound of that quantile with confidence; nan: too few runs
    worst: tuple[Worst, ...]

    @property
    def largest_is_worst(self) -> bool:
        return self.kind != "minimum"


@dataclass(frozen=True)
class Lost:
    """A run that came to nothing or lost control."""

    run: int
    outcome: str
    time_s: float
    cause: str


@dataclass
class DataSet:
    """The runs in a folder, in order."""

    folder: Path
    campaign: LoadedCampaign
    limit: int | None = None  # only runs below this
    _kept: dict[str, Array] = field(default_factory=dict)

    @cached_property
    def parts(self) -> list[Path]:
        return [p.path for p in parts_in(self.folder) if self.limit is None or p.first < self.limit]

    def column(self, name: str) -> pa.ChunkedArray:
        """One column of all runs."""
        kind = columns.schema_of(self.campaign).field(name).type
        chunks = [pq.read_table(path, columns=[name], partitioning=None)[name] for path in self.parts]
        whole = pa.chunked_array([c for chunk in chunks for c in chunk.chunks], type=kind)
        return whole if self.limit is None else whole.slice(0, int((self.runs < self.limit).sum()))

    def numbers(self, name: str) -> Array:
        """One column of numbers; nan where there is none."""
        if name not in self._kept:
            return columns.numbers(self.column(name))
        return self._kept[name]

    def read(self, names: Iterable[str]) -> None:
        """Read columns of numbers together, which is faster, and keep them; not those of very many runs."""
        wanted = [name for name in names if name not in self._kept]
        if not wanted or len(self.runs) > _KEPT_RUNS:
            return
        room = {name: np.empty(len(self.runs)) for name in wanted}
        at = 0
        for path in self.parts:
            with pq.ParquetFile(path) as file:
                table = file.read(columns=wanted, use_threads=False)
            count = min(len(table), len(self.runs) - at)
            for name in wanted:
                room[name][at : at + count] = columns.numbers(table[name])[:count]
            at += count
        self._kept |= room

    @cached_property
    def runs(self) -> np.ndarray:
        chunks = [
            pq.read_table(p, columns=[columns.RUN], partitioning=None)[columns.RUN].to_numpy() for p in self.parts
        ]
        runs = np.concatenate(chunks) if chunks else np.zeros(0, np.int64)
        return runs if self.limit is None else runs[runs < self.limit]

    @cached_property
    def outcomes(self) -> list[str]:
        return [str(outcome) for outcome in self.column(columns.OUTCOME).to_pylist()]

    @cached_property
    def void(self) -> np.ndarray:
        """Runs whose metrics say nothing."""
        return np.array([outcome in VOID for outcome in self.outcomes], dtype=bool)

    @cached_property
    def kept(self) -> np.ndarray:
        """Runs that kept control and came to their end."""
        causes = np.array([bool(cause) for cause in self.column(columns.CAUSE).to_pylist()], dtype=bool)
        return np.asarray(~causes & ~self.void)

    def row(self, run: int) -> dict[str, Any] | None:
        """All that is recorded of one run."""
        for part in parts_in(self.folder):
            if part.first <= run <= part.last:
                table = pq.read_table(part.path, partitioning=None)
                return dict(table.slice(run - part.first, 1).to_pylist()[0])
        return None


def judged(data: DataSet) -> list[Judged]:
    """Every requirement of the campaign, the first one being that control is kept."""
    campaign = data.campaign.campaign
    n, success, confidence = len(data.runs), campaign.success, campaign.confidence
    out = []
    tallies = tallies_of(data.campaign)
    metrics = [tally.requirement.metric for tally in tallies if tally.requirement]
    data.read(name for metric in metrics for name in (metric, columns.TIME_OF.format(metric)))
    for tally in tallies:
        if tally.requirement is None:
            failures = int((~data.kept).sum())
            shown = judge_failures(failures, n, success, confidence)
            any_time = judge_any_time(failures, n, success, confidence) if n else OPEN
            out.append(Judged(tally.name, "", "", "", math.nan, shown, any_time, math.nan, math.nan, math.nan, ()))
        else:
            out.append(_judged(data, tally.name, tally.requirement))
    return out


def _judged(data: DataSet, name: str, requirement: Requirement) -> Judged:
    campaign = data.campaign.campaign
    success, confidence = campaign.success, campaign.confidence
    kind, bound = ("limit", requirement.limit) if requirement.limit is not None else ("minimum", requirement.minimum)
    assert bound is not None
    values = data.numbers(requirement.metric).copy()
    values[data.void] = np.nan
    missed = ~(values <= bound) if kind == "limit" else ~(values >= bound)
    failures, n = int(missed.sum()), len(values)
    good = values[~np.isnan(values)]
    share = success if kind == "limit" else 1.0 - success
    ranked = np.argsort(-values if kind == "limit" else values, kind="stable")  # nan comes last
    order = [int(i) for i in ranked[:WORST] if not np.isnan(values[i])]
    times = data.numbers(columns.TIME_OF.format(requirement.metric)) if order else np.zeros(0)
    return Judged(
        name=name,
        metric=requirement.metric,
        unit=unit_of(requirement.metric),
        kind=kind,
        bound=bound,
        shown=judge_failures(failures, n, success, confidence),
        any_time=judge_any_time(failures, n, success, confidence) if n else OPEN,
        median=float(np.median(good)) if len(good) else math.nan,
        quantile=float(np.quantile(good, share)) if len(good) else math.nan,
        tolerance=tolerance_bound(values, success, confidence, kind == "limit"),
        worst=tuple(Worst(int(data.runs[i]), float(values[i]), float(times[i])) for i in order),
    )


def lost(data: DataSet, most: int = 1000) -> list[Lost]:
    """Runs that came to nothing or lost control, in order."""
    at = np.flatnonzero(~data.kept)[:most]
    if not len(at):
        return []
    times, causes = data.numbers(columns.LOST), data.column(columns.CAUSE)
    return [Lost(int(data.runs[i]), data.outcomes[i], float(times[i]), str(causes[int(i)].as_py())) for i in at]


def failed_runs(data: DataSet) -> list[int]:
    """Runs that missed a requirement or came to nothing."""
    passed = np.array(data.column(columns.PASSED).to_pylist(), dtype=bool)
    return [int(run) for run in data.runs[~passed]]


def redraws(data: DataSet) -> tuple[int, int]:
    """Draws that were rejected, and the runs that had some."""
    count = data.numbers(columns.REDRAWS)
    return int(count.sum()), int((count > 0).sum())


def summary_of(data: DataSet, wanted: int, further: dict[str, Any]) -> dict[str, Any]:
    """summary.json. A number that does not exist is None."""
    campaign = data.campaign.campaign
    verdicts = judged(data)
    drawn, in_runs = redraws(data) if len(data.runs) else (0, 0)
    content = {
        "schema": SUMMARY_SCHEMA,
        "campaign": data.campaign.name,
        "description": data.campaign.base.scenario.description,
        "runs": len(data.runs),
        "wanted": wanted,
        "seed": campaign.seed,
        "sampling": campaign.sampling,
        "success": campaign.success,
        "confidence": campaign.confidence,
        "outcomes": dict(sorted(Counter(data.outcomes).items())),
        "failed_runs": len(failed_runs(data)) if len(data.runs) else 0,
        "redraws": {"draws": drawn, "runs": in_runs},
        "requirements": [asdict(v) for v in verdicts],
        "lost": [asdict(item) for item in lost(data)],
        **further,
    }
    plain: dict[str, Any] = _plain(content)
    return plain


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {str(name): _plain(item) for name, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if isinstance(value, float | np.floating):
        return float(value) if math.isfinite(value) else None
    if isinstance(value, np.integer | np.bool_):
        return value.item()
    return value


def selected(data: DataSet, keep: Sequence[str]) -> list[int]:
    """Runs that `keep` names, without repetition: worst:5, worst:5:METRIC, failed, failed:20, or numbers."""
    out: list[int] = []
    for text in keep:
        head, *rest = text.split(":")
        if head == "worst":
            count = int(rest[0])
            for v in judged(data):
                if v.metric and (len(rest) == 1 or rest[1] == v.metric):
                    out += [w.run for w in v.worst[:count]]
            if len(rest) == 2 and not any(v.metric == rest[1] for v in judged(data)):
                values = data.numbers(rest[1])
                out += [
                    int(data.runs[i]) for i in np.argsort(-values, kind="stable")[:count] if not np.isnan(values[i])
                ]
        elif head == "failed":
            failed = failed_runs(data)
            out += failed[: int(rest[0])] if rest else failed
        else:
            there = set(data.runs.tolist())
            out += [int(part) for part in text.split(",") if int(part) in there]
    return list(dict.fromkeys(out))
