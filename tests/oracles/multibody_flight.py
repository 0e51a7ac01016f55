"""Fly the multibody system with SciPy's DOP853 on an oracle's accelerations, for conservation tests."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from oracles.multibody_system import Floats, Load, State, Vehicle, quaternion_from_rotation, rotation_from_quaternion
from scipy.integrate import solve_ivp

Accelerations = Callable[[Vehicle, State, Load], dict[str, Floats]]
Deflection = Callable[[float], tuple[Floats, Floats, Floats]]


def flatten(state: State) -> Floats:
    """Return the state as one vector: r, v, q_BI, w, eta, etadot, xi, xidot, u, udot, actuators' work (J, zero)."""
    return np.concatenate(
        (
            state.r_I_m,
            state.v_I_mps,
            quaternion_from_rotation(state.C_IB),
            state.w_BI_B_radps,
            state.eta_m,
            state.etadot_mps,
            state.xi_m,
            state.xidot_mps,
            state.u_B.ravel(),
            state.udot_B_1ps.ravel(),
            [0.0],
        )
    )


def unflatten(vector: Floats, like: State) -> State:
    """Return the inverse of `flatten`; gimbal angles and array sizes come from `like`."""
    n, k = len(like.eta_m), len(like.u_B)
    sizes = (3, 3, 4, 3, n, n, n, n, 3 * k, 3 * k)
    r, v, q, w, eta, eta_dot, xi, xi_dot, u, u_dot = np.split(vector[:-1], np.cumsum(sizes)[:-1])
    return replace(
        like,
        r_I_m=r,
        v_I_mps=v,
        C_IB=rotation_from_quaternion(q),
        w_BI_B_radps=w,
        eta_m=eta,
        etadot_mps=eta_dot,
        xi_m=xi,
        xidot_mps=xi_dot,
        u_B=u.reshape(k, 3),
        udot_B_1ps=u_dot.reshape(k, 3),
    )


def fly(
    accelerations: Accelerations,
    vehicle: Vehicle,
    start: State,
    duration_s: float,
    *,
    load: Load | None = None,
    deflection: Deflection | None = None,
    samples: int = 5,
    tolerance: float = 1e-11,
) -> tuple[list[State], Floats]:
    """Return the states at `samples` equally spaced instants, both ends included, and the actuators' work in J.

    `load` stays constant in its axes. `deflection(t)` gives (pitch, yaw) angle, rate and acceleration in radians.
    Without it, gimbal angles stay as in `start` and must be at rest there. Raises RuntimeError when the integrator
    fails.
    """
    loads = load or Load()

    def at(time: float, vector: Floats) -> State:
        state = unflatten(vector, start)
        if deflection is None:
            return state
        angle, rate, acceleration = deflection(time)
        return replace(state, deflection_rad=angle, deflection_radps=rate, deflection_radps2=acceleration)

    def derivative(time: float, vector: Floats) -> Floats:
        state = at(time, vector)
        answer = accelerations(vehicle, state, loads)
        p, q, r = state.w_BI_B_radps
        q0, q1, q2, q3 = vector[6:10]
        quaternion_rate = 0.5 * np.array(
            [-q1 * p - q2 * q - q3 * r, q0 * p + q2 * r - q3 * q, q0 * q + q3 * p - q1 * r, q0 * r + q1 * q - q2 * p]
        )
        torque = answer.get("actuator_torque_Nm", np.zeros(2))
        return np.concatenate(
            (
                state.v_I_mps,
                state.C_IB @ answer["specific_force_B_mps2"] + loads.gravitation_I_mps2,
                quaternion_rate,
                answer["wdot_B_radps2"],
                state.etadot_mps,
                answer["etaddot_mps2"],
                state.xidot_mps,
                answer["xiddot_mps2"],
                state.udot_B_1ps.ravel(),
                answer["uddot_B_1ps2"].ravel(),
                [torque @ state.deflection_radps],
            )
        )

    times = np.linspace(0.0, duration_s, samples)
    solution = solve_ivp(derivative, (0.0, duration_s), flatten(start), "DOP853", times, rtol=tolerance, atol=tolerance)
    if not solution.success:
        raise RuntimeError(f"DOP853 gave up after {solution.t[-1]} s: {solution.message}")
    return [at(t, y) for t, y in zip(times, solution.y.T, strict=True)], solution.y[-1]
