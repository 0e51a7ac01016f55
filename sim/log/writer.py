"""Writes the log of a flight: an MCAP file that Rerun, Foxglove and PlotJuggler open.

Equal input gives equal bytes (with the same releases of maxq and of the zstd library): a log's hash is a
regression test. Head first, so that a file cut off anywhere behind it can still be read and flown again;
then a chunk for each second of simulated time, or for each call where calls come more often; then the
summary.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from types import TracebackType

import numpy as np

from maxq.control.kernel.records import Array, IntArray
from maxq.sim.flight.channels import EVENTS_TOPIC, FRAMES_TOPIC, ChannelTable, Topic
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
from maxq.sim.log.head import (
    ABORTED,
    COMPLETE,
    CRC_KEY,
    END_METADATA,
    HEAD_METADATA,
    PROFILE,
    REASON_KEY,
    RUN_METADATA,
    STATUS_KEY,
    LogError,
    RunHead,
    maxq_version,
)
from maxq.sim.log.mcap_write import Block, Container, MessageBuffer, single_message
from maxq.sim.log.protobuf import doubles_template, message_type, metadata_of, put_values, schema_of

_NS_PER_S = 1_000_000_000


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
            self._container = Container(self.path, PROFILE, f"maxq {maxq_version()}")
        except OSError as error:
            raise _cannot_write(self.path, error) from error
        try:
            self._write_head(head)
        except OSError as error:
            self._container.close()
            raise _cannot_write(self.path, error) from error

    def _write_head(self, head: RunHead) -> None:
        container = self._container
        container.add_metadata(RUN_METADATA, head.full_metadata())
        self._buffers: dict[str, MessageBuffer] = {}
        self._channel_ids: dict[str, int] = {}
        for topic in self._table.topics:
            channel_id = container.add_channel(topic.name, message_type(topic), schema_of(topic), metadata_of(topic))
            self._channel_ids[topic.name] = channel_id
            self._buffers[topic.name] = MessageBuffer(channel_id, doubles_template(len(topic.channels)))
        self._events_id = container.add_channel(EVENTS_TOPIC, LOG_TYPE, LOG_SCHEMA, {})
        self._frames_id = container.add_channel(FRAMES_TOPIC, FRAMES_TYPE, FRAMES_SCHEMA, {})
        for attachment in head.attachments:
            container.add_attachment(attachment.name, attachment.media_type, attachment.data)
        container.add_metadata(HEAD_METADATA, {CRC_KEY: f"{container.crc:08x}"})

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
        taken = {STATUS_KEY, REASON_KEY}.intersection(result or {})
        if taken:
            raise ValueError(f"result key {sorted(taken)[0]!r} is set by the log writer")
        container = self._container
        if not container.usable:
            container.close()
            return
        status = {STATUS_KEY: COMPLETE}
        if error is not None:
            status = {STATUS_KEY: ABORTED, REASON_KEY: f"{type(error).__name__}: {error}"}
        try:
            container.add_metadata(END_METADATA, status | dict(sorted((result or {}).items())))
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
            _check_path(path)

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
        sequence = self._container.count(self._channel_ids[topic.name])
        block = self._buffers[topic.name].block(times, sequence)
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
                buffer = MessageBuffer(self._frames_id, frames_template(path.parent, path.child))
                block = buffer.block(times, sequence)
                put_frames(block.records["payload"], times, path.translation_m[some], path.rotation[some])
                blocks.append(block)
                sequence += len(times)
        return blocks


def _rows(seconds: IntArray, second: int) -> slice:
    """Rows of one second in sorted `seconds`."""
    return slice(*np.searchsorted(seconds, [second, second + 1]))


def _check_path(path: FramePath) -> None:
    n = len(path.times_ns)
    what = f"frame {path.child} in {path.parent}"
    _check_times(what, path.times_ns)
    if path.translation_m.shape != (n, 3) or path.rotation.shape != (n, 4):
        raise ValueError(f"{what}: translation must be ({n}, 3) and rotation ({n}, 4)")


def _check_times(what: str, times_ns: IntArray, earliest: int = 0) -> None:
    if times_ns.dtype != np.int64 or times_ns.ndim != 1:
        raise ValueError(f"{what}: times must be a one-dimensional array of int64")
    if len(times_ns) and (int(times_ns[0]) < earliest or bool((times_ns[1:] < times_ns[:-1]).any())):
        raise ValueError(f"{what}: times must not fall and must start at or after {earliest} ns")


def _cannot_write(path: Path, error: OSError) -> LogError:
    return LogError(f"{path}: the log cannot be written: {error.strerror or error}")
