"""Margins are right without gain, without a crossing, with poles on the axis and with named lobes."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from design_nodes import TIMES_S, design, node_at, without
from textbook_loops import ModalLoop, TransferLoop

from maxq import Margins, margins
from maxq.design.loop.fixed_path import fixed_path
from maxq.design.loop.loop import close_loop
from maxq.design.loop.resonance import Resonance
from maxq.design.margins.distances import Zone


def resonance(kind: str, number: int, omega: float, zeta: float) -> Resonance:
    pole = complex(-zeta * omega, omega * np.sqrt(1.0 - zeta**2))
    return Resonance(kind, number, pole.imag / (2.0 * np.pi), pole)


def numbers(m: Margins) -> list[float]:
    bounds = (m.gain_up_db, m.gain_down_db, m.phase_deg, m.delay_s, m.aero_gain_db, m.rigid_gain_db, m.rigid_phase_deg)
    disks = (m.disks.sensitivity, m.disks.complementary, m.disks.symmetric)
    return [
        *(bound.value for bound in bounds),
        *(value for disk in disks for value in dataclasses.astuple(disk)),
        *(c.value for c in m.clearances),
        m.modulus,
        m.crossover_hz,
    ]


def test_no_gain_has_no_end():
    m = margins(TransferLoop([0.0], [1.0, 1.0]))
    assert m.stable
    assert (m.gain_up_db.value, m.gain_down_db.value, m.phase_deg.value, m.delay_s.value) == (np.inf,) * 4
    assert (m.modulus, m.disks.complementary.size, m.disks.symmetric.size) == (1.0, np.inf, 2.0)


def test_no_crossing_at_all():
    m = margins(TransferLoop([0.5], [1.0, 1.0]))
    assert (m.gain_up_db.value, m.phase_deg.value, m.delay_s.value) == (np.inf, np.inf, np.inf)
    assert m.modulus == pytest.approx(1.0)


def test_an_unstable_loop_shows_no_margin_but_how_far_it_is():
    """The loop (s + 0.8) / 2 / (s^2 - 1) has the closed-loop polynomial s^2 + s/2 - 0.6 and no margins."""
    m = margins(TransferLoop([0.5, 0.4], [1.0, 0.0, -1.0]))
    growth = -0.25 + np.sqrt(0.0625 + 0.6)
    assert (m.stable, m.unstable_poles, m.encircled_poles) == (False, 1, 1)
    assert m.growth_1ps == pytest.approx(growth)
    assert m.growth_time_s == pytest.approx(1.0 / growth)
    assert np.isnan(numbers(m)).all()
    assert not any(value >= limit for value in numbers(m) for limit in (-np.inf, 0.0, 6.0))
    assert len(m.gain_crossings.frequency_hz) == 0
    assert len(m.phase_crossings.frequency_hz) == 1


def test_a_list_of_poles_that_contradicts_the_curve_is_not_believed():
    loop = TransferLoop([2.0], [1.0, 0.0, -1.0, 0.0], delay_s=1e-9, rightmost=[-1.0])
    m = margins(loop)
    assert m.unstable_poles == 0
    assert m.encircled_poles > 0
    assert not m.stable
    assert np.isnan(m.phase_deg.value)


def test_a_closed_loop_pole_on_the_axis_is_not_stable():
    m = margins(TransferLoop([8.0], [1.0, 3.0, 3.0, 1.0]))
    assert not m.stable


@pytest.mark.parametrize("zeta", [0.0, 1e-12, 1e-10, 1e-8, 1e-5])
@pytest.mark.parametrize(("rate", "unstable"), [(0.05, 0), (-0.05, 2)])
def test_an_undamped_mode_is_passed_on_the_right(zeta, rate, unstable):
    """A mode without damping, driven in and out of phase with its rate on a damped lag, is passed on the right."""
    loop = ModalLoop.of([(-1.0, 2.0)], [(7.0, zeta, rate, 0.0)])
    m = margins(loop)
    assert (m.unstable_poles, m.encircled_poles) == (unstable, unstable)
    assert m.stable == (unstable == 0)


def test_two_undamped_modes_at_one_frequency():
    for rates, unstable in (((0.1, 0.2), 0), ((-0.1, -0.2), 2)):
        loop = ModalLoop.of([], [(7.0, 0.0, rate, 0.0) for rate in rates])
        # one combination of the two is not seen and stays on the axis
        m = margins(loop)
        assert m.encircled_poles == unstable
        assert not m.stable


def test_hidden_integrators_are_drift():
    """A pole at zero that a zero hides is in both lists of poles and is not an instability."""
    m = margins(TransferLoop(np.array([2.0, 0.0]), [1.0, 3.0, 3.0, 1.0, 0.0]))
    assert m.stable
    assert m.gain_up_db.value == pytest.approx(20.0 * np.log10(4.0), abs=1e-7)


@pytest.mark.parametrize("level", [0.5, 0.99, 1.5, -0.5, -1.5])
def test_a_loop_that_stays_level(level):
    """For (level s + 1) / (s + 1), |L| tends to |level|: at 1 or above no delay is tolerated, at -1 or below L is
    unstable.
    """
    m = margins(TransferLoop([level, 1.0], [1.0, 1.0]))
    assert m.stable == (level > -1.0)
    if level == -0.5:
        assert m.gain_up_db.value == pytest.approx(20.0 * np.log10(2.0), abs=1e-6)
        assert m.gain_up_db.frequency_hz == np.inf
    if m.stable:
        assert (m.delay_s.value == 0.0) == (level > 1.0)


@pytest.mark.parametrize("order", [1, 2])
def test_an_improper_loop_is_refused(order):
    with pytest.raises(ValueError, match="improper"):
        margins(TransferLoop([1.0, *[0.0] * (order + 1)], [1.0, 1.0]))


class Odd:
    """A loop with invalid results."""

    highest_hz = 50.0

    def __init__(self, poles=(-1.0,), width=1, value=1.0):
        self.poles, self.width, self.value = poles, width, value

    def response(self, frequencies_hz):
        return np.full(len(frequencies_hz) * self.width, self.value, complex)

    def open_poles(self):
        return np.array(self.poles, complex)

    closed_poles = open_poles

    def factors(self):
        return None


def test_bad_answers_are_named():
    with pytest.raises(ValueError, match=r"shape \(4,\), not \(2,\)"):
        margins(Odd(width=2))
    with pytest.raises(ValueError, match="open-loop poles are not numbers"):
        margins(Odd(poles=(np.nan,)))
    for value in (np.nan, np.inf):
        with pytest.raises(ValueError, match=r"response at 1e-05 Hz is \(?(nan|inf)"):
            margins(Odd(value=value))
    for lowest_hz in (0.0, -1.0, 50.0, np.nan):
        with pytest.raises(ValueError, match="lowest_hz"):
            margins(Odd(), lowest_hz=lowest_hz)


@pytest.mark.parametrize(("shape", "phase", "gain"), [("disk", 30, 6), ("diamond", 0, 6), ("ellipse", 30, np.nan)])
def test_zones_that_are_none(shape, phase, gain):
    with pytest.raises(ValueError, match="zone"):
        Zone(shape, phase, gain)


# --- lobes --------------------------------------------------------------------------------------------------------


def test_lobes_are_named_and_judged():
    """A loop with a phase-stabilised mode at 7 rad/s and a gain-stabilised one at 20 rad/s has both by name."""
    parts = [(7.0, 0.005, 0.05, 0.0), (20.0, 0.01, -0.012, 0.0)]
    loop = ModalLoop.of([(-1.0, 2.0)], parts)
    named = [resonance("bending", 1, 7.0, 0.005), resonance("bending", 2, 20.0, 0.01), resonance("gyro", 0, 3.0, 0.2)]
    m = margins(loop, resonances=named)
    first, second = m.lobes
    assert (first.label, second.label) == ("bending 1", "bending 2")
    # at the pole the mode alone is rate omega / (2 zeta omega): 5 on the positive axis, 0.6 on the negative one
    assert (first.stabilised, second.stabilised) == ("phase", "gain")
    assert first.peak_db == pytest.approx(20.0 * np.log10(5.0), abs=0.5)
    assert abs(first.peak_phase_deg) == pytest.approx(180.0, abs=10.0)
    assert first.gain_up_db == first.gain_down_db == np.inf
    assert not first.conditional
    assert 60.0 < first.phase_deg < 130.0
    crossings = m.gain_crossings
    inside = (crossings.frequency_hz > first.low_hz) & (crossings.frequency_hz < first.high_hz)
    assert inside.sum() == 2
    assert first.phase_deg == pytest.approx(np.abs(crossings.phase_margin_deg[inside]).min())
    assert second.phase_deg == np.inf
    assert second.gain_up_db == pytest.approx(-20.0 * np.log10(0.583), abs=0.5)  # the circle hangs 0.1 lower
    assert m.gain_up_db.value == second.gain_up_db
    strict = margins(loop, resonances=named, gain_stabilised_db=20.0)
    assert strict.lobes[1].stabilised == "phase"


@pytest.mark.parametrize("rate", [12.0, 9.0])
def test_lag_and_lead_of_a_lobe_that_lies_above_0_db(rate):
    """Without a crossing inside the lobe, they are the least over its points, here of a much denser curve."""
    loop = ModalLoop.of([(-0.5, 100.0)], [(7.0, 0.02, rate, 0.0)])
    (lobe,) = margins(loop, resonances=[resonance("slosh", 1, 7.0, 0.02)]).lobes
    hz = np.linspace(lobe.low_hz, lobe.high_hz, 200_001)
    values = loop.response(hz)
    assert np.abs(values).min() > 1.0
    lag = np.degrees(np.angle(-values)) % 360.0
    assert lobe.lag_deg == pytest.approx(lag.min(), abs=1e-5)
    assert lobe.lead_deg == pytest.approx((360.0 - lag).min(), abs=1e-5)
    inside = (hz[lag.argmin()], hz[lag.argmax()])
    assert any(lobe.low_hz < at < lobe.high_hz for at in inside)


def test_a_conditionally_stable_lobe():
    """For an unstable mode that the loop damps, less gain is unstable again."""
    loop = ModalLoop.of([(-1.0, 0.5)], [(7.0, -0.01, 0.2, 0.0)])
    m = margins(loop)
    (lobe,) = m.lobes
    assert m.stable
    assert lobe.conditional
    assert lobe.gain_down_db == m.gain_down_db.value
    p = loop.poles_with(10.0 ** (-lobe.gain_down_db / 20.0))
    assert np.abs(p.real[np.abs(p.imag) > 1.0]).max() < 1e-8


def test_resonances_beyond_the_end_and_folded_ones():
    loop = TransferLoop([0.01], np.poly(0.99 * np.exp(np.array([2.0j, -2.0j]))), sample_s=0.01)
    named = [resonance("bending", 1, 200.0, 0.005), resonance("bending", 2, 900.0, 0.005)]
    (lobe,) = margins(loop, resonances=named).lobes
    assert lobe.label == "bending 1"
    assert lobe.peak_hz == pytest.approx(200.0 / (2.0 * np.pi), rel=1e-2)


def test_modes_of_equal_frequency_share_a_lobe():
    named = [resonance("bending", 1, 7.0, 0.005), resonance("bending", 2, 7.0, 0.005)]
    loop = ModalLoop.of([(-1.0, 2.0)], [(7.0, 0.005, 0.05, 0.0), (7.0, 0.005, 0.03, 0.0)])
    one, two = margins(loop, resonances=named).lobes
    assert (one.label, two.label) == ("bending 1", "bending 2")
    assert one.peak_db == two.peak_db
    assert one.peak_db == pytest.approx(20.0 * np.log10(8.0), abs=0.5)


# --- the vehicle's own loops --------------------------------------------------------------------------------------


@pytest.mark.parametrize("change", [{}, {"modes": True}, {"tanks": True}, {"modes": True, "tanks": True}])
def test_vehicles_with_and_without(change):
    path = fixed_path(without(node_at(40.0), **change))
    loop = close_loop(path, design())
    m = margins(loop, resonances=path.resonances())
    assert m.stable
    assert m.unstable_poles == m.encircled_poles == 0
    kinds = {lobe.kind for lobe in m.lobes}
    assert ("bending" in kinds) == ("modes" not in change)
    assert ("slosh" in kinds) == ("tanks" not in change)


def test_lobes_of_a_flight_are_those_of_its_modes_and_tanks():
    paths = [fixed_path(node_at(t)) for t in TIMES_S]
    found = [margins(close_loop(path, design()), resonances=path.resonances()).lobes for path in paths]
    labels = {"slosh 1", "slosh 2", "bending 1", "bending 2", "bending 3"}
    assert {lobe.label for lobes in found for lobe in lobes} == labels
