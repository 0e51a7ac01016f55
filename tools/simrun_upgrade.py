"""The subcommand `simrun upgrade FILE`: convert a file of an earlier version of maxq to the present format.

It converts designs, cases, suites, scenarios and campaigns.
"""

from __future__ import annotations

import shutil
from pathlib import Path

from maxq.sim.files import whole_file
from maxq.sim.input.documents import Source, TomlArray, TomlTable, parse
from maxq.sim.input.errors import ScenarioError
from maxq.sim.input.files import Reading, kind, shown
from maxq.sim.scenario.upgrade import newest_version, upgraded_text
from maxq.tools.cli.frame import Exit
from maxq.tools.cli.terminal import tell
from maxq.tools.schemas import MODELS

_ALLOWED = "a design, case, suite, scenario or campaign (.toml)"
_OF_SUITES = ("flight", "margins", "certificate", "dispersed_limit")


def execute(name: str) -> int:
    """Convert a file in place. Return the exit code. Raises ScenarioError and FileError."""
    path, reading = Path(name), Reading()
    if kind(path) != "file":
        raise ScenarioError(name or '""', "no such file", allowed=_ALLOWED)
    label = shown(path)
    text = reading.text(path, label, "a TOML file")
    model = MODELS[role_of(path, label, reading)]
    newest, given = newest_version(model), parse(text, Source(label)).get("schema")
    if given is not None and (type(given) is not int or not 1 <= given <= newest):
        raise ScenarioError(label, "is not a version of the format", "schema", value=given, allowed=f"1 to {newest}")
    new, changes = upgraded_text(text, model, Source(label))
    if not changes:
        tell(f"{label}: nothing to change, of schema {newest} already")
        return Exit.OK
    with whole_file(path.resolve()) as part:
        part.write_bytes(new.encode())
        shutil.copymode(path, part)
    tell(f"{label}: upgraded", *(f"  {change}" for change in changes))
    return Exit.OK


def role_of(path: Path, label: str, reading: Reading) -> str:
    """Return the kind of a file, by its keys and those of the files that it extends. Raises ScenarioError."""
    problem: ScenarioError | None = None
    for role in ("suite", "case", "design", "scenario"):
        try:
            found = _role_by_keys(reading.document(path, label, role, ignore_unset=True))
        except ScenarioError as error:  # the extended file is of another kind
            problem = problem or error
            continue
        if found == role:
            return role
    raise problem or ScenarioError(label, "is not of a kind that has an earlier version", allowed=_ALLOWED)


def _role_by_keys(tree: TomlTable) -> str:
    gains = tree.get("gains")
    if any(key in tree for key in _OF_SUITES) or isinstance(tree.get("campaign"), TomlArray):
        return "suite"
    if "vehicle" in tree and "run" in tree:
        return "scenario"
    if isinstance(gains, TomlTable) and "table" in gains:
        return "design"
    return "case" if "scenario" in tree else ""
