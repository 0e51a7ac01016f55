"""Reads case files: finds them, what they extend and the scenario that they name, applies overrides, validates.

    loaded = read_case("ksr3-identical", ["filter.structure='F6'"])

Every mistake is a ScenarioError of one line.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from pydantic import ValidationError

from maxq.design.case.schema import Case
from maxq.sim.scenario.builtin import scenarios_folder
from maxq.sim.scenario.documents import Source, Table, Text, merge, parse, plain
from maxq.sim.scenario.errors import ScenarioError
from maxq.sim.scenario.files import Reading, find, named_file, not_found, shown
from maxq.sim.scenario.loader import LoadedScenario, load_scenario
from maxq.sim.scenario.messages import explain
from maxq.sim.scenario.overrides import apply, parse_override

VARIANTS = ("{}", "{}.toml")
WANTED = "a case file (.toml)"


@dataclass(frozen=True)
class LoadedCase:
    """A case and the scenario whose flight it is about."""

    case: Case
    label: str
    scenario: LoadedScenario

    @property
    def name(self) -> str:
        return self.case.name


def cases_folder() -> Path:
    """Folder of the built-in cases."""
    return scenarios_folder() / "designs" / "cases"


def builtin_cases() -> list[str]:
    """Names of the built-in cases, sorted."""
    return sorted(path.stem for path in cases_folder().glob("*.toml"))


def read_case(name: str | Path, overrides: Iterable[str] = ()) -> LoadedCase:
    """The case in a file, or the built-in one of that name, with `key=value` overrides. Raises ScenarioError."""
    parsed = tuple(parse_override(text) for text in overrides)
    file, label = named_file(str(name), cases_folder(), WANTED)
    tree = _document(Reading(), file, label, ())
    command_line = Source("--set", (Path.cwd(), file.parent, cases_folder()))
    apply(parsed, tree, command_line)
    tree.setdefault("name", file.stem)
    try:
        case = Case.model_validate(plain(tree))
    except ValidationError as error:
        raise explain(error, tree, Case) from None
    return LoadedCase(case, label, _scenario(tree, case, file))


def _scenario(tree: Table, case: Case, file: Path) -> LoadedScenario:
    """The named scenario: beside the case, or as `load_scenario` finds it."""
    beside = find(tree["scenario"], VARIANTS) if isinstance(tree.get("scenario"), Text) else None
    try:
        return load_scenario(beside if beside is not None and beside != file else case.scenario)
    except ScenarioError as error:
        if error.file == case.scenario:  # the name itself is wrong
            source = tree.sources.get("scenario", tree.source)
            raise source.error(("scenario",), error.problem, value=case.scenario, allowed=error.allowed) from None
        raise


def _document(reading: Reading, path: Path, label: str, chain: tuple[Path, ...]) -> Table:
    """The document in a file, on top of what its key `extends` names."""
    source = Source(label, (path.parent, cases_folder()))
    table = parse(reading.text(path, label, "a TOML file"), source)
    name = table.pop("extends", None)
    if name is None:
        return table
    if not isinstance(name, Text):
        raise source.error(("extends",), "has the wrong type", value=name, allowed=f"the name of {WANTED}")
    base_path = find(name, VARIANTS)
    if base_path is None:
        problem, allowed = not_found(name, WANTED, VARIANTS)
        raise source.error(("extends",), problem, value=name, allowed=allowed)
    if base_path in (*chain, path):
        raise source.error(("extends",), "files extend each other in a loop", value=name)
    base = _document(reading, base_path, shown(base_path), (*chain, path))
    base.pop("name", None)
    merge(base, table)
    base.source = source
    return base
