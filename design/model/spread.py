"""How far vehicles deviate, and the vehicle of given deviations: one description for suites and for robust cases.

Every mode and every tank deviates by itself. What deviates is told by a `Place`, how far in units of three sigma.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Annotated, Any

import numpy as np
from pydantic import Field

from maxq.control.kernel.records import Array
from maxq.design.model.dispersion import Dispersion, for_each
from maxq.design.model.node import Node
from maxq.sim.scenario.errors import ScenarioError
from maxq.sim.scenario.schema_values import NotNegative, Section, optional

Share = Annotated[float, Field(ge=0.0, lt=1.0)]
"""Of a deviation; one of 1 would turn the sign of what deviates."""
Place = tuple[str, int]
"""A key of `Spread`, and of which mode or tank, from 0; -1 where there is one of it."""
Draw = Callable[[str, int], float]
"""A deviation in units of three sigma, of a place."""


class Spread(Section):
    """3-sigma deviations, relative unless a unit is named. (Random vehicles are drawn in the order of the keys.)"""

    bending_frequency: tuple[Share, ...] = optional("of each mode; the last for all beyond", (0.05, 0.10, 0.15))
    bending_slope: Share = optional("of each mode, at the gyro", 0.2)
    bending_damping: Share = optional("of each mode", 0.5)
    slosh_frequency: Share = optional("of each tank", 0.05)
    slosh_mass: Share = optional("of each tank", 0.10)
    slosh_damping: Share = optional("of each tank", 0.5)
    actuator_frequency: Share = optional("poles of the actuator", 0.15)
    thrust: Share = optional("lateral authority", 0.03)
    normal_force: Share = optional("of all surfaces", 0.15)
    inertia: Share = optional("transverse", 0.05)
    centre_of_pressure_m: NotNegative = optional("m", 0.25)
    delay_s: NotNegative = optional("either way, s; never below no delay", 0.002)


_CORRELATED = "margins.three_sigma.correlated"


class Correlated(Section):
    """Two deviations that go together."""

    of: tuple[str, str] = Field(
        description="keys of deviations, of a mode or tank with its number from 0: slosh_mass.1"
    )
    coefficient: Annotated[float, Field(ge=-1.0, le=1.0)] = Field(description="of correlation")


class CorrelatedSpread(Spread):
    """Deviations of which some go together; those not named are independent."""

    correlated: tuple[Correlated, ...] = optional("pairs of deviations that go together", ())


def correlation(spread: Spread, node: Node, places: Sequence[Place]) -> Array:
    """Correlation matrix of the deviations at `places`. Raises ScenarioError for none, and for no such deviation."""
    out = np.eye(len(places))
    names = [name if n < 0 else f"{name}.{n}" for name, n in places]
    for k, pair in enumerate(spread.correlated if isinstance(spread, CorrelatedSpread) else ()):
        if pair.of[0] == pair.of[1] or not set(pair.of) <= set(names):
            key, allowed = f"{_CORRELATED}.{k}.of", f"two of {', '.join(names)}"
            raise ScenarioError("suite", "are no two deviations of this vehicle", key, value=pair.of, allowed=allowed)
        i, j = (names.index(name) for name in pair.of)
        out[i, j] = out[j, i] = pair.coefficient
    if np.linalg.eigvalsh(out)[0] < -1e-9:
        problem = "no deviations have all of these coefficients together"
        raise ScenarioError("suite", problem, _CORRELATED, allowed="those of a positive semidefinite matrix")
    return out


def _count(node: Node, key: str) -> int | None:
    """Modes or tanks, None for what there is one of."""
    counts = {"bending": len(node.vehicle.modes.omega_radps), "slosh": len(node.vehicle.pendulums.mass_kg)}
    return counts.get(key.partition("_")[0])


def places_of(node: Node, spread: Spread | None = None) -> list[Place]:
    """All that deviates at a node; of a `spread` only what it lets deviate."""
    out = []
    for key in Spread.model_fields:
        count = _count(node, key)
        sizes = (0.0,) if spread is None else _sizes(spread, key, count or 1)
        for n in (-1,) if count is None else range(count):
            if spread is None or sizes[max(n, 0)] > 0.0:
                out.append((key, n))
    return out


def _sizes(spread: Spread, key: str, count: int) -> tuple[float, ...]:
    given = getattr(spread, key)
    return for_each(given if isinstance(given, tuple) else (given,), count)


def vehicle_of(spread: Spread, node: Node, draw: Draw, label: str) -> Dispersion:
    """Deviations of a vehicle with the modes and tanks of `node`."""
    values: dict[str, Any] = {}
    for key in Spread.model_fields:
        count = _count(node, key)
        if count is not None:
            sizes = _sizes(spread, key, count)
            values[key] = tuple(max(1.0 + size * draw(key, n), 0.05) for n, size in enumerate(sizes))
        elif key in ("delay_s", "centre_of_pressure_m"):
            values[key] = getattr(spread, key) * draw(key, -1)
        else:
            values[key] = max(1.0 + getattr(spread, key) * draw(key, -1), 0.05)
    return Dispersion(**values, label=label)


def vehicle_at_places(
    spread: Spread, node: Node, places: Sequence[Place], u: Array | Sequence[float], label: str = ""
) -> Dispersion:
    """That with deviations `u` (places,) in units of three sigma, and none elsewhere."""
    by: Mapping[Place, float] = dict(zip(places, (float(x) for x in u), strict=True))
    return vehicle_of(spread, node, lambda name, n: by.get((name, n), 0.0), label)
