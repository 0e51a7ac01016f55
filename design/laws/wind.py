"""What wind does to the closed loop: root mean squares of load and drift under a spectrum, and their gradients.

    T = G_w - G_u (sum of C_i M_i) / (1 + L),    rms^2 = integral of |T|^2 S df

from the lateral wind to an output, with the law's measurements M_i per wind, the output G_u per command and G_w per
wind. Load is dynamic pressure times incidence (relative to the air at the core's CG), drift the lateral velocity across
the undisturbed path, w - U theta. Frequencies are those that an ascent sees, `LOWEST_HZ` to `HIGHEST_HZ`; the computer
is in it as in the loop, the wind's images beyond its Nyquist frequency are not. A loop that is not stable has no rms:
stability is the optimiser's affair.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from maxq.control.kernel.records import Array
from maxq.design.model.state_space import ComplexArray

LOWEST_HZ, HIGHEST_HZ, POINTS = 0.02, 5.0, 96
LOAD, DRIFT = 0, 1  # outputs
WIND_LIMITS = {"q_alpha_Padeg": ("load q alpha in wind, rms", "Pa deg"), "drift_mps": ("drift in wind, rms", "m/s")}


def frequencies() -> Array:
    """x = ln f of the integral."""
    return np.linspace(math.log(LOWEST_HZ), math.log(HIGHEST_HZ), POINTS)


@dataclass(frozen=True)
class Spectrum:
    """Lateral spectrum of MIL-F-8785C (sim/world/turbulence.py)."""

    sigma_mps: float
    length_v_m: float
    model: str  # "dryden" or "von-karman"
    band_hz: tuple[float, float] = (LOWEST_HZ, HIGHEST_HZ)  # nothing counts beyond it

    def weights(self, airspeed_mps: float) -> Array:
        """Parts of sigma^2 by frequency, for sums over `frequencies`."""
        x = frequencies()
        time_s = self.length_v_m / airspeed_mps
        p = 2.0 * math.pi * np.exp(x) * time_s * (1.0 if self.model == "dryden" else 1.339)
        shape = (1.0 + 3.0 * p**2) / (1.0 + p**2) ** 2
        if self.model == "von-karman":
            shape = (1.0 + 8.0 / 3.0 * p**2) / (1.0 + p**2) ** (11.0 / 6.0)
        density = self.sigma_mps**2 * time_s / math.pi * shape * 2.0 * math.pi * np.exp(x)
        steps = np.full(len(x), x[1] - x[0])
        steps[[0, -1]] *= 0.5
        inside = (x >= math.log(self.band_hz[0]) - 1e-9) & (x <= math.log(self.band_hz[1]) + 1e-9)
        return np.asarray(density * steps * inside)


@dataclass(frozen=True)
class WindResponse:
    """Of one plant at `frequencies` (F,), without the law: `paths` and `measured` (F, inputs) of its measurements per
    command and per wind, `by_command` and `by_wind` (outputs, F).
    """

    weights: Array
    paths: ComplexArray
    measured: ComplexArray
    by_command: ComplexArray
    by_wind: ComplexArray

    def rms(self, output: int, law: ComplexArray, slopes: ComplexArray | None = None) -> tuple[float, Array]:
        """Of LOAD (Pa deg) or DRIFT (m/s) with C (F, inputs), and its gradient by what `slopes` (F, inputs, n) are."""
        loop, felt = 1.0 + (law * self.paths).sum(axis=1), (law * self.measured).sum(axis=1)
        t = self.by_wind[output] - self.by_command[output] * felt / loop
        value = math.sqrt(float(self.weights @ np.abs(t) ** 2))
        if slopes is None:
            return value, np.zeros(0)
        moved = np.einsum("fi,fin->fn", self.measured, slopes) * loop[:, None]
        moved -= felt[:, None] * np.einsum("fi,fin->fn", self.paths, slopes)
        by = -(self.by_command[output] / loop**2)[:, None] * moved
        return value, np.asarray((self.weights * np.conj(t)) @ by).real / value


Winds = Sequence[WindResponse]
