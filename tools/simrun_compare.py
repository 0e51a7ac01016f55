"""The subcommand `simrun compare LOG FILE`: a flight against measured time series."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from pathlib import Path

from maxq.sim.files import check_writable, write_whole
from maxq.sim.log.head import LogError
from maxq.sim.run.comparison import (
    MOST_SHIFT_S,
    STATISTICS,
    ComparisonError,
    ResidualLimit,
    Residuals,
    SeriesComparison,
    compare,
)
from maxq.sim.run.impact_channels import WithImpacts
from maxq.sim.run.measured import MeasuredSeries, read_measured
from maxq.sim.run.quantities import against_limit, quantity
from maxq.tools.cli.frame import CommandError, Exit
from maxq.tools.cli.terminal import aligned, announce, printable, tell
from maxq.tools.exchange.export import logged_flight
from maxq.tools.pages.render import render
from maxq.tools.plots.residuals import residual_plots

RECORD_NAME, TABLE_NAME, PAGE_NAME = "comparison.json", "residuals.csv", "comparison.html"


def execute(
    place: str,
    measured: str,
    *,
    columns: str | None = None,
    alias: tuple[tuple[str, str], ...] = (),
    shift: float | None = None,
    most_shift: float = MOST_SHIFT_S,
    limit: tuple[tuple[str, float], ...] = (),
    out: str | None = None,
) -> int:
    """Compare a log with a file of measured series, write the files, print the table, and return the exit code."""
    announce(f"reading {place}")
    log = logged_flight(place, "compare")
    folder = Path(out) if out is not None else Path(log.path).parent / "comparison"
    check_writable(folder)
    try:
        flight = WithImpacts(log)
    except LogError as error:
        raise CommandError(f"{place}: {error}") from None
    series = read_measured(measured, flight.table, columns, dict(alias))
    limits = [limit_of(name, bound, [each.name for each in series.channels]) for name, bound in limit]
    try:
        found = compare(flight, series, shift, most_shift)
    except ComparisonError as error:
        raise CommandError(f"{measured}: {error}") from None
    if lost := [m.channel for m in limits if m.channel not in {each.name for each in found.channels}]:
        raise CommandError(f"--limit {lost[0]}: this channel has no measured values in the time of the flight")
    missed = found.violated(limits)
    outcome, code = verdict(found, limits, missed)
    rows = residual_rows(found.channels)
    write_whole(folder / TABLE_NAME, residual_table(found.channels))
    write_whole(folder / RECORD_NAME, json.dumps(_record(place, series, found, limits, outcome), indent=1) + "\n")
    page = render(
        "comparison.html.j2",
        residual_plots(found.channels),
        kind="Flight compared with measurements",
        title=str(flight.loaded.name),
        facts=(
            ("log", str(place)),
            ("measured", measured),
            ("time shift", _shift_text(found).removeprefix("time shift ")),
        ),
        outcome_line=outcome,
        tone="open" if not limits else "bad" if missed else "good",
        tables=[("Channels", "", rows, (1, 2, 3, 4, 5, 6), "Residuals: measured minus flown.")],
    )
    files = [folder / TABLE_NAME, folder / RECORD_NAME, write_whole(folder / PAGE_NAME, page)]
    tell(f"{place} and {measured}: {_shift_text(found)}", "")
    tell(*aligned(rows, "  ", right=(1, 2, 3, 4, 5, 6), drop=(1, 6)))
    for note in notes_of(series, found):
        tell(f"  {printable(note)}")
    tell("", *files, "", outcome)
    return code


def limit_of(name: str, bound: float, channels: Sequence[str]) -> ResidualLimit:
    """Return the limit of `--limit CHANNEL=VALUE` or `--limit CHANNEL.STATISTIC=VALUE`. Raises CommandError."""
    channel, _, statistic = name.partition(".")
    if channel not in channels:
        raise CommandError(f"--limit {name}: this channel is not measured; allowed: {', '.join(channels)}")
    if (statistic or "largest") not in STATISTICS:
        raise CommandError(f"--limit {name}: allowed after the channel: {', '.join(STATISTICS)}")
    return ResidualLimit(channel, statistic or "largest", bound)


def verdict(
    found: SeriesComparison, limits: Sequence[ResidualLimit], missed: Sequence[ResidualLimit]
) -> tuple[str, Exit]:
    """Return the last line of the command and its exit code."""
    if not limits:
        worst = max(found.channels, key=lambda each: -1.0 if math.isnan(each.share) else each.share)
        share = f"; largest share of the range: {worst.name}, {100.0 * worst.share:.2g} %" if worst.share > 0.0 else ""
        return f"COMPARED: {len(found.channels)} channel{'s' * (len(found.channels) != 1)}, no limits{share}", Exit.OK
    count = f"{len(limits) - len(missed)} of {len(limits)} limits met"
    if not missed:
        return f"PASSED: {_limit_text(found, limits[0])}; {count}", Exit.OK
    return f"FAILED: {_limit_text(found, missed[0])}; {count}", Exit.FAILED


def _limit_text(found: SeriesComparison, limit: ResidualLimit) -> str:
    each = next(each for each in found.channels if each.name == limit.channel)
    value = each.value_of(limit.statistic)
    text, bound, unit = against_limit(value, "limit", limit.bound, each.measured.unit)
    at = f" at {each.time_s[each.worst]:.3f} s" if limit.statistic == "largest" else ""
    sign = "<=" if value <= limit.bound else ">"
    return f"{STATISTICS[limit.statistic]} of {limit.channel} {text} {sign} {bound} {unit}".rstrip() + at


def residual_rows(channels: Sequence[Residuals]) -> list[tuple[str, ...]]:
    """Return the table of channels, with its heads first."""
    rows: list[tuple[str, ...]] = [("channel", "values", "RMS", "bias", "largest", "at", "RMS / range")]
    for each in channels:
        cells = [
            " ".join(quantity(value, each.measured.unit)).rstrip() for value in (each.rms, each.bias, each.largest)
        ]
        at = f"{each.time_s[each.worst]:.3f} s"
        rows.append(
            (
                each.name,
                str(len(each.residual)),
                *cells,
                at,
                f"{100.0 * each.share:.2g} %" if each.share >= 0.0 else "-",
            )
        )
    return rows


def residual_table(channels: Sequence[Residuals]) -> str:
    """Return the residuals as CSV: a row for each measured value."""
    lines = ["channel,unit,time_s,measured,flown,residual"]
    for each in channels:
        rows = zip(each.time_s, each.values, each.modelled, each.residual, strict=True)
        lines += [f"{each.name},{each.measured.unit},{t:.9g},{y:.9g},{x:.9g},{r:.9g}" for t, y, x, r in rows]
    return "\n".join(lines) + "\n"


def notes_of(series: MeasuredSeries, found: SeriesComparison) -> list[str]:
    """Return notes on what was not compared."""
    notes = [f"{each.name}: {each.measured.gaps} empty cells" for each in found.channels if each.measured.gaps]
    notes += [f"{each.name}: {each.outside} values outside the flight" for each in found.channels if each.outside]
    there = {each.name for each in found.channels}
    notes += [f"{each.name}: no values in the time of the flight" for each in series.channels if each.name not in there]
    if series.unused:
        notes.append(f"columns without a channel: {', '.join(series.unused)}")
    if found.at_end:
        notes.append("the time shift is at the end of its range; --most-shift S makes it larger")
    return notes


def _shift_text(found: SeriesComparison) -> str:
    if math.isnan(found.shift_sigma_s):
        return f"time shift {found.shift_s:g} s, given"
    return f"time shift {found.shift_s:.4f} +- {found.shift_sigma_s:.2g} s (1 sigma), estimated"


def _record(
    place: str, series: MeasuredSeries, found: SeriesComparison, limits: Sequence[ResidualLimit], outcome: str
) -> dict[str, object]:
    missed = found.violated(limits)
    return {
        "log": str(place),
        "measured": series.file,
        "outcome": outcome.partition(":")[0],
        "shift_s": found.shift_s,
        "shift_sigma_s": None if math.isnan(found.shift_sigma_s) else found.shift_sigma_s,
        "channels": [each.as_json() for each in found.channels],
        "limits": [
            {"channel": limit.channel, "statistic": limit.statistic, "limit": limit.bound, "met": limit not in missed}
            for limit in limits
        ],
        "unused": list(series.unused),
        "notes": notes_of(series, found),
    }
