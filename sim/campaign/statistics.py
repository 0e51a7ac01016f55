"""The verdicts from a number of flights: tests that are valid at any time, binomial bounds, order statistics.

A share `success` of all flights must meet a limit, and this must be shown with `confidence`. For a vehicle that fails
with probability p0 = 1 - success or more, the verdict "met" may occur in at most the share 1 - confidence of all
campaigns (consumer's risk: Hanson & Beard, NASA/TP-2010-216447). For a vehicle that fails less often, the same bound
applies to the verdict "missed". All bounds are one-sided.

The *any-time test* is the default. An e-value is the likelihood of the data under a mixture of failure probabilities on
one side of p0, divided by the likelihood at p0. For a vehicle on the other side, it is a supermartingale. The
probability that it ever exceeds 1/risk is therefore at most `risk` (Ville's inequality; Robbins, Ann. Math. Statist.
41, 1970; Howard et al., Ann. Statist. 49, 2021). The verdict is thus valid under any rule for inspecting, stopping or
continuing a campaign.

The *fixed test* is the exact binomial test at a number of runs recorded before the first run. Its size is below the
risk, because failures are whole numbers. A campaign that is continued is judged by the any-time test with the remaining
risk, so that the total risk of both tests is within the risk (union bound).

The functions are those of scipy.special, because scipy.stats takes a second to import at the start of a campaign.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Literal

import numpy as np
from scipy.special import bdtr, bdtrc, betainc, betaincc, betaincinv, betaln

from maxq.control.kernel.records import Array

Judgement = Literal["met", "missed", "undecided"]
MET: Judgement = "met"
NOT_MET: Judgement = "missed"
OPEN: Judgement = "undecided"
_MOST_RUNS = 1 << 50
_POWER = 0.5  # of the density p^(_POWER - 1) of failure probabilities below p0; few failures then need few runs


def failure_upper(failures: int, runs: int, confidence: float) -> float:
    """Return the one-sided upper bound of the probability of failure (Clopper & Pearson, Biometrika 26, 1934)."""
    return 1.0 if failures >= runs else float(betaincinv(failures + 1, runs - failures, confidence))


def failure_lower(failures: int, runs: int, confidence: float) -> float:
    """Return the one-sided lower bound of the probability of failure (Clopper & Pearson)."""
    return 0.0 if failures == 0 else float(betaincinv(failures, runs - failures + 1, 1.0 - confidence))


@lru_cache(maxsize=1024)
def allowed_failures(runs: int, success: float, confidence: float) -> int:
    """Return the largest number of failures with which a fixed test of `runs` shows the requirement to be met.

    The result is -1 if even a test without failures does not show it.
    """
    p, risk = 1.0 - success, 1.0 - confidence
    return _least(lambda k: k > runs or bool(bdtr(k, runs, p) > risk), 0) - 1


@dataclass(frozen=True)
class Shown:
    """The evidence about a requirement from the number of failures in a number of runs."""

    judgement: Judgement
    runs: int
    failures: int
    success: float  # estimate
    success_least: float  # lower confidence bound of the test in use
    success_most: float  # upper confidence bound of this test
    allowed: int  # largest number of failures with which it would be met after these runs; -1: too few runs
    more: int  # further runs needed if none of them fails; 0 if settled
    test: str  # name of the test


ANY_TIME = "any-time test"


@lru_cache(maxsize=4096)
def judge_failures(failures: int, runs: int, success: float, confidence: float, planned: int | None = None) -> Shown:
    """Return the verdict on a requirement from the failures in the first `runs` runs, without a gap.

    `planned` is the number of runs of the fixed test, recorded beforehand. None selects the any-time test.
    """
    p, risk = 1.0 - success, 1.0 - confidence
    judgement, test, risk_met, risk_missed = OPEN, ANY_TIME, risk, risk
    if planned is not None:
        test, allowed = f"fixed test of {planned} runs", allowed_failures(planned, success, confidence)
        refused = _least(lambda k: k > planned or bool(bdtrc(k - 1, planned, p) <= risk), 1)
        risk_met = max(risk - (float(bdtr(allowed, planned, p)) if allowed >= 0 else 0.0), 1e-300)  # the remaining risk
        risk_missed = max(risk - float(bdtrc(refused - 1, planned, p)), 1e-300)

    def more(least: int) -> int:
        """Return the number of further runs, at least `least`, after which the any-time test is met.

        The further runs are assumed to have no failures.
        """
        needed = -math.log(risk_met)
        return _least(lambda n: evidence_met(failures, n, p) >= needed, max(runs + least, failures, 1)) - runs

    if planned is not None and runs <= planned:
        if runs == planned:
            judgement = MET if failures <= allowed else NOT_MET if failures >= refused else OPEN
        low, high = failure_lower(failures, runs, confidence), failure_upper(failures, runs, confidence)
        further = more(1) if runs == planned and judgement == OPEN else planned - runs
    else:
        if planned is not None:
            test = f"{ANY_TIME} at {100.0 * risk_met:.2g} % risk, which the {test} left"
        if runs and evidence_missed(failures, runs, p) >= -math.log(risk_missed):
            judgement = NOT_MET
        elif runs and evidence_met(failures, runs, p) >= -math.log(risk_met):
            judgement = MET
        low, high = confidence_sequence(failures, runs, confidence)
        allowed = _least(lambda k: k > runs or evidence_met(k, runs, p) < -math.log(risk_met), 0) - 1
        further = more(0) if judgement == OPEN else 0
    estimate = 1.0 - failures / runs if runs else math.nan
    return Shown(judgement, runs, failures, estimate, 1.0 - high, 1.0 - low, allowed, further, test)


def _least(holds: Callable[[int], bool], first: int) -> int:
    """Return the least whole number from `first` on for which the monotone condition `holds` is True."""
    step = 1
    while not holds(first + step - 1) and step < _MOST_RUNS:
        step *= 2
    low, high = first + step // 2, first + step - 1
    while low < high:
        middle = (low + high) // 2
        low, high = (low, middle) if holds(middle) else (middle + 1, high)
    return high


def last(holds: Callable[[float], bool], low: float, high: float, halvings: int) -> float:
    """Return the largest value, by bisection, of a condition that holds at `low` but not at `high`."""
    for _ in range(halvings):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if holds(middle) else (low, middle)
    return low


def confidence_sequence(failures: int, runs: int, confidence: float) -> tuple[float, float]:
    """Return the lower and upper bound of the probability of failure.

    Each has `confidence` at all times simultaneously. Values between the bounds are not rejected by the any-time test.
    """
    needed = -math.log(1.0 - confidence)
    share = failures / runs if runs else 0.0

    def bound(evidence: Callable[[int, int, float], float], end: float) -> float:
        def rejected(p: float) -> bool:
            return evidence(failures, runs, p) >= needed

        return last(rejected, end, share, 45) if runs and rejected(end) else round(end)

    return bound(evidence_missed, 1e-12), bound(evidence_met, 1.0 - 1e-12)


def tolerance_bound(values: Array, allowed: int, largest: bool = True) -> float:
    """Return the (allowed + 1)-th largest of `values` (runs,), an order statistic; nan if `allowed` is negative.

    If `allowed` is the number of failures that a test allows (`Shown.allowed`), the share `success` of all flights does
    not exceed the result, with the confidence of the test. With `largest` False, the result is the value below which
    this share does not fall. nan is regarded as the worst value.
    """
    if allowed < 0:
        return math.nan
    worst = np.where(np.isnan(values), np.inf, values if largest else -values)
    found = float(np.partition(worst, len(worst) - 1 - allowed)[len(worst) - 1 - allowed])
    return found if largest else -found


def evidence_met(failures: int, runs: int, p: float) -> float:
    """Return the logarithm of the e-value against the hypothesis of a failure probability of `p` or more.

    The alternative is a mixture of failure probabilities q below `p` with a density proportional to q^-0.5.
    """
    k, n = failures, runs
    inside = float(betainc(k + _POWER, n - k + 1, p))
    if inside <= 0.0:
        return -math.inf
    mixture = float(betaln(k + _POWER, n - k + 1)) + math.log(inside)
    return mixture + math.log(_POWER) - _POWER * math.log(p) - _log_likelihood(k, n, p)


def evidence_missed(failures: int, runs: int, p: float) -> float:
    """Return the logarithm of the e-value against the hypothesis of a failure probability of `p` or less.

    The alternative is a log-uniform mixture of failure probabilities above `p`.
    """
    k, n = failures, runs
    outside = float(betaincc(k, n - k + 1, p)) if k else 0.0
    if outside <= 0.0:
        return -math.inf
    mixture = float(betaln(k, n - k + 1)) + math.log(outside) - math.log(math.log(1.0 / p))
    return mixture - _log_likelihood(k, n, p)


def _log_likelihood(k: int, n: int, p: float) -> float:
    return k * math.log(p) + (n - k) * math.log1p(-p)
