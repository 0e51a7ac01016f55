"""What loops are held to."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from maxq.control.kernel.records import Array

Zone = Literal["none", "ellipse", "diamond", "rectangle"]
RigidBody = Literal["paper", "aerodynamic"]


@dataclass(frozen=True)
class Limits:
    """Of one plant; margins hold at every crossing. None: not asked for.

    A violated phase counts in decibels as the gain margin for the phase margin: 6 dB for 30 deg, 0.2 dB/deg.
    """

    gain_margin_db: float = 6.0
    phase_margin_deg: float = 30.0
    modulus_db: float | None = None  # least |1 + L|
    first_mode_db: float | None = None  # largest |L| in the band of mode 1, beside the objective
    second_mode_db: float | None = -6.0  # (43)
    higher_modes_db: float | None = None  # of modes 3 and above
    first_mode_phase_deg: float | None = None  # phase margin at crossings of 0 dB within the band of mode 1
    rigid_hz: float | None = 0.5  # (47)
    rigid_zeta: float | None = 0.7  # (48)


@dataclass(frozen=True)
class CommonLimits:
    """What does not depend on the plant."""

    zone: Zone = "none"  # around -1 in the Nichols plane, half axes gain_margin_db and phase_margin_deg
    filter_gain_at_infinity: float | None = 1.0  # |F(j inf)| (46)
    rigid_body: RigidBody = "paper"


class PlantLimits:
    """Limits of all plants as arrays, (plants,): nan where not asked for."""

    def __init__(self, limits: Sequence[Limits]) -> None:
        def column(name: str) -> Array:
            return np.array([math.nan if getattr(x, name) is None else getattr(x, name) for x in limits], float)

        self.gain_margin_db = column("gain_margin_db")
        self.phase_margin_deg = column("phase_margin_deg")
        self.modulus_db = column("modulus_db")
        self.first_mode_db = column("first_mode_db")
        self.second_mode_db = column("second_mode_db")
        self.higher_modes_db = column("higher_modes_db")
        self.first_mode_phase_deg = column("first_mode_phase_deg")
        self.rigid_hz = column("rigid_hz")
        self.rigid_zeta = column("rigid_zeta")
