"""Flights that are cut into segments, inspected and logged keep these invariants."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

import maxq
from maxq import FlightRun, LoadedScenario, record
from maxq.control.kernel.records import Array
from maxq.sim.flight.channels import unit_suffix
from maxq.sim.flight.metric_table import (
    METRIC_NAMES,
    METRICS,
    CutoffMetrics,
    EndMetrics,
    ImpactMetrics,
    LaunchMetrics,
    MetricIndex,
    OrbitMetrics,
    SectionMetrics,
    StepMetrics,
    WaveMetrics,
    unit_of,
)
from maxq.sim.flight.telemetry import SLOW
from maxq.sim.run.fly import fly
from maxq.sim.run.launch_frames import LaunchFrames, LaunchSite
from maxq.sim.scenario.loader import load_scenario


def loaded(*overrides: str) -> LoadedScenario:
    return load_scenario("nominal", ["run.duration_s=1.5", *overrides])


def test_where_a_flight_is_cut_into_segments_does_not_matter() -> None:
    hashes = set()
    for length_ns in (None, 1_000_000, 7_000_000, 1_500_000_000):
        run = FlightRun(loaded(), log=False)
        while not run.finished:
            run.fly_segment(length_ns)
        hashes.add(run.state_hash())
    assert len(hashes) == 1


FALLS = (
    "run.stop_at=['impact']",
    "initial.ned_mps=[0.0, 0.0, 55.5]",
    "initial.euler_deg=[0.0, 80.0, 0.0]",
    "initial.geodetic={latitude_deg=33.0, longitude_deg=126.0, altitude_m=2.0}",
)


@pytest.mark.parametrize("end", [("run.duration_s=0.02",), ("run.duration_s=0.0235",), FALLS])
def test_rows_rise_in_time_and_the_last_one_is_the_end(end: tuple[str, ...]) -> None:
    """Rows rise in time and the last one is the end, on a row's time or between two, by duration or by an event."""
    flight = fly(load_scenario("nominal", ["run.duration_s=2", *end, "log.fast_hz=100", "log.slow_hz=50"]))
    assert flight.outcome == ("impact" if end is FALLS else "duration")
    assert end is not FALLS or 0.03 < flight.end_s < 0.04
    for channel, hz in (("gimbal_pitch_angle_deg", 100.0), ("altitude_m", 50.0)):
        t = flight.time_s(channel)
        np.testing.assert_allclose(t[:-1], np.arange(len(t) - 1) / hz, atol=1e-9)
        assert t[-1] == pytest.approx(flight.end_s, abs=1e-9)
        assert t[-1] > t[-2]


def test_looking_changes_nothing() -> None:
    seen, blind = FlightRun(loaded()), FlightRun(loaded())
    while not blind.finished:
        seen.present()
        rows_seen, rows_blind = seen.fly_segment(100_000_000), blind.fly_segment(100_000_000)
        for group in rows_blind:
            np.testing.assert_array_equal(rows_seen[group][1], rows_blind[group][1])
        assert seen.state_hash() == blind.state_hash()


def test_what_is_seen_is_what_is_logged() -> None:
    """At 1.005 s the computer does nothing; `present` gives the instant before the processing due then."""
    run = FlightRun(loaded("log.slow_hz=1000.0"))
    while run.now_s < 1.005:
        run.fly_segment(5_000_000)
    present = run.present()
    rows = run.fly_segment(5_000_000)
    for group, (times, values) in rows.items():
        assert times[0] == 1_005_000_000
        for channel, value in zip(run.table.columns(group), values[0], strict=True):
            assert present[channel.name] == value or (math.isnan(value) and math.isnan(present[channel.name]))


@pytest.mark.parametrize(
    ("step_s", "fast_hz"), [(0.00001, 1000.0), (0.001, 1e6), (0.003, 1000.0), (1.0, 1000.0), (1.0, 1.0)]
)
def test_segments_are_short_enough_to_be_interrupted(step_s: float, fast_hz: float) -> None:
    run = FlightRun(loaded(f"run.step_s={step_s}", f"log.fast_hz={fast_hz}", f"log.slow_hz={min(fast_hz, 10.0)}"))
    step_ns = round(1e9 * step_s)
    assert run.segment_ns % step_ns == 0
    row_ns = round(1e9 / fast_hz)
    longest_ns = min(max(1_000_000_000, 1_000 * min(step_ns, row_ns)), 20_000 * step_ns, 20_000 * row_ns)
    assert run.segment_ns <= max(step_ns, longest_ns)
    assert run.segment_ns > 0.5 * longest_ns


def test_angles_are_scaled_once(tmp_path: Path) -> None:
    flight = fly(loaded())
    assert flight.final["latitude_deg"] == pytest.approx(36.7, abs=1e-3)
    assert flight["pitch_deg"][0] == pytest.approx(90.0, abs=1e-6)
    record(FlightRun(loaded()), tmp_path)
    assert maxq.read(tmp_path / "flight.mcap")["latitude_deg"][0] == pytest.approx(36.7, abs=1e-9)


def test_names_of_metrics_end_with_their_unit() -> None:
    assert (
        *MetricIndex._fields,
        *SectionMetrics._fields,
        *EndMetrics._fields,
        *WaveMetrics._fields,
        *StepMetrics._fields,
        *LaunchMetrics._fields,
        *CutoffMetrics._fields,
        *ImpactMetrics._fields,
        *OrbitMetrics._fields,
    ) == METRIC_NAMES
    for metric in METRICS.values():
        assert metric.name.endswith("_" + unit_suffix(unit_of(metric.name))) or unit_of(metric.name) == "1"


def test_every_stage_has_its_events(tmp_path: Path) -> None:
    scenario = load_scenario("checkcases/two-stage")
    flight = record(FlightRun(scenario), tmp_path)
    told = [(event.name, event.stage) for event in flight.events]
    assert told[:3] == [("ignition", 1), ("burnout", 1), ("separation", 1)]
    assert ("ignition", 2) in told
    assert [event.time_ns for event in flight.events] == sorted(event.time_ns for event in flight.events)
    texts = [(event.text, event.time_ns) for event in maxq.read(tmp_path / "flight.mcap").events]
    assert ("separation (stage 1)", flight.events[2].time_ns) in texts
    assert len(texts) == len(flight.events)


# the body in the launch frame


def turned(q: Array, v: tuple[float, float, float]) -> Array:
    """Return the vectors q v q* for quaternions (n, 4), scalar first."""
    w, u = q[:, :1], q[:, 1:]
    t = 2.0 * np.cross(u, np.array(v))
    return np.asarray(v + w * t + np.cross(u, t))


@pytest.mark.parametrize("shape", [[], ["earth.shape=sphere"], ["earth.shape=flat", "earth.rotating=false"]])
def test_frames_agree_with_the_logged_attitude_and_place(shape: list[str]) -> None:
    gravity = ["earth.gravity=uniform"] if shape else []
    scenario = load_scenario("nominal", ["run.duration_s=30.0", "run.step_s=0.002", *shape, *gravity])
    run = FlightRun(scenario)
    earth = run.packed.parameters[0].environment.earth
    frames = LaunchFrames(run.table, LaunchSite(earth, scenario.scenario.site), 20_000_000)
    index = run.table.index
    times, positions = [], []
    while not run.finished:
        slow_ns, slow = run.fly_segment()[SLOW]
        path = frames.path(slow_ns, slow)
        times += path.times_ns.tolist()
        positions += path.translation_m.tolist()
        rows = slow[np.isin(slow_ns, path.times_ns)][: len(path.times_ns)]
        yaw, pitch = (np.radians(rows[:, index(f"{n}_deg")]) for n in ("yaw", "pitch"))
        nose = np.stack([np.cos(pitch) * np.sin(yaw), np.cos(pitch) * np.cos(yaw), np.sin(pitch)], axis=1)
        # NED turns away from the launch site's axes as the vehicle flies: by 3 km / 6400 km here
        np.testing.assert_allclose(turned(path.rotation, (1.0, 0.0, 0.0)), nose, atol=6e-4)
        np.testing.assert_allclose(np.linalg.norm(path.rotation, axis=1), 1.0, atol=1e-9)
        np.testing.assert_allclose(path.translation_m[:, 2], rows[:, index("altitude_m")] - 30.0, atol=1.0)
    assert times == list(range(0, 30_000_000_000 + 1, 20_000_000))
    np.testing.assert_allclose(positions[0], 0.0, atol=1e-8)
    east, north, _ = positions[-1]
    assert math.degrees(math.atan2(east, north)) % 360.0 == pytest.approx(250.0, abs=1.0)


def test_transforms_that_slow_rows_do_not_meet_come_with_the_next_row() -> None:
    scenario = loaded()
    run = FlightRun(scenario)
    site = LaunchSite(run.packed.parameters[0].environment.earth, scenario.scenario.site)
    frames = LaunchFrames(run.table, site, 15_000_000)
    slow_ns, slow = run.fly_segment()[SLOW]
    first = frames.path(slow_ns[:3], slow[:3]).times_ns
    rest = frames.path(slow_ns[3:], slow[3:]).times_ns
    assert [*first, *rest[:3]] == [0, 20_000_000, 30_000_000, 50_000_000, 60_000_000]
