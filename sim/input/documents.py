"""TOML documents that record the source file of each value, and `--set KEY=VALUE`.

A scenario is assembled from several files and overrides. Error messages must name the right file, and a file named by a
value is searched for in the folder of the naming file. Therefore tables, lists and texts carry their source.
"""

from __future__ import annotations

import re
import tomllib
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

from maxq.sim.input import toml_columns
from maxq.sim.input.errors import Path as KeyPath
from maxq.sim.input.errors import ScenarioError, show_value, suggestion

COMMAND_LINE = "--set"
_USAGE = "--set KEY=VALUE, e.g. --set run.step_s=0.0005 or --set vehicle.stage.0.tank.0.damping_ratio=0.01"


@dataclass(frozen=True)
class Source:
    """The source of values: `label` is its name in messages, `folders` are searched for the files that the values name.

    `within` is the path of the document in the scenario (`vehicle` for a vehicle file). `shown_as` replaces this path
    in the keys of messages, which are then those of the document.
    """

    label: str
    folders: tuple[Path, ...] = ()
    within: KeyPath = ()
    shown_as: KeyPath = ()

    def error(self, path: KeyPath, problem: str, **details: Any) -> ScenarioError:
        """Return an error for the value at `path` of the scenario. It names the key as written in this document."""
        if path[: len(self.within)] == self.within:
            path = self.shown_as + path[len(self.within) :]
        return ScenarioError(self.label, problem, ".".join(map(str, path)), **details)


class Text(str):
    """A text value with its source."""

    source: Source

    @classmethod
    def of(cls, text: str, source: Source) -> Text:
        out = cls(text)
        out.source = source
        return out

    def like(self, text: str) -> Text:
        """Return another text of the same source."""
        return Text.of(text, self.source)


class _Sourced:
    """A table or array with its source; `sources` contains the source of each key or element that differs."""

    def __init__(self, source: Source) -> None:
        super().__init__()
        self.source = source
        self.sources: dict[str | int, Source] = {}


_NUMBERS = {bool, int, float}


class TomlTable(_Sourced, dict[str, Any]):
    """A TOML table."""


class TomlArray(_Sourced, list[Any]):
    """A TOML array."""


def adopt(value: Any, source: Source) -> Any:
    """Return `value`, as read by tomllib, with its source attached to all tables, lists and texts."""
    if isinstance(value, dict):
        table = TomlTable(source)
        table.update((key, adopt(item, source)) for key, item in value.items())
        return table
    if isinstance(value, list):
        array = TomlArray(source)
        array.extend(value if _NUMBERS.issuperset(map(type, value)) else (adopt(item, source) for item in value))
        return array
    if isinstance(value, str):
        return Text.of(value, source)
    return value


def plain(value: Any) -> Any:
    """Return a tree of TOML or JSON as dicts, tuples and values, for strict validation by schemas.

    Texts keep their source.
    """
    if isinstance(value, dict):
        return {key: plain(item) for key, item in value.items()}
    if isinstance(value, list):
        return tuple(value if _NUMBERS.issuperset(map(type, value)) else (plain(item) for item in value))
    return value


def parse(text: str, source: Source) -> TomlTable:
    """Return the document in `text`. Raises ScenarioError with line and column if the text is not TOML."""
    try:
        table: TomlTable = adopt(_document(text), source)
    except (ValueError, RecursionError) as error:  # TOMLDecodeError, or a number with thousands of digits
        reason = "nested too deeply" if isinstance(error, RecursionError) else str(error)
        raise ScenarioError(source.label, f"is not valid TOML: {reason}{_quoted(text, reason)}") from None
    return table


@lru_cache(maxsize=64)
def _document(text: str) -> dict[str, Any]:
    """Return the document in `text`, which must not be changed.

    A suite reads the same files for each of its flights, and parsing takes most of the time of a small file.
    """
    return toml_columns.loads(text)


def _quoted(text: str, reason: str) -> str:
    """Return the line of `text` that tomllib's `reason` names, in a form to be appended to the reason."""
    at = re.search(r"\(at line (\d+), column \d+\)$", reason)
    lines = text.split("\n")
    line = lines[int(at[1]) - 1].strip() if at and int(at[1]) <= len(lines) else ""
    return f": {show_value(line)[1:-1]}" if line else ""


def merge(base: TomlTable, over: TomlTable) -> None:
    """Merge `over` into `base`: tables key by key, and every other value, including an array of tables, as a whole."""
    for key, value in over.items():
        below = base.get(key)
        if isinstance(below, TomlTable) and isinstance(value, TomlTable):
            merge(below, value)
        else:
            base[key] = value
            base.sources[key] = over.sources.get(key, over.source)


def append(base: TomlTable, more: TomlTable, at: KeyPath = ()) -> None:
    """Append the elements of the lists in `more`, the table `append` of a file, to the lists of `base`.

    Tables are entered; a list that `base` lacks is created. Errors in an element name it as the file contains it.
    """
    for key, value in more.items():
        path, below, source = (*at, key), base.get(key), more.sources.get(key, more.source)
        shown = replace(source, within=(*source.within, *path), shown_as=(*source.shown_as, "append", *path))
        if below is None and isinstance(value, TomlTable | TomlArray):
            below = base[key] = TomlTable(shown) if isinstance(value, TomlTable) else TomlArray(shown)
            base.sources[key] = shown
        if isinstance(value, TomlTable) and isinstance(below, TomlTable):
            append(below, value, path)
            continue
        if not isinstance(value, TomlTable | TomlArray):
            raise shown.error(shown.within, "is no list", value=value, allowed="a list, or [[...]]")
        if not isinstance(value, TomlArray) or not isinstance(below, TomlArray):
            what = "list" if isinstance(value, TomlArray) else "table"
            raise shown.error(
                shown.within, f"the extended file has no {what} there", allowed=f"{'.'.join(map(str, path))} itself"
            )
        for k, item in enumerate(value):
            element = replace(source, within=(*shown.within, len(below)), shown_as=(*shown.shown_as, k))
            below.sources[len(below)] = element
            below.append(adopt(item, element))


def _step(tree: TomlTable | TomlArray, part: str | int, path: KeyPath, source: Source) -> Any:
    """Return the key or index that `part` of a path denotes in `tree`. Raises ScenarioError for an invalid index."""
    if isinstance(tree, TomlTable):
        return str(part)
    allowed = f"an index 0 .. {len(tree) - 1}" if tree else "nothing: the list is empty"
    if index_in(str(part), len(tree)) is None:
        raise source.error(path, f"{part!s:.40} is not an element of this list", allowed=allowed)
    return int(part)


def index_in(text: str, length: int) -> int | None:
    """Return the index that `text` denotes in a list of `length` elements, or None if it denotes none."""
    return int(text) if text.isdecimal() and len(text) < 10 and int(text) < length else None


def put(tree: TomlTable, path: KeyPath, value: Any, source: Source) -> None:
    """Set the value at `path`, such as ("run", "step_s"), and create the tables above it.

    Raises ScenarioError if the path passes through a value that is neither table nor list, or beyond the end of a list.
    """
    at: Any = tree
    for n, part in enumerate(path[:-1]):
        key = _step(at, part, path, source)
        if isinstance(at, TomlTable) and key not in at:
            at[key] = TomlTable(source)
            at.sources[key] = source
        at = at[key]
        if not isinstance(at, TomlTable | TomlArray):
            name = ".".join(map(str, path[: n + 1]))
            raise source.error(path, f"{name} is a value and has no keys below it")
    key = _step(at, path[-1], path, source)
    at[key] = value
    at.sources[key] = source


def drop(tree: TomlTable, path: KeyPath, source: Source, shift: KeyPath = ()) -> None:
    """Remove the key at `path` of `tree`. Raises ScenarioError about the key `shift` + `path` if there is none."""
    at: Any = tree
    for n, part in enumerate(path):
        place = (*shift, *path[: n + 1])
        here = _step(at, part, place, source) if isinstance(at, TomlTable | TomlArray) else None
        if here is None or (isinstance(at, TomlTable) and here not in at):
            hint = suggestion(str(part), at) if isinstance(at, TomlTable) else ""
            raise source.error(place, "there is no such key to remove" + (f"; {hint}" if hint else ""))
        if n == len(path) - 1:
            del at[here]
        else:
            at = at[here]


def leaves(table: TomlTable) -> Iterator[tuple[KeyPath, Any, Source]]:
    """Yield path, value and source of every value below `table` that is not a table.

    Keys that contain dots, such as "stage.0.name", are split.
    """
    for key, value in table.items():
        head: KeyPath = tuple(key.split("."))
        if isinstance(value, TomlTable) and value:
            for path, leaf, source in leaves(value):
                yield head + path, leaf, source
        else:
            yield head, value, table.sources.get(key, table.source)


def walk(value: Any, path: KeyPath = ()) -> Iterator[tuple[KeyPath, Any]]:
    """Yield the path and value of every entry below `value` that is neither a table nor a list."""
    if isinstance(value, TomlTable | TomlArray):
        for key, item in value.items() if isinstance(value, TomlTable) else enumerate(value):
            yield from walk(item, (*path, key))
    else:
        yield path, value


def source_of(tree: TomlTable, path: KeyPath) -> Source:
    """Return the source of the value at `path`, or of its nearest existing parent."""
    at: Any = tree
    source = tree.source
    for part in path:
        if not isinstance(at, TomlTable | TomlArray):
            break
        source = at.sources.get(part, at.source)
        try:
            at = at[part]  # type: ignore[index]  # the validator's path: str in tables, int in lists
        except (KeyError, IndexError, TypeError):
            break
    return source


_MOST_PARTS = 50  # of a path; the deepest key has a tenth of them
Override = tuple[KeyPath, Any]
"""The path and value of one override, as in TOML; None removes the key."""


def parse_override(text: str) -> Override:
    """Return the path and value of an override `a.b.0.c=value`.

    The right side is a TOML value, or otherwise a text (a bare word). An empty right side removes the key. Raises
    ScenarioError if there is no `=` or if a part of the path is empty.
    """
    left, equals, right = text.partition("=")
    path = tuple(part.strip() for part in left.split("."))
    if not equals:
        raise ScenarioError(COMMAND_LINE, "has no '='", text, allowed=_USAGE)
    if not all(path) or len(path) > _MOST_PARTS:
        raise ScenarioError(COMMAND_LINE, "is not the path of a key", left[:200] or '""', allowed=_USAGE)
    right = right.strip()
    try:
        document = tomllib.loads(f"value = {right}")
    except (ValueError, RecursionError):
        return path, right or None
    return path, document["value"] if list(document) == ["value"] and not _is_deeper(document, _MOST_PARTS) else right


def _is_deeper(value: Any, levels: int) -> bool:
    """Return True if tables and lists are nested in more levels, which no key needs."""
    if not isinstance(value, dict | list):
        return False
    items = value.values() if isinstance(value, dict) else value
    return levels == 0 or any(_is_deeper(item, levels - 1) for item in items)


def apply(overrides: Iterable[Override], tree: TomlTable, source: Source) -> None:
    """Write `overrides` into `tree`."""
    for path, value in overrides:
        if value is None:
            drop(tree, path, source)
        else:
            put(tree, path, adopt(value, source), source)
