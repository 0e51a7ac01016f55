"""The features by which a loop is assessed: its peaks, crossings and nearest approaches to -1.

Each feature is solved for, with its gradient. A change of sign or a local extreme on the mesh of `Curves` locates a
feature, and Newton's method on the splines refines it. Its value then depends smoothly on the variables:

| feature | at | value |
|---|---|---|
| peak | d ln|L| = 0 within a band, or the end of the band | ln|L| |
| gain crossing | arg L = 180 deg (mod 360) | ln|L| |
| phase crossing | |L| = 1 | arg L - 180 deg |
| turn of gain | d ln|L| = 0 near 0 dB, close to 180 deg | ln|L| |
| turn of phase | d arg L = 0 near 180 deg, close to 0 dB | arg L - 180 deg |
| end | zero frequency, Nyquist frequency: L is real | ln|L| where L is negative |
| modulus | d |1 + L| = 0 | ln|1 + L| |
| zone | minimum of the zone's function along the curve | that function |
| template | extreme of ln|S|, ln|T|, ln|K S| or ln|L| over a template (templates.py), or an end of it | ln of that |

Gradients: at an extreme, the frequency may be held constant, since its change has an effect of second order. At a
crossing u = 0 of u + iv = ln L along x, the value v changes by dv - (v_x / u_x) du. The function of a zone with corners
(diamond, rectangle) is a maximum of smooth functions. If its minimum is on a corner line, the formula of a crossing
applies to the two functions that meet there.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from enum import IntEnum
from functools import cached_property
from typing import TYPE_CHECKING, TypeVar

import numpy as np
from numpy.typing import NDArray

from maxq.control.kernel.records import Array
from maxq.design.laws.law import Axis
from maxq.design.laws.task import DB
from maxq.design.loop.own_part import SHARE, dominance
from maxq.design.margins import solving
from maxq.design.model.state_space import ComplexArray
from maxq.design.optimise.curves import CurveIndices, Curves

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

Mask = NDArray[np.bool_]
Record = TypeVar("Record", bound="DataclassInstance")

REAL_WITHIN_RAD = 0.02
WIDEST_ZONE = 2.5  # largest value of the zone's function that has a row


class FeatureKind(IntEnum):
    """The kinds of features, as listed in the table of the module."""

    PEAK = 0
    GAIN_CROSSING = 1
    PHASE_CROSSING = 2
    GAIN_TURN = 3
    PHASE_TURN = 4
    MODULUS = 5
    ZONE = 6
    END = 7
    ZONE_CORNER = 8
    OVER_S = 9
    OVER_T = 10
    OVER_KS = 11
    OVER_L = 12


@dataclass(frozen=True)
class Cross:
    """The half axes of the cross, and of the zone, around -1, for each plant, mesh point or feature: ln|L| and rad.

    `zone` is the name of a zone or "none".
    """

    gain: Array
    phase: Array
    zone: str

    def of(self, which: CurveIndices | Mask) -> Cross:
        """Return the half axes of a selection."""
        return Cross(self.gain[which], self.phase[which], self.zone)

    @property
    def db_per_rad(self) -> Array:
        """Return the conversion factor of phases, the ratio of gain margin to phase margin."""
        return np.asarray(self.gain / self.phase * DB)


@dataclass(frozen=True)
class LogLoop:
    """The values of ln L at points, its derivatives with respect to x = ln f, and the data for the gradient of the law.

    `weights` (points, inputs) are those of `LawVariables.gradient`. `own` has the shape (points, own parameters).
    `path` (3, points) is ln P with the same derivatives.
    """

    value: ComplexArray
    first: ComplexArray
    second: ComplexArray
    weights: ComplexArray
    own: Array
    axis: Axis
    path: ComplexArray

    def beside(self, change: Array) -> LogLoop:
        """Return the values at x + change, to second order in the change."""
        first = self.first + self.second * change
        path = self.path.copy()
        path[1] += path[2] * change
        path[0] += 0.5 * (self.path[1] + path[1]) * change
        return replace(self, value=self.value + 0.5 * (self.first + first) * change, first=first, path=path)

    def taken(self, i: CurveIndices) -> LogLoop:
        """Return the points with the indices `i`."""
        axis = tuple(a[i] for a in self.axis)
        path = self.path[:, i]
        return LogLoop(self.value[i], self.first[i], self.second[i], self.weights[i], self.own[i], axis, path)


@dataclass(frozen=True)
class MeshPlaces:
    """The mesh intervals that contain features, with starting points for the refinement."""

    kind: NDArray[np.int8]
    cell: CurveIndices
    x: Array
    tag: CurveIndices  # index of a peak's band, or of a template's segment; 0 for other features
    fixed: Mask  # True for a given frequency: the end of a band or of the mesh
    tilt: Array  # slope of the template, d ln / d ln f; 0 for other features


def wrapped(log_loop: ComplexArray) -> Array:
    """Return arg L - 180 deg in (-pi, pi], rad."""
    return np.asarray(np.angle(-np.exp(1j * log_loop.imag)))


@dataclass(frozen=True)
class FeatureMode:
    """A bending mode of a plant, as defined in `loop.own_part`.

    `log_weight` is ln of the ratio of the mode's peak to max |L| in its band.
    """

    number: int  # 1, 2, ...
    centre_hz: float
    half_width_hz: float
    part: complex
    band_hz: tuple[float, float]
    log_weight: float


@dataclass(frozen=True)
class Bands:
    """The frequency bands of the peaks of modes, as mesh points from `first` to `last` inclusive.

    `centre` is the mesh point of the mode's frequency.
    """

    first: CurveIndices
    last: CurveIndices
    centre: CurveIndices
    plant: CurveIndices
    each: tuple[FeatureMode, ...]

    @cached_property
    def mode(self) -> CurveIndices:
        return np.array([mode.number for mode in self.each], np.int64)

    @cached_property
    def weight_db(self) -> Array:
        return DB * np.array([mode.log_weight for mode in self.each])

    @cached_property
    def _by_plant(self) -> tuple[CurveIndices, CurveIndices, ComplexArray, Array, Array]:
        """Return the mode numbers, and mesh point, own part, frequency and half width of each mode, (modes, plants)."""
        numbers, row = np.unique(self.mode, return_inverse=True)
        shape, at = (len(numbers), int(self.plant.max(initial=-1)) + 1), (row, self.plant)
        centre, part = np.zeros(shape, np.int64), np.zeros(shape, np.complex128)
        hz, width = np.ones(shape), np.ones(shape)
        centre[at], part[at] = self.centre, [mode.part for mode in self.each]
        hz[at], width[at] = [mode.centre_hz for mode in self.each], [mode.half_width_hz for mode in self.each]
        return numbers, centre, part, hz, width

    def own_crossings(
        self, number: int, plant: CurveIndices, x: Array, value: ComplexArray, loop: ComplexArray
    ) -> Mask:
        """Return True for the points at which a mode dominates.

        The points have x = ln f and L = `value`, at the plants with index `plant`. A mode dominates if its own part is
        larger than SHARE times the rest and the largest of all modes, as in `margins.lobes`. `loop` is L on the mesh.
        """
        numbers, centre, part, hz, width = self._by_plant
        if number not in numbers:
            return np.zeros(len(x), bool)
        part = part[:, plant]
        terms = part * loop[centre[:, plant]] / (1.0 + 1j * (np.exp(x) - hz[:, plant]) / width[:, plant])
        row = int(np.searchsorted(numbers, number))
        own, sizes = terms[row], np.abs(terms)
        strong = np.array([dominance(p) > 1.0 for p in part[row]], bool)
        return np.asarray(strong & (sizes[row] > SHARE * np.abs(value - own)) & (sizes[row] >= sizes.max(axis=0)))


@dataclass(frozen=True)
class CurveMesh:
    """All loops on the mesh of their curves, for the search of features.

    `beside` is arg L - 180 deg, rad. `cross` contains the half axes at each mesh point. `finite_at_zero` (plants,) is
    True if L has no pole at s = 0.
    """

    curves: Curves
    bands: Bands
    loop: ComplexArray
    cross: Cross
    finite_at_zero: Mask

    @cached_property
    def log_gain(self) -> Array:
        return np.asarray(np.log(np.abs(self.loop) + 1e-300))

    @cached_property
    def beside(self) -> Array:
        return np.asarray(np.angle(-self.loop))


FeatureSearch = Callable[[CurveMesh], MeshPlaces]


def joined(parts: Sequence[Record]) -> Record:
    """Return several records of arrays (dataclasses) as one record with concatenated arrays."""
    names = [f.name for f in fields(parts[0])]
    return type(parts[0])(*(np.concatenate([getattr(part, name) for part in parts]) for name in names))


def _untagged(kind: FeatureKind | Array, cell: CurveIndices, x: Array, fixed: bool = False) -> MeshPlaces:
    """Return places of features that have no band, all of one kind or with a kind for each."""
    n = len(cell)
    return MeshPlaces(np.full(n, kind, np.int8), cell, x, np.zeros(n, np.int64), np.full(n, fixed), np.zeros(n))


def peaks(mesh: CurveMesh) -> MeshPlaces:
    """Return the local maxima of |L| in each band.

    An end of a band is included if the curve falls towards the inside.
    """
    curves, bands = mesh.curves, mesh.bands
    k, tag, starts, ends = points_of(bands.first, bands.last)
    found = maxima(mesh.log_gain[k], starts, ends)
    k, tag = k[found], tag[found]
    inner = (k > bands.first[tag]) & (k < bands.last[tag])
    at = curves.x[k]
    at[inner] = vertex(curves.x, mesh.log_gain, k[inner])
    return MeshPlaces(np.full(len(k), FeatureKind.PEAK, np.int8), k, at, tag, ~inner, np.zeros(len(k)))


def points_of(first: CurveIndices, last: CurveIndices) -> tuple[CurveIndices, CurveIndices, CurveIndices, CurveIndices]:
    """Return the mesh points of all bands from `first` to `last`, the band of each, and each band's ends.

    The ends are the positions of a band's first and last point in the returned mesh points.
    """
    size = last - first + 1
    end = np.cumsum(size)
    tag = np.repeat(np.arange(len(size)), size)
    return np.arange(int(size.sum())) - (end - size)[tag] + first[tag], tag, end - size, end - 1


def maxima(value: Array, starts: CurveIndices, ends: CurveIndices) -> CurveIndices:
    """Return the indices of local maxima in each band. An end counts if the curve falls inwards."""
    before, after = np.append(-np.inf, value[:-1]), np.append(value[1:], -np.inf)
    before[starts], after[ends] = -np.inf, -np.inf
    return np.flatnonzero((value > before) & (value >= after))


def crossings(mesh: CurveMesh) -> MeshPlaces:
    """Return the zeros of arg L - 180 deg and of ln|L|, interpolated linearly between mesh points."""
    curves, loop, log_gain = mesh.curves, mesh.loop, mesh.log_gain
    same = curves.plant[1:] == curves.plant[:-1]
    im, re = loop.imag, loop.real
    turned = same & (np.signbit(im[1:]) != np.signbit(im[:-1]))
    k = np.flatnonzero(turned)
    share = im[k] / (im[k] - im[k + 1])
    share = np.where(np.isfinite(share), share, 0.5)
    behind = re[k] + share * (re[k + 1] - re[k]) < 0.0
    k, share = k[behind], share[behind]
    g = np.flatnonzero(same & (np.signbit(log_gain[1:]) != np.signbit(log_gain[:-1])))
    level = log_gain[g] / (log_gain[g] - log_gain[g + 1])
    level = np.where(np.isfinite(level), level, 0.5)
    found = (FeatureKind.GAIN_CROSSING, k, share), (FeatureKind.PHASE_CROSSING, g, level)
    width = np.diff(curves.x)
    return joined([_untagged(kind, cell, curves.x[cell] + part * width[cell]) for kind, cell, part in found])


def ends(mesh: CurveMesh) -> MeshPlaces:
    """Return the ends of curves at which L is real and negative.

    The first mesh point is an end if the loop is finite at zero frequency, and the last one always. The curve cannot
    cross the axis at an end, but a change of gain moves it to -1.
    """
    curves, loop = mesh.curves, mesh.loop
    points = np.concatenate([curves.start[:-1][mesh.finite_at_zero], curves.start[1:] - 1])
    k = points[np.abs(np.angle(-loop[points])) < REAL_WITHIN_RAD]
    return _untagged(FeatureKind.END, k, curves.x[k], True)


def _extremes(curves: Curves, value: Array, lowest: bool, where: Mask) -> tuple[CurveIndices, Array]:
    """Return the inner mesh points that are local extremes, and each parabola's vertex.

    `where` selects the mesh points.
    """
    v = value if lowest else -value
    inner = np.zeros(len(v), bool)
    inner[1:-1] = (v[1:-1] <= v[:-2]) & (v[1:-1] < v[2:])
    inner[curves.start[:-1]] = inner[curves.start[1:] - 1] = False
    k = np.flatnonzero(inner & where)
    return k, vertex(curves.x, value, k)


def vertex(x: Array, value: Array, k: CurveIndices) -> Array:
    """Return the vertex of the parabola through mesh points k - 1, k, k + 1, limited to the outer two."""
    around = k + np.arange(-1, 2)[:, None]
    with np.errstate(divide="ignore", invalid="ignore"):
        at, _ = solving.vertex(*x[around], *value[around])
    return np.clip(np.where(np.isfinite(at), at, x[k]), x[k - 1], x[k + 1])


def turns(mesh: CurveMesh) -> MeshPlaces:
    """Return the extremes near the arms of the cross (0 dB within the phase margin, 180 deg within the gain margin).

    The curve turns there without a crossing.
    """
    curves, log_gain, beside, cross = mesh.curves, mesh.log_gain, mesh.beside, mesh.cross
    found = []
    for sign in (1.0, -1.0):
        near = (sign * log_gain > 0) & (np.abs(beside) < cross.phase)
        found.append(_untagged(FeatureKind.GAIN_TURN, *_extremes(curves, log_gain, sign > 0, near)))
        # the bound of 1.5 rad excludes jumps of the wrapped phase
        near = (sign * beside > 0) & (np.abs(beside) < 1.5) & (np.abs(log_gain) < cross.gain)
        found.append(_untagged(FeatureKind.PHASE_TURN, *_extremes(curves, beside, sign > 0, near)))
    return joined(found)


def approaches(mesh: CurveMesh) -> MeshPlaces:
    """Return the local minima of |1 + L| on the mesh that are below 1."""
    distance = np.abs(1.0 + mesh.loop)
    return _untagged(FeatureKind.MODULUS, *_extremes(mesh.curves, distance, True, distance < 1.0))


def near_zone(mesh: CurveMesh) -> MeshPlaces:
    """Return the local minima of the zone's function on a face, and for a rectangle also where two faces meet.

    The edges of a diamond are on the arms of the cross, where crossings are already features.
    """
    curves, log_gain, beside, cross = mesh.curves, mesh.log_gain, mesh.beside, mesh.cross
    value = zone_value(log_gain, beside, cross)
    k, x = _extremes(curves, value, True, value < WIDEST_ZONE)
    if cross.zone == "ellipse":
        return _untagged(FeatureKind.ZONE, k, x)
    if cross.zone == "diamond":
        face = np.signbit(log_gain) * 2 + np.signbit(beside)
        inside = (face[k] == face[k - 1]) & (face[k] == face[k + 1])
        return _untagged(FeatureKind.ZONE, k[inside], x[inside])
    a, p = np.abs(log_gain) / cross.gain, np.abs(beside) / cross.phase
    higher = a > p
    own = np.where(higher[k], (a[k - 1], a[k], a[k + 1]), (p[k - 1], p[k], p[k + 1]))
    # if the point's face still falls towards an edge and the other face is higher beyond it, the edge is the minimum
    after, before = (higher[k + 1] != higher[k]) & (own[2] < own[1]), (higher[k - 1] != higher[k]) & (own[0] < own[1])
    corner, other = after | before, np.where(after, k + 1, k - 1)
    gap = a - p
    with np.errstate(divide="ignore", invalid="ignore"):
        share = gap[k] / (gap[k] - gap[other])
    x = np.where(corner, curves.x[k] + share * (curves.x[other] - curves.x[k]), x)
    return _untagged(np.where(corner, FeatureKind.ZONE_CORNER, FeatureKind.ZONE), k, x)


def in_intervals(curves: Curves, places: MeshPlaces) -> MeshPlaces:
    """Return the places with mesh intervals in place of mesh points, so that each interval contains its x."""
    cell = np.where(places.x < curves.x[places.cell], places.cell - 1, places.cell)
    cell = np.minimum(cell, curves.start[curves.plant[places.cell] + 1] - 2)
    return replace(places, cell=cell)


def zone_value(log_gain: Array, beside: Array, cross: Cross) -> Array:
    """Return the zone's function, which is 0 at the centre and 1 on the border."""
    a, p = np.abs(log_gain) / cross.gain, np.abs(beside) / cross.phase
    if cross.zone == "ellipse":
        return np.asarray(np.hypot(a, p))
    return np.asarray(a + p if cross.zone == "diamond" else np.maximum(a, p))


def transfer(kind: NDArray[np.int8], at: LogLoop) -> tuple[ComplexArray, ComplexArray, ComplexArray]:
    """Return the logarithm of the function of each template, with two derivatives with respect to x.

    The functions are S = 1 / (1 + L), T = L S, K S = C S with the law C from the measured rate to the command, and L.
    """
    closed = 1.0 / (1.0 + np.exp(-at.value))
    first = closed * at.first
    s = -np.log1p(np.exp(at.value)), -first, -(closed * at.second + closed * (1.0 - closed) * at.first**2)
    loop = at.value, at.first, at.second
    takes_s, takes_loop, takes_path = (
        kind != FeatureKind.OVER_L,
        kind != FeatureKind.OVER_S,
        kind == FeatureKind.OVER_KS,
    )
    out = [takes_s * a + takes_loop * b - takes_path * p for a, b, p in zip(s, loop, at.path, strict=True)]
    return out[0], out[1], out[2]


def condition(kind: NDArray[np.int8], at: LogLoop, cross: Cross, tilt: Array) -> tuple[Array, Array]:
    """Return the function that is zero at each feature, and its derivative with respect to x.

    `MeshPlaces` defines `tilt`.
    """
    residual, slope = at.first.real.copy(), at.second.real.copy()  # default: extreme of ln|L|
    k = kind == FeatureKind.GAIN_CROSSING
    residual[k], slope[k] = wrapped(at.value[k]), at.first.imag[k]
    k = kind == FeatureKind.PHASE_CROSSING
    residual[k], slope[k] = at.value.real[k], at.first.real[k]
    k = kind == FeatureKind.PHASE_TURN
    residual[k], slope[k] = at.first.imag[k], at.second.imag[k]
    k = kind == FeatureKind.MODULUS
    if k.any():
        closed = 1.0 / (1.0 + np.exp(-at.value[k]))  # L / (1 + L)
        residual[k] = (closed * at.first[k]).real
        slope[k] = (closed * at.second[k] + closed * (1.0 - closed) * at.first[k] ** 2).real
    k = (kind == FeatureKind.ZONE) | (kind == FeatureKind.ZONE_CORNER)
    if k.any():
        residual[k], slope[k] = _zone_condition(kind[k], at, k, cross.of(k))
    k = kind >= FeatureKind.OVER_S
    if k.any():
        _, first, second = transfer(kind[k], at.taken(np.flatnonzero(k)))
        residual[k], slope[k] = first.real - tilt[k], second.real
    return residual, slope


def _zone_condition(kind: NDArray[np.int8], at: LogLoop, k: Mask, cross: Cross) -> tuple[Array, Array]:
    a, p = at.value.real[k] / cross.gain, wrapped(at.value[k]) / cross.phase
    a1, p1 = at.first.real[k] / cross.gain, at.first.imag[k] / cross.phase
    a2, p2 = at.second.real[k] / cross.gain, at.second.imag[k] / cross.phase
    if cross.zone == "ellipse":
        return a * a1 + p * p1, a1 * a1 + p1 * p1 + a * a2 + p * p2
    sign_a, sign_p = np.sign(a), np.sign(p)
    if cross.zone == "diamond":
        return sign_a * a1 + sign_p * p1, sign_a * a2 + sign_p * p2
    corner, beside = kind == FeatureKind.ZONE_CORNER, np.abs(p) > np.abs(a)
    return (
        np.where(corner, np.abs(a) - np.abs(p), np.where(beside, p1, a1)),
        np.where(corner, sign_a * a1 - sign_p * p1, np.where(beside, p2, a2)),
    )


def sensitivity(kind: NDArray[np.int8], at: LogLoop, cross: Cross) -> ComplexArray:
    """Return the factors c, (features,), for which Re(c d ln L) is the change of each feature's excess, dB."""
    value, first, db_per_rad = at.value, at.first, cross.db_per_rad
    beside = wrapped(value)
    gain_side, phase_side = np.sign(value.real), np.sign(beside)
    out = np.full(len(kind), DB + 0j)  # default: the peak ln|L|
    with np.errstate(divide="ignore", invalid="ignore"):
        k = kind == FeatureKind.GAIN_CROSSING  # Re(dL) - (Re L' / Im L') Im(dL)
        out[k] = (-gain_side * DB * (1.0 + 1j * first.real / first.imag))[k]
        k = kind == FeatureKind.PHASE_CROSSING
        out[k] = (-phase_side * db_per_rad * (-1j - first.imag / first.real))[k]
    k = (kind == FeatureKind.GAIN_TURN) | (kind == FeatureKind.END)
    out[k] = (-gain_side * DB)[k]
    k = kind == FeatureKind.PHASE_TURN
    out[k] = (1j * phase_side * db_per_rad)[k]
    k = kind == FeatureKind.MODULUS
    out[k] = -DB / (1.0 + np.exp(-value[k]))
    k = (kind == FeatureKind.ZONE) | (kind == FeatureKind.ZONE_CORNER)
    if k.any():
        out[k] = -cross.gain[k] * DB * _zone_sensitivity(kind[k], value[k], first[k], cross.of(k))
    k = (kind >= FeatureKind.OVER_S) & (kind < FeatureKind.OVER_L)
    if k.any():  # S changes by -T d ln L, and T and K S by S d ln L
        out[k] = DB * (1.0 / (1.0 + np.exp(value[k])) - (kind[k] == FeatureKind.OVER_S))
    # a curve tangent to the line that it crosses has no gradient; zero replaces infinity
    return np.where(np.isfinite(out) & (np.abs(out) < 1e6), out, 0.0)


def _zone_sensitivity(kind: NDArray[np.int8], value: ComplexArray, first: ComplexArray, cross: Cross) -> ComplexArray:
    """Return the factors c for which Re(c d ln L) is the change of the zone's function at its minimum."""
    a, p = value.real / cross.gain, wrapped(value) / cross.phase
    by_a, by_p = np.sign(a) / cross.gain, np.sign(p) / cross.phase
    if cross.zone == "diamond":
        return np.asarray(by_a - 1j * by_p)
    if cross.zone == "ellipse":
        size = np.hypot(a, p)
        return np.asarray(a / size / cross.gain - 1j * p / size / cross.phase)
    slope_a, slope_p = by_a * first.real, by_p * first.imag
    with np.errstate(divide="ignore", invalid="ignore"):
        share = slope_p / (
            slope_p - slope_a
        )  # weight of the gain's face, for which the sum is stationary along the curve
    share = np.where(kind == FeatureKind.ZONE_CORNER, share, np.where(np.abs(p) > np.abs(a), 0.0, 1.0))
    return np.asarray(share * by_a - 1j * (1.0 - share) * by_p)
