"""The results of a campaign as text: the printed summary, and the report in its folder.

`write_report` writes summary.json, report.html (one self-contained file) and its figures as CSV next to the data set.
"""

from __future__ import annotations

import math
import shlex
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from maxq.sim.campaign import analysis
from maxq.sim.campaign.analysis import Band, DataSet, Judged, Lost, failed_runs, tightest_first
from maxq.sim.campaign.availability import Month, availability
from maxq.sim.campaign.drop_zones import drop_zones
from maxq.sim.campaign.error import CampaignError
from maxq.sim.campaign.plan import Draw
from maxq.sim.campaign.read import LoadedCampaign, channel_units
from maxq.sim.campaign.runner import CampaignProgress
from maxq.sim.campaign.statistics import ANY_TIME, MET, NOT_MET, OPEN
from maxq.sim.campaign.store import read_manifest, write_json
from maxq.sim.campaign.tails import Tail, tail_of
from maxq.sim.files import write_whole
from maxq.sim.run.quantities import meets, number_text, quantity_text, share_text, sign_of, utilisation
from maxq.tools.cli import terminal
from maxq.tools.cli.terminal import aligned, printable
from maxq.tools.plots import campaign as plots
from maxq.tools.plots.campaign import replay
from maxq.tools.plots.drops import drop_plots, zone_cells
from maxq.tools.plots.figures import as_csv

TAIL_NOTE = "quantile: that the required share does not exceed; fit: share of samples that fit worse, 0.05 is poor"
_DRIVEN = 6  # most requirements whose drivers are shown, those nearest to their limits
_SHOWN = 3  # most requirements in the line of progress, the tightest
_NAMED = 8  # most drivers of a requirement in the summary


def watcher(bar: terminal.Progress) -> Callable[[CampaignProgress], None]:
    """Return a function that shows the runs, their rate, the time left, the failures, and the tightest requirements."""

    def show(progress: CampaignProgress) -> None:
        interim = progress.interim
        unfinished = math.isfinite(progress.left_s) and progress.done < progress.total
        left = f", {duration(progress.left_s)} left" if unfinished else ""
        shares = [(utilisation(t.worst, *t.requirement.bound), t) for t in interim.tallies if t.requirement is not None]
        tightest = sorted(((s, t) for s, t in shares if not math.isnan(s)), key=lambda item: -item[0])
        notes = [f"{interim.failed} failed", *(f"{t.name} {share_text(s)} used" for s, t in tightest[:_SHOWN])]
        count = f"{progress.done} of {progress.total} runs, {progress.rate:.1f}/s{left}"
        bar.show("flying", progress.done, progress.total, "; ".join(notes), count)

    return show


def duration(seconds: float) -> str:
    """Return a time span in words."""
    whole = round(seconds)
    if whole < 100:
        return f"{whole} s"
    if whole < 5400:
        return f"{whole // 60} min {whole % 60} s" if whole < 600 else f"{round(whole / 60)} min"
    return f"{whole // 3600} h {whole % 3600 // 60} min"


def labels_of(campaign: LoadedCampaign) -> dict[str, str]:
    """Return the labels of the draws for texts, by column."""
    return {d.name: d.label for d in campaign.plan.draws}


ReportRows = list[tuple[str, ...]]  # rows of a table; the first is its head
_TEXTS = ("requirement", "verdict", "limit")  # heads of columns without numbers
_DISPENSABLE = ("at least", "success", "allowed", "bound", "quantile", "median", "to go", "failed", "run")
"""The heads, or their last words, of the columns that a narrow terminal omits, in the order of omission."""


def requirement_rows(data: DataSet, verdicts: Sequence[Judged]) -> ReportRows:
    """Return the table of verdicts without its empty columns, those with the least margin first."""
    campaign = data.campaign.campaign
    quantile, bound = f"{100 * campaign.success:g} % quantile", f"{100 * campaign.confidence:g} % bound"
    rows = [_requirement(v, quantile, bound, campaign.success) for v in tightest_first(verdicts)]
    if not rows:
        return [("no requirement",)]
    heads = [head for head in rows[0] if head in _TEXTS or any(row[head] for row in rows)]
    return [tuple(heads), *(tuple(row[head] for head in heads) for row in rows)]


def meanings_of(success: float, confidence: float) -> dict[str, dict[str, str]]:
    """Return the meanings of the columns of the report's tables, by table and head.

    `success` and `confidence` are those of the campaign, 0 to 1.
    """
    part, level = f"{100 * success:g} %", f"{100 * confidence:g} %"
    return {
        "requirements": {
            "verdict": f"met: {part} of all flights meet the requirement, shown with {level} confidence (one-sided); "
            f"missed: fewer do, with the same confidence; undecided: more runs are needed",
            "worst": "largest value of the runs, or smallest if a least value is required; the bar is the used share",
            "used": "worst value as a share of the limit",
            "run": "number of the worst run",
            "failed": "runs that miss the requirement",
            "allowed": "largest number of failures with which these runs still show that the requirement is met",
            "to go": "further runs that decide the verdict if none of them fails",
            f"{part} quantile": "from the runs alone, where it is not between the two worst ones",
            f"{level} bound": f"bound of the {part} quantile of all flights, with {level} confidence (order statistic)",
            "success": "share of the runs that meet the requirement",
            "at least": f"lower bound of the success of all flights, with {level} confidence",
        },
        "months": {
            "all limits met": "share of the flights in this month's winds that meet all requirements",
            "at least": f"lower bound of the share; with the upper one at {level} confidence (Clopper-Pearson)",
            "at most": "upper bound of the share",
        },
        "tails": {
            "threshold": "value beyond which a run belongs to the tail",
            "runs beyond": "number of runs in the tail",
            "shape": "below 0, the tail ends; above 0, it is heavier than an exponential one",
            "quantile": f"estimate of the value that {part} of all flights do not exceed",
            "quantile bound": f"bound of the quantile with {level} confidence",
            "P(limit missed)": "estimated probability that a flight misses the limit",
            "P bound": f"bound of the probability with {level} confidence",
            "fit": "share of samples of the fitted distribution that fit worse; 0.05 is poor",
        },
        "drivers": {
            "rank correlation": "Spearman's; sign and strength of a monotone influence",
            "Sobol' index": "of first order; share of the metric's variance that the input explains on its own",
            "Borgonovo delta": "mean shift of the metric's distribution when the input is known, 0 to 1",
        },
    }


def number_columns(rows: ReportRows) -> list[int]:
    """Return the indices of the columns of a table of verdicts that contain numbers."""
    return [i for i, head in enumerate(rows[0]) if head not in _TEXTS]


def _requirement(v: Judged, quantile: str, bound: str, success: float) -> dict[str, str]:
    """Return a row of the table of verdicts, by the heads of its columns.

    A quantile between the two worst runs, which is an interpolation of little value, is omitted.
    """
    shown, (_, factor) = v.shown, v.unit_factor
    worst, limit, unit = v.worst_text
    known = len(v.worst) > 1 and shown.runs * (1.0 - success) >= 1.0
    return {
        "requirement": printable(v.name),
        "verdict": shown.judgement,
        "worst": worst if v.worst else "",
        "limit": f"{sign_of(v.kind)} {limit} {unit}".rstrip() if v.metric else "",
        "used": share_text(v.utilisation),
        "run": str(v.worst[0].run) if _varies(v) else "",
        "failed": str(shown.failures),
        "allowed": str(shown.allowed) if shown.allowed >= 0 else "",
        "to go": str(shown.more) if shown.more else "",
        "median": _finite(factor * v.median),
        quantile: _finite(factor * v.quantile) if known else "",
        bound: _finite(factor * v.tolerance),
        "success": f"{100 * shown.success:.4g} %" if shown.runs else "",
        "at least": f"{100 * shown.success_least:.4g} %" if shown.runs else "",
    }


def _varies(v: Judged) -> bool:
    """Return True if the worst run is worse than the median."""
    return bool(v.worst) and v.worst[0].value != v.median


def _finite(value: float) -> str:
    return "" if math.isnan(value) else number_text(value)


def value_text(value: object) -> str:
    """Return a number with four significant digits, or "" for None and NaN."""
    if isinstance(value, float):
        return _finite(value)
    return "" if value is None else str(value)


def headline(data: DataSet, verdicts: Sequence[Judged]) -> str:
    """Return the outcome of a campaign in one line: the verdict, the decisive requirement with numbers, and failed
    runs.
    """
    campaign, runs = data.campaign.campaign, len(data.runs)
    if runs == 0:
        return "NO RUNS: no verdict is possible"
    level = f"{100 * campaign.success:g} % of flights with {100 * campaign.confidence:g} % confidence"
    ordered, failed = tightest_first(verdicts), f"{len(failed_runs(data))} of {runs} runs failed"
    missed = [v for v in ordered if v.shown.judgement == NOT_MET]
    undecided = [v for v in ordered if v.shown.judgement == OPEN]
    each = [v for v in ordered if not v.joint]
    met = f"{sum(v.shown.judgement == MET for v in each)} of {len(each)} requirements met"
    if missed:
        others = [printable(v.name) for v in missed[1:] if not v.joint]
        said = [f"{_failures(missed[0])}; required in {level}"]
        said += [f"also missed: {', '.join(others)}"] * bool(others)
        return f"MISSED: {'; '.join((*said, met))}"
    if undecided:
        first = max(undecided, key=lambda v: v.shown.more)
        said = [f"{first.shown.more} more runs needed to show {level}"]
        said += [_failures(undecided[0])] * (undecided[0].shown.failures > 0)
        return f"UNDECIDED: {'; '.join((*said, met, failed, *_tightest(ordered)))}"
    every = f"all {len(each)} requirements together" if len(each) != 1 else each[0].name
    return f"MET: {every} in {level}; {'; '.join((failed, *_tightest(ordered)))}"


def _failures(v: Judged) -> str:
    """Return the frequency with which a requirement is missed, with its worst run.

    An example is "roll error 2.138 deg > 2 deg in 7 of 2000 runs (worst: run 17)".
    """
    often = f"in {v.shown.failures} of {v.shown.runs} runs"
    if not v.metric or not v.worst or meets(v.worst[0].value, v.kind, v.bound):
        return f"{printable(v.name)}{' together' if v.joint else ''}: missed {often}"
    value, limit, unit = v.worst_text
    unit, sign = f" {unit}" if unit else "", ">" if v.kind == "limit" else "<"
    return f"{printable(v.name)} {value}{unit} {sign} {limit}{unit} {often} (worst: run {v.worst[0].run})"


def _tightest(ordered: Sequence[Judged]) -> list[str]:
    """Return a list with a text on the utilisation of the tightest requirement, empty if it is missed or unknown."""
    first = next((v for v in ordered if math.isfinite(v.utilisation)), None)
    if first is None or first.shown.failures:
        return []
    value, limit, unit = first.worst_text
    least = "at least " if first.kind == "minimum" else ""
    numbers = f"{value} of {least}{limit} {unit}".rstrip()
    used = f"{share_text(first.utilisation)} used in run {first.worst[0].run}"
    return [f"tightest: {printable(first.name)}, {numbers}, {used}"]


def next_step(data: DataSet, verdicts: Sequence[Judged]) -> str:
    """Return the next step: fly a missed run again, fly more runs, or read or write the report."""
    runs = len(data.runs)
    for v in tightest_first(verdicts):
        run = v.worst[0].run if v.worst else v.first_missed
        if v.shown.judgement == NOT_MET and run is not None:
            return f"next: {replay(data.folder, run)}"
    more = max((v.shown.more for v in verdicts), default=0)
    if runs and more:
        return f"next: repeat the command with --runs {runs + more}"
    page = data.folder / "report.html"
    return f"next: read {page}" if page.exists() else f"next: simrun report {shlex.quote(str(data.folder))}"


def how_judged(data: DataSet, verdicts: Sequence[Judged]) -> str:
    """Return a sentence on the test that gave the verdicts, and on runs that are not judged."""
    said = f"judged by the {verdicts[0].shown.test}" if verdicts else ""
    if verdicts and verdicts[0].shown.test == ANY_TIME:
        said += ", which is valid at any number of runs"
    missing = len(data.runs) - data.in_order
    return said + (f"; runs from {data.in_order} on are not judged: one before them is missing" if missing else "")


Tails = Sequence[tuple[Judged, Tail]]


def tails_of(data: DataSet, verdicts: Sequence[Judged]) -> Tails:
    """Return the tails, by peaks over threshold, of the requirements selected by `nearest_limits`."""
    campaign = data.campaign.campaign

    def tail(v: Judged) -> Tail:
        values = np.where(data.void, np.nan, data.numbers(v.metric))
        return tail_of(values, v.bound, campaign.success, campaign.confidence, v.kind == "limit")

    return [(v, tail(v)) for v in nearest_limits(verdicts)]


def tails_shown(tails: Tails) -> bool:
    """Return True if there is an estimate, or an estimate that is withheld because of the largest values."""
    return any(not (tail.problem and math.isnan(tail.largest)) for _, tail in tails)


def tail_rows(tails: Tails) -> ReportRows:
    """Return the table of tails, with values in the units of the limits."""
    rows: ReportRows = [
        (
            "tail",
            "limit",
            "threshold",
            "runs beyond",
            "shape",
            "quantile",
            "quantile bound",
            "P(limit missed)",
            "P bound",
            "fit",
        )
    ]
    for v, tail in tails:
        (_, limit, unit), (_, factor) = v.worst_text, v.unit_factor
        head = (printable(v.name), f"{sign_of(v.kind)} {limit} {unit}".rstrip())
        if tail.problem:
            rows.append((*head, *[""] * 7, f"none: {tail.problem}"))
            continue
        quantiles = (_finite(factor * value) for value in (tail.quantile, tail.quantile_bound))
        beyond = ("" if math.isnan(value) else f"{value:.2g}" for value in (tail.beyond, tail.beyond_bound))
        begin = (_finite(factor * tail.threshold), str(len(tail.excesses)), f"{tail.shape + 0.0:.2f}")
        rows.append((*head, *begin, *quantiles, *beyond, f"{tail.fit:.2f}"))
    return rows


def month_rows(months: Sequence[Month]) -> ReportRows:
    """Return the table of launch availability by month."""
    rows: ReportRows = [("month", "flights", "all limits met", "at least", "at most", "first that missed")]
    for m in months:
        shares = (f"{100.0 * share:.1f} %" for share in (m.share, m.least, m.most))
        rows.append((m.name, str(m.runs), *shares, f"run {m.first_missed}" if m.first_missed is not None else ""))
    return rows


def report(data: DataSet, verdicts: Sequence[Judged], losses: Sequence[Lost], tails: Tails = ()) -> list[str]:
    """Return the printed lines on the results of a campaign, without the last line."""
    scenario = data.campaign.base.scenario
    title = printable(f"{scenario.name}: {scenario.description}" if scenario.description else scenario.name)
    ends = ", ".join(f"{count} {outcome}" for outcome, count in sorted(Counter(data.outcomes).items()))
    rows = requirement_rows(data, verdicts)
    drop = [i for word in _DISPENSABLE for i, head in enumerate(rows[0]) if head.endswith(word)]
    table = aligned(rows, "  ", right=number_columns(rows), drop=drop)
    lines = [
        title,
        *(f"warning: {printable(warning)}" for warning in data.campaign.warnings),
        "",
        f"{len(data.runs)} runs: {ends or 'none'}; {len(failed_runs(data))} failed",
        "",
        "requirements",
        *table,
        f"  {how_judged(data, verdicts)}",
        *(f"  {text}" for text in [analysis.finer_text(analysis.finer_runs(data))] if text),
    ]
    if months := availability(data):
        shown = aligned(month_rows(months), "  ", right=range(1, 5))
        sure = f"{100.0 * months[0].confidence:g} % confidence, Clopper-Pearson"
        lines += ["", f"launch availability by month of the wind (bounds at {sure})", *shown]
    if tails_shown(tails):
        shown = aligned(tail_rows(tails), "  ", right=range(2, 9))
        lines += ["", f"estimates by peaks over threshold, in addition to the verdicts ({TAIL_NOTE})", *shown]
        lines += [f"  {plots.unseen_text(tails)}"] * any(not tail.problem for _, tail in tails)
    flights = [(f"run {run.run}", run.outcome, printable(run.cause)[:90]) for run in losses[:5]]
    for v in tightest_first(verdicts):
        if v.metric and v.shown.failures and v.worst:
            worst, (value, _, unit) = v.worst[0], v.worst_text
            reached = f"{value} {unit}".rstrip()
            flights.append((f"run {worst.run}", printable(v.name), f"{reached} at {worst.time_s:.3f} s"))
    if flights:
        lines += ["", "worst flights", *aligned(flights, "  "), f"  again with a log: {replay(data.folder, 'RUN')}"]
    return lines


# The report


def write_report(
    data: DataSet,
    verdicts: Sequence[Judged],
    losses: Sequence[Lost],
    total: int,
    tails: Tails = (),
    *,
    settled: bool = False,
    pictures: bool = True,
) -> list[Path]:
    """Write all results, or without `pictures` only the summary. Return the paths of the files.

    `total` is the number of runs of the whole campaign. `settled` is True if the campaign was stopped as soon as every
    verdict was settled. Raises CampaignError.
    """
    sample = analysis.sample_of(data)
    inputs = analysis.inputs_of(sample) if len(data.runs) else {}
    found = [(v, analysis.drivers(sample, v.metric, inputs)) for v in nearest_limits(verdicts)]
    over_time = analysis.bands(data.folder, data.campaign)
    summary = analysis.summary_of(
        data,
        verdicts,
        losses,
        total,
        {
            "sequential": settled,
            "drivers": {v.name: ds[:_NAMED] for v, ds in found},
            "tails": {v.name: {k: x for k, x in vars(tail).items() if not isinstance(x, tuple)} for v, tail in tails},
            "availability": [{**vars(m), "share": m.share} for m in availability(data)],
            "envelopes": [_numbers(band) for band in over_time],
        },
    )
    files = [data.folder / "summary.json"]
    write_json(files[0], summary)
    if not pictures:
        return files
    from maxq.tools.pages.render import render  # noqa: PLC0415  # lazy: for the page only

    base, labels = data.campaign.base, labels_of(data.campaign)
    ordered, rows = tightest_first(verdicts), requirement_rows(data, verdicts)
    drawn = plots.plots(data, ordered, tails, over_time, channel_units(base), found, inputs, sample, labels)
    zones = drop_zones(data)
    drawn += drop_plots(zones, base.scenario, data.folder)
    for plot in drawn:
        files.append(write_whole(data.folder / "figures" / f"{plot.name}.csv", as_csv(plot), CampaignError))
    judgements = {v.shown.judgement for v in verdicts}
    page = render(
        "campaign.html.j2",
        drawn,
        data=data,
        verdicts=ordered,
        losses=losses,
        found=found,
        varies=_varies,
        meets=meets,
        quantity_text=quantity_text,
        number_columns=number_columns(rows),
        settled=settled,
        labels=labels,
        distribution=distribution,
        requirements=rows,
        zones=[zone_cells(zone) for zone in zones],
        tails=tail_rows(tails) if tails_shown(tails) else [],
        meanings=meanings_of(data.campaign.campaign.success, data.campaign.campaign.confidence),
        months=month_rows(availability(data)),
        replay=replay,
        simulator=read_manifest(data.folder)["simulator"],
        headline=headline(data, verdicts),
        vehicle=base.vehicle.name,
        design=base.design.name if base.design else "",
        tested=how_judged(data, verdicts),
        redraws=analysis.redraws(data),
        finer=analysis.finer_text(analysis.finer_runs(data)),
        tone="bad" if NOT_MET in judgements else "good" if judgements == {MET} and len(data.runs) else "open",
    )
    files.append(write_whole(data.folder / "report.html", page, CampaignError))
    return files


def nearest_limits(verdicts: Sequence[Judged]) -> list[Judged]:
    """Return the requirements that are nearest to being missed, at most six, those with the least margin first.

    A requirement with more failures is nearer. At equal failures, the distance of the worst run from the limit counts,
    in units of its distance from the median. Requirements without a metric, or with equal values in all runs, are
    omitted.
    """

    def excess(v: Judged) -> float:
        if not v.worst:
            return -math.inf
        worst = v.worst[0].value
        spread = abs(worst - v.median) or 1e-300
        return (worst - v.bound) / spread if v.kind == "limit" else (v.bound - worst) / spread

    varied = [v for v in verdicts if v.metric and _varies(v)]
    return tightest_first(sorted(varied, key=lambda v: (-v.shown.failures, -excess(v)))[:_DRIVEN])


def _numbers(band: Band) -> dict[str, Any]:
    return {
        "channel": band.channel,
        "runs": band.runs,
        "percentiles": list(band.percentiles),
        "time_s": [round(float(t), 6) for t in band.time_s],
        "lines": [[float(f"{x:.6g}") for x in line] for line in band.lines],
    }


def distribution(d: Draw) -> str:
    """Return a distribution in a few words."""
    s = d.spec
    act = {"set": "", "scale": "times ", "add": "plus "}[s.apply]
    if d.group is not None and s.covariance is not None:
        return f"{act}normal, sigma {math.sqrt(s.covariance[d.group[1]][d.group[1]]):.4g}, correlated"
    numbers = {"sigma": s.sigma, "3 sigma": s.three_sigma, "mean": s.mean, "median": s.median}
    numbers |= {"low": s.low, "mode": s.mode, "high": s.high, "at least": s.at_least, "at most": s.at_most}
    words = ", ".join(f"{name} {value:g}" for name, value in numbers.items() if value is not None)
    if s.values is not None:
        words = f"{len(s.values)} values"
    if s.file is not None:
        words = f"{len(s.file)} rows, {s.order}"
    return f"{act}{s.distribution}" + (f", {words}" if words else "")
