"""What is drawn for each run of a campaign: a function of seed, run and key alone (draws.py)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np

from maxq.control.kernel.records import Array
from maxq.sim.campaign import draws as numbers
from maxq.sim.campaign.distributions import chosen, correlated, quantile, standard_normal
from maxq.sim.campaign.error import CampaignError
from maxq.sim.campaign.schema import Campaign, Disperse
from maxq.sim.campaign.targets import Target
from maxq.sim.campaign.wind import WindDraw
from maxq.sim.scenario.tables_csv import CsvTable

SEED_KEY = "run.seed"
MOST_ATTEMPTS = 1000


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
    columns: Columns | None = None  # see Plan.columns


Columns = tuple[dict[str, list[Any]], dict[str, list[Any]]]
"""One value for each run: by name of a change what stands in the scenario, by column what is recorded."""


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

    def columns(self, drawn: Drawn) -> Columns:
        """The draws as Python's own numbers, texts and tables; made once for all runs of a batch. Without the wind."""
        if drawn.columns is None:
            flown: dict[str, list[Any]] = {}
            recorded: dict[str, list[Any]] = {}
            for d in self.draws:
                if d.is_text:
                    texts, chosen_ones = d.texts(), drawn.draws[d.name].tolist()
                    recorded[d.name] = [texts[k] for k in chosen_ones]
                    there = [d.tables[k] for k in chosen_ones] if d.tables else recorded[d.name]
                    flown |= {f"{d.name}\0{n}": there for n in range(len(d.targets))}
                else:
                    lists = [drawn.results[d.name, n].tolist() for n in range(len(d.targets))]
                    flown |= {f"{d.name}\0{n}": values for n, values in enumerate(lists)}
                    recorded[d.name] = lists[0]
            if drawn.seeds is not None:
                flown[SEED_KEY] = recorded[SEED_KEY] = drawn.seeds.tolist()
            drawn.columns = flown, recorded
        return drawn.columns

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
