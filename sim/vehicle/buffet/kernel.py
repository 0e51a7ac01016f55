"""Buffet: random lateral forces of the separated flow at stations, with given spectra over Mach number.

The force at a station along y, and that along z, is a stationary Gaussian process without correlation to any other. It
is a cubic B-spline over ticks of T whose coefficients are white noise behind a symmetric digital filter (packing.py):

    f(t) = q sum_n c_n B(t/T - n),     c_n = sum_m h_m(Mach) w_(n-m),

with the dynamic pressure q, or 1. The noise w is counter-based, so that the force is a function of time, Mach number
and q alone: twice differentiable within a step, and the same for any step. Filters of adjacent Mach numbers filter the
same noise, and their outputs are interpolated.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated, NamedTuple

from maxq.control.kernel.jit import kernel, rare_routine, routine
from maxq.control.kernel.limits import MAX_BUFFETS
from maxq.control.kernel.noise import standard_normal
from maxq.control.kernel.records import Array
from maxq.control.kernel.rows import PitchYaw
from maxq.sim.vehicle import schedule as sch
from maxq.sim.vehicle.block import Sizes, counts
from maxq.sim.vehicle.modes.planar import Modes, apply_gimbal_load
from maxq.sim.vehicle.modes.spatial import outer_spatial_load

BUFFET_STREAM = 64  # streams of the noise generator: two per station, for the forces along z and y
HALF = 256  # taps on each side of a filter's centre
_RING = 1024  # stored random numbers of each force; a power of two, at least 2 HALF + 4
_FORCES = 2 * MAX_BUFFETS


@dataclass(frozen=True)
class Buffet:
    """The buffet of a stage; `mach` and `taps` are places in the pool."""

    seed: int
    tick_ns: int
    rows: int  # number of Mach numbers
    mach: int
    taps: int
    per_pressure: int  # 1: the forces are multiplied by the dynamic pressure
    factor: float
    station_m: Annotated[Array, (MAX_BUFFETS,)]


@dataclass
class BuffetWork:
    """The noise about the present tick, which repeated evaluations use again.

    `seed`, `tick_ns`, `forces` and `taps` identify the process. `noise` contains the random numbers from the index
    `oldest` to `drawn`, and `spline` four coefficients for each force and each of two Mach numbers.
    """

    seed: int
    tick_ns: int
    forces: int  # 0: nothing is stored
    taps: int
    oldest: int
    drawn: int
    tick: int
    row: int  # index of the lower Mach number
    noise: Annotated[Array, (_RING * _FORCES,)]
    spline: Annotated[Array, (8 * _FORCES,)]
    load: Annotated[Array, (6,)]  # sum of force and moment about the core CG, B


@rare_routine
def buffet_loads(
    b: Buffet,
    of: Sizes,
    pool: Array,
    now_ns: int,
    elapsed_s: float,
    mach: float,
    pressure_Pa: float,
    properties: Array,
    modes: Modes,
    work: BuffetWork,
    forces_N: Array,
) -> None:
    """Write the forces (along z, along y at each station) to `forces_N`, and their sum and moment to `work.load`.

    The loads are also added to the generalised forces of the modes. The instant is `elapsed_s` after `now_ns`;
    `pressure_Pa` is the dynamic pressure.
    """
    sizes = counts(of)
    _process(b, 2 * sizes.buffets, pool, now_ns, elapsed_s, mach, work, forces_N)
    scale = b.factor * (pressure_Pa if b.per_pressure == 1 else 1.0)
    for j in range(6):
        work.load[j] = 0.0
    for s in range(sizes.buffets):
        forces_N[2 * s] *= scale
        forces_N[2 * s + 1] *= scale
        z, y, arm = forces_N[2 * s], forces_N[2 * s + 1], properties[sch.CORE_CG] - b.station_m[s]
        gimbal, load = sch.first_acted(sizes) + sizes.feed_lines + s, (0.0, y, z, 0.0, 0.0, 0.0)
        apply_gimbal_load(sizes, properties, gimbal, load, modes.planar.force_N)
        if sizes.spatial_modes > 0:
            moved = outer_spatial_load(sizes, properties, sch.gimbal_place(sizes, gimbal), load, modes.spatial)
            for j in range(3):
                work.load[3 + j] += moved[j]
        work.load[1] += y
        work.load[2] += z
        work.load[3] += properties[sch.CORE_CG + 2] * y - properties[sch.CORE_CG + 1] * z
        work.load[4] -= arm * z
        work.load[5] += arm * y


@routine
def _process(
    b: Buffet, forces: int, pool: Array, now_ns: int, elapsed_s: float, mach: float, work: BuffetWork, out: Array
) -> None:
    """Write the value of each process to `out`."""
    tick = now_ns // b.tick_ns
    u = (1e-9 * (now_ns - tick * b.tick_ns) + elapsed_s) / (1e-9 * b.tick_ns)
    later = math.floor(u)
    tick, u = tick + later, u - later
    row, share = 0, 0.0
    for k in range(b.rows - 1):
        low, high = pool[b.mach + k], pool[b.mach + k + 1]
        if mach >= low:
            row, share = k, min((mach - low) / (high - low), 1.0)
    known = work.seed == b.seed and work.tick_ns == b.tick_ns and work.forces == forces and work.taps == b.taps
    if not known or tick != work.tick or row != work.row:
        next_one = known and row == work.row and tick == work.tick + 1
        if not known:
            work.seed, work.tick_ns, work.forces, work.taps = b.seed, b.tick_ns, forces, b.taps
            work.oldest, work.drawn = tick, tick
        work.tick, work.row = tick, row
        _draw(b, forces, tick, work)
        _filter(b, forces, pool, next_one, work)
    rest, cube = 1.0 - u, u * u * u
    b_0, b_1 = rest * rest * rest / 6.0, (3.0 * cube - 6.0 * u * u + 4.0) / 6.0
    b_3 = cube / 6.0
    b_2 = 1.0 - b_0 - b_1 - b_3
    for k in range(forces):
        c = 8 * k
        low = b_0 * work.spline[c] + b_1 * work.spline[c + 1] + b_2 * work.spline[c + 2] + b_3 * work.spline[c + 3]
        c += 4
        high = b_0 * work.spline[c] + b_1 * work.spline[c + 1] + b_2 * work.spline[c + 2] + b_3 * work.spline[c + 3]
        out[k] = low + share * (high - low)


@kernel
def _draw(b: Buffet, forces: int, tick: int, work: BuffetWork) -> None:
    """Draw the random numbers from tick - 1 - HALF to tick + 2 + HALF that are not stored."""
    first, last = tick - 1 - HALF, tick + 2 + HALF
    if first < work.oldest or first > work.drawn + 1:
        work.oldest, work.drawn = first, first - 1
    for index in range(work.drawn + 1, last + 1):
        for k in range(forces):
            work.noise[_RING * k + (index & (_RING - 1))] = standard_normal(b.seed, BUFFET_STREAM + k, index)
    work.drawn = max(work.drawn, last)
    work.oldest = max(work.oldest, work.drawn - _RING + 1)


@kernel
def _filter(b: Buffet, forces: int, pool: Array, next_one: bool, work: BuffetWork) -> None:
    """Compute the coefficients of the splines at four ticks, of which three are known if the tick is the next one."""
    above = min(work.row + 1, b.rows - 1)
    for k in range(forces):
        for at in range(2):
            c, row = 8 * k + 4 * at, work.row if at == 0 else above
            taps, first = b.taps + (row * (forces // 2) + k // 2) * (HALF + 1), 0
            if next_one:
                work.spline[c], work.spline[c + 1], work.spline[c + 2] = (
                    work.spline[c + 1],
                    work.spline[c + 2],
                    work.spline[c + 3],
                )
                first = 3
            for j in range(first, 4):
                centre = work.tick - 1 + j
                total = pool[taps] * work.noise[_RING * k + (centre & (_RING - 1))]
                for m in range(1, HALF + 1):
                    before = work.noise[_RING * k + ((centre - m) & (_RING - 1))]
                    after = work.noise[_RING * k + ((centre + m) & (_RING - 1))]
                    total += pool[taps + m] * (before + after)
                work.spline[c + j] = total


class BuffetRow(NamedTuple):
    """The logged values of a station of buffet."""

    buffet_place_axis_N: Annotated[PitchYaw, "N", "force along z (pitch) or y (yaw)"]


@kernel
def buffet_row(buffets: int, station: int, forces_N: Array) -> BuffetRow:
    """Return the row of a station; the values are nan for a station that the stage does not have."""
    if station >= buffets:
        return BuffetRow(PitchYaw(math.nan, math.nan))
    return BuffetRow(buffet_place_axis_N=PitchYaw(forces_N[2 * station], forces_N[2 * station + 1]))
