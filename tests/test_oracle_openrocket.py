"""OpenRocket designs become layouts with masses in closed form, and vehicles that fly unguided from a rail."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import orkkit
import pytest

from maxq.sim.run.fly import fly
from maxq.sim.scenario.loader import load_scenario
from maxq.tools.vehicle.airframe import Airframe
from maxq.tools.vehicle.airframe_layout import write_layout
from maxq.tools.vehicle.build import build
from maxq.tools.vehicle.files import write
from maxq.tools.vehicle.layout import Layout, read_layout
from maxq.tools.vehicle.masses import Rod, properties_of, stacks
from maxq.tools.vehicle.openrocket import read_openrocket


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = tmp_path_factory.mktemp("ork")
    orkkit.write_design(made, orkkit.xml())
    return made


@pytest.fixture(scope="module")
def airframe(folder: Path) -> Airframe:
    return read_openrocket(folder / "rocket.ork")


@pytest.fixture(scope="module")
def layout(folder: Path, airframe: Airframe) -> Layout:
    return read_layout(write_layout(airframe, folder))


def test_masses_and_stations_are_those_of_the_closed_forms(airframe: Airframe) -> None:
    pieces = [p for stage in airframe.stages for p in stage.pieces]
    expected = orkkit.closed_forms()
    assert [p.name for p in pieces] == [name for name, _, _ in expected]
    np.testing.assert_allclose([p.mass_kg for p in pieces], [kg for _, kg, _ in expected], rtol=1e-9)
    np.testing.assert_allclose([p.station_m for p in pieces], [m for _, _, m in expected], rtol=1e-9)


def test_the_layout_has_the_mass_and_centre_of_all_parts(layout: Layout) -> None:
    parts = [(kg, x) for _, kg, x in orkkit.closed_forms()]
    upper_m = orkkit.NOSE_m + orkkit.TUBE_m
    parts += [(0.35, upper_m + 0.005 - 0.1), (0.35, upper_m + orkkit.CONE_m + orkkit.LOWER_m - 0.1)]  # motors
    mass = sum(kg for kg, _ in parts)
    found = stacks(layout)[0].mass_properties(0.0)
    assert found.mass_kg == pytest.approx(mass, rel=1e-9)
    assert found.x_cg_m == pytest.approx(sum(kg * x for kg, x in parts) / mass, rel=1e-9)
    assert layout.stage[0].rear_station_m == pytest.approx(1.4, rel=1e-12)
    assert [s.name for s in layout.stage] == ["lower_stage", "upper_stage"]


def test_a_rod_of_the_layout_has_the_inertia_of_its_component(layout: Layout) -> None:
    """A tube: m (r_o^2 + r_i^2) / 2 about the axis, and m (3 (r_o^2 + r_i^2) + L^2) / 12 across."""
    part = next(p for p in layout.stage[1].part if p.name == "tube")
    squares = orkkit.R**2 + (orkkit.R - orkkit.W) ** 2
    assert part.gyration_m is not None
    rod = Rod(part.mass_kg, part.front_station_m, part.rear_station_m, part.gyration_m[0] ** 2, part.gyration_m[1] ** 2)
    found = properties_of([rod])
    assert found.roll_kgm2 == pytest.approx(0.5 * part.mass_kg * squares, rel=1e-9)
    assert found.pitch_kgm2 == pytest.approx(part.mass_kg * (3.0 * squares + orkkit.TUBE_m**2) / 12.0, rel=1e-9)


def test_the_site_the_rail_and_the_times_of_staging_are_taken(layout: Layout) -> None:
    assert layout.rail is not None
    assert (layout.rail.length_m, layout.rail.elevation_deg) == (2.5, 85.0)
    site = layout.site
    assert (site.latitude_deg, site.longitude_deg, site.altitude_m, layout.azimuth_deg) == (46.5, 7.0, 120.0, 80.0)
    assert layout.stage[0].separation_after_s == 1.0  # the delay of the lower motor; the upper stage ignites at once
    assert layout.stage[1].ignition_after_s == 0.0


def test_normal_force_is_that_of_barrowman(layout: Layout) -> None:
    """The upper stack: a cone with CP at 2/3 of its length, and four fins (J. S. Barrowman, equations 3-57, 3-108)."""
    aero = layout.stage[1].aero
    assert aero is not None
    area = math.pi * 0.05**2  # the largest diameter is that of the lower stage
    nose, fins = aero.surface
    mach_0 = 1.0 + 0.15 * math.exp(-((1.1 / 0.5) ** 2))  # maxq's correction at Mach 0
    assert nose.table["CN_alpha_pr"][0] == pytest.approx(2.0 * math.pi * orkkit.R**2 / area * mach_0, rel=1e-9)
    assert nose.table["station_m"][0] == pytest.approx(2.0 / 3.0 * orkkit.NOSE_m, rel=1e-9)
    middle = math.hypot(0.06, 0.05 + 0.5 * (0.04 - 0.1))
    alone = 16.0 * (0.06 / 0.1) ** 2 / (1.0 + math.sqrt(1.0 + (2.0 * middle / 0.14) ** 2))
    assert fins.table["CN_alpha_pr"][0] == pytest.approx((1.0 + 0.04 / 0.1) * alone, rel=1e-9)
    front = orkkit.NOSE_m + orkkit.TUBE_m - 0.11
    centre = 0.05 / 3.0 * 0.18 / 0.14 + (0.14 - 0.1 * 0.04 / 0.14) / 6.0
    assert fins.table["station_m"][0] == pytest.approx(front + centre, rel=1e-9)


def _rail_exit_mps(mass_kg: float) -> float:
    """Return the speed after 2.5 m at 85 deg under the thrust of the test motor, without drag, by Euler steps."""
    times, thrust = np.array([0.0, 0.05, 1.0, 1.2]), np.array([0.0, 250.0, 250.0, 0.0])
    flow, speed, travel, t, step = 0.2 / np.trapezoid(thrust, times), 0.0, 0.0, 0.0, 1e-4
    while travel < 2.5:
        force = float(np.interp(t, times, thrust))
        speed += step * (force / mass_kg - 9.807 * math.sin(math.radians(85.0)))
        speed, mass_kg = max(speed, 0.0), mass_kg - step * force * flow
        travel, t = travel + step * speed, t + step
    return speed


def test_the_built_vehicle_leaves_the_rail_and_stages(folder: Path, layout: Layout) -> None:
    """Free from the rail, it climbs; the second motor burns after the separation at 1.2 + 1.0 s."""
    built = build(layout)
    assert not built.gains
    write(built, folder / "vehicle")
    flight = fly(load_scenario(folder / "vehicle" / "scenario.toml", ["run.duration_s=3.6"]))
    expected_mps = _rail_exit_mps(stacks(layout)[0].mass_properties(0.0).mass_kg)
    assert flight.metrics["rail_exit_speed_mps"] == pytest.approx(expected_mps, rel=0.01)  # drag: 0.3 % of the thrust
    assert flight.event_s("separation") == pytest.approx(2.2, abs=1e-6)
    fastest = max(p.speed_mps for p in built.flight.points)  # a point mass along its path
    assert flight.metrics["max_speed_mps"] == pytest.approx(fastest, rel=0.01)
    assert flight.metrics["max_alpha_deg"] < 0.5
