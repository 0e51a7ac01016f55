"""A design in the wind of its case: root mean squares of load, drift and bending moments at nodes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from maxq.control.kernel.records import Array
from maxq.design import api
from maxq.design.case.schema import Case
from maxq.design.laws.wind import WIND_LIMITS, Key, quantity
from maxq.design.margins.measure import margins
from maxq.design.model.node import Node
from maxq.design.optimise.plants import wind_of
from maxq.sim.scenario.schema_design import Design


@dataclass(frozen=True)
class InWind:
    """One quantity at the nodes: of a design, and of the one that the scenario flies by itself."""

    key: Key
    rms: Array  # (nodes,), nan where the loop is unstable
    before: Array | None  # None: the scenario has no design

    @property
    def name(self) -> str:
        return self.key if isinstance(self.key, str) else f"bending_moment_{self.key:g}_m"

    @property
    def about(self) -> tuple[str, str, str]:
        """Text, heading of a column and unit."""
        return quantity(self.key)


def in_wind(case: Case, nodes: Sequence[Node], design: Design, before: Design | None) -> list[InWind]:
    """All quantities that the case can limit, at its stations; nothing without a wind."""
    if case.wind is None:
        return []
    keys, rms = _rms(case, nodes, design)
    own = None if before is None else _rms(case, nodes, before)[1]
    return [InWind(key, rms[k], None if own is None else own[k]) for k, key in enumerate(keys)]


def _rms(case: Case, nodes: Sequence[Node], design: Design) -> tuple[list[Key], Array]:
    """Quantities, and their values (quantities, nodes)."""
    found, keys = [], list[Key](WIND_LIMITS)
    for loop in api.loops(nodes, design, kind=case.loop):
        path = loop.fixed
        path.measurements = loop.law.inputs
        wind = wind_of(path, case)
        keys = [*WIND_LIMITS, *wind.stations_m]
        law = loop.law.response(np.exp(wind.x))
        values = wind.rms(range(len(keys)), law, np.zeros((*law.shape, 0)))[0]
        found.append(values if margins(loop, resonances=()).stable else np.full(len(keys), np.nan))
    return keys, np.array(found).T
