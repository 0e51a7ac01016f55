"""Key paths of a scenario: what a dispersion changes, and the changed scenario.

A key path is that of `--set`: vehicle.stage.0.engine.thrust_factor, a list's element by its number, a table's column by
its name (vehicle.stage.0.mass.table.x_cg_m).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from typing import Any, Literal

import numpy as np
from pydantic import ValidationError

from maxq.control.kernel.records import Array
from maxq.sim.scenario.errors import LARGEST_NUMBER, suggestion
from maxq.sim.scenario.messages import describe, field_at
from maxq.sim.scenario.nanoseconds import LONGEST_S, NS_PER_S
from maxq.sim.scenario.schema_scenario import Scenario
from maxq.sim.scenario.schema_values import Section
from maxq.sim.scenario.tables_csv import Columns, CsvTable

Apply = Literal["set", "scale", "add"]
Value = Any  # what a draw hands over: a number, a text, a table


class BadKey(Exception):
    """A key path that leads nowhere, or to what cannot be dispersed so: `problem` and `allowed` in words."""

    def __init__(self, problem: str, allowed: str = "") -> None:
        super().__init__(problem)
        self.problem, self.allowed = problem, allowed


class Refused(Exception):
    """A scenario that cannot be: in words, with the key."""


@dataclass(frozen=True)
class Target:
    """One place of the scenario. `nominal` is nan where the place holds no number, `kind` what it holds."""

    key: str
    path: tuple[str | int, ...]
    kind: Literal["number", "integer", "text", "column", "table"]
    nominal: float
    least: float = -math.inf  # what the schema allows
    most: float = math.inf
    open_below: bool = False
    open_above: bool = False
    whole_ns: bool = False

    def result(self, apply: Apply, draw: Array) -> Array:
        """What becomes of a number; of a column, the draw itself."""
        if self.kind == "column" or apply == "set":
            out = draw
        elif apply == "scale":
            out = np.asarray(self.nominal * draw)
        else:
            out = np.asarray(self.nominal + draw)
        if self.kind == "integer":
            return np.rint(out)
        if self.whole_ns:
            near = np.clip(out, -LONGEST_S, LONGEST_S)
            return np.asarray(np.rint(near * NS_PER_S) / NS_PER_S)
        return out

    def allowed(self, value: Array) -> np.ndarray:
        """Where the schema's bounds hold."""
        below = value > self.least if self.open_below else value >= self.least
        above = value < self.most if self.open_above else value <= self.most
        return np.asarray(below & above & np.isfinite(value) & (np.abs(value) <= LARGEST_NUMBER))

    def bounds_text(self) -> str:
        low = "" if math.isinf(self.least) else f"{'above' if self.open_below else 'at least'} {self.least:g}"
        high = "" if math.isinf(self.most) else f"{'below' if self.open_above else 'at most'} {self.most:g}"
        return " and ".join(part for part in (low, high) if part)


def find_target(scenario: Scenario, key: str) -> Target:
    """The place that a key path names. Raises BadKey."""
    path: list[str | int] = []
    at: Any = scenario
    parts = key.split(".")
    for n, part in enumerate(parts):
        so_far = ".".join(parts[:n]) or "the scenario"
        if isinstance(at, Section):
            names = _names(type(at))
            if part not in names:
                raise BadKey("is no key of the scenario" + _hint(part, names, parts[:n]))
            at = getattr(at, names[part])
            path.append(part)
        elif isinstance(at, tuple):
            if not part.isdecimal() or int(part) >= len(at):
                raise BadKey(f"{so_far} has no element {part}", f"0 .. {len(at) - 1}" if at else "nothing: it is empty")
            at = at[int(part)]
            path.append(int(part))
        elif isinstance(at, CsvTable):
            return _column(scenario, key, path, at, part, parts[n + 1 :])
        elif at is None:
            raise BadKey(f"the scenario has no {so_far}")
        else:
            raise BadKey(f"{so_far} is a value and has no keys below it")
    return _leaf(key, tuple(path), at)


@cache
def _names(section: type[Section]) -> Mapping[str, str]:
    return {field.alias or name: name for name, field in section.model_fields.items()}


def _hint(part: str, names: Mapping[str, str], before: list[str]) -> str:
    hint = suggestion(part, names)
    if not hint:
        return ""
    word = hint.removeprefix("did you mean ").removesuffix("?")
    return f"; did you mean {'.'.join([*before, word])}?"


def _leaf(key: str, path: tuple[str | int, ...], value: Any) -> Target:
    annotation, metadata = field_at(Scenario, path)
    if isinstance(value, Section | tuple):
        inside = ", ".join(list(_names(type(value)))[:6]) if isinstance(value, Section) else "0, 1, ..."
        raise BadKey("is not a single value", f"one of what is inside: {inside}")
    if isinstance(value, bool) or annotation is bool:
        raise BadKey("is true or false and cannot be drawn", "a number, a text, or a column of a table")
    if any(isinstance(mark, Columns) for mark in metadata):
        return Target(key, path, "table", math.nan)
    if annotation is float or annotation is int:
        nominal = math.nan if value is None else float(value)
        bounds = _bounds(metadata)
        checks = {getattr(getattr(mark, "func", None), "__name__", "") for mark in metadata}
        whole = annotation is float and "_whole_ns" in checks
        return Target(key, path, "integer" if annotation is int else "number", nominal, **bounds, whole_ns=whole)
    if isinstance(value, str) or value is None:
        return Target(key, path, "text", math.nan)
    raise BadKey("cannot be drawn", describe(annotation, metadata))


def _bounds(metadata: Sequence[Any]) -> dict[str, Any]:
    out: dict[str, Any] = {}
    for mark in metadata:
        for name, target, strict in (
            ("gt", "least", "open_below"), ("ge", "least", ""), ("lt", "most", "open_above"), ("le", "most", ""),
        ):  # fmt: skip
            bound = getattr(mark, name, None)
            if bound is not None:
                out[target] = float(bound)
                if strict:
                    out[strict] = True
    return out


def _column(scenario: Scenario, key: str, path: list[str | int], table: CsvTable, name: str, rest: list[str]) -> Target:
    _, metadata = field_at(Scenario, tuple(path))
    columns = next(mark for mark in metadata if isinstance(mark, Columns))
    if rest:
        raise BadKey(f"column {name} is the end of a key path")
    if name not in columns.known():
        hint = suggestion(name, columns.known())
        raise BadKey(f"the table has no column {name}" + (f"; {hint}" if hint else ""), ", ".join(table.columns))
    return Target(key, (*path, name), "column", math.nan)


@dataclass
class _Node:
    """What is to be done below one place of the scenario."""

    below: dict[str | int, _Node] = field(default_factory=dict)
    changes: list[Change] = field(default_factory=list)


@dataclass(frozen=True)
class Change:
    """One target, and how the draw named `draw` acts on it."""

    target: Target
    apply: Apply
    draw: str
    where: tuple[tuple[str, float], ...] = ()


class Dispersed:
    """Makes the scenario of a run: the same as loading a file with the changed values would give."""

    def __init__(self, scenario: Scenario, changes: Sequence[Change]) -> None:
        self._scenario = scenario
        self._root = _Node()
        for change in changes:
            node = self._root
            for part in change.target.path:
                node = node.below.setdefault(part, _Node())
            node.changes.append(change)

    def __call__(self, values: Mapping[str, Value]) -> Scenario:
        """The scenario with the results of draws, by name, in place; where there is none, the value stays.

        Raises Refused where such a scenario cannot be.
        """
        if not self._root.below:
            return self._scenario
        try:
            return Scenario.model_validate(_rebuilt(self._scenario, self._root, values))
        except ValidationError as error:
            raise Refused(_in_words(error)) from None


def _rebuilt(at: Any, node: _Node, values: Mapping[str, Value]) -> Any:
    """The value with all changes below it: sections that change as their fields, to be checked once, together; what
    does not change is shared with the original."""
    if node.changes:
        return _changed_value(at, node.changes[0], values)
    if isinstance(at, Section):
        held = at.__dict__
        fields = {alias: held[name] for alias, name in _names(type(at)).items()}
        for part, below in node.below.items():
            fields[str(part)] = _rebuilt(fields[str(part)], below, values)
        return fields
    if isinstance(at, CsvTable):
        return _changed_table(at, node, values)
    out = list(at)
    for part, below in node.below.items():
        out[int(part)] = _rebuilt(out[int(part)], below, values)
    return tuple(out)


def _in_words(error: ValidationError) -> str:
    first = error.errors(include_url=False)[0]
    context = first.get("ctx", {})
    problem = context.get("problem", first["msg"]) if first["type"] == "refused" else first["msg"]
    key = ".".join(map(str, (*first["loc"], *context.get("key", ()))))
    return f"{key}: {problem}" if key else str(problem)


def _changed_value(at: Any, change: Change, values: Mapping[str, Value]) -> Any:
    if change.draw not in values:
        return at
    value = values[change.draw]
    return int(value) if change.target.kind == "integer" else value


def _changed_table(table: CsvTable, node: _Node, values: Mapping[str, Value]) -> CsvTable:
    columns = dict(table.columns)
    for part, below in node.below.items():
        name = str(part)
        column = columns.get(name, np.zeros(len(table)))
        for change in below.changes:
            if change.draw in values:
                column = _changed_column(table, column, change, float(values[change.draw]))
                column.flags.writeable = False
                columns[name] = column
    return CsvTable(table.file, columns)


def _changed_column(table: CsvTable, column: Array, change: Change, draw: float) -> Array:
    if change.apply == "scale":
        new = column * draw
    elif change.apply == "add":
        new = column + draw
    else:
        new = np.full_like(column, draw)
    if not change.where:
        return np.asarray(new)
    rows = np.ones(len(table), bool)
    for name, value in change.where:
        rows &= table[name] == value
    return np.where(rows, new, column)
