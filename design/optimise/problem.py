"""The problem (42) to (50) at a point of the variables: every peak, crossing and limit, with gradients.

All quantities are in decibels. A phase is converted by the ratio of gain margin to phase margin (6 dB for 30 deg:
0.2 dB/deg), so that violations of different limits are comparable.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
from numpy.typing import NDArray

from maxq.control.kernel.records import Array
from maxq.design.case.basis import Limits
from maxq.design.laws.law import LawLimit, LimitValues
from maxq.design.laws.task import DB, PlantLimits
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
    Mask,
    MeshPlaces,
    joined,
)
from maxq.design.optimise.loops import Loops

FARTHEST_DB = 20.0  # rows that meet their limit by a larger margin are omitted
MISSED_DB = 1e-4  # largest violation that counts as met at a plant or instant outside the problem


@dataclass(frozen=True)
class ProblemRows:
    """The rows of a problem.

    `excess_db` of a limit is at most 0 if the limit is met. For an objective it is the value itself. `what` is the
    index in `Problem.kinds`. `own` is the gradient with respect to the own parameters of the plant. `feature` (the
    kind, or -1 for none), `cell`, `x` and `fixed` are the data to find a feature again after a small change.
    """

    what: NDArray[np.int8]
    plant: CurveIndices  # -1 for the law itself
    value: Array  # in the unit of the limit: dB, deg, Hz, ratio
    limit: Array  # nan for a row without a limit
    excess_db: Array
    objective: Mask
    own: Array
    feature: NDArray[np.int8]
    cell: CurveIndices
    x: Array  # ln f
    fixed: Mask

    def __len__(self) -> int:
        return len(self.what)

    def taken(self, which: CurveIndices | Mask) -> ProblemRows:
        return ProblemRows(*(getattr(self, f.name)[which] for f in fields(self)))

    @property
    def keys(self) -> list[tuple[bool, int, int]]:
        """Return a key of each row: True for a limit, `what` and `plant`."""
        return list(zip((~self.objective).tolist(), self.what.tolist(), self.plant.tolist(), strict=True))

    @property
    def frequency_hz(self) -> Array:
        """Return the frequencies, with nan for rows that are independent of frequency."""
        return np.where(self.feature >= 0, np.exp(self.x), np.nan)


def law_rows(what: int, of: LimitValues, objective: bool = False) -> ProblemRows:
    """Return the rows of the law's limits, which are independent of frequency. A limit may be the objective."""
    n = len(of.value)
    return ProblemRows(
        what=np.full(n, what, np.int8),
        plant=of.plant,
        value=of.value,
        limit=of.limit,
        excess_db=of.excess_db,
        objective=np.full(n, objective),
        own=of.gradient,
        feature=np.full(n, -1, np.int8),
        cell=np.zeros(n, np.int64),
        x=np.zeros(n),
        fixed=np.ones(n, bool),
    )


@dataclass(frozen=True)
class ProblemAtPoint:
    """The problem at a point. `gradient` (rows, variables) is the gradient of each row's excess."""

    variables: Array
    rows: ProblemRows
    gradient: Array
    objective_db: float
    violation_db: float  # largest excess of a limit, or 0 if every limit is met
    unstable: int  # unstable closed-loop poles over all plants


class Problem:
    """The loops with an objective and limits. The variables are those of the law."""

    def __init__(self, loops: Loops, bands: Bands, limits: PlantLimits, common: Limits, objective: Objective) -> None:
        """Set up the problem.

        `limits` are those of each plant. `common` are the limits of the case that are equal for all plants.
        """
        self.loops, self.bands, self.limits, self.law = loops, bands, limits, loops.law
        self.lower, self.upper = self.law.lower, self.law.upper
        self.criteria = [objective.criterion, *LIMITS]
        self.kinds: list[Criterion | LawLimit] = [*self.criteria, *self.law.limits]
        self._asked = [True, *(limit.asked(limits, common) for limit in LIMITS)]
        asked = [limit for limit, yes in zip(LIMITS, self._asked[1:], strict=True) if yes]
        self._searches: list[FeatureSearch] = list(
            dict.fromkeys(search for criterion in (*asked, objective.criterion) for search in criterion.searches)
        )
        self.cross = Cross(limits["gain_margin_db"] / DB, np.radians(limits["phase_margin_deg"]), common.zone)
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
        made_small = [k == 0 or getattr(kind, "objective", False) for k, kind in enumerate(self.kinds)]
        return np.where(made_small, worse_db, MISSED_DB)

    def what(self, text: str) -> int:
        """Return the index in `kinds` of the limit with the given text."""
        return next(k for k, kind in enumerate(self.kinds) if kind.text == text and k > 0)

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
        first = places.kind == FeatureKind.PHASE_CROSSING
        first[first] = self.bands.own_crossings(1, plant[first], x[first], np.exp(at.value[first]), loop)
        seen = Seen(places.kind, plant, mode, weight_db, at, self.cross.of(plant), self.limits, first)
        parts = [self._feature_rows(seen, places, math.inf if complete else FARTHEST_DB)]
        for values in self.law.limit_values(own):
            made_small = self.law.limits[values.number].objective
            parts.append(law_rows(len(self.criteria) + values.number, values, made_small))
        rows = joined(parts)
        if not len(rows):
            raise ValueError("the problem has neither an objective nor limits")
        limits, objective = rows.excess_db[~rows.objective], rows.excess_db[rows.objective]
        return ProblemAtPoint(
            variables,
            rows,
            np.matmul(rows.own[:, None, :], self.law.jacobian(variables)[rows.plant])[:, 0],
            float(objective.max(initial=-1e3)),
            float(limits.max(initial=0.0)),
            int(self.loops.unstable_poles(loop).sum()),
        )

    def _feature_rows(self, seen: Seen, places: MeshPlaces, farthest_db: float) -> ProblemRows:
        """Return the rows of features by all criteria.

        Rows that meet their limit by more than `farthest_db` are omitted.
        """
        kept: list[tuple[CurveIndices, int, JudgedFeatures]] = []
        for what, (criterion, asked) in enumerate(zip(self.criteria, self._asked, strict=True)):
            for part in criterion.parts(seen) if asked else ():
                where, _, _, excess = part
                worst = float(excess[where].max(initial=-np.inf)) if what == 0 else 0.0
                kept.append((np.flatnonzero(where & (excess > worst - farthest_db)), what, part))
        i = np.concatenate([which for which, _, _ in kept])
        kinds = np.concatenate([np.full(len(which), what, np.int8) for which, what, _ in kept])
        value, limit, excess = (np.concatenate([part[k][which] for which, _, part in kept]) for k in (1, 2, 3))
        plant, kind = seen.plant[i], seen.kind[i]
        c = features.sensitivity(kind, at := seen.at.taken(i), self.cross.of(plant))
        return ProblemRows(
            kinds,
            plant,
            value,
            limit,
            excess,
            kinds == 0,
            np.asarray((c[:, None] * self.loops.own_gradient(at)).real),
            kind,
            places.cell[i],
            places.x[i],
            places.fixed[i],
        )

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
            places = MeshPlaces(rows.feature[again], rows.cell[again], rows.x[again], none, rows.fixed[again])
            cross = self.cross.of(plant)
            at = self.loops.refined(own[plant] + moves[move], places, cross)[1]
            c = features.sensitivity(places.kind, at, cross)
            out[:, i] = (c[:, None] * self.loops.own_gradient(at)).real.reshape(count, len(i), -1)
        if not all(limit.linear for limit in self.law.limits):
            for m, moved in enumerate(moves):
                for values in self.law.limit_values(own + moved):
                    k = np.flatnonzero(rows.what == len(self.criteria) + values.number)
                    out[m, k] = values.gradient[[int(np.flatnonzero(values.plant == p)[0]) for p in rows.plant[k]]]
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
