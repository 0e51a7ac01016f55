"""A flight depends neither on the longitude of its site, nor on its azimuth over a sphere at rest, nor on the units of
its wind.

The compared numbers come from other products of the same quantities, so that they agree to rounding: 1e-9 of their
size, or 1e-6 if the axes turn, since rounding of positions (1e-9 m) is divided by the small attitude error. A wrong
unit or frame differs by 0.01 or more.
"""

from __future__ import annotations

import math

import numpy as np
import pytest

from maxq import Flight
from maxq.sim.run.fly import fly
from maxq.sim.scenario.loader import load_scenario

KNOT, FOOT = 1852.0 / 3600.0, 0.3048
AT_REST = ("earth.shape=sphere", "earth.rotating=false")
SAME = ("altitude_m", "mach", "alpha_deg", "dynamic_pressure_Pa", "gimbal_pitch_angle_deg", "attitude_error_pitch_deg")
ROWS = ((0.0, 8.0, 270.0), (200.0, 14.0, 300.0), (900.0, 21.0, 350.0))  # m, m/s, deg from


def flown(*changes: str) -> Flight:
    return fly(load_scenario("nominal", ["run.duration_s=9.0", "requirement=", *changes]))


def wind(turn_deg: float = 0.0) -> str:
    altitudes, speeds, directions = (list(column) for column in zip(*ROWS, strict=True))
    turned = [(d + turn_deg) % 360.0 for d in directions]
    return f"wind.profile={{altitude_m={altitudes}, speed_mps={speeds}, from_deg={turned}}}"


def differences(one: Flight, other: Flight) -> dict[str, float]:
    """Return the largest difference of each channel over its largest value."""
    return {name: float(np.abs(one[name] - other[name]).max() / np.abs(one[name]).max()) for name in SAME}


@pytest.fixture(scope="module")
def westward() -> Flight:
    return flown(wind())


def test_the_longitude_of_the_site_turns_the_flight_only(westward: Flight) -> None:
    other = flown(wind(), "site.longitude_deg=-53.53")  # 180 deg away
    assert max(differences(westward, other).values()) < 1e-9
    moved = other.metrics["final_longitude_deg"] - westward.metrics["final_longitude_deg"]
    assert moved == pytest.approx(-180.0, abs=1e-9)
    assert other.metrics["range_m"] == pytest.approx(westward.metrics["range_m"], rel=1e-7)


def test_over_a_sphere_at_rest_the_azimuth_turns_the_flight_only() -> None:
    """The wind turns with the azimuth. At the equator, a launch to the north moves in latitude, to the east in
    longitude.
    """
    site = (*AT_REST, "site.latitude_deg=0.0")
    north = flown(*site, wind(), "site.azimuth_deg=0.0")
    east = flown(*site, wind(90.0), "site.azimuth_deg=90.0")
    assert max(differences(north, east).values()) < 1e-6
    start = north.scenario.scenario.site.longitude_deg
    climbed = north.metrics["final_latitude_deg"]
    assert abs(climbed) > 1e-5
    assert east.metrics["final_longitude_deg"] - start == pytest.approx(climbed, rel=1e-6)


@pytest.mark.parametrize("units", ["knots and feet", "components in km/h"])
def test_a_wind_in_other_units_gives_the_same_flight(
    units: str, westward: Flight, tmp_path_factory: pytest.TempPathFactory
) -> None:
    file = tmp_path_factory.mktemp("wind") / "wind.csv"
    if units == "knots and feet":
        lines = ["ALT (ft),direction (deg),wind speed [kts]"]
        lines += [f"{h / FOOT!r},{d!r},{v / KNOT!r}" for h, v, d in ROWS]
    else:
        lines = ["altitude_km,u_km/h,v_km/h"]
        for h, v, d in ROWS:
            u, along = (-3.6 * v * turn(math.radians(d)) for turn in (math.sin, math.cos))
            lines.append(f"{1e-3 * h!r},{u!r},{along!r}")
    file.write_text("\n".join(lines) + "\n")
    assert max(differences(westward, flown(f"wind.profile={file}")).values()) < 1e-9
    assert differences(westward, flown())["alpha_deg"] > 0.1  # the wind matters
