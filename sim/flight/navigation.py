"""Errors of the inertial navigation that the guidance uses: position, velocity and attitude.

The computer starts with a wrong position, velocity and attitude. From the release on, it integrates the specific force
in its own attitude, and gravitation at its own position. Errors of position and velocity therefore obey

    dr' = dv,    dv' = (C - 1) f + g(r + dr) - g(r),

in I, with the specific force f of the core CG and the rotation C from the true to the computed attitude, which contains
the errors of the gyros. They are computed once per sample, by the trapezoidal rule.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from maxq.control.attitude import Strapdown
from maxq.control.kernel import vectors as vec
from maxq.control.kernel.jit import kernel, routine
from maxq.control.kernel.records import Array
from maxq.sim.vehicle.block import Q_BI, R_I, V_I
from maxq.sim.world.earth import Earth, gravitation


@dataclass(frozen=True)
class Navigation:
    """The errors at the start; in I, and the attitude (rotation vector) in B.

    `on`: 0 without errors.
    """

    on: int
    position_m: Annotated[Array, (3,)]
    velocity_mps: Annotated[Array, (3,)]
    alignment_rad: Annotated[Array, (3,)]


@dataclass
class NavigationMemory:
    """The errors at the last sample, in I, and the true motion then."""

    position_m: Annotated[Array, (3,)]
    velocity_mps: Annotated[Array, (3,)]
    last_ns: int
    last_r_I_m: Annotated[Array, (3,)]
    last_v_I_mps: Annotated[Array, (3,)]
    last_q_BI: Annotated[Array, (4,)]


@kernel
def _keep(memory: NavigationMemory, y: Array, now_ns: int) -> None:
    memory.last_ns = now_ns
    vec.set_vector(memory.last_r_I_m, 0, vec.vector_at(y, R_I))
    vec.set_vector(memory.last_v_I_mps, 0, vec.vector_at(y, V_I))
    for k in range(4):
        memory.last_q_BI[k] = y[Q_BI + k]


@routine
def start_navigation(n: Navigation, memory: NavigationMemory, measured: Strapdown, y: Array, now_ns: int) -> None:
    """Set the errors, and the computer's attitude, to those of the start."""
    vec.set_vector(memory.position_m, 0, vec.vector_at(n.position_m, 0))
    vec.set_vector(memory.velocity_mps, 0, vec.vector_at(n.velocity_mps, 0))
    q = vec.quaternion_of(vec.vector_at(n.alignment_rad, 0))
    for k in range(4):
        measured.q[k] = q[k]
    _keep(memory, y, now_ns)


@routine
def advance_navigation(
    earth: Earth, memory: NavigationMemory, measured: Strapdown, start_q_BI: Array, y: Array, now_ns: int, held: int
) -> None:
    """Advance the errors to this sample; `measured` is the computer's attitude at the last one, R being `start_q_BI`.

    `held`: above 0 on the pad or rail, where the errors do not grow.
    """
    if held == 0:
        h = 1e-9 * (now_ns - memory.last_ns)
        r = vec.scaled(0.5, vec.add(vec.vector_at(y, R_I), vec.vector_at(memory.last_r_I_m, 0)))
        error, drift = vec.vector_at(memory.position_m, 0), vec.vector_at(memory.velocity_mps, 0)
        believed = vec.add(r, vec.add(error, vec.scaled(0.5 * h, drift)))
        g, own = gravitation(earth, r[0], r[1], r[2]), gravitation(earth, believed[0], believed[1], believed[2])
        gained = vec.add(vec.vector_at(y, V_I), vec.scaled(-1.0, vec.vector_at(memory.last_v_I_mps, 0)))
        sensed = vec.add(gained, vec.scaled(-h, g))
        computed = vec.quaternion_product(vec.quaternion_at(start_q_BI, 0), vec.quaternion_at(measured.q, 0))
        q = vec.quaternion_product(computed, vec.conjugate(vec.quaternion_at(memory.last_q_BI, 0)))
        turned = vec.rotate(vec.rotation_from_quaternion(q[0], q[1], q[2], q[3]), sensed)
        pulled = vec.scaled(h, vec.add(own, vec.scaled(-1.0, g)))
        growth = vec.add(vec.add(turned, vec.scaled(-1.0, sensed)), pulled)
        vec.set_vector(memory.velocity_mps, 0, vec.add(drift, growth))
        way = vec.scaled(h, vec.add(drift, vec.scaled(0.5, growth)))
        vec.set_vector(memory.position_m, 0, vec.add(error, way))
    _keep(memory, y, now_ns)
