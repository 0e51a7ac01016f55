"""Instructions of one step of the exported C law, counted over the samples of a flight.

    python -m maxq.tools.dev.bench.step_count [SCENARIO ...] [--write]

exports the law of each scenario (`simdesign export --c`), flies it, and runs it again on the recorded inputs in
Callgrind, which counts the instructions of every call of `law_step` without privileges. The result is a table of the
mean and the largest count, with the sample at which it occurs. `--write` puts it into docs/flights/results.md. The
counts depend on compiler and processor; they are equal in every run.
"""

from __future__ import annotations

import argparse
import ctypes
import re
import shutil
import subprocess
import sys
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from maxq.control.kernel.records import IntArray
from maxq.sim.run.held_code import Tape
from maxq.sim.run.tape import record
from maxq.sim.scenario.flight_code import CodeFile, code_hash
from maxq.sim.scenario.loader import LoadedScenario, load_scenario
from maxq.sim.scenario.schema_vehicle import ComputerSection
from maxq.tools.design.export import export_c

COMPILER = next((c for c in ("cc", "gcc", "clang") if shutil.which(c)), "cc")
FLAGS = ("-std=c99", "-O2", "-g", "-Wall", "-Wextra", "-Werror", "-pedantic", "-ffp-contract=off")
LAW = ("flight_law.c", "flight_law_tables.c", "flight_law_fsw.c")
SCENARIOS = ("nominal", "ksr3-ringed", "load-relief")
PAGE = Path(__file__).resolve().parents[3] / "docs/flights/results.md"
_BEGIN, _END = "<!-- from step_count -->", "<!-- end of step_count -->"
HARNESS = """
#include "maxq_fsw.h"
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

int main(int argc, char **argv)
{
    FILE *file = fopen(argc > 1 ? argv[1] : "", "rb");
    static maxq_fsw_setup setup;
    static maxq_fsw_inputs in;
    maxq_fsw_outputs out;
    void *self = calloc(1, (size_t)maxq_fsw_bytes());
    if (file == NULL || self == NULL || fread(&setup, sizeof setup, 1, file) != 1
        || maxq_fsw_init(self, &setup) != 0) {
        return 1;
    }
    while (fread(&in, sizeof in, 1, file) == 1) {
        memset(&out, 0, sizeof out);
        if (maxq_fsw_step(self, &in, &out) != 0) {
            return 1;
        }
    }
    return fclose(file);
}
"""
"""A program that runs flight code on a file with its setup and its inputs."""


class Counted(NamedTuple):
    """The instructions of the steps of a law over a flight, and the inputs."""

    scenario: str
    counts: IntArray  # (samples,)
    tape: Tape
    state_bytes: int  # memory of an instance

    @property
    def worst(self) -> int:
        """Return the sample with the largest count."""
        return int(np.argmax(self.counts))


def compiled(folder: Path, *more: str, out: str, sources: tuple[str, ...] = LAW) -> Path:
    """Compile the exported law in `folder`. Raises CalledProcessError."""
    words = [COMPILER, *FLAGS, *more, "-o", out, *sources]
    subprocess.run(words, cwd=folder, check=True)
    return folder / out


class Recorded(NamedTuple):
    """A program with an exported law (HARNESS), a file and a tape of the inputs of a flight, and its memory, bytes."""

    program: Path
    file: Path
    tape: Tape
    state_bytes: int


def exported(loaded: LoadedScenario, folder: Path) -> Recorded:
    """Export the law of a scenario to a folder, fly it, and return a program with the law and the recorded inputs."""
    export_c(loaded, folder)
    library = compiled(folder, "-shared", "-fPIC", out="libfsw.so")
    computer = {"law": "external", "library": CodeFile(file=str(library), sha256=code_hash(library)[0])}
    vehicle = loaded.vehicle.model_copy(update={"computer": flown_by(loaded).model_copy(update=computer)})
    tape = record(replace(loaded, scenario=loaded.scenario.model_copy(update={"vehicle": vehicle})))
    (folder / "harness.c").write_text(HARNESS)
    (folder / "inputs.bin").write_bytes(tape.setup + tape.inputs.tobytes())
    size = ctypes.CDLL(str(library)).maxq_fsw_bytes
    size.restype = ctypes.c_int64
    return Recorded(compiled(folder, out="harness", sources=(*LAW, "harness.c")), folder / "inputs.bin", tape, size())


def flown_by(loaded: LoadedScenario) -> ComputerSection:
    computer = loaded.vehicle.computer
    assert computer is not None
    return computer


def callgrind_counts(program: Path, inputs: Path) -> IntArray:
    """Return the number of instructions of each call of `law_step` (calls,). Raises CalledProcessError."""
    with tempfile.TemporaryDirectory() as scratch:
        out = Path(scratch) / "calls"
        words = ["valgrind", "--tool=callgrind", "--toggle-collect=law_step", "--dump-after=law_step"]
        words += ["--combine-dumps=yes", f"--callgrind-out-file={out}"]
        subprocess.run([*words, program, inputs], check=True, capture_output=True)
        totals = re.findall(r"^totals: (\d+)$", out.read_text(), re.MULTILINE)
    return np.array([int(total) for total in totals if total != "0"])


def counted(scenario: str) -> Counted:
    """Count the instructions of a scenario's law over its flight."""
    loaded = load_scenario(scenario, [])
    with tempfile.TemporaryDirectory() as scratch:
        found = exported(loaded, Path(scratch))
        counts = callgrind_counts(found.program, found.file)
    if len(counts) != len(found.tape.inputs):
        raise AssertionError(f"{scenario}: {len(counts)} calls counted of {len(found.tape.inputs)}")
    return Counted(loaded.scenario.name, counts, found.tape, found.state_bytes)


def table(found: list[Counted]) -> str:
    """Return the counts as a table in Markdown."""
    lines = ["| scenario | samples | mean | largest | at | memory |", "|---|---|---|---|---|---|"]
    for one in found:
        at_s = float(one.tape.inputs["time_s"][one.worst])
        row = f"{len(one.counts):,}", f"{one.counts.mean():,.0f}", f"{one.counts.max():,}", f"{at_s:.2f} s"
        lines.append(f"| `{one.scenario}` | {' | '.join(row)} | {one.state_bytes:,} bytes |")
    return "\n".join(lines)


def main() -> int:
    """Print the table, or write it into the page. Return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenarios", nargs="*", default=SCENARIOS)
    parser.add_argument("--write", action="store_true", help="renew the table of docs/flights/results.md")
    given = parser.parse_args()
    if shutil.which("valgrind") is None:
        print("step_count: valgrind is not installed", file=sys.stderr)
        return 2
    text = table([counted(scenario) for scenario in given.scenarios])
    print(text)
    if given.write:
        page = PAGE.read_text(encoding="utf-8")
        before, _, rest = page.partition(_BEGIN)
        PAGE.write_text(f"{before}{_BEGIN}\n\n{text}\n\n{_END}{rest.partition(_END)[2]}", encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
