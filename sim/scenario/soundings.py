"""The reader of wind soundings in the formats of weather services, which any key for a wind profile accepts.

The format is detected from the content:
- University of Wyoming: the text list (also inside its HTML page) and the CSV file.
- IGRA version 2 (NOAA/NCEI): station files of fixed-width records, with one or more soundings.
- CSV with column names in units other than those of maxq: `height_ft`, `pressure_hPa`, `speed_kt`,
  `wind direction_degree`, `u_mps` and others. Unknown columns are ignored.

The result has the columns altitude_m, north_mps and east_mps, and a date. The date is read from the headers of IGRA and
Wyoming files. In CSV, it is read from a line `# date: 2002-11-28` or from the first row. Rows may be in any order.
Levels without wind are omitted, and the first of several levels at one altitude is kept. Geopotential heights are
converted to geometric heights (r0 = 6356.766 km). A missing height is interpolated in ln p between levels with both
height and pressure. If fewer than two levels have both, it follows from the pressure by the US Standard Atmosphere
1976, with an error of up to some hundreds of metres in real air.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from maxq.sim.input.documents import Text
from maxq.sim.input.errors import refuse
from maxq.sim.input.files import Reading
from maxq.sim.input.tables_csv import DATE, Columns, CsvTable, Foreign, read_csv

_RADIUS_m = 6356766.0  # Earth radius of geopotential heights, as in the standard atmosphere
_MOST_hPa = 2000.0
NUMBER_MARK = "#"  # "station.txt#12": the twelfth sounding of a file


class SoundingLevel(NamedTuple):
    """A row of a sounding; missing values are nan. The wind is given by speed and direction, or by components."""

    line: int
    geopotential_m: float = math.nan
    altitude_m: float = math.nan
    pressure_hPa: float = math.nan
    direction_deg: float = math.nan
    speed_mps: float = math.nan
    north_mps: float = math.nan
    east_mps: float = math.nan


# by field of SoundingLevel: its names in files, and the factors of its units
_LENGTHS = {"m": 1.0, "gpm": 1.0, "ft": 0.3048, "km": 1000.0}
_SPEEDS = {
    "m/s": 1.0, "mps": 1.0, "kt": 1852.0 / 3600.0, "kts": 1852.0 / 3600.0, "knot": 1852.0 / 3600.0,
    "knots": 1852.0 / 3600.0, "km/h": 1.0 / 3.6, "kmh": 1.0 / 3.6, "kmph": 1.0 / 3.6, "mph": 0.44704,
}  # fmt: skip  # a table
_DEGREES = {"deg": 1.0, "degree": 1.0, "degrees": 1.0}
_QUANTITIES: dict[str, tuple[tuple[str, ...], dict[str, float]]] = {
    "geopotential_m": (
        ("geopotential height", "geopotential altitude", "geopotential", "gph", "hght", "hgt"),
        _LENGTHS,
    ),
    "altitude_m": (("altitude", "alt", "height"), _LENGTHS),
    "pressure_hPa": (("pressure", "pres", "press"), {"hpa": 1.0, "mb": 1.0, "mbar": 1.0, "pa": 0.01}),
    "direction_deg": (("wind direction", "direction", "from", "wind dir", "winddir", "dir", "drct", "wdir"), _DEGREES),
    "speed_mps": (("wind speed", "windspeed", "speed", "wind spd", "spd", "sknt", "sped", "wspd"), _SPEEDS),
    "north_mps": (("north", "v", "v wind", "northward wind"), _SPEEDS),
    "east_mps": (("east", "u", "u wind", "eastward wind"), _SPEEDS),
}
_IMPLIED = {"sknt": "kt", "drct": "deg", "hght": "m", "pres": "hpa"}  # units of Wyoming's names
_IGRA = re.compile(r"#[A-Z0-9]{11} (\d{4}) (\d\d) (\d\d) (\d\d) ")
_MONTHS = ("Jan", "Feb", "Mar", "Apr", "May", "Jun", "Jul", "Aug", "Sep", "Oct", "Nov", "Dec")
_OBSERVED = re.compile(rf"\bat (\d\d)Z (\d{{1,2}}) ({'|'.join(_MONTHS)})[a-z]* (\d{{4}})")
_WYOMING = re.compile(r"\bPRES\b.*\bHGHT\b.*\bDRCT\b.*\b(SKNT|SPED)\b")


def quantity(name: str, shown: str = "") -> tuple[str, float] | None:
    """Return the field of `SoundingLevel` in the column `name` of the file `shown`, and the factor to its unit.

    The result is None for an unknown column. Raises PydanticCustomError if the column is known but its unit is not.
    """
    whole = name.strip().lower()
    found = re.fullmatch(r"(.+?)[ _]?[_(\[]([^_()\[\]]+)[)\]]?", whole)
    for words, unit in (*(((found[1], found[2].strip()),) if found else ()), (whole, "")):
        for what, (names, units) in _QUANTITIES.items():
            if words.replace("_", " ").strip() in names:
                given = unit or _IMPLIED.get(words, "")
                if given in units:
                    return what, units[given]
                problem = f'column "{name.strip()}" has no unit that is known'
                raise refuse(problem, f"{words}_UNIT with {', '.join(units)}", file=shown, place="column names")
    return None


class Sounding(NamedTuple):
    levels: list[SoundingLevel]
    date: str  # in the form of `CsvTable.date`


def soundings(text: str, native: Iterable[str] = (), shown: str = "") -> list[Sounding]:
    """Return all soundings in the text of the file `shown`.

    The result is empty for a file of another kind, and for a CSV file with `native` columns only.
    """
    lines = text.splitlines()
    first = next((line for line in lines if line.strip()), "")
    if _IGRA.match(first):
        return list(_igra(lines))
    if any(_WYOMING.search(line) for line in lines):
        return list(_wyoming(lines))
    return _csv(lines, frozenset(native), shown)


def date_of(text: str) -> str:
    """Return the date in a comment of a CSV file, or an empty string if there is none."""
    found = re.search(rf"^#\s*date\s*[:=]?\s*({DATE})", text, re.MULTILINE | re.IGNORECASE)
    return found[1] if found else ""


def _igra(lines: Sequence[str]) -> Iterator[Sounding]:
    """Yield the soundings of an IGRA 2 file: pressure in Pa, geopotential height in m, wind in deg and 0.1 m/s."""
    levels, date = list[SoundingLevel](), ""
    for number, line in enumerate(lines, start=1):
        if line.startswith("#"):
            if levels:
                yield Sounding(levels, date)
            head = _IGRA.match(line)
            levels, date = [], f"{head[1]}-{head[2]}-{head[3]}" + f"T{head[4]}" * (head[4] != "99") if head else ""
        elif line.strip():
            pressure, height, direction, speed = (_value(line[a:b]) for a, b in ((9, 15), (16, 21), (40, 45), (46, 51)))
            levels.append(SoundingLevel(number, height, math.nan, 0.01 * pressure, direction, 0.1 * speed))
    if levels:
        yield Sounding(levels, date)


def _wyoming(lines: Sequence[str]) -> Iterator[Sounding]:
    """Yield the soundings of a Wyoming file, in which each cell ends below the end of its column name."""
    levels, date, coming = list[SoundingLevel](), "", ""
    cells: list[tuple[str, float, int, int]] = []
    for number, line in enumerate(re.sub(r"<[^>]*>", "", line).rstrip() for line in lines):
        observed = _OBSERVED.search(line)
        if observed:
            coming = f"{observed[4]}-{_MONTHS.index(observed[3]) + 1:02}-{int(observed[2]):02}T{observed[1]}"
        if _WYOMING.search(line):
            if levels:
                yield Sounding(levels, date)
            levels, cells, date, coming = [], [], coming, ""
            ends = [word.end() for word in re.finditer(r"\S+", line)]
            units = lines[number + 1] if number + 1 < len(lines) else ""
            for start, end in zip([0, *ends], ends, strict=False):
                word, unit = line[start:end].strip(), units[start:end].strip()
                known = quantity(f"{word}_{unit}" if unit else word)
                if known is not None:
                    cells.append((*known, start, end))
        elif cells and line.strip():
            found = {what: factor * _value(line[start:end]) for what, factor, start, end in cells}
            if re.fullmatch(r"[-\d. ]+", line) and not all(map(math.isnan, found.values())):
                levels.append(SoundingLevel(number + 1, **found))
            elif levels:  # the table has ended: indices of the station follow
                cells = []
    if levels:
        yield Sounding(levels, date)


def _csv(lines: Sequence[str], native: frozenset[str], shown: str) -> list[Sounding]:
    """Return the sounding of a CSV table, or an empty list if it has no wind or only native columns."""
    rows = [(n, line.split(",")) for n, line in enumerate(lines, start=1) if line.strip() and not line.startswith("#")]
    if not rows:
        return []
    if {name.strip() for name in rows[0][1]} <= native:
        return []
    found = [quantity(name, shown) for name in rows[0][1]]
    there = {known[0] for known in found if known is not None}
    if not ({"direction_deg", "speed_mps"} <= there or {"north_mps", "east_mps"} <= there):
        pairs = (("speed_mps", "direction_deg"), ("north_mps", "east_mps"))
        lacks = [b for pair in pairs for a, b in (pair, pair[::-1]) if a in there and b not in there]
        foreign = [n.strip() for n, known in zip(rows[0][1], found, strict=True) if known and n.strip() not in native]
        if lacks and foreign:
            names = " or ".join(f"{name}_<unit>" for name in _QUANTITIES[lacks[0]][0][:2])
            problem = f"is a sounding by its column {foreign[0]}, but has none of the wind's {lacks[0].split('_')[0]}"
            raise refuse(problem, names, file=shown, place="line 1")
        return []
    levels = []
    for number, cells in rows[1:]:
        if len(cells) != len(found):
            problem = f"has {len(cells)} columns, the first line has {len(found)}"
            raise refuse(problem, f"{len(found)} cells", file=shown, place=f"line {number}")
        values = {known[0]: known[1] * _value(cell) for known, cell in zip(found, cells, strict=True) if known}
        levels.append(SoundingLevel(number, **values))
    first = re.search(DATE, ",".join(rows[1][1])) if len(rows) > 1 else None
    return [Sounding(levels, date_of("\n".join(lines)) or (first[0].replace(" ", "T") if first else ""))]


def _value(cell: str) -> float:
    """Return the number in a cell, or nan if it is missing: no number, -999 or less, or 99999."""
    try:
        value = float(cell)
    except ValueError:
        return math.nan
    return math.nan if value <= -999.0 or value == 99999.0 else value


def wind_table(levels: Iterable[SoundingLevel], name: str, shown: str, date: str = "") -> CsvTable:
    """Return the wind profile of a sounding. Raises PydanticCustomError if no level has both height and wind."""
    rows = np.array(list(levels), dtype=float).reshape(-1, len(SoundingLevel._fields))
    line, geopotential, altitude, pressure, direction, speed, north, east = rows.T
    altitude = np.where(np.isnan(altitude), _geometric(geopotential), altitude)
    altitude = np.where(np.isnan(altitude), _from_pressure(altitude, pressure), altitude)
    polar = (direction >= 0.0) & (direction <= 360.0) & (speed >= 0.0)
    turned = np.deg2rad(np.where(polar, direction, 0.0))
    north = np.where(np.isnan(north) & polar, -speed * np.cos(turned), north)
    east = np.where(np.isnan(east) & polar, -speed * np.sin(turned), east)
    good = np.flatnonzero(np.isfinite(altitude) & np.isfinite(north) & np.isfinite(east))
    if not len(good):
        raise refuse("the sounding has no level with height and wind", "one level or more", file=shown)
    _, once = np.unique(altitude[good], return_index=True)
    kept = good[once]
    columns = {"altitude_m": altitude[kept], "north_mps": north[kept], "east_mps": east[kept]}
    return CsvTable(name, columns, shown, tuple(int(n) for n in line[kept]), date)


def _geometric(geopotential_m: np.ndarray) -> np.ndarray:
    return np.asarray(_RADIUS_m * geopotential_m / (_RADIUS_m - geopotential_m))


def _from_pressure(altitude_m: np.ndarray, pressure_hPa: np.ndarray) -> np.ndarray:
    """Return the geometric altitude (levels,), m, for each pressure.

    The altitude is interpolated in ln p between the levels with altitude and pressure. With fewer than two such levels,
    it is that of the standard atmosphere. Pressures that no air on Earth has count as missing.
    """
    real = (pressure_hPa > 0.0) & (pressure_hPa < _MOST_hPa)
    both, pressed = np.isfinite(altitude_m) & real, np.where(real, pressure_hPa, math.nan)
    if both.sum() < 2:
        from maxq.sim.world.atmosphere import pressure_altitude  # noqa: PLC0415  # lazy: it imports the compiler

        return pressure_altitude(100.0 * pressed)
    order = np.argsort(pressure_hPa[both])
    known = np.log(pressed[both])[order], altitude_m[both][order]
    return np.asarray(np.interp(np.log(pressed), *known, left=math.nan, right=math.nan))


def _profile(name: Text, reading: Reading, columns: Columns) -> CsvTable:
    """Return the wind profile that `name` denotes: a sounding, or a CSV file with native columns."""
    file, number = _parted(name)
    shown, text, found = _read(file, reading, columns)
    if not found:
        return replace(read_csv(text, str(name), shown, columns), date=date_of(text))
    if number is None and len(found) == 1:
        number = 1
    if number is None or not 1 <= number <= len(found):
        allowed = f"{file}{NUMBER_MARK}1 .. {file}{NUMBER_MARK}{len(found)}"
        raise refuse(f"holds {len(found)} soundings: which one is missing", allowed, file=shown)
    return wind_table(found[number - 1].levels, str(name), shown, found[number - 1].date)


SOUNDING = Foreign("a sounding", _profile)


def each_sounding(value: Any, context: Any, columns: Columns) -> Any:
    """Return the names of the profiles that a list denotes; a value that is no list is returned unchanged.

    A folder stands for its files in the order of their names, and a file for each of its soundings.
    """
    if not isinstance(value, Sequence) or not isinstance(context, Reading):
        return value
    out: list[Any] = []
    for item in value:
        if not isinstance(item, Text):
            out.append(item)
            continue
        for name in context.files_in(item):
            file, number = _parted(name)
            count = len(_read(file, context, columns)[2]) if number is None else 0
            numbered = (name.like(f"{name}{NUMBER_MARK}{k}") for k in range(1, count + 1))
            out += numbered if count > 1 else [name]
    return tuple(out)


def _read(file: Text, reading: Reading, columns: Columns) -> tuple[str, str, list[Sounding]]:
    """Return the displayed name of a file, its text, and its soundings, which are parsed once."""
    shown, text = reading.read_table(file)
    if shown not in reading.soundings:
        reading.soundings[shown] = soundings(text, columns.known(), shown)
    return shown, text, reading.soundings[shown]


def _parted(name: Text) -> tuple[Text, int | None]:
    """Return the file and the number in "file#12"; the number is None without a mark."""
    file, mark, number = name.rpartition(NUMBER_MARK)
    if not mark or not number.isdecimal():
        return name, None
    return name.like(file), int(number)
