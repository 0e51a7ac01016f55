"""The command `simverify`: accept or reject control designs, and say why. Nothing heavy is imported before it is known
what to do."""

from __future__ import annotations

import datetime
import sys
from typing import NoReturn

from maxq.tools.cli.frame import Exit, process, run, show_list
from maxq.tools.cli.parser import Parser, filled

_USAGE = """\
simverify DESIGN... [--suite SUITE] [--vehicle V] [--set KEY=VALUE]... [--only PART] [--out DIR]
                        [--author A] [--revision R] [--date YYYY-MM-DD] [--no-pack] [--afresh]
       simverify --list | --version | --help"""
_EXAMPLES = """\
  simverify ksr3-robust                           judge a built-in design
  simverify runs/mine --suite quick               one of simdesign, by a shorter suite
  simverify ksr3-robust ksr3-free ksr3-two-phase  several, and rank them
  simverify ksr3-robust --set margins.cases=1000  with more random vehicles
"""
_EXITS = {
    Exit.OK: "accepted: every requirement is met, and shown with the confidence that\n"
    "       is asked for (of several designs: by the best); by a suite that asks for\n"
    "       too little to accept anything: passed the screening",
    Exit.FAILED: "rejected: at least one requirement is not met",
    Exit.BAD_INPUT: "bad input, nothing flown, or files that cannot be read or written",
    Exit.UNDECIDED: "undecided: more runs are needed; it says how many",
    Exit.INTERRUPTED: "interrupted; what was worked out is kept, the same command resumes",
}
_DESIGN = ("DESIGN",)


def _parser() -> Parser:
    about = "Judge control designs by flights, margins, certificates and campaigns; write review packs."
    parser = Parser("simverify", _USAGE, about, _EXAMPLES, _EXITS)
    add = parser.option
    add(
        "designs",
        nargs="*",
        metavar="DESIGN",
        default=[],
        help="design file, folder with a design.toml, or a built-in design; or flight code: libfsw.so, my_fsw.py:Class",
    )
    add("--suite", modes=_DESIGN, metavar="SUITE", help="suite file or name of a built-in one (default: standard)")
    add("--vehicle", modes=_DESIGN, metavar="V", help="vehicle folder instead of the scenario's")
    add(
        "--set", modes=_DESIGN, metavar="KEY=VALUE", action="append", default=[], dest="overrides",
        help="override a value of the suite, e.g. margins.cases=1000; repeatable",
    )  # fmt: skip  # five more lines otherwise
    add("--only", modes=_DESIGN, metavar="PART", help="repeat one part: a flight's name, 'vehicle 15', 'corner 3', ...")
    add("--out", modes=_DESIGN, metavar="DIR", help="where to write (default: runs/verify-<name of the design>)")
    add("--author", modes=_DESIGN, metavar="A", default="", help="who answers for the review, for its title block")
    add("--revision", modes=_DESIGN, metavar="R", default="", help="of the review, for its title block")
    add("--date", modes=_DESIGN, metavar="YYYY-MM-DD", default="", help="of the review (default: today)")
    add("--no-pack", modes=_DESIGN, action="store_true", help="verdict.json only, no review pack")
    add("--afresh", modes=_DESIGN, action="store_true", help="work out everything anew, and keep nothing")
    add("--list", action="store_true", help="name the built-in suites and designs")
    parser.version_and_help()
    return parser


def command() -> NoReturn:
    """`simverify` as a process."""
    process(main)


def main(arguments: list[str] | None = None) -> int:
    """Run the command; returns the exit code."""
    given = sys.argv[1:] if arguments is None else arguments
    return run("simverify", lambda: _run(given), "interrupted; what was worked out is kept, the same command resumes")


def _run(arguments: list[str]) -> int:
    parser = _parser()
    options = parser.read(arguments)
    parser.check(options, parser.only(options, "DESIGN", "--list", none="give a design, e.g. simverify ksr3-robust"))
    if options.list:
        return show_list({"suite": "suites (simverify --suite SUITE)", "design": "designs (simverify DESIGN)"})
    if len(set(options.designs)) < len(options.designs):
        parser.error("a design is named twice")
    if options.out == "":
        parser.error("--out needs the name of a folder")
    if options.date:
        try:
            datetime.date.fromisoformat(options.date)
        except ValueError:
            parser.error(f"--date {options.date!r}: must be a date such as 2026-11-22")
    from maxq.tools.verify.run import Order, execute  # noqa: PLC0415  # lazy: --help is quick

    return execute(filled(Order, options, pack=not options.no_pack, memory=not options.afresh))


if __name__ == "__main__":
    command()
