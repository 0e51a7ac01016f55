"""Linear models and loops as a library.

    from maxq.design import api

    loop = api.loop("nominal", None, 40.0)                   # the scenario's own design, sampled exactly, pitch
    loop.response([1.0, 10.0]), loop.closed_poles()
    loop.to_frd(frequencies_hz), loop.to_state_space()       # for python-control

    node = api.nodes("nominal", [40.0])[0]
    weak = node.with_(bending_frequency=0.9, delay_s=0.005)  # deviations: design/model/dispersion.py
    api.loop(weak, "designs/ksr3-default", kind="pade")

    scenario = load_scenario("nominal")                      # pitch, yaw and roll together
    multiloop_margins(api.multiloops(scenario, scenario.design, [40.0])[0])

Wrong input is a ValueError of one line, in scenario and design files a `maxq.api.ScenarioError`.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Literal

from maxq.design.laws.law import Controller
from maxq.design.laws.registry import designed_law
from maxq.design.loop.fixed_path import Cut, FixedPath, Kind, fixed_path
from maxq.design.loop.loop import Loop
from maxq.design.loop.multiloop import multiloops
from maxq.design.model.dispersion import Dispersion
from maxq.design.model.instruments import Plane
from maxq.design.model.node import Node, disperse, nodes_along
from maxq.design.model.powered import node_times
from maxq.design.paper.errata import CORRECTED, PRESETS, Errata
from maxq.design.paper.nodes import PaperNode, paper_nodes
from maxq.design.paper.table2 import imposed, read_derivatives
from maxq.sim.scenario.loader import LoadedScenario, load_scenario
from maxq.sim.scenario.schema_design import Design

Plant = Literal["flown", "table2"]


def nodes(
    scenario: LoadedScenario | str | Path,
    times_s: Iterable[float] | None = None,
    *,
    plane: Plane = "pitch",
    errata: Errata | str = CORRECTED,
    plant: Plant = "flown",
    faults: bool = False,
) -> list[Node]:
    """Nodes along a flight of the scenario (loaded, a file, or a built-in name), at vehicle times in s; by default at
    such as suit the flight, stage by stage under full thrust (`node_times`).

    `plant`: the vehicle as flown, or with the derivatives of the paper's Table 2 (design/paper/table2.py).
    `errata`: switches, or the name of a preset; with one left in, the plant is the published equations (design/paper).
    `faults`: with what the scenario lets fail.
    """
    if plant not in ("flown", "table2"):
        raise ValueError(f"plant = {plant!r}: allowed is flown, table2")
    loaded = scenario if isinstance(scenario, LoadedScenario) else load_scenario(scenario)
    times = node_times(loaded) if times_s is None else times_s
    if preset(errata) != CORRECTED:
        return list(published_nodes(loaded, times, plane=plane, errata=errata, plant=plant, faults=faults))
    found = nodes_along(loaded, times, plane, faults)
    return imposed(found, read_derivatives()) if plant == "table2" else found


def published_nodes(
    scenario: LoadedScenario, times_s: Iterable[float], *, plane: Plane = "pitch", errata: Errata | str = CORRECTED,
    plant: Plant = "flown", faults: bool = False,
) -> list[PaperNode]:  # fmt: skip  # nine lines otherwise
    """Return nodes as `nodes`, on the published planar equations even where no erratum is left in."""
    found = paper_nodes(scenario, times_s, plane, preset(errata), faults)
    return imposed(found, read_derivatives()) if plant == "table2" else found


def preset(errata: Errata | str) -> Errata:
    """Switches as they are, or those of a preset's name."""
    if isinstance(errata, Errata):
        return errata
    if errata not in PRESETS:
        raise ValueError(f"errata = {errata!r}: allowed is {', '.join(PRESETS)}")
    return PRESETS[errata]


def load_design(name: str | Path, beside: LoadedScenario | str | Path = "nominal") -> Design:
    """The design in a file, or the built-in one (`designs/...`). Raises ScenarioError.

    A design is read as part of a scenario, `beside`, whose folder is one of those where it is looked for.
    """
    label = beside.label if isinstance(beside, LoadedScenario) else beside
    design = load_scenario(label, [f'design="{Path(name).as_posix()}"']).design
    assert design is not None
    return design


def law_at(design: Design, node: Node, kind: Kind = "sampled") -> Controller:
    """The design's law at a node's time and in its plane: as the flight computer runs it, or continuous."""
    law = designed_law(design.of_stage(node.stage))
    return law.at(node.scheduled(law.over), node.plane, node.instruments.sample_s if kind == "sampled" else None)


def close(path: FixedPath, design: Design) -> Loop:
    """The design's loop around a fixed path, with the law of its node's instant and plane."""
    return Loop(path, law_at(design, path.node, path.kind))


def loops(where: Iterable[Node], design: Design, *, kind: Kind = "sampled", cut: Cut = "gimbal_command") -> list[Loop]:
    """A design's loop at each node."""
    return [close(fixed_path(node, kind, cut), design) for node in where]


def loop(
    where: Node | LoadedScenario | str | Path,
    design: Design | str | Path | None = None,
    time_s: float | None = None,
    *,
    plane: Plane = "pitch",
    kind: Kind = "sampled",
    cut: Cut = "gimbal_command",
    errata: Errata | str = CORRECTED,
    plant: Plant = "flown",
) -> Loop:
    """A design's loop at one instant.

    `where`: a node, which brings its own time, plane, errata and plant; or a scenario, flown up to `time_s`.
    `design`: loaded, a file, a built-in name, or None for the scenario's own.
    """
    node, scenario = (where, None) if isinstance(where, Node) else (None, where)
    if isinstance(scenario, str | Path):
        scenario = load_scenario(scenario)
    if design is None:
        design = scenario.design if scenario is not None else None
        if design is None:
            raise ValueError("no design is given, and there is no scenario that has one")
    elif not isinstance(design, Design):
        design = load_design(design, scenario if scenario is not None else "nominal")
    if node is None:
        if time_s is None:
            raise ValueError("time_s is missing: when along the flight?")
        assert scenario is not None
        node = nodes(scenario, [time_s], plane=plane, errata=errata, plant=plant)[0]
    return loops([node], design, kind=kind, cut=cut)[0]


__all__ = [
    "Dispersion", "Errata", "Loop", "Node", "close", "disperse", "fixed_path", "law_at",
    "load_design", "loop", "loops", "multiloops", "node_times", "nodes", "preset",
]  # fmt: skip  # twelve more lines otherwise
