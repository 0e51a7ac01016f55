"""Feed lines: oscillations of flow, pressure and thrust that couple with axial modes (pogo).

The states of a line are deviations from the quasi-steady flow, which the thrust table contains. They are the flow q of
the line, pressure p and flow w of the pump, and the line's part c of the chamber pressure. With the deviation a of the
axial acceleration of the tank's bottom,

    I q' = H a - R q - p,    C p' = q - w - M q',    J w' = G p - D w - sum c,    T c' = Z w - c,

summed over the lines of the engine (docs/model.md, 8.6; S. Rubin, Longitudinal Instability of Liquid Rockets Due
to Propulsion Feedback (POGO), J. Spacecraft 3, 1966; B. W. Oppenheim & S. Rubin, Advanced Pogo Stability Analysis for
Liquid Rockets, J. Spacecraft 30, 1993). The thrust deviates by K c. The force A (p + R q) of the pressures on the cross
section A of the line pushes the engine aft.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated, Any, NamedTuple

from maxq.control.kernel.jit import kernel, rare_routine
from maxq.control.kernel.limits import MAX_ENGINES
from maxq.control.kernel.records import Array
from maxq.control.kernel.tables import TableRef
from maxq.sim.vehicle import schedule as sch
from maxq.sim.vehicle.block import Sizes, StateBlock, counts
from maxq.sim.vehicle.modes.planar import Modes
from maxq.sim.vehicle.modes.spatial import spatial_motion
from maxq.sim.vehicle.schedule import (
    FEED_CHAMBER,
    FEED_COMPLIANCE,
    FEED_DISCHARGE_INERTANCE,
    FEED_DISCHARGE_RESISTANCE,
    FEED_FLOW_GAIN,
    FEED_HEAD,
    FEED_INERTANCE,
    FEED_PUMP_GAIN,
    FEED_RESISTANCE,
)

FEED_LINES = StateBlock(
    {"feed_{}_flow_kgps": "kg/s", "feed_{}_inlet_Pa": "Pa", "feed_{}_pump_kgps": "kg/s", "feed_{}_chamber_Pa": "Pa"},
    "feed_lines",
)
FLOW, INLET, PUMP, CHAMBER = range(4)
N_FEED = len(FEED_LINES.states)


@dataclass(frozen=True)
class FeedLine:
    chamber: int  # number of the engine in the stage
    engine: int  # index of the engine's record, which may represent several engines
    table: TableRef  # over the schedule's clock, columns of `schedule.FEED_HEAD` and following
    chamber_lag_s: float
    thrust_gain_m2: float
    area_m2: float


@dataclass
class FeedWork:
    """The forces of the feed lines on the engines in one evaluation of the derivative."""

    thrust_N: Annotated[Array, (MAX_ENGINES,)]  # deviation of the thrust
    push_N: Annotated[Array, (MAX_ENGINES,)]  # forward force of the pressures in the lines
    axial_N: float  # sum of both over the burning engines
    burns: Annotated[Array, (MAX_ENGINES,)]  # 1: the engine has thrust


@rare_routine
def feed_forces(lines: Any, of: Sizes, properties: Array, y: Array, first: int, work: FeedWork) -> None:
    """Write the forces on each engine, for lines whose states begin at y[first]."""
    sizes = counts(of)
    for k in range(sizes.engines):
        work.thrust_N[k], work.push_N[k], work.burns[k] = 0.0, 0.0, 0.0
    work.axial_N = 0.0
    for n in range(sizes.feed_lines):
        line, i, c = lines[n], first + N_FEED * n, sch.feed_column(sizes, n)
        work.thrust_N[line.engine] += line.thrust_gain_m2 * y[i + CHAMBER]
        pressure = y[i + INLET] + properties[c + FEED_RESISTANCE] * y[i + FLOW]
        work.push_N[line.engine] -= line.area_m2 * pressure


@kernel
def thrust_with_feed(thrust_N: float, k: int, work: FeedWork) -> tuple[float, float]:
    """Return thrust and push of engine k; both are zero without thrust."""
    if thrust_N <= 0.0:
        return 0.0, 0.0
    work.burns[k] = 1.0
    work.axial_N += work.thrust_N[k] + work.push_N[k]
    return thrust_N + work.thrust_N[k], work.push_N[k]


@rare_routine
def feed_derivative(
    lines: Any,
    of: Sizes,
    accel_mps2: float,
    properties: Array,
    y: Array,
    first: int,
    dy: Array,
    modes: Modes,
    work: FeedWork,
) -> None:
    """Write the derivatives of the lines, once the accelerations are known.

    `accel_mps2` is the axial acceleration of the rigid body less its quasi-steady value. The deviations of an engine
    without thrust decay.
    """
    sizes = counts(of)
    for n in range(sizes.feed_lines):
        line, i, c = lines[n], first + N_FEED * n, sch.feed_column(sizes, n)
        if work.burns[line.engine] == 0.0:
            for j in range(N_FEED):
                dy[i + j] = -y[i + j] / line.chamber_lag_s
            continue
        accel, back = accel_mps2, 0.0
        if sizes.spatial_modes > 0:
            place = sch.gimbal_place(sizes, sch.first_acted(sizes) + n)
            accel += spatial_motion(sizes, properties, place, modes.spatial.accel_mps2)[0]
        for other in range(sizes.feed_lines):
            if lines[other].chamber == line.chamber:
                back += y[first + N_FEED * other + CHAMBER]
        flow, inlet, pump, chamber = y[i + FLOW], y[i + INLET], y[i + PUMP], y[i + CHAMBER]
        driven = properties[c + FEED_HEAD] * accel - properties[c + FEED_RESISTANCE] * flow - inlet
        dy[i + FLOW] = driven / properties[c + FEED_INERTANCE]
        stored = flow - pump - properties[c + FEED_FLOW_GAIN] * dy[i + FLOW]
        dy[i + INLET] = stored / properties[c + FEED_COMPLIANCE]
        lifted = properties[c + FEED_PUMP_GAIN] * inlet - properties[c + FEED_DISCHARGE_RESISTANCE] * pump - back
        dy[i + PUMP] = lifted / properties[c + FEED_DISCHARGE_INERTANCE]
        dy[i + CHAMBER] = (properties[c + FEED_CHAMBER] * pump - chamber) / line.chamber_lag_s


class FeedRow(NamedTuple):
    """The logged values of a feed line."""

    feed_line_flow_kgps: Annotated[float, "kg/s", "deviation of the flow from the tank"]
    feed_line_inlet_Pa: Annotated[float, "Pa", "deviation of the pressure at the pump"]
    feed_line_pump_kgps: Annotated[float, "kg/s", "deviation of the pump's flow"]
    feed_line_chamber_Pa: Annotated[float, "Pa", "deviation of the chamber pressure due to this line"]


@kernel
def feed_row(feed_lines: int, line: int, y: Array, first: int) -> FeedRow:
    """Return the row of a line; the values are nan for a line that the stage does not have."""
    if line >= feed_lines:
        return FeedRow(math.nan, math.nan, math.nan, math.nan)
    i = first + N_FEED * line
    return FeedRow(y[i + FLOW], y[i + INLET], y[i + PUMP], y[i + CHAMBER])
