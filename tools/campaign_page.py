"""What a campaign leaves beside its data set: summary.json, report.html (one file, nothing outside it), pictures."""

from __future__ import annotations

import base64
import html
import math
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from maxq.control.kernel.records import Array
from maxq.sim.campaign.analysis import DataSet, Judged, Lost, failed_runs, redraws, summary_of
from maxq.sim.campaign.envelopes import Band, bands
from maxq.sim.campaign.error import CampaignError
from maxq.sim.campaign.plan import Draw
from maxq.sim.campaign.sensitivity import Driver, drivers, inputs_of, sample_of
from maxq.sim.campaign.statistics import MET, NOT_MET
from maxq.sim.campaign.store import read_manifest, write_json
from maxq.sim.files import write_whole
from maxq.tools import campaign_text as text

SUMMARY, REPORT, PICTURES = "summary.json", "report.html", "pictures"
_DRIVEN = 6  # requirements whose drivers are shown: those nearest to their limits
_NAMED = 8  # drivers in the table of each

Found = list[tuple[Judged, list[Driver]]]


def write_report(
    data: DataSet,
    verdicts: Sequence[Judged],
    losses: Sequence[Lost],
    total: int,
    further: dict[str, Any],
    *,
    pictures: bool,
) -> list[Path]:
    """Write all, or without `pictures` the summary alone; returns the files. Raises CampaignError."""
    sample = sample_of(data)
    inputs = inputs_of(sample) if len(data.runs) else {}
    found = [(v, drivers(sample, v.metric, inputs)) for v in pressing(verdicts)]
    named = {v.name: [asdict(d) for d in ds[:_NAMED]] for v, ds in found}
    bands_ = bands(data.folder, data.campaign)
    summary = summary_of(data, total, {**further, "drivers": named, "envelopes": [_numbers(band) for band in bands_]})
    files = [data.folder / SUMMARY]
    write_json(files[0], summary)
    if pictures:
        drawn = _pictures(data, verdicts, found, inputs, bands_)
        for name, content in drawn.items():
            write_whole(data.folder / PICTURES / f"{name}.png", content, CampaignError)
        files.append(data.folder / REPORT)
        write_whole(files[-1], page(data, verdicts, losses, found, drawn, further), CampaignError)
    return files


def pressing(verdicts: Sequence[Judged]) -> list[Judged]:
    """Requirements whose worst run comes nearest to the limit, or goes beyond it farthest, first."""

    def strain(v: Judged) -> float:
        if not v.worst:
            return -math.inf
        worst = v.worst[0].value
        spread = abs(worst - v.median) or 1e-300
        return (worst - v.bound) / spread if v.kind == "limit" else (v.bound - worst) / spread

    return sorted((v for v in verdicts if v.metric), key=lambda v: (-v.shown.failures, -strain(v)))[:_DRIVEN]


def labels_of(data: DataSet) -> dict[str, str]:
    """Names for people, by column."""
    return {d.name: d.label for d in data.campaign.plan.draws}


def _pictures(
    data: DataSet, verdicts: Sequence[Judged], found: Found, inputs: dict[str, Array], bands_: Sequence[Band]
) -> dict[str, bytes]:
    from maxq.sim.campaign.flying import channel_units  # noqa: PLC0415  # lazy: matplotlib comes with it
    from maxq.tools.plots import campaign as draw  # noqa: PLC0415  # lazy

    labels = labels_of(data)
    made = {
        "histograms": draw.histograms(data, verdicts),
        "envelopes": draw.envelopes(bands_, channel_units(data.campaign.base)),
        "drivers": draw.tornado(found, labels),
        "scatter": draw.scatter(sample_of(data), found[:4], inputs, labels),
    }
    return {name: content for name, content in made.items() if content is not None}


def _numbers(band: Band) -> dict[str, Any]:
    return {
        "channel": band.channel,
        "runs": band.runs,
        "percentiles": list(band.percentiles),
        "time_s": [round(float(t), 6) for t in band.time_s],
        "lines": [[float(f"{x:.6g}") for x in line] for line in band.lines],
    }


# the page

_STYLE = """
:root { color-scheme: light dark; --line: #d5dbe1; --soft: #f3f5f7; --red: #c0392b; --green: #2e8b57;
  --amber: #b7791f; }
@media (prefers-color-scheme: dark) { :root { --line: #3c444d; --soft: #22272e; } img { filter: brightness(0.92); } }
body { font: 15px/1.5 system-ui, sans-serif; max-width: 1120px; margin: 2em auto; padding: 0 1em; }
h1 { font-size: 1.5em; margin-bottom: 0; } h2 { font-size: 1.15em; margin-top: 2em; }
p.sub { color: #6b7785; margin-top: 0.2em; }
table { border-collapse: collapse; width: 100%; font-size: 0.88em; font-variant-numeric: tabular-nums; }
th, td { text-align: right; padding: 0.3em 0.55em; border-bottom: 1px solid var(--line); vertical-align: top; }
th { font-weight: 600; background: var(--soft); } th:first-child, td:first-child, .left,
.second td:nth-child(2), .second th:nth-child(2) { text-align: left; }
.met { color: var(--green); font-weight: 600; } .missed { color: var(--red); font-weight: 600; }
.open { color: var(--amber); font-weight: 600; }
.headline { font-size: 1.1em; padding: 0.7em 1em; background: var(--soft); border-left: 5px solid var(--amber); }
.headline.met { border-color: var(--green); } .headline.missed { border-color: var(--red); }
code { font-size: 0.92em; background: var(--soft); padding: 0.1em 0.3em; border-radius: 3px; overflow-wrap: anywhere; }
img { max-width: 100%; height: auto; } .wide { overflow-x: auto; } details { margin: 1em 0; }
summary { cursor: pointer; font-weight: 600; } .note { color: var(--amber); }
"""


def page(
    data: DataSet,
    verdicts: Sequence[Judged],
    losses: Sequence[Lost],
    found: Found,
    drawn: dict[str, bytes],
    further: dict[str, Any],
) -> str:
    """report.html."""
    campaign, scenario = data.campaign.campaign, data.campaign.base.scenario
    failed = len(failed_runs(data)) if len(data.runs) else 0
    headline = text.headline(verdicts, len(data.runs), campaign.success, campaign.confidence, failed)
    judgements = {v.shown.judgement for v in verdicts}
    mood = "missed" if NOT_MET in judgements else "met" if judgements == {MET} and len(data.runs) else "open"
    parts = [
        f"<h1>{_e(scenario.name)}</h1>",
        f"<p class='sub'>{_e(scenario.description)}</p>",
        f"<p class='headline {mood}'>{_e(headline)}</p>",
        *_notes(data, further),
        "<h2>Requirements</h2>",
        _verdicts(data, verdicts),
        _explanation(campaign.success, campaign.confidence),
        _picture(drawn, "histograms", "Metrics of all runs", "Red: the limit and what misses it. Dashed: the bound of "
                 f"the {100 * campaign.success:g} % quantile at {100 * campaign.confidence:g} % confidence."),
        _worst(data, verdicts, losses),
        _picture(drawn, "envelopes", "Over time", f"Percentiles of the first {campaign.envelope.runs} runs or "
                 "fewer, at each time of those that still fly."),
        _drivers(found, labels_of(data)),
        _picture(drawn, "drivers", "", "Grey band: what an input without any influence stays within, 19 times of 20."),
        _picture(drawn, "scatter", "", "The strongest inputs; red: runs that miss the requirement."),
        _inputs(data),
        _origin(data),
    ]  # fmt: skip
    body = "\n".join(part for part in parts if part)
    head = f"<title>{_e(scenario.name)}: campaign</title>\n<style>{_STYLE}</style>"
    return (
        "<!doctype html>\n<html lang='en'>\n<head>\n<meta charset='utf-8'>\n"
        "<meta name='viewport' content='width=device-width, initial-scale=1'>\n"
        f"{head}\n</head>\n<body>\n{body}\n</body>\n</html>\n"
    )


def _e(value: object) -> str:
    return html.escape(str(value))


def _table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Cells are HTML already."""
    lines = ["<div class='wide'><table>", "<tr>" + "".join(f"<th>{cell}</th>" for cell in head) + "</tr>"]
    lines += ["<tr>" + "".join(f"<td>{cell}</td>" for cell in row) + "</tr>" for row in rows]
    return "\n".join([*lines, "</table></div>"])


def _notes(data: DataSet, further: dict[str, Any]) -> list[str]:
    out = []
    if len(data.runs):
        count, runs = redraws(data)
        if count:
            share = 100.0 * runs / len(data.runs)
            out.append(
                f"<p class='note'>{count} draws in {runs} runs ({share:.3g} %) lay outside their bounds and were drawn "
                "again: the distributions that were flown are cut off there.</p>"
            )
    if further.get("sequential"):
        out.append(
            "<p>Stopped as soon as every verdict was settled, by tests that allow looking at any time; bounds in the "
            "table are those of a fixed number of runs.</p>"
        )
    return out


def _verdicts(data: DataSet, verdicts: Sequence[Judged]) -> str:
    campaign = data.campaign.campaign
    head = (
        "requirement", "limit", "median", f"{100 * campaign.success:g} %", f"bound at {100 * campaign.confidence:g} %",
        "worst", "in run", "failed", "allowed", "success (bounds)", "verdict",
    )  # fmt: skip
    rows = []
    for v in verdicts:
        mood = {MET: "met", NOT_MET: "missed"}.get(v.shown.judgement, "open")
        worst = v.worst[0] if v.worst else None
        rows.append((
            _e(v.name), _e(text.limit_text(v)), text.value_text(v.median), text.value_text(v.quantile),
            text.value_text(v.tolerance) or "-", text.value_text(worst.value) if worst else "",
            str(worst.run) if worst else "", str(v.shown.failures),
            str(v.shown.allowed) if v.shown.allowed >= 0 else "-", _e(text.success_text(v)),
            f"<span class='{mood}'>{_e(text.verdict_text(v))}</span>",
        ))  # fmt: skip
    return _table(head, rows)


def _explanation(success: float, confidence: float) -> str:
    return (
        f"<p class='sub'>Met: {100 * success:g} % of all flights meet it, with {100 * confidence:g} % confidence "
        "(exact binomial, one-sided). Allowed: failures with which so many runs still show that. Bound: what "
        f"{100 * success:g} % of all flights do not exceed, with that confidence (order statistic); - : too few runs. "
        "Each requirement is judged on its own.</p>"
    )


def _picture(drawn: dict[str, bytes], name: str, title: str, caption: str) -> str:
    if name not in drawn:
        return ""
    content = base64.b64encode(drawn[name]).decode()
    head = f"<h2>{_e(title)}</h2>" if title else ""
    return (
        f"{head}<img alt='{_e(title or name)}' src='data:image/png;base64,{content}'><p class='sub'>{_e(caption)}</p>"
    )


def _worst(data: DataSet, verdicts: Sequence[Judged], losses: Sequence[Lost]) -> str:
    rows = []
    for lost in losses[:20]:
        command = text.replay(data.folder, lost.run)
        at = _time(lost.time_s)
        rows.append(
            (
                f"{_e(lost.outcome)}: <span class='missed'>{_e(lost.cause)}</span>",
                str(lost.run),
                at,
                f"<code>{_e(command)}</code>",
            )
        )
    for v in verdicts:
        for worst in v.worst[: 3 if v.shown.failures else 1]:
            command = text.replay(data.folder, worst.run)
            value = f"{_e(v.name)}: {worst.value:.5g} {'' if v.unit == '1' else _e(v.unit)}"
            missed = worst.value > v.bound if v.kind == "limit" else worst.value < v.bound
            shown = f"<span class='missed'>{value}</span>" if missed else value
            rows.append((shown, str(worst.run), _time(worst.time_s), f"<code>{_e(command)}</code>"))
    if not rows:
        return ""
    return "<h2>Worst flights</h2>" + _table(("what", "run", "at", "fly it again, with a full log"), rows)


def _time(seconds: float) -> str:
    return f"{seconds:.3f} s" if math.isfinite(seconds) else ""


def _drivers(found: Found, labels: dict[str, str]) -> str:
    rows = []
    for v, ds in found:
        for n, d in enumerate([d for d in ds if d.matters][:5]):
            rows.append((
                _e(v.name) if n == 0 else "", _e(labels.get(d.name, d.name)),
                f"{d.rank:+.2f}", f"{d.first_order:.2f}", f"{d.delta:.2f}",
            ))  # fmt: skip
    if not rows:
        return ""
    head = ("requirement", "input", "rank correlation", "Sobol', first order", "Borgonovo delta")
    return "<h2>What drives it</h2>" + _table(head, rows).replace("<table>", "<table class='second'>")


def _inputs(data: DataSet) -> str:
    plan = data.campaign.plan
    if not plan.draws and plan.wind is None:
        return ""
    rows = [(_e(d.label), f"<code>{_e(d.name)}</code>", _e(law_of(d)), _e(d.spec.source)) for d in plan.draws]
    model = data.campaign.file.wind_model
    if model is not None:
        rows.append(("wind profile", "<code>wind.profile</code>", _e(f"model {model.model}"), _e(model.source)))
    if plan.own_noise:
        rows.append(("noise of turbulence and gyros", "<code>run.seed</code>", "each run its own", ""))
    table = _table(("input", "key", "distribution", "source"), rows).replace("<td>", "<td class='left'>")
    return f"<details><summary>Dispersions ({len(rows)})</summary>{table}</details>"


def law_of(d: Draw) -> str:
    """A distribution in a few words."""
    s = d.spec
    act = {"set": "", "scale": "times ", "add": "plus "}[s.apply]
    if d.group is not None:
        assert s.covariance is not None
        return f"{act}normal, sigma {math.sqrt(s.covariance[d.group[1]][d.group[1]]):.4g}, correlated"
    numbers = {"sigma": s.sigma, "3 sigma": s.three_sigma, "mean": s.mean, "median": s.median}
    numbers |= {"low": s.low, "mode": s.mode, "high": s.high, "at least": s.at_least, "at most": s.at_most}
    words = ", ".join(f"{name} {value:g}" for name, value in numbers.items() if value is not None)
    if s.values is not None:
        words = f"{len(s.values)} values"
    if s.file is not None:
        words = f"{len(s.file)} rows, {s.order}"
    return f"{act}{s.distribution}" + (f", {words}" if words else "")


def _origin(data: DataSet) -> str:
    campaign = data.campaign.campaign
    simulator = read_manifest(data.folder)["simulator"]
    made = ", ".join(f"{name} {value}" for name, value in simulator.items())
    return (
        f"<p class='sub'>{len(data.runs)} runs, seed {campaign.seed}, sampling {_e(campaign.sampling)}. Data set: "
        f"<code>{_e(data.folder / 'runs')}</code> (Parquet, one row for each run). {_e(made)}.</p>"
    )
