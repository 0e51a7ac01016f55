"""The computations of simverify agree with independent ones.

| quantity | against |
|---|---|
| centre of percussion | the point without acceleration in the linear plant under the engine's force |
| wind that uses the whole gimbal | the moment of the plant in trim at that angle of attack |
| corners | every factor as often high as low, and every pair of factors uncorrelated |
| margins of a vehicle without deviations | those of the design |
| damping that slosh needs | the closed loop grows with less and not with more |
| one changed gain | only the neighbouring operating points are computed again |
"""

from __future__ import annotations

import dataclasses
import math
from functools import cache
from pathlib import Path

import numpy as np
import pytest

import maxq
from maxq import LoadedCampaign, Node, margins
from maxq.design.model.deviations import deviations_of
from maxq.design.model.dispersion import Dispersion
from maxq.design.model.node import disperse
from maxq.design.model.spread import Spread, campaign_of
from maxq.design.model.vehicle_at import without_engine_inertia
from maxq.design.verify.linear import authority, study, vehicles
from maxq.design.verify.memory import PartsOnDisk
from maxq.design.verify.slosh import advise, percussion_station_m
from maxq.design.verify.suite import LinearMargins
from maxq.sim.scenario.loader import load_scenario
from maxq.sim.scenario.schema_design import Design

TIMES_S = (10.0, 20.0, 30.0, 50.0)


@pytest.fixture(scope="module")
def nodes() -> list[Node]:
    return maxq.nodes("nominal", TIMES_S)


@pytest.fixture(scope="module")
def design() -> Design:
    return maxq.load_design("designs/ksr3-default")


@cache
def campaign(seed: int = 1) -> LoadedCampaign:
    """Return the deviations of a suite without a campaign."""
    return campaign_of(Spread(), load_scenario("nominal"), seed)


def _rigid(node: Node) -> Node:
    """Return the operating point with frozen liquid, fixed modes and no engine inertia."""
    frozen = disperse(node, Dispersion(slosh_mass=0.0, bending_shape=0.0))
    return dataclasses.replace(frozen, held=without_engine_inertia(frozen.held))


def test_centre_of_percussion_stays_where_it_is(nodes: list[Node]) -> None:
    for node in nodes:
        rigid = _rigid(node)
        plant = rigid.plant
        push = plant.b[:, plant.inputs.index("delta_rad")]
        w, q = (push[plant.states.index(name)] for name in ("w_mps", "q_radps"))
        forward = rigid.vehicle.total_cg_station_m - percussion_station_m(rigid)
        assert abs(w - forward * q) < 1e-6 * abs(w)  # a point x forward of the CG moves with w - x q


def test_gimbal_trims_just_the_wind_that_takes_all_of_it(nodes: list[Node]) -> None:
    for node, found in zip(nodes, authority(nodes, [math.radians(6.0)]), strict=True):
        rigid = _rigid(node)
        plant = rigid.plant
        q = plant.states.index("q_radps")
        w = node.condition.airspeed_mps * math.atan(found.wind_mps / node.condition.airspeed_mps)
        by_wind = plant.a[q, plant.states.index("w_mps")] * w
        by_gimbal = plant.b[q, plant.inputs.index("delta_rad")] * math.radians(6.0)
        assert abs(by_wind) == pytest.approx(abs(by_gimbal), rel=0.01)


def of_modes(node: Node, n: int) -> Node:
    """Return `node` with `n` modes, for drawing."""
    found = dataclasses.replace(node)
    found.__dict__["vehicle"] = dataclasses.replace(node.vehicle, omega_radps=np.ones(n))
    return found


def test_corners_are_balanced_and_uncorrelated(nodes: list[Node]) -> None:
    corners, _ = vehicles(LinearMargins(cases=0, corner_sigmas=3.0), nodes[0], campaign())
    assert len(corners) == 24
    rows = []
    for d in corners:
        together = tuple(
            np.round(each, 12).tolist()
            for each in (d.bending_slope, d.bending_damping, d.slosh_frequency, d.slosh_mass, d.inertia)
        )
        assert all(len(set(each)) == 1 for each in together)
        rows.append([each[0] for each in together] + [d.normal_force, d.delay_s, d.centre_of_pressure_m])
        assert d.bending_slope[0] in (pytest.approx(0.8), pytest.approx(1.2))
    table = np.array(rows)
    signs = np.sign(table - table.mean(axis=0))
    assert np.allclose(signs.sum(axis=0), 0.0)
    assert np.allclose(signs.T @ signs, 24.0 * np.eye(signs.shape[1]))
    corners = {tuple(row) for row in np.round(signs).tolist()}
    assert len(corners) == 24  # and each has its mirror image among them
    assert {tuple(-x for x in corner) for corner in corners} == corners


def test_random_vehicles_do_not_depend_on_how_many_there_are(nodes: list[Node]) -> None:
    few, many = (vehicles(LinearMargins(cases=n), nodes[0], campaign(5))[1] for n in (3, 9))
    assert many[:3] == few
    assert vehicles(LinearMargins(cases=3), nodes[0], campaign(6))[1] != few


def test_every_mode_of_the_vehicle_deviates(nodes: list[Node]) -> None:
    """Modes beyond the last given share have the last share, and the draws of earlier modes are unchanged."""
    wanted = LinearMargins(cases=1, corner_sigmas=0.0)
    three, two = (vehicles(wanted, of_modes(nodes[0], n), campaign(5))[1][0] for n in (3, 2))
    assert len(np.unique(three.bending_frequency)) == 3
    assert len(np.unique(three.bending_slope)) == 3
    assert two.bending_frequency == three.bending_frequency[:2]  # type: ignore[index]  # one each, no number
    beyond = deviations_of(campaign_of(Spread(bending_frequency=(0.05, 0.1)), load_scenario("nominal")), nodes[0])
    moved = beyond.at(np.array([1.0 if name.startswith("bending frequency") else 0.0 for name in beyond.places]))
    assert moved.bending_frequency == pytest.approx([1.05, 1.1, 1.1], rel=1e-12)


def test_vehicle_that_does_not_deviate_has_the_margins_of_the_design(nodes: list[Node], design: Design) -> None:
    found = study(nodes, design, LinearMargins(cases=1, corner_sigmas=0.0), campaign(), PartsOnDisk(None))
    for node, measured in zip(nodes, found.nominal.nodes, strict=True):
        expected = margins(maxq.loops([node], design)[0])
        assert measured["gain_up_db"] == pytest.approx(expected.gain_up_db.value, abs=1e-9)
        assert measured["delay_ms"] == pytest.approx(1e3 * expected.delay_s.value, abs=1e-9)


def test_slosh_grows_with_less_damping_than_it_needs(nodes: list[Node], design: Design) -> None:
    needing = [a for a in advise(nodes[-1:], design) if a.needed > 0.0]
    assert needing
    for a in needing:
        for share, grows in ((0.9, True), (1.1, False)):
            factors = [1.0, 1.0]
            factors[a.tank] = share * a.needed / a.damping
            loop = maxq.loops([disperse(nodes[-1], Dispersion(slosh_damping=tuple(factors)))], design)[0]
            poles = loop.closed_poles()
            assert bool((poles[(poles.imag > 0.5) & (poles.imag < 31.0)].real > 0.0).any()) is grows


def test_one_changed_gain_redoes_its_neighbours_only(nodes: list[Node], design: Design, tmp_path: Path) -> None:
    wanted = LinearMargins(cases=1, corner_sigmas=0.0)
    free = maxq.load_design("designs/ksr3-free")  # a gain at every node
    study(nodes, free, wanted, campaign(), PartsOnDisk(tmp_path))
    text = _with_more_gain(free, 30.0)
    second = PartsOnDisk(tmp_path)
    study(nodes, text, wanted, campaign(), second)
    assert (second.worked_out, second.recalled) == (1, 3)


def _with_more_gain(design: Design, time_s: float) -> Design:
    """Return the design with k_p of one row 1 % higher."""
    from maxq.sim.input.documents import Source, adopt, plain  # noqa: PLC0415  # for this helper only

    table = design.gains.table
    rows = [
        {"time_s": float(t), "k_p": float(p) * (1.01 if t == time_s else 1.0), "k_d_s": float(d)}
        for t, p, d in zip(table["time_s"], table["k_p"], table["k_d_s"], strict=True)
    ]
    assert any(row["time_s"] == time_s for row in rows)
    given = {"schema": 2, "gains": {"table": rows}, "filter": design.filter.model_dump(exclude_none=True)}
    return Design.model_validate(plain(adopt(given, Source("design"))))
