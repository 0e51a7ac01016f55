"""The voltage-to-frequency converter, which turns the gyro rate integrated over a sample into a whole number of pulses.

A pulse represents `count_rad`. The residual of a sample remains in the integrator and is counted later. Hence the sum
of the pulses always equals the true angle within half a pulse (Lee, Ahn & Roh 2.3; errata 15).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated

from maxq.control.kernel.jit import kernel
from maxq.control.kernel.records import Array, IntArray

# With a finer pulse, the accumulated rounding of the residual (1e-18 rad per sample) could reach one count in a long
# flight, and the int64 total could overflow.
FINEST_COUNT_RAD = 1.0e-9


@dataclass(frozen=True)
class Converter:
    """The parameter of the converter.

    `count_rad`: angle per pulse, rad. With 0, the converter is ideal and returns the increment itself.
    """

    count_rad: float


@dataclass
class ConverterState:
    """The state of the converter, per body axis x, y, z (roll, pitch, yaw), in B relative to I.

    - `counts`: pulses of the last sample.
    - `total_counts`: exact sum of all pulses. In an ideal converter, both counts are 0.
    - `residual_rad`: angle not yet counted.
    - `increment_rad`: measured increment of the last sample.
    - `angle_rad`: sum of the measured increments, computed from `total_counts`, not by adding floats.
    """

    counts: Annotated[IntArray, (3,)]
    total_counts: Annotated[IntArray, (3,)]
    residual_rad: Annotated[Array, (3,)]
    increment_rad: Annotated[Array, (3,)]
    angle_rad: Annotated[Array, (3,)]


def make_converter(count_rad: float) -> Converter:
    """Return a converter; `count_rad` must be 0 (ideal) or finite and at least `FINEST_COUNT_RAD`.

    Raises ValueError for other values.
    """
    if not (count_rad == 0 or FINEST_COUNT_RAD <= count_rad < math.inf):
        raise ValueError(f"count_rad = {count_rad}: allowed is 0 (ideal) or at least {FINEST_COUNT_RAD:g}")
    return Converter(count_rad)


@kernel
def round_half_away(value: float) -> int:
    """Return the nearest whole number, with halves rounded away from 0.

    Hence a mirrored flight is the exact mirror image.
    """
    return int(value + math.copysign(0.5, value))


@kernel
def start_converter(state: ConverterState) -> None:
    """Set all counts and angles to 0."""
    for axis in range(3):
        state.counts[axis] = 0
        state.total_counts[axis] = 0
        state.residual_rad[axis] = 0.0
        state.increment_rad[axis] = 0.0
        state.angle_rad[axis] = 0.0


@kernel
def convert(converter: Converter, state: ConverterState, axis: int, increment_rad: float) -> None:
    """Count the gyro angle `increment_rad` of one sample on body axis `axis` (0 roll, 1 pitch, 2 yaw).

    Afterwards |residual_rad| <= count_rad/2, and angle_rad differs from the sum of all true increments by the residual.
    The increment must be finite and below 9e18 count_rad, as `computer_tick` ensures.
    """
    if converter.count_rad == 0.0:
        state.increment_rad[axis] = increment_rad
        state.angle_rad[axis] += increment_rad
        return
    available_rad = increment_rad + state.residual_rad[axis]
    counts = round_half_away(available_rad / converter.count_rad)
    state.counts[axis] = counts
    state.total_counts[axis] += counts
    state.residual_rad[axis] = available_rad - counts * converter.count_rad
    state.increment_rad[axis] = counts * converter.count_rad
    state.angle_rad[axis] = state.total_counts[axis] * converter.count_rad
