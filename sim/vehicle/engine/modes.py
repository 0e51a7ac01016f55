"""Coupling of deflected engines with the modes of a bent body (docs/model.md, sections 3, 4 and 7).

The momentum of an engine relative to the body acts on the modes at its gimbal, and the modes move the engine. While the
body rolls, the momentum includes the displaced mass of the deflected engine, m_E p x cross Delta. Hence, with deflected
engines, roll acceleration excites the modes, and modal accelerations produce a roll moment.
"""

from __future__ import annotations

from maxq.control.kernel.jit import kernel, routine
from maxq.control.kernel.records import Array
from maxq.control.kernel.vectors import Vector
from maxq.sim.vehicle import schedule as sch
from maxq.sim.vehicle.block import Counts, Sizes, are_usual, counts, usual_counts
from maxq.sim.vehicle.engine.kernel import Engine, KeptEngines, beside_axis, deflected_at
from maxq.sim.vehicle.modes.planar import (
    Modes,
    add_multiple_of_modes,
    apply_gimbal_load,
    clear_modes,
    modal_accelerations,
    motion_at,
    of_plane,
    product_of_modes,
)
from maxq.sim.vehicle.modes.spatial import Load, apply_spatial_load, spatial_motion


@kernel
def load_at_gimbal(e: Engine, k: int, force: Vector, couple: Vector) -> Load:
    """Return the load at engine k's gimbal from a force at the engine's CG at rest and a couple, in B."""
    aft, to_y, to_z = e.lever_x_m[k], e.lever_y_m[k], e.lever_z_m[k]
    beside_y, beside_z = beside_axis(e, k)
    about_x = couple[0] + (beside_y * force[2] - beside_z * force[1])
    about_y = couple[1] + aft * force[2] + to_z * force[0]
    return force[0], force[1], force[2], about_x, about_y, couple[2] - aft * force[1] - to_y * force[0]


Rates = tuple[Vector, Vector]  # velocity (m/s) and angular rate (rad/s) of a station due to the modes, B


@kernel
def gimbal_rates(sizes: Counts, properties: Array, gimbal: int, modes: Modes) -> Rates:
    """Return velocity (m/s) and angular rate (rad/s) of a station of gimbals due to the modes, in B.

    Both are sums over the quasi-velocities, which include the contribution of the roll rate.
    """
    nu = modes.planar.nu_mps
    y, z, about_y, about_z = motion_at(sizes, properties, gimbal, nu, of_plane(sch.PITCH), of_plane(sch.YAW))
    if sizes.spatial_modes > 0:
        spatial = spatial_motion(sizes, properties, sch.gimbal_place(sizes, gimbal), modes.spatial.nu_mps)
        return ((spatial[0], y + spatial[1], z + spatial[2]), (spatial[3], about_y + spatial[4], about_z + spatial[5]))
    return (0.0, y, z), (0.0, about_y, about_z)


@kernel
def engine_velocity(e: Engine, k: int, rates: Rates) -> Vector:
    """Return the velocity of the CG of engine k at rest due to the modes (B, m/s), from the rates of its gimbal.

    This mapping is the transpose of `load_at_gimbal`.
    """
    velocity, turning = rates
    aft, to_y, to_z = e.lever_x_m[k], e.lever_y_m[k], e.lever_z_m[k]
    beside_y, beside_z = beside_axis(e, k)
    return (
        velocity[0] + to_z * turning[1] - to_y * turning[2],
        velocity[1] - aft * turning[2] - beside_z * turning[0],
        velocity[2] + aft * turning[1] + beside_y * turning[0],
    )


@routine
def modal_roll_response(
    e: Engine, of: Sizes, first: Vector, properties: Array, engines: KeptEngines, modes: Modes
) -> float:
    """Set the modal accelerations per unit of roll acceleration (`roll_m`) with the engines deflected.

    `first`: displacement of the first engine's CG by its deflection (B, m); `engines` contains the further engines.
    `accel_mps2` serves as a buffer for the forces. Returns the reduction of the roll inertia (kg m2) by the compliance
    of the modes (docs/model.md, 7.3).
    """
    sizes = counts(of)
    if are_usual(sizes):
        return _roll_response(e, usual_counts(sizes), first, properties, engines, modes)
    return _roll_response(e, sizes, first, properties, engines, modes)


@kernel
def _roll_response(
    e: Engine, sizes: Counts, first: Vector, properties: Array, engines: KeptEngines, modes: Modes
) -> float:
    planar, spatial = modes.planar, modes.spatial
    clear_modes(sizes, planar.accel_mps2)
    for i in range(sizes.spatial_modes):
        spatial.accel_mps2[i] = 0.0
    for k in range(sizes.engines):
        mass, delta = e.gimballed_mass_kg[k], first
        if k > 0:
            delta = deflected_at(engines[k]).delta
        load = load_at_gimbal(e, k, (0.0, mass * delta[2], -mass * delta[1]), (0.0, 0.0, 0.0))
        apply_gimbal_load(sizes, properties, e.gimbal[k], load, planar.accel_mps2)
        if sizes.spatial_modes > 0:
            apply_spatial_load(sizes, properties, sch.gimbal_place(sizes, e.gimbal[k]), load, spatial.accel_mps2)
    modal_accelerations(sizes, properties, planar.accel_mps2, planar.roll_m)
    given_way: float = product_of_modes(sizes, planar.accel_mps2, planar.roll_m)
    inverse = sch.spatial_derived(sizes, sch.MODE_INVERSE_MASS)
    for i in range(sizes.spatial_modes):
        force = spatial.accel_mps2[i]
        spatial.roll_m[i] = force * properties[inverse + i]
        given_way += force * spatial.roll_m[i]
    return given_way


@kernel
def roll_moment_of_modes(sizes: Counts, planar_N: Array, spatial_N: Array, modes: Modes) -> float:
    """Return the roll moment (N m) that generalised forces on the modes exert through the deflected engines."""
    total = product_of_modes(sizes, modes.planar.roll_m, planar_N)
    for i in range(sizes.spatial_modes):
        total += modes.spatial.roll_m[i] * spatial_N[i]
    return total


@kernel
def add_roll_to_modes(sizes: Counts, roll_accel: float, modes: Modes) -> None:
    """Add the effect of the roll acceleration (rad/s2) on deflected engines to the modal accelerations."""
    add_multiple_of_modes(sizes, modes.planar.roll_m, roll_accel, modes.planar.accel_mps2)
    for i in range(sizes.spatial_modes):
        modes.spatial.accel_mps2[i] += roll_accel * modes.spatial.roll_m[i]
