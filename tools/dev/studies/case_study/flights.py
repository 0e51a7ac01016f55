"""Designs flown once through the nominal ascent."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from maxq.sim.run.fly import Flight, fly
from maxq.sim.scenario.loader import load_scenario

METRICS = {
    "max_q_alpha_Padeg": ("q alpha, kPa deg", 1e-3, 1),
    "max_attitude_error_deg": ("attitude error, deg", 1.0, 2),
    "max_gimbal_deg": ("gimbal, deg", 1.0, 2),
    "max_gimbal_rate_degps": ("gimbal rate, deg/s", 1.0, 2),
    "max_slosh_deg": ("slosh, deg", 1.0, 2),
    "max_bending_m": ("bending, mm", 1e3, 3),
    "max_altitude_m": ("apogee, km", 1e-3, 2),
    "range_m": ("range, km", 1e-3, 2),
}
"""What is told of a flight: name, factor, digits."""


@dataclass(frozen=True)
class Flown:
    """A design's flight."""

    design: str
    wind: str
    passed: bool
    missed: tuple[str, ...]
    metrics: dict[str, float]


def fly_design(design: str, wind: Sequence[str] = (), wind_name: str = "none") -> Flown:
    """Fly `nominal` with a design (a file that a scenario may name) and overrides for the wind."""
    flight: Flight = fly(load_scenario("nominal", [f'design="{design}"', *wind]), log=False)
    missed = tuple(v.name for v in flight.verdicts if not v.met) + tuple(flight.failures)
    found = {name: flight.metrics[name] for name in METRICS if name in flight.metrics}
    return Flown(design, wind_name, flight.passed, missed, found)


def flights_table(flown: Sequence[Flown]) -> list[str]:
    """As Markdown."""
    names = [name for name in METRICS if all(name in f.metrics for f in flown)]
    lines = ["| design | wind | " + " | ".join(METRICS[name][0] for name in names) + " | verdict |"]
    lines.append("|---|---|" + "---:|" * len(names) + "---|")
    for f in flown:
        cells = [f"{f.metrics[name] * METRICS[name][1]:.{METRICS[name][2]}f}" for name in names]
        verdict = "all requirements met" if f.passed else "missed: " + ", ".join(f.missed)
        stem = f.design.rpartition("/")[2].removesuffix(".toml")
        lines.append(f"| {stem} | {f.wind} | " + " | ".join(cells) + f" | {verdict} |")
    return lines
