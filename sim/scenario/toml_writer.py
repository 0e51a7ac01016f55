"""Writes a validated section as TOML text that reads back to the same bits.

Floats are written by `repr`, the shortest decimal that gives the same double again; a column of a table takes one line.
(tomli-w gives each number of a list a line of its own: 56,000 lines for the nominal scenario instead of 330, in three
times the time.)
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from typing import Any

from maxq.sim.scenario.schema_values import Section
from maxq.sim.scenario.tables_csv import FILE_KEY, CsvTable


def to_toml(section: Section) -> str:
    """The section with every key that has a value, defaults included."""
    return "\n".join(_lines(_content(section), ())) + "\n"


def _content(value: Any) -> Any:
    if isinstance(value, Section):
        fields = {(f.alias or n): getattr(value, n) for n, f in type(value).model_fields.items()}
        return {key: _content(item) for key, item in fields.items() if item is not None}
    if isinstance(value, CsvTable):
        label = {FILE_KEY: value.file} if value.file else {}
        return label | {name: column.tolist() for name, column in value.columns.items()}
    return [_content(item) for item in value] if isinstance(value, tuple) else value


def _lines(table: dict[str, Any], path: tuple[str, ...]) -> Iterator[str]:
    """Values first, then tables and lists of tables: below a header TOML has no way back."""
    below: list[tuple[str, str, dict[str, Any]]] = []
    for key, value in table.items():
        name = key if key.isascii() and key.replace("_", "").replace("-", "").isalnum() else _value(key)
        if isinstance(value, dict):
            below.append((name, "[{}]", value))
        elif isinstance(value, list) and value and isinstance(value[0], dict):
            below += [(name, "[[{}]]", item) for item in value]
        else:
            yield f"{name} = {_value(value)}"
    for name, header, item in below:
        yield "\n" + header.format(".".join((*path, name)))
        yield from _lines(item, (*path, name))


def _value(value: Any) -> str:
    """JSON's texts, finite numbers, booleans and lists are TOML's, but for DEL, which TOML wants escaped."""
    return json.dumps(value, ensure_ascii=False, allow_nan=False).replace("\x7f", "\\u007F")
