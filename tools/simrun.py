"""The command `simrun`: fly a scenario. Nothing heavy is imported before it is known what to do."""

from __future__ import annotations

import argparse
import contextlib
import difflib
import gc
import os
import sys
from typing import NoReturn

PASSED, FAILED, BAD_INPUT, INTERNAL_ERROR, INTERRUPTED = 0, 1, 2, 70, 130
"""Exit codes; 70 is EX_SOFTWARE of sysexits.h."""

TRACEBACK = "MAXQ_TRACEBACK"
"""Environment variable with which an internal error shows where it happened."""

_USAGE = (
    "simrun SCENARIO [--set KEY=VALUE]... [--out DIR] [--no-log] [--view [--realtime [X]]]\n"
    "       simrun --from LOG [--set KEY=VALUE]... [--out DIR] [--view [--realtime [X]]]\n"
    "       simrun --list | --copy NAME DIR | --version | --help"
)
_EXAMPLES = """\
examples:
  simrun nominal                                    fly the built-in scenario of that name
  simrun nominal --set wind.profile=winds/anheung-november.csv --out runs/windy
  simrun --copy nominal mine                        then change mine/nominal.toml, and
  simrun mine/nominal.toml                          fly it
  simrun --from runs/nominal/flight.mcap            fly a log again and compare
  simrun nominal --view --realtime 4                watch it fly, four times as fast as it would

exit code:
    0  flown, all requirements met
    1  flown, but a requirement was missed, control was lost, the flight diverged, or it differs from the log
    2  bad input, nothing written
   70  a fault of maxq itself; MAXQ_TRACEBACK=1 in the environment shows where
  130  interrupted, the log is closed properly
"""


class _Parser(argparse.ArgumentParser):
    """argparse whose complaints are one line each, like those about scenarios."""

    def error(self, message: str) -> NoReturn:
        self.exit(BAD_INPUT, f"simrun: {message}; see simrun --help\n")


def _parser() -> argparse.ArgumentParser:
    parser = _Parser(
        prog="simrun",
        usage=_USAGE,
        description="Fly a scenario: write DIR/flight.mcap and DIR/summary.json, print a verdict.",
        epilog=_EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
        add_help=False,
    )
    parser.add_argument(
        "scenario",
        nargs="?",
        metavar="SCENARIO",
        help="scenario file (.toml), or name of a built-in scenario",
    )
    parser.add_argument("--out", metavar="DIR", help="where to write (default: runs/<name of the scenario>)")
    parser.add_argument(
        "--set",
        metavar="KEY=VALUE",
        action="append",
        default=[],
        dest="overrides",
        help="override a value of the scenario, e.g. run.step_s=0.0005; KEY= takes the key away; repeatable",
    )
    parser.add_argument("--no-log", action="store_true", help="no flight.mcap: only the summary")
    parser.add_argument(
        "--from",
        metavar="LOG",
        dest="log",
        help="fly the scenario in a log again and compare the final states; writes nothing without --out",
    )
    parser.add_argument("--view", action="store_true", help="show the flight in the Rerun viewer while it flies")
    parser.add_argument(
        "--view-port", type=int, metavar="N", help="show it in a viewer that listens on this port already"
    )
    parser.add_argument(
        "--realtime", nargs="?", const="1", metavar="X", help="with --view: X seconds of flight in a second (default 1)"
    )
    parser.add_argument("--list", action="store_true", help="name the built-in scenarios")
    parser.add_argument(
        "--copy", nargs=2, metavar=("NAME", "DIR"), help="copy a built-in scenario with all it refers to"
    )
    parser.add_argument("--version", action="store_true", help="version of maxq")
    parser.add_argument("-h", "--help", action="help", help="this text")
    return parser


def command() -> NoReturn:
    """`simrun` as a process: the command, then the end of the process without taking it apart.

    By now everything is written and closed. What is left out, Python's and LLVM's freeing of each object and module
    by itself, took a quarter of a second, in which a person waits and nothing comes of it.
    """
    gc.set_threshold(50_000)  # imports make much that stays: looking through it every 700 objects takes 0.05 s
    code = main(alone=True)
    for stream in (sys.stdout, sys.stderr):
        with contextlib.suppress(OSError, ValueError):  # nobody is there to read it
            stream.flush()
    os._exit(code)


def main(arguments: list[str] | None = None, *, alone: bool = False) -> int:
    """Run the command; returns the exit code.

    `alone`: the process ends with it, so that nothing needs to be loaded or kept for others.
    """
    for stream in (sys.stdout, sys.stderr):
        if hasattr(stream, "reconfigure"):
            stream.reconfigure(errors="replace")  # a terminal that lacks a letter is no reason to fail
    try:
        code = _run(sys.argv[1:] if arguments is None else arguments, alone)
        sys.stdout.flush()
        return code
    except KeyboardInterrupt:
        print("simrun: interrupted before the flight began; nothing written", file=sys.stderr)
        return INTERRUPTED
    except BrokenPipeError:  # whoever read our output, such as `head`, has seen enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return FAILED
    except Exception as error:
        return _internal(error)


def _internal(error: Exception) -> int:
    """Say that maxq is at fault, in one line."""
    import traceback  # noqa: PLC0415  # lazy

    if os.environ.get(TRACEBACK):
        traceback.print_exception(error)
    last = traceback.extract_tb(error.__traceback__)[-1]
    place = f"{os.path.basename(last.filename)}, line {last.lineno}"
    what = " ".join(f"{type(error).__name__}: {error}".split()).removesuffix(": ").removesuffix(":")
    how = "" if os.environ.get(TRACEBACK) else f"; {TRACEBACK}=1 in the environment shows more"
    print(
        f"simrun: internal error: {what} ({place}); this is a fault of maxq, not of your input: please report it, "
        f"with the command and the scenario{how}",
        file=sys.stderr,
    )
    return INTERNAL_ERROR


def _run(arguments: list[str], alone: bool) -> int:
    parser = _parser()
    options, unknown = parser.parse_known_args(arguments)
    factor = _real_time(options, parser)
    if unknown:
        parser.error(_unknown(unknown[0], parser))
    actions = [
        name
        for name, given in (
            ("SCENARIO", options.scenario is not None),
            ("--from", options.log is not None),
            ("--list", options.list),
            ("--copy", options.copy is not None),
            ("--version", options.version),
        )
        if given
    ]
    if not actions:
        parser.error("give a scenario, e.g. simrun nominal")
    if len(actions) > 1:
        parser.error(f"{actions[0]} and {actions[1]} exclude each other")
    flight_options = (
        ("--out", options.out),
        ("--set", options.overrides),
        ("--no-log", options.no_log),
        ("--view", options.view),
        ("--view-port", options.view_port),
    )
    given = [name for name, value in flight_options if value]
    if given and actions[0] not in ("SCENARIO", "--from"):
        parser.error(f"{given[0]} means nothing with {actions[0]}")
    if options.out == "":
        parser.error("--out needs the name of a folder")
    if options.version:
        from importlib.metadata import version  # noqa: PLC0415  # lazy, as all imports here: --help is quick

        print(f"maxq {version('maxq')}")
        return PASSED
    if options.list or options.copy:
        from maxq.tools import simrun_builtin  # noqa: PLC0415  # lazy

        return simrun_builtin.show_list() if options.list else simrun_builtin.copy(*options.copy)
    from maxq.tools import simrun_fly  # noqa: PLC0415  # lazy

    order = simrun_fly.Order(
        options.scenario,
        options.log,
        tuple(options.overrides),
        options.out,
        options.no_log,
        options.view or options.view_port is not None,
        options.view_port,
        factor,
    )
    return simrun_fly.execute(order, alone=alone)


def _real_time(options: argparse.Namespace, parser: argparse.ArgumentParser) -> float | None:
    """How many times faster than life; None: as fast as it goes."""
    given = options.realtime
    if given is None:
        return None
    try:
        factor = float(given)
    except ValueError:
        if options.scenario is None:  # `--realtime nominal`: the scenario, and no factor
            options.scenario, factor = given, 1.0
        else:
            parser.error(f"--realtime {given}: a factor is a number, e.g. --realtime 4")
    if not 0.0 < factor < float("inf"):
        parser.error(f"--realtime {given}: a factor is above 0")
    if not options.view and options.view_port is None:
        parser.error("--realtime means nothing without --view")
    return factor


def _unknown(argument: str, parser: argparse.ArgumentParser) -> str:
    if not argument.startswith("-"):
        return f"one scenario at a time: what is {argument!r}?"
    options = [option for action in parser._actions for option in action.option_strings]
    close = difflib.get_close_matches(argument.partition("=")[0], options, 1, 0.7)
    return f"unknown option {argument}" + (f"; did you mean {close[0]}?" if close else "")


if __name__ == "__main__":
    command()
