"""Copies of the built-in scenarios, for people to change."""

from __future__ import annotations

import shutil
from pathlib import Path

from maxq.sim.scenario.builtin import BUILTIN, builtin_names, builtin_path, campaign_path, scenarios_folder
from maxq.sim.scenario.documents import Array, Table, Text
from maxq.sim.scenario.errors import ScenarioError, suggestion
from maxq.sim.scenario.files import find
from maxq.sim.scenario.loader import CAMPAIGN_SECTIONS, load_with_sections


def copy_scenario(name: str, folder: str | Path) -> Path:
    """Copy the built-in scenario `name` with all it refers to into `folder`; returns the copied scenario
    file.

    The copies lie to each other as the originals do, so that what they name is found beside them; a vehicle's
    folder is copied whole. Raises ScenarioError when there is no such scenario, or a file would be
    overwritten (then nothing is copied).
    """
    root = scenarios_folder()
    path = builtin_path(name) or campaign_path(name)
    if path is None:
        hint = suggestion(name, builtin_names())
        problem = "no such built-in scenario" + (f"; {hint}" if hint else "")
        raise ScenarioError(name or '""', problem, allowed="" if hint else BUILTIN)
    loaded, sections, _ = load_with_sections(path, CAMPAIGN_SECTIONS)
    files = {file.path for file in loaded.files} | _named(sections)
    for vehicle in [file for file in files if file.name == "vehicle.toml"]:
        files |= {item for item in vehicle.parent.rglob("*") if item.is_file()}
    targets = {file: Path(folder) / file.relative_to(root) for file in sorted(files)}
    for target in targets.values():
        if target.exists():
            raise ScenarioError(str(target), "is there already, and is not overwritten", allowed="a new folder")
    try:
        for file, target in targets.items():
            target.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(file, target)
    except OSError as error:
        reason = (error.strerror or str(error)).lower()
        raise ScenarioError(str(folder), f"cannot be written: {reason}", allowed="a folder you may write") from None
    return targets[path]


def _named(sections: Table) -> set[Path]:
    """Files that the sections of a campaign name: every text that is found as one."""
    found: set[Path] = set()

    def look(value: object) -> None:
        if isinstance(value, Table):
            for item in value.values():
                look(item)
        elif isinstance(value, Array):
            for item in value:
                look(item)
        elif isinstance(value, Text) and value.endswith(".csv"):
            path = find(value, ("{}",))
            if path is not None:
                found.add(path)

    look(sections)
    return found
