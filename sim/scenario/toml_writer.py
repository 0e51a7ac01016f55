"""Writes a validated scenario as TOML text that reads back to the same bits.

Floats are written with `repr`, the shortest decimal that gives the same double again; tables of numbers are
written out column by column. (tomllib of the standard library only reads.)
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from typing import Any

from maxq.sim.scenario.schema_values import Section
from maxq.sim.scenario.tables_csv import FILE_KEY, CsvTable


def to_toml(section: Section) -> str:
    """The section with every key that has a value, defaults included."""
    return "\n".join(_lines(_as_dict(section), ())) + "\n"


def _as_dict(value: Any) -> Any:
    if isinstance(value, Section):
        fields = {(f.alias or n): getattr(value, n) for n, f in type(value).model_fields.items()}
        return {key: _as_dict(item) for key, item in fields.items() if item is not None}
    if isinstance(value, CsvTable):
        label = {FILE_KEY: value.file} if value.file else {}
        return label | {name: column.tolist() for name, column in value.columns.items()}
    if isinstance(value, tuple):
        return [_as_dict(item) for item in value]
    return value


def _is_tables(value: Any) -> bool:
    return isinstance(value, list) and bool(value) and isinstance(value[0], dict)


def _lines(table: dict[str, Any], path: tuple[str, ...]) -> Iterator[str]:
    """Values first, then tables and lists of tables: below a header TOML has no way back."""
    for key, value in table.items():
        if not isinstance(value, dict) and not _is_tables(value):
            yield f"{_key(key)} = {_value(value)}"
    for key, value in table.items():
        below = (*path, _key(key))
        if isinstance(value, dict):
            yield f"\n[{'.'.join(below)}]"
            yield from _lines(value, below)
        elif _is_tables(value):
            for item in value:
                yield f"\n[[{'.'.join(below)}]]"
                yield from _lines(item, below)


def _key(key: str) -> str:
    bare = key.isascii() and key.replace("_", "").replace("-", "").isalnum()
    return key if bare else _text(key)


def _value(value: Any) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        return _text(value)
    if isinstance(value, int | float):
        return repr(value)
    if isinstance(value, list):
        return "[" + ", ".join(_value(item) for item in value) + "]"
    raise TypeError(f"no TOML for a {type(value).__name__}")


def _text(text: str) -> str:
    """A basic string: JSON's escapes are TOML's, but for DEL, which TOML wants escaped."""
    return json.dumps(text, ensure_ascii=False).replace("\x7f", "\\u007F")
