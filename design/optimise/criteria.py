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
from maxq.design.case.goals import TRANSFERS, GoalSection
from maxq.design.case.schema import ObjectiveName
from maxq.design.laws.task import DB, PlantLimits
from maxq.design.model.state_space import ComplexArray
from maxq.design.optimise import features
from maxq.design.optimise.curves import CurveIndices
from maxq.design.optimise.features import Cross, FeatureKind, FeatureSearch, LogLoop, Mask
from maxq.design.optimise.templates import TemplateBands
from maxq.design.quantities import LAST_MODE, QUANTITIES, Quantity, Sense


@dataclass(frozen=True)
class Seen:
    """The features of all loops at a point of the variables, as arrays (features,).

    `mode` is the number of the bending mode of a peak, and 0 for other features. `weight_db` is the weight of the peak
    (`features.FeatureMode`). `of_first_mode` marks crossings of 0 dB that belong to mode 1 of the same plant. `goal` is
    the index of the goal of a template, or -1, `bound_db` the template there, and `sign` its sign (`TemplateBands`).
    """

    kind: NDArray[np.int8]
    plant: CurveIndices
    mode: CurveIndices
    weight_db: Array
    at: LogLoop
    cross: Cross
    limits: PlantLimits
    of_first_mode: Mask
    x: Array  # ln f
    goal: CurveIndices
    bound_db: Array
    sign: Array

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

    @cached_property
    def delay_ms(self) -> Array:
        """Return the delay that turns L at each feature to -180 deg, ms."""
        return np.asarray(1e3 * np.mod(self.beside_deg, 360.0) / 360.0 / np.exp(self.x))


JudgedFeatures = tuple[Mask, Array, Array, Array]
"""A mask of features, with value, limit and excess (dB) of each. The excess of an objective is the minimised value.
A feature with an excess of nan is not assessed.
"""


@dataclass(frozen=True)
class Criterion:
    """The rows of a quantity of `QUANTITIES`, by its key.

    The `searches` for features are carried out only if `asked` is True, that is, if a plant has the limit. A criterion
    of the objective has a `term` (`Problem`), and a limit -1. `weight` multiplies the excess. `goal` is the goal that
    it represents. `slopes` replaces `features.sensitivity` for a quantity with another gradient.
    """

    key: str
    searches: tuple[FeatureSearch, ...]
    parts: Callable[[Seen], list[JudgedFeatures]]
    term: int = -1
    weight: float = 1.0
    goal: GoalSection | None = None
    slopes: Callable[[LogLoop, Array], ComplexArray] | None = None  # of (ln L, ln f)

    @property
    def about(self) -> Quantity:
        return QUANTITIES[self.key] if self.goal is None else self.goal.about

    @property
    def text(self) -> str:
        return self.about.label

    @property
    def unit(self) -> str:
        return self.about.unit

    @property
    def sense(self) -> Sense:
        """Return ">=" if a larger value is better, else "<="."""
        lower = self.goal is not None and self.goal.quantity in TRANSFERS and self.goal.template[1] < 0.0
        return ">=" if lower else self.about.sense

    @property
    def objective(self) -> bool:
        return self.term >= 0

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

    criterion: Criterion | None  # None for soft goals
    about: str
    reached: Callable[[float], str]
    needs_mode: bool = False


Assessment = Callable[[Seen, Array], list[JudgedFeatures]]
"""The function of a quantity, of the features and of the limit at each feature."""


def _peak(first: int, last: int) -> Assessment:
    """Return the function for the peaks of bending modes `first` to `last`."""

    def parts(seen: Seen, most: Array) -> list[JudgedFeatures]:
        peak_db = seen.gain_db + seen.weight_db
        return [((seen.mode >= first) & (seen.mode <= last), peak_db, most, peak_db - most)]

    return parts


def _modulus(seen: Seen, least: Array) -> list[JudgedFeatures]:
    return [(seen.kind == FeatureKind.MODULUS, seen.distance_db, least, least - seen.distance_db)]


def _without_limit(assessment: Assessment) -> Callable[[Seen], list[JudgedFeatures]]:
    """Return the function of an objective, whose excess is its value."""

    def parts(seen: Seen) -> list[JudgedFeatures]:
        each = assessment(seen, np.zeros(len(seen.kind)))
        return [(which, value, seen.none, excess) for which, value, _, excess in each]

    return parts


OBJECTIVES: dict[ObjectiveName, Objective] = {
    "first-mode-peak": Objective(
        Criterion("first_mode_db", (features.peaks,), _without_limit(_peak(1, 1)), 0),
        about="largest peak of mode 1",
        reached=lambda db: f"largest peak of mode 1 {db:.2f} dB",
        needs_mode=True,
    ),
    "least-margin": Objective(
        Criterion("modulus_db", (features.approaches,), _without_limit(_modulus), 0),
        about="minus the least |1 + L|",
        reached=lambda db: f"least |1 + L| {10.0 ** (-db / 20.0):.3f}",
    ),
    "load": Objective(
        Criterion("q_alpha_Padeg", (), lambda _: [], 0),
        about="largest rms of q alpha, in dB over 1 Pa deg",
        reached=lambda db: f"largest rms of q alpha {10.0 ** (db / 20.0):.0f} Pa deg",
    ),
    "bending-moment": Objective(
        Criterion("bending_moment", (), lambda _: [], 0),
        about="largest rms of the bending moment, in dB over 1 N m",
        reached=lambda db: f"largest rms of the bending moment {10.0 ** (db / 20.0):.0f} N m",
    ),
    "goals": Objective(None, about="soft goals, in dB", reached=lambda db: f"soft goals {db:.3f} dB"),
}


def _gain_margin(seen: Seen, least: Array) -> list[JudgedFeatures]:
    """Return the rows of (44) at every crossing and end of the curve.

    Points that approach 180 deg within the gain margin but do not cross it have rows, too.
    """
    crossing = (seen.kind == FeatureKind.GAIN_CROSSING) | (seen.kind == FeatureKind.END)
    turn = (seen.kind == FeatureKind.PHASE_TURN) & (np.abs(seen.gain_db) < least)
    return [
        (crossing, seen.gain_db, least, least - np.abs(seen.gain_db)),
        (turn, seen.beside_deg, seen.none, -np.abs(seen.beside_deg) * seen.db_per_deg),
    ]


def _gain_side(sign: float) -> Assessment:
    """Return the function of the upper (`sign` 1) or the lower (-1) gain margin."""

    def parts(seen: Seen, least: Array) -> list[JudgedFeatures]:
        ((which, value, limit, excess), *_) = _gain_margin(seen, least)
        return [(which & (sign * seen.gain_db < 0.0), value, limit, excess)]

    return parts


def _phase_margin(seen: Seen, least: Array) -> list[JudgedFeatures]:
    """Return the rows of (45) at every crossing of 0 dB.

    Points that approach 0 dB within the phase margin but do not cross it have rows, too.
    """
    crossing = seen.kind == FeatureKind.PHASE_CROSSING
    turn = (seen.kind == FeatureKind.GAIN_TURN) & (np.abs(seen.beside_deg) < least)
    return [
        (crossing, seen.beside_deg, least, (least - np.abs(seen.beside_deg)) * seen.db_per_deg),
        (turn, seen.gain_db, seen.none, -np.abs(seen.gain_db)),
    ]


def _first_mode_phase(seen: Seen, least: Array) -> list[JudgedFeatures]:
    return [(seen.of_first_mode, seen.beside_deg, least, (least - np.abs(seen.beside_deg)) * seen.db_per_deg)]


def _delay(seen: Seen, least: Array) -> list[JudgedFeatures]:
    with np.errstate(divide="ignore"):
        excess = DB * np.log(least / seen.delay_ms)
    return [(seen.kind == FeatureKind.PHASE_CROSSING, seen.delay_ms, least, excess)]


def _delay_slopes(at: LogLoop, x: Array) -> ComplexArray:
    """Return the factors c of the delay, as in `features.sensitivity`. With the phase p, the delay is p / (2 pi f)."""
    del x
    phase = np.mod(features.wrapped(at.value), 2.0 * np.pi)
    by_x = (at.first.imag / phase - 1.0) / at.first.real
    return np.asarray(-DB * (-1j / phase - by_x))


def _zone(seen: Seen) -> list[JudgedFeatures]:
    near = (seen.kind == FeatureKind.ZONE) | (seen.kind == FeatureKind.ZONE_CORNER)
    value = features.zone_value(seen.at.value.real, np.radians(seen.beside_deg), seen.cross)
    return [(near, value, np.ones(len(near)), (1.0 - value) * seen.limit("gain_margin_db"))]


def _over_template(seen: Seen, number: Array) -> list[JudgedFeatures]:
    """Return the rows of the template of goal `number`, with the magnitude as value."""
    value_db = DB * features.transfer(seen.kind, seen.at)[0].real
    return [(seen.goal == number, value_db, seen.bound_db, seen.sign * (value_db - seen.bound_db))]


PEAKS = {"first_mode_db": (1, 1), "second_mode_db": (2, 2), "modes_from_2_db": (2, LAST_MODE),
         "modes_from_3_db": (3, LAST_MODE)}  # fmt: skip  # a table
ASSESSED: dict[str, tuple[tuple[FeatureSearch, ...], Assessment]] = {
    **{key: ((features.peaks,), _peak(*modes)) for key, modes in PEAKS.items()},
    "gain_margin_db": ((features.crossings, features.ends, features.turns), _gain_margin),
    "phase_margin_deg": ((features.crossings, features.turns), _phase_margin),
    "modulus_db": ((features.approaches,), _modulus),
    "zone": ((features.near_zone,), lambda seen, _: _zone(seen)),
    "first_mode_phase_deg": ((features.crossings,), _first_mode_phase),
    "gain_up_db": ((features.crossings, features.ends), _gain_side(1.0)),
    "gain_down_db": ((features.crossings, features.ends), _gain_side(-1.0)),
    "delay_ms": ((features.crossings,), _delay),
}
"""The searches and the function of each quantity of the loop."""
GOALS_ONLY = ("gain_up_db", "gain_down_db", "delay_ms")


def _limit(key: str) -> Criterion:
    searches, assessment = ASSESSED[key]
    return Criterion(key, searches, lambda seen: assessment(seen, seen.limit(key) if key != "zone" else seen.none))


LIMITS: tuple[Criterion, ...] = tuple(_limit(key) for key in ASSESSED if key not in GOALS_ONLY)


def criterion_of(goal: GoalSection, number: int, term: int, applies: Mask, bands: TemplateBands) -> Criterion:
    """Return the form of goal `number` of a case in the optimiser.

    `applies` selects its plants, and `term` is its term in the objective, or -1. A soft goal without a target has the
    target 0 dB.
    """
    weight = goal.weight or 1.0
    if goal.quantity in TRANSFERS:
        parts = lambda seen: _over_template(seen, np.asarray(number))  # noqa: E731  # short
        return Criterion(goal.quantity, (bands.search,), parts, term, weight, goal)
    searches, assessment = ASSESSED[goal.quantity]
    target, stated = goal.limit or 0.0, goal.limit is not None

    def parts_of(seen: Seen) -> list[JudgedFeatures]:
        here = applies[seen.plant]
        limit = np.where(here, target, np.nan)
        each = assessment(seen, limit)
        return [(which & here, value, limit if stated else seen.none, excess) for which, value, limit, excess in each]

    slopes = _delay_slopes if goal.quantity == "delay_ms" else None
    return Criterion(goal.quantity, searches, parts_of, term, weight, goal, slopes)
