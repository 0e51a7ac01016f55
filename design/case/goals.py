"""The goals of a case: `[[goal]]`, objectives and limits in addition to `[objective]` and `[limits]`.

A goal applies to a quantity of a loop at all operating points or at named ones. A hard goal is a limit. A soft goal has
a `weight` and belongs to the objective `goals`.
"""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path
from typing import Annotated, Literal, get_args

from pydantic import Field

from maxq.design.quantities import QUANTITIES, STEPS, Quantity, Sense
from maxq.sim.input.errors import refuse
from maxq.sim.input.values import Positive, Section, optional

TransferName = Literal["S", "T", "KS", "L"]
StepName = Literal["overshoot_pct", "settling_pct", "gimbal_peak", "offset_peak"]
WindName = Literal["q_alpha_Padeg", "drift_mps"]
GoalMargin = Literal[
    "first_mode_db",
    "second_mode_db",
    "modes_from_2_db",
    "modes_from_3_db",
    "gain_margin_db",
    "gain_up_db",
    "gain_down_db",
    "phase_margin_deg",
    "first_mode_phase_deg",
    "modulus_db",
    "delay_ms",
]
TRANSFERS: tuple[str, ...] = get_args(TransferName)
IN_DB = tuple(key for key in get_args(GoalMargin) if QUANTITIES[key].unit == "dB" and "margin" not in key)
"""The quantities that a soft goal can minimise or maximise without a target."""
Template = tuple[tuple[float, float], ...]


class GoalSection(Section):
    """A goal. S = 1 / (1 + L), T = L S, KS = C S with the law C from the measured rate to the gimbal command."""

    quantity: GoalMargin | TransferName | StepName | WindName | Literal["function"] = Field(
        description="quantity of the loop; S, T, KS, L: a template of its magnitude over frequency; overshoot_pct, "
        "settling_pct, gimbal_peak: after a step of the commanded attitude; offset_peak: largest attitude per constant "
        "gimbal offset; q_alpha_Padeg, drift_mps: in wind, soft only; function: of your own"
    )
    name: str = optional("name in reports (default: the quantity)", "")
    weight: Positive | None = optional("weight of a soft goal, in the objective `goals` (default: a hard goal)")
    limit: float | None = optional("limit, or target of a soft goal, in the unit of the quantity")
    most_db: Template | None = optional("template: points [Hz, dB], linear in dB over log frequency, not exceeded")
    least_db: Template | None = optional("template: likewise, from which the magnitude does not fall")
    after_s: Positive | None = optional("settling_pct: time from which the deviation from the command counts, s")
    until_s: Annotated[float, Field(gt=0.0, le=60.0)] = optional("duration of the step response, s", 10.0)
    at_s: tuple[float, ...] | None = optional("operating points to which the goal applies, s (default: all)")
    dispersed: bool = optional("true: the goal also applies to the dispersed plants of [robust]", False)
    function: str | None = optional("function as FILE.py:NAME, in the folder of the case")
    sense: Sense | None = optional("function: <= or >= (default: <=)")
    unit: Literal["", "dB", "deg"] = optional("function: unit; violations of others are relative to the limit", "")
    band_hz: tuple[float, float] = optional("function: band of its 400 frequencies, Hz", (0.02, 40.0))

    def _check(self) -> None:
        kind, templates = self.quantity, [key for key in ("most_db", "least_db") if getattr(self, key) is not None]
        self.only_with(("most_db", "least_db"), kind in TRANSFERS, "quantity S, T, KS or L")
        self.only_with(("function", "sense"), kind == "function", 'quantity = "function"')
        self.only_with(("after_s",), kind == "settling_pct", 'quantity = "settling_pct"')
        if kind in TRANSFERS:
            if len(templates) != 1:
                raise refuse("has no template, or two", "one of most_db, least_db; two goals for both", "quantity")
            points = getattr(self, templates[0])
            if len(points) < 2 or points[0][0] <= 0.0 or any(b[0] <= a[0] for a, b in pairwise(points)):
                raise refuse("does not rise in frequency", "two points [Hz, dB] or more, from above 0 Hz", templates[0])
        self.only_with(("limit",), kind not in TRANSFERS, "a quantity without a template")
        if kind == "function":
            self.needs("function", "the quantity is a function", "FILE.py:NAME")
            if not 0.0 < self.band_hz[0] < self.band_hz[1]:
                raise refuse("is empty", "two numbers above 0, the lower one first", "band_hz")
        if kind == "settling_pct":
            self.needs("after_s", "the quantity is settling_pct", "a time, s")
        if self.after_s is not None and self.after_s >= self.until_s:
            raise refuse("is after the end of the response", f"a time before until_s = {self.until_s:g}", "after_s")
        wind = kind in get_args(WindName)
        if wind and (self.weight is None or self.at_s is not None):
            raise refuse("is hard, or not at all operating points", f"[limits] {kind}, or a weight", "quantity")
        if kind not in TRANSFERS and not (self.weight is not None and (wind or kind in IN_DB)):
            self.needs("limit", "the goal is hard or has no other scale", "a number")
        if self.limit is not None and self.limit <= 0.0 and kind not in (*IN_DB, "function"):
            raise refuse("is not positive", "a number above 0", "limit")
        if self.limit == 0.0 and kind == "function" and self.unit == "":
            raise refuse("gives no scale for a violation", "a limit other than 0, or unit = 'dB'", "limit")

    @property
    def hard(self) -> bool:
        """Return True for a limit, False for a part of the objective."""
        return self.weight is None

    @property
    def about(self) -> Quantity:
        """Return the label, the unit and the sense of the quantity."""
        if self.quantity == "function":
            label = self.name or (self.function or "").rpartition(":")[2]
            return Quantity(label, label, self.unit, self.sense or "<=")
        if self.quantity in TRANSFERS:
            label = self.name or f"|{self.quantity}| {'over' if self.most_db else 'below'} its template"
            return Quantity(label, f"{self.quantity} dB", "dB", "<=")
        known = STEPS.get(self.quantity) or QUANTITIES[self.quantity]
        return Quantity(self.name or known.label, known.heading, known.unit, known.sense, known.value)

    @property
    def template(self) -> tuple[Template, float]:
        """Return the template, and 1 for an upper or -1 for a lower one."""
        assert self.quantity in TRANSFERS
        return (self.most_db, 1.0) if self.most_db is not None else (self.least_db or (), -1.0)

    def beside(self, folder: Path) -> GoalSection:
        """Return the goal with the path of its function's file in a folder, if this file exists."""
        file, colon, name = (self.function or "").rpartition(":")
        there = folder / file
        return self.model_copy(update={"function": f"{there}{colon}{name}"}) if file and there.is_file() else self

    def applies(self, time_s: float, dispersed: bool = False) -> bool:
        """Return True if the goal applies at an operating point (s)."""
        here = self.at_s is None or any(abs(time_s - t) < 1e-6 for t in self.at_s)
        return here and (self.dispersed or not dispersed)
