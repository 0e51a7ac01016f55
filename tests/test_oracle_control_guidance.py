"""Commanded angles equal SciPy's integrals of the commanded rates as piecewise polynomials."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.interpolate import PchipInterpolator, PPoly

from maxq.control.guidance import programme_angle, rate_programme
from maxq.control.kernel.records import Array, pack
from maxq.control.kernel.tables import NO_TABLE, Pool, fit, look_up

ROLL, PITCH, YAW = 0, 1, 2  # body axes x, y, z

TIME_S = np.array([2.0, 5.0, 6.5, 20.0, 55.0])
PITCH_RADPS = np.array([0.01, -0.02, -0.015, -0.004, 0.003])


def placed(method: str, **rates: Array | float) -> tuple:
    pool = Pool()
    pool.add(fit([0.0, 1.0], [[1.0], [2.0]]))  # so that the programme does not lie at offset 0
    ref = pool.add(rate_programme(TIME_S, PITCH_RADPS, method=method, **rates))
    return pool.array(), pack([ref])[0]


def reference(method: str) -> PPoly:
    if method == "pchip":
        return PchipInterpolator(TIME_S, PITCH_RADPS)
    slopes = np.diff(PITCH_RADPS) / np.diff(TIME_S) * (method == "linear")
    return PPoly([slopes, PITCH_RADPS[:-1]], TIME_S)


@pytest.mark.parametrize("method", ["linear", "pchip", "step"])
def test_angle_is_the_exact_integral_of_the_rate(method: str) -> None:
    pool, ref = placed(method)
    rate = reference(method)
    angle = rate.antiderivative()
    for t in np.linspace(TIME_S[0], TIME_S[-1], 401)[:-1]:
        assert look_up(pool, ref, t, PITCH) == pytest.approx(float(rate(t)), rel=1e-12, abs=1e-16)
        assert programme_angle(pool, ref, t, PITCH) == pytest.approx(float(angle(t)), rel=1e-12, abs=1e-16)


@pytest.mark.parametrize("method", ["linear", "pchip", "step"])
def test_end_rates_hold_outside(method: str) -> None:
    pool, ref = placed(method)
    end_rad = float(reference(method).antiderivative()(TIME_S[-1]))
    assert look_up(pool, ref, 70.0, PITCH) == pytest.approx(PITCH_RADPS[-1], rel=1e-12)
    assert programme_angle(pool, ref, 75.0, PITCH) == pytest.approx(end_rad + 20 * PITCH_RADPS[-1], rel=1e-12)
    assert look_up(pool, ref, 0.0, PITCH) == PITCH_RADPS[0]
    assert programme_angle(pool, ref, 0.0, PITCH) == pytest.approx(-2.0 * PITCH_RADPS[0], rel=1e-12)


def test_axes_have_their_own_rates() -> None:
    pool, ref = placed("linear", yaw_radps=-PITCH_RADPS, roll_radps=0.25)
    at = [programme_angle(pool, ref, 30.0, axis) for axis in (ROLL, PITCH, YAW)]
    assert at[0] == pytest.approx(0.25 * 28.0, rel=1e-12)
    assert at[1] == pytest.approx(float(reference("linear").antiderivative()(30.0)), rel=1e-12)
    assert at[2] == -at[1]


def test_one_point_is_a_constant_rate() -> None:
    pool = Pool()
    ref = pack([pool.add(rate_programme([3.0], [0.1]))])[0]
    assert programme_angle(pool.array(), ref, 8.0, PITCH) == pytest.approx(0.5, rel=1e-14)


def test_without_a_programme_nothing_is_commanded() -> None:
    ref = pack([NO_TABLE])[0]
    assert programme_angle(np.zeros(1), ref, 5.0, PITCH) == 0.0


def test_refused_programmes() -> None:
    with pytest.raises(ValueError, match="yaw_radps has 2 values: allowed is 1 or 3"):
        rate_programme([0.0, 1.0, 2.0], 0.0, yaw_radps=[0.0, 1.0])
    with pytest.raises(ValueError, match="finite"):
        rate_programme([0.0, 1.0], [0.0, np.nan])
    with pytest.raises(ValueError, match="increase strictly"):
        rate_programme([1.0, 1.0], [0.0, 0.0])
