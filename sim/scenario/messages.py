"""From what pydantic reports to the one line that a person reads."""

from __future__ import annotations

from typing import Any

from pydantic import ValidationError

from maxq.sim.scenario.describe import describe, field_at, keys_of, section_of, unwrap
from maxq.sim.scenario.documents import Table, source_of
from maxq.sim.scenario.errors import NOTHING, Path, ScenarioError, suggestion
from maxq.sim.scenario.schema_values import Section

DOCUMENT_KEYS = ("extends", "unset")
SCENARIO_KEYS = (*DOCUMENT_KEYS, "vehicle_overrides", "design_overrides")
"""Keys that the loader uses up before the schema sees the document."""

NAMED_FILES = {
    "vehicle": "a folder with vehicle.toml, or a .toml file",
    "design": "a design file (.toml)",
}
"""What a scenario names by file, besides tables."""

_PROBLEMS = {
    "greater_than": "is out of range",
    "greater_than_equal": "is out of range",
    "less_than": "is out of range",
    "less_than_equal": "is out of range",
    "finite_number": "is not finite",
    "literal_error": "is none of the choices",
    "too_long": "has too many elements",
    "too_short": "has too few elements",
}
_MANY_KEYS = 24
_IN_FILES_ONLY = {
    "extends": 'a file of your own that begins with, e.g., extends = "nominal"',
    "unset": "--set KEY= to take a key away, or a file of your own with extends and unset",
}


def explain(error: ValidationError, tree: Table, model: type[Section]) -> ScenarioError:
    """The first mistake (unknown keys first: they explain missing ones), and how many more there are."""
    order = {"extra_forbidden": 0, "missing": 2}
    found = error.errors(include_url=False)
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
        path = path[:-1]  # a list that is too short: say so of the list
        problem, value, allowed = (
            "has too few elements",
            value_at(tree, path),
            describe(*field_at(model, path)),
        )
    elif first["type"] == "missing":
        problem, value = "required key is missing", NOTHING
        allowed = NAMED_FILES.get(str(path[0]), allowed) if len(path) == 1 else allowed
    else:
        problem = _PROBLEMS.get(first["type"], "has the wrong type")
        if first["type"] == "literal_error":
            hint = suggestion(str(value), [c.strip("'") for c in allowed.split(", ")])
            problem += f"; {hint}" if hint else ""
    source = source_of(tree, path)
    return source.error(path, problem, value=value, allowed=allowed, more=more)


def _causes(found: list[Any]) -> list[Any]:
    """Without complaints of a list being too short because an element of it is wrong."""
    paths = [detail["loc"] for detail in found]
    return [
        detail
        for detail in found
        if detail["type"] != "too_short"
        or not any(len(path) > len(detail["loc"]) and path[: len(detail["loc"])] == detail["loc"] for path in paths)
    ]


def _refused(path: Path, context: dict[str, Any], tree: Table, more: int) -> ScenarioError:
    details = {"allowed": context["allowed"], "more": more}
    if context["file"]:
        return ScenarioError(context["file"], context["problem"], context["place"], value=context["value"], **details)
    path += context["key"]
    value = context["value"]
    if value is NOTHING:
        value = value_at(tree, path)
    return source_of(tree, path).error(path, context["problem"], value=value, **details)


def _unknown_key(path: Path, model: type[Section]) -> tuple[str, str]:
    """Problem and allowed keys for the key at the end of `path`."""
    annotation, _ = field_at(model, path[:-1])
    section = section_of(unwrap(annotation)[0]) or model
    known = keys_of(section)
    if path[:-1] == ():
        known += SCENARIO_KEYS
    elif path[:-1] in (("vehicle",), ("design",)):
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
    """A hint when another section of the scenario has this key."""
    for name, field in model.model_fields.items():
        section = section_of(field.annotation)
        if section is not None and key in keys_of(section):
            return f"did you mean {name}.{key}?"
    return ""


def value_at(tree: Any, path: Path) -> Any:
    """The value at `path`, or NOTHING."""
    for part in path:
        try:
            tree = tree[part]
        except (KeyError, IndexError, TypeError):
            return NOTHING
    return tree
