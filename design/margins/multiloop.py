"""The margins of several loops: each with the others closed, and the disk margin of the whole.

The disk margin of several loops is that of Seiler, Packard & Gahinet, An Introduction to Disk Margins, IEEE CSM 40(5),
2020. It is the largest alpha for which the loops stay stable while each command is multiplied by its own factor,

    f_i = (1 + d_i / 2) / (1 - d_i / 2),   |d_i| < alpha,   alpha = 1 / (largest mu(S - 1/2) over frequency)

with S = (1 + L)^-1 and mu the structured singular value for complex d_i on the diagonal. The upper bound of mu is the
least of the greatest singular value of D (S - 1/2) D^-1 over diagonal D. For up to three loops, mu equals this bound
(Packard & Doyle, Automatica 29(1), 1993). A law that treats each axis separately has the same margin at its
measurements, because the law itself is such a D.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy  # its submodules are imported at first use

from maxq.control.kernel.records import Array
from maxq.design.loop.multiloop import Multiloop
from maxq.design.margins.curve import ASYMPTOTIC
from maxq.design.margins.distances import Disk, symmetric_disk
from maxq.design.margins.measure import Margins, margins
from maxq.design.model.state_space import ComplexArray

LOWEST_HZ = 1e-3  # slower than any flight: gravity, position and speed are held there, and roots are drift
_BEGINS = LOWEST_HZ * np.array([1.0, 2.0, 0.5, 4.0, 0.25])
_CLOSE = 1e-9  # relative, of mu


@dataclass(frozen=True)
class MultiloopMargins:
    """The margins of each axis with the others closed, in the order of `axes`, and the disk of all.

    They are NaN for an unstable loop.
    """

    time_s: float
    axes: tuple[str, ...]
    each: tuple[Margins, ...]
    disk: Disk

    @property
    def stable(self) -> bool:
        return all(m.stable for m in self.each)


def multiloop_margins(loop: Multiloop) -> MultiloopMargins:
    """Return the margins.

    The disk is searched for where any of the single loops turns, and between these frequencies.
    """
    single = [loop.one(axis) for axis in loop.axes]
    each = tuple(margins(one, zones=(), lowest_hz=_begin_hz(one.open_poles())) for one in single)
    size, frequency_hz = np.nan, np.nan
    if all(m.stable for m in each):
        size, frequency_hz = _least_disk(loop, np.unique(np.concatenate([m.curve.frequency_hz for m in each])))
    return MultiloopMargins(loop.time_s, loop.axes, each, symmetric_disk(size, frequency_hz))


def _begin_hz(open_poles: ComplexArray) -> float:
    """Return a frequency near LOWEST_HZ and apart from slow roots.

    A curve that begins at a slow root makes half a turn about -1.
    """
    roots = np.abs(open_poles[np.isfinite(open_poles) & (open_poles != 0.0)]) / (2.0 * np.pi)
    apart = [np.abs(np.log(roots / hz)).min(initial=np.inf) for hz in _BEGINS]
    clear = (k for k, least in enumerate(apart) if least >= np.log(ASYMPTOTIC))
    return float(_BEGINS[next(clear, int(np.argmax(apart)))])


def _least_disk(loop: Multiloop, frequencies_hz: Array) -> tuple[float, float]:
    """Return alpha / 2 and its frequency, by a search between the frequencies next to that of the greatest mu."""
    best, hz, low, high = _greatest(loop, frequencies_hz)
    if len(loop.axes) < 3:  # the bound is mu, and that of all points takes little longer than that of one
        while high - low > _CLOSE * high:
            found, at_hz, low, high = _greatest(loop, np.linspace(low, high, 17))
            best, hz = max((best, hz), (found, at_hz))
        return 0.5 / best, hz
    near = scipy.optimize.minimize_scalar(
        lambda f: -structured_singular_value(_half(loop, np.array([f]))[0]),
        bounds=(low, high),
        method="bounded",
        options={"xatol": _CLOSE * high},
    )
    return (0.5 / -near.fun, float(near.x)) if -near.fun > best else (0.5 / best, hz)


def _greatest(loop: Multiloop, frequencies_hz: Array) -> tuple[float, float, float, float]:
    """Return the greatest mu, its frequency, and the frequencies next to it.

    mu is computed only where its bound by balancing is not below the greatest value found.
    """
    matrices = _half(loop, frequencies_hz)
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


def _half(loop: Multiloop, frequencies_hz: Array) -> ComplexArray:
    eye = np.eye(len(loop.axes))
    return np.asarray(np.linalg.inv(eye + loop.response(frequencies_hz)) - 0.5 * eye)


def structured_singular_value(matrix: ComplexArray) -> float:
    """Return an upper bound of mu for complex scalars on the diagonal, with a relative accuracy of 1e-9.

    For at most three scalars, the bound equals mu.
    """
    scales = log_scales(matrix[None])[0]

    def size(x: Array) -> float:
        d = np.exp(np.append(0.0, x))
        return float(np.linalg.svd(matrix * (d[:, None] / d), compute_uv=False)[0])  # norm takes twice as long

    best = size(scales[1:] - scales[0])
    if len(matrix) > 2:  # two are balanced at the least of their greatest singular value
        start = scales[1:] - scales[0]
        for _ in range(3):  # convex, with kinks where singular values meet
            found = scipy.optimize.minimize(size, start, method="Nelder-Mead", options={"xatol": 1e-7, "fatol": 0.0})
            if found.fun > best * (1.0 - _CLOSE):
                break
            best, start = float(found.fun), found.x
    return best


def log_scales(matrices: ComplexArray) -> Array:
    """Return the logarithm of the D that balances rows with columns (Osborne, J. ACM 7, 1960), (matrices, n): the
    better of two.
    """
    n = matrices.shape[-1]
    square, out = np.abs(matrices) ** 2 * (1.0 - np.eye(n)), np.zeros(matrices.shape[:2])
    floor = 1e-24 * (np.abs(matrices) ** 2).max(axis=(1, 2))  # a loop that no other loop acts on has no scale
    for _ in range(1 if n < 3 else 30):
        for i in range(n):
            weight = np.exp(2.0 * (out[:, :, None] - out[:, None, :]))
            row, column = (square * weight)[:, i, :].sum(axis=1), (square * weight)[:, :, i].sum(axis=1)
            out[:, i] += 0.25 * np.log((column + floor) / (row + floor))
    return out
