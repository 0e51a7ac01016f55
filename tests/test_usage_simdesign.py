"""`simdesign CASE` writes, prints and returns its results, here for two operating points, F2 and few starts."""

from __future__ import annotations

import contextlib
import json
import re
import signal
import tomllib
from pathlib import Path
from typing import Any

import pytest

from maxq.design.optimise import at_nodes, search
from maxq.sim.input.files import builtin_files
from maxq.sim.run.fly import fly
from maxq.sim.scenario.loader import load_scenario
from maxq.tools import simdesign
from maxq.tools.cli import terminal
from maxq.tools.design import run_case

Printed = pytest.CaptureFixture[str]
CANNOT = ["ksr3-relaxed", "--starts", "1", "--set", "nodes_s=[10, 40]", "--set", "filter.structure=F2", "--no-pictures"]
CANNOT += ["--set", "limits.gain_margin_db=25"]
SMALL = ["ksr3-relaxed", "--starts", "2", "--set", "nodes_s=[10, 40]", "--set", "filter.structure=F2", "--no-pictures"]


@pytest.fixture(autouse=True)
def _in_an_empty_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


def run(*arguments: str) -> int:
    """Run the command and return its exit code, also when argparse ends it."""
    try:
        return simdesign.main(list(arguments))
    except SystemExit as end:
        return int(str(end.code))


def record(folder: str = "out") -> dict[str, Any]:
    content: dict[str, Any] = json.loads((Path(folder) / "design.json").read_text())
    return content


@pytest.mark.slow
def test_a_case_leaves_a_design_that_flies(capsys: Printed) -> None:
    assert run(*SMALL, "--out", "out") == 0
    printed = capsys.readouterr()
    assert printed.err == ""
    lines = printed.out.splitlines()
    assert lines[0].startswith("ksr3-relaxed: KSR-III")
    assert lines[-1].startswith("DESIGNED: largest peak of mode 1 ")
    assert lines[-1].endswith("all limits met at its 2 operating points")
    assert lines[-2] == "  simrun nominal --set design=out/design.toml"
    assert sum("  met  " in line for line in lines) == 14, "seven limits, of the case's loop and as flown"
    assert sum(line.split()[1:2] == ["pass"] for line in lines) == 2
    at = lines.index("not covered by operating points")
    gaps = [
        "0.1069 to 10 s: under thrust, before the first operating point",
        "10 to 40 s: between the operating points, where no limit was checked",
        "40 to 59.09 s: under thrust, after the last operating point",
        "59.09 to 59.29 s: tail-off, with less than half of the largest thrust",
    ]
    assert lines[at + 1 : at + 5] == [f"  {gap}" for gap in gaps]
    assert [f"{one['begin_s']:.4g} to {one['end_s']:.4g} s: {one['why']}" for one in record()["not_covered"]] == gaps
    assert sorted(path.name for path in Path("out").iterdir()) == ["design.json", "design.toml"]
    text = Path("out/design.toml").read_text()
    assert [line for line in text.splitlines() if line.startswith("# not")] == [f"# not covered: {gap}" for gap in gaps]
    assert text.startswith(
        "# Written by simdesign for the case ksr3-relaxed (F2, linear gains).\n"
        "# All limits met at its 2 operating points.\n"
    )
    design = tomllib.loads(text)
    told = record()
    assert (told["feasible"], told["status"], told["missed"]) == (True, "optimal", [])
    assert told["search"]["starts"] == 2
    assert design["filter"]["structure"] == "F2"
    purpose, result = design["description"].split(". ", 1)
    assert re.fullmatch(r"KSR-III, the published problem .* \(filter F2, linear gains, pade loop\)", purpose)
    assert re.fullmatch(r"Largest peak of mode 1 \S+ dB; all limits met at its 2 operating points", result)
    assert design["gains"]["table"][0]["k_p"] == pytest.approx(told["gains"]["k_p"][0], rel=1e-8)
    assert [node["time_s"] for node in told["nodes"]] == [10.0, 40.0]
    peaks = [lobe["peak_db"] for node in told["nodes"] for lobe in node["lobes"] if lobe["label"] == "bending 1"]
    assert max(peaks) == pytest.approx(told["objective_db"], abs=1e-4), "judged by what the optimiser does not use"
    flight = fly(load_scenario("nominal", ['design="out/design.toml"', "run.duration_s=20.0"]), log=False)
    assert flight.passed


@pytest.mark.slow
def test_equal_orders_give_equal_designs_and_judged_again_they_are_the_same(capsys: Printed) -> None:
    texts = []
    for folder in ("one", "two"):
        assert run(*SMALL, "--seed", "7", "--out", folder) == 0
        texts.append((Path(folder) / "design.toml").read_text())
    assert texts[0] == texts[1]
    assert run("analyse", "one", "--kind", "pade", "--at", "10", "--at", "40", "--no-pictures", "--out", "again") == 0
    again = json.loads(Path("again/analysis.json").read_text())
    assert again["nodes"] == record("one")["nodes"]


@pytest.mark.long
def test_pictures_are_those_of_the_paper(capsys: Printed) -> None:
    assert run(*SMALL[:-1], "--plots", "--out", "out") == 0
    stems = ("filter", "gains", "lobes", "loop-010.0s", "loop-040.0s", "margins")
    stems += ("vehicle-bending", "vehicle-derivatives", "vehicle-slosh")
    names = {f"{stem}.{kind}" for stem in stems for kind in ("png", "svg")}
    assert {path.name for path in Path("out").iterdir()} == names | {"design.html", "design.json", "design.toml"}
    assert capsys.readouterr().out.splitlines()[-1].endswith("; page: out/design.html")


@pytest.mark.long
def test_orders_are_designed_besides(capsys: Printed, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(run_case, "STRUCTURES", ("F2", "F3"))
    assert run(*SMALL[:-1], "--starts", "1", "--orders", "--plots", "--out", "out") == 0
    lines = capsys.readouterr().out.splitlines()
    table = lines[lines.index("over the filter's order, dB") + 1 :]
    assert [line.split()[0] for line in table[1:3]] == ["F2", "F3"]
    names = {path.stem for path in Path("out").glob("orders-*.svg")}
    kinds = [f"orders-{what}-{how}" for what in ("gains", "filters") for how in ("two-phase", "linear", "free")]
    assert names == {"orders-peaks", *kinds}
    found = {(o["structure"], o["schedule"]): o["objective_db"] for o in record()["orders"]}
    assert len(found) == 6
    assert found["F3", "free"] < found["F2", "linear"]


@pytest.mark.slow
def test_limits_that_cannot_be_met_are_named_and_the_best_effort_is_kept(capsys: Printed) -> None:
    assert run(*CANNOT, "--out", "out") == 1
    lines = capsys.readouterr().out.splitlines()
    assert lines[-1].startswith("INFEASIBLE: the limits cannot be met together: at best ")
    assert "gain margin at " in lines[-1]
    assert any("  MISSED  " in line for line in lines)
    text = Path("out/design.toml").read_text()
    assert "# INFEASIBLE: the best effort misses limits of the case:\n#   gain margin missed by " in text
    assert "limits are missed" in tomllib.loads(text)["description"]
    told = record()
    assert (told["feasible"], told["status"]) == (False, "infeasible")
    assert told["missed"][0].startswith("gain margin missed by ")
    assert sum(limit["gains_db_per_db"] for limit in told["way_out"]["conflict"]) == pytest.approx(1.0, abs=2e-3)
    wider, higher, faster = told["way_out"]["trials"]
    assert (higher["change"], higher["settings"]) == ("F3 instead of F2", ["filter.structure=F3"])
    assert faster["change"] == "a sample every 5 instead of 10 ms"
    at = lines.index("way out")
    assert " ".join(lines[at + 1].split()) == "limits in conflict gains dB per dB a dB is at (part)"
    shown = [f"{t['change']}: reached {t['missing_db']:.3g} dB missing" for t in (wider, higher, faster)]
    assert lines[-1].endswith(f"; short trials from there: {'; '.join(shown)}")
    assert f"#   trial: {shown[1]}; filter.structure=F3" in text.splitlines()


@pytest.mark.slow
def test_trials_can_be_left_out(capsys: Printed) -> None:
    assert run(*CANNOT, "--no-trials", "--out", "out") == 1
    assert "trial" not in capsys.readouterr().out
    assert record()["way_out"]["trials"] == []
    assert record()["way_out"]["conflict"][0]["gains_db_per_db"] > 0.1


@pytest.mark.long
def test_ctrl_c_during_the_trials_keeps_the_design(capsys: Printed, monkeypatch: pytest.MonkeyPatch) -> None:
    honest, begun = at_nodes.descend, []

    def impatient(*arguments: Any, **more: Any) -> Any:
        begun.append(1)
        if len(begun) == 2:
            raise KeyboardInterrupt
        return honest(*arguments, **more)

    monkeypatch.setattr(at_nodes, "descend", impatient)
    assert run(*CANNOT, "--out", "out") == 130
    assert capsys.readouterr().out.splitlines()[-1].startswith("INFEASIBLE: ")
    assert "# INFEASIBLE: the best effort" in Path("out/design.toml").read_text()
    told = record()
    assert (told["status"], len(told["way_out"]["trials"])) == ("infeasible", 1)
    assert told["way_out"]["trials"][0]["interrupted"]


@pytest.mark.slow
def test_ctrl_c_keeps_the_best_so_far(capsys: Printed, monkeypatch: pytest.MonkeyPatch) -> None:
    honest, count = search.descend, 0

    def impatient(*arguments: Any, **more: Any) -> Any:
        nonlocal count
        count += 1
        if count == 3:
            raise KeyboardInterrupt
        return honest(*arguments, **more)

    monkeypatch.setattr(search, "descend", impatient)
    assert run(*SMALL[:-1], "--starts", "50", "--out", "out") == 130
    assert capsys.readouterr().out.splitlines()[-1].startswith("INTERRUPTED: the best so far is kept; ")
    assert "# INTERRUPTED: the best so far" in Path("out/design.toml").read_text()
    assert record()["status"] == "interrupted"
    assert sorted(path.name for path in Path("out").iterdir()) == ["design.json", "design.toml"]


@pytest.mark.slow
def test_ctrl_c_that_a_library_swallows_is_not_lost(capsys: Printed, monkeypatch: pytest.MonkeyPatch) -> None:
    honest = search.descend

    def deaf(*arguments: Any, **more: Any) -> Any:
        with contextlib.suppress(KeyboardInterrupt):  # as a callback of the compiler does
            signal.raise_signal(signal.SIGINT)
        return honest(*arguments, **more)

    monkeypatch.setattr(search, "descend", deaf)
    Path("out").mkdir()
    for name in ("margins.svg", "loop-010.0s.png", "design.html", "mine.png"):
        Path("out", name).write_text("of an earlier run")
    assert run(*SMALL[:-1], "--starts", "50", "--out", "out") == 130
    assert capsys.readouterr().out.splitlines()[-1].startswith("INTERRUPTED: the best so far is kept; ")
    assert sorted(path.name for path in Path("out").iterdir()) == ["design.json", "design.toml", "mine.png"]


def test_ctrl_c_before_anything_is_found_leaves_nothing(capsys: Printed, monkeypatch: pytest.MonkeyPatch) -> None:
    def impatient(*arguments: Any, **more: Any) -> Any:
        raise KeyboardInterrupt

    monkeypatch.setattr(search, "descend", impatient)
    assert run(*SMALL, "--out", "out") == 130
    printed = capsys.readouterr()
    assert (printed.out, printed.err) == ("", "simdesign: interrupted; nothing written\n")
    assert list(Path().rglob("*.*")) == []


def test_no_bar_where_there_is_no_terminal(capsys: Printed, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(terminal, "_PATIENCE_S", 0.0)
    with terminal.Progress() as bar:
        bar.show("optimising", 1, 2)
    assert capsys.readouterr().err == ""


WRONG = {
    "unknown case": (["ksr3-identicle"], "ksr3-identicle: no such file; did you mean ksr3-identical?"),
    "a folder": (["."], ".: is a folder"),
    "empty name": ([""], '"": no such file'),
    "two cases": (
        ["ksr3-identical", "ksr3-relaxed"],
        "what is 'ksr3-relaxed'? one case at a time, or several with --verify",
    ),
    "unknown key": (["ksr3-identical", "--set", "limits.gain_margin=3"], "did you mean gain_margin_db?"),
    "bad value": (
        ["ksr3-identical", "--set", "filter.structure=F7"],
        'filter.structure = "F7": is not one of the choices',
    ),
    "no value": (["ksr3-identical", "--set", "limits"], "has no '='"),
    "nan": (["ksr3-identical", "--set", "limits.gain_margin_db=nan"], "limits.gain_margin_db = nan"),
    "no start": (["ksr3-identical", "--starts", "0"], "--starts: '0' is not a whole number of at least 1"),
    "negative seed": (["ksr3-identical", "--seed", "-3"], "search.seed = -3"),
    "node after burnout": (["ksr3-identical", "--set", "nodes_s=[10, 70]"], "point at 70 s: the engine does not burn"),
    "nodes that fall": (["ksr3-identical", "--set", "nodes_s=[40, 10]"], "nodes_s = [40, 10]: does not rise"),
    "unknown scenario": (
        ["ksr3-identical", "--set", "scenario=nowhere"],
        'scenario = "nowhere": neither a file nor a built-in scenario',
    ),
    "option of analyse": (
        ["ksr3-identical", "--at", "3"],
        "--at is an option of simdesign analyse, open, errata or export, not of simdesign optimise",
    ),
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


@pytest.mark.slow
def test_a_case_file_of_ones_own(capsys: Printed) -> None:
    Path("mine.toml").write_text('extends = "ksr3-relaxed"\ndescription = "mine"\n[filter]\nstructure = "F3"\n')
    assert run("mine.toml", *SMALL[1:5], "--no-pictures") == 0
    assert capsys.readouterr().out.splitlines()[0] == "mine: mine"
    assert sorted(path.name for path in Path("runs/mine").iterdir()) == ["design.json", "design.toml"]
    Path("mine.toml").write_text('extends = "ksr3-relaxed"\n[filter]\nstructur = "F3"\n')
    assert run("mine.toml") == 2
    assert "mine.toml: filter.structur = " in capsys.readouterr().err


def test_the_list_names_cases(capsys: Printed) -> None:
    assert run("--list") == 0
    lines = capsys.readouterr().out.splitlines()
    for name in builtin_files("case"):
        assert any(line.split()[:1] == [name] for line in lines)
