"""Wind soundings as weather services give them, read where a wind profile is named.

The format is told by the content:
- University of Wyoming: the text list (also within its HTML page) and the CSV file;
- IGRA version 2 (NOAA/NCEI), the station files of fixed-width records, one sounding or thousands;
- CSV whose column names carry other units than ours: `height_ft`, `pressure_hPa`, `speed_kt`, `wind direction_degree`,
  `u_mps` ...; columns that are not wanted are passed over.

What comes of it are columns altitude_m, north_mps, east_mps, and the date: of IGRA's and Wyoming's heads, or in CSV of
a line `# date: 2002-11-28` or the first row. Rows may stand in any order; levels without wind are left out, of several
at one altitude the first is kept. Geopotential heights become geometric ones (r0 = 6356.766 km). A
level without height gets it from its pressure, linearly in ln p between levels that have both; where none has a height,
from the pressures of the US Standard Atmosphere 1976, which in real air may be some hundreds of metres off.
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

_RADIUS_m = 6356766.0  # of geopotential heights, as in the standard atmosphere
NUMBER_MARK = "#"  # "station.txt#12": the twelfth sounding of a file


class SoundingLevel(NamedTuple):
    """A row of a sounding; nan: missing. `speed` and `direction`, or `north` and `east`, m/s and deg."""

    line: int
    geopotential_m: float = math.nan
    altitude_m: float = math.nan
    pressure_hPa: float = math.nan
    direction_deg: float = math.nan
    speed_mps: float = math.nan
    north_mps: float = math.nan
    east_mps: float = math.nan


# quantity: the field of Level, its names, and the units that it may have
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
    """The field of `Level` that a column of the file `shown` holds, and the factor to its unit.

    Raises PydanticCustomError where the column is known and its unit is not.
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
    date: str  # as `CsvTable.date`


def soundings(text: str, native: Iterable[str] = (), shown: str = "") -> list[Sounding]:
    """All soundings in the text of the file `shown`; none in a file of another kind, or of `native` columns alone."""
    lines = text.splitlines()
    first = next((line for line in lines if line.strip()), "")
    if _IGRA.match(first):
        return list(_igra(lines))
    if any(_WYOMING.search(line) for line in lines):
        return list(_wyoming(lines))
    return _csv(lines, frozenset(native), shown)


def date_of(text: str) -> str:
    """The date that a comment of a CSV file states; empty without one."""
    found = re.search(rf"^#\s*date\s*[:=]?\s*({DATE})", text, re.MULTILINE | re.IGNORECASE)
    return found[1] if found else ""


def _igra(lines: Sequence[str]) -> Iterator[Sounding]:
    """Fixed columns of IGRA's version 2: pressure Pa, geopotential height m, direction deg, speed 0.1 m/s."""
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
    """Cells end where the words of the head end: an empty one is missing."""
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
    """A table with a line of names; empty where no column holds wind, or all columns are ours."""
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
    """A number, or nan where it is missing: empty, no number, or one of the codes -999, -8888, -9999, 99999."""
    try:
        value = float(cell)
    except ValueError:
        return math.nan
    return math.nan if value <= -999.0 or value == 99999.0 else value


def wind_table(levels: Iterable[SoundingLevel], name: str, shown: str, date: str = "") -> CsvTable:
    """The wind profile of a sounding. Raises PydanticCustomError where no level has height and wind."""
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
    """Altitude by pressure: between the levels that have both; by the standard atmosphere where fewer than two do."""
    both = np.isfinite(altitude_m) & (pressure_hPa > 0.0)
    pressed = np.where(pressure_hPa > 0.0, pressure_hPa, math.nan)
    if both.sum() < 2:
        from maxq.sim.world.atmosphere import pressure_altitude  # noqa: PLC0415  # lazy: it imports the compiler

        return pressure_altitude(100.0 * pressed)
    order = np.argsort(pressure_hPa[both])
    known = np.log(pressed[both])[order], altitude_m[both][order]
    return np.asarray(np.interp(np.log(pressed), *known, left=math.nan, right=math.nan))


def _profile(name: Text, reading: Reading, columns: Columns) -> CsvTable:
    """Return the profile of a sounding or of a CSV file, which may state its date."""
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
    """The profiles that a list means: a folder stands for the files in it in the order of their names, a file for each
    of the soundings in it.
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
    """Return the displayed name of a file, its text, and its soundings, which are looked for once."""
    shown, text = reading.read_table(file)
    if shown not in reading.soundings:
        reading.soundings[shown] = soundings(text, columns.known(), shown)
    return shown, text, reading.soundings[shown]


def _parted(name: Text) -> tuple[Text, int | None]:
    """File and number of "file#12"."""
    file, mark, number = name.rpartition(NUMBER_MARK)
    if not mark or not number.isdecimal():
        return name, None
    return name.like(file), int(number)
