"""The deviations of vehicles and their correlation: the draws of a campaign as changes of packed parameters.

Vehicle N of a sweep is run N of the campaign: `drawn` takes the same draws, by `Plan.draw`. It changes the records of
many vehicles at once, through the key paths of the table `RULES`. The result is that of drawing, rebuilding and packing
the scenario. The air, wind and noise of a run belong to its flight and are not changed here.

Corners, ellipsoids and bounds need a scale for each deviation. The scale is the score of a normal distribution: a
deviation of k sigma has the same exceedance probability as k sigma of a normal quantity (`Plan.of_scores`). A normal
deviation is k times its standard deviation. A uniform one is at 0.86 of its half-range at 1.5 sigma and at 0.997 of it
at 3 sigma, and never beyond its bound. A log-normal or triangular deviation follows the quantiles of its own
distribution. The middle is the median of every distribution, which is the nominal value if the campaign is symmetric
about it. `campaign_of` (spread.py) derives a campaign of normal deviations from their 3-sigma values.
"""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from maxq.control.kernel.records import Array
from maxq.design.model.dispersion import ADDED, SECTIONS, Dispersion
from maxq.design.model.node import Node
from maxq.design.model.spread import Spread, with_actuators_apart
from maxq.sim.campaign.plan import Draw, Drawn, Plan
from maxq.sim.campaign.read import LoadedCampaign
from maxq.sim.campaign.targets import Refused, Target
from maxq.sim.input.errors import ScenarioError
from maxq.sim.input.remembered import cached_by_identity
from maxq.sim.scenario.loader import LoadedScenario
from maxq.sim.scenario.schema_vehicle import Stage

_LEAST = 0.05  # smallest value in a search, relative to nominal, of a quantity that must be positive


class Rule(NamedTuple):
    """The field of `Dispersion` that a key of a stage changes, by the result to the `power`.

    `planes` are the planes in which the change acts. With `sensitivity`, the name of another key of the engine, the
    factor is the exponential of that key's value times the deviation.
    """

    field: str
    power: float = 1.0
    planes: tuple[str, ...] = ("pitch", "yaw")
    sensitivity: str = ""


RULES = {
    "bending.frequency_factor.#": Rule("bending_frequency"),
    "bending.damping_ratio.#": Rule("bending_damping"),
    "bending.gyro_slope_factor.#": Rule("bending_slope"),
    "bending.gimbal_shape_factor.#": Rule("bending_shape"),
    "spatial_modes.frequency_factor.#": Rule("bending_frequency"),
    "spatial_modes.damping_ratio.#": Rule("bending_damping"),
    "spatial_modes.gyro_slope_factor.#": Rule("bending_slope"),
    "spatial_modes.gimbal_shape_factor.#": Rule("bending_shape"),
    "tank.#.length_factor": Rule("slosh_frequency", -0.5),
    "tank.#.mass_factor": Rule("slosh_mass"),
    "tank.#.damping_factor": Rule("slosh_damping"),
    "tank.#.damping_ratio": Rule("slosh_damping_ratio"),
    "tank.#.second_damping_ratio": Rule("slosh_damping_ratio"),
    "actuator.#.omega_hz.#": Rule("actuator_sections"),
    "actuator.#.zeta.#": Rule("actuator_sections"),
    "actuator.#.yaw.omega_hz.#": Rule("actuator_sections", planes=("yaw",)),
    "actuator.#.yaw.zeta.#": Rule("actuator_sections", planes=("yaw",)),
    "computer.delay_s": Rule("delay_s"),
    "engine.#.thrust_factor": Rule("thrust"),
    "engine.#.mass_flow_factor": Rule("mass_flow"),
    "engine.#.propellant_temperature_K": Rule("mass_flow", sensitivity="temperature_sensitivity_1pK"),
    "aero.force_factor": Rule("normal_force"),
    "aero.axial_factor": Rule("axial_force"),
    "aero.damping_factor": Rule("rate_damping"),
    "aero.centre_shift_m": Rule("centre_of_pressure_m"),
    "mass.table.mass_kg": Rule("mass"),
    "mass.table.x_cg_m": Rule("centre_of_gravity_m"),
    "mass.table.y_cg_m": Rule("centre_of_gravity_y_m"),
    "mass.table.z_cg_m": Rule("centre_of_gravity_z_m"),
    "mass.table.Ixx_kgm2": Rule("roll_inertia"),
    "mass.table.Iyy_kgm2": Rule("inertia"),
    "mass.table.Izz_kgm2": Rule("inertia"),
    "mass.inertia_kgm2.#.#": Rule("inertia"),
    "mass.mass_kg": Rule("mass"),
    "mass.x_cg_m": Rule("centre_of_gravity_m"),
    "mass.y_cg_m": Rule("centre_of_gravity_y_m"),
    "mass.z_cg_m": Rule("centre_of_gravity_z_m"),
}
"""The rules by key of a stage, without the number of a single engine or actuator. # represents a number."""
UNREAD = re.compile(
    r"engine(\.#)?\.(misalignment_deg\.#|roll_arm_m)|actuator(\.#)?(\.yaw)?\.(rate_limit_degps|angle_limit_deg|stop_deg|stall_torque_Nm"
    r"|backlash_deg|bias_deg\.#)|cutoff_decay_(s|factor)"
    r"|gyro\.(bias_degph|scale_factor|misalignment_deg)\.#|gyro\.noise_deg_rt_h|computer\.command_limit_deg"
    r"|mass\.table\.I(xy|xz|yz)_kgm2"
)
"""A pattern for keys of a stage that no margin depends on: errors and limits that a linear model omits."""
_ACTUATOR, _OF_ONE = re.compile(r"^(actuator|engine)\.(?!#\.)"), r"\1.#."


class Act(NamedTuple):
    """The change of one element of a `Dispersion` field by one target of a draw."""

    draw: Draw
    target: int
    field: str
    part: int  # index in the field
    power: float
    of_whole: bool  # True if the result is a factor or an increment rather than a new value
    sensitivity: float | None = None  # derivative of the field's logarithm

    def change(self, result: Array) -> Array:
        """Return the factors or increments for the results of the draw, (vehicles,)."""
        target, added = self.draw.targets[self.target], self.field in ADDED
        if self.sensitivity is not None:
            return np.asarray(np.exp(self.sensitivity * (result - target.nominal)))
        if not self.of_whole:
            result = result - np.nan_to_num(target.nominal) if added else result / target.nominal
        return result if added else np.power(result, self.power)


@dataclass(frozen=True)
class Deviations:
    """The draws of a campaign that change the stage of an operating point.

    Scores `u` (places,) are independent, in the order of `places`, and in units of 3 sigma.
    """

    campaign: LoadedCampaign
    node: Node

    @cached_property
    def _found(self) -> tuple[list[Act], list[str]]:
        vehicle, node, left_out = self.campaign.base.vehicle, self.node, []
        acts = list[Act]()
        if node.stage >= len(vehicle.stage):
            return acts, []
        for draw in self.campaign.plan.draws:
            for n, target in enumerate(draw.targets):
                key = _key_in_stage(target.key, vehicle.stage[node.stage], node.stage)
                if key is None or UNREAD.fullmatch(re.sub(r"\.\d+", ".#", key)):
                    continue
                mine = (
                    []
                    if draw.is_text or draw.where
                    else list(_acts(draw, n, target, key, vehicle.stage[node.stage], node))
                )
                acts += mine
                if not mine and not any(node.plane not in r.planes for r in [_rule_of(key)] if r):
                    left_out.append(draw.name)
        return acts, left_out

    @property
    def left_out(self) -> tuple[str, ...]:
        """Return the names of the draws that change the stage in a way that `RULES` does not cover."""
        acting = {act.draw.name for act in self._found[0]}
        return tuple(dict.fromkeys(name for name in self._found[1] if name not in acting))

    @cached_property
    def _plan(self) -> Plan:
        """Return the plan of the draws that act at this point and of the draws with which they are correlated."""
        names = {act.draw.name for act in self._found[0]}
        entries = {act.draw.entry for act in self._found[0] if act.draw.group is not None}
        every = self.campaign.plan
        while more := {name for i, j, _ in every.pairs if {i, j} & names for name in (i, j)} - names:
            names |= more
        draws = tuple(d for d in every.draws if d.name in names or (d.group is not None and d.entry in entries))
        return Plan(every.campaign, draws, None)

    @cached_property
    def places(self) -> tuple[str, ...]:
        """Return the name of each score, which is the label of its draw."""
        labels = [d.label for d in self._plan.draws]
        by_stream = {d.stream: d for d in reversed(self._plan.draws)}
        each = [by_stream[stream] for stream in self._plan.score_names]
        return tuple(d.label if labels.count(d.label) == 1 else d.name for d in each)

    @cached_property
    def fields(self) -> tuple[str, ...]:
        """Return the field of `Dispersion` that each score changes first."""
        first: dict[str, str] = {}
        for act in self._found[0]:
            first.setdefault(act.draw.stream, act.field)
        return tuple(first.get(stream, "") for stream in self._plan.score_names)

    def at(self, u: Array, label: str = "") -> Dispersion:
        """Return the deviated vehicle for scores `u` (places,)."""
        return self.of_scores([u], [label])[0]

    def of_scores(self, every: Sequence[Array], labels: Sequence[str] = ()) -> list[Dispersion]:
        """Return the deviated vehicles for several vectors of scores."""
        z = 3.0 * np.reshape(np.asarray(every, float), (len(every), len(self.places)))
        drawn, _ = self._plan.of_scores(z, np.zeros(len(z), np.int64))
        return self._dispersions(self._within(drawn), labels or [""] * len(every))

    def drawn(self, numbers: range) -> list[Dispersion]:
        """Return the vehicles of the given runs of the campaign.

        The campaign redraws a run if its values are mutually inconsistent. Such runs are not redrawn here.
        """
        plan = dataclasses.replace(self.campaign.plan, wind=None)  # wind draws are separate streams
        found = plan.draw(numbers.start, len(numbers)) if len(numbers) else Drawn(0, np.zeros(0, np.int64))
        results = {place: np.array(found.flown.get(place, ()), float) for place in self._wanted}
        return self._dispersions(results, [f"vehicle {n}" for n in numbers])

    def scenario(self, base: LoadedScenario, u: Array) -> LoadedScenario:
        """Return the scenario `base` with the deviated vehicle for scores `u`.

        Raises ScenarioError if the vehicle is not possible.
        """
        drawn, _ = self._plan.of_scores(3.0 * np.reshape(u, (1, -1)), np.zeros(1, np.int64))
        values = {place: float(result[0]) for place, result in self._within(drawn).items()}
        base = with_actuators_apart(base, self.campaign.base.vehicle)
        try:
            return dataclasses.replace(self.campaign, base=base).changed({}, values)
        except Refused as refused:
            raise ScenarioError(
                self.campaign.name, f"a deviated vehicle is not possible: {refused}", "disperse"
            ) from None

    @cached_property
    def _wanted(self) -> list[tuple[str, int]]:
        return [(d.name, n) for d in self._plan.draws for n in range(len(d.targets)) if not d.is_text]

    def _within(self, drawn: Drawn) -> dict[tuple[str, int], Array]:
        """Return the results by draw and target, limited to the bounds of the draws."""
        out = {}
        for d in self._plan.draws:
            for n, target in enumerate(() if d.is_text else d.targets):
                result = np.clip(
                    np.array(drawn.flown[d.name, n], float),
                    -np.inf if d.spec.at_least is None else d.spec.at_least,
                    np.inf if d.spec.at_most is None else d.spec.at_most,
                )
                for mark, bound in target.bounds:  # a search stops at the bound, whereas a campaign redraws
                    if mark in ("gt", "ge"):
                        least = bound + (_LEAST * abs(target.nominal) if mark == "gt" else 0.0)
                        result = np.maximum(result, least)
                    else:
                        result = np.minimum(result, bound)
                out[d.name, n] = result
        return out

    def _dispersions(self, results: dict[tuple[str, int], Array], labels: Sequence[str]) -> list[Dispersion]:
        """Return the deviated vehicles from the results by draw and target."""
        fields: dict[str, Array] = {}
        for act in self._found[0]:
            if act.field not in fields:
                shape = (self._parts(act.field), len(labels))
                fields[act.field] = np.zeros(shape) if act.field in ADDED else np.ones(shape)
            change, mine = act.change(results[act.draw.name, act.target]), fields[act.field]
            mine[act.part] = mine[act.part] + change if act.field in ADDED else mine[act.part] * change
        each = {name: values.T.tolist() for name, values in fields.items()}
        single = [name for name, values in fields.items() if len(values) == 1 and self._parts(name) == 1]
        out = []
        for k, label in enumerate(labels):
            values: dict[str, Any] = {name: rows[k][0] if name in single else rows[k] for name, rows in each.items()}
            out.append(Dispersion(**values, label=label))
        return out

    def _parts(self, field: str) -> int:
        return _parts_of(field, self.node)


@cached_by_identity
def deviations_of(campaign: LoadedCampaign, node: Node) -> Deviations:
    """Return the deviations of a campaign's draws at an operating point."""
    return Deviations(campaign, node)


def acting_at(campaign: LoadedCampaign, spread: Spread, node: Node) -> LoadedCampaign:
    """Return the campaign.

    Raises ScenarioError if `spread` names the campaign and none of its draws changes the operating point.
    """
    if spread.campaign is not None and not deviations_of(campaign, node).places:
        source, at = spread.where
        problem, allowed = (
            "changes nothing that a loop depends on",
            "one that disperses the vehicle, or three sigma here",
        )
        raise ScenarioError(source, problem, f"{at}.campaign", value=spread.campaign, allowed=allowed)
    return campaign


def _parts_of(field: str, node: Node) -> int:
    sizes, engine = node.held.sizes, node.held.vehicle["engine"]
    if field.startswith("bending"):
        return len(node.vehicle.omega_radps)
    if field.startswith("slosh"):
        return len(node.held.swing_rad)
    many = {"thrust": int(np.sum(engine["parts"][0] > 0.0)), "inertia": 2}
    many |= {"mass_flow": many["thrust"], "actuator_sections": SECTIONS * (1 + int(sizes.further_groups))}
    return many.get(field, 1)


def _key_in_stage(key: str, stage: Stage, number: int) -> str | None:
    """Return a key path of the scenario as a key of the stage, or None if it does not belong to the stage."""
    prefix = f"vehicle.stage.{number}."
    if key.startswith(prefix):
        return stage.counted_key(key.removeprefix(prefix))
    name = key.removeprefix("vehicle.computer.")
    own = stage.computer is not None and getattr(stage.computer, name, None) is not None
    return None if name == key or own else f"computer.{name}"


def _rule_of(key: str) -> Rule | None:
    pattern = re.sub(r"\.\d+", ".#", key)
    return RULES.get(pattern) or RULES.get(_ACTUATOR.sub(_OF_ONE, pattern))


def _acts(draw: Draw, n: int, target: Target, key: str, stage: Stage, node: Node) -> Iterator[Act]:
    """Yield the changes by one target of a draw, or nothing if `RULES` does not cover the key or the kind of draw."""
    rule = _rule_of(key)
    if rule is None or node.plane not in rule.planes:
        return
    field, numbers, whole = rule.field, [int(part) for part in re.findall(r"\.(\d+)", key)], target.kind == "column"
    apply = draw.spec.apply
    if field == "mass" and whole and apply == "add":
        field = "mass_kg"
    if whole and (apply != "add" if field in ADDED else apply != "scale"):
        return
    if not whole and field not in ADDED and not target.nominal > 0.0:
        return
    for index in _indices(key, numbers, stage, node):
        if index < _parts_of(field, node):
            of = getattr(stage.engines[index], rule.sensitivity) if rule.sensitivity else None
            yield Act(draw, n, field, index, rule.power, whole, of)


def _indices(key: str, numbers: list[int], stage: Stage, node: Node) -> Sequence[int]:
    """Return the indices in a field that correspond to a key of a stage."""
    part = key.partition(".")[0]
    spatial = int(node.held.sizes.spatial_modes)
    if part == "bending":
        return [spatial + numbers[0]]
    if part == "spatial_modes":
        return [numbers[0]] if numbers[0] < spatial else []
    if part == "tank":
        return _pendulums_of(stage, numbers[0], key)
    if part == "engine":
        return [numbers[0] if numbers else 0]
    if part == "actuator":
        return _sections(key, numbers, stage, node)
    if part == "mass" and numbers:
        return [numbers[0] - 1] if numbers[0] == numbers[1] > 0 else []
    return [int(key == "mass.table.Izz_kgm2")]


def _sections(key: str, numbers: list[int], stage: Stage, node: Node) -> list[int]:
    """Return the indices in `actuator_sections` that correspond to an actuator's key in the plane of the node."""
    several = isinstance(stage.actuator, tuple)
    given = stage.actuator[numbers[0]] if isinstance(stage.actuator, tuple) else stage.actuator
    assert given is not None
    section = numbers[-1]
    of_yaw = given.yaw is not None and getattr(given.yaw, "omega_hz" if ".omega_hz." in key else "zeta") is not None
    if of_yaw and ".yaw." not in key and node.plane == "yaw":
        return []
    if given.axes[node.plane == "yaw"].exchange_a3_a4 and section >= 2:
        section = 5 - section
    section += 4 if ".zeta." in key else 0
    groups = range(len(stage.engine_groups)) if not several else [stage.engine_groups.index(given.group or "")]
    return [SECTIONS * group + section for group in groups]


def _pendulums_of(stage: Stage, tank: int, key: str) -> list[int]:
    """Return the pendulums of a tank that a key changes: all of its modes, or the mode with its own damping ratio."""
    tanks = [each for *_, each in stage.tanks]
    first = sum(each.pendulums for each in tanks[:tank])
    mine = list(range(first, first + tanks[tank].pendulums))
    if key.endswith("second_damping_ratio"):
        return mine[1:]
    own = key.endswith("damping_ratio") and tanks[tank].second_damping_ratio is not None
    return mine[:1] if own else mine
