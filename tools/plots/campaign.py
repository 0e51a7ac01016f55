"""Pictures of a campaign: histograms with limits, envelopes over time, what drives a metric."""

from __future__ import annotations

import io
import math
from collections.abc import Sequence
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from maxq.control.kernel.records import Array
from maxq.sim.campaign.analysis import DataSet, Judged
from maxq.sim.campaign.envelopes import Band
from maxq.sim.campaign.sensitivity import Driver

BLUE, GREY, RED, GREEN, AMBER = "#2f6fab", "#9aa5b1", "#c0392b", "#2e8b57", "#b7791f"
COLUMNS = 3
_MOST_POINTS = 4000
_STYLE: Any = {
    "font.size": 9.0, "axes.spines.top": False, "axes.spines.right": False, "axes.titlesize": 10.0,
    "axes.titleweight": "bold", "figure.facecolor": "white", "svg.hashsalt": "maxq",
}  # fmt: skip


def histograms(data: DataSet, verdicts: Sequence[Judged]) -> bytes | None:
    """One for each requirement that has a metric."""
    shown = [v for v in verdicts if v.metric and len(data.runs)]
    if not shown:
        return None
    with mpl.rc_context(_STYLE):
        figure, panels = _grid(len(shown), 2.5)
        for axes, v in zip(panels, shown, strict=True):
            values = data.numbers(v.metric)[~data.void]
            _histogram(axes, values[np.isfinite(values)], v)
        return _png(figure)


def _histogram(axes: Axes, values: Array, v: Judged) -> None:
    """A limit that is far away is written at the edge, so that it does not squeeze the bars together."""
    axes.set_title(v.name, loc="left")
    axes.set_xlabel(v.metric if v.unit == "1" else f"{v.metric.rpartition('_')[0]}, {v.unit}")
    axes.set_yticks([])
    if not len(values):
        return
    low, high = float(values.min()), float(values.max())
    width = high - low or max(abs(high), 1.0)
    near = low - 0.6 * width <= v.bound <= high + 1.5 * width
    edges = np.histogram_bin_edges(values, bins=min(max(round(math.sqrt(len(values))), 10), 60))
    missed = edges[:-1] >= v.bound if v.kind == "limit" else edges[1:] <= v.bound
    counts, _ = np.histogram(values, edges)
    axes.bar(edges[:-1], counts, np.diff(edges), align="edge", color=[RED if m else BLUE for m in missed])
    if near:
        axes.axvline(v.bound, color=RED, linewidth=1.4)
        axes.annotate(f" {v.kind} {v.bound:g}", (v.bound, 0.97), xycoords=("data", "axes fraction"), color=RED,
                      va="top", ha="left" if v.kind == "limit" else "right", fontsize=8)  # fmt: skip
        axes.set_xlim(
            min(low, v.bound) - 0.05 * width, max(high, v.bound) + (0.6 if v.kind == "limit" else 0.05) * width
        )
    else:
        arrow = f"{v.kind} {v.bound:g} \u2192" if v.bound > high else f"\u2190 {v.kind} {v.bound:g}"
        x = 0.99 if v.bound > high else 0.01
        axes.annotate(arrow, (x, 0.97), xycoords="axes fraction", color=RED, va="top",
                      ha="right" if v.bound > high else "left", fontsize=8)  # fmt: skip
    if math.isfinite(v.tolerance):
        axes.axvline(v.tolerance, color="black", linewidth=1.0, linestyle=(0, (4, 2)))


def envelopes(bands: Sequence[Band], units: dict[str, str]) -> bytes | None:
    """One panel for each channel: the middle line, and bands between the percentiles on either side of it."""
    if not bands:
        return None
    with mpl.rc_context(_STYLE):
        figure, panels = _grid(len(bands), 2.4)
        for axes, band in zip(panels, bands, strict=True):
            order = np.argsort(band.percentiles)
            lines, shares = band.lines[order], np.array(band.percentiles)[order]
            for k in range(len(shares) // 2):
                axes.fill_between(band.time_s, lines[k], lines[-1 - k], color=BLUE, alpha=0.22 + 0.2 * k, linewidth=0,
                                  label=f"{shares[k]:g} to {shares[-1 - k]:g} %")  # fmt: skip
            if len(shares) % 2:
                axes.plot(
                    band.time_s,
                    lines[len(shares) // 2],
                    color=BLUE,
                    linewidth=1.3,
                    label=f"{shares[len(shares) // 2]:g} %",
                )
            unit = units.get(band.channel, "1")
            axes.set_title(band.channel if unit == "1" else f"{band.channel.rpartition('_')[0]}, {unit}", loc="left")
            axes.set_xlabel("time, s")
            axes.margins(x=0.0)
        panels[0].legend(frameon=False, fontsize=7, loc="upper left")
        return _png(figure)


def tornado(found: Sequence[tuple[Judged, Sequence[Driver]]], labels: dict[str, str], most: int = 8) -> bytes | None:
    """Rank correlations of the strongest inputs with each metric; grey within the noise."""
    shown = [(v, ds[:most]) for v, ds in found if ds]
    if not shown:
        return None
    with mpl.rc_context(_STYLE):
        figure, panels = _grid(len(shown), 2.6, columns=2, left=2.2)
        for axes, (v, ds) in zip(panels, shown, strict=True):
            places = np.arange(len(ds))[::-1]
            axes.barh(places, [d.rank for d in ds], color=[BLUE if d.matters else GREY for d in ds], height=0.7)
            axes.set_yticks(places, [labels.get(d.name, d.name) for d in ds], fontsize=8)
            axes.axvspan(-ds[0].noise, ds[0].noise, color=GREY, alpha=0.25, linewidth=0)
            axes.axvline(0.0, color="black", linewidth=0.8)
            axes.set_xlim(-1.0, 1.0)
            axes.set_title(v.name, loc="left")
            axes.set_xlabel("rank correlation")
        return _png(figure)


def scatter(
    data: DataSet, found: Sequence[tuple[Judged, Sequence[Driver]]], inputs: dict[str, Array], labels: dict[str, str]
) -> bytes | None:
    """The three strongest inputs of each metric against it."""
    shown = [(v, d) for v, ds in found for d in ds[:COLUMNS]]
    if not shown:
        return None
    with mpl.rc_context(_STYLE):
        figure, panels = _grid(len(shown), 2.3)
        for axes, (v, d) in zip(panels, shown, strict=True):
            x, y = inputs[d.name], data.numbers(v.metric)[~data.void]
            every = max(len(x) // _MOST_POINTS, 1)
            missed = ~(y <= v.bound) if v.kind == "limit" else ~(y >= v.bound)
            axes.scatter(x[::every], y[::every], s=4, color=BLUE, alpha=0.5, linewidth=0)
            axes.scatter(x[missed], y[missed], s=9, color=RED, linewidth=0)
            if y.min() - 0.2 * np.ptp(y) <= v.bound <= y.max() + 0.2 * np.ptp(y):
                axes.axhline(v.bound, color=RED, linewidth=1.0)
            axes.set_xlabel(labels.get(d.name, d.name))
            axes.set_title(f"{v.name}: {d.rank:+.2f}", loc="left")
        return _png(figure)


def _grid(count: int, height: float, columns: int = COLUMNS, left: float = 0.6) -> tuple[Figure, list[Axes]]:
    columns = min(columns, count)
    rows = -(-count // columns)
    width, tall = 10.5, height * rows
    figure = Figure(figsize=(width, tall))  # margins by hand: an automatic layout takes as long as all the drawing
    panels = np.atleast_1d(figure.subplots(rows, columns, squeeze=False)).ravel()
    across, high = width / columns, height
    figure.subplots_adjust(
        left=left / width, right=1.0 - 0.12 / width, bottom=0.5 / tall, top=1.0 - 0.3 / tall,
        wspace=left / (across - left), hspace=0.85 / (high - 0.85),
    )  # fmt: skip
    for axes in panels[count:]:
        axes.set_axis_off()
    return figure, list(panels[:count])


def _png(figure: Figure) -> bytes:
    out = io.BytesIO()
    figure.savefig(out, format="png", dpi=110, metadata={"Software": None})
    return out.getvalue()
