"""The standard set of plots for a review: a sheet for each subject, as SVG and PNG, with events, limits and units.

A single flight has lines in several colours. Of a few flights, each has a colour, and dashes distinguish channels. Many
flights have envelopes, with the nominal flight on top and failed flights in red.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.lines import Line2D
from scipy.signal import detrend, spectrogram

from maxq.control.kernel.records import Array, IntArray
from maxq.sim.vehicle.loads.section import LoadsSection
from maxq.tools.plots.palette import BLACK, BLUE, FAILED, GREEN, GREY, LIMIT, ON_LIGHT, RED, VERDICT, WHITE
from maxq.tools.plots.style import curve as look_of
from maxq.tools.plots.style import drawing, name_point, save, sheet
from maxq.tools.replay.decimate import extremes, extremes_on_grid
from maxq.tools.replay.flight import (
    ConversionWatch,
    ReplayFlight,
    ShownRequirement,
    has_motion,
    path_of,
    place_of,
    tightest_first,
)
from maxq.tools.replay.plots import AXES, PlotAxis, PlotLine, ReplayPlot, Tab, axis_of, range_of, tabs_of
from maxq.tools.replay.vehicle_shape import PLANES, borne, shape_of
from maxq.tools.replay.viewer import ReplayError

WIDTH_IN, ROW_IN = 8.0, 1.9
"""The width of a sheet, and the height of a plot in it."""
_SETTINGS = {"lines.linewidth": 1.1, "figure.dpi": 160, "svg.fonttype": "none"}  # text remains searchable
_LEGEND: dict[str, Any] = {  # in one row above the plot
    "loc": "lower right",
    "bbox_to_anchor": (1.0, 0.985),
    "ncols": 8,
    "borderaxespad": 0.0,
    "handlelength": 1.6,
    "columnspacing": 1.2,
    "frameon": False,
}
_TITLE_LINE_IN = 0.26
_ENVELOPE_FROM = 6  # number of flights from which an envelope replaces single lines
_BINS, _POINTS, _THIN_POINTS = 1500, 4000, 1500  # points along a sheet: of an envelope, of a line, of a line among many
_PATH_NS = 100_000_000
_WINDOW_S, _HIGHEST_HZ, _FLOOR_DB = 2.0, 60.0, -80.0
_SPECTRA = {f"gyro_{plane}_rate_degps": f"Gyro, {plane} rate" for plane in PLANES}
_SPECTRA |= {f"gimbal_{plane}_angle_deg": f"Gimbal, {plane}" for plane in PLANES}
_IN_PATH = ("max_q", "burnout", "apogee", "impact", "fault", "control_lost", "diverged", "tumble")
_EVENTS = (*_IN_PATH, "liftoff", "separation")
_MOST_USED = 3.0  # share of the limit at which a bar is cut
_SECTION_LOADS = (  # title, unit, and the columns of the limits with their signs
    ("Axial force", "kN", {"compression_N": -1.0, "tension_N": 1.0}),
    ("Shear", "kN", {"shear_N": 1.0}),
    ("Bending moment", "kN m", {"bending_moment_Nm": 1.0}),
    ("Equivalent axial load", "kN", {"equivalent_compression_N": -1.0, "equivalent_tension_N": 1.0}),
)


@dataclass(frozen=True)
class Flights:
    """The flights of a set of sheets. The events and thick lines are those of the `reference`: the nominal or first
    flight.
    """

    all: Sequence[ReplayFlight]
    reference: ReplayFlight

    @property
    def many(self) -> bool:
        return len(self.all) > 1

    @property
    def few(self) -> bool:
        """Return True if there are several flights, but few enough for separate colours."""
        return 1 < len(self.all) < _ENVELOPE_FROM

    def colour(self, flight: ReplayFlight) -> str:
        """Return the colour of a flight.

        The reference is black. Among few flights, failed flights have shades of red; among many, all flights have the
        colours of their verdicts.
        """
        others = [f for f in self.all if f is not self.reference]
        if flight is self.reference:
            return BLACK
        if not self.few:
            return VERDICT[flight.verdict]
        failed = [f for f in others if f.verdict == "failed"]
        if flight in failed:
            return FAILED[failed.index(flight)]
        good = [colour for colour in ON_LIGHT if colour != RED]
        return good[[f for f in others if f not in failed].index(flight)]

    def look(self, flight: ReplayFlight) -> dict[str, Any]:
        """Return the style of a flight's line in a plot with one line for each flight."""
        if not self.many:
            return {"color": BLUE, "linewidth": 1.4}
        if flight is self.reference:
            return {"color": BLACK, "linewidth": 1.2, "zorder": 3.0, "label": None if self.few else flight.label}
        return {"color": self.colour(flight), "linewidth": 0.9 if self.few else 0.6, "alpha": 0.8}


def write_sheets(
    flights: Sequence[ReplayFlight], folder: Path, only: str = "", watch: ConversionWatch = lambda *_: None
) -> list[Path]:
    """Draw all sheets into a folder, which is created, and return the paths of the files.

    `only` selects the tabs whose name contains it. Raises ReplayError if a file cannot be written.
    """
    shown = Flights(flights, next((f for f in flights if f.is_nominal), flights[0]))
    tabs = tabs_of(shown.reference.log.table, shown.reference.scenario)
    written: list[Path] = []
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with drawing(settings=_SETTINGS):
            for number, tab in enumerate(tabs, start=1):
                watch("drawing", number - 1, len(tabs) + 1)
                ranges = (plot.value_range(f.log) for plot in tab.plots for f in flights)
                if only in tab.name.lower() and any(found is not None for found in ranges):
                    written += save(_sheet(tab, shown), folder / f"{number:02}-{tab.name.lower()}")
            watch("drawing", len(tabs), len(tabs) + 1)
            for name, figure in special_sheets(shown) if not only else ():
                written += save(figure, folder / name)
    except OSError as error:
        at = error.filename or folder
        raise ReplayError(f"{at}: cannot be written: {(error.strerror or str(error)).lower()}") from error
    return written


def _sheet(tab: Tab, shown: Flights) -> Figure:
    if shown.many:
        how = "" if shown.few else f" (shaded: all, thick: {shown.reference.label}, thin red: failed)"
        about = f", {sum(f.verdict == 'failed' for f in shown.all)} failed{how}"
    else:
        about = f", {shown.reference.outcome} at {shown.reference.span_s[1]:.1f} s"
    span_s = _span(tab, shown)
    if span_s[1] < max(f.span_s[1] for f in shown.all):
        about += f"; shown to {span_s[1]:.1f} s"
    figure, places = _figure(tab.name, shown, len(tab.plots), about=about, sharex=True)
    for place, plot in zip(places, tab.plots, strict=True):
        _draw(place, plot, shown, span_s)
    places[0].set_xlim(span_s)
    places[-1].set_xlabel("time, s")
    figure.align_ylabels()
    _mark_events(places, shown.reference, span_s)
    for place in places:
        _part(figure, place)
    return figure


def _part(figure: Figure, place: Axes) -> None:
    """Raise a title that its legend, on the same line, would overlap."""
    legend = place.get_legend()
    if legend is None:
        return
    renderer = FigureCanvasAgg(figure).get_renderer()  # type: ignore[no-untyped-call]  # Matplotlib does not annotate it
    key, name = legend.get_window_extent(renderer), place._left_title.get_window_extent(renderer)  # type: ignore[attr-defined]  # no public way
    if key.width + name.width > 0.88 * figure.bbox.width:
        place.set_title(place.get_title("left"), pad=key.height * 72.0 / figure.dpi)


def _figure(
    name: str, shown: Flights, rows: int, columns: int = 1, height_in: float = ROW_IN, about: str = "", **more: Any
) -> tuple[Figure, Sequence[Axes]]:
    """Return an empty sheet. If there are a few flights, a line below its title shows their colours."""
    of = f"{len(shown.all)} flights" if shown.many else shown.reference.label
    figure, places = sheet(rows, columns, height_in, WIDTH_IN, f"{name}: {of}{about}", **more)
    if shown.few:
        named = [(f, f.label + (", FAILED" if f.verdict == "failed" else "")) for f in shown.all]
        handles = [Line2D([], [], color=shown.colour(f), linewidth=1.6, label=text) for f, text in named]
        below, layout = 1.0 - _TITLE_LINE_IN / figure.get_figheight(), figure.get_layout_engine()
        assert isinstance(layout, ConstrainedLayoutEngine)
        layout.set(rect=(0.0, 0.0, 1.0, below))
        place: Any = {"loc": "upper left", "bbox_to_anchor": (0.0, below), "borderaxespad": 0.0, "frameon": False}
        figure.legend(handles=handles, ncols=len(handles), **place).set_in_layout(False)
    return figure, places


def _span(tab: Tab, shown: Flights) -> tuple[float, float]:
    """Return the time span of a sheet: the whole flight for `Trajectory` and `Air`, else up to 1.12 times the last
    burnout.
    """
    start, end = min(f.span_s[0] for f in shown.all), max(f.span_s[1] for f in shown.all)
    burnouts = [m.time_s for f in shown.all if (m := f.moment("burnout")) is not None]
    if tab.name in ("Trajectory", "Air") or not burnouts:
        return start, end
    return start, min(end, max(burnouts) * 1.12)


def _draw(place: Axes, plot: ReplayPlot, shown: Flights, span_s: tuple[float, float]) -> None:
    values: list[Array] = []
    for number, curve in enumerate(plot.curves):
        values += _draw_curve(place, curve, number, shown, span_s)
    axis = axis_of(plot, range_of(values))
    place.set_ylim(axis.low, axis.high)
    _draw_limits(place, axis, plot.unit)
    beyond = axis.beyond_text(plot.unit)
    title = plot.title if plot.title[1:2] == " " else plot.title[:1].upper() + plot.title[1:]  # but "q alpha"
    place.set_title(title + (f" ({beyond})" if beyond else ""))
    place.set_ylabel(plot.unit)
    if len(plot.curves) > 1 or axis.drawn:
        place.legend(**_LEGEND).set_in_layout(False)  # a legend of many names does not compress the plot


def _draw_curve(place: Axes, curve: PlotLine, number: int, shown: Flights, span_s: tuple[float, float]) -> list[Array]:
    """Draw a curve of a few flights as lines, or of many flights as an envelope, and return the values of each flight.

    Over an envelope, the reference and the failed flights are drawn as lines.
    """
    span_ns = round(span_s[0] * 1e9), round(span_s[1] * 1e9) + 1
    look = look_of(number)
    envelopes, drawn = [], []

    def line(ns: IntArray, values: Array, points: int, **how: Any) -> None:
        kept = extremes(ns, values, max((span_ns[1] - span_ns[0]) // points, 1))
        place.plot(ns[kept] / 1e9, values[kept], **(look | how))

    for flight in shown.all:
        if curve.channel not in flight.log:
            continue
        ns, values = curve.values(flight.log)
        seen = slice(*np.searchsorted(ns, span_ns))
        ns, values = ns[seen], values[seen]
        drawn.append(values)
        if not shown.many:
            line(ns, values, _POINTS, label=curve.label)
        elif flight is shown.reference:
            colour = BLACK if number == 0 or shown.few else look["color"]
            line(ns, values, _POINTS, label=curve.label, color=colour, linewidth=1.0, zorder=3.0)
        elif shown.few or flight.verdict == "failed":
            line(ns, values, _THIN_POINTS, **shown.look(flight))
        if len(shown.all) >= _ENVELOPE_FROM:
            envelopes.append(envelope(ns, values, span_ns))
    if envelopes:
        middle_s = (span_ns[0] + (np.arange(_BINS) + 0.5) * (span_ns[1] - span_ns[0]) / _BINS) / 1e9
        low, high = np.fmin.reduce([e[0] for e in envelopes]), np.fmax.reduce([e[1] for e in envelopes])
        place.fill_between(middle_s, low, high, color=look["color"], alpha=0.25, linewidth=0, label="_")
    return drawn


def envelope(times_ns: IntArray, values: Array, span_ns: tuple[int, int], bins: int = _BINS) -> tuple[Array, Array]:
    """Return the smallest and largest value in each of `bins` intervals of a span, both (bins,).

    An interval without samples has the interpolated value.
    """
    width_ns = -((span_ns[0] - span_ns[1]) // bins)
    ends = extremes_on_grid(times_ns, values, span_ns[0], width_ns, bins).reshape(bins, 2)
    low, high = ends.min(axis=1), ends.max(axis=1)
    finite = np.isfinite(values)
    if finite.any() and np.isnan(low).any():
        middle_ns = span_ns[0] + (np.arange(bins) + 0.5) * width_ns
        between = np.interp(middle_ns, times_ns[finite], values[finite], left=np.nan, right=np.nan)
        low, high = (np.where(np.isnan(x), between, x) for x in (low, high))
    return low, high


def _draw_limits(place: Axes, axis: PlotAxis, unit: str) -> None:
    """Shade and hatch the range outside the limits, so that it is visible without colour."""
    first = {limit.text: limit for limit in reversed(axis.drawn)}
    for limit in axis.drawn:
        colour, hatch = (LIMIT, "////") if limit.required else (GREY, None)
        look: Any = {"facecolor": (colour, 0.10), "edgecolor": (colour, 0.45), "linewidth": 0.0, "hatch": hatch}
        place.axhspan(limit.value, axis.high if limit.upper else axis.low, zorder=0.5, **look)
        label = f"{limit.text} {unit}".rstrip() if first[limit.text] is limit else None
        place.axhline(limit.value, color=colour, linewidth=0.9, label=label, zorder=1.5)


def _mark_events(places: Sequence[Axes], flight: ReplayFlight, span_s: tuple[float, float]) -> None:
    """Draw vertical lines at the events through all plots, with their names in the first plot."""
    start, width = span_s[0], span_s[1] - span_s[0]
    named: list[float] = []
    low, high = places[0].get_ylim()
    drawn = [np.asarray(line.get_xydata()) for line in places[0].lines]
    curves = np.concatenate([np.zeros((0, 2)), *(points for points in drawn if len(points) > 2)])
    curves[:, 1] = (curves[:, 1] - low) / (high - low)
    for moment in sorted(flight.moments, key=lambda m: m.level, reverse=True):  # place the names of failures first
        if moment.name not in _EVENTS or not 0.0 <= moment.time_s - start <= width:
            continue
        for place in places:
            place.axvline(moment.time_s, color=GREY, linewidth=0.7, linestyle=(0, (2, 2)), zorder=1.0)
        if any(abs(moment.time_s - other) < 0.02 * width for other in named):
            continue
        named.append(moment.time_s)
        aside, align = (-2, "right") if moment.time_s > start + 0.97 * width else (2, "left")
        levels = curves[np.abs(curves[:, 0] - moment.time_s) < 0.02 * width, 1]
        bottom = min((0.52, 0.03, 0.28), key=lambda y: int(((levels > y) & (levels < y + 0.45)).sum()))  # least hidden
        at: Any = {"xycoords": ("data", "axes fraction"), "textcoords": "offset points", "ha": align, "va": "bottom"}
        look: Any = {"fontsize": 6.5, "color": "#555555", "rotation": 90, "zorder": 4.0}
        look["bbox"] = {"facecolor": "white", "alpha": 0.75, "linewidth": 0.0, "pad": 0.6}
        places[0].annotate(moment.label, (moment.time_s, bottom), (aside, 0), **at, **look)


# -- plots that are not over time ------------------------------------------------------------------------------------
def special_sheets(shown: Flights) -> Iterator[tuple[str, Figure]]:
    """Yield the file name and figure of each sheet that is not over time and for which the logs have channels."""
    reference, has = shown.reference, shown.reference.log
    if moving := [f for f in shown.all if has_motion(f.log)]:
        yield "10-path", _path(Flights(moving, reference))
    if all(name in has for name in ("altitude_m", "dynamic_pressure_Pa", "mach")):
        yield "11-altitude", _altitude(shown)
    if "error_pitch_deg" in has and "measured_pitch_rate_degps" in has:
        yield "12-phase-plane", _phase_plane(shown)
    spectra = [channel for channel in _SPECTRA if channel in has]
    if spectra and reference.burn_end_s - reference.span_s[0] > 4.0 * _WINDOW_S:
        yield "13-spectra", _spectra(spectra, reference)
    if judged := [f for f in shown.all if any(r.value is not None for r in f.requirements)]:
        yield "14-requirements", _requirements(Flights(judged, reference))
    if "section_1_axial_N" in has and reference.scenario is not None:
        for stage, loads in enumerate(s.loads for s in reference.scenario.vehicle.stage):
            if loads is not None:
                yield f"15-sections-{stage + 1}", _sections(shown, stage, loads)


def _path(shown: Flights) -> Figure:
    figure, (profile, above) = _figure("Path", shown, 2, 1, 3.05)
    for flight in shown.all:
        path = path_of(flight.log, place_of(flight).frames(flight.log.table, _PATH_NS))
        east, north = path.translation_m[:, 0] / 1000.0, path.translation_m[:, 1] / 1000.0
        altitude = np.interp(path.times_ns, flight.log.time_ns("altitude_m"), flight.log["altitude_m"]) / 1000.0
        along = np.hypot(east, north)
        look = shown.look(flight)
        profile.plot(along, altitude, **look)
        above.plot(east, north, **(look | {"label": None}))
        if not shown.many or flight.verdict == "failed":
            above.plot(east[-1:], north[-1:], "x", color=look["color"], markersize=5)
        if flight is not shown.reference:
            continue
        if "thrust_N" in flight.log and not shown.many:
            burning = np.interp(path.times_ns, flight.log.time_ns("thrust_N"), flight.log["thrust_N"]) > 0.0
            powered = np.where(burning, along, np.nan), np.where(burning, altitude, np.nan)
            profile.plot(*powered, color=RED, linewidth=2.6, label="under thrust")
        for moment in flight.moments:
            if moment.name in _IN_PATH:
                k = min(int(np.searchsorted(path.times_ns, moment.time_ns)), len(along) - 1)
                _point(profile, along[k], altitude[k], moment.label)
                _point(above, east[k], north[k], moment.name.replace("_", " "))
    profile.set(xlabel="horizontal distance from the site, km", ylabel="altitude, km", title="Profile")
    above.set(xlabel="east of the site, km", ylabel="north of the site, km", title="From above")
    above.set_aspect("equal", adjustable="datalim")
    above.plot([0], [0], "s", color=BLACK, markersize=4)
    if profile.get_legend_handles_labels()[0]:
        profile.legend(loc="lower center")
    return figure


def _point(place: Axes, x: float, y: float, text: str) -> None:
    place.plot([x], [y], "o", color=GREY, markersize=3.5, zorder=4)
    name_point(place, x, y, text, fontsize=7.5)


def _altitude(shown: Flights) -> Figure:
    figure, places = _figure("Over altitude, going up", shown, 1, 3, 3.7)
    for flight in shown.all:
        log = flight.log
        apogee = flight.moment("apogee")
        rising = slice(0, int(np.searchsorted(log.time_ns("altitude_m"), apogee.time_ns)) if apogee else None)
        height = log["altitude_m"][rising] / 1000.0
        look = shown.look(flight)
        places[0].plot(log["dynamic_pressure_Pa"][rising] / 1000.0, height, **look)
        places[1].plot(log["mach"][rising], height, **look)
        for k, axis in enumerate(("north", "east") if "wind_N_north_mps" in log else ()):
            own = look | {"linestyle": look_of(k)["linestyle"]} if shown.many else look_of(k)
            label = f"to {axis}" if flight is shown.reference else None
            places[2].plot(log[f"wind_N_{axis}_mps"][rising], height, **(own | {"label": label}))
    for place, label in zip(places, ("dynamic pressure, kPa", "Mach number", "wind, m/s"), strict=True):
        place.set(xlabel=label, ylabel="altitude, km")
    if places[2].get_legend_handles_labels()[0]:
        places[2].legend(loc="best")
    return figure


def _phase_plane(shown: Flights) -> Figure:
    figure, places = _figure("Phase planes under thrust", shown, 1, 3, 2.5)
    for place, axis in zip(places, AXES, strict=True):
        for flight in shown.all:
            end = int(np.searchsorted(flight.log.time_ns("error_pitch_deg"), flight.burn_end_s * 1e9))
            k = slice(0, end, max(1, end // 6000))
            error, rate = flight.log[f"error_{axis}_deg"][k], flight.log[f"body_{axis}_rate_degps"][k]
            place.plot(error, rate, **(shown.look(flight) | {"linewidth": 0.7}))
        place.set(xlabel=f"{axis} error, deg", ylabel=f"{axis} rate, deg/s", title=axis.capitalize())
        place.locator_params(axis="x", nbins=4)  # small angles have wide labels
        place.axhline(0.0, color=GREY, linewidth=0.6)
        place.axvline(0.0, color=GREY, linewidth=0.6)
    return figure


def _spectra(channels: Sequence[str], flight: ReplayFlight) -> Figure:
    """Draw the amplitude over time and frequency, in windows that overlap by 3/4. A sine of amplitude 1 has 0 dB."""
    figure, places = _figure("Spectra under thrust", Flights([flight], flight), len(channels))
    for place, channel in zip(places, channels, strict=True):
        time_s, values = flight.log.time_ns(channel) / 1e9, flight.log[channel]
        inside = (time_s <= flight.burn_end_s) & np.isfinite(values)
        step_s = float(np.median(np.diff(time_s[inside]))) if inside.sum() > 16 else np.inf
        length = round(_WINDOW_S / step_s)
        if not 0 < length < inside.sum():
            continue
        options: Any = {"window": np.hanning(length), "noverlap": length - max(length // 4, 1), "scaling": "spectrum"}
        hertz, times, power = spectrogram(values[inside], 1.0 / step_s, nperseg=length, detrend=detrend, **options)
        times, hertz = times + time_s[inside][0], hertz[hertz <= _HIGHEST_HZ]
        decibel = 10.0 * np.log10(np.maximum(2.0 * power[: len(hertz)], 1e-24))  # amplitude squared: twice the power
        high = float(np.nanmax(decibel))
        scale: Any = {"cmap": "cividis", "vmin": max(high + _FLOOR_DB, float(np.nanmin(decibel))), "vmax": high}
        image = place.pcolormesh(times, hertz, decibel, shading="nearest", rasterized=True, **scale)
        unit = flight.log.channel(channel).unit
        place.set(ylabel="frequency, Hz", title=f"{_SPECTRA[channel]}: amplitude, dB re 1 {unit}")
        place.set_ylim(0.0, min(_HIGHEST_HZ, float(hertz[-1])))
        _name_modes(place, flight, channel.split("_")[1], times)
        place.grid(False)
        figure.colorbar(image, ax=place, label="dB", pad=0.01)
    places[-1].set_xlabel("time, s")
    return figure


def _name_modes(place: Axes, flight: ReplayFlight, axis: str, times_s: Array) -> None:
    """Draw and name the frequencies of the first stage's bending modes from its table, without axial load and air."""
    if flight.scenario is None:
        return
    stage = shape_of(flight.scenario.vehicle).stages[0]
    table = stage.modes[PLANES.index(axis)]
    if table is None:
        return
    end_s = min([m.time_s for m in flight.moments if m.name == "separation"], default=times_s[-1])
    times_s = times_s[times_s <= end_s]
    look: Any = {"color": WHITE, "fontsize": 6.5, "textcoords": "offset points", "ha": "right", "va": "bottom"}
    for k, hertz in enumerate(table.frequency_hz.T, start=1):
        at = np.interp(times_s * stage.clock_factor, table.time_s, hertz)
        if len(at) and at[-1] < place.get_ylim()[1] - 4.0:
            place.plot(times_s, at, color=WHITE, linewidth=0.7, linestyle=(0, (1, 3)))
            place.annotate(f"mode {k}", (times_s[-1], at[-1]), (-2, 2), **look)


def _requirements(shown: Flights) -> Figure:
    """Draw the utilisation of each requirement as a bar, in the order of the reference flight's utilisation."""
    names = [r.name for r in tightest_first(shown.reference.requirements)]
    figure, (place,) = _figure("Requirements", shown, 1, 1, 0.32 * max(len(names), 3))
    widest = 1.2
    for row, name in enumerate(names):
        for flight in shown.all:
            r = next((r for r in flight.requirements if r.name == name), None)
            if r is None or r.value is None:
                continue
            used = min(_used(r.value, r), _MOST_USED)
            widest = max(widest, used * 1.1)
            if shown.many:
                place.plot([used], [row], "|", color=shown.colour(flight), markersize=11)
                continue
            look: Any = {"color": GREEN} if r.met else {"color": RED, "hatch": "//"}
            place.barh(row, used, height=0.62, edgecolor="white", **look)
            value, limit, unit = r.shown
            text = f"{value} of {limit} {unit}".rstrip()
            place.annotate(text, (used, row), (4, 0), textcoords="offset points", va="center", fontsize=7.5)
    place.axvline(1.0, color=LIMIT, linewidth=1.2)
    place.set_yticks(range(len(names)), names)
    place.invert_yaxis()
    place.set_xlim(0.0, widest + 0.35)
    black = f"; black: {shown.reference.label}" if shown.many and not shown.few else ""
    place.set_xlabel(f"used share of the limit{black}")
    place.grid(axis="y", visible=False)
    return figure


def _sections(shown: Flights, stage: int, loads: LoadsSection) -> Figure:
    """Draw the envelopes of the section loads over the stations, on the pad and under thrust, with their limits."""
    radius, stations = borne(loads, "radius_m"), np.array(loads.stations_m)
    rows = _SECTION_LOADS if radius is not None else _SECTION_LOADS[:3]
    figure, places = _figure(f"Section loads, stage {stage + 1}", shown, len(rows))
    for flight in shown.all:
        log = flight.log
        if "section_1_axial_N" not in log:
            continue
        seen = (log["stage"] == stage) & ((log["thrust_N"] > 0.0) | (log["on_pad"] > 0.5))
        if not seen.any():
            continue
        number = range(1, len(stations) + 1)
        axial, *lateral = (
            np.array([log[f"section_{n}_{quantity}"][seen] for n in number]) / 1e3  # (stations, instants)
            for quantity in ("axial_N", "shear_pitch_N", "shear_yaw_N", "bending_pitch_Nm", "bending_yaw_Nm")
        )
        shear, bending = np.hypot(lateral[0], lateral[1]), np.hypot(lateral[2], lateral[3])
        lines = [(axial.min(axis=1), axial.max(axis=1)), (shear.max(axis=1),), (bending.max(axis=1),)]
        if radius is not None:
            edge = 2.0 * bending / radius[:, None]
            lines.append(((axial - edge).min(axis=1), (axial + edge).max(axis=1)))
        for place, envelopes in zip(places, lines, strict=True):
            for k, values in enumerate(envelopes):
                place.plot(stations, values, **(shown.look(flight) | ({"label": None} if k else {})))
    for place, (title, unit, bounds) in zip(places, rows, strict=True):
        place.set(title=title, ylabel=unit)
        for name, sign in bounds.items():
            limit = borne(loads, name)
            if limit is not None:
                label = name.rsplit("_", 1)[0].replace("_", " ") + ": limit"
                place.plot(stations, sign * limit / 1e3, color=LIMIT, linewidth=1.2, linestyle="--", label=label)
        if place.get_legend_handles_labels()[0]:
            place.legend(**_LEGEND).set_in_layout(False)
    places[-1].set_xlabel("station (m aft of the nose)")
    figure.align_ylabels()
    return figure


def _used(value: float, r: ShownRequirement) -> float:
    if r.kind == "minimum":
        return abs(r.bound / value) if r.bound and value else _MOST_USED
    if r.bound == 0.0:
        return 0.0 if value == 0.0 else _MOST_USED
    return abs(value / r.bound)
