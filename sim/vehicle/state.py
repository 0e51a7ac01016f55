"""The list of state blocks, and the state vector that they form.

    r_I v_I q_BI w_BI_B | actuator pitch, yaw | gyro roll, pitch, yaw | gyro integrals
    eta[n_pitch] nu_pitch[n_pitch] xi[n_yaw] nu_yaw[n_yaw] | eta[n_spatial] nu[n_spatial]
    per pendulum: u_B (3), kappa_B (3) | per further group of engines: actuator pitch, yaw
    per TVC load: angle, rate, friction in pitch and yaw | per feed line: four | air lags: two
    per sensor after the gyro: output, integral

The first `N_FIXED` entries are the same for every vehicle. The bending and slosh states of the vehicle follow. Position
and velocity are those of the *core* CG (the vehicle without its sloshing masses, with the engine at rest), in the
inertial frame. The modal rates are quasi-velocities that include the rotation of the bending plane with the roll rate
p: nu_pitch = d(eta)/dt + p xi, nu_yaw = d(xi)/dt - p eta. The states of a pendulum are two vectors in body components
(docs/model.md, section 1): the unit vector u_B from its hinge to its bob, and its *inertial* derivative kappa_B.
"""

from __future__ import annotations

import math

from maxq.control.kernel.jit import kernel, routine
from maxq.control.kernel.records import Array
from maxq.control.kernel.vectors import Vector
from maxq.sim.vehicle.actuator.kernel import ACTUATORS, FURTHER_ACTUATORS
from maxq.sim.vehicle.air.lag import AIR_LAGS
from maxq.sim.vehicle.block import (
    ANGULAR_VELOCITY,
    ATTITUDE,
    LARGEST,
    POSITION,
    Q_BI,
    R_I,
    V_I,
    VELOCITY,
    W_BI_B,
    Counts,
    Sizes,
    StateBlock,
    counts,
)
from maxq.sim.vehicle.feed.kernel import FEED_LINES
from maxq.sim.vehicle.modes.planar import ETA_STATES, NU_PITCH_STATES, NU_YAW_STATES, XI_STATES
from maxq.sim.vehicle.modes.spatial import NU_SPATIAL_STATES, SPATIAL_STATES
from maxq.sim.vehicle.sensor.further import SENSORS
from maxq.sim.vehicle.sensor.gyro import GYRO_ANGLES, GYROS, gyro_start
from maxq.sim.vehicle.slosh.kernel import N_PENDULUM, PENDULUMS, pendulum_start, restore_pendulum
from maxq.sim.vehicle.tvc_load.kernel import TVC_LOADS

BLOCKS = (
    POSITION, VELOCITY, ATTITUDE, ANGULAR_VELOCITY, ACTUATORS, GYROS, GYRO_ANGLES,
    ETA_STATES, NU_PITCH_STATES, XI_STATES, NU_YAW_STATES, SPATIAL_STATES, NU_SPATIAL_STATES, PENDULUMS,
    FURTHER_ACTUATORS, TVC_LOADS, FEED_LINES, AIR_LAGS, SENSORS,
)  # fmt: skip  # a table
# checked in this order
BOUNDED = (ANGULAR_VELOCITY, ETA_STATES, XI_STATES, SPATIAL_STATES, AIR_LAGS, POSITION, VELOCITY)

Index = tuple[int, ...]  # index of a state: a constant, and the increment per part for each field of `Counts`
_NO_PARTS: Index = (0,) * (1 + len(Counts._fields))


def _index_of(block: StateBlock | None) -> Index:
    """Return the index of a block's first state; for None the number of states."""
    before = BLOCKS if block is None else BLOCKS[: BLOCKS.index(block)]
    widths = [tuple(len(b.states) * parts for parts in _parts_of(b)) for b in before]
    return tuple(sum(column) for column in zip(*widths, strict=True)) or _NO_PARTS


def _parts_of(block: StateBlock) -> Index:
    """Return the number of parts of a block, as an index."""
    return block.fixed_parts, *(int(block.counted_by == field) for field in Counts._fields)


ACTUATOR = _index_of(ACTUATORS)[0]
GYRO = _index_of(GYROS)[0]
GYRO_ANGLE = _index_of(GYRO_ANGLES)[0]
_ETA, _XI, _SPATIAL = _index_of(ETA_STATES), _index_of(XI_STATES), _index_of(SPATIAL_STATES)
_PENDULUM, _TVC_LOAD, _END = _index_of(PENDULUMS), _index_of(TVC_LOADS), _index_of(None)
_FURTHER_ACTUATORS, _FEED_LINES, _AIR_LAGS = map(_index_of, (FURTHER_ACTUATORS, FEED_LINES, AIR_LAGS))
_SENSORS = _index_of(SENSORS)
N_FIXED = _ETA[0]
N_ACTUATOR, N_FEED, N_SENSOR = len(ACTUATORS.states), len(FEED_LINES.states), len(SENSORS.states)
MAX_STATE = sum(
    len(b.states) * (getattr(LARGEST, b.counted_by) if b.counted_by else b.fixed_parts) for b in BLOCKS
)  # fmt: skip  # one sum

FINITE, NOT_FINITE = 0, 1  # causes of divergence; from 2 on, a bounded block in the order of BOUNDED
CAUSES = ("", "a state is not finite", *(block.excess for block in BOUNDED))
# for each bounded block: its first state, its number of parts, the number of states per part, the bound
_LIMITS: tuple[tuple[Index, Index, int, float], ...] = tuple(
    (_index_of(b), _parts_of(b), len(b.states), b.bound) for b in BOUNDED
)


@kernel
def _at(index: Index, sizes: Sizes | Counts) -> int:
    """Evaluate an index with the fields of `Counts` in their order.

    The terms are written out, because a loop over them would not become one constant expression.
    """
    modes = index[1] * sizes.pitch_modes + index[2] * sizes.yaw_modes
    rest = index[3] * sizes.pendulums + index[4] * sizes.surfaces + index[5] * sizes.tables
    more = index[7] * sizes.further_groups + index[11] * sizes.tvc_loads + index[12] * sizes.sensors
    more += index[14] * sizes.feed_lines + index[15] * sizes.air_lags
    return index[0] + modes + rest + index[6] * sizes.spatial_modes + more


@kernel
def state_size(sizes: Sizes | Counts) -> int:
    return _at(_END, sizes)


@kernel
def eta_index(sizes: Sizes | Counts) -> int:
    """Return the index of the first modal coordinate in pitch; the rates follow `pitch_modes` entries later."""
    return _at(_ETA, sizes)


@kernel
def xi_index(sizes: Sizes | Counts) -> int:
    """Return the index of the first modal coordinate in yaw; the rates follow `yaw_modes` entries later."""
    return _at(_XI, sizes)


@kernel
def spatial_index(sizes: Sizes | Counts) -> int:
    """Return the index of the first coordinate of the spatial modes; the rates follow `spatial_modes` entries later."""
    return _at(_SPATIAL, sizes)


@kernel
def pendulum_index(sizes: Sizes | Counts, tank: int) -> int:
    """Return the index of u_B of a pendulum; kappa_B follows three entries later."""
    return _at(_PENDULUM, sizes) + N_PENDULUM * tank


@kernel
def actuator_index(sizes: Sizes | Counts, group: int) -> int:
    """Return the index of the first state of a group's pitch actuator; yaw follows `N_ACTUATOR` entries later."""
    return ACTUATOR if group == 0 else _at(_FURTHER_ACTUATORS, sizes) + 2 * N_ACTUATOR * (group - 1)


@kernel
def tvc_load_index(sizes: Sizes | Counts) -> int:
    """Return the index of angle, rate and friction of the first TVC load in pitch; those in yaw follow."""
    return _at(_TVC_LOAD, sizes)


@kernel
def feed_index(sizes: Sizes | Counts) -> int:
    """Return the index of the first state of the first feed line."""
    return _at(_FEED_LINES, sizes)


@kernel
def air_lag_index(sizes: Sizes | Counts) -> int:
    """Return the index of the lagged coordinate of the first mode in pitch; that in yaw follows."""
    return _at(_AIR_LAGS, sizes)


@kernel
def sensor_index(sizes: Sizes | Counts, sensor: int) -> int:
    """Return the index of a sensor's outputs and their rates about or along x, y, z.

    The integrals of the outputs follow six entries later.
    """
    return _at(_SENSORS, sizes) + N_SENSOR * sensor


def state_names(sizes: Sizes) -> tuple[str, ...]:
    return tuple(name for block in BLOCKS for name in block.names(sizes))


@routine
def start_states(sizes: Sizes, rate: Vector, separation: int, y: Array) -> None:
    """Set the initial values of all blocks except those of the rigid body, which turns at `rate` (B, rad/s).

    With `separation` = 1, the values are those at the start of a later stage, where the gyro and the further sensors
    keep their states.
    """
    for i in range(ACTUATOR, state_size(sizes) if separation == 0 else sensor_index(sizes, 0)):
        if separation == 0 or i < GYRO or i >= N_FIXED:
            y[i] = 0.0
    if separation == 0:
        gyro_start(y, GYRO, rate)
    for tank in range(sizes.pendulums):
        pendulum_start(y, pendulum_index(sizes, tank), rate)


@kernel
def restore_constraints(sizes: Counts, y: Array) -> None:
    """Normalise the quaternion and the pendulums' unit vectors, and make the pendulums' rates perpendicular to them."""
    a, b, c, d = y[Q_BI], y[Q_BI + 1], y[Q_BI + 2], y[Q_BI + 3]
    scale = 1.0 / math.sqrt(a * a + b * b + c * c + d * d)
    for j in range(4):
        y[Q_BI + j] *= scale
    for tank in range(sizes.pendulums):
        restore_pendulum(y, pendulum_index(sizes, tank))


@routine
def divergence_cause(sizes: Counts, y: Array) -> int:
    """Return the cause of divergence of a state (index into CAUSES), or FINITE."""
    infinite = 0
    for i in range(state_size(sizes)):  # without an early exit, so that several states are compared at a time
        infinite += 0 if abs(y[i]) < math.inf else 1  # a NaN fails every comparison
    if infinite > 0:
        return NOT_FINITE
    for k in range(len(_LIMITS)):
        first, parts, states, bound = _LIMITS[k]
        i = _at(first, sizes)
        for _ in range(_at(parts, sizes)):
            magnitude = 0.0
            for _ in range(states):
                magnitude += abs(y[i])
                i += 1
            if magnitude > bound:
                return 2 + k
    return FINITE


__all__ = ["N_PENDULUM", "Q_BI", "R_I", "TVC_LOADS", "V_I", "W_BI_B", "Counts", "Sizes", "counts"]
