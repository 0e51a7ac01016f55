"""Each call in help texts and documents is parsed by the right subcommand with its options."""

from __future__ import annotations

import re
import shlex
from pathlib import Path
from types import ModuleType

import pytest

from maxq.tools import simdesign, simreplay, simrun, simvehicle, simverify

Printed = pytest.CaptureFixture[str]
ROOT = Path(__file__).parents[1]
COMMANDS = {
    "simrun": simrun,
    "simdesign": simdesign,
    "simreplay": simreplay,
    "simverify": simverify,
    "simvehicle": simvehicle,
}


def test_a_scenario_is_flown_by_fly_and_a_campaign_by_campaign(capsys: Printed) -> None:
    assert simrun._command_for("nominal") == "fly"
    assert simrun._command_for(str(ROOT / "scenarios" / "nominal.toml")) == "fly"
    assert simrun._command_for("campaigns/first") == "campaign"
    read = simrun._parser().read
    assert read(["--set", "run.seed=1", "--view", "--realtime", "nominal"]) == read(
        ["fly", "nominal", "--view", "--realtime", "1", "--set", "run.seed=1"]
    )
    assert read(["--runs", "5", "campaigns/first"]).runs == 5
    assert (read(["--realtime", "2", "nominal", "--view"]).realtime, read(["--", "nominal"]).scenario) == (
        2.0,
        "nominal",
    )


def test_a_file_named_like_a_subcommand_is_given_with_its_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Printed
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("fly").write_text((ROOT / "scenarios" / "nominal.toml").read_text())
    options = simrun._parser().read(["./fly"])
    assert (options.scenario, options.do) == ("./fly", simrun._fly)
    with pytest.raises(SystemExit) as end:
        simrun.main(["fly"])
    assert end.value.code == 2
    assert capsys.readouterr().err == "simrun: give a SCENARIO, e.g. simrun fly nominal; see simrun fly --help\n"


@pytest.mark.parametrize(
    ("former", "present"),
    [
        ("--copy nominal mine", "copy nominal mine"),
        ("--schema=suite", "schema suite"),
        ("--upgrade case.toml", "upgrade case.toml"),
        ("--from a.mcap --set run.seed=1", "refly a.mcap --set run.seed=1"),
        ("--out x --from=a.mcap", "refly a.mcap --out x"),
        ("--from . --keep worst:5", "report . --keep worst:5"),
        ("--from . --run 3 --view", "refly . --run 3 --view"),
        ("--run=3 --from .", "refly . --run=3"),
        ("--from . --run 3 --shrink", "shrink . --run 3"),
        ("--from . --runs 9 --search max_alpha_deg", "search . --runs 9 max_alpha_deg"),
        ("--rare=max_alpha_deg --from .", "rare . max_alpha_deg"),
    ],
)
def test_former_options_are_subcommands(former: str, present: str) -> None:
    assert simrun._in_present_form(former.split()) == present.split()
    simrun._parser().read(present.split())


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (
            "simrun fly nominal --runs 5",
            "simrun: --runs is an option of simrun campaign, search or rare, not of simrun fly",
        ),
        ("simrun campaigns/first --view", "simrun: --view is an option of simrun fly or refly, not of simrun campaign"),
        (
            "simrun schema case --out x",
            "simrun: --out is an option of simrun fly, refly, campaign, merge, compare, calibrate or winds, "
            "not of simrun schema",
        ),
        ("simrun refly x.mcap --run 1 --set a=1", "simrun: --run and --set exclude each other"),
        ("simrun nominal --realtime 3", "simrun: --realtime needs --view or --view-port"),
        ("simrun fly nominal --from x", "simrun: one LOG|DIR at a time: what is 'fly'?"),
        ("simrun search runs/first", "simrun: give a METRIC, e.g. simrun search runs/first max_alpha_deg"),
        (
            "simdesign bias nominal --kind pade",
            "simdesign: --kind is an option of simdesign analyse or open, not of simdesign bias",
        ),
        ("simdesign ksr3-robust --c law", "simdesign: --c is an option of simdesign export, not of simdesign optimise"),
        ("simdesign analyze a", "simdesign: what is 'analyze'? did you mean analyse?"),
        ("simverify ksr3-robust --list", "simverify: --list stands alone: not with ksr3-robust"),
        ("simreplay x --tab Air --summary", "simreplay: --summary and --tab exclude each other"),
    ],
)
def test_an_option_of_another_subcommand_is_refused_in_one_line(arguments: str, says: str, capsys: Printed) -> None:
    name, *words = arguments.split()
    with pytest.raises(SystemExit) as end:
        COMMANDS[name].main(words)
    out, err = capsys.readouterr()
    assert (end.value.code, out, err.count("\n")) == (2, "", 1)
    assert err.startswith(f"{says}{' See' if says.endswith('?') else '; see'} {name} ")


def calls_in(text: str) -> list[str]:
    """Return the calls of maxq's commands at line starts, without pipes, redirections and explanations."""
    joined = re.sub(r"\\\n\s*", "", text)
    lines = re.findall(rf"^\s*(?:\$ )?((?:{'|'.join(COMMANDS)}) [^`\n]*)$", joined, re.MULTILINE)
    return [re.split(r" {2,}| [>|#] | && ", line.strip(), maxsplit=1)[0] for line in lines]


def understood(command: ModuleType, words: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    """Parse the words without reading files. Raises SystemExit where they are rejected."""
    if command is simrun:
        monkeypatch.setattr(simrun, "_command_for", lambda name: "campaign" if "campaign" in name else "fly")
        words = simrun._in_present_form(words)
    command._parser().read(words)


@pytest.mark.parametrize("name", COMMANDS)
def test_examples_in_help_are_understood(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "200")
    for prog, text in COMMANDS[name]._parser().helps().items():
        examples = text.split("examples:\n")[1].split("\n\nexit code:")[0]
        calls = calls_in(examples)
        assert calls
        assert prog == name or all(f"{call} ".startswith(f"{prog} ") for call in calls)
        for call in calls:
            words = shlex.split(call)
            understood(COMMANDS[words[0]], words[1:], monkeypatch)


def test_commands_in_the_documents_are_understood(monkeypatch: pytest.MonkeyPatch) -> None:
    files = [ROOT / "README.md", *(ROOT / "docs").rglob("*.md"), *(ROOT / "scenarios").rglob("*.toml")]
    calls = [call for file in files for call in calls_in(file.read_text()) if not re.search(r"\.\.\.|usage|<|…", call)]
    assert len(calls) > 60
    for call in calls:
        words = shlex.split(call)
        understood(COMMANDS[words[0]], words[1:], monkeypatch)
