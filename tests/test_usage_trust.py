"""Foreign logs and data sets cannot unpack to more than they declare, nor read files by their scenario."""

from __future__ import annotations

import io
import os
import struct
import zlib
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import zstandard
from example_log import TABLE, write_example
from lz4.frame import compress as lz4_compress
from mcap.data_stream import ReadDataStream
from mcap.reader import make_reader
from mcap.records import Chunk, ChunkIndex
from scenario_files import write_ascent

import maxq
from maxq import CampaignError, LogError, ScenarioError
from maxq.design.verify import ledger
from maxq.sim.campaign import store
from maxq.sim.files import plain_name
from maxq.sim.log import reader
from maxq.sim.log.head import Attachment, RunHead
from maxq.sim.log.writer import LogWriter
from maxq.sim.scenario.loader import load_scenario, load_scenario_text
from maxq.tools import simrun
from maxq.tools.cli.frame import CommandError
from maxq.tools.replay import flight
from maxq.tools.verify import check


def chunk(content: bytes, compression: str, packed: bytes, says: int | None = None) -> bytes:
    """Return an MCAP chunk record (opcode 0x06 of https://mcap.dev/spec)."""
    size = len(content) if says is None else says
    name = compression.encode()
    body = struct.pack("<QQQI", 0, 1, size, zlib.crc32(content)) + struct.pack("<I", len(name)) + name
    body += struct.pack("<Q", len(packed)) + packed
    return struct.pack("<BQ", 6, len(body)) + body


def first_chunk(log: bytes) -> ChunkIndex:
    summary = make_reader(io.BytesIO(log)).get_summary()
    assert summary is not None
    return min(summary.chunk_indexes, key=lambda index: index.chunk_start_offset)


def with_chunks(folder: Path, *chunks: bytes) -> Path:
    """Return the head of the example followed by these chunks, without the end of the file."""
    whole = write_example(folder / "example.mcap")
    path = folder / "made.mcap"
    path.write_bytes(whole[: first_chunk(whole).chunk_start_offset] + b"".join(chunks))
    return path


def own_chunk(folder: Path) -> bytes:
    """Return the content of the example's first chunk."""
    whole = write_example(folder / "example.mcap")
    index = first_chunk(whole)
    start = index.chunk_start_offset + 9  # behind opcode and length
    record = Chunk.read(ReadDataStream(io.BytesIO(whole[start : start + index.chunk_length - 9])))
    assert record.compression == "zstd"
    return zstandard.decompress(record.data)


PACKED = {"": lambda content: content, "zstd": zstandard.compress, "lz4": lz4_compress}


@pytest.mark.parametrize("compression", PACKED)
def test_chunks_of_every_compression_are_read(tmp_path: Path, compression: str) -> None:
    content = own_chunk(tmp_path)
    path = with_chunks(tmp_path, chunk(content, compression, PACKED[compression](content)))
    log = maxq.read(path)
    assert not [note for note in log.notes if "left out" in note]
    assert len(log.time_ns(TABLE.topics[0].name)) > 0


@pytest.mark.parametrize("compression", PACKED)
def test_a_chunk_that_is_larger_than_is_read(tmp_path: Path, compression: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(reader, "MOST_CHUNK_BYTES", 1_000_000)
    content = own_chunk(tmp_path)
    bomb = bytes(5_000_000)
    path = with_chunks(
        tmp_path,
        chunk(bomb, compression, PACKED[compression](bomb)),
        chunk(content, compression, PACKED[compression](content)),
    )
    log = maxq.read(path)
    said = "chunk 1 of 2 was left out: it declares a decompressed size of 5 MB; at most 1 MB are read"
    assert said in log.notes
    assert len(log.time_ns(TABLE.topics[0].name)) > 0  # the other one is there


@pytest.mark.parametrize("compression", PACKED)
def test_a_chunk_that_is_larger_than_it_says(tmp_path: Path, compression: str) -> None:
    bomb = bytes(50_000_000)
    path = with_chunks(tmp_path, chunk(bomb, compression, PACKED[compression](bomb), says=1000))
    assert any("chunk 1 of 1 was left out: " in note for note in maxq.read(path).notes)


def test_a_frame_that_claims_a_terabyte_takes_no_memory(tmp_path: Path) -> None:
    """The size in a frame's header is not trusted, since the decompressor would reserve it."""
    frame = b"\x28\xb5\x2f\xfd" + bytes([0b11100000]) + struct.pack("<Q", 1 << 40) + b"\x01\x00\x00"
    assert zstandard.frame_content_size(frame) == 1 << 40
    path = with_chunks(tmp_path, chunk(bytes(1000), "zstd", frame))
    assert "chunk 1 of 1 was left out: its size does not match" in maxq.read(path).notes


def test_a_frame_of_unknown_length(tmp_path: Path) -> None:
    bomb = bytes(50_000_000)
    packed = zstandard.ZstdCompressor(write_content_size=False).compress(bomb)
    path = with_chunks(tmp_path, chunk(bomb, "zstd", packed, says=1000))
    assert "chunk 1 of 1 was left out: it cannot be decompressed" in maxq.read(path).notes


def test_a_log_that_is_larger_than_is_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    content = own_chunk(tmp_path)
    path = with_chunks(tmp_path, *[chunk(content, "zstd", PACKED["zstd"](content))] * 20)
    maxq.read(path)
    monkeypatch.setattr(reader, "MOST_LOG_BYTES", 10 * len(content))
    with pytest.raises(LogError, match=r"made\.mcap: the log decompresses to more than 0 GB, the most that is read"):
        maxq.read(path)


# data sets


def test_a_part_that_is_larger_than_is_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "runs-0000000000-0000000009.parquet"
    pq.write_table(pa.table({"run": np.zeros(1_000_000, np.int64)}), path, use_dictionary=True)
    assert path.stat().st_size < 10_000
    assert len(store.read_part(path)) == 1_000_000
    monkeypatch.setattr(store, "MOST_BYTES", 1_000_000)
    with pytest.raises(CampaignError, match=r"decompresses to 0\.0 GB; 0.0 GB is the most that is read"):
        store.read_part(path)
    path.write_bytes(path.read_bytes()[:-50])
    with pytest.raises(CampaignError, match="it cannot be read"):
        store.read_part(path)


@pytest.mark.parametrize("spare", [-1, 0])
def test_texts_that_are_stored_once_and_decoded_for_each_row(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, spare: int
) -> None:
    """The file states the size of its dictionary: 2 kB instead of 1,000 rows of 2 kB. Numbers take 8 bytes."""
    path, text = tmp_path / "runs-0000000000-0000000999.parquet", "x" * 2000
    made = pa.table({"run": np.arange(1000), "cause": [text] * 999 + [None]})
    pq.write_table(made, path, use_dictionary=["cause"])
    assert path.stat().st_size < 14_000
    monkeypatch.setattr(store, "MOST_BYTES", 2 * 1000 * 8 + 999 * 2000 + spare)
    if spare < 0:
        with pytest.raises(CampaignError, match=r"decompresses to 0\.0 GB; 0.0 GB is the most that is read"):
            store.read_part(path)
    else:
        read = store.read_part(path)
        assert read.equals(made)
        assert read.schema.equals(made.schema)


def test_a_log_replaces_a_symbolic_link_and_not_the_file_behind_it(tmp_path: Path) -> None:
    victim, path = tmp_path / "victim", tmp_path / "flight.mcap"
    victim.write_text("mine")
    path.symlink_to(victim)
    LogWriter(path, TABLE, RunHead({})).close()
    assert victim.read_text() == "mine"
    assert not path.is_symlink()
    assert maxq.read(path).complete


@pytest.mark.skipif(os.name == "nt", reason="no locks")
def test_a_log_that_is_being_written_is_not_written_by_a_second_flight(tmp_path: Path) -> None:
    path = tmp_path / "flight.mcap"
    first = LogWriter(path, TABLE, RunHead({"scenario": "first"}))
    with pytest.raises(LogError, match=r"flight\.mcap: another flight is writing this log; wait for it, or give"):
        LogWriter(path, TABLE, RunHead({"scenario": "second"}))
    first.close()
    assert maxq.read(path).metadata["scenario"] == "first"
    LogWriter(path, TABLE, RunHead({"scenario": "third"})).close()
    assert maxq.read(path).metadata["scenario"] == "third"


# a log's own scenario


def log_with(folder: Path, scenario: str) -> Path:
    path = folder / "flight.mcap"
    writer = LogWriter(path, TABLE, RunHead({}, (Attachment("scenario.toml", "application/toml", scenario.encode()),)))
    writer.close(None, None)
    return path


NAMES = ("../../etc/passwd", "/etc/passwd", "ascent.toml", "nominal", "vehicles/rocket", "winds/west.csv", "tank.csv")
PLACES = (
    'extends = "{}"\n',
    'vehicle = "{}"\n',
    'design = "{}"\n',
    "[vehicle]\nextends = '{}'\n",
    "[design]\nextends = '{}'\n",
    'vehicle_overrides = {{extends = "{}"}}\nvehicle = {{}}\n',
    '[wind]\nprofile = "{}"\n',
    '[atmosphere]\nmodel = "table"\ntable = "{}"\n',
    '[guidance]\nprogramme = "{}"\n',
)


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("place", PLACES)
def test_a_scenario_in_a_log_reads_no_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], place: str, name: str
) -> None:
    """The scenario reads no file next to the log, in the working folder, among the built-in ones or elsewhere."""
    monkeypatch.chdir(tmp_path)
    write_ascent(tmp_path)
    whole = load_scenario("ascent.toml").as_flown
    given = place.format(name)
    key = given.split(" ", 1)[0].strip("[]\n")
    keep = key in ("wind", "guidance", "atmosphere")
    text = "\n".join(f"[{part}" for part in whole.split("\n[") if not part.startswith(key)) if keep else ""
    text = text.removeprefix("[") + "\n" + given if keep else given
    opened: list[Path] = []
    real = Path.read_bytes
    monkeypatch.setattr(Path, "read_bytes", lambda path: (opened.append(path), real(path))[1])
    with pytest.raises(
        ScenarioError, match=r"cannot do|self-contained|no such key|unknown key|has no|required key|in a file only"
    ):
        load_scenario_text(text)
    assert opened == []
    log = log_with(tmp_path, text)
    assert simrun.main(["--from", str(log)]) == 2
    assert {path.name for path in opened} <= {"flight.mcap"}
    said = capsys.readouterr().err
    assert "root:" not in said
    assert said.count("\n") == 1


def test_attachments_are_never_unpacked(tmp_path: Path) -> None:
    path = tmp_path / "deep" / "flight.mcap"
    path.parent.mkdir()
    odd = Attachment("../../out.toml", "application/toml", b"x = 1")
    LogWriter(path, TABLE, RunHead({}, (odd,))).close(None, None)
    assert "../../out.toml" in maxq.read(path).attachments
    assert [p.name for p in tmp_path.rglob("*")] == ["deep", "flight.mcap"]


@pytest.mark.parametrize(
    ("name", "folder"),
    [
        ("../../etc", "etc"),
        ("..", "else"),
        ("", "else"),
        ("a/b\\c:d", "a-b-c-d"),
        ("x" * 300, "x" * 80),
        ("é 1.2", "é-1.2"),
    ],
)
def test_names_make_one_folder(name: str, folder: str) -> None:
    assert plain_name(name, "else") == folder


def test_json_that_is_nested_without_end_is_refused_or_ignored(tmp_path: Path) -> None:
    """The files of others: of a campaign, next to a log, of a ledger, and of a review pack."""
    deep = "[" * 100_000
    for text in (deep, "[]"):
        (tmp_path / "campaign.json").write_text(text)
        with pytest.raises(CampaignError, match=r"campaign\.json: is damaged; remove it and the runs"):
            store.read_manifest(tmp_path)
    (tmp_path / "summary.json").write_text(deep)
    log: Any = SimpleNamespace(path=tmp_path / "flight.mcap", end={})
    assert flight._summary(log) == {}
    (tmp_path / "attempts.jsonl").write_text(deep + "\n")
    assert ledger.read_lines(tmp_path / "attempts.jsonl") == ([], ("line 1 is no line of a ledger",))
    (tmp_path / "verdict.json").write_text(deep)
    with pytest.raises(CommandError, match=r"verdict\.json: is not JSON: "):
        check.execute(str(tmp_path))
