"""Possible but implausible values fly, with a warning that names key, value and the usual range."""

from __future__ import annotations

import json
import re
import shutil
import tomllib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import petrelkit as petrel
import pytest
import tomli_w
from scenario_files import write_ascent

import maxq
from maxq import ScenarioError
from maxq.sim.scenario import plausibility
from maxq.sim.scenario.loader import load_scenario
from maxq.tools import simrun

SPHERE = "vehicle.stage.0.mass.inertia_kgm2 = 4.88094 is implausible; usual: at most 0.169 kg m2"


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    write_ascent(tmp_path)
    return tmp_path


def implausible(warnings: tuple[str, ...]) -> list[str]:
    """Return the warnings without those about the invented mode tables."""
    return [warning for warning in warnings if "implausible" in warning or "not expected" in warning]


def test_what_is_usual_is_not_warned_of() -> None:
    assert load_scenario("nominal").warnings == ()
    assert maxq.load("campaigns/ksr3").warnings == ()
    assert maxq.load("campaigns/first").warnings == ()


def test_the_sphere_of_the_check_cases_is_none() -> None:
    """The published NESC sphere of 6 inches and 1 slug has the inertia of one of 13 feet, and the warning names it."""
    assert [warning[: len(SPHERE)] for warning in load_scenario("checkcases/nesc-01").warnings] == [SPHERE]


@pytest.mark.parametrize(
    ("overrides", "says"),
    [
        (["reference.length_m=180.0"], "reference.length_m = 180 is implausible; usual: the rearmost station, 14"),
        (["reference.length_m=1.4"], "vehicle.reference.length_m = 1.4 is"),
        (["reference.diameter_m=100.0"], "diameter_m = 100 is implausible; usual: less than the length"),
        (["reference.area_m2=78.5"], "area_m2 = 78.5 is implausible; usual: about that of the diameter"),
        (["reference.chord_m=140.0"], "vehicle.reference.chord_m = 140 is"),
        (["stage.0.mass.table.mass_kg=[6e7,5e7,4e7]"], "vehicle.stage.0.mass.table.mass_kg = 6e+07 is implausible"),
        (["stage.0.mass.table.x_cg_m=[76.0,7.5,7.2]"], "mass.table.x_cg_m = 76 is implausible; usual: inside"),
        (
            [f"stage.0.mass.table.I{axis}_kgm2=[65893e3,60000e3,50000e3]" for axis in ("yy", "zz")],
            "vehicle.stage.0.mass.table.Iyy_kgm2 = 6.5893e+07 is implausible; usual: at most 3e+05",
        ),
        (["stage.0.engine.thrust_factor=100.0"], "engine.table.thrust_vacuum_N = 1.5e+07 is implausible"),
        (
            ["stage.0.engine.exit_area_m2=1.18"],
            "vehicle.stage.0.engine.exit_area_m2 = 1.18 is implausible; usual: at most the cross section of the body, "
            "0.785 m2",
        ),
        (["stage.0.engine.thrust_factor=0.1"], "usual: more than the weight of 2.627e+04 N, or it is never"),
    ],
)
def test_vehicles_that_are_implausible(here: Path, overrides: list[str], says: str) -> None:
    text = load_scenario("ascent.toml").as_flown
    (here / "whole.toml").write_text(text)
    found = load_scenario("whole.toml", [f"vehicle.{override}" for override in overrides]).warnings
    assert any(says in warning for warning in found), found


@pytest.fixture(scope="module")
def from_layout(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("petrel")
    shutil.copytree(petrel.folder(), folder, dirs_exist_ok=True)
    text = load_scenario(folder / "scenario.toml").as_flown
    (folder / "whole.toml").write_text(text)
    return folder


FAST = (
    "computer.sample_s = 0.01 is implausible; usual: below 0.00627 s: the first mode of second, fairing off reaches 79"
)


SPATIAL_END = {
    "time_s": [0.0] * 2 + [10.0] * 2,
    "mode": [1.0] * 4,
    "frequency_hz": [9.0] * 4,
    "generalized_mass_kg": [1e3] * 4,
    "station_m": [0.0, 14.0] * 2,
    "mass_forward_kg": [0.0, 2600.0] * 2,
    **{name: [0.0] * 4 for name in ("phi_y", "phi_z", "theta_x_pm", "theta_y_pm", "theta_z_pm")},
    "phi_x": [1.0, -1.0] * 2,
}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("key", "change"),
    [
        ("spatial_modes.table", {"spatial_modes": {"table": SPATIAL_END, "damping_ratio": [0.01]}}),
        (
            "mass.rate_damping",
            {"rate_damping": {"time_s": [0.0, 10.0], **{name: [1.0, 2.0] for name in ("x_Nms", "y_Nms", "z_Nms")}}},
        ),
        (
            "aero.moment_reference_over_time",
            {"moment_reference_over_time": {"time_s": [0.0, 10.0], "station_m": [7.0, 6.0]}},
        ),
    ],
)
def test_tables_that_end_before_the_thrust_are_refused(key: str, change: dict[str, Any], tmp_path: Path) -> None:
    tree = tomllib.loads(load_scenario("nominal").as_flown)
    stage = tree["vehicle"]["stage"][0]
    stage.pop("loads", None)
    at = stage if key.startswith("spatial") else stage[key.partition(".")[0]]
    at.pop("moment_reference_m", None)
    at.update(change)
    (tmp_path / "short.toml").write_text(tomli_w.dumps(tree))
    with pytest.raises(ScenarioError, match=rf"{key}.time_s.*: the table ends before the thrust does"):
        load_scenario(tmp_path / "short.toml")


@pytest.mark.parametrize(
    ("override", "says"),
    [
        ("vehicle.stage.0.engine.throttle=[{time_s=0.0,throttle=5.0}]", r"throttle\[?\.?0.* = 5.*is out of range"),
        (
            "fault=[{kind='engine-off',at_s=5.0,tail_off=[{time_s=0.0,share=2.0},{time_s=1.0,share=0.0}]}]",
            "share.* = 2.*exceeds the thrust before the fault",
        ),
    ],
)
def test_more_than_an_engine_has_is_refused(override: str, says: str) -> None:
    with pytest.raises(ScenarioError, match=says):
        load_scenario("nominal", [override])


def test_a_tank_without_radius_is_said_to_report_no_breaking_waves(here: Path) -> None:
    said = "vehicle.stage.0.tank.0.radius_m is not given: breaking waves of this tank are not reported"
    assert said in load_scenario("ascent.toml").warnings
    assert said not in load_scenario("ascent.toml", ["vehicle.stage.0.tank.0.radius_m=0.49"]).warnings
    assert said not in load_scenario("ascent.toml", ["switches.slosh=false"]).warnings


def test_a_vehicle_from_a_layout_is_warned_of_only_for_its_sample_rate(from_layout: Path) -> None:
    assert [
        warning.removeprefix("vehicle.")[: len(FAST)] for warning in load_scenario(from_layout / "whole.toml").warnings
    ] == [FAST]


@pytest.mark.slow
@pytest.mark.parametrize("vehicle", ["ksr3", "petrel"])
@pytest.mark.parametrize(
    ("break_it", "says"),
    [
        (lambda stage: scaled(stage["mass"]["table"], 1e-3, "Ixx_kgm2", "Iyy_kgm2", "Izz_kgm2"), "as gyration radius"),
        (lambda stage: scaled(stage["mass"]["table"], 10.0, "x_cg_m"), "x_cg_m = .* usual: inside the vehicle"),
        (lambda stage: engines(stage, gimbal_station_m=2.0), "gimbal_station_m = 2 .* turns the wrong way"),
        (lambda stage: stage["aero"].update(centre_shift_m=-30.0), "aero.surface = .* a centre of pressure near"),
        (lambda stage: engines(stage, thrust_factor=0.15), r"angle_limit_deg = 6 .* \|M_alpha\| / M_delta takes"),
        (
            lambda stage: [tank.update(damping_ratio=0.002) for tank in stage["tank"]],
            "damping_ratio = 0.002 .* between centre of percussion and CG",
        ),
        (lambda stage: scaled(stage["bending"]["pitch"], 10.0, "frequency_hz"), "sample_s = 0.01 .* Hz and aliases"),
    ],
)
def test_broken_copies_of_both_vehicles(
    vehicle: str, break_it: Callable[[Any], Any], says: str, from_layout: Path, tmp_path: Path
) -> None:
    text = load_scenario("nominal").as_flown if vehicle == "ksr3" else (from_layout / "whole.toml").read_text()
    tree = tomllib.loads(text)
    break_it(tree["vehicle"]["stage"][0])
    (tmp_path / "broken.toml").write_text(tomli_w.dumps(tree))
    found = load_scenario(tmp_path / "broken.toml").warnings
    assert any(re.search(says, warning) for warning in found), found


def scaled(table: dict[str, Any], factor: float, *columns: str) -> None:
    for name in columns:
        table[name] = [factor * value for value in table[name]]


def engines(stage: dict[str, Any], **change: float) -> None:
    stage.pop("loads", None)  # their stations reach to the gimbal
    for engine in stage["engine"] if isinstance(stage["engine"], list) else [stage["engine"]]:
        engine.update(change)


@pytest.mark.parametrize(
    ("overrides", "says"),
    [
        (["site.altitude_m=3e5"], "site.altitude_m = 300000 is implausible; usual: a place on the ground"),
        (["wind.factor=-5.0"], "wind.profile = 200 is implausible; usual: less than 150 m/s below 30000 m"),
        (["run.step_s=1e-6", "run.duration_s=1e4"], "run.step_s = 1e-06 is implausible; usual: fewer than 1e+09 steps"),
        (["log.fast_hz=1e6", "run.duration_s=1e4"], "log.fast_hz = 1e+06 is implausible; usual: fewer than 1e+09 rows"),
    ],
)
def test_flights_that_are_implausible(here: Path, overrides: list[str], says: str) -> None:
    found = implausible(load_scenario("ascent.toml", overrides).warnings)
    assert len(found) == 1
    assert says in found[0]


DISPERSED = """\
schema = 1
extends = "ascent.toml"
unset = ["requirement"]
[campaign]
runs = 4
[[disperse]]
key = "{key}"
{rest}
"""


@pytest.mark.parametrize(
    ("key", "rest", "warned_of"),
    [
        ("vehicle.stage.0.engine.thrust_factor", 'distribution = "normal"\nthree_sigma = 1.2', True),
        ("vehicle.stage.0.engine.thrust_factor", 'distribution = "normal"\nthree_sigma = 1.2\nat_least = 0.5', False),
        ("vehicle.stage.0.engine.thrust_factor", 'distribution = "normal"\nthree_sigma = 0.9', False),
        ("vehicle.stage.0.mass.table.Iyy_kgm2", 'apply = "scale"\ndistribution = "normal"\nthree_sigma = 1.1', True),
        ("vehicle.stage.0.mass.table.Ixx_kgm2", 'apply = "scale"\ndistribution = "uniform"\nlow = 0.5\nhigh = 1', 0),
        ("wind.factor", 'distribution = "uniform"\nlow = -1.0\nhigh = 1.0', True),
        ("vehicle.stage.0.aero.centre_shift_m", 'distribution = "normal"\nsigma = 0.3', False),  # about nothing
        ("vehicle.stage.0.engine.gimbal_station_m", 'apply = "add"\ndistribution = "normal"\nsigma = 9.0', True),
        ("site.azimuth_deg", 'apply = "add"\ndistribution = "normal"\nsigma = 50.0', False),  # an angle
    ],
)
def test_dispersions_that_turn_a_sign(here: Path, key: str, rest: str, warned_of: bool) -> None:
    (here / "campaign.toml").write_text(DISPERSED.format(key=key, rest=rest))
    found = implausible(maxq.load("campaign.toml").warnings)
    assert [warning.startswith(f"{key} is not expected to change its sign") for warning in found] == [True] * warned_of


@pytest.mark.slow
def test_warnings_in_summary_and_report(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    overrides = ["vehicle.reference.length_m=180.0", "run.duration_s=0.1", "requirement="]
    code = simrun.main(["ascent.toml", "--no-log", "--out", "out", *(x for o in overrides for x in ("--set", o))])
    assert code == 0
    line = "vehicle.reference.length_m = 180 is implausible; usual: the rearmost station, 14 m, or a little more"
    assert f"warning: {line}\n" in capsys.readouterr().out
    assert line in json.loads((here / "out" / "summary.json").read_text())["warnings"]
    sign = 'distribution = "normal"\nthree_sigma = 1.2\n[run]\nduration_s = 0.1'
    (here / "campaign.toml").write_text(DISPERSED.format(key="vehicle.stage.0.engine.thrust_factor", rest=sign))
    simrun.main(["campaign.toml", "--out", "flown"])
    assert "warning: vehicle.stage.0.engine.thrust_factor is not expected to" in capsys.readouterr().out
    assert "is not expected to change its sign" in (here / "flown" / "report.html").read_text()
    assert len(implausible(json.loads((here / "flown" / "summary.json").read_text())["warnings"])) == 1


def test_log_rates_above_that_of_the_steps(here: Path) -> None:
    at_most = "is implausible; usual: at most {} Hz, a row for each step"
    found = load_scenario("ascent.toml", ["log.fast_hz=2e3", "log.slow_hz=5e3"]).warnings
    said = {w.partition(" is ")[0]: w for w in found if w.startswith("log.")}
    assert said["log.fast_hz = 2000"].endswith(at_most.format(1000))
    assert said["log.slow_hz = 5000"].endswith(at_most.format(1000))
    for more in (["log.fast_hz=2e3", "run.step_s=0.0005"], ["run.step_s=0.002"]):
        assert not any(w.startswith("log.") for w in load_scenario("ascent.toml", more).warnings)


def test_a_check_that_fails_is_a_warning_and_does_not_end_the_flight(
    here: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fails(*_: object, **__: object) -> Iterator[plausibility.Implausible]:
        yield "mass", 1.0, "made up"
        raise ValueError("zero-size array")

    monkeypatch.setattr(plausibility, "_stage", fails)
    found = load_scenario("ascent.toml", ["wind.factor=20.0"]).warnings
    assert "vehicle.stage.0.mass = 1 is implausible; usual: made up" in found
    assert "vehicle.stage.0: not all values could be checked (ValueError: zero-size array)" in found
    assert any(warning.startswith("wind.profile = ") for warning in found)
