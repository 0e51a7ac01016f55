"""The measurements of a sampled path on a circle outside the unit circle, for step responses.

The inverse z-transform on a circle of radius r through N points is

    y[n] = r^n / N sum over k of Y(z_k) exp(2 pi j n k / N),    z_k = r exp(2 pi j k / N)

which differs from y[n] by y[n + N] r^-N and so on. Poles up to the radius r are permitted, so that a slow drift of the
vehicle needs no long response.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from maxq.control.kernel.records import Array
from maxq.design.laws.law import ANGLES, DRIFTS
from maxq.design.loop.fixed_path import FixedPath, SampledFixedPath
from maxq.design.model.instruments import ACCELERATION
from maxq.design.model.state_space import ComplexArray

ALIAS = 1e-9  # r^-N


@dataclass(frozen=True)
class StepPaths:
    """The measurements of a path (F, inputs) per gimbal command at the upper half of a circle, without the law.

    `x` (F,) is ln f with f = ln z / (2 pi j T), which is complex. `sums` (F,) is the ratio of angle integral to angle,
    and `angle` (F,) the measured attitude. `count` is the number of samples of a response.
    """

    x: ComplexArray
    paths: ComplexArray
    sums: ComplexArray
    angle: ComplexArray
    sample_s: float
    count: int

    @property
    def size(self) -> int:
        """Return N."""
        return 2 * (len(self.x) - 1)

    @property
    def radius(self) -> float:
        return float(ALIAS ** (-1.0 / self.size))

    def step(self) -> ComplexArray:
        """Return the z-transform of a unit step."""
        return np.asarray(self.sums / self.sample_s)

    def response(self, transform: ComplexArray) -> Array:
        """Return the samples of a signal, (count,), from its z-transform (F,)."""
        n = np.arange(self.count)
        return np.asarray(self.radius**n * np.fft.irfft(transform, self.size)[: self.count])

    def weights(self, samples: Array) -> ComplexArray:
        """Return the weights (samples, F) whose sum with a transform has the signal at these samples as real part."""
        k = np.arange(len(self.x))
        double = np.where((k == 0) | (k == len(k) - 1), 1.0, 2.0)
        turn = np.exp(2j * np.pi * np.outer(samples, k) / self.size)
        return np.asarray(self.radius ** samples[:, None] / self.size * double * turn)


def step_paths(path: FixedPath, measurements: tuple[str, ...], until_s: float) -> StepPaths:
    """Return the measurements of a path for step responses of `until_s`. Raises ValueError for a continuous path."""
    if not isinstance(path, SampledFixedPath):
        raise ValueError("a step response needs the sampled loop: allowed is loop = 'sampled'")
    period = path.sample_s
    count = math.ceil(until_s / period) + 1
    size = 2 ** math.ceil(math.log2(2 * count))
    k = np.arange(size // 2 + 1)
    z = ALIAS ** (-1.0 / size) * np.exp(2j * np.pi * k / size)
    late = [0, *(samples for _, _, samples in path.sensors)]
    mean = path.sampled.at(z, path.sampled.resolvent())[..., 0] * np.stack([z**-n for n in late], axis=-1)
    sums = period * z / (z - 1.0)
    angle = sums * mean[:, 0]
    known = {"rate_radps": mean[:, 0]} | {name: angle * sums**n for n, name in enumerate(ANGLES)}
    known |= {name: mean[:, n] for n, (name, _, _) in enumerate(path.sensors, 1)}
    if ACCELERATION in known:
        across = known[ACCELERATION] - path.node.axial_load_mps2 * angle
        known |= {name: across * sums ** (1 + n) for n, name in enumerate(DRIFTS)}
    x = np.log(np.log(z) / (2j * np.pi * period))
    return StepPaths(x, np.stack([known[name] for name in measurements], axis=1), sums, angle, period, count)
