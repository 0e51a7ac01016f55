"""The command `simdesign`: optimise a control design, or judge one. Nothing heavy is imported before it is known what
to do."""

from __future__ import annotations

import argparse
import difflib
import math
import os
import sys
from typing import NoReturn

from maxq.tools.command_line import guarded, one_thread_a_matrix, unknown_option

DESIGNED, INFEASIBLE, BAD_INPUT = 0, 1, 2

_USAGE = (
    "simdesign CASE [--out DIR] [--starts N] [--seed N] [--set KEY=VALUE]... [--orders] [--no-pictures]\n"
    "       simdesign CASE... --verify [--suite SUITE] [and the options of CASE]\n"
    "       simdesign analyse DESIGN [--at T]... [--scenario S] [--kind K] [--axis A] [--out DIR] [--no-pictures]\n"
    "       simdesign errata [DESIGN] [--at T]... [--scenario S] [--out FILE]\n"
    "       simdesign --list | --version | --help"
)
_EXAMPLES = """\
examples:
  simdesign ksr3-identical                       optimise the built-in case of that name
  simdesign mine.toml --out runs/mine               optimise your own; fly it with
  simrun nominal --set design=runs/mine/design.toml
  simdesign ksr3-identical ksr3-robust --verify     design both, then simverify the better one, and the other if need be
  simdesign analyse ksr3-default                    margins of a built-in design at every node
  simdesign analyse runs/mine --at 30 --at 45       of the design that a case has left there, at two times
  simdesign errata                                  what each erratum of the paper does to peaks and margins
  simdesign --list                                  built-in cases and designs

exit code:
    0  designed, all limits met; with analyse: stable at every node, and all limits met that the design states
    1  infeasible (the best effort is written, and marked); with analyse: unstable or a limit missed
    2  bad input, nothing written
    with --verify: 0 one accepted, 1 none accepted, 3 none accepted and more runs needed, as with simverify
  130  interrupted, the best design so far is kept
"""
ANALYSE, ERRATA = "analyse", "errata"
_ONLY = {  # option: what it may stand with; a case is ""
    "--starts": ("",),
    "--seed": ("",),
    "--set": ("",),
    "--orders": ("",),
    "--verify": ("",),
    "--suite": ("",),
    "--out": ("", ANALYSE, ERRATA),
    "--no-pictures": ("", ANALYSE),
    "--at": (ANALYSE, ERRATA),
    "--scenario": (ANALYSE, ERRATA),
    "--vehicle": (ANALYSE, ERRATA),
    "--kind": (ANALYSE,),
    "--axis": (ANALYSE,),
    "--errata": (ANALYSE,),
    "--plant": (ANALYSE, ERRATA),
}


class _Parser(argparse.ArgumentParser):
    """argparse whose complaints are one line each, like those about cases."""

    def error(self, message: str) -> NoReturn:
        self.exit(BAD_INPUT, f"simdesign: {message}; see simdesign --help\n")


def _seconds(text: str) -> float:
    value = float(text)
    if not math.isfinite(value):
        raise ValueError
    return value


_seconds.__name__ = "a time in seconds"  # argparse names it in its complaint


def _count(text: str) -> int:
    value = int(text)
    if value < 1:
        raise ValueError
    return value


_count.__name__ = "a whole number from 1"


def _parser() -> argparse.ArgumentParser:
    parser = _Parser(
        prog="simdesign",
        usage=_USAGE,
        description="Optimise gain schedules and bending filter; judge designs in the frequency domain.",
        epilog=_EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
        add_help=False,
    )
    add = parser.add_argument
    add("words", nargs="*", metavar="CASE", help="case file (.toml), or name of a built-in case; or a command as above")
    add("--out", metavar="DIR", help="where to write (default: runs/<name of the case>, or runs/analyse-<name>)")
    add("--starts", type=_count, metavar="N", help="number of starts of the optimiser instead of the case's")
    add("--seed", type=int, metavar="N", help="seed of the starts instead of the case's")
    add(
        "--set", metavar="KEY=VALUE", action="append", default=[], dest="overrides",
        help="override a value of the case, e.g. limits.gain_margin_db=7; repeatable",
    )  # fmt: skip
    add("--orders", action="store_true", help="also F2 to F6 with all three gain schedules: the paper's Fig. 9")
    add("--verify", action="store_true", help="then try what was designed, best first, until simverify accepts one")
    add("--suite", metavar="SUITE", help="with --verify: what has to be passed (default: standard)")
    add("--at", type=_seconds, metavar="T", action="append", help="judge at this vehicle time, s; repeatable")
    add("--scenario", metavar="S", help="scenario whose flight gives the nodes (default: nominal)")
    add("--vehicle", metavar="V", help="vehicle folder instead of the scenario's")
    add("--kind", choices=("sampled", "pade", "exact"), help="model of the computer (default: sampled, as it flies)")
    add("--axis", choices=("pitch", "yaw"), help="plane (default: pitch)")
    add("--errata", choices=("corrected", "paper"), help="equations corrected (default) or as the paper prints them")
    add("--plant", choices=("flown", "table2"), help="vehicle as flown (default), or with the ranges of Table 2")
    add("--no-pictures", action="store_true", help="tables and files only")
    add("--list", action="store_true", help="name the built-in cases and designs")
    add("--version", action="store_true", help="version of maxq")
    add("-h", "--help", action="help", help="this text")
    return parser


def main(arguments: list[str] | None = None) -> int:
    """Run the command; returns the exit code."""
    one_thread_a_matrix()
    given = sys.argv[1:] if arguments is None else arguments
    return guarded(lambda: _run(given), "simdesign: interrupted; nothing written", INFEASIBLE)


def _run(arguments: list[str]) -> int:
    parser = _parser()
    options, unknown = parser.parse_known_args(arguments)
    if unknown:
        parser.error(unknown_option(unknown[0], parser))
    command = options.words[0] if options.words and options.words[0] in (ANALYSE, ERRATA) else ""
    names = options.words[1:] if command else options.words
    actions = [
        name
        for name, given in (
            (command or "CASE", bool(options.words)),
            ("--list", options.list),
            ("--version", options.version),
        )
        if given
    ]
    if not actions:
        parser.error("give a case, e.g. simdesign ksr3-identical, or analyse DESIGN")
    if len(actions) > 1:
        parser.error(f"{actions[0]} and {actions[1]} exclude each other")
    if len(names) > 1 and (command or not options.verify):
        close = difflib.get_close_matches(names[0], (ANALYSE, ERRATA, "analyze"), 1, 0.7)
        hint = f"did you mean {ANALYSE if close[0] == 'analyze' else close[0]}?" if close else "one at a time"
        parser.error(f"what is {names[0 if close else 1]!r}? {hint}")
    if command == ANALYSE and not names:
        parser.error("give a design, e.g. simdesign analyse ksr3-default")
    for option, where in _ONLY.items():
        value = getattr(options, {"--set": "overrides"}.get(option, option[2:].replace("-", "_")))
        if value not in (None, [], False) and (options.list or options.version or command not in where):
            parser.error(f"{option} means nothing with {actions[0]}")
    if options.out == "":
        parser.error("--out needs a name")
    if options.suite is not None and not options.verify:
        parser.error("--suite means nothing without --verify")
    if len(set(names)) < len(names):
        parser.error("a case is named twice")
    if options.version:
        from importlib.metadata import version  # noqa: PLC0415  # lazy, as all imports here: --help is quick

        print(f"maxq {version('maxq')}")
        return DESIGNED
    if options.list:
        from maxq.tools.design.builtin import show_list  # noqa: PLC0415  # lazy

        return show_list()
    if command == ANALYSE:
        from maxq.tools.design.analyse import Order, execute  # noqa: PLC0415  # lazy

        given = {
            "scenario": options.scenario, "vehicle": options.vehicle, "times_s": tuple(options.at or ()),
            "kind": options.kind, "axis": options.axis, "errata": options.errata, "plant": options.plant,
            "out": options.out, "pictures": not options.no_pictures,
        }  # fmt: skip
        return execute(Order(names[0], **{k: v for k, v in given.items() if v is not None}))
    if command == ERRATA:
        from maxq.tools.design import errata_table as table  # noqa: PLC0415  # lazy

        given = {
            "design": names[0] if names else None, "scenario": options.scenario, "vehicle": options.vehicle,
            "times_s": tuple(options.at or ()), "plant": options.plant, "out": options.out,
        }  # fmt: skip
        return table.execute(table.Order(**{k: v for k, v in given.items() if v is not None}))
    from maxq.tools.design.run_case import Order as CaseOrder  # noqa: PLC0415  # lazy
    from maxq.tools.design.run_case import execute as execute_case  # noqa: PLC0415

    orders = [
        CaseOrder(
            name, tuple(options.overrides), _folder(options.out, name, len(names)), options.starts, options.seed,
            not options.no_pictures, options.orders,
        )
        for name in names
    ]  # fmt: skip
    if options.verify:
        from maxq.tools.verify.candidates import execute as execute_candidates  # noqa: PLC0415  # lazy

        return execute_candidates(orders, options.suite or "standard", not options.no_pictures)
    return execute_case(orders[0])


def _folder(out: str | None, case: str, cases: int) -> str | None:
    """Several cases get a folder each inside --out."""
    if out is None or cases == 1:
        return out
    return os.path.join(out, os.path.basename(case).removesuffix(".toml"))


if __name__ == "__main__":
    sys.exit(main())
