"""Nichols zones and disks equal an exhaustive search along the curve.

The search takes the least value over a grid of tens of thousands of points, refined ten times around the minimum. It is
slow and reliable, and uses neither kinks nor parabolas.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from textbook_loops import ModalLoop

from maxq import margins
from maxq.control.kernel.records import Array
from maxq.design.margins.distances import Zone


def least(loop: ModalLoop, value: Callable[[np.ndarray], Array], grid: Array) -> float:
    found = value(loop.response(grid))
    best = np.inf
    for k in np.argsort(found)[:3]:
        low, high = grid[max(k - 1, 0)], grid[min(k + 1, len(grid) - 1)]
        for _ in range(8):
            f = np.linspace(low, high, 61)
            values = value(loop.response(f))
            i = int(np.argmin(values))
            best = min(best, float(values[i]))
            low, high = f[max(i - 1, 0)], f[min(i + 1, 60)]
    return best


def fine_grid(loop: ModalLoop) -> Array:
    poles = np.concatenate([loop.open_poles(), loop.closed_poles()])
    poles = poles[poles.imag > 1e-4]
    spread = np.concatenate([-np.geomspace(1e-2, 1e6, 200), np.geomspace(1e-2, 1e6, 200)])
    near = (poles.imag[:, None] + np.abs(poles.real)[:, None] * spread).ravel() / (2.0 * np.pi)
    grid = np.concatenate([np.geomspace(1.001e-5, 1e3, 2001), near])
    return np.unique(grid[(grid > 1e-5) & (grid <= 1e3)])


def from_s(loop: np.ndarray) -> Array:
    return np.abs(1.0 + loop)


def from_t(loop: np.ndarray) -> Array:
    return np.abs(1.0 + 1.0 / loop)


def from_both(loop: np.ndarray) -> Array:
    return np.minimum(2.0 * np.abs((1.0 + loop) / (1.0 - loop)), 2.0)


ZONES = st.builds(
    Zone, st.sampled_from(["diamond", "rectangle", "ellipse"]), st.floats(5.0, 90.0), st.floats(1.0, 20.0)
)
PAIR = st.tuples(
    st.floats(-1.0, 2.0).map(lambda x: 10.0**x),
    st.sampled_from([1e-4, 5e-3, 0.05, 0.5]),
    st.floats(-0.3, 1.0),
    st.sampled_from([-0.3, 0.01, 0.4, 1.0]),
)


@settings(max_examples=40, deadline=None)
@given(
    st.lists(st.tuples(st.sampled_from([-0.1, -3.0]), st.floats(0.1, 4.0)), max_size=2, unique_by=lambda x: x[0]),
    st.lists(PAIR, min_size=1, max_size=3),
    st.floats(0.05, 3.0),
    st.lists(ZONES, min_size=1, max_size=3),
)
def test_clearances_and_disks_of_random_loops(real, pairs, gain, zones):
    loop = ModalLoop.of(real, pairs, gain)
    m = margins(loop, zones=zones)
    if not m.stable:
        return
    grid = fine_grid(loop)
    grid = grid[grid < m.curve.frequency_hz[-1]]
    found = [(c.value, c.frequency_hz, c.zone.clearance) for c in m.clearances]
    for disk, value in ((m.disks.sensitivity, from_s), (m.disks.complementary, from_t), (m.disks.symmetric, from_both)):
        found.append((disk.size, disk.frequency_hz, value))
    for size, f, value in found:
        assert size <= least(loop, value, grid) + 1e-7 * (1.0 + abs(size))
        if 0.0 < f < np.inf:
            assert size == pytest.approx(float(value(loop.response(np.array([f])))[0]), rel=1e-9)


def test_a_zone_is_a_constraint_that_margins_alone_do_not_make():
    """A loop with more than 6 dB and 30 deg on the axes misses the zone because it cuts the corner between them."""
    loop = ModalLoop.of([(0.0, 1.0), (-3.0, -1.0)], [(3.0, 0.1, -0.1, 0.1)])
    m = margins(loop, zones=(Zone("rectangle", 30.0, 6.0), Zone("diamond", 30.0, 6.0)))
    assert m.gain_up_db.value > 6.0
    assert m.phase_deg.value > 30.0
    rectangle, diamond = m.clearances
    assert rectangle.value < diamond.value < 0.0


@pytest.mark.parametrize("turns", [-2, -1, 0, 1, 2])
def test_zones_repeat_every_turn(turns):
    zone = Zone("diamond", 30.0, 6.0)
    phase = np.radians(-180.0 + 360.0 * turns + np.array([0.0, 15.0, 30.0, -45.0]))
    loop = 10.0 ** (np.array([0.0, 3.0, 0.0, 0.0]) / 20.0) * np.exp(1j * phase)
    assert zone.clearance(loop) == pytest.approx([-1.0, 0.0, 0.0, 0.5], abs=1e-12)


@pytest.mark.parametrize(
    ("shape", "expected"),
    [
        ("diamond", [1.0, -0.5, 0.0]),
        ("rectangle", [0.0, -0.75, -0.5]),
        ("ellipse", [2.0**0.5 - 1.0, -0.75 + 0.10355339059327379, -(1.0 - 0.5**0.5)]),
    ],
)
def test_clearance_by_hand(shape, expected):
    """Clearances equal hand calculations at the rectangle's corner, at a quarter of both axes and at a half of both."""
    share = np.array([1.0, 0.25, 0.5])
    loop = -(10.0 ** (6.0 * share / 20.0)) * np.exp(1j * np.radians(30.0 * share))
    assert Zone(shape, 30.0, 6.0).clearance(loop) == pytest.approx(expected, abs=1e-12)
