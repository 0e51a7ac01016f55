"""The built-in layout petrel as simvehicle writes it, for tests on a second vehicle: several stages, no fins."""

from __future__ import annotations

import tempfile
from functools import cache
from pathlib import Path

from maxq import LoadedScenario, Node
from maxq.design.model.node import nodes_along
from maxq.sim.scenario.loader import load_scenario
from maxq.tools.vehicle.build import build
from maxq.tools.vehicle.files import write
from maxq.tools.vehicle.layout import read_layout


@cache
def folder() -> Path:
    """With the files of the vehicle; kept for the session."""
    out = Path(tempfile.mkdtemp(prefix="petrel-"))
    write(build(read_layout("petrel")), out)
    return out


@cache
def scenario(*overrides: str) -> LoadedScenario:
    return load_scenario(folder() / "scenario.toml", overrides)


@cache
def nodes(*times_s: float) -> tuple[Node, ...]:
    return tuple(nodes_along(scenario(), times_s))
