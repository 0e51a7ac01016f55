"""The records of a scenario's rail, tower and navigation errors."""

from __future__ import annotations

import math

import numpy as np

from maxq.control.kernel.records import Array, pack
from maxq.sim.flight.launch import Launch
from maxq.sim.flight.navigation import Navigation
from maxq.sim.packing.environment import pack_earth
from maxq.sim.packing.initial import earth_rotation, product, site_axes
from maxq.sim.scenario.schema_scenario import Scenario
from maxq.sim.scenario.schema_vehicle import Stage


def pack_navigation(scenario: Scenario) -> Navigation:
    """Return the navigation errors at the start: position and velocity in I, attitude in B."""
    given, earth = scenario.navigation, pack([pack_earth(scenario.earth)])[0]
    if given is None:
        return Navigation(0, np.zeros(3), np.zeros(3), np.zeros(3))
    cos, sin = earth_rotation(earth, scenario.run.start_s)
    to_inertial = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
    axes = product(to_inertial, site_axes(scenario.initial, scenario.site, earth).T)
    position_m, velocity_mps = (
        product(axes, np.array(error)) for error in (given.position_error_m, given.velocity_error_mps)
    )
    return Navigation(1, position_m, velocity_mps, np.radians(given.alignment_error_deg))


def pack_launch(scenario: Scenario, stage: Stage) -> Launch:
    """Return the rail and the tower, in E, with the tail station of a stage."""
    rail, tower = scenario.rail, scenario.tower
    to_tower: Array = np.zeros(3)
    up: Array = np.zeros(3)
    height_m, radii_m = 0.0, 0.0
    if tower is not None:
        north, east, down = site_axes(scenario.initial, scenario.site, pack([pack_earth(scenario.earth)])[0])
        azimuth = math.radians(tower.azimuth_deg)
        to_tower, up = tower.distance_m * (math.cos(azimuth) * north + math.sin(azimuth) * east), -down
        height_m = tower.height_m
        radii_m = tower.radius_m + tower.vehicle_radius(scenario.vehicle.reference.diameter_m)
    tail_m = max((engine.exit_station_m for engine in stage.engines), default=scenario.vehicle.reference.length_m)
    return Launch(0.0 if rail is None else rail.length_m, height_m, to_tower, up, radii_m, tail_m)
