"""The command `simverify`: accept or reject control designs, and say why. Nothing heavy is imported before it is known
what to do."""

from __future__ import annotations

import argparse
import sys
from typing import NoReturn

from maxq.tools.command_line import guarded, one_thread_a_matrix, unknown_option

ACCEPTED, REJECTED, BAD_INPUT, UNDECIDED = 0, 1, 2, 3

_USAGE = (
    "simverify DESIGN... [--suite SUITE] [--vehicle V] [--set KEY=VALUE]... [--out DIR] [--no-pack] [--afresh]\n"
    "       simverify --list | --version | --help"
)
_EXAMPLES = """\
examples:
  simverify ksr3-robust                             judge a built-in design by the suite standard
  simverify runs/mine --suite quick                 one that simdesign has made, by a shorter suite
  simverify ksr3-robust ksr3-free ksr3-two-phase    several, and rank them
  simverify ksr3-robust --set margins.cases=1000    with more random vehicles

exit code (of several designs: that of the best):
    0  accepted: every requirement is met, and shown with the confidence that is asked for
    1  rejected: at least one is not
    2  bad input, nothing flown
    3  undecided: more runs are needed; it says how many
  130  interrupted; what was worked out is kept, and the same command goes on
"""


class _Parser(argparse.ArgumentParser):
    """argparse whose complaints are one line each, like those about suites."""

    def error(self, message: str) -> NoReturn:
        self.exit(BAD_INPUT, f"simverify: {message}; see simverify --help\n")


def _parser() -> argparse.ArgumentParser:
    parser = _Parser(
        prog="simverify",
        usage=_USAGE,
        description="Judge control designs by flights, margins, certificates and campaigns; write review packs.",
        epilog=_EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
        add_help=False,
    )
    add = parser.add_argument
    add("designs", nargs="*", metavar="DESIGN", help="design file, folder with a design.toml, or a built-in design")
    add("--suite", default="standard", metavar="SUITE", help="suite file or name of a built-in one (default: standard)")
    add("--vehicle", metavar="V", help="vehicle folder instead of the scenario's")
    add(
        "--set", metavar="KEY=VALUE", action="append", default=[], dest="overrides",
        help="override a value of the suite, e.g. margins.cases=1000; repeatable",
    )  # fmt: skip
    add("--out", metavar="DIR", help="where to write (default: runs/verify-<name of the design>)")
    add("--no-pack", action="store_true", help="verdict.json only, no review pack")
    add("--afresh", action="store_true", help="work out everything anew, and keep nothing")
    add("--list", action="store_true", help="name the built-in suites and designs")
    add("--version", action="store_true", help="version of maxq")
    add("-h", "--help", action="help", help="this text")
    return parser


def main(arguments: list[str] | None = None) -> int:
    """Run the command; returns the exit code."""
    one_thread_a_matrix()
    given = sys.argv[1:] if arguments is None else arguments
    return guarded(
        lambda: _run(given), "simverify: interrupted; what was worked out is kept, the same command goes on", REJECTED
    )


def _run(arguments: list[str]) -> int:
    parser = _parser()
    options, unknown = parser.parse_known_args(arguments)
    if unknown:
        parser.error(unknown_option(unknown[0], parser))
    if options.version:
        from importlib.metadata import version  # noqa: PLC0415  # lazy, as all imports here: --help is quick

        print(f"maxq {version('maxq')}")
        return ACCEPTED
    if options.list:
        from maxq.tools.verify.builtin import show_list  # noqa: PLC0415  # lazy

        return show_list()
    if not options.designs:
        parser.error("give a design, e.g. simverify ksr3-robust")
    if len(set(options.designs)) < len(options.designs):
        parser.error("a design is named twice")
    if options.out == "":
        parser.error("--out needs a name")
    from maxq.tools.verify.run import Order, execute  # noqa: PLC0415  # lazy

    return execute(
        Order(
            designs=tuple(options.designs), suite=options.suite, overrides=tuple(options.overrides),
            vehicle=options.vehicle, out=options.out, pack=not options.no_pack, memory=not options.afresh,
        )
    )  # fmt: skip


if __name__ == "__main__":
    sys.exit(main())
