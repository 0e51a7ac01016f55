"""The subcommands `simrun fly SCENARIO` and `simrun refly LOG`: load, fly, write, compare, report.

`simrun` imports this module only for a flight.
"""

from __future__ import annotations

import hashlib
import math
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path

from maxq.sim.files import check_writable, plain_name, write_whole
from maxq.sim.flight.telemetry import FAST, SLOW
from maxq.sim.log.head import VERSION_KEY, LogError, maxq_version
from maxq.sim.log.reader import LoggedRun, read_run
from maxq.sim.packing.flight import pack_flight
from maxq.sim.run import record
from maxq.sim.run.flight import Flight
from maxq.sim.run.fly import FlightRun
from maxq.sim.run.paced import PacedRun
from maxq.sim.scenario.loader import LoadedScenario, load_scenario
from maxq.tools.cli.frame import CommandError, Exit, Interruption, say
from maxq.tools.cli.terminal import Progress, announce, tell
from maxq.tools.flight_report import report

_VALUE_BYTES = 5.9  # of a compressed log: 102 MB of the nominal flight divided by its number of values
_LARGE_MB = 100.0
CYCLES_NAME = "pace.csv"  # of a paced flight


def execute(
    start_s: float,
    *,
    scenario: str = "",
    log: str | None = None,
    overrides: tuple[str, ...] = (),
    out: str | None = None,
    no_log: bool = False,
    view: bool = False,
    view_port: int | None = None,
    realtime: float | None = None,
    pace: float | None = None,
    pace_limit: float | None = None,
) -> int:
    """Fly a scenario, or the scenario in a log. Return the exit code.

    `start_s` is `time.perf_counter()` at the start of the command. The other arguments are the options.
    """
    announce(f"reading {scenario or log}")
    loaded, comparison = _load(scenario, log, overrides)
    if pace is not None and loaded.vehicle.computer is None:
        raise CommandError(f"--pace: {loaded.label} has no [computer], at whose samples the flight would wait")
    packed = pack_flight(loaded.scenario)
    folder = _folder(log, out, loaded.name, overrides)
    if folder is not None:
        check_writable(folder, LogError)
    loaded.warnings  # noqa: B018  # computed here, so that an error in the warnings precedes the flight
    loaded_s = time.perf_counter()
    announce("loading the compiled flight")
    live = None
    if view or view_port is not None:
        with viewer_needed():
            from maxq.tools.replay.live import LiveView  # noqa: PLC0415  # lazy: rerun takes half a second

            live = LiveView(loaded, view_port)
    with Progress():  # reports the compilation of kernels
        logs = folder is not None and not no_log
        if live is not None:
            run: FlightRun = live.run(packed, realtime)
        elif pace is not None:
            run = PacedRun(loaded, packed, logs, factor=pace, limit_s=pace_limit or math.inf)
        else:
            run = FlightRun(loaded, packed, logs)
    if folder is not None and not no_log:
        announce_log(run)
    prepared_s = time.perf_counter()

    def timing() -> dict[str, float]:
        total_s = time.perf_counter() - start_s
        timing = {"load_s": loaded_s - start_s, "prepare_s": prepared_s - loaded_s, "total_s": total_s}
        return timing | (_pace_timing(run) if isinstance(run, PacedRun) else {})

    with Interruption() as stop, Progress() as progress:

        def watch(run: FlightRun) -> None:
            show_flight(progress, run)
            comparison.look(run)

        if live is not None:
            live.stop = stop
        if isinstance(run, PacedRun):
            run.stop = stop
        comparison.look(run)
        try:
            if folder is None:
                flight = record.fly_to_end(run, watch=watch, stop=stop)
            else:
                flight = record.record(run, folder, log=not no_log, watch=watch, stop=stop, timing=timing)
        except KeyboardInterrupt:
            say("simrun", "interrupted twice: no summary, the log ends early")
            return Exit.INTERRUPTED
    files = []
    if folder is not None:
        files = [folder / record.LOG_NAME] * (not no_log) + [folder / record.SUMMARY_NAME]
        (folder / CYCLES_NAME).unlink(missing_ok=True)  # it describes another flight
    notes = []
    if isinstance(run, PacedRun):
        notes = [_pace_text(run)]
        if folder is not None:
            files.append(_write_cycles(folder / CYCLES_NAME, run))
    tell(report(flight, files, timing()["total_s"], notes))
    same = comparison.verdict(flight)
    if flight.outcome == "interrupted":
        return Exit.INTERRUPTED
    return Exit.OK if flight.passed and same else Exit.FAILED


def _pace_timing(run: PacedRun) -> dict[str, float]:
    """Return the entries of a paced flight for the timing in the summary, s of real time."""
    late = run.lateness()
    entries = asdict(late) if late.cycles else {"cycles": 0}
    return {"pace": run.factor} | {f"pace_{name}": value for name, value in entries.items()}


def _pace_text(run: PacedRun) -> str:
    late = run.lateness()
    ms = "{:.3f} ms".format
    text = f"at {run.factor:g} times real time: {late.cycles} cycles"
    if late.cycles == 0:
        return text
    text += f", late by {ms(1e3 * late.late_mean_s)} on average, {ms(1e3 * late.late_99_s)} (99 %), "
    text += f"{ms(1e3 * late.late_max_s)} at most, at {late.late_max_at_s:.3f} s; "
    worst = f", late by at most {ms(1e3 * late.overrun_max_s)}" if late.overruns else ""
    return f"{text}{late.overruns or 'no'} overrun{'s' * (late.overruns != 1)}{worst}"


def _write_cycles(path: Path, run: PacedRun) -> Path:
    """Write the time of flight, the lateness and the overruns of all cycles as CSV. Raises LogError."""
    lines = [f"{time_s:.9g},{late_s:.6f},{overran:.0f}" for time_s, late_s, overran in run.cycles.tolist()]
    write_whole(path, "\n".join(["time_s,late_s,overrun", *lines]) + "\n", LogError)
    return path


def show_flight(progress: Progress, run: FlightRun) -> None:
    """Show the progress of a flight, as a share of the duration only if no event can end the flight earlier."""
    limits = run.loaded.scenario.run
    end_s = limits.start_s + limits.duration_s
    if limits.stop_at:
        progress.show("flying", 0.0, 0.0, count=f"{run.now_s:.1f} s of at most {end_s:g} s")
    else:
        progress.show("flying", run.now_s - limits.start_s, limits.duration_s, count=f"{run.now_s:.1f} of {end_s:g} s")


@contextmanager
def viewer_needed() -> Iterator[None]:
    """Convert errors of opening a viewer in the block into a CommandError that names --view."""
    from maxq.tools.replay.viewer import check_installed  # noqa: PLC0415  # lazy: flights without a view do not need it

    try:
        check_installed()
        yield
    except CommandError as error:
        raise CommandError(f"--view: {error}") from error
    except ImportError as error:
        raise CommandError(f"--view: a package is missing or broken: {error}") from error


def _load(scenario: str, log: str | None, overrides: tuple[str, ...]) -> tuple[LoadedScenario, Comparison]:
    if log is None:
        return load_scenario(scenario, overrides).telling(overrides), Comparison(None)
    logged = read_run(log)
    return record.scenario_in(logged, overrides).telling(overrides), Comparison(logged, changed=bool(overrides))


def _folder(log: str | None, out: str | None, name: str, overrides: tuple[str, ...]) -> Path | None:
    """Return the folder for the results, or None for a log that is flown again without --out.

    A scenario that --set changes has a separate folder, named by a hash of the changes. Its result does not replace
    that of the plain scenario, but the same command replaces its own result. Raises LogError if the log to be flown
    again would be replaced.
    """
    if out is None:
        plain = plain_name(name, "flight")
        if overrides and not any(change.partition("=")[0].strip() == "name" for change in overrides):
            plain += f"-{hashlib.sha256(repr(overrides).encode()).hexdigest()[:6]}"
        return None if log else Path("runs") / plain
    path = Path(out) / record.LOG_NAME
    if log and path.exists() and path.samefile(log):
        raise LogError(f"{path}: is the log that is to be flown again; choose another folder for --out")
    return Path(out)


def announce_log(run: FlightRun) -> None:
    """Print the expected size of a large log, and the options that make it smaller."""
    scenario = run.loaded.scenario
    values = scenario.log.fast_hz * len(run.table.columns(FAST)) + scenario.log.slow_hz * len(run.table.columns(SLOW))
    size_MB = 1e-6 * _VALUE_BYTES * values * scenario.run.duration_s
    if size_MB > _LARGE_MB:
        tell(f"log: up to {size_MB:.0f} MB; --set log.fast_hz=100 makes it smaller, --no-log omits it\n")


class Comparison:
    """The comparison of a flight with a log, by the hash of state, time, metrics and events at the end of the log.

    `logged` is None for a flight that is not compared. `changed` is True if overrides change the scenario.
    """

    def __init__(self, logged: LoggedRun | None, changed: bool = False) -> None:
        self._logged = logged
        self._changed = changed
        end = logged.end.get(record.END_KEY, "") if logged else ""
        self._end_ns = int(end) if end.isdecimal() else -1
        self._hash = ""

    def look(self, run: FlightRun) -> None:
        """Store the hash if the flight is at the end of the log. Call this before the flight and after every
        segment.
        """
        if int(run.memory.clock.now_ns) == self._end_ns:
            self._hash = run.state_hash()

    def verdict(self, flight: Flight) -> bool:
        """Print the result of the comparison.

        Return False if the flight differs, or if it could not be compared as required.
        """
        if self._logged is None:
            return True
        path = self._logged.path
        if self._changed:
            tell(f"not compared with {path}: --set changes the scenario")
            return True
        logged = self._logged.end.get(record.STATE_HASH_KEY)
        if logged is None or self._end_ns < 0:
            tell(f"not compared with {path}: it was cut off and holds no final state")
            return False
        if flight.outcome == "interrupted" and not self._hash:
            tell(f"not compared with {path}: interrupted before its end at {self._end_ns / 1e9:.3f} s")
            return False
        if self._hash == logged:
            early = "" if flight.end_ns == self._end_ns else f" at {self._end_ns / 1e9:.3f} s, where that ends"
            tell(f"SAME as {path}: equal state, bit by bit{early} ({logged[:16]})")
            return True
        written_by = self._logged.metadata.get(VERSION_KEY, "")
        other = f"; that was flown by maxq {written_by}" if written_by != maxq_version() else ""
        mine = self._hash[:16] or f"none at {self._end_ns / 1e9:.3f} s"
        tell(f"DIFFERENT from {path}: state hash {mine}, there {logged[:16]}{other}")
        return False
