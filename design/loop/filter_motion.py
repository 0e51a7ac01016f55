"""The effect of a changing bending filter on a loop, to first order in the rate of change.

The margins at an operating point use the filter of that instant as a constant filter. A filter with changing parameters
has a different response. Its integrators (control/filter_schedule.py) obey x' = A x + b u, y = c x + d u with
time-dependent coefficients. For u = exp(s t), expansion in the rate of change gives

    x = (x0 + x1) exp(s t),    x0 = (s - A)^-1 b,    x1 = -(s - A)^-1 dx0/dt = -(s - A)^-2 (A' x0 + b')

so that the response changes by c x1. L changes by the rest of the loop times c x1. The ratio of this change to |1 + L|
is the share of the distance to the critical point that the motion uses. If the share is below 1, the loop remains
stable by the small-gain theorem, within the validity of the first-order expansion.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np

from maxq.control.filter_schedule import FilterSchedule, filter_of, parameters_of
from maxq.control.filters import BendingFilter
from maxq.control.kernel.records import Array
from maxq.design.laws.bending_filter import laplace_axis
from maxq.design.loop.loop import Loop
from maxq.design.model.operating_point import OperatingPoint
from maxq.design.model.state_space import ComplexArray
from maxq.sim.packing.computer import bending_filter
from maxq.sim.scenario.schema_design import Design

MOST_MOTION = 10.0
"""The largest acceptable change of L, % of |1 + L|. It changes a modulus margin by at most 1 dB."""
_MOVE = 1e-4  # relative step of the parameters for finite differences
_LOWEST_HZ, _POINTS = 0.03, 300
_AROUND = np.linspace(-6.0, 6.0, 13)  # points around a resonance, in half widths


def realisation(filter_: BendingFilter) -> tuple[Array, Array, Array, float]:
    """Return A (n, n), b (n,), c (n,) and d of the integrators of the flown filter cascade, in continuous time."""
    n = 2 * len(filter_.quadratic) + len(filter_.first_order)
    a, b, signal = (
        np.zeros((n, n)),
        np.zeros(n),
        np.zeros(n + 1),
    )  # signal: coefficients of the states, then of the input
    signal[n] = 1.0
    for i, q in enumerate(filter_.quadratic):
        w, r = 2.0 * np.pi * q.pole_hz, q.pole_hz / q.zero_hz
        x1, x2 = np.eye(n + 1)[2 * i], np.eye(n + 1)[2 * i + 1]
        e = signal - 2.0 * q.pole_zeta * x1 - x2
        for row, rate in ((2 * i, w * e), (2 * i + 1, w * x1)):
            a[row], b[row] = rate[:n], rate[n]
        signal = r * r * e + 2.0 * q.zero_zeta * r * x1 + x2
    for row, f in enumerate(filter_.first_order, 2 * len(filter_.quadratic)):
        x, r = np.eye(n + 1)[row], f.pole_hz / f.zero_hz
        rate = 2.0 * np.pi * f.pole_hz * (signal - x)
        a[row], b[row] = rate[:n], rate[n]
        signal = x + r * (signal - x)
    return a, b, signal[:n], float(signal[n])


def change_by_motion(filter_: BendingFilter, rates: Array, s: ComplexArray) -> ComplexArray:
    """Return the change of the filter's response at `s` (points,) due to parameters that change at `rates`, 1/s.

    The order of the rates is that of `parameters_of`.
    """
    parameters, structure = parameters_of(filter_), filter_.structure
    speed = float(np.max(np.abs(rates) / np.maximum(np.abs(parameters), 1e-2), initial=0.0))
    if speed == 0.0:
        return np.zeros(s.shape, np.complex128)
    step = _MOVE / speed
    (a_0, b_0, *_), (a_1, b_1, *_) = (
        realisation(filter_of(parameters + k * step * rates, *structure)) for k in (-1.0, 1.0)
    )
    a, b, c, _ = realisation(filter_)
    resolvent = np.linalg.inv(s[:, None, None] * np.eye(len(b)) - a)
    x0 = resolvent @ b[:, None]
    x1 = -resolvent @ (resolvent @ ((a_1 - a_0) @ x0 + (b_1 - b_0)[:, None])) / (2.0 * step)
    return np.asarray(x1[:, :, 0] @ c)


def motion_shares(loops: Sequence[Loop], design: Design) -> list[float]:
    """Return `motion_share` of each loop of a stage in one plane, %, or an empty list for a constant filter.

    `design` is the design of the stage.
    """
    flown = bending_filter(design)
    if not flown.moves:
        return []
    near = moves_near(flown, [loop.fixed.node for loop in loops], design.gains.over)
    return [
        motion_share(loop, flown, moves, design.filter.prewarp_hz) for loop, (_, moves) in zip(loops, near, strict=True)
    ]


def motion_share(
    loop: Loop, schedule: FilterSchedule, moves: Sequence[tuple[float, Array]], prewarp_hz: float | None
) -> float:
    """Return the largest change of L due to the motion of its filter over all frequencies, in % of |1 + L|.

    `moves` are values of the scheduling quantity, each with the rates of the filter parameters there, 1/s. L is
    evaluated with the filter at each of these values and the other properties of the operating point.
    """
    highest_hz = 0.999 * loop.highest_hz if np.isfinite(loop.highest_hz) else 100.0
    near = [r.frequency_hz + r.half_width_hz * _AROUND for r in loop.fixed.resonances()]
    hz = np.unique(np.concatenate([np.geomspace(_LOWEST_HZ, highest_hz, _POINTS), *near]))
    hz = hz[(hz >= _LOWEST_HZ) & (hz <= highest_hz)]
    law: Any = loop.law
    rest = replace(loop, law=replace(law, filter=None)).response(hz)
    s, worst = laplace_axis(np.log(hz), loop.sample_s, prewarp_hz)[0], 0.0
    for at, rates in moves:
        form = schedule(at)
        whole = 1.0 + rest * form.frequency_response(s / 1j)
        worst = max(worst, float(np.max(np.abs(rest * change_by_motion(form, rates, s)) / np.abs(whole))))
    return 100.0 * worst


def moves_near(
    schedule: FilterSchedule, where: Sequence[OperatingPoint], over: Any
) -> Iterator[tuple[OperatingPoint, list[tuple[float, Array]]]]:
    """Yield each operating point of a stage with the motions of its filter between the neighbouring operating points.

    A motion is a value of the scheduling quantity and the rates of the filter parameters, 1/s. The values are those of
    the operating point and of the schedule's points, with the rates on both sides of each. The first and the last
    operating point also represent the schedule before and after them. The rate of the scheduling quantity follows from
    its change between operating points; for time it is 1 s/s.
    """
    time_s, first = np.unique([node.time_s for node in where], return_index=True)
    x = np.array([where[k].scheduled(over) for k in first])
    rates = np.abs(np.diff(x) / np.diff(time_s)) if over != "time_s" else np.ones(len(x) - 1)
    for node in where:
        k = int(np.searchsorted(time_s, node.time_s))
        near = x[max(k - 1, 0) : k + 2]
        low, high = float(near.min()), float(near.max())
        rising = len(x) < 2 or x[-1] > x[0]
        if k == 0 or k == len(x) - 1:
            if (k == 0) == rising or len(x) == 1:
                low = -np.inf
            if (k == 0) != rising or len(x) == 1:
                high = np.inf
        rate = float(rates[max(k - 1, 0) : k + 1].max()) if len(rates) else 1.0 if over == "time_s" else np.nan
        moves = []
        for begin, end in pairwise(schedule.at):
            slope = schedule.slope(0.5 * (begin + end)) * rate
            here = [float(x[k])] if begin <= x[k] <= end else []
            moves += [(at, slope) for at in (*here, *(at for at in (begin, end) if low < at < high))]
        yield node, moves
