"""The in-flight response: the loop measured in the ascent itself, while mass, speed, air and gains change.

The ascent is flown twice without adaptation, once with and once without the excitation. In the difference of both
flights, guidance, wind and path cancel, and the response to the excitation remains. In a window around the time of the
operating point, least squares estimate the lines of a multisine together with a slow trend. The window is short, so
that only lines above half a hertz can be resolved.

The response differs from that of the held flight for two reasons, which the linear loop accounts for. First, the
vehicle changes during the window; sampled loops at operating points across the window give this change. Where that does
not explain a line, the loop is advanced along the ascent (time_varying.py). Second, gravity is the real one, which
affects the lowest lines only.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from maxq.control.kernel.records import Array
from maxq.design import operating_points
from maxq.design.certificate.excitation import SHARE_OF_BURST, gimbal_injection
from maxq.design.certificate.held_flight import with_ideal_converters
from maxq.design.certificate.response import NOISE, NOISE_SIGMAS, UNEXPLAINED, decibels, degrees
from maxq.design.certificate.time_varying import output_along
from maxq.design.loop.fixed_path import FixedPath, fixed_path
from maxq.design.loop.loop import Loop, loops
from maxq.design.model.instruments import Plane
from maxq.design.model.node import Node, with_swings
from maxq.design.model.powered import Span, powered_flight, powered_spans, spans_of
from maxq.design.model.state_space import ComplexArray
from maxq.sim.flight.telemetry import FAST
from maxq.sim.packing.flight import pack_flight
from maxq.sim.run.fly import FlightRun
from maxq.sim.scenario.loader import LoadedScenario
from maxq.sim.scenario.schema_scenario import Injection, LogSection

WINDOW_S = 8.0
SETTLE_S = 2.5  # after liftoff
ACROSS = (-0.5, -0.25, 0.0, 0.25, 0.5)  # operating points of the linear loop, relative to the window
LINES_HZ = tuple(n / WINDOW_S for n in (4, 7, 11, 18, 29, 46, 62, 74, 90))  # 0.5 .. 11 Hz
SPACING_S = 0.5  # between the operating points of the loop along the ascent, which is linear in time between them
TIME_CONSTANTS = 5.0  # for which this loop is advanced before a window; 0.7 % of an initial motion remains
COMMAND_DEG = 0.35  # upper bound of each line; all lines together use less than half of any limit
WITHIN_DB, WITHIN_DEG = 0.5, 4.0
TIME_VARIATION, SETTLING = "time variation", "settling"


@dataclass(frozen=True)
class InFlightResponse:
    """The response L at lines (Hz), measured in the ascent around `time_s`.

    `frozen` is the sampled loop at that instant. `reason` is "" if both agree to 0.5 dB and 4 deg. Otherwise it is one
    of:

    - "time variation": the loop's own change in the window is as large as the difference. Alternatively, the loop that
      is advanced along the ascent gives the measured response to 0.5 dB and 4 deg.
    - "converter noise": this change and the standard errors together explain the difference, or the difference vanishes
      in flights with ideal converters.
    - "settling": an oscillation near a line has not decayed since liftoff.
    - "unexplained".
    """

    time_s: float
    plane: Plane
    lines_hz: Array
    frozen: ComplexArray
    measured: ComplexArray
    error: Array  # relative standard error of `measured`, from the residual
    reason: tuple[str, ...]

    @property
    def difference_db(self) -> Array:
        return decibels(self.measured / self.frozen)

    @property
    def difference_deg(self) -> Array:
        return degrees(self.measured / self.frozen)


def in_flight_response(loaded: LoadedScenario, times_s: Sequence[float], plane: Plane) -> list[InFlightResponse]:
    """Measure the response around each time.

    Two ascents serve all times of a burn: one without excitation, and one excited from its ignition on. The flight up
    to this ignition has no excitation. An unstable airframe in a coast would otherwise amplify the remaining motion
    until control is lost. Raises ValueError for a scenario without a design.
    """
    design = loaded.design
    if design is None:
        raise ValueError(f"{loaded.label}: there is no design to measure")
    return _by_burn(loaded, lambda nodes: loops(nodes, design), times_s, plane)


def in_flight_response_of_code(
    loaded: LoadedScenario, held: Mapping[float, ComplexArray], plane: Plane
) -> list[InFlightResponse]:
    """Measure the response of flight code around each time, for comparison with held flights at LINES_HZ.

    `held` contains, by time, the responses in held flights, which become `frozen`. Within the window, only the change
    of the vehicle is known, not that of the code; the only known poles are those of the vehicle without feedback.
    """

    def of(nodes: Sequence[Node]) -> list[_ResponseOfCode]:
        paths = [fixed_path(node, "sampled") for node in nodes]
        middle = len(nodes) // 2
        return [_ResponseOfCode(path, paths[middle], held[nodes[middle].time_s]) for path in paths]

    return _by_burn(loaded, of, list(held), plane)


class _Response(Protocol):
    def response(self, frequencies_hz: Array) -> ComplexArray: ...

    def closed_poles(self) -> ComplexArray: ...


@dataclass(frozen=True)
class _ResponseOfCode:
    """The loop of flight code at an operating point close to that of a held flight.

    It is the response measured in the held flight, multiplied by the ratio of the paths at both points.
    """

    path: FixedPath
    there: FixedPath
    held: ComplexArray

    def response(self, frequencies_hz: Array) -> ComplexArray:
        return np.asarray(self.held * self.path.response(frequencies_hz) / self.there.response(frequencies_hz))

    def closed_poles(self) -> ComplexArray:
        return np.array([r.pole_radps for r in self.path.resonances()], np.complex128)


LoopsAt = Callable[[Sequence[Node]], Sequence[_Response]]


def _by_burn(
    loaded: LoadedScenario, loops_at: LoopsAt, times_s: Sequence[float], plane: Plane
) -> list[InFlightResponse]:
    by_burn: dict[tuple[int, float], list[Node]] = {}
    for node in operating_points.nodes(loaded, times_s, plane=plane):
        by_burn.setdefault((node.stage, node.stage_start_s), []).append(node)
    return [found for nodes in by_burn.values() for found in _of_burn(loaded, loops_at, nodes, plane)]


def _of_burn(loaded: LoadedScenario, loops_at: LoopsAt, points: Sequence[Node], plane: Plane) -> list[InFlightResponse]:
    """Measure the response around the operating points of one burn of a stage."""
    times_s, sample_s = [node.time_s for node in points], points[0].instruments.sample_s
    whole = powered_spans(loaded)
    for time_s in times_s:
        _window(time_s, whole)  # raises an error before any flight
    start_s = round(min(span.begin_s for span in whole if any(map(span.holds, times_s))), 9)
    lines = np.array(LINES_HZ)
    lasting = {"frequencies_hz": LINES_HZ, "start_s": start_s}
    signal = gimbal_injection(plane, "multisine", math.radians(_amplitude_deg(loaded)), **lasting)
    end_s = max(times_s) + 0.5 * WINDOW_S
    quiet, excited = (_flown(loaded, signals, plane, end_s, sample_s) for signals in ((), (signal,)))
    spans = [Span(a.stage, a.begin_s, min(a.end_s, b.end_s)) for a, b in zip(quiet.spans, excited.spans, strict=False)]
    windows = [_window(t, spans) for t in times_s]
    across = [tuple(t + share * (w[1] - w[0]) for share in ACROSS) for t, w in zip(times_s, windows, strict=True)]
    begun_s = [next(span.begin_s for span in spans if span.holds(t)) for t in times_s]
    excited_by = loaded.scenario.model_copy(update={"injection": (signal,)})  # determines the waves at rings

    def excited_nodes(at_s: Sequence[float]) -> list[Node]:
        nodes = operating_points.nodes(loaded, at_s, plane=plane)
        return with_swings(nodes, dataclasses.replace(loaded, scenario=excited_by))

    nodes = excited_nodes([x for each in across for x in each])
    sents = (excited.command - quiet.command)[points[0].instruments.rows_late :]
    backs = (excited.filtered - quiet.filtered)[: len(sents)]
    injected = sents - backs
    out = []
    for k, (time_s, (begin, end)) in enumerate(zip(times_s, windows, strict=True)):
        first, last = round(begin / sample_s), round(end / sample_s)
        (u, u_noise), (e, _) = (_at_lines(x[first:last], lines, sample_s) for x in (backs, sents))
        mine = loops_at(nodes[k * len(ACROSS) : (k + 1) * len(ACROSS)])
        responses = np.stack([loop.response(lines) for loop in mine])
        frozen = responses[len(mine) // 2]
        measured = -u / e
        error = u_noise * np.abs(1.0 + measured) / np.abs(u)
        spread, turn = np.ptp(decibels(responses), axis=0), np.degrees(np.ptp(np.angle(responses / frozen), axis=0))
        poles = mine[len(mine) // 2].closed_poles()
        rings = poles[-poles.real * (begin - begun_s[k]) < 3.0]
        near = [bool((np.abs(np.abs(rings.imag) / (2.0 * np.pi) - f) < 0.5).any()) for f in lines]
        reasons = tuple(
            _reason(complex(measured[i] / frozen[i]), float(error[i]), float(spread[i]), float(turn[i]), near[i])
            for i in range(len(lines))
        )
        if UNEXPLAINED in reasons and all(isinstance(loop, Loop) for loop in mine):
            slowest = min((-p.real for p in poles if lines[0] < p.imag / (2.0 * math.pi) < lines[-1]), default=1.0)
            start = max(begin - TIME_CONSTANTS / max(slowest, 1e-3), begun_s[k] + SETTLE_S)
            at_s = np.linspace(start, end, math.ceil((end - start) / SPACING_S) + 1)
            moving = loops_at(excited_nodes(at_s.tolist()))
            along = output_along(
                [loop for loop in moving if isinstance(loop, Loop)], at_s, injected[:last], round(start / sample_s)
            )
            if along is not None:
                (u, _), (e, _) = (_at_lines(x[first:], lines, sample_s) for x in (along, along + injected[:last]))
                reasons = variation_share(reasons, measured / (-u / e))
        out.append(InFlightResponse(time_s, plane, lines, frozen, measured, error, reasons))
    unexplained = [k for k, found in enumerate(out) if UNEXPLAINED in found.reason]
    ideal = with_ideal_converters(loaded)  # code that needs the pulses of the gyro is lost: nothing is explained
    if unexplained and loaded.scenario.switches.converter == "full" and powered_flight(ideal)[1] is None:
        again = _by_burn(ideal, loops_at, [times_s[k] for k in unexplained], plane)
        for k, fine in zip(unexplained, again, strict=True):
            out[k] = dataclasses.replace(out[k], reason=converters_share(out[k].reason, fine.reason))
    return out


def variation_share(reasons: Sequence[str], ratios: ComplexArray) -> tuple[str, ...]:
    """Return the reasons of lines, given the ratios of the measured response to that of the loop along the ascent."""
    agree = (np.abs(decibels(ratios)) <= WITHIN_DB) & (np.abs(degrees(ratios)) <= WITHIN_DEG)
    of_lines = zip(reasons, agree, strict=True)
    return tuple(TIME_VARIATION if reason == UNEXPLAINED and near else reason for reason, near in of_lines)


def converters_share(reasons: Sequence[str], fine: Sequence[str]) -> tuple[str, ...]:
    """Return the reasons of lines, with unexplained differences attributed to the converters where appropriate.

    A difference is due to the converters if it is explained in flights with ideal converters (`fine`). Errors of
    converters repeat with the excitation, so that they occur on its lines and not between them.
    """
    return tuple(NOISE if a == UNEXPLAINED != b else a for a, b in zip(reasons, fine, strict=True))


def _half(time_s: float, span: Span) -> float:
    """Return half the length of the window about a time, s."""
    return min(0.5 * WINDOW_S, time_s - span.begin_s - SETTLE_S, span.end_s - time_s - 0.1)


def fits(time_s: float, spans: Sequence[Span]) -> bool:
    """Return True if a window about a time is within a powered span."""
    return any(_half(time_s, span) >= 0.2 * WINDOW_S for span in spans)


def _window(time_s: float, spans: Sequence[Span]) -> tuple[float, float]:
    """Return the start and end of the symmetric window about a time, s.

    Raises ValueError if the time is too close to the ends of thrust.
    """
    if not fits(time_s, spans):
        least, allowed = SETTLE_S + 0.2 * WINDOW_S, []
        for span in spans:
            allowed.append(f"{span.begin_s + least:.6g} s to {span.end_s - 0.1 - 0.2 * WINDOW_S:.6g} s")
        raise ValueError(
            f"operating point at {time_s:g} s: too near to the ends of thrust to be measured in flight; "
            f"allowed is {', '.join(allowed)}, or certificate.in_flight = false"
        )
    half = max(_half(time_s, span) for span in spans)
    return time_s - half, time_s + half


def _amplitude_deg(loaded: LoadedScenario) -> float:
    """Return the amplitude of each line.

    The sum of all lines remains below the fraction of every stage's gimbal rate and angle that a burst may use.
    """
    together = math.sqrt(2.0 * len(LINES_HZ))  # crest factor of many sines
    actuators = [actuator for stage in loaded.vehicle.stage for actuator in stage.actuators]
    by_rate = [a.rate_limit_degps * 2.0 * a.zeta[0] / (2.0 * math.pi * a.omega_hz[0]) for a in actuators]
    return min([COMMAND_DEG, *(SHARE_OF_BURST * rate / together for rate in by_rate)])


@dataclass(frozen=True)
class _Ascent:
    """The filter output and gimbal command (deg) of an ascent, one entry per sample from time zero.

    `spans` are the powered spans of the stages.
    """

    filtered: Array
    command: Array
    spans: tuple[Span, ...]


def _flown(
    loaded: LoadedScenario, signals: tuple[Injection, ...], plane: Plane, end_s: float, sample_s: float
) -> _Ascent:
    scenario = loaded.scenario
    run_s = scenario.run.model_copy(update={"duration_s": math.ceil(end_s - scenario.run.start_s) + 1.0})
    log = LogSection(fast_hz=1.0 / sample_s, slow_hz=1.0, transform_hz=1.0)
    still = {"injection": signals, "fault": (), "run": run_s, "log": log}
    if scenario.design is not None:
        still["design"] = scenario.design.at_unit_gain
    scenario = scenario.model_copy(update=still)
    run = FlightRun(dataclasses.replace(loaded, scenario=scenario), pack_flight(scenario))
    kept, columns = [], [run.table.index(f"{name}_deg") for name in (f"filtered_{plane}", f"gimbal_{plane}_command")]
    while not run.finished:
        kept.append(run.fly_segment()[FAST][1][:, columns])  # all channels of a long coast would take much memory
    filtered, command = np.concatenate(kept).T
    return _Ascent(filtered, command, spans_of(run.events, len(scenario.vehicle.stage), run.now_s))


def _at_lines(samples: Array, lines_hz: Array, sample_s: float) -> tuple[ComplexArray, float]:
    """Return the phasors at the lines, and the standard deviation of each, estimated from the residual.

    The least-squares fit includes a cubic trend, with weights that taper at both ends.
    """
    n = len(samples)
    time = sample_s * np.arange(n)
    x = np.linspace(-1.0, 1.0, n)
    weight = np.hanning(n + 2)[1:-1]
    angle = 2.0 * np.pi * np.outer(time, lines_hz)
    columns = np.column_stack([np.cos(angle), np.sin(angle), *(x**k for k in range(4))])
    found = np.linalg.lstsq(weight[:, None] * columns, weight * samples, rcond=None)[0]
    left = weight * (samples - columns @ found)
    k = len(lines_hz)
    noise = math.sqrt(float(left @ left) / float(weight @ weight)) * math.sqrt(4.0 / n)
    return np.asarray(found[:k] - 1j * found[k : 2 * k]), noise


def _reason(ratio: complex, error: float, spread_db: float, spread_deg: float, rings: bool) -> str:
    db, deg = abs(20.0 * math.log10(max(abs(ratio), 1e-300))), abs(math.degrees(np.angle(ratio)))
    if db <= WITHIN_DB and deg <= WITHIN_DEG:
        return ""
    if db <= WITHIN_DB + spread_db and deg <= WITHIN_DEG + spread_deg:
        return TIME_VARIATION
    if rings:
        return SETTLING
    noise = NOISE_SIGMAS * error * abs(ratio)  # `error` is relative to the measurement, and `ratio` to the linear loop
    return NOISE if abs(ratio - 1.0) <= noise + 10.0 ** (spread_db / 20.0) - 1.0 else UNEXPLAINED
