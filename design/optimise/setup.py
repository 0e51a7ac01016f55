"""From a case and its plants to the optimiser's problem."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import linprog

from maxq.control.kernel.records import Array
from maxq.design.case.schema import Case
from maxq.design.optimise.filter_variables import FilterVariables
from maxq.design.optimise.gain_variables import GainVariables, interpolation_weights
from maxq.design.optimise.limits import CommonLimits
from maxq.design.optimise.loops import Loops
from maxq.design.optimise.plants import Plants, limits_of
from maxq.design.optimise.problem import Problem, Rigid

LEAST_GAIN, LARGEST_GAIN = 1e-4, 1e3  # bounds of the gains (49): ln k needs some


@dataclass(frozen=True)
class Form:
    """What the variables of a problem are: numbers of filter sections and kind of gain schedule."""

    quadratic: int
    first_order: int
    schedule: str

    @property
    def order(self) -> int:
        return 2 * self.quadratic + self.first_order


def form_of(case: Case) -> Form:
    return Form(*case.filter.sections, case.gains.schedule)


def gain_nodes(case: Case, schedule: str) -> Array:
    """Vehicle times of the gain table."""
    if schedule == "nodes":
        return np.array(case.gains.nodes_s, float)
    times = np.array(case.nodes_s, float)
    if schedule == "free" or len(times) == 1:
        return times
    return times[[0, -1]]


def prewarp_hz(case: Case, plants: Plants) -> float:
    """Where the discrete filter equals the continuous one."""
    if case.filter.prewarp_hz is not None:
        return case.filter.prewarp_hz
    return round(plants.first_mode_hz, 1)


def make_problem(case: Case, plants: Plants, form: Form, fixed: Array | None = None) -> Problem:
    """The problem of a case with some form of filter and gains.

    The gains of a two-phase design are those of the nominal plants, or `fixed` (2, nodes).
    """
    filter_ = FilterVariables(form.quadratic, form.first_order)
    nodes = gain_nodes(case, form.schedule)
    weights = interpolation_weights(plants.times_s, nodes)
    nominal, dispersed = limits_of(case.limits), None
    if form.schedule == "two-phase":
        if fixed is None:
            own = [k for k, p in enumerate(plants.each) if not p.dispersed]
            rigid = Rigid(plants.rigid.m_delta[own], plants.rigid.m_alpha[own], plants.rigid.m_q[own])
            hz, zeta = case.reference.rigid_hz, case.reference.rigid_zeta
            fixed = least_gains(rigid, weights[own], hz, zeta, case.limits.rigid_body)
        nominal = replace(nominal, rigid_hz=case.reference.rigid_hz, rigid_zeta=case.reference.rigid_zeta)
    if case.robust is not None:
        dispersed = limits_of(case.robust.limits)
    limits = [dispersed if p.dispersed and dispersed is not None else nominal for p in plants.each]
    gains = GainVariables(nodes, weights, fixed)
    lower, upper = bounds(case, form, gains)
    common = CommonLimits(
        case.limits.zone,
        None if "filter_gain_at_infinity" in case.limits.without else case.limits.filter_gain_at_infinity,
        case.limits.rigid_body,
    )
    sampled = plants.sample_s is not None
    loops = Loops(
        plants.curves,
        plants.unstable_open,
        filter_,
        gains,
        plants.sample_s,
        prewarp_hz(case, plants) if sampled else None,
    )
    least_margin = case.objective.kind == "least-margin"
    return Problem(loops, plants.bands, plants.rigid, limits, common, lower, upper, least_margin)


def bounds(case: Case, form: Form, gains: GainVariables) -> tuple[Array, Array]:
    """(49) and (50) in the optimiser's variables."""
    b = case.filter.bounds
    ends = []
    for i in (0, 1):
        quadratic = [math.log(b.zero_hz[i]), b.zero_zeta[i], math.log(b.pole_hz[i]), b.pole_zeta[i]]
        first_order = [math.log(b.first_order_zero_hz[i]), math.log(b.first_order_pole_hz[i])]
        gain = math.log((LEAST_GAIN, LARGEST_GAIN)[i])
        ends.append(np.array(quadratic * form.quadratic + first_order * form.first_order + [gain] * gains.size))
    return ends[0], ends[1]


def least_gains(rigid: Rigid, weights: Array, rigid_hz: float, rigid_zeta: float, body: str) -> Array:
    """(2, nodes): the least k_p, then the least k_d, at all plants in sum, that meet (47) and (48).

    Phase 1 of the paper's two-phase design (5.1). k_d suffices for the damping ratio with the k_p in force, not just
    with the least one.
    """
    full = body == "aerodynamic"
    omega = 2.0 * math.pi * rigid_hz
    floor = np.maximum((omega**2 + (rigid.m_alpha if full else 0.0)) / rigid.m_delta, LEAST_GAIN)
    k_p = _lowest_above(weights, floor)
    actual = np.sqrt(rigid.m_delta * (weights @ k_p) - (rigid.m_alpha if full else 0.0))
    floor = np.maximum((2.0 * rigid_zeta * actual + (rigid.m_q if full else 0.0)) / rigid.m_delta, LEAST_GAIN)
    return np.array([k_p, _lowest_above(weights, floor)])


def _lowest_above(weights: Array, floor: Array) -> Array:
    """Values at the nodes of the lowest schedule, in sum over the plants, that is nowhere below `floor`."""
    found = linprog(
        weights.sum(axis=0), A_ub=-weights, b_ub=-floor, bounds=(LEAST_GAIN, LARGEST_GAIN), method="highs-ds"
    )
    if found.x is None:
        raise ValueError(f"no gain schedule meets the reference's rigid-body limits: {found.message}")
    # off the limit by a rounding error, on the safe side
    return np.asarray(found.x) * (1.0 + 1e-12)
