"""The compiled Jacobian of the simulator's derivative in local coordinates.

The simulator's state is on a manifold (a unit quaternion, unit vectors of the pendulums) and contains inertial and
quasi-velocities. The linear model has independent coordinates, which design/model/linearised.py defines. The array `x`
contains them in this order, with m pitch modes, n yaw modes and s spatial modes:

    r_I (3) | velocity over ground in B (3) | rotation vector (3) | w_BI_B (3) | actuators, gyros and their integrals
    eta (m), eta' (m) | xi (n), xi' (n) | spatial modes and their quasi-velocities (2 s) | four per pendulum
    all states of the simulator after the pendulums

The inputs follow the coordinates: the command of each actuator (pitch, yaw of each group), rad, and the velocity of the
air in B, m/s (3).
"""

from __future__ import annotations

import math

from maxq.control.kernel.jit import bare_pointer, entry, kernel, routine
from maxq.control.kernel.records import Array, IntArray, Records
from maxq.control.kernel.tables import find_interval
from maxq.control.kernel.vectors import (
    Quaternion,
    Vector,
    add,
    cross,
    dot,
    quaternion_at,
    quaternion_of,
    quaternion_product,
    rotate,
    rotate_back,
    rotation_from_quaternion,
    scaled,
    set_vector,
    vector_at,
)
from maxq.sim.flight.parameters import Memory, Parameters
from maxq.sim.flight.step import evaluate, read_schedule, schedule_clock
from maxq.sim.run.evaluate import Space
from maxq.sim.vehicle import state as states
from maxq.sim.vehicle.block import Q_BI, R_I, V_I, W_BI_B, Counts, counts
from maxq.sim.vehicle.derivative import derive_properties
from maxq.sim.vehicle.loads.columns import MOMENT_Y, MOMENT_Z, SECTION_WIDTH
from maxq.sim.vehicle.loads.kernel import evaluate_sections
from maxq.sim.vehicle.workspace import Evaluation, Work

PLACE, VELOCITY, TURN, RATE, FLAT = 0, 3, 6, 9, 12  # first indices of the coordinates
FLEXIBLE = FLAT + states.N_FIXED - states.ACTUATOR
OUTPUTS = (
    4  # engine angle in pitch and yaw, local rate at the gyro about y and z; then bending moments about y, about z
)
LEVELS = 6  # maximum number of extrapolation levels, each with half the step of the previous one


@kernel
def coordinate_count(sizes: Counts) -> int:
    """Return the number of coordinates, without the inputs."""
    behind = states.state_size(sizes) - states.pendulum_index(sizes, sizes.pendulums)
    modes = sizes.pitch_modes + sizes.yaw_modes + sizes.spatial_modes
    return FLEXIBLE + 2 * modes + 4 * sizes.pendulums + behind


@kernel
def _partner(values: Array, first: int, k: int, count: int) -> float:
    """Return element k of a plane's modes, or zero beyond the last mode.

    Modes of both planes are paired as far as both exist.
    """
    value: float = values[first + k] if k < count else 0.0
    return value


@routine
def coordinates_of(sizes: Counts, spin_radps: float, y: Array, x: Array) -> None:
    """Compute the coordinates `x` of the state `y`, whose attitude is the reference."""
    m, n = sizes.pitch_modes, sizes.yaw_modes
    eta, xi, w = states.eta_index(sizes), states.xi_index(sizes), vector_at(y, W_BI_B)
    q = quaternion_at(y, Q_BI)
    ground = cross((0.0, 0.0, spin_radps), vector_at(y, R_I))
    over_ground = add(vector_at(y, V_I), scaled(-1.0, ground))
    set_vector(x, PLACE, vector_at(y, R_I))
    set_vector(x, VELOCITY, rotate_back(rotation_from_quaternion(q[0], q[1], q[2], q[3]), over_ground))
    set_vector(x, TURN, (0.0, 0.0, 0.0))
    set_vector(x, RATE, w)
    for i in range(FLEXIBLE - FLAT):
        x[FLAT + i] = y[states.ACTUATOR + i]
    at = FLEXIBLE
    for i in range(m):
        x[at + i] = y[eta + i]
        x[at + m + i] = y[eta + m + i] - w[0] * _partner(y, xi, i, n)
    at += 2 * m
    for i in range(n):
        x[at + i] = y[xi + i]
        x[at + n + i] = y[xi + n + i] + w[0] * _partner(y, eta, i, m)
    at += 2 * n
    for i in range(2 * sizes.spatial_modes):
        x[at + i] = y[states.spatial_index(sizes) + i]
    at += 2 * sizes.spatial_modes
    for k in range(sizes.pendulums):
        i = states.pendulum_index(sizes, k)
        u = vector_at(y, i)
        u_rate = add(vector_at(y, i + 3), scaled(-1.0, cross(w, u)))
        for plane in range(2):
            angle, rate, _ = _angle(u, u_rate, (0.0, 0.0, 0.0), plane)
            x[at + 2 * plane], x[at + 2 * plane + 1] = angle, rate
        at += 4
    behind = states.pendulum_index(sizes, sizes.pendulums)
    for i in range(states.state_size(sizes) - behind):
        x[at + i] = y[behind + i]


@routine
def state_of(sizes: Counts, spin_radps: float, reference: Quaternion, x: Array, y: Array) -> None:
    """Compute the simulator's state `y` at coordinates `x` relative to a reference attitude."""
    m, n = sizes.pitch_modes, sizes.yaw_modes
    eta, xi, w, r = states.eta_index(sizes), states.xi_index(sizes), vector_at(x, RATE), vector_at(x, PLACE)
    q = quaternion_product(reference, quaternion_of(vector_at(x, TURN)))
    moving = rotate(rotation_from_quaternion(q[0], q[1], q[2], q[3]), vector_at(x, VELOCITY))
    set_vector(y, R_I, r)
    set_vector(y, V_I, add(moving, cross((0.0, 0.0, spin_radps), r)))
    y[Q_BI], y[Q_BI + 1], y[Q_BI + 2], y[Q_BI + 3] = q[0], q[1], q[2], q[3]
    set_vector(y, W_BI_B, w)
    for i in range(FLEXIBLE - FLAT):
        y[states.ACTUATOR + i] = x[FLAT + i]
    at, across = FLEXIBLE, FLEXIBLE + 2 * m
    for i in range(m):
        y[eta + i] = x[at + i]
        y[eta + m + i] = x[at + m + i] + w[0] * _partner(x, across, i, n)
    for i in range(n):
        y[xi + i] = x[across + i]
        y[xi + n + i] = x[across + n + i] - w[0] * _partner(x, at, i, m)
    at = across + 2 * n
    for i in range(2 * sizes.spatial_modes):
        y[states.spatial_index(sizes) + i] = x[at + i]
    at += 2 * sizes.spatial_modes
    for k in range(sizes.pendulums):
        i = states.pendulum_index(sizes, k)
        u, u_rate = _bob(x[at], x[at + 1], x[at + 2], x[at + 3])
        set_vector(y, i, u)
        set_vector(y, i + 3, add(u_rate, cross(w, u)))
        at += 4
    behind = states.pendulum_index(sizes, sizes.pendulums)
    for i in range(states.state_size(sizes) - behind):
        y[behind + i] = x[at + i]


@routine
def rates_of(sizes: Counts, spin_radps: float, turning: Vector, x: Array, y: Array, dy: Array, out: Array) -> None:
    """Compute the time derivative of the coordinates, `out`, from the derivative `dy` of the state.

    The reference attitude rotates at `turning` (rad/s) in B.
    """
    m, n = sizes.pitch_modes, sizes.yaw_modes
    eta, xi, w, w_rate = states.eta_index(sizes), states.xi_index(sizes), vector_at(x, RATE), vector_at(dy, W_BI_B)
    spin, turn = (0.0, 0.0, spin_radps), vector_at(x, TURN)
    moving = add(vector_at(dy, V_I), scaled(-1.0, cross(spin, vector_at(y, V_I))))
    moving = rotate_back(rotation_from_quaternion(y[Q_BI], y[Q_BI + 1], y[Q_BI + 2], y[Q_BI + 3]), moving)
    set_vector(out, PLACE, vector_at(dy, R_I))
    set_vector(out, VELOCITY, add(moving, scaled(-1.0, cross(w, vector_at(x, VELOCITY)))))
    q = quaternion_of(turn)
    here = rotate_back(rotation_from_quaternion(q[0], q[1], q[2], q[3]), turning)
    set_vector(out, TURN, _vector_rate(turn, add(w, scaled(-1.0, here))))
    set_vector(out, RATE, w_rate)
    for i in range(FLEXIBLE - FLAT):
        out[FLAT + i] = dy[states.ACTUATOR + i]
    # eta' is that of the simulator's derivative, without conversion from the quasi-velocity
    at, across = FLEXIBLE, FLEXIBLE + 2 * m
    for i in range(m):
        rolls = w_rate[0] * _partner(x, across, i, n) + w[0] * _partner(x, across + n, i, n)
        out[at + i], out[at + m + i] = dy[eta + i], dy[eta + m + i] - rolls
    for i in range(n):
        rolls = w_rate[0] * _partner(x, at, i, m) + w[0] * _partner(x, at + m, i, m)
        out[across + i], out[across + n + i] = dy[xi + i], dy[xi + n + i] + rolls
    at = across + 2 * n
    for i in range(2 * sizes.spatial_modes):
        out[at + i] = dy[states.spatial_index(sizes) + i]
    at += 2 * sizes.spatial_modes
    for k in range(sizes.pendulums):
        i = states.pendulum_index(sizes, k)
        u, u_rate = vector_at(y, i), vector_at(dy, i)
        turns = add(cross(w_rate, u), cross(w, u_rate))
        u_accel = add(vector_at(dy, i + 3), scaled(-1.0, turns))
        for plane in range(2):
            _, rate, accel = _angle(u, u_rate, u_accel, plane)
            out[at + 2 * plane], out[at + 2 * plane + 1] = rate, accel
        at += 4
    behind = states.pendulum_index(sizes, sizes.pendulums)
    for i in range(states.state_size(sizes) - behind):
        out[at + i] = dy[behind + i]


@kernel
def _vector_rate(vector: Vector, turning: Vector) -> Vector:
    """Return the rate of a rotation vector, given the angular velocity in the rotated axes.

    The formula is a series of the inverse right Jacobian for small angles; the first omitted term is of order 8.
    """
    square = dot(vector, vector)
    factor = 1.0 / 12.0 + square * (1.0 / 720.0 + square / 30240.0)
    once = cross(vector, turning)
    return add(turning, add(scaled(0.5, once), scaled(factor, cross(vector, once))))


@kernel
def _angle(u: Vector, u_rate: Vector, u_accel: Vector, plane: int) -> tuple[float, float, float]:
    """Return atan2 of the bob's lateral component (pitch: z, yaw: y) over -u_x, and its first two time derivatives."""
    a, a1, a2 = (u[2], u_rate[2], u_accel[2]) if plane == 0 else (u[1], u_rate[1], u_accel[1])
    b, b1, b2 = -u[0], -u_rate[0], -u_accel[0]
    square, turned = a * a + b * b, a1 * b - a * b1
    rate = turned / square
    return math.atan2(a, b), rate, (a2 * b - a * b2) / square - 2.0 * rate * (a * a1 + b * b1) / square


@kernel
def _bob(pitch: float, pitch_rate: float, yaw: float, yaw_rate: float) -> tuple[Vector, Vector]:
    """Return the unit vector from hinge to bob and its rate in B. The angles must be below 90 degrees."""
    to_z, to_y = math.tan(pitch), math.tan(yaw)
    along = (-1.0, to_y, to_z)
    along_rate = (0.0, yaw_rate * (1.0 + to_y * to_y), pitch_rate * (1.0 + to_z * to_z))
    length = math.sqrt(dot(along, along))
    u = scaled(1.0 / length, along)
    return u, scaled(1.0 / length, add(along_rate, scaled(-dot(u, along_rate), u)))


@routine
def motion(
    p: Parameters,
    pool: Array,
    memory: Memory,
    now_ns: int,
    reference: Array,
    command: Array,
    x: Array,
    at: Evaluation,
    work: Work,
    columns: Array,
    out: Array,
) -> None:
    """Compute the rates of the coordinates at `x`, followed by the outputs, into `out`.

    `reference` contains attitude and angular velocity. The inputs in `x` are added to those in `command`.
    """
    sizes = counts(p.vehicle.sizes)
    n, groups, spin = coordinate_count(sizes), 1 + sizes.further_groups, p.environment.earth.rate_radps
    held, inputs = memory.held, memory.inputs
    for k in range(2 * groups):
        held.command_rad[k] = command[k] + x[n + k]
    gust = n + 2 * groups
    inputs.gust_x_mps = command[2 * groups] + x[gust]
    inputs.gust_y_mps = command[2 * groups + 1] + x[gust + 1]
    inputs.gust_z_mps = command[2 * groups + 2] + x[gust + 2]
    state_of(sizes, spin, quaternion_at(reference, 0), x, at.y)
    evaluate(p, pool, memory, now_ns, 0.0, at, work)
    rates_of(sizes, spin, vector_at(reference, 4), x, at.y, at.dy, out)
    channel, bending = at.aux.engines.channel, at.aux.gyro_bending_radps
    out[n], out[n + 1] = channel[0].angle_rad, channel[1].angle_rad
    out[n + 2], out[n + 3] = at.y[W_BI_B + 1] + bending[0], at.y[W_BI_B + 2] + bending[1]
    stations = p.loads.stations
    if stations > 0:
        clock_s = schedule_clock(p, memory.clock, now_ns, 0.0)
        evaluate_sections(p.loads, p.vehicle, memory.inputs, pool, clock_s, at, work, columns, memory.sections)
        for k in range(stations):
            first = SECTION_WIDTH * k
            out[n + OUTPUTS + k] = memory.sections.section[first + MOMENT_Y]
            out[n + OUTPUTS + stations + k] = memory.sections.section[first + MOMENT_Z]


@entry
def differentiate(
    P: Records,
    pool: Array,
    state: Records,
    y: Array,
    now_ns: int,
    read: int,
    which: IntArray,
    steps: Array,
    wanted: IntArray,
    levels: int,
    properties: Array,
    space: Records,
    x: Array,
    tableau: Array,
    rate: Array,
    slopes: Array,
) -> None:
    """Compute the rates and outputs at the states `y` and their derivatives.

    `rate` (vehicles, rows) receives the rates and outputs at `y` (vehicles, MAX_STATE). `slopes` (vehicles, wanted,
    columns) receives the derivatives of the `wanted` rows.

    Vehicle k has row `memory.clock.stage` + k of `P` and row k of `y` and `properties`. `which` contains the indices of
    the coordinates and inputs of the columns, and `steps` their first steps. If `read` is 1, the `properties` of the
    vehicle at the instant are read. If it is 0, they are used as given and the dependent ones are derived. `space` is
    (1,) of Space, `x` is working memory for coordinates and inputs, and `tableau` has the shape (3 LEVELS + 4, rows).

    Derivatives are central differences, extrapolated to step zero over all powers of the step (Ridders 1982). Odd
    powers are included because of terms such as |w| w. The element of each tableau with the least error estimate is
    used.
    """
    memory, pool = state[0], bare_pointer(pool)
    for vehicle in range(len(y)):
        p = P[memory.clock.stage + vehicle]
        mine = bare_pointer(properties[vehicle])
        clock_s = schedule_clock(p, memory.clock, now_ns, 0.0)
        if read == 1:
            within_s = schedule_clock(p, memory.clock, now_ns, 1e-9)
            memory.clock.interval = find_interval(pool, p.vehicle.schedule, within_s)
            read_schedule(p, pool, memory, now_ns, 0.0, mine)
        else:
            derive_properties(p.vehicle, pool, clock_s, mine)
        differentiate_vehicle(
            p,
            pool,
            memory,
            now_ns,
            bare_pointer(y[vehicle]),
            which,
            steps,
            wanted,
            levels,
            mine,
            space[0],
            x,
            tableau,
            rate[vehicle],
            slopes[vehicle],
        )


@routine
def differentiate_vehicle(
    p: Parameters,
    pool: Array,
    memory: Memory,
    now_ns: int,
    y: Array,
    which: IntArray,
    steps: Array,
    wanted: IntArray,
    levels: int,
    properties: Array,
    space: Space,
    x: Array,
    tableau: Array,
    rate: Array,
    slopes: Array,
) -> None:
    """Apply `differentiate` to one vehicle."""
    dy, work, columns, x = space.rate, space.work, space.columns, bare_pointer(x)
    sizes = counts(p.vehicle.sizes)
    rows, n, inputs = len(rate), coordinate_count(sizes), 2 * (1 + sizes.further_groups) + 3
    reference, command = bare_pointer(tableau[3 * LEVELS]), bare_pointer(tableau[3 * LEVELS + 1])
    held, air = memory.held, memory.inputs
    for k in range(4):
        reference[k] = y[Q_BI + k]
    for k in range(3):
        reference[4 + k] = y[W_BI_B + k]
    for k in range(inputs - 3):
        command[k] = held.command_rad[k]
    command[inputs - 3], command[inputs - 2], command[inputs - 1] = air.gust_x_mps, air.gust_y_mps, air.gust_z_mps
    coordinates_of(sizes, p.environment.earth.rate_radps, y, x)
    for k in range(inputs):
        x[n + k] = 0.0
    at = Evaluation(properties, y, dy, space.aux)
    there, back = bare_pointer(tableau[3 * LEVELS + 2]), bare_pointer(tableau[3 * LEVELS + 3])
    for column in range(len(which)):
        j = which[column]
        here = x[j]
        for level in range(levels):
            step = steps[column] / 2.0**level
            x[j] = here + step
            motion(p, pool, memory, now_ns, reference, command, x, at, work, columns, there)
            x[j] = here - step
            motion(p, pool, memory, now_ns, reference, command, x, at, work, columns, back)
            for i in range(len(wanted)):
                tableau[level, i] = (there[wanted[i]] - back[wanted[i]]) / (2.0 * step)
        x[j] = here
        for i in range(len(wanted)):
            slopes[i, column] = extrapolated(tableau, i, levels)
    motion(p, pool, memory, now_ns, reference, command, x, at, work, columns, there)
    for i in range(rows):
        rate[i] = there[i]
    for k in range(inputs - 3):
        held.command_rad[k] = command[k]


@kernel
def extrapolated(tableau: Array, i: int, levels: int) -> float:
    """Return the element of an extrapolation tableau with the least error estimate.

    Column i of `tableau` contains the differences in rows 0 to LEVELS - 1, each with half the step of the previous row.
    The other rows are working memory.
    """
    best: float = tableau[0, i]
    least = math.inf
    tableau[LEVELS, i] = best
    for level in range(1, levels):
        # the previous and the present row of the tableau alternate between two halves of the working memory
        before, now = LEVELS + (level - 1) % 2 * LEVELS, LEVELS + level % 2 * LEVELS
        tableau[now, i] = tableau[level, i]
        for power in range(1, level + 1):
            left, above = tableau[now + power - 1, i], tableau[before + power - 1, i]
            value = left + (left - above) / (2.0**power - 1.0)
            tableau[now + power, i] = value
            error = max(abs(value - left), abs(value - above))
            if error < least:
                best, least = value, error
    return best
