"""The command `simrun`: fly a scenario. Nothing heavy is imported before it is known what to do."""

from __future__ import annotations

import argparse
import os
import sys
import time
from functools import partial

from maxq.tools.cli.frame import Command, Exit, show_list
from maxq.tools.cli.parser import Parser, count, count_of_runs, filled

_USAGE = """\
simrun SCENARIO [--set KEY=VALUE]... [--out DIR] [--no-log] [--view [--realtime [X]]]
       simrun CAMPAIGN [--runs N] [--seed S] [--workers K] [--keep WHICH]... [--until-settled]
           [--dask ADDRESS] [--set KEY=VALUE]... [--out DIR] [--no-report]
       simrun --from LOG [--set KEY=VALUE]... [--out DIR] [--view [--realtime [X]]]
       simrun --from DIR [--keep WHICH]... [--no-report]
       simrun --from DIR --run N [--view | --shrink] [--out DIR]
       simrun --from DIR --search METRIC [--runs N] [--workers K]
       simrun --from DIR --rare METRIC [--runs N] [--workers K]
       simrun --list | --copy NAME DIR | --schema KIND | --upgrade FILE | --version | --help"""
_EXAMPLES = """\
  simrun nominal                           fly the built-in scenario of that name
  simrun nominal --set wind.profile=winds/anheung-november.csv --out runs/windy
  simrun --copy nominal mine               then change mine/nominal.toml, and
  simrun mine/nominal.toml                 fly it
  simrun --from runs/nominal/flight.mcap   fly a log again and compare
  simrun nominal --view --realtime 4       watch it fly, four times as fast
  simrun campaigns/first                   fly a campaign of dispersed flights;
                                           repeat the command to resume it
  simrun campaigns/first --runs 2000       make it larger
  simrun --from runs/first --run 17        fly one of its runs again, with a log
"""
_EXITS = {
    Exit.OK: "flown, all requirements met",
    Exit.FAILED: "flown, but a requirement was missed, control was lost, the flight\n"
    "       diverged, or it differs from the log",
    Exit.BAD_INPUT: "bad input, or files that cannot be read or written",
    Exit.UNDECIDED: "campaign: too few runs to say whether all requirements are met",
    Exit.INTERRUPTED: "interrupted; a log is closed properly, a campaign resumes with the\n       same command",
}
_SCENARIO, _CAMPAIGN, _LOG, _FOLDER = "SCENARIO", "CAMPAIGN", "--from LOG", "--from DIR"
_RUN, _SHRINK, _SEARCH = "--from DIR --run N", "--from DIR --run N --shrink", "--from DIR --search METRIC"
_RARE = "--from DIR --rare METRIC"
_FLIGHTS = (_SCENARIO, _LOG)
_SHOWN = (*_FLIGHTS, _RUN)
_KINDS = ("scenario", "vehicle", "design", "campaign", "case", "suite", "layout", "flight-software")


def _parser() -> Parser:
    about = "Fly a scenario, or a campaign of dispersed flights: leave log or data set, print a verdict."
    parser = Parser("simrun", _USAGE, about, _EXAMPLES, _EXITS)
    add = parser.option
    add("SCENARIO", "scenario or campaign file (.toml), or name of a built-in one", dest="scenario")
    add("--out DIR", "where to write (default: runs/<name of the scenario>)", [*_FLIGHTS, _CAMPAIGN, _RUN])
    parser.overrides("the scenario, e.g. run.step_s=0.0005; KEY= removes the key", [*_FLIGHTS, _CAMPAIGN])
    add("--no-log", "no flight.mcap: only the summary", _SHOWN)
    about = (
        "fly the scenario in a log again and compare the final states; writes nothing without --out; "
        "or the folder of a campaign: report on it again, or fly one --run"
    )
    add("--from LOG", about, dest="log")
    add("--view", "show the flight in the Rerun viewer while it flies", _SHOWN)
    add("--view-port N", "show it in a viewer that listens on this port already", _SHOWN, type=int)
    about = "with --view: X seconds of flight in a second (default 1)"
    add("--realtime X", about, _FLIGHTS, nargs="?", const="1")
    campaign = partial(add, group=parser.add_argument_group("campaigns"))
    campaign("--runs N", "number of runs instead of the file's", [_CAMPAIGN, _SEARCH, _RARE], type=count_of_runs)
    campaign("--seed S", "seed of all draws instead of the file's", [_CAMPAIGN], type=count)
    campaign("--workers K", "threads (default: all cores)", [_CAMPAIGN, _SHRINK, _SEARCH, _RARE], type=count)
    about = "keep full logs of: worst:5 (of each requirement), worst:5:METRIC, failed, failed:20, 0,17; repeatable"
    campaign("--keep WHICH...", about, [_CAMPAIGN, _FOLDER])
    campaign("--until-settled", "stop when every verdict is settled", [_CAMPAIGN])
    campaign("--dask ADDRESS", "fly on the workers of a dask.distributed scheduler", [_CAMPAIGN])
    campaign("--no-report", "no pictures, no page: summary.json only", [_CAMPAIGN, _FOLDER])
    campaign("--run N", "with --from DIR: fly this run again", [_RUN, _SHRINK], type=count)
    campaign("--shrink", "with --run: the fewest dispersions that fail", [_SHRINK])
    campaign("--search METRIC", "with --from DIR: the worst flight within 3 sigma", [_SEARCH])
    campaign("--rare METRIC", "with --from DIR: how rarely its limit is missed", [_RARE])
    add("--list", "name the built-in scenarios")
    kinds = f"{', '.join(_KINDS[:-1])}; or flight-software: the C header maxq_fsw.h"
    add("--schema KIND", f"print the JSON Schema of a file: {kinds}", choices=_KINDS)
    add("--copy NAME DIR", "copy a built-in scenario with all it refers to")
    add("--upgrade FILE", "convert a design, case or suite of an earlier version to the present format")
    parser.version_and_help()
    return parser


def _run(arguments: list[str]) -> int:
    parser = _parser()
    options = parser.read(arguments, extra="one scenario at a time: what is {!r}?")
    options.realtime = _real_time(options, parser)
    action = parser.only(
        options,
        _SCENARIO,
        "--from",
        "--list",
        "--copy",
        "--schema",
        "--upgrade",
        none="give a scenario, e.g. simrun nominal",
    )
    mode = _mode(options, action)
    if mode in _FLIGHTS and parser.stray(options, mode):
        parser.check(options, mode, _shown(options))
    parser.check(options, mode)
    if options.schema:
        return _print_schema(options.schema)
    if options.upgrade:
        from maxq.tools import simrun_upgrade  # noqa: PLC0415  # lazy

        return simrun_upgrade.execute(options.upgrade)
    if options.list:
        return show_list({"scenario": "scenarios (simrun SCENARIO)", "campaign": "campaigns (simrun CAMPAIGN)"})
    if options.copy:
        import shlex  # noqa: PLC0415  # lazy

        from maxq.sim.scenario.loader import copy_scenario  # noqa: PLC0415  # lazy

        print(f"copied; fly it with: simrun {shlex.quote(str(copy_scenario(*options.copy)))}")
        return Exit.OK
    options.view = options.view or options.view_port is not None
    if options.realtime is not None and not options.view:
        parser.error("--realtime goes with --view")
    if mode in _FLIGHTS:
        start_s = time.perf_counter()  # before the heavy imports
        if command.alone:
            _load_numba_without_blas()
        from maxq.tools import simrun_fly  # noqa: PLC0415  # lazy

        return simrun_fly.execute(filled(simrun_fly.Order, options), start_s)
    _check_campaign(options, mode, parser)
    from maxq.tools import simrun_campaign  # noqa: PLC0415  # lazy

    return simrun_campaign.execute(filled(simrun_campaign.Order, options, folder=options.log))


def _load_numba_without_blas() -> None:
    """Numba looks for BLAS where it first meets compiled code, by importing scipy.linalg: a fifth of a second.

    Kernels use no linear algebra (CONTRIBUTING.md), so this process, which flies and ends, tells it that there is none.
    """
    blas = "scipy.linalg.cython_blas"
    if blas in sys.modules:
        return
    sys.modules[blas] = None  # type: ignore[assignment]  # Python's way of saying "cannot be imported"
    try:
        import numba.np.arraymath  # noqa: F401, PLC0415  # its import is what looks
    finally:
        del sys.modules[blas]


def _print_schema(kind: str) -> int:
    if kind == "flight-software":
        from maxq.control.external import HEADER  # noqa: PLC0415  # lazy

        print(HEADER.read_text(encoding="utf-8"), end="")
        return Exit.OK
    import json  # noqa: PLC0415  # lazy

    from maxq.tools.schemas import json_schema  # noqa: PLC0415  # lazy

    print(json.dumps(json_schema(kind), indent=1))
    return Exit.OK


def _mode(options: argparse.Namespace, action: str) -> str:
    """What is asked for, in the words of the usage."""
    if action == "--from":
        if not os.path.isdir(options.log):
            return _LOG
        if options.shrink:
            return _SHRINK
        if options.rare is not None:
            return _RARE
        return _RUN if options.run is not None else _SEARCH if options.search is not None else _FOLDER
    if action == _SCENARIO:
        from maxq.sim.scenario.loader import is_campaign  # noqa: PLC0415  # lazy

        return _CAMPAIGN if is_campaign(options.scenario) else _SCENARIO
    return action


def _shown(options: argparse.Namespace) -> str:
    """A scenario or log with which an option was given that goes with campaigns only."""
    if options.log is not None:
        return f"{options.log}, which is not the folder of a campaign"
    from maxq.sim.scenario.loader import load_scenario  # noqa: PLC0415  # lazy

    load_scenario(options.scenario, options.overrides)  # a file that cannot be read is the greater trouble
    return f"{options.scenario}, which has no [campaign]"


def _check_campaign(options: argparse.Namespace, mode: str, parser: Parser) -> None:
    if options.shrink and options.run is None:
        parser.error("--shrink needs --run N: the run that fails")
    if options.view and options.no_log:
        parser.error("--view shows the log of --run N: not with --no-log")
    if options.workers == 0:
        parser.error("--workers 0: at least one is needed")
    for text in options.keep:
        from maxq.sim.campaign.schema import KEEP_ALLOWED, keep_is_known  # noqa: PLC0415  # lazy

        if not keep_is_known(text):
            parser.error(f"--keep {text}: allowed: {KEEP_ALLOWED}")


def _real_time(options: argparse.Namespace, parser: Parser) -> float | None:
    """How many times faster than life; None: as fast as it goes."""
    given = options.realtime
    if given is None:
        return None
    try:
        factor = float(given)
    except ValueError:
        if options.scenario is not None:
            parser.error(f"--realtime {given}: a factor is a number, e.g. --realtime 4")
        options.scenario, factor = given, 1.0  # `--realtime nominal`: the scenario, and no factor
    if not 0.0 < factor < float("inf"):
        parser.error(f"--realtime {given}: a factor is above 0")
    return factor


command = Command(
    "simrun",
    _run,
    interrupted="interrupted before the flight began; nothing written",
    memory="shorten the flight, log less often, or use fewer --workers",
)
main = command.main

if __name__ == "__main__":
    command()
