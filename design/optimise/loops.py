"""The loops of all plants as functions of the variables: L = F (k_p I + k_d) P."""

from __future__ import annotations

import math

import numpy as np

from maxq.control.kernel.records import Array
from maxq.design.model.state_space import ComplexArray
from maxq.design.optimise import features
from maxq.design.optimise.curves import Curves, Indices
from maxq.design.optimise.features import Cross, LogLoop, Places
from maxq.design.optimise.filter_variables import FilterVariables
from maxq.design.optimise.gain_variables import GainVariables

NEWTON_STEPS = 6
SMALL = 1e-8  # of ln f; the third derivatives that this leaves out are 1e7 at most beside a mode of zeta 0.005


class Loops:
    """Curves of the plants with the layout of filter and gains.

    `sample_s` and `prewarp_hz` are those of the discrete filter on a sampled loop, None for a continuous one.
    `unstable_open` (plants,) counts the poles of P in the right half plane (outside the unit circle).
    """

    def __init__(
        self,
        curves: Curves,
        unstable_open: Indices,
        filter_: FilterVariables,
        gains: GainVariables,
        sample_s: float | None = None,
        prewarp_hz: float | None = None,
    ) -> None:
        self.curves, self.filter, self.gains = curves, filter_, gains
        self.sample_s, self.prewarp_hz = sample_s, prewarp_hz
        self.unstable_open = unstable_open
        self._s = self.laplace(curves.x)[0]
        # poles of the loop at s = 0 (z = 1), less zeros there: an integrator behind a differentiator counts 0
        at, after = curves.start[:-1], curves.start[:-1] + 1
        fall = np.log(np.abs(curves.path[at] * curves.integrator[at] / curves.path[after] / curves.integrator[after]))
        self.poles_at_zero: Indices = np.rint(fall / (curves.x[after] - curves.x[at])).astype(np.int64)

    @property
    def size(self) -> int:
        """Number of variables."""
        return self.filter.size + self.gains.size

    def split(self, variables: Array) -> tuple[Array, Array]:
        """Those of the filter, and of the gains."""
        return variables[: self.filter.size], variables[self.filter.size :]

    def laplace(self, x: Array) -> tuple[ComplexArray, ComplexArray, ComplexArray]:
        """s at which the filter's continuous form gives the response at x = ln f; its two derivatives by x.

        A bilinear filter is the continuous one on a warped axis: s = j c tan(pi f T).
        """
        if self.sample_s is None or self.prewarp_hz is None:
            s = 2j * np.pi * np.exp(x)
            return s, s, s
        c = 2.0 * np.pi * self.prewarp_hz / math.tan(math.pi * self.prewarp_hz * self.sample_s)
        angle = np.pi * np.exp(x) * self.sample_s
        tangent = np.tan(angle)
        secant = 1.0 + tangent**2
        rise = c * secant * angle
        bend = rise * (1.0 + 2.0 * tangent * angle)
        return (1j * c * tangent).astype(complex), (1j * rise).astype(complex), (1j * bend).astype(complex)

    def response(self, variables: Array) -> ComplexArray:
        """L on the mesh of all plants."""
        y, u = self.split(variables)
        k_p, k_d = self.gains.at_plants(u)
        plant, curves = self.curves.plant, self.curves
        law = k_p[plant] * curves.integrator + k_d[plant]
        return np.asarray(curves.path * law * self.filter.response(y, self._s))

    def unstable_poles(self, loop: ComplexArray) -> Indices:
        """Closed-loop poles in the right half plane (outside the unit circle), by the argument principle, (plants,).

        1 + L turns by pi (P + n/2 - Z) from zero frequency to the highest, n being the poles of L at s = 0 (z = 1).
        """
        distance = 1.0 + loop
        # the step from each point to the next; where one mesh ends and the next begins it counts for nothing
        step = np.angle(distance[1:] * np.conj(distance[:-1]))
        step[self.curves.start[1:-1] - 1] = 0.0
        turned = np.add.reduceat(np.append(step, 0.0), self.curves.start[:-1])
        poles = self.unstable_open + 0.5 * np.maximum(self.poles_at_zero, 0) - turned / np.pi
        return np.maximum(np.rint(poles), 0.0).astype(np.int64)

    def log_loop(self, y: Array, k_p: Array, k_d: Array, cell: Indices, x: Array) -> LogLoop:
        """At points x of mesh intervals `cell`; `k_p`, `k_d` those of each point's plant, `y` of all or of each."""
        p = self.curves.in_cells(cell, x)
        s, s1, s2 = self.laplace(x)
        f0, f1, f2 = self.filter.slopes(y, s)
        integral = k_p * np.exp(p.log_integrator[0])
        law = integral + k_d
        g = integral / law
        i1, i2 = p.log_integrator[1], p.log_integrator[2]
        return LogLoop(
            p.log_path[0] + f0 + np.log(law),
            p.log_path[1] + f1 * s1 + g * i1,
            p.log_path[2] + f2 * s1 * s1 + f1 * s2 + g * i2 + g * (1.0 - g) * i1 * i1,
            np.asarray(g, np.complex128),
            s,
        )

    def refined(self, y: Array, k_p: Array, k_d: Array, places: Places, cross: Cross) -> tuple[Array, LogLoop]:
        """Newton's method on all features at once; `k_p`, `k_d`, `cross` and perhaps `y` are each feature's own.

        Steps stay near the mesh interval.
        """
        x, cell = places.x, places.cell
        width = self.curves.x[cell + 1] - self.curves.x[cell]
        left, right = self.curves.x[cell] - width, self.curves.x[cell + 1] + width
        for _ in range(NEWTON_STEPS):
            at = self.log_loop(y, k_p, k_d, cell, x)
            residual, slope = features.condition(places.kind, at, cross)
            with np.errstate(divide="ignore", invalid="ignore"):
                change = -residual / slope
            change = np.where(np.isfinite(change) & ~places.fixed, change, 0.0)
            x = np.clip(x + change, left, right)
            if np.abs(change).max(initial=0.0) < SMALL:  # the next change is below rounding: no need to look again
                return x, at.beside(change)
        return x, self.log_loop(y, k_p, k_d, cell, x)

    def own_gradient(self, y: Array, at: LogLoop) -> ComplexArray:
        """d ln L by the filter's variables, ln k_p and ln k_d of the point's own plant: (points, filter + 2)."""
        g = at.proportional[:, None]
        return np.concatenate([self.filter.gradient(y, at.s), g, 1.0 - g], axis=1)
