"""Injected signals: added to a command of the computer, to the loads on the body, or to the thrust.

Signals in the gimbal or rate command are evaluated at the computer's samples. Signals switch on and off only at step
boundaries, because the flight loop splits its steps there. Body loads and thrust are evaluated at every stage of a
step, so that a smooth signal preserves the integrator's order.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated

from maxq.control.kernel.jit import kernel, routine
from maxq.control.kernel.limits import MAX_INJECTIONS, MAX_TONES
from maxq.control.kernel.records import Array, IntArray
from maxq.control.kernel.tables import TableRef, find_interval, interpolate

GIMBAL_COMMAND, RATE_COMMAND, BODY_FORCE, BODY_TORQUE, THRUST = range(5)  # where a signal acts
STEP, DOUBLET, SINE, CHIRP, MULTISINE, TABLE = range(6)  # form of a signal


@dataclass(frozen=True)
class Injections:
    """The parameters of the injected signals.

    `axis`: 0 roll or x, 1 pitch or y, 2 yaw or z. `amplitude`: SI units (rad, rad/s, N, N m; 1 for the thrust).
    """

    count: int
    where: Annotated[IntArray, (MAX_INJECTIONS,)]
    axis: Annotated[IntArray, (MAX_INJECTIONS,)]
    form: Annotated[IntArray, (MAX_INJECTIONS,)]
    replaces: Annotated[IntArray, (MAX_INJECTIONS,)]
    start_ns: Annotated[IntArray, (MAX_INJECTIONS,)]
    stop_ns: Annotated[IntArray, (MAX_INJECTIONS,)]
    amplitude: Annotated[Array, (MAX_INJECTIONS,)]
    frequency_hz: Annotated[Array, (MAX_INJECTIONS,)]
    stop_frequency_hz: Annotated[Array, (MAX_INJECTIONS,)]
    tones: Annotated[IntArray, (MAX_INJECTIONS,)]
    tone_hz: Annotated[Array, (MAX_INJECTIONS, MAX_TONES)]
    tone_phase: Annotated[Array, (MAX_INJECTIONS, MAX_TONES)]
    column: Annotated[IntArray, (MAX_INJECTIONS,)]  # column of `table`, for the form TABLE
    table: TableRef


@routine
def signal(inj: Injections, pool: Array, i: int, step_start_ns: int, elapsed_s: float) -> float:
    """Return the value of signal `i`, `elapsed_s` after the start of a step; zero if it is off in that step."""
    if step_start_ns < inj.start_ns[i] or step_start_ns >= inj.stop_ns[i]:
        return 0.0
    form, amplitude = inj.form[i], float(inj.amplitude[i])
    since = 1e-9 * (step_start_ns - inj.start_ns[i]) + elapsed_s
    if form == STEP:
        return amplitude
    if form == DOUBLET:
        middle = (inj.start_ns[i] + inj.stop_ns[i]) // 2
        return amplitude if step_start_ns < middle else -amplitude
    if form == SINE:
        return amplitude * math.sin(2.0 * math.pi * inj.frequency_hz[i] * since)
    if form == CHIRP:
        duration = 1e-9 * (inj.stop_ns[i] - inj.start_ns[i])
        sweep = 0.5 * (inj.stop_frequency_hz[i] - inj.frequency_hz[i]) / duration
        return amplitude * math.sin(2.0 * math.pi * (inj.frequency_hz[i] + sweep * since) * since)
    if form == MULTISINE:
        total = 0.0
        for j in range(inj.tones[i]):
            total += math.sin(2.0 * math.pi * inj.tone_hz[i, j] * since + inj.tone_phase[i, j])
        return amplitude * total
    k = find_interval(pool, inj.table, 1e-9 * step_start_ns)
    return amplitude * interpolate(pool, inj.table, k, 1e-9 * step_start_ns + elapsed_s, inj.column[i])


@routine
def total_signal(inj: Injections, pool: Array, where: int, axis: int, step_start_ns: int, elapsed_s: float) -> float:
    """Return the sum of the signals that act at one place on one axis."""
    total = 0.0
    for i in range(inj.count):
        if inj.where[i] == where and inj.axis[i] == axis:
            total += signal(inj, pool, i, step_start_ns, elapsed_s)
    return total


@kernel
def replaced(inj: Injections, where: int, axis: int, now_ns: int) -> int:
    """Return 1 if a signal replaces the value at its place at this instant, otherwise 0."""
    for i in range(inj.count):
        if inj.where[i] == where and inj.axis[i] == axis and inj.replaces[i] == 1:
            if inj.start_ns[i] <= now_ns < inj.stop_ns[i]:
                return 1
    return 0


@routine
def next_switch(inj: Injections, pool: Array, now_ns: int, latest_ns: int) -> int:
    """Return the first instant after `now_ns`, at most `latest_ns`, at which a signal or its slope jumps."""
    best = latest_ns
    for i in range(inj.count):
        middle = (inj.start_ns[i] + inj.stop_ns[i]) // 2
        for instant in (inj.start_ns[i], middle, inj.stop_ns[i]):
            if now_ns < instant < best:
                best = instant
        if inj.form[i] == TABLE:
            k = find_interval(pool, inj.table, 1e-9 * (now_ns + 1))
            for j in range(k, min(k + 2, inj.table.n_breaks)):
                instant = round(1e9 * pool[inj.table.offset + j])
                if now_ns < instant < best:
                    best = instant
    return best
