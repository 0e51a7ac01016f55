"""Reads case files: finds them, what they extend and the scenario that they name, applies overrides, validates.

    loaded = read_case("ksr3-identical", ["filter.structure='F6'"])

Every mistake is a ScenarioError of one line.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from maxq.design.case.schema import Case
from maxq.sim.scenario.documents import Table, Text
from maxq.sim.scenario.errors import ScenarioError
from maxq.sim.scenario.files import find
from maxq.sim.scenario.loader import LoadedScenario, load_file, load_scenario


@dataclass(frozen=True)
class LoadedCase:
    """A case and the scenario whose flight it is about."""

    case: Case
    label: str
    scenario: LoadedScenario

    @property
    def name(self) -> str:
        return self.case.name


def read_case(name: str | Path, overrides: Iterable[str] = ()) -> LoadedCase:
    """The case in a file, or the built-in one of that name, with `key=value` overrides. Raises ScenarioError."""
    case, tree, file, label = load_file(Case, "case", name, overrides)
    return LoadedCase(case, label, _scenario(tree, case, file))


def _scenario(tree: Table, case: Case, file: Path) -> LoadedScenario:
    """The named scenario: beside the case, or as `load_scenario` finds it."""
    name = tree.get("scenario")
    beside = find(name, ("{}", "{}.toml")) if isinstance(name, Text) else None
    try:
        return load_scenario(beside if beside is not None and beside != file else case.scenario)
    except ScenarioError as error:
        if error.file == case.scenario:  # the name itself is wrong
            source = tree.sources.get("scenario", tree.source)
            raise source.error(("scenario",), error.problem, value=case.scenario, allowed=error.allowed) from None
        raise
