"""The problem (42) to (50) at a point of the variables: every peak, crossing and limit, with gradients.

All quantities are in decibels. A phase is converted by the ratio of gain margin to phase margin (6 dB for 30 deg:
0.2 dB/deg), so that violations of different limits are comparable.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from maxq.control.kernel.records import Array
from maxq.design.case.basis import Limits
from maxq.design.case.goals import TRANSFERS
from maxq.design.laws.law import LawLimit, LimitValues
from maxq.design.laws.task import DB, PlantLimits
from maxq.design.model.state_space import ComplexArray
from maxq.design.optimise import features
from maxq.design.optimise.criteria import LIMITS, Criterion, JudgedFeatures, Objective, Seen
from maxq.design.optimise.curves import CurveIndices, Curves
from maxq.design.optimise.features import (
    Bands,
    Cross,
    CurveMesh,
    FeatureKind,
    FeatureMode,
    FeatureSearch,
    LogLoop,
    Mask,
    MeshPlaces,
    joined,
)
from maxq.design.optimise.loops import Loops
from maxq.design.optimise.response_goals import ResponseGoal, ResponseGoals
from maxq.design.optimise.templates import TemplateBands

FARTHEST_DB = 20.0  # rows that meet their limit by a larger margin are omitted
NO_ROW_DB = -1e3  # level of a term of the objective without a row
MISSED_DB = 1e-4  # largest violation that counts as met at a plant or instant outside the problem


@dataclass(frozen=True)
class ProblemRows:
    """The rows of a problem.

    `excess_db` of a limit is at most 0 if the limit is met. For an objective it is the value itself. `what` is the
    index in `Problem.kinds`. `term` is the term of the objective, or -1 for a limit. `own` is the gradient with respect
    to the own parameters of the plant. `feature` (the kind, or -1 for none), `cell`, `x`, `fixed` and `tilt` are the
    data to find a feature again after a small change. A row without a feature has the index of `law.LimitValues` as
    `cell`.
    """

    what: NDArray[np.int8]
    plant: CurveIndices  # -1 for the law itself
    value: Array  # in the unit of the limit: dB, deg, Hz, ratio
    limit: Array  # nan for a row without a limit
    excess_db: Array
    term: NDArray[np.int8]
    own: Array
    feature: NDArray[np.int8]
    cell: CurveIndices
    x: Array  # ln f
    fixed: Mask
    tilt: Array

    def __len__(self) -> int:
        return len(self.what)

    def taken(self, which: CurveIndices | Mask) -> ProblemRows:
        return ProblemRows(*(getattr(self, f.name)[which] for f in fields(self)))

    @property
    def objective(self) -> Mask:
        """Return True for the rows of the objective."""
        return np.asarray(self.term >= 0)

    @property
    def keys(self) -> list[tuple[bool, int, int]]:
        """Return a key of each row: True for a limit, `what` and `plant`."""
        return list(zip((~self.objective).tolist(), self.what.tolist(), self.plant.tolist(), strict=True))

    @property
    def frequency_hz(self) -> Array:
        """Return the frequencies, with nan for rows that are independent of frequency."""
        return np.exp(np.where(self.feature >= 0, self.x, np.nan))


def law_rows(what: int, of: LimitValues, term: int = -1, weight: float = 1.0) -> ProblemRows:
    """Return the rows of a limit that is independent of frequency, or of a term of the objective."""
    n, index = len(of.value), of.index
    return ProblemRows(
        what=np.full(n, what, np.int8),
        plant=of.plant,
        value=of.value,
        limit=of.limit,
        excess_db=weight * of.excess_db,
        term=np.full(n, term, np.int8),
        own=weight * of.gradient,
        feature=np.full(n, -1, np.int8),
        cell=np.zeros(n, np.int64) if index is None else index,
        x=np.zeros(n) if index is None else index.astype(float),
        fixed=np.ones(n, bool),
        tilt=np.zeros(n),
    )


@dataclass(frozen=True)
class ProblemAtPoint:
    """The problem at a point. `gradient` (rows, variables) is the gradient of each row's excess.

    `levels_db` (terms,) is the largest value of each term of the objective, and `objective_db` their sum.
    """

    variables: Array
    rows: ProblemRows
    gradient: Array
    levels_db: Array
    violation_db: float  # largest excess of a limit, or 0 if every limit is met
    unstable: int  # unstable closed-loop poles over all plants

    @cached_property
    def objective_db(self) -> float:
        return float(self.levels_db.sum())

    @property
    def over_db(self) -> Array:
        """Return the excess of each row: of a limit, and of a row of the objective over the largest of its term."""
        return self.rows.excess_db - level_of(self.rows, self.levels_db)


def level_of(rows: ProblemRows, levels_db: Array, limit_db: float = 0.0) -> Array:
    """Return the level of the term of each row, and `limit_db` for a limit."""
    return np.where(rows.objective, levels_db[np.maximum(rows.term, 0)], limit_db)


@dataclass(frozen=True)
class ProblemGoals:
    """The goals of a case (`[[goal]]`) in the form of the optimiser, and the number of terms of the objective."""

    criteria: tuple[Criterion, ...]
    bands: TemplateBands
    responses: ResponseGoals
    terms: int


class Problem:
    """The loops with an objective and limits. The variables are those of the law."""

    def __init__(
        self, loops: Loops, bands: Bands, limits: PlantLimits, common: Limits, objective: Objective, goals: ProblemGoals
    ) -> None:
        """Set up the problem.

        `limits` are those of each plant. `common` are the limits of the case that are equal for all plants.
        """
        self.loops, self.bands, self.limits, self.law = loops, bands, limits, loops.law
        self.lower, self.upper = self.law.lower, self.law.upper
        self.templates, self.responses, self.terms = goals.bands, goals.responses, goals.terms
        limited = [limit for limit in LIMITS if limit.asked(limits, common)]
        made_small = [] if objective.criterion is None else [objective.criterion]
        self.criteria = [*made_small, *limited, *goals.criteria]
        self._own: list[LawLimit | ResponseGoal] = [
            *self.law.limits,
            *self.responses.limits,
        ]  # kinds of rows without a feature
        self.kinds: list[Criterion | LawLimit | ResponseGoal] = [*self.criteria, *self._own]
        self._weights = np.array([kind.weight for kind in self.criteria])
        self._searches: list[FeatureSearch] = list(
            dict.fromkeys(
                search for criterion in (*limited, *made_small, *goals.criteria) for search in criterion.searches
            )
        ) or [features.ends]
        gain_db, phase_deg = (limits.axes(key) for key in ("gain_margin_db", "phase_margin_deg"))
        self.cross = Cross(gain_db / DB, np.radians(phase_deg), common.zone)
        self._mesh_cross = self.cross.of(loops.curves.plant)
        self.evaluations = 0

    @property
    def size(self) -> int:
        """Return the number of variables."""
        return len(self.lower)

    def matters_db(self, worse_db: float) -> Array:
        """Return the excess above which a row matters at a plant outside the problem, (kinds,).

        It is MISSED_DB for a limit, and `worse_db` for the objective.
        """
        return np.where([kind.objective for kind in self.kinds], worse_db, MISSED_DB)

    def what(self, text: str) -> int:
        """Return the index in `kinds` of the limit with the given text."""
        return next(k for k, kind in enumerate(self.kinds) if kind.text == text and not kind.objective)

    def unstable_plants(self, variables: Array) -> CurveIndices:
        """Return the indices of the plants with an unstable closed loop."""
        return np.flatnonzero(self.loops.unstable_poles(self.loops.response(variables))).astype(np.int64)

    def evaluate(self, variables: Array, complete: bool = False) -> ProblemAtPoint:
        """Return the problem at a point.

        `complete` includes rows that meet their limit by a large margin. Raises ValueError for variables that are not
        finite, and for a problem without rows.
        """
        if not np.isfinite(variables).all():
            raise ValueError("variables are not finite")
        self.evaluations += 1
        own, loop, curves = self.law.own(variables), self.loops.response(variables), self.loops.curves
        mesh = CurveMesh(curves, self.bands, loop, self._mesh_cross, self.loops.poles_at_zero == 0)
        places = features.in_intervals(curves, joined([search(mesh) for search in self._searches]))
        plant = curves.plant[places.cell]
        x, at = self.loops.refined(own[plant], places, self.cross.of(plant))
        places = replace(places, x=x)
        mode, weight_db, peak = np.zeros(len(x), np.int64), np.zeros(len(x)), places.kind == FeatureKind.PEAK
        mode[peak], weight_db[peak] = self.bands.mode[places.tag[peak]], self.bands.weight_db[places.tag[peak]]
        of_goal, bound_db, sign = np.full(len(x), -1, np.int64), np.full(len(x), np.nan), np.ones(len(x))
        over = places.kind >= FeatureKind.OVER_S
        tag = places.tag[over]
        of_goal[over], sign[over] = self.templates.goal[tag], self.templates.sign[tag]
        bound_db[over] = DB * self.templates.at(tag, x[over])
        first = places.kind == FeatureKind.PHASE_CROSSING
        first[first] = self.bands.own_crossings(1, plant[first], x[first], np.exp(at.value[first]), loop)
        cross = self.cross.of(plant)
        of_template = (x, of_goal, bound_db, sign)
        seen = Seen(places.kind, plant, mode, weight_db, at, cross, self.limits, first, *of_template)
        parts = [self._feature_rows(seen, places, math.inf if complete else FARTHEST_DB)]
        for number, values in self._limit_values(own):
            limit = self._own[number]
            term = limit.term if limit.objective else -1
            parts.append(law_rows(len(self.criteria) + number, values, term, limit.weight if term >= 0 else 1.0))
        rows = joined(parts)
        if not len(rows):
            raise ValueError("the problem has neither an objective nor limits")
        limits = rows.excess_db[~rows.objective]
        levels_db = np.full(self.terms, NO_ROW_DB)
        np.maximum.at(levels_db, rows.term[rows.objective], rows.excess_db[rows.objective])
        return ProblemAtPoint(
            variables,
            rows,
            np.matmul(rows.own[:, None, :], self.law.jacobian(variables)[rows.plant])[:, 0],
            levels_db,
            float(limits.max(initial=0.0)),
            int(self.loops.unstable_poles(loop).sum()),
        )

    def _limit_values(self, own: Array) -> Iterator[tuple[int, LimitValues]]:
        """Yield the values of all limits without features, with their number in `_own`."""
        for values in self.law.limit_values(own):
            yield values.number, values
        for values in self.responses.values(own):
            yield len(self.law.limits) + values.number, values

    def _feature_rows(self, seen: Seen, places: MeshPlaces, farthest_db: float) -> ProblemRows:
        """Return the rows of features by all criteria.

        Rows that meet their limit by more than `farthest_db` are omitted.
        """
        kept: list[tuple[CurveIndices, int, JudgedFeatures]] = []
        for what, criterion in enumerate(self.criteria):
            for where, value, limit, unweighted in criterion.parts(seen):
                excess = unweighted if criterion.weight == 1.0 else criterion.weight * unweighted
                worst = float(excess[where].max(initial=-np.inf)) if criterion.objective else 0.0
                part = where, value, limit, excess
                kept.append((np.flatnonzero(where & (excess > worst - farthest_db)), what, part))
        kept = kept or [(np.zeros(0, np.int64), 0, (seen.none > 0.0, seen.none, seen.none, seen.none))]
        i = np.concatenate([which for which, _, _ in kept])
        kinds = np.concatenate([np.full(len(which), what, np.int8) for which, what, _ in kept])
        value, limit, excess = (np.concatenate([part[k][which] for which, _, part in kept]) for k in (1, 2, 3))
        plant, kind = seen.plant[i], seen.kind[i]
        at = seen.at.taken(i)
        c = self._sensitivity(kinds, kind, at, seen.x[i], self.cross.of(plant), seen.sign[i])
        terms = np.array([criterion.term for criterion in self.criteria], np.int8)
        return ProblemRows(
            kinds,
            plant,
            value,
            limit,
            excess,
            terms[kinds] if len(terms) else np.zeros(0, np.int8),
            np.asarray((c[:, None] * self.loops.own_gradient(at)).real),
            kind,
            places.cell[i],
            places.x[i],
            places.fixed[i],
            places.tilt[i],
        )

    def _sensitivity(
        self, what: NDArray[np.int8], kind: NDArray[np.int8], at: LogLoop, x: Array, cross: Cross, sign: Array
    ) -> ComplexArray:
        """Return the factors c, (rows,), for which Re(c d ln L) is the change of each row's excess, dB."""
        c = features.sensitivity(kind, at, cross)
        for k, criterion in enumerate(self.criteria):
            mine = np.flatnonzero(what == k) if criterion.slopes is not None else ()
            if criterion.slopes is not None and len(mine):
                c[mine] = criterion.slopes(at.taken(np.asarray(mine)), x[mine])
        return np.asarray(c * sign * self._weights[what]) if len(self._weights) else c

    # --- curvature
    def curvature(self, at: ProblemAtPoint, multipliers: Array, step: float = 1e-5) -> Array:
        """Return the second derivatives (variables, variables) of the sum of rows weighted with `multipliers`.

        They are finite differences of the analytic gradient. A row depends only on the own parameters of its plant. The
        own parameters of all plants are therefore changed at once, and the number of gradient evaluations is
        independent of the number of plants.
        """
        law, n = self.law, self.law.own_size
        own = law.own(at.variables)
        rows, weight = at.rows.taken(multipliers > 0.0), multipliers[multipliers > 0.0]
        moves = np.concatenate([np.eye(n), -np.eye(n)]) * step
        again = self._own_again(rows, own, moves)
        change = weight[:, None] * (again[:n] - again[n:]) / (2.0 * step)  # (moves, rows, own)
        by_own, slopes = np.zeros((len(own), n, n)), np.zeros((len(own), n))
        np.add.at(by_own, rows.plant, change.transpose(1, 0, 2))
        np.add.at(slopes, rows.plant, weight[:, None] * rows.own)
        jacobian = law.jacobian(at.variables)
        out = np.matmul(jacobian.transpose(0, 2, 1), np.matmul(by_own, jacobian)).sum(axis=0)
        out += law.bend(at.variables, slopes)
        return np.asarray(0.5 * (out + out.T))

    def _own_again(self, rows: ProblemRows, own: Array, moves: Array) -> Array:
        """Return the gradients of the same rows with respect to the own parameters after `moves` of them.

        The shape is (moves, rows, own).
        """
        count = len(moves)
        out = np.repeat(rows.own[None], count, axis=0)
        i = np.flatnonzero(rows.feature >= 0)
        if len(i) > 0:
            again, move = np.tile(i, count), np.repeat(np.arange(count), len(i))
            plant, none = rows.plant[again], np.zeros(len(again), np.int64)
            kept = (rows.feature[again], rows.cell[again], rows.x[again], none, rows.fixed[again], rows.tilt[again])
            places, cross = MeshPlaces(*kept), self.cross.of(plant)
            x, at = self.loops.refined(own[plant] + moves[move], places, cross)
            what = rows.what[again]
            lower = [c.key in TRANSFERS and c.sense == ">=" for c in self.criteria]
            sign = np.where(lower, -1.0, 1.0)[what]
            c = self._sensitivity(what, places.kind, at, x, cross, sign)
            out[:, i] = (c[:, None] * self.loops.own_gradient(at)).real.reshape(count, len(i), -1)
        if not all(limit.linear for limit in self.law.limits):
            for m, moved in enumerate(moves):
                for values in self.law.limit_values(own + moved):
                    k = np.flatnonzero(rows.what == len(self.criteria) + values.number)
                    by = values.gradient[[int(np.flatnonzero(values.plant == p)[0]) for p in rows.plant[k]]]
                    limit = self.law.limits[values.number]
                    out[m, k] = by * (limit.weight if limit.objective else 1.0)
        first = len(self.criteria) + len(self.law.limits)
        for m, moved in enumerate(moves if len(self.responses.limits) else ()):
            for number, goal in enumerate(self.responses.limits):  # in this order, for the sake of kept responses
                if len(k := np.flatnonzero(rows.what == first + number)):
                    by = self.responses.again(number, own + moved, rows.plant[k], rows.cell[k])
                    out[m, k] = by * (goal.weight if goal.objective else 1.0)
        return out


def bands_of(curves: Curves, modes: Sequence[Sequence[FeatureMode]]) -> Bands:
    """Return the bands of every plant's modes as mesh points. Their ends are among the kept points of `Curves`."""
    found, each = [], []
    for p, mine in enumerate(modes):
        begin, end = int(curves.start[p]), int(curves.start[p + 1])
        for mode in mine:
            hz = np.array([*mode.band_hz, mode.centre_hz])
            found.append([*(begin + np.abs(curves.frequency_hz[begin:end, None] - hz).argmin(axis=0)).tolist(), p])
            each.append(mode)
    columns = np.array(found, np.int64).reshape(-1, 4).T
    return Bands(columns[0], columns[1], columns[2], columns[3], tuple(each))
