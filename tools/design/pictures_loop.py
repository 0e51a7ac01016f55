"""The picture of one open loop: Bode, Nichols and Nyquist plots on a sheet, with named lobes, crossings and zones."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse, Polygon, Rectangle
from matplotlib.ticker import MultipleLocator

from maxq.control.kernel.records import Array
from maxq.design.certificate.response import decibels
from maxq.design.margins.distances import Zone
from maxq.design.model.state_space import ComplexArray
from maxq.tools.design.open_loop import BOTTOM_DB, LOWEST_HZ, LoopPicture, Mark, unwrapped_deg
from maxq.tools.plots.palette import BLACK, BLUE, GREY, ON_LIGHT, PALE, RED
from maxq.tools.plots.style import label, name_point, plain_numbers, sheet

TOP_DB = 50.0  # upper limit of Bode and Nichols plots


def draw_loop(picture: LoopPicture) -> Figure:
    """Draw the Bode plot on the left, and the Nichols and Nyquist plots on the right."""
    figure, places = sheet(2, 2, height_in=3.3, width_in=8.4)
    _bode(picture, places[0], places[2])
    draw_nichols(picture, places[1])
    _nyquist(picture, places[3])
    figure.suptitle(picture.title, fontsize=10)
    return figure


def _bode(picture: LoopPicture, gain: Axes, phase: Axes) -> None:
    """Draw the Bode plot with an unwrapped phase. Dotted lines are at -180 deg and at whole turns from it."""
    f, loop = picture.frequency_hz, picture.loop
    level, turned = decibels(loop), unwrapped_deg(picture)
    seen = (f >= LOWEST_HZ) & (level > BOTTOM_DB)
    gain.axhline(0.0, color=GREY, linewidth=0.8)
    gain.plot(f, level, color=BLUE)
    phase.plot(f, turned, color=BLUE)
    low, high = float(turned[seen].min()), float(turned[seen].max())
    step = 90.0 * max(1, round((high - low) / 540.0))
    phase.set_ylim(step * np.floor(low / step) - 0.2 * step, step * np.ceil(high / step) + 0.2 * step)
    phase.yaxis.set_major_locator(MultipleLocator(step))
    for at in np.arange(-180.0 - 360.0 * 12, 1000.0, 360.0):
        phase.axhline(at, color=GREY, linewidth=0.8, linestyle=":")
    bottom, top = max(float(level[f >= LOWEST_HZ].min()), BOTTOM_DB), float(level[f >= LOWEST_HZ].max())
    gain.set_ylim(bottom, min(top + 24.0, TOP_DB + 10.0))
    for place in (gain, phase):
        place.set_xscale("log")
        place.set_xlim(max(f[0], LOWEST_HZ), min(f[-1], 200.0))
        plain_numbers(place.xaxis)
    for n, mark in enumerate(picture.marks):
        level_db = float(decibels(np.array([mark.loop]))[0])
        turn = float(np.interp(mark.frequency_hz, f, turned))
        if mark.is_lobe and level_db <= BOTTOM_DB:
            continue
        if mark.is_lobe:
            gain.plot(mark.frequency_hz, level_db, "o", color=_colour(n), markersize=3)
            phase.plot(mark.frequency_hz, turn, "o", color=_colour(n), markersize=3)
            name_point(gain, mark.frequency_hz, min(level_db, TOP_DB), mark.text, color=_colour(n))
        elif mark.text and abs(level_db) > 1e-6:  # a gain margin: from the curve to 0 dB
            gain.plot([mark.frequency_hz] * 2, [level_db, 0.0], color=RED, linewidth=2.0)
            name_point(gain, mark.frequency_hz, level_db, mark.text, color=RED)
        elif mark.text:  # the phase margin: from the curve to the nearest -180 deg
            nearest = 360.0 * np.round((turn + 180.0) / 360.0) - 180.0
            phase.plot([mark.frequency_hz] * 2, [turn, nearest], color=RED, linewidth=2.0)
            name_point(phase, mark.frequency_hz, nearest, mark.text, color=RED)
    label(gain, "", "|L|, dB", "Gain")
    label(phase, "frequency, Hz", "phase of L, deg", "Phase")


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
    turn, level = _turn(loop), decibels(loop)
    jump = np.flatnonzero(np.abs(np.diff(turn)) > 180.0) + 1
    return np.insert(turn, jump, np.nan), np.insert(level, jump, np.nan)


def draw_nichols(picture: LoopPicture, place: Axes, *, small: bool = False) -> None:
    """Draw the loop in the Nichols plane over M and N contours, with named lobes and margins and shaded zones.

    `small` is True for a panel among many, which names only the lobes.
    """
    level, turn = decibels(picture.loop), _turn(picture.loop)
    seen = level[picture.frequency_hz >= LOWEST_HZ]
    bottom, top = max(float(seen.min()), -40.0), min(max(float(seen.max()), 10.0) + 6.0, TOP_DB)
    for name, phase, db in contours():
        place.plot(phase, np.clip(db, bottom - 20.0, top + 20.0), color=PALE, linewidth=0.5, zorder=0.5)
        inside = np.flatnonzero((db > bottom + 1.0) & (db < top - 1.0) & (phase > -340.0) & (phase < -2.0))
        low = name.startswith("-")  # a contour of attenuation crosses the plane, others enclose -1
        whole = low or db.max() < top - 1.0
        if name and name != f"{_M_DB[-1]:g} dB" and whole and len(inside) and not small:
            k = int(inside[np.argmax(phase[inside] if low else db[inside])])
            _name_contour(place, float(phase[k]), float(db[k]), name, ha="right" if low else "center")
    for zone in picture.zones:
        _draw_zone(zone, place)
    place.grid(visible=False)
    place.axhline(0.0, color=GREY, linewidth=0.8)
    place.axvline(-180.0, color=GREY, linewidth=0.8)
    _cross(place, -180.0)
    place.plot(*_broken(turn, level)[::-1], color=BLUE, linewidth=0.9 if small else 1.3)
    place.set_xlim(-360.0, 0.0)
    place.set_xticks(range(-360, 1, 120 if small else 60))
    place.set_ylim(bottom, top)
    for n, mark in enumerate(picture.marks):
        x, y = float(_turn(np.array([mark.loop]))[0]), float(decibels(np.array([mark.loop]))[0])
        if bottom < y < top:
            _mark(place, mark, n, x, y, named=mark.is_lobe or not small)
    if not small:
        _name_frequencies(place, picture, np.stack([turn, level]))
    label(place, "phase of L, deg (mod 360)", "|L|, dB", "Nichols (grey: |T| in dB, phase of T)")


def _name_contour(place: Axes, x: float, y: float, name: str, **look: Any) -> None:
    """Write the name of a contour on it, below the curves."""
    gap = {"facecolor": "white", "edgecolor": "none", "pad": 0.5}
    place.text(x, y, name, fontsize=5.0, color=GREY, va="center", zorder=0.6, clip_on=True, bbox=gap, **look)


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
                place, float(curve[0, k]), float(curve[1, k]), f"{hz:g} Hz", must=False, color=BLUE, fontsize=5.5
            )


def _nyquist(picture: LoopPicture, place: Axes) -> None:
    """Draw the Nyquist plot.

    The radius is |L| up to 1, and r = 1 + ln |L| beyond, so that lobes of any size fit.
    """
    seen = picture.frequency_hz >= LOWEST_HZ
    curve = _drawn_in(picture.loop[seen])
    reach = max(1.5, 1.08 * float(np.abs(curve).max()))
    around = np.exp(1j * np.linspace(0.0, 2.0 * np.pi, 181))
    for level_db in (-6.0, 0.0, 10.0, 20.0, 30.0, 40.0):
        radius = float(np.abs(_drawn_in(np.array([10.0 ** (level_db / 20.0) + 0j])))[0])
        if radius < reach:
            style: dict[str, Any] = {"color": GREY, "linewidth": 0.9 if level_db == 0.0 else 0.5, "alpha": 0.8}
            place.plot(radius * around.real, radius * around.imag, zorder=0.5, **style)
            _name_contour(place, 0.0, radius, f"{level_db:g} dB", ha="center")
    place.plot(curve.real, curve.imag, color=BLUE)
    _cross(place, -1.0)
    place.set_xlim(-reach, reach)
    place.set_ylim(-reach, reach)
    for n, mark in enumerate(picture.marks):
        at = _drawn_in(np.array([mark.loop]))[0]
        if mark.is_lobe and abs(at) > 0.05:
            _mark(place, mark, n, at.real, at.imag)
    drawn = _drawn_in(picture.loop)
    _name_frequencies(place, picture, np.stack([drawn.real, drawn.imag]))
    place.set_aspect("equal")
    place.grid(visible=False)
    place.set_xticks([])
    place.set_yticks([])
    for side in place.spines.values():
        side.set_visible(False)
    label(place, title="Nyquist (log radius beyond 0 dB)")


def _cross(place: Axes, x: float) -> None:
    """Draw the critical point as a text, so that the names of points avoid it."""
    place.text(x, 0.0, "+", color=RED, fontsize=15, fontweight="bold", ha="center", va="center_baseline")


def _mark(place: Axes, mark: Mark, n: int, x: float, y: float, *, named: bool = True) -> None:
    colour = _colour(n) if mark.is_lobe else BLACK
    if mark.text:  # a crossing that sets no margin has none
        place.plot(x, y, "o" if mark.is_lobe else "x", color=colour, markersize=3.5)
    if named and mark.text:
        name_point(place, x, y, mark.text, color=colour, fontsize=6.0)


def _draw_zone(zone: Zone, place: Axes) -> None:
    gain, phase = zone.gain_db, zone.phase_deg
    style: dict[str, Any] = {"facecolor": RED, "alpha": 0.15, "edgecolor": RED}
    if zone.shape == "ellipse":
        place.add_patch(Ellipse((-180.0, 0.0), 2.0 * phase, 2.0 * gain, **style))
    elif zone.shape == "diamond":
        corners = [(-180.0 - phase, 0.0), (-180.0, gain), (-180.0 + phase, 0.0), (-180.0, -gain)]
        place.add_patch(Polygon(corners, closed=True, **style))
    else:
        place.add_patch(Rectangle((-180.0 - phase, -gain), 2.0 * phase, 2.0 * gain, **style))


def _colour(n: int) -> str:
    return ON_LIGHT[1:][n % (len(ON_LIGHT) - 1)]


def _turn(loop: ComplexArray) -> Array:
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
