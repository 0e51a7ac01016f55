"""Wind profiles of a campaign: deviations from a mean that hang together over altitude, or an ensemble of profiles.

Vector-wind model: at each altitude the two components deviate from the mean by a bivariate normal distribution
(standard deviations and correlation from a table), and the standardised deviations of two altitudes are correlated by
exp(-|difference| / correlation length). This is the form of Adelfang's vector wind profile model (NASA/CR-1999-209759)
with an analytic correlation in place of its tables of monthly statistics.
"""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np

from maxq.control.kernel.records import Array
from maxq.sim.campaign import draws as numbers
from maxq.sim.campaign.distributions import standard_normal
from maxq.sim.campaign.schema import WindModel
from maxq.sim.scenario.schema_environment import Wind
from maxq.sim.scenario.tables_csv import CsvTable
from maxq.sim.world.wind import wind_components

WIND_KEY = "wind.profile"


class WindDraw(Protocol):
    """What a run's wind is made from."""

    def scores(self, seed: int, first: int, count: int, attempt: int = 0) -> np.ndarray:
        """What is drawn, a row for each run."""

    def profile(self, scores: np.ndarray) -> CsvTable:
        """The profile that follows from a row."""

    def recorded(self, scores: np.ndarray) -> dict[str, Any]:
        """What the data set says of a row, by column."""


def wind_draw(model: WindModel, wind: Wind) -> WindDraw:
    if model.model == "ensemble":
        return _Ensemble(model)
    assert wind.profile is not None
    return _Vector(model, wind.profile)


class _Ensemble:
    def __init__(self, model: WindModel) -> None:
        assert model.profiles is not None
        self._profiles, self._in_turn = model.profiles, model.order == "in-turn"

    def scores(self, seed: int, first: int, count: int, attempt: int = 0) -> np.ndarray:
        n = len(self._profiles)
        if self._in_turn:
            return np.arange(first, first + count)[:, None] % n
        u = numbers.uniforms(seed, WIND_KEY, first, count, attempt)
        return np.minimum((u * n).astype(np.int64), n - 1)[:, None]

    def profile(self, scores: np.ndarray) -> CsvTable:
        return self._profiles[int(scores[0])]

    def recorded(self, scores: np.ndarray) -> dict[str, Any]:
        return {WIND_KEY: self._profiles[int(scores[0])].file or str(int(scores[0]))}


class _Vector:
    def __init__(self, model: WindModel, mean: CsvTable) -> None:
        assert model.table is not None
        assert model.correlation_length_m is not None
        table = model.table
        self._altitude_m = table["altitude_m"]
        self._sigma = model.factor * np.stack([table["sigma_north_mps"], table["sigma_east_mps"]], axis=1)
        self._across = table.get("correlation")
        self._along = np.exp(-np.diff(self._altitude_m) / model.correlation_length_m)
        self._mean_altitude_m = mean["altitude_m"]
        self._out_m = np.unique(np.concatenate([self._mean_altitude_m, self._altitude_m]))
        columns = (
            wind_components(mean["speed_mps"], mean["from_deg"])[:, :2]
            if "speed_mps" in mean
            else np.stack([mean["north_mps"], mean["east_mps"]], axis=1)
        )
        self._mean = np.stack([np.interp(self._out_m, self._mean_altitude_m, c) for c in columns.T], axis=1)
        self._down = np.interp(self._out_m, self._mean_altitude_m, mean.get("down_mps")) if "down_mps" in mean else None

    def scores(self, seed: int, first: int, count: int, attempt: int = 0) -> np.ndarray:
        """(count, altitudes, 2): deviations north and east, m/s."""
        levels = len(self._altitude_m)
        z = np.empty((count, levels, 2))
        for level in range(levels):
            for axis in range(2):
                u = numbers.uniforms(seed, WIND_KEY, first, count, attempt, component=2 * level + axis)
                z[:, level, axis] = standard_normal(u)
        for level in range(1, levels):  # a Markov chain has just this correlation over altitude
            rho = self._along[level - 1]
            z[:, level] = rho * z[:, level - 1] + np.sqrt(1.0 - rho * rho) * z[:, level]
        across = self._across
        z[:, :, 1] = across * z[:, :, 0] + np.sqrt(1.0 - across * across) * z[:, :, 1]
        return np.asarray(z * self._sigma)

    def profile(self, scores: np.ndarray) -> CsvTable:
        deviation = [np.interp(self._out_m, self._altitude_m, scores[:, axis]) for axis in range(2)]
        columns: dict[str, Array] = {
            "altitude_m": self._out_m,
            "north_mps": self._mean[:, 0] + deviation[0],
            "east_mps": self._mean[:, 1] + deviation[1],
        }
        if self._down is not None:
            columns["down_mps"] = self._down
        return CsvTable("", columns)

    def recorded(self, scores: np.ndarray) -> dict[str, Any]:
        out = {}
        for axis, name in enumerate(("north", "east")):
            for level, altitude in enumerate(self._altitude_m):
                out[f"{WIND_KEY}.{name}_mps[{altitude:g} m]"] = float(scores[level, axis])
        return out
