"""The findings of a verification for a review board: inputs, fault cases, deviations by kind, second-tool values.

`check_board` compares the statements of [board] with the inputs, before any flight.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from maxq.design import operating_points
from maxq.design.loop.fixed_path import fixed_path
from maxq.design.loop.loop import Loop, law_at
from maxq.design.quantities import MEASURED, LoopLimits
from maxq.design.verify import linear
from maxq.design.verify.board import SecondToolSection
from maxq.design.verify.flown import CampaignResult, FlownResult
from maxq.design.verify.parts import Parts
from maxq.design.verify.suite import (
    ACCEPTED,
    REJECTED,
    UNDECIDED,
    JudgedRequirement,
    LoadedSuite,
    SuiteFlight,
    room_left,
)
from maxq.design.verify.waivers import FAULTS_NAME, AppliedWaiver, check_waivers
from maxq.sim.campaign.analysis import DataSet, failed_runs
from maxq.sim.campaign.read import LoadedCampaign
from maxq.sim.campaign.statistics import failure_lower, failure_upper
from maxq.sim.flight.metric_table import unit_of
from maxq.sim.input.errors import ScenarioError, suggestion
from maxq.sim.input.files import scenarios_folder, shown
from maxq.sim.input.tables_csv import FILE_KEY
from maxq.sim.scenario.loader import LoadedScenario, told

EPISTEMIC, ALEATORY, UNSAID = "epistemic", "aleatory", "not stated"
THIRDS = ("lowest", "middle", "highest")
_CONFIDENCE = 0.90


@dataclass(frozen=True)
class FaultCase:
    """A flight of the suite with a fault. `probability` is None if the suite does not state it."""

    name: str
    probability: float | None
    met: bool
    counts: bool  # True if a miss rejects the design


@dataclass(frozen=True)
class SecondToolValue:
    """A value from a second tool and the value of maxq, which is NaN if it does not exist."""

    given: SecondToolSection
    own: float
    unit: str

    @property
    def difference(self) -> float:
        return self.own - self.given.value


@dataclass(frozen=True)
class WorstThird:
    """The third of a campaign's runs in which most runs miss a limit, ranked by one epistemic deviation.

    `third` is "none" if no run misses a limit.
    """

    deviation: str
    third: str
    missed: int
    runs: int
    others_missed: int
    others: int

    @property
    def bounds(self) -> tuple[float, float]:
        """Return the 90 % confidence bounds of the probability that a run misses a limit (Clopper and Pearson).

        Each bound holds alone.
        """
        return failure_lower(self.missed, self.runs, _CONFIDENCE), failure_upper(self.missed, self.runs, _CONFIDENCE)


@dataclass(frozen=True)
class CampaignDeviations:
    """The deviations of a campaign by kind, and the worst third of the runs for each epistemic deviation."""

    campaign: str
    kinds: dict[str, tuple[str, ...]]
    worst: tuple[WorstThird, ...] = ()


@dataclass(frozen=True)
class BoardFindings:
    """The findings for a review board. `inputs` are the names of the files that were read."""

    inputs: tuple[str, ...] = ()
    faults: tuple[FaultCase, ...] = ()
    second_tool: tuple[SecondToolValue, ...] = ()
    deviations: tuple[CampaignDeviations, ...] = ()
    waivers: tuple[AppliedWaiver, ...] = ()


def input_name(path: Path) -> str:
    """Return the name of a file: relative to scenarios/ if it is shipped, or else relative to the working folder."""
    root = scenarios_folder()
    return path.relative_to(root).as_posix() if path.is_relative_to(root) else shown(path)


def inputs_of(scenarios: Iterable[LoadedScenario], campaigns: Sequence[LoadedCampaign]) -> tuple[str, ...]:
    """Return the names of all files that were read for scenarios and campaigns."""
    every = (*scenarios, *(campaign.base for campaign in campaigns))
    names = [input_name(file.path) for loaded in every for file in loaded.files]
    return tuple(dict.fromkeys([*names, *(name for c in campaigns for name in _tables(told(c.file)))]))


def _tables(value: Any) -> Iterator[str]:
    """Yield the file names of all tables in a tree of tables and lists."""
    if isinstance(value, dict) and isinstance(name := value.get(FILE_KEY), str):
        yield name
    for item in value.values() if isinstance(value, dict) else value if isinstance(value, list) else ():
        yield from _tables(item)


def check_board(
    loaded: LoadedSuite,
    scenario: LoadedScenario,
    flights: Sequence[LoadedScenario],
    campaigns: Sequence[LoadedCampaign],
) -> None:
    """Raise ScenarioError for a statement about a file, key, flight or vehicle that the verification does not use.

    `loaded` is the suite fitted to the vehicle, and `flights` are the scenarios of its flights.
    """

    def refuse(key: str, problem: str, value: Any, known: Sequence[str]) -> None:
        hint = suggestion(value, known)
        allowed = "" if hint else ", ".join(known) or "none"
        raise ScenarioError(loaded.label, f"{problem}{'; ' + hint if hint else ''}", key, value=value, allowed=allowed)

    suite, board = loaded.suite, loaded.suite.board
    for flight, flown in zip(suite.flight, flights, strict=True):
        if flight.probability is not None and not flown.scenario.fault:
            known = [f.name for f, one in zip(suite.flight, flights, strict=True) if one.scenario.fault]
            refuse("flight.name", "has a probability, but no fault", flight.name, known)
    if board is None:
        return
    if board.vehicle != scenario.vehicle.name:
        refuse("board.vehicle", "is not the vehicle that is verified", board.vehicle, [scenario.vehicle.name])
    check_waivers(loaded, scenario.vehicle, campaigns)
    files, tree = inputs_of([scenario, *flights], campaigns), told(scenario.scenario)
    for n, pedigree in enumerate(board.pedigree):
        if pedigree.input not in files and not _has(tree, pedigree.input):
            problem = "is neither a file that is read nor a key of the scenario"
            refuse(f"board.pedigree.{n}.input", problem, pedigree.input, files)
    for n, given in enumerate(board.second_tool):
        names = [flight.name for flight in suite.flight]
        if given.flight is not None and given.flight not in names:
            refuse(f"board.second_tool.{n}.flight", "is no flight of the suite", given.flight, names)


def _has(tree: Any, key: str) -> bool:
    """Return True if a tree of tables and lists has the key."""
    for part in key.split("."):
        if isinstance(tree, dict) and part in tree:
            tree = tree[part]
        elif isinstance(tree, list) and part.isdecimal() and int(part) < len(tree):
            tree = tree[int(part)]
        else:
            return False
    return True


def fault_cases(
    flights: Sequence[SuiteFlight], scenarios: Sequence[LoadedScenario], results: Sequence[FlownResult]
) -> tuple[FaultCase, ...]:
    """Return the flights of the suite with a fault."""
    every = zip(flights, scenarios, results, strict=True)
    return tuple(
        FaultCase(f.name, f.probability, result.passed, f.design_must_keep)
        for f, loaded, result in every
        if loaded.scenario.fault
    )


def fault_requirements(cases: Sequence[FaultCase], most: float | None) -> list[JudgedRequirement]:
    """Return the requirement on the sum of the probabilities of missed fault cases, if an upper limit is given.

    The sum is undecided if a missed case has no probability.
    """
    if most is None:
        return []
    missed = [case for case in cases if not case.met]
    total = missed_probability(cases)
    unsaid = sum(case.probability is None for case in missed)
    judgement = REJECTED if total > most else UNDECIDED if unsaid else ACCEPTED
    found = f"{total:.3g}, {len(missed)} of {len(cases)} cases not met"
    found += f", {unsaid} of them without a probability" if unsaid else ""
    return [JudgedRequirement("faults", FAULTS_NAME, f"<= {most:g}", found, judgement, room_left(total, most, "<="))]


def missed_probability(cases: Iterable[FaultCase]) -> float:
    """Return the sum of the known probabilities of the missed cases, an upper bound for any dependence between them."""
    return sum(case.probability or 0.0 for case in cases if not case.met)


def second_tool_values(job: Parts, results: Sequence[FlownResult]) -> tuple[SecondToolValue, ...]:
    """Return the values of a second tool together with those of maxq, for the loop as designed or for a flight."""
    board, by_name = job.suite.board, {result.name: result for result in results}
    limits = job.suite.margins.dispersed if job.suite.margins is not None else LoopLimits()

    def loop_value(given: SecondToolSection) -> float:
        design = job.design
        assert given.time_s is not None
        if design is None:
            return math.nan
        node = operating_points.nodes(job.along, [given.time_s], plane=given.plane or "pitch")[0]
        loop = Loop(fixed_path(node), law_at(design, node))
        return linear.measured(loop, limits.slosh_peak_db).get(given.quantity, math.nan)

    out = []
    for given in board.second_tool if board is not None else ():
        if given.flight is not None:
            own, unit = by_name[given.flight].metrics.get(given.quantity, math.nan), unit_of(given.quantity)
        else:
            own, unit = loop_value(given), MEASURED[given.quantity].unit
        out.append(SecondToolValue(given, own, "" if unit == "1" else unit))
    return tuple(out)


def second_tool_requirements(values: Sequence[SecondToolValue]) -> list[JudgedRequirement]:
    """Return the requirements that the values of maxq agree with those of the second tool within its tolerances."""
    out = []
    for v in values:
        known, given = math.isfinite(v.own), v.given
        met = known and abs(v.difference) <= given.tolerance
        wanted = f"{given.value:g} +- {given.tolerance:g} {v.unit}".rstrip()
        found = f"{v.own:.4g} {v.unit}".rstrip() if known else "no value"
        room = 1.0 - abs(v.difference) / given.tolerance if known else math.nan
        judgement = ACCEPTED if met else REJECTED if known else UNDECIDED
        out.append(JudgedRequirement("second tool", given.about, wanted, found, judgement, room))
    return out


def deviations_by_kind(loaded: LoadedCampaign, result: CampaignResult) -> CampaignDeviations:
    """Return the deviations of a campaign by kind, and the worst third of its runs for each epistemic deviation."""
    kinds: dict[str, list[str]] = {EPISTEMIC: [], ALEATORY: [], UNSAID: []}
    for draw in loaded.plan.draws:
        kinds[draw.spec.kind or UNSAID].append(draw.label)
    if loaded.file.wind_model is not None:
        kinds[loaded.file.wind_model.kind or UNSAID].append("wind")
    data = DataSet(result.folder, loaded, loaded.campaign.runs)
    missed = np.isin(data.runs, failed_runs(data))
    worst = []
    for draw in loaded.plan.draws:
        if draw.spec.kind == EPISTEMIC and not draw.is_text and len(missed) >= len(THIRDS):
            worst.append(worst_third(draw.label, data.numbers(draw.name), missed))
    by_kind = {kind: tuple(dict.fromkeys(names)) for kind, names in kinds.items()}
    return CampaignDeviations(result.name, by_kind, tuple(worst))


def kinds_of(campaigns: Sequence[LoadedCampaign], results: Sequence[CampaignResult]) -> tuple[CampaignDeviations, ...]:
    """Return the deviations by kind of each flown campaign."""
    return tuple(map(deviations_by_kind, campaigns if results else (), results))


def worst_third(name: str, values: np.ndarray, missed: np.ndarray) -> WorstThird:
    """Return the third of the runs, ranked by `values` (runs,), with the largest fraction of misses.

    `missed` (runs,) is True for a run that misses a limit.
    """
    thirds = np.array_split(np.argsort(values, kind="stable"), len(THIRDS))
    worst = max(range(len(THIRDS)), key=lambda k: float(missed[thirds[k]].mean()))
    count, runs = int(missed[thirds[worst]].sum()), len(thirds[worst])
    return WorstThird(
        name, THIRDS[worst] if count else "none", count, runs, int(missed.sum()) - count, len(missed) - runs
    )
