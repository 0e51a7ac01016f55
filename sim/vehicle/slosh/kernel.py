"""Sloshing propellant: spherical pendulums at any angle, coupled through the tension of their rods.

There is one pendulum for each simulated slosh mode of a tank. Here and in `Sizes`, "tank" means one pendulum.

The bob of mass m hangs on a massless rod of length L from a hinge on the bent body axis. Only the tension of the rod
and the damping act between bob and body. Damping is viscous and acts on the velocity of the bob relative to the
adjacent point of the body. Its reaction acts on the body at that same point. Hence damping dissipates energy in any
motion and conserves the angular momentum (docs/model.md, section 5). With the reaction at the hinge, as in Lee, Ahn &
Roh eq. 27, the moment arm of the damper would be lost.

accelerations.py solves for the tensions and all accelerations together, from the quantities in `TankWork` of every
tank.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, NamedTuple

import numpy as np

from maxq.control.kernel.jit import kernel, routine
from maxq.control.kernel.limits import MAX_PENDULUMS
from maxq.control.kernel.records import Array
from maxq.control.kernel.rows import DEG
from maxq.control.kernel.vectors import Vector, add, cross, dot, scaled, set_vector, vector_at
from maxq.sim.vehicle import schedule as sch
from maxq.sim.vehicle.block import W_BI_B, Counts, Sizes, StateBlock
from maxq.sim.vehicle.modes.planar import Modes, PlanarMotion, modal_sum, of_plane
from maxq.sim.vehicle.modes.spatial import PerSpatialMode, roll_defect, spatial_motion

if TYPE_CHECKING:
    from maxq.sim.vehicle.modes.section import BendingSection
    from maxq.sim.vehicle.slosh.packing import Pendulum

# The unit vector u_B from the hinge to the bob, and kappa_B, its inertial derivative in body components.
PENDULUMS = StateBlock(
    {f"slosh_{{}}_u_{a}": "1" for a in "xyz"} | {f"slosh_{{}}_kappa_{a}_1ps": "1/s" for a in "xyz"}, "pendulums"
)
N_PENDULUM = len(PENDULUMS.states)

# the inverse of the first Fourier coefficient of |cos|^(1/2) cos
RING_DRAG = 0.5 * math.sqrt(math.pi) * math.gamma(2.25) / math.gamma(1.75)


@dataclass
class TankWork:
    """A tank in one evaluation of the derivative; motion along x is due to spatial modes only."""

    arm_m: Annotated[Array, (3,)]  # moment of a unit tension about the CG with deflected engines, B
    hinge_accel_mps2: Annotated[Array, (3,)]  # of the hinge, without the contribution of the unknown accelerations, B
    shift_m: Annotated[Array, (3,)]  # displacement of the hinge by bending
    demand_mps2: float  # tension per bob mass at zero acceleration
    alpha_radps2pN: Annotated[Array, (3,)]  # angular acceleration of the body per unit tension
    hinge_m: Annotated[Array, (3,)]  # relative to the core CG without bending, B
    damping_mps2: Annotated[Array, (3,)]  # acceleration of the bob by damping, B
    asymmetry_m: Annotated[Array, (3,)]  # see `_plane_asymmetry`
    damper_force_N: Annotated[Array, (3,)]  # force of the damper on the bent axis
    bending_accel_mps2: Annotated[Array, (3,)]  # of the hinge by bending
    roll_bend_y_m: float  # acceleration of the hinge by planar modes per roll acceleration with deflected engines
    roll_bend_z_m: float
    # relative to the core CG, B; this and the next field only with `Slosh.exchange`
    bob_place_m: Annotated[Array, (3,)]
    bob_velocity_mps: Annotated[Array, (3,)]  # relative to the core CG, B
    shapes_along_rod: PerSpatialMode  # of spatial modes at the hinge


Tanks = tuple[TankWork, ...]


@dataclass(frozen=True)
class Slosh:
    planes_differ: int  # 1: pitch and yaw modes have different shapes, or one plane has none
    damping_ratio: Annotated[Array, (MAX_PENDULUMS,)]  # of the pendulum under the current axial acceleration
    law: int  # 1: a pendulum has damping in addition to its ratio
    law_factor: Annotated[Array, (MAX_PENDULUMS,)]  # of the columns TANK_VISCOUS and TANK_RING
    ring_damping: Annotated[Array, (MAX_PENDULUMS,)]  # see column TANK_RING
    breaking_height_m: Annotated[Array, (MAX_PENDULUMS,)]  # of a wave; 0: that of linear theory (`wave_share`)
    exchange: int  # 1: mass exchanged between bob and core keeps its momentum
    place_y_m: Annotated[Array, (MAX_PENDULUMS,)]  # of the tank's axis from the body axis
    place_z_m: Annotated[Array, (MAX_PENDULUMS,)]


def pack_slosh(pendulums: Sequence[Pendulum], bending: BendingSection | None, exchange: bool) -> Slosh:
    """Return the parameters from the stage's pendulums (slosh/packing.py) and its section `bending` (or None)."""
    n = len(pendulums)
    zeta, height, factor, none = (np.full(MAX_PENDULUMS, x) for x in (0.0, 0.0, 1.0, 0.0))
    zeta[:n], height[:n] = [p.damping_ratio for p in pendulums], [p.breaking_height_m for p in pendulums]
    factor[:n] = [p.tank.damping_factor for p in pendulums]
    law = any(p.has_law for p in pendulums)
    planes_differ = bending is not None and bending.pitch != bending.yaw
    places = np.zeros((2, MAX_PENDULUMS))
    places[:, :n] = np.reshape([p.place_m for p in pendulums], (n, 2)).T
    return Slosh(int(planes_differ), zeta, int(law), factor, none, height, int(exchange), *places)


@kernel
def pendulum_length(properties: Array, tank: int) -> float:
    length: float = properties[sch.tank_column(tank) + sch.TANK_LENGTH]
    return length


@kernel
def bob_mass(properties: Array, tank: int) -> float:
    mass: float = properties[sch.tank_column(tank) + sch.TANK_MASS]
    return mass


@kernel
def pendulum_start(y: Array, first: int, rate: Vector) -> None:
    """Set the pendulum aft of its hinge, at rest relative to a body that turns at `rate` (B, rad/s)."""
    aft = (-1.0, 0.0, 0.0)
    set_vector(y, first, aft)
    set_vector(y, first + 3, cross(rate, aft))


@kernel
def restore_pendulum(y: Array, first: int) -> None:
    """Normalise the unit vector, and make its derivative perpendicular to it."""
    u = vector_at(y, first)
    scale = 1.0 / math.sqrt(u[0] * u[0] + u[1] * u[1] + u[2] * u[2])
    u = (u[0] * scale, u[1] * scale, u[2] * scale)
    kappa = vector_at(y, first + 3)
    along = u[0] * kappa[0] + u[1] * kappa[1] + u[2] * kappa[2]
    set_vector(y, first, u)
    set_vector(y, first + 3, (kappa[0] - along * u[0], kappa[1] - along * u[1], kappa[2] - along * u[2]))


@kernel
def pendulum_loads(
    slosh: Slosh,
    sizes: Counts,
    tank: int,
    rate: Vector,
    axial_load: float,
    offset: Vector,
    properties: Array,
    y: Array,
    first: int,
    modes: Modes,
    own: TankWork,
) -> tuple[Vector, Vector]:
    """Fill `own` of a tank, and return the force and moment (about the core CG) of its damper, B.

    The states of the pendulum are y[first:first+6]. `offset` is the vector from the core CG to the CG with deflected
    engines.
    """
    p, q, r = rate
    column, spatial = sch.tank_column(tank), modes.spatial
    u, kappa = vector_at(y, first), vector_at(y, first + 3)
    length = pendulum_length(properties, tank)
    hinge = (
        properties[sch.CORE_CG] - properties[column + sch.TANK_HINGE],
        slosh.place_y_m[tank] - properties[sch.CORE_CG + 1],
        slosh.place_z_m[tank] - properties[sch.CORE_CG + 2],
    )
    shift_y, shift_z, shift_rate_y, shift_rate_z, nu_y, nu_z = _bending_at_tank(sizes, tank, properties, modes.planar)
    # Velocity of the hinge due to bending, with the rotation of the bent axis (docs/model.md, eq. 5.1).
    bend = (q * shift_z - r * shift_y, nu_y, nu_z)
    asymmetry_y, asymmetry_z, asymmetry_rate_y, asymmetry_rate_z = 0.0, 0.0, 0.0, 0.0
    if slosh.planes_differ == 1:
        asymmetry = _plane_asymmetry(sizes, tank, properties, modes.planar)
        asymmetry_y, asymmetry_z, asymmetry_rate_y, asymmetry_rate_z = asymmetry
        bend = (bend[0], bend[1] - p * asymmetry_z, bend[2] + p * asymmetry_y)
    shift_x, shift_rate_x, asymmetry_x, asymmetry_rate_x = 0.0, 0.0, 0.0, 0.0
    if sizes.spatial_modes > 0:
        at = sch.tank_place(tank)
        moved = spatial_motion(sizes, properties, at, spatial.eta_m)
        moving = spatial_motion(sizes, properties, at, spatial.rate_mps)
        nu = spatial_motion(sizes, properties, at, spatial.nu_mps)
        defect = roll_defect(sizes, properties, at, spatial.eta_m, spatial.turned_m)
        defect_rate = roll_defect(sizes, properties, at, spatial.rate_mps, spatial.turned_rate_mps)
        shift_x, shift_y, shift_z = moved[0], shift_y + moved[1], shift_z + moved[2]
        shift_rate_x = moving[0]
        shift_rate_y, shift_rate_z = shift_rate_y + moving[1], shift_rate_z + moving[2]
        asymmetry_x, asymmetry_y, asymmetry_z = defect[0], asymmetry_y + defect[2], asymmetry_z - defect[1]
        asymmetry_rate_x = defect_rate[0]
        asymmetry_rate_y, asymmetry_rate_z = asymmetry_rate_y + defect_rate[2], asymmetry_rate_z - defect_rate[1]
        bend = (
            bend[0] + q * moved[2] - r * moved[1] + nu[0] + p * defect[0],
            bend[1] + r * moved[0] + nu[1] + p * defect[1],
            bend[2] - q * moved[0] + nu[2] + p * defect[2],
        )
    accel = add(cross(rate, cross(rate, hinge)), cross(rate, bend))
    if sizes.spatial_modes > 0:
        accel = (accel[0] + p * asymmetry_rate_x, accel[1] + r * shift_rate_x, accel[2] - q * shift_rate_x)
    accel = (accel[0], accel[1] - p * asymmetry_rate_z, accel[2] + p * asymmetry_rate_y)
    # The bob moves aft with the surface of the liquid, which causes a Coriolis acceleration.
    travel = 2.0 * properties[column + sch.TANK_TRAVEL]
    accel = (accel[0] + q * shift_rate_z - r * shift_rate_y, accel[1] - travel * r, accel[2] + travel * q)
    arm = cross((hinge[0] - offset[0], hinge[1] - offset[1], hinge[2] - offset[2]), u)
    roll_arm = arm[0] + asymmetry_y * u[2] - asymmetry_z * u[1]
    arm = (roll_arm, arm[1] + shift_z * u[0], arm[2] - shift_y * u[0])
    if sizes.spatial_modes > 0:
        arm = (arm[0] + asymmetry_x * u[0], arm[1] - shift_x * u[2], arm[2] + shift_x * u[1])
    set_vector(own.arm_m, 0, arm)
    set_vector(own.hinge_accel_mps2, 0, accel)
    set_vector(own.hinge_m, 0, hinge)
    own.shift_m[1], own.shift_m[2] = shift_y, shift_z
    own.asymmetry_m[1], own.asymmetry_m[2] = asymmetry_y, asymmetry_z
    own.demand_mps2 = length * dot(kappa, kappa) - dot(accel, u)
    u_rate = add(kappa, scaled(-1.0, cross(rate, u)))  # d(u)/dt in B
    # 2 zeta omega L with omega = sqrt(a / L)
    damping = scaled(-2.0 * slosh.damping_ratio[tank] * math.sqrt(abs(axial_load) * length), u_rate)
    if slosh.law == 1:
        drag = wall_and_ring_damping(slosh, tank, length, abs(axial_load), math.sqrt(dot(u_rate, u_rate)), properties)
        damping = add(damping, scaled(-drag, u_rate))
    set_vector(own.damping_mps2, 0, damping)
    force = scaled(-bob_mass(properties, tank), damping)
    own.damper_force_N[1], own.damper_force_N[2] = force[1], force[2]
    if slosh.exchange == 1:
        place = add((hinge[0] + shift_x, hinge[1] + shift_y, hinge[2] + shift_z), scaled(length, u))
        velocity = add(add(cross(rate, place), scaled(length, u_rate)), (shift_rate_x, shift_rate_y, shift_rate_z))
        set_vector(own.bob_place_m, 0, place)
        set_vector(own.bob_velocity_mps, 0, velocity)
    moment = cross(add(hinge, scaled(length, u)), force)
    roll = moment[0] + asymmetry_y * force[2] - asymmetry_z * force[1]
    moment = (roll, moment[1] + shift_z * force[0], moment[2] - shift_y * force[0])
    if sizes.spatial_modes > 0:
        moment = (moment[0] + asymmetry_x * force[0], moment[1] - shift_x * force[2], moment[2] + shift_x * force[1])
        own.shift_m[0], own.asymmetry_m[0], own.damper_force_N[0] = shift_x, asymmetry_x, force[0]
    return force, moment


@routine
def wall_and_ring_damping(
    slosh: Slosh, tank: int, length: float, axial_load: float, rate: float, properties: Array
) -> float:
    """Return the damping acceleration of a smooth wall and ring baffles over the swing rate, m/s (docs/model.md, 5.8).

    zeta = viscous / a^(1/4) + ring sqrt(swing), as 2 zeta omega L; `rate` is the swing rate, rad/s. The drag of a ring
    grows with the 3/2-th power of the velocity. With the factor RING_DRAG it dissipates the same energy as that ratio,
    at any amplitude of a plane swing.
    """
    column = sch.tank_column(tank)
    viscous = slosh.law_factor[tank] * properties[column + sch.TANK_VISCOUS]
    ring = slosh.law_factor[tank] * properties[column + sch.TANK_RING] + slosh.ring_damping[tank]
    root = math.sqrt(axial_load)
    drag: float = viscous * math.sqrt(root * length)
    drag += RING_DRAG * ring * math.sqrt(rate * root * length * math.sqrt(length))
    drag *= 2.0
    return drag


@routine
def exchange_loads(
    slosh: Slosh, sizes: Counts, rate: Vector, properties: Array, y: Array, first: int, modes: Modes, tanks: Tanks
) -> tuple[Vector, Vector]:
    """Return force and moment (about the core CG, B) on the core due to the liquid exchanged between bobs and core.

    Exchanged liquid initially keeps its velocity. The mass that a bob loses exerts a force on the core and, at its
    place, on the modes; the mass that a bob gains slows the bob down. In `prepare_outflow` the flow enters the core at
    the rest position of the bob. Together, linear momentum and the angular momentum about the common CG are conserved,
    and no energy is gained (docs/model.md, eqs. 8.2 and 8.3).
    """
    drift = (0.0, 0.0, 0.0)  # velocity of the common CG relative to the core CG
    share = properties[sch.schedule_width(sizes) + sch.INVERSE_TOTAL_MASS]
    for tank in range(sizes.pendulums):
        mass = bob_mass(properties, tank)
        drift = add(drift, scaled(share * mass, vector_at(tanks[tank].bob_velocity_mps, 0)))
    force, moment = (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
    for tank in range(sizes.pendulums):
        own, mass = tanks[tank], bob_mass(properties, tank)
        flow = -properties[sch.tank_column(tank) + sch.TANK_MASS_RATE]  # from bob to core
        if flow == 0.0 or mass <= 0.0:
            continue
        hinge, place = vector_at(own.hinge_m, 0), vector_at(own.bob_place_m, 0)
        velocity = vector_at(own.bob_velocity_mps, 0)
        rest = (hinge[0] - pendulum_length(properties, tank), hinge[1], hinge[2])
        rest_velocity = cross(rate, rest)
        carried = velocity if flow > 0.0 else rest_velocity
        push = scaled(flow, add(carried, scaled(-1.0, rest_velocity)))
        force = add(force, push)
        spin = cross(place, add(carried, scaled(-1.0, drift)))
        spin = add(spin, scaled(-1.0, cross(rest, add(rest_velocity, scaled(-1.0, drift)))))
        moment = add(moment, scaled(flow, spin))
        if flow > 0.0:  # acts on the modes through the velocity relative to the bent axis
            _, _, shift_rate_y, shift_rate_z, _, _ = _bending_at_tank(sizes, tank, properties, modes.planar)
            by_modes = 0.0
            if sizes.spatial_modes > 0:
                moving = spatial_motion(sizes, properties, sch.tank_place(tank), modes.spatial.rate_mps)
                shift_rate_y, shift_rate_z = shift_rate_y + moving[1], shift_rate_z + moving[2]
                push_x = push[0] - flow * moving[0]
                own.damper_force_N[0] += push_x
                by_modes = -own.asymmetry_m[0] * push_x
            shift_y, shift_z = own.shift_m[1], own.shift_m[2]
            push_y, push_z = push[1] - flow * shift_rate_y, push[2] - flow * shift_rate_z
            own.damper_force_N[1] += push_y
            own.damper_force_N[2] += push_z
            # The modes take this part of the roll moment (docs/model.md, eq. 4.4).
            by_modes += (shift_y - own.asymmetry_m[1]) * push_z - (shift_z - own.asymmetry_m[2]) * push_y
            moment = (moment[0] - by_modes, moment[1], moment[2])
        else:
            u = vector_at(y, first + N_PENDULUM * tank)
            brake = scaled(flow / mass, add(velocity, scaled(-1.0, rest_velocity)))
            along = dot(brake, u)
            own.demand_mps2 += along
            for j in range(3):
                own.damping_mps2[j] += brake[j] - along * u[j]
    return force, moment


@kernel
def _bending_at_tank(
    sizes: Counts, tank: int, properties: Array, modes: PlanarMotion
) -> tuple[float, float, float, float, float, float]:
    """Return the displacement of a hinge by bending, its rate in B, and its quasi-velocity, each along y and z."""
    in_pitch, in_yaw = (
        sch.mode_column(sizes, sch.PITCH, sch.MODE_FIRST + tank),
        sch.mode_column(sizes, sch.YAW, sch.MODE_FIRST + tank),
    )
    return (
        modal_sum(sizes, properties, in_yaw, modes.eta_m, of_plane(sch.YAW)),
        modal_sum(sizes, properties, in_pitch, modes.eta_m, of_plane(sch.PITCH)),
        modal_sum(sizes, properties, in_yaw, modes.rate_mps, of_plane(sch.YAW)),
        modal_sum(sizes, properties, in_pitch, modes.rate_mps, of_plane(sch.PITCH)),
        modal_sum(sizes, properties, in_yaw, modes.nu_mps, of_plane(sch.YAW)),
        modal_sum(sizes, properties, in_pitch, modes.nu_mps, of_plane(sch.PITCH)),
    )


@kernel
def _plane_asymmetry(
    sizes: Counts, tank: int, properties: Array, modes: PlanarMotion
) -> tuple[float, float, float, float]:
    """Return the part of a hinge's displacement due to different planes: y, z (m), and the rates in B.

    It is the displacement minus that with the shapes of each plane in the other. The quasi-velocities include the roll
    rate with the shapes of their own plane. If the planes differ, roll adds this displacement of the hinge
    (docs/model.md, eq. 5.6).
    """
    in_pitch, in_yaw = (
        sch.mode_column(sizes, sch.PITCH, sch.MODE_FIRST + tank),
        sch.mode_column(sizes, sch.YAW, sch.MODE_FIRST + tank),
    )
    along_y, along_z, rate_y, rate_z = 0.0, 0.0, 0.0, 0.0
    for i in range(max(sizes.pitch_modes, sizes.yaw_modes)):
        p, q = of_plane(sch.PITCH) + i, of_plane(sch.YAW) + i
        more_in_yaw = properties[in_yaw + i] - properties[in_pitch + i]
        along_y += more_in_yaw * modes.eta_m[q]
        rate_y += more_in_yaw * modes.rate_mps[q]
        along_z -= more_in_yaw * modes.eta_m[p]
        rate_z -= more_in_yaw * modes.rate_mps[p]
    return along_y, along_z, rate_y, rate_z


@kernel
def pendulum_derivative(
    slosh: Slosh,
    sizes: Counts,
    tank: int,
    rate: Vector,
    specific_force: Vector,
    alpha: Vector,
    properties: Array,
    y: Array,
    first: int,
    dy: Array,
    own: TankWork,
) -> None:
    """Write the derivative of the states at y[first:first+6], once the body's accelerations are known.

    The states of an empty tank are constant, because a pendulum without mass has no effect.
    """
    if bob_mass(properties, tank) <= 0.0:
        for j in range(6):
            dy[first + j] = 0.0
        return
    u, kappa = vector_at(y, first), vector_at(y, first + 3)
    shift_y, shift_z = own.shift_m[1], own.shift_m[2]
    accel, damping = vector_at(own.hinge_accel_mps2, 0), vector_at(own.damping_mps2, 0)
    tangential = cross(alpha, vector_at(own.hinge_m, 0))
    bend_y, bend_z = own.bending_accel_mps2[1], own.bending_accel_mps2[2]
    asymmetry_y, asymmetry_z = own.asymmetry_m[1], own.asymmetry_m[2]
    hinge = (
        accel[0] + specific_force[0] + tangential[0] + alpha[1] * shift_z - alpha[2] * shift_y,
        accel[1] + specific_force[1] + tangential[1] + bend_y - alpha[0] * asymmetry_z,
        accel[2] + specific_force[2] + tangential[2] + bend_z + alpha[0] * asymmetry_y,
    )
    if sizes.spatial_modes > 0:
        shift_x, asymmetry_x, bend_x = own.shift_m[0], own.asymmetry_m[0], own.bending_accel_mps2[0]
        hinge = (
            hinge[0] + bend_x + alpha[0] * asymmetry_x,
            hinge[1] + alpha[2] * shift_x,
            hinge[2] - alpha[1] * shift_x,
        )
    per_length = 1.0 / pendulum_length(properties, tank)
    along = per_length * dot(hinge, u) - dot(kappa, kappa)
    spin_u, spin_kappa = cross(rate, u), cross(rate, kappa)
    for j in range(3):
        dy[first + j] = kappa[j] - spin_u[j]
        dy[first + 3 + j] = along * u[j] - spin_kappa[j] + per_length * (damping[j] - hinge[j])


class SloshRow(NamedTuple):
    """The logged values of a slosh pendulum."""

    slosh_tank_pitch_deg: Annotated[float, "deg", "pendulum angle in the pitch plane"]
    slosh_tank_yaw_deg: Annotated[float, "deg", "pendulum angle in the yaw plane"]
    slosh_tank_pitch_rate_degps: Annotated[float, "deg/s", "pendulum rate in the pitch plane"]
    slosh_tank_yaw_rate_degps: Annotated[float, "deg/s", "pendulum rate in the yaw plane"]
    slosh_tank_tension_N: Annotated[float, "N", "tension of the pendulum rod"]


@kernel
def slosh_row(
    slosh: Slosh, sizes: Sizes, tank: int, properties: Array, y: Array, first: int, tension_N: Array
) -> SloshRow:
    """Return the row of a pendulum; all values are nan for an empty tank, and if the stage has no such pendulum."""
    if tank >= sizes.pendulums or bob_mass(properties, tank) <= 0.0:
        return SloshRow(math.nan, math.nan, math.nan, math.nan, math.nan)
    i = first
    u_x, u_y, u_z = -y[i], y[i + 1], y[i + 2]
    # d(u)/dt in B = kappa - w x u
    rate_x = -(y[i + 3] - (y[W_BI_B + 1] * u_z - y[W_BI_B + 2] * u_y))
    rate_y = y[i + 4] - (-y[W_BI_B + 2] * u_x - y[W_BI_B] * u_z)
    rate_z = y[i + 5] - (y[W_BI_B] * u_y + y[W_BI_B + 1] * u_x)
    return SloshRow(
        slosh_tank_pitch_deg=DEG * math.atan2(u_z, u_x),
        slosh_tank_yaw_deg=DEG * math.atan2(u_y, u_x),
        slosh_tank_pitch_rate_degps=DEG * ((u_x * rate_z - u_z * rate_x) / (u_x * u_x + u_z * u_z)),
        slosh_tank_yaw_rate_degps=DEG * ((u_x * rate_y - u_y * rate_x) / (u_x * u_x + u_y * u_y)),
        slosh_tank_tension_N=tension_N[tank],
    )


@kernel
def wave_share(slosh: Slosh, tank: int, properties: Array, lateral: float) -> float:
    """Return the height of a wave divided by its breaking height.

    `lateral`: sine of the swing. The result is 0 if the height of the wave is unknown. By default a wave breaks when
    its surface accelerates aft at the axial load. In linear theory its height is then the length of the pendulum.
    """
    breaking = slosh.breaking_height_m[tank]
    if breaking == 0.0:
        breaking = pendulum_length(properties, tank)
    share: float = lateral * properties[sch.tank_column(tank) + sch.TANK_WAVE] / breaking
    return share


class WaveRow(NamedTuple):
    """The log row of the wave of one slosh pendulum."""

    slosh_tank_wave_m: Annotated[
        float, "m", "height of the wave: highest point of the surface above the liquid at rest"
    ]


@kernel
def wave_row(slosh: Slosh, sizes: Sizes, tank: int, properties: Array, y: Array, first: int) -> WaveRow:
    """Return the row of a wave; the value is nan as in `slosh_row`, and for a tank without a shape."""
    if tank >= sizes.pendulums or bob_mass(properties, tank) <= 0.0:
        return WaveRow(math.nan)
    wave = properties[sch.tank_column(tank) + sch.TANK_WAVE]
    lateral = math.sqrt(y[first + 1] * y[first + 1] + y[first + 2] * y[first + 2])
    return WaveRow(wave * lateral if wave > 0.0 else math.nan)
