"""The JSON Schemas of all files that a user writes, and of verdict.json: `simrun schema KIND`.

They are made from the models that check or write these files.
"""

from __future__ import annotations

from typing import Any

from maxq.design.case.basis import Basis
from maxq.design.case.schema import Case
from maxq.design.model.given_file import GivenPoints
from maxq.design.verify.suite import Suite
from maxq.sim.campaign.schema import CampaignFile
from maxq.sim.input.ranges import range_of
from maxq.sim.input.values import Section, optional
from maxq.sim.scenario.schema_design import Design
from maxq.sim.scenario.schema_scenario import Scenario
from maxq.sim.scenario.schema_vehicle import Vehicle
from maxq.tools.vehicle.layout import Layout
from maxq.tools.verify.record_model import verdict_schema


class DesignFile(Design):
    """A file in designs/."""

    basis: Basis | None = optional("conditions of the design; without stages, or for all stages")  # type: ignore[assignment]  # a table to sim


MODELS: dict[str, type[Section]] = {
    "scenario": Scenario,
    "vehicle": Vehicle,
    "design": DesignFile,
    "campaign": CampaignFile,
    "case": Case,
    "suite": Suite,
    "layout": Layout,
    "points": GivenPoints,
}
KINDS = tuple(MODELS)
_EXTENDS = {"type": "string", "description": "file that this one extends"}
_UNSET = {"type": "array", "items": {"type": "string"}, "description": "keys of the extended file to remove"}
_APPEND = {"type": "object", "description": "lists whose elements are added to those of the extended file"}


def json_schema(kind: str) -> dict[str, Any]:
    """Return the JSON Schema (2020-12) of a kind of file in the form that a user writes.

    It allows `extends`, and the names of files in place of their content. The kind "verdict" is verdict.json.
    """
    if kind == "verdict":
        return verdict_schema()
    if kind == "campaign":
        return _campaign()
    schema = MODELS[kind].model_json_schema(by_alias=True)
    properties = schema["properties"]
    if kind == "scenario":
        for part in ("vehicle", "design"):
            content = properties[part].pop("anyOf", [{"$ref": properties[part].pop("$ref", "")}])
            properties[part]["anyOf"] = [{"type": "string"}, *content]
            about = f"any key of the {part} by its path, e.g. stage.0.name"
            properties[f"{part}_overrides"] = {"type": "object", "description": about}
    properties |= {"extends": _EXTENDS, "unset": _UNSET, "append": _APPEND}
    if required := schema.pop("required", []):
        schema["anyOf"] = [{"required": required}, {"required": ["extends"]}]
    cleaned: dict[str, Any] = _as_written(schema)
    return {"$schema": "https://json-schema.org/draft/2020-12/schema"} | cleaned


_KEPT = ("default", "enum", "required")  # keys with values, not schemas


def _as_written(node: Any, name: str = "") -> Any:
    """Return a schema for values that TOML can represent: without null, since optional keys are omitted, and without
    titles.

    Each number has the range for the `name` of its key or column, unless it has bounds of its own.
    """
    if isinstance(node, list):
        return [_as_written(item, name) for item in node]
    if not isinstance(node, dict):
        return node
    out = {key: _as_written(below, name) for key, below in node.items() if key not in _KEPT}
    out |= {key: node[key] for key in _KEPT if key in node and node[key] is not None}
    for key in ("properties", "$defs"):
        if key in out:
            out[key] = {n: _as_written(item, n) for n, item in node[key].items()}
    if isinstance(out.get("title"), str):
        del out["title"]
    choices = out.get("anyOf")
    if isinstance(choices, list) and {"type": "null"} in choices:
        rest = [choice for choice in choices if choice != {"type": "null"}]
        del out["anyOf"]
        out = (rest[0] | out) if len(rest) == 1 else out | {"anyOf": rest}
    if out.get("type") in ("number", "integer"):
        most = range_of(name).most
        ends = {"minimum": -most, "maximum": most}
        out |= {end: value for end, value in ends.items() if end not in out and f"exclusiveM{end[1:]}" not in out}
    return out


def _campaign() -> dict[str, Any]:
    """Return the JSON Schema of a scenario with the sections of a campaign."""
    schema = json_schema("scenario")
    further = _as_written(CampaignFile.model_json_schema(by_alias=True))
    further["$defs"]["Campaign"].pop("required")  # the extended file may be a campaign already
    return schema | {
        "description": CampaignFile.__doc__,
        "properties": schema["properties"] | further["properties"],
        "$defs": schema["$defs"] | further["$defs"],
    }
