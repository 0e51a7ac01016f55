"""The pitch plane linearised at a frozen time: from gimbal command to the angle the gyro has turned through.

The paper's eqs 1 to 29 with the corrections of its errata: sloshing masses taken out of the core, pendulum
reaction and damping at the hinge, a gyro that feels d(eta)/dt, thrust that follows the bent tail, axial
softening, engine inertia about the gimbal. Written anew, apart from maxq.sim and maxq.design, so that it can
contradict them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from maxq.control.kernel.records import Array
from maxq.tools.dev.studies.ksr3.vehicle_at import Snapshot


@dataclass(frozen=True)
class Linear:
    """dx/dt = a x + b u; the output is c x."""

    a: Array
    b: Array
    c: Array


def actuator(omega_hz: list[float], zeta: list[float]) -> Linear:
    """Eq 28: command to gimbal angle, three blocks in a row; states are (value, rate) of each."""
    w1, w2, w3, w4 = 2 * np.pi * np.array(omega_hz)
    z1, z2, z3, z4 = zeta
    a = np.zeros((6, 6))
    for k, (w, z) in enumerate(((w1, z1), (w2, z2), (w3, z3))):
        i = 2 * k
        a[i, i + 1] = 1.0
        a[i + 1, i : i + 2] = -w * w, -2 * z * w
        if k:
            a[i + 1, i - 2] = w * w
    b = np.zeros(6)
    b[1] = w1 * w1
    # The zero pair of the third block: (v'' + 2 z4 w4 v' + w4^2 v) / w4^2.
    c = a[5] / w4**2
    c[4] += 1.0
    c[5] += 2 * z4 / w4
    return Linear(a, b, c)


def gyro(omega_hz: float, zeta: float) -> Linear:
    """Eq 29, from the angle at the gyro to the integral of the rate it reports (the same filter for both)."""
    w = 2 * np.pi * omega_hz
    a = np.array([[0.0, 1.0], [-w * w, -2 * zeta * w]])
    return Linear(a, np.array([0.0, w * w]), np.array([1.0, 0.0]))


def vehicle(s: Snapshot) -> tuple[Array, Array, Array]:
    """State matrix (n, n), inputs (n, 2) for gimbal angle and its second derivative, and the angle at the
    gyro (n,).

    State: w (m/s, body z), theta, q, pendulum angles, eta, pendulum rates, d(eta)/dt. Angles are
    perturbations in rad.
    """
    np_, nb = len(s.pendulums), len(s.bending.omega_radps)
    layout = _Layout(np_, nb)
    mass, force = _mass_matrix(s, layout), _forces(s, layout)
    # mass @ [A_z, q', Gamma'', eta''] = force @ [state, delta, delta'']; A_z is the body's lateral
    # acceleration.
    accelerations = np.linalg.solve(mass, force)
    n = layout.size
    rows = np.zeros((n, n + 2))
    rows[0] = accelerations[0]
    rows[0, 2] += s.speed_mps  # w' = A_z + U q - g sin(gamma) theta
    rows[0, 1] -= s.lateral_gravity_mps2
    rows[1, 2] = 1.0
    rows[2] = accelerations[1]
    flexible = np_ + nb
    rows[3 : 3 + flexible, 3 + flexible : 3 + 2 * flexible] = np.eye(flexible)
    rows[3 + flexible :] = accelerations[2:]
    angle = np.zeros(n)
    angle[1] = 1.0
    angle[layout.eta] = s.bending.gyro_slope_pm
    return rows[:, :n], rows[:, n:], angle


class _Layout:
    """Where the states are."""

    def __init__(self, pendulums: int, modes: int) -> None:
        first = 3
        self.gamma = slice(first, first + pendulums)
        self.eta = slice(first + pendulums, first + pendulums + modes)
        self.gamma_rate = slice(self.eta.stop, self.eta.stop + pendulums)
        self.eta_rate = slice(self.gamma_rate.stop, self.gamma_rate.stop + modes)
        self.size = self.eta_rate.stop
        self.pendulums, self.modes = pendulums, modes


def _mass_matrix(s: Snapshot, layout: _Layout) -> Array:
    """Rows: lateral force, pitch moment, each pendulum (per unit mass), each mode."""
    count = 2 + layout.pendulums + layout.modes
    m = np.diag(np.concatenate([[s.core_mass_kg, s.core_inertia_kgm2], np.ones(count - 2)]))
    for k, p in enumerate(s.pendulums):
        row = 2 + k
        m[row, 0] = 1.0
        m[row, 1] = p.length_m - p.hinge_m
        m[row, row] = p.length_m
        m[row, 2 + layout.pendulums :] = p.phi
    modal = range(2 + layout.pendulums, count)
    m[modal, modal] = s.bending.generalized_mass_kg
    return m


def _forces(s: Snapshot, layout: _Layout) -> Array:
    """(rows of the mass matrix) x (states, delta, delta'')."""
    f = np.zeros((2 + layout.pendulums + layout.modes, layout.size + 2))
    modal = slice(2 + layout.pendulums, None)
    _add_engine(f, modal, s, layout)
    _add_stiffness(f, modal, s, layout)
    for k in range(layout.pendulums):
        _add_pendulum(f, s, layout, k)
    _add_air(f, modal, s, layout)
    return f


def _add_engine(f: Array, modal: slice, s: Snapshot, layout: _Layout) -> None:
    """Thrust along the deflected, locally bent axis, and the engine's reaction to its own motion."""
    thrust, arm, slope, delta = s.thrust_N, s.gimbal_arm_m, s.bending.gimbal_slope_pm, layout.size
    f[0, delta] = thrust
    f[0, layout.eta] -= thrust * slope
    f[1, delta] = thrust * arm + s.engine_first_moment_kgm * s.axial_mps2  # the engine's weight moves off the axis
    f[1, layout.eta] += thrust * (1.0 - arm * slope)  # phi(gimbal) = 1
    f[modal, delta] = thrust + slope * s.engine_first_moment_kgm * s.axial_mps2
    f[modal, layout.eta] -= thrust * slope  # every mode has phi(gimbal) = 1: the same row for each
    f[0, delta + 1] = s.engine_first_moment_kgm
    f[1, delta + 1] = s.engine_inertia_kgm2 + s.engine_first_moment_kgm * arm
    f[modal, delta + 1] = s.engine_first_moment_kgm + slope * s.engine_inertia_kgm2


def _add_stiffness(f: Array, modal: slice, s: Snapshot, layout: _Layout) -> None:
    b = s.bending
    f[modal, layout.eta] += s.axial_mps2 * b.softening - np.diag(b.generalized_mass_kg * b.omega_radps**2)
    f[modal, layout.eta_rate] -= np.diag(2 * b.generalized_mass_kg * b.zeta * b.omega_radps)


def _add_pendulum(f: Array, s: Snapshot, layout: _Layout, k: int) -> None:
    """Its own restoring force, and what it does to core and modes through the hinge."""
    p = s.pendulums[k]
    modal = slice(2 + layout.pendulums, None)
    angle, rate = layout.gamma.start + k, layout.gamma_rate.start + k
    damping = 2 * p.damping * np.sqrt(s.axial_mps2 * p.length_m)  # m/s: force per unit mass and angular rate
    f[2 + k, angle] = -s.axial_mps2
    f[2 + k, rate] = -damping
    pull, drag = p.mass_kg * s.axial_mps2, p.mass_kg * damping
    couple = drag * p.length_m  # the damper's own reaction on the tank
    f[0, angle] += pull
    f[0, rate] += drag
    f[1, angle] -= p.hinge_m * pull
    f[1, rate] += couple - p.hinge_m * drag
    f[1, layout.eta] -= pull * p.phi  # the axial pull of the bob on a hinge that has moved sideways
    f[modal, angle] += p.phi * pull
    f[modal, rate] += p.phi * drag + p.slope_pm * couple


def _add_air(f: Array, modal: slice, s: Snapshot, layout: _Layout) -> None:
    """Normal force of each surface at its local incidence; pitch damping as one moment."""
    f[1, 2] += s.pitch_damping_Nms
    for surface in s.surfaces:
        incidence = np.zeros(layout.size + 2)
        incidence[0] = 1.0 / s.speed_mps
        incidence[layout.eta] = surface.slope_pm
        incidence[layout.eta_rate] = surface.phi / s.speed_mps
        normal = -s.pressure_area_N * surface.slope_pr * incidence
        f[0] += normal
        f[1] -= surface.arm_m * normal
        f[modal] += surface.phi[:, None] * normal


def plant(s: Snapshot, actuator_: Linear, gyro_: Linear) -> Linear:
    """Gimbal command (rad) to the integral of the gyro's output (rad)."""
    a, b, angle = vehicle(s)
    n, na, ng = len(a), len(actuator_.a), len(gyro_.a)
    full = np.zeros((n + na + ng, n + na + ng))
    full[:n, :n] = a
    full[:n, n : n + na] = np.outer(b[:, 0], actuator_.c)
    full[:n, n : n + na] += np.outer(b[:, 1], actuator_.c @ actuator_.a @ actuator_.a)  # four more poles than zeros
    full[n : n + na, n : n + na] = actuator_.a
    full[n + na :, :n] = np.outer(gyro_.b, angle)
    full[n + na :, n + na :] = gyro_.a
    command = np.concatenate([np.zeros(n), actuator_.b, np.zeros(ng)])
    return Linear(full, command, np.concatenate([np.zeros(n + na), gyro_.c]))
