"""Times of operating points that suit a flight: under full thrust, and in a long tail-off with control authority.

At an instant of a tail-off, the gimbals have authority under three conditions:

- The thrust of the gimballed engines is at least `LEAST_SHARE` of its largest value.
- The axial load is positive.
- The gimbals trim `TRIMMED_DEG` of angle of attack (`trims`).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np

from maxq.control.kernel.records import Array
from maxq.design.model.node import Node, node_of
from maxq.design.model.powered import flown_run, loss_of, powered_spans
from maxq.sim.run.fly import FlightRun
from maxq.sim.scenario.loader import LoadedScenario
from maxq.sim.scenario.schema_vehicle import Stage
from maxq.sim.vehicle.engine.burn import Burn, stage_burns, when_spent_s

NODES_PER_STAGE = 11
FULL = 0.5  # fraction of a stage's largest thrust at the ends of full thrust
EDGES = 0.005, 0.015  # fractions of a span at its ends without operating points
MEASURED_EDGES = 0.05, 0.02  # those of a certificate, which needs thrust before and after a point
JOINT = 0.002  # largest such fraction at a separation (boosters, fairing) through which the stage continues to burn
LONG_TAIL_S = 1.0  # shortest tail-off with operating points
LEAST_SHARE = 0.1  # fraction of the largest thrust at the last operating point of a tail-off
TAIL_POINTS = 3  # operating points under full thrust for each one in the tail-off
TRIMMED_DEG = 5.0  # angle of attack that the gimbals must trim in a tail-off
ENDS = ("apogee", "impact")  # events after which a flight is not examined


def node_times(
    scenario: LoadedScenario, count: int = NODES_PER_STAGE, stage: int | None = None, edges: tuple[float, float] = EDGES
) -> tuple[float, ...]:
    """Return times of operating points that suit a flight.

    There are `count` points in each burn of a stage under full thrust, and further points in a long tail-off. `stage`
    restricts the times to one stage. Under full thrust they are evenly spaced, and a single point is in the middle.
    `edges` are the distances of the first and last point from the ends of full thrust, relative to its duration. They
    are at most `JOINT` at a separation through which the stage continues to burn. See `tail_off_times` for the
    tail-off. Stages with fixed engines are omitted. Raises ValueError if no stage remains.
    """
    times, tails = list[float](), dict[int, list[float]]()
    stages = scenario.vehicle.stage
    burns = stage_burns(stages, scenario.scenario.fault)
    spans = powered_spans(scenario)
    for k, span in enumerate(spans):
        mine, burn = stages[span.stage], burns[span.stage]
        if stage in (None, span.stage) and any(engine.gimbal != "fixed" for engine in mine.engines):
            full = full_thrust(mine, burn)
            begin, end = max(span.begin_s, full[0] + span.idle_s), min(span.end_s, full[1] + span.idle_s)
            early, late = edges
            if k > 0 and spans[k - 1].end_s == span.begin_s:
                early = min(early, JOINT)
            if k + 1 < len(spans) and spans[k + 1].begin_s == span.end_s:
                late = min(late, JOINT)
            first, last = begin + early * (end - begin), end - late * (end - begin)
            chosen = np.linspace(first, last, count) if count > 1 else [0.5 * (first + last)]
            times += [round(float(t), 3) for t in chosen]
            if count > 1:
                tail_s = tail_off_times(mine, burn, span.end_s - span.idle_s, count)
                tails[span.stage] = [round(t + span.idle_s, 3) for t in tail_s]
    if not times:
        which = "no stage" if stage is None else f"stage {stage + 1} not"
        raise ValueError(f"{scenario.label}: {which} under thrust by movable engines; there is no operating point")
    return tuple(sorted(times + with_authority(scenario, tails)))


def full_thrust(stage: Stage, burn: Burn) -> tuple[float, float]:
    """Return the first and last vehicle time (s) at which the tabulated thrust is at least half of its largest value.

    Only the rows of the tables are examined (`_gimballed_thrust`).
    """
    times, thrust = _gimballed_thrust(stage)
    if len(times) == 1:
        return -math.inf, math.inf
    begin, end = times[thrust >= FULL * np.max(thrust)][[0, -1]].tolist()
    return _vehicle_time_s(stage, burn, begin), _vehicle_time_s(stage, burn, end)


def tail_off_times(stage: Stage, burn: Burn, end_s: float, count: int) -> list[float]:
    """Return the vehicle times (s) of operating points in a tail-off of at least `LONG_TAIL_S` that ends at `end_s`.

    There is one point for each `TAIL_POINTS` of `count`, rounded up. The thrust decreases by the same factor from half
    of the largest to the first point, and from each point to the next. It is `LEAST_SHARE` of the largest at the last
    point.
    """
    full_end_s = full_thrust(stage, burn)[1]
    if not end_s - full_end_s >= LONG_TAIL_S:
        return []
    times, thrust = _gimballed_thrust(stage)
    points = math.ceil(count / TAIL_POINTS)
    out = []
    for n in range(1, points + 1):
        least = FULL * (LEAST_SHARE / FULL) ** (n / points) * float(np.max(thrust))
        k = int(np.flatnonzero(thrust >= least)[-1])
        if k + 1 < len(times):
            spent_s = times[k] + (times[k + 1] - times[k]) * (thrust[k] - least) / (thrust[k] - thrust[k + 1])
            out.append(round(_vehicle_time_s(stage, burn, float(spent_s)), 3))
    return [t for t in sorted(set(out)) if full_end_s < t < end_s]


def with_authority(scenario: LoadedScenario, times_s: Mapping[int, Sequence[float]]) -> list[float]:
    """Return those of the given times, by stage from 0, that precede the loss of control authority in their stage.

    The flight has no faults.
    """
    out, lost = list[float](), set[int]()
    if not any(times_s.values()):
        return out
    run = flown_run(scenario, faults=False)
    for time_s, stage in sorted((t, n) for n, mine in times_s.items() for t in mine):
        if stage in lost:
            continue
        if not flies_to(run, time_s):
            break
        node = node_of(run.packed, run.now_s, stage)
        if node.axial_load_mps2 > 0.0 and trims(node):
            out.append(time_s)
        else:
            lost.add(stage)
    return out


def trims(node: Node) -> bool:
    """Return True if the gimbals trim `TRIMMED_DEG` of angle of attack.

    In trim, the moment of the deflected engines balances the aerodynamic moment, M_delta delta = -M_alpha alpha.
    """
    d = node.derivatives
    return abs(d.m_delta_1ps2) * node.angle_limit_rad >= d.m_alpha_1ps2 * math.radians(TRIMMED_DEG)


def flies_to(run: FlightRun, time_s: float) -> bool:
    """Continue the flight to the step nearest to a time. Return False if the flight or its examined part has ended."""
    step_ns = int(run.packed.parameters[0].timeline.step_ns)
    at_ns = round(time_s * 1e9 / step_ns) * step_ns
    while not run.finished and round(run.now_s * 1e9) < at_ns:
        run.fly_segment(at_ns)
    events = () if run.finished else run.events
    return not run.finished and loss_of(events) is None and not any(event.name in ENDS for event in events)


def thrust_share(stage: Stage, burn: Burn, time_s: float) -> float:
    """Return the thrust of the gimballed engines at a vehicle time, relative to its largest value."""
    times, thrust = _gimballed_thrust(stage)
    if len(times) == 1:
        return 1.0
    at = [_vehicle_time_s(stage, burn, float(t)) for t in times]
    return float(np.interp(time_s, at, thrust) / np.max(thrust))


def _gimballed_thrust(stage: Stage) -> tuple[Array, Array]:
    """Return times on the table clock, and the vacuum thrust of the gimballed engines at these times.

    Gimballed engines of boosters count only if the core has none, since boosters burn out before they separate. A table
    with one row is a constant thrust and gives a single time.
    """
    moved = [engine for engine in stage.own_engines if engine.gimbal != "fixed"]
    tables = [engine.table for engine in moved or [e for e in stage.engines if e.gimbal != "fixed"] or stage.engines]
    if any(len(table) == 1 for table in tables):
        return np.zeros(1), np.ones(1)
    times = np.unique(np.concatenate([table["time_s"] for table in tables]))
    thrust = sum(np.interp(times, table["time_s"], table["thrust_vacuum_N"], right=0.0) for table in tables)
    return times, np.asarray(thrust)


def _vehicle_time_s(stage: Stage, burn: Burn, table_s: float) -> float:
    return burn.start_s + when_spent_s(stage, burn, table_s)
