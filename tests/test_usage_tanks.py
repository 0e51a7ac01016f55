"""Tanks given by their shape have their keys, errors, names and limits."""

from __future__ import annotations

import numpy as np
import pytest
from flightkit import Tree, load, merged

from maxq import ScenarioError
from maxq.design.model.node import surface_radii_m
from maxq.sim.packing.schedule import stage_sizes
from maxq.sim.run.fly import logged_channels
from maxq.tools.replay.vehicle_shape import shape_of

SPHERE: Tree = {
    "name": "lox",
    "shape": "sphere",
    "radius_m": 0.6,
    "bottom_station_m": 8.0,
    "density_kgpm3": 1141.0,
    "damping_ratio": 0.01,
    "table": {"time_s": [0.0, 60.0], "liquid_mass_kg": [900.0, 50.0]},
}


def scenario(*tanks: Tree) -> Tree:
    inertia = [[900.0, 0.0, 0.0], [0.0, 5e4, 0.0], [0.0, 0.0, 5e4]]
    stage = {"mass": {"mass_kg": 6000.0, "x_cg_m": 7.0, "inertia_kgm2": inertia}, "tank": list(tanks)}
    return {
        "schema": 1,
        "vehicle": {"reference": {"length_m": 14.0, "diameter_m": 1.2, "area_m2": 1.1}, "stage": [stage]},
        "initial": {"euler_deg": [0.0, 90.0, 0.0], "ned_mps": [0.0, 0.0, -10.0]},
    }


def test_names_of_second_modes_and_waves() -> None:
    loaded = load(scenario(merged(SPHERE, {"modes": 2}), merged(SPHERE, {"name": ""})))
    stage = loaded.vehicle.stage[0]
    assert stage.pendulum_names == ("lox", "lox_2", "2")
    names = logged_channels(loaded.scenario, stage_sizes(stage, loaded.scenario.switches)).names
    assert {"slosh_lox_pitch_deg", "slosh_lox_2_pitch_deg", "slosh_lox_2_wave_m", "slosh_2_wave_m"} <= set(names)


def test_a_tank_of_another_stage_keeps_its_name() -> None:
    """A shared column of the log has the names of all stages that fill it, here with two modes and three."""
    tree = scenario(merged(SPHERE, {"modes": 2}), merged(SPHERE, {"name": "jeta1"}))
    (lower,) = tree["vehicle"]["stage"]
    upper = merged(lower, {"tank": [SPHERE, merged(SPHERE, {"name": "lh2"})]})
    tree["vehicle"]["stage"] = [lower | {"separation_s": 10.0}, upper]
    loaded = load(tree)
    table = logged_channels(loaded.scenario, stage_sizes(loaded.vehicle.stage[0], loaded.scenario.switches))
    names = [name for name in table.names if name.startswith("slosh") and name.endswith("pitch_deg")]
    assert names == ["slosh_lox_pitch_deg", "slosh_lox_2_or_lh2_pitch_deg", "slosh_jeta1_pitch_deg"]


def test_surface_of_the_liquid_by_the_shape_of_its_tank() -> None:
    """The surface is exact for a sphere half full and nearly empty, a cylinder's wall, and an ellipsoid's cap."""
    half = 1141.0 * 2.0 / 3.0 * np.pi * 0.6**3
    sphere = merged(SPHERE, {"modes": 2, "table": {"time_s": [0.0, 10.0], "liquid_mass_kg": [half, 0.0]}})
    wall = merged(SPHERE, {"name": "wall", "shape": "cylinder", "height_m": 2.0})
    egg = merged(sphere, {"name": "egg", "shape": "ellipsoid", "height_m": 2.4})
    first, second, cylinder, *ellipsoid = surface_radii_m(load(scenario(sphere, wall, egg)).vehicle.stage[0], 5.0)
    depth = np.roots([-1.0, 3.0, 0.0, -1.0])  # a cap of half of half a unit sphere: d^2 (3 - d) = 1
    depth = float(depth[(depth > 0.0) & (depth < 1.0)][0])
    assert first == second == pytest.approx(0.6 * np.sqrt(1.0 - (1.0 - depth) ** 2), rel=1e-9)
    assert cylinder == 0.6
    # twice as high: a quarter of its lower half
    low = np.roots([-1.0, 3.0, 0.0, -0.5])
    low = float(low[(low > 0.0) & (low < 1.0)][0])
    assert ellipsoid == pytest.approx([0.6 * np.sqrt(1.0 - (1.0 - low) ** 2)] * 2, rel=1e-9)


CYLINDER: Tree = {"shape": "cylinder", "height_m": 2.0}
PLAIN: Tree = {"time_s": [0.0], "slosh_mass_kg": [50.0], "pendulum_length_m": [0.3], "hinge_station_m": [7.0]}


def _without(key: str) -> Tree:
    return {k: v for k, v in SPHERE.items() if k != key}


@pytest.mark.parametrize(
    ("tank", "said"),
    [
        (_without("density_kgpm3"), "density_kgpm3"),
        (_without("radius_m"), "radius_m"),
        (_without("damping_ratio"), "nothing damps the liquid"),
        (_without("shape"), "shape with liquid_mass_kg, or neither"),
        (merged(SPHERE, {"height_m": 1.2}), "height_m"),
        (merged(SPHERE, {"dome_m": [0.2, 0.2]}), "dome_m"),
        (merged(SPHERE, {"second_damping_ratio": 0.1}), "second_damping_ratio"),
        (merged(SPHERE, {"radius_m": 0.4}), "more than the tank holds"),
        (merged(SPHERE, {"baffles": {"width_m": 0.1, "station_m": [7.3]}}), "not on the cylindrical wall"),
        (merged(SPHERE, CYLINDER | {"baffles": {"width_m": 0.7, "station_m": [7.3]}}), "as wide as the tank"),
        (merged(SPHERE, CYLINDER | {"dome_m": [0.05, 0.3]}), "too flat"),
        (merged(SPHERE, CYLINDER | {"dome_m": [1.2, 1.2]}), "higher than the tank"),
        ({"table": PLAIN | {"slosh_mass_2_kg": [1.0]}, "damping_ratio": 0.0}, "pendulum_length_2_m is missing"),
        ({"table": PLAIN, "viscosity_m2ps": 1e-6}, "radius_m"),
    ],
    ids=lambda x: x.replace(" ", "-") if isinstance(x, str) else "tank",
)
def test_mistakes_are_named(tank: Tree, said: str) -> None:
    with pytest.raises(ScenarioError, match=said):
        load(scenario(tank))


def test_more_slosh_modes_than_there_is_room_for() -> None:
    with pytest.raises(ScenarioError, match=r"10 slosh modes in all.*up to 8"):
        load(scenario(*(merged(SPHERE, {"modes": 2, "name": f"t{n}"}) for n in range(5))))


def test_replay_draws_the_liquid_of_a_shape() -> None:
    tank = shape_of(load(scenario(SPHERE)).vehicle).stages[0].tanks[0]
    times, height = tank.level
    assert tank.bottom_station_m == 8.0
    assert list(times) == [0.0, 60.0]
    volume = np.pi * height**2 * (0.6 - height / 3.0)
    np.testing.assert_allclose(1141.0 * volume, [900.0, 50.0], rtol=1e-6)
