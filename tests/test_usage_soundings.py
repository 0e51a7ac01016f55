"""Soundings in formats of weather services serve as wind profile and as ensemble, with wind near the ground."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

import maxq
from maxq import ScenarioError
from maxq.control.kernel.records import pack
from maxq.control.kernel.tables import Pool
from maxq.sim.packing.environment import pack_wind
from maxq.sim.scenario.loader import load_scenario
from maxq.sim.world.atmosphere import pressure_altitude
from maxq.sim.world.wind import wind_ned

KNOT = 1852.0 / 3600.0

WYOMING = """\
<HTML><TITLE>University of Wyoming - Radiosonde Data</TITLE>
<H2>47138 Pohang Observations at 00Z 28 Nov 2002</H2>
<PRE>
-----------------------------------------------------------------------------
   PRES   HGHT   TEMP   DWPT   RELH   MIXR   DRCT   SKNT   THTA   THTE   THTV
    hPa     m      C      C      %    g/kg    deg   knot     K      K      K
-----------------------------------------------------------------------------
 1022.0      6    3.6   -4.4     56   2.75    250      4  275.0  282.8  275.5
 1000.0    181    2.2   -5.8     56   2.53    290     13  275.4  282.6  275.8
  925.0    823   -3.1   -9.1     63   2.10
  850.0   1513   -4.9  -24.9     19   0.58    310     25  281.0  283.0  281.1
  500.0   5590  -23.5  -40.5     20   0.23    285     59  304.3  305.3  304.4
  250.0  10390  -52.7                         275    102  327.6         327.6
</PRE><H3>Station information and sounding indices</H3><PRE>
                         Station identifier: PHN
                             Station number: 47138
                           Observation time: 021128/0000
</PRE>
"""

# station, time; level type, elapsed time, pressure Pa, height m, temperature, humidity, dew point depression, wind
IGRA = """\
#KSM00047138 2002 11 28 00 2315    5 ncdc-gts ncdc-gts  360333  1293833
21 -9999 102200     6    36   560    80   250    21
10 -9999 100000   181    22   560    80   290    67
10 -9999  92500   823   -31 -9999 -9999 -9999 -9999
30 -9999  -9999  1500 -9999 -9999 -9999   310   129
10 -9999  50000  5590  -235   200   170   285   304
#KSM00047138 2002 11 28 12 1115    3 ncdc-gts ncdc-gts  360333  1293833
10 -9999  70000  3000  -100 -8888 -8888   270   200
10 -9999  85000 -9999  -100 -8888 -8888   260   100
10 -9999  92500   800  -100 -8888 -8888   250    50
"""


def geometric(geopotential_m: float) -> float:
    return 6356766.0 * geopotential_m / (6356766.0 - geopotential_m)


def profile(tmp_path: Path, text: str, name: str = "sounding.txt", number: str = "") -> list[tuple[float, ...]]:
    """Return the rows of altitude, speed and direction from which the wind blows."""
    (tmp_path / name).write_text(text)
    table = load_scenario("nominal", [f"wind.profile={tmp_path / name}{number}"]).scenario.wind.profile
    assert table is not None
    north, east = table["north_mps"], table["east_mps"]
    from_deg = np.degrees(np.arctan2(-east, -north)) % 360.0
    return list(zip(table["altitude_m"].tolist(), np.hypot(north, east).tolist(), from_deg.tolist(), strict=True))


def assert_rows(got: list[tuple[float, ...]], expected: list[tuple[float, float, float]]) -> None:
    assert len(got) == len(expected)
    for row, wanted in zip(got, expected, strict=True):
        assert row == pytest.approx(wanted, rel=1e-9, abs=1e-9)


def test_wyoming_text(tmp_path: Path) -> None:
    expected = [(6, 4, 250), (181, 13, 290), (1513, 25, 310), (5590, 59, 285), (10390, 102, 275)]
    assert_rows(profile(tmp_path, WYOMING), [(geometric(h), v * KNOT, d) for h, v, d in expected])


def test_wyoming_text_in_metres_per_second(tmp_path: Path) -> None:
    text = WYOMING.replace("SKNT", "SPED").replace("knot", " m/s")
    assert profile(tmp_path, text)[1] == pytest.approx((geometric(181.0), 13.0, 290.0))


def test_wyoming_csv(tmp_path: Path) -> None:
    text = (
        "time,longitude,latitude,pressure_hPa,geopotential height_m,temperature_C,relative humidity_%,"
        "wind direction_degree,wind speed_m/s\n"
        "2025-01-28 00:00:01,129.38,36.03,1022.0,6,3.6,56,250,2.1\n"
        "2025-01-28 00:00:31,129.38,36.03,1000.0,181,2.2,56,,\n"
        "2025-01-28 00:01:01,129.38,36.03,850.0,1513,-4.9,19,310,12.9\n"
    )
    assert_rows(profile(tmp_path, text), [(geometric(6), 2.1, 250), (geometric(1513), 12.9, 310)])


def test_igra_of_several_soundings(tmp_path: Path) -> None:
    first = [(6, 2.1, 250), (181, 6.7, 290), (1500, 12.9, 310), (5590, 30.4, 285)]
    assert_rows(profile(tmp_path, IGRA, number="#1"), [(geometric(h), v, d) for h, v, d in first])
    share = math.log(925.0 / 850.0) / math.log(925.0 / 700.0)  # the height that is missing, from the pressure
    between = geometric(800.0) + share * (geometric(3000.0) - geometric(800.0))
    second = [(geometric(800.0), 5.0, 250.0), (between, 10.0, 260.0), (geometric(3000.0), 20.0, 270.0)]
    assert_rows(profile(tmp_path, IGRA, number="#2"), second)


def test_csv_in_knots_and_feet_descending_with_gaps(tmp_path: Path) -> None:
    text = "# a range's balloon\nALT (ft),direction (deg),humidity_%,wind speed [kts]\n"
    text += "3000,,,\n2000,200,9,20\n1000,190,9,-9999\n0,180,9,10\n"
    assert_rows(profile(tmp_path, text, "balloon.csv"), [(0.0, 10 * KNOT, 180), (609.6, 20 * KNOT, 200)])


def test_csv_of_components_over_pressure_alone(tmp_path: Path) -> None:
    """Altitudes are those of the standard atmosphere: 226.32 hPa is its tropopause, 54.7489 hPa its 20 km."""
    text = "pressure_hPa,u_m/s,v_m/s\n54.7489,30,-4\n226.3206,20,3\n1013.25,5,0\n"
    rows = [(0.0, 5.0, 270.0), (geometric(11000.0), math.hypot(20, 3), 270.0 - math.degrees(math.atan(3 / 20)))]
    got = profile(tmp_path, text, "model.csv")
    for row, wanted in zip(got, rows, strict=False):
        assert row == pytest.approx(wanted, rel=1e-5, abs=0.2)
    assert got[2][0] == pytest.approx(geometric(20000.0), abs=0.5)


def test_pressures_that_no_air_has_count_as_missing(tmp_path: Path) -> None:
    text = "pressure_hPa,u_m/s,v_m/s\n54.7489,30,-4\n2.26e300,20,3\n1013.25,5,0\n"
    assert [row[1] for row in profile(tmp_path, text, "model.csv")] == pytest.approx([5.0, math.hypot(30.0, 4.0)])


def test_pressure_altitude_is_the_inverse_of_the_standard() -> None:
    published = np.array([101325.0, 54048.0, 26500.0, 12112.0, 2549.2, 287.14])  # table I: 0, 5, 10, 15, 25, 40 km
    assert pressure_altitude(published) == pytest.approx([0.0, 5e3, 10e3, 15e3, 25e3, 40e3], abs=1.0)


@pytest.mark.parametrize(
    ("text", "number", "said"),
    [
        (IGRA, "", "holds 2 soundings"),
        (IGRA, "#3", "sounding.txt#1 .. "),
        ("altitude_m,speed,from_deg\n0,1,2\n", "", 'column "speed" has no unit that is known'),
        ("altitude_m,speed_kt,from_deg\n0,,2\n", "", "no level with height and wind"),
        ("altitude_ft,speed_kt,from_deg\n0,1\n", "", "has 2 columns, the first line has 3"),
        ("altitude_m,speed_mps,from_deg\n5,1,2\n0,1,2\n", "", "altitude_m must increase strictly"),
        ("altitude_m,speed_mps,form_deg\n5,1,2\n", "", "did you mean from_deg?"),
    ],
)
def test_what_is_wrong_is_said_in_a_line(tmp_path: Path, text: str, number: str, said: str) -> None:
    with pytest.raises(ScenarioError) as refused:
        profile(tmp_path, text, number=number)
    assert said in str(refused.value)
    assert "sounding.txt" in str(refused.value)


def test_an_ensemble_of_a_folder_and_of_a_file_of_soundings(tmp_path: Path) -> None:
    folder = tmp_path / "autumn"
    folder.mkdir()
    (folder / "b.txt").write_text(WYOMING)
    (folder / "a.csv").write_text("altitude_m,speed_mps,from_deg\n0,5,270\n")
    (folder / "c.txt").write_text(IGRA)
    file = tmp_path / "campaign.toml"
    file.write_text(
        'extends = "nominal.toml"\n[campaign]\nruns = 6\n[wind_model]\nmodel = "ensemble"\norder = "in-turn"\n'
        'profiles = ["autumn", "autumn/a.csv"]\n'
    )
    campaign = maxq.load(str(file))
    names = ["autumn/a.csv", "autumn/b.txt", "autumn/c.txt#1", "autumn/c.txt#2", "autumn/a.csv", "autumn/a.csv"]
    drawn = campaign.plan.draw(0, 6)
    wind = campaign.plan.wind
    assert wind is not None
    assert drawn.wind is not None
    assert [wind.recorded(scores)["wind.profile"] for scores in drawn.wind] == names
    assert len(wind.profile(drawn.wind[3])) == 3


def wind_at(scenario, altitude_m: float) -> tuple[float, ...]:
    pool = Pool()
    row = pack([pack_wind(scenario.wind, pool, scenario.site.altitude_m)])[0]
    return wind_ned(row, pool.array(), altitude_m)[:2]


PROFILE = (
    "wind.profile={altitude_m=[40.0,100.0,500.0],speed_mps=[4.0,8.0,10.0],from_deg=[270.0,270.0,240.0]}"  # site: 30 m
)


@pytest.mark.parametrize(
    ("ground", "reference", "law"),
    [
        ("{law='power'}", (10.0, 4.0), lambda h: (h / 10.0) ** (1 / 7)),
        ("{law='power',exponent=0.25,height_m=50.0}", (50.0, 4.0), lambda h: (h / 50.0) ** 0.25),
        ("{law='log',roughness_m=0.1}", (10.0, 4.0), lambda h: math.log(1 + h / 0.1) / math.log(1 + 10.0 / 0.1)),
        ("{law='power',height_m=20.0,speed_mps=6.0,from_deg=270.0}", (20.0, 6.0), lambda h: (h / 20.0) ** (1 / 7)),
    ],
)
def test_wind_near_the_ground(ground: str, reference: tuple[float, float], law) -> None:
    scenario = load_scenario("nominal", [PROFILE, f"wind.ground={ground}"]).scenario
    height, speed = reference
    for h in (0.0, 0.005 * height, 0.01 * height, 0.1 * height, height):
        assert wind_at(scenario, 30.0 + h) == pytest.approx((0.0, speed * law(h)), abs=1e-9)
    for h in (0.011 * height, 0.07 * height, 0.25 * height, 0.95 * height):  # between the rows: straight lines
        assert wind_at(scenario, 30.0 + h)[1] == pytest.approx(speed * law(h), rel=1.2e-2)
    assert wind_at(scenario, 500.0) == pytest.approx((5.0, 10.0 * math.cos(math.radians(30.0))), abs=1e-9)


def test_without_a_law_the_lowest_level_holds() -> None:
    scenario = load_scenario("nominal", [PROFILE]).scenario
    assert wind_at(scenario, 30.0) == pytest.approx((0.0, 4.0))


def test_columns_by_their_short_names_and_what_is_missing(tmp_path: Path) -> None:
    (tmp_path / "short.csv").write_text("pressure_hPa,height_ft,dir_deg,spd_kt\n300,30000,270,100\n1000,500,180,10\n")
    where = f"wind.profile='{tmp_path}/short.csv'"
    table = load_scenario("nominal", [where]).scenario.wind.profile
    assert table is not None
    np.testing.assert_allclose(table["altitude_m"], [0.3048 * 500.0, 0.3048 * 30000.0])
    np.testing.assert_allclose(table["east_mps"], [0.0, 100.0 * KNOT], atol=1e-12)
    np.testing.assert_allclose(table["north_mps"], [10.0 * KNOT, 0.0], atol=1e-12)
    (tmp_path / "short.csv").write_text("pressure_hPa,height_ft,spd_kt\n300,30000,100\n1000,500,10\n")
    with pytest.raises(
        ScenarioError, match="sounding by its column pressure_hPa, but has none of the wind's direction"
    ):
        load_scenario("nominal", [where])
