"""The command `simdesign`: optimise or analyse a control design.

Expensive modules are imported only once the task is known.
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Sequence
from functools import partial
from typing import Any

from maxq.tools.cli.frame import Command, CommandError, Exit
from maxq.tools.cli.parser import Parser, count_from_1, number, seconds

_EXAMPLES = """\
  simdesign ksr3-identical                 optimise a built-in case
  simdesign mine.toml --out runs/mine      optimise your own case
  simrun nominal --set design=runs/mine/design.toml   fly the design found
  simdesign analyse ksr3-default           measure the margins of a built-in design
  simdesign analyse runs/mine              measure those of your design
  simdesign open ksr3-default              change gains and filter by hand
  simdesign export ksr3-robust --c law     write the law as C99 sources
  simdesign bias nominal                   bias the pitch programme for a wind
"""
_EXITS = {
    Exit.OK: "done; optimise: designed, all limits met; analyse: stable at every operating point, all limits met",
    Exit.FAILED: "optimise: infeasible, or no design accepted; analyse: unstable, or a limit missed",
    Exit.UNDECIDED: "optimise --verify: no design is accepted, and one needs more runs",
}


def _parser() -> Parser:
    about = (
        "Optimise gain schedules and bending filters, and analyse designs in the frequency domain. "
        "With a CASE instead of a command, optimise that case. For options: simdesign COMMAND --help."
    )
    parser = Parser("simdesign", about, _EXAMPLES, _EXITS)
    parser.commands("CASE", lambda name: "optimise")
    _add_optimise(parser)
    _add_analyse(parser)
    _add_open(parser)
    _add_others(parser)
    parser.about_itself(
        {
            "case": "cases (simdesign CASE)",
            "design": "designs (simdesign analyse DESIGN)",
            "points": "published derivatives (simdesign analyse DESIGN --points FILE)",
        }
    )
    return parser


def _add_optimise(parser: Parser) -> None:
    examples = """\
  simdesign optimise ksr3-identical        a built-in case
  simdesign optimise ksr3-identical --set limits.gain_margin_db=7   with a larger gain margin
  simdesign optimise ksr3-identical ksr3-robust --verify   design both; verify the better one, and
                                           the other if necessary
"""
    exits = {
        Exit.OK: "designed, all limits met; --verify: one design is accepted",
        Exit.FAILED: "infeasible (the best design found is written and marked); --verify: none is accepted",
        Exit.BAD_INPUT: "bad input, nothing written, or files that cannot be read or written",
        Exit.UNDECIDED: "--verify: none is accepted, and one needs more runs",
        Exit.INTERRUPTED: "interrupted; the best design so far is kept",
    }
    optimise = parser.command(
        "optimise", "Find the gains and filter that meet the limits of a case", examples, _optimise, exits
    )
    add = optimise.option
    add("CASE...", "case file (.toml), or name of a built-in case; several with --verify", dest="cases")
    add("--out DIR", "where to write (default: runs/<name of the case>)")
    add("--starts N", "number of starts of the search (default: the case's)", type=count_from_1)
    add("--seed N", "seed of the starts (default: the case's)", type=int)
    optimise.overrides("the case, e.g. limits.gain_margin_db=7")
    add("--orders", "also design filters F2 to F6, each with three gain schedules (Fig. 9 of the paper)")
    _add_page(optimise)
    add("--verify", "verify the designs, the best one first, until one is accepted")
    add("--suite SUITE", "suite for --verify (default: standard)", needs=["--verify"])
    add("--no-trials", "do not try wider bounds, a higher order or faster sampling if the case is infeasible")


def _add_analyse(parser: Parser) -> None:
    examples = """\
  simdesign analyse ksr3-default           a built-in design
  simdesign analyse runs/mine --at 30 --at 45   the design in this folder, at 30 s and 45 s
  simdesign analyse greensite-hm3          a launcher known only by published derivatives
"""
    exits = {
        Exit.OK: "stable at every operating point, and all limits of the design met",
        Exit.FAILED: "unstable, or a limit missed",
    }
    analyse = parser.command(
        "analyse", "Measure the margins of a design, and plot its loops on a page", examples, _analyse, exits
    )
    analyse.option("DESIGN", "design file, folder with a design.toml, or a built-in design")
    _add_operating_points(analyse, "the design's, if built in, else nominal")
    add = analyse.option
    about = "operating points every S seconds and at the rows of the gain tables, instead of those of the design"
    add("--every S", about, type=partial(_between, 0.01), dest="every_s")
    add("--kind sampled|pade|exact", "model of the flight computer (default: as designed, else sampled, as flown)")
    add("--axis pitch|yaw", "plane of motion (default: as designed, else pitch)")
    add("--errata corrected|paper", "equations as corrected, or as the paper prints them (default: as designed)")
    _add_plant(analyse)
    add("--faults", "operating points of the flight with the scenario's faults")
    add("--points FILE", "operating points of published derivatives (.toml, or built in) instead of a flight")
    add("--out DIR", "where to write (default: runs/analyse-<name of the design>)")
    _add_page(analyse)


def _add_open(parser: Parser) -> None:
    examples = """\
  simdesign open ksr3-robust               change gains and filter of a built-in design by hand
  simdesign open runs/mine --with ksr3-default   compare with another design
  simdesign open greensite-hm3             a launcher known only by published derivatives
"""
    exits = {Exit.OK: "closed by Ctrl-C", Exit.BAD_INPUT: "bad input, a port in use, or files that cannot be read"}
    about = "Change a design by hand on a local page, with its loops and limits"
    parser = parser.command("open", about, examples, _open, exits)
    parser.option("DESIGN", "design file, folder with a design.toml, or a built-in design")
    _add_operating_points(parser, "the design's, if built in, else nominal")
    add = parser.option
    add("--kind sampled|pade|exact", "model of the flight computer (default: as designed, else sampled, as flown)")
    add("--points FILE", "operating points of published derivatives (.toml, or built in) instead of a flight")
    add("--with DESIGN...", "draw this design too; repeatable", dest="also")
    add("--out DIR", "where trials are saved (default: the present folder)")
    add("--port N", "port on this machine (default: a free one)", type=count_from_1)
    add("--no-browser", "print the address only")


def _add_page(parser: Parser) -> None:
    parser.option(
        "--plots", "also write loops, margins, lobes, gains and filter as SVG and PNG", without=["--no-pictures"]
    )
    parser.option("--no-pictures", "write tables and files only, no page")


def _add_operating_points(parser: Parser, default: str, without: Sequence[str] = ()) -> None:
    parser.option(
        "--at T...", "operating point at vehicle time T, s; repeatable", without=without, type=seconds, dest="times_s"
    )
    parser.option("--scenario S", f"scenario that flies through the operating points (default: {default})")
    parser.option("--vehicle V", "vehicle folder instead of the scenario's")


def _add_plant(parser: Parser) -> None:
    about = "vehicle as flown, or with the ranges of Table 2 of the paper (default: as designed, else flown)"
    parser.option("--plant flown|table2", about)


def _add_others(parser: Parser) -> None:
    examples = """\
  simdesign errata                         for the design ksr3-default
  simdesign errata ksr3-robust --at 40     for another design, at one time
"""
    about = "Measure what each erratum of the paper changes in peaks and margins"
    errata = parser.command("errata", about, examples, _errata)
    errata.option("[DESIGN]", "design file, or a built-in design (default: ksr3-default)")
    _add_operating_points(errata, "nominal")
    _add_plant(errata)
    errata.option("--out FILE", "also write the table to a file")

    examples = """\
  simdesign export ksr3-robust --c law     C99 sources and a unit test, in the folder law
  simdesign export ksr3-robust --format mat   plant, law and loop for MATLAB
"""
    export = parser.command("export", "Export a control law as C, or its loop as matrices", examples, _export)
    export.option("DESIGN", "design file, or a built-in design")
    form = export.add_mutually_exclusive_group(required=True)
    export.option("--c DIR", "the law as C99 sources, with its tables, a unit test and a CMake file", group=form)
    about = "plant, law and loop as state-space matrices A, B, C, D at each operating point"
    export.option("--format mat|npz|json", about, group=form, dest="form")
    export.option("--axis pitch|yaw", "plane (default: both)", without=["--c"])
    _add_operating_points(export, "nominal", without=["--c"])
    export.option("--out FILE", "where to write the matrices (default: <name of the design>.mat)", without=["--c"])

    examples = """\
  simdesign bias nominal                   bias for the scenario's own wind
  simdesign bias nominal --wind today.csv  bias for a measured wind
"""
    bias = parser.command("bias", "Bias the pitch programme of a scenario for a wind", examples, _bias)
    bias.option("SCENARIO", "scenario file (.toml), or name of a built-in scenario")
    bias.option("--wind PROFILE", "measured wind over altitude (.csv), instead of the scenario's")
    about = "share of the wind's angle of attack to remove, 0 to 1 (default: 1)"
    bias.option("--share X", about, type=partial(_between, 1e-9, most=1.0))
    bias.option("--out FILE", "where to write (default: <name of the scenario>-biased.csv)")


def _run(arguments: list[str]) -> int:
    return _parser().run(arguments)


def _between(least: float, text: str, most: float = float("inf")) -> float:
    """Parse a number from `least` to `most`. Raises argparse.ArgumentTypeError."""
    value = number(text)
    if value < least or value > most:
        raise argparse.ArgumentTypeError(f"{text!r} is not from {least:g} to {most:g}")
    return value


def _optimise(
    cases: tuple[str, ...],
    *,
    out: str | None = None,
    verify: bool = False,
    suite: str = "standard",
    no_pictures: bool = False,
    no_trials: bool = False,
    **given: Any,
) -> int:
    if len(set(cases)) < len(cases):
        raise CommandError("a case is named twice")
    if len(cases) > 1 and not verify:
        raise CommandError(f"what is {cases[1]!r}? one case at a time, or several with --verify")
    from maxq.tools.design import points, run_case  # noqa: PLC0415  # lazy, as all imports below: --help is fast

    if any(map(points.is_case_of_points, cases)):
        search = (f"search.{key}={given.pop(key)}" for key in ("starts", "seed") if given.get(key) is not None)
        changes = (*given.pop("overrides", ()), *search)
        if verify or any(given.get(key) for key in ("orders", "plots")):
            raise CommandError("a case of points has no vehicle: allowed are --out, --starts, --seed and --set")
        return points.make(cases[0], overrides=changes, out=out)
    given |= {"page": not no_pictures, "trials": not no_trials}
    makes = [partial(run_case.make, case, out=_folder(out, case, len(cases)), **given) for case in cases]
    if not verify:
        return makes[0]().code
    from maxq.tools.verify.run import execute_cases  # noqa: PLC0415  # lazy

    return execute_cases(makes, suite, not no_pictures, command.end if command.alone else None)


def _analyse(*, no_pictures: bool = False, **given: Any) -> int:
    from maxq.tools.design import analyse, points, report  # noqa: PLC0415  # lazy

    order = report.AnalysisOrder(page=not no_pictures, given=tuple(given), **given)
    file = points.points_of(order)
    return analyse.execute(order) if file is None else points.execute(order, file)


def _open(
    *, also: tuple[str, ...] = (), out: str | None = None, port: int = 0, no_browser: bool = False, **given: Any
) -> int:
    from maxq.tools.design import report, serve  # noqa: PLC0415  # lazy

    order = report.AnalysisOrder(given=tuple(given), **given)
    return serve.execute(order, also, out, port, browser=not no_browser)


def _errata(**given: Any) -> int:
    from maxq.tools.design import analyse, report  # noqa: PLC0415  # lazy

    return analyse.execute_errata(report.AnalysisOrder(**given))


def _export(**given: Any) -> int:
    from maxq.tools.design import export  # noqa: PLC0415  # lazy

    return export.execute(**given)


def _bias(**given: Any) -> int:
    from maxq.tools.design import bias  # noqa: PLC0415  # lazy

    return bias.execute(**given)


def _folder(out: str | None, case: str, cases: int) -> str | None:
    """Return the folder for the results of a case. Each of several cases has a folder inside `out`."""
    if out is None or cases == 1:
        return out
    return os.path.join(out, os.path.basename(case).removesuffix(".toml"))


command = Command("simdesign", _run, "interrupted; nothing written")
main = command.main

if __name__ == "__main__":
    command()
