"""Actuators stall under the torque of their engine as in SciPy's integration of the valve's orifice law.

The vehicle is so heavy that the engine's gimbal is fixed in space. The torque of a flexible bearing resists the
actuators: v = r sqrt(1 - M / M_s) against it, so that the stroke to the stall takes 2 d_s / r.
"""

from __future__ import annotations

import math

import numpy as np
import pytest
from flightkit import Parts, Rig, Tree, flown, merged, rig, scenario_of
from scipy.integrate import solve_ivp

from maxq import ScenarioError
from maxq.control.kernel.records import Array
from maxq.sim.vehicle import state as layout

HZ, ZETA, RATE_degps, COMMAND_deg = 12.0, 1.6, 30.0, 5.5
LINK_Nmprad, BEARING_Nmprad, DAMPING, INERTIA_kgm2 = 4.0e6, 4.0e5, 0.4, 150.0
STALL_Nm = (2.0e4, 3.0e4)  # pitch, yaw
DURATION_s = 0.6


def engines(count: int, stall_Nm: tuple[float, float] = STALL_Nm, heavier_kg: float = 0.0) -> Rig:
    """Return one engine, or two of a group with half its inertia and stiffness; the second may be heavier."""
    tree = scenario_of(Parts(core_mass_kg=9e7, core_inertia=tuple(map(tuple, 1e11 * np.eye(3)))))
    stage: Tree = tree["vehicle"]["stage"][0]
    share = 1.0 / count
    stage["engine"] = [
        {
            "table": [{"time_s": 0.0, "thrust_vacuum_N": 0.0}],
            "gimbal_station_m": 12.0,
            "exit_station_m": 13.0,
            "offset_m": [0.5 * n, 0.0],
            "gimballed_mass_kg": 200.0 * share + heavier_kg * n,
            "cg_from_gimbal_m": 0.5,
            "inertia_about_gimbal_kgm2": INERTIA_kgm2 * share,
        }
        for n in range(count)
    ]
    given = {"stiffness_Nmprad": LINK_Nmprad, "bearing_stiffness_Nmprad": BEARING_Nmprad}
    stage["tvc_load"] = {key: share * value for key, value in given.items()} | {"damping_ratio": DAMPING}
    stage["actuator"] = {
        "model": "second-order",
        "omega_hz": [HZ],
        "zeta": [ZETA],
        "angle_limit_deg": 45.0,
        "rate_limit_degps": RATE_degps,
        "stall_torque_Nm": share * stall_Nm[0],
        "yaw": {"stall_torque_Nm": share * stall_Nm[1]},
    }
    commands = [
        {"at": "gimbal_command", "axis": axis, "kind": "step", "amplitude_deg": sign * COMMAND_deg}
        for axis, sign in (("pitch", 1.0), ("yaw", -1.0))
    ]
    return rig(merged(tree, {"run": {"step_s": 0.0005}, "injection": commands}))


def by_scipy(stall_Nm: float, start: float) -> Array:
    """Return the angle and rate of actuator and engine (4, samples) every 0.1 s, from rest at `start` (rad).

    The command takes effect 3 ms after the first sample of 10 ms.
    """
    w, limit = 2.0 * math.pi * HZ, math.radians(RATE_degps)
    damper = 2.0 * DAMPING * math.sqrt(LINK_Nmprad * INERTIA_kgm2)

    def rates(_: float, x: Array, command: float) -> list[float]:
        act, act_rate, angle, rate = x
        torque = LINK_Nmprad * (act - angle) + damper * (act_rate - rate)
        orifice = lambda side: limit * math.copysign(math.sqrt(abs(side)), side)  # noqa: E731  # a formula
        wanted = w / (2.0 * ZETA) * (command - act)
        wanted = min(max(wanted, -orifice(1.0 + torque / stall_Nm)), orifice(1.0 - torque / stall_Nm))
        servo = 2.0 * ZETA * w * (wanted - act_rate)
        return [act_rate, servo, rate, (torque - BEARING_Nmprad * angle) / INERTIA_kgm2]

    out = [np.array([start, 0.0, start, 0.0])]
    x = solve_ivp(rates, (0.0, 0.013), out[0], "DOP853", args=(0.0,), rtol=1e-10, atol=1e-13).y[:, -1]
    at = np.arange(0.1, DURATION_s + 0.05, 0.1)
    given = (math.radians(COMMAND_deg),)
    rest = solve_ivp(rates, (0.013, at[-1]), x, "DOP853", at, args=given, rtol=1e-10, atol=1e-13).y
    return np.concatenate([out[0][:, None], rest], axis=1)


@pytest.mark.parametrize("count", [1, 2])
@pytest.mark.parametrize("start_deg", [0.0, 7.0], ids=["drives", "is driven back"])
def test_a_stalling_actuator_follows_the_orifice_law(start_deg: float, count: int) -> None:
    made, start = engines(count), math.radians(start_deg)
    loads = int(layout.tvc_load_index(made.sizes))
    for axis, sign in ((0, 1.0), (1, -1.0)):
        made.y[layout.ACTUATOR + layout.N_ACTUATOR * axis] = made.y[loads + 3 * axis] = sign * start
    states = flown(made, DURATION_s, 0.1)
    for axis, sign in ((0, 1.0), (1, -1.0)):
        servo, engine = layout.ACTUATOR + layout.N_ACTUATOR * axis, loads + 3 * axis
        got = sign * states[:, [servo, servo + 1, engine, engine + 1]].T
        wanted = by_scipy(STALL_Nm[axis], start)
        scale = math.radians(COMMAND_deg) * np.array([[1.0], [25.0], [1.0], [25.0]])
        np.testing.assert_allclose(got / scale, wanted / scale, atol=2e-4)
        held = BEARING_Nmprad * got[2, -1]
        assert held == pytest.approx(STALL_Nm[axis], rel=0.02)  # it holds the torque at which it stalls


def test_below_the_stall_torque_the_command_is_reached() -> None:
    made = engines(1, (1e7, 1e7))
    angle = flown(made, 1.5)[-1][int(layout.tvc_load_index(made.sizes))]
    share = LINK_Nmprad / (LINK_Nmprad + BEARING_Nmprad)
    assert math.degrees(angle) == pytest.approx(share * COMMAND_deg, rel=1e-6)


def test_an_actuator_pushed_along_moves_faster_than_its_limit() -> None:
    """With the stall torque along the motion, the servo's rate command is -r sqrt 2 (floating engine: -r)."""
    made, w = engines(1), 2.0 * math.pi * HZ
    loads = int(layout.tvc_load_index(made.sizes))
    made.held.command_rad[0] = math.radians(-40.0)
    y = made.y.copy()
    y[layout.ACTUATOR] = 0.02
    y[loads] = 0.02 - STALL_Nm[0] / LINK_Nmprad
    limit = math.radians(RATE_degps)
    accel = made.derivative(y)[layout.ACTUATOR + 1]
    assert accel == pytest.approx(-2.0 * ZETA * w * math.sqrt(2.0) * limit, rel=1e-9)


@pytest.mark.parametrize("axis", [0, 1])
def test_unlike_engines_resist_their_common_actuators_together(axis: int) -> None:
    """Two loads of one group resist with springs stretched by 0.3 and 0.5 of the torque at which one stalls."""
    made, w = engines(2, heavier_kg=10.0), 2.0 * math.pi * HZ
    assert int(made.sizes.tvc_loads) == 2
    made.held.command_rad[axis] = math.radians(40.0)
    y, loads = made.y.copy(), int(layout.tvc_load_index(made.sizes)) + 3 * axis
    for n, share in enumerate((0.3, 0.5)):
        y[loads + 6 * n] = -share * STALL_Nm[axis] / LINK_Nmprad
    accel = made.derivative(y)[layout.ACTUATOR + layout.N_ACTUATOR * axis + 1]
    assert accel == pytest.approx(2.0 * ZETA * w * math.sqrt(1.0 - 0.4) * math.radians(RATE_degps), rel=1e-9)


def test_a_stall_torque_needs_a_load() -> None:
    made = scenario_of(Parts())
    stage = made["vehicle"]["stage"][0]
    given = stage["actuator"]
    for stalls, key in (({"stall_torque_Nm": 1e4}, ""), ({"yaw": {"stall_torque_Nm": 1e4}}, "yaw.")):
        stage["actuator"] = given | stalls
        with pytest.raises(ScenarioError, match=rf"actuator.{key}stall_torque_Nm = 10000.*follows its actuator at any"):
            rig(made)
