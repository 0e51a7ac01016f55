"""Margins are right for random loops whose extremes of |L| come within 1e-9 of 0 dB.

| quantity | expected |
|---|---|
| continuous loops, and sampled at 0.01, 0.02, 0.05 s; up to three integrators, unstable poles, damping to 1e-4 | |
| gain crossings | as many as sign changes between dense points that include every extreme of |L| |
| negative real axis above -80 dB | as many as sign changes between those points |
| closed-loop poles to the right | by encirclements and from their list, as by polynomial roots in 60 digits |
| least |1 + L| | no dense point is nearer |
"""

from __future__ import annotations

import numpy as np
import pytest
from textbook_loops import ZpkLoop

from maxq import margins
from maxq.control.kernel.records import Array

LOWEST_HZ, FLOOR, FARTHEST = 1e-3, 1.001e-4, 0.9e9  # beyond FARTHEST a sign change is a pole on the axis


def pair(rng: np.random.Generator, top: float) -> list[complex]:
    omega, zeta = 10.0 ** rng.uniform(-1.5, top), 10.0 ** rng.uniform(-4.0, -0.1) * rng.choice([1, 1, 1, 1, 1, 1, -1])
    p = omega * complex(-zeta, np.sqrt(1.0 - zeta * zeta))
    return [p, p.conjugate()]


def real(rng: np.random.Generator, top: float) -> float:
    return float(-(10.0 ** rng.uniform(-1.5, top)) * rng.choice([1, 1, 1, -1]))


def dense(loop: ZpkLoop) -> Array:
    """Return frequencies (Hz), dense near every pole and zero, that include the extremes of |L|."""
    end = 100.0 if loop.sample_s is None else loop.highest_hz * (1.0 - 1e-3)
    known = np.concatenate([loop.poles, loop.zeros])
    near = [(p.imag + abs(p.real) * np.linspace(-4.0, 4.0, 401)) / (2.0 * np.pi) for p in known if p.imag > 0.0]
    f = np.unique(np.concatenate([np.geomspace(LOWEST_HZ, end, 8000), *near]))
    f = f[(f >= LOWEST_HZ) & (f <= end)]
    rise = np.diff(np.abs(loop.response(f))) > 0.0
    solved = []
    for k in np.flatnonzero(rise[1:] != rise[:-1]) + 1:
        low, high = f[k - 1], f[k + 1]
        for _ in range(40):
            x = np.linspace(low, high, 9)
            size = np.abs(loop.response(x))
            i = int(np.argmax(size) if rise[k - 1] else np.argmin(size))
            low, high = x[max(i - 1, 0)], x[min(i + 1, 8)]
        solved.append(x[i])
    return np.unique(np.append(f, solved))


def random_loop(seed: int) -> ZpkLoop:
    """Return a random loop, scaled so that one of its extremes, if any, is 1e-9 above or below 0 dB."""
    rng = np.random.default_rng([77, seed])
    period = (None, 0.01, 0.02, 0.05)[seed % 4]
    top = 2.0 if period is None else float(np.log10(0.8 * np.pi / period))
    poles: list[complex] = [0.0] * int(rng.integers(0, 4))
    for _ in range(rng.integers(1, 5)):
        poles += pair(rng, top)
    poles += [real(rng, top) for _ in range(rng.integers(0, 3))]
    zeros: list[complex] = []
    while len(zeros) < len(poles) - 1 - rng.integers(0, 3):
        zeros += pair(rng, top) if rng.random() < 0.6 and len(zeros) + 2 < len(poles) else [real(rng, top)]
    shape = ZpkLoop(np.array(zeros, complex), np.array(poles, complex), 1.0, period)
    size = np.abs(shape.response(dense(shape)))
    turning = size[1:-1][(np.diff(size)[1:] > 0.0) != (np.diff(size)[:-1] > 0.0)]
    level = rng.choice(turning) * (1.0 + 1e-9 * rng.choice([-1, 1])) if len(turning) else np.median(size)
    return ZpkLoop(shape.zeros, shape.poles, float(rng.choice([1, 1, 1, -1]) / level), period)


def sign_changes(loop: np.ndarray) -> tuple[int, int]:
    size, below = np.abs(loop), loop.imag < 0.0
    crossed = (
        (below[1:] != below[:-1])
        & (loop.real[1:] < 0.0)
        & (loop.real[:-1] < 0.0)
        & (size[1:] > FLOOR)
        & (size[1:] < FARTHEST)
    )
    return int(((size[1:] >= 1.0) != (size[:-1] >= 1.0)).sum()), int(crossed.sum())


@pytest.mark.slow
@pytest.mark.parametrize("seeds", [range(8), pytest.param(range(8, 400), marks=pytest.mark.long)])
def test_no_crossing_is_missed_or_invented_and_both_counts_of_poles_agree(seeds: range) -> None:
    stable = 0
    for seed in seeds:
        loop = random_loop(seed)
        m, f = margins(loop), dense(loop)
        values = loop.response(f)
        gain, phase = m.gain_crossings, m.phase_crossings
        inside = (gain.frequency_hz > f[0]) & (gain.frequency_hz < f[-1])
        assert inside.sum() == sign_changes(values)[0], seed
        assert np.abs(loop.response(gain.frequency_hz)) == pytest.approx(1.0, abs=1e-9)
        on_axis = (phase.turn != 0) & (phase.frequency_hz > f[0]) & (phase.frequency_hz < f[-1])
        large = np.abs(phase.loop) > FLOOR
        assert (on_axis & large & (np.abs(phase.loop) < FARTHEST)).sum() == sign_changes(values)[1], seed
        closed, lowest = loop.closed_poles(), m.curve.lowest_radps
        moving = closed[np.abs(closed) > lowest]
        right = int((moving.real > 0.0).sum())
        certain = (
            np.abs(moving.real) > 1e-8 * np.abs(moving)
        ).all()  # else on the axis, to what double precision tells
        far = np.abs(m.curve.loop) > FARTHEST
        passed = (m.curve.loop.imag[1:] < 0.0) != (m.curve.loop.imag[:-1] < 0.0)
        if certain and not (passed & (far[1:] | far[:-1]) & (m.curve.loop.real[1:] < 0.0)).any():
            assert (m.encircled_poles, m.unstable_poles) == (right, right), seed
        if m.stable:
            stable += 1
            assert m.modulus <= np.abs(1.0 + values).min() + 1e-9, seed
    assert stable > len(seeds) // 40


@pytest.mark.parametrize("slow", np.linspace(6.9e-5, 9.6e-5, 7))
def test_a_chain_of_slow_roots_does_not_make_a_loop_unstable(slow: float) -> None:
    """Slow roots of attitude control in thin air between 1e-5 and 1e-3 Hz, with ratios below 16, leave the loop stable.

    The other roots of the closed loop are those of the polynomial.
    """
    poles, zeros, gain = np.array([0.0, slow, 1.12e-3, -3.84e-3]), np.array([0.0, 0.0, -1.0]), 4.0
    found = margins(ZpkLoop(zeros.astype(complex), poles.astype(complex), gain, None))
    closed = np.roots(np.polyadd(np.poly(poles), gain * np.poly(zeros)))
    fast = closed[np.abs(closed) > 2.0 * np.pi * 1e-3]
    assert len(fast) == 2
    assert (fast.real < 0.0).all()
    assert (found.stable, found.unstable_poles, found.encircled_poles) == (True, 0, 0)
