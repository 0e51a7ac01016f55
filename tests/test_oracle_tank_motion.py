"""Both slosh modes of a moving tank, also after a separation, equal a free body with two bobs on rods.

Newton's and Euler's equations in inertial coordinates, with the rods as constraints (multipliers), by DOP853. They
share no coordinates, mass matrix or reduction with docs/model.md. They confirm the damper (section 5) and the state of
the liquid after a separation (section 4).
"""

from __future__ import annotations

from typing import Any

import numpy as np
from flightkit import Parts, Tank, Tree, composed, flown, rig, scenario_of, stage_of, with_stage
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from maxq.control.kernel.records import Array
from maxq.sim.vehicle.state import Q_BI, R_I, V_I, W_BI_B, pendulum_index

PLACE_M = (0.12, -0.07)
FIRST = Tank(450.0, 0.9, 6.0, 0.02, PLACE_M)
SECOND = Tank(110.0, 0.3, 5.2, 0.05, PLACE_M)
BOBS = (FIRST, SECOND)
PARTS = Parts(
    core_mass_kg=3000.0,
    core_cg=(7.0, 0.02, -0.03),
    core_inertia=((900.0, 15.0, -20.0), (15.0, 3.0e4, 30.0), (-20.0, 30.0, 2.94e4)),
    tanks=BOBS,
    thrust_N=6.0e4,
    gimbal_offset_m=(0.05, -0.04),
)
END_S = 3.0


def cross_matrix(v: Array) -> Array:
    return np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])


def hinges() -> Array:
    """Return the hinges relative to the core's CG, in B."""
    x, y, z = PARTS.core_cg
    return np.array([[x - bob.hinge_station_m, bob.place_m[0] - y, bob.place_m[1] - z] for bob in BOBS])


def rates(_time: float, state: Array, thrust_N: float) -> Array:
    """Return the rates of r, v, q (x, y, z, w), rate_B of the core, and of each bob's place and velocity in I."""
    r, v, w = state[0:3], state[3:6], state[10:13]
    places, speeds = state[13:19].reshape(2, 3), state[19:25].reshape(2, 3)
    turn = Rotation.from_quat(state[6:10]).as_matrix()
    inertia = np.array(PARTS.core_inertia)
    masses = np.array([bob.mass_kg for bob in BOBS])
    gimbal = np.array([PARTS.core_cg[0] - PARTS.gimbal_station_m, *PARTS.gimbal_offset_m])
    gimbal[1:] -= PARTS.core_cg[1:]
    push = np.array([thrust_N, 0.0, 0.0])
    loads = np.zeros(12)  # force on the core in I, moment on it in B, forces on the bobs in I
    loads[:3], loads[3:6] = turn @ push, np.cross(gimbal, push) - np.cross(w, inertia @ w)
    axial = thrust_N / (PARTS.core_mass_kg + masses.sum())
    jacobian, bias = np.zeros((2, 12)), np.zeros(2)
    for k, (bob, hinge) in enumerate(zip(BOBS, hinges(), strict=True)):
        rod = places[k] - r - turn @ hinge
        seen = speeds[k] - v - turn @ np.cross(w, hinge) - turn @ np.cross(w, turn.T @ rod)  # in B's rotation
        drag = -2.0 * bob.mass_kg * bob.damping_ratio * np.sqrt(axial / bob.length_m) * seen
        loads[6 + 3 * k : 9 + 3 * k] += drag
        loads[:3] -= drag
        loads[3:6] -= np.cross(turn.T @ (places[k] - r), turn.T @ drag)
        # rod . (bob'' - hinge'') = -|bob' - hinge'|^2
        jacobian[k, :3], jacobian[k, 6 + 3 * k : 9 + 3 * k] = -rod, rod
        jacobian[k, 3:6] = rod @ turn @ cross_matrix(hinge)
        moving = speeds[k] - v - turn @ np.cross(w, hinge)
        bias[k] = -moving @ moving + rod @ (turn @ np.cross(w, np.cross(w, hinge)))
    weight = np.zeros((14, 14))
    weight[:3, :3], weight[3:6, 3:6] = PARTS.core_mass_kg * np.eye(3), inertia
    weight[6:12, 6:12] = np.diag(np.repeat(masses, 3))
    weight[:12, 12:], weight[12:, :12] = -jacobian.T, jacobian
    accel = np.linalg.solve(weight, np.concatenate([loads, bias]))
    spin = 0.5 * np.array([*(np.cross(state[6:9], w) + state[9] * w), -state[6:9] @ w])
    return np.concatenate([v, accel[:3], spin, accel[3:6], speeds.ravel(), accel[6:12]])


def stage() -> Tree:
    """Return the parts as a stage whose one tank has both modes."""
    mass, cg, inertia = composed(PARTS)
    tank = {
        "table": {
            "time_s": [0.0],
            "slosh_mass_kg": [FIRST.mass_kg],
            "pendulum_length_m": [FIRST.length_m],
            "hinge_station_m": [FIRST.hinge_station_m],
            "slosh_mass_2_kg": [SECOND.mass_kg],
            "pendulum_length_2_m": [SECOND.length_m],
            "hinge_station_2_m": [SECOND.hinge_station_m],
        },
        "damping_ratio": FIRST.damping_ratio,
        "second_damping_ratio": SECOND.damping_ratio,
        "position_m": list(PLACE_M),
    }
    whole = {"mass_kg": mass, "x_cg_m": cg[0], "y_cg_m": cg[1], "z_cg_m": cg[2], "inertia_kgm2": inertia}
    return stage_of(PARTS) | {"mass": whole, "tank": [tank]}


def cartesian(origin: Array, place: Array, velocity: Array, q: Array, rate: Array, bobs: Array) -> Array:
    """Return the state of `rates` from the core's state and (u, kappa) of each bob; places relative to `origin`."""
    turn = Rotation.from_quat([*q[1:], q[0]])
    places, speeds = [], []
    for bob, hinge, (u, kappa) in zip(BOBS, hinges(), bobs, strict=True):
        places.append(place - origin + turn.apply(hinge + bob.length_m * u))
        speeds.append(velocity + turn.apply(np.cross(rate, hinge) + bob.length_m * kappa))
    return np.concatenate([place - origin, velocity, q[1:], q[:1], rate, *places, *speeds])


def assert_moved(sizes: Any, y: Array, origin: Array, start: Array, seconds: float, thrust_N: float) -> None:
    """Check that the state `y` equals the motion of the constrained bodies after this time."""
    wanted = solve_ivp(rates, (0.0, seconds), start, "DOP853", rtol=1e-11, atol=1e-11, args=(thrust_N,)).y[:, -1]
    firsts = [int(pendulum_index(sizes, n)) for n in range(len(BOBS))]
    bobs = np.array([[y[k : k + 3], y[k + 3 : k + 6]] for k in firsts])
    got = cartesian(origin, y[R_I : R_I + 3], y[V_I : V_I + 3], y[Q_BI : Q_BI + 4], y[W_BI_B : W_BI_B + 3], bobs)
    assert (Rotation.from_quat(wanted[6:10]).inv() * Rotation.from_quat(got[6:10])).magnitude() < 1e-8
    for part, limit in ((slice(0, 6), 1e-7), (slice(10, 13), 1e-8), (slice(13, 19), 1e-7), (slice(19, 25), 1e-6)):
        np.testing.assert_allclose(got[part], wanted[part], rtol=0.0, atol=limit)


def test_two_modes_of_a_tank_swing_as_two_bobs_on_rods() -> None:
    tree = scenario_of(PARTS, switches={"actuator": "ideal"})
    made = rig(with_stage(tree, **stage()))
    y = made.y
    rng = np.random.default_rng(7)
    y[W_BI_B : W_BI_B + 3] = 0.4, -0.3, 0.25
    bobs = np.zeros((2, 2, 3))
    for n in range(2):
        u = np.array([-1.0, *rng.uniform(-0.5, 0.5, 2)])
        u /= np.linalg.norm(u)
        kappa = rng.normal(0.0, 1.0, 3)
        bobs[n] = u, kappa - (kappa @ u) * u
        first = int(pendulum_index(made.sizes, n))
        y[first : first + 6] = bobs[n].ravel()
    origin = y[R_I : R_I + 3].copy()
    start = cartesian(origin, origin, y[V_I : V_I + 3], y[Q_BI : Q_BI + 4], y[W_BI_B : W_BI_B + 3], bobs)
    assert_moved(made.sizes, flown(made, END_S)[-1], origin, start, END_S, PARTS.thrust_N)


def test_an_upper_stage_starts_from_the_motion_of_the_lower_one() -> None:
    """The structure keeps place, attitude and velocity; the liquid starts at rest in it, as the model states."""
    lower = Parts(
        core_mass_kg=9000.0,
        core_cg=(11.0, -0.05, 0.08),
        core_inertia=((4000.0, 0.0, 0.0), (0.0, 9.0e4, 0.0), (0.0, 0.0, 9.1e4)),
        tanks=(Tank(700.0, 0.8, 13.0),),
        thrust_N=0.0,
    )
    tree = scenario_of(lower, switches={"actuator": "ideal"})
    tree["vehicle"]["stage"] = [stage_of(lower) | {"separation_s": 0.5}, stage() | {"ignition_s": 50.0}]
    made = rig(tree)
    run = made.run()
    run.fly_segment(500_000_000)
    y = run.packed.state
    rate = np.array([0.4, -0.3, 0.25])
    y[W_BI_B : W_BI_B + 3] = rate
    origin, q = y[R_I : R_I + 3].copy(), y[Q_BI : Q_BI + 4].copy()
    jump = np.array([lower.core_cg[0] - PARTS.core_cg[0], *(np.subtract(PARTS.core_cg, lower.core_cg)[1:])])
    turn = Rotation.from_quat([*q[1:], q[0]])
    place, velocity = origin + turn.apply(jump), y[V_I : V_I + 3] + turn.apply(np.cross(rate, jump))
    down = np.array([-1.0, 0.0, 0.0])
    bobs = np.tile([down, np.cross(rate, down)], (2, 1, 1))
    start = cartesian(origin, place, velocity, q, rate, bobs)
    run.fly_segment(500_000_000)
    sizes = run.packed.parameters[1].vehicle.sizes
    assert_moved(sizes, run.packed.state, origin, start, 0.5, 0.0)
