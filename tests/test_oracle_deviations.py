"""Vehicle N of a margin sweep is run N of its campaign, with the same numbers and the same packed vehicle.

The reference is the campaign's method: the scenario of the run is rebuilt, checked and packed, and the packed stage is
held at the clock of the operating point.
"""

from __future__ import annotations

import dataclasses
import re
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import petrelkit
import pytest
from scipy import stats

import maxq
from maxq import LoadedCampaign, Loop, Node, ScenarioError, margins
from maxq.control.kernel.records import Array
from maxq.design.case.schema import read_case
from maxq.design.laws.pd import Pd
from maxq.design.loop.fixed_path import fixed_path
from maxq.design.loop.loop import law_at
from maxq.design.margins.dispersed import ManyLoops
from maxq.design.margins.many import DONE, HANDED_BACK
from maxq.design.model.deviations import UNREAD as UNREAD_KEYS
from maxq.design.model.deviations import acting_at, deviations_of
from maxq.design.model.dispersion import Dispersion, deviated, stacked
from maxq.design.model.held import hold_stage
from maxq.design.model.instruments import instruments_of
from maxq.design.model.node import disperse
from maxq.design.model.spread import Spread, campaign_of
from maxq.design.optimise.robust import deviated as plant_at
from maxq.design.optimise.robust import modes_off, ranges_of
from maxq.design.verify.flown import load_wanted
from maxq.design.verify.linear import vehicles
from maxq.design.verify.memory import PartsOnDisk
from maxq.design.verify.parts import Parts
from maxq.design.verify.suite import LinearMargins, read_suite
from maxq.sim.packing.flight import pack_flight
from maxq.sim.scenario.loader import load_scenario
from maxq.sim.vehicle import schedule

RUNS = 21
CAMPAIGNS = ("campaigns/first", "campaigns/ksr3", "campaigns/ksr3-ringed", "campaigns/ksr3-months")
AT_A_ROW_S, BETWEEN_ROWS_S = 35.0, 45.3
DELAY, DAMPING = "vehicle.computer.delay_s", "vehicle.stage.0.bending.damping_ratio.0"
UNREAD = ("environment", "computer", "timeline", "actuator_pitch", "actuator_yaw", "further_actuators", "offset")
"""Parts of a record that the linear model does not read at a node, and where the pool holds its tables."""


@cache
def loaded(name: str) -> LoadedCampaign:
    return maxq.load(name)


@cache
def node_of_campaign(name: str, time_s: float, plane: Any = "pitch") -> Node:
    return maxq.nodes(loaded(name).base, [time_s], plane=plane)[0]


def packed_as_flown(campaign: LoadedCampaign, run: int, node: Node) -> tuple:
    """Return the stage of an operating point in the scenario of a run, packed as the campaign packs it."""
    packed = pack_flight(campaign.scenario_of(run).scenario)
    held = hold_stage(packed, float(node.held.parameters[0].timeline.frozen_s), node.stage)
    there = dataclasses.replace(held, swing_rad=node.held.swing_rad)
    return there, instruments_of(packed.parameters[node.stage], node.plane)


def differing(a: Any, b: Any, path: str = "") -> list[str]:
    """Return the fields in which two records differ by more than rounding."""
    if a.dtype.names is None:
        return [] if np.allclose(a, b, rtol=1e-12, atol=0.0, equal_nan=True) else [path]
    names = (name for name in a.dtype.names if name not in UNREAD)
    return [field for name in names for field in differing(a[name], b[name], f"{path}.{name}")]


@pytest.mark.slow
@pytest.mark.parametrize("name", CAMPAIGNS)
def test_a_drawn_record_is_that_of_the_packed_scenario(name: str) -> None:
    """Parameters and instruments of runs 0 to 20 agree to rounding, as do properties at the rows of the tables.

    Between rows, packing interpolates the cores of the rows, while the sweep subtracts the bobs from the interpolated
    total. The difference is 1e-7 of mass, CG and inertia (1e-4 of the millimetres by which the CG is off the axis).
    Rates of the core, which only jet damping reads, are differences: 1e-4 of those along the axis.
    """
    campaign = loaded(name)
    for time_s, core in ((AT_A_ROW_S, 1e-12), (BETWEEN_ROWS_S, 2e-7)):
        node = node_of_campaign(name, time_s)
        deviations = deviations_of(campaign, node)
        assert deviations.left_out == ()
        every = deviations.drawn(range(RUNS))
        found = deviated(node.held, node.plane, stacked(every), RUNS)
        for run in range(RUNS):
            held, instruments = packed_as_flown(campaign, run, node)
            assert differing(held.parameters, found.parameters[run : run + 1]) == []
            theirs, ours = held.properties[0], found.properties[run]
            rates = [*range(schedule.CG_RATE, schedule.TOTAL_MASS)]
            rates += [schedule.tank_column(k) + schedule.TANK_TRAVEL for k in range(len(held.swing_rad))]
            along = np.isin(np.arange(len(ours)), [schedule.CG_RATE, *range(13, 16), *rates[9:]])
            off_axis = np.isin(np.arange(len(ours)), [2, 3, 7, 8, 9])  # of the core's CG and products of inertia
            rest = ~np.isin(np.arange(len(ours)), rates) & ~off_axis
            np.testing.assert_allclose(ours[rest], theirs[rest], rtol=core)
            np.testing.assert_allclose(ours[off_axis], theirs[off_axis], rtol=500.0 * core, atol=1e-12)
            np.testing.assert_allclose(ours[along], theirs[along], rtol=1e-4)
            moved = disperse(node, every[run]).instruments
            assert moved.delay_s == pytest.approx(instruments.delay_s, rel=1e-12)
            for a, b in zip(moved.actuators, instruments.actuators, strict=True):
                assert dataclasses.astuple(a)[:8] == pytest.approx(dataclasses.astuple(b)[:8], rel=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("plane", ["pitch", "yaw"])
def test_the_loop_of_a_vehicle_is_that_of_its_run(plane: Any) -> None:
    """From 0.05 Hz to 45 Hz the loops agree to 1e-4 dB, as does the least distance from -1 in a sweep of many."""
    campaign, design = loaded("campaigns/ksr3"), maxq.load_design("designs/ksr3-robust")
    node = node_of_campaign("campaigns/ksr3", BETWEEN_ROWS_S, plane)
    every, hz = deviations_of(campaign, node).drawn(range(8)), np.geomspace(0.05, 45.0, 200)
    law = law_at(design, node)
    values, status = ManyLoops(node, law).measure(every, -6.0, distances=True)
    for run, by in enumerate(every):
        held, instruments = packed_as_flown(campaign, run, node)
        flown = Loop(fixed_path(dataclasses.replace(node, held=held, instruments=instruments)), law)
        here = Loop(fixed_path(disperse(node, by)), law)
        apart_db = 20.0 * np.log10(np.abs(flown.response(hz) / here.response(hz)))
        assert np.abs(apart_db).max() < 1e-4
        assert status[run] == DONE
        assert values["distance"][run, 0] == pytest.approx(margins(flown).modulus, abs=1e-5)


def test_draws_are_the_campaigns_own_numbers() -> None:
    """All of 2,000 vehicles agree, also alone; the delay is uniform and the damping triangular, as in flight."""
    campaign, node = loaded("campaigns/ksr3"), node_of_campaign("campaigns/ksr3", AT_A_ROW_S)
    drawn, every = campaign.plan.draw(0, 2000).draws, deviations_of(campaign, node).drawn(range(2000))
    delay_s = np.array([by.delay_s for by in every]) + node.instruments.delay_s
    np.testing.assert_allclose(delay_s, np.rint(1e9 * drawn[DELAY]) / 1e9, rtol=0.0, atol=1e-15)
    assert 1e3 * delay_s.std() == pytest.approx(1.44, abs=0.03)  # 5 ms over the root of twelve; known to 1.6 %
    assert stats.kstest(delay_s, stats.uniform(0.0, 0.005).cdf).pvalue > 0.01
    damping = 0.005 * np.array([by.bending_damping for by in every])
    np.testing.assert_allclose(damping[:, 0], drawn[DAMPING], rtol=1e-12)
    triangle = stats.triang(1.0 / 3.0, 0.0025, 0.0075)
    assert min(stats.kstest(damping[:, k], triangle.cdf).pvalue for k in range(3)) > 0.01
    waves = np.log([by.slosh_damping_ratio for by in every])
    assert waves.std(axis=0) == pytest.approx([np.log(2.0) / 3.0] * 2, rel=0.05)
    shapes = np.array([by.bending_shape for by in every])
    assert shapes.std(axis=0) == pytest.approx([0.2 / 3.0] * 3, rel=0.05)
    alone = vehicles(LinearMargins(cases=5, only="vehicle 417", corner_sigmas=0.0), node, campaign)[1]
    assert alone == [every[417]]
    assert campaign.scenario_of(417).scenario.vehicle.computer.delay_s == pytest.approx(delay_s[417], abs=1e-12)  # type: ignore[union-attr]  # this vehicle has one


def test_another_seed_and_sampling_are_followed() -> None:
    node = node_of_campaign("campaigns/ksr3", AT_A_ROW_S)
    for changes in ({"seed": 5}, {"sampling": "latin-hypercube", "stratum": 50}, {"sampling": "sobol"}):
        campaign = loaded("campaigns/ksr3").with_campaign(**changes)
        every = deviations_of(campaign, node).drawn(range(7, 11))
        wanted = [campaign.inputs(run).recorded[DELAY] for run in range(7, 11)]
        found = [by.delay_s + node.instruments.delay_s for by in every]
        assert found == pytest.approx(wanted, abs=1e-12)
        assert [by.label for by in every] == [f"vehicle {run}" for run in range(7, 11)]


def by_name(deviations, name: str, sigmas: float) -> Dispersion:
    """Return the vehicle with a single deviation."""
    u = np.zeros(len(deviations.places))
    u[deviations.places.index(name)] = sigmas / 3.0
    return deviations.at(u)


def test_k_sigma_of_a_draw_is_the_quantile_of_its_distribution() -> None:
    """Each draw equals SciPy's quantile at the probability of k sigma of a normal quantity, within its bounds."""
    deviations = deviations_of(loaded("campaigns/ksr3"), node_of_campaign("campaigns/ksr3", AT_A_ROW_S))
    triangle = stats.triang(1.0 / 3.0, 0.0025, 0.0075)
    for k in (-6.0, -3.0, -1.5, 0.0, 2.0, 3.0, 6.0):
        p = stats.norm.cdf(k)
        assert by_name(deviations, "compute delay", k).delay_s == pytest.approx(0.005 * p - 0.003, abs=1e-9)
        damping: Any = by_name(deviations, "bending damping 2", k).bending_damping
        assert 0.005 * damping[1] == pytest.approx(triangle.ppf(p), rel=1e-9)
        waves: Any = by_name(deviations, "slosh damping, lox", k).slosh_damping_ratio
        assert waves[0] == pytest.approx(2.0 ** (k / 3.0), rel=1e-4)
        mass: Any = by_name(deviations, "slosh mass, lox", k).slosh_mass
        assert mass[0] == pytest.approx(1.0 + 0.1 * k / 3.0, rel=1e-9)
    assert by_name(deviations, "compute delay", 1.5).delay_s == pytest.approx(0.0025 * (1.0 + 0.866) - 0.003, abs=2e-6)


def test_the_scenario_of_scores_flies_that_vehicle() -> None:
    """A scenario with draws of many kinds at once, when packed, is the vehicle that the search measured."""
    campaign, node = loaded("campaigns/ksr3"), node_of_campaign("campaigns/ksr3", AT_A_ROW_S)
    deviations = deviations_of(campaign, node)
    u = np.random.default_rng(4).normal(size=len(deviations.places)) / 3.0
    scenario = deviations.scenario(campaign.base, u)
    held = hold_stage(pack_flight(scenario.scenario), float(node.held.parameters[0].timeline.frozen_s))
    found = deviated(node.held, node.plane, deviations.at(u))
    assert differing(held.parameters, found.parameters) == []
    bobs = [schedule.tank_column(k) + c for k in range(2) for c in (schedule.TANK_MASS, schedule.TANK_LENGTH)]
    for column in (schedule.CORE_MASS, schedule.CORE_CG, 5, 6, schedule.TOTAL_MASS, *bobs):
        assert found.properties[0, column] == pytest.approx(held.properties[0, column], rel=1e-12)


@pytest.mark.slow
def test_engines_of_a_cluster_deviate_each_by_itself() -> None:
    """The loops of petrel's campaign equal those of the packed scenario at the same propellant.

    Unequal burn rates make nine engines of three in the record. The tables of the throttled first stage have another
    clock.
    """
    campaign = maxq.load(petrelkit.folder() / "campaign.toml")
    hz = np.geomspace(0.3, 45.0, 100)
    for time_s, stage in ((40.0, 0), (150.0, 1)):
        (node,) = maxq.nodes(campaign.base, [time_s], plane="yaw")
        deviations = deviations_of(campaign, node)
        assert (node.stage, deviations.left_out) == (stage, ())
        counts = {field: deviations.fields.count(field) for field in ("mass_flow", "actuator_sections", "slosh_mass")}
        assert counts == {"mass_flow": (9, 1)[stage], "actuator_sections": (3, 1)[stage], "slosh_mass": 2}
        for run, by in enumerate(deviations.drawn(range(3))):
            packed = pack_flight(campaign.scenario_of(run).scenario)
            clock_s = float(node.held.parameters[0].timeline.frozen_s)
            clock_s /= float(np.mean(by.mass_flow)) if stage == 0 else 1.0
            flown = dataclasses.replace(
                node,
                held=hold_stage(packed, clock_s, stage),
                instruments=instruments_of(packed.parameters[stage], "yaw"),
            )
            law = Pd(0.8, 0.4)
            ratio = Loop(fixed_path(flown), law).response(hz) / Loop(fixed_path(disperse(node, by)), law).response(hz)
            assert np.abs(20.0 * np.log10(np.abs(ratio))).max() < 1e-4


OWN = """\
extends = "nominal.toml"
[campaign]
runs = 200
[[disperse]]
keys = [
    "vehicle.stage.0.tank.0.mass_factor", "vehicle.stage.0.tank.1.mass_factor", "vehicle.stage.0.tank.0.length_factor",
]
distribution = "normal"
covariance = [[4e-4, 2.4e-4, -1e-4], [2.4e-4, 9e-4, 0.0], [-1e-4, 0.0, 4e-4]]
[[disperse]]
key = "vehicle.stage.0.actuator.zeta.*"
apply = "scale"
distribution = "uniform"
low = 0.8
high = 1.2
[[disperse]]
key = "vehicle.stage.0.engine.gimballed_mass_kg"
apply = "scale"
distribution = "normal"
sigma = 0.01
[[disperse]]
key = "vehicle.stage.0.gyro.scale_factor.1"
distribution = "normal"
sigma = 0.001
"""


@pytest.fixture
def own(tmp_path: Path) -> Path:
    path = tmp_path / "own.toml"
    path.write_text(OWN)
    return path


@pytest.mark.parametrize("key", ["actuator.stall_torque_Nm", "actuator.1.yaw.stall_torque_Nm", "cutoff_decay_factor"])
def test_margins_depend_on_no_stall_and_no_cutoff(key: str) -> None:
    assert UNREAD_KEYS.fullmatch(re.sub(r"\.\d+", ".#", key))


def test_deviations_that_go_together_and_those_that_are_not_followed(own: Path) -> None:
    """Scores are independent and the covariance is the campaign's; a draw without a rule is named."""
    campaign = maxq.load(own)
    node = maxq.nodes(campaign.base, [AT_A_ROW_S])[0]
    deviations = deviations_of(campaign, node)
    assert deviations.left_out == ("vehicle.stage.0.engine.gimballed_mass_kg",)
    assert [field for field in deviations.fields if field.startswith("act")] == ["actuator_sections"] * 4
    scores = np.random.default_rng(1).normal(size=(4000, len(deviations.places))) / 3.0
    every = deviations.of_scores(list(scores))
    mass = np.array([by.slosh_mass for by in every])
    length = np.array([by.slosh_frequency for by in every])[:, 0] ** -2.0
    found = np.cov(np.column_stack([mass, length]).T)
    np.testing.assert_allclose(found, [[4e-4, 2.4e-4, -1e-4], [2.4e-4, 9e-4, 0.0], [-1e-4, 0.0, 4e-4]], atol=4e-5)
    held = packed_as_flown(campaign, 3, node)[1]
    moved = disperse(node, deviations.drawn(range(3, 4))[0]).instruments
    assert dataclasses.astuple(moved.actuator)[:8] == pytest.approx(dataclasses.astuple(held.actuator)[:8], rel=1e-12)


def test_a_suite_takes_the_draws_of_its_campaign(own: Path, tmp_path: Path) -> None:
    """The file `campaign` of [margins.three_sigma] is looked for next to the suite, and excludes other numbers."""
    suite = tmp_path / "suite.toml"
    suite.write_text('schema = 2\n[margins.three_sigma]\ncampaign = "own"\n')
    wanted = read_suite(suite).suite.margins
    assert wanted is not None
    node = maxq.nodes(maxq.load(own).base, [AT_A_ROW_S])[0]
    few = wanted.model_copy(update={"cases": 3, "corner_sigmas": 0.0})
    found = vehicles(few, node, campaign_of(wanted.three_sigma, load_scenario("nominal")))[1]
    assert found == deviations_of(maxq.load(own), node).drawn(range(3))
    suite.write_text('schema = 2\n[margins.three_sigma]\ncampaign = "own"\nthrust = 0.1\n')
    with pytest.raises(ScenarioError, match=r"three_sigma.thrust.*cannot be combined with campaign"):
        read_suite(suite)
    own.write_text(WIND_ONLY)
    with pytest.raises(ScenarioError, match=r"three_sigma.campaign.*changes nothing that a loop depends on"):
        acting_at(maxq.load(own), Spread(campaign=str(own)), node)


def test_corners_hold_all_deviations_of_a_factor_together() -> None:
    """A Plackett-Burman design has 24 corners, and each draw of the shipped campaign in a loop has its factor."""
    node = node_of_campaign("campaigns/ksr3", AT_A_ROW_S)
    corners, _ = vehicles(LinearMargins(cases=0, corner_sigmas=1.5), node, loaded("campaigns/ksr3"))
    assert len(corners) == 24
    shapes: Any = [by.bending_shape for by in corners]
    assert {tuple(np.round(shape, 9)) for shape in shapes} == {(0.9,) * 3, (1.1,) * 3}
    ends = 0.005 * stats.norm.cdf([-1.5, 1.5]) - 0.003
    assert sorted({round(by.delay_s, 9) for by in corners}) == pytest.approx(ends, abs=1e-9)


def test_vehicles_of_a_spread_are_normal_as_before() -> None:
    node = node_of_campaign("campaigns/ksr3", AT_A_ROW_S)
    every = deviations_of(campaign_of(Spread(thrust=0.3), load_scenario("nominal"), 3), node).drawn(range(900))
    thrust: Array = np.ravel([by.thrust for by in every])
    assert thrust.std() == pytest.approx(0.1, rel=0.1)
    assert HANDED_BACK not in ManyLoops(node, Pd(0.9, 0.4)).measure(every[:3], -6.0)[1]


def test_a_robust_case_takes_the_draws_of_a_campaign(own: Path, tmp_path: Path) -> None:
    """Ends of a uniform draw at two sigma are 0.977 of the range; masses follow the covariance's Cholesky factor."""
    case = tmp_path / "case.toml"
    case.write_text('schema = 2\nscenario = "nominal"\nnodes_s = [35.0]\n[robust]\ncampaign = "own"\n')
    node = node_of_campaign("campaigns/ksr3", AT_A_ROW_S)
    ranges = ranges_of(read_case(case), [node])
    assert ranges is not None
    fields = deviations_of(ranges.campaign, node).fields
    assert fields == ("slosh_mass", "slosh_mass", "slosh_frequency", *["actuator_sections"] * 4)
    there = plant_at(node, ranges, [1, -1, 0, 1, 0, -1, 0])
    low, high = 0.8 + 0.4 * stats.norm.cdf([-2.0, 2.0])
    before, after = node.instruments.actuator, there.instruments.actuator
    ratios = [getattr(after, f"zeta_{k}") / getattr(before, f"zeta_{k}") for k in range(1, 5)]
    assert ratios == pytest.approx([high, 1.0, low, 1.0], rel=1e-9)
    factor = np.linalg.cholesky([[4e-4, 2.4e-4], [2.4e-4, 9e-4]])
    masses = there.vehicle.pendulums.mass_kg / node.vehicle.pendulums.mass_kg
    np.testing.assert_allclose(masses, 1.0 + factor @ [2.0, -2.0], rtol=1e-9)
    assert [f for f, end in zip(fields, modes_off(node, ranges, 1), strict=True) if end] == []  # no mode deviates


WIND_ONLY = """\
extends = "nominal.toml"
[campaign]
runs = 10
[[disperse]]
key = "wind.factor"
distribution = "uniform"
low = 0.5
high = 1.0
"""
FLIES_FIRST = '[{file="campaigns/first"}]'


@pytest.mark.parametrize(
    ("given", "campaigns", "said"),
    [
        ("", FLIES_FIRST, "draws of campaign first, vehicle N is its run N"),
        (
            "three_sigma={thrust=0.05}",
            FLIES_FIRST,
            "normal deviations of [margins.three_sigma], not draws of campaign first",
        ),
        ("three_sigma={thrust=0.05}", "[]", "normal deviations of [margins.three_sigma], the suite has no campaign"),
        (
            "",
            "[{file='{wind}'}]",
            "normal deviations of [margins.three_sigma]; campaign wind changes nothing that a loop depends on",
        ),
        (
            "three_sigma={campaign='{own}'}",
            FLIES_FIRST,
            "draws of campaign own, vehicle N is its run N; not of campaign first, which the suite flies; "
            "without vehicle.stage.0.engine.gimballed_mass_kg",
        ),
    ],
)
def test_a_verification_says_which_description_its_vehicles_have(
    given: str, campaigns: str, said: str, own: Path
) -> None:
    wind = own.with_name("wind.toml")
    wind.write_text(WIND_ONLY)
    changes = [f"margins.{given.replace('{own}', str(own))}"] if given else []
    small = ["margins.times_s=[35.0]", "margins.planes=['pitch']", "margins.between_nodes='ignore'"]
    read = read_suite(
        "quick", [*small, "margins.cases=5", f"campaign={campaigns.replace('{wind}', str(wind))}", *changes]
    )
    flies = [load_wanted(read, wanted, "designs/ksr3-default.toml", None) for wanted in read.suite.campaign]
    scenario = load_scenario("nominal", ["design='designs/ksr3-default.toml'"])
    job = Parts(read.suite, scenario, scenario, PartsOnDisk(None), lambda *_: None, 1, next(iter(flies), None))
    assert job.deviations == f"dispersed vehicles: {said}"
    (node,) = job.nodes("pitch")
    assert [d.label for d in vehicles(read.suite.margins, node, job.described.at(node))[1]][-1] == "vehicle 4"  # type: ignore[arg-type]  # the suite asks for margins
