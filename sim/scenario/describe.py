"""What a field of the schema allows, in words: for errors and for the reference in docs/."""

from __future__ import annotations

import types
from typing import Annotated, Any, Literal, Union, get_args, get_origin

from pydantic.fields import FieldInfo

from maxq.sim.scenario.errors import Path
from maxq.sim.scenario.schema_values import Section
from maxq.sim.scenario.tables_csv import Columns

_BOUNDS = (("gt", ">"), ("ge", ">="), ("lt", "<"), ("le", "<="))
_LONG_INTEGER = 2**62
_PLURALS = {"a number": "numbers", "a whole number": "whole numbers", "a text": "texts", "a table": "tables"}


def unwrap(annotation: Any) -> tuple[Any, list[Any]]:
    """The bare type below Optional and Annotated, and all metadata on the way."""
    metadata: list[Any] = []
    while True:
        origin = get_origin(annotation)
        if origin is Annotated:
            annotation, *marks = get_args(annotation)
            for mark in marks:
                metadata += mark.metadata if isinstance(mark, FieldInfo) else [mark]
        elif origin in (Union, types.UnionType):
            annotation = next(part for part in get_args(annotation) if part is not type(None))
        else:
            return annotation, metadata


def section_of(annotation: Any) -> type[Section] | None:
    """The section that a field of this type holds, by itself or in a list."""
    bare, _ = unwrap(annotation)
    if get_origin(bare) is tuple:
        bare, _ = unwrap(get_args(bare)[0])
    return bare if isinstance(bare, type) and issubclass(bare, Section) else None


def field_at(model: type[Section], path: Path) -> tuple[Any, list[Any]]:
    """Type and metadata of what `path` names; (None, []) when the schema has no such place."""
    annotation: Any = model
    metadata: list[Any] = []
    for part in path:
        if isinstance(annotation, type) and issubclass(annotation, Section):
            field = next((f for n, f in annotation.model_fields.items() if (f.alias or n) == part), None)
            if field is None:
                return None, []
            annotation, more = unwrap(field.annotation)
            metadata = [*field.metadata, *more]
        elif get_origin(annotation) is tuple and isinstance(part, int):
            items = get_args(annotation)
            annotation, metadata = unwrap(items[0] if items[-1] is ... else items[min(part, len(items) - 1)])
        else:
            return None, []
    return annotation, metadata


def keys_of(section: type[Section]) -> list[str]:
    """The keys of a section as TOML has them."""
    return [field.alias or name for name, field in section.model_fields.items()]


def describe(annotation: Any, metadata: list[Any]) -> str:
    """The allowed values in a few words; empty for a type that is not known."""
    annotation, more = unwrap(annotation)
    metadata = [*metadata, *more]
    for mark in metadata:
        if isinstance(mark, Columns):
            return f"a CSV file or a table: {mark.allowed()}"
    if get_origin(annotation) is Literal:
        return ", ".join(repr(choice) for choice in get_args(annotation))
    if get_origin(annotation) is tuple:
        return _describe_list(get_args(annotation), metadata)
    if isinstance(annotation, type) and issubclass(annotation, Section):
        return "a table"
    words = {bool: "true, false", int: "a whole number", float: "a number", str: "a text"}.get(annotation, "")
    return words + _bounds(metadata) if annotation in (int, float) else words


def _bounds(metadata: list[Any]) -> str:
    found = [
        f" {sign} {value:g}"
        for name, sign in _BOUNDS
        for mark in metadata
        if (value := getattr(mark, name, None)) is not None and abs(value) < _LONG_INTEGER
    ]
    return ",".join(found)


def _describe_list(items: tuple[Any, ...], metadata: list[Any]) -> str:
    inner = describe(items[0], [])
    first, _, rest = inner.partition(" >")
    plural = _PLURALS.get(first, inner) + (f" >{rest}" if rest else "")
    if items[-1] is not ...:
        return f"a list of {len(items)} {plural.replace('a list', 'lists')}"
    longest = next((mark.max_length for mark in metadata if getattr(mark, "max_length", None)), None)
    return f"a list of {plural}" + (f", at most {longest}" if longest else "")
