"""Operating points along a flight, with the linear model of the flown vehicle or with the published equations."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Literal

from maxq.design.model.instruments import Plane
from maxq.design.model.node import Node, nodes_along
from maxq.design.model.node_times import node_times
from maxq.design.paper.errata import CORRECTED, PRESETS, Errata
from maxq.design.paper.nodes import PaperNode, paper_nodes
from maxq.design.paper.table2 import imposed, read_derivatives
from maxq.sim.scenario.loader import LoadedScenario, load_scenario

PlantKind = Literal["flown", "table2"]


def nodes(
    scenario: LoadedScenario | str | Path,
    times_s: Iterable[float] | None = None,
    *,
    plane: Plane = "pitch",
    errata: Errata | str = "corrected",
    plant: PlantKind = "flown",
    faults: bool = False,
    held: bool = False,
) -> list[Node]:
    """Return the operating points of a scenario's flight in one plane, in the order of `times_s`.

    `scenario` is a loaded scenario, a file, or the name of a built-in one. `times_s` are vehicle times, s; None selects
    times under full thrust, stage by stage (`node_times`). `plant` is the vehicle as flown, or with the derivatives of
    the paper's Table 2 (design/paper/table2.py). `errata` are switches, or the name of a preset; with an uncorrected
    erratum, the plant is that of the published equations (design/paper). `faults` includes the failures of the
    scenario. With `held`, gravity is the axial load, as in a certificate's held flight, so that the speed is constant.
    Raises ScenarioError, and ValueError for a time outside the powered flight.
    """
    if plant not in ("flown", "table2"):
        raise ValueError(f"plant = {plant!r}: allowed is flown, table2")
    loaded = scenario if isinstance(scenario, LoadedScenario) else load_scenario(scenario)
    times = node_times(loaded) if times_s is None else times_s
    if preset(errata) != CORRECTED:
        printed = published_nodes(loaded, times, plane=plane, errata=errata, plant=plant, faults=faults)
        return [node.held_still() for node in printed] if held else list(printed)
    found = nodes_along(loaded, times, plane, faults)
    found = imposed(found, read_derivatives()) if plant == "table2" else found
    return [node.held_still() for node in found] if held else found


def published_nodes(
    scenario: LoadedScenario,
    times_s: Iterable[float],
    *,
    plane: Plane = "pitch",
    errata: Errata | str = "corrected",
    plant: PlantKind = "flown",
    faults: bool = False,
) -> list[PaperNode]:
    """Return operating points as in `nodes`, with the published planar equations even if all errata are corrected."""
    found = paper_nodes(scenario, times_s, plane, preset(errata), faults)
    return imposed(found, read_derivatives()) if plant == "table2" else found


def preset(errata: Errata | str) -> Errata:
    """Return the switches of a preset. Switches are returned unchanged. Raises ValueError for an unknown preset."""
    if isinstance(errata, Errata):
        return errata
    if errata not in PRESETS:
        raise ValueError(f"errata = {errata!r}: allowed is {', '.join(PRESETS)}")
    return PRESETS[errata]
