"""The result of the optimiser: the design, every limit at every plant, and a certificate."""

from __future__ import annotations

import math
from collections import defaultdict
from dataclasses import dataclass
from typing import Literal

import numpy as np

from maxq.control.kernel.records import Array
from maxq.design.case.schema import Case
from maxq.design.laws.freedom import in_units, is_logarithmic, kind_of
from maxq.design.laws.law import DesignedLaw
from maxq.design.model.operating_point import OperatingPoint
from maxq.design.optimise.features import FeatureKind
from maxq.design.optimise.plants import Plants
from maxq.design.optimise.problem import NO_ROW_DB, Problem, ProblemAtPoint
from maxq.design.optimise.search import BestPoint

Status = Literal["optimal", "infeasible", "interrupted"]
ACTIVE_DB = 1e-4
MET_DB = 1e-6  # largest violation that counts as met
EITHER_WAY = ("gain margin", "phase margin")
"""The limits whose values have a sign for the side of -1."""


@dataclass(frozen=True)
class Constraint:
    """The worst case of one limit at one plant, or of the law itself if `plant` is None.

    `value` and `limit` are in `unit`. A positive `excess_db` is a violation. `multiplier` is the change of the
    objective in dB per dB by which the limit is moved. For an infeasible design, it is the limit's share in the
    conflict.
    """

    what: str
    plant: str | None
    time_s: float | None
    dispersed: bool
    frequency_hz: float | None
    value: float
    limit: float | None
    unit: str
    excess_db: float
    active: bool
    multiplier: float
    objective: bool = False  # a part of the objective, not a limit


@dataclass(frozen=True)
class Sensitivity:
    """The change of the worst value of a quantity with each variable.

    `value` is in `unit`. `by` contains the change of the value by the name of the variable. The changes apply to +1 %
    of a frequency or gain, or +0.01 of a damping ratio or weight. They are in deg for a quantity in deg, and in dB (12
    %) for others.
    """

    what: str
    plant: str | None
    time_s: float | None
    value: float
    unit: str
    by: dict[str, float]

    @property
    def changes_in(self) -> str:
        """Return the unit of the changes."""
        return "deg" if self.unit == "deg" else "dB"


@dataclass(frozen=True)
class ActiveBound:
    """A variable at its bound `value` (Hz, ratio or gain).

    `multiplier` is the improvement in dB if the bound is moved by one unit (of ln Hz, ln gain, damping ratio or
    weight). The improvement is that of the objective, or of the violation of an infeasible design.
    """

    variable: str
    side: Literal["lower", "upper"]
    value: float
    multiplier: float

    @property
    def _unit(self) -> tuple[float, str]:
        """Return the change of the variable to which `price_db` refers, and its name."""
        return (math.log(2.0), "octave") if is_logarithmic(self.variable) else (0.1, "0.1")

    @property
    def price_db(self) -> float:
        """Return the improvement in dB if the bound is moved by an octave (frequencies, gains) or by 0.1 (others)."""
        return self._unit[0] * self.multiplier

    @property
    def text(self) -> str:
        """Return the bound and its price as text."""
        unit = " Hz" if kind_of(self.variable).endswith("_hz") else ""
        what = f"{self.variable} at its {self.side} bound {self.value:.4g}{unit}"
        return f"{what} ({self.price_db:.2g} dB per {self._unit[1]})"


@dataclass(frozen=True)
class Trial:
    """A short search from the best effort of an infeasible case, with one change.

    A trial reports only the violation that it reached. `settings` is the change as keys of the case or of the vehicle.
    `missing_db` is the least violation reached, or 0 if all limits are met. `problem` is the reason why a change could
    not be tried.
    """

    change: str
    settings: tuple[str, ...]
    missing_db: float
    unstable: int  # unstable closed-loop poles
    evaluations: int
    interrupted: bool = False
    problem: str = ""

    @property
    def text(self) -> str:
        """Return the change and the violation reached as text."""
        if self.problem:
            return f"{self.change}: not tried, {self.problem}"
        reached = "meets all limits" if self.missing_db <= MET_DB else f"reached {self.missing_db:.3g} dB missing"
        reached = "reached no stable design" if self.unstable > 0 else reached
        return f"{self.change}: {reached}{' (interrupted)' if self.interrupted else ''}"


@dataclass(frozen=True)
class Certificate:
    """The evidence for the optimum: `near_best` of `starts` ended within 0.05 dB of it.

    `kkt_residual` is defined in `Optimality`. `stable` is derived from the poles of the closed loops, not from the
    argument principle that the optimiser uses.
    """

    starts: int
    near_best: int
    ends_db: tuple[float, ...]
    kkt_residual: float
    evaluations: int
    seconds: float
    seed: int
    stable: bool
    plants: int  # plants of the problem
    searched: int = 0  # further dispersed plants in the search for the worst
    worst_found_db: float = 0.0  # excess of the worst of them over the objective or a limit; nan without a search
    instants: int = 0  # instants at which this design was compared with its worst node
    worst_instant_db: float = 0.0  # excess of the worst instant over the worst node
    leaps: int = 0  # random steps from the best end, each followed by a descent
    leaps_back: int = 0  # number of them that ended within 0.05 dB of the best

    def statement(self) -> str:
        """Return the evidence for the optimum as text."""
        text = f"{self.near_best} of {self.starts} starts"
        if self.leaps > 0:
            text += f" and {self.leaps_back} of {self.leaps} perturbations of the best"
        return f"{text} ended within 0.05 dB of it"


@dataclass(frozen=True)
class Solution:
    """A design for a case.

    `objective_db` is the minimised objective of the case (`criteria.OBJECTIVES`) over all plants, the sum of
    `levels_db`.
    """

    case: Case
    status: Status
    levels_db: Array  # of each term of the objective
    violation_db: float
    law: DesignedLaw
    constraints: tuple[Constraint, ...]
    bounds: tuple[ActiveBound, ...]
    certificate: Certificate
    variables: Array
    nominal_objective_db: float  # over the nominal plants alone
    nodes: tuple[OperatingPoint, ...]  # of the nominal plants
    stable_without: tuple[str, ...] = ()  # if no design is stable: limits of which each, omitted alone, permits one
    trials: tuple[Trial, ...] = ()  # from an infeasible design
    sensitivities: tuple[Sensitivity, ...] = ()  # of the objective and of each limit, at its worst plant

    @property
    def objective_db(self) -> float:
        return float(self.levels_db.sum())

    @property
    def feasible(self) -> bool:
        """Return True if all limits are met and the loops are stable."""
        return self.status != "infeasible" and self.violation_db <= MET_DB and self.certificate.stable

    @property
    def unchecked(self) -> str:
        """Return the requirements of the case that were not checked, as text, or "" if there are none."""
        found = []
        if self.case.between_nodes == "hold" and self.certificate.instants == 0:
            found.append("the instants between them were not checked")
        if self.case.robust is not None and math.isnan(self.certificate.worst_found_db):
            found.append("the worst dispersed vehicles were not searched")
        return "; ".join(found)

    @property
    def met(self) -> str:
        """Return where a feasible design meets its limits, such as "all limits met at its 11 operating points"."""
        if self.unchecked:
            return f"limits met at the operating points; {self.unchecked}"
        count = len(self.nodes)
        where = "" if self.case.between_nodes == "hold" else f" at its {count} operating point{'s' * (count != 1)}"
        return f"all limits met{where}"

    @property
    def in_the_way(self) -> tuple[Constraint, ...]:
        """Return the limits that conflict in an infeasible design, in decreasing order of their share."""
        if self.feasible:
            return ()
        blamed = [c for c in self.constraints if c.excess_db > MET_DB and c.limit is not None]
        return tuple(sorted(blamed, key=lambda c: (-c.multiplier, -c.excess_db)))

    def explanation(self) -> str:
        """Return a sentence that explains an infeasible design, or "" for a feasible one."""
        if self.feasible:
            return ""
        alone = " or ".join(f"limits.{name}" for name in self.stable_without)
        unstable = f"no stable design was found{f'; without {alone} one is' if alone else ''}"
        if not self.in_the_way:
            return unstable
        parts, by_limit = [], defaultdict(list)
        for c in self.in_the_way:
            by_limit[c.what].append(c)
        for what, missed in by_limit.items():  # each limit once, at its largest share in the conflict
            c, others = missed[0], len(missed) - 1
            where = f" at {c.plant}" if c.plant is not None else ""
            where += f" and {others} more" if others else ""
            value = f"{abs(c.value) if what in EITHER_WAY else c.value:.4g}{' ' + c.unit if c.unit else ''}"
            parts.append(f"{what}{where} ({value}, limit {c.limit:g}: {c.excess_db:.3g} dB)")
        said = f"at best {self.violation_db:.3g} dB are missing; in the way: " + "; ".join(parts)
        if not self.certificate.stable:
            return f"{unstable}; of the limits {said}"
        return f"the limits cannot be met together: {said}"


def make_solution(
    case: Case, plants: Plants, problem: Problem, found: BestPoint, seconds: float, stable: bool
) -> Solution:
    """Return the solution at the best point of a search.

    `seconds` is the duration of the search, and `stable` the result of the check by poles.
    """
    full, names = problem.evaluate(found.best.variables, complete=True), problem.law.names
    status: Status = "interrupted" if found.interrupted else "optimal" if found.feasible and stable else "infeasible"
    peak = full.rows.objective & ~np.array([plants.each[p].dispersed for p in full.rows.plant])
    nominal = sum(
        float(full.rows.excess_db[peak & (full.rows.term == term)].max(initial=NO_ROW_DB))
        for term in range(problem.terms)
    )
    return Solution(
        case=case,
        status=status,
        levels_db=full.levels_db,
        violation_db=full.violation_db,
        law=problem.law.designed(found.best.variables),
        constraints=_constraints(plants, problem, found, full),
        bounds=tuple(
            ActiveBound(names[k], side, in_units(names[k], float(ends[k])), float(at[k]))  # type: ignore[arg-type]  # one of the two literals
            for side, ends, at in (
                ("lower", problem.lower, found.optimality.lower),
                ("upper", problem.upper, found.optimality.upper),
            )
            for k in np.flatnonzero((at > 0.0) & (problem.lower < problem.upper))
        ),
        certificate=Certificate(
            starts=len(found.ends_db),
            near_best=found.near_best,
            ends_db=tuple(float(x) for x in found.ends_db),
            kkt_residual=found.optimality.residual,
            evaluations=found.evaluations,
            seconds=seconds,
            seed=case.search.seed,
            stable=stable,
            plants=len(plants),
            leaps=len(found.leaps_db),
            leaps_back=found.leaps_back,
        ),
        variables=found.best.variables,
        nominal_objective_db=nominal,
        sensitivities=_sensitivities(plants, problem, full),
        nodes=tuple(sorted((p.node for p in plants.each if not p.dispersed), key=lambda node: node.time_s)),
    )


def _constraints(plants: Plants, problem: Problem, found: BestPoint, full: ProblemAtPoint) -> tuple[Constraint, ...]:
    rows, keys, weight = full.rows, full.rows.keys, defaultdict[tuple[bool, int, int], float](float)
    for key, multiplier in zip(found.best.rows.keys, found.optimality.multipliers.tolist(), strict=True):
        weight[key] += multiplier
    worst: dict[tuple[bool, int, int], int] = {}
    for r in np.argsort(-rows.excess_db, kind="stable").tolist():
        worst.setdefault(keys[r], r)
    out = []
    for key, r in sorted(worst.items()):
        _, what, p = key
        kind, plant = problem.kinds[what], plants.each[p] if p >= 0 else None
        # a turn near the cross is an approach and not a margin
        approach = int(rows.feature[r]) in (FeatureKind.GAIN_TURN, FeatureKind.PHASE_TURN)
        active = full.over_db[r] > -ACTIVE_DB
        frequency = float(rows.frequency_hz[r])
        out.append(
            Constraint(
                kind.text + (", approached without a crossing" if approach else ""),
                None if plant is None else plant.node.label,
                None if plant is None else plant.node.time_s,
                False if plant is None else plant.dispersed,
                None if math.isnan(frequency) else frequency,
                float(rows.value[r]),
                None if math.isnan(rows.limit[r]) else float(rows.limit[r]),
                kind.unit,
                float(rows.excess_db[r]),
                bool(active),
                weight[key],
                kind.objective,
            )
        )
    return tuple(out)


def _sensitivities(plants: Plants, problem: Problem, full: ProblemAtPoint) -> tuple[Sensitivity, ...]:
    """Return the change with each variable of the worst row of each kind, the objective first."""
    rows, names, out = full.rows, problem.law.names, list[Sensitivity]()
    step = np.array([math.log(1.01) if is_logarithmic(name) else 0.01 for name in names])
    for what in np.unique(rows.what):
        kind, mine = problem.kinds[what], np.flatnonzero(rows.what == what)
        r = int(mine[np.argmax(rows.excess_db[mine])])
        p = int(rows.plant[r])
        by = full.gradient[r] * step / (kind.weight if kind.objective else 1.0)
        by = by if kind.sense == "<=" else -by
        if kind.unit == "deg":
            cross = problem.cross.of(np.array([max(p, 0)]))
            by = by / float(np.radians(cross.db_per_rad[0]))
        node = plants.each[p].node if p >= 0 else None
        out.append(
            Sensitivity(
                kind.text,
                None if node is None else node.label,
                None if node is None else node.time_s,
                abs(float(rows.value[r])) if kind.text in EITHER_WAY else float(rows.value[r]),
                kind.unit,
                dict(zip(names, by.tolist(), strict=True)),
            )
        )
    return tuple(sorted(out, key=lambda one: one.what not in {k.text for k in problem.kinds if k.objective}))
