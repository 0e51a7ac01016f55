"""RocketPy rockets become airframes. Stand-ins have rocketpy's documented attributes and the numbers of Calisto."""

from __future__ import annotations

import math
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import maxq
from maxq import ScenarioError
from maxq.tools.vehicle.layout import read_layout
from maxq.tools.vehicle.masses import stacks
from maxq.tools.vehicle.rocketpy_objects import read_rocketpy


class NoseCone(SimpleNamespace):
    """A nose by its documented attributes."""


class Tail(SimpleNamespace):
    """A tail by its documented attributes."""


class TrapezoidalFins(SimpleNamespace):
    """A set of fins by its documented attributes."""


class FreeFormFins(SimpleNamespace):
    """A set of fins that is not imported."""


class Curve:
    """A function of one variable with the table `source`, as rocketpy.Function."""

    def __init__(self, rows: list[tuple[float, float]]) -> None:
        self.source = np.array(rows)

    def __call__(self, x: float) -> float:
        return float(np.interp(x, *self.source.T))


def calisto(sign: float = 1.0, **changes: Any) -> SimpleNamespace:
    """Return the rocket with stations on an axis towards the nose (sign 1) or the tail (-1)."""
    grain = math.pi * 5 * 0.12 * 1815 * (0.033**2 - 0.015**2)
    motor = SimpleNamespace(
        thrust=Curve([(0.0, 0.0), (0.1, 2000.0), (1.0, 2034.0), (3.0, 1650.0), (3.3, 530.0), (3.9, 0.0)]),
        burn_start_time=0.0,
        burn_out_time=3.9,
        grain_number=5,
        grain_initial_height=0.12,
        grain_separation=0.005,
        grain_outer_radius=0.033,
        grain_initial_inner_radius=0.015,
        propellant_initial_mass=grain,
        dry_mass=1.815,
        dry_I_11=0.125,
        dry_I_33=0.002,
        nozzle_radius=0.033,
        reference_pressure=None,
    )
    surfaces = [
        (NoseCone(kind="vonKarman", length=0.55829, base_radius=0.0635, bluffness=None), (0.0, 0.0, sign * 1.278)),
        (
            TrapezoidalFins(
                name="Fins",
                n=4,
                root_chord=0.12,
                tip_chord=0.06,
                span=0.11,
                sweep_length=0.06,
                rocket_radius=0.0635,
                cant_angle=0.0,
            ),
            (0.0, 0.0, sign * -1.04956),
        ),
        (Tail(name="Tail", top_radius=0.0635, bottom_radius=0.0435, length=0.06), (0.0, 0.0, sign * -1.194656)),
    ]
    out = SimpleNamespace(
        coordinate_system_orientation="tail_to_nose" if sign > 0 else "nose_to_tail",
        aerodynamic_surfaces=surfaces,
        radius=0.0635,
        mass=14.426,
        I_11_without_motor=6.321,
        I_22_without_motor=6.321,
        I_33_without_motor=0.034,
        center_of_mass_without_motor=0.0,
        motor=motor,
        nozzle_position=sign * -1.255,
        center_of_propellant_position=lambda t: sign * (-1.255 + 0.397),
        motor_center_of_dry_mass_position=sign * (-1.255 + 0.317),
        power_on_drag_by_mach=Curve([(0.0, 0.4), (1.0, 0.6), (2.0, 0.5)]),
        power_off_drag_by_mach=Curve([(0.0, 0.5), (1.0, 0.7), (2.0, 0.6)]),
    )
    out.__dict__.update(changes)
    return out


FLIGHT = SimpleNamespace(
    rail_length=5.2,
    effective_1rl=4.3,
    inclination=85.0,
    heading=30.0,
    env=SimpleNamespace(latitude=32.99, longitude=-106.97, elevation=1400.0),
)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return maxq.from_rocketpy(calisto(), FLIGHT, name="Calisto", folder=tmp_path_factory.mktemp("calisto"))


def test_mass_centre_and_inertia_are_those_of_rigid_bodies(folder: Path) -> None:
    """Rocket, case and five hollow cylinders by Steiner's theorem, about their common centre."""
    found = stacks(read_layout(folder / "layout.toml"))[0]
    grain = math.pi * 5 * 0.12 * 1815 * (0.033**2 - 0.015**2)
    length = 5 * 0.12 + 4 * 0.005  # maxq: one cylinder of this length
    radii = 0.033**2 + 0.015**2
    bodies = [  # mass, station aft of the nose's tip, moments about its own centre: across, along
        (14.426, 1.278, 6.321, 0.034),
        (1.815, 1.278 + 1.255 - 0.317, 0.125, 0.002),
        (grain, 1.278 + 1.255 - 0.397, grain * (radii / 4.0 + length**2 / 12.0), grain * radii / 2.0),
    ]
    for burnt, masses in ((0.0, bodies), (3.9, bodies[:2])):
        mass = sum(m for m, *_ in masses)
        centre = sum(m * x for m, x, *_ in masses) / mass
        now = found.mass_properties(burnt)
        assert now.mass_kg == pytest.approx(mass, rel=1e-9)
        assert now.x_cg_m == pytest.approx(centre, rel=1e-9)
        assert now.pitch_kgm2 == pytest.approx(sum(i + m * (x - centre) ** 2 for m, x, i, _ in masses), rel=1e-9)
        assert now.roll_kgm2 == pytest.approx(sum(i for *_, i in masses), rel=1e-9)


def test_surfaces_drag_site_and_rail_are_taken(folder: Path) -> None:
    layout = read_layout(folder / "layout.toml")
    aero = layout.stage[0].aero
    assert aero is not None
    nose, tail, fins = aero.surface
    at_rest = 1.0 + 0.15 * math.exp(-((1.1 / 0.5) ** 2))  # maxq's correction at Mach 0
    assert nose.table["CN_alpha_pr"][0] == pytest.approx(2.0 * at_rest, rel=1e-9)
    assert nose.table["station_m"][0] == pytest.approx(0.5 * 0.55829, rel=1e-9)  # von Karman: half of the cylinder
    assert tail.table["CN_alpha_pr"][0] == pytest.approx(2.0 * ((0.0435 / 0.0635) ** 2 - 1.0) * at_rest, rel=1e-9)
    assert fins.table["CN_alpha_pr"][0] == pytest.approx(_barrowman(), rel=1e-9)
    for mach, on in ((0.5, 0.5), (1.5, 0.55)):
        assert np.interp(mach, aero.table["mach"], aero.table["CA"]) == pytest.approx(on, rel=1e-9)
        assert np.interp(mach, aero.table["mach"], aero.table["CA_coast"]) == pytest.approx(on + 0.1, rel=1e-9)
    assert layout.stage[0].modes == 0  # RocketPy has no stiffness
    assert layout.rail is not None
    assert (layout.rail.length_m, layout.rail.elevation_deg, layout.azimuth_deg) == (4.3, 85.0, 30.0)
    assert (layout.site.latitude_deg, layout.site.longitude_deg, layout.site.altitude_m) == (32.99, -106.97, 1400.0)


def _barrowman() -> float:
    """Return the normal force slope of Calisto's fins with body interference (J. S. Barrowman, equation 3-57)."""
    middle = math.hypot(0.11, 0.06 + 0.5 * (0.06 - 0.12))
    alone = 16.0 * (0.11 / 0.127) ** 2 / (1.0 + math.sqrt(1.0 + (2.0 * middle / 0.18) ** 2))
    return alone * (1.0 + 0.0635 / (0.11 + 0.0635))


def test_both_orientations_of_the_axis_give_the_same_rocket() -> None:
    one, other = (read_rocketpy(calisto(sign)) for sign in (1.0, -1.0))
    for a, b in zip(one.stages[0].pieces, other.stages[0].pieces, strict=True):
        assert a.station_m == pytest.approx(b.station_m, rel=1e-12)
    assert [b.rear_station_m for b in one.stages[0].bodies] == pytest.approx(
        [b.rear_station_m for b in other.stages[0].bodies], rel=1e-12
    )
    assert one.rail_m == 5.0
    assert ("missing", "rail", "5 m, vertical") in one.remarks


def test_a_reference_pressure_gives_the_thrust_in_vacuum() -> None:
    rocket = calisto()
    rocket.motor.reference_pressure = 1e5
    motor = read_rocketpy(rocket).stages[0].motor
    area = math.pi * 0.033**2
    assert motor.exit_area_m2 == pytest.approx(area, rel=1e-12)
    assert motor.thrust_N.max() == pytest.approx(2034.0 + 1e5 * area, rel=1e-12)
    assert motor.thrust_N[-1] == 0.0


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"coordinate_system_orientation": "up"}, "coordinate_system_orientation: is up; allowed: tail_to_nose"),
        ({"aerodynamic_surfaces": []}, "aerodynamic_surfaces: has 0 noses; allowed: one NoseCone"),
        ({"motor": SimpleNamespace()}, "motor: has no grain_number; allowed: a SolidMotor"),
        ({"I_33_without_motor": 20.0}, "I_11_without_motor: is 6.321, below half of I_33"),
        (
            {"aerodynamic_surfaces": [*calisto().aerodynamic_surfaces, (FreeFormFins(name="Free"), 0.0)]},
            "Free: is of the class FreeFormFins; allowed: NoseCone, Tail, TrapezoidalFins, EllipticalFins",
        ),
    ],
)
def test_rockets_that_cannot_be_imported_are_one_line(changes: dict[str, Any], said: str) -> None:
    with pytest.raises(ScenarioError) as error:
        read_rocketpy(calisto(**changes))
    assert said in str(error.value)
