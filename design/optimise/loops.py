"""The loops of all plants as functions of the law's variables: L = P times the sum of C_i over its measurements."""

from __future__ import annotations

import numpy as np

from maxq.control.kernel.records import Array
from maxq.design.laws.law import LawVariables
from maxq.design.model.state_space import ComplexArray
from maxq.design.optimise import features
from maxq.design.optimise.curves import CurveIndices, Curves
from maxq.design.optimise.features import Cross, LogLoop, MeshPlaces

NEWTON_STEPS = 6
SMALL = 1e-8  # step of ln f; the neglected third derivatives are at most 1e7 near a mode with a damping ratio of 0.005


class Loops:
    """The open loops of all plants as functions of the variables of a control law.

    `unstable_open` (plants,) is the number of poles of P in the right half plane (outside the unit circle).
    """

    def __init__(self, curves: Curves, unstable_open: CurveIndices, law: LawVariables) -> None:
        self.curves, self.law, self.unstable_open = curves, law, unstable_open
        self._axis = law.axis(curves.x)
        # poles minus zeros of the loop at s = 0 (z = 1), so that an integrator after a differentiator counts as 0
        at, after = curves.start[:-1], curves.start[:-1] + 1
        width = curves.x[after] - curves.x[at]
        rises = [curves.path * curves.ratio[name] if name in curves.ratio else curves.path for name in law.inputs]
        falls = [np.rint(np.log(np.abs(p[at] / p[after])) / width) for p in rises]
        self.poles_at_zero: CurveIndices = np.max(falls, axis=0).astype(np.int64) + law.poles_at_zero

    def response(self, variables: Array) -> ComplexArray:
        """Return L on the mesh of all plants."""
        curves = self.curves
        common, gains = self.law.response(variables, curves.plant, self._axis)
        law = sum(
            (gains[:, i] * curves.ratio.get(name, 1.0) for i, name in enumerate(self.law.inputs)),
            np.zeros(len(common), np.complex128),
        )
        return np.asarray(curves.path * law * common)

    def unstable_poles(self, loop: ComplexArray) -> CurveIndices:
        """Return the number of closed-loop poles in the right half plane (outside the unit circle), (plants,).

        By the argument principle, 1 + L turns by pi (P + n/2 - Z) from the lowest to the highest frequency, where n is
        the number of poles of L at s = 0 (z = 1).
        """
        distance = 1.0 + loop
        # turn between consecutive points, without the steps from one plant's mesh to the next
        step = np.angle(distance[1:] * np.conj(distance[:-1]))
        step[self.curves.start[1:-1] - 1] = 0.0
        turned = np.add.reduceat(np.append(step, 0.0), self.curves.start[:-1])
        # for n < 0 and large L, 1 + L has zeros below the lowest frequency, which are drift and do not count
        large = np.abs(loop[self.curves.start[:-1]]) > 1.0
        at_zero = np.where(large, self.poles_at_zero, np.maximum(self.poles_at_zero, 0))
        poles = self.unstable_open + 0.5 * at_zero - turned / np.pi
        return np.maximum(np.rint(poles), 0.0).astype(np.int64)

    def log_loop(self, own: Array, cell: CurveIndices, x: Array) -> LogLoop:
        """Return ln L at points `x` in the mesh intervals `cell`.

        `own` (points, own) contains the own parameters at the plant of each point.
        """
        p = self.curves.in_cells(cell, x)
        axis = self.law.axis(x)
        law = self.law.log_response(own, axis)
        ratios = np.ones((len(x), len(self.law.inputs)), np.complex128)
        total, slope, bend = np.zeros((3, len(x)), np.complex128)
        for i, name in enumerate(self.law.inputs):
            gain_1, gain_2 = (None if part is None else part[:, i] for part in law.gains[1:])
            log = p.log_ratio[name]
            if log is not None:
                ratios[:, i] = np.exp(log[0])
            here = law.gains[0][:, i] * ratios[:, i]
            total += here
            if log is not None:
                slope += here * log[1]
                bend += here * (log[2] + log[1] * log[1])
            if gain_1 is not None and gain_2 is not None:
                slope += gain_1 * ratios[:, i]
                bend += gain_2 * ratios[:, i]
                if log is not None:
                    bend += 2.0 * gain_1 * ratios[:, i] * log[1]
        slope, bend = slope / total, bend / total
        return LogLoop(
            p.log_path[0] + law.common[0] + np.log(total),
            p.log_path[1] + law.common[1] + slope,
            p.log_path[2] + law.common[2] + bend - slope * slope,
            ratios / total[:, None],
            own,
            axis,
            np.stack(p.log_path),
        )

    def refined(self, own: Array, places: MeshPlaces, cross: Cross) -> tuple[Array, LogLoop]:
        """Refine all features simultaneously by Newton's method, and return their x = ln f and ln L.

        `own` and `cross` are those of each feature. Steps remain near the mesh interval.
        """
        x, cell = places.x, places.cell
        width = self.curves.x[cell + 1] - self.curves.x[cell]
        left, right = self.curves.x[cell] - width, self.curves.x[cell + 1] + width
        for _ in range(NEWTON_STEPS):
            at = self.log_loop(own, cell, x)
            residual, slope = features.condition(places.kind, at, cross, places.tilt)
            with np.errstate(divide="ignore", invalid="ignore"):
                change = -residual / slope
            change = np.where(np.isfinite(change) & ~places.fixed, change, 0.0)
            x = np.clip(x + change, left, right)
            if np.abs(change).max(initial=0.0) < SMALL:  # the next step is below the rounding error
                return x, at.beside(change)
        return x, self.log_loop(own, cell, x)

    def own_gradient(self, at: LogLoop) -> ComplexArray:
        """Return the gradient of ln L with respect to the own parameters of the point's plant, (points, own)."""
        return self.law.gradient(at.own, at.axis, at.weights)
