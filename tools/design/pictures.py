"""The pictures of a design: their file names, and the functions that draw them. Figure numbers are those of the
paper.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from maxq.control.filters import BendingFilter, DiscreteFilter
from maxq.control.kernel.records import Array
from maxq.design.model.node import Node
from maxq.design.verify.judging import JudgedLoop, Wanted
from maxq.sim.packing.computer import bending_filter
from maxq.sim.scenario.schema_design import Design
from maxq.tools.design.open_loop import picture_of
from maxq.tools.design.pictures_loop import draw_loop
from maxq.tools.design.report import GAIN_HEADS
from maxq.tools.plots.palette import BLACK, BLUE, GREY, RED
from maxq.tools.plots.style import MARKERS, curve, drawing, label, plain_numbers, save, sheet

_DERIVATIVES = {
    "z_alpha_1ps": r"$Z_\alpha$, 1/s",
    "m_alpha_1ps2": r"$M_\alpha$, 1/s$^2$",
    "z_delta_1ps": r"$Z_\delta$, 1/s",
    "m_delta_1ps2": r"$M_\delta$, 1/s$^2$",
    "m_q_1ps": r"$M_q$, 1/s",
}


def derivatives(nodes: Sequence[Node], title: str = "") -> Figure:
    """Draw Fig. 4: the stability derivatives (eqs 4 to 8) over time."""
    time_s = [node.time_s for node in nodes]
    values = [node.derivatives for node in nodes]
    figure, places = sheet(2, 3, height_in=2.0, title=title)
    for place, (key, name) in zip(places, _DERIVATIVES.items(), strict=False):
        place.plot(time_s, [getattr(v, key) for v in values], color=BLUE)
        label(place, "time, s", name)
    places[-1].axis("off")
    return figure


def bending_frequencies(nodes: Sequence[Node], title: str = "") -> Figure:
    """Draw Fig. 5: the frequencies of the free-free modes, uncoupled."""
    time_s, modes_hz = [node.time_s for node in nodes], bending_hz(nodes)
    figure, (place,) = sheet(1, 1, height_in=2.8, title=title)
    for i, hz in enumerate(modes_hz):
        place.plot(time_s, hz, **curve(i), label=f"mode {i + 1}")
    sampled_hz = 0.5 / nodes[0].instruments.sample_s
    if len(modes_hz) and np.nanmax(modes_hz) > sampled_hz / 2:
        place.axhline(sampled_hz, color=GREY, linewidth=0.8, linestyle=":", label="half the sample rate")
    place.set_ylim(bottom=0.0)
    label(place, "time, s", "frequency, Hz")
    if len(modes_hz):
        place.legend(loc="center left", bbox_to_anchor=(1.0, 0.5))
    return figure


def bending_hz(nodes: Sequence[Node]) -> Array:
    """Return the frequencies of the free-free modes (Hz), (modes, nodes), NaN where a node has fewer modes."""
    omega = [node.vehicle.omega_radps for node in nodes]
    return np.array([[_entry(own, i) for own in omega] for i in range(max(map(len, omega)))]) / (2.0 * np.pi)


def slosh_frequencies(nodes: Sequence[Node], tanks: Sequence[str], title: str = "") -> Figure:
    """Draw Fig. 6: the uncoupled frequencies of the liquids' pendulums, and their masses."""
    time_s = [node.time_s for node in nodes]
    figure, places = sheet(1, 2, height_in=2.6, title=title)
    for k, name in enumerate(tanks):
        hz, share = [], []
        for node in nodes:
            bobs = node.vehicle.pendulums
            load = node.axial_load_mps2
            hz.append(np.sqrt(max(load, 0.0) / _entry(bobs.length_m, k)) / (2.0 * np.pi))
            share.append(100.0 * _entry(bobs.mass_kg, k) / node.vehicle.total_mass_kg)
        places[0].plot(time_s, hz, **curve(k), label=name)
        places[1].plot(time_s, share, **curve(k), label=name)
    for place in places:
        place.set_ylim(bottom=0.0)
    label(places[0], "time, s", "frequency, Hz")
    label(places[1], "time, s", "sloshing mass, % of the vehicle")
    if tanks:
        places[0].legend()
    return figure


def _entry(values: np.ndarray, i: int) -> float:
    """Return the value for mode or tank `i` of a vehicle, or NaN, which is not drawn, if there are fewer."""
    return float(values[i]) if i < len(values) else float("nan")


LOWEST_HZ, HIGHEST_HZ = 0.1, 100.0
AXIS_OF = {
    "time_s": "time, s",
    "speed_mps": "speed, m/s",
    "mass_kg": "mass, kg",
    "dynamic_pressure_Pa": "q, Pa",
    "k_p": r"$k_P$, rad/rad",
    "k_d_s": r"$k_D$, s",
    "k_i_ps": r"$k_I$, 1/s",
    "k_a_s2pm": r"$k_A$, s$^2$/m",
    "k_alpha": r"$k_\alpha$, rad/rad",
    "percussion_m": "lever of the centre of percussion, m",
    "accel_per_incidence_mps2": r"acceleration per angle of attack, m/s$^2$",
}


def gains(designs: Mapping[str, Design], title: str = "") -> Figure:
    """Draw Figs 7, 11, 13: the gains over time, with a point at each row of the table."""
    names = max((design.gain_names for design in designs.values()), key=len)
    figure, places = sheet(1, len(names), height_in=2.8, title=title)
    for k, (name, design) in enumerate(designs.items()):
        axes = [("", design.gains.table)]
        if design.gains.yaw_table is not None:
            axes = [(", pitch", design.gains.table), (", yaw", design.gains.yaw_table)]
        for n, (axis, table) in enumerate(axes):
            for place, column in zip(places, design.gain_names, strict=False):
                style = curve(k + n)
                mark = {"marker": MARKERS[k % len(MARKERS)], "markersize": 3}
                place.plot(table[design.gains.over], table[column], **style, **mark, label=f"{name}{axis}")
    over = {AXIS_OF[design.gains.over] for design in designs.values()}
    for place, name in zip(places, names, strict=False):
        place.set_ylim(bottom=0.0)
        label(place, ", ".join(sorted(over)), AXIS_OF.get(name) or GAIN_HEADS[name])
    if len(designs) > 1 or any(d.gains.yaw_table is not None for d in designs.values()):
        places[0].legend()
    return figure


def filters(designs: Mapping[str, Design], nodes: Sequence[Node], title: str = "") -> Figure:
    """Draw Figs 8, 12, 14: the Bode plot of the bending filters.

    Thick curves show the discrete filter as flown, thin curves the continuous filter. The last filter of a schedule is
    paler than the first. Shaded areas are the bands of the bending frequencies over the operating points.
    """
    figure, places = sheet(2, 1, height_in=2.2, title=title)
    sample_s = nodes[0].instruments.sample_s
    nyquist_hz, bands_hz = 0.5 / sample_s, [(np.nanmin(hz), np.nanmax(hz)) for hz in bending_hz(nodes)]
    for low_hz, high_hz in bands_hz:
        for place in places:
            place.axvspan(low_hz, high_hz, color=GREY, alpha=0.18, linewidth=0)
    for k, (name, design) in enumerate(designs.items()):
        flown = bending_filter(design)
        for n, continuous in enumerate(flown.filters if not flown.moves else (flown.filters[0], flown.filters[-1])):
            discrete = continuous.discretize(sample_s, design.filter.discretization, design.filter.prewarp_hz)
            _bode(places, continuous, HIGHEST_HZ, curve(k) | {"linewidth": 0.6, "alpha": 0.8})
            _bode(places, discrete, nyquist_hz, curve(k) | ({"label": name} if n == 0 else {"alpha": 0.5}))
    for n, (low_hz, high_hz) in enumerate(bands_hz, 1):
        middle_hz = np.sqrt(low_hz * high_hz)
        places[0].annotate(
            f"{n}" if n > 1 else "mode 1",
            (middle_hz, 1.0),
            xycoords=("data", "axes fraction"),
            ha="center",
            va="bottom",
            fontsize=7,
            color=BLACK,
        )
    for place in places:
        place.set_xscale("log")
        place.set_xlim(LOWEST_HZ, HIGHEST_HZ)
        plain_numbers(place.xaxis)
        place.axvline(nyquist_hz, color=GREY, linewidth=0.8, linestyle=":")
    low_db, high_db = places[0].get_ylim()
    places[0].set_ylim(max(low_db, -60.0), high_db)
    label(places[0], y="gain, dB")
    label(
        places[1],
        "frequency, Hz (thick: as it flies, sampled; thin: continuous; dotted: half the sample rate)",
        "phase, deg",
    )
    if len(designs) > 1:
        places[1].legend(loc="lower left")
    return figure


def _bode(
    places: Sequence[Axes], flt: BendingFilter | DiscreteFilter, until_hz: float, style: Mapping[str, Any]
) -> None:
    frequency_hz = np.geomspace(LOWEST_HZ, until_hz * (1 - 1e-6), 1200)
    response = flt.frequency_response(2 * np.pi * frequency_hz)
    with np.errstate(divide="ignore"):
        places[0].plot(frequency_hz, 20 * np.log10(np.abs(response)), **style)
    places[1].plot(frequency_hz, np.degrees(np.unwrap(np.angle(response))), **style)


def peaks_over_order(series: Mapping[str, Mapping[str, float]]) -> Figure:
    """Draw Fig. 9: the worst first-mode peak of each design over the structure of the filter.

    `series` maps the name of a design to its peaks (dB) by structure.
    """
    structures = sorted({structure for each in series.values() for structure in each})
    figure, (place,) = sheet(1, 1, height_in=3.2, title="Peak of mode 1 by order of the filter")
    for k, (name, each) in enumerate(series.items()):
        at = [structures.index(structure) for structure in each]
        place.plot(at, list(each.values()), marker=MARKERS[k % len(MARKERS)], **curve(k), label=name)
    place.set_xticks(range(len(structures)), structures)
    label(place, "filter", "largest first-mode peak, dB")
    place.legend(loc="center left", bbox_to_anchor=(1.0, 0.5))
    return figure


def margins_over_time(judged: Sequence[JudgedLoop], wanted: Wanted, title: str = "") -> Figure:
    """Draw the gain, phase and delay margins and the least |1 + L| over time, with dotted limits.

    An unstable loop has no margin and is marked by a cross at the bottom.
    """
    figure, places = sheet(2, 2, height_in=2.5, title=title)
    time_s, measured = [j.time_s for j in judged], [j.margins for j in judged]
    modulus_db = wanted.constant("modulus_db")
    least = None if modulus_db is None else 10.0 ** (modulus_db / 20.0)
    curves: tuple[tuple[int, str, list[float], float | None], ...] = (
        (0, "gain margins, dB", [m.gain_up_db.value for m in measured], wanted.constant("gain_margin_db")),
        (0, "gain margins, dB", [m.gain_down_db.value for m in measured], None),
        (1, "phase margin, deg", [m.phase_deg.value for m in measured], wanted.constant("phase_margin_deg")),
        (2, "delay margin, ms", [1e3 * m.delay_s.value for m in measured], None),
        (3, "least |1 + L|", [m.modulus for m in measured], least),
    )
    for n, (at, text, values, limit) in enumerate(curves):
        name = ("upper", "lower")[n] if at == 0 else ""
        finite = np.where(np.isfinite(values), values, np.nan)
        places[at].plot(time_s, finite, marker=MARKERS[0], **curve(int(name == "lower")), label=name)
        if limit is not None:
            places[at].axhline(limit, color=RED, linewidth=0.9, linestyle=":", label="limit")
        label(places[at], "time, s", text)
    lost = [j.time_s for j in judged if not j.margins.stable]
    for place in places if lost else ():
        style = {"color": RED, "markersize": 7, "linestyle": "none", "clip_on": False}
        place.plot(lost, np.zeros(len(lost)), "x", transform=place.get_xaxis_transform(), **style)
    for place in places:
        place.set_ylim(0.0, 1.06 * place.get_ylim()[1])
        if any(not text.startswith("_") for text in place.get_legend_handles_labels()[1]):
            place.legend(loc="upper right", ncols=3)
            place.set_ylim(top=1.3 * place.get_ylim()[1])
    return figure


def lobes_over_time(judged: Sequence[JudgedLoop], wanted: Wanted, title: str = "") -> Figure:
    """Draw the peak of every lobe over time. Filled marks are phase-stabilised, hollow marks gain-stabilised."""
    labels = list(dict.fromkeys(lobe.label for j in judged for lobe in j.lobes))
    figure, (place,) = sheet(1, 1, height_in=3.2, title=title)
    place.axhline(0.0, color=GREY, linewidth=0.8)
    for k, name in enumerate(labels):
        found = [(j.time_s, lobe) for j in judged for lobe in j.lobes if lobe.label == name]
        style = curve(k)
        shown = name.replace("bending", "mode")
        place.plot([t for t, _ in found], [lobe.peak_db for _, lobe in found], **style, label=shown)
        for how in ("phase", "gain"):
            some = [(t, lobe.peak_db) for t, lobe in found if lobe.stabilised == how]
            face = style["color"] if how == "phase" else "white"
            marks = {"color": style["color"], "markerfacecolor": face, "linestyle": "none"}
            place.plot([t for t, _ in some], [db for _, db in some], MARKERS[k % len(MARKERS)], **marks)
    for limit in map(wanted.constant, ("first_mode_db", "second_mode_db")):
        if limit is not None:
            place.axhline(limit, color=RED, linewidth=0.9, linestyle=":")
    label(place, "time, s", "peak of |L|, dB (hollow: gain-stabilised)")
    if labels:
        place.legend(loc="center left", bbox_to_anchor=(1.0, 0.5))
    return figure


Sheet = tuple[str, Callable[[], Figure]]
"""The file name of a picture without suffix, and the function that draws it."""


def draw_all(
    sheets: Sequence[Sheet],
    folder: Path,
    tell: Callable[[str, int, int], None],
    stop: Callable[[], bool] = lambda: False,
) -> list[Path]:
    """Draw and save pictures until `stop` returns True. Return the paths of the files.

    `tell` receives the name of the activity, the pictures done, and their number.
    """
    files: list[Path] = []
    with drawing():
        for n, (stem, draw) in enumerate(sheets):
            if stop():
                break
            tell("drawing", n, len(sheets))
            files += save(draw(), folder / stem)
    return files


def judged_sheets(judged: Sequence[JudgedLoop], title: str, wanted: Wanted) -> list[Sheet]:
    """Return the sheets of margins and lobes over time, and of Bode, Nichols and Nyquist plots at every operating
    point.
    """
    over_time: list[Sheet] = [
        ("margins", lambda: margins_over_time(judged, wanted, f"Margins: {title}, {judged[0].node.plane}")),
        ("lobes", lambda: lobes_over_time(judged, wanted, f"Lobes: {title}, {judged[0].node.plane}")),
    ]
    return [
        *(over_time if len(judged) > 1 else ()),
        *((f"loop-{_stamp(j.time_s)}", partial(loop_picture, j, title, wanted)) for j in judged),
    ]


def loop_picture(judged: JudgedLoop, title: str, wanted: Wanted) -> Figure:
    """Draw the Bode, Nichols and Nyquist plots of one operating point.

    The zone drawn is the required zone or, without a requirement, the zones whose clearance was measured.
    """
    zones = (wanted.zone,) if wanted.zone is not None else tuple(c.zone for c in judged.margins.clearances)
    return draw_loop(picture_of(judged, f"{title}, {judged.node.plane}, {judged.time_s:g} s", zones))


def case_sheets(
    name: str, design: Design, nodes: Sequence[Node], along: Sequence[Node], tanks: Sequence[str], vehicle: str = ""
) -> list[Sheet]:
    """Return the sheets of a design: its gains, its filter, and the derivatives and frequencies of its vehicle.

    The filter is drawn over the modes at `nodes`. `along` contains the operating points for curves over time.
    """
    sheets: list[Sheet] = [("vehicle-derivatives", lambda: derivatives(along, f"Stability derivatives: {vehicle}"))]
    if any(len(node.vehicle.omega_radps) for node in along):
        sheets.append(("vehicle-bending", lambda: bending_frequencies(along, f"Bending, free-free: {vehicle}")))
    if tanks:
        sheets.append(("vehicle-slosh", lambda: slosh_frequencies(along, tanks, f"Slosh: {vehicle}")))
    return [
        *sheets,
        ("gains", lambda: gains({name: design}, f"Gains: {name}")),
        ("filter", lambda: filters({name: design}, nodes, f"Bending filter: {name}")),
    ]


def order_sheets(
    series: Mapping[str, Mapping[str, float]], designs: Mapping[str, Mapping[str, Design]], nodes: Sequence[Node]
) -> list[Sheet]:
    """Return the sheets of --orders: the peaks over the filter's order, and the gains and filters for each schedule.

    `series` maps schedule and structure to a peak (dB); `designs` maps them to a design.
    """
    return [
        ("orders-peaks", partial(peaks_over_order, series)),
        *((f"orders-gains-{schedule}", partial(gains, each)) for schedule, each in designs.items()),
        *((f"orders-filters-{schedule}", partial(filters, each, nodes)) for schedule, each in designs.items()),
    ]


def _stamp(time_s: float) -> str:
    """Return a time for the name of a file, such that names sort by time: 005.0s, 040.0s."""
    return f"{time_s:05.1f}s" if round(time_s, 1) == round(time_s, 9) else f"{time_s:08.4f}s"
