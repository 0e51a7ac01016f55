"""`simdesign CASE... --verify`: what has been designed is tried in order of merit until the harness accepts one."""

from __future__ import annotations

import shlex
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from maxq.design.case.design_file import design_path
from maxq.design.verify import memory
from maxq.design.verify.judging import judge, make_design
from maxq.design.verify.suite import ACCEPTED, UNDECIDED, read_suite
from maxq.design.verify.verify import Verification, Watch, verify
from maxq.sim.scenario.schema_design import Design
from maxq.tools.cli.frame import Exit, Interruption, say
from maxq.tools.cli.terminal import Progress, aligned
from maxq.tools.design import run_case
from maxq.tools.verify.report import headline, reasons, write_pack


@dataclass(frozen=True)
class Candidate:
    """A design in a folder. `objective_db` is the case's, less is better; `modulus` the least |1 + L| as it flies."""

    folder: Path
    meets_limits: bool
    kind: str
    objective_db: float
    modulus: float


def execute(orders: Sequence[run_case.Order], suite: str, pack: bool = True) -> int:
    """Design each case, then verify in order of merit; returns the exit code."""
    read_suite(suite)  # a mistake in it is reported before the minutes of designing
    made = []
    for order in orders:
        made.append(run_case.make(order))
        if made[-1].code == Exit.INTERRUPTED:
            return Exit.INTERRUPTED
        print()
    return _verify([c for one in made for c in candidates(one)], suite, pack)


def candidates(made: run_case.Made) -> Iterator[Candidate]:
    """The case's design, and with --orders those of every filter and schedule that meet the limits."""
    nodes = [j.node for j in made.outcome.judged]
    kind = made.solution.case.objective.kind

    def modulus(design: Design) -> float:
        return min(j.margins.modulus if j.margins.stable else -1.0 for j in judge(nodes, design, "sampled"))

    yield Candidate(
        made.folder, made.meets_limits, kind, made.solution.objective_db, modulus(made.outcome.design)
    )  # fmt: skip
    for (structure, schedule), (loaded, solution) in (made.orders or {}).items():
        if solution.feasible:
            folder, design = run_case.order_folder(made.folder, structure, schedule), make_design(loaded, solution)
            yield Candidate(folder, True, kind, solution.objective_db, modulus(design))


def in_order(found: Sequence[Candidate]) -> list[Candidate]:
    """Those that meet their cases' limits first; then by the objective where all have the same, else by the least
    |1 + L|, which can be compared."""
    same = len({c.kind for c in found}) < 2
    return sorted(found, key=lambda c: (not c.meets_limits, c.objective_db if same else -c.modulus))


def _verify(found: Sequence[Candidate], suite: str, pack: bool) -> int:
    ranked = in_order(found)
    rows = [("", "candidate", "objective, dB", "least |1 + L|", "limits of its case")]
    rows += [
        (str(n), str(c.folder), f"{c.objective_db:.3f}", f"{c.modulus:.3f}" if c.modulus > 0.0 else "unstable",
         "met" if c.meets_limits else "MISSED")
        for n, c in enumerate(ranked, 1)
    ]  # fmt: skip
    print("\n".join(["candidates in order of merit", *aligned(rows, "  ", right=(0, 2, 3))]) + "\n")

    def keep(design: str, verified: Verification) -> None:
        write_pack(verified, Path(design), shlex.join(["simverify", design, "--suite", suite, "--out", design]), pack)

    names = [str(c.folder) for c in ranked]
    try:
        with Interruption() as interruption, Progress() as progress:
            accepted, every = try_in_order(
                names, suite, keep=keep, watch=progress.show, stop=lambda: interruption.requested
            )  # fmt: skip
    except KeyboardInterrupt:
        say("simdesign", "interrupted; what was worked out is kept, the same command resumes")
        return Exit.INTERRUPTED
    count = "the only candidate" if len(names) == 1 else f"candidate {len(every)} of {len(names)}"
    if accepted is not None:
        print(f"\nACCEPTED by the suite {suite}: {accepted}, {count}; its review: {accepted}/review.html")
        return Exit.OK
    open_ = [name for name, v in zip(names, every, strict=True) if v.judgement == UNDECIDED]
    print(f"\nNONE ACCEPTED by the suite {suite}" + (f"; undecided: {', '.join(open_)}" if open_ else ""))
    return Exit.UNDECIDED if open_ else Exit.FAILED


def try_in_order(
    designs: Sequence[str],
    suite: str = "standard",
    overrides: Iterable[str] = (),
    *,
    tell: Callable[[str], None] = print,
    keep: Callable[[str, Verification], None] = lambda design, found: None,
    watch: Watch = lambda what, done, of: None,
    stop: Callable[[], bool] = lambda: False,
) -> tuple[str | None, list[Verification]]:
    """Verify one design after the other up to the first that is accepted.

    `designs` as for `simverify`, in order of preference. `tell` gets, line by line, the verdict on each and the
    requirements not met; `keep` each verification when it is complete. An undecided design is not accepted. Returns the
    accepted design, or None, and all verifications. Raises ScenarioError before anything is flown, KeyboardInterrupt
    soon after `stop` returns True.
    """
    loaded, paths = read_suite(suite, overrides), [design_path(design) for design in designs]
    every: list[Verification] = []
    for design, path in zip(designs, paths, strict=True):
        found = verify(path, loaded, memory=memory.default_folder(), watch=watch, stop=stop)
        every.append(found)
        keep(design, found)
        for line in (headline(found, design), *reasons(found)):
            tell(line)
        if found.judgement == ACCEPTED:
            return design, every
    return None, every
