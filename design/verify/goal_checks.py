"""The assessment of a case's hard goals on the loops of a design, independent of the optimiser.

Templates are assessed on a dense grid of frequencies with refined extremes, step responses by simulation of the closed
loop in state space, and functions at their frequencies.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from itertools import pairwise

import numpy as np

from maxq.control.kernel.records import Array
from maxq.design.case.goals import TRANSFERS, GoalSection
from maxq.design.laws.task import DB
from maxq.design.loop.loop import Loop
from maxq.design.loop.own_part import NEAREST_NYQUIST
from maxq.design.loop.time_response import Stepped, step_response
from maxq.design.margins.measured_loop import LoopAtPoint
from maxq.design.margins.solving import vertex
from maxq.design.quantities import STEPS, Convention

PER_SEGMENT = 800  # frequencies of a template's segment, in addition to those around resonances
FUNCTION_POINTS = 400


def transfers(loop: Loop, frequencies_hz: Array) -> dict[str, Array]:
    """Return |S|, |T|, |KS| and |L| of a loop in dB, each in the shape of the frequencies."""
    value, law = loop.response(frequencies_hz), loop.controller(frequencies_hz)
    s = -DB * np.log(np.abs(1.0 + value))
    gain = DB * np.log(np.abs(value))
    return {"S": s, "T": gain + s, "KS": DB * np.log(np.abs(law)) + s, "L": gain}


def over_template_db(loop: Loop, goal: GoalSection) -> float:
    """Return the largest excess of a loop over an upper template, or below a lower one, dB.

    The excess is -inf if the template has no frequency below the Nyquist frequency.
    """
    points, sign = goal.template
    x, db = np.log([hz for hz, _ in points]), np.array([level for _, level in points])
    top = math.log(min(NEAREST_NYQUIST * loop.highest_hz, math.exp(x[-1])))
    grid = [np.linspace(a, b, PER_SEGMENT) for a, b in pairwise(x)]
    spread = np.sinh(np.linspace(-4.0, 4.0, 81))
    for r in loop.fixed.resonances():
        around = r.centre_hz + r.half_width_hz * spread
        grid.append(np.log(around[around > 0.0]))
    at = np.unique(np.concatenate(grid))
    at = at[(at >= x[0]) & (at <= top)]
    if not len(at):
        return -math.inf
    value = sign * (transfers(loop, np.exp(at))[goal.quantity] - np.interp(at, x, db))
    best, k = float(value.max()), np.arange(1, len(at) - 1)
    k = k[(value[k] >= value[k - 1]) & (value[k] >= value[k + 1])]
    if len(k):
        around = k + np.arange(-1, 2)[:, None]
        with np.errstate(divide="ignore", invalid="ignore"):
            where, _ = vertex(*at[around], *value[around])
        where = where[np.isfinite(where) & (where > x[0]) & (where < top)]
        refined = sign * (transfers(loop, np.exp(where))[goal.quantity] - np.interp(where, x, db))
        best = max(best, float(refined.max(initial=-math.inf)))
    return best


_OF_STEP: dict[str, tuple[Stepped, str, Callable[[Array], Array]]] = {
    "overshoot_pct": ("attitude", "attitude_rad", lambda y: 100.0 * (y - 1.0)),
    "settling_pct": ("attitude", "attitude_rad", lambda y: 100.0 * np.abs(y - 1.0)),
    "gimbal_peak": ("attitude", "gimbal_rad", np.abs),
    "offset_peak": ("gimbal", "attitude_rad", np.abs),
}
"""The step, the output, and the measure of each quantity of a step response."""


def step_samples(loop: Loop, goal: GoalSection) -> Array:
    """Return the measure of a step response at each sample until `goal.until_s`, (n,).

    Raises ValueError for a continuous loop.
    """
    if loop.sample_s is None:
        raise ValueError("a step response needs the sampled loop: allowed is the kind sampled")
    stepped, output, measure = _OF_STEP[goal.quantity]
    duration_s = math.ceil(goal.until_s / loop.sample_s - 1e-9) * loop.sample_s
    return measure(getattr(step_response(loop, stepped, duration_s), output))


def goal_value(one: LoopAtPoint, goal: GoalSection) -> float:
    """Return the value of a goal on a loop; for a template, the largest excess over it, dB. NaN if it is unstable."""
    if not one.margins.stable:
        return math.nan
    loop = one.loop
    if goal.quantity in TRANSFERS:
        return over_template_db(loop, goal)
    if goal.quantity in STEPS:
        samples = step_samples(loop, goal)
        return float(samples[math.ceil((goal.after_s or 0.0) / (loop.sample_s or 1.0) - 1e-9) :].max())
    if goal.quantity == "function":
        top = min(goal.band_hz[1], NEAREST_NYQUIST * loop.highest_hz)
        hz = np.geomspace(goal.band_hz[0], top, FUNCTION_POINTS)
        value = loop.response(hz)
        from maxq.design.optimise.response_goals import LoopValues, function_of  # noqa: PLC0415  # lazy: few designs need it

        return float(np.real(function_of(goal.function or "")(LoopValues(one.time_s, hz, value.real, value.imag))))
    assert goal.about.value is not None
    return goal.about.value(one, Convention())


def goal_limit(goal: GoalSection) -> float:
    """Return the limit of the values of `goal_value`."""
    return 0.0 if goal.quantity in TRANSFERS else goal.limit or 0.0


def hard_goals(goals: Sequence[GoalSection], dispersed: bool = False) -> list[GoalSection]:
    """Return the goals that are limits, or those that also apply to dispersed plants."""
    return [one for one in goals if one.hard and (one.dispersed or not dispersed)]
