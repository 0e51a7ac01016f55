"""`--set section.key=value`: single values that a person changes from the command line."""

from __future__ import annotations

import tomllib
from dataclasses import dataclass
from typing import Any

from maxq.sim.scenario.documents import Source, Table, adopt, drop, put
from maxq.sim.scenario.errors import Path, ScenarioError

LABEL = "--set"
_USAGE = "--set KEY=VALUE, e.g. --set run.step_s=0.0005 or --set vehicle.stage.0.tank.0.damping_ratio=0.01"


@dataclass(frozen=True)
class Override:
    """One override: its path, and the value as TOML would give it; `value` None takes the key away."""

    path: Path
    value: Any


def parse_override(text: str) -> Override:
    """`a.b.0.c=value`. The right side is a TOML value; what is none (a bare word) is a text; empty: remove
    the key.

    Raises ScenarioError when there is no `=` or the path has an empty part.
    """
    left, equals, right = text.partition("=")
    path = tuple(part.strip() for part in left.split("."))
    if not equals:
        raise ScenarioError(LABEL, "has no '='", text, allowed=_USAGE)
    if not all(path):
        raise ScenarioError(LABEL, "is no path of a key", left or '""', allowed=_USAGE)
    right = right.strip()
    return Override(path, _value(right) if right else None)


def _value(text: str) -> Any:
    try:
        document = tomllib.loads(f"value = {text}")
    except (ValueError, RecursionError):
        return text
    return document["value"] if list(document) == ["value"] else text


def apply(overrides: tuple[Override, ...], tree: Table | None, source: Source, shift: Path = ()) -> None:
    """Write `overrides` into `tree`, which stands at `shift` of the scenario."""
    for override in overrides:
        assert tree is not None
        if override.value is None:
            drop(tree, override.path, source, shift)
        else:
            put(tree, override.path, adopt(override.value, source), source, shift)
