"""MCAP from bytes: walking over records, chunks and messages, also where the file is damaged.

The record classes are those of the `mcap` package; its readers give up at the first flaw of a file, so finding records
in a damaged file is done here. Our writer lays the messages of a topic side by side, so that a chunk is a few runs of
equally long records and both ways are array operations. Other tools may reorder them: a run may be as short as one
message. Format: MCAP specification, https://mcap.dev/spec.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from io import BytesIO
from typing import NamedTuple, TypeVar

import numpy as np
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Chunk, ChunkIndex, Footer
from numpy.typing import NDArray

MAGIC = b"\x89MCAP0\r\n"
ZSTD = "zstd"
RECORD_PREFIX = struct.Struct("<BQ")  # opcode, length of the content
MESSAGE_HEADER = struct.Struct("<BQHIQQ")  # opcode, length, channel, sequence, log time, publish time

_RUN_PREFIX = struct.Struct("<BQH")  # the part of the header that all messages of a run share
_FIRST_BLOCK = 64  # records compared at once at first
_FOOTER_SIZE = RECORD_PREFIX.size + 20
_LAST_OPCODE = max(Opcode)

Record = TypeVar("Record")


class DamagedError(ValueError):
    """A record's bytes do not make sense."""


class Frame(NamedTuple):
    """Place of one record: `start` of the opcode, `body` of the content, `end` behind it (byte offsets)."""

    opcode: int
    start: int
    body: int
    end: int


@dataclass(frozen=True)
class Run:
    """`count` messages of one channel, each `size` bytes with header, from `start` on."""

    start: int
    count: int
    size: int


class _Content(ReadDataStream):
    """A record content that ends: mcap's stream gives what is there when asked for more."""

    def read(self, length: int) -> bytes:
        data: bytes = super().read(length)
        if len(data) < length:
            raise DamagedError("its content is cut off")
        return data


def frames(data: bytes, start: int, end: int) -> Iterator[Frame]:
    """Whole records from `start` on; ends before the first that is cut off or has an impossible opcode."""
    while start + RECORD_PREFIX.size <= end:
        opcode, length = RECORD_PREFIX.unpack_from(data, start)
        body = start + RECORD_PREFIX.size
        if not 0 < opcode <= _LAST_OPCODE or body + length > end:
            return
        yield Frame(opcode, start, body, body + length)
        start = body + length


def parse(read: Callable[[ReadDataStream], Record], data: bytes, frame: Frame) -> Record:
    """The record in a frame by its class's `read`. Raises DamagedError where its content is not one."""
    try:
        return read(_Content(BytesIO(data[frame.body : frame.end])))
    except (McapError, struct.error, UnicodeDecodeError, OverflowError, MemoryError) as error:
        raise DamagedError("its content cannot be read") from error


def chunk_content(data: bytes, frame: Frame) -> bytes:
    """Decompressed and checked content of a chunk. Raises DamagedError."""
    if frame.opcode != Opcode.CHUNK:
        raise DamagedError("its first byte is wrong")
    chunk = parse(Chunk.read, data, frame)
    content: bytes = chunk.data
    if chunk.compression == ZSTD:
        try:
            if zstandard.frame_content_size(content) != chunk.uncompressed_size:
                raise DamagedError("its size does not match")
            content = zstandard.ZstdDecompressor().decompress(content)
        except (zstandard.ZstdError, MemoryError) as error:
            raise DamagedError("it cannot be decompressed") from error
    elif chunk.compression:
        raise DamagedError(f"unknown compression {chunk.compression!r}")
    if zlib.crc32(content) != chunk.uncompressed_crc:
        raise DamagedError("its checksum does not match")
    return content


def summary_frames(data: bytes) -> list[Frame] | None:
    """Records of the summary section, or None where it is missing or fails its checksum."""
    end = len(data) - len(MAGIC) - _FOOTER_SIZE
    if end < len(MAGIC) or not data.endswith(MAGIC):
        return None
    frame = Frame(data[end], end, end + RECORD_PREFIX.size, end + _FOOTER_SIZE)
    record = parse(Footer.read, data, frame)
    if not len(MAGIC) <= record.summary_start <= end:
        return None
    if zlib.crc32(data[record.summary_start : frame.end - 4]) != record.summary_crc:
        return None
    return list(frames(data, record.summary_start, end))


def chunk_frames(data: bytes, summary: list[Frame]) -> list[Frame]:
    """Places of all chunks by the summary's chunk index. Raises DamagedError where an index is not one.

    The opcode and length that stand at a place are compared with the index: a chunk whose frame is damaged
    gets opcode 0.
    """
    places = []
    for entry in summary:
        if entry.opcode != Opcode.CHUNK_INDEX:
            continue
        index = parse(ChunkIndex.read, data, entry)
        start, end = index.chunk_start_offset, index.chunk_start_offset + index.chunk_length
        body = start + RECORD_PREFIX.size
        if body > end or end > len(data):
            raise DamagedError("a chunk index points outside the file")
        opcode, length = RECORD_PREFIX.unpack_from(data, start)
        places.append(Frame(opcode if body + length == end else 0, start, body, end))
    return places


def message_dtype(payload: np.dtype[np.void]) -> np.dtype[np.void]:
    """Layout of a message record around a payload of fixed size."""
    return np.dtype(
        [
            ("opcode", "u1"),
            ("length", "<u8"),
            ("channel", "<u2"),
            ("sequence", "<u4"),
            ("log_time", "<u8"),
            ("publish_time", "<u8"),
            ("payload", payload),
        ]
    )


def message_runs(content: bytes) -> dict[int, list[Run]]:
    """Where the messages of each channel lie in the content of a chunk. Raises DamagedError."""
    runs: dict[int, list[Run]] = {}
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
            if size < MESSAGE_HEADER.size:
                raise DamagedError("a message is too short")
            count = _run_length(content, position, size)
            channel_id = _RUN_PREFIX.unpack_from(content, position)[2]
            runs.setdefault(channel_id, []).append(Run(position, count, size))
        position += count * size
    return runs


def _run_length(content: bytes, start: int, size: int) -> int:
    """How many records from `start` on have the same opcode, length and channel.

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


def gather(content: bytes, runs: list[Run], layout: np.dtype[np.void]) -> NDArray[np.void]:
    """The messages of one channel as an array of `layout`. Raises DamagedError if one has another size."""
    if any(run.size != layout.itemsize for run in runs):
        raise DamagedError("a message does not have the size of its schema")
    if len(runs) == 1:
        return np.frombuffer(content, layout, runs[0].count, runs[0].start)
    starts = np.concatenate([run.start + run.size * np.arange(run.count) for run in runs])
    gathered = np.frombuffer(content, np.uint8)[starts[:, None] + np.arange(layout.itemsize)]
    return gathered.view(layout).ravel()


def payloads(content: bytes, runs: list[Run]) -> list[bytes]:
    """The payload of each message of one channel."""
    starts = [run.start + i * run.size for run in runs for i in range(run.count)]
    sizes = [run.size for run in runs for _ in range(run.count)]
    return [content[s + MESSAGE_HEADER.size : s + size] for s, size in zip(starts, sizes, strict=True)]
