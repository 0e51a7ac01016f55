"""Processing of the further sensors in the computer: counts, latency, lost samples, and the blended rate of the law.

    q_g = w_0 q_0 + sum of w_k q_k

q_g blends the first gyro and further rate gyros, in pitch and yaw separately. The weights sum to 1. All points of a
rigid body have the same rate, so the weights change only the bending content of the law's input. The attitude is that
of the first gyro.
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
    """The parameters of the sensors.

    - `count`, `gyros`: number of sensors, and of the rate gyros among them, which come first.
    - `accelerometer`: index of the first accelerometer, which the laws use; -1 without one.
    - `converter`: angle (rad) or velocity (m/s) per pulse.
    - `latency`: delay of the output, samples.
    - `blend` (2, sensors): weights w_0, w_1 and so on, in pitch and yaw.
    """

    count: int
    gyros: int
    accelerometer: int
    converter: Annotated[tuple[Converter, ...], (MAX_SENSORS,)]
    latency: Annotated[IntArray, (MAX_SENSORS,)]
    blend: Annotated[Array, (2, MAX_SENSORS)]


@dataclass
class SensorState:
    """The state of the sensors.

    - `increment` (sensors, 3): output over the sample, written by the caller.
    - `lost`: 1 if the output did not arrive.
    - `past`: increments of the last samples, a ring buffer.
    - `delta` (sensors, 3): increments used by the computer, rad or m/s.
    - `value` (sensors, 3): their mean over the sample, rad/s or m/s2.
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
    accelerometers: int = 0,
    blend: Sequence[Sequence[float]] = (),
) -> Sensors:
    """Return the parameters of the sensors.

    - `counts`: angle (rad) or velocity (m/s) per pulse of each sensor.
    - `latency`: delay of each sensor, samples.
    - `accelerometers`: number of the last sensors that are accelerometers.
    - `blend`: weights in pitch and in yaw, by default (1, 0, ...).

    Raises ValueError if weights do not sum to 1, if their number differs from that of the rate gyros, and as
    `make_converter` does.
    """
    n, gyros = len(counts), len(counts) - accelerometers
    late, weights = np.zeros(MAX_SENSORS, np.int64), np.zeros((2, MAX_SENSORS))
    late[:n], weights[:, 0] = latency, 1.0
    for gimbal, given in enumerate(blend):
        if len(given) != gyros + 1:
            raise ValueError(f"blend has {len(given)} weights: allowed is {gyros + 1}, one for each rate gyro")
        if abs(sum(given) - 1.0) > 1e-6:
            raise ValueError(f"blend sums to {sum(given):g}: allowed is 1")
        weights[gimbal, : gyros + 1] = given
    converters = [make_converter(count) for count in counts]
    padded = (*converters, *[make_converter(0.0)] * (MAX_SENSORS - n))
    return Sensors(n, gyros, gyros if accelerometers > 0 else -1, padded, late, weights)


@kernel
def start_sensors(sensors: Sensors, state: SensorState) -> None:
    """Clear all counts, and set all values to 0."""
    for k in range(sensors.count):
        start_converter(state.converter[k])
        for axis in range(3):
            state.delta[k, axis], state.value[k, axis] = 0.0, 0.0
            for ago in range(MAX_LATENCY + 1):
                state.past[ago, k, axis] = 0.0


@routine
def read_sensors(sensors: Sensors, state: SensorState, tick: int, sample_s: float, limit: float) -> int:
    """Count the increments of a sample, and return the number of rejected increments: not finite, or beyond `limit`.

    If a sample is lost, the previous value remains in force, and the counts of the lost sample are not recovered.
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
    """Return the law's rate about the axis of a gimbal (0 pitch, 1 yaw), blended from all gyros, rad/s."""
    rate_radps: float = sensors.blend[gimbal, 0] * first_radps
    for k in range(MAX_SENSORS - 1):
        if k < sensors.gyros:
            rate_radps += sensors.blend[gimbal, 1 + k] * state.value[k, 1 + gimbal]
    return rate_radps
