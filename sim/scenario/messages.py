"""One-line messages from pydantic's error reports, and descriptions of the allowed values of a field."""

from __future__ import annotations

import types
from typing import Annotated, Any, Literal, Union, get_args, get_origin

from pydantic import ValidationError
from pydantic.fields import FieldInfo

from maxq.sim.input.documents import COMMAND_LINE, TomlTable, source_of
from maxq.sim.input.errors import NOTHING, Path, ScenarioError, suggestion
from maxq.sim.input.files import DOCUMENT_KEYS, PARTS, WANTED
from maxq.sim.input.tables_csv import Columns
from maxq.sim.input.values import LIST_FORM, TABLE_FORM, Section

_SCENARIO_KEYS = (*DOCUMENT_KEYS, *(f"{part}_overrides" for part in PARTS))
"""The keys that the loader consumes before the schema reads the document."""

_PROBLEMS = {
    "greater_than": "is out of range",
    "greater_than_equal": "is out of range",
    "less_than": "is out of range",
    "less_than_equal": "is out of range",
    "finite_number": "is not finite",
    "literal_error": "is not one of the choices",
    "too_long": "has too many elements",
    "too_short": "has too few elements",
}
_MANY_KEYS = 24
_NOW, OBSOLETE = "is now ", "is obsolete"
"""The problem of a key of an earlier version that has a new name, and of a key that has none."""
_IN_FILES_ONLY = {
    "extends": 'a file of your own that begins with, e.g., extends = "nominal"',
    "unset": "--set KEY= to remove a key, or a file of your own with extends and unset",
    "append": "a file of your own with extends and append",
}


def explain(error: ValidationError, tree: TomlTable, model: type[Section]) -> ScenarioError:
    """Return the most important error in `error` as a ScenarioError that states the number of further errors.

    Unknown keys come first, because they explain missing keys. `tree` is the document that `model` rejects.
    """
    order = {"extra_forbidden": 0, "missing": 2}
    found = [{**detail, "loc": _without_forms(detail["loc"])} for detail in error.errors(include_url=False)]
    details = sorted(_causes(found), key=lambda detail: order.get(detail["type"], 1))
    first = details[0]
    path, context = tuple(first["loc"]), first.get("ctx", {})
    more = len(details) - 1
    if first["type"] == "refused":
        return _refused(path, context, tree, more)
    value = value_at(tree, path)
    allowed = describe(*field_at(model, path))
    if first["type"] == "extra_forbidden":
        problem, allowed = _unknown_key(path, model)
    elif first["type"] == "missing" and path and isinstance(path[-1], int):
        path = path[:-1]  # a list that is too short: report the list
        problem, value, allowed = ("has too few elements", value_at(tree, path), describe(*field_at(model, path)))
    elif first["type"] == "missing":
        problem, value = "required key is missing", NOTHING
        allowed = WANTED[str(path[0])] if len(path) == 1 and path[0] in PARTS else allowed
    else:
        problem = _PROBLEMS.get(first["type"], "has the wrong type")
        if first["type"] == "too_long" and not allowed.startswith("a list"):
            allowed = f"{allowed}, or a list of at most {context['max_length']}"
        if first["type"] == "literal_error":
            hint = suggestion(str(value), [c.strip("'") for c in allowed.split(", ")])
            problem += f"; {hint}" if hint else ""
    source = source_of(tree, path)
    earlier = path[-1:] == ("schema",) and isinstance(value, int) and allowed.isdecimal() and value < int(allowed)
    if earlier:
        problem = "is an earlier version of the format"
    if (earlier or problem.startswith((_NOW, OBSOLETE))) and source.label != COMMAND_LINE:
        allowed = f"what simrun --upgrade {source.label} writes"
    return source.error(path, problem, value=value, allowed=allowed, more=more)


def _without_forms(path: Path) -> Path:
    return tuple(part for part in path if part not in (TABLE_FORM, LIST_FORM))


def _causes(found: list[Any]) -> list[Any]:
    """Return the errors without those of lists that are too short because one of their elements is invalid."""
    paths = [detail["loc"] for detail in found]
    return [
        detail
        for detail in found
        if detail["type"] != "too_short"
        or not any(len(path) > len(detail["loc"]) and path[: len(detail["loc"])] == detail["loc"] for path in paths)
    ]


def _refused(path: Path, context: dict[str, Any], tree: TomlTable, more: int) -> ScenarioError:
    details = {"allowed": context["allowed"], "more": more}
    if context["file"]:
        return ScenarioError(context["file"], context["problem"], context["place"], value=context["value"], **details)
    path += context["key"]
    value = context["value"]
    if value is NOTHING:
        value = value_at(tree, path)
    return source_of(tree, path).error(path, context["problem"], value=value, **details)


def _unknown_key(path: Path, model: type[Section]) -> tuple[str, str]:
    """Return the problem and the allowed keys for the unknown key at the end of `path`."""
    annotation, _ = field_at(model, path[:-1], table=True)
    section = section_of(unwrap(annotation)[0]) or model
    known = keys_of(section)
    if path[-1] in section.renamed:
        new = section.renamed[str(path[-1])]
        return f"{_NOW}{new}" if new else OBSOLETE, ""
    if path[:-1] == ():
        known += _SCENARIO_KEYS if "vehicle" in model.model_fields else DOCUMENT_KEYS
    elif len(path) == 2 and path[0] in PARTS:
        known += DOCUMENT_KEYS
    if path[-1] in _IN_FILES_ONLY and path[-1] in known:
        return "works in a file only", _IN_FILES_ONLY[str(path[-1])]
    hint = _elsewhere(str(path[-1]), model) if len(path) == 1 else ""
    hint = hint or suggestion(str(path[-1]), known)
    if hint:
        return f"unknown key; {hint}", ""
    listed = known if len(known) <= _MANY_KEYS else [*known[:_MANY_KEYS], "..."]
    return "unknown key", ", ".join(listed)


def _elsewhere(key: str, model: type[Section]) -> str:
    """Return a hint if another section of the scenario has this key."""
    for name, field in model.model_fields.items():
        section = section_of(field.annotation)
        if section is not None and key in keys_of(section):
            return f"did you mean {name}.{key}?"
    return ""


def value_at(tree: Any, path: Path) -> Any:
    """Return the value at `path`, or NOTHING if there is none."""
    for part in path:
        try:
            tree = tree[part]
        except (KeyError, IndexError, TypeError):
            return NOTHING
    return tree


# the allowed values of a field in words, for errors and docs/reference/

_BOUNDS = (("gt", ">"), ("ge", ">="), ("lt", "<"), ("le", "<="))
_LONG_INTEGER = 2**62
_PLURALS = {"a number": "numbers", "a whole number": "whole numbers", "a text": "texts", "a table": "tables"}


def unwrap(annotation: Any, table: bool = False) -> tuple[Any, list[Any]]:
    """Return the bare type inside Optional and Annotated, and the metadata of all levels.

    For a union, the result is the first type, or with `table` the first section.
    """
    metadata: list[Any] = []
    while True:
        origin = get_origin(annotation)
        if origin is Annotated:
            annotation, *marks = get_args(annotation)
            for mark in marks:
                metadata += mark.metadata if isinstance(mark, FieldInfo) else [mark]
        elif origin in (Union, types.UnionType):
            forms = [part for part in get_args(annotation) if part is not type(None)]
            annotation = next((form for form in forms if table and section_of(form)), forms[0])
        else:
            return annotation, metadata


def section_of(annotation: Any) -> type[Section] | None:
    """Return the section that a field of this type contains, directly or in a list; None if it contains none."""
    bare, _ = unwrap(annotation)
    if get_origin(bare) is tuple:
        bare, _ = unwrap(get_args(bare)[0])
    return bare if isinstance(bare, type) and issubclass(bare, Section) else None


def field_at(model: type[Section], path: Path, *, table: bool = False) -> tuple[Any, list[Any]]:
    """Return the type and metadata of the field at `path`; with `table`, the table among several forms of the field.

    The result is (None, []) if the schema has no such field.
    """
    annotation: Any = model
    metadata: list[Any] = []
    for n, part in enumerate(path, 1):
        if isinstance(annotation, type) and issubclass(annotation, Section):
            if isinstance(part, int):
                continue  # the index of a key that holds one table or a list of tables
            field = next((f for name, f in annotation.model_fields.items() if (f.alias or name) == part), None)
            if field is None:
                return None, []
            annotation, more = unwrap(field.annotation, isinstance(path[n], str) if n < len(path) else table)
            metadata = [*field.metadata, *more]
        elif get_origin(annotation) is tuple and isinstance(part, int):
            items = get_args(annotation)
            annotation, metadata = unwrap(items[0] if items[-1] is ... else items[min(part, len(items) - 1)])
        else:
            return None, []
    return annotation, metadata


def keys_of(section: type[Section]) -> list[str]:
    """Return the keys of a section as they appear in TOML."""
    return [field.alias or name for name, field in section.model_fields.items()]


def describe(annotation: Any, metadata: list[Any]) -> str:
    """Return the allowed values of a field in a few words, or an empty string for an unknown type."""
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
