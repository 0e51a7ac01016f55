"""The layout of the viewer: close-up, overview, plots in tabs, phases, events, and a page about the flight."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from rerun.blueprint.encodings import TextLogColumn, TextLogColumnKind

from maxq.control.kernel.records import Array
from maxq.tools.replay.plots import Axis, Plot, Tab
from maxq.tools.replay.stream import TIMELINE, limits_root
from maxq.tools.replay.viewer import ReplayError

_NIGHT, _DEEP = [24, 29, 38, 255], [13, 17, 24, 255]
_LEGEND_MOST = 3  # names of more flights would cover the plot


@dataclass(frozen=True)
class Eyes:
    """Where the cameras stand: offset of the close-up from the vehicle; place and aim of the overview, m."""

    close: tuple[float, float, float]
    overview: tuple[float, float, float]
    aim: tuple[float, float, float]


def eyes_for(length_m: float, azimuth_deg: float, positions_m: Array) -> Eyes:
    """Cameras that look across the plane of flight, from the right, a little from above."""
    a = np.radians(azimuth_deg)
    forward, right = np.array([np.sin(a), np.cos(a), 0.0]), np.array([np.cos(a), -np.sin(a), 0.0])
    close = 1.5 * length_m * (0.93 * right - 0.3 * forward) + np.array([0.0, 0.0, 0.35 * length_m])
    low, high = positions_m.min(axis=0), positions_m.max(axis=0)
    middle, wide, tall = 0.5 * (low + high), float(np.linalg.norm((high - low)[:2])), float((high - low)[2])
    away = max(0.72 * wide, 1.3 * tall, 8.0 * length_m)  # the view is twice as wide as high
    far = middle + away * (right - 0.25 * forward) + np.array([0.0, 0.0, 0.3 * away])
    return Eyes(*((float(x), float(y), float(z)) for x, y, z in (close, far, middle)))


def plot_view(
    plot: Plot, axis: Axis | None, roots: Sequence[str], span_s: tuple[float, float], legend: bool
) -> rrb.TimeSeriesView:
    """`axis`: None where the values are not known yet."""
    beyond = axis.beyond_text(plot.unit) if axis is not None else ""
    return rrb.TimeSeriesView(
        name=f"{plot.heading}{f' - {beyond}' if beyond else ''}",
        origin="/",
        contents=[*(f"+ /{root}/plots/{plot.key}/**" for root in roots), f"+ /{limits_root(plot)}/**"],
        axis_x=time_axis(span_s),
        axis_y=rrb.archetypes.ScalarAxis(range=(axis.low, axis.high)) if axis is not None else None,
        plot_legend=rrb.PlotLegend(rrb.Corner2D.RightTop, visible=legend),
    )


def time_axis(span_s: tuple[float, float]) -> rrb.archetypes.TimeAxis:
    """`span_s` of no length: from there to the cursor."""
    start, end = (rr.TimeRangeBoundary.absolute(seconds=s) for s in span_s)
    if span_s[1] <= span_s[0]:
        end = rr.TimeRangeBoundary.cursor_relative()
    return rrb.archetypes.TimeAxis(view_range=rr.TimeRange(start=start, end=end))


def close_view(root: str, eyes: Eyes, name: str) -> rrb.Spatial3DView:
    """A camera that follows one vehicle; the ground moves away below it."""
    return rrb.Spatial3DView(
        name=name,
        origin=f"{root}/vehicle",
        contents=["+ $origin/**", f"- /{root}/vehicle/at", "+ /ground/grid", "+ /ground/pad/**"],
        background=_NIGHT,
        line_grid=False,
        eye_controls=rrb.EyeControls3D(position=eyes.close, look_target=(0, 0, 0), eye_up=(0, 0, 1)),
    )


def overview(roots: Sequence[str], eyes: Eyes, grid: str) -> rrb.Spatial3DView:
    """The whole trajectory from aside; a trail shows everything flown so far."""
    contents = ["+ /ground/**", "- /ground/pad/**"]
    for root in roots:
        contents += [f"+ /{root}/{part}" for part in ("path", "trail", "marks", "vehicle/at")]
    so_far = rrb.VisibleTimeRange(
        TIMELINE, start=rrb.TimeRangeBoundary.infinite(), end=rrb.TimeRangeBoundary.cursor_relative()
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
    """Which tab is in front. Raises ReplayError for a name that none has."""
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
    axes: Mapping[str, Axis],
    span_s: tuple[float, float],
    *,
    plotted: Sequence[str] | None = None,
    live: bool = False,
    tab: str | None = None,
) -> rrb.Blueprint:
    """The whole window: `pictures` (close-up, overview) if there are any, plots in tabs, phases, events, a page.

    `plotted`: roots of what is plotted, where they are not those of the flights.
    """
    legend = len(roots) <= _LEGEND_MOST
    plotted = roots if plotted is None else plotted
    plots = rrb.Tabs(
        contents=[
            rrb.Vertical(
                contents=[plot_view(plot, axes.get(plot.key), plotted, span_s, legend) for plot in tab.plots],
                name=tab.name,
            )
            for tab in tabs
        ],
        active_tab=_tab_number(tabs, tab),
    )
    phases = rrb.StateTimelineView(
        name="Phases", origin="/", contents=[f"+ /{root}/phase" for root in roots[:6]], time_view=time_axis(span_s)
    )
    shown = [TextLogColumn(TextLogColumnKind.LogLevel), TextLogColumn(TextLogColumnKind.Body)]
    if len(roots) > 1:
        shown.insert(0, TextLogColumn(TextLogColumnKind.EntityPath))
    events = rrb.TextLogView(
        name="Events",
        origin="/",
        contents=[f"+ /{root}/events" for root in roots],
        columns=rrb.archetypes.TextLogColumns(timeline_columns=[], text_log_columns=shown),
    )
    about = rrb.TextDocumentView(name="About", origin="about")
    columns = [
        rrb.Vertical(contents=[plots, phases], row_shares=[6, 1]),
        rrb.Vertical(contents=[events, about], row_shares=[2, 3]),
    ]
    shares = [5, 2.4]
    if pictures:
        columns.insert(0, rrb.Vertical(contents=list(pictures), row_shares=[3, 2][: len(pictures)]))
        shares.insert(0, 5)
    content = rrb.Horizontal(contents=columns, column_shares=shares)
    return window(content, TIMELINE, "following" if live else "paused")


def window(
    content: rrb.Container, timeline: str, play_state: Literal["following", "paused"] | None = None
) -> rrb.Blueprint:
    """A window with this content and nothing around it but the time."""
    return rrb.Blueprint(
        content,
        rrb.TimePanel(timeline=timeline, state="collapsed", play_state=play_state, playback_speed=1.0),
        rrb.BlueprintPanel(state="hidden"),
        rrb.SelectionPanel(state="hidden"),
        auto_views=False,
        auto_layout=False,
    )
