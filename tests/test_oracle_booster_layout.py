"""A layout with boosters agrees with sums by hand, closed forms and the files that simvehicle writes for it."""

from __future__ import annotations

import math
import tomllib
from pathlib import Path

import numpy as np
import pytest

import maxq
from maxq import FlightRun, ScenarioError
from maxq.control.kernel.tables import table_in
from maxq.design import operating_points
from maxq.design.case.schema import read_case
from maxq.sim.packing.flight import pack_flight
from maxq.sim.run.evaluate import evaluate_at
from maxq.sim.scenario.loader import load_scenario
from maxq.sim.vehicle import schedule as columns
from maxq.sim.vehicle.loads.columns import AXIAL
from maxq.sim.vehicle.loads.section import SectionStations
from maxq.tools.vehicle.beam import ELEMENTS, Beam, RigidLoad
from maxq.tools.vehicle.build import Built, build, burning, m_delta_1ps2
from maxq.tools.vehicle.figures import stage_bodies
from maxq.tools.vehicle.files import write
from maxq.tools.vehicle.layout import LayoutNozzles, read_layout
from maxq.tools.vehicle.masses import Rod
from maxq.tools.vehicle.report import tables

HERON = Path(__file__).parent.parent / "scenarios" / "layouts" / "heron.toml"


@pytest.fixture(scope="module")
def built() -> Built:
    """Return the shipped layout with section loads of its core on a gravity turn, without search for an orbit."""
    layout = read_layout(HERON)
    core = layout.stage[0].model_copy(update={"loads": SectionStations(stations_m=(16.0, 20.0, 30.0, 35.0))})
    layout = layout.model_copy(update={"stage": (core, *layout.stage[1:])})
    turn = layout.trajectory.model_copy(update={"orbit_altitude_m": None, "final_path_angle_deg": 15.0})
    return build(layout.model_copy(update={"trajectory": turn}))


@pytest.mark.parametrize("attachments", [(6.0,), (3.0, 9.0)])
def test_modes_of_a_beam_with_boosters_are_free_and_orthogonal(attachments: tuple[float, ...]) -> None:
    """Each mode has neither momentum nor angular momentum, boosters included; energies give its frequency."""
    length, stiffness = 12.0, 3e7
    beam = Beam(np.linspace(0.0, length, ELEMENTS + 1), np.full(ELEMENTS, stiffness))
    booster = RigidLoad(attachments, [Rod(90.0, 4.0, 11.0, 0.0, 0.0)])
    modes = beam.modes([Rod(480.0, 0.0, length, 0.0, 0.0)], 3, [booster, booster])
    x, y = beam.nodes_m, np.linspace(4.0, 11.0, 2001)
    fine = np.linspace(0.0, length, 24001)

    def on_beam(k: int) -> np.ndarray:
        return np.interp(fine, x, modes[k].phi)

    def on_booster(k: int) -> np.ndarray:
        phi = np.interp(attachments, x, modes[k].phi)
        slope = np.interp(attachments[0], x, modes[k].slope_pm)
        if len(attachments) == 2:
            slope = (phi[1] - phi[0]) / (attachments[1] - attachments[0])
        return np.asarray(phi[0] + slope * (y - attachments[0]))

    def product(a: tuple[np.ndarray, np.ndarray], b: tuple[np.ndarray, np.ndarray]) -> float:
        return float(40.0 * np.trapezoid(a[0] * b[0], fine) + 180.0 / 7.0 * np.trapezoid(a[1] * b[1], y))

    shapes = [(on_beam(k), on_booster(k)) for k in range(3)]
    for k, mode in enumerate(modes):
        for rigid in ((np.ones_like(fine), np.ones_like(y)), (fine, y)):
            assert abs(product(shapes[k], rigid)) < 1e-3 * 480.0
        assert product(shapes[k], shapes[k]) == pytest.approx(mode.generalized_mass_kg, rel=1e-3)
        curvature = np.gradient(mode.slope_pm, x)
        if len(attachments) == 2:
            energy = stiffness * float(np.trapezoid(curvature**2, x))
            omega = math.sqrt(energy / mode.generalized_mass_kg)
            assert omega == pytest.approx(2.0 * math.pi * mode.frequency_hz, rel=2e-2)
        for j in range(k):
            assert abs(product(shapes[k], shapes[j])) < 1e-3 * mode.generalized_mass_kg


def test_boosters_are_drawn_to_scale() -> None:
    """The hull, grain and nozzle of each booster lie where the layout places them, on both sides of the core."""
    core = read_layout(HERON).stage[0]
    with_them, alone = (
        stage_bodies(core, 0.0, "ogive"),
        stage_bodies(core.model_copy(update={"booster": ()}), 0.0, "ogive"),
    )
    count = len(with_them) - len(alone)
    assert count == 6
    for k, axis_m in ((0, -2.05), (3, 2.05)):
        nozzle, hull, grain = ((np.asarray(s["x"]), np.asarray(s["y"])) for s in with_them[k : k + 3])
        assert (hull[0].min(), hull[0].max()) == (19.0, 36.0)
        assert (hull[1].min(), hull[1].max()) == pytest.approx((axis_m - 0.7, axis_m + 0.7))
        assert hull[1][hull[0] == 19.0] == pytest.approx([axis_m, axis_m])
        assert float(hull[0][np.abs(hull[1] - axis_m) > 0.699].min()) == pytest.approx(19.0 + 2.0 * 1.4, abs=0.2)
        assert (grain[0].min(), grain[0].max(), grain[1].max()) == pytest.approx((22.0, 35.0, axis_m + 0.68))
        exit_m = math.sqrt(0.85 / math.pi)
        assert (nozzle[0].max(), nozzle[1].min(), nozzle[1].max()) == pytest.approx(
            (37.5, axis_m - exit_m, axis_m + exit_m)
        )


@pytest.mark.slow
def test_masses_at_liftoff_are_sums_of_the_layout(built: Built) -> None:
    """Dry parts, propellants and engines by hand; the pair adds m y^2 to the roll inertia and nothing to pitch."""
    booster = 1500.0 + 250.0 + 250.0 + 500.0 + 22000.0
    core = 350.0 + 1350.0 + 300.0 + 900.0 + 1100.0 + 1400.0 + 47000.0 + 19500.0
    upper = 3800.0 + 120.0 + 250.0 + 950.0 + 11500.0 + 4700.0 + 220.0
    first, second = built.stacks[:2]
    both, alone = first.mass_properties(0.0), first.core_properties(0.0)
    assert alone.mass_kg == pytest.approx(core + upper + 450.0, rel=1e-12)
    assert both.mass_kg == pytest.approx(alone.mass_kg + 2.0 * booster, rel=1e-12)
    assert ["fixed nozzles" in line for line in built.assumed if line.startswith("core with solid: ")] == [True]
    one = first.boosters[0].mass_properties(0.0)
    assert both.roll_kgm2 - alone.roll_kgm2 == pytest.approx(2.0 * (one.roll_kgm2 + booster * 2.05**2), rel=1e-12)
    assert first.leave_s == second.begins_s == pytest.approx(first.boosters[0].burn.end_s + 3.0)
    dropped = first.mass_properties(first.end_s).mass_kg - second.mass_properties(second.begins_s).mass_kg
    assert dropped == pytest.approx(2.0 * (booster - 22000.0), rel=1e-9)


@pytest.mark.slow
def test_the_table_of_stages_counts_the_boosters(built: Built) -> None:
    """Each propellant gives its exhaust speed times its mass as impulse; the parts of the burn of the core meet."""
    both, core = built.stacks[:2]
    kg = [[stack.mass_properties(t).mass_kg for t in (stack.begins_s, stack.end_s)] for stack in (both, core)]
    of_core = [kg[0][0] - kg[0][1] - 2 * 22000.0, kg[1][0] - kg[1][1]]
    assert sum(of_core) == pytest.approx(47000.0 + 19500.0 - 500.0, rel=1e-9)
    impulses = 335.0 * of_core[0] + 270.0 * 2 * 22000.0, 335.0 * of_core[1]
    for stack, wanted in zip((both, core), impulses, strict=True):
        assert stack.impulse_Ns == pytest.approx(wanted * 9.80665, rel=1e-4)
    rows = tables(built)[0].rows
    (burn_s, both_weight, both_mps), (rest_s, core_weight, core_mps) = (
        [float(x) for x in row[3:6]] for row in rows[1:3]
    )
    assert burn_s + rest_s == pytest.approx(core.end_s, abs=0.1)
    assert burn_s == pytest.approx(both.end_s, abs=0.05)
    assert both_weight == pytest.approx(
        (950e3 + 2 * 830e3) / kg[0][0] / 9.80665, abs=0.015
    )  # thrust falls from its start
    assert core_weight == pytest.approx(950e3 / kg[1][0] / 9.80665, abs=0.006)
    assert core_mps == pytest.approx(335.0 * 9.80665 * math.log(kg[1][0] / kg[1][1]), abs=1.0)
    speed_mps = impulses[0] * 9.80665 / (kg[0][0] - kg[0][1])
    assert both_mps == pytest.approx(speed_mps * math.log(kg[0][0] / kg[0][1]), abs=1.0)


def test_files_fly_the_masses_and_thrusts_of_the_layout(built: Built, tmp_path: Path) -> None:
    """Mass, CG, inertia and thrust of the packed flight equal those of the layout, on both sides of the separation."""
    write(built, tmp_path)
    scenario = load_scenario(tmp_path / "scenario.toml").scenario
    stages = scenario.vehicle.stage
    assert [(s.name, s.continues, s.clock, len(s.booster)) for s in stages[:3]] == [
        ("core with solid", False, "own", 2),
        ("core", True, "preceding", 0),
        ("second", False, "own", 0),
    ]
    packed = pack_flight(scenario)
    assert packed.parameters[0].timeline.separation_ns == pytest.approx(1e9 * (built.stacks[0].leave_s or 0.0), abs=1e4)
    for n, times in ((0, (0.0, 20.0, 60.0)), (1, (100.0, 200.0))):
        table = table_in(packed.pool, packed.parameters[n].vehicle.schedule)
        sizes, stack = packed.parameters[n].vehicle.sizes, built.stacks[n]
        for t in times:
            row, wanted = table(t), stack.mass_properties(t)
            bobs = [row[int(columns.tank_column(k)) :][:3] for k in range(int(sizes.pendulums))]
            mass = row[columns.CORE_MASS] + sum(bob[0] for bob in bobs)
            cg = (row[columns.CORE_MASS] * row[columns.CORE_CG] + sum(m * (a + b) for m, a, b in bobs)) / mass
            assert mass == pytest.approx(wanted.mass_kg, rel=1e-6)
            assert row[columns.TOTAL_MASS] == pytest.approx(wanted.mass_kg, rel=1e-6)
            assert cg == pytest.approx(wanted.x_cg_m, abs=1e-3)
            lateral = row[columns.CORE_INERTIA + 1] + row[columns.CORE_MASS] * (row[columns.CORE_CG] - cg) ** 2
            lateral += sum(m * (a + b - cg) ** 2 for m, a, b in bobs)
            assert lateral == pytest.approx(wanted.pitch_kgm2, rel=1e-4)
            engine = packed.parameters[n].vehicle.engine
            thrust = sum(
                engine.thrust_factor[k] * row[int(columns.thrust_column(sizes, int(engine.curve[k])))]
                for k in range(int(sizes.engines))
            )
            assert thrust == pytest.approx(stack.thrusts_N(t, 0.0)[0], rel=1e-3, abs=1.0)


@pytest.mark.slow
def test_boosters_push_the_core_at_their_aft_attachment(built: Built, tmp_path: Path) -> None:
    """Axial force in vacuum at 20 s: forward of 33 m the core hangs on the boosters too, behind it on its engine only.

    The masses along the core, with boosters and without, agree with those of the stages, or loading would fail.
    """
    write(built, tmp_path)
    changes = ["switches.section_loads=true", "atmosphere.model=vacuum", "run.stop_at=[]"]
    run = FlightRun(load_scenario(tmp_path / "scenario.toml", changes), log=False)
    run.fly_segment(20_000_000_000)
    now, first = evaluate_at(run.packed, run.packed.state, 20.0), built.stacks[0]
    accel, core = now.aux.specific_force_B_mps2[0], first.core_properties(20.0).mass_kg
    behind_35 = 0.5 * 1100.0 + 1400.0
    behind_30 = 900.0 * 4.0 / 6.5 + 1100.0 + 1400.0 + first.liquids(20.0)[1].mass_kg  # kerosene rests on 33.7 m
    assert now.sections[3, AXIAL] == pytest.approx(behind_35 * accel - 950e3, rel=1e-3)
    assert now.sections[2, AXIAL] == pytest.approx(-(core - behind_30) * accel, rel=1e-3)
    assert now.sections[2, AXIAL] < 1.4 * now.sections[3, AXIAL] < 0.0


@pytest.mark.slow
def test_first_gains_are_below_bending_and_slosh(built: Built, tmp_path: Path) -> None:
    """The rigid body has an eighth of the core's mode 1 at liftoff, and half the slosh frequency above the core.

    Deep liquid sloshes at sqrt(1.8412 a / R); the domes lower this by a few percent. The poles of the second stage's
    filter are at 0.15 of mode 1.
    """
    first = burning(built, 0)[0]
    assert built.rigid_hz(first) == pytest.approx(built.modes[0][1][0][0].frequency_hz / 8.0, rel=1e-2)
    upper = [n for n, stack in enumerate(built.stacks) if stack.number == 1]
    for n in upper:
        p = burning(built, n)[0]
        load_mps2 = p.thrust_N / built.stacks[n].mass_properties(p.clock_s).mass_kg
        deep_hz = math.sqrt(1.8412 * load_mps2 / 1.25) / (2.0 * math.pi)
        assert 0.96 < 2.0 * built.rigid_hz(p) / deep_hz < 1.0
    write(built, tmp_path)
    design = load_scenario(tmp_path / "scenario.toml").design
    assert design is not None
    (section,) = design.of_stage(upper[0]).filter.quadratic
    assert section.zero_hz == pytest.approx(np.mean([m[0].frequency_hz for m in built.modes[upper[0]][1]]))
    assert section.pole_hz == pytest.approx(0.15 * section.zero_hz)
    assert [s.pole_hz / s.zero_hz for s in design.of_stage(0).filter.quadratic] == pytest.approx([0.8, 0.8])


@pytest.mark.long
def test_gimballed_boosters_steer_with_the_core(tmp_path: Path) -> None:
    """The angular acceleration per command is that of the flown vehicle at 20 s; each group has its own actuator."""
    layout = read_layout(HERON)
    (booster,) = layout.stage[0].booster
    given = booster.engine.model_dump(exclude_unset=True) | {"gimbal": "both", "angle_limit_deg": 5.0}
    moving = booster.model_copy(update={"engine": LayoutNozzles(**given)})
    core = layout.stage[0].model_copy(update={"booster": (moving,)})
    turn = layout.trajectory.model_copy(update={"orbit_altitude_m": None, "final_path_angle_deg": 15.0})
    built = build(layout.model_copy(update={"stage": (core, *layout.stage[1:]), "trajectory": turn}))
    assert ["fixed nozzles" in line for line in built.assumed if line.startswith("core with solid: ")] == [False]
    write(built, tmp_path)
    loaded = load_scenario(tmp_path / "scenario.toml")
    both, alone = loaded.vehicle.stage[:2]
    assert both.engine_groups == ("", "solid1", "solid2")
    assert [a.angle_limit_deg for a in both.actuators] == [8.0, 5.0, 5.0]
    assert [a.angle_limit_deg for a in alone.actuators] == [8.0]
    (node,) = operating_points.nodes(loaded, [20.0])
    k = int(np.argmin([abs(p.time_s - 20.0) for p in built.flight.points]))
    point = built.flight.points[k]
    assert m_delta_1ps2(built, point) == pytest.approx(abs(node.derivatives.m_delta_1ps2), rel=0.03)
    first = built.stacks[0]
    thrusts = first.thrusts_N(20.0, 0.0)
    cg_m = first.mass_properties(20.0).x_cg_m
    assert thrusts[1] == pytest.approx(950e3 + (thrusts[0] - 950e3) * (35.5 - cg_m) / (36.0 - cg_m), rel=1e-9)
    text = tomllib.loads((tmp_path / "campaign.toml").read_text(encoding="utf-8"))
    assert maxq.load(tmp_path / "campaign.toml").campaign.runs == 100
    keys = {key for deviation in text["disperse"] for key in deviation.get("keys", ())}
    assert {f"vehicle.stage.0.actuator.{k}.omega_hz.0" for k in (0, 1, 2)} <= keys
    assert "vehicle.stage.1.actuator.0.omega_hz.0" in keys


@pytest.mark.parametrize(
    ("before", "line", "says"),
    [
        ("tail_off_s = 4.0", "angle_limit_deg = 5.0", r"angle_limit_deg = 5\.0: has no meaning here"),
        (
            "modes = 4",
            "loads.stations_m = [20.0, 36.5]",
            r"heron\.toml: stage\.0\.loads\.stations_m\.1 = 36\.5: is behind the gimbal.*at most 36$",
        ),
        (
            "modes = 4",
            "loads.stations_m = [20.0, 20.0]",
            r"heron\.toml: stage\.0\.loads\.stations_m.*increase strictly",
        ),
    ],
)
def test_a_wrong_key_is_refused_in_the_layout(before: str, line: str, says: str, tmp_path: Path) -> None:
    text = HERON.read_text(encoding="utf-8").replace(before, f"{before}\n{line}")
    (tmp_path / "heron.toml").write_text(text, encoding="utf-8")
    with pytest.raises(ScenarioError, match=says):
        read_layout(tmp_path / "heron.toml")


def test_the_case_is_robust_in_the_stage_that_asks_for_it_and_filters_noise_above(built: Built, tmp_path: Path) -> None:
    """Both parts of the core meet limits for its deviated vehicles; the low passes of the second are below 2.3 Hz."""
    write(built, tmp_path)
    loaded = read_case(tmp_path / "case.toml")
    cases = [loaded.case.of_stage(n, (1.0,)) for n in range(4)]
    campaign = str(tmp_path / "campaign.toml")
    assert [case.robust and case.robust.campaign for case in cases] == [campaign, campaign, None, None]
    assert [case.limits.filter_gain_at_infinity for case in cases] == [1.0, 1.0, 0.1, 0.1]
    highest_hz = [12.0 * max(built.rigid_hz(p) for p in burning(built, n)) for n in (2, 3)]
    assert [case.filter.bounds.pole_hz[1] for case in cases[2:]] == pytest.approx(highest_hz, abs=0.005)
    assert [case.limits.gain_margin_db for case in cases] == [6.5] * 4
