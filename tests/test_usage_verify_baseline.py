"""The first page lists each difference of a suite from its baseline; a copy has none."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path

import petrelkit as petrel
import pytest

from maxq.design.verify.baseline import SuiteDifference, accepting_baseline, against_baseline
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


@pytest.mark.slow
@pytest.mark.parametrize("name", builtin_files("suite"))
def test_a_shipped_suite_is_its_own_baseline(name: str) -> None:
    if name == "petrel":
        Path("petrel").symlink_to(petrel.folder())
    compared = against_baseline(read_suite(name))
    assert compared.title == f"no differences from the shipped suite {name}"
    assert compared.hashes["suite"] == compared.hashes["baseline"]


@pytest.mark.slow
def test_a_copy_under_another_name_differs_in_nothing() -> None:
    text = (scenarios_folder() / "suites/standard.toml").read_text()
    Path("board.toml").write_text(f'name = "of the board"\n{text}'.replace('extends = "launcher"', ""))
    Path("whole.toml").write_text(text)
    found = against_baseline(read_suite("whole.toml"))  # it extends the shipped launcher
    assert found.baseline == "launcher"
    assert against_baseline(read_suite("whole.toml", ["baseline=standard"])).differences == ()
    assert against_baseline(read_suite("board.toml")).baseline == "standard"


@pytest.mark.slow
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
    """A suite that is `standard` with slosh and bending off has these switches first in the list."""
    every = ["run.stop_at=['burnout','impact']", "switches.slosh=false", "switches.bending=false"]
    Path("off.toml").write_text(f'schema = 2\nextends = "standard"\nevery = {json.dumps(every)}\n')
    assert _differences("off.toml") == [
        "physics switched off: 46 flights: switches.slosh, none -> false",
        "physics switched off: 46 flights: switches.bending, none -> false",
    ]


@pytest.mark.slow
def test_a_design_in_place_of_the_judged_one_is_named() -> None:
    design = "['design=\"designs/ksr3-robust.toml\"']"
    what = "design in place of the judged one, none -> designs/ksr3-robust.toml"
    found = [text for text in _differences("quick", f"every={design}") if "design" in text]
    assert found == [f"changed: 3 flights: {what}"]
    found = [text for text in _differences("standard", f"campaign.0.set={design}") if "design" in text]
    assert found == [f"changed: campaign 1: {what}"]


@pytest.mark.slow
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
    assert re.fullmatch(r"wind weaker: limit_wind\.speed_mps, 27 values, \w{8} -> 27 values, \w{8}", found)
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
    """Smaller standard deviations of factors and air are listed; larger ones and those in vehicle units are not."""
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


@pytest.mark.slow
def test_an_agreed_baseline_is_named_as_not_shipped() -> None:
    Path("agreed.toml").write_text(SHORT)
    Path("mine.toml").write_text(f'baseline = "agreed.toml"\n{SHORT}'.replace("3.0", "2.0"))
    compared = against_baseline(read_suite("mine.toml"))
    shipped = against_baseline(read_suite("mine.toml", ["baseline=standard"]))
    assert (
        compared.title == f"1 difference from the suite {Path('agreed.toml').resolve()}, not shipped; {shipped.title}"
    )
    assert compared.differences == (SuiteDifference("shortened", "flight three seconds: run.duration_s", "3", "2"),)


@pytest.mark.slow
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


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ("margins.nominal.gain_up_db=0.001", "limit loosened: margins.nominal.gain_up_db, 6 -> 0.001"),
        ("margins.trajectories=0", "level or number lowered: margins.trajectories, 20 -> 0"),
        ("campaign.0.set=['wind_model=']", "removed: campaign 1 wind_model"),
        ("campaign.0.set=['requirement.0.limit=1e9']", "limit loosened: campaign 1: scenario.requirement."),
        (
            "flight.13.set=['vehicle.stage.0.actuator.backlash_deg=0']",
            "changed: flight delay: vehicle.stage.0.actuator.backlash_deg, none -> 0",
        ),
        ("campaign.0.set=['vehicle.computer.delay_s=0.0']", "changed: campaign 1: scenario.vehicle.computer.delay_s"),
        (
            "every=['run.stop_at=[\"liftoff\"]']",
            "changed: 46 flights: run.stop_at, ['burnout', 'impact'] -> ['liftoff']",
        ),
        ("campaign.0.runs=1104", ""),
    ],
)
def test_what_is_looser_than_the_baseline_bars_an_acceptance(change: str, said: str) -> None:
    loosened = against_baseline(read_suite("standard", [change])).loosened
    assert loosened.startswith(f"looser than the suite standard: {said}") if said else loosened == ""


def test_a_changed_vehicle_is_judged_and_bars_nothing() -> None:
    """A changed vehicle is judged also in campaigns that fly the suite's change, and blocks no verdict."""
    vehicle = "vehicle.computer.delay_s=0.004"
    Path("changed.toml").write_text('extends = "nominal.toml"\n[vehicle_overrides.computer]\ndelay_s = 0.004\n')
    found = against_baseline(read_suite("standard", ["scenario=changed.toml", f"campaign.0.set=['{vehicle}']"]))
    of_vehicle = [one.what for one in found.differences]
    assert of_vehicle == ["scenario.vehicle.computer.delay_s", "campaign 1: scenario.vehicle.computer.delay_s"]
    assert found.loosened == ""


def test_a_weaker_wind_of_the_same_vehicle_bars_an_acceptance() -> None:
    rows = (scenarios_folder() / "winds/anheung-november.csv").read_text().splitlines()
    head = next(n for n, row in enumerate(rows) if not row.startswith("#"))
    every = [row.split(",") for row in rows[head + 1 :]]
    calm = [",".join([altitude, repr(0.1 * float(speed)), *more]) for altitude, speed, *more in every]
    Path("calm.csv").write_text("\n".join([rows[head], *calm]))
    found = against_baseline(read_suite("standard", ["limit_wind=calm.csv"]))
    assert found.loosened.startswith("looser than the suite standard: wind weaker: limit_wind.speed_mps, ")


def test_an_agreed_baseline_permits_what_it_loosens_and_is_named_with_its_hash() -> None:
    text = 'schema = 2\nextends = "standard"\n[margins.nominal]\ngain_up_db = 0.1\n'
    Path("agreed.toml").write_text(text)
    Path("mine.toml").write_text(f'baseline = "agreed.toml"\n{text}')
    found = against_baseline(read_suite("mine.toml"))
    assert found.loosened == ""
    assert found.agreed == (
        f"agreed baseline {Path('agreed.toml').resolve()}, SHA-256 {found.hashes['baseline'][:16]}, not shipped; "
        "looser than the suite standard: limit loosened: margins.nominal.gain_up_db, 6 -> 0.1"
    )
    assert against_baseline(read_suite("standard")).agreed == ""


def test_a_suite_that_extends_quick_is_accepted_by_the_rules_of_standard() -> None:
    """Compared with `quick` alone, it has no difference that loosens it, and the rules of `standard` apply."""
    Path("mine.toml").write_text('schema = 2\nextends = "quick"\n[[campaign]]\nfile = "campaigns/ksr3"\n')
    loaded = read_suite("mine.toml")
    assert (loaded.baseline, against_baseline(loaded).loosened) == ("quick", "")
    assert accepting_baseline(loaded, "any") == "standard"
    loosened = against_baseline(replace(loaded, baseline="standard")).loosened
    assert loosened.startswith("looser than the suite standard: removed: 4")


def test_a_suite_of_another_vehicle_on_launcher_is_not_looser() -> None:
    """A suite of `simvehicle`, with the end of its flights, has the levels of the floor and is not looser."""
    Path("other.toml").write_text('extends = "nominal.toml"\nunset = ["design"]\n[vehicle_overrides]\nname = "other"\n')
    Path("mine.toml").write_text(
        'schema = 2\nextends = "launcher"\nscenario = "other.toml"\nlimit_wind = "winds/anheung-november.csv"\n'
        """every = ["run.stop_at=['burnout','impact']"]\n[certificate]\nnodes_per_stage = 2\n"""
        '[margins]\nnodes_per_stage = 7\ncases = 60\nsuccess = 0.95\n[[campaign]]\nfile = "campaigns/ksr3"\n'
    )
    assert against_baseline(read_suite("mine.toml")).loosened == ""


def test_launcher_accepts_the_vehicle_of_standard_by_the_winds_and_deviations_of_standard() -> None:
    Path("mine.toml").write_text('schema = 2\nextends = "launcher"\nscenario = "nominal"\n')
    loaded = read_suite("mine.toml")
    assert accepting_baseline(loaded, "KSR-III (reconstruction)") == "standard"
    assert accepting_baseline(loaded, "petrel") == "launcher"
    assert accepting_baseline(read_suite("standard"), "petrel") == "standard"


@pytest.mark.slow
def test_terminal_page_and_verdict_show_the_differences_and_hash_everything(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("maxq.design.verify.memory.default_folder", lambda: tmp_path / "memory")
    Path("mine.toml").write_text(SHORT)
    assert main(["ksr3-robust", "--suite", "mine.toml", "--out", "out"]) == 0
    said = capsys.readouterr().out
    assert re.search(r"^baseline: \d+ differences from the shipped suite standard$", said, re.MULTILINE)
    assert re.search(r"^  removed +46 flights: nominal; limit wind; ", said, re.MULTILINE)
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
