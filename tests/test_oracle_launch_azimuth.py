"""The launch azimuth for the inclination of a layout equals that from vectors."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from flightkit import load
from test_oracle_restart import TREE as RESTART

from maxq import ScenarioError
from maxq.sim.world.earth import geocentric_rad
from maxq.tools.vehicle.azimuth import launch_azimuth_deg
from maxq.tools.vehicle.layout import read_layout

RADIUS_m, MU, SPIN_radps = 6378137.0, 3.986004418e14, 7.292115e-5
GANNET = Path(__file__).parent.parent / "scenarios" / "layouts" / "gannet.toml"


@pytest.mark.parametrize(
    ("latitude", "inclination"), [(28.5, 51.6), (-5.0, 98.0), (62.9, 90.0), (0.0, 0.0), (36.7, 37.0)]
)
@pytest.mark.parametrize("southwards", [False, True])
def test_the_speed_over_ground_plus_that_of_the_ground_is_in_the_plane(
    latitude: float, inclination: float, southwards: bool
) -> None:
    perigee, apogee = RADIUS_m + 250e3, RADIUS_m + 900e3
    azimuth = math.radians(launch_azimuth_deg(latitude, inclination, perigee, apogee, southwards=southwards))
    geocentric = geocentric_rad(latitude)
    east, north = np.array([0.0, 1.0, 0.0]), np.array([-math.sin(geocentric), 0.0, math.cos(geocentric)])
    r = perigee * np.array([math.cos(geocentric), 0.0, math.sin(geocentric)])
    course = math.sin(azimuth) * east + math.cos(azimuth) * north
    ground = np.cross([0.0, 0.0, SPIN_radps], r)
    wanted = math.sqrt(MU * (2.0 / perigee - 2.0 / (perigee + apogee)))
    along = course @ ground  # |k course + ground| = wanted
    v = (math.sqrt(along**2 + wanted**2 - ground @ ground) - along) * course + ground
    normal = np.cross(r, v)
    assert np.linalg.norm(v) == pytest.approx(wanted, rel=1e-12)
    assert math.degrees(math.acos(normal[2] / np.linalg.norm(normal))) == pytest.approx(inclination, abs=1e-5)
    if 0.0 < inclination < 90.0:
        assert bool(v[2] < 0.0) is southwards


def layout(tmp_path: Path, old: str, new: str, trajectory: str) -> Path:
    text = GANNET.read_text()
    assert old in text
    changed = text.replace(old, new).replace("[trajectory]\n", f"[trajectory]\n{trajectory}")
    (tmp_path / "layout.toml").write_text(changed)
    return tmp_path / "layout.toml"


def test_a_layout_takes_its_azimuth_from_the_inclination(tmp_path: Path) -> None:
    read = read_layout(layout(tmp_path, "azimuth_deg = 60.0", "#", "inclination_deg = 30.0\n"))
    expected = launch_azimuth_deg(5.24, 30.0, RADIUS_m + 300e3, RADIUS_m + 310e3)
    assert read.azimuth_deg == pytest.approx(expected, abs=1e-12)
    assert read_layout(GANNET).azimuth_deg == 60.0


@pytest.mark.parametrize(
    ("new", "trajectory", "said"),
    [
        ("#", "", "no launch azimuth, or two"),
        ("azimuth_deg = 60.0", "inclination_deg = 30.0\n", "no launch azimuth, or two"),
        ("#", "inclination_deg = 4.0\n", "5.205 to 174.8"),
        ("azimuth_deg = 60.0", "southwards = true\n", "inclination_deg"),
        ("azimuth_deg = 60.0", "restart = [{coast_s = 10.0, settling_s = 20.0}]\n", "longer than the coast"),
    ],
)
def test_azimuths_that_cannot_be(tmp_path: Path, new: str, trajectory: str, said: str) -> None:
    with pytest.raises(ScenarioError, match=said):
        read_layout(layout(tmp_path, "azimuth_deg = 60.0", new, trajectory))


@pytest.mark.parametrize(("shape", "least"), [("wgs84", math.degrees(geocentric_rad(28.5))), ("sphere", 28.5)])
def test_a_scenario_allows_each_inclination_of_a_layout(shape: str, least: float) -> None:
    """The least inclination of a site is its geocentric latitude, 0.16 deg below the geodetic one on the ellipsoid."""
    scenario = {**RESTART, "earth": {"shape": shape, "gravity": "inverse_square"}, "site": {"latitude_deg": 28.5}}
    for inclination, allowed in ((least + 0.01, True), (least - 0.01, False), (180.0 - least - 0.01, True)):
        orbit = {"perigee_altitude_m": 3e5, "apogee_altitude_m": 3e5, "isp_s": 300.0, "inclination_deg": inclination}
        tree = scenario | {"guidance": {"orbit": orbit}}
        if allowed:
            load(tree)
        else:
            with pytest.raises(ScenarioError, match="geocentric"):
                load(tree)
