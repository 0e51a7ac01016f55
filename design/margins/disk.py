"""Modulus (disk) margins: gain and phase that may change together (Seiler, Packard & Gahinet, IEEE CSM 40(5), 2020)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from maxq.control.kernel.records import Array
from maxq.design.margins.curve import Curve
from maxq.design.margins.objectives import DB, Objective, complementary, sensitivity, symmetric


@dataclass(frozen=True)
class Disk:
    """One disk and what it guarantees: the loop stays stable under any gain in [down, up] and any phase up to this.

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


def find_disks(curve: Curve) -> Disks:
    """Least distances over a curve whose turning points have been solved for."""
    size, f = _least(curve, sensitivity)
    from_s = Disk(size, f, _db(1.0 + size), -_db(1.0 - size), _phase_deg(size))
    size, f = _least(curve, complementary)
    from_t = Disk(size, f, -_db(1.0 - size), _db(1.0 + size), _phase_deg(size))
    half, f = _least(curve, symmetric)
    both = -_db((1.0 - half) / (1.0 + half))
    # |1 + L| < |1 - L| only where Re L < 0: elsewhere the disk is the half plane
    half = min(half, 1.0)
    return Disks(from_s, from_t, Disk(2.0 * half, f, both, both, float(np.degrees(2.0 * np.arctan(half)))))


def _least(curve: Curve, objective: Objective) -> tuple[float, float]:
    """The least distance and its frequency: 0 and infinity are limits."""
    value: Array = objective(curve.loop)
    k = int(np.argmin(value))
    found = [(float(value[k]), float(curve.frequency_hz[k]))]
    for limit, f in ((curve.at_zero_limit, 0.0), (curve.at_end_limit, np.inf)):
        if limit is not None:
            found.append((float(objective(np.array([limit]))[0]), f))
    least, f = min(found)
    return float(np.exp(least)) if least < 300.0 else np.inf, f


def _db(ratio: float) -> float:
    return float(DB * np.log(ratio)) if ratio > 0.0 else -np.inf


def _phase_deg(size: float) -> float:
    return float(np.degrees(2.0 * np.arcsin(size / 2.0))) if size <= 2.0 else np.inf
