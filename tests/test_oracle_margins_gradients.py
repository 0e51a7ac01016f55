"""Weights of design/margins/sensitivity.py against differences of the measures themselves.

A loop of rigid body, actuator and two lightly damped modes, each number of it a parameter. The measures are solved
for to 1e-10, so central differences with a step of 1e-5 are good to some 1e-5; d ln L/dp comes from the same
differences at the measure's frequency, held still, and so does the step in frequency.
"""

from __future__ import annotations

import numpy as np
import pytest
from textbook_loops import TransferLoop

from maxq.control.kernel.records import Array
from maxq.design.margins.measure import Margins, margins
from maxq.design.margins.nichols import Zone
from maxq.design.margins.sensitivity import Differentiable, log_slope, measures
from maxq.design.model.state_space import ComplexArray

START = np.array([6.0, 8.0, 2.0, 25.0, 0.6, 30.0, 0.01, 0.02, 70.0, 0.008, 0.004])
NAMES = ("rate", "place", "divergence", "lag", "zeta", "mode 1", "zeta 1", "gain 1", "mode 2", "zeta 2", "gain 2")
STEP = 1e-5
ZONES = (
    Zone("diamond", 30.0, 6.0), Zone("rectangle", 30.0, 6.0), Zone("ellipse", 30.0, 6.0),
    Zone("diamond", 80.0, 6.0), Zone("rectangle", 60.0, 9.0), Zone("rectangle", 5.0, 20.0),
)  # fmt: skip


class Parametrised(TransferLoop):
    """(d s + p) / (s^2 - mu) with a second-order lag, and two modes beside it."""

    def __init__(self, p: Array) -> None:
        rate, place, mu, lag, zeta, *modes = p
        n, d = np.array([rate, place]), np.array([1.0, 0.0, -mu])
        d = np.polymul(d, [1.0 / lag**2, 2.0 * zeta / lag, 1.0])
        for k in range(2):
            w, z, g = modes[3 * k : 3 * k + 3]
            n, d = (
                np.polyadd(np.polymul(n, [1.0 / w**2, 2 * z / w, 1.0]), np.polymul([g, 0.0], d)),
                np.polymul(d, [1.0 / w**2, 2 * z / w, 1.0]),
            )
        super().__init__(n, d)


def measured(p: Array) -> Margins:
    return margins(Parametrised(p), zones=ZONES)


@pytest.fixture(scope="module")
def centre() -> Margins:
    m = measured(START)
    assert m.stable
    return m


def test_the_loop_has_measures_of_all_kinds(centre):
    names = set(measures(centre))
    assert {"gain_up_db", "gain_down_db", "aero_gain_db", "phase_deg", "delay_s", "rigid_phase_deg"} <= names
    assert {"sensitivity", "complementary", "symmetric", "diamond", "rectangle", "ellipse", "rectangle 3"} <= names
    assert sum(name.startswith("peak") for name in names) == 2


@pytest.mark.parametrize("k", range(len(START)), ids=NAMES)
def test_weights_agree_with_differences(centre, k):
    up, down = START.copy(), START.copy()
    up[k] *= 1.0 + STEP
    down[k] *= 1.0 - STEP
    above, below = measures(measured(up)), measures(measured(down))
    for name, measure in measures(centre).items():
        if name.startswith("peak"):  # unnamed lobes are called by their frequency, which may be the parameter
            continue
        f = np.array([measure.frequency_hz])
        change = np.log(Parametrised(up).response(f) / Parametrised(down).response(f))[0] / (2.0 * STEP)
        expected = (above[name].value - below[name].value) / (2.0 * STEP)
        assert (measure.weight * change).real == pytest.approx(expected, rel=2e-4, abs=2e-4), name


@pytest.mark.parametrize("k", range(len(START)), ids=NAMES)
def test_peaks_agree_with_differences(centre, k):
    def lobes(p: Array) -> list[float]:
        return [lobe.peak_db for lobe in measured(p).lobes]

    up, down = START.copy(), START.copy()
    up[k] *= 1.0 + STEP
    down[k] *= 1.0 - STEP
    expected = (np.array(lobes(up)) - np.array(lobes(down))) / (2.0 * STEP)
    for lobe, slope in zip(centre.lobes, expected, strict=True):
        measure = measures(centre)[f"peak {lobe.label}"]
        f = np.array([measure.frequency_hz])
        change = np.log(Parametrised(up).response(f) / Parametrised(down).response(f))[0] / (2.0 * STEP)
        assert (measure.weight * change).real == pytest.approx(slope, rel=2e-4, abs=2e-4)


class WithSlope(TransferLoop):
    """That knows its own slope."""

    def log_derivative(self, frequencies_hz: Array) -> ComplexArray:
        s = 2j * np.pi * np.asarray(frequencies_hz)
        n, d = np.asarray(self.numerator), np.asarray(self.denominator)
        return (
            2j
            * np.pi
            * (np.polyval(np.polyder(n), s) / np.polyval(n, s) - np.polyval(np.polyder(d), s) / np.polyval(d, s))
        )


def test_the_slope_is_the_loops_own_where_it_has_one_and_differenced_as_well_elsewhere(centre):
    plain = Parametrised(START)
    exact = WithSlope(plain.numerator, plain.denominator)
    assert isinstance(exact, Differentiable)
    assert not isinstance(plain, Differentiable)
    f = centre.curve.frequency_hz[1:-1:3]
    assert log_slope(plain, f) == pytest.approx(log_slope(exact, f), rel=1e-6)
    f = np.concatenate([centre.gain_crossings.frequency_hz, centre.phase_crossings.frequency_hz[1:]])
    assert log_slope(plain, f) == pytest.approx(log_slope(exact, f), rel=1e-8)


def test_an_unstable_loop_has_no_measures():
    assert measures(margins(TransferLoop([1.0], [1.0, 0.0, -1.0]))) == {}
