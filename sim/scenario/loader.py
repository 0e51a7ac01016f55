"""The loader of scenarios, which finds and merges their files, applies overrides and validates the result.

    loaded = load_scenario("scenarios/nominal.toml", ["run.step_s=0.0005"])
    loaded.scenario.vehicle.stage[0].mass.table["mass_kg"]

Every error is a one-line ScenarioError. This module uses no kernels, so that loading compiles nothing.
"""

from __future__ import annotations

import json
import math
import shutil
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any, TypeVar

from pydantic import ValidationError

from maxq.sim.input.documents import (
    COMMAND_LINE,
    Override,
    Source,
    Text,
    TomlTable,
    adopt,
    apply,
    leaves,
    parse,
    parse_override,
    plain,
    put,
    source_of,
    walk,
)
from maxq.sim.input.errors import ScenarioError, suggestion
from maxq.sim.input.files import (
    DOCUMENT_KEYS,
    FOLDERS,
    PARTS,
    WANTED,
    ReadFile,
    Reading,
    builtin_files,
    find,
    locate,
    scenarios_folder,
)
from maxq.sim.input.ranges import LARGEST_NUMBER
from maxq.sim.input.tables_csv import CsvTable
from maxq.sim.input.values import Section
from maxq.sim.scenario.messages import explain
from maxq.sim.scenario.plausibility import warnings
from maxq.sim.scenario.schema_design import Design
from maxq.sim.scenario.schema_scenario import Scenario
from maxq.sim.scenario.schema_vehicle import Vehicle
from maxq.sim.scenario.upgrade import upgraded

AS_FLOWN = "scenario as flown"
CAMPAIGN_SECTIONS = ("campaign", "disperse", "wind_model")
"""The top-level keys of a campaign file in addition to those of a scenario (sim/campaign/schema.py)."""

_TOLD = 70  # characters of an override in a description
Model = TypeVar("Model", bound=Section)


@dataclass(frozen=True, repr=False)
class LoadedScenario:
    """A scenario that can be flown. Two scenarios are equal if their values and tables are the same, bit by bit."""

    scenario: Scenario
    label: str = field(compare=False)
    files: tuple[ReadFile, ...] = field(compare=False, repr=False)

    @property
    def name(self) -> str:
        return self.scenario.name

    def __repr__(self) -> str:
        design = f", design {self.design.name}" if self.design is not None else ""
        return f"<LoadedScenario {self.name} ({self.label}): {self.vehicle.name}{design}>"

    @property
    def vehicle(self) -> Vehicle:
        return self.scenario.vehicle

    @property
    def design(self) -> Design | None:
        return self.scenario.design

    @cached_property
    def warnings(self) -> tuple[str, ...]:
        """Return a line for each implausible value."""
        return warnings(self.scenario)

    @cached_property
    def as_flown(self) -> str:
        """Return the scenario as a self-contained TOML text, which `load_scenario_text` converts back."""
        return to_toml(self.scenario)

    def telling(self, overrides: Iterable[str]) -> LoadedScenario:
        """Return the scenario with the user's overrides added to its description, which they make incorrect.

        The scenario is unchanged if its description is empty or is itself overridden.
        """
        about, told = self.scenario.description.rstrip(), [text for text in overrides if not text.startswith("name=")]
        if not about or not told or any(text.startswith("description=") for text in told):
            return self
        short = (text if len(text) <= _TOLD else f"{text[:_TOLD]}..." for text in told)
        changed = self.scenario.model_copy(update={"description": f"{about}; changed: {', '.join(short)}"})
        return replace(self, scenario=changed)


def load_scenario(path: str | Path, overrides: Iterable[str] = ()) -> LoadedScenario:
    """Return the scenario in the file `path`, or the built-in scenario of that name, with `key=value` overrides.

    Raises ScenarioError.
    """
    return load_with_sections(path, (), overrides)[0]


def is_campaign(path: str | Path) -> bool:
    """Return True if the file, or the built-in file of that name, has a [campaign]; False if it cannot be read."""
    try:
        return "campaign" in Reading().document(*locate(str(path), "scenario"), "scenario")
    except ScenarioError:
        return False


def load_with_sections(
    path: str | Path, sections: tuple[str, ...], overrides: Iterable[str] = ()
) -> tuple[LoadedScenario, TomlTable, Reading]:
    """Load a scenario from a file that may also have the top-level keys `sections`.

    Returns the scenario, the values of these keys without validation, and the reader of the files, because the sections
    may name files. Raises ScenarioError.
    """
    parsed = [parse_override(text) for text in overrides]
    file, label = locate(str(path), "scenario")
    reading = Reading()
    tree = reading.document(file, label, "scenario")
    _assemble(reading, tree, parsed, (file.parent,))
    extra = TomlTable(tree.source)
    for key in sections:
        if key in tree:
            extra.sources[key] = tree.sources.get(key, tree.source)
            extra[key] = tree.pop(key)
    _refuse_huge_numbers(extra)
    _refuse_foreign_design(tree)
    return _scenario(reading, tree, label, file.stem), extra, reading


def load_scenario_text(text: str, overrides: Iterable[str] = (), label: str = AS_FLOWN) -> LoadedScenario:
    """Return the scenario in a self-contained TOML `text`, such as that of a log. Raises ScenarioError.

    `label` is the name of the text in errors. Files that the text names are not read, but overrides may name files.
    """
    parsed = [parse_override(item) for item in overrides]
    tree = parse(text, Source(label))
    for key in DOCUMENT_KEYS:
        if key in tree:
            raise ScenarioError(label, "a scenario given as text must be self-contained", key, value=tree[key])
    if isinstance(tree.get("design"), dict):  # from an earlier version of maxq
        tree["design"] = adopt(upgraded(tree["design"], Design, tree.source)[0], tree.source)
    reading = Reading()
    _assemble(reading, tree, parsed, ())
    return _scenario(reading, tree, label, "scenario")


def load_file(
    model: type[Model], role: str, name: str | Path, overrides: Iterable[str]
) -> tuple[Model, TomlTable, Path, str, tuple[Path, ...]]:
    """Return a design, case or suite (`role`) from a file, or the built-in one of that name, with overrides.

    `overrides` are `key=value` texts. Also returns the document, its file, the file's name in messages, and all files
    read: first this file, then the files that it extends. Raises ScenarioError.
    """
    parsed = [parse_override(text) for text in overrides]
    file, label = locate(str(name), role)
    reading = Reading()
    tree = reading.document(file, label, role)
    shipped = scenarios_folder()
    apply(parsed, tree, Source(COMMAND_LINE, (Path.cwd(), file.parent, shipped / FOLDERS[role], shipped)))
    tree.setdefault("name", file.stem)
    files = tuple(reading.files)
    return _validated(model, tree, reading), tree, file, label, files


def read_design(name: str | Path) -> Design:
    """Return the design in a file, or the built-in design of that name, without a vehicle. Raises ScenarioError."""
    return load_file(Design, "design", name, ())[0]


def _validated(model: type[Model], tree: TomlTable, reading: Reading) -> Model:
    _refuse_huge_numbers(tree)
    try:
        return model.model_validate(plain(tree), context=reading)
    except ValidationError as error:
        raise explain(error, tree, model) from None


def _scenario(reading: Reading, tree: TomlTable, label: str, name: str) -> LoadedScenario:
    tree.setdefault("name", name)
    return LoadedScenario(_validated(Scenario, tree, reading), label, tuple(reading.files.values()))


def _refuse_foreign_design(tree: TomlTable) -> None:
    """Reject a design that was made for another vehicle, unless the command line sets the vehicle."""
    design, vehicle = tree.get("design"), tree.get("vehicle")
    if not isinstance(design, TomlTable) or not isinstance(vehicle, TomlTable):
        return
    made_for, flies = design.get("vehicle"), vehicle.get("name")
    if not made_for or not flies or made_for == flies:
        return
    if tree.sources.get("vehicle", tree.source).label != COMMAND_LINE:
        problem = f'the design was made for "{made_for}", and the scenario flies "{flies}"'
        allowed = "a scenario of the design's vehicle (--scenario); or set the vehicle: --vehicle, --set vehicle=..."
        raise tree.sources.get("design", tree.source).error(("design",), problem, allowed=allowed)


def _assemble(reading: Reading, tree: TomlTable, overrides: list[Override], folders: tuple[Path, ...]) -> None:
    """Apply overrides, and insert vehicle and design. An override may replace either of them or change a key in it."""
    command_line = Source(COMMAND_LINE, (Path.cwd(), *folders, scenarios_folder()))
    inside = [(path, value) for path, value in overrides if path[0] in PARTS and len(path) > 1]
    apply([override for override in overrides if override not in inside], tree, command_line)
    for part in PARTS:
        _bring_in(reading, tree, part)
    for path, _ in inside:
        if path[0] not in tree:
            raise command_line.error(path, f"the scenario has no {path[0]}")
    apply(inside, tree, command_line)


def _bring_in(reading: Reading, tree: TomlTable, part: str) -> None:
    """Replace the name of a vehicle or design file by its content, and apply `<part>_overrides` to it."""
    value = tree.get(part)
    if isinstance(value, Text):
        tree[part] = reading.named(value, tree.sources.get(part, tree.source), (part,), part)
    elif isinstance(value, TomlTable):
        tree[part] = reading.extended(value, part)
    elif value is not None:
        source = tree.sources.get(part, tree.source)
        raise source.error((part,), "has the wrong type", value=value, allowed=f"{WANTED[part]}, or a table")
    key = f"{part}_overrides"
    if key not in tree:
        return
    origin, changes = tree.sources.get(key, tree.source), tree.pop(key)
    if not isinstance(changes, TomlTable):
        raise origin.error((key,), "has the wrong type", value=changes, allowed=f"a table of keys of the {part}")
    if part not in tree:
        raise origin.error((key,), f"the scenario has no {part}")
    for path, leaf, source in leaves(changes):
        put(tree, (part, *path), leaf, Source(source.label, source.folders, (part,), (key,)))


def _refuse_huge_numbers(tree: TomlTable) -> None:
    """Reject numbers so large that the checks of the schema could overflow."""
    if not _holds_huge_number(tree):
        return
    for path, value in walk(tree):
        if _holds_huge_number(value):
            allowed = f"numbers up to {LARGEST_NUMBER:g}"
            raise source_of(tree, path).error(path, "is too large", value=value, allowed=allowed)


def _holds_huge_number(value: Any) -> bool:
    if isinstance(value, dict | list):
        return any(map(_holds_huge_number, value.values() if isinstance(value, dict) else value))
    return isinstance(value, int | float) and LARGEST_NUMBER < abs(value) < math.inf


def copy_scenario(name: str, folder: str | Path) -> Path:
    """Copy the built-in scenario or campaign `name` with all its files into `folder`, and return its copy.

    The copies keep their relative paths, so that references between them remain valid. Raises ScenarioError if there is
    no such scenario, or if a file cannot be written. If a file would be overwritten, it is raised before any file is
    copied.
    """
    known = builtin_files("scenario") | builtin_files("campaign")
    if name not in known:
        hint = suggestion(name, known)
        problem = "no such built-in scenario" + (f"; {hint}" if hint else "")
        raise ScenarioError(name or '""', problem, allowed="" if hint else "what simrun --list names")
    loaded, sections, _ = load_with_sections(known[name], CAMPAIGN_SECTIONS)
    files = {file.path for file in loaded.files}
    named = (find(value) for _, value in walk(sections) if isinstance(value, Text) and value.endswith(".csv"))
    files |= {path for path in named if path is not None}
    targets = {file: Path(folder) / file.relative_to(scenarios_folder()) for file in sorted(files)}
    for target in targets.values():
        if target.exists():
            raise ScenarioError(str(target), "already exists, and is not overwritten", allowed="a new folder")
    try:
        for file, target in targets.items():
            target.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(file, target)
    except OSError as error:
        reason = (error.strerror or str(error)).lower()
        raise ScenarioError(str(folder), f"cannot be written: {reason}", allowed="a folder you may write") from None
    return targets[known[name]]


def to_toml(section: Section) -> str:
    """Return the section as TOML with every key that has a value, including defaults; reading it gives the same bits.

    Floats are written by `repr`, the shortest decimal that gives the same double. A column of a table is one line.
    tomli-w would write each number of a list on its own line: 56,000 lines for the nominal scenario instead of 330, in
    three times the time.
    """
    return "\n".join(_toml_lines(told(section), ())) + "\n"


def told(value: Any) -> Any:
    """Return a section as nested dictionaries and lists for TOML and JSON; keys without a value are omitted."""
    if isinstance(value, Section):
        fields = {(f.alias or n): getattr(value, n) for n, f in type(value).model_fields.items()}
        return {key: told(item) for key, item in fields.items() if item is not None}
    if isinstance(value, CsvTable):
        return value.told()
    if isinstance(value, dict):
        return {key: told(item) for key, item in value.items()}
    return [told(item) for item in value] if isinstance(value, tuple) else value


def _toml_lines(table: dict[str, Any], path: tuple[str, ...]) -> Iterator[str]:
    """Yield the lines of a table at `path`, with values first, because values after a header belong to its subtable."""
    below: list[tuple[str, str, dict[str, Any]]] = []
    for key, value in table.items():
        name = key if key.isascii() and key.replace("_", "").replace("-", "").isalnum() else _toml_value(key)
        if isinstance(value, dict):
            below.append((name, "[{}]", value))
        elif isinstance(value, list) and value and isinstance(value[0], dict):
            below += [(name, "[[{}]]", item) for item in value]
        else:
            yield f"{name} = {_toml_value(value)}"
    for name, header, item in below:
        yield "\n" + header.format(".".join((*path, name)))
        yield from _toml_lines(item, (*path, name))


def _toml_value(value: Any) -> str:
    """Return a value as TOML.

    JSON strings, finite numbers, booleans and lists are valid TOML, except for the character DEL, which TOML requires
    to be escaped.
    """
    return json.dumps(value, ensure_ascii=False, allow_nan=False).replace("\x7f", "\\u007F")
