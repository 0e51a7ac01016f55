"""Closed loops confirm the margins: gain, delay and whole sampling periods are increased until a pole crosses.

| quantity | expected |
|---|---|
| random sampled loops, with integrators and unstable poles | encirclements = poles outside the unit circle |
| gain margins of sampled loops | poles inside the circle up to the margin, one on it there |
| delay margins of random continuous loops | a Pade delay of order 12: stable 0.1 % below, unstable 0.1 % above |
| phase margins, lag and lead, of the modulus and the disks | no loop turned or scaled within them is unstable |
"""

from __future__ import annotations

import control
import numpy as np
import pytest
from hypothesis import HealthCheck, assume, given, settings
from hypothesis import strategies as st
from test_oracle_margins import GAINS, PAIRS
from textbook_loops import ModalLoop, TransferLoop

from maxq import margins

RADII = st.sampled_from([0.2, 0.7, 0.95, 0.999, 1.05])
PERIOD_S = 0.01


@st.composite
def sampled_loops(draw: st.DrawFn) -> TransferLoop:
    poles: list[complex] = []
    for radius, angle in draw(st.lists(st.tuples(RADII, st.floats(0.1, 3.0)), max_size=2)):
        poles += [radius * np.exp(1j * angle), radius * np.exp(-1j * angle)]
    poles += draw(st.lists(st.sampled_from([0.3, -0.6, 0.9, 1.1]), max_size=2))
    poles += draw(st.sampled_from([[], [1.0], [1.0, 1.0], [0.0, 0.0]]))
    assume(poles)
    zeros: list[complex] = []
    for radius, angle in draw(st.lists(st.tuples(st.floats(0.1, 1.3), st.floats(0.1, 3.0)), max_size=len(poles) // 2)):
        zeros += [radius * np.exp(1j * angle), radius * np.exp(-1j * angle)]
    gain = draw(st.floats(-2.0, 0.7).map(lambda x: 10.0**x)) * draw(st.sampled_from([1.0, -1.0]))
    numerator = gain * np.atleast_1d(np.real(np.poly(zeros)))
    return TransferLoop(numerator, np.real(np.poly(poles)), PERIOD_S, exact=poles)


def outside(loop: TransferLoop, gain: float = 1.0) -> tuple[int, bool]:
    """Return the number of closed-loop poles outside the unit circle, and True if this number is certain."""
    z = np.roots(np.polyadd(gain * np.asarray(loop.numerator), loop.denominator))
    return int((np.abs(z) > 1.0).sum()), bool((np.abs(np.abs(z) - 1.0) > 1e-5).all())


@pytest.mark.slow
@settings(max_examples=200, deadline=None)
@given(sampled_loops())
def test_encirclements_of_sampled_loops(loop):
    biproper = len(np.trim_zeros(loop.numerator, "f")) == len(loop.denominator)
    assume(not biproper or abs(loop.numerator[0] + 1.0) > 1e-3)
    count, certain = outside(loop)
    assume(certain)
    m = margins(loop)
    assert (m.encircled_poles, m.unstable_poles) == (count, count)


@pytest.mark.long
@settings(max_examples=80, deadline=None, suppress_health_check=[HealthCheck.filter_too_much])  # few are stable
@given(sampled_loops())
def test_gain_margins_of_sampled_loops(loop):
    m = margins(loop)
    assume(m.stable)
    for bound, sign in ((m.gain_up_db, 1.0), (m.gain_down_db, -1.0)):
        end = min(bound.value, 60.0)
        for share in (0.5, 0.999):
            count, certain = outside(loop, 10.0 ** (sign * share * end / 20.0))
            assert count == 0 or not certain
        if bound.value < 60.0 and np.isfinite(bound.frequency_hz):
            gain = 10.0 ** (sign * bound.value / 20.0)
            z = np.roots(np.polyadd(gain * np.asarray(loop.numerator), loop.denominator))
            assert np.abs(z - np.exp(2j * np.pi * bound.frequency_hz * PERIOD_S)).min() < 1e-4


@settings(max_examples=60, deadline=None)
@given(st.lists(st.tuples(st.sampled_from([-0.1, -3.0]), st.floats(0.1, 4.0)), max_size=2), PAIRS, GAINS)
def test_delay_margins(real, pairs, gain):
    loop = ModalLoop.of(real, [p for p in pairs if p[1] > 1e-3][:2], gain)
    assume(len(loop.a) > 0)
    m = margins(loop)
    assume(m.stable and np.isfinite(m.delay_s.value))
    # the approximant is good to 1e-6 up to some eight radians of lag
    assume(m.gain_crossings.frequency_hz.max() * 2.0 * np.pi * m.delay_s.value < 8.0 and m.delay_s.value > 1e-4)
    system = control.ss(loop.a, loop.b[:, None], loop.c[None], 0.0)
    for factor, stable in ((0.5, True), (0.999, True), (1.001, False)):
        # in units of the delay, where its approximant is well scaled
        t = m.delay_s.value * factor
        scaled = control.ss(system.A * t, system.B * t, system.C, 0.0)
        n, d = control.pade(1.0, 12)
        delay = control.ss(control.tf(n, d))
        loop_ = control.series(delay, scaled)
        p = np.linalg.eigvals(loop_.A - loop_.B @ loop_.C / (1.0 + loop_.D[0, 0])) / t
        near = p[np.abs(p.imag) < 4.0 * np.pi * m.gain_crossings.frequency_hz.max() + 1.0]
        worst = near.real.max()
        assert (worst < 1e-9) == stable or abs(worst) < 1e-7


@settings(max_examples=80, deadline=None)
@given(
    st.lists(st.tuples(st.sampled_from([-0.1, -3.0]), st.floats(0.1, 4.0)), max_size=2),
    PAIRS,
    GAINS,
    st.floats(-1.0, 1.0),
    st.floats(-1.0, 1.0),
)
def test_no_gain_and_phase_within_the_symmetric_disk_destabilise(real, pairs, gain, share, turn):
    """For any complex factor k of the disk, A - k b c has no pole to the right."""
    loop = ModalLoop.of(real, pairs, gain)
    m = margins(loop)
    assume(m.stable)
    disk = m.disks.symmetric
    centre_to = 0.5 * disk.size * 0.999 * share * np.exp(1j * np.pi * turn)
    factor = (1.0 + centre_to) / (1.0 - centre_to)
    p = np.linalg.eigvals(loop.a - factor * np.outer(loop.b, loop.c))
    assert (p.real < 1e-9 * np.abs(p)).all()
    for deg in (m.phase_deg.value * 0.999 * turn, disk.phase_deg * turn):
        if np.isfinite(deg) and abs(deg) < 180.0:
            p = np.linalg.eigvals(loop.a - np.exp(1j * np.radians(deg)) * np.outer(loop.b, loop.c))
            assert (p.real < 1e-9 * np.abs(p)).all()
