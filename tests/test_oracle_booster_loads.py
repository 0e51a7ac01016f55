"""Section loads of a core with boosters equal the sum of forces on every part forward of the cut.

The oracle places particles along the rods of core and boosters, and at the CG of each bob and engine. The simulator
gives the motion of the whole vehicle: specific force, angular acceleration, modal and pendulum accelerations. The
inertial force of each particle follows, and thrust and air loads are added. A booster held at two stations is in
equilibrium with two forces; one clamped at a station, with a force and a couple.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
import sympy
from flightkit import ACTUATOR, EMPTY_SPACE, Tree, engine_states, gimbal_motions, load, merged, rig
from scipy.interpolate import CubicHermiteSpline
from test_oracle_boosters import AFTER, PAIR, core, solid
from test_oracle_boosters import launcher as booster_launcher
from test_oracle_spatial_modes import spatial_section

from maxq.control.kernel.records import Array
from maxq.sim.run.evaluate import evaluate_at
from maxq.sim.run.fly import fly
from maxq.sim.vehicle import schedule
from maxq.sim.vehicle import state as layout

STATIONS_M = [3.0, 4.5, 6.5, 8.5, 9.5, 11.0, 12.0]
CORE_RODS = [(0.5, 5.0, 1500.0), (5.0, 12.0, 2600.0)]  # front, rear, kg
CORE_AT = (0.03, -0.05)  # y and z of the core's CG
SURFACES = [(3.0, 1.5), (2.0, 10.5)]  # slope and station, on the core
CORE_CA, HALF = 0.6, 0.5 * 1.2 * 0.8  # half density times area
THRUST_N = {"core": 9.0e4, "left": 6.0e4, "right": 4.0e4}
TANK_AT = (0.15, -0.1)  # from the axis of its booster
# in kg and m; engine: mass, distance behind the gimbal, inertia; bob: mass, distance behind the hinge, hinge
SIDES: dict[str, Tree] = {
    "left": {
        "at": (-1.1, 0.4),
        "held": [10.0, 4.0],
        "rods": [(5.0, 9.0, 700.0), (9.0, 11.0, 300.0)],
        "gimbal": 11.0,
        "engine": (80.0, 0.5, 6.0),
        "bob": (150.0, 0.6, 6.0),
        "CA": 0.2,
        "surface": (1.2, 5.5),
    },
    "right": {
        "at": (0.9, -0.6),
        "held": [9.0],
        "rods": [(4.0, 10.5, 850.0)],
        "gimbal": 10.5,
        "engine": (0.0, 0.0, 0.0),
        "bob": None,
        "CA": 0.1,
        "surface": None,
    },
}
GRID_M = np.linspace(0.0, 12.0, 13)


def particles(rods: list[tuple[float, float, float]]) -> tuple[Array, Array]:
    """Return the stations and masses of a Gauss quadrature of rods, exact for cubic shapes times lever arms."""
    node, weight = np.polynomial.legendre.leggauss(6)
    x, m = [], []
    for front, rear, kg in rods:
        edges = np.unique(np.concatenate([[front, rear], [g for g in (*GRID_M, *STATIONS_M) if front < g < rear]]))
        for a, b in pairwise(edges):
            x.append(0.5 * (a + b) + 0.5 * (b - a) * node)
            m.append(kg * (b - a) / (rear - front) * 0.5 * weight)
    return np.concatenate(x), np.concatenate(m)


def composed(points: list[tuple[float, Array]], extra_kgm2: float) -> tuple[float, Array, Array]:
    """Return the mass, CG (B) and inertia about it of points (kg, place), plus an isotropic inertia."""
    mass = sum(m for m, _ in points)
    cg = sum(m * r for m, r in points) / mass
    turned = sum(m * ((r - cg) @ (r - cg) * np.eye(3) - np.outer(r - cg, r - cg)) for m, r in points)
    return mass, cg, turned + extra_kgm2 * np.eye(3)


def section(points: list[tuple[float, Array]], extra_kgm2: float = 0.0, axis: tuple[float, float] = (0.0, 0.0)) -> Tree:
    mass, cg, inertia = composed(points, extra_kgm2)
    inertia = inertia + np.diag([1e-7, 0.0, 0.0])  # a rod without width has none
    return {
        "mass_kg": mass,
        "x_cg_m": -cg[0],
        "y_cg_m": cg[1] - axis[0],
        "z_cg_m": cg[2] - axis[1],
        "inertia_kgm2": inertia,
    }


def in_tank(side: Tree) -> tuple[float, float]:
    """Return y and z of the axis of a booster's tank."""
    return side["at"][0] + TANK_AT[0], side["at"][1] + TANK_AT[1]


def dry_points(side: Tree, shift: tuple[float, float]) -> list[tuple[float, Array]]:
    """Return the rods of a booster, displaced from its axis by `shift`, and its engine at rest."""
    x, m = particles(side["rods"])
    y, z = side["at"]
    points = [(mass, np.array([-at, y + shift[0], z + shift[1]])) for at, mass in zip(x, m, strict=True)]
    kg, arm, _ = side["engine"]
    return points + ([(kg, np.array([-(side["gimbal"] + arm), y, z]))] if kg else [])


def booster(name: str, shift: tuple[float, float]) -> Tree:
    side, (kg, arm, inertia), points = SIDES[name], SIDES[name]["engine"], dry_points(SIDES[name], shift)
    out: Tree = {"name": name, "position_m": side["at"], "attachments_m": side["held"]}
    out["engine"] = {
        "table": [{"time_s": 0.0, "thrust_vacuum_N": THRUST_N[name]}],
        "gimbal_station_m": side["gimbal"],
        "exit_station_m": side["gimbal"] + 1.0,
        "misalignment_deg": [0.7, -0.4],
    }
    if kg:
        out["engine"] |= {
            "gimballed_mass_kg": kg,
            "cg_from_gimbal_m": arm,
            "inertia_about_gimbal_kgm2": inertia + kg * arm * arm,
        }
    else:
        out["engine"] |= {"gimbal": "fixed"}
    if side["bob"] is not None:
        bob_kg, length, hinge = side["bob"]
        points = [*points, (bob_kg, np.array([-(hinge + length), *in_tank(side)]))]
        row = {"time_s": 0.0, "slosh_mass_kg": bob_kg, "pendulum_length_m": length, "hinge_station_m": hinge}
        out["tank"] = [{"table": [row], "damping_ratio": 0.03, "position_m": TANK_AT}]
    out["mass"] = section(points, inertia, side["at"])
    aero: Tree = {"mach": [0.0], "CA": [side["CA"]]}
    if side["surface"] is not None:
        aero |= {"CN_alpha_pr": [side["surface"][0]], "station_m": [side["surface"][1]]}
    out["aero"] = {"table": aero}
    return out


def shapes() -> tuple[CubicHermiteSpline, ...]:
    """Return two shapes without momentum and angular momentum of core and boosters under all masses but the bob."""
    rows = []
    for k in range(2):
        phi = np.cos((k + 2) * np.pi * GRID_M / 12.0) * (1.0 + 0.02 * GRID_M)
        raw = CubicHermiteSpline(GRID_M, phi, np.gradient(phi, GRID_M))
        moved = np.zeros(2)
        weight = np.zeros((2, 2))
        x, m = particles(CORE_RODS)
        parts = [(x, m, raw(x), 0.0, 0.0)]
        for side in SIDES.values():
            held, slope = motion_of(side, raw)
            x, m = particles(side["rods"])
            kg, arm, inertia = side["engine"]
            x, m = np.append(x, side["gimbal"] + arm), np.append(m, kg)
            parts.append((x, m, held + (x - side["held"][0]) * slope, inertia, slope))
        for x, m, value, inertia, slope in parts:
            moved += [m @ value, m @ (x * value) + inertia * slope]
            weight += [[m.sum(), m @ x], [m @ x, m @ x**2 + inertia]]
        c_0, c_1 = np.linalg.solve(weight, moved)
        rows.append(CubicHermiteSpline(GRID_M, phi - c_0 - c_1 * GRID_M, np.gradient(phi, GRID_M) - c_1))
    return tuple(rows)


def motion_of(side: Tree, shape: CubicHermiteSpline) -> tuple[float, float]:
    """Return the shape at a booster's first attachment, and its slope."""
    first, last = side["held"][0], side["held"][-1]
    held = float(shape(first))
    return held, float(shape(first, 1)) if first == last else (float(shape(last)) - held) / (last - first)


def launcher(shift: tuple[float, float], bent: bool) -> Tree:
    x, m = particles(CORE_RODS)
    core = [(mass, np.array([-at, *CORE_AT])) for at, mass in zip(x, m, strict=True)]
    line = [{"front_station_m": a, "rear_station_m": b, "mass_kg": kg} for a, b, kg in CORE_RODS]
    surfaces = [
        {"name": str(k), "table": {"mach": [0.0], "CN_alpha_pr": [slope], "station_m": [at]}}
        for k, (slope, at) in enumerate(SURFACES)
    ]
    stage: Tree = {
        "mass": section(core),
        "engine": {
            "table": [{"time_s": 0.0, "thrust_vacuum_N": THRUST_N["core"]}],
            "gimbal_station_m": 12.0,
            "exit_station_m": 13.0,
            "gimbal": "fixed",
            "misalignment_deg": [0.5, 0.3],
        },
        "actuator": dict(ACTUATOR),
        "aero": {"table": {"mach": [0.0], "CA": [CORE_CA]}, "surface": surfaces},
        "booster": [booster(name, shift) for name in SIDES],
        "loads": {
            "stations_m": STATIONS_M,
            "line_mass": line,
            "axial_force": {"station_m": [1.0, 9.0], "share": [0.7, 0.3]},
        },
    }
    if bent:
        stage["bending"] = {"damping_ratio": [0.01, 0.01]}
        for name, hz in (("pitch", 3.0), ("yaw", 3.3)):
            stage["bending"][name] = [
                {
                    "time_s": 0.0,
                    "mode": k + 1,
                    "frequency_hz": hz + 4.0 * k,
                    "generalized_mass_kg": 1500.0,
                    "station_m": at,
                    "phi": float(shape(at)),
                    "slope_pm": float(shape(at, 1)),
                    "mass_forward_kg": 0.0,
                }
                for k, shape in enumerate(shapes())
                for at in GRID_M
            ]
    sections = {
        "switches": {"section_loads": True, "actuator": "full", "local_incidence": False},
        "atmosphere": {"model": "constant", "density_kgpm3": 1.2, "pressure_Pa": 0.0},
        "initial": {"euler_deg": [0.0, 0.0, 0.0], "ned_mps": [120.0, 15.0, -10.0]},
        "vehicle": {
            "name": "sum",
            "reference": {"length_m": 12.0, "diameter_m": 1.0, "area_m2": 0.8},
            "stage": [stage],
        },
    }
    return merged({"schema": 1} | EMPTY_SPACE, sections)


def axis_motion(angles: Array, turned: tuple[float, float]) -> tuple[Array, Array, Array]:
    """Return the thrust axis of a deflected engine with its derivatives, from its definition."""
    t = sympy.Symbol("t")
    (a, b, c), (d, e, f) = angles.tolist()
    p, y = a + turned[0] + b * t + c * t**2 / 2, d + turned[1] + e * t + f * t**2 / 2
    axis = sympy.Matrix([sympy.cos(p) * sympy.cos(y), -sympy.sin(y), sympy.sin(p) * sympy.cos(y)])
    return tuple(np.array(axis.diff(t, n).subs(t, 0), float).ravel() for n in range(3))  # type: ignore[return-value]


class Whole:
    """The motion of the vehicle at an instant."""

    def __init__(self, made: Any, now: Any, y: Array, shift: tuple[float, float], bent: bool) -> None:
        x, m = particles(CORE_RODS)
        points = [(mass, np.array([-at, *CORE_AT])) for at, mass in zip(x, m, strict=True)]
        for side in SIDES.values():
            points += dry_points(side, shift)
        self.cg = composed(points, 0.0)[1]
        self.accel, self.alpha = np.array(now.aux.specific_force_B_mps2), np.array(now.aux.alpha_BI_B_radps2)
        self.rate = y[layout.W_BI_B : layout.W_BI_B + 3].copy()
        self.shapes = shapes() if bent else ()
        p, n = self.rate[0], 2 if bent else 0
        i, j = int(layout.eta_index(made.sizes)), int(layout.xi_index(made.sizes))
        self.eta, self.xi = y[i : i + n], y[j : j + n]
        etadot, xidot = y[i + n : i + 2 * n] - p * self.xi, y[j + n : j + 2 * n] + p * self.eta
        turning = self.alpha[0]
        eta_2 = now.rate[i + n : i + 2 * n] - turning * self.xi - p * xidot
        xi_2 = now.rate[j + n : j + 2 * n] + turning * self.eta + p * etadot
        # accelerations along z and y of a particle that a mode displaces, in axes that roll
        self.z_2 = eta_2 - p * p * self.eta + turning * self.xi + 2.0 * p * xidot
        self.y_2 = xi_2 - p * p * self.xi - turning * self.eta - 2.0 * p * etadot

    def bend(self, value: Any) -> tuple[Array, Array]:
        """Return the displacement and acceleration in B due to the modes, for the shapes `value(shape)` of a point."""
        phi = np.array([value(shape) for shape in self.shapes])
        if len(phi) == 0:
            return np.zeros(3), np.zeros(3)
        return np.array([0.0, self.xi @ phi, self.eta @ phi]), np.array([0.0, self.y_2 @ phi, self.z_2 @ phi])

    def rigid(self, place: Array) -> Array:
        r = place - self.cg
        return np.asarray(self.accel + np.cross(self.alpha, r) + np.cross(self.rate, np.cross(self.rate, r)))


def loads_on(side: Tree, name: str, w: Whole, now: Any, y: Array, made: Any, shift: tuple[float, float]) -> Any:
    """Return the force of a booster on the core, and its moment about the displaced first attachment."""
    forces: list[tuple[Array, Array]] = []  # place and force
    couple = np.zeros(3)
    first = side["held"][0]

    def here(station: float) -> Any:
        return lambda shape: motion_of(side, shape)[0] + (station - first) * motion_of(side, shape)[1]

    kg, arm, inertia = side["engine"]
    points = dry_points(side, shift)
    for mass, place in points[: len(points) - bool(kg)]:
        moved, accel = w.bend(here(-place[0]))
        forces.append((place + moved, -mass * (w.rigid(place) + accel)))
    gimbal = np.array([-side["gimbal"], *side["at"]])
    moved, _ = w.bend(here(side["gimbal"]))
    slope_y, slope_z = w.bend(lambda shape: motion_of(side, shape)[1])[0][1:]
    turned = np.radians([0.7, -0.4])
    angles = gimbal_motions(now.aux.engines.channel[:2]) if kg else np.zeros((2, 3))
    d, d_1, d_2 = axis_motion(angles, tuple(turned))
    along = d + np.cross([0.0, slope_z, -slope_y], d)
    forces.append((gimbal + moved, THRUST_N[name] * along))
    if kg:
        at = gimbal - arm * d
        moved, accel = w.bend(here(side["gimbal"] + arm))
        swung = -arm * (d_2 + 2.0 * np.cross(w.rate, d_1))
        forces.append((at + moved, -kg * (w.rigid(at) + swung)))
        forces.append((points[-1][1], -kg * accel))  # the model has no product of deflection and modal acceleration
        spin, spin_1 = np.cross(d, d_1), np.cross(d, d_2)
        couple -= inertia * (w.alpha + spin_1 + np.cross(w.rate, spin))
        slope_accel = w.bend(lambda shape: motion_of(side, shape)[1])[1]
        couple -= inertia * np.array([0.0, slope_accel[2], -slope_accel[1]])
    if side["bob"] is not None:
        mass, length, hinge = side["bob"]
        k = int(layout.pendulum_index(made.sizes, 0))
        u, kappa, kappa_1 = y[k : k + 3], y[k + 3 : k + 6], now.rate[k + 3 : k + 6]
        at, (moved, accel) = np.array([-hinge, *in_tank(side)]), w.bend(here(hinge))
        hung = w.rigid(at) + accel + np.cross(w.alpha, moved) * np.array([1.0, 0.0, 0.0])
        bob = hung + length * (kappa_1 + np.cross(w.rate, kappa))
        forces.append((at + moved + length * u, -mass * bob))
    speed = np.array([120.0, 15.0, -10.0])
    forces.append((np.array([-first, *side["at"]]), np.array([-HALF * side["CA"] * speed[0] ** 2, 0.0, 0.0])))
    if len(w.eta):  # the axial force acts on the displaced axis at the first attachment
        forces[-1] = (forces[-1][0] + w.bend(here(first))[0], forces[-1][1])
    if side["surface"] is not None:
        slope, at_m = side["surface"]
        normal = -HALF * slope * speed[0] * speed
        forces.append((np.array([-at_m, *side["at"]]), np.array([0.0, normal[1], normal[2]])))
    held = np.array([-first, 0.0, 0.0]) + w.bend(here(first))[0]
    return held, sum(f for _, f in forces), couple + sum(np.cross(r - held, f) for r, f in forces)


def expected(w: Whole, now: Any, y: Array, made: Any, shift: tuple[float, float]) -> Array:
    """Return the loads at all stations (stations, 5) from every particle of the core and the joints of the boosters."""
    x, m = particles(CORE_RODS)
    forces: list[tuple[float, Array, Array]] = []  # station, place and force
    for at, mass in zip(x, m, strict=True):
        place = np.array([-at, *CORE_AT])
        moved, accel = w.bend(lambda shape, at=at: float(shape(at)))
        forces.append((at, place + moved, -mass * (w.rigid(place) + accel)))
    speed = np.array([120.0, 15.0, -10.0])
    for slope, at in SURFACES:
        normal = -HALF * slope * speed[0] * speed
        forces.append((at, np.array([-at, 0.0, 0.0]), np.array([0.0, normal[1], normal[2]])))
    for at, share in ((1.0, 0.7), (9.0, 0.3)):
        forces.append((at, np.array([-at, 0.0, 0.0]), np.array([-share * HALF * CORE_CA * speed[0] ** 2, 0.0, 0.0])))
    couples: list[tuple[float, Array]] = []
    for name, side in SIDES.items():
        held, force, moment = loads_on(side, name, w, now, y, made, shift)
        first, last = side["held"][0], side["held"][-1]
        if first == last:
            couples.append((first, moment))
            forces.append((first, held, force))
            continue
        other = np.array([0.0, -moment[2] / (last - first), moment[1] / (last - first)])
        forces += [(first, held, force - other), (last, np.array([-last, 0.0, 0.0]), other)]
    rows = []
    for station in STATIONS_M:
        cut = np.array([-station, 0.0, 0.0]) + w.bend(lambda shape, s=station: float(shape(s)))[0]
        total, turning = np.zeros(3), np.zeros(3)
        for at, place, force in forces:
            if at <= station:
                total += force
                turning += np.cross(place - cut, force)
        turning += sum((c for at, c in couples if at <= station), np.zeros(3))
        rows.append([*total, *turning[1:]])
    return np.array(rows)


@pytest.mark.parametrize("bent", [False, True])
def test_loads_are_the_sum_of_forces_on_every_part(bent: bool) -> None:
    """Without modes, loads agree at any rates; with modes, at a roll rate, as displacement terms with q and r are
    omitted.

    A booster's inertia in the modes is the mean of both planes, so that its rods are on its axis with modes. Both
    planes have the same shapes, because the quasi-velocities in roll neglect their difference.
    """
    shift = (0.0, 0.0) if bent else (0.02, -0.01)
    made = rig(launcher(shift, bent))
    y, rng = made.packed.state, np.random.default_rng(5)
    y[layout.W_BI_B : layout.W_BI_B + 3] = (0.4, 0.0, 0.0) if bent else (0.3, -0.2, 0.25)
    y[layout.ACTUATOR : layout.ACTUATOR + 12] = engine_states(
        made, np.array([0.09, -0.06]), np.array([0.5, 0.4]), np.array([20.0, -15.0])
    )
    k = int(layout.pendulum_index(made.sizes, 0))
    u = np.array([-1.0, 0.25, -0.3])
    u /= np.linalg.norm(u)
    kappa = rng.normal(0.0, 1.0, 3)
    y[k : k + 3], y[k + 3 : k + 6] = u, kappa - (kappa @ u) * u
    if bent:
        for first in (int(layout.eta_index(made.sizes)), int(layout.xi_index(made.sizes))):
            y[first : first + 4] = rng.normal(0.0, [0.02, 0.01, 0.4, 0.3])
    now = evaluate_at(made.packed, y, 0.0)
    found = expected(Whole(made, now, y, shift, bent), now, y, made, shift)
    largest = np.abs(found).max(axis=0)
    assert (largest > 1e3).all()
    print(np.abs(now.sections - found).max(axis=0) / largest)
    np.testing.assert_allclose(now.sections / largest, found / largest, rtol=0.0, atol=1e-9)


def test_loads_follow_ignition_burnout_and_separation() -> None:
    """In straight flight, all thrusts carry the vehicle forward of 9 m, and the core's thrust alone that behind 9 m.

    A pair burns from 0 to 12 s, the other from 3 to 15 s, and all leave at 16.5 s; the core's liquid rests on 6 m.
    """
    line = [{"front_station_m": 0.0, "rear_station_m": 12.0, "mass_kg": 1600.0}]
    liquid = {"time_s": [0.0, 60.0], "mass_kg": [2400.0, 0.0], "front_station_m": [4.0, 4.0]}
    loads = {
        "stations_m": [7.0, 10.5],
        "line_mass": line,
        "liquid": [{"table": liquid, "bottom_station_m": 6.0}],
        "tolerance": 0.3,
        "coast": True,
    }
    pairs = [*PAIR, solid("upper", (-1.2, 0.0), 3.0), solid("lower", (1.2, 0.0), 3.0)]
    stages = core({"separation_after_burnout_s": 1.5}, pairs, loads=loads), core(AFTER, [], loads=loads)
    more = {"switches": {"section_loads": True}, "run": {"duration_s": 20.0, "step_s": 0.01}}
    flight = fly(load(booster_launcher(*stages, **more)))
    t = flight.time_s("section_1_axial_N")
    for at, thrust_N, booster_kg in (
        (1.0, 350e3, 3900.0),
        (5.0, 590e3, 3300.0),
        (13.0, 350e3, 1800.0),
        (16.0, 110e3, 1600.0),
        (18.0, 110e3, 0.0),
    ):
        k, core_kg = int(np.argmin(np.abs(t - at))), 4000.0 - 40.0 * at
        accel = thrust_N / (core_kg + booster_kg)
        forward_kg = core_kg - 1600.0 * 5.0 / 12.0
        assert t[k] == pytest.approx(at, abs=1e-9)
        assert flight["section_1_axial_N"][k] == pytest.approx(-forward_kg * accel, rel=1e-9)
        assert flight["section_2_axial_N"][k] == pytest.approx(1600.0 * 1.5 / 12.0 * accel - 110e3, rel=1e-9)
    assert flight.metrics["max_section_mass_mismatch"] < 0.06


def test_outflow_of_turning_boosters_leaves_the_ends_free() -> None:
    """At the gimbal, the core carries only the thrust of its engine; the flow has Coriolis forces elsewhere."""
    line = [{"front_station_m": 1.0, "rear_station_m": 11.0, "mass_kg": 1600.0}]  # its CG is that of the core
    table = {"time_s": [0.0, 60.0], "mass_kg": [2400.0, 0.0], "front_station_m": [4.0, 4.0]}
    liquid = [{"table": table, "bottom_station_m": 8.0}]
    loads = {"stations_m": [5.0, 11.0], "line_mass": line, "liquid": liquid, "tolerance": 0.5}
    tree = booster_launcher(core({}, [PAIR[0], solid("other", (0.7, 0.9))], loads=loads))
    made = rig(merged(tree, {"switches": {"section_loads": True}}))
    y = made.packed.state
    y[layout.W_BI_B : layout.W_BI_B + 3] = (0.3, -0.2, 0.25)
    now = evaluate_at(made.packed, y, 0.0)
    assert now.sections[1] == pytest.approx([-110e3, 0.0, 0.0, 0.0, 0.0], abs=1e-6)
    assert np.abs(now.sections[0, 3:]).min() > 100.0
    made.vehicle.jet_damping = 0
    without = evaluate_at(made.packed, y, 0.0)
    assert np.abs(now.sections[0] - without.sections[0]).max() > 10.0  # there is something to balance


Motion = Callable[[float], tuple[float, float, float]]  # displacement along y and z, and rotation about x, at a station


def on_booster(side: Tree, motion: Motion) -> tuple[Array, Array]:
    """Return the displacement of a booster's first attachment, and its rotation by both and by the core's twist."""
    first, last = side["held"][0], side["held"][-1]
    (y, z, twist), (y_2, z_2, _) = motion(first), motion(last)
    lean_y, lean_z = (y_2 - y) / (last - first), (z_2 - z) / (last - first)
    return np.array([0.0, y, z]), np.array([twist, lean_z, -lean_y])


def momenta(motion: Motion) -> Array:
    """Return momentum along y and z and angular momentum about z and y of core and boosters in a motion."""
    total = np.zeros(4)
    x, m = particles(CORE_RODS)
    moved = [(mass, at, *motion(at)[:2], 0.0, 0.0, 0.0) for at, mass in zip(x, m, strict=True)]
    for side in SIDES.values():
        held, turned = on_booster(side, motion)
        for mass, place in dry_points(side, (0.0, 0.0)):
            d = held + np.cross(turned, place - np.array([-side["held"][0], 0.0, 0.0]))
            moved.append((mass, -place[0], d[1], d[2], d[0], *side["at"]))
    for mass, at, y, z, along, off_y, off_z in moved:
        total += mass * np.array([y, z, at * y + off_y * along, at * z + off_z * along])
    return total


def free_motions() -> list[tuple[Motion, Array]]:
    """Return three motions without momentum and angular momentum, and their rows (phi, theta) at the grid."""
    units: list[Motion] = [
        lambda at: (1.0, 0.0, 0.0),
        lambda at: (0.0, 1.0, 0.0),
        lambda at: (at, 0.0, 0.0),
        lambda at: (0.0, at, 0.0),
    ]
    matrix, rng, out = np.stack([momenta(unit) for unit in units], axis=1), np.random.default_rng(12), []
    for _ in range(3):
        a, b = (np.polynomial.Polynomial(np.append(0.0, c) / 6.0 ** np.arange(4)) for c in rng.normal(size=(2, 3)))
        twist = 0.2 * rng.normal()
        rigid = np.linalg.solve(matrix, momenta(lambda at, a=a, b=b, t=twist: (a(at), b(at), t)))  # type: ignore[misc]
        y, z = a - np.polynomial.Polynomial(rigid[[0, 2]]), b - np.polynomial.Polynomial(rigid[[1, 3]])
        rows = [[0.0, y(at), z(at), twist, z.deriv()(at), -y.deriv()(at)] for at in GRID_M]
        out.append((lambda at, y=y, z=z, t=twist: (y(at), z(at), t), np.array(rows)))  # type: ignore[misc]
    return out


def test_loads_of_boosters_on_spatial_modes_are_sums_of_forces(monkeypatch: pytest.MonkeyPatch) -> None:
    """A pair of boosters that two stations hold; modes bend both planes and twist, and move the boosters' CG along x.

    The vehicle rolls. Mean motions along x are zero by symmetry; a CG off the axis would need one of the core.
    """
    alike = SIDES["right"] | {"held": [10.0, 4.0], "CA": 0.0}
    for name, sign in (("left", -1.0), ("right", 1.0)):
        monkeypatch.setitem(SIDES, name, alike | {"at": (0.9 * sign, -0.6 * sign)})
    motions = free_motions()
    tree = merged(launcher((0.0, 0.0), False), {"atmosphere": {"model": "vacuum"}})
    del tree["atmosphere"]["density_kgpm3"], tree["atmosphere"]["pressure_Pa"]
    del tree["vehicle"]["stage"][0]["actuator"], tree["switches"]["actuator"]
    modes = [(2.0 + k, 1500.0, 0.0, rows) for k, (_, rows) in enumerate(motions)]
    tree["vehicle"]["stage"][0]["spatial_modes"] = spatial_section(GRID_M, np.zeros(len(GRID_M)), modes)
    made, rng = rig(tree), np.random.default_rng(3)
    y, first = made.packed.state, int(layout.spatial_index(made.sizes))
    (eta, nu), p = rng.normal(0.0, [[0.01], [0.2]], (2, 3)), 0.4
    y[layout.W_BI_B : layout.W_BI_B + 3], y[first : first + 3], y[first + 3 : first + 6] = (p, 0.0, 0.0), eta, nu
    now = evaluate_at(made.packed, y, 0.0)
    made.derivative(y[: made.n])
    columns = [int(schedule.spatial_column(made.sizes, schedule.turning_row(made.sizes, j))) for j in range(3)]
    turning = np.stack([made.props[c : c + 3] for c in columns], axis=1)
    turns = float(now.aux.alpha_BI_B_radps2[0])
    eta_1 = nu - p * turning @ eta
    eta_2 = now.rate[first + 3 : first + 6] - turns * turning @ eta - p * turning @ eta_1

    def bent(at: float, q: Array) -> Array:
        return sum(amount * np.array(motion(at)) for amount, (motion, _) in zip(q, motions, strict=True))

    w = Whole(made, now, y, (0.0, 0.0), False)
    x, m = particles(CORE_RODS)
    forces: list[tuple[float, Array, Array]] = []

    def felt(d: Array, d_1: Array, d_2: Array) -> Array:
        """Return the acceleration of a point by its displacement in axes that roll."""
        across = np.cross([1.0, 0.0, 0.0], turns * d + 2.0 * p * d_1)
        return np.asarray(d_2 + across - p * p * d * np.array([0.0, 1.0, 1.0]))

    for at, mass in zip(x, m, strict=True):
        place, moved = np.array([-at, *CORE_AT]), [np.array([0.0, *bent(at, q)[:2]]) for q in (eta, eta_1, eta_2)]
        forces.append((at, place + moved[0], -mass * (w.rigid(place) + felt(*moved))))
    for name, side in SIDES.items():
        at_1, at_2 = side["held"]
        motion = [on_booster(side, lambda at, q=q: tuple(bent(at, q))) for q in (eta, eta_1, eta_2)]  # type: ignore[misc]
        held, turned = motion[0]
        anchor, sideways = np.array([-at_1, 0.0, 0.0]), np.array([0.0, 1.0, 1.0])
        joint, total, moment = anchor + held, np.zeros(3), np.zeros(3)
        loads = []
        for mass, place in dry_points(side, (0.0, 0.0)):
            moved = [shift + np.cross(turn, place - anchor) for shift, turn in motion]
            loads.append((place, -mass * (w.rigid(place) + felt(*moved))))
        direction = axis_motion(np.zeros((2, 3)), tuple(np.radians([0.7, -0.4])))[0]
        push = THRUST_N[name] * (direction + np.cross(turned, direction))
        loads.append((np.array([-side["gimbal"], *side["at"]]), push))
        for place, force in loads:
            there = place + (held + np.cross(turned, place - anchor)) * sideways
            total, moment = total + force, moment + np.cross(there - joint, force)
        other = np.array([0.0, -moment[2] / (at_2 - at_1), moment[1] / (at_2 - at_1)])
        forces += [(at_1, joint, total - other), (at_2, np.array([-at_2, 0.0, 0.0]), other)]
    rows = []
    for station in STATIONS_M:
        cut = np.array([-station, *bent(station, eta)[:2]])
        ahead = [(place, force) for at, place, force in forces if at <= station]
        turning_by = sum((np.cross(place - cut, force) for place, force in ahead), np.zeros(3))
        rows.append([*sum((force for _, force in ahead), np.zeros(3)), *turning_by[1:]])
    largest = np.abs(rows).max(axis=0)
    assert (largest > 1e3).all()
    np.testing.assert_allclose(now.sections / largest, np.array(rows) / largest, rtol=0.0, atol=1e-9)
