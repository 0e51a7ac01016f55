"""The command `simrun`: fly a scenario. Nothing heavy is imported before it is known what to do."""

from __future__ import annotations

import argparse
import contextlib
import gc
import os
import sys
from typing import NoReturn

from maxq.tools.command_line import guarded, unknown_option

PASSED, FAILED, BAD_INPUT, OPEN, INTERNAL_ERROR = 0, 1, 2, 3, 70
"""Exit codes; 70 is EX_SOFTWARE of sysexits.h."""

TRACEBACK = "MAXQ_TRACEBACK"
"""Environment variable with which an internal error shows where it happened."""

_USAGE = (
    "simrun SCENARIO [--set KEY=VALUE]... [--out DIR] [--no-log] [--view [--realtime [X]]]\n"
    "       simrun CAMPAIGN [--runs N] [--seed S] [--workers K] [--keep WHICH]... [--until-settled]\n"
    "                       [--dask ADDRESS] [--set KEY=VALUE]... [--out DIR] [--no-report]\n"
    "       simrun --from LOG [--set KEY=VALUE]... [--out DIR] [--view [--realtime [X]]]\n"
    "       simrun --from DIR [--run N [--view | --shrink]] [--search METRIC] [--keep WHICH]... [--out DIR]\n"
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
  simrun campaigns/first                            fly a campaign of dispersed flights; again: go on with it
  simrun campaigns/first --runs 2000                make it larger
  simrun --from runs/first --run 17                 fly one of its runs again, with a full log

exit code:
    0  flown, all requirements met
    1  flown, but a requirement was missed, control was lost, the flight diverged, or it differs from the log
    2  bad input, or files that cannot be read or written
    3  a campaign: too few runs to say whether all requirements are met
   70  a fault of maxq itself; MAXQ_TRACEBACK=1 in the environment shows where
  130  interrupted; a log is closed properly, a campaign goes on with the same command
"""


class _Parser(argparse.ArgumentParser):
    """argparse whose complaints are one line each, like those about scenarios."""

    def error(self, message: str) -> NoReturn:
        self.exit(BAD_INPUT, f"simrun: {message}; see simrun --help\n")


def _parser() -> argparse.ArgumentParser:
    parser = _Parser(
        prog="simrun",
        usage=_USAGE,
        description="Fly a scenario, or a campaign of dispersed flights: leave log or data set, print a verdict.",
        epilog=_EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
        add_help=False,
    )
    parser.add_argument(
        "scenario",
        nargs="?",
        metavar="SCENARIO",
        help="scenario or campaign file (.toml), or name of a built-in one",
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
        help="fly the scenario in a log again and compare the final states; writes nothing without --out; "
        "or the folder of a campaign: report on it again, or fly one --run",
    )
    parser.add_argument(
        "--view", action="store_true", help="show the flight in the Rerun viewer while it flies, also with --run"
    )
    parser.add_argument(
        "--view-port", type=int, metavar="N", help="show it in a viewer that listens on this port already"
    )
    parser.add_argument(
        "--realtime", nargs="?", const="1", metavar="X", help="with --view: X seconds of flight in a second (default 1)"
    )
    campaigns = parser.add_argument_group("campaigns")
    campaigns.add_argument("--runs", metavar="N", type=_count, help="number of runs, instead of the file's")
    campaigns.add_argument("--seed", metavar="S", type=_count, help="seed of all draws, instead of the file's")
    campaigns.add_argument("--workers", metavar="K", type=_count, help="threads (default: all cores)")
    campaigns.add_argument(
        "--keep",
        metavar="WHICH",
        action="append",
        default=[],
        help="keep full logs of: worst:5 (of each requirement), worst:5:METRIC, failed, failed:20, 0,17; repeatable",
    )
    campaigns.add_argument("--until-settled", action="store_true", help="stop when every verdict is settled")
    campaigns.add_argument("--dask", metavar="ADDRESS", help="fly on the workers of a dask.distributed scheduler")
    campaigns.add_argument("--device", choices=("cpu", "cuda"), help="fly on a CUDA GPU (extra: maxq[gpu])")
    campaigns.add_argument("--no-report", action="store_true", help="no pictures and no page, only summary.json")
    campaigns.add_argument("--run", metavar="N", type=_count, help="with --from DIR: fly this run again, with a log")
    campaigns.add_argument("--shrink", action="store_true", help="with --run: the fewest dispersions that still fail")
    campaigns.add_argument("--search", metavar="METRIC", help="with --from DIR: the worst flight within 3 sigma")
    parser.add_argument("--list", action="store_true", help="name the built-in scenarios")
    parser.add_argument(
        "--copy", nargs=2, metavar=("NAME", "DIR"), help="copy a built-in scenario with all it refers to"
    )
    parser.add_argument("--version", action="store_true", help="version of maxq")
    parser.add_argument("-h", "--help", action="help", help="this text")
    return parser


def _count(text: str) -> int:
    if not text.isdecimal():
        raise argparse.ArgumentTypeError(f"{text!r} is no whole number of at least 0")
    return int(text)


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
    given = sys.argv[1:] if arguments is None else arguments

    def run() -> int:
        try:
            return _run(given, alone)
        except BrokenPipeError:  # no fault of ours
            raise
        except Exception as error:
            return _internal(error)

    return guarded(run, "simrun: interrupted before the flight began; nothing written", FAILED)


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
    given = [name for name, value in (*flight_options, *_campaign_options(options)) if value]
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
    if _is_campaign(options):
        return _campaign(options, parser)
    alien = [name for name, value in _campaign_options(options) if value]
    if alien and options.scenario is not None:
        from maxq.sim.scenario.errors import ScenarioError  # noqa: PLC0415  # lazy
        from maxq.sim.scenario.loader import load_scenario  # noqa: PLC0415  # lazy

        try:  # a file that cannot be read is the greater trouble
            load_scenario(options.scenario, options.overrides)
        except ScenarioError as error:
            print(f"simrun: {error}", file=sys.stderr)
            return BAD_INPUT
        parser.error(f"{alien[0]} belongs to campaigns, and {options.scenario} has no [campaign]")
    if alien:
        parser.error(f"{alien[0]} needs the folder of a campaign, which {options.log} is not")
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


def _campaign_options(options: argparse.Namespace) -> tuple[tuple[str, bool], ...]:
    """Options that only campaigns have, and whether each was given."""
    return (
        ("--runs", options.runs is not None),
        ("--seed", options.seed is not None),
        ("--workers", options.workers is not None),
        ("--keep", bool(options.keep)),
        ("--until-settled", options.until_settled),
        ("--dask", options.dask is not None),
        ("--device", options.device is not None),
        ("--no-report", options.no_report),
        ("--run", options.run is not None),
        ("--shrink", options.shrink),
        ("--search", options.search is not None),
    )


def _is_campaign(options: argparse.Namespace) -> bool:
    if options.log is not None:
        return os.path.isdir(options.log)
    from maxq.sim.scenario.loader import is_campaign  # noqa: PLC0415  # lazy

    return is_campaign(options.scenario)


def _campaign(options: argparse.Namespace, parser: argparse.ArgumentParser) -> int:
    of_a_folder = ("--run", "--shrink", "--search")
    of_a_flight = ("--seed", "--until-settled", "--dask", "--device")
    given = [name for name, value in _campaign_options(options) if value]
    view = options.view or options.view_port is not None
    if options.realtime is not None:
        parser.error("--realtime goes with a scenario or a log; --run N --view shows a flight once flown")
    if options.log is None:
        if view:
            parser.error("--view shows one flight: with a campaign, --from DIR --run N")
        if wrong := [name for name in given if name in of_a_folder]:
            parser.error(f"{wrong[0]} goes with --from DIR")
        if options.no_log:
            parser.error("--no-log means nothing for a campaign: it logs the flights of --keep only")
    else:
        if options.overrides:
            parser.error("--set would make another campaign of it; fly the campaign file with --set and --out")
        if wrong := [name for name in given if name in of_a_flight]:
            parser.error(
                f"{wrong[0]} goes with a campaign file: a flown campaign is extended by the command that flew it"
            )
        if (view or options.shrink) and options.run is None:
            parser.error("--view and --shrink go with --run N")
        if view and (options.shrink or options.no_log):
            parser.error("--view shows the log of --run N")
    if options.dask is not None and options.device == "cuda":
        parser.error("--dask flies on the CPUs of its workers: not with --device cuda")
    if options.workers == 0:
        parser.error("--workers 0: at least one is needed")
    for text in options.keep:
        from maxq.sim.campaign.schema import KEEP_ALLOWED, keep_is_known  # noqa: PLC0415  # lazy

        if not keep_is_known(text):
            parser.error(f"--keep {text}: allowed: {KEEP_ALLOWED}")
    from maxq.tools import simrun_campaign  # noqa: PLC0415  # lazy

    return simrun_campaign.execute(
        simrun_campaign.Order(
            scenario=options.scenario,
            folder=options.log,
            overrides=tuple(options.overrides),
            out=options.out,
            no_log=options.no_log,
            runs=options.runs,
            seed=options.seed,
            workers=options.workers,
            keep=tuple(options.keep),
            until_settled=options.until_settled,
            no_report=options.no_report,
            dask=options.dask,
            device=options.device or "cpu",
            run=options.run,
            view=view,
            view_port=options.view_port,
            shrink=options.shrink,
            search=options.search,
        )
    )


def _unknown(argument: str, parser: argparse.ArgumentParser) -> str:
    if not argument.startswith("-"):
        return f"one scenario at a time: what is {argument!r}?"
    return unknown_option(argument, parser)


if __name__ == "__main__":
    command()
