"""The channel table: name, unit, frame, topic and rate of each logged number.

Channels are declared by the NamedTuples that kernels fill (control/kernel/rows.py). The columns of the kernels' rows,
protobuf schemas, plots and docs/telemetry.md all follow from one `ChannelTable`.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from functools import cached_property
from typing import get_args, get_type_hints

EVENTS_TOPIC = "/events"
FRAMES_TOPIC = "/tf"

_CHANNEL_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_]*")
_FRAMES = ("I", "E", "N", "B")
_TOPIC_NAME = re.compile(r"(/[a-z][a-z0-9_]*)+")


def unit_suffix(unit: str) -> str:
    """Return the suffix of a name for a unit: `rad/s` -> `radps`, `m/s^2` -> `mps2`, `1/s` -> `ps`, `1` -> ``."""
    per = unit.removeprefix("1").replace("/", "p").replace("%", "pct")
    return re.sub(r"[^A-Za-z0-9]", "", per)


@dataclass(frozen=True)
class Channel:
    """A logged number.

    `name` ends with the suffix of `unit` (see `unit_suffix`; upper or lower case) unless `unit` is "1". It contains
    `frame` as one of its parts unless `frame` is "": `w_BI_B_y_radps` has the unit rad/s and the frame B. The name is
    also that of a protobuf field. Raises ValueError for a name that breaks these rules.
    """

    name: str
    unit: str
    frame: str
    description: str

    def __post_init__(self) -> None:
        if not _CHANNEL_NAME.fullmatch(self.name):
            raise ValueError(f"channel {self.name!r}: a name is made of letters, digits and underscores")
        if not self.unit:
            raise ValueError(f"channel {self.name}: the unit is missing ('1' for none)")
        suffix = unit_suffix(self.unit)
        if suffix and not self.name.lower().endswith("_" + suffix.lower()):
            raise ValueError(f"channel {self.name}: unit {self.unit} asks for a name that ends with _{suffix}")
        if self.frame and self.frame not in self.name.split("_"):
            raise ValueError(f"channel {self.name}: frame {self.frame} is not a part of the name")


def declared_channels(row: type, part: str = "", label: str = "", suffix: str = "") -> tuple[Channel, ...]:
    """Return the channels that a NamedTuple declares (control/kernel/rows.py), in the order of writing.

    For parts of which a vehicle has several, `label` replaces the word `part` in the names (`eta_mode_m` ->
    `eta_pitch_1_m`), and `suffix` ends the descriptions.
    """
    channels: list[Channel] = []
    for name, hint in get_type_hints(row, include_extras=True).items():
        if not get_args(hint):  # a row in this row
            channels += declared_channels(hint, part, label, suffix)
            continue
        kind, unit, description = get_args(hint)
        for axis in getattr(kind, "_fields", ("",)):
            words = [{part: label, "axis": axis}.get(word, word) for word in name.split("_")]
            text = ", ".join(filter(None, (description, axis, suffix)))
            without_unit = words[:-1] if unit_suffix(unit) else words
            frame = next((word for word in without_unit if word in _FRAMES), "")
            channels.append(Channel("_".join(words), unit, frame, text))
    return tuple(channels)


@dataclass(frozen=True)
class Topic:
    """The channels that are logged in one message.

    `name` has the form `/truth`. `group` is the rate group, which has the times of the messages ("fast", "slow", ...).
    Raises ValueError for an invalid name, for a topic without channels, and for the topics that every log contains.
    """

    name: str
    group: str
    channels: tuple[Channel, ...]
    description: str = ""

    def __post_init__(self) -> None:
        if not _TOPIC_NAME.fullmatch(self.name):
            raise ValueError(f"topic {self.name!r}: a name looks like /truth or /truth/bending")
        if self.name in (EVENTS_TOPIC, FRAMES_TOPIC):
            raise ValueError(f"topic {self.name} is the log's own")
        if not self.group:
            raise ValueError(f"topic {self.name}: the rate group is missing")
        if not self.channels:
            raise ValueError(f"topic {self.name} has no channels")

    @property
    def message_name(self) -> str:
        """Return the name of the protobuf message: `/truth/bending_modes` -> `TruthBendingModes`."""
        return "".join(word.capitalize() for word in re.split("[/_]", self.name))


def declared_topics(group: str, rows: type) -> list[Topic]:
    """Return the topics of a NamedTuple whose fields are rows: `air: Annotated[AirRow, "air data"]` -> `/air`."""
    topics = []
    for name, hint in get_type_hints(rows, include_extras=True).items():
        row, description = get_args(hint)
        topics.append(Topic(f"/{name}", group, declared_channels(row), description))
    return topics


@dataclass(frozen=True)
class ChannelTable:
    """All topics of a log, in order.

    The columns of a rate group are the channels of its topics, in the order of the table. Raises ValueError if the name
    of a topic, a message or a channel occurs twice.
    """

    topics: tuple[Topic, ...]

    def __post_init__(self) -> None:
        _refuse_twice("topic", [topic.name for topic in self.topics])
        _refuse_twice("protobuf message", [topic.message_name for topic in self.topics])
        _refuse_twice("channel", [channel.name for topic in self.topics for channel in topic.channels])

    @property
    def groups(self) -> tuple[str, ...]:
        """Return the rate groups in order of first use."""
        return tuple(self._columns)

    def columns(self, group: str) -> tuple[Channel, ...]:
        """Return the channels of a rate group in the order of its columns; none for an unknown group."""
        return self._columns.get(group, ())

    @property
    def names(self) -> tuple[str, ...]:
        """Return the names of all channels, topic by topic."""
        return tuple(self._places)

    def __contains__(self, name: str) -> bool:
        return name in self._places

    def channel(self, name: str) -> Channel:
        """Return the channel of that name. Raises KeyError if there is none."""
        return self._places[name][2]

    def topic(self, name: str) -> Topic:
        """Return the topic that contains the channel of that name. Raises KeyError if there is none."""
        return self._places[name][0]

    def index(self, name: str) -> int:
        """Return the column of a channel within its rate group. Raises KeyError if there is no such channel."""
        return self._places[name][1]

    @cached_property
    def _columns(self) -> dict[str, tuple[Channel, ...]]:
        columns: dict[str, tuple[Channel, ...]] = {}
        for topic in self.topics:
            columns[topic.group] = columns.get(topic.group, ()) + topic.channels
        return columns

    @cached_property
    def _places(self) -> dict[str, tuple[Topic, int, Channel]]:
        """Return topic, column within the rate group, and channel, by name of the channel."""
        column = {channel.name: i for channels in self._columns.values() for i, channel in enumerate(channels)}
        return {c.name: (topic, column[c.name], c) for topic in self.topics for c in topic.channels}


def _refuse_twice(what: str, names: list[str]) -> None:
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise ValueError(f"{what} named twice: {', '.join(twice)}")
