"""What a flight is judged by: every metric by name and unit, and what became of a scenario's requirements."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from maxq.sim.flight.metrics import METRICS
from maxq.sim.run.ending import ENDING_METRICS
from maxq.sim.scenario.schema_scenario import Requirement, Scenario

ALL_METRICS = (*METRICS, *ENDING_METRICS)
METRIC_NAMES = tuple(metric.name for metric in ALL_METRICS)
"""Names that a requirement may use."""

_UNITS = {
    "mps": "m/s",
    "m": "m",
    "mach": "1",
    "Pa": "Pa",
    "deg": "deg",
    "Padeg": "Pa deg",
    "degps": "deg/s",
    "g": "g",
    "s": "s",
}


def unit_of(metric: str) -> str:
    """Unit of a metric, which its name ends with; KeyError for a name of another kind."""
    return _UNITS[metric.rpartition("_")[2]]


@dataclass(frozen=True)
class Verdict:
    """A requirement and what the flight made of it; `time_s` is that of the value, nan if it has none."""

    requirement: Requirement
    value: float
    time_s: float
    met: bool

    @property
    def name(self) -> str:
        return self.requirement.name or self.requirement.metric

    @property
    def bound(self) -> tuple[str, float]:
        """`limit` or `minimum`, and its value."""
        if self.requirement.limit is not None:
            return "limit", self.requirement.limit
        assert self.requirement.minimum is not None
        return "minimum", self.requirement.minimum


def judge(requirement: Requirement, values: Mapping[str, float], times_s: Mapping[str, float]) -> Verdict:
    """A value that is not a number meets no requirement. Raises KeyError for an unknown metric."""
    value = values[requirement.metric]
    if requirement.limit is not None:
        met = value <= requirement.limit
    else:
        assert requirement.minimum is not None
        met = value >= requirement.minimum
    return Verdict(requirement, value, times_s[requirement.metric], met)


def above_the_wind(scenario: Scenario, highest_m: float) -> tuple[str, ...]:
    """A complaint in words if the flight rose above a wind profile that is to cover it (wind.outside = "error")."""
    wind = scenario.wind
    if wind.outside == "hold" or wind.profile is None:
        return ()
    top_m = float(wind.profile["altitude_m"][-1])
    if highest_m <= top_m:
        return ()
    return (f"the flight rose to {highest_m:.0f} m, the wind profile ends at {top_m:.0f} m (wind.outside = 'error')",)
