"""The engine on the compliance of its actuators (docs/model.md, section 14) agrees with independent solutions.

| case | against |
|---|---|
| all coupled: modes, tanks, full inertia, engine free in both planes | Lagrange: accelerations, hinge moment |
| one plane under thrust, engine hanging behind a bent gimbal | Lagrange of finite rotations, linearised (SymPy) |
| engine and body, two inertias on one spring | closed form |
| energy and momentum, damping off | conserved |
| Dahl's friction, hard stop | first integrals |
| modes of KSR-III with the engine on 15.6 Hz | matrices written out here, and the review's figures |
"""

from __future__ import annotations

import math
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
import scipy.linalg
import sympy as sp
from flightkit import (
    Mode,
    Parts,
    Rig,
    Tank,
    accelerations,
    flown,
    oracle_vehicle,
    rig,
    scenario_of,
    to_oracle,
    with_stage,
)
from flightkit import to_simulator as locked_state
from oracles import multibody_sympy
from oracles.hand_model import planar_of
from oracles.multibody_system import State, rotation_from_quaternion
from oracles.planar.plant import vehicle_plant
from oracles.planar.vehicle_at import PlanarVehicle

from maxq.control.kernel.records import Array
from maxq.design.model.node import nodes_along
from maxq.sim.input.files import scenarios_folder
from maxq.sim.scenario.loader import load_scenario
from maxq.sim.vehicle import state as layout

STATIONS = (0.0, 3.0, 5.0, 10.0, 12.0, 14.0)
FREQUENCY_HZ = 15.6


def parts_of(rng: np.random.Generator) -> Parts:
    a = rng.normal(size=(3, 3))
    inertia = np.diag([8.0e3, 5.0e4, 5.2e4]) + 100.0 * (a + a.T)

    def mode(frequency_hz: float, phi: Array) -> Mode:
        slope = np.gradient(phi, STATIONS) + rng.normal(0.0, 0.05, len(STATIONS))  # a shape that the file may hold
        return Mode(frequency_hz, rng.uniform(300.0, 900.0), tuple(phi), tuple(slope), 0.01)

    shapes = rng.normal(0.0, 0.8, (2, len(STATIONS)))
    return Parts(
        core_mass_kg=4000.0,
        core_cg=(7.0, 0.04, -0.07),
        core_inertia=tuple(map(tuple, inertia)),
        tanks=(Tank(400.0, 0.5, 5.0, 0.0), Tank(700.0, 0.7, 10.0, 0.0)),
        pitch=(mode(6.0, shapes[0]), mode(11.0, shapes[1])),
        yaw=(mode(6.5, shapes[0]), mode(12.0, shapes[1])),
        gimbal_offset_m=(0.02, -0.03),
        engine_mass_kg=250.0,
        engine_cg_m=0.6,
        engine_inertia_kgm2=60.0,
    )


def loaded(parts: Parts, load: dict[str, float] | None = None, **sections: object) -> Rig:
    given = {"frequency_hz": FREQUENCY_HZ, "damping_ratio": 0.04} if load is None else load
    return rig(with_stage(scenario_of(parts, **sections), tvc_load=given))


def with_engine(made: Rig, y: Array, angle_rad: Array, rate_radps: Array) -> Array:
    """Return the state with the engine at these angles (pitch, yaw) and rates."""
    out, first = y.copy(), int(layout.tvc_load_index(made.sizes))
    for axis in range(2):
        out[first + 3 * axis], out[first + 3 * axis + 1] = angle_rad[axis], rate_radps[axis]
    return out


def random_state(rng: np.random.Generator, modes: int, tanks: int) -> State:
    u = rng.normal(size=(tanks, 3))
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    u_dot = rng.normal(size=(tanks, 3))
    u_dot -= np.sum(u * u_dot, axis=1, keepdims=True) * u
    return State(
        C_IB=rotation_from_quaternion(rng.normal(size=4)),
        w_BI_B_radps=rng.normal(size=3),
        r_I_m=rng.normal(0.0, 100.0, 3),
        v_I_mps=rng.normal(0.0, 20.0, 3),
        eta_m=0.1 * rng.normal(size=modes),
        etadot_mps=rng.normal(size=modes),
        xi_m=0.1 * rng.normal(size=modes),
        xidot_mps=rng.normal(size=modes),
        u_B=u,
        udot_B_1ps=u_dot,
    )


@pytest.mark.parametrize("tanks", [0, 1, 2])
@pytest.mark.parametrize("seed", range(2))
def test_free_engine_agrees_with_lagrange(seed: int, tanks: int) -> None:
    """Large angles and rates agree: from the engine's accelerations, the oracle computes the moment that they need."""
    rng = np.random.default_rng(500 + seed)
    parts = parts_of(rng)
    parts = replace(parts, tanks=parts.tanks[:tanks])
    made = loaded(parts)
    y = locked_state(made, random_state(rng, 2, tanks))
    y = with_engine(made, y, rng.normal(0.0, 0.3, 2), rng.normal(size=2))
    y[layout.ACTUATOR : layout.ACTUATOR + 12] = rng.normal(0.0, 0.02, 12)
    ours = accelerations(made, y)
    moment = made.aux.tvc_loads.hinge_moment_Nm[:2].copy()
    engine = to_oracle(made, y)
    assert np.abs(engine.deflection_radps2).min() > 1.0
    theirs = multibody_sympy.accelerations(oracle_vehicle(parts), engine)
    for key, value in ours.items():
        if theirs[key].size:
            np.testing.assert_allclose(value, theirs[key], rtol=0.0, atol=1e-10 * np.abs(theirs[key]).max())
    np.testing.assert_allclose(moment, theirs["actuator_torque_Nm"], rtol=1e-9)


def stiff(**changes: object) -> Parts:
    return replace(
        Parts(engine_mass_kg=180.0, engine_cg_m=0.4, engine_inertia_kgm2=20.0, core_cg=(7.0, 0.0, 0.0)), **changes
    )  # type: ignore[arg-type]  # fields of Parts


def free_inertia(parts: Parts) -> float:
    """Return the inertia of an engine about its hinge when the body is free to move."""
    first = parts.engine_mass_kg * parts.engine_cg_m
    about_gimbal = parts.engine_inertia_kgm2 + first * parts.engine_cg_m
    lever = about_gimbal + first * (parts.gimbal_station_m - parts.core_cg[0])
    return about_gimbal - first**2 / parts.core_mass_kg - lever**2 / parts.core_inertia[1][1]


@pytest.mark.parametrize("axis", [0, 1])
def test_engine_and_body_are_two_inertias_on_a_spring(axis: int) -> None:
    parts, angle, rate = stiff(), 1e-4 * np.eye(2)[axis], 1e-3 * np.eye(2)[axis]
    made = loaded(parts, {"stiffness_Nmprad": 4.0e5, "damping_ratio": 0.05})
    about_gimbal = parts.engine_inertia_kgm2 + parts.engine_mass_kg * parts.engine_cg_m**2
    damping = 2.0 * 0.05 * math.sqrt(4.0e5 * about_gimbal)
    first = int(layout.tvc_load_index(made.sizes)) + 3 * axis
    swing = made.derivative(with_engine(made, made.y, angle, rate))[first + 1]
    assert np.isclose(swing, -(4.0e5 * 1e-4 + damping * 1e-3) / free_inertia(parts), rtol=1e-6)
    # on the hold-down the body does not give way; what it carries pulls the engine straight
    held = loaded(
        parts,
        {"frequency_hz": FREQUENCY_HZ, "damping_ratio": 0.0},
        earth={"gravity": "uniform", "uniform_mps2": 9.8},
        initial={"euler_deg": [0.0, 90.0, 0.0]},
    )
    held.held.on_pad = 1
    swing = held.derivative(with_engine(held, held.y, angle, 0.0 * rate))[first + 1]
    weight = parts.engine_mass_kg * parts.engine_cg_m * 9.8
    assert np.isclose(swing / 1e-4, -((2.0 * np.pi * FREQUENCY_HZ) ** 2 + weight / about_gimbal), rtol=1e-6)


def test_floating_engine_hangs_on_its_gimbal() -> None:
    """On the hold-down without actuator force, the engine is a pendulum under the body's specific force."""
    parts = stiff()
    made = loaded(
        parts,
        earth={"gravity": "uniform", "uniform_mps2": 9.8},
        initial={"euler_deg": [0.0, 90.0, 0.0]},
        fault=[{"kind": "actuator-floating", "at_s": 0.0, "axis": "yaw"}],
    )
    flown(made, 0.001)
    made.held.on_pad = 1
    angles, first = np.array([1e-4, 1e-4]), int(layout.tvc_load_index(made.sizes))
    rates = made.derivative(with_engine(made, made.y, angles, np.zeros(2)))
    about_gimbal = parts.engine_inertia_kgm2 + parts.engine_mass_kg * parts.engine_cg_m**2
    weight = parts.engine_mass_kg * parts.engine_cg_m * 9.8 / about_gimbal
    assert np.isclose(rates[first + 4] / 1e-4, -weight, rtol=1e-6)
    assert np.isclose(rates[first + 1] / 1e-4, -weight - (2.0 * np.pi * FREQUENCY_HZ) ** 2, rtol=1e-6)


def test_energy_and_momentum_are_conserved() -> None:
    """The error of energy and momentum is that of the integrator: a sixteenth with half the step."""
    rng = np.random.default_rng(7)
    parts = parts_of(rng)
    pitch, yaw = (tuple(replace(mode, zeta=0.0) for mode in plane) for plane in (parts.pitch, parts.yaw))
    parts, stiffness = replace(parts, pitch=pitch, yaw=yaw), 3.0e5
    state = replace(random_state(rng, 2, 2), r_I_m=np.zeros(3), v_I_mps=np.zeros(3))
    state = replace(state, w_BI_B_radps=0.2 * state.w_BI_B_radps, etadot_mps=0.1 * state.etadot_mps)
    vehicle, drifts = oracle_vehicle(parts), []
    for step_s in (0.001, 0.0005):
        made = loaded(
            parts,
            {"stiffness_Nmprad": stiffness, "damping_ratio": 0.0},
            run={"step_s": step_s},
            switches={"actuator": "ideal", "control": False},
        )
        made.y[:] = with_engine(made, locked_state(made, state), np.array([0.05, -0.03]), np.array([0.4, 0.3]))
        kept = []
        for now in flown(made, 1.0):
            seen = to_oracle(made, now)
            total = multibody_sympy.energy(vehicle, seen)["total_J"]
            total += 0.5 * stiffness * float(seen.deflection_rad @ seen.deflection_rad)
            momentum = multibody_sympy.momentum(vehicle, seen)
            kept.append((np.array([total]), momentum["linear_I_Ns"], momentum["angular_I_Nms"]))
        drifts.append([np.abs(b - a).max() / np.abs(a).max() for a, b in zip(*kept, strict=True)])
    assert max(drifts[1]) < 2e-5
    assert (np.array(drifts[0]) / drifts[1] > 14.0).all()


def test_friction_takes_what_dahl_says() -> None:
    """Rising through the friction, I v^2 / 2 + T (d - theta (1 - exp(-d / theta))) is constant."""
    parts, torque, theta, rate = stiff(), 60.0, math.radians(0.2), 0.4
    made = loaded(
        parts,
        {"stiffness_Nmprad": 1e-6, "damping_ratio": 0.0, "friction_Nm": torque, "friction_angle_deg": 0.2},
        switches={"control": False},
    )
    made.y[:] = with_engine(made, made.y, np.zeros(2), np.array([rate, 0.0]))
    first, inertia = int(layout.tvc_load_index(made.sizes)), free_inertia(parts)
    for now in flown(made, 0.05, 0.01)[1:]:
        angle, speed = now[first], now[first + 1]
        work = torque * (angle - theta * (1.0 - math.exp(-angle / theta)))
        assert speed > 0.0
        assert np.isclose(0.5 * inertia * (rate**2 - speed**2), work, rtol=2e-4)  # the body turns along: 1e-4
        assert np.isclose(now[first + 2], 1.0 - math.exp(-angle / theta), rtol=1e-6)


def test_stop_is_a_stiff_spring() -> None:
    parts, stop, contact = stiff(), math.radians(5.0), 5.0e6
    tree = scenario_of(parts, switches={"control": False}, run={"step_s": 0.0001})
    tree = with_stage(tree, actuator={"stop_deg": 5.0})
    made = rig(
        with_stage(tree, tvc_load={"stiffness_Nmprad": 1e-6, "damping_ratio": 0.0, "stop_stiffness_Nmprad": contact})
    )
    made.y[:] = with_engine(made, made.y, np.array([stop - 0.01, 0.0]), np.array([0.5, 0.0]))
    first = int(layout.tvc_load_index(made.sizes))
    angle = flown(made, 0.06, 0.0001)[:, first]
    assert np.isclose(angle.max() - stop, 0.5 * math.sqrt(free_inertia(parts) / contact), rtol=1e-3)
    rate = np.diff(angle[-3:]) / 0.0001
    assert np.allclose(rate, -0.5, rtol=2e-3)  # it comes back as it went


# --- the axial load: one plane, finite rotations


def planar_equations(modes: int) -> tuple[sp.Matrix, sp.Matrix, list[sp.Symbol]]:
    """Return the mass and stiffness matrices over (z, theta, eta.., delta) about axial flight at the specific force a.

    The core with the engine locked has its free-free modes. The locked engine is subtracted, and the engine added at
    the gimbal of the bent axis, turned by theta + sum sigma eta - delta. Thrust acts along the engine.
    """
    m, j, m_e, l_e, i_t, arm, k, a = sp.symbols("m j m_e l_e i_t arm k a", positive=True)
    phi, sigma, mass, stiffness = (sp.symbols(f"{name}:{modes}") for name in ("phi", "sigma", "mass", "stiff"))
    names = ["z", "theta", *[f"eta{i}" for i in range(modes)], "delta"]
    q, rates, (x, x_rate) = sp.symbols(names), sp.symbols([f"{name}_rate" for name in names]), sp.symbols("x x_rate")
    z, theta, eta, delta = q[0], q[1], q[2:-1], q[-1]
    slope = sum(s * e for s, e in zip(sigma, eta, strict=True))
    shift = sum(p * e for p, e in zip(phi, eta, strict=True))

    def squared_rate(place: sp.Expr) -> sp.Expr:
        return sum(place.diff(c) * rate for c, rate in zip([*q, x], [*rates, x_rate], strict=True)) ** 2

    def engine(angle: sp.Expr) -> sp.Expr:
        """Return the kinetic energy of the engine, its axis at theta + slope - angle (about y, from x to -z)."""
        turn = theta + slope - angle
        at_x = x - arm * sp.cos(theta) + shift * sp.sin(theta) - l_e * sp.cos(turn)
        at_z = z + arm * sp.sin(theta) + shift * sp.cos(theta) + l_e * sp.sin(turn)
        return m_e / 2 * (squared_rate(at_x) + squared_rate(at_z)) + i_t / 2 * squared_rate(turn)

    kinetic = m / 2 * (squared_rate(x) + squared_rate(z)) + j / 2 * squared_rate(theta)
    kinetic += sum(w / 2 * squared_rate(e) for w, e in zip(mass, eta, strict=True))
    kinetic += engine(delta) - engine(sp.Integer(0))
    potential = k / 2 * delta**2 + sum(s / 2 * e**2 for s, e in zip(stiffness, eta, strict=True))
    # thrust m a along the engine, at the gimbal
    turn = theta + slope - delta
    gimbal_x = x - arm * sp.cos(theta) + shift * sp.sin(theta)
    gimbal_z = z + arm * sp.sin(theta) + shift * sp.cos(theta)
    # Lagrange's equations to first order about rest, where only x accelerates: terms with two rates vanish
    at_rest = dict.fromkeys([*q, x], 0)
    momenta = [kinetic.diff(rate) for rate in rates]
    inertia = sp.Matrix([[p.diff(rate).subs(at_rest) for rate in rates] for p in momenta])
    rows = []
    for c, momentum in zip(q, momenta, strict=True):
        thrust = m * a * (sp.cos(turn) * gimbal_x.diff(c) - sp.sin(turn) * gimbal_z.diff(c))
        row = momentum.diff(x_rate) * a + potential.diff(c) - thrust
        rows.append([row.diff(by).subs(at_rest) for by in q])
    symbols = [m, j, m_e, l_e, i_t, arm, k, a, *phi, *sigma, *mass, *stiffness]
    return inertia, sp.Matrix(rows), symbols


def stiff_air(vehicle: PlanarVehicle) -> PlanarVehicle:
    """Return the vehicle without liquid, mass flow, modal damping and softening by the core's own load."""
    modes, body = vehicle.modes, vehicle.body
    n = len(modes.omega_radps)
    bare = replace(modes, damping_ratio=np.zeros(n), phi_hinge=np.zeros((n, 0)), softening_kgpm=np.zeros((n, n)))
    return replace(
        vehicle,
        modes=bare,
        body=replace(body, core_cg_rate_mps=0.0, total_mass_kg=body.core_mass_kg),
        pendulums=type(vehicle.pendulums)(*(np.zeros(0) for _ in fields(vehicle.pendulums))),
        jet_damping=False,
    )


@pytest.mark.slow
def test_axial_load_and_bent_gimbal_agree_with_lagrange() -> None:
    """The axial load acts on the hinge through the displacements of the engine and the slope of the gimbal."""
    node = nodes_along(load_scenario("nominal", [load_of(0.0)]), [30.0])[0]
    vehicle = stiff_air(planar_of(node))
    condition = replace(node.condition, airspeed_mps=0.0, gravity_mps2=0.0)
    plant = vehicle_plant(vehicle, condition)
    engine, modes, load = vehicle.engine, vehicle.modes, vehicle.engine.tvc_load
    assert load is not None
    mass, arm = engine.gimballed_mass_kg, engine.cg_from_gimbal_m
    axial = engine.thrust_N(condition.pressure_Pa) / vehicle.body.core_mass_kg
    inertia, stiffness, symbols = planar_equations(len(modes.omega_radps))
    values = [
        vehicle.body.core_mass_kg,
        vehicle.body.core_inertia_kgm2,
        mass,
        arm,
        engine.inertia_about_gimbal_kgm2 - mass * arm**2,
        engine.gimbal_station_m - vehicle.body.core_cg_station_m,
        load.stiffness_Nmprad,
        axial,
        *modes.phi_gimbal,
        *modes.slope_gimbal_pm,
        *modes.generalized_mass_kg,
        *(modes.generalized_mass_kg * modes.omega_radps**2),
    ]
    numbers = dict(zip(symbols, values, strict=True))
    m, k = (np.array(matrix.subs(numbers).evalf(), float) for matrix in (inertia, stiffness))
    theirs = np.linalg.solve(m, -k)
    n = len(modes.omega_radps)
    accelerations_at = [0, 1, *range(3 + n, 3 + 2 * n), 4 + 2 * n]
    angles_at = [2, *range(3, 3 + n), 3 + 2 * n]  # theta, eta, delta
    ours = plant.a[np.ix_(accelerations_at, angles_at)]
    # in body axes theta tilts the axial specific force out of z'': there, and only there, it does not appear
    np.testing.assert_allclose(ours[:, 1:], theirs[:, 2:], rtol=1e-9, atol=1e-9 * np.abs(theirs).max())


# --- KSR-III

REVIEW_HZ = {5: (8.95, 16.2, 26.8, 46.9), 30: (9.54, 16.6, 31.6, 48.7), 55: (9.91, 17.6, 34.0, 58.4)}


def load_of(damping_ratio: float) -> str:
    return f"vehicle.stage.0.tvc_load={{frequency_hz={FREQUENCY_HZ}, damping_ratio={damping_ratio}}}"


def engine_on_compliance_hz(time_s: float) -> Array:
    """Return the modes of KSR-III's file with its engine on 15.6 Hz, from matrices independent of maxq."""
    folder = Path(scenarios_folder()) / "vehicles/ksr3"
    lines = [line for line in (folder / "modes.csv").read_text().splitlines() if line and not line.startswith("#")]
    head = lines[0].split(",")
    rows = np.array([[float(x) if x not in ("pitch", "yaw") else 0.0 for x in line.split(",")] for line in lines[1:]])
    column = {name: rows[:, k] for k, name in enumerate(head)}
    gimbal_m, first, about_gimbal = 12.7, 180.0 * 0.38, 45.992
    here = (column["time_s"] == time_s) & (np.abs(column["station_m"] - gimbal_m) < 1e-6)
    phi, slope = column["phi"][here], column["slope_pm"][here]
    modal, omega = column["generalized_mass_kg"][here], 2.0 * np.pi * column["frequency_hz"][here]
    node = nodes_along(load_scenario("nominal"), [time_s])[0]
    body = planar_of(node).body
    lever = about_gimbal + first * (gimbal_m - body.core_cg_station_m)
    couple = np.concatenate([[first, lever], first * phi + about_gimbal * slope])
    m = np.diag([body.core_mass_kg, body.core_inertia_kgm2, *modal, about_gimbal])
    m[-1, :-1], m[:-1, -1] = -couple, -couple
    k = np.diag([0.0, 0.0, *(modal * omega**2), about_gimbal * (2.0 * np.pi * FREQUENCY_HZ) ** 2])
    squares = scipy.linalg.eigh(k, m, eigvals_only=True)[2:]
    return np.sqrt(squares) / (2.0 * np.pi)


@pytest.mark.parametrize("time_s", REVIEW_HZ)
def test_review_s_modes_of_ksr3_with_the_engine_on_its_compliance(time_s: int) -> None:
    """The modes equal the review's figures to 0.4 % (its operating points have other masses), bare and as flown."""
    alone = engine_on_compliance_hz(float(time_s))
    np.testing.assert_allclose(alone, REVIEW_HZ[time_s], rtol=4e-3)
    node = nodes_along(load_scenario("nominal", [load_of(0.0)]), [float(time_s)])[0]
    no_thrust = replace(node.condition, pressure_Pa=1e9, airspeed_mps=0.0)
    for vehicle, condition, tolerance in (
        (stiff_air(planar_of(node)), no_thrust, 1e-8),
        (planar_of(node), node.condition, 1.3e-2),  # axial load, thrust and liquid
    ):
        poles = vehicle_plant(vehicle, condition).poles()
        swinging = np.sort(poles[poles.imag > 2.0 * np.pi * 5.0].imag) / (2.0 * np.pi)
        np.testing.assert_allclose(swinging, alone, rtol=tolerance)
