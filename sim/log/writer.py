"""Writes the log of a flight: an MCAP file that Rerun, Foxglove and PlotJuggler open.

Equal input gives equal bytes (with the same releases of maxq and of the zstd library): a log's hash is a
regression test. Head first, so that a file cut off anywhere behind it can still be read and flown again;
then a chunk for each second of simulated time, or for each call where calls come more often; then the
summary.
"""

from __future__ import annotations

import io
import struct
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType

import numpy as np
import zstandard
from mcap import records as mcap_records
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.writer import MCAP0_MAGIC as MAGIC
from numpy.typing import NDArray

from maxq.control.kernel.records import Array, IntArray
from maxq.sim.flight.channels import EVENTS_TOPIC, FRAMES_TOPIC, ChannelTable, Topic
from maxq.sim.log import head as keys
from maxq.sim.log.foxglove import (
    FRAMES_SCHEMA,
    FRAMES_TYPE,
    LOG_SCHEMA,
    LOG_TYPE,
    Event,
    FramePath,
    encode_event,
    frames_template,
    put_frames,
)
from maxq.sim.log.head import LogError, RunHead, maxq_version
from maxq.sim.log.protobuf import (
    MESSAGE_HEADER,
    RECORD_PREFIX,
    doubles_template,
    message_dtype,
    message_type,
    metadata_of,
    put_values,
    schema_of,
)

_NS_PER_S = 1_000_000_000
_ZSTD = "zstd"
_LEVEL = 1  # noisy numbers hardly compress: higher levels cost more time than they save space
_LENGTH_WITHOUT_PAYLOAD = MESSAGE_HEADER.size - RECORD_PREFIX.size
_SUMMARY_ORDER = (
    Opcode.SCHEMA,
    Opcode.CHANNEL,
    Opcode.STATISTICS,
    Opcode.CHUNK_INDEX,
    Opcode.ATTACHMENT_INDEX,
    Opcode.METADATA_INDEX,
)
_INDEX_HEADER = struct.Struct("<BQHI")  # opcode, length, channel, bytes of entries


class LogWriter:
    """A log that is being written; use it as a context manager.

    When the block ends with an exception, the log is closed properly all the same and says that the run was
    aborted and why. Raises LogError where the file cannot be written.
    """

    def __init__(self, path: str | Path, table: ChannelTable, head: RunHead) -> None:
        self.path = Path(path)
        self._table = table
        self._last_ns = dict.fromkeys(table.groups, 0)
        try:
            self._container = Container(self.path, keys.PROFILE, f"maxq {maxq_version()}")
        except OSError as error:
            raise _cannot_write(self.path, error) from error
        try:
            self._write_head(head)
        except OSError as error:
            self._container.close()
            raise _cannot_write(self.path, error) from error

    def _write_head(self, head: RunHead) -> None:
        container = self._container
        container.add_metadata(keys.RUN_METADATA, head.full_metadata())
        self._templates: dict[str, tuple[int, NDArray[np.void]]] = {}  # channel and message, by topic
        for topic in self._table.topics:
            channel_id = container.add_channel(topic.name, message_type(topic), schema_of(topic), metadata_of(topic))
            self._templates[topic.name] = channel_id, doubles_template(len(topic.channels))
        self._events_id = container.add_channel(EVENTS_TOPIC, LOG_TYPE, LOG_SCHEMA, {})
        self._frames_id = container.add_channel(FRAMES_TOPIC, FRAMES_TYPE, FRAMES_SCHEMA, {})
        for attachment in head.attachments:
            container.add_attachment(attachment.name, attachment.media_type, attachment.data)
        container.add_metadata(keys.HEAD_METADATA, {keys.CRC_KEY: f"{container.crc:08x}"})

    def __enter__(self) -> LogWriter:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            self.close(error)
        except LogError:
            if error is None:
                raise  # else the first error is what matters, and the chunks written so far can be read

    def close(self, error: BaseException | None = None, result: Mapping[str, str] | None = None) -> None:
        """Write the end of the log, with the reason if the run was aborted; a second call does nothing.

        `result`: what the run says about its end (outcome, state hash, ...); kept beside the status. Its keys
        are its own: `status` and `reason` are refused with ValueError.
        """
        taken = {keys.STATUS_KEY, keys.REASON_KEY}.intersection(result or {})
        if taken:
            raise ValueError(f"result key {sorted(taken)[0]!r} is set by the log writer")
        container = self._container
        if not container.usable:
            container.close()
            return
        status = {keys.STATUS_KEY: keys.COMPLETE}
        if error is not None:
            status = {keys.STATUS_KEY: keys.ABORTED, keys.REASON_KEY: f"{type(error).__name__}: {error}"}
        try:
            container.add_metadata(keys.END_METADATA, status | dict(sorted((result or {}).items())))
            container.finish()
        except OSError as failure:
            raise _cannot_write(self.path, failure) from failure
        finally:
            container.usable = False
            container.close()

    def write_block(
        self,
        groups: Mapping[str, tuple[IntArray, Array]],
        events: Sequence[Event] = (),
        frames: Sequence[FramePath] = (),
    ) -> None:
        """Append samples, events and frames, in one chunk for each second of simulated time that occurs.

        `groups`: for each rate group its times (n,) in ns and its values (n, columns of the group), both in
        the order of the table. Times start at or after 0 and do not fall, within a call and from call to call.
        `frames` go to /tf, `events` to /events.

        Raises ValueError for arrays that do not fit the table, LogError where the file cannot be written.
        """
        if not self._container.usable:
            raise LogError(f"{self.path}: the log is closed")
        samples = {name: self._checked(name, *block) for name, block in groups.items()}
        for event in events:
            _check_times("events", np.array([event.time_ns]))
        for path in frames:
            n, what = len(path.times_ns), f"frame {path.child} in {path.parent}"
            _check_times(what, path.times_ns)
            if path.translation_m.shape != (n, 3) or path.rotation.shape != (n, 4):
                raise ValueError(f"{what}: translation must be ({n}, 3) and rotation ({n}, 4)")

        sample_seconds = {name: times // _NS_PER_S for name, (times, _) in samples.items()}
        event_seconds = np.array([event.time_ns // _NS_PER_S for event in events], np.int64)
        path_seconds = [path.times_ns // _NS_PER_S for path in frames]
        every = [*sample_seconds.values(), event_seconds, *path_seconds]
        try:
            for second in np.unique(np.concatenate(every)):
                blocks = []
                for topic in self._table.topics:
                    if topic.group in samples:
                        rows = _rows(sample_seconds[topic.group], second)
                        blocks += self._topic_block(topic, samples[topic.group], rows)
                blocks += self._event_blocks([e for e in events if e.time_ns // _NS_PER_S == second])
                blocks += self._frame_blocks(frames, [_rows(seconds, second) for seconds in path_seconds])
                self._container.add_chunk(blocks)
        except OSError as error:
            raise _cannot_write(self.path, error) from error
        self._last_ns |= {name: int(times[-1]) for name, (times, _) in samples.items() if len(times)}

    def _checked(self, group: str, times_ns: IntArray, values: Array) -> tuple[IntArray, Array]:
        """Times and values of a rate group, once they fit the table."""
        if group not in self._table.groups:
            raise ValueError(f"the channel table has no rate group {group!r}")
        channels = len(self._table.columns(group))
        if values.shape != (len(times_ns), channels):
            raise ValueError(
                f"rate group {group}: {values.shape} values, but {len(times_ns)} times and {channels} channels"
            )
        _check_times(group, times_ns, self._last_ns[group])
        return times_ns, values

    def _topic_block(self, topic: Topic, samples: tuple[IntArray, Array], rows: slice) -> list[Block]:
        times, values = samples[0][rows], samples[1][rows]
        if not len(times):
            return []
        first = self._table.index(topic.channels[0].name)
        channel_id, template = self._templates[topic.name]
        block = message_block(channel_id, template, times, self._container.count(channel_id))
        put_values(block.records["payload"], values[:, first : first + len(topic.channels)])
        return [block]

    def _event_blocks(self, events: list[Event]) -> list[Block]:
        first = self._container.count(self._events_id)
        ordered = sorted(events, key=lambda event: event.time_ns)
        return [
            single_message(self._events_id, event.time_ns, sequence, encode_event(event))
            for sequence, event in enumerate(ordered, start=first)
        ]

    def _frame_blocks(self, paths: Sequence[FramePath], rows: list[slice]) -> list[Block]:
        blocks = []
        sequence = self._container.count(self._frames_id)
        for path, some in zip(paths, rows, strict=True):
            times = path.times_ns[some]
            if len(times):
                block = message_block(self._frames_id, frames_template(path.parent, path.child), times, sequence)
                put_frames(block.records["payload"], times, path.translation_m[some], path.rotation[some])
                blocks.append(block)
                sequence += len(times)
        return blocks


def _rows(seconds: IntArray, second: int) -> slice:
    """Rows of one second in sorted `seconds`."""
    return slice(*np.searchsorted(seconds, [second, second + 1]))


def _check_times(what: str, times_ns: IntArray, earliest: int = 0) -> None:
    if times_ns.dtype != np.int64 or times_ns.ndim != 1:
        raise ValueError(f"{what}: times must be a one-dimensional array of int64")
    if len(times_ns) and (int(times_ns[0]) < earliest or bool((times_ns[1:] < times_ns[:-1]).any())):
        raise ValueError(f"{what}: times must not fall and must start at or after {earliest} ns")


def _cannot_write(path: Path, error: OSError) -> LogError:
    return LogError(f"{path}: the log cannot be written: {error.strerror or error}")


@dataclass(frozen=True)
class Block:
    """Messages of one channel, ready for a chunk: `times_ns` (n,) and their records of equal size."""

    channel_id: int
    times_ns: IntArray
    records: NDArray[np.void]


def message_block(channel_id: int, template: NDArray[np.void], times_ns: IntArray, first_sequence: int) -> Block:
    """Messages with these times whose payloads differ from `template` in numbers only, which the caller fills."""
    n = len(times_ns)
    length = _LENGTH_WITHOUT_PAYLOAD + template.dtype.itemsize
    record = MESSAGE_HEADER.pack(Opcode.MESSAGE, length, channel_id, 0, 0, 0) + template.tobytes()
    rows = np.frombuffer(bytearray(record * n), message_dtype(template.dtype))
    rows["sequence"] = np.arange(first_sequence, first_sequence + n) & 0xFFFFFFFF
    rows["log_time"] = rows["publish_time"] = times_ns
    return Block(channel_id, times_ns, rows)


def single_message(channel_id: int, time_ns: int, sequence: int, payload: bytes) -> Block:
    """One message whose payload may have any size."""
    length = _LENGTH_WITHOUT_PAYLOAD + len(payload)
    header = MESSAGE_HEADER.pack(Opcode.MESSAGE, length, channel_id, sequence & 0xFFFFFFFF, time_ns, time_ns)
    record = np.frombuffer(header + payload, f"V{len(header) + len(payload)}")
    return Block(channel_id, np.array([time_ns], np.int64), record)


def encode(*records: mcap_records.McapRecord) -> bytes:
    builder = RecordBuilder()
    for record in records:
        record.write(builder)
    return bytes(builder.end())  # type: ignore[no-untyped-call]  # mcap does not annotate it


def _footer(summary_start: int, offsets_start: int, summary: bytes) -> bytes:
    """Footer record with the checksum of the summary section, which covers the footer's own first fields."""
    start_of_footer = encode(mcap_records.Footer(summary_start, offsets_start, 0))[:-4]
    crc = zlib.crc32(start_of_footer, zlib.crc32(summary))
    return encode(mcap_records.Footer(summary_start, offsets_start, crc))


class Container:
    """Writes records in order, keeps what the summary needs, and writes every chunk through to the system.

    Nothing in the file comes from the clock or the machine. `usable` is False after an error in the middle
    of a chunk: a reader could not find what follows it, so nothing more must be written.
    """

    def __init__(self, path: Path, profile: str, library: str) -> None:
        self._file = io.FileIO(path, "w")  # not buffered: what is written survives the end of this process
        self.usable = True
        self.size = 0
        self.crc = 0  # of all bytes so far; the data section ends with it
        self._compressor = zstandard.ZstdCompressor(level=_LEVEL)
        self._summary: dict[Opcode, list[mcap_records.McapRecord]] = {opcode: [] for opcode in _SUMMARY_ORDER}
        self._counts: dict[int, int] = {}  # of messages by channel
        self._first_ns: int | None = None
        self._last_ns = 0
        self._write(MAGIC + encode(mcap_records.Header(profile, library)))

    def add_channel(self, topic: str, message_type: str, schema: bytes, metadata: dict[str, str]) -> int:
        """Add a channel of protobuf messages with its schema; returns its id."""
        number = len(self._counts) + 1
        schema_record = mcap_records.Schema(id=number, name=message_type, encoding="protobuf", data=schema)
        channel = mcap_records.Channel(
            id=number, topic=topic, message_encoding="protobuf", schema_id=number, metadata=metadata
        )
        self._summary[Opcode.SCHEMA].append(schema_record)
        self._summary[Opcode.CHANNEL].append(channel)
        self._counts[number] = 0
        self._write(encode(schema_record, channel))
        return number

    def add_attachment(self, name: str, media_type: str, data: bytes) -> None:
        record = encode(mcap_records.Attachment(create_time=0, log_time=0, name=name, media_type=media_type, data=data))
        place = {"offset": self.size, "length": len(record), "create_time": 0, "log_time": 0, "data_size": len(data)}
        self._summary[Opcode.ATTACHMENT_INDEX].append(
            mcap_records.AttachmentIndex(**place, name=name, media_type=media_type)
        )
        self._write(record)

    def add_metadata(self, name: str, metadata: dict[str, str]) -> None:
        record = encode(mcap_records.Metadata(name=name, metadata=metadata))
        self._summary[Opcode.METADATA_INDEX].append(
            mcap_records.MetadataIndex(offset=self.size, length=len(record), name=name)
        )
        self._write(record)

    def count(self, channel_id: int) -> int:
        """Messages of a channel so far."""
        return self._counts[channel_id]

    def add_chunk(self, blocks: Sequence[Block]) -> None:
        """Add one chunk of messages and its message indexes."""
        self.usable = False
        content = b"".join([block.records.tobytes() for block in blocks])
        compressed = self._compressor.compress(content)
        first = min(int(block.times_ns.min()) for block in blocks)
        last = max(int(block.times_ns.max()) for block in blocks)
        chunk = mcap_records.Chunk(
            compression=_ZSTD,
            data=compressed,
            message_start_time=first,
            message_end_time=last,
            uncompressed_crc=zlib.crc32(content),
            uncompressed_size=len(content),
        )
        record = encode(chunk)
        indexes = _message_indexes(blocks)
        ends = np.cumsum([self.size + len(record), *map(len, indexes.values())]).tolist()
        chunk_index = mcap_records.ChunkIndex(
            chunk_start_offset=self.size,
            chunk_length=len(record),
            compression=_ZSTD,
            compressed_size=len(compressed),
            uncompressed_size=len(content),
            message_start_time=first,
            message_end_time=last,
            message_index_offsets=dict(zip(indexes, ends, strict=False)),
            message_index_length=ends[-1] - ends[0],
        )
        self._write(b"".join([record, *indexes.values()]))
        self._summary[Opcode.CHUNK_INDEX].append(chunk_index)
        for block in blocks:
            self._counts[block.channel_id] += len(block.times_ns)
        self._first_ns = first if self._first_ns is None else min(self._first_ns, first)
        self._last_ns = max(self._last_ns, last)
        self.usable = True

    def finish(self) -> None:
        """Write the end of the data section and the summary."""
        self._write(encode(mcap_records.DataEnd(self.crc)))
        start, summary, offsets = self.size, b"", []
        self._summary[Opcode.STATISTICS] = [self._statistics()]
        for opcode, records in self._summary.items():
            group = encode(*records)
            if group:
                offsets.append(mcap_records.SummaryOffset(opcode, start + len(summary), len(group)))
            summary += group
        offsets_start = start + len(summary)
        summary += encode(*offsets)
        self._write(summary + _footer(start, offsets_start, summary) + MAGIC)

    def _statistics(self) -> mcap_records.Statistics:
        return mcap_records.Statistics(
            attachment_count=len(self._summary[Opcode.ATTACHMENT_INDEX]),
            channel_count=len(self._counts),
            channel_message_counts=self._counts,
            chunk_count=len(self._summary[Opcode.CHUNK_INDEX]),
            message_count=sum(self._counts.values()),
            message_start_time=self._first_ns or 0,
            message_end_time=self._last_ns,
            metadata_count=len(self._summary[Opcode.METADATA_INDEX]),
            schema_count=len(self._counts),
        )

    def close(self) -> None:
        self._file.close()

    def _write(self, data: bytes) -> None:
        rest = memoryview(data)
        while rest:
            rest = rest[self._file.write(rest) :]
        self.crc = zlib.crc32(data, self.crc)
        self.size += len(data)


def _message_indexes(blocks: Sequence[Block]) -> dict[int, bytes]:
    """A message index record per channel: time and place in the chunk of each message, in order of time."""
    entries: dict[int, list[NDArray[np.uint64]]] = {}
    position = 0
    for block in blocks:
        size, count = block.records.dtype.itemsize, len(block.times_ns)
        rows = np.empty((count, 2), "<u8")
        rows[:, 0] = block.times_ns
        rows[:, 1] = position + size * np.arange(count)
        entries.setdefault(block.channel_id, []).append(rows)
        position += size * count
    records = {}
    for channel_id, parts in entries.items():
        rows = np.concatenate(parts)
        data = rows[np.argsort(rows[:, 0], kind="stable")].tobytes()
        records[channel_id] = _INDEX_HEADER.pack(Opcode.MESSAGE_INDEX, 6 + len(data), channel_id, len(data)) + data
    return records
