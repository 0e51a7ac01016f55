"""The reader of a flight's log into arrays, also of a truncated or damaged log.

The `mcap` package parses records. Its readers stop at the first flaw of a file and return messages individually. This
module finds the records in a damaged file, and reads the messages of a chunk as arrays. The writer of maxq keeps the
messages of a topic together, so that a chunk consists of a few runs of records of equal length. Other tools may reorder
the messages, so that a run may be as short as one message. Format: MCAP specification, https://mcap.dev/spec.
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
_RUN_PREFIX = struct.Struct("<BQH")  # the part of the header that is equal for all messages of a run
_FIRST_BLOCK = 64  # records in the first comparison
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
    RuntimeError,  # from lz4
)
MOST_CHUNK_BYTES = 1 << 28
"""The largest size of a chunk's content, bytes; the chunks of maxq contain a second of flight, about a megabyte."""
MOST_LOG_BYTES = 1 << 34
"""The largest size of the content of all chunks, bytes, which is a thousand times that of a flight of 400 s."""


class DamagedError(ValueError):
    """The error of a record whose bytes are invalid."""


@dataclass(frozen=True)
class LoggedRun:
    """The facts about a run in its log, without the flight itself.

    `end` contains the status, reason and result of the run (see `LogWriter.close`). It is empty if its record is
    missing or damaged.
    """

    path: Path
    metadata: Mapping[str, str]
    attachments: Mapping[str, Attachment]
    end: Mapping[str, str]


@dataclass(frozen=True, repr=False)
class Log(LoggedRun, Tabular):
    """The log of a flight.

    `log["alpha_deg"]` returns the values (n,) of a channel, and `log.time_s("alpha_deg")` their times (n,). `complete`
    is False if the run or the file ended early, or if a part of the file is damaged. `notes` then contains the reasons,
    one sentence each.
    """

    table: ChannelTable
    events: tuple[m.EventMessage, ...]
    complete: bool
    notes: tuple[str, ...]
    _times_ns: Mapping[str, IntArray]
    _values: Mapping[str, Mapping[str, Array]]

    def __getitem__(self, name: str) -> Array:
        """Return the values (n,) of a channel; raise KeyError with the closest name for an unknown channel."""
        return self._values[self._topic(name)][name]

    def __contains__(self, name: str) -> bool:
        return name in self.table

    def __repr__(self) -> str:
        end = max((float(ns[-1]) / 1e9 for ns in self._times_ns.values() if len(ns)), default=0.0)
        whole = "complete" if self.complete else f"not complete: {self.notes[0]}"
        scenario = self.metadata.get("scenario", "")
        return f"<Log {self.path}: {scenario}, {end:.3f} s, {len(self.table.names)} channels, {whole}>"

    def channel(self, name: str) -> Channel:
        """Return the unit, frame and description of a channel; raise KeyError for an unknown channel."""
        self._topic(name)
        return self.table.channel(name)

    def time_ns(self, name: str) -> IntArray:
        """Return the times (n,) of a channel or topic, ns; raise KeyError for an unknown name."""
        return self._times_ns[self._topic(name)]

    def time_s(self, name: str) -> Array:
        """Return the times (n,) of a channel or topic, s; raise KeyError for an unknown name."""
        return self.time_ns(name) / 1e9

    def _topic(self, name: str) -> str:
        """Return the name of the topic with this name, or of the topic that contains the channel with this name."""
        if name in self._times_ns:
            return name
        if name in self.table:
            return self.table.topic(name).name
        raise self._unknown(name)


def read_log(path: str | Path) -> Log:
    """Return the log in a file, with all intact chunks of a truncated or damaged file.

    Raises LogError if the file cannot be read, is no log of maxq, or has an unknown schema. Also raises LogError if the
    file is truncated within its head or if the head cannot be parsed, because the content is then unknown.
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
    """Return the facts about a run from its log, without the flight.

    Raises LogError if `read_log` does, and if the checksum of the head is wrong.
    """
    file = _LogFile(Path(path))
    if not file.intact:
        raise LogError(f"{path}: the head of the log is damaged: the scenario in it may be wrong")
    return LoggedRun(file.path, file.metadata, file.attachments, file.end)


class _LogFile:
    """The bytes of a log, its head, the positions of its chunks, and the record of the run's end.

    `intact` is True if the head's checksum matches. `end` is empty if its record is missing. `notes` lists the damage.
    The constructor raises LogError.
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
        """Read the head, and return the offset of its end.

        Raises ValueError with a message that follows the name of the file.
        """
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
        self._topics: dict[int, Topic | str] = {}  # by MCAP channel; names only for /events and /tf
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
        """Return the start and end of all chunks from the index at the end of the file, and read the record `end`.

        Raises DamagedError if the index is missing or damaged.
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
        """Return the start and end of all complete chunks, found record by record from byte `start` on."""
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
        """Return the events, the times (n,) by topic, ns, and the contiguous values (n,) by topic and channel.

        Damaged chunks are omitted and listed in `notes`. The numbers of a chunk are copied immediately, while they are
        in the processor's cache. Raises LogError above MOST_LOG_BYTES.
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
        """Return the events of a chunk, and its topics with times (n,) and values (channels, n). Raises ValueError."""
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
    """Yield the opcode, start and end of each record up to the first that is truncated or has an invalid opcode."""
    while start + RECORD_PREFIX.size <= len(data):
        opcode, length = RECORD_PREFIX.unpack_from(data, start)
        end = start + RECORD_PREFIX.size + length
        if not 0 < opcode <= _LAST_OPCODE or end > len(data):
            return
        yield opcode, start, end
        start = end


class _Content(BytesIO):
    """A stream that raises DamagedError on reading beyond its end, instead of returning the remaining bytes."""

    def read(self, size: int | None = -1) -> bytes:
        data = super().read(size)
        if size is not None and len(data) < size:
            raise DamagedError("its content is cut off")
        return data


def _parse(data: bytes, start: int, end: int) -> McapRecord:
    """Return the record from byte `start` to byte `end`. Raises DamagedError if it is invalid."""
    try:
        if RECORD_PREFIX.unpack_from(data, start)[1] != end - start - RECORD_PREFIX.size:
            raise DamagedError("its length is wrong")
        return next(StreamReader(_Content(data[start:end]), skip_magic=True, emit_chunks=True).records)
    except _UNREADABLE as error:
        raise DamagedError("its content cannot be read") from error


def _summary(data: bytes) -> Summary:
    """Return the summary section. Raises DamagedError if it is missing, damaged, or fails its checksum."""
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
    """Return the decompressed and verified content of the chunk from byte `start` to byte `end`.

    Raises DamagedError.
    """
    chunk = _parse(data, start, end)
    if not isinstance(chunk, Chunk):
        raise DamagedError("its first byte is wrong")
    if chunk.uncompressed_size > MOST_CHUNK_BYTES:
        size = f"{chunk.uncompressed_size / 1e6:.0f} MB"
        raise DamagedError(
            f"it declares a decompressed size of {size}; at most {MOST_CHUNK_BYTES / 1e6:.0f} MB are read"
        )
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
    """Return the decompressed content of a chunk, with a limit that prevents more than the declared size.

    For lz4, the limit is one byte more. Raises DamagedError for another size or an unknown compression.
    """
    size = chunk.uncompressed_size
    if chunk.compression == "":
        return bytes(chunk.data)
    if chunk.compression == "zstd":
        if zstandard.frame_content_size(chunk.data) not in (size, -1):  # it overrides max_output_size
            raise DamagedError("its size does not match")
        return zstandard.decompress(chunk.data, max_output_size=size)
    if chunk.compression == "lz4":
        from lz4.frame import LZ4FrameDecompressor  # noqa: PLC0415  # lazy: maxq writes zstd; mcap installs lz4

        return bytes(LZ4FrameDecompressor().decompress(chunk.data, max_length=size + 1))
    raise DamagedError(f"its compression {chunk.compression!r} is not known")


def _message_runs(content: bytes) -> dict[int, list[range]]:
    """Return, by channel, the runs of messages of equal size in a chunk's content.

    A run is the range of the starts of its messages. Raises DamagedError.
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
    """Return the number of consecutive records from `start` on with the same opcode, length and channel.

    Blocks of increasing size are compared, because short runs are common in files rewritten by other tools.
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
    """Return the messages (n,) of a channel as an array of `layout`. Raises DamagedError for a different size."""
    if any(run.step != layout.itemsize for run in runs):
        raise DamagedError("a message does not have the size of its schema")
    if len(runs) == 1:
        return np.frombuffer(content, layout, len(runs[0]), runs[0].start)
    starts = np.concatenate([np.arange(run.start, run.stop, run.step) for run in runs])
    gathered = np.frombuffer(content, np.uint8)[starts[:, None] + np.arange(layout.itemsize)]
    return gathered.view(layout).ravel()
