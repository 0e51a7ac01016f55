"""Measured time series from CSV files, with headings and units of other programs, as channels of a log.

A heading consists of a name and a unit: `Altitude (ft)`, `Altitude [ft]`, `altitude_ft`. It denotes the channel of that
name (`altitude_m`), one of the names in _OTHER_NAMES, or the channel given for it in a file of columns:

    time = "Time (ms)"                       # default: the first column whose name is time or t
    [[column]]
    heading = "Baro"
    channel = "altitude_m"
    unit = "ft"
    add = 36.0
    sigma = 2.0

Headings may be a comment, as in exports of OpenRocket and RocketPy. Cells are separated by commas, semicolons (with a
point or a comma in numbers) or tabs. Empty cells and nan are gaps.
"""

from __future__ import annotations

import difflib
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from pydantic import Field, ValidationError

from maxq.control.kernel.records import Array
from maxq.sim.flight.channels import ChannelTable, unit_suffix
from maxq.sim.input.documents import Source, parse, plain
from maxq.sim.input.errors import ScenarioError
from maxq.sim.input.files import Reading
from maxq.sim.input.values import NotNegative, Positive, Section, optional
from maxq.sim.run.units import name_suffixes, to_unit, units_like
from maxq.sim.scenario.messages import explain

_OTHER_NAMES = {
    "total velocity": "speed_mps",
    "speed - velocity magnitude": "speed_mps",
    "mach number": "mach",
    "angle of attack": "alpha_total_deg",
    "air pressure": "pressure_Pa",
    "air temperature": "temperature_K",
    "air density": "density_kgpm3",
}
_TIMES = ("time", "t", "timestamp")
_GAPS = ("", "nan", "na", "n/a", "-", "null")
_FEWEST = 3


class MeasuredColumn(Section):
    """The meaning of a column."""

    heading: str = Field(description="heading of the column, or its name without the unit")
    channel: str = Field(description="log channel (docs/telemetry.md); empty: none")
    unit: str = optional("unit of the column (default: that in its heading, else that of the channel)", "")
    add: float = optional("added to the values, in the unit of the channel", 0.0)
    sigma: Positive | None = optional("1-sigma measurement noise, in the unit of the channel")
    bias_sigma: NotNegative = optional("1-sigma constant error, in the unit of the channel", 0.0)


class ColumnsFile(Section):
    """The meanings of the columns of a measured series."""

    time: str = optional("heading of the column of times (default: the first whose name is time or t)", "")
    column: tuple[MeasuredColumn, ...] = optional("meanings of columns", ())


@dataclass(frozen=True)
class MeasuredChannel:
    """A measured series of a log channel: `time_s` (n,) and `values` (n,) in the unit of the channel, without gaps.

    `sigma` is the 1-sigma noise (nan: unknown), and `bias_sigma` that of a constant error. `heading` is the name in the
    file, and `gaps` the number of its empty cells.
    """

    name: str
    unit: str
    heading: str
    time_s: Array
    values: Array
    sigma: float = math.nan
    bias_sigma: float = 0.0
    gaps: int = 0


@dataclass(frozen=True)
class MeasuredSeries:
    """The measured channels of a file, and the headings of the columns that were not used."""

    file: str
    channels: tuple[MeasuredChannel, ...]
    unused: tuple[str, ...]


def read_measured(
    path: str | Path,
    table: ChannelTable,
    columns: str | Path | None = None,
    aliases: Mapping[str, str] | None = None,
    sigmas: Mapping[str, float] | None = None,
) -> MeasuredSeries:
    """Return the measured series in a CSV file, as channels of `table`.

    `columns` is a file of columns, `aliases` are channels by heading, and `sigmas` the noise by channel; the latter two
    precede the file. Columns without a channel are ignored. Raises ScenarioError for a file that cannot be read and for
    times that do not increase. The same applies to a unit that does not fit its channel, to an unknown channel or
    heading, and if no column is used.
    """
    file = _columns_file(columns)
    given = {each.heading: each for each in file.column}
    given |= {heading: MeasuredColumn(heading=heading, channel=name) for heading, name in (aliases or {}).items()}
    label = str(path)
    headings, cells, lines = _cells(Path(path), label)
    time_at = _time_column(headings, file.time, label, columns)
    wanted = _wanted(headings, given, table, label, columns)
    times = _times(headings[time_at], cells[time_at], lines, label)
    found: dict[str, MeasuredChannel] = {}
    for at, column in wanted.items():
        if at == time_at or column is None:
            continue
        if column.channel in found:
            raise ScenarioError(
                label,
                f"two columns denote {column.channel}: {found[column.channel].heading!r} and {headings[at]!r}",
                allowed="one; name another channel, or none, by --alias",
            )
        unit = table.channel(column.channel).unit
        factor, offset = _conversion(headings[at], column, unit, label)
        values = factor * _numbers(cells[at], headings[at], lines, label) + offset + column.add
        known = np.isfinite(values)
        if known.sum() < _FEWEST:
            allowed = f"at least {_FEWEST}, or no channel for this column"
            raise ScenarioError(label, f"has {known.sum()} numbers", headings[at], allowed=allowed)
        sigma = (sigmas or {}).get(column.channel, math.nan if column.sigma is None else column.sigma)
        found[column.channel] = MeasuredChannel(
            column.channel,
            unit,
            headings[at],
            times[known],
            values[known],
            sigma,
            column.bias_sigma,
            int(len(values) - known.sum()),
        )
    if not found:
        problem = f"no column denotes a channel of the log: {', '.join(headings)}"
        raise ScenarioError(label, problem, allowed="--alias 'HEADING=CHANNEL' (docs/telemetry.md)")
    if unknown := [name for name in (sigmas or {}) if name not in found]:
        raise ScenarioError(label, "is not measured", unknown[0], allowed=", ".join(found))
    unused = [heading for n, heading in enumerate(headings) if n != time_at and wanted.get(n) is None]
    return MeasuredSeries(label, tuple(found.values()), tuple(unused))


def _columns_file(path: str | Path | None) -> ColumnsFile:
    if path is None:
        return ColumnsFile()
    file = Path(path)
    tree = parse(Reading().text(file, str(path), "a TOML file"), Source(str(path), (file.parent,)))
    try:
        return ColumnsFile.model_validate(plain(tree))
    except ValidationError as error:
        raise explain(error, tree, ColumnsFile) from None


def _cells(path: Path, label: str) -> tuple[list[str], list[tuple[str, ...]], list[int]]:
    """Return the headings, the columns of cells, and the lines of the rows, from 1."""
    rows, lines, comments = list[str](), list[int](), list[str]()
    for number, line in enumerate(Reading().text(path, label, "a CSV file").splitlines(), start=1):
        text = line.strip()
        if text.startswith("#"):
            if len(rows) <= 1:
                comments.append(text.lstrip("# "))
        elif text:
            rows.append(line)
            lines.append(number)
    if not rows:
        raise ScenarioError(label, "is empty", allowed="headings, then rows of numbers")
    mark = max(("\t", ";", ","), key=(rows[0] + rows[-1]).count)
    split = [_split(row, mark) for row in rows]
    heads = split[0]
    if any(_number(cell, mark) is not None for cell in heads if cell.lower() not in _GAPS):  # headings in a comment
        heads = next((h for c in reversed(comments) if len(h := _split(c, mark)) == len(heads)), [])
        if not heads:
            raise ScenarioError(
                label, "has no headings", allowed="a first line, or a comment, with the names of columns"
            )
    else:
        split, lines = split[1:], lines[1:]
    if not split:
        raise ScenarioError(label, "has headings but no rows", allowed="rows of numbers")
    for row, number in zip(split, lines, strict=True):
        if len(row) != len(heads):
            problem = f"has {len(row)} cells, the headings {len(heads)}"
            raise ScenarioError(label, problem, f"line {number}", allowed=f"{len(heads)} cells")
    if mark == ";":
        split = [[cell.replace(",", ".") for cell in row] for row in split]
    return heads, list(zip(*split, strict=True)), lines


def _split(line: str, mark: str) -> list[str]:
    return [re.sub(r"\(\)$", "", cell.replace("\u200b", "").strip().strip('"')).strip() for cell in line.split(mark)]


def _number(cell: str, mark: str = ",") -> float | None:
    try:
        return float(cell.replace(",", ".") if mark == ";" else cell)
    except ValueError:
        return None


def _numbers(cells: Sequence[str], heading: str, lines: Sequence[int], label: str) -> Array:
    """Return the numbers of a column; nan for gaps."""
    out = np.full(len(cells), math.nan)
    for n, cell in enumerate(cells):
        if cell.lower() in _GAPS:
            continue
        value = _number(cell)
        if value is None:
            problem, allowed = f"{cell!r} is not a number", "a number; an empty cell or nan for a gap"
            raise ScenarioError(label, problem, f"line {lines[n]}, {heading}", allowed=allowed)
        out[n] = value if math.isfinite(value) else math.nan
    return out


def _parts(heading: str) -> tuple[str, str]:
    """Return the name, in lower case with spaces, and the unit of a heading; the unit is empty if it has none."""
    if found := re.fullmatch(r"(.*?)\s*[(\[]([^()\[\]]*)[)\]]", heading):
        return _plain(found[1]), found[2].strip() or "1"
    stem, _, end = heading.rpartition("_")
    if stem and end.lower() in name_suffixes():
        return _plain(stem), name_suffixes()[end.lower()]
    return _plain(heading), ""


def _plain(name: str) -> str:
    return " ".join(name.replace("_", " ").split()).lower()


def _time_column(headings: Sequence[str], given: str, label: str, columns: str | Path | None) -> int:
    if given:
        found = [n for n, heading in enumerate(headings) if given in (heading, _parts(heading)[0])]
        if not found:
            raise ScenarioError(
                str(columns), f"{label} has no such column", "time", allowed=", ".join(headings), value=given
            )
        return found[0]
    found = [n for n, heading in enumerate(headings) if _parts(heading)[0] in _TIMES]
    if not found:
        problem = f"has no column of times: {', '.join(headings)}"
        raise ScenarioError(
            label, problem, allowed=f"a heading {' or '.join(_TIMES)}, or the key time of a file of columns"
        )
    return found[0]


def _times(heading: str, cells: Sequence[str], lines: Sequence[int], label: str) -> Array:
    unit = _parts(heading)[1]
    conversion = to_unit(unit or "s", "s")
    if conversion is None:
        raise ScenarioError(label, f"the unit {unit!r} is no time", heading, allowed=", ".join(units_like("s")))
    times = conversion[0] * _numbers(cells, heading, lines, label)
    wrong = np.flatnonzero(~(np.diff(times, prepend=-math.inf) > 0.0))
    if len(wrong):
        problem = "the times do not increase" if np.isfinite(times[wrong[0]]) else "a time is missing"
        allowed, cell = "strictly increasing times", _number(cells[wrong[0]]) or 0.0
        raise ScenarioError(label, problem, f"line {lines[wrong[0]]}, {heading}", allowed=allowed, value=cell)
    return times


def _wanted(
    headings: Sequence[str],
    given: Mapping[str, MeasuredColumn],
    table: ChannelTable,
    label: str,
    columns: str | Path | None,
) -> dict[int, MeasuredColumn | None]:
    """Return the meaning of each column, by index; None for a column without a channel."""
    out: dict[int, MeasuredColumn | None] = {}
    for heading, column in given.items():
        at = [
            n
            for n, known in enumerate(headings)
            if heading in (known, _parts(known)[0]) or _plain(heading) == _parts(known)[0]
        ]
        if not at:
            near = difflib.get_close_matches(heading, headings, 1)
            hint = f"; did you mean {near[0]!r}?" if near else ""
            raise ScenarioError(label, f"has no column {heading!r}{hint}", allowed=", ".join(headings))
        if column.channel and column.channel not in table:
            near = difflib.get_close_matches(column.channel, table.names, 1)
            problem = f"no channel {column.channel!r}" + (f"; did you mean {near[0]}?" if near else "")
            raise ScenarioError(label, problem, heading, allowed="a channel of the log (docs/telemetry.md)")
        out[at[0]] = column if column.channel else None
    stems = {_plain(name.removesuffix(f"_{unit_suffix(table.channel(name).unit)}")): name for name in table.names}
    for n, heading in enumerate(headings):
        if n not in out:
            name = _parts(heading)[0]
            channel = heading if heading in table else stems.get(name, _OTHER_NAMES.get(name, ""))
            out[n] = MeasuredColumn(heading=heading, channel=channel) if channel in table else None
    return out


def _conversion(heading: str, column: MeasuredColumn, unit: str, label: str) -> tuple[float, float]:
    given = column.unit or ("" if heading == column.channel else _parts(heading)[1])
    found = to_unit(given or unit, unit)
    if found is None:
        problem = f"the unit {given!r} does not fit {column.channel}, in {unit}"
        raise ScenarioError(label, problem, heading, allowed=", ".join(units_like(unit)))
    return found
