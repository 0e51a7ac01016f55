"""The barometer: static air pressure at the altitude of the core CG, at each sample, with bias, scale and noise."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from maxq.control.kernel.jit import kernel
from maxq.control.kernel.noise import standard_normal
from maxq.control.kernel.records import Array
from maxq.sim.vehicle.faults import BAROMETER_ADDED, BAROMETER_DEAD, BAROMETER_STUCK

if TYPE_CHECKING:
    from maxq.sim.vehicle.sensor.section import BarometerSection

BAROMETER_STREAM = 86


@dataclass(frozen=True)
class Barometer:
    """The parameters of the barometer. `on`: 0 without one."""

    on: int = 0
    bias_Pa: float = 0.0
    scale: float = 0.0  # relative error
    noise_Pa: float = 0.0


def pack_barometer(given: BarometerSection | None) -> Barometer:
    return Barometer() if given is None else Barometer(1, given.bias_Pa, given.scale_factor, given.noise_Pa)


@kernel
def measured_pressure(b: Barometer, before_Pa: float, true_Pa: float, seed: int, sample: int, faults: Array) -> float:
    """Return the output, Pa; it remains `before_Pa` while the sensor is stuck, and is not negative."""
    if faults[BAROMETER_STUCK] > 0.0:
        return before_Pa
    if faults[BAROMETER_DEAD] > 0.0:
        return 0.0
    out: float = (1.0 + b.scale) * true_Pa + b.bias_Pa + faults[BAROMETER_ADDED]
    if b.noise_Pa > 0.0:
        out += b.noise_Pa * standard_normal(seed, BAROMETER_STREAM, sample)
    return max(out, 0.0)
