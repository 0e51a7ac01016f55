"""The joint share of flights that meet all requirements has the right count and verdict, and settles a campaign."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy import stats

from maxq.design.verify.suite import ACCEPTED, REJECTED, overall
from maxq.sim.campaign.analysis import judged, tightest_first
from maxq.sim.campaign.runner import Interim
from maxq.tools.campaign_report import headline, next_step
from maxq.tools.dev.verification.error_rates import SUCCESS, TEN, lacking, missed_alone, settled
from maxq.tools.dev.verification.false_verdicts import Formula, campaign, judged_runs

P = 1.0 - SUCCESS


def flown(seed: int, runs: int, each: float) -> Formula:
    """Return runs that miss each of ten limits with a probability, no two in the same run."""
    loaded = campaign(TEN, 0.0).with_campaign(runs=runs, success=SUCCESS)
    return Formula(loaded, missed_alone(np.random.default_rng(seed).random(runs), each, TEN))


def test_ten_requirements_at_half_the_allowed_rate_are_not_accepted() -> None:
    """Each requirement is met in 40,000 runs, while one flight in 74 misses one, five times the allowed rate."""
    for seed in range(4):
        data = flown(seed, 40_000, 0.5 * P)
        *each, joint = judged_runs(data)
        assert [row.judgement for row in each] == [ACCEPTED] * 11
        assert (joint.name, joint.judgement, overall([*each, joint])) == (": all requirements", REJECTED, REJECTED)
        failures = int((~data.passed).sum())
        assert failures / 40_000 == pytest.approx(5.0 * P, abs=4.0 * math.sqrt(5.0 * P / 40_000))
        assert joint.found == f"{failures} of 40000 failed"
        assert joint.where == f"run {np.flatnonzero(~data.passed)[0]}"
    assert settled((0,), 0.5 * P, TEN) == REJECTED  # by the runs that the verdicts state


def test_a_vehicle_at_a_tenth_of_the_allowed_rate_in_all_is_accepted() -> None:
    found = [settled((seed,), 0.01 * P, TEN) for seed in range(10)]
    assert found == [ACCEPTED] * 10


def test_the_joint_row_counts_each_run_once() -> None:
    """Three runs miss a limit, one of them two limits; the bounds are those of three failures."""
    values = {name: np.full(1000, -1.0) for name in TEN}
    for run, *missed in ((3, 0), (40, 1, 2), (41, 2)):
        for k in missed:
            values[TEN[k]][run] = 1.0
    data = Formula(campaign(TEN, 0.0).with_campaign(runs=1000, success=0.99), values)
    verdicts = judged(data)
    joint = verdicts[-1]
    assert joint.joint
    assert [v.joint for v in verdicts] == [False] * 11 + [True]
    assert (joint.shown.failures, joint.shown.runs, joint.first_missed) == (3, 1000, 3)
    assert [v.shown.failures for v in verdicts[:5]] == [0, 1, 1, 2, 0]
    assert [v.first_missed for v in verdicts[:5]] == [None, 3, 40, 40, None]
    assert joint.shown.success_least < float(stats.beta.ppf(0.1, 997, 4)) < 0.997  # of one look: less wide
    assert len(judged(Formula(campaign((TEN[0],), 0.0), {TEN[0]: np.zeros(5)}))) == 3


def test_the_last_line_names_all_together_where_no_requirement_is_missed_alone() -> None:
    data = flown(0, 40_000, 0.5 * P)
    verdicts = judged(data)
    failures = int((~data.passed).sum())
    assert tightest_first(verdicts)[0].joint
    assert headline(data, verdicts) == (
        f"MISSED: all requirements together: missed in {failures} of 40000 runs; "
        "required in 99.73 % of flights with 90 % confidence; 11 of 11 requirements met"
    )
    assert next_step(data, verdicts).endswith(f" --run {np.flatnonzero(~data.passed)[0]}")
    values = missed_alone(np.random.default_rng(0).random(4000), 4.0 * P, TEN)
    loaded = campaign(TEN, 1.0).with_campaign(runs=4000, success=SUCCESS)
    worse = Formula(loaded, {name: 1.0 + value for name, value in values.items()})  # 2 where 1 is allowed
    first, *rest = tightest_first(judged(worse))
    assert (first.joint, first.shown.judgement) == (False, "missed")  # the cause comes before its consequence
    assert [v.joint for v in rest].index(True) == sum(v.shown.failures > 0 for v in rest) - 1


def test_a_campaign_is_settled_only_with_the_joint_verdict() -> None:
    """With ten misses of each of two limits in 600 runs, both are met at 95 %, but not both together (20 misses)."""
    loaded = campaign(TEN[:2], 0.0).with_campaign(runs=600, success=0.95)
    for both, settled_now in ((False, False), (True, True)):  # in other runs, in the same
        interim = Interim(loaded)
        for run in range(600):
            missed = [run % 60 == 7, run % 60 == (7 if both else 37)]
            metrics = dict(zip(TEN[:2], np.where(missed, 1.0, -1.0).tolist(), strict=True))
            interim.add(run, "burnout", not any(missed), "", metrics)
        assert [t.failures_in_order for t in interim.tallies] == [0, 10, 10]
        assert interim.settled() is settled_now


def test_the_ledger_permits_one_seed() -> None:
    assert [bool(lacks) for lacks in lacking(5)] == [False, True, True, True, True]
