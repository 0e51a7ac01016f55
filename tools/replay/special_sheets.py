"""Plots that are not over time: path in profile and from above, air over altitude, phase planes, spectra, margins."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from maxq.control.kernel.records import Array, IntArray
from maxq.tools.plots.palette import BLACK, BLUE, GREEN, GREY, LIMIT, RED, VERDICT
from maxq.tools.replay.about import plain
from maxq.tools.replay.convert import place_of
from maxq.tools.replay.earth_frame import has_motion, path_of
from maxq.tools.replay.flight import ReplayFlight
from maxq.tools.replay.print_style import WIDTH_IN, curve_look

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_PATH_NS = 100_000_000
_WINDOW_S, _HIGHEST_HZ, _FLOOR_DB = 2.0, 60.0, -80.0
_SPECTRA = (
    ("gyro_pitch_rate_degps", "gyro, pitch rate"),
    ("gyro_yaw_rate_degps", "gyro, yaw rate"),
    ("gimbal_pitch_angle_deg", "gimbal, pitch"),
    ("gimbal_yaw_angle_deg", "gimbal, yaw"),
)


def special_sheets(flights: Sequence[ReplayFlight], reference: ReplayFlight) -> Iterator[tuple[str, Any]]:
    """Name of the file and figure of each sheet that the logs have channels for."""
    moving = [f for f in flights if has_motion(f.log)]
    if moving:
        yield "10-path", _path(moving, reference)
    if all(name in reference.log for name in ("altitude_m", "dynamic_pressure_Pa", "mach")):
        yield "11-altitude", _altitude(flights, reference)
    if "error_pitch_deg" in reference.log and "measured_pitch_rate_degps" in reference.log:
        yield "12-phase-plane", _phase_plane(flights, reference)
    spectra = [(channel, label) for channel, label in _SPECTRA if channel in reference.log]
    if spectra and _burn_end(reference) - reference.span_s[0] > 4.0 * _WINDOW_S:
        yield "13-spectra", _spectra(spectra, reference)
    judged = [f for f in flights if any(r.value is not None for r in f.requirements)]
    if judged:
        yield "14-requirements", _margins(judged, reference)


def _figure(rows: int, columns: int, height: float, title: str) -> tuple[Any, Any]:
    import matplotlib.pyplot as plt  # noqa: PLC0415  # lazy

    figure, places = plt.subplots(rows, columns, figsize=(WIDTH_IN, height), squeeze=False, layout="constrained")
    figure.suptitle(title, fontsize=11, fontweight="bold", x=0.01, ha="left")
    return figure, places


def _title(name: str, flights: Sequence[ReplayFlight], reference: ReplayFlight) -> str:
    return f"{name} - {reference.label if len(flights) == 1 else f'{len(flights)} flights'}"


def _look(flight: ReplayFlight, reference: ReplayFlight, many: bool) -> dict[str, Any]:
    if not many:
        return {"color": BLUE, "linewidth": 1.4}
    if flight is reference:
        return {"color": BLACK, "linewidth": 1.2, "zorder": 3.0, "label": reference.label}
    return {"color": VERDICT[flight.verdict], "linewidth": 0.6, "alpha": 0.7}


def _path(flights: Sequence[ReplayFlight], reference: ReplayFlight) -> Any:
    figure, places = _figure(2, 1, 7.0, _title("Path", flights, reference))
    profile, above = places[:, 0]
    many = len(flights) > 1
    for flight in flights:
        place = place_of(flight)
        path = path_of(flight.log, place.frames(flight.log.table, _PATH_NS))
        east, north = path.position_m[:, 0] / 1000.0, path.position_m[:, 1] / 1000.0
        altitude = np.interp(path.times_ns, flight.log.time_ns("altitude_m"), flight.log["altitude_m"]) / 1000.0
        along = np.hypot(east, north)
        look = _look(flight, reference, many)
        profile.plot(along, altitude, **look)
        above.plot(east, north, **{k: v for k, v in look.items() if k != "label"})
        if not many or flight.verdict == "failed":
            above.plot(east[-1:], north[-1:], "x", color=look["color"], markersize=5)
        if flight is reference:
            _powered_part(profile, flight, path.times_ns, along, altitude, many)
            for moment in flight.moments:
                k = min(int(np.searchsorted(path.times_ns, moment.time_ns)), len(along) - 1)
                if moment.name in ("max_q", "burnout", "apogee", "impact", "control_lost", "diverged", "tumble"):
                    _label(profile, along[k], altitude[k], f"{moment.name.replace('_', ' ')} {moment.time_s:.1f} s")
                    _label(above, east[k], north[k], moment.name.replace("_", " "))
    profile.set(xlabel="horizontal distance from the site (km)", ylabel="altitude (km)", title="profile")
    above.set(xlabel="east of the site (km)", ylabel="north of the site (km)", title="from above")
    above.set_aspect("equal", adjustable="datalim")
    above.plot([0], [0], "s", color=BLACK, markersize=4)
    if not many or any("label" in _look(f, reference, many) for f in flights):
        profile.legend(loc="lower center") if profile.get_legend_handles_labels()[0] else None
    return figure


def _powered_part(place: Axes, flight: ReplayFlight, ns: IntArray, x: Array, y: Array, many: bool) -> None:
    if "thrust_N" not in flight.log or many:
        return
    thrust = np.interp(ns, flight.log.time_ns("thrust_N"), flight.log["thrust_N"])
    burning = thrust > 0.0
    place.plot(
        np.where(burning, x, np.nan), np.where(burning, y, np.nan), color=RED, linewidth=2.6, label="under thrust"
    )


def _label(place: Axes, x: float, y: float, text: str) -> None:
    place.plot([x], [y], "o", color=GREY, markersize=3.5, zorder=4)
    place.annotate(text, (x, y), (5, 4), textcoords="offset points", fontsize=7.5)


def _altitude(flights: Sequence[ReplayFlight], reference: ReplayFlight) -> Any:
    figure, places = _figure(1, 3, 4.6, _title("Over altitude, going up", flights, reference))
    many = len(flights) > 1
    for flight in flights:
        log = flight.log
        apogee = flight.moment("apogee")
        rising = slice(0, int(np.searchsorted(log.time_ns("altitude_m"), apogee.time_ns)) if apogee else None)
        height = log["altitude_m"][rising] / 1000.0
        look = _look(flight, reference, many)
        places[0, 0].plot(log["dynamic_pressure_Pa"][rising] / 1000.0, height, **look)
        places[0, 1].plot(log["mach"][rising], height, **look)
        if "wind_N_north_mps" in log:
            for k, (axis, label) in enumerate((("north", "to north"), ("east", "to east"))):
                more = {**look, "label": label} if flight is reference else look
                if not many:
                    more = {**curve_look(k), "label": label}
                else:
                    more = {**more, "linestyle": curve_look(k)["linestyle"]}
                places[0, 2].plot(log[f"wind_N_{axis}_mps"][rising], height, **more)
    for place, label in zip(places[0], ("dynamic pressure (kPa)", "Mach number (1)", "wind (m/s)"), strict=True):
        place.set(xlabel=label, ylabel="altitude (km)")
    places[0, 2].legend(loc="best")
    return figure


def _phase_plane(flights: Sequence[ReplayFlight], reference: ReplayFlight) -> Any:
    axes = ("pitch", "yaw", "roll")
    figure, places = _figure(1, 3, 3.4, _title("Phase planes under thrust", flights, reference))
    many = len(flights) > 1
    for flight in flights:
        ns = flight.log.time_ns("error_pitch_deg")
        end = int(np.searchsorted(ns, _burn_end(flight) * 1e9))
        for place, axis in zip(places[0], axes, strict=True):
            k = slice(0, end, max(1, end // 6000))
            error, rate = flight.log[f"error_{axis}_deg"][k], flight.log[f"body_{axis}_rate_degps"][k]
            place.plot(error, rate, **{**_look(flight, reference, many), "linewidth": 0.7})
    for place, axis in zip(places[0], axes, strict=True):
        place.set(xlabel=f"{axis} error (deg)", ylabel=f"{axis} rate (deg/s)", title=axis)
        place.axhline(0.0, color=GREY, linewidth=0.6)
        place.axvline(0.0, color=GREY, linewidth=0.6)
    return figure


def _spectra(channels: Sequence[tuple[str, str]], flight: ReplayFlight) -> Any:
    """Amplitude over time and frequency, from overlapping windows of 2 s: where bending, slosh and loop live."""
    figure, places = _figure(
        len(channels), 1, 0.8 + 1.9 * len(channels), _title("Spectra under thrust", [flight], flight)
    )
    start, end = flight.span_s[0], _burn_end(flight)
    for place, (channel, label) in zip(places[:, 0], channels, strict=True):
        time_s, hertz, decibel = spectrogram(flight.log.time_ns(channel) / 1e9, flight.log[channel], start, end)
        if not len(time_s):
            continue
        image = place.pcolormesh(
            time_s, hertz, decibel.T, cmap="cividis", shading="nearest", rasterized=True,
            vmin=max(float(np.nanmax(decibel)) + _FLOOR_DB, float(np.nanmin(decibel))), vmax=float(np.nanmax(decibel)),
        )  # fmt: skip
        place.set(ylabel="frequency (Hz)", title=f"{label}: amplitude, dB re 1 {flight.log.channel(channel).unit}")
        place.set_ylim(0.0, min(_HIGHEST_HZ, float(hertz[-1])))
        place.grid(False)
        figure.colorbar(image, ax=place, label="dB", pad=0.01)
    places[-1, 0].set_xlabel("time (s)")
    return figure


def spectrogram(time_s: Array, values: Array, start: float, end: float) -> tuple[Array, Array, Array]:
    """Middle times (n,), frequencies (m,) and amplitudes (n, m) in dB of windows of 2 s that overlap by three quarters.

    A sine of amplitude 1 reads 0 dB (Hann window, trend taken out).
    """
    inside = (time_s >= start) & (time_s <= end) & np.isfinite(values)
    time_s, values = time_s[inside], values[inside]
    if len(time_s) < 16:
        return np.zeros(0), np.zeros(0), np.zeros((0, 0))
    step = float(np.median(np.diff(time_s)))
    length = round(_WINDOW_S / step)
    starts = np.arange(0, len(values) - length, max(length // 4, 1))
    if not len(starts):
        return np.zeros(0), np.zeros(0), np.zeros((0, 0))
    window = np.hanning(length)
    ramp = np.linspace(-1.0, 1.0, length)
    pieces = values[starts[:, None] + np.arange(length)]
    pieces = pieces - pieces.mean(axis=1, keepdims=True)
    pieces = pieces - (pieces @ ramp / (ramp @ ramp))[:, None] * ramp
    amplitude = 2.0 * np.abs(np.fft.rfft(pieces * window, axis=1)) / window.sum()
    hertz = np.fft.rfftfreq(length, step)
    keep = hertz <= _HIGHEST_HZ
    with np.errstate(divide="ignore"):
        decibel = 20.0 * np.log10(np.maximum(amplitude[:, keep], 1e-12))
    return time_s[starts + length // 2], np.asarray(hertz[keep], float), np.asarray(decibel)


def _margins(flights: Sequence[ReplayFlight], reference: ReplayFlight) -> Any:
    """Each requirement as a bar: how much of what is allowed was used."""
    names = [r.name for r in reference.requirements]
    figure, places = _figure(1, 1, 0.9 + 0.32 * max(len(names), 3), _title("Requirements", flights, reference))
    place = places[0, 0]
    many = len(flights) > 1
    widest = 1.2
    for row, name in enumerate(names):
        for flight in flights:
            r = next((r for r in flight.requirements if r.name == name), None)
            if r is None or r.value is None:
                continue
            used = _used(r.value, r.limit, r.minimum)
            widest = max(widest, min(used, 3.0) * 1.1)
            colour = GREEN if r.met else RED
            if many:
                place.plot([min(used, 3.0)], [row], "|", color=BLACK if flight is reference else colour, markersize=11)
            else:
                place.barh(
                    row, min(used, 3.0), color=colour, height=0.62, hatch=None if r.met else "//", edgecolor="white"
                )
                bound = r.limit if r.limit is not None else r.minimum
                unit = "" if r.unit == "1" else f" {r.unit}"
                place.annotate(
                    f"{plain(r.value)} of {bound:g}{unit}",
                    (min(used, 3.0), row), (4, 0), textcoords="offset points", va="center", fontsize=7.5,
                )  # fmt: skip
    place.axvline(1.0, color=LIMIT, linewidth=1.2)
    place.set_yticks(range(len(names)), names)
    place.invert_yaxis()
    place.set_xlim(0.0, widest + 0.35)
    place.set_xlabel("share of what is allowed (1)" + (f"; black: {reference.label}" if many else ""))
    place.grid(axis="y", visible=False)
    return figure


def _used(value: float, limit: float | None, minimum: float | None) -> float:
    if limit is not None:
        return 0.0 if limit == 0.0 and value == 0.0 else abs(value / limit) if limit else 3.0
    return abs(minimum / value) if minimum and value else 3.0


def _burn_end(flight: ReplayFlight) -> float:
    moment = flight.moment("burnout")
    return moment.time_s if moment is not None else flight.span_s[1]
