"""A flight that has been flown: channels by name, events, metrics and verdicts."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from maxq.control.kernel.records import Array, IntArray
from maxq.sim.flight.channels import ChannelTable
from maxq.sim.flight.metric_table import figures, title_of, unit_of
from maxq.sim.log.tabular import Tabular, html_table
from maxq.sim.run.metrics import SectionExtreme, Verdict
from maxq.sim.scenario.loader import LoadedScenario

WAVE_BREAKING_NAME = "wave_breaking"
_FIRST_ROOM = 400_000  # rows

LoggedRows = dict[str, tuple[IntArray, Array]]
"""By rate group: times (n,) in ns and values (n, columns of the group) in logged units."""


@dataclass(frozen=True)
class Event:
    """`stage` counts from 1 on a vehicle of several stages; 0 for an event of the whole vehicle. `detail`: what has
    failed, or why the flight did.
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
        """Name and stage, for people."""
        return self.name + (f" (stage {self.stage})" if self.stage else "")

    @property
    def text(self) -> str:
        """Name, stage and detail, for people."""
        return self.title + (f": {self.detail}" if self.detail else "")


@dataclass(frozen=True, repr=False)
class Flight(Tabular):
    """A flight that has been flown.

    `flight["alpha_deg"]` is a channel, `flight.time_s("alpha_deg")` its times; `metrics` and `metric_times_s`
    go by metric name (nan: no time, the metric was never updated). `outcome`: "impact" or another event of
    run.stop_at that ended it, "duration", "diverged", "interrupted". `cause`: why it diverged. `final` holds
    every channel at the last instant, with or without a log.
    """

    scenario: LoadedScenario
    table: ChannelTable
    rows: LoggedRows = field(repr=False)
    events: tuple[Event, ...]
    metrics: dict[str, float]
    metric_times_s: dict[str, float]
    verdicts: tuple[Verdict, ...]
    section_extremes: tuple[SectionExtreme, ...]
    failures: tuple[str, ...]  # what went wrong and when: control lost, diverged, above the wind profile
    outcome: str
    cause: str
    end_s: float
    end_ns: int
    steps: int
    state: Array = field(repr=False)
    final: dict[str, float] = field(repr=False)
    state_hash: str
    wall_s: float

    def __getitem__(self, channel: str) -> Array:
        """Values of a channel; KeyError for an unknown name or a flight that was flown without a log."""
        return self._rows(channel)[1][:, self.table.index(channel)]

    def time_s(self, channel: str) -> Array:
        """Times of a channel's values, s."""
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
        """Requirements and metrics, for notebooks."""
        rows = [
            (v.name, "met" if v.met else "MISSED", figures(v.value, 4 if v.met else 7), v.wanted) for v in self.verdicts
        ]
        for name in self.telling_metrics:
            rows.append((title_of(name), "", figures(self.metrics[name]), unit_of(name).removeprefix("1")))
        return html_table(repr(self).strip("<>"), ("", "", "value", "limit or unit"), rows)

    @property
    def telling_metrics(self) -> tuple[str, ...]:
        """Names of those that say something of this flight: none of what it does not have, none of an orbit that ends
        below the ground, no apogee ahead where it has ended by impact.
        """
        orbits = self.metrics["perigee_altitude_m"] >= 0.0
        return tuple(
            name
            for name, value in self.metrics.items()
            if not math.isnan(value)
            and (orbits or not name.startswith(("orbit_", "perigee_")))
            and (name != "apogee_altitude_m" or self.outcome != "impact")
        )

    def event_s(self, name: str) -> float:
        """Time of an event, the last one of several stages; nan if it has not happened."""
        return max((e.time_s for e in self.events if e.name == name), default=math.nan)

    @property
    def beyond_model(self) -> tuple[str, ...]:
        """Return a line for each departure of the flight from the limits of its model, such as breaking waves, with its
        first time.
        """
        return tuple(
            f"wave breaks at {e.time_s:.3f} s in {e.detail.split(':')[0]}"
            for e in self.events
            if e.name == WAVE_BREAKING_NAME
        )

    @property
    def passed(self) -> bool:
        """Flown to its end without a failure, all requirements met."""
        return self.outcome != "interrupted" and not self.failures and all(v.met for v in self.verdicts)


def copied(rows: LoggedRows) -> LoggedRows:
    """Rows that the next segment does not overwrite."""
    return {group: (times.copy(), values.copy()) for group, (times, values) in rows.items()}


class GrowingRows:
    """Rows of all segments so far, in arrays larger than needed: a long log is never in memory twice.

    What is not used of them takes address space only.
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
