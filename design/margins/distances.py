"""Distances of the curve from the critical point: modulus (disk) margins, and exclusion zones in the Nichols plane.

Disk margins bound gain and phase that change together (Seiler, Packard & Gahinet, IEEE CSM 40(5), 2020).

Gain and phase margin bound a curve on two lines only and let it cut the corner between them; exclusion zones around
-180 + 360 k degrees, 0 dB close it. The clearance of a zone is -1 in its centre, 0 on its border and grows linearly
outwards: d >= 0 is the constraint. With psi the phase from the nearest centre in degrees, y the gain in dB, a and b
the zone's half axes:

    diamond      |psi|/a + |y|/b - 1
    rectangle    max(|psi|/a, |y|/b) - 1
    ellipse      sqrt((psi/a)^2 + (y/b)^2) - 1
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from maxq.control.kernel.records import Array, IntArray
from maxq.design.margins import solving
from maxq.design.margins.curve import Curve, GainCrossings, PhaseCrossings, brackets, with_minima
from maxq.design.margins.solving import DB, along, from_minus_one_deg, log_size, roots, sample
from maxq.design.model.state_space import ComplexArray

Shape = Literal["diamond", "rectangle", "ellipse"]


@dataclass(frozen=True)
class Disk:
    """One disk and its guarantee: the loop stays stable under any gain in [down, up] and any phase up to `phase_deg`.

    `size` is the least distance: |1 + L| (sensitivity), |1 + 1/L| (complementary) or 2 |1 + L|/|1 - L| (symmetric:
    the alpha of the paper above, at most 2).
    """

    size: float
    frequency_hz: float
    gain_down_db: float  # both counted positive; infinite where the disk does not bound them
    gain_up_db: float
    phase_deg: float


@dataclass(frozen=True)
class Disks:
    sensitivity: Disk  # the modulus margin: 1 / max |S|
    complementary: Disk  # 1 / max |T|
    symmetric: Disk


_NO_DISK = Disk(np.nan, np.nan, np.nan, np.nan, np.nan)
NO_DISKS = Disks(_NO_DISK, _NO_DISK, _NO_DISK)
"""Of an unstable loop."""


def find_disks(curve: Curve) -> Disks:
    """Least distances over a curve whose turning points have been solved for."""
    size, f = _least_distance(curve, solving.sensitivity)
    from_s = Disk(size, f, _db(1.0 + size), -_db(1.0 - size), _phase_deg(size))
    size, f = _least_distance(curve, solving.complementary)
    from_t = Disk(size, f, -_db(1.0 - size), _db(1.0 + size), _phase_deg(size))
    return Disks(from_s, from_t, symmetric_disk(*_least_distance(curve, solving.symmetric)))


def symmetric_disk(half: float, frequency_hz: float) -> Disk:
    """From alpha / 2, the least |1 + L| / |1 - L|."""
    both = -_db((1.0 - half) / (1.0 + half)) if half < 1.0 else np.inf if half >= 1.0 else np.nan
    # |1 + L| < |1 - L| only where Re L < 0: elsewhere the disk is the half plane
    half = min(half, 1.0) if half >= 0.0 else half
    return Disk(2.0 * half, frequency_hz, both, both, float(np.degrees(2.0 * np.arctan(half))))


def _least_distance(curve: Curve, objective: solving.Objective) -> tuple[float, float]:
    """The least distance and its frequency: 0 and infinity are limits."""
    value: Array = objective(curve.loop)
    k = int(np.argmin(value))
    found = [(float(value[k]), float(curve.frequency_hz[k]))]
    found += [(float(objective(np.array([limit]))[0]), f) for limit, f in curve.limits]
    least, f = min(found)
    return float(np.exp(least)) if least < 300.0 else np.inf, f


def _db(ratio: float) -> float:
    return float(DB * np.log(ratio)) if ratio > 0.0 else -np.inf


def _phase_deg(size: float) -> float:
    return float(np.degrees(2.0 * np.arcsin(size / 2.0))) if size <= 2.0 else np.inf


@dataclass(frozen=True)
class Zone:
    """Half axes. Raises ValueError unless both are positive."""

    shape: Shape = "diamond"
    phase_deg: float = 30.0
    gain_db: float = 6.0

    def __post_init__(self) -> None:
        if self.shape not in ("diamond", "rectangle", "ellipse"):
            raise ValueError(f"zone shape {self.shape!r}: must be diamond, rectangle or ellipse")
        if not (self.phase_deg > 0.0 and self.gain_db > 0.0):
            raise ValueError(f"a zone of {self.phase_deg} deg by {self.gain_db} dB: both must be positive")

    def coordinates(self, loop: ComplexArray) -> tuple[Array, Array]:
        """psi/a and y/b."""
        return from_minus_one_deg(loop) / self.phase_deg, DB * log_size(loop) / self.gain_db

    def clearance(self, loop: ComplexArray) -> Array:
        """At each point of L."""
        x, y = self.coordinates(loop)
        if self.shape == "diamond":
            return np.asarray(np.abs(x) + np.abs(y) - 1.0)
        if self.shape == "rectangle":
            return np.asarray(np.maximum(np.abs(x), np.abs(y)) - 1.0)
        return np.asarray(np.hypot(x, y) - 1.0)

    def corner(self, loop: ComplexArray) -> Array:
        """|psi|/a - |y|/b, zero on the diagonals on which a rectangle's clearance has its kinks."""
        x, y = self.coordinates(loop)
        return np.asarray(np.abs(x) - np.abs(y))


@dataclass(frozen=True)
class Clearance:
    """Least clearance of a zone along the curve: negative inside the zone."""

    zone: Zone
    value: float
    frequency_hz: float
    loop: complex


def find_clearances(
    curve: Curve, zones: tuple[Zone, ...], gain: GainCrossings, phase: PhaseCrossings
) -> tuple[Clearance, ...]:
    """Of every zone; the curve must hold its crossings. Kinks of the clearance lie on crossings and diagonals."""
    if not zones:
        return ()
    curve, corners = _with_corners(curve, zones)
    axes = np.concatenate([gain.frequency_hz, phase.frequency_hz])
    curve = _beside(curve, np.append(axes, corners))
    kinks = {"diamond": axes, "rectangle": corners, "ellipse": np.zeros(0)}
    found = [_candidates(zone.clearance(curve.loop), np.isin(curve.frequency_hz, kinks[zone.shape])) for zone in zones]
    curve = with_minima(curve, [zone.clearance for zone in zones], found)
    least = [(zone, value := zone.clearance(curve.loop), int(np.argmin(value))) for zone in zones]
    at, loop = curve.frequency_hz, curve.loop
    return tuple(Clearance(zone, float(value[k]), float(at[k]), complex(loop[k])) for zone, value, k in least)


def _candidates(value: Array, sharp: NDArray[np.bool_]) -> tuple[IntArray, Array]:
    """Brackets that may hold the least value of all: the steps to the neighbours bound the improvement.

    A kink lower than the points close beside it is a minimum already.
    """
    middle, around = brackets(value)
    fall = np.maximum(around[:, 0], around[:, 2]) - around[:, 1]
    worth = (around[:, 1] - fall <= value.min()) & ~sharp[middle]
    return middle[worth], around[worth]


def _with_corners(curve: Curve, zones: tuple[Zone, ...]) -> tuple[Curve, Array]:
    """The curve with its crossings of the rectangles' diagonals near the zone, and their frequencies."""
    corners = [np.zeros(0)]
    for zone in zones:
        if zone.shape == "rectangle":
            f, value, near = curve.frequency_hz, zone.corner(curve.loop), zone.clearance(curve.loop)
            change = (value[1:] >= 0.0) != (value[:-1] >= 0.0)
            k = np.flatnonzero(change & (np.minimum(near[1:], near[:-1]) < near.min() + 1.0))
            corner = along(curve.source, (zone.corner,), np.zeros(len(k), int))
            found = roots(corner, f[k], f[k + 1], value[k], value[k + 1])
            curve = curve.with_points(found, sample(curve.source, found))
            corners.append(found)
    return curve, np.concatenate(corners)


def _beside(curve: Curve, kinks_hz: Array) -> Curve:
    """The curve with points close to each kink, so that a smooth minimum next to one has a bracket of its own."""
    f = curve.frequency_hz
    k = np.searchsorted(f, kinks_hz)
    k = k[(k > 0) & (k < len(f) - 1)]
    if not len(k):
        return curve
    close = np.concatenate([f[k] - 0.02 * (f[k] - f[k - 1]), f[k] + 0.02 * (f[k + 1] - f[k])])
    return curve.with_points(close, sample(curve.source, close))
