"""Margins of flight code measured without a linear model equal those of the linear loop of the same law.

The C code is the law of ksr3-robust by hand (examples/flight_software). The linear model of that design, which the
measurement does not use, has its exact margins; a planted delay must appear as lost delay margin.
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from flight_code import EXAMPLES, compiled, flies, needs_compiler

import maxq
from maxq import margins
from maxq.design.certificate.certificate import certify_node
from maxq.design.certificate.held_flight import hold
from maxq.design.certificate.measured_only import _rounding_deg, measure_node
from maxq.design.certificate.response import BANDS
from maxq.design.loop.fixed_path import fixed_path
from maxq.sim.packing.flight import Packed
from maxq.sim.scenario.loader import load_scenario

DRIFT_HZ = 0.02  # critical frequencies below it are those of the drift, which gravity moves

pytestmark = [pytest.mark.slow, needs_compiler]
NODE_S = 40.0


@pytest.fixture(scope="module")
def library(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return compiled(tmp_path_factory.mktemp("law"), EXAMPLES / "pd_law.c", "pd_law")


@pytest.mark.long
def test_margins_and_response_are_those_of_the_linear_loop(library: Path) -> None:
    loaded, known = load_scenario("nominal", ["design=", *flies(library=library)]), load_scenario("nominal")
    node = maxq.nodes("nominal", [NODE_S])[0]
    found = measure_node(loaded, node, bands=BANDS[:1])
    assert known.design is not None
    loop = maxq.loops([hold(known, node).node], known.design)[0]
    linear = margins(loop)
    assert found.stable
    assert found.margin("gain_up") == pytest.approx(linear.gain_up_db.value, abs=0.2)
    assert linear.gain_down_db.frequency_hz < DRIFT_HZ  # of the held flight's drift, which is too slow to be seen
    assert found.margin("gain_down") == math.inf
    assert found.margin("delay") == pytest.approx(linear.delay_s.value, rel=0.02)
    ratio = found.response / loop.response(found.lines_hz)
    assert np.abs(20.0 * np.log10(np.abs(ratio))).max() < 0.4
    assert np.abs(np.degrees(np.angle(ratio))).max() < 2.0
    assert {c.kind for c in found.cycles} <= {"decays", "limit cycle"}


@pytest.mark.long
def test_a_limit_cycle_of_the_converter_is_no_growth(library: Path) -> None:
    """A limit cycle is not reported as growth: at 30 s a gyro pulse moves the gimbal after half a minute of rest.

    Its 0.013 deg are less than a tenth of a count. The floor is far below the limits of the gimbal, and zero without
    rounding.
    """
    loaded, node = load_scenario("nominal", ["design=", *flies(library=library)]), maxq.nodes("nominal", [30.0])[0]
    assert measure_node(loaded, node, bands=(), names=()).stable

    held, path = hold(loaded, node), fixed_path(node, "sampled")
    assert 0.013 < _rounding_deg(held, path, 7.0) < 0.5
    assert 0.0 < _rounding_deg(held, path, 0.5) < 0.01
    quiet = load_scenario("nominal", ["design=", "switches.converter=ideal", *flies(library=library)])
    assert _rounding_deg(hold(quiet, node), path, 7.0) == 0.0


@pytest.mark.long
def test_a_planted_delay_is_lost_delay_margin(library: Path) -> None:
    def late(packed: Packed) -> None:
        packed.parameters[0].computer.delay_ns += 5_000_000

    loaded = load_scenario("nominal", ["design=", *flies(library=library)])
    node = maxq.nodes("nominal", [NODE_S])[0]
    sound, faulty = (measure_node(loaded, node, fault=f, bands=(), names=("delay",)) for f in (None, late))
    assert sound.margin("delay") - faulty.margin("delay") == pytest.approx(0.005, abs=0.0005)


def test_with_a_design_the_certificate_compares_flight_code_with_it(library: Path) -> None:
    """The law by hand agrees with its design, and disagrees with the linear loop of another design."""
    node = maxq.nodes("nominal", [NODE_S])[0]
    same = certify_node(load_scenario("nominal", flies(library=library)), node, bands=BANDS[:1], names=("delay",))
    assert same.unexplained == ()
    other = load_scenario("nominal", ["design=designs/ksr3-default.toml", *flies(library=library)])
    assert certify_node(other, node, bands=BANDS[:1], names=()).unexplained
