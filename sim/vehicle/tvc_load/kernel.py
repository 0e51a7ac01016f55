"""TVC load: the gimballed engine on the compliance of its actuators and mount, a degree of freedom in each plane.

The engine turns about its gimbal relative to the bent body by its own angles (delta_p, delta_y). A spring and a damper
connect it to the position of the actuators. Acceleration of the gimbal, bending, slosh and the axial load therefore
move the engine (docs/model.md, section 14). The moment about its hinge is

    -k (delta - delta_a) - c (delta' - delta_a') - k_b delta - T z,    theta z' = delta' - |delta'| z,

where k_b is the stiffness of a flexible bearing, and the last term is Dahl's friction (P. R. Dahl, A Solid Friction
Model, Aerospace TOR-158, 1968). T is the Coulomb torque. theta is the angle over which it builds up, so that the angle
at 1 - 1/e of the torque does not depend on the rate. A stop of the engine's angle is a stiff one-sided spring.

Per unit of an engine's angular acceleration, a force, a moment and generalised modal forces act on the vehicle. By
reciprocity these give the effect of the vehicle's accelerations on the hinge. A load adds two unknowns to the small
system of the pendulums' tensions (accelerations.py). The system is exact, and without loads it is unchanged.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated, NamedTuple

from maxq.control.kernel.jit import kernel, routine
from maxq.control.kernel.limits import MAX_PENDULUMS, MAX_TVC_LOADS
from maxq.control.kernel.records import Array, IntArray
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
from maxq.sim.vehicle import schedule as sch
from maxq.sim.vehicle.block import Counts, Sizes, StateBlock
from maxq.sim.vehicle.engine.kernel import (
    Deflected,
    Engine,
    EngineOutputs,
    GimbalMotion,
    KeptEngines,
    deflected_at,
    set_motion,
)
from maxq.sim.vehicle.engine.modes import Rates, engine_velocity, gimbal_rates, load_at_gimbal, roll_moment_of_modes
from maxq.sim.vehicle.faults import ACTUATOR_FAULT, FLOATING
from maxq.sim.vehicle.modes.planar import (
    Modes,
    PerPlanarMode,
    add_multiple_of_modes,
    apply_gimbal_load,
    clear_modes,
    gimbal_displacement,
    modal_accelerations,
    product_of_modes,
)
from maxq.sim.vehicle.modes.spatial import PerSpatialMode, apply_spatial_load, spatial_motion

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
MAX_UNKNOWNS = MAX_PENDULUMS + 2 * MAX_TVC_LOADS

STOP_FACTOR = 10.0  # default stiffness of a stop relative to that of the spring


_PER_LOAD = (MAX_TVC_LOADS,)
LoadNumbers = Annotated[Array, _PER_LOAD]


@dataclass(frozen=True)
class TvcLoad:
    """The parameters of all TVC loads of a stage; `Sizes.tvc_loads` is their number."""

    engine: Annotated[IntArray, _PER_LOAD]  # number of the engine, as in engine/kernel.py
    stiffness_Nmprad: LoadNumbers
    bearing_Nmprad: LoadNumbers  # stiffness of a flexible bearing, towards the engine's position at rest
    damping_Nmsprad: LoadNumbers
    friction_Nm: LoadNumbers
    friction_angle_rad: LoadNumbers
    stop_stiffness_Nmprad: LoadNumbers
    stop_pitch_rad: LoadNumbers
    stop_yaw_rad: LoadNumbers
    play_pitch_rad: LoadNumbers  # full width of the gap between actuator and spring
    play_yaw_rad: LoadNumbers
    stall_pitch_Nm: LoadNumbers  # torque that stops the actuator; inf: none does
    stall_yaw_Nm: LoadNumbers
    stalls: int  # 1: one of them is finite


@dataclass
class TvcLoadOutputs:
    """The auxiliary outputs of the TVC loads: pitch and yaw of each load."""

    swing: Annotated[tuple[GimbalMotion, ...], (2 * MAX_TVC_LOADS,)]  # motion of the engine
    actuator_rad: Annotated[Array, (2 * MAX_TVC_LOADS,)]  # position of the actuators
    actuator_radps: Annotated[Array, (2 * MAX_TVC_LOADS,)]
    hinge_moment_Nm: Annotated[Array, (2 * MAX_TVC_LOADS,)]  # moment on the engine about its gimbal


@dataclass
class Swing:
    """The effects of one unknown, per unit of angular acceleration of the engine, in one evaluation."""

    force_N: Annotated[Array, (3,)]  # on the vehicle, B
    moment_Nm: Annotated[Array, (3,)]  # about the CG with deflected engines, including the moment through the modes, B
    accel_mps2: Annotated[Array, (3,)]  # of that CG
    alpha_radps2: Annotated[Array, (3,)]  # angular acceleration of the body
    known_Nm: float  # moment about the hinge without the accelerations sought
    inertia_kgm2: float  # about the hinge
    planar_force_N: PerPlanarMode  # generalised forces on the modes, and the resulting accelerations
    planar_accel_mps2: PerPlanarMode
    spatial_force_N: PerSpatialMode
    spatial_accel_mps2: PerSpatialMode


@dataclass
class System:
    """The small system of tensions and angular accelerations of engines on a load (accelerations.py)."""

    swing: Annotated[tuple[Swing, ...], (2 * MAX_TVC_LOADS,)]  # pitch and yaw of each load
    matrix: Annotated[Array, (MAX_UNKNOWNS * MAX_UNKNOWNS,)]  # row by row
    unknown: Annotated[Array, (MAX_UNKNOWNS,)]  # right-hand side, then tensions (N) and accelerations (rad/s2)


@routine
def swing_engines(
    load: TvcLoad, e: Engine, sizes: Counts, y: Array, first: int, engines: EngineOutputs, out: TvcLoadOutputs
) -> None:
    """Set angles and rates of engines on a load in `engines` and `out`, and write those of their actuators to `out`.

    The values of a group are those of its first engine.
    """
    for k in range(sizes.tvc_loads):
        channel = 2 * e.group[load.engine[k]]
        for axis in range(2):
            held = engines.channel[channel + axis]
            out.actuator_rad[2 * k + axis], out.actuator_radps[2 * k + axis] = held.angle_rad, held.rate_radps
    for back in range(sizes.tvc_loads):
        k = sizes.tvc_loads - 1 - back
        channel = 2 * e.group[load.engine[k]]
        for axis in range(2):
            i = first + N_TVC_LOAD * k + N_AXIS * axis
            set_motion(out.swing[2 * k + axis], (y[i], y[i + 1], 0.0))
            set_motion(engines.channel[channel + axis], (y[i], y[i + 1], 0.0))


@kernel
def hinge_moment(
    load: TvcLoad, k: int, y: Array, i: int, position: float, rate: float, stop: float, play: float, floating: int
) -> float:
    """Return the moment of spring, damper, bearing, friction and stop on an engine about its hinge, N m.

    Its states are at y[i:i+3].
    """
    moment: float = -load.friction_Nm[k] * y[i + 2]
    if load.bearing_Nmprad[k] > 0.0:
        moment -= load.bearing_Nmprad[k] * y[i]
    if floating == 0:
        moment -= link_moment(load, k, y, i, position, rate, play)
    if abs(y[i]) > stop:
        moment -= load.stop_stiffness_Nmprad[k] * (y[i] - math.copysign(stop, y[i]))
    return moment


@kernel
def link_moment(load: TvcLoad, k: int, y: Array, i: int, position: float, rate: float, play: float) -> float:
    """Return the moment of spring and damper against the engine's deflection, N m.

    Within the play neither acts, and at its ends they only push.
    """
    moment = 0.0
    if play == 0.0:
        moment = load.stiffness_Nmprad[k] * (y[i] - position) + load.damping_Nmsprad[k] * (y[i + 1] - rate)
    elif abs(y[i] - position) > 0.5 * play:
        side = math.copysign(1.0, y[i] - position)
        beyond = abs(y[i] - position) - 0.5 * play
        push = load.stiffness_Nmprad[k] * beyond + load.damping_Nmsprad[k] * (y[i + 1] - rate) * side
        moment = side * max(push, 0.0)
    return moment


@kernel
def resistance(
    load: TvcLoad, e: Engine, sizes: Counts, channel: int, y: Array, first: int, faults: Array, out: TvcLoadOutputs
) -> float:
    """Return the torque against which the actuators of a channel move their engines, relative to the stall torque.

    `channel` is twice the group, plus one in yaw. The states of the loads are at y[first:]. Actuators of a group resist
    together.
    """
    torque_Nm = stall_Nm = 0.0
    axis = channel % 2
    if faults[ACTUATOR_FAULT + channel] == FLOATING:
        return 0.0
    for n in range(sizes.tvc_loads):
        k, at = load.engine[n], 2 * n + axis
        if e.group[k] != channel // 2 or (e.follows_pitch[k] if axis == 0 else e.follows_yaw[k]) == 0.0:
            continue
        stall_Nm += load.stall_pitch_Nm[n] if axis == 0 else load.stall_yaw_Nm[n]
        play = load.play_pitch_rad[n] if axis == 0 else load.play_yaw_rad[n]
        i = first + N_TVC_LOAD * n + N_AXIS * axis
        torque_Nm -= link_moment(load, n, y, i, out.actuator_rad[at], out.actuator_radps[at], play)
    return torque_Nm / stall_Nm if 0.0 < stall_Nm < math.inf else 0.0


@routine
def prepare_loads(
    load: TvcLoad,
    e: Engine,
    first: Deflected,
    offset: Vector,
    sizes: Counts,
    rate: Vector,
    first_rates: Rates,
    axial_load: float,
    properties: Array,
    y: Array,
    states: int,
    faults: Array,
    engines: KeptEngines,
    modes: Modes,
    system: System,
    out: TvcLoadOutputs,
) -> None:
    """Compute both unknowns of each load, whose states are at y[states:].

    - `first`: first engine; `engines` contains the others.
    - `first_rates`: rates of the first gimbal's station due to the modes.
    - `offset`: vector from the core CG to the CG with deflected engines.
    """
    for n in range(sizes.tvc_loads):
        k, i = load.engine[n], states + N_TVC_LOAD * n
        engine = first if k == 0 else deflected_at(engines[k])
        mass, arm, inertia = e.gimballed_mass_kg[k], e.cg_from_gimbal_m[k], e.inertia_kgm2[k]
        unbalance, about_hinge = mass * arm, inertia + mass * arm * arm
        sp, cp = sine_cosine(y[i] + e.turned_pitch_rad[k])
        sy, cy = sine_cosine(y[i + N_AXIS] + e.turned_yaw_rad[k])
        pitch_rate, yaw_rate = y[i + 1], y[i + N_AXIS + 1]
        _, _, slope_y, slope_z = gimbal_displacement(sizes, properties, e.gimbal[k], modes.planar)
        rates = first_rates
        if e.gimbal[k] > 0:
            rates = gimbal_rates(sizes, properties, e.gimbal[k], modes)
        moved, turning = engine_velocity(e, k, rates), add(rate, rates[1])
        if sizes.spatial_modes > 0:
            place = sch.gimbal_place(sizes, e.gimbal[k])
            bent = spatial_motion(sizes, properties, place, modes.spatial.eta_m)
            slope_y, slope_z = slope_y + bent[4], slope_z + bent[5]
        cg = add(engine.gimbal, scaled(-arm, engine.axis))
        apparent = add(cross(rate, cross(rate, cg)), scaled(2.0, cross(rate, engine.delta_rate)))
        # the quasi-velocities contain the other half
        apparent = add(apparent, (0.0, -rate[0] * moved[2], rate[0] * moved[1]))
        spin = cross(turning, cross(engine.relative_rate, engine.axis))
        for axis in range(2):
            unknown = 2 * n + axis
            if axis == 0:  # derivative of the thrust axis by the angle, and that angle's own centrifugal terms
                along, lever, own = (-sp * cy, 0.0, cp * cy), cy * cy, 2.0 * cy * sy * pitch_rate * yaw_rate
                moves, stop, play = e.follows_pitch[k], load.stop_pitch_rad[n], load.play_pitch_rad[n]
            else:
                along, lever, own = (-cp * sy, -cy, -sp * sy), 1.0, -cy * sy * pitch_rate * pitch_rate
                moves, stop, play = e.follows_yaw[k], load.stop_yaw_rad[n], load.play_yaw_rad[n]
            floating = 1 if faults[ACTUATOR_FAULT + 2 * e.group[k] + axis] == FLOATING else 0
            position, speed = out.actuator_rad[unknown], out.actuator_radps[unknown]
            moment_Nm = hinge_moment(load, n, y, i + N_AXIS * axis, position, speed, stop, play, floating)
            if moves == 0.0:  # not gimballed in this plane
                along, lever, own, moment_Nm = (0.0, 0.0, 0.0), 1.0, 0.0, 0.0
            out.hinge_moment_Nm[unknown] = moment_Nm
            swing, turn = system.swing[unknown], cross(engine.axis, along)
            force = scaled(unbalance, along)
            moment = add(scaled(unbalance, cross(cg, along)), scaled(-inertia, turn))
            set_vector(swing.force_N, 0, force)
            set_vector(swing.moment_Nm, 0, add(moment, scaled(-1.0, cross(offset, force))))
            swing.inertia_kgm2 = about_hinge * lever
            known = moment_Nm + unbalance * dot(along, apparent) - inertia * dot(along, spin)
            known += unbalance * axial_load * (slope_y * along[2] - slope_z * along[1]) + about_hinge * own
            swing.known_Nm = known
            _modal_forces(sizes, properties, e, k, force, scaled(-inertia, turn), swing)
            swing.moment_Nm[0] += roll_moment_of_modes(sizes, swing.planar_force_N, swing.spatial_force_N, modes)


@routine
def _modal_forces(
    sizes: Counts, properties: Array, e: Engine, k: int, force: Vector, couple: Vector, swing: Swing
) -> None:
    """Set the modal forces of a force at the CG of engine k at rest and of a couple (docs/model.md, 3.4)."""
    clear_modes(sizes, swing.planar_force_N)
    at_gimbal = load_at_gimbal(e, k, force, couple)
    apply_gimbal_load(sizes, properties, e.gimbal[k], at_gimbal, swing.planar_force_N)
    if sizes.spatial_modes > 0:
        for j in range(sizes.spatial_modes):
            swing.spatial_force_N[j] = 0.0
        apply_spatial_load(sizes, properties, sch.gimbal_place(sizes, e.gimbal[k]), at_gimbal, swing.spatial_force_N)


@routine
def load_responses(sizes: Counts, inverse_mass: float, inverse: Symmetric, properties: Array, system: System) -> None:
    """Set the accelerations of body and modes per unit of each unknown, without pendulums."""
    for k in range(2 * sizes.tvc_loads):
        swing = system.swing[k]
        set_vector(swing.accel_mps2, 0, scaled(inverse_mass, vector_at(swing.force_N, 0)))
        set_vector(swing.alpha_radps2, 0, symmetric_times(inverse, vector_at(swing.moment_Nm, 0)))
        modal_accelerations(sizes, properties, swing.planar_force_N, swing.planar_accel_mps2)
        for j in range(sizes.spatial_modes):
            inverse_mass_j = properties[sch.spatial_derived(sizes, sch.MODE_INVERSE_MASS) + j]
            swing.spatial_accel_mps2[j] = swing.spatial_force_N[j] * inverse_mass_j


@routine
def moment_about_hinge(
    sizes: Counts, swing: Swing, accel: Vector, alpha: Vector, planar_mps2: Array, spatial_mps2: Array
) -> float:
    """Return the moment on the hinge of an unknown due to the accelerations of the vehicle, N m.

    `accel` is that of the CG with deflected engines, `alpha` the angular acceleration; the others are those of the
    modes.
    """
    total: float = dot(vector_at(swing.force_N, 0), accel) + dot(vector_at(swing.moment_Nm, 0), alpha)
    total += product_of_modes(sizes, swing.planar_force_N, planar_mps2)
    for j in range(sizes.spatial_modes):
        total += swing.spatial_force_N[j] * spatial_mps2[j]
    return total


@routine
def add_load_to_modes(sizes: Counts, swing: Swing, amount: float, modes: Modes) -> None:
    """Add the effect of the acceleration `amount` of an unknown to the modal accelerations."""
    add_multiple_of_modes(sizes, swing.planar_accel_mps2, amount, modes.planar.accel_mps2)
    for j in range(sizes.spatial_modes):
        modes.spatial.accel_mps2[j] += amount * swing.spatial_accel_mps2[j]


@routine
def load_derivative(
    load: TvcLoad,
    e: Engine,
    sizes: Counts,
    y: Array,
    first: int,
    dy: Array,
    system: System,
    engines: EngineOutputs,
    out: TvcLoadOutputs,
) -> None:
    """Write the derivatives of the states at y[first:] and the accelerations of the engines, once they are known."""
    for back in range(2 * sizes.tvc_loads):
        k = 2 * sizes.tvc_loads - 1 - back
        n, i, accel = k // 2, first + N_AXIS * k, system.unknown[sizes.pendulums + k]
        dy[i], dy[i + 1], dy[i + 2] = y[i + 1], accel, 0.0
        if load.friction_Nm[n] > 0.0:
            dy[i + 2] = (y[i + 1] - abs(y[i + 1]) * y[i + 2]) / load.friction_angle_rad[n]
        out.swing[k].accel_radps2 = accel
        engines.channel[2 * e.group[load.engine[n]] + k % 2].accel_radps2 = accel


class TvcLoadRow(NamedTuple):
    actuator_axis_angle_deg: Annotated[PitchYaw, "deg", "position of the actuator, as an angle of the engine"]
    hinge_axis_moment_Nm: Annotated[PitchYaw, "N m", "moment on the engine about its gimbal"]


class SwingRow(NamedTuple):
    """The logged values of a swinging engine, in a vehicle with several such engines."""

    swing_load_axis_angle_deg: Annotated[PitchYaw, "deg", "angle of the engine"]
    actuator_load_axis_angle_deg: Annotated[PitchYaw, "deg", "position of its actuators, as an angle"]
    hinge_load_axis_moment_Nm: Annotated[PitchYaw, "N m", "moment on the engine about its gimbal"]


@kernel
def swing_row(loads: int, n: int, out: TvcLoadOutputs) -> SwingRow:
    """Return the row of an engine; all values are nan for a load that the stage does not have."""
    if n >= loads:
        none = PitchYaw(math.nan, math.nan)
        return SwingRow(none, none, none)
    return SwingRow(
        swing_load_axis_angle_deg=PitchYaw(DEG * out.swing[2 * n].angle_rad, DEG * out.swing[2 * n + 1].angle_rad),
        actuator_load_axis_angle_deg=PitchYaw(DEG * out.actuator_rad[2 * n], DEG * out.actuator_rad[2 * n + 1]),
        hinge_load_axis_moment_Nm=PitchYaw(out.hinge_moment_Nm[2 * n], out.hinge_moment_Nm[2 * n + 1]),
    )


@kernel
def tvc_load_row(sizes: Sizes, out: TvcLoadOutputs) -> TvcLoadRow:
    """Return the row of the first load; all values are nan for a stage whose engines follow their actuators."""
    if sizes.tvc_loads == 0:
        return TvcLoadRow(PitchYaw(math.nan, math.nan), PitchYaw(math.nan, math.nan))
    return TvcLoadRow(
        actuator_axis_angle_deg=PitchYaw(DEG * out.actuator_rad[0], DEG * out.actuator_rad[1]),
        hinge_axis_moment_Nm=PitchYaw(out.hinge_moment_Nm[0], out.hinge_moment_Nm[1]),
    )
