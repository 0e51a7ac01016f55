"""Verdicts: on a requirement, and on a design."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal

Judgement = Literal["accepted", "rejected", "undecided"]
ACCEPTED: Judgement = "accepted"
REJECTED: Judgement = "rejected"
UNDECIDED: Judgement = "undecided"


@dataclass(frozen=True)
class Requirement:
    """One thing asked for, and what became of it.

    `part`: what it was looked at with, "scenarios", "margins", "dispersed", "certificate", "campaign". `wanted` and
    `found` are for people; `room` is the share of the limit that is left, negative beyond it, NaN where that has no
    meaning. `where` says at which node or in which run, `again` the command that shows it.
    """

    part: str
    name: str
    wanted: str
    found: str
    judgement: Judgement
    room: float
    where: str = ""
    more_runs: int = 0
    again: str = ""

    @property
    def reason(self) -> str:
        """In a sentence."""
        place = f" ({self.where})" if self.where else ""
        if self.judgement == UNDECIDED:
            runs = f": {self.more_runs} more runs" if self.more_runs else ""
            return f"{self.name}: {self.found}, wanted {self.wanted}{place}; not settled{runs}"
        return f"{self.name}: {self.found}, wanted {self.wanted}{place}"


def overall(requirements: Iterable[Requirement]) -> Judgement:
    """Rejected if one is, else undecided if one is; nothing looked at is nothing shown."""
    found = {r.judgement for r in requirements}
    if REJECTED in found:
        return REJECTED
    return UNDECIDED if UNDECIDED in found or not found else ACCEPTED
