"""The inputs of external flight code in a held flight: those of a free flight plus the deviations in the held flight.

In a held flight, the vehicle does not move along its trajectory. Flight code could recognise the test from the clock,
mass, speed, attitude and commands. It therefore receives the recorded inputs of a flight, plus the gyro pulses and the
readings of the further sensors in the held flight. Without deviations, these equal the inputs of the flight bit for
bit. With deviations, angles, attitude and attitude error follow from the sum of the pulses as in attitude.py.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from maxq.control.attitude import AttitudeError, Strapdown, turn, update_attitude_error
from maxq.control.converter import round_half_away
from maxq.control.kernel.jit import entry
from maxq.control.kernel.limits import MAX_UNITS
from maxq.control.kernel.records import Array, IntArray, Records


@dataclass
class Superposition:
    """The state of the sum of two flights' inputs; triples are per body axis.

    - `sample_s`, `count_rad`, `method`, `limit_rad`: parameters of the flight computer.
    - `rounded`: 1 if both flights have pulses of `count_rad`; 0 if the angles of the held flight are not rounded.
    - `blended`: 1 if the law's rate is a blend of several gyros.
    - `added_counts`, `added_rad`: deviation of the angles added so far.
    - `total_counts`: pulses since the start, including those added.
    - `attitude`: attitude from the pulses, including those added.
    - `commanded`: commanded attitude of the recorded flight.
    """

    sample_s: float
    count_rad: float
    rounded: int
    method: int
    limit_rad: float
    blended: int
    added_counts: Annotated[IntArray, (3,)]
    added_rad: Annotated[Array, (3,)]
    total_counts: Annotated[IntArray, (3,)]
    attitude: AttitudeError
    commanded: Strapdown


@entry
def superpose(
    tape: Records, row: int, heard: Records, place: int, share: float, states: Records, outs: Records
) -> None:
    """Write the inputs of `tape[row]`, plus the deviations `heard[place]` of a held flight, to `outs[0]`.

    `tape`, `heard` and `outs` are arrays of FswInputs; `states` contains one Superposition.

    The angles of the held flight are deviations from its start. `share` (0 to 1, for a gradual start) is the fraction
    of them that is added, and the pulses added are the change of this fraction since the previous call. The clock, the
    commands, the axial specific force, mass, speed and dynamic pressure are those of the tape.

    If the held flight is not rounded, only the pulses are: code that integrates them receives the rounded sum.
    """
    outs[0] = tape[row]
    flown, held, state, out = tape[row], heard[place], states[0], outs[0]
    for axis in range(3):
        if state.rounded != 0:
            wanted = round_half_away(share * held.angle_rad[axis] / state.count_rad)
            counts = flown.counts[axis] + wanted - state.added_counts[axis]
            state.added_counts[axis] = wanted
            state.total_counts[axis] += counts
            out.counts[axis] = counts
            out.delta_angle_rad[axis] = counts * state.count_rad
            out.angle_rad[axis] = state.total_counts[axis] * state.count_rad
        else:
            wanted_rad = share * held.angle_rad[axis]
            out.delta_angle_rad[axis] = flown.delta_angle_rad[axis] + (wanted_rad - state.added_rad[axis])
            out.angle_rad[axis] = flown.angle_rad[axis] + wanted_rad
            state.added_rad[axis] = wanted_rad
            if state.count_rad > 0.0:
                counts = round_half_away(out.angle_rad[axis] / state.count_rad) - state.total_counts[axis]
                state.total_counts[axis] += counts
                out.counts[axis] = counts
        out.rate_radps[axis] = out.delta_angle_rad[axis] / state.sample_s
        if state.blended != 0:
            own_radps = held.rate_radps[axis] - held.delta_angle_rad[axis] / state.sample_s
            first_radps = (out.delta_angle_rad[axis] - flown.delta_angle_rad[axis]) / state.sample_s
            out.rate_radps[axis] = flown.rate_radps[axis] + first_radps + share * own_radps
        if axis > 0:
            out.delta_velocity_mps[axis] = flown.delta_velocity_mps[axis] + share * held.delta_velocity_mps[axis]
            for k in range(MAX_UNITS):
                out.imu_delta_velocity_mps[k, axis] += share * held.imu_delta_velocity_mps[k, axis]
        out.imu_delta_angle_rad[0, axis] = out.delta_angle_rad[axis]
        for k in range(1, MAX_UNITS):
            out.imu_delta_angle_rad[k, axis] += share * held.imu_delta_angle_rad[k, axis]
        for k in range(len(flown.further_rate_radps)):
            out.further_rate_radps[k, axis] = (
                flown.further_rate_radps[k, axis] + share * held.further_rate_radps[k, axis]
            )
    turn(state.attitude.measured, out.delta_angle_rad)
    for k in range(4):
        out.q_BR[k] = state.attitude.measured.q[k]
        state.commanded.q[k] = flown.commanded_q_BR[k]
    update_attitude_error(
        state.attitude, state.method, state.commanded, out.angle_rad, flown.commanded_angle_rad, state.limit_rad
    )
    for axis in range(3):
        out.attitude_error_rad[axis] = state.attitude.theta_e_rad[axis]
    out.health, out.imu_health = flown.health & held.health, flown.imu_health & held.imu_health
