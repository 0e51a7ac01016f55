"""Boosters agree with closed forms, hand calculations and the multibody oracle.

| case | against |
|---|---|
| core and boosters with their own propellant, ignition, burnout and separation | the rocket equation |
| off-axis liquid in a booster held at two stations of a bent core | Lagrange |
| thrust, drag and lift of a single booster | sums of moments about the CG, with products of inertia |
| softening of a core behind an attachment, and by a rigid booster | work of all forces and particles |
| a separation while core, liquid, engine and modes move | the motion of each particle, before and after |
| the linear model, with boosters and after them | the difference of two flights |
"""

from __future__ import annotations

import copy
import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from flightkit import (
    EMPTY_SPACE,
    Rig,
    Tree,
    accelerations,
    load,
    merged,
    oracle_vehicle,
    rig,
    scenario_of,
    to_oracle,
    to_simulator,
)
from oracles import multibody_sympy
from oracles import multibody_system as system
from scipy.integrate import solve_ivp
from test_oracle_dynamics import random_parts, random_state, worst

from maxq import ScenarioError
from maxq.control.kernel.records import Array
from maxq.design import operating_points
from maxq.design.model.node_times import node_times
from maxq.sim.run.fly import fly
from maxq.sim.scenario.loader import load_scenario_text
from maxq.sim.vehicle import state as layout


def engine(thrust_N: float, burn_s: float, station_m: float, **more: Any) -> Tree:
    table = {"time_s": [0.0, burn_s], "thrust_vacuum_N": [thrust_N, thrust_N]}
    return {"table": table, "gimbal_station_m": station_m, "exit_station_m": station_m + 0.5, "gimbal": "fixed"} | more


def solid(name: str, place: tuple[float, float], ignition_s: float = 0.0, **engines: Any) -> Tree:
    """Return a booster of 1000 kg that expels 600 kg in 12 s."""
    return {
        "name": name,
        "position_m": place,
        "attachments_m": [9.0],
        "ignition_s": ignition_s,
        "mass": {
            "mass_kg": 1000.0,
            "x_cg_m": 8.0,
            "inertia_kgm2": [[50.0, 0.0, 0.0], [0.0, 900.0, 0.0], [0.0, 0.0, 900.0]],
            "mass_flow_kgps": 50.0,
            "burn_s": 12.0,
        },
        "engine": engine(120e3, 12.0, 10.0, **engines),
    }


def core(separation: Tree, boosters: list[Tree], **more: Any) -> Tree:
    mass = {
        "mass_kg": 4000.0,
        "x_cg_m": 6.0,
        "inertia_kgm2": [[400.0, 0.0, 0.0], [0.0, 3.0e4, 0.0], [0.0, 0.0, 3.0e4]],
        "mass_flow_kgps": 40.0,
        "burn_s": 60.0,
    }
    return {"mass": mass, "engine": engine(110e3, 60.0, 11.0), "booster": boosters} | separation | more


def launcher(*stages: Tree, **sections: Any) -> Tree:
    vehicle = {
        "name": "boosters",
        "reference": {"length_m": 12.0, "diameter_m": 1.0, "area_m2": 0.8},
        "stage": [*stages],
    }
    start = {"euler_deg": [0.0, 0.0, 0.0], "ned_mps": [0.0, 0.0, 0.0]}
    return merged({"schema": 1, "vehicle": vehicle, "initial": start} | EMPTY_SPACE, sections)


AFTER = {"continues": True, "clock": "preceding"}
PAIR = [solid("left", (0.0, -1.2)), solid("right", (0.0, 1.2))]


def test_bodies_with_their_own_propellant_obey_the_rocket_equation() -> None:
    """A pair burns from 0 to 12 s, the other from 3 to 15 s, and all leave at 16.5 s.

    In each interval thrust and flow are constant: the gain is F / m' ln(m_0 / m_1).
    """
    pairs = [*PAIR, solid("upper", (-1.2, 0.0), 3.0), solid("lower", (1.2, 0.0), 3.0)]
    tree = launcher(core({"separation_after_burnout_s": 1.5}, pairs), core(AFTER, []), run={"duration_s": 40.0})
    flight = fly(load(tree))
    t, mass, speed = flight.time_s("mass_kg"), flight["mass_kg"], flight["v_I_x_mps"]
    speeds, kilograms, v, m = {0.0: 0.0}, {0.0: 8000.0}, 0.0, 8000.0
    for begin, end, thrust, flow in (
        (0.0, 3.0, 350e3, 140.0),
        (3.0, 12.0, 590e3, 240.0),
        (12.0, 15.0, 350e3, 140.0),
        (15.0, 16.5, 110e3, 40.0),
        (16.5, 40.0, 110e3, 40.0),
    ):
        m = 4000.0 - 40.0 * 16.5 if begin == 16.5 else m
        left = m - flow * (end - begin)
        v, m = v + thrust / flow * math.log(m / left), left
        speeds[end], kilograms[end] = v, m
    assert [(e.name, e.time_s, e.stage) for e in flight.events if e.name in ("separation", "burnout")] == [
        ("separation", 16.5, 1)
    ]
    assert [(e.name, e.time_s, e.detail) for e in flight.events if e.name.startswith("booster")] == [
        ("booster_ignition", 0.0, "left"),
        ("booster_ignition", 0.0, "right"),
        ("booster_ignition", 3.0, "upper"),
        ("booster_ignition", 3.0, "lower"),
        ("booster_burnout", 12.0, "left"),
        ("booster_burnout", 12.0, "right"),
        ("booster_burnout", 15.0, "upper"),
        ("booster_burnout", 15.0, "lower"),
    ]
    for at in (3.0, 12.0, 15.0, 16.5, 40.0):
        k = int(np.argmin(np.abs(t - at)))
        kg = 4000.0 - 40.0 * 16.5 if at == 16.5 else kilograms[at]  # the row of that instant is behind the separation
        assert mass[k] == pytest.approx(kg, rel=1e-12)
        assert speed[k] == pytest.approx(speeds[at], rel=1e-9)


def test_operating_points_are_on_both_sides_of_the_separation() -> None:
    """Boosters leave at 12.5 s, the core burns to 60 s.

    The points are 0.2 % of a stage from the separation, and 0.5 and 1.5 % from the other ends.
    """
    stages = core({"separation_after_burnout_s": 0.5}, PAIR), core(AFTER, [])
    for each in stages:
        each["engine"] = engine(110e3, 60.0, 11.0, gimbal="both")
    times_s = node_times(load(launcher(*stages, run={"duration_s": 70.0})))
    assert len(times_s) == 22
    assert (times_s[0], times_s[10], times_s[11], times_s[21]) == pytest.approx(
        (0.0625, 12.475, 12.595, 59.2875), abs=2e-3
    )
    assert np.diff(times_s[:11]) == pytest.approx(1.24125, abs=2e-3)


def test_core_that_ignites_in_flight() -> None:
    """The core ignites at 10 s, two seconds before the boosters burn out; its tables are over the stage clock."""
    late = {"ignition_s": 10.0}
    tree = launcher(
        core({"separation_after_burnout_s": 0.5} | late, PAIR), core(AFTER | late, []), run={"duration_s": 20.0}
    )
    for stage in tree["vehicle"]["stage"]:
        stage["engine"]["table"]["time_s"], stage["mass"]["burn_s"] = [0.0, 70.0], 70.0
    flight = fly(load(tree))
    t, thrust = flight.time_s("thrust_N"), flight["thrust_N"]
    for at, newton in ((5.0, 240e3), (11.0, 350e3), (12.3, 110e3), (15.0, 110e3)):
        assert thrust[int(np.argmin(np.abs(t - at)))] == pytest.approx(newton, rel=1e-12)
    assert flight["mass_kg"][-1] == pytest.approx(4000.0 - 40.0 * 10.0, rel=1e-12)


def single(**sections: Any) -> Tree:
    booster = solid("only", (0.9, -0.6)) | {
        "aero": {"table": {"mach": [0.0, 2.0], "CA": [0.3, 0.3], "CN_alpha_pr": [1.5, 1.5], "station_m": [7.0, 7.0]}}
    }
    aero = {"table": {"mach": [0.0, 2.0], "CA": [0.2, 0.2], "CN_alpha_pr": [2.0, 2.0], "x_cp_m": [4.0, 4.0]}}
    stage = core({}, [booster], aero=aero)
    return launcher(stage, **sections)


def test_thrust_drag_and_lift_of_a_single_booster() -> None:
    """The acceleration follows from sums over both bodies, with J of point sums and every force at its own point."""
    air = {"model": "constant", "density_kgpm3": 0.8, "pressure_Pa": 0.0, "temperature_K": 280.0}
    flow = np.array([150.0, 6.0, 9.0])
    made = rig(single(atmosphere=air, initial={"ned_mps": flow.tolist(), "euler_deg": [0.0, 0.0, 0.0]}))
    y = made.y.copy()
    dy = made.derivative(y)
    bodies = [(4000.0, np.array([-6.0, 0.0, 0.0]), np.diag([400.0, 3e4, 3e4]))]
    bodies.append((1000.0, np.array([-8.0, 0.9, -0.6]), np.diag([50.0, 900.0, 900.0])))
    total = sum(m for m, *_ in bodies)
    cg = sum(m * r for m, r, _ in bodies) / total
    inertia = sum(j + m * ((r - cg) @ (r - cg) * np.eye(3) - np.outer(r - cg, r - cg)) for m, r, j in bodies)
    q = 0.5 * 0.8 * 0.8  # density, area; forces per speed squared
    lift = np.array([0.0, *(-q * flow[0] * flow[1:])])
    forces = [
        (np.array([-11.0, 0.0, 0.0]), np.array([110e3, 0.0, 0.0])),
        (np.array([-10.0, 0.9, -0.6]), np.array([120e3, 0.0, 0.0])),
        (np.array([0.0, 0.0, 0.0]), np.array([-q * 0.2 * flow[0] ** 2, 0.0, 0.0])),
        (np.array([0.0, 0.9, -0.6]), np.array([-q * 0.3 * flow[0] ** 2, 0.0, 0.0])),
        (np.array([-4.0, 0.0, 0.0]), 2.0 * lift),
        (np.array([-7.0, 0.9, -0.6]), 1.5 * lift),
    ]
    force = sum(f for _, f in forces)
    moment = sum(np.cross(r - cg, f) for r, f in forces)
    drift = dy[layout.R_I : layout.R_I + 3] - y[layout.V_I : layout.V_I + 3]  # of the CG in the body
    np.testing.assert_allclose(dy[layout.V_I : layout.V_I + 3], force / total, rtol=1e-12)
    np.testing.assert_allclose(dy[layout.W_BI_B : layout.W_BI_B + 3], np.linalg.solve(inertia, moment), rtol=1e-11)
    lost = [(-40.0, bodies[0][1]), (-50.0, bodies[1][1])]
    np.testing.assert_allclose(drift, sum(m * (r - cg) for m, r in lost) / total, rtol=1e-9)


def off_axis(place: tuple[float, float] = (1.1, 0.7)) -> tuple[Tree, system.Vehicle, Any]:
    """Return random parts with a booster held at stations 5 and 10, with its own liquid, also as one vehicle."""
    rng = np.random.default_rng(7)
    parts = random_parts(rng, alike=False)
    parts = replace(parts, tanks=parts.tanks[:1])
    dry, bob, length, hinge = 800.0, 150.0, 0.45, 8.3
    whole, cg = dry + bob, (dry * 9.0 + bob * (hinge + length)) / (dry + bob)
    lateral = 700.0 + dry * (9.0 - cg) ** 2 + bob * (hinge + length - cg) ** 2
    booster = {
        "name": "side",
        "position_m": place,
        "attachments_m": [5.0, 10.0],
        "mass": {
            "mass_kg": whole,
            "x_cg_m": cg,
            "inertia_kgm2": [[60.0, 0.0, 0.0], [0.0, lateral, 0.0], [0.0, 0.0, lateral]],
        },
        "tank": [
            {
                "table": [{"time_s": 0.0, "slosh_mass_kg": bob, "pendulum_length_m": length, "hinge_station_m": hinge}],
                "damping_ratio": 0.0,
            }
        ],
    }
    tree = scenario_of(parts)
    tree["vehicle"]["stage"][0]["booster"] = [booster]
    bodies = [(parts.core_mass_kg, np.array([-parts.core_cg[0], *parts.core_cg[1:]]), np.array(parts.core_inertia))]
    bodies.append((dry, np.array([-9.0, *place]), np.diag([60.0, 700.0, 700.0])))
    mass = sum(m for m, *_ in bodies)
    centre = sum(m * r for m, r, _ in bodies) / mass
    inertia = sum(
        j + m * ((r - centre) @ (r - centre) * np.eye(3) - np.outer(r - centre, r - centre)) for m, r, j in bodies
    )
    core_cg = (-float(centre[0]), float(centre[1]), float(centre[2]))
    alone = oracle_vehicle(replace(parts, core_mass_kg=mass, core_cg=core_cg, core_inertia=tuple(map(tuple, inertia))))
    at = {station: k for k, station in enumerate(parts.stations_m)}

    def held(modes: tuple[Any, ...]) -> Array:
        return np.array([m.phi[at[5.0]] + (m.phi[at[10.0]] - m.phi[at[5.0]]) / 5.0 * (hinge - 5.0) for m in modes])

    point = np.array([core_cg[0] - hinge, place[0] - core_cg[1], place[1] - core_cg[2]])
    own = system.Pendulum(bob, length, point, 0.0, held(parts.pitch), held(parts.yaw))
    return tree, replace(alone, pendulums=(*alone.pendulums, own)), rng


@pytest.mark.slow
def test_liquid_off_the_axis_of_a_bent_core_agrees_with_lagrange() -> None:
    tree, vehicle, rng = off_axis()
    made = rig(tree)
    y = to_simulator(made, random_state(rng, 2))
    theirs = multibody_sympy.accelerations(vehicle, to_oracle(made, y))
    assert worst(accelerations(made, y), theirs) < 1e-10


SHAPES = (np.polynomial.Polynomial([1.0, -0.5, 0.04, 0.0]), np.polynomial.Polynomial([0.3, 0.4, -0.12, 0.006]))
MODAL_KG, FIRST_M, SECOND_M = 500.0, 4.0, 10.0


def bent_launcher(soft: bool, carries: bool) -> Tree:
    """Return a core of uniform mass from 0 to 12 m that carries two boosters at 4 m, with liquid, and at 10 m.

    Without boosters, the thrust of fixed engines enters at 7.5 m in addition to that at 12 m.
    """
    stations = np.array([0.0, 2.0, FIRST_M - 1e-6, FIRST_M, 7.0, SECOND_M, 12.0])
    pair = [copy.deepcopy(each) | {"attachments_m": [FIRST_M, SECOND_M]} for each in PAIR]
    for each in pair:
        each["mass"] = {key: value for key, value in each["mass"].items() if key not in ("mass_flow_kgps", "burn_s")}
        liquid = {"time_s": 0.0, "slosh_mass_kg": 200.0, "pendulum_length_m": 0.5, "hinge_station_m": 6.5}
        each["tank"] = [{"table": [liquid], "damping_ratio": 0.0}]
    stage = core({}, pair if carries else [])
    stage["mass"] = {key: value for key, value in stage["mass"].items() if key not in ("mass_flow_kgps", "burn_s")}
    stage["engine"] |= {"gimballed_mass_kg": 150.0, "cg_from_gimbal_m": 0.6, "inertia_about_gimbal_kgm2": 90.0}
    stage["engine"] |= {"gimbal_station_m": 12.0, "exit_station_m": 13.0, "gimbal": "both"}
    if not carries:
        stage["engine"] = [stage["engine"], engine(240e3, 60.0, 7.5)]
    forward = 3850.0 * stations / 12.0 + 2000.0 * (stations >= FIRST_M) * carries
    rows = []
    for n, shape in enumerate(SHAPES, start=1):
        mode = {"time_s": 0.0, "mode": n, "frequency_hz": 3.0 * n, "generalized_mass_kg": MODAL_KG}
        for x, m in zip(stations, forward, strict=True):
            place = {"station_m": float(x), "phi": float(shape(x)), "slope_pm": float(shape.deriv()(x))}
            rows.append(mode | place | {"mass_forward_kg": float(m)})
    stage["bending"] = {"pitch": rows, "damping_ratio": [0.0, 0.0]}
    return launcher(stage, switches={"bending_softening": soft}, run={"duration_s": 10.0})


def axial_work(eta: Array, carries: bool) -> float:
    """Return the work of thrust and axial inertia on the bent vehicle, per axial acceleration, to second order, kg m.

    A point aft of a bent length moves forward by half the integral of the squared slope. A booster turns about its
    first attachment as its second one demands.
    """
    s = np.linspace(0.0, 12.0, 120001)
    slope = sum(e * shape.deriv()(s) for e, shape in zip(eta, SHAPES, strict=True))
    nearer = np.concatenate([[0.0], np.cumsum(0.25 * (slope[1:] ** 2 + slope[:-1] ** 2) * np.diff(s))])
    particles = np.full(len(s), 3850.0 / 120000.0)
    particles[[0, -1]] *= 0.5
    ends = [sum(e * shape(x) for e, shape in zip(eta, SHAPES, strict=True)) for x in (FIRST_M, SECOND_M)]
    lean = (ends[1] - ends[0]) / (SECOND_M - FIRST_M)

    def of_booster(x: float) -> float:
        return float(np.interp(FIRST_M, s, nearer)) + 0.5 * lean**2 * (x - FIRST_M)

    mass, thrust = 6000.0 if carries else 4000.0, np.array([110e3, 120e3, 120e3])
    accel = thrust.sum() / mass
    work = thrust[0] / accel * nearer[-1] - particles @ nearer
    work -= 150.0 * (nearer[-1] + 0.5 * slope[-1] ** 2 * 0.6)  # the engine behind its gimbal
    if not carries:
        return float(work + 240e3 / accel * np.interp(7.5, s, nearer))
    dry_m = (1000.0 * 8.0 - 200.0 * 7.0) / 800.0
    for push in thrust[1:]:
        work += push / accel * of_booster(10.0) - 800.0 * of_booster(dry_m) - 200.0 * of_booster(6.5)
    return float(work)


@pytest.mark.parametrize("carries", [True, False], ids=["boosters", "two stations of gimbals"])
def test_boosters_push_and_hang_on_a_bent_core(carries: bool) -> None:
    """The core carries the mass forward less the boosters' thrust behind the first attachments, in part in tension."""
    pulled = []
    for soft in (True, False):
        made = rig(bent_launcher(soft, carries))
        first, columns = int(layout.eta_index(made.sizes)), []
        for n in range(2):
            y = made.y.copy()
            ends = []
            for side in (1.0, -1.0):
                y[first + n] = side * 1e-3
                ends.append(made.derivative(y)[first + 2 : first + 4].copy())
            columns.append((ends[0] - ends[1]) / 2e-3)
        pulled.append(np.array(columns).T)
    softening = MODAL_KG * (pulled[0] - pulled[1]) / (350e3 / (6000.0 if carries else 4000.0))
    units = [(1.0, 0.0), (0.0, 1.0), (1.0, 1.0)]
    (a, b, both) = (2.0 * axial_work(np.array(unit), carries) for unit in units)
    wanted = np.array([[a, 0.5 * (both - a - b)], [0.5 * (both - a - b), b]])
    np.testing.assert_allclose(softening, wanted, rtol=1e-6, atol=1e-6 * np.abs(wanted).max())


def dropped(a: tuple[float, float] = (0.3, -0.04), instant_s: float = 2e-6) -> Tree:
    """Return the vehicle of `off_axis` after its booster left: the modes are the old ones plus rigid motion."""
    tree, _, _ = off_axis()
    stage = tree["vehicle"]["stage"][0]
    later = copy.deepcopy(stage) | AFTER
    del later["booster"]
    for plane in ("pitch", "yaw"):
        for row in later["bending"][plane]:
            row["phi"] += a[0] + a[1] * row["station_m"]
            row["slope_pm"] += a[1]
    return merged(
        tree,
        {
            "vehicle": {"stage": [stage | {"separation_s": instant_s}, later]},
            "run": {"step_s": 1e-6, "duration_s": 1e-4},
            "switches": {"control": False},
        },
    )


def places(made: Rig, y: Array, stage: int, rows: dict[str, Any]) -> dict[str, tuple[Array, Array]]:
    """Return place and velocity in I of points of the bent axis, and of the core's bob."""
    p = made.packed.parameters[stage].vehicle
    table = made.packed.pool[p.schedule.offset + p.schedule.n_breaks :]
    station, cg_y, cg_z = table[1:4]
    turn = system.rotation_from_quaternion(y[layout.Q_BI : layout.Q_BI + 4])
    w = y[layout.W_BI_B : layout.W_BI_B + 3]
    sizes = p.sizes
    i, j, n = int(layout.eta_index(sizes)), int(layout.xi_index(sizes)), int(sizes.pitch_modes)
    out = {}
    for x in (0.0, 5.0, 12.0):
        phi_z, phi_y = (np.array([r["phi"] for r in rows[plane] if r["station_m"] == x]) for plane in ("pitch", "yaw"))
        rho = np.array([station - x, phi_y @ y[j : j + n] - cg_y, phi_z @ y[i : i + n] - cg_z])
        rate = np.array([0.0, phi_y @ y[j + n : j + 2 * n], phi_z @ y[i + n : i + 2 * n]])
        rate += np.cross(w, [station - x, -cg_y, -cg_z])
        out[f"axis at {x:g} m"] = rho, rate
    k = int(layout.pendulum_index(sizes, 0))
    length = 0.5
    hinge, moving = out["axis at 5 m"]
    out["bob"] = hinge + length * y[k : k + 3], moving + length * y[k + 3 : k + 6]
    at, v = y[layout.R_I : layout.R_I + 3], y[layout.V_I : layout.V_I + 3]
    return {name: (at + turn @ place, v + turn @ velocity) for name, (place, velocity) in out.items()}


def test_parts_that_remain_keep_their_motion() -> None:
    """Axis, bob and engine keep place and velocity, although CG, axes and modes change.

    Each remaining mass keeps its motion, and the separated part has the rest of the momentum.
    """
    tree = dropped()
    made = rig(tree)
    rng = np.random.default_rng(3)
    state = random_state(rng, 2, bent_m=1e-6, moving=True)
    state = replace(state, etadot_mps=1e-3 * state.etadot_mps, xidot_mps=1e-3 * state.xidot_mps)
    state = replace(state, w_BI_B_radps=1e-2 * state.w_BI_B_radps)
    made.y[:] = to_simulator(made, state)
    run = made.run()
    run.fly_segment(1000)
    first = run.packed.state.copy()
    run.fly_segment(1000)
    before = run.packed.state.copy()
    run.fly_segment(1000)
    after = run.packed.state.copy()
    assert [e.name for e in run.events if e.name == "separation"] == ["separation"]
    stages = tree["vehicle"]["stage"]
    old, new = (places(made, y, k, stages[k]["bending"]) for k, y in enumerate((before, after)))
    for name in old:
        (place, velocity), (later, moved) = old[name], new[name]
        np.testing.assert_allclose(later - place, 1e-6 * velocity, atol=2e-9, err_msg=name)
        np.testing.assert_allclose(moved, velocity, atol=1e-4, err_msg=name)  # 100 m/s2 over a step of 1 us
    assert np.linalg.norm(before[layout.R_I : layout.R_I + 3] - after[layout.R_I : layout.R_I + 3]) > 0.2
    actuator = slice(layout.ACTUATOR, layout.ACTUATOR + 12)
    np.testing.assert_allclose(after[actuator], 2.0 * before[actuator] - first[actuator], atol=1e-7)


def test_gimballed_boosters_and_what_they_leave_behind() -> None:
    """Engine groups, tanks and TVC loads of a remaining booster keep their angles; the others are gone."""
    link = {"frequency_hz": 20.0, "damping_ratio": 0.05}
    servo = {"model": "second-order", "omega_hz": [6.0], "zeta": [0.7], "angle_limit_deg": 8, "rate_limit_degps": 90}
    moves = {"gimbal": "both", "gimballed_mass_kg": 40.0, "cg_from_gimbal_m": 0.3, "inertia_about_gimbal_kgm2": 9.0}
    pair = [solid("stays", (0.0, -1.2), **moves), solid("leaves", (0.0, 1.2), **moves)]
    one = {"slosh_mass_kg": 60.0, "pendulum_length_m": 0.4, "hinge_station_m": 7.0, "time_s": 0.0}
    for booster in pair:
        booster["tank"] = [{"table": [one], "damping_ratio": 0.01}]
    more = {"tvc_load": link, "actuator": servo}
    first, second = core({"separation_s": 0.3}, pair, **more), core(AFTER, pair[:1], **more)
    for stage in (first, second):
        stage["engine"] = engine(110e3, 60.0, 11.0, **moves)
    deflect = {"at": "gimbal_command", "axis": "pitch", "kind": "sine", "amplitude_deg": 2.0, "frequency_hz": 1.0}
    tree = launcher(first, second, run={"duration_s": 0.31, "step_s": 1e-4}, injection=[deflect])
    tree["vehicle"]["computer"] = {
        "sample_s": 0.01,
        "delay_s": 0.0,
        "count_rad": 0.0,
        "angle_error_limit_deg": 20.0,
        "command_limit_deg": 6.0,
    }
    made = rig(tree)
    run = made.run()
    run.fly_segment(300_000_000)
    before = run.packed.state.copy()
    run.fly_segment(100_000)
    after = run.packed.state.copy()
    old, new = (list(layout.state_names(p.vehicle.sizes)) for p in made.packed.parameters)
    shared = [name for name in new if "slosh" in name or "gimbal" in name or "actuator" in name or "tvc" in name]
    assert len(shared) == 6 + 24 + 12
    assert len(old) - len(new) == 6 + 12 + 6
    moved = [abs(before[old.index(name)]) for name in shared]
    for name in shared:
        assert after[new.index(name)] == pytest.approx(before[old.index(name)], rel=0.05, abs=0.02), name
    assert sum(value > 1e-3 for value in moved) >= 12


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"name": "left"}, "another booster has this name"),
        ({"attachments_m": [3.0, 3.0]}, "both ends are held at one station"),
        ({"ignition": 1.0}, "unknown key"),
    ],
)
def test_wrong_boosters_are_refused_in_a_line(change: Tree, said: str) -> None:
    tree = launcher(core({"separation_s": 20.0}, [PAIR[0], PAIR[1] | change]), core(AFTER, []))
    with pytest.raises(ScenarioError, match=said):
        load(tree)


def test_a_vehicle_with_boosters_reads_back_to_the_bit() -> None:
    loaded = load(launcher(core({"separation_after_burnout_s": 1.0}, PAIR), core(AFTER, [])))
    assert load_scenario_text(loaded.as_flown).scenario == loaded.scenario


def test_boosters_of_a_stage_that_continues_are_those_before() -> None:
    swapped = launcher(core({"separation_s": 20.0}, PAIR), core(AFTER, PAIR[1:]))
    with pytest.raises(ScenarioError, match=r'stage\.1\.booster = "right": boosters that stay are the first'):
        load(swapped)
    with pytest.raises(ScenarioError, match=r'stage\.1\.clock = "own": .* allowed: "preceding"'):
        load(launcher(core({"separation_s": 20.0}, PAIR), core({"continues": True}, [])))


@pytest.mark.parametrize(("stage", "instant_s"), [(0, 1.0), (1, 13.0)])
def test_linear_model_is_the_difference_of_two_flights(stage: int, instant_s: float) -> None:
    """A step of the gimbals turns the body and moves the liquid as in the linear model, with boosters and after them.

    The flights start at the operating point with the vehicle frozen; the model is integrated by SciPy.
    """
    pair = copy.deepcopy(PAIR)
    one = {"slosh_mass_kg": 90.0, "pendulum_length_m": 0.6, "hinge_station_m": 7.2, "time_s": 0.0}
    for booster in pair:
        booster["tank"] = [{"table": [one], "damping_ratio": 0.02}]
    stages = core({"separation_after_burnout_s": 0.5}, pair), core(AFTER, [])
    for each in stages:
        each["engine"] = engine(110e3, 60.0, 11.0, gimbal="both")
        each["tank"] = [{"table": [one | {"slosh_mass_kg": 200.0, "hinge_station_m": 4.0}], "damping_ratio": 0.01}]
    computer = {"sample_s": 0.01, "delay_s": 0.0, "count_rad": 0.0, "angle_error_limit_deg": 20.0}
    tree = launcher(*stages, run={"duration_s": 20.0})
    tree["vehicle"]["computer"] = computer | {"command_limit_deg": 6.0}
    (node,) = operating_points.nodes(load(tree), [instant_s])
    assert node.stage == stage
    plant = node.plant
    n = len(plant.states)
    assert n == 3 + 2 * (3 if stage == 0 else 1)
    amplitude, duration = 1e-3, 1.2
    b = plant.b[:, [name.startswith("delta_rad") for name in plant.inputs]].sum(axis=1)
    acts_s = duration - 0.01  # the first sample is that of 10 ms
    found = solve_ivp(lambda t, x: plant.a @ x + amplitude * b, (0.0, acts_s), np.zeros(n), rtol=1e-9, atol=1e-12)
    step = {
        "at": "gimbal_command",
        "axis": "pitch",
        "kind": "step",
        "amplitude_deg": math.degrees(amplitude),
        "start_s": 0.0,
    }
    alone = copy.deepcopy(tree)
    held = tree["vehicle"]["stage"][stage] | {"separation_s": 30.0}
    held = {k: v for k, v in held.items() if k not in ("separation_after_burnout_s", "continues", "clock")}
    del held["separation_s"]
    alone["vehicle"]["stage"] = [held]
    alone["run"] = {"duration_s": duration, "stop_at": [], "freeze_vehicle_at_s": instant_s}
    flights = [fly(load(alone | {"injection": injected})) for injected in ([], [step])]
    rates = [f["w_BI_B_y_radps"] for f in flights]
    assert rates[1][-1] - rates[0][-1] == pytest.approx(found.y[1, -1], rel=1e-3)


def test_a_booster_that_fails_keeps_its_propellant() -> None:
    """With the left engine off from 5 s, 750 kg stay, the thrust is one-sided, and the other booster's burnout counts.

    The pitch acceleration is the moment about the CG of all bodies over the inertia by sums of points.
    """
    off = {"kind": "engine-off", "stage": 0, "engine": 1, "at_s": 5.0}
    tree = launcher(
        core({"separation_after_burnout_s": 1.0}, PAIR), core(AFTER, []), run={"duration_s": 14.0}, fault=[off]
    )
    flight = fly(load(tree))
    t, mass = flight.time_s("mass_kg"), flight["mass_kg"]
    assert [(e.name, e.time_s, e.detail) for e in flight.events if e.name == "booster_burnout"] == [
        ("booster_burnout", 5.0, "left"),
        ("booster_burnout", 12.0, "right"),
    ]
    assert [e.time_s for e in flight.events if e.name == "separation"] == [13.0]
    at = [int(np.argmin(np.abs(t - time))) for time in (12.9, 13.5)]
    assert mass[at] == pytest.approx([4000.0 - 40.0 * 12.9 + 750.0 + 400.0, 4000.0 - 40.0 * 13.5], rel=1e-9)
    k = int(np.argmin(np.abs(t - 5.2)))
    bodies = [(4000.0 - 40.0 * t[k], np.array([-6.0, 0.0, 0.0]), 3e4)]
    bodies += [(750.0, np.array([-8.0, 0.0, -1.2]), 900.0), (1000.0 - 50.0 * t[k], np.array([-8.0, 0.0, 1.2]), 900.0)]
    total = sum(m for m, *_ in bodies)
    cg = sum(m * r for m, r, _ in bodies) / total
    about_y = sum(j + m * ((r - cg) @ (r - cg)) for m, r, j in bodies)
    moment = 110e3 * (0.0 - cg[2]) + 120e3 * (1.2 - cg[2])
    rate = flight["w_BI_B_y_radps"]
    grows = (rate[k + 1] - rate[k - 1]) / (t[k + 1] - t[k - 1])
    assert grows == pytest.approx(moment / about_y, rel=2e-2)  # jet damping and the change over 0.1 s are below


def test_burn_rate_and_late_separation_of_boosters() -> None:
    """A burn rate of 1.2 expels the same mass in 10 s; a separation 5 s later leaves the core its propellant."""
    pair = copy.deepcopy(PAIR)
    for booster in pair:
        booster["engine"]["mass_flow_factor"] = 1.2
    tree = launcher(core({"separation_after_burnout_s": 5.0}, pair), core(AFTER, []), run={"duration_s": 20.0})
    flight = fly(load(tree))
    t, mass, thrust = flight.time_s("mass_kg"), flight["mass_kg"], flight["thrust_N"]
    assert [e.time_s for e in flight.events if e.name in ("booster_burnout", "separation")] == [10.0, 10.0, 15.0]
    for at, kg, newton in ((5.0, 5200.0, 398e3), (12.0, 4320.0, 110e3), (16.0, 3360.0, 110e3)):
        k = int(np.argmin(np.abs(t - at)))
        assert (mass[k], thrust[k]) == pytest.approx((kg, newton), rel=1e-9)


@pytest.mark.parametrize("interpolation", ["linear", "pchip"])
def test_thrust_above_zero_ends_with_the_propellant(interpolation: str) -> None:
    """A thrust of 110 kN over the whole flow, then a coast, gives v = F / m' ln(m_0 / m_1)."""
    steady = engine(110e3, 60.0, 11.0) | {"table": {"time_s": [0.0, 60.0], "thrust_vacuum_N": [110e3, 110e3]}}
    tree = launcher(core({"interpolation": interpolation}, [], engine=steady), run={"duration_s": 70.0})
    flight = fly(load(tree))
    assert [(e.name, e.time_s) for e in flight.events if e.name == "burnout"] == [("burnout", 60.0)]
    assert flight["mass_kg"][-1] == pytest.approx(1600.0, rel=1e-12)
    assert flight["v_I_x_mps"][-1] == pytest.approx(110e3 / 40.0 * math.log(4000.0 / 1600.0), rel=1e-9)
