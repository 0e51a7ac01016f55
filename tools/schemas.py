"""Writes docs/scenario.md and the JSON Schemas with which editors complete scenario files.

python -m maxq.tools.schemas [FOLDER]
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

from maxq.sim.campaign.schema import CampaignFile
from maxq.sim.scenario.reference import scenario_reference
from maxq.sim.scenario.schema_design import Design
from maxq.sim.scenario.schema_scenario import Scenario
from maxq.sim.scenario.schema_values import Section
from maxq.sim.scenario.schema_vehicle import Vehicle

_EXTENDS = {"type": "string", "description": "file on top of which this one lies"}
_UNSET = {
    "type": "array",
    "items": {"type": "string"},
    "description": "keys of the extended file that are taken away",
}


def _overrides(part: str) -> dict[str, Any]:
    return {"type": "object", "description": f"any key of the {part} by its path, e.g. stage.0.name"}


def json_schema(model: type[Section]) -> dict[str, Any]:
    """JSON Schema (2020-12) of a file as a person writes it: with `extends`, and files where the model has
    content.
    """
    schema = model.model_json_schema(by_alias=True)
    properties = schema["properties"]
    if model is Scenario:
        for part in ("vehicle", "design"):
            content = properties[part].pop("anyOf", [{"$ref": properties[part].pop("$ref", "")}])
            content = [choice for choice in content if choice != {"type": "null"}]
            properties[part]["anyOf"] = [{"type": "string"}, *content]
            properties[f"{part}_overrides"] = _overrides(part)
    properties |= {"extends": _EXTENDS, "unset": _UNSET}
    required = schema.pop("required", [])
    if required:
        schema["anyOf"] = [{"required": required}, {"required": ["extends"]}]
    cleaned: dict[str, Any] = _without_null(schema)
    return {"$schema": "https://json-schema.org/draft/2020-12/schema"} | cleaned


def _without_null(node: Any) -> Any:
    """The schema without null, which TOML does not have (optional keys are left out), and without titles."""
    if isinstance(node, list):
        return [_without_null(item) for item in node]
    if not isinstance(node, dict):
        return node
    out = {
        key: _without_null(item)
        for key, item in node.items()
        if not (key == "default" and item is None) and not (key == "title" and isinstance(item, str))
    }
    choices = out.get("anyOf")
    if isinstance(choices, list) and {"type": "null"} in choices:
        rest = [choice for choice in choices if choice != {"type": "null"}]
        del out["anyOf"]
        out = (rest[0] | out) if len(rest) == 1 else out | {"anyOf": rest}
    return out


def campaign_schema() -> dict[str, Any]:
    """JSON Schema of a campaign file: a scenario with the sections that make it a campaign."""
    schema, further = json_schema(Scenario), json_schema(CampaignFile)
    sections = {name: further["properties"][name] for name in CampaignFile.model_fields}
    further["$defs"]["Campaign"].pop("required")  # the file that is extended may be a campaign already
    return schema | {
        "description": CampaignFile.__doc__,
        "properties": schema["properties"] | sections,
        "$defs": schema["$defs"] | further["$defs"],
    }


def pages() -> dict[str, str]:
    """The exported files by name."""
    models: dict[str, type[Section]] = {"scenario": Scenario, "vehicle": Vehicle, "design": Design}
    out = {f"{name}.schema.json": json.dumps(json_schema(m), indent=1) + "\n" for name, m in models.items()}
    out["campaign.schema.json"] = json.dumps(campaign_schema(), indent=1) + "\n"
    return out | {"scenario.md": scenario_reference()}


def main(arguments: list[str]) -> int:
    folder = Path(arguments[0] if arguments else "docs")
    for name, text in pages().items():
        (folder / name).write_text(text, encoding="utf-8", newline="\n")
        print(folder / name)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
