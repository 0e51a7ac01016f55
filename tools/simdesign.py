"""The command `simdesign`: optimise a control design, or judge one. Nothing heavy is imported before it is known what
to do."""

from __future__ import annotations

import difflib
import os

from maxq.tools.cli.frame import Command, Exit, show_list
from maxq.tools.cli.parser import Parser, count_from_1, filled, positive, seconds

_USAGE = """\
simdesign CASE [--out DIR] [--starts N] [--seed N] [--set KEY=VALUE]... [--orders] [--no-pictures]
       simdesign CASE... --verify [--suite SUITE] [and the options of CASE]
       simdesign analyse DESIGN [--at T]... [--scenario S] [--kind K] [--axis A] [--out DIR] [--no-pictures]
       simdesign errata [DESIGN] [--at T]... [--scenario S] [--out FILE]
       simdesign export DESIGN --c DIR | --format F [--out FILE] [--at T]... [--axis A] [--scenario S]
       simdesign bias SCENARIO [--wind PROFILE] [--share X] [--out FILE]
       simdesign --list | --version | --help"""
_EXAMPLES = """\
  simdesign ksr3-identical                 optimise the built-in case of that name
  simdesign mine.toml --out runs/mine      optimise your own; fly it with
  simrun nominal --set design=runs/mine/design.toml
  simdesign ksr3-identical ksr3-robust --verify   design both, then simverify the
                                           better one, and the other if need be
  simdesign analyse ksr3-default           margins of a built-in design at every node
  simdesign analyse runs/mine --at 30 --at 45     of the design that a case has left
                                           there, at two times
  simdesign errata                         what each erratum of the paper does to
                                           peaks and margins
  simdesign export ksr3-robust --c law     the law as C99 sources, with a unit test
  simdesign export ksr3-robust --format mat   plant, law and loop as matrices
  simdesign bias nominal --wind today.csv  the pitch programme, biased for a measured
                                           wind
  simdesign --list                         built-in cases and designs
"""
_EXITS = {
    Exit.OK: "designed, all limits met; analyse: stable at every node, and all\n"
    "       limits met that the design states; --verify: one design is accepted",
    Exit.FAILED: "infeasible (the best effort is written, and marked); analyse: unstable\n"
    "       or a limit missed; --verify: none is accepted",
    Exit.BAD_INPUT: "bad input, nothing written, or files that cannot be read or written",
    Exit.UNDECIDED: "--verify: none is accepted, and one needs more runs",
    Exit.INTERRUPTED: "interrupted, the best design so far is kept",
}
_CASE, _VERIFY, _ANALYSE, _ERRATA, _EXPORT, _BIAS = "CASE", "CASE --verify", "analyse", "errata", "export", "bias"
_CASES, _JUDGED = (_CASE, _VERIFY), (_ANALYSE, _ERRATA)
_ON_A_DESIGN = (*_JUDGED, _EXPORT)
_COMMANDS = (*_ON_A_DESIGN, _BIAS)
_EVERY = (*_CASES, *_COMMANDS)


def _parser() -> Parser:
    about = "Optimise gain schedules and bending filter; judge designs in the frequency domain."
    parser = Parser("simdesign", _USAGE, about, _EXAMPLES, _EXITS)
    add = parser.option
    add("CASE...", "case file (.toml), or name of a built-in case; or a command as above", dest="words")
    add("--out DIR", "where to write (default: runs/<name of the case>, or runs/analyse-<name>)", _EVERY)
    add("--starts N", "starts of the optimiser instead of the case's", _CASES, type=count_from_1)
    add("--seed N", "seed of the starts instead of the case's", _CASES, type=int)
    parser.overrides("the case, e.g. limits.gain_margin_db=7", _CASES)
    add("--orders", "also F2 to F6 with all three gain schedules: the paper's Fig. 9", _CASES)
    add("--verify", "then try what was designed, best first, until simverify accepts one", _CASES)
    add("--suite SUITE", "what has to be passed (default: standard)", [_VERIFY])
    add("--at T...", "vehicle time, s", _ON_A_DESIGN, type=seconds, dest="times_s")
    about = "judge at the rows of the gain tables and every S seconds, not at the operating points as designed"
    add("--every S", about, [_ANALYSE], type=positive, dest="every_s")
    add(
        "--scenario S",
        "scenario whose flight gives the nodes (default: nominal; of analyse: the design's, if built in)",
        _ON_A_DESIGN,
    )
    add("--vehicle V", "vehicle folder instead of the scenario's", _ON_A_DESIGN)
    add(
        "--kind sampled|pade|exact",
        "model of the computer (default: as designed, else sampled, as it flies)",
        [_ANALYSE],
    )
    add("--axis pitch|yaw", "plane (default: as designed, else pitch; of an export: both)", [_ANALYSE, _EXPORT])
    add("--c DIR", "the law as C99 sources with tables, unit test and CMake file", [_EXPORT])
    about = "plant, law and loop at the nodes as A, B, C, D for MATLAB, NumPy or any reader"
    add("--format mat|npz|json", about, [_EXPORT])
    add(
        "--errata corrected|paper", "equations corrected or as the paper prints them (default: as designed)", [_ANALYSE]
    )
    add(
        "--plant flown|table2",
        "vehicle as flown (default, unless designed otherwise), or with the ranges of Table 2",
        _JUDGED,
    )
    add("--wind PROFILE", "measured wind over altitude (.csv) instead of the scenario's", [_BIAS])
    about = "of the incidence that the wind adds, to be taken away: 0 to 1 (default: 1)"
    add("--share X", about, [_BIAS], type=positive)
    add("--faults", "nodes of the flight with the scenario's faults", [_ANALYSE])
    add("--no-pictures", "tables and files only", [*_CASES, _ANALYSE])
    add("--no-trials", "of an infeasible case: no trials with wider bounds, higher order, faster samples", _CASES)
    add("--list", "name the built-in cases and designs")
    parser.version_and_help()
    return parser


def _run(arguments: list[str]) -> int:
    parser = _parser()
    options = parser.read(arguments)
    if options.words and options.words[0] in _COMMANDS:
        mode, names = options.words[0], options.words[1:]
    else:
        mode, names = _VERIFY if options.verify else _CASE, options.words
    if options.list and options.words:
        parser.error(f"{mode} and --list exclude each other")
    if not options.list and not options.words:
        parser.error("give a case, e.g. simdesign ksr3-identical, or analyse DESIGN")
    parser.check(options, "--list" if options.list else mode)
    _check_names(names, mode, parser)
    if options.every_s is not None and options.every_s < 0.01:
        parser.error("--every takes 0.01 s or more")
    if options.list:
        return show_list({"case": "cases (simdesign CASE)", "design": "designs (simdesign analyse DESIGN)"})
    pictures = not options.no_pictures
    if mode == _ANALYSE:
        from maxq.tools.design import analyse, report  # noqa: PLC0415  # lazy, as all imports here: --help is quick

        given = tuple(
            key
            for key in ("scenario", "kind", "axis", "errata", "plant", "every_s")
            if getattr(options, key) is not None
        )
        order = filled(report.AnalysisOrder, options, design=names[0], pictures=pictures, given=given)
        return analyse.execute(order)
    if mode == _EXPORT:
        from maxq.tools.design import export  # noqa: PLC0415  # lazy

        if (options.c is None) == (options.format is None):
            parser.error("export takes one of --c DIR and --format F")
        if options.c is not None and (options.out or options.times_s or options.axis):
            parser.error("--out, --at and --axis go with --format")
        return export.execute(filled(export.Order, options, design=names[0]))
    if mode == _BIAS:
        from maxq.tools.design import bias  # noqa: PLC0415  # lazy

        if options.share is not None and options.share > 1.0:
            parser.error("--share takes a number up to 1")
        return bias.execute(filled(bias.Order, options, scenario=names[0]))
    if mode == _ERRATA:
        from maxq.tools.design import analyse, report  # noqa: PLC0415  # lazy

        return analyse.execute_errata(filled(report.AnalysisOrder, options, design=names[0] if names else None))
    from maxq.tools.design import run_case  # noqa: PLC0415  # lazy

    said = {"pictures": pictures, "trials": not options.no_trials}
    orders = [
        filled(run_case.Order, options, case=name, out=_folder(options.out, name, len(names)), **said) for name in names
    ]
    if options.verify:
        from maxq.tools.verify.run import execute_cases  # noqa: PLC0415  # lazy

        return execute_cases(orders, options.suite or "standard", pictures)
    return run_case.execute(orders[0])


def _check_names(names: list[str], mode: str, parser: Parser) -> None:
    if len(names) > 1 and mode != _VERIFY:
        close = difflib.get_close_matches(names[0], (*_COMMANDS, "analyze"), 1, 0.7)
        hint = f"did you mean {_ANALYSE if close[0] == 'analyze' else close[0]}?" if close else "one at a time"
        parser.error(f"what is {names[0 if close else 1]!r}? {hint}")
    if mode in (_ANALYSE, _EXPORT) and not names:
        parser.error(f"give a design, e.g. simdesign {mode} ksr3-default")
    if mode == _BIAS and not names:
        parser.error("give a scenario, e.g. simdesign bias nominal --wind today.csv")
    if len(set(names)) < len(names):
        parser.error("a case is named twice")


def _folder(out: str | None, case: str, cases: int) -> str | None:
    """Several cases get a folder each inside --out."""
    if out is None or cases == 1:
        return out
    return os.path.join(out, os.path.basename(case).removesuffix(".toml"))


command = Command("simdesign", _run, "interrupted; nothing written")
main = command.main

if __name__ == "__main__":
    command()
