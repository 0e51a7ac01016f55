"""Commands that are killed or interrupted at a random instant, and then started again.

A child is forked from a process that has loaded everything, so that a kill does not cost a start. After each kill, no
file of the output folder may be half-written: TOML, JSON, CSV, Parquet, MCAP and .rrd files are read. At the end, the
same command runs to its end, and the folder must contain the files of an undisturbed run and no others.
"""

from __future__ import annotations

import json
import os
import random
import shutil
import signal
import sys
import time
import tomllib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import pyarrow.parquet as pq

from maxq.design.verify import memory
from maxq.sim.log.reader import read_log
from maxq.tools import simdesign, simreplay, simrun, simvehicle, simverify
from maxq.tools.cli import frame
from maxq.tools.dev.reliability.mutants import TESTS, of_tests

CASE = """\
schema = 2
scenario = "nominal"
loop = "sampled"
nodes_s = [20.0, 40.0]
between_nodes = "ignore"
[gains]
schedule = "linear"
[filter]
structure = "F2"
[search]
starts = 1
leaps = 0
"""
SUITE = """\
schema = 2
[margins]
times_s = [40.0]
planes = ["pitch"]
between_nodes = "ignore"
cases = 3
corner_sigmas = 0.0
success = 0.5
[margins.nominal]
gain_up_db = 3.0
[margins.three_sigma]
thrust = 0.03
[[flight]]
name = "two seconds"
set = ["run.duration_s=2.0"]
[[campaign]]
file = "campaigns/ksr3"
runs = 4
set = ["run.duration_s=2.0", "campaign.keep=[]"]
"""
ORDERLY = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
ENDS_S = 60.0
"""The time within which a command must end after a signal, s, on a busy machine."""


@dataclass(frozen=True)
class KilledCommand:
    """A command, the folder that it writes, and the numbers of SIGKILLs and of other signals."""

    name: str
    command: frame.Command
    words: tuple[str, ...]
    out: str
    kills: int
    signals: int = 3


@dataclass
class Killed:
    """The outcomes of a case: numbers of kills and of signals before the end, and the faults."""

    kills: int = 0
    signals: int = 0
    missed: int = 0  # signals after the end of the command
    faults: list[str] = field(default_factory=list)


def cases(folder: Path) -> list[KilledCommand]:
    """Write the inputs below `folder`, which becomes the working folder, and return the cases."""
    os.chdir(folder)
    os.environ["MAXQ_LEDGER"] = str(folder / "ledger")
    memory.default_folder = lambda: folder / "memory"
    of_tests("campaignkit").write_campaign(folder, runs=96)
    shutil.copy(TESTS / "data/layouts/stub.toml", "stub.toml")
    assert simrun.main(["fly", "nominal", "--set", "run.duration_s=20", "--out", "flown"]) in (0, 1)
    Path("case.toml").write_text(CASE)
    Path("suite.toml").write_text(SUITE)
    return [
        KilledCommand(
            "simrun fly", simrun.command, ("fly", "nominal", "--set", "run.duration_s=20", "--out", "fly"), "fly", 6
        ),
        KilledCommand(
            "simrun campaign", simrun.command, ("campaign", "small.toml", "--workers", "2", "--out", "camp"), "camp", 8
        ),
        KilledCommand(
            "simdesign optimise",
            simdesign.command,
            ("optimise", "case.toml", "--no-pictures", "--no-trials", "--out", "made"),
            "made",
            6,
        ),
        KilledCommand(
            "simverify", simverify.command, ("ksr3-robust", "--suite", "suite.toml", "--out", "pack"), "pack", 5
        ),
        KilledCommand("simvehicle", simvehicle.command, ("stub.toml", "--out", "stub"), "stub", 4),
        KilledCommand("simreplay --save", simreplay.command, ("flown", "--save", "saved/f.rrd"), "saved", 8),
        KilledCommand("simreplay --plots", simreplay.command, ("flown", "--plots", "plots"), "plots", 3),
    ]


def run(case: KilledCommand, seed: int, shown: Callable[[str], object]) -> Killed:
    """Kill a case, and return the outcome."""
    chance, found = random.Random(f"{case.name} {seed}"), Killed()
    Path("saved").mkdir(exist_ok=True)
    whole_s, code, said = _ended(case, None, 0.0)
    whole = _files(case.out)
    found.faults += [f"undisturbed: exit code {code}: {said}"] * (code not in (0, 1, 3))
    shown(f"{case.name}: {whole_s:.1f} s undisturbed, exit code {code}, {len(whole)} files {said}")
    shutil.rmtree(case.out)
    shutil.rmtree("memory", ignore_errors=True)
    Path("saved").mkdir(exist_ok=True)
    for n in range(case.kills + case.signals):
        number = signal.SIGKILL if n < case.kills else ORDERLY[n % 3]
        before = _files(case.out)
        took_s, code, said = _ended(case, number, chance.uniform(0.0, whole_s))
        if code in (0, 1, 3):
            found.missed += 1
        elif number == signal.SIGKILL:
            found.kills += 1
        else:
            found.signals += 1
            if code != 130 or len(said.splitlines()) > 1 or took_s > ENDS_S:
                found.faults.append(f"{number.name}: exit code {code} after {took_s:.1f} s: {said[-300:]}")
        found.faults += [f"{number.name}: {text}" for text in _broken(case, before, number != signal.SIGKILL)]
    _, code, said = _ended(case, None, 0.0)
    left = _files(case.out)
    found.faults += [f"afterwards: exit code {code}: {said}"] * (code not in (0, 1, 3))
    found.faults += [f"afterwards: {name}" for name in sorted(left ^ whole) if not Path(name).name.startswith(".")]
    for text in found.faults:
        shown(f"{case.name}: {text}")
    return found


def _files(folder: str) -> set[str]:
    return {str(path) for path in Path(folder).rglob("*") if path.is_file()}


def _ended(case: KilledCommand, number: signal.Signals | None, after_s: float) -> tuple[float, int, str]:
    """Run a command in a child, send a signal after a time, and return time, exit code and standard error."""
    Path("said").write_text("")
    signal.pthread_sigmask(signal.SIG_BLOCK, ORDERLY)  # until the command handles them
    began, child = time.monotonic(), os.fork()
    if child == 0:
        os.setpgid(0, 0)
        for stream, name in ((1, os.devnull), (2, "said")):
            os.dup2(os.open(name, os.O_WRONLY | os.O_CREAT | os.O_TRUNC), stream)
        sys.stdout, sys.stderr = open(1, "w", closefd=False), open(2, "w", closefd=False)  # noqa: SIM115  # to the end
        signal.signal(signal.SIGINT, signal.default_int_handler)

        def main() -> int:
            signal.pthread_sigmask(signal.SIG_UNBLOCK, ORDERLY)
            return case.command.main(list(case.words))

        frame.process(main)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, ORDERLY)
    sent = False
    while True:
        ended, status = os.waitpid(child, os.WNOHANG)
        passed_s = time.monotonic() - began
        if ended:
            return passed_s - after_s * sent, os.waitstatus_to_exitcode(status), Path("said").read_text()
        if number is not None and not sent and passed_s >= after_s:
            os.kill(child, number)
            sent = True
        time.sleep(0.002)


def _broken(case: KilledCommand, before: set[str], orderly: bool) -> Iterator[str]:
    """Yield the files of a folder that are not whole, and after an orderly end also new temporary files."""
    for name in sorted(_files(case.out)):
        path = Path(name)
        if path.name.startswith("."):
            if orderly and name not in before:
                yield f"leaves {name}"
            continue
        try:
            if path.suffix == ".toml":
                tomllib.loads(path.read_text())
            elif path.suffix == ".json":
                json.loads(path.read_text())
            elif path.suffix == ".parquet":
                pq.read_table(path)
            elif path.suffix == ".mcap":
                read_log(path)
            elif path.stat().st_size == 0 and path.name != "lock":
                yield f"{name} is empty"
        except Exception as error:
            yield f"{name}: {type(error).__name__}: {error}"
