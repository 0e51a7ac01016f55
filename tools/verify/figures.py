"""The figures of a review pack: vehicle, margins, open loops, certificate, flights, gimbal authority and slosh."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

import numpy as np

from maxq.control.kernel.records import Array
from maxq.design import operating_points
from maxq.design.certificate.certificate import NodeCertificate
from maxq.design.model.instruments import Plane
from maxq.design.quantities import MEASURED, SWEPT
from maxq.design.verify.flown import FlownResult
from maxq.design.verify.judging import JudgedLoop, judge
from maxq.design.verify.linear import MarginCase, MarginStudy, percentiles
from maxq.design.verify.names import tank_name
from maxq.design.verify.suite import LinearMargins
from maxq.design.verify.verify import Verification
from maxq.sim.campaign import analysis
from maxq.sim.campaign.read import channel_units
from maxq.sim.campaign.store import campaign_in
from maxq.sim.run.quantities import propellant_text
from maxq.tools.campaign_report import labels_of, nearest_limits, tails_of
from maxq.tools.design.figures import bode_panels, diamond, filter_plot, lobe_colours, nichols_panel, open_loop
from maxq.tools.plots import campaign as campaign_plots
from maxq.tools.plots import side_view
from maxq.tools.plots.figures import COLOURS, Panel, Plot, Series, limit, line, look, points, thinned
from maxq.tools.replay.vehicle_shape import shape_of

_MOST_VEHICLES = 100
_WORST_FLIGHTS = 6
_ALLOWED = (("dB", 0.2), ("deg", 1.5))  # differences of a certificate's lines that require no reason


def plots(found: Verification, command: str) -> list[Plot]:
    """Return all figures of a verification. `command` is the command that repeats it."""
    out = [_vehicle(found)]
    if found.scenario.design is not None:
        out.append(filter_plot(found.scenario.vehicle, found.scenario.design))
    if found.results.flights:
        out += [_flights(found), _worst_flights(found)]
    wanted = found.suite.margins
    if wanted is not None and found.scenario.design is not None:
        for name, plane, studies in _planes(found, wanted):
            out.append(_margins(studies, wanted, name, command))
            times_s = [t for m in studies for t in m.times_s]
            judged = judge(operating_points.nodes(found.scenario, times_s, plane=plane), found.scenario.design)
            out += [_bode(judged, name), _nichols(judged, wanted, name)]
    lines = [c for c in found.results.certificates if len(c.responses.lines_hz)]
    if lines:
        out.append(_certificate(lines))
    for k, _ in enumerate(found.campaigns):
        out += _campaign(found, k)
    if found.results.authority:
        out.append(_authority(found))
    if found.results.slosh:
        out.append(_slosh(found))
    return out


def _vehicle(found: Verification) -> Plot:
    vehicle, bodies = shape_of(found.scenario.vehicle), list[Series]()
    for stage in reversed(vehicle.stages):
        for booster in stage.boosters:
            y_m = booster.position_m[0]
            bodies.append(side_view.revolved(*booster.profile.T, y_m=y_m, fill="page", opacity=1.0))
        if (f := stage.fins) is not None:
            trailing = (f.tip_station_m + f.tip_chord_m, f.root_station_m + f.root_chord_m)
            bodies += side_view.fins((f.root_station_m, f.tip_station_m, *trailing), f.root_radius_m, f.tip_radius_m)
        for _, e in stage.nozzles:
            bodies.append(side_view.nozzle(e.gimbal_station_m, e.exit_station_m, e.exit_radius_m, e.offset_m[0]))
        bodies.append(side_view.revolved(*stage.profile.T, fill="page", opacity=1.0))
        for k, t in enumerate(stage.tanks):
            surface = t.bottom_station_m - float(t.level[1][0])
            name = f"{propellant_text(t.name)} at liftoff"
            for top, said, full in ((t.top_station_m, "", False), (surface, name, True)):
                bodies.append(side_view.tank([top, t.bottom_station_m], t.radius_m, said, COLOURS[k % 4], full=full))
    lowest = vehicle.stages[0]
    marks = [("gyro", lowest.gyro_station_m, "green")] if lowest.gyro_station_m is not None else []
    marks += [("gimbal", lowest.engine.gimbal_station_m, "purple")] if lowest.engine is not None else []
    first = [a for a in found.results.slosh if a.stage == 0]
    marks += [(f"CG at {a.time_s:.3g} s", a.cg_station_m, "red") for a in (*first[:1], *first[1:][-1:])]
    caption = "To scale. The shapes of nose and fins are assumed if the vehicle file does not state them."
    return side_view.figure(found.scenario.vehicle.name or "Vehicle as flown", bodies, marks, caption)


# Flights


def _peak(flight: FlownResult, names: Sequence[str]) -> float:
    return max((float(np.abs(flight.histories[n]).max(initial=0.0)) for n in names), default=0.0)


def _hardest_first(flights: Sequence[FlownResult], names: Sequence[str]) -> list[FlownResult]:
    return sorted(flights, key=lambda f: -_peak(f, names))


_SHOWN = {
    "gimbal angle": ("gimbal_pitch_angle_deg", "gimbal_yaw_angle_deg", "max_gimbal_deg"),
    "attitude error": ("error_pitch_deg", "error_yaw_deg", "max_attitude_error_deg"),
}


def _flights(found: Verification) -> Plot:
    panels = []
    for title, (pitch, yaw, metric) in _SHOWN.items():
        strain = _hardest_first(found.results.flights, (pitch, yaw))
        series = list[Series]()
        for n, f in reversed(list(enumerate(strain))):
            size = np.maximum(np.abs(f.histories[pitch]), np.abs(f.histories[yaw]))
            how = look(n) | {"width": 1.8} if n < 3 else {"colour": "grey", "width": 0.7}
            name = f.name if n < 3 else "all others"
            series.append(line(*thinned(f.time_s, size), name, who=f.name, command=f.again, **how))
        bounds = {v.bound[1] for f in found.results.flights for v in f.verdicts if v.requirement.metric == metric}
        series += [limit(bound) for bound in sorted(bounds)]
        panels.append(Panel(f"{title}, larger of pitch and yaw", series, "time, s", "deg"))
    caption = "All scenarios under thrust. The three with the largest value in each panel are named. Red: limits."
    return Plot("flights", "Scenarios", panels, caption, 2, 260)


def _worst_flights(found: Verification) -> Plot:
    """Return small multiples of the flights with the least margin to their limits."""

    def room(f: FlownResult) -> float:
        shares = [
            (v.bound[1] - v.value) / abs(v.bound[1]) * (1 if v.bound[0] == "limit" else -1)
            for v in f.verdicts
            if v.bound[1]
        ]
        return min(shares, default=math.inf) if not f.failures else -math.inf

    panels = []
    for f in sorted(found.results.flights, key=room)[:_WORST_FLIGHTS]:
        for title, (pitch, yaw, metric) in _SHOWN.items():
            axes = enumerate(((pitch, "pitch"), (yaw, "yaw")))
            series = [
                line(*thinned(f.time_s, f.histories[n]), axis, command=f.again, **look(k)) for k, (n, axis) in axes
            ]
            for v in f.verdicts:
                if v.requirement.metric == metric and abs(v.value) > 0.5 * v.bound[1]:
                    series += [limit(side * v.bound[1], note=f"{side * v.bound[1]:g}") for side in (1, -1)]
            panels.append(Panel(f"{f.name}: {title}", series, "time, s", "deg"))
    caption = "Scenarios with the least margin to any of their limits. A limit is drawn if at least half of it is used."
    return Plot("worst-flights", "Worst scenarios", panels, caption, 2, 130)


# Margins


def _planes(found: Verification, wanted: LinearMargins) -> list[tuple[str, Plane, list[MarginStudy]]]:
    """Return for each plane its name, the plane and its studies. Two planes with equal margins share an entry."""
    each = {plane: [m for m in found.results.margins if m.plane == plane] for plane in wanted.planes}
    have: list[tuple[str, Plane, list[MarginStudy]]] = [(str(plane), plane, s) for plane, s in each.items() if s]
    if len(have) == 2 and len(have[0][2]) == len(have[1][2]) and all(map(_equal, have[0][2], have[1][2])):
        return [(f"{have[0][0]}-and-{have[1][0]}", *have[0][1:])]
    return have


def _equal(one: MarginStudy, other: MarginStudy) -> bool:
    """Return True if all drawn data of two studies are equal."""
    cases = [([m.nominal], m.corners, [m.case(k) for k in range(len(m.random))]) for m in (one, other)]
    values = [
        [[[n.get(key, math.nan) for key in SWEPT] for n in c.nodes] for group in groups for c in group]
        for groups in cases
    ]
    a, b = (np.asarray(v, float) for v in values)
    return a.shape == b.shape and bool(np.allclose(a, b, rtol=1e-6, atol=1e-6, equal_nan=True))


def _margins(studies: Sequence[MarginStudy], wanted: LinearMargins, plane: str, command: str) -> Plot:
    panels, many = [], max(len(m.random) for m in studies)
    for name in SWEPT:
        title, unit = MEASURED[name].label, MEASURED[name].unit
        series, here = list[Series](), list[Series]()
        for number, m in enumerate(studies):
            times = np.array(m.times_s)

            def values(cases: Sequence[MarginCase], m: MarginStudy = m, name: str = name) -> Array:
                table = np.array([[n.get(name, math.nan) for n in c.nodes] for c in cases])
                return np.where(np.isfinite(table), table, np.nan).reshape(len(cases), len(m.times_s))

            random = [m.case(k) for k in range(min(len(m.random), _MOST_VEHICLES))]
            for cases, kind, colour in ((m.corners, "corners", "orange"), (random, "random vehicles", "grey")):
                for case, row in zip(cases, values(cases), strict=True):
                    again = f"{command} --only '{case.label}'"
                    here.append(line(times, row, kind, colour=colour, width=0.6, who=case.label, command=again))
            stage = f", {m.stage}" if m.stage else ""
            if len(m.random):
                shares = (1.0 - wanted.success, 0.1)
                rows = percentiles(m.random, name, wanted.confidence, shares)
                for share, dash, row in zip(shares, ("", "2 2"), rows, strict=True):
                    shown, text = (
                        np.where(np.isfinite(row), row, np.nan),
                        f"{100.0 * share:.3g} % of vehicles are worse",
                    )
                    here.append(line(times, shown, text, colour="purple", dash=dash, width=1.5))
            series.append(line(times, values([m.nominal])[0], f"as designed{stage}", mark="o", **look(number), width=2))
        if not any(np.isfinite(np.asarray(s["y"], float)).any() for s in series):
            continue
        bounds = []
        limited = ((wanted.nominal, "", "limit as designed"), (wanted.dispersed, "5 3", "limit of dispersed vehicles"))
        for limits, dash, text in limited:
            if (value := getattr(limits, name)) is not None:
                bounds.append(limit(value, text, dash=dash))
        panels.append(Panel(title, [*here, *series, *bounds], "time, s", unit))
    caption = "Exact sampled loop at the operating points."
    if many:
        caption += (
            f" Grey: {min(many, _MOST_VEHICLES)} of {many} vehicles with random deviations. Purple: the share of "
        )
        caption += "all such vehicles that is worse, at each operating point, with "
        caption += f"{100.0 * wanted.confidence:g} % confidence."
    if studies[0].corners:
        caption += " Orange: vehicles at the corners, all deviations at once."
    return Plot(f"margins-{plane}", f"Margins over the flight, {_titled(plane)}", panels, caption, 2, 170)


def _bode(judged: Sequence[JudgedLoop], plane: str) -> Plot:
    """Return the Bode plot at the operating point with the least |1 + L|, with its margins."""
    least = min(judged, key=lambda j: j.margins.modulus if j.margins.stable else -1.0)
    shown = open_loop(least, lobe_colours(judged))
    panels = bode_panels([shown])
    for panel in panels:
        panel.series.append(shown)
    said = f"{least.margins.modulus:.3f}" if least.margins.stable else "unstable"
    caption = (
        f"At {least.time_s:g} s, where |1 + L| of the loop as designed is least: {said}. Red: gain and phase margins."
    )
    return Plot(f"bode-{plane}", f"Open loop where it is nearest to -1, {_titled(plane)}", panels, caption, 1, 210)


def _nichols(judged: Sequence[JudgedLoop], wanted: LinearMargins, plane: str) -> Plot:
    colours, panels = lobe_colours(judged), []
    asked = wanted.nominal
    up, down, phase = asked.gain_up_db, asked.gain_down_db, asked.rigid_phase_deg
    zone = [] if up is None or phase is None else [diamond(up, up if down is None else down, phase)]
    for one in judged:
        shown = open_loop(one, colours)
        title = f"{one.time_s:.4g} s" + ("" if one.margins.stable else ", UNSTABLE")
        panels.append(nichols_panel([shown], [*zone, shown], title))
    caption = (
        "Open loop at each operating point over M contours (|T| in dB) and N contours (phase of T). "
        "Poles are named at their lobes, each in one colour throughout. Shaded: diamond whose corners are the required "
        "margins; its sides are no requirement."
    )
    return Plot(f"nichols-{plane}", f"Nichols plots, {_titled(plane)}", panels, caption, 2, 270)


def _titled(plane: str) -> str:
    return plane.replace("-", " ")


def _certificate(nodes: Sequence[NodeCertificate]) -> Plot:
    """Return the differences between flight and linear loop at all lines, with reasons for those above the
    tolerance.
    """
    panels = []
    kinds = ((True, "measured less sampled loop, converter as it flies"), (False, "the same without rounding"))
    for rounded, title in kinds:
        for n, (unit, allowed) in enumerate(_ALLOWED):
            series = list[Series]()
            for plane, colour in (("pitch", "blue"), ("yaw", "green")):
                rows = list(_lines([c for c in nodes if c.plane == plane], n, rounded=rounded))
                for name, tone, some in (
                    (plane, colour, [r for r in rows if abs(r[1]) <= allowed]),
                    ("beyond, explained", "orange", [r for r in rows if abs(r[1]) > allowed and r[2] != "unexplained"]),
                    ("unexplained", "limit", [r for r in rows if abs(r[1]) > allowed and r[2] == "unexplained"]),
                ):
                    if some:
                        ring = {"hollow": [True] * len(some)} if name == "pitch" else {}
                        x, y, reasons, names = zip(*some, strict=True)
                        series.append(points(x, y, name, colour=tone, more=reasons, names=names, size=1.6, **ring))
            series += [limit(side * allowed, "allowed without a reason") for side in (1.0, -1.0)]
            panels.append(Panel(title, series, "frequency, Hz", unit, log_x=True))
    caption = (
        "Differences at all operating points and lines. A difference beyond the band has a reason (in the data and "
        "under the pointer) or is unexplained."
    )
    return Plot("certificate", "Measured in flight against the linear loop", panels, caption, 2, 200)


def _lines(nodes: Sequence[NodeCertificate], n: int, *, rounded: bool) -> Iterator[tuple[float, float, str, str]]:
    """Yield the frequency (Hz), difference, reason and operating point of each judged line of the excitation.

    `n` is 0 for gain (dB) and 1 for phase (deg). If `rounded` is False, differences exclude the rounding of the
    converter where such values are available.
    """
    for c in nodes:
        r = c.responses
        flown, clean = ((r.difference_db, r.unrounded_db), (r.difference_deg, r.unrounded_deg))[n]
        fine, low = np.isfinite(r.unrounded.real), r.lines_hz < 2.7
        good = (r.coherence > 0.99) if rounded else (fine | low)
        values = flown if rounded else np.where(fine, clean, flown)
        for k in np.flatnonzero(good & np.isfinite(values)):
            yield float(r.lines_hz[k]), float(values[k]), str(r.reason[k]), f"{c.time_s:g} s, {c.plane}"


def _campaign(found: Verification, number: int) -> list[Plot]:
    """Return the figures of the campaign's own report. `number` is counted from 0."""
    result = found.campaigns[number]
    data = analysis.DataSet(result.folder, campaign_in(result.folder), result.runs)
    sample = analysis.sample_of(data)
    inputs = analysis.inputs_of(sample) if result.runs else {}
    drivers = [(v, analysis.drivers(sample, v.metric, inputs)) for v in nearest_limits(result.verdicts)]
    return campaign_plots.plots(
        data,
        result.verdicts,
        tails_of(data, result.verdicts),
        analysis.bands(data.folder, data.campaign),
        channel_units(data.campaign.base),
        drivers,
        inputs,
        sample,
        labels_of(data.campaign),
        f"campaign-{number + 1}-",
    )


# Gimbal and slosh


def _authority(found: Verification) -> Plot:
    every = np.array([(a.time_s, a.ratio, a.wind_mps) for a in found.results.authority])
    apart = np.flatnonzero(np.diff(every[:, 0]) > 1.5) + 1  # between stages
    times, ratio, wind = np.insert(every, apart, np.nan, axis=0).T
    shares = ((1.0, "all of the gimbal angle", ""), (0.5, "half of it", "6 3"), (0.25, "a quarter", "2 2"))
    winds = [line(times, share * wind, name, colour="limit", dash=dash) for share, name, dash in shares]
    if found.suite.wind_limit_mps is not None:
        winds.append(limit(found.suite.wind_limit_mps, "wind required", colour="ink"))
    top = min(float(np.nanmax(wind[np.isfinite(wind)], initial=10.0)), 100.0)
    panels = [
        Panel("gimbal per angle of attack, |M_alpha / M_delta|", [line(times, ratio)], "time, s", "deg/deg"),
        Panel("steady cross-wind that the gimbal trims", winds, "time, s", "m/s", y_range=(0.0, top)),
    ]
    caption = (
        "If one degree of angle of attack requires several degrees of gimbal angle, wind uses up the gimbal angle "
        "before a stability margin is lost."
    )
    return Plot("authority", "Gimbal authority", panels, caption)


def _slosh(found: Verification) -> Plot:
    stations, damping = list[Series](), list[Series]()
    for stage in sorted({a.stage for a in found.results.slosh}):
        one = list({a.time_s: a for a in found.results.slosh if a.stage == stage}.values())
        times = [a.time_s for a in one]
        low, high = [a.percussion_station_m for a in one], [a.cg_station_m for a in one]
        stations.append(
            {
                "kind": "band",
                "colour": "limit",
                "name": "between centre of percussion and CG: slosh harms",
                "x": times,
                "y": low,
                "y2": high,
                "opacity": 0.15,
            }
        )
    for n, (stage, tank) in enumerate(sorted({(a.stage, a.tank) for a in found.results.slosh})):
        mine = [a for a in found.results.slosh if (a.stage, a.tank) == (stage, tank)]
        here, name = [a.time_s for a in mine], tank_name(found.scenario.vehicle, stage, tank)
        stations.append(line(here, [a.bob_station_m for a in mine], name, **look(n)))
        damping.append(line(here, [a.needed for a in mine], f"{name}", **look(n)))
        damping.append(line(here, [a.damping for a in mine], "of the tank (thin)", **(look(n) | {"width": 0.7})))
    panels = [
        Panel("where the liquid swings", stations, "time, s", "m aft of the nose", down=True),
        Panel("damping ratio that the loop needs", damping, "time, s", ""),
    ]
    caption = "Left: bobs of the pendulums. Right: damping ratio below which slosh grows in the closed loop."
    return Plot("slosh", "Slosh", panels, caption)
