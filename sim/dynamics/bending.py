"""Bending modes: free-free modes of the vehicle with its engine locked and its sloshing masses removed.

Mode i of the pitch plane displaces the body axis by phi_i(x) eta_i along z and turns it by +slope_i eta_i about y; in
the yaw plane by phi_i(x) xi_i along y and -slope_i xi_i about z. The two planes turn with the body: with the
quasi-velocities nu (state.py) the kinetic energy is a plain sum of squares and the roll rate appears only in the
gyroscopic terms below (docs/model.md, section 4).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from maxq.control.jit import kernel
from maxq.control.records import Array
from maxq.sim.dynamics.schedule import (
    MODE_FIRST,
    MODE_MASS,
    MODE_OMEGA,
    MODE_PHI_GIMBAL,
    MODE_SLOPE_GIMBAL,
    MODE_SLOPE_GYRO,
    mode_width,
    pitch_column,
    yaw_column,
)
from maxq.sim.dynamics.state import MAX_MODES, Sizes, eta_index, xi_index
from maxq.sim.dynamics.vectors import Vector
from maxq.sim.dynamics.workspace import FORCE_PITCH, FORCE_YAW, RATE_PITCH, RATE_YAW


@dataclass(frozen=True)
class Bending:
    zeta_pitch: Annotated[Array, (MAX_MODES,)]
    zeta_yaw: Annotated[Array, (MAX_MODES,)]
    frequency_factor: Annotated[Array, (MAX_MODES,)]
    softening_factor: float  # 0 without axial softening


@kernel
def modal_rates(sizes: Sizes, roll_rate: float, y: Array, work: Array) -> None:
    """d(eta)/dt and d(xi)/dt from the quasi-velocities; generalised forces set to zero."""
    eta, xi = eta_index(sizes), xi_index(sizes)
    for i in range(sizes.pitch_modes):
        partner = y[xi + i] if i < sizes.yaw_modes else 0.0
        work[RATE_PITCH + i] = y[eta + sizes.pitch_modes + i] - roll_rate * partner
        work[FORCE_PITCH + i] = 0.0
    for i in range(sizes.yaw_modes):
        partner = y[eta + i] if i < sizes.pitch_modes else 0.0
        work[RATE_YAW + i] = y[xi + sizes.yaw_modes + i] + roll_rate * partner
        work[FORCE_YAW + i] = 0.0


@kernel
def bend_at_gimbal(sizes: Sizes, props: Array, y: Array) -> tuple[float, float, float, float]:
    """Displacement along y and z (m) and turning about y and z (rad) of the gimbal by bending."""
    eta, xi = eta_index(sizes), xi_index(sizes)
    move_y, move_z, turn_y, turn_z = 0.0, 0.0, 0.0, 0.0
    c, width = pitch_column(sizes, 0), mode_width(sizes, sizes.pitch_modes)
    for i in range(sizes.pitch_modes):
        move_z += props[c + i * width + MODE_PHI_GIMBAL] * y[eta + i]
        turn_y += props[c + i * width + MODE_SLOPE_GIMBAL] * y[eta + i]
    c, width = yaw_column(sizes, 0), mode_width(sizes, sizes.yaw_modes)
    for i in range(sizes.yaw_modes):
        move_y += props[c + i * width + MODE_PHI_GIMBAL] * y[xi + i]
        turn_z -= props[c + i * width + MODE_SLOPE_GIMBAL] * y[xi + i]
    return move_y, move_z, turn_y, turn_z


@kernel
def bend_rate_at_gyro(sizes: Sizes, props: Array, y: Array) -> tuple[float, float]:
    """Turning rate about y and z that bending adds at the gyro, rad/s."""
    eta, xi = eta_index(sizes), xi_index(sizes)
    about_y, about_z = 0.0, 0.0
    c, width = pitch_column(sizes, 0), mode_width(sizes, sizes.pitch_modes)
    for i in range(sizes.pitch_modes):
        about_y += props[c + i * width + MODE_SLOPE_GYRO] * y[eta + sizes.pitch_modes + i]
    c, width = yaw_column(sizes, 0), mode_width(sizes, sizes.yaw_modes)
    for i in range(sizes.yaw_modes):
        about_z -= props[c + i * width + MODE_SLOPE_GYRO] * y[xi + sizes.yaw_modes + i]
    return about_y, about_z


GimbalPush = tuple[float, float, float, float]  # forces along y and z, moments about y and z, at the gimbal, in B


@kernel
def push_at_gimbal(sizes: Sizes, props: Array, push: GimbalPush, work: Array) -> None:
    """Add the generalised forces of what acts on the body at the gimbal."""
    force_y, force_z, moment_y, moment_z = push
    c, width = pitch_column(sizes, 0), mode_width(sizes, sizes.pitch_modes)
    for i in range(sizes.pitch_modes):
        j = c + i * width
        work[FORCE_PITCH + i] += props[j + MODE_PHI_GIMBAL] * force_z + props[j + MODE_SLOPE_GIMBAL] * moment_y
    c, width = yaw_column(sizes, 0), mode_width(sizes, sizes.yaw_modes)
    for i in range(sizes.yaw_modes):
        j = c + i * width
        work[FORCE_YAW + i] += props[j + MODE_PHI_GIMBAL] * force_y - props[j + MODE_SLOPE_GIMBAL] * moment_z


@kernel
def elastic_forces(bending: Bending, sizes: Sizes, props: Array, axial_load: float, y: Array, work: Array) -> float:
    """Add stiffness, damping and axial softening to the generalised forces.

    Returns the roll moment that these internal forces leave on the body when the two planes differ in stiffness or
    while they damp a whirling motion: it keeps the angular momentum about x whole.
    """
    eta, xi = eta_index(sizes), xi_index(sizes)
    roll = 0.0
    n = sizes.pitch_modes
    c, width = pitch_column(sizes, 0), mode_width(sizes, n)
    soft = MODE_FIRST + sizes.tanks + 2 * sizes.surfaces
    k_soft = bending.softening_factor * axial_load
    for i in range(n):
        j = c + i * width
        omega = props[j + MODE_OMEGA] * bending.frequency_factor[i]
        force = (
            -props[j + MODE_MASS] * omega * (omega * y[eta + i] + 2.0 * bending.zeta_pitch[i] * work[RATE_PITCH + i])
        )
        for k in range(n):
            force += k_soft * props[j + soft + k] * y[eta + k]
        work[FORCE_PITCH + i] += force
        if i < sizes.yaw_modes:
            roll -= y[xi + i] * force
    n = sizes.yaw_modes
    c, width = yaw_column(sizes, 0), mode_width(sizes, n)
    for i in range(n):
        j = c + i * width
        omega = props[j + MODE_OMEGA] * bending.frequency_factor[i]
        force = -props[j + MODE_MASS] * omega * (omega * y[xi + i] + 2.0 * bending.zeta_yaw[i] * work[RATE_YAW + i])
        for k in range(n):
            force += k_soft * props[j + soft + k] * y[xi + k]
        work[FORCE_YAW + i] += force
        if i < sizes.pitch_modes:
            roll += y[eta + i] * force
    return roll


@kernel
def gyroscopic_forces(
    sizes: Sizes, props: Array, rate: Vector, engine_mass: float, engine_arm: float, engine_inertia: float,
    delta_rate: Vector, turn_rate_y: float, turn_rate_z: float, y: Array, work: Array,
) -> Vector:  # fmt: skip
    """Roll-rate coupling of the two planes, and the moment of the modes' angular momentum about x on the body.

    `delta_rate` is the velocity of the engine's CG relative to the straight engine, `turn_rate_*` the engine's turning
    rate relative to the gimbal's: they are part of the modal momenta (docs/model.md, eq. 4.6).
    """
    p, q, r = rate
    eta, xi = eta_index(sizes), xi_index(sizes)
    pitch, pitch_width = pitch_column(sizes, 0), mode_width(sizes, sizes.pitch_modes)
    yaw, yaw_width = yaw_column(sizes, 0), mode_width(sizes, sizes.yaw_modes)
    h, roll = 0.0, 0.0
    for i in range(min(sizes.pitch_modes, sizes.yaw_modes)):
        a, b = pitch + i * pitch_width, yaw + i * yaw_width
        nu_eta, nu_xi = y[eta + sizes.pitch_modes + i], y[xi + sizes.yaw_modes + i]
        slope_a, slope_b = props[a + MODE_SLOPE_GIMBAL], props[b + MODE_SLOPE_GIMBAL]
        p_eta = (
            props[a + MODE_MASS] * nu_eta
            + engine_mass * (props[a + MODE_PHI_GIMBAL] + engine_arm * slope_a) * delta_rate[2]
            + engine_inertia * slope_a * turn_rate_y
        )
        p_xi = (
            props[b + MODE_MASS] * nu_xi
            + engine_mass * (props[b + MODE_PHI_GIMBAL] + engine_arm * slope_b) * delta_rate[1]
            - engine_inertia * slope_b * turn_rate_z
        )
        work[FORCE_PITCH + i] -= p * p_xi
        work[FORCE_YAW + i] += p * p_eta
        h += y[xi + i] * p_eta - y[eta + i] * p_xi
        roll -= p_eta * nu_xi - p_xi * nu_eta
    return (roll, -r * h, q * h)
