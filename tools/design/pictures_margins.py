"""Pictures of margins and lobes over the flight."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes

from maxq.design.verify.judging import Judged, Wanted
from maxq.tools.plots.palette import GREY, RED
from maxq.tools.plots.style import MARKERS, curve, label, save, sheet


def margins_over_time(designs: Mapping[str, Sequence[Judged]], wanted: Wanted, stem: Path) -> list[Path]:
    """Gain up and down, phase, delay and the least |1 + L| of one design or several; limits dotted.

    An unstable loop has no margin: a cross at the bottom.
    """
    figure, places = sheet(2, 2, height_in=2.5)
    for k, (name, judged) in enumerate(designs.items()):
        time_s = [j.time_s for j in judged]
        gain_up = [j.margins.gain_up_db.value for j in judged]
        gain_down = [j.margins.gain_down_db.value for j in judged]
        phase = [j.margins.phase_deg.value for j in judged]
        delay = [1e3 * j.margins.delay_s.value for j in judged]
        modulus = [20.0 * np.log10(j.margins.modulus) for j in judged]
        one = len(designs) == 1
        _line(places[0], time_s, gain_up, k, f"{name}{', ' if name else ''}up")
        down = {"linestyle": ":"} if not one else curve(1)
        _line(places[0], time_s, gain_down, k, f"{name}{', ' if name else ''}down", down)
        for place, values in zip(places[1:], (phase, delay, modulus), strict=True):
            _line(place, time_s, values, k, name)
        lost = [j.time_s for j in judged if not j.margins.stable]
        for place in places if lost else ():
            style = {"color": RED, "markersize": 7, "linestyle": "none", "clip_on": False}
            place.plot(lost, np.zeros(len(lost)), "x", transform=place.get_xaxis_transform(), **style)
    for place, limit in zip(
        places, (wanted.gain_margin_db, wanted.phase_margin_deg, None, wanted.modulus_db), strict=True
    ):
        if limit is not None:
            place.axhline(limit, color=RED, linewidth=0.9, linestyle=":")
    names = ("gain margins, dB", "phase margin, deg", "delay margin, ms", "least |1 + L|, dB")
    for place, text in zip(places, names, strict=True):
        label(place, "time, s", text)
    for place in places[:3]:
        place.set_ylim(bottom=0.0)
    places[0].legend()
    return save(figure, stem)


def lobes_over_time(judged: Sequence[Judged], wanted: Wanted, stem: Path) -> list[Path]:
    """Peak of every lobe; filled marks are phase-stabilised, hollow ones gain-stabilised."""
    labels = list(dict.fromkeys(lobe.label for j in judged for lobe in j.lobes))
    figure, (place,) = sheet(1, 1, height_in=3.2)
    place.axhline(0.0, color=GREY, linewidth=0.8)
    for k, name in enumerate(labels):
        found = [(j.time_s, lobe) for j in judged for lobe in j.lobes if lobe.label == name]
        style = curve(k)
        place.plot([t for t, _ in found], [lobe.peak_db for _, lobe in found], **style, label=name)
        for how in ("phase", "gain"):
            some = [(t, lobe.peak_db) for t, lobe in found if lobe.stabilised == how]
            face = style["color"] if how == "phase" else "white"
            marks = {"color": style["color"], "markerfacecolor": face, "linestyle": "none"}
            place.plot([t for t, _ in some], [db for _, db in some], MARKERS[k % len(MARKERS)], **marks)
    for limit in (wanted.first_mode_db, wanted.second_mode_db):
        if limit is not None:
            place.axhline(limit, color=RED, linewidth=0.9, linestyle=":")
    label(place, "time, s", "peak of |L|, dB (hollow: gain-stabilised)")
    if labels:
        place.legend(loc="center left", bbox_to_anchor=(1.0, 0.5))
    return save(figure, stem)


def _line(
    place: Axes,
    time_s: Sequence[float],
    values: Sequence[float],
    k: int,
    name: str,
    more: Mapping[str, Any] | None = None,
) -> None:
    finite = np.where(np.isfinite(values), values, np.nan)
    place.plot(time_s, finite, marker=MARKERS[k % len(MARKERS)], **(curve(k) | dict(more or {})), label=name)
