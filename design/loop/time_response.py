"""The closed loop over time: after a step of the commanded attitude or at the gimbal, and in a gust.

The closed loop is a state space with the inputs

- `attitude_command_rad`: the commanded attitude, which the law subtracts from the measured angle and its integral. The
  drift that navigation measures does not change, since the trajectory remains.
- `gimbal_disturbance_rad`: an angle that is added to the command of the law.
- `wind_mps`: the lateral velocity of the air, equal along the whole vehicle.

It is discrete for a sampled loop, with the wind constant between the instants at which commands act; the outputs of the
vehicle are then means over a sample. For the kind `exact`, the delays are Padé approximants of order `ORDER`, with an
error of 1e-6 of the response for delays up to 50 ms and modes up to 20 Hz.
"""

from __future__ import annotations

import math
from collections.abc import MutableMapping
from dataclasses import dataclass, replace
from typing import Literal
from weakref import WeakKeyDictionary

import numpy as np
import scipy.linalg

from maxq.control.kernel.records import Array
from maxq.design.laws.law import ANGLES, DRIFTS
from maxq.design.loop.fixed_path import ExactFixedPath, FixedPath, PadeFixedPath, delayed
from maxq.design.loop.loop import Loop
from maxq.design.loop.rational import Rational
from maxq.design.loop.sampling import exponential, sample
from maxq.design.model.held import WIND
from maxq.design.model.instruments import ACCELERATION, actuators, gyro
from maxq.design.model.state_space import StateSpace, chain, channels

Stepped = Literal["attitude", "gimbal"]
"""The inputs for a step."""
INPUTS = ("attitude_command_rad", "gimbal_disturbance_rad", WIND)
OUTPUTS = ("attitude_rad", "rate_radps", "gimbal_rad", "w_mps", "theta_rad")
ORDER = 7
STEPS = 1200  # of a continuous response
_CONSTANTS, _SHORTEST_S, _LONGEST_S = 4.0, 2.0, 60.0  # time constants of the slowest pole; s

_PATHS: MutableMapping[FixedPath, dict[tuple[tuple[str, ...], bool], StateSpace]] = WeakKeyDictionary()


@dataclass(frozen=True)
class TimeResponse:
    """The response of a closed loop at `time_s` (n,), the input beginning at 0.

    `attitude_rad` and `rate_radps` are the law's measured angle and mean rate. `gimbal_rad` is the gimbal command with
    its disturbance. `alpha_rad` is the angle of attack in a gust, and empty without one. Angles are deviations from the
    operating point, in its plane and with the signs of its model.
    """

    time_s: Array
    attitude_rad: Array
    rate_radps: Array
    gimbal_rad: Array
    alpha_rad: Array
    name: str = ""


def step_response(loop: Loop, of: Stepped = "attitude", duration_s: float | None = None) -> TimeResponse:
    """Return the response to a step of 1 rad: of the commanded attitude, or in the gimbal angle.

    The default duration is four time constants of the slowest pole, from 2 s to 60 s. Raises ValueError for another
    `of`, and for a duration that is not positive.
    """
    if of not in ("attitude", "gimbal"):
        raise ValueError(f"of = {of!r}: allowed are attitude, gimbal")
    system, until_s = closed_loop(loop, wind=False), _duration_s(loop, duration_s)
    column = INPUTS.index("attitude_command_rad" if of == "attitude" else "gimbal_disturbance_rad")
    t = _times(loop, 0.0, until_s, STEPS)
    one = _Source(np.zeros((1, 1)), np.ones(1), np.ones(1))
    out, _ = _driven(loop, system, column, np.zeros(len(system.a)), one, t)
    return _response(t, out, f"step of 1 rad, {of}")


def gust_response(
    loop: Loop, speed_mps: float = 9.0, length_m: float = 300.0, duration_s: float | None = None
) -> TimeResponse:
    """Return the response to a gust of the shape 1 - cos with a peak of `speed_mps` over `length_m` of the path.

    The gust is equal along the whole vehicle. Raises ValueError for an operating point without wind or airspeed, and
    for a length or a duration that is not positive.
    """
    node = loop.fixed.node
    airspeed = node.condition.airspeed_mps
    if not airspeed > 0.0:
        raise ValueError(f"operating point at {node.time_s:g} s: a gust needs an airspeed above 0")
    if not 0.0 < length_m < math.inf:
        raise ValueError(f"length_m = {length_m:g}: allowed is a number above 0")
    system, end_s = closed_loop(loop), length_m / airspeed
    until_s = max(_duration_s(loop, duration_s), 0.0 if duration_s is not None else 2.0 * end_s)
    turn, period = 2.0 * np.pi / end_s, loop.sample_s or 0.0
    ahead = node.instruments.delay_s + 0.5 * period if period else 0.0  # of the wind that acts until the next command
    last_s = min(max(end_s - ahead + period, 0.0), until_s)  # where the last command in the gust has acted
    during = _times(loop, 0.0, last_s, max(math.ceil(STEPS * last_s / until_s), 40))
    after = _times(loop, during[-1], until_s, STEPS)
    swing = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, -turn], [0.0, turn, 0.0]])
    start = np.array([1.0, math.cos(turn * ahead), math.sin(turn * ahead)])
    gust = _Source(swing, start, 0.5 * speed_mps * np.array([1.0, -1.0, 0.0]))
    column, calm = INPUTS.index(WIND), _Source(np.zeros((1, 1)), np.zeros(1), np.ones(1))
    first, x = _driven(loop, system, column, np.zeros(len(system.a)), gust, during)
    rest, _ = _driven(loop, system, column, x, calm, after)
    t, out = np.concatenate([during, after[1:]]), np.concatenate([first, rest[1:]])
    seen = t - 0.5 * period  # in the middle of the sample over which the outputs are means
    wind = np.where((seen >= 0.0) & (seen <= end_s), 0.5 * speed_mps * (1.0 - np.cos(turn * seen)), 0.0)
    return _response(t, out, f"gust of {speed_mps:g} m/s over {length_m:g} m", wind / airspeed, airspeed)


def _times(loop: Loop, first_s: float, last_s: float, steps: int) -> Array:
    """Return equally spaced times: the samples of a sampled loop, else `steps` steps."""
    if loop.sample_s is None:
        return np.asarray(np.linspace(first_s, last_s, steps + 1 if last_s > first_s else 1), float)
    first, last = round(first_s / loop.sample_s), math.floor(last_s / loop.sample_s + 1e-9)
    return np.asarray(np.arange(first, last + 1) * loop.sample_s, float)


def _duration_s(loop: Loop, given_s: float | None) -> float:
    if given_s is not None:
        if not 0.0 < given_s < math.inf:
            raise ValueError(f"duration_s = {given_s:g}: allowed is a number above 0")
        return float(given_s)
    decays = np.abs(loop.closed_poles().real)
    slowest = float(decays[decays > 1e-3].min(initial=math.inf))
    return min(max(_CONSTANTS / slowest, _SHORTEST_S), _LONGEST_S)


@dataclass(frozen=True)
class _Source:
    """An input that is an output of the autonomous system g' = A g, v = c g, from g = `start`."""

    a: Array
    start: Array
    c: Array


def _driven(loop: Loop, system: StateSpace, column: int, x: Array, source: _Source, t: Array) -> tuple[Array, Array]:
    """Return the outputs (n, outputs) of a system from the state `x`, at equally spaced times, and the last state.

    The input is exact for a continuous system, and constant between samples for a discrete one.
    """
    n, m = len(system.a), len(source.a)
    whole, by_source = np.zeros((n + m, n + m)), np.outer(system.b[:, column], source.c)
    whole[:n, :n], whole[:n, n:], whole[n:, n:] = system.a, by_source, source.a
    scale = np.ones(n + m)
    if loop.sample_s is None:
        balanced, (factors, _) = scipy.linalg.matrix_balance(whole, permute=False, separate=True)
        whole, scale = np.asarray(balanced, float), np.asarray(factors, float)
        step = exponential(whole * (t[1] - t[0])) if len(t) > 1 else np.eye(n + m)
    else:
        step = whole
        step[n:, n:] = exponential(source.a * loop.sample_s)
    states = (np.append(x, source.start) / scale)[None]
    while len(states) < len(t):  # twice as many states with each product
        states = np.concatenate([states, states @ step.T])
        step = step @ step
    states = states[: len(t)] * scale
    out = states[:, :n] @ system.c.T + np.outer(states[:, n:] @ source.c, system.d[:, column])
    return np.asarray(out), states[-1, :n]


def _response(t: Array, out: Array, name: str, wind_rad: Array | None = None, airspeed: float = 1.0) -> TimeResponse:
    attitude, rate, gimbal, *vehicle = out.T
    alpha = np.zeros(0) if wind_rad is None else vehicle[0] / airspeed - wind_rad
    return TimeResponse(t, attitude, rate, gimbal, alpha, name)


def closed_loop(loop: Loop, wind: bool = True) -> StateSpace:
    """Return the closed loop from `INPUTS` to `OUTPUTS`, discrete for a sampled loop.

    Without `wind`, the input of the wind and the last two outputs are absent. Raises ValueError for an operating point
    without a wind input, and for a cut other than the gimbal command.
    """
    if loop.fixed.cut != "gimbal_command":
        raise ValueError(f"cut = {loop.fixed.cut!r}: a loop is closed at the gimbal command only")
    names = tuple(dict.fromkeys((*loop.law.inputs, "angle_rad", "rate_radps")))
    path = _known_path(loop, names, wind)
    law = loop.law_system
    n, m, p = len(path.a), len(law.a), len(names)
    sums = ANGLES[1] in loop.law.inputs  # the integral of the commanded attitude
    size = n + m + sums
    picks = np.array([np.arange(p) == names.index(name) for name in loop.law.inputs], float)
    # measurements of the law: y = C x + D_w v - (commanded angle, and its integral); u = disturbance - law
    y_x, y_in = np.zeros((len(law.inputs), size)), np.zeros((len(law.inputs), 2 + wind))
    y_x[:, :n] = picks @ path.c[:p]
    angle = np.array([float(name == "angle_rad") for name in law.inputs])
    y_in[:, 0] = -angle
    y_in[:, 2:] = picks @ path.d[:p, 1:]
    period = loop.sample_s
    if sums:
        integral = np.array([float(name == ANGLES[1]) for name in law.inputs])
        y_x[:, -1] = -integral
        y_in[:, 0] -= integral * (period or 0.0)
    if path.d[:p, 0].any():
        raise ValueError("the path has a direct feedthrough from the command to a measurement")
    u_x, u_in = -law.d @ y_x, -law.d @ y_in
    u_x[0, n : n + m] -= law.c[0]
    u_in[0, 1] += 1.0
    a, b = np.zeros((size, size)), np.zeros((size, 2 + wind))
    a[:n, :n] = path.a
    a[:n] += path.b[:, :1] @ u_x
    b[:n] = path.b[:, :1] @ u_in
    b[:n, 2:] += path.b[:, 1:]
    a[n : n + m, n : n + m] = law.a
    a[n : n + m] += law.b @ y_x
    b[n : n + m] = law.b @ y_in
    if sums:
        a[-1, -1], b[-1, 0] = (0.0, 1.0) if period is None else (1.0, period)
    rows = [names.index("angle_rad"), names.index("rate_radps")]
    vehicle = list(range(p, len(path.c)))
    c, d = np.zeros((3 + len(vehicle), size)), np.zeros((3 + len(vehicle), 2 + wind))
    c[:2, :n], d[:2, 2:] = path.c[rows], path.d[rows, 1:]
    c[2], d[2] = u_x[0], u_in[0]
    c[3:, :n], d[3:, 2:] = path.c[vehicle], path.d[vehicle, 1:]
    states = (*path.states, *law.states, *(("attitude_command_rads",) * sums))
    return StateSpace(a, b, c, d, states, INPUTS[: 2 + wind], OUTPUTS[: 3 + len(vehicle)])


def _known_path(loop: Loop, names: tuple[str, ...], wind: bool) -> StateSpace:
    """Return `_path` from a cache, since it does not depend on the law."""
    known = _PATHS.setdefault(loop.fixed, {})
    if (names, wind) not in known:
        known[names, wind] = _path(loop, names, wind)
    return known[names, wind]


def _path(loop: Loop, names: tuple[str, ...], wind: bool) -> StateSpace:
    """Return the path from the command and the wind to measurements and, with wind, the vehicle's w and theta."""
    fixed, node = loop.fixed, loop.fixed.node
    if not wind and not isinstance(fixed, ExactFixedPath):
        return fixed.measured(names)
    sensed = ("local_rate_radps", *(name for name, _, _ in fixed.sensors))
    moved = fixed.vehicle.inputs
    plant = node.plant_in_wind() if wind else node.plant
    if wind and "w_mps" not in plant.outputs:
        raise ValueError(f"operating point at {node.time_s:g} s: a gust needs the outputs w_mps and theta_rad")
    vehicle = channels(
        plant, (*sensed, *(("w_mps", "theta_rad") if wind else ())), (*moved, *((WIND,) if wind else ()))
    )
    inputs = ("command_rad", *((WIND,) if wind else ()))
    if not node.actuator.ideal:
        drive = channels(actuators(node.actuators), moved)
        vehicle = chain(_beside(drive, inputs[1:]), vehicle)
    lags = [node.instruments.gyro, *(record for _, record, _ in fixed.sensors)]
    vehicle = chain(vehicle, _parallel([None if lag.ideal else gyro(lag) for lag in lags], 2 * wind))
    timing = node.instruments
    outputs = vehicle.outputs[: len(sensed)]
    if fixed.kind == "sampled":
        named = replace(vehicle, inputs=inputs)
        path = sample(named, timing.sample_s, timing.delay_s).state_space()
        for k, (_, _, samples) in enumerate(fixed.sensors, 1):
            path = delayed(path, k, samples)
    else:
        before, after = _computer(fixed)
        for part in before:
            vehicle = chain(_beside(part, inputs[1:]), vehicle)
        path = chain(vehicle, _parallel([_lagged(after, n, timing.sample_s) for n in _latencies(fixed)], 2 * wind))
    rows = dict(zip(("rate_radps", *sensed[1:]), range(len(outputs)), strict=True))
    return _with_sums(path, rows, names, fixed, 2 * wind)


def _latencies(fixed: FixedPath) -> list[int]:
    return [0, *(samples for _, _, samples in fixed.sensors)]


def _computer(fixed: FixedPath) -> tuple[list[StateSpace], list[StateSpace]]:
    """Return the computer of a continuous path as systems: hold and delay, and the converter."""
    if isinstance(fixed, PadeFixedPath):
        systems = {part.name: part.state_space() for part in fixed.computer}
        return (
            [systems[name] for name in ("hold", "delay") if name in systems],
            [systems["converter"]] if "converter" in systems else [],
        )
    timing = fixed.node.instruments
    before = [average_of_order(ORDER, timing.sample_s)] if timing.sample_s > 0.0 else []
    delays = [delay_of_order(ORDER, timing.delay_s)] if timing.delay_s > 0.0 else []
    return [part.state_space() for part in (*before, *delays)], [part.state_space() for part in before]


def _lagged(after: list[StateSpace], samples: int, sample_s: float) -> StateSpace | None:
    parts = [*after, *([delay_of_order(ORDER, samples * sample_s).state_space()] if samples else [])]
    return chain(*parts) if parts else None


def delay_of_order(order: int, tau_s: float) -> Rational:
    """Return the Padé approximant [order/order] of e^-x with x = tau s."""
    below = [math.comb(order, k) * math.factorial(2 * order - k) / math.factorial(2 * order) for k in range(order + 1)]
    return Rational("delay", tau_s, tuple((-1.0) ** k * v for k, v in enumerate(below)), tuple(below))


def average_of_order(order: int, tau_s: float) -> Rational:
    """Return (1 - e^-x) / x with x = tau s and the approximant [order/order] of e^-x."""
    delay = delay_of_order(order, tau_s)
    above = [b - a for a, b in zip(delay.numerator, delay.denominator, strict=True)]
    return Rational("average", tau_s, (*above[1:], 0.0), delay.denominator)


def _through(count: int) -> StateSpace:
    names = tuple(f"through_{k + 1}" for k in range(count))
    return StateSpace(np.zeros((0, 0)), np.zeros((0, count)), np.zeros((count, 0)), np.eye(count), (), names, names)


def _parallel(parts: list[StateSpace | None], further: int) -> StateSpace:
    """Return systems side by side, with None and `further` channels passed through."""
    each = [part or _through(1) for part in parts] + ([_through(further)] if further else [])
    a, b, c, d = (scipy.linalg.block_diag(*(getattr(one, name) for one in each)) for name in "abcd")
    named = list(enumerate(each, 1))
    states = tuple(f"{name}_{k}" for k, one in named for name in one.states)
    inputs = tuple(f"{name}_{k}" for k, one in named for name in one.inputs)
    outputs = tuple(f"{name}_{k}" for k, one in named for name in one.outputs)
    return StateSpace(a, b, c, d, states, inputs, outputs)


def _beside(part: StateSpace, passed: tuple[str, ...]) -> StateSpace:
    """Return a system of one input with further inputs that pass unchanged."""
    return part if not passed else _parallel([part], len(passed))


def _with_sums(
    path: StateSpace, rows: dict[str, int], names: tuple[str, ...], fixed: FixedPath, vehicle: int
) -> StateSpace:
    """Return a path with the outputs `names`, including integrals as further states, and the last `vehicle` outputs."""
    period = fixed.sample_s
    a, b, states = path.a, path.b, list(path.states)
    found = {name: (path.c[k], path.d[k]) for name, k in rows.items()}

    def add(name: str, c: Array, d: Array) -> None:
        nonlocal a, b, found
        unit = 1.0 if period is None else period
        a = np.block([[a, np.zeros((len(a), 1))], [unit * c[None], np.full((1, 1), 0.0 if period is None else 1.0)]])
        b = np.vstack([b, unit * d[None]])
        states.append(name)
        found = {key: (np.append(row, 0.0), through) for key, (row, through) in found.items()}
        now = 0.0 if period is None else period  # a sum includes the present sample
        found[name] = np.append(now * c, 1.0), now * d

    wanted = set(names)
    if wanted & {*ANGLES, *DRIFTS}:
        add("angle_rad", *found["rate_radps"])
    if wanted & set(DRIFTS):
        (c_a, d_a), (c_t, d_t) = found[ACCELERATION], found["angle_rad"]
        load = fixed.node.axial_load_mps2
        add(DRIFTS[0], c_a - load * c_t, d_a - load * d_t)
    if ANGLES[1] in wanted:
        add(ANGLES[1], *found["angle_rad"])
    if DRIFTS[1] in wanted:
        add(DRIFTS[1], *found[DRIFTS[0]])
    c, d = (np.array([found[name][k] for name in names]) for k in (0, 1))
    if vehicle:
        last = np.hstack([path.c[-vehicle:], np.zeros((vehicle, len(a) - len(path.a)))])
        c, d = np.vstack([c, last]), np.vstack([d, path.d[-vehicle:]])
    outputs = (*names, *OUTPUTS[3 : 3 + vehicle])
    return StateSpace(a, b, c, d, tuple(states), path.inputs, outputs)
