"""Bounds and run counts equal sums of the binomial distribution, published numbers and simulation."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from functools import lru_cache
from types import SimpleNamespace
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from scipy import integrate, optimize, stats

from maxq import DataSet
from maxq.sim.campaign import statistics as s
from maxq.sim.campaign import tails
from maxq.sim.campaign.analysis import _judged
from maxq.sim.campaign.draws import box, chosen, correlated, quantile
from maxq.sim.campaign.runner import Tally
from maxq.sim.campaign.schema import Disperse
from maxq.sim.campaign.tails import fit_pareto, tail_of
from maxq.sim.scenario.schema_scenario import RequirementSection
from maxq.tools.dev.verification.tail_bounds import LAWS

OPEN = "undecided"
TWO = "second mechanism in 0.4%, at 10 sigma"

Judge = Callable[[int, int, int | None], s.Shown]
User = Callable[[np.ndarray, int | None, Judge], bool]


@pytest.mark.parametrize(
    ("success", "runs"), [(0.9973, [852, 1440, 1970, 2473, 2959]), (0.99865, [1705, 2880, 3941, 4947])]
)
def test_runs_that_show_it_with_k_failures(success: float, runs: list[int]) -> None:
    """The numbers of runs equal the table of Hanson & Beard, NASA/TP-2010-216447, at 90 % confidence."""
    for k, n in enumerate(runs):
        assert s.allowed_failures(n, success, 0.9) == k
        assert s.allowed_failures(n - 1, success, 0.9) == k - 1
        assert s.judge_failures(k, n, success, 0.9, planned=n).judgement == "met"
        assert s.judge_failures(k, n - 1, success, 0.9, planned=n - 1).judgement == OPEN


def test_two_thousand_runs() -> None:
    assert s.allowed_failures(2000, 0.9973, 0.9) == 2
    assert s.allowed_failures(2000, 0.99865, 0.9) == 0


@pytest.mark.parametrize(("k", "n"), [(0, 10), (3, 50), (10, 10), (7, 2000)])
def test_bounds_are_where_the_binomial_tails_are(k: int, n: int) -> None:
    """The bounds equal sums of probabilities, term by term."""

    def at_most(count: int, p: float) -> float:
        return math.fsum(math.comb(n, i) * p**i * (1 - p) ** (n - i) for i in range(count + 1))

    upper, lower = s.failure_upper(k, n, 0.9), s.failure_lower(k, n, 0.9)
    assert upper == 1.0 if k == n else at_most(k, upper) == pytest.approx(0.1, rel=1e-9)
    assert lower == 0.0 if k == 0 else 1.0 - at_most(k - 1, lower) == pytest.approx(0.1, rel=1e-7)


def test_judgements() -> None:
    assert s.judge_failures(0, 0, 0.9973, 0.9).judgement == OPEN
    assert s.judge_failures(0, 0, 0.9973, 0.9).more == 1104
    assert s.judge_failures(0, 1103, 0.9973, 0.9).more == 1
    assert s.judge_failures(0, 1104, 0.9973, 0.9).judgement == "met"
    assert s.judge_failures(6, 60, 0.9973, 0.9).judgement == "missed"
    assert s.judge_failures(1, 1, 0.5, 0.9).judgement == OPEN
    before, at, beyond = (s.judge_failures(4, n, 0.99, 0.9, planned=1000) for n in (999, 1000, 1001))
    assert (before.judgement, before.more, at.judgement, beyond.judgement) == (OPEN, 1, "met", OPEN)
    # five failures of 1000 are the most: P(X <= 5) = 0.0661, which leaves 3.4 %
    assert beyond.test == "any-time test at 3.4 % risk, which the fixed test of 1000 runs left"
    assert s.judge_failures(16, 1000, 0.99, 0.9, planned=1000).judgement == "missed"  # P(X >= 16) = 0.049
    for k in range(40):  # what is allowed is what is judged
        n = int(np.random.default_rng(k).integers(k + 1, 4000))
        assert (s.judge_failures(k, n, 0.99, 0.9).judgement == "met") == (
            k <= s.judge_failures(0, n, 0.99, 0.9).allowed
        )


@pytest.mark.parametrize(("k", "n", "p"), [(0, 50, 0.0027), (3, 400, 0.01), (12, 90, 0.05), (40, 40, 0.3), (1, 1, 0.5)])
def test_evidence_is_the_integral_over_the_mixture(k: int, n: int, p: float) -> None:
    """The evidence is the likelihood ratio averaged numerically over the other side of p."""

    def ratio(q: float) -> float:
        return math.exp(k * math.log(q / p) + (n - k) * math.log((1.0 - q) / (1.0 - p))) if q < 1.0 or n == k else 0.0

    below = integrate.quad(lambda root: ratio(root * root) / math.sqrt(p), 0.0, math.sqrt(p), epsrel=1e-10)[0]
    above = integrate.quad(lambda x: ratio(math.exp(x)) / -math.log(p), math.log(p), 0.0, epsrel=1e-10)[0]
    assert float(s.evidence_met(k, n, p)) == pytest.approx(math.log(below), rel=1e-7, abs=1e-7)
    if k:
        assert float(s.evidence_missed(k, n, p)) == pytest.approx(math.log(above), rel=1e-7, abs=1e-7)


def test_the_order_statistic_agrees_with_the_verdict() -> None:
    """The bound is within the limit exactly when no more runs fail than are allowed."""
    rng = np.random.default_rng(2)
    for planned in (None, 2000):
        for _ in range(50):
            values = rng.normal(size=2000)
            limit = np.sort(values)[-int(rng.integers(1, 8))]
            shown = s.judge_failures(int((values > limit).sum()), 2000, 0.9973, 0.9, planned)
            assert (s.tolerance_bound(values, shown.allowed) <= limit) == (shown.judgement == "met")
    assert math.isnan(s.tolerance_bound(np.zeros(851), -1))
    assert s.tolerance_bound(np.array([math.nan] + [1.0] * 851), 0) == math.inf
    assert s.tolerance_bound(np.arange(852.0), 0, largest=False) == 0.0


def test_the_order_statistic_covers_the_quantile_as_often_as_it_says() -> None:
    rng = np.random.default_rng(1)
    allowed = s.allowed_failures(300, 0.95, 0.9)
    covered = [s.tolerance_bound(rng.random(300), allowed) >= 0.95 for _ in range(4000)]
    # exactly 1 - P(X > k), X binomial: at least 0.9; four standard deviations of 4000 trials are 0.02
    exact = 1.0 - stats.binom.cdf(allowed, 300, 0.05)
    assert exact >= 0.9
    assert np.mean(covered) == pytest.approx(exact, abs=0.02)


@pytest.mark.parametrize("seed", [0, 1])
def test_bounds_of_a_tail_are_those_of_the_profile_likelihood(seed: int) -> None:
    """The bounds are at half the chi-square quantile below the best likelihood.

    A fine grid of shape and share beyond the threshold with SciPy's densities is the reference.
    """
    x, p, limit = np.random.default_rng(seed).normal(size=1000), 0.0027, 4.0
    t = tail_of(x, limit, 1.0 - p, 0.9)
    y, n = np.sort(x[x > t.threshold]) - t.threshold, len(x)
    k = len(y)
    shapes = np.linspace(-0.9, 0.6, 150)[:, None]  # none of them 0
    shares = k / n * np.exp(np.linspace(-5.0, 5.0, 101) / np.sqrt(k))[None]
    allowed = 0.5 * stats.chi2.ppf(0.9, 1)

    def profile(excess: float, beyond: float) -> float:
        ratio = np.log(shares / beyond)
        scales = excess * shapes / np.expm1(shapes * ratio)
        fits = stats.genpareto.logpdf(y[:, None, None], shapes[None], scale=scales[None]).sum(axis=0)
        return float((fits + stats.binom.logpmf(k, n, shares)).max())

    best = stats.genpareto.logpdf(y, t.shape, scale=t.scale).sum() + stats.binom.logpmf(k, n, k / n)
    at_bound = best - profile(t.quantile_bound - t.threshold, p), best - profile(limit - t.threshold, t.beyond_bound)
    assert at_bound == pytest.approx((allowed, allowed), abs=0.05)


# what a user may do next, with a vehicle whose probability of failure is just the one that is not allowed

SUCCESS, P, RISK, CAMPAIGNS = 0.95, 0.05, 0.1, 800
LIMIT = RISK + 2.6 * math.sqrt(RISK * (1.0 - RISK) / CAMPAIGNS)  # 99.5 % of all counts where the risk is just RISK


@lru_cache(maxsize=2048)
def _failures(seed: int, runs: int = 3000) -> np.ndarray:
    return np.cumsum(np.random.default_rng([3, seed]).random(runs) < P)


def _follows_the_advice(failures: np.ndarray, planned: int | None, judge: Judge) -> bool:
    """Fly the advised number of further runs until the verdict settles; return True if the verdict is met."""
    n = planned or 100
    while n <= len(failures):
        shown = judge(int(failures[n - 1]), n, planned)
        if shown.judgement != OPEN:
            return shown.judgement == "met"
        n += max(shown.more, 1)
    return False


def _looks_all_the_time(failures: np.ndarray, planned: int | None, judge: Judge) -> bool:
    looks = range(planned or 40, 1500, 40)
    return any(judge(int(failures[n - 1]), n, planned).judgement == "met" for n in looks)


def _any_time_or_as_planned(failures: int, runs: int, planned: int | None) -> s.Shown:
    return s.judge_failures(failures, runs, SUCCESS, 1.0 - RISK, planned)


@lru_cache(maxsize=4096)
def _exact_at_every_look(failures: int, runs: int, planned: int | None) -> s.Shown:
    """Return the exact binomial test at a number of runs as if it were the only look, which leads to a false "met"."""
    shown = s.judge_failures(failures, runs, SUCCESS, 1.0 - RISK, runs)
    more = next(n for n in range(runs, 9999) if s.allowed_failures(n, SUCCESS, 1.0 - RISK) >= failures) - runs
    return dataclasses.replace(shown, more=more)


@pytest.mark.slow
@pytest.mark.parametrize("planned", [None, 120], ids=["any-time", "fixed"])
@pytest.mark.parametrize("user", [_follows_the_advice, _looks_all_the_time])
def test_whatever_the_user_does_next_the_risk_is_kept(user: User, planned: int | None) -> None:
    """For a vehicle just below the requirement, no more campaigns end as met than the confidence allows."""
    met = np.mean([user(_failures(k), planned, _any_time_or_as_planned) for k in range(CAMPAIGNS)])
    assert met <= LIMIT
    assert met > 0.02  # and the tests do not keep it by never saying anything


@pytest.mark.slow
@pytest.mark.parametrize("user", [pytest.param(_follows_the_advice, marks=pytest.mark.long), _looks_all_the_time])
def test_the_exact_test_would_not_keep_the_risk(user: User) -> None:
    """The exact test at every look exceeds the risk, so the measurement above can fail."""
    assert np.mean([user(_failures(k), None, _exact_at_every_look) for k in range(100)]) > 0.18


def test_looking_all_the_time_rejects_no_good_vehicle_too_often() -> None:
    """A vehicle that just meets the requirement is "missed" at any look no more often than the risk allows."""
    wrong = [
        any(s.judge_failures(int(f[n - 1]), n, SUCCESS, 1.0 - RISK).judgement == "missed" for n in range(5, 1500, 40))
        for f in map(_failures, range(600))
    ]
    assert np.mean(wrong) <= RISK + 2.6 * math.sqrt(RISK * (1.0 - RISK) / 600)


def test_the_confidence_sequence_covers_at_all_times_together() -> None:
    looks = [10, 30, 100, 300, 1000]
    low, high = 0, 0
    for f in map(_failures, range(400)):
        bounds = [s.confidence_sequence(int(f[n - 1]), n, 1.0 - RISK) for n in looks]
        assert all(a <= f[n - 1] / n <= b for (a, b), n in zip(bounds, looks, strict=True))
        low, high = low + any(a > P for a, _ in bounds), high + any(b < P for _, b in bounds)
    assert max(low, high) / 400 <= RISK + 2.6 * math.sqrt(RISK * (1.0 - RISK) / 400)


def test_the_confidence_sequence_ends_where_the_evidence_suffices() -> None:
    """Each bound follows from the evidence on its own side, and no runs give no bound."""
    for k, n in ((0, 30), (3, 100), (97, 100)):
        low, high = s.confidence_sequence(k, n, 0.9)
        assert low <= k / n <= high
        if k > 0:
            assert s.evidence_missed(k, n, low) == pytest.approx(-math.log(0.1), rel=1e-6)
        assert s.evidence_met(k, n, high) == pytest.approx(-math.log(0.1), rel=1e-6)
    assert s.confidence_sequence(0, 0, 0.9) == (0.0, 1.0)


@pytest.mark.slow
def test_beyond_the_fixed_test_each_side_has_the_risk_that_is_left_of_its_own() -> None:
    p, risk, planned = 0.05, 0.1, 60
    allowed = s.allowed_failures(planned, 1.0 - p, 1.0 - risk)
    refused = next(k for k in range(planned) if stats.binom.sf(k - 1, planned, p) <= risk)
    left_met = risk - stats.binom.cdf(allowed, planned, p)
    left_missed = risk - stats.binom.sf(refused - 1, planned, p)
    between = 0
    for n in range(planned + 1, 400):
        for k in range(12):
            met, missed = s.evidence_met(k, n, p), s.evidence_missed(k, n, p)
            wanted = "missed" if missed >= -math.log(left_missed) else OPEN
            wanted = "met" if wanted == OPEN and met >= -math.log(left_met) else wanted
            assert s.judge_failures(k, n, 1.0 - p, 1.0 - risk, planned).judgement == wanted
            between += min(left_met, left_missed) < math.exp(-met) < max(left_met, left_missed)
    assert between > 5  # the risks differ enough to be told apart


@pytest.mark.parametrize("shape", [-0.4, -0.1, 0.0, 0.3])
def test_pareto_fits_are_scipys(shape: float) -> None:
    y = np.sort(stats.genpareto.rvs(shape, scale=2.0, size=200, random_state=5))
    found, scale = (float(part[0]) for part in fit_pareto(y[None]))
    theirs, _, their_scale = stats.genpareto.fit(y, floc=0)
    ours = stats.genpareto.logpdf(y, found, 0, scale).sum()
    assert ours >= stats.genpareto.logpdf(y, theirs, 0, their_scale).sum() - 1e-4
    assert (found, scale) == pytest.approx((theirs, their_scale), rel=2e-3, abs=2e-3)


def test_values_expected_beyond_a_threshold_are_quantiles_of_the_fit() -> None:
    found = tail_of(stats.expon.rvs(size=1000, random_state=3), 12.0, 0.9973, 0.9)
    count = len(found.excesses)
    assert found.problem == ""
    assert count > 20
    ranks = (np.arange(count) + 0.5) / count
    ours = found.threshold + stats.genpareto.ppf(ranks, found.shape, scale=found.scale)
    np.testing.assert_allclose(found.expected, ours, rtol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize(
    "law", [stats.expon, *(pytest.param(law, marks=pytest.mark.long) for law in (stats.norm, stats.gumbel_r))]
)
def test_tails_cover_what_lies_beyond_the_runs(law: stats.rv_continuous) -> None:
    """From 1,000 runs, bounds at 90 % for the 99.73 % quantile and a probability of 1e-4 cover in most cases."""
    limit, quantile = float(law.isf(1e-4)), float(law.ppf(0.9973))
    every = [tail_of(law.rvs(size=1000, random_state=k), limit, 0.9973, 0.9) for k in range(25)]
    tails = [t for t in every if not t.problem]
    assert len(tails) >= 20  # fewer are left of 25, where 5 % are withheld: 0.1 %
    assert sum(t.quantile_bound < quantile for t in tails) <= 7  # 7 of 25 or more at 90 %: 0.9 %
    assert sum(t.beyond_bound < 1e-4 for t in tails) <= 7
    assert np.median([t.quantile for t in tails]) == pytest.approx(quantile, rel=0.06)
    assert 0.2 < np.mean([t.fit for t in tails]) < 0.85
    mirrored = tail_of(-law.rvs(size=1000, random_state=0), -limit, 0.9973, 0.9, largest=False)
    assert mirrored.quantile_bound == -tails[0].quantile_bound
    assert mirrored.beyond_bound == tails[0].beyond_bound


def test_a_censored_fit_and_its_ratio_of_two_tails_are_scipys(monkeypatch: pytest.MonkeyPatch) -> None:
    """A fit censored at the ten largest values equals a search over both parameters of the likelihood."""
    y = np.sort(stats.genpareto.rvs(0.1, scale=2.0, size=100, random_state=8))
    y[-4:] += 12.0

    def body(parameters: np.ndarray) -> float:
        law = stats.genpareto(parameters[0], scale=math.exp(parameters[1]))
        return -float(law.logpdf(y[:90]).sum() + 10.0 * law.logsf(y[89]))

    theirs = optimize.minimize(body, [0.1, 0.7], method="Nelder-Mead", options={"xatol": 1e-7, "fatol": 1e-9})
    shape, scale = (float(part[0]) for part in fit_pareto(y[None], 10))
    assert (shape, scale) == pytest.approx((theirs.x[0], math.exp(theirs.x[1])), abs=1e-3)
    above = stats.expon(scale=float((y[90:] - y[89]).mean())).logpdf(y[90:] - y[89]).sum()
    whole, its_scale = (float(part[0]) for part in fit_pareto(y[None]))
    one = float(stats.genpareto.logpdf(y, whole, scale=its_scale).sum())
    monkeypatch.setattr(tails, "_LARGEST", (10,))
    assert tails.two_tails(y[None])[0] == pytest.approx(above - theirs.fun - one, abs=1e-5)


def test_a_second_mechanism_in_the_sample_withholds_the_estimate() -> None:
    rng = np.random.default_rng(11)
    x = rng.normal(size=1000)
    assert not tail_of(x, 12.0, 0.9973, 0.9).problem
    x[[17, 400, 600, 999]] = 8.0 + rng.normal(size=4)
    found = tail_of(x, 12.0, 0.9973, 0.9)
    assert found.problem == f"the largest values depart from the rest ({found.largest:.2f}): a second mechanism?"
    assert found.largest <= 0.05
    assert math.isnan(found.quantile_bound)
    assert math.isnan(found.beyond_bound)


def test_a_tail_states_how_frequent_a_mechanism_without_a_run_may_be() -> None:
    found = tail_of(np.random.default_rng(11).normal(size=1000), 12.0, 0.9973, 0.9)
    assert (1.0 - found.unseen) ** 1000 == pytest.approx(0.1, rel=1e-9)


@pytest.mark.slow
def test_two_tails_are_found_as_often_as_the_documentation_says() -> None:
    """Fits are withheld in at least seven of ten campaigns of 1,000 runs with a 0.4 % mechanism at ten sigma."""
    flagged = [bool(tail_of(LAWS[TWO].draw(np.random.default_rng(k)), 99.0, 0.9973, 0.9).problem) for k in range(10)]
    assert sum(flagged) >= 7


@pytest.mark.parametrize("shape", [-0.4, 0.0, 0.3])
def test_what_lies_beyond_an_excess_is_scipys_both_ways(shape: float) -> None:
    law = stats.genpareto(shape, scale=1.7)
    for excess in (0.1, 0.9, 2.5):
        assert tails._beyond(shape, 1.7, excess) == pytest.approx(law.sf(excess), rel=1e-12)
        assert tails._excess_at(shape, 1.7, law.sf(excess)) == pytest.approx(excess, rel=1e-12)
    assert tails._beyond(shape, 1.7, 4.3) == pytest.approx(law.sf(4.3), rel=1e-12)  # of -0.4 the end is at 4.25


def test_where_a_condition_ends() -> None:
    assert tails._last(lambda x: x < 0.3, 0.0, 0.5) == pytest.approx(0.3, abs=1e-9)
    assert tails._last(lambda _: True, 0.0, 0.5) == math.inf  # no end above
    assert tails._last(lambda _: True, 0.0, -0.5) == -0.5


def test_tails_say_why_there_is_no_fit_and_when_it_is_poor() -> None:
    rng = np.random.default_rng(6)
    assert tail_of(rng.normal(size=100), 3.0, 0.99, 0.9).problem == "100 runs; 120 are needed"
    assert "are equal, at 6" in tail_of(np.minimum(rng.normal(5.0, 1.0, 1000), 6.0), 6.3, 0.9973, 0.9).problem
    assert tail_of(rng.normal(size=200), 3.0, 0.5, 0.9).problem == "50 % is within the values flown"
    steps = np.round(rng.exponential(1.0, 1000)) + 0.02 * rng.random(1000)  # comes in lumps, as no such tail does
    assert "the largest values depart from the rest (0.00)" in tail_of(steps, 20.0, 0.9973, 0.9).problem
    x = rng.exponential(1.0, 1000)
    x[rng.permutation(np.flatnonzero(x < 1.0))[:40]] = rng.normal(3.0, 0.02, 40)  # a lump in the middle of the tail
    assert tail_of(x, 20.0, 0.9973, 0.9).fit < 0.05


CASES = [
    ({"distribution": "normal", "mean": 2.0, "sigma": 0.5}, stats.norm(2.0, 0.5)),
    ({"distribution": "normal", "mean": 2.0, "three_sigma": 1.5}, stats.norm(2.0, 0.5)),
    ({"distribution": "uniform", "low": -1.0, "high": 3.0}, stats.uniform(-1.0, 4.0)),
    ({"distribution": "triangular", "low": -1.0, "mode": 0.0, "high": 3.0}, stats.triang(0.25, -1.0, 4.0)),
    ({"distribution": "triangular", "low": 0.0, "mode": 0.0, "high": 3.0}, stats.triang(0.0, 0.0, 3.0)),
    ({"distribution": "log-normal", "median": 3.0, "sigma": 0.4}, stats.lognorm(0.4, scale=3.0)),
    (
        {"distribution": "truncated-normal", "mean": 0.0, "sigma": 1.0, "low": -0.5, "high": 2.0},
        stats.truncnorm(-0.5, 2.0),
    ),
    ({"distribution": "truncated-normal", "mean": 0.0, "sigma": 1.0, "low": 9.0}, stats.truncnorm(9.0, np.inf)),
    ({"distribution": "truncated-normal", "mean": 0.0, "sigma": 1.0, "high": -9.0}, stats.truncnorm(-np.inf, -9.0)),
]


@pytest.mark.parametrize(("spec", "law"), CASES)
def test_quantiles_are_scipys(spec: dict[str, object], law: stats.rv_continuous) -> None:
    u = np.concatenate([[1e-12, 1e-6], np.linspace(0.001, 0.999, 499), [1 - 1e-6]])
    mine = quantile(Disperse.model_validate({"key": "x", **spec}), u, 0.0)
    assert mine == pytest.approx(law.ppf(u), rel=1e-8, abs=1e-9)


def test_choices_come_as_often_as_they_weigh() -> None:
    spec = Disperse.model_validate(
        {"key": "x", "distribution": "choice", "values": (1.0, 2.0, 3.0), "weights": (1.0, 0.0, 3.0)}
    )
    u = (np.arange(1000) + 0.5) / 1000
    assert np.bincount(chosen(spec, u), minlength=3).tolist() == [250, 0, 750]


def test_covariances_are_met_also_where_singular() -> None:
    rng = np.random.default_rng(4)
    for matrix in (((4.0, 1.0), (1.0, 9.0)), ((1.0, 1.0), (1.0, 1.0)), ((0.0, 0.0), (0.0, 1.0))):
        scores = [rng.normal(size=40_000) for _ in range(2)]
        found = np.cov(correlated(matrix, scores))
        # the standard error of a covariance of unit normals is about sqrt(2/n)
        assert found == pytest.approx(np.array(matrix), abs=5 * 9 * math.sqrt(2 / 40_000))


def test_the_box_of_a_search() -> None:
    assert box(
        Disperse.model_validate({"key": "x", "distribution": "normal", "three_sigma": 0.3}), 2.0
    ) == pytest.approx((1.7, 2.3))
    uniform = Disperse.model_validate({"key": "x", "distribution": "uniform", "low": 1.0, "high": 5.0})
    assert box(uniform, 0.0) == (1.0, 5.0)


@pytest.mark.parametrize(
    ("bound", "values", "worst"), [("limit", (4.0, 6.0, 5.0), 6.0), ("minimum", (6.0, 4.0, 5.0), 4.0)]
)
def test_a_run_beyond_its_limit_is_counted_and_one_without_a_value_too(
    bound: str, values: tuple[float, ...], worst: float
) -> None:
    tally = Tally("incidence", RequirementSection.model_validate({"metric": "max_alpha_deg", bound: 5.0}))
    counts = [tally.judge("burnout", "", {"max_alpha_deg": value}) for value in values]
    assert counts == list(zip((0, 1, 0), values, strict=True))  # the second lies beyond, the third on it
    void = tally.judge("diverged", "", {"max_alpha_deg": 5.0})
    assert void[0] == 1
    for count in (*counts, void):
        tally.add(count)
    assert (tally.failures, tally.worst) == (2, worst)
    kept = Tally("control kept", None)
    assert [kept.judge("burnout", "", {})[0], kept.judge("burnout", "incidence", {})[0]] == [0, 1]


@pytest.mark.parametrize("bound", ["limit", "minimum"])
def test_runs_are_judged_up_to_the_first_gap_and_one_without_a_value_has_failed(bound: str) -> None:
    """Six runs have one value below 5, one equal to 5, two above it, and one missing; the last follows a gap."""
    runs = np.array([0, 1, 2, 3, 4, 7])
    level = SimpleNamespace(success=0.9, confidence=0.9)
    data: Any = SimpleNamespace(
        campaign=SimpleNamespace(campaign=level),
        in_order=5,
        planned=None,
        runs=runs,
        void=runs == 4,
        kept=runs != 4,
        numbers=lambda name: np.array([1.0, 5.0, 6.0, 7.0, 2.0, 8.0 if bound == "limit" else 0.0]),
    )
    requirement = RequirementSection.model_validate({"metric": "max_alpha_deg", bound: 5.0})
    found = _judged(data, "incidence", requirement)
    assert (found.kind, found.shown.failures, found.shown.runs) == (bound, 3 if bound == "limit" else 2, 5)
    assert [w.run for w in found.worst] == ([7, 3, 2, 1, 0] if bound == "limit" else [7, 0, 1, 2, 3])
    assert _judged(data, "control kept", None).shown.failures == 1


def test_control_is_kept_by_runs_that_neither_lost_it_nor_ended_early() -> None:
    void = np.array([False, False, True, True])
    data: Any = SimpleNamespace(column=lambda name: pa.chunked_array([["", "incidence", "", "rate"]]), void=void)
    assert DataSet.kept.func(data).tolist() == [True, False, False, False]
