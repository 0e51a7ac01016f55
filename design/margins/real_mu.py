"""An upper bound of the structured singular value for real parameters.

1 / mu(M) is the least r for which 1 - M D is singular. D is a diagonal of real numbers of magnitude up to r, each
repeated over its number of rows. An upper bound of mu (Fan, Tits & Doyle, IEEE Trans. Autom. Control 36, 1991) is the
square root of the greatest eigenvalue of

    N^H N + j (G N - N^H G),      N = T M T^-1,

with block-diagonal T and G = G^H. Any T and G give an upper bound, and a descent searches for the least.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import scipy  # its submodules are imported at first use

from maxq.control.kernel.records import Array
from maxq.design.margins.multiloop import log_scales
from maxq.design.model.state_space import ComplexArray

_SHARPNESS = (10.0, 30.0, 100.0, 300.0)  # of the smoothed greatest eigenvalue, in the order of the descents
_ROUNDS, _STEPS, _TURN, _GAIN = 12, 60, 1.0, 0.01

Scaling = tuple[ComplexArray, ComplexArray]
"""The scalings T and G, which are zero outside their diagonal blocks."""


def real_mu_upper(
    m: ComplexArray, ranks: Sequence[int], start: Scaling | None = None, enough: float = 0.0
) -> tuple[float, Scaling]:
    """Return an upper bound of mu of `m` (n, n) for real parameters, and the scaling that gives the bound.

    `ranks` contains the number of rows of each parameter. The descent begins with balanced rows and columns, or with
    `start` if that is better, and ends as soon as the bound is at most `enough`.
    """
    owner = np.repeat(np.arange(len(ranks)), ranks)
    inside = owner[:, None] == owner
    balanced = np.diag(np.exp(log_scales(m[None])[0])).astype(np.complex128), np.zeros(m.shape, np.complex128)
    best, scaling = min(((bound(m, s), s) for s in (balanced, start) if s is not None), key=lambda one: one[0])
    for sharpness in _SHARPNESS:
        for _ in range(_ROUNDS):
            if best <= enough or best == 0.0:
                return best, scaling
            found = _descended(m, inside, scaling, best, sharpness)
            before, value = best, bound(m, found)
            if value < best:
                best, scaling = value, found
            if best > before * (1.0 - _GAIN):
                break
    return best, scaling


def bound(m: ComplexArray, scaling: Scaling) -> float:
    """Return the upper bound of mu of `m` for a given scaling."""
    turn, g = scaling
    n = turn @ m @ np.linalg.inv(turn)
    return float(np.sqrt(max(np.linalg.eigvalsh(_form(n, g))[-1], 0.0)))


def _form(n: ComplexArray, g: ComplexArray) -> ComplexArray:
    turned = g @ n
    return np.asarray(n.conj().T @ n + 1j * (turned - turned.conj().T))


def _hermitian(x: Array, inside: Array) -> ComplexArray:
    """Return a Hermitian matrix from numbers: real parts in the lower triangle, imaginary parts in the upper triangle.

    `inside` selects the elements of the diagonal blocks.
    """
    whole = np.zeros(inside.shape)
    whole[inside] = x
    lower, upper = np.tril(whole, -1), np.triu(whole, 1)
    return np.asarray(np.diag(whole.diagonal()) + lower + lower.T + 1j * (upper - upper.T), np.complex128)


def _slopes(q: ComplexArray, inside: Array) -> Array:
    """Return the derivative of Re tr(q H) with respect to the numbers that define H in `_hermitian`."""
    both = (q + q.conj().T).real
    return np.asarray((np.tril(both, -1) + np.diag(q.diagonal().real) + np.triu((q - q.T).imag, 1))[inside])


def _exp(h: ComplexArray) -> tuple[ComplexArray, ComplexArray]:
    sizes, vectors = np.linalg.eigh(h)
    back = vectors.conj().T
    return (vectors * np.exp(sizes)) @ back, (vectors * np.exp(-sizes)) @ back


def descent(
    m: ComplexArray, inside: Array, start: Scaling, value: float, sharpness: float = 30.0
) -> Callable[[Array], tuple[float, Array]]:
    """Return the objective of a descent: the smoothed squared bound divided by `value` squared, and its gradient.

    The argument of the objective contains the exponent of the change of T, and the change of G. `start` is the scaling
    at its zero.
    """
    before, scale, count = start[0] @ m @ np.linalg.inv(start[0]), max(value * value, 1e-12), int(inside.sum())
    sharp = sharpness / scale

    def at(x: Array) -> tuple[float, Array]:
        turn, back = _exp(_hermitian(x[:count], inside))
        g, n = start[1] + scale**0.5 * _hermitian(x[count:], inside), turn @ before @ back
        sizes, vectors = np.linalg.eigh(_form(n, g))
        weight = np.exp(sharp * (sizes - sizes[-1]))
        smooth = sizes[-1] + np.log(weight.sum()) / sharp
        p = (vectors * (weight / weight.sum())) @ vectors.conj().T  # derivative of the smoothed greatest eigenvalue
        by_n = p @ (n.conj().T + 1j * g)  # 2 Re tr(by_n dn) with dn = e n - n e; the derivative of exp is taken at zero
        by_turn, by_g = 2.0 * (n @ by_n - by_n @ n), 2.0 * scale**0.5 * 1j * (n @ p)
        return smooth / scale, np.concatenate([_slopes(by_turn, inside), _slopes(by_g, inside)]) / scale

    return at


def _descended(m: ComplexArray, inside: Array, start: Scaling, value: float, sharpness: float) -> Scaling:
    """Return T and G after a short descent.

    It is short because the gradient with respect to T is exact only at its start.
    """
    count = int(inside.sum())
    found = scipy.optimize.minimize(
        descent(m, inside, start, value, sharpness),
        np.zeros(2 * count),
        jac=True,
        method="L-BFGS-B",
        bounds=[(-_TURN, _TURN)] * count + [(None, None)] * count,
        options={"maxiter": _STEPS},
    )
    turn, _ = _exp(_hermitian(found.x[:count], inside))
    return turn @ start[0], start[1] + value * _hermitian(found.x[count:], inside)
