"""Case files have their allowed keys and values, and errors name what is wrong."""

from __future__ import annotations

from pathlib import Path

import petrelkit as petrel
import pytest

from maxq import ScenarioError
from maxq.design.case.schema import read_case
from maxq.design.optimise.solve import solve
from maxq.sim.input.files import builtin_files


def test_built_in_cases_are_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "petrel").symlink_to(petrel.folder())  # as `simvehicle petrel --out petrel` leaves it
    monkeypatch.chdir(tmp_path)
    assert {"ksr3-identical", "ksr3-relaxed", "ksr3-robust"} <= set(builtin_files("case"))
    for name in builtin_files("case"):
        loaded = read_case(name)
        assert loaded.name == name
        assert loaded.case.description
        assert loaded.case.between_nodes == "ignore"  # designed at the nodes that it states


def test_a_case_of_a_vehicle_not_yet_written_says_how_to(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ScenarioError, match="no such file; allowed: what 'simvehicle petrel --out petrel' writes here"):
        read_case("petrel-robust")


def test_relaxed_limits_extend_the_identical_ones() -> None:
    identical, relaxed = read_case("ksr3-identical").case, read_case("ksr3-relaxed").case
    assert (identical.limits.rigid_hz, identical.limits.rigid_zeta) == (0.5, 0.7)
    assert (relaxed.limits.rigid_hz, relaxed.limits.rigid_zeta) == (0.48, 0.68)
    assert identical.reference == relaxed.reference
    assert identical.limits.gain_margin_db == relaxed.limits.gain_margin_db == 6.0


@pytest.mark.slow
def test_a_new_case_holds_between_its_nodes(tmp_path: Path) -> None:
    """The limits hold also for a single operating point, which has no instants between, and for simvehicle's case."""
    mine = tmp_path / "mine.toml"
    mine.write_text('scenario = "nominal"\nfilter = {structure = "F2"}\nsearch = {starts = 1, leaps = 0}\n')
    instants = []
    for nodes in ("[45.0]", "[45.0, 47.0]"):
        loaded = read_case(mine, [f"nodes_s={nodes}"])
        assert loaded.case.between_nodes == "hold"
        instants.append(solve(loaded).certificate.instants)
    assert instants[0] == 1
    assert instants[1] >= 9  # a quarter of a second apart
    assert read_case(petrel.folder() / "case.toml").case.between_nodes == "hold"


def test_overrides_and_a_file_of_ones_own(tmp_path: Path) -> None:
    mine = tmp_path / "mine.toml"
    mine.write_text('extends = "ksr3-identical"\n[filter]\nstructure = "F6"\n', encoding="utf-8")
    case = read_case(mine, ["limits.gain_margin_db=7", "gains.schedule=free"]).case
    assert case.name == "mine"
    assert case.filter.sections == (2, 2)
    assert case.limits.gain_margin_db == 7.0
    assert case.gains.schedule == "free"


@pytest.mark.parametrize(
    ("override", "said"),
    [
        ("filter.structure=F7", "is not one of the choices"),
        ("filter.strukture=F4", "did you mean structure?"),
        ("limits.gain_margin_db=nan", "is not finite"),
        ("limits.gain_margin_db=-1", "is out of range"),
        ("limits.phase_margin_deg=200", "is out of range"),
        ("filter.bounds.pole_zeta=[-0.1, 1.0]", "unstable"),
        ("filter.bounds.zero_zeta=[-0.1, 1.0]", "right-half-plane"),
        ("filter.bounds.pole_hz=[10.0, 5.0]", "is empty"),
        ("filter.quadratic=3", 'this key with structure = "sections" only'),
        ("nodes_s=[5.0, 5.0]", "does not rise"),
        ("nodes_s=[]", "does not rise"),
        ("gains.schedule=nodes", "required key is missing"),
        ("gains.nodes_s=[5.0]", 'this key with schedule = "nodes" only'),
        ("search.starts=0", "is out of range"),
        ("limits.without=['modulus_db']", "is not one of the choices"),
        ("limits.rigid_hz={time_s=[5.0,4.0],value=[0.3,0.5]}", "does not rise"),
        ("limits.rigid_hz={time_s=[5.0],value=[0.3,0.5]}", "has 2 numbers"),
        ("limits.rigid_hz=[0.3]", "has the wrong type"),
        (
            "limits.rigid_hz={time_s=[5.0],values=[0.3]}",
            "limits.rigid_hz.values = [0.3]: unknown key; did you mean value?",
        ),
        ("limits.rigid_hz={time_s=[5.0],value=[0.3],unit=1}", "unit = 1: unknown key; allowed: time_s, value"),
        ("limits.rigid_hz={time_s=[5.0],value=[-0.3]}", "value.0 = -0.3: is out of range; allowed: a number > 0"),
        ("limits.bending_moment=[{station_m=8.1,rms_Nm=900}]", "needs a wind"),
        ("objective.stations_m=[8.1]", 'this key with kind = "bending-moment" only'),
        ("robust.bending_slope=1.5", "is out of range"),
        ("scenario=nominl", "did you mean nominal?"),
    ],
)
def test_mistakes_are_answered_in_one_line(override: str, said: str) -> None:
    with pytest.raises(ScenarioError) as caught:
        read_case("ksr3-identical", [override])
    line = str(caught.value)
    assert said in line
    assert "\n" not in line
    assert override.partition("=")[0].split(".")[0] in line


def test_a_name_that_is_none() -> None:
    with pytest.raises(ScenarioError, match="did you mean ksr3-identical"):
        read_case("ksr3-identicl")
    with pytest.raises(ScenarioError, match="no such file"):
        read_case("")


def test_files_that_extend_each_other(tmp_path: Path) -> None:
    (tmp_path / "a.toml").write_text('extends = "b"\n', encoding="utf-8")
    (tmp_path / "b.toml").write_text('extends = "a"\n', encoding="utf-8")
    with pytest.raises(ScenarioError, match="in a loop"):
        read_case(tmp_path / "a.toml")
