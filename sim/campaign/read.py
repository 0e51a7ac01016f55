"""Reading a campaign file: what it disperses must be there in its scenario, once, and fit its bounds.

campaign = load_campaign("campaigns/ksr3")
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import TypeAdapter, ValidationError

from maxq.sim.campaign.loaded import LoadedCampaign
from maxq.sim.campaign.plan import SEED_KEY, Draw, Plan
from maxq.sim.campaign.schema import CampaignFile, Disperse, plain_value, tuples
from maxq.sim.campaign.targets import BadKey, Target, find_target
from maxq.sim.campaign.wind import WIND_KEY, wind_draw
from maxq.sim.run.metrics import METRIC_NAMES
from maxq.sim.scenario.documents import plain, source_of
from maxq.sim.scenario.errors import Path as KeyPath
from maxq.sim.scenario.files import Reading
from maxq.sim.scenario.loader import CAMPAIGN_SECTIONS, LoadedScenario, load_scenario_text, load_with_sections
from maxq.sim.scenario.messages import explain, field_at
from maxq.sim.scenario.schema_scenario import Scenario
from maxq.sim.scenario.tables_csv import Columns, CsvTable


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
