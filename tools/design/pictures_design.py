"""Pictures of gains and filters, of one design or of several beside each other: the paper's Figs 7 to 9, 11 to 14."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes

from maxq.control.filters import BendingFilter, DiscreteFilter
from maxq.sim.packing.computer import bending_filter
from maxq.sim.scenario.schema_design import Design
from maxq.tools.plots.palette import BLACK, GREY
from maxq.tools.plots.style import MARKERS, curve, label, plain_numbers, save, sheet

LOWEST_HZ, HIGHEST_HZ = 0.1, 100.0


def gains(designs: Mapping[str, Design], stem: Path, until_s: float | None = None) -> list[Path]:
    """Figs 7, 11, 13: k_p and k_d over time, a point where the table has a row; held before and after it."""
    figure, places = sheet(1, 2, height_in=2.8)
    for k, (name, design) in enumerate(designs.items()):
        axes = [("", design.gains.table)]
        if design.gains.yaw_table is not None:
            axes = [(", pitch", design.gains.table), (", yaw", design.gains.yaw_table)]
        for n, (axis, table) in enumerate(axes):
            time_s = np.asarray(table["time_s"])
            end_s = max(until_s or time_s[-1], time_s[-1])
            for place, column in zip(places, ("k_p", "k_d_s"), strict=True):
                style = curve(k + n)
                line = np.append(np.asarray(table[column]), table[column][-1])
                place.plot(np.append(time_s, end_s), line, **style, label=f"{name}{axis}")
                place.plot(time_s, table[column], MARKERS[k % len(MARKERS)], color=style["color"], markersize=3)
    for place, text in zip(places, (r"$k_P$, rad/rad", r"$k_D$, s"), strict=True):
        place.set_ylim(bottom=0.0)
        label(place, "time, s", text)
    if len(designs) > 1 or any(d.gains.yaw_table is not None for d in designs.values()):
        places[0].legend()
    return save(figure, stem)


def filters(
    designs: Mapping[str, Design],
    stem: Path,
    sample_s: float,
    modes_hz: Mapping[str, tuple[float, float]] | None = None,
) -> list[Path]:
    """Figs 8, 12, 14: Bode plot of the bending filters; thick the discrete filter that flies, thin the continuous one.

    `modes_hz`: bands through which bending frequencies wander in flight, shaded.
    """
    figure, places = sheet(2, 1, height_in=2.2)
    nyquist_hz = 0.5 / sample_s
    for low_hz, high_hz in (modes_hz or {}).values():
        for place in places:
            place.axvspan(low_hz, high_hz, color=GREY, alpha=0.18, linewidth=0)
    for k, (name, design) in enumerate(designs.items()):
        continuous = bending_filter(design)
        discrete = continuous.discretize(sample_s, design.filter.discretization, design.filter.prewarp_hz)
        _bode(places, continuous, HIGHEST_HZ, curve(k) | {"linewidth": 0.6, "alpha": 0.8})
        _bode(places, discrete, nyquist_hz, curve(k) | {"label": name})
    for name, (low_hz, high_hz) in (modes_hz or {}).items():
        places[0].annotate(
            name, (np.sqrt(low_hz * high_hz), 1.0), xycoords=("data", "axes fraction"),
            ha="center", va="bottom", fontsize=7, color=BLACK,
        )  # fmt: skip
    for place in places:
        place.set_xscale("log")
        place.set_xlim(LOWEST_HZ, HIGHEST_HZ)
        plain_numbers(place.xaxis)
        place.axvline(nyquist_hz, color=GREY, linewidth=0.8, linestyle=":")
    low_db, high_db = places[0].get_ylim()
    places[0].set_ylim(max(low_db, -60.0), high_db)
    label(places[0], y="gain, dB")
    label(places[1], "frequency, Hz (dotted: half the sample rate)", "phase, deg")
    if len(designs) > 1:
        places[1].legend(loc="lower left")
    return save(figure, stem)


def _bode(
    places: Sequence[Axes], flt: BendingFilter | DiscreteFilter, until_hz: float, style: Mapping[str, Any]
) -> None:
    frequency_hz = np.geomspace(LOWEST_HZ, until_hz * (1 - 1e-6), 1200)
    response = flt.frequency_response(2 * np.pi * frequency_hz)
    with np.errstate(divide="ignore"):
        places[0].plot(frequency_hz, 20 * np.log10(np.abs(response)), **style)
    places[1].plot(frequency_hz, np.degrees(np.unwrap(np.angle(response))), **style)


def peaks_over_order(series: Mapping[str, Mapping[str, float]], stem: Path, title: str = "") -> list[Path]:
    """Fig. 9: worst first-mode peak of each design over the filter's structure; `series`: name -> structure -> dB."""
    structures = sorted({structure for each in series.values() for structure in each})
    figure, (place,) = sheet(1, 1, height_in=3.2)
    for k, (name, each) in enumerate(series.items()):
        at = [structures.index(structure) for structure in each]
        place.plot(at, list(each.values()), marker=MARKERS[k % len(MARKERS)], **curve(k), label=name)
    place.set_xticks(range(len(structures)), structures)
    label(place, "filter", "largest first-mode peak, dB", title)
    place.legend(loc="center left", bbox_to_anchor=(1.0, 0.5))
    return save(figure, stem)
