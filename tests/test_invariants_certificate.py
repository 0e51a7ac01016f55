"""The parts of the margin certificate are correct separately.

| case | expected |
|---|---|
| a signal of less than one pulse per sample, alone | vanishes or is magnified, hence the dither of measurements |
| the same with slow tones | keeps its amplitude |
| a slow command rounded under the two tones of its dither | has the gain of a Bessel series, within 0.4 % |
| these tones, integrated from rest | cause no mean rotation |
| lower gain margin of a slow root whose burst is three such steps | that of the linear loop |
| dither tones of a vehicle whose liquid swings at 0.83 Hz | are at other frequencies, and swing it a third as far |
| excitation level predicted by the linear loop | that of the flight, and below every limit |
| a stable loop; a loop beyond its stability boundary | decays; grows |
| margin bounded at half the sample rate | the linear loop's: its burst does not vanish between the samples |
| a margin that rounding changes by less than half a decibel | is reported as noise; a larger or lasting change is not |
| growth beyond the boundary | ends in a limit cycle or in a loss |
| a root that grows slowly, and only in the held flight | is reported as "drift"; wrong gravity appears in it |
| one that grows faster | is a disagreement that names the unstable loop |
| in-flight response of the ascent | agrees with the frozen loop, or its change in the window explains it |
"""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import scipy.special

import maxq
from maxq import LoadedScenario, margins
from maxq.control.converter import ConverterState, convert, make_converter
from maxq.control.kernel.jit import from_python
from maxq.control.kernel.records import blank, pack
from maxq.design.certificate.certificate import MarginRow, certify_node
from maxq.design.certificate.certificate import _with_noise as with_noise
from maxq.design.certificate.excitation import (
    LineBand,
    away_from_slosh,
    band,
    dither,
    dither_tones_hz,
    excitation_level,
    injections,
)
from maxq.design.certificate.held_flight import hold, linear_limits
from maxq.design.certificate.in_flight import _reason as reason_of
from maxq.design.certificate.in_flight import converters_share, in_flight_response
from maxq.design.certificate.measured_margins import LimitCycle, fine_dither, limit_cycle, measure_margin
from maxq.design.certificate.response import BANDS
from maxq.design.loop.fixed_path import fixed_path
from maxq.design.loop.loop import loops
from maxq.sim.packing.flight import Packed
from maxq.sim.scenario.loader import load_scenario

FINE_STEPS = 50.0
DITHER_HZ = 0.525, 0.825

PULSE_RAD = 1e-5


@pytest.fixture(scope="module")
def loaded() -> LoadedScenario:
    return load_scenario("nominal")


@pytest.fixture(scope="module")
def held(loaded: LoadedScenario):
    return hold(loaded, maxq.nodes(loaded, [40.0])[0])


@pytest.fixture(scope="module")
def certificate(loaded: LoadedScenario):
    return certify_node(loaded, maxq.nodes(loaded, [50.0])[0])


def _through_converter(increments_rad: np.ndarray, remainder_rad: float) -> np.ndarray:
    converter, state = pack([make_converter(PULSE_RAD)])[0], blank(ConverterState)
    count = from_python(convert)
    state[0].residual_rad[1] = remainder_rad
    out = []
    for x in increments_rad:
        count(converter, state[0], 1, float(x))
        out.append(float(state[0].increment_rad[1]))
    return np.array(out)


def _gain(pulses: float, slow_pulses: float, remainder: float = 0.0) -> float:
    """Return the gain of the converter at 29.7 Hz sampled at 100 Hz, by a transform over 40 s."""
    n, line = 4000, 1188
    turn = 2.0 * np.pi * np.arange(n) / n
    fast = PULSE_RAD * pulses * np.sin(line * turn + 0.4)
    slow = PULSE_RAD * slow_pulses * (np.sin(21 * turn) + np.sin(33 * turn))
    seen = np.fft.rfft(_through_converter(fast + slow, remainder * PULSE_RAD))[line]
    return float(abs(seen / np.fft.rfft(fast)[line]))


def test_converter_has_no_gain_of_its_own_only_when_dithered() -> None:
    assert _gain(0.2, 0.0, 0.0) < 0.1  # no pulse ever comes
    assert _gain(0.2, 0.0, 0.45) > 1.5  # whole pulses come
    noise = 0.05  # of rounding, 1/sqrt(12) pulse differenced, in one of 4000 bins, with a signal of 0.2 pulses
    assert _gain(0.2, 6.0, 0.0) == pytest.approx(1.0, abs=3.0 * noise)
    assert _gain(0.2, 6.0, 0.45) == pytest.approx(1.0, abs=3.0 * noise)
    assert _gain(20.0, 0.0) == pytest.approx(1.0, abs=0.005)


@pytest.mark.parametrize("steps", [7.0, FINE_STEPS])
def test_dither_of_fifty_steps_leaves_a_rounded_command_its_gain(steps: float) -> None:
    amplitudes = steps, steps * DITHER_HZ[1] / DITHER_HZ[0]  # the second one's sign is a phase
    time_s = 0.002 * np.arange(20000)  # three beats of the tones
    x, phases = np.linspace(0.0, 1.0, 41), 2.0 * np.pi * np.arange(20) / 20.0
    first, second = (a * np.sin(2.0 * np.pi * hz * time_s) for a, hz in zip(amplitudes, DITHER_HZ, strict=True))
    turned = amplitudes[1] * np.cos(2.0 * np.pi * DITHER_HZ[1] * time_s)
    tones = np.concatenate([first + np.cos(p) * second + np.sin(p) * turned for p in phases])
    mean = np.array([np.round(at + tones).mean() for at in x])
    order = np.arange(1, 200)
    bessel = np.prod([scipy.special.j0(2.0 * np.pi * order * a) for a in amplitudes], axis=0)
    terms = (-1.0) ** order * bessel / (np.pi * order)
    of_series = x + np.sin(2.0 * np.pi * np.outer(x, order)) @ terms
    assert np.abs(mean - of_series).max() < 0.001  # 400,000 samples of a phase in place of the mean over all
    off = np.abs(2.0 * np.cos(2.0 * np.pi * x) * bessel[0]).max()
    assert (off < 0.005) == (steps == FINE_STEPS)


def test_tones_of_the_dither_begin_without_a_kick(held) -> None:
    """Integrated from rest over three beats (whole turns of both), the tones of the dither cause no mean rotation."""
    (low, low_hz), (high, high_hz) = fine_dither(held)
    time_s = np.arange(0.0, 40.0, 1e-3)
    sines = [a * np.sin(2.0 * np.pi * hz * time_s) for a, hz in ((low, low_hz), (high, high_hz))]
    turned = [float(np.mean(np.cumsum(x) * 1e-3)) for x in sines]
    assert turned[0] == pytest.approx(low / (2.0 * np.pi * float(low_hz[0])), rel=1e-3)
    assert abs(sum(turned)) < 1e-3 * turned[0]


@pytest.mark.long
def test_slow_root_is_found_under_a_coarse_output() -> None:
    """At 3.056 s a burst of 0.0033 deg is three steps of the output: without dither the margin is 0.84 dB off."""
    robust = load_scenario("nominal", ['design="designs/ksr3-robust.toml"'])
    assert robust.design is not None
    held = hold(robust, maxq.nodes(robust, [3.056])[0])
    loop = maxq.loops([held.node], robust.design)[0]
    found = measure_margin(held, loop, margins(loop), "gain_down")
    assert (found.reason, found.frequency_hz) == ("", 0.0)
    assert abs(found.difference) < 0.06


@pytest.mark.slow
@pytest.mark.parametrize("lines", BANDS, ids=["low", "middle", "high"])
def test_excitation_does_what_the_linear_loop_predicts(held, lines: LineBand) -> None:
    assert held.loaded.design is not None
    loop = maxq.loops([held.node], held.loaded.design)[0]
    level = excitation_level(held, loop, lines)
    angle, rate = linear_limits(held)
    assert level.command_rad < angle
    assert level.servo_radps < rate
    run, rows = held.fly(lines.settle_s + lines.period_s, injections([*level.groups, *level.dither], "pitch"))
    command = np.radians(rows[round(lines.settle_s / held.sample_s) :, run.table.index("gimbal_pitch_command_deg")])
    assert np.abs(command).max() < 1.02 * level.command_rad
    assert np.abs(command).max() > 0.5 * level.command_rad


@pytest.mark.slow
def test_flight_and_linear_loop_agree_at_50_s(certificate) -> None:
    assert certificate.unexplained == ()
    assert [e.what for e in certificate.margins] == ["gain_up", "gain_down", "delay"]


def test_without_rounding_flight_and_sampled_loop_are_the_same(certificate) -> None:
    r = certificate.responses
    measured = np.isfinite(r.unrounded.real)
    assert measured.sum() >= 25
    above = measured & (20.0 * np.log10(np.abs(r.sampled)) > -50.0)
    assert np.abs(r.unrounded_db[above]).max() < 0.05
    assert np.abs(r.unrounded_deg[above]).max() < 0.5


def test_half_the_amplitude_measures_the_same(certificate) -> None:
    assert np.nanmax(np.abs(certificate.responses.nonlinear_db)) < 0.2


def test_margin_is_found_again_from_an_altered_flight(held) -> None:
    """A flight with 2 dB more gain has 2 dB less margin, although the linear loop is unchanged."""
    assert held.loaded.design is not None
    loop = maxq.loops([held.node], held.loaded.design)[0]

    def more_gain(packed: Packed) -> None:
        computer = packed.parameters[0].computer
        computer.law.pd.sections[0, 0, :3] *= 10.0**0.1

    found = measure_margin(dataclasses.replace(held, fault=more_gain), loop, margins(loop), "gain_up")
    assert found.reason == ""
    assert found.difference == pytest.approx(-2.0, abs=0.05)
    assert found.tried[0][1] > 0.0


@pytest.mark.slow
def test_margin_at_half_the_sample_rate(tmp_path: Path) -> None:
    """Two blended gyros are bounded correctly at 50 Hz, where a sine that starts at a sample is 0 at all samples.

    Such a burst gave 17.1 dB instead of 9.6 dB.
    """
    (tmp_path / "design.toml").write_text(
        "schema = 2\n[gains]\ntable = [{time_s=57.9, k_p=0.407, k_d_s=0.246}]\n[blend]\npitch = [0.4192, 0.5808]\n"
        "[filter]\nstructure = 'F4'\nprewarp_hz = 9.7\nquadratic = [{zero_hz=42.4, zero_zeta=0.1, pole_hz=12.94, "
        "pole_zeta=0.3}, {zero_hz=3.226, zero_zeta=0.739, pole_hz=7.19, pole_zeta=0.3}]\n"
    )
    blended = load_scenario("load-relief", [f"design={tmp_path / 'design.toml'}"])
    assert blended.design is not None
    held = hold(blended, maxq.nodes(blended, [57.9])[0], along_body=True)
    loop = maxq.loops([held.node], blended.design)[0]
    found = measure_margin(held, loop, margins(loop), "gain_up")
    assert (found.reason, found.frequency_hz) == ("", 50.0)
    assert abs(found.difference) < 0.15


def test_delay_that_does_not_fit_the_computer_is_named(loaded: LoadedScenario) -> None:
    """At 5 s ksr3-free tolerates a delay of 15 samples; the filter holds 12, so the margin is reported as longer."""
    patient = load_scenario("nominal", ['design="designs/ksr3-free.toml"'])
    held = hold(patient, maxq.nodes(patient, [5.0])[0])
    assert patient.design is not None
    loop = maxq.loops([held.node], patient.design)[0]
    found = measure_margin(held, loop, margins(loop), "delay")
    assert found.linear > 0.12
    assert (found.reason, found.tried) == ("longer than can be inserted", ())


def test_what_grows_ends_as_a_limit_cycle_or_is_lost(held) -> None:
    assert held.loaded.design is not None
    bound = margins(maxq.loops([held.node], held.loaded.design)[0]).gain_up_db

    def over(db: float):
        def change(packed: Packed) -> None:
            filters = packed.parameters[0].computer.law.pd
            filters.sections[0, int(filters.n_sections[0])] = [10.0 ** (db / 20.0), 0.0, 0.0, 0.0, 0.0]
            filters.n_sections[0] += 1

        return change

    hz = bound.frequency_hz
    assert limit_cycle(held, hz, over(bound.value - 1.0), 60.0).kind == "decays"
    ended = limit_cycle(held, hz, over(bound.value + 2.0), 120.0)
    assert ended.kind in ("limit cycle", "lost")
    if ended.kind == "limit cycle":
        assert ended.gimbal_deg > 0.01
        assert 0.5 * hz < ended.frequency_hz < 1.1 * hz  # the lag of an actuator at its limit makes it slower


@pytest.fixture(scope="module")
def drifting() -> LoadedScenario:
    """Return a scenario whose slowest root at 55 s, stable in the ascent, grows at 0.002 1/s when held."""
    return load_scenario("nominal", ['design="designs/ksr3-free.toml"'])


@pytest.mark.slow
def test_drift_of_a_held_loop_is_measured_and_named(drifting: LoadedScenario) -> None:
    found = certify_node(drifting, maxq.nodes(drifting, [55.0])[0], bands=BANDS[:1])
    assert found.agrees
    assert found.stable
    by_name = {e.what: e for e in found.margins}
    slow = by_name["drift"]
    assert slow.sampled < 0.0 < slow.held
    assert slow.measured == pytest.approx(slow.held, abs=2e-4)
    assert (slow.reason, by_name["gain_down"].reason) == ("frozen-point gravity", "frozen-point gravity")
    assert math.isfinite(by_name["gain_up"].measured)
    assert math.isfinite(by_name["delay"].measured)


def test_wrong_gravity_shows_in_the_drift(drifting: LoadedScenario) -> None:
    def lighter(packed: Packed) -> None:
        packed.parameters[0].environment.earth.uniform_mps2 *= 0.8

    found = certify_node(drifting, maxq.nodes(drifting, [55.0])[0], fault=lighter, bands=(), names=())
    assert not found.agrees
    assert "drift" in found.unexplained[0]


def test_held_loop_that_grows_fast_is_not_taken_for_a_drift(certificate) -> None:
    lost = dataclasses.replace(certificate, margins=(), cycle=LimitCycle("lost", 0.0, 5.0, 3.0, 40.0))
    assert lost.stable
    assert lost.unexplained == (
        "the loop of the frozen point, and not that of the flown instant, is unstable; in flight: lost after 40 s",
    )


@pytest.mark.parametrize("sigma", [0.05, 0.2, 0.5])
def test_a_line_that_noise_alone_moves_is_called_noise(sigma: float) -> None:
    """A response whose parts have the standard deviation of their error is reported as noise."""
    rng = np.random.default_rng(1)
    measured = 1.0 + sigma * (rng.normal(size=5000) + 1j * rng.normal(size=5000))
    reasons = [reason_of(complex(m), sigma / abs(m), 0.0, 0.0, False) for m in measured]
    assert reasons.count("unexplained") <= 3  # exp(-4.5^2 / 2): one in 25,000
    assert reason_of(1.0 + 6.0 * sigma, sigma / (1.0 + 6.0 * sigma), 0.0, 0.0, False) == "unexplained"
    assert reason_of(2.0 + 0j, 0.02, 0.0, 0.0, False) == "unexplained"


def test_what_is_left_with_ideal_converters_is_not_theirs() -> None:
    reasons, fine = (
        ("", "unexplained", "unexplained", "time variation"),
        ("unexplained", "", "unexplained", "unexplained"),
    )
    assert converters_share(reasons, fine) == ("", "converter noise", "unexplained", "time variation")


@pytest.mark.parametrize(
    ("measured", "fine", "reason"),
    [
        (16.4, 16.1, "converter noise"),
        (16.4, 15.7, "unexplained"),
        (17.0, 16.1, "unexplained"),
        (15.4, 16.0, "unexplained"),
    ],
)
def test_a_margin_that_rounding_alone_moves_is_called_noise(measured: float, fine: float, reason: str) -> None:
    """Margins of 16 dB are noise only if equal to the linear loop's without rounding and within 0.5 dB with it."""
    rows = [
        MarginRow("gain_up", "dB", 8.1, 16.0, 16.0, 16.0, x, "" if abs(x - 16.0) < 0.2 else "unexplained")
        for x in (measured, fine)
    ]
    assert with_noise(*rows).reason == reason


def test_in_flight_response_agrees_or_says_why(loaded: LoadedScenario) -> None:
    for found in in_flight_response(loaded, (20.0, 40.0), "yaw"):
        assert "unexplained" not in found.reason
        middle = [i for i, hz in enumerate(found.lines_hz) if 2.0 < hz < 5.0]
        assert np.abs(found.difference_db[middle]).max() < 0.3
        assert np.abs(found.difference_deg[middle]).max() < 2.0


@pytest.mark.parametrize(
    ("slosh_hz", "tones_hz"),
    [
        ((), (0.525, 0.825)),
        ((1.19, 1.22), (0.525, 0.825)),
        ((0.862, 0.883), (0.525, 1.275)),
        ((0.442, 0.525), (0.825, 1.275)),
        ((0.509, 0.724), (1.275, 1.925)),
        ((0.5, 0.85, 1.3, 1.9), (0.525, 0.825)),  # relative distances 0.05, 0.03, 0.02 and 0.01
    ],
)
def test_dither_tones_avoid_slosh(slosh_hz: tuple[float, ...], tones_hz: tuple[float, ...]) -> None:
    modes = [SimpleNamespace(kind="slosh", frequency_hz=hz) for hz in slosh_hz]
    path: Any = SimpleNamespace(resonances=lambda: [*modes, SimpleNamespace(kind="bending", frequency_hz=0.525)])
    assert dither_tones_hz(path) == tones_hz
    bands = away_from_slosh(BANDS, path)
    assert [b.dithered for b in bands] == [False, True, True]
    for b in bands[1:]:
        np.testing.assert_allclose(b.dither_hz, tones_hz, atol=1.01 / b.period_s)


def test_the_liquid_swings_less_under_the_chosen_tones() -> None:
    """The pendulums of KSR-III are 2.9 times as long, and swing at 0.831 and 0.838 Hz."""
    longer = load_scenario("nominal", [f"vehicle.stage.0.tank.{n}.length_factor=2.9" for n in (0, 1)])
    assert longer.design is not None
    held = hold(longer, maxq.nodes(longer, [45.0])[0])
    (loop,) = loops([held.node], longer.design)

    def swing_deg(tones_hz: tuple[float, ...]) -> float:
        tones = injections(dither(held, loop, np.array(tones_hz)), held.plane)
        return float(held.fly(60.0, tones)[0].result().metrics["max_slosh_deg"])

    assert swing_deg(DITHER_HZ) > 6.0
    assert swing_deg(dither_tones_hz(fixed_path(held.node, "sampled"))) < 2.5


def test_a_band_must_hold_its_lowest_line() -> None:
    with pytest.raises(ValueError, match=r"allowed is at least 0\.05"):
        band(0.02, 1.0, 5, 40.0, 10.0, 1)


def test_lines_are_even_and_dither_is_odd() -> None:
    for b in BANDS:
        assert np.allclose(np.mod(b.lines_hz * b.period_s, 2.0), 0.0)
        assert np.allclose(np.mod(b.dither_hz * b.period_s, 2.0), 1.0)
        assert math.isclose(b.duration_s, b.settle_s + b.periods * b.period_s + 1.0)
