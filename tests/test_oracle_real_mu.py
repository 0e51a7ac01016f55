"""Bounds of the structured singular value over real numbers equal exhaustive searches and closed forms."""

from __future__ import annotations

import dataclasses
import itertools

import design_nodes
import numpy as np
import petrelkit
import pytest

from maxq import Loop
from maxq.control.kernel.records import Array
from maxq.design.loop.fixed_path import fixed_path
from maxq.design.loop.loop import law_at
from maxq.design.loop.multiloop import multiloop
from maxq.design.margins.real_mu import bound, descent, real_mu_upper
from maxq.design.model.deviations import deviations_of
from maxq.design.model.node import disperse
from maxq.design.model.powered import flown_run, flown_to
from maxq.design.model.spread import DEVIATIONS, Spread, campaign_of
from maxq.design.verify.named_mu import Uncertain, stable_together, stable_within, uncertain
from maxq.design.verify.suite import WorstWanted
from maxq.design.verify.worst import search_node
from maxq.sim.packing.flight import pack_flight

LOWEST_HZ = 1e-3  # slower roots are drift


def brute_force(m: np.ndarray, ranks: list[int]) -> float:
    """Return 1 / the least greatest real number at which 1 - M d is singular, over directions in the box's faces."""
    best = np.inf
    axes = np.linspace(-1.0, 1.0, 21)
    for face in range(len(ranks)):
        for rest in itertools.product(axes, repeat=len(ranks) - 1):
            d = np.insert(np.array(rest), face, 1.0)
            sizes = np.linalg.eigvals(m * np.repeat(d, ranks))
            real = sizes[np.abs(sizes.imag) < 1e-3 * np.abs(sizes)].real
            best = min(best, 1.0 / np.abs(real).max(initial=1e-12))
    return 1.0 / best


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("ranks", [[1, 1], [2, 1], [1, 1, 1]])
def test_upper_bound_lies_above_brute_force_and_not_far(seed: int, ranks: list[int]) -> None:
    rng = np.random.default_rng([seed, *ranks])
    n = sum(ranks)
    m = rng.normal(size=(n, n)) + 0.2j * rng.normal(size=(n, n))
    found, scaling = real_mu_upper(m, ranks)
    below = brute_force(m, ranks)
    assert found >= below * (1.0 - 1e-6)
    assert found <= np.linalg.norm(m, 2) + 1e-9
    assert found == pytest.approx(bound(m, scaling))
    owner = np.repeat(np.arange(len(ranks)), ranks)
    assert all(np.abs(part[owner[:, None] != owner]).max(initial=0.0) < 1e-12 for part in scaling)
    np.testing.assert_allclose(scaling[1], scaling[1].conj().T, atol=1e-12)


def test_of_one_real_number_it_is_the_greatest_real_eigenvalue() -> None:
    """For M = diag(3 j, 1), a real d makes 1 - M d singular only at d = 1; complex ones do at 1/3."""
    found, _ = real_mu_upper(np.diag([3.0j, 1.0]).astype(complex), [2])
    assert found == pytest.approx(1.0, rel=0.02)


def test_slopes_of_the_descent_are_differences() -> None:
    rng = np.random.default_rng(7)
    m, inside = rng.normal(size=(3, 3)) + 1j * rng.normal(size=(3, 3)), np.zeros((3, 3), bool)
    inside[:2, :2] = inside[2, 2] = True
    at = descent(m, inside, (np.diag([1.0, 2.0, 0.5]).astype(complex), np.diag([0.1, -0.2, 0.3]).astype(complex)), 2.0)
    _, slope = at(np.zeros(10))
    differences = [(at(unit)[0] - at(-unit)[0]) / 2e-6 for unit in 1e-6 * np.eye(10)]
    np.testing.assert_allclose(slope, differences, atol=1e-6)


@pytest.mark.slow
def test_determinant_of_the_deviations_is_that_of_the_sampled_loop() -> None:
    """det(1 - M d) is the ratio of det(s - A(d)) (1 + L(d)), by differences of the judged loop.

    The actuator agrees to 1 %, since with 15 % its poles curve between their ends.
    """
    node, campaign = design_nodes.node_at(45.0), campaign_of(Spread(actuator_frequency=0.01), design_nodes.nominal())
    deviations, law = deviations_of(campaign, node), law_at(design_nodes.design(), node)
    every = uncertain(node, campaign)
    hz, step = np.array([0.7, 1.3, 3.0, 9.0]), 1e-4
    here, n = Loop(fixed_path(node), law), len(every.whole) - 1
    for f in hz:
        a, b, c, d = every.whole[:n, :n], every.whole[:n, n:], every.whole[n:, :n], every.whole[n:, n:]
        path = (c @ np.linalg.solve(2j * np.pi * f * np.eye(n) - a, b) + d)[0, 0]
        nominal = here.response([f])[0]
        m, ranks = every.matrix(float(f), complex(nominal / path))
        found, wanted = [], []
        for unit in np.eye(len(deviations.places)):
            there = Loop(fixed_path(disperse(node, deviations.at(step * unit))), law)
            open_, as_it_is = (np.linalg.det(2j * np.pi * f * np.eye(n) - x.fixed.continuous.a) for x in (there, here))
            wanted.append((1.0 + there.response([f])[0]) / (1.0 + nominal) * (open_ / as_it_is) - 1.0)
            found.append(np.linalg.det(np.eye(len(m)) - m * np.repeat(step * unit, ranks)) - 1.0)
        np.testing.assert_allclose(found, wanted, atol=2e-3 * np.abs(wanted).max())


@pytest.mark.long
def test_no_vehicle_of_the_box_is_unstable_and_one_farther_out_is() -> None:
    """All of 400 vehicles at corners and inside the box of mu are stable; a box 1.25 times as large has an unstable
    one.
    """
    node, campaign = design_nodes.node_at(45.0), campaign_of(Spread(), design_nodes.nominal())
    deviations, design = deviations_of(campaign, node), design_nodes.design()
    found = stable_within(node, design, campaign)
    assert found is not None
    assert 1.0 < found.sigmas < 6.0
    rng, law = np.random.default_rng(3), law_at(design, node)
    places, reach = deviations.places, found.sigmas / 3.0

    def unstable(u: np.ndarray) -> bool:
        loop = Loop(fixed_path(disperse(node, deviations.at(u))), law)
        return not bool((loop.closed_poles().real < 0.0).all())

    corners = reach * rng.choice([-1.0, 1.0], size=(300, len(places)))
    assert not any(unstable(u) for u in [*corners, *rng.uniform(-reach, reach, size=(100, len(places)))])
    least, worst, _ = search_node(
        node, design, campaign, WorstWanted(region="box", sigmas=1.25 * found.sigmas, starts=2)
    )
    assert least < 0.0
    assert unstable(worst)


def by_hand(*changes: Array, gain: float = 2.0) -> tuple[Uncertain, np.ndarray]:
    """Return two integrators, each in a loop of this gain; `changes` (2, 2) of their coupling."""
    whole = np.block([[np.zeros((2, 2)), np.eye(2)], [np.eye(2), np.zeros((2, 2))]])
    padded = tuple(np.pad(change, (0, 2)) for change in changes)
    return Uncertain(whole, padded, np.zeros(len(changes)), np.ones(len(changes)), axes=2), gain * np.eye(2)


@pytest.mark.long
def test_two_coupled_loops_have_the_bound_of_their_closed_form() -> None:
    """With s = -k +- sqrt(v w), two couplings destabilise from |v| = |w| = k, and one factor for both from k.

    One coupling alone, and a rotation (s = -k +- j v), never do.
    """
    up, down = np.array([[0.0, 1.0], [0.0, 0.0]]), np.array([[0.0, 0.0], [1.0, 0.0]])
    for changes, wanted in (((up, down), 0.5), ((up + down,), 0.5), ((up,), 0.0), ((down - up,), 0.0)):
        every, back = by_hand(*changes)
        peak = 0.0
        for hz in (1e-6, 0.1, 0.3, 1.0):
            m, ranks = every.matrix(hz, back)
            peak = max(peak, real_mu_upper(m, ranks)[0])
        assert peak == pytest.approx(wanted, rel=1e-3, abs=0.02)


def test_a_delay_of_all_commands_is_that_of_each() -> None:
    """For two loops without coupling, det(1 - M v) is the square of that of one."""
    one = Uncertain(np.array([[0.0, 1.0], [1.0, 0.0]]), (np.zeros((2, 2)),), np.array([0.02]), np.ones(1))
    two = Uncertain(by_hand()[0].whole, (np.zeros((4, 4)),), np.array([0.02]), np.ones(1), axes=2)
    for hz in (0.3, 2.0):
        (single, _), (both, ranks) = one.matrix(hz, 2.0), two.matrix(hz, 2.0 * np.eye(2))
        assert ranks == [2]
        alone = np.linalg.det(np.eye(1) - 0.7 * single)
        # 1 + L (1 - j v sin) over 1 + L
        returned = 2.0 / (2j * np.pi * hz)
        wanted = 1.0 - returned * 0.7j * np.sin(2.0 * np.pi * hz * 0.02) / (1.0 + returned)
        assert alone == pytest.approx(wanted, rel=1e-12)
        assert np.linalg.det(np.eye(2) - 0.7 * both) == pytest.approx(alone**2, rel=1e-12)


FEW = Spread(
    **{name: 0.0 for name in DEVIATIONS if name not in ("bending_slope", "actuator_frequency")},
    bending_slope=(0.7, 0.0),
    actuator_frequency=0.3,
)


@pytest.mark.long
@pytest.mark.parametrize(("vehicle", "beyond"), [("ksr3", 3.6), ("petrel", 1.2)])
def test_no_vehicle_within_the_bound_of_all_axes_is_unstable_and_one_beyond_is(vehicle: str, beyond: float) -> None:
    """All corners of the box have stable poles in the simulator's linearised loops of all axes; one beyond does not.

    For petrel's third mode, 0.1 rad/s from the axis, frequencies a hundredth of a hertz apart matter.
    """
    base, time_s = (design_nodes.nominal(), 45.0) if vehicle == "ksr3" else (petrelkit.scenario(), 40.0)
    design = base.design
    assert design is not None
    node = design_nodes.node_at(time_s) if vehicle == "ksr3" else petrelkit.nodes(time_s)[0]
    campaign = campaign_of(FEW, base)
    found = stable_together(base, design, node, campaign)
    assert found is not None
    run, deviations = flown_run(base, faults=False), deviations_of(campaign, node)
    flown_to(run, time_s)
    assert len(multiloop(run.packed, design, time_s).axes) == (2 if vehicle == "ksr3" else 3)

    def unstable(u: Array) -> bool:
        packed = pack_flight(deviations.scenario(base, u).scenario)
        loop = multiloop(
            dataclasses.replace(run.packed, parameters=packed.parameters, pool=packed.pool), design, time_s
        )
        poles = loop.poles(range(len(loop.axes)))
        return bool((poles.real[np.abs(poles) > 2.0 * np.pi * LOWEST_HZ] >= 0.0).any())

    corners = [
        np.array(ends) * found.sigmas / 3.0 for ends in itertools.product((-1.0, 1.0), repeat=len(deviations.places))
    ]
    assert not any(unstable(0.99 * corner) for corner in corners)
    assert any(unstable(beyond * corner) for corner in reversed(corners))
