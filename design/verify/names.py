"""Names of stages, tanks and operating points in texts."""

from __future__ import annotations

from maxq.design.model.node import Node
from maxq.sim.scenario.schema_vehicle import Vehicle


def stage_name(vehicle: Vehicle, stage: int) -> str:
    """Return the name of a stage for texts, or "" for a single stage."""
    if len(vehicle.stage) == 1:
        return ""
    name = vehicle.stage[stage].name
    return f"stage {stage + 1}" + (f" ({name})" if name and name != str(stage + 1) else "")


def tank_name(vehicle: Vehicle, stage: int, tank: int) -> str:
    """Return the name of a slosh mode for texts, with its stage if there are several."""
    name = vehicle.stage[stage].pendulum_names[tank]
    return name if len(vehicle.stage) == 1 else f"{name}, stage {stage + 1}"


def node_name(node: Node) -> str:
    """Return an operating point as text: time and plane."""
    return f"{node.time_s:g} s, {node.plane}"
