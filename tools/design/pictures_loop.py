"""Pictures of one open loop: Bode, Nichols and Nyquist on a sheet, with its lobes, crossings and zones named."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse, Polygon, Rectangle

from maxq.control.kernel.records import Array
from maxq.design.margins.distances import Zone
from maxq.design.model.state_space import ComplexArray
from maxq.design.verify.judging import Judged
from maxq.tools.plots.palette import BLACK, BLUE, GREY, ON_LIGHT, RED
from maxq.tools.plots.style import label, plain_numbers, sheet

BOTTOM_DB, TOP_DB = -50.0, 50.0  # of Bode and Nichols plots, where the curve goes farther
LOWEST_HZ = 0.02


@dataclass(frozen=True)
class Mark:
    """A point of the curve with a name: the top of a lobe, or a crossing."""

    frequency_hz: float
    loop: complex
    text: str
    is_lobe: bool = True


@dataclass(frozen=True)
class LoopPicture:
    """What is drawn. Points of the curve in rising frequency, close enough to follow every resonance."""

    title: str
    frequency_hz: Array
    loop: ComplexArray
    marks: Sequence[Mark] = ()
    zones: Sequence[Zone] = ()


def picture_of(judged: Judged, title: str, zones: Sequence[Zone] = ()) -> LoopPicture:
    """The loop at a node: its lobes, and where it crosses 0 dB and the negative real axis."""
    margins, curve = judged.margins, judged.margins.curve
    f, loop = smooth(judged.loop.response, curve.frequency_hz, curve.loop)
    marks: list[Mark] = []
    for lobe in judged.lobes:
        at, text = np.array([lobe.peak_hz]), _short(lobe.label)
        if marks and abs(marks[-1].frequency_hz / lobe.peak_hz - 1.0) < 1e-3:  # two pendulums that swing as one
            text = f"{marks.pop().text}, {text}"
        marks.append(Mark(lobe.peak_hz, complex(judged.loop.response(at)[0]), text))
    gain, phase = margins.gain_crossings, margins.phase_crossings
    binding = {
        margins.gain_up_db.frequency_hz: f"{margins.gain_up_db.value:.1f} dB up",
        margins.gain_down_db.frequency_hz: f"{margins.gain_down_db.value:.1f} dB down",
        margins.phase_deg.frequency_hz: f"{margins.phase_deg.value:.0f} deg",
    }
    inner = (phase.frequency_hz >= f[0]) & (phase.frequency_hz <= f[-1])
    for crossings, chosen in ((gain, np.ones(len(gain.frequency_hz), bool)), (phase, inner)):
        for hz, value in zip(crossings.frequency_hz[chosen], crossings.loop[chosen], strict=True):
            text = f"{binding[hz]}, {hz:.3g} Hz" if hz in binding else ""
            marks.append(Mark(float(hz), complex(value), text, is_lobe=False))
    return LoopPicture(title, f, loop, marks, zones)


def _short(text: str) -> str:
    return text.replace("bending ", "mode ")


def draw_loop(picture: LoopPicture) -> Figure:
    """Bode at the left, Nichols and Nyquist at the right."""
    figure, places = sheet(2, 2, height_in=3.3, width_in=8.4)
    _bode(picture, places[0], places[2])
    draw_nichols(picture, places[1])
    _nyquist(picture, places[3])
    figure.suptitle(picture.title, fontsize=10)
    return figure


def _bode(picture: LoopPicture, gain: Axes, phase: Axes) -> None:
    f, loop = picture.frequency_hz, picture.loop
    level = _decibels(loop)
    gain.axhline(0.0, color=GREY, linewidth=0.8)
    gain.plot(f, level, color=BLUE)
    for at in (-180.0, 180.0):
        phase.axhline(at, color=GREY, linewidth=0.8)
    where, wrapped = _broken(np.degrees(np.angle(loop)), f)
    phase.plot(where, wrapped, color=BLUE)
    lobes = [mark.frequency_hz for mark in picture.marks if mark.is_lobe]
    for n, mark in enumerate(picture.marks):
        if mark.is_lobe:
            top = float(_decibels(np.array([mark.loop]))[0])
            gain.plot(mark.frequency_hz, top, "o", color=_colour(n), markersize=3)
            gain.annotate(
                mark.text, (mark.frequency_hz, min(top, TOP_DB)), xytext=(_aside(mark.frequency_hz, lobes), 5),
                textcoords="offset points", rotation=90, ha="center", va="bottom", fontsize=6.5, color=_colour(n),
            )  # fmt: skip  # seven more lines otherwise
            phase.plot(mark.frequency_hz, np.degrees(np.angle(mark.loop)), "o", color=_colour(n), markersize=3)
    seen = level[f >= LOWEST_HZ]
    gain.set_ylim(max(float(seen.min()), BOTTOM_DB), min(float(seen.max()) + 24.0, TOP_DB + 10.0))
    phase.set_ylim(-190.0, 190.0)
    phase.set_yticks(range(-180, 181, 60))
    for place in (gain, phase):
        place.set_xscale("log")
        place.set_xlim(max(f[0], LOWEST_HZ), min(f[-1], 200.0))
        plain_numbers(place.xaxis)
    label(gain, y="|L|, dB", title="Bode")
    label(phase, "frequency, Hz", "phase of L, deg")


def _aside(hz: float, lobes: Sequence[float]) -> float:
    """How far a name moves aside, in points, for that of a neighbour: the lower one to the left."""
    if any(hz < other < 1.3 * hz or (other == hz and lobes.count(hz) > 1) for other in lobes):
        return -4.0
    return 4.0 if any(other < hz < 1.3 * other for other in lobes) else 0.0


def draw_nichols(picture: LoopPicture, place: Axes) -> None:
    """The loop in the Nichols plane, with lobes and margins named and zones shaded."""
    level, turn = _decibels(picture.loop), _turn(picture.loop)
    for zone in picture.zones:
        _draw_zone(zone, place)
    place.axhline(0.0, color=GREY, linewidth=0.8)
    place.axvline(-180.0, color=GREY, linewidth=0.8)
    place.plot(-180.0, 0.0, "+", color=RED, markersize=9, markeredgewidth=1.5)
    place.plot(*_broken(turn, level)[::-1], color=BLUE)
    for n, mark in enumerate(picture.marks):
        x, y = float(_turn(np.array([mark.loop]))[0]), float(_decibels(np.array([mark.loop]))[0])
        if not BOTTOM_DB < y < TOP_DB:
            continue
        inward = -1.0 if abs(x + 180.0) > 140.0 else 1.0  # no room for a name beyond the edge
        _mark(place, mark, n, x, y, outward=(inward * (x + 180.0), 4.0 * y))
    place.set_xlim(-360.0, 0.0)
    place.set_xticks(range(-360, 1, 60))
    seen = level[picture.frequency_hz >= LOWEST_HZ]
    place.set_ylim(max(float(seen.min()), -40.0), min(max(float(seen.max()), 10.0) + 6.0, TOP_DB))
    label(place, "phase of L, deg (mod 360)", "|L|, dB", "Nichols")


def _nyquist(picture: LoopPicture, place: Axes) -> None:
    """Radius true up to 1, logarithmic beyond: r = 1 + ln|L|, so that lobes of any size stay on the page."""
    seen = picture.frequency_hz >= LOWEST_HZ
    curve = _drawn_in(picture.loop[seen])
    reach = max(1.5, 1.08 * float(np.abs(curve).max()))
    around = np.exp(1j * np.linspace(0.0, 2.0 * np.pi, 181))
    for level_db in (-6.0, 0.0, 10.0, 20.0, 30.0, 40.0):
        radius = float(np.abs(_drawn_in(np.array([10.0 ** (level_db / 20.0) + 0j])))[0])
        if radius < reach:
            style: dict[str, Any] = {"color": GREY, "linewidth": 0.9 if level_db == 0.0 else 0.5, "alpha": 0.8}
            place.plot(radius * around.real, radius * around.imag, **style)
            place.text(0.0, radius, f"{level_db:g} dB", fontsize=6, color=GREY, ha="center", va="bottom")
    place.plot(curve.real, curve.imag, color=BLUE)
    place.plot(-1.0, 0.0, "+", color=RED, markersize=9, markeredgewidth=1.5)
    for n, mark in enumerate(picture.marks):
        at = _drawn_in(np.array([mark.loop]))[0]
        if mark.is_lobe and abs(at) > 0.05:
            _mark(place, mark, n, at.real, at.imag, outward=(at.real, at.imag))
    place.set_xlim(-reach, reach)
    place.set_ylim(-reach, reach)
    place.set_aspect("equal")
    place.grid(visible=False)
    place.set_xticks([])
    place.set_yticks([])
    for side in place.spines.values():
        side.set_visible(False)
    label(place, title="Nyquist (radius beyond 0 dB logarithmic)")


def _mark(place: Axes, mark: Mark, n: int, x: float, y: float, outward: tuple[float, float]) -> None:
    colour = _colour(n)
    if not mark.is_lobe:
        place.plot(x, y, "x", color=BLACK, markersize=3.5)
        place.annotate(
            mark.text, (x, y), xytext=(4, 3), textcoords="offset points", fontsize=6, color=BLACK, clip_on=True
        )
        return
    length = float(np.hypot(*outward)) or 1.0
    shift = (14.0 * outward[0] / length, 14.0 * outward[1] / length)
    place.plot(x, y, "o", color=colour, markersize=3.5)
    place.annotate(
        mark.text, (x, y), xytext=shift, textcoords="offset points", fontsize=6.5, color=colour,
        ha="left" if shift[0] >= 0.0 else "right", va="center",
    )  # fmt: skip  # six more lines otherwise


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


def _decibels(loop: ComplexArray) -> Array:
    return np.asarray(20.0 * np.log10(np.maximum(np.abs(loop), 1e-300)))


def _turn(loop: ComplexArray) -> Array:
    """Phase in [-360, 0) degrees: -180 in the middle."""
    return np.asarray(np.degrees(np.angle(-loop)) - 180.0)


def _broken(wrapped_deg: Array, other: Array) -> tuple[Array, Array]:
    """`other` and the phase with a gap where the phase jumps round, each end drawn on to the edge."""
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


def smooth(
    response: Callable[[Array], ComplexArray], frequency_hz: Array, loop: ComplexArray
) -> tuple[Array, ComplexArray]:
    """The curve with points added until no corner is to be seen: steps of 4 degrees and 1 dB at most, above -60 dB."""
    f, values = frequency_hz, loop
    for _ in range(8):
        level = _decibels(values)
        steep = (np.abs(np.diff(np.unwrap(np.angle(values)))) > np.radians(4.0)) | (np.abs(np.diff(level)) > 1.0)
        steep &= np.maximum(level[1:], level[:-1]) > BOTTOM_DB - 10.0
        k = np.flatnonzero(steep & (np.diff(f) > 1e-9 * f[1:]))
        if not len(k):
            break
        middle = np.sqrt(f[k] * f[k + 1])
        f, values = np.insert(f, k + 1, middle), np.insert(values, k + 1, response(middle))
    return f, values
