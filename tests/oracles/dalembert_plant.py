"""Derive the vehicle as a linear system by d'Alembert's principle, independently of design/model/jacobian.py.

Body axes at the core's CG, x forward, z down (pitch plane). The vehicle flies along x at speed U with the specific
axial force a = (T - D) / m and does not turn. Small quantities: lateral speed w, rate q, pitch theta, modes eta_i,
pendulum angles G_k (towards +z), engine angle delta. To first order, a particle at x (forward of the core's CG) with
lateral displacement z has the lateral and axial specific accelerations

    f_z = s - x q' + z'',   s = w' - U q + g sin(theta_0) theta,      f_x = a.

The constant g cos(theta_0) accelerates all particles equally and curves the path (gravity turn); it is omitted. Under a
virtual motion dZ, dTheta, d(eta_i), d(G_k) the particle moves dZ - x dTheta + dz laterally and z dTheta + dx along the
axis. dx is of second order: a pendulum rises, an engine swings out, and bending shortens a beam. Sum m (f_z, f_x) .
(displacement) equals the work of the loads, with

    core      z = sum phi_i(x) eta_i, modes free-free: sum m phi = sum m x phi = 0, sum m phi_i phi_j = M_i
              for i = j, else 0; shortening by bending: work  -a K_ij eta_j d(eta_i),  K the softening
              matrix (erratum 4), which the engine hanging behind the gimbal stiffens
    engine    in addition to the core that contains it straight: a point r behind the gimbal moves by -r delta,
              and forward by r (sigma_T eta - delta)^2 / 2, sigma_T the slope there
    bob       x_b = x_h - L,  z = phi_h eta + L G,  and it rises by L G^2 / 2

From this follow the mass matrix `_mass_matrix`, the axial-load terms of `_stiffness`, and for the engine (I_E about the
gimbal, S = m_E l_E, l_C from the core's CG aft to the gimbal, erratum 8)

    lateral  S delta''        rotation  (I_E + S l_C) delta'' + a S delta
    mode i   (S phi_T,i + I_E sigma_T,i) delta'' + a S sigma_T,i delta.

The engine's rate has no effect. Loads: thrust T at the displaced gimbal along the bent axis, with (x, z) components T
(1, delta - sigma_T eta): moment T l_C (delta - sigma_T eta) + T phi_T eta (erratum 4). Each lifting surface: -q S
CN_alpha (w/U + sigma_s eta + phi_s eta' / U) at its station. Rate damping Cmq (7). Drag along the wind: -q S CD w/U.
Gravity does no work on a free-free mode (erratum 3). Modal damping. Mass flow: `_mass_flow`.

Slosh damping is a force between bob and tank with the work -2 zeta w L m_p L G' d(G), so it appears only in the
pendulum's row. In the notation of (24) and (27) it reacts on the vehicle at the bob:

    M_S = - sum m_p [ a l_p G + 2 zeta w L (l_p - L) G' ].

(27) prints the hinge's arm l_p for both terms, a further erratum. The rod's pull acts at the hinge, the liquid's
friction at the bob, l_p - L forward of the CG. Equivalently, the reaction of a torque about the hinge is a couple,
which moves the force's line of action from hinge to bob. The printed pair of damping forces is not on one line, so it
does not conserve angular momentum.
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass

import numpy as np
from oracles.planar.equations import mass_flow_momentum
from oracles.planar.plant import axial_load_mps2
from oracles.planar.vehicle_at import PlanarVehicle

from maxq.control.kernel.records import Array
from maxq.design.model.held import OUTPUTS, FlightCondition, state_names
from maxq.design.model.state_space import StateSpace


@dataclass(frozen=True)
class _Layout:
    """The indices of the coordinates in the second-order system: lateral, rotation, modes, pendulums."""

    modes: int
    tanks: int

    @property
    def size(self) -> int:
        return 2 + self.modes + self.tanks

    @property
    def mode(self) -> slice:
        return slice(2, 2 + self.modes)

    @property
    def pendulum(self) -> slice:
        return slice(2 + self.modes, self.size)


def dalembert_plant(vehicle: PlanarVehicle, condition: FlightCondition) -> StateSpace:
    """Return the plant of `vehicle_plant` with all errata corrected."""
    at = _Layout(len(vehicle.modes.omega_radps), len(vehicle.pendulums.mass_kg))
    load = axial_load_mps2(vehicle, condition)
    if at.tanks > 0 and load <= 0.0:
        raise ValueError(f"a pendulum needs a positive axial load, not {load:g} m/s2")
    mass = _mass_matrix(vehicle, at)
    stiffness = _stiffness(vehicle, condition, load, at)
    damping = _damping(vehicle, condition, load, at)
    engine = _engine_columns(vehicle, condition, load, at)
    empty = vehicle.pendulums.mass_kg == 0.0
    if empty.any():  # such a bob swings and moves nothing: its row per unit of mass, where 0 = 0 would stand
        bobs = dataclasses.replace(vehicle.pendulums, mass_kg=np.ones(at.tanks))
        unit = dataclasses.replace(vehicle, pendulums=bobs)
        rows = 2 + at.modes + np.flatnonzero(empty)
        mass[rows] = _mass_matrix(unit, at)[rows]
        stiffness[rows] = _stiffness(unit, condition, load, at)[rows]
        damping[rows] = _damping(unit, condition, load, at)[rows]
    # unknown of the first row is s, of the others the second derivatives
    per_position = _solve(mass, -stiffness)  # column 0 is zero: nothing depends on a lateral position
    per_rate = _solve(mass, -damping)
    per_engine = _solve(mass, engine)
    return _first_order(per_position, per_rate, per_engine, vehicle, condition, at)


def _solve(matrix: Array, right: Array) -> Array:
    return np.asarray(np.linalg.solve(matrix, right), np.float64)


def _mass_matrix(vehicle: PlanarVehicle, at: _Layout) -> Array:
    """Return the mass matrix of the generalised accelerations s, q', eta'', G'' (symmetric)."""
    body, bobs = vehicle.body, vehicle.pendulums
    mass = np.zeros((at.size, at.size))
    mass[0, 0], mass[1, 1] = body.core_mass_kg, body.core_inertia_kgm2
    mass[at.mode, at.mode] = np.diag(vehicle.modes.generalized_mass_kg)
    for k in range(at.tanks):
        reach = _bob_reach(vehicle, at, k)
        mass += bobs.mass_kg[k] * np.outer(reach, reach)
    return mass


def _stiffness(vehicle: PlanarVehicle, condition: FlightCondition, load: float, at: _Layout) -> Array:
    """Return the restoring force per displacement: elastic, axial load, thrust and angle of attack of the bent body."""
    modes, bobs, engine = vehicle.modes, vehicle.pendulums, vehicle.engine
    k = np.zeros((at.size, at.size))
    k[at.mode, at.mode] += np.diag(modes.generalized_mass_kg * modes.omega_radps**2)
    k[at.mode, at.mode] -= load * modes.softening_kgpm
    # a bob off the axis turns the nose: moment of its axial inertia about the CG
    k[1, at.mode] += load * modes.phi_hinge @ bobs.mass_kg
    k[1, at.pendulum] += load * bobs.mass_kg * bobs.length_m
    k[at.pendulum, at.pendulum] += load * np.diag(bobs.mass_kg * bobs.length_m)
    thrust, arm = engine.thrust_N(condition.pressure_Pa), _gimbal_arm(vehicle)
    tilt = -modes.slope_gimbal_pm if engine.follower else np.zeros(at.modes)
    k[0, at.mode] -= thrust * tilt
    k[1, at.mode] -= thrust * (arm * tilt + modes.phi_gimbal)
    k[at.mode, at.mode] -= thrust * np.outer(modes.phi_gimbal, tilt)
    for force, incidence in _surfaces(vehicle, condition, at):
        k -= np.outer(force, condition.airspeed_mps * incidence[1])
    return k


def _damping(vehicle: PlanarVehicle, condition: FlightCondition, load: float, at: _Layout) -> Array:
    """Return the resisting force per rate; column 0 is that of w."""
    modes, bobs, air = vehicle.modes, vehicle.pendulums, vehicle.aerodynamics
    c = np.zeros((at.size, at.size))
    c[at.mode, at.mode] += np.diag(2.0 * modes.damping_ratio * modes.omega_radps * modes.generalized_mass_kg)
    omega = np.sqrt(load / bobs.length_m)
    c[at.pendulum, at.pendulum] += np.diag(2.0 * bobs.damping_ratio * omega * bobs.mass_kg * bobs.length_m**2)
    flow = 0.5 * condition.density_kgpm3 * condition.airspeed_mps * air.area_m2
    c[0, 0] += flow * air.drag
    c[1, 1] -= 0.5 * flow * air.chord_m**2 * air.rate_damping
    for force, incidence in _surfaces(vehicle, condition, at):
        c -= np.outer(force, incidence[0])
    if vehicle.jet_damping:
        c[:, 1] += _mass_flow(vehicle, at)
    return c


def _surfaces(
    vehicle: PlanarVehicle, condition: FlightCondition, at: _Layout
) -> list[tuple[Array, tuple[Array, Array]]]:
    """Return, for each lifting surface, the generalised force per local lateral speed, and the speed's rows.

    The rows are that speed per rate and, divided by U, per deflection.
    """
    air, modes, out = vehicle.aerodynamics, vehicle.modes, []
    flow = 0.5 * condition.density_kgpm3 * condition.airspeed_mps * air.area_m2
    for k, slope in enumerate(air.slope_pr):
        force, by_rate, by_bend = np.zeros(at.size), np.zeros(at.size), np.zeros(at.size)
        force[0] = -flow * slope
        force[1] = flow * (slope * vehicle.body.core_cg_station_m - air.moment_slope_mpr[k])
        force[at.mode] = -flow * slope * modes.phi_surface[:, k]
        by_rate[0] = 1.0
        if air.local_incidence:
            by_rate[at.mode], by_bend[at.mode] = modes.phi_surface[:, k], modes.slope_surface_pm[:, k]
        out.append((force, (by_rate, by_bend)))
    return out


def _mass_flow(vehicle: PlanarVehicle, at: _Layout) -> Array:
    """Return the generalised forces per pitch rate due to the flow through the turning vehicle (jet damping).

    The core is a vessel with mass flow through it. Reynolds' transport theorem with the internal Coriolis acceleration
    2 w x v_rel gives, for the body point at its CG and about it (W. T. Thomson, Introduction to Space Dynamics, ch. 7),

        m a = F - 2 w x P,   P = m dc/dt + sum of outflow times place,
        I q' = M - (dI/dt + sum of outflow times place^2) q,

    with places forward of the CG and c the CG in the body. The gas leaves at the nozzle exit. Liquid also moves from
    the shrinking bobs to the core, at the bobs. The bobs move aft with the liquid surface, which gives them a Coriolis
    acceleration.
    """
    bobs = vehicle.pendulums
    momentum, turning = mass_flow_momentum(vehicle)
    out = np.zeros(at.size)
    for k in range(at.tanks):
        out += 2.0 * bobs.mass_kg[k] * bobs.bob_station_rate_mps[k] * _bob_reach(vehicle, at, k)
    out[0] -= 2.0 * momentum
    out[1] += turning
    return out


def _bob_reach(vehicle: PlanarVehicle, at: _Layout, tank: int) -> Array:
    """Return the lateral displacement of a bob per unit of each coordinate."""
    bobs = vehicle.pendulums
    reach = np.zeros(at.size)
    reach[0], reach[1] = 1.0, -(vehicle.body.core_cg_station_m - bobs.bob_station_m[tank])
    reach[at.mode] = vehicle.modes.phi_hinge[:, tank]
    reach[2 + at.modes + tank] = bobs.length_m[tank]
    return reach


def _gimbal_arm(vehicle: PlanarVehicle) -> float:
    """Return the distance from the core's CG aft to the gimbal, m."""
    return vehicle.engine.gimbal_station_m - vehicle.body.core_cg_station_m


def _engine_columns(vehicle: PlanarVehicle, condition: FlightCondition, load: float, at: _Layout) -> Array:
    """Return the generalised forces per engine angle and per engine acceleration."""
    engine, modes, arm = vehicle.engine, vehicle.modes, _gimbal_arm(vehicle)
    thrust, inertia = engine.thrust_N(condition.pressure_Pa), engine.inertia_about_gimbal_kgm2
    first_moment = engine.gimballed_mass_kg * engine.cg_from_gimbal_m
    out = np.zeros((at.size, 2))
    out[0] = thrust, first_moment
    out[1] = thrust * arm + load * first_moment, inertia + first_moment * arm
    out[at.mode, 0] = thrust * modes.phi_gimbal + load * first_moment * modes.slope_gimbal_pm
    out[at.mode, 1] = first_moment * modes.phi_gimbal + inertia * modes.slope_gimbal_pm
    return out


def _first_order(
    per_position: Array,
    per_rate: Array,
    per_engine: Array,
    vehicle: PlanarVehicle,
    condition: FlightCondition,
    at: _Layout,
) -> StateSpace:
    """Convert from second order in (lateral, theta, eta, G) to the states w, q, theta, eta, eta', G, G'."""
    n, m = at.modes, at.tanks
    eta, gamma = 3 + np.arange(n), 3 + 2 * n + np.arange(m)
    positions = np.concatenate([[2], eta, gamma])
    rates = np.concatenate([[0, 1], eta + n, gamma + m])
    a, b = np.zeros((3 + 2 * (n + m), 3 + 2 * (n + m))), np.zeros((3 + 2 * (n + m), 2))
    a[np.ix_(rates, positions)] = per_position[:, 1:]
    a[np.ix_(rates, rates)] = per_rate
    b[rates] = per_engine
    a[positions, rates[1:]] = 1.0
    # w' = s + U q - g sin(theta_0) theta, and the CG wanders to body points that the rotation moves otherwise
    a[0, 1] += condition.airspeed_mps + vehicle.body.core_cg_rate_mps
    a[0, 2] -= condition.gravity_mps2 * math.sin(condition.pitch_rad)
    c = np.zeros((len(OUTPUTS), len(a)))
    c[0, 1] = c[1, 1] = c[2, 0] = c[3, 2] = 1.0
    c[1, eta + n] = vehicle.modes.slope_gyro_pm
    inputs = ("delta_rad", "delta_accel_radps2")
    return StateSpace(a, b, c, np.zeros((len(OUTPUTS), 2)), state_names(n, m), inputs, OUTPUTS)
