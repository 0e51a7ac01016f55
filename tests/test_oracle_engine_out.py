"""A vehicle that loses an engine moves as in rigid-body equations with variable mass, written here (SciPy).

| quantity | against |
|---|---|
| six degrees of freedom without control: tail-off, slower clock, moving CG, jet damping of each nozzle, cant | DOP853 |
| steady attitude and acceleration under the PD law | the thrust line of the remaining engines through the CG |

The equations are those of docs/model.md, sections 8 and 9.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from flightkit import Parts, Rig, Tree, flown, merged, rig, scenario_of, with_stage
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from maxq.control.kernel.records import Array
from maxq.sim.vehicle.state import Q_BI, R_I, V_I, W_BI_B

OFF_S, TAIL_S, END_S, BURN_S = 3.0, 0.4, 9.0, 20.0
LOST, RADIUS_M, GIMBAL_M, EXIT_M = 2, 0.8, 12.0, 13.1
PLACES = ((RADIUS_M, 0.0), (-RADIUS_M, 0.0), (0.0, RADIUS_M), (0.0, -RADIUS_M))
CANT_DEG = ((0.0, -1.5), (0.0, -1.5), (0.0, 1.5), (0.0, 1.5))  # balanced while all four burn
THRUST_N = (30e3, 24e3)  # of one engine, at ignition and at BURN_S of the tables
MASS_KG, FLOW_KGPS = 5000.0, 48.0
CG_M, CG_AFT_MPS = 6.5, -0.05
INERTIA, INERTIA_RATE = np.diag([4000.0, 5.2e4, 4.9e4]), np.diag([-60.0, -900.0, -800.0])
GRAVITY = 9.80665
EULER_DEG, RATE = (20.0, 70.0, 10.0), (0.02, -0.03, 0.01)


def vehicle(thrust_N: tuple[float, float], flow_kgps: float, cant_deg: Any) -> Tree:
    engines = [
        {
            "table": {"time_s": [0.0, BURN_S], "thrust_vacuum_N": list(thrust_N)},
            "gimbal_station_m": GIMBAL_M,
            "exit_station_m": EXIT_M,
            "offset_m": list(place),
            "cant_deg": list(cant),
            "group": "all",
        }
        for place, cant in zip(PLACES, cant_deg, strict=True)
    ]
    rate = flow_kgps / FLOW_KGPS
    at = np.array([0.0, BURN_S])
    inertia = INERTIA[:, :, None] + rate * INERTIA_RATE[:, :, None] * at
    mass = {
        "time_s": at,
        "mass_kg": MASS_KG - flow_kgps * at,
        "x_cg_m": CG_M + rate * CG_AFT_MPS * at,
        "Ixx_kgm2": inertia[0, 0],
        "Iyy_kgm2": inertia[1, 1],
        "Izz_kgm2": inertia[2, 2],
    }
    tree = scenario_of(
        Parts(engine=False),
        run={"duration_s": BURN_S},
        earth={"gravity": "uniform", "uniform_mps2": GRAVITY},
        initial={
            "euler_deg": list(EULER_DEG),
            "geodetic": {"latitude_deg": 0.0, "longitude_deg": 0.0, "altitude_m": 5000.0},
        },
    )
    tree["vehicle"]["stage"][0] |= {"interpolation": "linear", "mass": {"table": mass}, "engine": engines}
    return tree


def to_inertial(made: Rig) -> Rotation:
    """Return the rotation from north, east, down to I, from the scenario's attitude in both frames."""
    w, x, y, z = made.y[Q_BI : Q_BI + 4]
    return Rotation.from_quat([x, y, z, w]) * Rotation.from_euler("ZYX", EULER_DEG, degrees=True).inv()


def share(time_s: float) -> float:
    """Return the thrust of the lost engine relative to its nominal thrust."""
    return float(np.clip(1.0 - (time_s - OFF_S) / TAIL_S, 0.0, 1.0))


def rates(time_s: float, state: Array, down_I: Array) -> Array:
    """Return the time derivative of r_I, v_I, q_BI (x, y, z, w), rate_B and the clock of the tables."""
    v, attitude, w, clock = state[3:6], Rotation.from_quat(state[6:10]), state[10:13], state[13]
    on = np.array([share(time_s) if k == LOST else 1.0 for k in range(4)])
    pace = on.mean()
    thrust = on * (THRUST_N[0] + (THRUST_N[1] - THRUST_N[0]) * clock / BURN_S)
    mass, cg = MASS_KG - FLOW_KGPS * clock, CG_M + CG_AFT_MPS * clock
    inertia, inertia_rate = INERTIA + INERTIA_RATE * clock, INERTIA_RATE * pace
    cg_rate = np.array([-CG_AFT_MPS * pace, 0.0, 0.0])
    flows = on * FLOW_KGPS / 4.0
    force, moment, outflow = np.zeros(3), -inertia_rate @ w, mass * cg_rate
    for k, (place, cant) in enumerate(zip(PLACES, np.radians(CANT_DEG), strict=True)):
        axis = np.array(
            [math.cos(cant[0]) * math.cos(cant[1]), -math.sin(cant[1]), math.sin(cant[0]) * math.cos(cant[1])]
        )
        gimbal = np.array([cg - GIMBAL_M, *place])
        nozzle = gimbal - (EXIT_M - GIMBAL_M) * axis / axis[0]  # at its station on the line of thrust
        force = force + thrust[k] * axis
        moment = moment + np.cross(gimbal, thrust[k] * axis) - flows[k] * np.cross(nozzle, np.cross(w, nozzle))
        outflow = outflow + flows[k] * nozzle
    force = force - 2.0 * np.cross(w, outflow)
    accel = attitude.apply(force / mass + np.cross(w, cg_rate)) + GRAVITY * down_I
    turn = 0.5 * np.array([*(np.cross(state[6:9], w) + state[9] * w), -state[6:9] @ w])
    spin = np.linalg.solve(inertia, moment - np.cross(w, inertia @ w))
    return np.concatenate([v + attitude.apply(cg_rate), accel, turn, spin, [pace]])


def test_a_vehicle_turns_as_its_remaining_engines_push_it() -> None:
    tree = merged(vehicle(THRUST_N, FLOW_KGPS, CANT_DEG), {"initial": {"rate_BI_radps": list(RATE)}})
    tree["fault"] = [
        {
            "kind": "engine-off",
            "engine": LOST,
            "at_s": OFF_S,
            "tail_off": {"time_s": [0.0, TAIL_S], "share": [1.0, 0.0]},
        }
    ]
    made = rig(tree)
    down_I = to_inertial(made).apply([0.0, 0.0, 1.0])
    w, x, y, z = made.y[Q_BI : Q_BI + 4]
    state = np.concatenate([made.y[R_I : R_I + 3], made.y[V_I : V_I + 3], [x, y, z, w], RATE, [0.0]])
    for start, end in ((0.0, OFF_S), (OFF_S, OFF_S + TAIL_S), (OFF_S + TAIL_S, END_S)):
        found = solve_ivp(rates, (start, end), state, method="DOP853", rtol=1e-12, atol=1e-12, args=(down_I,))
        state = found.y[:, -1]
    origin = made.y[R_I : R_I + 3].copy()
    flight = flown(made, END_S)[-1]
    assert np.abs(state[10:13]).min() > 0.05  # every axis turns
    np.testing.assert_allclose(flight[W_BI_B : W_BI_B + 3], state[10:13], rtol=0.0, atol=1e-9)
    wanted, (w, x, y, z) = Rotation.from_quat(state[6:10]), flight[Q_BI : Q_BI + 4]
    assert (wanted.inv() * Rotation.from_quat([x, y, z, w])).magnitude() < 1e-9
    np.testing.assert_allclose(flight[V_I : V_I + 3], state[3:6], rtol=0.0, atol=1e-7)
    np.testing.assert_allclose(flight[R_I : R_I + 3] - origin, state[0:3] - origin, rtol=0.0, atol=1e-6)


@pytest.mark.parametrize("lost", range(4))
def test_the_law_settles_with_the_thrust_line_through_the_cg(lost: int) -> None:
    """The law settles at gimbal angles (p, y) = (-z, y) / L of the mean gimbal, L behind the CG.

    The attitude error is -angle / k_p.
    """
    k_p, thrust = 0.8, 30e3
    tree = vehicle((thrust, thrust), 0.0, ((0.0, 0.0),) * 4)
    tree["fault"] = [{"kind": "engine-off", "engine": lost, "at_s": 0.5}]
    tree["design"] = {"schema": 2, "gains": {"table": {"time_s": [0.0], "k_p": [k_p], "k_d_s": [0.9]}}}
    tree["switches"] = {"actuator": "ideal"}
    gyro = {"station_m": 3.0, "omega_hz": 60.0, "zeta": 0.65}
    made = rig(with_stage(tree, gyro=gyro))
    start = made.y[Q_BI : Q_BI + 4].copy()
    before, after = flown(made, BURN_S, 0.5)[-2:]
    mean = np.delete(np.array(PLACES), lost, axis=0).mean(axis=0)
    wanted = np.arctan(np.array([-mean[1], mean[0]]) / (GIMBAL_M - CG_M))
    first, last = (Rotation.from_quat([*q[1:], q[0]]) for q in (start, after[Q_BI : Q_BI + 4]))
    error = (first.inv() * last).as_rotvec()
    np.testing.assert_allclose(error, [0.0, *(-wanted / k_p)], rtol=0.0, atol=1e-6)
    np.testing.assert_allclose(after[W_BI_B : W_BI_B + 3], 0.0, atol=1e-6)
    gained = last.inv().apply((after - before)[V_I : V_I + 3] / 0.5 - GRAVITY * to_inertial(rig(tree)).apply([0, 0, 1]))
    line = np.array([GIMBAL_M - CG_M, -mean[0], -mean[1]])
    np.testing.assert_allclose(gained, 3.0 * thrust / MASS_KG * line / np.linalg.norm(line), atol=1e-5)
