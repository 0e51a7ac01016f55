"""Bending modes: free-free modes of the vehicle with its engine locked and its sloshing masses removed.

Mode i of the pitch plane displaces the body axis by phi_i(x) eta_i along z and turns it by +slope_i eta_i about y; in
the yaw plane by phi_i(x) xi_i along y and -slope_i xi_i about z. The two planes turn with the body: with the
quasi-velocities nu (state.py) the kinetic energy is a plain sum of squares and the roll rate appears only in the
gyroscopic terms below (docs/model.md, section 4).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from maxq.control.kernel.jit import kernel
from maxq.control.kernel.records import Array
from maxq.control.kernel.vectors import Vector
from maxq.sim.vehicle.schedule import (
    MODE_DAMPING,
    MODE_MASS,
    MODE_PHI_GIMBAL,
    MODE_SLOPE_GIMBAL,
    MODE_SLOPE_GYRO,
    MODE_STIFFNESS,
    PITCH,
    YAW,
    following_column,
    fours,
    lanes,
    mode_column,
    mode_rows,
    softening_row,
)
from maxq.sim.vehicle.state import MAX_MODES, Counts, eta_index, xi_index
from maxq.sim.vehicle.workspace import ETA, FORCE, NU, RATE


@dataclass(frozen=True)
class Bending:
    zeta_pitch: Annotated[Array, (MAX_MODES,)]
    zeta_yaw: Annotated[Array, (MAX_MODES,)]
    frequency_factor: Annotated[Array, (MAX_MODES,)]
    softening_factor: float  # 0 without axial softening


@kernel
def of_plane(quantity: int, plane: int) -> int:
    """Where the workspace holds a modal quantity (FORCE, ETA, ...) of the plane PITCH or YAW."""
    return quantity + plane * MAX_MODES


# A plane has room for MAX_MODES = 8 modes, which kernels take four at a time without a loop: LLVM would unroll a loop
# whose length it does not know for lengths that never come.


@kernel
def modal_sum(sizes: Counts, props: Array, row: int, work: Array, quantity: int) -> float:
    """Sum over a plane's modes of a row of the schedule (its first column) times a modal quantity."""
    total = 0.0
    if fours(sizes) > 0:
        total = _sum_of_four(props, row, work, quantity)
    if fours(sizes) > 1:
        total += _sum_of_four(props, row + 4, work, quantity + 4)
    return total


@kernel
def _sum_of_four(props: Array, r: int, work: Array, q: int) -> float:
    ab = props[r] * work[q] + props[r + 1] * work[q + 1]
    cd = props[r + 2] * work[q + 2] + props[r + 3] * work[q + 3]
    total: float = ab + cd
    return total


@kernel
def push_modes(sizes: Counts, props: Array, row: int, amount: float, work: Array, quantity: int) -> None:
    """Add a row of the schedule times `amount` to a modal quantity: what a force does at a point with these shapes."""
    if fours(sizes) > 0:
        _push_four(props, row, amount, work, quantity)
    if fours(sizes) > 1:
        _push_four(props, row + 4, amount, work, quantity + 4)


@kernel
def _push_four(props: Array, r: int, amount: float, work: Array, q: int) -> None:
    a, b = work[q] + amount * props[r], work[q + 1] + amount * props[r + 1]
    c, d = work[q + 2] + amount * props[r + 2], work[q + 3] + amount * props[r + 3]
    work[q], work[q + 1], work[q + 2], work[q + 3] = a, b, c, d


@kernel
def scale_modes(sizes: Counts, props: Array, row: int, work: Array, quantity: int) -> None:
    """Multiply a modal quantity by a row of the schedule."""
    if fours(sizes) > 0:
        _scale_four(props, row, work, quantity)
    if fours(sizes) > 1:
        _scale_four(props, row + 4, work, quantity + 4)


@kernel
def _scale_four(props: Array, r: int, work: Array, q: int) -> None:
    a, b, c, d = work[q] * props[r], work[q + 1] * props[r + 1], work[q + 2] * props[r + 2], work[q + 3] * props[r + 3]
    work[q], work[q + 1], work[q + 2], work[q + 3] = a, b, c, d


@kernel
def modal_state(sizes: Counts, roll_rate: float, y: Array, work: Array) -> None:
    """Modal coordinates, quasi-velocities and from them d(eta)/dt, d(xi)/dt; generalised forces set to zero."""
    if fours(sizes) > 0:
        _state_of_four(sizes, 0, roll_rate, y, work)
    if fours(sizes) > 1:
        _state_of_four(sizes, 4, roll_rate, y, work)


@kernel
def _state_of_four(sizes: Counts, first: int, roll_rate: float, y: Array, work: Array) -> None:
    eta, xi = eta_index(sizes), xi_index(sizes)
    for i in range(first, first + 4):
        p, q = of_plane(0, PITCH) + i, of_plane(0, YAW) + i
        in_pitch, in_yaw, nu_pitch, nu_yaw, rate_pitch, rate_yaw = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        if i < sizes.pitch_modes:
            in_pitch, nu_pitch = y[eta + i], y[eta + sizes.pitch_modes + i]
        if i < sizes.yaw_modes:
            in_yaw, nu_yaw = y[xi + i], y[xi + sizes.yaw_modes + i]
            rate_yaw = nu_yaw + roll_rate * in_pitch
        if i < sizes.pitch_modes:
            rate_pitch = nu_pitch - roll_rate * in_yaw
        work[ETA + p], work[ETA + q] = in_pitch, in_yaw
        work[NU + p], work[NU + q] = nu_pitch, nu_yaw
        work[RATE + p], work[RATE + q] = rate_pitch, rate_yaw
        work[FORCE + p], work[FORCE + q] = 0.0, 0.0


@kernel
def modal_derivative(sizes: Counts, y: Array, dy: Array, work: Array) -> None:
    """Derivatives of the modal part of the state, once FORCE holds the accelerations."""
    eta, xi = eta_index(sizes), xi_index(sizes)
    for i in range(sizes.pitch_modes):
        dy[eta + i] = work[of_plane(RATE, PITCH) + i]
        dy[eta + sizes.pitch_modes + i] = work[of_plane(FORCE, PITCH) + i]
    for i in range(sizes.yaw_modes):
        dy[xi + i] = work[of_plane(RATE, YAW) + i]
        dy[xi + sizes.yaw_modes + i] = work[of_plane(FORCE, YAW) + i]


@kernel
def bend_at_gimbal(sizes: Counts, props: Array, work: Array) -> tuple[float, float, float, float]:
    """Displacement along y and z (m) and turning about y and z (rad) of the gimbal by bending."""
    pitch, yaw = of_plane(ETA, PITCH), of_plane(ETA, YAW)
    return (
        modal_sum(sizes, props, mode_column(sizes, YAW, MODE_PHI_GIMBAL), work, yaw),
        modal_sum(sizes, props, mode_column(sizes, PITCH, MODE_PHI_GIMBAL), work, pitch),
        modal_sum(sizes, props, mode_column(sizes, PITCH, MODE_SLOPE_GIMBAL), work, pitch),
        -modal_sum(sizes, props, mode_column(sizes, YAW, MODE_SLOPE_GIMBAL), work, yaw),
    )


@kernel
def bend_rate_at_gyro(sizes: Counts, props: Array, work: Array) -> tuple[float, float]:
    """Turning rate about y and z that bending adds at the gyro, rad/s."""
    return (
        modal_sum(sizes, props, mode_column(sizes, PITCH, MODE_SLOPE_GYRO), work, of_plane(NU, PITCH)),
        -modal_sum(sizes, props, mode_column(sizes, YAW, MODE_SLOPE_GYRO), work, of_plane(NU, YAW)),
    )


GimbalPush = tuple[float, float, float, float]  # forces along y and z, moments about y and z, at the gimbal, in B


@kernel
def push_at_gimbal(sizes: Counts, props: Array, push: GimbalPush, work: Array) -> None:
    """Add the generalised forces of what acts on the body at the gimbal."""
    force_y, force_z, moment_y, moment_z = push
    pitch, yaw = of_plane(FORCE, PITCH), of_plane(FORCE, YAW)
    push_modes(sizes, props, mode_column(sizes, PITCH, MODE_PHI_GIMBAL), force_z, work, pitch)
    push_modes(sizes, props, mode_column(sizes, PITCH, MODE_SLOPE_GIMBAL), moment_y, work, pitch)
    push_modes(sizes, props, mode_column(sizes, YAW, MODE_PHI_GIMBAL), force_y, work, yaw)
    push_modes(sizes, props, mode_column(sizes, YAW, MODE_SLOPE_GIMBAL), -moment_z, work, yaw)


@kernel
def elastic_forces(bending: Bending, sizes: Counts, props: Array, axial_load: float, work: Array) -> float:
    """Add stiffness, damping and axial softening to the generalised forces.

    Returns the roll moment that these internal forces leave on the body when the two planes differ in stiffness or
    while they damp a whirling motion: it keeps the angular momentum about x whole.
    """
    k_soft = bending.softening_factor * axial_load
    roll = 0.0
    if fours(sizes) > 0:
        roll = _elastic_forces_on_four(sizes, YAW, 0, k_soft, props, work)
        roll -= _elastic_forces_on_four(sizes, PITCH, 0, k_soft, props, work)
    if fours(sizes) > 1:
        roll += _elastic_forces_on_four(sizes, YAW, 4, k_soft, props, work)
        roll -= _elastic_forces_on_four(sizes, PITCH, 4, k_soft, props, work)
    return roll


@kernel
def _elastic_forces_on_four(
    sizes: Counts, plane: int, first: int, k_soft: float, props: Array, work: Array
) -> float:  # fmt: skip
    """The same on four modes of one plane; returns the sum of their forces times the other plane's coordinates."""
    s = following_column(sizes, plane, MODE_STIFFNESS) + first
    d = following_column(sizes, plane, MODE_DAMPING) + first
    e, r, o = of_plane(ETA, plane) + first, of_plane(RATE, plane) + first, of_plane(ETA, 1 - plane) + first
    f_0 = -(props[s] * work[e] + props[d] * work[r])
    f_1 = -(props[s + 1] * work[e + 1] + props[d + 1] * work[r + 1])
    f_2 = -(props[s + 2] * work[e + 2] + props[d + 2] * work[r + 2])
    f_3 = -(props[s + 3] * work[e + 3] + props[d + 3] * work[r + 3])
    for half in range(2):
        if half < fours(sizes):
            for k in range(4 * half, 4 * half + 4):
                c, taken = (
                    mode_column(sizes, plane, softening_row(sizes, k)) + first,
                    k_soft * work[of_plane(ETA, plane) + k],
                )
                f_0 += taken * props[c]
                f_1 += taken * props[c + 1]
                f_2 += taken * props[c + 2]
                f_3 += taken * props[c + 3]
    q = of_plane(FORCE, plane) + first
    roll: float = (f_0 * work[o] + f_1 * work[o + 1]) + (f_2 * work[o + 2] + f_3 * work[o + 3])
    f_0, f_1, f_2, f_3 = work[q] + f_0, work[q + 1] + f_1, work[q + 2] + f_2, work[q + 3] + f_3
    work[q], work[q + 1], work[q + 2], work[q + 3] = f_0, f_1, f_2, f_3
    return roll


@kernel
def gyroscopic_forces(
    sizes: Counts, props: Array, rate: Vector, engine_mass: float, engine_arm: float, engine_inertia: float,
    delta_rate: Vector, turn_rate_y: float, turn_rate_z: float, work: Array,
) -> Vector:  # fmt: skip
    """Roll-rate coupling of the two planes, and the moment of the modes' angular momentum about x on the body.

    `delta_rate` is the velocity of the engine's CG relative to the straight engine, `turn_rate_*` the engine's turning
    rate relative to the gimbal's: they are part of the modal momenta (docs/model.md, eq. 4.6).
    """
    p, q, r = rate
    mass, apart = mode_column(sizes, PITCH, MODE_MASS), mode_rows(sizes) * lanes(sizes)
    phi, slope = mode_column(sizes, PITCH, MODE_PHI_GIMBAL), mode_column(sizes, PITCH, MODE_SLOPE_GIMBAL)
    push_z, push_y = engine_mass * delta_rate[2], engine_mass * delta_rate[1]
    twist_y = engine_arm * push_z + engine_inertia * turn_rate_y
    twist_z = engine_arm * push_y - engine_inertia * turn_rate_z
    h, roll = 0.0, 0.0
    for half in range(2):
        if half < fours(sizes):
            for i in range(4 * half, 4 * half + 4):
                j = i + of_plane(0, YAW)
                nu_eta, nu_xi = work[NU + i], work[NU + j]
                p_eta = props[mass + i] * nu_eta + props[phi + i] * push_z + props[slope + i] * twist_y
                p_xi = props[mass + apart + i] * nu_xi + props[phi + apart + i] * push_y
                p_xi += props[slope + apart + i] * twist_z
                work[FORCE + i] -= p * p_xi
                work[FORCE + j] += p * p_eta
                h += work[ETA + j] * p_eta - work[ETA + i] * p_xi
                roll -= p_eta * nu_xi - p_xi * nu_eta
    return (roll, -r * h, q * h)
