"""Rigid part: mass properties with the engine deflected, its inertial reaction, outflow, and kinematics."""

from __future__ import annotations

from typing import NamedTuple

from maxq.control.kernel.jit import kernel
from maxq.control.kernel.records import Array
from maxq.control.kernel.vectors import (
    Matrix,
    Symmetric,
    Vector,
    add,
    cross,
    inertia_times,
    inverse_inertia,
    rotate,
    scaled,
    set_vector,
    symmetric_at,
    vector_at,
)
from maxq.sim.vehicle.block import Q_BI, R_I, V_I, W_BI_B, Counts
from maxq.sim.vehicle.engine import Engine
from maxq.sim.vehicle.schedule import (
    CG_RATE,
    CORE_CG,
    CORE_INERTIA,
    CORE_MASS,
    INERTIA_RATE,
    INNER_FLOW,
    INVERSE_CORE_MASS,
    INVERSE_TOTAL_MASS,
    JET_DAMPING,
    MASS_FLOW,
    TANK_HINGE,
    TANK_MASS_RATE,
    TOTAL_MASS,
    schedule_width,
    tank_column,
)
from maxq.sim.vehicle.slosh import Slosh, pendulum_length
from maxq.sim.vehicle.spatial_modes import Load
from maxq.sim.world.earth import Earth


class Deflected(NamedTuple):
    """The engine of this instant, in B (m, kg m2)."""

    axis: Vector  # unit vector of the thrust
    gimbal: Vector  # gimbal point relative to the core CG
    delta: Vector  # engine CG relative to where it is with the engine straight, and derivatives
    delta_rate: Vector
    delta_accel: Vector
    relative_rate: Vector  # angular velocity of the engine relative to the body, and derivative
    relative_accel: Vector
    offset: Vector  # CG with the engine deflected, relative to the core CG
    inertia: Symmetric  # about the core CG, engine deflected
    inverse_inertia: Symmetric  # inverse of the tensor about the CG with the engine deflected


@kernel
def deflected_engine(
    e: Engine, sizes: Counts, axis: Vector, axis_rate: Vector, axis_accel: Vector, properties: Array
) -> Deflected:
    arm, mass = e.cg_from_gimbal_m, e.gimballed_mass_kg
    gimbal = (
        properties[CORE_CG] - e.gimbal_station_m,
        e.gimbal_offset_y_m - properties[CORE_CG + 1],
        e.gimbal_offset_z_m - properties[CORE_CG + 2],
    )
    delta = (arm * (1.0 - axis[0]), -arm * axis[1], -arm * axis[2])
    straight = (gimbal[0] - arm, gimbal[1], gimbal[2])
    moved = add(straight, delta)
    core = symmetric_at(properties, CORE_INERTIA)
    inertia = _plus_point(_plus_point(core, mass, moved), -mass, straight)
    offset = scaled(mass * properties[schedule_width(sizes) + INVERSE_CORE_MASS], delta)
    about_cg = _plus_point(inertia, -properties[CORE_MASS], offset)
    return Deflected(
        axis,
        gimbal,
        delta,
        scaled(-arm, axis_rate),
        scaled(-arm, axis_accel),
        cross(axis, axis_rate),
        cross(axis, axis_accel),
        offset,
        inertia,
        inverse_inertia(about_cg),
    )


@kernel
def _plus_point(j: Symmetric, mass: float, at: Vector) -> Symmetric:
    """Inertia integrals with a point mass added."""
    xx, yy, zz = at[0] * at[0], at[1] * at[1], at[2] * at[2]
    return (
        j[0] + mass * (yy + zz),
        j[1] + mass * (xx + zz),
        j[2] + mass * (xx + yy),
        j[3] + mass * at[0] * at[1],
        j[4] + mass * at[0] * at[2],
        j[5] + mass * at[1] * at[2],
    )


@kernel
def engine_reaction(e: Engine, engine: Deflected, rate: Vector, axial_load: float) -> tuple[Vector, Vector, Load]:
    """Force and moment (about the core CG) of the moving engine on the vehicle, in B ("tail wags dog").

    The third result is the load at the gimbal that excites the modes.

    Terms in the unknown accelerations are in the mass matrix (`Deflected.offset`, `.inertia`). The axial load on the
    displaced engine bends the body as well: a first-order effect of the deflection.
    """
    mass, arm = e.gimballed_mass_kg, e.cg_from_gimbal_m
    relative = add(engine.delta_accel, scaled(2.0, cross(rate, engine.delta_rate)))
    force = scaled(-mass, add(relative, cross(rate, cross(rate, engine.delta))))
    at = add((engine.gimbal[0] - arm, engine.gimbal[1], engine.gimbal[2]), engine.delta)
    moment = scaled(-mass, cross(at, relative))
    spin = add(engine.relative_accel, cross(rate, engine.relative_rate))
    moment = add(moment, scaled(-e.inertia_kgm2, spin))
    inertial = scaled(-mass, engine.delta_accel)
    moment_y = arm * inertial[2] - e.inertia_kgm2 * engine.relative_accel[1] - mass * axial_load * engine.delta[2]
    moment_z = -arm * inertial[1] - e.inertia_kgm2 * engine.relative_accel[2] + mass * axial_load * engine.delta[1]
    moment_x = -e.inertia_kgm2 * engine.relative_accel[0]
    return force, moment, (inertial[0], inertial[1], inertial[2], moment_x, moment_y, moment_z)


@kernel
def prepare_outflow(e: Engine, slosh: Slosh, sizes: Counts, properties: Array) -> None:
    """Derived properties of the flowing propellant (momentum, jet damping), and the inverse masses.

    The relative momentum of the inner flow is d(m c)/dt + mdot r_exit (mass conservation), the moment is
    -(dJ/dt) w - mdot r_exit x (w x r_exit) about the core CG (docs/model.md, section 8; Eke 1998, Meirovitch 1970):
    that of a point of "mass" mdot at the exit. What a bob loses flows into the core at the bob's position.
    """
    flow, mass = properties[MASS_FLOW], properties[CORE_MASS]
    at = (properties[CORE_CG] - e.exit_station_m, -properties[CORE_CG + 1], -properties[CORE_CG + 2])
    inner = add(
        scaled(mass, (-properties[CG_RATE], properties[CG_RATE + 1], properties[CG_RATE + 2])), scaled(flow, at)
    )
    damping = _plus_point(symmetric_at(properties, INERTIA_RATE), flow, at)
    for tank in range(sizes.tanks):
        c = tank_column(tank)
        at = (
            properties[CORE_CG] - properties[c + TANK_HINGE] - pendulum_length(slosh, properties, tank),
            -properties[CORE_CG + 1],
            -properties[CORE_CG + 2],
        )
        growth = properties[c + TANK_MASS_RATE] * slosh.mass_factor[tank]
        inner = add(inner, scaled(growth, at))
        damping = _plus_point(damping, growth, at)
    behind = schedule_width(sizes)
    properties[behind + INVERSE_CORE_MASS] = 1.0 / mass
    properties[behind + INVERSE_TOTAL_MASS] = 1.0 / properties[TOTAL_MASS]
    set_vector(properties, behind + INNER_FLOW, inner)
    for j in range(6):
        properties[behind + JET_DAMPING + j] = damping[j]


@kernel
def coriolis_of_outflow(sizes: Counts, rate: Vector, properties: Array) -> tuple[Vector, Vector]:
    """Force and moment of the propellant that flows through a turning vehicle: jet damping."""
    behind = schedule_width(sizes)
    force = scaled(-2.0, cross(rate, vector_at(properties, behind + INNER_FLOW)))
    damping = symmetric_at(properties, behind + JET_DAMPING)
    return force, scaled(-1.0, inertia_times(damping, rate))


@kernel
def kinematics(
    earth: Earth, on_pad: int, rotation: Matrix, rate: Vector, specific_force: Vector, alpha: Vector,
    gravitation: Vector, properties: Array, y: Array, dy: Array,
) -> None:  # fmt: skip  # eight more lines otherwise
    """Position, velocity, attitude and rate. The core CG moves through the body as propellant leaves.

    On the pad, position and attitude rotate with the Earth.
    """
    if on_pad == 1:
        turning = earth.rate_radps
        dy[R_I], dy[R_I + 1], dy[R_I + 2] = -turning * y[R_I + 1], turning * y[R_I], 0.0
        dy[V_I], dy[V_I + 1], dy[V_I + 2] = -turning * y[V_I + 1], turning * y[V_I], 0.0
    else:
        drift = (-properties[CG_RATE], properties[CG_RATE + 1], properties[CG_RATE + 2])
        drift_I = rotate(rotation, drift)
        accel = rotate(rotation, add(specific_force, cross(rate, drift)))
        for j in range(3):
            dy[R_I + j] = y[V_I + j] + drift_I[j]
            dy[V_I + j] = accel[j] + gravitation[j]
    w, x, yy, z = y[Q_BI], y[Q_BI + 1], y[Q_BI + 2], y[Q_BI + 3]
    p, q, r = rate
    dy[Q_BI] = 0.5 * (-x * p - yy * q - z * r)
    dy[Q_BI + 1] = 0.5 * (w * p + yy * r - z * q)
    dy[Q_BI + 2] = 0.5 * (w * q + z * p - x * r)
    dy[Q_BI + 3] = 0.5 * (w * r + x * q - yy * p)
    set_vector(dy, W_BI_B, alpha)


@kernel
def engine_momentum(e: Engine, engine: Deflected) -> Load:
    """What the moving engine adds to the momentum of the modes, as a load at the gimbal: N s, N m s (eq. 4.9)."""
    x, y, z = scaled(e.gimballed_mass_kg, engine.delta_rate)
    spin, arm = scaled(e.inertia_kgm2, engine.relative_rate), e.cg_from_gimbal_m
    return x, y, z, spin[0], spin[1] + arm * z, spin[2] - arm * y
