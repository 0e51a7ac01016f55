"""The text that `simvehicle` prints: stages, bending modes, control over time, and assumptions."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from maxq.sim.world.constants import STANDARD_GRAVITY_mps2
from maxq.tools.cli.terminal import aligned, printable
from maxq.tools.vehicle.build import (
    Built,
    burning,
    m_alpha_1ps2,
    m_delta_1ps2,
    on_the_pad,
    spread,
    static_margin,
    warnings,
)

LayoutRows = list[tuple[str, ...]]  # the first row is the head


class LayoutTable(NamedTuple):
    """A table that describes a vehicle; the first row is its head.

    `note` is printed below it. `caption` is used on the page, where `MEANINGS` explains the columns.
    """

    heading: str
    note: str
    rows: LayoutRows
    caption: str


MEANINGS = {
    "from, kg": "mass at ignition, with all stages above",
    "T/W": "largest thrust in vacuum / weight at ignition",
    "dv, m/s": "delta-v in vacuum, without losses",
    "v, m/s": "speed relative to the Earth at burnout",
    "h, km": "altitude at burnout",
    "path, deg": "flight-path angle above the local horizon at burnout",
    "mass, kg": "generalised mass at ignition, for a displacement of 1 at the gimbal",
    "slope at gyro, 1/m": "slope of the mode shape at the gyro, at ignition",
    "q, kPa": "dynamic pressure",
    "CG, m": "station of the centre of gravity, aft of the nose",
    "CP, m": "station of the centre of pressure, aft of the nose",
    "static margin": "distance of the centre of pressure behind the centre of gravity, in largest diameters",
    "M_alpha, 1/s2": "angular acceleration per angle of attack; above 0, the vehicle is unstable",
    "M_delta, 1/s2": "angular acceleration per gimbal angle",
    "k_p": "first gain from attitude error to gimbal command",
    "k_d, s": "first gain from body rate to gimbal command",
}
"""The meanings of the columns by their heads."""


def report(built: Built) -> str:
    """Return the text of the whole report."""
    parts = [[printable(f"{built.layout.name}: {built.layout.description}".rstrip(": "))]]
    for heading, note, rows, _ in tables(built):
        less = [n for n, name in enumerate(rows[0]) if name in ("CG, m", "CP, m")]  # omitted on a narrow terminal
        parts.append([heading.lower(), *aligned(rows, "  ", right=numbers(rows[0]), drop=less), f"  {note}"])
    parts += [[title, *(f"  {line}" for line in lines)] for title, lines in notes(built)]
    return "\n\n".join("\n".join(part) for part in parts)


def numbers(head: tuple[str, ...]) -> list[int]:
    """Return the indices of the columns of a table that contain numbers."""
    return [n for n, name in enumerate(head) if name != "stage"]


def tables(built: Built) -> list[LayoutTable]:
    """Return the tables of stages, bending modes and control that have rows."""
    return [found for found in (_stages(built), _modes(built), _control(built)) if len(found.rows) > 1]


def notes(built: Built) -> list[tuple[str, list[str]]]:
    """Return the titles and lines of the assumptions and of the unusual values, without empty lists."""
    both = (("assumptions beyond the layout", built.assumed), ("unusual", warnings(built)))
    return [(title, lines) for title, lines in both if lines]


def _stages(built: Built) -> LayoutTable:
    rows: LayoutRows = [("stage", "from, kg", "to, kg", "burn, s", "T/W", "dv, m/s", "v, m/s", "h, km", "path, deg")]
    for n, stack in enumerate(built.stacks):
        first, last = (stack.mass_properties(t).mass_kg for t in (stack.begins_s, stack.end_s))
        digits = 0 if first >= 100.0 else 3
        point = [p for p in built.flight.points if p.number == n][-1]
        gained = stack.impulse_Ns / (first - last) * math.log(first / last)
        rows.append(
            (
                stack.name,
                f"{first:.{digits}f}",
                f"{last:.{digits}f}",
                f"{stack.end_s - max(stack.begins_s, stack.burn.start_s):.1f}",
                f"{stack.largest_thrust_N / first / STANDARD_GRAVITY_mps2:.2f}",
                f"{gained:.0f}",
                f"{point.speed_mps:.0f}",
                f"{point.altitude_m / 1e3:.1f}",
                f"{math.degrees(point.path_rad):z.1f}",
            )
        )
    orbit = built.flight.orbit
    about = "point mass; thrust-to-weight ratio and delta-v in vacuum; speed, altitude and path angle at burnout"
    ends = ""
    if orbit.perigee_m >= 0.0:
        ends = f"; orbit after the last burnout: {orbit.perigee_m / 1e3:.0f} by {orbit.apogee_m / 1e3:.0f} km"
    return LayoutTable("Stages", about + ends, rows, f"Ascent of a point mass{ends}.")


def _modes(built: Built) -> LayoutTable:
    rows: LayoutRows = [("stage", "mode", "at ignition, Hz", "at burnout, Hz", "mass, kg", "slope at gyro, 1/m")]
    gyro = built.layout.control.gyro_station_m
    for stack, (_, modes) in zip(built.stacks, built.modes, strict=True):
        for k, mode in enumerate(modes[0]):
            slope = float(np.interp(gyro, mode.station_m, mode.slope_pm))
            ends = (f"{mode.frequency_hz:.2f}", f"{modes[-1][k].frequency_hz:.2f}", f"{mode.generalized_mass_kg:.4g}")
            rows.append((stack.name, str(k + 1), *ends, f"{slope:.3f}"))
    held = ", ".join(f"{mode.frequency_hz:.2f}" for mode in on_the_pad(built))
    on_pad = f"; clamped at the tail on the pad: {held} Hz" if held else ""
    return LayoutTable(
        "Bending modes", f"free-free, displacement of 1 at the gimbal{on_pad}", rows, f"Free-free{on_pad}."
    )


def _control(built: Built) -> LayoutTable:
    heads = ("time, s", "stage", "Mach", "q, kPa", "CG, m", "CP, m", "M_alpha, 1/s2", "M_delta, 1/s2", "k_p", "k_d, s")
    rows: LayoutRows = [heads]
    if built.layout.unguided:
        return _stability(built)
    gains = np.array(built.gains)
    for n, stack in enumerate(built.stacks):
        for p in spread(burning(built, n), 6):
            cg, cp = stack.mass_properties(p.clock_s).x_cg_m, built.aero[n].normal(p.mach)[1]
            k_p, k_d = (float(np.interp(p.time_s, gains[:, 0], gains[:, i])) for i in (1, 2))
            cells = (f"{p.mach:.2f}", f"{p.dynamic_pressure_Pa / 1e3:.2f}", f"{cg:.2f}", f"{cp:.2f}")
            turn = (f"{m_alpha_1ps2(built, p):.3f}", f"{m_delta_1ps2(built, p):.3f}", f"{k_p:.3f}", f"{k_d:.3f}")
            rows.append((f"{p.time_s:.1f}", stack.name, *cells, *turn))
    return LayoutTable("Control", "unstable where M_alpha > 0", rows, "Stability, control authority and first gains.")


def _stability(built: Built) -> LayoutTable:
    rows: LayoutRows = [("time, s", "stage", "Mach", "q, kPa", "CG, m", "CP, m", "static margin", "M_alpha, 1/s2")]
    for n, stack in enumerate(built.stacks):
        for p in spread(burning(built, n), 6):
            cg, cp = stack.mass_properties(p.clock_s).x_cg_m, built.aero[n].normal(p.mach)[1]
            cells = (f"{p.mach:.2f}", f"{p.dynamic_pressure_Pa / 1e3:.2f}", f"{cg:.3f}", f"{cp:.3f}")
            margin = f"{static_margin(built, p):z.2f}"
            rows.append((f"{p.time_s:.2f}", stack.name, *cells, margin, f"{m_alpha_1ps2(built, p):z.2f}"))
    return LayoutTable("Static stability", "static margin in diameters; stable above 0", rows, "Static stability.")
