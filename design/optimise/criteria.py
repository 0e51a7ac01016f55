"""The objectives and limits of the optimiser, as tables of quantities of `design.quantities`.

Each entry has the key of its quantity, the searches for features on the curves, and the function that assesses them.
The function returns parts of (features, value, limit, excess in dB). Limits that are independent of frequency belong to
the law (`LawVariables.limits`). A phase is converted to decibels by the ratio of gain margin to phase margin: 6 dB for
30 deg, or 0.2 dB/deg.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from maxq.control.kernel.records import Array
from maxq.design.case.basis import Limits
from maxq.design.case.schema import ObjectiveName
from maxq.design.laws.task import DB, PlantLimits
from maxq.design.optimise import features
from maxq.design.optimise.curves import CurveIndices
from maxq.design.optimise.features import Cross, FeatureKind, FeatureSearch, LogLoop, Mask
from maxq.design.quantities import LAST_MODE, QUANTITIES


@dataclass(frozen=True)
class Seen:
    """The features of all loops at a point of the variables, as arrays (features,).

    `mode` is the number of the bending mode of a peak, and 0 for other features. `weight_db` is the weight of the peak
    (`features.FeatureMode`). `of_first_mode` marks crossings of 0 dB that belong to mode 1 of the same plant.
    """

    kind: NDArray[np.int8]
    plant: CurveIndices
    mode: CurveIndices
    weight_db: Array
    at: LogLoop
    cross: Cross
    limits: PlantLimits
    of_first_mode: Mask

    @cached_property
    def gain_db(self) -> Array:
        """Return |L| at each feature, dB."""
        return self.at.value.real * DB

    @cached_property
    def beside_deg(self) -> Array:
        """Return arg L - 180 deg, wrapped to (-180, 180]."""
        return np.asarray(np.degrees(features.wrapped(self.at.value)))

    @cached_property
    def distance_db(self) -> Array:
        """Return |1 + L| in dB at the nearest approaches to -1, and nan at other features."""
        out, near = self.none.copy(), self.kind == FeatureKind.MODULUS
        out[near] = DB * np.log(np.abs(1.0 + np.exp(self.at.value[near])))
        return out

    @cached_property
    def db_per_deg(self) -> Array:
        return np.radians(self.cross.db_per_rad)

    @cached_property
    def none(self) -> Array:
        """Return nan for all features, for a quantity without a limit of its own."""
        return np.full(len(self.kind), np.nan)

    def limit(self, name: str) -> Array:
        """Return the limit of each feature's plant by its key."""
        return self.limits[name][self.plant]


JudgedFeatures = tuple[Mask, Array, Array, Array]
"""A mask of features, with value, limit and excess (dB) of each. The excess of an objective is the minimised value.
A feature with an excess of nan is not assessed.
"""


@dataclass(frozen=True)
class Criterion:
    """The rows of a quantity of `QUANTITIES`, by its key.

    The `searches` for features are carried out only if `asked` is True, that is, if a plant has the limit.
    """

    key: str
    searches: tuple[FeatureSearch, ...]
    parts: Callable[[Seen], list[JudgedFeatures]]

    @property
    def text(self) -> str:
        return QUANTITIES[self.key].label

    @property
    def unit(self) -> str:
        return QUANTITIES[self.key].unit

    def asked(self, limits: PlantLimits, common: Limits) -> bool:
        """Return True if at least one plant has a limit on the quantity."""
        return common.zone != "none" if self.key == "zone" else limits.asked(self.key)


@dataclass(frozen=True)
class Objective:
    """The objective: the largest value of a criterion over all plants, dB, which is minimised.

    `about` describes the value in a design file, and `reached` formats it in the unit of a report. With `needs_mode`, a
    plant without a first bending mode is an error. An objective of the law in wind (`LawLimit.objective`) needs no
    search of the loop.
    """

    criterion: Criterion
    about: str
    reached: Callable[[float], str]
    needs_mode: bool = False


def _peak(key: str, first: int, last: int) -> Callable[[Seen], list[JudgedFeatures]]:
    """Return the function for the peaks of bending modes `first` to `last`.

    `key` is the key of the limit, or empty for an objective.
    """

    def parts(seen: Seen) -> list[JudgedFeatures]:
        most = seen.limit(key) if key else seen.none
        which = (seen.mode >= first) & (seen.mode <= last)
        peak_db = seen.gain_db + seen.weight_db
        return [(which, peak_db, most, peak_db - (most if key else 0.0))]

    return parts


def _distance(seen: Seen) -> list[JudgedFeatures]:
    return [(seen.kind == FeatureKind.MODULUS, seen.distance_db, seen.none, -seen.distance_db)]


OBJECTIVES: dict[ObjectiveName, Objective] = {
    "first-mode-peak": Objective(
        Criterion("first_mode_db", (features.peaks,), _peak("", 1, 1)),
        about="largest peak of mode 1",
        reached=lambda db: f"largest peak of mode 1 {db:.2f} dB",
        needs_mode=True,
    ),
    "least-margin": Objective(
        Criterion("modulus_db", (features.approaches,), _distance),
        about="minus the least |1 + L|",
        reached=lambda db: f"least |1 + L| {10.0 ** (-db / 20.0):.3f}",
    ),
    "load": Objective(
        Criterion("q_alpha_Padeg", (), lambda _: []),
        about="largest rms of q alpha, in dB over 1 Pa deg",
        reached=lambda db: f"largest rms of q alpha {10.0 ** (db / 20.0):.0f} Pa deg",
    ),
    "bending-moment": Objective(
        Criterion("bending_moment", (), lambda _: []),
        about="largest rms of the bending moment, in dB over 1 N m",
        reached=lambda db: f"largest rms of the bending moment {10.0 ** (db / 20.0):.0f} N m",
    ),
}


def _gain_margin(seen: Seen) -> list[JudgedFeatures]:
    """Return the rows of (44) at every crossing and end of the curve.

    Points that approach 180 deg within the gain margin but do not cross it have rows, too.
    """
    least = seen.limit("gain_margin_db")
    crossing = (seen.kind == FeatureKind.GAIN_CROSSING) | (seen.kind == FeatureKind.END)
    turn = (seen.kind == FeatureKind.PHASE_TURN) & (np.abs(seen.gain_db) < least)
    return [
        (crossing, seen.gain_db, least, least - np.abs(seen.gain_db)),
        (turn, seen.beside_deg, seen.none, -np.abs(seen.beside_deg) * seen.db_per_deg),
    ]


def _phase_margin(seen: Seen) -> list[JudgedFeatures]:
    """Return the rows of (45) at every crossing of 0 dB.

    Points that approach 0 dB within the phase margin but do not cross it have rows, too.
    """
    least, crossing = seen.limit("phase_margin_deg"), seen.kind == FeatureKind.PHASE_CROSSING
    turn = (seen.kind == FeatureKind.GAIN_TURN) & (np.abs(seen.beside_deg) < least)
    return [
        (crossing, seen.beside_deg, least, (least - np.abs(seen.beside_deg)) * seen.db_per_deg),
        (turn, seen.gain_db, seen.none, -np.abs(seen.gain_db)),
    ]


def _first_mode_phase(seen: Seen) -> list[JudgedFeatures]:
    least = seen.limit("first_mode_phase_deg")
    return [(seen.of_first_mode, seen.beside_deg, least, (least - np.abs(seen.beside_deg)) * seen.db_per_deg)]


def _modulus(seen: Seen) -> list[JudgedFeatures]:
    least = seen.limit("modulus_db")
    return [(seen.kind == FeatureKind.MODULUS, seen.distance_db, least, least - seen.distance_db)]


def _zone(seen: Seen) -> list[JudgedFeatures]:
    near = (seen.kind == FeatureKind.ZONE) | (seen.kind == FeatureKind.ZONE_CORNER)
    value = features.zone_value(seen.at.value.real, np.radians(seen.beside_deg), seen.cross)
    return [(near, value, np.ones(len(near)), (1.0 - value) * seen.limit("gain_margin_db"))]


PEAKS = {"first_mode_db": (1, 1), "second_mode_db": (2, 2), "modes_from_2_db": (2, LAST_MODE),
         "modes_from_3_db": (3, LAST_MODE)}  # fmt: skip  # a table
LIMITS: tuple[Criterion, ...] = (
    *(Criterion(key, (features.peaks,), _peak(key, *modes)) for key, modes in PEAKS.items()),
    Criterion("gain_margin_db", (features.crossings, features.ends, features.turns), _gain_margin),
    Criterion("phase_margin_deg", (features.crossings, features.turns), _phase_margin),
    Criterion("modulus_db", (features.approaches,), _modulus),
    Criterion("zone", (features.near_zone,), _zone),
    Criterion("first_mode_phase_deg", (features.crossings,), _first_mode_phase),
)
