"""Gimballed engines on a bent, rolling body with liquid equal particles (tests/oracles/rolling_particles.py).

The roll rate is 1 rad/s, and all other quantities are small. There are two engines off the axis at two stations, on
compliant gimbals or driven by their actuators, two pairs of modes (planar, or spatial and turned about x) and two bobs.
The equations of motion agree with the particles' to first order in modal coordinates and rates, gimbal angles and
rates, bob angles and rates, pitch and yaw rate. Without the products of roll rate, gimbal angle and modal rate in the
engine's energy (docs/model.md, 3.2), the modal accelerations per modal rate are off by 0.71 of 2.0 and per gimbal rate
by 0.18, the engines' by 5.3 and 0.69. The engines have inertia about their CG. With twice its Coriolis moment, as of a
slender rod, the engines' accelerations per gimbal rate are off by 0.50 of 1.56.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache

import numpy as np
import pytest
from flightkit import Mode, Parts, Rig, Tank, Tree, gimbal_motions, rig, scenario_of
from oracles.rolling_particles import Bob, Floats, Particles, PointEngine, jacobian_of
from test_oracle_spatial_modes import spatial_section

from maxq.control.kernel.records import Array
from maxq.sim.vehicle import state as layout

ROLL_RADPS, MODES = 1.0, 4
OMEGA, MODAL_KG = np.array([20.0, 26.0, 35.0, 50.0]), 500.0  # of the modes, rad/s
STIFFNESS_NMPRAD = 4.0e4
ENGINES = (PointEngine(160.0, 0.6, 12, (0.3, -0.2), 12.0), PointEngine(120.0, 0.45, 13, (-0.25, 0.15), 9.0))
BOBS = (Bob(400.0, 0.5, 4), Bob(300.0, 0.7, 9))


def shapes_of(turn: bool) -> tuple[Floats, Floats, Floats, Floats]:
    """Return masses, places, shapes and slopes of two pairs of free-free modes, in the planes or mixed by a rotation.

    A pair's turned shapes are modes as well, so that the quasi-velocities hold the roll rate's share completely.
    """
    rng = np.random.default_rng(11)
    mass, x = rng.uniform(50.0, 300.0, 15), np.linspace(7.0, -7.0, 15)
    x = x - mass @ x / mass.sum()
    basis = [np.ones(15), x]
    for power in (2, 3):
        shape = (x / 7.0) ** power
        for other in [*basis, *basis]:
            shape = shape - other * (mass @ (shape * other)) / (mass @ (other * other))
        basis.append(shape / np.sqrt(mass @ shape**2 / MODAL_KG))
    plain = np.zeros((MODES, 15, 3))
    plain[[0, 1], :, 2], plain[[2, 3], :, 1] = basis[2:], basis[2:]
    mixed = np.linalg.qr(rng.normal(size=(MODES, MODES)))[0] if turn else np.eye(MODES)
    shapes = np.einsum("ij,jnk->ink", mixed, plain)
    slope = np.gradient(shapes, 7.0 - x, axis=1)
    return mass, x, shapes, np.stack([0.0 * slope[..., 0], slope[..., 2], -slope[..., 1]], axis=-1)


@dataclass(frozen=True, eq=False)
class Vehicles:
    """The simulator's vehicle and the particles'; `share` is A of docs/model.md (4.7)."""

    made: Rig
    particles: Particles
    share: Floats
    driven: bool

    @property
    def angles_at(self) -> int:
        return 6 + MODES


@cache
def vehicles(spatial: bool, driven: bool) -> Vehicles:
    mass, x, shapes, slopes = shapes_of(spatial)
    hull_kg, reach = np.full(4, 60.0), 1.5
    hull_m = reach * np.array([[0.0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]])
    particles = Particles(mass, x, shapes, slopes, hull_kg, hull_m, ENGINES, BOBS)
    stations = 7.0 - x
    across = float(mass @ x**2 + hull_kg[:2].sum() * reach**2)
    parts = Parts(
        core_mass_kg=float(mass.sum() + hull_kg.sum()), core_cg=(7.0, 0.0, 0.0), gyro_station_m=float(stations[7]),
        core_inertia=((float(hull_kg.sum() * reach**2), 0.0, 0.0), (0.0, across, 0.0), (0.0, 0.0, across)),
        tanks=tuple(Tank(b.mass_kg, b.length_m, float(stations[b.section])) for b in BOBS),
        stations_m=tuple(map(float, stations)), mass_forward_kg=tuple(map(float, np.cumsum(mass) - mass)),
        gimbal_station_m=float(stations[12]),
    )  # fmt: skip  # a table
    if not spatial:
        planes = ((shapes[:2, :, 2], slopes[:2, :, 1]), (shapes[2:, :, 1], -slopes[2:, :, 2]))
        hz = OMEGA.reshape(2, 2) / (2.0 * np.pi)
        pitch, yaw = (
            tuple(
                Mode(float(f), MODAL_KG, tuple(map(float, a)), tuple(map(float, b)))
                for f, a, b in zip(each, phi, slope, strict=True)
            )
            for each, (phi, slope) in zip(hz, planes, strict=True)
        )
        parts = replace(parts, pitch=pitch, yaw=yaw)
    tree = scenario_of(parts)
    stage: Tree = tree["vehicle"]["stage"][0]
    stage["engine"] = [
        {
            "table": [{"time_s": 0.0, "thrust_vacuum_N": 0.0}], "group": str(n), "offset_m": list(e.offset_m),
            "gimbal_station_m": float(stations[e.section]), "exit_station_m": 15.0, "gimballed_mass_kg": e.mass_kg,
            "cg_from_gimbal_m": e.length_m,
            "inertia_about_gimbal_kgm2": e.mass_kg * e.length_m**2 + e.inertia_kgm2,
        }
        for n, e in enumerate(ENGINES)
    ]  # fmt: skip  # a table
    if not driven:
        load = {"stiffness_Nmprad": STIFFNESS_NMPRAD, "damping_ratio": 0.0}
        stage["tvc_load"] = [load | {"group": str(n)} for n in range(len(ENGINES))]
    if spatial:
        sets = [
            (w / (2.0 * np.pi), MODAL_KG, 0.0, np.concatenate([a, b], axis=1))
            for w, a, b in zip(OMEGA, shapes, slopes, strict=True)
        ]
        stage["spatial_modes"] = spatial_section(stations, np.cumsum(mass) - mass, sets, mass_kg=mass)
    made = rig(tree)
    assert (int(made.sizes.engines), int(made.sizes.spatial_modes > 0)) == (2, int(spatial))
    turned = np.stack([0.0 * shapes[..., 0], -shapes[..., 2], shapes[..., 1]], axis=-1)
    share = np.einsum("n,jnk,ink->ij", mass, turned, shapes) / MODAL_KG
    return Vehicles(made, particles, share, driven)


def modal_places(made: Rig) -> tuple[list[int], list[int]]:
    """Return the indices of the modal coordinates and their quasi-velocities, in the order of the particles' modes."""
    if made.sizes.spatial_modes > 0:
        first = int(layout.spatial_index(made.sizes))
        return [first + k for k in range(MODES)], [first + MODES + k for k in range(MODES)]
    eta, xi = int(layout.eta_index(made.sizes)), int(layout.xi_index(made.sizes))
    return [eta, eta + 1, xi, xi + 1], [eta + 2, eta + 3, xi + 2, xi + 3]


def state_of(v: Vehicles, q: Floats, rate: Floats) -> Array:
    """Return the simulator's state at coordinates and rates of the particles."""
    made, w = v.made, rate[3:6]
    y, (at_eta, at_nu) = made.y.copy(), modal_places(made)
    y[layout.V_I : layout.V_I + 3], y[layout.W_BI_B : layout.W_BI_B + 3] = rate[:3], w
    modes = slice(6, 6 + MODES)
    y[at_eta], y[at_nu] = q[modes], rate[modes] + w[0] * v.share @ q[modes]
    for n in range(len(ENGINES)):
        i, at = int(layout.tvc_load_index(made.sizes)) + 6 * n, v.angles_at + 2 * n
        for axis in range(2):
            if not v.driven:
                y[i + 3 * axis], y[i + 3 * axis + 1] = q[at + axis], rate[at + axis]
    for k in range(len(BOBS)):
        i, at = int(layout.pendulum_index(made.sizes, k)), v.angles_at + 2 * len(ENGINES) + 2 * k
        (a, b), (da, db) = q[at : at + 2], rate[at : at + 2]
        u = np.array([-np.sqrt(1.0 - a * a - b * b), a, b])
        y[i : i + 3] = u
        y[i + 3 : i + 6] = np.array([-(a * da + b * db) / u[0], da, db]) + np.cross(w, u)
    return y


def of_simulator(v: Vehicles, q: Floats, rate: Floats, actuators: Floats) -> tuple[Floats, Floats]:
    """Return accelerations of the particles' coordinates, and the engines' motion.

    The motion (4, 3) is angle, rate and acceleration of each engine in pitch and yaw. `actuators`: states (24,) of the
    actuators, which drive the engines or hold the far ends of their springs.
    """
    made = v.made
    y = state_of(v, q, rate)
    first = int(layout.actuator_index(made.sizes, 0))
    y[first : first + 12] = actuators[:12]
    second = int(layout.actuator_index(made.sizes, 1))
    y[second : second + 12] = actuators[12:]
    dy, w = made.derivative(y), rate[3:6]
    out, (_, at_nu) = np.zeros(v.particles.size), modal_places(made)
    alpha = dy[layout.W_BI_B : layout.W_BI_B + 3]
    out[:3] = made.aux.specific_force_B_mps2
    out[3:6] = alpha
    modes = slice(6, 6 + MODES)
    out[modes] = dy[at_nu] - v.share @ (alpha[0] * q[modes] + w[0] * rate[modes])
    motion = gimbal_motions(made.aux.engines.channel[: 2 * len(ENGINES)])
    out[v.angles_at : v.angles_at + len(motion)] = motion[:, 2]
    for k in range(len(BOBS)):
        i, at = int(layout.pendulum_index(made.sizes, k)), v.angles_at + 2 * len(ENGINES) + 2 * k
        u = y[i : i + 3]
        u_rate = y[i + 3 : i + 6] - np.cross(w, u)
        out[at : at + 2] = (dy[i + 3 : i + 6] - np.cross(alpha, u) - np.cross(w, u_rate))[1:]
    return out, motion


def of_particles(v: Vehicles, q: Floats, rate: Floats, motion: Floats) -> Floats:
    """Return the same accelerations by the particles; a driven engine's acceleration is given."""
    force, at = np.zeros(v.particles.size), v.angles_at
    force[6 : 6 + MODES] = -MODAL_KG * OMEGA**2 * q[6 : 6 + MODES]
    if v.driven:
        return v.particles.accelerations(q, rate, force, {at + k: float(a) for k, a in enumerate(motion[:, 2])})
    for n, engine in enumerate(ENGINES):
        force[at + 2 * n : at + 2 * n + 2] = -STIFFNESS_NMPRAD * q[at + 2 * n : at + 2 * n + 2] + preload(engine)
    return v.particles.accelerations(q, rate, force, {})


def preload(engine: PointEngine) -> Floats:
    """Return the moments (pitch, yaw; N m) that hold an engine off the axis straight in its centrifugal field."""
    y, z = engine.offset_m
    force = engine.mass_kg * ROLL_RADPS**2 * np.array([y, z])
    return engine.length_m * np.array([force[1], -force[0]])


@cache
def actuator_maps(v: Vehicles) -> list[Floats]:
    """Return the states (6) of an actuator per angle, rate and acceleration (3), for each engine in pitch and yaw.

    With compliant gimbals the motion is that of the far end of the spring, whose acceleration has no meaning.
    """
    zero, out = np.zeros(v.particles.size), []
    for number in range(2 * len(ENGINES)):
        columns = []
        for state in range(6):
            _, motion = of_simulator(v, zero, zero, 1e-6 * np.eye(24)[6 * number + state])
            held = v.made.aux.tvc_loads
            far_end = np.array([held.actuator_rad[number], held.actuator_radps[number], 0.0])
            columns.append(motion[number] if v.driven else far_end)
        scale = np.array([1.0, 1e-2, 1e-4])[:, None]
        out.append(np.linalg.pinv(scale * 1e6 * np.array(columns).T) * scale.T)
    return out


def actuators_of(v: Vehicles, motion: Floats) -> Floats:
    """Return the states of the actuators (24,) at angles, rates and accelerations (4, 3) of the engines."""
    return np.concatenate([states @ wanted for states, wanted in zip(actuator_maps(v), motion, strict=True)])


def both(v: Vehicles, amount: Floats) -> tuple[Floats, Floats]:
    """Return the accelerations computed by the simulator and by the particles.

    `amount` contains small pitch and yaw rates, then the coordinates after the first six, and their rates. Driven
    engines also have accelerations.
    """
    size = v.particles.size
    q, rate, motion = np.zeros(size), np.zeros(size), np.zeros((2 * len(ENGINES), 3))
    rate[3:6] = ROLL_RADPS, *amount[:2]
    small = amount[2:].reshape(2, size - 6)
    q[6:], rate[6:] = small
    engines = slice(v.angles_at, v.angles_at + 2 * len(ENGINES))
    if v.driven:
        motion = np.stack([q[engines], rate[engines], 30.0 * (q[engines] - rate[engines])], axis=1)
    else:
        motion[:, 0] = np.concatenate([preload(engine) for engine in ENGINES]) / STIFFNESS_NMPRAD
    ours, flown = of_simulator(v, q, rate, actuators_of(v, motion))
    if v.driven:
        np.testing.assert_allclose(flown, motion, rtol=1e-9, atol=1e-9 * np.abs(motion).max())
    return ours, of_particles(v, q, rate, flown)


def small_quantities(v: Vehicles) -> int:
    return 2 + 2 * (v.particles.size - 6)


KINDS = [(spatial, driven) for spatial in (False, True) for driven in (False, True)]
NAMES = [f"{'spatial' if spatial else 'planar'}-{'driven' if driven else 'compliant'}" for spatial, driven in KINDS]


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS, ids=NAMES)
def test_equations_of_motion_agree_with_particles_to_first_order(kind: tuple[bool, bool]) -> None:
    """A tenth of the amplitude leaves a hundredth of the difference; a term of first order would leave a tenth."""
    v = vehicles(*kind)
    direction = np.random.default_rng(3).normal(size=small_quantities(v))
    left = []
    for amplitude in (1e-2, 1e-3, 1e-4):
        ours, theirs = both(v, amplitude * direction)
        left.append(np.abs(ours - theirs).max() / amplitude)
    assert left[1] / left[0] < 0.15
    assert left[2] / left[1] < 0.15


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS, ids=NAMES)
def test_every_column_of_the_jacobian_is_that_of_particles(kind: tuple[bool, bool]) -> None:
    """Central differences at 1e-4 leave 1e-8 of third-order coefficients, and 1e-12 of the largest stiffness."""
    v = vehicles(*kind)
    size = small_quantities(v)
    ours = jacobian_of(lambda x: both(v, x)[0], size, 1e-4)
    theirs = jacobian_of(lambda x: both(v, x)[1], size, 1e-4)
    np.testing.assert_allclose(ours, theirs, rtol=0.0, atol=2e-8 * np.abs(theirs).max())
