"""The standard set of plots for a review: a sheet for each subject, as SVG and PNG, with events, limits and units.

One flight gives lines; several give lines coloured by outcome; a campaign gives envelopes over its kept flights, with
the nominal on top.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from maxq.control.kernel.records import Array, IntArray
from maxq.tools.plots.palette import BLACK, GREY, LIMIT, VERDICT, rgba
from maxq.tools.replay.collect import is_nominal
from maxq.tools.replay.decimate import extremes
from maxq.tools.replay.error import ReplayError
from maxq.tools.replay.flight import ReplayFlight
from maxq.tools.replay.plot_stream import Axis, axis_of, beyond_text, value_range
from maxq.tools.replay.plots import Curve, Plot, Tab, tabs_of
from maxq.tools.replay.print_style import ROW_IN, WIDTH_IN, curve_look, in_style
from maxq.tools.replay.special_sheets import special_sheets

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_ENVELOPE_FROM = 6  # so many flights are drawn as envelope instead of one by one
_BINS = 1500
_EVENTS = ("liftoff", "max_q", "burnout", "separation", "apogee", "impact", "control_lost", "tumble", "diverged")
_FORMATS = ("svg", "png")


def write_sheets(flights: Sequence[ReplayFlight], folder: Path, only: str = "") -> list[Path]:
    """Draw all sheets into a folder, which is made; returns the files. Raises ReplayError where that fails.

    `only`: those of one tab, a part of its name.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ReplayError(f"{folder}: cannot be written: {(error.strerror or str(error)).lower()}") from error
    import matplotlib.pyplot as plt  # noqa: PLC0415  # lazy

    written: list[Path] = []
    with in_style():
        reference = next((f for f in flights if is_nominal(f)), flights[0])
        tabs = tabs_of(reference.log.table, reference.scenario)
        for number, tab in enumerate(tabs, start=1):
            if only not in tab.name.lower():
                continue
            if tab.name == "Trajectory" or any(_has_numbers(plot, flights) for plot in tab.plots):
                figure = _sheet(tab, flights, reference)
                written += _save(figure, folder / f"{number:02}-{tab.name.lower()}")
                plt.close(figure)
        for name, figure in special_sheets(flights, reference) if not only else ():
            written += _save(figure, folder / name)
            plt.close(figure)
    return written


def _save(figure: Any, stem: Path) -> list[Path]:
    files = []
    figure.canvas.draw()
    figure.set_layout_engine("none")  # both files have the layout that it has now
    for kind in _FORMATS:
        path = stem.with_suffix(f".{kind}")
        try:
            figure.savefig(path, metadata={"Date": None} if kind == "svg" else {"Software": None})
        except OSError as error:
            raise ReplayError(f"{path}: cannot be written: {(error.strerror or str(error)).lower()}") from error
        files.append(path)
    return files


def _has_numbers(plot: Plot, flights: Sequence[ReplayFlight]) -> bool:
    return any(value_range(_of(plot, f), f.log) is not None for f in flights)


def _of(plot: Plot, flight: ReplayFlight) -> Plot:
    """The plot with those curves only that a flight has."""
    curves = tuple(curve for curve in plot.curves if curve.channel in flight.log)
    return Plot(plot.key, plot.title, plot.unit, curves, plot.limits)


def _sheet(tab: Tab, flights: Sequence[ReplayFlight], reference: ReplayFlight) -> Any:
    import matplotlib.pyplot as plt  # noqa: PLC0415  # lazy

    count = len(tab.plots)
    figure, places = plt.subplots(
        count, 1, figsize=(WIDTH_IN, 0.9 + ROW_IN * count), sharex=True, squeeze=False, layout="constrained"
    )
    span = _span(tab, flights)
    for place, plot in zip(places[:, 0], tab.plots, strict=True):
        _draw(place, plot, flights, reference, span)
    places[0, 0].set_xlim(span)
    places[-1, 0].set_xlabel("time (s)")
    figure.align_ylabels()
    mark_events(list(places[:, 0]), reference, span)
    figure.suptitle(sheet_title(tab.name, flights, reference), fontsize=11, fontweight="bold", x=0.01, ha="left")
    return figure


def sheet_title(name: str, flights: Sequence[ReplayFlight], reference: ReplayFlight) -> str:
    if len(flights) == 1:
        outcome = f"{reference.outcome} at {reference.span_s[1]:.1f} s"
        return f"{name} - {reference.label} ({outcome})"
    failed = sum(f.verdict == "failed" for f in flights)
    how = "shaded: all, " if len(flights) >= _ENVELOPE_FROM else ""
    return f"{name} - {len(flights)} flights, {failed} failed ({how}thick: {reference.label}, thin red: failed)"


def _span(tab: Tab, flights: Sequence[ReplayFlight]) -> tuple[float, float]:
    """The whole flight for what concerns all of it; else until shortly after burn-out, where the rest is at zero."""
    start, end = min(f.span_s[0] for f in flights), max(f.span_s[1] for f in flights)
    if tab.name in ("Trajectory", "Air"):
        return start, end
    burnouts = [m.time_s for f in flights if (m := f.moment("burnout")) is not None]
    return (start, min(end, max(burnouts) * 1.12)) if burnouts else (start, end)


def _draw(
    place: Axes, plot: Plot, flights: Sequence[ReplayFlight], reference: ReplayFlight, span: tuple[float, float]
) -> None:
    ranges = []
    if len(flights) == 1:
        for number, curve in enumerate(_of(plot, reference).curves):
            ns, values = _seen(curve, reference, span)
            kept = extremes(ns, values, max(round((span[1] - span[0]) * 1e9 / 4000), 1))
            place.plot(ns[kept] / 1e9, values[kept], label=curve.label, **curve_look(number))
            ranges.append(values)
    else:
        for number, curve in enumerate(plot.curves):
            ranges += _draw_many(place, curve, number, flights, reference, span)
    numbers = np.concatenate(ranges) if ranges else np.zeros(0)
    numbers = numbers[np.isfinite(numbers)]
    axis = axis_of(plot, (float(numbers.min()), float(numbers.max())) if len(numbers) else None)
    place.set_ylim(axis.low, axis.high)
    draw_limits(place, axis)
    beyond = beyond_text(axis, plot.unit)
    place.set_title(plot.title + (f"  [{beyond}]" if beyond else ""))
    place.set_ylabel(plot.unit or "1")
    if len(plot.curves) > 1 or axis.drawn:
        legend = place.legend(
            loc="lower right", bbox_to_anchor=(1.0, 0.985), ncols=8, borderaxespad=0.0, handlelength=1.6
        )
        legend.set_in_layout(False)  # a long one does not squeeze the plot


def _seen(curve: Curve, flight: ReplayFlight, span: tuple[float, float]) -> tuple[IntArray, Array]:
    ns, values = curve.values(flight.log)
    a, b = np.searchsorted(ns, [round(span[0] * 1e9), round(span[1] * 1e9) + 1])
    return ns[a:b], values[a:b]


def _draw_many(
    place: Axes, curve: Curve, number: int, flights: Sequence[ReplayFlight], reference: ReplayFlight,
    span: tuple[float, float],
) -> list[Array]:  # fmt: skip
    """Lines of a few flights, or the envelope of many with the failed ones and the reference as lines."""
    edges = np.linspace(span[0], span[1], _BINS + 1)
    look = curve_look(number)
    lows, highs, drawn = [], [], []
    for flight in flights:
        if curve.channel not in flight.log:
            continue
        ns, values = _seen(curve, flight, span)
        drawn.append(values)
        low, high = binned(ns / 1e9, values, edges)
        lows.append(low)
        highs.append(high)
        as_line = len(flights) < _ENVELOPE_FROM or flight.verdict == "failed"
        if as_line and flight is not reference:
            kept = extremes(ns, values, max(round((span[1] - span[0]) * 1e9 / 1500), 1))
            colour = VERDICT[flight.verdict]
            place.plot(
                ns[kept] / 1e9, values[kept], color=colour, linewidth=0.6, alpha=0.7, linestyle=look["linestyle"]
            )
    if not lows:
        return []
    if len(flights) >= _ENVELOPE_FROM:
        with np.errstate(all="ignore"):
            bottom, top = np.fmin.reduce(lows), np.fmax.reduce(highs)
        middle = 0.5 * (edges[1:] + edges[:-1])
        place.fill_between(middle, bottom, top, color=look["color"], alpha=0.25, linewidth=0, label="_")
    ns, values = (
        _seen(curve, reference, span) if curve.channel in reference.log else (np.zeros(0, np.int64), np.zeros(0))
    )
    if len(ns):
        kept = extremes(ns, values, max(round((span[1] - span[0]) * 1e9 / 4000), 1))
        colour = BLACK if number == 0 else look["color"]
        place.plot(
            ns[kept] / 1e9, values[kept], color=colour, linestyle=look["linestyle"], linewidth=1.0,
            label=curve.label,
        )  # fmt: skip
    return drawn


def binned(time_s: Array, values: Array, edges: Array) -> tuple[Array, Array]:
    """Smallest and largest value in each interval; an interval without samples takes the value on the line."""
    low, high = np.full(len(edges) - 1, np.inf), np.full(len(edges) - 1, -np.inf)
    finite = np.isfinite(values)
    place = np.searchsorted(edges, time_s, side="right") - 1
    inside = finite & (place >= 0) & (place < len(low))
    np.minimum.at(low, place[inside], values[inside])
    np.maximum.at(high, place[inside], values[inside])
    empty = np.isinf(low)
    if finite.any() and empty.any():
        middle = 0.5 * (edges[1:] + edges[:-1])
        between = np.interp(middle, time_s[finite], values[finite], left=np.nan, right=np.nan)
        low[empty] = high[empty] = between[empty]
    low[np.isinf(low)] = high[np.isinf(high)] = np.nan
    return low, high


def draw_limits(place: Axes, axis: Axis) -> None:
    """What is not allowed is shaded and hatched, so that it is seen without colour too."""
    named: set[str] = set()
    for limit in axis.drawn:
        colour = LIMIT if limit.required else GREY
        edge = axis.high if limit.upper else axis.low
        text = f"{limit.label}: {abs(limit.value):g}"
        label = None if text in named else text
        named.add(text)
        face = (*[c / 255 for c in rgba(colour)[:3]], 0.10)
        hatch = "////" if limit.required else None
        place.axhspan(
            limit.value, edge, facecolor=face, edgecolor=(*face[:3], 0.45), hatch=hatch, linewidth=0.0, zorder=0.5
        )
        place.axhline(limit.value, color=colour, linewidth=0.9, label=label, zorder=1.5)


def mark_events(places: Sequence[Axes], flight: ReplayFlight, span: tuple[float, float]) -> None:
    """Vertical lines through all plots, names above the first."""
    named: list[float] = []
    for moment in sorted(flight.moments, key=lambda m: m.level, reverse=True):  # what went wrong gets its name first
        if moment.name not in _EVENTS or not span[0] <= moment.time_s <= span[1]:
            continue
        for place in places:
            place.axvline(moment.time_s, color=GREY, linewidth=0.7, linestyle=(0, (2, 2)), zorder=1.0)
        if any(abs(moment.time_s - other) < 0.02 * (span[1] - span[0]) for other in named):
            continue
        named.append(moment.time_s)
        right = moment.time_s > span[0] + 0.97 * (span[1] - span[0])
        places[0].annotate(
            f"{moment.name.replace('_', ' ')} {moment.time_s:.1f} s", (moment.time_s, 0.5),
            xycoords=("data", "axes fraction"), xytext=(-2 if right else 2, 0), textcoords="offset points",
            fontsize=6.5, color="#555555", rotation=90, ha="right" if right else "left", va="center", zorder=1.2,
        )  # fmt: skip
