"""The burns of the last stage's engine: cutoffs, coasts between burns, and ignitions.

A burn ends at an orbit (orbit_guidance.py), at the value of a quantity, or when the propellant is consumed. The instant
of a cutoff by a quantity is extrapolated from its last two samples. If thrust decays after the cutoff, the quantity is
that at the end of the decay (`quantity_after_decay`). In a coast, the commanded attitude turns to the
local horizontal along the motion. Settling thrust begins `settling_s` before the ignition. A restart may be timed from
the apogee of the Kepler orbit. The next burn continues in the direction of the coast until its own guidance steers.

The caller supplies navigated position and velocity (`OrbitGuidanceState`), here the simulator's own with the errors of
`sim/flight/navigation.py`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Annotated

from maxq.control.kernel import vectors as vec
from maxq.control.kernel.jit import kernel, routine
from maxq.control.kernel.limits import MAX_BURNS
from maxq.control.kernel.records import Array
from maxq.control.orbit_guidance import (
    OrbitGuidance,
    OrbitGuidanceState,
    advance_orbit_guidance,
    gravitation,
    is_steady,
    level,
    mean_push,
    start_orbit_guidance,
    steer,
    turn_towards,
)

QUANTITIES = ("", "earth_speed_mps", "inertial_speed_mps", "apogee_altitude_m")
"""The quantities of a cutoff: none, speed relative to the rotating Earth, inertial speed, apogee altitude.

The apogee is that of the Kepler orbit, measured from the equatorial radius.
"""
SPEED, INERTIAL_SPEED, APOGEE = range(1, len(QUANTITIES))
SETTLING_s = 3.0  # time from an ignition to constant thrust


@dataclass(frozen=True)
class GuidedBurn:
    """The parameters of one burn.

    - `orbit`: guidance to an orbit, with `on` = 0 if there is none. `orbit.start_s` counts from the ignition of a
      restart.
    - `quantity`, `wanted`: the cutoff occurs when this quantity (index into QUANTITIES) reaches this value; 0 is none.
    - `coast_s`: time from the preceding cutoff to the ignition; if negative, the ignition is `before_apogee_s` before
      the apogee.
    - `settling_s`, `settling_N`: duration and force of the forward thrust before the ignition.
    """

    orbit: OrbitGuidance = field(default_factory=OrbitGuidance)
    quantity: int = 0
    wanted: float = 0.0
    coast_s: float = 0.0
    before_apogee_s: float = 0.0
    settling_s: float = 0.0
    settling_N: float = 0.0


@dataclass(frozen=True)
class Burns:
    """The parameters of all burns of the last stage's engine.

    - `count`: number of burns; 0 if no burn has a commanded end.
    - `start_s`: first ignition on the vehicle clock.
    - `turns`: 1 if thrusters turn the vehicle in a coast.
    - `equator_m`: equatorial radius.
    - `flat_mps2`: gravity of a flat Earth, along z of I.
    """

    count: int = 0
    start_s: float = 0.0
    turns: int = 0
    earth_rate_radps: float = 0.0
    equator_m: float = 0.0
    flat_mps2: float = 0.0
    burn: Annotated[tuple[GuidedBurn, ...], (MAX_BURNS,)] = (GuidedBurn(),) * MAX_BURNS


@dataclass
class BurnsState:
    """The state of the sequence of burns.

    - `number`: current burn from 0; in a coast, the next burn.
    - `coasting`: 1 from a cutoff to the next ignition.
    - `cut_off_s`, `ignite_s`: commanded times of the cutoff and of the next ignition; inf until they are known.
    - `began_s`: time of the last ignition; in a coast, of the last cutoff.
    - `last`, `last_s`: quantity of the cutoff at the last sample, and the time of that sample.
    - `settling_N`: current settling thrust.
    - `depleted`: 1 after the propellant is exhausted, when thrust reaches no quantity any more.
    """

    number: int
    coasting: int
    cut_off_s: float
    ignite_s: float
    began_s: float
    last: float
    last_s: float
    settling_N: float
    depleted: int


@kernel
def start_burns(state: BurnsState) -> None:
    """Set the sequence to its first burn."""
    state.number, state.coasting = 0, 0
    state.cut_off_s, state.ignite_s, state.began_s = math.inf, math.inf, 0.0
    state.last, state.last_s, state.settling_N, state.depleted = 0.0, -1e300, 0.0, 0


@kernel
def kepler(mu_m3ps2: float, r: vec.Vector, v: vec.Vector) -> tuple[float, float, float]:
    """Return the semi-major axis (m), e cos E and e sin E of the Kepler orbit at `r` (m), `v` (m/s) in I.

    E is the eccentric anomaly. For an escape, the axis is negative. Source: Vallado, Fundamentals of Astrodynamics and
    Applications, section 2.2.
    """
    radius = vec.norm(r)
    axis_m = 1.0 / (2.0 / radius - vec.dot(v, v) / mu_m3ps2)
    return axis_m, 1.0 - radius / axis_m, vec.dot(r, v) / math.sqrt(mu_m3ps2 * abs(axis_m))


@kernel
def to_apogee_s(mu_m3ps2: float, r: vec.Vector, v: vec.Vector) -> float:
    """Return the time to the next apogee by Kepler's equation, s; inf for an escape."""
    axis_m, along, across = kepler(mu_m3ps2, r, v)
    if axis_m <= 0.0:
        return math.inf
    mean = math.atan2(across, along) - across  # -pi to pi, 0 at the perigee
    return (math.pi - mean) * math.sqrt(axis_m / mu_m3ps2) * axis_m


@kernel
def quantity_of(burns: Burns, burn: GuidedBurn, r: vec.Vector, v: vec.Vector) -> float:
    """Return the quantity of a burn's cutoff at `r` (m), `v` (m/s) in I; the apogee of an escape is infinite."""
    if burn.quantity == SPEED:
        spin = burns.earth_rate_radps
        return vec.norm((v[0] + spin * r[1], v[1] - spin * r[0], v[2]))
    if burn.quantity == INERTIAL_SPEED:
        return vec.norm(v)
    axis_m, along, across = kepler(burn.orbit.mu_m3ps2, r, v)
    if axis_m <= 0.0:
        return math.inf
    return axis_m * (1.0 + math.hypot(along, across)) - burns.equator_m


@routine
def advance_burns(
    burns: Burns, state: BurnsState, orbit: OrbitGuidanceState, q_BR: Array, time_s: float, sample_s: float
) -> tuple[int, float, float]:
    """Advance the sequence at the end of a sample, and command cutoffs and ignitions.

    Returns 1 and the turn of the commanded attitude `q_BR` about its y and z (rad) if the sequence replaces the
    programme, otherwise 0 and zeros.
    """
    if state.coasting == 0 and time_s >= state.cut_off_s and state.number + 1 < burns.count:
        state.number, state.coasting = state.number + 1, 1
        state.began_s, state.ignite_s = state.cut_off_s, math.inf
        start_orbit_guidance(orbit)
    if state.coasting == 1 and time_s >= state.ignite_s:
        state.coasting, state.began_s = 0, state.ignite_s
        state.cut_off_s, state.last_s, state.settling_N = math.inf, -1e300, 0.0
    burn = burns.burn[state.number]
    if state.coasting == 1:
        await_ignition(burn, state, orbit, time_s, sample_s)
    elif burn.orbit.on != 0:
        if state.number == 0 or time_s >= state.began_s + burn.orbit.start_s:
            steers = advance_orbit_guidance(burn.orbit, orbit, time_s, sample_s)
            state.cut_off_s = orbit.cut_off_s
            if steers == 1:
                turn_y, turn_z = steer(burn.orbit, orbit, q_BR, time_s, sample_s)
                return 1, turn_y, turn_z
    elif burn.quantity > 0 and time_s >= burns.start_s and state.depleted == 0:
        watch_quantity(burns, burn, state, orbit, time_s, sample_s)
    if state.number == 0:
        return 0, 0.0, 0.0
    turn_y, turn_z = turn_towards(burn.orbit, orbit, level(orbit), q_BR, sample_s)
    return 1, turn_y, turn_z


@kernel
def await_ignition(
    burn: GuidedBurn, state: BurnsState, orbit: OrbitGuidanceState, time_s: float, sample_s: float
) -> None:
    """Command the next ignition within 1.5 samples of its time, and the settling thrust before it."""
    if not math.isinf(state.ignite_s):
        return
    left_s = state.began_s + burn.coast_s - time_s
    if burn.coast_s < 0.0:
        r, v = vec.vector_at(orbit.position_m, 0), vec.vector_at(orbit.velocity_mps, 0)
        left_s = to_apogee_s(burn.orbit.mu_m3ps2, r, v) - burn.before_apogee_s
    state.settling_N = burn.settling_N if left_s <= burn.settling_s else 0.0
    if left_s < 1.5 * sample_s:
        state.ignite_s = time_s + max(left_s, 0.0)


@kernel
def earth_pull(burns: Burns, g: OrbitGuidance, r: vec.Vector) -> vec.Vector:
    """Return the gravitation at `r` (m) in I, m/s2."""
    return gravitation(g, r) if g.mu_m3ps2 > 0.0 else (0.0, 0.0, burns.flat_mps2)


@kernel
def measure_push(burns: Burns, g: OrbitGuidance, orbit: OrbitGuidanceState, since_s: float) -> vec.Vector:
    """Return the acceleration by thrust in the middle of the next sample, m/s2, and keep its magnitude now.

    The mean over the last sample, of `since_s`, is extrapolated if it is steady.
    """
    push = mean_push(orbit, since_s, earth_pull(burns, g, vec.vector_at(orbit.position_m, 0)))
    now_mps2, before_mps2 = vec.norm(push), orbit.acceleration_mps2
    orbit.acceleration_mps2 = now_mps2
    if is_steady(now_mps2, before_mps2):
        push = vec.scaled(2.0 - before_mps2 / now_mps2, push)
    return push


@kernel
def quantity_after_decay(burns: Burns, burn: GuidedBurn, r: vec.Vector, v: vec.Vector, push: vec.Vector) -> float:
    """Return the quantity at the end of a decay that begins at `r`, `v` with the acceleration `push`.

    It falls linearly within the decay D, which adds `push` D / 2 to the velocity and `push` D^2 / 3 to the position.
    Gravitation is that in the middle.
    """
    decay_s = 2.0 * burn.orbit.lead_s
    pull = earth_pull(burns, burn.orbit, vec.add(r, vec.scaled(0.5 * decay_s, v)))
    moved = vec.add(vec.scaled(0.5, pull), vec.scaled(1.0 / 3.0, push))
    later = vec.add(r, vec.add(vec.scaled(decay_s, v), vec.scaled(decay_s * decay_s, moved)))
    return quantity_of(burns, burn, later, vec.add(v, vec.scaled(decay_s, vec.add(pull, vec.scaled(0.5, push)))))


@kernel
def watch_quantity(
    burns: Burns, burn: GuidedBurn, state: BurnsState, orbit: OrbitGuidanceState, time_s: float, sample_s: float
) -> None:
    """Command the cutoff when the extrapolated quantity reaches its value within 1.5 samples."""
    if not math.isinf(state.cut_off_s):
        return
    r, v = vec.vector_at(orbit.position_m, 0), vec.vector_at(orbit.velocity_mps, 0)
    value = quantity_of(burns, burn, r, v)
    if burn.orbit.lead_s > 0.0:
        before, was = vec.vector_at(orbit.last_position_m, 0), vec.vector_at(orbit.last_velocity_mps, 0)
        if state.last_s > -1e300:
            push = measure_push(burns, burn.orbit, orbit, time_s - state.last_s)
            value = quantity_after_decay(burns, burn, r, v, push)
            state.last = quantity_after_decay(burns, burn, before, was, push)
        vec.set_vector(orbit.last_position_m, 0, r)
        vec.set_vector(orbit.last_velocity_mps, 0, v)
    missing, gained = burn.wanted - value, value - state.last
    if missing <= 0.0:
        state.cut_off_s = time_s
    elif state.last_s > -1e300 and gained > 0.0:
        left_s = missing / gained * (time_s - state.last_s)
        if left_s < 1.5 * sample_s:
            state.cut_off_s = time_s + max(left_s, 0.0)
    state.last, state.last_s = value, time_s
