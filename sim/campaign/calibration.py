"""The calibration of a campaign's dispersed numbers to measured series: the maximum of the posterior density.

The unknowns are the standard normal scores z of the draws. The prior of each is therefore N(0, 1), and the
distributions, covariances and correlated pairs of the campaign apply as they are. The measured values y have
independent normal errors sigma. The estimate minimises

    |(y - f(z) - b) / sigma|^2 + |z|^2 + |b / sigma_b|^2 + (s / sigma_s)^2

over the scores, a constant error b of each channel with a `bias_sigma`, and a time shift s. Method: Levenberg-Marquardt
with central differences (More, Lecture Notes in Mathematics 630, 1978), whose flights run in
parallel. The covariance is the inverse of the Gauss-Newton matrix at the estimate: the posterior for a model that is
linear within its uncertainty, with errors that are independent.

The path of the search depends on its flights only, which are stored. The same call therefore continues after an
interruption, with the same result, bit for bit.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from maxq.control.kernel.records import Array
from maxq.sim.campaign.error import CampaignError
from maxq.sim.campaign.plan import Draw, Drawn
from maxq.sim.campaign.read import LoadedCampaign, description_of
from maxq.sim.campaign.runs import VOID, fly_histories
from maxq.sim.campaign.store import simulator
from maxq.sim.campaign.targets import Refused
from maxq.sim.files import whole_file
from maxq.sim.run.comparison import Modelled, Residuals, difference, no_overlap, unwrapped
from maxq.sim.run.measured import MeasuredChannel, MeasuredSeries
from maxq.sim.scenario.loader import LoadedScenario

STEP, LEAST_STEP = 0.05, 0.005
"""The half-width of the differences, in standard deviations of the prior: that of the posterior, within these limits.
"""
OBSERVED = 0.9
"""A parameter whose posterior standard deviation is a larger share of its prior one is not observable."""
_CONTINUOUS = ("normal", "truncated-normal", "uniform", "log-normal", "triangular")
_MOST_ITERATIONS, _MOST_DAMPING = 25, 1e8
_CONVERGED = 0.01  # largest last step, in standard deviations of the posterior
_GRADIENT = 1e-4
_FASTEST_HZ, _PER_VALUE = 100.0, 4.0  # rows of a flight for each measured value
_SECOND_DIFFERENCE = math.sqrt(6.0)  # standard deviation of y[k-1] - 2 y[k] + y[k+1] of independent errors over sigma


@dataclass(frozen=True)
class Parameter:
    """A calibrated number: its name and label in the campaign, prior median, and estimate.

    `low` and `high` are the values at one posterior standard deviation on either side. `share` is the posterior
    standard deviation over that of the prior, linearised at the estimate.
    """

    name: str
    label: str
    prior: float
    value: float
    low: float
    high: float
    share: float

    @property
    def observed(self) -> bool:
        """Return True if the measurements determine the parameter better than the prior does."""
        return self.share <= OBSERVED


@dataclass(frozen=True)
class Calibration:
    """The result of `calibrate`.

    - `parameters`: those of the campaign; `correlation` (k, k): that of their values.
    - `nuisances`: name, unit, value and standard deviation of time shift and constant errors.
    - `scores` (k,) and `covariance`: normal scores, and the posterior covariance of scores and nuisances, of which the
      latter are in units of their prior standard deviations.
    - `before`, `after`: residuals of each channel at the prior medians and at the estimate.
    - `scenario`: the scenario with the estimates.
    """

    parameters: tuple[Parameter, ...]
    nuisances: tuple[tuple[str, str, float, float], ...]
    scores: Array
    covariance: Array
    correlation: Array
    before: tuple[Residuals, ...]
    after: tuple[Residuals, ...]
    scenario: LoadedScenario
    converged: bool
    iterations: int
    flights: int


class CalibrationStopped(Exception):
    """The end of a calibration on request; the same call continues it."""


@dataclass(frozen=True)
class CalibrationOptions:
    """The settings of a calibration: parameters by name or label (empty: all), prior of the time shift."""

    only: tuple[str, ...] = ()
    shift_s: float = 0.0
    shift_sigma_s: float = 0.0


def with_noise(measured: MeasuredSeries) -> MeasuredSeries:
    """Return the series with a noise for each channel, by default from the second differences of its values.

    The estimate assumes errors that are independent from value to value. Raises CampaignError if it is 0.
    """
    out = []
    for each in measured.channels:
        sigma = each.sigma
        if math.isnan(sigma):
            second = np.diff(unwrapped(each.values, each.unit), 2)
            sigma = float(np.sqrt(np.mean(second**2))) / _SECOND_DIFFERENCE if len(second) else 0.0
            if not sigma > 0.0:
                raise CampaignError(f"{measured.file}: {each.name}: its noise is unknown; give it by --sigma")
        out.append(replace(each, sigma=sigma))
    return replace(measured, channels=tuple(out))


def parameters_of(campaign: LoadedCampaign, only: Sequence[str] = ()) -> list[Draw]:
    """Return the draws that can be calibrated, or those of them with the names or labels `only`.

    These are all with a continuous distribution of numbers. Raises CampaignError for other names and without any.
    """
    free = [d for d in campaign.plan.draws if not d.is_text and d.spec.distribution in _CONTINUOUS]
    known = [name for d in free for name in (d.name, d.label)]
    if unknown := [name for name in only if name not in known]:
        allowed = ", ".join(dict.fromkeys(d.label for d in free))
        raise CampaignError(f"{unknown[0]}: the campaign has no such continuous draw; allowed: {allowed}")
    found = [d for d in free if not only or d.name in only or d.label in only]
    if not found:
        raise CampaignError(f"{campaign.name}: no draw has a continuous distribution of numbers")
    return found


class _Flights:
    """The flights of a calibration, which are stored in `folder` by a hash of all that determines them."""

    def __init__(
        self,
        campaign: LoadedCampaign,
        draws: Sequence[Draw],
        measured: MeasuredSeries,
        folder: Path,
        workers: int,
        stop: Callable[[], bool],
    ) -> None:
        self.campaign, self.names, self._folder, self._stop = campaign, [d.name for d in draws], folder, stop
        self._columns = [campaign.plan.score_names.index(d.stream) for d in draws]
        self._channels = tuple(each.name for each in measured.channels)
        shortest_s = min(float(np.median(np.diff(each.time_s))) for each in measured.channels)
        self.rate_hz = min(_FASTEST_HZ, max(_PER_VALUE / shortest_s, 10.0))
        self._pool = ThreadPoolExecutor(workers, thread_name_prefix="calibrate")
        about = json.dumps([description_of(campaign), self._channels, self.rate_hz, simulator()], sort_keys=True)
        self._identity = hashlib.sha256(about.encode()).digest()
        self.flown = 0

    def scenario(self, scores: Array) -> LoadedScenario | None:
        """Return the scenario for scores (k,), or None outside the bounds."""
        drawn, good = self._drawn(scores[None])
        try:
            return self.campaign.mixed(drawn, 0, self.names) if good[0] else None
        except Refused:
            return None

    def values(self, scores: Array) -> Array:
        """Return the values (m, k) of the draws for scores (m, k), without their bounds."""
        drawn, _ = self._drawn(scores)
        return np.stack([drawn.draws[name] for name in self.names], axis=1)

    def _drawn(self, scores: Array) -> tuple[Drawn, np.ndarray]:
        plan = self.campaign.plan
        z = np.zeros((len(scores), len(plan.score_names)))
        z[:, self._columns] = scores
        return plan.of_scores(z, np.zeros(len(scores), np.int64))

    def fly(self, points: Sequence[Array]) -> list[tuple[Array, Array] | None]:
        """Return times (n,) and channels (c, n) of a flight for each point; None without a usable flight.

        Raises CalibrationStopped.
        """
        found = list(self._pool.map(self._fly, points))
        if self._stop():
            raise CalibrationStopped
        return found

    def _fly(self, scores: Array) -> tuple[Array, Array] | None:
        path = self._folder / f"{hashlib.sha256(self._identity + scores.tobytes()).hexdigest()[:32]}.npy"
        if path.exists():
            stored = np.load(path)
            return (stored[0], stored[1:]) if stored.size else None
        made = self.scenario(scores)
        history = None
        if made is not None:
            flown = fly_histories(made, self._channels, self.rate_hz, self._stop)
            if flown is None:  # interrupted
                return None
            flight, times, values = flown
            self.flown += 1
            history = None if flight.outcome in VOID else (times, values)
        if not self._stop():
            with whole_file(path, CampaignError) as part, part.open("wb") as file:
                np.save(file, np.zeros(0) if history is None else np.vstack(history))
        return history

    def close(self) -> None:
        self._pool.shutdown(cancel_futures=True)


@dataclass
class _Point:
    """A point of the search: unknowns x (scores, then shift and constant errors), its weighted residuals and cost."""

    x: Array
    history: tuple[Array, Array]
    residuals: Array
    cost: float


class _Problem:
    """The weighted residuals of a calibration, with their derivatives."""

    def __init__(self, flights: _Flights, measured: MeasuredSeries, options: CalibrationOptions) -> None:
        self.flights, self.measured, self.options = flights, measured, options
        self.scores = len(flights.names)
        self.priors: list[tuple[str, str, float]] = []
        if options.shift_sigma_s > 0.0:
            self.priors.append(("time shift", "s", options.shift_sigma_s))
        biased = [each for each in measured.channels if each.bias_sigma > 0.0]
        self.priors += [(f"bias of {each.name}", each.unit, each.bias_sigma) for each in biased]
        self.used: list[np.ndarray] = []  # measured values within the first flight, a mask for each channel

    @property
    def size(self) -> int:
        return self.scores + len(self.priors)

    def shift_s(self, x: Array) -> float:
        """Return the time shift at unknowns x; those after the scores are in units of their prior."""
        fitted = self.options.shift_sigma_s * x[self.scores] if self.options.shift_sigma_s > 0.0 else 0.0
        return float(self.options.shift_s + fitted)

    def _bias(self, x: Array, each: MeasuredChannel) -> float:
        if not each.bias_sigma > 0.0:
            return 0.0
        at = next(n for n, (name, *_) in enumerate(self.priors) if name == f"bias of {each.name}")
        return float(each.bias_sigma * x[self.scores + at])

    def begin(self, history: tuple[Array, Array]) -> None:
        """Use the measured values within the time of this flight. Raises CampaignError if there are none."""
        shift_s = self.options.shift_s
        models = self._models(history)
        self.used = [m.inside(each.time_s + shift_s) for m, each in zip(models, self.measured.channels, strict=True)]
        if not any(mask.any() for mask in self.used):
            pairs = list(zip(self.measured.channels, models, strict=True))
            raise CampaignError(f"{self.measured.file}: {no_overlap(pairs, shift_s)}")

    def _models(self, history: tuple[Array, Array]) -> list[Modelled]:
        channels = zip(history[1], self.measured.channels, strict=True)
        return [Modelled(history[0], values, each.unit) for values, each in channels]

    def predicted(self, history: tuple[Array, Array], x: Array) -> list[Array]:
        """Return the modelled values at the times used, by channel."""
        shift_s = self.shift_s(x)
        return [
            model.at(each.time_s[mask] + shift_s)
            for model, each, mask in zip(self._models(history), self.measured.channels, self.used, strict=True)
        ]

    def residuals(self, history: tuple[Array, Array], x: Array) -> Array:
        """Return the weighted residuals (n,) of all channels, without the prior."""
        out = []
        for y, each, mask in zip(self.predicted(history, x), self.measured.channels, self.used, strict=True):
            values = unwrapped(each.values, each.unit)[mask]
            out.append((difference(values, y, each.unit) - self._bias(x, each)) / each.sigma)
        return np.concatenate(out)

    def point(self, x: Array, history: tuple[Array, Array]) -> _Point:
        residuals = self.residuals(history, x)
        return _Point(x, history, residuals, float(residuals @ residuals + x @ x))

    def jacobian(self, at: _Point, widths: Array) -> Array:
        """Return the derivative (n, size) of the weighted residuals, by central differences where both flights exist.

        `widths` (size,) are the half-widths of the differences of the scores.

        Raises CampaignError if neither exists, and CalibrationStopped.
        """
        moves = [sign * widths[k] * np.eye(self.size)[k] for k in range(self.scores) for sign in (1.0, -1.0)]
        flown = self.flights.fly([(at.x + move)[: self.scores] for move in moves])
        out = np.zeros((len(at.residuals), self.size))
        for k in range(self.scores):
            up, down = flown[2 * k], flown[2 * k + 1]
            if up is None and down is None:
                raise CampaignError(f"{self.flights.names[k]}: no flight near its estimate is usable")
            ahead = at.residuals if up is None else self.residuals(up, at.x)
            behind = at.residuals if down is None else self.residuals(down, at.x)
            out[:, k] = (ahead - behind) / (widths[k] * ((up is not None) + (down is not None)))
        for n in range(len(self.priors)):
            move = 1e-3 * np.eye(self.size)[self.scores + n]
            out[:, self.scores + n] = (
                self.residuals(at.history, at.x + move) - self.residuals(at.history, at.x - move)
            ) / 2e-3
        return out

    def compared(self, at: _Point) -> tuple[Residuals, ...]:
        """Return the residuals of each channel at a point, with its constant error removed."""
        out, shift_s = [], self.shift_s(at.x)
        for y, each, mask in zip(self.predicted(at.history, at.x), self.measured.channels, self.used, strict=True):
            if mask.any():
                values = unwrapped(each.values, each.unit)[mask]
                residual = difference(values, y, each.unit) - self._bias(at.x, each)
                out.append(Residuals(each, each.time_s[mask] + shift_s, y, residual, int(len(mask) - mask.sum())))
        return tuple(out)


def calibrate(
    campaign: LoadedCampaign,
    measured: MeasuredSeries,
    folder: Path,
    options: CalibrationOptions | None = None,
    *,
    workers: int = 1,
    watch: Callable[[int, float, int], None] = lambda iteration, cost, flights: None,
    stop: Callable[[], bool] = lambda: False,
) -> Calibration:
    """Return the most probable values of a campaign's parameters, given measured series with their noise.

    Draws that are not calibrated, wind and noise are those of the scenario. Flights are stored in `folder`. `watch` is
    called with the number of the iteration, the sum of squares over the number of measured values, and the number of
    flights. Raises CampaignError if the scenario itself has no usable flight, and CalibrationStopped.
    """
    options = options or CalibrationOptions()
    draws = parameters_of(campaign, options.only)
    flights = _Flights(campaign, draws, measured, folder, workers, stop)
    try:
        return _calibrated(_Problem(flights, measured, options), draws, watch)
    finally:
        flights.close()


def _calibrated(problem: _Problem, draws: Sequence[Draw], watch: Callable[[int, float, int], None]) -> Calibration:
    flights, x = problem.flights, np.zeros(problem.size)
    (first,) = flights.fly([x[: problem.scores]])
    if first is None:
        raise CampaignError(f"{flights.campaign.name}: its flight with the medians of all draws is not usable")
    problem.begin(first)
    start = at = problem.point(x, first)
    damping, converged, iteration = 0.0, False, 0
    jacobian = problem.jacobian(at, np.full(problem.size, STEP))
    while iteration < _MOST_ITERATIONS and not converged and damping <= _MOST_DAMPING:
        iteration += 1
        watch(iteration, at.cost / len(at.residuals), flights.flown)
        normal, slope = jacobian.T @ jacobian + np.eye(problem.size), jacobian.T @ at.residuals + at.x
        widths = np.clip(np.sqrt(np.diag(np.linalg.inv(normal))), LEAST_STEP, STEP)
        while damping <= _MOST_DAMPING:
            step = -np.linalg.solve(normal + damping * np.eye(problem.size), slope)
            converged = math.sqrt(float(step @ normal @ step)) < _CONVERGED and damping < 1.0
            (history,) = flights.fly([(at.x + step)[: problem.scores]])
            trial = None if history is None else problem.point(at.x + step, history)
            if trial is not None and trial.cost <= at.cost:
                gain = (at.cost - trial.cost) / max(float(-step @ (2.0 * slope + normal @ step)), 1e-300)
                damping = 0.0 if gain > 0.75 and damping <= 1.0 else damping * (0.1 if gain > 0.75 else 1.0)
                at, jacobian = trial, problem.jacobian(trial, widths)
                break
            if converged:
                break
            damping = max(10.0 * damping, 1.0)
    covariance = np.asarray(np.linalg.inv(jacobian.T @ jacobian + np.eye(problem.size)), np.float64)
    return _result(problem, draws, start, at, covariance, converged, iteration)


def _result(
    problem: _Problem,
    draws: Sequence[Draw],
    start: _Point,
    at: _Point,
    covariance: Array,
    converged: bool,
    iterations: int,
) -> Calibration:
    flights, k = problem.flights, problem.scores
    sigma, scores, own = np.sqrt(np.diag(covariance)), at.x[:k], covariance[:k, :k]
    prior, value = flights.values(np.stack([start.x[:k], scores]))
    moves = _GRADIENT * np.eye(k)
    gradient = (flights.values(scores + moves) - flights.values(scores - moves)).T / (2.0 * _GRADIENT)
    spread = np.sqrt(np.einsum("ij,jk,ik->i", gradient, own, gradient))  # posterior standard deviations of the values
    ends = [
        flights.values(scores + sign * (gradient @ own) / np.maximum(spread, 1e-300)[:, None]) for sign in (-1.0, 1.0)
    ]
    found = []
    for n, d in enumerate(draws):
        low, high = sorted(float(end[n, n]) for end in ends)
        width = float(np.linalg.norm(gradient[n]))
        share = float(spread[n]) / width if width > 0.0 else 1.0
        found.append(Parameter(d.name, d.label, float(prior[n]), float(value[n]), low, high, share))
    made = flights.scenario(scores)
    assert made is not None
    correlation = gradient @ own @ gradient.T / np.maximum(np.outer(spread, spread), 1e-300)
    nuisances = []
    for n, (name, unit, width) in enumerate(problem.priors, start=k):
        offset = problem.options.shift_s if name == "time shift" else 0.0
        nuisances.append((name, unit, float(offset + width * at.x[n]), float(width * sigma[n])))
    return Calibration(
        tuple(found),
        tuple(nuisances),
        scores,
        covariance,
        correlation,
        problem.compared(start),
        problem.compared(at),
        made,
        converged,
        iterations,
        flights.flown,
    )
