"""Dryden turbulence against its spectra and against the exact discretisation in 30 digits."""

from __future__ import annotations

import math

import mpmath
import numba
import numpy as np
import pytest
import scipy.signal

from maxq.control.kernel.records import blank, pack
from maxq.control.kernel.tables import Pool
from maxq.sim.world.turbulence import (
    FOOT_m,
    Turbulence,
    TurbulenceState,
    exceedance_table,
    intensity_table,
    second_order_step,
    turbulence_at,
    turbulence_start,
    turbulence_tick,
)

SIGMA = (2.0, 3.0, 0.5)
LENGTH = (20.0, 30.0, 15.0)  # short, so that a run of minutes holds thousands of independent gusts
AIRSPEED = 100.0
TICKS = 2**14 if numba.config.DISABLE_JIT else 2**18  # every bound below follows the number of samples
SEGMENT = 4096


def setting(table, seed=1, **more):
    pool = Pool()
    ref = pool.add(table)
    return pack([Turbulence(1, ref, seed, **more)])[0], pool.array()


@numba.njit
def fly(turbulence, pool, state, airspeed, altitude, out):
    turbulence_start(turbulence, pool, state, altitude)
    for i in range(len(out)):
        turbulence_tick(turbulence, pool, state, airspeed, altitude)
        out[i, 0], out[i, 1], out[i, 2] = turbulence_at(state, 1.0)


def history(seed, ticks=TICKS, airspeed=AIRSPEED):
    row, pool = setting(intensity_table(0.0, SIGMA, LENGTH), seed)
    out = np.empty((ticks, 3))
    fly(row, pool, blank(TurbulenceState)[0], airspeed, 0.0, out)
    return out


@pytest.fixture(scope="module")
def gusts():
    return history(seed=1)


def test_variance_and_mean(gusts):
    """The standard error from the correlation length: 2 L / V seconds per independent sample, at most."""
    samples = TICKS * 0.01 * AIRSPEED / (2 * np.array(LENGTH))
    assert np.all(np.abs(gusts.mean(axis=0)) < 4 * np.array(SIGMA) / np.sqrt(samples))
    assert np.all(np.abs(gusts.var(axis=0) / np.square(SIGMA) - 1) < 4 * np.sqrt(2 / samples))


def dryden(component, f):
    """One-sided spectral density over Hz, (m/s)^2/Hz: MIL-F-8785C 3.7.1.2."""
    s, n = SIGMA[component], LENGTH[component] / AIRSPEED
    x2 = (2 * math.pi * f * n) ** 2
    over_w = 2 * n / math.pi / (1 + x2) if component == 0 else n / math.pi * (1 + 3 * x2) / (1 + x2) ** 2
    return 2 * math.pi * s**2 * over_w


@pytest.mark.parametrize("component", [0, 1, 2])
def test_spectrum(gusts, component):
    f, got = scipy.signal.welch(gusts[:, component], fs=100.0, nperseg=SEGMENT)
    # sampling folds what lies above 50 Hz back, and that must be in the comparison
    expected = sum(dryden(component, np.abs(f + 100.0 * k)) for k in range(-400, 401))
    for low, high in [(0.1, 0.3), (0.3, 0.7), (0.7, 1.5), (1.5, 4.0), (4.0, 10.0), (10.0, 45.0)]:
        band = (f >= low) & (f < high)
        # half-overlapping Hann segments: 2 TICKS / SEGMENT of them, worth 0.53 independent ones each (Welch),
        # and every second bin of a Hann window is independent of the others
        error = 4 / math.sqrt(0.53 * 2 * TICKS / SEGMENT * max(1, band.sum() // 2))
        assert np.mean(got[band] / expected[band]) == pytest.approx(1.0, abs=error)


def test_components_are_independent(gusts):
    samples = TICKS * 0.01 * AIRSPEED / (2 * max(LENGTH))
    correlation = np.corrcoef(gusts.T) - np.eye(3)
    assert np.abs(correlation).max() < 4 / math.sqrt(samples)


def test_seed_makes_the_field(gusts):
    assert np.array_equal(history(seed=1, ticks=500), gusts[:500])
    other = history(seed=2)
    samples = TICKS * 0.01 * AIRSPEED / (2 * max(LENGTH))
    for j in range(3):
        assert abs(np.corrcoef(gusts[:, j], other[:, j])[0, 1]) < 4 / math.sqrt(samples)


@pytest.mark.parametrize("theta", [0.0, 1e-8, 1e-4, 9.4e-3, 0.0499, 0.0501, 0.3, 2.0, 30.0])
def test_second_order_step_is_exact(theta):
    with mpmath.workdps(40):
        t = mpmath.mpf(theta)
        q = [
            mpmath.quad(lambda s, n=n: s**n * mpmath.exp(-2 * s), [0, t / 3, t]) if theta else mpmath.mpf(0)
            for n in range(3)
        ]
        l_11 = mpmath.sqrt(q[0])
        l_21 = q[1] / l_11 if theta else mpmath.mpf(0)
        expected = (mpmath.exp(-t), l_11, l_21, mpmath.sqrt(q[2] - l_21**2))
    assert second_order_step(theta) == pytest.approx(tuple(map(float, expected)), rel=2e-8)


def test_start_is_stationary():
    """No spin-up: over many seeds the first gust has already the full variance."""
    first = np.array([history(seed, ticks=1)[0] for seed in range(2000)])
    assert first.std(axis=0) == pytest.approx(np.array(SIGMA), rel=4 / math.sqrt(2 * 2000))


def test_still_vehicle_sees_a_frozen_gust():
    out = history(seed=3, ticks=50, airspeed=0.0)
    assert np.array_equal(out, np.broadcast_to(out[0], out.shape))
    assert np.all(out[0] != 0.0)


def test_linear_and_continuous_between_ticks():
    row, pool = setting(intensity_table(0.0, 1.0, 50.0))
    state = blank(TurbulenceState)[0]
    turbulence_start(row, pool, state, 0.0)
    at_start = turbulence_at(state, 0.0)
    assert at_start == turbulence_at(state, 1.0)
    turbulence_tick(row, pool, state, 300.0, 0.0)
    assert turbulence_at(state, 0.0) == at_start
    end = turbulence_at(state, 1.0)
    assert end != at_start
    assert turbulence_at(state, 0.25) == pytest.approx(
        tuple(0.75 * a + 0.25 * b for a, b in zip(at_start, end, strict=True))
    )
    turbulence_tick(row, pool, state, 300.0, 0.0)
    assert turbulence_at(state, 0.0) == pytest.approx(end, abs=1e-15)


def test_off_is_calm():
    state = blank(TurbulenceState)[0]
    off = pack([Turbulence()])[0]
    turbulence_start(off, np.zeros(1), state, 0.0)
    turbulence_tick(off, np.zeros(1), state, 300.0, 0.0)
    assert turbulence_at(state, 0.5) == (0.0, 0.0, 0.0)


def test_tick_length_enters_through_the_way_flown():
    """Twice the tick at half the speed is the same field."""
    table = intensity_table(0.0, SIGMA, LENGTH)
    last = []
    for tick_ns, airspeed in [(10_000_000, 200.0), (20_000_000, 100.0)]:
        row, pool = setting(table, tick_ns=tick_ns)
        out = np.empty((20, 3))
        fly(row, pool, blank(TurbulenceState)[0], airspeed, 0.0, out)
        last.append(out[-1])
    assert last[0] == pytest.approx(last[1], rel=1e-12)


def test_preset_intensities():
    """Figure 7 at a tabulated altitude, and the low-altitude model at 500 ft, worked by hand."""
    for level, at_15000_ft, wind_kt in [("light", 4.6, 15), ("moderate", 8.0, 30), ("severe", 22.1, 45)]:
        table = exceedance_table(level)
        assert table(15000 * FOOT_m) == pytest.approx([at_15000_ft * FOOT_m] * 3 + [1750 * FOOT_m] * 3)
        sigma_u, sigma_v, sigma_w, l_u, l_v, l_w = table(600 * FOOT_m)
        k = 0.177 + 0.000823 * 600
        assert sigma_w == pytest.approx(0.1 * wind_kt * 1852 / 3600)
        assert sigma_u == sigma_v == pytest.approx(sigma_w / k**0.4)
        assert l_w == pytest.approx(600 * FOOT_m)
        assert l_u == l_v == pytest.approx(600 * FOOT_m / k**1.2)
    # k = 1 at 1000 ft: there the three are equal, as the joint to the upper model wants
    assert exceedance_table("light")(1000 * FOOT_m)[:3] == pytest.approx([1.5 * 1852 / 3600] * 3, rel=1e-6)


def test_preset_over_high_ground():
    ground = 2000.0
    raised, level = exceedance_table("moderate", ground), exceedance_table("moderate")
    assert raised(ground + 100.0) == pytest.approx(level(100.0))
    assert raised(12e3) == pytest.approx(level(12e3))


def test_impossible_intensities_are_refused():
    with pytest.raises(ValueError, match="scale lengths"):
        intensity_table([0.0, 1.0], 1.0, 0.0)
    with pytest.raises(ValueError, match="intensities"):
        intensity_table(0.0, -1.0, 10.0)
