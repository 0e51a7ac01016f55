"""Margins equal closed forms, python-control, and eigenvalue problems without a grid.

| quantity | expected |
|---|---|
| textbook loops: third order, unstable, conditionally stable, pure delay | closed forms, 1e-7 dB and deg |
| L at zero frequency and at Nyquist | counts as a crossing where it is negative |
| gain and phase margins, first crossings | those of python-control's stability_margins |
| disk margins | those of python-control's disk_margins on a dense grid |
| all crossings of random modal loops, damping 1e-5 to 0.7 | imaginary eigenvalues of the Hamiltonian pencils |
| a resonance of zeta 1e-4 and 1e-5 between two points of any grid | found, peak exact |
| |L| or its phase that just touches | both crossings found, or none |
"""

from __future__ import annotations

import control
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from scipy.special import lambertw
from textbook_loops import ModalLoop, TransferLoop

from maxq import margins
from maxq.control.kernel.records import Array
from maxq.design.margins.crossings import steps_past_poles

DB = 20.0 / np.log(10.0)
EXACT = 1e-7  # dB, degrees: a thousandth of what the solver promises, and the rounding of polynomials
TAU = 2.0 * np.pi


def db(ratio: float) -> float:
    return float(DB * np.log(ratio))


def test_a_pole_on_the_axis_is_passed_by_the_step_around_it():
    """A pole on the axis is found in every step, including the last, and none beyond the ends or off the axis.

    A hidden pole cancels no other.
    """
    f = np.array([1.0, 2.0, 5.0, 7.0, 8.0])
    at_hz = np.array([0.5, 1.5, 3.0, 6.0, 7.5, 9.0])
    none = np.zeros(0, complex)
    poles = 1j * TAU * at_hz
    assert steps_past_poles(f, poles, none).tolist() == [1, 1, 1, 1]
    assert steps_past_poles(f, poles, poles[[1, 4]]).tolist() == [0, 1, 1, 0]
    assert steps_past_poles(f, 1j * TAU * np.array([7.2, 7.6, 3.0]), none).tolist() == [0, 1, 0, 2]
    assert steps_past_poles(f, poles - 0.1, none).tolist() == [0, 0, 0, 0]


def test_third_order_lag():
    """For k / (s + 1)^3, -180 deg is at sqrt(3) rad/s, where |L| = k / 8."""
    m = margins(TransferLoop([2.0], [1.0, 3.0, 3.0, 1.0]))
    assert m.gain_up_db.value == pytest.approx(db(4.0), abs=EXACT)
    assert m.gain_up_db.frequency_hz == pytest.approx(np.sqrt(3.0) / TAU, rel=1e-9)
    w = np.sqrt(2.0 ** (2 / 3) - 1.0)
    assert m.phase_deg.value == pytest.approx(180.0 - 3.0 * np.degrees(np.arctan(w)), abs=EXACT)
    assert m.gain_down_db.value == np.inf
    assert not np.isfinite(m.gain_down_db.value)


@pytest.mark.parametrize("delay_s", [0.01, 0.3, 1.5])
def test_integrator_with_delay(delay_s):
    """For exp(-s T) / s the poles are W(-T) / T, and margins and delay margin have closed forms."""
    poles = [lambertw(-delay_s, k) / delay_s for k in range(-2, 3)]
    m = margins(TransferLoop([1.0], [1.0, 0.0], delay_s=delay_s, rightmost=poles))
    assert m.stable
    assert m.gain_up_db.value == pytest.approx(db(np.pi / 2.0 / delay_s), abs=EXACT)
    assert m.phase_deg.value == pytest.approx(90.0 - np.degrees(delay_s), abs=EXACT)
    assert m.delay_s.value == pytest.approx(np.pi / 2.0 - delay_s, rel=1e-9)


def test_delay_beyond_the_margin_is_unstable():
    poles = [lambertw(-2.0, k) / 2.0 for k in range(-2, 3)]
    m = margins(TransferLoop([1.0], [1.0, 0.0], delay_s=2.0, rightmost=poles))
    assert (m.stable, m.unstable_poles, m.encircled_poles) == (False, 2, 2)


@pytest.mark.parametrize("divergence", [0.02, 1.0, 30.0])
def test_aerodynamically_unstable_body(divergence):
    """For m (p + d s) / (s^2 - mu), the gain can fall to mu / (m p) before the body diverges, at zero frequency."""
    m = margins(TransferLoop([8.0, 4.0 * divergence], [1.0, 0.0, -divergence]))
    assert m.stable
    assert m.encircled_poles == 0
    assert m.aero_gain_db.value == pytest.approx(db(4.0), abs=EXACT)
    assert m.aero_gain_db.frequency_hz == 0.0
    assert m.gain_up_db.value == np.inf


def test_aerodynamically_unstable_body_with_an_actuator_has_both_margins():
    """m (p + d s) / ((s^2 - mu) (1 + s T)) has both margins; closed: T s^3 + s^2 + (k m d - T mu) s + k m p - mu."""
    mu, lag = 2.0, 0.1
    m = margins(TransferLoop([6.0, 8.0], np.polymul([1.0, 0.0, -mu], [lag, 1.0])))
    assert m.aero_gain_db.value == pytest.approx(db(4.0), abs=EXACT)
    # Routh: k m d - T mu > T (k m p - mu), that is k (6 - 0.8) > 0: no upper end
    assert m.rigid_gain_db.value == np.inf
    m = margins(TransferLoop([0.6, 8.0], np.polymul([1.0, 0.0, -mu], [lag, 1.0])))
    assert (m.stable, m.unstable_poles, m.encircled_poles) == (False, 2, 2)


def test_conditionally_stable():
    """k (s + 1)^2 / s^3 is stable for k > 1/2, with -180 deg at 1 rad/s."""
    m = margins(TransferLoop([4.0, 8.0, 4.0], [1.0, 0.0, 0.0, 0.0]))
    assert m.stable
    assert np.isfinite(m.gain_down_db.value)
    assert m.gain_down_db.value == pytest.approx(db(8.0), abs=EXACT)
    assert m.gain_down_db.frequency_hz == pytest.approx(1.0 / TAU, rel=1e-9)
    assert m.gain_up_db.value == np.inf
    below = margins(TransferLoop([0.4, 0.8, 0.4], [1.0, 0.0, 0.0, 0.0]))
    assert (below.stable, below.encircled_poles) == (False, 2)


def test_sampled_lag_reaches_minus_one_at_nyquist():
    """For k / (z - a), z = -1 when k = 1 + a."""
    m = margins(TransferLoop([0.8], [1.0, -0.5], sample_s=0.01))
    assert m.gain_up_db.value == pytest.approx(db(1.5 / 0.8), abs=EXACT)
    assert m.gain_up_db.frequency_hz == 50.0


def test_delay_of_whole_periods_destabilises_a_sampled_loop_when_the_delay_margin_says():
    loop = TransferLoop([0.1], [1.0, -1.0], sample_s=0.01)
    periods = margins(loop).delay_s.value / 0.01
    for n in range(25):
        delayed = margins(TransferLoop([0.1], [1.0, -1.0, *[0.0] * n], sample_s=0.01))
        assert delayed.stable == (n < periods)


@pytest.mark.parametrize(
    ("numerator", "denominator"),
    [
        ([6.0, 3.0], [1.0, 3.0, 4.0, 2.0, 0.0]),
        ([2.0], [1.0, 2.0, 2.0, 1.0]),
        ([20.0, 30.0], np.poly([0.0, 0.0, -8.0, -9.0])),
        ([0.4, 0.01, 2.0], np.poly([-1.0, -2.0, -0.1 + 2.0j, -0.1 - 2.0j])),
    ],
)
def test_python_control_agrees(numerator, denominator):
    loop = TransferLoop(numerator, denominator)
    m = margins(loop)
    system = control.tf(np.real(numerator), np.real(denominator))
    gm, pm, _, wg, wp, _ = control.stability_margins(system, returnall=True)
    positive = gm > 0
    ours = m.phase_crossings
    inner = ours.turn != 0
    assert np.sort(ours.frequency_hz[inner] * TAU) == pytest.approx(np.sort(wg[positive & (wg > 0)]), rel=1e-6)
    assert np.sort(ours.gain_margin_db[inner]) == pytest.approx(np.sort(DB * np.log(gm[positive & (wg > 0)])), abs=1e-5)
    assert m.gain_crossings.frequency_hz * TAU == pytest.approx(np.sort(wp), rel=1e-6)
    turns = np.mod(m.gain_crossings.phase_margin_deg, 360.0)
    assert turns == pytest.approx(np.mod(pm[np.argsort(wp)], 360.0), abs=1e-5)
    w = np.unique(np.concatenate([np.geomspace(1e-4, 1e3, 2001), TAU * m.curve.frequency_hz]))
    for disk, skew in ((m.disks.sensitivity, 1.0), (m.disks.symmetric, 0.0), (m.disks.complementary, -1.0)):
        size, gain_db, phase = control.disk_margins(system, w, skew=skew)
        assert disk.size == pytest.approx(size, rel=1e-7)
        assert disk.phase_deg == pytest.approx(phase, rel=1e-6)
        least = min(disk.gain_up_db, disk.gain_down_db) if size < 1.0 or skew == 0.0 else float(gain_db)
        assert least == pytest.approx(float(gain_db), rel=1e-6)


# --- random loops -----------------------------------------------------------------------------------------------

OMEGAS = st.floats(-1.5, 2.0).map(lambda x: 10.0**x)
ZETAS = st.sampled_from([1e-5, 1e-4, 5e-3, 0.03, 0.3, 0.7])
PAIRS = st.lists(st.tuples(OMEGAS, ZETAS, st.floats(-1.0, 1.0), st.floats(-1.0, 1.0)), min_size=1, max_size=4)
REAL = st.lists(
    st.tuples(st.sampled_from([0.0, -0.03, -1.0, -20.0, 0.5]), st.floats(-3.0, 3.0)),
    max_size=3,
    unique_by=lambda pole: pole[0],
)
GAINS = st.floats(-2.0, 1.5).map(lambda x: 10.0**x)


def loops() -> st.SearchStrategy[ModalLoop]:
    return st.builds(ModalLoop.of, REAL, PAIRS, GAINS)


def on_axis(found: np.ndarray, within: float, above_hz: float = 2e-5) -> Array:
    """Return the frequencies of the eigenvalues that are imaginary to a relative `within`.

    A curve begins at 1e-5 Hz or above.
    """
    return np.sort(found.real[(found.real > above_hz) & (np.abs(found.imag) < within * found.real)])


def missing(ours: Array, theirs: Array, rel: float) -> list[float]:
    """Return the values of `theirs` without a close value in `ours`."""
    return [float(x) for x in theirs if not (np.abs(ours - x) < rel * x).any()]


@pytest.mark.slow
@settings(max_examples=150, deadline=None)
@given(loops())
@example(ModalLoop.of([(0.0, 2.0**-8)], [(1.0, 1e-5, 0.0, 0.0)], 10.0**-1.5))  # crosses at 1.97e-5 Hz
def test_no_crossing_of_a_random_loop_is_missed_or_invented(loop):
    """Each crossing has its eigenvalue and each eigenvalue its crossing, with |L| = 1 or L real to 1e-9."""
    m = margins(loop)
    gain, phase = m.gain_crossings.frequency_hz, m.phase_crossings.frequency_hz[m.phase_crossings.turn != 0]
    assert np.abs(loop.response(gain)) == pytest.approx(1.0, abs=1e-9)
    assert np.abs(np.sin(np.angle(loop.response(phase)))) == pytest.approx(0.0, abs=1e-9)
    pencil = loop.gain_crossings_hz()
    lone = np.array([x for x in on_axis(pencil, 1e-11) if (np.abs(pencil - x) < 0.01 * x).sum() == 1])
    assert missing(gain, lone, 1e-3) == []
    assert missing(on_axis(pencil, 1e-2, 0.9e-5), gain, 1e-2) == []
    pencil = loop.real_crossings_hz()
    lone = np.array([x for x in on_axis(pencil, 1e-11) if (np.abs(pencil - x) < 0.01 * x).sum() == 1])
    value = loop.response(lone)
    # above -80 dB on the negative axis, and not the pole itself
    lone = lone[(value.real < 0.0) & (np.abs(value) > 1e-4) & (np.abs(value.imag) < 1e-3 * np.abs(value))]
    assert missing(phase, lone, 1e-3) == []


@settings(max_examples=150, deadline=None)
@given(loops())
def test_encirclements_equal_the_unstable_poles_of_random_loops(loop):
    m = margins(loop)
    closed = loop.closed_poles()
    lowest = m.curve.lowest_radps
    size = np.abs(closed)
    if (
        abs(1.0 + m.curve.at_zero) < 1e-6
        or (np.abs(closed.real) < 1e-7 * size).any()
        or ((size > 0.1 * lowest) & (size < 10.0 * lowest)).any()
    ):
        return  # on the axis, to rounding
    assert m.encircled_poles == int(((size > lowest) & (closed.real > 0.0)).sum())
    assert m.encircled_poles == m.unstable_poles


@pytest.mark.slow
@settings(max_examples=200, deadline=None)
@given(loops())
def test_gain_margins_of_random_loops_are_where_a_pole_meets_the_axis(loop):
    m = margins(loop)
    if not m.stable:
        assert np.isnan([m.gain_up_db.value, m.gain_down_db.value, m.phase_deg.value, m.modulus]).all()
        return
    drift = loop.closed_poles()
    if ((np.abs(drift) <= m.curve.lowest_radps) & (drift.real > 0.0)).any():
        return  # more gain makes dynamics of it
    for bound, sign in ((m.gain_up_db, 1.0), (m.gain_down_db, -1.0)):
        end = min(bound.value, 60.0)
        for share in (0.3, 0.9, 1.0 - 1e-5):
            p = loop.poles_with(10.0 ** (sign * end * share / 20.0))
            p = p[np.abs(p) > m.curve.lowest_radps]
            assert (p.real < 1e-9 * np.abs(p)).all()
        if bound.value < 60.0:
            p = loop.poles_with(10.0 ** (sign * bound.value / 20.0))
            w = TAU * bound.frequency_hz
            k = int(np.argmin(np.abs(p - 1j * w)))
            assert abs(p[k] - 1j * w) < 1e-6 * max(w, 0.1)  # a damping of 1e-5 moves it 1e5 times as far as the gain


@pytest.mark.parametrize("zeta", [1e-2, 1e-4, 1e-5, 1e-7])
@pytest.mark.parametrize("omega", [3.0, 7.654321])
def test_a_resonance_is_never_missed(zeta, omega):
    """For 1/(s+1) plus a small resonance, the peak is 1 / (2 zeta) of the static contribution."""
    weight = 3.0 * zeta
    loop = ModalLoop.of([(-1.0, 0.5)], [(omega, zeta, 0.0, weight)])
    m = margins(loop)
    f = omega / TAU * (1.0 + zeta * np.linspace(-8.0, 8.0, 400001))
    size = np.abs(loop.response(f))
    (lobe,) = m.lobes
    assert lobe.peak_db == pytest.approx(db(size.max()), abs=1e-7)
    assert lobe.damping_ratio == pytest.approx(zeta, rel=1e-6)
    crossed = np.flatnonzero((size[1:] > 1.0) != (size[:-1] > 1.0))
    assert len(m.gain_crossings.frequency_hz) == len(crossed) == 2
    assert m.gain_crossings.frequency_hz == pytest.approx(f[crossed], rel=1e-4 * zeta)
    assert m.modulus == pytest.approx(np.abs(1.0 + loop.response(f)).min(), rel=1e-7)


def test_a_curve_that_just_touches_the_unit_circle_is_seen_both_ways():
    """|L| with a maximum of 1 +- 1e-9 between grid points has two crossings or none."""
    parts = [(3.0, 0.3, 1.0, 0.4), (4.0, 0.2, -0.3, 0.1)]
    shape = ModalLoop.of([], parts)
    peak = np.abs(shape.response(np.linspace(0.3, 0.7, 400001))).max()
    for change, crossings in ((1e-9, 2), (-1e-9, 0)):
        found = margins(ModalLoop.of([], parts, (1.0 + change) / peak)).gain_crossings
        assert len(found.frequency_hz) == crossings


def test_a_phase_that_just_touches_180_degrees_is_seen_both_ways():
    """s^-2 with corners of lead, lag, lead has a phase that falls to -180 deg between them and rises again."""

    def loop(pole: float) -> TransferLoop:
        return TransferLoop(np.poly([-1.0, -8.0, -30.0]), np.poly([0.0, 0.0, -2.0, -pole, -90.0]))

    w = np.geomspace(1.5, 60.0, 40001)
    low, high = 2.0, 8.0
    for _ in range(60):
        pole = 0.5 * (low + high)
        lead = np.arctan(w) - np.arctan(w / 2) + np.arctan(w / 8) - np.arctan(w / pole)
        low, high = (pole, high) if (lead + np.arctan(w / 30) - np.arctan(w / 90)).min() < 0.0 else (low, pole)
    counts = [int((margins(loop(high + change)).phase_crossings.turn != 0).sum()) for change in (-1e-6, 1e-6)]
    assert counts == [2, 0]
