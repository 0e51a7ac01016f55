"""The instructions of a step of the exported law: Callgrind against single-stepping, and the bounds of its loops."""

from __future__ import annotations

import platform
import re
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from flight_code import needs_compiler

from maxq.control.external import HEADER
from maxq.sim.scenario.loader import load_scenario
from maxq.tools.dev.bench.step_count import LAW, Counted, callgrind_counts, compiled, exported, table

SAMPLES = 12
STEPPER = """
#define _GNU_SOURCE
#include <signal.h>
#include <stddef.h>
#include <stdint.h>
#include <stdio.h>
#include <sys/ptrace.h>
#include <sys/user.h>
#include <sys/wait.h>
#include <unistd.h>

void law_step(void *, const void *, void *);
int harness(int argc, char **argv);

/* Count every instruction between the entry of law_step and its return, stopping after each one. */
int main(int argc, char **argv)
{
    long back = 0, count = 0;
    int status = 0;
    const pid_t child = fork();
    if (child == 0) {
        ptrace(PTRACE_TRACEME, 0, NULL, NULL);
        raise(SIGSTOP);
        _exit(harness(argc, argv));
    }
    for (waitpid(child, &status, 0); !WIFEXITED(status); waitpid(child, &status, 0)) {
        const long at = ptrace(PTRACE_PEEKUSER, child, (void *)offsetof(struct user_regs_struct, rip), NULL);
        if (back == 0 && at == (long)(intptr_t)law_step) {
            const long top = ptrace(PTRACE_PEEKUSER, child, (void *)offsetof(struct user_regs_struct, rsp), NULL);
            back = ptrace(PTRACE_PEEKDATA, child, (void *)top, NULL);
            count = 0;
        } else if (back != 0) {
            ++count;
            if (at == back) {
                printf("%ld\\n", count);
                back = 0;
            }
        }
        ptrace(PTRACE_SINGLESTEP, child, NULL, NULL);
    }
    return WEXITSTATUS(status);
}
"""


@needs_compiler
@pytest.mark.slow
@pytest.mark.skipif(shutil.which("valgrind") is None, reason="valgrind is not installed")
@pytest.mark.skipif(
    sys.platform != "linux" or platform.machine() != "x86_64", reason="the program reads registers of x86-64 on Linux"
)
def test_callgrind_counts_what_single_stepping_counts(tmp_path: Path) -> None:
    """Compare the counts of all samples of a short flight, and the table with them."""
    loaded = load_scenario("nominal", [f"run.duration_s={0.01 * SAMPLES + 0.005}", "requirement="])
    found = exported(loaded, tmp_path)
    counts = callgrind_counts(found.program, found.file)
    (tmp_path / "stepper.c").write_text(STEPPER)
    (tmp_path / "harness.c").write_text((tmp_path / "harness.c").read_text().replace("int main(", "int harness("))
    relaxed = ("-Wno-pedantic", "-Wno-missing-prototypes")
    stepper = compiled(tmp_path, *relaxed, out="stepper", sources=(*LAW, "harness.c", "stepper.c"))
    said = subprocess.run([stepper, found.file], capture_output=True, text=True, check=True, timeout=100)
    stepped = [int(line) for line in said.stdout.split()]
    assert len(stepped) == SAMPLES
    assert stepped == counts.tolist()
    assert min(stepped) > 200
    assert max(stepped) < 1000
    row = table([Counted("ksr3-robust", counts, found.tape, found.state_bytes)]).splitlines()[-1]
    at_s = 0.01 * (1 + int(np.argmax(stepped)))
    assert row.startswith(f"| `ksr3-robust` | {SAMPLES} | {np.mean(stepped):,.0f} | {max(stepped)} | {at_s:.2f} s |")


BOUNDS = {
    "LAW_FILTER_PARAMETERS",
    "LAW_FURTHER_GYROS",
    "LAW_MOST_SECTIONS",
    "(2 * LAW_GAINS)",
    "4 * LAW_MOST_SECTIONS",
    "2",
    "3",
    "4",
    "sections",  # of->sections, of->loop_sections: numbers of the tables
    "of->filter_quadratic",
    "of->filter_quadratic + of->filter_first_order",
}
"""The bounds of counting loops: constants of the tables."""
SEARCHES = {
    "high - low > 1": "halves the number of breakpoints, hence at most log2 of it, rounded up",
    "(state->stage < stage) && (state->stage < LAW_STAGES - 1)": "counts up to the number of stages, once a flight",
}


def test_every_loop_of_the_exported_law_has_a_bound_of_its_tables() -> None:
    """Read all loops: counting up to a constant of the tables, or one of two searches that end by their condition."""
    text = re.sub(r"/\*.*?\*/", "", (HEADER.parent / "flight_law" / "flight_law.c").read_text(), flags=re.DOTALL)
    loops = re.findall(r"\b(for|while|do|goto)\b\s*(\((?:[^()]|\([^()]*\))*\))?", text)
    counting = [condition for kind, condition in loops if kind == "for"]
    for condition in counting:
        found = re.fullmatch(r"\((\w+) = [\w>-]+; \1 < (.+); \+\+\1\)", condition)
        assert found is not None, condition
        assert found[2] in BOUNDS, condition
    assert len(counting) > 20
    assert {condition[1:-1] for kind, condition in loops if kind != "for"} == set(SEARCHES)
    recursive = re.findall(r"static \w+ \*?(\w+)\(", text)
    for name in recursive:
        body = re.split(rf"static \w+ \*?{name}\(", text)[1].split("\n}\n")[0]
        assert not re.search(rf"\b{name}\(", body), name
