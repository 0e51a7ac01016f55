"""Waivers of requirements: the names of requirements that can be waived, and the effect of a waiver on a verdict.

A waived requirement remains rejected, with its value. A waiver is in force between its dates, if the requirement is
missed by no more than its `room` and the evidence reaches the floor of an acceptance.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

from maxq.design.quantities import MEASURED, LoopLimits
from maxq.design.verify.board import BoardSection, WaiverSection
from maxq.design.verify.linear import AUTHORITY_NAME, RANDOM_NAME
from maxq.design.verify.names import stage_name
from maxq.design.verify.suite import AS_DESIGNED, REJECTED, JudgedRequirement, LoadedSuite
from maxq.design.verify.worst import modulus_name
from maxq.sim.campaign.analysis import ALL_REQUIREMENTS
from maxq.sim.campaign.read import LoadedCampaign
from maxq.sim.input.errors import ScenarioError, suggestion
from maxq.sim.scenario.schema_vehicle import Vehicle

FAULTS_NAME = "probability of the fault cases that are not met"
IN_FORCE = "in force"


@dataclass(frozen=True)
class AppliedWaiver:
    """A waiver of the suite, the number of requirements that it waives, and its state as text."""

    waiver: WaiverSection
    count: int
    state: str


def waivable(loaded: LoadedSuite, vehicle: Vehicle, campaigns: Sequence[LoadedCampaign]) -> dict[str, list[str]]:
    """Return the names of the requirements that can be waived, by part, for a suite fitted to its vehicle."""
    suite, out = loaded.suite, dict[str, list[str]]()
    stages = [stage_name(vehicle, n) for n in range(len(vehicle.stage))]

    def named(*parts: str) -> list[str]:
        return [", ".join(filter(None, (*parts, stage))) for stage in stages]

    def limits(of: LoopLimits, whose: str) -> list[str]:
        asked = [about.label for key, about in MEASURED.items() if getattr(of, key) is not None]
        return [name for label in asked for name in named(label, whose)]

    out["scenarios"] = [flight.name for flight in suite.flight if flight.design_must_keep]
    if suite.margins is not None:
        out["margins"] = limits(suite.margins.nominal, AS_DESIGNED)
        out["dispersed"] = [*limits(suite.margins.dispersed, "corners"), *named(RANDOM_NAME)]
        worst = suite.margins.worst
        if worst is not None and worst.modulus is not None:
            out["worst"] = [name for plane in suite.margins.planes for name in named(modulus_name(worst), plane)]
    if suite.wind_limit_mps is not None:
        out["authority"] = [AUTHORITY_NAME]
    out["campaign"] = [
        f"{wanted.name or campaign.name}: {name}"
        for wanted, campaign in zip(suite.campaign, campaigns, strict=False)
        for name in (*(r.name or r.metric for r in campaign.base.scenario.requirement), ALL_REQUIREMENTS)
        if wanted.availability is None and campaign.base.scenario.requirement
    ]
    board = suite.board
    out["faults"] = [FAULTS_NAME] if board is not None and board.fault_probability is not None else []
    out["second tool"] = [one.about for one in board.second_tool] if board is not None else []
    return {part: names for part, names in out.items() if names}


def check_waivers(loaded: LoadedSuite, vehicle: Vehicle, campaigns: Sequence[LoadedCampaign]) -> None:
    """Raise ScenarioError for a waiver of a requirement that the suite does not have."""
    board = loaded.suite.board
    known = waivable(loaded, vehicle, campaigns) if board is not None and board.waiver else {}
    for n, waiver in enumerate(board.waiver if board is not None else ()):
        names = known.get(waiver.part, [])
        if waiver.requirement not in names:
            hint = suggestion(waiver.requirement, names)
            problem = f"the suite has no such requirement in the part {waiver.part}{'; ' + hint if hint else ''}"
            allowed = "" if hint else ", ".join(names) or "no waiver in this part"
            key = f"board.waiver.{n}.requirement"
            raise ScenarioError(loaded.label, problem, key, value=waiver.requirement, allowed=allowed)


def apply_waivers(
    requirements: Sequence[JudgedRequirement], board: BoardSection | None, date: str, screening: bool
) -> tuple[list[JudgedRequirement], tuple[AppliedWaiver, ...]]:
    """Return the requirements with their waivers, and the state of each waiver.

    `date` (YYYY-MM-DD) is the day of the verdict. `screening` is True if the evidence is below the floor of an
    acceptance.
    """
    out, applied = list(requirements), list[AppliedWaiver]()
    for waiver in board.waiver if board is not None else ():
        mine = [n for n, r in enumerate(out) if (r.part, r.name) == (waiver.part, waiver.requirement)]
        missed = [n for n in mine if out[n].judgement == REJECTED]
        beyond = [out[n] for n in missed if not out[n].room >= waiver.room]
        state = IN_FORCE
        if not missed:
            state = "not needed: the requirement is not missed" if mine else "the requirement was not judged"
        elif not waiver.date <= date <= waiver.expires:
            state = f"expired on {waiver.expires}" if date > waiver.expires else f"not valid before {waiver.date}"
        elif beyond:
            room = "none" if math.isnan(beyond[0].room) else f"{100.0 * beyond[0].room:.1f} %"
            state = f"not in force: the margin to the limit is {room}"
        elif screening:
            state = "not in force: below the floor of an acceptance"
        if state == IN_FORCE:
            for n in missed:
                out[n] = replace(out[n], waived=f"{waiver.approver} until {waiver.expires}")
        applied.append(AppliedWaiver(waiver, len(missed) if state == IN_FORCE else 0, state))
    return out, tuple(applied)
