"""A clamped tail equals a clamped beam of finite elements, and the release an integrated modal model.

| quantity | against |
|---|---|
| deflection on a tilted pad under the beam's own weight | finite elements with geometric stiffness |
| frequencies on the pad | eigenvalues of the clamped finite elements |
| frequencies of spatial modes on the pad | Lagrange in the motions that leave the tail at rest |
| start of the flight | static deflection of the finite elements; nothing moves until the release |
| motion on the pad and after the release | Lagrange's equations of the modes, by DOP853 |
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from flightkit import Rig, Tree, load, merged, rig
from oracles.multibody_system import rotation_from_quaternion
from scipy.integrate import solve_ivp
from scipy.linalg import block_diag, eigh, null_space
from test_oracle_section_loads import LENGTH_M, NODES, a_beam, beam_vehicle, forward_kg, of_modes, wind_on
from test_oracle_spatial_modes import spatial_section

from maxq import FlightRun, ScenarioError
from maxq.control.kernel.records import Array
from maxq.sim.run.evaluate import evaluate_at
from maxq.sim.vehicle import state as layout

FREE = slice(None, -2)  # of the finite elements: all nodes but the tail


def on_the_pad(count: int, pitch_deg: float = 90.0, **sections: Any) -> Tree:
    """Return the beam's first modes in pitch, clamped at the tail at the engine's gimbal."""
    site = {
        "initial": {"held": True, "euler_deg": [0.0, pitch_deg, 0.0]},
        "holddown": {"release": "time", "release_s": 0.3, "clamped": True},
        "earth": {"shape": "flat", "rotating": False, "gravity": "none"},
    }
    tree = beam_vehicle(a_beam(), count, np.array([6.0]), **merged(site, sections))
    tree["switches"] |= {"section_loads": False, "control": False}
    del tree["vehicle"]["stage"][0]["loads"]
    return tree


def tilted(q: Array, angle: float) -> Array:
    """Return a quaternion after a rotation about the body's y axis."""
    (w, x, y, z), c, s = q, math.cos(0.5 * angle), math.sin(0.5 * angle)
    return np.array([w * c - y * s, x * c - z * s, w * s + y * c, x * s + z * c])


class Clamped:
    """A packed vehicle on the pad, whose body axes lean with its modes to keep the tail fixed."""

    def __init__(self, tree: Tree, count: int) -> None:
        self.made: Rig = rig(tree)
        self.q = self.made.packed.state[layout.Q_BI : layout.Q_BI + 4].copy()
        _, _, phi, slope = a_beam().modes(count)
        self.phi, self.slope = phi, slope

    def acceleration(self, eta: Array) -> Array:
        """Return the accelerations of the modes at these coordinates, at rest."""
        y, place = self.made.packed.state, of_modes(self.made)
        y[place] = eta
        y[layout.Q_BI : layout.Q_BI + 4] = tilted(self.q, -self.slope[:, -1] @ eta)
        return evaluate_at(self.made.packed, y, 0.0).rate[place.stop : place.stop + len(eta)].copy()

    def stiffness(self) -> Array:
        """Return the derivatives of the accelerations with respect to the coordinates (count, count)."""
        units = 1e-3 * np.eye(len(self.phi))
        return np.stack([self.acceleration(unit) - self.acceleration(-unit) for unit in units], axis=1) / 2e-3

    def shape(self, eta: Array) -> Array:
        """Return the deflections of the nodes relative to the tail."""
        bent, turned = eta @ self.phi, eta @ self.slope
        return np.asarray(bent - bent[-1] - turned[-1] * (a_beam().x - LENGTH_M))


def leaning(count: int) -> Array:
    """Return the free modes less the motion of their tail, over (w, w') of every node but the tail (nodes, count)."""
    _, _, phi, slope = a_beam().modes(count)
    bent = phi - phi[:, -1:] - slope[:, -1:] * (a_beam().x - LENGTH_M)
    return np.stack([bent, slope - slope[:, -1:]], axis=2).reshape(count, -1)[:, FREE].T


def test_a_column_that_leans_on_its_clamp_bends_as_finite_elements_do() -> None:
    """At 80 degrees, weight acts along and across the axis; finite elements in the span of the leaning modes agree."""
    count, pitch = 6, math.radians(80.0)
    pad = Clamped(on_the_pad(count, 80.0, earth={"gravity": "uniform"}), count)
    gravity = float(np.linalg.norm(evaluate_at(pad.made.packed, pad.made.packed.state, 0.0).aux.air.gravitation_I_mps2))
    eta = np.linalg.solve(pad.stiffness(), -pad.acceleration(np.zeros(count)))
    kg, modes = forward_kg(a_beam()), leaning(count)
    middle_kg = 0.5 * (kg[1:] + kg[:-1] - a_beam().point_kg[1:])
    found = []
    for axial_N in (-gravity * math.sin(pitch) * middle_kg, 0.0):
        k, m = a_beam(axial_N).matrices()
        load = m @ np.tile([gravity * math.cos(pitch), 0.0], NODES)
        found.append(modes @ np.linalg.solve(modes.T @ k[FREE, FREE] @ modes, modes.T @ load[FREE]))
    expected, straight = (np.append(w[0::2], 0.0) for w in found)
    largest = np.abs(expected).max()
    assert np.abs(straight - expected).max() > 0.01 * largest  # the axial force is seen
    assert np.abs(pad.shape(eta) - expected).max() < 1e-4 * largest


def test_a_leaning_column_stands_still_until_its_release() -> None:
    """Its deflection is that of finite elements, and 0.2 s on the pad change it by less than a ten-thousandth."""
    count, pitch = 6, math.radians(80.0)
    more = {"run": {"step_s": 0.0005, "duration_s": 0.3, "stop_at": []}, "earth": {"gravity": "uniform"}}
    tree = on_the_pad(count, 80.0, **more)
    pad, arm = Clamped(tree, count), float(tree["vehicle"]["stage"][0]["mass"]["x_cg_m"]) - LENGTH_M
    straight = pad.made.packed.state.copy()
    run, place, gravity = FlightRun(pad.made.loaded, log=False), of_modes(pad.made), 9.80665
    begun = run.packed.state.copy()
    run.fly_segment(200_000_000)
    kg, modes = forward_kg(a_beam()), leaning(count)
    middle_kg = 0.5 * (kg[1:] + kg[:-1] - a_beam().point_kg[1:])
    k, m = a_beam(-gravity * math.sin(pitch) * middle_kg).matrices()
    load = m @ np.tile([gravity * math.cos(pitch), 0.0], NODES)
    expected = modes @ np.linalg.solve(modes.T @ k[FREE, FREE] @ modes, modes.T @ load[FREE])
    largest = np.abs(expected[0::2]).max()
    assert largest > 1e-3
    assert np.abs(pad.shape(begun[place]) - np.append(expected[0::2], 0.0)).max() < 1e-4 * largest
    assert np.abs(run.packed.state[place] - begun[place]).max() < 1e-4 * np.abs(begun[place]).max()
    tail = []
    for y in (straight, begun, run.packed.state):
        turn, eta = rotation_from_quaternion(y[layout.Q_BI : layout.Q_BI + 4]), y[place]
        tail.append(y[layout.R_I : layout.R_I + 3] + turn @ np.array([arm, 0.0, pad.phi[:, -1] @ eta]))
    assert np.abs(np.array(tail) - tail[0]).max() < 1e-6 * largest


def test_modes_on_the_pad_are_those_of_a_cantilever() -> None:
    """The modes are those of finite elements in the span of the leaning modes, which converges as 1 / count."""
    k, m = a_beam().matrices()
    found = {}
    for count in (6, 12):
        modes = leaning(count)
        projected = (modes.T @ matrix[FREE, FREE] @ modes for matrix in (k, m))
        expected = np.sqrt(eigh(*projected, eigvals_only=True))
        squares = np.linalg.eigvals(-Clamped(on_the_pad(count), count).stiffness())
        found[count] = np.sqrt(np.sort(squares.real))[:3]
        assert found[count] == pytest.approx(expected[:3], rel=1e-4)
    whole = np.sqrt(eigh(k[FREE, FREE], m[FREE, FREE], eigvals_only=True, subset_by_index=[0, 2]))
    assert (2.0 * found[12] - found[6])[:2] == pytest.approx(whole[:2], rel=5e-3)
    assert found[12][0] == pytest.approx(1.08 * whole[0], rel=1e-2)
    assert whole[0] < 0.3 * a_beam().modes(1)[0][0]


SPATIAL_KG, SPATIAL_HZ, TAIL = (900.0, 500.0, 700.0, 400.0), (2.0, 3.1, 4.4, 6.0), 1


def spatial_column(pitch_deg: float, **more: Any) -> tuple[Tree, Array]:
    """Return a clamped vehicle with four modes that bend in both planes, twist and stretch, and their tail (4, 6)."""
    tree = on_the_pad(2, pitch_deg, **more)
    stage = tree["vehicle"]["stage"][0]
    del stage["bending"]
    stage["mass"] |= {"y_cg_m": 0.2, "z_cg_m": -0.1}
    stage["mass"]["inertia_kgm2"] = np.array(stage["mass"]["inertia_kgm2"]) + np.diag([2000.0, 0.0, 0.0])
    shapes = np.random.default_rng(8).normal(size=(4, 2, 6)) * np.array([0.3, 1.0, 1.0, 0.1, 0.1, 0.1])
    lean = (shapes[:, 1:] - shapes[:, :1]) / LENGTH_M
    shapes[:, :, 4], shapes[:, :, 5] = lean[:, :, 2], -lean[:, :, 1]
    modes = [(hz, kg, 0.0, shape) for hz, kg, shape in zip(SPATIAL_HZ, SPATIAL_KG, shapes, strict=True)]
    stage["spatial_modes"] = spatial_section(np.array([0.0, LENGTH_M]), np.zeros(2), modes)
    return tree, shapes[:, TAIL]


def test_a_clamp_holds_spatial_modes_in_all_six_directions() -> None:
    """Oracle: modes and rigid body in the space of motions without one of the tail."""
    tree, tail = spatial_column(90.0)
    made, mass = rig(tree), tree["vehicle"]["stage"][0]["mass"]
    x, y, z = mass["x_cg_m"] - LENGTH_M, -mass["y_cg_m"], -mass["z_cg_m"]
    arm = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    kept = np.block([[np.eye(3), -arm, tail[:, :3].T], [np.zeros((3, 3)), np.eye(3), tail[:, 3:].T]])
    inertia = block_diag(mass["mass_kg"] * np.eye(3), mass["inertia_kgm2"], np.diag(SPATIAL_KG))
    stiffness = np.diag([0.0] * 6 + list(np.array(SPATIAL_KG) * (2.0 * np.pi * np.array(SPATIAL_HZ)) ** 2))
    free = null_space(kept)
    expected = eigh(free.T @ stiffness @ free, free.T @ inertia @ free, eigvals_only=True)
    first, columns = int(layout.spatial_index(made.sizes)), []
    for n in range(4):
        rates = []
        for side in (1e-5, -1e-5):
            state = made.packed.state.copy()
            state[first + n] = side
            rates.append(evaluate_at(made.packed, state, 0.0).rate[first + 4 : first + 8].copy())
        columns.append((rates[1] - rates[0]) / 2e-5)
    found = np.sort(np.linalg.eigvals(np.array(columns).T).real)
    np.testing.assert_allclose(found, expected, rtol=1e-7)
    assert np.sqrt(found[0]) < 0.9 * 2.0 * np.pi * SPATIAL_HZ[0]


def test_spatial_modes_stand_still_on_a_leaning_pad() -> None:
    run = {"step_s": 0.001, "duration_s": 0.4, "stop_at": []}
    tree, tail = spatial_column(80.0, run=run, earth={"gravity": "uniform"})
    made = rig(tree)
    first, straight = int(layout.spatial_index(made.sizes)), made.packed.state.copy()
    flight = FlightRun(made.loaded, log=False)
    begun = flight.packed.state.copy()
    flight.fly_segment(100_000_000)
    bent = begun[first : first + 4]
    assert np.abs(bent).max() > 1e-3
    np.testing.assert_allclose(flight.packed.state[first : first + 4], bent, rtol=0.0, atol=1e-5 * np.abs(bent).max())
    mass, places = tree["vehicle"]["stage"][0]["mass"], []
    arm = np.array([mass["x_cg_m"] - LENGTH_M, -mass["y_cg_m"], -mass["z_cg_m"]])
    for y in (straight, begun):
        turn = rotation_from_quaternion(y[layout.Q_BI : layout.Q_BI + 4])
        places.append(y[layout.R_I : layout.R_I + 3] + turn @ (arm + y[first : first + 4] @ tail[:, :3]))
    np.testing.assert_allclose(places[1], places[0], rtol=0.0, atol=1e-9)


def test_motion_on_the_pad_and_after_the_release() -> None:
    """The beam is bent, released on the pad, and freed after 0.3 s; until then only modes give rigid motion."""
    count, zeta = 3, 0.01
    tree = on_the_pad(count)
    tree["vehicle"]["stage"][0]["bending"]["damping_ratio"] = [zeta] * count
    omega, mass, phi, slope = a_beam().modes(count)
    start = np.array([2e-3, -1e-3, 5e-4])
    made = rig(merged(tree, {"run": {"step_s": 0.0005, "duration_s": 0.6, "stop_at": []}}))
    place = of_modes(made)
    made.y[place] = start
    run = made.run()
    states = []
    for _ in range(2):
        run.fly_segment(300_000_000)
        states.append(made.y.copy())
    section = tree["vehicle"]["stage"][0]["mass"]
    arm = float(section["x_cg_m"]) - LENGTH_M
    rigid = np.diag([float(section["mass_kg"]), float(np.array(section["inertia_kgm2"])[1, 1])])
    # z of the CG and rotation about y per modal coordinate, so that the tail stays
    follows = np.stack([-phi[:, -1] - arm * slope[:, -1], -slope[:, -1]])
    inertia = np.diag(mass) + follows.T @ rigid @ follows

    def held(_: float, y: Array) -> Array:
        inner = -mass * (omega**2 * y[:count] + 2.0 * zeta * omega * y[count:])
        return np.concatenate([y[count:], np.linalg.solve(inertia, inner)])

    def free(_: float, y: Array) -> Array:
        return np.concatenate([y[count:], -(omega**2) * y[:count] - 2.0 * zeta * omega * y[count:]])

    exact = {"method": "DOP853", "rtol": 1e-11, "atol": 1e-13}
    at_release = solve_ivp(held, (0.0, 0.3), np.concatenate([start, np.zeros(count)]), **exact).y[:, -1]
    later = solve_ivp(free, (0.0, 0.3), at_release, **exact).y[:, -1]
    both = slice(place.start, place.start + 2 * count)
    size = np.abs(at_release).max()
    assert states[0][both] == pytest.approx(at_release, abs=1e-4 * size)
    assert states[1][both] == pytest.approx(later, abs=1e-4 * size)
    velocity, rate = follows @ at_release[count:]
    for y in states:
        speed = float(np.linalg.norm(y[layout.V_I : layout.V_I + 3]))
        assert speed == pytest.approx(abs(velocity), rel=1e-4)
        assert y[layout.W_BI_B + 1] == pytest.approx(rate, rel=1e-4)
    at_s = np.linspace(0.0, 0.3, 601)
    swing = solve_ivp(free, (0.0, 0.3), at_release, t_eval=at_s, **exact).y[count:]
    at_gyro = np.degrees(np.abs(slope[:, np.searchsorted(a_beam().x, 3.0)] @ swing))
    metrics, times = run.result().metrics, run.result().metric_times_s
    assert metrics["max_release_bending_degps"] == pytest.approx(at_gyro.max(), rel=1e-3)
    assert times["max_release_bending_degps"] == pytest.approx(0.3 + at_s[int(at_gyro.argmax())], abs=1e-3)
    assert math.isnan(rig(on_the_pad(2)).run().result().metrics["max_release_bending_degps"])


def test_both_planes_swing_alike_on_the_clamp() -> None:
    tree = on_the_pad(3, run={"step_s": 0.001, "duration_s": 0.2, "stop_at": []})
    bending = tree["vehicle"]["stage"][0]["bending"]
    bending["yaw"] = bending["pitch"]
    made = rig(tree)
    pitch, yaw = of_modes(made), int(layout.xi_index(made.sizes))
    made.y[pitch] = made.y[yaw : yaw + 3] = (2e-6, -1e-6, 5e-7)
    made.run().fly_segment(200_000_000)
    y, w = made.y, layout.W_BI_B
    assert np.abs(y[pitch]).max() > 1e-7
    assert y[yaw : yaw + 6] == pytest.approx(y[pitch.start : pitch.start + 6], rel=1e-9)
    assert y[w + 2] == pytest.approx(-y[w + 1], rel=1e-9)


def test_the_tail_stays_under_all_loads() -> None:
    """Under misaligned thrust, weight, wind and liquid on a turning Earth, the tail moves with the ground.

    The bob swings by 5 degrees. Its tension varies by 1.5 times their square, on a twentieth of the mass: 6 mm/s2, over
    200 per second.
    """
    stage = {
        "aero": wind_on([(5.0, 2.0), (3.0, 9.0)], CA=0.4),
        "engine": {"misalignment_deg": [1.5, -1.0]},
        "tank": [
            {
                "table": [{"time_s": 0.0, "slosh_mass_kg": 300.0, "pendulum_length_m": 0.6, "hinge_station_m": 5.0}],
                "damping_ratio": 0.05,
            }
        ],
    }
    tree = on_the_pad(
        4,
        85.0,
        stage=stage,
        thrust_N=5e4,
        earth={"shape": "wgs84", "rotating": True, "gravity": "j2"},
        atmosphere={"model": "constant", "density_kgpm3": 1.2},
        wind={"profile": {"altitude_m": [0.0], "north_mps": [20.0], "east_mps": [12.0]}},
        run={"step_s": 0.001, "duration_s": 0.3, "stop_at": []},
    )
    bending = tree["vehicle"]["stage"][0]["bending"]
    bending["yaw"], bending["damping_ratio"] = bending["pitch"], [0.02] * 4
    tree["vehicle"]["stage"][0]["mass"]["inertia_kgm2"][0][0] = 2000.0
    made = rig(tree)
    run, count = made.run(), 4
    phi, slope = (rows[:, -1] for rows in a_beam().modes(count)[2:])
    spin = np.array([0.0, 0.0, 7.292115e-5])
    i, j, bent = of_modes(made).start, int(layout.xi_index(made.sizes)), 0.0
    for _ in range(6):
        run.fly_segment(48_000_000)
        y = made.y
        turn = rotation_from_quaternion(y[layout.Q_BI : layout.Q_BI + 4])
        made.derivative(y)
        station, cg_y, cg_z = made.props[1:4]
        rate = y[layout.W_BI_B : layout.W_BI_B + 3] - turn.T @ spin
        at = np.array([station - LENGTH_M, phi @ y[j : j + count] - cg_y, phi @ y[i : i + count] - cg_z])
        nu = y[i + count : i + 2 * count], y[j + count : j + 2 * count]
        velocity = turn.T @ (y[layout.V_I : layout.V_I + 3] - np.cross(spin, y[layout.R_I : layout.R_I + 3]))
        velocity = velocity + np.cross(rate, at) + np.array([0.0, phi @ nu[1], phi @ nu[0]])
        turning = rate + np.array([0.0, slope @ nu[0], -slope @ nu[1]])
        bent = max(bent, float(np.abs(slope @ y[i : i + count])), float(np.abs(slope @ y[j : j + count])))
        assert np.abs(velocity).max() < 5e-5
        assert np.abs(turning).max() < 2e-5
    assert bent > 1e-4
    assert int(made.held.on_pad) == 1


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"initial": {"held": False}}, "the vehicle is not held on a pad"),
        ({"rail": {"length_m": 3.0, "elevation_deg": 80.0}}, "the vehicle is not held on a pad"),
    ],
)
def test_a_clamp_that_cannot_hold_is_refused(change: Tree, says: str) -> None:
    with pytest.raises(ScenarioError, match=says):
        load(merged(on_the_pad(2), change))
