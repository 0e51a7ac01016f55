"""Build the layout petrel with simvehicle, for tests on a second vehicle with several stages and no fins."""

from __future__ import annotations

import json
from functools import cache
from pathlib import Path

from made_once import copy_of

from maxq import LoadedScenario, Node
from maxq.design.model.node import nodes_along
from maxq.sim.scenario.loader import load_scenario
from maxq.tools.vehicle.build import build
from maxq.tools.vehicle.files import write
from maxq.tools.vehicle.layout import read_layout


@cache
def folder() -> Path:
    """Return a folder with the files of the vehicle, kept for the session."""
    return _files() / "petrel"


def path() -> tuple[float, tuple[float, float]]:
    """Return the pitch-over time and tangents of its ascent to orbit; the search takes twenty seconds."""
    kick_rad, *tangents = json.loads((_files() / "path.json").read_text())
    return kick_rad, (tangents[0], tangents[1])


@cache
def _files() -> Path:
    return copy_of("petrel", _build)


def _build(out: Path) -> None:
    built = build(read_layout("petrel"))
    write(built, out / "petrel")
    assert built.flight.tangents is not None
    (out / "path.json").write_text(json.dumps([built.flight.kick_rad, *built.flight.tangents]))


@cache
def scenario(*overrides: str) -> LoadedScenario:
    return load_scenario(folder() / "scenario.toml", overrides)


@cache
def nodes(*times_s: float) -> tuple[Node, ...]:
    return tuple(nodes_along(scenario(), times_s))
