"""The text that a command prints on a flight: requirements, events, metrics, and the verdict as the last line."""

from __future__ import annotations

import math
import shlex
from collections.abc import Sequence
from pathlib import Path

from maxq.sim.flight.metric_table import title_of, unit_of
from maxq.sim.packing.integration import worst_error
from maxq.sim.run.flight import Flight
from maxq.sim.run.fly import DIVERGED_NAME
from maxq.sim.run.metrics import Verdict, tightest_first
from maxq.sim.run.quantities import number_text, quantity, share_text
from maxq.sim.run.record import LOG_NAME
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
"""The part of the final state that is printed for a diverged flight. summary.json contains the whole state."""
_TIGHT = 0.95  # utilisation of a limit from which a hint is given


def report(flight: Flight, files: list[Path], total_s: float, notes: Sequence[str] = ()) -> str:
    """Return the text that a command prints on a flight. Its last line is the verdict.

    `files` are the written files. `total_s` is the wall-clock time of the command. `notes` are further lines.
    """
    scenario = flight.scenario.scenario
    title = printable(f"{scenario.name}: {scenario.description}" if scenario.description else scenario.name)
    head = [title, *(f"warning: {printable(warning)}" for warning in flight.scenario.warnings)]
    parts = [head, _requirements(flight.verdicts), _events(flight), _metrics(flight)]
    if flight.outcome == DIVERGED_NAME:
        parts.append(_state(flight))
    error = worst_error(scenario)
    parts.append([f"warning: {printable(error.text)}"] if error is not None and error.text else [])
    parts.append([*_timing(flight, files, total_s), *notes, *_next_step(flight, files)])
    parts.append([verdict_line(flight)])
    return "\n\n".join("\n".join(part) for part in parts if part)


def verdict_line(flight: Flight) -> str:
    """Return the outcome of a flight in one line, with the decisive requirement in numbers and remarks."""
    if flight.outcome == "interrupted":
        return f"INTERRUPTED at {flight.end_s:.3f} s of flight"
    verdicts = tightest_first(flight.verdicts)
    count, missed = len(verdicts), [v for v in verdicts if not v.met]
    said = list(flight.failures)
    if missed:
        said.append(_missed(missed[0]))
        if others := [printable(v.name) for v in missed[1:]]:
            said.append(f"also missed: {', '.join(others)}")
        said.append(f"{count - len(missed)} of {count} requirements met")
    if said:
        return "FAILED: " + "; ".join((*said, *flight.remarks))
    met = "no requirements" if count == 0 else "1 requirement met" if count == 1 else f"all {count} requirements met"
    return "PASSED: " + "; ".join((met, *_tightest(verdicts), *flight.remarks))


def _missed(verdict: Verdict) -> str:
    """Return the name, value, limit and time of a missed requirement, such as "roll error 2.138 deg > 2 deg at 59.280
    s".
    """
    value, limit, unit = verdict.shown
    unit = f" {unit}" if unit else ""
    if math.isnan(verdict.value):
        return f"{printable(verdict.name)} has no value, required {verdict.limit_text}"
    sign = ">" if verdict.bound[0] == "limit" else "<"
    return f"{printable(verdict.name)} {value}{unit} {sign} {limit}{unit}{_at(verdict.time_s, ' at ')}"


def _tightest(verdicts: Sequence[Verdict]) -> list[str]:
    """Return a list with a text on the utilisation of the tightest requirement, empty if no utilisation is known."""
    if not verdicts or not math.isfinite(verdicts[0].utilisation):
        return []
    first = verdicts[0]
    value, limit, unit = first.shown
    least = "at least " if first.bound[0] == "minimum" else ""
    numbers = f"{value} of {least}{limit} {unit}".rstrip()
    return [f"tightest: {printable(first.name)}, {numbers}, {share_text(first.utilisation)} used"]


def _next_step(flight: Flight, files: Sequence[Path]) -> list[str]:
    """Return the command that shows the flight, and a hint if a requirement is nearly missed."""
    lines = []
    if any(path.name == LOG_NAME for path in files):
        lines.append(f"next: simreplay {shlex.quote(str(files[0].parent))} --summary")
    tight = tightest_first(flight.verdicts)[:1]
    if flight.passed and tight and tight[0].utilisation >= _TIGHT and flight.scenario.scenario.design is not None:
        lines.append(f"{printable(tight[0].name)} is close to its limit: examine the margins with simdesign analyse")
    return lines


def _events(flight: Flight) -> list[str]:
    rows = [(e.title.replace("_", " "), f"{e.time_s:.3f} s", e.detail) for e in flight.events]
    if flight.outcome in ("duration", "interrupted"):
        rows.append((f"end ({flight.outcome})", f"{flight.end_s:.3f} s", ""))
    return ["events", *aligned(rows, "  ", right=(1,))]


def _metrics(flight: Flight) -> list[str]:
    rows = []
    for name in flight.telling_metrics:
        at = _at(flight.metric_times_s[name], "at ")
        if name.startswith(("final_", "flight_time", "range")):
            at = "at the end"
        rows.append((title_of(name), *quantity(flight.metrics[name], unit_of(name)), at))
    return ["metrics", *aligned(rows, "  ", right=(1,))]


def requirement_cells(verdict: Verdict) -> tuple[str, str, str, str]:
    """Return the name, value, limit and utilisation of a requirement as cells of a table."""
    return printable(verdict.name), verdict.shown[0], verdict.limit_text, share_text(verdict.utilisation)


def _requirements(verdicts: tuple[Verdict, ...]) -> list[str]:
    """Return the table of requirements, those with the least margin first."""
    if not verdicts:
        return []
    rows = [("", "", "value", "limit", "used", "at")]
    for v in tightest_first(verdicts):
        name, value, limit, share = requirement_cells(v)
        rows.append((name, "met" if v.met else "MISSED", value, limit, share, _at(v.time_s)))
    return ["requirements", *aligned(rows, "  ", right=(2, 4, 5), drop=(5,))]


def _at(time_s: float, before: str = "") -> str:
    return f"{before}{time_s:.3f} s" if math.isfinite(time_s) else ""


def _state(flight: Flight) -> list[str]:
    rows = [(name, number_text(flight.final[name])) for name in _FINAL if name in flight.final]
    return [f"state at {flight.end_s:.3f} s, before it diverged", *aligned(rows, "  ", right=(1,))]


def _timing(flight: Flight, files: list[Path], total_s: float) -> list[str]:
    flown_s = flight.end_s - flight.scenario.scenario.run.start_s
    ratio = f", {flown_s / flight.wall_s:.0f} times real time" if flight.wall_s > 0.0 else ""
    took = f"{flown_s:.1f} s flown in {flight.wall_s:.2f} s ({flight.steps} steps{ratio})"
    rows = [(str(path), _size(path.stat().st_size)) for path in files]
    return [f"{took}; {total_s:.2f} s in all", *aligned(rows, right=(1,))]


def _size(count: int) -> str:
    return f"{count / 1e6:.1f} MB" if count >= 1e6 else f"{count / 1e3:.1f} kB"
