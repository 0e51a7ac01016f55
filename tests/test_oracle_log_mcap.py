"""The `mcap` package and protobuf's parser read the same values from a log as maxq's reader."""

from __future__ import annotations

import struct
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zstandard
from example_log import EVENTS, FAST, FRAMES, HEAD, SLOW, TABLE, same_bits, write_example
from mcap.reader import NonSeekingReader, make_reader
from mcap.records import Chunk, MessageIndex, Metadata
from mcap.stream_reader import StreamReader
from mcap.summary import Summary
from mcap_messages import messages

import maxq
from maxq.sim.log.writer import Container, LogWriter, message_block


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("log") / "example.mcap"
    write_example(path)
    return path


def summary_of(path: Path) -> Summary:
    with path.open("rb") as file:
        summary = make_reader(file, validate_crcs=True).get_summary()
    assert summary is not None
    return summary


@pytest.mark.parametrize("topic", TABLE.topics, ids=lambda topic: topic.name)
def test_channels(path: Path, topic: Any) -> None:
    log = maxq.read(path)
    rows = list(messages(path, topic.name))
    assert [m.log_time for _, _, m, _ in rows] == log.time_ns(topic.name).tolist()
    assert [m.publish_time for _, _, m, _ in rows] == log.time_ns(topic.name).tolist()
    assert [m.sequence for _, _, m, _ in rows] == list(range(len(rows)))
    assert len(rows) == len((FAST if topic.group == "fast" else SLOW)[0])
    for channel in topic.channels:
        theirs = np.array([getattr(decoded, channel.name) for _, _, _, decoded in rows])
        assert same_bits(theirs, log[channel.name]), channel.name


def test_fields_of_a_message_have_the_names_of_the_channels(path: Path) -> None:
    schema, channel, _, decoded = next(messages(path, "/slosh/tank_1"))
    assert schema.name == "maxq.SloshTank1"
    assert [f.name for f in decoded.DESCRIPTOR.fields] == ["slosh_0_m", "slosh_1_m"]
    assert channel.metadata["field.slosh_1_m"] == '{"unit": "m", "frame": "", "description": "number 1"}'


def test_events(path: Path) -> None:
    rows = list(messages(path, "/events"))
    assert [m.log_time for _, _, m, _ in rows] == [event.time_ns for event in EVENTS]
    for (schema, _, _, decoded), event in zip(rows, EVENTS, strict=True):
        assert schema.name == "foxglove.Log"
        assert decoded.timestamp.seconds * 10**9 + decoded.timestamp.nanos == event.time_ns
        assert decoded.level == event.level
        assert (decoded.message, decoded.name) == (event.text, event.source)


def test_frames(path: Path) -> None:
    rows = list(messages(path, "/tf"))
    assert [m.log_time for _, _, m, _ in rows] == FRAMES.times_ns.tolist()
    for i, (schema, _, message, decoded) in enumerate(rows):
        assert schema.name == "foxglove.FrameTransforms"
        (transform,) = decoded.transforms
        assert transform.timestamp.seconds * 10**9 + transform.timestamp.nanos == message.log_time
        assert (transform.parent_frame_id, transform.child_frame_id) == ("I", "B")
        shift, turn = transform.translation, transform.rotation
        assert [shift.x, shift.y, shift.z] == FRAMES.translation_m[i].tolist()
        assert [turn.w, turn.x, turn.y, turn.z] == FRAMES.rotation[i].tolist()


def test_every_checksum_is_right_in_a_reader_that_goes_through_the_file(path: Path) -> None:
    with path.open("rb") as file:
        kinds = [type(record).__name__ for record in StreamReader(file, validate_crcs=True).records]
    n = 2 * len(FAST[0]) + 2 * len(SLOW[0]) + len(EVENTS)
    assert kinds.count("Message") == n
    assert kinds[-1] == "Footer"


def test_a_cut_file_gives_their_reader_every_whole_chunk(path: Path, tmp_path: Path) -> None:
    chunks = summary_of(path).chunk_indexes
    cut = chunks[2].chunk_start_offset + chunks[2].chunk_length // 2
    (tmp_path / "cut.mcap").write_bytes(path.read_bytes()[:cut])
    times = []
    with (tmp_path / "cut.mcap").open("rb") as file:
        reader = NonSeekingReader(file).iter_messages(["/truth"], log_time_order=False)
        with pytest.raises(Exception):  # noqa: B017, PT011 the mcap package raises different errors here
            times += [message.log_time for _, _, message in reader]
    log = maxq.read(tmp_path / "cut.mcap")
    assert len(log["truth_0_m"]) == 200


def test_the_summary_counts_what_is_there(path: Path) -> None:
    summary = summary_of(path)
    statistics = summary.statistics
    assert statistics is not None
    assert statistics.channel_message_counts == {
        1: len(FAST[0]),
        2: len(SLOW[0]),
        3: len(FAST[0]),
        4: len(EVENTS),
        5: len(SLOW[0]),
    }
    assert statistics.message_count == sum(statistics.channel_message_counts.values())
    assert (statistics.schema_count, statistics.channel_count, statistics.chunk_count) == (5, 5, 4)
    assert (statistics.attachment_count, statistics.metadata_count) == (2, 3)
    assert (statistics.message_start_time, statistics.message_end_time) == (0, int(FAST[0][-1]))
    with path.open("rb") as file:
        reader = make_reader(file)
        attachments = [(a.name, a.media_type, a.data) for a in reader.iter_attachments()]
        metadata = {m.name: m.metadata for m in reader.iter_metadata()}
    assert attachments == [(a.name, a.media_type, a.data) for a in HEAD.attachments]
    assert HEAD.metadata.items() <= metadata["run"].items()
    assert metadata["end"] == {"status": "complete"}


def test_message_indexes_point_to_their_messages(tmp_path: Path) -> None:
    """Each entry gives the time and offset in the chunk of a message of its channel, in order of time."""
    other = replace(FRAMES, parent="B", child="nozzle")
    with LogWriter(tmp_path / "a.mcap", TABLE, HEAD) as log:
        log.write_block({"fast": FAST, "slow": SLOW}, EVENTS, [FRAMES, other])
    content, n_entries, channels = b"", 0, set()
    with (tmp_path / "a.mcap").open("rb") as file:
        for record in StreamReader(file, emit_chunks=True).records:
            if isinstance(record, Chunk):
                content = zstandard.decompress(record.data)
            elif isinstance(record, MessageIndex):
                assert record.records == sorted(record.records, key=lambda entry: entry[0])
                for time_ns, offset in record.records:
                    header = struct.unpack_from("<BQHIQQ", content, offset)
                    assert (header[0], header[2], header[4]) == (0x05, record.channel_id, time_ns)
                n_entries += len(record.records)
                channels.add(record.channel_id)
    assert channels == {1, 2, 3, 4, 5}
    statistics = summary_of(tmp_path / "a.mcap").statistics
    assert statistics is not None
    assert n_entries == statistics.message_count == 2 * len(FAST[0]) + 3 * len(SLOW[0]) + len(EVENTS)


def test_a_log_in_order_of_time_from_another_tool_reads_the_same(path: Path, tmp_path: Path) -> None:
    """A log in the order that `mcap` tools write, in which topics alternate within a chunk, reads the same."""
    ours = maxq.read(path)
    other = Container(tmp_path / "other.mcap", "maxq", "another tool")
    summary = summary_of(path)
    with path.open("rb") as file:
        run = next(m for m in make_reader(file).iter_metadata() if m.name == "run")
        assert isinstance(run, Metadata)
        other.add_metadata("run", run.metadata)
        for number, channel in summary.channels.items():
            schema = summary.schemas[channel.schema_id]
            assert other.add_channel(channel.topic, schema.name, schema.data, channel.metadata) == number
        other.add_metadata("head", {"crc32": f"{other.crc:08x}"})
        file.seek(0)
        found = [message for _, _, message in make_reader(file).iter_messages()]
        for second in range(4):
            some = [m for m in found if m.log_time // 10**9 == second]
            payloads = [np.array([m.data], f"V{len(m.data)}") for m in some]
            pairs = zip(some, payloads, strict=True)
            other.add_chunk([message_block(m.channel_id, data, np.array([m.log_time])) for m, data in pairs])
    other.add_metadata("end", {"status": "complete"})
    other.finish()
    other.close()
    theirs = maxq.read(tmp_path / "other.mcap")
    assert theirs.complete
    assert theirs.events == ours.events
    for name in TABLE.names:
        assert np.array_equal(theirs.time_ns(name), ours.time_ns(name))
        assert same_bits(theirs[name], ours[name])
