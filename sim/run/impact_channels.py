"""The impact points of a flight or its log: channels over time, and the points of dropped bodies."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Annotated, NamedTuple

import numpy as np

from maxq.control.kernel.records import Array
from maxq.sim.flight.channels import ChannelTable, Topic, declared_channels
from maxq.sim.flight.parameters import EVENT_NAMES, SEPARATION
from maxq.sim.flight.telemetry import SLOW
from maxq.sim.log.reader import Log
from maxq.sim.log.tabular import Tabular
from maxq.sim.packing.environment import pack_earth
from maxq.sim.packing.flight import pack_flight
from maxq.sim.run.flight import Flight
from maxq.sim.run.impact import AirColumn, Impacts, air_column, falling_impacts, has_impacts, vacuum_impacts
from maxq.sim.run.record import scenario_in
from maxq.sim.scenario.loader import LoadedScenario
from maxq.sim.scenario.schema_vehicle import Stage
from maxq.sim.world.earth import Earth

_DRAG_PERIOD_s = 1.0
_NAMES = [f"r_I_{axis}_m" for axis in "xyz"], [f"v_I_{axis}_mps" for axis in "xyz"]
VACUUM_TOPIC, DRAG_TOPIC = "/impact", "/impact_drag"


class ImpactRow(NamedTuple):
    """The instantaneous impact point on a Kepler ellipse."""

    impact_latitude_deg: Annotated[float, "deg", "geodetic latitude of the vacuum impact point; nan: none"]
    impact_longitude_deg: Annotated[float, "deg", "longitude of the vacuum impact point, east positive"]
    impact_fall_s: Annotated[float, "s", "time to the vacuum impact"]


class DragImpactRow(NamedTuple):
    """The instantaneous impact point with drag."""

    impact_drag_latitude_deg: Annotated[float, "deg", "geodetic latitude of the impact point with drag; nan: none"]
    impact_drag_longitude_deg: Annotated[float, "deg", "longitude of the impact point with drag, east positive"]
    impact_drag_fall_s: Annotated[float, "s", "time to the impact with drag"]


@dataclass(frozen=True)
class DroppedBody:
    """A body that a vehicle drops, and its state (3,) in I immediately before the separation.

    `number` is the number of the separation, from 1. Without a ballistic coefficient, the body falls in vacuum. The
    impulse of the separation is neglected.
    """

    number: int
    name: str
    time_s: float
    r_I_m: Array
    v_I_mps: Array
    ballistic_kgpm2: float | None


@dataclass(frozen=True)
class DropPoint:
    """The impact point of a dropped body: geodetic latitude, longitude, and time of the fall; nan: no impact."""

    body: DroppedBody
    latitude_deg: float
    longitude_deg: float
    fall_s: float


class WithImpacts(Tabular):
    """A flight or its log with the channels of its instantaneous impact points.

    The vacuum impact point has the times of slow rows. With `ballistic_kgpm2`, m / (C_D A), the impact point with drag
    has about one row per second. The ground is defined as for the event `impact`. On an Earth that is flat or without
    central gravitation, there are no impact channels. Raises LogError for a log without a scenario.
    """

    def __init__(self, source: Flight | Log, ballistic_kgpm2: float | None = None) -> None:
        self.source, self.ballistic_kgpm2 = source, ballistic_kgpm2
        self.loaded: LoadedScenario = source.scenario if isinstance(source, Flight) else scenario_in(source)
        scenario = self.loaded.scenario
        self.earth, self.ground_m = pack_earth(scenario.earth), min(scenario.site.altitude_m, 0.0)
        vacuum = Topic(VACUUM_TOPIC, SLOW, declared_channels(ImpactRow), "instantaneous impact point in vacuum")
        drag = Topic(DRAG_TOPIC, "impact", declared_channels(DragImpactRow), "instantaneous impact point with drag")
        topics = (vacuum, *([drag] if ballistic_kgpm2 is not None else ())) if has_impacts(self.earth) else ()
        self.table = ChannelTable((*source.table.topics, *topics))

    def __getitem__(self, channel: str) -> Array:
        if channel in ImpactRow._fields and channel in self.table:
            return _column(self._vacuum, ImpactRow._fields.index(channel))
        if channel in DragImpactRow._fields and channel in self.table:
            return _column(self._drag[1], DragImpactRow._fields.index(channel))
        if channel not in self.source.table:
            raise self._unknown(channel)
        return self.source[channel]

    def time_s(self, channel: str) -> Array:
        if channel in ImpactRow._fields:
            return self.source.time_s(_NAMES[0][0])
        return self._drag[0] if channel in DragImpactRow._fields else self.source.time_s(channel)

    @cached_property
    def states(self) -> tuple[Array, Array, Array]:
        """Return the times (n,), positions and velocities (n, 3) in I of the slow rows."""
        r, v = (np.stack([self.source[name] for name in names], axis=1) for names in _NAMES)
        return self.source.time_s(_NAMES[0][0]), r, v

    @cached_property
    def _vacuum(self) -> Impacts:
        return vacuum_impacts(self.earth, *self.states, self.ground_m)

    @cached_property
    def _drag(self) -> tuple[Array, Impacts]:
        assert self.ballistic_kgpm2 is not None
        times, r, v = self.states
        k = np.flatnonzero(np.diff(np.floor(times / _DRAG_PERIOD_s), prepend=-1.0))
        return times[k], falling_impacts(
            self.earth, self._air, self.ballistic_kgpm2, times[k], r[k], v[k], self.ground_m
        )

    @cached_property
    def _air(self) -> AirColumn:
        return air_column(pack_flight(self.loaded.scenario), self.ground_m)

    def drop_points(self) -> list[DropPoint]:
        """Return the impact points of all dropped bodies, in order of their separations."""
        if not has_impacts(self.earth):
            return []
        air = self._air if any(body.ballistic_kgpm2 is not None for body in self.dropped()) else None
        return [drop_point(self.earth, body, air, self.ground_m) for body in self.dropped()]

    def dropped(self) -> list[DroppedBody]:
        """Return the bodies dropped in this flight, with states advanced from the last slow row before the separation.

        The acceleration of this row applies until the separation.
        """
        times, r, v = self.states
        stages = self.loaded.scenario.vehicle.stage
        at_s = [
            event.time_ns / 1e9
            for event in self.source.events
            if (event.text.partition(":")[0].partition(" ")[0] == EVENT_NAMES[SEPARATION])
        ]
        found = []
        for index, time_s in enumerate(at_s):
            k = int(np.searchsorted(times, time_s)) - 1
            if k < 0:
                continue
            dt, a = time_s - times[k], self._acceleration(k)
            place, speed = r[k] + dt * v[k] + 0.5 * dt * dt * a, v[k] + dt * a
            found.append(dropped_body(stages, index, time_s, place, speed))
        return found

    def _acceleration(self, k: int) -> Array:
        """Return the acceleration (3,) in I of slow row `k`."""
        w, x, y, z = (self.source[f"q_BI_{part}"][k] for part in "wxyz")
        force = np.array([self.source[f"specific_force_B_{axis}_mps2"][k] for axis in "xyz"])
        turned = 2.0 * np.cross([x, y, z], force)
        own = force + w * turned + np.cross([x, y, z], turned)
        return np.asarray(own + [self.source[f"gravitation_I_{axis}_mps2"][k] for axis in "xyz"])


def dropped_body(stages: tuple[Stage, ...], index: int, time_s: float, r_I_m: Array, v_I_mps: Array) -> DroppedBody:
    """Return the body that the separation at the end of stage `index` (from 0) drops."""
    stage, following = stages[index], stages[index + 1]
    boosters = ", ".join(booster.name for booster in stage.leaving(following))
    name = boosters or ("fairing" if following.continues else stage.name or f"stage {index + 1}")
    ballistic = stage.separation.ballistic_kgpm2 if stage.separation is not None else None
    return DroppedBody(index + 1, name, time_s, r_I_m, v_I_mps, ballistic)


def drop_point(earth: Earth, body: DroppedBody, air: AirColumn | None, ground_m: float) -> DropPoint:
    """Return the impact point of a dropped body; `air` is needed if it has a ballistic coefficient."""
    state = np.array([body.time_s]), body.r_I_m[None, :], body.v_I_mps[None, :]
    if body.ballistic_kgpm2 is None or air is None:
        found = vacuum_impacts(earth, *state, ground_m)
    else:
        found = falling_impacts(earth, air, body.ballistic_kgpm2, *state, ground_m)
    return DropPoint(body, float(found.latitude_deg[0]), float(found.longitude_deg[0]), float(found.fall_s[0]))


def _column(impacts: Impacts, index: int) -> Array:
    return (impacts.latitude_deg, impacts.longitude_deg, impacts.fall_s)[index]
