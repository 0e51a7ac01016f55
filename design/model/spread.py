"""Deviations of a vehicle that has no campaign: normal ones, by their three sigma.

Every mode, tank, engine and actuator deviates by itself (actuators by groups of engines, both planes alike). A `Place`
names a deviation, and its size is in units of three sigma. A `Spread` that names a campaign has the draws of that
campaign instead (`deviations.py`).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Annotated, Any, ClassVar, NamedTuple

import numpy as np
from pydantic import Discriminator, Field, Tag
from pydantic_core import PydanticCustomError

from maxq.control.kernel.records import Array
from maxq.design.model.dispersion import Dispersion, for_each, unlike_drives
from maxq.design.model.node import Node
from maxq.sim.campaign.targets import Change, Dispersed, find_target
from maxq.sim.scenario.errors import ScenarioError, refuse
from maxq.sim.scenario.loader import LoadedScenario
from maxq.sim.scenario.schema_values import LIST_FORM, TABLE_FORM, NotNegative, Section, optional
from maxq.sim.scenario.schema_vehicle import Vehicle

Share = Annotated[float, Field(ge=0.0, lt=1.0)]
"""Of a deviation; one of 1 would turn the sign of what deviates."""
Shares = Annotated[
    Annotated[Share, Tag(TABLE_FORM)] | Annotated[tuple[Share, ...], Tag(LIST_FORM)],
    Discriminator(lambda value: LIST_FORM if isinstance(value, list | tuple) else TABLE_FORM),
]
"""One for all modes, tanks, engines or groups of engines, or one each, the last for all beyond."""
Place = tuple[str, int]
"""A key of `Spread`, and of which mode, tank, engine or group of engines, from 0; -1 where there is one of it."""
Draw = Callable[[str, int], float]
"""A deviation in units of three sigma, of a place."""


class Correlated(Section):
    """Two deviations that go together."""

    of: tuple[str, str] = Field(
        description="keys of deviations; a mode's, tank's, engine's or group's with its number from 0: slosh_mass.1"
    )
    coefficient: Annotated[float, Field(ge=-1.0, le=1.0)] = Field(description="of correlation")


class Spread(Section):
    """3-sigma deviations, relative unless a unit is named. (Random vehicles are drawn in the order of the keys.)"""

    where: ClassVar[tuple[str, str]] = ("suite", "margins.three_sigma")

    bending_frequency: Shares = optional("of each mode; the last for all beyond", (0.05, 0.10, 0.15))
    bending_slope: Shares = optional("of each mode, at the gyro", 0.2)
    bending_damping: Shares = optional("of each mode", 0.5)
    slosh_frequency: Shares = optional("of each tank", 0.05)
    slosh_mass: Shares = optional("of each tank", 0.10)
    slosh_damping: Shares = optional("of each tank", 0.5)
    actuator_frequency: Shares = optional("poles of the actuators, of each group of engines", 0.15)
    thrust: Shares = optional("lateral authority, of each engine", 0.03)
    normal_force: Share = optional("of all surfaces", 0.15)
    inertia: Share = optional("transverse", 0.05)
    centre_of_pressure_m: NotNegative = optional("m", 0.25)
    delay_s: NotNegative = optional("either way, s; never below no delay", 0.002)
    correlated: tuple[Correlated, ...] = optional("pairs of deviations that go together", ())
    campaign: str | None = optional(
        "a campaign (file, or name of a built-in one), whose draws these deviations are; no other key may be given"
    )

    def _check(self) -> None:
        given = sorted(self.model_fields_set & {*DEVIATIONS, "correlated"})
        if self.campaign is not None and given:
            raise refuse("cannot be combined with campaign, whose draws the deviations are", "no such key", given[0])


_ABOUT = ("correlated", "campaign")
DEVIATIONS = tuple(key for key in Spread.model_fields if key not in _ABOUT)
"""What deviates, in order."""


class Keys(NamedTuple):
    """The key paths of a deviation in a scenario: {stage}, {n} of the mode or tank, * of engine or actuator, for each
    pole. The value there is multiplied by the deviated factor to the `power`, or the deviation is added to it.
    """

    keys: tuple[str, ...]
    power: float = 1.0
    added: bool = False


_S = "vehicle.stage.{stage}."
_POLES = 3  # the fourth frequency of an actuator is that of its zero, which stays
KEYS = {
    "bending_frequency": Keys((_S + "bending.frequency_factor.{n}",)),
    "bending_slope": Keys((_S + "bending.gyro_slope_factor.{n}",)),
    "bending_damping": Keys((_S + "bending.damping_ratio.{n}",)),
    "slosh_frequency": Keys((_S + "tank.{n}.length_factor",), power=-2.0),
    "slosh_mass": Keys((_S + "tank.{n}.mass_factor",)),
    "slosh_damping": Keys((_S + "tank.{n}.damping_ratio",)),
    "actuator_frequency": Keys((_S + "actuator.*.omega_hz.*",)),
    "thrust": Keys((_S + "engine.*.thrust_factor",)),
    "normal_force": Keys((_S + "aero.force_factor",)),
    "inertia": Keys((_S + "mass.table.Iyy_kgm2", _S + "mass.table.Izz_kgm2")),
    "centre_of_pressure_m": Keys((_S + "aero.centre_shift_m",), added=True),
    "delay_s": Keys((_S + "computer.delay_s",), added=True),
}


def keys_of(vehicle: Vehicle, stage: int, place: Place) -> list[str]:
    """Return the key paths of a deviation in a vehicle's scenario."""
    name, n = place
    flies, out = vehicle.stage[stage], list[str]()
    if name == "delay_s" and (flies.computer is None or flies.computer.delay_s is None):
        return ["vehicle.computer.delay_s"]
    for pattern in KEYS[name].keys:
        key = pattern.format(stage=stage, n=n)
        head, _, tail = key.partition(".*")
        if not tail:
            out.append(key)
            continue
        part = getattr(flies, head.rpartition(".")[2])
        several = [(f"{head}.{k}", one) for k, one in enumerate(part)] if isinstance(part, tuple) else [(head, part)]
        if n >= 0 and isinstance(part, tuple):  # actuators may stand in another order than their groups
            groups = [getattr(one, "group", "") or "" for one in part]
            several = [several[n if name == "thrust" else groups.index(flies.engine_groups[n])]]
        for at, one in several:
            last = tail.removeprefix(".")
            count = min(len(getattr(one, last[:-2]) or ()), _POLES) if last.endswith(".*") else 1
            out += [f"{at}.{last[:-1]}{k}" for k in range(count)] if last.endswith(".*") else [f"{at}.{last}"]
    return out


def _name(place: Place) -> str:
    return place[0] if place[1] < 0 else f"{place[0]}.{place[1]}"


def correlation(spread: Spread, places: Sequence[Place]) -> Array:
    """Correlation matrix of the deviations at `places`. Raises ScenarioError for none, and for no such deviation."""
    out, (source, at) = np.eye(len(places)), spread.where
    names = [_name(place) for place in places]
    for k, pair in enumerate(spread.correlated):
        if pair.of[0] == pair.of[1] or not set(pair.of) <= set(names):
            key, allowed = f"{at}.correlated.{k}.of", f"two of {', '.join(names)}"
            raise ScenarioError(source, "are no two deviations of this vehicle", key, value=pair.of, allowed=allowed)
        i, j = (names.index(name) for name in pair.of)
        out[i, j] = out[j, i] = pair.coefficient
    if np.linalg.eigvalsh(out)[0] < -1e-9:
        problem = "no deviations have all of these coefficients together"
        raise ScenarioError(source, problem, f"{at}.correlated", allowed="those of a positive semidefinite matrix")
    return out


def root_of_correlation(spread: Spread, places: Sequence[Place]) -> Array:
    """Symmetric root of `correlation`: the deviations that belong to independent ones, which are as likely.

    Corners, boxes and spheres of independent deviations become those of correlated ones by it.
    """
    if not spread.correlated:
        return np.eye(len(places))
    sizes, vectors = np.linalg.eigh(correlation(spread, places))
    return np.asarray((vectors * np.sqrt(np.maximum(sizes, 0.0))) @ vectors.T)


def _count(node: Node, key: str) -> int | None:
    """Modes, tanks, engines or their groups; None for what there is one of, as is a single engine."""
    vehicle, kind = node.vehicle, key.partition("_")[0]
    counts = {"bending": len(vehicle.omega_radps), "slosh": len(vehicle.pendulums.mass_kg)}
    sizes, engine = node.held.sizes, node.held.vehicle["engine"]
    several = {"thrust": int(np.sum(engine["parts"][0] > 0.0)), "actuator": 1 + int(sizes.further_groups)}
    return counts.get(kind, several[kind] if several.get(kind, 1) > 1 else None)


def places_of(node: Node, spread: Spread | None = None) -> list[Place]:
    """All that deviates at a node; of a `spread` only what it lets deviate."""
    out = []
    for key in DEVIATIONS:
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
    """Deviations of a vehicle with the modes, tanks and engines of `node`."""
    values: dict[str, Any] = {}
    for key in DEVIATIONS:
        count = _count(node, key)
        numbers = (-1,) if count is None else range(count)
        by = [size * draw(key, n) for size, n in zip(_sizes(spread, key, len(numbers)), numbers, strict=True)]
        each = tuple(by if KEYS[key].added else (max(1.0 + x, 0.05) for x in by))
        values[key] = each[0] if count is None else each
    return Dispersion(**values, label=label)


def vehicle_at_places(
    spread: Spread, node: Node, places: Sequence[Place], u: Array | Sequence[float], label: str = ""
) -> Dispersion:
    """That with deviations `u` (places,) in units of three sigma, and none elsewhere."""
    by: Mapping[Place, float] = dict(zip(places, (float(x) for x in u), strict=True))
    return vehicle_of(spread, node, lambda name, n: by.get((name, n), 0.0), label)


def with_actuators_apart(base: LoadedScenario, stage: int) -> LoadedScenario:
    """The scenario with actuators of its own for each group of a stage's engines, where one table serves all."""
    vehicle, flies = base.vehicle, base.vehicle.stage[stage]
    if flies.actuator is None or isinstance(flies.actuator, tuple):
        return base
    apart = tuple(flies.actuator.model_copy(update={"group": group}) for group in flies.engine_groups)
    stages = list(vehicle.stage)
    stages[stage] = flies.model_copy(update={"actuator": apart})
    flown = base.scenario.model_copy(update={"vehicle": vehicle.model_copy(update={"stage": tuple(stages)})})
    return LoadedScenario(flown, base.label, base.files)


def scenario_of(base: LoadedScenario, node: Node, d: Dispersion) -> tuple[LoadedScenario, list[str]]:
    """The scenario in which the deviated vehicle flies, and the keys that it does not have.

    What the linear model changes about its node flies all the way: thrust acts along the axis as well, inertia is that
    of the whole vehicle.
    """
    base = with_actuators_apart(base, node.stage) if unlike_drives(d) else base
    vehicle, factors, added = base.vehicle, dict[str, float](), dict[str, float]()
    for name, n in places_of(node):
        each = np.atleast_1d(getattr(d, name))
        value = float(each[min(max(n, 0), len(each) - 1)])
        for key in keys_of(vehicle, node.stage, (name, n)):
            (added if KEYS[name].added else factors)[key] = value ** KEYS[name].power
    computer, delay = vehicle.computer_of(node.stage), keys_of(vehicle, node.stage, ("delay_s", -1))[0]
    changes, missing = [], []
    results: dict[str, float] = {}
    for key, number in (*factors.items(), *added.items()):
        try:
            target = find_target(base.scenario, key)
        except PydanticCustomError:
            missing.append(key)
            continue
        if target.kind == "column":
            changes.append(Change(target, "scale", key))
            results[key] = number
        else:
            changes.append(Change(target, "set", key))
            result = target.nominal + number if key in added else target.nominal * number
            if key == delay and result > (most_s := computer.sample_s if computer is not None else result):
                result = most_s
                missing.append(f"{key} beyond the sample")
            results[key] = round(max(result, 0.0), 9) if target.whole_ns else result
    return LoadedScenario(Dispersed(base.scenario, changes)(results), base.label, base.files), missing
