"""A valid scenario has defaults, files, extends and overrides, and its text flies again."""

from __future__ import annotations

import subprocess
import sys
import time
import tomllib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from pydantic import ValidationError
from scenario_files import ASCENT, TABLES, write_ascent, write_free

from maxq import LoadedScenario, ScenarioError, builtin_names
from maxq.sim.input import toml_columns
from maxq.sim.input.documents import Source, parse
from maxq.sim.input.files import builtin_files, scenarios_folder
from maxq.sim.input.values import is_whole_ns, period_ns, to_ns
from maxq.sim.scenario.loader import copy_scenario, load_scenario, load_scenario_text


@pytest.fixture
def ascent(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return write_ascent(tmp_path)


def same_bits(a: LoadedScenario, b: LoadedScenario) -> bool:
    return a == b and a.as_flown == b.as_flown


# the schema


def test_tables_come_with_the_model(ascent: Path) -> None:
    stage = load_scenario(ascent).vehicle.stage[0]
    assert stage.mass.table is not None
    assert stage.engine is not None
    assert stage.mass.table.file == "mass.csv"
    assert stage.mass.table["mass_kg"].tolist() == [6100.0, 4400.0, 2681.0]
    assert stage.mass.table.get("y_cg_m").tolist() == [0.0, 0.0, 0.0]
    assert "y_cg_m" not in stage.mass.table
    assert stage.engine.table["time_s"].tolist() == [0.0, 0.5, 58.0, 59.0]
    with pytest.raises(ValueError, match="read-only"):
        stage.mass.table["mass_kg"][0] = 1.0


def test_mode_tables_as_arrays(ascent: Path) -> None:
    bending = load_scenario(ascent).vehicle.stage[0].bending
    assert bending is not None
    modes = bending.pitch_modes
    assert modes is not None
    assert modes.time_s.tolist() == [0.0, 59.0]
    assert modes.station_m.tolist() == [0.0, 7.0, 14.0]
    np.testing.assert_allclose(modes.frequency_hz, [[9.1, 18.2], [9.69, 18.79]], rtol=1e-15)
    assert modes.generalized_mass_kg.tolist() == [[1700.0, 3400.0], [1700.0, 3400.0]]
    assert modes.phi[1, 1].tolist() == [1.8, 0.4, -1.0]
    assert modes.slope_pm[0, 0].tolist() == [-0.5, -0.01, 0.48]
    assert modes.mass_forward_kg.tolist() == [[0.0, 2800.0, 5600.0]] * 2


def test_the_order_of_modes_and_stations_does_not_matter(ascent: Path) -> None:
    before = load_scenario(ascent).vehicle.stage[0].bending
    path = ascent.parent / "vehicles/rocket/modes.csv"
    header, *rows = path.read_text().splitlines()
    path.write_text("\n".join([header, *rows[5::-1], *rows[:5:-1]]))
    after = load_scenario(ascent).vehicle.stage[0].bending
    assert before is not None
    assert after is not None
    assert before.pitch_modes is not None
    assert after.pitch_modes is not None
    assert before.pitch_modes.phi.tolist() == after.pitch_modes.phi.tolist()


def test_defaults(tmp_path: Path) -> None:
    scenario = load_scenario(write_free(tmp_path)).scenario
    assert scenario.name == "free"
    assert (scenario.run.step_s, scenario.run.seed, scenario.run.stop_at) == (0.001, 1, ("impact",))
    assert scenario.run.freeze_vehicle_at_s is None
    assert (scenario.earth.shape, scenario.earth.rotating, scenario.earth.gravity) == ("wgs84", True, "j2")
    assert (scenario.log.fast_hz, scenario.log.slow_hz, scenario.log.transform_hz) == (1000.0, 100.0, 50.0)
    assert scenario.held is False
    assert scenario.design is None
    assert scenario.vehicle.computer is None
    reference = scenario.vehicle.reference
    assert (reference.chord_m, reference.span_m, reference.yaw_chord_m) == (0.1, 0.1, 0.1)


def test_whole_numbers_are_numbers(tmp_path: Path) -> None:
    scenario = load_scenario(write_free(tmp_path), ["run.duration_s=30", "site.altitude_m=0"]).scenario
    assert isinstance(scenario.run.duration_s, float)


def test_nothing_can_be_changed(ascent: Path) -> None:
    loaded = load_scenario(ascent)
    with pytest.raises(ValidationError, match="frozen"):
        loaded.scenario.run.step_s = 0.1


def test_yaw_actuator_differs_where_it_says_so(ascent: Path) -> None:
    sets = ["vehicle.stage.0.actuator.yaw.rate_limit_degps=20", "vehicle.stage.0.actuator.backlash_deg=0.1"]
    actuator = load_scenario(ascent, sets).vehicle.stage[0].actuator
    assert actuator is not None
    pitch, yaw = actuator.axes
    assert (pitch.rate_limit_degps, yaw.rate_limit_degps) == (30.0, 20.0)
    assert (pitch.backlash_deg, yaw.backlash_deg) == (0.1, 0.1)
    assert pitch.omega_hz == yaw.omega_hz == (5.8, 7.2, 52.6, 15.6)


def test_gains_of_the_yaw_axis(ascent: Path) -> None:
    design = load_scenario(ascent).design
    assert design is not None
    assert design.gains.axes[0] is design.gains.axes[1]
    own = ["design.gains.yaw=", "design.gains.yaw_table={time_s = [0], k_p = [1], k_d_s = [0.4]}"]
    design = load_scenario(ascent, own).design
    assert design is not None
    assert design.gains.axes[1]["k_d_s"].tolist() == [0.4]


def test_products_of_inertia_take_part_in_the_check(ascent: Path) -> None:
    """With Ixx 735 and Izz 65,893 kg m2, an Ixz of 100 is accepted and 7,000 rejected (Ixz^2 > Ixx Izz)."""
    path = ascent.parent / "vehicles/rocket/mass.csv"
    header, *rows = TABLES["mass.csv"].splitlines()
    path.write_text("\n".join([f"{header},Ixz_kgm2", *(f"{row},100" for row in rows)]))
    load_scenario(ascent)
    path.write_text("\n".join([f"{header},Ixz_kgm2", *(f"{row},7000" for row in rows)]))
    with pytest.raises(ScenarioError, match="are not all positive"):
        load_scenario(ascent)


def test_a_stage_that_separates_needs_its_tables_until_then_only(ascent: Path) -> None:
    path = ascent.parent / "vehicles/rocket/vehicle.toml"
    text = path.read_text()
    head, computer = text.split("[computer]")
    stage = '[[stage]]\nname = "upper"\n[stage.mass]\nmass_kg = 300.0\nx_cg_m = 2.0\n'
    stage += "inertia_kgm2 = [[10.0, 0, 0], [0, 90.0, 0], [0, 0, 90.0]]\nmass_flow_kgps = 2.0\nburn_s = 20.0\n"
    named = head.replace('name = "main"', 'name = "main"\nseparation_after_burnout_s = 1.0')
    path.write_text(f"{named}{stage}[computer]{computer}")
    assert [s.name for s in load_scenario(ascent).vehicle.stage] == ["main", "upper"]
    path.write_text(f"{head}{stage}[computer]{computer}")
    with pytest.raises(ScenarioError, match="another stage follows; allowed: separation_s or"):
        load_scenario(ascent)
    early = head.replace('name = "main"', 'name = "main"\nseparation_s = 40.0')
    path.write_text(f"{early}{stage}[computer]{computer}")
    tank = ascent.parent / "vehicles/rocket/tank.csv"
    tank.write_text(tank.read_text().replace("59,10", "40,10"))
    load_scenario(ascent)


def test_thrust_may_go_on_when_the_flight_ends_before(ascent: Path) -> None:
    path = ascent.parent / "vehicles/rocket/thrust.csv"
    path.write_text(path.read_text().replace("59,0", "59,100000"))
    load_scenario(ascent)  # it ends with the propellant
    mass = ascent.parent / "vehicles/rocket/mass.csv"
    mass.write_text(mass.read_text().replace("59,2681", "59.1,2681"))
    with pytest.raises(ScenarioError, match=r"thrust does not end at zero.*end of the mass flow \(59.1 s\)"):
        load_scenario(ascent)
    load_scenario(ascent, ["run.duration_s=59"])
    with pytest.raises(ScenarioError, match="goes on after 53"):
        load_scenario(ascent, ["run.duration_s=59", "vehicle.stage.0.engine.mass_flow_factor=1.1"])
    load_scenario(ascent, ["run.freeze_vehicle_at_s=30"])
    load_scenario(ascent, ["switches.thrust=false", "holddown.release=time", "holddown.release_s=0"])


def test_a_table_with_one_row_is_constant(ascent: Path) -> None:
    path = ascent.parent / "vehicles/rocket/tank.csv"
    path.write_text("time_s,slosh_mass_kg,pendulum_length_m,hinge_station_m\n0,100,0.27,8.6\n")
    tank = load_scenario(ascent).vehicle.stage[0].tank[0]
    assert len(tank.table) == 1


def test_a_short_flight_needs_no_other_gains(ascent: Path) -> None:
    assert load_scenario(ascent, ["run.duration_s=1"]).scenario.run.duration_s == 1.0


def test_check_cases_need_neither_engine_nor_computer(tmp_path: Path) -> None:
    path = write_free(tmp_path)
    path.write_text(
        path.read_text() + '[[injection]]\nat = "body_torque"\naxis = "x"\nkind = "step"\namplitude_Nm = 10.0\n'
        "start_s = 1000.0\n"
        "stop_s = 2000.0\n"
        '[[injection]]\nat = "body_force"\naxis = "z"\nkind = "table"\n'
        "table = {time_s = [0, 1], value = [0, 5]}\n"
        '[earth]\nshape = "sphere"\nrotating = false\ngravity = "inverse_square"\n'
        "sphere_radius_m = 6371007.1809\n"
    )
    loaded = load_scenario(path)
    assert [injection.amplitude for injection in loaded.scenario.injection] == [10.0, 1.0]
    assert same_bits(load_scenario_text(loaded.as_flown), loaded)


# files, extends, overrides


def test_extends_merges_tables_and_replaces_lists(ascent: Path) -> None:
    sub = ascent.parent / "variants"
    sub.mkdir()
    (sub / "calm.toml").write_text(
        'extends = "../ascent.toml"\nunset = ["wind.profile"]\n[run]\nstep_s = 0.002\n'
        '[[requirement]]\nmetric = "range_m"\nminimum = 1.0\n'
    )
    parent, child = load_scenario(ascent).scenario, load_scenario(sub / "calm.toml").scenario
    assert (child.run.duration_s, child.run.step_s) == (300.0, 0.002)
    assert [r.metric for r in child.requirement] == ["range_m"]
    assert (parent.name, child.name) == ("ascent", "calm")
    assert parent.wind.profile is not None
    assert child.wind.profile is None
    assert child.vehicle == parent.vehicle, "files of the parent are found beside the parent"


def test_extends_across_three_files(ascent: Path) -> None:
    (ascent.parent / "b.toml").write_text('extends = "ascent"\nname = "b"\n[run]\nseed = 2\nstep_s = 0.002\n')
    (ascent.parent / "c.toml").write_text('extends = "b"\n[run]\nseed = 3\n')
    scenario = load_scenario(ascent.parent / "c.toml").scenario
    assert (scenario.name, scenario.run.seed, scenario.run.step_s) == ("c", 3, 0.002)


def test_appended_lists_follow_those_of_the_extended_files(ascent: Path) -> None:
    """Each file of a chain appends; a table is merged, a missing list created, and another key replaced."""
    first = '[[append.requirement]]\nmetric = "range_m"\nminimum = 1.0\n[append.run]\nstop_at = ["apogee"]\n'
    (ascent.parent / "b.toml").write_text(f'extends = "ascent"\n{first}')
    second = '[[append.requirement]]\nmetric = "max_slosh_deg"\nlimit = 3.0\n'
    (ascent.parent / "c.toml").write_text(f'extends = "b"\n[run]\nstop_at = ["impact"]\n{second}')
    base, b, c = (load_scenario(ascent.parent / f"{name}.toml").scenario for name in ("ascent", "b", "c"))
    assert b.run.stop_at == ("apogee",)  # the default is no list of the extended file
    assert c.run.stop_at == ("impact",)
    assert b.requirement == (*base.requirement, b.requirement[-1])
    assert [r.metric for r in c.requirement[len(base.requirement) :]] == ["range_m", "max_slosh_deg"]
    assert not base.fault
    fault = '[[append.fault]]\nkind = "engine-off"\nat_s = 7.0\n'
    (ascent.parent / "d.toml").write_text(f'extends = "ascent"\n{fault}')
    assert [f.at_s for f in load_scenario(ascent.parent / "d.toml").scenario.fault] == [7.0]


def test_an_appended_stage_finds_its_tables_beside_its_file(ascent: Path) -> None:
    folder = ascent.parent / "vehicles" / "taller"
    folder.mkdir()
    (folder / "heavy.csv").write_text("time_s,mass_kg,x_cg_m,Ixx_kgm2,Iyy_kgm2,Izz_kgm2\n0,500,3,100,900,900\n")
    upper = '[[append.stage]]\nname = "upper"\n[append.stage.mass]\ntable = "heavy.csv"\n'
    (folder / "vehicle.toml").write_text(f'extends = "../rocket"\n{upper}')
    vehicle = load_scenario(ascent, ["vehicle=vehicles/taller", "vehicle.stage.0.separation_s=70"]).vehicle
    assert [stage.name for stage in vehicle.stage][1:] == ["upper"]
    table = vehicle.stage[-1].mass.table
    assert table is not None
    assert table["mass_kg"].tolist() == [500.0]


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("[[append.requirement]]\n", "append: there is no list to append to; allowed: with extends"),
        ('extends = "ascent"\nappend = 3\n', "append = 3: has the wrong type; allowed: a table of lists"),
        ('extends = "ascent"\n[append.run]\nstep_s = 1.0\n', "append.run.step_s = 1.0: is no list; allowed: a list"),
        ('extends = "ascent"\n[append.run]\nstep_s = [1.0]\n', "append.run.step_s = [1.0]: has the wrong type"),
        (
            'extends = "ascent"\n[append.run]\nduration_s = [1.0]\n',
            "append.run.duration_s: the extended file has no list",
        ),
        ('extends = "ascent"\n[[append.run]]\nstep_s = 1.0\n', "append.run: the extended file has no list there"),
        ('extends = "ascent"\n[append.vehicle]\nstage = []\n', "append.vehicle: the extended file has no table there"),
        (
            'extends = "ascent"\n[[append.requirement]]\nmetric = "range_m"\nmost = 1.0\n',
            "append.requirement.0.most = 1.0: unknown key",
        ),
        (
            'extends = "ascent"\n[[append.requirements]]\nmetric = "range_m"\n',
            'append.requirements = [{metric = "range_m"}]: unknown key',
        ),
    ],
)
def test_a_mistake_in_appended_lists_names_file_and_key(ascent: Path, text: str, says: str) -> None:
    (ascent.parent / "b.toml").write_text(text)
    with pytest.raises(ScenarioError) as error:
        load_scenario(ascent.parent / "b.toml")
    assert str(error.value).startswith(str(ascent.parent / "b.toml"))
    assert says in str(error.value)


def test_a_vehicle_extends_another(ascent: Path) -> None:
    folder = ascent.parent / "vehicles" / "stiff"
    folder.mkdir()
    (folder / "vehicle.toml").write_text('extends = "../rocket"\nname = "stiff"\n[reference]\narea_m2 = 1.0\n')
    vehicle = load_scenario(ascent, ["vehicle=vehicles/stiff"]).vehicle
    assert (vehicle.name, vehicle.reference.area_m2, vehicle.reference.length_m) == ("stiff", 1.0, 14.0)
    assert vehicle.stage == load_scenario(ascent).vehicle.stage


@pytest.mark.parametrize(
    "written",
    [
        "stage.0.tank.0.damping_ratio = 0.01\nstage.0.engine.thrust_factor = 1.02",
        '"stage.0.tank.0.damping_ratio" = 0.01\n"stage.0.engine".thrust_factor = 1.02',
    ],
)
def test_overrides_in_the_file(ascent: Path, written: str) -> None:
    ascent.write_text(f"{ASCENT}[vehicle_overrides]\n{written}\n[design_overrides]\nroll.dead_band_deg = 2.0\n")
    loaded = load_scenario(ascent)
    stage, design = loaded.vehicle.stage[0], loaded.design
    assert stage.engine is not None
    assert design is not None
    assert design.roll is not None
    assert (stage.tank[0].damping_ratio, stage.engine.thrust_factor) == (0.01, 1.02)
    assert stage.engine.gimbal_station_m == 12.7
    assert design.roll.dead_band_deg == 2.0


def test_overrides_on_the_command_line(ascent: Path) -> None:
    loaded = load_scenario(
        ascent,
        [
            "run.step_s=0.0005",
            "earth.gravity=inverse_square",
            "vehicle.stage.0.actuator.omega_hz.2=50",
            "vehicle.stage.0.tank.0.damping_ratio = 0.05",
            "wind={speed_mps = 5.0, from_deg = 90.0}",
            "design.gains.table=[{time_s = 0, k_p = 1, k_d_s = 0.5}]",
            "injection=[]",
            'description="a = b"',
        ],
    )
    scenario = loaded.scenario
    actuator = loaded.vehicle.stage[0].actuator
    assert actuator is not None
    assert loaded.design is not None
    assert (scenario.run.step_s, scenario.earth.gravity) == (0.0005, "inverse_square")
    assert actuator.omega_hz == (5.8, 7.2, 50.0, 15.6)
    assert loaded.vehicle.stage[0].tank[0].damping_ratio == 0.05
    assert (scenario.wind.speed_mps, scenario.wind.profile) == (5.0, None)
    assert len(loaded.design.gains.table) == 1
    assert scenario.injection == ()
    assert scenario.description == "a = b"
    assert load_scenario(ascent, ["design="]).design is None


def test_files_that_were_read(ascent: Path) -> None:
    files = load_scenario("ascent.toml").files
    assert [f.shown for f in files][:3] == ["ascent.toml", "vehicles/rocket/vehicle.toml", "designs/trial.toml"]
    assert {f.path.name for f in files} >= {*TABLES, "modes.csv", "programme.csv", "west.csv"}
    assert len({f.path for f in files}) == len(files) == 11
    assert files[0].content == ascent.read_bytes()


# the scenario as flown


def test_the_text_flies_again_bit_by_bit(ascent: Path) -> None:
    loaded = load_scenario(ascent, ["vehicle.stage.0.engine.thrust_factor=1.0000000000000002", "run.seed=77"])
    again = load_scenario_text(loaded.as_flown)
    assert same_bits(again, loaded)
    assert again.files == ()
    assert str(ascent.parent) not in loaded.as_flown
    assert again != load_scenario(ascent)
    assert tomllib.loads(loaded.as_flown)["run"]["step_s"] == 0.001, "defaults are written, too"


def test_one_bit_makes_another_scenario(ascent: Path) -> None:
    before = load_scenario(ascent)
    path = ascent.parent / "vehicles/rocket/aero.csv"
    path.write_text(path.read_text().replace("0.9,-700", "0.9000000000000001,-700"))
    after = load_scenario(ascent)
    assert before != after
    assert before.as_flown != after.as_flown


def test_odd_texts_and_numbers_survive(tmp_path: Path) -> None:
    path = write_free(tmp_path)
    text = 'tab\\t quote \\" backslash \\\\ line\\nend é \\U0001f680'
    path.write_text(f'description = "{text}"\n' + path.read_text())
    loaded = load_scenario(path, ["site.longitude_deg=-0.0", "initial.ned_mps=[1e-300, 1e4, 0.1]"])
    again = load_scenario_text(loaded.as_flown)
    assert again.scenario.description == 'tab\t quote " backslash \\ line\nend é \U0001f680'
    assert str(again.scenario.site.longitude_deg) == "-0.0"
    assert same_bits(again, loaded)


def test_overrides_apply_to_the_text_of_a_log(ascent: Path) -> None:
    text = load_scenario(ascent).as_flown
    assert load_scenario_text(text, ["run.seed=5"]).scenario.run.seed == 5
    wind = "wind.profile=winds/west.csv"
    assert same_bits(load_scenario_text(text, [wind]), load_scenario_text(text)) is True


def test_errors_in_the_text_of_a_log(ascent: Path) -> None:
    text = load_scenario(ascent).as_flown.replace("mass_kg = [6100.0", "mass_kg = [-6100.0")
    with pytest.raises(ScenarioError) as caught:
        load_scenario_text(text)
    assert str(caught.value) == (
        "scenario as flown: vehicle.stage.0.mass.table.mass_kg.0 = -6100.0: is not positive; allowed: numbers > 0"
    )


# built-in scenarios


@pytest.fixture
def shipped(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return a folder of built-in scenarios."""
    root = tmp_path / "installed" / "scenarios"
    write_ascent(root)
    (root / "checkcases").mkdir()
    (root / "checkcases" / "windy.toml").write_text('extends = "../ascent"\n[wind]\nfactor = 2.0\n')
    (root / "vehicles" / "rocket" / "NOTES.md").write_text("notes\n")
    for module in ("scenario.loader", "input.files"):
        monkeypatch.setattr(f"maxq.sim.{module}.scenarios_folder", lambda: root)
    empty = tmp_path / "elsewhere"
    empty.mkdir()
    monkeypatch.chdir(empty)
    return root


def test_built_in_names(shipped: Path) -> None:
    assert builtin_names() == ["ascent", "checkcases/windy"]
    assert builtin_files("scenario")["checkcases/windy"] == shipped / "checkcases" / "windy.toml"
    assert "vehicles/rocket/vehicle" not in builtin_files("scenario")
    assert load_scenario("checkcases/windy").scenario.wind.factor == 2.0
    with pytest.raises(ScenarioError, match=r"^asent: no such file; did you mean ascent"):
        load_scenario("asent")


def test_a_file_comes_before_a_built_in_scenario_a_folder_does_not(shipped: Path) -> None:
    Path("ascent").mkdir()
    assert load_scenario("ascent").name == "ascent"
    Path("ascent.toml").write_text('extends = "checkcases/windy"\nname = "mine"\n')
    mine = load_scenario("ascent.toml").scenario
    assert (mine.name, mine.wind.factor) == ("mine", 2.0)


def test_a_copy_stands_on_its_own(shipped: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    before = load_scenario("checkcases/windy")
    copied = copy_scenario("checkcases/windy", "mine")
    assert copied == Path("mine/checkcases/windy.toml")
    assert not Path("mine/vehicles/rocket/NOTES.md").exists()  # nothing that the scenario does not read
    for module in ("scenario.loader", "input.files"):
        monkeypatch.setattr(f"maxq.sim.{module}.scenarios_folder", lambda: tmp_path / "gone")
    after = load_scenario(copied)
    assert same_bits(before, after)
    assert all(file.path.is_relative_to(tmp_path / "elsewhere" / "mine") for file in after.files)


def test_a_copy_overwrites_nothing(shipped: Path) -> None:
    Path("mine/winds").mkdir(parents=True)
    Path("mine/winds/west.csv").write_text("my own\n")
    with pytest.raises(ScenarioError, match=r"^mine/winds/west.csv: already exists, and is not overwritten"):
        copy_scenario("ascent", "mine")
    assert not Path("mine/ascent.toml").exists()
    assert Path("mine/winds/west.csv").read_text() == "my own\n"
    with pytest.raises(ScenarioError, match=r"^asent: no such built-in scenario; did you mean ascent"):
        copy_scenario("asent", "other")


@pytest.mark.parametrize("name", builtin_names())
def test_every_built_in_scenario_loads_flies_again_and_copies(name: str, tmp_path: Path) -> None:
    loaded = load_scenario(name)
    assert same_bits(load_scenario_text(loaded.as_flown), loaded)
    copy = load_scenario(copy_scenario(name, tmp_path))
    assert same_bits(copy, loaded)
    assert all(file.path.is_relative_to(tmp_path.resolve()) for file in copy.files)


def test_the_folder_of_scenarios_is_the_repositorys() -> None:
    assert scenarios_folder() == Path(__file__).resolve().parents[1] / "scenarios"


# time


@pytest.mark.parametrize(
    ("seconds", "whole"),
    [(0.001, True), (0.003, True), (1 / 128, True), (0.1 + 0.2, True), (1e-9, True), (1 / 3, False), (1e-10, False)],
)
def test_whole_nanoseconds(seconds: float, whole: bool) -> None:
    assert is_whole_ns(seconds) is whole
    if whole:
        assert abs(to_ns(seconds) - seconds * 1e9) < 1e-6
    else:
        with pytest.raises(ValueError, match="whole number of nanoseconds"):
            to_ns(seconds)


def test_periods() -> None:
    assert [period_ns(rate) for rate in (1000.0, 100.0, 50.0, 0.5)] == [1_000_000, 10_000_000, 20_000_000, 2 * 10**9]
    with pytest.raises(ValueError, match="whole number of nanoseconds"):
        period_ns(300.0)


@pytest.mark.parametrize(("name", "old", "new"), [("mass.csv", "4400", "4500"), ("vehicle.toml", "0.785", "0.795")])
def test_a_file_that_changes_is_read_again(ascent: Path, name: str, old: str, new: str) -> None:
    """A file that changes is read again, also at the same length; equal files are read once."""
    (path,) = ascent.parent.rglob(name)
    text = path.read_text()
    assert old in text
    before = load_scenario(ascent)
    path.write_text(text.replace(old, new, 1))
    assert load_scenario(ascent) != before
    path.write_text(text)
    assert same_bits(load_scenario(ascent), before)


def test_documents_of_one_text_are_independent() -> None:
    text = "a = [1]\n[b]\nc = 1\n"
    document = parse(text, Source("one"))
    document["a"].append(2)
    document["b"]["c"] = 2
    assert parse(text, Source("another")) == {"a": [1], "b": {"c": 1}}


LONG = ", ".join(f"{0.37 * k - 9.0!r}, {-k}, {k}e-{k}" for k in range(40))


@pytest.mark.parametrize(
    "text",
    [
        f"before = 1\na = [{LONG}]\n[t]\nb = [{LONG}, 7]\n[[u]]\nc = [{LONG}]\n[[u]]\nc = [[{LONG}], [{LONG}]]\n",
        f'a = """\nb = [{LONG}]\n"""\n',
        f"a = '''\nb = [{LONG}]\n'''\n",
        f"a = [{LONG}, 1979-05-27]\nb = [{LONG}, 1_000, +3, inf, 0x1F]\n",
        f"# a = [{LONG}]\nb = [{LONG}]  # of c\n'a.b' = [{LONG}]\n",
        f'a = "\ue0000"\nb = [{LONG}]\n',
        f"a = [{LONG}]\na = [{LONG}]\n",
        f"a = [{LONG}, 01]\n",
        f"a = [{LONG}, ]]\n",
        f"a = [{LONG}]\nb = \n",
        f"a = [\nb = [{LONG}]\n]\n",
    ],
)
def test_long_columns_are_read_as_by_tomllib(text: str) -> None:
    """Values and types, or the error with line and column, equal those of tomllib."""

    def read(loads: Callable[[str], object]) -> str:
        try:
            return repr(loads(text))
        except tomllib.TOMLDecodeError as error:
            return str(error)

    assert read(toml_columns.loads) == read(tomllib.loads)


def test_loading_is_quick_and_compiles_nothing(ascent: Path) -> None:
    load_scenario(ascent)
    begin = time.process_time()
    load_scenario(ascent)
    assert time.process_time() - begin < 0.15
    code = "import sys, maxq.sim.scenario.loader; print('numba' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True)
    assert done.stdout.strip() == "False"
