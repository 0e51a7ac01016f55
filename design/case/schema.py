"""Case files: what they may hold, problem (42) to (50) of Lee, Ahn & Roh and what goes beyond it, and reading them.

    loaded = read_case("ksr3-identical", ["filter.structure='F6'"])

The paper leaves the values of its limits and bounds open; each description says what is assumed and why.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, TypeVar

from pydantic import Field

from maxq.control.kernel.limits import MAX_STAGES
from maxq.control.structures import MAX_SECTIONS, RELIEF, STRUCTURES, DesignedStructure, Law, Over
from maxq.design.model.spread import Shares, Spread
from maxq.design.quantities import CommonLimits, Degrees, RigidBody, ZoneName
from maxq.sim.scenario.documents import Text
from maxq.sim.scenario.errors import ScenarioError, refuse
from maxq.sim.scenario.files import builtin_files, find, shown
from maxq.sim.scenario.loader import LoadedScenario, load_file, load_scenario
from maxq.sim.scenario.schema_design import Design, LoadRelief
from maxq.sim.scenario.schema_values import NotNegative, Positive, PositiveOverTime, Section, optional

LIMIT_NAMES = Literal["second_mode_db", "filter_gain_at_infinity", "rigid_hz", "rigid_zeta"]

ObjectiveName = Literal["first-mode-peak", "least-margin", "load", "bending-moment"]
"""Keys of `design.optimise.criteria.OBJECTIVES`."""

Model = TypeVar("Model", bound=Section)
Range = tuple[float, float]


def _check_range(value: Range, key: str, lowest: float) -> None:
    low, high = value
    if not lowest < low:
        raise refuse("reaches down to an unstable or right-half-plane root", "numbers above 0", key)
    if not low < high:
        raise refuse("is empty", "two numbers, the lower one first", key)


class Gains(Section):
    """The gain schedules."""

    schedule: Literal["two-phase", "linear", "free", "nodes"] = optional(
        "two-phase: the least linear ones that meet [reference], found before the filter (paper, 5.1); "
        "linear: values at the first and last node, or at the least and the largest value there of what the gains are "
        "over (Subcase 1); free: at every node (Subcase 2); nodes: at nodes_s, or nodes",
        "linear",
    )
    over: Over = optional("what the gains are scheduled over, as the column of a design's table says it", "time_s")
    nodes_s: tuple[float, ...] | None = optional("vehicle times of the gain table, s; with nodes")
    nodes: tuple[float, ...] | None = optional("rows of the gain table over anything but time, in its unit; with nodes")

    def _check(self) -> None:
        if self.over != "time_s" and self.schedule == "two-phase":
            raise refuse("finds gains over time only", "linear, free, nodes", "schedule")
        mine, other = ("nodes_s", "nodes") if self.over == "time_s" else ("nodes", "nodes_s")
        self.only_with((mine,), self.schedule == "nodes", 'schedule = "nodes"')
        when = "over = 'time_s'" if other == "nodes_s" else "over another quantity than time_s"
        self.only_with((other,), False, when)
        if self.schedule == "nodes":
            unit = "times, s" if mine == "nodes_s" else f"values of {self.over}"
            _rising(self.needs(mine, 'schedule is "nodes"', f"rising {unit}"), mine)


def _rising(values: tuple[float, ...], key: str) -> None:
    if len(values) == 0 or any(b <= a for a, b in pairwise(values)):
        raise refuse("does not rise", "one rising number or more", key)


class FilterBounds(Section):
    """Bounds of the filter's variables (50), Hz where a frequency; the paper gives none.

    They matter. Frequencies begin well above the rigid body's crossover: lower ones would change the gains that (35)
    and (36) reckon with, and an optimiser makes use of that (with roots from 1 Hz, F4 came 8 dB lower as a lag
    network).
    """

    zero_hz: Range = optional("of quadratic sections; from twice the crossover", (3.0, 100.0))
    zero_zeta: Range = optional(
        "a notch of 0.01 is optimal on paper and brittle; one of 0.1 keeps 10 of its 14 dB where a mode is 10 % off",
        (0.1, 1.2),
    )
    pole_hz: Range = optional("of quadratic sections; from twice the crossover", (3.0, 100.0))
    pole_zeta: Range = optional(
        "below 0.3 a filter amplifies by more than 4 dB at its own resonance, and rings; above 1 the roots are real",
        (0.3, 1.2),
    )
    first_order_zero_hz: Range = optional("of first-order sections", (2.0, 200.0))
    first_order_pole_hz: Range = optional("of first-order sections", (2.0, 200.0))

    def _check(self) -> None:
        for key in type(self).model_fields:
            _check_range(getattr(self, key), key, 0.0)


class Sections(Section):
    """A filter's form."""

    structure: DesignedStructure = optional(
        "of the paper (37 to 41), or sections: as many as quadratic and first_order say", "F4"
    )
    quadratic: int | None = optional("number of quadratic sections; with sections", ge=0)
    first_order: int | None = optional("number of first-order sections; with sections", ge=0)

    def _check(self) -> None:
        free = self.structure == "sections"
        self.only_with(("quadratic", "first_order"), free, 'structure = "sections"')
        if free and not 1 <= sum(self.sections) <= MAX_SECTIONS:
            raise refuse(f"has {sum(self.sections)} sections", f"1 .. {MAX_SECTIONS} in all", "structure")

    @property
    def sections(self) -> tuple[int, int]:
        """Quadratic and first-order ones."""
        return STRUCTURES.get(self.structure, (self.quadratic or 0, self.first_order or 0))


class Filter(Sections):
    """The bending filter's form."""

    prewarp_hz: Positive | None = optional(
        "where the discrete filter equals the continuous one, Hz; default: mean first bending frequency"
    )
    bounds: FilterBounds = FilterBounds()


class LoopFilters(Section):
    """Filters of what the law works on, each loop by itself, with the bounds and prewarping of [filter]."""

    attitude: Sections | None = optional("of the attitude error")
    rate: Sections | None = optional("of the (blended) rate")
    acceleration: Sections | None = optional("of the lateral acceleration, before its lag; with load relief")

    @property
    def each(self) -> tuple[tuple[int, int], ...]:
        """Quadratic and first-order sections of each."""
        return tuple((0, 0) if f is None else f.sections for f in (self.attitude, self.rate, self.acceleration))


class Objective(Section):
    """What is made best."""

    kind: ObjectiveName = optional(
        "first-mode-peak: least peak of mode 1 over all nodes (42). least-margin: largest of the least "
        "|1 + L|; for plants whose first mode wanders so far that it is better phase-stabilised than notched. load, "
        "bending-moment: least rms of q alpha, or of the bending moment, over all nodes in the wind of [wind], against "
        "drift and margins as limits",
        "first-mode-peak",
    )
    stations_m: tuple[float, ...] | None = optional(
        "where the bending moment is made small, of the stage's loads.stations_m (default: at all of them); with "
        "bending-moment"
    )
    band: Annotated[float, Field(gt=0.0, lt=0.5)] = optional(
        "half width of the band around each coupled bending frequency in which its peak is sought, as a "
        "share of it; the paper evaluates at the uncoupled frequency, which can miss the peak by 1 dB (erratum 17)",
        0.03,
    )

    def _check(self) -> None:
        self.only_with(("stations_m",), self.kind == "bending-moment", 'kind = "bending-moment"')
        if self.stations_m is not None:
            _rising(self.stations_m, "stations_m")


class SectionLimit(Section):
    """A station and the bending moment that is allowed there."""

    station_m: float = Field(description="one of the stage's loads.stations_m, m aft of the nose")
    rms_Nm: Positive = Field(description="largest rms in the wind of [wind], N m")


class DesignLimits(CommonLimits):
    """Limits of one plant; a key that is absent sets none."""

    renamed: ClassVar[dict[str, str]] = {"higher_modes_db": "modes_from_3_db"}

    q_alpha_Padeg: Positive | None = optional("largest rms of dynamic pressure times incidence in the wind of [wind]")
    drift_mps: Positive | None = optional("largest rms of the lateral velocity in the wind of [wind]")
    bending_moment: tuple[SectionLimit, ...] = optional("largest rms of the bending moment in the wind of [wind]", ())
    without: tuple[LIMIT_NAMES, ...] = optional("limits that are not asked for", ())


class MarginLimits(DesignLimits):
    """Limits of a loop; margins hold at every crossing, and the closed loop must be stable."""

    gain_margin_db: Positive = optional("GM_R (44): customary, the paper gives none", 6.0)
    phase_margin_deg: Degrees = optional("PM_R (45): customary, the paper gives none", 30.0)
    second_mode_db: float = optional("P2_UL (43): as low as the gain margin asks; not in the paper", -6.0)
    rigid_hz: PositiveOverTime = optional(
        "omega_RB,min (47): what the paper's reference design was held to; a table {time_s, value} for one over the "
        "vehicle clock, linear between its times",
        0.5,
    )
    rigid_zeta: PositiveOverTime = optional("zeta_RB,min (48): likewise", 0.7)


class Limits(MarginLimits):
    """Limits of the nominal plants, and those of filter and method."""

    zone: ZoneName = optional(
        "keep L out of a zone around -1 in the Nichols plane, half axes gain_margin_db, phase_margin_deg", "none"
    )
    filter_gain_at_infinity: Positive = optional(
        "P^F, largest |F(j inf)| (46): 1, a filter that amplifies no noise; not in the paper", 1.0
    )
    integral_hz: Positive | None = optional(
        "law pid: least corner k_i / (2 pi k_p) of the integral, Hz (default there: a tenth of rigid_hz)"
    )
    most_integral_hz: Positive | None = optional("law pid: largest corner of the integral, Hz (default: none)")
    rigid_body: RigidBody = optional(
        "frequency and damping ratio by (35), (36), or with M_alpha and M_q in them (erratum 12)", "paper"
    )


class Wind(Section):
    """Lateral wind that load and drift are limited in: a spectrum of MIL-F-8785C."""

    sigma_mps: Positive = Field(description="intensity, m/s")
    length_v_m: Positive = optional("scale length, m", 533.0)
    model: Literal["dryden", "von-karman"] = optional("form of the spectrum", "dryden")
    band_hz: Range = optional(
        "frequencies that count, from 0.02 Hz to less than half the sample rate: shears lie below some tenths of one, "
        "where a law can give way; bending modes count if they lie within",
        (0.02, 5.0),
    )

    def _check(self) -> None:
        _check_range(self.band_hz, "band_hz", 0.0)


class Reference(Section):
    """Phase 1 of the two-phase design: the least gains linear in time that meet these."""

    rigid_hz: Positive = optional("natural frequency at every node, Hz (paper, 5.1)", 0.5)
    rigid_zeta: Positive = optional("damping ratio at every node (paper, 5.1)", 0.7)


class DispersedLimits(MarginLimits):
    """Limits of the dispersed plants: half the nominal ones, as is practice."""

    gain_margin_db: Positive = optional("customary: half the nominal one", 3.0)
    phase_margin_deg: Degrees = optional("customary: half the nominal one", 15.0)
    second_mode_db: float = optional("as low as the gain margin asks", -3.0)
    without: tuple[LIMIT_NAMES, ...] = optional("limits that are not asked for", ("rigid_hz", "rigid_zeta"))


class Robust(Spread):
    """Plants other than the nominal one for which the design must hold: half ranges, shares unless a unit is named.

    Every mode and every tank by itself. The defaults are 3-sigma ranges after a modal survey: bending 5, 10, 15 %,
    slopes 20 %. Plants are corners at which all deviate at once: n deviations of one sigma each are sqrt(n) sigma away.
    Where some go together, corners are those of the independent deviations behind them, and as likely.
    """

    where: ClassVar[tuple[str, str]] = ("case", "robust")

    corner_sigmas: Annotated[float, Field(gt=0.0, le=3.0)] = optional("each deviation at a corner, sigma", 2.0)
    bending_damping: Shares = optional("of each mode", 0.0)
    delay_s: NotNegative = optional("either way, s; never below no delay", 0.005)
    rounds: Annotated[int, Field(ge=1, le=50)] = optional(
        "times that the worst plants are searched, added, and the design is made anew", 8
    )
    limits: DispersedLimits = DispersedLimits()


class Search(Section):
    """The optimiser's starts."""

    starts: Annotated[int, Field(ge=1, le=1000)] = optional("number of starts of the whole problem", 8)
    leaps: Annotated[int, Field(ge=0, le=1000)] = optional(
        "leaps from the best end: part of the variables thrown off, and brought down again", 8
    )
    seed: Annotated[int, Field(ge=0)] = optional("of the random ones among them", 1)
    start_design: str | None = optional(
        "design from which one more start begins: a file, a folder that a case has left, or a built-in one"
    )


class StageCase(Section):
    """What differs in a stage: keys that are given replace those of the case."""

    gains: Gains | None = optional("see [gains]")
    filter: Filter | None = optional("see [filter]")
    loop_filters: LoopFilters | None = optional("see [loop_filters]")
    objective: Objective | None = optional("see [objective]")
    limits: Limits | None = optional("see [limits]")
    reference: Reference | None = optional("see [reference]")


class Case(Section):
    """A case file, in designs/cases/."""

    schema_version: Literal[1] = optional("version of the format", 1, alias="schema")
    name: str = optional("name of the case", "")
    description: str = optional("what it is, in a sentence", "")
    scenario: str = Field(description="whose flight gives speed, air and attitude at the nodes")
    plant: Literal["flown", "table2"] = optional(
        "the scenario's vehicle, or with derivatives that span the paper's Table 2", "flown"
    )
    errata: Literal["corrected", "paper"] = optional("the paper's model corrected or as printed", "corrected")
    loop: Literal["pade", "sampled", "exact"] = optional(
        "pade: the paper's continuous model (30 to 32); sampled: as the computer runs it", "sampled"
    )
    plane: Literal["pitch", "yaw"] = optional("plane of the model", "pitch")
    nodes_s: tuple[float, ...] | None = optional(
        "vehicle times at which the limits are checked, s (default: chosen from the flight, in every stage under full "
        "thrust)"
    )
    nodes_per_stage: Annotated[int, Field(ge=1, le=1000)] = optional("where nodes_s is not given", 11)
    stages: tuple[Annotated[int, Field(ge=1, le=MAX_STAGES)], ...] | None = optional(
        "stages to design for, from 1; others fly as the scenario's own design (default: all that have nodes)"
    )
    between_nodes: Literal["ignore", "hold"] = optional(
        "hold: instants between the nodes that are worse by 0.02 dB or 0.1 deg are searched and become nodes, until "
        "none is found; with [robust] for dispersed plants too; ignore: limits at the nodes only, as in the paper",
        "hold",
    )
    law: Law = optional(
        "control law; pd: proportional-derivative with a bending filter; pid: with an integral besides; load-relief: "
        "pd with the lateral acceleration fed back; incidence-relief: pd with an estimated angle of attack fed back",
        "pd",
    )
    blend: Range | None = optional(
        "bounds of the weights of the vehicle's further rate gyros, which are variables (default: the first gyro alone)"
    )
    load_relief: LoadRelief = optional("accelerometer's lag, of both laws of load relief", LoadRelief(corner_hz=1.0))
    wind: Wind | None = optional("absent: no limits of load and drift")
    gains: Gains = Gains()
    filter: Filter = Filter()
    loop_filters: LoopFilters = LoopFilters()
    objective: Objective = Objective()
    limits: Limits = Limits()
    reference: Reference = Reference()
    robust: Robust | None = optional("absent: the nominal plants only")
    search: Search = Search()
    stage: tuple[StageCase, ...] = optional(
        "what differs in each stage, in the order of flight (default: nothing)", (), max_length=MAX_STAGES
    )

    def _check(self) -> None:
        if self.nodes_s is not None:
            _rising(self.nodes_s, "nodes_s")
        if self.blend is not None and not self.blend[0] < self.blend[1]:
            raise refuse("is empty", "two numbers, the lower one first", "blend")
        of_wind = ("q_alpha_Padeg", "drift_mps", "bending_moment")
        objective = {"load": of_wind[0], "bending-moment": of_wind[2]}.get(self.objective.kind)
        if objective is not None and self.wind is None:
            raise refuse("needs a wind", "a table [wind]", ("objective", "kind"))
        small_m = self.objective.stations_m  # a limit of a moment may be about another station
        made_small = small_m is None or any(one.station_m in small_m for one in self.limits.bending_moment)
        for key in of_wind:
            asked = getattr(self.limits, key) not in (None, ())
            if asked and self.wind is None:
                raise refuse("needs a wind", "a table [wind]", ("limits", key))
            if asked and key == objective and made_small:
                raise refuse("is the objective", "no limit of it", ("limits", key))
        if self.bends and self.errata == "paper":
            raise refuse("has no bending moments", "errata = 'corrected'", "errata")
        if self.loop_filters.acceleration is not None and self.law not in RELIEF:
            allowed = f"law = {' or '.join(map(repr, RELIEF))}"
            raise refuse(f"the law {self.law} takes no acceleration", allowed, ("loop_filters", "acceleration"))
        if self.law != "pd" and self.gains.schedule == "two-phase":
            raise refuse("finds gains of the law pd only", "linear, free, nodes", ("gains", "schedule"))
        for name in ("integral_hz", "most_integral_hz"):
            if self.law != "pid" and getattr(self.limits, name) is not None:
                raise refuse(f"the law {self.law} has no integral", "with law = 'pid' only", ("limits", name))
        least, most = self.limits.integral_hz, self.limits.most_integral_hz
        if most is not None and least is not None and most < least:
            raise refuse("is below integral_hz", f"at least {least:g}", ("limits", "most_integral_hz"), value=most)

    @property
    def bends(self) -> bool:
        """Whether bending moments are asked for, of any stage."""
        limits: list[MarginLimits | None] = [self.limits, *(stage.limits for stage in self.stage)]
        limits.append(None if self.robust is None else self.robust.limits)
        objectives = [self.objective, *(stage.objective for stage in self.stage)]
        return any(each is not None and len(each.bending_moment) > 0 for each in limits) or any(
            each is not None and each.kind == "bending-moment" for each in objectives
        )

    def bending_stations_m(self, known: tuple[float, ...]) -> tuple[float, ...]:
        """Of a case of one stage: where moments are asked for, among the stations that the stage has.

        Raises ValueError for others.
        """
        limits = [self.limits, *([] if self.robust is None else [self.robust.limits])]
        asked = {one.station_m for each in limits for one in each.bending_moment}
        asked |= set(self.objective_stations_m(known))
        if not asked <= set(known):
            strange = ", ".join(f"{x:g}" for x in sorted(asked - set(known)))
            raise ValueError(
                f"bending moment at {strange} m: allowed are the stage's loads.stations_m, "
                f"{', '.join(f'{x:g}' for x in known) or 'of which it has none'}"
            )
        return tuple(sorted(asked))

    def objective_stations_m(self, known: tuple[float, ...]) -> tuple[float, ...]:
        """Those where the moment is made small."""
        if self.objective.kind != "bending-moment":
            return ()
        return known if self.objective.stations_m is None else self.objective.stations_m

    @property
    def times_s(self) -> tuple[float, ...]:
        """Nodes of a case of one stage (`optimise.solve.each_stage`)."""
        assert self.nodes_s is not None
        return self.nodes_s

    def of_stage(self, number: int, nodes_s: tuple[float, ...]) -> Case:
        """The case of one stage, from 0. Raises ValidationError where what differs does not go with the rest."""
        own = self.stage[number] if number < len(self.stage) else StageCase()
        changed = _laid_over(self, own).model_copy(update={"stage": (), "stages": None, "nodes_s": nodes_s})
        return type(self).model_validate({k: v for k, v in dict(changed).items() if k != "schema_version"})


def _laid_over(below: Model, over: Section) -> Model:
    """A section with the keys that another one says, sections within it likewise."""
    update = {}
    for key in over.model_fields_set:
        mine, value = getattr(below, key), getattr(over, key)
        update[key] = _laid_over(mine, value) if isinstance(mine, Section) and isinstance(value, Section) else value
    return below.model_copy(update=update)


@dataclass(frozen=True)
class LoadedCase:
    """A case and its scenario. `flight`: gives the operating points, by default the scenario with its own design."""

    case: Case
    label: str
    scenario: LoadedScenario
    start: Design | None = None  # `search.start_design`
    flight: LoadedScenario | None = None

    @property
    def name(self) -> str:
        return self.case.name

    @property
    def along(self) -> LoadedScenario:
        """The scenario with the design whose flight gives the operating points."""
        return self.flight or self.scenario


def read_case(name: str | Path, overrides: Iterable[str] = ()) -> LoadedCase:
    """The case in a file, or the built-in one of that name, with `key=value` overrides. Raises ScenarioError.

    Its scenario is one beside the case, or as `load_scenario` finds it.
    """
    case, tree, file, label = load_file(Case, "case", name, overrides)
    given = tree.get("scenario")
    beside = find(given, ("{}", "{}.toml")) if isinstance(given, Text) else None
    campaign = tree.get("robust", {}).get("campaign")
    there = find(campaign, ("{}", "{}.toml")) if isinstance(campaign, Text) else None
    if case.robust is not None and there is not None:
        case = case.model_copy(update={"robust": case.robust.model_copy(update={"campaign": shown(there)})})
    try:
        flown = beside if beside is not None and beside != file else case.scenario
        scenario = load_scenario(flown)
        if case.bends:  # its masses along the body are the vehicle's
            load_scenario(flown, ["switches.section_loads=true"])
    except ScenarioError as error:
        if error.file == case.scenario:  # the name itself is wrong
            source, allowed = tree.sources.get("scenario", tree.source), error.allowed
            layout = Path(case.scenario).parts[0]
            if layout in builtin_files("layout"):
                allowed = f"what 'simvehicle {layout} --out {layout}' writes here, first"
            raise source.error(("scenario",), error.problem, value=case.scenario, allowed=allowed) from None
        raise
    return LoadedCase(case, label, scenario, _start_design(case, tree, scenario))


def _start_design(case: Case, tree: Any, scenario: LoadedScenario) -> Design | None:
    name = case.search.start_design
    if name is None:
        return None
    path = find(tree["search"]["start_design"], ("{}/design.toml", "{}"))
    at = f"designs/{name.removesuffix('.toml')}.toml" if path is None else path.as_posix()
    try:
        return load_scenario(scenario.label, [f'design="{at}"']).design
    except ScenarioError as error:
        source = tree["search"].sources.get("start_design", tree.source)
        problem, allowed = error.problem, error.allowed or "a design file (.toml), or a built-in design"
        raise source.error(("search", "start_design"), problem, value=name, allowed=allowed) from None
