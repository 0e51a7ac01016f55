"""From flights to a recording: everything that the viewer shows, and how it is laid out."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from maxq.control.kernel.records import Array
from maxq.sim.packing.environment import pack_earth
from maxq.tools.plots.palette import BLUE, GREY, ORANGE, PURPLE, SKY, VERDICT, rgba
from maxq.tools.replay.about import about_flight, about_flights, factors_text
from maxq.tools.replay.bent_body import LARGEST, bent_line, modal_coordinates, nice_factor
from maxq.tools.replay.blueprint import close_view, eyes_for, layout
from maxq.tools.replay.collect import FEW, closest, is_nominal
from maxq.tools.replay.earth_frame import LaunchSite, Path3D, first_place, has_motion, launch_site, path_of
from maxq.tools.replay.family import FROM as FAMILY_FROM
from maxq.tools.replay.family import ROOT as FAMILY_ROOT
from maxq.tools.replay.family import Family
from maxq.tools.replay.flight import Channels, ReplayFlight, launch_of
from maxq.tools.replay.ground import ground, tail_below_cg
from maxq.tools.replay.phases import COLOURS, Phase, first_phase, phases
from maxq.tools.replay.plot_stream import Axis, Style, axis_of, send_curves, send_limits, send_styles, value_range
from maxq.tools.replay.plots import Tab, tabs_of
from maxq.tools.replay.scene import Exaggeration, Scene
from maxq.tools.replay.sending import APPLICATION, every
from maxq.tools.replay.vehicle_shape import VehicleShape, shape_of

DEFAULT_RATE_HZ, MANY_RATE_HZ = 50.0, 10.0
_STEEPEST_DEG = 25.0  # how far the automatic factor lets a surface tilt
_NOMINAL_COLOUR = PURPLE


@dataclass(frozen=True)
class Options:
    """What a person may choose. None: chosen by what the flights hold."""

    rate_hz: float | None = None
    bend_factor: float | None = None
    slosh_factor: float | None = None
    side_by_side: bool = False
    tab: str | None = None


def save(flights: Sequence[ReplayFlight], options: Options, path: Path) -> None:
    """Write an .rrd file that opens by itself in any viewer of this version."""
    recording = rr.RecordingStream(APPLICATION, recording_id=_recording_id(flights))
    with recording:
        recording.save(path)
        blueprint = send_flights(recording, flights, options)
        recording.send_blueprint(blueprint, make_active=True, make_default=True)
        recording.flush()
        recording.disconnect()


def _recording_id(flights: Sequence[ReplayFlight]) -> str:
    return ", ".join(flight.label for flight in flights[:3]) + (" ..." if len(flights) > 3 else "")


def send_flights(recording: rr.RecordingStream, flights: Sequence[ReplayFlight], options: Options) -> rrb.Blueprint:
    """Send everything; returns the layout."""
    many = len(flights) > 1
    rate_hz = options.rate_hz or (MANY_RATE_HZ if len(flights) > FEW else DEFAULT_RATE_HZ)
    interval_ns = round(1e9 / rate_hz)
    roots = _roots(flights)
    near = closest(flights)
    scenarios = [s for s in (flights[i].scenario for i in sorted(near)) if s is not None]
    first = flights[0]
    shape = shape_of(scenarios[0].vehicle) if scenarios else None
    tabs = tabs_of(first.log.table, scenarios[0] if scenarios else None, shape)
    span = min(f.span_s[0] for f in flights), max(f.span_s[1] for f in flights)
    recording.log("/", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)

    ranges: dict[str, list[tuple[float, float]]] = {}
    drawn: list[tuple[str, ReplayFlight, Path3D, LaunchSite, VehicleShape | None]] = []
    exaggeration = common_exaggeration([flights[i] for i in sorted(near)], options)
    family = Family(span, interval_ns) if len(flights) - len(near) >= FAMILY_FROM else None
    plotted = [FAMILY_ROOT] if family is not None else []
    for i, (root, flight) in enumerate(zip(roots, flights, strict=True)):
        colour = _colour(flight, flights) if many else None
        style = Style(colour, f"{flight.label}: " if many else "", alpha=1.0 if len(flights) <= FEW else 0.55)
        own = tabs if not many else _own_tabs(tabs, flight, i in near)
        if family is not None and i not in near:
            family.add(flight.label, colour or GREY, own, flight.log)
        else:
            plotted.append(root)
            send_styles(recording, root, own, style)
            send_curves(recording, root, own, flight.log, interval_ns)
        for tab in own:
            for plot in tab.plots:
                if (found := value_range(plot, flight.log)) is not None:
                    ranges.setdefault(plot.key, []).append(found)
        _send_events(recording, root, flight)
        if not has_motion(flight.log):
            continue
        place = place_of(flight)
        scenario = flight.scenario if i in near else None
        with_vehicle = shape_of(scenario.vehicle) if scenario is not None else None
        trail = colour or ORANGE, colour or BLUE
        scene = Scene(recording, root, place, with_vehicle, exaggeration, trail=trail, near=i in near)
        scene.add(flight.log)
        path = path_of(flight.log, place.frames(flight.log.table, 100_000_000))
        scene.whole_path(path, colour or GREY)
        if not many:
            scene.mark(flight.moments, path)
        drawn.append((root, flight, path, place, with_vehicle))

    if family is not None:
        family.send(recording)
    axes = {plot.key: axis_of(plot, _union(ranges.get(plot.key, []))) for tab in tabs for plot in tab.plots}
    for tab in tabs:
        for plot in tab.plots:
            send_limits(recording, plot, axes[plot.key], (round(span[0] * 1e9), round(span[1] * 1e9)))
    text = (
        about_flights(flights, exaggeration if drawn else None)
        if many
        else about_flight(first, exaggeration if drawn else None, drawn[0][3] if drawn else None)
    )
    recording.log("about", rr.TextDocument(text, media_type="text/markdown"), static=True)
    return _layout(recording, roots, plotted, drawn, tabs, axes, span, exaggeration, options)


def _layout(
    recording: rr.RecordingStream,
    roots: Sequence[str],
    plotted: Sequence[str],
    drawn: Sequence[tuple[str, ReplayFlight, Path3D, LaunchSite, VehicleShape | None]],
    tabs: Sequence[Tab],
    axes: dict[str, Axis],
    span: tuple[float, float],
    exaggeration: Exaggeration,
    options: Options,
) -> rrb.Blueprint:
    if not drawn:
        return layout(roots, [], None, tabs, axes, span, plotted=plotted, tab=options.tab)
    positions = np.concatenate([path.position_m for _, _, path, _, _ in drawn])
    _, flight, _, place, shape = drawn[0]
    reach = float(np.abs(positions[:, :2]).max(initial=0.0))
    length = shape.length_m if shape is not None else 10.0
    grid = ground(recording, place, max(reach, 100.0), tail_below_cg(flight.log, shape))
    eyes = eyes_for(length, place.site.azimuth_deg, positions)
    factor = factors_text(exaggeration, flight.log.table) if shape else ""
    close: list[rrb.Spatial3DView] = []
    for root, its, _, _, its_shape in drawn:
        if its_shape is None and (close or len(drawn) > FEW):
            continue
        name = "Vehicle" if len(drawn) == 1 else its.label
        close.append(close_view(root, eyes, f"{name} ({factor})" if factor and len(drawn) < 3 else name))
    return layout(
        roots, close, eyes, tabs, axes, span,
        plotted=plotted, grid=grid, side_by_side=options.side_by_side, tab=options.tab,
    )  # fmt: skip


def _roots(flights: Sequence[ReplayFlight]) -> list[str]:
    """An entity root for each flight, unlike the others."""
    if len(flights) == 1:
        return ["flight"]
    out: list[str] = []
    for flight in flights:
        name = "flights/" + (re.sub(r"[^A-Za-z0-9_.-]+", "-", flight.label).strip("-.") or "flight")
        out.append(name if name not in out else f"{name}-{len(out) + 1}")
    return out


def _colour(flight: ReplayFlight, flights: Sequence[ReplayFlight]) -> str:
    return _NOMINAL_COLOUR if is_nominal(flight) and len(flights) > 1 else VERDICT.get(flight.verdict, SKY)


def _own_tabs(tabs: Sequence[Tab], flight: ReplayFlight, near: bool) -> Sequence[Tab]:
    """The tabs with those curves only that this flight has; those computed by its vehicle only of a near one."""
    scenario = flight.scenario if near else None
    own = {plot.key: plot for tab in tabs_of(flight.log.table, scenario) for plot in tab.plots}
    return [Tab(tab.name, tuple(own[plot.key] for plot in tab.plots if plot.key in own)) for tab in tabs]


def _union(ranges: Sequence[tuple[float, float]]) -> tuple[float, float] | None:
    return (min(a for a, _ in ranges), max(b for _, b in ranges)) if ranges else None


def place_of(flight: ReplayFlight) -> LaunchSite:
    """The launch site's frame."""
    earth, site = launch_of(flight.log)
    return launch_site(pack_earth(earth), site, first_place(flight.log))


def common_exaggeration(flights: Sequence[ReplayFlight], options: Options) -> Exaggeration:
    """The factors that suit all of the flights whose vehicles are drawn, so that they can be compared."""
    shapes = [shape_of(f.scenario.vehicle) if f.scenario is not None else None for f in flights]
    each = [exaggeration_of(f, shape, options) for f, shape in zip(flights, shapes, strict=True)]
    return Exaggeration(min(e.bending for e in each), min(e.slosh for e in each), max(e.most_m for e in each))


def exaggeration_of(flight: ReplayFlight, shape: VehicleShape | None, options: Options) -> Exaggeration:
    """Factors as asked for, or so that the largest deflection and tilt of the flight can be seen."""
    diameter = shape.diameter_m if shape is not None else 1.0
    bend, slosh = options.bend_factor, options.slosh_factor
    if bend is None:
        bend = nice_factor(_largest_bending_m(flight.log, shape), LARGEST * diameter)
    if slosh is None:
        slosh = min(nice_factor(_largest_slosh_deg(flight.log), _STEEPEST_DEG), 10.0)
    return Exaggeration(bend, slosh, 1.5 * diameter)


def _largest_bending_m(channels: Channels, shape: VehicleShape | None) -> float:
    """Over all stations, at 100 Hz."""
    if shape is None or ("eta_pitch_1_m" not in channels and "eta_yaw_1_m" not in channels):
        return 0.0
    name = next(n for n in ("eta_pitch_1_m", "eta_yaw_1_m") if n in channels)
    ns = channels.time_ns(name)
    k = every(ns, 10_000_000)
    stage = shape.stages[0]
    clock = ns[k] / 1e9 * stage.clock_factor
    eta = [modal_coordinates(channels, plane, k) for plane in ("pitch", "yaw")]
    bent: Array = bent_line(stage, clock, eta[0], eta[1], shape.joints(0)[::3])
    return float(np.abs(bent).max(initial=0.0))


def _largest_slosh_deg(channels: Channels) -> float:
    """The largest pendulum angle under thrust: without it a pendulum hangs anywhere."""
    largest = 0.0
    for topic in channels.table.topics:
        for channel in topic.channels:
            if channel.name.startswith("slosh_") and channel.name.endswith(("_pitch_deg", "_yaw_deg")):
                values = np.abs(channels[channel.name])
                if "thrust_N" in channels and len(channels["thrust_N"]):
                    burning_until = channels.time_ns("thrust_N")[channels["thrust_N"] > 0.0]
                    if len(burning_until):
                        values = values[channels.time_ns(channel.name) <= burning_until[-1]]
                largest = max(largest, float(np.nanmax(values, initial=0.0)))
    return largest


def _send_events(recording: rr.RecordingStream, root: str, flight: ReplayFlight) -> None:
    levels = {1: "DEBUG", 2: "INFO", 3: "WARN", 4: "ERROR", 5: "CRITICAL"}
    for moment in flight.moments:
        recording.set_time("sim_time", duration=np.timedelta64(moment.time_ns, "ns"))
        text = f"{moment.time_s:9.3f} s  {moment.text}"
        recording.log(f"{root}/events", rr.TextLog(text, level=levels[int(moment.level)]))
    recording.reset_time()
    start = first_phase(flight.log, round(flight.span_s[0] * 1e9))
    send_phases(recording, root, phases(start, flight.moments), styled=True)


def send_phases(recording: rr.RecordingStream, root: str, some: Sequence[Phase], *, styled: bool) -> None:
    """Phases as a band of colours."""
    if styled:
        names = list(COLOURS)
        colours = [rgba(colour) for colour in COLOURS.values()]
        config = rr.StateConfiguration(values=names, labels=names, colors=colours)
        recording.log(f"{root}/phase", config, static=True)
    for phase in some:
        recording.set_time("sim_time", duration=np.timedelta64(phase.start_ns, "ns"))
        recording.log(f"{root}/phase", rr.StateChange(state=phase.name))
    recording.reset_time()
