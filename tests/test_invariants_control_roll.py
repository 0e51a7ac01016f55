"""Roll thrusters on a pure inertia have the expected limit cycle, switching line, hysteresis and minimum pulse."""

from __future__ import annotations

import math

import pytest

from maxq.control.kernel.records import blank, pack
from maxq.control.roll import RollState, make_roll, silence_roll, start_roll, update_roll

SAMPLE_NS = 10_000_000
DEAD_BAND_RAD = math.radians(1.0)
HYSTERESIS_RAD = math.radians(0.2)


def demands(errors_rad: list[float], minimum_on_s: float = 0.0) -> list[int]:
    """Return the roll demands for errors at rest, sample by sample."""
    roll = pack([make_roll(SAMPLE_NS, 0.5, DEAD_BAND_RAD, HYSTERESIS_RAD, minimum_on_s)])[0]
    state, out = blank(RollState)[0], []
    for error_rad in errors_rad:
        update_roll(roll, state, error_rad, 0.0)
        out.append(int(state.demand))
    return out


@pytest.mark.slow
@pytest.mark.parametrize("rate_degps", [-3.0, 0.4, 3.0])
@pytest.mark.parametrize("minimum_on_s", [0.0, 0.02])
def test_limit_cycle_stays_in_the_dead_band(rate_degps: float, minimum_on_s: float) -> None:
    roll = pack([make_roll(SAMPLE_NS, 0.5, DEAD_BAND_RAD, HYSTERESIS_RAD, minimum_on_s)])[0]
    state = blank(RollState)[0]
    sample_s, torque_per_inertia = SAMPLE_NS / 1e9, 150.0 / 700.0
    angle, rate, largest = math.radians(4.0), math.radians(rate_degps), 0.0
    for k in range(30_000):
        acceleration = torque_per_inertia * state.demand
        angle += rate * sample_s + 0.5 * acceleration * sample_s**2
        rate += acceleration * sample_s
        update_roll(roll, state, angle, rate)
        if k > 6_000:
            largest = max(largest, abs(angle))
    assert 0.5 * DEAD_BAND_RAD < largest <= DEAD_BAND_RAD
    assert state.firings < 300


def test_positive_error_or_rate_asks_for_negative_torque() -> None:
    roll = pack([make_roll(SAMPLE_NS, 0.5, DEAD_BAND_RAD, HYSTERESIS_RAD, 0.0)])[0]
    for error_rad, rate_radps, expected in ((0.1, 0.0, -1), (0.0, 0.1, -1), (-0.1, 0.0, 1), (0.0, -0.1, 1)):
        state = blank(RollState)[0]
        update_roll(roll, state, error_rad, rate_radps)
        assert state.demand == expected
        assert state.switching_rad == error_rad + 0.5 * rate_radps


@pytest.mark.parametrize("sign", [1, -1])
def test_hysteresis(sign: int) -> None:
    errors_deg = [0.9, 0.99, 1.01, 0.9, 0.81, 0.79, 0.9, 0.99, 1.01]
    got = demands([sign * math.radians(x) for x in errors_deg])
    assert got == [-sign * on for on in (0, 0, 1, 1, 1, 0, 0, 0, 1)]


def test_a_firing_lasts_its_minimum_whatever_the_error_becomes() -> None:
    errors_deg = [2.0, 0.0, -2.0, -2.0, 0.0, 0.0, 0.0, 0.0]
    assert demands([math.radians(x) for x in errors_deg], 0.03) == [-1, -1, -1, 1, 1, 1, 0, 0]


def test_minimum_on_time_is_whole_samples_rounded_up() -> None:
    ticks = [make_roll(SAMPLE_NS, 0.5, 1.0, 0.2, s).minimum_on_ticks for s in (0.0, 0.005, 0.01, 0.02, 0.021)]
    assert ticks == [0, 1, 1, 2, 3]


def test_firings_are_counted_from_the_start() -> None:
    roll = pack([make_roll(SAMPLE_NS, 0.5, DEAD_BAND_RAD, HYSTERESIS_RAD, 0.0)])[0]
    state = blank(RollState)[0]
    for _ in range(2):  # whatever was before
        getattr(start_roll, "py_func", start_roll)(state)
        for fired, error_deg in enumerate((2.0, 0.0, -2.0, 0.0, 2.0)):
            update_roll(roll, state, math.radians(error_deg), 0.0)
            assert state.firings == 1 + fired // 2


def test_silence_is_at_once() -> None:
    state = blank(RollState)[0]
    roll = pack([make_roll(SAMPLE_NS, 0.5, DEAD_BAND_RAD, HYSTERESIS_RAD, 1.0)])[0]
    update_roll(roll, state, 1.0, 0.0)
    silence_roll(state)
    assert state.demand == 0


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ((-0.1, 0.1, 0.0, 0.0), "k_rate_s = -0.1: allowed"),
        ((0.5, 0.0, 0.0, 0.0), "dead_band_rad = 0.0: allowed"),
        ((0.5, 0.1, 0.2, 0.0), "hysteresis_rad = 0.2: allowed is from 0 to dead_band_rad"),
        ((0.5, 0.1, 0.0, math.inf), "minimum_on_s = inf: allowed"),
        ((math.nan, 0.1, 0.0, 0.0), "k_rate_s = nan: allowed"),
    ],
)
def test_refused_parameters(values: tuple[float, float, float, float], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        make_roll(SAMPLE_NS, *values)
