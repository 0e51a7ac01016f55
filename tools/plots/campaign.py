"""Pictures of a campaign as PNG: histograms with limits, envelopes over time, sensitivities. None: nothing to show."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Callable, Sequence
from typing import Any, TypeVar

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import AutoLocator, MaxNLocator
from numpy.typing import NDArray

from maxq.control.kernel.records import Array
from maxq.sim.campaign.analysis import Band, DataSet, Driver, Judged
from maxq.sim.campaign.tails import Tail
from maxq.sim.run.metrics import title_of
from maxq.tools.plots.palette import BLACK, BLUE, GREY, LIMIT
from maxq.tools.plots.style import drawing, label, png, sheet

Item = TypeVar("Item")
Found = Sequence[tuple[Judged, Sequence[Driver]]]

_WIDTH_IN = 10.5
_MOST_POINTS = 4000
_LETTERS_PER_IN = 12.0  # of a title
_LIMITED = {  # channel: the metric whose limits hold for it
    "alpha_total_deg": "max_alpha_deg", "dynamic_pressure_Pa": "max_dynamic_pressure_Pa", "mach": "max_mach",
    "altitude_m": "max_altitude_m", "speed_mps": "max_speed_mps", "q_alpha_Padeg": "max_q_alpha_Padeg",
    "error_pitch_deg": "max_attitude_error_deg", "error_yaw_deg": "max_attitude_error_deg",
    "error_roll_deg": "max_roll_error_deg", "gimbal_pitch_angle_deg": "max_gimbal_deg",
    "gimbal_yaw_angle_deg": "max_gimbal_deg", "gimbal_pitch_rate_degps": "max_gimbal_rate_degps",
    "gimbal_yaw_rate_degps": "max_gimbal_rate_degps", "bend_pitch_gimbal_m": "max_bending_m",
    "bend_yaw_gimbal_m": "max_bending_m",
}  # fmt: skip  # nine more lines otherwise


def _panels(
    items: Sequence[Item], draw: Callable[[Axes, Item], None], height: float, title: str, columns: int = 3
) -> bytes | None:
    """One panel for each item, `height` in inches."""
    if not items:
        return None
    columns = min(columns, len(items))
    rows = -(-len(items) // columns)
    with drawing():
        figure, panels = sheet(rows, columns, height, _WIDTH_IN)
        figure.suptitle(title, fontsize=10, x=0.01, ha="left")
        for axes, item in zip(panels, items, strict=False):
            draw(axes, item)
            letters = int(_LETTERS_PER_IN * _WIDTH_IN / columns * 0.8)
            axes.set_title(textwrap.fill(axes.get_title(loc="left"), letters), fontsize=9)
            for axis in (axes.xaxis, axes.yaxis):
                if isinstance(axis.get_major_locator(), AutoLocator):
                    axis.set_major_locator(MaxNLocator(4 if axis is axes.xaxis else 5))
        for axes in panels[len(items) :]:
            axes.set_axis_off()
        return png(figure, 110)


def _named(name: str, unit: str) -> str:
    """A metric or channel, whose name ends with its unit, for people."""
    plain = title_of(name)
    if plain == name:
        plain = (name if unit == "1" else name.rpartition("_")[0]).replace("_", " ")
    return plain if unit == "1" else f"{plain}, {unit}"


def tails(found: Sequence[tuple[Judged, Tail]], of: str = "") -> bytes | None:
    """Quantiles of each tail against those of the distribution fitted to it; on the line the fit is exact."""

    def draw(axes: Axes, item: tuple[Judged, Tail]) -> None:
        v, tail = item
        axes.plot(tail.expected, tail.excesses, ".", color=BLUE, markersize=4)
        ends = [min(*tail.expected, *tail.excesses), max(*tail.expected, *tail.excesses)]
        axes.plot(ends, ends, color=GREY, linewidth=0.8)
        if ends[0] <= v.bound <= ends[1]:
            axes.axhline(v.bound, color=LIMIT, linewidth=1.0)
        title = f"{v.name}: shape {tail.shape:+.2f}, fit {tail.fit:.2f}"
        label(axes, f"fitted: {_named(v.metric, v.unit)}", "flown", title)

    return _panels(found, draw, 2.6, f"Tails against the distribution fitted to them; {of}")


def histograms(data: DataSet, verdicts: Sequence[Judged], of: str = "") -> bytes | None:
    """One for each requirement that has a metric. `of`: vehicle and design, for the title."""

    def draw(axes: Axes, v: Judged) -> None:
        values = data.numbers(v.metric)[~data.void]
        _histogram(axes, values[np.isfinite(values)], v)

    return _panels([v for v in verdicts if v.metric and len(data.runs)], draw, 2.4, f"Metrics of all runs; {of}")


def missed(values: Array, v: Judged) -> NDArray[np.bool_]:
    """Which values miss the requirement; at the limit it is met."""
    return np.asarray(~(values <= v.bound) if v.kind == "limit" else ~(values >= v.bound))


def _histogram(axes: Axes, values: Array, v: Judged) -> None:
    """Red is what misses the limit. A limit that is far away is written at the edge, so that it does not squeeze the
    bars together.
    """
    axes.set_title(v.name)
    label(axes, _named(v.metric, v.unit), "runs")
    if not len(values):
        return
    low, high, upper = float(values.min()), float(values.max()), v.kind == "limit"
    width = high - low or max(abs(high), 1.0)
    edges = np.histogram_bin_edges(values, bins=min(max(round(math.sqrt(len(values))), 10), 60))
    bars: Any = {"x": edges[:-1], "width": np.diff(edges), "align": "edge"}
    wrong, every = np.histogram(values[missed(values, v)], edges)[0], np.histogram(values, edges)[0]
    axes.bar(height=every, color=BLUE, **bars)
    axes.bar(height=wrong, color=LIMIT, **bars)
    axes.set_ylim(0.0, 1.25 * every.max())
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


def envelopes(
    bands: Sequence[Band], units: dict[str, str], verdicts: Sequence[Judged] = (), of: str = ""
) -> bytes | None:
    """One panel for each channel: the middle line, bands between the percentiles on either side of it, and in red the
    limits on the channel, those far beyond it in words.
    """

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
        low, high = float(np.nanmin(lines)), float(np.nanmax(lines))
        room = max(high - low, 1e-12)
        beyond = []
        for v in (v for v in verdicts if v.metric and v.metric == _LIMITED.get(band.channel)):
            both = v.kind == "limit" and band.channel not in ("alpha_total_deg", "q_alpha_Padeg") and low < 0.0
            for bound in (v.bound, -v.bound)[: 1 + both]:
                if low - room < bound < high + room:
                    axes.axhline(bound, color=LIMIT, linewidth=1.2)
                elif bound == v.bound:
                    beyond.append(f"{v.kind} {'+-' if both else ''}{v.bound:g}")
        axes.set_title(_named(band.channel, units.get(band.channel, "1")) + "".join(f" ({text})" for text in beyond))
        axes.set_xlabel("time, s")
        axes.margins(x=0.0)
        if band is bands[0]:
            axes.figure.legend(*axes.get_legend_handles_labels(), loc="outside upper right", ncols=4)

    return _panels(bands, draw, 2.3, f"Envelopes; {of}")


def tornado(found: Found, labels: dict[str, str], of: str = "", most: int = 8) -> bytes | None:
    """Rank correlations of the strongest inputs with each metric; grey within the noise."""

    def draw(axes: Axes, shown: tuple[Judged, Sequence[Driver]]) -> None:
        v, drivers = shown[0], shown[1][:most]
        places = np.arange(len(drivers))[::-1]
        axes.barh(places, [d.rank for d in drivers], color=[BLUE if d.matters else GREY for d in drivers], height=0.7)
        names = [textwrap.shorten(labels.get(d.name, d.name), 44, placeholder=" ...") for d in drivers]
        axes.set_yticks(places, names, fontsize=7.5)
        axes.axvspan(-drivers[0].noise, drivers[0].noise, color=GREY, alpha=0.25, linewidth=0)
        axes.axvline(0.0, color=BLACK, linewidth=0.8)
        axes.set_xlim(-1.0, 1.0)
        axes.set_title(v.name)
        axes.set_xlabel("rank correlation")

    panels = [(v, drivers) for v, drivers in found if drivers]
    return _panels(panels, draw, 2.5, f"What drives each metric; {of}", columns=2)


def scatter(
    data: DataSet, found: Found, inputs: dict[str, Array], labels: dict[str, str], of: str = ""
) -> bytes | None:
    """The three strongest inputs of each metric against it."""

    def draw(axes: Axes, shown: tuple[Judged, Driver]) -> None:
        v, d = shown
        x, y = inputs[d.name], data.numbers(v.metric)[~data.void]
        every, wrong = max(len(x) // _MOST_POINTS, 1), missed(y, v)
        size = 14.0 if len(x) < 500 else 7.0
        axes.scatter(x[::every], y[::every], s=size, color=BLUE, alpha=0.5, linewidth=0)
        axes.scatter(x[wrong], y[wrong], s=1.5 * size, color=LIMIT, linewidth=0)
        if y.min() - 0.2 * np.ptp(y) <= v.bound <= y.max() + 0.2 * np.ptp(y):
            axes.axhline(v.bound, color=LIMIT, linewidth=1.0)
        label(axes, _input(d.name, labels), _named(v.metric, v.unit), f"{v.name}: {d.rank:+.2f}")

    panels = [(v, d) for v, drivers in found for d in drivers[:3]]
    return _panels(panels, draw, 2.3, f"Strongest inputs, with their rank correlation; {of}")


_UNITS = {"mps": "m/s", "radps": "rad/s", "degps": "deg/s", "kg": "kg", "m": "m", "s": "s", "deg": "deg", "hz": "Hz",
          "N": "N", "Pa": "Pa", "rad": "rad", "g": "g", "K": "K"}  # fmt: skip  # eleven more lines otherwise


def _input(name: str, labels: dict[str, str]) -> str:
    """An input for people, with the unit that its key ends with."""
    unit = _UNITS.get(name.rpartition("_")[2], "")
    text = labels.get(name, name)
    return textwrap.fill(text if not unit or text.endswith(f", {unit}") else f"{text}, {unit}", 44)
