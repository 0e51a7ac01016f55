"""The viewer renders its images without a window, in software without a graphics card.

| claim | check |
|---|---|
| every view of the layout draws its data | no view reports an error, tab by tab, at several times |
| the picture has content | no picture is blank; the close-up differs from time to time |
| the picture is unchanged | small grey copies are compared with stored ones, within a tolerance for other drivers |
"""

from __future__ import annotations

import io
import itertools
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from replaykit import OLD_LOG, free_port, headless_viewer, no_driver

from maxq.tools import simreplay, simrun
from maxq.tools.replay import viewer
from maxq.tools.replay.convert import Options, save
from maxq.tools.replay.flight import open_flight
from maxq.tools.replay.viewer import ReplayError

KEPT = Path(__file__).parent / "data" / "replay"
TIMES_S = (0.3, 8.0, 9.4, 13.5)  # liftoff, pitching over, control being lost, tumbling
SMALL = (64, 36)
TOLERANCE = 6.0  # of 255, mean over the picture: another driver draws edges differently, not areas


@pytest.fixture(scope="module")
def flight():
    return open_flight(OLD_LOG)


@pytest.fixture(scope="module")
def shown(flight, tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple]:
    path = tmp_path_factory.mktemp("rendered") / "flight.rrd"
    save([flight], Options(), path)
    with headless_viewer() as client:
        client.open(str(path))
        yield client, path


def pixels(png: bytes) -> np.ndarray:
    return np.asarray(Image.open(io.BytesIO(png)).convert("L"), float)


def at(client, time_s: float) -> bytes:
    client.pause_at("sim_time", duration=time_s)
    return viewer.steady_picture(client)


def view_picture(client, name: str) -> np.ndarray:
    found = next(v for v in client.get_state().views if v.name.startswith(name))
    return pixels(viewer.steady_picture(client, found.view_id))


def test_no_view_complains_at_any_time(shown: tuple) -> None:
    client, _ = shown
    for time_s in TIMES_S:
        picture = pixels(at(client, time_s))
        assert picture.std() > 10.0
        assert viewer.complaints_of(client) == []
    names = {view.name.split(" (")[0].split(", ")[0] for view in client.get_state().views}
    assert {
        "Vehicle",
        "Trajectory",
        "Phases",
        "Events",
        "About",
        "pitch gimbal angle",
        "q alpha under thrust",
    } <= names, names


@pytest.mark.slow
def test_the_vehicle_moves_and_the_trajectory_grows(shown: tuple) -> None:
    client, _ = shown
    seen = []
    for time_s in TIMES_S[1:]:
        at(client, time_s)
        seen.append((view_picture(client, "Vehicle"), view_picture(client, "Trajectory")))
    for earlier, later in itertools.pairwise(seen):
        assert np.abs(earlier[0] - later[0]).mean() > 0.5
        assert np.abs(earlier[1] - later[1]).max() > 50.0


@pytest.mark.parametrize("time_s", [pytest.param(t, marks=pytest.mark.long if t < 9.0 else []) for t in TIMES_S])
def test_the_picture_is_what_it_was(shown: tuple, time_s: float) -> None:
    client, _ = shown
    picture = Image.open(io.BytesIO(at(client, time_s))).convert("L").resize(SMALL, Image.Resampling.BOX)
    kept = KEPT / f"window-{time_s:g}.png"
    if not kept.exists():
        kept.parent.mkdir(exist_ok=True)
        picture.save(kept)
        pytest.fail(f"{kept.name} did not exist; it was written: look at it")
    difference = np.abs(np.asarray(picture, float) - np.asarray(Image.open(kept), float))
    assert difference.mean() < TOLERANCE


@pytest.mark.parametrize(
    "tab",
    [
        "Air",
        "Slosh",
        *(pytest.param(tab, marks=pytest.mark.long) for tab in ("Attitude", "Gimbal", "Bending", "Computer", "Loads")),
        "Vehicle",
    ],
)
def test_every_tab_draws_its_plots(shown: tuple, flight, tab: str, tmp_path: Path) -> None:
    client, _ = shown
    path = tmp_path / f"{tab}.rrd"
    save([flight], Options(tab=tab, rate_hz=10.0), path)
    client.close_recordings()
    client.open(str(path))
    at(client, 9.4)
    assert viewer.complaints_of(client) == []
    plots = [v for v in client.get_state().views if v.view_class == "TimeSeries"]
    assert sum(_shows_curves(client, v.view_id) for v in plots) >= 4


def _shows_curves(client, view_id: str) -> bool:
    try:
        return bool(pixels(client.take_screenshot(view_id)).std() > 5.0)
    except ConnectionError:
        return False  # a view behind another tab has no picture


@pytest.mark.long
def test_several_flights_in_one_window(flight, tmp_path: Path) -> None:
    import dataclasses  # noqa: PLC0415  # only here

    flights = [dataclasses.replace(flight, label=label) for label in ("nominal", "run-000001", "run-000002")]
    path = tmp_path / "three.rrd"
    save(flights, Options(side_by_side=True, tab="Gimbal"), path)
    with headless_viewer() as client:
        client.open(str(path))
        assert pixels(at(client, 9.0)).std() > 10.0
        assert viewer.complaints_of(client) == []
        names = {view.name for view in client.get_state().views}
        assert {"nominal", "run-000001", "run-000002"} <= names


@pytest.mark.slow
def test_the_command_writes_pictures(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    target = tmp_path / "shot.png"
    code = simreplay.main([str(OLD_LOG), "--screenshot", str(target), "--at", "2", "--at", "9.4", "--size", "900x600"])
    out, err = capsys.readouterr()
    if code == 2:
        no_driver(ReplayError(err))
    assert code == 0
    assert [Path(line).name for line in out.split()] == ["shot-2.png", "shot-9.4.png"]
    for line in out.split():
        with Image.open(line) as picture:
            assert picture.size == (900, 600)


@pytest.mark.slow
def test_a_live_flight_is_shown_and_its_log_is_the_same(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    short = ["nominal", "--set", "run.duration_s=3.1", "--set", "requirement="]
    assert simrun.main([*short, "--out", "plain"]) == 0
    with headless_viewer() as client:
        port = client.url.rsplit(":", 1)[1].split("/")[0]
        assert simrun.main([*short, "--out", "seen", "--view-port", port, "--realtime", "20"]) == 0
        picture = viewer.steady_picture(client)
        assert pixels(picture).std() > 10.0
        assert viewer.complaints_of(client) == []
        state = client.get_state()
        ends = [t.end or 0 for r in state.recordings for t in r.timelines if t.name == "sim_time"]
        assert max(ends) == pytest.approx(3.1e9, rel=1e-6)
        assert {"Vehicle", "Trajectory"} <= {view.name.split(" (")[0].split(", ")[0] for view in state.views}
    assert Path("seen/flight.mcap").read_bytes() == Path("plain/flight.mcap").read_bytes()


def test_a_live_flight_without_a_viewer_is_not_flown(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    port = free_port()
    assert simrun.main(["nominal", "--view-port", str(port), "--out", str(tmp_path / "out")]) == 2
    err = capsys.readouterr().err
    assert err == f"simrun: --view: no viewer listens on port {port} of 127.0.0.1\n"
    assert not (tmp_path / "out").exists()


CAMPAIGN = """
schema = 1
extends = "nominal.toml"
requirement = []

[campaign]
runs = 2
seed = 1

[run]
duration_s = 3.1

[[disperse]]
key = "vehicle.stage.0.aero.force_factor"
name = "normal force"
distribution = "normal"
three_sigma = 0.15
source = "a test"
"""


@pytest.mark.long
def test_a_run_of_a_campaign_is_flown_again_and_shown(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """`simrun refly DIR --run N --view` opens the same window as `simreplay` with its log."""
    monkeypatch.chdir(tmp_path)
    assert simrun.main(["--copy", "nominal", "."]) == 0
    Path("short.toml").write_text(CAMPAIGN, encoding="utf-8")
    assert simrun.main(["short.toml", "--out", "flown", "--no-report"]) in {0, 3}
    again = ["--from", "flown", "--run", "1", "--out", "again"]

    free = free_port()
    assert simrun.main([*again, "--view-port", str(free)]) == 2
    assert capsys.readouterr().err.endswith(f"simrun: --view: no viewer listens on port {free} of 127.0.0.1\n")
    assert not Path("again").exists()

    with headless_viewer() as client:
        port = client.url.rsplit(":", 1)[1].split("/")[0]
        assert simrun.main([*again, "--view-port", port]) == 0
        assert "SAME as run 1 of flown" in capsys.readouterr().out
        assert pixels(at(client, 2.0)).std() > 10.0
        assert viewer.complaints_of(client) == []
        state = client.get_state()
        ends = [t.end or 0 for r in state.recordings for t in r.timelines if t.name == "sim_time"]
        assert max(ends) == pytest.approx(3.1e9, rel=1e-6)
        assert {"Vehicle", "Trajectory", "Phases"} <= {view.name.split(" (")[0].split(", ")[0] for view in state.views}
