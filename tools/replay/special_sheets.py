"""Plots that are not over time: path in profile and from above, air over altitude, phase planes, spectra, margins."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from scipy.signal import detrend

from maxq.control.kernel.records import Array
from maxq.tools.plots.palette import BLACK, GREEN, GREY, LIMIT, RED
from maxq.tools.plots.style import curve as look_of
from maxq.tools.plots.style import sheet
from maxq.tools.replay.flight import ReplayFlight, Requirement
from maxq.tools.replay.launch_site import has_motion, path_of, place_of
from maxq.tools.replay.plots import AXES
from maxq.tools.replay.sheets import WIDTH_IN, Flights
from maxq.tools.replay.text import plain

_PATH_NS = 100_000_000
_WINDOW_S, _HIGHEST_HZ, _FLOOR_DB = 2.0, 60.0, -80.0
_SPECTRA = {
    "gyro_pitch_rate_degps": "gyro, pitch rate",
    "gyro_yaw_rate_degps": "gyro, yaw rate",
    "gimbal_pitch_angle_deg": "gimbal, pitch",
    "gimbal_yaw_angle_deg": "gimbal, yaw",
}
_IN_PATH = ("max_q", "burnout", "apogee", "impact", "control_lost", "diverged", "tumble")
_MOST_USED = 3.0  # share of what is allowed at which a bar ends


def special_sheets(shown: Flights) -> Iterator[tuple[str, Figure]]:
    """Name of the file and figure of each sheet that the logs have channels for."""
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


def _figure(name: str, shown: Flights, rows: int, columns: int, height_in: float) -> tuple[Figure, Sequence[Axes]]:
    of = f"{len(shown.all)} flights" if shown.many else shown.reference.label
    return sheet(rows, columns, height_in, WIDTH_IN, f"{name} - {of}")


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
    profile.set(xlabel="horizontal distance from the site (km)", ylabel="altitude (km)", title="profile")
    above.set(xlabel="east of the site (km)", ylabel="north of the site (km)", title="from above")
    above.set_aspect("equal", adjustable="datalim")
    above.plot([0], [0], "s", color=BLACK, markersize=4)
    if profile.get_legend_handles_labels()[0]:
        profile.legend(loc="lower center")
    return figure


def _point(place: Axes, x: float, y: float, text: str) -> None:
    place.plot([x], [y], "o", color=GREY, markersize=3.5, zorder=4)
    place.annotate(text, (x, y), (5, 4), textcoords="offset points", fontsize=7.5)


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
    for place, label in zip(places, ("dynamic pressure (kPa)", "Mach number (1)", "wind (m/s)"), strict=True):
        place.set(xlabel=label, ylabel="altitude (km)")
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
        place.set(xlabel=f"{axis} error (deg)", ylabel=f"{axis} rate (deg/s)", title=axis)
        place.axhline(0.0, color=GREY, linewidth=0.6)
        place.axvline(0.0, color=GREY, linewidth=0.6)
    return figure


def _spectra(channels: Sequence[str], flight: ReplayFlight) -> Figure:
    """Amplitude over time and frequency, from overlapping windows of 2 s: where bending, slosh and loop live."""
    figure, places = _figure("Spectra under thrust", Flights([flight], flight), len(channels), 1, 1.9)
    for place, channel in zip(places, channels, strict=True):
        time_s, values = flight.log.time_ns(channel) / 1e9, flight.log[channel]
        times, hertz, decibel = spectrogram(time_s, values, flight.span_s[0], flight.burn_end_s)
        if not len(times):
            continue
        high = float(np.nanmax(decibel))
        scale: Any = {"cmap": "cividis", "vmin": max(high + _FLOOR_DB, float(np.nanmin(decibel))), "vmax": high}
        image = place.pcolormesh(times, hertz, decibel, shading="nearest", rasterized=True, **scale)
        unit = flight.log.channel(channel).unit
        place.set(ylabel="frequency (Hz)", title=f"{_SPECTRA[channel]}: amplitude, dB re 1 {unit}")
        place.set_ylim(0.0, min(_HIGHEST_HZ, float(hertz[-1])))
        place.grid(False)
        figure.colorbar(image, ax=place, label="dB", pad=0.01)
    places[-1].set_xlabel("time (s)")
    return figure


def spectrogram(time_s: Array, values: Array, start: float, end: float) -> tuple[Array, Array, Array]:
    """Middle times (n,), frequencies (m,) and amplitudes (m, n) in dB of windows of 2 s that overlap by three quarters.

    A sine of amplitude 1 reads 0 dB (Hann window, trend taken out).
    """
    inside = (time_s >= start) & (time_s <= end) & np.isfinite(values)
    time_s, values = time_s[inside], values[inside]
    step = float(np.median(np.diff(time_s))) if len(time_s) > 16 else np.inf
    length = round(_WINDOW_S / step)
    starts = np.arange(0, len(values) - length, max(length // 4, 1))
    if not length or not len(starts):
        return np.zeros(0), np.zeros(0), np.zeros((0, 0))
    pieces = detrend(values[starts[:, None] + np.arange(length)])
    window = np.hanning(length)
    amplitude = 2.0 * np.abs(np.fft.rfft(pieces * window, axis=1)) / window.sum()
    hertz = np.asarray(np.fft.rfftfreq(length, step), float)
    keep = hertz <= _HIGHEST_HZ
    decibel = np.asarray(20.0 * np.log10(np.maximum(amplitude[:, keep], 1e-12)), float)
    return time_s[starts + length // 2], hertz[keep], decibel.T


def _requirements(shown: Flights) -> Figure:
    """Each requirement as a bar: how much of what is allowed was used."""
    names = [r.name for r in shown.reference.requirements]
    figure, (place,) = _figure("Requirements", shown, 1, 1, 0.32 * max(len(names), 3))
    widest = 1.2
    for row, name in enumerate(names):
        for flight in shown.all:
            r = next((r for r in flight.requirements if r.name == name), None)
            if r is None or r.value is None:
                continue
            used = min(_used(r.value, r), _MOST_USED)
            widest = max(widest, used * 1.1)
            colour = GREEN if r.met else RED
            if shown.many:
                colour = BLACK if flight is shown.reference else colour
                place.plot([used], [row], "|", color=colour, markersize=11)
                continue
            place.barh(row, used, color=colour, height=0.62, hatch=None if r.met else "//", edgecolor="white")
            text = f"{plain(r.value)} of {r.bound:g}{'' if r.unit == '1' else f' {r.unit}'}"
            place.annotate(text, (used, row), (4, 0), textcoords="offset points", va="center", fontsize=7.5)
    place.axvline(1.0, color=LIMIT, linewidth=1.2)
    place.set_yticks(range(len(names)), names)
    place.invert_yaxis()
    place.set_xlim(0.0, widest + 0.35)
    place.set_xlabel("share of what is allowed (1)" + (f"; black: {shown.reference.label}" if shown.many else ""))
    place.grid(axis="y", visible=False)
    return figure


def _used(value: float, r: Requirement) -> float:
    if r.kind == "minimum":
        return abs(r.bound / value) if r.bound and value else _MOST_USED
    if r.bound == 0.0:
        return 0.0 if value == 0.0 else _MOST_USED
    return abs(value / r.bound)
