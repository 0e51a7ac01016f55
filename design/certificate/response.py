"""The open loop three times over: the paper's continuous one, the exact sampled one, and the one that flies."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass

import numpy as np

from maxq.control.kernel.records import Array
from maxq.design.certificate.excitation import Band, band
from maxq.design.certificate.held_flight import HeldFlight
from maxq.design.certificate.loudness import loudness
from maxq.design.certificate.measurement import Measured, measure
from maxq.design.loop.loop import Loop
from maxq.design.model.state_space import ComplexArray
from maxq.sim.packing.flight import Packed

BANDS = (
    band(0.05, 2.5, 26, 40.0, 40.0, 3),
    band(2.75, 12.0, 16, 80.0, 12.0, 1, dithered=True),
    band(12.5, 49.5, 12, 120.0, 12.0, 1, dithered=True),
)
"""Slow enough for the slowest line, loud enough for the highest: each band is limited by something else."""
UNROUNDED_FROM_HZ = 2.7
UNROUNDED_PERIOD_S, UNROUNDED_SETTLE_S = 40.0, 40.0

COHERENT = 0.99
WITHIN_DB, WITHIN_DEG = 0.2, 1.5
NOISE_SIGMAS = 4.5  # told from ten bins of noise: one of 60,000 lines lies beyond, a certificate has 1,000
QUIET = 0.5  # of the amplitude, to see what depends on it
AGREED, NOISE, INCOHERENT = "", "converter noise", "incoherent"
FAULTY = ("unexplained", "saturation", "flight ended")


@dataclass(frozen=True)
class ResponseTable:
    """L at lines, (lines,): continuous, exactly sampled, in flight, and in flight without rounding.

    `unrounded` is measured with the converter and the output made fine, NaN where that was not done: a difference that
    is the converter's noise is gone there. `nonlinear_db` is by how much L moves when the same is played at half the
    amplitude, NaN likewise. `reason` names each difference above the tolerance: "" agreed, "incoherent" not judged,
    "converter noise" within 4.5 standard errors, "saturation", "flight ended", or "unexplained".
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
        return np.asarray(np.degrees(np.angle(self.measured / self.sampled)))

    @property
    def unrounded_db(self) -> Array:
        return decibels(self.unrounded / self.sampled)

    @property
    def unrounded_deg(self) -> Array:
        return np.asarray(np.degrees(np.angle(self.unrounded / self.sampled)))

    @property
    def judged(self) -> int:
        return sum(r != INCOHERENT for r in self.reason)

    @property
    def faulty(self) -> list[int]:
        """Lines that no innocent reason explains."""
        return [i for i, why in enumerate(self.reason) if why in FAULTY]

    @property
    def worst(self) -> int:
        """Line with the largest difference beside what is allowed, of those that are judged."""
        share = np.array([0.0 if r == INCOHERENT else self._share(i) for i, r in enumerate(self.reason)])
        return int(np.argmax(np.nan_to_num(share, nan=np.inf)))

    def _share(self, i: int) -> float:
        if math.isfinite(self.unrounded[i].real):
            return float(max(abs(self.unrounded_db[i]) / WITHIN_DB, abs(self.unrounded_deg[i]) / WITHIN_DEG))
        return float(max(abs(self.difference_db[i]) / WITHIN_DB, abs(self.difference_deg[i]) / WITHIN_DEG))


def decibels(ratio: ComplexArray) -> Array:
    """20 log10 of the size."""
    return np.asarray(20.0 * np.log10(np.maximum(np.abs(ratio), 1e-300)))


def measured_response(
    held: HeldFlight, loop: Loop, pade: Loop, bands: tuple[Band, ...] = BANDS, *, quiet: bool = True
) -> ResponseTable:
    """All bands measured, as they fly and without rounding, and judged. `quiet`: at half the amplitude as well."""
    if not bands:
        empty, none = np.zeros(0), np.zeros(0, np.complex128)
        return ResponseTable(empty, none, none, none, none, empty, empty, empty, ())
    poles = loop.closed_poles()
    seen = [measure(held, b, loudness(held, loop, b), poles) for b in bands]
    lines = np.concatenate([s.lines_hz for s in seen])
    fine = _fine(held)
    clean = _nothing(len(lines))
    change = np.full(len(lines), np.nan)
    high = np.flatnonzero(lines > UNROUNDED_FROM_HZ)
    if len(high):
        one = Band(_even(lines[high]), UNROUNDED_PERIOD_S, UNROUNDED_SETTLE_S, 1)
        found = measure(fine, one, loudness(fine, loop, one), poles)
        clean[high] = found.response * loop.response(lines[high]) / loop.response(one.lines_hz)
        if quiet:
            softer = measure(fine, one, loudness(fine, loop, one, QUIET), poles)
            change[high] = decibels(softer.response / found.response)
    if quiet:
        for b, s in zip(bands, seen, strict=True):
            at = np.flatnonzero(np.isin(lines, b.lines_hz) & (lines <= UNROUNDED_FROM_HZ))
            if len(at):
                softer = measure(held, b, loudness(held, loop, b, QUIET), poles)
                change[at] = decibels(softer.response / s.response)
    response, coherence, error = (
        np.concatenate([getattr(s, name) for s in seen]) for name in ("response", "coherence", "error")
    )
    joined = Measured(lines, response, coherence, error, max(s.saturated_s for s in seen), seen[-1].outcome)
    sampled = loop.response(lines)
    reasons = tuple(
        _reason(joined, i, joined.response[i] / sampled[i], clean[i] / sampled[i]) for i in range(len(lines))
    )
    return ResponseTable(
        lines, pade.response(lines), sampled, joined.response, clean, joined.coherence, joined.error, change, reasons
    )


def _nothing(count: int) -> ComplexArray:
    return np.full(count, complex(np.nan, np.nan))


def _even(lines_hz: Array) -> Array:
    """The nearest lines that fit the period of the measurement without rounding."""
    return np.asarray(2.0 * np.round(0.5 * lines_hz * UNROUNDED_PERIOD_S) / UNROUNDED_PERIOD_S)


def _fine(held: HeldFlight) -> HeldFlight:
    """The same with pulses and output steps of no size."""

    def fault(packed: Packed) -> None:
        held.fault(packed)
        computer = packed.parameters[0].computer
        computer.converter.count_rad = 0.0
        computer.law.dac_step_rad = 0.0

    return dataclasses.replace(held, fault=fault)


def _reason(seen: Measured, line: int, ratio: complex, clean: complex) -> str:
    if not math.isfinite(seen.error[line]):
        return "flight ended"
    if math.isfinite(clean.real) and not _agrees(clean):
        return "unexplained"
    if seen.coherence[line] < COHERENT:
        return INCOHERENT
    if _agrees(ratio):
        return AGREED
    if abs(ratio - 1.0) <= NOISE_SIGMAS * float(seen.error[line]):
        return NOISE
    return "saturation" if seen.saturated_s > 0.0 else "unexplained"


def _agrees(ratio: complex) -> bool:
    size = abs(ratio)
    return bool(
        size > 0.0
        and abs(20.0 * math.log10(size)) <= WITHIN_DB
        and abs(math.degrees(math.atan2(ratio.imag, ratio.real))) <= WITHIN_DEG
    )
