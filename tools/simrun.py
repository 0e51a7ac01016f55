"""The command `simrun`: fly scenarios and campaigns.

Expensive modules are imported only once the task is known.
"""

from __future__ import annotations

import argparse
import os
import shlex
import sys
import time
from datetime import UTC, datetime
from types import ModuleType
from typing import Any

from maxq.tools.cli.frame import Command, CommandError, Exit
from maxq.tools.cli.parser import Parser, count, count_from_1, count_of_runs, number, positive
from maxq.tools.cli.terminal import announce, tell, wipe

_EXAMPLES = """\
  simrun nominal                           fly the built-in scenario of that name
  simrun nominal --set wind.profile=winds/anheung-november.csv --out runs/windy
  simrun copy nominal mine                 then change mine/nominal.toml, and
  simrun mine/nominal.toml                 fly it
  simrun refly runs/nominal/flight.mcap    fly a log again and compare
  simrun campaigns/first                   fly a campaign of dispersed flights
  simrun refly runs/first --run 17         fly one of its runs again, with a log
"""
_MISSED = "flown, but a requirement was missed, control was lost or the flight diverged"
_EXITS = {
    Exit.OK: "flown, all requirements met",
    Exit.FAILED: f"{_MISSED}, or the final state differs from the log",
    Exit.UNDECIDED: "campaign: undecided, more runs are needed",
    Exit.INTERRUPTED: "interrupted; a log is complete up to this time, a campaign resumes with the same command",
}
_FLIGHT = {
    Exit.OK: _EXITS[Exit.OK],
    Exit.FAILED: _MISSED,
    Exit.INTERRUPTED: "interrupted; the log is complete up to this time",
}
_CAMPAIGN = {
    Exit.OK: "all requirements are met with the required confidence",
    Exit.FAILED: "a requirement is missed",
    Exit.UNDECIDED: "undecided: more runs are needed",
}
_RESUMED = {Exit.INTERRUPTED: "interrupted; the same command resumes the campaign"}
_CALIBRATED = {Exit.INTERRUPTED: "interrupted; the same command continues"}
_MODELS = ("scenario", "vehicle", "design", "campaign", "case", "suite", "layout", "points")
_KINDS = (*_MODELS, "verdict", "flight-software", "messages")
_FLIGHT_FILES = {
    "csv": "table of channels over time (.csv); units end their names",
    "mat": "MATLAB file (.mat) of channels, units and descriptions",
    "hdf5": "HDF5 file (.hdf5) of channels, with units as attributes; needs the extra maxq[hdf5]",
    "kml": "map (.kml): trajectory, impact points, drop points",
    "geojson": "the same map (.geojson)",
    "oem": "ephemeris (.oem, CCSDS 502.0-B)",
    "opm": "state after the last burn (.opm, CCSDS 502.0-B)",
}
_FORMER = ("--copy", "--schema", "--upgrade", "--from")


def _parser() -> Parser:
    about = (
        "Fly a scenario or a campaign of dispersed flights: write a log or a data set, and print a verdict. "
        "Without a command, simrun flies a scenario as fly does, and a campaign as campaign does. "
        "simrun COMMAND --help lists the options of a command."
    )
    parser = Parser("simrun", about, _EXAMPLES, _EXITS)
    parser.commands("SCENARIO|CAMPAIGN", _command_for)
    _add_flights(parser)
    _add_campaigns(parser)
    _add_files(parser)
    _add_export(parser)
    _add_measured(parser)
    _add_winds(parser)
    parser.about_itself({"scenario": "scenarios (simrun SCENARIO)", "campaign": "campaigns (simrun CAMPAIGN)"})
    return parser


def _add_flights(parser: Parser) -> None:
    examples = """\
  simrun fly nominal                       the built-in scenario of that name
  simrun fly nominal --set run.seed=7 --out runs/seven
  simrun fly nominal --view --realtime 4   watch it at four times real speed
  simrun fly nominal --pace                in real time, e.g. for a computer behind a socket
"""
    fly = parser.command(
        "fly", "Fly a scenario, write its log and summary, and print a verdict", examples, _fly, _FLIGHT
    )
    fly.option("SCENARIO", "scenario file (.toml), or name of a built-in scenario")
    fly.overrides("the scenario, e.g. run.step_s=0.0005; KEY= removes the key")
    fly.option("--out DIR", "where to write (default: runs/<name of the scenario>, with --set a folder of its own)")
    about = "compute each sample of the flight computer at its time, X seconds of flight per second (default 1)"
    fly.option("--pace [X]", about, without=["--view", "--view-port"], type=positive, const=1.0)
    about = "end the flight if a sample is more than S seconds late (default: continue, and catch up)"
    fly.option("--pace-limit S", about, needs=["--pace"], type=positive)
    _add_views(fly)
    examples = """\
  simrun refly runs/nominal/flight.mcap    the flight in a log
  simrun refly runs/first --run 17         run 17 of a campaign, with a log
"""
    about = "Fly a log, or a run of a campaign, again and compare the final states"
    refly = parser.command(
        "refly", about, examples, _refly, _FLIGHT | {Exit.FAILED: f"{_MISSED}, or the final state differs"}
    )
    refly.option("LOG|DIR", "log (.mcap), or folder of a campaign", dest="place")
    refly.option("--run N", "number of the run in the campaign", type=count)
    refly.overrides("the scenario in the log; nothing is compared then", without=["--run"])
    refly.option("--out DIR", "where to write (default: for a run, DIR/flights/run-N; for a log, nothing is written)")
    _add_views(refly)

    examples = """\
  simrun limit nominal wind.speed_mps --set wind.from_deg=270
  simrun limit nominal run.step_s --start 0.001 --end 0.01
"""
    exits = {
        Exit.OK: "found, or all values flown meet all requirements",
        Exit.FAILED: "the first value misses a requirement",
    }
    about = "Find the largest value of a number at which a flight meets all requirements"
    limit = parser.command("limit", about, examples, _limit, exits)
    limit.option("SCENARIO", "scenario file (.toml), or name of a built-in scenario")
    limit.option("KEY", "number of the scenario, as for --set")
    limit.option("--start A", "first value (default: the scenario's, 0 if it has none)", type=number)
    about = "last value, which may be smaller than the first (default: steps double until a requirement is missed)"
    limit.option("--end B", about, type=number)
    limit.overrides("the scenario")


def _add_views(parser: Parser) -> None:
    parser.option("--no-log", "write the summary only, no flight.mcap")
    parser.option("--view", "show the flight in the Rerun viewer")
    parser.option("--view-port N", "show the flight in a viewer that already listens on this port", type=int)
    about = "show X seconds of flight per second (default 1)"
    parser.option("--realtime [X]", about, needs=["--view", "--view-port"], type=positive, const=1.0)


def _add_campaigns(parser: Parser) -> None:
    examples = """\
  simrun campaign campaigns/first          repeat the command to resume it
  simrun campaign campaigns/first --runs 2000   make it larger
  simrun campaign campaigns/first --shard 1/8 --out part-1   an eighth of it
"""
    about = "Fly, resume or enlarge a campaign of dispersed flights"
    campaign = parser.command(
        "campaign", about, examples, lambda **given: _campaigns().fly_campaign(**given), _CAMPAIGN | _RESUMED
    )
    campaign.option("CAMPAIGN", "campaign file (.toml), or name of a built-in campaign")
    campaign.option("--runs N", "number of runs, instead of the file's", type=count_of_runs)
    campaign.option("--seed S", "seed of all draws, instead of the file's", type=count)
    campaign.overrides("the scenario, e.g. run.step_s=0.0005; KEY= removes the key")
    campaign.option("--out DIR", "where to write (default: runs/<name of the campaign>)")
    _add_workers(campaign)
    campaign.option("--dask ADDRESS", "fly on the workers of a dask.distributed scheduler")
    about = "keep a copy of the folder in object storage, such as s3://bucket/first, and resume from it"
    campaign.option("--sync ADDRESS", about)
    campaign.option("--until-settled", "stop when every requirement is met or missed")
    about = "fly only part K of N of the runs, into a folder of its own; simrun merge makes the report"
    campaign.option("--shard K/N", about, without=["--until-settled", "--keep", "--no-report"], type=_shard)
    _add_report(campaign)

    examples = """\
  simrun merge part-1 part-2 --out runs/first   from campaign --shard 1/2 and 2/2
"""
    about = "Merge the shards of a campaign, and write its report"
    merge = parser.command("merge", about, examples, lambda **given: _campaigns().merge_shards(**given), _CAMPAIGN)
    merge.option("DIR...", "folders of all shards, or an address such as 's3://bucket/part-*'", dest="folders")
    merge.option("--out DIR", "where to write (default: runs/<name of the campaign>)")
    _add_report(merge)

    examples = """\
  simrun report runs/first                 write verdicts and pictures again
  simrun report runs/first --keep worst:5  with logs of the five worst runs
"""
    report = parser.command(
        "report",
        "Write the report of a flown campaign again",
        examples,
        lambda **given: _campaigns().report_again(**given),
        _CAMPAIGN,
    )
    _add_folder(report)
    _add_report(report)

    examples = "  simrun shrink runs/first --run 17        writes runs/first/shrunk/run-000017.toml\n"
    exits = {
        Exit.OK: "the run does not fail",
        Exit.FAILED: "the run fails; the dispersions that cause the failure are written",
    }
    about = "Find the fewest dispersions with which a run of a campaign fails"
    shrink = parser.command("shrink", about, examples, lambda **given: _campaigns().shrink(**given), exits)
    _add_folder(shrink)
    shrink.option("--run N", "the run that fails", type=count, required=True)
    _add_workers(shrink)

    examples = "  simrun search runs/first max_alpha_deg   writes runs/first/worst/max_alpha_deg.toml\n"
    exits = {Exit.OK: "the worst flight meets all requirements", Exit.FAILED: "the worst flight misses a requirement"}
    about = "Find the worst flight of a campaign within 3 sigma"
    search = parser.command("search", about, examples, lambda **given: _campaigns().search(**given), exits)
    _add_folder(search)
    search.option("METRIC", "metric whose worst value is sought")
    search.option("--runs N", "largest number of flights (default: 2000)", type=count_of_runs)
    _add_workers(search)

    examples = "  simrun rare runs/first max_attitude_error_deg   probability and its bounds\n"
    exits = {
        Exit.OK: "the requirement is missed as rarely as the campaign allows",
        Exit.FAILED: "the requirement is missed more often",
        Exit.UNDECIDED: "undecided between the bounds of the estimate",
    }
    about = "Estimate how rarely a requirement of a campaign is missed"
    rare = parser.command("rare", about, examples, lambda **given: _campaigns().rare(**given), exits)
    _add_folder(rare)
    rare.option("METRIC", "metric of the requirement")
    rare.option(
        "--runs N",
        "planned number of flights, which sets the size of the populations (default: 10000)",
        type=count_of_runs,
    )
    _add_workers(rare)


def _add_folder(parser: Parser) -> None:
    parser.option("DIR", "folder of a campaign", dest="folder")


def _add_workers(parser: Parser) -> None:
    parser.option("--workers K", "threads (default: all cores)", type=count_from_1)


def _add_report(parser: Parser) -> None:
    about = "keep full logs of runs: worst:5 (of each requirement), worst:5:METRIC, failed, failed:20, 0,17; repeatable"
    parser.option("--keep WHICH...", about, type=_kept)
    parser.option("--no-report", "write summary.json only, no pictures or page")
    parser.option("--junit FILE", "write the verdicts as JUnit XML (.xml) for continuous integration")


def _add_files(parser: Parser) -> None:
    examples = "  simrun copy nominal mine                 then: simrun mine/nominal.toml\n"
    copy = parser.command("copy", "Copy a built-in scenario with all files that it names", examples, _copy)
    copy.option("NAME", "built-in scenario or campaign")
    copy.option("DIR", "new folder", dest="folder")
    examples = """\
  simrun schema scenario > scenario.schema.json
  simrun schema flight-software > maxq_fsw.h
  simrun schema messages > messages.csv
"""
    about = "Print the JSON Schema of a kind of file, or the interface of flight code"
    schema = parser.command("schema", about, examples, _print_schema)
    kinds = (
        f"{', '.join(_MODELS)}; verdict: verdict.json; messages: structs over a socket; "
        "flight-software: the C header maxq_fsw.h"
    )
    schema.option("KIND", kinds, choices=_KINDS)
    examples = "  simrun upgrade mine/case.toml            convert the file in place\n"
    about = "Convert a file of an earlier version to the present format"
    upgrade = parser.command("upgrade", about, examples, _upgrade)
    upgrade.option("FILE", "design, case, suite, scenario or campaign (.toml)")


def _add_export(parser: Parser) -> None:
    examples = """\
  simrun export runs/nominal/flight.mcap --csv f.csv --kml f.kml
  simrun export runs/nominal/flight.mcap --mat f.mat --channels /truth
  simrun export runs/nominal/flight.mcap --oem f.oem --utc 2026-01-31T12:00:00Z
  simrun export nominal --fmu rocket.fmu   needs the extra maxq[fmu]
"""
    about = "Export a flown flight (tables, maps, orbit messages), or a scenario as a unit for co-simulation"
    export = parser.command("export", about, examples, _export)
    export.option(
        "LOG|SCENARIO",
        "log (.mcap) or its folder; folder of a campaign for its drop zones; for --fmu a scenario (file or name)",
        dest="place",
    )
    flight = [f"--{kind}" for kind in _FLIGHT_FILES]
    for kind, text in _FLIGHT_FILES.items():
        export.option(f"--{kind} FILE", text, without=["--fmu"])
    about = "channel or topic (/truth) in tables; repeatable (default: all)"
    export.option("--channels NAME...", about, needs=["--csv", "--mat", "--hdf5"])
    about = "m / (C_D A), kg/m2: adds the impact point with drag"
    export.option("--ballistic B", about, needs=[f for f in flight if f not in ("--oem", "--opm")], type=positive)
    export.option("--utc DATE", "date of T0 (default: site.utc)", needs=["--oem", "--opm"])
    export.option("--frame TEME|ITRF2000", "frame of orbit messages (default TEME)", needs=["--oem", "--opm"])
    export.option("--fmu FILE", "unit for co-simulation (FMI): sensors out, commands in")
    export.option("--fmi 3.0|2.0", "version of FMI (default 3.0)", needs=["--fmu"])
    export.overrides("the scenario", needs=["--fmu"])


def _add_measured(parser: Parser) -> None:
    examples = """\
  simrun compare runs/nominal flown.csv
  simrun compare runs/nominal flown.csv --limit altitude_m.rms=50
"""
    exits = {Exit.OK: "compared, all limits met", Exit.FAILED: "a limit is exceeded"}
    about = "Compare a flown flight with measured time series"
    compare = parser.command("compare", about, examples, _compare, exits)
    compare.option("LOG", "log (.mcap) or its folder", dest="place")
    _add_series(compare)
    about = "time of flight minus time of the file, s (default: the best fit, with its uncertainty)"
    compare.option("--shift S", about, type=number)
    about = "largest shift of the fit, s (default: 10)"
    compare.option("--most-shift S", about, without=["--shift"], type=positive)
    about = "limit of a channel's largest residual; CHANNEL.rms and CHANNEL.bias limit these; repeatable"
    compare.option("--limit CHANNEL=VALUE...", about, type=_limit_pair)
    compare.option("--out DIR", "where to write (default: comparison, next to the log)")

    examples = """\
  simrun calibrate campaigns/first flown.csv --sigma altitude_m=5
  simrun calibrate mine.toml flown.csv --fit thrust --shift-sigma 0.2
"""
    exits = {Exit.OK: "calibrated", Exit.FAILED: "the search did not converge"} | _CALIBRATED
    about = "Fit the dispersed numbers of a campaign to measured time series"
    calibrate = parser.command("calibrate", about, examples, _calibrate, exits)
    calibrate.option("CAMPAIGN", "campaign file (.toml), or name of a built-in campaign")
    _add_series(calibrate)
    about = "1-sigma noise of a channel (default: from second differences); repeatable"
    calibrate.option("--sigma CHANNEL=VALUE...", about, type=_limit_pair)
    calibrate.option("--fit NAME...", "draw to fit, by key or name; repeatable (default: all that are continuous)")
    calibrate.option("--shift S", "time of flight minus time of the file, s (default: 0)", type=number)
    calibrate.option("--shift-sigma S", "fit the shift too, with this prior standard deviation, s", type=positive)
    calibrate.overrides("the scenario, e.g. run.step_s=0.0005; KEY= removes the key")
    _add_workers(calibrate)
    calibrate.option("--out DIR", "where to write (default: runs/<name of the campaign>-calibrated)")


def _add_series(parser: Parser) -> None:
    parser.option("FILE", "measured series (.csv), with units in the headings, e.g. Altitude (ft)", dest="measured")
    parser.option("--columns FILE", "channels, units and noise of the columns (.toml)")
    about = "channel of a column (empty: none); repeatable"
    parser.option("--alias HEADING=CHANNEL...", about, type=_pair)


def _pair(text: str) -> tuple[str, str]:
    name, sign, value = text.rpartition("=")
    if not (sign and name):
        raise argparse.ArgumentTypeError(f"{text!r} is not of the form NAME=VALUE")
    return name.strip(), value.strip()


def _limit_pair(text: str) -> tuple[str, float]:
    name, value = _pair(text)
    return name, positive(value)


def _add_winds(parser: Parser) -> None:
    examples = """\
  simrun winds era5.nc --site nominal      needs the extra maxq[winds]
  simrun winds gfs.grib2 --at 28.5,-80.6 --time 2026-06-01T14:30
"""
    about = "Write wind profiles at a place from gridded data (NetCDF or GRIB)"
    winds = parser.command("winds", about, examples, _winds)
    winds.option("FILE...", "files with winds on pressure levels (ERA5, GFS, MERRA-2 or similar)", dest="files")
    winds.option(
        "--at LAT,LON",
        "geodetic latitude and longitude, deg, north and east positive",
        dest="place",
        type=_place,
        without=["--site"],
    )
    winds.option("--site SCENARIO", "the launch site of this scenario instead")
    winds.option("--time T", "UTC, such as 2026-06-01T14:30 (default: each time in the files)", type=_utc)
    winds.option("--out DIR", "where to write (default: winds)")


def _place(text: str) -> tuple[float, float]:
    latitude, _, longitude = text.partition(",")
    place = number(latitude, "a latitude, deg"), number(longitude, "a longitude, deg")
    if not (abs(place[0]) <= 90.0 and abs(place[1]) <= 360.0):
        raise argparse.ArgumentTypeError(f"{text!r} is not a latitude within 90 deg and a longitude within 360 deg")
    return place


def _utc(text: str) -> datetime:
    try:
        time_ = datetime.fromisoformat(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is not a time such as 2026-06-01T14:30") from None
    return time_ if time_.tzinfo else time_.replace(tzinfo=UTC)


def _run(arguments: list[str]) -> int:
    return _parser().run(_in_present_form(arguments))


def _in_present_form(arguments: list[str]) -> list[str]:
    """Return the arguments with a subcommand in place of an option of an earlier version that names the task.

    Such options are --copy NAME DIR, --schema KIND, --upgrade FILE, --search KEY, and --from LOG, or --from DIR with
    --run, --shrink, --search or --rare.
    """
    parted = tuple(f"{name}=" for name in (*_FORMER, "--search", "--rare"))
    words = [part for word in arguments for part in (word.split("=", 1) if word.startswith(parted) else [word])]
    asked = next((word for word in words if word in _FORMER), None)
    if asked is None:
        if "--search" not in words:
            return arguments
        at = words.index("--search")
        return ["limit", *words[:at], *words[at + 2 :], *words[at + 1 : at + 2]]
    at = words.index(asked)
    if asked != "--from":
        return [asked.removeprefix("--"), *words[:at], *words[at + 1 :]]
    place, rest = words[at + 1 : at + 2], words[:at] + words[at + 2 :]
    task = "refly"
    if place and os.path.isdir(place[0]):
        again = "refly" if any(word.partition("=")[0] == "--run" for word in rest) else "report"
        task = next((name for name in ("shrink", "rare", "search") if f"--{name}" in rest), again)
    return [task, *place, *(word for word in rest if word != f"--{task}")]


def _command_for(name: str) -> str:
    """Return the subcommand that flies this scenario or campaign. Raises ScenarioError if there is no such file."""
    from maxq.sim.input.files import locate  # noqa: PLC0415  # lazy, as all imports below: --help is fast
    from maxq.sim.scenario.loader import is_campaign  # noqa: PLC0415  # lazy

    _refuse_result(name)
    locate(name, "scenario")
    return "campaign" if is_campaign(name) else "fly"


def _refuse_result(name: str) -> None:
    """Raise CommandError if a log, or the path of a folder with a log, is given in place of a scenario.

    A name without a separator may be that of a built-in scenario, even if there is a folder of that name.
    """
    log = name if name.endswith(".mcap") else os.path.join(name, "flight.mcap") if os.sep in name else ""
    if os.path.isfile(log):
        again, shown = (f"{command} {shlex.quote(log)}" for command in ("simrun refly", "simreplay"))
        raise CommandError(f"{name} is a flown flight, not a scenario: {again} flies it again, {shown} shows it")


def _fly(**given: Any) -> int:
    start_s = time.perf_counter()  # before the expensive imports
    announce("loading the simulator")
    _refuse_result(given.get("scenario", ""))
    if command.alone:
        _load_numba_without_blas()
    from maxq.tools import simrun_fly  # noqa: PLC0415  # lazy

    return simrun_fly.execute(start_s, **given)


def _export(place: str, **given: Any) -> int:
    if "fmu" in given:
        _refuse_result(place)
        from maxq.tools.fmu import export as unit  # noqa: PLC0415  # lazy

        return unit.execute(place, **given)
    if not given.keys() & _FLIGHT_FILES.keys():
        raise CommandError(f"export {place}: give a file to write: --fmu, --{', --'.join(_FLIGHT_FILES)}")
    announce("loading the simulator")
    from maxq.tools.exchange import export  # noqa: PLC0415  # lazy

    return export.execute(place, **given)


def _compare(**given: Any) -> int:
    announce("loading the simulator")
    from maxq.tools import simrun_compare  # noqa: PLC0415  # lazy

    return simrun_compare.execute(**given)


def _calibrate(**given: Any) -> int:
    announce("loading the simulator")
    from maxq.tools import simrun_calibrate  # noqa: PLC0415  # lazy

    return simrun_calibrate.execute(**given)


def _winds(**given: Any) -> int:
    from maxq.tools import simrun_winds  # noqa: PLC0415  # lazy

    return simrun_winds.execute(**given)


def _limit(**given: Any) -> int:
    announce("loading the simulator")
    _refuse_result(given["scenario"])
    from maxq.tools import simrun_limit  # noqa: PLC0415  # lazy

    return simrun_limit.execute(**given)


def _refly(place: str, run: int | None = None, **given: Any) -> int:
    if os.path.isdir(place):
        if run is None:
            raise CommandError(f"{place} is a folder: name a run of the campaign in it with --run N")
        return int(_campaigns().fly_run(place, run, **given))
    if run is not None:
        raise CommandError(f"{place} is no folder of a campaign: --run {run} has no meaning")
    return _fly(log=place, **given)


def _campaigns() -> ModuleType:
    from maxq.tools import simrun_campaign  # noqa: PLC0415  # lazy

    return simrun_campaign


def _copy(name: str, folder: str) -> int:
    from maxq.sim.scenario.loader import copy_scenario  # noqa: PLC0415  # lazy

    tell(f"copied; fly it with: simrun {shlex.quote(str(copy_scenario(name, folder)))}")
    return Exit.OK


def _upgrade(file: str) -> int:
    from maxq.tools import simrun_upgrade  # noqa: PLC0415  # lazy

    return simrun_upgrade.execute(file)


def _shard(text: str) -> str:
    """Check and return the number of a shard, as in 3/8. Raises argparse.ArgumentTypeError."""
    from maxq.sim.campaign.shards import shard_from  # noqa: PLC0415  # lazy

    try:
        return str(shard_from(text))
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from None


def _kept(text: str) -> str:
    """Check and return a selection of runs whose logs are kept. Raises argparse.ArgumentTypeError."""
    from maxq.sim.campaign.schema import KEEP_ALLOWED, keep_is_known  # noqa: PLC0415  # lazy

    if not keep_is_known(text):
        raise argparse.ArgumentTypeError(f"{text}: allowed: {KEEP_ALLOWED}")
    return text


def _load_numba_without_blas() -> None:
    """Load Numba without its search for BLAS, which imports scipy.linalg and takes 0.2 s.

    Kernels use no linear algebra (CONTRIBUTING.md). The process ends after the flight, so scipy.linalg may be marked as
    unavailable during the import.
    """
    blas = "scipy.linalg.cython_blas"
    if blas in sys.modules:
        return
    sys.modules[blas] = None  # type: ignore[assignment]  # Python's marker for "cannot be imported"
    try:
        import numba.np.arraymath  # noqa: F401, PLC0415  # its import makes the search
    finally:
        del sys.modules[blas]


def _print_schema(kind: str) -> int:
    wipe()
    if kind == "flight-software":
        from maxq.control.external import HEADER  # noqa: PLC0415  # lazy

        print(HEADER.read_text(encoding="utf-8"), end="")
        return Exit.OK
    if kind == "messages":
        from maxq.tools.flight_messages import as_csv  # noqa: PLC0415  # lazy

        print(as_csv(), end="")
        return Exit.OK
    import json  # noqa: PLC0415  # lazy

    from maxq.tools.schemas import json_schema  # noqa: PLC0415  # lazy

    print(json.dumps(json_schema(kind), indent=1))
    return Exit.OK


command = Command(
    "simrun",
    _run,
    interrupted="interrupted before the flight began; nothing written",
    memory="shorten the flight, log less often, or use fewer --workers",
)
main = command.main

if __name__ == "__main__":
    command()
