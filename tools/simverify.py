"""The command `simverify`: accept or reject control designs, and say why. Nothing heavy is imported before it is known
what to do."""

from __future__ import annotations

import datetime

from maxq.tools.cli.frame import Command, Exit, show_list
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
    about = "design file, folder with a design.toml, or a built-in design; or flight code: libfsw.so, my_fsw.py:Class"
    add("DESIGN...", about, dest="designs")
    add("--suite SUITE", "suite file or name of a built-in one (default: standard)", _DESIGN)
    add("--vehicle V", "vehicle folder instead of the scenario's", _DESIGN)
    parser.overrides("the suite, e.g. margins.cases=1000", _DESIGN)
    add("--only PART", "repeat one part: a flight's name, 'vehicle 15', 'corner 3', ...", _DESIGN)
    add("--out DIR", "where to write (default: runs/verify-<name of the design>)", _DESIGN)
    add("--author A", "who answers for the review, for its title block", _DESIGN, default="")
    add("--revision R", "of the review, for its title block", _DESIGN, default="")
    add("--date YYYY-MM-DD", "of the review (default: today)", _DESIGN, default="")
    add("--no-pack", "verdict.json only, no review pack", _DESIGN)
    add("--afresh", "work out everything anew, and keep nothing", _DESIGN)
    add("--list", "name the built-in suites and designs")
    parser.version_and_help()
    return parser


def _run(arguments: list[str]) -> int:
    parser = _parser()
    options = parser.read(arguments)
    parser.check(options, parser.only(options, "DESIGN", "--list", none="give a design, e.g. simverify ksr3-robust"))
    if options.list:
        return show_list({"suite": "suites (simverify --suite SUITE)", "design": "designs (simverify DESIGN)"})
    if len(set(options.designs)) < len(options.designs):
        parser.error("a design is named twice")
    if options.date:
        try:
            datetime.date.fromisoformat(options.date)
        except ValueError:
            parser.error(f"--date {options.date!r}: must be a date such as 2026-11-22")
    from maxq.tools.verify.run import Order, execute  # noqa: PLC0415  # lazy: --help is quick

    return execute(filled(Order, options, pack=not options.no_pack, memory=not options.afresh))


command = Command("simverify", _run, "interrupted; what was worked out is kept, the same command resumes")
main = command.main

if __name__ == "__main__":
    command()
