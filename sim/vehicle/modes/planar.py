"""Bending modes: free-free modes of the vehicle with its engine locked and its sloshing masses removed.

Mode i of the pitch plane displaces the body axis by phi_i(x) eta_i along z and rotates it by +slope_i eta_i about y. In
the yaw plane it displaces the axis by phi_i(x) xi_i along y and rotates it by -slope_i xi_i about z. The two planes
rotate with the body. With the quasi-velocities nu (state.py), the kinetic energy is a plain sum of squares, and the
roll rate appears only in the gyroscopic terms below (docs/model.md, section 4).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, NamedTuple

import numpy as np

from maxq.control.kernel.jit import kernel
from maxq.control.kernel.limits import MAX_MODES
from maxq.control.kernel.records import Array
from maxq.control.kernel.rows import DEG, PitchYaw, put
from maxq.control.kernel.vectors import Vector
from maxq.sim.vehicle import schedule as sch
from maxq.sim.vehicle.block import Counts, StateBlock
from maxq.sim.vehicle.modes.spatial import Load, SpatialModes, SpatialMotion

if TYPE_CHECKING:
    from maxq.sim.vehicle.modes.section import BendingSection, SpatialModesSection

_EXCESS = "a bending mode exceeds 10 m"
ETA_STATES = StateBlock({"eta_{}_m": "m"}, "pitch_modes", bound=10.0, excess=_EXCESS)
NU_PITCH_STATES = StateBlock({"nu_pitch_{}_mps": "m/s"}, "pitch_modes")
XI_STATES = StateBlock({"xi_{}_m": "m"}, "yaw_modes", bound=10.0, excess=_EXCESS)
NU_YAW_STATES = StateBlock({"nu_yaw_{}_mps": "m/s"}, "yaw_modes")


@dataclass(frozen=True)
class Bending:
    zeta_pitch: Annotated[Array, (MAX_MODES,)]
    zeta_yaw: Annotated[Array, (MAX_MODES,)]
    frequency_factor: Annotated[Array, (MAX_MODES,)]
    softening_factor: float  # 0 without axial softening


PerPlanarMode = Annotated[Array, (2 * MAX_MODES,)]  # pitch, then yaw


@dataclass
class PlanarMotion:
    """The modes in one evaluation of the derivative, with zeros up to a multiple of four in each plane."""

    force_N: PerPlanarMode  # generalised force
    eta_m: PerPlanarMode  # modal coordinate: eta in pitch, xi in yaw
    rate_mps: PerPlanarMode  # its time derivative
    nu_mps: PerPlanarMode  # its quasi-velocity
    accel_mps2: PerPlanarMode  # time derivative of the quasi-velocity
    roll_m: PerPlanarMode  # acceleration per roll acceleration with deflected engines


@dataclass
class Modes:
    planar: PlanarMotion
    spatial: SpatialMotion


@dataclass
class GimbalBending:
    """The motion of the first gimbal's station due to bending, in B."""

    moved_y_m: float
    moved_z_m: float
    slope_y_rad: float
    slope_z_rad: float


def pack_bending(given: BendingSection | SpatialModesSection | None, softening: bool) -> Bending:
    """Return the parameters from the stage's section `bending` (or None); both planes have the same damping ratios."""
    zeta, factor = np.zeros(MAX_MODES), np.ones(MAX_MODES)
    if given is not None:
        zeta[: len(given.damping_ratio)] = given.damping_ratio
        factor[: len(given.frequency_factor)] = given.frequency_factor
    return Bending(zeta, zeta, factor, 1.0 if softening else 0.0)


def pack_spatial_modes(given: SpatialModesSection | None) -> SpatialModes:
    """Return the parameters from the stage's section `spatial_modes` (or None)."""
    one = pack_bending(given, softening=False)
    return SpatialModes(one.zeta_pitch, one.frequency_factor)


@kernel
def of_plane(plane: int) -> int:
    """Return the index of the first mode of the plane PITCH or YAW in a modal quantity."""
    return plane * MAX_MODES


# A plane has up to MAX_MODES = 12 modes, processed four at a time without a loop: LLVM would unroll a loop of unknown
# length for lengths that do not occur.


@kernel
def modal_sum(sizes: Counts, properties: Array, row: int, quantity: Array, first: int) -> float:
    """Return the sum over a plane's modes of a row of the schedule (at its first column) times a modal quantity."""
    total = 0.0
    if sizes.mode_groups > 0:
        total = _sum_of_four(properties, row, quantity, first)
    if sizes.mode_groups > 1:
        total += _sum_of_four(properties, row + 4, quantity, first + 4)
    if sizes.mode_groups > 2:
        total += _sum_of_four(properties, row + 8, quantity, first + 8)
    return total


@kernel
def _sum_of_four(properties: Array, r: int, quantity: Array, q: int) -> float:
    ab = properties[r] * quantity[q] + properties[r + 1] * quantity[q + 1]
    cd = properties[r + 2] * quantity[q + 2] + properties[r + 3] * quantity[q + 3]
    total: float = ab + cd
    return total


@kernel
def add_to_modes(sizes: Counts, properties: Array, row: int, amount: float, quantity: Array, first: int) -> None:
    """Add a row of the schedule times `amount` to a modal quantity, as the generalised forces of a load at a point."""
    if sizes.mode_groups > 0:
        _add_to_four(properties, row, amount, quantity, first)
    if sizes.mode_groups > 1:
        _add_to_four(properties, row + 4, amount, quantity, first + 4)
    if sizes.mode_groups > 2:
        _add_to_four(properties, row + 8, amount, quantity, first + 8)


@kernel
def _add_to_four(properties: Array, r: int, amount: float, quantity: Array, q: int) -> None:
    a, b = quantity[q] + amount * properties[r], quantity[q + 1] + amount * properties[r + 1]
    c, d = quantity[q + 2] + amount * properties[r + 2], quantity[q + 3] + amount * properties[r + 3]
    quantity[q], quantity[q + 1], quantity[q + 2], quantity[q + 3] = a, b, c, d


@kernel
def clear_modes(sizes: Counts, quantity: Array) -> None:
    """Set a quantity of the modes of both planes to zero."""
    for plane in (sch.PITCH, sch.YAW):
        q = of_plane(plane)
        if sizes.mode_groups > 0:
            quantity[q], quantity[q + 1], quantity[q + 2], quantity[q + 3] = 0.0, 0.0, 0.0, 0.0
        if sizes.mode_groups > 1:
            quantity[q + 4], quantity[q + 5], quantity[q + 6], quantity[q + 7] = 0.0, 0.0, 0.0, 0.0
        if sizes.mode_groups > 2:
            quantity[q + 8], quantity[q + 9], quantity[q + 10], quantity[q + 11] = 0.0, 0.0, 0.0, 0.0


@kernel
def product_of_modes(sizes: Counts, a: Array, b: Array) -> float:
    """Return the sum of the products of two quantities over the modes of both planes."""
    in_pitch: float = modal_sum(sizes, a, of_plane(sch.PITCH), b, of_plane(sch.PITCH))
    in_yaw: float = modal_sum(sizes, a, of_plane(sch.YAW), b, of_plane(sch.YAW))
    return in_pitch + in_yaw


@kernel
def add_multiple_of_modes(sizes: Counts, of: Array, amount: float, quantity: Array) -> None:
    """Add `amount` times the modal quantity `of` to `quantity`, in both planes."""
    for plane in (sch.PITCH, sch.YAW):
        add_to_modes(sizes, of, of_plane(plane), amount, quantity, of_plane(plane))


@kernel
def modal_accelerations(sizes: Counts, properties: Array, forces: Array, accelerations: Array) -> None:
    """Set the accelerations of the modes of both planes under generalised forces."""
    for plane in (sch.PITCH, sch.YAW):
        row = sch.derived_column(sizes, plane, sch.MODE_INVERSE_MASS)
        q = of_plane(plane)
        if sizes.mode_groups > 0:
            _accelerate_four(properties, row, forces, accelerations, q)
        if sizes.mode_groups > 1:
            _accelerate_four(properties, row + 4, forces, accelerations, q + 4)
        if sizes.mode_groups > 2:
            _accelerate_four(properties, row + 8, forces, accelerations, q + 8)


@kernel
def _accelerate_four(properties: Array, r: int, force: Array, accel: Array, q: int) -> None:
    a, b = force[q] * properties[r], force[q + 1] * properties[r + 1]
    c, d = force[q + 2] * properties[r + 2], force[q + 3] * properties[r + 3]
    accel[q], accel[q + 1], accel[q + 2], accel[q + 3] = a, b, c, d


@kernel
def modal_state(sizes: Counts, roll_rate: float, y: Array, eta: int, xi: int, modes: PlanarMotion) -> None:
    """Compute `modes` from the states at y[eta:] (pitch plane) and y[xi:] (yaw plane).

    The states are modal coordinates and quasi-velocities, from which d(eta)/dt and d(xi)/dt are computed. The
    generalised forces are set to zero.
    """
    if sizes.mode_groups > 0:
        _state_of_four(sizes, 0, roll_rate, y, eta, xi, modes)
    if sizes.mode_groups > 1:
        _state_of_four(sizes, 4, roll_rate, y, eta, xi, modes)
    if sizes.mode_groups > 2:
        _state_of_four(sizes, 8, roll_rate, y, eta, xi, modes)


@kernel
def _state_of_four(
    sizes: Counts, first: int, roll_rate: float, y: Array, eta: int, xi: int, modes: PlanarMotion
) -> None:
    for i in range(first, first + 4):
        p, q = of_plane(sch.PITCH) + i, of_plane(sch.YAW) + i
        in_pitch, in_yaw, nu_pitch, nu_yaw, rate_pitch, rate_yaw = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        if i < sizes.pitch_modes:
            in_pitch, nu_pitch = y[eta + i], y[eta + sizes.pitch_modes + i]
        if i < sizes.yaw_modes:
            in_yaw, nu_yaw = y[xi + i], y[xi + sizes.yaw_modes + i]
            rate_yaw = nu_yaw + roll_rate * in_pitch
        if i < sizes.pitch_modes:
            rate_pitch = nu_pitch - roll_rate * in_yaw
        modes.eta_m[p], modes.eta_m[q] = in_pitch, in_yaw
        modes.nu_mps[p], modes.nu_mps[q] = nu_pitch, nu_yaw
        modes.rate_mps[p], modes.rate_mps[q] = rate_pitch, rate_yaw
        modes.force_N[p], modes.force_N[q] = 0.0, 0.0


@kernel
def modal_derivative(sizes: Counts, eta: int, xi: int, dy: Array, modes: PlanarMotion) -> None:
    """Write the derivatives of the states at y[eta:] and y[xi:], once the modal accelerations are known."""
    for i in range(sizes.pitch_modes):
        dy[eta + i] = modes.rate_mps[of_plane(sch.PITCH) + i]
        dy[eta + sizes.pitch_modes + i] = modes.accel_mps2[of_plane(sch.PITCH) + i]
    for i in range(sizes.yaw_modes):
        dy[xi + i] = modes.rate_mps[of_plane(sch.YAW) + i]
        dy[xi + sizes.yaw_modes + i] = modes.accel_mps2[of_plane(sch.YAW) + i]


@kernel
def gimbal_displacement(
    sizes: Counts, properties: Array, gimbal: int, modes: PlanarMotion
) -> tuple[float, float, float, float]:
    """Return displacement along y and z (m) and rotation about y and z (rad) of a gimbal's station due to bending."""
    return motion_at(sizes, properties, gimbal, modes.eta_m, of_plane(sch.PITCH), of_plane(sch.YAW))


@kernel
def motion_at(
    sizes: Counts, properties: Array, gimbal: int, quantity: Array, pitch: int, yaw: int
) -> tuple[float, float, float, float]:
    """Return the sums that `gimbal_displacement` returns, for another modal quantity.

    `pitch`, `yaw`: indices at which the modes of the pitch and yaw planes begin in `quantity`.
    """
    phi = sch.gimbal_row(sizes, gimbal)
    return (
        modal_sum(sizes, properties, sch.mode_column(sizes, sch.YAW, phi), quantity, yaw),
        modal_sum(sizes, properties, sch.mode_column(sizes, sch.PITCH, phi), quantity, pitch),
        modal_sum(sizes, properties, sch.mode_column(sizes, sch.PITCH, phi + 1), quantity, pitch),
        -modal_sum(sizes, properties, sch.mode_column(sizes, sch.YAW, phi + 1), quantity, yaw),
    )


@kernel
def bending_rate_at_gyro(sizes: Counts, properties: Array, modes: PlanarMotion) -> tuple[float, float]:
    """Return the angular rate about y and z due to bending at the gyro, rad/s."""
    return (
        modal_sum(
            sizes, properties, sch.mode_column(sizes, sch.PITCH, sch.MODE_SLOPE_GYRO), modes.nu_mps, of_plane(sch.PITCH)
        ),
        -modal_sum(
            sizes, properties, sch.mode_column(sizes, sch.YAW, sch.MODE_SLOPE_GYRO), modes.nu_mps, of_plane(sch.YAW)
        ),
    )


@kernel
def apply_gimbal_load(sizes: Counts, properties: Array, gimbal: int, load: Load, quantity: Array) -> None:
    """Add the generalised forces of a load on the body at a gimbal's station to a modal quantity."""
    _, force_y, force_z, _, moment_y, moment_z = load
    pitch, yaw, phi = of_plane(sch.PITCH), of_plane(sch.YAW), sch.gimbal_row(sizes, gimbal)
    add_to_modes(sizes, properties, sch.mode_column(sizes, sch.PITCH, phi), force_z, quantity, pitch)
    add_to_modes(sizes, properties, sch.mode_column(sizes, sch.PITCH, phi + 1), moment_y, quantity, pitch)
    add_to_modes(sizes, properties, sch.mode_column(sizes, sch.YAW, phi), force_y, quantity, yaw)
    add_to_modes(sizes, properties, sch.mode_column(sizes, sch.YAW, phi + 1), -moment_z, quantity, yaw)


@kernel
def elastic_forces(bending: Bending, sizes: Counts, properties: Array, axial_load: float, modes: PlanarMotion) -> float:
    """Add stiffness, damping and axial softening to the generalised forces, and return their roll moment on the body.

    The roll moment of these internal forces conserves the angular momentum about x. It is not zero if the two planes
    differ in stiffness or if the forces damp a whirling motion.
    """
    k_soft = bending.softening_factor * axial_load
    roll = 0.0
    if sizes.mode_groups > 0:
        roll = _elastic_forces_on_four(sizes, sch.YAW, 0, k_soft, properties, modes)
        roll -= _elastic_forces_on_four(sizes, sch.PITCH, 0, k_soft, properties, modes)
    if sizes.mode_groups > 1:
        roll += _elastic_forces_on_four(sizes, sch.YAW, 4, k_soft, properties, modes)
        roll -= _elastic_forces_on_four(sizes, sch.PITCH, 4, k_soft, properties, modes)
    if sizes.mode_groups > 2:
        roll += _elastic_forces_on_four(sizes, sch.YAW, 8, k_soft, properties, modes)
        roll -= _elastic_forces_on_four(sizes, sch.PITCH, 8, k_soft, properties, modes)
    return roll


@kernel
def _elastic_forces_on_four(
    sizes: Counts, plane: int, first: int, k_soft: float, properties: Array, modes: PlanarMotion
) -> float:
    """Add the forces of `elastic_forces` on four modes of one plane.

    Returns the sum of these forces times the coordinates of the other plane.
    """
    s = sch.derived_column(sizes, plane, sch.MODE_STIFFNESS) + first
    d = sch.derived_column(sizes, plane, sch.MODE_DAMPING) + first
    eta, rate, force = modes.eta_m, modes.rate_mps, modes.force_N
    q, o = of_plane(plane) + first, of_plane(1 - plane) + first
    f_0 = -(properties[s] * eta[q] + properties[d] * rate[q])
    f_1 = -(properties[s + 1] * eta[q + 1] + properties[d + 1] * rate[q + 1])
    f_2 = -(properties[s + 2] * eta[q + 2] + properties[d + 2] * rate[q + 2])
    f_3 = -(properties[s + 3] * eta[q + 3] + properties[d + 3] * rate[q + 3])
    for four in range(3):
        if four < sizes.mode_groups:
            for k in range(4 * four, 4 * four + 4):
                c = sch.mode_column(sizes, plane, sch.softening_row(sizes, k)) + first
                taken = k_soft * eta[of_plane(plane) + k]
                f_0 += taken * properties[c]
                f_1 += taken * properties[c + 1]
                f_2 += taken * properties[c + 2]
                f_3 += taken * properties[c + 3]
    roll: float = (f_0 * eta[o] + f_1 * eta[o + 1]) + (f_2 * eta[o + 2] + f_3 * eta[o + 3])
    f_0, f_1, f_2, f_3 = force[q] + f_0, force[q + 1] + f_1, force[q + 2] + f_2, force[q + 3] + f_3
    force[q], force[q + 1], force[q + 2], force[q + 3] = f_0, f_1, f_2, f_3
    return roll


@kernel
def gyroscopic_forces(
    sizes: Counts, properties: Array, gimbal: int, rate: Vector, engines: Load, modes: PlanarMotion
) -> Vector:
    """Add the roll-rate coupling of the two planes, and return the moment on the body of the modes' momentum about x.

    `engines` is the momentum of the engines at a gimbal's station relative to the body, and its moment about the axis
    at this station (`rigid.engine_momentum`). Both enter the modal momenta (docs/model.md, eq. 4.1). The modes' own
    momentum is included at the first station only.
    """
    p, q, r = rate
    mass, apart = sch.mode_column(sizes, sch.PITCH, sch.MODE_MASS), sch.mode_rows(sizes) * sch.padded_modes(sizes)
    phi = sch.mode_column(sizes, sch.PITCH, sch.gimbal_row(sizes, gimbal))
    slope = phi + sch.padded_modes(sizes)
    momentum_y, momentum_z, angular_y, angular_z = engines[1], engines[2], engines[4], -engines[5]
    own, h, roll = 1.0 if gimbal == 0 else 0.0, 0.0, 0.0
    for four in range(3):
        if four < sizes.mode_groups:
            for i in range(4 * four, 4 * four + 4):
                j = i + of_plane(sch.YAW)
                nu_eta, nu_xi = modes.nu_mps[i], modes.nu_mps[j]
                p_eta = own * properties[mass + i] * nu_eta + properties[phi + i] * momentum_z
                p_eta += properties[slope + i] * angular_y
                p_xi = own * properties[mass + apart + i] * nu_xi + properties[phi + apart + i] * momentum_y
                p_xi += properties[slope + apart + i] * angular_z
                modes.force_N[i] -= p * p_xi
                modes.force_N[j] += p * p_eta
                h += modes.eta_m[j] * p_eta - modes.eta_m[i] * p_xi
                roll -= p_eta * nu_xi - p_xi * nu_eta
    return (roll, -r * h, q * h)


class ModeRow(NamedTuple):
    """The logged values of a bending mode."""

    eta_mode_m: Annotated[float, "m", "modal coordinate (displacement of the gimbal)"]
    eta_mode_mps: Annotated[float, "m/s", "modal rate"]


class BendingRow(NamedTuple):
    """The log row of all bending modes."""

    bend_axis_gimbal_m: Annotated[PitchYaw, "m", "displacement of the gimbal by bending"]
    bend_axis_gimbal_deg: Annotated[PitchYaw, "deg", "rotation of the gimbal by bending"]


@kernel
def put_modes(row: Array, column: int, y: Array, first: int, count: int, logged: int) -> int:
    """Write the rows of `logged` modes of one plane, and return the next column.

    The values are nan for modes that the stage, with `count` modes, does not have.
    """
    for i in range(logged):
        if i < count:
            column = put(row, column, ModeRow(eta_mode_m=y[first + i], eta_mode_mps=y[first + count + i]))
        else:
            column = put(row, column, ModeRow(eta_mode_m=math.nan, eta_mode_mps=math.nan))
    return column


@kernel
def bending_row(gimbal: GimbalBending) -> BendingRow:
    return BendingRow(
        bend_axis_gimbal_m=PitchYaw(gimbal.moved_z_m, gimbal.moved_y_m),
        bend_axis_gimbal_deg=PitchYaw(DEG * gimbal.slope_y_rad, DEG * gimbal.slope_z_rad),
    )
