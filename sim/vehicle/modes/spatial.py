"""Spatial modes: coupled three-dimensional free-free modes of the vehicle, engine locked and sloshing masses removed.

Mode i displaces the point of the body axis at station x by the vector Phi_i(x) eta_i and rotates its section by
Theta_i(x) eta_i. Both vectors have components in all three axes of B. Hence bending in both planes, torsion and axial
motion may be coupled. A planar mode of planar.py is the special case Phi = (0, 0, phi), Theta = (0, slope, 0) in pitch
and Phi = (0, phi, 0), Theta = (0, 0, -slope) in yaw. The quasi-velocities nu = d(eta)/dt + p A eta include the rotation
with the roll rate. A contains the share of each mode in the shape of another mode rotated by 90 deg about x
(docs/model.md, section 4).

A *place* is a station at which loads or sensors act (schedule.py). A load is six numbers: force (N) and moment (N m) in
B on the section of its place. A motion is also six numbers: displacement and rotation.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from maxq.control.kernel.jit import kernel, routine
from maxq.control.kernel.limits import MAX_MODES
from maxq.control.kernel.records import Array
from maxq.control.kernel.vectors import Vector
from maxq.sim.vehicle import schedule as sch
from maxq.sim.vehicle.block import Counts, StateBlock

SPATIAL_STATES = StateBlock(
    {"eta_spatial_{}_m": "m"}, "spatial_modes", bound=10.0, excess="a spatial mode exceeds 10 m"
)
NU_SPATIAL_STATES = StateBlock({"nu_spatial_{}_mps": "m/s"}, "spatial_modes")

PerSpatialMode = Annotated[Array, (MAX_MODES,)]
Load = tuple[float, float, float, float, float, float]  # force and moment, or displacement and rotation, in B


@kernel
def sum_of_loads(a: Load, b: Load) -> Load:
    return a[0] + b[0], a[1] + b[1], a[2] + b[2], a[3] + b[3], a[4] + b[4], a[5] + b[5]


@dataclass(frozen=True)
class SpatialModes:
    zeta: PerSpatialMode
    frequency_factor: PerSpatialMode


@dataclass
class SpatialMotion:
    """The modes in one evaluation of the derivative."""

    force_N: PerSpatialMode  # generalised force
    eta_m: PerSpatialMode  # modal coordinate
    rate_mps: PerSpatialMode  # its time derivative
    nu_mps: PerSpatialMode  # its quasi-velocity
    accel_mps2: PerSpatialMode  # time derivative of the quasi-velocity
    turned_m: PerSpatialMode  # A eta (eq. 4.7)
    turned_rate_mps: PerSpatialMode  # A d(eta)/dt
    momentum_Ns: PerSpatialMode  # contribution of the moving engine to the modal momentum
    roll_m: PerSpatialMode  # acceleration per roll acceleration with deflected engines


@routine
def spatial_state(
    sizes: Counts, roll_rate: float, properties: Array, y: Array, first: int, modes: SpatialMotion
) -> None:
    """Compute `modes` from the states at y[first:], and set the generalised forces to zero."""
    n = sizes.spatial_modes
    for i in range(n):
        modes.eta_m[i], modes.nu_mps[i] = y[first + i], y[first + n + i]
        modes.force_N[i], modes.momentum_Ns[i] = 0.0, 0.0
    _turn(sizes, properties, modes.eta_m, modes.turned_m)
    for i in range(n):
        modes.rate_mps[i] = modes.nu_mps[i] - roll_rate * modes.turned_m[i]
    _turn(sizes, properties, modes.rate_mps, modes.turned_rate_mps)


@kernel
def _turn(sizes: Counts, properties: Array, quantity: Array, turned: Array) -> None:
    """Write A times a modal quantity to `turned`."""
    for i in range(sizes.spatial_modes):
        total = 0.0
        for j in range(sizes.spatial_modes):
            total += properties[sch.spatial_column(sizes, sch.turning_row(sizes, j)) + i] * quantity[j]
        turned[i] = total


@routine
def spatial_derivative(sizes: Counts, first: int, dy: Array, modes: SpatialMotion) -> None:
    """Write the derivatives of the states at y[first:], once the modal accelerations are known."""
    for i in range(sizes.spatial_modes):
        dy[first + i] = modes.rate_mps[i]
        dy[first + sizes.spatial_modes + i] = modes.accel_mps2[i]


@kernel
def spatial_motion(sizes: Counts, properties: Array, place: int, quantity: Array) -> Load:
    """Return the motion of a place: its shapes times a modal quantity."""
    return _spatial_motion(sizes, properties, place, quantity)


@routine
def _spatial_motion(sizes: Counts, properties: Array, place: int, quantity: Array) -> Load:
    x, y, z, about_x, about_y, about_z = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    n, c = sizes.spatial_modes, sch.place_column(sizes, place, 0)
    for i in range(n):
        amount = quantity[i]
        x += properties[c + i] * amount
        y += properties[c + n + i] * amount
        z += properties[c + 2 * n + i] * amount
        about_x += properties[c + 3 * n + i] * amount
        about_y += properties[c + 4 * n + i] * amount
        about_z += properties[c + 5 * n + i] * amount
    return x, y, z, about_x, about_y, about_z


@kernel
def roll_defect(sizes: Counts, properties: Array, place: int, quantity: Array, turned: Array) -> Load:
    """Return the motion of a place per roll rate not included in the quasi-velocities: (x cross Phi) eta - Phi A eta.

    `quantity`, `turned`: `eta_m` with `turned_m`, or their rates. The motion is zero if the rotated shapes are also
    modes. Source: docs/model.md, eq. 4.9.
    """
    whole = spatial_motion(sizes, properties, place, quantity)
    held = spatial_motion(sizes, properties, place, turned)
    return -held[0], -whole[2] - held[1], whole[1] - held[2], -held[3], -whole[5] - held[4], whole[4] - held[5]


@kernel
def apply_spatial_load(sizes: Counts, properties: Array, place: int, load: Load, quantity: Array) -> None:
    """Add the generalised forces of a load at a place to a modal quantity."""
    _apply_spatial_load(sizes, properties, place, load, quantity)


@routine
def _apply_spatial_load(sizes: Counts, properties: Array, place: int, load: Load, quantity: Array) -> None:
    n, c = sizes.spatial_modes, sch.place_column(sizes, place, 0)
    for i in range(n):
        force = properties[c + i] * load[0] + properties[c + n + i] * load[1] + properties[c + 2 * n + i] * load[2]
        moment = properties[c + 3 * n + i] * load[3] + properties[c + 4 * n + i] * load[4]
        quantity[i] += force + (moment + properties[c + 5 * n + i] * load[5])


@routine
def outer_spatial_load(sizes: Counts, properties: Array, place: int, load: Load, modes: SpatialMotion) -> Vector:
    """Add the generalised forces of an external load (thrust, air, a pendulum) at the displaced place.

    Returns the moment on the body (B, N m) in addition to that of the force at the undisplaced place.
    """
    apply_spatial_load(sizes, properties, place, load, modes.force_N)
    moved = spatial_motion(sizes, properties, place, modes.eta_m)
    defect = roll_defect(sizes, properties, place, modes.eta_m, modes.turned_m)
    roll = defect[0] * load[0] + defect[1] * load[1] + defect[2] * load[2]
    roll += defect[3] * load[3] + defect[4] * load[4] + defect[5] * load[5]
    return roll, moved[2] * load[0] - moved[0] * load[2], moved[0] * load[1] - moved[1] * load[0]


@routine
def spatial_rate_at_gyro(sizes: Counts, roll_rate: float, properties: Array, modes: SpatialMotion) -> Vector:
    """Return the angular rate (B, rad/s) due to the modes at the gyro."""
    of_modes = spatial_motion(sizes, properties, sch.GYRO_PLACE, modes.nu_mps)
    defect = roll_defect(sizes, properties, sch.GYRO_PLACE, modes.eta_m, modes.turned_m)
    return (
        of_modes[3] + roll_rate * defect[3],
        of_modes[4] + roll_rate * defect[4],
        of_modes[5] + roll_rate * defect[5],
    )


@routine
def spatial_elastic_forces(sizes: Counts, properties: Array, k_soft: float, modes: SpatialMotion) -> float:
    """Add stiffness, damping and axial softening to the generalised forces, and return their roll moment on the body.

    `k_soft`: softening factor times axial load, m/s2.
    """
    roll = 0.0
    stiffness, damping = sch.spatial_derived(sizes, sch.MODE_STIFFNESS), sch.spatial_derived(sizes, sch.MODE_DAMPING)
    for i in range(sizes.spatial_modes):
        force = -(properties[stiffness + i] * modes.eta_m[i] + properties[damping + i] * modes.rate_mps[i])
        for j in range(sizes.spatial_modes):
            taken = properties[sch.spatial_column(sizes, sch.spatial_softening_row(sizes, j)) + i]
            force += k_soft * taken * modes.eta_m[j]
        modes.force_N[i] += force
        roll -= force * modes.turned_m[i]
    return roll


@routine
def spatial_gyroscopic(sizes: Counts, properties: Array, rate: Vector, modes: SpatialMotion) -> Vector:
    """Add the roll-rate coupling of the modes, and return the moment on the body of their angular momentum about x.

    `momentum_Ns` contains the contribution of moving engines to the modal momenta. Source: docs/model.md, eq. 4.8.
    """
    p, q, r = rate
    mass, n = sch.spatial_column(sizes, sch.SPATIAL_MASS), sizes.spatial_modes
    h, roll = 0.0, 0.0
    for i in range(n):
        momentum = properties[mass + i] * modes.nu_mps[i] + modes.momentum_Ns[i]
        h += momentum * modes.turned_m[i]
        for j in range(n):
            share = properties[sch.spatial_column(sizes, sch.turning_row(sizes, j)) + i]  # A_ij
            modes.force_N[j] += p * (share * momentum)
            roll -= momentum * (share * modes.nu_mps[j])
    return roll, -r * h, q * h


@routine
def free_spatial_accelerations(sizes: Counts, properties: Array, modes: SpatialMotion) -> None:
    """Set the accelerations of the modes under their generalised forces, without the tensions of the pendulums."""
    inverse = sch.spatial_derived(sizes, sch.MODE_INVERSE_MASS)
    for i in range(sizes.spatial_modes):
        modes.accel_mps2[i] = properties[inverse + i] * modes.force_N[i]


@routine
def spatial_along_rod(
    sizes: Counts, properties: Array, place: int, u: Vector, accel_mps2: Array, shapes: Array
) -> float:
    """Write the shapes at a hinge along its rod `u` to `shapes`, and return its acceleration due to `accel_mps2`."""
    n, c, total = sizes.spatial_modes, sch.place_column(sizes, place, 0), 0.0
    for i in range(n):
        along = properties[c + i] * u[0] + properties[c + n + i] * u[1] + properties[c + 2 * n + i] * u[2]
        shapes[i] = along
        total += along * accel_mps2[i]
    return total


@routine
def spatial_compliance(sizes: Counts, properties: Array, shapes: Array, of_other: Array) -> float:
    """Return the acceleration of a hinge along its rod per newton of tension in another tank, 1/kg.

    `shapes`, `of_other`: shapes at the two hinges along their rods.
    """
    inverse, total = sch.spatial_derived(sizes, sch.MODE_INVERSE_MASS), 0.0
    for i in range(sizes.spatial_modes):
        total += shapes[i] * (of_other[i] * properties[inverse + i])
    return total


@routine
def add_tension_to_spatial(sizes: Counts, properties: Array, shapes: Array, tension: float, accel_mps2: Array) -> None:
    """Add the effect of a rod's tension, with `shapes` along the rod, to the modal accelerations."""
    inverse = sch.spatial_derived(sizes, sch.MODE_INVERSE_MASS)
    for i in range(sizes.spatial_modes):
        accel_mps2[i] += tension * (shapes[i] * properties[inverse + i])
