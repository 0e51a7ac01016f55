"""What a step costs part by part: each kernel in a loop of its own, on the state of a flight stopped
half-way.

Every turn of the loop changes the state by what the turn before has computed: so the compiler cannot move a
part's work out of the loop, and the core cannot begin a turn before the last one has ended. What is
measured is how long a part keeps a chain of operations waiting; the parts do not add up to the whole
exactly, as some of them overlap there.
"""

from __future__ import annotations

import json
import time
from dataclasses import dataclass
from typing import Any

import numpy as np

from maxq.control.computer import computer_tick
from maxq.control.kernel.jit import borrowed, entry
from maxq.control.kernel.records import Array
from maxq.control.kernel.vectors import rotation_from_quaternion
from maxq.sim.flight.arena import ARENA_SIZE, lend
from maxq.sim.flight.events import fault, meet_instants, step_length, watch
from maxq.sim.flight.loop import crossed
from maxq.sim.flight.metrics import gather
from maxq.sim.flight.parameters import NEVER
from maxq.sim.flight.step import evaluate, read_schedule, runge_kutta
from maxq.sim.run.fly import FlightRun
from maxq.sim.vehicle.actuator import actuator_derivative
from maxq.sim.vehicle.bending import elastic_forces, gyroscopic_forces
from maxq.sim.vehicle.derivative import aerodynamics, move_engine, push_of_thrust
from maxq.sim.vehicle.gyro import gyro_derivative
from maxq.sim.vehicle.rigid import coriolis_of_outflow, engine_reaction, kinematics
from maxq.sim.vehicle.schedule import TOTAL_MASS
from maxq.sim.vehicle.slosh import hang, swing_derivative
from maxq.sim.vehicle.solve import accelerate
from maxq.sim.vehicle.state import (
    ACTUATOR,
    GYRO,
    N_ACTUATOR,
    Q_BI,
    R_I,
    V_I,
    W_BI_B,
    counts,
    pendulum_index,
)
from maxq.sim.vehicle.surroundings import surroundings
from maxq.sim.vehicle.workspace import ALTITUDE, FELT
from maxq.sim.world.atmosphere import air
from maxq.sim.world.earth import gravitation, local_frame
from maxq.tools.dev.bench.midflight import scenario, stopped_flight

TURNS = 100_000
REPETITIONS = 5
TANKS = 2  # of the nominal vehicle


@dataclass(frozen=True)
class Part:
    """A loop of `repeat_part`: its name, how often a step calls it, and whether another line contains it."""

    name: str
    calls: float
    within: str = ""
    less: int = 0  # number of a part that its loop has to run before, which is taken off


PARTS = (
    Part("loop alone", 0.0),
    Part("evaluate: one derivative", 4.0),
    Part("surroundings: gravity, air, wind, flow", 4.0, "evaluate"),
    Part("gravitation with J2", 4.0, "surroundings"),
    Part("local frame on the ellipsoid", 4.0, "surroundings"),
    Part("air, US 1976", 4.0, "surroundings"),
    Part("engine angles and mass properties", 4.0, "evaluate"),
    Part("aerodynamics", 4.0, "evaluate"),
    Part("thrust on the bent body", 4.0, "evaluate", less=6),
    Part("bending: elastic and gyroscopic forces", 4.0, "evaluate"),
    Part("a pendulum's block", 4.0 * TANKS, "evaluate"),
    Part("coupled accelerations", 4.0, "evaluate", less=6),
    Part("a pendulum's derivative", 4.0 * TANKS, "evaluate"),
    Part("actuators and gyros", 4.0, "evaluate"),
    Part("schedule: all columns at an instant", 2.0),
    Part("Runge-Kutta: three derivatives, two schedules, sums", 1.0),
    Part("instants due now", 1.0),
    Part("events seen at a step's start", 1.0),
    Part("length of the next step", 1.0),
    Part("metrics", 1.0),
    Part("is the state sane", 1.0),
    Part("events crossed", 1.0),
    Part("flight computer, one sample", 0.1),
    Part("engine reaction, jet damping", 4.0, "evaluate", less=6),
    Part("motion of the rigid body", 4.0, "evaluate"),
)


@entry
def repeat_part(P: Array, pool: Array, state: Array, y: Array, arena: Array, turns: int, part: int) -> float:
    """Run part number `part` `turns` times; returns a number that depends on all of them."""
    p, memory = P[0], state[0]
    v, around, held = p.vehicle, p.around, memory.held
    sizes = counts(v.sizes)
    now = memory.clock.now_ns
    pool, y = borrowed(pool), borrowed(y)
    y_end, y_stage, k_1, k, props, props_middle, props_end, work, aux, aux_stage = lend(arena)
    read_schedule(p, pool, memory, now, 0.0, props)
    evaluate(p, pool, memory, now, 0.0, props, y, k_1, work, aux)
    felt = (aux[FELT], aux[FELT + 1], aux[FELT + 2])
    r, v_I, w, slack = y[R_I], y[V_I], y[W_BI_B], y[ACTUATOR + 2]
    answer = pendulum_index(sizes, 0) + 3
    total = 0.0
    for _ in range(turns):
        last = 1e-30 * total
        y[R_I], y[V_I], y[W_BI_B], y[ACTUATOR + 2] = r + last, v_I + last, w + last, slack + last
        rate = (y[W_BI_B], y[W_BI_B + 1], y[W_BI_B + 2])
        if part == 1:
            evaluate(p, pool, memory, now, 0.0, props, y, k_1, work, aux)
        elif part == 2:
            rotation = rotation_from_quaternion(y[Q_BI], y[Q_BI + 1], y[Q_BI + 2], y[Q_BI + 3])
            total += surroundings(around, pool, memory.gusts, held.turbulence_phase, rotation, y, work, aux)[0]
        elif part == 3:
            total += gravitation(around.earth, y[R_I], y[R_I + 1], y[R_I + 2])[0]
        elif part == 4:
            total += local_frame(around.earth, y[R_I], y[R_I + 1], y[R_I + 2])[0]
        elif part == 5:
            total += air(around.atmosphere, pool, aux[ALTITUDE] + last)[0]
        elif part == 6:
            total += move_engine(v, sizes, held, props, y, aux).axis[0]
        elif part == 7:
            rotation = rotation_from_quaternion(y[Q_BI], y[Q_BI + 1], y[Q_BI + 2], y[Q_BI + 3])
            total += aerodynamics(v, sizes, around, pool, held, rotation, rate, props, work, aux)[0][0]
        elif part == 8:
            engine = move_engine(v, sizes, held, props, y, aux)
            total += push_of_thrust(v, sizes, engine, props, work, aux)[0][0]
        elif part == 9:
            e = v.engine
            total += gyroscopic_forces(
                sizes, props, rate, e.gimballed_mass_kg, e.cg_from_gimbal_m, e.inertia_kgm2,
                (0.0, 0.01, 0.01), 0.1, 0.1, work,
            )[0]  # fmt: skip
            total += elastic_forces(v.bending, sizes, props, felt[0], work)
        elif part == 10:
            total += hang(v.slosh, sizes, 0, rate, felt[0], felt, props, y, work)[0][0]
        elif part == 11:
            engine = move_engine(v, sizes, held, props, y, aux)
            total += accelerate(
                v.slosh, sizes, 0, engine.offset, engine.inverse_inertia, felt, felt, felt, props, y, work,
            )[0][0]  # fmt: skip
        elif part == 12:
            swing_derivative(v.slosh, sizes, 0, rate, felt, felt, props, y, k_1, work)
        elif part == 13:
            actuator_derivative(v.actuator_pitch, y, ACTUATOR, held.command_pitch_rad, k_1)
            actuator_derivative(v.actuator_yaw, y, ACTUATOR + N_ACTUATOR, held.command_yaw_rad, k_1)
            gyro_derivative(v.gyro, y, rate, k_1)
        elif part == 14:
            read_schedule(p, pool, memory, now, last, props_end)
            total += props_end[TOTAL_MASS]
        elif part == 15:
            runge_kutta(
                p,
                pool,
                memory,
                now,
                1_000_000,
                y,
                k_1,
                y_end,
                y_stage,
                k,
                props_middle,
                props_end,
                work,
                aux_stage,
            )
        elif part == 16:
            total += meet_instants(p, pool, memory, y, aux)
        elif part == 17:
            watch(p, memory, y, aux)
        elif part == 18:
            total += step_length(p, pool, memory, NEVER)
        elif part == 19:
            gather(memory.extremes, v, around.earth, held, memory.computer, now, 0.0, props, y, aux)
        elif part == 20:
            total += fault(p, y)
        elif part == 21:
            total += crossed(p, memory, y, props, aux)
        elif part == 22:
            computer_tick(
                p.computer, pool, memory.computer, 1e-9 * now, memory.increment_rad,
                memory.rate_injection_radps, memory.rate_replaces, memory.gimbal_injection_rad,
                memory.gimbal_replaces,
            )  # fmt: skip
        elif part == 23:
            engine = move_engine(v, sizes, held, props, y, aux)
            total += engine_reaction(v.engine, engine, rate, felt[0])[0][1]
            total += coriolis_of_outflow(sizes, rate, props)[1][1]
        elif part == 24:
            rotation = rotation_from_quaternion(y[Q_BI], y[Q_BI + 1], y[Q_BI + 2], y[Q_BI + 3])
            kinematics(around.earth, 0, rotation, rate, felt, felt, felt, props, y, k_1)
            total += k_1[Q_BI] + k_1[V_I]
        if part in (1, 12, 13):
            total += k_1[answer] + k_1[GYRO + 1]
        elif part == 15:
            total += y_end[V_I]
        elif part == 22:
            total += memory.computer.command_rad[0]
    y[R_I], y[V_I], y[W_BI_B], y[ACTUATOR + 2] = r, v_I, w, slack
    return total


def _seconds(run: FlightRun, part: int, turns: int) -> float:
    """Shortest CPU time of a loop; every repetition begins with the same memory."""
    packed, arena = run.packed, np.zeros(ARENA_SIZE)
    best = float("inf")
    for _ in range(REPETITIONS):
        state, memory = packed.state.copy(), packed.memory.copy()
        start = time.process_time()
        repeat_part(packed.parameters, packed.pool, memory, state, arena, turns, part)
        best = min(best, time.process_time() - start)
    return best


def _flown_ns_per_step() -> float:
    """CPU time per step of whole powered flights, the shortest of a few."""
    loaded, best = scenario(), float("inf")
    for _ in range(REPETITIONS):
        run = FlightRun(loaded, log=False)
        start = time.process_time()
        while not run.finished:
            run.fly_segment(10**12)
        best = min(best, (time.process_time() - start) / int(run.memory.clock.steps))
    return 1e9 * best


def measure(turns: int = TURNS) -> dict[str, Any]:
    """`parts`: name, `calls` a step, `ns` a call (loop taken off), `within`; `step_ns`: a whole step in
    flight.
    """
    run = stopped_flight()
    repeat_part(run.packed.parameters, run.packed.pool, run.packed.memory.copy(), run.packed.state.copy(),
                np.zeros(ARENA_SIZE), 1, 0)  # fmt: skip
    raw = [1e9 * _seconds(run, number, turns) / turns for number in range(len(PARTS))]
    rows = [
        {"name": part.name, "calls": part.calls, "within": part.within, "ns": round(ns - raw[part.less], 1)}
        for part, ns in zip(PARTS[1:], raw[1:], strict=True)
    ]
    order = {"evaluate": 1, "surroundings": 1, "": 2}
    rows[1:] = sorted(rows[1:], key=lambda row: order[str(row["within"])])
    return {"parts": rows, "loop_ns": round(raw[0], 2), "step_ns": round(_flown_ns_per_step(), 1)}


if __name__ == "__main__":
    print(json.dumps(measure()))
