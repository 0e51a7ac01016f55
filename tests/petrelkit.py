"""The built-in layout petrel as simvehicle writes it, for tests on a second vehicle: several stages, no fins."""

from __future__ import annotations

import tempfile
from functools import cache
from pathlib import Path

import maxq
from maxq import LoadedScenario, Node
from maxq.design.model.node import nodes_along
from maxq.sim.scenario.loader import load_scenario


@cache
def folder() -> Path:
    """With the files of the vehicle; kept for the session."""
    out = Path(tempfile.mkdtemp(prefix="petrel-"))
    return maxq.vehicle("petrel", out)


@cache
def scenario(*overrides: str) -> LoadedScenario:
    return load_scenario(folder() / "scenario.toml", overrides)


@cache
def nodes(*times_s: float) -> tuple[Node, ...]:
    return tuple(nodes_along(scenario(), times_s))
