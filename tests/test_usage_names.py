"""Built-in names mean the shipped files in every working folder; a path names a user's file."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from maxq.design.laws.design_file import design_path
from maxq.design.verify.flown import load_flight
from maxq.design.verify.suite import read_suite
from maxq.sim.input.files import NameNote, builtin_files, locate, scenarios_folder
from maxq.sim.scenario.loader import load_scenario
from maxq.tools.simverify import main

WIND = "winds/anheung-november.csv"
WEAK = """
schema = 2
[[flight]]
name = "one second"
set = ["run.duration_s=1.0"]
"""


@pytest.fixture(autouse=True)
def _in_an_empty_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


def _calm() -> None:
    """Write a wind table with the shipped one's name and a tenth of its speed to the working folder."""
    Path("winds").mkdir()
    rows = [line for line in (scenarios_folder() / WIND).read_text().splitlines() if not line.startswith("#")]
    cells = [row.split(",") for row in rows[1:]]
    Path(WIND).write_text("\n".join([rows[0], *(f"{a},{float(v) / 10.0},{d}" for a, v, d in cells)]))


@pytest.mark.parametrize("file", ["standard", "standard.toml"])
def test_a_file_called_standard_replaces_no_shipped_suite(file: str) -> None:
    shipped = read_suite("standard").suite
    Path(file).write_text(WEAK)
    with pytest.warns(NameNote, match=rf"^standard is the one that comes with maxq; the other file is \./{file}$"):
        assert read_suite("standard").suite == shipped
    for name in (f"./{file}", os.path.abspath(file)):
        assert [f.name for f in read_suite(name).suite.flight] == ["one second"]


def test_a_name_with_a_suffix_is_the_users_file_where_there_is_one() -> None:
    assert len(read_suite("standard.toml").suite.flight) > 1
    Path("standard.toml").write_text(WEAK)
    assert len(read_suite("standard.toml").suite.flight) == 1


def test_a_suite_extends_the_shipped_one_whatever_is_in_its_folder() -> None:
    Path("launcher.toml").write_text(WEAK)
    Path("standard.toml").write_text('schema = 2\nextends = "standard"\n')
    assert (
        read_suite("./standard.toml").suite.flight
        == read_suite(scenarios_folder() / "suites/standard.toml").suite.flight
    )


@pytest.mark.parametrize("suite", ["quick", pytest.param("standard", marks=pytest.mark.long)])
def test_a_folder_of_winds_replaces_no_wind_of_a_shipped_suite(suite: str) -> None:
    def winds() -> list[str]:
        loaded = read_suite(suite)
        texts = []
        for flight in loaded.suite.flight:
            sets = tuple(text.replace("$limit_wind", str(loaded.suite.limit_wind)) for text in flight.set)
            plain = {"set": tuple(text for text in sets if "$" not in text and "*" not in text), "limits": "own"}
            texts.append(
                load_flight(loaded, flight.model_copy(update=plain), "designs/ksr3-robust.toml", None)[0].as_flown
            )
        return texts

    before = winds()
    _calm()
    with pytest.warns(NameNote, match=f"^{WIND} is the one that comes with maxq; the other file is ./{WIND}$"):
        assert winds() == before


def test_an_override_names_a_file_here_by_a_path() -> None:
    def fastest(name: str) -> float:
        profile = load_scenario("nominal", [f"wind.profile='{name}'"]).scenario.wind.profile
        assert profile is not None
        return float(profile["speed_mps"].max())

    shipped = fastest(WIND)
    _calm()
    with pytest.warns(NameNote):
        assert fastest(WIND) == shipped
    for name in (f"./{WIND}", os.path.abspath(WIND)):
        assert fastest(name) == pytest.approx(shipped / 10.0)
    loaded = read_suite("standard", [f"limit_wind=./{WIND}"])
    assert fastest(str(loaded.suite.limit_wind)) == pytest.approx(shipped / 10.0)
    with pytest.warns(NameNote):
        assert read_suite("standard", [f"limit_wind={WIND}"]).suite.limit_wind == WIND


def test_a_suite_names_files_of_its_folder_by_paths_and_shipped_ones_by_names() -> None:
    _calm()
    Path("nominal.toml").write_text('extends = "nominal.toml"\n')
    text = f'schema = 2\nscenario = "{{}}"\nlimit_wind = "{WIND}"\n[[flight]]\nname = "a"\n'
    Path("mine.toml").write_text(text.format("nominal.toml"))
    mine = read_suite("mine.toml").suite
    assert (mine.scenario, mine.limit_wind) == ("./nominal.toml", f"./{WIND}")
    Path("mine.toml").write_text(text.format("nominal"))
    with pytest.warns(NameNote, match="^nominal is"):
        assert read_suite("mine.toml").suite.scenario == "nominal"


def test_designs_cases_and_scenarios_of_shipped_names() -> None:
    Path("ksr3-robust").mkdir()
    Path("ksr3-robust/design.toml").write_text("")
    with pytest.warns(NameNote, match=r"ksr3-robust is .* \./ksr3-robust/design\.toml$"):
        assert design_path("ksr3-robust") == "designs/ksr3-robust.toml"
    assert design_path("designs/ksr3-robust.toml") == design_path("ksr3-robust.toml") == "designs/ksr3-robust.toml"
    assert design_path("./ksr3-robust") == os.path.abspath("ksr3-robust/design.toml")
    for role, name in (
        ("scenario", "nominal"),
        ("scenario", "campaigns/ksr3"),
        ("case", "ksr3-robust"),
        ("layout", "petrel"),
    ):
        path = Path(f"{name}.toml")
        path.parent.mkdir(exist_ok=True)
        path.write_text("")
        known = builtin_files(role) | builtin_files("campaign")
        with pytest.warns(NameNote):
            assert locate(name, role)[0] == known[name]
        assert locate(f"{name}.toml", role)[0] == path.resolve()


def test_a_command_says_once_which_file_it_uses(capsys: pytest.CaptureFixture[str]) -> None:
    Path("quick").write_text(WEAK)
    assert main(["ksr3-robust", "--suite", "quick", "--only", "no such part"]) == 2
    said = capsys.readouterr().err.splitlines()
    assert said[0] == "simverify: note: quick is the one that comes with maxq; the other file is ./quick"
    assert len(said) == 2
    assert "no such part" in said[1]
