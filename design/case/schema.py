"""What a person may write into a case file: problem (42) to (50) of Lee, Ahn & Roh, and what goes beyond it.

The paper leaves the values of its limits and bounds open; each description says what is assumed and why.
"""

from __future__ import annotations

from itertools import pairwise
from typing import Annotated, Literal

from pydantic import Field, model_validator

from maxq.control.laws.structures import MAX_SECTIONS, STRUCTURES, Law
from maxq.sim.scenario.errors import refuse
from maxq.sim.scenario.schema_values import NotNegative, Positive, Section, needs, only_with

PAPER_TIMES_S = tuple(float(t) for t in range(5, 60, 5))
LIMIT_NAMES = Literal["second_mode_db", "filter_gain_at_infinity", "rigid_hz", "rigid_zeta"]

ObjectiveName = Literal["first-mode-peak", "least-margin"]
"""Keys of `design.optimise.criteria.OBJECTIVES`."""

Range = tuple[float, float]
Margin = Annotated[float, Field(gt=0.0, le=90.0)]
Share = Annotated[float, Field(ge=0.0, lt=1.0)]


def _check_range(value: Range, key: str, lowest: float) -> None:
    low, high = value
    if not lowest < low:
        raise refuse("reaches down to an unstable or right-half-plane root", "numbers above 0", key=(key,))
    if not low < high:
        raise refuse("is empty", "two numbers, the lower one first", key=(key,))


class Gains(Section):
    """The gain schedules."""

    schedule: Literal["two-phase", "linear", "free", "nodes"] = Field(
        default="linear",
        description="two-phase: the least linear ones that meet [reference], found before the filter (paper, 5.1); "
        "linear: values at the first and last node (Subcase 1); free: at every node (Subcase 2); nodes: at nodes_s",
    )
    nodes_s: tuple[float, ...] | None = Field(
        default=None, description="vehicle times of the gain table, s; with nodes"
    )

    @model_validator(mode="after")
    def _check(self) -> Gains:
        only_with(self, ("nodes_s",), self.schedule == "nodes", 'schedule = "nodes"')
        if self.schedule == "nodes":
            _rising(needs(self, "nodes_s", 'schedule is "nodes"', "rising times, s"), "nodes_s")
        return self


def _rising(times: tuple[float, ...], key: str) -> None:
    if len(times) == 0 or any(b <= a for a, b in pairwise(times)):
        raise refuse("does not rise", "one rising time or more, s", key=(key,))


class FilterBounds(Section):
    """Bounds of the filter's variables (50), Hz where a frequency; the paper gives none.

    They matter. Frequencies begin well above the rigid body's crossover: lower ones would change the gains that (35)
    and (36) reckon with, and an optimiser makes use of that (with roots from 1 Hz, F4 came 8 dB lower as a lag
    network).
    """

    zero_hz: Range = Field(default=(3.0, 100.0), description="of quadratic sections; from twice the crossover")
    zero_zeta: Range = Field(
        default=(0.1, 1.2),
        description="a notch of 0.01 is optimal on paper and brittle; one of 0.1 keeps 10 of its 14 dB "
        "where a mode is 10 % off",
    )
    pole_hz: Range = Field(default=(3.0, 100.0), description="of quadratic sections; from twice the crossover")
    pole_zeta: Range = Field(
        default=(0.3, 1.2),
        description="below 0.3 a filter amplifies by more than 4 dB at its own resonance, and rings; "
        "above 1 the roots are real",
    )
    first_order_zero_hz: Range = Field(default=(2.0, 200.0), description="of first-order sections")
    first_order_pole_hz: Range = Field(default=(2.0, 200.0), description="of first-order sections")

    @model_validator(mode="after")
    def _check(self) -> FilterBounds:
        for key in type(self).model_fields:
            _check_range(getattr(self, key), key, 0.0)
        return self


class Filter(Section):
    """The bending filter's form."""

    structure: Literal["F2", "F3", "F4", "F5", "F6", "sections"] = Field(
        default="F4", description="of the paper (37 to 41), or sections: as many as quadratic and first_order say"
    )
    quadratic: int | None = Field(default=None, ge=0, description="number of quadratic sections; with sections")
    first_order: int | None = Field(default=None, ge=0, description="number of first-order sections; with sections")
    prewarp_hz: Positive | None = Field(
        default=None,
        description="where the discrete filter equals the continuous one, Hz; default: mean first bending frequency",
    )
    bounds: FilterBounds = FilterBounds()

    @model_validator(mode="after")
    def _check(self) -> Filter:
        free = self.structure == "sections"
        only_with(self, ("quadratic", "first_order"), free, 'structure = "sections"')
        if free and not 1 <= sum(self.sections) <= MAX_SECTIONS:
            raise refuse(f"has {sum(self.sections)} sections", f"1 .. {MAX_SECTIONS} in all", key=("structure",))
        return self

    @property
    def sections(self) -> tuple[int, int]:
        """Quadratic and first-order ones."""
        return STRUCTURES.get(self.structure, (self.quadratic or 0, self.first_order or 0))


class Objective(Section):
    """What is made best."""

    kind: ObjectiveName = Field(
        default="first-mode-peak",
        description="first-mode-peak: least peak of mode 1 over all nodes (42). least-margin: largest of the least "
        "|1 + L|; for plants whose first mode wanders so far that it is better phase-stabilised than notched",
    )
    band: Annotated[float, Field(gt=0.0, lt=0.5)] = Field(
        default=0.03,
        description="half width of the band around each coupled bending frequency in which its peak is sought, as a "
        "share of it; the paper evaluates at the uncoupled frequency, which can miss the peak by 1 dB (erratum 17)",
    )


class MarginLimits(Section):
    """Limits of a loop; margins hold at every crossing, and the closed loop must be stable."""

    gain_margin_db: Positive = Field(default=6.0, description="GM_R (44): customary, the paper gives none")
    phase_margin_deg: Margin = Field(default=30.0, description="PM_R (45): customary, the paper gives none")
    modulus_db: Annotated[float, Field(lt=0.0)] | None = Field(default=None, description="least |1 + L|")
    first_mode_db: float | None = Field(default=None, description="largest peak of mode 1, where it is no objective")
    second_mode_db: float = Field(
        default=-6.0, description="P2_UL (43): as low as the gain margin asks; not in the paper"
    )
    higher_modes_db: float | None = Field(
        default=None, description="largest peak of modes 3 and above; not in the paper"
    )
    first_mode_phase_deg: Margin | None = Field(
        default=None,
        description="phase margin at 0 dB inside the band of mode 1 (45 is customary for a phase-stabilised one)",
    )
    rigid_hz: Positive = Field(
        default=0.5, description="omega_RB,min (47): what the paper's reference design was held to"
    )
    rigid_zeta: Positive = Field(default=0.7, description="zeta_RB,min (48): likewise")
    without: tuple[LIMIT_NAMES, ...] = Field(default=(), description="limits that are not asked for")


class Limits(MarginLimits):
    """Limits of the nominal plants, and those of filter and method."""

    zone: Literal["none", "ellipse", "diamond", "rectangle"] = Field(
        default="none",
        description="keep L out of a zone around -1 in the Nichols plane, half axes gain_margin_db, phase_margin_deg",
    )
    filter_gain_at_infinity: Positive = Field(
        default=1.0, description="P^F, largest |F(j inf)| (46): 1, a filter that amplifies no noise; not in the paper"
    )
    rigid_body: Literal["paper", "aerodynamic"] = Field(
        default="paper",
        description="frequency and damping ratio by (35), (36), or with M_alpha and M_q in them (erratum 12)",
    )


class Reference(Section):
    """Phase 1 of the two-phase design: the least gains linear in time that meet these."""

    rigid_hz: Positive = Field(default=0.5, description="natural frequency at every node, Hz (paper, 5.1)")
    rigid_zeta: Positive = Field(default=0.7, description="damping ratio at every node (paper, 5.1)")


class DispersedLimits(MarginLimits):
    """Limits of the dispersed plants: half the nominal ones, as is practice."""

    gain_margin_db: Positive = Field(default=3.0, description="customary: half the nominal one")
    phase_margin_deg: Margin = Field(default=15.0, description="customary: half the nominal one")
    second_mode_db: float = Field(default=-3.0, description="as low as the gain margin asks")
    without: tuple[LIMIT_NAMES, ...] = Field(
        default=("rigid_hz", "rigid_zeta"), description="limits that are not asked for"
    )


class Robust(Section):
    """Plants other than the nominal one for which the design must hold: half ranges, shares unless a unit is named.

    The defaults are 3-sigma ranges after a modal survey: bending 5, 10, 15 %, slopes 20 %.
    """

    bending_frequency: tuple[Share, ...] = Field(default=(0.05, 0.10, 0.15), description="of each mode, all one way")
    bending_slope: Share = Field(default=0.2, description="of all modes at the gyro")
    slosh_frequency: Share = Field(default=0.05, description="of all tanks")
    slosh_mass: Share = Field(default=0.1, description="of all tanks")
    slosh_damping: Share = Field(default=0.5, description="of all tanks")
    actuator_frequency: Share = Field(default=0.15, description="of the actuator's poles")
    delay_s: NotNegative = Field(default=0.005, description="more delay in the computer, s; none is the other end")
    thrust: Share = Field(default=0.03, description="of the gimbal's authority")
    normal_force: Share = Field(default=0.15, description="of the slope of lift")
    centre_of_pressure_m: NotNegative = Field(default=0.25, description="a quarter of the diameter")
    inertia: Share = Field(default=0.05, description="of the core")
    rounds: Annotated[int, Field(ge=1, le=50)] = Field(
        default=8, description="times that the worst plants are searched, added, and the design is made anew"
    )
    limits: DispersedLimits = DispersedLimits()


class Search(Section):
    """The optimiser's starts."""

    starts: Annotated[int, Field(ge=1, le=1000)] = Field(default=8, description="number of starts of the whole problem")
    leaps: Annotated[int, Field(ge=0, le=1000)] = Field(
        default=8, description="leaps from the best end: part of the variables thrown off, and brought down again"
    )
    seed: Annotated[int, Field(ge=0)] = Field(default=1, description="of the random ones among them")


class Case(Section):
    """A case file, in designs/cases/."""

    schema_version: Literal[1] = Field(default=1, alias="schema", description="version of the format")
    name: str = Field(default="", description="name of the case")
    description: str = Field(default="", description="what it is, in a sentence")
    scenario: str = Field(default="nominal", description="whose flight gives speed, air and attitude at the nodes")
    plant: Literal["flown", "table2"] = Field(
        default="flown", description="the scenario's vehicle, or with derivatives that span the paper's Table 2"
    )
    errata: Literal["corrected", "paper"] = Field(
        default="corrected", description="the paper's model corrected or as printed"
    )
    loop: Literal["pade", "sampled", "exact"] = Field(
        default="sampled", description="pade: the paper's continuous model (30 to 32); sampled: as the computer runs it"
    )
    plane: Literal["pitch", "yaw"] = Field(default="pitch", description="plane of the model")
    nodes_s: tuple[float, ...] = Field(
        default=PAPER_TIMES_S, description="vehicle times at which the limits are checked, s"
    )
    law: Law = Field(default="pd", description="control law; pd: proportional-derivative with a bending filter")
    gains: Gains = Gains()
    filter: Filter = Filter()
    objective: Objective = Objective()
    limits: Limits = Limits()
    reference: Reference = Reference()
    robust: Robust | None = Field(default=None, description="absent: the nominal plants only")
    search: Search = Search()

    @model_validator(mode="after")
    def _check(self) -> Case:
        _rising(self.nodes_s, "nodes_s")
        return self
