"""Closed-loop guidance to an orbit outside the atmosphere, and the engine cutoff at its energy.

The direction of thrust follows the linear tangent law in a frame fixed in I,

    u(t) = unit(x + (a + b s) z + (c + d s) n),    s = t - t_0,

which is optimal in uniform gravity if the position along x is free (Bryson & Ho, Applied Optimal Control, 2.7 and 4.6).
The vector n is the normal of the orbital plane. At the predicted end of the burn, z points upwards and x along the
motion. Once per cycle, the four numbers and the time to go are computed from the navigated position and velocity, by
Newton's method on a numerical prediction of the burn. The conditions at its end are the radius, speed and vertical
speed of the target apsis, and zero position and speed across the plane. Gravitation is that of a flattened Earth (J2).
The thrust is constant, with the acceleration measured over the last cycle. In the last seconds, when the position can
no longer be controlled, the numbers are no longer updated. The engine is cut off when the orbit's energy is reached,
the energy of the thrust's decay included.

The caller supplies the navigated position and velocity (`OrbitGuidanceState`); the simulator supplies its own, without
error.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated

from maxq.control.kernel import vectors as vec
from maxq.control.kernel.jit import kernel, routine
from maxq.control.kernel.records import Array

WAITING, SEARCHING, STEERING, ENDING, CUT_OFF = range(5)
"""The phases of the guidance.

- WAITING: before `start_s`.
- SEARCHING: the programme steers until there is a solution.
- STEERING: the solution steers.
- ENDING: the last solution steers until the cutoff.
- CUT_OFF: the engine is cut off.
"""
N = 5  # number of unknowns (a, b, c, d, time to go) and of conditions
STEPS = 24  # steps of the prediction
ENDING_s = 8.0
TRIALS, FIRST_TRIALS = 3, 40
THRUSTING_mps2 = 1.0
STEADY = 0.1  # largest relative change of a steady acceleration between two cycles
SLOPE_s = 100.0  # scale of the unknowns a, SLOPE_s b, c, SLOPE_s d and time to go / SLOPE_s, which are all of order one
LONGEST_STEP = 0.3
CLOSE = 1e-3  # residual (km, m/s) at which the iteration ends; a solution is accepted below FAIR
FAIR = 1.0


@dataclass(frozen=True)
class OrbitGuidance:
    """The parameters of the orbit guidance.

    - `on`: 0 if the guidance is not used.
    - `start_s`: start of the guidance on the vehicle clock.
    - `cycle_s`: time between two solutions.
    - `rate_limit_radps`: limit of the commanded attitude rate.
    - `radius_m`, `speed_mps`: targets at cutoff, where the vertical speed is 0, at the perigee or the apogee.
    - `semimajor_m`: semi-major axis of the orbit.
    - `cos_inclination`: cosine of the inclination; a magnitude above 1 selects the plane of flight at the start.
    - `exhaust_mps`: effective exhaust speed of the engine that is cut off.
    - `lead_s`: duration of full thrust with the impulse after the cutoff.
    """

    on: int = 0
    start_s: float = 0.0
    cycle_s: float = 1.0
    rate_limit_radps: float = 1.0
    radius_m: float = 1.0
    speed_mps: float = 1.0
    semimajor_m: float = 1.0
    cos_inclination: float = 2.0
    exhaust_mps: float = 1.0
    mu_m3ps2: float = 1.0
    j2: float = 0.0
    j2_radius_m: float = 1.0
    lead_s: float = 0.0


@dataclass
class OrbitGuidanceState:
    """The state of the orbit guidance.

    - `position_m`, `velocity_mps`: navigated, in I, at the end of the sample.
    - `start_q_BI`: attitude at the start of the computer.
    - `next_s`: time of the next cycle.
    - `last_s`, `last_position_m`, `last_velocity_mps`: values at the last cycle.
    - `acceleration_mps2`: thrust acceleration at `last_s`.
    - `axes`: x, n, z in I.
    - `begun_s`, `solved_s`: t_0, and the time of the last solution.
    - `unknowns`: a, b, c, d and time to go, scaled by `SLOPE_s`.
    - `cut_off_s`: time of the engine cutoff; inf until it is known.
    - `trial`, `missed`, `rows`: scratch memory of the solver.
    """

    position_m: Annotated[Array, (3,)]
    velocity_mps: Annotated[Array, (3,)]
    start_q_BI: Annotated[Array, (4,)]
    phase: int
    next_s: float
    last_s: float
    last_position_m: Annotated[Array, (3,)]
    last_velocity_mps: Annotated[Array, (3,)]
    acceleration_mps2: float
    axes: Annotated[Array, (9,)]
    begun_s: float
    solved_s: float
    unknowns: Annotated[Array, (N,)]
    cut_off_s: float
    trial: Annotated[Array, (N,)]
    end: Annotated[Array, (6,)]  # predicted position and velocity
    missed: Annotated[Array, (N,)]
    rows: Annotated[Array, (N * (N + 1),)]


@kernel
def start_orbit_guidance(state: OrbitGuidanceState) -> None:
    state.phase = WAITING
    state.next_s, state.last_s, state.acceleration_mps2 = -1e300, -1e300, 0.0
    state.begun_s, state.solved_s, state.cut_off_s = 0.0, 0.0, math.inf
    for i in range(N):
        state.unknowns[i] = 0.0


@kernel
def gravitation(g: OrbitGuidance, r: vec.Vector) -> vec.Vector:
    """Return the gravitation of a flattened Earth at `r` (m) in I, m/s2 (Vallado, eq. 8-30)."""
    radius = vec.norm(r)
    k = -g.mu_m3ps2 / radius**3
    bulge = 1.5 * g.j2 * (g.j2_radius_m / radius) ** 2
    lift = 5.0 * (r[2] / radius) ** 2
    side = k * (1.0 + bulge * (1.0 - lift))
    return (side * r[0], side * r[1], k * (1.0 + bulge * (3.0 - lift)) * r[2])


@kernel
def direction(state: OrbitGuidanceState, unknowns: Array, time_s: float) -> vec.Vector:
    """Return the unit vector of the direction of thrust at `time_s`, in I."""
    s = (time_s - state.begun_s) / SLOPE_s
    up, aside = unknowns[0] + unknowns[1] * s, unknowns[2] + unknowns[3] * s
    x, n, z = vec.vector_at(state.axes, 0), vec.vector_at(state.axes, 3), vec.vector_at(state.axes, 6)
    u = vec.add(x, vec.add(vec.scaled(up, z), vec.scaled(aside, n)))
    return vec.scaled(1.0 / vec.norm(u), u)


@kernel
def thrust_acceleration(g: OrbitGuidance, state: OrbitGuidanceState, time_s: float) -> float:
    """Return the thrust acceleration at `time_s` for constant thrust and decreasing mass, m/s2.

    It is extrapolated from the last measured value.
    """
    left = 1.0 - state.acceleration_mps2 * (time_s - state.last_s) / g.exhaust_mps
    return state.acceleration_mps2 / max(left, 0.01)


@kernel
def acceleration(
    g: OrbitGuidance, state: OrbitGuidanceState, unknowns: Array, time_s: float, r: vec.Vector
) -> vec.Vector:
    u = direction(state, unknowns, time_s)
    return vec.add(gravitation(g, r), vec.scaled(thrust_acceleration(g, state, time_s), u))


@routine
def predict(g: OrbitGuidance, state: OrbitGuidanceState, unknowns: Array, time_s: float) -> None:
    """Predict position and velocity at the end of the burn by the classical Runge-Kutta method.

    Writes them into `state.end`, and the residuals (km, m/s) into `state.missed`: radius, vertical speed, speed, and
    position and speed across the plane.
    """
    r, v = vec.vector_at(state.position_m, 0), vec.vector_at(state.velocity_mps, 0)
    h = SLOPE_s * unknowns[4] / STEPS
    for step in range(STEPS):
        t = time_s + step * h
        a_1 = acceleration(g, state, unknowns, t, r)
        v_2 = vec.add(v, vec.scaled(0.5 * h, a_1))
        a_2 = acceleration(g, state, unknowns, t + 0.5 * h, vec.add(r, vec.scaled(0.5 * h, v)))
        v_3 = vec.add(v, vec.scaled(0.5 * h, a_2))
        a_3 = acceleration(g, state, unknowns, t + 0.5 * h, vec.add(r, vec.scaled(0.5 * h, v_2)))
        v_4 = vec.add(v, vec.scaled(h, a_3))
        a_4 = acceleration(g, state, unknowns, t + h, vec.add(r, vec.scaled(h, v_3)))
        r = vec.add(r, vec.scaled(h / 6.0, vec.add(vec.add(v, v_4), vec.scaled(2.0, vec.add(v_2, v_3)))))
        v = vec.add(v, vec.scaled(h / 6.0, vec.add(vec.add(a_1, a_4), vec.scaled(2.0, vec.add(a_2, a_3)))))
    vec.set_vector(state.end, 0, r)
    vec.set_vector(state.end, 3, v)
    n, radius = vec.vector_at(state.axes, 3), vec.norm(r)
    state.missed[0] = (radius - g.radius_m) / 1e3
    state.missed[1] = vec.dot(v, r) / radius
    state.missed[2] = vec.norm(v) - g.speed_mps
    state.missed[3] = vec.dot(r, n) / 1e3
    state.missed[4] = vec.dot(v, n)


@kernel
def largest_miss(state: OrbitGuidanceState) -> float:
    largest = 0.0
    for i in range(N):
        largest = max(largest, abs(state.missed[i]))
    return largest


@routine
def solve(g: OrbitGuidance, state: OrbitGuidanceState, time_s: float, trials: int) -> float:
    """Solve for `state.unknowns` by Newton's method with at most `trials` steps, and return the largest residual.

    The steps are bounded, because the first guess may be far from the solution.
    """
    x, rows = state.unknowns, state.rows
    for _ in range(trials):
        predict(g, state, x, time_s)
        if largest_miss(state) < CLOSE:
            break
        for i in range(N):
            rows[(N + 1) * i + N] = -state.missed[i]
        for k in range(N):
            step = 1e-5 if k < N - 1 else 1e-4
            for i in range(N):
                state.trial[i] = x[i]
            state.trial[k] += step
            predict(g, state, state.trial, time_s)
            for i in range(N):
                rows[(N + 1) * i + k] = (state.missed[i] + rows[(N + 1) * i + N]) / step
        if solve_rows(rows) == 0:
            break
        largest = 0.0
        for k in range(N):
            largest = max(largest, abs(rows[(N + 1) * k + N]))
        share = min(1.0, LONGEST_STEP / largest) if largest > 0.0 else 1.0
        for k in range(N):
            x[k] += share * rows[(N + 1) * k + N]
        mass_left_s = g.exhaust_mps / thrust_acceleration(g, state, time_s)
        x[4] = min(max(x[4], 1e-3), 0.95 * mass_left_s / SLOPE_s)
    predict(g, state, x, time_s)
    return largest_miss(state)


@kernel
def solve_rows(rows: Array) -> int:
    """Solve N equations by Gauss-Jordan elimination with row pivoting.

    The last column contains the right-hand side and becomes the solution. Returns 0 if the equations are singular,
    otherwise 1.
    """
    w = N + 1
    for k in range(N):
        best = k
        for i in range(k + 1, N):
            if abs(rows[w * i + k]) > abs(rows[w * best + k]):
                best = i
        if not abs(rows[w * best + k]) > 1e-12:
            return 0
        for j in range(w):
            rows[w * k + j], rows[w * best + j] = rows[w * best + j], rows[w * k + j]
        pivot = rows[w * k + k]
        for j in range(w):
            rows[w * k + j] /= pivot
        for i in range(N):
            if i != k:
                factor = rows[w * i + k]
                for j in range(w):
                    rows[w * i + j] -= factor * rows[w * k + j]
    return 1


@routine
def choose_axes(g: OrbitGuidance, state: OrbitGuidanceState, time_s: float) -> None:
    """Choose the orbital plane, the frame and a first guess: a horizontal burn over the missing speed."""
    r, v = vec.vector_at(state.position_m, 0), vec.vector_at(state.velocity_mps, 0)
    radius, momentum = vec.norm(r), vec.cross(r, v)
    n = vec.scaled(1.0 / vec.norm(momentum), momentum)
    flat = math.sqrt(r[0] * r[0] + r[1] * r[1])
    if abs(g.cos_inclination) <= 1.0 and flat > 1e-6 * radius:
        east = (-r[1] / flat, r[0] / flat, 0.0)
        north = vec.scaled(1.0 / radius, vec.cross(r, east))
        cosine = min(max(g.cos_inclination * radius / flat, -1.0), 1.0)
        sine = math.sqrt(1.0 - cosine * cosine)
        if vec.dot(n, east) < 0.0:
            sine = -sine
        n = vec.add(vec.scaled(cosine, north), vec.scaled(sine, east))
    missing = abs(g.speed_mps - vec.norm(v)) + 9.8 * abs(vec.dot(r, v)) / radius / max(state.acceleration_mps2, 1.0)
    burn_s = g.exhaust_mps / state.acceleration_mps2 * (1.0 - math.exp(-missing / g.exhaust_mps))
    turned = 0.5 * (vec.norm(v) + g.speed_mps) * burn_s / radius
    ahead = vec.cross(n, r)
    z = vec.add(vec.scaled(math.cos(turned) / radius, r), vec.scaled(math.sin(turned) / radius, ahead))
    z = vec.add(z, vec.scaled(-vec.dot(z, n), n))
    z = vec.scaled(1.0 / vec.norm(z), z)
    vec.set_vector(state.axes, 0, vec.cross(n, z))
    vec.set_vector(state.axes, 3, n)
    vec.set_vector(state.axes, 6, z)
    state.begun_s = time_s
    state.unknowns[0], state.unknowns[1], state.unknowns[2], state.unknowns[3] = 0.4, -0.2, 0.0, 0.0
    state.unknowns[4] = burn_s / SLOPE_s


@kernel
def begin_at(state: OrbitGuidanceState, time_s: float) -> None:
    """Move t_0 to `time_s` without a change of the directions of thrust.

    With an early t_0, a and c extrapolate the directions of the last seconds over the whole burn. Small changes of
    these directions are then large steps of the unknowns.
    """
    passed = (time_s - state.begun_s) / SLOPE_s
    state.unknowns[0] += passed * state.unknowns[1]
    state.unknowns[2] += passed * state.unknowns[3]
    state.unknowns[4] -= passed
    state.begun_s = time_s


@kernel
def mean_push(state: OrbitGuidanceState, since_s: float, pull: vec.Vector) -> vec.Vector:
    """Return the mean acceleration by thrust in I since `last_velocity_mps`, `since_s` ago, m/s2.

    `pull`: mean gravitation.
    """
    was = vec.vector_at(state.last_velocity_mps, 0)
    gained = vec.add(vec.vector_at(state.velocity_mps, 0), vec.scaled(-1.0, was))
    return vec.add(vec.scaled(1.0 / since_s, gained), vec.scaled(-1.0, pull))


@kernel
def is_steady(now_mps2: float, before_mps2: float) -> bool:
    return abs(now_mps2 - before_mps2) < STEADY * now_mps2


@routine
def measure_acceleration(g: OrbitGuidance, state: OrbitGuidanceState, time_s: float) -> int:
    """Measure the thrust acceleration, and return 1 if the thrust is on and steady, otherwise 0.

    The mean acceleration without gravitation since the last cycle is extrapolated to `time_s`.
    """
    r, v, since_s = vec.vector_at(state.position_m, 0), vec.vector_at(state.velocity_mps, 0), time_s - state.last_s
    known = since_s < 2.5 * g.cycle_s
    steady = False
    if known:
        middle = vec.scaled(0.5, vec.add(r, vec.vector_at(state.last_position_m, 0)))
        mean_mps2 = vec.norm(mean_push(state, since_s, gravitation(g, middle)))
        now_mps2 = mean_mps2 * (1.0 + 0.5 * since_s * mean_mps2 / g.exhaust_mps)
        steady = is_steady(now_mps2, state.acceleration_mps2)
        state.acceleration_mps2 = now_mps2
    state.last_s = time_s
    vec.set_vector(state.last_position_m, 0, r)
    vec.set_vector(state.last_velocity_mps, 0, v)
    return 1 if steady and state.acceleration_mps2 > THRUSTING_mps2 else 0


@routine
def advance_orbit_guidance(g: OrbitGuidance, state: OrbitGuidanceState, time_s: float, sample_s: float) -> int:
    """Solve if a cycle is due at the end of a sample, and command the cutoff when it is within 1.5 samples.

    Returns 1 if `steer` determines the commanded attitude, and 0 if the programme does.
    """
    if time_s < g.start_s:
        return 0
    if state.phase < ENDING and time_s >= state.next_s:
        state.next_s = time_s + g.cycle_s
        if measure_acceleration(g, state, time_s) == 1:
            was = state.phase
            if was == STEERING:
                begin_at(state, time_s)
            else:
                choose_axes(g, state, time_s)
            missed = solve(g, state, time_s, TRIALS if was == STEERING else FIRST_TRIALS)
            if missed < FAIR:
                state.phase, state.solved_s = STEERING, time_s
            elif was == STEERING and time_s - state.solved_s > 10.0 * g.cycle_s:
                state.phase = SEARCHING
        elif state.phase == WAITING:
            state.phase = SEARCHING
    if state.phase == STEERING and state.begun_s + SLOPE_s * state.unknowns[4] - time_s < ENDING_s + g.lead_s:
        state.phase = ENDING
    if state.phase == ENDING:
        r, v = vec.vector_at(state.position_m, 0), vec.vector_at(state.velocity_mps, 0)
        wanted = 0.5 * g.mu_m3ps2 * (2.0 / vec.norm(r) - 1.0 / g.semimajor_m) - 0.5 * vec.dot(v, v)
        a_mps2, u = thrust_acceleration(g, state, time_s), direction(state, state.unknowns, time_s)
        power = a_mps2 * vec.dot(u, v)
        growth = a_mps2 * a_mps2 + power * a_mps2 / g.exhaust_mps
        if g.lead_s > 0.0:  # energy by the impulse of the decay, and by its position, which is 2 a lead^2 / 3 behind
            wanted -= g.lead_s * (power + 0.5 * g.lead_s * a_mps2 * a_mps2)
            wanted -= 2.0 / 3.0 * g.lead_s * g.lead_s * a_mps2 * vec.dot(u, gravitation(g, r))
        power += g.lead_s * growth
        left_s = wanted / power if power > 0.0 else 0.0
        left_s = wanted / (power + 0.5 * growth * left_s) if power > 0.0 else 0.0
        if left_s < 1.5 * sample_s:
            state.cut_off_s, state.phase = time_s + max(left_s, 0.0), CUT_OFF
    return 1 if state.phase >= STEERING else 0


@kernel
def steer(
    g: OrbitGuidance, state: OrbitGuidanceState, q_BR: Array, time_s: float, sample_s: float
) -> tuple[float, float]:
    """Return the turn of the commanded attitude `q_BR` about its y and z in this sample, rad.

    The turn is towards the direction of thrust, and zero after the cutoff.
    """
    if state.phase == CUT_OFF:
        return 0.0, 0.0
    return turn_towards(g, state, direction(state, state.unknowns, time_s), q_BR, sample_s)


@kernel
def level(state: OrbitGuidanceState) -> vec.Vector:
    """Return the unit vector of the horizontal direction of motion, in I."""
    r, v = vec.vector_at(state.position_m, 0), vec.vector_at(state.velocity_mps, 0)
    u = vec.cross(vec.cross(r, v), r)
    return vec.scaled(1.0 / max(vec.norm(u), 1e-300), u)


@kernel
def turn_towards(
    g: OrbitGuidance, state: OrbitGuidanceState, u: vec.Vector, q_BR: Array, sample_s: float
) -> tuple[float, float]:
    """Return the turn of `q_BR` about its y and z towards the direction `u` (in I) in one sample, rad.

    The angle is bounded by the limit of the commanded attitude rate.
    """
    start = vec.rotation_from_quaternion(
        state.start_q_BI[0], state.start_q_BI[1], state.start_q_BI[2], state.start_q_BI[3]
    )
    u = vec.rotate_back(vec.rotation_from_quaternion(q_BR[0], q_BR[1], q_BR[2], q_BR[3]), vec.rotate_back(start, u))
    sine = math.sqrt(u[1] * u[1] + u[2] * u[2])
    angle_rad = min(math.atan2(sine, u[0]), g.rate_limit_radps * sample_s)
    k = angle_rad / max(sine, 1e-12)
    return -k * u[2], k * u[1]
