"""Section loads equal closed forms, a finite-element beam and Newton's law for the parts behind the cut.

| case | against |
|---|---|
| uniform rod pushed at its tail, spun end over end, standing on the pad, in steady wind | closed forms |
| beam with modes under a harmonic force | finite elements without modes, solved at the frequency |
| accelerated beam bent by a gimballed engine, at rest in its own frame | finite elements with geometric stiffness |
| tanks, swinging engine, air, rates, CG off the axis at once | Newton and Euler for the parts behind the gimbal |
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from flightkit import Mode, Parts, Rig, Tank, Tree, engine_states, gimbal_motions, merged, rig, scenario_of, with_stage
from oracles.beam_frame import Beam

from maxq.control.kernel.records import Array
from maxq.sim.run.evaluate import evaluate_at
from maxq.sim.vehicle import state as layout
from maxq.sim.vehicle.loads.columns import AXIAL, MOMENT_Y, MOMENT_Z, SHEAR_Y, SHEAR_Z

ON = {"section_loads": True, "actuator": "ideal"}
AIR = {"model": "constant", "density_kgpm3": 1.2}
HELD = {"release": "time", "release_s": 1.0}
LENGTH_M, MASS_KG = 12.0, 6000.0
STATIONS_M = tuple(np.linspace(0.5, LENGTH_M, 24).tolist())
ROD = [{"front_station_m": 0.0, "rear_station_m": LENGTH_M, "mass_kg": MASS_KG}]
SLENDER = Parts(  # a rod without width: its axis has the whole transverse inertia
    core_mass_kg=MASS_KG,
    core_cg=(0.5 * LENGTH_M, 0.0, 0.0),
    core_inertia=((1e-6, 0.0, 0.0), (0.0, MASS_KG * LENGTH_M**2 / 12.0, 0.0), (0.0, 0.0, MASS_KG * LENGTH_M**2 / 12.0)),
    gimbal_station_m=LENGTH_M,
)


def at_start(tree: Tree, change: Any = None) -> tuple:
    made = rig(tree)
    if change is not None:
        change(made.y)
    return made, evaluate_at(made.packed, made.packed.state, 0.0)


def loaded_rod(parts: Parts = SLENDER, stage: Tree | None = None, **sections: Any) -> Tree:
    changes = merged({"loads": {"stations_m": STATIONS_M, "line_mass": ROD}}, stage or {})
    return with_stage(scenario_of(parts, **merged({"switches": ON}, sections)), **changes)


# --- a rigid rod
def test_a_rod_pushed_sideways_and_forward_at_its_tail() -> None:
    pitch_deg, yaw_deg, thrust_N = 5.0, -3.0, 1.0e5
    stage = {"actuator": {"bias_deg": (pitch_deg, yaw_deg)}}
    _, now = at_start(loaded_rod(replace(SLENDER, thrust_N=thrust_N), stage))
    p, y = np.radians((pitch_deg, yaw_deg))
    along, force_y, force_z = thrust_N * np.array([np.cos(p) * np.cos(y), -np.sin(y), np.sin(p) * np.cos(y)])
    s = np.array(STATIONS_M) / LENGTH_M
    # specific force at s: (F / m) (6 s - 2); integrated once and twice
    expected = np.stack(
        [
            -along * s,
            -force_y * (3 * s**2 - 2 * s),
            -force_z * (3 * s**2 - 2 * s),
            force_z * LENGTH_M * (s**3 - s**2),
            -force_y * LENGTH_M * (s**3 - s**2),
        ],
        axis=1,
    )
    assert now.sections == pytest.approx(expected, abs=1e-6)
    # nose up by an engine deflected downwards: the tail is pushed to +z, the middle lags: the nose bends down
    assert now.sections[12, MOMENT_Y] < 0.0 < force_z


def test_a_rod_spun_end_over_end_is_in_tension() -> None:
    rate = 0.7

    def spin(y: Array) -> None:
        y[layout.W_BI_B + 1] = rate

    _, now = at_start(loaded_rod(), spin)
    s = np.array(STATIONS_M)
    expected = 0.5 * MASS_KG / LENGTH_M * rate**2 * ((0.5 * LENGTH_M) ** 2 - (0.5 * LENGTH_M - s) ** 2)
    assert now.sections[:, AXIAL] == pytest.approx(expected, abs=1e-8)
    assert np.abs(now.sections[:, SHEAR_Y:]).max() < 1e-8


def test_a_rod_that_stands_on_the_pad_bears_its_weight() -> None:
    upright = {"held": True, "euler_deg": [0.0, 90.0, 0.0]}
    made, now = at_start(loaded_rod(initial=upright, earth={"gravity": "uniform"}, holddown=HELD))
    gravity = float(np.linalg.norm(now.aux.air.gravitation_I_mps2))
    s = np.array(STATIONS_M) / LENGTH_M
    assert made.held.on_pad == 1
    assert gravity > 9.7
    assert now.sections[:, AXIAL] == pytest.approx(-MASS_KG * gravity * s, rel=1e-12)
    assert np.abs(now.sections[:, SHEAR_Y:]).max() < 1e-6


def wind_on(surfaces: list[tuple[float, float]], **table: float) -> Tree:
    """Return aerodynamics with lifting parts of these slopes and stations."""
    made: Tree = {"table": {"mach": [0.0], **{name: [value] for name, value in table.items()}}}
    made["surface"] = [
        {"name": str(k), "table": {"mach": [0.0], "CN_alpha_pr": [slope], "station_m": [x]}}
        for k, (slope, x) in enumerate(surfaces)
    ]
    return made


def test_a_held_rod_in_steady_wind_is_a_cantilever() -> None:
    stage = {"aero": wind_on([(4.0, 2.0), (6.0, 9.0)], CA=0.5)}
    stage["loads"] = {"axial_force": {"station_m": [1.0, 11.0], "share": [0.75, 0.25]}}
    wind = {"profile": {"altitude_m": [0.0], "north_mps": [-30.0], "east_mps": [4.0]}}
    level = {"held": True, "euler_deg": [0.0, 0.0, 0.0]}
    _, now = at_start(loaded_rod(stage=stage, atmosphere=AIR, initial=level, holddown=HELD, wind=wind))
    q, area = 0.5 * 1.2, 0.8
    forces = [(4.0 * q * area * 30.0 * 4.0, 2.0), (6.0 * q * area * 30.0 * 4.0, 9.0)]  # along +y, blown by the wind
    drag = 0.5 * q * area * 30.0**2
    s = np.array(STATIONS_M)
    shear = sum(f * (s >= x) for f, x in forces)
    moment = sum(f * np.maximum(s - x, 0.0) for f, x in forces)
    assert now.sections[:, SHEAR_Y] == pytest.approx(shear, rel=1e-12)
    assert now.sections[:, MOMENT_Z] == pytest.approx(moment, rel=1e-12)
    assert now.sections[:, AXIAL] == pytest.approx(-drag * (0.75 * (s >= 1.0) + 0.25 * (s >= 11.0)), rel=1e-12)
    assert np.abs(now.sections[:, [SHEAR_Z, MOMENT_Y]]).max() < 1e-6


# --- a beam that bends
NODES, EVERY = 241, 4  # of the finite elements; every fourth in the vehicle's table of modes


def a_beam(axial_N: Array | float = 0.0) -> Beam:
    """Return a beam of unequal sections with a point mass in the nose."""
    x = np.linspace(0.0, LENGTH_M, NODES)
    middle = 0.5 * (x[1:] + x[:-1])
    density = np.where(middle < 4.0, 200.0, np.where(middle < 9.0, 700.0, 400.0))
    stiffness = np.where(middle < 4.0, 2.0e7, 6.0e7)
    point = np.zeros(NODES)
    point[20] = 300.0
    return Beam(x, stiffness, density, point, np.broadcast_to(np.asarray(axial_N, float), middle.shape))


def forward_kg(beam: Beam) -> Array:
    """Return the mass forward of each node, its own point included."""
    of_elements = np.concatenate([[0.0], np.cumsum(beam.density_kgpm * np.diff(beam.x))])
    return np.asarray(of_elements + np.cumsum(beam.point_kg))


def beam_vehicle(beam: Beam, modes: int, stations: Array, **sections: Any) -> Tree:
    """Return the beam's first modes in pitch, with its mass as rods and a point."""
    omega, mass, phi, slope = beam.modes(modes)
    ends = beam.x[[0, 80, 180, 240]]
    rods = [
        {"front_station_m": a, "rear_station_m": b, "mass_kg": rho * (b - a)}
        for a, b, rho in zip(ends[:-1], ends[1:], (200.0, 700.0, 400.0), strict=True)
    ]
    point = {"front_station_m": beam.x[20], "rear_station_m": beam.x[20], "mass_kg": 300.0}
    line = sorted([*rods, point], key=lambda row: row["front_station_m"])
    kg = np.array([row["mass_kg"] for row in line])
    at = np.array([0.5 * (row["front_station_m"] + row["rear_station_m"]) for row in line])
    length = np.array([row["rear_station_m"] - row["front_station_m"] for row in line])
    cg = float(kg @ at / kg.sum())
    transverse = float(kg @ ((at - cg) ** 2 + length**2 / 12.0))
    shown = slice(None, None, EVERY)
    parts = Parts(
        core_mass_kg=float(kg.sum()),
        core_cg=(cg, 0.0, 0.0),
        core_inertia=((1e-6, 0.0, 0.0), (0.0, transverse, 0.0), (0.0, 0.0, transverse)),
        stations_m=tuple(beam.x[shown]),
        mass_forward_kg=tuple(forward_kg(beam)[shown]),
        pitch=tuple(
            Mode(w / (2.0 * np.pi), m, tuple(p[shown]), tuple(s[shown]))
            for w, m, p, s in zip(omega, mass, phi, slope, strict=True)
        ),
        gimbal_station_m=LENGTH_M,
        thrust_N=sections.pop("thrust_N", 0.0),
    )
    stage = {"loads": {"stations_m": stations.tolist(), "line_mass": line}} | sections.pop("stage", {})
    return with_stage(scenario_of(parts, **merged({"switches": ON}, sections)), **stage)


INNER = slice(10, 240, 10)  # 23 nodes of the finite elements


def of_modes(made: Rig) -> slice:
    first = int(layout.eta_index(made.sizes))
    return slice(first, first + int(made.sizes.pitch_modes))


@pytest.mark.parametrize(("modes", "tolerance"), [(3, 0.012), (8, 4e-4)])
def test_a_beam_that_vibrates_under_a_harmonic_force(modes: int, tolerance: float) -> None:
    """The force acts on a lifting part near the nose; modal coordinates are those at the peak of the steady vibration.

    Omitted modes respond as rigid; the error falls with the number of modes.
    """
    beam = a_beam()
    omega, mass, phi, _ = beam.modes(modes)
    struck, frequency = 30, 0.6 * omega[0] + 0.4 * omega[1]
    stage = {"aero": wind_on([(5.0, float(beam.x[struck]))])}
    start = {"ned_mps": [100.0, 0.0, 8.0]}
    tree = beam_vehicle(beam, modes, beam.x[INNER], stage=stage, atmosphere=AIR, initial=start)
    tree["switches"]["local_incidence"] = False
    force = -5.0 * 0.5 * 1.2 * 0.8 * 100.0 * 8.0  # -CN q S alpha, along z
    made, _ = at_start(tree)
    made.packed.state[of_modes(made)] = phi[:, struck] * force / (mass * (omega**2 - frequency**2))
    now = evaluate_at(made.packed, made.packed.state, 0.0)
    nodal = np.zeros(NODES)
    nodal[struck] = force
    moment = beam.moment_Nm(beam.harmonic(nodal, frequency))
    assert np.abs(now.sections[:, MOMENT_Y] - moment[INNER]).max() < tolerance * np.abs(moment).max()
    rigid, _ = at_start(tree)
    still = evaluate_at(rigid.packed, rigid.packed.state, 0.0)  # the same force on the straight body: another moment
    assert np.abs(still.sections[:, MOMENT_Y] - moment[INNER]).max() > 0.5 * np.abs(moment).max()


def test_a_beam_bent_by_a_gimballed_engine_under_thrust() -> None:
    """In quasi-static state the modal accelerations are zero, and the moments equal those of finite elements.

    The axial force of the bent beam has a moment, which the finite elements have from their geometric stiffness.
    """
    thrust_N, angle_deg, modes = 3.0e5, 6.0, 8
    along, across = thrust_N * np.cos(np.radians(angle_deg)), thrust_N * np.sin(np.radians(angle_deg))
    kg = forward_kg(a_beam())
    middle_kg = 0.5 * (kg[1:] + kg[:-1] - a_beam().point_kg[1:])
    beam = a_beam(-along * middle_kg / kg[-1])
    stage = {"actuator": {"bias_deg": (angle_deg, 0.0)}}
    tree = beam_vehicle(beam, modes, beam.x[INNER], thrust_N=thrust_N, stage=stage)
    tree["switches"] |= {"follower_thrust": False}
    made, now = at_start(tree)
    place, n = of_modes(made), modes

    def acceleration(eta: Array) -> Array:
        made.packed.state[place] = eta
        return evaluate_at(made.packed, made.packed.state, 0.0).rate[place.stop : place.stop + n].copy()

    at_rest = acceleration(np.zeros(n))
    matrix = np.stack([acceleration(unit) - at_rest for unit in 1e-3 * np.eye(n)], axis=1) / 1e-3
    acceleration(np.linalg.solve(matrix, -at_rest))
    now = evaluate_at(made.packed, made.packed.state, 0.0)
    nodal = np.zeros(NODES)
    nodal[-1] = across
    with_axial = beam.moment_Nm(beam.in_free_fall(nodal))
    without = a_beam().moment_Nm(a_beam().in_free_fall(nodal))
    largest = np.abs(with_axial).max()
    assert np.abs(with_axial - without).max() > 0.04 * largest  # there is something to find
    assert np.abs(now.sections[:, MOMENT_Y] - with_axial[INNER]).max() < 0.002 * largest
    assert now.sections[:, AXIAL] == pytest.approx(-along * kg[INNER] / kg[-1], rel=1e-9)


# --- all at once: what is forward of the gimbal against what is behind it
BOTH = Parts(
    core_mass_kg=4000.0,
    core_cg=(7.0, 0.03, -0.05),
    tanks=(Tank(300.0, 0.6, 4.0, 0.02), Tank(500.0, 0.8, 9.0, 0.03)),
    gimbal_station_m=12.0,
    gimbal_offset_m=(0.03, -0.05),  # on the line of the CGs, where the line mass lies
    engine_mass_kg=250.0,
    engine_cg_m=0.6,
    thrust_N=1.1e5,
)


def all_at_once() -> Tree:
    """Return a slender core of two rods with a point engine aft of the gimbal; all liquid is in the pendulum bobs."""
    engine_kg, gimbal, arm = BOTH.engine_mass_kg, BOTH.gimbal_station_m, BOTH.engine_cg_m
    ends, kg = (0.5, 6.0, 12.0), np.array([1500.0, BOTH.core_mass_kg - 1500.0 - engine_kg, engine_kg])
    at = np.array([3.25, 9.0, gimbal + arm])
    length = np.array([5.5, 6.0, 0.0])
    cg = float(kg @ at / kg.sum())
    transverse = float(kg @ ((at - cg) ** 2 + length**2 / 12.0))
    line = [
        {"front_station_m": ends[0], "rear_station_m": ends[1], "mass_kg": kg[0]},
        {"front_station_m": ends[1], "rear_station_m": ends[2], "mass_kg": kg[1]},
        {"front_station_m": at[2], "rear_station_m": at[2], "mass_kg": kg[2]},
    ]
    parts = replace(
        BOTH,
        core_cg=(cg, *BOTH.core_cg[1:]),
        core_inertia=((1e-6, 0.0, 0.0), (0.0, transverse, 0.0), (0.0, 0.0, transverse)),
    )
    liquid = [
        {
            "tank": str(k + 1),
            "bottom_station_m": t.hinge_station_m + t.length_m,
            "table": {"time_s": [0.0], "mass_kg": [t.mass_kg], "front_station_m": [t.hinge_station_m + t.length_m]},
        }
        for k, t in enumerate(BOTH.tanks)
    ]
    stage = {
        "aero": wind_on([(3.0, 1.5), (5.0, 11.0)], CA=0.6, C_crossflow=8.0, Cmq=-300.0, Clp=-20.0, CD=0.1, Cm0=0.05),
        "loads": {
            "stations_m": [2.0, 8.0, gimbal],
            "line_mass": line,
            "liquid": liquid,
            "axial_force": {"station_m": [0.5, 12.0], "share": [0.8, 0.2]},
        },
    }
    start = {"ned_mps": [120.0, 15.0, -10.0], "euler_deg": [0.0, 0.0, 0.0]}
    switches = {"section_loads": True, "actuator": "full"}
    injected = [
        {"at": "body_force", "axis": "z", "kind": "step", "amplitude_N": 700.0},
        {"at": "body_torque", "axis": "y", "kind": "step", "amplitude_Nm": 900.0},
    ]
    tree = scenario_of(parts, switches=switches, atmosphere=AIR, initial=start)
    return with_stage(tree | {"injection": injected}, **stage)


def test_what_is_forward_of_the_gimbal_balances_what_is_behind_it() -> None:
    made = rig(all_at_once())
    y = made.packed.state
    rng = np.random.default_rng(3)
    y[layout.W_BI_B : layout.W_BI_B + 3] = (0.3, -0.2, 0.25)
    angle, angular_rate, angular_accel = np.array([0.09, -0.06]), np.array([0.5, 0.4]), np.array([20.0, -15.0])
    y[layout.ACTUATOR : layout.ACTUATOR + 12] = engine_states(made, angle, angular_rate, angular_accel)
    for k in range(2):
        i = int(layout.pendulum_index(made.sizes, k))
        u = np.array([-1.0, *rng.normal(0.0, 0.3, 2)])
        u /= np.linalg.norm(u)
        kappa = rng.normal(0.0, 1.0, 3)
        y[i : i + 3], y[i + 3 : i + 6] = u, kappa - (kappa @ u) * u
    now = evaluate_at(made.packed, y, 0.0)
    aux, rate = now.aux, y[layout.W_BI_B : layout.W_BI_B + 3]
    d, d_rate, d_accel = thrust_axis(gimbal_motions(aux.engines.channel[:2]))
    cg = composed_core_cg()
    gimbal = np.array([cg - BOTH.gimbal_station_m, 0.0, 0.0])  # relative to C: on the line of the CGs
    accel, alpha = aux.specific_force_B_mps2, aux.alpha_BI_B_radps2
    arm = -BOTH.engine_cg_m
    at = gimbal + arm * d
    of_engine = accel + np.cross(alpha, at) + np.cross(rate, np.cross(rate, at))
    of_engine = of_engine + arm * (d_accel + 2.0 * np.cross(rate, d_rate))
    force = aux.engines.axial_thrust_N * d - BOTH.engine_mass_kg * of_engine
    moment = np.cross(arm * d, -BOTH.engine_mass_kg * of_engine)
    last = now.sections[-1]
    # about the body axis at the gimbal: the force acts off the axis
    beside = np.array([0.0, *BOTH.gimbal_offset_m])
    moment = moment + np.cross(beside, force)
    assert last[AXIAL] + force[0] == pytest.approx(0.0, abs=1e-6)
    assert last[[SHEAR_Y, SHEAR_Z]] + force[1:] == pytest.approx(np.zeros(2), abs=1e-6)
    assert last[[MOMENT_Y, MOMENT_Z]] + moment[1:] == pytest.approx(np.zeros(2), abs=1e-5)
    assert np.abs(last).min() > 100.0


def thrust_axis(angles: Array) -> tuple[Array, Array, Array]:
    """Return the thrust axis and its derivatives by finite differences in time of its definition."""

    def axis(t: float) -> Array:
        p, y = angles @ np.array([1.0, t, 0.5 * t * t])
        return np.array([np.cos(p) * np.cos(y), -np.sin(y), np.sin(p) * np.cos(y)])

    h = 1e-3
    d_m2, d_m1, d_0, d_1, d_2 = (axis(k * h) for k in (-2, -1, 0, 1, 2))
    rate = (8.0 * (d_1 - d_m1) - (d_2 - d_m2)) / (12.0 * h)
    return d_0, rate, (16.0 * (d_1 + d_m1) - (d_2 + d_m2) - 30.0 * d_0) / (12.0 * h * h)


def composed_core_cg() -> float:
    """Return the station of the core's CG of `all_at_once`."""
    kg = np.array([1500.0, BOTH.core_mass_kg - 1500.0 - BOTH.engine_mass_kg, BOTH.engine_mass_kg])
    return float(kg @ np.array([3.25, 9.0, BOTH.gimbal_station_m + BOTH.engine_cg_m]) / kg.sum())
