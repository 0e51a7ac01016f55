"""The fixed part of every plant's loop, as a smooth curve over frequency that is fast to evaluate.

The optimiser evaluates peaks, crossings and gradients hundreds of times at a few hundred frequencies, while the law
changes and the vehicle does not. The exact response is therefore computed once, on a mesh that resolves every
resonance. Quintic splines over ln f interpolate ln P, and ln of the ratio of each other measurement to P. The mesh is
halved wherever the spline differs from the exact response by more than `TOLERANCE`. The tolerance corresponds to
2e-6 dB and 1e-5 deg, far below the resolution of 0.01 of the margins.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy  # its submodules are imported at first use
from numpy.typing import NDArray

from maxq.control.kernel.records import Array
from maxq.design.loop.fixed_path import FixedPath
from maxq.design.loop.own_part import NEAREST_NYQUIST
from maxq.design.margins.curve import lowest_hz_of
from maxq.design.model.state_space import ComplexArray

CurveIndices = NDArray[np.int64]

BASE = "rate_radps"  # the measurement that is the output of the fixed path
TOLERANCE = 2e-7  # of ln P
HIGHEST_HZ = 200.0  # end of a loop without a Nyquist frequency
PER_DECADE = 24
MOST_ROUNDS = 14
CLOSEST = 1e-6  # least distance of points in ln f


LogAndSlopes = tuple[ComplexArray, ComplexArray, ComplexArray]


@dataclass(frozen=True)
class Points:
    """The response at points of the curves, as logarithms with two derivatives with respect to x = ln f.

    Each array has the shape (points,). `log_ratio` contains the ratio of each measurement to `BASE`, and None for
    `BASE` itself.
    """

    log_path: LogAndSlopes
    log_ratio: dict[str, LogAndSlopes | None]


class Curves:
    """The meshes of all plants (`mesh_of`), concatenated."""

    def __init__(self, meshes: Sequence[PathMesh]) -> None:
        self.sizes = np.array([len(m.x) for m in meshes])
        self.start = np.concatenate([[0], np.cumsum(self.sizes)])
        self.plant: CurveIndices = np.repeat(np.arange(len(meshes)), self.sizes)
        self.x = np.concatenate([m.x for m in meshes])
        self.frequency_hz = np.exp(self.x)
        self.path = np.concatenate([m.path for m in meshes])
        others = meshes[0].ratios
        self.ratio: dict[str, ComplexArray] = {
            name: np.concatenate([m.ratios[name] for m in meshes]) for name in others
        }
        # a mesh of n points has n - 1 intervals, so the last column of each plant is unused
        self._coefficients = np.concatenate(
            [np.concatenate([m.spline.c, np.zeros((6, 1, 2 + 2 * len(others)))], axis=1) for m in meshes], axis=1
        )
        self.meshes = meshes

    def in_cells(self, cell: CurveIndices, x: Array) -> Points:
        """Return the response at `x` in the mesh intervals `cell` or close to them.

        Intervals are numbered over all plants.
        """
        t = (x - self.x[cell])[:, None]
        c = self._coefficients[:, cell, :]
        value = ((((c[0] * t + c[1]) * t + c[2]) * t + c[3]) * t + c[4]) * t + c[5]
        first = (((5 * c[0] * t + 4 * c[1]) * t + 3 * c[2]) * t + 2 * c[3]) * t + c[4]
        second = ((20 * c[0] * t + 12 * c[1]) * t + 6 * c[2]) * t + 2 * c[3]
        orders = [part[:, ::2] + 1j * part[:, 1::2] for part in (value, first, second)]
        path, *ratios = zip(*(part.T for part in orders), strict=True)
        return Points(path, {BASE: None, **dict(zip(self.ratio, ratios, strict=True))})


@dataclass(frozen=True)
class PathMesh:
    """The mesh of one path and its splines."""

    x: Array
    path: ComplexArray
    ratios: dict[str, ComplexArray]  # ratio of each other measurement to BASE
    spline: scipy.interpolate.PPoly  # of Re ln P and Im ln P, then of Re ln and Im ln of each ratio


def mesh_of(path: FixedPath, kept_hz: Array, tolerance: float = TOLERANCE) -> PathMesh:
    """Return the mesh of a path. `kept_hz` contains frequencies that must be mesh points, such as bands of modes."""
    top = HIGHEST_HZ if math.isinf(path.highest_hz) else path.highest_hz * NEAREST_NYQUIST
    names = [name for name in path.measurements if name != BASE]

    def exact(x: Array) -> ComplexArray:
        """Return the exact values of the response and of the ratios, (1 + ratios, points)."""
        f = np.exp(x)
        return np.array([path.response(f), *(path.ratio(name, f) for name in names)])

    x = np.log(_first_frequencies(path, top, kept_hz))
    known = exact(x)
    for _ in range(MOST_ROUNDS):
        spline = _spline(x, known)  # polynomials are derived from the last spline only
        middle = 0.5 * (x[1:] + x[:-1])
        wanted, guess = exact(middle), spline(middle)
        with np.errstate(over="ignore", invalid="ignore"):  # a spline through few points may overflow
            miss = np.abs(np.exp(guess[:, ::2] + 1j * guess[:, 1::2]).T / wanted - 1.0).max(axis=0)
        bad = ~(miss < tolerance)
        if not bad.any():
            break
        # refines neighbours as well, since steps that differ by at most a factor of 2 limit the spread of the error
        spread = bad.copy()
        spread[1:] |= bad[:-1]
        spread[:-1] |= bad[1:]
        x = np.concatenate([x, middle[spread]])
        known = np.concatenate([known, wanted[:, spread]], axis=1)
        order = np.argsort(x)
        x, known = x[order], known[:, order]
    spline = _spline(x, known)
    # Taylor coefficients at the left end of each interval (BSpline is continuous from the right)
    orders = [spline.derivative(k)(x[:-1]) / math.factorial(k) if k else spline(x[:-1]) for k in range(6)]
    return PathMesh(
        x, known[0], dict(zip(names, known[1:], strict=True)), scipy.interpolate.PPoly(np.stack(orders[::-1]), x)
    )


def _spline(x: Array, responses: ComplexArray) -> scipy.interpolate.BSpline:
    """Return the splines of Re ln and Im ln of each row of `responses`, as columns.

    Raises ValueError for values that are not finite.
    """
    if not np.isfinite(responses).all():
        raise ValueError("the response of a plant is not finite")
    columns = [part for row in responses for part in (np.log(np.abs(row)), np.unwrap(np.angle(row)))]
    return scipy.interpolate.make_interp_spline(x, np.stack(columns, axis=1), k=5)


def _first_frequencies(path: FixedPath, top_hz: float, kept_hz: Array) -> Array:
    """Return geometrically spaced frequencies (Hz), refined around every oscillatory pole."""
    low_hz = lowest_hz_of(path.poles())
    decades = np.log10(top_hz / low_hz)
    parts = [np.geomspace(low_hz, top_hz, int(decades * PER_DECADE) + 1), np.asarray(kept_hz, float)]
    spread = np.sinh(np.linspace(-4.0, 4.0, 33))
    for pole in path.poles() / (2.0 * np.pi):
        if pole.imag > 0.0 and abs(pole.real) < 0.3 * pole.imag:
            parts.append(pole.imag + abs(pole.real) * spread)
    joined = np.unique(np.concatenate(parts))
    joined = joined[(joined >= low_hz) & (joined <= top_hz)]
    # removes points that are too close for the spline, except the kept ones
    kept = np.isin(joined, kept_hz)
    close = np.abs(np.log(joined[:, None] / joined[kept])).min(axis=1, initial=math.inf) <= CLOSEST
    joined = joined[kept | ~close]
    apart = np.concatenate([[True], np.diff(np.log(joined)) > CLOSEST]) | np.isin(joined, kept_hz)
    return np.asarray(joined[apart])
