"""The section [board] of a suite: information for a review board that people must supply.

It contains the pedigree of inputs, credibility factors, waivers, and values of a second tool. `board_findings` compares
them with a verification; docs/verdicts.md explains each.
"""

from __future__ import annotations

import datetime
import re
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, Field

from maxq.design.quantities import MEASURED
from maxq.sim.flight.metric_table import METRIC_NAMES
from maxq.sim.input.errors import refuse
from maxq.sim.input.values import NotNegative, Positive, Section, optional

Factor = Literal[
    "data pedigree",
    "verification",
    "validation",
    "input pedigree",
    "uncertainty characterization",
    "results robustness",
    "history",
    "process and product management",
]
WaivablePart = Literal["scenarios", "margins", "dispersed", "worst", "authority", "campaign", "faults", "second tool"]
"""The parts whose requirements can be waived. Stability and certificates cannot be waived."""


def _date(text: str) -> str:
    try:
        datetime.date.fromisoformat(text if re.fullmatch(r"\d{4}-\d{2}-\d{2}", text) else "")
    except ValueError:
        raise refuse("is not a date", "a text such as '2026-11-26'") from None
    return text


def _filled(text: str) -> str:
    if not text.strip():
        raise refuse("is empty", "words")
    return text


Date = Annotated[str, AfterValidator(_date)]
BoardText = Annotated[str, AfterValidator(_filled)]


class PedigreeSection(Section):
    """The source and the use history of one input."""

    input: BoardText = Field(
        description="a file that is read, as the review pack names it, or a key of the scenario, e.g. "
        "vehicle.stage.0.gyro"
    )
    source: BoardText = Field(description="source of the numbers")
    obtained: Literal["measured", "computed", "estimated"] = Field(description="how the numbers were obtained")
    date: Date | None = optional("date of the numbers, YYYY-MM-DD")
    use_history: str = optional("earlier uses of these numbers, and their outcome", "")


class CredibilitySection(Section):
    """The assessed level of one credibility factor of NASA-STD-7009."""

    factor: Factor = Field(description="the factor")
    level: Annotated[int, Field(ge=0, le=4)] = Field(description="0 (insufficient evidence) to 4")
    evidence: BoardText = Field(description="the evidence for this level")


class WaiverSection(Section):
    """A requirement that may be missed by a stated fraction until a date."""

    part: WaivablePart = Field(description="part of the requirement, as in the report")
    requirement: BoardText = Field(
        description="name of the requirement, as in the report; a waiver covers all of this name"
    )
    room: Annotated[float, Field(gt=-1.0, lt=0.0)] = Field(
        description="least margin to the limit that is waived, as a share of it: -0.05 is 5 % beyond the limit"
    )
    reason: BoardText = Field(description="the reason")
    approver: BoardText = Field(description="the person who approved it")
    date: Date = Field(description="first day, YYYY-MM-DD")
    expires: Date = Field(description="last day, YYYY-MM-DD")

    def _check(self) -> None:
        if self.expires < self.date:
            raise refuse("is before the first day", f"{self.date} or later", "expires")

    @property
    def about(self) -> str:
        """Return the part and name of the requirement."""
        return f"{self.part}: {self.requirement}"


class SecondToolSection(Section):
    """A value from a second tool, for comparison with the value that maxq computes."""

    tool: BoardText = Field(description="the tool and its version")
    file: BoardText = Field(description="file or report with the value")
    quantity: str = Field(description="a key of margins.nominal (of the loop at time_s), or a metric (of a flight)")
    time_s: NotNegative | None = optional("vehicle time of the operating point, s")
    plane: Literal["pitch", "yaw"] | None = optional("plane of the operating point")
    flight: str | None = optional("name of a flight of the suite")
    value: float = Field(description="value by the second tool, in the unit of the quantity")
    tolerance: Positive = Field(description="largest difference that is accepted, in the same unit")

    def _check(self) -> None:
        of_flight = self.flight is not None
        known = METRIC_NAMES if of_flight else tuple(MEASURED)
        if self.quantity not in known:
            raise refuse(
                "is not a metric" if of_flight else "is not a quantity of a loop", ", ".join(known), "quantity"
            )
        self.only_with(("time_s", "plane"), not of_flight, "a quantity of a loop")
        for key, allowed in () if of_flight else (("time_s", "a number >= 0"), ("plane", "'pitch', 'yaw'")):
            self.needs(key, f"{self.quantity} is of an operating point", allowed)

    @property
    def where(self) -> str:
        """Return the operating point or the flight as text."""
        return self.flight if self.flight is not None else f"{self.time_s:g} s, {self.plane}"

    @property
    def about(self) -> str:
        """Return the quantity, its operating point or flight, and the tool. This is the name of the requirement."""
        what = self.quantity if self.flight is not None else MEASURED[self.quantity].label
        return f"{what} ({self.where}) by {self.tool}"


class BoardSection(Section):
    """The statements about one vehicle for a review board."""

    vehicle: BoardText = Field(description="name of the vehicle that the statements are about")
    pedigree: tuple[PedigreeSection, ...] = optional("inputs with their source and use history", ())
    credibility: tuple[CredibilitySection, ...] = optional("credibility factors of NASA-STD-7009", ())
    waiver: tuple[WaiverSection, ...] = optional("requirements that may be missed", ())
    second_tool: tuple[SecondToolSection, ...] = optional("values from a second tool", ())
    fault_probability: Annotated[float, Field(gt=0.0, lt=1.0)] | None = optional(
        "largest sum of the probabilities of the fault cases that are not met (default: not judged)"
    )

    def _check(self) -> None:
        every: dict[str, list[Any]] = {
            "pedigree": [one.input for one in self.pedigree],
            "credibility": [one.factor for one in self.credibility],
            "waiver": [one.about for one in self.waiver],
            "second_tool": [one.about for one in self.second_tool],
        }
        key = {"pedigree": "input", "credibility": "factor", "waiver": "requirement", "second_tool": "quantity"}
        for section, names in every.items():
            for n, name in enumerate(names):
                if name in names[:n]:
                    raise refuse("is listed already", "each once", (section, n, key[section]))
