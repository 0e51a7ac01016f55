"""One flight to be shown: its log, the scenario inside it, and how it ended.

A log that is cut off or damaged is shown as far as it reaches. Where the scenario inside cannot be read (an older
or a later maxq), numbers and trajectory are still shown, but no vehicle and no limits. Numbers of many flights do not
fit into memory at once: a `LogShelf` holds those of the last few and reads the others again.
"""

from __future__ import annotations

import json
import re
import tomllib
from collections import OrderedDict
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from maxq.control.kernel.records import Array, IntArray
from maxq.sim.flight.channels import ChannelTable
from maxq.sim.log.foxglove import Level
from maxq.sim.log.head import LogError
from maxq.sim.log.reader import Log, read_log
from maxq.sim.scenario.errors import ScenarioError
from maxq.sim.scenario.schema_environment import Earth, Site
from maxq.sim.scenario.schema_scenario import Scenario
from maxq.tools.replay.error import ReplayError

SCENARIO_ATTACHMENT = "scenario.toml"
_SUMMARY = "summary.json"
_FAULTS = ("control_lost", "diverged")


class Channels(Protocol):
    """Columns of a flight by channel name: a log, or a block of a flight under way."""

    @property
    def table(self) -> ChannelTable: ...
    def __contains__(self, name: str) -> bool: ...
    def __getitem__(self, name: str) -> Array: ...
    def time_ns(self, name: str) -> IntArray: ...


@dataclass(frozen=True)
class Moment:
    """An event: `name` as in the log, `text` for people."""

    name: str
    time_ns: int
    text: str
    level: Level = Level.INFO

    @property
    def time_s(self) -> float:
        return self.time_ns / 1e9


@dataclass(frozen=True)
class Requirement:
    """What a scenario demands, and what the flight made of it as far as it is known."""

    name: str
    metric: str
    limit: float | None
    minimum: float | None
    unit: str
    value: float | None = None
    met: bool | None = None


class LogShelf:
    """Logs by their paths, the `most` last used in memory (None: all)."""

    def __init__(self, most: int | None = None) -> None:
        self._most = most
        self._logs: OrderedDict[Path, Log] = OrderedDict()

    def log(self, path: Path) -> Log:
        """Raises ReplayError where it cannot be read."""
        if path not in self._logs:
            while self._most is not None and len(self._logs) >= self._most:
                self._logs.popitem(last=False)
            try:
                self._logs[path] = read_log(path)
            except LogError as error:
                raise ReplayError(str(error)) from error
        self._logs.move_to_end(path)
        return self._logs[path]


@dataclass(frozen=True)
class ReplayFlight:
    """`label` names the flight for people; `moments` are its events and those read off its channels (largest dynamic
    pressure), in order; `span_s` is its first and last time; `damage` says what of the log is missing, a sentence each.
    """

    path: Path
    label: str
    shelf: LogShelf = field(repr=False)
    end: Mapping[str, str]
    moments: tuple[Moment, ...]
    span_s: tuple[float, float]
    damage: tuple[str, ...]
    summary: Mapping[str, Any] = field(repr=False)

    @property
    def log(self) -> Log:
        return self.shelf.log(self.path)

    @property
    def scenario(self) -> Scenario | None:
        return self._scenario_and_complaint[0]

    @property
    def notes(self) -> tuple[str, ...]:
        """What cannot be shown, a sentence each."""
        return (*self.damage, *self._scenario_and_complaint[1])

    @cached_property
    def _scenario_and_complaint(self) -> tuple[Scenario | None, tuple[str, ...]]:
        return _scenario(self.log)

    @property
    def outcome(self) -> str:
        """As `Flight.outcome`; "cut off" where the log does not say it."""
        return self.end.get("outcome", "cut off")

    @cached_property
    def verdict(self) -> str:
        """`passed`, `failed` or `unknown` (no summary.json beside the log, and no fault in it)."""
        if isinstance(self.summary.get("passed"), bool):
            return "passed" if self.summary["passed"] else "failed"
        return "failed" if any(self.moment(name) for name in _FAULTS) else "unknown"

    def moment(self, name: str) -> Moment | None:
        """The last event of that name."""
        return next((m for m in reversed(self.moments) if m.name == name), None)

    @cached_property
    def requirements(self) -> tuple[Requirement, ...]:
        """Those of the scenario; values from the summary beside the log."""
        from maxq.sim.run.metrics import unit_of  # noqa: PLC0415  # lazy: loads the kernels' modules

        if self.scenario is None:
            return ()
        judged = {(r.get("name"), r.get("metric")): r for r in self.summary.get("requirements", [])}
        out = []
        for r in self.scenario.requirement:
            about = judged.get((r.name or r.metric, r.metric), {})
            value, met = about.get("value"), about.get("met")
            unit = unit_of(r.metric)
            out.append(Requirement(r.name or r.metric, r.metric, r.limit, r.minimum, unit, value, met))
        return tuple(out)


def open_flight(path: Path, label: str = "", shelf: LogShelf | None = None) -> ReplayFlight:
    """Read a log and what belongs to it. Raises ReplayError where nothing of it can be shown."""
    shelf = shelf or LogShelf()
    log = shelf.log(path)
    if not any(len(log.time_ns(topic.name)) for topic in log.table.topics):
        raise ReplayError(f"{path}: the log holds no samples: there is nothing to show")
    name = label or log.metadata.get("scenario") or path.stem
    return ReplayFlight(path, name, shelf, log.end, _moments(log), _span_s(log), log.notes, _summary(log))


def _moments(log: Log) -> tuple[Moment, ...]:
    found = [Moment(e.text.split(" ")[0].split(":")[0], e.time_ns, e.text, e.level) for e in log.events]
    largest = largest_pressure(log, found)
    return tuple(sorted([*found, *([largest] if largest else [])], key=lambda moment: moment.time_ns))


def _span_s(log: Log) -> tuple[float, float]:
    times = [log.time_ns(topic.name) for topic in log.table.topics]
    ends = [(int(t[0]), int(t[-1])) for t in times if len(t)]
    return min(a for a, _ in ends) / 1e9, max(b for _, b in ends) / 1e9


def _scenario(log: Log) -> tuple[Scenario | None, tuple[str, ...]]:
    from maxq.sim.scenario.loader import load_scenario_text  # noqa: PLC0415  # lazy: some logs hold none

    attachment = log.attachments.get(SCENARIO_ATTACHMENT)
    if attachment is None:
        return None, ("the log holds no scenario: neither vehicle nor limits are shown",)
    try:
        text = attachment.data.decode(errors="replace")
        return load_scenario_text(text, label="the scenario in the log").scenario, ()
    except ScenarioError as error:
        return None, (f"neither vehicle nor limits are shown: {error}",)


def launch_of(log: Log) -> tuple[Earth, Site]:
    """Earth and launch site, by the two tables of the scenario alone: all of it takes a third of a second to read.

    Where they cannot be read: WGS-84, and the site that the log's metadata name.
    """
    attachment = log.attachments.get(SCENARIO_ATTACHMENT)
    text = attachment.data.decode(errors="replace") if attachment is not None else ""
    tables = re.findall(r"^\[(?:earth|site)\]\n(?:[^\[\n].*\n|\n)*", text, re.MULTILINE)
    try:
        found = tomllib.loads("".join(tables))
        if "site" in found:
            return Earth.model_validate(found.get("earth", {})), Site.model_validate(found["site"])
    except ValueError:  # of TOML or of the schema
        pass
    data = log.metadata
    site = Site.model_construct(
        latitude_deg=float(data.get("site_latitude_deg", "0")),
        longitude_deg=float(data.get("site_longitude_deg", "0")),
        altitude_m=float(data.get("site_altitude_m", "0")),
        azimuth_deg=float(data.get("azimuth_deg", "90")),
    )
    return Earth(), site


def _summary(log: Log) -> Mapping[str, Any]:
    """The summary beside the log, if it tells of the same flight."""
    path = log.path.with_name(_SUMMARY)
    try:
        summary = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    same = isinstance(summary, dict) and summary.get("state_hash") == log.end.get("state_hash", "")
    return summary if same else {}


def largest_pressure(log: Channels, events: list[Moment]) -> Moment | None:
    """The largest dynamic pressure under thrust, which engineers call max q; None without air or thrust."""
    if "dynamic_pressure_Pa" not in log or "thrust_N" not in log:
        return None
    pressure, burning = log["dynamic_pressure_Pa"], log["thrust_N"] > 0.0
    times = log.time_ns("dynamic_pressure_Pa")
    if len(times) != len(burning) or not burning.any():
        return None
    powered = np.where(burning & np.isfinite(pressure), pressure, 0.0)
    k = int(np.argmax(powered))
    if powered[k] < 1000.0 or any(m.name == "max_q" for m in events):
        return None
    mach = f", Mach {log['mach'][k]:.2f}" if "mach" in log else ""
    return Moment("max_q", int(times[k]), f"max q {powered[k] / 1000.0:.1f} kPa{mach}")
