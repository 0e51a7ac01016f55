"""Operating points, deviations and loops have these invariants for every vehicle, including the limiting cases.

| case | invariant |
|---|---|
| sloshing masses changed | the vehicle with frozen liquid is the same: mass, CG, inertia, stability derivatives |
| slosh mass zero | the same loop as without that tank |
| no modes, no tanks, ideal actuator and gyro | the loop of a rigid body in closed form |
| two modes of equal frequency and shape | one mode of half the generalised mass |
| a deviation of zero | the operating point itself |
| imposed derivatives | are exactly the results of eqs 4 to 8; axial load, slosh frequency and M_q are unchanged |
| operating points along a flight | equal the flight's log; outside powered flight they are rejected |
"""

from __future__ import annotations

import dataclasses
import pickle
from pathlib import Path

import numpy as np
import pytest
from design_nodes import (
    TIMES_S,
    closed_damping,
    design,
    flown,
    ideal,
    node_at,
    nominal,
    published,
    published_at,
    without,
)

import maxq
from maxq import Loop, Node
from maxq.design.laws.pd import Pd, PdDesign
from maxq.design.loop.fixed_path import PadeFixedPath, SampledFixedPath, fixed_path
from maxq.design.loop.loop import law_at
from maxq.design.model.deviations import deviations_of
from maxq.design.model.dispersion import Dispersion
from maxq.design.model.node import nodes_along
from maxq.design.model.spread import Spread, campaign_of
from maxq.design.model.state_space import Resolvent
from maxq.design.model.vehicle_at import without_engine_inertia
from maxq.design.paper.errata import PAPER
from maxq.design.paper.errata_effects import peaks_db
from maxq.design.paper.table2 import DerivativeTable, imposed, read_derivatives
from maxq.sim.run.fly import fly
from maxq.sim.scenario.loader import load_scenario
from maxq.sim.vehicle import schedule
from maxq.tools.dev.documents.departure import departure

KINDS = "sampled", "pade", "exact"
COLUMNS = "z_alpha_1ps", "m_alpha_1ps2", "z_delta_1ps", "m_delta_1ps2"

F = np.geomspace(0.01, 49.0, 120)
EVERY_NODE = pytest.mark.parametrize("time_s", TIMES_S)


def with_modes(node: Node, which: list[int]) -> Node:
    """Return the operating point with only these pitch modes and without axial softening."""
    held = node.held.copied()
    p, sizes, modes = held.properties, held.sizes, len(node.vehicle.omega_radps)
    for row in range(int(schedule.mode_rows(sizes))):
        first = int(schedule.mode_column(sizes, schedule.PITCH, row))
        p[:, first : first + len(which)] = p[:, [first + k for k in which]]
        if row >= schedule.MODE_PHI_GIMBAL:
            p[:, first + len(which) : first + modes] = 0.0
        if row >= int(schedule.softening_row(sizes, 0)):
            p[:, first : first + modes] = 0.0
    return dataclasses.replace(node, held=held)


# --- nodes
def test_nodes_are_those_of_the_flight_that_is_logged() -> None:
    times = (41.5, 7.25, 41.5)
    nodes = nodes_along(nominal(), times)
    assert [n.time_s for n in nodes] == list(times)
    flight = fly(nominal("run.duration_s=42"))
    for node in nodes:
        for name, ours in (
            ("airspeed_mps", node.condition.airspeed_mps),
            ("mach", node.condition.mach),
            ("density_kgpm3", node.condition.density_kgpm3),
            ("pressure_Pa", node.condition.pressure_Pa),
        ):
            there = np.interp(node.time_s, flight.time_s(name), flight[name])
            np.testing.assert_allclose(ours, there, rtol=1e-6)


def test_a_node_is_the_same_whichever_others_are_asked_for() -> None:
    alone, among = maxq.nodes(nominal(), [40.0])[0], node_at(40.0)
    assert alone.condition == among.condition
    np.testing.assert_array_equal(alone.plant.a, among.plant.a)


def test_nodes_come_back_from_another_process() -> None:
    node = node_at(40.0)
    again = pickle.loads(pickle.dumps(node))
    np.testing.assert_array_equal(fixed_path(again).response(F), fixed_path(node).response(F))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("time_s", "words"),
    [
        (0.05, r"operating point at 0.05 s: the vehicle is held down; allowed are times under thrust: liftoff to"),
        (-1.0, "operating point at -1 s: the flight begins at 0 s"),
        (61.0, "operating point at 61 s: the engine does not burn; allowed .*liftoff to 59.2874 s"),
        (500.0, "operating point at 500 s: the flight ends at 2.*impact"),
        (np.nan, "operating point at nan s: allowed are times up to 1e.08 s"),
    ],
)
def test_nodes_outside_the_powered_flight(time_s: float, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        nodes_along(nominal(), [10.0, time_s])


def test_no_nodes() -> None:
    assert nodes_along(nominal(), []) == []


def test_second_stage_has_nodes() -> None:
    node = nodes_along(load_scenario("checkcases/two-stage"), [1.0])[0]
    later = nodes_along(load_scenario("checkcases/two-stage"), [_second_burn()])[0]
    assert 0.0 < later.vehicle.total_mass_kg < 0.9 * node.vehicle.total_mass_kg


def _second_burn() -> float:
    flight = fly(load_scenario("checkcases/two-stage"), log=False)
    ignitions = [e.time_s for e in flight.events if e.name == "ignition"]
    return ignitions[-1] + 1.0


# --- deviations
def test_no_deviation_is_the_node_itself() -> None:
    node = node_at(40.0)
    assert node.with_() is node


@EVERY_NODE
def test_sloshing_masses_leave_the_frozen_vehicle(time_s: float) -> None:
    node = node_at(time_s)
    changed = node.with_(slosh_mass=(1.1, 0.8), slosh_frequency=(0.95, 1.05), slosh_damping=0.5)
    for f in ("total_cg_station_m", "total_inertia_kgm2"):
        np.testing.assert_allclose(getattr(changed.vehicle, f), getattr(node.vehicle, f), rtol=1e-12)
    ours, theirs = (dataclasses.astuple(n.derivatives) for n in (changed, node))
    np.testing.assert_allclose(ours, theirs, rtol=1e-9)  # numerical derivatives
    load = node.axial_load_mps2
    np.testing.assert_allclose(changed.axial_load_mps2, load, rtol=1e-12)
    before, after = node.vehicle.pendulums, changed.vehicle.pendulums
    np.testing.assert_allclose(np.sqrt(load / after.length_m) / np.sqrt(load / before.length_m), [0.95, 1.05])
    np.testing.assert_allclose(after.mass_kg / before.mass_kg, [1.1, 0.8])
    np.testing.assert_allclose(after.damping_ratio, 0.5 * before.damping_ratio)


def test_deviations_of_modes_and_instruments() -> None:
    node = node_at(40.0)
    off = node.with_(bending_frequency=(0.9, 1.1), bending_slope=1.2, actuator_frequency=0.85, delay_s=0.005)
    right, wrong = PadeFixedPath(node), PadeFixedPath(off)
    at = {r.label: r for r in right.resonances()}
    there = {r.label: r for r in wrong.resonances()}
    for label, factor in (("bending 1", 0.9), ("bending 2", 1.1), ("bending 3", 1.0), ("actuator 3", 0.85)):
        # coupling to the body moves a mode by half a per cent, softening by a little
        np.testing.assert_allclose(there[label].frequency_hz / at[label].frequency_hz, factor, rtol=5e-3)
    assert off.instruments.delay_s == node.instruments.delay_s + 0.005
    assert off.instruments.actuator.omega_4_radps == node.instruments.actuator.omega_4_radps
    bends = np.array([name.startswith("eta") for name in node.plant.states])
    np.testing.assert_allclose(off.plant.c[1], np.where(bends, 1.2, 1.0) * node.plant.c[1], rtol=1e-12)
    for kept in ("mass_kg", "length_m", "damping_ratio"):  # what is not named deviates by nothing
        np.testing.assert_array_equal(getattr(off.vehicle.pendulums, kept), getattr(node.vehicle.pendulums, kept))
    for kept in ("total_mass_kg", "total_cg_station_m", "total_inertia_kgm2"):
        assert getattr(off.vehicle, kept) == getattr(node.vehicle, kept)
    stronger = node.with_(thrust=1.03, normal_force=1.15, centre_of_pressure_m=0.25, inertia=0.95)
    before, after = (n.derivatives for n in (node, stronger))
    vacuum_N = node.held.properties[0, schedule.THRUST_VACUUM]
    added_mps2 = 0.03 * vacuum_N / node.vehicle.total_mass_kg
    speed = node.condition.airspeed_mps
    np.testing.assert_allclose(abs(after.z_delta_1ps - before.z_delta_1ps) * speed, added_mps2, rtol=1e-6)
    np.testing.assert_allclose(after.z_alpha_1ps / before.z_alpha_1ps, 1.15)
    assert after.m_delta_1ps2 > 1.03 * before.m_delta_1ps2
    assert after.m_alpha_1ps2 < before.m_alpha_1ps2
    np.testing.assert_allclose(stronger.axial_load_mps2 - node.axial_load_mps2, added_mps2, rtol=1e-9)


def test_every_mode_and_every_tank_deviates() -> None:
    node = node_at(40.0)
    modes, tanks = len(node.vehicle.omega_radps), len(node.vehicle.pendulums.mass_kg)
    deviations = deviations_of(campaign_of(Spread(), nominal()), node)
    assert len(set(deviations.places)) == len(deviations.places)
    for kind, count in (("bending_", modes), ("slosh_", tanks)):
        fields = [field for field in deviations.fields if field.startswith(kind)]
        assert {field: fields.count(field) for field in fields} == dict.fromkeys(fields, count)
        assert len(set(fields)) == 3


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"bending_frequency": 0.0}, "bending_frequency = 0.0: allowed are finite numbers above 0"),
        ({"slosh_mass": (1.0, -0.1)}, r"slosh_mass = \(1.0, -0.1\): allowed are finite numbers from 0"),
        ({"delay_s": np.nan}, "delay_s = nan: allowed"),
        ({"bending_slope": np.inf}, "bending_slope = inf: allowed are finite numbers$"),
    ],
)
def test_deviations_that_make_no_sense(given: dict[str, object], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        Dispersion(**given)  # type: ignore[arg-type]  # wrong on purpose


def test_too_many_factors_and_too_much_slosh() -> None:
    node = node_at(40.0)
    with pytest.raises(ValueError, match="slosh_mass has 3 factors: allowed are 2, or one number for all"):
        node.with_(slosh_mass=(1.0, 1.0, 1.0))
    with pytest.raises(ValueError, match="in a vehicle of"):
        node.with_(slosh_mass=30.0)


# --- edges
def test_zero_slosh_mass_is_no_tank() -> None:
    node = node_at(40.0).with_(slosh_mass=(1.0, 0.0))
    held = node.held.copied()
    held.properties[:, schedule.tank_column(1) + schedule.TANK_LENGTH] *= 3.0
    single = dataclasses.replace(node, held=held)  # an empty bob may hang as it likes
    for kind in KINDS:
        with_both, with_one = fixed_path(node, kind), fixed_path(single, kind)
        np.testing.assert_allclose(with_both.response(F), with_one.response(F), rtol=1e-9)
        assert len(with_both.poles()) == len(with_one.poles())
        assert [r.label for r in with_both.resonances()] == [r.label for r in with_one.resonances()]
    swinging = [p for p in node.plant.poles() if p.imag > 0]
    assert len(swinging) == 5  # the simulator lets an empty bob rest
    both_empty = node.with_(slosh_mass=0.0)
    assert not [r for r in fixed_path(both_empty).resonances() if r.kind == "slosh"]


@pytest.mark.parametrize("kind", KINDS)
def test_a_rigid_body_with_ideal_instruments(kind: str) -> None:
    """In vacuum, q' = M_delta delta exactly, and the loop has its closed form."""
    node = ideal(without(node_at(40.0), modes=True, tanks=True), actuator=True, gyro=True)
    condition = dataclasses.replace(node.condition, density_kgpm3=0.0)
    held = without_engine_inertia(node.held)
    held.vehicle["jet_damping"] = 0
    node = dataclasses.replace(node, condition=condition, held=held)
    path = fixed_path(node, kind)
    assert path.continuous.states == ("q_radps",)
    engine, numbers = held.vehicle["engine"], held.properties[0]
    thrust = engine["thrust_factor"][0, 0] * numbers[schedule.THRUST_VACUUM]
    thrust -= condition.pressure_Pa * engine["exit_area_m2"][0, 0]
    arm = engine["gimbal_station_m"][0, 0] - numbers[schedule.CORE_CG]
    m_delta = thrust * arm / numbers[schedule.CORE_INERTIA + 1]
    f = np.array([0.1, 1.0, 10.0, 40.0])
    s, timing = 2j * np.pi * f, node.instruments
    if kind == "sampled":
        z, late = np.exp(s * timing.sample_s), timing.sample_s - timing.delay_s
        # increments of the angle under a staircase that comes late, worked by hand
        t, d = timing.sample_s, timing.delay_s
        rate = late + d / z
        angle = 0.5 * late**2 + (d * late + 0.5 * d * d) / z
        expected = m_delta * (rate * t / (z - 1.0) + angle) / (z * t)
    elif kind == "exact":
        x = s * timing.sample_s
        expected = m_delta / s * ((1.0 - np.exp(-x)) / x) ** 2 * np.exp(-s * timing.delay_s)
    else:
        x = s * timing.sample_s
        y = s * timing.delay_s
        average = (1 - x / 14 + x**2 / 42 - x**3 / 840) / (1 + 3 * x / 7 + x**2 / 14 + x**3 / 210)
        late = (1 - y / 2 + y**2 / 12) / (1 + y / 2 + y**2 / 12)
        expected = m_delta / s * average * late / (1 + x / 2 + x**2 / 12)
    np.testing.assert_allclose(path.response(f), expected, rtol=1e-9)
    loop = Loop(path, Pd(0.5, 0.3))
    assert (loop.closed_poles().real < 0.0).all()
    assert (loop.open_poles() == 0.0).sum() == 2  # the body's and the integrator's


@pytest.mark.parametrize("kind", KINDS)
def test_two_modes_of_equal_frequency(kind: str) -> None:
    """Two equal modes are one mode with half the generalised mass, apart from axial softening."""
    twice, once = with_modes(node_at(40.0), [0, 0]), with_modes(node_at(40.0), [0])
    mass = int(schedule.mode_column(once.held.sizes, schedule.PITCH, schedule.MODE_MASS))
    once.held.properties[:, mass] *= 0.5
    f = np.append(F, [r.frequency_hz for r in fixed_path(once, kind).resonances()])
    np.testing.assert_allclose(fixed_path(twice, kind).response(f), fixed_path(once, kind).response(f), rtol=1e-6)
    labels = [r.label for r in fixed_path(twice, kind).resonances() if r.kind == "bending"]
    assert sorted(labels) == ["bending 1", "bending 2"]


def test_response_without_a_basis_of_eigenvectors() -> None:
    """The response is exact for two equal poles in series, 1 / (s + 1)^2, which have only one eigenvector."""
    a, b, c = np.array([[-1.0, 1.0], [0.0, -1.0]]), np.array([[0.0], [1.0]]), np.array([[1.0, 0.0]])
    s = 1j * np.geomspace(0.01, 100.0, 50).reshape(5, 10)
    np.testing.assert_allclose(Resolvent(a, b, c)(s)[..., 0, 0], 1.0 / (s + 1.0) ** 2, rtol=1e-14)


def test_scalar_frequencies_and_shapes() -> None:
    for kind in KINDS:
        loop = maxq.loop(node_at(40.0), design(), kind=kind)
        assert loop.response(1.0).shape == ()
        assert loop.response(np.ones((2, 3))).shape == (2, 3)
        np.testing.assert_allclose(loop.response([1.0, 2.0])[0], loop.response(1.0), rtol=1e-13)


def test_what_does_not_fit_is_refused() -> None:
    node = node_at(40.0)
    with pytest.raises(ValueError, match="kind = 'zoh': allowed is sampled, pade, exact"):
        fixed_path(node, "zoh")  # type: ignore[arg-type]  # wrong on purpose
    with pytest.raises(ValueError, match="cut = 'gyro': allowed is gimbal_command, rate_command_to_q"):
        fixed_path(node, cut="gyro")  # type: ignore[arg-type]  # wrong on purpose
    sampled, pade = fixed_path(node), fixed_path(node, "pade")
    law = PdDesign.of(design())
    with pytest.raises(ValueError, match="needs a discrete filter"):
        Loop(sampled, law.at(40.0, "pitch", None))
    with pytest.raises(ValueError, match="the loop's period is None"):
        Loop(pade, law.at(40.0, "pitch", 0.01))
    with pytest.raises(ValueError, match=r"filter of sample_s = 0\.02: the loop's period is 0\.01"):
        Loop(sampled, law.at(40.0, "pitch", 0.02))
    with pytest.raises(ValueError, match="k_p = nan"):
        Pd(np.nan, 1.0)
    with pytest.raises(ValueError, match="no state space"):
        fixed_path(node, "exact").state_space()
    with pytest.raises(ValueError, match="time_s is missing"):
        maxq.loop("nominal")
    with pytest.raises(ValueError, match="no design is given"):
        maxq.loop(node)
    with pytest.raises(ValueError, match="plant = 'paper': allowed is flown, table2"):
        maxq.nodes("nominal", [40.0], plant="paper")  # type: ignore[arg-type]  # wrong on purpose


def test_resonances_are_named() -> None:
    for node in flown():
        path = SampledFixedPath(node)
        labels = [r.label for r in path.resonances()]
        wanted = ["actuator 3", "bending 1", "bending 2", "bending 3", "body", "slosh 1", "slosh 2"]
        assert set(labels) <= set(wanted)
        assert set(wanted[:4] + wanted[5:]) <= set(labels)
        assert len(set(labels)) == len(labels)
        by = {r.label: r for r in path.resonances()}
        modes = node.vehicle
        for i in range(3):
            np.testing.assert_allclose(by[f"bending {i + 1}"].pole_radps.imag, modes.omega_radps[i], rtol=0.02)
        assert 47.0 < by["actuator 3"].frequency_hz < 49.0  # 52 Hz, folded
    damped = {r.label for r in path.resonances(below_zeta=2.0)}
    assert {"actuator 1", "actuator 2", "gyro"} <= damped


@pytest.mark.parametrize("unit", [1e-6, 1.0, 1e6])
def test_whether_a_command_ends_in_no_rate_depends_on_no_unit(unit: float) -> None:
    """KSR-III's attitude affects its motion because gravity turns; a vehicle without this has a rate that stays."""
    for gravity, rests in ((True, True), (False, False)):
        body = node_at(40.0).plant
        if not gravity:  # as an attitude that nothing depends on
            k = body.states.index("theta_rad")
            body = dataclasses.replace(body, a=np.where(np.arange(len(body.a)) == k, 0.0, body.a))
        scaled = dataclasses.replace(body, b=unit * body.b)
        path = PadeFixedPath(node_at(40.0))
        path.vehicle = scaled
        assert path.rests_at_dc is rests


def test_law_s_command_at_the_gimbal_s_limit() -> None:
    """The limit is 6 deg by KSR-III's file, half where a group moves twice as far, none for an ideal actuator."""
    node = node_at(40.0)
    assert np.degrees(node.angle_limit_rad) == pytest.approx(6.0, rel=1e-12)
    wider = dataclasses.replace(node, allocation=((2.0, 0.0),))
    assert np.degrees(wider.angle_limit_rad) == pytest.approx(3.0, rel=1e-12)
    assert ideal(node, actuator=True).angle_limit_rad == np.inf


def test_without_k_p_there_is_no_integrator() -> None:
    for kind in ("pade", "sampled"):
        path = fixed_path(node_at(40.0), kind)  # type: ignore[arg-type]  # a Literal, from parametrize
        loop = Loop(path, Pd(0.0, 0.3))
        assert len(loop.open_poles()) == len(path.poles())
        np.testing.assert_allclose(loop.response(F), 0.3 * path.response(F))


def test_literal_cuts_of_eq_42() -> None:
    node = node_at(40.0)
    for cut in ("rate_command_to_q", "rate_command_to_q_m"):
        loop = maxq.loop(node, design(), kind="pade", cut=cut)  # type: ignore[arg-type]  # a Literal, from a loop
        again = dataclasses.replace(loop, law=dataclasses.replace(loop.law, k_d_s=100.0))  # type: ignore[type-var]  # a Pd
        np.testing.assert_array_equal(loop.response(F), again.response(F))  # q_c meets k_p only
        s = loop.state_space()
        direct = s.response(F)[:, 0, 0]
        np.testing.assert_allclose(loop.response(F), direct, rtol=1e-5)
    peak = {
        cut: peaks_db(maxq.loop(node, design(), kind="pade", cut=cut))["bending 1"]  # type: ignore[arg-type]  # a Literal, from a loop
        for cut in ("gimbal_command", "rate_command_to_q", "rate_command_to_q_m")
    }
    assert peak["gimbal_command"] > 10.0 > -15.0 > peak["rate_command_to_q_m"] > peak["rate_command_to_q"] + 15.0


# --- Table 2
def test_imposed_derivatives_span_table_2() -> None:
    table = read_derivatives()
    nodes = imposed(published(), table)
    found = np.array([[getattr(n.derivatives, c) for c in COLUMNS] for n in nodes])
    np.testing.assert_allclose(found, table.values, rtol=1e-12)
    ends = {
        "z_alpha_1ps": (-0.55, -0.1),
        "m_alpha_1ps2": (-40, -1),
        "z_delta_1ps": (0.05, 0.38),
        "m_delta_1ps2": (8.1, 15.5),
    }
    for k, name in enumerate(COLUMNS):
        np.testing.assert_allclose((found[:, k].min(), found[:, k].max()), ends[name], rtol=1e-12)
    for before, after in zip(published(), nodes, strict=True):
        np.testing.assert_allclose(after.axial_load_mps2, before.axial_load_mps2, rtol=1e-12)
        rates = [n.derivatives.m_q_1ps for n in (before, after)]
        np.testing.assert_allclose(rates[0], rates[1], rtol=1e-12)
        assert after.vehicle.pendulums.mass_kg.tolist() == before.vehicle.pendulums.mass_kg.tolist()
        np.testing.assert_array_equal(after.vehicle.omega_radps, before.vehicle.omega_radps)
        assert (maxq.loop(after, design()).closed_poles().real < 0.0).all()
        assert len(maxq.loop(after.with_errata(PAPER), design(), kind="pade").closed_poles()) > 0


def test_imposed_derivatives_that_cannot_be() -> None:
    table = read_derivatives()
    with pytest.raises(ValueError, match=r"operating point at 57 s: .*derivatives.csv holds 5 s to 55 s"):
        table.at(57.0)
    between = table.at(42.5)
    assert 11.462 < between["m_delta_1ps2"] < 12.542
    wild = DerivativeTable(np.array([40.0]), np.array([[-0.5, -40.0, 0.07, 1e4]]))
    with pytest.raises(ValueError, match="M_delta = 10000 leaves the core no inertia"):
        imposed([published_at(40.0)], wild)


def test_tables_of_derivatives_that_are_none(tmp_path: Path) -> None:
    for text in ("time_s,z_alpha_1ps\n5,1\n", "", "time_s," + ",".join(COLUMNS) + "\n5,1,2,3,x\n"):
        file = tmp_path / "derivatives.csv"
        file.write_text(text)
        with pytest.raises(ValueError, match=r"derivatives.csv: allowed are"):
            read_derivatives(file)


# --- comparison
def test_departure_closes_and_says_where_it_comes_from() -> None:
    for node in flown()[::5]:
        found = departure(node, law_at(design(), node, "pade"), law_at(design(), node))
        pade = maxq.loop(node, design(), kind="pade").response(found.frequency_hz)
        sampled = maxq.loop(node, design()).response(found.frequency_hz)
        np.testing.assert_allclose(found.db["total"], 20 * np.log10(np.abs(pade / sampled)), atol=1e-9)
        turned = np.exp(1j * np.radians(found.deg["total"]))
        np.testing.assert_allclose(turned, pade / sampled / np.abs(pade / sampled), atol=1e-9)
        low = found.frequency_hz < 2.0
        assert np.abs(found.db["total"][low]).max() < 0.1
        assert np.abs(found.deg["total"][low]).max() < 1.0
        assert set(found.at(10.0)) == {"total", "pade", "aliasing", "integrator", "filter"}
    # at 55 s mode 3 lies 0.6 Hz below Nyquist: its image is as large as itself but for the distance
    third = next(r for r in found.resonances if r.label == "bending 3")
    assert abs(found.at(third.frequency_hz)["aliasing"][1]) > 5.0


def test_closed_damping_follows_slosh() -> None:
    """At 55 s the fuel is between CG and centre of percussion, and the loop reduces its damping."""
    loop = maxq.loop(node_at(55.0), design())
    free = {r.label: r.damping_ratio for r in loop.fixed.resonances() if r.kind == "slosh"}
    closed = closed_damping(loop)
    assert set(free) <= set(closed)
    off = dataclasses.replace(loop, law=Pd(0.0, 0.0))
    again = closed_damping(off)
    np.testing.assert_allclose([again[k] for k in free], list(free.values()), rtol=1e-6)
    assert closed["slosh 2"] < free["slosh 2"]


def test_nodes_are_those_of_a_flight_without_its_faults() -> None:
    loss = "fault=[{kind='thrust-loss',at_s=0.5,loss=0.4}]"
    sound, nominal = (nodes_along(load_scenario("nominal", more), [1.0])[0] for more in ([loss], []))
    weak = nodes_along(load_scenario("nominal", [loss]), [1.0], faults=True)[0]
    assert sound.condition == nominal.condition
    thrust = [n.held.properties[0, schedule.THRUST_VACUUM] for n in (sound, nominal, weak)]
    assert thrust[0] == thrust[1]
    assert thrust[2] == pytest.approx(0.6 * thrust[0], rel=1e-2)
