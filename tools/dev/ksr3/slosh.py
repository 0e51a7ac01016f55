"""First slosh mode of a flat-bottomed cylinder as a pendulum (Abramson, NASA SP-106; Dodge, "The New Dynamic
Behavior of Liquids in Moving Containers"): lateral mode 1 of radius R (the paper's R_i is a radius, not a
diameter).

Below a depth of R/4 the pendulum keeps its length (the formula's grows without bound as the depth goes to
nothing); below R/10 its mass fades smoothly, and both end at exactly zero with the liquid.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import tanh

from maxq.tools.dev.ksr3.assumptions import TANK_RADIUS_M
from maxq.tools.dev.ksr3.mass_model import Fill

ROOT = 1.8412  # first zero of J1'
HOLD_DEPTH = 0.25  # depth over radius below which the length is held
FADE_DEPTH = 0.10  # depth over radius below which the mass fades


@dataclass(frozen=True)
class Pendulum:
    mass_kg: float
    length_m: float
    hinge_station_m: float

    @property
    def bob_station_m(self) -> float:
        return self.hinge_station_m + self.length_m


def pendulum(fill: Fill) -> Pendulum:
    depth = fill.height_m / TANK_RADIUS_M
    length = TANK_RADIUS_M / (ROOT * tanh(ROOT * max(depth, HOLD_DEPTH)))
    return Pendulum(slosh_mass_kg(fill), length, _bob_station_m(fill) - length)


def slosh_mass_kg(fill: Fill) -> float:
    """At most 2/(root^2 - 1) = 0.837 of the liquid, in the limit of a shallow layer."""
    depth = fill.height_m / TANK_RADIUS_M
    if depth == 0:
        return 0.0
    share = 2 * tanh(ROOT * depth) / (ROOT * depth * (ROOT**2 - 1))
    x = min(depth / FADE_DEPTH, 1.0)
    return fill.mass_kg * share * x * x * (3 - 2 * x)


def _bob_station_m(fill: Fill) -> float:
    """The bob hangs (h/2 - (2R/root) tanh(root h / 2R)) above the liquid's CG, within the liquid."""
    height = fill.height_m
    above = height / 2 - 2 * TANK_RADIUS_M / ROOT * tanh(ROOT * height / (2 * TANK_RADIUS_M))
    return fill.tank.bottom_station_m - height / 2 - above
