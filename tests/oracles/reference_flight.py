"""Integrate the same flight with another integrator.

SciPy's DOP853 (order eight, adaptive, tight tolerance) integrates the flight's derivative from instant to instant. The
flight's kernels process samples, commands, ignition and burnout, so that only the integration differs: step size,
method, and normalisation of the quaternion and pendulums. Limits: liftoff by thrust, apogee and impact are not located;
start in flight, or release at a given time.
"""

from __future__ import annotations

import numpy as np
from flightkit import Rig, meet
from scipy.integrate import solve_ivp

from maxq.control.kernel.records import Array

LONG_STEP_NS = 10**12  # no step of the simulator's own between two instants


def fly(made: Rig, duration_s: float, tolerance: float = 1e-11) -> Array:
    """Return the state (n,) after `duration_s`, at which `made` also ends.

    `tolerance` is relative, and absolute in units of `scale`: metres for the position, 1e-3 for small quantities.
    Raises RuntimeError if the integrator fails.
    """
    made.timeline.step_ns = LONG_STEP_NS
    clock = made.packed.memory[0].clock
    until = int(clock.now_ns) + round(1e9 * duration_s)
    made.derivative(made.y, 1e-9 * int(clock.now_ns))
    scale = np.full(made.n, 1e-3)
    scale[:3] = 1e3
    scale[3:6] = 1.0
    while int(clock.now_ns) < until:
        now = int(clock.now_ns)
        length = meet(made, until)
        start_s = 1e-9 * now

        def derivative(elapsed_s: float, y: Array, now: int = now) -> Array:
            return made.derivative_within(y, now, elapsed_s)

        solution = solve_ivp(
            derivative, (0.0, 1e-9 * length), made.y.copy(), "DOP853", rtol=tolerance, atol=tolerance * scale
        )
        if not solution.success:
            raise RuntimeError(f"DOP853 gave up {solution.t[-1]} s after {start_s} s: {solution.message}")
        made.y[:] = solution.y[:, -1]
        clock.now_ns = now + length
        clock.steps += 1
    return made.y.copy()
