"""Tables of numbers, from a CSV file or written out in the TOML file, and their checks.

A CSV file has one line of column names, then one line per row, separated by commas. Empty lines and lines that begin
with # are skipped. In a TOML file the same table is `{time_s = [0.0, 1.0], mass_kg = [10.0, 9.0]}` or a list of rows
`[{time_s = 0.0, mass_kg = 10.0}, ...]`.
"""

from __future__ import annotations

import re
from array import array
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import GetJsonSchemaHandler
from pydantic_core import CoreSchema, PydanticCustomError, core_schema

from maxq.sim.input.documents import Text
from maxq.sim.input.errors import NOTHING, Path, refuse, show_value, suggestion
from maxq.sim.input.ranges import range_of

if TYPE_CHECKING:
    from maxq.sim.input.files import Reading

Column = NDArray[np.float64]

LEAST_STEP = 1e-9
"""The least step of the axis from row to row, in its unit; slopes between rows must be finite."""

FILE_KEY, DATE_KEY = "file", "date"
"""The further keys of a table that is written out: the original file, for information only, and `CsvTable.date`."""
DATE = r"\d{4}-(?:0[1-9]|1[0-2])-\d\d(?:[T ]\d\d)?"


@dataclass(frozen=True, eq=False)
class CsvTable:
    """A table of named, read-only columns of equal length, in the order of the file.

    `file` is the file's name as given in the scenario, or empty if the scenario itself contains the table. `date` is
    the date of a wind profile, YYYY-MM-DD with or without Thh, or empty if unknown. Two tables are equal if their
    columns contain the same bits.
    """

    file: str
    columns: Mapping[str, Column]
    shown: str = ""
    lines: tuple[int, ...] = field(default=(), repr=False)
    date: str = ""
    checked_as: Columns | None = field(default=None, init=False, repr=False)
    derived: Any = field(default=None, init=False, repr=False)  # cached result derived from the columns

    def __post_init__(self) -> None:
        for column in self.columns.values():
            column.flags.writeable = False

    def keep(self, derived: Any) -> None:
        """Store a result derived from the columns alone, which never change."""
        object.__setattr__(self, "derived", derived)

    def __getitem__(self, name: str) -> Column:
        return self.columns[name]

    def __contains__(self, name: object) -> bool:
        return name in self.columns

    def __len__(self) -> int:
        return len(next(iter(self.columns.values())))

    def told(self) -> dict[str, Any]:
        """Return the table as a dictionary for JSON and TOML."""
        label = {FILE_KEY: self.file, DATE_KEY: self.date}
        return {key: text for key, text in label.items() if text} | {k: v.tolist() for k, v in self.columns.items()}

    def get(self, name: str, default: float = 0.0) -> Column:
        """Return a column, or a column of `default` if it is absent."""
        return self.columns[name] if name in self.columns else np.full(len(self), default)

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, CsvTable):
            return NotImplemented
        return list(self.columns) == list(other.columns) and all(
            self.columns[name].tobytes() == other.columns[name].tobytes() for name in self.columns
        )

    __hash__ = None  # type: ignore[assignment]  # arrays have no fast hash, and none is needed

    def refusal(
        self, problem: str, allowed: str = "", column: str = "", row: int = -1, *, value: Any = NOTHING, at: Path = ()
    ) -> PydanticCustomError:
        """Return the exception for an error in this table, with file, line and column (or key and index).

        `at` is the key of the table relative to the section being validated.
        """
        if column and row >= 0 and value is NOTHING:
            value = float(self.columns[column][row])
        if self.shown:
            line = f"line {self.lines[row]}" if row >= 0 else ""
            place = ", ".join(part for part in (line, column) if part)
            return refuse(problem, allowed, value=value, file=self.shown, place=place)
        key = (*at, column) if column else at
        return refuse(problem, allowed, (*key, row) if column and row >= 0 else key, value=value)

    def refuse_where(self, wrong: NDArray[np.bool_], column: str, problem: str, allowed: str, *, at: Path = ()) -> None:
        """Reject the first row of `column` that is `wrong`, and count the other wrong rows."""
        if wrong.any():
            more = int(wrong.sum()) - 1
            problem += f" (and in {more} more {'row' if more == 1 else 'rows'})" if more else ""
            raise self.refusal(problem, allowed, column, int(np.argmax(wrong)), at=at)


class Foreign(NamedTuple):
    """The format of another program that a file may have instead of CSV: its name in messages, and its reader.

    `read` returns None if the file is CSV, and raises the refusal of the schema for an invalid file.
    """

    words: str
    read: Callable[[Text, Reading, Columns], CsvTable | None]


@dataclass(frozen=True)
class Columns:
    """The required form of a table, which annotates a field: `Annotated[CsvTable, Columns("time_s", ...)]`.

    - `axis`: the independent column, which one of `other_axes` may replace. It must increase strictly, with two
      exceptions: `repeats` allows equal values, and `falling` names axes that decrease. `axis` itself must begin at or
      before `begins_by`.
    - `sets`: alternative sets of required columns, of which exactly one must be complete.
    - `positive`, `not_negative`: columns with these bounds.
    - `own`: the beginning of the names of further columns, which replace all sets.
    - `grid`: instead of an axis, at least one of these columns, with the other columns at each combination of their
      values (sim/vehicle/air/tables.py).

    Without an axis (empty) the table consists of samples, with any columns.
    """

    axis: str
    sets: tuple[tuple[str, ...], ...] = ((),)
    optional: tuple[str, ...] = ()
    positive: tuple[str, ...] = ()
    not_negative: tuple[str, ...] = ()
    begins_by: float | None = None
    repeats: bool = False
    grid: tuple[str, ...] = ()
    other_axes: tuple[str, ...] = ()
    falling: tuple[str, ...] = ()
    foreign: Foreign | None = None
    own: str = ""

    def axis_of(self, table: CsvTable) -> str:
        """Return the name of the table's independent column: one of `other_axes`, or `axis` by default."""
        return next((name for name in self.other_axes if name in table), self.axis)

    @property
    def named(self) -> bool:
        """Return True if only certain columns are allowed."""
        return bool(self.axis or self.grid)

    def known(self) -> list[str]:
        """Return all names that a column may have."""
        axes = [self.axis, *self.other_axes] if self.axis else [*self.grid]
        return list(dict.fromkeys([*axes, *(name for names in self.sets for name in names), *self.optional]))

    def allowed(self) -> str:
        """Return the allowed columns in words."""
        instead = f"; or {self.foreign.words}" if self.foreign else ""
        if self.grid:
            return f"columns {', '.join(self.grid)} (one or more), {', '.join(self.optional)} (one or more){instead}"
        if not self.axis:
            return "a line of column names, then lines of numbers"
        either = " or ".join(", ".join((self.axis, *names)) for names in self.sets)
        more = f" [, {', '.join(self.optional)}]" if self.optional else ""
        others = f", or over {', '.join(self.other_axes)} in place of {self.axis}" if self.other_axes else ""
        return f"columns {either}{more}{others}{instead}"

    # Hooks of pydantic: validation of such a field, and its JSON Schema.

    def __get_pydantic_core_schema__(self, source: Any, handler: Any) -> CoreSchema:
        return core_schema.with_info_plain_validator_function(self._validate)

    def __get_pydantic_json_schema__(self, schema: CoreSchema, handler: GetJsonSchemaHandler) -> dict[str, Any]:
        number = {"type": "number"}
        if not self.named:
            lists = {"type": "array", "items": number, "minItems": 1}
            return {"anyOf": [{"type": "string"}, {"type": "object", "additionalProperties": lists}]}

        def table(item: dict[str, Any], **more: Any) -> dict[str, Any]:
            properties = more | dict.fromkeys(self.known(), item)
            required = [self.axis] if self.axis and not self.other_axes else []
            closed = {"type": "object", "properties": properties, "required": required, "additionalProperties": False}
            return closed | ({"patternProperties": {f"^{self.own}": item}} if self.own else {})

        return {
            "anyOf": [
                {"type": "string", "description": f"name of a CSV file with {self.allowed()}"},
                table(
                    {"type": "array", "items": number}, **{FILE_KEY: {"type": "string"}, DATE_KEY: {"type": "string"}}
                ),
                {"type": "array", "items": table(number)},
            ]
        }

    def _validate(self, value: Any, info: core_schema.ValidationInfo) -> CsvTable:
        if isinstance(value, CsvTable):
            if value.checked_as is self:
                return value
            table = value
        elif isinstance(value, str):
            table = self._from_file(value, info.context)
        elif isinstance(value, Mapping):
            table = self._from_columns(value)
        elif isinstance(value, tuple) and value and all(isinstance(row, Mapping) for row in value):
            table = self._from_rows(value)
        else:
            raise refuse("is not a table", f"the name of a CSV file, or {self.allowed()} written out")
        self._check(table)
        object.__setattr__(table, "checked_as", self)
        return table

    def _from_file(self, name: str, context: Any) -> CsvTable:
        if not isinstance(name, Text) or context is None:
            raise refuse("names a file, but no files can be read here", "the table itself")
        reading: Reading = context
        if self.foreign and (made := self.foreign.read(name, reading, self)):
            return made
        shown, text = reading.read_table(name)
        return read_csv(text, str(name), shown, self)

    def _from_columns(self, value: Mapping[str, Any]) -> CsvTable:
        label, date = value.get(FILE_KEY, ""), value.get(DATE_KEY, "")
        for key, given in ((FILE_KEY, label), (DATE_KEY, date)):
            if not isinstance(given, str):
                raise refuse("must be a text", key=key)
        if date and not re.fullmatch(DATE, date):
            raise refuse("is not a date", "YYYY-MM-DD, or YYYY-MM-DDThh", (DATE_KEY,), value=date)
        columns: dict[str, Column] = {}
        for name, numbers in value.items():
            if name in (FILE_KEY, DATE_KEY):
                continue
            self._check_name(name, key=(name,))
            if not isinstance(numbers, tuple):
                raise refuse("is not a list of numbers", "a list of numbers", (name,))
            columns[name] = np.array([_number(n, (name, row)) for row, n in enumerate(numbers)], dtype=np.float64)
        return CsvTable(str(label), columns, date=str(date))

    def _from_rows(self, rows: tuple[Mapping[str, Any], ...]) -> CsvTable:
        names = list(rows[0])
        for n, row in enumerate(rows):
            for name in row:
                self._check_name(name, key=(n, name))
            odd = set(names).symmetric_difference(row)
            if odd:
                raise refuse(f"this row and the first differ in {sorted(odd)[0]}", "the same keys in each row", (n,))
        cells = {name: [_number(row[name], (n, name)) for n, row in enumerate(rows)] for name in names}
        return CsvTable("", {name: np.array(numbers) for name, numbers in cells.items()})

    def _check_name(self, name: str, key: Path = (), file: str = "", place: str = "") -> None:
        if self.named and name not in self.known() and not self._is_own(name):
            hint = suggestion(name, self.known(), cutoff=0.75)  # for less similar names, the list is more helpful
            problem = f"unknown column {show_value(name)}" + (f"; {hint}" if hint else "")
            raise refuse(problem, self.allowed(), key, file=file, place=place)

    def _is_own(self, name: str) -> bool:
        return bool(self.own) and name.startswith(self.own)

    def _check(self, table: CsvTable) -> None:
        if any(map(self._is_own, table.columns)):
            self._check_own(table)
            return
        complete = [names for names in self.sets if all(name in table for name in names)]
        over = self.axis_of(table)
        if self.axis and (over not in table or not complete):
            short = min(self.sets, key=lambda names: sum(name not in table for name in names))
            missing = [name for name in (over, *short) if name not in table]
            raise table.refusal(f"column {missing[0]} is missing", self.allowed())
        for name in (self.axis, *self.other_axes):
            if name != over and name in table:
                raise table.refusal(f"column {name} cannot be combined with {over}", self.allowed())
        for names, what in ((self.grid, "an axis"), (self.optional, "a coefficient")):
            if self.grid and not any(name in table for name in names):
                raise table.refusal(f"the table has no column of {what}", self.allowed())
        also = {name for names in self.sets for name in names} - set(complete[0]) - set(self.optional)
        clash = [name for name in table.columns if name in also]
        if clash:
            raise table.refusal(f"column {clash[0]} cannot be combined with {complete[0][0]}", self.allowed())
        self._check_lengths(table, over)

    def _check_own(self, table: CsvTable) -> None:
        """Check a table with columns of its own, which has the independent column and no others."""
        over, others = self.axis_of(table), [name for name in table.columns if not self._is_own(name)]
        if others != [over]:
            allowed = f"{self.axis} (or {', '.join(self.other_axes)}), and columns {self.own}..."
            raise table.refusal(f"has the columns {', '.join(others) or 'none'} next to {self.own}...", allowed)
        self._check_lengths(table, over)

    def _check_lengths(self, table: CsvTable, over: str) -> None:
        lengths = {name: len(column) for name, column in table.columns.items()}
        if min(lengths.values(), default=0) == 0:
            raise table.refusal("the table has no rows", "one row or more")
        first = over or next(iter(lengths))
        for name, length in lengths.items():
            if length != lengths[first]:
                raise table.refusal(f"has {length} numbers, {first} has {lengths[first]}", column=name)
        self._check_values(table)

    def _check_values(self, table: CsvTable) -> None:
        refusals = []
        for name, column in table.columns.items():
            try:
                self._check_column(table, name, column)
            except PydanticCustomError as refusal:
                refusals.append(refusal)
        raise_together(refusals)
        if not self.axis:
            return
        over = self.axis_of(table)
        axis = table[over]
        steps = np.diff(-axis if over in self.falling else axis, prepend=-np.inf)
        falls = steps < LEAST_STEP
        if self.repeats:
            falls &= steps != 0.0
        rule = "must not decrease" if self.repeats else "must increase strictly"
        allowed = f"increasing numbers, by {LEAST_STEP:g} or more"
        if over in self.falling:
            rule, allowed = rule.replace("decrease", "rise").replace("increase", "fall"), allowed.replace("in", "de", 1)
        table.refuse_where(falls, over, f"{over} {rule}", allowed)
        if self.begins_by is not None and over == self.axis and axis[0] > self.begins_by:
            raise table.refusal("the table begins too late", f"a first {over} <= {self.begins_by:g}", over, 0)

    def _check_column(self, table: CsvTable, name: str, column: Column) -> None:
        of, low, high = range_of(name), column.min(), column.max()
        least = _ABOVE_ZERO if name in self.positive else 0.0 if name in self.not_negative else -of.most
        if of.least == 0.0 and low >= least and -of.most <= low and high <= of.most:
            return  # the usual case; a campaign checks the tables of every run
        table.refuse_where(~np.isfinite(column), name, "is not finite", "finite numbers")
        table.refuse_where(~of.holds(column), name, "is out of range", of.allowed())
        if name in self.positive:
            table.refuse_where(column <= 0.0, name, "is not positive", "numbers > 0")
        if name in self.not_negative:
            table.refuse_where(column < 0.0, name, "is negative", "numbers >= 0")


_ABOVE_ZERO = 5e-324  # the smallest positive number
_ALSO = 4  # number of further errors of a table in the message of the first


def raise_together(refusals: list[PydanticCustomError]) -> None:
    """Raise the first of these refusals, if any, with the others in its message."""
    if not refusals:
        return
    first, *others = (dict(refusal.context or {}) for refusal in refusals)
    also = []
    for other in others[:_ALSO]:
        value = other["value"]
        place = other["place"] or ".".join(map(str, other["key"]))
        also.append(f"{place}{'' if value is NOTHING else f' = {show_value(value)}'}: {other['problem']}")
    if len(others) > _ALSO:
        also.append(f"and {len(others) - _ALSO} more mistakes")
    problem = "; also ".join([first.pop("problem"), *([", ".join(also)] if also else [])])
    raise refuse(problem, **first)


def _number(value: Any, key: Path) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise refuse("is not a number", "numbers", key, value=value)
    try:
        return float(value)
    except OverflowError:
        raise refuse("is too large", "numbers", key, value=value) from None


class _Lines(NamedTuple):
    """The lines of a CSV text: the column names, the rows of numbers, and the lines that are not rows.

    `header_line` and `lines` are line numbers in the text. `numbers` has one row per element of `lines`. `wrong`
    contains line number and cells of each line that is not a row.
    """

    header: tuple[str, ...]
    header_line: int
    lines: tuple[int, ...]
    numbers: NDArray[np.float64]
    wrong: tuple[tuple[int, tuple[str, ...]], ...]


_MOST_KEPT = 4_000_000  # letters of a text in the cache, which keeps its numbers, too


@lru_cache(maxsize=128)
def _lines_of(text: str) -> _Lines:
    """Return the lines of a text, from a cache, because a suite reads the same tables for each of its flights."""
    header, header_line = tuple[str, ...](), 0
    lines, rows, wrong = list[int](), array("d"), list[tuple[int, tuple[str, ...]]]()  # 8 bytes for a number
    for number, line in enumerate(text.splitlines(), start=1):
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        cells = line.split(",")
        if not header:
            header, header_line = tuple(cell.strip() for cell in cells), number
            continue
        try:
            row = list(map(float, cells))
        except ValueError:
            row = []
        if len(row) == len(header):
            rows.extend(row)
            lines.append(number)
        else:
            wrong.append((number, tuple(cells)))
    numbers = np.array(rows, dtype=np.float64).reshape(len(lines), len(header))
    return _Lines(header, header_line, tuple(lines), numbers, tuple(wrong))


def read_csv(text: str, name: str, shown: str, columns: Columns) -> CsvTable:
    """Return the table in the `text` of the CSV file `name`, called `shown` in messages."""
    found = _lines_of(text) if len(text) < _MOST_KEPT else _lines_of.__wrapped__(text)
    if not found.header:
        raise refuse("the file is empty", f"CSV with {columns.allowed()}", file=shown)
    _check_header(list(found.header), shown, found.header_line, columns)
    refusals: list[PydanticCustomError] = []
    for number, cells in found.wrong:
        if len(cells) != len(found.header):
            problem = f"has {len(cells)} columns, the first line has {len(found.header)}"
            refusals.append(refuse(problem, f"{len(found.header)} numbers", file=shown, place=f"line {number}"))
            continue
        refusals += (
            refuse("is not a number", "numbers", value=cell.strip(), file=shown, place=f"line {number}, {name}")
            for cell, name in zip(cells, found.header, strict=True)
            if not _is_number(cell)
        )
    raise_together(refusals)
    columns_of = {h: column.copy() for h, column in zip(found.header, found.numbers.T, strict=True)}
    return CsvTable(name, columns_of, shown, found.lines)


def _check_header(header: list[str], shown: str, number: int, columns: Columns) -> None:
    place = f"line {number}"
    for i, name in enumerate(header):
        if name in header[:i]:
            raise refuse(f"column {name} appears twice", columns.allowed(), file=shown, place=place)
    if columns.named and columns.axis not in header and not any(name in columns.known() for name in header):
        numbers = all(_is_number(cell) for cell in header)
        problem = (
            "is not a line of column names" if numbers else f"unknown columns {', '.join(map(show_value, header))}"
        )
        raise refuse(problem, f"CSV with {columns.allowed()}", file=shown, place=place)
    refusals = []
    for name in header:
        try:
            columns._check_name(name, file=shown, place=place)
        except PydanticCustomError as refusal:
            refusals.append(refusal)
    raise_together(refusals)


def _is_number(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return False
    return True
