"""Coupled three-dimensional modes agree with these references.

| case | against |
|---|---|
| pairs of planar modes written as spatial modes | the planar modes, at random states and in flight |
| the same with both planes turned about x | the same motion |
| thrust step and torque step at the end of a uniform rod | d'Alembert's travelling waves |
| lateral modes of unlike planes, at any rates | Kane's method on a core made of particles |
| linear model of both planes | the simulator, linearised numerically |
| free flight of coupled modes, axial and torsion included, with tanks | energy and momenta written out here |
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from aero_tables import OVER_ALPHA_BETA
from flightkit import Mode, Parts, Rig, Tank, Tree, flown, load, merged, rig, scenario_of, with_stage
from oracles.hand_model import planar_of
from oracles.multibody_system import rotation_from_quaternion
from oracles.planar.plant import alone, vehicle_plant
from oracles.planar.vehicle_at import vehicle_at
from test_oracle_aero_tables_linear import ALL, ROUND, symmetric
from test_oracle_wind_bending import loaded
from zero_incidence import zero_incidence

from maxq.control.kernel.records import Array
from maxq.design.laws.wind import Spectrum
from maxq.design.loop.fixed_path import PadeFixedPath
from maxq.design.loop.wind import wind_response
from maxq.design.model.dispersion import Dispersion
from maxq.design.model.held import FlightCondition
from maxq.design.model.instruments import actuator
from maxq.design.model.linearised import linearise, settled
from maxq.design.model.node import disperse, node_of
from maxq.sim.packing.flight import Packed, pack_flight
from maxq.sim.run.evaluate import evaluate_at
from maxq.sim.vehicle import state as layout
from maxq.tools.replay.vehicle_shape import bent_line, shape_of

STATIONS = (0.0, 3.0, 5.0, 10.0, 12.0, 14.0)
MODES = (
    Mode(3.0, 600.0, (1.2, 0.3, -0.4, -0.5, 0.6, 1.1), (-0.35, -0.3, -0.15, 0.2, 0.3, 0.3), 0.01),
    Mode(5.0, 450.0, (-1.1, 0.5, 0.7, -0.6, 0.4, 1.2), (0.5, 0.4, -0.2, -0.3, 0.4, 0.45), 0.02),
)
PARTS = Parts(
    core_cg=(7.0, 0.04, -0.07),
    core_inertia=((8.0e3, 150.0, -90.0), (150.0, 5.0e4, 200.0), (-90.0, 200.0, 5.2e4)),
    tanks=(Tank(400.0, 0.5, 5.0, 0.03), Tank(700.0, 0.7, 10.0, 0.02)),
    pitch=MODES,
    yaw=MODES,
    gimbal_offset_m=(0.02, -0.03),
    engine_mass_kg=250.0,
    engine_cg_m=0.6,
    engine_inertia_kgm2=60.0,
    thrust_N=1.0e5,
)
AERO: Tree = {
    "table": [{"mach": 0.0, "CA": 0.4, "Cmq": -300.0, "Clp": -5.0, "C_crossflow": 8.0}],
    "surface": [
        {"table": [{"mach": 0.0, "CN_alpha_pr": 2.2, "station_m": 3.0}]},
        {"table": [{"mach": 0.0, "CN_alpha_pr": 9.0, "station_m": 12.0}]},
    ],
}
TABLES: Tree = {"moment_reference_m": 6.0, "coefficients": [{"table": OVER_ALPHA_BETA, "station_m": 5.0}]}
AIR: Tree = {"atmosphere": {"model": "us1976"}, "initial": {"ned_mps": [200.0, 20.0, -15.0]}}
SHAPES = ("phi_x", "phi_y", "phi_z", "theta_x_pm", "theta_y_pm", "theta_z_pm")


def spatial_section(
    stations_m: Array, forward_kg: Array, modes: list[tuple[float, float, float, Array]], **more: Any
) -> Tree:
    """Return the section `spatial_modes`: frequency (Hz), generalised mass, damping and shapes (S, 6) per mode."""
    rows = [
        {
            "time_s": 0.0,
            "mode": n + 1,
            "frequency_hz": hz,
            "generalized_mass_kg": mass,
            "station_m": station,
            **dict(zip(SHAPES, shape[k], strict=True)),
            "mass_forward_kg": forward_kg[k],
            **{key: values[k] for key, values in more.items()},
        }
        for n, (hz, mass, _, shape) in enumerate(modes)
        for k, station in enumerate(stations_m)
    ]
    return {"table": rows, "damping_ratio": [zeta for _, _, zeta, _ in modes]}


def as_spatial(parts: Parts, angle: float = 0.0) -> tuple[Tree, Parts]:
    """Return the pairs of `parts` as spatial modes (first of each pair: the pitch plane turned by `angle` about x)."""
    c, s = np.cos(angle), np.sin(angle)
    modes = []
    for pitch, yaw in zip(parts.pitch, parts.yaw, strict=True):
        for mode, (y, z) in ((pitch, (s, c)), (yaw, (c, -s))):
            phi, slope = np.array(mode.phi), np.array(mode.slope_pm)
            shape = np.stack([0 * phi, y * phi, z * phi, 0 * phi, z * slope, -y * slope], axis=1)
            modes.append((mode.frequency_hz, mode.mass_kg, mode.zeta, shape))
    section = spatial_section(np.array(parts.stations_m), np.array(parts.mass_forward_kg), modes)
    return section, replace(parts, pitch=(), yaw=())


def turning(n: int, angle: float) -> Array:
    """Return the matrix (2n, 2n) from (eta, xi) of the planes to coordinates of the turned pairs, pair by pair."""
    out = np.zeros((2 * n, 2 * n))
    for k in range(n):
        out[2 * k, [k, n + k]] = np.cos(angle), np.sin(angle)
        out[2 * k + 1, [k, n + k]] = -np.sin(angle), np.cos(angle)
    return out


def spatial_state(made: Rig, planar: Rig, y: Array, angle: float) -> Array:
    """Return the state of the vehicle with planar modes as a state with turned spatial modes."""
    n, first = int(planar.sizes.pitch_modes), int(layout.eta_index(planar.sizes))
    turn = turning(n, angle)
    eta, nu, xi, nu_yaw = y[first : first + 4 * n].reshape(4, n)
    bent = np.concatenate([turn @ np.concatenate([eta, xi]), turn @ np.concatenate([nu, nu_yaw])])
    return np.concatenate([y[:first], bent, y[first + 4 * n :]])


ON_LOAD: Tree = {"tvc_load": {"frequency_hz": 14.0, "damping_ratio": 0.05}}


def rigs(angle: float, stage: Tree, **more: Any) -> tuple[Rig, Rig]:
    section, rest = as_spatial(PARTS, angle)
    tree = with_stage(scenario_of(PARTS, **AIR, **more), aero=AERO | TABLES, **stage)
    spatial = with_stage(scenario_of(rest, **AIR, **more), aero=AERO | TABLES, spatial_modes=section, **stage)
    return rig(tree), rig(spatial)


def stirred(made: Rig, rng: np.random.Generator) -> Array:
    y = made.y.copy()
    y[layout.W_BI_B : layout.W_BI_B + 3] = rng.normal(size=3)
    y[layout.ACTUATOR : layout.ACTUATOR + 12] = 0.05 * rng.normal(size=12)
    y[layout.GYRO : layout.GYRO + 9] = 0.1 * rng.normal(size=9)
    first = int(layout.eta_index(made.sizes))
    n = int(made.sizes.pitch_modes)
    y[first : first + 4 * n] = rng.normal(size=4 * n) * np.repeat([0.05, 1.0, 0.05, 1.0], n)
    for k in range(int(made.sizes.pendulums)):
        i = int(layout.pendulum_index(made.sizes, k))
        u = np.array([-1.0, 0.0, 0.0]) + 0.4 * rng.normal(size=3)
        y[i : i + 3] = u / np.linalg.norm(u)
        y[i + 3 : i + 6] = np.cross(rng.normal(size=3), y[i : i + 3])
    first = int(layout.tvc_load_index(made.sizes))
    y[first:] = 0.1 * rng.normal(size=made.n - first)
    return y


@pytest.mark.parametrize("stage", [{}, ON_LOAD], ids=["locked", "swinging"])
@pytest.mark.parametrize("angle_deg", [0.0, 30.0])
def test_pairs_written_as_spatial_modes_have_the_same_derivative(angle_deg: float, stage: Tree) -> None:
    rng, angle = np.random.default_rng(3), np.radians(angle_deg)
    planar, spatial = rigs(angle, stage)
    for _ in range(20):
        y = stirred(planar, rng)
        wanted = spatial_state(spatial, planar, planar.derivative(y), angle)
        got = spatial.derivative(spatial_state(spatial, planar, y, angle))
        scale = np.maximum(np.abs(wanted), 1e-3 * np.abs(wanted).max())
        np.testing.assert_allclose((got - wanted) / scale, 0.0, atol=2e-11)
        bent = (made.aux.gimbal_bending.tolist() for made in (spatial, planar))
        np.testing.assert_allclose(*bent, rtol=1e-11, atol=1e-14)


@pytest.mark.parametrize("angle_deg", [0.0, 30.0])
def test_pairs_written_as_spatial_modes_fly_the_same(angle_deg: float) -> None:
    angle = np.radians(angle_deg)
    planar, spatial = rigs(angle, {})
    y = stirred(planar, np.random.default_rng(5))
    planar.y[:], spatial.y[:] = y, spatial_state(spatial, planar, y, angle)
    theirs, ours = flown(planar, 2.0)[-1], flown(spatial, 2.0)[-1]
    wanted = spatial_state(spatial, planar, theirs, angle)
    np.testing.assert_allclose(ours, wanted, rtol=1e-8, atol=1e-9)


# --- a uniform rod
LENGTH_M, ROD_KG, ROLL_KGM2, SPEED_MPS = 14.0, 4200.0, 800.0, 700.0  # of both waves
ROD_STATIONS = np.linspace(0.0, LENGTH_M, 57)


def rod(component: int, yaw_rad: float = 0.0, stage: Tree | None = None, **engine: Any) -> Rig:
    """Return 12 modes cos(n pi x / L) of a uniform free-free rod: axial (component 0) or torsional (3)."""
    modes = []
    for n in range(1, 13):
        shape = np.zeros((len(ROD_STATIONS), 6))
        shape[:, component] = np.cos(n * np.pi * ROD_STATIONS / LENGTH_M)
        mass = 0.5 * (ROLL_KGM2 if component == 3 else ROD_KG)
        modes.append((n * SPEED_MPS / (2.0 * LENGTH_M), mass, 0.0, shape))
    forward = ROD_KG * ROD_STATIONS / LENGTH_M
    parts = Parts(
        core_mass_kg=ROD_KG,
        core_cg=(LENGTH_M / 2, 0.0, 0.0),
        core_inertia=((ROLL_KGM2, 0.0, 0.0), (0.0, 7e4, 0.0), (0.0, 0.0, 7e4)),
        gimbal_station_m=LENGTH_M,
        gyro_station_m=0.0,
        **engine,
    )
    tree = scenario_of(parts, run={"step_s": 0.0001}, switches={"gyro": "ideal", "actuator": "ideal"})
    tree["vehicle"]["computer"]["sample_s"] = 1.0  # a sample takes what the gyro has counted
    bias = {"bias_deg": (0.0, float(np.degrees(yaw_rad)))}
    tree["switches"]["section_loads"] = stage is not None
    return rig(
        with_stage(tree, actuator=bias, spatial_modes=spatial_section(ROD_STATIONS, forward, modes), **stage or {})
    )


def wave(time_s: float, impedance: float, strength: float) -> tuple[float, float]:
    """Return the displacement of the end with the step and of the far end, until the second echo."""
    travel = LENGTH_M / SPEED_MPS
    rate = strength / impedance
    return rate * (time_s + 2 * max(time_s - 2 * travel, 0.0)), 2 * rate * max(time_s - travel, 0.0)


@pytest.mark.parametrize("share", [0.5, 1.3, 1.8, 2.5])
def test_a_thrust_step_travels_as_an_axial_wave(share: float) -> None:
    made, time_s = rod(0, thrust_N=1.0e5), share * LENGTH_M / SPEED_MPS
    y = flown(made, round(time_s, 4))[-1]
    i = int(layout.spatial_index(made.sizes))
    whole = 0.5 * 1.0e5 / ROD_KG * time_s**2
    eta, sign = y[i : i + 12], (-1.0) ** np.arange(1, 13)
    tail, nose = wave(time_s, ROD_KG * SPEED_MPS / LENGTH_M, 1.0e5)
    tolerance = _truncated(1.0e5, ROD_KG)
    np.testing.assert_allclose([whole + eta @ sign, whole + eta.sum()], [tail, nose], atol=tolerance)
    assert tolerance < 0.07 * tail


@pytest.mark.parametrize("share", [0.5, 1.3, 1.8, 2.5])
def test_a_torque_step_travels_as_a_torsion_wave(share: float) -> None:
    """The thrust axis is off the body axis and inclined, its torque acts at the gimbal, and the gyro is at the nose."""
    offset, yaw = 0.5, 0.1
    made, time_s = rod(3, yaw, thrust_N=1.0e5, gimbal_offset_m=(0.0, offset)), share * LENGTH_M / SPEED_MPS
    y = flown(made, round(time_s, 4))[-1]
    torque = offset * 1.0e5 * np.sin(yaw)  # r x F about x: -z F_y, F_y = -T sin
    nose = wave(time_s, ROLL_KGM2 * SPEED_MPS / LENGTH_M, torque)[1]
    tolerance = _truncated(torque, ROLL_KGM2)
    assert abs(y[layout.GYRO_ANGLE] - nose) < tolerance < 0.3 * max(nose, 0.5 * torque / ROLL_KGM2 * time_s**2)


def _truncated(strength: float, inertia: float) -> float:
    """Return a bound on the sum of 2 F / (m w^2) (1 - cos) over the omitted modes, from the thirteenth on."""
    omega = np.pi * SPEED_MPS / LENGTH_M * np.arange(13, 20000)
    return float((2.0 * strength / inertia / omega**2 * 2.0).sum())


# --- section loads
def sections(made: Rig, y: Array) -> Array:
    now = evaluate_at(made.packed, y, 0.0)
    assert now.sections is not None
    return now.sections


@pytest.mark.parametrize("angle_deg", [0.0, 30.0])
def test_pairs_written_as_spatial_modes_have_the_same_section_loads(angle_deg: float) -> None:
    """The loads agree while bent and rolling, with liquid and air; planar modes are checked by finite elements."""
    liquid = [
        {
            "tank": str(k + 1),
            "bottom_station_m": tank.hinge_station_m + tank.length_m,
            "table": {
                "time_s": [0.0],
                "mass_kg": [1.5 * tank.mass_kg],
                "front_station_m": [tank.hinge_station_m - 0.3],
            },
        }
        for k, tank in enumerate(PARTS.tanks)
    ]
    line = [{"front_station_m": 0.0, "rear_station_m": 14.0, "mass_kg": PARTS.core_mass_kg - 550.0}]
    loads = {"stations_m": [2.0, 5.0, 9.0, 12.0], "line_mass": line, "liquid": liquid, "tolerance": 1.0}
    angle = np.radians(angle_deg)
    planar, spatial = rigs(angle, {"loads": loads}, switches={"section_loads": True})
    rng = np.random.default_rng(23)
    for _ in range(5):
        y = stirred(planar, rng)
        wanted = sections(planar, y)
        got = sections(spatial, spatial_state(spatial, planar, y, angle))
        np.testing.assert_allclose(got, wanted, rtol=1e-9, atol=1e-9 * np.abs(wanted).max())


CUTS_M = np.linspace(0.5, 13.5, 14)
ROD_LOADS = {
    "stations_m": CUTS_M.tolist(),
    "line_mass": [{"front_station_m": 0.0, "rear_station_m": LENGTH_M, "mass_kg": ROD_KG}],
    "tolerance": 1.0,
}


def test_axial_force_of_a_rod_that_vibrates_and_of_one_that_is_pushed() -> None:
    """The axial force is EA u' in free vibration, and just after a push the partial sum of the series of N = 0."""
    made = rod(0, stage={"loads": ROD_LOADS}, thrust_N=1.0e5)
    i, n, s = int(layout.spatial_index(made.sizes)), np.arange(1, 13), np.pi * CUTS_M / LENGTH_M
    pushed = -1.0e5 * (CUTS_M / LENGTH_M + np.sin(np.outer(s, n)) @ (2.0 * (-1.0) ** n / (np.pi * n)))
    y = made.y.copy()
    np.testing.assert_allclose(sections(made, y)[:, 0], pushed, atol=150.0)  # shapes are interpolated between stations
    assert np.abs(pushed[:12]).max() < 0.1 * 1.0e5  # the tail's push is not felt yet where a rigid rod bears all of it
    stiffness_N = ROD_KG / LENGTH_M * SPEED_MPS**2
    for mode in (1, 2, 5):
        y[i : i + 12] = 0.0
        y[i + mode - 1] = 1e-3
        # u' over the station, aft of the nose, is the compression of an x that points forward
        vibrating = pushed + 1e-3 * stiffness_N * mode * np.pi / LENGTH_M * np.sin(mode * s)
        np.testing.assert_allclose(sections(made, y)[:, 0], vibrating, atol=2e-3 * np.abs(vibrating).max() + 150.0)


def test_section_loads_of_coupled_modes_are_those_of_particles() -> None:
    """Section loads of coupled modes equal Newton's law for the particles forward of each station.

    The vehicle rolls, its thrust is off the axis, and six modes move along all axes at once.
    """
    rng = np.random.default_rng(31)
    mass, x, lateral = particles(rng)
    axial = np.linalg.qr(np.sqrt(mass)[:, None] * np.stack([np.ones(15), x, x**2], axis=1))[0][:, 1:]
    plain = np.concatenate([lateral, np.zeros((2, 15, 3))])
    plain[4:, :, 0] = (axial * np.sqrt(500.0 / mass)[:, None]).T
    shapes = np.einsum("ij,jnk->ink", np.linalg.qr(rng.normal(size=(6, 6)))[0], plain)
    stations = 7.0 - x
    thetas = np.gradient(shapes, stations, axis=1)
    modes = [
        (4.0 + n, 500.0, 0.0, np.concatenate([s, np.stack([0 * x, t[:, 2], -t[:, 1]], axis=1)], axis=1))
        for n, (s, t) in enumerate(zip(shapes, thetas, strict=True))
    ]
    inertia = np.diag([900.0, mass @ x**2, mass @ x**2])
    parts = Parts(
        core_mass_kg=float(mass.sum()),
        core_cg=(7.0, 0.0, 0.0),
        core_inertia=inertia,
        gyro_station_m=5.0,
        gimbal_station_m=float(stations[-1]),
        gimbal_offset_m=(0.3, -0.2),
        thrust_N=9.0e4,
    )
    cuts = 0.5 * (stations[1:] + stations[:-1])
    line = [{"front_station_m": at, "rear_station_m": at, "mass_kg": kg} for at, kg in zip(stations, mass, strict=True)]
    stage = {
        "spatial_modes": spatial_section(stations, np.cumsum(mass) - mass, modes, mass_kg=mass),
        "loads": {"stations_m": cuts.tolist(), "line_mass": line},
    }
    made = rig(with_stage(scenario_of(parts, switches={"section_loads": True}), **stage))
    turned = np.stack([0 * shapes[..., 0], -shapes[..., 2], shapes[..., 1]], -1)
    share = np.einsum("n,jnk,ink->ij", mass, turned, shapes) / 500.0
    i, y, roll, rate = int(layout.spatial_index(made.sizes)), made.y.copy(), 3.0, rng.normal(size=6)
    y[layout.W_BI_B], y[i + 6 : i + 12] = roll, rate
    now, w = evaluate_at(made.packed, y, 0.0), np.array([roll, 0.0, 0.0])
    accel, alpha = now.aux.specific_force_B_mps2, now.aux.alpha_BI_B_radps2
    bending = now.rate[i + 6 : i + 12] - roll * share @ rate
    places = np.stack([x, 0 * x, 0 * x], axis=1)
    moved, moving = np.einsum("i,ink->nk", bending, shapes), np.einsum("i,ink->nk", rate, shapes)
    force = -mass[:, None] * (accel + np.cross(alpha, places) + moved + 2.0 * np.cross(w, moving))
    assert np.abs(mass[:, None] * np.cross(w, moving)).max() > 1e-2 * np.abs(force).max()
    wanted = np.zeros((len(cuts), 5))
    for k, cut in enumerate(cuts):
        ahead = stations < cut
        arm = np.stack([cut - stations[ahead], 0 * x[ahead], 0 * x[ahead]], axis=1)
        wanted[k] = *force[ahead].sum(axis=0), *np.cross(arm, force[ahead]).sum(axis=0)[1:]
    got = now.sections
    np.testing.assert_allclose(got, wanted, atol=1e-8 * np.abs(wanted).max())


# --- a core made of particles
def particles(rng: np.random.Generator) -> tuple[Array, Array, Array]:
    """Return the masses (N,), places x of B (N,) and four lateral shapes (4, N, 3), orthogonal to 1, x and each other.

    They are two pairs with mixed planes and unlike frequencies; with the turned ones they are a closed set.
    """
    mass, x = rng.uniform(50.0, 300.0, 15), np.linspace(7.0, -7.0, 15)
    x = x - mass @ x / mass.sum()
    basis = [np.ones(15), x]
    for power in (2, 3):
        shape = (x / 7.0) ** power
        for other in [*basis, *basis]:
            shape = shape - other * (mass @ (shape * other)) / (mass @ (other * other))
        basis.append(shape / np.sqrt(mass @ shape**2 / 500.0))
    plain = np.zeros((4, 15, 3))
    plain[0, :, 2], plain[1, :, 1], plain[2, :, 2], plain[3, :, 1] = basis[2], basis[2], basis[3], basis[3]
    mixed = np.linalg.qr(rng.normal(size=(4, 4)))[0]
    return mass, x, np.einsum("ij,jnk->ink", mixed, plain)


def test_lateral_modes_of_unlike_planes_move_as_particles_do() -> None:
    """At an instant with straight modes and any rates, the energy omitted by (3.1) has no effect on the equations."""
    rng = np.random.default_rng(11)
    mass, x, shapes = particles(rng)
    omega, rotor = np.array([20.0, 26.0, 35.0, 50.0]), np.diag([900.0, 0.0, 0.0])
    inertia = np.diag([0.0, mass @ x**2, mass @ x**2]) + rotor
    stations = 7.0 - x
    thetas = np.gradient(shapes, stations, axis=1)
    modes = [
        (w / (2 * np.pi), 500.0, 0.0, np.concatenate([s, np.stack([0 * x, t[:, 2], -t[:, 1]], axis=1)], axis=1))
        for w, s, t in zip(omega, shapes, thetas, strict=True)
    ]
    section = spatial_section(stations, np.cumsum(mass) - mass, modes, mass_kg=mass)
    parts = Parts(core_mass_kg=float(mass.sum()), core_cg=(7.0, 0.0, 0.0), core_inertia=inertia, gyro_station_m=5.0)
    made = rig(with_stage(scenario_of(parts), spatial_modes=section))
    i = int(layout.spatial_index(made.sizes))
    for _ in range(5):
        w, rate = rng.normal(size=3), rng.normal(size=4)
        # Kane: partial velocities of the particles in v, w and the modes' rates
        places, moving = np.stack([x, 0 * x, 0 * x], axis=1), np.einsum("i,ink->nk", rate, shapes)
        matrix, right = np.zeros((10, 10)), np.zeros(10)
        for m, r, v, phi in zip(mass, places, moving, shapes.transpose(1, 2, 0), strict=True):
            cross = np.array([[0.0, -r[2], r[1]], [r[2], 0.0, -r[0]], [-r[1], r[0], 0.0]])
            partial = np.hstack([np.eye(3), -cross, phi])
            matrix += m * partial.T @ partial
            right -= m * partial.T @ (np.cross(w, np.cross(w, r)) + 2 * np.cross(w, v))
        matrix[3:6, 3:6] += rotor
        right[3:6] -= np.cross(w, rotor @ w)
        wanted = np.linalg.solve(matrix, right)
        y = made.y.copy()
        y[layout.W_BI_B : layout.W_BI_B + 3], y[i + 4 : i + 8] = w, rate
        dy = made.derivative(y)
        np.testing.assert_allclose(dy[layout.W_BI_B : layout.W_BI_B + 3], wanted[3:6], rtol=1e-10, atol=1e-10)
        # d(eta)/dt = nu - p A eta, and eta = 0: eta'' = nu' - p A eta'
        share = np.einsum(
            "n,jnk,ink->ij", mass, np.stack([0 * shapes[..., 0], -shapes[..., 2], shapes[..., 1]], -1), shapes
        )
        np.testing.assert_allclose(dy[i + 4 : i + 8] - w[0] * share / 500.0 @ rate, wanted[6:], rtol=1e-9, atol=1e-9)


# --- conservation
def coupled(rng: np.random.Generator) -> list[tuple[float, float, float, Array]]:
    """Return five asymmetric modes, each with six nonzero components."""
    x = np.array(STATIONS) / 14.0
    modes = []
    for n in range(5):
        a = rng.normal(size=(6, 3))
        waves = np.stack([np.cos(2.5 * x), np.sin(3.0 * x) - 0.4, x**2 - 0.3])
        slopes = np.stack([-2.5 * np.sin(2.5 * x), 3.0 * np.cos(3.0 * x), 2.0 * x]) / 14.0
        phi = 0.5 * a[:3] @ waves
        theta = 0.5 * np.stack([a[3] @ waves, a[2] @ slopes, -a[1] @ slopes])
        modes.append((3.0 + 2.0 * n, 400.0 + 100.0 * n, 0.0, np.concatenate([phi, theta]).T))
    return modes


def constants(y: Array, made: Rig, modes: list[tuple[float, float, float, Array]], share: Array) -> Array:
    """Return the energy, linear and angular momentum (in I, about its origin) of core, modes and bobs."""
    n, first = len(modes), int(layout.spatial_index(made.sizes))
    c_ib = rotation_from_quaternion(y[layout.Q_BI : layout.Q_BI + 4])
    w, v = y[layout.W_BI_B : layout.W_BI_B + 3], c_ib.T @ y[layout.V_I : layout.V_I + 3]
    eta, nu = y[first : first + n], y[first + n : first + 2 * n]
    mass, omega = np.array([m for _, m, _, _ in modes]), 2 * np.pi * np.array([f for f, _, _, _ in modes])
    core, rate = np.array(PARTS.core_inertia), nu - w[0] * share @ eta
    energy = 0.5 * PARTS.core_mass_kg * v @ v + 0.5 * w @ core @ w + 0.5 * mass @ (nu**2 + (omega * eta) ** 2)
    linear, angular = PARTS.core_mass_kg * v, core @ w + np.array([(mass * nu) @ share @ eta, 0.0, 0.0])
    for k, tank in enumerate(PARTS.tanks):
        i = int(layout.pendulum_index(made.sizes, k))
        phi = np.array([shape[STATIONS.index(tank.hinge_station_m), :3] for *_, shape in modes])
        hinge = np.array([7.0 - tank.hinge_station_m, -0.04, 0.07]) + eta @ phi
        u, kappa = y[i : i + 3], y[i + 3 : i + 6]
        speed = v + np.cross(w, hinge) + rate @ phi + tank.length_m * kappa
        energy += 0.5 * tank.mass_kg * speed @ speed
        linear = linear + tank.mass_kg * speed
        angular = angular + np.cross(hinge + tank.length_m * u, tank.mass_kg * speed)
    return np.concatenate(([energy], c_ib @ linear, c_ib @ angular + np.cross(y[:3], c_ib @ linear)))


def test_coupled_modes_conserve_energy_and_momenta() -> None:
    """At 1 rad/s of tumbling with bobs at large angles, the drift falls with the method's order."""
    rng = np.random.default_rng(17)
    modes = coupled(rng)
    tanks = tuple(replace(t, damping_ratio=0.0) for t in PARTS.tanks)
    parts = replace(PARTS, pitch=(), yaw=(), tanks=tanks, thrust_N=0.0, engine_mass_kg=0.0, engine_inertia_kgm2=0.0)
    section = spatial_section(np.array(STATIONS), np.array(parts.mass_forward_kg), modes)
    drifts = []
    for step in (0.002, 0.001):
        made = rig(with_stage(scenario_of(parts, run={"step_s": step}), spatial_modes=section))
        n, first = 5, int(layout.spatial_index(made.sizes))
        # A as the vehicle's own kinematics show it: d(eta)/dt at roll rate 1 without modal rates
        share = np.zeros((n, n))
        for j in range(n):
            y = made.y.copy()
            y[layout.W_BI_B], y[first + j] = 1.0, 1.0
            share[:, j] = -made.derivative(y)[first : first + n]
        mass = np.array([m for _, m, _, _ in modes])
        exchange = mass[:, None] * share
        np.testing.assert_allclose(exchange, -exchange.T, atol=1e-9 * np.abs(exchange).max())
        assert np.abs(share).max() > 0.1
        y = made.y
        y[layout.V_I : layout.V_I + 3], y[layout.W_BI_B : layout.W_BI_B + 3] = [1.0, 2.0, -3.0], [0.9, -0.5, 0.4]
        y[first : first + n], y[first + n : first + 2 * n] = 0.03 * np.cos(np.arange(5)), 0.5 * np.sin(np.arange(5))
        for k in range(2):
            i = int(layout.pendulum_index(made.sizes, k))
            y[i : i + 3] = np.array([[-0.6, 0.5, np.sqrt(1 - 0.61)], [-0.2, -0.9, np.sqrt(1 - 0.85)]])[k]
            y[i + 3 : i + 6] = np.cross([1.5, -2.0, 0.5], y[i : i + 3])
        before = constants(made.y, made, modes, share)
        change = np.abs(constants(flown(made, 2.0)[-1], made, modes, share) - before)
        size = np.repeat([abs(before[0]), np.linalg.norm(before[1:4]), np.linalg.norm(before[4:])], [1, 3, 3])
        drifts.append(change / size)
    assert drifts[1][0] < 1e-6
    assert drifts[1][1:].max() < 1e-8
    assert drifts[0][0] / drifts[1][0] > 15.0  # order four at least


# --- the linear model
def ascending(section: Tree, rest: Parts, **stage: Any) -> tuple[Packed, FlightCondition]:
    """Return a vehicle with spatial modes at zero angle of attack, with the CG on the axis."""
    straight = replace(
        rest,
        core_cg=(7.0, 0.0, 0.0),
        core_inertia=((8e3, 0.0, 0.0), (0.0, 5.0e4, 0.0), (0.0, 0.0, 5.2e4)),
        gimbal_offset_m=(0.0, 0.0),
    )
    path = np.radians(50.0)
    velocity = [float(200.0 * np.cos(path)), 0.0, float(-200.0 * np.sin(path))]
    start = {"initial": {"ned_mps": velocity, "euler_deg": [0.0, 50.0, 0.0]}, "earth": {"gravity": "uniform"}}
    tree = merged(scenario_of(straight, **AIR), start)
    packed = rig(with_stage(tree, aero=AERO, spatial_modes=section, **stage)).packed
    air = evaluate_at(packed, packed.state, 0.0).aux.air
    condition = FlightCondition(
        0.0,
        float(air.airspeed_mps),
        float(air.density_kgpm3),
        float(air.pressure_Pa),
        float(air.mach),
        float(path),
        float(np.linalg.norm(air.gravitation_I_mps2)),
    )
    return packed, condition


@pytest.mark.parametrize("stage", [{}, ON_LOAD], ids=["locked", "swinging"])
def test_linear_model_of_both_planes_is_the_linearised_simulator(stage: Tree) -> None:
    """Modes that bend in both planes and twist, of unlike frequencies, agree with all axes in one state space."""
    angle = np.radians(30.0)
    section, rest = as_spatial(
        replace(PARTS, yaw=tuple(replace(m, frequency_hz=1.2 * m.frequency_hz) for m in MODES)), angle
    )
    for row in section["table"]:
        row["theta_x_pm"] = 0.1 * row["mode"] * np.cos(row["station_m"])
    packed, condition = ascending(section, rest, **stage)
    theirs = linearise(packed, zero_incidence(packed, packed.state), 0.0)
    modes = [f"spatial_{i}_{what}" for what in ("m", "rate_mps") for i in range(1, 5)]

    def slosh(plane: str) -> list[str]:
        engine = [f"tvc_load_1_{plane}_{what}" for what in ("rad", "rate_radps") if stage]
        return [f"slosh_{k}_{plane}{what}" for what in ("_rad", "_rate_radps") for k in (1, 2)] + engine

    for plane, across in (("pitch", "yaw"), ("yaw", "pitch")):
        motion = {"pitch": ["w_mps", "q_radps", "theta_rad"], "yaw": ["v_mps", "r_radps", "psi_rad"]}
        names = [*motion[plane], *modes, *slosh(plane), *motion[across], *slosh(across)]
        turned = {"r_radps", "psi_rad", "tvc_load_1_yaw_rad", "tvc_load_1_yaw_rate_radps"}
        sign = np.array([-1.0 if name in turned else 1.0 for name in names])
        i = [theirs.states.index(name) for name in names]
        a = sign[:, None] * theirs.a[np.ix_(i, i)] * sign
        plant = vehicle_plant(vehicle_at(packed, 0.0, condition.mach, plane), condition)
        scale = 1e-8 * np.abs(plant.a).max(axis=1, keepdims=True)
        assert np.abs(a - plant.a).max() < 1e-8 * np.abs(plant.a).max()
        np.testing.assert_array_less(np.abs(a - plant.a), 1e-8 * np.abs(plant.a) + 1e-3 * scale + 1e-8)
        for k, (p, output) in enumerate(((plane, "local_rate_radps"), (across, "across_local_rate_radps"))):
            columns = [theirs.states.index(f"actuator_{p}_{j}") for j in range(1, 7)]
            angle_row = theirs.c[theirs.outputs.index(f"delta_{p}_rad")][columns]
            rates = theirs.a[np.ix_(columns, columns)]
            if stage:  # the angle that is put out is the engine's
                angle_row = actuator(packed.parameters[0].vehicle[f"actuator_{p}"]).c[0]
            motions = np.stack([angle_row, angle_row @ rates, angle_row @ rates @ rates], axis=1)
            through = np.linalg.lstsq(motions, theirs.a[np.ix_(i, columns)].T, rcond=None)[0].T
            through = sign[:, None] * through * (1.0 if p == "pitch" else -1.0)
            felt = [0, 1] if stage else [0, 2]  # angle and rate of the actuator, or acceleration of the engine
            np.testing.assert_allclose(through[:, felt], plant.b[:, 2 * k : 2 * k + 2], rtol=1e-8, atol=1e-8)
            sensed = theirs.c[theirs.outputs.index(f"local_rate_{p}_radps")][i] * sign * (1.0 if p == "pitch" else -1.0)
            np.testing.assert_allclose(sensed, plant.c[plant.outputs.index(output)], rtol=1e-8, atol=1e-10)
        roll = (
            theirs.a[theirs.states.index("gyro_roll_rate_radps2")][i]
            / theirs.a[theirs.states.index("gyro_roll_rate_radps2"), theirs.states.index("p_radps")]
        )
        np.testing.assert_allclose(roll, plant.c[-1], rtol=1e-8, atol=1e-10)


@pytest.mark.parametrize("trim_deg", [(4.0, 2.0), (-3.0, 7.0)])
def test_modes_of_both_planes_in_incidence_feel_each_others_flow(trim_deg: tuple[float, float]) -> None:
    """With asymmetric tables, Fy by w and Fz by v act on body and modes of both planes; roll is trimmed."""
    alpha, beta = np.radians(trim_deg)
    section, rest = as_spatial(
        replace(PARTS, yaw=tuple(replace(m, frequency_hz=1.2 * m.frequency_hz) for m in MODES)), np.radians(30.0)
    )
    flow = 290.0 * np.array([np.cos(alpha) * np.cos(beta), np.sin(beta), np.sin(alpha) * np.cos(beta)])
    straight = replace(
        rest, core_cg=(7.0, 0.0, 0.0), gimbal_offset_m=(0.0, 0.0), core_inertia=np.diag((8e3, 5e4, 5.2e4))
    )
    start = {"initial": {"ned_mps": [*flow], "euler_deg": [0.0, 0.0, 0.0]}, "earth": {"gravity": "uniform"}}
    aero, level = symmetric() | ROUND, [{key: value for key, value in t.items() if key != "Cl"} for t in ALL]
    aero["coefficients"] = [
        *aero["coefficients"][:2],
        *({"table": t, "station_m": 4.0 + k} for k, t in enumerate(level)),
    ]
    made = rig(with_stage(merged(scenario_of(straight, **AIR), start), aero=aero, spatial_modes=section))
    made.packed.memory[0].held.burning = 1
    node = node_of(made.packed, 0.0)
    whole = vehicle_plant(planar_of(node), node.condition)
    ours, theirs = whole.a, both_planes(linearise(made.packed, made.packed.state, 0.0), 4)
    scale = np.abs(theirs).max(axis=1, keepdims=True)
    np.testing.assert_allclose(ours / scale, theirs / scale, rtol=1e-8, atol=1e-10)
    mine, other = node.plant, alone(whole, planar_of(node))
    assert (mine.states, mine.inputs) == (other.states, other.inputs)
    for got, expected in ((mine.a, other.a), (mine.b, other.b), (mine.c, other.c[: len(mine.c)])):
        row = np.abs(expected).max(axis=1, keepdims=True)
        np.testing.assert_allclose(got / row, expected / row, rtol=1e-8, atol=1e-9)


def both_planes(theirs, modes: int, loaded: bool = False) -> Array:
    """Return the state matrix in the order of the plant's states, yaw in its mirrored axes."""

    def swinging(plane: str) -> list[str]:
        engine = [f"tvc_load_1_{plane}_{what}" for what in ("rad", "rate_radps") if loaded]
        return [f"slosh_{k}_{plane}{w}" for w in ("_rad", "_rate_radps") for k in (1, 2)] + engine

    names = [
        "w_mps",
        "q_radps",
        "theta_rad",
        *(f"spatial_{i + 1}_{w}" for w in ("m", "rate_mps") for i in range(modes)),
    ]
    names += [*swinging("pitch"), "v_mps", "r_radps", "psi_rad", *swinging("yaw")]
    i = [theirs.states.index(name) for name in names]
    turned = {"r_radps", "psi_rad", "tvc_load_1_yaw_rad", "tvc_load_1_yaw_rate_radps"}
    sign = np.array([-1.0 if name in turned else 1.0 for name in names])
    return np.asarray(sign[:, None] * theirs.a[np.ix_(i, i)] * sign)


def stiff(factor: float, along: Callable[[int, float], float]) -> tuple[Tree, Parts]:
    """Return the pairs, `factor` times as stiff and unlike, with motion `along` (of mode, station) along x."""
    pitch = tuple(replace(m, frequency_hz=factor * m.frequency_hz) for m in MODES)
    yaw = tuple(replace(m, frequency_hz=1.2 * m.frequency_hz) for m in pitch)
    section, rest = as_spatial(replace(PARTS, pitch=pitch, yaw=yaw))
    for row in section["table"]:
        row["phi_x"] = along(row["mode"], row["station_m"])
    return section, rest


def plant_and_simulator(section: Tree, rest: Parts, **stage: Any) -> tuple[Array, Array]:
    """Return the state matrices of both planes, about the deflection under the loads of the instant."""
    packed, condition = ascending(section, rest, **stage)
    state, n = settled(packed, zero_incidence(packed, packed.state), 0.0), len(section["damping_ratio"])
    plant = vehicle_plant(vehicle_at(packed, 0.0, condition.mach), condition)
    return plant.a, both_planes(linearise(packed, state, 0.0), n, bool(stage))


@pytest.mark.parametrize("stage", [{}, ON_LOAD], ids=["locked", "swinging"])
def test_linear_model_with_axial_modes_is_the_linearised_simulator(stage: Tree) -> None:
    """Thrust shortens the vehicle by 8 mm, stations move and liquid moves with its tank; every coefficient agrees."""
    section, rest = stiff(10.0, lambda mode, station: 0.0)
    for j in (1, 2):
        for row in [row for row in section["table"] if row["mode"] == 1]:
            shape = dict.fromkeys(SHAPES, 0.0) | {"phi_x": float(np.cos(j * np.pi * row["station_m"] / 14.0))}
            section["table"].append(row | shape | {"mode": 4 + j, "frequency_hz": 20.0 * j})
    section["damping_ratio"] = [*section["damping_ratio"], 0.01, 0.01]
    ours, theirs = plant_and_simulator(section, rest, **stage)
    np.testing.assert_allclose(ours, theirs, rtol=1e-8, atol=1e-9)
    packed, condition = ascending(section, rest, **stage)
    vehicle = vehicle_at(packed, 0.0, condition.mach)
    assert vehicle.across is not None
    still = replace(vehicle, modes=replace(vehicle.modes, along=None))
    without = vehicle_plant(replace(still, across=replace(vehicle.across, modes=still.modes)), condition).a
    assert (np.abs(without - theirs) / np.abs(theirs).max(axis=1, keepdims=True)).max() > 1e-3


@pytest.mark.parametrize(
    ("factor", "stage", "bound"), [(10.0, {}, 1e-6), (10.0, ON_LOAD, 2e-6), (2.0, {}, 1e-3), (2.0, ON_LOAD, 2e-3)]
)
def test_modes_that_move_along_and_across_at_once_are_exact_in_the_first_order(
    factor: float, stage: Tree, bound: float
) -> None:
    """Thrust also bends the axis; the omitted terms grow with the square of that deflection."""
    section, rest = stiff(factor, lambda mode, station: 0.35 * mode * np.cos(station / 3.0 + mode))
    ours, theirs = plant_and_simulator(section, rest, **stage)
    apart = (np.abs(ours - theirs) / np.abs(theirs).max(axis=1, keepdims=True)).max()
    assert 0.1 * bound < apart < bound


def test_a_plane_of_the_coupled_plant_holds_the_other() -> None:
    """With planar pairs as spatial modes in their planes, the plant of a loop is that of the planar vehicle."""
    section, rest = as_spatial(PARTS)
    start = {"initial": {"ned_mps": [200.0, 0.0, 0.0]}, "earth": {"gravity": "uniform"}}
    made = []
    for parts, more in ((PARTS, {}), (rest, {"spatial_modes": section})):
        straight = replace(parts, core_cg=(7.0, 0.0, 0.0), gimbal_offset_m=(0.0, 0.0))
        tree = with_stage(merged(scenario_of(straight, **AIR), start), aero=AERO, **more)
        made.append(node_of(pack_flight(load(tree).scenario), 0.0))
    planar, spatial = made
    frequencies = np.array([0.3, 1.0, 3.1, 5.2, 20.0])
    ours, theirs = (node.plant.response(frequencies) for node in (spatial, planar))
    np.testing.assert_allclose(ours, theirs, rtol=1e-9, atol=1e-12)
    weak = [disperse(node, Dispersion(bending_slope=1.2, thrust=1.0, slosh_mass=0.9)) for node in made]
    ours, theirs = (node.plant.response(frequencies) for node in weak[::-1])
    np.testing.assert_allclose(ours, theirs, rtol=1e-9, atol=1e-12)
    gusts = [wind_response(PadeFixedPath(node), Spectrum(3.0, 500.0, "dryden")) for node in (spatial, planar)]
    for name in ("weights", "measured", "by_command", "by_wind"):
        ours, theirs = (getattr(of, name) for of in gusts)
        np.testing.assert_allclose(ours, theirs, rtol=1e-9, atol=1e-9 * np.abs(theirs).max())


@pytest.mark.parametrize("plane", ["pitch", "yaw"])
def test_bending_moments_of_spatial_modes_are_those_of_planar_ones(plane: str) -> None:
    """With planar pairs as spatial modes turned by 30 deg, each moment by command and wind agrees at six stations."""
    section, rest = as_spatial(PARTS, np.radians(30.0))
    start = {"initial": {"ned_mps": [200.0, 0.0, 0.0]}, "earth": {"gravity": "uniform"}}
    made = []
    for parts, more in ((PARTS, {}), (rest, {"spatial_modes": section})):
        straight = replace(parts, core_cg=(7.0, 0.0, 0.0), gimbal_offset_m=(0.0, 0.0), tanks=parts.tanks[:1])
        given = merged(scenario_of(straight, **AIR), start | {"switches": {"section_loads": True}})
        tree = with_stage(given, aero=AERO, loads=loaded(), **more)
        made.append(node_of(pack_flight(load(tree).scenario), 0.0, 0, plane).plant_in_wind())
    planar, spatial = made
    moments = [k for k, name in enumerate(planar.outputs) if name.startswith("bending")]
    assert planar.outputs == spatial.outputs
    assert len(moments) == 6
    hz = np.array([0.3, 1.0, 3.1, 5.2, 20.0])
    ours, theirs = (plant.response(hz)[:, moments] for plant in (spatial, planar))
    np.testing.assert_allclose(ours, theirs, rtol=1e-8, atol=1e-9 * np.abs(theirs).max())


@pytest.mark.parametrize("plane", ["pitch", "yaw"])
def test_air_that_moves_with_the_vehicle_does_nothing(plane: str) -> None:
    """For turned pairs, which couple the planes, with tables, the wind's column is minus that of w."""
    section, rest = as_spatial(PARTS, np.radians(30.0))
    start = {"initial": {"ned_mps": [200.0, 20.0, -15.0]}, "earth": {"gravity": "uniform"}}
    tree = with_stage(merged(scenario_of(rest, **AIR), start), aero=AERO | TABLES, spatial_modes=section)
    node = node_of(pack_flight(load(tree).scenario), 0.0, 0, plane)
    whole = node.plant_in_wind()
    wind, w = whole.inputs.index("wind_mps"), whole.states.index("w_mps")
    np.testing.assert_allclose(whole.b[:, wind], -whole.a[:, w], rtol=1e-9, atol=1e-11)
    felt = [n for n, name in enumerate(whole.outputs) if name != "w_mps"]  # which is not relative to the air
    np.testing.assert_allclose(whole.d[felt, wind], -whole.c[felt, w], rtol=1e-9, atol=1e-11)
    assert whole.inputs == (*node.plant.inputs, "wind_mps")


def test_the_replay_bends_the_same() -> None:
    """The replay draws planar pairs written as spatial modes turned by 30 deg along the line of the planar modes."""
    angle = np.radians(30.0)
    section, rest = as_spatial(PARTS, angle)
    planar, spatial = (
        shape_of(load(tree).vehicle).stages[0]
        for tree in (scenario_of(PARTS), with_stage(scenario_of(rest), spatial_modes=section))
    )
    rng = np.random.default_rng(9)
    pitch, yaw = rng.normal(size=(2, 3, 2))
    turned = np.concatenate([pitch, yaw], axis=1) @ turning(2, angle).T
    for column in ("phi", "slope_pm"):
        wanted = bent_line(planar, np.zeros(3), pitch, yaw, np.array(STATIONS), column)
        ours = bent_line(spatial, np.zeros(3), *np.zeros((2, 3, 0)), np.array(STATIONS), column, turned)
        np.testing.assert_allclose(ours, wanted, atol=1e-12)
