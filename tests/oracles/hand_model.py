"""Build the published planar equations for an operating point: an independent derivation of its linear model."""

from __future__ import annotations

import dataclasses

from oracles.planar.vehicle_at import PlanarVehicle, vehicle_at

from maxq import Node
from maxq.control.kernel.records import blank
from maxq.sim.flight.parameters import Memory
from maxq.sim.packing.flight import Packed


def planar_of(node: Node) -> PlanarVehicle:
    """Return the vehicle of an operating point's tables in its plane, without deviations; all actuators are alike."""
    held = node.held
    packed = Packed(held.parameters, held.pool, blank(Memory), node.held.properties[0], held.sizes)
    planar = vehicle_at(packed, 0.0, node.condition.mach, node.plane, 0, node.trim)
    bobs = dataclasses.replace(planar.pendulums, swing_rad=held.swing_rad)
    return dataclasses.replace(planar, pendulums=bobs)
