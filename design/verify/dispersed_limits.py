"""The dispersed limits of a robust basis: a search at operating points for the vehicles with the smallest margins.

The vehicles are those of `[basis.robust]`, with each deviation up to `corner_sigmas` in both directions. At an
operating point, the search moves from several corners of that box to one that no single deviation makes worse
(`descent.to_corner`). At the worst operating points it continues with a descent that may leave the corners
(`descent.descend`). The minimised value is the least relative margin to a limit, over the limits that the margin sweep
measures (`guides`). Between operating points, the worst vehicles of the neighbouring points are measured, and the
descent is repeated where they are worst. The search gives no bound: other vehicles of the box may be worse than those
found.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np

from maxq.control.kernel.records import Array
from maxq.design.case.basis import LoadLimits, Robust
from maxq.design.model.deviations import deviations_of
from maxq.design.model.node import Node, disperse
from maxq.design.optimise.descent import Region, descend, to_corner
from maxq.design.quantities import MEASURED, SWEPT, LoopLimits
from maxq.design.verify.compared import IMPLIED
from maxq.design.verify.judging import Wanted
from maxq.design.verify.linear import SweptVehicles
from maxq.design.verify.memory import counted
from maxq.sim.campaign.read import LoadedCampaign
from maxq.sim.scenario.schema_design import Design

CORNERS = 4  # starting corners per operating point
REFINED = 3  # operating points, and instants between them, with a descent that may leave the corners
SEED = 1
_LOST, _FREE = -1.0, 10.0  # value of an unstable loop, and of a loop without an active limit

Rooms = Callable[[Sequence[Array]], list[float]]
"""A function that returns the least relative margin to a limit at each vector of scores (places,), or -1 if unstable.

Scores are in units of 3 sigma.
"""


@dataclass(frozen=True)
class WorstOfBasis:
    """The worst vehicles found, one per operating point or instant, in the order of time.

    `guides` are the labels of the limits in the search. `loops` is the total number of loops measured, and `instants`
    the number of instants examined between the operating points.
    """

    nodes: tuple[Node, ...]
    guides: tuple[str, ...]
    loops: int
    instants: int

    @property
    def text(self) -> str:
        """Return the extent of the search as text."""
        between = f" and {self.instants} instants between" if self.instants else ""
        wanted = ", ".join(("stability", *self.guides))
        return f"the worst of each point{between} in a search of {self.loops} loops for {wanted}"


def guides(limits: LoadLimits) -> dict[str, float]:
    """Return the limits of the margin sweep (`SWEPT`) that the limits of dispersed vehicles imply, by key."""
    out: dict[str, float] = {}
    for key, limit in Wanted.of(limits).limits.items():
        for part in (key,) if key in SWEPT else IMPLIED.get(key, ()):
            if isinstance(limit, float | int):
                out[part] = min(float(limit), out.get(part, float(limit)), key=MEASURED[part].badness)
    return out


def rooms(node: Node, design: Design, campaign: LoadedCampaign, wanted: Mapping[str, float]) -> Rooms:
    """Return the function of scores to be minimised at an operating point. `wanted` contains limits by key of SWEPT."""
    deviations, swept = deviations_of(campaign, node), SweptVehicles(node, design, LoopLimits())

    def at(every: Sequence[Array]) -> list[float]:
        table = np.full((len(every), len(SWEPT)), np.nan)
        swept.measure(node, deviations.of_scores(every), table, np.arange(len(every)))
        left = [np.full(len(every), _FREE)]
        for key, limit in wanted.items():
            about, values = MEASURED[key], table[:, SWEPT.index(key)]
            left.append((limit - values if about.sense == "<=" else values - limit) / abs(limit))
        unstable = np.isnan(table).all(axis=1)
        return list(np.where(unstable, _LOST, np.clip(np.min(left, axis=0), _LOST, _FREE)))

    return at


def worst_of_basis(
    nodes: Sequence[Node],
    between: Sequence[Node],
    design: Design,
    robust: Robust,
    campaign: LoadedCampaign,
    watch: Callable[[int, int], None] = lambda done, of: None,
    workers: int = 2,
) -> WorstOfBasis:
    """Return the worst vehicles of a robust basis at the operating points of one stage.

    The instants `between` them are searched, too.
    """
    wanted, region = guides(robust.limits), Region("box", robust.corner_sigmas / 3.0)
    tried: list[int] = []

    def looked(node: Node) -> Rooms:
        values = rooms(node, design, campaign, wanted)

        def look(every: Sequence[Array]) -> list[float]:
            tried.append(len(every))
            return values(every)

        return look

    def search(node: Node) -> tuple[float, Array]:
        fields, look = deviations_of(campaign, node).fields, looked(node)
        rng = np.random.default_rng([SEED, round(1e3 * node.time_s)])
        starts = [rng.choice([-1.0, 1.0], len(fields)) for _ in range(CORNERS)]
        for end, start in zip(
            (-1.0, 1.0), starts, strict=False
        ):  # modes at one end of their frequency, with large slopes at the gyro
            start[[k for k, name in enumerate(fields) if name == "bending_frequency"]] = end
            start[[k for k, name in enumerate(fields) if name == "bending_slope"]] = 1.0
        found = [to_corner(look, start, region) for start in starts]
        u, value = min(found, key=lambda each: each[1])
        return value, u

    def refine(node: Node, value: float, u: Array) -> tuple[float, Array]:
        if value <= _LOST:
            return value, u
        u, value = descend(looked(node), u, value, region)
        return value, u

    def beside(node: Node) -> tuple[float, Array]:
        near = sorted(range(len(nodes)), key=lambda k: abs(nodes[k].time_s - node.time_s))[:2]
        points = [found[k][1] for k in near]
        values = looked(node)(points)
        k = int(np.argmin(values))
        return values[k], points[k]

    with ThreadPoolExecutor(max_workers=workers) as pool:
        found = list(pool.map(counted(search, watch, len(nodes)), nodes))
        every = [(node, *each) for node, each in zip(nodes, found, strict=True)]
        beyond = [(node, *each) for node, each in zip(between, pool.map(beside, between), strict=True)]
        for some in filter(None, (every, beyond)):
            worst = sorted(range(len(some)), key=lambda k: some[k][1])[:REFINED]
            for k, each in zip(worst, pool.map(refine, *zip(*(some[k] for k in worst), strict=True)), strict=True):
                some[k] = (some[k][0], *each)
    beyond = sorted(beyond, key=lambda each: each[1])[:REFINED]
    vehicles = [
        disperse(node, deviations_of(campaign, node).at(u, "worst found"))
        for node, _, u in sorted((*every, *beyond), key=lambda each: each[0].time_s)
    ]
    labels = tuple(MEASURED[key].label for key in wanted)
    return WorstOfBasis(tuple(vehicles), labels, sum(tried), len(between))
