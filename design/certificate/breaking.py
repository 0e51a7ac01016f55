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

from maxq.control.filters import MAX_SECTIONS
from maxq.control.records import Array
from maxq.design.certificate.held_flight import HeldFlight
from maxq.design.certificate.loudness import burst_rad
from maxq.design.loop.fixed_path import fixed_path
from maxq.design.loop.loop import Loop
from maxq.design.margins.measure import Margins
from maxq.design.model.dispersion import Dispersion, disperse
from maxq.sim.flight.fly import KeptRows
from maxq.sim.flight.telemetry import FAST
from maxq.sim.packing.flight import Packed
from maxq.sim.scenario.schema_injection import Injection

What = Literal["gain_up", "gain_down", "delay"]
WHATS: tuple[What, ...] = ("gain_up", "gain_down", "delay")
UNITS: dict[What, str] = {"gain_up": "dB", "gain_down": "dB", "delay": "s"}

MOST_FLIGHTS = 7
DRIFT_HZ = 0.02  # slower than this the edge is that of a root without oscillation


@dataclass(frozen=True)
class Watch:
    """How a loop is set ringing and watched: all times in s."""

    frequency_hz: float  # 0: a push, and a drift
    burst_s: float
    wait_s: float
    watch_s: float
    window_s: float

    @property
    def duration_s(self) -> float:
        return math.ceil(self.burst_s + self.wait_s + self.watch_s)


def watch_at(frequency_hz: float) -> Watch:
    """Three turns of burst, six to wait, at least 25 s and 24 turns to watch; minutes where the edge is a drift's."""
    if frequency_hz < DRIFT_HZ:
        return Watch(0.0, 5.0, 60.0, 300.0, 20.0)
    turn = 1.0 / frequency_hz
    return Watch(frequency_hz, 3.0 * turn, 6.0 * turn, max(25.0, 24.0 * turn), 4.0 * turn)


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
        return Broken(what, UNITS[what], linear, math.nan, frequency, (), "nothing bounds it")
    watch = watch_at(frequency)
    slope = _slope(loop, what, linear)
    tolerance = 0.01 if what != "delay" else 0.002 * linear
    tried: list[tuple[float, float]] = []
    at = linear
    for _ in range(MOST_FLIGHTS):
        growth = _growth(held, what, at, watch)
        tried.append((at, growth))
        if not math.isfinite(growth):
            return Broken(what, UNITS[what], linear, math.nan, frequency, tuple(tried), "the flight was lost")
        if len(tried) > 1 and tried[-1][0] != tried[-2][0]:
            measured = (tried[-1][1] - tried[-2][1]) / (tried[-1][0] - tried[-2][0])
            slope = measured if measured * slope > 0.0 else slope
        step = float(np.clip(-growth / slope, -0.25 * linear, 0.25 * linear))
        at += step
        if abs(step) < tolerance:
            return Broken(what, UNITS[what], linear, at, frequency, tuple(tried))
    return Broken(what, UNITS[what], linear, at, frequency, tuple(tried), "not settled")


def altered(loop: Loop, what: What, amount: float) -> Loop:
    """The linear loop with gain (dB) added or taken away, or a delay (s) added to the computer's."""
    if what == "delay":
        path = fixed_path(disperse(loop.fixed.node, Dispersion(delay_s=amount)), loop.fixed.kind, loop.fixed.cut)
        return dataclasses.replace(loop, fixed=path)
    gain = 10.0 ** ((amount if what == "gain_up" else -amount) / 20.0)
    return dataclasses.replace(loop, k_p=gain * loop.k_p, k_d_s=gain * loop.k_d_s)


def _slope(loop: Loop, what: What, at: float) -> float:
    """How fast the linear loop's fastest growing pole moves with the alteration, 1/s per unit."""
    step = 1e-3 * at
    low, high = (altered(loop, what, x).closed_poles().real.max() for x in (at - step, at + step))
    return float((high - low) / (2.0 * step))


def _growth(held: HeldFlight, what: What, amount: float, watch: Watch) -> float:
    """Growth (1/s) of the ringing in flight; NaN where the flight ended early."""
    kind = {"kind": "sine", "frequency_hz": watch.frequency_hz} if watch.frequency_hz > 0.0 else {"kind": "step"}
    burst = {"amplitude_deg": math.degrees(burst_rad(held, watch.frequency_hz)), "stop_s": round(watch.burst_s, 6)}
    injection = Injection.model_validate({"at": "gimbal_command", "axis": held.plane, **kind, **burst})
    run = held.run(watch.duration_s, (injection,), lambda packed: _alter(packed, held, what, amount))
    kept = KeptRows()
    while not run.finished:
        kept.add(run.fly_segment())
    _, values = kept.rows()[FAST]
    ringing = values[:, run.table.index(f"filtered_{held.plane}_deg")]
    first = round((watch.burst_s + watch.wait_s) / held.sample_s)
    if len(ringing) - first < 0.9 * watch.watch_s / held.sample_s:
        return math.nan
    return ringing_growth(ringing[first:], held.sample_s, watch.frequency_hz, watch.window_s)


def ringing_growth(samples: Array, sample_s: float, frequency_hz: float, window_s: float) -> float:
    """Rate (1/s) at which an oscillation near a frequency grows, or at 0 Hz a drift: slope of its envelope's logarithm.

    The envelope is that of windows with a raised-cosine weight, which shuts out drifts and what is more than a turn a
    window away.
    """
    window = max(round(window_s / sample_s), 8)
    turn = np.hanning(window) * np.exp(-2j * np.pi * frequency_hz * sample_s * np.arange(window))
    starts = np.arange(0, len(samples) - window, max(window // 2, 1))
    envelope = np.abs(np.array([samples[s : s + window] @ turn for s in starts]))
    times = (starts + 0.5 * window) * sample_s
    return float(np.polyfit(times, np.log(np.maximum(envelope, 1e-300)), 1)[0])


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
