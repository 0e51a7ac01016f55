"""A glance at a flight in a terminal: events, requirements, and the key channels as lines of small blocks."""

from __future__ import annotations

import shutil
import sys
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from maxq.control.kernel.records import Array, IntArray
from maxq.tools.replay.about import plain
from maxq.tools.replay.flight import ReplayFlight
from maxq.tools.replay.limits import Limit
from maxq.tools.replay.plots import Curve, Plot, tabs_of

_BLOCKS, _PLAIN_BLOCKS = "▁▂▃▄▅▆▇█", "_.-=+*%#"
_NARROWEST, _WIDEST = 20, 100
_KEYS = {  # plots of the table by key; of each curve, or of the first ones
    "trajectory/altitude": 2, "trajectory/speed": 1, "trajectory/mach": 1, "trajectory/path_angle": 1,
    "air/pressure": 1, "air/incidence": 3, "attitude/error": 3, "gimbal/pitch": 2, "gimbal/yaw": 2,
    "bending/pitch": 1, "bending/yaw": 1, "slosh/pitch": 2, "slosh/yaw": 2, "loads/q_alpha": 1, "loads/axial": 1,
    "loads/lateral": 1, "vehicle/thrust": 1, "vehicle/mass": 1,
}  # fmt: skip
_GAP = " "


@dataclass(frozen=True)
class Row:
    name: str
    unit: str
    line: str
    low: float
    high: float
    broken: bool


def summary_text(flight: ReplayFlight, width: int | None = None, ascii_only: bool | None = None) -> str:
    """Plain text of at most `width` columns (default: the terminal's)."""
    width = width or shutil.get_terminal_size((100, 24)).columns
    if ascii_only is None:
        ascii_only = not _can_print_blocks()
    rows = _rows(flight, ascii_only, 10)
    names = max((len(row.name) for row in rows), default=0)
    numbers = max((len(_ends(row)) for row in rows), default=0)
    cells = min(max(width - names - numbers - 6, _NARROWEST), _WIDEST)
    rows = _rows(flight, ascii_only, cells)
    start, end = flight.span_s
    lines = [f"{flight.label}: {flight.outcome} at {end:.1f} s, {flight.verdict}"]
    lines += [flight.log.metadata.get("description", "")] if flight.log.metadata.get("description") else []
    lines += [*(f"incomplete: {note}" for note in flight.notes)]
    lines += ["", *(f"  {m.time_s:9.3f} s  {m.text}" for m in flight.moments), ""]
    lines.append(f"{'':{names}}  {_scale(start, end, cells)}")
    for row in rows:
        mark = " !" if row.broken else ""
        lines.append(f"{row.name:{names}}  {row.line}  {_ends(row)}{mark}")
    lines.append(f"{'':{names}}  {_event_marks(flight, cells)}")
    if any(row.broken for row in rows):
        lines.append("! goes beyond what the scenario allows")
    for r in flight.requirements:
        if r.met is False and r.value is not None:
            bound = r.limit if r.limit is not None else r.minimum
            lines.append(f"MISSED {r.name}: {plain(r.value)} instead of {bound:g} {r.unit}")
    return "\n".join(_clean(line) for line in lines)


def _clean(line: str) -> str:
    """A line without control characters; its columns stay."""
    return "".join(c if c.isprintable() else " " for c in line).rstrip()


def _can_print_blocks() -> bool:
    encoding = getattr(sys.stdout, "encoding", None) or "ascii"
    try:
        _BLOCKS.encode(encoding)
    except (UnicodeEncodeError, LookupError):
        return False
    return True


def _ends(row: Row) -> str:
    least = 1e-9 * max(abs(row.low), abs(row.high))
    low, high = (0.0 if abs(x) < least else x for x in (row.low, row.high))
    return f"{_number(low)} .. {_number(high)} {row.unit}".rstrip()


def _number(value: float) -> str:
    size = abs(value)
    return "0" if size < 1e-12 else f"{value:.0f}" if size >= 1000.0 else f"{value:.3g}"


def _rows(flight: ReplayFlight, ascii_only: bool, cells: int) -> list[Row]:
    plots = {plot.key: plot for tab in tabs_of(flight.log.table, flight.scenario) for plot in tab.plots}
    rows = []
    for key, count in _KEYS.items():
        plot = plots.get(key)
        for curve in plot.curves[:count] if plot is not None else ():
            assert plot is not None
            row = _row(plot, curve, flight, ascii_only, cells)
            if row is not None:
                rows.append(row)
    return rows


def _row(plot: Plot, curve: Curve, flight: ReplayFlight, ascii_only: bool, cells: int) -> Row | None:
    ns, values = curve.values(flight.log)
    finite = np.isfinite(values)
    if not finite.any():
        return None
    low, high = float(values[finite].min()), float(values[finite].max())
    start, end = flight.span_s
    line = sparkline(
        ns, values, (round(start * 1e9), round(end * 1e9)), cells, _PLAIN_BLOCKS if ascii_only else _BLOCKS
    )
    words = plot.title.split(":")[0]
    only = len(plot.curves) == 1 or curve.label == words
    name = words if only else f"{words}, {curve.label}"
    burning = values[finite & (ns <= _burn_end_ns(flight))]  # requirements are judged under thrust
    broken = len(burning) > 0 and _is_broken(plot.limits, float(burning.min()), float(burning.max()))
    return Row(_short(name), plot.unit, line, low, high, broken)


def _burn_end_ns(flight: ReplayFlight) -> int:
    moment = flight.moment("burnout")
    return moment.time_ns if moment is not None else round(flight.span_s[1] * 1e9)


def _short(name: str) -> str:
    for words, fewer in (
        ("altitude and distance from the site, ", ""),
        ("incidence where the dynamic pressure exceeds 1 kPa, ", "incidence, "),
        ("flight path and pitch above the horizon, ", ""),
        ("attitude error in the computer, ", "error, "),
        ("slosh pendulums, pitch plane, ", "slosh "),
        ("slosh pendulums, yaw plane, ", "slosh "),
        ("pitch gimbal, pitch", "pitch gimbal"),
        ("yaw gimbal, yaw", "yaw gimbal"),
        ("pitch bending, pitch", "bending, pitch"),
        ("yaw bending, yaw", "bending, yaw"),
        ("distance along the ground", "distance"),
    ):
        name = name.replace(words, fewer)
    return name


def _is_broken(limits: Sequence[Limit], low: float, high: float) -> bool:
    wanted = [limit for limit in limits if limit.required]
    return any(high > limit.value if limit.upper else low < limit.value for limit in wanted)


def sparkline(ns: IntArray, values: Array, span_ns: tuple[int, int], cells: int, blocks: str = _BLOCKS) -> str:
    """A character for each of `cells` intervals; where it swings, its largest excursion, so that no peak is lost."""
    finite = np.isfinite(values)
    if not finite.any():
        return _GAP * cells
    low, high = float(values[finite].min()), float(values[finite].max())
    middle = float(np.median(values[finite]))
    place = np.clip((ns - span_ns[0]) * cells // max(span_ns[1] - span_ns[0], 1), 0, cells - 1)
    out = []
    for cell in range(cells):
        here = values[(place == cell) & finite]
        if not len(here):
            out.append(_GAP)
            continue
        value = (
            float(here[np.argmax(np.abs(here - middle))]) if np.ptp(here) > 0.25 * (high - low) else float(here.mean())
        )
        share = 0.0 if high <= low else (value - low) / (high - low)
        out.append(blocks[min(int(share * len(blocks)), len(blocks) - 1)])
    return "".join(out)


def _scale(start: float, end: float, cells: int) -> str:
    left, right = f"{start:g} s", f"{end:.1f} s"
    return left + " " * max(cells - len(left) - len(right), 1) + right


def _event_marks(flight: ReplayFlight, cells: int) -> str:
    """First letters of events where they happen."""
    start, end = flight.span_s
    marks = [" "] * cells
    for moment in flight.moments:
        place = int((moment.time_s - start) / max(end - start, 1e-9) * cells)
        marks[min(max(place, 0), cells - 1)] = "^"
    return "".join(marks)
