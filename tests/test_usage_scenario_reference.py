"""The exported reference and JSON Schemas say what the loader does."""

from __future__ import annotations

import json
import tomllib
from pathlib import Path

import pytest

from maxq.sim.campaign.schema import CampaignFile
from maxq.sim.scenario.schema_design import Design
from maxq.sim.scenario.schema_scenario import Scenario
from maxq.sim.scenario.schema_vehicle import Vehicle
from maxq.tools.schemas import campaign_schema, json_schema, main, pages

DOCS = Path(__file__).resolve().parents[1] / "docs"


@pytest.mark.parametrize("name", sorted(pages()))
def test_docs_are_up_to_date(name: str) -> None:
    text = (DOCS / name).read_text(encoding="utf-8")
    fresh = pages()[name]
    hint = "run: python -m maxq.tools.schemas docs"
    if name.endswith(".json"):
        assert json.loads(text) == json.loads(fresh), hint
    else:
        assert text == fresh, hint


def test_export_writes_all_pages(tmp_path: Path) -> None:
    assert main([str(tmp_path)]) == 0
    assert {path.name for path in tmp_path.iterdir()} == set(pages())


def test_every_key_has_a_meaning() -> None:
    """Every key with a value of its own is described, so that reference and editors can say what it is."""
    for model in (Scenario, Vehicle, Design, CampaignFile):
        schema = json_schema(model)
        for name, section in {"": schema, **schema["$defs"]}.items():
            for key, value in section["properties"].items():
                assert "description" in value or "$ref" in value, f"{model.__name__} {name}.{key}"


def test_schema_is_of_the_file_a_person_writes() -> None:
    schema = json_schema(Scenario)
    assert {"extends", "unset", "vehicle_overrides", "design_overrides"} <= set(schema["properties"])
    assert {"type": "string"} in schema["properties"]["vehicle"]["anyOf"]
    assert schema["additionalProperties"] is False
    assert schema["anyOf"] == [{"required": ["vehicle"]}, {"required": ["extends"]}]
    assert '"null"' not in json.dumps(schema)


@pytest.mark.parametrize("name", ["first", "ksr3"])
def test_shipped_campaigns_use_what_the_schema_knows(name: str) -> None:
    schema = campaign_schema()
    file = tomllib.loads((DOCS.parent / "scenarios" / "campaigns" / f"{name}.toml").read_text(encoding="utf-8"))
    assert set(file) <= set(schema["properties"])
    assert set(json_schema(Scenario)["properties"]) < set(schema["properties"])
    assert set(file["campaign"]) <= set(schema["$defs"]["Campaign"]["properties"])
    assert "required" not in schema["$defs"]["Campaign"]  # a campaign may extend another
    known = schema["$defs"]["Disperse"]
    for entry in file["disperse"]:
        assert set(entry) <= set(known["properties"])
        assert set(known["required"]) <= set(entry)
        assert entry["distribution"] in known["properties"]["distribution"]["enum"]
    for reference in json.dumps(schema).split('"#/$defs/')[1:]:
        assert reference.split('"')[0] in schema["$defs"]
