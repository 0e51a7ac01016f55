"""Messages that were misleading name the right cause and the next step."""

from __future__ import annotations

from pathlib import Path

import pytest

import maxq
from maxq import CampaignError, FlightRun, LoadedScenario, ScenarioError, record
from maxq.design.verify.outcome import described
from maxq.sim.campaign.store import open_store
from maxq.sim.input.files import builtin_files
from maxq.sim.scenario.loader import copy_scenario, load_scenario
from maxq.tools import simreplay
from maxq.tools.cli.frame import show_list


@pytest.fixture(autouse=True)
def _in_an_empty_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)


def refused(table: str) -> str:
    """Return the error message for a CSV file of gains."""
    Path("t.csv").write_text(table)
    with pytest.raises(ScenarioError) as caught:
        load_scenario("nominal", ["design.gains.table=t.csv"])
    return str(caught.value)


def test_a_copy_in_its_own_folder_is_found_before_the_built_in_one() -> None:
    copy_scenario("checkcases/two-stage", "ts")
    with pytest.raises(ScenarioError, match=r"no such file; did you mean ts/checkcases/two-stage.toml\?"):
        load_scenario("ts/two-stage.toml")


def test_a_mistyped_log_is_named_before_the_missing_display(capsys: pytest.CaptureFixture[str]) -> None:
    assert simreplay.main(["nosuch"]) == 2
    assert capsys.readouterr().err == "simreplay: nosuch: no such file or folder\n"


def test_a_campaign_without_logs_says_how_to_keep_some(capsys: pytest.CaptureFixture[str]) -> None:
    Path("runs/first").mkdir(parents=True)
    Path("runs/first", "campaign.json").write_text("{}")
    assert simreplay.main(["runs/first"]) == 2
    assert "simrun report runs/first --keep worst:5" in capsys.readouterr().err


def test_a_folder_in_use_advises_what_can_help() -> None:
    campaign = maxq.load("campaigns/first")
    store, _ = open_store(Path("there"), campaign)
    try:
        with pytest.raises(CampaignError, match=r"wait for it, or give another --out$"):
            open_store(Path("there"), campaign)
        with pytest.raises(CampaignError, match=r"wait for it, or work it out again$"):
            open_store(Path("there"), campaign, "work it out again")
    finally:
        store.unlock()


def test_an_unlike_column_gets_no_hint_but_the_columns_there_are() -> None:
    said = refused("time_s,alpha_deg\n0,1\n")
    assert "did you mean" not in said
    assert 'unknown column "alpha_deg"' in said
    assert "allowed: columns time_s, " in said


def test_a_near_column_gets_its_hint() -> None:
    assert "did you mean time_s?" in refused("tim_s,k_p,k_d_s\n0,0,0\n")


def test_every_unknown_column_is_named() -> None:
    said = refused("time,gain,damping\n0,0,0\n")
    assert (
        't.csv: line 1: unknown columns "time", "gain", "damping"; allowed: CSV with columns time_s, k_p, k_d_s' in said
    )
    said = refused("time_s,north,east\n0,0,0\n")
    assert 'unknown column "north"' in said
    assert 'unknown column "east"' in said


def test_every_wrong_cell_and_row_is_named() -> None:
    header = "time_s,k_p,k_d_s\n"
    said = refused(header + "0,x,0\n1000,0\n2000,0,y\n")
    assert said.startswith('t.csv: line 2, k_p = "x": is not a number; also line 3: has 2 columns')
    assert 'line 4, k_d_s = "y": is not a number' in said
    said = refused(header + "0,inf,0\n1000,inf,nan\n")
    assert "k_p = inf: is not finite (and in 1 more row); also line 3, k_d_s = nan: is not finite" in said
    assert "\n" not in said
    many = refused(header + "a,a,a\n" * 10)
    assert "and 25 more mistakes" in many


def test_a_description_tells_what_was_changed() -> None:
    """A description states changes: `nominal` in wind must not read "no wind"."""

    def described(*overrides: str) -> str:
        loaded = maxq.load("nominal", *overrides)
        assert isinstance(loaded, LoadedScenario)
        return loaded.scenario.description

    wind = "wind.profile=winds/anheung-november.csv"
    assert described(wind).endswith(f", no wind; changed: {wind}")
    assert described(wind, "description=in wind") == "in wind"
    assert described(wind, "name=windy") == described(wind)
    long = described(f"design.description={'x' * 200}")
    assert long.endswith("...")
    assert len(long) < 200


def test_designs_are_listed_by_their_purpose_and_no_two_alike(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "300")
    assert show_list({"design": "designs"}) == 0
    told = [line.split(maxsplit=1)[1] for line in capsys.readouterr().out.splitlines()[1:]]
    assert len(set(told)) == len(told) > 5
    assert all(text.startswith(("KSR-III", "Greensite's launcher", "petrel, an unstable launcher")) for text in told)


def test_a_design_of_several_stages_is_described_stage_by_stage() -> None:
    forms = [("F4", "free", "sampled"), ("F2", "linear", "sampled")]
    assert described("For gusts.", forms, ["stage 1: met", "stage 2: missed"]) == (
        "For gusts (filter F4/F2, free/linear gains, sampled loop). Stage 1: met. Stage 2: missed"
    )
    assert described("", forms[:1], ["least 1"]) == "filter F4, free gains, sampled loop. Least 1"


@pytest.mark.parametrize("width", [80, 120])
def test_lists_of_all_kinds_are_aligned(
    width: int, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", str(width))
    assert show_list({"case": "cases", "points": "derivatives", "suite": "suites"}) == 0
    groups = [group.splitlines() for group in capsys.readouterr().out.split("\n\n")]
    assert [group[0] for group in groups] == ["cases", "derivatives", "suites"]
    lines = [line for group in groups for line in group[1:]]
    column = 2 + max(len(name) for kind in ("case", "points", "suite") for name in builtin_files(kind)) + 2
    assert max(map(len, lines)) <= width
    for line in lines:  # a name or nothing, two spaces, and the description
        assert line[column - 2 : column] == "  ", line
        assert line[column] != " ", line


def test_a_flight_is_recorded_into_a_folder_named_by_text() -> None:
    loaded = load_scenario("nominal", ["run.duration_s=0.01", "requirement="])
    flight = record(FlightRun(loaded), "runs/x")
    assert flight.outcome == "duration"
    assert Path("runs/x/flight.mcap").is_file()
