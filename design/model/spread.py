"""A short form of a campaign with normal deviations: the 3-sigma value of each quantity, equal for all stages.

`campaign_of` derives the campaign. Modes, tanks and engines deviate independently, and actuators by engine groups.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import TYPE_CHECKING, Annotated, Any, ClassVar

import numpy as np
from pydantic import Discriminator, Field, Tag
from pydantic_core import PydanticCustomError

from maxq.sim.campaign.correlated import Correlated
from maxq.sim.input.errors import ScenarioError, refuse
from maxq.sim.input.remembered import cached_by_identity
from maxq.sim.input.values import LIST_FORM, TABLE_FORM, NotNegative, Section, optional
from maxq.sim.scenario.loader import LoadedScenario
from maxq.sim.scenario.schema_vehicle import Stage, Vehicle
from maxq.sim.vehicle.actuator.section import ActuatorAxis

if TYPE_CHECKING:
    from maxq.sim.campaign.read import LoadedCampaign

RelativeDeviation = Annotated[float, Field(ge=0.0, lt=1.0)]
"""A relative deviation below 1, so that the quantity keeps its sign."""
Shares = Annotated[
    Annotated[RelativeDeviation, Tag(TABLE_FORM)] | Annotated[tuple[RelativeDeviation, ...], Tag(LIST_FORM)],
    Discriminator(lambda value: LIST_FORM if isinstance(value, list | tuple) else TABLE_FORM),
]
"""A value for all modes, tanks, engines or engine groups, or one value each. The last value applies to all others."""
_LEAST = 0.05  # lower bound, relative to nominal


class Spread(Section):
    """The 3-sigma deviations, which are relative unless a unit is given."""

    where: ClassVar[tuple[str, str]] = ("suite", "margins.three_sigma")

    bending_frequency: Shares = optional("frequency of each mode; last value for all higher modes", (0.05, 0.10, 0.15))
    bending_slope: Shares = optional("slope of each mode at the gyro", 0.2)
    bending_damping: Shares = optional("damping of each mode", 0.5)
    slosh_frequency: Shares = optional("frequency of each tank", 0.05)
    slosh_mass: Shares = optional("slosh mass of each tank", 0.10)
    slosh_damping: Shares = optional("damping of each tank, with walls and rings", 0.5)
    actuator_frequency: Shares = optional("poles of the actuators, of each group of engines", 0.15)
    thrust: Shares = optional("lateral authority, of each engine", 0.03)
    normal_force: RelativeDeviation = optional("normal force of all surfaces", 0.15)
    inertia: RelativeDeviation = optional("transverse inertia", 0.05)
    centre_of_pressure_m: NotNegative = optional("centre of pressure, m", 0.25)
    delay_s: NotNegative = optional("in both directions, s; the delay stays between 0 and the sample period", 0.002)
    correlated: tuple[Correlated, ...] = optional(
        "correlated pairs of deviations, by their keys; with the number of the mode, tank, engine or group, from 0: "
        "slosh_mass.1",
        (),
    )
    campaign: str | None = optional(
        "a campaign (file, or name of a built-in one) that gives the deviations; excludes all other keys"
    )

    def _check(self) -> None:
        given = sorted(self.model_fields_set & {*DEVIATIONS, "correlated"})
        if self.campaign is not None and given:
            raise refuse("cannot be combined with campaign, whose draws the deviations are", "no such key", given[0])

    def size(self, key: str, number: int) -> float:
        """Return the 3-sigma value of a deviation. `number` is the index of the mode, tank, engine or group, from 0."""
        given = getattr(self, key)
        each = given if isinstance(given, tuple) else (given,)
        return float(each[min(max(number, 0), len(each) - 1)]) if each else 0.0


DEVIATIONS = tuple(key for key in Spread.model_fields if key not in ("correlated", "campaign"))
"""The keys of the deviating quantities."""
_ADDED = ("centre_of_pressure_m", "delay_s")


@cached_by_identity
def campaign_of(spread: Spread, base: LoadedScenario, seed: int = 1) -> LoadedCampaign:
    """Return the campaign that a `Spread` names, or the campaign that it describes for all stages of a scenario.

    Raises ScenarioError for a campaign that cannot be read, and for impossible correlations.
    """
    from maxq.sim.campaign.read import load_campaign, made_of  # noqa: PLC0415  # lazy, as the next two: a basis is read
    from maxq.sim.campaign.schema import CampaignFile  # noqa: PLC0415  # by commands that need no campaign
    from maxq.sim.campaign.targets import find_target  # noqa: PLC0415

    if spread.campaign is not None:
        return load_campaign(spread.campaign)
    base = with_actuators_apart(base)
    vehicle, entries, names = base.vehicle, dict[str, dict[str, Any]](), list[dict[str, str]]()
    for stage in range(len(vehicle.stage)):
        names.append({})
        for key, number, targets in _deviations(vehicle, stage):
            size, of = spread.size(key, number), f" {number + 1}" if number >= 0 else ""
            if len(vehicle.stage) > 1 and not targets[0].startswith("vehicle.computer."):
                of += f" of stage {stage + 1}"
            name = key.removesuffix("_m").removesuffix("_s").replace("_", " ") + of
            nominal = [find_target(base.scenario, target).nominal for target in targets]
            least = float(np.nan_to_num(np.min(nominal), nan=1.0))  # for columns, the nominal factor of 1
            if size == 0.0 or (key not in _ADDED and least <= 0.0):
                continue
            bounds = {"at_least": _LEAST * least}
            if key in _ADDED:
                bounds = {"at_most": _sample_s(vehicle, targets[0])} if key == "delay_s" else {}
            elif key == "slosh_frequency":  # a pendulum's length is proportional to its frequency to the power -2
                bounds = {"power": -2.0, "at_most": least / _LEAST**2}
            apply = "add" if key in _ADDED else "scale"
            entries[name] = {"name": name, "keys": tuple(targets), "apply": apply, "distribution": "normal"}
            entries[name] |= {"three_sigma": size, **bounds}
            names[-1][key if number < 0 else f"{key}.{number}"] = name
    about = {"runs": 0, "seed": seed, "noise": "as-scenario", "envelope": {"channels": ()}}
    file = CampaignFile.model_validate(
        {"campaign": about | {"correlated": _correlated(spread, names)}, "disperse": tuple(entries.values())}
    )
    try:
        return made_of(base, file)
    except PydanticCustomError as wrong:
        found, (source, at) = wrong.context or {}, spread.where
        raise ScenarioError(source, found["problem"], f"{at}.correlated", allowed=found["allowed"]) from None


def _correlated(spread: Spread, names: list[dict[str, str]]) -> tuple[dict[str, Any], ...]:
    """Return the correlated pairs of draws of all stages. `names` maps keys to draws, for each stage.

    Raises ScenarioError for a pair that no stage has.
    """
    out, (source, at) = list[dict[str, Any]](), spread.where
    for n, pair in enumerate(spread.correlated):
        i, j = pair.of
        pairs = dict.fromkeys((each[i], each[j]) for each in names if i != j and i in each and j in each)
        if not pairs:
            key, known = f"{at}.correlated.{n}.of", dict.fromkeys(key for each in names for key in each)
            problem, allowed = "are no two deviations of this vehicle", f"two of {', '.join(known)}"
            raise ScenarioError(source, problem, key, value=pair.of, allowed=allowed)
        out += [{"of": of, "coefficient": pair.coefficient} for of in pairs]
    return tuple(out)


def _deviations(vehicle: Vehicle, number: int) -> Iterator[tuple[str, int, list[str]]]:
    """Yield key, index from 0 (-1 for a single quantity) and key paths of each deviating quantity in a stage."""
    stage, s = vehicle.stage[number], f"vehicle.stage.{number}."
    modes = [
        f"{s}spatial_modes.{{}}.{k}"
        for k in range(len(stage.spatial_modes.damping_ratio) if stage.spatial_modes else 0)
    ]
    modes += [f"{s}bending.{{}}.{k}" for k in range(len(stage.bending.damping_ratio) if stage.bending else 0)]
    tanks = [f"{s}{'.'.join(map(str, stage.tank_key(k)))}.{{}}" for k in range(len(stage.tanks))]
    for parts, key, name in (
        (modes, "bending_frequency", "frequency_factor"),
        (modes, "bending_slope", "gyro_slope_factor"),
        (modes, "bending_damping", "damping_ratio"),
        (tanks, "slosh_frequency", "length_factor"),
        (tanks, "slosh_mass", "mass_factor"),
        (tanks, "slosh_damping", "damping_factor"),
    ):
        yield from ((key, k, [part.format(name)]) for k, part in enumerate(parts))
    yield from _of_actuators(stage, s)
    engines = [f"{s}{'.'.join(map(str, stage.engine_key(k)))}.thrust_factor" for k in range(len(stage.engines))]
    yield from (("thrust", k if len(engines) > 1 else -1, [engine]) for k, engine in enumerate(engines))
    if stage.aero is not None:
        yield "normal_force", -1, [f"{s}aero.force_factor"]
    if stage.mass.table is None:
        yield "inertia", -1, [f"{s}mass.inertia_kgm2.1.1", f"{s}mass.inertia_kgm2.2.2"]
    else:
        yield "inertia", -1, [f"{s}mass.table.Iyy_kgm2", f"{s}mass.table.Izz_kgm2"]
    if stage.aero is not None:
        yield "centre_of_pressure_m", -1, [f"{s}aero.centre_shift_m"]
    if vehicle.computer is not None:
        own = stage.computer is not None and stage.computer.delay_s is not None
        yield "delay_s", -1, [f"{s if own else 'vehicle.'}computer.delay_s"]


def _of_actuators(stage: Stage, s: str) -> Iterator[tuple[str, int, list[str]]]:
    """Yield the tuples of `_deviations` for the actuator poles of each engine group. Both axes deviate equally."""
    if stage.actuator is None:
        return
    groups = stage.engine_groups
    for number, (group, actuator) in enumerate(zip(groups, stage.actuators, strict=True)):
        at = f"{s}actuator."
        if isinstance(stage.actuator, tuple):
            at += f"{[each.group or '' for each in stage.actuator].index(group)}."
        pitch, yaw = actuator.axes
        keys = [f"{at}omega_hz.{k}" for k in _poles(pitch)]
        if actuator.yaw is not None and actuator.yaw.omega_hz is not None:
            keys += [f"{at}yaw.omega_hz.{k}" for k in _poles(yaw)]
        yield "actuator_frequency", number if len(groups) > 1 else -1, keys


def _poles(axis: ActuatorAxis) -> list[int]:
    """Return the indices of an actuator's frequencies that belong to poles.

    One of four frequencies belongs to the zeros.
    """
    zeros = 2 if axis.exchange_a3_a4 else 3
    return [k for k in range(len(axis.omega_hz)) if k != zeros]


def _sample_s(vehicle: Vehicle, key: str) -> float:
    """Return the upper bound of a computer's delay: the shortest sample period of the stages with this key."""
    stages = range(len(vehicle.stage)) if key.startswith("vehicle.computer.") else [int(key.split(".")[2])]
    return min(computer.sample_s for n in stages if (computer := vehicle.computer_of(n)) is not None)


def with_actuators_apart(base: LoadedScenario, like: Vehicle | None = None) -> LoadedScenario:
    """Return the scenario with a separate actuator for each engine group, in stages whose groups share an actuator.

    `like` restricts the change to stages in which this vehicle has separate actuators.
    """
    stages = list(base.vehicle.stage)
    for n, stage in enumerate(stages):
        wanted = len(stage.engine_groups) > 1 if like is None else isinstance(like.stage[n].actuator, tuple)
        if wanted and stage.actuator is not None and not isinstance(stage.actuator, tuple):
            apart = tuple(stage.actuator.model_copy(update={"group": group}) for group in stage.engine_groups)
            stages[n] = stage.model_copy(update={"actuator": apart})
    if all(new is old for new, old in zip(stages, base.vehicle.stage, strict=True)):
        return base
    vehicle = base.vehicle.model_copy(update={"stage": tuple(stages)})
    return replace(base, scenario=base.scenario.model_copy(update={"vehicle": vehicle}))
