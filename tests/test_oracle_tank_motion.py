"""Both slosh modes of a tank in motion: a free body and two bobs on rods, each in inertial Cartesian coordinates.

Newton's and Euler's equations with the two rods as constraints (multipliers), integrated by DOP853. No coordinates, mass
matrix or reduction of docs/model.md are used, only its data: hinges, lengths, masses and the damper (section 5).
"""

from __future__ import annotations

import numpy as np
from flightkit import Parts, Tank, composed, flown, rig, scenario_of, with_stage
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
    """From the core's CG, in B."""
    x, y, z = PARTS.core_cg
    return np.array([[x - bob.hinge_station_m, bob.place_m[0] - y, bob.place_m[1] - z] for bob in BOBS])


def rates(_time: float, state: Array) -> Array:
    """Time derivative of r, v, q (x, y, z, w), rate_B of the core, then place and velocity of each bob, all in I."""
    r, v, w = state[0:3], state[3:6], state[10:13]
    places, speeds = state[13:19].reshape(2, 3), state[19:25].reshape(2, 3)
    turn = Rotation.from_quat(state[6:10]).as_matrix()
    inertia = np.array(PARTS.core_inertia)
    masses = np.array([bob.mass_kg for bob in BOBS])
    gimbal = np.array([PARTS.core_cg[0] - PARTS.gimbal_station_m, *PARTS.gimbal_offset_m])
    gimbal[1:] -= PARTS.core_cg[1:]
    push = np.array([PARTS.thrust_N, 0.0, 0.0])
    loads = np.zeros(12)  # force on the core in I, moment on it in B, forces on the bobs in I
    loads[:3], loads[3:6] = turn @ push, np.cross(gimbal, push) - np.cross(w, inertia @ w)
    axial = PARTS.thrust_N / (PARTS.core_mass_kg + masses.sum())
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


def test_two_modes_of_a_tank_swing_as_two_bobs_on_rods() -> None:
    mass, cg, inertia = composed(PARTS)
    whole = {"mass_kg": mass, "x_cg_m": cg[0], "y_cg_m": cg[1], "z_cg_m": cg[2], "inertia_kgm2": inertia}
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
    made = rig(with_stage(scenario_of(PARTS, switches={"actuator": "ideal"}), mass=whole, tank=[tank]))
    y = made.y
    rng = np.random.default_rng(7)
    rate = np.array([0.4, -0.3, 0.25])
    y[W_BI_B : W_BI_B + 3] = rate
    w, i, j, k = y[Q_BI : Q_BI + 4]
    turn = Rotation.from_quat([i, j, k, w]).as_matrix()
    places, speeds = [], []
    for n, (bob, hinge) in enumerate(zip(BOBS, hinges(), strict=True)):
        u = np.array([-1.0, *rng.uniform(-0.5, 0.5, 2)])
        u /= np.linalg.norm(u)
        kappa = rng.normal(0.0, 1.0, 3)
        kappa -= (kappa @ u) * u
        first = int(pendulum_index(made.sizes, n))
        y[first : first + 3], y[first + 3 : first + 6] = u, kappa
        places.append(y[R_I : R_I + 3] + turn @ (hinge + bob.length_m * u))
        speeds.append(y[V_I : V_I + 3] + turn @ (np.cross(rate, hinge) + bob.length_m * kappa))
    start = np.concatenate([y[R_I : R_I + 3], y[V_I : V_I + 3], [i, j, k, w], rate, *places, *speeds])
    origin = y[R_I : R_I + 3].copy()
    start[0:3] -= origin
    start[13:19] -= np.tile(origin, 2)
    wanted = solve_ivp(rates, (0.0, END_S), start, "DOP853", rtol=1e-11, atol=1e-11).y[:, -1]
    end = flown(made, END_S)[-1]
    turn = Rotation.from_quat([*end[Q_BI + 1 : Q_BI + 4], end[Q_BI]])
    assert (Rotation.from_quat(wanted[6:10]).inv() * turn).magnitude() < 1e-8
    np.testing.assert_allclose(end[W_BI_B : W_BI_B + 3], wanted[10:13], rtol=0.0, atol=1e-8)
    np.testing.assert_allclose(end[R_I : R_I + 3] - origin, wanted[0:3], rtol=0.0, atol=1e-7)
    np.testing.assert_allclose(end[V_I : V_I + 3], wanted[3:6], rtol=0.0, atol=1e-7)
    for n, (bob, hinge) in enumerate(zip(BOBS, hinges(), strict=True)):
        first = int(pendulum_index(made.sizes, n))
        place = end[R_I : R_I + 3] - origin + turn.apply(hinge + bob.length_m * end[first : first + 3])
        np.testing.assert_allclose(place, wanted[13 + 3 * n : 16 + 3 * n], rtol=0.0, atol=1e-7)
        swing = np.cross(end[W_BI_B : W_BI_B + 3], hinge) + bob.length_m * end[first + 3 : first + 6]
        speed = end[V_I : V_I + 3] + turn.apply(swing)
        np.testing.assert_allclose(speed, wanted[19 + 3 * n : 22 + 3 * n], rtol=0.0, atol=1e-6)
