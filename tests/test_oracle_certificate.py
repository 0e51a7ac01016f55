"""The loop measured in the nonlinear simulator equals the exact sampled linear loop.

| quantity | expected |
|---|---|
| frequency response in a held flight, 0.05 to 12 Hz | within 0.2 dB and 1.5 deg, or three standard errors |
| gain and delay at which the flight becomes unstable | the linear loop's margins: 0.05 dB, 1 % of the delay |
| speed and vehicle of a held flight | unchanged |
"""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import maxq
from maxq import Loop, margins
from maxq.design.certificate import measured_margins
from maxq.design.certificate.certificate import certify_node
from maxq.design.certificate.excitation import LineBand, band, excitation_level
from maxq.design.certificate.held_flight import hold
from maxq.design.certificate.measured_margins import growth_rate, measure_margin
from maxq.design.certificate.response import BANDS as RESPONSE_BANDS
from maxq.design.certificate.response import _estimated, _spectra, measure
from maxq.sim.packing.flight import Packed
from maxq.sim.run.evaluate import evaluate_at
from maxq.sim.scenario.loader import load_scenario
from maxq.sim.vehicle.state import Q_BI

TIME_S = 40.0
BANDS = (band(0.05, 2.5, 14, 40.0, 40.0, 4), band(2.75, 12.0, 12, 40.0, 12.0, 2))


@pytest.fixture(scope="module", params=["pitch", "yaw"])
def held(request: pytest.FixtureRequest):
    loaded = load_scenario("nominal")
    return hold(loaded, maxq.nodes(loaded, [TIME_S], plane=request.param)[0])


@pytest.fixture(scope="module")
def loop(held) -> Loop:
    assert held.loaded.design is not None
    return maxq.loops([held.node], held.loaded.design)[0]


def test_a_held_flight_has_no_navigation_errors(held) -> None:
    errors = "navigation.alignment_error_deg=[0.0,2.0,-1.0]"
    loaded = load_scenario("nominal", ["vehicle.computer.attitude=quaternion", errors])
    run = hold(loaded, held.node).run(1.0, ())
    while not run.finished:
        run.fly_segment()
    after = run.present()
    for axis in ("pitch", "yaw"):
        assert abs(after[f"error_{axis}_deg"]) < 1e-3


def test_held_flight_keeps_speed_mass_and_gains(held) -> None:
    run = held.run(60.0, ())
    run.fly_segment()  # the gains are read at the first tick
    before = run.present()
    while not run.finished:
        run.fly_segment()
    after = run.present()
    for name in ("airspeed_mps", "mach", "dynamic_pressure_Pa", "mass_kg", "Iyy_kgm2", "axial_load_g", "k_p_pitch"):
        assert after[name] == pytest.approx(before[name], rel=1e-6), name
    assert abs(after["alpha_total_deg"]) < 0.01


@pytest.mark.slow
@pytest.mark.parametrize("lines", BANDS, ids=["low", "middle"])
def test_response_in_flight_is_that_of_the_sampled_loop(held, loop: Loop, lines: LineBand) -> None:
    seen = measure(held, lines, excitation_level(held, loop, lines), loop.closed_poles())
    ratio = seen.response / loop.response(seen.lines_hz)
    assert seen.outcome == "duration"
    assert seen.saturated_s == 0.0
    assert (seen.coherence > 0.99).mean() > 0.9
    sure = seen.coherence > 0.99
    noise_db = 3.0 * 20.0 * np.log10(1.0 + seen.error)
    assert (np.abs(20.0 * np.log10(np.abs(ratio))) < np.maximum(0.2, noise_db))[sure].all()
    assert (np.abs(np.degrees(np.angle(ratio))) < np.maximum(1.5, 3.0 * np.degrees(seen.error)))[sure].all()


@pytest.mark.slow
def test_gravity_along_the_body_follows_it_and_leaves_its_loop() -> None:
    """Gravity fixed along the body turns with the attitude (SciPy), and the loop is that without gravity.

    The lowest line distinguishes it from the loop with gravity.
    """
    loaded = load_scenario("nominal")
    node = maxq.nodes(loaded, [TIME_S])[0]
    held, other = hold(loaded, node, along_body=True), hold(loaded, node)
    y = held.packed.state.copy()
    turned = Rotation.random(random_state=1)
    y[Q_BI : Q_BI + 4] = np.roll(turned.as_quat(), 1)
    felt = evaluate_at(held.packed, y, TIME_S).aux.air.gravitation_I_mps2
    load = node.axial_load_mps2
    np.testing.assert_allclose(felt, -load * turned.apply([1.0, 0.0, 0.0]), rtol=1e-9)
    assert loaded.design is not None
    mine, with_gravity = maxq.loops([held.node, other.node], loaded.design)
    lines = BANDS[0]
    seen = measure(held, lines, excitation_level(held, mine, lines), mine.closed_poles())
    assert np.abs(20.0 * np.log10(np.abs(seen.response / mine.response(seen.lines_hz)))).max() < 0.1
    assert abs(seen.response[0] / with_gravity.response(seen.lines_hz)[0] - 1.0) > 0.1


@pytest.mark.long
def test_load_relief_is_certified_where_its_held_flight_topples() -> None:
    """With accelerometer and second gyro in the loop, flight and linear loop agree in the lines and in two margins."""
    loaded = load_scenario("load-relief")
    node = maxq.nodes(loaded, [30.0], plane="yaw")[0]
    assert loaded.design is not None
    assert not margins(maxq.loops([hold(loaded, node).node], loaded.design)[0]).stable
    found = certify_node(loaded, node, bands=RESPONSE_BANDS[:2], names=("gain_up", "delay"))
    assert found.agrees, found.unexplained
    assert [math.isfinite(row.measured) for row in found.margins] == [True, True]

    def deaf(packed: Packed) -> None:
        packed.parameters[0].computer.law.relief.share *= 0.5

    assert not certify_node(loaded, node, fault=deaf, bands=RESPONSE_BANDS[:1], names=()).agrees


def test_measured_margins_are_those_of_the_linear_loop(held, loop: Loop) -> None:
    of_loop = margins(loop)
    gain, delay = (measure_margin(held, loop, of_loop, what) for what in ("gain_up", "delay"))
    assert abs(gain.difference) < 0.05
    assert abs(delay.difference) < 0.01 * delay.linear


def test_growth_of_a_known_oscillation() -> None:
    times = np.arange(4000) * 0.01
    ringing = np.exp(0.031 * times) * np.sin(2 * np.pi * 1.7 * times + 0.3) + 5.0 * np.exp(-0.02 * times)
    assert growth_rate(ringing, 0.01, 1.7, 4.0 / 1.7) == pytest.approx(0.031, abs=2e-4)


def test_growth_of_a_slow_oscillation_beside_a_drift() -> None:
    """Growth is exact for two periods in a window with a decaying root of ten times the amplitude."""
    times = np.arange(100_000) * 0.01
    swing = np.exp(0.002 * times) * np.sin(2 * np.pi * 0.01 * times + 0.3)
    assert growth_rate(swing + 10.0 * np.exp(-0.004 * times), 0.01, 0.01, 200.0) == pytest.approx(0.002, abs=3e-4)


def test_growth_changes_with_the_gain_as_a_line_does(monkeypatch: pytest.MonkeyPatch) -> None:
    """The slope is that of the pole next to the critical frequency, 2 rad/s, which moves by 0.7/s per dB of gain."""
    bound: Any = SimpleNamespace(value=6.0, frequency_hz=1.0 / np.pi)

    def altered(loop: Loop, what: str, amount: float) -> Any:
        return SimpleNamespace(closed_poles=lambda: np.array([0.7 * amount - 3.0 + 2j, 9.0 - 1j]))

    monkeypatch.setattr(measured_margins, "altered", altered)
    assert measured_margins._slope(cast("Any", None), "gain_up", bound) == pytest.approx(0.7, rel=1e-12)


def test_neither_mean_nor_nyquist_counts_as_noise() -> None:
    """The bins of the mean and of Nyquist, with the offset and half a tone, are excluded from the error."""
    top = LineBand(np.array([45.0, 49.5]), 4.0, 4.0, 1)
    lines = np.round(top.lines_hz * top.period_s).astype(int)
    rng = np.random.default_rng(4)
    out = 1e-3 * (rng.normal(size=201) + 1j * rng.normal(size=201))
    out[lines], into = 0.5, np.ones(201, complex)
    quiet = _estimated(top, out, into, 0.0, "")
    out[[0, -1]] = 100.0
    loud = _estimated(top, out, into, 0.0, "")
    assert loud.error.tolist() == quiet.error.tolist()
    assert quiet.response == pytest.approx([-0.5, -0.5])  # L = -U / E
    assert (quiet.error > 1e-4).all()
    assert quiet.coherence == pytest.approx(1.0 / (1.0 + quiet.error**2))  # signal over signal and noise, in power


def test_a_flight_that_ends_a_sample_early_has_no_response() -> None:
    """Two periods of ten samples after five need one more row, because a command is read one row later."""
    short = LineBand(np.array([1.0]), period_s=1.0, settle_s=0.5, periods=2)
    rows = np.random.default_rng(4).normal(size=(2, 26))
    assert _spectra(short, 0.1, rows[0, :25], rows[1, :25]) is None
    found = _spectra(short, 0.1, *rows)
    assert found is not None
    for spectra, begins in zip(found, (([5, 15], rows[0]), ([6, 16], rows[1])), strict=True):
        at, row = begins
        wave = np.exp(-2j * np.pi * np.outer(np.arange(6), np.arange(10)) / 10.0)
        np.testing.assert_allclose(spectra, [wave @ row[k : k + 10] for k in at], atol=1e-12)


def test_trials_follow_the_secant_and_stay_between_what_decayed_and_what_grew() -> None:
    """With growth -1 at 2 dB and +1 at 4 dB, the next trial is the root of the secant, inside the bracket."""
    following = measured_margins.following_trial
    assert following([(2.0, -1.0)], 0.5, 10.0, 0.01) == 4.0  # by the slope that is given
    assert following([(2.0, -1.0)], 0.5, 1.5, 0.01) == 3.5  # the largest step
    assert following([(2.0, -1.0), (4.0, 1.0)], 0.5, 10.0, 0.01) == 3.0
    assert following([(4.0, 1.0), (2.0, -1.0), (2.1, -0.999)], 0.5, 10.0, 0.01) == pytest.approx(3.05)  # midway
    assert following([(2.0, -1.0), (2.001, -0.5)], 0.5, 10.0, 0.01) == pytest.approx(3.001)  # too near for a secant
