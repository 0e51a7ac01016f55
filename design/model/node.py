"""A node: all that a linear loop depends on at one instant of one flight, in one plane."""

from __future__ import annotations

import dataclasses
import math
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from maxq.control.kernel.records import Array
from maxq.control.structures import Over
from maxq.design.model.dispersion import NOMINAL, Dispersion, deviated, disperse_instruments, unlike_drives
from maxq.design.model.held import Drives, FlightCondition, HeldStage, Trim, hold_stage, table_clock_s
from maxq.design.model.instruments import Instruments, Plane, allocation_at, instruments_of
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
from maxq.sim.flight.parameters import EVENT_NAMES, NEVER, TUMBLE
from maxq.sim.flight.telemetry import FAST
from maxq.sim.packing.flight import Packed, pack_flight
from maxq.sim.packing.initial import rotation
from maxq.sim.run.evaluate import evaluate_at
from maxq.sim.run.flight import Event, KeptRows
from maxq.sim.run.fly import CONTROL_LOST_NAME, DIVERGED_NAME, IGNITION_NAME, FlightRun
from maxq.sim.scenario.burn import Burn, burn_rate, stage_burns
from maxq.sim.scenario.loader import LoadedScenario
from maxq.sim.scenario.ranges import LONGEST_S
from maxq.sim.scenario.schema_scenario import Log
from maxq.sim.scenario.schema_vehicle import Stage
from maxq.sim.vehicle.actuator import Actuator
from maxq.sim.vehicle.slosh import RING_DRAG
from maxq.sim.vehicle.state import Q_BI, R_I, V_I
from maxq.sim.vehicle.workspace import AIRSPEED, DENSITY, FLOW, GRAVITATION, MACH, PRESSURE
from maxq.sim.world.earth import ground_velocity


@dataclass(frozen=True)
class Node:
    """An operating point: vehicle, air and instruments of one plane at a vehicle time."""

    time_s: float
    held: HeldStage
    condition: FlightCondition
    instruments: Instruments
    plane: Plane = "pitch"
    allocation: tuple[tuple[float, float], ...] = ((1.0, 0.0),)  # angles per command of each group, own and other plane
    surface_radius_m: tuple[float, ...] = ()  # of the liquid under each pendulum, nan if unknown; nominal vehicle
    label: str = ""
    stage: int = 0  # which one burns, from 0
    stage_start_s: float = 0.0  # zero of that stage's clock on the vehicle clock
    trim: Trim = (0.0, 0.0)  # angles of attack and sideslip at which tables over incidence have their slopes, rad
    speed_mps: float = math.nan  # relative to the rotating Earth

    @cached_property
    def plant(self) -> StateSpace:
        """Linear model of the plane: motion of the actuators and wind -> rates, of body, modes and pendulums.

        The Jacobian of the simulator's derivative (held.py). States w (m/s, of the body point at the core's CG), q
        (rad/s), theta (rad), eta (m), eta' (m/s; the spatial modes first), slosh angles (rad) and their rates, angle
        and rate of each engine on a TVC load. The other plane, roll and the speed along the axis are held. Inputs: of
        each drive, an actuator's motion, the angle and what else of its motion engines feel. Outputs: `held.OUTPUTS`,
        then what the vehicle's other sensors measure, and the bending moment at each station of section loads that are
        switched on, N m. The yaw plane has the states and signs of the pitch plane turned about x.

        Raises ValueError, naming the node, where no such system exists.
        """
        return self.plant_in_wind(wind=False)

    def plant_in_wind(self, wind: bool = True) -> StateSpace:
        """`plant`, with the lateral velocity of the air in the plane, m/s, as its last input."""
        self.check_axial_load()
        *parts, names = self.held.plants(
            self.condition, self.trim, self.plane, self.drives, wind=wind, moments=bool(self.vehicle.cut_stations_m)
        )
        a, b, c, d = (part[0] for part in parts)
        return StateSpace(a, b, c, d, *names)

    def check_axial_load(self) -> None:
        """Raise ValueError, naming the node, where pendulums do not hang under a positive axial load."""
        if len(self.vehicle.pendulums.mass_kg) and self.axial_load_mps2 <= 0.0:
            problem = f"a pendulum needs a positive axial load, not {self.axial_load_mps2:g} m/s2"
            raise ValueError(f"node at {self.time_s:g} s: {problem}")

    @property
    def drives(self) -> Drives:
        """Actuators that the law's command moves, for each of the instruments' drives."""
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
        """Masses, modes and pendulums in the plane."""
        return vehicle_at(self.held, self.plane)

    @cached_property
    def axial_load_mps2(self) -> float:
        """Axial specific force of the whole vehicle, (thrust - drag) / mass."""
        return axial_load_mps2(self.held, self.condition, self.trim)

    @cached_property
    def derivatives(self) -> StabilityDerivatives:
        """Of the rigid vehicle with its liquid frozen. Raises ValueError at rest, where they are not defined."""
        return stability_derivatives(self.held, self.condition, self.trim, self.plane, self.drives)

    @property
    def actuators(self) -> tuple[Actuator, ...]:
        """Of each drive."""
        return self.instruments.actuators

    @property
    def actuator(self) -> Actuator:
        """Of the first drive."""
        return self.actuators[0]

    @property
    def gains(self) -> tuple[float, ...]:
        """Of each drive: the largest angle of a group per command of the law."""
        moved = self.held.groups_that_follow(self.plane)
        return tuple(
            max((abs(self.allocation[group][0]) for group in groups if group in moved), default=0.0)
            for groups in self.instruments.groups
        )

    @property
    def angle_limit_rad(self) -> float:
        """Command of the law at which the first actuator reaches the limit of its angle; infinite for ideal ones."""
        limits = zip(self.actuators, self.gains, strict=True)
        return min((a.angle_limit_rad / gain for a, gain in limits if gain > 0.0 and not a.ideal), default=math.inf)

    def scheduled(self, over: Over) -> float:
        """What gains are scheduled over, at this instant of the flight, as the flight computer has it.

        Raises ValueError for a node that was not flown and has no speed.
        """
        if over == "time_s":
            return self.time_s
        if over == "mass_kg":
            return self.vehicle.total_mass_kg
        if not math.isfinite(self.speed_mps):
            raise ValueError(f"node at {self.time_s:g} s: it has no speed, over which the gains are scheduled")
        return self.speed_mps if over == "speed_mps" else 0.5 * self.condition.density_kgpm3 * self.speed_mps**2

    def steps(self) -> list[Node]:
        """The vehicle built up: rigid body, aerodynamics, slosh, engine inertia, bending; the last is the node itself.

        Without slosh the liquid is frozen at its bobs; without aerodynamics the axial force stays, since it sets the
        axial load on liquid and engine; without engine inertia the gimbal moves a massless engine.
        """
        stiff = without_bending(self.held)
        light = without_engine_inertia(stiff)
        frozen = with_frozen_liquid(light)
        bare = without_lateral_air(frozen)
        return [*(dataclasses.replace(self, held=held) for held in (bare, frozen, light, stiff)), self]

    def with_(self, **deviations: Any) -> Node:
        """The node with deviations, by the fields of `dispersion.Dispersion`."""
        return disperse(self, Dispersion(**deviations))


@dataclass(frozen=True)
class Span:
    """A stretch of the flight, s on the vehicle clock, in which a stage is under thrust and off the pad."""

    stage: int  # from 0
    begin_s: float
    end_s: float

    def holds(self, time_s: float) -> bool:
        return self.begin_s <= time_s <= self.end_s


LOSSES = (CONTROL_LOST_NAME, EVENT_NAMES[TUMBLE], DIVERGED_NAME)
"""Events from which on a flight gives no operating points."""


def loss_of(events: Iterable[Event]) -> Event | None:
    """Return the first event by which a flight is lost: control lost, a tumble or divergence; None without one."""
    return min((e for e in events if e.name in LOSSES), key=lambda e: e.time_ns, default=None)


def loss_text(loss: Event) -> str:
    """Name a loss and its time: "control lost at 23.140 s"."""
    return f"{loss.name.replace('_', ' ')} at {loss.time_s:.3f} s"


def powered_flight(scenario: LoadedScenario, faults: bool = False) -> tuple[tuple[Span, ...], Event | None]:
    """Fly without a log up to the last burnout, or to the loss: the powered span of each stage, and that loss.

    The latest answers are kept, since spans, times and loss of one flight are asked for in turn.
    """
    for known, with_faults, found in tuple(_LATEST):
        if known is scenario and with_faults == faults:
            return found
    answer = _powered_flight(scenario, faults)
    _LATEST.append((scenario, faults, answer))
    return answer


_LATEST: deque[tuple[LoadedScenario, bool, tuple[tuple[Span, ...], Event | None]]] = deque(maxlen=4)


def _powered_flight(scenario: LoadedScenario, faults: bool) -> tuple[tuple[Span, ...], Event | None]:
    run, loss = flown_run(scenario, faults), None
    last = len(run.packed.parameters) - 1
    while not run.finished and loss is None and int(run.memory.clock.stage_burnout_ns[last]) < 0:
        run.fly_segment()
        loss = loss_of(run.events)
    burnout_ns = int(run.memory.clock.stage_burnout_ns[last])
    if loss is not None and 0 <= burnout_ns < loss.time_ns:
        loss = None  # of the coast that follows
    return spans_of(run.events, len(run.packed.parameters), run.now_s), loss


def powered_spans(scenario: LoadedScenario) -> tuple[Span, ...]:
    """Return the powered span of each stage that burns, in a flight without faults; they end where it is lost."""
    return powered_flight(scenario)[0]


def spans_of(events: Iterable[Event], stages: int, now_s: float) -> tuple[Span, ...]:
    """Return the powered spans up to `now_s` by the events of a flight of this number of stages.

    No span contains a time after the loss of the flight.
    """
    found = list(events)
    loss = loss_of(found)
    now_s = now_s if loss is None else min(now_s, loss.time_s)
    lift_off_s = next((e.time_s for e in found if e.name == "liftoff"), -math.inf)
    out, end_s, burns_on = [], math.inf, False
    for n in range(stages):
        mine = [e for e in found if e.stage == (n + 1 if stages > 1 else 0)]
        begin_s = next((e.time_s for e in mine if e.name == IGNITION_NAME), end_s if burns_on else math.inf)
        end_s = min([now_s, *(e.time_s for e in mine if e.name in ("burnout", "separation"))])
        burns_on = math.isfinite(begin_s) and all(e.name != "burnout" for e in mine)  # the stage after it continues
        if max(begin_s, lift_off_s) < end_s:
            out.append(Span(n, max(begin_s, lift_off_s), end_s))
    return tuple(out)


NODES_PER_STAGE = 11
_FULL = 0.5  # share of a stage's largest thrust that nodes need
EDGES = 0.05, 0.02  # shares of a span that nodes keep off its ends


def node_times(
    scenario: LoadedScenario, count: int = NODES_PER_STAGE, stage: int | None = None,
    edges: tuple[float, float] = EDGES,
) -> tuple[float, ...]:  # fmt: skip  # three lines more otherwise
    """Times of nodes that suit a flight: `count` in each stage (or one of them), evenly under full thrust; a single one
    in the middle.

    Stages whose engines cannot be moved have none. Raises ValueError where there is no stage left.
    """
    times: list[float] = []
    stages = scenario.vehicle.stage
    burns = stage_burns(stages, scenario.scenario.fault)
    for span in powered_spans(scenario):
        mine = stages[span.stage]
        if stage in (None, span.stage) and any(engine.gimbal != "fixed" for engine in mine.engines):
            full = full_thrust(mine, burns[span.stage])
            begin, end = max(span.begin_s, full[0]), min(span.end_s, full[1])
            first, last = begin + edges[0] * (end - begin), end - edges[1] * (end - begin)
            chosen = np.linspace(first, last, count) if count > 1 else [0.5 * (first + last)]
            times += [round(float(t), 3) for t in chosen]
    if not times:
        which = "no stage" if stage is None else f"stage {stage + 1} not"
        raise ValueError(f"{scenario.label}: {which} under thrust by engines that can be moved; there is no node")
    return tuple(times)


def full_thrust(stage: Stage, burn: Burn) -> tuple[float, float]:
    """Return the first and last instant on the vehicle clock of half the largest thrust by the tables."""
    tables = [engine.table for engine in stage.engines]
    if any(len(table) == 1 for table in tables):
        return -math.inf, math.inf
    times = np.unique(np.concatenate([table["time_s"] for table in tables]))
    thrust = sum(np.interp(times, table["time_s"], table["thrust_vacuum_N"], right=0.0) for table in tables)
    ends = times[thrust >= _FULL * np.max(thrust)][[0, -1]]
    begin, end = ends / burn_rate(stage) if burn.clock is None else burn.clock.when(ends)
    return burn.start_s + float(begin), burn.start_s + float(end)


def nodes_along(
    scenario: LoadedScenario, times_s: Iterable[float], plane: Plane = "pitch", faults: bool = False,
    refine: Callable[[FlightRun, Node], Node] = lambda run, node: node,
) -> list[Node]:  # fmt: skip  # seven lines otherwise
    """Nodes at vehicle times (s) of a flight of the scenario, flown once and without a log.

    Speed, air and attitude are those flown, at the integrator's step nearest to each time; incidence and rotation
    are taken as zero, but for a vehicle with tables over incidence, which is taken at the flown angles, and ring
    baffles, which damp as they do in the flown swing (`with_swings`). What the scenario lets fail works, but with
    `faults`. Nodes come in the order of `times_s`. Raises ValueError, naming node and range, for a time outside the
    powered flight.
    """
    wanted = [float(t) for t in times_s]
    if not wanted:
        return []
    for time_s in wanted:
        if not abs(time_s) <= LONGEST_S:
            raise ValueError(f"node at {time_s} s: allowed are times up to {LONGEST_S:g} s")
    run = flown_run(scenario, faults)
    found = {time_s: refine(run, _node(run, time_s, plane)) for time_s in sorted(set(wanted))}
    return with_swings([found[time_s] for time_s in wanted], scenario, faults)


def with_cuts(nodes: Sequence[Node], scenario: LoadedScenario) -> list[Node]:
    """Nodes whose vehicles have the bending moment at the stations of their section loads among their outputs.

    The flight needs no section loads for that: its tables are packed once more with them.
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


SWING_PERIODS = 3.0  # of a pendulum, about a node, over which its swing is averaged
_SWING_LOG = Log(fast_hz=200.0, slow_hz=1.0, transform_hz=1.0)


def with_swings(nodes: Sequence[Node], scenario: LoadedScenario, faults: bool = False) -> list[Node]:
    """Nodes whose ring baffles damp as in a flight of the scenario, `SWING_PERIODS` about each: as `swing_rad` tells.

    Only vehicles with rings are flown. The swing is that of both planes together.
    """
    if not any(node.vehicle.pendulums.ring.any() for node in nodes):
        return list(nodes)
    logged = scenario.scenario.model_copy(update={"log": _SWING_LOG})
    run, kept = flown_run(dataclasses.replace(scenario, scenario=logged), faults, log=True), KeptRows()
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
    """Over which the swing of each pendulum is averaged, (pendulums,)."""
    load = max(node.axial_load_mps2, 1e-9)
    return np.asarray(2.0 * np.pi * SWING_PERIODS * np.sqrt(node.vehicle.pendulums.length_m / load))


def swing_rates_radps(run: FlightRun, rows: Array) -> Array:
    """Of a flight's fast rows: angular rate of each pendulum in the body, both planes together, (rows, pendulums)."""
    pitch, yaw = (rows[:, slosh_columns(run, plane, "rate_degps")] for plane in ("pitch", "yaw"))
    return np.radians(np.hypot(pitch, yaw))


def slosh_columns(run: FlightRun, plane: str, what: str = "deg") -> list[int]:
    """Columns of a flight's fast rows with the swing of each tank's pendulum, deg, or its rate."""
    names = [c.name for c in run.table.columns(FAST)]
    return [n for n, name in enumerate(names) if name.startswith("slosh") and name.endswith(f"{plane}_{what}")]


def equivalent_swing(rate_radps: Array, omega_radps: float) -> float:
    """Amplitude (rad) of a plane swing at a frequency for which rings are as good a linear damper as in a motion.

    The linear damper that dissipates as much is in proportion to mean(v^(5/2)) / mean(v^2) (docs/model.md, 5.9).
    """
    v = rate_radps[np.isfinite(rate_radps)]
    square = float(np.mean(v * v)) if len(v) else 0.0
    return (RING_DRAG * float(np.mean(v**2.5)) / square) ** 2 / omega_radps if square > 0.0 else 0.0


def disperse(node: Node, by: Dispersion) -> Node:
    """Return the node with the deviations applied (`Node.with_`: by keywords). Raises ValueError for too many
    factors."""
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
    """Return the node with a drive for each group of engines that moves in its plane, alike as their actuators may
    be."""
    kept = node.instruments
    moved = sorted(group for group in node.held.groups_that_follow(node.plane) if any(node.allocation[group]))
    if all(len(groups) == 1 for groups in kept.groups) or not moved:
        return node
    by_group = {group: a for a, groups in zip(kept.actuators, kept.groups, strict=True) for group in groups}
    actuators, groups = tuple(by_group[group] for group in moved), tuple((group,) for group in moved)
    return dataclasses.replace(node, instruments=dataclasses.replace(kept, actuators=actuators, groups=groups))


def at_swing(node: Node, swing_rad: Array) -> Node:
    """Return the node with its pendulums' `swing_rad`, in both planes."""
    return dataclasses.replace(node, held=dataclasses.replace(node.held, swing_rad=swing_rad))


def flown_run(scenario: LoadedScenario, faults: bool, log: bool = False) -> FlightRun:
    """A flight at its start, by default without a log; on the grid of run.step_s, on which nodes lie."""
    run = scenario.scenario.run.model_copy(update={"accuracy": None})
    flown = scenario.scenario.model_copy(update={"run": run} | ({} if faults else {"fault": ()}))
    return FlightRun(dataclasses.replace(scenario, scenario=flown), pack_flight(flown), log=log)


def _node(run: FlightRun, time_s: float, plane: Plane) -> Node:
    at_ns = flown_to(run, time_s)
    stage = int(run.memory.clock.stage)
    node = node_of(run.packed, at_ns / 1e9, stage, plane)
    row = run.packed.parameters[stage]
    clock_s = table_clock_s(row, (at_ns - int(row.timeline.stage_start_ns)) / 1e9)
    return dataclasses.replace(
        node, surface_radius_m=surface_radii_m(run.loaded.scenario.vehicle.stage[stage], clock_s)
    )


def at_same_propellant_s(run: FlightRun, flown: Packed, node: Node) -> float:
    """When a flight meets a node of another one (`flown`), whose engines may burn at another rate: vehicle clock."""
    mine, other = (packed.parameters[node.stage].timeline for packed in (run.packed, flown))
    start_ns = int(mine.stage_start_ns) if int(mine.stage_start_ns) < NEVER else round(1e9 * node.stage_start_s)
    burnt_s = float(other.burn_rate) * (node.time_s - node.stage_start_s)
    return start_ns / 1e9 + burnt_s / float(mine.burn_rate)


def met_by(node: Node, met: Node) -> Node:
    """Return a node with its own vehicle in the air, at the speed and in the attitude of `met`.

    Rings damp as at the node: in the calm air of a design's own flight less than in the winds of others.
    """
    return dataclasses.replace(node, condition=dataclasses.replace(met.condition, time_s=node.time_s), trim=met.trim)


def flown_to(run: FlightRun, time_s: float) -> int:
    """Fly on to the integrator's step nearest to a vehicle time, in ns.

    Raises ValueError where no engine burns, and after the loss of the flight.
    """
    step_ns = int(run.packed.parameters[0].timeline.step_ns)
    at_ns = round(time_s * 1e9 / step_ns) * step_ns
    begins_s = run.now_s
    if at_ns < round(begins_s * 1e9):
        raise ValueError(f"node at {time_s:g} s: the flight begins at {begins_s:g} s; {_allowed(run)}")
    if round(run.now_s * 1e9) < at_ns:
        run.fly_segment(at_ns)
    if round(run.now_s * 1e9) != at_ns:
        events = ", ".join(f"{e.title} at {e.time_s:.4g} s" for e in run.events)
        raise ValueError(f"node at {time_s:g} s: the flight ends at {run.now_s:.6g} s ({events or 'no events'})")
    if (loss := loss_of(run.events)) is not None:
        raise ValueError(
            f"node at {time_s:g} s: the flight is lost before ({loss_text(loss)}); allowed are times before the loss"
        )
    held = run.memory.held
    if held.on_pad == 1 or held.burning == 0:
        why = "the vehicle is held down" if held.on_pad == 1 else "the engine does not burn"
        raise ValueError(f"node at {time_s:g} s: {why}; {_allowed(run)}")
    return at_ns


def _allowed(run: FlightRun) -> str:
    """Times under thrust, as the stages' timelines have them."""
    spans: list[str] = []
    for row in run.packed.parameters:
        begin_ns, end_ns = int(row.timeline.burn_start_ns), int(row.timeline.burnout_ns)
        if begin_ns < end_ns:
            begin = f"{max(begin_ns, 0) / 1e9:.6g} s" if spans else "lift-off"
            spans.append(f"{begin} to {f'{end_ns / 1e9:.6g} s' if end_ns < NEVER else 'the end'}")
    return f"allowed are times under thrust: {', '.join(spans) or 'there are none'}"


def surface_radii_m(stage: Stage, clock_s: float) -> tuple[float, ...]:
    """Radius of the surface at rest in the tank of each pendulum; nan where the file does not tell it."""
    out: list[float] = []
    for tank in stage.tank:
        radius = math.nan if tank.radius_m is None else tank.radius_m
        if tank.shape is not None and tank.density_kgpm3 is not None:
            mass = np.interp(clock_s, tank.table["time_s"], tank.table["liquid_mass_kg"])
            depth = tank.profile.depth(np.array(mass / (tank.density_kgpm3 * radius**3)))
            radius *= float(tank.profile.surface_radius(depth))
        out += [radius] * tank.pendulums
    return tuple(out)


def node_of(packed: Packed, time_s: float, stage: int = 0, plane: Plane = "pitch") -> Node:
    """Node at the state and time at which a packed flight stands."""
    air = evaluate_at(packed, packed.state, time_s).aux
    gravitation = air[GRAVITATION : GRAVITATION + 3]
    gravity = float(np.linalg.norm(gravitation))
    forward = rotation(packed.state[Q_BI : Q_BI + 4])[:, 0]
    pitch = math.asin(max(-1.0, min(1.0, float(-forward @ gravitation) / gravity))) if gravity > 0.0 else 0.0
    u, v, w = (float(x) for x in air[FLOW : FLOW + 3])
    row, trim = packed.parameters[stage], (math.atan2(w, u), math.atan2(v, math.hypot(u, w)))
    flies = air[AIRSPEED] >= row.vehicle.aero.airspeed_floor_mps  # below it no air acts, and its pressure does
    carried = ground_velocity(row.environment.earth, *packed.state[R_I : R_I + 2])
    condition = FlightCondition(
        time_s=time_s,
        airspeed_mps=float(air[AIRSPEED]),
        density_kgpm3=float(air[DENSITY]) if flies else 0.0,
        pressure_Pa=float(air[PRESSURE]),
        mach=float(air[MACH]),
        pitch_rad=pitch,
        gravity_mps2=gravity,
    )
    since_s = time_s - 1e-9 * int(row.timeline.stage_start_ns)
    return Node(
        time_s=time_s,
        held=hold_stage(packed, table_clock_s(row, since_s), stage),
        condition=condition,
        instruments=instruments_of(row, plane),
        plane=plane,
        allocation=allocation_at(packed.pool, row, time_s, plane),
        label=f"{time_s:g} s",
        stage=stage,
        stage_start_s=1e-9 * int(row.timeline.stage_start_ns),
        trim=trim,
        speed_mps=float(np.linalg.norm(packed.state[V_I : V_I + 3] - carried)),
    )
