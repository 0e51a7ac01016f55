"""Draws from files reach the data set: ensembles of winds, samples, cases, choices of files."""

from __future__ import annotations

from pathlib import Path

import campaignkit
import pytest

from maxq import ScenarioError
from maxq.sim.campaign.investigation import refly
from maxq.sim.campaign.runner import run_campaign
from maxq.sim.run.fly import fly
from maxq.sim.scenario.loader import load_scenario

ACCURACY = 0.05

THRUST, DELAY = "vehicle.stage.0.engine.thrust_factor", "vehicle.computer.delay_s"
SAME_NOISE = 'noise = "as-scenario"'
WINDS = {
    "calm.csv": "altitude_m,speed_mps,from_deg\n0,1,270\n",
    "storm.csv": "altitude_m,speed_mps,from_deg\n0,25,180\n",
}
SAMPLES = "thrust,unused\n0.99,7\n1.01,8\n1.02,9\n"
CASES = f"{THRUST},{DELAY}\n0.98,0.001\n1.03,0.004\n"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for name, text in {**WINDS, "thrust.csv": SAMPLES, "cases.csv": CASES}.items():
        (tmp_path / name).write_text(text)
    return tmp_path


def flown(folder: Path, runs: int, inputs: str) -> list[dict[str, object]]:
    """Return the rows of a campaign after repeating its last run from the output folder alone."""
    campaign = campaignkit.small(folder, runs=runs, campaign=SAME_NOISE, inputs=inputs)
    run_campaign(campaign, folder / "out", workers=2)
    for name in ("thrust.csv", "cases.csv", "small.toml"):
        (folder / name).unlink()
    again = refly(folder / "out", runs - 1, log=False)
    assert again.same, again.differences
    rows: list[dict[str, object]] = campaignkit.data_set(folder / "out").to_pylist()
    return rows


def hash_of(folder: Path, *overrides: str) -> str:
    """Return the final state of the same scenario, flown alone with single values instead of dispersions."""
    file = folder / "alone.toml"
    text = campaignkit.campaign_text(inputs="").partition("[campaign]")[0]
    file.write_text(text)
    return fly(load_scenario(file, [*overrides, f"run.accuracy={ACCURACY}"]), log=False).state_hash


@pytest.mark.parametrize(
    "inputs",
    [
        '[wind_model]\nmodel = "ensemble"\nprofiles = ["calm.csv", "storm.csv"]\norder = "{order}"\n',
        '[[disperse]]\nkey = "wind.profile"\ndistribution = "choice"\nvalues = ["calm.csv", "storm.csv"]\n',
    ],
    ids=["ensemble", "choice"],
)
def test_winds_out_of_files(folder: Path, inputs: str) -> None:
    rows = flown(folder, 8, inputs.replace("{order}", "random"))
    winds = [str(row["wind.profile"]) for row in rows]
    assert {Path(wind).name for wind in winds} == set(WINDS)
    hashes = {Path(wind).name: row["state_hash"] for wind, row in zip(winds, rows, strict=True)}
    assert hashes == {name: hash_of(folder, f'wind.profile="{name}"') for name in WINDS}
    assert hashes["calm.csv"] != hashes["storm.csv"]
    assert len({row["state_hash"] for row in rows}) == 2


def test_an_ensemble_in_turn(folder: Path) -> None:
    inputs = '[wind_model]\nmodel = "ensemble"\nprofiles = ["calm.csv", "storm.csv"]\norder = "in-turn"\n'
    rows = flown(folder, 5, inputs)
    assert [Path(str(row["wind.profile"])).name for row in rows] == ["calm.csv", "storm.csv"] * 2 + ["calm.csv"]


def test_a_choice_is_weighed(folder: Path) -> None:
    inputs = '[[disperse]]\nkey = "wind.profile"\ndistribution = "choice"\nvalues = ["calm.csv", "storm.csv"]\n'
    rows = flown(folder, 3, inputs + "weights = [0.0, 1.0]\n")
    assert {Path(str(row["wind.profile"])).name for row in rows} == {"storm.csv"}


@pytest.mark.parametrize("order", ["in-turn", "random"])
def test_samples_out_of_a_column(folder: Path, order: str) -> None:
    inputs = f'[[disperse]]\nkey = "{THRUST}"\ndistribution = "samples"\nfile = "thrust.csv"\n'
    rows = flown(folder, 5, inputs + f'column = "thrust"\norder = "{order}"\n')
    drawn = [row[THRUST] for row in rows]
    if order == "in-turn":
        assert drawn == [0.99, 1.01, 1.02, 0.99, 1.01]
    assert set(drawn) <= {0.99, 1.01, 1.02}
    assert rows[1]["state_hash"] == hash_of(folder, f"{THRUST}={drawn[1]}")


def test_cases_are_rows_whose_columns_belong_together(folder: Path) -> None:
    inputs = '[[disperse]]\ndistribution = "cases"\nfile = "cases.csv"\norder = "{order}"\n'
    rows = flown(folder, 3, inputs.replace("{order}", "in-turn"))
    assert [(row[THRUST], row[DELAY]) for row in rows] == [(0.98, 0.001), (1.03, 0.004), (0.98, 0.001)]
    assert rows[1]["state_hash"] == hash_of(folder, f"{THRUST}=1.03", f"{DELAY}=0.004")
    (folder / "cases.csv").write_text(CASES)
    campaign = campaignkit.small(folder, "random", campaign=SAME_NOISE, inputs=inputs.replace("{order}", "random"))
    drawn = campaign.plan.draw(0, 200).draws
    pairs = set(zip(drawn[THRUST].tolist(), drawn[DELAY].tolist(), strict=True))
    assert pairs == {(0.98, 0.001), (1.03, 0.004)}


@pytest.mark.parametrize(
    ("inputs", "says"),
    [
        ('[[disperse]]\ndistribution = "samples"\nkey = "wind.factor"\nfile = "thrust.csv"', "thrust, unused"),
        ('[[disperse]]\ndistribution = "cases"\nfile = "thrust.csv"', "thrust"),
        ('[[disperse]]\ndistribution = "choice"\nkey = "wind.profile"\nvalues = ["none.csv"]', "no such file"),
        ('[wind_model]\nmodel = "ensemble"\nprofiles = ["none.csv"]', "no such file"),
        ('[wind_model]\nmodel = "ensemble"\nprofiles = []', "one profile or more"),
    ],
)
def test_mistakes_in_files_are_said_in_one_line(folder: Path, inputs: str, says: str) -> None:
    with pytest.raises(ScenarioError) as caught:
        campaignkit.small(folder, inputs=inputs + "\n")
    assert says in str(caught.value)
    assert "\n" not in str(caught.value)
