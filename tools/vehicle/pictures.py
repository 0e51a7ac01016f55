"""The page of pictures that `simvehicle` writes: drawing, masses, modes, aerodynamics, control, ascent."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from maxq.control.kernel.records import Array
from maxq.tools.pages.render import render
from maxq.tools.plots.palette import BLACK, BLUE, GREEN, GREY, ORANGE, PALE, PURPLE, RED, SKY
from maxq.tools.plots.style import curve, drawing, label, plain_numbers, png, sheet
from maxq.tools.vehicle.build import Built, burning, m_alpha_1ps2, m_delta_1ps2, on_the_pad
from maxq.tools.vehicle.layout import Stage, Tank
from maxq.tools.vehicle.report import notes, numbers, tables
from maxq.tools.vehicle.trajectory import Point

_AIR_Pa = 100.0  # below this dynamic pressure a centre of pressure is of no consequence


def page(built: Built) -> str:
    """One HTML file with all pictures in it."""
    draw: dict[str, Callable[[Built], Figure]] = {
        "drawing": _drawing, "masses": _masses, "modes": _modes, "aerodynamics": _aerodynamics, "control": _control,
        "ascent": _ascent,
    }  # fmt: skip  # six more lines otherwise
    if not any(modes[0] for _, modes in built.modes):
        del draw["modes"]
    with drawing():
        pictures = {name: png(make(built), dpi=150) for name, make in draw.items()}
    return render(
        "vehicle.html.j2", layout=built.layout, tables=tables(built), notes=notes(built), pictures=pictures,
        numbers=numbers,
    )  # fmt: skip  # three more lines otherwise


def _drawing(built: Built) -> Figure:
    """From the side, nose on the left, to scale; widths are drawn larger where the body is slender."""
    layout, tail = built.layout, _tail_m(built)
    widest = max(s.diameter_m for s in layout.stage)
    wider = max(1.0, round(0.11 * tail / widest))
    half = wider * 0.5 * max(widest, *(s.diameter_m + 2.0 * s.fins.semispan_m for s in layout.stage if s.fins), widest)
    figure, (place,) = sheet(height_in=min(max(8.4 * 2.6 * half / tail + 1.3, 2.2), 5.0), width_in=8.4)
    for stage in layout.stage:
        _draw_stage(place, stage, layout.nose_length_m if stage is layout.stage[-1] else 0.0, layout.nose, wider)
    if (f := layout.fairing) is not None:
        r = wider * 0.5 * layout.stage[-1].diameter_m
        place.plot([f.rear_station_m] * 2, [-r, r], "--", color=PURPLE)
        place.text(f.rear_station_m, 1.12 * r, "fairing", color=PURPLE, fontsize=7, ha="right", va="bottom")
    gyro = layout.control.gyro_station_m
    place.plot([gyro], [0.0], "D", color=GREEN, zorder=6, label=f"gyro, {gyro:g} m")
    first, burn = built.stacks[0], built.stacks[0].burn
    for t, mark, name in ((0.0, "o", "lift-off"), (burn.end_s, "s", "burn-out")):
        cg = first.mass_properties(t).x_cg_m
        place.plot(
            [cg], [0.0], mark, color=BLACK, markersize=6, zorder=6, label=f"CG at {name} of {first.name}, {cg:.2f} m"
        )
    hardest = max((p for p in burning(built) if p.number == 0), key=lambda p: p.dynamic_pressure_Pa)
    cp = built.aero[0].normal(hardest.mach)[1]
    place.plot([cp], [0.0], "X", color=RED, markersize=6, zorder=6, label=f"CP at Mach {hardest.mach:.1f}, {cp:.2f} m")
    place.set_xlim(-0.02 * tail, 1.02 * tail)
    place.set_ylim(-1.3 * half, 1.3 * half)
    place.set_yticks([])
    place.grid(visible=False, axis="y")
    place.spines["left"].set_visible(False)
    label(place, "station, m aft of the nose", title="" if wider == 1 else f"widths {wider:g} times as large")
    figure.legend(loc="outside lower center", ncols=4)
    return figure


def _draw_stage(place: Axes, stage: Stage, nose_m: float, nose: str, wider: float) -> None:
    r, front, rear = wider * 0.5 * stage.diameter_m, stage.front_station_m, stage.rear_station_m
    x = np.linspace(0.0, 1.0, 41)
    shape = r * (np.sin(0.5 * math.pi * x) ** 0.9 if nose == "ogive" else x)
    along = np.concatenate([nose_m * x, [rear]]) if nose_m else np.array([front, rear])
    across = np.concatenate([shape, [r]]) if nose_m else np.array([r, r])
    outline = np.concatenate([along, along[::-1]]), np.concatenate([across, -across[::-1]])
    place.fill(*outline, facecolor="#f5f5f5", edgecolor=BLACK, linewidth=0.9, zorder=1)
    for part, colour in zip(stage.tank, (SKY, ORANGE, PURPLE, GREEN) * 2, strict=False):
        _draw_tank(place, part, colour, wider)
    for grain in stage.grain:
        g = wider * (grain.radius_m or 0.5 * stage.diameter_m)
        xs = [grain.front_station_m, grain.rear_station_m]
        place.fill_between(xs, -g, g, color=GREY, alpha=0.5, zorder=2)
    e = stage.engine
    length, heights = e.exit_station_m - e.gimbal_station_m, sorted({round(y, 3) for y, _ in e.positions_m})
    exit_r = max(math.sqrt(e.exit_area_m2 / math.pi), 0.12 * length)
    for y in heights:
        xs = [e.gimbal_station_m, e.exit_station_m]
        top, bottom = (
            [wider * y + 0.3 * wider * exit_r, wider * (y + exit_r)],
            [wider * (y - 0.3 * exit_r), wider * (y - exit_r)],
        )
        place.fill_between(xs, bottom, top, facecolor=PALE, edgecolor=BLACK, linewidth=0.7, zorder=3)
    if stage.fins is not None:
        f = stage.fins
        chord = np.array([0.0, f.sweep_m, f.sweep_m + f.tip_chord_m, f.root_chord_m]) + f.leading_edge_station_m
        ys = np.array([0.0, 1.0, 1.0, 0.0]) * wider * f.semispan_m + r
        for side in (1, -1):
            place.fill(chord, side * ys, facecolor=PALE, edgecolor=BLACK, linewidth=0.7)
    place.text(0.5 * (max(front, nose_m) + rear), -1.12 * r, stage.name, ha="center", va="top", fontsize=8)


def _draw_tank(place: Axes, tank: Tank, colour: str, wider: float) -> None:
    profile, r = tank.profile, tank.radius_m
    depth = float(profile.depth(np.array(tank.liquid_mass_kg / (tank.density_kgpm3 * r**3))))
    for top, alpha in ((profile.height, 0.15), (depth, 0.7)):
        z = np.linspace(0.0, top, 81)
        across = wider * r * profile.surface_radius(z)
        place.fill_between(
            tank.bottom_station_m - r * z, -across, across, color=colour, alpha=alpha, linewidth=0, zorder=2
        )
    middle = tank.bottom_station_m - 0.5 * r * profile.height
    place.text(middle, 0.55 * wider * r, tank.name, ha="center", va="center", fontsize=7, zorder=4)


def _tail_m(built: Built) -> float:
    return max(max(s.engine.exit_station_m, s.rear_station_m) for s in built.layout.stage)


def _of_stacks(built: Built, place: Axes, value: Callable[[int, float], float]) -> None:
    """A quantity of each stack over flight time."""
    for n, stack in enumerate(built.stacks):
        t = np.linspace(0.0, stack.burn.end_s, 61)
        place.plot(built.flight.begins_s[n] + t, [value(n, float(x)) for x in t], **curve(n), label=stack.name)


def _masses(built: Built) -> Figure:
    figure, places = sheet(1, 3, height_in=2.6, width_in=8.4)
    _of_stacks(built, places[0], lambda n, t: built.stacks[n].mass_properties(t).mass_kg / 1e3)
    _of_stacks(built, places[1], lambda n, t: built.stacks[n].mass_properties(t).x_cg_m)
    _of_stacks(built, places[2], lambda n, t: built.stacks[n].mass_properties(t).pitch_kgm2 / 1e3)
    for n, stack in enumerate(built.stacks):
        times = built.flight.begins_s[n] + np.array([0.0, stack.burn.end_s])
        roll = [stack.mass_properties(t).roll_kgm2 / 1e3 for t in (0.0, stack.burn.end_s)]
        places[2].plot(times, roll, ":", color=GREY, label="roll" if n == 0 else None)
    places[2].set_yscale("log")
    plain_numbers(places[2].yaxis)
    label(places[0], "flight time, s", "t", "mass")
    label(places[1], "flight time, s", "m aft of the nose", "centre of gravity")
    label(places[2], "flight time, s", "t m2", "moments of inertia")
    places[0].set_ylim(bottom=0.0)
    places[1].legend()
    places[2].legend(handles=places[2].get_lines()[-len(built.stacks) :][:1])
    return figure


def _modes(built: Built) -> Figure:
    """Shapes at the beginning of each burn, and frequencies over flight time."""
    shown = [n for n, (_, modes) in enumerate(built.modes) if modes[0]]
    figure, places = sheet(len(shown) + 1, 1, height_in=2.0, width_in=8.4)
    for place, n in zip(places, shown, strict=False):
        stack, modes = built.stacks[n], built.modes[n][1]
        for k, (mode, last) in enumerate(zip(modes[0], modes[-1], strict=True)):
            name = f"{k + 1}: {mode.frequency_hz:.2f} to {last.frequency_hz:.2f} Hz"
            place.plot(mode.station_m, mode.phi, **curve(k), label=name)
        for k, mode in enumerate(on_the_pad(built)[:2] if n == 0 else []):
            place.plot(mode.station_m, mode.phi, color=GREY, linestyle=("-.", ":")[k], linewidth=0.9,
                       label=f"held on the pad: {mode.frequency_hz:.2f} Hz")  # fmt: skip  # three more lines otherwise
        place.axhline(0.0, color=BLACK, linewidth=0.5)
        place.axvline(built.layout.control.gyro_station_m, color=GREEN, linewidth=0.8, linestyle="--")
        place.set_xlim(-0.02 * _tail_m(built), 1.02 * _tail_m(built))
        label(place, "station, m aft of the nose; dashed: gyro", "phi", f"{stack.name}, beginning of its burn")
        place.legend(loc="center left", bbox_to_anchor=(1.0, 0.5))
    for n in shown:
        times, modes = built.modes[n]
        for k in range(len(modes[0])):
            hz = [at[k].frequency_hz for at in modes]
            places[-1].plot(
                built.flight.begins_s[n] + times, hz, **curve(k), label=f"mode {k + 1}" if n == shown[0] else None
            )
    places[-1].axhline(0.5 / built.layout.control.sample_s, color=RED, linewidth=0.8, label="half the sample rate")
    places[-1].set_yscale("log")
    plain_numbers(places[-1].yaxis)
    label(places[-1], "flight time, s", "Hz", "frequencies")
    places[-1].legend(loc="center left", bbox_to_anchor=(1.0, 0.5))
    return figure


def _split(points: list[Point], values: list[float]) -> tuple[Array, Array]:
    """Over flight time, apart where the stage changes."""
    t, y = np.array([p.time_s for p in points]), np.array(values, dtype=float)
    at = np.flatnonzero(np.diff([p.number for p in points])) + 1
    return np.insert(t, at, np.nan), np.insert(y, at, np.nan)


def _aerodynamics(built: Built) -> Figure:
    figure, places = sheet(1, 2, height_in=2.7, width_in=8.4)
    points = [p for p in burning(built) if p.dynamic_pressure_Pa > _AIR_Pa]
    cg = [built.stacks[p.number].mass_properties(p.clock_s).x_cg_m for p in points]
    cp = [built.aero[p.number].normal(p.mach)[1] for p in points]
    margin = [(b - a) / built.aero[0].diameter_m for a, b in zip(cg, cp, strict=True)]
    places[0].plot(*_split(points, cg), color=BLUE, label="CG")
    places[0].plot(*_split(points, cp), "--", color=RED, label="CP")
    places[0].invert_yaxis()
    places[1].plot(*_split(points, margin), color=BLACK)
    places[1].axhline(0.0, color=RED, linewidth=0.8)
    label(places[0], "flight time, s", "m aft of the nose (nose up)", "centres, while the air counts (q > 0.1 kPa)")
    label(places[1], "flight time, s", "diameters", "static margin (below 0: unstable)")
    places[0].legend()
    return figure


def _control(built: Built) -> Figure:
    figure, places = sheet(1, 3, height_in=2.6, width_in=8.4)
    points = burning(built)
    alpha, delta = [m_alpha_1ps2(built, p) for p in points], [m_delta_1ps2(built, p) for p in points]
    places[0].plot(*_split(points, alpha), color=RED, label="M_alpha")
    places[0].plot(*_split(points, delta), "--", color=BLUE, label="M_delta")
    places[1].plot(*_split(points, [abs(a) / d for a, d in zip(alpha, delta, strict=True)]), color=BLACK)
    places[1].axhline(min(s.engine.angle_limit_deg for s in built.layout.stage) / 5.0, color=RED, linewidth=0.8)
    gains = np.array(built.gains)
    places[2].plot(gains[:, 0], gains[:, 1], color=BLUE, label="k_p")
    places[2].plot(gains[:, 0], gains[:, 2], "--", color=ORANGE, label="k_d, s")
    label(places[0], "flight time, s", "1/s2", "moments over inertia")
    label(places[1], "flight time, s", "deg of gimbal per deg", "|M_alpha| / M_delta")
    label(places[2], "flight time, s", "", "first gains")
    places[0].legend()
    places[2].legend()
    return figure


def _ascent(built: Built) -> Figure:
    figure, places = sheet(2, 2, height_in=2.1, width_in=8.4)
    points = built.flight.points
    shown = (
        ("altitude", "km", [p.altitude_m / 1e3 for p in points]),
        ("speed, relative", "m/s", [p.speed_mps for p in points]),
        ("dynamic pressure", "kPa", [p.dynamic_pressure_Pa / 1e3 for p in points]),
        ("path above the local horizon", "deg", [math.degrees(p.path_rad) for p in points]),
    )  # fmt: skip  # six more lines otherwise
    for place, (title, unit, values) in zip(places, shown, strict=True):
        place.plot([p.time_s for p in points], values, color=BLUE, label="path")
        for begin in built.flight.begins_s[1:]:
            place.axvline(begin, color=GREY, linewidth=0.7, linestyle=":")
        label(place, "flight time, s", unit, title)
    attitude = [math.degrees(p.path_rad + p.incidence_rad) for p in points]
    places[3].plot([p.time_s for p in points], attitude, "--", color=ORANGE, label="attitude")
    places[3].legend()
    return figure
