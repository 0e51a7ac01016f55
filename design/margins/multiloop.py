"""The margins of several loops: of each loop with the others closed, and the disk margin of all loops together.

The disk margin of several loops is defined by Seiler, Packard & Gahinet, An Introduction to Disk Margins, IEEE CSM
40(5), 2020. It is the largest alpha for which the loops remain stable while each command is multiplied by its own
factor,

    f_i = (1 + d_i / 2) / (1 - d_i / 2),   |d_i| < alpha,   alpha = 1 / (largest mu(S - 1/2) over frequency)

with S = (1 + L)^-1, and mu the structured singular value for complex d_i on the diagonal. The upper bound of mu is the
least of the greatest singular value of D (S - 1/2) D^-1 over diagonal D. For up to three loops, mu equals this bound
(Packard & Doyle, Automatica 29(1), 1993). If the law treats each axis separately, the margin at its measurements is the
same, since the law itself is such a D.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import scipy  # its submodules are imported at first use

from maxq.control.kernel.records import Array
from maxq.design.loop.multiloop import Multiloop
from maxq.design.margins.curve import ASYMPTOTIC
from maxq.design.margins.distances import Disk, symmetric_disk
from maxq.design.margins.measure import Margins, margins
from maxq.design.margins.packed import matrix_response
from maxq.design.model.state_space import ComplexArray

Response = Callable[[Array], ComplexArray]
LOWEST_HZ = 1e-3  # slower motion is outside the model, which holds gravity, position and speed, and its roots are drift
_BEGINS = LOWEST_HZ * np.array([1.0, 2.0, 0.5, 4.0, 0.25])
_CLOSE = 1e-9  # relative tolerance of mu


@dataclass(frozen=True)
class MultiloopMargins:
    """The margins of each axis with the other loops closed, in the order of `axes`, and the disk margin of all loops.

    All margins of an unstable loop are NaN.
    """

    time_s: float
    axes: tuple[str, ...]
    each: tuple[Margins, ...]
    disk: Disk

    @property
    def stable(self) -> bool:
        return all(m.stable for m in self.each)


def multiloop_margins(loop: Multiloop) -> MultiloopMargins:
    """Return the margins of several loops.

    The search for the disk margin uses the frequencies of the single loops' curves, and refines the result between
    them.
    """
    single = [loop.one(axis) for axis in loop.axes]
    each = tuple(margins(one, zones=(), lowest_hz=_begin_hz(one.open_poles())) for one in single)
    size, frequency_hz = np.nan, np.nan
    if all(m.stable for m in each):
        size, frequency_hz = _least_disk(loop, np.unique(np.concatenate([m.curve.frequency_hz for m in each])))
    return MultiloopMargins(loop.time_s, loop.axes, each, symmetric_disk(size, frequency_hz))


def _begin_hz(open_poles: ComplexArray) -> float:
    """Return a frequency near LOWEST_HZ at a distance from slow roots.

    A curve that begins at a slow root makes half a turn about -1.
    """
    roots = np.abs(open_poles[np.isfinite(open_poles) & (open_poles != 0.0)]) / (2.0 * np.pi)
    apart = [np.abs(np.log(roots / hz)).min(initial=np.inf) for hz in _BEGINS]
    clear = (k for k, least in enumerate(apart) if least >= np.log(ASYMPTOTIC))
    return float(_BEGINS[next(clear, int(np.argmax(apart)))])


def _least_disk(loop: Multiloop, frequencies_hz: Array) -> tuple[float, float]:
    """Return alpha / 2 and its frequency in Hz, by a search between the frequencies next to that of the greatest mu."""
    response = matrix_response(loop)
    best, hz, low, high = _greatest(response, frequencies_hz)
    if len(loop.axes) < 3:  # the bound is mu, and that of all points takes little longer than that of one
        while high - low > _CLOSE * high:
            found, at_hz, low, high = _greatest(response, np.linspace(low, high, 17))
            best, hz = max((best, hz), (found, at_hz))
        return 0.5 / best, hz
    near = scipy.optimize.minimize_scalar(
        lambda f: -structured_singular_value(_half(response, np.array([f]))[0]),
        bounds=(low, high),
        method="bounded",
        options={"xatol": _CLOSE * high},
    )
    return (0.5 / -near.fun, float(near.x)) if -near.fun > best else (0.5 / best, hz)


def _greatest(response: Response, frequencies_hz: Array) -> tuple[float, float, float, float]:
    """Return the greatest mu, its frequency, and the frequencies next to it.

    The exact mu is computed only where its bound by balancing exceeds the greatest value found so far.
    """
    matrices = _half(response, frequencies_hz)
    d = np.exp(log_scales(matrices))
    bounds = np.linalg.norm(matrices * (d[:, :, None] / d[:, None, :]), 2, axis=(1, 2))
    best, at = 0.0, 0
    for k in np.argsort(-bounds):
        if bounds[k] <= best:
            break
        found = structured_singular_value(matrices[k])
        best, at = max((best, at), (found, int(k)))
    low, high = frequencies_hz[max(at - 1, 0)], frequencies_hz[min(at + 1, len(frequencies_hz) - 1)]
    return best, float(frequencies_hz[at]), float(low), float(high)


def _half(response: Response, frequencies_hz: Array) -> ComplexArray:
    whole = response(frequencies_hz)
    eye = np.eye(whole.shape[-1])
    return np.asarray(np.linalg.inv(eye + whole) - 0.5 * eye)


def structured_singular_value(matrix: ComplexArray) -> float:
    """Return an upper bound of mu for complex scalars on the diagonal, to a relative accuracy of 1e-9.

    For at most three scalars, the bound equals mu.
    """
    scales = log_scales(matrix[None])[0]

    def size(x: Array) -> float:
        d = np.exp(np.append(0.0, x))
        return float(
            np.linalg.svd(matrix * (d[:, None] / d), compute_uv=False)[0]
        )  # np.linalg.norm takes twice as long

    best = size(scales[1:] - scales[0])
    if len(matrix) > 2:  # for two loops, balancing gives the exact minimum
        start = scales[1:] - scales[0]
        for _ in range(3):  # the function is convex, with kinks where singular values coincide
            found = scipy.optimize.minimize(size, start, method="Nelder-Mead", options={"xatol": 1e-7, "fatol": 0.0})
            if found.fun > best * (1.0 - _CLOSE):
                break
            best, start = float(found.fun), found.x
    return best


def log_scales(matrices: ComplexArray) -> Array:
    """Return ln of the diagonal D that balances rows with columns (Osborne, J. ACM 7, 1960), (matrices, n)."""
    n = matrices.shape[-1]
    square, out = np.abs(matrices) ** 2 * (1.0 - np.eye(n)), np.zeros(matrices.shape[:2])
    floor = 1e-24 * (np.abs(matrices) ** 2).max(
        axis=(1, 2)
    )  # keeps the scale finite for a loop that is not coupled to others
    for _ in range(1 if n < 3 else 30):
        for i in range(n):
            weight = np.exp(2.0 * (out[:, :, None] - out[:, None, :]))
            row, column = (square * weight)[:, i, :].sum(axis=1), (square * weight)[:, :, i].sum(axis=1)
            out[:, i] += 0.25 * np.log((column + floor) / (row + floor))
    return out
