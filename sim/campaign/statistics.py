"""Verdicts from a number of flights: tests that allow looking at any time, binomial bounds, order statistics.

A share `success` of all flights must meet a limit, shown with `confidence`. Consider all campaigns of a vehicle that
fails with probability p0 = 1 - success or more. A share of at most 1 - confidence of them may ever be called met
(consumer's risk: Hanson & Beard, NASA/TP-2010-216447). The same share of a vehicle that fails less often may be called
missed. All bounds are one-sided.

The *any-time test* is the default. An e-value is the likelihood of the data under a mixture of failure probabilities on
one side of p0, divided by that at p0. For a vehicle on the other side it is a supermartingale, so it ever exceeds
1/risk with probability at most `risk` (Ville's inequality; Robbins, Ann. Math. Statist. 41, 1970; Howard et al., Ann.
Statist. 49, 2021). Hence the verdict is valid under any rule for looking, stopping or continuing.

The *fixed test* is the exact binomial test at a number of runs recorded before the first is flown. Its size is below
the risk, because failures are whole numbers. A campaign that is continued is judged by the any-time test with the
remaining risk, so that both together stay within the risk (union bound).

The functions are those of scipy.special. scipy.stats takes a second to import, and a campaign needs these functions at
its start.
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
_POWER = 0.5  # exponent in the density of failure probabilities below p0, p^(_POWER - 1): few runs if few fail


def failure_upper(failures: int, runs: int, confidence: float) -> float:
    """Return the upper bound of the probability of failure (Clopper & Pearson, Biometrika 26, 1934)."""
    return 1.0 if failures >= runs else float(betaincinv(failures + 1, runs - failures, confidence))


def failure_lower(failures: int, runs: int, confidence: float) -> float:
    """Return the lower bound of the probability of failure."""
    return 0.0 if failures == 0 else float(betaincinv(failures, runs - failures + 1, 1.0 - confidence))


@lru_cache(maxsize=1024)
def allowed_failures(runs: int, success: float, confidence: float) -> int:
    """Return the most failures with which a fixed test of `runs` shows the requirement to be met.

    It is -1 if not even zero failures do.
    """
    p, risk = 1.0 - success, 1.0 - confidence
    return _least(lambda k: k > runs or bool(bdtr(k, runs, p) > risk), 0) - 1


@dataclass(frozen=True)
class Shown:
    """The evidence of k failures in n runs about a requirement."""

    judgement: Judgement
    runs: int
    failures: int
    success: float  # estimate
    success_least: float  # lower confidence bound, by the test that judges
    success_most: float  # upper confidence bound
    allowed: int  # failures with which it would be met after these runs; -1: too few runs even for none
    more: int  # further runs needed, all of them without failure; 0 if settled
    test: str  # name of the test


ANY_TIME = "any-time test"


@lru_cache(maxsize=4096)
def judge_failures(failures: int, runs: int, success: float, confidence: float, planned: int | None = None) -> Shown:
    """Return the verdict on a requirement; the runs are the first ones in order, without a gap.

    `planned`: the number of runs recorded beforehand, at which the fixed test judges. None selects the any-time test.
    """
    p, risk = 1.0 - success, 1.0 - confidence
    judgement, test, risk_met, risk_missed = OPEN, ANY_TIME, risk, risk
    if planned is not None:
        test, allowed = f"fixed test of {planned} runs", allowed_failures(planned, success, confidence)
        refused = _least(lambda k: k > planned or bool(bdtrc(k - 1, planned, p) <= risk), 1)
        risk_met = max(risk - (float(bdtr(allowed, planned, p)) if allowed >= 0 else 0.0), 1e-300)  # the remaining risk
        risk_missed = max(risk - float(bdtrc(refused - 1, planned, p)), 1e-300)

    def more(least: int) -> int:
        """Return the further runs, `least` or more, after which these failures show the requirement to be met.

        The proof is valid at any time.
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
    """Return the least whole number from `first` on for which a monotone condition holds."""
    step = 1
    while not holds(first + step - 1) and step < _MOST_RUNS:
        step *= 2
    low, high = first + step // 2, first + step - 1
    while low < high:
        middle = (low + high) // 2
        low, high = (low, middle) if holds(middle) else (middle + 1, high)
    return high


def last(holds: Callable[[float], bool], low: float, high: float, halvings: int) -> float:
    """Return the end of a condition that holds at `low`, but not at `high`."""
    for _ in range(halvings):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if holds(middle) else (low, middle)
    return low


def confidence_sequence(failures: int, runs: int, confidence: float) -> tuple[float, float]:
    """Return bounds of the probability of failure, each with `confidence` at all times together.

    The values between the bounds are those that no test rejects.
    """
    needed = -math.log(1.0 - confidence)
    share = failures / runs if runs else 0.0

    def bound(evidence: Callable[[int, int, float], float], end: float) -> float:
        def rejected(p: float) -> bool:
            return evidence(failures, runs, p) >= needed

        return last(rejected, end, share, 45) if runs and rejected(end) else round(end)

    return bound(evidence_missed, 1e-12), bound(evidence_met, 1.0 - 1e-12)


def tolerance_bound(values: Array, allowed: int, largest: bool = True) -> float:
    """Return the (allowed + 1)-th largest of `values`, an order statistic; nan if no failure is allowed.

    With the failures that a test allows (`Shown.allowed`), the share `success` of all flights does not exceed this
    value, with the test's confidence. `largest` False: the value below which this share does not fall. nan counts as
    worst.
    """
    if allowed < 0:
        return math.nan
    worst = np.where(np.isnan(values), np.inf, values if largest else -values)
    found = float(np.partition(worst, len(worst) - 1 - allowed)[len(worst) - 1 - allowed])
    return found if largest else -found


def evidence_met(failures: int, runs: int, p: float) -> float:
    """Return the log of the e-value against "fails with probability p or more".

    The alternative is a mixture of failure probabilities q below p, with a density proportional to q^-0.5.
    """
    k, n = failures, runs
    inside = float(betainc(k + _POWER, n - k + 1, p))
    if inside <= 0.0:
        return -math.inf
    mixture = float(betaln(k + _POWER, n - k + 1)) + math.log(inside)
    return mixture + math.log(_POWER) - _POWER * math.log(p) - _log_likelihood(k, n, p)


def evidence_missed(failures: int, runs: int, p: float) -> float:
    """Return the log of the e-value against "fails with probability p or less"; the mixture is log-uniform above p."""
    k, n = failures, runs
    outside = float(betaincc(k, n - k + 1, p)) if k else 0.0
    if outside <= 0.0:
        return -math.inf
    mixture = float(betaln(k, n - k + 1)) + math.log(outside) - math.log(math.log(1.0 / p))
    return mixture - _log_likelihood(k, n, p)


def _log_likelihood(k: int, n: int, p: float) -> float:
    return k * math.log(p) + (n - k) * math.log1p(-p)
