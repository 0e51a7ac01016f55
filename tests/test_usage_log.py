"""The log rejects wrong channel tables, wrong arrays and wrong files."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Annotated, NamedTuple

import numpy as np
import pytest
from example_log import FAST, HEAD, SECOND, SLOW, TABLE, write_example
from mcap.writer import Writer
from numba import njit
from replaykit import OLD_LOG

import maxq
from maxq import LogError
from maxq.control.kernel.jit import entry
from maxq.control.kernel.records import Array
from maxq.control.kernel.rows import NorthEastDown, PitchYaw, put
from maxq.sim.flight.channels import Channel, ChannelTable, Topic, declared_channels, unit_suffix
from maxq.sim.flight.telemetry import channel_table
from maxq.sim.log.head import Attachment, RunHead
from maxq.sim.log.messages import EventMessage, FramePath, Level, doubles_template
from maxq.sim.log.writer import LogWriter
from maxq.sim.vehicle.state import Sizes
from maxq.tools.dev.documents.reference import topics_markdown

MOST_FIELDS = 2047  # from field 2048 on, a tag takes three bytes

ALPHA = Channel("alpha_deg", "deg", "", "angle of attack")


@pytest.mark.parametrize(
    ("unit", "suffix"),
    [("m", "m"), ("rad/s", "radps"), ("m/s^2", "mps2"), ("N m", "Nm"), ("1/s", "ps"), ("1", ""), ("%", "pct")],
)
def test_unit_suffix(unit: str, suffix: str) -> None:
    assert unit_suffix(unit) == suffix


@pytest.mark.parametrize(
    ("name", "unit", "frame", "what"),
    [
        ("alpha", "deg", "", "ends with _deg"),
        ("alpha_rad", "deg", "", "ends with _deg"),
        ("v_I_x_mps", "m/s", "B", "frame B"),
        ("2nd_mode_m", "m", "", "letters, digits"),
        ("mode m", "m", "", "letters, digits"),
        ("mach", "", "", "unit is missing"),
    ],
)
def test_a_channel_name_carries_unit_and_frame(name: str, unit: str, frame: str, what: str) -> None:
    with pytest.raises(ValueError, match=what):
        Channel(name, unit, frame, "")


def test_a_unit_may_stand_in_lower_case() -> None:
    assert Channel("thrust_n", "N", "", "").name == "thrust_n"
    assert Channel("thrust_N", "N", "", "").name == "thrust_N"


@pytest.mark.parametrize(
    ("name", "group", "channels", "what"),
    [
        ("truth", "fast", (ALPHA,), "looks like"),
        ("/Truth", "fast", (ALPHA,), "looks like"),
        ("/events", "fast", (ALPHA,), "the log's own"),
        ("/truth", "", (ALPHA,), "rate group"),
        ("/truth", "fast", (), "no channels"),
    ],
)
def test_a_bad_topic_is_refused(name: str, group: str, channels: tuple[Channel, ...], what: str) -> None:
    with pytest.raises(ValueError, match=what):
        Topic(name, group, channels)


def test_nothing_is_named_twice() -> None:
    with pytest.raises(ValueError, match="channel named twice: alpha_deg"):
        ChannelTable((Topic("/a", "fast", (ALPHA,)), Topic("/b", "slow", (ALPHA,))))
    with pytest.raises(ValueError, match="topic named twice: /a"):
        ChannelTable((Topic("/a", "fast", (ALPHA,)), Topic("/a", "fast", (Channel("b", "1", "", ""),))))
    with pytest.raises(ValueError, match="message named twice: AB"):
        ChannelTable((Topic("/a_b", "fast", (ALPHA,)), Topic("/a/b", "fast", (Channel("b", "1", "", ""),))))


def test_columns_of_a_rate_group_follow_the_table() -> None:
    names = [channel.name for channel in TABLE.columns("fast")]
    assert TABLE.groups == ("fast", "slow")
    assert names[:2] == ["truth_0_m", "truth_1_m"]
    assert names[-3:] == ["w_BI_B_y_radps", "slosh_0_m", "slosh_1_m"]
    assert [TABLE.index(name) for name in names] == list(range(20))
    assert TABLE.index("alpha_deg") == 0
    assert TABLE.topic("slosh_1_m").name == "/slosh/tank_1"
    assert TABLE.columns("none") == ()
    assert "alpha_deg" in TABLE
    assert "beta_deg" not in TABLE
    with pytest.raises(KeyError):
        TABLE.index("beta_deg")


def test_markdown() -> None:
    text = topics_markdown(TABLE)
    assert "| `w_BI_B_y_radps` | rad/s | B | pitch rate |" in text
    assert "## `/slosh/tank_1` (fast)\n\none | two\n" in text
    assert r"a \| b" in topics_markdown(ChannelTable((Topic("/a", "f", (Channel("a", "1", "", "a | b"),)),)))


def test_a_message_has_at_most_2047_fields() -> None:
    doubles_template(MOST_FIELDS)
    for count in (0, MOST_FIELDS + 1):
        with pytest.raises(ValueError, match="1 to 2047"):
            doubles_template(count)


def test_a_topic_with_most_fields_round_trips(tmp_path: Path) -> None:
    channels = tuple(Channel(f"c{i}", "1", "", "") for i in range(MOST_FIELDS))
    table = ChannelTable((Topic("/a", "fast", channels),))
    values = np.random.default_rng(1).normal(size=(3, MOST_FIELDS))
    with LogWriter(tmp_path / "a.mcap", table, RunHead()) as writer:
        writer.write_block({"fast": (np.arange(3), values)})
    log = maxq.read(tmp_path / "a.mcap")
    assert np.array_equal(np.array(list(log.topic("/a").values())).T, values)


def test_head_refuses_what_the_writer_sets_and_doubles() -> None:
    with pytest.raises(ValueError, match="'schema' is set"):
        RunHead({"schema": "2"})
    with pytest.raises(ValueError, match=r"named twice: x\.toml"):
        RunHead({}, (Attachment("x.toml", "", b"1"), Attachment("x.toml", "", b"2")))


@pytest.mark.parametrize(
    ("groups", "what"),
    [
        ({"other": FAST}, "no rate group 'other'"),
        ({"fast": SLOW}, "20 channels"),
        ({"fast": (FAST[0][1:], FAST[1])}, "324 times"),
        ({"fast": (FAST[0][::-1].copy(), FAST[1])}, "must not decrease"),
        ({"fast": (FAST[0] - 1, FAST[1])}, "must not decrease"),
        ({"fast": (FAST[0] / 1e9, FAST[1])}, "int64"),
    ],
)
def test_arrays_that_do_not_fit_are_refused_before_anything_is_written(
    tmp_path: Path, groups: object, what: str
) -> None:
    with LogWriter(tmp_path / "a.mcap", TABLE, HEAD) as log:
        size = (tmp_path / "a.mcap").stat().st_size
        with pytest.raises(ValueError, match=what):
            log.write_block(groups)  # type: ignore[arg-type]  # wrong on purpose
        assert (tmp_path / "a.mcap").stat().st_size == size


def test_time_does_not_fall_from_call_to_call(tmp_path: Path) -> None:
    with LogWriter(tmp_path / "a.mcap", TABLE, HEAD) as log:
        log.write_block({"fast": FAST})
        with pytest.raises(ValueError, match="must not decrease"):
            log.write_block({"fast": FAST})
        log.write_block({"slow": SLOW})


def test_bad_events_and_frames_are_refused(tmp_path: Path) -> None:
    path = FramePath("I", "B", np.arange(2), np.zeros((2, 3)), np.zeros((2, 3)))
    with LogWriter(tmp_path / "a.mcap", TABLE, HEAD) as log:
        with pytest.raises(ValueError, match="rotation"):
            log.write_block({}, (), [path])
        with pytest.raises(ValueError, match="events"):
            log.write_block({}, [EventMessage(-1, Level.INFO, "before the start")])


def test_a_closed_log_takes_no_more(tmp_path: Path) -> None:
    log = LogWriter(tmp_path / "a.mcap", TABLE, HEAD)
    log.close()
    log.close()
    with pytest.raises(LogError, match="closed"):
        log.write_block({"fast": FAST})
    assert maxq.read(tmp_path / "a.mcap").complete


def test_a_log_that_cannot_be_written_names_file_and_reason(tmp_path: Path) -> None:
    path = tmp_path / "none" / "a.mcap"
    with pytest.raises(LogError, match=re.escape(f"{path}: the log cannot be written: No such file")):
        LogWriter(path, TABLE, HEAD)


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="this system has no device that is always full")
def test_a_full_disk_is_a_log_error() -> None:
    with pytest.raises(LogError, match="No space left"):
        LogWriter("/dev/full", TABLE, HEAD)


def test_a_disk_that_fills_up_keeps_the_chunks_before(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """When the third chunk is written only in part, and the next one not at all, the chunks before it stay readable."""
    path = tmp_path / "a.mcap"
    log = LogWriter(path, TABLE, HEAD)
    rows = {second: FAST[0] // SECOND == second for second in range(3)}
    for second in (0, 1):
        log.write_block({"fast": (FAST[0][rows[second]], FAST[1][rows[second]])})
    file = log._container._file

    class FullDisk:
        written, closed = 0, False

        def write(self, data: memoryview) -> int:
            if self.written:
                raise OSError(28, "No space left on device")
            self.written = file.write(data[:1000])
            return self.written

        def fileno(self) -> int:
            return int(file.fileno())

        def close(self) -> None:
            file.close()

    monkeypatch.setattr(log._container, "_file", FullDisk())
    with pytest.raises(LogError, match="No space left"), log:
        log.write_block({"fast": (FAST[0][rows[2]], FAST[1][rows[2]])})
    read = maxq.read(path)
    assert len(read["truth_0_m"]) == 200
    assert not read.complete


def test_an_unknown_channel_is_answered_with_close_names(tmp_path: Path) -> None:
    write_example(tmp_path / "a.mcap")
    log = maxq.read(tmp_path / "a.mcap")
    with pytest.raises(KeyError, match=r"no channel or topic alfa_deg; did you mean alpha_deg\?"):
        log["alfa_deg"]
    assert log.channel("w_BI_B_y_radps").frame == "B"
    assert "w_BI_B_y_radps" in log
    assert list(log.topic("/slosh/tank_1")) == ["slosh_0_m", "slosh_1_m"]


def test_files_that_are_no_logs(tmp_path: Path) -> None:
    with pytest.raises(LogError, match=r"none\.mcap: the log cannot be read: No such file"):
        maxq.read(tmp_path / "none.mcap")
    (tmp_path / "flight.mcap").mkdir()
    with pytest.raises(LogError, match="cannot be read: Is a directory"):
        maxq.read(tmp_path)  # where the log is looked for in the folder
    (tmp_path / "a.csv").write_text("t,alpha\n0,1\n")
    with pytest.raises(LogError, match=r"a\.csv: this is not a log"):
        maxq.read(tmp_path / "a.csv")
    (tmp_path / "empty.mcap").write_bytes(b"")
    with pytest.raises(LogError, match="this is not a log"):
        maxq.read(tmp_path / "empty.mcap")


def test_a_log_of_someone_else(tmp_path: Path) -> None:
    with (tmp_path / "ros.mcap").open("wb") as file:
        writer = Writer(file)
        writer.start(profile="ros2", library="rosbag2")
        writer.finish()
    with pytest.raises(LogError, match=r"an MCAP file, but not a log of maxq \(written by .*rosbag2"):
        maxq.read(tmp_path / "ros.mcap")


def test_a_log_of_a_later_schema(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("maxq.sim.log.head.SCHEMA_VERSION", "3")
    write_example(tmp_path / "a.mcap")
    with pytest.raises(LogError, match=r"has schema 3, written by maxq \d.*; this maxq reads schemas up to 2"):
        maxq.read(tmp_path / "a.mcap")


def test_a_log_of_schema_1_is_read_with_the_names_of_today() -> None:
    log = maxq.read(OLD_LOG)
    assert log.complete
    assert log.metadata["schema"] == "1"
    old_names = ("felt_B_x_mps2", "pitch_counted_deg", "held_down")
    new_names = ("specific_force_B_x_mps2", "pitch_measured_deg", "on_pad")
    assert not any(name in log for name in old_names)
    assert [log.channel(name).unit for name in new_names] == ["m/s2", "deg", "1"]
    assert log["on_pad"][0] == 1.0
    assert log["on_pad"][-1] == 0.0
    assert set(log.table.names) <= set(channel_table(Sizes(3, 3, 2, 1), ("lox", "jeta1")).names)  # some came later


def test_a_kept_log_of_schema_2_is_read_as_it_was_written() -> None:
    log = maxq.read(OLD_LOG.parents[1] / "schema-2" / "flight.mcap")
    assert log.complete
    assert log.metadata["schema"] == "2"
    assert [event.text for event in log.events] == ["ignition (stage 1)"]
    assert set(log.table.names) <= set(channel_table(Sizes(0, 0, 0, 1), ()).names)  # some came later
    assert len(log["on_pad"]) == 21


def test_a_log_cut_in_its_head_says_so(tmp_path: Path) -> None:
    data = write_example(tmp_path / "a.mcap")
    (tmp_path / "a.mcap").write_bytes(data[:1000])
    with pytest.raises(LogError, match="within its head"):
        maxq.read(tmp_path / "a.mcap")


class TiltRow(NamedTuple):
    tilt_axis_deg: Annotated[PitchYaw, "deg", "tilt"]


class ExampleRow(NamedTuple):
    tilt: TiltRow
    wind_N_axis_mps: Annotated[NorthEastDown, "m/s", "wind"]
    eta_mode_m: Annotated[float, "m", "modal coordinate"]
    valve_open: Annotated[float, "1", "1 while open"]


@entry
def write_row(row: Array, first: int) -> int:
    """Write a row as a kernel does; the count of the valve is an integer."""
    tilt, wind = TiltRow(PitchYaw(pitch=1.0, yaw=2.0)), NorthEastDown(east=4.0, north=3.0, down=5.0)
    return put(row, first, ExampleRow(valve_open=1, eta_mode_m=6.0, wind_N_axis_mps=wind, tilt=tilt))


def test_a_declared_row_is_written_in_the_order_of_its_channels() -> None:
    channels = declared_channels(ExampleRow, "mode", "pitch_1", "pitch mode 1")
    assert [(c.name, c.unit, c.frame, c.description) for c in channels[1:]] == [
        ("tilt_yaw_deg", "deg", "", "tilt, yaw, pitch mode 1"),
        ("wind_N_north_mps", "m/s", "N", "wind, north, pitch mode 1"),
        ("wind_N_east_mps", "m/s", "N", "wind, east, pitch mode 1"),
        ("wind_N_down_mps", "m/s", "N", "wind, down, pitch mode 1"),
        ("eta_pitch_1_m", "m", "", "modal coordinate, pitch mode 1"),
        ("valve_open", "1", "", "1 while open, pitch mode 1"),
    ]
    for write in (write_row, getattr(write_row, "py_func", write_row)):
        row = np.full(9, -1.0)
        assert write(row, 1) == 8
        assert row.tolist() == [-1.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 1.0, -1.0]


def test_a_row_with_a_missing_field_is_not_compiled() -> None:
    @njit  # type: ignore[untyped-decorator]  # Numba has no types
    def incomplete(row: Array) -> int:
        return put(row, 0, ExampleRow(valve_open=1.0))  # type: ignore[call-arg]  # which is the point

    with pytest.raises(TypeError, match=r"missing .*required"):
        incomplete(np.zeros(9))
