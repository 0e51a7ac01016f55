"""Derive the equations of motion by Lagrange's method with SymPy, from energies alone.

No force balance is written. The Lagrangian is a sum of pieces (core, engine, one per mode pair, one per pendulum).
Lagrange's operator is linear, so each piece is derived once, in true generalised coordinates, and the pieces are added
over a constant selection of coordinates. The derivation is the same for any number of mode pairs and pendulums.

Coordinates: position of C0 in I' (3), 3-2-1 Euler angles of B relative to I' (yaw, pitch, roll), eta and xi of each
pair, two angles per pendulum, and gimbal angles, whose accelerations are given, so that their rows yield the actuator's
generalised torque. I' is I turned by a constant rotation, and each pendulum's angles are measured from a constant axis.
Both charts are placed again at every call, so no state is singular. The result must not depend on the chart; a test
moves it.

Energies (rigid velocity v0 of C0 and w = (p, q, r), all in B; nu_eta = etadot + p xi, nu_xi = xidot - p eta):
    core      m0 |v0|^2 / 2 + w' J w / 2
    pair      (Mz nu_eta^2 + My nu_xi^2) / 2,  strain (Mz wz^2 eta^2 + My wy^2 xi^2) / 2
    pendulum  m |v0 + w x r + rdot|^2 / 2 with r = rho + (0, sum phi_y xi, sum phi_z eta) + L u, exact
    engine    m_E |v_E + Deltadot + w x Delta|^2 / 2 - m_E |v_E|^2 / 2, Delta = -l_E (d - x),
              + I_t (|w + w_r|^2 - |w|^2) / 2
    engine on pair
              m_E (Deltadot + p x cross Delta) . (0, phi_Ey nu_xi, phi_Ez nu_eta)
              + I_t w_r . (0, sz nu_eta, -sy nu_xi)
The engine has three gimbal axes, whose rates give w_r. It does not turn about its own axis: w_r . d = 0. This
constraint is not holonomic. Its moment about d is that of the row of the third axis. It acts on the pitch row, whose
axis has the component sin(dy) along d (Lagrange's equations with multipliers).
Modal damping acts on etadot and xidot, pendulum damping on L udot_B; both are internal.
Limits: parameters frozen in time; by definition no terms of order (q, r) * bending of the core or
(q, r) * Delta * bending, and no rotation of Delta with the bent mount.
"""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import sympy as sp
from made_once import copy_of
from oracles.multibody_system import Engine, Floats, Load, Pendulum, State, Vehicle, rotation_taking

Numeric = Callable[..., Sequence[float]]

# Where the charts put the present state: away from zero, so that every term of the derivation is exercised.
EULER_CHART = (0.5, -0.4, 0.3)
PENDULUM_CHART = (0.3, -0.2)


def _symbols(names: str) -> sp.Matrix:
    return sp.Matrix(sp.symbols(names, real=True))


# Symbols shared by all pieces.
_R, _RD = _symbols("X Y Z"), _symbols("Xd Yd Zd")
_E, _ED = _symbols("psi theta phi"), _symbols("psid thetad phid")
_V, _W = _symbols("u v w"), _symbols("p q r")
_G = _symbols("g1 g2 g3")
_D, _DD = _symbols("dp dy dr"), _symbols("dpd dyd drd")  # pitch, yaw, turn about the thrust axis
_X_HAT = sp.Matrix([1, 0, 0])


def _euler_rotation() -> sp.Matrix:
    """Return C_I'B for yaw, pitch and roll, in this order."""
    psi, theta, phi = _E
    return (
        sp.Matrix([[sp.cos(psi), -sp.sin(psi), 0], [sp.sin(psi), sp.cos(psi), 0], [0, 0, 1]])
        * sp.Matrix([[sp.cos(theta), 0, sp.sin(theta)], [0, 1, 0], [-sp.sin(theta), 0, sp.cos(theta)]])
        * sp.Matrix([[1, 0, 0], [0, sp.cos(phi), -sp.sin(phi)], [0, sp.sin(phi), sp.cos(phi)]])
    )


def _rate(expression: sp.Matrix, q: Sequence[sp.Symbol], qd: Sequence[sp.Symbol]) -> sp.Matrix:
    return expression.jacobian(sp.Matrix(list(q))) * sp.Matrix(list(qd))


@cache
def _attitude() -> tuple[sp.Matrix, sp.Matrix]:
    """Return C_I'B and w_B as functions of Euler angles and rates, with w derived from C' Cdot."""
    c = _euler_rotation()
    c_dot = sp.zeros(3, 3)
    for angle, rate in zip(_E, _ED, strict=True):
        c_dot += c.diff(angle) * rate
    skew = c.T * c_dot
    return c, sp.Matrix([skew[2, 1], skew[0, 2], skew[1, 0]]).applyfunc(_without_squares_of_cosines)


def _without_squares_of_cosines(expression: sp.Expr) -> sp.Expr:
    """Return a simplified polynomial of degree two in the sines and cosines of the Euler angles.

    Substituting 1 - sin^2 for cos^2 gives equal polynomials the same form. `sp.trigsimp` takes 15 s.
    """
    return sp.expand(sp.expand(expression).subs({sp.cos(angle) ** 2: 1 - sp.sin(angle) ** 2 for angle in _E}))


@dataclass(frozen=True)
class _Piece:
    """A term of the Lagrangian.

    `kinetic` is a function of the quasi-velocities `_V`, `_W`, of the coordinates of the piece and of their rates;
    `potential` is a function of position, attitude and the coordinates of the piece.
    """

    kinetic: sp.Expr
    potential: sp.Expr
    own: tuple[sp.Symbol, ...]
    own_rates: tuple[sp.Symbol, ...]
    constants: tuple[sp.Symbol, ...]


@dataclass(frozen=True)
class _Compiled:
    """Numeric functions of one piece.

    `motion(*q, *qd, *constants)` -> mass matrix (row-major) then bias, q = (R, Euler, own);
    `momenta(*v, *w, *own, *own_rates, *constants)` -> kinetic energy, dT/dv (3), dT/dw (3);
    `potential(*R, *Euler, *own, *constants)` -> potential energy.
    """

    size: int
    motion: Numeric
    momenta: Numeric
    potential: Numeric


def _shared(name: str, derive: Callable[[], dict[str, Numeric]]) -> dict[str, Numeric]:
    """Return the functions that `sp.lambdify` makes of the expressions from `derive`, by name.

    The first process of a test run that needs them derives them, and the others load their source.
    """

    def write(folder: Path) -> None:
        sources = [inspect.getsource(f).replace("_lambdifygenerated", each) for each, f in derive().items()]
        (folder / "functions.py").write_text("\n".join(sources))

    names: dict[str, Any] = dict(vars(math))
    exec((copy_of(f"lagrange-{name}", write) / "functions.py").read_text(), names)
    return names


def _compiled(name: str, own: int, piece: Callable[[], _Piece]) -> _Compiled:
    """Return the functions of a piece with `own` coordinates of its own."""
    found = _shared(name, lambda: _derived(piece()))
    return _Compiled(len(_R) + len(_E) + own, found["motion"], found["momenta"], found["potential"])


def _derived(piece: _Piece) -> dict[str, Numeric]:
    c_ib, w = _attitude()
    v = c_ib.T * _RD
    to_coordinates = dict(zip(_V, v, strict=True)) | dict(zip(_W, w, strict=True))
    kinetic = piece.kinetic.subs(to_coordinates, simultaneous=True)

    q = sp.Matrix([*_R, *_E, *piece.own])
    qd = sp.Matrix([*_RD, *_ED, *piece.own_rates])
    momentum = sp.Matrix([kinetic.diff(rate) for rate in qd])
    mass = momentum.jacobian(qd)
    # Lagrange: d/dt (dT/dqd) - dT/dq + dV/dq = Q, with d/dt (dT/dqd) = M qdd + (d momentum / dq) qd.
    bias = (
        momentum.jacobian(q) * qd
        - sp.Matrix([kinetic.diff(coordinate) for coordinate in q])
        + sp.Matrix([piece.potential.diff(coordinate) for coordinate in q])
    )
    quasi = [piece.kinetic, *(piece.kinetic.diff(s) for s in (*_V, *_W))]
    constants = (*piece.constants, *_G)
    return {
        "motion": sp.lambdify((*q, *qd, *constants), [*mass, *bias], modules="math", cse=True),
        "momenta": sp.lambdify((*_V, *_W, *piece.own, *piece.own_rates, *constants), quasi, modules="math", cse=True),
        "potential": sp.lambdify((*q, *constants), [piece.potential], modules="math", cse=True),
    }


@cache
def _core() -> _Compiled:
    return _compiled("core", 0, _core_piece)


def _core_piece() -> _Piece:
    mass = sp.symbols("m0", positive=True)
    j = sp.symbols("J:6", real=True)
    inertia = sp.Matrix([[j[0], j[1], j[2]], [j[1], j[3], j[4]], [j[2], j[4], j[5]]])
    kinetic = mass * _V.dot(_V) / 2 + (_W.T * inertia * _W)[0] / 2
    return _Piece(kinetic, -mass * _G.dot(_R), (), (), (mass, *j))


def _thrust_direction() -> sp.Matrix:
    dp, dy, _ = _D
    return sp.Matrix([sp.cos(dp) * sp.cos(dy), -sp.sin(dy), sp.sin(dp) * sp.cos(dy)])


def _engine_motion(length: sp.Symbol) -> tuple[sp.Matrix, sp.Matrix, sp.Matrix]:
    """Return Delta, Deltadot and the engine's angular velocity relative to its mount, in B.

    The gimbal has three axes: pitch about -y of the mount, yaw, and a turn about the thrust axis.
    """
    d = _thrust_direction()
    delta = -length * (d - _X_HAT)
    about_yaw = d.cross(d.diff(_D[1]))
    turning = sp.Matrix([0, -_DD[0], 0]) + about_yaw * _DD[1] + d * _DD[2]
    return delta, -length * _rate(d, _D, _DD), turning


@cache
def _engine() -> _Compiled:
    return _compiled("engine", 3, _engine_piece)


def _engine_piece() -> _Piece:
    mass, inertia, length = sp.symbols("m_E I_t l_E", positive=True)
    gimbal = _symbols("g_x g_y g_z")
    delta, delta_dot, spin = _engine_motion(length)
    v_locked = _V + _W.cross(gimbal - length * _X_HAT)
    v_moved = v_locked + delta_dot + _W.cross(delta)
    w_engine = _W + spin
    kinetic = (
        mass * (v_moved.dot(v_moved) - v_locked.dot(v_locked)) / 2 + inertia * (w_engine.dot(w_engine) - _W.dot(_W)) / 2
    )
    potential = -mass * _G.dot(_attitude()[0] * delta)
    return _Piece(kinetic, potential, tuple(_D), tuple(_DD), (mass, inertia, length, *gimbal))


@cache
def _pair() -> _Compiled:
    return _compiled("pair", 5, _pair_piece)


def _pair_piece() -> _Piece:
    """Return a mode pair and the effect on it of the engine's motion relative to the core."""
    eta, xi, eta_dot, xi_dot = sp.symbols("eta xi etad xid", real=True)
    mass_z, mass_y, omega_z, omega_y = sp.symbols("M_z M_y w_z w_y", real=True)
    phi_z, phi_y, sigma_z, sigma_y = sp.symbols("phi_gz phi_gy sigma_gz sigma_gy", real=True)
    mass, inertia, length = sp.symbols("m_E I_t l_E", real=True)
    delta, delta_dot, spin = _engine_motion(length)
    nu_eta, nu_xi = eta_dot + _W[0] * xi, xi_dot - _W[0] * eta
    engine_velocity = sp.Matrix([0, (phi_y + length * sigma_y) * nu_xi, (phi_z + length * sigma_z) * nu_eta])
    w_mount = sp.Matrix([0, sigma_z * nu_eta, -sigma_y * nu_xi])
    kinetic = (
        (mass_z * nu_eta**2 + mass_y * nu_xi**2) / 2
        + mass * (delta_dot + _W[0] * _X_HAT.cross(delta)).dot(engine_velocity)
        + inertia * spin.dot(w_mount)
    )
    strain = (mass_z * omega_z**2 * eta**2 + mass_y * omega_y**2 * xi**2) / 2
    constants = (mass_z, mass_y, omega_z, omega_y, phi_z, phi_y, sigma_z, sigma_y, mass, inertia, length)
    return _Piece(kinetic, strain, (eta, xi, *_D), (eta_dot, xi_dot, *_DD), constants)


_PENDULUM_ANGLES, _PENDULUM_RATES = _symbols("alpha beta"), _symbols("alphad betad")


def _chart_direction() -> sp.Matrix:
    """Return the unit vector of the two pendulum angles in chart axes; singular at beta = +-90 degrees."""
    alpha, beta = _PENDULUM_ANGLES
    return sp.Matrix([sp.cos(alpha) * sp.cos(beta), sp.sin(beta), sp.sin(alpha) * sp.cos(beta)])


@cache
def _pendulum() -> _Compiled:
    return _compiled("pendulum", 4, _pendulum_piece)


def _pendulum_piece() -> _Piece:
    """Return a pendulum on the hinge displacement (y, z), a constant linear map of the modal coordinates."""
    mass, length = sp.symbols("m_p L_p", positive=True)
    hinge = _symbols("h_x h_y h_z")
    displacement, displacement_rate = sp.symbols("s_y s_z", real=True), sp.symbols("s_yd s_zd", real=True)
    axes = sp.Matrix(3, 3, sp.symbols("A:9", real=True))
    u = axes * _chart_direction()
    u_dot = _rate(u, _PENDULUM_ANGLES, _PENDULUM_RATES)
    arm = hinge + sp.Matrix([0, *displacement]) + length * u
    velocity = _V + _W.cross(arm) + sp.Matrix([0, *displacement_rate]) + length * u_dot
    kinetic = mass * velocity.dot(velocity) / 2
    potential = -mass * _G.dot(_R + _attitude()[0] * arm)
    own = (*displacement, *_PENDULUM_ANGLES)
    own_rates = (*displacement_rate, *_PENDULUM_RATES)
    return _Piece(kinetic, potential, own, own_rates, (mass, length, *hinge, *axes))


@cache
def _kinematics() -> tuple[Numeric, Numeric]:
    """Return two numeric functions of angles and rates.

    Attitude: C_I'B (9), dw/dedot (9), and the part of wdot that is independent of second derivatives (3).
    Pendulum: u (3), du/dangles (6), and the part of uddot that is independent of second derivatives (3).
    """
    found = _shared("kinematics", _derived_kinematics)
    return found["attitude"], found["direction"]


def _derived_kinematics() -> dict[str, Numeric]:
    c, w = _attitude()
    attitude = sp.lambdify((*_E, *_ED), [*c, *w.jacobian(_ED), *_rate(w, _E, _ED)], modules="math", cse=True)
    u = _chart_direction()
    u_dot = _rate(u, _PENDULUM_ANGLES, _PENDULUM_RATES)
    rest = _rate(u_dot, _PENDULUM_ANGLES, _PENDULUM_RATES)
    direction = sp.lambdify(
        (*_PENDULUM_ANGLES, *_PENDULUM_RATES), [*u, *u.jacobian(_PENDULUM_ANGLES), *rest], modules="math", cse=True
    )
    return {"attitude": attitude, "direction": direction}


@dataclass(frozen=True)
class _Chart:
    """The present state in generalised coordinates, in charts that are regular there."""

    q: Floats  # all coordinates: R, Euler, eta, xi, pendulum angles, gimbal angles
    q_dot: Floats
    C_IJ: Floats  # I' components into I; J stands for I'
    C_JB: Floats
    w_of_rates: Floats  # dw/dedot
    w_rest: Floats  # wdot = w_of_rates eddot + w_rest
    axes: list[Floats]  # per pendulum
    u_jacobian: list[Floats]  # du_B/dangles (3, 2)
    u_rest: list[Floats]  # uddot_B = u_jacobian angles'' + u_rest


def _chart(state: State, euler: tuple[float, float, float], angles: tuple[float, float]) -> _Chart:
    attitude, direction = _kinematics()
    zero = attitude(*euler, 0.0, 0.0, 0.0)
    c_jb = np.reshape(zero[:9], (3, 3))
    w_of_rates = np.reshape(zero[9:18], (3, 3))
    euler_rates = np.linalg.solve(w_of_rates, state.w_BI_B_radps)
    w_rest = np.array(attitude(*euler, *euler_rates)[18:])
    c_ij = state.C_IB @ c_jb.T

    axes, jacobians, rests = [], [], []
    pendulum_angles: list[float] = []
    pendulum_rates: list[float] = []
    for u, u_dot in zip(state.u_B, state.udot_B_1ps, strict=True):
        still = direction(*angles, 0.0, 0.0)
        a = rotation_taking(np.array(still[:3]), u)
        jacobian = a @ np.reshape(still[3:9], (3, 2))
        rates = np.linalg.lstsq(jacobian, u_dot, rcond=None)[0]
        axes.append(a)
        jacobians.append(jacobian)
        rests.append(a @ np.array(direction(*angles, *rates)[9:]))
        pendulum_angles += angles
        pendulum_rates += list(rates)

    return _Chart(
        q=np.concatenate(
            (c_ij.T @ state.r_I_m, euler, state.eta_m, state.xi_m, pendulum_angles, state.deflection_rad, [0.0])
        ),
        q_dot=np.concatenate(
            (
                c_ij.T @ state.v_I_mps,
                euler_rates,
                state.etadot_mps,
                state.xidot_mps,
                pendulum_rates,
                state.deflection_radps,
                [-math.sin(state.deflection_rad[1]) * state.deflection_radps[0]],
            )
        ),
        C_IJ=c_ij,
        C_JB=c_jb,
        w_of_rates=w_of_rates,
        w_rest=w_rest,
        axes=axes,
        u_jacobian=jacobians,
        u_rest=rests,
    )


_NO_ENGINE = Engine(0.0, 0.0, 0.0, np.zeros(3))


def _pieces(vehicle: Vehicle, axes: list[Floats]) -> list[tuple[_Compiled, Floats, Floats]]:
    """Return every piece with its constants and its selection matrix S: own coordinates = S (all coordinates)."""
    n_pairs, n_pendulums = len(vehicle.pairs), len(vehicle.pendulums)
    total = 6 + 2 * n_pairs + 2 * n_pendulums + 3
    eye = np.eye(total)
    rigid, gimbal = eye[:6], eye[-3:]
    eta, xi = eye[6 : 6 + n_pairs], eye[6 + n_pairs : 6 + 2 * n_pairs]
    j = vehicle.inertia_B_kgm2
    engine = vehicle.engine or _NO_ENGINE

    core_constants = np.array([vehicle.mass_kg, j[0, 0], j[0, 1], j[0, 2], j[1, 1], j[1, 2], j[2, 2]])
    engine_constants = np.array([engine.mass_kg, engine.inertia_kgm2, engine.length_m])
    pieces = [
        (_core(), core_constants, rigid),
        (_engine(), np.concatenate((engine_constants, engine.gimbal_B_m)), np.vstack((rigid, gimbal))),
    ]
    for i, pair in enumerate(vehicle.pairs):
        own_constants = np.array(
            [
                pair.mass_z_kg,
                pair.mass_y_kg,
                pair.omega_z_radps,
                pair.omega_y_radps,
                pair.phi_gimbal_z,
                pair.phi_gimbal_y,
                pair.sigma_gimbal_z_1pm,
                pair.sigma_gimbal_y_1pm,
            ]
        )
        selection = np.vstack((rigid, eta[i], xi[i], gimbal))
        pieces.append((_pair(), np.concatenate((own_constants, engine_constants)), selection))
    for k, pendulum in enumerate(vehicle.pendulums):
        start = 6 + 2 * n_pairs + 2 * k
        selection = np.vstack(
            (rigid, _shape(pendulum.phi_y, n_pairs) @ xi, _shape(pendulum.phi_z, n_pairs) @ eta, eye[start : start + 2])
        )
        constants = np.concatenate(((pendulum.mass_kg, pendulum.length_m), pendulum.hinge_B_m, axes[k].ravel()))
        pieces.append((_pendulum(), constants, selection))
    return pieces


def _shape(phi: Floats, n_pairs: int) -> Floats:
    """Return the mode shapes of a pendulum; a pendulum without shapes is unaffected by all modes."""
    return phi if len(phi) else np.zeros(n_pairs)


def _damping(pendulum: Pendulum, jacobian: Floats, u_dot: Floats) -> Floats:
    """Return the generalised force (2,) on the pendulum's angles: virtual work of -c m L udot over L delta(u)."""
    force: Floats = -pendulum.damping_1ps * pendulum.mass_kg * pendulum.length_m**2 * (jacobian.T @ u_dot)
    return force


def accelerations(
    vehicle: Vehicle,
    state: State,
    load: Load | None = None,
    *,
    euler_chart: tuple[float, float, float] = EULER_CHART,
    pendulum_chart: tuple[float, float] = PENDULUM_CHART,
) -> dict[str, Floats]:
    """Solve Lagrange's equations at one instant.

    Returns a dict:
        specific_force_B_mps2 (3,)   inertial acceleration of C0 minus gravitation, in B
        wdot_B_radps2 (3,)           rate of the B components of w_BI
        etaddot_mps2, xiddot_mps2 (n_pairs,)
        uddot_B_1ps2 (n_pendulums, 3)  second rate of the B components of u
        actuator_torque_Nm (2,)      generalised forces that give the gimbal angles their prescribed accelerations
    The charts may be moved (yaw, pitch, roll; two pendulum angles; radians) without changing the result.
    `modal_z_N`, `modal_y_N` do work on etadot, xidot; `moment_B_Nm` on w; `force_B_N` on the velocity of C0.
    """
    load = load or Load()
    n_pairs, n_pendulums = len(vehicle.pairs), len(vehicle.pendulums)
    chart = _chart(state, euler_chart, pendulum_chart)
    g_j = chart.C_IJ.T @ load.gravitation_I_mps2
    total = len(chart.q)
    mass, bias = np.zeros((total, total)), np.zeros(total)
    for compiled, constants, selection in _pieces(vehicle, chart.axes):
        n = compiled.size
        flat = compiled.motion(*(selection @ chart.q), *(selection @ chart.q_dot), *constants, *g_j)
        mass += selection.T @ np.reshape(flat[: n * n], (n, n)) @ selection
        bias += selection.T @ np.array(flat[n * n :])

    force = np.zeros(total)
    force[:3] = chart.C_JB @ load.force_B_N
    force[3:6] = chart.w_of_rates.T @ load.moment_B_Nm
    for i, pair in enumerate(vehicle.pairs):
        damping_z = 2.0 * pair.zeta_z * pair.omega_z_radps * pair.mass_z_kg
        damping_y = 2.0 * pair.zeta_y * pair.omega_y_radps * pair.mass_y_kg
        force[6 + i] = -damping_z * state.etadot_mps[i]
        force[6 + n_pairs + i] = -damping_y * state.xidot_mps[i]
    if load.modal_z_N is not None:
        force[6 : 6 + n_pairs] += load.modal_z_N
    if load.modal_y_N is not None:
        force[6 + n_pairs : 6 + 2 * n_pairs] += load.modal_y_N
    for k, pendulum in enumerate(vehicle.pendulums):
        start = 6 + 2 * n_pairs + 2 * k
        force[start : start + 2] = _damping(pendulum, chart.u_jacobian[k], state.udot_B_1ps[k])

    free = slice(0, total - 3)
    given = slice(total - 3, total)
    q_ddot = np.zeros(total)
    yaw, (pitch_rate, yaw_rate) = state.deflection_rad[1], state.deflection_radps
    turn = -math.cos(yaw) * yaw_rate * pitch_rate - math.sin(yaw) * state.deflection_radps2[0]
    q_ddot[given] = [*state.deflection_radps2, turn]
    q_ddot[free] = _solve(mass[free, free], force[free] - bias[free] - mass[free, given] @ q_ddot[given])
    torque = mass[given] @ q_ddot + bias[given]
    torque = torque[:2] - np.array([math.sin(yaw), 0.0]) * torque[2]  # the pitch axis along d is sin(yaw)

    angles_ddot = q_ddot[6 + 2 * n_pairs : total - 3].reshape(n_pendulums, 2)
    uddot = [chart.u_jacobian[k] @ angles_ddot[k] + chart.u_rest[k] for k in range(n_pendulums)]
    return {
        "specific_force_B_mps2": chart.C_JB.T @ (q_ddot[:3] - g_j),
        "wdot_B_radps2": chart.w_of_rates @ q_ddot[3:6] + chart.w_rest,
        "etaddot_mps2": q_ddot[6 : 6 + n_pairs],
        "xiddot_mps2": q_ddot[6 + n_pairs : 6 + 2 * n_pairs],
        "uddot_B_1ps2": np.array(uddot).reshape(n_pendulums, 3),
        "actuator_torque_Nm": torque,
    }


def _solve(mass: Floats, force: Floats) -> Floats:
    """Solve a linear system with scaled rows and columns: kg and kg m2 differ by many orders of magnitude."""
    scale = 1.0 / np.sqrt(np.diag(mass))
    scaled: Floats = scale * np.linalg.solve(mass * np.outer(scale, scale), scale * force)
    return scaled


def energy(vehicle: Vehicle, state: State, gravitation_I_mps2: Floats | None = None) -> dict[str, float]:
    """Return the kinetic and potential energy (strain and gravity) in J, from the pieces of the Lagrangian."""
    chart = _chart(state, EULER_CHART, PENDULUM_CHART)
    g_j = chart.C_IJ.T @ (np.zeros(3) if gravitation_I_mps2 is None else gravitation_I_mps2)
    v_b = state.C_IB.T @ state.v_I_mps
    kinetic = potential = 0.0
    for compiled, constants, selection in _pieces(vehicle, chart.axes):
        q, q_dot = selection @ chart.q, selection @ chart.q_dot
        kinetic += compiled.momenta(*v_b, *state.w_BI_B_radps, *q[6:], *q_dot[6:], *constants, *g_j)[0]
        potential += compiled.potential(*q, *constants, *g_j)[0]
    return {"kinetic_J": float(kinetic), "potential_J": float(potential), "total_J": float(kinetic + potential)}


def momentum(vehicle: Vehicle, state: State) -> dict[str, Floats]:
    """Return the linear momentum dT/dv and angular momentum dT/dw, the Noether constants of the defined Lagrangian.

    Returns `linear_I_Ns`, `angular_C0_B_Nms` (about C0, B axes) and `angular_I_Nms` (about the origin of I). Limits:
    with bending, they follow from the energies as defined, without second-order terms.
    """
    chart = _chart(state, EULER_CHART, PENDULUM_CHART)
    v_b = state.C_IB.T @ state.v_I_mps
    linear_b, angular_b = np.zeros(3), np.zeros(3)
    for compiled, constants, selection in _pieces(vehicle, chart.axes):
        q, q_dot = selection @ chart.q, selection @ chart.q_dot
        flat = compiled.momenta(*v_b, *state.w_BI_B_radps, *q[6:], *q_dot[6:], *constants, 0.0, 0.0, 0.0)
        linear_b += flat[1:4]
        angular_b += flat[4:7]
    linear_i = state.C_IB @ linear_b
    return {
        "linear_I_Ns": linear_i,
        "angular_C0_B_Nms": angular_b,
        "angular_I_Nms": np.cross(state.r_I_m, linear_i) + state.C_IB @ angular_b,
    }
