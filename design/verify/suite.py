"""The sections of a suite, its reader, and the form of the results: requirements with their verdicts.

    suite = read_suite("standard")

Every mistake in a file is reported as a ScenarioError of one line.
"""

from __future__ import annotations

import math
import re
import shlex
import tomllib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from itertools import product
from pathlib import Path
from string import Template
from typing import Annotated, Any, Literal

from pydantic import Field

from maxq.design.model.node_times import EDGES, NODES_PER_STAGE
from maxq.design.model.spread import RelativeDeviation, Spread
from maxq.design.quantities import MEASURED, SWEPT, LoopLimits, violation
from maxq.design.verify.board import BoardSection
from maxq.sim.campaign.schema import Campaign, campaign_title
from maxq.sim.campaign.statistics import MET, NOT_MET
from maxq.sim.input.documents import Text
from maxq.sim.input.errors import ScenarioError, refuse, suggestion
from maxq.sim.input.files import builtin_files, find, named_in_file
from maxq.sim.input.values import NotNegative, Positive, Section, optional
from maxq.sim.scenario.loader import load_file
from maxq.sim.scenario.schema_scenario import Scenario

SuiteVerdict = Literal["accepted", "accepted with waivers", "passed screening", "rejected", "undecided"]
ACCEPTED: SuiteVerdict = "accepted"
WAIVED: SuiteVerdict = "accepted with waivers"  # every missed requirement is waived
SCREENED: SuiteVerdict = (
    "passed screening"  # every requirement is met, but the evidence is below the floor of an acceptance
)
REJECTED: SuiteVerdict = "rejected"
UNDECIDED: SuiteVerdict = "undecided"


@dataclass(frozen=True)
class JudgedRequirement:
    """A requirement with its verdict.

    `part` is the method: "scenarios", "margins", "dispersed", "authority", "certificate" or "campaign". `wanted` and
    `found` are texts. `room` is the relative margin to the limit, negative beyond it, and NaN if it has no meaning.
    `where` is an operating point or a run. `again` is the command that reproduces the result. `waived` is the waiver in
    force of a rejected requirement (`waivers`).
    """

    part: str
    name: str
    wanted: str
    found: str
    judgement: SuiteVerdict
    room: float
    where: str = ""
    more_runs: int = 0
    again: str = ""
    waived: str = ""

    @property
    def reason(self) -> str:
        """Return the reason for the verdict as one line of text."""
        said = f"{self.name}: {self.found}, required {self.wanted}" + (f" ({self.where})" if self.where else "")
        said += f"; waived by {self.waived}" if self.waived else ""
        if self.judgement != UNDECIDED:
            return said
        more = self.more_runs
        return f"{said}; " + (f"{more} more run{'s' * (more != 1)} needed" if more else "undecided")


def overall(requirements: Iterable[JudgedRequirement], missing_evidence: Iterable[str] = ()) -> SuiteVerdict:
    """Return the verdict on all requirements.

    It is rejected if any requirement is rejected, or else undecided if any is undecided or there is no requirement.
    Otherwise it is accepted, with waivers if a rejected requirement is waived. If evidence is missing
    (`floor.missing_evidence`), it is a passed screening instead, and waivers have no effect.
    """
    screening = any(missing_evidence)
    found = {WAIVED if r.waived and r.judgement == REJECTED and not screening else r.judgement for r in requirements}
    found = found or {UNDECIDED}
    passed = SCREENED if screening else WAIVED if WAIVED in found else ACCEPTED
    return REJECTED if REJECTED in found else UNDECIDED if UNDECIDED in found else passed


def judgement_of(shown: str) -> SuiteVerdict:
    """Return the verdict that corresponds to the result of a statistical test (`sim.campaign.statistics`)."""
    return ACCEPTED if shown == MET else REJECTED if shown == NOT_MET else UNDECIDED


def room_left(value: float, bound: float, sense: str, unit: str = "") -> float:
    """Return the relative margin to a bound, negative beyond it, and NaN for a bound of zero.

    `sense` is "<=" or ">=". `unit` is the unit of a stability margin. A margin that is met within the tolerance of
    `violation` has at least zero room.
    """
    if bound == 0.0:
        return math.nan
    left = (bound - value if sense == "<=" else value - bound) / abs(bound)
    return max(left, 0.0) if unit and violation(value, bound, sense, unit) <= 0.0 else left


AS_DESIGNED, CERTIFICATE, WORST = "as designed", "certificate", "worst"
VEHICLE_LABEL = re.compile(r"corner [1-9][0-9]*|vehicle (0|[1-9][0-9]*)")
SuiteProbability = Annotated[float, Field(gt=0.0, lt=1.0)]
Plane = Literal["pitch", "yaw"]


class DispersedLimit(Section):
    """A limit for dispersed flights, which replaces the limit of the scenario."""

    requirement: str = Field(description="name of the scenario's requirement")
    limit: float | str = Field(
        description="largest value allowed, in the metric's unit; ${MARK * NUMBER} as in a flight"
    )
    why: str = Field(description="the engineering reason, shown in the review pack")

    def _check(self) -> None:
        if not self.why.strip():
            raise refuse("a limit without a reason", "the engineering reason, in words", "why")


Each = dict[str, Annotated[tuple[float | str, ...], Field(min_length=1)]]


class SuiteFlight(Section):
    """A flight of the suite: the base scenario with changes and requirements."""

    name: str = Field(description="name in reports")
    each: Each = optional(
        "a flight for each of these values (for each combination of several keys), which replace $KEY in name and set",
        {},
    )
    why: str = optional("purpose, one sentence", "")
    scenario: str | None = optional("base scenario (default: the suite's)")
    set: tuple[str, ...] = optional(
        "changes, key=value as with simrun --set; * in a key stands for each element of a list, $MARK or "
        "${MARK + NUMBER} for a value from the flight of the suite's scenario (docs/simverify.md)",
        (),
    )
    scale: dict[str, float | str] = optional("changes: key and factor on its value; * as in set", {})
    add: dict[str, float | str] = optional("changes: key and value to add; * as in set", {})
    each_stage: bool = optional("a flight for each stage that burns, with the marks of that stage", False)
    limits: Literal["own", "dispersed"] = optional(
        "the scenario's own limits, or those of [[dispersed_limit]] where there is one", "own"
    )
    design_must_keep: bool = optional("false: flown and reported, but not required", True)
    probability: SuiteProbability | None = optional("probability of the fault, of a flight with one (docs/verdicts.md)")

    def _check(self) -> None:
        for key in self.each:
            if f"${key}" not in self.name:
                raise refuse(f"does not distinguish the flights of ${key}", f"a name with ${key}", "name")

    def flights(self) -> list[SuiteFlight]:
        """Return a flight for each combination of the values in `each`, or this flight alone without such values."""
        out = []
        for values in product(*self.each.values()):
            said = dict(zip(self.each, (f"{v:g}" if isinstance(v, float) else v for v in values), strict=True))

            def filled(text: Any, said: dict[str, Any] = said) -> Any:
                return Template(text).safe_substitute(said) if isinstance(text, str) else text

            shown = {key: str(value).replace("_", " ") for key, value in said.items()}
            update = {"name": filled(self.name, shown), "set": tuple(filled(text) for text in self.set), "each": {}}
            for key in ("scale", "add"):
                update[key] = {filled(path): filled(by) for path, by in getattr(self, key).items()}
            out.append(self.model_copy(update=update))
        return out


TIMES = "vehicle times, s (default: chosen from the flight, in every stage)"


class WorstWanted(Section):
    """A search for the worst vehicle within the dispersions, with independent modes and tanks, and a flight of it."""

    sigmas: Positive = optional("limit of the search, sigma", 3.0)
    region: Literal["ellipsoid", "box"] = optional(
        "ellipsoid: all deviations together as unlikely as one of this many sigma; box: each up to this many",
        "ellipsoid",
    )
    starts: Annotated[int, Field(ge=1, le=1000)] = optional(
        "searches at each of the worst operating points; all others have one", 12
    )
    seed: Annotated[int, Field(ge=0, lt=2**63)] = optional("seed of the starts", 1)
    modulus: Positive | None = optional("least |1 + L| of the worst vehicle found")
    bound: bool = optional(
        "also compute the deviation, in sigma each, up to which no vehicle is unstable at the worst operating point "
        "(structured singular value)",
        False,
    )
    together: bool = optional("the same for pitch, yaw and roll together, coupled as in the simulator", False)


class LinearMargins(Section):
    """The margins of the exact sampled loop, as designed and dispersed."""

    times_s: tuple[NotNegative, ...] | None = optional(TIMES, min_length=1)
    nodes_per_stage: Annotated[int, Field(ge=1, le=1000)] = optional(
        "number of operating points in each burn of a stage without times_s", NODES_PER_STAGE
    )
    edges: tuple[RelativeDeviation, RelativeDeviation] = optional(
        "shares of a stage's burn at its start (on the pad) and end without such operating points", EDGES
    )
    between_nodes: Literal["ignore", "hold"] = optional(
        "hold: the instant between the operating points with the worst nominal margin becomes an operating point, if "
        "it is worse than all others",
        "hold",
    )
    planes: tuple[Plane, ...] = optional("pitch, yaw", ("pitch",), min_length=1)
    cases: Annotated[int, Field(ge=0, le=100000)] = optional("number of random vehicles", 150)
    trajectories: Annotated[int, Field(ge=0, le=1000)] = optional(
        "number of dispersed flights (runs of the suite's first campaign) that give speed, air and attitude of the "
        "random vehicles in turn; 0: the flight as designed",
        0,
    )
    only: str = optional("'as designed', 'corner N' or 'vehicle N': measure only this one", "")
    seed: Annotated[int, Field(ge=0, lt=2**63)] = optional("seed of the random vehicles", 1)
    success: SuiteProbability = optional("share of random vehicles that must meet the dispersed limits", 0.975)
    confidence: SuiteProbability = optional("required confidence", 0.90)
    why: str = optional("the reason for this level and confidence, shown in the review pack", "")
    corner_sigmas: NotNegative = optional(
        "deviation of every factor at the corners of the screening design, in sigma; 0: no corners. Twelve "
        "factors at 1.5 sigma together are as unlikely as one at 5",
        1.5,
    )
    nominal: LoopLimits = LoopLimits()
    dispersed: LoopLimits = LoopLimits()
    three_sigma: Spread = Spread()
    worst: WorstWanted | None = optional("absent: not searched")

    def _check(self) -> None:
        for key in MEASURED:
            if key not in SWEPT and getattr(self.dispersed, key) is not None:
                allowed = f"limits on {', '.join(SWEPT)}"
                raise refuse("is not measured of dispersed vehicles", allowed, ("dispersed", key))


class CertificateWanted(Section):
    """The operating points at which the certificate measures the loop and its margins in flight."""

    times_s: tuple[NotNegative, ...] | None = optional(TIMES, min_length=1)
    nodes_per_stage: Annotated[int, Field(ge=1, le=1000)] = optional(
        "number of operating points in each burn of a stage without times_s", NODES_PER_STAGE
    )
    planes: tuple[Plane, ...] = optional("pitch, yaw", ("pitch", "yaw"), min_length=1)
    in_flight: bool = optional(
        "also measure in the ascent, where thrust lasts for some seconds before and after the time", True
    )


class CampaignWanted(Section):
    """A campaign with its required confidence."""

    file: str = Field(description="a campaign file, or the name of a built-in one")
    name: str = optional("name in reports (default: the campaign's)", "")
    why: str = optional("the reason for its level and confidence, shown in the review pack", "")
    set: tuple[str, ...] = optional("changes, key=value as with simrun --set", ())
    limits: Literal["own", "dispersed"] = optional("as for a flight", "own")
    runs: Annotated[int, Field(gt=0)] | None = optional("default: the campaign's")
    seed: Annotated[int, Field(ge=0, lt=2**63)] | None = optional("default: the campaign's")
    availability: SuiteProbability | None = optional(
        "replaces the separate requirements: share of the flights in each month's winds that must meet all of them"
    )
    success: SuiteProbability | None = optional("default: the campaign's")
    confidence: SuiteProbability | None = optional("default: the campaign's")


class Suite(Section):
    """The contents of a suite file."""

    schema_version: Literal[2] = optional("version of the format", 2, alias="schema")
    name: str = optional("default: the file's name", "")
    description: str = optional("purpose, one sentence", "")
    scenario: str = optional("base of the scenarios, and flight of the operating points", "nominal")
    every: tuple[str, ...] = optional("changes of every flight, as in set", ())
    limit_wind: str | None = optional("wind profile (CSV) for $limit_wind")
    flight: tuple[SuiteFlight, ...] = optional("scenarios, each with its requirements", ())
    margins: LinearMargins | None = optional("absent: not required")
    certificate: CertificateWanted | None = optional("absent: not required")
    campaign: tuple[CampaignWanted, ...] = optional("campaigns", ())
    dispersed_limit: tuple[DispersedLimit, ...] = optional(
        "limits of flights and campaigns with limits = 'dispersed'", ()
    )
    baseline: str | None = optional(
        "agreed suite for comparison (default: the shipped suite that it extends, else standard)"
    )
    wind_limit_mps: Positive | None = optional(
        "steady cross-wind that the gimbal must be able to trim at every time, m/s"
    )
    board: BoardSection | None = optional("statements for a review board (docs/verdicts.md)")

    def _check(self) -> None:
        names = [f.name for f in self.flight]
        for n, name in enumerate(names):
            if name in names[:n]:
                raise refuse("is the name of another flight already", "each name once", ("flight", n, "name"))
        if not self.flight and self.margins is None and self.certificate is None and not self.campaign:
            raise refuse("requires nothing", "[[flight]], [margins], [certificate] or [[campaign]]", "flight")


def set_words(changes: Iterable[str]) -> list[str]:
    """Return the command-line options for the given changes.

    TOML strings in single quotes, which are inconvenient in a shell, are written with double quotes if the meaning is
    the same.
    """
    out = []
    for change in changes:
        doubled = change.replace("'", '"')
        try:
            same = tomllib.loads(change) == tomllib.loads(doubled)
        except tomllib.TOMLDecodeError:
            same = False
        out += ["--set", doubled if same else change]
    return out


@dataclass(frozen=True)
class LoadedSuite:
    suite: Suite
    label: str  # the name given by the user
    overrides: tuple[str, ...] = ()
    left_out: tuple[
        str, ...
    ] = ()  # flights for parts that the vehicle does not have (`fitted.fit`); parts excluded by `only`
    part: str = ""  # part that is verified alone (`only`)
    along: CampaignWanted | None = None  # campaign of the draws and flights of a vehicle that is measured alone
    asked: Suite = field(default_factory=Suite.model_construct)  # the whole suite as read, before fitting
    baseline: str = "standard"  # the suite with which it is compared
    shipped: str = "standard"  # the shipped suite that it extends or equals

    def command(self, design: str, vehicle: str | None = None, *more: str) -> str:
        """Return the command that verifies a design by this suite. `more` contains additional arguments."""
        built_in = design.startswith("designs/")
        words = ["simverify", Path(design).stem if built_in else design]
        words += ["--suite", self.label] if self.label != "standard" else []
        words += ["--vehicle", vehicle] if vehicle is not None else []
        return shlex.join([*words, *set_words(self.overrides), *more])

    def only(self, label: str) -> LoadedSuite:
        """Return the suite with one flight, one vehicle of the linear margins, or the certificate alone.

        The limits of the suite are unchanged. Raises ScenarioError for an unknown part.
        """
        suite = self.suite
        flights = tuple(f for f in suite.flight if f.name == label)
        known = label in (AS_DESIGNED, WORST) or VEHICLE_LABEL.fullmatch(label) is not None
        certificate = suite.certificate if label == CERTIFICATE else None
        margins = suite.margins if known or certificate is not None else None
        if not flights and certificate is None and (margins is None or not known):
            allowed = ", ".join(
                [*(f.name for f in suite.flight), AS_DESIGNED, "corner N", "vehicle N", WORST, CERTIFICATE]
            )
            raise ScenarioError(self.label, "the suite has no such part", "--only", value=label, allowed=allowed)
        if margins is not None:
            margins = margins.model_copy(update={"only": label})
        wind = suite.wind_limit_mps if label == AS_DESIGNED else None
        update = {"flight": flights, "margins": margins, "certificate": certificate, "campaign": ()}
        along = next(iter(suite.campaign), None) if known and label != AS_DESIGNED else None
        others = len(suite.flight) - len(flights)
        left_out = [f"{others} flight{'s' * (others != 1)}"] if others else []
        if suite.margins is not None:
            left_out.append("linear margins" + (f" but for '{label}'" if known else ""))
        left_out += ["wind that can be trimmed"] if suite.wind_limit_mps is not None and wind is None else []
        left_out += ["certificate"] if suite.certificate is not None and certificate is None else []
        left_out += [campaign_title(wanted.name or wanted.file.removesuffix(".toml")) for wanted in suite.campaign]
        left_out += ["[board]"] if suite.board is not None else []
        suite = suite.model_copy(update={**update, "wind_limit_mps": wind, "board": None})
        return replace(self, suite=suite, along=along, part=label, left_out=(*self.left_out, *left_out))


def read_suite(name: str | Path, overrides: Iterable[str] = ()) -> LoadedSuite:
    """Return the suite in a file, or the built-in suite of that name, with `key=value` overrides. Raises ScenarioError.

    Scenarios, campaigns and winds are first searched for in the folder of the suite, then among the shipped ones.
    """
    changes = tuple(overrides)
    suite, tree, file, _, files = load_file(Suite, "suite", name, changes)

    def placed(one: Any, table: Any, key: str) -> Any:
        given = table.get(key)
        return one.model_copy(update={key: named_in_file(given, file)}) if isinstance(given, Text) else one

    suite = placed(suite, tree, "scenario")
    suite = placed(suite, tree, "limit_wind") if suite.limit_wind else suite
    flights = [placed(f, t, "scenario") for f, t in zip(suite.flight, tree.get("flight", ()), strict=True)]
    campaigns = [placed(c, t, "file") for c, t in zip(suite.campaign, tree.get("campaign", ()), strict=True)]
    if suite.margins is not None and suite.margins.three_sigma.campaign is not None:
        spread = placed(suite.margins.three_sigma, tree["margins"]["three_sigma"], "campaign")
        suite = suite.model_copy(update={"margins": suite.margins.model_copy(update={"three_sigma": spread})})
    each = tuple(one for flown in flights for one in flown.flights())
    suite = suite.model_copy(update={"flight": each, "campaign": tuple(campaigns)})
    shipped = {path: builtin for builtin, path in builtin_files("suite").items()}
    baseline = extended = next((shipped[path] for path in files if path in shipped), "standard")
    if isinstance(given := tree.get("baseline"), Text):
        beside = find(given, ("{}", "{}.toml"))
        known = given in shipped.values() or beside is None
        baseline = str(given) if known or beside is None else str(beside)
    return LoadedSuite(suite, str(name), changes, asked=suite, baseline=baseline, shipped=extended)


def shared_risk(loaded: LoadedSuite, campaigns: Sequence[Campaign], designs: int, number: int = 0) -> list[str]:
    """Return overrides that divide the risk of accepting a bad design among several designs.

    A design that is selected from many because it passed had many opportunities to pass by chance. Each design
    therefore gets its share of the risk (Bonferroni). `campaigns` are those of the suite, as loaded. A `number` above 0
    also gives design `number` its own seeds, so that its draws differ from those that selected another design.
    """
    suite, out = loaded.suite, []

    def add(part: str, confidence: float, seed: int) -> None:
        if designs > 1:
            out.append(f"{part}.confidence={1.0 - (1.0 - confidence) / designs:.12g}")
        if number:
            out.append(f"{part}.seed={seed + number}")

    if suite.margins is not None and suite.margins.cases:
        add("margins", suite.margins.confidence, suite.margins.seed)
    for n, campaign in enumerate(campaigns):
        add(f"campaign.{n}", campaign.confidence, campaign.seed)
    return out


def limit_changes(loaded: LoadedSuite, which: str, scenario: Scenario) -> list[str]:
    """Return the overrides that replace the scenario's limits by those of the suite.

    `which` is "own" (no replacement) or "dispersed". Raises ScenarioError if the scenario has no such requirement, or
    if it is not an upper limit.
    """
    if which == "own":
        return []
    limits = {r.name or r.metric: (n, r.limit) for n, r in enumerate(scenario.requirement)}
    out = []
    for k, stated in enumerate(loaded.suite.dispersed_limit):
        known = [name for name, (_, limit) in limits.items() if limit is not None]
        if stated.requirement not in known:
            hint = suggestion(stated.requirement, known)
            raise ScenarioError(
                loaded.label,
                f"the scenario has no such limit{'; ' + hint if hint else ''}",
                f"dispersed_limit[{k}].requirement",
                value=stated.requirement,
                allowed="" if hint else ", ".join(known),
            )
        out.append(f"requirement.{limits[stated.requirement][0]}.limit={stated.limit!r}")
    return out
