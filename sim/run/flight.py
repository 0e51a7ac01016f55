"""The result of a flight: channels by name, events, metrics and verdicts."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from maxq.control.kernel.records import Array, IntArray
from maxq.sim.flight.channels import ChannelTable
from maxq.sim.flight.metric_table import title_of, unit_of
from maxq.sim.flight.parameters import BURNOUT, EVENT_NAMES, LIFTOFF, TUMBLE
from maxq.sim.log.tabular import Tabular, html_table
from maxq.sim.run.metrics import SectionExtreme, Verdict, tightest_first
from maxq.sim.run.quantities import quantity
from maxq.sim.scenario.loader import LoadedScenario

WAVE_BREAKING_NAME = "wave_breaking"
_FIRST_ROOM = 400_000  # rows
_SPACE_M = 100e3

LoggedRows = dict[str, tuple[IntArray, Array]]
"""The log rows by rate group: times (n,), ns, and values (n, columns of the group) in logged units."""


@dataclass(frozen=True)
class Event:
    """An event of a flight.

    `stage` is the number of the stage, from 1, for a vehicle with several stages; 0 denotes the whole vehicle. `detail`
    is the part concerned, or the cause of a failure.
    """

    name: str
    time_ns: int
    stage: int = 0
    detail: str = ""

    @property
    def time_s(self) -> float:
        return self.time_ns / 1e9

    @property
    def title(self) -> str:
        """Return the name and stage of the event, for messages."""
        return self.name + (f" (stage {self.stage})" if self.stage else "")

    @property
    def text(self) -> str:
        """Return the name, stage and detail of the event, for messages."""
        return self.title + (f": {self.detail}" if self.detail else "")


@dataclass(frozen=True)
class SeparationState:
    """The state of the whole vehicle in I immediately before the separation at the end of a stage, from 0."""

    stage: int
    time_ns: int
    r_I_m: tuple[float, float, float]
    v_I_mps: tuple[float, float, float]


@dataclass(frozen=True, repr=False)
class Flight(Tabular):
    """The result of a flight.

    `flight["alpha_deg"]` returns the values (n,) of a channel, and `flight.time_s("alpha_deg")` their times (n,).

    - `metrics`, `metric_times_s`: values and times by metric name; the time of a metric never updated is nan.
    - `outcome`: reason for the end: "impact" or another event of run.stop_at, "duration", "diverged",
      "flight_software", "overrun" or "interrupted".
    - `cause`: reason for a divergence, an overrun, or a failure of external flight code.
    - `final`: value of every channel at the last instant, with or without a log.
    - `separations`: states at separations that are scheduled; empty with external flight code.
    """

    scenario: LoadedScenario
    table: ChannelTable
    rows: LoggedRows = field(repr=False)
    events: tuple[Event, ...]
    metrics: dict[str, float]
    metric_times_s: dict[str, float]
    verdicts: tuple[Verdict, ...]
    section_extremes: tuple[SectionExtreme, ...]
    failures: tuple[str, ...]  # failures with times, such as loss of control, other than missed requirements
    inexact: bool  # control was kept, but an estimated integration error exceeds run.accuracy
    outcome: str
    cause: str
    end_s: float
    end_ns: int
    steps: int
    state: Array = field(repr=False)
    final: dict[str, float] = field(repr=False)
    state_hash: str
    wall_s: float
    separations: tuple[SeparationState, ...] = field(default=(), repr=False)

    def __getitem__(self, channel: str) -> Array:
        """Return the values (n,) of a channel; raise KeyError for an unknown name or a flight without a log."""
        return self._rows(channel)[1][:, self.table.index(channel)]

    def time_s(self, channel: str) -> Array:
        """Return the times (n,) of a channel's values, s; raise KeyError as for the values."""
        return self._rows(channel)[0] / 1e9

    def _rows(self, channel: str) -> tuple[IntArray, Array]:
        if channel not in self.table:
            raise self._unknown(channel)
        if not self.rows:
            raise KeyError(f"{channel}: flown without a log")
        return self.rows[self.table.topic(channel).group]

    def __repr__(self) -> str:
        met = f"{sum(v.met for v in self.verdicts)} of {len(self.verdicts)} requirements met"
        failed = f", {'; '.join(self.failures)}" if self.failures else ""
        return f"<Flight {self.scenario.name}: {self.outcome} at {self.end_s:.3f} s, {met}{failed}>"

    def _repr_html_(self) -> str:
        """Return the requirements and metrics as an HTML table, for notebooks."""
        verdicts = tightest_first(self.verdicts)
        rows = [(v.name, "met" if v.met else "MISSED", v.shown[0], v.limit_text) for v in verdicts]
        for name in self.telling_metrics:
            rows.append((title_of(name), "", *quantity(self.metrics[name], unit_of(name))))
        return html_table(repr(self).strip("<>"), ("", "", "value", "limit or unit"), rows)

    @property
    def telling_metrics(self) -> tuple[str, ...]:
        """Return the names of the metrics that describe this flight.

        Metrics without a value are omitted, as are those of an orbit with its perigee below the ground. The apogee of
        such an orbit is omitted if the flight has passed it or ended at impact, or if it is below _SPACE_M. Its
        altitude is relative to the equatorial radius, which is up to 21 km above the ground.
        """
        orbits = self.metrics["perigee_altitude_m"] >= 0.0
        apogee_ahead = math.isnan(self.event_s("apogee")) and self.outcome != "impact"
        shows_apogee = orbits or (apogee_ahead and self.metrics["apogee_altitude_m"] >= _SPACE_M)
        names = [
            name
            for name, value in self.metrics.items()
            if not math.isnan(value)
            and (orbits or not name.startswith(("orbit_", "perigee_")))
            and (shows_apogee or name != "apogee_altitude_m")
        ]
        first, then = "max_powered_dynamic_pressure_Pa", "max_dynamic_pressure_Pa"  # "max q" is that of the ascent
        if first in names and then in names:
            names.remove(first)
            names.insert(names.index(then), first)
        return tuple(names)

    def event_s(self, name: str) -> float:
        """Return the time of the last event with this name, s; nan if there is none."""
        return max((e.time_s for e in self.events if e.name == name), default=math.nan)

    @property
    def remarks(self) -> tuple[str, ...]:
        """Return the remarks of a verdict: an end before liftoff, a tumble, departures from the limits of the model."""
        tumble_s, burnout_s = self.event_s(EVENT_NAMES[TUMBLE]), self.event_s(EVENT_NAMES[BURNOUT])
        since = f", {tumble_s - burnout_s:.3f} s after burnout" if tumble_s >= burnout_s else ""
        said = []
        on_pad = self.scenario.scenario.held and math.isnan(self.event_s(EVENT_NAMES[LIFTOFF]))
        if on_pad and not self.failures:
            said.append("the flight ends before liftoff")
        if not math.isnan(tumble_s):
            said.append(f"the vehicle tumbles from {tumble_s:.3f} s on{since}")
        return (*said, *(f"beyond the model: {what}" for what in self.beyond_model))

    @property
    def beyond_model(self) -> tuple[str, ...]:
        """Return a line, with its first time, for each departure from the limits of the model: a breaking wave."""
        return tuple(
            f"wave breaks at {e.time_s:.3f} s in {e.detail.split(':')[0]}"
            for e in self.events
            if e.name == WAVE_BREAKING_NAME
        )

    @property
    def passed(self) -> bool:
        """Return True if the flight reached its end without a failure, with all requirements met."""
        return self.outcome != "interrupted" and not self.failures and all(v.met for v in self.verdicts)


def copied(rows: LoggedRows) -> LoggedRows:
    """Return a copy of log rows, which the next segment does not overwrite."""
    return {group: (times.copy(), values.copy()) for group, (times, values) in rows.items()}


def joined(parts: list[LoggedRows]) -> LoggedRows:
    """Return consecutive blocks of rows as one block."""
    return {
        group: (np.concatenate([part[group][0] for part in parts]), np.concatenate([part[group][1] for part in parts]))
        for group in parts[0]
    }


class GrowingRows:
    """The log rows of all segments so far, in arrays larger than needed, so that no long log is copied as a whole.

    The unused part of the arrays takes address space only.
    """

    def __init__(self) -> None:
        self._room: LoggedRows = {}
        self._used: dict[str, int] = {}

    def add(self, rows: LoggedRows) -> None:
        for group, (times, values) in rows.items():
            if group not in self._room:
                self._room[group] = (np.empty(_FIRST_ROOM, np.int64), np.empty((_FIRST_ROOM, values.shape[1])))
                self._used[group] = 0
            begin, end = self._used[group], self._used[group] + len(times)
            for array in self._room[group]:
                if end > len(array):
                    array.resize((max(end, len(array) * 5 // 4), *array.shape[1:]), refcheck=False)
            self._room[group][0][begin:end], self._room[group][1][begin:end] = times, values
            self._used[group] = end

    def rows(self) -> LoggedRows:
        return {
            group: (times[: self._used[group]], values[: self._used[group]])
            for group, (times, values) in self._room.items()
        }
