"""The command `simdesign`: optimise a control design, or judge one. Nothing heavy is imported before it is known what
to do."""

from __future__ import annotations

import difflib
import os
import sys
from typing import NoReturn

from maxq.tools.cli.frame import Exit, process, run, show_list
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


def _parser() -> Parser:
    about = "Optimise gain schedules and bending filter; judge designs in the frequency domain."
    parser = Parser("simdesign", _USAGE, about, _EXAMPLES, _EXITS)
    add = parser.option
    add(
        "words",
        nargs="*",
        metavar="CASE",
        default=[],
        help="case file (.toml), or name of a built-in case; or a command as above",
    )
    add(
        "--out",
        modes=(*_CASES, *_ON_A_DESIGN, _BIAS),
        metavar="DIR",
        help="where to write (default: runs/<name of the case>, or runs/analyse-<name>)",
    )
    add("--starts", modes=_CASES, type=count_from_1, metavar="N", help="starts of the optimiser instead of the case's")
    add("--seed", modes=_CASES, type=int, metavar="N", help="seed of the starts instead of the case's")
    add(
        "--set", modes=_CASES, metavar="KEY=VALUE", action="append", default=[], dest="overrides",
        help="override a value of the case, e.g. limits.gain_margin_db=7; repeatable",
    )  # fmt: skip  # five more lines otherwise
    add(
        "--orders",
        modes=_CASES,
        action="store_true",
        help="also F2 to F6 with all three gain schedules: the paper's Fig. 9",
    )
    add(
        "--verify",
        modes=_CASES,
        action="store_true",
        help="then try what was designed, best first, until simverify accepts one",
    )
    add("--suite", modes=(_VERIFY,), metavar="SUITE", help="what has to be passed (default: standard)")
    add("--at", modes=_ON_A_DESIGN, type=seconds, metavar="T", action="append", dest="times_s", help="vehicle time, s")
    add(
        "--every", modes=(_ANALYSE,), type=positive, metavar="S", dest="every_s",
        help="seconds between the nodes, where no --at is given (default: 5); 0.25 finds what lies between",
    )  # fmt: skip  # four more lines otherwise
    add("--scenario", modes=_ON_A_DESIGN, metavar="S", help="scenario whose flight gives the nodes (default: nominal)")
    add("--vehicle", modes=_ON_A_DESIGN, metavar="V", help="vehicle folder instead of the scenario's")
    add(
        "--kind",
        modes=(_ANALYSE,),
        choices=("sampled", "pade", "exact"),
        help="model of the computer (default: sampled, as it flies)",
    )
    add(
        "--axis", modes=(_ANALYSE, _EXPORT), choices=("pitch", "yaw"), help="plane (default: pitch; of an export: both)"
    )
    add("--c", modes=(_EXPORT,), metavar="DIR", help="the law as C99 sources with tables, unit test and CMake file")
    add(
        "--format",
        modes=(_EXPORT,),
        choices=("mat", "npz", "json"),
        help="plant, law and loop at the nodes as A, B, C, D for MATLAB, NumPy or any reader",
    )
    add(
        "--errata",
        modes=(_ANALYSE,),
        choices=("corrected", "paper"),
        help="equations corrected (default) or as the paper prints them",
    )
    add(
        "--plant",
        modes=_JUDGED,
        choices=("flown", "table2"),
        help="vehicle as flown (default), or with the ranges of Table 2",
    )
    add(
        "--wind", modes=(_BIAS,), metavar="PROFILE", help="measured wind over altitude (.csv) instead of the scenario's"
    )
    add(
        "--share", modes=(_BIAS,), type=positive, metavar="X",
        help="of the incidence that the wind adds, to be taken away: 0 to 1 (default: 1)",
    )  # fmt: skip  # four more lines otherwise
    add("--faults", modes=(_ANALYSE,), action="store_true", help="nodes of the flight with the scenario's faults")
    add("--no-pictures", modes=(*_CASES, _ANALYSE), action="store_true", help="tables and files only")
    add("--list", action="store_true", help="name the built-in cases and designs")
    parser.version_and_help()
    return parser


def command() -> NoReturn:
    """`simdesign` as a process."""
    process(main)


def main(arguments: list[str] | None = None) -> int:
    """Run the command; returns the exit code."""
    given = sys.argv[1:] if arguments is None else arguments
    return run("simdesign", lambda: _run(given), "interrupted; nothing written")


def _run(arguments: list[str]) -> int:
    parser = _parser()
    options = parser.read(arguments)
    if options.words and options.words[0] in (*_ON_A_DESIGN, _BIAS):
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
    if options.out == "":
        parser.error("--out needs the name of a folder")
    if options.list:
        return show_list({"case": "cases (simdesign CASE)", "design": "designs (simdesign analyse DESIGN)"})
    pictures = not options.no_pictures
    if mode == _ANALYSE:
        from maxq.tools.design import analyse  # noqa: PLC0415  # lazy, as all imports here: --help is quick

        return analyse.execute(filled(analyse.Order, options, design=names[0], pictures=pictures))
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
        from maxq.tools.design import analyse  # noqa: PLC0415  # lazy

        return analyse.execute_errata(filled(analyse.Order, options, design=names[0] if names else None))
    from maxq.tools.design import run_case  # noqa: PLC0415  # lazy

    orders = [
        filled(run_case.Order, options, case=name, out=_folder(options.out, name, len(names)), pictures=pictures)
        for name in names
    ]
    if options.verify:
        from maxq.tools.verify.run import execute_cases  # noqa: PLC0415  # lazy

        return execute_cases(orders, options.suite or "standard", pictures)
    return run_case.execute(orders[0])


def _check_names(names: list[str], mode: str, parser: Parser) -> None:
    if len(names) > 1 and mode != _VERIFY:
        close = difflib.get_close_matches(names[0], (*_ON_A_DESIGN, _BIAS, "analyze"), 1, 0.7)
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


if __name__ == "__main__":
    command()
