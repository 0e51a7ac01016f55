"""Linear time-invariant systems with named states, inputs and outputs: connection, reduction and frequency response."""

from __future__ import annotations

from dataclasses import dataclass
from functools import reduce

import numpy as np
import scipy.linalg
from numpy.typing import ArrayLike, NDArray

from maxq.control.kernel.records import Array

ComplexArray = NDArray[np.complex128]


@dataclass(frozen=True)
class StateSpace:
    """The linear system x' = A x + B u, y = C x + D u."""

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
        """Return the eigenvalues of A, rad/s, in rising order of magnitude."""
        values = np.linalg.eigvals(self.a).astype(np.complex128)
        return values[np.argsort(np.abs(values))]

    def response(self, frequencies_hz: ArrayLike) -> ComplexArray:
        """Return the frequency response (frequencies, outputs, inputs)."""
        eye = np.eye(len(self.states))
        omega = 2.0 * np.pi * np.atleast_1d(np.asarray(frequencies_hz, float))
        return np.array([self.c @ np.linalg.solve(1j * w * eye - self.a, self.b) + self.d for w in omega])

    def channel(self, output: str, source: str, frequencies_hz: ArrayLike) -> ComplexArray:
        """Return the frequency response (frequencies,) from a named input to a named output."""
        i, j = self.outputs.index(output), self.inputs.index(source)
        return np.asarray(self.response(frequencies_hz)[:, i, j])


def series(first: StateSpace, second: StateSpace) -> StateSpace:
    """Return `second` driven by all outputs of `first`. Both are continuous, or sampled with the same period."""
    n, m = len(first.states), len(second.states)
    a = np.zeros((n + m, n + m))
    a[:n, :n], a[n:, n:] = first.a, second.a
    a[n:, :n] = second.b @ first.c
    return StateSpace(
        a,
        np.concatenate([first.b, second.b @ first.d]),
        np.concatenate([second.d @ first.c, second.c], axis=1),
        second.d @ first.d,
        (*first.states, *second.states),
        first.inputs,
        second.outputs,
    )


def chain(*systems: StateSpace) -> StateSpace:
    """Return the systems connected in series, in the order of the arguments."""
    return reduce(series, systems)


def zeros_and_poles(system: StateSpace) -> tuple[ComplexArray, ComplexArray]:
    """Return the zeros and poles of a system with one input and one output.

    The zeros are generalised eigenvalues of the system matrix (Emami-Naeini & Van Dooren, Automatica 18(4), 1982), and
    the poles are eigenvalues of A.
    """
    a, (scale, _) = scipy.linalg.matrix_balance(system.a, permute=False, separate=True)
    b, c, n = system.b[:, 0] / scale, system.c[0] * scale, len(system.a)
    left, right = np.zeros((n + 1, n + 1)), np.diag(np.append(np.ones(n), 0.0))
    left[:n, :n], left[n, n] = a, system.d[0, 0]
    size = np.abs(a).max(initial=1e-300)
    left[:n, n], left[n, :n] = b * (size / np.abs(b).max()), c * (size / np.abs(c).max())
    left[n, n] *= size / np.abs(b).max() * size / np.abs(c).max()
    top, below = scipy.linalg.eigvals(left, right, homogeneous_eigvals=True)
    finite = np.abs(below) > 1e-13 * np.abs(top)
    return np.asarray(top[finite] / below[finite]), np.linalg.eigvals(a).astype(np.complex128)


def channels(system: StateSpace, outputs: tuple[str, ...], inputs: tuple[str, ...] | None = None) -> StateSpace:
    """Return the system with some of its outputs and inputs, reduced to the states on a path between them.

    Structurally uncontrollable and unobservable states are removed. In vacuum, for example, lateral drift does not
    affect the rotation, and its poles at zero do not belong to the loop.
    """
    i = [system.outputs.index(name) for name in outputs]
    j = [system.inputs.index(name) for name in (system.inputs if inputs is None else inputs)]
    b, c, d = system.b[:, j], system.c[i], system.d[np.ix_(i, j)]
    reached = _connected(system.a != 0.0, (b != 0.0).any(axis=1))
    seen = _connected((system.a != 0.0).T, (c != 0.0).any(axis=0))
    keep = np.flatnonzero(reached & seen)
    return StateSpace(
        system.a[np.ix_(keep, keep)],
        b[keep],
        c[:, keep],
        d,
        tuple(system.states[k] for k in keep),
        tuple(system.inputs[k] for k in j),
        outputs,
    )


def _connected(entries: np.ndarray, start: np.ndarray) -> np.ndarray:
    """Return True for the states that are reachable from `start`. `entries[i, k]` is True if state k acts on i."""
    found = start.copy()
    for _ in range(len(start)):
        grown = found | (entries & found).any(axis=1)
        if (grown == found).all():
            break
        found = grown
    return found


_WORST_BASIS = 1e7  # condition number above which partial fractions lose half the digits, as for nearly equal poles


class Resolvent:
    """The function C (s - A)^-1 B for arrays of s, accurate even at the sharpest resonance.

    Partial fractions are used if A has a well-conditioned basis of eigenvectors. Otherwise a linear system is solved at
    each point. `poles` are the eigenvalues of A, (n,). A call with s of any shape returns (*s.shape, outputs, inputs).
    """

    def __init__(self, a: Array, b: Array, c: Array) -> None:
        scaled, (scale, _) = scipy.linalg.matrix_balance(a, permute=False, separate=True)
        b, c = b / scale[:, None], c * scale
        self._outputs, self._inputs = len(c), b.shape[1]
        poles, vectors = np.linalg.eig(scaled) if len(a) else (np.zeros(0), np.zeros((0, 0)))
        self.poles: ComplexArray = poles.astype(np.complex128)
        self._fractions = len(a) == 0 or np.linalg.cond(vectors) < _WORST_BASIS
        if self._fractions:
            per_pole = np.linalg.solve(vectors, b) if len(a) else b
            self._residues = np.einsum("oi,ij->ioj", c @ vectors, per_pole).reshape(len(a), -1).astype(np.complex128)
        else:
            self._system = scaled, b, c

    def __call__(self, s: ComplexArray) -> ComplexArray:
        flat = np.asarray(s, np.complex128).reshape(-1)
        if self._fractions:
            # `@` is slower for such a thin product, because the library starts its threads
            out = np.einsum("sp,pk->sk", 1.0 / (flat[:, None] - self.poles), self._residues)
        else:
            a, b, c = self._system
            out = c @ np.linalg.solve(flat[:, None, None] * np.eye(len(a)) - a, b)
        return np.asarray(out.reshape(*np.shape(s), self._outputs, self._inputs))
