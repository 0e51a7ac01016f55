"""Loads a scenario: finds its files, puts them together, applies overrides, validates.

    loaded = load_scenario("scenarios/nominal.toml", ["run.step_s=0.0005"])
    loaded.scenario.vehicle.stage[0].mass.table["mass_kg"]

Every mistake is a ScenarioError of one line. Nothing here knows kernels: loading compiles nothing.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

from pydantic import ValidationError

from maxq.sim.scenario.builtin import (
    BUILTIN,
    builtin_names,
    builtin_path,
    campaign_names,
    campaign_path,
    scenarios_folder,
)
from maxq.sim.scenario.documents import (
    Array,
    Source,
    Table,
    Text,
    drop,
    leaves,
    merge,
    parse,
    plain,
    put,
    source_of,
)
from maxq.sim.scenario.errors import LARGEST_NUMBER, ScenarioError, suggestion
from maxq.sim.scenario.errors import Path as KeyPath
from maxq.sim.scenario.files import ReadFile, Reading, find, kind, not_found, shown
from maxq.sim.scenario.messages import NAMED_FILES, explain
from maxq.sim.scenario.overrides import LABEL, Override, apply, parse_override
from maxq.sim.scenario.schema_design import Design
from maxq.sim.scenario.schema_scenario import Scenario
from maxq.sim.scenario.schema_vehicle import Vehicle
from maxq.sim.scenario.toml_writer import to_toml

PARTS = ("vehicle", "design")
"""What a scenario names by file."""

_VARIANTS = {
    "scenario": ("{}", "{}.toml"),
    "vehicle": ("{}", "{}/vehicle.toml", "{}.toml"),
    "design": ("{}", "{}.toml"),
}
_WANTED = {"scenario": "a scenario file (.toml)", **NAMED_FILES}
AS_FLOWN = "scenario as flown"
CAMPAIGN_SECTIONS = ("campaign", "disperse", "wind_model")
"""Top-level keys that a campaign file has beside those of a scenario (sim/campaign/schema.py)."""


@dataclass(frozen=True)
class LoadedScenario:
    """A scenario that can be flown. Two are equal when they hold the same values and tables, bit by bit."""

    scenario: Scenario
    label: str = field(compare=False)
    files: tuple[ReadFile, ...] = field(compare=False, repr=False)

    @property
    def name(self) -> str:
        return self.scenario.name

    @property
    def vehicle(self) -> Vehicle:
        return self.scenario.vehicle

    @property
    def design(self) -> Design | None:
        return self.scenario.design

    @cached_property
    def as_flown(self) -> str:
        """The scenario as one self-contained TOML text: `load_scenario_text` reads back an equal one."""
        return to_toml(self.scenario)

    def to_toml(self) -> str:
        """As `as_flown`."""
        return self.as_flown


def load_scenario(
    path: str | Path, overrides: Iterable[str] = (), known_metrics: tuple[str, ...] | None = None
) -> LoadedScenario:
    """The scenario in the file `path`, or the built-in one of that name, with `key=value` overrides applied.

    `known_metrics`: names that a requirement may use; None accepts any. Raises ScenarioError.
    """
    loaded, _, _ = load_with_sections(path, (), overrides, known_metrics)
    return loaded


def is_campaign(path: str | Path) -> bool:
    """Whether this file, or the built-in one of that name, has a [campaign]. False where it cannot be read."""
    try:
        file, label = _locate(str(path))
        return "campaign" in _document(Reading(), file, label, "scenario", ())
    except ScenarioError:
        return False


def load_with_sections(
    path: str | Path,
    sections: tuple[str, ...],
    overrides: Iterable[str] = (),
    known_metrics: tuple[str, ...] | None = None,
) -> tuple[LoadedScenario, Table, Reading]:
    """As `load_scenario`, for a file with further top-level keys: those of `sections` that it has, unchecked.

    Also returns what has read the files, so that the sections can name some. Raises ScenarioError.
    """
    parsed = tuple(parse_override(text) for text in overrides)
    file, label = _locate(str(path))
    reading = Reading(known_metrics)
    tree = _document(reading, file, label, "scenario", ())
    extra = Table(tree.source)
    loaded = _finish(reading, tree, label, parsed, folders=(file.parent,), name=file.stem, extra=(extra, sections))
    return loaded, extra, reading


def load_scenario_text(
    text: str,
    overrides: Iterable[str] = (),
    known_metrics: tuple[str, ...] | None = None,
    label: str = AS_FLOWN,
) -> LoadedScenario:
    """The scenario that a self-contained TOML `text` holds, e.g. one from a log. Raises ScenarioError.

    `label` names it in errors. Files that the text names are not read; overrides may name some.
    """
    parsed = tuple(parse_override(item) for item in overrides)
    tree = parse(text, Source(label))
    for key in ("extends", "unset"):
        if key in tree:
            raise ScenarioError(label, "a scenario given as text stands alone", key, value=tree[key])
    return _finish(Reading(known_metrics), tree, label, parsed, folders=(), name="scenario")


def _locate(name: str) -> tuple[Path, str]:
    """The file that a person means by `name`, and how to show it."""
    path = Path(name)
    there = kind(path) if name else ""
    if there == "file":
        return path.resolve(), name
    builtin = builtin_path(name.removesuffix(".toml")) or campaign_path(name.removesuffix(".toml"))
    if builtin is not None:
        return builtin, shown(builtin)
    hint = suggestion(name.removesuffix(".toml"), [*builtin_names(), *campaign_names()])
    as_a_file = not name.isidentifier() or hint  # a bare word may have been meant as one of ours
    missing = "no such file" if as_a_file else "neither a file nor a built-in scenario"
    problem = {"folder": "is a folder", "other": "is no ordinary file"}.get(there, missing)
    allowed = _WANTED["scenario"] + ("" if hint else f", or {BUILTIN}")
    raise ScenarioError(name or '""', f"{problem}; {hint}" if hint else problem, allowed=allowed)


def _document(reading: Reading, path: Path, label: str, role: str, chain: tuple[Path, ...]) -> Table:
    """The document in a file, with what it extends below it."""
    within: KeyPath = () if role == "scenario" else (role,)
    source = Source(label, (path.parent, scenarios_folder()), within)
    table = parse(reading.text(path, label, "a TOML file"), source)
    return _extended(reading, table, role, (*chain, path))


def _extended(reading: Reading, table: Table, role: str, chain: tuple[Path, ...]) -> Table:
    """`table` on top of the file that its key `extends` names."""
    prefix: KeyPath = () if role == "scenario" else (role,)
    name, unset = table.pop("extends", None), table.pop("unset", None)
    if name is None:
        if unset is not None:
            raise table.source.error((*prefix, "unset"), "there is nothing to take away from", allowed="with extends")
        return table
    where: KeyPath = (*prefix, "extends")
    if not isinstance(name, Text):
        raise table.source.error(where, "has the wrong type", value=name, allowed=f"the name of {_WANTED[role]}")
    path = find(name, _VARIANTS[role])
    if path is None:
        problem, allowed = not_found(name, _WANTED[role], _VARIANTS[role])
        raise table.source.error(where, problem, value=name, allowed=allowed)
    if path in chain:
        loop = " -> ".join(shown(p) for p in (*chain[chain.index(path) :], path))
        raise table.source.error(where, f"files extend each other in a loop: {loop}", value=name)
    base = _document(reading, path, shown(path), role, chain)
    base.pop("name", None)  # a scenario is named after its own file unless it says otherwise
    _unset(base, unset, table.source, (*prefix, "unset"))
    merge(base, table)
    base.source = table.source
    return base


def _unset(base: Table, unset: object, source: Source, where: KeyPath) -> None:
    """Take away the keys of `base` that the list `unset` names."""
    if unset is None:
        return
    if not isinstance(unset, Array) or not all(isinstance(item, str) for item in unset):
        raise source.error(where, "has the wrong type", value=unset, allowed="a list of keys, e.g. ['wind.profile']")
    for item in unset:
        drop(base, tuple(item.split(".")), source, where)


def _finish(
    reading: Reading,
    tree: Table,
    label: str,
    overrides: tuple[Override, ...],
    *,
    folders: tuple[Path, ...],
    name: str,
    extra: tuple[Table, tuple[str, ...]] | None = None,
) -> LoadedScenario:
    """Apply overrides, bring in vehicle and design, validate; what is `extra` is moved there, and not looked at."""
    command_line = Source(LABEL, (Path.cwd(), *folders, scenarios_folder()))
    apply(tuple(o for o in overrides if not _is_inside(o)), tree, command_line)
    for part in PARTS:
        _bring_in(reading, tree, part)
        inside = [o for o in overrides if _is_inside(o) and o.path[0] == part]
        if inside and part not in tree:
            raise command_line.error(inside[0].path, f"the scenario has no {part}")
        apply(tuple(Override(o.path[1:], o.value) for o in inside), tree.get(part), command_line, (part,))
    if "name" not in tree:
        tree["name"] = name
    if extra is not None:
        for key in extra[1]:
            if key in tree:
                extra[0].sources[key] = tree.sources.get(key, tree.source)
                extra[0][key] = tree.pop(key)
        _refuse_huge_numbers(extra[0], extra[0], ())
    _refuse_huge_numbers(tree, tree, ())
    try:
        scenario = Scenario.model_validate(plain(tree), context=reading)
    except ValidationError as error:
        raise explain(error, tree, Scenario) from None
    return LoadedScenario(scenario, label, tuple(reading.files.values()))


def _refuse_huge_numbers(tree: Table, value: object, path: KeyPath) -> None:
    """Refuse numbers with which the checks of the schema could overflow."""
    if isinstance(value, Table):
        for key, item in value.items():
            _refuse_huge_numbers(tree, item, (*path, key))
    elif isinstance(value, Array):
        for index, item in enumerate(value):
            _refuse_huge_numbers(tree, item, (*path, index))
    elif isinstance(value, int | float) and LARGEST_NUMBER < abs(value) < math.inf:
        allowed = f"numbers up to {LARGEST_NUMBER:g}"
        raise source_of(tree, path).error(path, "is too large", value=value, allowed=allowed)


def _is_inside(override: Override) -> bool:
    """Whether it changes a key of the vehicle or design, which have to be read first."""
    return override.path[0] in PARTS and len(override.path) > 1


def _bring_in(reading: Reading, tree: Table, part: str) -> None:
    """Replace the name of a vehicle or design file by its content, and apply `<part>_overrides` to it."""
    value = tree.get(part)
    source = tree.sources.get(part, tree.source)
    if isinstance(value, Text):
        path = find(value, _VARIANTS[part])
        if path is None:
            problem, allowed = not_found(value, _WANTED[part], _VARIANTS[part])
            if any(kind(folder / value) == "folder" for folder in value.source.folders) and part == "vehicle":
                problem = "the folder has no vehicle.toml"
            raise source.error((part,), problem, value=value, allowed=allowed)
        tree[part] = _document(reading, path, shown(path), part, ())
    elif isinstance(value, Table):
        tree[part] = _extended(reading, value, part, ())
    elif value is not None:
        raise source.error((part,), "has the wrong type", value=value, allowed=f"{_WANTED[part]}, or a table")
    key = f"{part}_overrides"
    changes = tree.pop(key, None)
    if changes is None:
        return
    origin = tree.sources.get(key, tree.source)
    if not isinstance(changes, Table):
        raise origin.error((key,), "has the wrong type", value=changes, allowed=f"a table of keys of the {part}")
    if part not in tree:
        raise origin.error((key,), f"the scenario has no {part}")
    for path_, leaf, leaf_source in leaves(changes):
        below = Source(leaf_source.label, leaf_source.folders, (part,), (key,))
        put(tree[part], path_, leaf, below, (part,))
