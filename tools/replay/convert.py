"""From flights to a recording: everything that the viewer shows, and how it is laid out."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from maxq.sim.log.foxglove import FramePath
from maxq.tools.plots.palette import BLUE, ORANGE, PURPLE, VERDICT
from maxq.tools.replay.blueprint import close_view, eyes_for, layout, overview
from maxq.tools.replay.flight import FEW, ReplayFlight, closest
from maxq.tools.replay.launch_site import LaunchSite, has_motion, path_of, place_of
from maxq.tools.replay.plots import axis_of, own_tabs, range_of, tabs_of
from maxq.tools.replay.scene import FAR_NS, Scene, send_ground, tail_below_cg
from maxq.tools.replay.stream import (
    APPLICATION,
    FAMILY,
    FAMILY_FROM,
    Family,
    first_phase,
    phases,
    send_curves,
    send_events,
    send_limits,
    send_phases,
    send_styles,
)
from maxq.tools.replay.text import about, drawn_text
from maxq.tools.replay.vehicle_shape import Exaggeration, VehicleShape, exaggeration_of, shape_of

DEFAULT_RATE_HZ, MANY_RATE_HZ = 50.0, 10.0
_NOMINAL_COLOUR = PURPLE


@dataclass(frozen=True)
class Options:
    """Options of `simreplay`. None: a value that suits the flights."""

    rate_hz: float | None = None
    bend_factor: float | None = None
    slosh_factor: float | None = None
    side_by_side: bool = False
    tab: str | None = None


@dataclass(frozen=True)
class _Drawn:
    """A flight that was sent to the three-dimensional views."""

    root: str
    flight: ReplayFlight
    path: FramePath
    place: LaunchSite
    shape: VehicleShape | None


def save(flights: Sequence[ReplayFlight], options: Options, path: Path) -> None:
    """Write an .rrd file that opens by itself in any viewer of this version."""
    name = ", ".join(flight.label for flight in flights[:3]) + (" ..." if len(flights) > 3 else "")
    recording = rr.RecordingStream(APPLICATION, recording_id=name)
    with recording:
        recording.save(path)
        blueprint = send_flights(recording, flights, options)
        recording.send_blueprint(blueprint, make_active=True, make_default=True)
        recording.flush()
        recording.disconnect()


def send_flights(recording: rr.RecordingStream, flights: Sequence[ReplayFlight], options: Options) -> rrb.Blueprint:
    """Send everything; returns the layout."""
    many = len(flights) > 1
    interval_ns = round(1e9 / (options.rate_hz or (MANY_RATE_HZ if len(flights) > FEW else DEFAULT_RATE_HZ)))
    near = closest(flights)
    scenario = next((s for i in sorted(near) if (s := flights[i].scenario) is not None), None)
    tabs = tabs_of(flights[0].log.table, scenario)
    span_s = min(f.span_s[0] for f in flights), max(f.span_s[1] for f in flights)
    recording.log("/", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)

    ranges: dict[str, list[tuple[float, float]]] = {}
    drawn: list[_Drawn] = []
    exaggeration = common_exaggeration([flights[i] for i in sorted(near)], options)
    family = Family(span_s, interval_ns) if len(flights) - len(near) >= FAMILY_FROM else None
    roots = _roots(flights)
    plotted = [FAMILY] if family is not None else []
    for i, (root, flight) in enumerate(zip(roots, flights, strict=True)):
        colour = (_NOMINAL_COLOUR if flight.is_nominal else VERDICT[flight.verdict]) if many else None
        own = own_tabs(tabs, flight.log.table, flight.scenario if i in near else None) if many else tabs
        if family is not None and colour is not None and i not in near:
            family.add(flight.label, colour, own, flight.log)
        else:
            plotted.append(root)
            prefix = f"{flight.label}: " if many else ""
            send_styles(recording, root, own, colour, prefix, alpha=1.0 if len(flights) <= FEW else 0.55)
            send_curves(recording, root, own, flight.log, interval_ns)
        for plot in (plot for tab in own for plot in tab.plots):
            if (found := plot.value_range(flight.log)) is not None:
                ranges.setdefault(plot.key, []).append(found)
        send_events(recording, root, flight.moments)
        start = first_phase(flight.log, round(flight.span_s[0] * 1e9))
        send_phases(recording, root, phases(start, flight.moments), styled=True)
        if has_motion(flight.log):
            drawn.append(_send_scene(recording, root, flight, exaggeration, colour, near=i in near))

    if family is not None:
        family.send(recording)
    axes = {}
    for plot in (plot for tab in tabs for plot in tab.plots):
        axis = axes[plot.key] = axis_of(plot, range_of([np.array(r) for r in ranges.get(plot.key, [])]))
        send_limits(recording, plot, axis.drawn, (round(span_s[0] * 1e9), round(span_s[1] * 1e9)), axis)
    text = about(flights, drawn_text(exaggeration, None if many else drawn[0].place) if drawn else [])
    recording.log("about", rr.TextDocument(text, media_type="text/markdown"), static=True)
    pictures = _pictures(recording, roots, drawn, exaggeration, options.side_by_side) if drawn else []
    return layout(roots, pictures, tabs, axes, span_s, plotted=plotted, tab=options.tab)


def _send_scene(
    recording: rr.RecordingStream,
    root: str,
    flight: ReplayFlight,
    exaggeration: Exaggeration,
    colour: str | None,
    *,
    near: bool,
) -> _Drawn:
    """Vehicle and trajectory; `colour`: of one flight among others."""
    place = place_of(flight)
    scenario = flight.scenario if near else None
    shape = shape_of(scenario.vehicle) if scenario is not None else None
    trail = colour or ORANGE, colour or BLUE
    scene = Scene(recording, root, place, shape, exaggeration, trail=trail, near=near)
    scene.add(flight.log)
    path = path_of(flight.log, place.frames(flight.log.table, FAR_NS))
    if colour is not None:
        scene.whole_path(path, colour)
    else:
        scene.whole_path(path)
        scene.mark(flight.moments, path)
    return _Drawn(root, flight, path, place, shape)


def _pictures(
    recording: rr.RecordingStream, roots: Sequence[str], drawn: Sequence[_Drawn], ex: Exaggeration, side_by_side: bool
) -> list[rrb.View | rrb.Container]:
    """The views in three dimensions: vehicles from near by, and the trajectories from aside."""
    first = drawn[0]
    positions = np.concatenate([each.path.translation_m for each in drawn])
    reach = float(np.abs(positions[:, :2]).max(initial=0.0))
    length = first.shape.length_m if first.shape is not None else 10.0
    grid = send_ground(recording, first.place, max(reach, 100.0), tail_below_cg(first.flight.log, first.shape))
    eyes = eyes_for(length, first.place.site.azimuth_deg, positions)
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


def _roots(flights: Sequence[ReplayFlight]) -> list[str]:
    """An entity root for each flight, unlike the others."""
    if len(flights) == 1:
        return ["flight"]
    out: list[str] = []
    for flight in flights:
        name = "flights/" + (re.sub(r"[^A-Za-z0-9_.-]+", "-", flight.label).strip("-.") or "flight")
        out.append(name if name not in out else f"{name}-{len(out) + 1}")
    return out


def common_exaggeration(flights: Sequence[ReplayFlight], options: Options) -> Exaggeration:
    """The factors that suit all of the flights whose vehicles are drawn, so that they can be compared."""
    each = []
    for flight in flights:
        shape = shape_of(flight.scenario.vehicle) if flight.scenario is not None else None
        each.append(exaggeration_of(flight.log, shape, options.bend_factor, options.slosh_factor))
    return Exaggeration(min(e.bending for e in each), min(e.slosh for e in each), max(e.most_m for e in each))
