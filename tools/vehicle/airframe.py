"""A rocket as read from another program: pieces of mass, bodies, fins and motors at stations, with remarks.

Stations are in m aft of the nose of the whole rocket. `layout_text` (tools/vehicle/airframe_layout.py) makes a layout
of it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq

from maxq.control.kernel.records import Array

_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(32)
_PARTS = 12  # of an interval of integration
_SCAN = 400  # points among which the inner wall is searched for its tip
Kind = Literal["taken", "assumed", "missing"]


class Remark(NamedTuple):
    """A statement on the import: data that were taken, assumed or missing."""

    kind: Kind
    subject: str
    text: str


@dataclass(frozen=True)
class Piece:
    """A mass on the axis: station of its CG, and variances of its mass along the axis, about it, and across it, m2.

    The moments of inertia about its CG are m roll_m2, and m (axial_m2 + across_m2).
    """

    name: str
    mass_kg: float
    station_m: float
    axial_m2: float = 0.0
    roll_m2: float = 0.0
    across_m2: float = 0.0

    def moved(self, by_m: float) -> Piece:
        """Return the piece at a station further aft."""
        return replace(self, station_m=self.station_m + by_m)


@dataclass(frozen=True)
class Body:
    """A body of revolution that carries the loads: its ends, its wall, and its outer volume and side area."""

    name: str
    front_station_m: float
    rear_station_m: float
    front_radius_m: float
    rear_radius_m: float
    volume_m3: float
    side_m2: float  # area of the silhouette
    side_station_m: float  # its centroid
    wall_m: float | None  # None: solid
    modulus_Pa: float

    @property
    def length_m(self) -> float:
        return self.rear_station_m - self.front_station_m

    @property
    def lift_area_m2(self) -> float:
        """Return the gain of cross-section from the front to the rear."""
        return math.pi * (self.rear_radius_m**2 - self.front_radius_m**2)

    @property
    def lift_station_m(self) -> float:
        """Return the station of the normal force of slender-body theory, for a body that changes its cross-section."""
        rear_m2 = math.pi * self.rear_radius_m**2
        return self.front_station_m + (self.length_m * rear_m2 - self.volume_m3) / self.lift_area_m2


@dataclass(frozen=True)
class FinSet:
    """A set of equal fins with a trapezoidal planform on a body."""

    name: str
    count: int
    root_chord_m: float
    tip_chord_m: float
    semispan_m: float
    sweep_m: float
    leading_edge_station_m: float
    body_radius_m: float


@dataclass(frozen=True)
class Motor:
    """Equal solid motors side by side: the thrust of one over time, linear between its rows, and its masses."""

    name: str
    time_s: Array
    thrust_N: Array
    propellant_kg: float
    case_kg: float
    front_station_m: float
    rear_station_m: float
    radius_m: float
    count: int = 1
    grain: tuple[float, float] | None = None  # its ends, m aft of the nose (None: those of the motor)
    port_radius_m: float | None = None
    exit_area_m2: float = 0.0


@dataclass(frozen=True)
class AirframeStage:
    """A stage: its masses without motor, its bodies from front to rear, its fins and its motor.

    The times are those from its burnout to its separation, and from there to the ignition of the next stage.
    """

    name: str
    pieces: tuple[Piece, ...]
    bodies: tuple[Body, ...]
    fins: tuple[FinSet, ...]
    motor: Motor
    separation_after_s: float = 0.0
    ignition_after_s: float = 0.0

    @property
    def diameter_m(self) -> float:
        return 2.0 * max(max(b.front_radius_m, b.rear_radius_m) for b in self.bodies)


@dataclass(frozen=True)
class Airframe:
    """A rocket with its launch site. `stages` begin at the top; `axial` has rows of Mach number, CA and CA_coast.

    A rigid rocket has no bending modes, because the stiffness of its bodies is unknown.
    """

    name: str
    source: str
    stages: tuple[AirframeStage, ...]
    nose: Literal["ogive", "cone"]
    latitude_deg: float
    longitude_deg: float
    altitude_m: float
    azimuth_deg: float
    rail_m: float
    elevation_deg: float
    axial: tuple[Array, Array, Array] | None = None
    reference_diameter_m: float | None = None  # of `axial` (None: the largest diameter)
    rigid: bool = False
    remarks: list[Remark] = field(default_factory=list)


class Solid(NamedTuple):
    """The volume of a body of revolution, its centroid, and the variances of a uniform density, m2."""

    volume_m3: float
    centroid_m: float
    axial_m2: float
    roll_m2: float


def joined_solids(solids: Sequence[Solid]) -> Solid:
    """Return the sum of solids of the same density."""
    volume = sum(s.volume_m3 for s in solids)
    if volume <= 0.0:
        return Solid(0.0, 0.0, 0.0, 0.0)
    centre = sum(s.volume_m3 * s.centroid_m for s in solids) / volume
    axial = sum(s.volume_m3 * (s.axial_m2 + (s.centroid_m - centre) ** 2) for s in solids) / volume
    return Solid(volume, centre, axial, sum(s.volume_m3 * s.roll_m2 for s in solids) / volume)


def tube(length_m: float, outer_m: float, inner_m: float, front_m: float = 0.0) -> Solid:
    """Return a hollow cylinder, or a solid one with an inner radius of 0."""
    volume = math.pi * (outer_m**2 - inner_m**2) * length_m
    return Solid(volume, front_m + 0.5 * length_m, length_m**2 / 12.0, 0.5 * (outer_m**2 + inner_m**2))


RealOrComplex = NDArray[Any]  # real or complex
RadiusProfile = Callable[[RealOrComplex], RealOrComplex]  # outer radius over the distance from the front


def revolved(profile: RadiusProfile, length_m: float, wall_m: float | None) -> tuple[Solid, Solid, float, float]:
    """Return the wall and the outer volume of a body of revolution, and the area and centroid of its silhouette.

    `wall_m` is the thickness normal to the surface, or None for a solid body. Integrals are of Gauss and Legendre in
    the square root of the distance from each end, in which blunt tips are smooth.
    """

    def radius(x: Array) -> Array:
        return np.asarray(np.maximum(profile(x).real, 0.0))

    def inner(x: Array) -> Array:
        if wall_m is None:
            return np.zeros_like(x)
        step = 1e-30
        slope = profile(x + step * 1j).imag / step
        with np.errstate(over="ignore", invalid="ignore"):
            return np.asarray(np.nan_to_num(radius(x) - wall_m * np.sqrt(1.0 + slope**2), nan=-1.0, neginf=-1.0))

    scan = length_m * 0.5 * (1.0 - np.cos(np.pi * (np.arange(_SCAN) + 0.5) / _SCAN))
    signs = inner(scan) > 0.0
    edges = [0.0, 0.5 * length_m, length_m]
    for k in np.flatnonzero(signs[1:] != signs[:-1]):
        edges.append(float(brentq(lambda x: float(inner(np.array([x]))[0]), scan[k], scan[k + 1], xtol=1e-15)))
    nodes, weights = _quadrature(np.unique(edges), length_m)
    outside, inside = radius(nodes), np.maximum(inner(nodes), 0.0)

    def moments(inner_m: Array) -> Solid:
        area = math.pi * (outside**2 - inner_m**2) * weights
        volume = float(area.sum())
        if volume <= 0.0:
            return Solid(0.0, 0.0, 0.0, 0.0)
        centre = float(area @ nodes) / volume
        roll = float(area @ (outside**2 + inner_m**2)) / (2.0 * volume)
        return Solid(volume, centre, float(area @ (nodes - centre) ** 2) / volume, roll)

    side = 2.0 * float(weights @ outside)
    return moments(inside), moments(0.0 * inside), side, 2.0 * float((weights * outside) @ nodes) / side


def _quadrature(edges: Array, length_m: float) -> tuple[Array, Array]:
    """Return nodes and weights between the edges. Each half of the length is integrated over the root of the distance
    from its end.
    """
    every, weights = [], []
    for a, b in pairwise(edges.tolist()):
        back = a >= 0.5 * length_m  # measured from the rear
        low, high = (length_m - b, length_m - a) if back else (a, b)
        cuts = np.linspace(math.sqrt(max(low, 0.0)), math.sqrt(high), _PARTS + 1)
        half, middle = 0.5 * np.diff(cuts), 0.5 * (cuts[1:] + cuts[:-1])
        root = (middle[:, None] + half[:, None] * _NODES).ravel()
        every.append(length_m - root**2 if back else root**2)
        weights.append((half[:, None] * _WEIGHTS).ravel() * 2.0 * root)
    return np.concatenate(every), np.concatenate(weights)


class Planform(NamedTuple):
    """The area of a fin, the centroid of the area from the root's leading edge, and second moments per area, m2.

    `along_m2` is the variance along the axis, `span_m2` the mean square of the distance from the root.
    """

    area_m2: float
    x_m: float
    y_m: float
    along_m2: float
    span_m2: float


def polygon(points: Array) -> Planform:
    """Return the planform of a polygon (n, 2) of distances aft of the root's leading edge and from the root."""
    x0, y0 = points.T
    x1, y1 = np.roll(points, -1, axis=0).T
    cross = x0 * y1 - x1 * y0
    area = 0.5 * float(cross.sum())
    if area == 0.0:
        return Planform(0.0, 0.0, 0.0, 0.0, 0.0)
    x = float(((x0 + x1) * cross).sum()) / (6.0 * area)
    y = float(((y0 + y1) * cross).sum()) / (6.0 * area)
    xx = float(((x0 * x0 + x0 * x1 + x1 * x1) * cross).sum()) / (12.0 * area)
    yy = float(((y0 * y0 + y0 * y1 + y1 * y1) * cross).sum()) / (12.0 * area)
    return Planform(abs(area), x, y, xx - x * x, yy)


def equivalent_trapezoid(y: Array, leading: Array, chord: Array) -> tuple[float, float, float, float]:
    """Return the root chord, tip chord, sweep, and shift of the leading edge of a trapezoid with the same lift centre.

    `leading` and `chord` are over the distance `y` from the root. Span, area, mean aerodynamic chord and its place are
    equal. If there is no such trapezoid, the tip chord is 0.
    """
    span, area = float(y[-1]), float(np.trapezoid(chord, y))
    mean = float(np.trapezoid(chord**2, y)) / area
    front = float(np.trapezoid(chord * leading, y)) / area
    both = 2.0 * area / span
    product = max(both * (both - 1.5 * mean), 0.0)
    root = 0.5 * both + math.sqrt(max(0.25 * both**2 - product, 0.0))
    tip = max(both - root, 0.0)
    middle = leading + 0.5 * chord  # its mean slope is that of the mid-chord line
    slope = float(np.polyfit(y, middle, 1)[0])
    sweep = slope * span + 0.5 * (root - tip)
    return root, tip, sweep, front - sweep / 3.0 * (root + 2.0 * tip) / (root + tip)
