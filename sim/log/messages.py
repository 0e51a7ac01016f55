"""Messages inside an MCAP chunk: blocks of equal size as NumPy arrays.

The writer lays the messages of a topic side by side, so that a chunk is a few runs of equally long records
and both ways are array operations. Other tools may reorder them: a run may be as short as one message.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass

import numpy as np
from mcap.opcode import Opcode
from numpy.typing import NDArray

from maxq.control.kernel.records import IntArray
from maxq.sim.log.mcap_records import RECORD_PREFIX, DamagedError

_HEADER = struct.Struct("<BQHIQQ")  # opcode, length, channel, sequence, log time, publish time
_KIND = struct.Struct("<BQH")  # the part of the header that all messages of a run share
_LENGTH_WITHOUT_PAYLOAD = _HEADER.size - RECORD_PREFIX.size
_FIRST_LOOK = 64


@dataclass(frozen=True)
class Run:
    """`count` messages of one channel, each `size` bytes with header, from `start` on."""

    start: int
    count: int
    size: int


@dataclass(frozen=True)
class Block:
    """Messages of one channel, ready for a chunk: `times_ns` (n,) and their records of equal size."""

    channel_id: int
    times_ns: IntArray
    records: NDArray[np.void]


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
    header = _HEADER.pack(
        Opcode.MESSAGE,
        _LENGTH_WITHOUT_PAYLOAD + len(payload),
        channel_id,
        sequence & 0xFFFFFFFF,
        time_ns,
        time_ns,
    )
    record = np.frombuffer(header + payload, f"V{len(header) + len(payload)}")
    return Block(channel_id, np.array([time_ns], np.int64), record)


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
            if size < _HEADER.size:
                raise DamagedError("a message is too short")
            count = _run_length(content, position, size)
            channel_id = _KIND.unpack_from(content, position)[2]
            runs.setdefault(channel_id, []).append(Run(position, count, size))
        position += count * size
    return runs


def _run_length(content: bytes, start: int, size: int) -> int:
    """How many records from `start` on have the same opcode, length and channel.

    Looks at ever more records at once: short runs are common in files that other tools have rewritten.
    """
    kind = content[start : start + _KIND.size]
    count, look = 1, _FIRST_LOOK
    while True:
        position = start + count * size
        look = min(look, (len(content) - position) // size)
        if look == 0 or content[position : position + _KIND.size] != kind:
            return count
        rows = np.frombuffer(content, np.uint8, look * size, position).reshape(look, size)
        same = (rows[:, : _KIND.size] == np.frombuffer(kind, np.uint8)).all(axis=1)
        if not same.all():
            return count + int(same.argmin())
        count, look = count + look, 8 * look


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
    return [content[s + _HEADER.size : s + size] for s, size in zip(starts, sizes, strict=True)]
