"""What is drawn for each run of a campaign: a function of seed, run and key alone (draws.py).

Vector-wind model: at each altitude the two components deviate from the mean by a bivariate normal distribution
(standard deviations and correlation from a table), and the standardised deviations of two altitudes are correlated by
exp(-|difference| / correlation length). This is the form of Adelfang's vector wind profile model (NASA/CR-1999-209759)
with an analytic correlation in place of its tables of monthly statistics.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from scipy.special import ndtr, ndtri

from maxq.control.kernel.records import Array
from maxq.sim.campaign.draws import Sobol, chosen, correlated, latin, quantile, seeds, uniforms
from maxq.sim.campaign.error import CampaignError
from maxq.sim.campaign.schema import Campaign, Disperse, WindModel
from maxq.sim.campaign.targets import BOUNDS, Target
from maxq.sim.scenario.tables_csv import CsvTable
from maxq.sim.world.wind import wind_components

SEED_KEY, WIND_KEY, MONTH_KEY, DATE_KEY = "run.seed", "wind.profile", "wind.month", "wind.date"
MOST_ATTEMPTS = 1000


@dataclass(frozen=True)
class Draw:
    """One random number of a run, and the places of the scenario it goes to."""

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
    def stream(self) -> str:
        """Name of its random numbers: cases draw a row, the same for all columns."""
        return f"cases\0{self.entry}" if self.spec.distribution == "cases" else self.name


@dataclass
class Drawn:
    """What was drawn for consecutive runs."""

    first: int
    count: int
    draws: dict[str, np.ndarray]  # by name; of texts and tables the index
    results: dict[tuple[str, int], Array]  # by name and target: what stands in the scenario
    seeds: np.ndarray | None
    wind: np.ndarray | None
    redraws: np.ndarray
    columns: Columns | None = None  # see Plan.columns


Columns = tuple[dict[tuple[str, int], list[Any]], dict[str, list[Any]]]
"""One value for each run: by name and target what stands in the scenario, by column what is recorded."""


@dataclass(frozen=True)
class Plan:
    """How the draws of a run come about. Nothing here is drawn in an order: see draws.py."""

    campaign: Campaign
    draws: tuple[Draw, ...]
    wind: Ensemble | VectorWind | None

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
        seed = self.campaign.seed
        use_sobol = self.campaign.sampling == "sobol" and attempt == 0 and bool(self.draws)
        sobol = Sobol(seed, self.names, first, count) if use_sobol else None
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
            drawn.seeds = seeds(seed, SEED_KEY, first, count, attempt)
        if self.wind is not None:
            drawn.wind = self.wind.scores(seed, first, count, attempt)
        return drawn

    @cached_property
    def scores(self) -> int:
        """Standard normal numbers that make up a run, beside its noise."""
        return len(self.score_names)

    @cached_property
    def score_names(self) -> list[str]:
        """What each of them is: a draw, or the wind."""
        return self._streams + [f"{WIND_KEY} {k + 1}" for k in range(self.wind.size if self.wind is not None else 0)]

    @cached_property
    def _streams(self) -> list[str]:
        return list(dict.fromkeys(d.stream for d in self.draws))

    def of_scores(self, z: Array, noise: np.ndarray) -> tuple[Drawn, np.ndarray]:
        """Runs 0, 1, ... made of standard normal numbers (runs, scores) and seeds, and which lie within all bounds.

        Samples, cases and profiles that are taken in turn are taken at random here.
        """
        count, good, groups = len(z), np.ones(len(z), bool), dict[int, list[Array]]()
        u = dict(zip(self._streams, np.clip(ndtr(z.T), 1e-300, 1.0 - 1e-16), strict=False))
        raw = {d.name: u[d.stream] for d in self.draws}
        drawn = Drawn(0, count, {}, {}, noise if self.own_noise else None, None, np.zeros(count, np.int64))
        for d in self.draws:
            drawn.draws[d.name] = self._values(_at_random(d), raw[d.name], 0, count, raw, groups)
            results = [] if d.is_text else [t.result(d.spec.apply, drawn.draws[d.name]) for t in d.targets]
            good &= self._good(d, results) if results else True
            drawn.results |= {(d.name, n): result for n, result in enumerate(results)}
        if self.wind is not None:
            drawn.wind = self.wind.of_scores(z[:, len(self._streams) :])
        return drawn, good

    def columns(self, drawn: Drawn) -> Columns:
        """The draws as Python's own numbers, texts and tables; made once for all runs of a batch. Without the wind."""
        if drawn.columns is None:
            flown: dict[tuple[str, int], list[Any]] = {}
            recorded: dict[str, list[Any]] = {}
            for d in self.draws:
                if d.is_text:
                    chosen_ones = drawn.draws[d.name].tolist()
                    recorded[d.name] = [str((d.spec.values or ())[k]) for k in chosen_ones]
                    there = [d.tables[k] for k in chosen_ones] if d.tables else recorded[d.name]
                    lists = [there] * len(d.targets)
                else:
                    lists = [drawn.results[d.name, n].tolist() for n in range(len(d.targets))]
                    recorded[d.name] = lists[0]
                flown |= {(d.name, n): values for n, values in enumerate(lists)}
            if drawn.seeds is not None:
                flown[SEED_KEY, 0] = recorded[SEED_KEY] = drawn.seeds.tolist()
            drawn.columns = flown, recorded
        return drawn.columns

    def _uniforms(self, d: Draw, first: int, count: int, attempt: int, sobol: Sobol | None) -> Array:
        if attempt == 0 and d.spec.distribution != "cases":
            if self.campaign.sampling == "latin-hypercube":
                stratum = self.campaign.stratum or max(self.campaign.runs, 1)
                return latin(self.campaign.seed, d.stream, first, count, stratum)
            if sobol is not None:
                return sobol(d.name)
        return uniforms(self.campaign.seed, d.stream, first, count, attempt)

    def _values(
        self, d: Draw, u: Array, first: int, count: int, raw: Mapping[str, Array], groups: dict[int, list[Array]]
    ) -> np.ndarray:
        spec = d.spec
        if d.group is not None:
            entry, position = d.group
            if entry not in groups:
                members = [other for other in self.draws if other.entry == entry]
                assert spec.covariance is not None
                groups[entry] = correlated(spec.covariance, [ndtri(raw[m.name]) for m in members])
            return np.asarray(spec.centre(d.nominal) + groups[entry][position])
        if spec.values is not None:
            index = chosen(spec, u)
            return index if d.is_text else np.array([float(value) for value in spec.values])[index]
        if d.samples is not None:
            return np.asarray(d.samples[_rows(spec.order, len(d.samples), u, first, count)])
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
                f"{_bounds_text(d)}; outside = 'resample' draws again, at_least and at_most cut the distribution"
            )
        for at in np.flatnonzero(~good).tolist():
            run = drawn.first + at
            for again in range(1, MOST_ATTEMPTS + 1):
                new = self._single(d, run, attempt + again)
                single = [target.result(d.spec.apply, new) for target in d.targets]
                if self._good(d, single).all():
                    break
            else:
                raise CampaignError(
                    f"run {run}: {MOST_ATTEMPTS} draws of {d.name} all lie outside its bounds{_bounds_text(d)}; "
                    "change the distribution or the bounds"
                )
            values[at] = new[0]
            for result, one in zip(results, single, strict=True):
                result[at] = one[0]
            drawn.redraws[at] += again
        return values, results

    def _single(self, d: Draw, run: int, attempt: int) -> np.ndarray:
        """One draw anew; of a correlated group with new scores for all of it."""
        group = [other for other in self.draws if other.entry == d.entry] if d.group is not None else [d]
        raw = {m.name: uniforms(self.campaign.seed, m.stream, run, 1, attempt) for m in group}
        return self._values(_at_random(d), raw[d.name], run, 1, raw, {})

    def _good(self, d: Draw, results: list[Array]) -> np.ndarray:
        good = np.ones(len(results[0]), bool)
        for target, result in zip(d.targets, results, strict=True):
            good &= target.allowed(result)
            if d.spec.at_least is not None:
                good &= result >= d.spec.at_least
            if d.spec.at_most is not None:
                good &= result <= d.spec.at_most
        return good


def _at_random(d: Draw) -> Draw:
    return d if d.samples is None else replace(d, spec=d.spec.model_copy(update={"order": "random"}))


def _bounds_text(d: Draw) -> str:
    words = [" and ".join(f"{BOUNDS[mark][1]} {bound:g}" for mark, bound in d.targets[0].bounds)]
    words += [f"at_least = {d.spec.at_least:g}"] if d.spec.at_least is not None else []
    words += [f"at_most = {d.spec.at_most:g}"] if d.spec.at_most is not None else []
    given = ", ".join(word for word in words if word)
    return f" ({given})" if given else ""


def _rows(order: str, available: int, u: Array, first: int, count: int) -> np.ndarray:
    """Rows or profiles: i for run i, again from the first after the last, or at random."""
    if order == "in-turn":
        return np.arange(first, first + count) % available
    return np.minimum((u * available).astype(np.int64), available - 1)


class Ensemble:
    """Wind out of given profiles."""

    def __init__(self, model: WindModel) -> None:
        self._profiles, self._order, self.size = model.profiles or (), model.order, 1

    def of_scores(self, z: Array) -> np.ndarray:
        """`scores` of standard normal numbers (runs, size)."""
        return _rows("random", len(self._profiles), ndtr(z[:, 0]), 0, len(z))[:, None]

    def scores(self, seed: int, first: int, count: int, attempt: int = 0) -> np.ndarray:
        """(count, 1): numbers of the profiles."""
        u = uniforms(seed, WIND_KEY, first, count, attempt)
        return _rows(self._order, len(self._profiles), u, first, count)[:, None]

    def profile(self, scores: np.ndarray) -> CsvTable:
        """The profile that follows from the scores of a run."""
        return self._profiles[int(scores[0])]

    def recorded(self, scores: np.ndarray) -> dict[str, Any]:
        """What the data set holds of the scores of a run, by column."""
        one = self._profiles[int(scores[0])]
        out: dict[str, Any] = {WIND_KEY: one.file or str(int(scores[0]))}
        if any(profile.date for profile in self._profiles):
            out |= {DATE_KEY: one.date, MONTH_KEY: float(one.date[5:7]) if one.date else np.nan}
        return out


class VectorWind:
    """Correlated normal deviations from a mean profile; methods as those of `Ensemble`."""

    def __init__(self, model: WindModel, mean: CsvTable) -> None:
        assert model.table is not None
        assert model.correlation_length_m is not None
        table = model.table
        self._altitude_m = table["altitude_m"]
        self._sigma = model.factor * np.stack([table["sigma_north_mps"], table["sigma_east_mps"]], axis=1)
        self._across = table.get("correlation")
        self._along = np.exp(-np.diff(self._altitude_m) / model.correlation_length_m)
        self._out_m = np.unique(np.concatenate([mean["altitude_m"], self._altitude_m]))
        columns = (
            wind_components(mean["speed_mps"], mean["from_deg"])[:, :2].T
            if "speed_mps" in mean
            else (mean["north_mps"], mean["east_mps"])
        )
        self._mean = [np.interp(self._out_m, mean["altitude_m"], column) for column in columns]
        self._down = np.interp(self._out_m, mean["altitude_m"], mean.get("down_mps")) if "down_mps" in mean else None
        self._months = model.months
        self.size = 2 * len(self._altitude_m) + (model.months is not None)

    def scores(self, seed: int, first: int, count: int, attempt: int = 0) -> np.ndarray:
        """(count, altitudes, 2): deviations north and east, m/s; with months one row more, that of the month."""
        parts = [uniforms(seed, WIND_KEY, first, count, attempt, component=k) for k in range(self.size)]
        if self._months is not None:  # in turn: as many runs of each
            parts[-1] = (np.arange(first, first + count) % len(self._months) + 0.5) / len(self._months)
        return self.of_scores(ndtri(np.array(parts)).T)

    def of_scores(self, z: Array) -> np.ndarray:
        levels, months = len(self._altitude_m), self._months
        row = np.floor(ndtr(z[:, -1]) * len(months)) if months is not None else np.zeros(len(z))
        z = z[:, : 2 * levels].reshape(len(z), levels, 2).copy()
        for level in range(1, levels):  # a Markov chain over altitude has an exponential correlation
            rho = self._along[level - 1]
            z[:, level] = rho * z[:, level - 1] + np.sqrt(1.0 - rho * rho) * z[:, level]
        across = self._across
        z[:, :, 1] = across * z[:, :, 0] + np.sqrt(1.0 - across * across) * z[:, :, 1]
        if months is None:
            return np.asarray(z * self._sigma)
        z *= self._sigma * months["sigma_factor"][row.astype(int)][:, None, None]
        return np.concatenate([z, np.repeat(row, 2).reshape(-1, 1, 2)], axis=1)

    def profile(self, scores: np.ndarray) -> CsvTable:
        levels = len(self._altitude_m)
        factor = 1.0 if self._months is None else self._months["mean_factor"][int(scores[-1, 0])]
        north, east = (
            factor * mean + np.interp(self._out_m, self._altitude_m, scores[:levels, axis])
            for axis, mean in enumerate(self._mean)
        )
        columns: dict[str, Array] = {"altitude_m": self._out_m, "north_mps": north, "east_mps": east}
        if self._down is not None:
            columns["down_mps"] = self._down
        return CsvTable("", columns)

    def recorded(self, scores: np.ndarray) -> dict[str, Any]:
        month = {} if self._months is None else {MONTH_KEY: float(self._months["month"][int(scores[-1, 0])])}
        return month | {
            f"{WIND_KEY}.{name}_mps[{altitude:g} m]": float(scores[level, axis])
            for axis, name in enumerate(("north", "east"))
            for level, altitude in enumerate(self._altitude_m)
        }
