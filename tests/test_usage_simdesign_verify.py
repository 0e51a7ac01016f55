"""`simdesign CASE... --verify` and `try_in_order` try candidates, best first, until one is accepted."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import pytest

from maxq.tools import simdesign
from maxq.tools.design import run_case
from maxq.tools.verify.run import Candidate, in_order, try_in_order

Printed = pytest.CaptureFixture[str]
CASES = ("ksr3-identical", "ksr3-relaxed")
SMALL = ("--starts", "2", "--set", "nodes_s=[10, 40]", "--set", "filter.structure=F2", "--no-pictures")
SUITE = """
schema = 2
[margins]
times_s = [20.0, 40.0]
cases = 0
corner_sigmas = 0.0
[margins.nominal]
gain_down_db = {aero_db}
"""
AT_NODES = "margins.between_nodes=ignore"


@pytest.fixture(scope="module")
def memory(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder of verified parts for all tests of this module."""
    return tmp_path_factory.mktemp("memory")


@pytest.fixture(scope="module")
def designed() -> dict[str, Any]:
    """Return the requirements of the cases, by their content, for all tests of this module."""
    return {}


@pytest.fixture(autouse=True)
def _in_an_empty_folder(tmp_path: Path, memory: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("maxq.design.verify.memory.default_folder", lambda: memory)


@pytest.fixture
def _design_once(designed: dict[str, Any], monkeypatch: pytest.MonkeyPatch) -> None:
    """Design a case when the first test needs it, and reuse the result."""
    design_case = run_case.design_case

    def remembered(loaded: Any, *rest: Any) -> Any:
        key = repr(loaded.case)
        if key not in designed:
            designed[key] = design_case(loaded, *rest)
        return designed[key]

    monkeypatch.setattr(run_case, "design_case", remembered)


def _suite(aero_db: float) -> str:
    Path("suite.toml").write_text(SUITE.format(aero_db=aero_db))
    return "suite.toml"


def _run(*arguments: str) -> int:
    try:
        return simdesign.main(list(arguments))
    except SystemExit as end:
        return int(str(end.code))


@pytest.mark.long
@pytest.mark.usefixtures("_design_once")
def test_second_candidate_is_accepted_when_the_first_fails(capsys: Printed) -> None:
    """The relaxed case has the lower peak of mode 1 and is first; its lower gain margin is 9.4 dB, and it fails."""
    assert _run(*CASES, *SMALL, "--verify", "--suite", _suite(10.0), "--out", "out") == 0
    said = capsys.readouterr().out.splitlines()
    table = said[said.index("candidates in order of merit") :]
    assert table[2].split()[:2] == ["1", "out/ksr3-relaxed"]
    assert table[3].split()[:2] == ["2", "out/ksr3-identical"]
    failed = next(n for n, line in enumerate(said) if line.startswith("out/ksr3-relaxed: REJECTED: lower gain margin"))
    assert said[failed + 1].startswith("  missed: lower gain margin, as designed: 9.36 dB")
    assert said[failed + 2].split()[:3] == ["simverify", "out/ksr3-relaxed/design.toml", "--suite"]
    assert any(line.startswith("out/ksr3-identical: PASSED SCREENING: ") for line in said[failed:])
    assert said[-1].startswith("PASSED SCREENING by the suite suite.toml: out/ksr3-identical, candidate 2 of 2")
    verdicts = {case: json.loads(Path("out", case, "verdict.json").read_text())["verdict"] for case in CASES}
    assert verdicts == {"ksr3-identical": "passed screening", "ksr3-relaxed": "rejected"}


@pytest.mark.long
@pytest.mark.usefixtures("_design_once")
def test_none_accepted_says_what_each_failed(capsys: Printed) -> None:
    assert _run(*CASES, *SMALL, "--verify", "--suite", _suite(20.0), "--out", "out") == 1
    said = capsys.readouterr().out
    assert said.count("  missed: lower gain margin, as designed") == 2
    assert said.splitlines()[-1] == "NONE PASSED the suite suite.toml"


@pytest.mark.long
def test_designs_are_tried_until_one_is_accepted() -> None:
    """The second of three designs is accepted (rigid phase margins 38 and 61 deg); the third is not examined."""
    told: list[str] = []
    kept: list[str] = []
    designs = ("ksr3-two-phase", "ksr3-robust", "ksr3-default")
    accepted, every = try_in_order(
        designs,
        _suite(6.0),
        [AT_NODES, "margins.nominal.rigid_phase_deg=50.0"],
        tell=told.append,
        keep=lambda d, *_: kept.append(d),
    )
    assert accepted == "ksr3-robust"
    assert [v.judgement for v in every] == ["rejected", "passed screening"]
    assert kept == ["ksr3-two-phase", "ksr3-robust"]
    assert told[0].startswith("ksr3-two-phase: REJECTED: phase margin, rigid body 38.48 deg < 50 deg at ")
    assert told[0].endswith(" requirements met. A screening can reject, not accept.")
    assert told[1].startswith("  missed: phase margin, rigid body, as designed: 38.48 deg")
    assert told[-1].startswith("ksr3-robust: PASSED SCREENING: tightest requirement: phase margin, rigid body ")
    nothing, all_ = try_in_order(designs, _suite(50.0), [AT_NODES], tell=told.append)
    assert nothing is None
    assert [v.judgement for v in all_] == ["rejected"] * 3


@pytest.mark.slow
def test_stop_ends_it() -> None:
    with pytest.raises(KeyboardInterrupt):
        try_in_order(("ksr3-robust",), _suite(6.0), tell=lambda line: None, stop=lambda: True)


def test_order_of_merit() -> None:
    quiet = Candidate(Path("a"), True, "peak", -12.0, 0.3)
    loud = dataclasses.replace(quiet, folder=Path("b"), objective_db=2.0, modulus=0.5)
    missed = dataclasses.replace(quiet, folder=Path("c"), meets_limits=False, objective_db=-20.0, modulus=0.6)
    other = dataclasses.replace(loud, folder=Path("d"), kind="least-margin", objective_db=6.0)
    assert in_order([missed, loud, quiet]) == [quiet, loud, missed]
    assert in_order([missed, quiet, other]) == [other, quiet, missed]  # not comparable: the least |1 + L| decides


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("ksr3-relaxed", "--suite", "quick"), "--suite needs --verify"),
        (("ksr3-relaxed", "ksr3-relaxed", "--verify"), "a case is named twice"),
        (("ksr3-relaxed", "--verify", "--suite", "quik"), "did you mean quick?"),
        (
            ("analyse", "ksr3-robust", "--verify"),
            "--verify is an option of simdesign optimise, not of simdesign analyse",
        ),
    ],
)
def test_wrong_input_is_one_line(words: tuple[str, ...], said: str, capsys: Printed) -> None:
    assert _run(*words) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert err.count("\n") == 1
    assert said in err
