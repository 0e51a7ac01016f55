"""The schema of case files, and the functions that read them.

A case defines the optimisation problem of Lee, Ahn & Roh, equations (42) to (50), with extensions.

    loaded = read_case("ksr3-identical", ["filter.structure='F6'"])

The paper does not give the values of its limits and bounds. The description of each key states the assumed value and
the reason.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, TypeVar

from pydantic import Field

from maxq.control.kernel.limits import MAX_STAGES
from maxq.control.structures import INTEGRAL, MAX_SECTIONS, RELIEF, STRUCTURES, DesignedStructure, Law, Over
from maxq.design.case.basis import (
    BETWEEN,
    WIND_KEYS,
    Basis,
    BetweenNodes,
    BetweenTimes,
    DesignLimits,
    Limits,
    LoadLimits,
    Robust,
    check_range,
    check_rising,
    limit_of,
)
from maxq.design.case.goals import GoalSection
from maxq.design.model.given_file import GivenPoints, PointList, read_points
from maxq.sim.input.documents import Text
from maxq.sim.input.errors import ScenarioError, refuse
from maxq.sim.input.files import builtin_files, find, named_in_file
from maxq.sim.input.values import Positive, Section, at_time, optional
from maxq.sim.scenario.flight_code import PlugIn
from maxq.sim.scenario.loader import LoadedScenario, load_file, load_scenario, read_design
from maxq.sim.scenario.schema_design import LAW_TEXT, PLUG_IN_TEXT, Design, LoadReliefSection, check_plug_in

ObjectiveName = Literal["first-mode-peak", "least-margin", "load", "bending-moment", "goals"]
"""The keys of `design.optimise.criteria.OBJECTIVES`."""

Model = TypeVar("Model", bound=Section)
CORNER = 0.1  # default corner of the integral relative to the lowest rigid-body frequency


class CaseGains(Section):
    """The gain schedules."""

    schedule: Literal["two-phase", "linear", "free", "nodes"] = optional(
        "two-phase: the smallest linear gains that meet [reference], found before the filter (paper, 5.1); linear: "
        "values at the first and last operating point, or at the extremes of the scheduling variable (Subcase 1); "
        "free: at every operating point (Subcase 2); nodes: at nodes_s, or nodes",
        "linear",
    )
    over: Over = optional("scheduling variable, named as the column of a design's table", "time_s")
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
            check_rising(self.needs(mine, 'schedule is "nodes"', f"rising {unit}"), mine)


class FilterBounds(Section):
    """The bounds of the filter variables (50), with frequencies in Hz. The paper gives none.

    The bounds affect the result. The lowest frequencies are well above the crossover of the rigid body. Lower
    frequencies would change the gains that (35) and (36) assume, and an optimiser would exploit this. With roots from
    1 Hz, F4 became a lag network with an objective 8 dB lower.
    """

    zero_hz: BetweenTimes = optional("zeros of quadratic sections; from twice the crossover", (3.0, 100.0))
    zero_zeta: BetweenTimes = optional(
        "a notch of 0.01 is optimal in the model but sensitive; one of 0.1 keeps 10 of its 14 dB for a mode 10 % off",
        (0.1, 1.2),
    )
    pole_hz: BetweenTimes = optional("poles of quadratic sections; from twice the crossover", (3.0, 100.0))
    pole_zeta: BetweenTimes = optional(
        "below 0.3 a filter amplifies by more than 4 dB at its resonance; above 1 the roots are real", (0.3, 1.2)
    )
    first_order_zero_hz: BetweenTimes = optional("zeros of first-order sections", (2.0, 200.0))
    first_order_pole_hz: BetweenTimes = optional("poles of first-order sections", (2.0, 200.0))

    def _check(self) -> None:
        for key in type(self).model_fields:
            check_range(getattr(self, key), key, 0.0)


class FilterSections(Section):
    """The structure of a filter, as numbers of sections."""

    structure: DesignedStructure = optional(
        "F2 to F6: of the paper (37 to 41); sections: numbers given by quadratic and first_order", "F4"
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
        """Return the numbers of quadratic and first-order sections."""
        return STRUCTURES.get(self.structure, (self.quadratic or 0, self.first_order or 0))


class CaseFilter(FilterSections):
    """The structure, schedule and bounds of the bending filter."""

    prewarp_hz: Positive | None = optional(
        "frequency at which the discrete filter equals the continuous one, Hz (default: mean frequency of mode 1)"
    )
    nodes_s: tuple[float, ...] | None = optional(
        "vehicle times of the points of a filter schedule, s; with gains over time (default: a constant filter)"
    )
    nodes: tuple[float, ...] | None = optional(
        "points of a filter schedule over gains.over, in its unit; with gains not over time"
    )
    bounds: FilterBounds = FilterBounds()

    def _check(self) -> None:
        super()._check()
        for key in ("nodes_s", "nodes"):
            if getattr(self, key) is not None:
                check_rising(getattr(self, key), key)


class CaseLoopFilters(Section):
    """The filters of the law's inputs, one for each loop, with the bounds and the prewarping of [filter]."""

    attitude: FilterSections | None = optional("filter of the attitude error")
    rate: FilterSections | None = optional("filter of the (blended) rate")
    acceleration: FilterSections | None = optional("load relief: filter of the lateral acceleration before its lag")

    @property
    def each(self) -> tuple[tuple[int, int], ...]:
        """Return the numbers of quadratic and first-order sections of each filter."""
        return tuple((0, 0) if f is None else f.sections for f in (self.attitude, self.rate, self.acceleration))


class ObjectiveSection(Section):
    """The quantity that a design optimises."""

    renamed: ClassVar[dict[str, str]] = {"band": ""}

    kind: ObjectiveName = optional(
        "over all operating points; first-mode-peak: smallest peak of mode 1 (42); least-margin: largest least "
        "|1 + L|, for plants whose mode 1 varies too much for a notch; load, bending-moment: smallest rms of q alpha, "
        "or of the bending moment, in the wind of [wind], with drift and margins as limits; goals: the soft ones of "
        "[[goal]]",
        "first-mode-peak",
    )
    combine: Literal["sum", "largest"] | None = optional(
        "goals: minimise the weighted sum of the soft goals in dB, each at its worst operating point, or the largest "
        "(default: sum)"
    )
    stations_m: tuple[float, ...] | None = optional(
        "stations of the bending moment to minimise, of the stage's loads.stations_m (default: all); with "
        "bending-moment"
    )

    def _check(self) -> None:
        self.only_with(("stations_m",), self.kind == "bending-moment", 'kind = "bending-moment"')
        self.only_with(("combine",), self.kind == "goals", 'kind = "goals"')
        if self.stations_m is not None:
            check_rising(self.stations_m, "stations_m")


class ReferencePhase(Section):
    """The limits of phase 1 of the two-phase design, which finds the smallest gains, linear in time, that meet them."""

    rigid_hz: Positive = optional("natural frequency at every operating point, Hz (paper, 5.1)", 0.5)
    rigid_zeta: Positive = optional("damping ratio at every operating point (paper, 5.1)", 0.7)


class SearchSettings(Section):
    """The settings of the optimiser's search."""

    starts: Annotated[int, Field(ge=1, le=1000)] = optional("number of starts of the whole problem", 8)
    leaps: Annotated[int, Field(ge=0, le=1000)] = optional(
        "restarts from the best result, with a part of the variables perturbed", 8
    )
    seed: Annotated[int, Field(ge=0)] = optional("seed of the random starts", 1)
    start_design: str | None = optional(
        "design for an additional start: a file, a results folder of a case, or a built-in one"
    )


class VariableSection(Section):
    """A variable, or several of one kind, that the case fixes or bounds."""

    name: str = Field(
        description="a variable (k_p at 35 s), all of a kind (k_p, quadratic[0].zero_hz), a section (quadratic[0]), or "
        "gains, filter, blend; a later entry has priority"
    )
    value: float | None = optional("fixed value: Hz, damping ratio, gain or weight")
    bounds: BetweenTimes | None = optional("bounds, in the same unit")
    from_start: Literal[True] | None = optional("true: fixed at the values of search.start_design")

    def _check(self) -> None:
        given = [key for key in ("value", "bounds", "from_start") if getattr(self, key) is not None]
        if len(given) != 1:
            raise refuse("has none or several of value, bounds, from_start", "one of them", "name")
        if self.bounds is not None and not self.bounds[0] < self.bounds[1]:
            raise refuse("is empty", "two numbers, the lower one first; value fixes a variable", "bounds")

    @property
    def ends(self) -> tuple[float, float]:
        """Return the bounds. They are equal for a fixed value."""
        assert self.from_start is None, "replaced by its values in `solve`"
        return self.bounds if self.bounds is not None else (self.value or 0.0, self.value or 0.0)


class StageCase(Section):
    """The keys that replace those of the case in one stage."""

    gains: CaseGains | None = optional("see [gains]")
    filter: CaseFilter | None = optional("see [filter]")
    loop_filters: CaseLoopFilters | None = optional("see [loop_filters]")
    objective: ObjectiveSection | None = optional("see [objective]")
    limits: Limits | None = optional("see [limits]")
    reference: ReferencePhase | None = optional("see [reference]")
    robust: Robust | None = optional("see [robust]; without a [robust] of the case, this stage alone is robust")
    variable: tuple[VariableSection, ...] | None = optional("see [[variable]]")
    goal: tuple[GoalSection, ...] | None = optional("see [[goal]]")


class CaseHead(Section):
    """The head of a case file."""

    schema_version: Literal[2] = optional("version of the format", 2, alias="schema")
    name: str = optional("name of the case", "")
    description: str = optional("description, one sentence", "")


class Case(Basis, CaseHead):
    """The contents of a case file (designs/cases/)."""

    earlier: ClassVar[dict[str, str]] = {"between_nodes": "ignore"}

    scenario: str = optional(
        "scenario whose flight gives speed, air and attitude at the operating points; needed without points", ""
    )
    between_nodes: BetweenNodes = optional(BETWEEN, "hold")
    limits: Limits = Limits()
    nodes_per_stage: Annotated[int, Field(ge=1, le=1000)] = optional(
        "number of operating points in each burn of a stage without nodes_s", 11
    )
    stages: tuple[Annotated[int, Field(ge=1, le=MAX_STAGES)], ...] | None = optional(
        "stages to design, from 1; others use the scenario's design (default: all with operating points)"
    )
    law: Law = optional(LAW_TEXT, "pd")
    plug_in: PlugIn | None = optional(PLUG_IN_TEXT)
    blend: BetweenTimes | None = optional(
        "bounds of the weights of the vehicle's further rate gyros, which are variables (default: the first gyro alone)"
    )
    load_relief: LoadReliefSection = optional(
        "accelerometer lag of both load-relief laws", LoadReliefSection(corner_hz=1.0)
    )
    gains: CaseGains = CaseGains()
    filter: CaseFilter = CaseFilter()
    loop_filters: CaseLoopFilters = CaseLoopFilters()
    objective: ObjectiveSection = ObjectiveSection()
    reference: ReferencePhase = ReferencePhase()
    search: SearchSettings = SearchSettings()
    variable: tuple[VariableSection, ...] = optional("variables of the law to fix or to bound (default: none)", ())
    stage: tuple[StageCase, ...] = optional(
        "keys that differ by stage, in the order of flight (default: none)", (), max_length=MAX_STAGES
    )

    def _check(self) -> None:
        super()._check()
        check_plug_in(self)
        if self.law == "own" and self.loop != "sampled":
            raise refuse("has no continuous form of the law own", "sampled", "loop")
        if (self.points is None) == (self.scenario == ""):
            raise refuse("names both a flight and points, or neither", "one of scenario, points", "scenario")
        robust: list[tuple[Robust | None, tuple[str | int, ...]]] = [(self.robust, ("robust",))]
        robust += [(stage.robust, ("stage", n, "robust")) for n, stage in enumerate(self.stage)]
        for given, at in robust:
            if self.points is not None and given is not None:
                raise refuse("deviates from a vehicle, which points do not have", "scenario in place of points", at)
        if self.blend is not None and not self.blend[0] < self.blend[1]:
            raise refuse("is empty", "two numbers, the lower one first", "blend")
        objective = {"load": WIND_KEYS[0], "bending-moment": WIND_KEYS[2]}.get(self.objective.kind)
        if objective is not None and self.wind is None:
            raise refuse("needs a wind", "a table [wind]", ("objective", "kind"))
        small_m = self.objective.stations_m  # a limit on a moment may apply to another station
        made_small = small_m is None or any(one.station_m in small_m for one in self.limits.bending_moment)
        if objective is not None and made_small and getattr(self.limits, objective) not in (None, ()):
            raise refuse("is the objective", "no limit of it", ("limits", objective))
        if self.loop_filters.acceleration is not None and self.law not in RELIEF:
            allowed = f"law = {' or '.join(map(repr, RELIEF))}"
            raise refuse(f"the law {self.law} takes no acceleration", allowed, ("loop_filters", "acceleration"))
        absent = "nodes" if self.gains.over == "time_s" else "nodes_s"
        if getattr(self.filter, absent) is not None:
            allowed = "nodes_s" if absent == "nodes" else f"nodes, over {self.gains.over}"
            raise refuse(f"the gains are over {self.gains.over}", allowed, ("filter", absent))
        soft = [one for one in self.goal if not one.hard]
        if bool(soft) != (self.objective.kind == "goals"):
            problem = "has no soft goal" if not soft else "does not include the soft goals"
            allowed = "a [[goal]] with a weight" if not soft else "goals, or [[goal]] without weight"
            raise refuse(problem, allowed, ("objective", "kind"))
        for one in soft:
            if one.quantity in WIND_KEYS and self.wind is None:
                raise refuse("needs a wind", "a table [wind]", "goal")
            if one.quantity in WIND_KEYS and getattr(self.limits, one.quantity) is not None:
                raise refuse("is a soft goal", "no limit of it", ("limits", one.quantity))
        if self.search.start_design is None and any(one.from_start for one in self.variable):
            raise refuse("needs a start design", "search.start_design", "variable")
        if self.law != "pd" and self.gains.schedule == "two-phase":
            raise refuse("finds gains of the law pd only", "linear, free, nodes", ("gains", "schedule"))
        for name in ("integral_hz", "most_integral_hz"):
            if self.law not in INTEGRAL and getattr(self.limits, name) is not None:
                raise refuse(
                    f"the law {self.law} has no integral", "with law = 'pid' or 'pid-drift' only", ("limits", name)
                )

    @property
    def bends(self) -> bool:
        """Return True if bending moments are limited or are the objective in any stage."""
        limits: list[LoadLimits] = [stage.limits for stage in self.stage if stage.limits is not None]
        objectives = [self.objective, *(stage.objective for stage in self.stage if stage.objective is not None)]
        limits += [stage.robust.limits for stage in self.stage if stage.robust is not None]
        asked = any(each.bending_moment for each in limits) or any(o.kind == "bending-moment" for o in objectives)
        return asked or super().bends

    def _stations_m(self, known: tuple[float, ...]) -> set[float]:
        return super()._stations_m(known) | set(self.objective_stations_m(known))

    def objective_stations_m(self, known: tuple[float, ...]) -> tuple[float, ...]:
        """Return the stations at which the bending moment is minimised, among the stations `known` of a stage."""
        if self.objective.kind != "bending-moment":
            return ()
        return known if self.objective.stations_m is None else self.objective.stations_m

    @property
    def soft_goals(self) -> dict[int, GoalSection]:
        """Return the soft goals by their term of the objective. With `largest`, all belong to term 0 (`term_of`)."""
        return dict(enumerate(one for one in self.goal if not one.hard))

    def term_of(self, number: int) -> int:
        """Return the term of the objective to which soft goal `number` belongs."""
        return 0 if self.objective.combine == "largest" else number

    def integral_hz(self, times_s: Any) -> float:
        """Return the lowest corner frequency (Hz) of the integral of a law with an integral, at vehicle times (s)."""
        least = self.limits.integral_hz
        return CORNER * float(at_time(self.limits.rigid_hz, times_s).min()) if least is None else least

    def basis(self, scenario: str, nodes_s: tuple[float, ...]) -> Basis:
        """Return the basis of a design of this case, with the imposed limits at the operating points of one stage.

        The limits of a two-phase design include the rigid-body motion of [reference]. `scenario` is the name of the
        scenario.
        """
        stated = {key: limit_of(self.limits, key) for key in DesignLimits.model_fields}
        if self.gains.schedule == "two-phase":
            stated |= {key: getattr(self.reference, key) for key in ("rigid_hz", "rigid_zeta")}
        if self.law in INTEGRAL:
            stated["integral_hz"] = self.integral_hz(nodes_s)
        given = {key: getattr(self, key) for key in Basis.model_fields}
        # a function remains with the case
        given["goal"] = tuple(one for one in self.goal if one.hard and one.quantity != "function")
        return Basis(**given | {"scenario": scenario, "nodes_s": nodes_s, "limits": DesignLimits(**stated)})

    @property
    def times_s(self) -> tuple[float, ...]:
        """Return the vehicle times (s) of the operating points of a case with one stage (`solve.each_stage`)."""
        assert self.nodes_s is not None
        return self.nodes_s

    def of_stage(self, number: int, nodes_s: tuple[float, ...]) -> Case:
        """Return the case of one stage, counted from 0.

        Raises ValidationError if the keys of the stage are incompatible with the others.
        """
        own = self.stage[number] if number < len(self.stage) else StageCase()
        changed = _laid_over(self, own).model_copy(update={"stage": (), "stages": None, "nodes_s": nodes_s})
        return type(self).model_validate({k: v for k, v in dict(changed).items() if k != "schema_version"})


def _laid_over(below: Model, over: Section) -> Model:
    """Return a section with keys replaced by those set in another section, recursively for nested sections."""
    update = {}
    for key in over.model_fields_set:
        mine, value = getattr(below, key), getattr(over, key)
        update[key] = _laid_over(mine, value) if isinstance(mine, Section) and isinstance(value, Section) else value
    return below.model_copy(update=update)


@dataclass(frozen=True)
class LoadedCase:
    """A case, with its scenario or its points.

    `flight` provides the operating points. The default is the scenario with its own design.
    """

    case: Case
    label: str
    base: LoadedScenario | None
    start: Design | None = None  # `search.start_design`
    flight: LoadedScenario | None = None
    points: GivenPoints | PointList | None = None

    @property
    def name(self) -> str:
        return self.case.name

    @property
    def scenario(self) -> LoadedScenario:
        """Return the scenario. Raises ValueError for a case of points, which has no scenario."""
        if self.base is None:
            raise ValueError("the case has points in place of a scenario: it has no vehicle and no flight")
        return self.base

    @property
    def along(self) -> LoadedScenario:
        """Return the scenario with the design whose flight provides the operating points."""
        return self.flight or self.scenario


def read_case(name: str | Path, overrides: Iterable[str] = ()) -> LoadedCase:
    """Return the case in a file, or the built-in case of that name, with `key=value` overrides. Raises ScenarioError.

    The scenario is first searched for in the folder of the case, then as in `load_scenario`.
    """
    case, tree, file, label, _ = load_file(Case, "case", name, overrides)
    case = _with_functions(case, file.parent)
    if case.points is not None:
        found = find(Text.of(case.points, tree.sources.get("points", tree.source)), ("{}", "{}.toml"))
        known = case.points in builtin_files("points") or found is None
        points = read_points(case.points if known else str(found))
        start = case.search.start_design
        return LoadedCase(case, label, None, None if start is None else read_design(start), points=points)
    given = tree.get("scenario")
    flown = named_in_file(given, file) if isinstance(given, Text) else case.scenario
    stages = [_beside(own, given, file) for own, given in zip(case.stage, tree.get("stage", ()), strict=True)]
    case = _beside(case, tree, file).model_copy(update={"stage": tuple(stages)})
    try:
        scenario = load_scenario(flown)
        if case.bends:  # checks that the vehicle has its masses along the body
            load_scenario(flown, ["switches.section_loads=true"])
    except ScenarioError as error:
        if error.file == case.scenario:  # the name itself is invalid
            source, allowed = tree.sources.get("scenario", tree.source), error.allowed
            layout = Path(case.scenario).parts[0]
            if layout in builtin_files("layout"):
                allowed = f"what 'simvehicle {layout} --out {layout}' writes here, first"
            raise source.error(("scenario",), error.problem, value=case.scenario, allowed=allowed) from None
        raise
    named = case.model_copy(update={"scenario": flown})
    return LoadedCase(named, label, scenario, _start_design(case, tree, scenario))


def _beside(of: Model, tree: Any, file: Path) -> Model:
    """Return a case or its stage with the path of the campaign of its [robust], which is in the folder of the file."""
    robust, campaign = getattr(of, "robust", None), tree.get("robust", {}).get("campaign")
    if robust is None or not isinstance(campaign, Text):
        return of
    return of.model_copy(update={"robust": robust.model_copy(update={"campaign": named_in_file(campaign, file)})})


def _with_functions(case: Case, folder: Path) -> Case:
    """Return the case with the files of its goals' functions in its folder."""
    stages = [one.model_copy(update={"goal": _with_paths(one.goal, folder)}) if one.goal else one for one in case.stage]
    return case.model_copy(update={"goal": _with_paths(case.goal, folder), "stage": tuple(stages)})


def _with_paths(goals: Iterable[GoalSection], folder: Path) -> tuple[GoalSection, ...]:
    return tuple(one.beside(folder) if one.function else one for one in goals)


def _start_design(case: Case, tree: Any, scenario: LoadedScenario) -> Design | None:
    name = case.search.start_design
    if name is None:
        return None
    known = name in builtin_files("design")
    path = None if known else find(tree["search"]["start_design"], ("{}/design.toml", "{}"))
    at = f"designs/{name.removesuffix('.toml')}.toml" if path is None else path.as_posix()
    try:
        return load_scenario(scenario.label, [f'design="{at}"']).design
    except ScenarioError as error:
        source = tree["search"].sources.get("start_design", tree.source)
        problem, allowed = error.problem, error.allowed or "a design file (.toml), or a built-in design"
        raise source.error(("search", "start_design"), problem, value=name, allowed=allowed) from None
