"""The printed report of a flight: events, metrics, requirements, and the verdict as the last line."""

from __future__ import annotations

import math
from pathlib import Path

from maxq.sim.flight.metric_table import figures, title_of, unit_of
from maxq.sim.packing.integration import worst_error
from maxq.sim.run.flight import Flight
from maxq.sim.run.fly import DIVERGED_NAME
from maxq.sim.run.metrics import Verdict
from maxq.tools.cli.terminal import aligned, printable

_FINAL = (
    "altitude_m",
    "speed_mps",
    "yaw_deg",
    "pitch_deg",
    "roll_deg",
    "alpha_total_deg",
    "dynamic_pressure_Pa",
    "body_roll_rate_degps",
    "body_pitch_rate_degps",
    "body_yaw_rate_degps",
    "gimbal_pitch_angle_deg",
    "gimbal_yaw_angle_deg",
    "bend_pitch_gimbal_m",
    "bend_yaw_gimbal_m",
)
"""State shown of a flight that failed; summary.json has all of it."""


def report(flight: Flight, files: list[Path], total_s: float) -> str:
    """All that is said about a flight, in plain text."""
    scenario = flight.scenario.scenario
    title = printable(f"{scenario.name}: {scenario.description}" if scenario.description else scenario.name)
    head = [title, *(f"warning: {printable(warning)}" for warning in flight.scenario.warnings)]
    parts = [head, _requirements(flight.verdicts), _events(flight), _metrics(flight)]
    if flight.outcome == DIVERGED_NAME:
        parts.append(_state(flight))
    error = worst_error(scenario)
    parts.append([f"warning: {printable(error.text)}"] if error is not None and error.text else [])
    parts.append(_timing(flight, files, total_s))
    parts.append([verdict_line(flight)])
    return "\n\n".join("\n".join(part) for part in parts if part)


def verdict_line(flight: Flight) -> str:
    """The flight in one line: how it ended and what was wrong."""
    if flight.outcome == "interrupted":
        return f"INTERRUPTED at {flight.end_s:.3f} s of flight"
    missed = [v for v in flight.verdicts if not v.met]
    wrong = list(flight.failures)
    if len(missed) == 1:
        wrong.append(f"requirement missed: {printable(missed[0].name)}: {_bounded(missed[0])}")
    elif missed:
        wrong.append(f"{len(missed)} requirements missed: {', '.join(printable(v.name) for v in missed)}")
    beyond = "".join(f"; beyond the model: {what}" for what in flight.beyond_model)
    if wrong:
        return "FAILED: " + "; ".join(wrong) + beyond
    count = len(flight.verdicts)
    met = "no requirements" if count == 0 else "1 requirement met" if count == 1 else f"all {count} requirements met"
    return f"PASSED: {met}{beyond}"


def _events(flight: Flight) -> list[str]:
    rows = [(e.title, f"{e.time_s:.3f} s", e.detail) for e in flight.events]
    if flight.outcome in ("duration", "interrupted"):
        rows.append((f"end ({flight.outcome})", f"{flight.end_s:.3f} s", ""))
    return ["events", *aligned(rows, "  ", right=(1,))]


def _metrics(flight: Flight) -> list[str]:
    rows = []
    for name in flight.telling_metrics:
        unit, time_s = unit_of(name), flight.metric_times_s[name]
        at = f"at {time_s:.3f} s" if math.isfinite(time_s) else ""
        if name.startswith(("final_", "flight_time", "range")):
            at = "at the end"
        rows.append((title_of(name), figures(flight.metrics[name]), "" if unit == "1" else unit, at))
    return ["metrics", *aligned(rows, "  ", right=(1,))]


def _requirements(verdicts: tuple[Verdict, ...]) -> list[str]:
    if not verdicts:
        return []
    rows = []
    for verdict in verdicts:
        at = f"at {verdict.time_s:.3f} s" if math.isfinite(verdict.time_s) else ""
        value = figures(verdict.value, 4 if verdict.met else 7)  # rounded more, a missed one may look like the limit
        rows.append((printable(verdict.name), "met" if verdict.met else "MISSED", value, verdict.wanted, at))
    return ["requirements", *aligned(rows, "  ", right=(2,), drop=(4,))]


def _state(flight: Flight) -> list[str]:
    rows = [(name, figures(flight.final[name])) for name in _FINAL if name in flight.final]
    return [f"state at {flight.end_s:.3f} s, before it diverged", *aligned(rows, "  ", right=(1,))]


def _timing(flight: Flight, files: list[Path], total_s: float) -> list[str]:
    flown_s = flight.end_s - flight.scenario.scenario.run.start_s
    ratio = f", {flown_s / flight.wall_s:.0f} times real time" if flight.wall_s > 0.0 else ""
    took = f"{flown_s:.1f} s flown in {flight.wall_s:.2f} s ({flight.steps} steps{ratio})"
    rows = [(str(path), _size(path.stat().st_size)) for path in files]
    return [f"{took}; {total_s:.2f} s in all", *aligned(rows, right=(1,))]


def _size(count: int) -> str:
    return f"{count / 1e6:.1f} MB" if count >= 1e6 else f"{count / 1e3:.1f} kB"


def _bounded(verdict: Verdict) -> str:
    kind, bound = verdict.bound
    sign = ">" if kind == "limit" else "<"
    unit = unit_of(verdict.requirement.metric)
    text = f"{verdict.value:.6g} {sign} {bound:.6g}" + ("" if unit == "1" else f" {unit}")
    return text + (f" at {verdict.time_s:.3f} s" if math.isfinite(verdict.time_s) else "")
