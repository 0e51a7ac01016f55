"""Each key of a loop quantity has one meaning in cases, suites, judge, margin sweep and optimiser.

| item | against |
|---|---|
| keys of cases and suites | the table |
| values of the judge | those of simverify's linear part, and `Margins` |
| a loop without bending modes | limits on modes that it lacks |
| an earlier key | the hint that names the present one |
"""

from __future__ import annotations

import math

import pytest

import maxq
from maxq import ScenarioError
from maxq.design.case.basis import Limits
from maxq.design.case.schema import read_case
from maxq.design.margins import many
from maxq.design.margins.measured_loop import measure_loop
from maxq.design.optimise import criteria
from maxq.design.quantities import MEASURED, QUANTITIES, SWEPT, CommonLimits, Convention, LoopLimits
from maxq.design.verify.judging import Wanted, checks, judge
from maxq.design.verify.linear import measured
from maxq.design.verify.suite import LinearMargins, read_suite
from maxq.sim.scenario.loader import load_scenario

ASKED = Limits(modulus_db=-8.0, first_mode_db=20.0, modes_from_2_db=0.0, modes_from_3_db=0.0, first_mode_phase_deg=45.0)


def test_every_key_is_in_the_table() -> None:
    assert set(LoopLimits.model_fields) - {"slosh_peak_db", "rigid_body"} == set(MEASURED)
    settings = {"without", "rigid_body"}
    assert set(Limits.model_fields) - settings <= set(QUANTITIES)
    assert set(CommonLimits.model_fields) == set(Limits.model_fields) & set(LoopLimits.model_fields) - settings
    assert [name.replace("delay_s", "delay_ms") for name in many.MEASURES.names or ()][: len(SWEPT)] == list(SWEPT)
    of_law = {"rigid_hz", "rigid_zeta"}
    assert {limit.key for limit in criteria.LIMITS} == set(CommonLimits.model_fields) - of_law | {"zone"}
    labels = [about.label for about in QUANTITIES.values()]
    assert len(set(labels)) == len(labels)


def test_judge_and_suite_measure_the_same() -> None:
    scenario = load_scenario("nominal")
    assert scenario.design is not None
    nodes = maxq.nodes(scenario, [40.0])
    found = {c.key: c for c in checks(judge(nodes, scenario.design), scenario.design, Wanted.of(ASKED))}
    loop = maxq.loops(nodes, scenario.design)[0]
    theirs, m = measured(loop, -6.0), measure_loop(loop).margins
    assert set(found) == {"unstable_poles", "filter_gain_at_infinity", *CommonLimits.model_fields}
    for key in CommonLimits.model_fields:
        assert found[key].values[0] == theirs[key]
        assert found[key].text == MEASURED[key].label
    peaks = {lobe.label: lobe.peak_db for lobe in m.lobes if lobe.kind == "bending"}
    assert (theirs["first_mode_db"], theirs["second_mode_db"]) == (peaks["bending 1"], peaks["bending 2"])
    assert theirs["modes_from_3_db"] == peaks["bending 3"]
    assert theirs["modes_from_2_db"] == max(peaks["bending 2"], peaks["bending 3"])
    assert theirs["gain_down_db"] == m.gain_down_db.value <= m.aero_gain_db.value
    assert theirs["gain_margin_db"] == min(theirs["gain_up_db"], theirs["gain_down_db"])
    assert theirs["phase_margin_deg"] == m.phase_deg.value <= theirs["rigid_phase_deg"] == m.rigid_phase_deg.value
    assert theirs["modulus_db"] == pytest.approx(20.0 * math.log10(m.modulus))


def test_modes_that_do_not_exist_miss_no_limit() -> None:
    scenario = load_scenario("nominal", ["switches.bending=false"])
    assert scenario.design is not None
    judged = judge(maxq.nodes(scenario, [40.0]), scenario.design)
    assert judged[0].margins.stable
    assert judged[0].quantities(Convention())["first_mode_phase_deg"] == math.inf
    found = {c.key: c for c in checks(judged, scenario.design, Wanted.of(ASKED))}
    for key in ("first_mode_phase_deg", "first_mode_db", "second_mode_db", "modes_from_2_db", "modes_from_3_db"):
        assert found[key].passed


@pytest.mark.parametrize(
    ("old", "new"),
    [("aero_gain_db", "gain_down_db"), ("phase_deg", "rigid_phase_deg"), ("higher_modes_db", "modes_from_2_db")],
)
def test_an_earlier_key_of_a_suite_is_answered_by_the_present_one(old: str, new: str) -> None:
    with pytest.raises(ScenarioError, match=rf"margins.nominal.{old} = 6.0: is now {new}"):
        read_suite("standard", [f"margins.nominal.{old}=6.0"])


def test_an_earlier_key_of_a_case_is_answered_by_the_present_one() -> None:
    with pytest.raises(ScenarioError, match=r"limits.higher_modes_db = -6.0: is now modes_from_3_db"):
        read_case("ksr3-identical", ["limits.higher_modes_db=-6.0"])


def test_a_limit_that_the_sweep_does_not_measure_is_refused() -> None:
    with pytest.raises(ScenarioError, match=r"margins.dispersed.modulus_db = -6.0: is not measured of dispersed"):
        read_suite("standard", ["margins.dispersed.modulus_db=-6.0"])
    assert LinearMargins(dispersed=LoopLimits(delay_ms=5.0)).dispersed.delay_ms == 5.0
