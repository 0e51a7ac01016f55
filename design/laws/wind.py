"""The response of the closed loop to wind: root mean squares of load and drift under a spectrum, and their gradients.

    T = G_w - G_u (sum of C_i M_i) / (1 + L),    rms^2 = integral of |T|^2 S df

from the lateral wind to an output, with the law's measurements M_i per wind, the output G_u per command and G_w per
wind. Load is dynamic pressure times angle of attack (relative to the air at the core's CG). Drift is the lateral
velocity across the undisturbed path, w - U theta. The bending moment is that of model/sections.py at each of the
required stations. The frequencies are those of the spectrum's band. The computer is included as in the loop; the wind's
images beyond its Nyquist frequency are not. An unstable loop has no rms; the optimiser checks stability.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from maxq.control.kernel.records import Array
from maxq.design.model.state_space import ComplexArray
from maxq.design.quantities import QUANTITIES, Quantity

LOWEST_HZ, HIGHEST_HZ, POINTS = 0.02, 5.0, 96
FINE = 0.004  # step of ln f above it, at bending modes: 8e-4 of the mean square at a damping ratio of 0.005
LOAD, DRIFT, MOMENTS = 0, 1, 2  # outputs: moments have this index and those after it
Key = str | float
"""The key of a quantity: the name of its limit, or the station of a bending moment."""
WIND_LIMITS = ("q_alpha_Padeg", "drift_mps")


def quantity(key: Key) -> Quantity:
    """Return the quantity of a key. The quantity of a station's bending moment has the station in its names."""
    if isinstance(key, str):
        return QUANTITIES[key]
    moment = QUANTITIES["bending_moment"]
    label = moment.label.replace("moment", f"moment at {key:g} m")
    return replace(moment, label=label, heading=f"{moment.heading} {key:g} m")


@dataclass(frozen=True)
class Spectrum:
    """The lateral spectrum of MIL-F-8785C (sim/world/turbulence.py)."""

    sigma_mps: float
    length_v_m: float
    model: str  # "dryden" or "von-karman"
    band_hz: tuple[float, float] = (LOWEST_HZ, HIGHEST_HZ)  # nothing counts beyond it

    def frequencies(self) -> Array:
        """Return x = ln f of the integral."""
        x, top = np.linspace(math.log(LOWEST_HZ), math.log(HIGHEST_HZ), POINTS), math.log(self.band_hz[1])
        return x if top <= x[-1] else np.append(x, np.linspace(x[-1], top, math.ceil((top - x[-1]) / FINE) + 1)[1:])

    def weights(self, airspeed_mps: float) -> Array:
        """Return the parts of sigma^2 by frequency, for sums over `frequencies`."""
        x = self.frequencies()
        time_s = self.length_v_m / airspeed_mps
        p = 2.0 * math.pi * np.exp(x) * time_s * (1.0 if self.model == "dryden" else 1.339)
        shape = (1.0 + 3.0 * p**2) / (1.0 + p**2) ** 2
        if self.model == "von-karman":
            shape = (1.0 + 8.0 / 3.0 * p**2) / (1.0 + p**2) ** (11.0 / 6.0)
        density = self.sigma_mps**2 * time_s / math.pi * shape * 2.0 * math.pi * np.exp(x)
        steps = 0.5 * (np.diff(x, append=x[-1]) + np.diff(x, prepend=x[0]))
        inside = (x >= math.log(self.band_hz[0]) - 1e-9) & (x <= math.log(self.band_hz[1]) + 1e-9)
        return np.asarray(density * steps * inside)


@dataclass(frozen=True)
class WindResponse:
    """The wind response of a plant at x = ln f (F,), without the law.

    `paths` and `measured` (F, inputs) are those of its measurements per command and per wind. `by_command` and
    `by_wind` (outputs, F) are those of load, drift, and moments at `stations_m`.
    """

    x: Array
    stations_m: tuple[float, ...]
    weights: Array
    paths: ComplexArray
    measured: ComplexArray
    by_command: ComplexArray
    by_wind: ComplexArray

    def output(self, key: Key) -> int:
        """Return the number of a quantity among the outputs."""
        return list(WIND_LIMITS).index(key) if isinstance(key, str) else MOMENTS + self.stations_m.index(key)

    def rms(self, outputs: Sequence[int], law: ComplexArray, slopes: ComplexArray) -> tuple[Array, Array]:
        """Return LOAD (Pa deg), DRIFT (m/s) and MOMENTS (N m) with C (F, inputs), (outputs,), and their gradients.

        The gradients (outputs, n) are those for the derivatives `slopes` (F, inputs, n) of C; n = 0 for none.
        """
        loop, sensed = 1.0 + (law * self.paths).sum(axis=1), (law * self.measured).sum(axis=1)
        by_command = self.by_command[list(outputs)]
        t = self.by_wind[list(outputs)] - by_command * sensed / loop
        value = np.sqrt(np.abs(t) ** 2 @ self.weights)
        moved = np.einsum("fi,fin->fn", self.measured, slopes) * loop[:, None]
        moved -= sensed[:, None] * np.einsum("fi,fin->fn", self.paths, slopes)
        by = -(self.weights * np.conj(t) * by_command / loop**2) @ moved
        return value, by.real / value[:, None]


Winds = Sequence[WindResponse]
