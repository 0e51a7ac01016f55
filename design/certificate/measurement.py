"""The loop measured in flight: what comes back for what was sent, line by line."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from maxq.control.kernel.records import Array
from maxq.design.certificate.excitation import Band, injections
from maxq.design.certificate.held_flight import HeldFlight
from maxq.design.certificate.loudness import Loudness
from maxq.design.model.state_space import ComplexArray
from maxq.sim.flight.telemetry import FAST
from maxq.sim.run.fly import KeptRows

_NEAR_HZ, _NEAR = 0.125, 5  # on either side in which noise is looked for, and at least so many bins
_DEAD = 9.0  # exp(-9) = 1e-4 of what there was at the start
_TOLD = 0.01  # a root that changes less than this over the record cannot be told from the mean


@dataclass(frozen=True)
class Measured:
    """L at lines, (lines,), with what it is worth.

    `error` is the standard error of L relative to L, `coherence` the share of what came back that L explains: both
    from what came back between the lines, where nothing was sent. `saturated_s` is how long a command lay at its
    limit, `outcome` that of the flight.
    """

    lines_hz: Array
    response: ComplexArray
    coherence: Array
    error: Array
    saturated_s: float
    outcome: str


def measure(held: HeldFlight, band: Band, loud: Loudness, closed_poles: ComplexArray) -> Measured:
    """Fly with the signal injected at the gimbal command and compare filter output with what is handed on.

    L = -U / E with U the output of the bending filter and E = U + injected, limited and quantised: the command that
    the actuator gets. E is what truly enters, so that limits and the converter behind it do not bias L.

    `closed_poles` (rad/s) of the linear loop say what is still dying away, or drifting off, when the record begins: a
    root of 0.02 rad/s would take minutes. It is taken out of the spectra, not waited for.
    """
    run = held.run(band.duration_s, injections([*loud.groups, *loud.dither], held.plane))
    kept = KeptRows()
    while not run.finished:
        kept.add(run.fly_segment())
    _, values = kept.rows()[FAST]
    back = values[:, run.table.index(f"filtered_{held.plane}_deg")]
    sent = values[:, run.table.index(f"gimbal_{held.plane}_command_deg")]
    flight = run.result()
    saturated_s = flight.metrics["saturation_time_s"]
    spectra = _spectra(band, held.sample_s, back, sent)
    if spectra is None:
        nothing = np.full(len(band.lines_hz), np.nan)
        return Measured(band.lines_hz, nothing.astype(complex), 0.0 * nothing, nothing, saturated_s, flight.outcome)
    out, into = (_settled(x, band, closed_poles) for x in spectra)
    return _estimated(band, out, into, saturated_s, flight.outcome)


def _spectra(band: Band, sample_s: float, back: Array, sent: Array) -> tuple[ComplexArray, ComplexArray] | None:
    """(periods, bins) of what came back and what was sent; None if the flight ended before.

    A command shows in the log after its tick: it is read one row later.
    """
    n, first = round(band.period_s / sample_s), round(band.settle_s / sample_s)
    if first + band.periods * n + 1 > len(sent):
        return None
    starts = first + n * np.arange(band.periods)
    out, into = (
        np.stack([np.fft.rfft(x[s + shift : s + shift + n]) for s in starts]) for x, shift in ((back, 0), (sent, 1))
    )
    return out, into


def _settled(spectra: ComplexArray, band: Band, closed_poles: ComplexArray) -> ComplexArray:
    """Mean over the periods, (bins,), without what dies away or drifts off: each root's part changes by exp(p times the
    period). The slowest roots first: there are not periods enough for all."""
    told = np.abs(closed_poles.real) * band.duration_s > _TOLD
    slow = closed_poles[told & (-closed_poles.real * band.settle_s < _DEAD)]
    slow = slow[np.argsort(-slow.real, kind="stable")]
    began = np.arange(band.periods) * band.period_s
    shapes = np.column_stack([np.ones(band.periods), np.exp(np.outer(began, slow[: max(band.periods - 2, 0)]))])
    return np.asarray(np.linalg.lstsq(shapes, spectra, rcond=None)[0][0])


def _estimated(
    band: Band, out: ComplexArray, into: ComplexArray, saturated_s: float, outcome: str
) -> Measured:  # fmt: skip
    """At the lines; between them nothing is sent, and U = E is noise that has gone round the loop: N / (1 + L)."""
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
    return Measured(band.lines_hz, response, 1.0 / (1.0 + error**2), error, saturated_s, outcome)
