"""The targets of dispersions, which are given by key paths of a scenario, and the dispersed scenario.

Key paths are those of `--set`, such as vehicle.stage.0.engine.thrust_factor. They give an element of a list by its
index, and a column of a table by its name (vehicle.stage.0.mass.table.x_cg_m).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Hashable, Iterable, Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any, Literal

import numpy as np
from pydantic import ValidationError

from maxq.control.kernel.records import Array
from maxq.sim.input.documents import index_in
from maxq.sim.input.errors import refuse, suggestion
from maxq.sim.input.ranges import LONGEST_S, range_of
from maxq.sim.input.tables_csv import Columns, CsvTable
from maxq.sim.input.values import NS_PER_S, Section
from maxq.sim.scenario.messages import describe, field_at
from maxq.sim.scenario.schema_scenario import Scenario

Apply = Literal["set", "scale", "add"]
BOUNDS: dict[str, tuple[Callable[..., Any], str]] = {
    "gt": (np.greater, "above"),
    "ge": (np.greater_equal, "at least"),
    "lt": (np.less, "below"),
    "le": (np.less_equal, "at most"),
}
"""The bounds of numbers in pydantic, with their functions and their names in messages."""


class Refused(Exception):
    """The error of draws that give no valid scenario, with the key and the reason as its message."""


@dataclass(frozen=True)
class Target:
    """A place of the scenario that a draw can change.

    `kind` is the type of its content, and `nominal` its value, or nan if it has no single number.
    """

    key: str
    path: tuple[str | int, ...]
    kind: Literal["number", "integer", "text", "column", "table"]
    nominal: float
    bounds: tuple[tuple[str, float], ...] = ()  # bounds of the schema, such as ("gt", 0.0)
    whole_ns: bool = False
    columns: tuple[str, ...] = ()  # columns of the table that contains the column

    @property
    def is_angle(self) -> bool:
        """Return True for an angle or an angular rate in degrees, for which both signs are plausible."""
        return any(isinstance(part, str) and "deg" in part.rpartition("_")[2] for part in self.path[-2:])

    def result(self, apply: Apply, draw: Array) -> Array:
        """Return the changed numbers (runs,) for the draws `draw` (runs,); for a column, the draws themselves."""
        out = draw if self.kind == "column" else np.asarray(_applied(apply, self.nominal, draw))
        if self.kind == "integer":
            return np.rint(out)
        if self.whole_ns:
            near = np.clip(out, -LONGEST_S, LONGEST_S)
            return np.asarray(np.rint(near * NS_PER_S) / NS_PER_S)
        return out

    def allowed(self, value: Array) -> np.ndarray:
        """Return a mask (runs,) of values within the range of the quantity and the bounds of the schema."""
        name = next(part for part in reversed(self.path) if isinstance(part, str))
        good = range_of("" if self.kind == "column" else name).holds(value)
        for mark, bound in self.bounds:
            good &= BOUNDS[mark][0](value, bound)
        return good


def _applied(apply: Apply, value: Any, draw: Any) -> Any:
    return value * draw if apply == "scale" else value + draw if apply == "add" else draw


def find_target(scenario: Scenario, key: str) -> Target:
    """Return the target at a key path. Raises PydanticCustomError if there is none."""
    path: list[str | int] = []
    at: Any = scenario
    parts = key.split(".")
    for n, part in enumerate(parts):
        so_far = ".".join(parts[:n]) or "the scenario"
        if isinstance(at, Section):
            names = _names(type(at))
            if part not in names:
                raise refuse("is not a key of the scenario" + _hint(part, names, parts[:n]))
            at = getattr(at, names[part])
            path.append(part)
        elif isinstance(at, tuple):
            index = index_in(part, len(at))
            if index is None:
                raise refuse(f"{so_far} has no element {part}", f"0 .. {len(at) - 1}" if at else "nothing: it is empty")
            at = at[index]
            path.append(index)
        elif isinstance(at, CsvTable):
            return _column(scenario, key, path, at, part, parts[n + 1 :])
        elif at is None:
            raise refuse(f"the scenario has no {so_far}")
        else:
            raise refuse(f"{so_far} is a value and has no keys below it")
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
        raise refuse("is not a single value", f"one of what is inside: {inside}")
    if isinstance(value, bool) or annotation is bool:
        raise refuse("is true or false and cannot be drawn", "a number, a text, or a column of a table")
    if any(isinstance(mark, Columns) for mark in metadata):
        return Target(key, path, "table", math.nan)
    if annotation is float or annotation is int:
        nominal = math.nan if value is None else float(value)
        bounds = tuple((n, float(getattr(m, n))) for m in metadata for n in BOUNDS if getattr(m, n, None) is not None)
        checks = {getattr(getattr(mark, "func", None), "__name__", "") for mark in metadata}
        whole = annotation is float and "_whole_ns" in checks
        return Target(key, path, "integer" if annotation is int else "number", nominal, bounds, whole)
    if isinstance(value, str) or value is None:
        return Target(key, path, "text", math.nan)
    raise refuse("cannot be drawn", describe(annotation, metadata))


def _column(scenario: Scenario, key: str, path: list[str | int], table: CsvTable, name: str, rest: list[str]) -> Target:
    _, metadata = field_at(Scenario, tuple(path))
    columns = next(mark for mark in metadata if isinstance(mark, Columns))
    if rest:
        raise refuse(f"column {name} is the end of a key path")
    if name not in columns.known():
        hint = suggestion(name, columns.known())
        raise refuse(f"the table has no column {name}" + (f"; {hint}" if hint else ""), ", ".join(table.columns))
    return Target(key, (*path, name), "column", math.nan, columns=tuple(table.columns))


@dataclass(frozen=True)
class TargetChange:
    """The change of a target by the draw named `draw`. Of a column, only the rows that match `where` are changed."""

    target: Target
    apply: Apply
    draw: Hashable
    where: tuple[tuple[str, float], ...] = ()


class Dispersed:
    """The function that returns the scenario of a run, as if it were loaded from a file with the changed values."""

    def __init__(self, scenario: Scenario, changes: Iterable[TargetChange]) -> None:
        self._scenario = scenario
        self._tree: dict[Any, Any] = {}  # by part of the path; its leaves are lists of changes
        for change in changes:
            *before, last = change.target.path
            node = self._tree
            for part in before:
                node = node.setdefault(part, {})
            node.setdefault(last, []).append(change)

    def __call__(self, values: Mapping[Any, Any]) -> Scenario:
        """Return the scenario with the results `values` of draws, by name; targets without a result are unchanged.

        Raises Refused if the scenario is not valid.
        """
        if not self._tree:
            return self._scenario
        try:
            return Scenario.model_validate(_rebuilt(self._scenario, self._tree, values))
        except ValidationError as error:
            first = error.errors(include_url=False)[0]
            context = first.get("ctx", {})
            problem = context.get("problem", first["msg"]) if first["type"] == "refused" else first["msg"]
            key = ".".join(map(str, (*first["loc"], *context.get("key", ()))))
            raise Refused(f"{key}: {problem}" if key else str(problem)) from None


def _rebuilt(at: Any, node: Any, values: Mapping[Any, Any]) -> Any:
    """Return the value `at` with all changes in the tree `node`.

    Changed sections are returned as dictionaries of their fields, for a single validation. Unchanged parts are shared
    with the original.
    """
    if isinstance(node, list):
        change = node[0]
        value = values.get(change.draw, at)
        return int(value) if change.target.kind == "integer" and change.draw in values else value
    if at is None:
        return _absent(node, values)
    if isinstance(at, CsvTable):
        return _changed_table(at, node, values)
    out: Any = {alias: at.__dict__[n] for alias, n in _names(type(at)).items()} if isinstance(at, Section) else list(at)
    for part, below in node.items():
        if isinstance(out, list) and part >= len(out):
            _absent(below, values)
        else:
            out[part] = _rebuilt(out[part], below, values)
    return out if isinstance(at, Section) else tuple(out)


def _absent(node: Any, values: Mapping[Any, Any]) -> None:
    """Raise Refused if a draw changes a section that is absent in the scenario, such as a gust.

    The scenario is not always that of the campaign, because a dispersed vehicle also flies in the calm air of its
    design.
    """
    if isinstance(node, list):
        if any(change.draw in values for change in node):
            raise Refused(f"{node[0].target.key}: the scenario has no such section")
    else:
        for below in node.values():
            _absent(below, values)


def _changed_table(table: CsvTable, node: dict[str, list[TargetChange]], values: Mapping[Any, Any]) -> CsvTable:
    columns = dict(table.columns)
    for name, changes in node.items():
        for change in changes:
            if change.draw in values:
                rows = np.ones(len(table), bool)
                for other, value in change.where:
                    rows &= table[other] == value
                column = columns.get(name, np.zeros(len(table)))
                columns[name] = np.where(rows, _applied(change.apply, column, float(values[change.draw])), column)
    return CsvTable(table.file, columns)
