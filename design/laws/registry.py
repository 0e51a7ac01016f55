"""The registry of all control laws, by the name in a design or a case. A new law adds an entry to `LAWS`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from maxq.design.laws.drift import DriftVariables, PidDriftVariables
from maxq.design.laws.law import DesignedLaw, LawVariables
from maxq.design.laws.load_relief import IncidenceReliefVariables, LoadReliefVariables
from maxq.design.laws.own import OwnDesign, OwnVariables
from maxq.design.laws.pd import PdDesign
from maxq.design.laws.pd_variables import PdVariables
from maxq.design.laws.pid import PidVariables
from maxq.design.laws.task import Task
from maxq.sim.scenario.schema_design import Design


@dataclass(frozen=True)
class LawKind:
    """The functions and inputs of a law.

    `variables` returns the variables of a task, optionally with the results of another instance of the same case
    (`PdVariables`). `of_design` reads the law from a design file. `frozen` returns the design with its gains frozen at
    a value of the scheduling quantity (`DesignedLaw.at`). `inputs` are all measurements that the law may use.
    """

    variables: Callable[[Task, Any], LawVariables]
    inputs: tuple[str, ...] = PdVariables.inputs
    of_design: Callable[[Design], DesignedLaw] = PdDesign.of
    frozen: Callable[[Design, float], Design] = PdDesign.frozen


LAWS: dict[str, LawKind] = {
    "pd": LawKind(PdVariables),
    "pid": LawKind(PidVariables, PidVariables.inputs),
    "load-relief": LawKind(LoadReliefVariables, LoadReliefVariables.inputs),
    "drift": LawKind(DriftVariables, DriftVariables.inputs),
    "pid-drift": LawKind(PidDriftVariables, PidDriftVariables.inputs),
    "incidence-relief": LawKind(IncidenceReliefVariables, IncidenceReliefVariables.inputs),
    "own": LawKind(OwnVariables, of_design=OwnDesign.of),
}


def designed_law(design: Design) -> DesignedLaw:
    """Return the law of a design. Raises ValueError if its name is not in `LAWS`."""
    return law_kind(design.law).of_design(design)


def law_kind(name: str) -> LawKind:
    """Return the registry entry of a law. Raises ValueError if its name is not in `LAWS`."""
    if name not in LAWS:
        raise ValueError(f"law = {name!r}: allowed is {', '.join(LAWS)}")
    return LAWS[name]
