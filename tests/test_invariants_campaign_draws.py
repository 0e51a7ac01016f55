"""A draw depends only on campaign seed, key path and run index, and independent draws are uncorrelated."""

from __future__ import annotations

from itertools import combinations
from pathlib import Path

import campaignkit
import numpy as np
import pytest

import maxq
from maxq import LoadedCampaign, ScenarioError
from maxq.sim.campaign import draws
from maxq.sim.campaign.plan import VectorWind
from maxq.sim.campaign.schema import WindModel
from maxq.sim.input.tables_csv import CsvTable

SAMPLINGS = ("random", "latin-hypercube", "sobol")
FURTHER = """\
[[disperse]]
key = "vehicle.stage.0.aero.force_factor"
distribution = "normal"
sigma = 0.05
"""


def drawn(campaign: LoadedCampaign, first: int, count: int) -> dict[str, np.ndarray]:
    made = campaign.plan.draw(first, count)
    assert made.seeds is not None
    return {**made.draws, "seed": made.seeds}


@pytest.mark.parametrize("sampling", SAMPLINGS)
def test_where_a_batch_begins_and_how_many_runs_there_are_changes_nothing(tmp_path: Path, sampling: str) -> None:
    campaign = campaignkit.small(tmp_path, runs=64, campaign=f'sampling = "{sampling}"')
    whole = drawn(campaign, 0, 200)
    larger = campaign.with_campaign(runs=200)
    for first, count in ((0, 1), (17, 1), (30, 50), (63, 3), (150, 50)):
        part = drawn(larger, first, count)
        for name, values in whole.items():
            assert part[name].tobytes() == values[first : first + count].tobytes()


@pytest.mark.parametrize("sampling", SAMPLINGS)
def test_a_further_key_changes_no_other_draw(tmp_path: Path, sampling: str) -> None:
    chosen = {"campaign": f'sampling = "{sampling}"'}
    before = drawn(campaignkit.small(tmp_path, **chosen), 0, 50)
    after = drawn(campaignkit.small(tmp_path, "more", inputs=campaignkit.INPUTS + FURTHER, **chosen), 0, 50)
    assert len(after) == len(before) + 1
    for name, values in before.items():
        assert after[name].tobytes() == values.tobytes()


@pytest.mark.parametrize("sampling", ["random", "latin-hypercube"])
def test_the_order_of_keys_changes_nothing(tmp_path: Path, sampling: str) -> None:
    chosen = {"campaign": f'sampling = "{sampling}"'}
    after = drawn(campaignkit.small(tmp_path, "first", inputs=FURTHER + campaignkit.INPUTS, **chosen), 0, 50)
    before = drawn(campaignkit.small(tmp_path, "last", inputs=campaignkit.INPUTS + FURTHER, **chosen), 0, 50)
    for name, values in before.items():
        assert after[name].tobytes() == values.tobytes()


def test_an_asterisk_draws_for_each_mode_of_the_vehicle(tmp_path: Path) -> None:
    """A key with an asterisk draws the same numbers as one key per mode."""
    law = 'distribution = "normal"\nsigma = 0.1\n'
    key = "vehicle.stage.0.bending.frequency_factor"
    each = "".join(f'[[disperse]]\nkey = "{key}.{n}"\n{law}' for n in range(3))
    all_ = f'[[disperse]]\nkey = "{key}.*"\nname = "frequency"\n{law}'
    one, other = (campaignkit.small(tmp_path, name, inputs=text) for name, text in (("each", each), ("all", all_)))
    assert [d.name for d in other.plan.draws] == [f"{key}.{n}" for n in range(3)]
    assert [d.label for d in other.plan.draws] == ["frequency 1", "frequency 2", "frequency 3"]
    before, after = drawn(one, 0, 20), drawn(other, 0, 20)
    assert all(after[name].tobytes() == values.tobytes() for name, values in before.items())
    two = f'[[disperse]]\nkey = "vehicle.stage.*.bending.frequency_factor.*"\n{law}'  # for several parts of a key, too
    assert [d.name for d in campaignkit.small(tmp_path, "two", inputs=two).plan.draws] == [
        f"{key}.{n}" for n in range(3)
    ]
    with pytest.raises(ScenarioError, match="is a value and has no keys below it"):
        campaignkit.small(tmp_path, "none", inputs=all_.replace("frequency_factor", "damping_ratio.0"))


def test_the_seed_and_the_key_change_everything() -> None:
    a = draws.uniforms(1, "a", 0, 1000)
    for other in (draws.uniforms(2, "a", 0, 1000), draws.uniforms(1, "b", 0, 1000), draws.uniforms(1, "a", 0, 1000, 1)):
        assert not np.isin(a, other).any()


def test_the_bits_are_those_of_today() -> None:
    """The bits of draws are recorded, so that new versions of NumPy or SciPy cannot change old campaigns."""
    assert [x.hex() for x in draws.uniforms(1, "run.seed", 3, 2)] == PINNED["uniforms"]
    assert draws.seeds(1, "run.seed", 3, 2).tolist() == PINNED["seeds"]
    assert [x.hex() for x in draws.latin(1, "a", 6, 2, 4)] == PINNED["latin"]
    assert [x.hex() for x in draws.Sobol(1, ("a", "b"), 5, 2)("b")] == PINNED["sobol"]


@pytest.mark.parametrize("sampling", SAMPLINGS)
def test_no_two_inputs_correlate_that_should_not(tmp_path: Path, sampling: str) -> None:
    """No two independent inputs correlate.

    A known error of other tools gives every model of a worker the same stream: ten pairs with r = 1.
    """
    campaign = maxq.load("campaigns/ksr3", f"campaign.sampling={sampling}")
    n = 4096
    made = campaign.plan.draw(0, n)
    assert made.seeds is not None
    columns = {name: values.astype(float) for name, values in made.draws.items()}
    columns |= {"seed": made.seeds.astype(float), "next seed": np.roll(made.seeds, 1).astype(float)}
    correlated = {frozenset(d.name for d in campaign.plan.draws if d.group and d.entry == e) for e in range(99)}
    for (a, x), (b, y) in combinations(columns.items(), 2):
        if not any({a, b} <= group for group in correlated):
            assert abs(np.corrcoef(x, y)[0, 1]) < 5.0 / np.sqrt(n), (a, b)


def test_runs_have_noise_of_their_own(tmp_path: Path) -> None:
    seeds = campaignkit.small(tmp_path).plan.draw(0, 10_000).seeds
    assert seeds is not None
    assert len(set(seeds.tolist())) == 10_000
    assert seeds.min() >= 0


def test_a_latin_hypercube_fills_every_cell_once() -> None:
    n = 1000
    for block in range(2):
        u = draws.latin(3, "key", block * n, n, n)
        assert sorted((u * n).astype(int)) == list(range(n))


def test_scrambled_sobol_points_are_still_a_net() -> None:
    """Each elementary interval of area 2^-m of the first two dimensions contains one of 2^m points."""
    m = 10
    points = draws.Sobol(9, ("a", "b"), 0, 2**m)
    x, y = points("a"), points("b")
    for i in range(m + 1):
        cells = (x * 2**i).astype(int) * 2 ** (m - i) + (y * 2 ** (m - i)).astype(int)
        assert len(set(cells.tolist())) == 2**m
    assert len(set(x.tolist()) & set(draws.Sobol(10, ("a",), 0, 2**m)("a").tolist())) < 3


PINNED: dict[str, list[object]] = {
    "uniforms": ["0x1.75472394aa9fbp-1", "0x1.5e617f6b165e2p-2"],
    "seeds": [1354879671871929088, 7153136581263746108],
    "latin": ["0x1.a7ba125c3b26ep-1", "0x1.10be091f4625bp-3"],
    "sobol": ["0x1.401962a500000p-1", "0x1.aabcf57a00000p-2"],
}


def test_vector_winds_have_the_covariance_of_their_table() -> None:
    """Standard deviations and correlations match the table, with exp(-height / length) between altitudes.

    With 6,000 draws, the standard error is 0.013 for a correlation and 1 % for a standard deviation. Five standard
    errors are allowed.
    """
    z = np.arange(3) * 4000.0
    columns = {"sigma_north_mps": [4.0, 9.0, 7.0], "sigma_east_mps": [6.0, 8.0, 12.0], "correlation": [0.8, -0.5, 0.0]}
    table = CsvTable("", {"altitude_m": z, **{name: np.array(values) for name, values in columns.items()}})
    wind = WindModel(model="vector", table=table, correlation_length_m=6000.0, factor=0.5)
    mean = CsvTable("", {"altitude_m": z, "north_mps": 0.0 * z, "east_mps": 0.0 * z})
    scores = VectorWind(wind, mean).scores(3, 0, 6000)
    assert scores.std(axis=0) == pytest.approx(0.5 * np.array([[4.0, 6.0], [9.0, 8.0], [7.0, 12.0]]), rel=0.05)
    north, east = scores[:, :, 0].T, scores[:, :, 1].T
    assert [np.corrcoef(n, e)[0, 1] for n, e in zip(north, east, strict=True)] == pytest.approx(
        [0.8, -0.5, 0.0], abs=0.065
    )
    assert np.corrcoef(north) == pytest.approx(np.exp(-np.abs(z[:, None] - z) / 6000.0), abs=0.065)


def test_a_search_is_over_what_has_a_range(tmp_path: Path) -> None:
    """A search covers inputs with a range, but no choice among values and no text."""
    choice = (
        '[[disperse]]\nkey = "vehicle.stage.0.engine.thrust_factor"\ndistribution = "choice"\nvalues = [0.9, 1.1]\n'
    )
    campaign = campaignkit.small(tmp_path, inputs=choice + FURTHER)
    (name, box) = next(iter(campaign.boxes().items()))
    assert (len(campaign.boxes()), name) == (1, "vehicle.stage.0.aero.force_factor")
    assert box == pytest.approx((0.85, 1.15))
