"""Where the optimiser starts: other optima, filters as an engineer would draw them, a low-discrepancy sequence."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
from scipy.stats import qmc

from maxq.control.filters import BendingFilter, FirstOrderSection, QuadraticSection
from maxq.control.kernel.records import Array
from maxq.design.optimise.problem import Problem
from maxq.design.optimise.setup import Form, least_gains

Pair = tuple[float, float]

SPAN = 2.0  # random frequencies lie within this factor squared around the first mode
GAIN_FACTOR = 1.02


def start_gains(problem: Problem) -> Array:
    """The gain variables a little above the least that meet the limits; those of (47) and (48) as printed."""
    gains = problem.loops.gains
    if gains.size == 0:
        return np.zeros(0)
    limits = problem.limits
    hz = float(np.nanmax(np.append(limits.rigid_hz, 0.1)))
    zeta = float(np.nanmax(np.append(limits.rigid_zeta, 0.3)))
    return np.log(GAIN_FACTOR * least_gains(problem.rigid, gains.weights, hz, zeta, "paper")).ravel()


def drawn(problem: Problem, form: Form, mode_hz: float) -> Iterator[Array]:
    """Notches at the first mode, with poles below it and lead or lag round it: what optima have come to look like."""
    lead, lag, mild, roll_off = (0.5, 5.0), (0.3, 0.22), (4.0, 2.0), (1.2, 20.0)
    notch, shelf = (1.0, 0.1, 0.5, 0.3), (0.65, 0.7, 0.5, 0.3)
    layouts: tuple[tuple[tuple[tuple[float, ...], ...], tuple[tuple[float, float], ...]], ...] = (
        # zero, zeta, pole, zeta of the quadratic sections, zero, pole of the first-order ones; relative to the mode
        ((notch, notch), (lead, lag)),
        ((notch, shelf), (lead, mild)),
        ((notch, notch), (roll_off, lag)),
        (((1.0, 0.12, 0.45, 0.35), (0.95, 1.1, 2.0, 1.0)), (mild, mild)),
        (((1.0, 0.2, 0.65, 0.3), (2.5, 0.4, 2.0, 0.7)), (lead, lead)),
    )
    seen: set[tuple[object, ...]] = set()
    for quadratic, first_order in layouts:
        q = [*quadratic, *[(2.0 + k, 0.7, 2.0 + k, 0.7) for k in range(form.quadratic)]][: form.quadratic]
        f = [*first_order, *[(4.0 + k, 4.0 + k) for k in range(form.first_order)]][: form.first_order]
        if (*q, *f) not in seen:
            seen.add((*q, *f))
            yield _from(
                problem,
                BendingFilter(
                    tuple(QuadraticSection(z * mode_hz, a, p * mode_hz, b) for z, a, p, b in q),
                    tuple(FirstOrderSection(z * mode_hz, p * mode_hz) for z, p in f),
                ),
            )


def _from(problem: Problem, filter_: BendingFilter) -> Array:
    whole = np.concatenate([problem.loops.filter.variables(filter_), start_gains(problem)])
    return np.asarray(np.clip(whole, problem.lower, problem.upper))


def random(problem: Problem, form: Form, mode_hz: float, count: int, seed: int) -> Array:
    """(count, variables): Sobol points, every fourth in the bounds, the others as `_like_a_notch`."""
    n = problem.loops.filter.size
    if count == 0:
        return np.zeros((0, problem.size))
    everywhere, likely = _everywhere(problem, mode_hz), _like_a_notch(form, mode_hz)
    points = qmc.Sobol(n, seed=seed).random_base2(max(1, math.ceil(math.log2(count))))[:count]
    low, high = (np.where((np.arange(count) % 4 == 3)[:, None], everywhere[i], likely[i]) for i in (0, 1))
    filters = np.clip(low + points * (high - low), problem.lower[:n], problem.upper[:n])
    return np.hstack([filters, np.tile(start_gains(problem), (count, 1))])


def _everywhere(problem: Problem, mode_hz: float) -> tuple[Array, Array]:
    """The bounds, but for frequencies that are farther than SPAN squared from the mode."""
    n = problem.loops.filter.size
    low, high = problem.lower[:n].copy(), problem.upper[:n].copy()
    frequency = np.array([name.endswith("_hz") for name in problem.loops.filter.names], bool)
    centre, reach = math.log(mode_hz), 2.0 * math.log(SPAN)
    low[frequency] = np.clip(centre - reach, low[frequency], high[frequency])
    high[frequency] = np.clip(centre + reach, low[frequency], high[frequency])
    return low, high


def _like_a_notch(form: Form, mode_hz: float) -> tuple[Array, Array]:
    """A first section that is a notch at the mode with poles below it; the others lead, lag or notch anywhere.

    With gains linear in time, every second such start ends in the best valley of F3 to F5, every tenth of the whole
    bounds.
    """

    def ranges(zero: Pair, zero_zeta: Pair, pole: Pair, pole_zeta: Pair) -> list[Pair]:
        hz = [tuple(math.log(x * mode_hz) for x in pair) for pair in (zero, pole)]
        return [(hz[0][0], hz[0][1]), zero_zeta, (hz[1][0], hz[1][1]), pole_zeta]

    notch = ranges((0.9, 1.1), (0.1, 0.3), (0.4, 0.8), (0.3, 0.6))
    other = ranges((0.5, 3.0), (0.1, 0.8), (0.35, 3.0), (0.3, 1.0))
    first_order = (math.log(0.2 * mode_hz), math.log(8.0 * mode_hz))
    sections = [*notch, *other * form.quadratic][: 4 * form.quadratic]
    low, high = np.array([*sections, *[first_order, first_order] * form.first_order]).T
    return low, high


def lifted(filter_: BendingFilter, form: Form, mode_hz: float) -> BendingFilter | None:
    """The same response from a filter of `form`: cancelling pairs are added; None where that is not enough.

    A first-order section that has no place becomes a quadratic one with a cancelling pair of its own.
    """
    quadratic, first_order = list(filter_.quadratic), list(filter_.first_order)
    while len(first_order) > form.first_order and len(quadratic) < form.quadratic:
        f = first_order.pop()
        pair = math.sqrt(f.zero_hz * f.pole_hz)
        zero, pole = math.sqrt(f.zero_hz * pair), math.sqrt(f.pole_hz * pair)
        quadratic.append(QuadraticSection(zero, 0.5 * (f.zero_hz + pair) / zero, pole, 0.5 * (f.pole_hz + pair) / pole))
    while len(quadratic) < form.quadratic:
        quadratic.append(QuadraticSection(2.0 * mode_hz, 0.7, 2.0 * mode_hz, 0.7))
    while len(first_order) < form.first_order:
        first_order.append(FirstOrderSection(2.0 * mode_hz, 2.0 * mode_hz))
    if (len(quadratic), len(first_order)) != (form.quadratic, form.first_order):
        return None
    return BendingFilter(tuple(quadratic), tuple(first_order))


def from_design(problem: Problem, filter_: BendingFilter, nodes_s: Array, k_p: Array, k_d: Array) -> Array:
    """The variables of a design, its gains interpolated at this problem's gain nodes."""
    gains = problem.loops.gains
    values = [np.log(np.interp(gains.nodes_s, nodes_s, k)) for k in (k_p, k_d)] if gains.size > 0 else []
    whole = np.concatenate([problem.loops.filter.variables(filter_), *values])
    return np.asarray(np.clip(whole, problem.lower, problem.upper))
