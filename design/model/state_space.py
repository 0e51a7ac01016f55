"""A linear time-invariant system with named states, inputs and outputs."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from maxq.control.kernel.records import Array

ComplexArray = NDArray[np.complex128]


@dataclass(frozen=True)
class StateSpace:
    """x' = A x + B u, y = C x + D u."""

    a: Array  # (n, n)
    b: Array  # (n, inputs)
    c: Array  # (outputs, n)
    d: Array  # (outputs, inputs)
    states: tuple[str, ...]
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]

    def __post_init__(self) -> None:
        n, m, p = len(self.states), len(self.inputs), len(self.outputs)
        shapes = (self.a.shape, self.b.shape, self.c.shape, self.d.shape)
        if shapes != ((n, n), (n, m), (p, n), (p, m)):
            raise ValueError(f"matrices {shapes} do not fit {n} states, {m} inputs and {p} outputs")

    def poles(self) -> ComplexArray:
        """Eigenvalues, rad/s, in rising order of magnitude."""
        values = np.linalg.eigvals(self.a).astype(np.complex128)
        return values[np.argsort(np.abs(values))]

    def response(self, frequencies_hz: ArrayLike) -> ComplexArray:
        """Frequency response (frequencies, outputs, inputs)."""
        eye = np.eye(len(self.states))
        omega = 2.0 * np.pi * np.atleast_1d(np.asarray(frequencies_hz, float))
        return np.array([self.c @ np.linalg.solve(1j * w * eye - self.a, self.b) + self.d for w in omega])

    def channel(self, output: str, source: str, frequencies_hz: ArrayLike) -> ComplexArray:
        """Frequency response (frequencies,) from one input to one output, by name."""
        i, j = self.outputs.index(output), self.inputs.index(source)
        return np.asarray(self.response(frequencies_hz)[:, i, j])
