"""The open loop measured in a held flight, compared with the paper's continuous loop and with the exact sampled loop.

The signal is injected at the gimbal command, and the returned signal is compared with it at each line. Each difference
from the sampled loop has a stated reason or is unexplained.
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from maxq.control.kernel.records import Array
from maxq.design.certificate.excitation import (
    ExcitationLevel,
    LineBand,
    away_from_slosh,
    band,
    excitation_level,
    injections,
)
from maxq.design.certificate.held_flight import HeldFlight
from maxq.design.loop.fixed_path import fixed_path
from maxq.design.loop.loop import Loop
from maxq.design.model.node import SWING_PERIODS, at_swing, equivalent_swing, swing_rates_radps, swing_window_s
from maxq.design.model.state_space import ComplexArray
from maxq.sim.packing.flight import Packed
from maxq.sim.run.fly import FlightRun

BANDS = (
    band(0.05, 2.5, 26, 40.0, 40.0, 3),
    band(2.75, 12.0, 16, 80.0, 12.0, 1, dithered=True),
    band(12.5, 49.5, 12, 120.0, 12.0, 1, dithered=True),
)
"""The bands of lines, with periods for the lowest line and levels for the highest.

The quantity that limits the level differs between the bands.
"""
UNROUNDED_FROM_HZ = 2.7
UNROUNDED_PERIOD_S, UNROUNDED_SETTLE_S = 40.0, 40.0

COHERENT = 0.99
WITHIN_DB, WITHIN_DEG = 0.2, 1.5
NOISE_SIGMAS = 4.5  # with noise from ten bins, one line in 60,000 exceeds this; a certificate has 1,000 lines
HALF = 0.5  # fraction of the excitation level, to show nonlinearity
RING_SHARE = 0.1  # fraction of the level, for waves lower than the depth of the rings
AGREED, NOISE, INCOHERENT, UNEXPLAINED = "", "converter noise", "incoherent", "unexplained"
SATURATION, ENDED = "saturation", "flight ended"
FAULTY = UNEXPLAINED, SATURATION, ENDED

_NEAR_HZ, _NEAR = 0.125, 5  # range of the noise estimate on each side of a line, and its least number of bins
_DECAYED = 9.0  # a transient has decayed at exp(-9) = 1e-4 of its initial amplitude
_DISTINCT = 0.01  # a root with a smaller change over the record cannot be separated from the mean


@dataclass(frozen=True)
class MeasuredResponse:
    """The response L at lines, (lines,), and its quality.

    `error` is the standard error of L relative to L, and `coherence` is the fraction of the return that L explains.
    Both are estimated from the spectrum between the lines, where no signal was sent. `saturated_s` is the time during
    which a command was at its limit. `outcome` is the outcome of the flight.
    """

    lines_hz: Array
    response: ComplexArray
    coherence: Array
    error: Array
    saturated_s: float
    outcome: str


def measure(held: HeldFlight, band: LineBand, level: ExcitationLevel, closed_poles: ComplexArray) -> MeasuredResponse:
    """Fly with the signal injected at the gimbal command, and return the measured response.

    L = -U / E, where U is the output of the bending filter, and E = U + injected, after limits and quantisation. E is
    the command that the actuator receives, so that limits and the output converter do not bias L. `closed_poles`
    (rad/s) of the linear loop determine the transients that remain when the record begins. The decay of a root of 0.02
    rad/s would take minutes, so that such transients are removed from the spectra.
    """
    run, values = held.fly(band.duration_s, injections([*level.groups, *level.dither], held.plane))
    return _measured(held, band, closed_poles, run, values)


def _measured(
    held: HeldFlight, band: LineBand, closed_poles: ComplexArray, run: FlightRun, values: Array
) -> MeasuredResponse:
    back = values[:, run.table.index(f"filtered_{held.plane}_deg")]
    sent = values[:, run.table.index(f"gimbal_{held.plane}_command_deg")]
    flight = run.result()
    saturated_s = flight.metrics["saturation_time_s"]
    spectra = _spectra(band, held.sample_s, back, sent, held.node.instruments.rows_late)
    if spectra is None:
        nothing = np.full(len(band.lines_hz), np.nan)
        return MeasuredResponse(
            band.lines_hz, nothing.astype(complex), 0.0 * nothing, nothing, saturated_s, flight.outcome
        )
    out, into = (_settled(x, band, closed_poles) for x in spectra)
    return _estimated(band, out, into, saturated_s, flight.outcome)


def _spectra(
    band: LineBand, sample_s: float, back: Array, sent: Array, late: int = 1
) -> tuple[ComplexArray, ComplexArray] | None:
    """Return the spectra (periods, bins) of the return and of the command, or None if the flight ended early.

    A command is logged `late` rows after its tick (`Instruments.rows_late`).
    """
    n, first = round(band.period_s / sample_s), round(band.settle_s / sample_s)
    if first + band.periods * n + late > len(sent):
        return None
    starts = first + n * np.arange(band.periods)
    out, into = (
        np.stack([np.fft.rfft(x[s + shift : s + shift + n]) for s in starts]) for x, shift in ((back, 0), (sent, late))
    )
    return out, into


def _settled(spectra: ComplexArray, band: LineBand, closed_poles: ComplexArray) -> ComplexArray:
    """Return the mean spectrum over the periods, (bins,), without transients.

    The contribution of each root changes by exp(p times the period). The slowest roots are removed first, since there
    are too few periods for all roots.
    """
    distinct = np.abs(closed_poles.real) * band.duration_s > _DISTINCT
    slow = closed_poles[distinct & (-closed_poles.real * band.settle_s < _DECAYED)]
    slow = slow[np.argsort(-slow.real, kind="stable")]
    began = np.arange(band.periods) * band.period_s
    shapes = np.column_stack([np.ones(band.periods), np.exp(np.outer(began, slow[: max(band.periods - 2, 0)]))])
    return np.asarray(np.linalg.lstsq(shapes, spectra, rcond=None)[0][0])


def _estimated(
    band: LineBand, out: ComplexArray, into: ComplexArray, saturated_s: float, outcome: str
) -> MeasuredResponse:
    """Return the estimates at the lines.

    No signal is sent between the lines, and U = E is noise that has passed around the loop: N / (1 + L).
    """
    lines = np.round(band.lines_hz * band.period_s).astype(int)
    response = -out[lines] / into[lines]
    silent = np.ones(len(out), bool)
    silent[lines] = False
    silent[np.round(band.dither_hz * band.period_s).astype(int)] = False
    silent[[0, -1]] = False
    reach = max(_NEAR, round(_NEAR_HZ * band.period_s))
    noise = np.empty(len(lines))
    for i, line in enumerate(lines):
        low = max(line - reach, 1)
        near = np.flatnonzero(silent[low : line + reach + 1]) + low
        noise[i] = np.sqrt(np.mean(np.abs(out[near] * (1.0 + response[i])) ** 2))
    error = noise / np.abs(out[lines])
    return MeasuredResponse(band.lines_hz, response, 1.0 / (1.0 + error**2), error, saturated_s, outcome)


@dataclass(frozen=True)
class ResponseTable:
    """The response L at lines, (lines,): continuous, exactly sampled, in flight, and in flight without rounding.

    `unrounded` is measured with infinitely fine converters, and is NaN if not measured or if flight code rounds there.
    A difference due to converter noise vanishes in it. `nonlinear_db` is the change of L at half the excitation level,
    and is NaN if not measured. `reason` explains each difference above the tolerance: "" (agrees), "incoherent" (not
    assessed), "converter noise" (within 4.5 standard errors), "saturation", "flight ended", or "unexplained".
    """

    lines_hz: Array
    pade: ComplexArray
    sampled: ComplexArray
    measured: ComplexArray
    unrounded: ComplexArray
    coherence: Array
    error: Array
    nonlinear_db: Array
    reason: tuple[str, ...]

    @property
    def difference_db(self) -> Array:
        return decibels(self.measured / self.sampled)

    @property
    def difference_deg(self) -> Array:
        return degrees(self.measured / self.sampled)

    @property
    def unrounded_db(self) -> Array:
        return decibels(self.unrounded / self.sampled)

    @property
    def unrounded_deg(self) -> Array:
        return degrees(self.unrounded / self.sampled)

    @property
    def faulty(self) -> list[int]:
        """Return the indices of lines with a difference that neither noise nor tolerance explains."""
        return [i for i, why in enumerate(self.reason) if why in FAULTY]


def decibels(ratio: ComplexArray) -> Array:
    """Return the magnitude of a ratio in dB."""
    return np.asarray(20.0 * np.log10(np.maximum(np.abs(ratio), 1e-300)))


def degrees(ratio: ComplexArray) -> Array:
    """Return the phase of a ratio in degrees."""
    return np.asarray(np.degrees(np.angle(ratio)))


def no_response() -> ResponseTable:
    """Return a table without lines."""
    empty, none = np.zeros(0), np.zeros(0, np.complex128)
    return ResponseTable(empty, none, none, none, none, empty, empty, empty, ())


def measured_response(
    held: HeldFlight, loop: Loop, pade: Loop, bands: tuple[LineBand, ...] = BANDS, *, at_half: bool = True
) -> ResponseTable:
    """Measure and assess all bands, with and without rounding. `at_half` also measures them at half the level."""
    if not bands:
        return no_response()
    bands, poles = away_from_slosh(bands, loop.fixed), loop.closed_poles()
    seen = [measure(held, b, excitation_level(held, loop, b), poles) for b in bands]
    lines = np.concatenate([s.lines_hz for s in seen])
    clean = np.full(len(lines), complex(np.nan, np.nan))
    change = np.full(len(lines), np.nan)
    high = np.flatnonzero(lines > UNROUNDED_FROM_HZ)
    if len(high):
        fine = _without_rounding(held)
        one = LineBand(_even(lines[high]), UNROUNDED_PERIOD_S, UNROUNDED_SETTLE_S, 1, held.tape is not None)
        (one,) = away_from_slosh((one,), loop.fixed)
        found = measure(fine, one, excitation_level(fine, loop, one), poles)
        clean[high] = found.response * loop.response(lines[high]) / loop.response(one.lines_hz)
        if held.tape is not None:
            clean[high[_rounded_by_code(found, clean[high] / loop.response(lines[high]))]] = np.nan
        if at_half:
            weaker = measure(fine, one, excitation_level(fine, loop, one, HALF), poles)
            change[high] = decibels(weaker.response / found.response)
    for b, s in zip(bands, seen, strict=True) if at_half else ():
        at = np.flatnonzero(np.isin(lines, b.lines_hz) & (lines <= UNROUNDED_FROM_HZ))
        if len(at):
            weaker = measure(held, b, excitation_level(held, loop, b, HALF), poles)
            change[at] = decibels(weaker.response / s.response)
    response, coherence, error = (
        np.concatenate([getattr(s, name) for s in seen]) for name in ("response", "coherence", "error")
    )
    sampled = loop.response(lines)
    saturated = max(s.saturated_s for s in seen) > 0.0
    reasons = tuple(
        _reason(*line, saturated) for line in zip(error, coherence, response / sampled, clean / sampled, strict=True)
    )
    return ResponseTable(lines, pade.response(lines), sampled, response, clean, coherence, error, change, reasons)


@dataclass(frozen=True)
class RingLine:
    """The response L at the frequency of a pendulum with ring baffles, measured and linear.

    In the measurement, the rings follow their law. The excitation is a sine. `linear` has the damping of the rings at
    the flown swing (rad, of each pendulum). `difference_db` and `difference_deg` are the measured minus the linear
    response. `rings_db` is the effect of the rings at this frequency: `linear` minus the same loop without rings.
    """

    line_hz: float
    swing_rad: tuple[float, ...]
    linear: complex
    without: complex
    measured: complex
    reason: str

    @property
    def difference_db(self) -> float:
        return float(decibels(np.array(self.measured / self.linear)))

    @property
    def difference_deg(self) -> float:
        return float(degrees(np.array(self.measured / self.linear)))

    @property
    def rings_db(self) -> float:
        return float(decibels(np.array(self.linear / self.without)))


def ring_lines(by_law: HeldFlight, loop: Loop) -> tuple[RingLine, ...]:
    """Return a line at each frequency of pendulums with rings, in a held flight in which the rings follow their law."""
    node, found = by_law.node, []
    omega = 2.0 * np.pi * SWING_PERIODS / swing_window_s(node)
    ringed = node.vehicle.pendulums.ring * node.vehicle.pendulums.mass_kg > 0.0
    for hz in sorted(set(_even(omega[ringed] / (2.0 * np.pi)).tolist())):
        one = LineBand(np.array([hz]), UNROUNDED_PERIOD_S, UNROUNDED_SETTLE_S, 3)
        level = excitation_level(by_law, loop, one, RING_SHARE)
        run, rows = by_law.fly(one.duration_s, injections([*level.groups, *level.dither], by_law.plane))
        seen = _measured(by_law, one, loop.closed_poles(), run, rows)
        rates = swing_rates_radps(run, rows[round(one.settle_s / by_law.sample_s) :])
        swing = [equivalent_swing(rates[:, n], w) for n, w in enumerate(omega)]
        linear, without = (
            dataclasses.replace(loop, fixed=fixed_path(at_swing(node, at), loop.fixed.kind, loop.fixed.cut))
            for at in (np.array(swing), np.zeros(len(swing)))
        )
        expected, bare = (complex(each.response(one.lines_hz)[0]) for each in (linear, without))
        measured = complex(seen.response[0])
        reason = _reason(
            float(seen.error[0]), float(seen.coherence[0]), measured / expected, complex(np.nan), seen.saturated_s > 0.0
        )
        found.append(RingLine(hz, tuple(swing), expected, bare, measured, reason))
    return tuple(found)


def _even(lines_hz: Array) -> Array:
    """Return the nearest lines (Hz) that fit the period of the measurement without rounding."""
    return np.asarray(2.0 * np.round(0.5 * lines_hz * UNROUNDED_PERIOD_S) / UNROUNDED_PERIOD_S)


def _without_rounding(held: HeldFlight) -> HeldFlight:
    """Return the held flight with infinitely fine counts and output steps."""

    def fault(packed: Packed) -> None:
        held.fault(packed)
        computer = packed.parameters[0].computer
        computer.converter.count_rad = 0.0
        computer.dac_step_rad = 0.0
        computer.sensors.converter["count_rad"] = 0.0

    return dataclasses.replace(held, fault=fault)


def _rounded_by_code(found: MeasuredResponse, ratio: ComplexArray) -> NDArray[np.bool_]:
    """Return the lines at which flight code has rounded in a flight without rounding, so that it shows nothing.

    Code that works with pulses receives them in every flight. `ratio` is the ratio of measured to sampled L. At these
    lines, noise between the lines hides L, or explains a difference that exceeds the tolerance.
    """
    noisy = np.abs(ratio - 1.0) <= NOISE_SIGMAS * found.error
    differs = np.array([not _agrees(complex(each)) for each in ratio])
    return np.asarray(np.isfinite(found.error) & differs & (noisy | (found.coherence < COHERENT)), np.bool_)


def _reason(error: float, coherence: float, ratio: complex, clean: complex, saturated: bool) -> str:
    """Return the reason for the difference of a line.

    `ratio` is the ratio of measured to sampled L, and `clean` is the same ratio without rounding.
    """
    if not math.isfinite(error):
        return ENDED
    if math.isfinite(clean.real) and not _agrees(clean):
        return UNEXPLAINED
    if coherence < COHERENT:
        return INCOHERENT
    if _agrees(ratio):
        return AGREED
    if abs(ratio - 1.0) <= NOISE_SIGMAS * error:
        return NOISE
    return SATURATION if saturated else UNEXPLAINED


def _agrees(ratio: complex) -> bool:
    size = abs(ratio)
    return bool(
        size > 0.0
        and abs(20.0 * math.log10(size)) <= WITHIN_DB
        and abs(math.degrees(math.atan2(ratio.imag, ratio.real))) <= WITHIN_DEG
    )
