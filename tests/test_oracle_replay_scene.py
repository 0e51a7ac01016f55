"""The replay scene equals the log's numbers and independent geometry."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
import rerun as rr
from mcap_messages import messages
from replaykit import OLD_LOG
from rerun import ComponentColumn

from maxq.tools.replay import meshes
from maxq.tools.replay.flight import launch_of, open_flight, path_of, place_of
from maxq.tools.replay.plots import tabs_of
from maxq.tools.replay.scene import Scene
from maxq.tools.replay.stream import send_now
from maxq.tools.replay.vehicle_shape import (
    BoosterShape,
    LoadStations,
    bent_line,
    exaggeration_of,
    modal_coordinates,
    nice_factor,
    shape_of,
)

SIDES = 24
SECTION = "section_1_bending_pitch_Nm"  # a channel of every log with section loads


@cache
def flight():
    return open_flight(OLD_LOG)


@cache
def shape():
    scenario = flight().scenario
    assert scenario is not None
    return shape_of(scenario.vehicle)


def test_the_bent_line_ends_where_the_flight_says_that_the_gimbal_is() -> None:
    log, stage = flight().log, shape().stages[0]
    assert stage.engine is not None
    at = np.array([stage.engine.gimbal_station_m])
    clock = log.time_s("eta_pitch_1_m")
    pitch, yaw = (modal_coordinates(log, plane) for plane in ("pitch", "yaw"))
    moved = bent_line(stage, clock, pitch, yaw, at)[:, 0]
    slope = bent_line(stage, clock, pitch, yaw, at, "slope_pm")[:, 0]
    for values, name in (
        (moved[:, 1], "bend_pitch_gimbal_m"),
        (moved[:, 0], "bend_yaw_gimbal_m"),
        (np.degrees(slope[:, 1]), "bend_pitch_gimbal_deg"),
        (-np.degrees(slope[:, 0]), "bend_yaw_gimbal_deg"),
    ):
        # linear between the rows of the mode table here, cubic in the flight
        np.testing.assert_allclose(values, log[name], atol=2e-3 * np.abs(log[name]).max())


def test_the_gyro_picks_up_from_all_modes_what_it_picks_up_from_each() -> None:
    scenario = flight().scenario
    plots = {p.key: p for tab in tabs_of(flight().log.table, scenario) for p in tab.plots}
    for axis in ("pitch", "yaw"):
        every, *each = plots[f"bending/{axis}_gyro"].curves
        assert len(each) == 3
        total = sum(curve.values(flight().log)[1] for curve in each)
        whole = every.values(flight().log)[1]
        np.testing.assert_allclose(total, whole, atol=5e-3 * np.abs(whole).max())


def test_pose_is_that_of_the_frames_in_the_log() -> None:
    """The pose equals /tf, which the flight writes, read with the mcap package and protobuf."""
    logged = []
    for _, _, message, decoded in messages(OLD_LOG, "/tf"):
        frame = decoded.transforms[0]
        p, q = frame.translation, frame.rotation
        logged.append((message.log_time, p.x, p.y, p.z, q.w, q.x, q.y, q.z))
    expected = np.array(logged)
    place = place_of(flight())
    path = path_of(flight().log, place.frames(flight().log.table, 100_000_000))
    np.testing.assert_array_equal(path.times_ns, expected[:, 0])
    np.testing.assert_allclose(path.translation_m, expected[:, 1:4], atol=1e-6)
    np.testing.assert_allclose(path.rotation, expected[:, 4:], atol=1e-12)


def test_velocity_arrow_is_the_motion_of_the_picture() -> None:
    log, place = flight().log, place_of(flight())
    path = path_of(log, place.frames(log.table, 100_000_000))
    v_N = np.stack([log[f"v_N_{a}_mps"] for a in ("north", "east", "down")], axis=1)
    v = place.from_ned(log["latitude_deg"], log["longitude_deg"], v_N)
    time_s = path.times_ns / 1e9
    moved = np.gradient(path.translation_m, time_s, axis=0)
    inside = slice(5, 85)  # steady thrust: central differences of 0.1 s are good to a a' h^2 / 6
    np.testing.assert_allclose(moved[inside], v[: len(moved)][inside], atol=0.05)


def test_the_ground_is_at_the_altitude_of_the_site() -> None:
    """A sphere of the mean radius falls by d^2 / 2 R; the curvature of the ellipsoid differs by less than 1 %."""
    place = place_of(flight())
    east, north = np.array([0.0, 30e3, -50e3, 0.0]), np.array([0.0, -20e3, 0.0, 80e3])
    points = place.ground(east, north)
    assert points[0] == pytest.approx([0.0, 0.0, 0.0], abs=1e-3)
    far = np.hypot(east, north)[1:]
    drop = far**2 / (2.0 * 6.37e6)
    np.testing.assert_allclose(-points[1:, 2], drop, rtol=0.01)


def test_a_surface_stands_across_its_pendulum() -> None:
    pitch, yaw = math.radians(7.0), math.radians(-4.0)
    tilt = np.array([[math.tan(yaw), math.tan(pitch)]])
    vertices = meshes.liquid_vertices(np.array([-11.0]), np.array([-9.0]), 0.5, tilt, np.zeros((1, 2, 2)))[0]
    sides = SIDES
    surface = vertices[3 * sides : 4 * sides].astype(float)
    centre = surface.mean(axis=0)
    pendulum = np.array([-1.0, math.tan(yaw), math.tan(pitch)])  # from the hinge to the bob, in B
    across = (surface - centre) @ pendulum
    np.testing.assert_allclose(across, 0.0, atol=1e-6)
    assert surface[np.argmax(surface[:, 2]), 0] > centre[0]  # the bob hangs to +z, and so does the liquid


def test_a_liquid_keeps_within_its_tank_and_normals_point_outwards() -> None:
    tilt = np.array([[3.0, 0.0]])
    vertices = meshes.liquid_vertices(np.array([0.0]), np.array([0.1]), 0.5, tilt, np.zeros((1, 2, 2)))[0]
    assert vertices[:, 0].min() == 0.0
    body = meshes.revolved([(0.0, 1.0), (2.0, 1.0)])
    outwards = (body.normals[:, 1:] * body.vertices[:, 1:]).sum(axis=1)
    assert (outwards > 0.99).all()
    fin = meshes.plate([(0, 1, 0), (-0.5, 2, 0), (-1, 2, 0), (-1.5, 1, 0)], 0.1)
    middle = fin.vertices.mean(axis=0)
    assert (((fin.vertices - middle) * fin.normals).sum(axis=1) > 0.0).all()


def test_the_shape_follows_the_file() -> None:
    stage = shape().stages[0]
    assert shape().length_m == 14.0
    assert [t.name for t in stage.tanks] == ["lox", "jeta1"]
    assert [t.bottom_station_m for t in stage.tanks] == [11.1, 5.45]
    assert stage.engine is not None
    assert (stage.engine.gimbal_station_m, stage.engine.exit_station_m) == (12.7, 14.0)
    assert stage.engine.exit_radius_m == pytest.approx(math.sqrt(0.2515 / math.pi))
    assert stage.fins is not None
    assert stage.fins.root_station_m < 11.06 < stage.fins.root_station_m + stage.fins.root_chord_m
    assert max(radius for _, radius in stage.profile) == 0.5


@pytest.mark.parametrize(
    ("largest", "wanted", "factor"), [(1e-3, 0.35, 200.0), (0.4, 0.35, 1.0), (0.1, 0.35, 2.0), (0.0, 0.35, 1.0)]
)
def test_factors_are_round_and_keep_within_what_is_wanted(largest: float, wanted: float, factor: float) -> None:
    assert nice_factor(largest, wanted) == factor


def test_the_factor_may_be_chosen() -> None:
    chosen = exaggeration_of(flight().log, shape(), 123.0, 4.0)
    assert (chosen.bending, chosen.slosh) == (123.0, 4.0)
    assert exaggeration_of(flight().log, shape()).bending > 1.0


def test_earth_and_site_read_by_themselves_are_those_of_the_scenario() -> None:
    scenario = flight().scenario
    assert scenario is not None
    assert launch_of(flight().log) == (scenario.earth, scenario.site)


class Loaded:
    """The flight with section loads at both ends: 3 : 4 about y and z, 100 N m per second aft, none in front."""

    def __init__(self) -> None:
        self.log = flight().log
        self.table = self.log.table
        self.own = {f"section_{n}_bending_{plane}_Nm": 0.0 for n in (1, 2) for plane in ("pitch", "yaw")}
        self.own |= {"section_2_bending_pitch_Nm": 60.0, "section_2_bending_yaw_Nm": -80.0}

    def __contains__(self, name: str) -> bool:
        return name in self.own or name in self.log

    def __getitem__(self, name: str) -> np.ndarray:
        return self.own[name] * self.time_ns(name) / 1e9 if name in self.own else self.log[name]

    def time_ns(self, name: str) -> np.ndarray:
        return self.log.time_ns("cg_station_m" if name in self.own else name)


@pytest.mark.parametrize("limit_Nm", [None, np.array([500.0, 500.0])])
def test_skin_has_the_colour_of_its_bending_moment(
    limit_Nm: np.ndarray | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The last of sixteen pieces, 31/32 of the way aft, has the colour of 31/32 of 100 t N m."""
    sent: dict[str, tuple[np.ndarray, np.ndarray]] = {}
    said: list[str] = []

    def keep(_: Scene, entity: str, times_ns: np.ndarray, columns: Iterable[ComponentColumn]) -> None:
        if entity.endswith("skin"):
            sent[entity] = times_ns, np.concatenate([c.as_arrow_array().flatten().to_numpy() for c in columns])

    def note(_: Scene, entity: str, item: Any) -> None:
        if entity == "vehicle/legend/shares":
            said.append(str(item.labels.as_arrow_array().to_pylist()[-1]))

    monkeypatch.setattr(Scene, "_send", keep)
    monkeypatch.setattr(Scene, "_log", note)
    stage = shape().stages[0]
    sections = LoadStations(np.array([0.0, stage.end_m]), limit_Nm)
    drawn = replace(shape(), stages=(replace(stage, sections=sections),))
    scene = Scene(rr.RecordingStream("test"), "flight", place_of(flight()), drawn, exaggeration_of(flight().log, drawn))
    scene.add(Loaded())
    times_ns, colours = sent["vehicle/body/hull/stage1/piece_15/skin"]
    largest_Nm = 100.0 * Loaded().time_ns(SECTION)[-1] / 1e9
    share = 31.0 / 32.0 * 100.0 * times_ns / 1e9 / (largest_Nm if limit_Nm is None else 500.0)
    red, violet = (205 << 24 | 30 << 16 | 40 << 8 | 235), (150 << 24 | 30 << 16 | 190 << 8 | 255)
    assert (np.diff(colours[share < 0.9].astype(np.int64) & 255) >= 0).all(), "ever less transparent"
    assert not set(colours[share < 0.98].tolist()) & {red, violet}
    if limit_Nm is not None:
        assert set(colours[share > 1.03].tolist()) == {violet}
        assert said[-1] == "limit"
    else:
        assert abs(int(colours[-1] >> 24) - 205) < 8, "the flight's largest, less a thirty-second: all but red"
        assert said[-1] == f"maximum {largest_Nm / 1e3:.3g} kN m"
    assert (sent["vehicle/body/hull/stage1/piece_00/skin"][1] & 255 < 90).all(), "a thirty-second of it: all but plain"


def test_read_outs_are_the_last_samples_before(monkeypatch: pytest.MonkeyPatch) -> None:
    """A row of the table contains the last samples of the log before its time."""
    sent: list[tuple[list[int], list[str]]] = []

    def keep(_: rr.RecordingStream, entity: str, indexes: Iterable[Any], columns: Iterable[ComponentColumn]) -> None:
        assert entity == "now"
        texts = [c.as_arrow_array().flatten().to_pylist() for c in columns]
        (when,) = (index.as_arrow_array().cast("int64").to_pylist() for index in indexes)
        sent.append((when, next(text for text in texts if text[0].startswith("**"))))

    monkeypatch.setattr(rr.RecordingStream, "send_columns", keep)
    log = flight().log
    send_now(rr.RecordingStream("test"), [("one", log), ("two", log)])
    ((when, texts),) = sent
    assert np.diff(when).tolist() == [200_000_000] * (len(when) - 1)
    ns, mach = log.time_ns("mach").tolist(), log["mach"].tolist()
    for t, text in list(zip(when, texts, strict=True))[1:-1:7]:
        value = [m for n, m in zip(ns, mach, strict=True) if n <= t][-1]
        assert f"| Mach number | {value:.2f} | {value:.2f} |" in text.splitlines()
        assert text.startswith(f"**{t / 1e9:.1f} s**")


def test_boosters_fall_behind_the_core_and_drift_outwards(monkeypatch: pytest.MonkeyPatch) -> None:
    """A booster that leaves at 7 s under 2 g is g t^2 aft and 2 m/s t off the axis, up to 3 s later."""
    sent: dict[str, tuple[np.ndarray, np.ndarray]] = {}

    def keep(_: Scene, entity: str, times_ns: np.ndarray, columns: Iterable[ComponentColumn]) -> None:
        moved = next(c for c in columns if "translation" in str(c.component_descriptor()))
        sent[entity] = times_ns, moved.as_arrow_array().flatten().flatten().to_numpy().reshape(-1, 3)

    class Constant:
        def __contains__(self, name: str) -> bool:
            return True

        def time_ns(self, name: str) -> np.ndarray:
            return np.array([0, 20_000_000_000])

        def __getitem__(self, name: str) -> np.ndarray:
            return np.array([2.0, 2.0])

    monkeypatch.setattr(Scene, "_send", keep)
    stage = shape().stages[0]
    profile = np.array([[4.0, 0.0], [5.0, 0.4], [9.0, 0.4], [9.0, 0.0]])
    stays, leaves = BoosterShape("stays", profile, (-1.0, 0.0)), BoosterShape("leaves", profile, (0.6, 0.8))
    after = replace(stage, boosters=(stays,), keeps_clock=True)
    drawn = replace(shape(), stages=(replace(stage, boosters=(stays, leaves)), after))
    scene = Scene(rr.RecordingStream("test"), "flight", place_of(flight()), drawn, exaggeration_of(flight().log, drawn))
    scene._stage = 0
    scene._drop(drawn, 1, 7_000_000_000, Constant())  # type: ignore[arg-type]  # two of its methods
    (entity,) = sent
    times_ns, moved = sent[entity]
    assert entity == "vehicle/body/hull/left/leaves"
    k = int(np.argmin(np.abs(times_ns - 10_000_000_000)))
    t = 1e-9 * (times_ns[k] - 7_000_000_000)
    assert moved[k] == pytest.approx([-9.80665 * t * t, 2.0 * t * 0.6, 2.0 * t * 0.8], rel=1e-6)
