"""Slopes of tables over angle of attack in the linear model equal the linearised simulator to 1e-8."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import numpy as np
import pytest
from aero_tables import AIR, MODES, OVER_ALPHA_BETA, OVER_TOTAL, PARTS, RATES, REFERENCE, STABILITY, WIND_PLANE, table
from flightkit import Parts, Rig, Tank, Tree, merged, rig, scenario_of, with_stage
from oracles.planar.incidence import table_slopes

from maxq.control.kernel.records import Array
from maxq.design.loop.fixed_path import ExactFixedPath, fixed_path
from maxq.design.model.linearised import linearise
from maxq.design.model.node import node_of
from maxq.sim.run.evaluate import evaluate_at

TOLERANCE = 1e-8
RIGID = dataclasses.replace(PARTS, pitch=(), yaw=(), core_cg=(7.0, 0.0, 0.0), engine=False)
FLEXIBLE = Parts(
    core_cg=(7.0, 0.0, 0.0),
    pitch=MODES,
    yaw=MODES,
    engine_mass_kg=120.0,
    engine_cg_m=0.6,
    engine_inertia_kgm2=30.0,
    thrust_N=2.5e5,
    tanks=(Tank(300.0, 0.8, 5.0, 0.01),),
)
ALL = [OVER_TOTAL, OVER_ALPHA_BETA, STABILITY, WIND_PLANE, RATES]


def made_of(
    parts: Parts, aero: Tree, flow: list[float], mass: Tree | None = None, loads: Tree | None = None, **changes: Any
) -> Rig:
    start = {"euler_deg": [0.0, 0.0, 0.0], "ned_mps": flow}
    tree = scenario_of(parts, initial=start, atmosphere=AIR, vehicle={"reference": REFERENCE})
    stage = {"aero": aero, "mass": mass or {}} | ({} if loads is None else {"loads": loads})
    return rig(merged(with_stage(tree, **stage), changes))


def columns(model, rows: tuple[str, ...], by: tuple[str, ...]) -> Array:
    at = [model.states.index(name) for name in by]
    return model.a[np.ix_([model.states.index(name) for name in rows], at)]


SPEEDS, RATE = ("u_mps", "v_mps", "w_mps"), ("p_radps", "q_radps", "r_radps")


@pytest.mark.parametrize("method", ["linear", "pchip"])
@pytest.mark.parametrize("trim_deg", [(3.0, -2.0), (-11.0, 4.0), (6.0, 0.0), (0.5, 17.0)])
def test_all_slopes_at_a_trim(method: str, trim_deg: tuple[float, float]) -> None:
    """Forces and moments of five tables by all six motions of a rigid vehicle agree, including cross terms."""
    alpha, beta = np.radians(trim_deg)
    speed = 290.0
    flow = speed * np.array([math.cos(alpha) * math.cos(beta), math.sin(beta), math.sin(alpha) * math.cos(beta)])
    aero = {
        "interpolation": method,
        "moment_reference_m": 6.2,
        "axial_factor": 1.2,
        "force_factor": 0.9,
        "damping_factor": 1.3,
        "centre_shift_m": 0.2,
        "coefficients": [{"table": t} for t in ALL],
    }
    made = made_of(RIGID, aero, [*flow])
    model = linearise(made.packed, made.packed.state, 0.0)
    mach = float(evaluate_at(made.packed, made.packed.state, 0.0).aux.air.mach)
    made.derivative(made.y)
    scale = 0.5 * 0.9 * speed * REFERENCE["area_m2"]
    by_flow, by_rate, turn_by_flow, turn_by_rate = np.zeros((4, 3, 3))
    for one in table_slopes(made.packed.pool, made.vehicle, made.props, 0.0, mach, alpha, beta):
        arm = np.array([7.0 - one.reference_m, 0.0, 0.0])
        axial = one.force_by_flow * np.array([[1.0], [0.0], [0.0]])
        lateral = one.force_by_flow - axial
        by_flow += one.force_by_flow
        by_rate += one.force_by_rate_m
        turn_by_flow += one.couple_by_flow_m + np.cross(arm, lateral.T).T
        turn_by_rate += one.couple_by_rate_m2 + np.cross(arm, one.force_by_rate_m.T).T
    inverse = np.linalg.inv(np.array(RIGID.core_inertia))
    ours = {"by flow": scale * by_flow / RIGID.core_mass_kg, "turn by flow": scale * inverse @ turn_by_flow}
    ours["turn by rate"] = scale * inverse @ turn_by_rate
    # that of the speeds by the rates has w x v besides
    u, v, w = flow
    gyration = np.array([[0.0, -w, v], [w, 0.0, -u], [-v, u, 0.0]])
    ours["by rate"] = scale * by_rate / RIGID.core_mass_kg + gyration
    theirs = {
        "by flow": columns(model, SPEEDS, SPEEDS),
        "turn by flow": columns(model, RATE, SPEEDS),
        "turn by rate": columns(model, RATE, RATE),
        "by rate": columns(model, SPEEDS, RATE),
    }
    for name, matrix in ours.items():
        np.testing.assert_allclose(theirs[name], matrix, rtol=TOLERANCE, atol=TOLERANCE * np.abs(matrix).max())
    assert np.abs(by_flow[1, 2]) > 1e-2 * np.abs(by_flow[2, 2])  # there is a cross term, which a planar model drops


def test_a_table_for_the_engine_off_has_no_slopes_under_thrust() -> None:
    slopes = {}
    for power in ("always", "on", "off"):
        aero = {
            "interpolation": "linear",
            "moment_reference_m": 6.2,
            "coefficients": [{"table": ALL[0], "power": power}],
        }
        made = made_of(RIGID, aero, [290.0, 4.0, 12.0])
        made.derivative(made.y)
        (one,) = table_slopes(made.packed.pool, made.vehicle, made.props, 0.0, 0.9, 0.04, 0.01)
        slopes[power] = np.concatenate([one.force_by_flow, one.couple_by_flow_m, one.force_by_rate_m])
    np.testing.assert_array_equal(slopes["on"], slopes["always"])
    assert np.abs(slopes["on"]).max() > 0.1
    assert not slopes["off"].any()


def symmetric() -> Tree:
    """Return aeroballistic tables without a roll angle: forces and rate derivatives of a body of revolution."""
    made = table({"mach": [0.0, 0.5, 1.0, 2.0], "total_deg": [0.0, 4.0, 11.0, 40.0]}, 11, "CN", "Cm", "CA")
    rates = table({"mach": [0.0, 1.0, 2.0]}, 12, "Cmq", "CNq", "Clp")
    rates = rates | {"Cnr": 2.0 * rates["Cmq"], "CYr": -1.5 * rates["CNq"]}
    return {
        "interpolation": "pchip",
        "moment_reference_m": 6.0,
        "rate_reference": "inertial",
        "table": {"mach": [0.0, 2.0], "CA": [0.3, 0.4], "CD": [0.1, 0.05], "Cmq": [-30.0, -50.0]},
        "surface": [{"table": {"mach": [0.0], "CN_alpha_pr": [2.0], "station_m": [11.0]}}],
        "coefficients": [{"table": made, "station_m": 3.4}, {"table": rates, "station_m": 10.0}, {"table": WIND_PLANE}],
    }


def in_plane(model, plane: str) -> Array:
    """Return the rates of the states of `vehicle_plant` by these states; yaw in its mirrored axes."""
    pitch = plane == "pitch"
    shape, side = ("eta", "pitch") if pitch else ("xi", "yaw")
    names = ["w_mps", "q_radps", "theta_rad"] if pitch else ["v_mps", "r_radps", "psi_rad"]
    names += [f"{shape}_{i}_m" for i in (1, 2)] + [f"{shape}_{i}_rate_mps" for i in (1, 2)]
    names += [f"slosh_1_{side}_rad", f"slosh_1_{side}_rate_radps"]
    sign = np.array([1.0 if pitch or not name.startswith(("r_", "psi")) else -1.0 for name in names])
    at = [model.states.index(name) for name in names]
    return np.asarray(sign[:, None] * model.a[np.ix_(at, at)] * sign)


@pytest.mark.parametrize("plane", ["pitch", "yaw"])
def test_flexible_vehicle_along_its_axis(plane: str) -> None:
    """Every entry agrees: rigid body, modes, slosh, and damping with the mass properties."""
    damping = {"time_s": [0.0], "x_Nms": [5e3], "y_Nms": [8e4], "z_Nms": [5e4]}
    made = made_of(FLEXIBLE, symmetric(), [300.0, 0.0, 0.0], {"rate_damping": damping})
    made.packed.memory[0].held.burning = 1
    node = node_of(made.packed, 0.0, plane=plane)
    ours, theirs = node.plant, linearise(made.packed, made.packed.state, 0.0)
    np.testing.assert_allclose(in_plane(theirs, plane), ours.a, rtol=TOLERANCE, atol=1e-8)


@pytest.mark.parametrize("plane", ["pitch", "yaw"])
def test_rigid_vehicle_at_its_trim(plane: str) -> None:
    """The planar slopes, and Z_alpha, M_alpha and M_q from them, agree for asymmetric tables at an angle of attack."""
    alpha, beta = np.radians((6.0, -4.0))
    speed = 290.0
    flow = speed * np.array([math.cos(alpha) * math.cos(beta), math.sin(beta), math.sin(alpha) * math.cos(beta)])
    parts = dataclasses.replace(RIGID, engine=True, thrust_N=1e5)
    aero = {"interpolation": "pchip", "moment_reference_m": 6.2, "coefficients": [{"table": t} for t in ALL]}
    made = made_of(parts, aero, [*flow])
    made.packed.memory[0].held.burning = 1
    node = node_of(made.packed, 0.0, plane=plane)
    model = linearise(made.packed, made.packed.state, 0.0)
    names, sign = (("w_mps", "q_radps"), 1.0) if plane == "pitch" else (("v_mps", "r_radps"), -1.0)
    force, turn = columns(model, names, names) * np.array([[1.0, sign], [sign, 1.0]])
    d = node.derivatives
    np.testing.assert_allclose([d.z_alpha_1ps, d.m_alpha_1ps2 / speed, d.m_q_1ps], [force[0], *turn], rtol=TOLERANCE)


ROUND = {
    "table": {
        "mach": [0.0, 0.7, 2.0],
        "CA": [0.3, 0.35, 0.4],
        "CD": [0.1, 0.07, 0.05],
        "Cmq": [-30.0, -40.0, -50.0],
        "C_crossflow": [4.0, 5.0, 9.0],
        "Cm0": [0.02, 0.05, 0.01],
    },
    "surface": [{"table": {"mach": [0.0, 0.8, 2.0], "CN_alpha_pr": [2.0, 3.0, 2.2], "station_m": [11.0, 10.0, 10.5]}}],
}


def inclined(trim_deg: tuple[float, float], coefficients: list[Tree], loads: Tree | None = None, **changes: Any) -> Rig:
    """Return a flexible vehicle with liquid and an engine at an angle of attack, with tables, slopes and cross-flow."""
    alpha, beta = np.radians(trim_deg)
    flow = 290.0 * np.array([math.cos(alpha) * math.cos(beta), math.sin(beta), math.sin(alpha) * math.cos(beta)])
    aero = symmetric() | ROUND | {"coefficients": coefficients}
    made = made_of(FLEXIBLE, aero, [*flow], loads=loads, **changes)
    made.packed.memory[0].held.burning = 1
    return made


@pytest.mark.parametrize("trim_deg", [(6.0, -4.0), (-3.0, 0.0), (2.0, 9.0)])
def test_flexible_vehicle_at_its_trim(trim_deg: tuple[float, float]) -> None:
    """Every coefficient of both planes agrees: asymmetric tables, body and modes, angle of attack and sideslip."""
    tables = [*symmetric()["coefficients"][:2], *({"table": t, "station_m": 4.0 + k} for k, t in enumerate(ALL))]
    made = inclined(trim_deg, tables)
    theirs = linearise(made.packed, made.packed.state, 0.0)
    for plane in ("pitch", "yaw"):
        node = node_of(made.packed, 0.0, plane=plane)
        assert node.trim == pytest.approx(np.radians(trim_deg), abs=1e-9)
        ours = node.plant
        scale = np.abs(ours.a).max(axis=1, keepdims=True)
        np.testing.assert_allclose(in_plane(theirs, plane) / scale, ours.a / scale, rtol=TOLERANCE, atol=1e-10)


def test_what_other_states_do_to_one_plane_in_incidence() -> None:
    """At alpha 4 deg, beta 2 deg, other states change the response of a plane as docs/model.md, section 6, states."""
    made = inclined((4.0, 2.0), symmetric()["coefficients"])
    model, hz = linearise(made.packed, made.packed.state, 0.0), np.geomspace(0.05, 30.0, 25)
    apart = []
    for axis, plane in enumerate(("pitch", "yaw")):
        path = fixed_path(node_of(made.packed, 0.0, plane=plane), "exact")
        assert isinstance(path, ExactFixedPath)
        out, eye = model.states.index(f"gyro_{plane}_radps"), np.eye(len(model.a))
        whole = np.array([np.linalg.solve(2j * np.pi * f * eye - model.a, model.b[:, axis])[out] for f in hz])
        apart.append(np.abs(whole / path.plant_at(2j * np.pi * hz) - 1.0))
    worst = np.max(apart, axis=0)
    for above_hz, bound in ((0.9, 2.5e-2), (1.2, 1e-2), (10.0, 2.5e-3)):
        assert 0.1 * bound < worst[hz >= above_hz].max() < bound
    assert worst.max() > 1.0, "near the short period, 0.25 Hz, one plane says little"


def test_moving_reference_and_floor() -> None:
    aero = symmetric() | {"moment_reference_over_mass": {"mass_kg": [4000.0, 5000.0], "station_m": [6.4, 5.4]}}
    del aero["moment_reference_m"]
    aero["table"] = aero["table"] | {"CN_alpha_pr": [3.0, 2.5], "Cm_alpha_pr": [-2.0, -1.0]}
    made = made_of(FLEXIBLE, aero, [300.0, 0.0, 0.0])
    made.packed.memory[0].held.burning = 1
    node = node_of(made.packed, 0.0)
    ours, theirs = node.plant, linearise(made.packed, made.packed.state, 0.0)
    np.testing.assert_allclose(in_plane(theirs, "pitch"), ours.a, rtol=TOLERANCE, atol=1e-8)
    below = made_of(FLEXIBLE, symmetric() | {"airspeed_floor_mps": 301.0}, [300.0, 0.0, 0.0])
    below.packed.memory[0].held.burning = 1
    node = node_of(below.packed, 0.0)
    ours, theirs = node.plant, linearise(below.packed, below.packed.state, 0.0)
    np.testing.assert_allclose(in_plane(theirs, "pitch"), ours.a, rtol=TOLERANCE, atol=1e-8)
