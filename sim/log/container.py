"""An MCAP file that grows chunk by chunk and is readable up to the last of them at any time."""

from __future__ import annotations

import io
import struct
import zlib
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import zstandard
from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Channel,
    Chunk,
    ChunkIndex,
    DataEnd,
    Header,
    McapRecord,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)
from numpy.typing import NDArray

from maxq.sim.log.mcap_records import MAGIC, ZSTD, encode, footer
from maxq.sim.log.messages import Block

_LEVEL = 1  # numbers full of noise hardly compress: higher levels cost more time than they save space
_INDEX_HEADER = struct.Struct("<BQHI")  # opcode, length, channel, bytes of entries


class Container:
    """Writes records in order, keeps what the summary will need, hands every chunk to the system.

    Nothing in the file comes from the clock or the machine. `usable` is False after an error in the middle
    of a chunk: what follows it could not be found, so nothing more must be written.
    """

    def __init__(self, path: Path, profile: str, library: str) -> None:
        self._file = io.FileIO(path, "w")  # not buffered: what is written survives the end of this process
        self.usable = True
        self.size = 0
        self.crc = 0  # of all bytes so far; the data section ends with it
        self._compressor = zstandard.ZstdCompressor(level=_LEVEL)
        self._schemas: list[McapRecord] = []
        self._channels: list[McapRecord] = []
        self._chunk_indexes: list[McapRecord] = []
        self._attachment_indexes: list[McapRecord] = []
        self._metadata_indexes: list[McapRecord] = []
        self._counts: dict[int, int] = {}
        self._first_ns: int | None = None
        self._last_ns = 0
        self._write(MAGIC + encode(Header(profile, library)))

    def add_channel(self, topic: str, message_type: str, schema: bytes, metadata: dict[str, str]) -> int:
        """Add a channel of protobuf messages with its schema; returns its id."""
        number = len(self._channels) + 1
        self._schemas.append(Schema(id=number, name=message_type, encoding="protobuf", data=schema))
        self._channels.append(
            Channel(id=number, topic=topic, message_encoding="protobuf", schema_id=number, metadata=metadata)
        )
        self._counts[number] = 0
        self._write(encode(self._schemas[-1], self._channels[-1]))
        return number

    def add_attachment(self, name: str, media_type: str, data: bytes) -> None:
        record = encode(Attachment(create_time=0, log_time=0, name=name, media_type=media_type, data=data))
        index = AttachmentIndex(
            offset=self.size,
            length=len(record),
            create_time=0,
            log_time=0,
            data_size=len(data),
            name=name,
            media_type=media_type,
        )
        self._attachment_indexes.append(index)
        self._write(record)

    def add_metadata(self, name: str, metadata: dict[str, str]) -> None:
        record = encode(Metadata(name=name, metadata=metadata))
        self._metadata_indexes.append(MetadataIndex(offset=self.size, length=len(record), name=name))
        self._write(record)

    def count(self, channel_id: int) -> int:
        """Messages of a channel so far."""
        return self._counts[channel_id]

    def add_chunk(self, blocks: Sequence[Block]) -> None:
        """Add one chunk of messages and its message indexes."""
        self.usable = False
        content = b"".join([block.records.tobytes() for block in blocks])
        first = min(int(block.times_ns.min()) for block in blocks)
        last = max(int(block.times_ns.max()) for block in blocks)
        chunk = Chunk(
            compression=ZSTD,
            data=self._compressor.compress(content),
            message_start_time=first,
            message_end_time=last,
            uncompressed_crc=zlib.crc32(content),
            uncompressed_size=len(content),
        )
        record = encode(chunk)
        indexes = _message_indexes(blocks)
        offsets, position = {}, self.size + len(record)
        for channel_id, index in indexes.items():
            offsets[channel_id] = position
            position += len(index)
        chunk_index = ChunkIndex(
            chunk_start_offset=self.size,
            chunk_length=len(record),
            compression=ZSTD,
            compressed_size=len(chunk.data),
            uncompressed_size=len(content),
            message_start_time=first,
            message_end_time=last,
            message_index_offsets=offsets,
            message_index_length=position - self.size - len(record),
        )
        self._write(b"".join([record, *indexes.values()]))
        self._chunk_indexes.append(chunk_index)
        for block in blocks:
            self._counts[block.channel_id] += len(block.times_ns)
        self._first_ns = first if self._first_ns is None else min(self._first_ns, first)
        self._last_ns = max(self._last_ns, last)
        self.usable = True

    def finish(self) -> None:
        """Write the end of the data section and the summary."""
        self._write(encode(DataEnd(self.crc)))
        start = self.size
        statistics = Statistics(
            attachment_count=len(self._attachment_indexes),
            channel_count=len(self._channels),
            channel_message_counts=self._counts,
            chunk_count=len(self._chunk_indexes),
            message_count=sum(self._counts.values()),
            message_start_time=self._first_ns or 0,
            message_end_time=self._last_ns,
            metadata_count=len(self._metadata_indexes),
            schema_count=len(self._schemas),
        )
        groups: list[tuple[Opcode, list[McapRecord]]] = [
            (Opcode.SCHEMA, self._schemas),
            (Opcode.CHANNEL, self._channels),
            (Opcode.STATISTICS, [statistics]),
            (Opcode.CHUNK_INDEX, self._chunk_indexes),
            (Opcode.ATTACHMENT_INDEX, self._attachment_indexes),
            (Opcode.METADATA_INDEX, self._metadata_indexes),
        ]
        summary, offsets = b"", []
        for opcode, records in groups:
            group = encode(*records)
            if group:
                offsets.append(SummaryOffset(opcode, start + len(summary), len(group)))
            summary += group
        offsets_start = start + len(summary)
        summary += encode(*offsets)
        self._write(summary + footer(start, offsets_start, summary) + MAGIC)

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
        size = block.records.dtype.itemsize
        rows = np.empty((len(block.times_ns), 2), "<u8")
        rows[:, 0] = block.times_ns
        rows[:, 1] = position + size * np.arange(len(rows))
        entries.setdefault(block.channel_id, []).append(rows)
        position += size * len(rows)
    records = {}
    for channel_id, parts in entries.items():
        rows = parts[0] if len(parts) == 1 else np.concatenate(parts)
        if len(parts) > 1:
            rows = rows[np.argsort(rows[:, 0], kind="stable")]
        data = rows.tobytes()
        records[channel_id] = _INDEX_HEADER.pack(Opcode.MESSAGE_INDEX, 6 + len(data), channel_id, len(data)) + data
    return records
