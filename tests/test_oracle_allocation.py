"""Allocation of pitch, yaw and roll to engine groups equals NumPy's pseudo-inverse and moments written here."""

from __future__ import annotations

import numpy as np
import pytest

from maxq.control.allocation import Allocation, AllocationState, allocate, pseudo_inverse, roll_command
from maxq.control.kernel.limits import MAX_ENGINES
from maxq.control.kernel.records import Array, blank, pack
from maxq.control.kernel.tables import Pool, fit, table_in
from maxq.sim.packing.flight import Packed, pack_flight
from maxq.sim.run.fly import fly
from maxq.sim.scenario.loader import load_scenario
from maxq.sim.vehicle.engine.allocation import moments

NINE = "tests/data/nine-engines/flight.toml"
GROUPS = [f"vehicle.stage.0.engine.{k}.group='{name}'" for k, name in enumerate("abcdabcd")]  # opposite ones together
ROLL = "design.roll_gimbal={k_p=0.4,k_d_s=0.5,limit_deg=2.0}"
NO_MODES = ["switches.bending=false", "switches.slosh=false"]


def packed(*overrides: str) -> Packed:
    return pack_flight(load_scenario(NINE, [*GROUPS, ROLL, *overrides]).scenario)


def matrices(made: Packed) -> tuple[Array, list[Array]]:
    """Return the times and matrices (channels, 3) of the first stage."""
    a = made.parameters[0].computer.allocation
    table = table_in(made.pool, a.matrix)
    return table.breaks, [c[0].reshape(-1, 3) for c in table.coefficients]


@pytest.mark.parametrize("seed", range(5))
def test_pseudo_inverse_is_that_of_numpy(seed: int) -> None:
    rng = np.random.default_rng(seed)
    effect, limits, authority = rng.normal(size=(3, 8)), rng.uniform(0.5, 2.0, 8), rng.uniform(1.0, 3.0, 3)
    ours = pseudo_inverse(effect, list(limits), authority)
    theirs = np.diag(limits) @ np.linalg.pinv(effect @ np.diag(limits)) @ np.diag(authority)
    np.testing.assert_allclose(ours, theirs, rtol=1e-11, atol=1e-12)
    np.testing.assert_allclose(effect @ ours, np.diag(authority), atol=1e-10)


def test_an_axis_that_cannot_be_turned_gets_nothing_and_costs_the_others_nothing() -> None:
    rng = np.random.default_rng(9)
    effect = rng.normal(size=(3, 6))
    for roll in (np.zeros(6), 2.0 * effect[0] - effect[1]):  # none, and none apart from pitch and yaw
        effect[2] = roll
        out = pseudo_inverse(effect, [1.0] * 6, np.ones(3))
        assert not out[:, 2].any()
        np.testing.assert_allclose(out[:, :2], np.linalg.pinv(effect[:2]), rtol=1e-11)


def test_the_computer_does_not_know_by_what_an_engine_deviates() -> None:
    """A dispersed engine flies with the allocation of the nominal vehicle."""
    off = ["vehicle.stage.0.engine.0.thrust_factor=1.1", "vehicle.stage.0.engine.3.mass_flow_factor=0.9"]
    for one, other in zip(matrices(packed())[1], matrices(packed(*off))[1], strict=True):
        assert one.tobytes() == other.tobytes()


def test_moments_of_the_ring_are_those_of_forces_at_their_places() -> None:
    stage = load_scenario(NINE, GROUPS).scenario.vehicle.stage[0]
    effect, small = moments(stage, ()), 1e-6
    assert effect.shape == (3, 10)
    cg = stage.mass.table["x_cg_m"]
    for channel in range(10):
        group, angle = stage.engine_groups[channel // 2], np.zeros(2)
        angle[channel % 2] = small
        moment = np.zeros(3)
        for e in stage.engines:
            d = np.array([np.cos(angle[0]) * np.cos(angle[1]), -np.sin(angle[1]), np.sin(angle[0]) * np.cos(angle[1])])
            if e.group == group:
                place = np.array([0.0, *e.offset_m]) - np.array([e.gimbal_station_m, 0.0, 0.0])
                moment += np.cross(place, 4e5 * d) - np.cross(place, [4e5, 0, 0])
        assert effect[2, channel] == pytest.approx(moment[0] / small, rel=1e-5, abs=1.0)
        station = 0.5 * float(cg.max() - cg.min())  # of the CG, somewhere between its ends
        lateral = effect[channel % 2, channel] / 4e5 / sum(e.group == group for e in stage.engines)
        assert 38.6 - cg.max() < lateral < 38.6 - cg.min() + station


def test_a_symmetric_cluster_deflects_alike_in_pitch_and_yaw_and_along_the_ring_in_roll() -> None:
    _, (a, *_) = matrices(packed())
    np.testing.assert_allclose(a[0::2, 0], 1.0, rtol=1e-12)  # pitch: all pitch angles
    np.testing.assert_allclose(a[1::2, 0], 0.0, atol=1e-12)
    np.testing.assert_allclose(a[1::2, 1], 1.0, rtol=1e-12)
    stage = load_scenario(NINE, GROUPS).scenario.vehicle.stage[0]
    effect = moments(stage, ())
    assert not a[:, 2].any()  # opposite engines in one group: each group's roll moments cancel
    single = pack_flight(load_scenario(NINE, [f"vehicle.stage.0.engine.{k}.group='g{k}'" for k in range(9)]).scenario)
    _, (a, *_) = matrices(single)
    for k in range(8):
        y, z = stage.engines[k].offset_m
        np.testing.assert_allclose(a[2 * k : 2 * k + 2, 2] * 1.15 / a[0, 2], [y, z], atol=2e-6)
    np.testing.assert_allclose(a[16:, 2], 0.0, atol=1e-12)  # the middle one cannot roll
    assert abs(effect[2]).max() < 1e-3


SINGLY = [f"vehicle.stage.0.engine.{k}.group='g{k}'" for k in range(9)]


def test_after_a_fault_the_computer_allocates_to_what_is_left() -> None:
    fault = "fault=[{kind='engine-off',engine=2,at_s=20.0,reallocate_after_s=0.5,until_s=40.0}]"
    scenario = load_scenario(NINE, [*SINGLY, fault]).scenario
    times, (before, after, again, *_) = matrices(pack_flight(scenario))
    np.testing.assert_allclose(times[:3], [0.0, 20.5, 40.5])
    stage = scenario.vehicle.stage[0]
    nominal = moments(stage, ())
    left = nominal.copy()
    left[:, 4:6] = 0.0
    wanted = np.diag(np.abs(nominal).sum(axis=1))
    np.testing.assert_allclose(nominal @ before, wanted, rtol=1e-9, atol=1e-3)
    np.testing.assert_allclose(left @ after, wanted, rtol=1e-9, atol=1e-3)
    assert not after[4:6].any()
    np.testing.assert_array_equal(again, before)
    unaware = load_scenario(NINE, [*SINGLY, "fault=[{kind='engine-off',engine=2,at_s=20.0}]"]).scenario
    assert len(matrices(pack_flight(unaware))[1]) == 1


def test_roll_takes_what_pitch_and_yaw_leave_by_one_factor() -> None:
    matrix = np.array([[1.0, 0.0, 1.0], [0.0, 1.0, 0.0], [1.0, 0.0, -1.0], [0.0, 1.0, 0.5]])
    pool = Pool()
    table = pool.add(fit([0.0], matrix.reshape(1, -1), "step"))
    made = Allocation(2, table, 2.0, 3.0, 0.05, np.ones(2 * MAX_ENGINES))
    a, state = pack([made])[0], blank(AllocationState)[0]
    assert roll_command(a, 0.01, 0.005) == pytest.approx(-0.035)
    assert roll_command(a, -1.0, 0.0) == 0.05
    assert allocate(a, pool.array(), state, 1.0, 0.08, 0.02, 0.05, 0.1) == 0
    np.testing.assert_allclose(state.angle_rad[:4], [0.08 + 0.02, 0.02, 0.08 - 0.02, 0.02 + 0.01], rtol=1e-14)
    assert allocate(a, pool.array(), state, 1.0, 0.12, 0.0, 0.05, 0.1) == 1
    np.testing.assert_allclose(state.angle_rad[:4], [0.1, 0.0, 0.1, 0.0], atol=1e-16)


@pytest.mark.slow
def test_gimbals_hold_roll_against_a_torque_as_the_pd_law_says() -> None:
    torque = "injection=[{at='body_torque',axis='x',kind='step',amplitude_Nm=20000.0,start_s=5.0}]"
    flight = fly(load_scenario(NINE, [*SINGLY, ROLL, torque, "run.duration_s=20.0", *NO_MODES]))
    error_deg = float(flight["error_roll_deg"][-1])
    row = pack_flight(load_scenario(NINE, [*SINGLY, ROLL]).scenario).parameters[0].computer.allocation
    assert int(row.groups) == 9
    radius = 1.15
    # 9.2 m of ring in all: sum of |y| + |z| times the thrust at the ground gives the moment of a radian
    stage = load_scenario(NINE, SINGLY).scenario.vehicle.stage[0]
    per_radian = (4e5 - 0.6 * 101325.0) * sum(abs(y) + abs(z) for y, z in (e.offset_m for e in stage.engines))
    assert radius * 8 * 4e5 > 0.7 * per_radian
    expected = np.degrees(20000.0 / (0.4 * per_radian))  # the PD law's own error under a constant torque
    assert error_deg == pytest.approx(expected, rel=0.05)
    calm = fly(load_scenario(NINE, [*SINGLY, torque, "run.duration_s=20.0", *NO_MODES]))
    assert abs(float(calm["error_roll_deg"][-1])) > 9.9  # at the clamp of the error, and on its way


@pytest.mark.slow
def test_groups_with_equal_commands_fly_as_one_group() -> None:
    """Without roll control, the pseudo-inverse of a symmetric cluster gives the law's command to all groups."""
    one = fly(load_scenario(NINE, ["run.duration_s=12.0"]))
    many = fly(load_scenario(NINE, [*SINGLY, "run.duration_s=12.0"]))
    for channel in ("gimbal_pitch_angle_deg", "pitch_deg", "altitude_m", "eta_pitch_1_m"):
        np.testing.assert_allclose(many[channel], one[channel], rtol=1e-6, atol=1e-7)


def test_one_group_has_no_allocation() -> None:
    made = pack_flight(load_scenario(NINE).scenario)
    assert int(made.parameters[0].computer.allocation.groups) == 1
