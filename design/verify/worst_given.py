"""The worst deviation of an operating point that is given by coefficients or matrices, without vehicle and campaign.

The search minimises the least |1 + L| within a box or an ellipsoid of the deviations of `GivenPoint.with_`. It starts
at the nominal point and at random points. In a box, it goes to a corner first; a local descent follows
(optimise/descent.py). It gives no lower bound.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from maxq.control.kernel.records import Array
from maxq.design.loop.fixed_path import LoopKind, fixed_path
from maxq.design.loop.loop import Loop, law_at
from maxq.design.margins.measure import margins
from maxq.design.model.given import GivenPoint
from maxq.design.optimise.descent import RangeShape, Region, descend, to_corner
from maxq.design.verify.worst import least_distance
from maxq.sim.scenario.schema_design import Design


@dataclass(frozen=True)
class WorstPoint:
    """The worst deviation found: the arguments of `GivenPoint.with_`, and the operating point with them.

    `modulus` is its least `|1 + L|`, or 0 for an unstable loop. `tried` is the number of loops.
    """

    deviations: dict[str, float]
    modulus: float
    point: GivenPoint
    tried: int


def worst_point(
    point: GivenPoint,
    design: Design,
    ranges: Mapping[str, float],
    *,
    kind: LoopKind = "sampled",
    region: RangeShape = "box",
    starts: int = 4,
    seed: int = 1,
) -> WorstPoint:
    """Return the worst operating point found within half ranges of the deviations of a given point.

    A half range of a coefficient, or of `gain`, is relative: 0.2 allows factors from 0.8 to 1.2. A half range of
    `delay_s` is in s, and one of a deviation of matrices in its own unit. In an ellipsoid, all deviations relative to
    their half ranges have a norm of at most 1. Raises ValueError for an unknown name, for a half range that is not
    positive, and for a delay that becomes negative.
    """
    names = tuple(ranges)
    for name, half in ranges.items():
        if name not in point.known_deviations or not 0.0 < half < np.inf:
            known = ", ".join(point.known_deviations)
            raise ValueError(f"ranges: {name} = {half:g}; allowed are numbers above 0 for {known}")
    if not names or starts < 1:
        raise ValueError(f"ranges of {len(names)} deviations, starts = {starts}: allowed is at least one of each")
    law, centre = law_at(design, point, kind), np.array([float(_relative(point, name)) for name in names])
    halves, region_, tried = np.array(list(ranges.values())), Region(region, 1.0), 0

    def given(u: Array) -> dict[str, float]:
        return dict(zip(names, (centre + halves * u).tolist(), strict=True))

    def values(every: Sequence[Array]) -> list[float]:
        nonlocal tried
        tried += len(every)
        return [least_distance(Loop(fixed_path(point.with_(**given(u)), kind), law))[0] for u in every]

    rng, found = np.random.default_rng(seed), list[tuple[float, Array]]()
    for start in range(starts):
        u = np.zeros(len(names)) if start == 0 else region_.nearest(rng.uniform(-1.0, 1.0, len(names)))
        (value,) = values([u])
        if region == "box":
            corner, at_corner = to_corner(values, u, region_)
            u, value = (corner, at_corner) if at_corner < value else (u, value)
        u, value = descend(values, u, value, region_)
        found.append((value, u))
    _, worst = min(found, key=lambda one: one[0])
    there = point.with_(**given(worst))
    loop = Loop(fixed_path(there, kind), law)
    exact = margins(loop, resonances=loop.fixed.resonances())
    return WorstPoint(given(worst), exact.modulus if exact.stable else 0.0, there, tried)


def _relative(point: GivenPoint, name: str) -> bool:
    """Return True for a deviation that is a factor."""
    return name == "gain" or (point.coefficients is not None and name != "delay_s")
