"""The exported reference and JSON Schemas agree with the loader."""

from __future__ import annotations

import json
import re
import tomllib
from pathlib import Path

import pytest

from maxq.tools import simrun
from maxq.tools.dev.documents.reference import fill, keys, pages
from maxq.tools.schemas import KINDS, json_schema

DOCS = Path(__file__).resolve().parents[1] / "docs"


def test_the_reference_has_every_key_of_every_kind() -> None:
    for kind in KINDS:
        text, schema = keys(kind), json_schema(kind)
        own = set(schema["properties"]) - {"extends", "unset", "append", "vehicle_overrides", "design_overrides"}
        if kind == "campaign":
            own -= set(json_schema("scenario")["properties"])
        assert own <= set(re.findall(r"^\| `(\w+)` \|", text, re.MULTILINE)), kind
    with pytest.raises(KeyError):
        fill("<!-- from code: nosuch -->")


def test_tables_are_put_between_their_marks_once() -> None:
    page = "a\n<!-- from code: events -->\nb\n<!-- from code: metrics -->\nc\n"
    filled = fill(page)
    assert fill(filled) == filled
    assert filled.startswith("a\n<!-- from code: events -->\n\n| event |")
    assert "\n<!-- end of code -->\nb\n<!-- from code: metrics -->\n\n| metric |" in filled
    assert filled.endswith("\n<!-- end of code -->\nc\n")
    assert fill(filled.replace("`apogee`", "`summit`")) == filled


@pytest.mark.parametrize("page", pages(), ids=lambda page: page.stem)
def test_tables_of_the_pages_are_those_of_the_code(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    assert fill(text) == text, "python -m maxq.tools.dev.documents.reference --write"


@pytest.mark.parametrize("kind", KINDS)
def test_the_command_prints_the_schema(kind: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert simrun.main(["--schema", kind]) == 0
    assert json.loads(capsys.readouterr().out) == json_schema(kind)


@pytest.mark.parametrize("kind", KINDS)
def test_every_key_has_a_meaning(kind: str) -> None:
    """Every key with a value has a description for the reference and for editors."""
    schema = json_schema(kind)
    for name, section in {"": schema, **schema["$defs"]}.items():
        for key, value in section["properties"].items():
            assert "description" in value or "$ref" in value, f"{kind} {name}.{key}"


def test_schema_is_of_the_file_a_person_writes() -> None:
    schema = json_schema("scenario")
    assert {"extends", "unset", "append", "vehicle_overrides", "design_overrides"} <= set(schema["properties"])
    assert {"type": "string"} in schema["properties"]["vehicle"]["anyOf"]
    assert schema["additionalProperties"] is False
    assert schema["anyOf"] == [{"required": ["vehicle"]}, {"required": ["extends"]}]
    assert '"null"' not in json.dumps(schema)


@pytest.mark.parametrize("name", ["first", "ksr3"])
def test_shipped_campaigns_use_what_the_schema_knows(name: str) -> None:
    schema = json_schema("campaign")
    file = tomllib.loads((DOCS.parent / "scenarios" / "campaigns" / f"{name}.toml").read_text(encoding="utf-8"))
    assert set(file) <= set(schema["properties"])
    assert set(json_schema("scenario")["properties"]) < set(schema["properties"])
    assert set(file["campaign"]) <= set(schema["$defs"]["Campaign"]["properties"])
    assert "required" not in schema["$defs"]["Campaign"]  # a campaign may extend another
    known = schema["$defs"]["Disperse"]
    for entry in file["disperse"]:
        assert set(entry) <= set(known["properties"])
        assert set(known["required"]) <= set(entry)
        assert entry["distribution"] in known["properties"]["distribution"]["enum"]
    for reference in json.dumps(schema).split('"#/$defs/')[1:]:
        assert reference.split('"')[0] in schema["$defs"]
