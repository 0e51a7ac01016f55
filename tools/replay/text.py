"""Texts on flights: the page next to the views of the viewer, and the summary in a terminal."""

from __future__ import annotations

import shutil
import sys
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from maxq.control.kernel.records import Array, IntArray
from maxq.sim.log.messages import Level
from maxq.sim.run.quantities import number_text, share_text, sign_of
from maxq.tools.plots.palette import ON_DARK
from maxq.tools.replay.flight import FEW, ReplayFlight, ShownLaunchSite, ShownRequirement, tightest_first
from maxq.tools.replay.plots import PlotLine, ReplayPlot, range_of, tabs_of
from maxq.tools.replay.vehicle_shape import Exaggeration

_VERDICTS = {"passed": "PASSED", "failed": "FAILED", "unknown": "no verdict: there is no summary.json next to the log"}
_BLOCKS, _PLAIN_BLOCKS = "▁▂▃▄▅▆▇█", "_.-=+*%#"
_NARROWEST, _WIDEST = 20, 100


# -- next to the pictures ------------------------------------------------------------------------------------------
def about(flights: Sequence[ReplayFlight], drawn: Sequence[str]) -> str:
    """Return a Markdown page on one flight or several, which ends with the lines `drawn`."""
    if len(flights) == 1:
        return "\n".join([*_about_flight(flights[0]), *drawn])
    lines = [f"# {len(flights)} flights", "", "| flight | outcome | verdict |", "|---|---|---|"]
    for f in flights:
        verdict = _VERDICTS[f.verdict].partition(":")[0]
        lines.append(f"| {f.label} | {f.outcome} at {f.span_s[1]:.1f} s | {verdict} |")
    few = flights if len(flights) <= FEW else ()  # the reasons of many would require reading every log again
    reasons = [(f.label, _verdict(f).partition(": ")[2]) for f in few if f.verdict == "failed"]
    lines += ["", *(f"- {label}: {reason}" for label, reason in reasons if reason)]
    if len(flights) > len(ON_DARK):  # otherwise each has its own colour
        lines += ["", "Green: passed. Red: failed. Blue: no verdict known. Purple: the nominal."]
    lines.append("")
    lines += _went_wrong([(f"{f.label}: ", f) for f in flights])
    lines += _notes([f"{f.label}: {note}" for f in flights for note in f.damage])
    return "\n".join([*lines, *drawn])


def _about_flight(flight: ReplayFlight) -> list[str]:
    data = flight.log.metadata
    facts = {
        **{name: data.get(name, "") for name in ("vehicle", "design", "seed")},
        "T0": data.get("t0_utc", ""),
        "site": f"{data.get('site_latitude_deg', '?')} N, {data.get('site_longitude_deg', '?')} E",
        "maxq": f"{data.get('maxq', '?')}, log schema {data.get('schema', '?')}",
        "log": flight.path.name,
    }
    met = sum(r.met is True for r in flight.requirements)
    count = f"; {met} of {len(flight.requirements)} requirements met" if flight.requirements else ""
    lines = [f"# {_verdict(flight)}", "", f"{flight.label}: {flight.outcome} at {flight.span_s[1]:.1f} s{count}", ""]
    lines += _went_wrong([("", flight)])
    if flight.requirements:
        lines += ["| requirement | value | limit | used |", "|---|--:|---|--:|"]
        lines += [*(_requirement(r) for r in tightest_first(flight.requirements)), ""]
    lines += _notes(flight.notes)
    lines += [data.get("description", ""), "", "| item | value |", "|---|---|"]
    return [*lines, *(f"| {name} | {value} |" for name, value in facts.items() if value), ""]


def _verdict(flight: ReplayFlight) -> str:
    """Return the verdict with its decisive requirement, such as "FAILED: slosh 11.2 deg, limit 10 deg"."""
    verdict = _VERDICTS[flight.verdict]
    missed = [r for r in tightest_first(flight.requirements) if r.met is False]
    if not missed or flight.verdict != "failed":
        return verdict
    value, limit, unit = missed[0].shown
    others = f", {len(missed) - 1} more missed" if len(missed) > 1 else ""
    return f"{verdict}: {missed[0].name} {value} {unit}".rstrip() + f", limit {limit} {unit}".rstrip() + others


def _went_wrong(flights: Sequence[tuple[str, ReplayFlight]]) -> list[str]:
    """Return a section with all warnings and failures in whole sentences, which the narrow list of events folds."""
    said = [f"- {name}{m.line.strip()}" for name, f in flights for m in f.moments if m.level >= Level.WARNING]
    return ["## Problems", "", *said, ""] if said else []


def _notes(notes: Sequence[str]) -> list[str]:
    return ["## Missing data", "", *(f"- {note}" for note in notes), ""] if notes else []


def _requirement(r: ShownRequirement) -> str:
    value, limit, unit = r.shown
    name = f"**MISSED** {r.name}" if r.met is False else r.name
    value = "" if r.value is None else value
    sign = {"<=": "≤", ">=": "≥"}[sign_of(r.kind)]
    return f"| {name} | {value} | {sign} {limit} {unit} | {share_text(r.utilisation)} |"


def drawn_text(ex: Exaggeration, place: ShownLaunchSite | None = None) -> list[str]:
    """Return the section on the scales and colours of the picture."""
    moved = ["- Axes: east, north, up at the start of the flight, which is far from the site."]
    return [
        "## Scales and colours",
        "",
        f"- Bending: exaggerated **{ex.bending:g} times**, drawn up to {ex.most_m:.2g} m.",
        f"- Slosh angles: exaggerated **{ex.slosh:g} times**; a liquid's surface is perpendicular to its pendulum.",
        "- Gimbal angle, attitude and trajectory: to scale.",
        "- Thrust: the arrow ends at the nozzle; its length is proportional to the square root of the force.",
        "- Green: direction of flight over the ground. Blue: wind, one vehicle length at 60 m/s and above.",
        *(moved if place is not None and place.moved else []),
        "- The ground is drawn under the vehicle; the simulation begins with the CG at the site's altitude.",
        "- Red, green and blue axes: x, y and z of the body, from its CG.",
        "- Skin, nose and fins follow the vehicle file; missing dimensions are assumed.",
        "",
    ]


# -- in a terminal -------------------------------------------------------------------------------------------------
@dataclass(frozen=True)
class _TextRow:
    """A curve of the summary. `broken` is True if it exceeds a limit of the scenario under thrust."""

    name: str
    ns: IntArray
    values: Array
    ends: str
    broken: bool


def summary_text(flight: ReplayFlight, width: int | None = None, ascii_only: bool | None = None) -> str:
    """Return a summary of a flight in plain text: events, missed requirements, and the key channels as sparklines.

    It has at most `width` columns, by default those of the terminal. `ascii_only` avoids block characters, by default
    if the terminal cannot print them.
    """
    width = width or shutil.get_terminal_size((100, 24)).columns
    if ascii_only is None:
        ascii_only = not _can_print_blocks()
    plots = [plot for tab in tabs_of(flight.log.table, flight.scenario) for plot in tab.plots]
    tried = [_row(plot, curve, flight) for plot in plots for curve in plot.curves[: plot.glance[0]]]
    rows = [row for row in tried if row is not None]
    names = max((len(row.name) for row in rows), default=0)
    numbers = max((len(row.ends) for row in rows), default=0)
    cells = min(max(width - names - numbers - 6, _NARROWEST), _WIDEST)
    start, end = flight.span_s
    span_ns = round(start * 1e9), round(end * 1e9)
    lines = [f"{flight.label}: {flight.outcome} at {end:.1f} s, {_verdict(flight)}"]
    lines += filter(None, [flight.log.metadata.get("description", "")])
    lines += (f"incomplete: {note}" for note in flight.notes)
    left, right = f"{start:g} s", f"{end:.1f} s"
    scale = f"{left}{' ' * max(cells - len(left) - len(right), 1)}{right}"
    lines += ["", *(f"  {m.line}" for m in flight.moments), "", f"{'':{names}}  {scale}"]
    for row in rows:
        line = sparkline(row.ns, row.values, span_ns, cells, _PLAIN_BLOCKS if ascii_only else _BLOCKS)
        lines.append(f"{row.name:{names}}  {line}  {row.ends}{' !' if row.broken else ''}")
    marks = [" "] * cells
    for moment in flight.moments:
        cell = int((moment.time_s - start) / max(end - start, 1e-9) * cells)
        marks[min(max(cell, 0), cells - 1)] = "^"
    lines.append(f"{'':{names}}  {''.join(marks)}")
    if any(row.broken for row in rows):
        lines.append("! exceeds a limit of the scenario")
    for r in tightest_first(flight.requirements):
        if r.met is False and r.value is not None:
            value, limit, unit = r.shown
            lines.append(f"MISSED {r.name}: {value} {unit}".rstrip() + f", limit {limit} {unit}".rstrip())
    return "\n".join("".join(c if c.isprintable() else " " for c in line).rstrip() for line in lines)


def _can_print_blocks() -> bool:
    try:
        _BLOCKS.encode(getattr(sys.stdout, "encoding", None) or "ascii")
    except (UnicodeEncodeError, LookupError):
        return False
    return True


def _row(plot: ReplayPlot, curve: PlotLine, flight: ReplayFlight) -> _TextRow | None:
    ns, values = curve.values(flight.log)
    found = range_of([values])
    if found is None:
        return None
    low, high = found
    least = 1e-4 * max(abs(low), abs(high))
    ends = " .. ".join("0" if abs(x) <= least else number_text(x, 4 if abs(x) >= 1000.0 else 3) for x in (low, high))
    burning = values[
        np.isfinite(values) & (ns <= round(flight.burn_end_s * 1e9))
    ]  # requirements are judged under thrust
    broken = any((burning > x.value).any() if x.upper else (burning < x.value).any() for x in plot.limits if x.required)
    return _TextRow(plot.glance[1].format(curve.label), ns, values, f"{ends} {plot.unit}".rstrip(), broken)


def sparkline(ns: IntArray, values: Array, span_ns: tuple[int, int], cells: int, blocks: str = _BLOCKS) -> str:
    """Return a text with one character for each of `cells` intervals.

    In an interval with an oscillation, it shows the largest excursion from the median, so that no peak is lost.
    """
    found, finite = range_of([values]), np.isfinite(values)
    if found is None:
        return " " * cells
    (low, high), middle = found, float(np.median(values[finite]))
    place = np.clip((ns - span_ns[0]) * cells // max(span_ns[1] - span_ns[0], 1), 0, cells - 1)
    out = []
    for cell in range(cells):
        here = values[(place == cell) & finite]
        if not len(here):
            out.append(" ")
            continue
        swings = np.ptp(here) > 0.25 * (high - low)
        value = float(here[np.argmax(np.abs(here - middle))]) if swings else float(here.mean())
        share = 0.0 if high <= low else (value - low) / (high - low)
        out.append(blocks[min(int(share * len(blocks)), len(blocks) - 1)])
    return "".join(out)
