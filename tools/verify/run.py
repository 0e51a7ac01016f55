"""The command `simverify DESIGN...`: judge designs by a suite, write verdicts and review packs, and rank the designs.

`simdesign CASE... --verify` tries designs in order of merit until the suite accepts one.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

from maxq.design.laws.design_file import DESIGN_NAME, design_path
from maxq.design.optimise.solution import Solution
from maxq.design.verify import ledger, memory, seeds
from maxq.design.verify import suite as suites
from maxq.design.verify.compared import against_basis
from maxq.design.verify.flown import load_wanted
from maxq.design.verify.judging import judge
from maxq.design.verify.parts import Watch
from maxq.design.verify.verify import SAMPLE, WAITING, Verification, part_alone, prepare, verify
from maxq.sim.campaign.schema import Campaign
from maxq.sim.files import check_writable, plain_name
from maxq.sim.input.errors import ScenarioError
from maxq.sim.run.guard import kill_workers
from maxq.sim.scenario.flight_code import flight_code_key
from maxq.sim.scenario.schema_design import Design
from maxq.tools.cli.frame import CommandError, Exit, Interruption, say
from maxq.tools.cli.terminal import Progress, aligned, printable, tell
from maxq.tools.design import run_case
from maxq.tools.exchange.junit import checked_path, suite_of_verification, write_junit
from maxq.tools.verify import report, signing
from maxq.tools.verify.outcome import headline

KEPT = "interrupted; finished results are kept, and the same command resumes"
_EXIT: dict[suites.SuiteVerdict, Exit] = {
    suites.ACCEPTED: Exit.OK,
    suites.WAIVED: Exit.OK,
    suites.SCREENED: Exit.OK,
    suites.REJECTED: Exit.FAILED,
    suites.UNDECIDED: Exit.UNDECIDED,
}


def execute(
    designs: Sequence[str],
    *,
    suite: str = "standard",
    overrides: tuple[str, ...] = (),
    vehicle: str | None = None,
    out: str | None = None,
    only: str | None = None,
    no_pack: bool = False,
    afresh: bool = False,
    sample: int = SAMPLE,
    register: bool = False,
    sign: str | None = None,
    author: str = "",
    revision: str = "",
    date: str = "",
    junit: str | None = None,
    end: Callable[[], object] | None = None,
) -> int:
    """Verify designs, write their packs and rank them. Return the exit code for the best design.

    The arguments are the options of `simverify`. `end` ends the process if an interrupted computation does not return
    soon. Raises CommandError and ScenarioError.
    """
    if len(set(designs)) < len(designs):
        raise CommandError("a design is named twice")
    paths = [design_name(name) for name in designs]
    folders = [folder_of(name, out, only, len(designs)) for name in designs]
    loaded = suites.read_suite(suite, overrides)
    changes = suites.shared_risk(loaded, campaigns_of(loaded, paths[0], vehicle), len(paths))
    if changes:
        loaded = suites.read_suite(suite, [*overrides, *changes])
        tell(f"{len(paths)} designs share the risk of a wrong acceptance: {', '.join(changes)}\n")
    words = ("--only", only) if only else ()
    if only:
        loaded = part_alone(loaded, only, paths[0], vehicle, memory.PartsOnDisk(memory.default_folder()))
    if register:
        return _register(paths, loaded, vehicle)
    if sign is not None:
        signing.check_key(Path(sign))
    junit_path = None if junit is None else checked_path(junit)
    for folder in [*folders, *([junit_path.parent] if junit_path is not None else [])]:
        check_writable(folder)
    found: list[Verification] = []
    with Interruption(last_resort=_without_workers(end)) as stop, Progress() as progress:
        for name, path, folder in zip(designs, paths, folders, strict=True):
            begun = time.perf_counter()
            try:
                one = verify(
                    path,
                    loaded,
                    vehicle=vehicle,
                    memory=None if afresh else memory.default_folder(),
                    watch=_announced(progress),
                    stop=stop,
                    sample=sample,
                )
            except ValueError as error:
                if not str(error).startswith("operating point at"):
                    raise
                raise ScenarioError(loaded.label, str(error)) from None  # the suite's times are invalid
            found.append(one)
            progress.show(f"writing the review pack of {name}", 0, 0)
            signed = report.Signed(author, revision, date)
            files = report.write_pack(one, folder, loaded.command(name, vehicle, *words), not no_pack, signed)
            if sign is not None:
                files.append(signing.sign(files[0], Path(sign)))
            missed = report.reasons(one)
            tell(
                *against_basis(one.suite, one.scenario),
                *report.report(one, f"{name} by the suite {one.suite.name}"),
                *(("", "requirements not shown to be met", *missed) if missed else ()),
            )
            for left in one.left_out:
                tell(f"left out: {printable(left)}")
            for warning in one.scenario.warnings:
                tell(f"warning: {printable(warning)}")
            tell(
                f"\n{len(files)} file{'s' * (len(files) > 1)} in {folder}/; {time.perf_counter() - begun:.1f} s, "
                f"{one.recalled} results recalled from the cache\n{headline(one)}\n"
            )
    if len(found) > 1:
        tell(*report.ranking(found))
    if junit_path is not None:
        write_junit(junit_path, map(suite_of_verification, found, designs))
    return _EXIT[report.ranked(found)[0].judgement]


def _without_workers(end: Callable[[], object] | None) -> Callable[[], object] | None:
    """Return a function that kills the processes of flight code and calls `end`, or None without `end`."""

    def kill_and_end() -> None:
        assert end is not None
        kill_workers()
        end()

    return None if end is None else kill_and_end


def _announced(progress: Progress) -> Watch:
    """Return a callback that shows progress and reports once that it is waiting for another process."""
    said = set[str]()

    def show(what: str, done: int, of: int) -> None:
        if WAITING in what and what not in said:
            said.add(what)
            say("simverify", what)
        progress.show(what, done, of)

    return show


def design_name(given: str) -> str:
    """Return the name of a design or of flight code in the form that `verify` accepts. Raises ScenarioError."""
    return given if flight_code_key(given) else design_path(given)


def _register(designs: Sequence[str], loaded: suites.LoadedSuite, vehicle: str | None) -> int:
    """Write seeds that were chosen by hand into the ledger, before any attempt with them. Return the exit code.

    Raises CommandError if no seed was chosen by hand, or if a seed cannot be registered.
    """
    for design in designs:
        prepared = prepare(design, loaded, vehicle, memory.PartsOnDisk(memory.default_folder()))
        name, vehicle_hash = prepared.scenario.vehicle.name, prepared.entry()["hashes"]["vehicle"]
        path = ledger.ledger_path()
        try:
            known = ledger.lines_of(ledger.read_lines(path)[0], name, vehicle_hash)
            line = seeds.registered(prepared.seeds, known, vehicle_hash)
        except ValueError as error:
            raise CommandError(str(error)) from None
        if not line["seeds"]:
            raise CommandError("no seed is chosen by hand; give one, such as --set campaign.0.seed=7")
        ledger.append(path, {"vehicle": name, **line})
        tell(f"registered for {name}: " + ", ".join(f"seed {value} of {of}" for of, value in line["seeds"].items()))
    return Exit.OK


def campaigns_of(loaded: suites.LoadedSuite, design: str, vehicle: str | None = None) -> list[Campaign]:
    """Return the suite's campaigns without their limits, which depend on the vehicle. Raises ScenarioError."""
    suite = loaded.suite.model_copy(update={"dispersed_limit": ()})
    return [load_wanted(replace(loaded, suite=suite), w, design, vehicle).campaign for w in suite.campaign]


def folder_of(design: str, out: str | None, only: str | None, designs: int) -> Path:
    """Return the folder of a design's pack. If there are several designs, each has a folder inside `out`."""
    path = Path(design)
    name = path.parent.name if path.name == DESIGN_NAME else path.name.removesuffix(".toml")
    plain = plain_name(name, "design")
    if out is None:
        return Path("runs") / "-".join(filter(None, ("verify", plain, plain_name(only or "", ""))))
    return Path(out) if designs == 1 else Path(out) / plain


# Candidates of simdesign


@dataclass(frozen=True)
class Candidate:
    """A design in a folder that may be verified.

    `objective_db` is the objective of its case; less is better. `modulus` is the least |1 + L| of the sampled loop, or
    -1 if it is unstable.
    """

    folder: Path
    meets_limits: bool
    kind: str
    objective_db: float
    modulus: float


def candidates(made: run_case.Made) -> Iterator[Candidate]:
    """Yield the case's design and, with --orders, the design of every filter and schedule that meets the limits."""
    found = made.found
    nodes = [j.node for outcome, _ in found.results for j in outcome.judged]

    def candidate(folder: Path, meets_limits: bool, solutions: Sequence[Solution], design: Design) -> Candidate:
        solution = max(solutions, key=lambda s: s.objective_db)
        modulus = min(j.margins.modulus if j.margins.stable else -1.0 for j in judge(nodes, design, "sampled"))
        return Candidate(folder, meets_limits, solution.case.objective.kind, solution.objective_db, modulus)

    yield candidate(made.folder, found.feasible, [solution for _, solution in found.results], found.design)
    for structure, schedule, design, solutions in run_case.order_designs(made.orders):
        yield candidate(run_case.order_folder(made.folder, structure, schedule), True, solutions, design)


def in_order(found: Sequence[Candidate]) -> list[Candidate]:
    """Return the candidates in order of merit, those that meet their cases' limits first.

    The order is by the objective if all have the same kind of objective, else by the least |1 + L|, which is
    comparable.
    """
    same = len({c.kind for c in found}) < 2
    return sorted(found, key=lambda c: (not c.meets_limits, c.objective_db if same else -c.modulus))


def execute_cases(
    cases: Iterable[Callable[[], run_case.Made]],
    suite: str,
    pack: bool = True,
    end: Callable[[str], object] | None = None,
) -> int:
    """Run each case, then verify the designs in order of merit. Return the exit code.

    `pack` adds the review to each pack. For `end`, see `execute`.
    """
    suites.read_suite(suite)  # report an error in the suite before the minutes of designing
    made = []
    for design in cases:
        made.append(design())
        if made[-1].code == Exit.INTERRUPTED:
            return Exit.INTERRUPTED
        tell()
    ranked = in_order([c for one in made for c in candidates(one)])
    rows = [("", "candidate", "objective, dB", "least |1 + L|", "limits of its case")]
    rows += [
        (
            str(n),
            str(c.folder),
            f"{c.objective_db:.3f}",
            f"{c.modulus:.3f}" if c.modulus > 0.0 else "unstable",
            "met" if c.meets_limits else "MISSED",
        )
        for n, c in enumerate(ranked, 1)
    ]
    tell("candidates in order of merit", *aligned(rows, "  ", right=(0, 2, 3)), "")

    def keep(design: str, found: Verification, loaded: suites.LoadedSuite) -> None:
        report.write_pack(found, Path(design), loaded.command(design, None, "--out", design), pack)

    names = [str(c.folder) for c in ranked]
    try:
        last_resort = _without_workers(None if end is None else partial(end, KEPT))
        with Interruption(last_resort=last_resort) as stop, Progress() as progress:
            accepted, every = try_in_order(names, suite, keep=keep, watch=progress.show, stop=stop)
    except KeyboardInterrupt:
        say("simdesign", KEPT)
        return Exit.INTERRUPTED
    if accepted is not None:
        count = "the only candidate" if len(names) == 1 else f"candidate {len(every)} of {len(names)}"
        verdict = every[-1].judgement.upper()
        tell(f"\n{verdict} by the suite {suite}: {accepted}, {count}; its review: {accepted}/review.html")
        return Exit.OK
    open_ = [name for name, v in zip(names, every, strict=True) if v.judgement == suites.UNDECIDED]
    tell(f"\nNONE PASSED the suite {suite}" + (f"; undecided: {', '.join(open_)}" if open_ else ""))
    return Exit.UNDECIDED if open_ else Exit.FAILED


def try_in_order(
    designs: Sequence[str],
    suite: str = "standard",
    overrides: Iterable[str] = (),
    *,
    tell: Callable[[str], None] = tell,
    keep: Callable[[str, Verification, suites.LoadedSuite], None] = lambda design, found, loaded: None,
    watch: Watch = lambda what, done, of: None,
    stop: Callable[[], bool] = lambda: False,
) -> tuple[str | None, list[Verification]]:
    """Verify designs one after the other until one is accepted, or passes if the suite is a screening.

    `designs` are as for `simverify`, in order of preference. Each has its share of the risk of a wrong acceptance, and
    its own draws (`shared_risk`). `tell` receives, line by line, each verdict and the requirements not met. `keep`
    receives each verification when it is complete, with its suite. An undecided design is not accepted.

    Return the accepted design, or None, and all verifications. Raises ScenarioError before any flight, and
    KeyboardInterrupt soon after `stop` returns True.
    """
    wanted, paths = suites.read_suite(suite, overrides), [design_path(design) for design in designs]
    campaigns, given = campaigns_of(wanted, paths[0]), wanted.overrides
    every: list[Verification] = []
    for number, (design, path) in enumerate(zip(designs, paths, strict=True)):
        loaded = suites.read_suite(suite, [*given, *suites.shared_risk(wanted, campaigns, len(paths), number)])
        found = verify(path, loaded, memory=memory.default_folder(), watch=watch, stop=stop, candidate=number)
        every.append(found)
        keep(design, found, loaded)
        for line in (headline(found, design), *report.reasons(found)):
            tell(line)
        if found.judgement in (suites.ACCEPTED, suites.SCREENED):
            return design, every
    return None, every
