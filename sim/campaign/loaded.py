"""A campaign that can be flown: the scenario of each run, and what is recorded of it.

campaign = load_campaign("campaigns/ksr3")          # read.py
campaign.inputs(417).recorded                       # what was drawn, by column
campaign.scenario_of(417).scenario                  # what is flown
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from maxq.sim.campaign.distributions import box
from maxq.sim.campaign.error import CampaignError
from maxq.sim.campaign.plan import MOST_ATTEMPTS, SEED_KEY, Drawn, Plan
from maxq.sim.campaign.schema import Campaign, CampaignFile
from maxq.sim.campaign.targets import Change, Dispersed, Refused, find_target
from maxq.sim.campaign.wind import WIND_KEY
from maxq.sim.scenario.loader import LoadedScenario

_JOINT = 1 << 20  # attempts of a run whose values exclude each other begin here, apart from those of single keys


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
        out = {name: values[at] for name, values in self.plan.columns(drawn)[1].items()}
        if drawn.wind is not None and self.plan.wind is not None:
            out |= self.plan.wind.recorded(drawn.wind[at])
        return out

    def _flown(self, drawn: Drawn, at: int) -> dict[str, Any]:
        out = {name: values[at] for name, values in self.plan.columns(drawn)[0].items()}
        if drawn.wind is not None and self.plan.wind is not None:
            out[WIND_KEY] = self.plan.wind.profile(drawn.wind[at])
        return out

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
