"""Section loads in scenarios reject wrong input with clear messages, and appear in flights."""

from __future__ import annotations

import math
from dataclasses import astuple
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import campaignkit
import numpy as np
import pytest
from flightkit import Parts, Tank, Tree, load, merged, scenario_of, with_stage

from maxq import DataSet, Flight, ScenarioError
from maxq.sim.campaign.analysis import judged
from maxq.sim.campaign.runner import run_campaign
from maxq.sim.flight.metric_table import METRICS, SectionMetrics
from maxq.sim.run.fly import fly, logged_channels
from maxq.sim.scenario.loader import load_scenario
from maxq.sim.vehicle.loads.columns import KINDS
from maxq.sim.vehicle.loads.section import BORNE, _mass_over_time
from maxq.sim.vehicle.state import Sizes

PARTS = Parts(core_inertia=((700.0, 0.0, 0.0), (0.0, 6.4e4, 0.0), (0.0, 0.0, 6.4e4)))
ON = {"section_loads": True}
LOADS: Tree = {
    "stations_m": [3.0, 7.0, 12.0],
    "line_mass": [{"front_station_m": 0.1, "rear_station_m": 13.9, "mass_kg": 4000.0}],
}


def with_loads(parts: Parts = PARTS, switches: Tree | None = None, **changes: Any) -> Tree:
    tree = scenario_of(parts, switches=switches or {})
    return with_stage(tree, loads=merged(LOADS, changes))


def said_of(tree: Tree) -> str:
    with pytest.raises(ScenarioError) as caught:
        load(tree)
    line = str(caught.value)
    assert "\n" not in line
    return line


def test_names_agree_across_layers() -> None:
    assert [name.rsplit("_", 1)[0] for name in BORNE] == list(KINDS)
    assert all(name.startswith("max_section_") and name in METRICS for name in SectionMetrics._fields)
    assert load(with_loads()).scenario.vehicle.stage[0].loads is not None


SPATIAL = {
    "damping_ratio": [0.01],
    "table": [
        {
            "time_s": 0.0,
            "mode": 1,
            "frequency_hz": 9.0,
            "generalized_mass_kg": 1000.0,
            "station_m": x,
            "phi_x": 0.0,
            "phi_y": 0.0,
            "phi_z": 1.0 - x,
            "theta_x_pm": 0.0,
            "theta_y_pm": -1.0,
            "theta_z_pm": 0.0,
            "mass_forward_kg": x,
        }
        for x in (0.0, 14.0)
    ],
}


def test_section_loads_of_spatial_modes_are_evaluated() -> None:
    tree = with_stage(with_loads(switches=ON), spatial_modes=SPATIAL)
    assert load(tree).scenario.vehicle.stage[0].spatial_modes is not None


def test_a_campaign_judges_section_loads(tmp_path: Path) -> None:
    """Metrics of section loads are columns of each run and can be required."""
    bound = "[switches]\nsection_loads = true\n"
    bound += "".join(f'[[requirement]]\nmetric = "max_section_compression_N"\nlimit = {n}\n' for n in (1e9, 1.0))
    campaign = campaignkit.small(tmp_path, runs=4, rest=bound)
    run_campaign(campaign, tmp_path / "out")
    found = campaignkit.data_set(tmp_path / "out")
    compression = found["max_section_compression_N"].to_numpy()
    assert (compression > 1e4).all()
    assert len(set(compression)) == 4
    assert not any(found["passed"].to_pylist())  # none keeps to 1 N
    judgements = judged(DataSet(tmp_path / "out", campaign))
    assert [each.shown.failures for each in judgements] == [0, 0, 4, 4]  # the last: all together


LIMITS = {"station_m": [1.0, 9.0], "shear_N": [1e5, 1e5]}
TANK = Tank(300.0, 0.5, 5.0)


@pytest.mark.parametrize(
    ("tree", "says"),
    [
        (with_loads(stations_m=[3.0, 3.0]), "loads.stations_m = [3.0, 3.0]: must increase strictly"),
        (with_loads(stations_m=[3.0, 12.5]), "stations_m.1 = 12.5: is behind the gimbal"),
        (with_loads(line_mass=[{"front_station_m": 2.0, "rear_station_m": 1.0, "mass_kg": 1.0}]), "before the front"),
        (
            with_loads(line_mass=[{"front_station_m": 0.1, "rear_station_m": 13.9, "mass_kg": 4400.0}], switches=ON),
            "line mass and liquids have a mass of 4400 kg, the stage 4000 kg: 10 % apart; allowed: at most tolerance",
        ),
        (
            with_loads(line_mass=[{"front_station_m": 0.1, "rear_station_m": 11.9, "mass_kg": 4000.0}], switches=ON),
            "have a CG of 6 m, the stage 7 m: 8.4 % apart",
        ),
        (
            with_loads(line_mass=[{"front_station_m": 1.1, "rear_station_m": 12.9, "mass_kg": 4000.0}], switches=ON),
            "have a transverse radius of gyration of 3.40637 m, the stage 4 m: 15 % apart",
        ),
        (with_loads(Parts(core_inertia=PARTS.core_inertia, tanks=(TANK,))), "has no entry for tank 1"),
        (
            with_loads(liquid=[{"tank": "lox", "bottom_station_m": 6.0,
                                "table": {"time_s": [0.0], "mass_kg": [1.0], "front_station_m": [5.0]}}]),
            'liquid.0.tank = "lox": names no tank',
        ),
        (
            with_loads(liquid=[{"bottom_station_m": 4.0,
                                "table": {"time_s": [0.0], "mass_kg": [1.0], "front_station_m": [5.0]}}]),
            "lies behind the tank's bottom; allowed: at most bottom_station_m = 4",
        ),
        (with_loads(limits={"station_m": [1.0]}), "bounds nothing; allowed: one or more of compression_N"),
        (
            with_loads(limits={"station_m": [1.0], "equivalent_tension_N": [1.0]}),
            "an equivalent axial load needs a radius; allowed: a column radius_m",
        ),
        (with_loads(limits=LIMITS | {"time_s": [0.0, 1.0]}), "stations and times are not a grid"),
        (with_loads(axial_force={"station_m": [1.0], "share": [0.7]}), "the shares add up to 0.7; allowed: a sum of 1"),
        (scenario_of(PARTS, switches={"section_loads": True}), "no stage has [stage.loads]"),
        (
            with_loads() | {"requirement": [{"metric": "max_section_shear_N", "limit": 1.0}]},
            "section loads are switched off; allowed: switches.section_loads = true",
        ),
    ],
    ids=lambda value: value[:40] if isinstance(value, str) else "",
)  # fmt: skip  # a table
def test_a_mistake_is_said_in_one_line(tree: Tree, says: str) -> None:
    assert says in said_of(tree)


def test_channels_are_there_with_the_switch_only() -> None:
    sizes = Sizes(0, 0, 0, 0)
    off, on = (logged_channels(load(with_loads(switches={"section_loads": s})).scenario, sizes) for s in (False, True))
    assert not [name for name in off.names if name.startswith("section_")]
    assert [name for name in on.names if name.startswith("section_")][5:7] == [
        "section_2_axial_N",
        "section_2_shear_pitch_N",
    ]
    assert on.channel("section_3_bending_yaw_Nm").description.endswith("station 3 at 12 m")


@pytest.fixture(scope="module")
def flights() -> tuple[Flight, Flight, Flight]:
    """Return flights of KSR-III for 15 s: without section loads, with them, and with them and a log."""
    changes = ["run.duration_s=15.0", "log.slow_hz=500"]
    on = [*changes, "switches.section_loads=true"]
    return (
        fly(load_scenario("nominal", changes), log=False),
        fly(load_scenario("nominal", on), log=False),
        fly(load_scenario("nominal", on)),
    )


@pytest.mark.slow
def test_section_loads_leave_the_flight_alone(flights: tuple[Flight, ...]) -> None:
    off, on, logged = flights
    assert off.state_hash == on.state_hash == logged.state_hash
    assert all(math.isnan(off.metrics[name]) for name in SectionMetrics._fields)
    assert off.section_extremes == ()
    np.testing.assert_equal(on.metrics, logged.metrics)  # takes nan as equal to nan, which == does by identity at most
    np.testing.assert_equal([astuple(e) for e in on.section_extremes], [astuple(e) for e in logged.section_extremes])


@pytest.mark.slow
def test_extremes_are_those_of_the_log(flights: tuple[Flight, ...]) -> None:
    """The log has a row at each instant of the extremes: every 2 ms."""
    flight = flights[2]
    assert len(flight.section_extremes) == 16 * len(KINDS)
    time_s = flight.time_s("section_1_axial_N")
    for number, kind, of in (
        (8, "compression", lambda f, n: -f[f"section_{n}_axial_N"]),
        (13, "shear", lambda f, n: np.hypot(f[f"section_{n}_shear_pitch_N"], f[f"section_{n}_shear_yaw_N"])),
        (
            13,
            "bending_moment",
            lambda f, n: np.hypot(f[f"section_{n}_bending_pitch_Nm"], f[f"section_{n}_bending_yaw_Nm"]),
        ),
    ):
        station_m = flight.scenario.vehicle.stage[0].loads.stations_m[number - 1]
        found = next(e for e in flight.section_extremes if e.kind == kind and e.station_m == station_m)
        values = of(flight, number)
        worst = int(np.argmax(values))
        assert found.value == values[worst] > 0.0
        assert found.time_s == pytest.approx(time_s[worst])
    largest = max((e for e in flight.section_extremes if e.kind == "bending_moment"), key=lambda e: e.value)
    assert flight.metrics["max_section_bending_moment_Nm"] == largest.value
    assert flight.metrics["max_section_bending_moment_station_m"] == largest.station_m
    assert 0.0 < flight.metrics["max_section_load_ratio"] < 1.0
    assert 0.0 < flight.metrics["max_section_mass_mismatch"] < 0.01


def test_the_mass_of_a_stage_without_a_table_falls_by_its_flow() -> None:
    given: Any = {"table": None, "mass_kg": 100.0, "x_cg_m": 3.0, "mass_flow_kgps": 2.0, "burn_s": 10.0}
    times, (mass, station, pitch, yaw) = _mass_over_time(
        SimpleNamespace(**given, inertia_kgm2=[[1.0, 0.0, 0.0], [0.0, 50.0, 0.0], [0.0, 0.0, 60.0]])  # type: ignore[arg-type]
    )
    assert (times.tolist(), mass.tolist(), station.tolist()) == ([0.0, 10.0], [100.0, 80.0], [3.0, 3.0])
    assert (pitch.tolist(), yaw.tolist()) == ([50.0, 50.0], [60.0, 60.0])
