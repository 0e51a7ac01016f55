"""Conversion of a validated scenario into kernel inputs: parameter rows, table pool, initial state and memory."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields, replace
from operator import attrgetter
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from maxq.control.burns import Burns
from maxq.control.external import BOOSTER_SEPARATION, FAIRING_SEPARATION, NO_SEPARATION, STAGE_SEPARATION
from maxq.control.kernel.jit import from_python
from maxq.control.kernel.records import Array, blank, pack, with_constants
from maxq.control.kernel.tables import Pool
from maxq.sim.flight.parameters import DROPS, EVENT_NAMES, NEVER, NONE, Memory, Parameters, StageTimeline
from maxq.sim.input.values import NS_PER_S, period_ns, to_ns
from maxq.sim.packing.computer import pack_burns, pack_computers, pack_injections
from maxq.sim.packing.environment import pack_environment
from maxq.sim.packing.faults import pack_faults
from maxq.sim.packing.gauges import pack_gauges
from maxq.sim.packing.initial import initial_motion, thrust_exceeds_weight_s
from maxq.sim.packing.integration import step_ns
from maxq.sim.packing.launch import pack_launch, pack_navigation
from maxq.sim.packing.schedule import carried_boosters, mass_at, stage_sizes, vehicle_schedule
from maxq.sim.packing.separation import modal_transfer, part_at
from maxq.sim.packing.vehicle import pack_vehicle
from maxq.sim.scenario.schema_scenario import Scenario
from maxq.sim.scenario.schema_vehicle import Separation, Stage
from maxq.sim.vehicle.engine.allocation import pack_allocation
from maxq.sim.vehicle.engine.burn import Burn, burn_rate, leaving, stage_burns
from maxq.sim.vehicle.loads.packing import CarriedBoosters, pack_loads
from maxq.sim.vehicle.sensor.gauges import Gauges
from maxq.sim.vehicle.sensor.receivers import pack_receivers
from maxq.sim.vehicle.state import MAX_STATE, W_BI_B, Sizes, start_states

CONTROL_LOST_RAD = math.radians(45.0)
TUMBLE_RAD = math.radians(90.0)
TUMBLE_PRESSURE_PA = 5000.0
_TRAIL_NS = NS_PER_S // 10
_start_states = from_python(start_states)


class BoosterBurn(NamedTuple):
    """The ignition and burnout of a booster in a stage, in ns of flight time; NEVER if they do not occur in it."""

    name: str
    stage: int
    ignition_ns: int
    burnout_ns: int


@dataclass(frozen=True)
class Packed:
    """A packed flight.

    `parameters` (stages,) is of Parameters, `memory` (1,) of Memory, and `pool` contains the tables. `state`
    (MAX_STATE,) is the initial state.
    """

    parameters: NDArray[Any]
    pool: Array
    memory: NDArray[Any]
    state: Array
    sizes: Sizes  # the largest sizes of all stages
    boosters: tuple[BoosterBurn, ...] = ()


_counts = attrgetter(*(f.name for f in fields(Sizes) if f.init))


def pack_flight(scenario: Scenario) -> Packed:
    """Return the packed flight of a scenario, for the compiled kernels that all vehicles share."""
    pool = Pool()
    environment, computers = pack_environment(scenario, pool), pack_computers(scenario, pool)
    injections, faults, navigation = pack_injections(scenario, pool), pack_faults(scenario), pack_navigation(scenario)
    burns = stage_burns(scenario.vehicle.stage, scenario.fault, _liftoff_s(scenario))
    rows: list[Parameters] = []
    ignition_ns = 0
    all_sizes = [
        stage_sizes(stage, scenario.switches, burn) for stage, burn in zip(scenario.vehicle.stage, burns, strict=True)
    ]
    frozen = scenario.run.freeze_vehicle_at_s is not None
    stages, computer = scenario.vehicle.stage, scenario.vehicle.computer
    external = computer is not None and computer.law == "external"
    sequenced = int(computer is not None and computer.sequences and not frozen)
    receivers = pack_receivers(scenario.vehicle)
    for n, (stage, burn, sizes) in enumerate(zip(stages, burns, all_sizes, strict=True)):
        schedule = vehicle_schedule(stage, burn, sizes, scenario.switches, frozen)
        stage_start_ns = _stage_start_ns(rows, stage)
        vehicle = pack_vehicle(scenario, stage, burn, sizes, schedule, pool)
        burns_later = any(later.engines for later in stages[n + 1 :])
        handed_on = NONE if n == 0 or frozen else _handed_on(stages, burns, all_sizes, n, pool)
        goes_on = int(stage.continues) * (DROPS if n > 0 and leaving(stages, n - 1) else 1)
        timeline = _timeline(scenario, stage, burn, stage_start_ns, burns_later, handed_on, goes_on)
        timeline = replace(timeline, sequenced=sequenced, separates=_separates(stages, n))
        carried = carried_boosters(stage, burn, sizes) if stage.loads is not None else CarriedBoosters()
        loads = pack_loads(scenario, stage, burn, sizes, pool, carried)
        if not stage.continues:
            ignition_ns = timeline.burn_start_ns
        guided = all(later.continues for later in stages[n + 1 :]) and not frozen and not sequenced
        last = pack_burns(scenario, stage, ignition_ns) if guided else Burns()
        flies = replace(computers[n], allocation=pack_allocation(scenario, stage, burn, pool), burns=last)
        launch = pack_launch(scenario, stage)
        gauges = pack_gauges(stage, burn, pool) if external else Gauges()
        beside = launch, navigation, injections, faults, timeline, receivers, gauges
        rows.append(Parameters(vehicle, loads, environment, flies, *beside))
    parameters = pack(rows)
    y = np.zeros(MAX_STATE)
    initial_motion(scenario, y)
    rate = (float(y[W_BI_B]), float(y[W_BI_B + 1]), float(y[W_BI_B + 2]))
    _start_states(parameters["vehicle"]["sizes"][0], rate, 0, y)
    memory = blank(Memory)
    memory["clock"]["now_ns"] = to_ns(scenario.run.start_s)
    memory["trail"]["period_ns"] = _TRAIL_NS if scenario.range_safety is not None else 0
    memory["held"]["on_pad"] = int(scenario.held)
    memory["held"]["clamped"] = int(scenario.held and scenario.holddown.clamped)
    widest = Sizes(*map(max, zip(*map(_counts, all_sizes), strict=True)))
    starts_ns = [row.timeline.stage_start_ns for row in rows]
    return Packed(parameters, pool.array(), memory, y, widest, tuple(_booster_burns(stages, burns, starts_ns)))


def _booster_burns(stages: Sequence[Stage], burns: Sequence[Burn], starts_ns: Sequence[int]) -> Iterator[BoosterBurn]:
    """Yield the burn of each booster in each of its stages, with its ignition in the first of them only."""
    known: set[str] = set()
    for n, (stage, burn, start_ns) in enumerate(zip(stages, burns, starts_ns, strict=True)):
        for booster, own in zip(stage.booster, burn.bodies[1:], strict=True):
            ignition_ns = start_ns + round(NS_PER_S * booster.ignition_s)
            burns_out = own.burnout_s > 0.0
            burnout_ns = start_ns + round(NS_PER_S * own.burnout_s) if burns_out else NEVER
            yield BoosterBurn(booster.name, n, NEVER if booster.name in known else ignition_ns, burnout_ns)
            known.add(booster.name)


def pack_for_one_vehicle(scenario: Scenario) -> Packed:
    """Return the same as `pack_flight`, for kernels compiled for this vehicle's numbers of modes, tanks and so on.

    These kernels compute the same bits in less time. Compiling them takes as long as about two hundred flights, once.
    Stages of different sizes use the common kernels.
    """
    return for_one_vehicle(pack_flight(scenario))


def for_one_vehicle(packed: Packed) -> Packed:
    """Return a packed flight in the form of `pack_for_one_vehicle`."""
    return replace(packed, parameters=with_constants(packed.parameters, "vehicle", "sizes"))


def _liftoff_s(scenario: Scenario) -> float:
    """Return the time of liftoff on the vehicle clock, s, or infinity if no engine fault refers to it."""
    counted = [fault for fault in scenario.fault if fault.of_engines and fault.since == "liftoff"]
    if not counted:
        return math.inf
    if scenario.holddown.release_s is not None:
        return scenario.holddown.release_s
    others = tuple(fault for fault in scenario.fault if fault not in counted)
    before = pack_flight(scenario.model_copy(update={"fault": others}))
    return thrust_exceeds_weight_s(before.parameters[0], before.pool, before.state)


def _handed_on(stages: Sequence[Stage], burns: Sequence[Burn], sizes: Sequence[Sizes], n: int, pool: Pool) -> int:
    """Return the place in the pool of the transfer matrix from the modes of the preceding stage to those of stage n.

    The result is NONE if the modes are kept or the preceding stage has none.
    """
    if stages[n].continues and not leaving(stages, n - 1):
        return NONE
    before = part_at(stages[n - 1], burns[n - 1], sizes[n - 1], burns[n - 1].end_s)
    if not any(before.sets):
        return NONE
    at_s = burns[n - 1].end_s if stages[n].clock == "preceding" else 0.0
    after, (mass_kg, *_, roll_kgm2) = part_at(stages[n], burns[n], sizes[n], at_s), mass_at(stages[n], burns[n], at_s)
    # arguments without effect are 0, so that the runs of a campaign use the cached matrix
    known, twist = any(after.sets), before.spatial or after.spatial
    transfer = modal_transfer(before, after, 0.0 if known else mass_kg, roll_kgm2 / mass_kg if twist else 0.0)
    return pool.put(transfer)


def _stage_start_ns(before: Sequence[Parameters], stage: Stage) -> int:
    """Return the flight time of the zero of a stage's clock, ns, from the parameters of the stages before it."""
    if not before:
        return 0
    last = before[-1].timeline
    return last.stage_start_ns if stage.clock == "preceding" else last.separation_ns


def _timeline(
    scenario: Scenario, stage: Stage, burn: Burn, stage_start_ns: int, burns_later: bool, handed_on: int, goes_on: int
) -> StageTimeline:
    run, rate = scenario.run, burn_rate(stage) if burn.clock is None else 1.0
    start_ns = to_ns(run.start_s)
    ignition_ns, burnout_ns = _burn(stage, burn, stage_start_ns)
    end_s = burn.end_s
    frozen_s = run.freeze_vehicle_at_s
    if frozen_s is not None:
        burning = ignition_ns <= round(NS_PER_S * frozen_s) < burnout_ns
        ignition_ns, burnout_ns = (-NEVER, NEVER) if burning else (NEVER, NEVER)
    release_s = scenario.holddown.release_s
    judged = scenario.vehicle.computer is not None and scenario.design is not None
    apart = stage.separation or Separation()
    ends = ("diverged", *(name for name in run.stop_at if name != "burnout" or not burns_later))
    return StageTimeline(
        step_ns=step_ns(scenario, stage),
        even=int(run.accuracy is not None),
        stage_start_ns=stage_start_ns,
        burn_start_ns=ignition_ns,
        frozen=int(frozen_s is not None),
        frozen_s=rate * (frozen_s or 0.0),
        burn_rate=rate,
        burnout_ns=burnout_ns,
        decay_ns=to_ns(stage.cutoff_decay_s * stage.cutoff_decay_factor),
        separation_ns=NEVER if math.isinf(end_s) else stage_start_ns + round(NS_PER_S * end_s),
        release_ns=NEVER if release_s is None else to_ns(release_s),
        stop_ns=start_ns + to_ns(run.duration_s),
        ground_altitude_m=min(0.0, scenario.site.altitude_m),
        stop_mask=sum(1 << EVENT_NAMES.index(name) for name in ends),
        separation_impulse_Ns=apart.impulse_Ns,
        separation_spring_J=apart.spring_J,
        tip_off_radps=np.radians(apart.tip_off_degps),
        continues=goes_on,
        handed_on=handed_on,
        control_lost_rad=CONTROL_LOST_RAD if judged else math.inf,
        tumble_rad=TUMBLE_RAD,
        tumble_pressure_Pa=TUMBLE_PRESSURE_PA,
        fast_ns=period_ns(scenario.log.fast_hz),
        slow_ns=period_ns(scenario.log.slow_hz),
        seed=run.seed,
        sequenced=0,
        separates=NO_SEPARATION,
    )


def _separates(stages: Sequence[Stage], n: int) -> int:
    """Return the kind of the separation that ends stage n, as an index into external.SEPARATIONS."""
    if n + 1 == len(stages):
        return NO_SEPARATION
    if not stages[n + 1].continues:
        return STAGE_SEPARATION
    return BOOSTER_SEPARATION if leaving(stages, n) else FAIRING_SEPARATION


def _burn(stage: Stage, burn: Burn, stage_start_ns: int) -> tuple[int, int]:
    """Return the flight times of ignition and burnout, ns.

    With a single row of thrust, an engine burns without end, and the burnout is NEVER. Without an engine, both are
    NEVER.
    """
    if not stage.engines:
        return NEVER, NEVER
    ignition_ns = stage_start_ns + round(NS_PER_S * min(body.ignition_s for body in stage.bodies if body.own_engines))
    if any(len(engine.table) == 1 for engine in stage.engines) and burn.burnout_s == 0.0:
        return ignition_ns, NEVER
    return ignition_ns, stage_start_ns + round(NS_PER_S * burn.burnout_s)
