"""The margin budget adds up for any order, kind of loop, operating point and frequency.

| case | expected |
|---|---|
| sum of all shares | L in decibels and degrees to 1e-9, at every operating point, kind and crossing |
| shares of parts in series | the response of the part; a delay of more than 180 deg is unwrapped |
| build-up steps in another order | other shares, the same sum |
| frozen liquid | the stability derivatives of the whole |
| a vehicle without liquid, modes, lift, engine inertia | a share of zero |
"""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from design_nodes import TIMES_S, design, node_at, published_at, without
from hypothesis import given, settings
from hypothesis import strategies as st

from maxq import Node, margins
from maxq.control.kernel.records import Array
from maxq.design.loop.fixed_path import fixed_path
from maxq.design.loop.loop import close_loop
from maxq.design.margins.budget import crossing_budgets, loop_budget, split
from maxq.design.model.vehicle_at import without_engine_inertia
from maxq.design.paper.errata import PAPER

KINDS = "sampled", "pade", "exact"
BUILD_UP = "rigid body", "aerodynamics", "slosh", "engine inertia", "bending"

ROUNDING = 1e-9  # dB, degrees: a dozen factors, each good to some 1e-12 of its resonances' sharpness


def share_of(budget, part: str):
    return next(share for share in budget.shares if share.part == part)


def closed(node: Node, kind: str = "sampled"):
    return close_loop(fixed_path(node, kind), design())


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("time_s", TIMES_S[::3])
def test_the_budget_closes_at_every_crossing(time_s, kind):
    loop = closed(node_at(time_s), kind)
    measured = margins(loop, resonances=loop.fixed.resonances())
    budgets = crossing_budgets(loop, measured)
    assert {"crossover", "phase margin", "upper gain margin"} <= set(budgets)
    for budget in budgets.values():
        assert abs(budget.left_db) < ROUNDING
        assert abs(budget.left_deg) < ROUNDING
    assert budgets["crossover"].gain_db == pytest.approx(0.0, abs=1e-8)
    assert abs(budgets["phase margin"].phase_margin_deg) == pytest.approx(measured.phase_deg.value, abs=1e-8)
    assert budgets["upper gain margin"].gain_db == pytest.approx(-measured.gain_up_db.value, abs=1e-8)


def test_shares_of_delay_hold_and_converter_are_their_closed_forms():
    node = node_at(40.0)
    loop = closed(node, "exact")
    f = 8.0
    (budget,) = loop_budget(loop, [f])
    timing = node.instruments
    assert share_of(budget, "delay").phase_deg == pytest.approx(-360.0 * f * timing.delay_s, abs=1e-9)
    assert share_of(budget, "hold").phase_deg == pytest.approx(-180.0 * f * timing.sample_s, abs=1e-9)
    assert share_of(budget, "V/F").gain_db == pytest.approx(20.0 * np.log10(np.sinc(f * timing.sample_s)), abs=1e-9)
    assert [share.part for share in budget.shares[-len(BUILD_UP) :]] == list(BUILD_UP)
    assert [share.part for share in budget.shares[:2]] == ["law", "filter"]


def test_an_absent_effect_has_no_share():
    node = without(node_at(20.0), modes=True, tanks=True)
    node = dataclasses.replace(node, held=without_engine_inertia(node.held))
    (budget,) = loop_budget(closed(node, "pade"), [1.0])
    for part in ("slosh", "engine inertia", "bending"):
        share = share_of(budget, part)
        assert (share.gain_db, share.phase_deg) == pytest.approx((0.0, 0.0), abs=1e-12)
    assert abs(share_of(budget, "aerodynamics").gain_db) > 0.1


def test_frozen_liquid_keeps_mass_cg_and_inertia():
    node = node_at(20.0)
    frozen = dict(node.steps())["aerodynamics"]
    assert not frozen.vehicle.pendulums.mass_kg.any()
    ours, whole = (dataclasses.asdict(n.derivatives) for n in (frozen, node))
    assert ours == pytest.approx(whole, rel=1e-10)


def test_the_printed_model_has_a_budget_too():
    node = published_at(30.0).with_errata(PAPER)
    for budget in loop_budget(closed(node, "pade"), [0.3, 1.0, 9.0]):
        assert abs(budget.left_db) < ROUNDING
        assert abs(budget.left_deg) < ROUNDING


def test_a_cut_has_no_budget():
    path = fixed_path(node_at(20.0), "pade", "rate_command_to_q")
    with pytest.raises(ValueError, match="rate_command_to_q"):
        loop_budget(close_loop(path, design()), [1.0])


# --- any parts ----------------------------------------------------------------------------------------------------


def lag(pole: float, gain: float, delay: float):
    def response(f: Array) -> np.ndarray:
        s = 2j * np.pi * f
        return np.asarray(gain * pole / (s + pole) * np.exp(-s * delay))

    return response


PARTS = st.lists(
    st.builds(lag, st.floats(0.1, 100.0), st.floats(0.01, 50.0), st.floats(0.0, 0.5)), min_size=1, max_size=5
)


@settings(max_examples=60, deadline=None)
@given(PARTS, PARTS, st.floats(0.01, 20.0), st.randoms(use_true_random=False))
def test_any_budget_closes_whatever_the_order(series, stages, f, random):
    def whole(x: Array) -> np.ndarray:
        return np.asarray(np.prod([part(x) for part in series], axis=0) * stages[-1](x))

    def budget(parts, steps):
        named = [(f"part {k}", part) for k, part in enumerate(parts)]
        return split(whole, [f], named, [(f"stage {k}", step) for k, step in enumerate(steps)])[0]

    first = budget(series, stages)
    mixed = stages[:-1]
    random.shuffle(mixed)
    second = budget(random.sample(series, len(series)), [*mixed, stages[-1]])
    for one in (first, second):
        assert abs(one.left_db) < 1e-11
        assert abs(one.left_deg) < 1e-9
    assert first.gain_db == pytest.approx(second.gain_db, abs=1e-10)
    assert (
        first.phase_margin_deg == pytest.approx(second.phase_margin_deg, abs=1e-8)
        or abs(abs(first.phase_margin_deg - second.phase_margin_deg) - 360.0) < 1e-8
    )


def test_the_phase_of_a_long_delay_is_unwrapped():
    (share,) = split(lag(1e6, 1.0, 0.7), [3.0], [("delay", lag(1e6, 1.0, 0.7))])[0].shares
    assert share.phase_deg == pytest.approx(-360.0 * 3.0 * 0.7, abs=0.01)


def test_a_part_that_is_zero_is_refused():
    with pytest.raises(ValueError, match=r"budget at 1 Hz: notch is 0j there"):
        split(lag(1.0, 1.0, 0.0), [1.0], [("notch", lambda f: np.zeros(f.shape, complex))])
