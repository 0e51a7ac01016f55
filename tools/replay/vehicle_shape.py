"""The shape of a vehicle, from its TOML file. Stations are in metres aft of the nose.

The file contains length and diameter, the gimbal, the nozzle exit, the tanks with their levels, and the stations of the
forces on nose and fins. Missing dimensions are assumed. The nose is a tangent ogive whose length is consistent with its
centre of pressure. Four trapezoidal fins of usual proportions are placed by the station of their force. Bending is the
sum of mode shapes times modal coordinates, exaggerated.
"""

from __future__ import annotations

import dataclasses
import math
import re
from dataclasses import dataclass

import numpy as np
from scipy.interpolate import make_interp_spline

from maxq.control.kernel.records import Array
from maxq.sim.flight.channels import ChannelTable
from maxq.sim.scenario.schema_booster import Booster
from maxq.sim.scenario.schema_vehicle import Stage, Vehicle
from maxq.sim.vehicle.air.section import AeroSurface
from maxq.sim.vehicle.engine.burn import burn_rate
from maxq.sim.vehicle.loads.section import LoadsSection
from maxq.sim.vehicle.modes.tables import ModeTable
from maxq.tools.replay.decimate import KeptRows, every
from maxq.tools.replay.flight import Channels

PIECES = 16  # straight pieces of the body: enough for the third bending mode
PLANES = ("pitch", "yaw")
SECTION = "section_1_bending_pitch_Nm"  # a channel of every log with section loads
_FACTORS = [step * 10.0**power for power in range(6) for step in (1.0, 2.0, 5.0)]
_LARGEST = 0.35  # largest bending by the automatic factor, as a share of the diameter
_STEEPEST_DEG = 25.0  # largest tilt of a surface by the automatic factor


@dataclass(frozen=True)
class TankShape:
    """A cylindrical tank. `level` contains times on the stage's clock (s) and heights of the liquid above the bottom
    (m).
    """

    name: str
    radius_m: float
    bottom_station_m: float
    top_station_m: float
    level: tuple[Array, Array]


@dataclass(frozen=True)
class Fins:
    """A set of `count` equal trapezoidal fins.

    The stations are those of the leading edge at root and tip; radii are measured from the axis of the body.
    """

    count: int
    root_station_m: float
    root_chord_m: float
    tip_station_m: float
    tip_chord_m: float
    root_radius_m: float
    tip_radius_m: float


@dataclass(frozen=True)
class EngineShape:
    """An engine.

    `channels` is the prefix of the channels of its gimbal angles. `follows` is True for each plane, pitch and yaw, in
    which it moves.
    """

    gimbal_station_m: float
    exit_station_m: float
    exit_radius_m: float
    offset_m: tuple[float, float] = (0.0, 0.0)
    cant_deg: tuple[float, float] = (0.0, 0.0)
    follows: tuple[bool, bool] = (True, True)
    channels: str = "gimbal"


@dataclass(frozen=True)
class LoadStations:
    """The stations at which section loads are known, and the limits of the bending moment there, if they are known."""

    station_m: Array
    limit_Nm: Array | None

    def shares(self, moments_Nm: Array, largest_Nm: float, at_m: Array) -> Array:
        """Return the utilisation of the limit by moments (times, stations) at places `at_m`, as an array (times,
        places).

        Without limits, it is the share of `largest_Nm`.
        """
        of = moments_Nm / (self.limit_Nm if self.limit_Nm is not None else max(largest_Nm, 1e-9))
        return np.array([np.interp(at_m, self.station_m, row) for row in of]).reshape(len(of), len(at_m))


@dataclass(frozen=True)
class BoosterShape:
    """A booster. `profile` (n, 2) contains station and radius from the front to the end; `position_m` is y and z of its
    axis.
    """

    name: str
    profile: Array
    position_m: tuple[float, float]


@dataclass(frozen=True)
class StageShape:
    """The part of the body that is dropped at the end of this stage, and its contents.

    `profile` (n, 2) contains station and radius from the front to the end. `modes` are those of the whole vehicle in
    pitch and yaw while this stage flies, over the stage's clock.
    """

    profile: Array
    tanks: tuple[TankShape, ...]
    fins: Fins | None
    engine: EngineShape | None
    modes: tuple[ModeTable | None, ModeTable | None]
    spatial: tuple[ModeTable, ModeTable] | None  # motion of spatial modes along y and along z
    gyro_station_m: float | None
    clock_factor: float
    sections: LoadStations | None = None
    further_engines: tuple[EngineShape, ...] = ()
    boosters: tuple[BoosterShape, ...] = ()
    keeps_clock: bool = False  # of the preceding stage

    @property
    def nozzles(self) -> list[tuple[str, EngineShape]]:
        """Return the names of the entities of all engines, with the engines."""
        first = [("engine", self.engine)] if self.engine is not None else []
        return first + [(f"engine_{n}", engine) for n, engine in enumerate(self.further_engines, start=2)]

    @property
    def front_m(self) -> float:
        return float(self.profile[0, 0])

    @property
    def end_m(self) -> float:
        return float(self.profile[-1, 0])


@dataclass(frozen=True)
class VehicleShape:
    length_m: float
    diameter_m: float
    stages: tuple[StageShape, ...]

    def joints(self, stage: int) -> Array:
        """Return the stations at which the body that flies in a stage is cut into straight pieces."""
        return np.linspace(0.0, self.stages[stage].end_m, PIECES + 1)


def shape_of(vehicle: Vehicle) -> VehicleShape:
    """Return the shape of a vehicle with any number of stages."""
    length, radius = vehicle.reference.length_m, 0.5 * vehicle.reference.diameter_m
    ends = [_end(stage, length if k == 0 else math.inf) for k, stage in enumerate(vehicle.stage)]
    for k in range(len(ends) - 2, -1, -1):  # a stage ends, at the front, where the next one in flight begins
        ends[k] = max(ends[k], ends[k + 1])
    if math.isinf(ends[-1]):
        ends = [length * (len(ends) - k) / len(ends) for k in range(len(ends))]
    nose = _nose(vehicle.stage[-1], radius, ends[-1])
    stages = []
    for k, stage in enumerate(vehicle.stage):
        front = ends[k + 1] if k + 1 < len(ends) else 0.0
        bending, gyro = stage.bending, stage.gyro
        stages.append(
            StageShape(
                profile=_body(nose, radius, front, ends[k]),
                tanks=tuple(_tank(stage, i, radius) for i in range(len(stage.tank))),
                fins=_fins(stage, radius, ends[k]),
                engine=_engine(stage, 0) if stage.engines else None,
                further_engines=tuple(_engine(stage, n) for n in range(1, len(stage.engines))),
                modes=(bending.pitch_modes, bending.yaw_modes) if bending is not None else (None, None),
                spatial=stage.spatial_modes.modes.lateral() if stage.spatial_modes is not None else None,
                gyro_station_m=gyro.station_m if gyro is not None else None,
                clock_factor=burn_rate(stage),
                sections=_sections(stage.loads),
                boosters=tuple(_booster(booster, radius) for booster in stage.booster),
                keeps_clock=stage.clock == "preceding",
            )
        )
    return VehicleShape(length, 2.0 * radius, tuple(stages))


def _booster(booster: Booster, body_radius: float) -> BoosterShape:
    """Return the shape of a booster that touches the body. Its length is that of a uniform rod with its moment of
    inertia.
    """
    y, z = booster.position_m
    radius = max(math.hypot(y, z) - body_radius, 0.2 * body_radius)
    kg, station_m, _, _, _, lateral, *_ = booster.mass.rows(0.0)[1][0]
    half = 0.5 * math.sqrt(max(12.0 * lateral / kg - 3.0 * radius**2, radius**2))
    ends = [e.gimbal_station_m for e in booster.own_engines]
    front, end = station_m - half, max([station_m + half, *ends])
    nose = front + min(2.0 * radius, 0.4 * (end - front))
    return BoosterShape(
        booster.name, np.array([[front, 0.0], [nose, radius], [end, radius], [end, 0.0]]), booster.position_m
    )


def _sections(loads: LoadsSection | None) -> LoadStations | None:
    return None if loads is None else LoadStations(np.array(loads.stations_m), borne(loads, "bending_moment_Nm"))


def borne(loads: LoadsSection, column: str) -> Array | None:
    """Return a column of the limits at the load stations, the least over time, or None without such limits."""
    table = loads.limits
    if table is None or column not in table:
        return None
    places = np.unique(table["station_m"])
    least = [float(table[column][table["station_m"] == x].min()) for x in places]
    return np.asarray(np.interp(loads.stations_m, places, least))


def _end(stage: Stage, otherwise: float) -> float:
    """Return the station of the end of a stage's skin, slightly aft of the gimbal, so that the engine is visible."""
    ends = [e.gimbal_station_m + 0.1 * max(e.exit_station_m - e.gimbal_station_m, 0.0) for e in stage.engines]
    return max(ends, default=otherwise)


def _surface(stage: Stage, part: str) -> AeroSurface | None:
    surfaces = stage.aero.surface if stage.aero is not None else ()
    return next((s for s in surfaces if part in s.name.lower()), None)


def _nose(stage: Stage, radius: float, end: float) -> Array:
    """Return the stations and radii (n, 2) of a tangent ogive."""
    surface = _surface(stage, "nose")
    length = 1.5 * float(np.median(surface.table["station_m"])) if surface is not None else 5.0 * radius
    length = min(max(length, radius), 0.5 * end)
    if end <= 4.0 * radius:  # not a launcher, but a ball or a brick
        length = min(radius, 0.5 * end)
    rho = (radius * radius + length * length) / (2.0 * radius)
    stations = length * (1.0 - np.cos(np.linspace(0.0, 0.5 * math.pi, 14)))
    radii = np.sqrt(np.maximum(rho * rho - (length - stations) ** 2, 0.0)) + radius - rho
    return np.stack([stations, np.maximum(radii, 0.0)], axis=1)


def _body(nose: Array, radius: float, front: float, end: float) -> Array:
    if front > 0.0:
        return np.array([[front, radius], [end, radius]])
    tail = np.array([[end, radius]])
    if end <= 4.0 * radius:  # a ball, with the nose at both ends
        tail = nose[::-1] * [-1.0, 1.0] + [end, 0.0]
        tail = tail[tail[:, 0] > nose[-1, 0]]
    return np.concatenate([nose, tail])


def _tank(stage: Stage, i: int, body_radius: float) -> TankShape:
    tank = stage.tank[i]
    table = tank.table
    radius = min(tank.radius_m or 0.9 * body_radius, 0.98 * body_radius)
    if tank.shape is not None:
        assert tank.radius_m is not None
        assert tank.density_kgpm3 is not None
        bottom = tank.bottom_station_m or 0.0
        height = tank.radius_m * tank.profile.depth(table["liquid_mass_kg"] / (tank.density_kgpm3 * tank.radius_m**3))
    elif "liquid_height_m" in table and tank.bottom_station_m is not None:
        height, bottom = table["liquid_height_m"], tank.bottom_station_m
    else:  # only the pendulum's hinge is known, which is near the surface
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
    trailing = min(place + 0.62 * root, end)  # the force of swept fins acts aft of the middle of the root chord
    return Fins(4, trailing - root, root, trailing - tip, tip, radius, radius + span)


def _engine(stage: Stage, number: int) -> EngineShape:
    engine, groups = stage.engines[number], stage.engine_groups
    length = max(engine.exit_station_m - engine.gimbal_station_m, 0.1)
    exit_radius = math.sqrt(engine.exit_area_m2 / math.pi) if engine.exit_area_m2 > 0.0 else 0.3 * length
    shape = EngineShape(engine.gimbal_station_m, engine.gimbal_station_m + length, exit_radius)
    if len(stage.engines) == 1:
        return shape
    name = engine.group or str(groups.index(engine.group) + 1) if engine.gimbal != "fixed" else ""
    return dataclasses.replace(
        shape,
        offset_m=engine.offset_m,
        cant_deg=engine.cant_deg,
        follows=(engine.gimbal in ("both", "pitch"), engine.gimbal in ("both", "yaw")),
        channels=f"gimbal_group_{name}" if len(groups) > 1 and name else "gimbal",
    )


# -- bending and slosh ---------------------------------------------------------------------------------------------
def modal_coordinates(channels: Channels, plane: str, at: KeptRows | slice = slice(None)) -> Array:
    """Return the modal displacements (n, modes) of a plane, with zeros for the modes that a stage does not have."""
    names = [name for name in channels.table.names if name.startswith(f"eta_{plane}_") and name.endswith("_m")]
    if not names:
        return np.zeros((0, 0))
    return np.nan_to_num(np.stack([channels[name][at] for name in names], axis=1))


def shapes_at(table: ModeTable, clock_s: Array, stations_m: Array, column: str = "phi") -> Array:
    """Return mode shapes (n, modes, stations) at stage times (n,) and stations, linear between the rows of the table.

    `column` is "phi" for the shapes or "slope_pm" for their slopes.
    """
    values: Array = getattr(table, column)
    at = np.clip(stations_m, table.station_m[0], table.station_m[-1])
    along = make_interp_spline(table.station_m, values, k=1, axis=2)(at)
    if len(table.time_s) == 1:
        return np.broadcast_to(along[0], (len(clock_s), *along.shape[1:]))
    now = np.clip(clock_s, table.time_s[0], table.time_s[-1])
    return np.asarray(make_interp_spline(table.time_s, along, k=1, axis=0)(now))


def bent_line(
    stage: StageShape,
    clock_s: Array,
    pitch: Array,
    yaw: Array,
    stations_m: Array,
    column: str = "phi",
    spatial: Array | None = None,
) -> Array:
    """Return the displacement (n, stations, 2) of the axis along body y and z, without exaggeration.

    `pitch`, `yaw` and `spatial` are the modal coordinates (n, modes) of each kind of mode. With `column` "slope_pm",
    the result is the slope of the axis.
    """
    out = np.zeros((len(clock_s), len(stations_m), 2))
    moves = [(0, stage.modes[1], yaw), (1, stage.modes[0], pitch)]
    if stage.spatial is not None and spatial is not None:
        moves += [(axis, table, spatial) for axis, table in enumerate(stage.spatial)]
    for axis, table, eta in moves:
        if table is not None and eta.shape[1:] and eta.shape[1] >= table.modes:
            shapes = shapes_at(table, clock_s, stations_m, column)
            out[:, :, axis] += np.einsum("nm,nms->ns", eta[:, : table.modes], shapes)
    return out


def nice_factor(largest_m: float, wanted_m: float) -> float:
    """Return the largest of 1, 2, 5, 10, 20, ... whose product with `largest_m` is at most `wanted_m`, or 1 without
    bending.
    """
    if not 0.0 < largest_m < wanted_m:
        return 1.0
    return max(x for x in _FACTORS if x <= wanted_m / largest_m * (1.0 + 1e-12))


@dataclass(frozen=True)
class Exaggeration:
    """The factors by which bending and slosh angles are exaggerated, and the largest bending that is drawn, m."""

    bending: float
    slosh: float
    most_m: float

    def text(self, table: ChannelTable) -> str:
        """Return the factors that apply to the vehicle, in a few words."""
        factors = (("eta_", "bending", self.bending), ("slosh_", "slosh", self.slosh))
        has = [f"{what} x{x:g}" for start, what, x in factors if any(name.startswith(start) for name in table.names)]
        return ", ".join([*has, *(["skin: bending moment"] if SECTION in table.names else [])])


def exaggeration_of(
    channels: Channels, shape: VehicleShape | None, bending: float | None = None, slosh: float | None = None
) -> Exaggeration:
    """Return the requested factors, or factors that make the largest deflection and tilt of the flight visible."""
    diameter = shape.diameter_m if shape is not None else 1.0
    if bending is None:
        bending = nice_factor(_largest_bending_m(channels, shape), _LARGEST * diameter)
    if slosh is None:
        slosh = min(nice_factor(_largest_slosh_deg(channels), _STEEPEST_DEG), 10.0)
    return Exaggeration(bending, slosh, 1.5 * diameter)


def _largest_bending_m(channels: Channels, shape: VehicleShape | None) -> float:
    """Return the largest bending of the first stage's vehicle over its joints, from samples at 100 Hz."""
    name = next((name for name in channels.table.names if name.startswith("eta_")), None)
    if shape is None or name is None:
        return 0.0
    ns = channels.time_ns(name)
    k = every(ns, 10_000_000)
    stage = shape.stages[0]
    pitch, yaw, spatial = (modal_coordinates(channels, kind, k) for kind in (*PLANES, "spatial"))
    bent = bent_line(stage, ns[k] / 1e9 * stage.clock_factor, pitch, yaw, shape.joints(0)[::3], spatial=spatial)
    return float(np.abs(bent).max(initial=0.0))


def _largest_slosh_deg(channels: Channels) -> float:
    """Return the largest pendulum angle until the end of thrust. Without thrust, a pendulum has no equilibrium."""
    end_ns = np.iinfo(np.int64).max
    if "thrust_N" in channels and (burning := channels["thrust_N"] > 0.0).any():
        end_ns = int(channels.time_ns("thrust_N")[burning][-1])
    angles = re.compile(r"slosh_.*_(pitch|yaw)_deg")
    names = [name for name in channels.table.names if angles.fullmatch(name)]
    powered = [np.abs(channels[name][channels.time_ns(name) <= end_ns]) for name in names]
    return max((float(np.nanmax(values, initial=0.0)) for values in powered), default=0.0)
