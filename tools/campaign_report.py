"""The results of a campaign for people: what is printed, and the report in its folder.

`write_report` leaves summary.json, report.html (one file, nothing outside it) and its figures as CSV beside the data
set.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from maxq.sim.campaign import analysis
from maxq.sim.campaign.analysis import Band, DataSet, Judged, Lost, failed_runs
from maxq.sim.campaign.availability import Month, availability
from maxq.sim.campaign.error import CampaignError
from maxq.sim.campaign.plan import Draw
from maxq.sim.campaign.read import LoadedCampaign, channel_units
from maxq.sim.campaign.runner import CampaignProgress
from maxq.sim.campaign.statistics import ANY_TIME, MET, NOT_MET
from maxq.sim.campaign.store import read_manifest, write_json
from maxq.sim.campaign.tails import Tail, tail_of
from maxq.sim.files import write_whole
from maxq.sim.flight.metric_table import figures
from maxq.tools.cli import terminal
from maxq.tools.cli.terminal import aligned, printable
from maxq.tools.plots import campaign as plots
from maxq.tools.plots.campaign import replay
from maxq.tools.plots.figures import as_csv

TAIL_NOTE = "quantile: that the required share does not exceed; fit: share of samples that fit worse, 0.05 is poor"
_DRIVEN = 6  # requirements whose drivers are shown: those nearest to their limits
_NAMED = 8  # drivers in the summary of each


def watcher(bar: terminal.Progress) -> Callable[[CampaignProgress], None]:
    """Shows runs, rate, time left, failures, and the worst of each requirement."""

    def show(progress: CampaignProgress) -> None:
        interim = progress.interim
        unfinished = math.isfinite(progress.left_s) and progress.done < progress.total
        left = f", {duration(progress.left_s)} left" if unfinished else ""
        notes = ["none failed" if interim.failed == 0 else f"{interim.failed} failed"]
        for tally in interim.tallies:
            if tally.requirement is not None and not math.isnan(tally.worst):
                notes.append(f"{tally.name} {tally.worst:.4g} of {tally.requirement.bound[1]:.4g}")
        count = f"{progress.done} of {progress.total} runs, {progress.rate:.1f}/s{left}"
        bar.show("flying", progress.done, progress.total, "; ".join(notes), count)

    return show


def duration(seconds: float) -> str:
    """A time span in words."""
    whole = round(seconds)
    if whole < 100:
        return f"{whole} s"
    if whole < 5400:
        return f"{whole // 60} min {whole % 60} s" if whole < 600 else f"{round(whole / 60)} min"
    return f"{whole // 3600} h {whole % 3600 // 60} min"


def labels_of(campaign: LoadedCampaign) -> dict[str, str]:
    """Names for people, by column."""
    return {d.name: d.label for d in campaign.plan.draws}


ReportRows = list[tuple[str, ...]]  # of a table; the first is its head


def requirement_rows(data: DataSet, verdicts: Sequence[Judged]) -> ReportRows:
    """The table of verdicts."""
    campaign = data.campaign.campaign
    quantile, bound = f"{100 * campaign.success:g} %", f"bound at {100 * campaign.confidence:g} %"
    rows = [_requirement(v, quantile, bound) for v in verdicts]
    return [tuple(rows[0]), *(tuple(row.values()) for row in rows)] if rows else [("no requirement",)]


def _requirement(v: Judged, quantile: str, bound: str) -> dict[str, str]:
    """A row of the table of verdicts, by the heads of its columns."""
    shown, worst = v.shown, v.worst[0] if v.worst else None
    success = f"{100 * shown.success:.4g} % ({100 * shown.success_least:.4g} .. {100 * shown.success_most:.4g})"
    sign, unit = "<=" if v.kind == "limit" else ">=", "" if v.unit == "1" else " " + v.unit
    settled = shown.judgement in (MET, NOT_MET)
    return {
        "requirement": printable(v.name),
        "verdict": shown.judgement if settled else "not yet",
        "limit": f"{sign} {v.bound:g}{unit}" if v.metric else "",
        "worst": value_text(worst.value) if worst else "",
        "run": str(worst.run) if worst else "",
        "failed": str(shown.failures),
        "allowed": str(shown.allowed) if shown.allowed >= 0 else "",
        "to go": "" if settled else str(shown.more),
        "median": value_text(v.median),
        quantile: value_text(v.quantile),
        bound: value_text(v.tolerance),
        "success": success if shown.runs else "",
    }


def value_text(value: object, digits: int = 4) -> str:
    """A number with so many digits; nothing for what is missing or nan."""
    if isinstance(value, float):
        return "" if math.isnan(value) else figures(value, digits)
    return "" if value is None else str(value)


def headline(data: DataSet, verdicts: Sequence[Judged]) -> str:
    """The campaign in one line."""
    campaign, runs = data.campaign.campaign, len(data.runs)
    level = f"{100 * campaign.success:g} % with {100 * campaign.confidence:g} % confidence"
    if runs == 0:
        return "NO RUNS: no verdict is possible"
    missed = [v.name for v in verdicts if v.shown.judgement == NOT_MET]
    still = [v for v in verdicts if v.shown.judgement not in (MET, NOT_MET)]
    failures = f"{len(failed_runs(data))} of {runs} runs failed"
    if missed:
        return f"NOT MET ({level}): {', '.join(printable(name) for name in missed)}; {failures}"
    if still:
        more = max(v.shown.more for v in still)
        return f"NOT YET SETTLED ({level}): {len(still)} of {len(verdicts)} open, {more} more runs needed; {failures}"
    return f"MET ({level}): all {len(verdicts)} requirements; {failures}"


def how_judged(data: DataSet, verdicts: Sequence[Judged]) -> str:
    """Return a sentence on how the verdicts were reached."""
    said = f"judged by the {verdicts[0].shown.test}" if verdicts else ""
    if verdicts and verdicts[0].shown.test == ANY_TIME:
        said += ": verdicts hold whenever one looks, stops or flies on"
    missing = len(data.runs) - data.in_order
    return said + (f"; runs from {data.in_order} on are not judged: one before them is missing" if missing else "")


Tails = Sequence[tuple[Judged, Tail]]


def tails_of(data: DataSet, verdicts: Sequence[Judged]) -> Tails:
    """Peaks over threshold of the requirements nearest to their limits, or that miss them most."""
    campaign = data.campaign.campaign

    def tail(v: Judged) -> Tail:
        values = np.where(data.void, np.nan, data.numbers(v.metric))
        return tail_of(values, v.bound, campaign.success, campaign.confidence, v.kind == "limit")

    return [(v, tail(v)) for v in nearest_limits(verdicts)]


def tail_rows(tails: Tails) -> ReportRows:
    """The table of tails."""
    rows: ReportRows = [
        ("tail", "limit", "threshold", "runs beyond", "shape", "quantile", "bound", "P(limit missed)", "bound", "fit")
    ]
    for v, tail in tails:
        head = (printable(v.name), f"{'<=' if v.kind == 'limit' else '>='} {v.bound:g}")
        if tail.problem:
            rows.append((*head, *[""] * 7, f"none: {tail.problem}"))
            continue
        quantiles = (value_text(value) for value in (tail.quantile, tail.quantile_bound))
        beyond = (value_text(value, 3) for value in (tail.beyond, tail.beyond_bound))
        begin = (f"{tail.threshold:.4g}", str(len(tail.excesses)), value_text(tail.shape, 3))
        rows.append((*head, *begin, *quantiles, *beyond, f"{tail.fit:.2f}"))
    return rows


def month_rows(months: Sequence[Month]) -> ReportRows:
    """The table of launch availability."""
    rows: ReportRows = [("month", "flights", "all limits met", "at least", "at most", "first that missed")]
    for m in months:
        shares = (f"{100.0 * share:.1f} %" for share in (m.share, m.least, m.most))
        rows.append((m.name, str(m.runs), *shares, f"run {m.first_missed}" if m.first_missed is not None else ""))
    return rows


def report(data: DataSet, verdicts: Sequence[Judged], losses: Sequence[Lost], tails: Tails = ()) -> list[str]:
    """All that is printed about a campaign's results, but the last line."""
    scenario = data.campaign.base.scenario
    title = printable(f"{scenario.name}: {scenario.description}" if scenario.description else scenario.name)
    ends = ", ".join(f"{count} {outcome}" for outcome, count in sorted(Counter(data.outcomes).items()))
    table = aligned(requirement_rows(data, verdicts), "  ", right=range(3, 11), drop=(11, 6, 10, 9, 8, 7, 4))
    lines = [
        title,
        *(f"warning: {printable(warning)}" for warning in data.campaign.warnings),
        "",
        f"{len(data.runs)} runs: {ends or 'none'}; {len(failed_runs(data))} failed",
        "",
        "requirements",
        *table,
        f"  {how_judged(data, verdicts)}",
    ]
    if months := availability(data):
        shown = aligned(month_rows(months), "  ", right=range(1, 5))
        sure = f"{100.0 * months[0].confidence:g} % confidence, Clopper-Pearson"
        lines += ["", f"launch availability by month of the wind (bounds at {sure})", *shown]
    if any(not tail.problem for _, tail in tails):
        shown = aligned(tail_rows(tails), "  ", right=range(2, 9))
        lines += ["", f"estimates by peaks over threshold, beside the verdicts ({TAIL_NOTE})", *shown]
    rows = [(f"run {run.run}", run.outcome, printable(run.cause)[:90]) for run in losses[:5]]
    for v in verdicts:
        if v.metric and v.shown.failures and v.worst:
            worst = v.worst[0]
            rows.append((f"run {worst.run}", printable(v.name), f"{worst.value:.5g} at {worst.time_s:.3f} s"))
    if rows:
        lines += ["", "worst flights", *aligned(rows, "  "), f"  again with a log: {replay(data.folder, 'RUN')}"]
    return lines


# the report


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
    """Write all, or without `pictures` the summary alone; returns the files. Raises CampaignError.

    `settled`: the campaign was stopped as soon as every verdict was settled.
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
    drawn = plots.plots(data, verdicts, tails, over_time, channel_units(base), found, inputs, sample, labels)
    for plot in drawn:
        files.append(write_whole(data.folder / "figures" / f"{plot.name}.csv", as_csv(plot), CampaignError))
    judgements = {v.shown.judgement for v in verdicts}
    page = render(
        "campaign.html.j2",
        drawn,
        data=data,
        verdicts=verdicts,
        losses=losses,
        found=found,
        settled=settled,
        labels=labels,
        distribution=distribution,
        requirements=requirement_rows(data, verdicts),
        tails=tail_rows(tails),
        tail_note=TAIL_NOTE,
        months=month_rows(availability(data)),
        replay=replay,
        simulator=read_manifest(data.folder)["simulator"],
        headline=headline(data, verdicts),
        vehicle=base.vehicle.name,
        design=base.design.name if base.design else "",
        tested=how_judged(data, verdicts),
        redraws=analysis.redraws(data),
        tone="bad" if NOT_MET in judgements else "good" if judgements == {MET} and len(data.runs) else "open",
    )
    files.append(write_whole(data.folder / "report.html", page, CampaignError))
    return files


def nearest_limits(verdicts: Sequence[Judged]) -> list[Judged]:
    """Requirements whose worst run comes nearest to the limit, or exceeds it most, first."""

    def excess(v: Judged) -> float:
        if not v.worst:
            return -math.inf
        worst = v.worst[0].value
        spread = abs(worst - v.median) or 1e-300
        return (worst - v.bound) / spread if v.kind == "limit" else (v.bound - worst) / spread

    return sorted((v for v in verdicts if v.metric), key=lambda v: (-v.shown.failures, -excess(v)))[:_DRIVEN]


def _numbers(band: Band) -> dict[str, Any]:
    return {
        "channel": band.channel,
        "runs": band.runs,
        "percentiles": list(band.percentiles),
        "time_s": [round(float(t), 6) for t in band.time_s],
        "lines": [[float(f"{x:.6g}") for x in line] for line in band.lines],
    }


def distribution(d: Draw) -> str:
    """A distribution in a few words."""
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
