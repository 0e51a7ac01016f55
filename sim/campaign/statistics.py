"""Exact verdicts from a number of flights: binomial confidence bounds and order statistics.

A requirement asks that a share `success` of all flights meets a limit, shown with `confidence`. With n flights of which
k failed, it is shown to be met when flights that fail with probability 1 - success would give k failures or fewer in at
most 1 - confidence of all campaigns (consumer's risk: Hanson & Beard, NASA/TP-2010-216447). All bounds are one-sided.

The functions are those of scipy.special: scipy.stats takes a second to import, and a campaign needs these at its start.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Literal

import numpy as np
from scipy.special import bdtr, bdtrik, bdtrin, betainc, betaincc, betaincinv, betaln

from maxq.control.kernel.records import Array

Judgement = Literal["met", "not met", "not yet enough runs"]
MET: Judgement = "met"
NOT_MET: Judgement = "not met"
OPEN: Judgement = "not yet enough runs"


def failure_upper(failures: int, runs: int, confidence: float) -> float:
    """Upper bound of the probability of failure (Clopper & Pearson, Biometrika 26, 1934)."""
    return 1.0 if failures >= runs else float(betaincinv(failures + 1, runs - failures, confidence))


def failure_lower(failures: int, runs: int, confidence: float) -> float:
    """Lower bound of the probability of failure."""
    return 0.0 if failures == 0 else float(betaincinv(failures, runs - failures + 1, 1.0 - confidence))


@lru_cache(maxsize=1024)
def runs_for(failures: int, success: float, confidence: float) -> int:
    """Least number of runs with which `failures` of them still show that the requirement is met."""
    runs = max(math.ceil(bdtrin(failures, 1.0 - confidence, 1.0 - success)), failures + 1)
    while _shown(failures, runs - 1, success, confidence):  # the inverse may be a rounding error off
        runs -= 1
    while not _shown(failures, runs, success, confidence):
        runs += 1
    return runs


def allowed_failures(runs: int, success: float, confidence: float) -> int:
    """Most failures in `runs` with which the requirement is shown to be met; -1: not even with none."""
    if not runs or not _shown(0, runs, success, confidence):
        return -1
    allowed = max(math.floor(bdtrik(1.0 - confidence, runs, 1.0 - success)), 0)
    while not _shown(allowed, runs, success, confidence):  # as above
        allowed -= 1
    while _shown(allowed + 1, runs, success, confidence):
        allowed += 1
    return allowed


def _shown(failures: int, runs: int, success: float, confidence: float) -> bool:
    return bool(bdtr(failures, runs, 1.0 - success) <= 1.0 - confidence)


@dataclass(frozen=True)
class Shown:
    """What k failures in n runs say about a requirement."""

    judgement: Judgement
    runs: int
    failures: int
    success: float  # estimate
    success_least: float  # lower confidence bound
    success_most: float  # upper confidence bound
    allowed: int  # failures with which it would be met; -1: too few runs for any
    more: int  # further runs needed, all of them without failure; 0 where it is settled


def judge_failures(failures: int, runs: int, success: float, confidence: float) -> Shown:
    """Verdict on a requirement after a number of runs that was fixed beforehand."""
    if runs == 0:
        return Shown(OPEN, 0, 0, math.nan, 0.0, 1.0, -1, runs_for(0, success, confidence))
    upper, lower = failure_upper(failures, runs, confidence), failure_lower(failures, runs, confidence)
    judgement: Judgement = OPEN
    more = 0
    if _shown(failures, runs, success, confidence):
        judgement = MET
    elif lower > 1.0 - success:
        judgement = NOT_MET
    else:
        more = runs_for(failures, success, confidence) - runs
    allowed = allowed_failures(runs, success, confidence)
    return Shown(judgement, runs, failures, 1.0 - failures / runs, 1.0 - upper, 1.0 - lower, allowed, more)


def tolerance_bound(values: Array, success: float, confidence: float, largest: bool = True) -> float:
    """Value that a share `success` of all flights does not exceed, with `confidence`: an order statistic.

    With k allowed failures it is the (k + 1)-th largest value; nan where there are too few. `largest` False: the value
    that they do not fall short of. nan among the values counts as worst.
    """
    k = allowed_failures(len(values), success, confidence)
    if k < 0:
        return math.nan
    worst = np.where(np.isnan(values), np.inf, values if largest else -values)
    found = float(np.partition(worst, len(worst) - 1 - k)[len(worst) - 1 - k])
    return found if largest else -found


def evidence_met(failures: int, runs: int, success: float) -> float:
    """log of an e-value against "fails too often": a mixture of likelihood ratios, at any number of runs.

    Under a probability of failure p >= p0 = 1 - success the mixture over p uniform below p0 is a supermartingale, so it
    ever exceeds 1/(1 - confidence) with probability at most 1 - confidence (Ville): one may look after every run.
    """
    p, k, n = 1.0 - success, failures, runs
    inside = float(betainc(k + 1, n - k + 1, p))
    if inside <= 0.0:
        return -math.inf
    mixture = float(betaln(k + 1, n - k + 1)) + math.log(inside) - math.log(p)
    return mixture - _log_likelihood(k, n, p)


def evidence_missed(failures: int, runs: int, success: float) -> float:
    """log of an e-value against "fails rarely enough"; the mixture is log-uniform over p above p0."""
    p, k, n = 1.0 - success, failures, runs
    if k == 0:
        return -math.inf
    outside = float(betaincc(k, n - k + 1, p))
    if outside <= 0.0:
        return -math.inf
    mixture = float(betaln(k, n - k + 1)) + math.log(outside) - math.log(math.log(1.0 / p))
    return mixture - _log_likelihood(k, n, p)


def judge_any_time(failures: int, runs: int, success: float, confidence: float) -> Judgement:
    """Verdict that stays true however often one looks: what a sequential campaign stops at.

    It asks for more runs than a number fixed beforehand: 1337 instead of 852 without failure for 99.73 % at 90 %.
    """
    needed = -math.log(1.0 - confidence)
    if evidence_met(failures, runs, success) >= needed:
        return MET
    return NOT_MET if evidence_missed(failures, runs, success) >= needed else OPEN


def _log_likelihood(k: int, n: int, p: float) -> float:
    return k * math.log(p) + (n - k) * math.log1p(-p)
