"""MCAP records as bytes: writing them, walking over them, and taking them apart when the file may be damaged.

The record classes are those of the `mcap` package; its readers give up at the first flaw of a file, so
finding records in a damaged file is done here. Format: MCAP specification, https://mcap.dev/spec.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from io import BytesIO
from typing import NamedTuple, Protocol, TypeVar

import zstandard
from mcap.data_stream import ReadDataStream, RecordBuilder
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Chunk, ChunkIndex, Footer, McapRecord

MAGIC = b"\x89MCAP0\r\n"
RECORD_PREFIX = struct.Struct("<BQ")  # opcode, length of the content
ZSTD = "zstd"

_FOOTER_SIZE = RECORD_PREFIX.size + 20
_LAST_OPCODE = max(Opcode)


class DamagedError(ValueError):
    """A record's bytes do not make sense."""


class Frame(NamedTuple):
    """Place of one record: `start` of the opcode, `body` of the content, `end` behind it (byte offsets)."""

    opcode: int
    start: int
    body: int
    end: int


RecordType_co = TypeVar("RecordType_co", covariant=True)


class _Content(ReadDataStream):
    """A record content that ends: mcap's stream gives what is there when asked for more."""

    def read(self, length: int) -> bytes:
        data: bytes = super().read(length)
        if len(data) < length:
            raise DamagedError("its content is cut off")
        return data


class _RecordClass(Protocol[RecordType_co]):
    @staticmethod
    def read(stream: ReadDataStream) -> RecordType_co: ...


def encode(*records: McapRecord) -> bytes:
    builder = RecordBuilder()
    for record in records:
        record.write(builder)
    return bytes(builder.end())  # type: ignore[no-untyped-call]  # mcap does not annotate it


def frames(data: bytes, start: int, end: int) -> Iterator[Frame]:
    """Whole records from `start` on; ends before the first that is cut off or has an impossible opcode."""
    while start + RECORD_PREFIX.size <= end:
        opcode, length = RECORD_PREFIX.unpack_from(data, start)
        body = start + RECORD_PREFIX.size
        if not 0 < opcode <= _LAST_OPCODE or body + length > end:
            return
        yield Frame(opcode, start, body, body + length)
        start = body + length


def parse(kind: _RecordClass[RecordType_co], data: bytes, frame: Frame) -> RecordType_co:
    """The record in a frame. Raises DamagedError where its content is not one."""
    try:
        return kind.read(_Content(BytesIO(data[frame.body : frame.end])))
    except (McapError, struct.error, UnicodeDecodeError, OverflowError, MemoryError) as error:
        raise DamagedError("its content cannot be read") from error


def chunk_content(data: bytes, frame: Frame) -> bytes:
    """Decompressed and checked content of a chunk. Raises DamagedError."""
    if frame.opcode != Opcode.CHUNK:
        raise DamagedError("its first byte is wrong")
    chunk = parse(Chunk, data, frame)
    content: bytes = chunk.data
    if chunk.compression == ZSTD:
        content = _decompress(chunk.data, chunk.uncompressed_size)
    elif chunk.compression:
        raise DamagedError(f"unknown compression {chunk.compression!r}")
    if zlib.crc32(content) != chunk.uncompressed_crc:
        raise DamagedError("its checksum does not match")
    return content


def _decompress(data: bytes, size: int) -> bytes:
    """Decompress a zstd frame that must say of itself that it holds `size` bytes."""
    try:
        if zstandard.frame_content_size(data) != size:
            raise DamagedError("its size does not match")
        return zstandard.ZstdDecompressor().decompress(data)
    except (zstandard.ZstdError, MemoryError) as error:
        raise DamagedError("it cannot be decompressed") from error


def footer(summary_start: int, offsets_start: int, summary: bytes) -> bytes:
    """Footer record with the checksum of the summary section, which covers the footer's own first fields."""
    start_of_footer = encode(Footer(summary_start, offsets_start, 0))[:-4]
    crc = zlib.crc32(start_of_footer, zlib.crc32(summary))
    return encode(Footer(summary_start, offsets_start, crc))


def summary_frames(data: bytes) -> list[Frame] | None:
    """Records of the summary section, or None where it is missing or fails its checksum."""
    end = len(data) - len(MAGIC) - _FOOTER_SIZE
    if end < len(MAGIC) or not data.endswith(MAGIC):
        return None
    frame = Frame(data[end], end, end + RECORD_PREFIX.size, end + _FOOTER_SIZE)
    record = parse(Footer, data, frame)
    if not len(MAGIC) <= record.summary_start <= end:
        return None
    if zlib.crc32(data[record.summary_start : frame.end - 4]) != record.summary_crc:
        return None
    return list(frames(data, record.summary_start, end))


def chunk_frames(data: bytes, summary: list[Frame]) -> list[tuple[Frame, ChunkIndex]]:
    """Places of all chunks by the summary's chunk index. Raises DamagedError where an index is not one.

    The opcode and length that stand at a place are compared with the index: a chunk whose frame is damaged
    gets opcode 0.
    """
    places = []
    for entry in summary:
        if entry.opcode != Opcode.CHUNK_INDEX:
            continue
        index = parse(ChunkIndex, data, entry)
        start, end = index.chunk_start_offset, index.chunk_start_offset + index.chunk_length
        body = start + RECORD_PREFIX.size
        if body > end or end > len(data):
            raise DamagedError("a chunk index points outside the file")
        opcode, length = RECORD_PREFIX.unpack_from(data, start)
        places.append((Frame(opcode if body + length == end else 0, start, body, end), index))
    return places
