"""Intervals without operating points follow from events, thrust tables and a hand calculation of the nose moment."""

from __future__ import annotations

import math
import re

import layoutkit
import numpy as np
import petrelkit as petrel
import pytest

from maxq import LoadedScenario
from maxq.design.model.node import node_of
from maxq.design.model.node_times import node_times
from maxq.design.model.powered import flown_run, powered_flight
from maxq.design.verify.uncovered import uncovered
from maxq.sim.scenario.loader import load_scenario


def points(scenario: LoadedScenario) -> dict[int, list[float]]:
    """Return the times of the default operating points by stage."""
    times_s = node_times(scenario)
    return {span.stage: [t for t in times_s if span.holds(t)] for span in powered_flight(scenario)[0]}


def test_intervals_and_operating_points_are_the_whole_powered_flight() -> None:
    """KSR-III coasts with its fins after burnout, so no coast is named."""
    scenario = load_scenario("nominal")
    (span,) = powered_flight(scenario)[0]
    times_s = points(scenario)[0]
    found = uncovered(scenario, {0: times_s})
    assert [one.stage for one in found] == [0, 0, 0]
    before, after, tail = found
    assert (before.begin_s, before.end_s) == (span.begin_s, times_s[0])
    assert (after.begin_s, after.end_s) == (times_s[-1], tail.begin_s)
    assert tail.end_s == span.end_s
    table = scenario.vehicle.stage[0].engines[0].table
    thrust = np.interp([tail.begin_s - 0.02, tail.begin_s + 0.02], table["time_s"], table["thrust_vacuum_N"])
    assert thrust[1] < 0.5 * table["thrust_vacuum_N"].max() <= thrust[0]
    assert before.text == f"{span.begin_s:.4g} to {times_s[0]:.4g} s: under thrust, before the first operating point"
    assert tail.text.endswith(": tail-off, with less than half of the largest thrust")


@pytest.mark.slow
def test_a_point_in_the_tail_off_covers_it_up_to_there() -> None:
    scenario = load_scenario("nominal")
    (span,) = powered_flight(scenario)[0]
    found = uncovered(scenario, {0: [span.begin_s, 59.2]})
    assert [(one.begin_s, one.end_s) for one in found] == [(59.2, span.end_s)]
    assert uncovered(scenario, {0: [span.begin_s, span.end_s]}) == ()


@pytest.mark.slow
def test_a_stage_without_operating_points_is_named_whole() -> None:
    scenario = petrel.scenario()
    spans = powered_flight(scenario)[0]
    of_first = points(scenario)[0]
    powered = [one for one in uncovered(scenario, {0: of_first}) if not one.why.startswith("coast")]
    assert [(one.stage, one.begin_s, one.end_s) for one in powered[3:]] == [
        (span.stage, span.begin_s, span.end_s) for span in spans[1:]
    ]
    assert {one.why for one in powered[3:]} == {"under thrust, no operating point"}


@pytest.mark.slow
def test_a_coast_of_an_unstable_airframe_is_named_with_its_growth() -> None:
    """petrel flies without fins between burnout of the first stage and ignition of the second.

    M_alpha = q S CN_alpha (x_cg - x_nose) / I by hand, for the exposed nose; the growth is its WKB integral.
    """
    scenario = petrel.scenario()
    spans = powered_flight(scenario)[0]
    (coast,) = (one for one in uncovered(scenario, points(scenario)) if one.why.startswith("coast"))
    assert (coast.begin_s, coast.end_s) == pytest.approx((spans[0].end_s, spans[1].begin_s), abs=0.01)
    said = re.search(r"M_alpha up to ([0-9.]+) 1/s2, a disturbance grows ([0-9.]+) times", coast.why)
    assert said is not None
    run, times_s, m_alpha = flown_run(scenario, faults=False), np.linspace(coast.begin_s, coast.end_s, 61), []
    for time_s in times_s:
        while run.now_s < time_s:
            run.fly_segment(round(1e9 * time_s))
        stage = int(run.memory.clock.stage)
        node = node_of(run.packed, run.now_s, stage)
        nose = scenario.vehicle.stage[stage].aero.surface[0].table
        slope, station_m = (np.interp(node.condition.mach, nose["mach"], nose[k]) for k in ("CN_alpha_pr", "station_m"))
        pressure = 0.5 * node.condition.density_kgpm3 * node.speed_mps**2
        force = pressure * scenario.vehicle.reference.area_m2 * slope
        m_alpha.append(force * (node.vehicle.total_cg_station_m - station_m) / node.vehicle.total_inertia_kgm2)
    assert float(said[1]) == pytest.approx(max(m_alpha), rel=0.02)
    assert float(said[2]) == pytest.approx(math.exp(np.trapezoid(np.sqrt(m_alpha), times_s)), rel=0.03)


@pytest.mark.slow
def test_nothing_is_said_of_the_time_after_a_loss() -> None:
    scenario = layoutkit.lost_scenario()
    spans, loss = powered_flight(scenario)
    assert loss is not None
    found = uncovered(scenario, points(scenario))
    assert max(one.end_s for one in found) == spans[-1].end_s == loss.time_s
