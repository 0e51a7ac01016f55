"""`simdesign analyse` and `simdesign errata` print, write and return their results."""

from __future__ import annotations

import json
import math
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from maxq.design.laws import design_file
from maxq.design.laws.registry import designed_law
from maxq.sim.files import write_whole
from maxq.sim.input.files import builtin_files
from maxq.sim.run.fly import fly
from maxq.sim.scenario.loader import load_scenario
from maxq.sim.scenario.schema_design import Design
from maxq.tools import simdesign

Printed = pytest.CaptureFixture[str]
ROOT = Path(__file__).parents[1]
QUICK = ["--no-pictures", "--at", "40"]


@pytest.fixture(autouse=True)
def _in_an_empty_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


def run(*arguments: str) -> int:
    """Run the command and return its exit code, also when argparse ends it."""
    try:
        return simdesign.main(list(arguments))
    except SystemExit as end:
        return int(str(end.code))


def default_design() -> Design:
    found = load_scenario("nominal", ['design="designs/ksr3-default.toml"']).design
    assert found is not None
    return found


# analyse


@pytest.mark.slow
def test_a_design_is_judged_at_every_node(capsys: Printed) -> None:
    assert run("analyse", "ksr3-default", "--no-pictures") == 0
    printed = capsys.readouterr()
    lines = printed.out.splitlines()
    assert lines[0] == "ksr3-default: KSR-III default"
    assert "sampled, as it flies" in lines[1]
    for time_s in range(5, 60, 5):
        assert sum(line.split()[:1] == [str(time_s)] and "stable" in line.split()[1:3] for line in lines) == 3
        budget = next(
            line.split()
            for line in lines[lines.index("margin budget at the phase margin, deg") :]
            if line.split()[:1] == [str(time_s)]
        )
        assert sum(map(float, budget[2:-2])) == pytest.approx(float(budget[-2]), abs=0.7), "digits of thirteen shares"
        assert 180.0 + float(budget[-2]) == pytest.approx(float(budget[-1]), abs=0.11)
    assert lines[-1] == "PASSED: stable, all 9 limits met"
    assert lines[lines.index("not covered by operating points") + 1 :][:4] == [
        "  0.1069 to 5 s: under thrust, before the first operating point",
        "  5 to 55 s: between the operating points, where no limit was checked",
        "  55 to 59.09 s: under thrust, after the last operating point",
        "  59.09 to 59.29 s: tail-off, with less than half of the largest thrust",
    ]
    assert any(line.split()[:2] == ["phase", "margin"] and "  met  " in line for line in lines)
    assert printed.err == ""
    assert list(Path().iterdir()) == []


@pytest.mark.long
def test_pictures_and_record_go_into_a_folder(capsys: Printed) -> None:
    assert run("analyse", "ksr3-default", "--at", "40", "--at", "20", "--out", "here", "--kind", "pade", "--plots") == 0
    names = sorted(path.name for path in Path("here").iterdir())
    stems = ("lobes", "loop-020.0s", "loop-040.0s", "margins")
    assert names == sorted(
        ["analysis.html", "analysis.json", *(f"{stem}.{kind}" for stem in stems for kind in ("png", "svg"))]
    )
    told: dict[str, Any] = json.loads(Path("here/analysis.json").read_text())
    assert (told["design"], told["kind"], told["passed"]) == ("ksr3-default", "pade", True)
    assert [node["time_s"] for node in told["nodes"]] == [40.0, 20.0]
    first = told["nodes"][0]
    assert first["gain_up"]["db"] > 6.0
    assert {lobe["label"] for lobe in first["lobes"]} == {"slosh 1", "slosh 2", "bending 1", "bending 2", "bending 3"}
    assert "\n10 files in here/\n" in capsys.readouterr().out
    assert run("analyse", "ksr3-default", *QUICK, "--out", "here", "--kind", "pade") == 0
    assert "\n1 file in here/\n" in capsys.readouterr().out


def test_limits_that_are_missed_are_said_so(capsys: Printed) -> None:
    text = builtin_files("design")["ksr3-default"].read_text()
    Path("stricter.toml").write_text(text.replace("gain_margin_db = 6.0", "gain_margin_db = 9.6"))
    assert run("analyse", "stricter.toml", *QUICK) == 1
    printed = capsys.readouterr().out.splitlines()
    assert printed[-1] == "FAILED: gain margin missed, " + ", ".join(
        f"gain margin, {axis}, other axes closed missed" for axis in ("pitch", "yaw")
    )
    assert any(line.split()[:2] == ["40", "FAIL"] for line in printed)


def test_an_unstable_loop_shows_no_margin(capsys: Printed) -> None:
    text = builtin_files("design")["ksr3-default"].read_text()
    Path("hot.toml").write_text(text.replace("k_d_s = 0.481", "k_d_s = 4.81").replace("k_d_s = 0.329", "k_d_s = 3.29"))
    assert run("analyse", "hot.toml", "--at", "40", "--out", "hot") == 1
    printed = capsys.readouterr().out
    assert "UNSTABLE" in printed
    assert printed.splitlines()[-1].startswith("FAILED: unstable, gain margin missed")
    node = json.loads(Path("hot/analysis.json").read_text())["nodes"][0]
    assert (node["stable"], node["gain_up"]["db"], node["phase"]["deg"]) == (False, None, None)
    assert [lobe["label"] for lobe in node["lobes"]], "lobes are facts, also of an unstable loop"


def test_yaw_of_a_round_vehicle_is_as_pitch(capsys: Printed) -> None:
    said = []
    for axis in ("pitch", "yaw"):
        assert run("analyse", "ksr3-default", *QUICK, "--axis", axis) == 0
        said.append(capsys.readouterr().out.splitlines())
        assert f"along nominal, {axis};" in said[-1][1]
        assert ("yaw axis, designed for pitch" in said[-1][2]) == (axis == "yaw")
    assert said[0][3:] == said[1][3:]


@pytest.mark.slow
@pytest.mark.parametrize("more", [["--errata", "paper"], ["--plant", "table2"], ["--kind", "exact"]])
def test_other_loops_of_the_same_design(more: list[str], capsys: Printed) -> None:
    said = []
    for words in ([], more):
        assert run("analyse", "ksr3-default", *QUICK, *words) in (0, 1)
        said.append(capsys.readouterr().out.splitlines())
    assert said[0][2:] != said[1][2:]


def test_a_folder_that_holds_a_design_will_do(capsys: Printed) -> None:
    Path("made").mkdir()
    Path("made/design.toml").write_text(builtin_files("design")["ksr3-default"].read_text())
    assert run("analyse", "made", *QUICK) == 0
    assert capsys.readouterr().out.splitlines()[0] == "made: KSR-III default"


# errata


@pytest.mark.slow
def test_errata_are_listed_with_their_effect_at_every_node(capsys: Printed) -> None:
    assert run("errata", "--at", "10", "--at", "50", "--out", "errata.txt") == 0
    printed = capsys.readouterr()
    assert printed.err == ""
    text = printed.out
    assert Path("errata.txt").read_text() == text
    blocks = {block.splitlines()[0]: block for block in text.split("\n\n")}
    peak = blocks["peak of mode 1, dB: as printed less corrected"].splitlines()
    assert peak[1].split() == ["time,", "s", "10", "50"]
    row = next(line.split() for line in peak if line.split()[0] == "gyro_senses_rate")
    assert all(-40.0 < float(x) < -30.0 for x in row[1:]), "errata.md: 35 to 36 dB lower"
    phase = blocks["phase margin, deg: as printed less corrected"]
    assert any(line.split() == ["mode_force_sign", "unst.", "unst."] for line in phase.splitlines())


# wrong input: one line, exit code 2, nothing written

WRONG = {
    "nothing": ([], "give a CASE, e.g. simdesign ksr3-identical"),
    "no design": (["analyse"], "give a DESIGN, e.g. simdesign analyse ksr3-default"),
    "unknown design": (
        ["analyse", "nowhere"],
        "nowhere: no such file; allowed: a design file (.toml), or a built-in one",
    ),
    "unknown design at given points": (
        ["analyse", "nowhere", "--points", "greensite"],
        "nowhere: neither a file nor a built-in design; allowed: a design file (.toml), or a built-in design "
        "(simverify --list names them)",
    ),
    "empty name": (["analyse", ""], '"": no such file'),
    "empty folder": (["analyse", "."], "the folder has no design.toml"),
    "two designs": (["analyse", "a", "b"], "one DESIGN at a time: what is 'b'?"),
    "misspelt command": (["analyze", "a"], "what is 'analyze'? did you mean analyse?"),
    "misspelt option": (["analyse", "ksr3-default", "--axes", "yaw"], "unknown option --axes; did you mean --axis?"),
    "time before liftoff": (["analyse", "ksr3-default", "--at", "-1"], "operating point at -1 s"),
    "time after burnout": (["analyse", "ksr3-default", "--at", "70"], "operating point at 70 s"),
    "time without load": (["errata", "--at", "59.25"], "point at 59.25 s: a pendulum needs a positive axial load"),
    "no time": (["analyse", "ksr3-default", "--at", "nan"], "--at: 'nan' is not a time in seconds"),
    "unknown scenario": (["analyse", "ksr3-default", "--scenario", "nominl"], "did you mean nominal?"),
    "unknown vehicle": (["analyse", "ksr3-default", "--vehicle", "nowhere"], "nowhere"),
    "unknown kind": (["analyse", "ksr3-default", "--kind", "z"], "invalid choice: 'z'"),
    "option of another order": (
        ["--list", "--at", "3"],
        "--at is an option of simdesign analyse, open, errata or export, not of simdesign;",
    ),
    "option of a case": (
        ["analyse", "x", "--seed", "3"],
        "--seed is an option of simdesign optimise, not of simdesign analyse",
    ),
    "two orders": (["analyse", "x", "--list"], "--list stands alone: simdesign --list"),
    "no name": (["analyse", "x", "--out", ""], "--out needs the name of a folder"),
    "errata without such a design": (["errata", "nowhere"], "nowhere: no such file"),
}


@pytest.mark.parametrize("wrong", WRONG)
def test_wrong_input_is_one_line(wrong: str, capsys: Printed) -> None:
    arguments, says = WRONG[wrong]
    assert run(*arguments) == 2
    printed = capsys.readouterr()
    assert printed.out == ""
    assert printed.err.startswith("simdesign: ")
    assert printed.err.count("\n") == 1
    assert says in printed.err
    assert list(Path().iterdir()) == []


def test_a_folder_that_cannot_be_written_is_said_before_the_work(capsys: Printed) -> None:
    Path("file").write_text("")
    assert run("analyse", "ksr3-default", "--at", "40", "--out", "file/inside") == 2
    assert "file/inside: cannot be written" in capsys.readouterr().err


def test_a_design_with_a_mistake_names_file_and_key(capsys: Printed) -> None:
    text = builtin_files("design")["ksr3-default"].read_text()
    Path("bad.toml").write_text(text.replace("pole_zeta = 0.42", "pole_zeta = -0.42"))
    assert run("analyse", "bad.toml") == 2
    assert "bad.toml: filter.quadratic.0.pole_zeta = -0.42: makes an unstable pole" in capsys.readouterr().err


@pytest.mark.parametrize("option", ["--help", "--list", "--version"])
def test_what_needs_no_kernel_loads_none(option: str) -> None:
    code = (
        "import sys; from maxq.tools import simdesign\n"
        f"try: simdesign.main([{option!r}])\nexcept SystemExit: pass\n"
        "sys.exit(any(name in sys.modules for name in ('numba', 'numpy', 'scipy', 'matplotlib', 'pydantic', 'rich')))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, check=False)
    assert done.returncode == 0, done.stderr


def test_an_analysis_loads_no_optimiser_campaign_or_plots() -> None:
    code = (
        "import sys; from maxq.tools import simdesign\n"
        "simdesign.main(['analyse', 'ksr3-default', '--at', '40', '--no-pictures'])\n"
        "names = 'maxq.design.optimise', 'maxq.sim.campaign.read', 'scipy.optimize', 'matplotlib', 'pyarrow', 'rich'\n"
        "sys.exit(str([name for name in names if name in sys.modules]))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, check=False, text=True)
    assert done.stderr == "[]\n"
    assert "gain margin, yaw, other axes closed" in done.stdout


def test_the_list_names_designs(capsys: Printed) -> None:
    assert run("--list") == 0
    lines = capsys.readouterr().out.splitlines()
    assert any(line.split()[:1] == ["ksr3-default"] for line in lines)


# files


def test_a_design_that_is_written_reads_back_the_same_and_flies_the_same() -> None:
    design = default_design()
    again = design_file.design_of(
        name=design.name,
        description=design.description,
        vehicle=design.vehicle,
        law=designed_law(design),
        roll=design.roll,
        basis=design.basis,
    )
    assert again == design
    write_whole(Path("again.toml"), design_file.design_text(again, ["a comment", "and one more"]))
    assert Path("again.toml").read_text().startswith("# a comment\n# and one more\nschema = 2\n")
    short = ["run.duration_s=1.0"]
    one = fly(load_scenario("nominal", [*short, 'design="designs/ksr3-default.toml"']), log=False)
    other = fly(load_scenario("nominal", [*short, 'design="again.toml"']), log=False)
    assert one.state_hash == other.state_hash


# documentation

PAGE = Path(__file__).parents[1] / "docs" / "simdesign.md"
EXAMPLES = [part.split("```")[0] for part in PAGE.read_text(encoding="utf-8").split("```python\n")[1:]]


@pytest.mark.slow
@pytest.mark.parametrize("number", range(len(EXAMPLES)))
def test_examples_of_the_documentation_run(number: int) -> None:
    exec(compile(EXAMPLES[number], f"example {number + 1} of docs/simdesign.md", "exec"), {})  # ours
    if "draw_loop" in EXAMPLES[number]:
        assert sorted(path.name for path in Path().iterdir()) == ["mine.png", "mine.svg"]


def test_axes_that_a_product_of_inertia_couples_are_judged_together(capsys: Printed) -> None:
    """With Ixy^2 = 0.42 Ixx Iyy, a core free to roll pitches with 0.58 of its inertia, which no single plane shows."""
    text = builtin_files("design")["ksr3-default"].read_text()
    Path("mine.toml").write_text(text.replace("gain_margin_db = 6.0", "gain_margin_db = 8.0"))
    shutil.copytree(ROOT / "scenarios" / "vehicles" / "ksr3", "tilted")
    names, *rows = Path("tilted/mass.csv").read_text().splitlines()
    x, y = (names.split(",").index(f"I{axis}{axis}_kgm2") for axis in "xy")
    products = [0.65 * math.sqrt(float(row.split(",")[x]) * float(row.split(",")[y])) for row in rows]
    tilted = [f"{row},{product!r}" for row, product in zip(rows, products, strict=True)]
    Path("tilted/mass.csv").write_text("\n".join([f"{names},Ixy_kgm2", *tilted]))
    assert run("analyse", "mine.toml", *QUICK, "--vehicle", "tilted/vehicle.toml", "--out", "here") == 1
    assert capsys.readouterr().out.splitlines()[-1] == "FAILED: gain margin, pitch, other axes closed missed"
    told = json.loads(Path("here/analysis.json").read_text())
    plane, whole = told["nodes"][0], told["all_axes"][0]
    assert whole["yaw"]["gain_up"]["db"] == pytest.approx(plane["gain_up"]["db"], abs=0.05)
    assert -4.8 < whole["pitch"]["gain_up"]["db"] - plane["gain_up"]["db"] < -2.4, "the liquid keeps its own inertia"
    assert whole["disk"]["gain_up_db"] < whole["pitch"]["gain_up"]["db"]
