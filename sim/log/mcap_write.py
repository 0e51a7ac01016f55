"""An MCAP file that grows chunk by chunk and is readable up to the last of them at any time.

Messages come in blocks of equal size, as NumPy arrays.
"""

from __future__ import annotations

import io
import struct
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import zstandard
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Channel,
    Chunk,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    McapRecord,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)
from numpy.typing import NDArray

from maxq.control.kernel.records import IntArray
from maxq.sim.log.mcap_read import MAGIC, MESSAGE_HEADER, RECORD_PREFIX, ZSTD, message_dtype

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


@dataclass(frozen=True)
class Block:
    """Messages of one channel, ready for a chunk: `times_ns` (n,) and their records of equal size."""

    channel_id: int
    times_ns: IntArray
    records: NDArray[np.void]


class MessageBuffer:
    """Records of one channel whose payloads differ in numbers only; reused from chunk to chunk."""

    def __init__(self, channel_id: int, template: NDArray[np.void]) -> None:
        self._channel_id = channel_id
        self._template = template
        self._rows = np.zeros(0, message_dtype(template.dtype))

    def block(self, times_ns: IntArray, first_sequence: int) -> Block:
        """Records with these times, payload to be filled by the caller; valid until the next call."""
        n = len(times_ns)
        if n > len(self._rows):
            self._rows = np.zeros(n, self._rows.dtype)
            self._rows["opcode"] = Opcode.MESSAGE
            self._rows["length"] = _LENGTH_WITHOUT_PAYLOAD + self._template.dtype.itemsize
            self._rows["channel"] = self._channel_id
            self._rows["payload"] = self._template
        rows = self._rows[:n]
        rows["sequence"] = np.arange(first_sequence, first_sequence + n) & 0xFFFFFFFF
        rows["log_time"] = times_ns
        rows["publish_time"] = times_ns
        return Block(self._channel_id, times_ns, rows)


def single_message(channel_id: int, time_ns: int, sequence: int, payload: bytes) -> Block:
    """One message whose payload may have any size."""
    length = _LENGTH_WITHOUT_PAYLOAD + len(payload)
    header = MESSAGE_HEADER.pack(Opcode.MESSAGE, length, channel_id, sequence & 0xFFFFFFFF, time_ns, time_ns)
    record = np.frombuffer(header + payload, f"V{len(header) + len(payload)}")
    return Block(channel_id, np.array([time_ns], np.int64), record)


def encode(*records: McapRecord) -> bytes:
    builder = RecordBuilder()
    for record in records:
        record.write(builder)
    return bytes(builder.end())  # type: ignore[no-untyped-call]  # mcap does not annotate it


def _footer(summary_start: int, offsets_start: int, summary: bytes) -> bytes:
    """Footer record with the checksum of the summary section, which covers the footer's own first fields."""
    start_of_footer = encode(Footer(summary_start, offsets_start, 0))[:-4]
    crc = zlib.crc32(start_of_footer, zlib.crc32(summary))
    return encode(Footer(summary_start, offsets_start, crc))


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
        self._summary: dict[Opcode, list[McapRecord]] = {opcode: [] for opcode in _SUMMARY_ORDER}
        self._counts: dict[int, int] = {}  # of messages by channel
        self._first_ns: int | None = None
        self._last_ns = 0
        self._write(MAGIC + encode(Header(profile, library)))

    def add_channel(self, topic: str, message_type: str, schema: bytes, metadata: dict[str, str]) -> int:
        """Add a channel of protobuf messages with its schema; returns its id."""
        number = len(self._counts) + 1
        schema_record = Schema(id=number, name=message_type, encoding="protobuf", data=schema)
        channel = Channel(id=number, topic=topic, message_encoding="protobuf", schema_id=number, metadata=metadata)
        self._summary[Opcode.SCHEMA].append(schema_record)
        self._summary[Opcode.CHANNEL].append(channel)
        self._counts[number] = 0
        self._write(encode(schema_record, channel))
        return number

    def add_attachment(self, name: str, media_type: str, data: bytes) -> None:
        record = encode(Attachment(create_time=0, log_time=0, name=name, media_type=media_type, data=data))
        place = {"offset": self.size, "length": len(record), "create_time": 0, "log_time": 0, "data_size": len(data)}
        self._summary[Opcode.ATTACHMENT_INDEX].append(AttachmentIndex(**place, name=name, media_type=media_type))
        self._write(record)

    def add_metadata(self, name: str, metadata: dict[str, str]) -> None:
        record = encode(Metadata(name=name, metadata=metadata))
        self._summary[Opcode.METADATA_INDEX].append(MetadataIndex(offset=self.size, length=len(record), name=name))
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
        chunk = Chunk(
            compression=ZSTD,
            data=compressed,
            message_start_time=first,
            message_end_time=last,
            uncompressed_crc=zlib.crc32(content),
            uncompressed_size=len(content),
        )
        record = encode(chunk)
        indexes = _message_indexes(blocks)
        ends = np.cumsum([self.size + len(record), *map(len, indexes.values())]).tolist()
        chunk_index = ChunkIndex(
            chunk_start_offset=self.size,
            chunk_length=len(record),
            compression=ZSTD,
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
        self._write(encode(DataEnd(self.crc)))
        start, summary, offsets = self.size, b"", []
        self._summary[Opcode.STATISTICS] = [self._statistics()]
        for opcode, records in self._summary.items():
            group = encode(*records)
            if group:
                offsets.append(SummaryOffset(opcode, start + len(summary), len(group)))
            summary += group
        offsets_start = start + len(summary)
        summary += encode(*offsets)
        self._write(summary + _footer(start, offsets_start, summary) + MAGIC)

    def _statistics(self) -> Statistics:
        return Statistics(
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
