"""An operating point of a flight: vehicle, air and instruments at one instant, in one plane."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from maxq.control.kernel.records import Array
from maxq.control.structures import Over
from maxq.design.model.dispersion import NOMINAL, Dispersion, deviated, disperse_instruments, unlike_drives
from maxq.design.model.held import Drives, FlightCondition, HeldStage, Trim, hold_stage, table_clock_s
from maxq.design.model.instruments import Plane, allocation_at, instruments_of
from maxq.design.model.operating_point import BUILD_UP, OperatingPoint
from maxq.design.model.powered import flown_run, flown_to, powered_spans
from maxq.design.model.state_space import StateSpace
from maxq.design.model.vehicle_at import (
    StabilityDerivatives,
    VehicleAt,
    axial_load_mps2,
    stability_derivatives,
    vehicle_at,
    with_frozen_liquid,
    without_bending,
    without_engine_inertia,
    without_lateral_air,
)
from maxq.sim.flight.parameters import NEVER
from maxq.sim.flight.telemetry import FAST
from maxq.sim.input.ranges import LONGEST_S
from maxq.sim.packing.flight import Packed, pack_flight
from maxq.sim.packing.initial import rotation
from maxq.sim.run.evaluate import evaluate_at
from maxq.sim.run.flight import GrowingRows
from maxq.sim.run.fly import FlightRun
from maxq.sim.scenario.loader import LoadedScenario
from maxq.sim.scenario.schema_scenario import LogSection, Scenario
from maxq.sim.scenario.schema_vehicle import Stage
from maxq.sim.vehicle.engine.burn import stage_burns, table_time_s, when_spent_s
from maxq.sim.vehicle.slosh.kernel import RING_DRAG
from maxq.sim.vehicle.state import Q_BI, R_I, V_I
from maxq.sim.world.earth import ground_velocity


@dataclass(frozen=True, kw_only=True)
class Node(OperatingPoint):
    """An operating point of a flight: vehicle, air and instruments of one plane at a vehicle time."""

    held: HeldStage
    allocation: tuple[tuple[float, float], ...] = (
        (1.0, 0.0),
    )  # angles of each engine group per command, in the plane and in the other
    surface_radius_m: tuple[float, ...] = ()  # liquid surface in the tank of each pendulum; nan if unknown
    stage_start_s: float = 0.0  # start of the stage's clock on the vehicle clock, plus the coasts before restarts
    trim: Trim = (
        0.0,
        0.0,
    )  # angles of attack and sideslip (rad) at which tables over angle of attack are differentiated

    def plant_in_wind(self, wind: bool = True) -> StateSpace:
        """Return the linear model of the plane, from actuator motion and wind to rates and measurements.

        The model is the Jacobian of the simulator's derivative (held.py). `plant` is the same model without wind. The
        states are w (m/s, at the body point of the core's CG), q (rad/s), theta (rad), eta (m) and eta' (m/s), spatial
        modes first. Slosh angles (rad) and rates follow, then angle and rate of each engine on a TVC load. The other
        plane, roll and the axial speed are held.

        The inputs are, for each drive, the actuator angle and the derivatives of it that act on engines. The last input
        is the lateral velocity of the air in the plane, m/s. The outputs are `held.OUTPUTS`, the measurements of
        further sensors, and the bending moment (N m) at each station of active section loads. The yaw plane has the
        states and signs of the pitch plane rotated about x.

        Raises ValueError, with the operating point, if no such system exists.
        """
        self.check_axial_load()
        *parts, names = self.held.plants(
            self.condition, self.trim, self.plane, self.drives, wind=wind, moments=bool(self.vehicle.cut_stations_m)
        )
        a, b, c, d = (part[0] for part in parts)
        return StateSpace(a, b, c, d, *names)

    def check_axial_load(self) -> None:
        """Raise ValueError, with the operating point, if a vehicle with pendulums has no positive axial load."""
        if self.vehicle.pendulums.mass_kg.any() and self.axial_load_mps2 <= 0.0:
            problem = f"a pendulum needs a positive axial load, not {self.axial_load_mps2:g} m/s2"
            raise ValueError(f"operating point at {self.time_s:g} s: {problem}")

    @property
    def drives(self) -> Drives:
        """Return the actuators that the law's command moves, for each drive of the instruments."""
        own = 0 if self.plane == "pitch" else 1
        return [
            [
                (2 * group + axis, gain)
                for group in groups
                for axis, gain in zip((own, 1 - own), self.allocation[group], strict=True)
                if axis == own or gain != 0.0
            ]
            for groups in self.instruments.groups
        ]

    @cached_property
    def vehicle(self) -> VehicleAt:
        """Return the masses, modes and pendulums in the plane."""
        return vehicle_at(self.held, self.plane)

    @cached_property
    def axial_load_mps2(self) -> float:
        """Return the axial specific force of the whole vehicle, (thrust - drag) / mass."""
        return axial_load_mps2(self.held, self.condition, self.trim)

    @cached_property
    def derivatives(self) -> StabilityDerivatives:
        """Return the derivatives of the rigid vehicle with frozen liquid. Raises ValueError for zero airspeed."""
        return stability_derivatives(self.held, self.condition, self.trim, self.plane, self.drives)

    @property
    def omega_radps(self) -> Array:
        return self.vehicle.omega_radps

    @property
    def cut_stations_m(self) -> tuple[float, ...]:
        return self.vehicle.cut_stations_m

    @property
    def gains(self) -> tuple[float, ...]:
        """Return the largest angle of an engine group per command of the law, for each drive."""
        moved = self.held.groups_that_follow(self.plane)
        return tuple(
            max((abs(self.allocation[group][0]) for group in groups if group in moved), default=0.0)
            for groups in self.instruments.groups
        )

    @property
    def angle_limit_rad(self) -> float:
        """Return the command at which the first actuator reaches its angle limit, or infinity for ideal actuators."""
        limits = zip(self.actuators, self.gains, strict=True)
        return min((a.angle_limit_rad / gain for a, gain in limits if gain > 0.0 and not a.ideal), default=math.inf)

    def scheduled(self, over: Over) -> float:
        return self.vehicle.total_mass_kg if over == "mass_kg" else super().scheduled(over)

    def steps(self) -> list[tuple[str, OperatingPoint]]:
        """Return the build-up of the vehicle: rigid body, aerodynamics, slosh, engine inertia, bending.

        Without slosh, the liquid is frozen at its bobs. Without aerodynamics, the axial force remains, since it
        determines the axial load on liquid and engine. Without engine inertia, the gimbal moves a massless engine.
        """
        stiff = without_bending(self.held)
        light = without_engine_inertia(stiff)
        frozen = with_frozen_liquid(light)
        bare = without_lateral_air(frozen)
        built = [*(dataclasses.replace(self, held=held) for held in (bare, frozen, light, stiff)), self]
        return list(zip(BUILD_UP, built, strict=True))

    def with_(self, **deviations: Any) -> Node:
        """Return the operating point with deviations, given as fields of `dispersion.Dispersion`."""
        return disperse(self, Dispersion(**deviations))


def nodes_along(
    scenario: LoadedScenario,
    times_s: Iterable[float],
    plane: Plane = "pitch",
    faults: bool = False,
    refine: Callable[[FlightRun, Node], Node] = lambda run, node: node,
) -> list[Node]:
    """Return operating points at vehicle times (s) of one flight of the scenario, in the order of `times_s`.

    Speed, air and attitude are those flown, at the integrator's step nearest to each time. Angle of attack and rotation
    are zero, with two exceptions. A vehicle with tables over angle of attack has the flown angles, and the damping of
    ring baffles is that of the flown swing (`with_swings`). Failures of the scenario are included only if `faults` is
    True. `refine` may change each operating point while the flight is at its time. Raises ValueError, with the
    operating point and the allowed range, for a time outside the powered flight.
    """
    wanted = [float(t) for t in times_s]
    if not wanted:
        return []
    for time_s in wanted:
        if not abs(time_s) <= LONGEST_S:
            raise ValueError(f"operating point at {time_s} s: allowed are times up to {LONGEST_S:g} s")
    run = flown_run(scenario, faults)
    found = {time_s: refine(run, _node(run, time_s, plane)) for time_s in sorted(set(wanted))}
    return with_swings([found[time_s] for time_s in wanted], scenario, faults)


def with_cuts(nodes: Sequence[Node], scenario: LoadedScenario) -> list[Node]:
    """Return operating points with the bending moments at the stations of section loads as further outputs.

    The flight itself needs no section loads, since its tables are packed again with them.
    """
    given = scenario.scenario
    on = given.model_copy(update={"switches": given.switches.model_copy(update={"section_loads": True})})
    packed, out = pack_flight(on), []
    for node in nodes:
        row = packed.parameters[node.stage]
        clock_s = table_clock_s(row, node.time_s - node.stage_start_s)
        held = dataclasses.replace(hold_stage(packed, clock_s, node.stage), swing_rad=node.held.swing_rad)
        out.append(dataclasses.replace(node, held=held))
    return out


SWING_PERIODS = 3.0  # periods of a pendulum about an operating point, over which its swing is averaged
_SWING_LOG = LogSection(fast_hz=200.0, slow_hz=1.0, transform_hz=1.0)


def with_swings(nodes: Sequence[Node], scenario: LoadedScenario, faults: bool = False) -> list[Node]:
    """Return operating points with the damping of ring baffles in a flight of the scenario (`swing_rad`).

    The flight is simulated only for vehicles with ring baffles. The swing combines both planes and is averaged over
    `SWING_PERIODS` about each operating point.
    """
    if not any(node.vehicle.pendulums.ring.any() for node in nodes):
        return list(nodes)
    logged = scenario.scenario.model_copy(update={"log": _SWING_LOG})
    run, kept = flown_run(dataclasses.replace(scenario, scenario=logged), faults, log=True), GrowingRows()
    last_s = max(node.time_s + 0.5 * float(window_s.max()) for node in nodes if len(window_s := swing_window_s(node)))
    while not run.finished and run.now_s < last_s:
        kept.add(run.fly_segment())
    times_ns, rows = kept.rows()[FAST]
    rates, out = swing_rates_radps(run, rows), []
    for node in nodes:
        apart_s = np.abs(1e-9 * times_ns - node.time_s)
        omega = 2.0 * np.pi * SWING_PERIODS / swing_window_s(node)
        swings = [equivalent_swing(rates[apart_s < np.pi * SWING_PERIODS / w, k], w) for k, w in enumerate(omega)]
        out.append(at_swing(node, np.array(swings)))
    return out


def swing_window_s(node: Node) -> Array:
    """Return the time over which the swing of each pendulum is averaged, s, (pendulums,)."""
    load = max(node.axial_load_mps2, 1e-9)
    return np.asarray(2.0 * np.pi * SWING_PERIODS * np.sqrt(node.vehicle.pendulums.length_m / load))


def swing_rates_radps(run: FlightRun, rows: Array) -> Array:
    """Return the angular rate of each pendulum relative to the body, in both planes combined, (rows, pendulums).

    `rows` are the fast rows of the log.
    """
    pitch, yaw = (rows[:, slosh_columns(run, plane, "rate_degps")] for plane in ("pitch", "yaw"))
    return np.radians(np.hypot(pitch, yaw))


def slosh_columns(run: FlightRun, plane: str, what: str = "deg") -> list[int]:
    """Return the columns of a flight's fast rows with the swing of each pendulum in a plane, or with its rate."""
    names = [c.name for c in run.table.columns(FAST)]
    return [n for n, name in enumerate(names) if name.startswith("slosh") and name.endswith(f"{plane}_{what}")]


def equivalent_swing(rate_radps: Array, omega_radps: float) -> float:
    """Return the amplitude (rad) of a planar swing in which ring baffles have the same damping as in a given motion.

    The linear damper with the same dissipation is proportional to mean(v^(5/2)) / mean(v^2) (docs/model.md, 5.9).
    """
    v = rate_radps[np.isfinite(rate_radps)]
    square = float(np.mean(v * v)) if len(v) else 0.0
    return (RING_DRAG * float(np.mean(v**2.5)) / square) ** 2 / omega_radps if square > 0.0 else 0.0


def disperse(node: Node, by: Dispersion) -> Node:
    """Return the operating point with deviations applied. Raises ValueError for too many factors."""
    if by == NOMINAL:
        return node
    label = f"{node.label} {by.label}".strip() if by.label else node.label
    if unlike_drives(by):
        node = with_drives_apart(node)
    return dataclasses.replace(
        node,
        held=deviated(node.held, node.plane, by),
        instruments=disperse_instruments(node.instruments, by),
        label=label,
    )


def with_drives_apart(node: Node) -> Node:
    """Return the operating point with a separate drive for each engine group that moves in its plane.

    Groups are separated even if their actuators are equal.
    """
    kept = node.instruments
    moved = sorted(group for group in node.held.groups_that_follow(node.plane) if any(node.allocation[group]))
    if all(len(groups) == 1 for groups in kept.groups) or not moved:
        return node
    by_group = {group: a for a, groups in zip(kept.actuators, kept.groups, strict=True) for group in groups}
    actuators, groups = tuple(by_group[group] for group in moved), tuple((group,) for group in moved)
    return dataclasses.replace(node, instruments=dataclasses.replace(kept, actuators=actuators, groups=groups))


def at_swing(node: Node, swing_rad: Array) -> Node:
    """Return the operating point with pendulums that swing with `swing_rad` (pendulums,) in both planes."""
    return dataclasses.replace(node, held=dataclasses.replace(node.held, swing_rad=swing_rad))


def _node(run: FlightRun, time_s: float, plane: Plane) -> Node:
    at_ns = flown_to(run, time_s)
    stage = int(run.memory.clock.stage)
    node = node_of(run.packed, at_ns / 1e9, stage, plane)
    row, idle_ns = run.packed.parameters[stage], int(run.memory.clock.idle_ns)
    clock_s = table_clock_s(row, (at_ns - int(row.timeline.stage_start_ns) - idle_ns) / 1e9)
    return dataclasses.replace(
        node, surface_radius_m=surface_radii_m(run.loaded.scenario.vehicle.stage[stage], clock_s)
    )


def at_same_propellant_s(run: FlightRun, flown: Scenario, node: Node) -> float:
    """Return the vehicle time at which a flight has burnt the same propellant as another flight at its operating point.

    `flown` is the scenario of the operating point. Burn rates and throttling may differ between the flights. Raises
    ValueError if the flight never burns this amount.
    """
    n, scenario = node.stage, run.loaded.scenario
    mine, other = (stage_burns(each.vehicle.stage, each.fault)[n] for each in (scenario, flown))
    start_ns = int(run.packed.parameters[n].timeline.stage_start_ns)
    start_s = start_ns / 1e9 if start_ns < NEVER else node.stage_start_s
    spent_s = table_time_s(flown.vehicle.stage[n], other, node.time_s - node.stage_start_s)
    at_s = start_s + when_spent_s(scenario.vehicle.stage[n], mine, spent_s)
    if scenario.guidance.restart or run.packed.parameters[n].timeline.sequenced == 1:
        burns = [span for span in powered_spans(run.loaded) if span.stage == n]
        at_s = next((at_s + each.idle_s for each in burns if each.holds(at_s + each.idle_s)), math.inf)
    if not math.isfinite(at_s):
        raise ValueError(f"operating point at {node.time_s:g} s: the flight never burns the propellant gone there")
    return at_s


def flown_point(point: OperatingPoint) -> Node:
    """Return an operating point with a vehicle. Raises ValueError for an operating point without one (given.py)."""
    if not isinstance(point, Node):
        raise ValueError(f"node at {point.time_s:g} s: it has no vehicle: allowed is an operating point of a flight")
    return point


def met_by(node: Node, met: Node) -> Node:
    """Return the operating point with its own vehicle, and with the air, speed and attitude of `met`.

    The damping of ring baffles remains that of `node`. It is lower in the calm air of a design's own flight than in the
    winds of other flights.
    """
    return dataclasses.replace(node, condition=dataclasses.replace(met.condition, time_s=node.time_s), trim=met.trim)


def surface_radii_m(stage: Stage, clock_s: float) -> tuple[float, ...]:
    """Return the radius of the liquid surface at rest for each pendulum, or NaN if the file does not state it."""
    out: list[float] = []
    for body, _, tank in stage.tanks:
        radius = math.nan if tank.radius_m is None else tank.radius_m
        if tank.shape is not None and tank.density_kgpm3 is not None:
            since_s = clock_s - (stage.booster[body - 1].ignition_s if body > 0 else 0.0)
            mass = np.interp(since_s, tank.table["time_s"], tank.table["liquid_mass_kg"])
            depth = tank.profile.depth(np.array(mass / (tank.density_kgpm3 * radius**3)))
            radius *= float(tank.profile.surface_radius(depth))
        out += [radius] * tank.pendulums
    return tuple(out)


def node_of(packed: Packed, time_s: float, stage: int = 0, plane: Plane = "pitch") -> Node:
    """Return the operating point at the present state and time of a packed flight."""
    air = evaluate_at(packed, packed.state, time_s).aux.air
    gravitation = air.gravitation_I_mps2
    gravity = float(np.linalg.norm(gravitation))
    forward = rotation(packed.state[Q_BI : Q_BI + 4])[:, 0]
    pitch = math.asin(max(-1.0, min(1.0, float(-forward @ gravitation) / gravity))) if gravity > 0.0 else 0.0
    u, v, w = (float(x) for x in air.flow_B_mps)
    row, trim = packed.parameters[stage], (math.atan2(w, u), math.atan2(v, math.hypot(u, w)))
    flies = (
        air.airspeed_mps >= row.vehicle.aero.airspeed_floor_mps
    )  # below this airspeed, only the pressure of the air acts
    carried = ground_velocity(row.environment.earth, *packed.state[R_I : R_I + 2])
    condition = FlightCondition(
        time_s=time_s,
        airspeed_mps=float(air.airspeed_mps),
        density_kgpm3=float(air.density_kgpm3) if flies else 0.0,
        pressure_Pa=float(air.pressure_Pa),
        mach=float(air.mach),
        pitch_rad=pitch,
        gravity_mps2=gravity,
    )
    start_s = 1e-9 * (int(row.timeline.stage_start_ns) + int(packed.memory[0].clock.idle_ns))
    return Node(
        time_s=time_s,
        held=hold_stage(packed, table_clock_s(row, time_s - start_s), stage),
        condition=condition,
        instruments=instruments_of(row, plane),
        plane=plane,
        allocation=allocation_at(packed.pool, row, time_s, plane),
        label=f"{time_s:g} s",
        stage=stage,
        stage_start_s=start_s,
        trim=trim,
        speed_mps=float(np.linalg.norm(packed.state[V_I : V_I + 3] - carried)),
    )
