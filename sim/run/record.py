"""The recording of a flight in files: DIR/flight.mcap during the flight, DIR/summary.json at its end.

    flight = record(FlightRun(load_scenario("nominal")), "runs/nominal")

A separate thread writes the log, a few segments behind the flight. Kernel and compression both release the
interpreter's lock and run in parallel. Memory contains a few segments, never the whole flight.
"""

from __future__ import annotations

import json
import math
import platform
from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import asdict
from importlib.metadata import version
from pathlib import Path

from maxq.sim.files import cannot_write, write_whole
from maxq.sim.flight.metric_table import unit_of
from maxq.sim.flight.telemetry import SLOW
from maxq.sim.input.values import period_ns
from maxq.sim.log import messages
from maxq.sim.log.head import Attachment, LogError, RunHead
from maxq.sim.log.reader import LoggedRun
from maxq.sim.log.writer import LogWriter
from maxq.sim.packing.integration import MethodError, worst_error
from maxq.sim.run.flight import WAVE_BREAKING_NAME, Event, Flight, LoggedRows, copied
from maxq.sim.run.fly import CONTROL_LOST_NAME, DIVERGED_NAME, FAULT_NAME, OVERRUN_NAME, SOFTWARE_NAME, FlightRun
from maxq.sim.run.launch_frames import LaunchFrames, LaunchSite
from maxq.sim.scenario.loader import LoadedScenario, load_scenario_text, to_toml

LOG_NAME, SUMMARY_NAME = "flight.mcap", "summary.json"
SCENARIO_ATTACHMENT, DESIGN_ATTACHMENT = "scenario.toml", "design.toml"
STATE_HASH_KEY, END_KEY, STEPS_KEY, OUTCOME_KEY = "state_hash", "end_ns", "steps", "outcome"
SUMMARY_SCHEMA = 2  # 2: channel names of log schema 2 under `final`
_PACKAGES = ("maxq", "numpy", "numba")
_TOML = "application/toml"
_SEGMENTS_WAITING = 4
LEVELS = {
    FAULT_NAME: messages.Level.WARNING,
    WAVE_BREAKING_NAME: messages.Level.WARNING,
    CONTROL_LOST_NAME: messages.Level.ERROR,
    DIVERGED_NAME: messages.Level.FATAL,
    SOFTWARE_NAME: messages.Level.FATAL,
    OVERRUN_NAME: messages.Level.FATAL,
}


class Interrupted(Exception):
    """The reason recorded in the log of a flight that was stopped before its end."""


def record(
    run: FlightRun | LoadedScenario,
    folder: str | Path,
    *,
    log: bool = True,
    watch: Callable[[FlightRun], None] | None = None,
    stop: Callable[[], bool] = lambda: False,
    timing: Callable[[], dict[str, float]] = dict,
    number: int = 0,
) -> Flight:
    """Fly `run` to its end, write its log and summary into `folder`, and return the flight without log rows.

    The folder is created if it is missing, and files of the same names are replaced. `watch` is called after every
    segment (1 s of simulated time, or about a thousand steps). If `stop` then returns True, the flight ends there with
    the outcome "interrupted". `timing` returns further entries for the timing in the summary. `number` is the number of
    the run in a campaign.

    Raises LogError if a file cannot be written. If the first file cannot be created, new folders are removed.
    """
    run = FlightRun(run) if isinstance(run, LoadedScenario) else run
    folder = Path(folder)
    made = _make(folder)
    try:
        (folder / SUMMARY_NAME).unlink(missing_ok=True)  # it describes another flight
        writer = LogWriter(folder / LOG_NAME, run.table, run_head(run.loaded, number)) if log else None
    except (OSError, LogError) as error:
        for empty in made:
            empty.rmdir()
        raise error if isinstance(error, LogError) else LogError(cannot_write(folder / SUMMARY_NAME, error)) from error
    flight = fly_to_end(run, _LogThread(writer, run) if writer else None, watch=watch, stop=stop)
    write_summary(folder / SUMMARY_NAME, flight, LOG_NAME if log else None, timing())
    return flight


def run_head(loaded: LoadedScenario, number: int = 0) -> RunHead:
    """Return the head of a log, from which the same flight can be flown again."""
    scenario, site = loaded.scenario, loaded.scenario.site
    metadata = {
        "scenario": scenario.name,
        "description": scenario.description,
        "vehicle": scenario.vehicle.name,
        "design": scenario.design.name if scenario.design else "",
        "seed": str(scenario.run.seed),
        "run": str(number),
        "site_latitude_deg": repr(site.latitude_deg),
        "site_longitude_deg": repr(site.longitude_deg),
        "site_altitude_m": repr(site.altitude_m),
        "azimuth_deg": repr(site.azimuth_deg),
        "t0_utc": site.utc,
    }
    attachments = [Attachment(SCENARIO_ATTACHMENT, _TOML, loaded.as_flown.encode())]
    if scenario.design is not None:
        attachments.append(Attachment(DESIGN_ATTACHMENT, _TOML, to_toml(scenario.design).encode()))
    return RunHead(metadata, tuple(attachments))


def scenario_in(logged: LoggedRun, overrides: tuple[str, ...] = ()) -> LoadedScenario:
    """Return the scenario as flown that a log contains. Raises LogError if it contains none."""
    attachment = logged.attachments.get(SCENARIO_ATTACHMENT)
    if attachment is None:
        raise LogError(f"{logged.path}: the log holds no scenario ({SCENARIO_ATTACHMENT})")
    return load_scenario_text(attachment.data.decode(errors="replace"), overrides, f"scenario in {logged.path}")


def result_record(flight: Flight) -> dict[str, str]:
    """Return the result for the end of the log, with which a repeated flight can be compared bit by bit."""
    return {
        OUTCOME_KEY: flight.outcome,
        END_KEY: str(flight.end_ns),
        STEPS_KEY: str(flight.steps),
        STATE_HASH_KEY: flight.state_hash,
    }


def _make(folder: Path) -> list[Path]:
    """Create a folder, and return the folders that were missing, innermost first. Raises LogError."""
    missing = [path for path in (folder, *folder.parents) if not path.exists()]
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        for path in missing:
            if path.is_dir():
                path.rmdir()
        raise LogError(cannot_write(folder, error)) from error
    return missing


def fly_to_end(
    run: FlightRun,
    log: _LogThread | None = None,
    *,
    watch: Callable[[FlightRun], None] | None = None,
    stop: Callable[[], bool] = lambda: False,
) -> Flight:
    """Fly a run to its end without keeping rows, and close its log; `watch` and `stop` are as in `record`."""
    try:
        while not run.finished and not stop():
            rows = run.fly_segment()
            if log is not None:
                log.put(rows, run.events)
            if watch is not None:
                watch(run)
        flight = run.result()
    except BaseException as error:
        if log is not None:
            log.close(error, None)
        raise
    if log is not None:
        aborted = Interrupted(f"at {flight.end_s:.3f} s") if flight.outcome == "interrupted" else None
        log.close(aborted, flight)
    return flight


class _LogThread:
    """The thread that writes segments in parallel with the flight. A later `put`, or `close`, raises its errors."""

    def __init__(self, writer: LogWriter, run: FlightRun) -> None:
        scenario, earth = run.loaded.scenario, run.packed.parameters[0].environment.earth
        transform_ns = period_ns(scenario.log.transform_hz)
        self._writer = writer
        self._run = run
        self._frames = LaunchFrames(run.table, LaunchSite(earth, scenario.site), transform_ns)
        self._written: set[Event] = set()
        self._pool = ThreadPoolExecutor(1, "log")
        self._waiting: deque[Future[None]] = deque()

    def put(self, rows: LoggedRows, events: Sequence[Event]) -> None:
        if len(self._waiting) == _SEGMENTS_WAITING:
            self._waiting.popleft().result()
        new = [event for event in events if event not in self._written]
        self._written.update(new)
        self._waiting.append(self._pool.submit(self._write, copied(rows), [self._message(event) for event in new]))

    def close(self, error: BaseException | None, flight: Flight | None) -> None:
        """Write the waiting segments and the end of the log."""
        try:
            while self._waiting:
                self._waiting.popleft().result()
        except Exception as failure:
            self._pool.shutdown(cancel_futures=True)
            self._writer.close(error or failure)
            if error is None:
                raise
        else:
            self._pool.shutdown()
            self._writer.close(error, result_record(flight) if flight else None)

    def _message(self, event: Event) -> messages.EventMessage:
        return messages.EventMessage(event.time_ns, LEVELS.get(event.name, messages.Level.INFO), event.text, "flight")

    def _write(self, rows: LoggedRows, events: list[messages.EventMessage]) -> None:
        self._writer.write_block(rows, events, [self._frames.path(*rows[SLOW])])


def versions() -> dict[str, str]:
    """Return the versions on which the bits of a flight depend."""
    return {"python": platform.python_version()} | {name: version(name) for name in _PACKAGES}


def write_summary(path: Path, flight: Flight, log: str | None, timing: dict[str, float]) -> None:
    """Write the summary of a flight, which contains everything except channels over time, completely or not at all.

    Numbers that are not finite become null. `log` is the name of the log, or None. Raises LogError if the file cannot
    be written.
    """
    scenario = flight.scenario.scenario
    summary = {
        "schema": SUMMARY_SCHEMA,
        "scenario": scenario.name,
        "description": scenario.description,
        "outcome": flight.outcome,
        "cause": flight.cause,
        "passed": flight.passed,
        "failures": flight.failures,
        "warnings": flight.scenario.warnings,
        "beyond_model": flight.beyond_model,
        "end_s": flight.end_s,
        "events": [
            {"name": event.name, "time_s": event.time_s}
            | {key: value for key, value in (("stage", event.stage), ("detail", event.detail)) if value}
            for event in flight.events
        ],
        "metrics": {
            name: {"value": _number(value), "unit": unit_of(name), "time_s": _number(flight.metric_times_s[name])}
            for name, value in flight.metrics.items()
        },
        "requirements": [
            {
                "name": verdict.name,
                "metric": verdict.requirement.metric,
                verdict.bound[0]: verdict.bound[1],
                "value": _number(verdict.value),
                "unit": unit_of(verdict.requirement.metric),
                "time_s": _number(verdict.time_s),
                "met": verdict.met,
            }
            for verdict in flight.verdicts
        ],
        "final": {name: _number(value) for name, value in flight.final.items()},
        "state_hash": flight.state_hash,
        "steps": flight.steps,
        "integration": _integration(worst_error(scenario)),
        "seed": scenario.run.seed,
        "log": log,
        "timing": {"flight_s": flight.wall_s} | timing,
        "versions": versions(),
    }
    if flight.section_extremes:
        summary["section_loads"] = [
            {name: _number(value) if isinstance(value, float) else value for name, value in asdict(extreme).items()}
            for extreme in flight.section_extremes
        ]
    text = json.dumps(summary, indent=2, ensure_ascii=False, allow_nan=False)
    write_whole(path, text + "\n", LogError)


def _integration(error: MethodError | None) -> dict[str, object] | None:
    """Return the integration error of an oscillation for the summary."""
    if error is None:
        return None
    return error.oscillation._asdict() | {
        "step_s": error.step_s,
        "added_damping_ratio": error.added_damping_ratio,
        "frequency_error": error.frequency_error,
        "warning": error.text,
    }


def _number(value: float) -> float | None:
    return value if math.isfinite(value) else None
