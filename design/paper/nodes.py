"""Nodes whose plant is the published planar model, with each erratum corrected or as printed.

    nodes = paper_nodes(load_scenario("nominal"), [40.0], errata=PAPER)

It reproduces the study of Lee, Ahn & Roh; all else stands on the linear model of the simulator (design/model/held.py).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from typing import Any, TypeVar

import numpy as np

from maxq.design.model.held import table_clock_s
from maxq.design.model.instruments import Plane
from maxq.design.model.node import Node, nodes_along
from maxq.design.model.state_space import StateSpace
from maxq.design.model.vehicle_at import StabilityDerivatives
from maxq.design.paper.errata import CORRECTED, Errata
from maxq.design.paper.plant import Liquids, alone, axial_load_mps2, vehicle_plant
from maxq.design.paper.vehicle_at import Modes, Pendulums, PlanarVehicle, stability_derivatives, vehicle_at
from maxq.sim.run.fly import FlightRun
from maxq.sim.scenario.loader import LoadedScenario
from maxq.sim.scenario.schema_vehicle import Stage
from maxq.sim.vehicle.actuator import Actuator

_Arrays = TypeVar("_Arrays", Modes, Pendulums, Liquids)


@dataclass(frozen=True)
class PaperNode(Node):
    """A node with the published equations in place of the simulator's; it takes no deviations."""

    planar: PlanarVehicle = dataclasses.field(kw_only=True)
    errata: Errata = CORRECTED
    liquids: Liquids | None = None  # needed only for the errata of the tanks; of the nominal vehicle

    def plant_in_wind(self, wind: bool = True) -> StateSpace:
        """`Node.plant_in_wind` by the published equations, with the node's errata."""
        swung = dataclasses.replace(self.planar.pendulums, swing_rad=self.held.swing_rad)
        vehicle = dataclasses.replace(self.planar, pendulums=swung)
        try:
            whole = vehicle_plant(vehicle, self.condition, self.errata, self.liquids, wind)
        except ValueError as problem:
            raise ValueError(f"node at {self.time_s:g} s: {problem}") from problem
        return alone(whole, vehicle, wind)

    @cached_property
    def axial_load_mps2(self) -> float:
        return axial_load_mps2(self.planar, self.condition)

    @cached_property
    def derivatives(self) -> StabilityDerivatives:
        return stability_derivatives(self.planar, self.condition)

    @cached_property
    def actuators(self) -> tuple[Actuator, ...]:
        """Of each drive, with a3 and a4 exchanged where the errata say so."""
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

    def with_(self, **deviations: Any) -> Node:
        """Raises ValueError."""
        raise ValueError(
            f"node at {self.time_s:g} s: the paper's model takes no deviations; allowed is plant = 'flown'"
        )

    def steps(self) -> list[Node]:
        """`Node.steps` of the published equations."""
        full, liquids = self.planar, self.liquids
        modes = dataclasses.replace(_emptied(full.modes), softening_kgpm=np.zeros((0, 0)), spatial=0)
        stiff = dataclasses.replace(full, modes=modes, across=None, cuts=None)
        massless: dict[str, Any] = {"gimballed_mass_kg": 0.0, "inertia_about_gimbal_kgm2": 0.0, "tvc_load": None}
        light = dataclasses.replace(stiff, engines=tuple(dataclasses.replace(one, **massless) for one in full.engines))
        frozen = _frozen(light)
        none = np.zeros_like(full.aerodynamics.slope_pr)
        air = dataclasses.replace(
            full.aerodynamics, drag=0.0, rate_damping=0.0, slope_pr=none, moment_slope_mpr=none,
            rate_slope_m=none, rate_moment_m2=none,
        )  # fmt: skip  # five more lines otherwise
        none_left = liquids and _emptied(liquids)
        bare = dataclasses.replace(frozen, aerodynamics=air)
        steps = ((bare, none_left), (frozen, none_left), (light, liquids), (stiff, liquids))
        still = dataclasses.replace(self.held, swing_rad=self.held.swing_rad[:0])
        out: list[Node] = [
            dataclasses.replace(self, planar=p, liquids=held, held=self.held if len(p.pendulums.mass_kg) else still)
            for p, held in steps
        ]
        return [*out, self]


def paper_nodes(
    scenario: LoadedScenario, times_s: Iterable[float], plane: Plane = "pitch", errata: Errata = CORRECTED,
    faults: bool = False,
) -> list[PaperNode]:  # fmt: skip  # seven lines otherwise
    """Return nodes as `nodes_along`, with the published model of the same vehicle."""

    def refine(run: FlightRun, node: Node) -> Node:
        row = run.packed.parameters[node.stage]
        since_s = node.time_s - node.stage_start_s
        planar = vehicle_at(run.packed, since_s, node.condition.mach, plane, node.stage, node.trim)
        given = run.loaded.scenario.vehicle.stage[node.stage]
        liquids = _liquids(given, table_clock_s(row, since_s), len(planar.pendulums.mass_kg))
        return PaperNode(**vars_of(node), planar=planar, errata=errata, liquids=liquids)

    found = nodes_along(scenario, times_s, plane, faults, refine)
    return [node for node in found if isinstance(node, PaperNode)]


def vars_of(node: Node) -> dict[str, Any]:
    """Return the fields of a node by name."""
    return {f.name: getattr(node, f.name) for f in dataclasses.fields(Node)}


def _liquids(stage: Stage, clock_s: float, tanks_known: int) -> Liquids | None:
    """Radius and depth of the liquid, if the vehicle's tables give them."""
    tanks = stage.tank[:tanks_known]
    known = all(tank.radius_m is not None and "liquid_height_m" in tank.table for tank in tanks)
    if not known or any(tank.pendulums > 1 for tank in tanks):
        return None
    heights = [float(np.interp(clock_s, tank.table["time_s"], tank.table["liquid_height_m"])) for tank in tanks]
    return Liquids(np.array([tank.radius_m for tank in tanks], float), np.array(heights))


def _frozen(vehicle: PlanarVehicle) -> PlanarVehicle:
    """Bobs fixed to the core."""
    body = dataclasses.replace(
        vehicle.body,
        core_mass_kg=vehicle.body.core_mass_kg + float(vehicle.pendulums.mass_kg.sum()),
        core_cg_station_m=vehicle.total_cg_station_m,
        core_inertia_kgm2=vehicle.total_inertia_kgm2,
    )
    modes = dataclasses.replace(vehicle.modes, phi_hinge=vehicle.modes.phi_hinge[:, :0])
    return dataclasses.replace(vehicle, body=body, pendulums=_emptied(vehicle.pendulums), modes=modes, cuts=None)


def _emptied(record: _Arrays) -> _Arrays:
    """The record of arrays, and of tuples of them, without any entry in them; a count is zero, another record gone."""
    return dataclasses.replace(
        record, **{f.name: _nothing_of(getattr(record, f.name)) for f in dataclasses.fields(record)}
    )


def _nothing_of(value: Any) -> Any:
    if isinstance(value, tuple):
        return tuple(_nothing_of(each) for each in value)
    return 0 if isinstance(value, int) else value[:0] if isinstance(value, np.ndarray) else None
