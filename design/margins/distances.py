"""The distances of the curve from the critical point: disk margins, and exclusion zones in the Nichols plane.

Disk margins bound simultaneous changes of gain and phase (Seiler, Packard & Gahinet, IEEE CSM 40(5), 2020).

Gain and phase margins restrict a curve on two lines only, so that the curve may pass through the corner between them.
Exclusion zones around -180 + 360 k degrees, 0 dB close this gap. The clearance of a zone is -1 at its centre, 0 on its
border and grows linearly outwards. The requirement is a clearance of at least 0. Let psi be the phase relative to the
nearest centre in degrees, y the gain in dB, and a and b the half axes of the zone:

    diamond      |psi|/a + |y|/b - 1
    rectangle    max(|psi|/a, |y|/b) - 1
    ellipse      sqrt((psi/a)^2 + (y/b)^2) - 1
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from maxq.control.kernel.jit import routine
from maxq.control.kernel.records import Array
from maxq.design.margins import solving
from maxq.design.margins.crossings import Crossings
from maxq.design.margins.curve import Trace, is_bracket, merged
from maxq.design.margins.response import LoopResponse
from maxq.design.margins.solving import DB, from_minus_one_deg, log_size, objective, objectives
from maxq.design.model.state_space import ComplexArray

ExclusionShape = Literal["diamond", "rectangle", "ellipse"]


@dataclass(frozen=True)
class Disk:
    """A disk margin: the loop remains stable for any gain in [down, up] and for any phase up to `phase_deg`.

    `size` is the least distance along the curve: |1 + L| (sensitivity), |1 + 1/L| (complementary) or 2 |1 + L|/|1 - L|
    (symmetric). The symmetric size is alpha of Seiler, Packard & Gahinet and is at most 2.
    """

    size: float
    frequency_hz: float
    gain_down_db: float  # both gains are positive, and infinite if the disk does not bound them
    gain_up_db: float
    phase_deg: float


@dataclass(frozen=True)
class Disks:
    sensitivity: Disk  # the modulus margin: 1 / max |S|
    complementary: Disk  # 1 / max |T|
    symmetric: Disk


_NO_DISK = Disk(np.nan, np.nan, np.nan, np.nan, np.nan)
NO_DISKS = Disks(_NO_DISK, _NO_DISK, _NO_DISK)
"""The disks of an unstable loop."""


def disks_of(least: Array) -> Disks:
    """Return the disks from the logarithms and frequencies of the least distances, (3, 2) (`least_distances`)."""
    sizes = [(float(np.exp(log)) if log < 300.0 else np.inf, float(f)) for log, f in least.tolist()]
    (from_s, f_s), (from_t, f_t), both = sizes
    return Disks(
        Disk(from_s, f_s, _db(1.0 + from_s), -_db(1.0 - from_s), _phase_deg(from_s)),
        Disk(from_t, f_t, -_db(1.0 - from_t), _db(1.0 + from_t), _phase_deg(from_t)),
        symmetric_disk(*both),
    )


def symmetric_disk(half: float, frequency_hz: float) -> Disk:
    """Return the symmetric disk from alpha / 2, the least |1 + L| / |1 - L|, and its frequency in Hz."""
    both = -_db((1.0 - half) / (1.0 + half)) if half < 1.0 else np.inf if half >= 1.0 else np.nan
    # alpha / 2 is at most 1, where the disk is a half plane
    half = min(half, 1.0) if half >= 0.0 else half
    return Disk(2.0 * half, frequency_hz, both, both, float(np.degrees(2.0 * np.arctan(half))))


@routine
def least_distances(t: Trace) -> Array:
    """Return the least SENSITIVITY, COMPLEMENTARY and SYMMETRIC objectives and their frequencies in Hz, (3, 2).

    The curve `t` must contain their turning points. The limits at zero and infinite frequency are included.
    """
    out, none, last = np.empty((3, 2)), np.zeros((0, 3)), t.loop[len(t.loop) - 1]
    at_zero = t.at_zero if t.slope_at_zero == 0 else 0.0 if t.slope_at_zero > 0 else 1e150
    for kind in range(3):
        value = objectives(kind, t.loop, none)
        k = int(np.argmin(value))
        out[kind, 0], out[kind, 1] = value[k], t.frequency_hz[k]
        limit = objective(kind, 0.0, complex(at_zero, 0.0), none)
        if limit <= out[kind, 0]:
            out[kind, 0], out[kind, 1] = limit, 0.0
        limit = objective(kind, 0.0, complex(last.real if t.slope_at_end == 0 else 0.0, 0.0), none)
        if not t.finite_end and limit < out[kind, 0]:
            out[kind, 0], out[kind, 1] = limit, np.inf
    return out


def _db(ratio: float) -> float:
    return float(DB * np.log(ratio)) if ratio > 0.0 else -np.inf


def _phase_deg(size: float) -> float:
    return float(np.degrees(2.0 * np.arcsin(size / 2.0))) if size <= 2.0 else np.inf


@dataclass(frozen=True)
class Zone:
    """An exclusion zone with its shape and half axes. Raises ValueError unless both half axes are positive."""

    shape: ExclusionShape = "diamond"
    phase_deg: float = 30.0
    gain_db: float = 6.0

    def __post_init__(self) -> None:
        if self.shape not in ("diamond", "rectangle", "ellipse"):
            raise ValueError(f"zone shape {self.shape!r}: must be diamond, rectangle or ellipse")
        if not (self.phase_deg > 0.0 and self.gain_db > 0.0):
            raise ValueError(f"a zone of {self.phase_deg} deg by {self.gain_db} dB: both must be positive")

    def clearance(self, loop: ComplexArray) -> Array:
        """Return the clearance at each point of L."""
        x = np.abs(from_minus_one_deg(loop)) / self.phase_deg
        y = np.abs(DB * log_size(loop)) / self.gain_db
        if self.shape == "diamond":
            return np.asarray(x + y - 1.0)
        return np.asarray((np.maximum(x, y) if self.shape == "rectangle" else np.hypot(x, y)) - 1.0)


@dataclass(frozen=True)
class Clearance:
    """The least clearance of a zone along the curve, which is negative inside the zone."""

    zone: Zone
    value: float
    frequency_hz: float
    loop: complex


def as_rows(zones: tuple[Zone, ...]) -> Array:
    """Return the zones as an array (zones, 3) for `solving.objective`."""
    shapes = {"diamond": solving.DIAMOND, "rectangle": solving.RECTANGLE, "ellipse": solving.ELLIPSE}
    return np.array([(shapes[z.shape], z.phase_deg, z.gain_db) for z in zones], float).reshape(-1, 3)


@routine
def find_clearances(t: Trace, every: Crossings, zones: Array, source: LoopResponse) -> tuple[Array, ComplexArray]:
    """Return the least clearance of every zone and its frequency in Hz, (zones, 2), and the value of L, (zones,).

    The curve `t` must contain the crossings, since the clearance has kinks at crossings and on diagonals.
    """
    f, loop = t.frequency_hz, t.loop
    corners = _corners(f, loop, zones, source)
    axes = np.concatenate((every.gain_hz, every.phase_hz))
    f, loop, _ = merged(f, loop, corners, source)
    f, loop, _ = merged(f, loop, _beside(f, np.concatenate((axes, corners))), source)
    n, m = len(f), 0
    kinds = np.empty(len(zones) * n, np.int64)
    points, around = np.empty((len(zones) * n, 3)), np.empty((len(zones) * n, 3))
    for z in range(len(zones)):
        kind = solving.CLEARANCE + z
        kinks = axes if zones[z, 0] == solving.DIAMOND else corners if zones[z, 0] == solving.RECTANGLE else axes[:0]
        value = objectives(kind, loop, zones)
        least = value.min()
        for k in range(1, n - 1):
            # the differences to the neighbours bound the improvement; a kink below its neighbours is already a minimum
            if is_bracket(value, k) and 2.0 * value[k] - max(value[k - 1], value[k + 1]) <= least:
                if (kinks == f[k]).any():
                    continue
                kinds[m] = kind
                for p in range(3):
                    points[m, p], around[m, p] = f[k - 1 + p], value[k - 1 + p]
                m += 1
    f, loop, _ = merged(f, loop, solving.minima(kinds[:m], points[:m], around[:m], source, zones), source)
    out, there = np.empty((len(zones), 2)), np.empty(len(zones), np.complex128)
    for z in range(len(zones)):
        value = objectives(solving.CLEARANCE + z, loop, zones)
        k = int(np.argmin(value))
        out[z, 0], out[z, 1], there[z] = value[k], f[k], loop[k]
    return out, there


@routine
def _corners(f: Array, loop: ComplexArray, zones: Array, source: LoopResponse) -> Array:
    """Return the frequencies at which the curve crosses the diagonals of rectangular zones, near each zone."""
    n, m = len(f), 0
    kinds = np.empty(len(zones) * n, np.int64)
    ends, values = np.empty((len(zones) * n, 2)), np.empty((len(zones) * n, 2))
    for z in range(len(zones)):
        if zones[z, 0] != solving.RECTANGLE:
            continue
        value, near = objectives(solving.CORNER - z, loop, zones), objectives(solving.CLEARANCE + z, loop, zones)
        least = near.min()
        for k in range(n - 1):
            if (value[k] >= 0.0) != (value[k + 1] >= 0.0) and min(near[k], near[k + 1]) < least + 1.0:
                kinds[m] = solving.CORNER - z
                ends[m, 0], ends[m, 1], values[m, 0], values[m, 1] = f[k], f[k + 1], value[k], value[k + 1]
                m += 1
    return solving.roots(kinds[:m], ends[:m], values[:m], source, zones)


@routine
def _beside(f: Array, kinks_hz: Array) -> Array:
    """Return frequencies close to each kink, so that a smooth minimum next to a kink has its own bracket."""
    out, m = np.empty(2 * len(kinks_hz)), 0
    for hz in kinks_hz:
        k = np.searchsorted(f, hz)
        if 0 < k < len(f) - 1:
            out[m], out[m + 1] = f[k] - 0.02 * (f[k] - f[k - 1]), f[k] + 0.02 * (f[k + 1] - f[k])
            m += 2
    return out[:m].copy()
