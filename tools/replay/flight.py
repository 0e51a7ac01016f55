"""The flights to be shown: their logs, the scenario in each log, and the end of each flight.

A truncated or damaged log is shown up to its last readable row. If its scenario cannot be read (it is from an older or
a later maxq), numbers and trajectory are still shown, but neither vehicle nor limits. The numbers of many flights
exceed the memory, so those of the last few are kept and others are read again.
"""

from __future__ import annotations

import functools
import json
import math
import re
import shlex
import tomllib
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from maxq.control.kernel.records import Array, IntArray
from maxq.sim.flight.channels import ChannelTable
from maxq.sim.flight.metric_table import unit_of
from maxq.sim.input.errors import ScenarioError
from maxq.sim.log.head import LogError
from maxq.sim.log.messages import FramePath, Level
from maxq.sim.log.reader import Log, read_log
from maxq.sim.packing.environment import pack_earth
from maxq.sim.run import launch_frames
from maxq.sim.run.launch_frames import ENU_NED, LaunchFrames, plain
from maxq.sim.run.quantities import against_limit, by_utilisation, utilisation
from maxq.sim.run.record import LOG_NAME, SCENARIO_ATTACHMENT, SUMMARY_NAME
from maxq.sim.scenario.loader import load_scenario_text
from maxq.sim.scenario.schema_environment import EarthSection, Site
from maxq.sim.scenario.schema_scenario import Scenario
from maxq.sim.world.earth import FLAT, ned_to_earth
from maxq.tools.replay.viewer import ReplayError

KEPT = ("flights", "kept")  # folders of a campaign that contain whole flights
MOST = 200
"""The largest number of flights shown at once. More would be illegible in one window, and need much memory."""
FEW = 4
"""The largest number of flights whose vehicles are all drawn."""
FAR_KM = 20.0
"""The distance from the site beyond which the start of a flight is the origin of its axes."""
ConversionWatch = Callable[[str, int, int], None]
"""A function that receives the name of the activity, the steps done, and their number."""
_FAULTS = ("control_lost", "diverged")
_NEEDED = tuple(f"r_E_{a}_m" for a in "xyz") + tuple(f"q_BI_{c}" for c in "wxyz")


class Channels(Protocol):
    """The columns of a flight by channel name: those of a log, or of a block of a running flight."""

    @property
    def table(self) -> ChannelTable: ...
    def __contains__(self, name: str) -> bool: ...
    def __getitem__(self, name: str) -> Array: ...
    def time_ns(self, name: str) -> IntArray: ...


@dataclass(frozen=True)
class Moment:
    """An event of a flight. `name` is the name in the log, and `text` is for readers."""

    name: str
    time_ns: int
    text: str
    level: Level = Level.INFO

    @property
    def time_s(self) -> float:
        return self.time_ns / 1e9

    @property
    def label(self) -> str:
        """Return the name and the time, for a picture."""
        return f"{self.name.replace('_', ' ')} {self.time_s:.1f} s"

    @property
    def line(self) -> str:
        """Return the time and the text, for a list."""
        return f"{self.time_s:9.3f} s  {self.text}"


@dataclass(frozen=True)
class ShownRequirement:
    """A requirement of a scenario. `kind` is "limit" or "minimum". `value` and `met` are None without a summary."""

    name: str
    kind: str
    bound: float
    unit: str
    value: float | None
    met: bool | None

    @property
    def utilisation(self) -> float:
        """Return the utilisation of the limit as a share, or NaN without a value."""
        return math.nan if self.value is None else utilisation(self.value, self.kind, self.bound)

    @property
    def shown(self) -> tuple[str, str, str]:
        """Return the value, the limit and their engineering unit as texts."""
        return against_limit(math.nan if self.value is None else self.value, self.kind, self.bound, self.unit)


def tightest_first(requirements: Iterable[ShownRequirement]) -> list[ShownRequirement]:
    """Return the missed requirements, then the others, each in decreasing order of utilisation."""
    return sorted(requirements, key=lambda r: by_utilisation(r.met is not False, r.utilisation))


@dataclass(frozen=True)
class ReplayFlight:
    """A flight to be shown.

    `label` names the flight. `moments` are its events in order, with max q derived from the channels if the log has no
    such event. `span_s` contains its first and last time. `damage` contains a sentence on each missing part of the log.
    """

    path: Path
    label: str
    read: Callable[[Path], Log] = field(repr=False)
    end: Mapping[str, str]
    moments: tuple[Moment, ...]
    span_s: tuple[float, float]
    damage: tuple[str, ...]
    summary: Mapping[str, Any] = field(repr=False)

    @property
    def log(self) -> Log:
        return self.read(self.path)

    @property
    def scenario(self) -> Scenario | None:
        return self._scenario_and_complaint[0]

    @property
    def notes(self) -> tuple[str, ...]:
        """Return a sentence on each part of the flight that cannot be shown."""
        return (*self.damage, *self._scenario_and_complaint[1])

    @cached_property
    def _scenario_and_complaint(self) -> tuple[Scenario | None, tuple[str, ...]]:
        text = _scenario_text(self.log)
        if text is None:
            return None, ("the log holds no scenario: neither vehicle nor limits are shown",)
        try:
            return load_scenario_text(text, label="the scenario in the log").scenario, ()
        except ScenarioError as error:
            return None, (f"neither vehicle nor limits are shown: {error}",)

    @property
    def outcome(self) -> str:
        """Return the outcome of the flight (`Flight.outcome`), or "cut off" if the log does not contain it."""
        return self.end.get("outcome", "cut off")

    @cached_property
    def verdict(self) -> str:
        """Return `passed` or `failed`, or `unknown` if there is neither a summary next to the log nor a fault in it."""
        if isinstance(self.summary.get("passed"), bool):
            return "passed" if self.summary["passed"] else "failed"
        return "failed" if any(self.moment(name) for name in _FAULTS) else "unknown"

    @property
    def is_nominal(self) -> bool:
        """Return True for the undispersed flight that a campaign stores with the others."""
        return "nominal" in self.label.lower().split("/")[-1]

    @property
    def burn_end_s(self) -> float:
        """Return the time of the last burnout, or the end of the log if there is none."""
        moment = self.moment("burnout")
        return moment.time_s if moment is not None else self.span_s[1]

    def moment(self, name: str) -> Moment | None:
        """Return the last event of that name, or None."""
        return next((m for m in reversed(self.moments) if m.name == name), None)

    @cached_property
    def requirements(self) -> tuple[ShownRequirement, ...]:
        """Return the requirements of the scenario, with the values in the summary next to the log."""
        judged = {(r.get("name"), r.get("metric")): r for r in self.summary.get("requirements", [])}
        out = []
        for r in self.scenario.requirement if self.scenario is not None else ():
            name = r.name or r.metric
            about = judged.get((name, r.metric), {})
            out.append(ShownRequirement(name, *r.bound, unit_of(r.metric), about.get("value"), about.get("met")))
        return tuple(out)


def open_flight(path: Path, label: str = "", read: Callable[[Path], Log] | None = None) -> ReplayFlight:
    """Read a log and the summary next to it. Raises ReplayError if no part of the log can be shown."""
    read = read or _keeping(None)
    log = read(path)
    times = [log.time_ns(topic.name) for topic in log.table.topics]
    ends = [(int(t[0]), int(t[-1])) for t in times if len(t)]
    if not ends:
        raise ReplayError(f"{path}: the log holds no samples: there is nothing to show")
    span_s = min(a for a, _ in ends) / 1e9, max(b for _, b in ends) / 1e9
    name = label or log.metadata.get("scenario") or path.stem
    return ReplayFlight(path, name, read, log.end, _moments(log), span_s, log.notes, _summary(log))


def _keeping(most: int | None) -> Callable[[Path], Log]:
    """Return a function that reads logs and keeps the `most` recently used logs in memory (None: all).

    The function raises ReplayError for a log that cannot be read.
    """

    @functools.lru_cache(most)
    def read(path: Path) -> Log:
        try:
            return read_log(path)
        except LogError as error:
            raise ReplayError(str(error)) from error

    return read


def _moments(log: Log) -> tuple[Moment, ...]:
    found = [Moment(e.text.split(" ")[0].split(":")[0], e.time_ns, e.text, e.level) for e in log.events]
    if not any(m.name == "max_q" for m in found) and (largest := _largest_pressure(log)) is not None:
        found.append(largest)
    return tuple(sorted(found, key=lambda moment: moment.time_ns))


def _largest_pressure(log: Channels) -> Moment | None:
    """Return the largest dynamic pressure under thrust (max q), or None if it is below 1 kPa or unknown."""
    if "dynamic_pressure_Pa" not in log or "thrust_N" not in log:
        return None
    pressure, burning = log["dynamic_pressure_Pa"], log["thrust_N"] > 0.0
    if len(pressure) != len(burning):
        return None
    powered = np.where(burning & np.isfinite(pressure), pressure, 0.0)
    if powered.max(initial=0.0) < 1000.0:
        return None
    k = int(np.argmax(powered))
    mach = f", Mach {log['mach'][k]:.2f}" if "mach" in log else ""
    text = f"max q {powered[k] / 1000.0:.1f} kPa{mach}"
    return Moment("max_q", int(log.time_ns("dynamic_pressure_Pa")[k]), text)


def _scenario_text(log: Log) -> str | None:
    attachment = log.attachments.get(SCENARIO_ATTACHMENT)
    return attachment.data.decode(errors="replace") if attachment is not None else None


def launch_of(log: Log) -> tuple[EarthSection, Site]:
    """Return the Earth and the launch site of a log.

    Only two tables of the scenario are read, since reading the whole scenario takes a tenth of a second. If they cannot
    be read, the Earth is WGS 84, and the site comes from the metadata of the log.
    """
    tables = re.findall(r"^\[(?:earth|site)\]\n(?:[^\[\n].*\n|\n)*", _scenario_text(log) or "", re.MULTILINE)
    try:
        found = tomllib.loads("".join(tables))
        if "site" in found:
            return EarthSection.model_validate(found.get("earth", {})), Site.model_validate(found["site"])
    except ValueError:  # raised by TOML or by the schema
        pass
    data = log.metadata
    site = Site.model_construct(
        latitude_deg=float(data.get("site_latitude_deg", "0")),
        longitude_deg=float(data.get("site_longitude_deg", "0")),
        altitude_m=float(data.get("site_altitude_m", "0")),
        azimuth_deg=float(data.get("azimuth_deg", "90")),
    )
    return EarthSection(), site


def _summary(log: Log) -> Mapping[str, Any]:
    """Return the summary next to the log, or an empty mapping if it does not belong to the same flight."""
    try:
        summary = json.loads(log.path.with_name(SUMMARY_NAME).read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return {}
    if not isinstance(summary, dict) or summary.get("state_hash") != log.end.get("state_hash", ""):
        return {}
    judged = summary.get("requirements")  # the file may be from any author
    whole = isinstance(judged, list) and all(isinstance(r, dict) for r in judged)
    return summary if whole else summary | {"requirements": []}


# -- finding logs ---------------------------------------------------------------------------------------------------
def find_logs(places: Sequence[str]) -> list[tuple[Path, str]]:
    """Return the paths of the logs at the given places, with labels. Raises ReplayError for a place without logs."""
    found: list[tuple[Path, str]] = []
    for place in places:
        path = Path(place)
        if not path.exists():
            raise ReplayError(f"{place}: no such file or folder")
        inside = _in_folder(path) if path.is_dir() else [(path, "")]
        if not inside:
            from maxq.sim.campaign.store import MANIFEST  # noqa: PLC0415  # lazy: loads pyarrow

            where = f"{LOG_NAME}, {KEPT[0]}/run-.../{LOG_NAME}, or any .mcap"
            if (path / MANIFEST).is_file():
                how = f"simrun report {shlex.quote(place)} --keep worst:5"
                raise ReplayError(f"{place}: this campaign has kept no logs; {how} keeps those of the worst flights")
            raise ReplayError(f"{place}: no flight in this folder ({where})")
        found += inside
    unlike = {path.resolve(): (path, label) for path, label in reversed(found)}
    return list(reversed(unlike.values()))


def _in_folder(folder: Path) -> list[tuple[Path, str]]:
    """Return the logs in a folder with their labels: the nominal flight first, the others in the order of their
    names.
    """
    alone = folder / LOG_NAME
    kept = sorted(path for name in KEPT for path in (folder / name).glob(f"*/{LOG_NAME}"))
    if alone.is_file() and not kept:
        return [(alone, "")]
    logs = [*([alone] if alone.is_file() else []), *kept]
    if not kept:
        logs += sorted(folder.glob(f"*/{LOG_NAME}")) + sorted(p for p in folder.glob("*.mcap") if p != alone)
    labels = [p.parent.name if p.name == LOG_NAME and p != alone else p.stem for p in logs]
    named = [(path, "nominal" if path == alone else label) for path, label in zip(logs, labels, strict=True)]
    return sorted(named, key=lambda pair: "nominal" not in pair[1])


def open_flights(
    places: Sequence[str], *, in_turn: bool = False, watch: ConversionWatch = lambda *_: None
) -> tuple[list[ReplayFlight], list[str]]:
    """Return all readable flights, and a message on each flight that cannot be read completely.

    Set `in_turn` if the caller processes the flights one after the other: then, only the data of a few flights are kept
    in memory. Raises ReplayError if no flight can be read.
    """
    logs = find_logs(places)
    flights: list[ReplayFlight] = []
    complaints: list[str] = []
    if len(logs) > MOST:
        complaints.append(f"{len(logs)} flights are too many to look at: the first {MOST} are shown")
        logs = logs[:MOST]
    read = _keeping(FEW if in_turn else None)
    for k, (path, label) in enumerate(logs):
        watch("reading", k, len(logs))
        try:
            flights.append(open_flight(path, label, read))
        except ReplayError as error:
            complaints.append(str(error))
    if not flights:
        raise ReplayError("; ".join(complaints))
    flights = _unlike_labels(flights)
    near = closest(flights)
    for i, flight in enumerate(flights):
        complaints += [f"{flight.path}: {note}" for note in (flight.notes if i in near else flight.damage)]
    return flights, complaints


def closest(flights: Sequence[ReplayFlight]) -> set[int]:
    """Return the indices of the flights whose vehicle and limits are drawn.

    The nominal flight is first in order, then failed flights, then the others.
    """

    def rank(i: int) -> tuple[bool, bool, int]:
        return not flights[i].is_nominal, flights[i].verdict != "failed", i

    return set(sorted(range(len(flights)), key=rank)[:FEW])


def _unlike_labels(flights: Sequence[ReplayFlight]) -> list[ReplayFlight]:
    """Return the flights with distinct labels.

    Equal labels are replaced by the name of the folder or, if these are equal too, completed by the path and a number.
    """
    count = Counter(flight.label for flight in flights)
    folders = Counter(flight.path.resolve().parent.name for flight in flights)
    seen: Counter[str] = Counter()
    out = []
    for flight in flights:
        label, folder = flight.label, flight.path.resolve().parent.name
        if count[label] > 1:
            label = folder if folder and folders[folder] == 1 else f"{label}, {flight.path}"
        seen[label] += 1
        out.append(replace(flight, label=label if seen[label] == 1 else f"{label} ({seen[label]})"))
    return out


# -- the frame of the launch site: x east, y north, z up (the log's `launch_site`) -----------------------------------
class ShownLaunchSite(launch_frames.LaunchSite):
    """The frame of the launch site. If `moved` is True, its origin is the start of the flight instead of the site."""

    moved = False

    def frames(self, table: ChannelTable, period_ns: int) -> LaunchFrames:
        return LaunchFrames(table, self, period_ns)

    def from_ned(self, latitude_deg: Array, longitude_deg: Array, v_N: Array) -> Array:
        """Return vectors in the axes of the site, (n, 3), from their components north, east, down at places (n,)."""
        if self.earth.figure == FLAT:
            return np.asarray(v_N @ ENU_NED.T)
        lat, lon = np.radians(latitude_deg), np.radians(longitude_deg)
        v_E = plain(ned_to_earth)(np.sin(lat), np.cos(lat), np.sin(lon), np.cos(lon), *v_N.T)
        return np.asarray(np.stack(v_E, axis=1) @ self.enu_E.T)

    def ground(self, east_m: Array, north_m: Array) -> Array:
        """Return the points (n, 3) on the ground, at the site's altitude, below points (n,) of the horizontal plane."""
        if self.earth.figure == FLAT:
            return np.stack([east_m, north_m, np.zeros_like(east_m)], axis=1)
        flattening, a = self.earth.flattening, self.earth.equatorial_radius_m
        height = self.site.altitude_m
        semi = np.array([a + height, a + height, a * (1.0 - flattening) + height])
        on_plane = self.origin_E_m + np.stack([east_m, north_m, np.zeros_like(east_m)], 1) @ self.enu_E
        direction = -self.enu_E[2]  # vertical at the site, to the ellipsoid at the site's altitude
        p, d = on_plane / semi, direction / semi
        a2, b1, c0 = float(d @ d), p @ d, (p * p).sum(axis=1) - 1.0
        root = np.sqrt(np.maximum(b1 * b1 - a2 * c0, 0.0))
        drop = (-b1 - root) / a2
        return np.stack([east_m, north_m, -drop], axis=1)


def place_of(flight: ReplayFlight) -> ShownLaunchSite:
    """Return the frame in which a logged flight is drawn."""
    return launch_site(*launch_of(flight.log), flight.log)


def launch_site(earth: EarthSection, site: Site, channels: Channels) -> ShownLaunchSite:
    """Return the frame in which to draw a flight. It is moved if the flight, by its `channels`, starts far from the
    site.
    """
    place = ShownLaunchSite(pack_earth(earth), site)
    if place.earth.figure == FLAT or "latitude_deg" not in channels or not len(channels["latitude_deg"]):
        return place
    start = float(channels["latitude_deg"][0]), float(channels["longitude_deg"][0])
    north = start[0] - site.latitude_deg
    east = ((start[1] - site.longitude_deg + 180.0) % 360.0 - 180.0) * math.cos(math.radians(site.latitude_deg))
    if 111.0 * math.hypot(north, east) >= FAR_KM:
        moved = site.model_copy(update={"latitude_deg": start[0], "longitude_deg": start[1], "altitude_m": 0.0})
        place = ShownLaunchSite(place.earth, moved)
        place.moved = True
    return place


def path_of(channels: Channels, frames: LaunchFrames) -> FramePath:
    """Return the motion in a log or a block. `frames` selects the poses and stores the last pose."""
    table = channels.table
    times_ns = channels.time_ns(_NEEDED[0])
    rows = np.zeros((len(times_ns), len(table.columns(table.topic(_NEEDED[0]).group))))
    for name in _NEEDED:
        rows[:, table.index(name)] = channels[name]
    return frames.path(times_ns, rows)


def has_motion(channels: Channels) -> bool:
    return all(name in channels for name in _NEEDED)
