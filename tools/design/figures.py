"""The figures of a design for the pages: open loops, limits over the flight, gains, and bending filter."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from maxq.control.kernel.records import Array
from maxq.design.certificate.response import decibels
from maxq.design.model.node import Node
from maxq.design.quantities import QUANTITIES
from maxq.design.verify.judging import Check, JudgedLoop, Wanted
from maxq.sim.packing.computer import bending_filter
from maxq.sim.scenario.schema_design import Design
from maxq.sim.scenario.schema_vehicle import Vehicle
from maxq.tools.design.open_loop import LOWEST_HZ, named, picture_of, unwrapped_deg
from maxq.tools.plots.figures import COLOURS, Panel, Plot, Series, limit, line, look, loop, points, shape, thinned

LOWEST_DB = -40.0  # lower end of the gain axis of Bode and Nichols plots
_LOWEST_HZ = 0.05  # lower end of the frequency axis of Bode plots
_ABOVE_LAST = 1.25  # end of the frequency axis / highest frequency above LOWEST_DB
_HIGHEST_DB = 50.0
_FARTHEST = 3.4  # largest radius of Nyquist plots: |L| of 21 dB
_SIGNS = {">=": "≥", "<=": "≤"}
_LEAST_SPAN = 0.01  # least span of an axis, as a share of the values
_STEPS = np.linspace(0.0, 1.0, 12, endpoint=False)[:, None]
_OUTLINE = np.radians(np.arange(0.0, 360.0, 6.0))


# Open loops


def lobe_colours(judged: Sequence[JudgedLoop]) -> dict[str, str]:
    """Return a colour for each pole with a lobe, equal at all operating points."""
    poles = sorted({named(lobe) for j in judged for lobe in j.lobes})
    return {pole: COLOURS[1:][n % (len(COLOURS) - 1)] for n, pole in enumerate(poles)}


def open_loop(judged: JudgedLoop, colours: dict[str, str], name: str = "L", **more: Any) -> Series:
    """Return the curve of the open loop at an operating point, with its lobes, margins and least |1 + L| as marks.

    `colours` are those of `lobe_colours`. `more` contains further keys of the series.
    """
    picture = picture_of(judged, "")
    f, level, phase = picture.frequency_hz, decibels(picture.loop), unwrapped_deg(picture)
    keep = np.flatnonzero(f >= LOWEST_HZ)
    keep = keep[_seen(np.log10(f[keep]), level[keep], phase[keep])]
    marks = list[Series]()

    def mark(hz: float, value: complex, what: str, text: str, colour: str) -> None:
        level_db = float(decibels(np.array([value]))[0])
        turn = float(np.interp(hz, f, phase))
        marks.append({"x": hz, "y": level_db, "y2": turn, "what": what, "name": text, "colour": colour})

    for m in picture.marks:
        if m.what != "lobe":
            if m.text:
                mark(m.frequency_hz, m.loop, m.what, m.text.split(",")[0], "limit")
        elif abs(m.loop) > 10.0 ** (LOWEST_DB / 20.0):
            mark(m.frequency_hz, m.loop, "lobe", m.text, colours[m.text.split(", ")[0]])
    hz, db, deg = (np.round(v[keep], digits) for v, digits in ((f, 5), (level, 2), (phase, 1)))
    return loop(hz, db, deg, name, marks, **more)


def _seen(decades: Array, level_db: Array, phase_deg: Array) -> Array:
    """Return the indices of the points of a curve that are visibly distinct from the previous point kept."""
    keep, last = [0], 0
    for k in range(1, len(decades)):
        step = math.hypot((phase_deg[k] - phase_deg[last]) / 1.5, (level_db[k] - level_db[last]) / 0.5)
        if step > 1.0 or decades[k] - decades[last] > 0.02 or k == len(decades) - 1:
            keep.append(k)
            last = k
    return np.array(keep)


def margins_text(judged: JudgedLoop) -> str:
    """Return the margins of a loop as one line of text."""
    m = judged.margins
    if not m.stable:
        return f"UNSTABLE: {m.unstable_poles or 'some'} unstable pole{'s' * (m.unstable_poles != 1)}"
    named = (
        ("upper gain margin", m.gain_up_db.value, "dB"),
        ("lower", m.gain_down_db.value, "dB"),
        ("phase margin", m.phase_deg.value, "deg"),
        ("delay margin", 1e3 * m.delay_s.value, "ms"),
        ("least |1 + L|", m.modulus, ""),
    )
    return ", ".join(f"{name} {value:.3g} {unit}".rstrip() for name, value, unit in named if math.isfinite(value))


def zone_of(wanted: Wanted) -> list[Series]:
    """Return the zone around -1 in the Nichols plane that the limits exclude.

    Without a required zone, it is the diamond of the gain and phase margins, or nothing if these are not both limited.
    """
    zone, gain, phase = wanted.zone, wanted.constant("gain_margin_db"), wanted.constant("phase_margin_deg")
    if zone is None:
        return [] if gain is None or phase is None else [diamond(gain, gain, phase)]
    x, y = np.cos(_OUTLINE), np.sin(_OUTLINE)
    if zone.shape != "ellipse":
        size = np.abs(x) + np.abs(y) if zone.shape == "diamond" else np.maximum(np.abs(x), np.abs(y))
        x, y = x / size, y / size
    outline = np.stack([zone.phase_deg * x - 180.0, zone.gain_db * y], 1)
    return [shape(outline, "zone of the limits", colour="limit", opacity=0.15)]


def diamond(up_db: float, down_db: float, phase_deg: float) -> Series:
    """Return the diamond in the Nichols plane whose corners are these margins."""
    corners = [(-180.0 - phase_deg, 0.0), (-180.0, -up_db), (-180.0 + phase_deg, 0.0), (-180.0, down_db)]
    return shape(corners, "diamond of the margins required", colour="limit", opacity=0.15)


def bode_panels(every: Sequence[Series]) -> list[Panel]:
    """Return empty panels for gain and phase, with axes that contain all of the loops."""
    f, level, phase = (np.concatenate([np.asarray(s[key], float) for s in every]) for key in ("x", "y", "y2"))
    drawn = f >= _LOWEST_HZ
    visible = drawn & (level > LOWEST_DB)
    visible = visible if visible.any() else drawn
    highest = min(float(f.max()), _ABOVE_LAST * float(f[visible].max()))
    reach, top = (_LOWEST_HZ, highest), min(float(level[drawn].max()) + 10.0, _HIGHEST_DB + 10.0)
    turns = (90.0 * math.floor(phase[visible].min() / 90.0), 90.0 * math.ceil(phase[visible].max() / 90.0))
    return [
        Panel("Gain |L|", [], "frequency, Hz", "dB", reach, (LOWEST_DB, max(top, 10.0)), log_x=True, plane="gain"),
        Panel("Phase of L", [], "frequency, Hz", "deg", reach, turns, log_x=True, plane="phase"),
    ]


def nichols_panel(every: Sequence[Series], zone: Sequence[Series], title: str) -> Panel:
    """Return a panel of the Nichols plane for loops, with `zone` below them."""
    top = min(max(10.0, *(float(np.max(s["y"])) for s in every)) + 4.0, _HIGHEST_DB)
    return Panel(title, list(zone), "phase of L, deg", "|L|, dB", (-360.0, 0.0), (LOWEST_DB, top), plane="nichols")


def limits_of_planes(wanted: Wanted) -> dict[str, list[Series]]:
    """Return the limits of a loop as series, by the plane in which they are drawn."""
    return {"nichols": zone_of(wanted), "critical": zone_near_minus_one(wanted), "distance": _least(wanted)}


def loop_panels(loops: Sequence[Series]) -> list[Panel]:
    """Return empty panels for Bode, |1 + L|, Nichols and Nyquist plots, with axes that contain all of the loops."""
    gain, phase = bode_panels(loops)
    reach = min(max(1.5, *(1.05 * _drawn_in(float(np.max(s["y"]))) for s in loops)), _FARTHEST)
    nyquist = Panel(
        "Nyquist, logarithmic beyond 0 dB",
        [],
        x_range=(-reach, reach),
        y_range=(-reach, reach),
        plane="nyquist",
        equal=True,
    )
    distance = Panel("Distance to -1", [], "frequency, Hz", "|1 + L|", gain.x_range, (0.0, 2.0), log_x=True)
    distance.plane = "distance"
    critical = Panel(
        "Nyquist near -1, to scale", [], "Re L", "Im L", (-1.6, 0.6), (-1.1, 1.1), plane="critical", equal=True
    )
    nichols = nichols_panel(loops, [], "Nichols")
    panels = [gain, phase, distance, nichols, nyquist, critical]
    for panel, height in zip(panels, (258, 258, 258, 258, 275, 260), strict=True):
        panel.height = height
    return panels


def explorer(
    judged: Sequence[JudgedLoop], names: Sequence[str], wanted: Sequence[Wanted], planes: Sequence[str]
) -> Plot:
    """Return Bode, |1 + L|, Nichols and Nyquist plots of the open loop, with a slider over operating points.

    Args:
        judged: loops, in the order of the slider.
        names: the name of each operating point.
        wanted: the limits at each operating point.
        planes: the name of the plane of each loop. The reader chooses a plane.
    """
    colours = lobe_colours(judged)
    size = [j.margins.modulus if j.margins.stable else -1.0 for j in judged]
    loops = [
        open_loop(
            j,
            colours,
            name,
            group=plane,
            at=j.time_s,
            text=margins_text(j),
            first=size[n] == min(size),
            limits=limits_of_planes(limits),
        )
        for n, (j, name, limits, plane) in enumerate(zip(judged, names, wanted, planes, strict=True))
    ]
    panels = loop_panels(loops)
    slider = "The slider chooses the operating point; left and right arrow keys move it. " if len(judged) > 1 else ""
    caption = (
        f"{slider}Red: the gain and phase margins, and the least |1 + L|. Nichols: over contours of |T| in dB and of "
        "the phase of T. Nyquist: the radius is |L| up to 1 (0 dB) and 1 + ln |L| beyond; near -1, L is to scale."
    )
    return Plot("loop", "Open loop", panels, caption, 2, 175, loops=loops, split=3)


def zone_near_minus_one(wanted: Wanted) -> list[Series]:
    """Return the zone of the Nichols plane in the plane of L, where |1 + L| is to scale."""
    out = []
    for zone in zone_of(wanted):
        corners = np.stack([zone["x"], zone["y"]], axis=1)
        outline = np.concatenate([a + (b - a) * _STEPS for a, b in zip(corners, np.roll(corners, -1, 0), strict=True)])
        size, angle = 10.0 ** (outline[:, 1] / 20.0), np.radians(outline[:, 0])
        out.append(zone | {"x": size * np.cos(angle), "y": size * np.sin(angle)})
    return out


def _least(wanted: Wanted) -> list[Series]:
    least_db = wanted.constant("modulus_db")
    return [] if least_db is None else [limit(10.0 ** (least_db / 20.0))]


def _drawn_in(level_db: float) -> float:
    size = 10.0 ** (level_db / 20.0)
    return 1.0 + math.log(size) if size > 1.0 else size


# Limits


def is_stability(check: Check) -> bool:
    """Return True for a check of stability alone, which has no margin."""
    return check.key.endswith(("unstable_poles", "unstable")) or check.key.startswith("total_")


def relative_margin(check: Check) -> Array:
    """Return the margin of each value to its limit as a share of the limit: 0 at the limit, NaN for a limit of zero."""
    bound = np.broadcast_to(np.asarray(check.limit, float), check.values.shape)
    left = check.values - bound if check.sense == ">=" else bound - check.values
    return np.asarray(np.divide(left, np.abs(bound), out=np.full(len(left), np.nan), where=bound != 0.0))


def limits_over_flight(checks: Sequence[Check]) -> list[Plot]:
    """Return figures of the margin to each limit over the flight, and of each limited quantity with its limit."""
    held = [c for c in checks if np.isfinite(c.time_s).all() and not is_stability(c)]
    found = [c for c in held if np.isfinite(c.values).any()]  # a vehicle without a mode has no peak for it
    if np.unique(np.concatenate([np.zeros(0), *(c.time_s for c in found)])).size < 2:  # nothing over time
        return []
    relative, apart = list[Series](), dict[str, list[Check]]()
    for c in found:
        apart.setdefault(_limited(c.key), []).append(c)
    for n, (key, some) in enumerate(apart.items()):
        own = [c for c in some if c.key == key]
        t, left = _over_time(own, [relative_margin(c) for c in own])
        if np.isfinite(left).any():
            relative.append(line(t, 100.0 * left, own[0].text, mark="o", **look(n)))
    out = []
    if relative:
        lowest = min(float(np.nanmin(np.where(np.isfinite(s["y"]), s["y"], np.nan))) for s in relative)
        reach = (min(1.1 * lowest, -5.0), 100.0)
        panel = Panel(
            "Margin to each limit", [*relative, limit(0.0, "the limit")], "time, s", "% of the limit", y_range=reach
        )
        said = "A limit is missed below 0. The axis ends at 100 %."
        out.append(Plot("utilisation", "Margin to each limit over the flight", [panel], said, 1, 260))
    panels = [_limit_panel(some) for some in apart.values()]
    caption = "Each limited quantity at the operating points. Red: its limit"
    dispersed = any(c.key.startswith("dispersed_") for c in found)
    caption += "; orange: the worst dispersed vehicles found." if dispersed else "."
    return [*out, Plot("limits", "Limits over the flight", panels, caption, 2, 170)]


def _limited(key: str) -> str:
    """Return the key of the quantity that a check limits, without the prefixes for dispersed vehicles and coupled
    axes.
    """
    plain = key.removeprefix("dispersed_")
    return next((k for k in QUANTITIES if plain.startswith("coupled_") and plain.endswith(k)), plain)


def _over_time(checks: Sequence[Check], values: Sequence[Array]) -> tuple[Array, Array]:
    """Return times and values of all checks, each check in order of time and separated from the next by NaN."""
    t, y = [np.zeros(0)], [np.zeros(0)]
    for check, some in zip(checks, values, strict=True):
        order = np.argsort(check.time_s)
        t += [check.time_s[order], np.array([np.nan])]
        y += [np.asarray(some, float)[order], np.array([np.nan])]
    return np.concatenate(t)[:-1], np.concatenate(y)[:-1]


def _limit_panel(checks: Sequence[Check]) -> Panel:
    series, own = list[Series](), [c for c in checks if _limited(c.key) == c.key]
    kinds: dict[str, tuple[str, Series]] = {
        "": ("value", {"colour": "blue", "mark": "o"}),
        "dispersed": ("worst dispersed vehicles found", {"colour": "orange"}),
    }
    for kind, (name, style) in kinds.items():
        some = [c for c in checks if c.key.startswith("dispersed_") == bool(kind) and not c.key.startswith("coupled_")]
        if some:
            t, y = _over_time(some, [c.values for c in some])
            series.append(points(t, y, name, **style) if kind else line(t, y, name, **style))
    for n, check in enumerate(c for c in checks if c.key.startswith("coupled_")):
        t, y = _over_time([check], [check.values])
        axis = check.key.split("_")[1]
        series.append(line(t, y, f"{axis}, other axes closed", **look(2 + n)))
    for check in own or checks[:1]:
        if np.ndim(check.limit):
            t, y = _over_time([check], [np.asarray(check.limit, float)])
            series.append(line(t, y, "limit", colour="limit"))
    constant = {float(np.max(c.limit)) for c in own or checks[:1] if not np.ndim(c.limit)}
    series += [limit(value, note=f"{_SIGNS[checks[0].sense]} {value:g}") for value in sorted(constant)]
    series += [
        limit(value, "limit of dispersed vehicles", dash="5 3")
        for value in sorted({float(np.max(c.limit)) for c in checks if c.key.startswith("dispersed_")} - constant)
    ]
    every = np.concatenate([np.append(c.values, c.limit) for c in checks])
    every, text, reach = every[np.isfinite(every)], (own or checks)[0].text, None
    if len(every) and np.ptp(every) < _LEAST_SPAN * abs(every[0]):  # rounding only
        reach = (every.min() - _LEAST_SPAN * abs(every[0]), every.max() + _LEAST_SPAN * abs(every[0]))
    return Panel(text[:1].upper() + text[1:], series, "time, s", checks[0].unit, y_range=reach)


# The design


def gains_plot(design: Design, heads: dict[str, str]) -> Plot:
    """Return the gain schedules, with a point at each row of a table. `heads` maps names to labels with units."""
    panels: dict[tuple[str, str], Panel] = {}
    for number in range(len(design.stage) or 1):
        own = design.of_stage(number)
        if design.stage and number and design.stage[number].gains is None:
            continue
        stage = f"stage {number + 1}" if len(design.stage) > 1 else ""
        for axis, table in (("pitch", own.gains.table), ("yaw", own.gains.yaw_table)):
            if table is None:
                continue
            plane = axis if own.gains.yaw_table is not None else ""
            for column in own.gain_names:
                key = (own.gains.over, column)
                panel = panels.setdefault(key, Panel(heads[column], [], heads[own.gains.over], y_range=(0.0, None)))
                name = ", ".join(filter(None, (stage, plane)))
                panel.series.append(
                    line(table[own.gains.over], table[column], name, mark="o", **look(len(panel.series)))
                )
    for panel in panels.values():
        if min(float(np.min(s["y"])) for s in panel.series) < 0.0:
            panel.y_range = None
    return Plot("gains", "Gain schedules", list(panels.values()), "A point at each row of the table.", 2, 180)


def filter_plot(vehicle: Vehicle, design: Design, nodes: Sequence[Node] = ()) -> Plot:
    """Return the response of each stage's bending filter, over the frequency bands of the bending modes at `nodes`."""
    gain, phase = list[Series](), list[Series]()
    for number in range(len(design.stage) or 1):
        own, computer = design.of_stage(number), vehicle.computer_of(number) or vehicle.computer
        assert computer is not None
        hz = np.geomspace(0.1, 0.5 / computer.sample_s * (1.0 - 1e-6), 500)
        flown = bending_filter(own)
        for n in range(0, len(flown.filters), max(1, len(flown.filters) - 1)):  # both ends of a schedule
            flt = flown.filters[n].discretize(computer.sample_s, own.filter.discretization, own.filter.prewarp_hz)
            response = flt.frequency_response(2.0 * np.pi * hz)
            name = f"stage {number + 1}" if design.stage else "filter"
            name += f", {own.gains.over} {flown.at[n]:g}" if flown.moves else ""
            style = look(len(gain))
            gain.append(line(*thinned(hz, 20.0 * np.log10(np.maximum(np.abs(response), 1e-3))), name, **style))
            phase.append(line(*thinned(hz, np.degrees(np.unwrap(np.angle(response)))), name, **style))
    panels = []
    for title, series, unit in (("Gain", gain, "dB"), ("Phase", phase, "deg")):
        every = np.concatenate([np.asarray(s["y"], float) for s in series])
        low, high = float(every.min()), float(every.max())
        reach = (max(low, -60.0) - 3.0, high + 3.0) if unit == "dB" else (low - 10.0, high + 10.0)
        bands = _mode_bands(nodes, *reach)
        panels.append(Panel(title, [*bands, *series], "frequency, Hz", unit, y_range=reach, log_x=True))
    caption = "The discrete filter as flown, up to half the sample rate."
    if panels[0].series[0]["kind"] == "shape":
        caption += " Grey: the frequencies of each bending mode over the flight."
    return Plot("filter", "Bending filter", panels, caption)


def _mode_bands(nodes: Sequence[Node], low: float, high: float) -> list[Series]:
    modes: dict[int, list[float]] = {}
    for node in nodes:
        for k, omega in enumerate(node.vehicle.omega_radps):
            modes.setdefault(k, []).append(float(omega) / (2.0 * math.pi))
    bands = [(0.99 * min(hz), 1.01 * max(hz)) for hz in modes.values()]  # visible at a single point, too
    outlines = [[(a, low), (b, low), (b, high), (a, high)] for a, b in bands]
    return [shape(o, "bending modes over the flight", bare=True, fill="grey", opacity=0.25) for o in outlines]
