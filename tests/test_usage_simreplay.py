"""`simreplay` writes, prints and returns its results without a viewer, for the stored log and broken ones."""

from __future__ import annotations

import json
import os
import re
import shutil
import socket
import subprocess
import sys
import xml.etree.ElementTree as ET
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import petrelkit as petrel
import pytest
from example_log import write_example
from mcap.writer import Writer
from PIL import Image
from replaykit import OLD_LOG

import maxq
from maxq.sim.packing.flight import pack_flight
from maxq.sim.run.fly import logged_channels
from maxq.tools import simreplay
from maxq.tools.replay import flight as flight_module
from maxq.tools.replay import stream, viewer
from maxq.tools.replay.convert import Options, colours_of, free_corner, legend_of, part_with, parts_of, save, with_scale
from maxq.tools.replay.flight import Moment, open_flight
from maxq.tools.replay.plots import Limit, PlotAxis, PlotLine, ReplayPlot, tabs_of
from maxq.tools.replay.sheets import write_sheets
from maxq.tools.replay.stream import PHASES, first_phase, phases
from maxq.tools.replay.text import about, summary_text

FEW = 4  # flights of a family that are shown in full

Printed = pytest.CaptureFixture[str]


@pytest.fixture(autouse=True)
def _in_an_empty_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


def run(*arguments: object) -> int:
    """Run the command and return its exit code, also when argparse ends it."""
    try:
        return simreplay.main([str(argument) for argument in arguments])
    except SystemExit as end:
        return int(str(end.code))


def one_line(printed: Printed) -> str:
    out, err = printed.readouterr()
    assert out == ""
    assert err.count("\n") == 1, err
    assert err.startswith("simreplay: ")
    assert "Traceback" not in err
    return err


# a log of an older schema


def test_the_kept_log_of_schema_1_opens() -> None:
    flight = open_flight(OLD_LOG)
    assert flight.notes == ()
    assert flight.log.metadata["schema"] == "1"
    assert flight.scenario is not None
    assert flight.verdict == "failed"
    assert [m.name for m in flight.moments] == ["ignition", "liftoff", "max_q", "control_lost", "tumble"]
    assert flight.moment("control_lost").time_s == pytest.approx(9.66)  # type: ignore[union-attr]  # it is there


# files


def test_save_leaves_a_recording(capsys: Printed) -> None:
    assert run(OLD_LOG, "--save", "out.rrd") == 0
    assert capsys.readouterr().out.startswith("out.rrd   ")
    command = [str(viewer.executable()), "rrd", "verify", "out.rrd"]
    checked = subprocess.run(command, capture_output=True, text=True, check=False)
    assert checked.returncode == 0, checked.stderr


@pytest.mark.long
def test_the_standard_set_has_every_subject_as_svg_and_png(capsys: Printed) -> None:
    assert run(OLD_LOG, "--plots", "sheets") == 0
    printed = capsys.readouterr().out.split()
    names = sorted({Path(name).stem for name in printed})
    assert [name.split("-", 1)[1] for name in names] == [
        "trajectory",
        "air",
        "attitude",
        "gimbal",
        "bending",
        "slosh",
        "computer",
        "loads",
        "vehicle",
        "path",
        "altitude",
        "phase-plane",
        "spectra",
        "requirements",
    ]
    for name in names:
        picture = np.asarray(Image.open(f"sheets/{name}.png").convert("L"), float)
        assert picture.std() > 5.0, f"{name} is blank"
        assert min(picture.shape) > 300
        ET.parse(f"sheets/{name}.svg")
    texts = "".join(Path("sheets/08-loads.svg").read_text(encoding="utf-8"))
    for text in ("kPa deg", "bending moment of the structure 100", "time, s", "control lost 9.7 s"):
        assert text in texts, text


@pytest.mark.slow
def test_equal_logs_give_equal_plots(tmp_path: Path) -> None:
    for folder in ("one", "two"):
        write_sheets([open_flight(OLD_LOG)], Path(folder), only="slosh")
    assert len(list(Path("one").iterdir())) == 2
    for path in sorted(Path("one").iterdir()):
        assert path.read_bytes() == (tmp_path / "two" / path.name).read_bytes(), path.name


def test_summary_is_a_glance_in_plain_text(capsys: Printed) -> None:
    assert run(OLD_LOG, "--summary") == 0
    out = capsys.readouterr().out
    assert out.startswith("loses-control: duration at 14.0 s, FAILED: ")
    assert "control_lost: the attitude error exceeds 45 deg under thrust" in out
    assert re.search(r"q alpha under thrust +[▁-█ ]+ .* kPa deg !", out)
    assert "MISSED slosh angle" in out
    assert not re.search(r"[\x00-\x09\x0b-\x1f\x1b]", out)


def test_summary_fits_the_terminal_and_does_without_blocks() -> None:
    flight = open_flight(OLD_LOG)
    for width in (80, 120):
        text = summary_text(flight, width, ascii_only=True)
        rows = [line for line in text.splitlines() if " .. " in line]
        assert max(len(line) for line in rows) <= width
        assert text.isascii()


@pytest.mark.parametrize("most", [7, 15])
@pytest.mark.parametrize("span", [(-0.09, 0.09), (-20.5, 3.2), (0.0, 13.0), (4.1, 4.9), (-1e-7, 2e-6), (80.0, 1400.0)])
def test_every_axis_has_two_numbers(span: tuple[float, float], most: int) -> None:
    """At least two multiples of the smallest power of ten of which `most` fit are on an axis, away from its edges."""
    low, high = span
    bottom, top = with_scale(low, high, most)
    assert bottom <= low < high <= top
    step = next(10.0**k for k in range(-12, 9) if (high - low) / 10.0**k <= most)
    assert np.floor(top / step) - np.ceil(bottom / step) >= 1
    assert top - bottom < 1.1 * (high - low + 1.1 * step)
    ends = np.ceil(bottom / step) * step - bottom, top - np.floor(top / step) * step
    assert min(ends) > 0.03 * (top - bottom)


def test_a_glance_shows_every_pendulum() -> None:
    """The second vehicle with a second slosh mode in one tank shows three pendulums by name."""
    loaded = petrel.scenario("vehicle.stage.0.tank.0.modes=2")
    table = logged_channels(loaded.scenario, pack_flight(loaded.scenario).sizes)
    plots = [plot for tab in tabs_of(table, loaded.scenario) for plot in tab.plots if plot.key == "slosh/pitch"]
    shown = [curve.label for plot in plots for curve in plot.curves[: plot.glance[0]]]
    assert shown == ["oxygen pitch", "oxygen_2_or_kerosene pitch", "kerosene pitch"]


# several flights


def test_a_campaign_folder_gives_the_nominal_first_and_flights_by_their_names() -> None:
    for name in ("run-000012", "run-000003", "nominal"):
        (Path("campaign/flights") / name).mkdir(parents=True)
        shutil.copy(OLD_LOG, f"campaign/flights/{name}/flight.mcap")
    flights, complaints = flight_module.open_flights(["campaign"])
    assert [flight.label for flight in flights] == ["nominal", "run-000003", "run-000012"]
    assert complaints == []


def test_a_folder_of_runs_and_bare_logs_are_found() -> None:
    Path("runs/a").mkdir(parents=True)
    shutil.copy(OLD_LOG, "runs/a/flight.mcap")
    shutil.copy(OLD_LOG, "runs/bare.mcap")
    assert [label for _, label in flight_module.find_logs(["runs"])] == ["a", "bare"]
    flights, _ = flight_module.open_flights(["runs/a", "runs/bare.mcap"])
    assert len({flight.label for flight in flights}) == 2


def test_several_flights_go_into_one_recording_and_one_broken_log_is_named(capsys: Printed) -> None:
    Path("kept/run-1").mkdir(parents=True)
    Path("kept/run-2").mkdir(parents=True)
    shutil.copy(OLD_LOG, "kept/run-1/flight.mcap")
    Path("kept/run-2/flight.mcap").write_bytes(b"nonsense")
    assert run(".", OLD_LOG, "--save", "both.rrd", "--side-by-side") == 1
    err = capsys.readouterr().err
    assert err.count("\n") == 1
    assert "kept/run-2/flight.mcap: this is not a log" in err
    assert Path("both.rrd").stat().st_size > 100_000


def test_plots_are_parted_by_stages_and_legends_stand_aside_of_curves() -> None:
    flight = open_flight(OLD_LOG)
    start, end = flight.span_s
    assert list(parts_of([flight], flight.span_s).values())[-1] == (start, end)
    parted = replace(flight, moments=(*flight.moments, Moment("separation", round(1e9 * (start + 4.0)), "separation")))
    (_, first), (_, second), (name, whole) = parts_of([parted], flight.span_s).items()
    assert (first, second, name, whole) == ((start, start + 4.0), (start + 4.0, end), "Whole flight", (start, end))
    ns = np.linspace(start * 1e9, end * 1e9, 500).astype(np.int64)

    def corner(values: list[float], name: str = "", lines: int = 1) -> str:
        rows = np.interp(ns, [ns[0], ns[-1]], values)
        plot = ReplayPlot("a/b", "", "", (PlotLine(name, "mach", lambda _: (ns, rows)),) * lines)
        return free_corner(plot, PlotAxis(0.0, 1.0, (), ()), (start, end), [flight], 3).name

    assert corner([0.0, 1.0]) == "LeftTop"
    assert corner([1.0, 0.0]) == "RightTop"
    assert corner([0.4, 0.62]) == "RightTop", "above the curve"
    assert corner([0.4, 0.62], "a curve with a long name", 5) == "RightBottom", "27 % of it, at the top 36 % and more"


def test_a_legend_too_large_for_a_plot_names_the_flights_whose_curves_differ_in_width(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A legend names the curves; with several flights it names the flights, or is omitted if it does not fit."""
    tab = next(tab for tab in tabs_of(open_flight(OLD_LOG).log.table, None) if tab.name == "Loads")
    plots = {plot.key.removeprefix("loads/"): plot for plot in tab.plots}
    legends = [{key: legend_of(tab, plot, n) for key, plot in plots.items()} for n in (1, 3, 6, 7)]
    assert legends[0] == {key: "curves" if len(plot.curves) > 1 else "" for key, plot in plots.items()}
    assert {"curves", ""} == set(legends[0].values())
    limited = replace(plots["q_alpha"], limits=(Limit(1e5, "q alpha 100", upper=True, required=True),))
    assert legend_of(tab, limited, 1) == "curves"
    assert (legends[1]["q_alpha"], legends[1]["force"], legends[2]["moment"]) == ("curves", "flights", "flights")
    assert set(legends[3].values()) == {""}

    sent: dict[str, tuple[str, float]] = {}

    def log(_: object, entity: str, style: Any, *, static: bool) -> None:
        first = [style.names.as_arrow_array()[0].as_py(), style.widths.as_arrow_array()[0].as_py()]
        sent[entity.rpartition("loads/")[2]] = first[0], round(first[1], 3)

    monkeypatch.setattr(stream.rr.RecordingStream, "log", log)
    recording, keys = stream.rr.RecordingStream("test"), {plots["force"].key}
    stream.send_styles(recording, "flights/windy", [tab], "#d55e00", "windy, FAILED: ", by_width=keys)
    assert [sent[f"force/curve_{i}"] for i in (1, 2, 3)] == [("windy, FAILED", w) for w in (3.2, 1.8, 1.0)]
    assert sent["moment/curve_1"] == ("windy, FAILED: x", 1.4)
    assert stream.width_text(plots["force"]) == "thick to thin: x, y, z"


def test_pictures_show_the_plots_of_the_part_with_their_times() -> None:
    """A picture at 150 s shows the stage of that time, not the first stage, which ends at 120 s."""
    parts = [(0.0, 4.0), (4.0, 10.0), (0.0, 10.0)]
    assert [part_with(parts, times) for times in ((), (1.0,), (5.0,), (3.0, 5.0), (20.0,))] == [0, 0, 1, 2, 2]


def test_the_last_event_so_far_is_bold(monkeypatch: pytest.MonkeyPatch) -> None:
    sent: list[tuple[int, list[str]]] = []
    now = [0]
    monkeypatch.setattr(stream, "set_time", lambda _, time_ns: now.append(time_ns))
    log = lambda _, entity, document: sent.append((now[-1], document.text.as_arrow_array()[0].as_py().splitlines()))  # noqa: E731
    monkeypatch.setattr(stream.rr.RecordingStream, "log", log)
    events = (Moment("ignition", 500_000_000, "ignition"), Moment("end", 2_000_000_000, "the end " * 9))
    stream.send_events(stream.rr.RecordingStream("test"), [("", events)], 0)
    assert [time_ns for time_ns, _ in sent] == [0, 500_000_000, 2_000_000_000]
    assert sent[0][1][:3] == ["| time, s | event |", "|--:|---|", "| 0.500 | ignition |"]
    assert sent[1][1][2:4] == ["| **0.500** | **ignition** |", f"| 2.000 | {'the end ' * 5}the |"]
    assert sent[2][1][2:5] == [
        "| 0.500 | ignition |",
        f"| **2.000** | **{'the end ' * 5}the** |",
        f"|  | **end {'the end ' * 3}**".rstrip("* ") + "** |",
    ]
    sent.clear()
    stream.send_events(stream.rr.RecordingStream("test"), [("one", events[:1]), ("two", events[:1])], 0)
    assert sent[1][1][:4] == [
        "| time, s | flight | event |",
        "|--:|---|---|",
        "| **0.500** | **one** | **ignition** |",
        "| 0.500 | two | ignition |",
    ]


@pytest.mark.slow
def test_of_many_flights_a_few_are_in_memory_and_plots_are_families(monkeypatch: pytest.MonkeyPatch) -> None:
    for i in range(24):
        Path(f"c/flights/run-{i:06}").mkdir(parents=True)
        os.link(OLD_LOG, f"c/flights/run-{i:06}/flight.mcap")
    flights, complaints = flight_module.open_flights(["c"], in_turn=True)
    assert complaints == []
    assert len(flights) == 24
    read: list[Path] = []
    monkeypatch.setattr(flight_module, "read_log", lambda path: read.append(path) or maxq.read(path))
    save(flights, Options(), Path("many.rrd"))
    assert len(read) <= 24 + 2 * FEW
    assert len(set(read)) >= 24 - FEW - 1
    said = subprocess.run(
        [str(viewer.executable()), "rrd", "stats", "many.rrd"], capture_output=True, text=True, check=True
    ).stdout
    roots = {line.split("/plots/")[0] for line in said.splitlines() if "/plots/" in line}
    assert roots == {"/family", *(f"/flights/run-{i:06}" for i in range(FEW))}


def test_a_failed_flight_is_red_among_few_and_many_and_its_verdict_comes_first() -> None:
    """A failed flight is red whatever its place in the list of colours, and its verdict comes first."""
    failed = open_flight(OLD_LOG)
    passed = replace(failed, summary={"passed": True})
    colours = colours_of([passed, passed, failed, failed])
    assert len(set(colours)) == 4
    assert colours[2:] == ["#d55e00", "#a34700"]
    assert colours_of([passed] * 6 + [failed])[-1] == "#d55e00"
    lines = about([failed], ["drawn"]).splitlines()
    assert lines[0].startswith("# FAILED")
    at = lines.index("| requirement | value | limit | used |")
    assert at < 12
    assert lines[at + 2].startswith("| **MISSED** ")
    assert lines[at + 2].endswith(" | ≤ 0 s |  |")
    met = sum(not line.startswith("| **MISSED** ") for line in lines[at + 2 : lines.index("", at)])
    assert lines[2].endswith(f"; {met} of {len(failed.requirements)} requirements met")
    several = about([replace(passed, label="calm"), replace(failed, label="windy")], []).splitlines()
    assert [line.split(" | ")[-1] for line in several[4:6]] == ["PASSED |", "FAILED |"]
    assert several[6] == ""
    assert several[7] == f"- windy: {lines[0].removeprefix('# FAILED: ')}"
    assert PHASES["ended"] != "#009e73"


@pytest.mark.slow
def test_each_of_a_few_flights_has_its_name_and_its_colour() -> None:
    for name in ("calm", "windy"):
        Path(name).mkdir()
        shutil.copy(OLD_LOG, f"{name}/flight.mcap")
    flights, _ = flight_module.open_flights(["calm", "windy"])
    told: list[tuple[str, int, int]] = []
    write_sheets(flights, Path("sheets"), only="gimbal", watch=lambda *step: told.append(step))
    drawn = Path("sheets/04-gimbal.svg").read_text(encoding="utf-8")
    assert "2 flights" in drawn
    assert all(f">{name}" in drawn for name in ("calm", "windy"))
    assert "stroke: #000000" in drawn
    assert "stroke: #d55e00" in drawn  # failed: never green
    assert "stroke: #e69f00" not in drawn  # which was the second curve's, whosoever it was
    assert [done for _, done, _ in told] == list(range(len(told)))


@pytest.mark.slow
def test_many_flights_are_drawn_as_envelopes() -> None:
    for i in range(7):
        Path(f"c/kept/run-{i}").mkdir(parents=True)
        shutil.copy(OLD_LOG, f"c/kept/run-{i}/flight.mcap")
    write_sheets(flight_module.open_flights(["c"])[0], Path("sheets"), only="gimbal")
    assert "shaded: all" in Path("sheets/04-gimbal.svg").read_text(encoding="utf-8")


# what cannot be shown, or not whole


def cut(fraction: float) -> Path:
    data = OLD_LOG.read_bytes()
    path = Path("cut.mcap")
    path.write_bytes(data[: int(fraction * len(data))])
    return path


def test_a_truncated_log_is_shown_as_far_as_it_reaches(capsys: Printed) -> None:
    assert run(cut(0.8), "--save", "out.rrd") == 1
    assert "the end of the log is missing or damaged" in capsys.readouterr().err
    assert Path("out.rrd").stat().st_size > 100_000
    assert run("cut.mcap", "--summary") == 1
    out = capsys.readouterr().out
    assert "cut off at" in out
    assert "incomplete: the end of the log is missing" in out


def test_a_corrupt_log_is_shown_without_the_damaged_part(capsys: Printed) -> None:
    data = bytearray(OLD_LOG.read_bytes())
    middle = int(0.85 * len(data))
    data[middle : middle + 64] = bytes(64)
    Path("corrupt.mcap").write_bytes(data)
    assert run("corrupt.mcap", "--save", "out.rrd") == 1
    assert "was left out" in capsys.readouterr().err


def test_a_log_cut_in_its_head_shows_nothing(capsys: Printed) -> None:
    assert run(cut(0.2), "--save", "out.rrd") == 2
    assert "cut off or damaged within its head" in one_line(capsys)
    assert not Path("out.rrd").exists()


def test_an_empty_file_and_a_foreign_one_show_nothing(capsys: Printed) -> None:
    Path("empty.mcap").touch()
    assert run("empty.mcap", "--summary") == 2
    assert "this is not a log" in one_line(capsys)
    with Path("foreign.mcap").open("wb") as file:
        writer = Writer(file)
        writer.start("ros2", "someone else")
        writer.finish()
    assert run("foreign.mcap", "--summary") == 2
    assert "not a log of maxq (written by someone else)" in one_line(capsys)


def test_a_log_of_a_later_schema_is_refused_by_name(capsys: Printed) -> None:
    data = OLD_LOG.read_bytes()
    at = data.index(b"\x06\x00\x00\x00schema\x01\x00\x00\x001") + 14
    Path("later.mcap").write_bytes(data[:at] + b"9" + data[at + 1 :])
    assert run("later.mcap", "--summary") == 2
    assert "this log has schema 9" in one_line(capsys)


def test_a_log_whose_scenario_cannot_be_read_is_shown_without_vehicle(tmp_path: Path, capsys: Printed) -> None:
    path = tmp_path / "example.mcap"
    write_example(path)
    assert run(path, "--save", "out.rrd") == 1
    assert "neither vehicle nor limits are shown" in capsys.readouterr().err
    assert Path("out.rrd").stat().st_size > 5_000


def test_a_log_without_samples_shows_nothing(tmp_path: Path, capsys: Printed) -> None:
    from example_log import HEAD, TABLE  # noqa: PLC0415  # only here

    from maxq.sim.log.writer import LogWriter  # noqa: PLC0415  # only here

    with LogWriter(tmp_path / "bare.mcap", TABLE, HEAD):
        pass
    assert run(tmp_path / "bare.mcap", "--summary") == 2
    assert "holds no samples" in one_line(capsys)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("arguments", "what"),
    [
        (("nowhere.mcap", "--summary"), "nowhere.mcap: no such file or folder"),
        ((".", "--summary"), "no flight in this folder"),
        ((), "give a LOG|DIR, e.g. simreplay runs/nominal/flight.mcap"),
        ((OLD_LOG, "--screenshot", "a.png"), "--screenshot needs --at"),
        ((OLD_LOG, "--at", "3"), "--at needs --screenshot"),
        ((OLD_LOG, "--screenshot", "a.png", "--at", "x"), "'x' is not a time in seconds"),
        ((OLD_LOG, "--port", "80"), "--port needs --web"),
        ((OLD_LOG, "--web", "--save", "a.rrd"), "--web and --save exclude each other"),
        ((OLD_LOG, "--rate", "0"), "'0' is not above 0"),
        ((OLD_LOG, "--screenshot", "a.png", "--at", "3", "--size", "big"), "'big' is not a size"),
        ((OLD_LOG, "--save", "none/out.rrd"), "there is no folder none"),
        ((OLD_LOG, "--save", "."), "is a folder"),
        ((OLD_LOG, "--save", "a.rrd", "--tab", "Fuel"), "there is no such tab; there are Trajectory, Air"),
        ((OLD_LOG, "--plots", "/dev/null/x"), "cannot be written"),
    ],
)
def test_wrong_input_is_answered_in_one_line(arguments: tuple[object, ...], what: str, capsys: Printed) -> None:
    assert run(*arguments) == 2
    assert what in one_line(capsys)


def test_a_port_in_use_is_named(capsys: Printed) -> None:
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        port = other.getsockname()[1]
        assert run(OLD_LOG, "--web", "--port", port) == 2
        assert f"port {port} is in use" in one_line(capsys)


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="elsewhere a window needs no DISPLAY")
def test_without_a_display_other_ways_are_named(monkeypatch: pytest.MonkeyPatch, capsys: Printed) -> None:
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    assert run(OLD_LOG) == 2
    assert "--web" in one_line(capsys)


@pytest.mark.skipif(
    not sys.platform.startswith("linux"), reason="the variable that hides drivers is the Linux loader's"
)
def test_missing_drivers_are_named(monkeypatch: pytest.MonkeyPatch, capsys: Printed) -> None:
    monkeypatch.setenv("VK_DRIVER_FILES", "/nonexistent")
    monkeypatch.setenv("VK_ICD_FILENAMES", "/nonexistent")
    monkeypatch.setenv("__EGL_VENDOR_LIBRARY_FILENAMES", "/nonexistent")
    assert run(OLD_LOG, "--screenshot", "a.png", "--at", "5") == 2
    assert "mesa-vulkan-drivers" in one_line(capsys)
    assert not Path("a.png").exists()


def test_the_viewer_reports_to_nobody() -> None:
    env = viewer.environment()
    command = [str(viewer.executable()), "analytics", "config"]
    said = subprocess.run(command, env=env, capture_output=True, text=True, check=True).stdout
    assert json.loads(said)["analytics_enabled"] is False


# the command


def test_help_is_quick_and_lists_every_option(capsys: Printed) -> None:
    assert run("--help") == 0
    text = capsys.readouterr().out
    for option in ("--web", "--save", "--screenshot", "--plots", "--summary", "--bend-factor", "--side-by-side"):
        assert option in text
    code = "import sys; from maxq.tools import simreplay, simrun; "
    code += "print(sorted({'numpy', 'rerun', 'numba'} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_version(capsys: Printed) -> None:
    assert run("--version") == 0
    assert capsys.readouterr().out.startswith("maxq ")


def test_phases_follow_the_events() -> None:
    flight = open_flight(OLD_LOG)
    first = flight.moments[0]
    names = [phase.name for phase in phases(first_phase(flight.log, first.time_ns), flight.moments)]
    assert names == ["held down", "powered", "control lost", "tumbling"]
