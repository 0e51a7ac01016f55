"""The fast linear parts of a vehicle, whose motion under a known force is computed exactly: modes, actuators, gyros.

Each part is a block of up to six states with its own matrix D. All other effects on it are slow or external. A step of
length h (`step.exponential_runge_kutta`) needs seven matrices of each block: D, and those listed below, of the
functions

    phi_1(Z) = (exp(Z) - 1) / Z,   phi_2(Z) = (phi_1(Z) - 1) / Z,   phi_3(Z) = (phi_2(Z) - 1/2) / Z,   Z = h D.

They are stored for the few step lengths that alternate. D may be any matrix near the current matrix that is constant
within a step. Hence the modes, which change with the propellant, are updated only every quarter of a second. Actuators
and gyros are constant until the stage ends.
"""

from __future__ import annotations

from maxq.control.kernel.jit import kernel, routine
from maxq.control.kernel.limits import MAX_ENGINES, MAX_MODES
from maxq.control.kernel.records import Array
from maxq.sim.vehicle import schedule as sch
from maxq.sim.vehicle.actuator.kernel import Actuator, linear_sections
from maxq.sim.vehicle.block import Counts, counts
from maxq.sim.vehicle.derivative import StageRecord
from maxq.sim.vehicle.state import ACTUATOR, GYRO, N_ACTUATOR, actuator_index, eta_index, spatial_index, xi_index
from maxq.sim.vehicle.workspace import Evaluation

D = 0  # matrices of a block, row by row, one after the other
FORCED_HALF = 1  # h/2 phi_1(Z/2): motion in half a step under a constant force
TURNED_HALF = 2  # h phi_2(Z/2)
FORCED = 3  # h phi_1(Z)
TURNED = 4  # 2 h phi_2(Z)
MIDDLE = 5  # 2 h phi_2(Z) - 4 h phi_3(Z): weight of the force at the two middle stages
LAST = 6  # 4 h phi_3(Z) - h phi_2(Z): weight of the force at the last stage
_MATRICES = 7
LARGEST = N_ACTUATOR
_BLOCKS = 3 * MAX_MODES + 2 * MAX_ENGINES + 3

# Layout of a stored step length: the step and the end of validity of its modes (ns), its stage from 1, its number of
# blocks; then for each block its first state, the distance to the next state, the number of states, the place of its
# matrices; then the matrices.
STEP_NS, UNTIL_NS, STAGE, COUNT = 0, 1, 2, 3
HEAD = 4
BLOCK_WIDTH = 4
_NUMBERS = HEAD + BLOCK_WIDTH * _BLOCKS
_SCRATCH = 2 * LARGEST * LARGEST
LENGTH_WIDTH = (
    _NUMBERS + _MATRICES * (4 * (3 * MAX_MODES + 1) + LARGEST * LARGEST * 2 * MAX_ENGINES) + _SCRATCH
)  # fmt: skip  # one sum
LENGTHS = 6  # number of stored step lengths
KEPT_SIZE = LENGTHS * LENGTH_WIDTH + 1  # the last element is the index of the length to be replaced next
MOVED_WIDTH = 5 * LARGEST
MOVED_SIZE = MOVED_WIDTH * _BLOCKS
_KEPT_NS = 250_000_000
_LEAST_TERM = 1e-18


@routine
def blocks_for(kept: Array, vehicle: StageRecord, stage: int, now_ns: int, step_ns: int, at: Evaluation) -> int:
    """Return the index in `kept` (KEPT_SIZE,) of the blocks for this step.

    The blocks are computed from the evaluation at the start of the step if needed. Times are whole numbers of ns, which
    a float64 represents exactly for a hundred days.
    """
    for k in range(LENGTHS):
        slot = k * LENGTH_WIDTH
        if kept[slot + STEP_NS] == step_ns and kept[slot + STAGE] == stage + 1:
            if now_ns >= kept[slot + UNTIL_NS]:
                kept[slot + COUNT] = 0.0
                kept[slot + UNTIL_NS] = now_ns + _KEPT_NS
                _add_modes(kept, slot, vehicle, counts(vehicle.sizes), 1e-9 * step_ns, at)
                kept[slot + COUNT] += _further_blocks(vehicle)
            return slot
    turn = int(kept[LENGTHS * LENGTH_WIDTH])
    kept[LENGTHS * LENGTH_WIDTH] = (turn + 1) % LENGTHS
    slot = turn * LENGTH_WIDTH
    kept[slot + STEP_NS], kept[slot + UNTIL_NS] = step_ns, now_ns + _KEPT_NS
    kept[slot + STAGE], kept[slot + COUNT] = stage + 1, 0.0
    h, sizes = 1e-9 * step_ns, counts(vehicle.sizes)
    end = _add_modes(kept, slot, vehicle, sizes, h, at)
    end = _add_actuator(kept, slot, end, vehicle.actuator_pitch, vehicle.actuator_pitch, 0, ACTUATOR, h)
    yaw = ACTUATOR + N_ACTUATOR
    end = _add_actuator(kept, slot, end, vehicle.actuator_yaw, vehicle.actuator_pitch, 1, yaw, h)
    for channel in range(2 * sizes.further_groups):
        i, of = actuator_index(sizes, 1) + N_ACTUATOR * channel, vehicle.further_actuators
        end = _add_actuator(kept, slot, end, of[channel], of[max(channel - 1, 0)], channel, i, h)
    if vehicle.gyro.ideal == 0:
        w, zeta = vehicle.gyro.omega_radps, vehicle.gyro.zeta
        for axis in range(3):
            _add_block(kept, slot, GYRO + 2 * axis, 1, 2, end)
        put_oscillator(kept, end, w * w, 2.0 * zeta * w, h)
    return slot


@kernel
def _further_blocks(vehicle: StageRecord) -> int:
    """Return the number of blocks after the modes."""
    blocks = (1 - vehicle.actuator_pitch.ideal) + (1 - vehicle.actuator_yaw.ideal)
    for channel in range(2 * vehicle.sizes.further_groups):
        blocks += 1 - vehicle.further_actuators[channel].ideal
    return blocks + 3 * (1 - vehicle.gyro.ideal)


@kernel
def _add_block(kept: Array, slot: int, first: int, stride: int, states: int, matrices: int) -> None:
    i = slot + HEAD + BLOCK_WIDTH * int(kept[slot + COUNT])
    kept[i], kept[i + 1], kept[i + 2], kept[i + 3] = first, stride, states, matrices
    kept[slot + COUNT] += 1.0


@routine
def _add_modes(kept: Array, slot: int, vehicle: StageRecord, sizes: Counts, h: float, at: Evaluation) -> int:
    """Add all modes, with the current stiffness under the axial load, and return the index of the next matrices."""
    p, end = at.properties, slot + _NUMBERS
    soft = vehicle.bending.softening_factor * at.aux.axial_load_mps2
    for plane in (sch.PITCH, sch.YAW):
        n, first = sizes.pitch_modes, eta_index(sizes)
        if plane == sch.YAW:
            n, first = sizes.yaw_modes, xi_index(sizes)
        for i in range(n):
            inverse = p[sch.derived_column(sizes, plane, sch.MODE_INVERSE_MASS) + i]
            taken = soft * p[sch.mode_column(sizes, plane, sch.softening_row(sizes, i)) + i]
            stiffness = p[sch.derived_column(sizes, plane, sch.MODE_STIFFNESS) + i] - taken
            damping = p[sch.derived_column(sizes, plane, sch.MODE_DAMPING) + i]
            _add_block(kept, slot, first + i, n, 2, end)
            put_oscillator(kept, end, stiffness * inverse, damping * inverse, h)
            end += 4 * _MATRICES
    n = sizes.spatial_modes
    for i in range(n):
        inverse = p[sch.spatial_derived(sizes, sch.MODE_INVERSE_MASS) + i]
        taken = soft * p[sch.spatial_column(sizes, sch.spatial_softening_row(sizes, i)) + i]
        stiffness = p[sch.spatial_derived(sizes, sch.MODE_STIFFNESS) + i] - taken
        damping = p[sch.spatial_derived(sizes, sch.MODE_DAMPING) + i]
        _add_block(kept, slot, spatial_index(sizes) + i, n, 2, end)
        put_oscillator(kept, end, stiffness * inverse, damping * inverse, h)
        end += 4 * _MATRICES
    return end


@routine
def _add_actuator(
    kept: Array, slot: int, end: int, a: Actuator, before: Actuator, channel: int, first: int, h: float
) -> int:
    """Add the sections of an actuator as one block, and return the index of the next matrices.

    The matrices of the actuator `before` it are reused if they are equal.
    """
    if a.ideal == 1:
        return end
    n = a.order
    alike = before.ideal == 0 and a.order == before.order and a.limits_on_engine == before.limits_on_engine
    alike = alike and a.omega_1_radps == before.omega_1_radps and a.zeta_1 == before.zeta_1
    alike = alike and a.omega_2_radps == before.omega_2_radps and a.zeta_2 == before.zeta_2
    alike = alike and a.omega_3_radps == before.omega_3_radps and a.zeta_3 == before.zeta_3
    alike = alike and a.omega_4_radps == before.omega_4_radps and a.zeta_4 == before.zeta_4
    if channel > 0 and alike:
        _add_block(kept, slot, first, 1, n, end - _MATRICES * n * n)
        return end
    _add_block(kept, slot, first, 1, n, end)
    linear_sections(a, kept, end)
    put_functions(kept, end, n, h, slot + LENGTH_WIDTH - _SCRATCH)
    return end + _MATRICES * n * n


@kernel
def put_oscillator(kept: Array, i: int, a: float, b: float, h: float) -> None:
    """Write the matrices of x' = v, v' = -a x - b v at kept[i:].

    Every function of D has the form p + q D, because D^2 = -a - b D.
    """
    kept[i], kept[i + 1], kept[i + 2], kept[i + 3] = 0.0, 1.0, -a, -b
    for half in range(2):
        t = h if half == 0 else 0.5 * h
        p, q, factor, p_2, q_2, p_3, q_3 = 1.0, 0.0, 0.5, 0.5, 0.0, 1.0 / 6.0, 0.0
        for j in range(1, 60):  # t D to the power j is p + q D
            p, q = -a * t * q, t * (p - b * q)
            factor /= j + 2
            p_2, q_2 = p_2 + factor * p, q_2 + factor * q
            p_3, q_3 = p_3 + factor / (j + 3) * p, q_3 + factor / (j + 3) * q
            if factor * (abs(p) + abs(q)) < _LEAST_TERM:
                break
        p_1, q_1 = 1.0 - a * t * q_2, t * (p_2 - b * q_2)
        if half == 0:
            _put_two(kept, i + 4 * FORCED, a, b, h * p_1, h * q_1)
            _put_two(kept, i + 4 * TURNED, a, b, 2.0 * h * p_2, 2.0 * h * q_2)
            _put_two(kept, i + 4 * MIDDLE, a, b, h * (2.0 * p_2 - 4.0 * p_3), h * (2.0 * q_2 - 4.0 * q_3))
            _put_two(kept, i + 4 * LAST, a, b, h * (4.0 * p_3 - p_2), h * (4.0 * q_3 - q_2))
        else:
            _put_two(kept, i + 4 * FORCED_HALF, a, b, t * p_1, t * q_1)
            _put_two(kept, i + 4 * TURNED_HALF, a, b, h * p_2, h * q_2)


@kernel
def _put_two(kept: Array, i: int, a: float, b: float, p: float, q: float) -> None:
    """Write the matrix p + q D at kept[i:]."""
    kept[i], kept[i + 1], kept[i + 2], kept[i + 3] = p, q, -a * q, p - b * q


@routine
def put_functions(kept: Array, i: int, n: int, h: float, scratch: int) -> None:
    """Write the other matrices of the block whose D (n, n) is at kept[i:], by their power series."""
    size = n * n
    for half in range(2):
        t = h if half == 0 else 0.5 * h
        second, third = i + size * TURNED, i + size * LAST
        if half == 1:
            second, third = i + size * TURNED_HALF, i + size * FORCED_HALF
        power, following, factor = scratch, scratch + LARGEST * LARGEST, 0.5
        for j in range(size):
            one = 1.0 if j % (n + 1) == 0 else 0.0
            kept[power + j], kept[second + j], kept[third + j] = one, 0.5 * one, one / 6.0
        for j in range(1, 60):
            _times(kept, i, power, following, n, t)
            power, following = following, power
            factor /= j + 2
            largest = 0.0
            for e in range(size):
                term = factor * kept[power + e]
                kept[second + e] += term
                kept[third + e] += term / (j + 3)
                largest = max(largest, abs(term))
            if largest < _LEAST_TERM:
                break
        _times(kept, i, second, following, n, t)  # phi_1 = 1 + Z phi_2
        first = i + size * (FORCED if half == 0 else FORCED_HALF)
        for e in range(size):
            phi_1 = kept[following + e] + (1.0 if e % (n + 1) == 0 else 0.0)
            phi_2, phi_3 = kept[second + e], kept[third + e]
            kept[first + e] = t * phi_1
            if half == 0:
                kept[second + e] = 2.0 * h * phi_2
                kept[i + size * MIDDLE + e] = h * (2.0 * phi_2 - 4.0 * phi_3)
                kept[third + e] = h * (4.0 * phi_3 - phi_2)
            else:
                kept[second + e] = h * phi_2


@kernel
def _times(kept: Array, matrix: int, other: int, out: int, n: int, t: float) -> None:
    """Write t D times another matrix at kept[out:]; D has few nonzero entries."""
    for row in range(n):
        for column in range(n):
            kept[out + n * row + column] = 0.0
        for j in range(n):
            entry = t * kept[matrix + n * row + j]
            if entry != 0.0:
                for column in range(n):
                    kept[out + n * row + column] += entry * kept[other + n * j + column]


@kernel
def row_times(kept: Array, matrix: int, row: int, n: int, vector: Array, at: int) -> float:
    """Return a row of a block's matrix times the vector at vector[at:]."""
    i, total = matrix + n * row, 0.0
    for j in range(n):
        total += kept[i + j] * vector[at + j]
    return total
