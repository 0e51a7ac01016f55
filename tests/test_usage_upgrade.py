"""`simrun --upgrade FILE` converts designs, cases and suites of schema 1 to the present format.

| case | expected |
|---|---|
| designs, cases, suites of schema 1 with comments | the present keys, every other byte unchanged |
| keys in `unset` and in the changes of a design | likewise; an obsolete key is removed |
| a document whose keys are written in an unusual way | the same document, without its comments, which is reported |
| a file of schema 2 | unchanged |
| a log and a scenario text of schema 1 | readable without conversion |
| a file that cannot be converted | one line, exit code 2, the file unchanged |
"""

from __future__ import annotations

import stat
import tomllib
from pathlib import Path

import pytest

from maxq import ScenarioError
from maxq.design.case.basis import stated_basis
from maxq.design.case.schema import read_case
from maxq.design.verify.suite import read_suite
from maxq.sim.scenario.loader import load_scenario, load_scenario_text
from maxq.tools import simdesign, simrun, simverify

Printed = pytest.CaptureFixture[str]
DESIGN = """\
# Written by simdesign, long ago.
schema = 1   # of its format
name = "old"
vehicle = "KSR-III (reconstruction)"

[gains]  # limits = none of them here
table = [
    { time_s = 5.0, k_p = 1.078, k_d_s = 0.481 },
    { time_s = 55.0, k_p = 0.738, k_d_s = 0.329 },
]

[limits]  # customary
gain_margin_db = 6.0
rigid_hz = { time_s = [5.0, 55.0], value = [0.5, 0.4] }
rigid_body = "aerodynamic"

[[stage]]
limits.phase_margin_deg = 31.0  # of the only stage
"""
CASE = """\
schema = 1
extends = "ksr3-robust"   # built in
[limits]
higher_modes_db = -11.0   # modes 3 and above
[robust]
limits = { higher_modes_db = -5.0, gain_margin_db = 3.0 }
"""
SUITE = """\
schema = 1
extends = "launcher"
scenario = "nominal"
limit_wind = "winds/anheung-november.csv"

[margins.nominal]
phase_deg = 31.0     # rigid crossings
aero_gain_db = 5.5
  higher_modes_db=-7.0
[margins.dispersed]
phase_deg = 14.0
"""


@pytest.fixture(autouse=True)
def _in_an_empty_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


def upgrade(name: str, text: str | None, capsys: Printed) -> tuple[int, str, str]:
    """Write a file and upgrade it; return the exit code, output and error."""
    if text is not None:
        Path(name).write_text(text)
    code = simrun.main(["--upgrade", name])
    printed = capsys.readouterr()
    return code, printed.out, printed.err


def test_a_design(capsys: Printed) -> None:
    code, said, _ = upgrade("old.toml", DESIGN, capsys)
    assert code == 0
    assert said.splitlines()[:2] == ["old.toml: upgraded", "  schema is now 2"]
    assert said.splitlines()[2:] == ["  limits is now basis.limits", "  stage.0.limits is now basis.limits"]
    expected = DESIGN.replace("schema = 1", "schema = 2").replace("[limits]", "[basis.limits]")
    expected = expected.replace("limits.phase_margin_deg", "basis.limits.phase_margin_deg")
    assert Path("old.toml").read_text().replace("basis.limits = none", "limits = none") == expected
    design = load_scenario("nominal", ['design="old.toml"']).design
    assert design is not None
    whole, stage = stated_basis(design.model_copy(update={"stage": ()})), stated_basis(design)
    assert whole is not None
    assert stage is not None
    assert (whole.limits.asked, whole.limits.rigid_body) == (("gain_margin_db", "rigid_hz"), "aerodynamic")
    assert (stage.limits.asked, stage.limits.phase_margin_deg) == (("phase_margin_deg",), 31.0)
    assert [path.name for path in Path().iterdir()] == ["old.toml"]


def test_a_case(capsys: Printed) -> None:
    code, said, _ = upgrade("old.toml", CASE, capsys)
    assert (code, said.count("modes_from_3_db")) == (0, 2)
    expected = CASE.replace("schema = 1", "schema = 2").replace("higher_modes_db", "modes_from_3_db")
    assert Path("old.toml").read_text() == expected
    case = read_case("old.toml").case
    assert case.robust is not None
    assert (case.limits.modes_from_3_db, case.robust.limits.modes_from_3_db) == (-11.0, -5.0)


def test_a_default_that_has_changed_is_written(capsys: Printed) -> None:
    case = '# mine\nschema = 1  # old\nscenario = "nominal"\n\n[limits]\nrigid_hz = 0.4\n'
    code, said, _ = upgrade("old.toml", case, capsys)
    assert (code, said.splitlines()[-1]) == (0, "  between_nodes is given, 'ignore', which was the default")
    expected = case.replace("schema = 1  # old\n", 'schema = 2  # old\nbetween_nodes = "ignore"\n')
    assert Path("old.toml").read_text() == expected
    assert read_case("old.toml").case.between_nodes == "ignore"


def test_a_suite(capsys: Printed) -> None:
    Path("old.toml").write_text(SUITE)
    Path("old.toml").chmod(0o640)
    code, said, _ = upgrade("old.toml", None, capsys)
    assert (code, len(said.splitlines())) == (0, 6)
    changes = {"schema = 1": "schema = 2", "phase_deg": "rigid_phase_deg", "aero_gain_db": "gain_down_db"}
    expected = SUITE
    for old, new in (changes | {"higher_modes_db": "modes_from_2_db"}).items():
        expected = expected.replace(old, new)
    assert Path("old.toml").read_text() == expected
    assert stat.S_IMODE(Path("old.toml").stat().st_mode) == 0o640
    margins = read_suite("old.toml").suite.margins
    assert margins is not None
    assert (margins.nominal.rigid_phase_deg, margins.dispersed.rigid_phase_deg) == (31.0, 14.0)
    assert (margins.nominal.gain_down_db, margins.nominal.modes_from_2_db) == (5.5, -7.0)


def test_a_design_in_a_scenario(capsys: Printed) -> None:
    text = 'schema = 1\nextends = "nominal"\n' + DESIGN.partition("[gains]")[2].join(["[design.gains]", ""])
    text = text.replace("\n[limits]", "\n[design.limits]").replace("[[stage]]", "[[design.stage]]")
    code, said, _ = upgrade("old.toml", text, capsys)
    assert (code, said.splitlines()[1]) == (0, "  design.limits is now basis.limits")
    design = load_scenario("old.toml").design
    assert design is not None
    assert design.basis == {
        "limits": tomllib.loads(DESIGN)["limits"] | {"rigid_hz": design.basis["limits"]["rigid_hz"]}
    }
    assert tomllib.loads(Path("old.toml").read_text())["schema"] == 1, "scenarios are of schema 1 still"


def test_keys_in_quotes_cost_the_comments(capsys: Printed) -> None:
    text = DESIGN.replace("[limits]", '["limits"]')
    code, said, _ = upgrade("old.toml", text, capsys)
    assert (code, said.splitlines()[-1]) == (0, "  comments and layout are lost")
    found, old = tomllib.loads(Path("old.toml").read_text()), tomllib.loads(text)
    assert found["basis"] == {"limits": old.pop("limits")}
    assert found["stage"] == [{"basis": {"limits": {"phase_margin_deg": 31.0}}}]
    assert {key: found[key] for key in ("name", "vehicle", "gains")} == {
        k: old[k] for k in ("name", "vehicle", "gains")
    }


OLD_PATHS = {
    "append": (
        'extends = "designs/ksr3-default"\n[[append.stage]]\nlimits = { phase_margin_deg = 31.0 }  # mine\n'
        "[[append.gains.table]]\ntime_s = 60.0\n",
        'extends = "designs/ksr3-default"\n[[append.stage]]\nbasis.limits = { phase_margin_deg = 31.0 }  # mine\n'
        "[[append.gains.table]]\ntime_s = 60.0\n",
        ["append.stage.0.limits is now basis.limits"],
    ),
    "unset": (
        'extends = "ksr3-robust"  # mine\nunset = [\n    "limits.higher_modes_db",  # of modes 3 and above\n'
        '    \'robust.limits.higher_modes_db\', "objective.band", "search.seed",\n]\n',
        'extends = "ksr3-robust"  # mine\nunset = [\n    "limits.modes_from_3_db",  # of modes 3 and above\n'
        "    'robust.limits.modes_from_3_db', \"search.seed\",\n]\n",
        [
            "unset: limits.higher_modes_db is now limits.modes_from_3_db",
            "unset: robust.limits.higher_modes_db is now robust.limits.modes_from_3_db",
            "unset: objective.band is obsolete",
        ],
    ),
    "obsolete key": (
        'schema = 1\nextends = "ksr3-robust"\n\n[objective]\nband = 0.05  # of a share\nkind = "least-margin"\n',
        'schema = 2\nextends = "ksr3-robust"\n\n[objective]\nkind = "least-margin"\n',
        ["schema is now 2", "objective.band is obsolete"],
    ),
    "obsolete key in a line": (
        'extends = "ksr3-robust"\nobjective = { band = 0.05, kind = "least-margin" }  # mine\n',
        'extends = "ksr3-robust"\nobjective = { kind = "least-margin" }  # mine\n',
        ["objective.band is obsolete"],
    ),
    "obsolete dotted key": (
        'extends = "ksr3-robust"  # mine\nobjective.band = 0.05\nobjective.kind = "least-margin"\n',
        'extends = "ksr3-robust"  # mine\nobjective.kind = "least-margin"\n',
        ["objective.band is obsolete"],
    ),
    "changes of a design": (
        'extends = "nominal"\nunset = ["design.limits", "design.stage.0.limits.rigid_hz"]\n\n'
        "[design_overrides]  # mine\nlimits.gain_margin_db = 5.0\n",
        'extends = "nominal"\nunset = ["design.basis.limits", "design.stage.0.basis.limits.rigid_hz"]\n\n'
        "[design_overrides]  # mine\nbasis.limits.gain_margin_db = 5.0\n",
        [
            "unset: design.limits is now design.basis.limits",
            "unset: design.stage.0.limits.rigid_hz is now design.stage.0.basis.limits.rigid_hz",
            "design_overrides.limits is now basis.limits",
        ],
    ),
}


@pytest.mark.parametrize(("text", "expected", "changes"), OLD_PATHS.values(), ids=OLD_PATHS)
def test_paths_and_obsolete_keys(text: str, expected: str, changes: list[str], capsys: Printed) -> None:
    code, said, _ = upgrade("old.toml", text, capsys)
    assert (code, said.splitlines()) == (0, ["old.toml: upgraded", *(f"  {change}" for change in changes)])
    assert Path("old.toml").read_text() == expected
    assert upgrade("old.toml", None, capsys)[1].startswith("old.toml: nothing to change")


def test_an_obsolete_key_is_answered_by_the_command(capsys: Printed) -> None:
    Path("case.toml").write_text(OLD_PATHS["obsolete dotted key"][0])
    assert simdesign.main(["case.toml"]) == 2
    said = "simdesign: case.toml: objective.band = 0.05: is obsolete; allowed: what simrun --upgrade case.toml writes\n"
    assert capsys.readouterr().err == said


@pytest.mark.parametrize("text", [DESIGN, CASE, SUITE])
def test_a_file_of_the_present_format_is_left_alone(text: str, capsys: Printed) -> None:
    upgrade("old.toml", text, capsys)
    content, before = Path("old.toml").read_bytes(), Path("old.toml").stat()
    assert upgrade("old.toml", None, capsys)[:2] == (0, "old.toml: nothing to change, of schema 2 already\n")
    assert Path("old.toml").read_bytes() == content
    assert Path("old.toml").stat().st_ino == before.st_ino


MISTAKES = {
    "no such file": (None, "none.toml: no such file; allowed: a design, case, suite, scenario or campaign (.toml)"),
    "no TOML": ("[limits\n", "none.toml: is not valid TOML: "),
    "both keys": (
        CASE.replace("higher_modes_db = -11.0", "modes_from_3_db = -9.0\nhigher_modes_db = -11.0"),
        "none.toml: limits.higher_modes_db: is given in addition to modes_from_3_db; allowed: one of them",
    ),
    "later version": (
        DESIGN.replace("schema = 1", "schema = 3"),
        "none.toml: schema = 3: is not a version of the format; allowed: 1 to 2",
    ),
    "of another kind": (
        "[reference]\nlength_m = 2.0\n",
        "none.toml: is not of a kind that has an earlier version; allowed: ",
    ),
    "base that is not there": ('extends = "nowhere"\n[limits]\n', 'none.toml: extends = "nowhere": no such file'),
}


@pytest.mark.parametrize(("text", "said"), MISTAKES.values(), ids=MISTAKES)
def test_mistakes_are_answered_in_one_line(text: str | None, said: str, capsys: Printed) -> None:
    code, out, err = upgrade("none.toml", text, capsys)
    assert (code, out, err.count("\n")) == (2, "", 1)
    assert err.startswith(f"simrun: {said}")
    assert text is None or Path("none.toml").read_text() == text


def test_old_keys_and_versions_are_answered_by_the_command(capsys: Printed) -> None:
    Path("design.toml").write_text(DESIGN)
    Path("case.toml").write_text(CASE)
    Path("suite.toml").write_text(SUITE)
    assert simdesign.main(["analyse", "design.toml", "--no-pictures"]) == 2
    hint = "is now basis.limits; allowed: what simrun --upgrade design.toml writes"
    assert f"simdesign: design.toml: stage.0.limits = {{phase_margin_deg = 31.0}}: {hint}" in capsys.readouterr().err
    assert simdesign.main(["case.toml"]) == 2
    hint = "higher_modes_db = -11.0: is now modes_from_3_db; allowed: what simrun --upgrade case.toml writes"
    assert f"simdesign: case.toml: limits.{hint}" in capsys.readouterr().err
    assert simverify.main(["ksr3-robust", "--suite", "suite.toml"]) == 2
    hint = "phase_deg = 31.0: is now rigid_phase_deg; allowed: what simrun --upgrade suite.toml writes"
    assert f"simverify: suite.toml: margins.nominal.{hint}" in capsys.readouterr().err
    Path("case.toml").write_text(CASE.partition("[limits]")[0])
    with pytest.raises(ScenarioError) as caught:
        read_case("case.toml")
    said = "schema = 1: is an earlier version of the format; allowed: what simrun --upgrade case.toml writes"
    assert str(caught.value) == f"case.toml: {said}"
    with pytest.raises(ScenarioError, match=r"^--set: limits.higher_modes_db = -9: is now modes_from_3_db$"):
        read_case("ksr3-robust", ["limits.higher_modes_db=-9"])


def test_a_scenario_text_of_an_earlier_version_is_read() -> None:
    now = load_scenario("nominal", ['design="designs/ksr3-sampled.toml"'])
    text = now.as_flown
    head, _, below = text.partition("[design]\nschema = 2\n")
    assert below
    old = (head + "[design]\nschema = 1\n" + below).replace("[design.basis.limits]", "[design.limits]")
    kept = [part for part in old.split("\n\n") if not part.startswith("[design.basis]")]
    then = load_scenario_text("\n\n".join(kept)).design
    assert then is not None
    assert now.design is not None
    assert now.design.basis is not None
    assert then == now.design.model_copy(update={"basis": {"limits": now.design.basis["limits"]}})
