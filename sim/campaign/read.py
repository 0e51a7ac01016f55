"""The reader of campaigns, which checks them against their scenario and gives the scenario of each run.

    campaign = load_campaign("campaigns/ksr3")
    campaign.inputs(417).recorded                       # the draws, by column
    campaign.scenario_of(417).scenario                  # the scenario of the run

Each dispersed value must exist in the scenario, be dispersed once, and satisfy its bounds.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import TypeAdapter, ValidationError
from pydantic_core import PydanticCustomError

from maxq.sim.campaign.draws import box
from maxq.sim.campaign.error import CampaignError
from maxq.sim.campaign.plan import MOST_ATTEMPTS, SEED_KEY, WIND_KEY, Draw, Drawn, Ensemble, Plan, VectorWind
from maxq.sim.campaign.schema import Campaign, CampaignFile, Disperse
from maxq.sim.campaign.targets import Dispersed, Refused, Target, TargetChange, find_target
from maxq.sim.input.documents import plain, source_of
from maxq.sim.input.errors import Path as KeyPath
from maxq.sim.input.errors import refuse
from maxq.sim.input.files import Reading
from maxq.sim.input.tables_csv import Columns, CsvTable
from maxq.sim.scenario.loader import CAMPAIGN_SECTIONS, LoadedScenario, load_scenario_text, load_with_sections, told
from maxq.sim.scenario.messages import explain, field_at
from maxq.sim.scenario.schema_scenario import Scenario

DrawPlace = tuple[str, int]
"""The name of a draw, and the number of its target."""
ACCURACY = 0.05
"""The run.accuracy of campaigns that give neither run.accuracy nor run.step_s (docs/performance.md)."""
_PLAUSIBLE_SIGMAS = 3.0
_JOINT = 1 << 20  # first attempt of a whole run with incompatible values, distinct from the attempts of single keys


@dataclass(frozen=True)
class Inputs:
    """The recorded draws of a run, and the scenario that follows from them."""

    run: int
    recorded: dict[str, Any]  # by column: number or text
    redraws: int
    loaded: LoadedScenario


@dataclass(frozen=True)
class LoadedCampaign:
    """A campaign that can be flown."""

    base: LoadedScenario
    file: CampaignFile
    plan: Plan

    @property
    def name(self) -> str:
        return self.base.name

    @property
    def campaign(self) -> Campaign:
        return self.file.campaign

    def __repr__(self) -> str:
        return f"<LoadedCampaign {self.name} ({self.base.label}): {self.campaign.runs} runs>"

    def with_campaign(self, **changes: Any) -> LoadedCampaign:
        """Return the campaign with other values in [campaign], such as runs, seed or keep, but the same stratum."""
        before = self.campaign
        if before.sampling == "latin-hypercube" and before.stratum is None and "stratum" not in changes:
            changes["stratum"] = max(before.runs, 1)
        campaign = before.model_copy(update=changes)
        file = self.file.model_copy(update={"campaign": campaign})
        return LoadedCampaign(self.base, file, Plan(campaign, self.plan.draws, self.plan.wind))

    def inputs(self, run: int, drawn: Drawn | None = None) -> Inputs:
        """Return the draws and the scenario of a run, from the batch `drawn` if it is given.

        A run with incompatible values is drawn again as a whole. Raises CampaignError if the campaign does not allow
        this, and Refused if repeated draws do not help. Threads may call this method in parallel.
        """
        redraws = 0
        drawn = drawn or self.plan.draw(run, 1)
        while True:
            try:
                loaded = self.mixed(drawn, run)
                break
            except Refused as refused:
                if self.campaign.outside == "refuse":
                    raise CampaignError(f"run {run}: {refused}; outside = 'resample' draws again") from None
                redraws += 1
                if redraws > MOST_ATTEMPTS or not self.plan.draws:
                    raise
                drawn = self.plan.draw(run, 1, _JOINT * redraws)
        at = run - drawn.first
        recorded = {name: values[at] for name, values in drawn.recorded.items()}
        if drawn.wind is not None and self.plan.wind is not None:
            recorded |= self.plan.wind.recorded(drawn.wind[at])
        return Inputs(run, recorded, int(drawn.redraws[at]) + redraws, loaded)

    def scenario_of(self, run: int) -> LoadedScenario:
        """Return the scenario of run `run`."""
        return self.inputs(run).loaded

    def mixed(self, drawn: Drawn, run: int, kept: Iterable[str] | None = None) -> LoadedScenario:
        """Return the scenario of a run from the batch `drawn`. Raises Refused.

        If `kept` is given, only these inputs are dispersed, and all others are nominal.
        """
        return self._loaded(self.values_of(drawn, run, kept))

    def changed(self, draws: Mapping[str, float], further: Mapping[DrawPlace, Any] | None = None) -> LoadedScenario:
        """Return the scenario with the draws `draws`, by name, and all other values nominal. Raises Refused.

        `further` contains further values of a run, from `values_of`.
        """
        values: dict[DrawPlace, Any] = dict(further or {})
        for d in self.plan.draws:
            if d.name in draws:
                results = d.results(np.array([float(draws[d.name])]))
                values |= {(d.name, n): float(result[0]) for n, result in enumerate(results)}
        return self._loaded(values)

    def values_of(self, drawn: Drawn, run: int, names: Iterable[str] | None) -> dict[DrawPlace, Any]:
        """Return the values of the inputs `names` (None: all) in run `run`, for the argument `further` of `changed`.

        The inputs include the wind and the seed of the noise.
        """
        at = run - drawn.first
        values = {place: values[at] for place, values in drawn.flown.items()}
        if drawn.wind is not None and self.plan.wind is not None:
            values[WIND_KEY, 0] = self.plan.wind.profile(drawn.wind[at])
        wanted = None if names is None else set(names)
        return {place: value for place, value in values.items() if wanted is None or place[0] in wanted}

    def _loaded(self, values: Mapping[DrawPlace, Any]) -> LoadedScenario:
        return LoadedScenario(self._dispersed(values), self.base.label, self.base.files)

    @cached_property
    def _dispersed(self) -> Dispersed:
        changes = [
            TargetChange(t, d.spec.apply if t.kind == "column" else "set", (d.name, n), d.where)
            for d in self.plan.draws
            for n, t in enumerate(d.targets)
        ]
        changes += [TargetChange(find_target(self.base.scenario, key), "set", (key, 0)) for key in self._extra]
        return Dispersed(self.base.scenario, changes)

    @property
    def _extra(self) -> list[str]:
        return [SEED_KEY] * self.plan.own_noise + [WIND_KEY] * (self.plan.wind is not None)

    @cached_property
    def input_names(self) -> tuple[str, ...]:
        """Return the names of all inputs that are drawn for a run."""
        return (*(d.name for d in self.plan.draws), *self._extra)

    def boxes(self, sigmas: float = 3.0) -> dict[str, tuple[float, float]]:
        """Return the least and greatest draw of each input with a distribution of numbers, by name, for a search."""
        out = {}
        for d in self.plan.draws:
            if d.is_text or d.spec.distribution in ("choice", "samples", "cases"):
                continue
            if d.group is not None and d.spec.covariance is not None:
                centre = d.spec.centre(d.nominal)
                reach = sigmas * float(np.sqrt(d.spec.covariance[d.group[1]][d.group[1]]))
                out[d.name] = (centre - reach, centre + reach)
            else:
                out[d.name] = box(d.spec, d.nominal, sigmas)
        return out

    @cached_property
    def warnings(self) -> tuple[str, ...]:
        """Return a line for each implausible value of the scenario, and for each draw that may change a sign."""
        boxes, found = self.boxes(_PLAUSIBLE_SIGMAS), []
        for d in self.plan.draws:
            if d.name not in boxes or d.targets[0].is_angle:
                continue
            low, high = sorted(d.results(np.array(boxes[d.name]))[0].tolist())
            spec = d.spec
            low = low if spec.at_least is None else max(low, spec.at_least)
            high = high if spec.at_most is None else min(high, spec.at_most)
            of_factor = d.targets[0].kind == "column" and d.spec.apply == "scale"
            centre = 1.0 if of_factor else d.nominal
            if (of_factor or d.targets[0].kind == "number") and low * centre < 0.0 < high * centre:
                found.append(
                    f"{d.name} is not expected to change its sign, as it does between {low:.4g} and {high:.4g} "
                    f"({_PLAUSIBLE_SIGMAS:g} sigma); usual: a smaller spread, or at_least and at_most"
                )
        return (*self.base.warnings, *found)


def load_campaign(path: str | Path, overrides: Iterable[str] = ()) -> LoadedCampaign:
    """Return the campaign in a file, or the built-in campaign of that name, with `key=value` overrides.

    Raises ScenarioError.
    """
    loaded, tree, reading = load_with_sections(path, CAMPAIGN_SECTIONS, overrides)
    run = loaded.scenario.run
    if run.accuracy is None and "step_s" not in run.model_fields_set:
        run = run.model_copy(update={"accuracy": ACCURACY})
        loaded = replace(loaded, scenario=loaded.scenario.model_copy(update={"run": run}))
    try:
        file = CampaignFile.model_validate(plain(tree), context=reading)
        return made_of(loaded, file, reading)
    except ValidationError as error:
        raise explain(error, tree, CampaignFile) from None
    except PydanticCustomError as wrong:
        found = wrong.context or {}
        at = found["key"]
        raise source_of(tree, at).error(at, found["problem"], allowed=found["allowed"], value=found["value"]) from None


def description_of(campaign: LoadedCampaign) -> dict[str, Any]:
    """Return a campaign, including its files, as a JSON object, from which `campaign_from` makes the same campaign."""
    tables = {d.name: told(d.tables) for d in campaign.plan.draws if d.tables}
    return {"scenario": campaign.base.as_flown, "wind_model": None, **told(campaign.file), "tables": tables}


def campaign_from(description: Mapping[str, Any], label: str = "campaign") -> LoadedCampaign:
    """Return the campaign in a description. Raises ScenarioError or ValidationError if the description is corrupt."""
    loaded = load_scenario_text(description["scenario"], (), label)
    parts = {name: description[name] for name in CAMPAIGN_SECTIONS if description.get(name) is not None}
    file = CampaignFile.model_validate(plain(parts))
    return made_of(loaded, file, given=plain(description.get("tables", {})))


def made_of(
    loaded: LoadedScenario,
    file: CampaignFile,
    reading: Reading | None = None,
    given: Mapping[str, tuple[Any, ...]] | None = None,
) -> LoadedCampaign:
    """Return the campaign that disperses `loaded` as specified in `file`.

    `given` contains the tables of choices among files, by name of the draw, for a campaign without access to its files.
    Raises PydanticCustomError, which `load_campaign` reports as a ScenarioError.
    """
    found = [d for n, spec in enumerate(file.disperse) for d in _draws(loaded, spec, n, reading, given or {})]
    _check_overlaps(file, found)
    wind: Ensemble | VectorWind | None = None
    if file.wind_model is not None:
        model, scenario_wind = file.wind_model, loaded.scenario.wind
        if scenario_wind.speed_mps is not None:
            raise refuse("cannot be combined with wind.speed_mps", key=("wind_model", "model"), value=model.model)
        if model.model == "ensemble":
            wind = Ensemble(model)
        elif scenario_wind.profile is not None:
            wind = VectorWind(model, scenario_wind.profile)
        else:
            problem = "there is no wind.profile to deviate from"
            raise refuse(problem, "wind.profile", ("wind_model", "model"), value="vector")
    known = channel_units(loaded)
    for n, channel in enumerate(file.campaign.envelope.channels):
        if channel not in known:
            path = ("campaign", "envelope", "channels", n)
            raise refuse("is not a log channel (docs/telemetry.md)", key=path, value=channel)
    plan = Plan(file.campaign, tuple(found), wind)
    _check_correlated(plan)
    return LoadedCampaign(loaded, file, plan)


_CONTINUOUS = ("normal", "truncated-normal", "uniform", "log-normal", "triangular")


def _check_correlated(plan: Plan) -> None:
    """Reject correlated pairs that are not two independent continuous draws, and incompatible coefficients."""
    free = [d for d in plan.draws if d.spec.distribution in _CONTINUOUS and d.group is None]
    for n, pair in enumerate(plan.campaign.correlated):
        found = [[d.name for d in free if name in (d.name, d.label)] for name in pair.of]
        if [len(names) for names in found] != [1, 1] or found[0] == found[1]:
            allowed = f"two of {', '.join(d.label for d in free) or 'no draws'}"
            raise refuse("are not two draws", allowed, ("campaign", "correlated", n, "of"), value=pair.of)
    if plan.pairs and np.linalg.eigvalsh(plan.correlation[1])[0] < -1e-9:
        problem, allowed = "these coefficients exclude each other", "those of a positive semidefinite matrix"
        raise refuse(problem, allowed, ("campaign", "correlated"), value=len(plan.campaign.correlated))


def _check_overlaps(file: CampaignFile, found: list[Draw]) -> None:
    """Reject dispersions in which a value of the scenario is drawn twice."""
    taken = set()
    for d in found:
        key: KeyPath = ("disperse", d.entry, "key")
        for target in d.targets:
            in_column = target.kind == "column"
            place = (target.key, d.where, d.spec.tag if in_column else None)
            if place in taken:
                allowed = "two draws that scale or add to a column, each with a tag" if in_column else ""
                raise refuse("is dispersed twice", allowed, key, value=target.key)
            taken.add(place)
            if target.key == WIND_KEY and file.wind_model is not None:
                raise refuse("is already drawn by [wind_model]", key=key, value=target.key)
            if target.key == SEED_KEY and file.campaign.noise == "each-run":
                allowed = "'as-scenario' with such a draw"
                raise refuse("run.seed is dispersed", allowed, ("campaign", "noise"))


def channel_units(loaded: LoadedScenario) -> dict[str, str]:
    """Return the units of the log channels that an envelope may contain, by name."""
    from maxq.sim.flight.telemetry import FAST, SLOW  # noqa: PLC0415  # lazy: loads the kernels' modules
    from maxq.sim.packing.schedule import stage_sizes  # noqa: PLC0415  # lazy: as above
    from maxq.sim.run.fly import logged_channels  # noqa: PLC0415  # lazy: as above

    stages = loaded.vehicle.stage
    widest = max((stage_sizes(stage, loaded.scenario.switches) for stage in stages), key=lambda s: s.pendulums)
    table = logged_channels(loaded.scenario, widest)
    return {channel.name: channel.unit for group in (FAST, SLOW) for channel in table.columns(group)}


def _elements(scenario: Scenario, key: str, where: KeyPath) -> list[Target]:
    """Return the targets of a key path with `*` for one or more parts, each of which denotes all elements of a list."""
    head, _, tail = key.partition(".*")
    found: list[Target] = []
    for n in itertools.count():
        one = f"{head}.{n}{tail}"
        try:
            found += _elements(scenario, one, where) if "*" in tail else [find_target(scenario, one)]
        except PydanticCustomError as bad:
            context = bad.context or {}
            if found and f"has no element {n}" in context["problem"]:
                return found
            raise refuse(context["problem"], context["allowed"], where, value=key) from None
    return found


def _draws(
    loaded: LoadedScenario, spec: Disperse, entry: int, reading: Reading | None, given: Mapping[str, tuple[Any, ...]]
) -> Iterator[Draw]:
    """Yield the draws of the [[disperse]] entry `spec` with the index `entry`."""
    here: KeyPath = ("disperse", entry)

    def target_of(key: str, where: KeyPath) -> Target:
        try:
            target = find_target(loaded.scenario, key)
        except PydanticCustomError as bad:
            found = bad.context or {}
            raise refuse(found["problem"], found["allowed"], where, value=key) from None
        _check_fits(spec, target, here)
        return target

    def named(key: str) -> str:
        """Return the name of the column in the data set, which consists of key, selected table rows and tag."""
        marks = [f"{name}={value:g}" for name, value in (spec.where or {}).items()] + [spec.tag] * bool(spec.tag)
        return f"{key}[{','.join(marks)}]" if marks else key

    if spec.distribution == "cases" and spec.file is not None:
        for key, column in spec.file.columns.items():
            yield Draw(named(key), key, entry, spec, (target_of(key, (*here, "file")),), samples=column)
        return
    if spec.key is not None and "*" in spec.key.split("."):
        for n, target in enumerate(_elements(loaded.scenario, spec.key, (*here, "key"))):
            _check_fits(spec, target, here)
            label = f"{spec.name} {n + 1}" if spec.name else target.key
            yield Draw(named(target.key), label, entry, spec, (target,))
        return
    if spec.key is not None:
        keys, targets = [spec.key], [target_of(spec.key, (*here, "key"))]
    else:
        keys = list(spec.keys or ())
        targets = [target_of(key, (*here, "keys", n)) for n, key in enumerate(keys)]
    if spec.covariance is not None:
        for n, (key, target) in enumerate(zip(keys, targets, strict=True)):
            yield Draw(named(key), key, entry, spec, (target,), (entry, n))
        return
    name = named(keys[0])
    samples = spec.file[spec.sample_column] if spec.file is not None else None
    tables = _tables(spec, targets[0], here, reading, given.get(name)) if targets[0].kind == "table" else ()
    yield Draw(name, spec.name or keys[0], entry, spec, tuple(targets), samples=samples, tables=tables)


def _check_fits(spec: Disperse, target: Target, at: KeyPath) -> None:
    """Reject a distribution that is not suitable for the value to which it applies."""
    if target.kind in ("text", "table"):
        if spec.distribution != "choice" or spec.apply != "set":
            raise refuse(f"{target.key} holds no number", "'choice'", (*at, "distribution"), value=spec.distribution)
        if not all(isinstance(value, str) for value in spec.values or ()):
            raise refuse(f"{target.key} holds no number", "texts", (*at, "values"))
        return
    if any(isinstance(value, str) for value in spec.values or ()):
        raise refuse(f"{target.key} holds a number", "numbers", (*at, "values"))
    if spec.where is not None and target.kind != "column":
        raise refuse(f"{target.key} is not a column of a table", key=(*at, "where"))
    for name, value in (spec.where or {}).items():
        if name not in target.columns:
            raise refuse("the table has no such column", ", ".join(target.columns), (*at, "where", name), value=value)
    is_column = target.kind == "column"
    if spec.apply != "set" and not is_column and np.isnan(target.nominal):
        raise refuse(f"{target.key} has no value to start from", "'set'", (*at, "apply"), value=spec.apply)
    centre = {"normal": "mean", "truncated-normal": "mean", "log-normal": "median"}.get(spec.distribution)
    if spec.apply == "set" and centre is not None and getattr(spec, centre) is None and np.isnan(target.nominal):
        raise refuse(f"required key is missing: {target.key} has no value of its own", key=(*at, centre))


def _tables(
    spec: Disperse, target: Target, here: KeyPath, reading: Reading | None, given: tuple[Any, ...] | None
) -> tuple[CsvTable, ...]:
    """Return the tables among which a draw chooses, from its values or from `given`."""
    _, metadata = field_at(Scenario, target.path)
    columns = next(mark for mark in metadata if isinstance(mark, Columns))
    out = []
    for n, value in enumerate(given if given is not None else spec.values or ()):
        try:
            out.append(TypeAdapter(Annotated[CsvTable, columns]).validate_python(value, context=reading))
        except ValidationError as error:
            context = error.errors(include_url=False)[0].get("ctx", {})
            problem, allowed = context.get("problem", "is not such a table"), context.get("allowed", "")
            raise refuse(problem, allowed, (*here, "values", n), value=str(value)) from None
    return tuple(out)
