"""Indices equal those of known functions, and planted causes of failures are found."""

from __future__ import annotations

import importlib
import json
import math
import re
from pathlib import Path

import campaignkit
import numpy as np
import pytest
from scipy import integrate, stats

import maxq
from maxq import CampaignError, DataSet, Flight, LoadedScenario
from maxq.sim.campaign import investigation
from maxq.sim.campaign.analysis import bands, borgonovo, failed_runs, first_order, judged, rank_correlation, selected
from maxq.sim.campaign.investigation import search_worst, shrink_run
from maxq.sim.campaign.runner import run_campaign
from maxq.sim.run.fly import fly
from maxq.sim.scenario.loader import load_scenario
from maxq.tools import simrun
from maxq.tools.campaign_report import how_judged


def test_first_order_indices_of_ishigamis_function() -> None:
    """With a = 7 and b = 0.1 the indices are 0.3139, 0.4424, 0 (Saltelli et al., Sensitivity Analysis, 2000)."""
    rng = np.random.default_rng(1)
    x = rng.uniform(-math.pi, math.pi, (20_000, 3))
    y = np.sin(x[:, 0]) + 7.0 * np.sin(x[:, 1]) ** 2 + 0.1 * x[:, 2] ** 4 * np.sin(x[:, 0])
    found = [first_order(x[:, i], y) for i in range(3)]
    # within one of 27 classes the function varies on: a percent of its variance; sampling adds about a percent
    assert found == pytest.approx([0.3139, 0.4424, 0.0], abs=0.02)


def test_first_order_indices_of_sobols_g_function() -> None:
    """Input i has the variance V = 1 / (3 (1 + a_i)^2); the total is the product of 1 + V, minus 1 (Sobol', 1993)."""
    a = np.array([0.0, 1.0, 4.5, 9.0, 99.0])
    x = np.random.default_rng(5).random((20_000, len(a)))
    y = np.prod((np.abs(4.0 * x - 2.0) + a) / (1.0 + a), axis=1)
    parts = 1.0 / (3.0 * (1.0 + a) ** 2)
    exact = parts / (np.prod(1.0 + parts) - 1.0)
    found = [first_order(x[:, i], y) for i in range(len(a))]
    assert found == pytest.approx(exact, abs=0.01)


def test_indices_of_a_linear_function_of_normal_inputs() -> None:
    """The first-order index is the square of the correlation r, the rank correlation 6/pi asin(r/2) (Pearson, 1907)."""
    weights = np.array([3.0, -2.0, 1.0, 0.0])
    x = np.random.default_rng(6).normal(size=(20_000, 4))
    y, r = x @ weights, weights / np.linalg.norm(weights)
    assert [first_order(x[:, i], y) for i in range(4)] == pytest.approx(r**2, abs=0.015)
    ranks = [rank_correlation(x[:, i], y) for i in range(4)]
    assert ranks == pytest.approx(6.0 / math.pi * np.arcsin(0.5 * r), abs=0.02)


def test_rank_correlation_is_scipys_with_ties() -> None:
    rng = np.random.default_rng(2)
    for _ in range(20):
        x, y = np.round(rng.normal(size=200), 1), np.round(rng.normal(size=200), 1)
        assert rank_correlation(x, y) == pytest.approx(stats.spearmanr(x, y).statistic, rel=1e-12)
    assert rank_correlation(np.ones(10), np.arange(10.0)) == 0.0


def test_borgonovos_delta_of_a_sum_of_normal_inputs() -> None:
    """For y = 2 a + b, delta is the distance of the conditional from the unconditional normal law."""
    rng = np.random.default_rng(3)
    a, b, c = rng.normal(size=(3, 40_000))
    y = 2.0 * a + b

    def exact(weight: float, rest: float) -> float:
        grid = np.linspace(-12.0, 12.0, 2001)
        whole = stats.norm.pdf(grid, 0.0, math.hypot(weight, rest))

        def inner(x: float) -> float:
            gap = np.abs(whole - stats.norm.pdf(grid, weight * x, rest))
            return float(stats.norm.pdf(x) * 0.5 * integrate.trapezoid(gap, grid))

        return float(integrate.quad(inner, -6.0, 6.0, limit=200, epsabs=1e-4)[0])

    # classes of 34 and as many bins see a little less of the distance than densities at a point do
    assert borgonovo(a, y) == pytest.approx(exact(2.0, 1.0), abs=0.04)
    assert borgonovo(b, y) == pytest.approx(exact(1.0, 2.0), abs=0.04)
    assert borgonovo(c, y) < 0.01


def test_first_order_index_of_a_switch_that_is_mostly_off() -> None:
    """With most values at the minimum, one quantile class is empty; Var(E[y|x]) = 9 p (1 - p), and the rest is 1."""
    rng = np.random.default_rng(8)
    on = (rng.random(20_000) < 0.3).astype(float)
    y = 3.0 * on + rng.normal(size=len(on))
    between = 9.0 * 0.3 * 0.7
    assert first_order(on, y) == pytest.approx(between / (between + 1.0), abs=0.02)


def test_delta_sees_what_widens_only() -> None:
    rng = np.random.default_rng(4)
    x, z = rng.normal(size=(2, 5000))
    y = np.exp(x) * z
    assert abs(rank_correlation(x, y)) < 0.05
    assert first_order(x, y) < 0.05
    assert borgonovo(x, y) > 0.15


FAILING = """\
[[requirement]]
name = "turning"
metric = "max_attitude_error_deg"
limit = 1e-3
"""
PAIR = """\
[[injection]]
at = "body_torque"
axis = "y"
kind = "step"
amplitude_Nm = 0.0
start_s = 0.15
[[injection]]
at = "body_torque"
axis = "z"
kind = "step"
amplitude_Nm = 0.0
start_s = 0.15
"""
TORQUES = """\
[[disperse]]
key = "injection.0.amplitude_Nm"
distribution = "choice"
values = [3e3]
[[disperse]]
key = "injection.1.amplitude_Nm"
distribution = "uniform"
low = -1.0
high = 1.0
"""


@pytest.mark.slow
def test_shrinking_finds_the_torque_that_was_put_in(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    text = campaignkit.campaign_text(rest=PAIR + FAILING, inputs=campaignkit.INPUTS + TORQUES)
    (tmp_path / "pair.toml").write_text(text.replace('unset = ["requirement"]\n', ""))
    campaign = maxq.load(tmp_path / "pair.toml")
    counted: list[LoadedScenario] = []
    fly_one = investigation.fly_scenario

    def counting(scenario: LoadedScenario) -> Flight:
        counted.append(scenario)
        return fly_one(scenario)

    with monkeypatch.context() as patched:
        patched.setattr(investigation, "fly_scenario", counting)
        found = [shrink_run(campaign, 3, "turning")]
    assert found[0] is not None
    assert found[0].flights == len(counted)
    found.append(shrink_run(campaign, 3, "turning", workers=3))
    for shrunk in found:
        assert shrunk is not None
        assert shrunk.inputs == ("injection.0.amplitude_Nm",)
        assert not fly(shrunk.scenario, log=False).passed
    run_campaign(campaign.with_campaign(runs=4), tmp_path / "out")
    assert failed_runs(DataSet(tmp_path / "out", campaign)) == [0, 1, 2, 3]
    assert simrun.main(["--from", str(tmp_path / "out"), "--run", "3", "--shrink"]) == 1
    printed = capsys.readouterr().out
    assert "1 of 9 dispersions are enough" in printed
    again = load_scenario(tmp_path / "out" / "shrunk" / "run-000003.toml")
    assert again.scenario.injection[0].amplitude == 3e3
    assert again.scenario.injection[1].amplitude == 0.0


def test_shrinking_what_does_not_fail(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    campaign = campaignkit.small(tmp_path, runs=1)
    run_campaign(campaign, tmp_path / "out")
    assert simrun.main(["--from", str(tmp_path / "out"), "--run", "0", "--shrink"]) == 0
    assert "does not fail" in capsys.readouterr().out


@pytest.mark.slow
def test_a_search_begins_all_over_the_box() -> None:
    """The start is a Latin hypercube: each equal cell of an input contains one member."""
    bounds = np.array([[-2.0, 6.0], [10.0, 11.0]])
    first = investigation._first(bounds, 16)
    cells = np.floor(16.0 * (first - bounds[:, 0]) / (bounds[:, 1] - bounds[:, 0])).astype(int)
    assert [sorted(column) for column in cells.T.tolist()] == [list(range(16))] * 2


@pytest.mark.long
def test_the_search_goes_into_the_worst_corner(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Thrust over mass depends on the thrust factor alone, so the worst corner is 3 sigma up."""
    campaign = campaignkit.small(tmp_path, runs=8)
    found = [search_worst(campaign, "max_thrust_over_weight_g", flights=250, workers=w) for w in (1, 2)]
    assert found[0].draws == found[1].draws
    assert found[0].draws["vehicle.stage.0.engine.thrust_factor"] == pytest.approx(1.03, abs=4e-3)
    run_campaign(campaign, tmp_path / "out")
    assert simrun.main(["--from", str(tmp_path / "out"), "--search", "max_thrust_over_weight_g", "--runs", "120"]) == 0
    printed = capsys.readouterr().out
    assert "worst of the campaign's 8 runs" in printed
    flight = fly(load_scenario(tmp_path / "out" / "worst" / "max_thrust_over_weight_g.toml"), log=False)
    assert f"{flight.metrics['max_thrust_over_weight_g']:.4g}" in printed


def test_envelopes_are_percentiles_of_the_channels(tmp_path: Path) -> None:
    file = campaignkit.write_campaign(tmp_path, runs=12)
    envelope = '[campaign.envelope]\nruns = 9\nrate_hz = 20.0\nchannels = ["mass_kg", "altitude_m"]\n'
    file.write_text(file.read_text().replace("[campaign.envelope]\nruns = 0\n", envelope))
    campaign = maxq.load(file)
    run_campaign(campaign, tmp_path / "out", workers=2)
    mass, altitude = bands(tmp_path / "out", campaign)
    flights = [fly(campaign.scenario_of(run)) for run in range(9)]
    for band, name in ((mass, "mass_kg"), (altitude, "altitude_m")):
        assert band.runs == 9
        every = [np.interp(band.time_s, f.time_s(name), f[name]) for f in flights]
        assert band.time_s.tolist() == pytest.approx(np.arange(7) / 20.0)
        # histories are kept in single precision
        assert band.lines == pytest.approx(np.percentile(every, band.percentiles, axis=0), rel=1e-6)


@pytest.mark.slow
def test_the_flights_that_are_kept(tmp_path: Path) -> None:
    campaign = campaignkit.small(tmp_path, runs=10, rest=FAILING.replace("1e-3", "-1.0").replace("[[", "[["))
    (tmp_path / "keep.toml").write_text((tmp_path / "small.toml").read_text().replace('unset = ["requirement"]\n', ""))
    campaign = maxq.load(tmp_path / "keep.toml")
    run_campaign(campaign, tmp_path / "out")
    data = DataSet(tmp_path / "out", campaign)
    speed = data.numbers("max_speed_mps")
    assert selected(data, ["worst:2:max_speed_mps"]) == np.argsort(-speed)[:2].tolist()
    assert selected(data, ["0,7", "7,99"]) == [0, 7]
    assert selected(data, ["failed:3"]) == [0, 1, 2]
    command = [str(tmp_path / "keep.toml"), "--out", str(tmp_path / "out"), "--keep", "0,7", "--no-report"]
    assert simrun.main(command) == 1
    assert sorted(p.name for p in (tmp_path / "out" / "flights").iterdir()) == ["run-000000", "run-000007"]
    hashes = campaignkit.data_set(tmp_path / "out")["state_hash"].to_pylist()
    summary = json.loads((tmp_path / "out" / "flights" / "run-000007" / "summary.json").read_text())
    assert summary["state_hash"] == hashes[7]


@pytest.mark.slow
def test_the_report_stands_alone(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = campaignkit.write_campaign(tmp_path, runs=40)
    file.write_text(file.read_text().replace('unset = ["requirement"]\n', "").replace("\nruns = 0", "\nruns = 40"))
    code = simrun.main([str(file), "--out", str(tmp_path / "out")])
    assert code == 3
    page = (tmp_path / "out" / "report.html").read_text()
    assert page.count("<script") == 2
    assert set(re.findall(r"https?:[^\"']*", page)) == {"http://www.w3.org/2000/svg"}
    assert page.count('<figure class="plot') >= 3
    assert f"simrun refly {tmp_path / 'out'} --run" in page
    data = DataSet(tmp_path / "out", maxq.load(file))
    limits = [(r.metric, r.limit) for r in data.campaign.base.scenario.requirement if r.metric and r.limit]
    used = [100.0 * np.nanmax(data.numbers(metric)) / limit for metric, limit in limits]
    bars = [int(share) for share in re.findall(r'class="n used(?: bad)?" style="--used:(\d+)%"', page)]
    assert bars == sorted(map(round, used), reverse=True)
    assert len(bars) >= 5
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert summary["outcomes"] == {"duration": 40}
    first = summary["requirements"][1]
    assert first["shown"]["failures"] == 0
    assert first["shown"]["more"] == 1104 - 40
    assert {p.name for p in (tmp_path / "out" / "figures").iterdir()} >= {"histograms.csv", "envelopes.csv"}
    before = capsys.readouterr().out
    assert simrun.main(["--from", str(tmp_path / "out")]) == 3
    assert before.splitlines()[-1] == capsys.readouterr().out.splitlines()[-1]
    assert simrun.main([str(file), "--out", str(tmp_path / "out"), "--no-report"]) == 3
    assert "all 40 runs were flown before" in capsys.readouterr().out


def test_a_campaign_stops_when_its_verdicts_are_settled(tmp_path: Path) -> None:
    """A requirement that every run misses is settled after a few runs, as is one that all meet at a lower level."""
    rest = FAILING.replace("1e-3", "-1.0")
    text = campaignkit.campaign_text(runs=400, rest=rest, inputs="", campaign="success = 0.9")
    (tmp_path / "early.toml").write_text(text.replace('unset = ["requirement"]\n', ""))
    campaign = maxq.load(tmp_path / "early.toml")
    done = run_campaign(campaign, tmp_path / "out", until_settled=True)
    assert done.settled
    assert 8 <= done.flown < 120  # in batches of eight: how many are under way at the verdict depends on the machine
    assert run_campaign(campaign, tmp_path / "out", until_settled=True).flown == 0


@pytest.mark.slow
def test_a_fixed_number_of_runs_is_recorded_and_an_extension_said(tmp_path: Path) -> None:
    """A fixed number of runs is judged at that number only, whatever the file says later."""
    file = campaignkit.write_campaign(tmp_path, runs=30, campaign='success = 0.9\ntest = "fixed"')
    campaign, out = maxq.load(file), tmp_path / "out"
    shown = {}
    for runs in (30, 20, 34):
        run_campaign(campaign.with_campaign(runs=max(runs, 30)), out)
        shown[runs] = judged(DataSet(out, campaign, limit=runs))[0].shown
    assert (shown[20].judgement, shown[20].more) == ("undecided", 10)
    assert (shown[30].judgement, shown[30].test) == ("met", "fixed test of 30 runs")
    assert shown[34].test.startswith("any-time test at")  # 0.9^30 = 4.2 % are spent
    assert "5.8 % risk, which the fixed test of 30 runs left" in shown[34].test
    with pytest.raises(CampaignError, match="looks at any time"):
        run_campaign(campaign, out, until_settled=True)
    file.write_text(file.read_text().replace('"fixed"', '"any-time"'))
    with pytest.raises(CampaignError, match=r"campaign.test was \"fixed\", is \"any-time\""):
        run_campaign(maxq.load(file), out)
    (out / "runs" / "runs-0000000008-0000000015.parquet").unlink()  # as an interruption leaves it
    data = DataSet(out, campaign)
    assert (data.in_order, judged(data)[0].shown.runs) == (8, 8)
    assert "runs from 8 on are not judged" in how_judged(data, judged(data))


@pytest.mark.slow
@pytest.mark.parametrize("reader", ["pandas", "polars", "duckdb"])
def test_others_read_the_data_set_as_it_is(tmp_path: Path, reader: str) -> None:
    library = importlib.import_module(reader)
    run_campaign(campaignkit.small(tmp_path, runs=12), tmp_path / "out")
    folder = tmp_path / "out" / "runs"
    if reader == "pandas":
        runs = library.read_parquet(folder)["run"].tolist()
    elif reader == "polars":
        runs = library.read_parquet(folder)["run"].to_list()
    else:
        runs = [row[0] for row in library.sql(f"select run from '{folder}/*.parquet'").fetchall()]
    assert sorted(runs) == list(range(12))
