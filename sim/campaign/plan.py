"""A campaign file as a plan: what is drawn for each run, and the scenario that follows from the draws.

campaign = load_campaign("campaigns/ksr3")
values = campaign.plan.values(run=417)           # recorded inputs by column name
scenario = campaign.scenario_of(417).scenario    # what is flown
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import TypeAdapter, ValidationError

from maxq.control.records import Array
from maxq.sim.campaign import draws as numbers
from maxq.sim.campaign.distributions import box, chosen, correlated, quantile, standard_normal
from maxq.sim.campaign.error import CampaignError
from maxq.sim.campaign.schema import Campaign, CampaignFile, Disperse, plain_value, tuples
from maxq.sim.campaign.targets import BadKey, Change, Dispersed, Refused, Target, find_target
from maxq.sim.campaign.wind import WIND_KEY, WindDraw, wind_draw
from maxq.sim.flight.judgement import METRIC_NAMES
from maxq.sim.scenario.describe import field_at
from maxq.sim.scenario.documents import plain, source_of
from maxq.sim.scenario.errors import Path as KeyPath
from maxq.sim.scenario.files import Reading
from maxq.sim.scenario.loader import CAMPAIGN_SECTIONS, LoadedScenario, load_scenario_text, load_with_sections
from maxq.sim.scenario.messages import explain
from maxq.sim.scenario.schema_scenario import Scenario
from maxq.sim.scenario.tables_csv import Columns, CsvTable

SEED_KEY = "run.seed"
MOST_ATTEMPTS = 1000
_JOINT = 1 << 20  # attempts of a run whose values exclude each other begin here, apart from those of single keys

Batch = dict[str, Any]
"""Draws of consecutive runs by name: arrays (runs,), or a list of tables; see `Plan.columns`."""


@dataclass(frozen=True)
class Draw:
    """One random number of a run, and the places it goes to."""

    name: str  # of the column in the data set: the key path, or the first of several
    label: str
    entry: int  # of [[disperse]]
    spec: Disperse
    targets: tuple[Target, ...]
    group: tuple[int, int] | None = None  # (entry, position) where it is correlated with others of the entry
    samples: Array | None = None
    tables: tuple[CsvTable, ...] = ()  # choice among files

    @property
    def nominal(self) -> float:
        return self.targets[0].nominal

    @property
    def where(self) -> tuple[tuple[str, float], ...]:
        return tuple((self.spec.where or {}).items())

    @property
    def is_text(self) -> bool:
        return self.targets[0].kind in ("text", "table")

    @property
    def centre(self) -> float:
        """The mean of a normal draw; the draw that changes nothing, where the file does not say otherwise."""
        if self.spec.mean is not None:
            return self.spec.mean
        return {"set": self.nominal, "scale": 1.0, "add": 0.0}[self.spec.apply]

    def texts(self) -> tuple[str, ...]:
        assert self.spec.values is not None
        return tuple(str(value) for value in self.spec.values)


@dataclass
class Drawn:
    """What was drawn for consecutive runs."""

    first: int
    count: int
    draws: dict[str, np.ndarray]  # by name; of texts and tables the index
    results: dict[tuple[str, int], Array]  # by name and target: what stands in the scenario
    seeds: np.ndarray | None
    wind: np.ndarray | None
    redraws: np.ndarray = field(default_factory=lambda: np.zeros(0, np.int64))


@dataclass(frozen=True)
class Plan:
    """How the draws of a run come about. Nothing here is drawn in an order: see draws.py."""

    campaign: Campaign
    draws: tuple[Draw, ...]
    wind: WindDraw | None

    @property
    def own_noise(self) -> bool:
        return self.campaign.noise == "each-run"

    @cached_property
    def names(self) -> tuple[str, ...]:
        return tuple(draw.name for draw in self.draws)

    def draw(self, first: int, count: int, attempt: int = 0) -> Drawn:
        """Draws of the runs `first` .. `first + count - 1`; single values out of their bounds are drawn again.

        Raises CampaignError where the file says that such a draw is refused, or no draw is ever allowed.
        """
        sobol = numbers.Sobol(self.campaign.seed, self.names) if self._sobol(attempt) else None
        drawn = Drawn(first, count, {}, {}, None, None, np.zeros(count, np.int64))
        raw = {d.name: self._uniforms(d, first, count, attempt, sobol) for d in self.draws}
        groups: dict[int, list[Array]] = {}
        for d in self.draws:
            values = self._values(d, raw[d.name], first, count, raw, groups)
            values, results = self._within_bounds(d, values, drawn, attempt)
            drawn.draws[d.name] = values
            for n, result in enumerate(results):
                drawn.results[d.name, n] = result
        if self.own_noise:
            drawn.seeds = numbers.seeds(self.campaign.seed, SEED_KEY, first, count, attempt)
        if self.wind is not None:
            drawn.wind = self.wind.scores(self.campaign.seed, first, count, attempt)
        return drawn

    def _sobol(self, attempt: int) -> bool:
        return self.campaign.sampling == "sobol" and attempt == 0 and bool(self.draws)

    def _uniforms(self, d: Draw, first: int, count: int, attempt: int, sobol: numbers.Sobol | None) -> Array:
        seed, name = self.campaign.seed, self._stream(d)
        if d.spec.distribution == "cases":
            return numbers.uniforms(seed, name, first, count, attempt)
        if attempt == 0 and self.campaign.sampling == "latin-hypercube":
            stratum = self.campaign.stratum or max(self.campaign.runs, 1)
            return numbers.latin(seed, name, first, count, stratum)
        if sobol is not None:
            return sobol(d.name, first, count)
        return numbers.uniforms(seed, name, first, count, attempt)

    def _stream(self, d: Draw) -> str:
        """Cases draw a row: all columns the same."""
        return f"cases\0{d.entry}" if d.spec.distribution == "cases" else d.name

    def _values(
        self, d: Draw, u: Array, first: int, count: int, raw: Mapping[str, Array], groups: dict[int, list[Array]]
    ) -> np.ndarray:
        spec = d.spec
        if d.group is not None:
            entry, position = d.group
            if entry not in groups:
                members = [other for other in self.draws if other.entry == entry]
                assert spec.covariance is not None
                groups[entry] = correlated(spec.covariance, [standard_normal(raw[m.name]) for m in members])
            return np.asarray(d.centre + groups[entry][position])
        if spec.distribution == "choice":
            index = chosen(spec, u)
            if d.is_text:
                return index
            assert spec.values is not None
            return np.asarray(np.array([float(value) for value in spec.values])[index])
        if spec.distribution in ("samples", "cases"):
            assert d.samples is not None
            n = len(d.samples)
            in_turn = np.arange(first, first + count) % n
            rows = in_turn if spec.order == "in-turn" else np.minimum((u * n).astype(np.int64), n - 1)
            return np.asarray(d.samples[rows])
        return quantile(spec, u, d.nominal)

    def _within_bounds(self, d: Draw, values: np.ndarray, drawn: Drawn, attempt: int) -> tuple[np.ndarray, list[Array]]:
        if d.is_text:
            return values, []
        results = [target.result(d.spec.apply, values) for target in d.targets]
        good = self._good(d, results)
        if good.all():
            return values, results
        if (d.spec.outside or self.campaign.outside) == "refuse":
            at = int(np.argmin(good))
            raise CampaignError(
                f"run {drawn.first + at}: {d.name} = {results[0][at]:g} lies outside its bounds"
                f"{self._bounds_text(d)}; outside = 'resample' draws again, at_least and at_most cut the distribution"
            )
        for at in np.flatnonzero(~good).tolist():
            run = drawn.first + at
            for again in range(1, MOST_ATTEMPTS + 1):
                u = numbers.uniforms(self.campaign.seed, self._stream(d), run, 1, attempt + again)
                new = self._single(d, u, run, attempt + again)
                single = [target.result(d.spec.apply, new) for target in d.targets]
                if self._good(d, single).all():
                    break
            else:
                raise CampaignError(
                    f"run {run}: {MOST_ATTEMPTS} draws of {d.name} all lie outside its bounds{self._bounds_text(d)}; "
                    "change the distribution or the bounds"
                )
            values[at] = new[0]
            for result, one in zip(results, single, strict=True):
                result[at] = one[0]
            drawn.redraws[at] += again
        return values, results

    def _single(self, d: Draw, u: Array, run: int, attempt: int) -> np.ndarray:
        """One draw anew; of a correlated group with new scores for all of it."""
        raw = {d.name: u}
        if d.group is not None:
            for other in self.draws:
                if other.entry == d.entry:
                    raw[other.name] = numbers.uniforms(self.campaign.seed, other.name, run, 1, attempt)
        spec = d.spec
        if spec.order == "in-turn" and spec.distribution in ("samples", "cases"):
            d = replace(d, spec=spec.model_copy(update={"order": "random"}))
        return self._values(d, u, run, 1, raw, {})

    def _good(self, d: Draw, results: list[Array]) -> np.ndarray:
        good = np.ones(len(results[0]), bool)
        for target, result in zip(d.targets, results, strict=True):
            good &= target.allowed(result)
            if d.spec.at_least is not None:
                good &= result >= d.spec.at_least
            if d.spec.at_most is not None:
                good &= result <= d.spec.at_most
        return good

    def _bounds_text(self, d: Draw) -> str:
        words = [d.targets[0].bounds_text()]
        words += [f"at_least = {d.spec.at_least:g}"] if d.spec.at_least is not None else []
        words += [f"at_most = {d.spec.at_most:g}"] if d.spec.at_most is not None else []
        words = [word for word in words if word]
        return f" ({', '.join(words)})" if words else ""


@dataclass(frozen=True)
class Inputs:
    """What was drawn for one run, as it is recorded, and the scenario that follows."""

    run: int
    recorded: dict[str, Any]  # by column: number, text, or list of numbers
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

    def with_campaign(self, **changes: Any) -> LoadedCampaign:
        """The same with other values in [campaign]: runs, seed, keep. The stratum stays as it was."""
        before = self.campaign
        if before.sampling == "latin-hypercube" and before.stratum is None and "stratum" not in changes:
            changes["stratum"] = max(before.runs, 1)
        campaign = before.model_copy(update=changes)
        file = self.file.model_copy(update={"campaign": campaign})
        return LoadedCampaign(self.base, file, Plan(campaign, self.plan.draws, self.plan.wind))

    @cached_property
    def _dispersed(self) -> Dispersed:
        changes = [
            Change(t, d.spec.apply if t.kind == "column" else "set", f"{d.name}\0{n}", d.where)
            for d in self.plan.draws
            for n, t in enumerate(d.targets)
        ]
        if self.plan.own_noise:
            changes.append(Change(find_target(self.base.scenario, SEED_KEY), "set", SEED_KEY))
        if self.plan.wind is not None:
            changes.append(Change(find_target(self.base.scenario, WIND_KEY), "set", WIND_KEY))
        return Dispersed(self.base.scenario, changes)

    def batch(self, first: int, count: int) -> BatchInputs:
        """The draws of consecutive runs, made together."""
        return BatchInputs(self, self.plan.draw(first, count))

    def inputs(self, run: int) -> Inputs:
        """Draws and scenario of one run. Raises CampaignError, or Refused where no scenario is possible."""
        return self.batch(run, 1).inputs(run)

    def scenario_of(self, run: int) -> LoadedScenario:
        """What run `run` flies."""
        return self.inputs(run).loaded

    def made(self, drawn: Drawn, run: int) -> Inputs:
        """The scenario of one of the runs in `drawn`, and what is recorded of it. Raises Refused."""
        at = run - drawn.first
        loaded = self._loaded(self._flown(drawn, at))
        return Inputs(run, self._recorded(drawn, at), int(drawn.redraws[at]), loaded)

    def changed(self, draws: Mapping[str, float], further: Mapping[str, Any] | None = None) -> LoadedScenario:
        """The scenario in which these draws, by name, act, and all else is nominal. Raises Refused.

        `further`: what `surroundings` gave of a run.
        """
        values: dict[str, Any] = dict(further or {})
        for d in self.plan.draws:
            for n, target in enumerate(d.targets):
                if d.name in draws:
                    values[f"{d.name}\0{n}"] = float(target.result(d.spec.apply, np.array([float(draws[d.name])]))[0])
        return self._loaded(values)

    def surroundings(self, drawn: Drawn, run: int, names: Iterable[str]) -> dict[str, Any]:
        """What a run flies of the named inputs, e.g. its wind and its noise: for `changed`."""
        wanted = set(names)
        values = self._flown(drawn, run - drawn.first)
        return {name: value for name, value in values.items() if name.partition("\0")[0] in wanted}

    def mixed(self, drawn: Drawn, run: int, kept: Iterable[str]) -> LoadedScenario:
        """The scenario of a run with only the named inputs dispersed, all others nominal. Raises Refused."""
        names = set(kept)
        values = self._flown(drawn, run - drawn.first)
        return self._loaded({name: value for name, value in values.items() if name.partition("\0")[0] in names})

    def _loaded(self, values: Mapping[str, Any]) -> LoadedScenario:
        return LoadedScenario(self._dispersed(values), self.base.label, self.base.files)

    @cached_property
    def input_names(self) -> tuple[str, ...]:
        """All that is drawn for a run: names that `mixed` takes."""
        extra = [SEED_KEY] if self.plan.own_noise else []
        return (*self.plan.names, *extra, *([WIND_KEY] if self.plan.wind else []))

    def _recorded(self, drawn: Drawn, at: int) -> dict[str, Any]:
        out: dict[str, Any] = {}
        for d in self.plan.draws:
            if d.is_text:
                out[d.name] = d.texts()[int(drawn.draws[d.name][at])]
            else:
                out[d.name] = float(drawn.results[d.name, 0][at])
        if drawn.seeds is not None:
            out[SEED_KEY] = int(drawn.seeds[at])
        if drawn.wind is not None and self.plan.wind is not None:
            out |= self.plan.wind.recorded(drawn.wind[at])
        return out

    def _flown(self, drawn: Drawn, at: int) -> dict[str, Any]:
        values: dict[str, Any] = {}
        for d in self.plan.draws:
            for n in range(len(d.targets)):
                if d.is_text:
                    index = int(drawn.draws[d.name][at])
                    values[f"{d.name}\0{n}"] = d.tables[index] if d.tables else d.texts()[index]
                else:
                    values[f"{d.name}\0{n}"] = float(drawn.results[d.name, n][at])
        if drawn.seeds is not None:
            values[SEED_KEY] = int(drawn.seeds[at])
        if drawn.wind is not None and self.plan.wind is not None:
            values[WIND_KEY] = self.plan.wind.profile(drawn.wind[at])
        return values

    def boxes(self, sigmas: float = 3.0) -> dict[str, tuple[float, float]]:
        """Least and greatest draw of every numeric input: what a search may use."""
        out = {}
        for d in self.plan.draws:
            if d.is_text or d.spec.distribution in ("choice", "samples", "cases"):
                continue
            if d.group is not None:
                assert d.spec.covariance is not None
                reach = sigmas * float(np.sqrt(d.spec.covariance[d.group[1]][d.group[1]]))
                out[d.name] = (d.centre - reach, d.centre + reach)
            else:
                out[d.name] = box(d.spec, d.nominal, sigmas)
        return out


class BatchInputs:
    """The inputs of consecutive runs; `inputs` may be called from several threads."""

    def __init__(self, loaded: LoadedCampaign, drawn: Drawn) -> None:
        self._loaded, self._drawn = loaded, drawn

    def inputs(self, run: int) -> Inputs:
        """Draws and scenario of a run; drawn anew as a whole while its values exclude each other.

        Raises CampaignError where the file refuses that, Refused where it does not help.
        """
        loaded, drawn = self._loaded, self._drawn
        redraws = 0
        while True:
            try:
                made = loaded.made(drawn, run)
                return replace(made, redraws=made.redraws + redraws)
            except Refused as refused:
                if loaded.campaign.outside == "refuse":
                    raise CampaignError(f"run {run}: {refused}; outside = 'resample' draws again") from None
                redraws += 1
                if redraws > MOST_ATTEMPTS or not loaded.plan.draws:
                    raise
                drawn = loaded.plan.draw(run, 1, _JOINT * redraws)


# loading


def load_campaign(path: str | Path, overrides: Iterable[str] = ()) -> LoadedCampaign:
    """The campaign in a file, or the built-in one of that name, with `key=value` overrides. Raises ScenarioError."""
    loaded, tree, reading = load_with_sections(path, CAMPAIGN_SECTIONS, overrides, METRIC_NAMES)
    try:
        file = CampaignFile.model_validate(plain(tree), context=reading)
        return made_of(loaded, file, reading)
    except ValidationError as error:
        raise explain(error, tree, CampaignFile) from None
    except _Misplaced as wrong:
        raise source_of(tree, wrong.path).error(
            wrong.path, wrong.problem, allowed=wrong.allowed, **({"value": wrong.value} if wrong.value else {})
        ) from None


def description_of(campaign: LoadedCampaign) -> dict[str, Any]:
    """A campaign as JSON has it, files included: `campaign_from` makes the same one of it."""
    file = plain_value(campaign.file)
    tables = {d.name: [plain_value(table) for table in d.tables] for d in campaign.plan.draws if d.tables}
    return {
        "scenario": campaign.base.as_flown,
        "campaign": file["campaign"],
        "disperse": file["disperse"],
        "wind_model": file.get("wind_model"),
        "tables": tables,
    }


def campaign_from(description: Mapping[str, Any], label: str = "campaign") -> LoadedCampaign:
    """The campaign of a description. Raises ScenarioError or ValidationError where it was tampered with."""
    loaded = load_scenario_text(description["scenario"], (), METRIC_NAMES, label)
    parts = {name: description[name] for name in CAMPAIGN_SECTIONS if description.get(name) is not None}
    file = CampaignFile.model_validate(tuples(parts))
    return made_of(loaded, file, given=tuples(description.get("tables", {})))


def made_of(
    loaded: LoadedScenario,
    file: CampaignFile,
    reading: Reading | None = None,
    given: Mapping[str, tuple[Any, ...]] | None = None,
) -> LoadedCampaign:
    """The campaign that disperses `loaded` as `file` says. Raises what `load_campaign` puts into words.

    `given`: by name of a draw the tables among which it chooses, where no files can be read.
    """
    found: list[Draw] = []
    for n, spec in enumerate(file.disperse):
        found += _draws(loaded, spec, n, reading, given or {})
    taken: dict[tuple[str, tuple[tuple[str, float], ...]], str] = {}
    for d in found:
        for target in d.targets:
            place = (target.key, (*d.where, *([(d.spec.tag, 0.0)] if target.kind == "column" else [])))
            if place in taken:
                raise _Misplaced(
                    ("disperse", d.entry, "key"),
                    "is dispersed twice",
                    target.key,
                    _TAG if target.kind == "column" else "",
                )
            taken[place] = d.name
            if target.kind == "table" and file.wind_model is not None and target.key == WIND_KEY:
                raise _Misplaced(("disperse", d.entry, "key"), "is drawn by [wind_model] already", target.key)
    if file.campaign.noise == "each-run" and any(t.key == SEED_KEY for d in found for t in d.targets):
        raise _Misplaced(("campaign", "noise"), "run.seed is dispersed", allowed="'as-scenario' with such a draw")
    wind = None
    if file.wind_model is not None:
        if loaded.scenario.wind.profile is None and file.wind_model.model == "vector":
            raise _Misplaced(
                ("wind_model", "model"), "there is no wind.profile to deviate from", "vector", "wind.profile"
            )
        if loaded.scenario.wind.speed_mps is not None:
            raise _Misplaced(("wind_model", "model"), "cannot stand beside wind.speed_mps", file.wind_model.model)
        wind = wind_draw(file.wind_model, loaded.scenario.wind)
    _check_envelope(file, loaded)
    return LoadedCampaign(loaded, file, Plan(file.campaign, tuple(found), wind))


_TAG = "two draws that scale or add to a column, each with a tag"


class _Misplaced(Exception):
    """A mistake in a campaign file that only the scenario shows."""

    def __init__(self, path: KeyPath, problem: str, value: Any = "", allowed: str = "") -> None:
        super().__init__(problem)
        self.path, self.problem, self.value, self.allowed = path, problem, value, allowed


def _check_envelope(file: CampaignFile, loaded: LoadedScenario) -> None:
    from maxq.sim.campaign.flying import channel_units  # noqa: PLC0415  # it loads the kernels' modules

    known = channel_units(loaded)
    for n, channel in enumerate(file.campaign.envelope.channels):
        if channel not in known:
            path = ("campaign", "envelope", "channels", n)
            raise _Misplaced(path, "is no log channel (docs/telemetry.md)", channel)


def _draws(
    loaded: LoadedScenario,
    spec: Disperse,
    entry: int,
    reading: Reading | None,
    given: Mapping[str, tuple[Any, ...]],
) -> list[Draw]:
    scenario = loaded.scenario

    def target_of(key: str, where: KeyPath) -> Target:
        try:
            target = find_target(scenario, key)
        except BadKey as bad:
            raise _Misplaced(where, bad.problem, key, bad.allowed) from None
        _check_fits(spec, target, where)
        return target

    here: KeyPath = ("disperse", entry)
    if spec.distribution == "cases":
        assert spec.file is not None
        return [
            Draw(_column_name(key, spec), key, entry, spec, (target_of(key, (*here, "file")),), samples=column)
            for key, column in spec.file.columns.items()
        ]
    if spec.key is not None:
        keys: tuple[str, ...] = (spec.key,)
        places: list[KeyPath] = [(*here, "key")]
    else:
        keys = spec.keys or ()
        places = [(*here, "keys", n) for n in range(len(keys))]
    targets = [target_of(key, place) for key, place in zip(keys, places, strict=True)]
    if spec.covariance is not None:
        return [
            Draw(_column_name(key, spec), key, entry, spec, (target,), (entry, n))
            for n, (key, target) in enumerate(zip(keys, targets, strict=True))
        ]
    samples = None
    if spec.distribution == "samples":
        assert spec.file is not None
        samples = spec.file.columns[spec.column or spec.file.only]
    name = _column_name(keys[0], spec)
    tables: tuple[CsvTable, ...] = ()
    if targets[0].kind == "table":
        tables = _tables(spec, targets[0], here, reading, given.get(name))
    return [Draw(name, spec.name or keys[0], entry, spec, tuple(targets), samples=samples, tables=tables)]


def _column_name(key: str, spec: Disperse) -> str:
    """Name of the column in the data set: the key, which rows of a table, and the tag."""
    marks = [f"{name}={value:g}" for name, value in (spec.where or {}).items()] + [spec.tag] * bool(spec.tag)
    return f"{key}[{','.join(marks)}]" if marks else key


def _check_fits(spec: Disperse, target: Target, where: KeyPath) -> None:
    at = where[:2]
    if target.kind in ("text", "table"):
        if spec.distribution != "choice" or spec.apply != "set":
            raise _Misplaced((*at, "distribution"), f"{target.key} holds no number", spec.distribution, "'choice'")
        if not all(isinstance(value, str) for value in spec.values or ()):
            raise _Misplaced((*at, "values"), f"{target.key} holds no number", allowed="texts")
        return
    if spec.distribution == "choice" and any(isinstance(value, str) for value in spec.values or ()):
        raise _Misplaced((*at, "values"), f"{target.key} holds a number", allowed="numbers")
    if spec.where is not None and target.kind != "column":
        raise _Misplaced((*at, "where"), f"{target.key} is no column of a table")
    unknown = np.isnan(target.nominal) and target.kind != "column"
    centred = spec.distribution in ("normal", "truncated-normal") and spec.mean is None
    centred = centred or (spec.distribution == "log-normal" and spec.median is None)
    if unknown and spec.apply != "set":
        raise _Misplaced((*at, "apply"), f"{target.key} has no value to start from", spec.apply, "'set'")
    if spec.apply == "set" and centred and (unknown or target.kind == "column"):
        missing = "median" if spec.distribution == "log-normal" else "mean"
        raise _Misplaced((*at, missing), f"required key is missing: {target.key} has no value of its own")


def _tables(
    spec: Disperse, target: Target, here: KeyPath, reading: Reading | None, given: tuple[Any, ...] | None
) -> tuple[CsvTable, ...]:
    """The tables among which a draw chooses."""
    _, metadata = field_at(Scenario, target.path)
    columns = next(mark for mark in metadata if isinstance(mark, Columns))
    out = []
    for n, value in enumerate(given if given is not None else spec.values or ()):
        try:
            out.append(TypeAdapter(Annotated[CsvTable, columns]).validate_python(value, context=reading))
        except ValidationError as error:
            context = error.errors(include_url=False)[0].get("ctx", {})
            problem, allowed = context.get("problem", "is no such table"), context.get("allowed", "")
            raise _Misplaced((*here, "values", n), problem, str(value), allowed) from None
    return tuple(out)
