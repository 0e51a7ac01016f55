"""A law on drifts, expressed as a law on the measurements from which navigation derives them: acceleration and angle.

    C_accel = C_v I + C_z I^2,    C_angle = C_angle - a_x C_accel,    I = T z / (z - 1)

for `drift_mps` (v) and `drift_m` (z), with the axial specific force a_x. Analyses that represent sensors only use this
form: loops of all axes together (loop/multiloop.py) and the slopes of a search (verify/worst.py). The loop of a single
plane integrates in its path instead (loop/fixed_path.py), where the integral of a rate of change of the plant adds no
pole.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from maxq.design.laws.law import DRIFTS, Controller
from maxq.design.model.instruments import ACCELERATION
from maxq.design.model.state_space import ComplexArray, StateSpace, chain

ANGLE = "angle_rad"


@dataclass(frozen=True)
class Navigated:
    """A sampled law in series with its navigation (`law.Controller`). `axial_mps2` is the axial specific force."""

    law: Controller
    axial_mps2: float
    sample_s: float

    @property
    def inputs(self) -> tuple[str, ...]:
        kept = tuple(name for name in self.law.inputs if name not in (*DRIFTS, ACCELERATION))
        return (*kept, *([] if ANGLE in kept else [ANGLE]), ACCELERATION)

    @property
    def gains(self) -> Mapping[str, float]:
        return self.law.gains

    def check(self, sample_s: float | None) -> None:
        if sample_s != self.sample_s:
            raise ValueError(f"navigation every {self.sample_s:g} s: the loop's period is {sample_s}")
        self.law.check(sample_s)

    def response(self, frequencies_hz: ArrayLike) -> ComplexArray:
        f = np.asarray(frequencies_hz)
        given = dict(zip(self.law.inputs, np.moveaxis(self.law.response(f), -1, 0), strict=True))
        summed = -self.sample_s / np.expm1(-2j * np.pi * self.sample_s * f)
        none = np.zeros(f.shape, np.complex128)
        across = sum((given.pop(name, none) * summed ** (1 + k) for k, name in enumerate(DRIFTS)), none)
        given[ACCELERATION] = given.get(ACCELERATION, none) + across
        given[ANGLE] = given.get(ANGLE, none) - self.axial_mps2 * across
        return np.stack([given[name] for name in self.inputs], axis=-1)

    def filter_response(self, frequencies_hz: ArrayLike) -> ComplexArray:
        return self.law.filter_response(frequencies_hz)

    def static_gain(self, name: str) -> float:
        return self.law.static_gain(name)

    def poles(self) -> ComplexArray:
        sums = 1 + max(k for k, name in enumerate(DRIFTS) if name in self.law.inputs)
        return np.append(self.law.poles(), np.zeros(sums, np.complex128))

    def state_space(self) -> StateSpace:
        wanted, t, inputs = self.law.inputs, self.sample_s, self.inputs
        sums = 1 + max(k for k, name in enumerate(DRIFTS) if name in wanted)
        across = np.array([{ACCELERATION: 1.0, ANGLE: -self.axial_mps2}.get(name, 0.0) for name in inputs])
        # drift velocity and displacement include the increment of the present sample
        a, through = np.array([[1.0, 0.0], [t, 1.0]])[:sums, :sums], np.array([t, t * t])[:sums]
        c, d = np.zeros((len(wanted), sums)), np.zeros((len(wanted), len(inputs)))
        for row, name in enumerate(wanted):
            if name in DRIFTS:
                k = DRIFTS.index(name)
                c[row], d[row] = a[k], through[k] * across
            else:
                d[row, inputs.index(name)] = 1.0
        navigation = StateSpace(a, np.outer(through, across), c, d, DRIFTS[:sums], inputs, wanted)
        return chain(navigation, self.law.state_space())

    def scaled(self, factor: float) -> Navigated:
        return Navigated(self.law.scaled(factor), self.axial_mps2, self.sample_s)


def navigated(law: Controller, axial_mps2: float, sample_s: float) -> Controller:
    """Return a sampled law with sensor measurements as its inputs. A law that uses no drift is returned unchanged."""
    return Navigated(law, axial_mps2, sample_s) if any(name in DRIFTS for name in law.inputs) else law
