"""Broken inputs and killed commands, with the table of docs/verification.md.

    python -m maxq.tools.dev.reliability.run inputs --number 10000 --seed 1 --results FILE

`kills` in place of `inputs` kills commands, and `table` writes the table from FILE. Each takes about five minutes.
`--results` appends a line for each kind of input and for each command. `--keep` is a folder for the inputs that are
faults, each with its message.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import json
import tempfile
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

from maxq.tools.dev.reliability import inputs, kills
from maxq.tools.dev.verification.section import VERIFICATION, rewrite

GROUPS = {
    "scenarios, vehicles, designs, tables": ("scenarios", "vehicles", "tables of vehicles", "designs"),
    "soundings, NetCDF": ("soundings", "winds in NetCDF"),
    "RASP, RockSim, DATCOM, drag curves": ("RASP, RockSim", "DATCOM", "drag curves"),
    "NASTRAN": ("NASTRAN",),
    "cases, suites, layouts, published derivatives": (
        "cases",
        "suites",
        "layouts",
        "small layouts, built",
        "published derivatives",
    ),
    "campaigns, their data, logs, packs": ("campaigns", "data of campaigns", "logs", "review packs"),
    "options of the commands": ("options",),
}
"""The rows of the table, and the kinds of inputs in each."""
ShowLine = Callable[[str], object]


def broken(only: list[str], number: int, seed: int, keep: Path | None, shown: ShowLine) -> Iterator[dict[str, Any]]:
    """Give broken inputs to the commands, and yield the outcome of each kind. Raises SystemExit for an intact input
    that is not used.
    """
    with tempfile.TemporaryDirectory() as folder:
        with contextlib.redirect_stdout(io.StringIO()):
            kinds = inputs.make_files(Path(folder), only)
        with inputs.stand_ins():
            for kind in kinds:
                for file in kind.files:
                    code, fault = inputs.answer(kind, file)
                    kind.steady()
                    if fault or code == 2:
                        raise SystemExit(f"{kind.name}: the intact {file} is not used: {fault}")
            found = inputs.run(kinds, number, seed, shown)
    for name, counts in found.items():
        for n, (text, content) in enumerate(counts.faults if keep is not None else ()):
            assert keep is not None
            place = keep / f"{name}-{n}"
            place.mkdir(parents=True, exist_ok=True)
            (place / Path(text.partition(":")[0]).name).write_bytes(content)
            (place / "fault.txt").write_text(text)
        faults = len(counts.faults)
        yield {
            "kind": name,
            "inputs": counts.number,
            "used": counts.used,
            "rejected": counts.rejected,
            "faults": faults,
        }
    for text, times in inputs.summary(found).most_common():
        shown(f"{times} {text}")


def killed(only: list[str], seed: int, shown: ShowLine) -> Iterator[dict[str, Any]]:
    """Kill and interrupt commands, and yield the outcome of each."""
    with tempfile.TemporaryDirectory() as folder:
        with contextlib.redirect_stdout(io.StringIO()):
            every = kills.cases(Path(folder))
        for case in every:
            if not only or case.name in only:
                found = kills.run(case, seed, shown)
                counts = {"kills": found.kills, "signals": found.signals, "late": found.missed}
                yield {"command": case.name, **counts, "faults": len(found.faults)}


def table(rows: list[dict[str, Any]]) -> str:
    """Return the table of inputs and kills as Markdown. Several results of one kind are added."""

    def added(of: Iterable[dict[str, Any]], *names: str) -> list[str]:
        chosen = list(of)
        return [f"{sum(row[name] for row in chosen):,}" for name in names]

    lines = ["| input | mutants | faults |", "|---|---:|---:|"]
    given = [row for row in rows if "kind" in row]
    for group, kinds in (*GROUPS.items(), ("all", tuple(row["kind"] for row in given))):
        mine = [row for row in given if row["kind"] in kinds]
        lines.append(" | ".join((f"| {group}", *added(mine, "inputs", "faults"))) + " |")
    lines += ["", "| command | SIGKILL | other signals | faults |", "|---|---:|---:|---:|"]
    ended = [row for row in rows if "command" in row]
    for name in (*dict.fromkeys(row["command"] for row in ended), "all"):
        mine = [row for row in ended if name in (row["command"], "all")]
        shown = f"`{name}`" if name != "all" else name
        lines.append(" | ".join((f"| {shown}", *added(mine, "kills", "signals", "faults"))) + " |")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("do", choices=["inputs", "kills", "table"])
    parser.add_argument("--number", type=int, default=10_000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--only", action="append", default=[], help="this kind or command only; repeatable")
    parser.add_argument("--keep", type=Path, help="folder for the inputs that are faults")
    parser.add_argument("--results", type=Path, required=True, help="file of the outcomes, one in each line")
    given = parser.parse_args()
    results, keep = given.results.resolve(), given.keep.resolve() if given.keep else None
    if given.do == "table":
        rows = [json.loads(line) for line in results.read_text().splitlines()]
        rewrite(VERIFICATION, "reliability", table(rows))
        return

    def shown(text: str) -> None:
        print(text, flush=True)

    if given.do == "inputs":
        found = broken(given.only, given.number, given.seed, keep, shown)
    else:
        found = killed(given.only, given.seed, shown)
    for row in found:
        with results.open("a") as file:
            file.write(json.dumps(row) + "\n")


if __name__ == "__main__":
    main()
