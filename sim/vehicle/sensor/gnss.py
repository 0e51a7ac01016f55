"""The GNSS receiver: position and velocity of its antenna, Earth-fixed, at regular epochs.

The antenna moves with the rigid body: r_ant = r + rho, v_ant = v + w x rho, with the lever arm rho from the core CG. A
solution has a constant error and a first-order Gauss-Markov error in north, east and down, which is white for a
correlation time of 0. It arrives after a latency of at most one period. Epochs coincide with samples of the computer.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Annotated, NamedTuple

import numpy as np

from maxq.control.kernel.jit import kernel, routine
from maxq.control.kernel.noise import standard_normal
from maxq.control.kernel.records import Array
from maxq.control.kernel.rows import Xyz, xyz
from maxq.control.kernel.vectors import add, cross, rotate, rotation_from_quaternion, set_vector, vector_at
from maxq.sim.vehicle.block import Q_BI, R_I, V_I, W_BI_B
from maxq.sim.vehicle.faults import GNSS_ADDED, GNSS_OUTAGE, GNSS_STUCK
from maxq.sim.vehicle.schedule import CORE_CG
from maxq.sim.world.earth import Earth, earth_rotation, ground_velocity, inertial_to_earth, local_frame, ned_to_earth

if TYPE_CHECKING:
    from maxq.sim.vehicle.sensor.section import GnssSection

GNSS_STREAM = 80  # streams of the noise generator: three of position, three of velocity


@dataclass(frozen=True)
class Gnss:
    """The parameters of the receiver; triples are north, east, down.

    - `period_ns`: time between epochs; 0 without a receiver.
    - `kept`: share of the Gauss-Markov error that remains after a period.
    - `antenna_m`: station, y and z of the antenna.
    """

    period_ns: int = 0
    latency_ns: int = 0
    kept: float = 0.0
    antenna_m: Annotated[Array, (3,)] = field(default_factory=lambda: np.zeros(3))
    position_noise_m: Annotated[Array, (3,)] = field(default_factory=lambda: np.zeros(3))
    velocity_noise_mps: Annotated[Array, (3,)] = field(default_factory=lambda: np.zeros(3))
    position_bias_m: Annotated[Array, (3,)] = field(default_factory=lambda: np.zeros(3))


@dataclass
class GnssMemory:
    """The state of the receiver: the solution that is due at `due_ns`, and the last one that has arrived."""

    next_ns: int  # next epoch
    epochs: int
    due_ns: int  # 0: none
    measured_ns: int
    measured: Annotated[Array, (6,)]  # position and velocity, E
    error: Annotated[Array, (6,)]  # Gauss-Markov errors of position and velocity, N
    number: int
    valid_ns: int  # epoch of the last solution that has arrived
    solution: Annotated[Array, (6,)]


def pack_gnss(given: GnssSection | None) -> Gnss:
    if given is None:
        return Gnss()
    kept = math.exp(-given.period_s / given.correlation_s) if given.correlation_s > 0.0 else 0.0
    return Gnss(
        round(1e9 * given.period_s),
        round(1e9 * given.latency_s),
        kept,
        np.array([given.station_m, *given.offset_m]),
        np.array(given.position_noise_m),
        np.array(given.velocity_noise_mps),
        np.array(given.position_bias_m),
    )


@routine
def measure_gnss(
    g: Gnss, memory: GnssMemory, earth: Earth, seed: int, now_ns: int, properties: Array, faults: Array, y: Array
) -> None:
    """Measure at an epoch, and deliver the solution that is due."""
    if now_ns >= memory.next_ns:
        memory.next_ns = (now_ns // g.period_ns + 1) * g.period_ns
        _fix(g, memory, earth, seed, now_ns, properties, faults, y)
    if 0 < memory.due_ns <= now_ns:
        memory.due_ns = 0
        memory.number += 1
        memory.valid_ns = memory.measured_ns
        for k in range(6):
            memory.solution[k] = memory.measured[k]


@kernel
def _fix(
    g: Gnss, memory: GnssMemory, earth: Earth, seed: int, now_ns: int, properties: Array, faults: Array, y: Array
) -> None:
    kept, fresh, epoch = g.kept, math.sqrt(1.0 - g.kept * g.kept), memory.epochs
    memory.epochs += 1
    for k in range(6):
        sigma = g.position_noise_m[k] if k < 3 else g.velocity_noise_mps[k - 3]
        drawn = sigma * standard_normal(seed, GNSS_STREAM + k, epoch) if sigma > 0.0 else 0.0
        memory.error[k] = drawn if epoch == 0 else kept * memory.error[k] + fresh * drawn
    if faults[GNSS_OUTAGE] > 0.0:
        return
    memory.due_ns = max(now_ns + g.latency_ns, 1)
    memory.measured_ns = now_ns
    if faults[GNSS_STUCK] > 0.0:
        return
    rho = (
        properties[CORE_CG] - g.antenna_m[0],
        g.antenna_m[1] - properties[CORE_CG + 1],
        g.antenna_m[2] - properties[CORE_CG + 2],
    )
    rotation = rotation_from_quaternion(y[Q_BI], y[Q_BI + 1], y[Q_BI + 2], y[Q_BI + 3])
    r = add(vector_at(y, R_I), rotate(rotation, rho))
    v = add(vector_at(y, V_I), rotate(rotation, cross(vector_at(y, W_BI_B), rho)))
    cos, sin = earth_rotation(earth, 1e-9 * now_ns)
    ground = ground_velocity(earth, r[0], r[1])
    r_E = inertial_to_earth(cos, sin, r[0], r[1], r[2])
    v_E = inertial_to_earth(cos, sin, v[0] - ground[0], v[1] - ground[1], v[2] - ground[2])
    _, sin_lat, cos_lat, sin_lon, cos_lon = local_frame(earth, r_E[0], r_E[1], r_E[2])
    e, b = memory.error, g.position_bias_m
    wrong = (
        e[0] + b[0] + faults[GNSS_ADDED],
        e[1] + b[1] + faults[GNSS_ADDED + 1],
        e[2] + b[2] + faults[GNSS_ADDED + 2],
    )
    slips = vector_at(e, 3)
    set_vector(memory.measured, 0, add(r_E, ned_to_earth(sin_lat, cos_lat, sin_lon, cos_lon, *wrong)))
    set_vector(memory.measured, 3, add(v_E, ned_to_earth(sin_lat, cos_lat, sin_lon, cos_lon, *slips)))


class GnssRow(NamedTuple):
    """The log row of the receiver: its last solution."""

    gnss_r_E_axis_m: Annotated[Xyz, "m", "GNSS position of the antenna, Earth-fixed"]
    gnss_v_E_axis_mps: Annotated[Xyz, "m/s", "GNSS velocity of the antenna relative to the Earth, Earth-fixed"]
    gnss_time_s: Annotated[float, "s", "time at which the GNSS solution was valid"]


@kernel
def gnss_row(memory: GnssMemory) -> GnssRow:
    return GnssRow(xyz(memory.solution, 0), xyz(memory.solution, 3), 1e-9 * memory.valid_ns)
