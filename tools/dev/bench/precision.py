"""The work-precision benchmark: the powered phase through a gust, with RK4 at many step sizes and with DOP853.

The outputs of converter, DAC and roll thrusters are steps. Because the last digit can decide which step is output, a
difference of 1e-12 may become a whole count. These parts are therefore ideal here; the limits remain active.
"""

from __future__ import annotations

import json
import math
import time
from dataclasses import dataclass
from typing import Any

import numpy as np

from maxq.control.kernel.records import Array
from maxq.sim.run.fly import FlightRun
from maxq.sim.scenario.loader import load_scenario
from maxq.sim.vehicle.state import Q_BI, R_I, eta_index, pendulum_index, xi_index
from maxq.tools.dev.bench.adaptive_flight import AdaptiveFlight

NS = 1_000_000_000
END_NS = 59 * NS
EVERY_NS = NS // 10  # interval of the errors: a multiple of the computer's sample, so that no step is cut for it
AFLOAT_NS = 1 * NS  # from here on, after liftoff, DOP853 continues from the fine reference
STEPS_NS = (5_000_000, 4_000_000, 2_000_000, 1_000_000, 500_000, 250_000, 125_000)
FINEST_NS = 62_500
RELATIVE = (1e-3, 1e-6, 1e-10)  # the last is the reference
QUANTITIES = ("attitude_deg", "bending_m", "slosh_deg", "position_m")
CONDITIONS = (
    "run.duration_s=59.0",
    "switches.converter=ideal",
    "switches.roll_control=false",
    "vehicle.computer.dac_step_deg=0.0",
    'wind.gust=[{kind="one-minus-cosine", altitude_m=8000.0, thickness_m=1500.0, edge_m=500.0,'
    " speed_mps=15.0, from_deg=310.0}]",
)


@dataclass
class Course:
    """The states of a flight at every multiple of `EVERY_NS`, by time in ns, and the cost of the flight."""

    states: dict[int, Array]
    evaluations: int
    cpu_s: float
    sizes: Any  # a record of Sizes


def _run(step_ns: int) -> FlightRun:
    return FlightRun(load_scenario("nominal", [*CONDITIONS, f"run.step_s={step_ns / NS!r}"]), log=False)


def _fly(step_ns: int) -> Course:
    """Return the flight with RK4 at this step. A flight before it has compiled the kernels."""
    run = _run(step_ns)
    states, cpu = {}, 0.0
    while not run.finished:
        start = time.process_time()
        run.fly_segment(EVERY_NS)
        cpu += time.process_time() - start
        states[int(run.memory.clock.now_ns)] = run.packed.state.copy()
    return Course(states, 4 * int(run.memory.clock.steps), cpu, run.packed.parameters[0].vehicle.sizes)


def _fly_adaptive(relative: float) -> Course:
    run = _run(FINEST_NS)
    states = {}
    while int(run.memory.clock.now_ns) < AFLOAT_NS:
        run.fly_segment(EVERY_NS)
        states[int(run.memory.clock.now_ns)] = run.packed.state.copy()
    flight = AdaptiveFlight(run, relative)
    start = time.process_time()
    states |= dict(flight.until(END_NS, EVERY_NS))
    return Course(states, flight.evaluations, time.process_time() - start, run.packed.parameters[0].vehicle.sizes)


def _angle_deg(a: Array, b: Array) -> float:
    """Return the angle between two directions, deg, exact also for small angles."""
    a, b = a / np.linalg.norm(a), b / np.linalg.norm(b)
    return math.degrees(2.0 * math.asin(min(0.5 * float(np.linalg.norm(a - b)), 1.0)))


def differences(a: Array, b: Array, sizes: Any) -> dict[str, float]:
    """Return the differences of two states: attitude (angle of rotation), modal coordinates, pendulum angles, and
    position.
    """
    q, p = a[Q_BI : Q_BI + 4], b[Q_BI : Q_BI + 4]
    eta, xi = int(eta_index(sizes)), int(xi_index(sizes))
    modes = [*range(eta, eta + sizes.pitch_modes), *range(xi, xi + sizes.yaw_modes)]
    bobs = [int(pendulum_index(sizes, tank)) for tank in range(sizes.pendulums)]
    return {
        "attitude_deg": 2.0 * min(_angle_deg(q, p), _angle_deg(q, -p)),
        "bending_m": float(np.max(np.abs(a[modes] - b[modes]))),
        "slosh_deg": max(_angle_deg(a[i : i + 3], b[i : i + 3]) for i in bobs),
        "position_m": float(np.linalg.norm(a[R_I : R_I + 3] - b[R_I : R_I + 3])),
    }


def _errors(course: Course, reference: Course) -> dict[str, Any]:
    """Return the errors of a flight at burnout, and the largest errors during the flight."""
    if set(course.states) != set(reference.states):
        raise RuntimeError("two flights were sampled at different times")
    all_of = [differences(course.states[t], reference.states[t], course.sizes) for t in sorted(course.states)]
    return {
        "evaluations_per_s": round(course.evaluations / (END_NS / NS)),
        "cpu_s": round(course.cpu_s, 4),
        "burnout": all_of[-1],
        "largest": {key: max(d[key] for d in all_of) for key in QUANTITIES},
    }


def _sizes_of_motion(course: Course) -> dict[str, float]:
    """Return the largest bending and slosh motion of a flight, for comparison with the errors."""
    sizes, upright = course.sizes, np.array([-1.0, 0.0, 0.0])
    first, bobs = int(eta_index(sizes)), [int(pendulum_index(sizes, k)) for k in range(sizes.pendulums)]
    modes = [first + i for i in range(sizes.pitch_modes)]
    late = [y for t, y in course.states.items() if t > AFLOAT_NS]
    return {
        "bending_m": float(max(np.max(np.abs(y[modes])) for y in late)),
        "slosh_deg": max(_angle_deg(y[i : i + 3], upright) for y in late for i in bobs),
    }


def measure() -> dict[str, Any]:
    """Return the errors and costs of RK4 (`steps`) and of DOP853 (`adaptive`) against the reference.

    The reference is DOP853 with a tight tolerance; `agreement` is the error of RK4 at the finest step.
    """
    reference = _fly_adaptive(RELATIVE[-1])
    return {
        "steps": [{"step_ms": 1e-6 * step, **_errors(_fly(step), reference)} for step in STEPS_NS],
        "adaptive": [{"relative": r, **_errors(_fly_adaptive(r), reference)} for r in RELATIVE[:-1]],
        "agreement": {"step_ms": 1e-6 * FINEST_NS, **_errors(_fly(FINEST_NS), reference)},
        "reference": {
            "relative": RELATIVE[-1],
            "motion": _sizes_of_motion(reference),
            "evaluations_per_s": round(reference.evaluations / (END_NS / NS)),
            "cpu_s": round(reference.cpu_s, 2),
        },
    }


if __name__ == "__main__":
    print(json.dumps(measure()))
