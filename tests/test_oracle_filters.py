"""Bending filters agree with python-control and scipy.signal.

| quantity | oracle |
|---|---|
| continuous frequency response | control.tf, evaluated at jω |
| bilinear, prewarped, matched, zoh | control.sample_system of the whole product, by frequency response |
| zoh | step response of the continuous filter at the sample instants (scipy.signal.StateSpace) |
| exactness at the prewarp frequency | the continuous filter itself, to 1e-12 |
| running the cascade | scipy.signal.sosfilt |
"""

from __future__ import annotations

import math

import control
import numpy as np
import pytest
import scipy.signal

from maxq.control.filters import BendingFilter, FirstOrderSection, QuadraticSection, filter_sample, settle_filter
from maxq.design.laws.bending_filter import laplace_axis

MAX_SECTIONS = 8

SAMPLE_S = 0.01
PREWARP_HZ = 9.2

Q = (QuadraticSection(9.0, 0.3, 7.0, 0.7), QuadraticSection(24.0, 0.1, 12.0, 0.9))
F = (FirstOrderSection(30.0, 5.0), FirstOrderSection(-14.0, 20.0))
FILTERS: dict[str, BendingFilter] = {
    "F2": BendingFilter(Q[:1]),
    "F3": BendingFilter(Q[:1], F[:1]),
    "F4": BendingFilter(Q),
    "F5": BendingFilter(Q, F[:1]),
    "F6": BendingFilter(Q, F),
    "sections": BendingFilter((*Q, QuadraticSection(15.0, 0.2, 11.0, 0.5))),
}
OVERDAMPED = BendingFilter((QuadraticSection(8.0, 1.7, 6.0, 1.3),))
EVERY = pytest.mark.parametrize("bending", [*FILTERS.values(), OVERDAMPED], ids=[*FILTERS, "overdamped"])
METHODS = pytest.mark.parametrize("method", ["prewarped", "bilinear", "matched", "zoh"])


def discretize(bending: BendingFilter, method: str) -> object:
    return bending.discretize(SAMPLE_S, method, PREWARP_HZ)


def transfer_function(bending: BendingFilter) -> control.TransferFunction:
    """Return the same filter, written independently from eqs 37 to 41."""
    s = control.tf("s")
    out = control.tf(1, 1)
    for q in bending.quadratic:
        w_z, w_p = 2 * math.pi * q.zero_hz, 2 * math.pi * q.pole_hz
        out *= (s**2 / w_z**2 + 2 * q.zero_zeta * s / w_z + 1) / (s**2 / w_p**2 + 2 * q.pole_zeta * s / w_p + 1)
    for f in bending.first_order:
        out *= (s / (2 * math.pi * f.zero_hz) + 1) / (s / (2 * math.pi * f.pole_hz) + 1)
    return out


OMEGA = 2 * math.pi * np.geomspace(0.05, 49.0, 60)


@EVERY
def test_continuous_response_is_that_of_the_transfer_function(bending: BendingFilter) -> None:
    np.testing.assert_allclose(bending.frequency_response(OMEGA), transfer_function(bending)(1j * OMEGA), rtol=1e-12)


@EVERY
@METHODS
def test_discrete_response_is_that_of_python_control(bending: BendingFilter, method: str) -> None:
    named = {"prewarped": "bilinear", "bilinear": "bilinear", "matched": "matched", "zoh": "zoh"}[method]
    warp = 2 * math.pi * PREWARP_HZ if method == "prewarped" else None
    reference = control.sample_system(transfer_function(bending), SAMPLE_S, named, prewarp_frequency=warp)
    # The oracle multiplies its polynomials out: with up to six poles near z = 1 that costs it some digits.
    np.testing.assert_allclose(
        discretize(bending, method).frequency_response(OMEGA), reference(np.exp(1j * OMEGA * SAMPLE_S)), rtol=1e-8
    )


@EVERY
@pytest.mark.parametrize("prewarp_hz", [0.5, 9.2, 23.5, 45.0])
def test_prewarped_is_exact_at_the_prewarp_frequency(bending: BendingFilter, prewarp_hz: float) -> None:
    omega = 2 * math.pi * prewarp_hz
    discrete = bending.discretize(SAMPLE_S, "prewarped", prewarp_hz).frequency_response(omega)
    assert abs(discrete / bending.frequency_response(omega) - 1) < 1e-12


@EVERY
@METHODS
def test_gain_at_rest_is_one(bending: BendingFilter, method: str) -> None:
    assert abs(bending.frequency_response(0.0) - 1) < 1e-15
    assert abs(discretize(bending, method).frequency_response(0.0) - 1) < 1e-12


@EVERY
def test_zoh_is_step_invariant(bending: BendingFilter) -> None:
    """The whole cascade, not each section, equals the continuous filter's step response at the samples."""
    instants = np.arange(200) * SAMPLE_S
    tf = transfer_function(bending)
    state_space = control.tf2ss(tf)
    _, expected = control.step_response(state_space, instants)
    np.testing.assert_allclose(run(bending, "zoh", np.ones(200)), expected, rtol=0, atol=1e-9)


def run(bending: BendingFilter, method: str, signal: np.ndarray) -> np.ndarray:
    discrete = discretize(bending, method)
    memory = np.zeros((MAX_SECTIONS, 2))
    sections = discrete.padded()
    return np.array([filter_sample(sections, discrete.n_sections, memory, float(x)) for x in signal])


@EVERY
@METHODS
def test_cascade_runs_like_sosfilt(bending: BendingFilter, method: str) -> None:
    sections = discretize(bending, method).sections
    sos = np.insert(sections, 3, 1.0, axis=1)
    impulse = np.zeros(300)
    impulse[0] = 1.0
    noise = np.random.default_rng(4).normal(size=300)
    for signal in (impulse, noise):
        np.testing.assert_allclose(run(bending, method, signal), scipy.signal.sosfilt(sos, signal), rtol=0, atol=1e-12)


@EVERY
@METHODS
def test_settled_filter_has_no_transient(bending: BendingFilter, method: str) -> None:
    discrete = discretize(bending, method)
    memory = np.zeros((MAX_SECTIONS, 2))
    settle_filter(discrete.padded(), discrete.n_sections, memory, 0.7)
    out = [filter_sample(discrete.padded(), discrete.n_sections, memory, 0.7) for _ in range(200)]
    np.testing.assert_allclose(out, 0.7, rtol=0, atol=1e-12)


@METHODS
def test_as_many_sections_fit_as_are_allowed(method: str) -> None:
    more = [QuadraticSection(15.0 + k, 0.2, 11.0 + k, 0.5) for k in range(MAX_SECTIONS - len(Q))]
    bending = BendingFilter((*Q, *more))
    discrete = discretize(bending, method)
    assert discrete.n_sections == MAX_SECTIONS
    assert discrete.padded().shape == (MAX_SECTIONS, 5)
    sos = np.insert(discrete.sections, 3, 1.0, axis=1)
    impulse = np.eye(1, 300)[0]
    np.testing.assert_allclose(run(bending, method, impulse), scipy.signal.sosfilt(sos, impulse), rtol=0, atol=1e-12)


def test_no_sections_pass_the_signal_as_it_is() -> None:
    discrete = BendingFilter().discretize(SAMPLE_S)
    assert discrete.n_sections == 0
    assert filter_sample(discrete.padded(), 0, np.zeros((MAX_SECTIONS, 2)), 0.123) == 0.123


@pytest.mark.parametrize(("sample_s", "prewarp_hz"), [(None, None), (0.01, 9.2), (0.004, 20.0)])
def test_slope_and_curvature_of_the_frequency_axis(sample_s: float | None, prewarp_hz: float | None) -> None:
    """Slope and curvature equal fourth-order differences over ln f to 1e-9 and rounding."""
    x, h = np.log(np.array([0.3, 2.0, 9.2, 31.0])), 1e-3

    def s(n: int) -> np.ndarray:
        return laplace_axis(x + n * h, sample_s, prewarp_hz)[0]

    _, slope, curvature = laplace_axis(x, sample_s, prewarp_hz)
    np.testing.assert_allclose(slope, (8.0 * (s(1) - s(-1)) - s(2) + s(-2)) / (12.0 * h), rtol=1e-7)
    np.testing.assert_allclose(
        curvature, (16.0 * (s(1) + s(-1)) - s(2) - s(-2) - 30.0 * s(0)) / (12.0 * h**2), rtol=1e-6
    )
