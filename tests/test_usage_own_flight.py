"""A case is designed until its design passes its own analysis, each axis with the loops of the others closed.

| claim | expected |
|---|---|
| margins of each axis along the design's own flight, others closed | the limits of the case, by `multiloop_margins` |
| limits that hold between the operating points | also every 0.25 s of the design's own flight |
| limits that the design states | those of the case, not the tighter ones of the search |
| a limit that no design meets with the other axes closed | named; the design is that of the round before |
| a limit that the roll loop misses | named; no further round |
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import optimise_kit as kit
import pytest

import maxq
from maxq import multiloop_margins
from maxq.design.case.basis import stated_basis
from maxq.design.verify import own_flight
from maxq.design.verify.judging import Check, judge, multiloop_checks
from maxq.design.verify.own_flight import design_case, with_design

TIMES_S = (15.0, 55.0)
CASE = (f"nodes_s={list(TIMES_S)}", "loop=sampled", "filter.structure=F2", "search.starts=1", "search.leaps=0")


@pytest.mark.long
def test_a_design_keeps_its_limits_with_the_other_axes_closed() -> None:
    """The phase margin is at its limit at 55 s: the search has a tighter limit, and the design states the case's."""
    made = design_case(kit.case(*CASE))
    assert made.feasible
    scenario = with_design(kit.case(*CASE).scenario, made.design)
    found = [multiloop_margins(loop) for loop in maxq.multiloops(scenario, made.design, TIMES_S)]
    assert [m.axes for m in found] == [("pitch", "yaw")] * 2
    gains, phases = ([margin(one) for m in found for one in m.each] for margin in (_gain_db, _phase_deg))
    assert min(gains) == pytest.approx(6.0, abs=0.005)
    assert min(gains) >= 6.0 - 5e-4
    assert min(phases) == pytest.approx(30.0, abs=0.01)
    assert min(phases) >= 30.0 - 5e-4

    first, *_, last = made.rounds
    assert first.tightened == ()
    assert "along its own flight phase margin, pitch, other axes closed missed by" in first.text
    assert any(text.startswith("limit on phase margin raised by 0.02") for text in last.tightened)
    assert last.text.endswith("its own flight agrees")
    ((outcome, solution),) = made.results
    alone = next(c for c in outcome.found if c.key == "phase_margin_deg")
    assert alone.values[alone.worst] == pytest.approx(30.022, abs=0.003)
    basis = stated_basis(made.design)
    assert basis is not None
    assert (basis.limits.phase_margin_deg, basis.limits.gain_margin_db) == (30.0, 6.0)
    assert (solution.case.limits.phase_margin_deg, solution.case.limits.gain_margin_db) == (30.0, 6.0)


@pytest.mark.long
def test_limits_that_hold_between_the_points_hold_at_the_instants_of_the_own_flight() -> None:
    """The limits hold every 0.25 s, for each axis alone and with the others closed."""
    given = (*(c for c in CASE if not c.startswith("nodes_s")), "nodes_s=[45.0, 55.0]", "between_nodes='hold'")
    loaded = kit.case(*given)
    made = design_case(loaded)
    assert made.feasible
    scenario, times_s = with_design(loaded.scenario, made.design), np.arange(45.0, 55.01, 0.25)
    together = [multiloop_margins(loop) for loop in maxq.multiloops(scenario, made.design, times_s)]
    alone = [j.margins for j in judge(maxq.nodes(scenario, times_s), made.design)]
    every = [*alone, *(one for m in together for one in m.each)]
    assert min(map(_gain_db, every)) == pytest.approx(6.0, abs=0.02)
    assert min(map(_gain_db, every)) >= 6.0 - 5e-4
    assert min(map(_phase_deg, every)) >= 30.0 - 5e-4


@pytest.mark.long
def test_a_limit_that_no_design_meets_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    _with_less(monkeypatch, "coupled_yaw_gain_margin_db", 6.0)
    made = design_case(kit.case(*CASE))
    ((outcome, solution),) = made.results
    assert (made.feasible, solution.feasible) == (False, True)
    assert any(text.startswith("gain margin, yaw, other axes closed missed by ") for text in outcome.missed)
    assert made.rounds[-1].tightened[-1] == "without a design that meets this, so that the last one stays"
    assert min(_gain_db(j) for j in (one.margins for one in outcome.judged)) == pytest.approx(6.0, abs=0.05)


@pytest.mark.slow
def test_what_the_roll_loop_misses_takes_no_further_round(monkeypatch: pytest.MonkeyPatch) -> None:
    _with_less(monkeypatch, "coupled_roll_gain_margin_db", 6.0, of="coupled_yaw_gain_margin_db")
    made = design_case(kit.case(*CASE, "limits.phase_margin_deg=20", "limits.gain_margin_db=5"))
    assert (made.feasible, len(made.rounds)) == (False, 1)
    assert [text.partition(" missed")[0] for text in made.results[0][0].missed] == ["gain margin, roll"]


def _with_less(monkeypatch: pytest.MonkeyPatch, key: str, less_db: float, of: str = "") -> None:
    """Reduce a margin with the other axes closed by some dB; `of`: the check that represents it."""

    def measured(*arguments: Any) -> list[Check]:
        found = multiloop_checks(*arguments)
        changed = next(c for c in found if c.key == (of or key))
        text = "gain margin, roll" if of else changed.text
        return [
            *(c for c in found if c.key != key),
            replace(changed, key=key, text=text, values=changed.values - less_db),
        ]

    monkeypatch.setattr(own_flight, "multiloop_checks", measured)


def _gain_db(margins: Any) -> float:
    return float(margins.gain_db)


def _phase_deg(margins: Any) -> float:
    return float(margins.phase_deg.value)
