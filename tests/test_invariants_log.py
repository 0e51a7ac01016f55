"""A log keeps these properties under all circumstances.

- The data read are the data written, bit for bit, for any division into blocks.
- Equal input gives equal bytes.
- A file cut at any byte gives every whole chunk; a damaged chunk costs only that chunk; both are noted.
- No bytes make the reader raise an exception other than LogError.
"""

from __future__ import annotations

import bisect
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from example_log import EVENTS, FAST, FRAMES, HEAD, SECOND, SLOW, TABLE, holds_exactly, same_bits, write_example
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap.records import ChunkIndex

import maxq
from maxq import Log, LogError
from maxq.sim.flight.channels import Channel, ChannelTable, Topic
from maxq.sim.log.head import RunHead
from maxq.sim.log.messages import EventMessage, Level
from maxq.sim.log.writer import LogWriter

SECONDS = [0, 1, 2, 3]
on_one_file = settings(suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None)


@pytest.fixture(scope="module")
def example(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    return write_example(tmp_path_factory.mktemp("log") / "example.mcap")


@pytest.fixture(scope="module")
def chunks(tmp_path_factory: pytest.TempPathFactory) -> list[ChunkIndex]:
    """Return the places of the chunks according to the mcap package."""
    path = tmp_path_factory.mktemp("log") / "example.mcap"
    write_example(path)
    with path.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    return summary.chunk_indexes


def read_bytes(folder: Path, data: bytes) -> Log:
    path = folder / "some.mcap"
    path.write_bytes(data)
    return maxq.read(path)


def test_what_is_read_is_what_was_written(tmp_path: Path) -> None:
    write_example(tmp_path / "a.mcap")
    log = maxq.read(tmp_path / "a.mcap")
    assert log.complete
    assert log.notes == ()
    assert holds_exactly(log, SECONDS)
    assert log.attachments == {a.name: a for a in HEAD.attachments}
    assert HEAD.metadata.items() <= log.metadata.items()
    assert np.array_equal(log.time_s("alpha_deg"), SLOW[0] / 1e9)


def test_units_and_frames_travel_with_the_log(tmp_path: Path) -> None:
    write_example(tmp_path / "a.mcap")
    table = maxq.read(tmp_path / "a.mcap").table
    assert table.groups == TABLE.groups
    assert [t.description for t in table.topics] == [t.description for t in TABLE.topics]
    for name in TABLE.names:
        ours, read = TABLE.channel(name), table.channel(name)
        assert (read.name, read.unit, read.frame, read.description) == (
            ours.name,
            ours.unit,
            ours.frame,
            ours.description,
        )


@on_one_file
@given(cuts=st.lists(st.integers(0, 3_250_000_000), max_size=8))
def test_blocks_of_any_length_give_the_same_arrays(tmp_path: Path, cuts: list[int]) -> None:
    with LogWriter(tmp_path / "a.mcap", TABLE, HEAD) as log:
        for start, stop in pairwise([0, *sorted(cuts), 4 * SECOND]):
            groups = {}
            for name, (times, values) in {"fast": FAST, "slow": SLOW}.items():
                rows = slice(*np.searchsorted(times, [start, stop]))
                groups[name] = (times[rows], values[rows])
            log.write_block(groups, [e for e in EVENTS if start <= e.time_ns < stop])
    assert holds_exactly(maxq.read(tmp_path / "a.mcap"), SECONDS)


def test_equal_input_gives_equal_bytes(tmp_path: Path) -> None:
    backwards = RunHead(dict(reversed(HEAD.metadata.items())), HEAD.attachments)
    assert write_example(tmp_path / "a.mcap") == write_example(tmp_path / "b.mcap", backwards)


def test_what_is_written_can_be_read_before_the_log_is_closed(tmp_path: Path) -> None:
    log = LogWriter(tmp_path / "a.mcap", TABLE, HEAD)
    log.write_block({"fast": FAST, "slow": SLOW}, EVENTS)
    read = maxq.read(tmp_path / "a.mcap")
    log.close()
    assert holds_exactly(read, SECONDS)
    assert not read.complete


@pytest.mark.slow
def test_a_file_cut_anywhere_gives_every_whole_chunk(tmp_path: Path, example: bytes, chunks: list[ChunkIndex]) -> None:
    starts = [chunk.chunk_start_offset for chunk in chunks]
    ends = [chunk.chunk_start_offset + chunk.chunk_length for chunk in chunks]
    edges = [0, 8, *starts, *ends, len(example)]
    near_edges = {edge + shift for edge in edges for shift in range(-12, 13)}
    cuts = sorted((near_edges | set(range(0, len(example), 97))) & set(range(len(example))))
    for cut in cuts:
        if cut < starts[0]:
            with pytest.raises(LogError):
                read_bytes(tmp_path, example[:cut])
            continue
        log = read_bytes(tmp_path, example[:cut])
        assert holds_exactly(log, SECONDS[: bisect.bisect_right(ends, cut)]), cut
        assert not log.complete
        assert log.attachments == {a.name: a for a in HEAD.attachments}


def test_a_damaged_chunk_is_left_out_and_noted(tmp_path: Path, example: bytes, chunks: list[ChunkIndex]) -> None:
    for number, chunk in enumerate(chunks):
        # Opcode and length of the record, start of the sizes and checksum, and the compressed data
        places = [*range(9), 25, 33, 37, 49, *range(60, chunk.chunk_length, 211), chunk.chunk_length - 1]
        for place in places:
            data = bytearray(example)
            data[chunk.chunk_start_offset + place] ^= 0x20
            log = read_bytes(tmp_path, bytes(data))
            rest = SECONDS[:number] + SECONDS[number + 1 :]
            assert holds_exactly(log, rest), (number, place)
            assert not log.complete
            assert f"chunk {number + 1} of {len(chunks)} was left out" in log.notes[0]


@on_one_file
@given(place=st.integers(0, 10**9), mask=st.integers(1, 255))
def test_no_flipped_byte_goes_unnoticed(tmp_path: Path, example: bytes, place: int, mask: int) -> None:
    data = bytearray(example)
    data[place % len(data)] ^= mask
    try:
        log = read_bytes(tmp_path, bytes(data))
    except LogError:
        return
    assert log.notes or holds_exactly(log, SECONDS)
    assert log.complete == (not log.notes)


@pytest.mark.slow
def test_every_flipped_byte_of_the_head_is_noticed(tmp_path: Path, example: bytes, chunks: list[ChunkIndex]) -> None:
    for place in range(0, chunks[0].chunk_start_offset, 5):
        data = bytearray(example)
        data[place] ^= 0x04
        try:
            log = read_bytes(tmp_path, bytes(data))
        except LogError:
            continue
        assert log.notes, place


def test_a_damaged_summary_costs_no_data(tmp_path: Path, example: bytes) -> None:
    for place in (1, 8, 9, 20, 30, 100):
        data = bytearray(example)
        data[-place] ^= 0x01
        log = read_bytes(tmp_path, bytes(data))
        assert holds_exactly(log, SECONDS), place
        assert not log.complete


@on_one_file
@given(garbage=st.binary(max_size=300), start=st.sampled_from([b"", b"\x89MCAP0\r\n"]))
def test_garbage_raises_log_error_only(tmp_path: Path, garbage: bytes, start: bytes) -> None:
    with pytest.raises(LogError, match=r"some\.mcap"):
        read_bytes(tmp_path, start + garbage)


@on_one_file
@given(places=st.lists(st.integers(0, 10**9), min_size=2, max_size=2), garbage=st.binary(max_size=80))
def test_a_log_with_garbage_in_it_raises_log_error_only(
    tmp_path: Path, example: bytes, places: list[int], garbage: bytes
) -> None:
    first, second = sorted(place % len(example) for place in places)
    try:
        log = read_bytes(tmp_path, example[:first] + garbage + example[second:])
    except LogError:
        return
    assert log.notes or holds_exactly(log, SECONDS)


def test_an_empty_log_is_a_log(tmp_path: Path) -> None:
    with LogWriter(tmp_path / "a.mcap", TABLE, RunHead()):
        pass
    log = maxq.read(tmp_path / "a.mcap")
    assert log.complete
    assert holds_exactly(log, [])
    with LogWriter(tmp_path / "b.mcap", ChannelTable(()), RunHead()) as writer:
        writer.write_block({})
    assert maxq.read(tmp_path / "b.mcap").table == ChannelTable(())


def test_times_up_to_the_last_nanosecond(tmp_path: Path) -> None:
    table = ChannelTable((Topic("/a", "fast", (Channel("b", "1", "", ""),)),))
    times = np.array([0, 1, SECOND - 1, SECOND, 2**53 + 1, 2**63 - 1])
    event = EventMessage(2**63 - 1, Level.ERROR, "end of time")
    with LogWriter(tmp_path / "a.mcap", table, RunHead()) as writer:
        writer.write_block({"fast": (times, np.arange(6.0)[:, None])}, [event])
    log = maxq.read(tmp_path / "a.mcap")
    assert np.array_equal(log.time_ns("b"), times)
    assert same_bits(log["b"], np.arange(6.0))
    assert log.events == (event,)


def test_a_run_that_fails_leaves_a_whole_file_that_says_so(tmp_path: Path) -> None:
    def fly() -> None:
        with LogWriter(tmp_path / "a.mcap", TABLE, HEAD) as log:
            log.write_block({"fast": FAST, "slow": SLOW}, EVENTS, [FRAMES])
            raise RuntimeError("state is not finite")

    with pytest.raises(RuntimeError):
        fly()
    log = maxq.read(tmp_path / "a.mcap")
    assert holds_exactly(log, SECONDS)
    assert log.notes == ("the run was aborted: RuntimeError: state is not finite",)
    assert not log.complete
