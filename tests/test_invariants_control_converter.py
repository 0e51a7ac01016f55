"""The pulses of the V/F converter follow the true angle without drift, and mirror it."""

from __future__ import annotations

import math
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from maxq.control.converter import ConverterState, convert, make_converter, round_half_away
from maxq.control.kernel.records import blank, pack

FINEST_COUNT_RAD = 1e-9

INCREMENTS = st.lists(st.floats(-0.05, 0.05), min_size=1, max_size=60)
COUNTS_RAD = st.floats(1e-9, 1e-2)


def counted(count_rad: float, increments_rad: list[float]) -> list[ConverterState]:
    """Return a copy of the state after each sample of a rotation about body y."""
    converter, states, after = pack([make_converter(count_rad)])[0], blank(ConverterState), []
    for increment_rad in increments_rad:
        convert(converter, states[0], 1, increment_rad)
        after.append(states.copy()[0])
    return after


@pytest.mark.slow
@settings(deadline=None, max_examples=200)
@given(COUNTS_RAD, INCREMENTS)
def test_pulses_never_leave_the_true_angle(count_rad: float, increments_rad: list[float]) -> None:
    """In exact arithmetic, the pulses are within half a pulse of the true angle after every sample, plus rounding."""
    true, total = Fraction(0), 0
    for increment_rad, state in zip(increments_rad, counted(count_rad, increments_rad), strict=True):
        true += Fraction(increment_rad)
        total += int(state.counts[1])
        assert total == state.total_counts[1]
        assert abs(total * Fraction(count_rad) - true) <= Fraction(count_rad) * Fraction(1001, 2000)
        assert abs(state.residual_rad[1]) <= 0.5001 * count_rad
        assert state.angle_rad[1] == total * count_rad


@pytest.mark.slow
def test_a_long_flight_does_not_drift() -> None:
    """Over 400 s at 100 Hz, a rate far below one pulse per sample and one far above it do not drift."""
    count_rad = 1e-5
    increments_rad = [1.23456e-7] * 20_000 + [3.21e-3] * 20_000
    last = counted(count_rad, increments_rad)[-1]
    true = sum(map(Fraction, increments_rad))
    assert abs(int(last.total_counts[1]) * Fraction(count_rad) - true) < Fraction(count_rad) * Fraction(501, 1000)


@settings(deadline=None, max_examples=50)
@given(COUNTS_RAD, INCREMENTS)
def test_a_mirrored_rate_gives_mirrored_pulses(count_rad: float, increments_rad: list[float]) -> None:
    mirrored = counted(count_rad, [-x for x in increments_rad])
    for state, other in zip(counted(count_rad, increments_rad), mirrored, strict=True):
        assert state.counts[1] == -other.counts[1]
        assert state.residual_rad[1] == -other.residual_rad[1]


def test_halves_round_away_from_zero() -> None:
    assert [round_half_away(x) for x in (-1.5, -0.5, -0.4, 0.0, 0.4, 0.5, 1.5)] == [-2, -1, 0, 0, 0, 1, 2]


def test_ideal_converter_hands_the_increment_on() -> None:
    increments_rad = [0.1, -0.03, 1e-9]
    after = counted(0.0, increments_rad)
    assert [s.increment_rad[1] for s in after] == increments_rad
    assert after[-1].angle_rad[1] == 0.1 - 0.03 + 1e-9
    assert after[-1].total_counts[1] == 0


@pytest.mark.parametrize("count_rad", [-1e-5, FINEST_COUNT_RAD / 2, math.nan, math.inf])
def test_refused_pulses(count_rad: float) -> None:
    with pytest.raises(ValueError, match=rf"count_rad = {count_rad}: allowed is 0 \(ideal\) or at least 1e-09"):
        make_converter(count_rad)


def test_axes_do_not_touch_each_other() -> None:
    state = counted(1e-5, [0.01])[0]
    np.testing.assert_array_equal(state.counts, [0, 1000, 0])
