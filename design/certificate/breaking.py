"""Margins measured by breaking the loop: more gain, less gain, more delay, until the flight grows instead of decaying.

The nonlinear simulator is flown held (held_flight.py) with the loop altered inside its flight computer. A burst at the
critical frequency sets it ringing; then it is left alone, and the rate at which the ringing grows or dies away is
read off. The margin is where that rate is zero, found by the secant rule from the linear loop's own margin: near the
edge the rate is nearly linear in the alteration, so that three or four flights tell it to a few hundredths of a dB.
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from typing import Literal

import numpy as np

from maxq.control.kernel.records import Array
from maxq.control.laws.structures import MAX_SECTIONS
from maxq.design.certificate.excitation import DITHER_HZ, injections
from maxq.design.certificate.held_flight import Change, HeldFlight
from maxq.design.certificate.loudness import burst_rad, dither, linear_command_rad
from maxq.design.loop.fixed_path import fixed_path
from maxq.design.loop.loop import Loop
from maxq.design.margins.measure import Margins
from maxq.design.model.dispersion import Dispersion, disperse
from maxq.sim.flight.telemetry import FAST
from maxq.sim.packing.flight import Packed
from maxq.sim.run.fly import KeptRows
from maxq.sim.scenario.schema_injection import Injection

What = Literal["gain_up", "gain_down", "delay"]
WHATS: tuple[What, ...] = ("gain_up", "gain_down", "delay")
UNITS: dict[What, str] = {"gain_up": "dB", "gain_down": "dB", "delay": "s"}

MOST_FLIGHTS = 10
DRIFT_HZ = 0.02  # slower than this the edge is that of a root without oscillation
DITHER_ABOVE_HZ = 2.0  # without it the converter keeps a ringing of some pulses alive, up to half a dB inside the edge
RINGS_UP = 4.0  # a burst goes on until the loop at its edge has made this much of it, if that is not too long
LONGEST_BURST_S = 6.0
TOO_LONG = "longer than can be inserted"  # reason for a delay margin that is not looked for in flight
UNBOUNDED = "nothing bounds it"
LOST = math.inf  # growth of what meets the limits before it can be told
DEAD = -math.inf  # of what has died away before
_LEAST_WINDOWS = 6


@dataclass(frozen=True)
class Watch:
    """How a loop is set ringing and watched: all times in s."""

    frequency_hz: float  # 0: a push, and a drift
    burst_s: float
    wait_s: float
    watch_s: float
    window_s: float
    growth: float = 1.0  # how many times the burst the ringing is when it ends

    @property
    def duration_s(self) -> float:
        return math.ceil(self.burst_s + self.wait_s + self.watch_s)


def watch_at(frequency_hz: float, ringing_1ps: float = 0.0) -> Watch:
    """At least three turns of burst, six to wait, 25 s and 24 turns to watch; more of both where the edge is a drift's.

    `ringing_1ps` is how fast a burst builds up at the edge, in burst's amplitudes a second.
    """
    if frequency_hz < DRIFT_HZ:
        return Watch(0.0, 8.0, 40.0, 120.0, 10.0)
    turn = 1.0 / frequency_hz
    burst_s = max(3.0 * turn, min(RINGS_UP / ringing_1ps if ringing_1ps > 0.0 else 0.0, LONGEST_BURST_S))
    window_s = max(5.0 * turn, min(1.0, 25.0 * turn))
    return Watch(
        frequency_hz, burst_s, 6.0 * turn, max(25.0, 24.0 * turn), window_s, 1.0 + ringing_1ps * burst_s
    )  # fmt: skip


@dataclass(frozen=True)
class Broken:
    """A margin by the linear loop and by flight, in `unit`, and the flights that tell it.

    `tried` holds alteration and measured growth (1/s); NaN in `measured` means that no edge was found, and `reason`
    says why.
    """

    what: What
    unit: str
    linear: float
    measured: float
    frequency_hz: float
    tried: tuple[tuple[float, float], ...]
    reason: str = ""

    @property
    def difference(self) -> float:
        return self.measured - self.linear


def break_loop(held: HeldFlight, loop: Loop, margins: Margins, what: What) -> Broken:
    """Find the margin in flight. One that is infinite by the linear loop, or met at no frequency, is not looked for."""
    bound = {"gain_up": margins.gain_up_db, "gain_down": margins.gain_down_db, "delay": margins.delay_s}[what]
    linear, frequency = float(bound.value), float(bound.frequency_hz)
    if not margins.stable:
        return Broken(what, UNITS[what], math.nan, math.nan, frequency, (), "the linear loop is unstable")
    if not math.isfinite(linear):
        return Broken(what, UNITS[what], linear, math.nan, frequency, (), UNBOUNDED)
    most = _longest_s(held) if what == "delay" else math.inf
    if 1.02 * linear > most:
        return Broken(what, UNITS[what], linear, math.nan, frequency, (), TOO_LONG)
    watch = watch_at(frequency, build_up(altered(loop, what, linear), frequency))
    slope = abs(_slope(loop, what, linear))
    tolerance = 0.02 if what != "delay" else 0.003 * linear
    tried: list[tuple[float, float]] = []
    at = linear
    for _ in range(MOST_FLIGHTS):
        growth = kicked_growth(held, loop, watch, lambda packed, at=at: _alter(packed, held, what, at))  # type: ignore[misc]  # a default binds the loop's value
        tried.append((at, growth))
        if math.isnan(growth):
            return Broken(what, UNITS[what], linear, math.nan, frequency, tuple(tried), "the flight was lost")
        following = min(_next(tried, slope, 0.25 * linear, 5.0 * tolerance), most)
        step, at = following - at, following
        if abs(step) < tolerance:
            return Broken(what, UNITS[what], linear, at, frequency, tuple(tried))
    return Broken(what, UNITS[what], linear, at, frequency, tuple(tried), "not settled")


def _next(tried: list[tuple[float, float]], slope: float, most: float, apart: float) -> float:
    """Where to try next: by the secant rule, between what has decayed and what has grown, else in their middle.

    `slope` (1/s per unit) serves until two tries that are at least `apart` tell a better one; no step is larger than
    `most`.
    """
    at, growth = tried[-1]
    known = [t for t in tried if math.isfinite(t[1])]
    if len(known) > 1 and abs(known[-1][0] - known[-2][0]) > apart:
        measured = (known[-1][1] - known[-2][1]) / (known[-1][0] - known[-2][0])
        slope = measured if measured > 0.0 else slope
    low = max((x for x, g in tried if g <= 0.0), default=-math.inf)
    high = min((x for x, g in tried if g > 0.0), default=math.inf)
    following = at + float(np.clip(-growth / slope, -most, most))
    if low < high and not low < following < high and math.isfinite(high - low):
        return 0.5 * (low + high)
    return following


def build_up(edge: Loop, frequency_hz: float) -> float:
    """How fast a sine at the frequency of a pole on the axis builds up, 1/s: the size of the residue of 1 / (1 + L)."""
    if frequency_hz < DRIFT_HZ:
        return 0.0
    apart = 1e-4 * frequency_hz
    low, high = edge.response(np.array([frequency_hz - apart, frequency_hz + apart]))
    return float(4.0 * np.pi * apart / abs(high - low))


def altered(loop: Loop, what: What, amount: float) -> Loop:
    """The linear loop with gain (dB) added or taken away, or a delay (s) added to the computer's."""
    if what == "delay":
        path = fixed_path(disperse(loop.fixed.node, Dispersion(delay_s=amount)), loop.fixed.kind, loop.fixed.cut)
        return dataclasses.replace(loop, fixed=path)
    gain = 10.0 ** ((amount if what == "gain_up" else -amount) / 20.0)
    return dataclasses.replace(loop, law=loop.law.scaled(gain))


def _slope(loop: Loop, what: What, at: float) -> float:
    """How fast the linear loop's fastest growing pole moves with the alteration, 1/s per unit."""
    step = 1e-3 * at
    low, high = (altered(loop, what, x).closed_poles().real.max() for x in (at - step, at + step))
    return float((high - low) / (2.0 * step))


def kicked_growth(held: HeldFlight, loop: Loop, watch: Watch, change: Change) -> float:
    """Growth (1/s) of a ringing in flight; NaN where the flight ended early. `loop` is the linear one, for loudness."""
    amplitude = math.degrees(burst_rad(held, watch.frequency_hz, watch.growth))
    kind = {"kind": "sine", "frequency_hz": watch.frequency_hz} if watch.frequency_hz > 0.0 else {"kind": "step"}
    burst = {"amplitude_deg": amplitude, "stop_s": round(watch.burst_s, 6)}
    signals = [Injection.model_validate({"at": "gimbal_command", "axis": held.plane, **kind, **burst})]
    if watch.frequency_hz > DITHER_ABOVE_HZ:
        signals += injections(dither(held, loop, np.array(DITHER_HZ)), held.plane)
    run = held.run(watch.duration_s, tuple(signals), change)
    kept = KeptRows()
    while not run.finished:
        kept.add(run.fly_segment())
    _, values = kept.rows()[FAST]
    ringing = values[:, run.table.index(f"filtered_{held.plane}_deg")]
    first = round((watch.burst_s + watch.wait_s) / held.sample_s)
    loud = math.degrees(linear_command_rad(held, watch.frequency_hz))
    if len(ringing) - first < 0.9 * watch.watch_s / held.sample_s:
        return LOST if np.abs(ringing[: len(ringing)]).max(initial=0.0) > loud else math.nan
    rung = 0.15 * amplitude * watch.growth if watch.frequency_hz > 0.0 else 0.0
    return ringing_growth(ringing[first:], held.sample_s, watch.frequency_hz, watch.window_s, loud, rung)


def ringing_growth(
    samples: Array, sample_s: float, frequency_hz: float, window_s: float, loud: float = math.inf, quiet: float = 0.0
) -> float:
    """Rate (1/s) at which an oscillation near a frequency grows, or at 0 Hz a drift: slope of its envelope's logarithm.

    The envelope is that of windows with a raised-cosine weight, which shuts out drifts and what is more than a turn a
    window away. It is followed while it is above a tenth of its beginning, where noise would hide the decay, and
    below `loud` (in the unit of the samples), where limits would hide the growth: a limit cycle does not grow. What
    is as loud as that from the beginning, or becomes so at once, is `LOST`; what is below `quiet` then is `DEAD`.
    """
    window = max(round(window_s / sample_s), 8)
    weight = np.hanning(window)
    turn = weight * np.exp(-2j * np.pi * frequency_hz * sample_s * np.arange(window))
    starts = np.arange(0, len(samples) - window, max(window // 4, 1))
    double = 2.0 if frequency_hz > 0.0 else 1.0
    if frequency_hz > 0.0:  # what drifts below is no ringing
        turn = turn - weight * (turn.sum() / weight.sum())
    envelope = double * np.abs(np.array([samples[s : s + window] @ turn for s in starts])) / weight.sum()
    times = (starts + 0.5 * window) * sample_s
    over = np.flatnonzero(envelope > loud)
    count = int(over[0]) if len(over) else len(envelope)
    if count < _LEAST_WINDOWS:
        return LOST
    if envelope[0] < quiet:
        return DEAD
    under = np.flatnonzero(envelope[:count] < 0.1 * envelope[0])
    count = max(int(under[0]), _LEAST_WINDOWS) if len(under) else count
    return float(np.polyfit(times[:count], np.log(np.maximum(envelope[:count], 1e-300)), 1)[0])


def _longest_s(held: HeldFlight) -> float:
    """Delay for which the filter has sections left, two samples each."""
    free = MAX_SECTIONS - int(held.packed.parameters[0].computer.filters.n_sections[held.axis])
    return 2.0 * free * held.sample_s


def _alter(packed: Packed, held: HeldFlight, what: What, amount: float) -> None:
    """The packed flight's computer altered in place, on the held axis: sections of its own behind the filter's."""
    row, axis = packed.parameters[0].computer, held.axis
    sections, used = row.filters.sections[axis], int(row.filters.n_sections[axis])
    if what != "delay":
        gain = 10.0 ** ((amount if what == "gain_up" else -amount) / 20.0)
        extra = [[gain, 0.0, 0.0, 0.0, 0.0]]
    else:
        whole, rest_ns = divmod(int(row.delay_ns) + round(1e9 * amount), int(row.sample_ns))
        row.delay_ns = rest_ns
        extra = [[0.0, 0.0, 1.0, 0.0, 0.0]] * (whole // 2) + [[0.0, 1.0, 0.0, 0.0, 0.0]] * (whole % 2)
    if used + len(extra) > MAX_SECTIONS:
        raise ValueError(f"a delay of {amount:g} s needs {len(extra)} filter sections: {MAX_SECTIONS - used} are free")
    for k, section in enumerate(extra):
        sections[used + k] = section
    row.filters.n_sections[axis] = used + len(extra)
