"""Templates on |S|, |T|, |K S| and |L|: limits that are linear in dB over the logarithm of the frequency.

Each segment of a template is a band of mesh points of each plant to which it applies. The features of a band are the
local extremes of the magnitude over the template, and the ends of the band (features.py). The points of a template are
mesh points (`plants.make_plant`), so that corners are assessed exactly.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from maxq.control.kernel.records import Array
from maxq.design.case.goals import TRANSFERS, GoalSection
from maxq.design.laws.task import DB
from maxq.design.optimise.curves import CurveIndices, Curves
from maxq.design.optimise.features import CurveMesh, FeatureKind, Mask, MeshPlaces, maxima, points_of, vertex

KIND_OF = {name: FeatureKind[f"OVER_{name}"] for name in TRANSFERS}


@dataclass(frozen=True, eq=False)  # compared by identity, as a search of `Problem`
class TemplateBands:
    """The segments of all templates on the meshes of all plants, as mesh points from `first` to `last` inclusive.

    `goal` is the index of the goal, and `sign` 1 for an upper or -1 for a lower template. The template is
    `level` + `tilt` (x - `corner`), in ln of the magnitude over x = ln f.
    """

    first: CurveIndices
    last: CurveIndices
    goal: CurveIndices
    kind: NDArray[np.int8]
    sign: Array
    corner: Array
    level: Array
    tilt: Array

    def __len__(self) -> int:
        return len(self.first)

    def at(self, tag: CurveIndices, x: Array) -> Array:
        """Return the template of segments `tag` at x = ln f, in ln of the magnitude."""
        return np.asarray(self.level[tag] + self.tilt[tag] * (x - self.corner[tag]))

    def search(self, mesh: CurveMesh) -> MeshPlaces:
        """Return the local extremes of the magnitude over the template in each segment, and its ends."""
        k, tag, starts, ends = points_of(self.first, self.last)
        value = self.sign[tag] * (_log_magnitude(self.kind[tag], mesh, k) - self.at(tag, mesh.curves.x[k]))
        found = maxima(value, starts, ends)
        x, inner = mesh.curves.x[k[found]], (found > starts[tag[found]]) & (found < ends[tag[found]])
        i = found[inner]
        x[inner] = vertex(mesh.curves.x[k], value, i)
        kinds = self.kind[tag[found]].astype(np.int8)
        return MeshPlaces(kinds, k[found], x, tag[found], ~inner, self.tilt[tag[found]])


def _log_magnitude(kind: NDArray[np.int8], mesh: CurveMesh, k: CurveIndices) -> Array:
    """Return ln of the magnitudes of `FeatureKind` at mesh points."""
    loop = mesh.loop[k]
    s = -np.log(np.abs(1.0 + loop) + 1e-300)
    path = np.log(np.abs(mesh.curves.path[k]) + 1e-300)
    out = np.where(kind == FeatureKind.OVER_L, 0.0, s)
    out = out + np.where(kind == FeatureKind.OVER_S, 0.0, mesh.log_gain[k])
    return np.asarray(out - np.where(kind == FeatureKind.OVER_KS, path, 0.0))


def bands_of_goals(goals: Sequence[GoalSection], applies: Sequence[Mask], curves: Curves) -> TemplateBands:
    """Return the segments of the templates among `goals`. `applies` (goals, plants) selects the plants of each."""
    rows = []
    for g, (goal, where) in enumerate(zip(goals, applies, strict=True)):
        if goal.quantity not in TRANSFERS:
            continue
        points, sign = goal.template
        for (low_hz, low_db), (high_hz, high_db) in pairwise(points):
            ends = math.log(low_hz), math.log(high_hz)
            tilt = (high_db - low_db) / DB / (ends[1] - ends[0])
            for p in np.flatnonzero(where):
                begin, end = int(curves.start[p]), int(curves.start[p + 1])
                x = curves.x[begin:end]
                first = int(np.searchsorted(x, ends[0] - 1e-9))
                last = int(np.searchsorted(x, ends[1] + 1e-9)) - 1
                if first <= last:
                    kind = float(KIND_OF[goal.quantity])
                    rows.append((begin + first, begin + last, g, kind, sign, ends[0], low_db / DB, tilt))
    table = np.array(rows, float).reshape(-1, 8).T
    first, last, goal_of = (column.astype(np.int64) for column in table[:3])
    return TemplateBands(first, last, goal_of, table[3].astype(np.int8), *table[4:])


def corners_hz(goals: Sequence[GoalSection]) -> Array:
    """Return the frequencies of all points of templates, Hz."""
    return np.array([hz for goal in goals if goal.quantity in TRANSFERS for hz, _ in goal.template[0]])
