"""The results in a campaign's data set: verdicts, quantiles, worst flights, percentiles over time, sensitivities.

The data set is read by columns, so that memory remains bounded for any number of runs. The global sensitivity of a
metric to the dispersed inputs is estimated from the completed runs, without further runs:

- Rank correlation (Spearman): sign and strength of a monotone influence.
- First-order Sobol' index: the share of the metric's variance that the input explains. It is estimated from the
  variance between classes of the input (Pearson's correlation ratio), with a correction for the number of classes.
- Borgonovo's delta: the mean shift of the metric's distribution when the input is known (Plischke, Borgonovo & Smith,
  EJOR 226, 2013). It is half the difference between the histograms of a class and of all runs, averaged over the
  classes. The value for an independent input in the same number of runs is subtracted. Delta also detects an influence
  on the spread alone.

Each index refers to a single input. Inputs that are correlated with each other, such as winds at adjacent altitudes,
share their influence.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa

from maxq.control.kernel.records import Array, IntArray
from maxq.sim.campaign.plan import SEED_KEY
from maxq.sim.campaign.read import LoadedCampaign
from maxq.sim.campaign.runs import TIME_OF, VOID, input_types, schema_of
from maxq.sim.campaign.statistics import NOT_MET, Shown, judge_failures, tolerance_bound
from maxq.sim.campaign.store import HISTORIES, parts_in, read_manifest, read_part
from maxq.sim.flight.metric_table import METRIC_NAMES, unit_of
from maxq.sim.run.metrics import STEP_SCALES, judged_requirements, step_failure
from maxq.sim.run.quantities import against_limit, by_utilisation, engineering_unit, meets, utilisation
from maxq.sim.scenario.schema_scenario import RequirementSection

if TYPE_CHECKING:
    import pandas as pd

SUMMARY_SCHEMA = 1
CONTROL_KEPT = "control kept"
"""The requirement of every campaign that a run keeps control and reaches its end without a failure."""
ALL_REQUIREMENTS = "all requirements"
"""The joint requirement that a flight meets all others."""
_KEPT_RUNS = 100_000  # about 80 MB with a hundred columns
_WORST = 10  # flights that are listed for each requirement
_MOST_RUNS = 20_000  # runs for a sensitivity; more runs do not change the displayed digits
_FEWEST_RUNS = 30
_FINER = 12  # runs with a finer step that a line lists; summary.json lists all
_SHUFFLES = 8


@dataclass(frozen=True)
class Worst:
    run: int
    value: float
    time_s: float


@dataclass(frozen=True)
class Judged:
    """The verdict on a requirement of a campaign, with statistics of its metric."""

    name: str
    metric: str  # empty for CONTROL_KEPT and ALL_REQUIREMENTS
    unit: str
    kind: str  # "limit" or "minimum"; empty without a metric
    bound: float
    shown: Shown
    median: float
    quantile: float  # sample quantile of the share `success`
    tolerance: float  # bound of that quantile with the verdict's confidence; nan for too few runs
    worst: tuple[Worst, ...]
    first_missed: int | None = None  # first of the judged runs that misses the requirement

    @property
    def joint(self) -> bool:
        """Return True for the joint requirement."""
        return self.name == ALL_REQUIREMENTS and not self.metric

    @property
    def utilisation(self) -> float:
        """Return the utilisation of the limit in the worst run; nan without a worst run or for a limit of 0 or less."""
        return utilisation(self.worst[0].value, self.kind, self.bound) if self.worst else math.nan

    @property
    def unit_factor(self) -> tuple[str, float]:
        """Return the engineering unit of limit and values, and the factor to it."""
        return engineering_unit(self.unit, self.bound or (self.worst[0].value if self.worst else 0.0))

    @property
    def worst_text(self) -> tuple[str, str, str]:
        """Return the texts of the worst value, the limit and their engineering unit."""
        return against_limit(self.worst[0].value if self.worst else math.nan, self.kind, self.bound, self.unit)


def tightest_first(verdicts: Iterable[Judged]) -> list[Judged]:
    """Return verdicts in order: missed requirements, requirements missed in a run, and the others.

    Within each group, they are in order of decreasing utilisation in the worst run, and the joint requirement is last.
    """

    def order(v: Judged) -> tuple[bool | float, ...]:
        met, share = by_utilisation(v.shown.failures == 0, v.utilisation)
        return v.shown.judgement != NOT_MET, met, v.joint, share

    return sorted(verdicts, key=order)


@dataclass(frozen=True)
class Lost:
    """A run that lost control, failed, or has no usable metrics."""

    run: int
    outcome: str
    time_s: float
    cause: str


@dataclass(repr=False)
class DataSet:
    """The completed runs in a campaign's folder, in order."""

    folder: Path
    campaign: LoadedCampaign
    limit: int | None = None  # runs below this number only
    _kept: dict[str, Array] = field(default_factory=dict)

    def __repr__(self) -> str:
        return (
            f"<DataSet {self.folder}: {len(self.runs)} runs of {self.campaign.name}, {len(failed_runs(self))} failed>"
        )

    def to_pandas(self, *names: str) -> pd.DataFrame:
        """Return a data frame with a row for each run and the columns `names`; without names, all columns.

        The index is the number of the run. Requires pandas. Raises KeyError for an unknown column.
        """
        known = schema_of(self.campaign).names
        if unknown := [name for name in names if name not in known]:
            raise KeyError(f"no column {unknown[0]}; columns: {', '.join(known)}")
        return self._table(list(dict.fromkeys(["run", *(names or known)]))).to_pandas().set_index("run")

    @cached_property
    def parts(self) -> list[Path]:
        return [p.path for p in parts_in(self.folder) if self.limit is None or p.first < self.limit]

    def _table(self, names: list[str]) -> pa.Table:
        """Return the columns `names` of all runs."""
        whole = schema_of(self.campaign)
        tables = [pa.schema([whole.field(name) for name in names]).empty_table()]
        tables += [read_part(path, names) for path in self.parts]
        return pa.concat_tables(tables).slice(0, len(self.runs))

    def column(self, name: str) -> pa.ChunkedArray:
        """Return a column of all runs."""
        return self._table([name])[name]

    def numbers(self, name: str) -> Array:
        """Return a column of numbers (runs,), with nan for missing values."""
        return self._kept[name] if name in self._kept else _numbers(self.column(name))

    def read(self, names: Iterable[str]) -> None:
        """Read columns of numbers together, which is faster, and keep them if there are at most _KEPT_RUNS runs."""
        wanted = [name for name in dict.fromkeys(names) if name not in self._kept]
        if wanted and len(self.runs) <= _KEPT_RUNS:
            table = self._table(wanted)
            self._kept |= {name: _numbers(table[name]) for name in wanted}

    @cached_property
    def runs(self) -> np.ndarray:
        chunks = [read_part(p, ["run"])["run"].to_numpy() for p in self.parts]
        runs = np.concatenate(chunks) if chunks else np.zeros(0, np.int64)
        return runs if self.limit is None else runs[runs < self.limit]

    @cached_property
    def in_order(self) -> int:
        """Return the number of runs before the first gap, on which verdicts are based.

        An interruption leaves gaps for long runs, whose duration may be related to a failure.
        """
        gaps = np.flatnonzero(self.runs != np.arange(len(self.runs)))
        return int(gaps[0]) if len(gaps) else len(self.runs)

    @cached_property
    def planned(self) -> int | None:
        """Return the number of runs of the fixed test, recorded before the first run; None for the any-time test."""
        if self.campaign.campaign.test != "fixed":
            return None
        return int(read_manifest(self.folder)["campaign"]["runs"])

    @cached_property
    def outcomes(self) -> list[str]:
        return [str(outcome) for outcome in self.column("outcome").to_pylist()]

    @cached_property
    def void(self) -> np.ndarray:
        """Return a mask (runs,) of runs without usable metrics."""
        return np.array([outcome in VOID for outcome in self.outcomes], dtype=bool)

    @cached_property
    def kept(self) -> np.ndarray:
        """Return a mask (runs,) of runs that reached their end without a cause of failure."""
        causes = np.array([bool(cause) for cause in self.column("cause").to_pylist()], dtype=bool)
        return np.asarray(~causes & ~self.void)

    @cached_property
    def passed(self) -> np.ndarray:
        """Return a mask (runs,) of runs without a cause of failure that met all requirements."""
        return np.array(self.column("passed").to_pylist(), dtype=bool)

    def row(self, run: int) -> dict[str, Any] | None:
        """Return the complete record of a run, or None if it is not in the data set."""
        for part in parts_in(self.folder):
            if part.first <= run <= part.last:
                table = read_part(part.path)
                return dict(table.slice(run - part.first, 1).to_pylist()[0])
        return None


def _numbers(column: Any) -> Array:
    """Return a column of numbers as an array (runs,), with nan for null."""
    return np.asarray(column.to_numpy(), dtype=float)


def requirements_of(campaign: LoadedCampaign) -> list[tuple[str, RequirementSection | None]]:
    """Return the names and requirements of a campaign: CONTROL_KEPT with None, then the scenario's requirements."""
    return [(CONTROL_KEPT, None), *((r.name or r.metric, r) for r in campaign.base.scenario.requirement)]


def judged(data: DataSet) -> list[Judged]:
    """Return the verdicts on all requirements of the campaign.

    The first is that on CONTROL_KEPT. If the scenario has requirements, the last is that on ALL_REQUIREMENTS, which
    fails at least as often as each of the others.
    """
    requirements = requirements_of(data.campaign)
    metrics = [requirement.metric for _, requirement in requirements if requirement]
    data.read(name for metric in metrics for name in (metric, TIME_OF.format(metric)))
    each = [_judged(data, name, requirement) for name, requirement in requirements]
    return [*each, _without_metric(data, ALL_REQUIREMENTS, ~data.passed)] if metrics else each


def _verdict(data: DataSet, missed: np.ndarray) -> tuple[Shown, int | None]:
    """Return the evidence of the judged runs, and the first of them that missed, from a mask (runs,) of misses."""
    campaign, n = data.campaign.campaign, data.in_order
    at = np.flatnonzero(missed[:n])
    shown = judge_failures(len(at), n, campaign.success, campaign.confidence, data.planned)
    return shown, int(data.runs[at[0]]) if len(at) else None


def _without_metric(data: DataSet, name: str, missed: np.ndarray) -> Judged:
    shown, first = _verdict(data, missed)
    return Judged(name, "", "", "", math.nan, shown, math.nan, math.nan, math.nan, (), first)


def _judged(data: DataSet, name: str, requirement: RequirementSection | None) -> Judged:
    if requirement is None:
        return _without_metric(data, name, ~data.kept)
    success, n = data.campaign.campaign.success, data.in_order
    kind, bound = requirement.bound
    upper = kind == "limit"
    values = data.numbers(requirement.metric).copy()
    values[data.void] = np.nan
    missed = ~(values <= bound) if upper else ~(values >= bound)
    good = values[~np.isnan(values)]
    ranked = np.argsort(-values if upper else values, kind="stable")  # nan comes last
    order = [int(i) for i in ranked[:_WORST] if not np.isnan(values[i])]
    times = data.numbers(TIME_OF.format(requirement.metric)) if order else np.zeros(0)
    shown, first = _verdict(data, missed)
    return Judged(
        name,
        requirement.metric,
        unit_of(requirement.metric),
        kind,
        bound,
        shown,
        median=float(np.median(good)) if len(good) else math.nan,
        quantile=float(np.quantile(good, success if upper else 1.0 - success)) if len(good) else math.nan,
        tolerance=tolerance_bound(values[:n], shown.allowed, upper),
        worst=tuple(Worst(int(data.runs[i]), float(values[i]), float(times[i])) for i in order),
        first_missed=first,
    )


def lost(data: DataSet, most: int = 1000) -> list[Lost]:
    """Return the runs without usable metrics or with a cause of failure, in order, at most `most`."""
    at = np.flatnonzero(~data.kept)[:most]
    if not len(at):
        return []
    times, causes = data.numbers("lost_s"), data.column("cause")
    return [Lost(int(data.runs[i]), data.outcomes[i], float(times[i]), str(causes[int(i)].as_py())) for i in at]


def failed_runs(data: DataSet) -> list[int]:
    """Return the numbers of runs that missed a requirement, had a cause of failure or have no usable metrics."""
    return [int(run) for run in data.runs[~data.passed]]


def redraws(data: DataSet) -> tuple[int, int]:
    """Return the number of rejected draws, and the number of runs with such draws."""
    count = data.numbers("redraws")
    return int(count.sum()), int((count > 0).sum())


def finer_runs(data: DataSet) -> dict[int, int]:
    """Return, by run, the number of halvings of the step, for runs flown again because of integration errors."""
    halvings, given = data.numbers("halvings").astype(int), data.campaign.base.scenario.run.halvings
    return {int(data.runs[i]): int(halvings[i]) for i in np.flatnonzero(halvings > given)}


def unfounded(data: DataSet) -> list[str]:
    """Return a message for each row whose failure or success does not follow from its other columns.

    A run passes if it has no cause of failure and meets all requirements. It has a cause if it lost control, or if its
    integration errors are too large at the finest step.
    """
    scenario, causes = data.campaign.base.scenario, [str(cause) for cause in data.column("cause").to_pylist()]
    judged = judged_requirements(scenario)
    errors = [name for name in METRIC_NAMES if name.startswith("step_error_")]
    data.read(["lost_s", "halvings", *errors, *STEP_SCALES, *(r.metric for r in judged)])
    met = np.ones(len(data.runs), bool)
    for r in judged:
        met &= np.array([meets(value, *r.bound) for value in data.numbers(r.metric)], bool)
    lost_s, halvings, out = data.numbers("lost_s"), data.numbers("halvings").astype(int), list[str]()
    columns = {name: data.numbers(name) for name in (*errors, *STEP_SCALES)}
    for i in np.flatnonzero(~data.void).tolist():
        run = scenario.run.model_copy(update={"halvings": int(halvings[i])})
        inexact = step_failure(run, {name: column[i] for name, column in columns.items()}, judged)
        lost = not math.isnan(lost_s[i])
        if inexact and not lost and inexact not in causes[i]:
            out.append(f"run {data.runs[i]}: its integration errors are too large for {halvings[i]} halvings")
        elif lost and not causes[i]:
            out.append(f"run {data.runs[i]}: control is lost without a cause")
    wrong = np.flatnonzero(data.passed != (met & data.kept))
    return [*out, *(f"run {data.runs[i]}: `passed` does not follow from its metrics and requirements" for i in wrong)]


def finer_text(runs: Mapping[int, int]) -> str:
    """Return the runs of `finer_runs` and their shares of the step in a line, or an empty string without runs."""
    if not runs:
        return ""
    named = [f"{run} (1/{2**count})" for run, count in list(runs.items())[:_FINER]]
    more = [f"and {len(runs) - _FINER} more"] * (len(runs) > _FINER)
    what = "run" if len(runs) == 1 else "runs"
    return f"{what} flown again with a share of the step, to reduce integration errors: {', '.join(named + more)}"


def summary_of(
    data: DataSet, verdicts: Sequence[Judged], losses: Sequence[Lost], wanted: int, further: dict[str, Any]
) -> dict[str, Any]:
    """Return the content of summary.json; `wanted` is the number of runs of the campaign, `further` more entries."""
    campaign = data.campaign.campaign
    drawn, in_runs = redraws(data)
    return {
        "schema": SUMMARY_SCHEMA,
        "campaign": data.campaign.name,
        "description": data.campaign.base.scenario.description,
        "runs": len(data.runs),
        "wanted": wanted,
        "judged_runs": data.in_order,
        "test": verdicts[0].shown.test if verdicts else "",
        "seed": campaign.seed,
        "sampling": campaign.sampling,
        "success": campaign.success,
        "confidence": campaign.confidence,
        "outcomes": dict(sorted(Counter(data.outcomes).items())),
        "failed_runs": len(failed_runs(data)),
        "redraws": {"draws": drawn, "runs": in_runs},
        "finer_runs": {str(run): count for run, count in finer_runs(data).items()},
        "warnings": data.campaign.warnings,
        "requirements": verdicts,
        "lost": losses,
        **further,
    }


def selected(data: DataSet, keep: Sequence[str]) -> list[int]:
    """Return the runs that `keep` selects, without repetition.

    Its forms are worst:5, worst:5:METRIC, failed, failed:20, and numbers separated by commas.
    """
    out: list[int] = []
    for text in keep:
        head, *rest = text.split(":")
        if head == "worst":
            count, metric = int(rest[0]), rest[1] if len(rest) == 2 else ""
            verdicts = [v for v in judged(data) if v.metric and metric in ("", v.metric)]
            for v in verdicts:
                out += [w.run for w in v.worst[:count]]
            if metric and not verdicts:
                values = data.numbers(metric)
                order = np.argsort(-values, kind="stable")[:count]
                out += [int(data.runs[i]) for i in order if not np.isnan(values[i])]
        elif head == "failed":
            out += failed_runs(data)[: int(rest[0]) if rest else None]
        else:
            there = set(data.runs.tolist())
            out += [int(part) for part in text.split(",") if int(part) in there]
    return list(dict.fromkeys(out))


# envelopes


@dataclass(frozen=True)
class Band:
    """The envelope of a channel: its percentiles `lines` (percentiles, n) over `time_s` (n,).

    `flying` (n,) is the number of runs that reach each time.
    """

    channel: str
    runs: int
    time_s: Array
    percentiles: tuple[float, ...]
    lines: Array
    flying: Array


def bands(folder: Path, campaign: LoadedCampaign) -> list[Band]:
    """Return the envelope of each channel; empty if no histories were kept."""
    envelope = campaign.campaign.envelope
    files = sorted((folder / HISTORIES).glob("runs-*.parquet"))
    if not files:
        return []
    times = [t for file in files for t in _lists(file, "time_s")]
    steps = [np.rint(t * envelope.rate_hz).astype(np.int64) for t in times]
    first = min((int(s[0]) for s in steps if len(s)), default=0)
    length = max((int(s[-1]) for s in steps if len(s)), default=0) - first + 1
    out = []
    for channel in envelope.channels:
        grid = np.full((len(steps), length), np.nan, dtype=np.float32)
        values = (v for file in files for v in _lists(file, channel))
        for row, step, value in zip(grid, steps, values, strict=True):
            row[step - first] = value
        flying = np.isfinite(grid).sum(axis=0)
        used = flying > 0
        lines = np.nanpercentile(grid[:, used], envelope.percentiles, axis=0)
        time_s = (first + np.arange(length)[used]) / envelope.rate_hz
        out.append(Band(channel, len(steps), time_s, envelope.percentiles, np.atleast_2d(lines), flying[used]))
    return out


def _lists(file: Path, column: str) -> list[Array]:
    whole = read_part(file, [column])[column]
    return [np.asarray(row) for row in whole.combine_chunks().to_numpy(zero_copy_only=False)]


# sensitivities


@dataclass(frozen=True)
class Driver:
    """The influence of an input on a metric. `noise` is the 2-sigma bound of |rank| without an influence."""

    name: str
    rank: float
    first_order: float
    delta: float
    noise: float

    @property
    def matters(self) -> bool:
        return abs(self.rank) > self.noise or self.delta > self.noise


def rank_correlation(x: Array, y: Array) -> float:
    """Return Spearman's rank correlation of x and y, both (runs,); 0 if either is constant."""
    from scipy.stats import spearmanr  # noqa: PLC0415  # lazy: a second to import, at a campaign's end only

    return float(spearmanr(x, y).statistic) if np.ptp(x) > 0.0 and np.ptp(y) > 0.0 else 0.0


def first_order(x: Array, y: Array) -> float:
    """Return the first-order Sobol' index of the input x for the metric y, both (runs,), from 0 to 1."""
    n, total = len(y), float(np.var(y))
    classes = _classes(x)
    count = np.bincount(classes)
    used = int((count > 0).sum())
    if total == 0.0 or used < 2 or n <= used:
        return 0.0
    sums = np.bincount(classes, weights=y)
    means = sums[count > 0] / count[count > 0]
    between = float((count[count > 0] * (means - y.mean()) ** 2).sum()) / n
    return float(np.clip(1.0 - (1.0 - between / total) * (n - 1) / (n - used), 0.0, 1.0))


def borgonovo(x: Array, y: Array) -> float:
    """Return Borgonovo's delta of the input x for the metric y, both (runs,), from 0 to 1."""
    classes, bins = _classes(x), _classes(y)
    if classes.max(initial=0) < 1 or bins.max(initial=0) < 1:
        return 0.0
    rng = np.random.default_rng(20020412)  # the same noise is subtracted every time
    by_chance = np.mean([_distance(rng.permutation(classes), bins) for _ in range(_SHUFFLES)])
    return float(np.clip((_distance(classes, bins) - by_chance) / (1.0 - by_chance), 0.0, 1.0))


def _distance(classes: IntArray, bins: IntArray) -> float:
    n, width = len(classes), int(bins.max()) + 1
    table = np.bincount(classes * width + bins, minlength=(int(classes.max()) + 1) * width).reshape(-1, width)
    share = table.sum(axis=1, keepdims=True)
    inside = table / np.maximum(share, 1)
    overall = table.sum(axis=0) / n
    return float((share[:, 0] / n * 0.5 * np.abs(inside - overall).sum(axis=1)).sum())


def _classes(x: Array) -> IntArray:
    """Return the class of each value (n,), for about n^(1/3) classes of equal size."""
    n = len(x)
    count = int(np.clip(round(n ** (1.0 / 3.0)), 2, 40))
    edges = np.quantile(x, np.linspace(0.0, 1.0, count + 1)[1:-1])
    return np.searchsorted(np.unique(edges), x, side="right")


def sample_of(data: DataSet) -> DataSet:
    """Return the first runs, at most _MOST_RUNS, from which sensitivities are estimated."""
    return data if len(data.runs) <= _MOST_RUNS else DataSet(data.folder, data.campaign, limit=_MOST_RUNS)


def inputs_of(sample: DataSet) -> dict[str, Array]:
    """Return, by name, the numeric inputs of the runs with usable metrics, without constant inputs."""
    good = ~sample.void
    out = {}
    names = [n for n, kind in input_types(sample.campaign).items() if n != SEED_KEY and str(kind) != "string"]
    sample.read(names)
    for name in names:
        values = sample.numbers(name)[good]
        if len(values) and np.isfinite(values).all() and np.ptp(values) > 0.0:
            out[name] = values
    return out


def drivers(sample: DataSet, metric: str, inputs: dict[str, Array]) -> list[Driver]:
    """Return all inputs in order of decreasing influence on a metric; empty with fewer than 30 runs."""
    y = sample.numbers(metric)[~sample.void]
    good = np.isfinite(y)
    n = int(good.sum())
    if n < _FEWEST_RUNS or np.ptp(y[good]) == 0.0:
        return []
    noise = 2.0 / math.sqrt(n - 1)
    found = [
        Driver(
            name, rank_correlation(x[good], y[good]), first_order(x[good], y[good]), borgonovo(x[good], y[good]), noise
        )
        for name, x in inputs.items()
    ]
    return sorted(found, key=lambda d: -max(abs(d.rank), d.delta))
