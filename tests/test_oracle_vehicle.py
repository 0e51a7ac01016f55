"""The results of simvehicle for a layout agree with closed forms and with its vehicle in the simulator."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import petrelkit
import petrelkit as petrel
import pytest

import maxq
from maxq import ScenarioError
from maxq.control.kernel.tables import find_interval, interpolate
from maxq.design.case.schema import read_case
from maxq.design.verify.suite import read_suite
from maxq.sim.input.values import OverTime, at_time
from maxq.sim.packing.flight import pack_flight
from maxq.sim.run.fly import fly
from maxq.sim.scenario.loader import load_scenario
from maxq.sim.scenario.schema_launch import Cutoff, Restart
from maxq.sim.vehicle.state import R_I, V_I
from maxq.tools import simvehicle
from maxq.tools.vehicle import build as building
from maxq.tools.vehicle import trajectory
from maxq.tools.vehicle.aerodynamics import aerodynamics
from maxq.tools.vehicle.beam import Beam
from maxq.tools.vehicle.build import build, burning, least_rigid_hz, m_alpha_1ps2, m_delta_1ps2
from maxq.tools.vehicle.figures import page
from maxq.tools.vehicle.files import write
from maxq.tools.vehicle.layout import Layout, LayoutEngines, read_layout
from maxq.tools.vehicle.linear_curve import LinearCurve
from maxq.tools.vehicle.masses import Rod, stacks
from maxq.tools.vehicle.trajectory import Orbit, ascent
from maxq.tools.vehicle.trajectory import _level as level_ascent

WGS84_RADIUS_m = 6378137.0
WGS84_MU_m3ps2 = 3.986004418e14

ELEMENTS = 120


@pytest.fixture(scope="module")
def layout() -> Layout:
    return read_layout("petrel")


@contextmanager
def known_path() -> Iterator[None]:
    """Build along the stored ascent of petrel, without the search, in tests that are independent of it."""
    found = petrel.path()

    def steer(model: Any, altitude_m: float) -> None:
        assert altitude_m == 250e3
        model.kick_rad, model.tangents = found

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(trajectory, "_steer_to", steer)
        yield


@pytest.fixture(scope="module")
def built(layout: Layout):
    with known_path():
        return build(layout)


def changed(layout: Layout, stage: int, **change: Any) -> Layout:
    stages = list(layout.stage)
    stages[stage] = stages[stage].model_copy(update=change)
    return layout.model_copy(update={"stage": tuple(stages)})


@pytest.mark.slow
@known_path()
def test_guidance_to_an_orbit_and_an_accelerometer_are_written(layout: Layout, tmp_path: Path) -> None:
    """The specific impulse is impulse over propellant of the last burn."""
    again = Restart(coast_s=1500.0, settling_s=20.0, settling_thrust_N=50.0, cutoff=Cutoff(apogee_altitude_m=1e6))
    wanted = layout.trajectory.model_copy(update={"apogee_altitude_m": 500e3, "restart": (again,)})
    control = layout.control.model_copy(update={"accelerometer_station_m": 3.4})
    made = build(layout.model_copy(update={"trajectory": wanted, "control": control}))
    write(made, tmp_path)
    loaded = load_scenario(tmp_path / "scenario.toml")
    orbit = loaded.scenario.guidance.orbit
    assert orbit is not None
    assert (orbit.perigee_altitude_m, orbit.apogee_altitude_m) == (250e3, 500e3)
    assert orbit.isp_s == pytest.approx(layout.stage[-1].engine.isp_vacuum_s, rel=1e-3)
    assert [s.accelerometer.station_m for s in loaded.vehicle.stage if s.accelerometer] == [3.4] * 3
    assert loaded.scenario.guidance.restart == (again,)
    assert loaded.scenario.run.duration_s > made.flight.points[-1].time_s + 1500.0
    turns = [s.roll_thrusters.pitch_yaw_torque_Nm for s in loaded.vehicle.stage if s.roll_thrusters]
    full = made.stacks[-1].mass_properties(0.0).pitch_kgm2  # the part without the fairing begins with its burn
    assert turns[0] is None
    assert turns[-1] == pytest.approx(math.radians(0.5) * full, rel=1e-9)
    far = wanted.model_copy(update={"apogee_altitude_m": 1e7})
    with pytest.raises(ScenarioError, match="exceeds the altitude that all propellant reaches"):
        write(build(layout.model_copy(update={"trajectory": far})), tmp_path)
    for keys in ({"apogee_altitude_m": 3e5}, {"apogee_altitude_m": 2e5, "orbit_altitude_m": 2.5e5}):
        with pytest.raises(ValueError, match="needs a perigee below it"):
            type(wanted).model_validate(keys)


def test_uniform_beam_has_the_frequencies_and_masses_of_the_closed_form() -> None:
    """Free-free modes have beta L = 4.73004, 7.85320, 10.99561 and, with 1 at the end, a quarter of the beam's mass."""
    length, mass, stiffness = 12.0, 480.0, 3e7
    beam = Beam(np.linspace(0.0, length, ELEMENTS + 1), np.full(ELEMENTS, stiffness))
    modes = beam.modes([Rod(mass, 0.0, length, 0.0, 0.0)], 3)
    for mode, beta in zip(modes, (4.730041, 7.853205, 10.995608), strict=True):
        wanted = (beta / length) ** 2 * math.sqrt(stiffness * length / mass) / (2.0 * math.pi)
        assert mode.frequency_hz == pytest.approx(wanted, rel=1e-6)
        assert mode.generalized_mass_kg == pytest.approx(0.25 * mass, rel=1e-5)
        assert mode.phi[-1] == 1.0
        assert mode.slope_pm == pytest.approx(np.gradient(mode.phi, beam.nodes_m), abs=0.01)


def test_engine_behind_the_beam_is_a_rigid_mass_with_a_lever() -> None:
    """A mode has no momentum and no angular momentum, including the engine's."""
    beam = Beam(np.linspace(0.0, 10.0, ELEMENTS + 1), np.full(ELEMENTS, 1e7))
    rods = [Rod(500.0, 0.0, 10.0, 0.0, 0.0), Rod(80.0, 10.0, 11.0, 0.0, 0.0)]
    with_it, without = beam.modes(rods, 1)[0], beam.modes(rods[:1], 1)[0]
    assert with_it.frequency_hz < without.frequency_hz
    x = beam.nodes_m
    shape = with_it.phi
    behind = np.linspace(0.0, 1.0, 101)
    engine = shape[-1] + with_it.slope_pm[-1] * behind
    for rigid, on_engine in ((np.ones_like(x), np.ones_like(behind)), (x, 10.0 + behind)):
        momentum = np.trapezoid(50.0 * shape * rigid, x) + np.trapezoid(80.0 * engine * on_engine, behind)
        assert abs(momentum) < 2e-3 * 500.0


def test_a_beam_held_at_its_tail_is_a_cantilever() -> None:
    """Its modes have beta L = 1.87510, 4.69409 and, with 1 at the free end, a quarter of the beam's mass."""
    length, mass, stiffness = 12.0, 480.0, 3e7
    beam = Beam(np.linspace(0.0, length, ELEMENTS + 1), np.full(ELEMENTS, stiffness))
    modes = beam.modes([Rod(mass, 0.0, length, 0.0, 0.0)], 2, clamped=True)
    for mode, beta in zip(modes, (1.875104, 4.694091), strict=True):
        wanted = (beta / length) ** 2 * math.sqrt(stiffness * length / mass) / (2.0 * math.pi)
        assert mode.frequency_hz == pytest.approx(wanted, rel=1e-5)
        assert mode.generalized_mass_kg == pytest.approx(0.25 * mass, rel=1e-5)
        assert (mode.phi[0], mode.phi[-1], mode.slope_pm[-1]) == pytest.approx((1.0, 0.0, 0.0), abs=1e-12)


@pytest.mark.slow
def test_page_holds_all_pictures(built) -> None:
    text = page(built, "BUILT: stable first gains", passed=True)
    for name in ("vehicle", "masses", "modes", "aerodynamics", "control", "ascent"):
        assert text.count(f'id="figure-{name}"') == 1
    assert '<div class="outcome good"><b>BUILT</b><p>Stable first gains.</p></div>' in text
    facts = dict(re.findall(r"<dt>(.*?)</dt><dd>(.*?)</dd>", text))
    assert {
        "mass at liftoff": "13.2 t",
        "length": "19.6 m",
        "largest diameter of the core": "1.2 m",
    }.items() <= facts.items()
    stages = re.findall(r'<th scope="col"(.*?)>(.*?)</th>', text.split("<caption>")[1])
    assert stages[0] == ("", "stage")
    assert stages[1] == (' class="n" title="mass at ignition, with all stages above"', "mass at ignition, kg")
    assert stages[5] == (' class="n" title="delta-v in vacuum, without losses"', "delta-v, m/s")
    assert "<dt>speed, m/s</dt><dd>speed relative to the Earth at burnout</dd>" in text
    assert "second, fairing off" in text
    assert "clamped at the tail on the pad" in text
    headings = ["Vehicle", "Stages", "Bending modes", "Control", "Assumptions beyond the layout"]
    assert re.findall(r'<h2 id="s\d">\d (.*?)</h2>', text) == headings
    (vehicle,) = [f for f in json.loads(text.split('id="figures">')[1].split("</script>")[0]) if f["name"] == "vehicle"]
    assert vehicle["panels"][0]["equal"], "to scale"


def test_masses_add_up_and_the_propellant_is_burned(layout: Layout) -> None:
    first, second = stacks(layout)
    assert layout.fairing is not None
    parts = sum(p.mass_kg for s in layout.stage for p in s.part) + layout.fairing.mass_kg
    engines = sum(s.engine.mass_kg * len(s.engine.positions_m) for s in layout.stage)
    liquids = sum(t.liquid_mass_kg for s in layout.stage for t in s.tank)
    assert first.mass_properties(0.0).mass_kg == pytest.approx(parts + engines + liquids, rel=1e-12)
    for stack in (first, second):
        left = sum(t.residual_kg for t in stack.stage.tank)
        assert sum(r.mass_kg for r in stack.liquids(stack.burn.end_s)) == pytest.approx(left, rel=1e-12)
        e, usable = stack.stage.engine, stack.burn.usable_kg
        impulse = float(stack.burn._impulse(stack.burn.end_s))
        assert impulse == pytest.approx(usable * 9.80665 * e.isp_vacuum_s, rel=1e-3)


def student_with_side_tanks(folder: Path, places: tuple[tuple[float, float], ...]) -> Layout:
    """Return the student rocket with its ethanol in two tanks."""
    text = (Path(__file__).parent / "data" / "layouts" / "student.toml").read_text(encoding="utf-8")
    (line,) = re.findall(r"    \{ name = \"ethanol\".*\n", text)
    half = line.replace("16.0", "8.0").replace("residual_kg = 0.5", "residual_kg = 0.25").replace("0.11", "0.078")
    lines = (
        half.replace("ethanol", f"ethanol{k}").replace(" }", f", position_m = {list(at)} }}")
        for k, at in enumerate(places)
    )
    file = folder / "student.toml"
    file.write_text(text.replace(line, "".join(lines)), encoding="utf-8")
    return read_layout(file)


def test_tanks_off_the_axis_add_their_mass_times_squared_distances(tmp_path: Path) -> None:
    """Tanks of 16 kg at 30, 70 mm add m (y^2 + z^2) to roll, m z^2 to pitch and m y^2 to yaw; half when half full."""
    beside, on_axis = (
        stacks(student_with_side_tanks(tmp_path, ((y, -z), (-y, z))))[0] for y, z in ((0.03, 0.07), (0.0, 0.0))
    )
    for t in (0.0, 10.0):
        left = sum(liquid.mass_kg for liquid in beside.liquids(t)[1:])
        a, b = beside.mass_properties(t), on_axis.mass_properties(t)
        assert left == pytest.approx(16.0 - 15.5 * beside.burn.used(t), rel=1e-12)
        assert (a.mass_kg, a.x_cg_m) == (b.mass_kg, b.x_cg_m)
        assert a.roll_kgm2 - b.roll_kgm2 == pytest.approx(left * (0.03**2 + 0.07**2), rel=1e-9)
        assert a.pitch_kgm2 - b.pitch_kgm2 == pytest.approx(left * 0.07**2, rel=1e-9)
        assert a.yaw_kgm2 - b.yaw_kgm2 == pytest.approx(left * 0.03**2, rel=1e-9)


def test_files_of_a_vehicle_with_tanks_off_the_axis(tmp_path: Path) -> None:
    built = build(student_with_side_tanks(tmp_path, ((0.03, -0.07), (-0.03, 0.07))))
    write(built, tmp_path / "out")
    (stage,) = load_scenario(tmp_path / "out" / "scenario.toml").vehicle.stage
    assert [tank.position_m for tank in stage.tank] == [(0.0, 0.0), (0.03, -0.07), (-0.03, 0.07)]
    wanted, table = built.stacks[0].mass_properties(0.0), stage.mass.table
    assert table is not None
    found = [float(table[f"I{axis}_kgm2"][0]) for axis in ("xx", "yy", "zz")]
    assert found == pytest.approx([wanted.roll_kgm2, wanted.pitch_kgm2, wanted.yaw_kgm2], rel=1e-6)
    assert found[1] > found[2] + 0.06


def test_liquid_off_the_axis_that_does_not_balance_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ScenarioError, match=r"tank = 3: liquid_mass_kg off the axis has the moments 0.48 and 0 kg m"):
        student_with_side_tanks(tmp_path, ((0.03, -0.07), (0.03, 0.07)))


def test_cg_and_inertia_are_the_integrals_over_slices(layout: Layout) -> None:
    """A half-full flat tank next to rings equals sums over a thousand slices."""
    tank = layout.stage[0].tank[0].model_copy(update={"dome_m": (0.0, 0.0), "liquid_mass_kg": 3000.0})
    stack = stacks(changed(layout, 0, tank=(tank,)))[0]
    found, rods = stack.mass_properties(0.0), [*stack.dry, *stack.liquids(0.0)]
    slices = [
        (r.mass_kg / 1000, x, r.across_m2)
        for r in rods
        for x in r.front_station_m + (r.rear_station_m - r.front_station_m) * (np.arange(1000) + 0.5) / 1000
    ]
    m, x, across = np.array(slices).T
    cg = (m @ x) / m.sum()
    assert found.x_cg_m == pytest.approx(cg, rel=1e-12)
    assert found.pitch_kgm2 == pytest.approx(m @ ((x - cg) ** 2 + across), rel=1e-6)
    height = 3000.0 / (tank.density_kgpm3 * math.pi * tank.radius_m**2)
    liquid = stack.liquids(0.0)[0]
    assert liquid.rear_station_m == pytest.approx(tank.bottom_station_m, abs=1e-6)
    assert liquid.rear_station_m - liquid.front_station_m == pytest.approx(height, rel=1e-6)


def test_fins_and_nose_have_barrowmans_slopes(layout: Layout) -> None:
    """The slopes are those of NARAM-8: nose 2 / rad; four fins of 0.8 m root, 0.4 m tip, 0.6 m span, 0.2 m sweep.

    The body has a diameter of 1.2 m.
    """
    fins = {"root_chord_m": 0.8, "tip_chord_m": 0.4, "semispan_m": 0.6, "leading_edge_station_m": 16.0, "sweep_m": 0.2}
    from maxq.tools.vehicle.layout import LayoutFins  # noqa: PLC0415  # only here

    aero = aerodynamics(stacks(changed(layout, 0, fins=LayoutFins(**fins)))[0])
    nose, finned = aero.surfaces
    assert nose.slope_pr[0] == pytest.approx(2.0, rel=0.01)
    assert nose.station_m[0] == pytest.approx(0.466 * 2.4)
    middle = math.sqrt(0.6**2 + (0.2 + 0.2 - 0.4) ** 2)
    alone = 16.0 * (0.6 / 1.2) ** 2 / (1.0 + math.sqrt(1.0 + (2.0 * middle / 1.2) ** 2))
    assert finned.slope_pr[0] == pytest.approx(alone * (1.0 + 0.6 / 1.2))
    centre = 0.2 / 3.0 * 1.6 / 1.2 + (1.2 - 0.32 / 1.2) / 6.0
    assert finned.station_m[0] == pytest.approx(16.0 + centre)
    assert (aero.roll_damping < 0.0).all()


def test_ascent_ends_in_the_orbit_asked_for(built) -> None:
    last = built.flight.points[-1]
    assert math.degrees(last.path_rad) == pytest.approx(0.0, abs=0.01)
    assert built.flight.orbit.perigee_m == pytest.approx(250e3, abs=1e3)
    assert max(m_alpha_1ps2(built, p) for p in building.burning(built)) > 3.0  # unstable
    for t, k_p, _ in built.gains:
        p = min(building.burning(built), key=lambda p: abs(p.time_s - t))
        omega = math.sqrt(m_delta_1ps2(built, p) * k_p - max(m_alpha_1ps2(built, p), 0.0))
        assert omega == pytest.approx(2.0 * math.pi * 0.4, rel=0.02)


def test_fairing_is_dropped_and_nothing_else(built, layout: Layout) -> None:
    """In a burn in two parts, mass and flow are continuous except for the fairing."""
    assert layout.fairing is not None
    _, with_it, without = built.stacks
    whole, at = stacks(layout)[1], with_it.burn.end_s
    assert with_it.mass_properties(at).mass_kg - without.mass_properties(0.0).mass_kg == pytest.approx(60.0, rel=1e-9)
    assert at + without.burn.end_s == pytest.approx(whole.burn.end_s, abs=1e-5)
    for t in (1.0, 100.0, 250.0):
        there = whole.mass_properties(at + t).mass_kg - layout.fairing.mass_kg
        assert without.mass_properties(t).mass_kg == pytest.approx(there, rel=1e-6)
    dropped = next(p for p in built.flight.points if p.number == 2)
    assert dropped.altitude_m == pytest.approx(layout.fairing.jettison_altitude_m, abs=2e3)


def test_without_an_orbit_the_path_angle_is_met(layout: Layout) -> None:
    wanted = layout.trajectory.model_copy(update={"orbit_altitude_m": None, "final_path_angle_deg": 12.0})
    every = stacks(layout)
    given = layout.model_copy(update={"trajectory": wanted})
    found = ascent(given, every, [aerodynamics(stack) for stack in every], points=21)
    assert math.degrees(found.points[-1].path_rad) == pytest.approx(12.0, abs=0.01)


def test_orbit_has_the_heights_of_the_textbook() -> None:
    """A Hohmann transfer ellipse and a circle follow from their vis-viva speeds."""
    low, high = WGS84_RADIUS_m + 250e3, WGS84_RADIUS_m + 900e3
    at_perigee = math.sqrt(WGS84_MU_m3ps2 * (2.0 / low - 2.0 / (low + high)))
    assert Orbit.of(low, at_perigee, 0.0) == pytest.approx((250e3, 900e3), abs=1.0)
    at_apogee = at_perigee * low / high
    assert Orbit.of(high, at_apogee, 0.0) == pytest.approx((250e3, 900e3), abs=1.0)
    assert Orbit.of(low, math.sqrt(WGS84_MU_m3ps2 / low), 0.0) == pytest.approx((250e3, 250e3), abs=10.0)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"stage.0.shell.1.front_station_m": 8.8}, "leaves a gap or overlaps"),
        ({"stage.1.rear_station_m": 7.9}, "the next stage ends at 7.9 m: a gap"),
        ({"stage.0.shell.0.EI_Nm2": 1e7}, "no stiffness, or two"),
        ({"stage.0.engine.thrust_vacuum_N": 9000.0}, "pushes .* and weighs"),
        pytest.param(
            {"stage.1.part.0.mass_kg": 400.0}, "short of the 775. m/s .inertial. of an orbit", marks=pytest.mark.long
        ),
    ],
)
def test_a_wrong_layout_is_answered_in_one_line(
    change: dict[str, float], says: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    key, value = next(iter(change.items()))
    wrong = tmp_path / "wrong.toml"
    wrong.write_text(f'extends = "{_petrel().as_posix()}"\n')
    with pytest.raises((ScenarioError, ValueError), match=says):
        _built_with(wrong, f"{key}={value}")
    assert simvehicle.main([str(tmp_path / "none.toml")]) == 2
    assert capsys.readouterr().err.count("\n") == 1


def test_the_gimbals_of_a_cluster_hold_its_roll() -> None:
    """The moments of the engines, lateral force times arm, give roll 0.4 Hz and a damping ratio of 0.7."""
    loaded = load_scenario(petrel.folder() / "scenario.toml")
    scenario, stage = loaded.scenario, loaded.vehicle.stage[0]
    assert [e.group for e in stage.engines].count("left") == [e.offset_m[0] < -0.1 for e in stage.engines].count(True)
    packed = pack_flight(scenario)
    allocation, gains = packed.parameters[0].computer.allocation, scenario.design.roll_gimbal
    row = find_interval(packed.pool, allocation.matrix, 10.0)
    table = [interpolate(packed.pool, allocation.matrix, row, 10.0, 3 * k + 2) for k in range(6)]  # A's column of roll
    angles = {name: (table[2 * n], table[2 * n + 1]) for n, name in enumerate(stage.engine_groups)}
    roll_Nm = 0.0
    for engine in stage.engines:  # +TVC angles: +z force in pitch, -y in yaw
        (y, z), (pitch_rad, yaw_rad) = engine.offset_m, angles[engine.group]
        across = np.array([0.0, -yaw_rad, pitch_rad]) * float(engine.table["thrust_vacuum_N"].max())
        roll_Nm += float(np.cross([0.0, y, z], across)[0])
    inertia = float(stage.mass.table["Ixx_kgm2"][0])
    omega = math.sqrt(gains.k_p * roll_Nm / inertia)
    assert omega / (2.0 * math.pi) == pytest.approx(0.4, rel=1e-3)
    assert gains.k_d_s * roll_Nm / inertia / (2.0 * omega) == pytest.approx(0.7, rel=1e-3)
    assert scenario.design.roll_gimbal == scenario.design.of_stage(0).roll_gimbal
    one = LayoutEngines(
        positions_m=((0.0, 0.3), (0.0, -0.3)),
        thrust_vacuum_N=1e4,
        isp_vacuum_s=300.0,
        gimbal_station_m=9.0,
        exit_station_m=9.5,
        mass_kg=20.0,
    )
    assert one.groups == ("lower", "upper")


def test_the_campaign_of_a_layout_flies_every_stage_in_wind() -> None:
    campaign = maxq.load(petrel.folder() / "campaign.toml")
    stages = [
        {t.key.split(".")[2] for t in d.targets if t.key.startswith("vehicle.stage")} for d in campaign.plan.draws
    ]
    assert [s for s in stages if not s] == [set()] * 3  # speed and direction of the wind, and the delay
    assert all(s in ({"0"}, {"1", "2"}) for s in stages if s)  # the parts of a stage deviate together
    flown = [campaign.scenario_of(run).scenario for run in range(2)]
    winds = [(float(s.wind.profile["speed_mps"].max()), s.wind.turn_deg) for s in flown if s.wind.profile is not None]
    assert len(set(winds)) == 2
    assert all(0.0 < speed < 40.0 for speed, _ in winds)
    upper = [stage.engines[0].mass_flow_factor for stage in flown[0].vehicle.stage[1:]]
    assert upper[0] == upper[1] != 1.0


def test_a_case_from_a_layout_asks_for_what_its_suite_asks() -> None:
    """A case from a layout demands more than its suite, which does not reject a design that meets the case."""
    suite = read_suite(petrel.folder() / "suite.toml").suite
    asked = suite.margins.nominal
    assert suite.margins.trajectories > 0
    limits = read_case(petrel.folder() / "case.toml").case.limits
    assert limits.gain_margin_db > asked.gain_up_db == asked.gain_down_db
    assert limits.phase_margin_deg > asked.rigid_phase_deg
    assert limits.first_mode_phase_deg > asked.first_mode_phase_deg
    assert max(limits.second_mode_db, limits.modes_from_3_db) < asked.modes_from_2_db
    assert not limits.without
    # where the air is dense, a frequency that leaves the gain margin downwards, by the flown vehicle's M_alpha
    assert isinstance(limits.rigid_hz, OverTime)
    dense, low, high = 54.7, 6.0, 140.0
    (node,) = petrelkit.nodes(dense)
    m_alpha = node.derivatives.m_alpha_1ps2
    needed = math.sqrt((10.0 ** (asked.gain_down_db / 20.0) - 1.0) * m_alpha) / (2.0 * math.pi)
    assert at_time(limits.rigid_hz, [low, high]).tolist() == [0.32, 0.32]
    assert at_time(limits.rigid_hz, dense) == pytest.approx(needed, rel=0.03)
    assert needed > 0.322


@pytest.mark.slow
@known_path()
def test_rigid_limits_follow_actuator_and_mode_1(layout: Layout) -> None:
    """The limit is at most an eighth of both frequencies for each stage; a layout may set one value for all stages."""
    engine = layout.stage[0].engine.model_copy(update={"servo_hz": (2.0,)})
    slow = build(changed(layout, 0, engine=engine))
    assert {slow.rigid_hz(p) for p in slow.flight.points if p.number == 0} == {0.25}
    assert {slow.rigid_hz(p) for p in slow.flight.points if p.number > 0} == {0.4}
    times_s, hz = least_rigid_hz(slow, 0.0)  # no margin: of the first gains alone
    assert hz == [0.2, 0.2, 0.32, 0.32]
    assert times_s == sorted(times_s)
    shells = tuple(s.model_copy(update={"wall_m": 0.05 * s.wall_m}) for s in layout.stage[0].shell)
    soft = build(changed(layout, 0, shell=shells))
    times, modes = soft.modes[0]
    p = burning(soft)[30]
    wanted = np.interp(p.clock_s, times, [m[0].frequency_hz for m in modes]) / 8.0
    assert soft.rigid_hz(p) == pytest.approx(wanted, rel=1e-12)
    assert wanted < 0.4
    control = layout.control.model_copy(update={"rigid_hz": 0.3})
    named = build(layout.model_copy(update={"control": control}))
    assert {named.rigid_hz(p) for p in named.flight.points} == {0.3}


def _petrel() -> Path:
    from maxq.sim.input.files import builtin_files  # noqa: PLC0415  # only here

    return builtin_files("layout")["petrel"]


def _built_with(path: Path, override: str):
    from maxq.sim.scenario.loader import load_file  # noqa: PLC0415  # only here

    return build(load_file(Layout, "layout", path, [override])[0])


@pytest.mark.long
@known_path()
def test_the_vehicle_flies_the_point_mass_s_path_to_orbit(tmp_path: Path, built) -> None:
    """In six degrees of freedom, each burnout altitude is within 2 % of the point mass, and the perigee is 250 km."""
    assert simvehicle.main(["petrel", "--out", str(tmp_path)]) == 0
    flight = fly(load_scenario(tmp_path / "scenario.toml"))
    assert not flight.failures
    assert all(v.met for v in flight.verdicts)
    for n, stack in enumerate(built.stacks):
        at = built.flight.begins_s[n] + stack.burn.end_s
        point = [p for p in built.flight.points if p.number == n][-1]
        k = int(np.argmin(np.abs(flight.time_s("altitude_m") - at)))
        assert flight["altitude_m"][k] == pytest.approx(point.altitude_m, rel=0.02)
    r, v = flight.state[R_I : R_I + 3], flight.state[V_I : V_I + 3]
    momentum, mu = np.cross(r, v), 3.986004418e14
    e = np.linalg.norm(np.cross(v, momentum) / mu - r / np.linalg.norm(r))
    perigee_km = (momentum @ momentum / mu / (1.0 + e) - 6378137.0) / 1e3
    assert perigee_km == pytest.approx(250.0, abs=15.0)


@pytest.mark.parametrize("rows", [2, 3, 5, 40])
def test_a_line_has_the_bits_of_numpy(rows):
    """Between rows, at them, at steps (rows of one time), outside, and for a number that is none."""
    rng = np.random.default_rng(rows)
    x, y = np.sort(rng.uniform(-3.0, 90.0, rows)), rng.normal(0.0, 1e5, rows)
    x[1::7] = x[::7][: len(x[1::7])]
    at = [*rng.uniform(-20.0, 110.0, 500), *x, math.inf, -math.inf, math.nan]
    line = LinearCurve(x, y)
    found = [line(value) for value in at]
    assert {type(value) for value in found} == {float}
    assert np.array_equal(found, [np.interp(value, x, y) for value in at], equal_nan=True)


def test_the_pitch_over_of_an_ascent_is_rounded_and_the_tangents_follow():
    """After the pitch-over is rounded, the tangents are solved for again, so that the end stays level.

    In this test the end is level where the tangents are twice the pitch-over and minus its square.
    """

    def ends(x):
        return np.array([x[1] - 2.0 * x[0], x[2] + x[0] ** 2, 7.8])

    for kick in (0.58266, 0.58233):  # as far apart as processors leave it
        found = level_ascent(ends, np.array([kick, 1.0, -0.3]))
        np.testing.assert_allclose(found, [0.5825, 1.165, -(0.5825**2)], rtol=1e-12)
