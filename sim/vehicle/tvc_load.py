"""TVC load: the gimballed engine on the compliance of its actuators and mount, a degree of freedom in each plane.

The engine turns about its gimbal relative to the bent body by its own angles (delta_p, delta_y); a spring and a damper
lead from there to the actuators' position, so that acceleration of the gimbal, bending, slosh and the axial load drive
the engine back (docs/model.md, section 14). About its hinge it has the moment

    -k (delta - delta_a) - c (delta' - delta_a') - T z,    theta z' = delta' - |delta'| z,

the last being Dahl's friction (P. R. Dahl, A Solid Friction Model, Aerospace TOR-158, 1968): T the Coulomb torque,
theta the angle over which it builds up, so that the angle of 1 - 1/e of the torque does not depend on the rate. A stop
of the engine's own angle is a stiff one-sided spring.

Per unit of an engine's angular acceleration the vehicle feels a force, a moment and generalised forces on the modes; by
reciprocity these are what its accelerations do to the hinge. A load adds two unknowns to the small system of the
pendulums' tensions (slosh.accelerate): exact, and nothing where there is none.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

from maxq.control.kernel.jit import kernel, routine
from maxq.control.kernel.records import Array
from maxq.control.kernel.rows import DEG, PitchYaw
from maxq.control.kernel.vectors import (
    Symmetric,
    Vector,
    add,
    cross,
    dot,
    scaled,
    set_vector,
    sine_cosine,
    symmetric_times,
    vector_at,
)
from maxq.sim.vehicle.bending import add_to_modes, modal_sum, of_plane
from maxq.sim.vehicle.block import Counts, Sizes, StateBlock
from maxq.sim.vehicle.engine import Engine
from maxq.sim.vehicle.faults import ACTUATOR_FAULT, FLOATING
from maxq.sim.vehicle.schedule import (
    MODE_INVERSE_MASS,
    MODE_PHI_GIMBAL,
    MODE_SLOPE_GIMBAL,
    PITCH,
    YAW,
    derived_column,
    mode_column,
    padded_modes,
)
from maxq.sim.vehicle.workspace import (
    ACCEL,
    ACTUATOR_PITCH,
    ACTUATOR_YAW,
    GIMBAL_BEND,
    HINGE_MOMENT,
    LOAD,
    LOAD_MODAL,
    LOAD_MODAL_WIDTH,
    LOAD_WIDTH,
    NU,
    TENSION,
)

if TYPE_CHECKING:
    from maxq.sim.vehicle.rigid import Deflected  # which imports slosh, which imports this module

TVC_LOADS = StateBlock(
    {
        f"tvc_load_{{}}_{plane}_{state}": unit
        for plane in ("pitch", "yaw")
        for state, unit in (("rad", "rad"), ("rate_radps", "rad/s"), ("friction", "1"))
    },
    "tvc_loads",
)
N_TVC_LOAD = len(TVC_LOADS.states)
N_AXIS = N_TVC_LOAD // 2

# an unknown's block of the workspace: per unit of angular acceleration of the engine, 1/(rad/s2)
FORCE = 0  # on the vehicle, B, N (3)
MOMENT = 3  # about the CG with the engine deflected, B, N m (3)
RIGID_ACCEL = 6  # of that CG, m/s2 (3)
ALPHA = 9  # angular acceleration of the body, rad/s2 (3)
KNOWN = 12  # moment about the hinge without the accelerations sought, N m
INERTIA = 13  # about the hinge, kg m2
STOP_FACTOR = 10.0  # stiffness of a stop over that of the spring, where nothing else is given


@dataclass(frozen=True)
class TvcLoad:
    stiffness_Nmprad: float
    damping_Nmsprad: float
    friction_Nm: float
    friction_angle_rad: float
    stop_stiffness_Nmprad: float
    stop_pitch_rad: float
    stop_yaw_rad: float


def pack_tvc_load(given: Any, engine: Engine, stop_pitch_rad: float, stop_yaw_rad: float) -> TvcLoad:
    """From the stage's section `tvc_load` or None, and its engines, which count as one; stops are the actuators'."""
    if given is None:
        return TvcLoad(0.0, 0.0, 0.0, 1.0, 0.0, math.inf, math.inf)
    inertia = float(engine.inertia_kgm2[0] + engine.gimballed_mass_kg[0] * engine.cg_from_gimbal_m[0] ** 2)
    stiffness = given.stiffness_Nmprad
    if stiffness is None:
        stiffness = inertia * (2.0 * math.pi * given.frequency_hz) ** 2
    return TvcLoad(
        stiffness_Nmprad=stiffness,
        damping_Nmsprad=2.0 * given.damping_ratio * math.sqrt(stiffness * inertia),
        friction_Nm=given.friction_Nm,
        friction_angle_rad=math.radians(given.friction_angle_deg),
        stop_stiffness_Nmprad=given.stop_stiffness_Nmprad or STOP_FACTOR * stiffness,
        stop_pitch_rad=stop_pitch_rad,
        stop_yaw_rad=stop_yaw_rad,
    )


@kernel
def load_block(unknown: int) -> int:
    """Where the workspace holds the block of an unknown: pitch and yaw acceleration of each load in turn."""
    return LOAD + LOAD_WIDTH * unknown


@kernel
def load_modal(unknown: int, accelerations: int) -> int:
    """Where it holds the generalised forces of an unknown on the modes (0), or the accelerations they make (1)."""
    return LOAD_MODAL + LOAD_MODAL_WIDTH * (2 * unknown + accelerations)


@kernel
def hinge_moment(load: TvcLoad, y: Array, i: int, position: float, rate: float, stop: float, floating: int) -> float:
    """Moment of spring, damper, friction and stop on the engine about its hinge, N m; states at y[i:i+3]."""
    moment: float = -load.friction_Nm * y[i + 2]
    if floating == 0:
        moment -= load.stiffness_Nmprad * (y[i] - position) + load.damping_Nmsprad * (y[i + 1] - rate)
    if abs(y[i]) > stop:
        moment -= load.stop_stiffness_Nmprad * (y[i] - math.copysign(stop, y[i]))
    return moment


@routine
def prepare_load(
    load: TvcLoad, e: Engine, engine: Deflected, offset: Vector, sizes: Counts, rate: Vector, axial_load: float,
    properties: Array, y: Array, first: int, faults: Array, work: Array, aux: Array,
) -> None:  # fmt: skip  # fourteen lines otherwise
    """Fill the blocks of both unknowns of the load whose states lie at y[first:first+6].

    `offset` leads from the core CG to the CG with the engine deflected.
    """
    mass, arm, inertia = e.gimballed_mass_kg[0], e.cg_from_gimbal_m[0], e.inertia_kgm2[0]
    unbalance, about_hinge = mass * arm, inertia + mass * arm * arm
    sp, cp = sine_cosine(y[first] + e.turned_pitch_rad[0])
    sy, cy = sine_cosine(y[first + N_AXIS] + e.turned_yaw_rad[0])
    pitch_rate, yaw_rate = y[first + 1], y[first + N_AXIS + 1]
    slope_y, slope_z = aux[GIMBAL_BEND + 2], aux[GIMBAL_BEND + 3]
    turning_y = modal_sum(sizes, properties, mode_column(sizes, PITCH, MODE_SLOPE_GIMBAL), work, of_plane(NU, PITCH))
    turning_z = -modal_sum(sizes, properties, mode_column(sizes, YAW, MODE_SLOPE_GIMBAL), work, of_plane(NU, YAW))
    at = add((engine.gimbal[0] - arm, engine.gimbal[1], engine.gimbal[2]), engine.delta)
    felt = add(cross(rate, cross(rate, at)), scaled(2.0, cross(rate, engine.delta_rate)))
    axis_rate = cross(engine.relative_rate, engine.axis)
    spin = scaled(2.0, cross((rate[0], rate[1] + turning_y, rate[2] + turning_z), axis_rate))
    for k in range(2):
        at_k, stop = ACTUATOR_PITCH + 2 * k, load.stop_pitch_rad if k == 0 else load.stop_yaw_rad
        floating = 1 if faults[ACTUATOR_FAULT + k] == FLOATING else 0
        aux[HINGE_MOMENT + k] = hinge_moment(load, y, first + N_AXIS * k, aux[at_k], aux[at_k + 1], stop, floating)
    for k in range(2):
        if k == 0:  # derivative of the thrust axis by the angle, and that angle's own centrifugal terms
            along, lever, own = (-sp * cy, 0.0, cp * cy), cy * cy, 2.0 * cy * sy * pitch_rate * yaw_rate
        else:
            along, lever, own = (-cp * sy, -cy, -sp * sy), 1.0, -cy * sy * pitch_rate * pitch_rate
        b, turn = load_block(k), cross(engine.axis, along)
        force = scaled(unbalance, along)
        moment = add(scaled(unbalance, cross(at, along)), scaled(-inertia, turn))
        set_vector(work, b + FORCE, force)
        set_vector(work, b + MOMENT, add(moment, scaled(-1.0, cross(offset, force))))
        work[b + INERTIA] = about_hinge * lever
        known = aux[HINGE_MOMENT + k] + unbalance * dot(along, felt) - inertia * dot(along, spin)
        known += unbalance * axial_load * (slope_y * along[2] - slope_z * along[1]) + about_hinge * own
        work[b + KNOWN] = known
        _modal_forces(sizes, properties, force, arm, inertia, turn, load_modal(k, 0), work)


@kernel
def _modal_forces(
    sizes: Counts, properties: Array, force: Vector, arm: float, inertia: float, turn: Vector, quantity: int,
    work: Array,
) -> None:  # fmt: skip  # ten lines otherwise
    pitch, yaw = of_plane(quantity, PITCH), of_plane(quantity, YAW)
    for j in range(padded_modes(sizes)):
        work[pitch + j], work[yaw + j] = 0.0, 0.0
    about_y, about_z = arm * force[2] - inertia * turn[1], -arm * force[1] - inertia * turn[2]
    add_to_modes(sizes, properties, mode_column(sizes, PITCH, MODE_PHI_GIMBAL), force[2], work, pitch)
    add_to_modes(sizes, properties, mode_column(sizes, PITCH, MODE_SLOPE_GIMBAL), about_y, work, pitch)
    add_to_modes(sizes, properties, mode_column(sizes, YAW, MODE_PHI_GIMBAL), force[1], work, yaw)
    add_to_modes(sizes, properties, mode_column(sizes, YAW, MODE_SLOPE_GIMBAL), -about_z, work, yaw)


@routine
def load_responses(sizes: Counts, inverse_mass: float, inverse: Symmetric, properties: Array, work: Array) -> None:
    """Accelerations of body and modes per unit of each unknown, without pendulums."""
    for k in range(2 * sizes.tvc_loads):
        b, force, accel = load_block(k), load_modal(k, 0), load_modal(k, 1)
        set_vector(work, b + RIGID_ACCEL, scaled(inverse_mass, vector_at(work, b + FORCE)))
        set_vector(work, b + ALPHA, symmetric_times(inverse, vector_at(work, b + MOMENT)))
        for plane in (PITCH, YAW):
            inverse_at = derived_column(sizes, plane, MODE_INVERSE_MASS)
            for j in range(padded_modes(sizes)):
                work[of_plane(accel, plane) + j] = work[of_plane(force, plane) + j] * properties[inverse_at + j]


@routine
def moment_about_hinge(sizes: Counts, k: int, accel: Vector, alpha: Vector, modal: int, work: Array) -> float:
    """Moment on the hinge of unknown k by accelerations of the CG, of the body's rotation and of the modes, N m."""
    b, force = load_block(k), load_modal(k, 0)
    total: float = dot(vector_at(work, b + FORCE), accel) + dot(vector_at(work, b + MOMENT), alpha)
    for plane in (PITCH, YAW):
        for j in range(padded_modes(sizes)):
            total += work[of_plane(force, plane) + j] * work[of_plane(modal, plane) + j]
    return total


@routine
def add_load_to_modes(sizes: Counts, k: int, amount: float, work: Array) -> None:
    """Add what the acceleration `amount` of unknown k does to the modal accelerations."""
    modal = load_modal(k, 1)
    for plane in (PITCH, YAW):
        for j in range(padded_modes(sizes)):
            work[of_plane(ACCEL, plane) + j] += amount * work[of_plane(modal, plane) + j]


@routine
def load_derivative(load: TvcLoad, sizes: Counts, y: Array, first: int, dy: Array, work: Array) -> None:
    """Derivatives of the states at y[first:first+6] once the accelerations are known."""
    for k in range(2):
        i = first + N_AXIS * k
        dy[i], dy[i + 1], dy[i + 2] = y[i + 1], work[TENSION + sizes.pendulums + k], 0.0
        if load.friction_Nm > 0.0:
            dy[i + 2] = (y[i + 1] - abs(y[i + 1]) * y[i + 2]) / load.friction_angle_rad


class TvcLoadRow(NamedTuple):
    actuator_axis_angle_deg: Annotated[PitchYaw, "deg", "position of the actuator, as an angle of the engine"]
    hinge_axis_moment_Nm: Annotated[PitchYaw, "N m", "moment on the engine about its gimbal"]


@kernel
def tvc_load_row(sizes: Sizes, aux: Array) -> TvcLoadRow:
    """Nan for a stage whose engine follows its actuators."""
    if sizes.tvc_loads == 0:
        return TvcLoadRow(PitchYaw(math.nan, math.nan), PitchYaw(math.nan, math.nan))
    return TvcLoadRow(
        actuator_axis_angle_deg=PitchYaw(DEG * aux[ACTUATOR_PITCH], DEG * aux[ACTUATOR_YAW]),
        hinge_axis_moment_Nm=PitchYaw(aux[HINGE_MOMENT], aux[HINGE_MOMENT + 1]),
    )
