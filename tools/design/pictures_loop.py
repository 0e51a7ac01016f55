"""The picture of one open loop: Bode, Nichols and Nyquist plots on a sheet, with named lobes, crossings and zones."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, Polygon
from matplotlib.ticker import MultipleLocator

from maxq.control.kernel.records import Array
from maxq.design.certificate.response import decibels
from maxq.design.margins.distances import Zone
from maxq.design.model.state_space import ComplexArray
from maxq.tools.design.open_loop import BOTTOM_DB, LOWEST_HZ, LoopPicture, Mark, unwrapped_deg
from maxq.tools.plots.palette import BLACK, BLUE, GREY, ON_LIGHT, PALE, RED
from maxq.tools.plots.style import label, name_point, plain_numbers, sheet

_MARGIN: dict[str, Any] = {"color": RED, "linewidth": 2.0}
_ZONE: dict[str, Any] = {"facecolor": RED, "alpha": 0.15, "edgecolor": RED}
_OF_LOBES = tuple(colour for colour in ON_LIGHT if colour not in (BLUE, RED))
_TURN = np.radians(np.arange(0.0, 360.0, 3.0))
TOP_DB = 50.0  # upper limit of Bode and Nichols plots


def draw_loop(picture: LoopPicture) -> Figure:
    """Draw the Bode plot and |1 + L| on the left, and Nichols, Nyquist and the neighbourhood of -1 on the right."""
    figure, places = sheet(3, 2, height_in=2.9, width_in=8.4, title=f"Open loop: {picture.title}")
    draw_bode(picture, places[0], places[2])
    _distance(picture, places[4])
    draw_nichols(picture, places[1])
    draw_nyquist(picture, places[3])
    _near_minus_one(picture, places[5])
    grey = Line2D([], [], color=PALE, linewidth=1.2, label="|T| in dB, phase of T (Nichols); |L| in dB (Nyquist)")
    cross = Line2D([], [], color=BLACK, marker="+", markersize=9, markeredgewidth=1.8, linestyle="none", label="-1")
    shown: list[Artist] = [
        Line2D([], [], color=BLUE, label="L"),
        Line2D([], [], **_MARGIN, label="margin"),
        cross,
        grey,
    ]
    if picture.zones:
        shown.insert(3, Patch(**_ZONE, label="zone around -1"))
    figure.legend(handles=shown, loc="outside lower left", ncols=len(shown))
    return figure


def draw_bode(picture: LoopPicture, gain: Axes, phase: Axes, colour: str = BLUE) -> None:
    """Draw the Bode plot with an unwrapped phase. Dotted lines are at -180 deg and at whole turns from it."""
    f, loop = picture.frequency_hz, picture.loop
    level, turned = decibels(loop), unwrapped_deg(picture)
    seen = (f >= LOWEST_HZ) & (level > BOTTOM_DB)
    gain.axhline(0.0, color=GREY, linewidth=0.8)
    gain.plot(f, level, color=colour)
    phase.plot(f, turned, color=colour)
    low, high = float(turned[seen].min()), float(turned[seen].max())
    step = 90.0 * max(1, round((high - low) / 540.0))
    phase.set_ylim(step * np.floor(low / step) - 0.2 * step, step * np.ceil(high / step) + 0.2 * step)
    phase.yaxis.set_major_locator(MultipleLocator(step))
    for at in np.arange(-180.0 - 360.0 * 12, 1000.0, 360.0):
        phase.axhline(at, color=GREY, linewidth=0.8, linestyle=":")
    bottom, top = max(float(level[f >= LOWEST_HZ].min()), BOTTOM_DB), float(level[f >= LOWEST_HZ].max())
    gain.set_ylim(bottom, min(top + 14.0, TOP_DB + 10.0))
    for place in (gain, phase):
        place.set_xscale("log")
        place.set_xlim(max(f[0], LOWEST_HZ), min(f[-1], 200.0))
        plain_numbers(place.xaxis)
    for n, mark in enumerate(picture.marks):
        level_db = float(decibels(np.array([mark.loop]))[0])
        turn = float(np.interp(mark.frequency_hz, f, turned))
        if mark.what == "lobe" and level_db > BOTTOM_DB:
            gain.plot(mark.frequency_hz, level_db, "o", color=_colour(n), markersize=3)
            phase.plot(mark.frequency_hz, turn, "o", color=_colour(n), markersize=3)
            name_point(gain, mark.frequency_hz, min(level_db, TOP_DB), mark.text)
        elif mark.what == "gain" and mark.text:  # from the curve to 0 dB
            gain.plot([mark.frequency_hz] * 2, [level_db, 0.0], **_MARGIN)
            name_point(gain, mark.frequency_hz, level_db, mark.text, color=RED)
        elif mark.what == "phase" and mark.text:  # from the curve to the nearest -180 deg
            nearest = 360.0 * np.round((turn + 180.0) / 360.0) - 180.0
            phase.plot([mark.frequency_hz] * 2, [turn, nearest], **_MARGIN)
            name_point(phase, mark.frequency_hz, nearest, mark.text, color=RED)
    label(gain, "frequency, Hz", "|L|, dB", "Gain |L|")
    label(phase, "frequency, Hz", "phase of L, deg", "Phase of L")


def _distance(picture: LoopPicture, place: Axes) -> None:
    f = picture.frequency_hz
    place.plot(f, np.abs(1.0 + picture.loop), color=BLUE)
    place.set_xscale("log")
    place.set_xlim(max(f[0], LOWEST_HZ), min(f[-1], 200.0))
    place.set_ylim(0.0, 2.0)
    plain_numbers(place.xaxis)
    for mark in picture.marks:
        if mark.what == "least":
            place.plot(mark.frequency_hz, abs(1.0 + mark.loop), "o", color=RED, markersize=3.5)
            name_point(place, mark.frequency_hz, abs(1.0 + mark.loop), mark.text, color=RED)
    label(place, "frequency, Hz", "|1 + L|", "Distance to -1")


_M_DB = (-20.0, -12.0, -6.0, -3.0, -1.0, 0.25, 0.5, 1.0, 3.0, 6.0, 12.0)
_N_DEG = (-340.0, -300.0, -240.0, -210.0, -150.0, -120.0, -90.0, -60.0, -30.0, -10.0)
_NAMED_HZ = (0.1, 1.0, 10.0)


def contours() -> list[tuple[str, Array, Array]]:
    """Return the M and N contours of the Nichols plane as (name, phase of L in deg, |L| in dB).

    On a contour, T = L / (1 + L) has a constant magnitude, which names it (in dB), or a constant phase, without a name.
    The contours follow from L = T / (1 - T).
    """
    out = []
    for m_db in _M_DB:
        turns = np.radians(np.linspace(-359.9, -0.1, 721))
        t = 10.0 ** (m_db / 20.0) * np.exp(1j * turns)
        out.append((f"{m_db:g} dB", *_placed(t / (1.0 - t))))
    for n_deg in _N_DEG:
        t = 10.0 ** (np.linspace(-70.0, 60.0, 801) / 20.0) * np.exp(1j * np.radians(n_deg))
        out.append(("", *_placed(t / (1.0 - t))))
    return out


def _placed(loop: ComplexArray) -> tuple[Array, Array]:
    """Return the phase in [-360, 0) degrees and the level in dB, with gaps where the phase jumps."""
    turn, level = turned_deg(loop), decibels(loop)
    jump = np.flatnonzero(np.abs(np.diff(turn)) > 180.0) + 1
    return np.insert(turn, jump, np.nan), np.insert(level, jump, np.nan)


def draw_nichols(picture: LoopPicture, place: Axes, colour: str = BLUE) -> None:
    """Draw the loop in the Nichols plane over M and N contours, with lobes and margins named and zones shaded."""
    level, turn = decibels(picture.loop), turned_deg(picture.loop)
    seen = level[picture.frequency_hz >= LOWEST_HZ]
    bottom, top = max(float(seen.min()), -40.0), min(max(float(seen.max()), 10.0) + 6.0, TOP_DB)
    for name, phase, db in contours():
        place.plot(phase, np.clip(db, bottom - 20.0, top + 20.0), color=PALE, linewidth=0.5, zorder=0.5)
        inside = np.flatnonzero((db > bottom + 1.0) & (db < top - 1.0) & (phase > -340.0) & (phase < -2.0))
        low = name.startswith("-")  # a contour of attenuation crosses the plane, others enclose -1
        whole = low or db.max() < top - 1.0
        if name and name != f"{_M_DB[-1]:g} dB" and whole and len(inside):
            k = int(inside[np.argmax(phase[inside] if low else db[inside])])
            _name_contour(place, float(phase[k]), float(db[k]), name, ha="right" if low else "center")
    for zone in picture.zones:
        place.add_patch(Polygon(_outline(zone), **_ZONE))
    place.grid(visible=False)
    place.axhline(0.0, color=GREY, linewidth=0.8, zorder=0.55)
    place.axvline(-180.0, color=GREY, linewidth=0.8, zorder=0.55)
    _cross(place, -180.0)
    place.plot(*_broken(turn, level)[::-1], color=colour, linewidth=1.3)
    place.set_xlim(-360.0, 0.0)
    place.set_xticks(range(-360, 1, 60))
    place.set_ylim(bottom, top)
    for n, mark in enumerate(picture.marks):
        x, y = float(turned_deg(np.array([mark.loop]))[0]), float(decibels(np.array([mark.loop]))[0])
        if mark.what != "least" and bottom < y < top:
            _mark(place, mark, n, np.array([(x, y), (-180.0, 0.0)]))
    _name_frequencies(place, picture, np.stack([turn, level]))
    label(place, "phase of L, deg (mod 360)", "|L|, dB", "Nichols")


def _name_contour(place: Axes, x: float, y: float, name: str, **look: Any) -> None:
    """Write the name of a contour on it, below the curves."""
    gap = {"facecolor": "white", "edgecolor": "none", "pad": 0.5}
    place.text(x, y, name, fontsize=6.0, color=GREY, va="center", zorder=0.6, clip_on=True, bbox=gap, **look)


def _name_frequencies(place: Axes, picture: LoopPicture, curve: Array) -> None:
    """Draw dots at round frequencies, and name those for which there is space. `curve` is (2, n): the points of the
    picture.
    """
    f, (low, high) = picture.frequency_hz, place.get_ylim()
    for hz in _NAMED_HZ:
        k = int(np.argmin(np.abs(np.log(f / hz))))
        if f[0] < hz < f[-1] and low < curve[1, k] < high:
            place.plot(*curve[:, k], ".", color=BLUE, markersize=4)
            name_point(
                place, float(curve[0, k]), float(curve[1, k]), f"{hz:g} Hz", must=False, color=BLUE, fontsize=6.0
            )


def draw_nyquist(picture: LoopPicture, place: Axes) -> None:
    """Draw the Nyquist plot.

    The radius is |L| up to 1, and r = 1 + ln |L| beyond, so that lobes of any size fit.
    """
    seen = picture.frequency_hz >= LOWEST_HZ
    curve = _drawn_in(picture.loop[seen])
    reach = max(1.5, 1.08 * float(np.abs(curve).max()))
    _circles(place, (-6.0, 0.0, 10.0, 20.0, 30.0, 40.0), reach)
    place.plot(curve.real, curve.imag, color=BLUE)
    _cross(place, -1.0)
    place.set_ylim(-reach, reach)
    for n, mark in enumerate(picture.marks):
        if mark.what != "least" and abs(mark.loop) > 0.05:
            _mark(place, mark, n, _plane(_drawn_in(_ends(mark))))
    drawn = _drawn_in(picture.loop)
    _name_frequencies(place, picture, np.stack([drawn.real, drawn.imag]))
    _scale_equally(place, (-reach, reach), (-reach, reach))
    place.set_xticks([])
    place.set_yticks([])
    for side in place.spines.values():
        side.set_visible(False)
    label(place, title="Nyquist (logarithmic beyond 0 dB)")


def _near_minus_one(picture: LoopPicture, place: Axes) -> None:
    """Draw the Nyquist plot within about 0 dB, to scale: lengths from -1 are |1 + L|."""
    seen = picture.loop[picture.frequency_hz >= LOWEST_HZ]
    for zone in picture.zones:
        turn, level_db = _outline(zone).T
        place.add_patch(Polygon(_plane(10.0 ** (level_db / 20.0) * np.exp(1j * np.radians(turn))), **_ZONE))
    _circles(place, (-6.0, 0.0), 2.0)
    place.plot(seen.real, seen.imag, color=BLUE)
    _cross(place, -1.0)
    place.axhline(0.0, color=GREY, linewidth=0.6, zorder=0.6)
    place.set_ylim(-1.15, 1.15)
    for n, mark in enumerate(picture.marks):
        ends = _ends(mark)
        if abs(ends[0].imag) < 1.1 and -1.6 < ends[0].real < 1.1:
            _mark(place, mark, n, _plane(ends))
    _scale_equally(place, (-1.6, 0.6), (-1.15, 1.15))
    label(place, "Re L", "Im L", "Nyquist near -1 (to scale)")


def _scale_equally(place: Axes, x: tuple[float, float], y: tuple[float, float]) -> None:
    """Draw to scale, with the range along the longer side of the panel extended."""
    place.set_xlim(*x, auto=True)
    place.set_ylim(*y, auto=True)
    place.set_aspect("equal", adjustable="datalim")
    place.grid(visible=False)


def _circles(place: Axes, levels_db: Sequence[float], reach: float) -> None:
    """Draw circles of |L|, named in dB."""
    around = np.exp(1j * np.linspace(0.0, 2.0 * np.pi, 181))
    for level_db in levels_db:
        radius = float(np.abs(_drawn_in(np.array([10.0 ** (level_db / 20.0) + 0j])))[0])
        if radius < reach:
            style: dict[str, Any] = {"color": GREY, "linewidth": 0.9 if level_db == 0.0 else 0.5, "alpha": 0.8}
            place.plot(radius * around.real, radius * around.imag, zorder=0.5, **style)
            _name_contour(place, 0.0, radius, f"{level_db:g} dB", ha="center")


def _ends(mark: Mark) -> ComplexArray:
    """Return the line of a margin in the plane of L from the mark to -1, for a phase margin along |L| = 1."""
    if mark.what != "phase":
        return np.array([mark.loop, -1.0])
    angle = float(np.angle(mark.loop))
    return np.asarray(np.exp(1j * np.linspace(angle, math.copysign(math.pi, angle), 25)))


def _plane(values: ComplexArray) -> Array:
    return np.stack([values.real, values.imag], 1)


def _cross(place: Axes, x: float) -> None:
    """Draw the critical point as a text, so that the names of points avoid it."""
    place.text(x, 0.0, "+", color=BLACK, fontsize=15, fontweight="bold", ha="center", va="center_baseline")


def _mark(place: Axes, mark: Mark, n: int, way: Array) -> None:
    """Draw a mark at the beginning of `way`; of a margin, all of it."""
    if not mark.text:  # a crossing that sets no margin
        return
    x, y = map(float, way[0])
    if mark.what == "lobe":
        place.plot(x, y, "o", color=_colour(n), markersize=3.5)
        name_point(place, x, y, mark.text)
    else:
        place.plot(*way.T, **_MARGIN)
        name = f"|1 + L| {mark.text}" if mark.what == "least" else mark.text.partition(",")[0]
        name_point(place, x, y, name, color=RED)


def _outline(zone: Zone) -> Array:
    """Return the outline of a zone in the Nichols plane, (n, 2): phase in deg and |L| in dB."""
    x, y = np.cos(_TURN), np.sin(_TURN)
    if zone.shape != "ellipse":
        size = np.abs(x) + np.abs(y) if zone.shape == "diamond" else np.maximum(np.abs(x), np.abs(y))
        x, y = x / size, y / size
    return np.stack([zone.phase_deg * x - 180.0, zone.gain_db * y], 1)


def _colour(n: int) -> str:
    return _OF_LOBES[n % len(_OF_LOBES)]


def turned_deg(loop: ComplexArray) -> Array:
    """Return the phase in [-360, 0) degrees, so that -180 is in the middle."""
    return np.asarray(np.degrees(np.angle(-loop)) - 180.0)


def _broken(wrapped_deg: Array, other: Array) -> tuple[Array, Array]:
    """Return `other` and the wrapped phase, with gaps where the phase jumps. Both ends of a gap extend to the edge."""
    other = np.asarray(other, float)
    jump = np.flatnonzero(np.abs(np.diff(wrapped_deg)) > 180.0)
    centre = 0.0 if wrapped_deg.max() > 0.0 else -180.0
    side = np.sign(wrapped_deg[jump] - centre)
    low, high = 180.0 - side * (wrapped_deg[jump] - centre), 180.0 + side * (wrapped_deg[jump + 1] - centre)
    share = low / np.maximum(low + high, 1e-12)
    between = other[jump] + share * (other[jump + 1] - other[jump])
    edge = 180.0 * side
    more = np.stack([between, np.full(len(jump), np.nan), between], axis=1).ravel()
    phases = np.stack([centre + edge, np.full(len(jump), np.nan), centre - edge], axis=1).ravel()
    at = np.repeat(jump + 1, 3)
    return np.insert(other, at, more), np.insert(wrapped_deg, at, phases)


def _drawn_in(loop: ComplexArray) -> ComplexArray:
    size = np.maximum(np.abs(loop), 1e-300)
    return np.asarray(np.where(size > 1.0, loop / size * (1.0 + np.log(size)), loop))
