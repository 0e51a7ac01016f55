"""Flights with the production integrator conserve momentum and energy and keep symmetries.

A free multibody vehicle (modes in two planes, two tanks, deflected engine) has no damping, thrust or air.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from flightkit import (
    Mode,
    Parts,
    Rig,
    Tank,
    flown,
    merged,
    oracle_vehicle,
    rig,
    scenario_of,
    to_oracle,
    to_simulator,
    with_stage,
)
from oracles import multibody_sympy
from oracles.multibody_system import State, quaternion_from_rotation, rotation_from_quaternion

from maxq.control.kernel.records import Array
from maxq.sim.vehicle import state as layout

MODES = (
    Mode(3.0, 600.0, (1.2, 0.3, -0.4, -0.5, 0.6, 1.1), (-0.35, -0.3, -0.15, 0.2, 0.3, 0.3)),
    Mode(5.0, 450.0, (-1.1, 0.5, 0.7, -0.6, 0.4, 1.2), (0.5, 0.4, -0.2, -0.3, 0.4, 0.45)),
)
PARTS = Parts(
    core_cg=(7.0, 0.04, -0.07),
    core_inertia=((8.0e3, 150.0, -90.0), (150.0, 5.0e4, 200.0), (-90.0, 200.0, 5.2e4)),
    tanks=(Tank(400.0, 0.5, 5.0), Tank(700.0, 0.7, 10.0)),
    pitch=MODES,
    yaw=tuple(replace(m, frequency_hz=1.1 * m.frequency_hz, mass_kg=0.9 * m.mass_kg) for m in MODES),
    gimbal_offset_m=(0.02, -0.03),
    engine_mass_kg=250.0,
    engine_cg_m=0.6,
    engine_inertia_kgm2=60.0,
)
SYMMETRIC = replace(
    PARTS,
    core_cg=(7.0, 0.0, 0.0),
    core_inertia=((8.0e3, 0.0, 0.0), (0.0, 5.0e4, 0.0), (0.0, 0.0, 5.0e4)),
    tanks=tuple(replace(t, damping_ratio=0.03) for t in PARTS.tanks),
    pitch=tuple(replace(m, zeta=0.01) for m in MODES),
    yaw=tuple(replace(m, zeta=0.01) for m in MODES),
    gimbal_offset_m=(0.0, 0.0),
    thrust_N=1.0e5,
)
DEFLECTED_DEG = (4.0, -3.0)


def free_flight(step_s: float, parts: Parts = PARTS, moving: bool = False) -> Rig:
    """Return a tumbling, bending, sloshing vehicle with its engine deflected at rest, or moved by its actuators."""
    tree = scenario_of(parts, run={"step_s": step_s}, switches={"actuator": "full" if moving else "ideal"})
    if not moving:
        tree = with_stage(tree, actuator={"bias_deg": DEFLECTED_DEG})
    made = rig(tree)
    u = np.array([[-0.6, 0.5, np.sqrt(1 - 0.61)], [-0.2, -0.9, np.sqrt(1 - 0.85)]])
    u_dot = np.cross(np.array([[1.5, -2.0, 0.5], [-1.0, 0.7, 1.3]]), u)
    n = len(parts.pitch)
    start = State(
        C_IB=rotation_from_quaternion(np.array([0.4, -0.3, 0.8, 0.33])),
        w_BI_B_radps=np.array([0.9, -0.5, 0.4]),
        r_I_m=np.array([3.0, -2.0, 1.0]),
        v_I_mps=np.array([1.0, 2.0, -3.0]),
        eta_m=np.array([0.05, -0.03])[:n],
        etadot_mps=np.array([0.4, 0.6])[:n],
        xi_m=np.array([-0.04, 0.02])[:n],
        xidot_mps=np.array([0.5, -0.7])[:n],
        u_B=u,
        udot_B_1ps=u_dot,
        deflection_rad=np.array([0.07, -0.05]) if moving else np.zeros(2),
    )
    actuators = made.y[layout.ACTUATOR : layout.ACTUATOR + 12].copy()
    y = to_simulator(made, start) if moving else _without_engine(made, start)
    if not moving:
        y[layout.ACTUATOR : layout.ACTUATOR + 12] = actuators
    made.y[:] = y
    return made


def _without_engine(made: Rig, start: State) -> Array:
    """Return `to_simulator` for an ideal actuator, whose states have no meaning."""
    plain = rig(scenario_of(replace(PARTS)))
    return to_simulator(plain, start)


def slope(steps: list[float], errors: list[float]) -> float:
    return float(np.polyfit(np.log(steps), np.log(errors), 1)[0])


STEPS = [0.002, 0.001, 0.0005]  # coarser ones are not yet in the asymptotic range


def constants(made: Rig) -> Array:
    vehicle, state = oracle_vehicle(PARTS), to_oracle(made, made.y)
    moved = multibody_sympy.momentum(vehicle, state)
    energy = multibody_sympy.energy(vehicle, state)["total_J"]
    return np.concatenate(([energy], moved["linear_I_Ns"], moved["angular_I_Nms"]))


@pytest.fixture(scope="module")
def drifts() -> dict[bool, list[Array]]:
    """Return the relative change of energy and momenta in 2 s per step size, engine at rest or moving."""
    out: dict[bool, list[Array]] = {False: [], True: []}
    for moving, rows in out.items():
        for step in STEPS:
            made = free_flight(step, moving=moving)
            before = constants(made)
            flown(made, 2.0)
            change = constants(made) - before
            size = [abs(before[0]), *[np.linalg.norm(before[1:4])] * 3, *[np.linalg.norm(before[4:])] * 3]
            rows.append(np.abs(change) / size)
    return out


@pytest.mark.slow
def test_energy_is_conserved_to_the_order_of_the_method(drifts: dict[bool, list[Array]]) -> None:
    energy = [row[0] for row in drifts[False]]
    assert energy[-1] < 1e-10
    assert 4.5 < slope(STEPS, energy) < 5.5  # a swinging system loses energy with order five


@pytest.mark.parametrize("moving", [False, True])
@pytest.mark.parametrize(("first", "name"), [(1, "linear"), (4, "angular")])
def test_momentum_is_conserved_to_the_order_of_the_method(
    drifts: dict[bool, list[Array]], first: int, name: str, moving: bool
) -> None:
    """Momentum is conserved at the order of the method, also while internal forces swing the engine."""
    change = [float(np.linalg.norm(row[first : first + 3])) for row in drifts[moving]]
    assert change[-1] < 1e-11, name
    assert 3.7 < slope(STEPS, change) < 5.2


def test_default_step_conserves_in_a_minute() -> None:
    made = free_flight(0.001)
    before = constants(made)
    flown(made, 60.0)
    change = np.abs(constants(made) - before)
    assert change[0] < 1e-6 * abs(before[0])
    assert np.linalg.norm(change[1:4]) < 1e-8 * np.linalg.norm(before[1:4])
    assert np.linalg.norm(change[4:]) < 1e-8 * np.linalg.norm(before[4:])


def test_actuators_work_is_the_energy_that_a_moving_engine_brings() -> None:
    """At every instant of a swing, dE/dt along the flight equals actuator torque times rate."""
    made = free_flight(0.001, moving=True)
    vehicle = oracle_vehicle(PARTS)
    for y in flown(made, 0.1, 0.02)[1:]:
        dy = made.derivative(y)
        state = to_oracle(made, y)
        torque = multibody_sympy.accelerations(vehicle, state)["actuator_torque_Nm"]
        h = 1e-5
        high = multibody_sympy.energy(vehicle, to_oracle(made, y + h * dy))["total_J"]
        low = multibody_sympy.energy(vehicle, to_oracle(made, y - h * dy))["total_J"]
        power = float(torque @ state.deflection_radps)
        assert abs(power) > 1.0
        assert np.isclose((high - low) / (2 * h), power, rtol=1e-5, atol=0.05)


def test_constraints_hold_all_the_way() -> None:
    made = free_flight(0.004)
    for y in flown(made, 4.0, 0.2)[1:]:
        assert abs(np.linalg.norm(y[layout.Q_BI : layout.Q_BI + 4]) - 1.0) < 1e-14
        for tank in range(2):
            i = int(layout.pendulum_index(made.sizes, tank))
            assert abs(np.linalg.norm(y[i : i + 3]) - 1.0) < 1e-14
            assert abs(y[i : i + 3] @ y[i + 3 : i + 6]) < 1e-13


def test_modes_in_one_plane_only_conserve_energy_and_momentum() -> None:
    """A vehicle that bends in pitch only conserves energy and momentum while it rolls and sloshes.

    The energies are written out here.
    """
    drift = []
    parts = replace(PARTS, yaw=(), pitch=PARTS.pitch[:1], engine_mass_kg=0.0, engine_inertia_kgm2=0.0)
    for step in STEPS:
        made = free_flight_one_plane(step, parts)
        before = one_plane_constants(made, parts)
        flown(made, 4.0)
        drift.append(np.abs(one_plane_constants(made, parts) - before))
    scale = np.abs(before)
    assert drift[-1][0] < 1e-6 * scale[0]
    assert np.linalg.norm(drift[-1][1:4]) < 1e-7 * np.linalg.norm(scale[1:4])
    assert np.linalg.norm(drift[-1][4:]) < 1e-7 * np.linalg.norm(scale[4:])


def free_flight_one_plane(step_s: float, parts: Parts) -> Rig:
    made = rig(scenario_of(parts, run={"step_s": step_s}))
    whole = free_flight(step_s)
    n = layout.N_FIXED
    made.y[:n] = whole.y[:n]
    made.y[n], made.y[n + 1] = 0.05, 0.4
    made.y[n + 2 :] = whole.y[n + 8 :]
    return made


def one_plane_constants(made: Rig, parts: Parts) -> Array:
    """Return energy, linear and angular momentum (in I, about its origin) of core, one pitch mode and two bobs.

    The bent core keeps its momenta (displacements of first order); a hinge moves with its displacement along z.
    """
    y = made.y
    c_ib = rotation_from_quaternion(y[layout.Q_BI : layout.Q_BI + 4])
    w, v = y[layout.W_BI_B : layout.W_BI_B + 3], c_ib.T @ y[layout.V_I : layout.V_I + 3]
    mode, eta, rate = parts.pitch[0], y[layout.N_FIXED], y[layout.N_FIXED + 1]
    core = np.array(parts.core_inertia)
    energy = 0.5 * parts.core_mass_kg * v @ v + 0.5 * w @ core @ w
    energy += 0.5 * mode.mass_kg * (rate**2 + (2 * np.pi * mode.frequency_hz * eta) ** 2)
    linear, angular = parts.core_mass_kg * v, core @ w
    for k, tank in enumerate(parts.tanks):
        i = int(layout.pendulum_index(made.sizes, k))
        phi = mode.phi[parts.stations_m.index(tank.hinge_station_m)]
        station, side, down = parts.core_cg
        hinge = np.array([station - tank.hinge_station_m, -side, -down + phi * eta])
        u, kappa = y[i : i + 3], y[i + 3 : i + 6]
        speed = v + np.cross(w, hinge) + np.array([0.0, 0.0, phi * rate]) + tank.length_m * kappa
        energy += 0.5 * tank.mass_kg * speed @ speed
        linear = linear + tank.mass_kg * speed
        angular = angular + np.cross(hinge + tank.length_m * u, tank.mass_kg * speed)
    linear_i = c_ib @ linear
    return np.concatenate(([energy], linear_i, c_ib @ angular + np.cross(y[:3], linear_i)))


# --- slosh damping: a fault that a peer ships is a damper that dissipates nothing, or adds energy
def test_slosh_damping_takes_energy_and_leaves_momentum() -> None:
    """The damper's power is -c m L^2 |du/dt|^2 for any motion, and its forces on bob and body are opposite."""
    parts = replace(PARTS, thrust_N=1.0e5)
    rng = np.random.default_rng(7)
    plain = rig(scenario_of(parts))
    damped = rig(scenario_of(replace(parts, tanks=tuple(replace(t, damping_ratio=0.1) for t in parts.tanks))))
    vehicle = oracle_vehicle(parts)
    for _ in range(5):
        y = free_flight(0.001).y.copy()
        y[layout.W_BI_B : layout.W_BI_B + 3] = rng.normal(size=3)
        for k in range(2):
            i = int(layout.pendulum_index(damped.sizes, k))
            y[i : i + 3] = rotation_from_quaternion(rng.normal(size=4))[:, 0]
            y[i + 3 : i + 6] = 2.0 * np.cross(rng.normal(size=3), y[i : i + 3])
        change = damped.derivative(y) - plain.derivative(y)
        state = to_oracle(damped, y)
        axial = damped.aux.axial_load_mps2
        wanted = 0.0
        for k, tank in enumerate(parts.tanks):
            c = 2 * 0.1 * np.sqrt(abs(axial) / tank.length_m)
            wanted -= c * tank.mass_kg * tank.length_m**2 * float(state.udot_B_1ps[k] @ state.udot_B_1ps[k])
        h = 1e-4
        ends = [to_oracle(damped, y + s * h * change) for s in (1.0, -1.0)]
        energy = [multibody_sympy.energy(vehicle, end)["total_J"] for end in ends]
        momenta = [multibody_sympy.momentum(vehicle, end) for end in ends]
        power = (energy[0] - energy[1]) / (2 * h)
        assert power < 0.0
        assert np.isclose(power, wanted, rtol=1e-6)
        for key in ("linear_I_Ns", "angular_I_Nms"):
            size = np.linalg.norm(momenta[0][key])
            assert np.linalg.norm(momenta[0][key] - momenta[1][key]) / (2 * h) < 1e-7 * size


def test_slosh_on_the_pad_comes_to_rest() -> None:
    """On the pad, the bobs' energy in isotropic tanks falls at every sample, in pitch, yaw and whirling motion."""
    tanks = tuple(replace(t, damping_ratio=0.05) for t in PARTS.tanks)
    parts = replace(SYMMETRIC, tanks=tanks, pitch=(), yaw=(), thrust_N=0.0)
    tree = scenario_of(
        parts,
        earth={"gravity": "uniform"},
        initial={"held": True, "euler_deg": [0.0, 90.0, 0.0]},
        holddown={"release": "time", "release_s": 1000.0},
    )
    made = rig(tree)
    u = np.array([[-0.5, 0.6, np.sqrt(0.39)], [-0.8, 0.6, 0.0]])
    kappa = np.array([np.cross([0.0, 2.0, 1.0], u[0]), [0.0, 0.0, 2.0]])
    for k in range(2):
        i = int(layout.pendulum_index(made.sizes, k))
        made.y[i : i + 3], made.y[i + 3 : i + 6] = u[k], kappa[k]
    states = flown(made, 40.0, 0.1)
    for k, tank in enumerate(tanks):
        i = int(layout.pendulum_index(made.sizes, k))
        speed2 = np.sum(states[:, i + 3 : i + 6] ** 2, axis=1) * tank.length_m**2
        energy = tank.mass_kg * (0.5 * speed2 + 9.80665 * tank.length_m * (1.0 + states[:, i]))
        assert (np.diff(energy[:300]) < 0.0).all()
        assert energy[-1] < 1e-3 * energy[0]


# --- the same from elsewhere
GLOBE = {
    "earth": {"shape": "sphere", "rotating": False, "gravity": "inverse_square"},
    "atmosphere": {"model": "us1976"},
}
AERO = {
    "table": [
        {"mach": 0.0, "CA": 0.4, "Cmq": -300.0, "Clp": -5.0, "C_crossflow": 8.0},
        {"mach": 3.0, "CA": 0.6, "Cmq": -200.0, "Clp": -4.0, "C_crossflow": 6.0},
    ],
    "surface": [
        {"table": [{"mach": 0.0, "CN_alpha_pr": 2.2, "station_m": 3.0}]},
        {"table": [{"mach": 0.0, "CN_alpha_pr": 9.0, "station_m": 12.0}]},
    ],
}


def in_air(step_s: float = 0.001, **sections: object) -> Rig:
    start = {"geodetic": {"latitude_deg": 20.0, "longitude_deg": 30.0, "altitude_m": 4000.0}}
    start |= {"euler_deg": [70.0, 60.0, 0.0], "ned_mps": [60.0, 100.0, -250.0]}
    tree = merged(scenario_of(SYMMETRIC, run={"step_s": step_s}), GLOBE | {"initial": start})
    return rig(merged(with_stage(tree, aero=AERO), dict(sections)))


def stirred(made: Rig, both_gimbals: bool = True) -> None:
    """Give the state nonzero rates, engine angles, bending and slosh."""
    y = made.y
    y[layout.W_BI_B : layout.W_BI_B + 3] += [0.3, 0.1, -0.2]
    y[layout.ACTUATOR : layout.ACTUATOR + 6] = [0.03, 0.1, 0.025, 0.0, 0.025, 0.0]
    if both_gimbals:
        y[layout.ACTUATOR + 6 : layout.ACTUATOR + 12] = [-0.02, 0.2, -0.015, 0.1, -0.015, 0.1]
    y[layout.GYRO : layout.GYRO + 9] = 0.05 * np.sin(np.arange(9))
    for first in (layout.eta_index(made.sizes), layout.xi_index(made.sizes)):
        y[first : first + 4] = [0.01, -0.02, 0.3, 0.2]
    for k in range(2):
        i = int(layout.pendulum_index(made.sizes, k))
        u = np.array([-1.0, 0.3 + 0.2 * k, -0.4])
        y[i : i + 3] = u / np.linalg.norm(u)
        y[i + 3 : i + 6] = np.cross([0.4, -1.0, 0.7 + k], y[i : i + 3])


def turned(y: Array, rotation: Array) -> Array:
    """Return the state with position, velocity and attitude rotated in I."""
    out = y.copy()
    for first in (layout.R_I, layout.V_I):
        out[first : first + 3] = rotation @ y[first : first + 3]
    q = slice(layout.Q_BI, layout.Q_BI + 4)
    out[q] = quaternion_from_rotation(rotation @ rotation_from_quaternion(y[q]))
    return out


def test_turning_the_whole_set_up_changes_nothing() -> None:
    """On a round Earth at rest, with air and thrust, a rotated set-up flies the same body motion."""
    rotation = rotation_from_quaternion(np.array([0.3, 0.5, -0.7, 0.2]))
    here, there = in_air(), in_air()
    stirred(here)
    there.y[:] = turned(here.y, rotation)
    flown(here, 2.0)
    flown(there, 2.0)
    wanted = turned(here.y, rotation)
    assert np.linalg.norm(here.y[layout.W_BI_B : layout.W_BI_B + 3]) > 0.01
    same(there.y, wanted)


def test_shift_and_constant_speed_change_nothing_in_empty_space() -> None:
    here, there = free_flight(0.002), free_flight(0.002)
    shift, speed = np.array([300.0, -200.0, 50.0]), np.array([20.0, 10.0, -40.0])
    there.y[:3] += shift
    there.y[3:6] += speed
    flown(here, 2.0)
    flown(there, 2.0)
    assert np.allclose(there.y[:3], here.y[:3] + shift + 2.0 * speed, rtol=0.0, atol=1e-10)
    assert np.allclose(there.y[3:6], here.y[3:6] + speed, rtol=0.0, atol=1e-11)
    assert np.allclose(there.y[6:], here.y[6:], rtol=0.0, atol=1e-10)


def rolled(made: Rig, y: Array) -> Array:
    """Return the motion of a body of revolution with y and z axes rotated by 90 deg.

    The motion in the pitch plane becomes that in the yaw plane: z becomes -y, y becomes z.
    """
    turn = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])  # old B components into new ones
    out = y.copy()
    q = slice(layout.Q_BI, layout.Q_BI + 4)
    out[q] = quaternion_from_rotation(rotation_from_quaternion(y[q]) @ turn.T)
    out[layout.W_BI_B : layout.W_BI_B + 3] = turn @ y[layout.W_BI_B : layout.W_BI_B + 3]
    a = layout.ACTUATOR
    out[a + 6 : a + 12], out[a : a + 6] = y[a : a + 6], -y[a + 6 : a + 12]
    g = layout.GYRO
    out[g + 4 : g + 6], out[g + 2 : g + 4] = y[g + 2 : g + 4], -y[g + 4 : g + 6]
    i = layout.GYRO_ANGLE
    out[i + 2], out[i + 1] = y[i + 1], -y[i + 2]
    eta, xi = layout.eta_index(made.sizes), layout.xi_index(made.sizes)
    out[xi : xi + 4], out[eta : eta + 4] = -y[eta : eta + 4], y[xi : xi + 4]
    for k in range(int(made.sizes.pendulums)):
        for j in (0, 3):
            b = int(layout.pendulum_index(made.sizes, k)) + j
            out[b : b + 3] = turn @ y[b : b + 3]
    return out


def mirrored(made: Rig, y: Array) -> Array:
    """Return the mirror image in the body's x-z plane, with I mirrored in its own y axis."""
    flip, spin = np.diag([1.0, -1.0, 1.0]), np.diag([-1.0, 1.0, -1.0])
    out = y.copy()
    for first in (layout.R_I, layout.V_I):
        out[first : first + 3] = flip @ y[first : first + 3]
    q = slice(layout.Q_BI, layout.Q_BI + 4)
    out[q] = quaternion_from_rotation(flip @ rotation_from_quaternion(y[q]) @ flip)
    out[layout.W_BI_B : layout.W_BI_B + 3] = spin @ y[layout.W_BI_B : layout.W_BI_B + 3]
    a, g, i = layout.ACTUATOR, layout.GYRO, layout.GYRO_ANGLE
    out[a + 6 : a + 12] *= -1.0
    out[g : g + 2] *= -1.0
    out[g + 4 : g + 6] *= -1.0
    out[i] *= -1.0
    out[i + 2] *= -1.0
    xi = layout.xi_index(made.sizes)
    out[xi : xi + 4] *= -1.0
    for k in range(int(made.sizes.pendulums)):
        for j in (0, 3):
            out[int(layout.pendulum_index(made.sizes, k)) + j + 1] *= -1.0
    return out


def same(a: Array, b: Array) -> None:
    """Check that two states are equal; a quaternion and its negative are one attitude."""
    q = slice(layout.Q_BI, layout.Q_BI + 4)
    a, b = a.copy(), b.copy()
    b[q] *= np.sign(a[q] @ b[q])
    for x in (a, b):
        x[layout.GYRO + 1 : layout.GYRO + 6 : 2] /= 2 * np.pi * 60.0  # the gyros' second states, in rad/s
    assert np.allclose(a[:3], b[:3], rtol=0.0, atol=1e-6)
    assert np.allclose(a[3:6], b[3:6], rtol=0.0, atol=1e-8)
    assert np.allclose(a[6:], b[6:], rtol=0.0, atol=1e-9)


@pytest.mark.parametrize(("image", "both_gimbals"), [(rolled, False), (mirrored, True)])
def test_symmetric_vehicle_flies_symmetric(image: Callable[[Rig, Array], Array], both_gimbals: bool) -> None:
    """From a stirred state without commands, thrust, air, bending, slosh, engine and gyros keep the symmetry.

    Two large gimbal angles do not commute, so the quarter turn uses the pitch gimbal alone.
    """
    one, other = in_air(), in_air()
    stirred(one, both_gimbals)
    other.y[:] = image(other, one.y)
    flown(one, 2.0)
    flown(other, 2.0)
    same(image(one, one.y), other.y)


def doublet(axis: str, sign: float) -> list[dict[str, object]]:
    return [
        {
            "at": "gimbal_command",
            "axis": axis,
            "kind": "doublet",
            "amplitude_deg": sign * 2.0,
            "start_s": 0.0,
            "stop_s": 0.6,
            "replaces": True,
        }
    ]


def test_doublets_in_pitch_and_yaw_give_the_same_response() -> None:
    """Positive gimbal angles make positive moments in both planes; the force is +z in pitch and -y in yaw."""
    pitch = in_air(injection=doublet("pitch", 1.0))
    yaw = in_air(injection=doublet("yaw", 1.0))
    yaw.y[:] = rolled(yaw, pitch.y)
    flown(pitch, 0.3)
    assert pitch.y[layout.W_BI_B + 1] > 0.005
    flown(pitch, 0.9)
    flown(yaw, 0.3)
    assert yaw.y[layout.W_BI_B + 2] > 0.005
    flown(yaw, 0.9)
    same(rolled(pitch, pitch.y), yaw.y)


def test_opposite_yaw_doublets_are_mirror_images() -> None:
    right, left = in_air(injection=doublet("yaw", 1.0)), in_air(injection=doublet("yaw", -1.0))
    left.y[:] = mirrored(left, right.y)
    flown(right, 1.2)
    flown(left, 1.2)
    same(mirrored(right, right.y), left.y)
