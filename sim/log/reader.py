"""Reads the log of a flight back into arrays, also when the file is cut off or damaged.

Records are parsed by the `mcap` package. Its readers stop at the first flaw of a file and give messages one by one:
finding records in a damaged file, and the messages of a chunk as arrays, is done here. Our writer lays the messages of
a topic side by side, so that a chunk is a few runs of equally long records; other tools may reorder them: a run may be
as short as one message. Format: MCAP specification, https://mcap.dev/spec.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path

import numpy as np
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.reader import make_reader
from mcap.records import Attachment as AttachmentRecord
from mcap.records import Channel as ChannelRecord
from mcap.records import Chunk, Footer, Header, McapRecord, Metadata, Schema
from mcap.stream_reader import CRCValidationError, StreamReader
from mcap.summary import Summary
from mcap.writer import MCAP0_MAGIC as MAGIC
from numpy.typing import NDArray
from zstandard import ZstdError

from maxq.control.kernel.records import Array, IntArray
from maxq.sim.flight.channels import EVENTS_TOPIC, FRAMES_TOPIC, Channel, ChannelTable, Topic
from maxq.sim.log import head as keys
from maxq.sim.log import messages as m
from maxq.sim.log.head import SCHEMA_VERSION, Attachment, LogError
from maxq.sim.log.messages import RECORD_PREFIX
from maxq.sim.log.tabular import Tabular

_HEAD_OPCODES = (Opcode.HEADER, Opcode.SCHEMA, Opcode.CHANNEL, Opcode.ATTACHMENT, Opcode.METADATA)
_RUN_PREFIX = struct.Struct("<BQH")  # the part of the header that all messages of a run share
_FIRST_BLOCK = 64  # records compared at once at first
_FOOTER_SIZE = RECORD_PREFIX.size + 20
_LAST_OPCODE = max(Opcode)
_UNREADABLE = (
    McapError,
    CRCValidationError,
    ZstdError,
    struct.error,
    UnicodeDecodeError,
    OverflowError,
    MemoryError,
    RuntimeError,  # of lz4
)
MOST_CHUNK_BYTES = 1 << 28
"""Of a chunk's content: ours hold a second of flight, a megabyte or so."""
MOST_LOG_BYTES = 1 << 34
"""Of the content of all chunks: a thousand times a flight of 400 s."""


class DamagedError(ValueError):
    """A record's bytes do not make sense."""


@dataclass(frozen=True)
class LoggedRun:
    """The information of a log about its run, apart from the flight itself.

    `end`: status, reason and result of the run (see `LogWriter.close`); empty where the file was cut off.
    """

    path: Path
    metadata: Mapping[str, str]
    attachments: Mapping[str, Attachment]
    end: Mapping[str, str]


@dataclass(frozen=True, repr=False)
class Log(LoggedRun, Tabular):
    """The log of one flight.

    `log["alpha_deg"]` is a channel's values (n,), `log.time_s("alpha_deg")` their times. `complete` is
    False where the run or the file ended early or something in it is damaged; `notes` then say what, one
    sentence each.
    """

    table: ChannelTable
    events: tuple[m.EventMessage, ...]
    complete: bool
    notes: tuple[str, ...]
    _times_ns: Mapping[str, IntArray]
    _values: Mapping[str, Mapping[str, Array]]

    def __getitem__(self, name: str) -> Array:
        """Values (n,) of a channel; KeyError, with the name that comes closest, if there is none."""
        return self._values[self._topic(name)][name]

    def __contains__(self, name: str) -> bool:
        return name in self.table

    def __repr__(self) -> str:
        end = max((float(ns[-1]) / 1e9 for ns in self._times_ns.values() if len(ns)), default=0.0)
        whole = "complete" if self.complete else f"not complete: {self.notes[0]}"
        scenario = self.metadata.get("scenario", "")
        return f"<Log {self.path}: {scenario}, {end:.3f} s, {len(self.table.names)} channels, {whole}>"

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

    def _topic(self, name: str) -> str:
        """Name of the topic of this name, or of the topic that holds the channel of this name."""
        if name in self._times_ns:
            return name
        if name in self.table:
            return self.table.topic(name).name
        raise self._unknown(name)


def read_log(path: str | Path) -> Log:
    """Read a log whole. All chunks that are whole are read, wherever the file is cut or damaged.

    Raises LogError where the file cannot be read, is not a log of maxq, was written by a later maxq, or is
    damaged or cut within its head, so that its content is unknown.
    """
    file = _LogFile(Path(path))
    if not file.intact:
        file.notes.insert(0, "the head is damaged: scenario, metadata and names may be wrong")
    events, times_ns, values = file.columns()
    if file.end and file.end.get(keys.STATUS_KEY) != keys.COMPLETE:
        file.notes.append(f"the run was aborted: {file.end.get(keys.REASON_KEY, 'no reason given')}")
    return Log(
        file.path,
        file.metadata,
        file.attachments,
        file.end,
        file.table,
        tuple(events),
        not file.notes,
        tuple(file.notes),
        times_ns,
        values,
    )


def read_run(path: str | Path) -> LoggedRun:
    """Read the information of a log about its run, without the flight. Raises LogError as `read_log` does, and if the
    head is damaged.
    """
    file = _LogFile(Path(path))
    if not file.intact:
        raise LogError(f"{path}: the head of the log is damaged: the scenario in it may be wrong")
    return LoggedRun(file.path, file.metadata, file.attachments, file.end)


class _LogFile:
    """The bytes of a log, its head, the places of its chunks, and the record of the run's end.

    `intact`: the head's checksum matches. `end` is empty where it is missing. `notes` say what is damaged.
    Raises LogError.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.notes: list[str] = []
        self.end: dict[str, str] = {}
        self.attachments: dict[str, Attachment] = {}
        try:
            self._data = path.read_bytes()
        except OSError as error:
            raise LogError(f"{path}: the log cannot be read: {error.strerror or error}") from error
        except ValueError as error:  # a NUL character in the name
            raise LogError(f"{path}: this is not a file name") from error
        try:
            head_end = self._read_head()
        except ValueError as error:
            raise LogError(f"{path}: {error}") from error
        try:
            self._chunks = self._indexed_chunks()
        except DamagedError:
            self._chunks = self._chunks_from(head_end)

    def _read_head(self) -> int:
        """Read the head; returns the offset behind it. Raises ValueError, with a message to follow the file's name."""
        data = self._data
        if not data.startswith(MAGIC):
            raise ValueError("this is not a log: it does not begin like an MCAP file")
        metadata: dict[str, dict[str, str]] = {}
        schemas: dict[int, Schema] = {}
        channels: list[ChannelRecord] = []
        end, self.intact = 0, False
        for opcode, start, stop in _frames(data, len(MAGIC)):
            if opcode not in _HEAD_OPCODES and start > len(MAGIC):
                break
            try:
                record = _parse(data, start, stop)
            except DamagedError as error:
                raise ValueError(f"the head of the log is damaged: {error}") from error
            if start == len(MAGIC) and (not isinstance(record, Header) or record.profile != keys.PROFILE):
                by = f" (written by {record.library})" if isinstance(record, Header) and record.library else ""
                raise ValueError(f"this is an MCAP file, but not a log of maxq{by}")
            if isinstance(record, Schema):
                schemas[record.id] = record
            elif isinstance(record, ChannelRecord):
                channels.append(record)
            elif isinstance(record, AttachmentRecord):
                self.attachments[record.name] = Attachment(record.name, record.media_type, record.data)
            elif isinstance(record, Metadata):
                metadata[record.name] = record.metadata
                if record.name == keys.HEAD_METADATA:
                    end, self.intact = stop, record.metadata.get(keys.CRC_KEY) == f"{zlib.crc32(data[:start]):08x}"
                    break
        self.metadata = metadata.get(keys.RUN_METADATA, {})
        schema = self.metadata.get(keys.SCHEMA_KEY, SCHEMA_VERSION)
        if schema not in ("1", SCHEMA_VERSION):
            raise ValueError(
                f"this log has schema {schema}, written by maxq {self.metadata.get(keys.VERSION_KEY, '(unknown)')}; "
                f"this maxq reads schemas up to {SCHEMA_VERSION}"
            )
        if not end:
            raise ValueError("the log is cut off or damaged within its head: nothing of the flight can be read")
        renamed = keys.NAMES_OF_SCHEMA_1 if schema == "1" else {}
        self._topics: dict[int, Topic | str] = {}  # by MCAP channel; the name only of /events and /tf
        try:
            for c in channels:
                self._topics[c.id] = c.topic
                if c.topic not in (EVENTS_TOPIC, FRAMES_TOPIC):
                    self._topics[c.id] = m.topic_from(c.topic, schemas[c.schema_id].data, c.metadata, renamed)
            topics = tuple(topic for topic in self._topics.values() if isinstance(topic, Topic))
            self.table = ChannelTable(topics)
            self._layouts = {t.name: m.message_dtype(m.doubles_template(len(t.channels)).dtype) for t in topics}
        except (ValueError, KeyError) as error:
            raise ValueError(f"the head of the log is damaged: {error}") from error
        return end

    def _indexed_chunks(self) -> list[tuple[int, int]]:
        """Start and end of all chunks by the index at the end of the file, where the record of the run's end is too.

        Raises DamagedError where the index is missing or damaged.
        """
        summary, size = _summary(self._data), len(self._data)
        places = [(i.chunk_start_offset, i.chunk_start_offset + i.chunk_length) for i in summary.chunk_indexes]
        if any(start + RECORD_PREFIX.size > end or end > size for start, end in places):
            raise DamagedError("a chunk index points outside the file")
        for index in summary.metadata_indexes:
            if index.name == keys.END_METADATA:
                try:
                    record = _parse(self._data, index.offset, index.offset + index.length)
                except DamagedError:
                    break
                self.end = record.metadata if isinstance(record, Metadata) else {}
        if not self.end:
            self.notes.append("the record of how the run ended is missing or damaged")
        return places

    def _chunks_from(self, start: int) -> list[tuple[int, int]]:
        """Start and end of the chunks that are whole, record by record from byte `start` on."""
        chunks, last = [], start
        for opcode, begin, end in _frames(self._data, start):
            if opcode == Opcode.DATA_END:
                break
            if opcode == Opcode.CHUNK:
                chunks.append((begin, end))
            last = end
        self.notes.append(f"the end of the log is missing or damaged: read up to byte {last} of {len(self._data)}")
        return chunks

    def columns(self) -> tuple[list[m.EventMessage], dict[str, IntArray], dict[str, dict[str, Array]]]:
        """Events, times (n,) by topic, and values (n,) by topic and channel, each contiguous.

        Damaged chunks are left out and noted. The numbers of a chunk are copied at once, while they are in the cache.
        """
        events: list[m.EventMessage] = []
        parts: dict[str, list[tuple[IntArray, Array]]] = {topic.name: [] for topic in self.table.topics}
        total = 0
        for number, place in enumerate(self._chunks, start=1):
            try:
                content = _chunk_content(self._data, *place)
                total += len(content)
                if total > MOST_LOG_BYTES:
                    most = f"{MOST_LOG_BYTES / 1e9:.0f} GB"
                    raise LogError(f"{self.path}: the log decompresses to more than {most}, the most that is read")
                new_events, new_parts = self._chunk_columns(content)
            except ValueError as error:
                self.notes.append(f"chunk {number} of {len(self._chunks)} was left out: {error}")
                continue
            events += new_events
            for name, part in new_parts:
                parts[name].append(part)
        self._data = b""
        times_ns: dict[str, IntArray] = {}
        values: dict[str, dict[str, Array]] = {}
        for topic in self.table.topics:
            some = parts.pop(topic.name)
            times_ns[topic.name] = np.concatenate([np.zeros(0, np.int64), *(times for times, _ in some)])
            matrix = np.concatenate([np.empty((len(topic.channels), 0)), *(rows for _, rows in some)], axis=1)
            values[topic.name] = {channel.name: matrix[i] for i, channel in enumerate(topic.channels)}
        return events, times_ns, values

    def _chunk_columns(self, content: bytes) -> tuple[list[m.EventMessage], list[tuple[str, tuple[IntArray, Array]]]]:
        """Events of a chunk, and by topic times (n,) and values (channels, n). Raises ValueError."""
        events: list[m.EventMessage] = []
        parts = []
        for channel_id, runs in _message_runs(content).items():
            topic = self._topics.get(channel_id)
            if topic is None:
                raise DamagedError("it has messages of an unknown channel")
            if topic == EVENTS_TOPIC:
                for run in runs:
                    events += [m.decode_event(content[at + m.MESSAGE_HEADER.size : at + run.step]) for at in run]
            elif isinstance(topic, Topic):
                messages = _gather(content, runs, self._layouts[topic.name])
                values = np.empty((len(topic.channels), len(messages)))
                m.get_values(messages["payload"], values)
                parts.append((topic.name, (messages["log_time"].astype(np.int64), values)))
        return events, parts


def _frames(data: bytes, start: int) -> Iterator[tuple[int, int, int]]:
    """Opcode, start and end of whole records; ends before the first that is cut off or has an impossible opcode."""
    while start + RECORD_PREFIX.size <= len(data):
        opcode, length = RECORD_PREFIX.unpack_from(data, start)
        end = start + RECORD_PREFIX.size + length
        if not 0 < opcode <= _LAST_OPCODE or end > len(data):
            return
        yield opcode, start, end
        start = end


class _Content(BytesIO):
    """Bytes that end: reading beyond them is an error, where mcap takes what is left."""

    def read(self, size: int | None = -1) -> bytes:
        data = super().read(size)
        if size is not None and len(data) < size:
            raise DamagedError("its content is cut off")
        return data


def _parse(data: bytes, start: int, end: int) -> McapRecord:
    """The record between two bytes. Raises DamagedError where there is none."""
    try:
        if RECORD_PREFIX.unpack_from(data, start)[1] != end - start - RECORD_PREFIX.size:
            raise DamagedError("its length is wrong")
        return next(StreamReader(_Content(data[start:end]), skip_magic=True, emit_chunks=True).records)
    except _UNREADABLE as error:
        raise DamagedError("its content cannot be read") from error


def _summary(data: bytes) -> Summary:
    """The summary section. Raises DamagedError where it is missing or fails its checksum."""
    end = len(data) - len(MAGIC) - _FOOTER_SIZE
    try:
        footer = Footer.read(ReadDataStream(_Content(data[max(end, 0) + RECORD_PREFIX.size :])))
        checksum = zlib.crc32(data[footer.summary_start : -len(MAGIC) - 4])
        if data.endswith(MAGIC) and len(MAGIC) <= footer.summary_start <= end and checksum == footer.summary_crc:
            summary = make_reader(BytesIO(data)).get_summary()
            if summary is not None:
                return summary
    except _UNREADABLE as error:
        raise DamagedError("the summary cannot be read") from error
    raise DamagedError("the summary is missing or damaged")


def _chunk_content(data: bytes, start: int, end: int) -> bytes:
    """Decompressed and checked content of the chunk between two bytes. Raises DamagedError."""
    chunk = _parse(data, start, end)
    if not isinstance(chunk, Chunk):
        raise DamagedError("its first byte is wrong")
    if chunk.uncompressed_size > MOST_CHUNK_BYTES:
        size = f"{chunk.uncompressed_size / 1e6:.0f} MB"
        raise DamagedError(f"it says that it decompresses to {size}; at most {MOST_CHUNK_BYTES / 1e6:.0f} MB are read")
    try:
        content = _decompressed(chunk)
    except _UNREADABLE as error:
        raise DamagedError("it cannot be decompressed") from error
    if len(content) != chunk.uncompressed_size:
        raise DamagedError("its size does not match")
    if chunk.uncompressed_crc not in (0, zlib.crc32(content)):
        raise DamagedError("its checksum does not match")
    return content


def _decompressed(chunk: Chunk) -> bytes:
    """The content of a chunk; of one that is longer than it says no more than that comes into memory."""
    size = chunk.uncompressed_size
    if chunk.compression == "":
        return bytes(chunk.data)
    if chunk.compression == "zstd":
        if zstandard.frame_content_size(chunk.data) not in (size, -1):  # known, it would count for more than `size`
            raise DamagedError("its size does not match")
        return zstandard.decompress(chunk.data, max_output_size=size)
    if chunk.compression == "lz4":
        from lz4.frame import LZ4FrameDecompressor  # noqa: PLC0415  # lazy: we write zstd; it comes with mcap

        return bytes(LZ4FrameDecompressor().decompress(chunk.data, max_length=size + 1))
    raise DamagedError(f"its compression {chunk.compression!r} is not known")


def _message_runs(content: bytes) -> dict[int, list[range]]:
    """Return the places of each channel's messages in the content of a chunk, in runs of equal size: the starts of the
    messages of a run. Raises DamagedError.
    """
    runs: dict[int, list[range]] = {}
    position, end = 0, len(content)
    while position < end:
        if position + RECORD_PREFIX.size > end:
            raise DamagedError("its last record is cut off")
        opcode, length = RECORD_PREFIX.unpack_from(content, position)
        size = RECORD_PREFIX.size + length
        if position + size > end:
            raise DamagedError("its last record is cut off")
        count = 1
        if opcode == Opcode.MESSAGE:
            if size < m.MESSAGE_HEADER.size:
                raise DamagedError("a message is too short")
            count = _run_length(content, position, size)
            channel_id = _RUN_PREFIX.unpack_from(content, position)[2]
            runs.setdefault(channel_id, []).append(range(position, position + count * size, size))
        position += count * size
    return runs


def _run_length(content: bytes, start: int, size: int) -> int:
    """Return the number of records from `start` on that have the same opcode, length and channel.

    Compares ever larger blocks: short runs are common in files that other tools have rewritten.
    """
    prefix = content[start : start + _RUN_PREFIX.size]
    count, block = 1, _FIRST_BLOCK
    while True:
        position = start + count * size
        block = min(block, (len(content) - position) // size)
        if block == 0 or content[position : position + _RUN_PREFIX.size] != prefix:
            return count
        rows = np.frombuffer(content, np.uint8, block * size, position).reshape(block, size)
        same = (rows[:, : _RUN_PREFIX.size] == np.frombuffer(prefix, np.uint8)).all(axis=1)
        if not same.all():
            return count + int(same.argmin())
        count, block = count + block, 8 * block


def _gather(content: bytes, runs: list[range], layout: np.dtype[np.void]) -> NDArray[np.void]:
    """The messages of one channel as an array of `layout`. Raises DamagedError if one has another size."""
    if any(run.step != layout.itemsize for run in runs):
        raise DamagedError("a message does not have the size of its schema")
    if len(runs) == 1:
        return np.frombuffer(content, layout, len(runs[0]), runs[0].start)
    starts = np.concatenate([np.arange(run.start, run.stop, run.step) for run in runs])
    gathered = np.frombuffer(content, np.uint8)[starts[:, None] + np.arange(layout.itemsize)]
    return gathered.view(layout).ravel()
