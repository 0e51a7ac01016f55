"""The command `simverify`: accept or reject control designs, with the reasons.

Expensive modules are imported only once the task is known.
"""

from __future__ import annotations

import argparse
import datetime
from typing import Any

from maxq.tools.cli.frame import Command, CommandError, Exit
from maxq.tools.cli.parser import Parser, count

_EXAMPLES = """\
  simverify ksr3-ringed --suite ksr3-ringed       judge a built-in design on its own vehicle
  simverify runs/mine --suite quick               judge a result of simdesign by a shorter suite
  simverify ksr3-robust ksr3-free ksr3-two-phase  judge several designs and rank them
  simverify ksr3-robust --set margins.cases=1000  use more random vehicles
  simverify --check runs/verify-ksr3-ringed       check a pack and recompute a sample of it
"""
_EXITS = {
    Exit.OK: "accepted: every requirement is met with the required confidence (of several designs: by the best), or "
    "each missed requirement is waived; or passed the screening: met, with less evidence than an acceptance needs",
    Exit.FAILED: "rejected: at least one requirement is missed; with --check: something differs",
    Exit.BAD_INPUT: "bad input, nothing flown, or files that cannot be read or written",
    Exit.UNDECIDED: "undecided: more runs are needed; the last line states how many",
    Exit.INTERRUPTED: "interrupted; finished results are kept, and the same command resumes",
}


def _parser() -> Parser:
    about = "Judge control designs by flights, margins, certificates and campaigns; write review packs."
    parser = Parser("simverify", about, _EXAMPLES, _EXITS, _verify)
    add = parser.option
    about = "design file, folder with a design.toml, or a built-in design; or flight code: libfsw.so, my_fsw.py:Class"
    add("[DESIGN]...", about, dest="designs")
    add("--suite SUITE", "suite file, or name of a built-in suite (default: standard)")
    add("--vehicle V", "vehicle folder instead of the scenario's")
    parser.overrides("the suite, e.g. margins.cases=1000")
    add("--only PART", "repeat one part: a flight's name, 'vehicle 15', 'corner 3', ...")
    add("--out DIR", "where to write (default: runs/verify-<name of the design>)")
    add("--author A", "person responsible for the review, for its title block")
    add("--revision R", "revision of the review, for its title block")
    add("--date YYYY-MM-DD", "date of the review (default: today)", type=_date)
    add("--no-pack", "verdict.json only, no review pack")
    add("--junit FILE", "write the verdicts as JUnit XML (.xml) for continuous integration")
    add("--afresh", "compute everything again, without the cache")
    add("--register", "write seeds chosen by --set into the ledger of the vehicle before they are flown; fly nothing")
    add("--sign KEY", "sign the pack with this SSH key (ssh-keygen -Y sign)")
    judging = (
        "--set",
        "--only",
        "--out",
        "--author",
        "--revision",
        "--date",
        "--no-pack",
        "--junit",
        "--afresh",
        "--register",
        "--sign",
    )
    add("--check PACK", "check a review pack (folder or verdict.json) instead of verifying a design", without=judging)
    add("--allowed FILE", "signers whose signature --check accepts (ssh-keygen(1), ALLOWED SIGNERS)", needs=["--check"])
    about = (
        "number of results of each kind to recompute and compare: of a pack (default 5), or from the cache (default 2)"
    )
    add("--sample N", about, type=count)
    parser.about_itself({"suite": "suites (simverify --suite SUITE)", "design": "designs (simverify DESIGN)"})
    return parser


def _run(arguments: list[str]) -> int:
    return _parser().run(arguments)


def _date(text: str) -> str:
    """Check a date in ISO format, and return it unchanged. Raises argparse.ArgumentTypeError."""
    try:
        datetime.date.fromisoformat(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} must be a date such as 2026-11-22") from None
    return text


def _verify(designs: tuple[str, ...] = (), check: str | None = None, allowed: str | None = None, **given: Any) -> int:
    if check is not None:
        from maxq.tools.verify.check import execute as execute_check  # noqa: PLC0415  # lazy: --help is fast

        named = {key: given[key] for key in ("suite", "vehicle", "sample") if key in given}
        return execute_check(check, designs, allowed=allowed, **named)
    if not designs:
        raise CommandError("give a DESIGN, e.g. simverify ksr3-robust, or a pack with --check")
    from maxq.tools.verify.run import execute  # noqa: PLC0415  # lazy, too

    return execute(designs, end=command.end if command.alone else None, **given)


command = Command("simverify", _run, "interrupted; finished results are kept, and the same command resumes")
main = command.main

if __name__ == "__main__":
    command()
