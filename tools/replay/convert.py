"""The conversion of flights to a recording, with all data that the viewer shows, and its layout."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any, Literal

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from maxq.control.kernel.records import Array
from maxq.sim.files import whole_file
from maxq.sim.log.messages import FramePath
from maxq.tools.plots.palette import BLUE, FAILED, GREY, ON_DARK, ORANGE, PURPLE, RED, VERDICT, WHITE
from maxq.tools.replay import stream
from maxq.tools.replay.flight import FEW, ReplayFlight, ShownLaunchSite, closest, has_motion, path_of, place_of
from maxq.tools.replay.plots import PlotAxis, ReplayPlot, Tab, axis_of, own_tabs, range_of, tabs_of
from maxq.tools.replay.scene import FAR_NS, Scene, compass_ends, send_ground, tail_below_cg
from maxq.tools.replay.text import about, drawn_text
from maxq.tools.replay.vehicle_shape import Exaggeration, VehicleShape, exaggeration_of, shape_of
from maxq.tools.replay.viewer import ReplayError

DEFAULT_RATE_HZ, MANY_RATE_HZ = 50.0, 10.0
_NOMINAL_COLOUR = PURPLE
_NIGHT, _DEEP = [24, 29, 38, 255], [13, 17, 24, 255]
_CORNERS = {  # right, top
    rrb.Corner2D.RightTop: (True, True),
    rrb.Corner2D.LeftTop: (False, True),
    rrb.Corner2D.RightBottom: (True, False),
    rrb.Corner2D.LeftBottom: (False, False),
}
_WHOLE = 0.04  # share of an axis for half the height of a number
_BEHIND = 0.07  # share of the powered flight shown after it, so that the number at its end is not cut
_LEGEND_LINES = 4  # curves above which a legend of several flights would cover the curves
_LEGEND_MOST = COLOURED = 6  # flights with a colour and a name of their own; more names would cover the plots
_PLOT_PX = 420.0, 730.0  # width of a plot of two columns, and height of all plots of a column, in a picture
_PHASED = 6  # most flights whose phases are shown
_MOSTLY = 0.9  # share of the time under thrust above which there is no part for it


@dataclass(frozen=True)
class Options:
    """The options of `simreplay`. None selects a value that suits the flights."""

    rate_hz: float | None = None
    bend_factor: float | None = None
    slosh_factor: float | None = None
    side_by_side: bool = False
    tab: str | None = None
    bare: bool = False  # True for a picture, which is drawn without the viewer's menu
    at: Sequence[float] | None = None  # times of pictures, s, which the front plots contain


@dataclass(frozen=True)
class TimeSpan:
    """A part of the time and the axes of the plots over it. `name` is the name of its tab, if there are several."""

    name: str
    span_s: tuple[float, float]
    axes: Mapping[str, PlotAxis]
    corners: Mapping[str, rrb.Corner2D] = field(default_factory=dict)
    """The corner of each plot in which a legend hides least, if it is not the upper right."""


@dataclass(frozen=True)
class _Drawn:
    """A flight whose data has been sent to the three-dimensional views."""

    root: str
    flight: ReplayFlight
    path: FramePath
    place: ShownLaunchSite
    shape: VehicleShape | None


def save(flights: Sequence[ReplayFlight], options: Options, path: Path) -> None:
    """Write an .rrd file, which any viewer of this version opens without further files.

    The file is written completely or not at all. Raises FileError.
    """
    name = ", ".join(flight.label for flight in flights[:3]) + (" ..." if len(flights) > 3 else "")
    recording = rr.RecordingStream(stream.APPLICATION, recording_id=name)
    with whole_file(path) as part, recording:
        recording.save(part)
        blueprint = send_flights(recording, flights, options)
        recording.send_blueprint(blueprint, make_active=True, make_default=True)
        recording.flush()
        recording.disconnect()


def send_flights(recording: rr.RecordingStream, flights: Sequence[ReplayFlight], options: Options) -> rrb.Blueprint:
    """Send all data of the flights, and return the layout."""
    many = len(flights) > 1
    interval_ns = round(1e9 / (options.rate_hz or (MANY_RATE_HZ if len(flights) > FEW else DEFAULT_RATE_HZ)))
    near = closest(flights)
    scenario = next((s for i in sorted(near) if (s := flights[i].scenario) is not None), None)
    tabs = tabs_of(flights[0].log.table, scenario)
    span_s = min(f.span_s[0] for f in flights), max(f.span_s[1] for f in flights)
    recording.log("/", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)

    parts = parts_of(flights, span_s)
    ranges: dict[tuple[str, str], list[tuple[float, float]]] = {}
    drawn: list[_Drawn] = []
    exaggeration = common_exaggeration([flights[i] for i in sorted(near)], options)
    family = stream.Family(span_s, interval_ns) if len(flights) - len(near) >= stream.FAMILY_FROM else None
    roots, colours = _roots(flights), colours_of(flights)
    by_width = {plot.key for tab in tabs for plot in tab.plots if legend_of(tab, plot, len(flights)) == "flights"}
    plotted = [stream.FAMILY] if family is not None else []
    for i, (root, flight) in enumerate(zip(roots, flights, strict=True)):
        colour = colours[i] if many else None
        own = own_tabs(tabs, flight.log.table, flight.scenario if i in near else None) if many else tabs
        if family is not None and colour is not None and i not in near:
            family.add(flight.label, colour, own, flight.log)
        else:
            plotted.append(root)
            prefix, alpha = prefix_of(flight, many=many), 1.0 if len(flights) <= FEW else 0.55
            stream.send_styles(recording, root, own, colour, prefix, alpha, by_width)
            stream.send_curves(recording, root, own, flight.log, interval_ns)
        for plot in (plot for tab in own for plot in tab.plots):
            for name, part_s in parts.items():
                seen_ns = (round(s * 1e9) for s in seen_of(part_s, span_s))
                if (found := plot.value_range(flight.log, *seen_ns)) is not None:
                    ranges.setdefault((name, plot.key), []).append(found)
        start = stream.first_phase(flight.log, round(flight.span_s[0] * 1e9))
        stream.send_phases(recording, root, stream.phases(start, flight.moments), styled=True)
        if has_motion(flight.log):
            drawn.append(_send_scene(recording, root, flight, exaggeration, colour, near=i in near))

    if family is not None:
        family.send(recording)
    listed = [(flight.label, flight.moments) for i, flight in enumerate(flights) if i in near]
    note = f"Events of the {len(listed)} flights whose vehicles are drawn." if len(listed) < len(flights) else ""
    stream.send_events(recording, listed, round(span_s[0] * 1e9), note)
    every = [plot for tab in tabs for plot in tab.plots]
    spans = []
    for name, (start_s, end_s) in parts.items():
        axes = {p.key: axis_of(p, range_of([np.array(r) for r in ranges.get((name, p.key), [])])) for p in every}
        seen_s = seen_of((start_s, end_s), span_s)
        corners = {
            plot.key: free_corner(plot, axes[plot.key], seen_s, flights, rows_and_columns(tab)[0], plot.key in by_width)
            for tab in tabs
            for plot in tab.plots
            if len(flights) <= FEW
        }
        spans.append(TimeSpan(name, seen_s, axes, corners))
    for plot in every:
        axis = spans[-1].axes[plot.key]
        stream.send_limits(recording, plot, axis.drawn, (round(span_s[0] * 1e9), round(span_s[1] * 1e9)), axis)
        if plot.key in by_width:
            stream.send_widths(recording, plot, round(span_s[0] * 1e9))
    stream.send_now(recording, [(flight.label if many else "", flight.log) for flight in flights[:COLOURED]])
    text = about(flights, drawn_text(exaggeration, None if many else drawn[0].place) if drawn else [])
    recording.log("about", rr.TextDocument(text, media_type="text/markdown"), static=True)
    pictures = _pictures(recording, roots, drawn, exaggeration, options.side_by_side) if drawn else []
    front = part_with([span.span_s for span in spans], options.at or ())
    return layout(roots, pictures, tabs, spans, plotted=plotted, tab=options.tab, bare=options.bare, front=front)


def part_with(parts_s: Sequence[tuple[float, float]], times_s: Sequence[float]) -> int:
    """Return the index of the first part that contains all times, or that of the last part, which is the whole
    flight.
    """
    inside = (k for k, (start_s, end_s) in enumerate(parts_s) if all(start_s <= t <= end_s for t in times_s))
    return next(inside, len(parts_s) - 1)


def seen_of(part_s: tuple[float, float], span_s: tuple[float, float]) -> tuple[float, float]:
    """Return the time span that a plot of a part shows.

    It ends slightly after the part, so that the number at its end is not cut, but not after `span_s`.
    """
    return part_s[0], min(part_s[1] + _BEHIND * (part_s[1] - part_s[0]), span_s[1])


def parts_of(flights: Sequence[ReplayFlight], span_s: tuple[float, float]) -> dict[str, tuple[float, float]]:
    """Return the parts of the flight by name, as time spans (s), with the whole flight last.

    The other parts are the stages if all flights have the same number of separations. Otherwise, the only other part is
    the powered flight, which is omitted if it is nearly the whole flight.
    """
    whole = {"Whole flight": span_s}
    parted = [[m.time_s for m in f.moments if m.name == "separation"] for f in flights]
    if parted[0] and len({len(times) for times in parted}) == 1:
        edges = [span_s[0], *np.max(parted, axis=0).tolist(), span_s[1]]
        stages = flights[0].scenario.vehicle.stage if flights[0].scenario is not None else ()
        names = [s.name or f"stage {k + 1}" for k, s in enumerate(stages)]
        if len(names) != len(edges) - 1 or len(set(names)) != len(names):
            names = [f"stage {k + 1}" for k in range(len(edges) - 1)]
        return dict(zip(names, pairwise(edges), strict=True)) | whole
    burnt_s = max(f.burn_end_s for f in flights)
    if burnt_s - span_s[0] > _MOSTLY * (span_s[1] - span_s[0]):
        return {"": span_s}
    return {"Powered flight": (span_s[0], burnt_s)} | whole


def _send_scene(
    recording: rr.RecordingStream,
    root: str,
    flight: ReplayFlight,
    exaggeration: Exaggeration,
    colour: str | None,
    *,
    near: bool,
) -> _Drawn:
    """Send the vehicle and the trajectory of a flight. `colour` identifies one flight among others."""
    place = place_of(flight)
    scenario = flight.scenario if near else None
    shape = shape_of(scenario.vehicle) if scenario is not None else None
    trail = colour or ORANGE, colour or BLUE
    scene = Scene(recording, root, place, shape, exaggeration, trail=trail, near=near)
    scene.add(flight.log)
    path = path_of(flight.log, place.frames(flight.log.table, FAR_NS))
    scene.whole_path(path, colour or GREY)
    if colour is None:
        scene.mark(flight.moments, path)
    return _Drawn(root, flight, path, place, shape)


def _pictures(
    recording: rr.RecordingStream, roots: Sequence[str], drawn: Sequence[_Drawn], ex: Exaggeration, side_by_side: bool
) -> list[rrb.View | rrb.Container]:
    """Return the three-dimensional views: close-ups of the vehicles, and the trajectories from the side."""
    first = drawn[0]
    positions = np.concatenate([each.path.translation_m for each in drawn])
    reach = float(np.abs(positions[:, :2]).max(initial=0.0))
    length = first.shape.length_m if first.shape is not None else 10.0
    grid = send_ground(recording, first.place, max(reach, 100.0), tail_below_cg(first.flight.log, first.shape))
    seen = np.concatenate([positions, compass_ends(first.place, max(reach, 100.0))])
    eyes = eyes_for(length, first.place.site.azimuth_deg, seen)
    factor = ex.text(first.flight.log.table) if first.shape else ""
    close: list[rrb.View | rrb.Container] = []
    for each in drawn:
        if each.shape is None and (close or len(drawn) > FEW):
            continue
        name = "Vehicle" if len(drawn) == 1 else each.flight.label
        close.append(close_view(each.root, eyes, f"{name} ({factor})" if factor and len(drawn) < 3 else name))
    if len(close) > 1:
        close = [rrb.Grid(contents=close) if side_by_side else rrb.Tabs(contents=close)]
    return [*close, overview(roots, eyes, grid)]


def colours_of(flights: Sequence[ReplayFlight]) -> list[str]:
    """Return a colour for each of several flights.

    Up to `COLOURED` flights have distinct colours, shades of red if they failed. Otherwise the colour is that of the
    verdict.
    """
    if len(flights) > COLOURED:
        return [_NOMINAL_COLOUR if flight.is_nominal else VERDICT[flight.verdict] for flight in flights]
    others, failed = iter(colour for colour in (*ON_DARK, WHITE) if colour != RED), iter(FAILED)
    return [next(failed if flight.verdict == "failed" else others) for flight in flights]


def _roots(flights: Sequence[ReplayFlight]) -> list[str]:
    """Return a distinct root of entities for each flight."""
    if len(flights) == 1:
        return ["flight"]
    out: list[str] = []
    for flight in flights:
        name = "flights/" + (re.sub(r"[^A-Za-z0-9_.-]+", "-", flight.label).strip("-.") or "flight")
        out.append(name if name not in out else f"{name}-{len(out) + 1}")
    return out


def common_exaggeration(flights: Sequence[ReplayFlight], options: Options) -> Exaggeration:
    """Return common factors for all of the drawn vehicles, so that they can be compared."""
    each = []
    for flight in flights:
        shape = shape_of(flight.scenario.vehicle) if flight.scenario is not None else None
        each.append(exaggeration_of(flight.log, shape, options.bend_factor, options.slosh_factor))
    return Exaggeration(min(e.bending for e in each), min(e.slosh for e in each), max(e.most_m for e in each))


# -- the layout: close-up, overview, plots in tabs, phases, events, and a page about the flight ----------------------
@dataclass(frozen=True)
class Eyes:
    """The positions of the cameras, m: the offset of the close-up from the vehicle, and the place and aim of the
    overview.
    """

    close: tuple[float, float, float]
    overview: tuple[float, float, float]
    aim: tuple[float, float, float]


def eyes_for(length_m: float, azimuth_deg: float, positions_m: Array) -> Eyes:
    """Return cameras that look across the plane of flight, from the right and slightly from above.

    `positions_m` (n, 3) are those to be seen in the overview.
    """
    a = np.radians(azimuth_deg)
    forward, right = np.array([np.sin(a), np.cos(a), 0.0]), np.array([np.cos(a), -np.sin(a), 0.0])
    close = 1.5 * length_m * (0.93 * right - 0.3 * forward) + np.array([0.0, 0.0, 0.35 * length_m])
    low, high = positions_m.min(axis=0), positions_m.max(axis=0)
    middle, wide, tall = 0.5 * (low + high), float(np.linalg.norm((high - low)[:2])), float((high - low)[2])
    away = max(0.72 * wide, 1.3 * tall, 8.0 * length_m)  # the view is twice as wide as high
    far = middle + away * (right - 0.25 * forward) + np.array([0.0, 0.0, 0.3 * away])
    return Eyes(*((float(x), float(y), float(z)) for x, y, z in (close, far, middle)))


def plot_view(plot: ReplayPlot, span: TimeSpan, roots: Sequence[str], legend: bool, rows: int) -> rrb.TimeSeriesView:
    """Return the view of a plot over a span.

    The viewer chooses the vertical axis if the span has none. `rows` is the number of plots in a column of the window.
    """
    axis = span.axes.get(plot.key)
    beyond = axis.beyond_text("") if axis is not None else ""
    shown = None if axis is None else rrb.archetypes.ScalarAxis(range=with_scale(axis.low, axis.high, 33 // rows))
    return rrb.TimeSeriesView(
        name=f"{plot.heading}{f', {beyond}' if beyond else ''}",
        origin="/",
        contents=[*(f"+ /{root}/plots/{plot.key}/**" for root in roots), f"+ /{stream.limits_root(plot)}/**"],
        axis_x=time_axis(span.span_s),
        axis_y=shown,
        plot_legend=rrb.PlotLegend(span.corners.get(plot.key, rrb.Corner2D.RightTop), visible=legend),
    )


def with_scale(low: float, high: float, most: int) -> tuple[float, float]:
    """Return the range from `low` to `high`, extended such that its axis shows at least two numbers.

    The viewer writes the multiples of the smallest power of ten of which at most `most` fit. It cuts numbers near the
    edge.
    """
    step = 10.0 ** math.ceil(math.log10((high - low) / most))
    edge = 0.04 * step  # a number exactly at the edge is not written
    while (last := math.floor(high / step)) <= (first := math.ceil(low / step)):
        down, up = (first - 1) * step - edge, (last + 1) * step + edge
        low, high = (low, up) if up - high < low - down else (down, high)
    room = _WHOLE * (high - low)
    return min(low, first * step - room), max(high, last * step + room)


def prefix_of(flight: ReplayFlight, *, many: bool) -> str:
    """Return the prefix of the names of a flight's curves, which identifies it among several, or "" for a single
    flight.
    """
    return f"{flight.label}{', FAILED' if flight.verdict == 'failed' else ''}: " if many else ""


def legend_of(tab: Tab, plot: ReplayPlot, count: int) -> Literal["curves", "flights", ""]:
    """Return the content of a plot's legend for `count` flights: its curves, the flights, or "" for no legend.

    A legend of all curves of several flights may cover the plot. It then names the flights, whose curves differ in
    width.
    """
    most = max(_LEGEND_LINES, count * min(len(p.curves) for p in tab.plots)) if count > 1 else 99
    if count > _LEGEND_MOST or (count == 1 and len(plot.curves) == 1 and not plot.limits):  # the title says it
        return ""
    if count * len(plot.curves) <= most:
        return "curves"
    return "flights" if len(plot.curves) <= len(stream.WIDTHS) else ""


def rows_and_columns(tab: Tab) -> tuple[int, int]:
    """Return the numbers of rows and columns of a tab's plots. Two columns leave height for the numbers at the axes."""
    columns = 2 if len(tab.plots) > 2 else 1
    return -(-len(tab.plots) // columns), columns


def free_corner(
    plot: ReplayPlot,
    axis: PlotAxis,
    span_s: tuple[float, float],
    flights: Sequence[ReplayFlight],
    rows: int,
    by_width: bool = False,
) -> rrb.Corner2D:
    """Return the corner of a plot in which its legend hides the fewest points of the curves.

    `rows` is the number of plots in a column. If the curves differ `by_width`, the legend contains each flight once,
    and the order of the widths.
    """
    if by_width:
        names = [prefix_of(f, many=True) for f in flights] + [stream.width_text(plot)]
    else:
        names = [prefix_of(f, many=len(flights) > 1) + c.label for f in flights for c in plot.curves]
    names += [f"limit: {text}" for text in {limit.text for limit in axis.drawn}]
    wide = min((40.0 + 7.5 * max(map(len, names))) / _PLOT_PX[0], 0.9)  # sizes of the legend as shares of the plot
    tall = min((16.0 + 23.0 * len(names)) * rows / _PLOT_PX[1], 0.9)
    inside = dict.fromkeys(_CORNERS, 0.0)
    for flight in flights:
        for curve in (c for c in plot.curves if c.channel in flight.log):
            ns, values = curve.values(flight.log)
            first, end = np.searchsorted(ns, [round(s * 1e9) for s in span_s])
            some = slice(int(first), int(end), max(len(ns) // 3000, 1))
            x = (ns[some] / 1e9 - span_s[0]) / max(span_s[1] - span_s[0], 1e-9)
            y = (values[some] - axis.low) / (axis.high - axis.low)
            for corner, (right, top) in _CORNERS.items():
                there = (x > 1.0 - wide if right else x < wide) & (y > 1.0 - tall if top else y < tall)
                inside[corner] += float(there.mean()) if len(x) else 0.0
    return min(inside, key=lambda corner: inside[corner])


def time_axis(span_s: tuple[float, float]) -> rrb.archetypes.TimeAxis:
    """Return a time axis. If `span_s` has no length, the axis extends from there to the cursor."""
    start, end = (rr.TimeRangeBoundary.absolute(seconds=s) for s in span_s)
    if span_s[1] <= span_s[0]:
        end = rr.TimeRangeBoundary.cursor_relative()
    return rrb.archetypes.TimeAxis(view_range=rr.TimeRange(start=start, end=end))


def close_view(root: str, eyes: Eyes, name: str) -> rrb.Spatial3DView:
    """Return a view from a camera that follows a vehicle, while the ground moves away below it."""
    return rrb.Spatial3DView(
        name=name,
        origin=f"{root}/vehicle",
        contents=["+ $origin/**", f"- /{root}/vehicle/at", "+ /ground/grid", "+ /ground/pad/**"],
        background=_NIGHT,
        line_grid=False,
        eye_controls=rrb.EyeControls3D(position=eyes.close, look_target=(0, 0, 0), eye_up=(0, 0, 1)),
    )


def overview(roots: Sequence[str], eyes: Eyes, grid: str) -> rrb.Spatial3DView:
    """Return a view of the whole trajectories from the side, with a trail along the part flown so far."""
    contents = ["+ /ground/**", "- /ground/pad/**"]
    for root in roots:
        contents += [f"+ /{root}/{part}" for part in ("path", "trail", "marks", "vehicle/at")]
    so_far = rrb.VisibleTimeRange(
        stream.TIMELINE, start=rrb.TimeRangeBoundary.infinite(), end=rrb.TimeRangeBoundary.cursor_relative()
    )
    trails: Any = {f"/{root}/trail": rrb.VisibleTimeRanges([so_far]) for root in roots}
    return rrb.Spatial3DView(
        name=f"Trajectory (grid {grid})",
        origin="/",
        contents=contents,
        background=_DEEP,
        line_grid=False,
        overrides=trails,
        eye_controls=rrb.EyeControls3D(position=eyes.overview, look_target=eyes.aim, eye_up=(0, 0, 1)),
    )


def _tab_number(tabs: Sequence[Tab], wanted: str | None) -> int:
    """Return the index of the front tab. Raises ReplayError for a name that no tab has."""
    names = [tab.name.lower() for tab in tabs]
    if wanted is None:
        return 0
    if wanted.lower() not in names:
        raise ReplayError(f"--tab {wanted}: there is no such tab; there are {', '.join(tab.name for tab in tabs)}")
    return names.index(wanted.lower())


def layout(
    roots: Sequence[str],
    pictures: Sequence[rrb.View | rrb.Container],
    tabs: Sequence[Tab],
    spans: Sequence[TimeSpan],
    *,
    plotted: Sequence[str] | None = None,
    live: bool = False,
    tab: str | None = None,
    bare: bool = False,
    front: int = 0,
) -> rrb.Blueprint:
    """Return the layout of the window: pictures, plots in tabs, phases, current values, events, and a page about the
    flights.

    `pictures` (close-up, overview) may be empty. `plotted` are the roots of the plotted entities, by default those of
    the flights. `front` is the index of the span whose plots are in front.
    """
    plotted = roots if plotted is None else plotted

    def tabs_over(span: TimeSpan) -> rrb.Tabs:
        pages = []
        for page in tabs:
            rows, columns = rows_and_columns(page)
            views = [plot_view(p, span, plotted, legend_of(page, p, len(roots)) != "", rows) for p in page.plots]
            pages.append(rrb.Grid(contents=views, grid_columns=columns, name=page.name))
        return rrb.Tabs(contents=pages, active_tab=_tab_number(tabs, tab), name=span.name or None)

    plots = tabs_over(spans[0])
    if len(spans) > 1:
        plots = rrb.Tabs(contents=[tabs_over(span) for span in spans], active_tab=front)
    phased = roots[:_PHASED]
    phases = rrb.StateTimelineView(
        name="Phases",
        origin="/",
        contents=[f"+ /{root}/phase" for root in phased],
        time_view=time_axis(spans[-1].span_s),
    )
    events = rrb.TextDocumentView(name="Events", origin="events")
    now = rrb.TextDocumentView(name="Now", origin="now")
    about = rrb.TextDocumentView(name="About", origin="about")
    columns = [
        rrb.Vertical(contents=[plots, phases], row_shares=[9, 0.6 + 0.45 * len(phased)]),
        rrb.Vertical(contents=[now, events, about], row_shares=[2, 2, 3]),
    ]
    shares = [5.8, 3.0]
    if pictures:
        columns.insert(0, rrb.Vertical(contents=list(pictures), row_shares=[3, 2][: len(pictures)]))
        shares.insert(0, 4)
    content = rrb.Horizontal(contents=columns, column_shares=shares)
    return window(content, stream.TIMELINE, "following" if live else "paused", bare=bare)


def window(
    content: rrb.Container,
    timeline: str,
    play_state: Literal["following", "paused"] | None = None,
    *,
    bare: bool = False,
) -> rrb.Blueprint:
    """Return a layout of this content with only the time panel. `bare` also removes the viewer's menu."""
    return rrb.Blueprint(
        *([rrb.TopPanel(state="hidden")] if bare else []),
        content,
        rrb.TimePanel(timeline=timeline, state="collapsed", play_state=play_state, playback_speed=1.0),
        rrb.BlueprintPanel(state="hidden"),
        rrb.SelectionPanel(state="hidden"),
        auto_views=False,
        auto_layout=False,
    )
