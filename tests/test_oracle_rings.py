"""Ring baffles in the linear model have the describing function at the flown swing.

| quantity | against |
|---|---|
| damping of a plane swing of any amplitude | first harmonic of the simulator's damper, integrated over a cycle |
| equivalent swing of any motion | equal work of damper and linear model over that motion, by quadrature |
| small motion on a large swing | 5/4 in its plane, 5/6 across: averages of the damper's slope |
| swing at an operating point | half the peak-to-peak value in the flight's log |
| plant | the one by d'Alembert's principle with that damping as a constant |
| loop with rings by their law in a held flight | linear loop at the swing flown, 0.2 dB; planted faults are found |
"""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
from oracles.dalembert_plant import dalembert_plant
from oracles.hand_model import planar_of
from oracles.planar.vehicle_at import vehicle_at
from scipy.integrate import quad, simpson
from test_oracle_slosh_waves import GRAVITY_MPS2, OMEGA, swinging

import maxq
from maxq import LoadedScenario, Node
from maxq.design.certificate.certificate import certify_node
from maxq.design.certificate.held_flight import hold
from maxq.design.certificate.response import ring_lines
from maxq.design.model.dispersion import Dispersion
from maxq.design.model.node import at_swing, disperse, equivalent_swing, with_swings
from maxq.sim.packing.flight import Packed
from maxq.sim.run.fly import fly
from maxq.sim.scenario.loader import load_scenario
from maxq.sim.vehicle import state as layout

TURN = np.linspace(0.0, 2.0 * np.pi, 2001)


@pytest.mark.parametrize("swing_deg", [0.05, 1.0, 8.0])
def test_linear_damping_is_the_first_harmonic_of_the_damper(swing_deg: float) -> None:
    swing = math.radians(swing_deg)
    plain, ringed = (
        swinging((0.0, 0.0), damping_ratio=0.0),
        swinging((0.0, 0.0), damping_ratio=0.0, baffles={"width_m": 0.06, "station_m": [5.1]}),
    )
    i = int(layout.pendulum_index(plain.sizes, 0))

    def friction(rate: float) -> float:
        y = plain.y.copy()
        y[i + 5] = rate
        return float((ringed.derivative(y) - plain.derivative(y))[i + 5])

    rate = swing * OMEGA * np.cos(TURN)
    harmonic = simpson([friction(r) for r in rate] * np.cos(TURN), x=TURN) / np.pi
    bobs = vehicle_at(ringed.packed, 0.0, 0.0).pendulums
    bobs = dataclasses.replace(bobs, swing_rad=np.array([swing]))
    assert bobs.damping(GRAVITY_MPS2)[0] > bobs.small_wave_damping(GRAVITY_MPS2)[0] == 0.0
    assert -harmonic / (2.0 * OMEGA * swing * OMEGA) == pytest.approx(bobs.damping(GRAVITY_MPS2)[0], rel=1e-4)


def test_any_motion_is_worth_the_swing_that_takes_as_much_work() -> None:
    """A linear damper of k sqrt(A) does the work of the drag k' v^(3/2), with k' from a plane swing."""
    omega = 7.0
    per_swing = math.pi / quad(lambda x: abs(math.cos(x)) ** 2.5, 0.0, 2.0 * math.pi)[0]  # k' sqrt(omega) / k
    for beat, share, across in ((1.0, 0.0, 0.0), (1.37, 0.7, 0.0), (1.0, 0.0, 1.0), (0.61, 0.4, 0.5)):
        t = np.linspace(0.0, 100.0 * 2.0 * np.pi / omega, 400_001)
        v = 0.1 * omega * np.hypot(np.cos(omega * t) + share * np.cos(beat * omega * t), across * np.sin(omega * t))
        found = equivalent_swing(v, omega)
        drag = per_swing / math.sqrt(omega) * simpson(v**2.5, x=t)
        assert math.sqrt(found) * simpson(v**2, x=t) == pytest.approx(drag, rel=1e-3)
    assert equivalent_swing(np.abs(0.1 * omega * np.cos(TURN[:-1])), omega) == pytest.approx(0.1, rel=1e-4)
    assert equivalent_swing(np.zeros(9), omega) == equivalent_swing(np.array([np.nan]), omega) == 0.0


def test_small_motion_on_a_large_swing() -> None:
    """The slope of |v|^(1/2) v is 3/2 |v|^(1/2) along v and |v|^(1/2) across v, averaged over one cycle."""
    mean = quad(lambda x: abs(math.cos(x)) ** 0.5, 0.0, 2.0 * math.pi)[0] / (2.0 * math.pi)
    own = quad(lambda x: abs(math.cos(x)) ** 2.5, 0.0, 2.0 * math.pi)[0] / math.pi
    assert 1.5 * mean / own == pytest.approx(5.0 / 4.0, rel=1e-6)
    assert mean / own == pytest.approx(5.0 / 6.0, rel=1e-6)


@pytest.fixture(scope="module")
def loaded() -> LoadedScenario:
    return load_scenario("ksr3-ringed")


@pytest.fixture(scope="module")
def node(loaded: LoadedScenario) -> Node:
    return maxq.nodes(loaded, [20.0])[0]


def test_swing_at_a_node_is_that_of_the_flight(loaded: LoadedScenario, node: Node) -> None:
    """A sine at the pendulum frequency moves the liquid with the amplitudes of the log near the operating point."""
    hz = math.sqrt(node.axial_load_mps2 / node.vehicle.pendulums.length_m[0]) / (2.0 * math.pi)
    signal = (
        "injection=[{at='gimbal_command',axis='pitch',kind='sine',amplitude_deg=0.8,frequency_hz="
        f"{hz},start_s=5.0,stop_s=24.0}}]"
    )
    shaken = load_scenario("ksr3-ringed", [signal, "run.duration_s=24", "log.fast_hz=200"])
    flight, swung = fly(shaken), with_swings([node], shaken)[0].vehicle.pendulums
    near = np.abs(flight.time_s("slosh_lox_pitch_deg") - 20.0) < 0.5 / hz
    for k, tank in enumerate(("lox", "jeta1")):
        half = 0.5 * np.ptp(flight[f"slosh_{tank}_pitch_deg"][near])
        assert half > 1.0
        assert math.degrees(swung.swing_rad[k]) == pytest.approx(half, rel=0.1)
        assert swung.swing_rad[k] > 20.0 * node.vehicle.pendulums.swing_rad[k] > 0.0


def test_plant_has_that_damping(node: Node) -> None:
    swung = at_swing(node, np.radians([6.0, 2.0]))
    load, bobs = node.axial_load_mps2, planar_of(swung).pendulums
    constant = dataclasses.replace(bobs, damping_ratio=bobs.damping(load), ring=0.0 * bobs.ring)
    other = dalembert_plant(dataclasses.replace(planar_of(swung), pendulums=constant), node.condition)
    mine = swung.plant
    hz = np.array([0.3, 1.1, 1.4, 1.7, 9.0])
    np.testing.assert_allclose(mine.response(hz), other.response(hz), rtol=1e-8, atol=1e-12)
    assert np.abs(mine.response(hz) / node.plant.response(hz) - 1.0).max() > 0.05
    half = disperse(swung, Dispersion(slosh_damping=0.5)).vehicle.pendulums
    np.testing.assert_allclose(half.damping(load), 0.5 * bobs.damping(load))


def test_vehicle_without_rings_is_not_flown_again() -> None:
    nominal = load_scenario("nominal")
    (plain,) = maxq.nodes(nominal, [20.0])
    assert not plain.vehicle.pendulums.ring.any()
    assert with_swings([plain], nominal)[0] is plain


@pytest.mark.long
def test_certificate_with_rings(loaded: LoadedScenario, node: Node) -> None:
    found = certify_node(loaded, node, names=("gain_up",))
    assert found.unexplained == ()
    assert found.rings
    assert max(abs(line.rings_db) for line in found.rings) > 0.5  # what is compared is not small


@pytest.mark.slow
@pytest.mark.parametrize("factor", [0.8, 1.25])
def test_rings_that_damp_otherwise_are_found(loaded: LoadedScenario, node: Node, factor: float) -> None:
    def fault(packed: Packed) -> None:
        packed.parameters[0].vehicle.slosh.law_factor[:] = factor

    assert loaded.design is not None
    held = hold(loaded, node, fault, rings_by_law=True)
    loop = maxq.loops([hold(loaded, node).node], loaded.design)[0]
    assert any(line.reason for line in ring_lines(held, loop))
