"""Correlated draws have SciPy's marginal distributions and the closed-form rank correlation of the Gaussian copula."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy import stats

import maxq
from maxq import LoadedCampaign, ScenarioError
from maxq.sim.packing.flight import pack_flight
from maxq.sim.scenario.loader import load_scenario

THRUST, LENGTH, FORCE = "vehicle.stage.0.engine.thrust_factor", "vehicle.stage.0.tank.0.length_factor", "aero force"
TEXT = f"""\
extends = "nominal.toml"
[campaign]
runs = 100
correlated = [{{of = ["{THRUST}", "{FORCE}"], coefficient = 0.8}}, {{of = ["{FORCE}", "{LENGTH}"], coefficient = -0.5}}]
[[disperse]]
key = "{THRUST}"
apply = "scale"
distribution = "uniform"
low = 0.9
high = 1.1
[[disperse]]
name = "{FORCE}"
key = "vehicle.stage.0.aero.force_factor"
apply = "scale"
distribution = "log-normal"
sigma = 0.1
[[disperse]]
key = "{LENGTH}"
apply = "scale"
power = -2.0
distribution = "normal"
sigma = 0.02
"""


def campaign(folder: Path, old: str = "", new: str = "") -> LoadedCampaign:
    path = folder / "together.toml"
    path.write_text(TEXT.replace(old, new) if old else TEXT)
    return maxq.load(path)


def test_draws_keep_their_distributions_and_have_the_rank_correlation_of_their_scores(tmp_path: Path) -> None:
    """Spearman's rho of normal scores with correlation r is 6/pi asin(r/2) (Kruskal 1958), to 0.01 for 10,000."""
    drawn = campaign(tmp_path).plan.draw(0, 10_000)
    thrust, force, length = (np.array(column) for column in drawn.recorded.values() if isinstance(column[0], float))
    assert stats.kstest(thrust, stats.uniform(0.9, 0.2).cdf).pvalue > 0.01
    assert stats.kstest(force, stats.lognorm(0.1).cdf).pvalue > 0.01
    assert stats.kstest(length**-0.5, stats.norm(1.0, 0.02).cdf).pvalue > 0.01
    for a, b, r in ((thrust, force, 0.8), (force, length**-0.5, -0.5), (thrust, length, 0.0)):
        wanted = 6.0 / np.pi * np.arcsin(r / 2.0)
        assert stats.spearmanr(a, b).statistic == pytest.approx(wanted, abs=0.03)


def test_a_run_has_its_draws_alone_and_by_its_scores(tmp_path: Path) -> None:
    """The symmetric root mixes independent scores: a run alone has SciPy's quantiles of z = sqrt(R) v."""
    found = campaign(tmp_path)
    alone, many = found.plan.draw(7, 1).recorded, found.plan.draw(0, 20).recorded
    assert {name: values[0] for name, values in alone.items()} == {name: values[7] for name, values in many.items()}
    sizes, vectors = np.linalg.eigh(np.array([[1.0, 0.8, 0.0], [0.8, 1.0, -0.5], [0.0, -0.5, 1.0]]))
    v = np.array([0.5, -1.0, 2.0])
    z = (vectors * np.sqrt(sizes)) @ vectors.T @ v
    drawn, good = found.plan.of_scores(v[None], np.zeros(1, np.int64))
    thrust, force, length = (drawn.flown[d.name, 0][0] for d in found.plan.draws)
    assert good.all()
    assert thrust == pytest.approx(0.9 + 0.2 * stats.norm.cdf(z[0]), rel=1e-10)
    assert force == pytest.approx(np.exp(0.1 * z[1]), rel=1e-10)
    assert length == pytest.approx((1.0 + 0.02 * z[2]) ** -2.0, rel=1e-10)


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        (f'["{FORCE}", "{LENGTH}"]', '["aero force", "drag"]', "campaign.correlated.1.of"),
        (f'["{FORCE}", "{LENGTH}"]', '["aero force", "aero force"]', "are not two draws"),
        ("coefficient = -0.5", "coefficient = -0.9", "positive semidefinite"),
        ('apply = "scale"\npower', 'apply = "set"\npower', "disperse.2.power"),
    ],
)
def test_pairs_that_cannot_be_are_refused(tmp_path: Path, old: str, new: str, said: str) -> None:
    with pytest.raises(ScenarioError, match=said) as error:
        campaign(tmp_path, old, new)
    assert "together.toml" in str(error.value)


def test_damping_factor_scales_all_damping_of_a_tank() -> None:
    """The factor scales the damping ratio of the pendulum and the contributions of walls and rings."""
    records = []
    for factor in (1.0, 1.5):
        flown = load_scenario("ksr3-ringed", [f"vehicle.stage.0.tank.0.damping_factor={factor}"])
        records.append(pack_flight(flown.scenario).parameters[0].vehicle.slosh)
    one, other = records
    assert other.damping_ratio[0] == pytest.approx(1.5 * one.damping_ratio[0], rel=1e-15)
    assert (one.law_factor[0], other.law_factor[0]) == (1.0, 1.5)
    assert (other.damping_ratio[1], other.law_factor[1]) == (one.damping_ratio[1], 1.0)
