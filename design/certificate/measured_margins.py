"""Margins measured in flight: gain is raised, gain is lowered, or delay is added until the loop grows.

The nonlinear simulator flies a held flight (held_flight.py) with the loop altered inside its flight computer. A burst
at the critical frequency excites the loop, and the growth rate of its free response is measured. The margin is the
alteration for which that rate is zero. The secant rule finds it, starting from the margin of the linear loop. Near the
stability boundary, the rate is nearly linear in the alteration, so that three or four flights determine the margin to a
few hundredths of a dB.

Some loops have no measurable margin. A slowly growing root is measured by its rate (`drift`). A faster growth is
described by its end, a limit cycle or the loss of the vehicle (`limit_cycle`). If slosh is unstable in the linear loop,
its amplitude is assessed instead of a margin.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np

from maxq.control.kernel.records import Array
from maxq.control.structures import MAX_SECTIONS
from maxq.design.certificate import excitation
from maxq.design.certificate.held_flight import HeldFlight, PackedChange, unchanged
from maxq.design.certificate.response import UNEXPLAINED
from maxq.design.loop.fixed_path import fixed_path
from maxq.design.loop.loop import Loop
from maxq.design.margins.measure import LeastValue, Margins, margins
from maxq.design.model.dispersion import Dispersion, disperse_instruments
from maxq.design.model.node import slosh_columns
from maxq.sim.packing.flight import Packed
from maxq.sim.scenario.schema_scenario import Injection

MarginName = Literal["gain_up", "gain_down", "delay"]
UNITS: dict[MarginName, str] = {"gain_up": "dB", "gain_down": "dB", "delay": "s"}
MARGIN_NAMES: tuple[MarginName, ...] = tuple(UNITS)

MOST_FLIGHTS = 10
DRIFT_HZ = 0.02  # lower critical frequencies belong to the drift, which gravity affects (held_flight.py)
SLOWEST_HZ = 0.004  # slower oscillations are not visible in a flight of minutes, but a real root is
BEYOND_DB = 6.0  # range beyond the boundary in which a root must remain slow to count as too slow
DITHER_ABOVE_HZ = 2.0  # without dither, the converter sustains an oscillation of some pulses 0.5 dB inside the boundary
FINE_BELOW_HZ = 0.25  # far below the dither tones; commands of few converter steps are also dithered
# size of such a command, and largest amplitude of the weaker dither tone. With tones of A and B steps, rounding has a
# mean gain of 1 + 2 J0(2 pi A) J0(2 pi B) cos(2 pi x) at x steps, which is an error of 0.2 % for 50 and 79 steps.
FEW_STEPS, FINE_STEPS = 100.0, 50.0
FINE_SHARE = 0.2  # fraction of the linear range for the dither
RINGS_UP = 4.0  # growth factor of a burst at the stability boundary, which determines the length of the burst
LONGEST_BURST_S = 6.0
TOO_LONG = "longer than can be inserted"  # reason for a delay margin that is not measured
UNBOUNDED = "nothing bounds it"
TOO_SMALL = "commands less than a step of the converter"  # reason for a margin at very low gain that is not measured
TOO_SLOW = "grows too slowly to be seen"  # reason for a margin bounded by a slow root, which is not visible in flight
NOT_MEASURED = UNBOUNDED, TOO_LONG, TOO_SMALL, TOO_SLOW
NOT_SETTLED = "not settled"
SATURATED = math.inf  # growth rate if limits are reached before it can be measured
DECAYED = -math.inf  # growth rate if the response decays before it can be measured
SLOWEST_1PS = 1.0 / 160.0  # slowest drift: an e-fold within the longest flight of a certificate
FASTEST_UNSEEN_1PS = SLOWEST_1PS + 1.0 / 48.0  # adds the growth rate 1 / t of a uniform drift at the end of the wait
WATCHED_S = 240.0  # duration of flights for limit cycles
STEADY = 0.01  # largest relative difference between the last two quarters of a steady limit cycle
_LEAST_WINDOWS = 6
_STEP_DB = 0.1


@dataclass(frozen=True)
class BurstTest:
    """An excitation burst and the free response after it. All times are in s."""

    frequency_hz: float  # 0 for a step and the response of a real root
    burst_s: float
    wait_s: float
    watch_s: float
    window_s: float
    growth: float = 1.0  # amplitude at the end of the burst, relative to the burst

    @property
    def duration_s(self) -> float:
        return math.ceil(self.burst_s + self.wait_s + self.watch_s)


def burst_test(frequency_hz: float, build_up_1ps: float = 0.0) -> BurstTest:
    """Return a burst at a frequency, with the waiting and observation times after it.

    The burst lasts at least three periods, the waiting time six periods, and the observation at least 25 s and 24
    periods. Below LOWEST_BURST_HZ, where periods are long, waiting and observation are a third of these. For a real
    root, the burst is a step of 8 s, followed by 160 s. `build_up_1ps` is the rate at which a burst builds up at the
    stability boundary (`build_up_rate`).
    """
    if frequency_hz < SLOWEST_HZ:
        return BurstTest(0.0, 8.0, 40.0, 120.0, 40.0 / 3.0)  # a window contains whole periods of the dither tones
    turn, slow = 1.0 / frequency_hz, frequency_hz < excitation.LOWEST_BURST_HZ
    burst_s = max(3.0 * turn, min(RINGS_UP / build_up_1ps if build_up_1ps > 0.0 else 0.0, LONGEST_BURST_S))
    wait_s, watch_s = (2.0 * turn, 8.0 * turn) if slow else (6.0 * turn, max(25.0, 24.0 * turn))
    window_s = 2.0 * turn if slow else max(5.0 * turn, min(1.0, 25.0 * turn))
    return BurstTest(frequency_hz, burst_s, wait_s, watch_s, window_s, 1.0 + build_up_1ps * burst_s)


@dataclass(frozen=True)
class MeasuredMargin:
    """A margin of the linear loop and its measurement in flight, in `unit`, with the flights that determined it.

    `tried` contains pairs of alteration and measured growth rate (1/s). `measured` is NaN, with a `reason`, if no
    boundary was found.
    """

    what: MarginName
    unit: str
    linear: float
    measured: float
    frequency_hz: float
    tried: tuple[tuple[float, float], ...]
    reason: str = ""

    @property
    def difference(self) -> float:
        return self.measured - self.linear


def bound_of(of: Margins, what: MarginName) -> LeastValue:
    """Return a margin of the linear loop by its name."""
    return {"gain_up": of.gain_up_db, "gain_down": of.gain_down_db, "delay": of.delay_s}[what]


def measure_margin(held: HeldFlight, loop: Loop, of_loop: Margins, what: MarginName) -> MeasuredMargin:
    """Return the margin measured in flight, unless the linear loop is unstable or its margin is infinite."""
    bound = bound_of(of_loop, what)
    linear, frequency = float(bound.value), float(bound.frequency_hz)
    tried: list[tuple[float, float]] = []

    def found(measured: float, reason: str = "") -> MeasuredMargin:
        of_linear = linear if of_loop.stable else math.nan
        return MeasuredMargin(what, UNITS[what], of_linear, measured, frequency, tuple(tried), reason)

    if not of_loop.stable:
        return found(math.nan, "the linear loop is unstable")
    if not math.isfinite(linear):
        return found(math.nan, UNBOUNDED)
    most = longest_delay_s(held) if what == "delay" else math.inf
    if 1.02 * linear > most:
        return found(math.nan, TOO_LONG)
    if is_too_slow(loop, what, bound):
        grown = measured_growth(held, loop, burst_test(0.0), lambda packed: alter(packed, held, what, linear))
        tried.append((linear, grown))
        return found(math.nan, TOO_SLOW if grown <= FASTEST_UNSEEN_1PS else UNEXPLAINED)
    test = burst_test(frequency, build_up_rate(altered(loop, what, linear), frequency))
    if what == "gain_down" and excitation.burst_rad(held, test.frequency_hz) < _step_rad(held):
        return found(math.nan, TOO_SMALL)
    slope = abs(_slope(loop, what, bound))
    tolerance = 0.02 if what != "delay" else 0.003 * linear

    def grow(at: float) -> float:
        return measured_growth(held, loop, test, lambda packed: alter(packed, held, what, at))

    at, settled = settle(grow, tried, linear, slope, 0.25 * linear, tolerance, (-math.inf, most))
    return found(at, "the flight was lost" if math.isnan(at) else "" if settled else NOT_SETTLED)


def settle(
    grow: Callable[[float], float],
    tried: list[tuple[float, float]],
    at: float,
    slope: float,
    most: float,
    tolerance: float,
    within: tuple[float, float],
    flights: int = MOST_FLIGHTS,
) -> tuple[float, bool]:
    """Return the alteration at which the loop neither grows nor decays, and True if the search converged.

    `grow` flies an alteration and returns its growth rate (1/s); NaN ends the search with NaN. `tried` collects pairs
    of both. `at` is the first alteration. `slope` and `most` are those of `following_trial`. `within` are the bounds of
    the alteration.
    """
    for _ in range(flights):
        growth = grow(at)
        tried.append((at, growth))
        if math.isnan(growth):
            return math.nan, False
        following = float(np.clip(following_trial(tried, slope, most, 5.0 * tolerance), *within))
        step, at = following - at, following
        if abs(step) < tolerance:
            return at, True
    return at, False


def is_too_slow(loop: Loop, what: MarginName, bound: LeastValue) -> bool:
    """Return True if the margin is bounded by an oscillation that does not grow e-fold within a flight, for any gain.

    The condition is tested at the boundary and BEYOND_DB beyond it. In thin air, an attitude without restoring moment
    drifts in this way.
    """
    if what == "delay" or not bound.frequency_hz < SLOWEST_HZ:
        return False
    past = altered(loop, what, bound.value + BEYOND_DB).closed_poles()
    slow = past[np.abs(past) < 2.0 * np.pi * excitation.LOWEST_BURST_HZ]
    return bool(bound.frequency_hz > 0.0 and slow.real.max(initial=-math.inf) < SLOWEST_1PS)


def following_trial(tried: list[tuple[float, float]], slope: float, most: float, apart: float) -> float:
    """Return the next alteration by the secant rule, or by bisection if the secant rule leaves the known bounds.

    The bounds are alterations that decayed and grew. `slope` (1/s per unit) is used until two trials that differ by at
    least `apart` give a better value. No step exceeds `most`.
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


def build_up_rate(boundary: Loop, frequency_hz: float) -> float:
    """Return the build-up rate (1/s) of a sine at the frequency of a pole on the imaginary axis.

    It is the magnitude of the residue of 1 / (1 + L).
    """
    if frequency_hz < SLOWEST_HZ:
        return 0.0
    apart = 1e-4 * frequency_hz
    low, high = boundary.response(np.array([frequency_hz - apart, frequency_hz + apart]))
    return float(4.0 * np.pi * apart / abs(high - low))


def altered(loop: Loop, what: MarginName, amount: float) -> Loop:
    """Return the linear loop with gain (dB) added or removed, or with an additional delay (s) of the computer."""
    if what == "delay":
        node = loop.fixed.node
        late = disperse_instruments(node.instruments, Dispersion(delay_s=amount))
        path = fixed_path(dataclasses.replace(node, instruments=late), loop.fixed.kind, loop.fixed.cut)
        return dataclasses.replace(loop, fixed=path)
    return dataclasses.replace(loop, law=loop.law.scaled(_gain(what, amount)))


def _gain(what: MarginName, amount_db: float) -> float:
    return float(10.0 ** ((amount_db if what == "gain_up" else -amount_db) / 20.0))


def _slope(loop: Loop, what: MarginName, bound: LeastValue) -> float:
    """Return the derivative of the critical pole's real part with respect to the alteration, 1/s per unit."""
    step, place = 1e-3 * bound.value, 2j * np.pi * bound.frequency_hz
    low, high = (altered(loop, what, x).closed_poles() for x in (bound.value - step, bound.value + step))
    return float(np.ptp([p[np.argmin(np.abs(p - place))].real for p in (low, high)]) / (2.0 * step))


def measured_growth(
    held: HeldFlight, loop: excitation.Excited, test: BurstTest, change: PackedChange = unchanged
) -> float:
    """Return the growth rate (1/s) of the free response in flight, or NaN if the flight ended early.

    `loop` determines the dither.
    """
    amplitude = excitation.burst_rad(held, test.frequency_hz, test.growth)
    swings = test.frequency_hz > 0.0
    signals: tuple[Injection, ...] = (
        excitation.sine(held, test.frequency_hz, amplitude, test.burst_s)
        if swings
        else excitation.gimbal_injection(held.plane, "step", amplitude, stop_s=round(test.burst_s, 6)),
    )
    step_rad = _step_rad(held)
    if test.frequency_hz > DITHER_ABOVE_HZ:
        tones = excitation.dither(held, loop, np.array(excitation.dither_tones_hz(loop.fixed)))
        signals += excitation.injections(tones, held.plane)
    elif test.frequency_hz < FINE_BELOW_HZ and amplitude * test.growth < FEW_STEPS * step_rad:
        signals += excitation.injections(fine_dither(held, excitation.dither_tones_hz(loop.fixed)), held.plane)
    run, values = held.fly(test.duration_s, signals, change)
    response = values[:, run.table.index(f"filtered_{held.plane}_deg")]
    first = round((test.burst_s + test.wait_s) / held.sample_s)
    limit = math.degrees(excitation.linear_room(held, test.frequency_hz)[0])
    over = np.flatnonzero(np.abs(response) > limit)
    if (
        swings and test.frequency_hz < FINE_BELOW_HZ and len(over)
    ):  # the motion after saturation is not the free response
        response = response[: over[0]]
    elif len(response) - first < 0.9 * test.watch_s / held.sample_s:
        return SATURATED if len(over) else math.nan
    least = 0.15 * math.degrees(amplitude) * test.growth if swings else 0.0
    return growth_rate(response[first:], held.sample_s, test.frequency_hz, test.window_s, limit, least)


def fine_dither(held: HeldFlight, tones_hz: tuple[float, ...] = excitation.DITHER_HZ[:2]) -> excitation.Groups:
    """Return two tones that start without an impulse, and with which the gain of rounding is close to 1.

    `tones_hz` are their frequencies, the lower one first.

    A tone A sin(w t) that starts at rest gives the slow motion an angular velocity of A / w, the mean of its integral.
    The tones have opposite signs and amplitudes proportional to their frequencies, so that these impulses cancel. With
    two equal tones of 50 steps, petrel at 125.6 s moved by nine times the goal of the burst, and cross-flow lift then
    turned it over.
    """
    low, high = tones_hz
    rooms = (FINE_SHARE * min(excitation.linear_room(held, hz)) * low / hz for hz in tones_hz)
    weaker = min(FINE_STEPS * _step_rad(held), *rooms)
    return [(weaker, np.array([low])), (-weaker * high / low, np.array([high]))]


def growth_rate(
    samples: Array, sample_s: float, frequency_hz: float, window_s: float, limit: float = math.inf, least: float = 0.0
) -> float:
    """Return the growth rate (1/s) of an oscillation near a frequency, or of a drift at 0 Hz.

    It is the slope of the logarithm of the envelope, which is computed in windows with a raised-cosine weight. The
    weight rejects drifts, and motions whose frequency differs by more than one period per window. Values below a tenth
    of the initial value are excluded, since noise would hide the decay. Values above `limit` (in the unit of the
    samples) are excluded, since saturation would hide the growth: a limit cycle does not grow. The result is
    `SATURATED` if the envelope exceeds `limit` from the beginning or soon after, and `DECAYED` if it begins below
    `least`.
    """
    window = max(round(window_s / sample_s), 8)
    weight = np.hanning(window)
    turn = weight * np.exp(-2j * np.pi * frequency_hz * sample_s * np.arange(window))
    starts = np.arange(0, len(samples) - window, max(window // 4, 1))
    double = 2.0 if frequency_hz > 0.0 else 1.0
    if frequency_hz > 0.0:  # rejects a constant and a slow drift
        slow = np.vander(np.linspace(-1.0, 1.0, window), 3)
        turn = turn - weight * (slow @ np.linalg.solve(slow.T @ (weight[:, None] * slow), slow.T @ turn))
    if len(samples) <= window:
        return SATURATED
    envelope = double * np.abs(np.array([samples[s : s + window] @ turn for s in starts])) / weight.sum()
    times = (starts + 0.5 * window) * sample_s
    over = np.flatnonzero(envelope > limit)
    count = int(over[0]) if len(over) else len(envelope)
    if count < _LEAST_WINDOWS:
        return SATURATED
    if envelope[0] < least:
        return DECAYED
    under = np.flatnonzero(envelope[:count] < 0.1 * envelope[0])
    count = max(int(under[0]), _LEAST_WINDOWS) if len(under) else count
    return float(np.polyfit(times[:count], np.log(np.maximum(envelope[:count], 1e-300)), 1)[0])


def _step_rad(held: HeldFlight) -> float:
    """Return the step of the converter from commands to angles, or 0 for an ideal converter."""
    return float(held.packed.parameters[0].computer.dac_step_rad)


def longest_delay_s(held: HeldFlight) -> float:
    """Return the longest delay that the free filter sections can hold, with two samples each."""
    free = MAX_SECTIONS - int(held.packed.parameters[0].computer.law.pd.n_sections[held.axis])
    return 2.0 * free * held.sample_s


def alter(packed: Packed, held: HeldFlight, what: MarginName, amount: float) -> None:
    """Alter the packed flight's computer in place, on the held axis, by sections after those of the filter.

    Raises ValueError if a delay needs more sections than are free.
    """
    row, axis = packed.parameters[0].computer, held.axis
    sections, used = row.law.pd.sections[axis], int(row.law.pd.n_sections[axis])
    if what != "delay":
        extra = [[_gain(what, amount), 0.0, 0.0, 0.0, 0.0]]
    else:
        whole, rest_ns = divmod(int(row.delay_ns) + round(1e9 * amount), int(row.sample_ns))
        row.delay_ns = rest_ns
        extra = [[0.0, 0.0, 1.0, 0.0, 0.0]] * (whole // 2) + [[0.0, 1.0, 0.0, 0.0, 0.0]] * (whole % 2)
    if used + len(extra) > MAX_SECTIONS:
        raise ValueError(f"a delay of {amount:g} s needs {len(extra)} filter sections: {MAX_SECTIONS - used} are free")
    for k, section in enumerate(extra):
        sections[used + k] = section
    row.law.pd.n_sections[axis] = used + len(extra)


@dataclass(frozen=True)
class Drift:
    """The growth rate (1/s) of the slowest root, in the linear loop and in flight, and its change per decibel of gain.

    `others` contains the margins of the held loop without that root.
    """

    linear_1ps: float
    measured_1ps: float
    per_db_1ps: float
    others: Margins


def drift(held: HeldFlight, loop: Loop, of_held: Margins) -> Drift | None:
    """Measure a held loop in which only the slowest root is unstable and grows slowly, or return None for other loops.

    In a held flight, the axial load acts as gravity (held_flight.py) and is several times the real gravity. The slowest
    root then sometimes crosses the imaginary axis, although the loop at the flown instant is stable. Such a root takes
    minutes to grow e-fold, so that all other properties of the loop can be measured. The growth rate of the root is
    measured too, since it reveals a wrong sign or a wrong gravity in the slow motion.
    """
    if of_held.stable or of_held.growth_hz >= DRIFT_HZ or not 0.0 < of_held.growth_1ps <= SLOWEST_1PS:
        return None
    others = margins(loop, lowest_hz=DRIFT_HZ)
    if not others.stable:
        return None
    measured = measured_growth(held, loop, burst_test(0.0))
    more, less = (altered(loop, "gain_up", db).closed_poles().real.max() for db in (_STEP_DB, -_STEP_DB))
    return Drift(of_held.growth_1ps, measured, float(abs(more - less) / (2.0 * _STEP_DB)), others)


@dataclass(frozen=True)
class LimitCycle:
    """The end of an excited flight.

    `kind` is "decays", "limit cycle", "grows" (not steady at the end) or "lost". `gimbal_deg` and `slosh_deg` (the
    largest of all tanks) are amplitudes at the end. `frequency_hz` is that of the command.
    """

    kind: str
    frequency_hz: float
    gimbal_deg: float
    slosh_deg: float
    after_s: float

    @property
    def text(self) -> str:
        swings = f"gimbal {self.gimbal_deg:.2g} deg, slosh {self.slosh_deg:.2g} deg"
        return {
            "limit cycle": f"limit cycle at {self.frequency_hz:.3g} Hz: {swings}",
            "decays": "decays",
            "grows": f"still grows after {self.after_s:g} s",
        }.get(self.kind, f"lost after {self.after_s:.0f} s")


def limit_cycle(
    held: HeldFlight, frequency_hz: float, change: PackedChange = unchanged, watched_s: float = WATCHED_S
) -> LimitCycle:
    """Excite the held flight by a burst at a frequency, and classify its end. `change` may make the flight unstable."""
    run, rows = held.fly(watched_s, (excitation.sine_burst(held, frequency_hz),), change)
    command = rows[:, run.table.index(f"gimbal_{held.plane}_command_deg")]
    slosh = slosh_columns(run, held.plane)
    quarter = len(command) // 4
    if run.now_s < watched_s - 1.0 or quarter < 8:
        return LimitCycle("lost", frequency_hz, amplitude(command), _largest(rows, slosh, 0), run.now_s)
    after = command[3 * quarter :]
    level, earlier = amplitude(after), amplitude(command[2 * quarter : 3 * quarter])
    if level < 0.5 * earlier or level < 0.05 * amplitude(command[:quarter]):
        kind = "decays"
    elif abs(level / earlier - 1.0) < STEADY:
        kind = "limit cycle"
    else:
        kind = "grows" if level > earlier else "decays"
    spectrum = np.abs(np.fft.rfft((after - after.mean()) * np.hanning(len(after))))
    strongest_hz = float(np.argmax(spectrum) / (len(after) * held.sample_s))
    return LimitCycle(kind, strongest_hz, level, _largest(rows, slosh, 3 * quarter), run.now_s)


def amplitude(samples: Array) -> float:
    """Return half the peak-to-peak value of samples."""
    return float(0.5 * np.ptp(samples)) if len(samples) else 0.0


def _largest(rows: Array, columns: list[int], first: int) -> float:
    return max((amplitude(rows[first:, c]) for c in columns), default=0.0)
