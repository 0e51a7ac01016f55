"""Crossings of random vehicle loops, including close pairs, equal those of exact arithmetic and of dense points.

| case | expected |
|---|---|
| random gains, F4 filters and vehicles, sampled and Pade | every crossing, no other, of Sturm's chain in 200 digits |
| the same, more of them | the sign changes between 30,000 points of L, a linear system at each |
| least |1 + L|, also next to Nyquist | none of those points is nearer |
| least |1 + L| at frequency zero | L in 60 digits, far below the start of a grid |
| bounds on the derivatives over intervals | hold at all points between |
"""

from __future__ import annotations

from functools import cache
from itertools import pairwise

import design_nodes
import numpy as np
import pytest
from oracles.exact_crossings import crossings, response

from maxq import Loop, margins
from maxq.control.filters import BendingFilter, QuadraticSection
from maxq.design.laws.pd import Pd
from maxq.design.loop.fixed_path import fixed_path
from maxq.design.margins.bounds import slopes, with_extremes
from maxq.design.model.deviations import deviations_of
from maxq.design.model.node import disperse
from maxq.design.model.spread import Spread, campaign_of

LOWEST_HZ, HIGHEST_HZ, FLOOR = 1e-3, 300.0, 1.001e-4
PAIRS = (663,)
SPREAD = Spread()


@cache
def random_loop(seed: int) -> Loop:
    """Return the loop of a dispersed vehicle at an operating point, with gains scaled by up to ten and a random F4."""
    rng = np.random.default_rng([2, seed])
    nodes = design_nodes.flown()
    node = nodes[rng.integers(len(nodes))]
    deviations = deviations_of(campaign_of(SPREAD, design_nodes.nominal()), node)
    node = disperse(node, deviations.at(rng.normal(size=len(deviations.places)) / 3.0))
    sampled, deep = bool(rng.random() < 0.5), rng.random() < 0.4
    sections = [
        QuadraticSection(
            zero_hz=9.5 * 10.0 ** rng.uniform(-0.4, 0.4),
            zero_zeta=10.0 ** rng.uniform(-3.0 if deep else -1.3, 0.0) * rng.choice([1.0, 1.0, 1.0, -1.0]),
            pole_hz=9.5 * 10.0 ** rng.uniform(-0.6, 0.3),
            pole_zeta=rng.uniform(0.1, 1.0),
        )
        for _ in range(2)
    ]
    filter_ = BendingFilter(tuple(sections))
    hz, period = float(rng.uniform(5.0, 20.0)), node.instruments.sample_s
    law = Pd(
        0.8 * 10.0 ** rng.uniform(-1.0, 1.2),
        0.4 * 10.0 ** rng.uniform(-1.0, 1.2),
        filter_.discretize(period, "prewarped", prewarp_hz=hz) if sampled else filter_,
    )
    return Loop(fixed_path(node, "sampled" if sampled else "pade"), law)


def found(loop: Loop) -> tuple[np.ndarray, np.ndarray, float]:
    """Return |L| = 1, the negative real axis above -80 dB, and the least |1 + L|, between the frequencies above."""
    m = margins(loop)
    inside = [
        (f > LOWEST_HZ) & (f < min(HIGHEST_HZ, loop.highest_hz * (1.0 - 1e-9)))
        for f in (m.gain_crossings.frequency_hz, m.phase_crossings.frequency_hz)
    ]
    high = (np.abs(m.phase_crossings.loop) > FLOOR) & (m.phase_crossings.turn != 0)
    return m.gain_crossings.frequency_hz[inside[0]], m.phase_crossings.frequency_hz[inside[1] & high], m.modulus


def exact(loop: Loop) -> tuple[np.ndarray, np.ndarray]:
    s = loop.state_space()
    gain, phase, at = crossings(s.a, s.b[:, 0], s.c[0], float(s.d[0, 0]), loop.sample_s, 2.0 * np.pi * HIGHEST_HZ)
    return gain[gain > LOWEST_HZ], phase[(at < -FLOOR) & (phase > LOWEST_HZ)]


def agree(loop: Loop) -> None:
    gain, phase = exact(loop)
    ours = found(loop)
    # two that are 1e-7 apart are each as uncertain as the root of the arithmetic's precision
    assert ours[0] == pytest.approx(gain, rel=1e-7)
    assert ours[1] == pytest.approx(phase, rel=1e-7)


@pytest.mark.parametrize("seed", PAIRS)
def test_a_pair_that_the_grid_alone_misses_is_found(seed):
    loop = random_loop(seed)
    agree(loop)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1, *(pytest.param(n, marks=pytest.mark.long) for n in (2, 3))])
def test_crossings_are_those_of_exact_arithmetic(seed):
    agree(random_loop(seed))


@pytest.mark.parametrize("seed", [13, 369, 417, 468])
def test_the_least_distance_at_frequency_zero_is_that_of_60_digits(seed):
    """The least distance equals that in 60 digits; a grid from 1e-3 Hz is up to 0.4 too large for 11 of 64 loops."""
    loop = random_loop(seed)
    m, s = margins(loop), loop.state_space()
    assert m.disks.sensitivity.frequency_hz == 0.0
    low, grid = (
        abs(1.0 + response(s.a, s.b[:, 0], s.c[0], float(s.d[0, 0]), loop.sample_s, f)) for f in (1e-9, LOWEST_HZ)
    )
    assert m.modulus == pytest.approx(low, abs=1e-8)
    assert m.modulus < grid - 0.05


def dense(loop: Loop) -> tuple[np.ndarray, np.ndarray]:
    """Return frequencies and L by a linear system at each, dense near every pole of L and of the closed loop.

    By partial fractions of the whole realisation, L is wrong by a factor of two where it is small, because poles of
    filter and actuator are close together.
    """
    end = min(HIGHEST_HZ, loop.highest_hz * (1.0 - 1e-9))
    s = loop.state_space()
    poles = np.linalg.eigvals(s.a)
    closed = np.linalg.eigvals(s.a - np.outer(s.b[:, 0], s.c[0]) / (1.0 + s.d[0, 0]))
    every = np.concatenate([poles, closed])
    at = every if loop.sample_s is None else np.log(every[np.abs(every) > 1e-6]) / loop.sample_s
    parts = [np.geomspace(LOWEST_HZ, end, 12_000), np.linspace(LOWEST_HZ, end, 12_000)]
    for p in at[at.imag > 0.0]:
        parts.append((p.imag + max(abs(p.real), 1e-5) * np.sinh(np.linspace(-9.0, 9.0, 801)) / 100.0) / (2.0 * np.pi))
    f = np.unique(np.concatenate(parts))
    f = f[(f >= LOWEST_HZ) & (f < end)]
    x = 2j * np.pi * f if loop.sample_s is None else np.exp(2j * np.pi * f * loop.sample_s)
    eye = np.eye(len(s.a))
    parts = [s.c[0] @ np.linalg.solve(part[:, None, None] * eye - s.a, s.b)[..., 0].T for part in np.array_split(x, 40)]
    return f, np.concatenate(parts) + s.d[0, 0]


@pytest.mark.long
def test_no_sign_change_between_dense_points_is_missed_and_none_is_nearer():
    for seed in range(6):
        loop = random_loop(seed)
        gain, phase, modulus = found(loop)
        f, values = dense(loop)
        size, below = np.abs(values), values.imag < 0.0
        assert len(gain) == ((size[1:] > 1.0) != (size[:-1] > 1.0)).sum(), seed
        crossed = (below[1:] != below[:-1]) & (values.real[1:] < 0.0) & (values.real[:-1] < 0.0) & (size[1:] > FLOOR)
        assert len(phase) == crossed.sum(), seed
        if np.isfinite(modulus):
            nearest = np.abs(1.0 + values).min()
            assert modulus <= nearest + 1e-9, seed
            inside = LOWEST_HZ < margins(loop).disks.sensitivity.frequency_hz < f[-1]
            assert not inside or modulus == pytest.approx(nearest, rel=1e-3), seed


@pytest.mark.parametrize("sample_s", [None, 0.01])
def test_bounds_of_slopes_hold_between_all_points(sample_s):
    """The bounds hold for differences of ln L between points a thousand times denser.

    Poles are inside, outside and near the axis.
    """
    rng = np.random.default_rng(5)
    at = -(10.0 ** rng.uniform(-4.0, 1.5, 12)) + 1j * 10.0 ** rng.uniform(-1.0, 2.4, 12)
    at[::4] = -at[::4].conj()
    at = np.concatenate([at, at.conj(), [-3.0, 0.4]])
    if sample_s is not None:
        at = np.exp(at * sample_s)
    factors = with_extremes(at, np.where(rng.random(len(at)) < 0.5, 1.0, -1.0), sample_s or 0.0)
    edges = np.sort(rng.uniform(0.01, 49.9, 40))
    for low, high in pairwise(edges):
        least, most, least_phase, most_phase = slopes(low, high, factors)
        t = 2.0 * np.pi * np.linspace(low, high, 4001) * (1.0 if sample_s is None else sample_s)
        x = 1j * t if sample_s is None else np.exp(1j * t)
        slope = np.diff(np.log(x[:, None] - at) * factors.sign, axis=0)
        slope.imag = (slope.imag + np.pi) % (2.0 * np.pi) - np.pi
        slope = slope.sum(axis=1) / np.diff(t)
        room = 1e-6 * (1.0 + np.abs(slope))  # rounding of the differences
        assert (slope.real > least - room).all()
        assert (slope.real < most + room).all()
        assert (slope.imag > least_phase - room).all()
        assert (slope.imag < most_phase + room).all()
