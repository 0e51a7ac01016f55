"""Pictures of a review pack, each drawn into memory as PNG."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from matplotlib.figure import Figure

from maxq.control.kernel.records import Array
from maxq.design import api
from maxq.design.verify.flown import FlownResult
from maxq.design.verify.judging import judge
from maxq.design.verify.linear import MEASURES, MarginCase, MarginStudy
from maxq.design.verify.verify import Verification, tank_name
from maxq.tools.design.pictures_loop import draw_nichols, picture_of
from maxq.tools.plots.palette import BLACK, BLUE, GREEN, GREY, ORANGE, PALE, RED
from maxq.tools.plots.style import drawing, label, plain_numbers, png, sheet

_SHOWN = ("gain_up_db", "aero_gain_db", "phase_deg", "slosh_phase_deg", "first_mode_phase_deg", "higher_modes_db")


def pictures(found: Verification) -> dict[str, bytes]:
    """All that can be drawn of what was found, by name."""
    draw: dict[str, Callable[[], Figure]] = {}
    if found.margins:
        draw["margins"] = lambda: _margins(found, [m for m in found.margins if m.plane == found.margins[0].plane])
        draw["nichols"] = lambda: _nichols(found)
    if found.certificates and any(len(c.responses.lines_hz) for c in found.certificates):
        draw["certificate"] = lambda: _certificate(found)
    if found.authority:
        draw["authority"] = lambda: _authority(found)
    if found.flights:
        draw["gimbal"] = lambda: _flights(found)
    if found.slosh:
        draw["slosh"] = lambda: _slosh(found)
    out = {}
    with drawing():
        for name, make in draw.items():
            figure = make()
            plane = f", {found.margins[0].plane}" if name in ("margins", "nichols") else ""
            of = found.scenario.design.name if found.scenario.design else found.design
            figure.suptitle(f"{found.scenario.vehicle.name}: {of}{plane}", fontsize=9, x=0.01, ha="left")
            out[name] = png(figure, dpi=150)
    return out


def _margins(found: Verification, studies: list[MarginStudy]) -> Figure:
    figure, places = sheet(3, 2, height_in=1.75, width_in=8.4)
    wanted = found.suite.margins
    assert wanted is not None
    for place, name in zip(places, _SHOWN, strict=True):
        title, unit, sense = MEASURES[name]
        for margin in studies:  # a stage each
            times, both = np.array(margin.times_s), (*margin.corners, *margin.random)
            table = _values(both, name)
            if len(table):
                known = ~np.isnan(table).all(axis=0)
                worst = np.nanmin(table[:, known], axis=0) if sense == ">=" else np.nanmax(table[:, known], axis=0)
                place.plot(times[known], worst, "s--", color=ORANGE, label=f"worst of {len(both)} dispersed")
                for row in table[:100]:
                    place.plot(times, row, color=PALE, linewidth=0.5, zorder=1)
            place.plot(times, _values([margin.nominal], name)[0], "o-", color=BLUE, label="as designed")
        for limits, style, text in ((wanted.nominal, "-", "limit"), (wanted.dispersed, "--", "limit, dispersed")):
            limit = getattr(limits, name)
            if limit is not None:
                place.axhline(limit, color=RED, linestyle=style, linewidth=1.0, label=text)
        label(place, "time, s" if name in _SHOWN[-2:] else "", unit, title)
    names = {text: handle for handle, text in zip(*places[0].get_legend_handles_labels(), strict=True)}
    figure.legend(names.values(), names.keys(), loc="outside lower center", ncols=len(names))
    return figure


def _values(cases: tuple[MarginCase, ...] | list[MarginCase], name: str) -> Array:
    table = np.array([[n.get(name, math.nan) for n in c.nodes] for c in cases])
    table[~np.isfinite(table)] = np.nan
    return table


def _nichols(found: Verification) -> Figure:
    design, wanted = found.scenario.design, found.suite.margins
    assert design is not None
    assert wanted is not None
    times_s = [t for m in found.margins if m.plane == found.margins[0].plane for t in m.times_s]
    judged = judge(api.nodes(found.scenario, times_s), design)
    columns = min(len(judged), 3)  # eleven nodes fit on a printed page
    figure, places = sheet(math.ceil(len(judged) / columns), columns, height_in=2.5, width_in=8.4)
    for place, one in zip(places, judged, strict=False):
        draw_nichols(picture_of(one, ""), place, small=True)
        label(place, title=f"{one.time_s:g} s" + ("" if one.margins.stable else ", UNSTABLE"))
    for place in places[len(judged) :]:
        place.set_axis_off()
    return figure


def _certificate(found: Verification) -> Figure:
    figure, places = sheet(2, 2, height_in=2.3, width_in=8.4)
    for c in found.certificates:
        r = c.responses
        if not len(r.lines_hz):
            continue
        fine = np.isfinite(r.unrounded.real)
        colour = BLUE if c.plane == "pitch" else GREEN
        for n, (as_flown, clean) in enumerate(((r.difference_db, r.unrounded_db), (r.difference_deg, r.unrounded_deg))):
            good = r.coherence > 0.99
            places[n].plot(r.lines_hz[good], as_flown[good], ".", color=colour, markersize=2.5, alpha=0.6)
            low = r.lines_hz < 2.7
            places[2 + n].plot(r.lines_hz[fine], clean[fine], ".", color=colour, markersize=2.5, alpha=0.6)
            places[2 + n].plot(r.lines_hz[low], as_flown[low], ".", color=colour, markersize=2.5, alpha=0.6)
    for n, (unit, limit) in enumerate((("dB", 0.2), ("deg", 1.5)) * 2):
        for side in (-limit, limit):
            places[n].axhline(side, color=RED, linewidth=0.8)
        places[n].set_ylim(-(5.0 if n < 2 else 1.5) * limit, (5.0 if n < 2 else 1.5) * limit)
        places[n].set_xscale("log")
        plain_numbers(places[n].xaxis)
        title = "measured less sampled loop, converter as it flies" if n < 2 else "the same without rounding"
        label(places[n], "frequency, Hz" if n > 1 else "", unit, title)
    return figure


def _authority(found: Verification) -> Figure:
    figure, places = sheet(1, 2, height_in=2.5, width_in=8.4)
    times = np.array([a.time_s for a in found.authority])
    places[0].plot(times, [a.ratio for a in found.authority], color=BLUE)
    label(places[0], "time, s", "deg of gimbal per deg of incidence", "|M_alpha / M_delta|")
    limit = np.array([a.wind_mps for a in found.authority])
    places[1].plot(times, limit, color=RED, label="steady cross-wind that takes all of the gimbal")
    for share in (0.5, 0.25):
        style = {0.5: "--", 0.25: ":"}[share]
        places[1].plot(
            times, share * limit, color=RED, linestyle=style, linewidth=0.9, label=f"{share:.0%} of the gimbal"
        )
    places[1].set_ylim(0.0, min(float(np.nanmax(limit[np.isfinite(limit)], initial=100.0)), 100.0))
    label(places[1], "time, s", "m/s", "gimbal authority against steady wind")
    places[1].legend()
    return figure


def _flights(found: Verification) -> Figure:
    figure, places = sheet(1, 2, height_in=2.6, width_in=8.4)
    names = (("gimbal_pitch_angle_deg", "gimbal_yaw_angle_deg"), ("error_pitch_deg", "error_yaw_deg"))
    strain = sorted(found.flights, key=lambda f: -_peak(f, names[0]))
    for place, pair, title in zip(
        places, names, ("gimbal angle, larger axis", "attitude error, larger axis"), strict=True
    ):
        for n, flight in enumerate(strain):
            size = np.maximum(*(np.abs(flight.histories[name]) for name in pair))
            tone = (BLUE, ORANGE, GREEN)[n] if n < 3 else GREY
            place.plot(
                flight.time_s, size, color=tone, linewidth=1.1 if n < 3 else 0.5, zorder=3 if n < 3 else 1,
                label=flight.name if n < 3 else None,
            )  # fmt: skip  # four more lines otherwise
        label(place, "time, s", "deg", title)
    if found.authority:
        places[0].axhline(found.authority[0].gimbal_limit_deg, color=RED, linewidth=0.9)
        places[0].set_ylim(top=1.45 * found.authority[0].gimbal_limit_deg)
    places[0].legend(loc="upper right")
    return figure


def _peak(flight: FlownResult, names: tuple[str, str]) -> float:
    return max((float(np.abs(flight.histories[n]).max(initial=0.0)) for n in names), default=0.0)


def _slosh(found: Verification) -> Figure:
    figure, places = sheet(1, 2, height_in=2.6, width_in=8.4)
    for n, stage in enumerate(sorted({a.stage for a in found.slosh})):
        one = list({a.time_s: a for a in found.slosh if a.stage == stage}.values())
        places[0].fill_between(
            [a.time_s for a in one], [a.percussion_station_m for a in one], [a.cg_station_m for a in one],
            color=RED, alpha=0.15, label=None if n else "centre of percussion to CG: slosh harms",
        )  # fmt: skip  # four more lines otherwise
    for n, (stage, tank) in enumerate(sorted({(a.stage, a.tank) for a in found.slosh})):
        mine = [a for a in found.slosh if (a.stage, a.tank) == (stage, tank)]
        tone, style = (BLUE, GREEN, ORANGE, BLACK)[n % 4], ("-", "--", ":", "-.")[n % 4]
        here, name = [a.time_s for a in mine], tank_name(found.scenario.vehicle, stage, tank)
        places[0].plot(here, [a.bob_station_m for a in mine], color=tone, linestyle=style, label=name)
        places[1].plot(here, [a.needed for a in mine], color=tone, linestyle=style, label=f"{name}, needed")
        places[1].plot(here, [a.damping for a in mine], color=tone, linestyle=style, linewidth=0.6, alpha=0.7)
    low, high = places[0].get_ylim()
    places[0].set_ylim(high + 0.4 * (high - low), low)  # aft is below, and the legend under all of it
    label(places[0], "time, s", "station, m aft of the nose", "where the liquid swings")
    label(places[1], "time, s", "damping ratio", "damping that the loop needs (thin: what the tank has)")
    places[0].legend(loc="lower left")
    places[1].legend()
    return figure
