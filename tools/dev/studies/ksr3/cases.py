"""The sampled plants of the loop check: eleven nodes, bending frequencies as they are and 10 % off."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from maxq.control.kernel.records import Array
from maxq.tools.dev.studies.ksr3 import linear_model, sampled_loop
from maxq.tools.dev.studies.ksr3.assumptions import NODES_S
from maxq.tools.dev.studies.ksr3.margins import Response
from maxq.tools.dev.studies.ksr3.sampled_loop import Discrete
from maxq.tools.dev.studies.ksr3.vehicle_at import Snapshot, VehicleFolder, snapshot

BENDING_FACTORS = (1.0, 0.9, 1.1)


@dataclass(frozen=True)
class Case:
    """One plant with its frequency response on a grid of its own."""

    time_s: float
    bending_factor: float
    snapshot: Snapshot
    plant: Discrete
    frequency_hz: Array
    response: Response
    unstable_poles: int
    period_s: float


def make_case(vehicle: VehicleFolder, t: float, bending_factor: float) -> Case:
    s = snapshot(vehicle, t)
    bending = replace(s.bending, omega_radps=s.bending.omega_radps * bending_factor)
    s = replace(s, bending=bending)
    stage, computer = vehicle.stage, vehicle.description["computer"]
    actuator = linear_model.actuator(stage["actuator"]["omega_hz"], stage["actuator"]["zeta"])
    gyro = linear_model.gyro(stage["gyro"]["omega_hz"], stage["gyro"]["zeta"])
    period = computer["sample_s"]
    plant = sampled_loop.sampled_plant(linear_model.plant(s, actuator, gyro), period, computer["delay_s"])
    grid = sampled_loop.frequency_grid(plant, period)
    unstable = int((np.abs(sampled_loop.plant_poles(plant)) > 1).sum())
    return Case(t, bending_factor, s, plant, grid, sampled_loop.response(plant, grid, period), unstable, period)


def all_cases(folder: Path, times_s: tuple[float, ...] = NODES_S) -> list[Case]:
    vehicle = VehicleFolder(folder)
    return [make_case(vehicle, t, factor) for factor in BENDING_FACTORS for t in times_s]
