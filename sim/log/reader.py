"""Reads the log of a flight back into arrays, also when the file is cut off or damaged."""

from __future__ import annotations

import difflib
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from mcap import records
from mcap.opcode import Opcode

from maxq.control.kernel.records import Array, IntArray
from maxq.sim.flight.channels import EVENTS_TOPIC, FRAMES_TOPIC, Channel, ChannelTable
from maxq.sim.log.foxglove import Event, decode_event
from maxq.sim.log.head import (
    COMPLETE,
    CRC_KEY,
    END_METADATA,
    HEAD_METADATA,
    NAMES_OF_SCHEMA_1,
    PROFILE,
    REASON_KEY,
    RUN_METADATA,
    SCHEMA_KEY,
    SCHEMA_VERSION,
    STATUS_KEY,
    VERSION_KEY,
    Attachment,
    LogError,
)
from maxq.sim.log.mcap_read import (
    MAGIC,
    DamagedError,
    Frame,
    chunk_content,
    chunk_frames,
    frames,
    gather,
    message_dtype,
    message_runs,
    parse,
    payloads,
    summary_frames,
)
from maxq.sim.log.protobuf import doubles_template, get_values, topic_from

_HEAD_OPCODES = (Opcode.HEADER, Opcode.SCHEMA, Opcode.CHANNEL, Opcode.ATTACHMENT, Opcode.METADATA)


@dataclass(frozen=True)
class LoggedRun:
    """What a log says about its run besides the flight itself.

    `end`: status, reason and result of the run (see `LogWriter.close`); empty where the file was cut off.
    """

    path: Path
    metadata: Mapping[str, str]
    attachments: Mapping[str, Attachment]
    end: Mapping[str, str]


@dataclass(frozen=True)
class Log(LoggedRun):
    """The log of one flight.

    `log["alpha_deg"]` is a channel's values (n,), `log.time_s("alpha_deg")` their times. `complete` is
    False where the run or the file ended early or something in it is damaged; `notes` then say what, one
    sentence each.
    """

    table: ChannelTable
    events: tuple[Event, ...]
    complete: bool
    notes: tuple[str, ...]
    _times_ns: Mapping[str, IntArray]
    _values: Mapping[str, Mapping[str, Array]]

    def __getitem__(self, name: str) -> Array:
        """Values (n,) of a channel; KeyError, with names that come close, if there is none."""
        return self._values[self._topic(name)][name]

    def __contains__(self, name: str) -> bool:
        return name in self.table

    def channel(self, name: str) -> Channel:
        """Unit, frame and description of a channel; KeyError as above."""
        self._topic(name)
        return self.table.channel(name)

    def time_ns(self, name: str) -> IntArray:
        """Times (n,) of a channel or topic, in ns since the start of the simulation; KeyError as above."""
        return self._times_ns[self._topic(name)]

    def time_s(self, name: str) -> Array:
        """Times (n,) of a channel or topic, in s since the start of the simulation; KeyError as above."""
        return self.time_ns(name) / 1e9

    def topic(self, name: str) -> Mapping[str, Array]:
        """All channels of a topic by name; KeyError as above."""
        return self._values[self._topic(name)]

    def _topic(self, name: str) -> str:
        """Name of the topic of this name, or of the topic that holds the channel of this name."""
        if name in self._times_ns:
            return name
        if name in self.table:
            return self.table.topic(name).name
        close = difflib.get_close_matches(name, [*self.table.names, *self._times_ns])
        hint = f"; close names: {', '.join(close)}" if close else ""
        raise KeyError(f"{self.path} has no channel {name}{hint}")


class _Head(NamedTuple):
    """`end`: offset behind the head. `intact`: its checksum matches."""

    metadata: dict[str, str]
    attachments: dict[str, Attachment]
    table: ChannelTable
    topic_ids: dict[int, str]  # MCAP channel id -> topic, /events and /tf included
    end: int
    intact: bool


class _Places(NamedTuple):
    """Where the chunks are, the record of the run's end where there is one, and notes on damage."""

    chunks: list[Frame]
    end_record: dict[str, str] | None
    notes: list[str]


def read_log(path: str | Path) -> Log:
    """Read a log whole. All chunks that are whole are read, wherever the file is cut or damaged.

    Raises LogError where the file cannot be read, is not a log of maxq, was written by a later maxq, or is
    damaged or cut within its head, so that its content is unknown.
    """
    path = Path(path)
    data, head, places = _read_frame(path)
    notes = places.notes
    try:
        columns = _Columns(head)
    except ValueError as error:
        raise LogError(f"{path}: {error}") from error
    if not head.intact:
        notes.insert(0, "the head is damaged: scenario, metadata and names may be wrong")

    events: list[Event] = []
    for number, frame in enumerate(places.chunks, start=1):
        try:
            events += columns.add_chunk(chunk_content(data, frame))
        except ValueError as error:
            notes.append(f"chunk {number} of {len(places.chunks)} was left out: {error}")
    del data
    times_ns, values = columns.arrays()

    end = places.end_record or {}
    if end.get(STATUS_KEY) != COMPLETE and end:
        notes.append(f"the run was aborted: {end.get(REASON_KEY, 'no reason given')}")
    return Log(
        path, head.metadata, head.attachments, end, head.table, tuple(events), not notes, tuple(notes), times_ns, values
    )


def read_run(path: str | Path) -> LoggedRun:
    """What a log says about its run, without reading the flight. Raises LogError as `read_log` does, and
    where the head is damaged.
    """
    path = Path(path)
    _, head, places = _read_frame(path)
    if not head.intact:
        raise LogError(f"{path}: the head of the log is damaged: the scenario in it may be wrong")
    return LoggedRun(path, head.metadata, head.attachments, places.end_record or {})


def _read_frame(path: Path) -> tuple[bytes, _Head, _Places]:
    """The bytes of a log, its head, and where its chunks are. Raises LogError."""
    try:
        data = path.read_bytes()
    except OSError as error:
        raise LogError(f"{path}: the log cannot be read: {error.strerror or error}") from error
    except ValueError as error:  # a NUL character in the name
        raise LogError(f"{path}: this is not a file name") from error
    try:
        head = _read_head(data)
        return data, head, _find_chunks(data, head.end)
    except ValueError as error:
        raise LogError(f"{path}: {error}") from error


def _read_head(data: bytes) -> _Head:
    """Raises ValueError, with a message to follow the file's name, where the head cannot be read."""
    if not data.startswith(MAGIC):
        raise ValueError("this is not a log: it does not begin like an MCAP file")
    metadata: dict[str, dict[str, str]] = {}
    attachments: dict[str, Attachment] = {}
    schemas: dict[int, records.Schema] = {}
    channels: list[records.Channel] = []
    end, intact = 0, False
    for frame in frames(data, len(MAGIC), len(data)):
        if frame.opcode not in _HEAD_OPCODES:
            break
        try:
            if frame.start == len(MAGIC):
                _check_header(data, frame)
            elif frame.opcode == Opcode.SCHEMA:
                schema = parse(records.Schema.read, data, frame)
                schemas[schema.id] = schema
            elif frame.opcode == Opcode.CHANNEL:
                channels.append(parse(records.Channel.read, data, frame))
            elif frame.opcode == Opcode.ATTACHMENT:
                file = parse(records.Attachment.read, data, frame)
                attachments[file.name] = Attachment(file.name, file.media_type, file.data)
            elif frame.opcode == Opcode.METADATA:
                record = parse(records.Metadata.read, data, frame)
                metadata[record.name] = record.metadata
                if record.name == HEAD_METADATA:
                    end = frame.end
                    intact = record.metadata.get(CRC_KEY) == f"{zlib.crc32(data[: frame.start]):08x}"
                    break
        except DamagedError as error:
            raise ValueError(f"the head of the log is damaged: {error}") from error
    run = metadata.get(RUN_METADATA, {})
    schema = run.get(SCHEMA_KEY, SCHEMA_VERSION)
    if schema not in ("1", SCHEMA_VERSION):
        raise ValueError(
            f"this log has schema {schema}, written by maxq {run.get(VERSION_KEY, '(unknown)')}; "
            f"this maxq reads schemas up to {SCHEMA_VERSION}"
        )
    renamed = NAMES_OF_SCHEMA_1 if schema == "1" else {}
    if not end:
        raise ValueError("the log is cut off or damaged within its head: nothing of the flight can be read")
    try:
        topics = {
            c.id: topic_from(c.topic, schemas[c.schema_id].data, c.metadata, renamed)
            for c in channels
            if c.topic not in (EVENTS_TOPIC, FRAMES_TOPIC)
        }
        table = ChannelTable(tuple(topics.values()))
    except (ValueError, KeyError) as error:
        raise ValueError(f"the head of the log is damaged: {error}") from error
    return _Head(run, attachments, table, {c.id: c.topic for c in channels}, end, intact)


def _check_header(data: bytes, frame: Frame) -> None:
    header = parse(records.Header.read, data, frame) if frame.opcode == Opcode.HEADER else None
    if header is None or header.profile != PROFILE:
        by = f" (written by {header.library})" if header is not None and header.library else ""
        raise ValueError(f"this is an MCAP file, but not a log of maxq{by}")


def _find_chunks(data: bytes, start: int) -> _Places:
    """All whole chunks: by the index at the end of the file, or record by record where there is none."""
    try:
        summary = summary_frames(data)
        if summary is not None:
            return _Places(chunk_frames(data, summary), *_read_end(data, summary))
    except DamagedError:
        pass  # the summary passes its checksum but is not one that maxq wrote: ignore it
    chunks, last = [], start
    for frame in frames(data, start, len(data)):
        if frame.opcode == Opcode.DATA_END:
            break
        if frame.opcode == Opcode.CHUNK:
            chunks.append(frame)
        last = frame.end
    note = f"the end of the log is missing or damaged: read up to byte {last} of {len(data)}"
    return _Places(chunks, None, [note])


def _read_end(data: bytes, summary: list[Frame]) -> tuple[dict[str, str] | None, list[str]]:
    """The record that says how the run ended, and notes about it."""
    for entry in summary:
        if entry.opcode != Opcode.METADATA_INDEX:
            continue
        index = parse(records.MetadataIndex.read, data, entry)
        if index.name != END_METADATA:
            continue
        place = next(frames(data, index.offset, min(index.offset + index.length, len(data))), None)
        try:
            if place is not None and place.opcode == Opcode.METADATA:
                return parse(records.Metadata.read, data, place).metadata, []
        except DamagedError:
            break
    return None, ["the record of how the run ended is missing or damaged"]


class _Columns:
    """Collects the messages of each topic chunk by chunk."""

    def __init__(self, head: _Head) -> None:
        self._topics = {topic.name: topic for topic in head.table.topics}
        self._topic_ids = head.topic_ids
        self._layouts = {
            topic.name: message_dtype(doubles_template(len(topic.channels)).dtype) for topic in head.table.topics
        }
        self._parts: dict[str, list[tuple[IntArray, Array]]] = {name: [] for name in self._topics}

    def add_chunk(self, content: bytes) -> list[Event]:
        """Add a chunk, whole or not at all; returns its events. Raises ValueError where it is damaged.

        Its numbers are copied at once, while they are in the cache: nothing keeps a reference to `content`.
        """
        events: list[Event] = []
        parts = []
        for channel_id, runs in message_runs(content).items():
            topic = self._topic_ids.get(channel_id)
            if topic is None:
                raise DamagedError("it has messages of an unknown channel")
            if topic == EVENTS_TOPIC:
                events += [decode_event(payload) for payload in payloads(content, runs)]
            elif topic in self._layouts:
                messages = gather(content, runs, self._layouts[topic])
                values = np.empty((len(self._topics[topic].channels), len(messages)))
                get_values(messages["payload"], values)
                parts.append((topic, messages["log_time"].astype(np.int64), values))
        for topic, times_ns, values in parts:
            self._parts[topic].append((times_ns, values))
        return events

    def arrays(self) -> tuple[dict[str, IntArray], dict[str, dict[str, Array]]]:
        """Times (n,) by topic, and values (n,) by topic and channel, each contiguous."""
        times_ns: dict[str, IntArray] = {}
        values: dict[str, dict[str, Array]] = {}
        for name, topic in self._topics.items():
            parts = self._parts.pop(name)
            times_ns[name] = np.concatenate([np.zeros(0, np.int64), *(times for times, _ in parts)])
            matrix = np.concatenate([np.empty((len(topic.channels), 0)), *(rows for _, rows in parts)], axis=1)
            values[name] = {channel.name: matrix[i] for i, channel in enumerate(topic.channels)}
        return times_ns, values
