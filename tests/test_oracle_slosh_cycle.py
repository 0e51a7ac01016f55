"""Slosh limit cycles predicted by the linear loop and a baffle's law equal flights of the nonlinear simulator.

| quantity | against |
|---|---|
| Miles's damping of a ring baffle | the formula of SP-106 at a separate wave |
| swing of the pendulum for a wave at the wall | equal moments of liquid and pendulum, integrated over the surface |
| final swing of the slosh, from below and from above | the predicted one: 5 % |
| growth with half the required damping | the linear loop's root: 2 % of the effect of damping |
| without baffles | unbounded: the gimbal is far from its limits while the liquid swings through a right angle |
"""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.special import j1

import maxq
from maxq import LoadedScenario
from maxq.design.certificate.held_flight import hold
from maxq.design.certificate.measured_margins import burst_test, limit_cycle, measured_growth
from maxq.design.model.dispersion import Dispersion
from maxq.design.model.node import disperse
from maxq.design.verify.slosh import Baffle, advise, confirm, fly_cycle
from maxq.sim.packing.flight import Packed
from maxq.sim.scenario.loader import load_scenario

TANK, TIME_S = 1, 55.0
MIDWAY = Baffle(depth_r=0.5, cover=0.25)
SWING_PER_WAVE = (1.841184**2 - 1.0) / 2.0  # rad; from the first root of J1', for a wave as high as the radius
TWO_PHASE = 'design="designs/ksr3-two-phase.toml"'


@pytest.fixture(scope="module")
def loaded() -> LoadedScenario:
    return load_scenario("nominal", [TWO_PHASE])


@pytest.fixture(scope="module")
def held(loaded: LoadedScenario):
    return hold(loaded, maxq.nodes(loaded, [TIME_S])[0])


@pytest.fixture(scope="module")
def advice(loaded: LoadedScenario, held):
    assert loaded.design is not None
    return next(a for a in advise([held.node], loaded.design) if a.tank == TANK)


def _edge_hz(held, share: float) -> tuple[float, float]:
    """Return frequency (Hz) and growth (1/s) of the linear loop with a fraction of the tank's damping."""
    assert held.loaded.design is not None
    weak = disperse(held.node, Dispersion(slosh_damping=(1.0, share)))
    poles = maxq.loops([weak], held.loaded.design)[0].closed_poles()
    ringing = poles[(poles.imag > 0.5) & (poles.imag < 31.0)]
    pole = ringing[int(np.argmax(ringing.real))]
    return float(pole.imag) / (2.0 * math.pi), float(pole.real)


def test_baffle_has_the_damping_of_its_formula() -> None:
    ring = Baffle(depth_r=0.2, cover=0.1)
    wave_r = 0.03
    damping = 2.83 * math.exp(-0.92) * 0.1**1.5 * math.sqrt(wave_r)
    assert ring.wave_m(damping, 0.5) == pytest.approx(0.5 * wave_r)
    assert ring.damping(math.radians(ring.swing_deg(damping))) == pytest.approx(damping)


def test_pendulum_has_the_moment_of_the_wave() -> None:
    """rho pi R^3 eta J2 ..., by quadrature of the mode J1(xi r / R), equals m L theta with SP-106's mass and length."""
    xi, depth = 1.84118, 0.8  # of the radius, which is 1, as are density and wave
    moment = math.pi * quad(lambda r: j1(xi * r) / j1(xi) * r * r, 0.0, 1.0)[0]
    mass = math.pi * 2.0 * math.tanh(xi * depth) / (xi * (xi * xi - 1.0))
    length = 1.0 / (xi * math.tanh(xi * depth))
    assert moment / (mass * length) == pytest.approx(SWING_PER_WAVE, rel=1e-4)


@pytest.mark.slow
@pytest.mark.parametrize("level", [1.0, 0.03], ids=["from above", "from below"])
def test_slosh_ends_at_the_predicted_swing(held, advice, level: float) -> None:
    hz, _ = _edge_hz(held, advice.needed / advice.damping)
    found = fly_cycle(held, TANK, MIDWAY, hz, level)
    assert found.settled
    assert advice.midway_deg == pytest.approx(2.2, abs=0.1)
    assert found.swing_deg == pytest.approx(advice.midway_deg, rel=0.05)


@pytest.mark.slow
def test_a_ring_twice_as_good_halves_the_root_of_the_swing(held, advice) -> None:
    """Damping grows with the root of the wave, so with a ring twice as effective the swing is a quarter."""
    hz, _ = _edge_hz(held, advice.needed / advice.damping)
    twice = Baffle(MIDWAY.depth_r, MIDWAY.cover * 2.0 ** (2.0 / 3.0))
    assert fly_cycle(held, TANK, twice, hz).swing_deg == pytest.approx(0.25 * advice.midway_deg, rel=0.1)


@pytest.mark.slow
def test_advice_is_confirmed(loaded: LoadedScenario, advice) -> None:
    flown = confirm(loaded, maxq.nodes(loaded, [TIME_S])[0], advice)
    assert flown.flown_deg == pytest.approx(advice.midway_deg, rel=0.05)
    assert abs(flown.flown_growth_1ps) < 0.003


def _with(held, damping: float):
    def fault(packed: Packed) -> None:
        packed.parameters[0].vehicle.slosh.damping_ratio[TANK] = damping

    return dataclasses.replace(held, fault=fault)


def test_slosh_with_too_little_damping_grows_as_fast_as_the_linear_loop_says(held, advice) -> None:
    assert held.loaded.design is not None
    hz, growth = _edge_hz(held, 0.5 * advice.needed / advice.damping)
    loop = maxq.loops([held.node], held.loaded.design)[0]
    flown = measured_growth(_with(held, 0.5 * advice.needed), loop, burst_test(hz))
    assert growth > 0.01
    assert flown == pytest.approx(growth, abs=0.02 * 2.0 * math.pi * hz * 0.5 * advice.needed + 5e-4)


def test_without_baffles_no_limit_of_the_loop_ends_slosh(held, advice) -> None:
    hz, _ = _edge_hz(held, 0.5 * advice.needed / advice.damping)
    found = limit_cycle(_with(held, 0.5 * advice.needed), hz)
    assert found.slosh_deg > 80.0  # no liquid does: waves break long before
    assert found.gimbal_deg < 2.0  # of 6; at 1.2 Hz the servo's 30 deg/s are reached at 4 deg
