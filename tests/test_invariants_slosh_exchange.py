"""Liquid that moves between bobs and core in empty space conserves momentum and loses only the expected energy.

| quantity | expected |
|---|---|
| linear momentum, angular momentum about the common CG; one bob shrinks, one grows | constant to 1e-8 |
| the same without the switch | changes by more than a hundredth, so the test can fail |
| energy | falls by the impact of the arriving liquid (closed form) |
| linear model | equals the linearised simulator to 1e-8 |
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from flightkit import Mode, Parts, Rig, Tank, oracle_vehicle, rig, scenario_of, to_oracle, with_stage
from oracles import multibody_sympy
from oracles.planar.plant import vehicle_plant
from oracles.planar.vehicle_at import vehicle_at
from scipy.interpolate import PchipInterpolator
from test_oracle_linear_model import TOLERANCE, VEHICLE_STATES, flat_earth, plane_states

from maxq import Flight
from maxq.control.kernel.records import Array
from maxq.design.model.linearised import linearise
from maxq.sim.run.fly import fly
from maxq.sim.scenario.loader import load_scenario
from maxq.sim.vehicle import state as layout

END_S = 2.0
TIMES_S = np.linspace(0.0, END_S, 401)  # dense: core and bobs are joined each by themselves between the rows
SHRINKING = 400.0 - 300.0 * np.sin(0.25 * np.pi * TIMES_S) ** 2
GROWING = 200.0 + 150.0 * TIMES_S
STATIONS = (0.0, 3.0, 5.0, 10.0, 12.0, 14.0)
MODE = Mode(3.0, 600.0, (1.2, 0.3, -0.4, -0.5, 0.6, 1.1), (-0.35, -0.3, -0.15, 0.2, 0.3, 0.3))
PARTS = Parts(
    core_mass_kg=1500.0,
    core_inertia=((1.0e3, 0.0, 0.0), (0.0, 9.0e3, 0.0), (0.0, 0.0, 9.0e3)),
    tanks=(Tank(SHRINKING[0], 0.5, 5.0), Tank(GROWING[0], 0.7, 10.0)),
    pitch=(MODE,),
    yaw=(replace(MODE, frequency_hz=3.3, mass_kg=540.0, phi=tuple(1.2 * x for x in MODE.phi)),),
    engine=False,
)


def vehicle_of(time_s: float, parts: Parts = PARTS) -> Parts:
    """Return the parts at a time: liquid lost by a bob is in the core, at the bob's rest position."""
    first, second = parts.tanks
    masses = [float(PchipInterpolator(TIMES_S, m)(time_s)) for m in (SHRINKING, GROWING)]
    x, _, _ = parts.core_cg
    inertia = np.array(parts.core_inertia)
    gains = [(t.mass_kg - m, t.hinge_station_m + t.length_m) for t, m in zip((first, second), masses, strict=True)]
    core = parts.core_mass_kg + sum(gain for gain, _ in gains)
    cg = (parts.core_mass_kg * x + sum(gain * at for gain, at in gains)) / core
    across = parts.core_mass_kg * (x - cg) ** 2 + sum(gain * (at - cg) ** 2 for gain, at in gains)
    inertia = inertia + np.diag([0.0, across, across])
    tanks = tuple(replace(t, mass_kg=m) for t, m in zip((first, second), masses, strict=True))
    return replace(
        parts, core_mass_kg=core, core_cg=(cg, 0.0, 0.0), core_inertia=tuple(map(tuple, inertia)), tanks=tanks
    )


def stirred(step_s: float, exchange: bool = True, parts: Parts = PARTS) -> Rig:
    tables = [
        {
            "time_s": TIMES_S,
            "slosh_mass_kg": mass,
            "pendulum_length_m": np.full(len(TIMES_S), tank.length_m),
            "hinge_station_m": np.full(len(TIMES_S), tank.hinge_station_m),
        }
        for tank, mass in zip(parts.tanks, (SHRINKING, GROWING), strict=True)
    ]
    tree = scenario_of(parts, run={"step_s": step_s}, switches={"slosh_exchange": exchange})
    made = rig(with_stage(tree, tank=[{"table": table, "damping_ratio": 0.0} for table in tables]))
    y = made.y
    y[layout.V_I : layout.V_I + 3] = [0.3, 0.2, -0.1]
    y[layout.W_BI_B : layout.W_BI_B + 3] = [0.4, -0.3, 0.5]
    if parts.pitch:
        i, j = int(layout.eta_index(made.sizes)), int(layout.xi_index(made.sizes))
        y[i : i + 2], y[j : j + 2] = [0.05, 0.4], [-0.03, 0.3]
    for k, (u, turn) in enumerate((([-0.8, 0.5, 0.33], [0.5, -2.0, 1.5]), ([-0.7, -0.6, 0.4], [-0.7, 1.0, 1.3]))):
        b = int(layout.pendulum_index(made.sizes, k))
        y[b : b + 3] = u / np.linalg.norm(u)
        y[b + 3 : b + 6] = np.cross(turn, y[b : b + 3])
    return made


def constants(made: Rig, time_s: float) -> tuple[Array, Array]:
    """Return the linear momentum, and the angular momentum about the common CG (I)."""
    parts = vehicle_of(time_s)
    vehicle, state = oracle_vehicle(parts), to_oracle(made, made.y)
    moved = multibody_sympy.momentum(vehicle, state)
    masses = [parts.core_mass_kg, *(tank.mass_kg for tank in parts.tanks)]
    places = [state.r_I_m.copy()]
    for k, tank in enumerate(parts.tanks):
        shape = [m.phi[STATIONS.index(tank.hinge_station_m)] for m in (parts.yaw[0], parts.pitch[0])]
        bent = np.array([0.0, shape[0] * state.xi_m[0], shape[1] * state.eta_m[0]])
        place = np.array([parts.core_cg[0] - tank.hinge_station_m, 0.0, 0.0]) + bent + tank.length_m * state.u_B[k]
        places.append(state.r_I_m + state.C_IB @ place)
    cg = np.average(places, axis=0, weights=masses)
    linear = moved["linear_I_Ns"]
    return linear, moved["angular_I_Nms"] - np.cross(cg, linear)


def wander(step_s: float, exchange: bool) -> tuple[float, float]:
    """Return the largest relative change of linear and angular momentum in the flight."""
    made = stirred(step_s, exchange)
    run = made.run()
    linear, angular = constants(made, 0.0)
    worst = [0.0, 0.0]
    for n in range(1, 21):
        run.fly_segment(round(0.05e9 * END_S))
        now, spin = constants(made, n * 0.05 * END_S)
        worst[0] = max(worst[0], float(np.linalg.norm(now - linear) / np.linalg.norm(linear)))
        worst[1] = max(worst[1], float(np.linalg.norm(spin - angular) / np.linalg.norm(angular)))
    return worst[0], worst[1]


@pytest.mark.slow
def test_momentum_is_constant_with_the_exchange_and_not_without() -> None:
    """With the exchange, momentum is constant to 1e-8 at 1 ms; the rest is interpolation between table rows."""
    linear, angular = wander(0.001, True)
    assert linear < 1e-8
    assert angular < 1e-8
    linear, angular = wander(0.001, False)
    assert linear > 0.01
    assert angular > 0.01


def test_energy_falls_by_the_impact_of_what_arrives() -> None:
    """Energy falls by the perfectly inelastic impact at the bob, and by the work of rotation as liquid settles at rest.

    The reference is a difference quotient of the energy along the derivative, masses included.
    """
    parts, time_s, h = replace(PARTS, pitch=(), yaw=()), 0.8, 1e-5
    made = stirred(0.001, parts=parts)
    y, slope = made.y.copy(), made.derivative(made.y, time_s)
    ends = []
    for sign in (1.0, -1.0):
        now = vehicle_of(time_s + sign * h, parts)
        made.y[:] = y + sign * h * slope
        ends.append(multibody_sympy.energy(oracle_vehicle(now), to_oracle(made, made.y))["total_J"])
    power = (ends[0] - ends[1]) / (2.0 * h)

    now, w = vehicle_of(time_s, parts), y[layout.W_BI_B : layout.W_BI_B + 3]
    speeds, places, rests = [], [], []
    for k, tank in enumerate(now.tanks):
        b = int(layout.pendulum_index(made.sizes, k))
        hinge = np.array([now.core_cg[0] - tank.hinge_station_m, 0.0, 0.0])
        places.append(hinge + tank.length_m * y[b : b + 3])
        rests.append(hinge - [tank.length_m, 0.0, 0.0])
        speeds.append(np.cross(w, hinge) + tank.length_m * y[b + 3 : b + 6])  # relative to the core's CG
    masses = [tank.mass_kg for tank in now.tanks]
    drift = sum(m * v for m, v in zip(masses, speeds, strict=True)) / (sum(masses) + now.core_mass_kg)
    wanted = 0.0
    for k, table in enumerate((SHRINKING, GROWING)):
        flow = -float(PchipInterpolator(TIMES_S, table).derivative()(time_s))
        at_bob, at_rest = np.cross(w, places[k]), np.cross(w, rests[k])
        if flow > 0.0:
            wanted -= 0.5 * flow * np.sum((speeds[k] - at_bob) ** 2)
            wanted += 0.5 * flow * (np.sum((at_bob - drift) ** 2) - np.sum((at_rest - drift) ** 2))
        else:
            wanted += 0.5 * flow * np.sum((speeds[k] - at_rest) ** 2) + flow * (at_bob - at_rest) @ (at_rest - drift)
    assert wanted < -100.0
    assert power == pytest.approx(wanted, rel=1e-5)


@pytest.fixture(scope="module")
def flight() -> Flight:
    return fly(load_scenario("nominal", ["run.duration_s=56"]))


GROWS = (
    "vehicle.stage.0.tank.0.table={time_s=[0, 100], slosh_mass_kg=[50, 250], pendulum_length_m=[0.27, 0.3],"
    " hinge_station_m=[8.6, 9.6]}"
)


@pytest.mark.parametrize(("time_s", "changes"), [(55, ()), (20, (GROWS,))], ids=["shrinking", "growing"])
def test_linear_model_has_the_same_exchange(flight: Flight, time_s: int, changes: tuple[str, ...]) -> None:
    packed, condition = flat_earth(flight, time_s, "switches.slosh_exchange=true", *changes)
    simulated = linearise(packed, packed.state, time_s)
    vehicle = vehicle_at(packed, time_s, condition.mach)
    ours = vehicle_plant(vehicle, condition).a
    at = [simulated.states.index(name) for name in plane_states("pitch")[:VEHICLE_STATES]]
    np.testing.assert_allclose(simulated.a[np.ix_(at, at)], ours, rtol=TOLERANCE, atol=1e-8)
    plain = vehicle_plant(replace(vehicle, slosh_exchange=False), condition).a
    assert np.abs(ours - plain).max() > 1e-3
