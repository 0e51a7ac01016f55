"""The figures of a campaign: histograms with limits, tails, envelopes over time, and sensitivities.

A function returns None if there is nothing to show.
"""

from __future__ import annotations

import math
import re
import shlex
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from maxq.control.kernel.records import Array
from maxq.sim.campaign.analysis import Band, DataSet, Driver, Judged
from maxq.sim.campaign.tails import Tail
from maxq.sim.flight.metric_table import title_of
from maxq.sim.run.quantities import engineering_unit, unit_text
from maxq.tools.plots.figures import Panel, Plot, Series, at, band, limit, line, points

JudgedDrivers = Sequence[tuple[Judged, Sequence[Driver]]]

_MOST_POINTS = 4000
_LIMITED = {  # the metric whose limits apply to each channel
    "alpha_total_deg": "max_alpha_deg",
    "dynamic_pressure_Pa": "max_dynamic_pressure_Pa",
    "mach": "max_mach",
    "altitude_m": "max_altitude_m",
    "speed_mps": "max_speed_mps",
    "q_alpha_Padeg": "max_q_alpha_Padeg",
    "error_pitch_deg": "max_attitude_error_deg",
    "error_yaw_deg": "max_attitude_error_deg",
    "error_roll_deg": "max_roll_error_deg",
    "gimbal_pitch_angle_deg": "max_gimbal_deg",
    "gimbal_yaw_angle_deg": "max_gimbal_deg",
    "gimbal_pitch_rate_degps": "max_gimbal_rate_degps",
    "gimbal_yaw_rate_degps": "max_gimbal_rate_degps",
    "bend_pitch_gimbal_m": "max_bending_m",
    "bend_yaw_gimbal_m": "max_bending_m",
}


def replay(folder: Path, run: int | str) -> str:
    """Return the command that flies a run again. `folder` is the folder of the campaign."""
    return f"simrun refly {shlex.quote(str(folder))} --run {run}"


def unseen_text(tails: Sequence[tuple[Judged, Tail]]) -> str:
    """Return a sentence on the limitation of all estimates from runs: mechanisms that may occur in none of them."""
    most = max((tail.unseen for _, tail in tails if not tail.problem), default=math.nan)
    return f"A mechanism in up to {100.0 * most:.2g} % of flights may occur in no run and is then not in the estimate"


def plots(
    data: DataSet,
    verdicts: Sequence[Judged],
    tails: Sequence[tuple[Judged, Tail]],
    over_time: Sequence[Band],
    units: dict[str, str],
    found: JudgedDrivers,
    inputs: dict[str, Array],
    sample: DataSet,
    labels: dict[str, str],
    prefix: str = "",
) -> list[Plot]:
    """Return all figures of a campaign that have content.

    `tails` are fitted to the `verdicts`. `over_time` contains the envelopes, and `units` the units of their channels.
    `found` contains the drivers of each verdict, computed on `sample` with `inputs`, whose names are `labels`. `prefix`
    precedes the names of the figures if a page has several campaigns.
    """
    campaign = data.campaign.campaign
    quantile = f"{100 * campaign.success:g} % quantile at {100 * campaign.confidence:g} % confidence"
    fitted = [(v, tail) for v, tail in tails if not tail.problem]
    driven = [(v, drivers) for v, drivers in found if drivers]
    strongest = [(v, d) for v, drivers in found[:4] for d in drivers[:3]]
    dashed = f" Dashed: bound of the {quantile}." if any(math.isfinite(v.tolerance) for v in verdicts) else ""
    made = (
        Plot(
            "histograms",
            "Metrics of all runs",
            [panel for v in verdicts if v.metric and (panel := _histogram(data, v)) is not None],
            f"Red: the limit, and runs beyond it; a distant limit is in the panel's title.{dashed} Metrics with one "
            "value in all runs are omitted.",
            columns=3,
            height=150,
        ),
        Plot(
            "tails",
            "Tails",
            [_tail(v, tail) for v, tail in fitted],
            "Runs beyond the threshold against the fitted distribution; on the line the fit is exact. "
            f"{unseen_text(tails)}.",
            columns=3,
            height=170,
        ),
        Plot(
            "envelopes",
            "Over time",
            [_envelope(each, units.get(each.channel, "1"), verdicts) for each in over_time],
            f"Percentiles at each time of the runs in flight, of at most the first {campaign.envelope.runs} runs. "
            "Red: limit of the channel's largest value; a distant limit is in the panel's title.",
            columns=2,
        ),
        Plot(
            "drivers",
            "Drivers of each metric",
            [_tornado(v, drivers[:8], labels) for v, drivers in driven],
            "Rank correlation of the inputs with the metric. 95 % of inputs without influence stay within the grey "
            "band. Blue: inputs with an influence.",
            columns=2,
            height=240,
        ),
        Plot(
            "scatter",
            "Strongest inputs",
            [_scatter(sample, v, d, inputs[d.name], labels) for v, d in strongest],
            "The strongest inputs of the metrics nearest to their limits, with their rank correlation r. Red: runs "
            "that miss the limit.",
            columns=3,
            height=170,
        ),
    )
    out = [plot for plot in made if plot.panels]
    for plot in out:
        plot.command, plot.name = replay(data.folder, "{}"), prefix + plot.name
    return out


def named(name: str, unit: str) -> str:
    """Return a readable name with its unit for a metric or channel, whose key ends with the unit."""
    plain = title_of(name)
    if plain == name:
        plain = (name if unit == "1" else name.rpartition("_")[0]).replace("_", " ")
        plain = re.sub(r"^(\w+) (pitch|yaw|roll)\b", r"\2 \1", plain)
    return plain if unit == "1" else f"{plain}, {unit}"


def missed(values: Array, v: Judged) -> NDArray[np.bool_]:
    """Return an array that is True for values that miss the requirement. A value at the limit meets it."""
    return np.asarray(~(values <= v.bound) if v.kind == "limit" else ~(values >= v.bound))


def _shown(v: Judged) -> tuple[Judged, float]:
    """Return the verdict in its engineering unit, and the factor to this unit."""
    unit, factor = v.unit_factor
    scaled = {name: factor * getattr(v, name) for name in ("bound", "median", "quantile", "tolerance")}
    return replace(v, unit=unit, **scaled), factor


def _limit_text(v: Judged) -> str:
    return f"{v.kind} {v.bound:.6g} {unit_text(v.unit)}".rstrip()


def _histogram(data: DataSet, v: Judged) -> Panel | None:
    """Return the histogram of a metric, or None if there are no runs or all have one value.

    The title states a distant limit, which would compress the bars.
    """
    v, factor = _shown(v)
    values, runs = factor * data.numbers(v.metric)[~data.void], data.runs[~data.void]
    runs, values = runs[np.isfinite(values)], values[np.isfinite(values)]
    if not len(values) or (len(values) > 1 and np.ptp(values) == 0.0):
        return None
    series, title = [bars(values, runs, v)], v.name
    low, high = float(values.min()), float(values.max())
    width = high - low or max(abs(high), 1.0)
    if low - 0.6 * width <= v.bound <= high + 1.5 * width:
        series.append(at(v.bound, "limit", width=1.6))
    else:
        title = f"{v.name} ({_limit_text(v)})"
    if math.isfinite(v.tolerance):
        series.append(at(v.tolerance, "bound", colour="ink", dash="5 3"))
    return Panel(title, series, named(v.metric, v.unit), "runs", unit=unit_text(v.unit))


def bars(values: Array, runs: NDArray[np.int64], v: Judged) -> Series:
    """Return a histogram with separate counts of the values that miss the limit.

    `runs` contains the run number of each value. The series also contains the worst run of each bar.
    """
    edges = np.histogram_bin_edges(values, bins=min(max(round(math.sqrt(len(values))), 10), 40))
    place = np.clip(np.searchsorted(edges, values, side="right") - 1, 0, len(edges) - 2)
    order = np.argsort(values if v.kind == "limit" else -values)
    worst: list[int | None] = [None] * (len(edges) - 1)
    for k in order:
        worst[place[k]] = int(runs[k])
    every = np.bincount(place, minlength=len(worst))
    wrong = np.bincount(place[missed(values, v)], minlength=len(worst))
    return {
        "kind": "bars",
        "colour": "blue",
        "name": "runs",
        "x": 0.5 * (edges[1:] + edges[:-1]),
        "edges": edges,
        "y": every,
        "y2": wrong,
        "runs": worst,
    }


def _tail(v: Judged, tail: Tail) -> Panel:
    """Return the quantiles of a tail against those of the distribution fitted to it."""
    v, factor = _shown(v)
    fitted, flown = (factor * np.array(values) for values in (tail.expected, tail.excesses))
    ends = [min(*fitted, *flown), max(*fitted, *flown)]
    series = [line(ends, ends, "exact fit", colour="grey", faint=True), points(fitted, flown, "runs")]
    if ends[0] <= v.bound <= ends[1]:
        series.append(limit(v.bound))
    title = f"{v.name}: shape {tail.shape + 0.0:.2f}, fit {tail.fit:.2f}"
    return Panel(title, series, f"fitted: {named(v.metric, v.unit)}", "flown")


def _envelope(each: Band, unit: str, verdicts: Sequence[Judged]) -> Panel:
    """Return the median, bands between pairs of percentiles, and the limits on the channel.

    A percentile of less than one run is an interpolation, and its band is named accordingly.
    """
    order = np.argsort(each.percentiles)
    unit, factor = engineering_unit(unit, float(np.nanmax(np.abs(each.lines))))
    lines, shares = factor * each.lines[order], np.array(each.percentiles)[order]
    middle, series = len(shares) // 2, list[Series]()
    for k in range(middle):
        name = f"{shares[k]:g} to {shares[-1 - k]:g} %"
        name += " (about all runs)" if shares[k] / 100.0 * each.runs < 1.0 else ""
        series.append(band(each.time_s, lines[k], lines[-1 - k], name, opacity=0.22 + 0.2 * k))
    if len(shares) % 2:
        series.append(line(each.time_s, lines[middle], "median" if shares[middle] == 50.0 else f"{shares[middle]:g} %"))
    low, high = float(np.nanmin(lines)), float(np.nanmax(lines))
    room, beyond = max(high - low, 1e-12), list[str]()
    for v in (v for v in verdicts if v.metric and v.metric == _LIMITED.get(each.channel)):
        both = v.kind == "limit" and each.channel not in ("alpha_total_deg", "q_alpha_Padeg") and low < 0.0
        most = factor * v.bound
        for bound in (most, -most)[: 1 + both]:
            if low - room < bound < high + room:
                series.append(limit(bound))
            elif bound == most:
                beyond.append(f" ({v.kind} {'±' if both else ''}{most:.6g} {unit_text(unit)})")
    return Panel(named(each.channel, unit) + "".join(beyond), series, "time, s")


def _tornado(v: Judged, drivers: Sequence[Driver], labels: dict[str, str]) -> Panel:
    names = [_plain(d.name, labels) for d in drivers]
    noise = drivers[0].noise
    series: list[Series] = [
        {
            "kind": "shape",
            "colour": "grey",
            "name": "",
            "bare": True,
            "opacity": 0.22,
            "x": [-noise, noise, noise, -noise],
            "y": [0.0, 0.0, 1.0, 1.0],
        },
        {
            "kind": "rows",
            "colour": "blue",
            "name": "",
            "names": names,
            "x": [d.rank for d in drivers],
            "y": [d.rank for d in drivers],
            "matters": [d.matters for d in drivers],
        },
    ]
    return Panel(v.name, series, "rank correlation", x_range=(-1.0, 1.0), y_range=(0.0, 1.0), rows=True)


def _scatter(data: DataSet, v: Judged, d: Driver, x: Array, labels: dict[str, str]) -> Panel:
    v, factor = _shown(v)
    y, runs = factor * data.numbers(v.metric)[~data.void], data.runs[~data.void]
    every, wrong = max(len(x) // _MOST_POINTS, 1), missed(y, v)
    size = 2.4 if len(x) < 500 else 1.6
    series = [points(x[::every], y[::every], "runs", runs=runs[::every], size=size, opacity=0.6)]
    if wrong.any():
        some = np.flatnonzero(wrong)[:_MOST_POINTS]
        series.append(
            points(x[some], y[some], "runs that miss the limit", runs=runs[some], size=1.4 * size, colour="limit")
        )
    if y.min() - 0.2 * np.ptp(y) <= v.bound <= y.max() + 0.2 * np.ptp(y):
        series.append(limit(v.bound))
    title = f"{v.name}, r = {d.rank:+.2f}"
    return Panel(title, series, _input(d.name, labels), unit_text(v.unit))


_UNITS = {
    "mps": "m/s",
    "radps": "rad/s",
    "degps": "deg/s",
    "kg": "kg",
    "m": "m",
    "s": "s",
    "deg": "deg",
    "hz": "Hz",
    "N": "N",
    "Pa": "Pa",
    "rad": "rad",
    "g": "g",
    "K": "K",
}


def _plain(name: str, labels: dict[str, str]) -> str:
    """Return the label of an input, or that of the wind at an altitude."""
    wind = re.fullmatch(r"wind\.profile\.(\w+)_mps\[(\S+) m\]", name)
    return labels.get(name, f"wind, {wind[1]} component at {wind[2]} m" if wind else name)


def _input(name: str, labels: dict[str, str]) -> str:
    """Return the label of an input with its unit, which ends its key. A factor is labelled as a factor."""
    unit = _UNITS.get(name.partition("[")[0].rpartition("_")[2], "")
    text = _plain(name, labels)
    if re.search(r"factor(\.\d+)?$", name) and "factor" not in text:
        return f"{text}, factor"
    return text if not unit or text.endswith(f", {unit}") else f"{text}, {unit}"
