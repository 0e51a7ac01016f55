"""Exports of a flight (`simrun export LOG`) against independent readers.

These are csv, SciPy, json, an XML parser, and a strict parser of CCSDS 502.0-B-2 written here. Positions are compared
by a closed form of the Earth-fixed coordinates.
"""

from __future__ import annotations

import csv
import json
import math
import re
import sys
from datetime import UTC, datetime, timedelta
from itertools import pairwise
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from scipy.io import loadmat

import maxq
from maxq import Log
from maxq.control.kernel.records import Array
from maxq.sim.run.impact_channels import WithImpacts
from maxq.tools import simrun
from maxq.tools.exchange.maps import Feature, write_geojson
from maxq.tools.exchange.orbit_messages import gmst_rad

A, E2 = 6378137.0, 0.00669437999014  # WGS 84
MU, SPIN = 3.986004418e14, 7.292115e-5
UTC_TEXT = "2027-03-01T13:00:00+01:00"
CHANGES = [
    "run.duration_s=60",
    "log.slow_hz=20",
    f'site.utc="{UTC_TEXT}"',
    'vehicle.stage.0.name="booster"',
    "vehicle.stage.0.separation={ballistic_kgpm2=500.0}",
]
KML = {"k": "http://www.opengis.net/kml/2.2"}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with the log of two stages (separation at 45 s), and with all exports."""
    out = tmp_path_factory.mktemp("exchange")
    maxq.record(maxq.load("checkcases/two-stage", *CHANGES), out)
    files = [
        word for kind in ("csv", "mat", "kml", "geojson", "oem", "opm") for word in (f"--{kind}", f"{out}/f.{kind}")
    ]
    tables = ["--channels", "/truth", "--channels", "/impact", "--channels", "/impact_drag", "--channels", "mass_kg"]
    assert simrun.main(["export", str(out / "flight.mcap"), *files, *tables, "--ballistic", "800"]) == 0
    return out


@pytest.fixture(scope="module")
def log(folder: Path) -> Log:
    return maxq.read(folder / "flight.mcap")


def earth_fixed(longitude_deg: Array, latitude_deg: Array, altitude_m: Array) -> Array:
    """Return Earth-fixed positions (n, 3), m, of places on WGS 84."""
    lon, lat = np.radians(longitude_deg), np.radians(latitude_deg)
    normal = A / np.sqrt(1.0 - E2 * np.sin(lat) ** 2)
    p = (normal + altitude_m) * np.cos(lat)
    return np.stack([p * np.cos(lon), p * np.sin(lon), (normal * (1.0 - E2) + altitude_m) * np.sin(lat)], axis=1)


def logged(log: Log, stem: str) -> Array:
    suffix = "mps" if stem.startswith("v") else "m"
    return np.stack([log[f"{stem}_{axis}_{suffix}"] for axis in "xyz"], axis=1)


# tables
def test_matlab_reads_every_value_with_its_unit(folder: Path, log: Log) -> None:
    content = loadmat(folder / "f.mat", simplify_cells=True)
    slow, flight = content["slow"], WithImpacts(log, 800.0)
    assert np.array_equal(slow["time_s"], log.time_s("/truth"))
    for name in ("r_I_x_m", "altitude_m", "q_BI_w", "mass_kg"):
        assert np.array_equal(slow[name], log[name])
        assert content["units"][name] == log.channel(name).unit
        assert content["descriptions"][name] == log.channel(name).description
    for name in ("impact_latitude_deg", "impact_longitude_deg", "impact_fall_s"):
        assert np.array_equal(slow[name], flight[name])
    assert len(content["impact"]["time_s"]) == 61
    assert np.array_equal(content["impact"]["impact_drag_fall_s"], flight["impact_drag_fall_s"])
    assert content["units"]["impact_fall_s"] == "s"
    assert set(slow) == {"time_s", *log.topic("/truth"), *flight.topic("/impact"), "mass_kg"}
    raw = loadmat(folder / "f.mat")["slow"]
    assert raw["altitude_m"][0, 0].shape == (len(log["altitude_m"]), 1)


def test_h5py_reads_every_value_with_its_unit(folder: Path, log: Log) -> None:
    h5py = pytest.importorskip("h5py", reason="the extra maxq[hdf5] is not installed")
    file = str(folder / "f.hdf5")
    given = ["--channels", "/truth", "--channels", "/impact_drag", "--ballistic", "800"]
    assert simrun.main(["export", str(folder / "flight.mcap"), "--hdf5", file, *given]) == 0
    flight = WithImpacts(log, 800.0)
    with h5py.File(file) as content:
        assert set(content) == {"slow", "impact"}
        assert set(content["slow"]) == {"time_s", *log.topic("/truth")}
        for group, names in (("slow", log.topic("/truth")), ("impact", flight.topic("/impact_drag"))):
            for name in names:
                found, channel = content[group][name], flight.table.channel(name)
                assert np.array_equal(found[:], flight[name], equal_nan=True)
                assert np.array_equal(content[group]["time_s"][:], flight.time_s(name))
                assert dict(found.attrs) == {
                    "units": channel.unit,
                    "long_name": channel.description,
                    "topic": flight.table.topic(name).name,
                }
        assert content["slow"]["time_s"].attrs["units"] == "s"


def test_hdf5_needs_its_extra(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "h5py", None)
    file = folder / "without.hdf5"
    assert simrun.main(["export", str(folder / "flight.mcap"), "--hdf5", str(file)]) == 2
    assert "pip install 'maxq[hdf5]'" in capsys.readouterr().err
    assert not file.exists()


def test_a_csv_reader_reads_every_value(folder: Path, log: Log) -> None:
    with (folder / "f.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    kept = [row for row in rows if row["altitude_m"]]
    assert np.array_equal([float(row["time_s"]) for row in kept], log.time_s("altitude_m"))
    assert np.array_equal([float(row["altitude_m"]) for row in kept], log["altitude_m"])
    assert sum(row["impact_drag_fall_s"] != "" for row in rows) == 61


# maps
def features(folder: Path) -> dict[str, dict[str, object]]:
    collection = json.loads((folder / "f.geojson").read_text())
    assert collection["type"] == "FeatureCollection"
    return {f["properties"]["name"]: f for f in collection["features"]}


def test_the_map_is_the_flight_in_geodetic_coordinates(folder: Path, log: Log) -> None:
    line = features(folder)["trajectory"]
    places = np.array(line["geometry"]["coordinates"])  # type: ignore[index]
    rows = np.searchsorted(log.time_s("/truth"), np.arange(61.0))
    assert np.abs(earth_fixed(*places.T) - logged(log, "r_E")[rows]).max() < 0.02  # 1e-7 deg and 1 mm, rounded

    root = ElementTree.parse(folder / "f.kml").getroot()
    assert root.tag == "{http://www.opengis.net/kml/2.2}kml"
    marks = {mark.findtext("k:name", "", KML): mark for mark in root.iterfind(".//k:Placemark", KML)}
    shape = marks["trajectory"].find("k:LineString", KML)
    assert shape is not None
    assert [child.tag.partition("}")[2] for child in shape] == ["altitudeMode", "coordinates"]
    assert shape.findtext("k:altitudeMode", "", KML) == "absolute"
    drawn = [[float(x) for x in point.split(",")] for point in shape.findtext("k:coordinates", "", KML).split()]
    assert np.array_equal(drawn, places)
    assert set(marks) == set(features(folder))
    trace = marks["impact points"].find("k:LineString", KML)
    assert trace is not None
    assert trace.findtext("k:altitudeMode", "", KML) == "clampToGround"
    assert all(point.count(",") == 1 for point in trace.findtext("k:coordinates", "", KML).split())


def test_the_drop_point_of_a_stage_is_the_impact_point_at_its_separation(folder: Path, log: Log) -> None:
    """The trace with drag has a point each second; 45 s is that of the separation."""
    flight = WithImpacts(log, 500.0)
    drop = features(folder)["drop of booster"]
    longitude, latitude = drop["geometry"]["coordinates"]  # type: ignore[index]
    assert flight["impact_drag_longitude_deg"][45] == pytest.approx(longitude, abs=1e-4)  # 10 m: it is the row after
    assert flight["impact_drag_latitude_deg"][45] == pytest.approx(latitude, abs=1e-4)
    assert flight["impact_drag_fall_s"][45] == pytest.approx(drop["properties"]["fall_s"], abs=0.05)  # type: ignore[index]
    assert abs(flight["impact_longitude_deg"][900] - longitude) > 1e-3  # not that in vacuum
    assert drop["properties"]["model"] == "m / (C_D A) = 500 kg/m2"  # type: ignore[index]
    (body,) = flight.dropped()
    before = slice(895, 900)  # five rows until 44.95 s; the row at 45 s has the CG of the upper stage, 2 m ahead
    t = log.time_s("r_I_x_m")[before] - 45.0
    for found, stem, tolerance in ((body.r_I_m, "r_I", 2e-4), (body.v_I_mps, "v_I", 5e-3)):
        exact = [np.polyfit(t, column, 4)[-1] for column in logged(log, stem)[before].T]  # a polynomial through them
        assert np.abs(found - exact).max() < tolerance  # change of the acceleration within 0.05 s
    assert body.time_s == 45.0


def test_a_line_across_the_antimeridian_is_cut(tmp_path: Path) -> None:
    places = np.array([[179.0, 10.0, 0.0], [179.8, 11.0, 5.0], [-179.8, 13.0, 15.0], [-179.0, 14.0, 20.0]])
    write_geojson(tmp_path / "f.geojson", [Feature("x", "trajectory", places, {})])
    (feature,) = json.loads((tmp_path / "f.geojson").read_text())["features"]
    assert feature["geometry"]["type"] == "MultiLineString"
    assert feature["geometry"]["coordinates"] == [
        [[179.0, 10.0, 0.0], [179.8, 11.0, 5.0], [180.0, 12.0, 10.0]],
        [[-180.0, 12.0, 10.0], [-179.8, 13.0, 15.0], [-179.0, 14.0, 20.0]],
    ]


# orbit messages
_META = (
    "OBJECT_NAME",
    "OBJECT_ID",
    "CENTER_NAME",
    "REF_FRAME",
    "TIME_SYSTEM",
    "START_TIME",
    "STOP_TIME",
    "INTERPOLATION",
    "INTERPOLATION_DEGREE",
)


def parsed_oem(text: str) -> list[tuple[dict[str, str], list[tuple[datetime, Array]]]]:
    """Return the segments of an OEM; keywords must have the order of 502.0-B-2, table 5-3, and lines its syntax."""
    lines = [line for line in text.split("\n") if line.strip()]
    assert all(len(line) <= 254 and line.isascii() for line in lines)
    header = [line.split(" = ")[0] for line in lines[:3]]
    assert header == ["CCSDS_OEM_VERS", "CREATION_DATE", "ORIGINATOR"]
    assert lines[0] == "CCSDS_OEM_VERS = 2.0"
    segments: list[tuple[dict[str, str], list[tuple[datetime, Array]]]] = []
    at = 3
    while at < len(lines):
        assert lines[at] == "META_START"
        stop = lines.index("META_STOP", at)
        meta = dict(line.split(" = ") for line in lines[at + 1 : stop])
        assert list(meta) == [key for key in _META if key in meta]
        assert set(_META[:7]) <= set(meta)
        at, rows = stop + 1, []
        while at < len(lines) and lines[at] != "META_START":
            date, *numbers = lines[at].split(" ")
            assert re.fullmatch(r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d\.\d{6}", date)
            assert len(numbers) == 6
            rows.append((datetime.fromisoformat(date), np.array(numbers, float)))
            at += 1
        dates = [date for date, _ in rows]
        assert all(a < b for a, b in pairwise(dates))
        assert (dates[0], dates[-1]) == tuple(datetime.fromisoformat(meta[key]) for key in ("START_TIME", "STOP_TIME"))
        segments.append((meta, rows))
    return segments


def test_mean_sidereal_time_and_teme_are_those_of_a_published_example() -> None:
    """Vallado, Fundamentals of Astrodynamics and Applications, example 3-15: 2004-04-06, UT1 - UTC = -0.4399619 s."""
    angle = gmst_rad(datetime(2004, 4, 6, 7, 51, 28, 386009, UTC) - timedelta(seconds=0.4399619))
    assert math.degrees(angle) == pytest.approx(312.8098943, abs=1e-6)
    x, y = -1033.4750313, 7901.3055856  # PEF
    teme = math.cos(angle) * x - math.sin(angle) * y, math.sin(angle) * x + math.cos(angle) * y
    assert teme == pytest.approx((5094.1801621, 6127.6446595), abs=1e-4)


def test_the_ephemeris_is_the_flight_in_teme(folder: Path, log: Log) -> None:
    segments = parsed_oem((folder / "f.oem").read_text())
    assert {meta["REF_FRAME"] for meta, _ in segments} == {"TEME"}
    starts = [(rows[0][0] - datetime(2027, 3, 1, 12)).total_seconds() for _, rows in segments]
    assert starts == [0.0, 40.0, 45.0, 48.0]  # ignition, burnout, separation, ignition: half of log.slow_hz exactly
    angle, times = gmst_rad(datetime(2027, 3, 1, 12, tzinfo=UTC)), log.time_s("/truth")
    r, v = logged(log, "r_I"), logged(log, "v_I")
    for _, rows in segments:
        for date, state in rows:
            k = int(np.searchsorted(times, (date - datetime(2027, 3, 1, 12)).total_seconds() - 1e-6))
            for offset, vector, tolerance in ((0, r[k], 1e-6), (3, v[k], 1e-9)):
                turned = (vector[0] + 1j * vector[1]) * np.exp(1j * angle) / 1e3
                assert state[offset : offset + 3] == pytest.approx(
                    [turned.real, turned.imag, vector[2] / 1e3], abs=tolerance
                )


def test_the_earth_fixed_ephemeris_is_that_of_the_log(folder: Path, log: Log) -> None:
    assert simrun.main(["export", str(folder), "--oem", f"{folder}/e.oem", "--frame", "ITRF2000"]) == 0
    rows = [row for _, some in parsed_oem((folder / "e.oem").read_text()) for row in some]
    state = rows[30][1]
    assert state[:3] == pytest.approx(logged(log, "r_E")[600] / 1e3, abs=1e-6)
    assert np.linalg.norm(state[3:]) == pytest.approx(log["speed_mps"][600] / 1e3, abs=2e-9)


def test_the_orbit_message_is_the_state_after_the_last_burnout(folder: Path, log: Log) -> None:
    lines = [line for line in (folder / "f.opm").read_text().split("\n") if line]
    given = dict(line.split(" = ") for line in lines)
    numbers = {
        key: float(value.split(" ")[0])
        for key, value in given.items()
        if value.split(" ")[0][-1].isdigit() and "DATE" not in key and key != "EPOCH"
    }
    assert list(given)[:9] == ["CCSDS_OPM_VERS", "CREATION_DATE", "ORIGINATOR", *_META[:5], "EPOCH"]
    burnout_s = max(event.time_ns / 1e9 for event in log.events if event.text.startswith("burnout"))
    epoch_s = (datetime.fromisoformat(given["EPOCH"]) - datetime(2027, 3, 1, 12)).total_seconds()
    k = int(np.searchsorted(log.time_s("/truth"), burnout_s))
    assert epoch_s == pytest.approx(log.time_s("/truth")[k], abs=1e-6)
    assert numbers["MASS"] == pytest.approx(log["mass_kg"][k], abs=1e-6)
    r, v = (np.array([numbers[axis + end] for axis in "XYZ"]) for end in ("", "_DOT"))
    assert np.linalg.norm(r) == pytest.approx(np.linalg.norm(logged(log, "r_I")[k]) / 1e3, abs=2e-6)
    # elements from the state (by the vis-viva equation, the momentum and the eccentricity vector), and back
    mu, h = MU / 1e9, np.cross(r, v)
    assert numbers["GM"] == pytest.approx(mu)
    axis = 1.0 / (2.0 / np.linalg.norm(r) - v @ v / mu)
    assert numbers["SEMI_MAJOR_AXIS"] == pytest.approx(axis, abs=1e-3)
    towards = np.cross(v, h) / mu - r / np.linalg.norm(r)
    assert numbers["ECCENTRICITY"] == pytest.approx(np.linalg.norm(towards), abs=1e-8)
    assert numbers["INCLINATION"] == pytest.approx(math.degrees(math.acos(h[2] / np.linalg.norm(h))), abs=1e-6)
    node = math.radians(numbers["RA_OF_ASC_NODE"])
    along = math.radians(numbers["ARG_OF_PERICENTER"] + numbers["TRUE_ANOMALY"])
    tilt = math.radians(numbers["INCLINATION"])
    unit = [
        math.cos(node) * math.cos(along) - math.sin(node) * math.sin(along) * math.cos(tilt),
        math.sin(node) * math.cos(along) + math.cos(node) * math.sin(along) * math.cos(tilt),
        math.sin(along) * math.sin(tilt),
    ]
    assert unit == pytest.approx((r / np.linalg.norm(r)).tolist(), abs=1e-8)


# wrong input
@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["nominal", "--csv", "f.csv"], "nominal is no log: fly the scenario first (simrun fly nominal), then export"),
        (["LOG"], "give a file to write: --fmu, --csv, --mat, --hdf5, --kml, --geojson, --oem, --opm"),
        (["LOG", "--csv", "f.txt"], "--csv f.txt: the name of this file ends with .csv"),
        (["LOG", "--csv", "f.csv", "--channels", "altitud_m"], "did you mean altitude_m?"),
        (["LOG", "--opm", "f.opm", "--utc", "tomorrow"], "--utc tomorrow: is not a date and time; allowed: ISO 8601"),
        (["none.mcap", "--csv", "f.csv"], "none.mcap: the log cannot be read: no such file"),
        (["LOG", "--fmu", "f.fmu"], "is a flown flight, not a scenario"),
        (["LOG", "--kml", "f.kml", "--set", "run.seed=1"], "--set needs --fmu"),
        (["LOG", "--kml", "f.kml", "--ballistic", "-1"], "'-1' is not above 0"),
    ],
)
def test_wrong_input_is_one_line(
    folder: Path, words: list[str], said: str, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(folder)
    given = ["export", *(word.replace("LOG", "flight.mcap") for word in words)]
    try:
        code = simrun.main(given)
    except SystemExit as end:
        code = int(str(end.code))
    assert code == 2
    line = capfd.readouterr().err
    assert said in line
    assert line.count("\n") == 1
    assert not any((folder / name).exists() for name in ("f.txt", "f.fmu"))
