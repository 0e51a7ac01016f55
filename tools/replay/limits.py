"""Where the limits of a plot come from: requirements of the scenario, and what the vehicle can do."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

from maxq.sim.scenario.schema_scenario import Scenario

Metrics = Mapping[str, tuple[float | None, float | None]]  # metric: largest, smallest allowed


@dataclass(frozen=True)
class Limit:
    """A bound in a plot's unit. `upper`: values above it are not allowed (else: below)."""

    value: float
    label: str
    upper: bool = True
    required: bool = True  # by the scenario; else what the hardware cannot exceed


def required(scenario: Scenario | None, metric: str, factor: float = 1.0, both: bool = False) -> list[Limit]:
    """Requirements on a metric; `both`: the metric is the larger of either sign, so the bound holds on both sides."""
    out = []
    for r in scenario.requirement if scenario is not None else ():
        if r.metric != metric:
            continue
        name = r.name or r.metric
        if r.limit is not None and math.isfinite(r.limit):
            out.append(Limit(factor * r.limit, name))
            if both:
                out.append(Limit(-factor * r.limit, name, upper=False))
        if r.minimum is not None and not both:
            out.append(Limit(factor * r.minimum, name, upper=False))
    return out


def hardware(scenario: Scenario | None, key: str, axis: int, label: str) -> list[Limit]:
    """The actuator's own limit of the first stage that has one; `axis` 0 pitch, 1 yaw."""
    for stage in scenario.vehicle.stage if scenario is not None else ():
        if stage.actuator is not None:
            value = float(getattr(stage.actuator.axes[axis], key))
            return [Limit(value, label, required=False), Limit(-value, label, upper=False, required=False)]
    return []
