"""Drop points of flights and campaigns: against the log of the same flight, and ellipses against their coverage."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from xml.etree import ElementTree

import numpy as np
import pytest

import maxq
from maxq import DataSet, Flight
from maxq.control.kernel.records import Array
from maxq.sim.campaign.drop_zones import drop_zones, prediction_ellipse, radii_m
from maxq.sim.run.fly import FlightRun, fly
from maxq.tools import simrun

CHANGES = [
    "run.duration_s=46",
    "run.step_s=0.005",
    "log.slow_hz=100",
    'vehicle.stage.0.name="booster"',
    "vehicle.stage.0.separation={ballistic_kgpm2=500.0}",
]
CAMPAIGN = """\
schema = 1
extends = "checkcases/two-stage.toml"
vehicle_overrides = { "stage.0.separation.ballistic_kgpm2" = 500.0 }
[run]
duration_s = 46.0
step_s = 0.005
[campaign]
runs = 4
seed = 1
[campaign.envelope]
runs = 0
[[disperse]]
key = "vehicle.stage.0.engine.thrust_factor"
distribution = "normal"
three_sigma = 0.03
"""


@pytest.fixture(scope="module")
def flown() -> Flight:
    return fly(maxq.load("checkcases/two-stage", *CHANGES))


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> DataSet:
    folder = tmp_path_factory.mktemp("drops")
    (folder / "two.toml").write_text(CAMPAIGN)
    return maxq.campaign(folder / "two.toml", folder / "out", workers=1)


def test_the_recorded_state_is_that_of_the_log_and_does_not_change_the_flight(
    flown: Flight, monkeypatch: pytest.MonkeyPatch
) -> None:
    (kept,) = flown.separations
    assert (kept.stage, kept.time_ns) == (0, 45_000_000_000)
    (body,) = maxq.impacts(flown).dropped()
    assert body.r_I_m == pytest.approx(kept.r_I_m, abs=1e-4)  # change of the acceleration within 0.01 s
    assert body.v_I_mps == pytest.approx(kept.v_I_mps, abs=1e-3)
    unlogged = fly(flown.scenario, log=False)  # in one segment
    assert unlogged.separations == flown.separations
    monkeypatch.setattr(FlightRun, "_stops_ns", lambda run, until_ns: iter([until_ns]))
    assert fly(flown.scenario, log=False).state_hash == flown.state_hash == unlogged.state_hash


def test_a_campaign_records_the_drop_point_of_each_run(data: DataSet) -> None:
    table = data.to_pandas("drop_1_latitude_deg", "drop_1_longitude_deg", "drop_1_fall_s")
    assert len(table) == 4
    assert table.drop_1_latitude_deg.nunique() == 4
    loaded = data.campaign.inputs(2).loaded
    log = loaded.scenario.log.model_copy(update={"slow_hz": 200.0})
    logged = fly(replace(loaded, scenario=loaded.scenario.model_copy(update={"log": log})))
    (point,) = maxq.impacts(logged).drop_points()
    assert table.drop_1_latitude_deg[2] == pytest.approx(point.latitude_deg, abs=1e-6)  # 0.1 m
    assert table.drop_1_longitude_deg[2] == pytest.approx(point.longitude_deg, abs=1e-6)
    assert table.drop_1_fall_s[2] == pytest.approx(point.fall_s, abs=1e-3)
    (zone,) = drop_zones(data)
    assert (zone.name, zone.model) == ("first", "drag, m / (C_D A) = 500 kg/m2")
    assert zone.latitude_deg == pytest.approx(table.drop_1_latitude_deg.mean(), abs=1e-12)
    assert zone.longitude_deg == pytest.approx(table.drop_1_longitude_deg.mean(), abs=1e-9)
    assert zone.runs.tolist() == [0, 1, 2, 3]


def test_the_page_shows_the_zone(data: DataSet) -> None:
    assert simrun.main(["report", str(data.folder)]) == 3
    page = (data.folder / "report.html").read_text()
    assert "Impact points of separated bodies." in page
    assert "drag, m / (C_D A) = 500 kg/m2" in page
    columns = (data.folder / "figures" / "drops.csv").read_text().splitlines()
    assert sum(row.startswith("first,runs,") for row in columns) == 4


def test_the_zone_is_an_area_of_the_map(data: DataSet, tmp_path: Path) -> None:
    """Its points are those of the data set, and the ring is an ellipse about them."""
    files = str(tmp_path / "z.kml"), str(tmp_path / "z.geojson")
    assert simrun.main(["export", str(data.folder), "--kml", files[0], "--geojson", files[1]]) == 0
    zone, *drops = json.loads(Path(files[1]).read_text())["features"]
    table = data.to_pandas("drop_1_latitude_deg", "drop_1_longitude_deg")
    wanted = table[["drop_1_longitude_deg", "drop_1_latitude_deg"]].to_numpy()
    assert np.abs(np.array([f["geometry"]["coordinates"] for f in drops]) - wanted).max() < 1e-7
    assert zone["geometry"]["type"] == "Polygon"
    (ring,) = np.array(zone["geometry"]["coordinates"])
    assert ring[0].tolist() == ring[-1].tolist()
    x, y = (ring - ring[0]).T
    assert np.sum(x[:-1] * y[1:] - x[1:] * y[:-1]) > 0.0  # anticlockwise: RFC 7946
    (found,) = drop_zones(data)
    assert np.ptp(y) / 2 * 110_930.0 == pytest.approx(np.ptp(found.outline_m()[:, 1]) / 2, rel=0.01)  # m per deg
    root = ElementTree.parse(files[0]).getroot()
    (drawn,) = root.iterfind(".//{*}Polygon/{*}outerBoundaryIs/{*}LinearRing/{*}coordinates")
    assert drawn.text is not None
    assert np.array_equal([[float(v) for v in p.split(",")] for p in drawn.text.split()], ring)
    assert simrun.main(["export", str(data.folder), "--csv", str(tmp_path / "z.csv")]) == 2


def test_the_ellipse_contains_the_next_point_as_often_as_it_states() -> None:
    """6 points of a normal distribution with correlated axes, and a seventh: 4,000 times."""
    random, inside = np.random.default_rng(5), 0
    root = np.array([[300.0, 0.0], [120.0, 50.0]])
    for _ in range(4000):
        points = random.normal(size=(7, 2)) @ root.T
        (major, minor), azimuth = prediction_ellipse(*points[:6].T, level=0.9)
        away = points[6] - points[:6].mean(axis=0)
        along = np.array([math.sin(math.radians(azimuth)), math.cos(math.radians(azimuth))])
        inside += math.hypot(away @ along / major, (away[0] * along[1] - away[1] * along[0]) / minor) < 1.0
    assert inside / 4000 == pytest.approx(0.9, abs=0.0143)  # three standard deviations of the count


def test_an_ellipse_has_the_axes_of_the_covariance() -> None:
    angle = np.linspace(0.0, 2.0 * math.pi, 1000, endpoint=False)
    x, y = 200.0 * np.cos(angle), 50.0 * np.sin(angle)
    turn = math.radians(30.0)  # azimuth of the long axis
    east, north = x * math.sin(turn) + y * math.cos(turn), x * math.cos(turn) - y * math.sin(turn)
    (major, minor), azimuth = prediction_ellipse(east, north, level=0.99)
    assert azimuth == pytest.approx(30.0, abs=1e-9)
    assert major / minor == pytest.approx(4.0, rel=1e-9)
    assert major == pytest.approx(200.0 / math.sqrt(2.0) * math.sqrt(-2.0 * math.log(0.01)), rel=0.01)  # many points
    assert all(map(math.isnan, prediction_ellipse(east[:2], north[:2])[0]))


def test_a_zone_across_the_antimeridian_is_in_one_piece(data: DataSet) -> None:
    longitude = np.array([179.99, -179.99, 179.97, -179.97, math.nan])
    columns: dict[str, Array] = {"drop_1_longitude_deg": longitude, "drop_1_latitude_deg": np.full(5, 60.0)}
    crossing = SimpleNamespace(
        campaign=data.campaign,
        parts=["x"],
        read=lambda names: None,
        numbers=columns.__getitem__,
        void=np.zeros(5, bool),
        runs=np.arange(5),
    )
    (zone,) = drop_zones(crossing)  # type: ignore[arg-type]  # a stand-in for DataSet
    assert abs(zone.longitude_deg) == pytest.approx(180.0, abs=1e-9)
    assert zone.runs.tolist() == [0, 1, 2, 3]
    east, north = radii_m(6378137.0, 1.0 / 298.257223563, math.radians(60.0))
    assert zone.east_m == pytest.approx(np.radians([-0.01, 0.01, -0.03, 0.03]) * east, abs=1e-3)
    assert math.radians(1.0) * east == pytest.approx(55800.0, abs=5.0)  # NGA, length of a degree at 60 deg
    assert math.radians(1.0) * north == pytest.approx(111412.0, abs=5.0)
