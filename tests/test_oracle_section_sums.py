"""Section loads of a vehicle that bends, sloshes, turns and flies in wind equal sums of forces forward of each cut.

The loads, their places and signs are those of docs/model.md, section 13. Integrals over the core are Gauss sums of
point masses. The vehicle's accelerations are the simulator's, which other tests compare with Lagrange's equations.
"""

from __future__ import annotations

import itertools

import numpy as np
from flightkit import Mode, Parts, Rig, Tank, Tree, rig, scenario_of, with_stage

from maxq.control.kernel.records import Array
from maxq.sim.run.evaluate import Instant, evaluate_at
from maxq.sim.vehicle import state as layout
from maxq.sim.vehicle.loads.columns import AXIAL, MOMENT_Y, MOMENT_Z, SHEAR_Y, SHEAR_Z

GIMBAL_M, ENGINE_KG, ENGINE_M = 12.0, 250.0, 12.6
RODS = ((0.5, 6.0, 900.0), (6.0, 12.0, 1400.0))  # front and rear station, kg
COLUMNS = ((2.0, 4.2, 700.0), (7.5, 10.5, 1300.0))  # liquid: surface, bottom, kg
BOBS = (Tank(260.0, 0.6, 2.3, 0.02), Tank(420.0, 0.8, 7.9, 0.03))
CUTS_M = (1.0, 3.0, 4.2, 5.0, 8.2, 10.0, 11.5)
ROLL_KGM2 = 900.0
AREA_M2, CHORD_M, DENSITY = 0.8, 1.3, 1.2
SURFACES = ((1.5, 3.0), (5.0, 11.0))  # slope, station
CA, CROSSFLOW, CROSSFLOW_M, CMQ = 0.6, 8.0, 6.5, -300.0
AXIAL_PLACES = ((0.5, 0.8), (9.0, 0.2))  # station, share
PUSH_N, TWIST_NM = 700.0, 900.0
FLOW_MPS = np.array([120.0, 15.0, -10.0])
SHAPE = np.polynomial.Polynomial([1.0, -0.42, 0.031, -0.0004])  # a cubic is its own Hermite interpolant


def core_points() -> tuple[Array, Array, Array]:
    """Return stations and masses of points that represent the core, and the column of each; -1: structure."""
    nodes, weights = np.polynomial.legendre.leggauss(3)
    x, kg, column = [np.array([ENGINE_M])], [np.array([ENGINE_KG])], [np.array([-1])]

    def add(front: float, rear: float, which: int, mean: float, slope: float = 0.0) -> None:
        """Add points of a density `mean` + `slope` (x - middle), split at every section."""
        ends = [front, *(cut for cut in CUTS_M if front < cut < rear), rear]
        for a, b in itertools.pairwise(ends):
            at = 0.5 * (a + b) + 0.5 * (b - a) * nodes
            x.append(at)
            kg.append(0.5 * (b - a) * weights * (mean + slope * (at - 0.5 * (front + rear))))
            column.append(np.full(at.shape, which))

    for front, rear, mass in RODS:
        add(front, rear, -1, mass / (rear - front))
    for k, ((front, rear, mass), bob) in enumerate(zip(COLUMNS, BOBS, strict=True)):
        length = rear - front
        arm = bob.hinge_station_m + bob.length_m - 0.5 * (front + rear)
        add(front, rear, k, (mass - bob.mass_kg) / length, -12.0 * bob.mass_kg * arm / length**3)
    return np.concatenate(x), np.concatenate(kg), np.concatenate(column)


X, KG, COLUMN = core_points()
CORE_KG, CG_M = float(KG.sum()), float(KG @ X / KG.sum())


def vehicle() -> Tree:
    inertia = float(KG @ (X - CG_M) ** 2)
    stations = tuple(np.linspace(0.0, 13.0, 14))
    mode = Mode(4.0, 500.0, tuple(SHAPE(np.array(stations))), tuple(SHAPE.deriv()(np.array(stations))), 0.01)
    parts = Parts(
        core_mass_kg=CORE_KG,
        core_cg=(CG_M, 0.0, 0.0),
        core_inertia=((ROLL_KGM2, 0.0, 0.0), (0.0, inertia, 0.0), (0.0, 0.0, inertia)),
        tanks=BOBS,
        stations_m=stations,
        mass_forward_kg=tuple(np.linspace(0.0, CORE_KG, 14)),
        pitch=(mode,),
        yaw=(mode,),
        gimbal_station_m=GIMBAL_M,
        engine_mass_kg=ENGINE_KG,
        engine_cg_m=ENGINE_M - GIMBAL_M,
        thrust_N=1.1e5,
    )
    aero = {
        "table": {"mach": [0.0], "CA": [CA], "C_crossflow": [CROSSFLOW], "Cmq": [CMQ], "Cnr": [CMQ]},
        "crossflow_station_m": CROSSFLOW_M,
        "surface": [{"table": {"mach": [0.0], "CN_alpha_pr": [n], "station_m": [x]}} for n, x in SURFACES],
    }
    loads = {
        "stations_m": [*CUTS_M, GIMBAL_M],
        "line_mass": [{"front_station_m": a, "rear_station_m": b, "mass_kg": kg} for a, b, kg in RODS]
        + [{"front_station_m": ENGINE_M, "rear_station_m": ENGINE_M, "mass_kg": ENGINE_KG}],
        "liquid": [
            {
                "tank": str(k + 1),
                "bottom_station_m": rear,
                "table": {"time_s": [0.0], "mass_kg": [kg], "front_station_m": [front]},
            }
            for k, (front, rear, kg) in enumerate(COLUMNS)
        ],
        "axial_force": {"station_m": [x for x, _ in AXIAL_PLACES], "share": [s for _, s in AXIAL_PLACES]},
    }
    tree = scenario_of(
        parts,
        vehicle={"reference": {"chord_m": CHORD_M, "yaw_chord_m": CHORD_M, "area_m2": AREA_M2}},
        switches={"section_loads": True},
        atmosphere={"model": "constant", "density_kgpm3": DENSITY},
        initial={"ned_mps": list(FLOW_MPS), "euler_deg": [0.0, 0.0, 0.0]},
    )
    injected = [
        {"at": "body_force", "axis": "z", "kind": "step", "amplitude_N": PUSH_N},
        {"at": "body_torque", "axis": "y", "kind": "step", "amplitude_Nm": TWIST_NM},
    ]
    return with_stage(tree | {"injection": injected}, aero=aero, loads=loads)


class Sum:
    """The axial force, shear and moments at the cuts, summed over forces at a station and lateral place."""

    def __init__(self, bend_m: Array) -> None:
        self.cuts, self.bend_m = np.array(CUTS_M), bend_m  # (2,): modal displacement of y and z per unit of shape
        self.total = np.zeros((len(CUTS_M), 5))

    def across(self, station: float) -> Array:
        return np.asarray(SHAPE(station) * self.bend_m)

    def force(self, f: Array, station: float, place_m: Array | None = None) -> None:
        """Add a force at a station of the bent axis, or at a place (y, z) off the straight one."""
        place = self.across(station) if place_m is None else place_m
        behind = self.cuts >= station
        arm = self.cuts - station
        y, z = (place[:, None] - self.bend_m[:, None] * SHAPE(self.cuts)) * behind
        self.total[:, AXIAL] += behind * f[0]
        self.total[:, SHEAR_Y] += behind * f[1]
        self.total[:, SHEAR_Z] += behind * f[2]
        self.total[:, MOMENT_Y] += z * f[0] - behind * arm * f[2]
        self.total[:, MOMENT_Z] += behind * arm * f[1] - y * f[0]

    def couple(self, moment: Array, station: float) -> None:
        self.total[:, MOMENT_Y] += (self.cuts >= station) * moment[1]
        self.total[:, MOMENT_Z] += (self.cuts >= station) * moment[2]


def stirred() -> tuple[Array, Instant, Rig]:
    made = rig(vehicle())
    y, rng = made.packed.state, np.random.default_rng(5)
    y[layout.W_BI_B : layout.W_BI_B + 3] = (0.3, -0.2, 0.25)
    i, j = int(layout.eta_index(made.sizes)), int(layout.xi_index(made.sizes))
    y[i], y[i + 1], y[j], y[j + 1] = 0.02, 0.3, -0.015, 0.2
    for k in range(len(BOBS)):
        first = int(layout.pendulum_index(made.sizes, k))
        u = np.array([-1.0, *rng.normal(0.0, 0.3, 2)])
        u /= np.linalg.norm(u)
        kappa = rng.normal(0.0, 1.0, 3)
        y[first : first + 3], y[first + 3 : first + 6] = u, kappa - (kappa @ u) * u
    return y, evaluate_at(made.packed, y, 0.0), made


def test_every_section_carries_what_acts_forward_of_it() -> None:
    y, now, made = stirred()
    i, j = int(layout.eta_index(made.sizes)), int(layout.xi_index(made.sizes))
    (eta, nu_eta), (xi, nu_xi) = y[i : i + 2], y[j : j + 2]
    nu_accel = np.array([now.rate[j + 1], now.rate[i + 1]])  # of y and z
    w, accel, alpha = y[layout.W_BI_B : layout.W_BI_B + 3], now.aux.specific_force_B_mps2, now.aux.alpha_BI_B_radps2
    p, q, r = w
    loads = Sum(np.array([xi, eta]))
    # the core: structure where it is, liquid along x at its bottom
    arms = CG_M - X
    basis = np.stack([np.ones_like(X), arms])
    pure = SHAPE(X) - np.linalg.solve(basis @ np.diag(KG) @ basis.T, basis @ (KG * SHAPE(X))) @ basis
    assert abs(KG @ pure) < 1e-9
    assert abs(KG @ (pure * arms)) < 1e-8
    for x, kg, column, arm, phi in zip(X, KG, COLUMN, arms, pure, strict=True):
        along, spun = -kg * accel[0], kg * (q * q + r * r) * arm
        side = -kg * (accel[1] + (alpha[2] + p * q) * arm + phi * (nu_accel[0] - p * nu_eta))
        up = -kg * (accel[2] - (alpha[1] - p * r) * arm + phi * (nu_accel[1] + p * nu_xi))
        loads.force(np.array([0.0, side, up]), x)
        bottom = x if column < 0 else COLUMNS[column][1]
        loads.force(np.array([along, 0.0, 0.0]), bottom, loads.across(x))
        loads.total[loads.cuts >= bottom, AXIAL] += spun  # its moment by the displacement is neglected
        # roll inertia, spread as the mass
        loads.couple(-kg / CORE_KG * ROLL_KGM2 * np.array([0.0, p * r, -p * q]), x)
    # liquid that swings
    half = 0.5 * DENSITY * AREA_M2
    u_mps, v_mps, w_mps = FLOW_MPS
    drag = -half * CA * u_mps * abs(u_mps)
    axial = (1.1e5 + drag) / (CORE_KG + sum(bob.mass_kg for bob in BOBS))
    for k, bob in enumerate(BOBS):
        first = int(layout.pendulum_index(made.sizes, k))
        u, kappa = y[first : first + 3], y[first + 3 : first + 6]
        phi, rho = float(SHAPE(bob.hinge_station_m)), np.array([CG_M - bob.hinge_station_m, 0.0, 0.0])
        d_y, d_z = phi * xi, phi * eta
        b = np.array([q * d_z - r * d_y, phi * nu_xi, phi * nu_eta])
        b_rate = np.array(
            [
                alpha[1] * d_z + q * phi * (nu_eta - p * xi) - alpha[2] * d_y - r * phi * (nu_xi + p * eta),
                *(phi * nu_accel),
            ]
        )
        hinge = accel + np.cross(alpha, rho) + np.cross(w, np.cross(w, rho)) + b_rate + np.cross(w, b)
        tension = bob.mass_kg * (bob.length_m * kappa @ kappa - hinge @ u)
        loads.force(tension * np.array([0.0, u[1], u[2]]), bob.hinge_station_m)
        loads.force(tension * np.array([u[0], 0.0, 0.0]), COLUMNS[k][1], np.array([d_y, d_z]))
        swing = kappa - np.cross(w, u)
        damper = 2.0 * bob.mass_kg * bob.damping_ratio * np.sqrt(axial * bob.length_m) * swing
        loads.force(damper, bob.hinge_station_m - bob.length_m * u[0], np.array([d_y, d_z]) + bob.length_m * u[1:])
    # air
    for slope, x in SURFACES:
        phi, sigma = float(SHAPE(x)), float(SHAPE.deriv()(x))
        flow = np.array([0.0, v_mps + u_mps * sigma * xi + phi * nu_xi, w_mps + u_mps * sigma * eta + phi * nu_eta])
        loads.force(-half * slope * abs(u_mps) * flow, x)
    for x, share in AXIAL_PLACES:
        loads.force(np.array([share * drag, 0.0, 0.0]), x, np.zeros(2))  # on the straight axis, as in section 6
    cross = -half * CROSSFLOW * np.hypot(v_mps, w_mps) * np.array([0.0, v_mps, w_mps])
    damping = 0.5 * half * float(np.linalg.norm(FLOW_MPS)) * CHORD_M**2 * CMQ * np.array([0.0, q, r])
    # linear over the station, with equal force and moment: density f_0 + f_1 (x - middle) from nose to gimbal
    middle, span = 0.5 * GIMBAL_M, GIMBAL_M
    first_moment = np.array([0.0, *((CROSSFLOW_M - middle) * cross[1:] + [-damping[2], damping[1]])])
    nodes, weights = np.polynomial.legendre.leggauss(3)
    ends = [0.0, *CUTS_M]
    for a, c in itertools.pairwise(ends):
        for node, weight in zip(nodes, weights, strict=True):
            x = 0.5 * (a + c) + 0.5 * (c - a) * node
            density = cross / span + 12.0 * first_moment / span**3 * (x - middle)
            loads.force(0.5 * (c - a) * weight * density, x)
    loads.force(np.array([0.0, 0.0, PUSH_N]), CG_M)
    loads.couple(np.array([0.0, TWIST_NM, 0.0]), CG_M)
    wanted = loads.total
    assert np.abs(wanted).min() > 100.0
    np.testing.assert_allclose(now.sections[:-1, : wanted.shape[1]], wanted, rtol=1e-9, atol=1e-6)
