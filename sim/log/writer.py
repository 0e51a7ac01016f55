"""The writer of a flight's log, an MCAP file for Rerun, Foxglove and PlotJuggler.

Equal input gives equal bytes with the same releases of maxq and of the zstd library, so that the hash of a log can
serve as a regression test. The head comes first. A file that is truncated anywhere after the head can therefore be
read, and its flight can be repeated. The head is followed by a chunk for each second of simulated time, or for each
call if calls are more frequent, and by the summary.
"""

from __future__ import annotations

import io
import os
import stat
import struct
import sys
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager, suppress
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
import zstandard
from mcap import records as mcap_records
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.writer import MCAP0_MAGIC as MAGIC
from numpy.typing import NDArray

from maxq.control.kernel.records import Array, IntArray
from maxq.sim.flight.channels import EVENTS_TOPIC, FRAMES_TOPIC, ChannelTable
from maxq.sim.log import head as keys
from maxq.sim.log import messages as m
from maxq.sim.log.head import LogError, RunHead, maxq_version

if sys.platform != "win32":
    import fcntl

_LEVEL = 1  # zstd level; for noisy numbers, higher levels take more time and save little space
_SUMMARY_ORDER = (
    Opcode.SCHEMA,
    Opcode.CHANNEL,
    Opcode.STATISTICS,
    Opcode.CHUNK_INDEX,
    Opcode.ATTACHMENT_INDEX,
    Opcode.METADATA_INDEX,
)
_INDEX_HEADER = struct.Struct("<BQHI")  # opcode, length, channel, bytes of entries

Put = Callable[..., None]
"""A function that writes columns of numbers, with a row for each message, into the payloads of messages."""


class LogWriter:
    """The writer of a log, a context manager.

    If the block ends with an exception, the log is closed properly, and its end record has the status "aborted" and the
    reason. Raises LogError if the file cannot be written.
    """

    def __init__(self, path: str | Path, table: ChannelTable, head: RunHead) -> None:
        self.path = Path(path)
        self._table = table
        self._last_ns = dict.fromkeys(table.groups, 0)
        with _log_errors(self.path):
            self._container = Container(self.path, keys.PROFILE, f"maxq {maxq_version()}")
            try:
                self._write_head(head)
            except OSError:
                self._container.close()
                raise

    def _write_head(self, head: RunHead) -> None:
        add_channel = self._container.add_channel
        self._container.add_metadata(keys.RUN_METADATA, head.full_metadata())
        self._templates: dict[str, tuple[int, NDArray[np.void]]] = {}  # channel id and message, by topic
        for t in self._table.topics:
            channel_id = add_channel(t.name, m.message_type(t), m.schema_of(t), m.metadata_of(t))
            self._templates[t.name] = channel_id, m.doubles_template(len(t.channels))
        self._events_id = add_channel(EVENTS_TOPIC, m.LOG_TYPE, m.LOG_SCHEMA, {})
        self._frames_id = add_channel(FRAMES_TOPIC, m.FRAMES_TYPE, m.FRAMES_SCHEMA, {})
        for attachment in head.attachments:
            self._container.add_attachment(attachment.name, attachment.media_type, attachment.data)
        self._container.add_metadata(keys.HEAD_METADATA, {keys.CRC_KEY: f"{self._container.crc:08x}"})

    def __enter__(self) -> LogWriter:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            self.close(error)
        except LogError:
            if error is None:
                raise  # otherwise, the first error matters, and the chunks written before it can be read

    def close(self, error: BaseException | None = None, result: Mapping[str, str] | None = None) -> None:
        """Write the end of the log, with the reason if `error` aborted the run; a second call has no effect.

        `result` contains the final results of the run (outcome, state hash and so on), which are stored in addition to
        the status. Raises ValueError if it has the keys `status` or `reason`, and LogError if the file cannot be
        written.
        """
        taken = {keys.STATUS_KEY, keys.REASON_KEY}.intersection(result or {})
        if taken:
            raise ValueError(f"result key {sorted(taken)[0]!r} is set by the log writer")
        status = {keys.STATUS_KEY: keys.COMPLETE}
        if error is not None:
            status = {keys.STATUS_KEY: keys.ABORTED, keys.REASON_KEY: f"{type(error).__name__}: {error}"}
        with _log_errors(self.path), closing(self._container) as container:
            if container.usable:
                container.add_metadata(keys.END_METADATA, status | dict(sorted((result or {}).items())))
                container.finish()

    def write_block(
        self,
        groups: Mapping[str, tuple[IntArray, Array]],
        events: Sequence[m.EventMessage] = (),
        frames: Sequence[m.FramePath] = (),
    ) -> None:
        """Append samples, events and frames, in a chunk for each second of simulated time.

        `groups` contains, for each rate group, times (n,) in ns and values (n, columns of the group) with columns in
        the order of the table. Times start at or after 0 and do not decrease; the times of a group also do not decrease
        from call to call. `frames` are written to /tf, and `events` to /events.

        Raises ValueError for arrays that do not match the table, and LogError if the file cannot be written.
        """
        if not self._container.usable:
            raise LogError(f"{self.path}: the log is closed")
        streams: list[tuple[int, NDArray[np.void], IntArray, Put, tuple[Array | IntArray, ...]]] = []
        for group, (times, values) in groups.items():
            if group not in self._table.groups:
                raise ValueError(f"the channel table has no rate group {group!r}")
            n, channels = len(times), len(self._table.columns(group))
            if values.shape != (n, channels):
                raise ValueError(f"rate group {group}: {values.shape} values, but {n} times and {channels} channels")
            _check_times(group, times, self._last_ns[group])
        for topic in self._table.topics:
            if topic.group in groups:
                times, values = groups[topic.group]
                first = self._table.index(topic.channels[0].name)
                own = values[:, first : first + len(topic.channels)]
                streams.append((*self._templates[topic.name], times, m.put_values, (own,)))
        for event in sorted(events, key=lambda event: event.time_ns):
            times = np.array([event.time_ns])
            _check_times("events", times)
            streams.append((self._events_id, m.encode_event(event), times, lambda _: None, ()))
        for path in frames:
            times, what = path.times_ns, f"frame {path.child} in {path.parent}"
            _check_times(what, times)
            if path.translation_m.shape != (len(times), 3) or path.rotation.shape != (len(times), 4):
                raise ValueError(f"{what}: translation must be ({len(times)}, 3) and rotation ({len(times)}, 4)")
            motion, template = (times, path.translation_m, path.rotation), m.frames_template(path.parent, path.child)
            streams.append((self._frames_id, template, times, m.put_frames, motion))

        seconds = [times // m.NS_PER_S for _, _, times, _, _ in streams]
        with _log_errors(self.path):
            for second in np.unique(np.concatenate([np.zeros(0, np.int64), *seconds])):
                blocks = []
                for (channel_id, template, times, put, columns), own_seconds in zip(streams, seconds, strict=True):
                    rows = slice(*np.searchsorted(own_seconds, [second, second + 1]))
                    if rows.start < rows.stop:
                        blocks.append(message_block(channel_id, template, times[rows]))
                        put(blocks[-1]["payload"], *(column[rows] for column in columns))
                self._container.add_chunk(blocks)
        self._last_ns |= {group: int(times[-1]) for group, (times, _) in groups.items() if len(times)}


@contextmanager
def _log_errors(path: Path) -> Iterator[None]:
    """Raise an OSError in the block as LogError."""
    try:
        yield
    except OSError as error:
        raise LogError(f"{path}: the log cannot be written: {error.strerror or error}") from error


def _check_times(what: str, times_ns: IntArray, earliest: int = 0) -> None:
    if times_ns.dtype != np.int64 or times_ns.ndim != 1:
        raise ValueError(f"{what}: times must be a one-dimensional array of int64")
    if len(times_ns) and (int(times_ns[0]) < earliest or bool((times_ns[1:] < times_ns[:-1]).any())):
        raise ValueError(f"{what}: times must not decrease and must start at or after {earliest} ns")


def message_block(channel_id: int, template: NDArray[np.void], times_ns: IntArray) -> NDArray[np.void]:
    """Return the message records (n,) of a channel at the times `times_ns` (n,), for a chunk, which numbers them.

    All payloads are copies of `template`, into which the caller writes the numbers.
    """
    n, layout = len(times_ns), m.message_dtype(template.dtype)
    length = layout.itemsize - m.RECORD_PREFIX.size
    record = m.MESSAGE_HEADER.pack(Opcode.MESSAGE, length, channel_id, 0, 0, 0) + template.tobytes()
    rows = np.frombuffer(bytearray(record * n), layout)
    rows["log_time"] = rows["publish_time"] = times_ns
    return rows


def encode(*records: mcap_records.McapRecord) -> bytes:
    builder = RecordBuilder()
    for record in records:
        record.write(builder)
    return bytes(builder.end())  # type: ignore[no-untyped-call]  # mcap does not annotate it


def _opened(path: str, flags: int) -> int:
    """Open a file for writing, lock it until it is closed, and empty it. Raises LogError if another writer has it."""
    handle = os.open(path, flags & ~os.O_TRUNC | getattr(os, "O_NOFOLLOW", 0), 0o666)
    try:
        if stat.S_ISREG(os.fstat(handle).st_mode):
            if not _lock(handle):
                raise LogError(f"{path}: another flight is writing this log; wait for it, or give another --out")
            os.ftruncate(handle, 0)
    except BaseException:
        os.close(handle)
        raise
    return handle


def _lock(handle: int) -> bool:
    """Lock a file, and return False if another writer has locked it. Not every file system has locks."""
    if sys.platform != "win32":
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            return not isinstance(error, BlockingIOError)
    return True


class Container:
    """The writer of an MCAP file, which collects the summary and passes every chunk to the operating system at once.

    The content does not depend on the clock or the machine. `usable` is False after closing, and after an error inside
    a chunk, because a reader could not find records after such an error.
    """

    def __init__(self, path: Path, profile: str, library: str) -> None:
        if path.is_symlink():  # replaced, as by the rename of other files: the file behind it may be another's
            path.unlink()
        self._file = io.FileIO(path, "w", opener=_opened)  # not buffered: written data survive the end of this process
        self.usable = True
        self.size = 0
        self.crc = 0  # CRC-32 of all bytes so far; the data section ends with it
        self._compressor = zstandard.ZstdCompressor(level=_LEVEL)
        self._summary: dict[Opcode, list[mcap_records.McapRecord]] = {opcode: [] for opcode in _SUMMARY_ORDER}
        self._counts: dict[int, int] = {}  # number of messages by channel
        self._first_ns, self._last_ns = 1 << 63, 0
        self._write(MAGIC + encode(mcap_records.Header(profile, library)))

    def add_channel(self, topic: str, message_type: str, schema: bytes, metadata: dict[str, str]) -> int:
        """Write a channel of protobuf messages with its schema, and return its id."""
        number = len(self._counts) + 1
        records = (
            mcap_records.Schema(id=number, name=message_type, encoding="protobuf", data=schema),
            mcap_records.Channel(number, metadata=metadata, message_encoding="protobuf", schema_id=number, topic=topic),
        )
        for opcode, record in zip((Opcode.SCHEMA, Opcode.CHANNEL), records, strict=True):
            self._summary[opcode].append(record)
        self._counts[number] = 0
        self._write(encode(*records))
        return number

    def add_attachment(self, name: str, media_type: str, data: bytes) -> None:
        about: dict[str, Any] = {"create_time": 0, "log_time": 0, "name": name, "media_type": media_type}
        record = encode(mcap_records.Attachment(**about, data=data))
        index = mcap_records.AttachmentIndex(**about, data_size=len(data), offset=self.size, length=len(record))
        self._summary[Opcode.ATTACHMENT_INDEX].append(index)
        self._write(record)

    def add_metadata(self, name: str, metadata: dict[str, str]) -> None:
        record = encode(mcap_records.Metadata(name=name, metadata=metadata))
        index = mcap_records.MetadataIndex(offset=self.size, length=len(record), name=name)
        self._summary[Opcode.METADATA_INDEX].append(index)
        self._write(record)

    def add_chunk(self, blocks: Sequence[NDArray[np.void]]) -> None:
        """Write a chunk of messages (`message_block`), numbered consecutively by channel, and its message indexes."""
        self.usable = False
        for block in blocks:
            channel_id = int(block["channel"][0])
            before = self._counts[channel_id]
            block["sequence"] = np.arange(before, before + len(block)) & 0xFFFFFFFF
            self._counts[channel_id] += len(block)
        content = b"".join([block.tobytes() for block in blocks])
        compressed = self._compressor.compress(content)
        first = min(int(block["log_time"][0]) for block in blocks)
        last = max(int(block["log_time"][-1]) for block in blocks)
        self._first_ns, self._last_ns = min(self._first_ns, first), max(self._last_ns, last)
        about: dict[str, Any] = {
            "compression": "zstd",
            "message_start_time": first,
            "message_end_time": last,
            "uncompressed_size": len(content),
        }
        record = encode(mcap_records.Chunk(**about, data=compressed, uncompressed_crc=zlib.crc32(content)))
        indexes = _message_indexes(blocks)
        ends = np.cumsum([self.size + len(record), *map(len, indexes.values())]).tolist()
        chunk_index = mcap_records.ChunkIndex(
            **about,
            chunk_start_offset=self.size,
            chunk_length=len(record),
            compressed_size=len(compressed),
            message_index_offsets=dict(zip(indexes, ends, strict=False)),
            message_index_length=ends[-1] - ends[0],
        )
        self._write(b"".join([record, *indexes.values()]))
        self._summary[Opcode.CHUNK_INDEX].append(chunk_index)
        self.usable = True

    def finish(self) -> None:
        """Write the end of the data section, the summary and the footer."""
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
        beginning = encode(mcap_records.Footer(start, offsets_start, 0))[:-4]  # part of the footer in the checksum
        footer = mcap_records.Footer(start, offsets_start, zlib.crc32(beginning, zlib.crc32(summary)))
        self._write(summary + encode(footer) + MAGIC)

    def _statistics(self) -> mcap_records.Statistics:
        return mcap_records.Statistics(
            attachment_count=len(self._summary[Opcode.ATTACHMENT_INDEX]),
            channel_count=len(self._counts),
            channel_message_counts=self._counts,
            chunk_count=len(self._summary[Opcode.CHUNK_INDEX]),
            message_count=sum(self._counts.values()),
            message_start_time=min(self._first_ns, self._last_ns),
            message_end_time=self._last_ns,
            metadata_count=len(self._summary[Opcode.METADATA_INDEX]),
            schema_count=len(self._counts),
        )

    def close(self) -> None:
        self.usable = False
        if sys.platform != "win32" and not self._file.closed:  # else a forked process would keep the lock
            with suppress(OSError):
                fcntl.flock(self._file.fileno(), fcntl.LOCK_UN)
        self._file.close()

    def _write(self, data: bytes) -> None:
        rest = memoryview(data)
        while rest:
            rest = rest[self._file.write(rest) :]
        self.crc = zlib.crc32(data, self.crc)
        self.size += len(data)


def _message_indexes(blocks: Sequence[NDArray[np.void]]) -> dict[int, bytes]:
    """Return, by channel, a record with the time and the position in the chunk of each message, in order of time."""
    entries: dict[int, list[NDArray[np.uint64]]] = {}
    position = 0
    for block in blocks:
        places = position + block.itemsize * np.arange(len(block), dtype=np.uint64)
        entries.setdefault(int(block["channel"][0]), []).append(np.stack([block["log_time"], places], axis=1))
        position += block.nbytes
    records = {}
    for channel_id, parts in entries.items():
        rows = np.concatenate(parts)
        data = rows[np.argsort(rows[:, 0], kind="stable")].tobytes()
        records[channel_id] = _INDEX_HEADER.pack(Opcode.MESSAGE_INDEX, 6 + len(data), channel_id, len(data)) + data
    return records
