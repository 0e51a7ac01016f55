"""The measured loop of flight code without a linear model, in held flights up to its stability boundary.

A certificate (certificate.py) compares measurements with a linear loop, whereas this module only measures. The open
loop is measured at lines by excitation. The margins are measured by raising the gain, lowering the gain and adding
delay after the flight code until the loop grows. The vehicle's linear model only determines the level of the excitation
and the slosh frequencies.

Limits of validity: motions that the excitation does not reach remain unknown. The response does not show resonances
between the lines. The margins include them, because an unstable loop oscillates at whichever resonance is unstable.
Three kinds of motion count as stable:

- growth slower than e-fold in some 20 s (`GROWS`)
- a growing motion that the initial burst does not excite
- an oscillation within the rounding of the gyro's converter (`FLOOR_COUNTS`)
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np

from maxq.control.kernel.records import Array
from maxq.design.certificate import measured_margins
from maxq.design.certificate.excitation import LineBand, away_from_slosh, burst_rad, excitation_level, gimbal_injection
from maxq.design.certificate.held_flight import (
    CodeDiffers,
    CodeLost,
    HeldFlight,
    PackedChange,
    hold,
    linear_limits,
    unchanged,
)
from maxq.design.certificate.in_flight import LINES_HZ, WINDOW_S
from maxq.design.certificate.measured_margins import MARGIN_NAMES, UNBOUNDED, UNITS, MarginName, MeasuredMargin
from maxq.design.certificate.response import BANDS, measure
from maxq.design.loop.fixed_path import FixedPath, fixed_path
from maxq.design.model.instruments import Plane
from maxq.design.model.node import Node
from maxq.design.model.state_space import ComplexArray
from maxq.sim.run.fly import SOFTWARE_NAME
from maxq.sim.scenario.loader import LoadedScenario

_TRIALS_DB = (1.0, 2.0, 3.0, 4.5, 6.0, 8.0, 10.0, 13.0, 17.0, 22.0, 28.0)
TRIALS: dict[MarginName, tuple[float, ...]] = {
    "gain_up": _TRIALS_DB,
    "gain_down": _TRIALS_DB,
    "delay": (0.003, 0.006, 0.01, 0.015, 0.02, 0.03, 0.04, 0.055, 0.075, 0.1, 0.13, 0.16),
}
"""The alterations in the order of their trials, dB and s."""
WATCHED_S = 48.0  # duration of a trial
GROWS = 1.25  # least ratio of the amplitudes in the last and the second quarter of a growing trial
UNSTABLE = "the loop is unstable as it is"
MOST_FLIGHTS = measured_margins.MOST_FLIGHTS + 4  # most flights between two trials
FLOOR_COUNTS = 2.0  # counts of the gyro's converter; rounding alone can sustain such an oscillation
_PROBE = 0.15  # relative to the level for a loop without feedback
_ACROSS = 0.3  # fraction of a limit above which an oscillation counts as growing
_IN_FLIGHT = LineBand(np.array(LINES_HZ), 10.0 * WINDOW_S, 40.0, 1)
_TOLERANCE = {"dB": 0.02, "s": 1e-4}


@dataclass(frozen=True)
class _Loop:
    """The loop in the form for the excitation: its measured response at `lines_hz`.

    An empty response represents a loop without feedback.
    """

    fixed: FixedPath
    lines_hz: Array
    found: ComplexArray

    def response(self, frequencies_hz: Array) -> ComplexArray:
        if len(self.lines_hz) == 0:
            return np.zeros(np.shape(frequencies_hz), np.complex128)
        x, f = np.log(self.lines_hz), np.log(frequencies_hz)
        size, turn = np.interp(f, x, np.log(np.abs(self.found))), np.interp(f, x, np.unwrap(np.angle(self.found)))
        return np.asarray(np.exp(size + 1j * turn))


@dataclass(frozen=True)
class MeasuredNode:
    """The measurement of flight code at an operating point.

    `error` is the standard error of L at the lines (Hz), relative to L. The margins are measured in flight, and their
    `linear` is NaN. `cycles` are the outcomes of a burst at each slosh frequency. All are empty if the unaltered loop
    is unstable.

    - `clock_s`: range of the code's clock in the held flight (sim/run/held_code.py).
    - `in_flight`: L at `in_flight.LINES_HZ`.
    - `ended`: the reason if the code's own flight ends early or the code ends the held flight, or "".
    - `differs`: the message of a failed replay check, or "".
    """

    time_s: float
    plane: Plane
    stable: bool
    lines_hz: Array
    response: ComplexArray
    error: Array
    margins: tuple[MeasuredMargin, ...]
    cycles: tuple[measured_margins.LimitCycle, ...]
    clock_s: tuple[float, float] = (math.nan, math.nan)
    in_flight: ComplexArray = field(default_factory=lambda: np.zeros(0, np.complex128))
    ended: str = ""
    differs: str = ""

    def margin(self, what: MarginName) -> float:
        """Return a margin in its unit.

        It is infinite if no boundary was found within the trials, and NaN if it was not determined.
        """
        found = next((m for m in self.margins if m.what == what), None)
        if found is None:
            return math.nan
        return math.inf if found.reason == UNBOUNDED else found.measured

    @property
    def phase_deg(self) -> float:
        """Return the least phase margin (deg) at crossings of |L| = 1 between adjacent lines.

        It is infinite without a crossing.
        """
        size = np.log(np.abs(self.response))
        turn = np.unwrap(np.angle(self.response))
        out = math.inf
        for i in np.flatnonzero(np.sign(size[1:]) != np.sign(size[:-1])):
            share = size[i] / (size[i] - size[i + 1])
            at = turn[i] + share * (turn[i + 1] - turn[i]) - math.pi
            out = min(out, abs(math.degrees(math.remainder(at, 2.0 * math.pi))))
        return out


def measure_node(
    loaded: LoadedScenario,
    node: Node,
    *,
    fault: PackedChange | None = None,
    bands: tuple[LineBand, ...] = BANDS,
    names: tuple[MarginName, ...] = MARGIN_NAMES,
) -> MeasuredNode:
    """Measure the loop at an operating point, in its plane.

    Raises ValueError if the point cannot be held (held_flight.py).
    """
    empty = np.zeros(0), np.zeros(0, np.complex128), np.zeros(0)
    nothing = MeasuredNode(node.time_s, node.plane, False, *empty, (), ())
    try:
        held = hold(loaded, node, fault)
        return _measured(held, bands, names)
    except CodeLost as error:
        return replace(nothing, ended=str(error))
    except CodeDiffers as error:
        return replace(nothing, differs=str(error))


def _measured(held: HeldFlight, bands: tuple[LineBand, ...], names: tuple[MarginName, ...]) -> MeasuredNode:
    node, clock_s = held.node, (math.nan, math.nan)
    if held.tape is not None:
        clock_s = held.windows(held.tape, held.packed).span_s
    path = fixed_path(held.node, "sampled")
    floor = _trial(held, path, unchanged)
    if floor.grows:
        empty = measured_loop(held, path, ())
        return MeasuredNode(node.time_s, node.plane, False, *empty, (), (), clock_s, ended=floor.cause)
    lines, response, error = measured_loop(held, path, bands)
    loop = _Loop(path, lines, response)
    margins = tuple(broken(held, loop, name, floor.level_deg) for name in names)
    slosh = [r.frequency_hz for r in path.resonances() if r.kind == "slosh"]
    cycles = tuple(measured_margins.limit_cycle(held, hz) for hz in slosh)
    in_flight = np.zeros(0, np.complex128)
    if bands:
        in_flight = measure(held, _IN_FLIGHT, excitation_level(held, loop, _IN_FLIGHT), in_flight).response
    return MeasuredNode(node.time_s, node.plane, True, lines, response, error, margins, cycles, clock_s, in_flight)


def measured_loop(held: HeldFlight, path: FixedPath, bands: tuple[LineBand, ...]) -> tuple[Array, ComplexArray, Array]:
    """Measure L at the lines of the bands, first at a low level, then at a level adapted to the first result.

    Returns the lines (Hz), L, and its relative standard error.
    """
    if not bands:
        return np.zeros(0), np.zeros(0, np.complex128), np.zeros(0)
    unknown = np.zeros(0, np.complex128)
    loop, bands = _Loop(path, np.zeros(0), unknown), away_from_slosh(bands, path)
    for scale in (_PROBE, 1.0):
        seen = [measure(held, b, excitation_level(held, loop, b, scale), unknown) for b in bands]
        lines, response, error = (
            np.concatenate([getattr(s, name) for s in seen]) for name in ("lines_hz", "response", "error")
        )
        good = np.isfinite(response) & (np.abs(response) > 0.0)
        loop = _Loop(path, lines[good], response[good])
    return lines, response, error


@dataclass(frozen=True)
class _Trial:
    grows: bool
    frequency_hz: float
    level_deg: float  # amplitude at the end of the trial
    cause: str = ""  # reason for which the flight code ended the flight


def _trial(held: HeldFlight, path: FixedPath, change: PackedChange, floor_deg: float = 0.0) -> _Trial:
    """Excite all motions with a doublet, and test whether the command grows beyond the level that rounding sustains.

    `floor_deg` is the amplitude of the unaltered loop. Commands that turn the gyro by less than `FLOOR_COUNTS` do not
    count as growth.
    """
    kick = gimbal_injection(held.plane, "doublet", 0.5 * burst_rad(held, 1.0), stop_s=0.3)
    run, rows = held.fly(WATCHED_S, (kick,), change)
    samples = rows[:, run.table.index(f"filtered_{held.plane}_deg")]
    quarter = round(0.25 * WATCHED_S / held.sample_s)
    if len(samples) < 4 * quarter:
        cause = next((event.detail for event in run.events if event.name == SOFTWARE_NAME), "")
        return _Trial(True, _strongest(samples[-quarter:], held.sample_s), math.inf, cause)
    parts = (_without_trend(samples[k * quarter : (k + 1) * quarter]) for k in (1, 3))
    second, last = (math.sqrt(2.0 * float(np.mean(part**2))) for part in parts)  # amplitudes of sines with equal power
    frequency_hz = _strongest(samples[3 * quarter :], held.sample_s)
    limit, least = math.degrees(linear_limits(held)[0]), max(2.0 * floor_deg, _rounding_deg(held, path, frequency_hz))
    grows = last > _ACROSS * limit or (last > GROWS * second and last > least)
    return _Trial(grows, frequency_hz, last)


def _rounding_deg(held: HeldFlight, path: FixedPath, frequency_hz: float) -> float:
    """Return the amplitude of the gimbal command that turns the gyro by `FLOOR_COUNTS` at a frequency."""
    count = float(held.packed.parameters[0].computer.converter.count_rad)
    turn = abs(complex(path.response(np.array([frequency_hz]))[0])) / (2.0 * math.pi * frequency_hz)
    return math.degrees(FLOOR_COUNTS * count / turn) if turn > 0.0 else 0.0


def _without_trend(samples: Array) -> Array:
    x = np.linspace(-1.0, 1.0, len(samples))
    return np.asarray(samples - np.polyval(np.polyfit(x, samples, 1), x))


def _strongest(samples: Array, sample_s: float) -> float:
    """Return the frequency (Hz) of the strongest line, with a resolution finer than a bin."""
    if len(samples) < 16:
        return 1.0
    spectrum = np.abs(np.fft.rfft(_without_trend(samples) * np.hanning(len(samples)), 8 * len(samples)))
    return max(int(np.argmax(spectrum)), 1) / (8.0 * len(samples) * sample_s)


def broken(held: HeldFlight, loop: _Loop, what: MarginName, floor_deg: float) -> MeasuredMargin:
    """Return the alteration at which the loop neither grows nor decays.

    A series of trials brackets it, and the growth rate then refines it.
    """
    tried: list[tuple[float, float]] = []

    def found(measured: float, frequency_hz: float, reason: str = "") -> MeasuredMargin:
        return MeasuredMargin(what, UNITS[what], math.nan, measured, frequency_hz, tuple(tried), reason)

    def change(amount: float) -> PackedChange:
        return lambda packed: measured_margins.alter(packed, held, what, amount)

    most = measured_margins.longest_delay_s(held) if what == "delay" else math.inf
    low, trial = 0.0, None
    for amount in (a for a in TRIALS[what] if a <= most):
        trial = _trial(held, loop.fixed, change(amount), floor_deg)
        if trial.grows:
            break
        low = amount
    if trial is None or not trial.grows:
        return found(math.nan, math.nan, UNBOUNDED)
    tolerance, high = _TOLERANCE[UNITS[what]], amount
    while True:
        test, own = measured_margins.burst_test(trial.frequency_hz), list[tuple[float, float]]()

        def grow(at: float, test: measured_margins.BurstTest = test) -> float:
            growth = measured_margins.measured_growth(held, loop, test, change(at))
            return math.inf if math.isnan(growth) else growth  # the flight was lost

        slope, bounds = trial.frequency_hz * (20.0 if what == "delay" else 0.05), (0.5 * low, min(1.5 * high, most))
        at, settled = measured_margins.settle(
            grow, own, 0.5 * (low + high), slope, 0.5 * (high - low), tolerance, bounds, MOST_FLIGHTS
        )
        tried += own
        within = at - 5.0 * tolerance
        if within <= low:
            break
        inside = _trial(held, loop.fixed, change(within), floor_deg)  # another motion may have become unstable earlier
        if not inside.grows:
            break
        high, trial = within, inside
    return found(at, trial.frequency_hz, "" if settled else measured_margins.NOT_SETTLED)
