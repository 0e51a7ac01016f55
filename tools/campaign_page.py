"""What a campaign leaves beside its data set: summary.json, report.html (one file, nothing outside it), pictures."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from maxq.sim.campaign.analysis import Band, DataSet, Judged, Lost, bands, redraws, summary_of
from maxq.sim.campaign.error import CampaignError
from maxq.sim.campaign.plan import Draw
from maxq.sim.campaign.read import channel_units
from maxq.sim.campaign.sensitivity import drivers, inputs_of, sample_of
from maxq.sim.campaign.statistics import MET, NOT_MET
from maxq.sim.campaign.store import read_manifest, write_json
from maxq.sim.files import write_whole
from maxq.tools import campaign_text as text

_DRIVEN = 6  # requirements whose drivers are shown: those nearest to their limits
_NAMED = 8  # drivers in the summary of each


def write_report(
    data: DataSet,
    verdicts: Sequence[Judged],
    losses: Sequence[Lost],
    total: int,
    *,
    settled: bool = False,
    pictures: bool = True,
) -> list[Path]:
    """Write all, or without `pictures` the summary alone; returns the files. Raises CampaignError.

    `settled`: the campaign was stopped as soon as every verdict was settled.
    """
    sample = sample_of(data)
    inputs = inputs_of(sample) if len(data.runs) else {}
    found = [(v, drivers(sample, v.metric, inputs)) for v in _pressing(verdicts)]
    over_time = bands(data.folder, data.campaign)
    summary = summary_of(data, verdicts, losses, total, {
        "sequential": settled,
        "drivers": {v.name: ds[:_NAMED] for v, ds in found},
        "envelopes": [_numbers(band) for band in over_time],
    })  # fmt: skip
    files = [data.folder / "summary.json"]
    write_json(files[0], summary)
    if not pictures:
        return files
    from maxq.tools.pages.render import render  # noqa: PLC0415  # lazy: for pictures and page only
    from maxq.tools.plots import campaign as plots  # noqa: PLC0415  # lazy: Matplotlib

    labels = text.labels_of(data.campaign)
    drawn = {
        "histograms": plots.histograms(data, verdicts),
        "envelopes": plots.envelopes(over_time, channel_units(data.campaign.base)),
        "drivers": plots.tornado(found, labels),
        "scatter": plots.scatter(sample, found[:4], inputs, labels),
    }
    made = {name: content for name, content in drawn.items() if content is not None}
    for name, content in made.items():
        write_whole(data.folder / "pictures" / f"{name}.png", content, CampaignError)
    judgements = {v.shown.judgement for v in verdicts}
    page = render(
        "campaign.html.j2", data=data, verdicts=verdicts, losses=losses, found=found, pictures=made, settled=settled,
        text=text, labels=labels, distribution=distribution, simulator=read_manifest(data.folder)["simulator"],
        headline=text.headline(data, verdicts), redraws=redraws(data),
        tone="bad" if NOT_MET in judgements else "good" if judgements == {MET} and len(data.runs) else "open",
    )  # fmt: skip
    files.append(write_whole(data.folder / "report.html", page, CampaignError))
    return files


def _pressing(verdicts: Sequence[Judged]) -> list[Judged]:
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
