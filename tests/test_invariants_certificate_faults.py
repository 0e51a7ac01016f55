"""The certificate finds faults planted in the simulator.

A few run in every test run, and all under the marker slow. tools/dev/verification/planted_faults.py lists them, and
docs/verification.md has the table.
"""

from __future__ import annotations

import pytest

import maxq
from maxq import LoadedScenario, Node
from maxq.design.certificate.certificate import certify_node
from maxq.design.certificate.response import BANDS
from maxq.sim.scenario.loader import load_scenario
from maxq.tools.dev.verification.planted_faults import FAULTS

QUICK = (
    "mode 2 at the gyro, sign",
    "axial softening left out",
    "hinges 5 cm aft",
    "rate damping, sign",
    "a3 and a4 of the actuator exchanged",
    "delay 1 ms longer",
    "filter not pre-warped",
)


@pytest.fixture(scope="module")
def loaded() -> LoadedScenario:
    return load_scenario("nominal")


@pytest.fixture(scope="module")
def node(loaded: LoadedScenario) -> Node:
    return maxq.nodes(loaded, [40.0])[0]


def test_there_are_many_and_none_is_named_twice() -> None:
    names = [fault.name for fault in FAULTS]
    assert len(names) == len(set(names)) >= 40
    assert set(QUICK) <= set(names)


@pytest.mark.slow
def test_without_a_fault_nothing_is_found(loaded: LoadedScenario, node: Node) -> None:
    assert certify_node(loaded, node, fault=lambda packed: None).unexplained == ()


@pytest.mark.slow
@pytest.mark.parametrize("fault", [f for f in FAULTS if f.name in QUICK], ids=lambda f: f.name)
def test_found(loaded: LoadedScenario, node: Node, fault) -> None:
    assert certify_node(loaded, node, fault=fault.plant, bands=BANDS[:1] + BANDS[2:], names=()).unexplained


@pytest.mark.long
@pytest.mark.parametrize("fault", [f for f in FAULTS if f.name not in QUICK], ids=lambda f: f.name)
def test_found_too(loaded: LoadedScenario, node: Node, fault) -> None:
    assert certify_node(loaded, node, fault=fault.plant).unexplained
