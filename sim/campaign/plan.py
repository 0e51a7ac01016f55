"""The draws of each run of a campaign, as a function of seed, run and key alone (draws.py).

In the vector-wind model, the deviations of the two components from the mean at each altitude have a bivariate normal
distribution, with standard deviations and correlation from a table. The correlation of the standardised deviations at
two altitudes is exp(-|difference| / correlation length). This is the form of Adelfang's vector wind profile model
(NASA/CR-1999-209759), with an analytic correlation instead of its tables of monthly statistics.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
from scipy.special import ndtr, ndtri

from maxq.control.kernel.records import Array
from maxq.sim.campaign.draws import Sobol, chosen, correlated, latin, quantile, seeds, uniforms
from maxq.sim.campaign.error import CampaignError
from maxq.sim.campaign.schema import Campaign, Disperse, WindModel
from maxq.sim.campaign.targets import BOUNDS, Target
from maxq.sim.input.tables_csv import CsvTable
from maxq.sim.world.wind import wind_components

SEED_KEY, WIND_KEY, MONTH_KEY, DATE_KEY = "run.seed", "wind.profile", "wind.month", "wind.date"
MOST_ATTEMPTS = 1000
_INSIDE = 1e-300, 1.0 - 1e-16  # limits inside (0, 1) for quantile functions


@dataclass(frozen=True)
class Draw:
    """A random number of a run, and the places of the scenario that it changes."""

    name: str  # name of the column in the data set: the key path, or the first of several
    label: str
    entry: int  # index in [[disperse]]
    spec: Disperse
    targets: tuple[Target, ...]
    group: tuple[int, int] | None = None  # (entry, position) if the draws of the entry have a covariance
    samples: Array | None = None
    tables: tuple[CsvTable, ...] = ()  # the tables of a choice among files

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
        """Return the name of its random numbers, which is common to all columns of a file of cases."""
        return f"cases\0{self.entry}" if self.spec.distribution == "cases" else self.name

    def results(self, values: np.ndarray) -> list[Array]:
        """Return, for each target, the results (runs,) of draws `values` (runs,); empty for texts and tables."""
        if self.is_text:
            return []
        values = values if self.spec.power is None else np.power(values, self.spec.power)
        return [target.result(self.spec.apply, values) for target in self.targets]

    def allowed(self, results: list[Array]) -> np.ndarray:
        """Return a mask (runs,) of results within the bounds of all targets and of the draw."""
        low = -np.inf if self.spec.at_least is None else self.spec.at_least
        high = np.inf if self.spec.at_most is None else self.spec.at_most
        targets = zip(self.targets, results, strict=False)
        good = [target.allowed(one) & (one >= low) & (one <= high) for target, one in targets]
        return np.asarray(np.all(good, axis=0))


@dataclass
class Drawn:
    """The draws of consecutive runs. `flown` and `recorded` contain Python numbers, texts and tables."""

    first: int
    redraws: np.ndarray
    seeds: np.ndarray | None = None
    wind: np.ndarray | None = None
    draws: dict[str, np.ndarray] = field(default_factory=dict)  # by name; the index for texts and tables
    flown: dict[tuple[str, int], list[Any]] = field(default_factory=dict)  # values in the scenario, by name and target
    recorded: dict[str, list[Any]] = field(default_factory=dict)  # values in the data set by column, without the wind


@dataclass(frozen=True)
class Plan:
    """The rules for the draws of a run, which do not depend on the order of runs (draws.py)."""

    campaign: Campaign
    draws: tuple[Draw, ...]
    wind: Ensemble | VectorWind | None

    @property
    def own_noise(self) -> bool:
        return self.campaign.noise == "each-run"

    def draw(self, first: int, count: int, attempt: int = 0) -> Drawn:
        """Return the draws of `count` runs from `first` on. A value outside its bounds is drawn again.

        Raises CampaignError if the campaign does not allow further draws, or if MOST_ATTEMPTS draws are not sufficient.
        """
        seed = self.campaign.seed
        use_sobol = self.campaign.sampling == "sobol" and attempt == 0 and bool(self.draws)
        sobol = Sobol(seed, tuple(d.name for d in self.draws), first, count) if use_sobol else None
        drawn = Drawn(first, np.zeros(count, np.int64))
        raw = self._together({d.name: self._uniforms(d, first, count, attempt, sobol) for d in self.draws})
        groups: dict[int, list[Array]] = {}
        for d in self.draws:
            values = self._values(d, first, raw, groups)
            self._enter(drawn, d, values, self._within_bounds(d, values, drawn, attempt))
        self._enter_seeds(drawn, seeds(seed, SEED_KEY, first, count, attempt))
        if self.wind is not None:
            drawn.wind = self.wind.scores(seed, first, count, attempt)
        return drawn

    @cached_property
    def pairs(self) -> list[tuple[str, str, float]]:
        """Return the draw names and the coefficient of each correlated pair whose draws are both in `draws`."""
        found = []
        for pair in self.campaign.correlated:
            i, j = ([d.name for d in self.draws if name in (d.name, d.label)] for name in pair.of)
            if len(i) == len(j) == 1:
                found.append((i[0], j[0], pair.coefficient))
        return found

    @cached_property
    def correlation(self) -> tuple[list[str], Array]:
        """Return the names of the correlated draws, and the matrix (draws, draws) of their coefficients."""
        names = list(dict.fromkeys(name for i, j, _ in self.pairs for name in (i, j)))
        matrix = np.eye(len(names))
        for i, j, coefficient in self.pairs:
            at = names.index(i), names.index(j)
            matrix[at] = matrix[at[::-1]] = coefficient
        return names, matrix

    @cached_property
    def _root(self) -> Array:
        """Return the symmetric square root of the matrix `correlation`, which maps independent to correlated scores.

        The root is rounded, so that draws do not depend on the processor that decomposes the matrix.
        """
        sizes, vectors = np.linalg.eigh(self.correlation[1])
        return np.asarray(np.round((vectors * np.sqrt(np.maximum(sizes, 0.0))) @ vectors.T, 12))

    def _together(self, raw: dict[str, Array]) -> dict[str, Array]:
        """Return the uniform numbers (runs,) of all draws, by name, after correlation of the independent `raw`."""
        if not self.pairs:
            return raw
        names = self.correlation[0]
        z = [ndtri(raw[name]) for name in names]
        mixed = [sum((r * each for r, each in zip(row, z, strict=True)), np.zeros_like(z[0])) for row in self._root]
        return raw | {name: np.clip(ndtr(x), *_INSIDE) for name, x in zip(names, mixed, strict=True)}

    @cached_property
    def score_names(self) -> list[str]:
        """Return the names of a run's standard normal numbers, which give its draws and its wind but not its noise."""
        return self._streams + [f"{WIND_KEY} {k + 1}" for k in range(self.wind.size if self.wind is not None else 0)]

    @cached_property
    def _streams(self) -> list[str]:
        return list(dict.fromkeys(d.stream for d in self.draws))

    def of_scores(self, z: Array, noise: np.ndarray) -> tuple[Drawn, np.ndarray]:
        """Return the draws of runs 0, 1, ... from standard normal numbers `z` (runs, scores) and seeds `noise` (runs,).

        The second result is a mask (runs,) of runs within all bounds. Samples, cases and profiles are chosen at random
        here, even if their order is "in-turn".
        """
        good, groups = np.ones(len(z), bool), dict[int, list[Array]]()
        u = dict(zip(self._streams, np.clip(ndtr(z.T), *_INSIDE), strict=False))
        raw = self._together({d.name: u[d.stream] for d in self.draws})
        drawn = Drawn(0, np.zeros(len(z), np.int64))
        for d in self.draws:
            values = self._values(_at_random(d), 0, raw, groups)
            results = d.results(values)
            good &= d.allowed(results)
            self._enter(drawn, d, values, results)
        self._enter_seeds(drawn, noise)
        if self.wind is not None:
            drawn.wind = self.wind.of_scores(z[:, len(self._streams) :])
        return drawn, good

    def _enter(self, drawn: Drawn, d: Draw, values: np.ndarray, results: list[Array]) -> None:
        """Write the draws of `d` and their results at each target into `drawn`."""
        drawn.draws[d.name] = values
        lists: list[list[Any]] = [result.tolist() for result in results]
        if d.is_text:
            texts: list[Any] = [str((d.spec.values or ())[k]) for k in values.tolist()]
            lists = [[d.tables[k] for k in values.tolist()] if d.tables else texts] * len(d.targets)
        drawn.recorded[d.name] = texts if d.is_text else lists[0]
        drawn.flown |= {(d.name, n): column for n, column in enumerate(lists)}

    def _enter_seeds(self, drawn: Drawn, noise: np.ndarray) -> None:
        if self.own_noise:
            drawn.seeds = noise
            drawn.flown[SEED_KEY, 0] = drawn.recorded[SEED_KEY] = noise.tolist()

    def _uniforms(self, d: Draw, first: int, count: int, attempt: int, sobol: Sobol | None) -> Array:
        if attempt == 0 and d.spec.distribution != "cases":
            if self.campaign.sampling == "latin-hypercube":
                stratum = self.campaign.stratum or max(self.campaign.runs, 1)
                return latin(self.campaign.seed, d.stream, first, count, stratum)
            if sobol is not None:
                return sobol(d.name)
        return uniforms(self.campaign.seed, d.stream, first, count, attempt)

    def _values(self, d: Draw, first: int, raw: Mapping[str, Array], groups: dict[int, list[Array]]) -> np.ndarray:
        """Return the draws (runs,) of `d` for consecutive runs from the uniform numbers `raw`, by name.

        `groups` is a cache of the values of entries with a covariance.
        """
        spec, u = d.spec, raw[d.name]
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
            return np.asarray(d.samples[_rows(spec.order, len(d.samples), u, first)])
        return quantile(spec, u, d.nominal)

    def _within_bounds(self, d: Draw, values: np.ndarray, drawn: Drawn, attempt: int) -> list[Array]:
        """Return the results (runs,) at each target; values outside their bounds are drawn again, in place."""
        results = d.results(values)
        good = d.allowed(results)
        if good.all():
            return results
        if (d.spec.outside or self.campaign.outside) == "refuse":
            at = int(np.argmin(good))
            raise CampaignError(
                f"run {drawn.first + at}: {d.name} = {results[0][at]:g} is outside its bounds"
                f"{_bounds_text(d)}; outside = 'resample' draws again, at_least and at_most cut the distribution"
            )
        for at in np.flatnonzero(~good).tolist():
            run = drawn.first + at
            for again in range(1, MOST_ATTEMPTS + 1):
                new = self._single(d, run, attempt + again)
                single = d.results(new)
                if d.allowed(single).all():
                    break
            else:
                raise CampaignError(
                    f"run {run}: {MOST_ATTEMPTS} draws of {d.name} are all outside its bounds{_bounds_text(d)}; "
                    "change the distribution or the bounds"
                )
            values[at] = new[0]
            for result, one in zip(results, single, strict=True):
                result[at] = one[0]
            drawn.redraws[at] += again
        return results

    def _single(self, d: Draw, run: int, attempt: int) -> np.ndarray:
        """Return a repeated draw (1,), with new scores for all draws that are correlated with it."""
        group = [other for other in self.draws if other.entry == d.entry] if d.group is not None else [d]
        together = d.name in self.correlation[0]
        group = [other for other in self.draws if other.name in self.correlation[0]] if together else group
        raw = {m.name: uniforms(self.campaign.seed, m.stream, run, 1, attempt) for m in group}
        return self._values(_at_random(d), run, self._together(raw) if together else raw, {})


def _at_random(d: Draw) -> Draw:
    return d if d.samples is None else replace(d, spec=d.spec.model_copy(update={"order": "random"}))


def _bounds_text(d: Draw) -> str:
    words = [" and ".join(f"{BOUNDS[mark][1]} {bound:g}" for mark, bound in d.targets[0].bounds)]
    words += [f"at_least = {d.spec.at_least:g}"] if d.spec.at_least is not None else []
    words += [f"at_most = {d.spec.at_most:g}"] if d.spec.at_most is not None else []
    given = ", ".join(word for word in words if word)
    return f" ({given})" if given else ""


def _rows(order: str, available: int, u: Array, first: int = 0) -> np.ndarray:
    """Return the indices (runs,) of rows or profiles, at random, or for "in-turn" consecutive and cyclic."""
    if order == "in-turn":
        return np.arange(first, first + len(u)) % available
    return np.minimum((u * available).astype(np.int64), available - 1)


class Ensemble:
    """The wind model that chooses among given profiles."""

    def __init__(self, model: WindModel) -> None:
        self._profiles, self._order, self.size = model.profiles or (), model.order, 1

    def of_scores(self, z: Array) -> np.ndarray:
        """Return the scores for standard normal numbers `z` (runs, size)."""
        return _rows("random", len(self._profiles), ndtr(z[:, 0]))[:, None]

    def scores(self, seed: int, first: int, count: int, attempt: int = 0) -> np.ndarray:
        """Return the indices (count, 1) of the profiles of consecutive runs."""
        u = uniforms(seed, WIND_KEY, first, count, attempt)
        return _rows(self._order, len(self._profiles), u, first)[:, None]

    def profile(self, scores: np.ndarray) -> CsvTable:
        """Return the wind profile for the scores of a run."""
        return self._profiles[int(scores[0])]

    def recorded(self, scores: np.ndarray) -> dict[str, Any]:
        """Return the values in the data set, by column, for the scores of a run."""
        one = self._profiles[int(scores[0])]
        out: dict[str, Any] = {WIND_KEY: one.file or str(int(scores[0]))}
        if any(profile.date for profile in self._profiles):
            out |= {DATE_KEY: one.date, MONTH_KEY: float(one.date[5:7]) if one.date else np.nan}
        return out


class VectorWind:
    """The wind model of correlated normal deviations from a mean profile, with the methods of `Ensemble`."""

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
        """Return the deviations north and east (count, altitudes, 2), m/s, of consecutive runs.

        With months, a further row contains the index of the month, twice.
        """
        parts = [uniforms(seed, WIND_KEY, first, count, attempt, component=k) for k in range(self.size)]
        if self._months is not None:  # in turn, so that all months have the same number of runs
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
