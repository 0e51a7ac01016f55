"""What loops are made to and held to: the tables of objectives and of limits on features of the loop.

Each entry says what to look for on the curves, and how the features found are judged: as parts of
(where, value, limit, excess in dB). A new objective or limit is an entry here, and the name that a case chooses it by
(design/case/schema.py). Limits that belong to no frequency come with the law (`LawVariables.limits`).

A phase counts in decibels as the gain margin for the phase margin: 6 dB for 30 deg, 0.2 dB/deg.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from maxq.control.kernel.records import Array
from maxq.design.case.schema import Limits, ObjectiveName
from maxq.design.laws.task import DB, PlantLimits
from maxq.design.optimise import features
from maxq.design.optimise.curves import Indices
from maxq.design.optimise.features import Cross, Kind, LogLoop, Mask, Search


@dataclass(frozen=True)
class Seen:
    """Features of all loops at a point of the variables; arrays are (features,).

    `mode`: of a bending peak, else 0. `in_first_lobe`: at a frequency where mode 1 of the same plant rules.
    """

    kind: NDArray[np.int8]
    plant: Indices
    mode: Indices
    at: LogLoop
    cross: Cross
    limits: PlantLimits
    in_first_lobe: Mask

    @cached_property
    def gain_db(self) -> Array:
        """|L|."""
        return self.at.value.real * DB

    @cached_property
    def beside_deg(self) -> Array:
        """arg L - 180 deg."""
        return np.asarray(np.degrees(features.wrapped(self.at.value)))

    @cached_property
    def distance_db(self) -> Array:
        """|1 + L| of the nearest approaches to -1, else nan."""
        out, near = self.none.copy(), self.kind == Kind.MODULUS
        out[near] = DB * np.log(np.abs(1.0 + np.exp(self.at.value[near])))
        return out

    @cached_property
    def db_per_deg(self) -> Array:
        return np.radians(self.cross.db_per_rad)

    @cached_property
    def none(self) -> Array:
        """nan: no limit of its own."""
        return np.full(len(self.kind), np.nan)

    def limit(self, name: str) -> Array:
        """Of each feature's plant."""
        return self.limits[name][self.plant]


Part = tuple[Mask, Array, Array, Array]
"""Which features, value, limit, excess (dB); an objective's excess is what is made small. nan: not judged."""


@dataclass(frozen=True)
class Criterion:
    """A row of a kind. `asked` tells whether any plant is held to it; `searches` of its features, if so."""

    text: str
    unit: str
    searches: tuple[Search, ...]
    parts: Callable[[Seen], list[Part]]
    asked: Callable[[PlantLimits, Limits], bool] = lambda limits, common: True


@dataclass(frozen=True)
class Objective:
    """What is made small: the largest value of a criterion, dB, over all plants.

    `about` names the number as it is written into a design; `reached` says it in the unit of a report. `needs_mode`:
    a plant without a first bending mode has none. Of what the law says of wind (`LawLimit.objective`) nothing is looked
    for in the loop.
    """

    criterion: Criterion
    about: str
    reached: Callable[[float], str]
    needs_mode: bool = False


def _peak(name: str, which: Callable[[Indices], Mask]) -> Callable[[Seen], list[Part]]:
    """`name` of the limit; none: an objective."""

    def parts(seen: Seen) -> list[Part]:
        most = seen.limit(name) if name else seen.none
        return [(which(seen.mode), seen.gain_db, most, seen.gain_db - (most if name else 0.0))]

    return parts


def _distance(seen: Seen) -> list[Part]:
    return [(seen.kind == Kind.MODULUS, seen.distance_db, seen.none, -seen.distance_db)]


OBJECTIVES: dict[ObjectiveName, Objective] = {
    "first-mode-peak": Objective(
        Criterion("peak of mode 1", "dB", (features.peaks,), _peak("", lambda mode: mode == 1)),
        about="largest peak of mode 1",
        reached=lambda db: f"largest peak of mode 1 {db:.2f} dB",
        needs_mode=True,
    ),
    "least-margin": Objective(
        Criterion("modulus margin", "dB", (features.approaches,), _distance),
        about="minus the least |1 + L|",
        reached=lambda db: f"least |1 + L| {10.0 ** (-db / 20.0):.3f}",
    ),
    "load": Objective(
        Criterion("load q alpha in wind, rms", "Pa deg", (), lambda _: []),
        about="largest rms of q alpha, in dB over 1 Pa deg",
        reached=lambda db: f"largest rms of q alpha {10.0 ** (db / 20.0):.0f} Pa deg",
    ),
    "bending-moment": Objective(
        Criterion("bending moment in wind, rms", "N m", (), lambda _: []),
        about="largest rms of the bending moment, in dB over 1 N m",
        reached=lambda db: f"largest rms of the bending moment {10.0 ** (db / 20.0):.0f} N m",
    ),
}


def _gain_margin(seen: Seen) -> list[Part]:
    """(44) at every crossing and end, and what approaches 180 deg within the margin without a crossing."""
    least = seen.limit("gain_margin_db")
    crossing = (seen.kind == Kind.GAIN_CROSSING) | (seen.kind == Kind.END)
    turn = (seen.kind == Kind.PHASE_TURN) & (np.abs(seen.gain_db) < least)
    return [
        (crossing, seen.gain_db, least, least - np.abs(seen.gain_db)),
        (turn, seen.beside_deg, seen.none, -np.abs(seen.beside_deg) * seen.db_per_deg),
    ]


def _phase_margin(seen: Seen) -> list[Part]:
    """(45) at every crossing of 0 dB but those of mode 1 with a limit of their own, and what approaches 0 dB."""
    least, own = seen.limit("phase_margin_deg"), ~np.isnan(seen.limit("first_mode_phase_deg"))
    crossing = (seen.kind == Kind.PHASE_CROSSING) & ~(own & seen.in_first_lobe)
    turn = (seen.kind == Kind.GAIN_TURN) & (np.abs(seen.beside_deg) < least)
    return [
        (crossing, seen.beside_deg, least, (least - np.abs(seen.beside_deg)) * seen.db_per_deg),
        (turn, seen.gain_db, seen.none, -np.abs(seen.gain_db)),
    ]


def _first_mode_phase(seen: Seen) -> list[Part]:
    least, inside = seen.limit("first_mode_phase_deg"), (seen.kind == Kind.PHASE_CROSSING) & seen.in_first_lobe
    return [(inside, seen.beside_deg, least, (least - np.abs(seen.beside_deg)) * seen.db_per_deg)]


def _modulus(seen: Seen) -> list[Part]:
    least = seen.limit("modulus_db")
    return [(seen.kind == Kind.MODULUS, seen.distance_db, least, least - seen.distance_db)]


def _zone(seen: Seen) -> list[Part]:
    near = (seen.kind == Kind.ZONE) | (seen.kind == Kind.ZONE_CORNER)
    value = features.zone_value(seen.at.value.real, np.radians(seen.beside_deg), seen.cross)
    return [(near, value, np.ones(len(near)), (1.0 - value) * seen.limit("gain_margin_db"))]


LIMITS: tuple[Criterion, ...] = (
    Criterion("peak of mode 1", "dB", (features.peaks,), _peak("first_mode_db", lambda mode: mode == 1)),
    Criterion("peak of mode 2", "dB", (features.peaks,), _peak("second_mode_db", lambda mode: mode == 2)),
    Criterion("peak of modes 3 and above", "dB", (features.peaks,), _peak("higher_modes_db", lambda mode: mode > 2)),
    Criterion("gain margin", "dB", (features.crossings, features.ends, features.turns), _gain_margin),
    Criterion("phase margin", "deg", (features.crossings, features.turns), _phase_margin),
    Criterion(
        "modulus margin", "dB", (features.approaches,), _modulus, lambda limits, common: limits.asked("modulus_db")
    ),
    Criterion("Nichols zone", "", (features.near_zone,), _zone, lambda limits, common: common.zone != "none"),
    Criterion("phase margin at mode 1", "deg", (features.crossings,), _first_mode_phase),
)
