"""Plots sent to a recording: one entity per curve, decimated to its extremes, limits as hatched bands."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import rerun as rr

from maxq.control.kernel.records import Array, IntArray
from maxq.tools.plots.palette import GREY, LIMIT, ON_DARK, rgba
from maxq.tools.replay.decimate import extremes
from maxq.tools.replay.flight import Channels
from maxq.tools.replay.limits import Limit
from maxq.tools.replay.plots import Plot, Tab
from maxq.tools.replay.sending import times

NEAR = 3.0  # a limit farther away than so many times the largest value is named, not drawn
_TEETH = 240  # of the hatching over the whole flight


@dataclass(frozen=True)
class Style:
    """How a flight's curves look: one colour for all of it, or one for each curve (None); a name put before labels."""

    colour: str | None = None
    prefix: str = ""
    width: float = 1.4
    alpha: float = 1.0


def curve_entity(root: str, plot: Plot, number: int) -> str:
    return f"{root}/plots/{plot.key}/curve_{number + 1}"


def limits_root(plot: Plot) -> str:
    return f"limits/{plot.key}"


def send_styles(recording: rr.RecordingStream, root: str, tabs: Sequence[Tab], style: Style) -> None:
    """Names, colours and the rule that no extreme may be averaged away when the viewer zooms out."""
    for tab in tabs:
        for plot in tab.plots:
            for i, curve in enumerate(plot.curves):
                colour = style.colour or ON_DARK[i % len(ON_DARK)]
                lines = rr.SeriesLines(
                    names=style.prefix + curve.label,
                    colors=rgba(colour, style.alpha),
                    widths=style.width,
                    aggregation_policy=rr.components.AggregationPolicy.MinMax,
                )
                recording.log(curve_entity(root, plot, i), lines, static=True)


def send_curves(
    recording: rr.RecordingStream, root: str, tabs: Sequence[Tab], channels: Channels, interval_ns: int
) -> None:
    """The samples of a block or of a whole log."""
    for tab in tabs:
        for plot in tab.plots:
            for i, curve in enumerate(plot.curves):
                ns, values = curve.values(channels)
                if not len(ns):
                    continue
                kept = extremes(ns, values, interval_ns)
                columns = rr.Scalars.columns(scalars=values[kept])
                recording.send_columns(curve_entity(root, plot, i), times(ns[kept]), columns)


def value_range(plot: Plot, channels: Channels) -> tuple[float, float] | None:
    """Smallest and largest value of a plot's curves; None where there is no number."""
    lows, highs = [], []
    for curve in plot.curves:
        _, values = curve.values(channels)
        finite = values[np.isfinite(values)]
        if len(finite):
            lows.append(float(finite.min()))
            highs.append(float(finite.max()))
    return (min(lows), max(highs)) if lows else None


@dataclass(frozen=True)
class Axis:
    """The range of a plot's y axis, the limits within it and those beyond."""

    low: float
    high: float
    drawn: tuple[Limit, ...]
    beyond: tuple[Limit, ...]


def axis_of(plot: Plot, found: tuple[float, float] | None) -> Axis:
    """A range that shows the data, and each limit that is near enough not to squash them."""
    low, high = found or (0.0, 1.0)
    reach = max(abs(low), abs(high), 1e-12)
    drawn = tuple(limit for limit in plot.limits if abs(limit.value) <= NEAR * reach)
    beyond = tuple(limit for limit in plot.limits if limit not in drawn)
    low, high = min([low, *(x.value for x in drawn)]), max([high, *(x.value for x in drawn)])
    if high - low < 1e-9 * max(abs(high), abs(low), 1e-3):  # a constant
        room = max(0.5 * abs(high), 1.0 if high == 0.0 else 0.0)
        low, high = low - room, high + room
    margin = 0.06 * (high - low)
    return Axis(low - margin, high + margin, drawn, beyond)


def beyond_text(axis: Axis, unit: str) -> str:
    """What to say of limits that are not drawn: `limit 30 deg/s is off the scale`."""
    sizes = sorted({abs(limit.value) for limit in axis.beyond})
    if not sizes:
        return ""
    text = " and ".join(f"{size:g}" for size in sizes) + (f" {unit}" if unit else "")
    return f"limit{'s' * (len(sizes) > 1)} {text} off the scale"


def send_limits(recording: rr.RecordingStream, plot: Plot, axis: Axis, span_ns: tuple[int, int]) -> None:
    """A line at each limit and hatching on the forbidden side."""
    for i, limit in enumerate(axis.drawn):
        colour = LIMIT if limit.required else GREY
        edge = axis.high if limit.upper else axis.low
        ns, hatch = _hatch(limit.value, edge, span_ns)
        name = f"{limits_root(plot)}/limit_{i + 1}"
        parts: tuple[tuple[str, Array, IntArray, float, float], ...] = (
            ("line", np.full(2, limit.value), np.array(span_ns, np.int64), 1.6, 1.0),
            ("band", hatch, ns, 1.0, 0.45),
        )
        for part, values, at, width, alpha in parts:
            label = f"limit: {limit.label} {abs(limit.value):g}"  # one entry of the legend for all its parts
            style = rr.SeriesLines(names=label, colors=rgba(colour, alpha), widths=width)
            recording.log(f"{name}/{part}", style, static=True)
            recording.send_columns(f"{name}/{part}", times(at), rr.Scalars.columns(scalars=values))


def send_limit_lines(recording: rr.RecordingStream, plot: Plot, span_ns: tuple[int, int], styled: bool) -> None:
    """Requirements as lines alone, for a flight under way: between two times, with their style the first time."""
    for i, limit in enumerate(x for x in plot.limits if x.required):
        name = f"{limits_root(plot)}/limit_{i + 1}/line"
        if styled:
            label = f"limit: {limit.label} {abs(limit.value):g}"
            recording.log(name, rr.SeriesLines(names=label, colors=rgba(LIMIT)), static=True)
        values = rr.Scalars.columns(scalars=np.full(2, limit.value))
        recording.send_columns(name, times(np.array(span_ns, np.int64)), values)


def _hatch(value: float, edge: float, span_ns: tuple[int, int]) -> tuple[IntArray, Array]:
    ns = np.linspace(span_ns[0], span_ns[1], 2 * _TEETH + 1).astype(np.int64)
    return ns, np.where(np.arange(len(ns)) % 2 == 0, value, edge)
