"""Comparison with measured series: known shifts and noise, SciPy's minimum, exports of other programs, wrong files."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest
from scipy.optimize import minimize_scalar

from maxq import FlightRun, record
from maxq.control.kernel.records import Array
from maxq.sim.input.errors import ScenarioError
from maxq.sim.run.comparison import Modelled, SeriesComparison, compare
from maxq.sim.run.flight import Flight
from maxq.sim.run.fly import fly
from maxq.sim.run.measured import MeasuredChannel, MeasuredSeries, read_measured
from maxq.sim.run.units import to_unit
from maxq.sim.scenario.loader import load_scenario
from maxq.tools import simrun

SHIFT_S, TIMES = 0.3704, np.arange(0.5, 15.0, 0.04)
SCENARIO = ["run.duration_s=20", "log.slow_hz=50", "log.fast_hz=50"]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("flown")
    record(FlightRun(load_scenario("checkcases/two-stage", SCENARIO)), path)
    return path


@pytest.fixture(scope="module")
def flown() -> Flight:
    return fly(load_scenario("checkcases/two-stage", SCENARIO))


def series(flown: Flight, noise: Array, name: str = "altitude_m", sigma: float = math.nan) -> MeasuredSeries:
    values = Modelled.of(flown, name).at(TIMES + SHIFT_S) + noise
    return MeasuredSeries("file", (MeasuredChannel(name, "m", name, TIMES, values, sigma),), ())


def test_the_shift_is_that_of_the_least_squares(flown: Flight) -> None:
    noise = np.random.default_rng(2).normal(0.0, 3.0, len(TIMES))
    measured = series(flown, noise)
    (channel,), model = measured.channels, Modelled.of(flown, "altitude_m")
    found = compare(flown, measured)
    best = minimize_scalar(
        lambda s: float(np.sum((channel.values - model.at(TIMES + s)) ** 2)), (0.3, 0.45), options={"xtol": 1e-10}
    )
    assert found.shift_s == pytest.approx(best.x, abs=3e-5)  # slope over two rows, not of the line between two
    assert found.shift_s == pytest.approx(SHIFT_S, abs=3.0 * found.shift_sigma_s)
    (each,) = found.channels
    assert each.rms == pytest.approx(np.sqrt(np.mean((channel.values - model.at(TIMES + found.shift_s)) ** 2)))
    assert each.bias == pytest.approx(np.mean(channel.values - model.at(TIMES + found.shift_s)), abs=1e-9)
    assert abs(each.largest) == pytest.approx(np.abs(each.residual).max())
    assert each.time_s[each.worst] == pytest.approx(TIMES[np.abs(each.residual).argmax()] + found.shift_s)
    assert each.share == pytest.approx(each.rms / np.ptp(channel.values), rel=1e-12)


@pytest.mark.parametrize("memory", [0.0, 0.9])
def test_the_standard_error_is_the_spread_of_the_shift(flown: Flight, memory: float) -> None:
    """The formula for independent noise is too small by sqrt((1 + 0.9) / (1 - 0.9)) = 4.4 for the correlated noise."""
    rng, shifts, sigmas = np.random.default_rng(5), [], []
    slope = Modelled.of(flown, "altitude_m").slope(TIMES + SHIFT_S)
    for _ in range(30):
        noise = rng.normal(0.0, 3.0 * math.sqrt(1.0 - memory**2), len(TIMES))
        for k in range(1, len(noise)):
            noise[k] += memory * noise[k - 1]
        found = compare(flown, series(flown, noise), most_shift_s=0.5)
        shifts.append(found.shift_s)
        sigmas.append(found.shift_sigma_s)
    assert np.mean(shifts) == pytest.approx(SHIFT_S, abs=4.0 * np.std(shifts) / math.sqrt(30))
    assert np.std(shifts) == pytest.approx(np.mean(sigmas), rel=0.4)
    independent = 3.0 / math.sqrt(float(slope @ slope))
    ratio = float(np.mean(sigmas)) / independent
    assert ratio == pytest.approx(1.0, abs=0.15) if memory == 0.0 else 2.5 < ratio < 4.4


def test_a_given_shift_and_several_channels_and_angles(flown: Flight) -> None:
    yaw = Modelled.of(flown, "yaw_deg")
    turned = np.mod(yaw.at(TIMES) + 0.5 + 180.0, 360.0) - 180.0
    channel = MeasuredChannel("yaw_deg", "deg", "yaw", TIMES, turned)
    late = MeasuredChannel("altitude_m", "m", "h", TIMES + 12.0, np.zeros(len(TIMES)))
    found = compare(flown, MeasuredSeries("file", (channel, late), ()), 0.0)
    assert found.channels[0].residual == pytest.approx(np.full(len(TIMES), 0.5), abs=1e-9)
    assert found.channels[1].outside == int((TIMES + 12.0 > 20.0 + 1e-9).sum())
    assert math.isnan(found.shift_sigma_s)


def test_units_are_converted() -> None:
    assert to_unit("ft", "m") == (0.3048, 0.0)
    assert to_unit("°C", "K") == (1.0, 273.15)
    factor, offset = to_unit("°F", "K") or (0.0, 0.0)
    assert factor * 212.0 + offset == pytest.approx(373.15)
    assert to_unit("m/s²", "g") == (pytest.approx(1.0 / 9.80665), 0.0)
    assert to_unit("rad/s", "deg/s") == (pytest.approx(180.0 / math.pi), 0.0)
    assert to_unit("deg/s", "rad/s") == (pytest.approx(math.pi / 180.0), 0.0)
    assert to_unit("g", "kg") == (1e-3, 0.0)
    assert to_unit("psi", "Pa") == (pytest.approx(6894.757293, rel=1e-9), 0.0)
    assert to_unit("MPa", "Pa") == (1e6, 0.0)
    assert to_unit("mbar", "Pa") == to_unit("hPa", "Pa") == (100.0, 0.0)
    assert to_unit("km/h", "m/s") == (pytest.approx(1.0 / 3.6), 0.0)
    assert to_unit("ft", "Pa") is None


OPENROCKET = """\
# Simulation 1 (up to date)
# Time (s),Altitude (ft),Total velocity (km/h),Air temperature (°C),Drag coefficient (\u200b)
# Event IGNITION occurred at t=0 seconds
0,0,3.6,20,0.5
0.1,10,7.2,nan,0.5
# Event APOGEE occurred at t=0.15 seconds
0.2,20,,19,0.5
0.3,30,10.8,18,0.5
0.4,40,14.4,17,0.5
"""
ROCKETPY = "# Time (s), Altitude (m), Speed - Velocity Magnitude (m/s)\n0.0, 1.0, 2.0\n1.0, 3.0, 4.0\n2.0, 5.0, 6.0\n"
SEMICOLONS = "time_ms;altitude_ft;speed_mps\n0;0,5;1\n10;1,5;2\n20;2,5;3\n"


def test_exports_of_other_programs_are_read(flown: Flight, tmp_path: Path) -> None:
    file = tmp_path / "m.csv"
    file.write_text(OPENROCKET, encoding="utf-8")
    found = read_measured(file, flown.table)
    by_name = {each.name: each for each in found.channels}
    assert list(by_name) == ["altitude_m", "speed_mps", "temperature_K"]
    assert by_name["altitude_m"].values == pytest.approx(0.3048 * np.arange(0.0, 50.0, 10.0))
    assert by_name["speed_mps"].values == pytest.approx([1.0, 2.0, 3.0, 4.0])
    assert by_name["speed_mps"].time_s == pytest.approx([0.0, 0.1, 0.3, 0.4])
    assert by_name["temperature_K"].values == pytest.approx([293.15, 292.15, 291.15, 290.15])
    assert [each.gaps for each in found.channels] == [0, 1, 1]
    assert found.unused == ("Drag coefficient",)
    file.write_text(ROCKETPY)
    found = read_measured(file, flown.table)
    assert [(each.name, each.values.tolist()) for each in found.channels] == [
        ("altitude_m", [1.0, 3.0, 5.0]),
        ("speed_mps", [2.0, 4.0, 6.0]),
    ]
    file.write_text(SEMICOLONS)
    found = read_measured(file, flown.table)
    assert found.channels[0].values == pytest.approx([0.1524, 0.4572, 0.762])
    assert found.channels[0].time_s == pytest.approx([0.0, 0.01, 0.02])


def test_a_file_of_columns_names_channels_units_and_noise(flown: Flight, tmp_path: Path) -> None:
    (tmp_path / "m.csv").write_text("clock (ms),Baro,Speed (m/s)\n0,1,5\n1,2,6\n2,3,7\n")
    columns = tmp_path / "columns.toml"
    columns.write_text(
        'time = "clock"\n[[column]]\nheading = "Speed (m/s)"\nchannel = ""\n'
        '[[column]]\nheading = "Baro"\nchannel = "altitude_m"\nunit = "ft"\nadd = 100.0\nsigma = 2.0\n'
        "bias_sigma = 5.0\n"
    )
    (found,) = read_measured(tmp_path / "m.csv", flown.table, columns).channels
    assert found.values == pytest.approx([100.3048, 100.6096, 100.9144])
    assert (found.sigma, found.bias_sigma, found.time_s.tolist()) == (2.0, 5.0, [0.0, 0.001, 0.002])
    columns.write_text("[[column]]\nheading = 'Baro'\nchanel = 'altitude_m'\n")
    with pytest.raises(ScenarioError, match=r"chanel = .* did you mean channel"):
        read_measured(tmp_path / "m.csv", flown.table, columns)


@pytest.mark.parametrize(
    ("content", "options", "message"),
    [
        ("", [], "is empty"),
        ("time_s,altitude_m\n", [], "has headings but no rows"),
        ("0,1\n1,2\n", [], "has no headings"),
        ("clock,altitude_m\n0,1\n", [], "has no column of times: clock, altitude_m"),
        ("time_s,height\n0,1\n1,2\n2,3\n", [], "no column denotes a channel of the log"),
        ("time_s,altitude_m\n0,1\n1,x\n2,3\n", [], "line 3, altitude_m: 'x' is not a number"),
        ("time_s,altitude_m\n0,1\n1\n", [], "line 3: has 1 cells, the headings 2"),
        ("time_s,altitude_m\n0,1\n0,2\n1,3\n", [], "line 3, time_s = 0.0: the times do not increase"),
        ("time_s,altitude_m\n0,nan\n1,nan\n2,3\n", [], "altitude_m: has 1 numbers"),
        ("time_s,Altitude (kg)\n0,1\n1,2\n2,3\n", [], "the unit 'kg' does not fit altitude_m, in m; allowed: m, km"),
        ("time_kg,altitude_m\n0,1\n1,2\n2,3\n", [], "the unit 'kg' is no time"),
        ("time_s,Altitude (m),altitude_ft\n0,1,1\n1,2,2\n2,3,3\n", [], "two columns denote altitude_m"),
        ("time_s,h\n0,1\n1,2\n2,3\n", ["--alias", "h=altitude"], "no channel 'altitude'; did you mean altitude_m?"),
        ("time_s,h\n0,1\n1,2\n2,3\n", ["--alias", "hh=altitude_m"], "has no column 'hh'; did you mean 'h'?"),
        ("time_s,altitude_m\n900,1\n901,2\n902,3\n", [], "the times do not overlap: flight 0 to 20 s, measured 900"),
        ("time_s,altitude_m\n0,1\n1,2\n2,3\n", ["--shift", "50"], "with a shift of 50 s; give the shift by --shift"),
        (
            "time_s,altitude_m\n0,1\n1,2\n2,3\n",
            ["--limit", "mach=1"],
            "this channel is not measured; allowed: altitude",
        ),
        ("time_s,altitude_m\n0,1\n1,2\n2,3\n", ["--limit", "altitude_m.mean=1"], "rms, largest, bias"),
    ],
)
def test_wrong_files_are_rejected_on_one_line(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], content: str, options: list[str], message: str
) -> None:
    file = tmp_path / "m.csv"
    file.write_text(content)
    assert simrun.main(["compare", str(folder), str(file), *options, "--out", str(tmp_path / "out")]) == 2
    said = capsys.readouterr().err
    assert message in said
    assert said.count("\n") == 1
    assert not (tmp_path / "out").exists()


def test_the_command_writes_its_record_and_judges_limits(
    folder: Path, flown: Flight, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    noise = np.random.default_rng(3).normal(0.0, 2.0, len(TIMES))
    (channel,) = series(flown, noise).channels
    rows = [f"{t:.6f},{h:.6f}" for t, h in zip(TIMES, channel.values / 0.3048, strict=True)]
    file = tmp_path / "m.csv"
    file.write_text("\n".join(["time_s,Altitude (ft)", *rows]) + "\n")
    given = ["compare", str(folder), str(file), "--out", str(tmp_path / "out")]
    assert simrun.main([*given, "--limit", "altitude_m=20"]) == 0
    assert "PASSED: largest residual of altitude_m " in capsys.readouterr().out
    assert simrun.main([*given, "--limit", "altitude_m=20", "--limit", "altitude_m.rms=1.5"]) == 1
    said = capsys.readouterr().out
    assert "FAILED: RMS of altitude_m " in said
    assert "1 of 2 limits met" in said
    found: SeriesComparison = compare(flown, MeasuredSeries("", (channel,), ()))
    told = json.loads((tmp_path / "out" / "comparison.json").read_text())
    assert told["shift_s"] == pytest.approx(found.shift_s, abs=1e-5)
    assert told["channels"][0]["rms"] == pytest.approx(found.channels[0].rms, abs=1e-4)
    assert [limit["met"] for limit in told["limits"]] == [True, False]
    table = (tmp_path / "out" / "residuals.csv").read_text().splitlines()
    assert len(table) == 1 + len(TIMES)
    assert "Figure 1." in (tmp_path / "out" / "comparison.html").read_text()
