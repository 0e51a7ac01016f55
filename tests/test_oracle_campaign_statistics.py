"""Bounds and run counts against sums of the binomial distribution, published numbers and simulation."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy import stats

from maxq.sim.campaign import statistics as s
from maxq.sim.campaign.draws import box, chosen, correlated, quantile
from maxq.sim.campaign.schema import Disperse


@pytest.mark.parametrize(
    ("success", "runs"), [(0.9973, [852, 1440, 1970, 2473, 2959]), (0.99865, [1705, 2880, 3941, 4947])]
)
def test_runs_that_show_it_with_k_failures(success: float, runs: list[int]) -> None:
    """The table of shared/design/practice.md (Hanson & Beard, NASA/TP-2010-216447), 90 % confidence."""
    assert [s.runs_for(k, success, 0.9) for k in range(len(runs))] == runs
    for k, n in enumerate(runs):
        assert s.allowed_failures(n, success, 0.9) == k
        assert s.allowed_failures(n - 1, success, 0.9) == k - 1
        assert s.judge_failures(k, n, success, 0.9).judgement == s.MET
        assert s.judge_failures(k, n - 1, success, 0.9).more == 1


def test_two_thousand_runs() -> None:
    assert s.allowed_failures(2000, 0.9973, 0.9) == 2
    assert s.allowed_failures(2000, 0.99865, 0.9) == 0


@pytest.mark.parametrize(("k", "n"), [(0, 10), (3, 50), (10, 10), (7, 2000)])
def test_bounds_are_where_the_binomial_tails_are(k: int, n: int) -> None:
    """Sums of probabilities, term by term."""

    def at_most(count: int, p: float) -> float:
        return math.fsum(math.comb(n, i) * p**i * (1 - p) ** (n - i) for i in range(count + 1))

    upper, lower = s.failure_upper(k, n, 0.9), s.failure_lower(k, n, 0.9)
    assert upper == 1.0 if k == n else at_most(k, upper) == pytest.approx(0.1, rel=1e-9)
    assert lower == 0.0 if k == 0 else 1.0 - at_most(k - 1, lower) == pytest.approx(0.1, rel=1e-7)


def test_judgements() -> None:
    assert s.judge_failures(0, 0, 0.9973, 0.9).judgement == s.OPEN
    assert s.judge_failures(0, 0, 0.9973, 0.9).more == 852
    assert s.judge_failures(0, 1, 0.9973, 0.9).more == 851
    assert s.judge_failures(30, 2000, 0.9973, 0.9).judgement == s.NOT_MET
    assert s.judge_failures(1, 1, 0.5, 0.9).judgement == s.OPEN


def test_the_order_statistic_covers_the_quantile_as_often_as_it_says() -> None:
    rng = np.random.default_rng(1)
    covered = [s.tolerance_bound(rng.random(300), 0.95, 0.9) >= 0.95 for _ in range(4000)]
    # exactly 1 - P(X > k), X binomial: at least 0.9; four standard deviations of 4000 trials are 0.02
    exact = 1.0 - stats.binom.cdf(s.allowed_failures(300, 0.95, 0.9), 300, 0.05)
    assert exact >= 0.9
    assert np.mean(covered) == pytest.approx(exact, abs=0.02)


def test_the_order_statistic_agrees_with_the_verdict() -> None:
    """The bound lies within the limit exactly when no more fail than are allowed."""
    rng = np.random.default_rng(2)
    for _ in range(50):
        values = rng.normal(size=2000)
        limit = np.sort(values)[-int(rng.integers(1, 8))]
        failures = int((values > limit).sum())
        met = s.judge_failures(failures, 2000, 0.9973, 0.9).judgement == s.MET
        assert (s.tolerance_bound(values, 0.9973, 0.9) <= limit) == met
    assert math.isnan(s.tolerance_bound(np.zeros(851), 0.9973, 0.9))
    assert s.tolerance_bound(np.array([math.nan] + [1.0] * 851), 0.9973, 0.9) == math.inf
    assert s.tolerance_bound(np.arange(852.0), 0.9973, 0.9, largest=False) == 0.0


def test_looking_at_any_time_keeps_the_risk() -> None:
    """Campaigns of a vehicle that just misses: at most 10 % are ever called met, where the fixed-size test fails."""
    rng = np.random.default_rng(3)
    success, looks = 0.95, range(10, 1500, 10)
    wrong_any, wrong_fixed = 0, 0
    for _ in range(200):
        failures = np.cumsum(rng.random(1500) < 0.05)
        counts = [(int(failures[n - 1]), n) for n in looks]
        wrong_any += any(s.judge_any_time(k, n, success, 0.9) == s.MET for k, n in counts)
        wrong_fixed += any(s.allowed_failures(n, success, 0.9) >= k for k, n in counts)
    assert wrong_any / 200 <= 0.1
    assert wrong_fixed / 200 > 0.15


def test_any_time_verdicts_come() -> None:
    assert s.judge_any_time(0, 1336, 0.9973, 0.9) == s.OPEN
    assert s.judge_any_time(0, 1337, 0.9973, 0.9) == s.MET
    assert s.judge_any_time(6, 60, 0.9973, 0.9) == s.NOT_MET


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
