"""C (s - A)^-1 B at many points s at once, exact at the sharpest resonance."""

from __future__ import annotations

import numpy as np
import scipy.linalg

from maxq.control.kernel.records import Array
from maxq.design.model.state_space import ComplexArray

# Beyond it partial fractions would lose more than half the digits; nearly equal poles do that.
_WORST_BASIS = 1e7


class Resolvent:
    """Partial fractions where A has a usable basis of eigenvectors, else back-substitution in its Schur form.

    `poles` are A's eigenvalues, (n,). Calling it with s (any shape) gives (*s.shape, outputs, inputs).
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
            self._triangle, basis = scipy.linalg.schur(scaled, output="complex")
            self.poles = np.diag(self._triangle).copy()
            self._b, self._c = basis.conj().T @ b, c @ basis

    def __call__(self, s: ComplexArray) -> ComplexArray:
        flat = np.asarray(s, np.complex128).reshape(-1)
        out = self._by_fractions(flat) if self._fractions else self._by_substitution(flat)
        return out.reshape(*np.shape(s), self._outputs, self._inputs)

    def _by_fractions(self, s: ComplexArray) -> ComplexArray:
        # not `@`: for so thin a product the linear-algebra library's threads cost more than they save
        return np.asarray(np.einsum("sp,pk->sk", 1.0 / (s[:, None] - self.poles), self._residues))

    def _by_substitution(self, s: ComplexArray) -> ComplexArray:
        t, n = self._triangle, len(self._triangle)
        x = np.zeros((n, len(s), self._inputs), np.complex128)
        for i in range(n - 1, -1, -1):
            right = self._b[i] + np.tensordot(t[i, i + 1 :], x[i + 1 :], axes=1)
            x[i] = right / (s - t[i, i])[:, None]
        return np.asarray(np.einsum("oi,isj->soj", self._c, x))
