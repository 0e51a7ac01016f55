"""Run the commands that the documentation quotes, and renew the outputs shown below them.

    python -m maxq.tools.dev.documents.outputs              # renew every page that quotes an output
    python -m maxq.tools.dev.documents.outputs --check      # name the outputs that are out of date

`--short` leaves the outputs of the commands in `LONG` unchanged. The exit code of `--check` is 1 if an output is out of
date.

A fenced block ```` ```console ```` contains commands (`$ simrun nominal`, continued after a backslash), and below each
command the lines that it prints on stdout and stderr. The commands of a page run in order in one scratch folder. The
folder contains `examples`, and the files that the page shows: a block ```` ```toml ```` whose first line is
`# NAME.toml`. Compiled kernels and results come from the usual cache (`$MAXQ_CACHE`).

- A line `...` elides any number of lines. The lines between two elisions are found by the words of the first and the
  last of these lines. If no printed line resembles the last line of an output, the outcome line replaces it.
- An output is current if it has the same words, and numbers within 1 %, since the last digits of an optimum depend on
  the processor. Numbers that measure the machine (`MACHINE`) and spaces are not compared. Lines of progress
  (`PROGRESS`) are not quoted.
- A current output keeps its text, so that a page changes only where a command prints something else.
"""

from __future__ import annotations

import argparse
import difflib
import os
import re
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[3]
ELISION = "..."
WIDTH = 92  # characters of a line, as in the quoted help of the commands
OUTCOMES = {0, 1, 3}  # exit codes that are verdicts
LONG = {
    "simdesign analyse ksr3-robust-ascent --at 10 --at 50 --no-pictures": "dispersed vehicles: half a minute",
    "simverify ksr3-ringed --suite ksr3-ringed": "the whole suite standard: twenty minutes of one core",
}
"""The quoted commands that `--short` does not run, with the reasons."""
MACHINE = re.compile(
    r"flown in [\d.]+ s|[\d.]+ times real time|[\d.]+ s in all|[\d.]+ flights/s"
    r"|[\d.]+ s, \d+ results reused|[\d.]+ [kM]B|\b[0-9a-f]{16}\b"
)
PROGRESS = re.compile(r"[a-z][\w ]*: [\d.]+ of [\d.]+\b")  # lines printed during the work
_BLOCK = re.compile(r"^```console\n(.*?)^```$", re.MULTILINE | re.DOTALL)
_FILE = re.compile(r"^```toml\n(# ([\w-]+\.toml)\n.*?)^```$", re.MULTILINE | re.DOTALL)
_NUMBER = re.compile(r"-?\d+(?:,\d{3})*(?:\.\d+)?(?:e[-+]?\d+)?")
_RELATIVE = 0.01  # relative difference below which two numbers are equal
_ALIKE = 0.5  # least similarity of a line to the line that it replaces

QuotedRun = Callable[[str, Path], list[str]]


class OutputError(Exception):
    """An error of a quoted command that failed, or of an output whose shown lines are not found."""


@dataclass(frozen=True)
class Quoted:
    """A quoted command: its line number in the page, its text, and the lines shown below it."""

    line: int
    command: str
    shown: list[str]


def pages() -> list[Path]:
    """Return the pages with quoted outputs, README.md first."""
    found = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
    return [p for p in found if "build" not in p.parts and "```console\n" in p.read_text(encoding="utf-8")]


def files_of(text: str) -> dict[str, str]:
    """Return the files that a page shows, by name."""
    return {name: content for content, name in _FILE.findall(text)}


def run(command: str, folder: Path) -> list[str]:
    """Run a command in a folder, and return the lines that it prints. Raises OutputError if it fails."""
    paths = os.pathsep.join([str(Path(sys.executable).parent), os.environ.get("PATH", "")])
    own = {"PATH": paths, "COLUMNS": str(WIDTH), "MPLBACKEND": "Agg", "MAXQ_LEDGER": str(folder / "attempts")}
    done = subprocess.run(
        ["bash", "-c", command],
        cwd=folder,
        env=os.environ | own,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        check=False,
    )
    if done.returncode not in OUTCOMES:
        raise OutputError(f"$ {command}: exit code {done.returncode}\n{done.stdout[-2000:]}")
    return [line.rstrip() for line in _stripped(done.stdout.splitlines()) if not PROGRESS.match(line)]


def renew(text: str, folder: Path, run: QuotedRun = run, short: bool = False) -> tuple[str, list[str]]:
    """Return a page with its outputs renewed, and a line for each output that was out of date.

    If `short` is True, the outputs of the commands in `LONG` are unchanged. Raises OutputError.
    """
    stale: list[str] = []
    for name, content in files_of(text).items():
        (folder / name).write_text(content, encoding="utf-8")

    def renewed(block: re.Match[str]) -> str:
        lines = ["```console"]
        for quoted in _quoted(block[1].splitlines(), text.count("\n", 0, block.start()) + 2):
            if short and quoted.command in LONG:
                lines += ["$ " + quoted.command, *quoted.shown]
                continue
            shown = renewed_lines(quoted.shown, run(quoted.command, folder))
            current = _current(quoted.shown, shown)
            if not current:
                stale.append(f"{quoted.line}: $ {quoted.command}: {_difference(quoted.shown, shown)}")
            lines += ["$ " + quoted.command, *(quoted.shown if current else shown)]
        return "\n".join([*lines, "```"])

    return _BLOCK.sub(renewed, text), stale


def renewed_lines(shown: Sequence[str], printed: Sequence[str]) -> list[str]:
    """Return the printed lines that correspond to the shown lines, with the same elisions. Raises OutputError."""
    parts = _split(shown)
    lines: list[str] = []
    start, last = 0, len(parts) - 1
    for number, part in enumerate(parts):
        if number:
            lines.append(ELISION)
        if not part and last:
            continue
        if number:
            start = _find(part[0], printed, start, _outcome(printed) if number == last else None)
        end = _find(part[-1], printed, start) + 1 if number < last else len(printed)
        lines += printed[start:end]
        start = end
    return lines


def _quoted(lines: Sequence[str], first: int) -> Iterable[Quoted]:
    """Yield the commands of a block. `first` is the number of its first line in the page."""
    starts = [number for number, line in enumerate(lines) if line.startswith("$ ")]
    for start, end in zip(starts, [*starts[1:], len(lines)], strict=True):
        below = start
        while lines[below].endswith("\\"):
            below += 1
        command = "\n".join(lines[start : below + 1])[2:]
        yield Quoted(first + start, command, _stripped(lines[below + 1 : end]))


def _split(shown: Sequence[str]) -> list[list[str]]:
    """Return the parts between elisions, without blank lines at their ends."""
    parts: list[list[str]] = [[]]
    for line in shown:
        if line == ELISION:
            parts.append([])
        else:
            parts[-1].append(line)
    return [_stripped(part) for part in parts]


def _stripped(lines: Sequence[str]) -> list[str]:
    """Return lines without blank lines at both ends."""
    return "\n".join(lines).strip("\n").splitlines()


def _outcome(printed: Sequence[str]) -> int:
    """Return the index of the last printed line that is not a continuation."""
    return max((number for number, line in enumerate(printed) if not line.startswith(" ")), default=0)


def _find(line: str, printed: Sequence[str], start: int, anchor: int | None = None) -> int:
    """Return the index of the printed line that is most similar to a line, by words and then by numbers, else `anchor`.

    Raises OutputError if there is neither.
    """
    best, found = (_ALIKE, 0.0), anchor
    for number in range(start, len(printed)):
        other = printed[number]
        alike = _likeness(_words(line), _words(other)), _likeness(line, other)
        if alike > best:
            best, found = alike, number
    if found is None:
        raise OutputError(f"no line like '{line}' is printed: show other lines")
    return max(found, start)


def _likeness(one: str, other: str) -> float:
    return difflib.SequenceMatcher(None, one, other, autojunk=False).ratio()


def _words(line: str) -> str:
    return " ".join(_NUMBER.sub("#", line).split())


def _current(shown: Sequence[str], printed: Sequence[str]) -> bool:
    return len(shown) == len(printed) and all(map(_equal, shown, printed))


def _equal(one: str, other: str) -> bool:
    """Return True if two lines are equal by the rules in the docstring of this module."""
    one, other = MACHINE.sub("", one), MACHINE.sub("", other)
    if _words(one) != _words(other):
        return False
    pairs = zip(_NUMBER.findall(one), _NUMBER.findall(other), strict=True)
    return all(_close(float(a.replace(",", "")), float(b.replace(",", ""))) for a, b in pairs)


def _close(one: float, other: float) -> bool:
    return abs(one - other) <= _RELATIVE * max(abs(one), abs(other))


def _difference(shown: Sequence[str], printed: Sequence[str]) -> str:
    """Return a text on the first line that differs, as shown and as printed."""
    for number in range(max(len(shown), len(printed))):
        one, other = (lines[number] if number < len(lines) else "" for lines in (shown, printed))
        if not _equal(one, other):
            return f"'{one.strip()}' is now '{other.strip()}'"
    return "other lines"


def _named(page: Path) -> str:
    page = page.resolve()
    return str(page.relative_to(ROOT) if page.is_relative_to(ROOT) else page)


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("page", nargs="*", type=Path, help="pages; all with quoted outputs if none is given")
    parser.add_argument("--check", action="store_true", help="change no page; exit code 1 if an output is out of date")
    parser.add_argument("--short", action="store_true", help="keep the outputs of commands that take minutes")
    given = parser.parse_args(arguments)
    wrong = 0
    for page in given.page or pages():
        with tempfile.TemporaryDirectory() as name:
            (Path(name) / "examples").symlink_to(ROOT / "examples")
            try:
                text, stale = renew(page.read_text(encoding="utf-8"), Path(name), short=given.short)
            except OutputError as error:
                print(f"{_named(page)}: {error}", flush=True)
                wrong += 1
                continue
        for line in stale:
            print(f"{_named(page)}:{line}", flush=True)
        if given.check:
            wrong += len(stale)
        elif stale:
            page.write_text(text, encoding="utf-8")
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
