"""Changing what swings in a vehicle without changing the vehicle that does not."""

from __future__ import annotations

import dataclasses

from maxq.design.model.vehicle_at import Pendulums, VehicleAt


def with_pendulums(vehicle: VehicleAt, pendulums: Pendulums) -> VehicleAt:
    """The vehicle with other pendulums and the same mass, CG and inertia of the whole, liquid frozen.

    What the bobs take on, the core gives. Raises ValueError where no core is left.
    """
    old, body = vehicle.pendulums, vehicle.body
    total = body.core_mass_kg + float(old.mass_kg.sum())
    centre, inertia = vehicle.total_cg_station_m, vehicle.total_inertia_kgm2
    mass = total - float(pendulums.mass_kg.sum())
    if mass <= 0.0:
        raise ValueError(f"sloshing masses of {float(pendulums.mass_kg.sum()):g} kg in a vehicle of {total:g} kg")
    station = (total * centre - float(pendulums.mass_kg @ pendulums.bob_station_m)) / mass
    bobs = float(pendulums.mass_kg @ (pendulums.bob_station_m - centre) ** 2)
    core = inertia - bobs - mass * (station - centre) ** 2
    if core <= 0.0:
        raise ValueError(f"bobs of {bobs:g} kg m2 in a vehicle of {inertia:g} kg m2")
    changed = dataclasses.replace(body, core_mass_kg=mass, core_cg_station_m=station, core_inertia_kgm2=core)
    return dataclasses.replace(vehicle, body=changed, pendulums=pendulums)
