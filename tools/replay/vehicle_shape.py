"""What a vehicle looks like, from its TOML. Stations are metres aft of the nose.

Length and diameter, the gimbal, the nozzle's exit, the tanks with their levels and the places of nose and fins stand in
the file. What it does not say is filled in: a tangent ogive whose length puts the nose's centre of pressure where the
file has it, and four trapezoidal fins of customary proportions about the station where the fins' force acts.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from maxq.control.kernel.records import Array
from maxq.sim.scenario.modes import ModeTable
from maxq.sim.scenario.schema_aero import AeroSurface
from maxq.sim.scenario.schema_vehicle import Stage, Vehicle

PIECES = 16  # of the body, each straight: enough for the third bending mode


@dataclass(frozen=True)
class TankShape:
    """A cylindrical tank; `level` (times on the stage clock, heights) of the liquid above the bottom."""

    name: str
    radius_m: float
    bottom_station_m: float
    top_station_m: float
    level: tuple[Array, Array]


@dataclass(frozen=True)
class Fins:
    """`count` equal trapezoids: stations of the leading edge at root and tip, chords, and radii of root and tip."""

    count: int
    root_station_m: float
    root_chord_m: float
    tip_station_m: float
    tip_chord_m: float
    root_radius_m: float
    tip_radius_m: float


@dataclass(frozen=True)
class EngineShape:
    gimbal_station_m: float
    exit_station_m: float
    exit_radius_m: float


@dataclass(frozen=True)
class StageShape:
    """The part of the body that is dropped at the end of this stage, and what it holds.

    `profile` lists (station, radius) from the front to the end. `modes`: pitch and yaw, on the stage clock, of the
    whole vehicle while this stage flies.
    """

    name: str
    profile: tuple[tuple[float, float], ...]
    tanks: tuple[TankShape, ...]
    fins: Fins | None
    engine: EngineShape | None
    modes: tuple[ModeTable | None, ModeTable | None]
    gyro_station_m: float | None
    clock_factor: float

    @property
    def front_m(self) -> float:
        return self.profile[0][0]

    @property
    def end_m(self) -> float:
        return self.profile[-1][0]


@dataclass(frozen=True)
class VehicleShape:
    length_m: float
    diameter_m: float
    stages: tuple[StageShape, ...]

    def joints(self, stage: int) -> Array:
        """Stations at which the body that flies in a stage is cut into straight pieces."""
        start, end = 0.0, self.stages[stage].end_m
        return np.linspace(start, end, PIECES + 1)


def shape_of(vehicle: Vehicle) -> VehicleShape:
    """The shape of a vehicle of any number of stages."""
    length, radius = vehicle.reference.length_m, 0.5 * vehicle.reference.diameter_m
    ends = [_end(stage, length if k == 0 else math.inf) for k, stage in enumerate(vehicle.stage)]
    for k in range(len(ends) - 2, -1, -1):  # a stage ends behind the one before it in flight begins
        ends[k] = max(ends[k], ends[k + 1])
    if math.isinf(ends[-1]):
        ends = [length * (len(ends) - k) / len(ends) for k in range(len(ends))]
    nose = _nose(vehicle.stage[-1], radius, ends[-1])
    stages = []
    for k, stage in enumerate(vehicle.stage):
        front = ends[k + 1] if k + 1 < len(ends) else 0.0
        profile = _body(nose, radius, front, ends[k])
        stages.append(
            StageShape(
                name=stage.name or str(k + 1),
                profile=profile,
                tanks=tuple(_tank(stage, i, radius) for i in range(len(stage.tank))),
                fins=_fins(stage, radius, ends[k]),
                engine=_engine(stage),
                modes=(
                    (stage.bending.pitch_modes, stage.bending.yaw_modes) if stage.bending is not None else (None, None)
                ),
                gyro_station_m=stage.gyro.station_m if stage.gyro is not None else None,
                clock_factor=stage.engine.mass_flow_factor if stage.engine is not None else 1.0,
            )
        )
    return VehicleShape(length, 2.0 * radius, tuple(stages))


def _end(stage: Stage, otherwise: float) -> float:
    """Where the skin of a stage ends: a little behind the gimbal, so that the engine is seen."""
    if stage.engine is None:
        return otherwise
    gimbal, exit_ = stage.engine.gimbal_station_m, stage.engine.exit_station_m
    return gimbal + 0.1 * max(exit_ - gimbal, 0.0)


def _surface(stage: Stage, part: str) -> AeroSurface | None:
    surfaces = stage.aero.surface if stage.aero is not None else ()
    return next((s for s in surfaces if part in s.name.lower()), None)


def _nose(stage: Stage, radius: float, end: float) -> tuple[tuple[float, float], ...]:
    surface = _surface(stage, "nose")
    length = 1.5 * float(np.median(surface.table["station_m"])) if surface is not None else 5.0 * radius
    length = min(max(length, radius), 0.5 * end)
    if end <= 4.0 * radius:  # no rocket: a ball or a brick
        length = min(radius, 0.5 * end)
    rho = (radius * radius + length * length) / (2.0 * radius)
    stations = length * (1.0 - np.cos(np.linspace(0.0, 0.5 * math.pi, 14)))
    radii = np.sqrt(np.maximum(rho * rho - (length - stations) ** 2, 0.0)) + radius - rho
    return tuple((float(s), max(float(r), 0.0)) for s, r in zip(stations, radii, strict=True))


def _body(
    nose: tuple[tuple[float, float], ...], radius: float, front: float, end: float
) -> tuple[tuple[float, float], ...]:
    if front > 0.0:
        return ((front, radius), (end, radius))
    if end <= 4.0 * radius:  # the ball: the nose at both ends
        tail = tuple((end - s, r) for s, r in reversed(nose))
        return (*nose, *(point for point in tail if point[0] > nose[-1][0]))
    return (*nose, (end, radius))


def _tank(stage: Stage, i: int, body_radius: float) -> TankShape:
    tank = stage.tank[i]
    table = tank.table
    radius = min(tank.radius_m or 0.9 * body_radius, 0.98 * body_radius)
    if "liquid_height_m" in table and tank.bottom_station_m is not None:
        height, bottom = table["liquid_height_m"], tank.bottom_station_m
    else:  # what is known is where the pendulum hangs, which is near the surface
        bottom = float((table["hinge_station_m"] + table["pendulum_length_m"]).max()) + radius
        height = bottom - table["hinge_station_m"]
    top = bottom - (float(height.max()) + 0.15 * body_radius)
    return TankShape(tank.name or str(i + 1), radius, bottom, max(top, 0.0), (table["time_s"], height))


def _fins(stage: Stage, radius: float, end: float) -> Fins | None:
    surface = _surface(stage, "fin")
    if surface is None:
        return None
    diameter = 2.0 * radius
    root, tip, span = 1.8 * diameter, 0.8 * diameter, 1.45 * diameter
    place = float(np.median(surface.table["station_m"]))
    trailing = min(place + 0.62 * root, end)  # the force of swept fins acts behind the middle of the root chord
    return Fins(4, trailing - root, root, trailing - tip, tip, radius, radius + span)


def _engine(stage: Stage) -> EngineShape | None:
    engine = stage.engine
    if engine is None:
        return None
    length = max(engine.exit_station_m - engine.gimbal_station_m, 0.1)
    exit_radius = math.sqrt(engine.exit_area_m2 / math.pi) if engine.exit_area_m2 > 0.0 else 0.3 * length
    return EngineShape(engine.gimbal_station_m, engine.gimbal_station_m + length, exit_radius)
