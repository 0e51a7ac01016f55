"""Outputs quoted in the documentation are up to date and can be renewed."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

import pytest
from flight_code import needs_compiler

from maxq.design.verify.suite import read_suite
from maxq.sim.input.files import builtin_files
from maxq.tools.dev.documents import outputs
from maxq.tools.dev.documents.outputs import ROOT, OutputError, pages, renew, renewed_lines

FLOWN = """\
requirements
  gimbal angle  met  2.725  <= 4 deg
  gimbal rate   met  0.811  <= 15 deg/s

233.1 s flown in 3.71 s
PASSED: all 2 requirements met""".splitlines()
PAGE = """\
Text.

```toml
# mine.toml
seed = 1
```

```console
$ simrun mine.toml \\
    --out runs
...
  gimbal rate   met  0.811  <= 15 deg/s
...
PASSED: all 2 requirements met
```
"""
LONG = {  # seconds of one core
    "docs/start/flight-code.md": 12,
    "docs/start/margins.md": 9,
    "docs/start/monte-carlo.md": 20,
    "docs/tutorial.md": 420,
}
README = (ROOT / "README.md").read_text(encoding="utf-8")


def _page(path: Path) -> object:
    """Return a page name with its marks."""
    name = path.relative_to(ROOT).as_posix()
    marks = [pytest.mark.long] if name in LONG else []
    marks += [needs_compiler] if "flight-code" in name else []
    return pytest.param(name, marks=marks)


@pytest.mark.slow
@pytest.mark.parametrize("name", [_page(path) for path in pages()])
def test_quoted_outputs_are_up_to_date(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    """Quoted commands give their quoted output, except commands of minutes on pages that are not long tests.

    To renew the pages: python -m maxq.tools.dev.documents.outputs
    """
    code = outputs.main(["--check", "--short", str(ROOT / name)])
    assert code == 0, capsys.readouterr().out


def test_the_example_of_a_verdict_is_accepted() -> None:
    """The README quotes the whole suite for a shipped design on the scenario of its design, which is accepted."""
    blocks = re.findall(r"^```console\n\$ simverify (\S+) --suite (\S+)\n(.*?)^```\n", README, re.M | re.S)
    accepted = [(design, suite) for design, suite, shown in blocks if "\nACCEPTED: " in shown]
    whole = [command for command in outputs.LONG if command.startswith("simverify ")]
    assert [f"simverify {design} --suite {suite}" for design, suite in accepted] == whole
    for design, suite in accepted:
        text = builtin_files("design")[design].read_text(encoding="utf-8")
        assert tomllib.loads(text)["basis"]["scenario"] == read_suite(suite).suite.scenario
        assert "# Again: simdesign " in text


@pytest.mark.long
@pytest.mark.parametrize("command", outputs.LONG)
def test_quoted_outputs_of_minutes_are_up_to_date(command: str, tmp_path: Path) -> None:
    printed = outputs.run(command, tmp_path)
    every = "".join(page.read_text(encoding="utf-8") for page in pages())
    quoted = [shown for shown in re.findall(r"^```console\n.*?^```\n", every, re.M | re.S) if f"$ {command}\n" in shown]
    assert quoted
    assert [renew(block, tmp_path, lambda *_: printed)[1] for block in quoted] == [[]] * len(quoted)


@pytest.mark.parametrize(
    ("shown", "expected"),
    [
        ([], FLOWN),
        (["..."], ["..."]),
        (["...", "FAILED: 1 of 3 requirements missed"], ["...", FLOWN[-1]]),
        (["...", "NOT YET SETTLED: 10 of 10 open", "    (1004 more)"], ["...", FLOWN[-1]]),  # another outcome
        (["requirements", "  gimbal angle  met  9.1  <= 4 deg", "..."], [*FLOWN[:2], "..."]),
        (["...", "  gimbal rate   met  0.7  <= 15 deg/s", "...", "PASSED: all"], ["...", FLOWN[2], "...", FLOWN[-1]]),
    ],
)
def test_the_lines_shown_are_found_again(shown: list[str], expected: list[str]) -> None:
    assert renewed_lines(shown, FLOWN) == expected


def test_lines_that_are_printed_no_more_are_an_error() -> None:
    with pytest.raises(OutputError, match="no line like 'wind speed 12 m/s'"):
        renewed_lines(["...", "wind speed 12 m/s", "..."], FLOWN)


def test_a_page_runs_its_commands_with_its_files(tmp_path: Path) -> None:
    asked: list[str] = []

    def run(command: str, folder: Path) -> list[str]:
        asked.append(command)
        assert (folder / "mine.toml").read_text() == "# mine.toml\nseed = 1\n"
        return FLOWN

    assert renew(PAGE, tmp_path, run) == (PAGE, [])
    assert asked == ["simrun mine.toml \\\n    --out runs"]


@pytest.mark.parametrize(
    ("old", "new", "stale"),
    [
        ("0.811", "0.815", False),  # within 1 %
        ("0.811", "0.830", True),
        ("met  0.811", "met    0.811", False),  # another width of a column
        ("all 2 requirements met", "all 2 requirements met; tightest: gimbal angle", True),
    ],
)
def test_an_output_is_renewed_where_it_says_something_else(tmp_path: Path, old: str, new: str, stale: bool) -> None:
    printed = [line.replace(old, new) for line in FLOWN]
    page, named = renew(PAGE, tmp_path, lambda *_: printed)
    assert page == (PAGE.replace(old, new) if stale else PAGE)
    assert len(named) == stale
    assert all(name.startswith("9: $ simrun mine.toml") and new in name for name in named)


def test_outputs_of_long_commands_are_kept_in_short(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[str] = []

    def run(command: str, _: Path) -> list[str]:
        asked.append(command)
        return ["new"]

    monkeypatch.setattr(outputs, "LONG", {"simverify a": "minutes"})
    page = "```console\n$ simverify a\n...\nACCEPTED\n$ simrun b\nold\n```\n"
    expected = page.replace("old", "new")
    assert renew(page, tmp_path, run, short=True)[0] == expected
    assert asked == ["simrun b"]


def test_measures_of_the_machine_are_not_compared(tmp_path: Path) -> None:
    page = "```console\n$ simrun\n...\n233.1 s flown in 0.4 s\nPASSED: all 2 requirements met\n```\n"
    assert renew(page, tmp_path, lambda *_: FLOWN) == (page, [])


def test_a_command_that_fails_is_an_error(tmp_path: Path) -> None:
    page = "```console\n$ echo why >&2; exit 2\n```\n"
    with pytest.raises(OutputError, match=r"exit code 2\nwhy"):
        renew(page, tmp_path)
    assert renew(page.replace("2\n", "3\n"), tmp_path)[0] == page.replace("2\n", "3\nwhy\n")


def test_quoted_commands_write_into_a_ledger_of_their_own(tmp_path: Path) -> None:
    assert outputs.run("echo $MAXQ_LEDGER", tmp_path) == [str(tmp_path / "attempts")]
