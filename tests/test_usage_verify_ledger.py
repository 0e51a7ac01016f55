"""The ledger of attempts and the rule for seeds follow docs/simverify.md, section Records."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import pytest

from maxq.design.verify import ledger, seeds
from maxq.design.verify.seeds import Seed, chosen, registered, seeds_of
from maxq.design.verify.suite import read_suite
from maxq.design.verify.verify import verify
from maxq.sim.campaign.read import load_campaign
from maxq.sim.files import FileError
from maxq.sim.scenario.loader import load_scenario

SHORT = """
schema = 2
[[flight]]
name = "one second"
set = ["run.duration_s=1.0"]
"""


@pytest.fixture(autouse=True)
def _own_ledger(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MAXQ_LEDGER", str(tmp_path / "ledger"))


def _begin(everything: str, vehicle: str = "v", name: str = "KSR-III", **more: Any) -> ledger.Attempt:
    hashes = {"vehicle": vehicle, "suite": "s", "design": "d", "all": everything}
    content = {"design": "mine", "suite": "quick", "part": "", "candidate": 0, "seeds": {}, "command": ""}
    return ledger.begin(name, {**content, "hashes": hashes, **more})


def test_every_attempt_names_the_others_with_their_verdicts() -> None:
    first = _begin("1")
    assert first.title == "attempt 1 for this vehicle"
    first.end("rejected")
    _begin("2").end("rejected")
    assert _begin("3").title == "attempt 3 for this vehicle; 2 earlier ones: REJECTED, REJECTED"
    fourth = _begin("4")  # the third was interrupted
    assert fourth.title == "attempt 4 for this vehicle; 3 earlier ones: REJECTED, REJECTED, NOT ENDED"
    fourth.end("accepted")
    assert _begin("1").title == ("attempt 1 of 4 for this vehicle, repeated; 3 others: REJECTED, NOT ENDED, ACCEPTED")
    _begin("5", part="as designed").end("passed screening")
    assert _begin("6", vehicle="w").title == "attempt 1 for this vehicle; 5 for other versions of KSR-III"
    assert _begin("2").title.endswith("; 1 of part alone; 1 for other versions of KSR-III")


def test_many_verdicts_are_counted() -> None:
    for number in range(7):
        _begin(str(number)).end("rejected" if number else "accepted")
    assert _begin("last").title == "attempt 8 for this vehicle; 7 earlier ones: 1 ACCEPTED, 6 REJECTED"


def test_a_line_that_was_changed_or_removed_is_found() -> None:
    for number in range(3):
        _begin(str(number)).end("rejected")
    path = ledger.ledger_path()
    rows = path.read_text().splitlines()
    assert ledger.read_lines(path)[1] == ()

    def damage(kept: list[str]) -> tuple[str, ...]:
        path.write_text("\n".join(kept) + "\n")
        return ledger.read_lines(path)[1]

    edited = rows[1].replace("rejected", "accepted")
    assert damage([rows[0], edited, *rows[2:]]) == ("line 2 was changed",)
    forged = json.loads(edited)
    forged["hash"] = ledger._hash(forged)  # as one does who knows the format
    assert damage([rows[0], json.dumps(forged), *rows[2:]]) == ("lines before line 3 were removed or changed",)
    assert damage([rows[0], *rows[3:]]) == ("lines before line 2 were removed or changed",)
    assert damage(rows[1:])[0] == "lines before line 1 were removed or changed"
    assert damage([*rows[:2], "{}", *rows[2:]]) == ("line 3 is no line of a ledger",)
    assert damage(rows[:4]) == ()  # its end: nothing can tell
    damage([rows[0], edited, *rows[2:]])
    assert _begin("9").title.endswith("; LEDGER DAMAGED: line 2 was changed")


def test_ledger_is_in_the_data_folder_of_the_user(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("MAXQ_LEDGER")
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path / "data"))
    assert ledger.ledger_path() == tmp_path / "data/maxq/attempts/attempts.jsonl"
    monkeypatch.delenv("XDG_DATA_HOME")
    monkeypatch.setenv("HOME", str(tmp_path))
    assert ledger.ledger_path() == tmp_path / ".local/share/maxq/attempts/attempts.jsonl"


def test_a_copy_of_a_vehicle_under_another_name_continues_its_attempts() -> None:
    """A renamed copy of a vehicle continues its attempts, and no second seed can be registered for it."""
    _begin("1", seeds={"campaign.0": 1}).end("rejected")
    copy = _begin("2", name="Falke")
    assert copy.title == "attempt 2 for this vehicle; 1 earlier one: REJECTED; also under the name KSR-III"
    copy.end("rejected")
    changed = _begin("3", vehicle="w", name="Falke")
    assert changed.title == "attempt 1 for this vehicle; 2 for other versions of Falke; also under the name KSR-III"
    other = _begin("4", vehicle="x", name="Bussard")
    assert other.title == "attempt 1 for this vehicle; further vehicles in the ledger: KSR-III, Falke"
    for name, vehicle in (("Falke", "v"), ("Falke", "w"), ("another", "v")):
        with pytest.raises(ValueError, match="cannot be registered"):
            _register(7, vehicle, name)
    _register(7, "y", "one that was never flown")


def test_the_content_of_a_vehicle_is_that_of_a_renamed_copy(tmp_path: Path) -> None:
    folder = tmp_path / "own"
    shutil.copytree(Path(__file__).parents[1] / "scenarios/vehicles/ksr3", folder)
    file, known = folder / "vehicle.toml", ledger.vehicle_hash(load_scenario("nominal").vehicle)
    text = file.read_text()
    for before, after in (("KSR-III (", "Falke ("), ('"lox"', '"oxidiser"'), ('"mass.csv"', '"m.csv"')):
        assert before in text
        text = text.replace(before, after)
    file.write_text(f"# a comment\n{text}")
    (folder / "mass.csv").rename(folder / "m.csv")
    copy = load_scenario("nominal", [f"vehicle='{folder}'"]).vehicle
    assert copy.name.startswith("Falke")
    assert ledger.vehicle_hash(copy) == known
    file.write_text(text.replace("count_rad = 1.0e-5", "count_rad = 1.1e-5"))
    assert ledger.vehicle_hash(load_scenario("nominal", [f"vehicle='{folder}'"]).vehicle) != known


def test_vehicle_is_the_same_with_other_flight_code() -> None:
    def hash_of(*changes: str) -> str:
        return ledger.vehicle_hash(load_scenario("nominal", changes).scenario.vehicle)

    code = str(Path(__file__).parents[1] / "examples/flight_software/pd_law.py:Autopilot")
    external = ("design=", "vehicle.computer.law=external", f"vehicle.computer.python='{code}'")
    assert hash_of() == hash_of(*external) == hash_of("design='designs/ksr3-free.toml'")
    assert hash_of() != hash_of("vehicle.computer.delay_s=0.004")


@pytest.mark.slow
def test_an_attempt_is_written_before_it_is_flown(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "short.toml").write_text(SHORT)
    loaded = read_suite(tmp_path / "short.toml")
    with pytest.raises(KeyboardInterrupt):
        verify("designs/ksr3-robust.toml", loaded, stop=lambda: True)
    (path,) = (tmp_path / "ledger").glob("*.jsonl")
    (line,) = ledger.read_lines(path)[0]
    assert (line["state"], line["design"]) == ("begun", "designs/ksr3-robust.toml")
    assert line["command"] == f"simverify ksr3-robust --suite {tmp_path / 'short.toml'}"
    found = verify("designs/ksr3-robust.toml", loaded)
    assert found.attempt.title == "attempt 1 of 1 for this vehicle, repeated"
    assert [line["state"] for line in ledger.read_lines(path)[0]] == ["begun", "begun", "ended"]
    path.write_text(path.read_text().replace("begun", "began", 1))
    damaged = verify("designs/ksr3-robust.toml", loaded)
    assert "the ledger of attempts is damaged: line 1 was changed" in damaged.missing_evidence
    monkeypatch.setenv("MAXQ_LEDGER", str(tmp_path / "short.toml" / "below"))
    with pytest.raises((FileError, OSError), match=r"short\.toml"):  # no verdict without its line
        verify("designs/ksr3-robust.toml", loaded)


def _seeds(suite: str, *overrides: str, candidate: int = 0) -> dict[str, str]:
    loaded = read_suite(suite, overrides)
    campaigns = [load_campaign(wanted.file, wanted.set) for wanted in loaded.suite.campaign]
    given = [wanted.seed for wanted in loaded.suite.campaign]
    flown = [c if s is None else c.with_campaign(seed=s) for c, s in zip(campaigns, given, strict=True)]
    flights = {f.name: load_scenario(f.scenario or loaded.suite.scenario, f.set) for f in loaded.suite.flight[:1]}
    return {seed.of: seed.how for seed in seeds_of(loaded, read_suite(loaded.baseline), flights, flown, candidate)}


@pytest.mark.parametrize("name", ["standard", "quick", "ksr3-ringed"])
def test_seeds_of_shipped_suites_are_declared(name: str) -> None:
    assert set(_seeds(name).values()) == {"declared"}


@pytest.mark.parametrize(
    ("change", "of"),
    [
        ("campaign.0.seed=7", "campaign.0"),
        ("campaign.0.seed=1", "campaign.0"),  # the default: the baseline has another
        ("campaign.0.set=['run.seed=2']", "campaign.0 run"),
        ("margins.seed=2", "margins"),
        ("margins.worst.seed=2", "margins.worst"),
        ("flight.0.set=['run={seed=5}']", "flight 'nominal' run"),
    ],
)
def test_a_seed_that_differs_from_the_declared_one_is_chosen_by_hand(change: str, of: str) -> None:
    found = _seeds("standard", change)
    assert [name for name, how in found.items() if how == "chosen by hand"] == [of]


def test_seed_of_a_suite_without_a_campaign_in_its_baseline_is_that_of_its_file(tmp_path: Path) -> None:
    suite = tmp_path / "own.toml"
    suite.write_text('schema = 2\nextends = "launcher"\nscenario = "nominal"\n[[campaign]]\nfile = "campaigns/ksr3"\n')
    assert _seeds(str(suite))["campaign.0"] == "declared"
    (tmp_path / "own-campaign.toml").write_text('extends = "campaigns/ksr3"\n[campaign]\nseed = 5\n')
    suite.write_text('schema = 2\nextends = "launcher"\n[[campaign]]\nfile = "own-campaign.toml"\n')
    assert _seeds(str(suite))["campaign.0"] == "chosen by hand"


def test_a_baseline_that_is_not_shipped_declares_no_seed(tmp_path: Path) -> None:
    """Only a shipped baseline declares a seed, since an author could otherwise choose the best of many."""
    suite = tmp_path / "own.toml"
    suite.write_text('schema = 2\nbaseline = "own.toml"\n[[campaign]]\nfile = "campaigns/ksr3"\nseed = 7\n')
    assert _seeds(str(suite))["campaign.0"] == "chosen by hand"


def _known(vehicle: str = "v", name: str = "KSR-III") -> list[ledger.Line]:
    return ledger.lines_of(ledger.read_lines(ledger.ledger_path())[0], name, vehicle)


def _how(value: int, declared: int = 1) -> str:
    seed = Seed("campaign.0", value, declared, seeds.DECLARED if value == declared else seeds.BY_HAND)
    return chosen([seed], _known(), "d")[0].how


def _register(value: int, vehicle: str = "v", name: str = "KSR-III") -> None:
    by_hand = [Seed("campaign.0", value, 1, seeds.BY_HAND)]
    line = registered(by_hand, _known(vehicle, name), vehicle)
    ledger.append(ledger.ledger_path(), {"vehicle": name, **line})


def test_a_seed_registered_before_any_flight_replaces_the_declared_one() -> None:
    """The registered seed replaces the declared one; with both, 16.5 % of 200 vehicles at the limit were accepted."""
    assert (_how(7), _how(1)) == ("chosen by hand", "declared")
    _register(7)
    _begin("1", seeds={"campaign.0": 7})
    assert _how(7).startswith("registered on 20")
    assert (_how(8), _how(1)) == ("replaced by the registered seed 7",) * 2
    with pytest.raises(ValueError, match=r"^seed 8 of campaign\.0 cannot be registered for this vehicle: an attempt"):
        _register(8)
    assert seeds.missing([Seed("campaign.0", 8, 1, seeds.BY_HAND), Seed("margins", 1, 1)]) == [
        "seed 8 of campaign.0 chosen by hand, not registered before"
    ]
    assert seeds.missing([Seed("campaign.0", 1, 1, _how(1))]) == [
        "seed 1 of campaign.0 replaced by the registered seed 7"
    ]


def test_no_seed_is_registered_after_a_flight_also_of_a_changed_vehicle() -> None:
    """A vehicle with one changed digit cannot register a seed of its own after a flight."""
    _begin("1", seeds={"campaign.0": 1})
    for vehicle in ("v", "w"):
        with pytest.raises(ValueError, match="cannot be registered"):
            _register(7, vehicle)
    assert (_how(7), _how(1)) == ("chosen by hand", "declared")


def test_seeds_of_noise_count_as_flown_where_an_attempt_does_not_record_them() -> None:
    _begin("1", seeds={"campaign.0": 1})
    noise = Seed("flight 'nominal' wind.turbulence", 5, 1, seeds.BY_HAND)
    with pytest.raises(ValueError, match="cannot be registered"):
        registered([noise], _known(), "v")


def test_seeds_that_simdesign_assigns_count_for_their_design() -> None:
    found = _seeds("standard", "campaign.0.seed=20021130", "margins.seed=3", candidate=2)
    assert [how for how in found.values() if how != "declared"] == ["assigned to candidate 2"] * 2
    assert "chosen by hand" in _seeds("standard", "campaign.0.seed=20021130", candidate=1).values()
    _begin("1", seeds={"campaign.0": 20021130}, candidate=2)
    lines = _known()
    seed = Seed("campaign.0", 20021130, 20021128, seeds.BY_HAND)
    assert chosen([seed], lines, "d")[0].how == "assigned to candidate 2"
    assert chosen([seed], lines, "another design")[0].how == "chosen by hand"
