"""The worst instant between operating points equals that from phases of L every tenth of a second."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np
import pytest

import maxq
from maxq import Node
from maxq.design.loop.fixed_path import fixed_path
from maxq.design.loop.loop import close_loop
from maxq.design.quantities import MEASURED, LoopLimits
from maxq.design.verify import linear
from maxq.design.verify.linear import measured, worst_instants
from maxq.sim.scenario.loader import load_scenario

WORSE = {"dB": 0.02, "deg": 0.1, "ms": 0.05, "Hz": 0.002, "": 0.005}  # a worse instant has more than this
SCENARIO = load_scenario("nominal", ['design="designs/ksr3-linear.toml"'])


def nodes_at(times_s: Sequence[float]) -> list[Node]:
    return maxq.nodes(SCENARIO, times_s)


def least_phase_deg(node: Node) -> float:
    """Return the least phase margin over the crossings of |L| = 1 from 0.1 to 4 Hz: rigid body and both tanks."""
    assert SCENARIO.design is not None
    loop = close_loop(fixed_path(node), SCENARIO.design)
    f = np.linspace(0.1, 4.0, 40_000)
    values = loop.response(f)
    size = np.log(np.abs(values))
    k = np.flatnonzero((size[1:] > 0.0) != (size[:-1] > 0.0))
    return float(np.abs(np.degrees(np.angle(-values[k]))).min())


@pytest.mark.slow
def test_the_worst_instant_is_found_and_becomes_a_node() -> None:
    """The phase margin is 30.1 deg at 50 and at 55 s, and 22 deg between, where the peak of LOX slosh passes 0 dB."""
    limits = LoopLimits(rigid_phase_deg=30.0)
    assert SCENARIO.design is not None
    found = worst_instants(nodes_at, SCENARIO.design, [50.0, 55.0], limits)
    assert len(found) == 1
    every = np.arange(50.0, 55.01, 0.1).round(3).tolist()
    phases = [least_phase_deg(node) for node in nodes_at([*every, found[0]])]
    assert 21.0 < phases[-1] < 23.0
    assert phases[-1] < min(phases[0], phases[-2]) - 5.0
    assert phases[-1] < min(phases[:-1]) + 0.02
    assert worst_instants(nodes_at, SCENARIO.design, [50.0, found[0], 55.0], limits) == []
    assert found[0] == pytest.approx(every[int(np.argmin(phases[:-1]))], abs=0.1)


def test_no_instant_is_added_where_the_nodes_are_the_worst() -> None:
    assert SCENARIO.design is not None
    assert worst_instants(nodes_at, SCENARIO.design, [54.0], LoopLimits(rigid_phase_deg=30.0)) == []
    assert worst_instants(nodes_at, SCENARIO.design, [50.0, 55.0], LoopLimits()) == []


@pytest.mark.parametrize(("name", "just_worse"), [("gain_up_db", 0.02), ("rigid_phase_deg", 0.1), ("delay_ms", 0.05)])
def test_an_instant_becomes_a_node_from_what_is_documented_on(
    name: str, just_worse: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """An instant becomes an operating point from 0.02 dB, 0.1 deg or 0.05 ms.

    The example is a margin of 10 that dips between the points.
    """
    none: Any = None
    for depth, wanted in ((0.9 * just_worse, []), (1.1 * just_worse, [43.21])):
        monkeypatch.setattr(linear, "Loop", lambda time_s, law: time_s)
        monkeypatch.setattr(linear, "fixed_path", lambda time_s: time_s)
        monkeypatch.setattr(linear, "law_at", lambda design, node: None)
        dip = partial(lambda depth, t, peak: {name: 10.0 - depth * max(1.0 - abs(t - 43.21) / 2.0, 0.0)}, depth)
        monkeypatch.setattr(linear, "measured", dip)
        found = worst_instants(list, none, [40.0, 47.0], LoopLimits(**{name: 5.0}))
        assert found == pytest.approx(wanted, abs=0.01)


@pytest.mark.long
def test_all_margins_that_are_asked_for_are_searched() -> None:
    """Each instant is worse in one margin than every operating point, and no tenth of a second is worse."""
    limits = LoopLimits(gain_up_db=6.0, rigid_phase_deg=30.0, delay_ms=10.0, slosh_phase_deg=30.0, modes_from_2_db=-6.0)
    asked = [name for name in MEASURED if getattr(limits, name) is not None]
    assert SCENARIO.design is not None
    design, times_s = SCENARIO.design, [40.0, 47.0, 55.0]
    found = worst_instants(nodes_at, design, times_s, limits)
    assert 1 <= len(found) <= len(asked)

    def table(at_s: Sequence[float]) -> np.ndarray:
        rows = [measured(close_loop(fixed_path(node), design), limits.slosh_peak_db) for node in nodes_at(at_s)]
        return np.array([[MEASURED[name].badness(row[name]) for name in asked] for row in rows])

    ends, ours = table(times_s).max(axis=0), table(found)
    room = np.array([WORSE[MEASURED[name].unit] for name in asked])
    assert (ours > ends + room).any(axis=1).all()
    dense = table(np.arange(40.0, 55.01, 0.1).round(3).tolist()).max(axis=0)
    assert (np.maximum(ours.max(axis=0), ends) >= dense - 2.0 * room).all()
