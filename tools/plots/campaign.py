"""Pictures of a campaign as PNG: histograms with limits, envelopes over time, sensitivities. None: nothing to show."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, TypeVar

import numpy as np
from matplotlib.axes import Axes

from maxq.control.kernel.records import Array
from maxq.sim.campaign.analysis import Band, DataSet, Driver, Judged
from maxq.tools.plots.palette import BLACK, BLUE, GREY, LIMIT
from maxq.tools.plots.style import drawing, png, sheet

Item = TypeVar("Item")
Found = Sequence[tuple[Judged, Sequence[Driver]]]

_STYLE: Any = {"axes.grid": False, "figure.constrained_layout.use": False}  # automatic margins take as long as drawing
_WIDTH_IN = 10.5
_MOST_POINTS = 4000


def _panels(
    items: Sequence[Item], draw: Callable[[Axes, Item], None], height: float, columns: int = 3, left: float = 0.6
) -> bytes | None:
    """One panel for each item, `height` and `left` margin in inches."""
    if not items:
        return None
    columns = min(columns, len(items))
    rows = -(-len(items) // columns)
    tall, across = height * rows, _WIDTH_IN / columns
    with drawing(settings=_STYLE):
        figure, panels = sheet(rows, columns, height, _WIDTH_IN)
        figure.subplots_adjust(
            left=left / _WIDTH_IN, right=1.0 - 0.12 / _WIDTH_IN, bottom=0.5 / tall, top=1.0 - 0.3 / tall,
            wspace=left / (across - left), hspace=0.85 / (height - 0.85),
        )  # fmt: skip  # four more lines otherwise
        for axes, item in zip(panels, items, strict=False):
            draw(axes, item)
        for axes in panels[len(items) :]:
            axes.set_axis_off()
        return png(figure, 110)


def _named(name: str, unit: str) -> str:
    """A metric or channel, whose name ends with its unit, for people."""
    return name if unit == "1" else f"{name.rpartition('_')[0]}, {unit}"


def histograms(data: DataSet, verdicts: Sequence[Judged]) -> bytes | None:
    """One for each requirement that has a metric."""

    def draw(axes: Axes, v: Judged) -> None:
        values = data.numbers(v.metric)[~data.void]
        _histogram(axes, values[np.isfinite(values)], v)

    return _panels([v for v in verdicts if v.metric and len(data.runs)], draw, 2.5)


def _histogram(axes: Axes, values: Array, v: Judged) -> None:
    """A limit that is far away is written at the edge, so that it does not squeeze the bars together."""
    axes.set_title(v.name)
    axes.set_xlabel(_named(v.metric, v.unit))
    axes.set_yticks([])
    if not len(values):
        return
    low, high, upper = float(values.min()), float(values.max()), v.kind == "limit"
    width = high - low or max(abs(high), 1.0)
    edges = np.histogram_bin_edges(values, bins=min(max(round(math.sqrt(len(values))), 10), 60))
    beyond = edges[:-1] >= v.bound if upper else edges[1:] <= v.bound
    missed = beyond & (v.shown.failures > 0)  # values at the limit meet it
    counts, _ = np.histogram(values, edges)
    axes.bar(edges[:-1], counts, np.diff(edges), align="edge", color=[LIMIT if m else BLUE for m in missed])
    near = low - 0.6 * width <= v.bound <= high + 1.5 * width
    if near:
        axes.axvline(v.bound, color=LIMIT, linewidth=1.4)
        axes.set_xlim(min(low, v.bound) - 0.05 * width, max(high, v.bound) + (0.6 if upper else 0.05) * width)
        text, x, side = f" {v.kind} {v.bound:g}", v.bound, "left" if upper else "right"
    elif v.bound > high:
        text, x, side = f"{v.kind} {v.bound:g} \u2192", 0.99, "right"
    else:
        text, x, side = f"\u2190 {v.kind} {v.bound:g}", 0.01, "left"
    across = axes.get_xaxis_transform() if near else axes.transAxes  # x in the metric's unit or as a share
    axes.text(x, 0.97, text, transform=across, color=LIMIT, ha=side, va="top", fontsize=8)
    if math.isfinite(v.tolerance):
        axes.axvline(v.tolerance, color=BLACK, linewidth=1.0, linestyle=(0, (4, 2)))


def envelopes(bands: Sequence[Band], units: dict[str, str]) -> bytes | None:
    """One panel for each channel: the middle line, and bands between the percentiles on either side of it."""

    def draw(axes: Axes, band: Band) -> None:
        order = np.argsort(band.percentiles)
        lines, shares = band.lines[order], np.array(band.percentiles)[order]
        middle = len(shares) // 2
        for k in range(middle):
            between = f"{shares[k]:g} to {shares[-1 - k]:g} %"
            shade = 0.22 + 0.2 * k
            axes.fill_between(band.time_s, lines[k], lines[-1 - k], color=BLUE, alpha=shade, linewidth=0, label=between)
        if len(shares) % 2:
            axes.plot(band.time_s, lines[middle], color=BLUE, label=f"{shares[middle]:g} %")
        axes.set_title(_named(band.channel, units.get(band.channel, "1")))
        axes.set_xlabel("time, s")
        axes.margins(x=0.0)
        if band is bands[0]:
            axes.legend(frameon=False, fontsize=7, loc="upper left")

    return _panels(bands, draw, 2.4)


def tornado(found: Found, labels: dict[str, str], most: int = 8) -> bytes | None:
    """Rank correlations of the strongest inputs with each metric; grey within the noise."""

    def draw(axes: Axes, shown: tuple[Judged, Sequence[Driver]]) -> None:
        v, drivers = shown[0], shown[1][:most]
        places = np.arange(len(drivers))[::-1]
        axes.barh(places, [d.rank for d in drivers], color=[BLUE if d.matters else GREY for d in drivers], height=0.7)
        axes.set_yticks(places, [labels.get(d.name, d.name) for d in drivers], fontsize=8)
        axes.axvspan(-drivers[0].noise, drivers[0].noise, color=GREY, alpha=0.25, linewidth=0)
        axes.axvline(0.0, color=BLACK, linewidth=0.8)
        axes.set_xlim(-1.0, 1.0)
        axes.set_title(v.name)
        axes.set_xlabel("rank correlation")

    return _panels([(v, drivers) for v, drivers in found if drivers], draw, 2.6, columns=2, left=2.2)


def scatter(data: DataSet, found: Found, inputs: dict[str, Array], labels: dict[str, str]) -> bytes | None:
    """The three strongest inputs of each metric against it."""

    def draw(axes: Axes, shown: tuple[Judged, Driver]) -> None:
        v, d = shown
        x, y = inputs[d.name], data.numbers(v.metric)[~data.void]
        every = max(len(x) // _MOST_POINTS, 1)
        missed = ~(y <= v.bound) if v.kind == "limit" else ~(y >= v.bound)
        axes.scatter(x[::every], y[::every], s=4, color=BLUE, alpha=0.5, linewidth=0)
        axes.scatter(x[missed], y[missed], s=9, color=LIMIT, linewidth=0)
        if y.min() - 0.2 * np.ptp(y) <= v.bound <= y.max() + 0.2 * np.ptp(y):
            axes.axhline(v.bound, color=LIMIT, linewidth=1.0)
        axes.set_xlabel(labels.get(d.name, d.name))
        axes.set_title(f"{v.name}: {d.rank:+.2f}")

    return _panels([(v, d) for v, drivers in found for d in drivers[:3]], draw, 2.3)
