"""A node with its vehicle put together step by step, for the margin budget."""

from __future__ import annotations

import dataclasses

import numpy as np

from maxq.design.model.node import Node
from maxq.design.model.vehicle_at import Aerodynamics, GimballedEngine, Modes, Pendulums, VehicleAt

STAGES = ("rigid body", "aerodynamics", "slosh", "engine inertia", "bending")


def vehicle_stages(node: Node) -> list[tuple[str, Node]]:
    """Nodes named as STAGES, each with all that the one before has and one thing more; the last is the node itself.

    Without slosh the liquid is frozen where its bobs hang; without aerodynamics the axial force stays, since it sets
    the load under which liquid and engine hang; without engine inertia the gimbal moves a massless engine.
    """
    full = node.vehicle
    stiff = dataclasses.replace(full, modes=_no_modes(full.modes))
    light = dataclasses.replace(stiff, engine=_massless(full.engine))
    frozen = _frozen(light)
    bare = dataclasses.replace(frozen, aerodynamics=_no_lift(full.aerodynamics))
    vehicles = (bare, frozen, light, stiff)
    out = [(name, _with(node, vehicle)) for name, vehicle in zip(STAGES, vehicles, strict=False)]
    return [*out, (STAGES[-1], node)]


def _with(node: Node, vehicle: VehicleAt) -> Node:
    liquids = node.liquids
    if liquids is not None and not len(vehicle.pendulums.mass_kg):
        liquids = dataclasses.replace(
            liquids, **{f.name: getattr(liquids, f.name)[:0] for f in dataclasses.fields(liquids)}
        )
    return dataclasses.replace(node, vehicle=vehicle, liquids=liquids)


def _no_modes(modes: Modes) -> Modes:
    cut = {f.name: getattr(modes, f.name)[:0] for f in dataclasses.fields(modes)}
    return Modes(**(cut | {"softening_kgpm": np.zeros((0, 0))}))


def _massless(engine: GimballedEngine) -> GimballedEngine:
    return dataclasses.replace(engine, gimballed_mass_kg=0.0, inertia_about_gimbal_kgm2=0.0)


def _frozen(vehicle: VehicleAt) -> VehicleAt:
    """Bobs fixed to the core."""
    bobs = vehicle.pendulums
    body = dataclasses.replace(
        vehicle.body,
        core_mass_kg=vehicle.body.core_mass_kg + float(bobs.mass_kg.sum()),
        core_cg_station_m=vehicle.total_cg_station_m,
        core_inertia_kgm2=vehicle.total_inertia_kgm2,
    )
    none = Pendulums(**{f.name: getattr(bobs, f.name)[:0] for f in dataclasses.fields(bobs)})
    modes = dataclasses.replace(vehicle.modes, phi_hinge=vehicle.modes.phi_hinge[:, :0])
    return dataclasses.replace(vehicle, body=body, pendulums=none, modes=modes)


def _no_lift(air: Aerodynamics) -> Aerodynamics:
    return dataclasses.replace(
        air,
        drag=0.0,
        rate_damping=0.0,
        slope_pr=np.zeros_like(air.slope_pr),
        moment_slope_mpr=np.zeros_like(air.moment_slope_mpr),
    )
