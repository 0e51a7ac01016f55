"""The response of the closed loop to wind: rms load, drift and bending moments, and their gradients.

    T = G_w - G_u (sum of C_i M_i) / (1 + L),    rms^2 = integral of |T|^2 S df

T is the transfer function from the lateral wind to an output. M_i are the law's measurements per unit of wind, and G_u
and G_w the output per unit of command and of wind. The outputs are:

- load: dynamic pressure times angle of attack, relative to the air at the core's CG
- drift: the lateral velocity across the undisturbed path, w - U theta
- bending moment: the moment of the linear model (model/held.py) at each required station

The integral covers the band of the spectrum. The flight computer is included as in the loop; images of the wind beyond
the Nyquist frequency are neglected. An unstable loop has no rms value, so the optimiser checks stability separately.
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
FINE = 0.004  # step of ln f above HIGHEST_HZ; error of 8e-4 of the mean square for a damping ratio of 0.005
LOAD, DRIFT, MOMENTS = 0, 1, 2  # indices of the outputs; the moments begin at the last
Key = str | float
"""The key of a quantity: the name of its limit, or the station of a bending moment in m."""
WIND_LIMITS = ("q_alpha_Padeg", "drift_mps")


def quantity(key: Key) -> Quantity:
    """Return the quantity of a key. The label and heading of a bending moment include its station."""
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
    band_hz: tuple[float, float] = (LOWEST_HZ, HIGHEST_HZ)  # frequencies outside the band are excluded

    def frequencies(self) -> Array:
        """Return the integration points x = ln f."""
        x, top = np.linspace(math.log(LOWEST_HZ), math.log(HIGHEST_HZ), POINTS), math.log(self.band_hz[1])
        return x if top <= x[-1] else np.append(x, np.linspace(x[-1], top, math.ceil((top - x[-1]) / FINE) + 1)[1:])

    def weights(self, airspeed_mps: float) -> Array:
        """Return the contribution of each point of `frequencies` to sigma^2, (m/s)^2."""
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

    `paths` and `measured` (F, inputs) are its measurements per unit of command and of wind. `by_command` and `by_wind`
    (outputs, F) are load, drift and the moments at `stations_m`, per unit of command and of wind. `weights` (F,) are
    those of the spectrum.
    """

    x: Array
    stations_m: tuple[float, ...]
    weights: Array
    paths: ComplexArray
    measured: ComplexArray
    by_command: ComplexArray
    by_wind: ComplexArray

    def output(self, key: Key) -> int:
        """Return the index of a quantity among the outputs."""
        return list(WIND_LIMITS).index(key) if isinstance(key, str) else MOMENTS + self.stations_m.index(key)

    def rms(self, outputs: Sequence[int], law: ComplexArray, slopes: ComplexArray) -> tuple[Array, Array]:
        """Return the rms values of the outputs, (outputs,), and their gradients, (outputs, n).

        `law` is C (F, inputs). Loads are in Pa deg, drift in m/s and moments in N m. `slopes` (F, inputs, n) are the
        derivatives of C; n = 0 gives no gradients.
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
