"""Launch availability by month agrees with SciPy's bounds, dates of soundings, winds of the months and verdicts."""

from __future__ import annotations

import json
from pathlib import Path

import campaignkit
import numpy as np
import petrelkit
import pytest
from scipy.stats import binomtest

import maxq
from maxq import DataSet, ScenarioError
from maxq.design.verify.flown import CampaignResult, campaign_requirements
from maxq.sim.campaign.availability import Month, availability, clopper_pearson
from maxq.sim.campaign.runner import run_campaign
from maxq.sim.scenario.loader import load_scenario, load_scenario_text
from maxq.tools.campaign_report import report, write_report


@pytest.mark.parametrize(("successes", "runs"), [(0, 7), (7, 7), (88, 100), (1, 30)])
def test_bounds_are_scipys(successes: int, runs: int) -> None:
    least, most = binomtest(successes, runs).proportion_ci(0.9, method="exact")
    assert clopper_pearson(successes, runs, 0.9) == pytest.approx((least, most), abs=1e-12)


IGRA = """\
#KSM00047138 2002 11 28 12 1130    2 ncdc-gts           361000  1293700
21 -9999 102200B    6B   36A-9999    44   250    20
10 -9999  25000 10390B -527A-9999 -9999   275   525
#KSM00047138 2003 07 01 99 1130    2 ncdc-gts           361000  1293700
21 -9999 102200B    6B   36A-9999    44   250    20
10 -9999  25000 10390B -527A-9999 -9999   275   125
"""
WYOMING = """\
<H2>47138 Pohang Observations at 00Z 28 Nov 2002</H2>
   PRES   HGHT   DRCT   SKNT
    hPa     m    deg   knot
 1022.0      6    250      4
  250.0  10390    275    102
<H2>47138 Pohang Observations at 12Z 03 Mar 2003</H2>
   PRES   HGHT   DRCT   SKNT
    hPa     m    deg   knot
 1022.0      6    250      4
  250.0  10390    275     52
"""
TIMED = """\
time,height_m,wind direction_degree,wind speed_m/s
2004-02-29 00:00:01,10,250,4
2004-02-29 00:20:00,9000,275,30
"""
PLAIN = "# a windy day\n# date: 2002-01-15\naltitude_m,speed_mps,from_deg\n0,4,250\n9000,30,275\n"


@pytest.mark.slow
def test_soundings_keep_their_dates(tmp_path: Path) -> None:
    wanted = {
        "igra.txt#1": "2002-11-28T12",
        "igra.txt#2": "2003-07-01",
        "wyoming.txt#1": "2002-11-28T00",
        "wyoming.txt#2": "2003-03-03T12",
        "timed.csv": "2004-02-29T00",
        "plain.csv": "2002-01-15",
        "none.csv": "",
    }
    texts = {
        "igra.txt": IGRA,
        "wyoming.txt": WYOMING,
        "timed.csv": TIMED,
        "plain.csv": PLAIN,
        "none.csv": PLAIN.replace("# date", "# day"),
    }
    for name, text in texts.items():
        (tmp_path / name).write_text(text)
    for name, date in wanted.items():
        loaded = load_scenario("nominal", [f"wind.profile={tmp_path / name}"])
        profile = loaded.scenario.wind.profile
        assert profile is not None
        assert profile.date == date, name
        again = load_scenario_text(loaded.as_flown).scenario.wind.profile
        assert again is not None
        assert again.date == date
    with pytest.raises(ScenarioError, match="is not a date"):
        load_scenario("nominal", ["wind.profile={date='2002-13-01',altitude_m=[0],north_mps=[0],east_mps=[0]}"])


DATED = """\
# date: {}
altitude_m,north_mps,east_mps
0,{speed},0
50000,{speed},0
"""
WIND = '[[requirement]]\nmetric = "max_powered_dynamic_pressure_Pa"\nlimit = 150.0\n[wind_model]\n'


def test_share_of_flights_that_meet_all_limits_by_the_month_of_their_sounding(tmp_path: Path) -> None:
    """Shares are counted by month of the sounding: two Januaries, a July and an undated day.

    At release in 30 m/s the 550 Pa limit is met, in 1 m/s hardly ever.
    """
    for n, (date, speed) in enumerate((("2001-01-02", 30), ("2002-01-09", 1), ("2002-07-01", 1), ("unknown", 30))):
        (tmp_path / f"{n}.csv").write_text(DATED.format(date, speed=speed))
    names = json.dumps([str(tmp_path / f"{n}.csv") for n in range(4)])
    wind = f'{WIND}model = "ensemble"\norder = "in-turn"\nprofiles = {names}\n'
    campaign = campaignkit.small(tmp_path, "days", runs=16, inputs=wind)
    folder = tmp_path / "out"
    run_campaign(campaign, folder)
    data = DataSet(folder, campaign, 16)
    assert data.column("wind.date").to_pylist()[:4] == ["2001-01-02", "2002-01-09", "2002-07-01", ""]
    january, july = availability(data)
    assert (january.name, january.runs, january.missed, january.first_missed) == ("Jan", 8, 4, 0)
    assert (july.name, july.runs, july.missed, july.first_missed) == ("Jul", 4, 0, None)
    assert (january.least, january.most) == clopper_pearson(4, 8, campaign.campaign.confidence)
    lines = report(data, [], [])
    assert any("launch availability by month" in line for line in lines)
    assert any(line.split()[:4] == ["Jan", "8", "50.0", "%"] for line in lines)
    write_report(data, [], [], 16)
    told = json.loads((folder / "summary.json").read_text())["availability"]
    assert [(m["month"], m["missed"], m["share"]) for m in told] == [(1, 4, 0.5), (7, 0, 1.0)]
    assert "Launch availability by month" in (folder / "report.html").read_text()


MONTHS = """\
[wind]
profile = {{altitude_m = [0.0, 20000.0], north_mps = [4.0, 40.0], east_mps = [0.0, 20.0]}}
[wind_model]
model = "vector"
table = "winds/anheung-november-dispersion.csv"
correlation_length_m = 6000.0
{}
"""


@pytest.mark.parametrize("vehicle", ["ksr3", pytest.param("petrel", marks=pytest.mark.slow)])
def test_winds_of_a_month_are_the_mean_and_the_deviations_times_its_factors(tmp_path: Path, vehicle: str) -> None:
    """Winds of a month are its mean plus the deviations times its factors, for the draws of runs without months.

    Twelve months follow in turn, whatever the first run.
    """
    factors = "months = {month = [1, 7], mean_factor = [2.0, 0.5], sigma_factor = [1.5, 0.0]}"
    plans = []
    for name, more in (("plain", ""), ("months", factors)):
        if vehicle == "ksr3":
            plans.append(campaignkit.small(tmp_path, name, inputs=MONTHS.format(more)).plan.wind)
        else:
            path = tmp_path / f"{name}.toml"
            path.write_text(f'schema = 1\nextends = "{petrelkit.folder()}/campaign.toml"\n{MONTHS.format(more)}')
            plans.append(maxq.load(path).plan.wind)
    plain, months = plans
    assert plain is not None
    assert months is not None
    before, after = plain.scores(5, 3, 6), months.scores(5, 3, 6)
    assert [months.recorded(one)["wind.month"] for one in after] == [7.0, 1.0] * 3
    mean = plain.profile(0.0 * before[0])
    for k, (one, other) in enumerate(zip(before, after, strict=True)):
        by_mean, by_sigma = ((0.5, 0.0), (2.0, 1.5))[k % 2]
        for axis in ("north_mps", "east_mps"):
            wanted = by_mean * mean[axis] + by_sigma * (plain.profile(one)[axis] - mean[axis])
            np.testing.assert_allclose(months.profile(other)[axis], wanted, atol=1e-12)
    with pytest.raises(ScenarioError, match="is not a month"):
        campaignkit.small(tmp_path, "bad", inputs=MONTHS.format(factors.replace("[1, 7]", "[1, 7.5]")))


def test_shipped_months_go_through_the_two_that_are_assumed() -> None:
    months = maxq.load("campaigns/ksr3-months").file.wind_model
    assert months is not None
    assert months.months is not None
    table = months.months
    assert (table["mean_factor"][8], table["sigma_factor"][8]) == (0.5, 0.8)
    assert (table["mean_factor"][10], table["sigma_factor"][10]) == (1.0, 1.0)
    phase = np.cos(2.0 * np.pi * (table["month"] - 1.0) / 12.0)
    np.testing.assert_allclose(table["mean_factor"], 0.75 + 0.5 * phase, atol=0.005)
    np.testing.assert_allclose(table["sigma_factor"], 0.9 + 0.2 * phase, atol=0.005)


def test_a_suite_judges_each_month_by_its_availability() -> None:
    """At 90 % with 90 % confidence, 45 flights without a miss are enough, 20 undecided, 30 misses in 60 too many."""
    counts = ((1, 60, 30, 4), (6, 20, 0, None), (7, 45, 0, None))
    months = tuple(Month(m, n, k, *clopper_pearson(n - k, n, 0.9), 0.9, run) for m, n, k, run in counts)
    none = Path("runs")
    result = CampaignResult("days", "f", none, 125, False, 0.9973, 0.9, (), "", None, months, 0.9, True)
    january, june, july = campaign_requirements(result)
    assert [r.judgement for r in (january, june, july)] == ["rejected", "undecided", "accepted"]
    assert (january.again, july.again) == ("simrun refly runs --run 4", "")
    assert january.found.startswith("50.0 % of 60 flights (38.")
    assert "Jan" in january.name
    (nothing,) = campaign_requirements(CampaignResult("d", "f", none, 9, False, 0.9, 0.9, (), "", None, (), 0.9))
    assert nothing.judgement == "undecided"
