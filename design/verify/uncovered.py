"""The intervals of a flight without operating points, which the report of a design lists.

Under thrust, these are the times before the first operating point of a stage and after its last, and stages without any
operating points. The authority of the gimbals is reported if `LONG_TAIL_S` or more of a tail-off is not covered.

Without thrust, these are the coasts in which the airframe is unstable. No gimbal can control it there, and a
disturbance grows by exp(integral of sqrt(M_alpha) dt), where M_alpha is the moment derivative of the rigid body along
the flight. Aerodynamic damping is neglected.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from maxq.design.model.instruments import Plane
from maxq.design.model.node import node_of
from maxq.design.model.node_times import FULL, LONG_TAIL_S, TRIMMED_DEG, flies_to, full_thrust, thrust_share, trims
from maxq.design.model.powered import Span, flown_run, powered_flight
from maxq.sim.scenario.loader import LoadedScenario
from maxq.sim.vehicle.engine.burn import stage_burns

BETWEEN = "between the operating points, where no limit was checked"
BRIEF_S = 1e-6  # shorter intervals are not listed
COAST_STEP_S = 0.1  # least step between instants in a coast to the next burn
LAST_STEP_S = 1.0  # step between instants in the coast after the last burnout
MOST_INSTANTS = 300  # largest number of instants in a coast
GROWS = 2.0  # least growth factor of a disturbance for which a coast is listed
TAIL_INSTANTS = 41  # number of instants in a long tail-off
TAIL_OFF = "tail-off, with less than"


@dataclass(frozen=True)
class Uncovered:
    """An interval (s on the vehicle clock) of a stage, from 0, and the reason why it has no operating points."""

    stage: int
    begin_s: float
    end_s: float
    why: str

    @property
    def text(self) -> str:
        """Return the interval as one line of text."""
        return f"{self.begin_s:.4g} to {self.end_s:.4g} s: {self.why}"


def uncovered(
    flight: LoadedScenario,
    points_s: Mapping[int, Sequence[float]],
    plane: Plane = "pitch",
    at_points_only: Collection[int] = (),
) -> tuple[Uncovered, ...]:
    """Return the intervals of a flight, up to its loss, that the operating points of its stages do not cover.

    `points_s` contains the times of the operating points by stage, from 0. `at_points_only` contains the stages that
    were not checked between their operating points.
    """
    spans, loss = powered_flight(flight)
    stages = flight.vehicle.stage
    burns = stage_burns(stages, ())
    found: list[Uncovered] = []
    for span in spans:
        stage, burn = stages[span.stage], burns[span.stage]
        mine = sorted(t for t in points_s.get(span.stage, ()) if span.holds(t))
        full_end_s = full_thrust(stage, burn)[1] + span.idle_s
        share = thrust_share(stage, burn, mine[-1] - span.idle_s) if mine and mine[-1] > full_end_s else FULL
        found += _of_span(span, mine, full_end_s, share)
        if span.stage in at_points_only and len(mine) > 1:
            found.append(Uncovered(span.stage, mine[0], mine[-1], BETWEEN))
    if loss is None:
        found = _with_authority(flight, found, plane)
        found += _unstable_coasts(flight, spans, plane)
    return tuple(sorted(found, key=lambda each: each.begin_s))


def _of_span(span: Span, points_s: Sequence[float], full_end_s: float, share: float) -> list[Uncovered]:
    if not points_s:
        return [Uncovered(span.stage, span.begin_s, span.end_s, "under thrust, no operating point")]
    less = "half" if share == FULL else f"{100.0 * share:.0f} %"
    last_s, tail_s = points_s[-1], min(max(full_end_s, points_s[-1]), span.end_s)
    parts = (
        (span.begin_s, points_s[0], "under thrust, before the first operating point"),
        (last_s, tail_s, "under thrust, after the last operating point"),
        (tail_s, span.end_s, f"{TAIL_OFF} {less} of the largest thrust"),
    )
    return [Uncovered(span.stage, *part) for part in parts if part[1] - part[0] > BRIEF_S]


def _with_authority(flight: LoadedScenario, found: Sequence[Uncovered], plane: Plane) -> list[Uncovered]:
    """Return the intervals, with the gimbal authority added to those of a long tail-off."""
    out, run = list(found), None
    for n, part in sorted(enumerate(found), key=lambda each: each[1].begin_s):
        gimballed = any(engine.gimbal != "fixed" for engine in flight.vehicle.stage[part.stage].engines)
        if not part.why.startswith(TAIL_OFF) or not gimballed or part.end_s - part.begin_s < LONG_TAIL_S:
            continue
        run = flown_run(flight, faults=False) if run is None else run
        held_s, m_delta = part.begin_s, list[float]()
        for time_s in np.linspace(part.begin_s, part.end_s, TAIL_INSTANTS)[:-1].tolist():
            if not flies_to(run, time_s):
                break
            node = node_of(run.packed, run.now_s, part.stage, plane)
            m_delta.append(abs(node.derivatives.m_delta_1ps2))
            if not trims(node):
                break
            held_s = run.now_s
        else:
            held_s = part.end_s
        if m_delta:
            until = "to its end" if held_s == part.end_s else f"to {held_s:.4g} s"
            trimmed = f"the gimbals trim {TRIMMED_DEG:g} deg of angle of attack {until}"
            falls = f"M_delta falls from {m_delta[0]:.3g} to {m_delta[-1]:.3g} 1/s2"
            out[n] = replace(part, why=f"{part.why}; {trimmed} ({falls})")
    return out


def _unstable_coasts(flight: LoadedScenario, spans: Sequence[Span], plane: Plane) -> list[Uncovered]:
    """Return the parts of coasts, up to apogee, in which the airframe is unstable."""
    ends = [(span.end_s, after.begin_s) for span, after in pairwise(spans)]
    coasts = [(a, b) for a, b in ends if b - a > COAST_STEP_S]
    if spans:
        coasts.append((spans[-1].end_s, math.inf))
    run, out = flown_run(flight, faults=False), list[Uncovered]()
    for begin_s, end_s in coasts:
        times_s, m_alpha, stage = list[float](), list[float](), 0
        step_s = LAST_STEP_S if math.isinf(end_s) else max(COAST_STEP_S, (end_s - begin_s) / (MOST_INSTANTS - 1))
        for time_s in (min(begin_s + k * step_s, end_s - BRIEF_S) for k in range(MOST_INSTANTS)):
            if (times_s and time_s <= times_s[-1]) or not flies_to(run, time_s):
                break
            stage = int(run.memory.clock.stage)
            node = node_of(run.packed, run.now_s, stage, plane)
            times_s.append(run.now_s)
            m_alpha.append(node.derivatives.m_alpha_1ps2 if node.condition.airspeed_mps > 0.0 else 0.0)
        out += _unstable_parts(np.array(times_s), np.array(m_alpha), stage)
    return out


def _unstable_parts(times_s: np.ndarray, m_alpha: np.ndarray, stage: int) -> list[Uncovered]:
    """Return the intervals with M_alpha > 0 in which a disturbance grows by a factor of `GROWS` or more."""
    out = []
    edges = np.flatnonzero(np.diff(np.concatenate([[False], m_alpha > 0.0, [False]]).astype(int)))
    for first, after in zip(edges[::2], edges[1::2], strict=True):
        mine, rates = times_s[first:after], np.sqrt(m_alpha[first:after])
        growth = math.exp(float(np.trapezoid(rates, mine)))
        if growth >= GROWS:
            why = (
                f"coast, the airframe is unstable (M_alpha up to {float(rates.max()) ** 2:.3g} 1/s2, a disturbance "
                f"grows {growth:.3g} times) and no gimbal can hold it"
            )
            out.append(Uncovered(stage, float(mine[0]), float(mine[-1]), why))
    return out
