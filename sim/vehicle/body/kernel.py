"""The rigid body: mass properties and inertial reaction of deflected engines, propellant flow, and kinematics."""

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
from maxq.sim.vehicle import schedule as sch
from maxq.sim.vehicle.block import Q_BI, R_I, V_I, W_BI_B, Counts
from maxq.sim.vehicle.engine.kernel import Deflected, Engine, KeptEngines, deflected_at, flow_share
from maxq.sim.vehicle.engine.modes import load_at_gimbal
from maxq.sim.vehicle.modes.spatial import Load
from maxq.sim.vehicle.slosh.kernel import Slosh, pendulum_length
from maxq.sim.world.earth import Earth


class Balance(NamedTuple):
    """The CG and the inertia with all engines deflected, in B (m, kg m2)."""

    offset: Vector  # vector from the core CG to the CG
    inertia: Symmetric  # about the core CG
    inverse_inertia: Symmetric  # inverse of the tensor about that CG, with the modal compliance in roll
    given_way_kgm2: float  # reduction of the roll inertia by the modes, see engine/modes.py


@kernel
def _at_rest(e: Engine, k: int, gimbal: Vector) -> Vector:
    """Return the CG of engine k at rest relative to the core CG, B, m."""
    arm = e.cg_from_gimbal_m[k]
    return gimbal[0] - arm * e.rest_x[k], gimbal[1] - arm * e.rest_y[k], gimbal[2] - arm * e.rest_z[k]


@kernel
def displaced_inertia(e: Engine, k: int, engine: Deflected, inertia: Symmetric) -> Symmetric:
    """Return `inertia` about the core CG after the deflection of engine k from its rest position."""
    mass, rest = e.gimballed_mass_kg[k], _at_rest(e, k, engine.gimbal)
    return plus_point(plus_point(inertia, mass, add(rest, engine.delta)), -mass, rest)


@kernel
def balance(
    e: Engine, sizes: Counts, first: Deflected, given_way_kgm2: float, properties: Array, engines: KeptEngines
) -> Balance:
    """Return CG and inertia with the first engine as given, and further engines from `engines`."""
    inverse_mass = properties[sch.schedule_width(sizes) + sch.INVERSE_CORE_MASS]
    inertia = displaced_inertia(e, 0, first, symmetric_at(properties, sch.CORE_INERTIA))
    offset = scaled(e.gimballed_mass_kg[0] * inverse_mass, first.delta)
    for k in range(1, sizes.engines):
        engine = deflected_at(engines[k])
        inertia = displaced_inertia(e, k, engine, inertia)
        offset = add(offset, scaled(e.gimballed_mass_kg[k] * inverse_mass, engine.delta))
    xx, yy, zz, xy, xz, yz = plus_point(inertia, -properties[sch.CORE_MASS], offset)
    return Balance(offset, inertia, inverse_inertia((xx - given_way_kgm2, yy, zz, xy, xz, yz)), given_way_kgm2)


@kernel
def plus_point(j: Symmetric, mass: float, at: Vector) -> Symmetric:
    """Return the inertia integrals with the addition of a point mass."""
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
def engine_reaction(
    e: Engine, k: int, engine: Deflected, rate: Vector, axial_load: float, bending: Vector
) -> tuple[Vector, Vector, Load]:
    """Return force and moment (about the core CG) of the moving engine k on the vehicle, in B ("tail wags dog").

    The third result is the load at the gimbal on the modes. `bending`: velocity of the engine's CG at rest due to the
    modes (`engine_velocity`), m/s.

    Terms with the unknown accelerations are in the mass matrix (`Balance`). The axial load on the displaced engine also
    bends the body, which is a first-order effect of the deflection.
    """
    mass, inertia = e.gimballed_mass_kg[k], e.inertia_kgm2[k]
    relative = add(engine.delta_accel, scaled(2.0, cross(rate, engine.delta_rate)))
    force = scaled(-mass, add(relative, cross(rate, cross(rate, engine.delta))))
    at = add(_at_rest(e, k, engine.gimbal), engine.delta)
    moment = scaled(-mass, cross(at, relative))
    spin = add(engine.relative_accel, cross(rate, engine.relative_rate))
    moment = add(moment, scaled(-inertia, spin))
    # Angular momentum about x of the displaced mass that the modes move, and its rate without their accelerations.
    delta, delta_rate = engine.delta, engine.delta_rate
    roll = mass * (delta[1] * bending[2] - delta[2] * bending[1])
    growth = mass * (delta_rate[1] * bending[2] - delta_rate[2] * bending[1])
    moment = add(moment, (-growth, -rate[2] * roll, rate[1] * roll))
    accel = engine.delta_accel
    inertial = scaled(-mass, (accel[0], accel[1] - rate[0] * delta_rate[2], accel[2] + rate[0] * delta_rate[1]))
    couple = scaled(-inertia, engine.relative_accel)
    couple = add(couple, (0.0, -mass * axial_load * delta[2], mass * axial_load * delta[1]))
    return force, moment, load_at_gimbal(e, k, inertial, couple)


@kernel
def engine_momentum(e: Engine, k: int, engine: Deflected, roll_rate: float) -> Load:
    """Return the momentum that engine k adds to that of the modes, as a load at its gimbal (docs/model.md, 3.4, 4.1).

    Its units are N s and N m s.
    """
    delta, moving = engine.delta, engine.delta_rate
    velocity = (moving[0], moving[1] - roll_rate * delta[2], moving[2] + roll_rate * delta[1])
    spin = scaled(e.inertia_kgm2[k], engine.relative_rate)
    return load_at_gimbal(e, k, scaled(e.gimballed_mass_kg[k], velocity), spin)


@kernel
def prepare_outflow(e: Engine, slosh: Slosh, sizes: Counts, properties: Array) -> None:
    """Compute the derived properties of the propellant flow (momentum, jet damping), and the inverse masses.

    The relative momentum of the inner flow is d(m c)/dt + mdot r_exit (mass conservation). The moment about the core CG
    is -(dJ/dt) w - mdot r_exit x (w x r_exit) (docs/model.md, section 8; Eke 1998, Meirovitch 1970). Its second term is
    that of a point mass mdot at the exit. The mass that a bob loses flows into the core at the position of the bob.
    """
    mass = properties[sch.CORE_MASS]
    inner = scaled(mass, (-properties[sch.CG_RATE], properties[sch.CG_RATE + 1], properties[sch.CG_RATE + 2]))
    damping = symmetric_at(properties, sch.INERTIA_RATE)
    for k in range(sizes.engines):
        flow = properties[sch.MASS_FLOW] * flow_share(e, sizes, k, properties)
        at = (
            properties[sch.CORE_CG] - e.exit_station_m[k],
            e.exit_y_m[k] - properties[sch.CORE_CG + 1],
            e.exit_z_m[k] - properties[sch.CORE_CG + 2],
        )
        inner = add(inner, scaled(flow, at))
        yy, zz, yz = flow * e.exit_yy_m2[k], flow * e.exit_zz_m2[k], flow * e.exit_yz_m2[k]
        m = plus_point(damping, flow, at)
        damping = (m[0] + (yy + zz), m[1] + zz, m[2] + yy, m[3], m[4], m[5] + yz)
    for tank in range(sizes.pendulums):
        c = sch.tank_column(tank)
        at = (
            properties[sch.CORE_CG] - properties[c + sch.TANK_HINGE] - pendulum_length(properties, tank),
            slosh.place_y_m[tank] - properties[sch.CORE_CG + 1],
            slosh.place_z_m[tank] - properties[sch.CORE_CG + 2],
        )
        growth = properties[c + sch.TANK_MASS_RATE]
        inner = add(inner, scaled(growth, at))
        damping = plus_point(damping, growth, at)
    behind = sch.schedule_width(sizes)
    properties[behind + sch.INVERSE_CORE_MASS] = 1.0 / mass
    properties[behind + sch.INVERSE_TOTAL_MASS] = 1.0 / properties[sch.TOTAL_MASS]
    set_vector(properties, behind + sch.INNER_FLOW, inner)
    for j in range(6):
        properties[behind + sch.JET_DAMPING + j] = damping[j]


@kernel
def coriolis_of_outflow(sizes: Counts, rate: Vector, properties: Array) -> tuple[Vector, Vector]:
    """Return force (N) and moment (N m), in B, of the propellant flow through a rotating vehicle (jet damping)."""
    behind = sch.schedule_width(sizes)
    force = scaled(-2.0, cross(rate, vector_at(properties, behind + sch.INNER_FLOW)))
    damping = symmetric_at(properties, behind + sch.JET_DAMPING)
    return force, scaled(-1.0, inertia_times(damping, rate))


@kernel
def kinematics(
    earth: Earth,
    on_pad: int,
    rotation: Matrix,
    rate: Vector,
    specific_force: Vector,
    alpha: Vector,
    gravitation: Vector,
    properties: Array,
    y: Array,
    dy: Array,
) -> None:
    """Write the derivatives of position, velocity, attitude and rate.

    The core CG moves in the body as propellant is consumed. On the pad, position and velocity rotate with the Earth.
    """
    if on_pad == 1:
        turning = earth.rate_radps
        dy[R_I], dy[R_I + 1], dy[R_I + 2] = -turning * y[R_I + 1], turning * y[R_I], 0.0
        dy[V_I], dy[V_I + 1], dy[V_I + 2] = -turning * y[V_I + 1], turning * y[V_I], 0.0
    else:
        drift = (-properties[sch.CG_RATE], properties[sch.CG_RATE + 1], properties[sch.CG_RATE + 2])
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
