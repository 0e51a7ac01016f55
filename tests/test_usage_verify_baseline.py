"""A suite and its baseline: each difference in resolved content is on the first page; a copy differs in nothing."""

from __future__ import annotations

import json
import re
from pathlib import Path

import petrelkit as petrel
import pytest

from maxq.design.verify.baseline import SuiteDifference, against_baseline
from maxq.design.verify.suite import read_suite
from maxq.sim.input.files import builtin_files, scenarios_folder
from maxq.tools.simverify import main

SHORT = """
schema = 2
[[flight]]
name = "three seconds"
set = ["run.duration_s=3.0"]
"""


@pytest.fixture(autouse=True)
def _in_an_empty_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


def _differences(suite: str, *overrides: str) -> list[str]:
    return [one.text for one in against_baseline(read_suite(suite, overrides)).differences]


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=pytest.mark.slow if name == "petrel" else []) for name in builtin_files("suite")]
)
def test_a_shipped_suite_is_its_own_baseline(name: str) -> None:
    if name == "petrel":
        Path("petrel").symlink_to(petrel.folder())
    compared = against_baseline(read_suite(name))
    assert compared.title == f"no differences from the shipped suite {name}"
    assert compared.hashes["suite"] == compared.hashes["baseline"]


def test_a_copy_under_another_name_differs_in_nothing() -> None:
    text = (scenarios_folder() / "suites/standard.toml").read_text()
    Path("board.toml").write_text(f'name = "of the board"\n{text}'.replace('extends = "launcher"', ""))
    Path("whole.toml").write_text(text)
    found = against_baseline(read_suite("whole.toml"))  # it extends the shipped launcher
    assert found.baseline == "launcher"
    assert against_baseline(read_suite("whole.toml", ["baseline=standard"])).differences == ()
    assert against_baseline(read_suite("board.toml")).baseline == "standard"


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ("margins.nominal.gain_up_db=5.0", "limit loosened: margins.nominal.gain_up_db, 6 -> 5"),
        ("margins.nominal.gain_up_db=", "limit loosened: margins.nominal.gain_up_db, 6 -> none"),
        ("margins.nominal.modes_from_2_db=-5.0", "limit loosened: margins.nominal.modes_from_2_db, -6 -> -5"),
        ("margins.nominal.gain_up_db=7.0", "added or stricter: margins.nominal.gain_up_db, 6 -> 7"),
        ("margins.worst.modulus=0.2", "limit loosened: margins.worst.modulus, 0.25 -> 0.2"),
        ("margins.worst=", "removed: margins worst"),
        ("margins.only=certificate", "removed: margins.only,  -> certificate"),
        ("margins.cases=100", "level or number lowered: margins.cases, 10000 -> 100"),
        ("margins.confidence=0.5", "level or number lowered: margins.confidence, 0.9 -> 0.5"),
        ("margins.planes=['pitch']", "level or number lowered: margins.planes, [pitch, yaw] -> [pitch]"),
        ("margins.seed=7", "seed chosen by hand: margins.seed, 1 -> 7"),
        ("margins.three_sigma.thrust=0.0", "spread reduced: margins.three_sigma.thrust, 0.03 -> 0"),
        ("certificate=", "removed: certificate"),
        ("certificate.in_flight=false", "level or number lowered: certificate.in_flight, true -> false"),
        ("campaign=[]", "removed: campaign 1"),
        ("campaign.0.success=0.9", "level or number lowered: campaign 1: success, 0.9973 -> 0.9"),
        ("campaign.0.runs=1", "level or number lowered: campaign 1: runs, 1200 -> 1"),
        ("campaign.0.set=['run.duration_s=1.0']", "shortened: campaign 1: scenario.run.duration_s, 70 -> 1"),
        (
            "campaign.0.set=['switches.slosh=false']",
            "physics switched off: campaign 1: scenario.switches.slosh, true -> false",
        ),
        ("scenario=tvc-load", None),
        ("dispersed_limit.2.limit=25.0", "limit loosened: dispersed_limit.slosh angle, 17 -> 25"),
        (
            "flight.0.design_must_keep=false",
            "design_must_keep = false: flight nominal: design_must_keep, true -> false",
        ),
        ("flight.0.set=['run.duration_s=1.0']", "shortened: flight nominal: run.duration_s, none -> 1"),
    ],
)
def test_each_change_of_standard_has_its_kind(change: str, said: str | None) -> None:
    found = _differences("standard", change)
    if said is None:
        assert found
    else:
        assert found == [said]


def test_switches_of_every_flight_are_named_first() -> None:
    """As the suite that switches slosh and bending off, and is otherwise `standard`."""
    every = ["run.stop_at=['burnout','impact']", "switches.slosh=false", "switches.bending=false"]
    Path("off.toml").write_text(f'schema = 2\nextends = "standard"\nevery = {json.dumps(every)}\n')
    assert _differences("off.toml") == [
        "physics switched off: 43 flights: switches.slosh, none -> false",
        "physics switched off: 43 flights: switches.bending, none -> false",
    ]


def test_a_design_in_place_of_the_judged_one_is_named() -> None:
    design = "['design=\"designs/ksr3-robust.toml\"']"
    what = "design in place of the judged one, none -> designs/ksr3-robust.toml"
    found = [text for text in _differences("quick", f"every={design}") if "design" in text]
    assert found == [f"changed: 3 flights: {what}"]
    found = [text for text in _differences("standard", f"campaign.0.set={design}") if "design" in text]
    assert found == [f"changed: campaign 1: {what}"]


def test_files_are_compared_by_their_content() -> None:
    folder = scenarios_folder()
    Path("winds").mkdir()
    rows = (folder / "winds/anheung-november.csv").read_text().splitlines()
    Path("winds/mine.csv").write_text("\n".join(rows))
    Path("same.toml").write_text('schema = 2\nextends = "standard"\nlimit_wind = "winds/mine.csv"\n')
    assert _differences("same.toml") == []
    head = next(n for n, row in enumerate(rows) if not row.startswith("#"))
    calm = [",".join([(cells := row.split(","))[0], "1.0", *cells[2:]]) for row in rows[head + 1 :]]
    Path("winds/mine.csv").write_text("\n".join([rows[head], *calm]))
    (found,) = _differences("same.toml")
    assert re.fullmatch(r"changed: limit_wind\.speed_mps, 27 values, \w{8} -> 27 values, \w{8}", found)
    Path("weak.toml").write_text(
        f'extends = "{folder}/campaigns/ksr3.toml"\n[[disperse]]\nkey = "atmosphere.density_factor"\n'
        'distribution = "normal"\nthree_sigma = 0.01\n'
    )
    Path("fewer.toml").write_text(
        'schema = 2\nextends = "standard"\n[[campaign]]\nfile = "weak.toml"\nlimits = "dispersed"\nruns = 1200\n'
    )
    found_all = _differences("fewer.toml")
    assert "spread reduced: campaign 1: deviation.atmosphere.density_factor.three_sigma, 0.075 -> 0.01" in found_all
    assert "spread reduced: campaign 1 deviation vehicle.stage.0.aero.force_factor" in found_all


def test_a_suite_without_a_scenario_of_its_own_is_compared_by_the_usual_one() -> None:
    campaign = '[[campaign]]\nfile = "campaigns/ksr3"\nset = ["run.duration_s=1.0"]\n'
    Path("mine.toml").write_text(f"schema = 2\n{campaign}")
    found = _differences("mine.toml")
    assert "shortened: campaign 1: scenario.run.duration_s, 70 -> 1" in found


def test_another_vehicle_is_named_and_its_numbers_are_not_compared() -> None:
    Path("other.toml").write_text('extends = "nominal.toml"\nunset = ["design"]\n[vehicle_overrides]\nname = "other"\n')
    Path("mine.toml").write_text('schema = 2\nextends = "standard"\nscenario = "other.toml"\n')
    (found,) = _differences("mine.toml")
    assert found.startswith("changed: vehicle, whose own numbers, limits and winds are not compared, KSR-III")
    assert found.endswith(" -> other")


def test_smaller_spreads_of_another_vehicle_are_listed() -> None:
    """Those of factors and of the air, by standard deviation; a larger one and one in the vehicle's units are not."""
    Path("other.toml").write_text('extends = "nominal.toml"\nunset = ["design"]\n[vehicle_overrides]\nname = "other"\n')
    draws = {
        "atmosphere.density_factor": "three_sigma = 0.01",
        "vehicle.stage.0.engine.thrust_factor": "sigma = 0.001",
        "vehicle.stage.0.engine.mass_flow_factor": "three_sigma = 0.04",
        "vehicle.stage.0.engine.misalignment_deg.0": "three_sigma = 0.01",
    }
    text = "".join(f'[[disperse]]\nkey = "{key}"\ndistribution = "normal"\n{size}\n' for key, size in draws.items())
    Path("calm.toml").write_text(f'schema = 1\nextends = "other.toml"\n[campaign]\nruns = 2000\n{text}')
    campaign = '[[campaign]]\nfile = "calm.toml"\nlimits = "dispersed"\nruns = 1200\n'
    Path("mine.toml").write_text(f'schema = 2\nextends = "standard"\nscenario = "other.toml"\n{campaign}')
    found = [text for text in _differences("mine.toml") if text.startswith("spread reduced")]
    of = "spread reduced: campaign 1: deviation."
    assert found == [
        f"{of}vehicle.stage.0.engine.thrust_factor, standard deviation, 0.00333333 -> 0.001",
        f"{of}atmosphere.density_factor, standard deviation, 0.025 -> 0.00333333",
    ]


def test_an_agreed_baseline_is_named_as_not_shipped() -> None:
    Path("agreed.toml").write_text(SHORT)
    Path("mine.toml").write_text(f'baseline = "agreed.toml"\n{SHORT}'.replace("3.0", "2.0"))
    compared = against_baseline(read_suite("mine.toml"))
    shipped = against_baseline(read_suite("mine.toml", ["baseline=standard"]))
    assert (
        compared.title == f"1 difference from the suite {Path('agreed.toml').resolve()}, not shipped; {shipped.title}"
    )
    assert compared.differences == (SuiteDifference("shortened", "flight three seconds: run.duration_s", "3", "2"),)


def test_a_suite_that_is_its_own_baseline_is_compared_with_the_shipped_one() -> None:
    weak = 'schema = 2\nextends = "standard"\nbaseline = "mine.toml"\n[margins.nominal]\ngain_up_db = 0.1\n'
    Path("mine.toml").write_text(weak)
    compared = against_baseline(read_suite("mine.toml"))
    assert compared.title.endswith("not shipped; 1 difference from the shipped suite standard")
    loosened = SuiteDifference("limit loosened", "margins.nominal.gain_up_db", "6", "0.1")
    assert (compared.differences, compared.all_differences) == ((), [loosened])


def test_a_vehicle_s_suite_is_compared_with_launcher_but_for_its_own_numbers() -> None:
    found = against_baseline(read_suite(petrel.folder() / "suite.toml"))
    assert found.title.endswith("differences from the shipped suite launcher")
    assert {one.what for one in found.differences if one.kind == "level or number lowered"} == {
        "margins.nodes_per_stage",
        "margins.cases",
        "margins.success",
        "certificate.nodes_per_stage",
    }
    assert not any("ksr" in one.text.lower() for one in found.differences)


@pytest.mark.slow
def test_terminal_page_and_verdict_show_the_differences_and_hash_everything(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("maxq.design.verify.memory.default_folder", lambda: tmp_path / "memory")
    Path("mine.toml").write_text(SHORT)
    assert main(["ksr3-robust", "--suite", "mine.toml", "--out", "out"]) == 0
    said = capsys.readouterr().out
    assert re.search(r"^baseline: \d+ differences from the shipped suite standard$", said, re.MULTILINE)
    assert re.search(r"^  removed +43 flights: nominal, limit wind, ", said, re.MULTILINE)
    page, verdict = Path("out/review.html").read_text(), json.loads(Path("out/verdict.json").read_text())
    assert "differences from the shipped suite standard" in page
    assert {"kind": "removed", "what": "certificate", "baseline": "", "here": ""} in verdict["baseline"]["differences"]
    names = {"design", "scenario", "vehicle", "code", "physics switches", "requirements", "suite", "baseline"}
    assert names | {"flight three seconds", "suite: flight", "overrides"} <= set(verdict["hashes"])
    assert all(re.fullmatch(r"[0-9a-f]{64}", text) and text in page for text in verdict["hashes"].values())
    before = verdict["hashes"]
    Path("mine.toml").write_text(SHORT.replace("3.0", "2.0"))
    main(["ksr3-robust", "--suite", "mine.toml", "--out", "out", "--no-pack"])
    after = json.loads(Path("out/verdict.json").read_text())["hashes"]
    assert {n for n in before if before[n] != after[n]} == {"suite", "suite: flight", "flight three seconds"}
