"""Sensors beyond the first gyro, in the computer: counting, latency, lost samples, and the blended rate of the law.

    q_g = w_0 q_0 + sum of w_k q_k

of the first gyro and of further rate gyros, pitch and yaw by themselves. The weights sum to 1: a rigid body turns alike
everywhere, so that they change what the law sees of bending and nothing else. The attitude is that of the first gyro.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import numpy as np

from maxq.control.converter import Converter, ConverterState, convert, make_converter, start_converter
from maxq.control.kernel.jit import kernel, routine
from maxq.control.kernel.limits import MAX_LATENCY, MAX_SENSORS
from maxq.control.kernel.records import Array, IntArray


@dataclass(frozen=True)
class Sensors:
    """`accelerometer`: number of the last one, which is an accelerometer; -1 without.

    `converter`: angle (rad) or velocity (m/s) per pulse. `latency`: samples. `blend` (2, sensors): weights w_0, w_1 and
    so on in pitch and yaw.
    """

    count: int
    accelerometer: int
    converter: Annotated[tuple[Converter, ...], (MAX_SENSORS,)]
    latency: Annotated[IntArray, (MAX_SENSORS,)]
    blend: Annotated[Array, (2, MAX_SENSORS)]


@dataclass
class SensorState:
    """`increment` (sensors, 3): output over the sample, written by the caller, and `lost`: 1 where it did not arrive.

    `past`: what was counted in the last samples, a ring; `delta` (sensors, 3): what the computer goes by, rad or m/s,
    and `value` its mean over the sample, rad/s or m/s2.
    """

    converter: Annotated[tuple[ConverterState, ...], (MAX_SENSORS,)]
    increment: Annotated[Array, (MAX_SENSORS, 3)]
    lost: Annotated[IntArray, (MAX_SENSORS,)]
    past: Annotated[Array, (MAX_LATENCY + 1, MAX_SENSORS, 3)]
    delta: Annotated[Array, (MAX_SENSORS, 3)]
    value: Annotated[Array, (MAX_SENSORS, 3)]


def make_sensors(
    counts: Sequence[float] = (),
    latency: Sequence[int] = (),
    accelerometer: bool = False,
    blend: Sequence[Sequence[float]] = (),
) -> Sensors:
    """`counts`: angle or velocity per pulse of each sensor. `blend`: weights in pitch and in yaw, default (1, 0, ...).

    Raises ValueError for weights that do not sum to 1, for more of them than rate gyros, and as `make_converter`.
    """
    n, gyros = len(counts), len(counts) - int(accelerometer) + 1
    late, weights = np.zeros(MAX_SENSORS, np.int64), np.zeros((2, MAX_SENSORS))
    late[:n], weights[:, 0] = latency, 1.0
    for gimbal, given in enumerate(blend):
        if len(given) != gyros:
            raise ValueError(f"blend has {len(given)} weights: allowed is {gyros}, one for each rate gyro")
        if abs(sum(given) - 1.0) > 1e-6:
            raise ValueError(f"blend sums to {sum(given):g}: allowed is 1")
        weights[gimbal, :gyros] = given
    converters = [make_converter(count) for count in counts]
    padded = (*converters, *[make_converter(0.0)] * (MAX_SENSORS - n))
    return Sensors(n, n - 1 if accelerometer else -1, padded, late, weights)


@kernel
def start_sensors(sensors: Sensors, state: SensorState) -> None:
    """Nothing counted, all values 0."""
    for k in range(sensors.count):
        start_converter(state.converter[k])
        for axis in range(3):
            state.delta[k, axis], state.value[k, axis] = 0.0, 0.0
            for ago in range(MAX_LATENCY + 1):
                state.past[ago, k, axis] = 0.0


@routine
def read_sensors(sensors: Sensors, state: SensorState, tick: int, sample_s: float, limit: float) -> int:
    """Count the increments of a sample; returns how many were refused: not finite, or beyond `limit`.

    A sample that is lost leaves the value before in force; what it counted is lost with it.
    """
    refused, slots = 0, MAX_LATENCY + 1
    for k in range(sensors.count):
        for axis in range(3):
            increment = state.increment[k, axis]
            if not abs(increment) <= limit:
                increment = 0.0
                refused += 1
            convert(sensors.converter[k], state.converter[k], axis, increment)
            state.past[tick % slots, k, axis] = state.converter[k].increment_rad[axis]
            if state.lost[k] == 0:
                state.delta[k, axis] = state.past[(tick + slots - sensors.latency[k]) % slots, k, axis]
                state.value[k, axis] = state.delta[k, axis] / sample_s
    return refused


@kernel
def blended_rate(sensors: Sensors, state: SensorState, gimbal: int, first_radps: float) -> float:
    """Rate of the law about the axis of a gimbal (0 pitch, 1 yaw), rad/s, from the first gyro's and further ones'."""
    rate_radps: float = sensors.blend[gimbal, 0] * first_radps
    for k in range(MAX_SENSORS - 1):
        if k < sensors.count and k != sensors.accelerometer:
            rate_radps += sensors.blend[gimbal, 1 + k] * state.value[k, 1 + gimbal]
    return rate_radps
