"""Operating points whose plant is the published planar model, with each erratum corrected or as printed.

    nodes = paper_nodes(load_scenario("nominal"), [40.0], errata=PAPER)

They reproduce the study of Lee, Ahn & Roh. All other applications use the simulator's linear model
(design/model/held.py).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from maxq.design.model.held import table_clock_s
from maxq.design.model.instruments import Plane
from maxq.design.model.node import Node, nodes_along
from maxq.design.model.state_space import StateSpace
from maxq.design.paper.errata import CORRECTED, Errata
from maxq.design.paper.model import Liquids, plane_vehicle, published_plant
from maxq.sim.run.fly import FlightRun
from maxq.sim.scenario.loader import LoadedScenario
from maxq.sim.scenario.schema_vehicle import Stage
from maxq.sim.vehicle.actuator.kernel import Actuator


@dataclass(frozen=True)
class PaperNode(Node):
    """An operating point with the published equations in place of the simulator's derivative."""

    errata: Errata = CORRECTED
    liquids: Liquids | None = None  # of the nominal vehicle; needed only for the errata of the tanks

    def plant_in_wind(self, wind: bool = True) -> StateSpace:
        """Return the plant of the published equations, with the interface of `Node.plant_in_wind`."""
        self.check_axial_load()
        try:
            vehicle = plane_vehicle(self.held, self.condition, self.plane)
            plant = published_plant(vehicle, self.condition, self.axial_load_mps2, self.errata, self.liquids)
        except ValueError as problem:
            raise ValueError(f"operating point at {self.time_s:g} s: {problem}") from problem
        return (
            plant
            if wind
            else dataclasses.replace(plant, b=plant.b[:, :-1], d=plant.d[:, :-1], inputs=plant.inputs[:-1])
        )

    @property
    def actuators(self) -> tuple[Actuator, ...]:
        """Return the actuator of each drive, with a3 and a4 exchanged if the errata require it."""
        return tuple(
            a
            if not self.errata.actuator_labels or a.ideal or a.order < 6
            else dataclasses.replace(
                a, omega_3_radps=a.omega_4_radps, omega_4_radps=a.omega_3_radps, zeta_3=a.zeta_4, zeta_4=a.zeta_3
            )
            for a in self.instruments.actuators
        )

    def with_errata(self, errata: Errata) -> PaperNode:
        return dataclasses.replace(self, errata=errata)


def paper_nodes(
    scenario: LoadedScenario,
    times_s: Iterable[float],
    plane: Plane = "pitch",
    errata: Errata = CORRECTED,
    faults: bool = False,
) -> list[PaperNode]:
    """Return operating points as in `nodes_along`, with the published model of the same vehicle."""

    def refine(run: FlightRun, node: Node) -> Node:
        clock_s = table_clock_s(run.packed.parameters[node.stage], node.time_s - node.stage_start_s)
        liquids = _liquids(run.loaded.scenario.vehicle.stage[node.stage], clock_s, len(node.held.swing_rad))
        fields = {f.name: getattr(node, f.name) for f in dataclasses.fields(Node)}
        return PaperNode(**fields, errata=errata, liquids=liquids)

    found = nodes_along(scenario, times_s, plane, faults, refine)
    return [node for node in found if isinstance(node, PaperNode)]


def _liquids(stage: Stage, clock_s: float, tanks_known: int) -> Liquids | None:
    """Return the radius and depth of the liquid in each tank, or None if the vehicle's tables do not contain them."""
    tanks = stage.tank[:tanks_known]
    known = all(tank.radius_m is not None and "liquid_height_m" in tank.table for tank in tanks)
    if not known or any(tank.pendulums > 1 for tank in tanks):
        return None
    heights = [float(np.interp(clock_s, tank.table["time_s"], tank.table["liquid_height_m"])) for tank in tanks]
    return Liquids(np.array([tank.radius_m for tank in tanks], float), np.array(heights))
