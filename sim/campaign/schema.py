"""The sections of a campaign file in addition to its scenario: [campaign], [[disperse]] and [wind_model]."""

from __future__ import annotations

import math
import re
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BeforeValidator, Field, ValidationInfo, ValidatorFunctionWrapHandler, WrapValidator

from maxq.sim.campaign.correlated import Correlated
from maxq.sim.flight.metric_table import METRIC_NAMES
from maxq.sim.input.documents import Text
from maxq.sim.input.errors import refuse
from maxq.sim.input.ranges import MOST_TOGETHER
from maxq.sim.input.tables_csv import Columns, CsvTable
from maxq.sim.input.values import NotNegative, Positive, Section, optional
from maxq.sim.scenario.schema_environment import WIND_COLUMNS
from maxq.sim.scenario.soundings import each_sounding

WIND_MODEL_COLUMNS = Columns(
    "altitude_m",
    sets=(("sigma_north_mps", "sigma_east_mps"),),
    optional=("correlation",),
    not_negative=("sigma_north_mps", "sigma_east_mps"),
)
MONTH_COLUMNS = Columns("month", sets=(("mean_factor", "sigma_factor"),), not_negative=("mean_factor", "sigma_factor"))
KEEP_ALLOWED = "worst:5, worst:5:max_alpha_deg, failed, failed:20, 0,17"
Outside = Literal["resample", "refuse"]
Order = Literal["random", "in-turn"]
Uncertainty = Literal["aleatory", "epistemic"]
Probability = Annotated[float, Field(gt=0.0, lt=1.0)]


def _as_read(value: Any, usual: ValidatorFunctionWrapHandler) -> Any:
    """Return a text of a file unchanged, because it may name a file relative to the folder of that file."""
    return value if isinstance(value, Text) else usual(value)


def _each_sounding(value: Any, info: ValidationInfo) -> Any:
    return each_sounding(value, info.context, WIND_COLUMNS)


Profiles = tuple[Annotated[CsvTable, WIND_COLUMNS], ...]
Choice = Annotated[float | int | str, WrapValidator(_as_read)]


Samples = Annotated[CsvTable, Columns("")]


class Envelope(Section):
    """The channel histories stored at a reduced rate, from which percentiles over time are computed."""

    channels: tuple[str, ...] = optional(
        "names of log channels (docs/telemetry.md)",
        (
            "dynamic_pressure_Pa",
            "q_alpha_Padeg",
            "error_pitch_deg",
            "error_yaw_deg",
            "gimbal_pitch_angle_deg",
            "gimbal_yaw_angle_deg",
            "altitude_m",
        ),
    )
    rate_hz: Annotated[float, Field(gt=0.0, le=100.0)] = optional("sample rate, Hz", 2.0)
    runs: Annotated[int, Field(ge=0)] = optional("number of runs, from the first", 1000)
    percentiles: tuple[Annotated[float, Field(ge=0.0, le=100.0)], ...] = optional(
        "lines of the envelope, %", (0.135, 5.0, 50.0, 95.0, 99.865)
    )


def campaign_title(name: str) -> str:
    """Return `campaign NAME`, or `campaign` for a campaign of that name."""
    return name if name == "campaign" else f"campaign {name}"


class Campaign(Section):
    """The number of runs, the sampling, and the required confidence."""

    runs: Annotated[int, Field(ge=0, lt=2**53)] = Field(description="number of flights")
    seed: Annotated[int, Field(ge=0, lt=2**63)] = optional("seed of all draws", 1)
    sampling: Literal["random", "latin-hypercube", "sobol"] = optional("sampling method", "random")
    stratum: Annotated[int, Field(gt=0)] | None = optional("runs of a Latin hypercube (default: runs of this file)")
    noise: Literal["each-run", "as-scenario"] = optional(
        "a separate run.seed for each run (turbulence, gyro noise), or the file's for all", "each-run"
    )
    outside: Outside = optional("a draw outside its bounds is repeated and counted, or ends the campaign", "resample")
    test: Literal["any-time", "fixed"] = optional(
        "statistical test: any-time is valid under optional stopping; fixed is valid after the number of runs "
        "recorded beforehand (an extended campaign uses any-time with the remaining risk)",
        "any-time",
    )
    success: Probability = optional("share of flights that must meet a requirement", 0.9973)
    confidence: Probability = optional("required confidence", 0.90)
    correlated: tuple[Correlated, ...] = optional("correlated pairs of draws", ())
    batch: Annotated[int, Field(gt=0)] | None = optional(
        "runs in a file of the data set (default: a 32nd of the runs, 64 to 1024)"
    )
    keep: tuple[str, ...] = optional("flights whose full logs are kept: 'worst:5', 'failed', 'failed:20', '0,17'", ())
    envelope: Envelope = Envelope()

    def _check(self) -> None:
        if self.sampling == "latin-hypercube" and self.stratum is None and self.runs > MOST_TOGETHER:
            raise refuse(
                f"required key is missing: one hypercube of {self.runs} runs takes too much memory",
                f"at most {MOST_TOGETHER}",
                "stratum",
            )


_MEANINGFUL: dict[str, tuple[str, ...]] = {
    "normal": ("mean", "sigma", "three_sigma", "covariance"),
    "truncated-normal": ("mean", "sigma", "three_sigma", "low", "high"),
    "uniform": ("low", "high"),
    "log-normal": ("median", "sigma", "three_sigma"),
    "triangular": ("low", "mode", "high"),
    "choice": ("values", "weights"),
    "samples": ("file", "column"),
    "cases": ("file",),
}
"""The keys that have a meaning for certain distributions only, by distribution."""
_REQUIRED = {
    "low": "a number",
    "high": "a number",
    "mode": "a number",
    "values": "a list of values",
    "file": "a CSV file",
}
"""The keys that are required where they have a meaning, except low and high in a truncated normal distribution."""


class Disperse(Section):
    """A value of the scenario that differs from run to run."""

    key: str | None = optional(
        "key path, e.g. vehicle.stage.0.engine.thrust_factor; * as a part: one draw for each element of the list"
    )
    keys: tuple[str, ...] | None = optional(
        "several keys: with covariance one draw for each, otherwise one draw for all"
    )
    tag: str = optional("distinguishes two draws for the same column of a table", "")
    name: str = optional("name in reports (default: the key)", "")
    source: str = optional("source of the numbers", "")
    kind: Uncertainty | None = optional(
        "aleatory: differs from flight to flight; epistemic: one unknown value (docs/verdicts.md)"
    )
    apply: Literal["set", "scale", "add"] = optional(
        "the draw replaces the value, multiplies it, or is added to it", "set"
    )
    power: float | None = optional("with apply = 'scale': exponent of the draw in the factor (default 1)")
    where: dict[str, float] | None = optional(
        "for tables: only rows in which these columns have these values, e.g. {mode = 1}"
    )
    distribution: Literal[
        "normal", "truncated-normal", "uniform", "log-normal", "triangular", "choice", "samples", "cases"
    ] = Field(description="distribution of the draws")
    mean: float | None = optional("normal: mean (default: the value itself; 1 to scale, 0 to add)")
    sigma: NotNegative | None = optional("standard deviation; log-normal: that of ln(x)")
    three_sigma: NotNegative | None = optional("three times sigma, instead of it")
    low: float | None = optional("uniform, triangular, truncated normal: smallest value")
    high: float | None = optional("uniform, triangular, truncated normal: largest value")
    mode: float | None = optional("triangular: most likely value")
    median: Positive | None = optional("log-normal: median (default: 1 to scale, else the value)")
    values: tuple[Choice, ...] | None = optional("choice: numbers, texts or files")
    weights: tuple[NotNegative, ...] | None = optional("choice: weight of each (default: equal)")
    file: Samples | None = optional("samples, cases: a CSV file")
    column: str | None = optional("samples: column of the file (default: its only one)")
    order: Order = optional("samples, cases: a row at random, or row i for run i, cyclic", "random")
    covariance: tuple[tuple[float, ...], ...] | None = optional("normal with keys: covariance matrix")
    at_least: float | None = optional("lower bound of the resulting value")
    at_most: float | None = optional("upper bound of the resulting value")
    outside: Outside | None = optional("as campaign.outside, for this draw")

    @property
    def sigma_of_normal(self) -> float:
        """Return the standard deviation of a normal distribution, or of ln(x) of a log-normal one."""
        return self.sigma if self.sigma is not None else (self.three_sigma or 0.0) / 3.0

    @property
    def ends(self) -> tuple[float, float]:
        """Return `low` and `high`, infinite if they are not given."""
        return -math.inf if self.low is None else self.low, math.inf if self.high is None else self.high

    @property
    def sample_column(self) -> str:
        """Return the column from which samples are drawn; empty if none is given and there are several."""
        names = list(self.file.columns) if self.file is not None else []
        return self.column or (names[0] if len(names) == 1 else "")

    def centre(self, nominal: float) -> float:
        """Return the mean of a draw, or without a given mean, the draw that leaves the nominal value unchanged."""
        if self.mean is not None:
            return self.mean
        return {"set": nominal, "scale": 1.0, "add": 0.0}[self.apply]

    def _check(self) -> None:
        if self.distribution == "cases":
            for key in ("key", "keys"):
                if getattr(self, key) is not None:
                    raise refuse("the columns of the file are the keys", "no key with 'cases'", key)
        elif (self.key is None) == (self.keys is None):
            raise refuse("needs one of key, keys", "a key path", "key")
        self.only_with(("power",), self.apply == "scale", "apply = 'scale'")
        if self.keys is not None and (not self.keys or len(set(self.keys)) != len(self.keys)):
            raise refuse("names no key, or one twice", "different keys", "keys")
        meaningful = _MEANINGFUL[self.distribution]
        for key in {key: None for keys in _MEANINGFUL.values() for key in keys}:
            laws = ", ".join(f"'{law}'" for law, keys in _MEANINGFUL.items() if key in keys)
            self.only_with((key,), key in meaningful, laws)
            if key in _REQUIRED and key in meaningful and self.distribution != "truncated-normal":
                self.needs(key, f"distribution is '{self.distribution}'", _REQUIRED[key])
        self.only_with(("sigma", "three_sigma"), self.covariance is None, "a distribution without covariance")
        if "sigma" in meaningful and self.covariance is None:
            if (self.sigma is None) == (self.three_sigma is None):
                raise refuse("needs one of sigma, three_sigma", "a number >= 0", "sigma")
        low, high = self.ends
        if self.distribution == "truncated-normal" and low == -high == -math.inf:
            raise refuse("needs low, high or both", "a number", "low")
        if low > high or (low == high and self.distribution == "truncated-normal"):
            raise refuse("low is above high", f"at most {high:g}", "low")
        if self.at_least is not None and self.at_most is not None and self.at_least > self.at_most:
            raise refuse("is above at_most", f"at most {self.at_most:g}", "at_least")
        if self.mode is not None and not low <= self.mode <= high:
            raise refuse("is outside low .. high", f"{low:g} .. {high:g}", "mode")
        if self.values is not None:
            if not self.values:
                raise refuse("is empty", "one value or more", "values")
            if self.weights is not None and (len(self.weights) != len(self.values) or not sum(self.weights) > 0.0):
                raise refuse("do not fit the values", f"{len(self.values)} numbers >= 0, not all 0", "weights")
        if self.distribution == "samples" and self.file is not None:
            if self.sample_column not in self.file:
                raise refuse("the file has no such column", ", ".join(self.file.columns), "column")
        if self.covariance is not None:
            self._check_covariance(self.covariance)

    def _check_covariance(self, matrix: tuple[tuple[float, ...], ...]) -> None:
        n = len(self.keys or ())
        c = np.array([row for row in matrix if len(row) == n])
        if n == 0 or len(c) != n or len(matrix) != n:
            raise refuse(f"is not a matrix of {n} by {n}", "a row of numbers for each of keys", "covariance")
        if (c != c.T).any() or np.linalg.eigvalsh(c).min() < -1e-12 * np.abs(c).max():
            raise refuse("is not a covariance", "a symmetric matrix without negative eigenvalues", "covariance")


class WindModel(Section):
    """The wind profiles that differ from run to run."""

    model: Literal["vector", "ensemble"] = Field(
        description="vector: normal deviations from wind.profile, correlated over altitude; ensemble: given profiles"
    )
    source: str = optional("source of the numbers", "")
    kind: Uncertainty | None = optional(
        "aleatory: differs from flight to flight; epistemic: one unknown value (docs/verdicts.md)"
    )
    table: Annotated[CsvTable, WIND_MODEL_COLUMNS] | None = optional(
        "vector: standard deviations of both components over altitude, and their correlation"
    )
    correlation_length_m: Positive | None = optional("vector: height difference with correlation 1/e, m")
    factor: NotNegative = optional("vector: factor on the standard deviations", 1.0)
    months: Annotated[CsvTable, MONTH_COLUMNS] | None = optional(
        "vector: factors on the mean wind and the deviations by month (1 to 12), which runs use in turn"
    )
    profiles: Annotated[Profiles | None, BeforeValidator(_each_sounding)] = optional(
        "ensemble: files as for wind.profile; a folder: all its files; a file of several soundings: each of them"
    )
    order: Order = optional("ensemble: a profile at random, or profile i for run i", "random")

    def _check(self) -> None:
        is_vector = self.model == "vector"
        self.only_with(("table", "correlation_length_m", "months"), is_vector, "model = 'vector'")
        self.only_with(("profiles",), not is_vector, "model = 'ensemble'")
        if is_vector:
            table: CsvTable = self.needs("table", "model is 'vector'", WIND_MODEL_COLUMNS.allowed())
            self.needs("correlation_length_m", "model is 'vector'", "a number > 0")
            if (np.abs(table.get("correlation")) > 1.0).any():
                raise table.refusal("is not a correlation", "numbers -1 .. 1", "correlation", at=("table",))
            if self.months is not None:
                odd = ~np.isin(self.months["month"], np.arange(1, 13))
                self.months.refuse_where(odd, "month", "is not a month", "whole numbers 1 .. 12", at=("months",))
        elif not self.needs("profiles", "model is 'ensemble'", "a list of CSV files"):
            raise refuse("is empty", "one profile or more", "profiles")


class CampaignFile(Section):
    """The sections of a campaign file in addition to those of a scenario."""

    campaign: Campaign
    disperse: tuple[Disperse, ...] = optional("values that differ from run to run", ())
    wind_model: WindModel | None = optional("absent: every run has the scenario's wind")

    def _check(self) -> None:
        for n, text in enumerate(self.campaign.keep):
            if not keep_is_known(text):
                raise refuse("is not a selection", KEEP_ALLOWED, ("campaign", "keep", n))


def keep_is_known(text: str) -> bool:
    """Return True if `text` is a valid selection of flights, as in `KEEP_ALLOWED`."""
    found = re.fullmatch(r"worst:\d+(?::(.*))?|failed(?::\d+)?|\s*\d+\s*(?:,\s*\d+\s*)*", text)
    return found is not None and found[1] in (None, *METRIC_NAMES)
