"""The page that `simvehicle` writes: side view, masses, modes, aerodynamics, control and ascent."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from maxq.control.kernel.records import Array
from maxq.sim.run.quantities import propellant_text
from maxq.tools.pages.render import render
from maxq.tools.plots import side_view
from maxq.tools.plots.figures import COLOURS, Panel, Plot, Series, at, limit, line, look
from maxq.tools.vehicle.build import Built, burning, m_alpha_1ps2, m_delta_1ps2, on_the_pad
from maxq.tools.vehicle.layout import LayoutBooster, LayoutStage, LayoutThrust
from maxq.tools.vehicle.report import MEANINGS, notes, numbers, tables
from maxq.tools.vehicle.trajectory import TrajectoryPoint

_LIGHT_kg = 1000.0  # below this mass at liftoff, masses are in kg
_AIR_Pa = 100.0  # below this dynamic pressure, the centre of pressure is irrelevant
_TIME, _STATION = "flight time, s", "station, m aft of the nose"


_HEADS = {
    "from, kg": "mass at ignition, kg",
    "to, kg": "mass at burnout, kg",
    "burn, s": "burn time, s",
    "T/W": "thrust / weight",
    "dv, m/s": "delta-v, m/s",
    "v, m/s": "speed, m/s",
    "h, km": "altitude, km",
    "path, deg": "flight path, deg",
    "mass, kg": "generalised mass, kg",
}
"""Heads of columns on the page, which has more space than a terminal."""


def page(built: Built, outcome: str, *, passed: bool) -> str:
    """Return the page as one HTML file with all figures, tables and notes.

    `outcome` is a word in capitals, a colon and the reason.
    """
    layout, first = built.layout, built.stacks[0]
    front, rear = layout.stage[-1].front_station_m, max(s.engine.exit_station_m for s in layout.stage)
    control = [] if layout.unguided else [_control(built)]
    plots = [_vehicle(built), _masses(built), _aerodynamics(built), *control, _ascent(built)]
    if any(modes[0] for _, modes in built.modes):
        plots.append(_modes(built))
    return render(
        "vehicle.html.j2",
        plots,
        layout=layout,
        outcome_line=outcome,
        passed=passed,
        facts=(
            ("mass at liftoff", _mass_text(first.mass_properties(first.begins_s).mass_kg)),
            ("length", f"{rear - front:.4g} m"),
            ("largest diameter of the core", f"{max(s.diameter_m for s in layout.stage):.4g} m"),
        ),
        tables=[t._replace(rows=[tuple(_HEADS.get(h, h) for h in t.rows[0]), *t.rows[1:]]) for t in tables(built)],
        notes=notes(built),
        numbers=numbers,
        meanings={_HEADS.get(head, head): meaning for head, meaning in MEANINGS.items()},
    )


def _mass_text(mass_kg: float) -> str:
    return f"{mass_kg:.4g} kg" if mass_kg < _LIGHT_kg else f"{mass_kg / 1e3:.4g} t"


def _vehicle(built: Built) -> Plot:
    layout, first, burn = built.layout, built.stacks[0], built.stacks[0].burn
    bodies = list[Series]()
    for stage in layout.stage:
        bodies += stage_bodies(stage, layout.nose_length_m if stage is layout.stage[-1] else 0.0, layout.nose)
    if layout.fairing is not None:
        rear, r = layout.fairing.rear_station_m, 0.5 * layout.stage[-1].diameter_m
        bodies.append(line([rear, rear], [-r, r], "rear end of the fairing", colour="purple", dash="6 3"))
    hardest = max((p for p in burning(built) if p.number == 0), key=lambda p: p.dynamic_pressure_Pa)
    cg_m = [(name, first.mass_properties(t).x_cg_m) for name, t in (("liftoff", 0.0), ("burnout", burn.end_s))]
    marks = [] if layout.unguided else [("gyro", layout.control.gyro_station_m, "green")]
    marks += [(f"CG at {name}" + f" of {first.name}" * (name == "burnout"), station, "ink") for name, station in cg_m]
    marks.append((f"CP at Mach {hardest.mach:.1f}", built.aero[0].normal(hardest.mach)[1], "red"))
    caption = "To scale. Dark: propellant at liftoff; pale: tanks. Nozzles have the width of their exits."
    return side_view.figure(layout.name, bodies, marks, caption)


def stage_bodies(stage: LayoutStage, nose_m: float, nose: str) -> list[Series]:
    """Return the bodies of a stage to scale, with its boosters first, so that the core covers those in front and
    behind.

    `nose_m` is the length of the nose, 0 for a stage without a nose. `nose` is its shape.
    """
    r, out = 0.5 * stage.diameter_m, list[Series]()
    for booster in stage.booster:
        for y in sorted({y for y, _ in booster.positions_m}):
            own_nose_m = booster.nose_length_m or 2.0 * booster.diameter_m
            out += _nozzles(booster.engine, y)
            out.append(
                _hull(booster.front_station_m, booster.rear_station_m, 0.5 * booster.diameter_m, own_nose_m, nose, y)
            )
            out += _propellants(booster, y)
    if (f := stage.fins) is not None:
        chord = np.array([0.0, f.sweep_m, f.sweep_m + f.tip_chord_m, f.root_chord_m]) + f.leading_edge_station_m
        out += side_view.fins(chord, r, r + f.semispan_m)
    out += _nozzles(stage.engine)
    out.append(_hull(stage.front_station_m, stage.rear_station_m, r, nose_m, nose))
    return [*out, *_propellants(stage)]


def _nozzles(e: LayoutThrust, y_m: float = 0.0) -> list[Series]:
    exit_r = max(math.sqrt(e.exit_area_m2 / math.pi), 0.12 * (e.exit_station_m - e.gimbal_station_m))
    places = sorted({y for y, _ in e.positions_m})
    return [side_view.nozzle(e.gimbal_station_m, e.exit_station_m, exit_r, y_m + y) for y in places]


def _hull(front_m: float, rear_m: float, r: float, nose_m: float, nose: str, y_m: float = 0.0) -> Series:
    if not nose_m:
        return side_view.revolved([front_m, rear_m], r, y_m=y_m, fill="page", opacity=1.0)
    x = np.linspace(0.0, 1.0, 41)
    radius = r * np.append(np.sin(0.5 * math.pi * x) ** 0.9 if nose == "ogive" else x, 1.0)
    return side_view.revolved(np.append(front_m + nose_m * x, rear_m), radius, y_m=y_m, fill="page", opacity=1.0)


def _propellants(body: LayoutStage | LayoutBooster, y_m: float = 0.0) -> list[Series]:
    out = list[Series]()
    for k, t in enumerate(body.tank):
        profile = t.profile
        depth = float(profile.depth(np.array(t.liquid_mass_kg / (t.density_kgpm3 * t.radius_m**3))))
        for top, full in ((profile.height, False), (depth, True)):
            z = np.linspace(0.0, top, 81)
            place, radius = t.bottom_station_m - t.radius_m * z, t.radius_m * profile.surface_radius(z)
            name = f"{propellant_text(t.name)} at liftoff" if full else ""
            at_m = y_m + t.position_m[0]
            out.append(side_view.tank(place, radius, name, COLOURS[k % 4], full=full, y_m=at_m))
    for grain in body.grain:
        ends, r = [grain.front_station_m, grain.rear_station_m], grain.radius_m or 0.5 * body.diameter_m
        out.append(side_view.revolved(ends, r, "grain", y_m=y_m, fill="grey", opacity=0.5, bare=True))
    return out


def _of_stacks(built: Built, value: Callable[[int, float], float]) -> list[Series]:
    """Return the curve of a quantity over flight time for each stack. `value` takes the stack and the time on its
    clock, s.
    """
    out = list[Series]()
    for n, stack in enumerate(built.stacks):
        t = np.linspace(stack.begins_s, stack.end_s, 61)
        out.append(line(built.flight.begins_s[n] + t, [value(n, float(x)) for x in t], stack.name, **look(n)))
    return out


def _masses(built: Built) -> Plot:
    stacks = built.stacks
    light = stacks[0].mass_properties(stacks[0].begins_s).mass_kg < _LIGHT_kg
    scale, unit = (1.0, "kg") if light else (1e3, "t")
    mass = _of_stacks(built, lambda n, t: stacks[n].mass_properties(t).mass_kg / scale)
    cg = _of_stacks(built, lambda n, t: stacks[n].mass_properties(t).x_cg_m)
    inertia = _of_stacks(built, lambda n, t: stacks[n].mass_properties(t).pitch_kgm2 / scale)
    for n, stack in enumerate(stacks):
        times_s = np.array([stack.begins_s, stack.end_s])
        roll = [stack.mass_properties(t).roll_kgm2 / scale for t in times_s]
        inertia.append(line(built.flight.begins_s[n] + times_s, roll, "roll" * (n == 0), colour="grey", dash="2 2"))
    panels = [
        Panel("mass", mass, _TIME, unit, y_range=(0.0, None)),
        Panel("centre of gravity", cg, _TIME, "m aft of the nose"),
        Panel("moments of inertia", inertia, _TIME, f"{unit} m2", log_y=True),
    ]
    return Plot("masses", "Masses", panels, "The whole vehicle; grey: moment of inertia about the axis.", 3)


def _modes(built: Built) -> Plot:
    """Return the mode shapes at each ignition, and the frequencies over flight time."""
    shown = [n for n, (_, modes) in enumerate(built.modes) if modes[0]]
    panels, frequencies = list[Panel](), list[Series]()
    for n in shown:
        times_s, modes = built.modes[n]
        shapes = list[Series]()
        for k, (mode, last) in enumerate(zip(modes[0], modes[-1], strict=True)):
            name = f"mode {k + 1}: {mode.frequency_hz:.2f} to {last.frequency_hz:.2f} Hz"
            shapes.append(line(mode.station_m, mode.phi, name, **look(k)))
            hz = [now[k].frequency_hz for now in modes]
            name = f"mode {k + 1}" if n == shown[0] else ""
            frequencies.append(line(built.flight.begins_s[n] + times_s, hz, name, **look(k)))
        for k, mode in enumerate(on_the_pad(built)[:2] if n == 0 else []):
            name = f"clamped on the pad: {mode.frequency_hz:.2f} Hz"
            shapes.append(line(mode.station_m, mode.phi, name, colour="grey", dash=("8 3 2 3", "2 2")[k]))
        if not built.layout.unguided:
            shapes.append(at(built.layout.control.gyro_station_m, "gyro", colour="green", dash="6 3"))
        panels.append(Panel(f"{built.stacks[n].name}, at ignition", shapes, _STATION, "mode shape"))
    if not built.layout.unguided:
        frequencies.append(limit(0.5 / built.layout.control.sample_s, "half the sample rate"))
    panels.append(Panel("frequencies", frequencies, _TIME, "Hz", log_y=True))
    caption = (
        "Free-free modes with a displacement of 1 at the gimbal, engine locked, without sloshing masses. Grey: clamped "
        "at the tail, with a displacement of 1 at the nose."
    )
    return Plot("modes", "Bending modes", panels, caption, 2)


def _split(points: list[TrajectoryPoint], values: list[float]) -> tuple[Array, Array]:
    """Return the flight times and values of points, with a NaN between stacks that interrupts the curve."""
    t, y = np.array([p.time_s for p in points]), np.array(values, dtype=float)
    changes = np.flatnonzero(np.diff([p.number for p in points])) + 1
    return np.insert(t, changes, np.nan), np.insert(y, changes, np.nan)


def _aerodynamics(built: Built) -> Plot:
    points = [p for p in burning(built) if p.dynamic_pressure_Pa > _AIR_Pa]
    cg = [built.stacks[p.number].mass_properties(p.clock_s).x_cg_m for p in points]
    cp = [built.aero[p.number].normal(p.mach)[1] for p in points]
    margin = [(b - a) / built.aero[0].diameter_m for a, b in zip(cg, cp, strict=True)]
    centres = [line(*_split(points, cg), "CG"), line(*_split(points, cp), "CP", colour="red", dash="6 3")]
    static = [line(*_split(points, margin), colour="ink"), limit(0.0, "neutral")]
    panels = [
        Panel("centres, while q > 0.1 kPa", centres, _TIME, "m aft of the nose", down=True),
        Panel("static margin (below 0: unstable)", static, _TIME, "diameters"),
    ]
    return Plot("aerodynamics", "Static stability", panels, "Static margin: CP behind CG, over the largest diameter.")


def _control(built: Built) -> Plot:
    points, gains = burning(built), np.array(built.gains)
    alpha, delta = [m_alpha_1ps2(built, p) for p in points], [m_delta_1ps2(built, p) for p in points]
    ratio = [abs(a) / d for a, d in zip(alpha, delta, strict=True)]
    steepest = min(s.engine.angle_limit_deg for s in built.layout.stage) / 5.0
    moments = [
        line(*_split(points, alpha), "M_alpha", colour="red"),
        line(*_split(points, delta), "M_delta", dash="6 3"),
    ]
    first = [
        line(gains[:, 0], gains[:, 1], "k_p"),
        line(gains[:, 0], gains[:, 2], "k_d, s", colour="orange", dash="6 3"),
    ]
    panels = [
        Panel("moments over inertia", moments, _TIME, "1/s2"),
        Panel(
            "|M_alpha| / M_delta",
            [line(*_split(points, ratio), colour="ink"), limit(steepest)],
            _TIME,
            "deg of gimbal per deg",
        ),
        Panel("first gains", first, _TIME),
    ]
    caption = "Middle: above the red line the gimbals cannot hold an angle of attack of 5 deg."
    return Plot("control", "Control", panels, caption, 3)


def _ascent(built: Built) -> Plot:
    points = built.flight.points
    path = [math.degrees(p.path_rad) for p in points]
    attitude = [math.degrees(p.path_rad + p.incidence_rad) for p in points]
    shown = (
        ("altitude", "km", {"": [p.altitude_m / 1e3 for p in points]}),
        ("speed relative to the Earth", "m/s", {"": [p.speed_mps for p in points]}),
        ("dynamic pressure", "kPa", {"": [p.dynamic_pressure_Pa / 1e3 for p in points]}),
        ("angle above the local horizon", "deg", {"path": path, "attitude": attitude}),
    )
    times_s, changes = [p.time_s for p in points], [at(s, colour="grey", dash="2 2") for s in built.flight.begins_s[1:]]
    panels = [
        Panel(
            title, [line(times_s, y, name, **look(k)) for k, (name, y) in enumerate(of.items())] + changes, _TIME, unit
        )
        for title, unit, of in shown
    ]
    caption = "Dotted: staging or fairing separation. The attitude differs from the path while the upper stages steer."
    return Plot("ascent", "Ascent", panels, caption)
