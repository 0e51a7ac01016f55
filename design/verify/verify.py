"""The verification of a design by a suite: flights, linear margins, certificate, campaigns, results and the verdict.

found = verify("ksr3-robust", read_suite("standard"))
found.judgement, [r.reason for r in found.requirements if r.judgement == "rejected"]
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

from maxq.design.certificate.certificate import NodeCertificate
from maxq.design.certificate.in_flight import InFlightResponse
from maxq.design.model.powered import loss_text, powered_flight, powered_spans
from maxq.design.quantities import LoopLimits
from maxq.design.verify import board_findings, flown, ledger, linear, seeds
from maxq.design.verify.baseline import Compared, accepting_baseline, against_baseline
from maxq.design.verify.certified import certificate_requirements, measured_requirements
from maxq.design.verify.fitted import fit, named
from maxq.design.verify.floor import Evidence, computers_of, missing_evidence
from maxq.design.verify.memory import PartsOnDisk, code_hash, content_hash
from maxq.design.verify.parts import Parts, Watch
from maxq.design.verify.results import Results
from maxq.design.verify.suite import (
    ACCEPTED,
    AS_DESIGNED,
    CERTIFICATE,
    REJECTED,
    UNDECIDED,
    WORST,
    JudgedRequirement,
    LoadedSuite,
    Suite,
    SuiteVerdict,
    WorstWanted,
    overall,
    read_suite,
    set_words,
)
from maxq.design.verify.waivers import apply_waivers
from maxq.design.verify.worst import worst_requirements
from maxq.sim.campaign.read import LoadedCampaign, description_of
from maxq.sim.campaign.runner import CampaignProgress
from maxq.sim.files import FileError
from maxq.sim.input.files import shown
from maxq.sim.run.flight_software import guards
from maxq.sim.run.record import versions
from maxq.sim.scenario.loader import LoadedScenario, load_scenario, told

UNDER_TEST = "code under test"
WAITING = "waiting for"
"""A word in the text for `watch` while another process flies the campaign."""
SAMPLE = 2
"""The number of recalled results of each kind that are computed again."""


@dataclass(frozen=True)
class Reused:
    """The names of the parts that were recalled from the cache, of those computed again, and of those that differ."""

    names: tuple[str, ...]
    computed_again: tuple[str, ...]
    differing: tuple[str, ...]


@dataclass(frozen=True, repr=False)
class Verification:
    """A design, the requirements on it, and the results. Parts that the suite does not require are empty."""

    design: str  # the name given by the user
    suite: Suite
    scenario: LoadedScenario = field(repr=False)
    requirements: tuple[JudgedRequirement, ...]
    results: Results = field(repr=False)
    campaigns: tuple[flown.CampaignResult, ...] = field(repr=False)
    left_out: tuple[str, ...]  # flights and limits that were omitted because the vehicle lacks a part
    missing_evidence: tuple[str, ...]  # evidence that is missing for an acceptance (`floor`)
    compared: Compared  # comparison of the suite with its baseline
    hashes: dict[str, str]  # SHA-256 of all inputs of the verdict, by name
    versions: dict[str, str]
    attempt: ledger.Attempt = field(repr=False)  # includes the other attempts for the vehicle
    seeds: tuple[seeds.Seed, ...]
    asked: dict[str, Any]  # design, vehicle, suite, overrides and part, by name
    board: board_findings.BoardFindings = field(repr=False)
    deviations: str = ""  # description of the dispersed vehicles
    part: str = ""  # part that was verified alone
    reused: Reused = Reused((), (), ())
    worked_out: int = 0
    wall_s: float = 0.0
    walls_s: dict[str, float] = field(default_factory=dict)
    cpus_s: dict[str, float] = field(default_factory=dict)  # includes all threads

    def __repr__(self) -> str:
        counts = ", ".join(f"{len(found)} {j}" for j in (ACCEPTED, REJECTED, UNDECIDED) if (found := self.of(j)))
        return (
            f"<Verification of {self.design} by the suite {self.suite.name}: {self.judgement}; requirements: {counts}>"
        )

    @property
    def recalled(self) -> int:
        """Return the number of parts that were recalled from the cache."""
        return len(self.reused.names)

    @property
    def judgement(self) -> SuiteVerdict:
        return overall(self.requirements, self.missing_evidence)

    @property
    def more_runs(self) -> int:
        """Return the number of campaign runs that would decide all undecided requirements, if none of them fails."""
        return max((r.more_runs for r in self.requirements), default=0)

    @property
    def waived(self) -> list[JudgedRequirement]:
        """Return the missed requirements that are waived."""
        return [r for r in self.requirements if r.waived]

    def of(self, judgement: SuiteVerdict) -> list[JudgedRequirement]:
        return [r for r in self.requirements if r.judgement == judgement]

    @property
    def merit(self) -> tuple[int, int, float]:
        """Return the sort key for a ranking, in which a larger key is better.

        The criteria are, in this order, fewer rejected requirements, fewer undecided requirements, and a larger least
        margin.
        """
        rooms = [r.room for r in self.requirements if math.isfinite(r.room)]
        undecided = sum(r.judgement not in (ACCEPTED, REJECTED) for r in self.requirements)
        return (-len(self.of(REJECTED)), -undecided, min(rooms, default=math.nan))


@dataclass(frozen=True)
class Prepared:
    """The inputs of a verification, loaded in advance, with their hashes by name.

    `loaded` is the suite fitted to the vehicle. `flights` contains the scenario and the changes of each flight.
    """

    design: str
    vehicle: str | None
    loaded: LoadedSuite
    compared: Compared
    scenario: LoadedScenario
    along: LoadedScenario
    campaigns: tuple[LoadedCampaign, ...]
    flights: tuple[tuple[LoadedScenario, list[str]], ...]
    seeds: tuple[seeds.Seed, ...]
    hashes: dict[str, str]
    candidate: int = 0

    @property
    def shown(self) -> str:
        """Return the design, as a path relative to the working folder if it is inside that folder."""
        return shown(Path(self.design)) if Path(self.design).is_absolute() else self.design

    @property
    def asked(self) -> dict[str, Any]:
        """Return the inputs by name: design, vehicle, suite, overrides, and the part that is verified alone."""
        suite = self.loaded
        return {
            "design": f"./{self.shown}"
            if self.shown != self.design
            else self.design,  # the prefix marks a file rather than a built-in name
            "vehicle": self.vehicle,
            "suite": suite.label,
            "overrides": suite.overrides,
            "part": suite.part,
        }

    def parts(self, memory: PartsOnDisk, watch: Watch, workers: int) -> Parts:
        """Return the linear parts and the certificate of this verification."""
        campaign, changes = next(iter(self.campaigns), None), flown.design_changes(self.design, self.vehicle)
        return Parts(self.loaded.suite, self.scenario, self.along, memory, watch, workers, campaign, changes)

    def entry(self) -> dict[str, Any]:
        """Return the content of this verification's line in the ledger of attempts."""
        part, under_test = self.loaded.part, [h for name, h in self.hashes.items() if name.startswith(UNDER_TEST)]
        return {
            "design": self.shown,
            "suite": self.loaded.suite.name,
            "part": part,
            "candidate": self.candidate,
            "seeds": seeds.drawn(self.seeds),
            "hashes": {
                "vehicle": ledger.vehicle_hash(self.scenario.vehicle),
                "suite": self.hashes["suite"],
                "design": content_hash(self.hashes["design"], under_test),
                "all": content_hash(sorted(self.hashes.items()), part),
            },
            "command": self.loaded.command(self.shown, self.vehicle, *(("--only", part) if part else ())),
        }


def prepare(design: str, loaded: LoadedSuite, vehicle: str | None, kept: PartsOnDisk, candidate: int = 0) -> Prepared:
    """Load the inputs of a verification. Raises ScenarioError for an invalid input."""
    baseline = read_suite(loaded.baseline)
    compared = against_baseline(loaded, vehicle, baseline)
    scenario = load_scenario(loaded.suite.scenario, flown.design_changes(design, vehicle))
    along = flight_of(loaded.suite, design, vehicle)
    loaded = fit(loaded, along, kept)
    suite = loaded.suite
    campaigns = tuple(
        flown.load_wanted(loaded, wanted, design, vehicle) for wanted in suite.campaign or filter(None, [loaded.along])
    )
    flights = tuple(flown.load_flight(loaded, flight, design, vehicle) for flight in suite.flight)
    board_findings.check_board(loaded, scenario, [one for one, _ in flights], campaigns)
    by_name = {flight.name: one for flight, (one, _) in zip(suite.flight, flights, strict=True)}
    hashes = _hashes(scenario, {name: one.as_flown for name, one in by_name.items()}, campaigns) | compared.hashes
    hashes |= {
        "overrides": content_hash(loaded.overrides),
        "limits off the nominal flight": content_hash(suite.dispersed_limit),
    }
    drawn = tuple(seeds.seeds_of(loaded, baseline, by_name, campaigns, candidate))
    return Prepared(design, vehicle, loaded, compared, scenario, along, campaigns, flights, drawn, hashes, candidate)


def verify(
    design: str,
    loaded: LoadedSuite,
    *,
    vehicle: str | None = None,
    memory: Path | None = None,
    watch: Watch = lambda what, done, of: None,
    stop: Callable[[], bool] = lambda: False,
    workers: int = 2,
    candidate: int = 0,
    sample: int = SAMPLE,
) -> Verification:
    """Verify a design by a suite, and write the beginning and end of the attempt to the ledger (`ledger`).

    `design` is a name as in a scenario. `memory` is the folder for parts, or None to store nothing. `candidate` is the
    number of a candidate of `simdesign --verify`, after the first. `sample` is the number of recalled parts, and of
    recalled runs of each campaign, that are computed again for comparison.

    Raises ScenarioError before any flight if an input is invalid. Raises FileError if the ledger cannot be written, or
    if a recalled result differs from its computation. Raises KeyboardInterrupt soon after `stop` returns True; results
    up to then are kept.
    """
    kept = PartsOnDisk(memory)
    prepared = prepare(design, loaded, vehicle, kept, candidate)
    entry, name = prepared.entry(), prepared.scenario.vehicle.name
    lines = ledger.lines_of(ledger.read_lines(ledger.ledger_path())[0], name, entry["hashes"]["vehicle"])
    drawn = seeds.chosen(prepared.seeds, lines, entry["hashes"]["design"])
    attempt = ledger.begin(name, entry)
    found = _verify(replace(prepared, seeds=drawn), attempt, kept, memory, watch, stop, workers, sample)
    wrong = [*found.reused.differing, *(f"{c.name} {run}" for c in found.campaigns for run in c.differing)]
    if wrong:
        attempt.end("none: recalled results differ from their computation")
        problem = f"{', '.join(wrong)}: kept results differ from their computation; verify with --afresh"
        raise FileError(f"{memory}: {problem}")
    attempt.end(found.judgement, f"{len(found.of(ACCEPTED))} of {len(found.requirements)}")
    return found


def _verify(
    prepared: Prepared,
    attempt: ledger.Attempt,
    kept: PartsOnDisk,
    memory: Path | None,
    watch: Watch,
    stop: Callable[[], bool],
    workers: int,
    sample: int,
) -> Verification:
    begun, walls, cpus = time.perf_counter(), {}, {}

    def interruptible(what: str, done: int, of: int) -> None:
        watch(what, done, of)
        if stop():
            raise KeyboardInterrupt

    @contextmanager
    def timed(what: str) -> Iterator[None]:
        wall, cpu = time.perf_counter(), time.process_time()
        yield
        walls[what], cpus[what] = time.perf_counter() - wall, time.process_time() - cpu
        if stop():
            raise KeyboardInterrupt

    design, vehicle, loaded = prepared.design, prepared.vehicle, prepared.loaded
    suite, scenarios, job = loaded.suite, prepared.flights, prepared.parts(kept, interruptible, workers)
    with timed("scenarios"):
        flights = flown.fly_suite(loaded, scenarios, kept, partial(interruptible, "scenarios"), workers)
    with timed("linear margins"):  # omits the other parts if one is requested alone
        alone = suite.margins is not None and suite.margins.only in (WORST, CERTIFICATE)
        margin, limits, slosh = ([], [], []) if alone else (job.margins(), job.authority(), job.slosh())
    with timed("worst vehicle"):
        worst = job.worst()
    with timed("certificate"):
        (certificates, through), measured, gaps = job.certificates(), job.measured(), job.uncovered()
        through += job.in_flight_of_code(measured)
    results = Results(
        flights=tuple(flights),
        margins=tuple(margin),
        authority=tuple(limits),
        slosh=tuple(slosh),
        worst=tuple(worst),
        certificates=tuple(certificates),
        measured=tuple(measured),
        in_flight=tuple(through),
        uncovered=gaps,
    )
    campaigns = []
    with timed("campaigns"):
        for k, asked in enumerate(suite.campaign):

            def show(progress: CampaignProgress, k: int = k) -> None:
                watch(f"campaign {k + 1}", progress.done, progress.total)

            def wait(who: str, k: int = k) -> None:
                interruptible(f"campaign {k + 1}: {WAITING} {who}, which is flying it", 0, 0)

            parts, afresh = memory or Path("runs"), memory is None
            given = (loaded, asked, design, vehicle, parts, show, stop, afresh, sample, wait)
            campaigns.append(flown.fly_campaign(*given))
    with timed("recalled results computed again"):
        reused = Reused(kept.recalled_names, *kept.recheck(sample))
    found = conclude(prepared, job, results, campaigns, board_findings.kinds_of(prepared.campaigns, campaigns), attempt)
    wall_s, made = time.perf_counter() - begun, kept.worked_out
    return replace(found, reused=reused, worked_out=made, wall_s=wall_s, walls_s=walls, cpus_s=cpus)


def conclude(
    prepared: Prepared,
    job: Parts,
    results: Results,
    campaigns: Sequence[flown.CampaignResult],
    deviations: Sequence[board_findings.CampaignDeviations],
    attempt: ledger.Attempt,
) -> Verification:
    """Return the verification that follows from the results: its requirements, waivers and missing evidence.

    It depends only on the arguments, so that a review pack can be assessed again from its results. `deviations` are
    those of the campaigns by kind.
    """
    design, vehicle, loaded = prepared.design, prepared.vehicle, prepared.loaded
    suite, scenario, scenarios = loaded.suite, prepared.scenario, prepared.flights
    requirements = [*flight_requirement(prepared.along), *flown.flight_requirements(results.flights)]

    def again(label: str) -> str:
        return loaded.command(design, vehicle, "--only", label)

    if suite.margins is not None:
        for found in results.margins:
            requirements += linear.margin_requirements(found, suite.margins, again)
        for vehicle_found in results.worst:
            requirements += worst_requirements(vehicle_found, suite.margins.worst or WorstWanted(), again(WORST))
    if suite.wind_limit_mps is not None:
        requirements.append(linear.authority_requirement(results.authority, suite.wind_limit_mps, again(AS_DESIGNED)))

    def at_node(c: NodeCertificate | InFlightResponse) -> str:
        changes = [f"certificate.times_s=[{c.time_s!r}]", f"certificate.planes=['{c.plane}']"]
        if isinstance(c, NodeCertificate):  # the time may be too close to the ends of thrust for an in-flight response
            changes.append("certificate.in_flight=false")
        return loaded.command(design, vehicle, *set_words(changes), "--only", CERTIFICATE)

    requirements += certificate_requirements(results.certificates, results.in_flight, at_node)
    nominal = suite.margins.nominal if suite.margins else LoopLimits()
    requirements += measured_requirements(results.measured, nominal)
    for campaign in campaigns:
        requirements += flown.campaign_requirements(campaign)
    flown_scenarios = [one for one, _ in scenarios]
    faults = board_findings.fault_cases(suite.flight, flown_scenarios, results.flights)
    second_tool = board_findings.second_tool_values(job, results.flights)
    requirements += board_findings.fault_requirements(faults, suite.board.fault_probability if suite.board else None)
    requirements += board_findings.second_tool_requirements(second_tool)
    damage = () if loaded.part else [f"the ledger of attempts is damaged: {text}" for text in attempt.damage]
    missing = (*missing_of(prepared, job, {response.plane for response in results.in_flight}), *damage)
    requirements, waivers = apply_waivers(requirements, suite.board, attempt.date, bool(missing))
    findings = board_findings.BoardFindings(
        board_findings.inputs_of([scenario, *flown_scenarios], prepared.campaigns),
        faults,
        second_tool,
        tuple(deviations),
        waivers,
    )
    return Verification(
        design,
        suite,
        scenario,
        tuple(requirements),
        results=results,
        campaigns=tuple(campaigns),
        left_out=loaded.left_out,
        missing_evidence=missing,
        compared=prepared.compared,
        hashes=prepared.hashes,
        versions=versions(),
        attempt=attempt,
        seeds=prepared.seeds,
        asked=prepared.asked,
        board=findings,
        deviations=job.deviations,
        part=loaded.part,
    )


def missing_of(prepared: Prepared, job: Parts, in_flight: Iterable[str]) -> tuple[str, ...]:
    """Return the evidence that is missing for an acceptance, apart from damage of the ledger.

    `in_flight` contains the planes with in-flight responses.
    """
    loaded, scenario, flights = prepared.loaded, prepared.scenario, [one for one, _ in prepared.flights]
    if loaded.part:
        return (f"'{loaded.part}' was judged alone",)
    suite = loaded.suite
    every = [scenario, *flights, *(campaign.base for campaign in prepared.campaigns)]
    evidence = Evidence(
        suite,
        prepared.along,
        powered_spans(prepared.along),
        {
            part: job.points_s(wanted)
            for part, wanted in (("margins", suite.margins), ("certificate", suite.certificate))
        },
        job.described_by_stage(),
        job.design is not None,
        [one.scenario for flight, one in zip(suite.flight, flights, strict=True) if flight.design_must_keep],
        prepared.campaigns if suite.campaign else (),
        frozenset(in_flight),
        all(guards(one) or not any(c.law == "external" for c in computers_of(one.scenario)) for one in every),
        scenario.scenario,
        prepared.compared.loosened,
    )
    missing = (*missing_evidence(evidence), *seeds.missing(prepared.seeds))
    accepting = loaded.baseline if missing else accepting_baseline(loaded, scenario.vehicle.name)
    if accepting == loaded.baseline:
        return missing
    return tuple(filter(None, [against_baseline(replace(loaded, baseline=accepting), prepared.vehicle).loosened]))


def _hashes(scenario: LoadedScenario, flights: dict[str, str], campaigns: Sequence[LoadedCampaign]) -> dict[str, str]:
    """Return the SHA-256 of design, scenario, code, flights (as flown) and campaigns, by name."""
    section, vehicle = scenario.scenario, scenario.vehicle
    parts: dict[str, Any] = {
        "design": repr(scenario.design),
        "scenario": scenario.as_flown,
        "vehicle": told(vehicle),
        "physics switches": told(section.switches),
        "requirements": told(section.requirement),
    }
    parts |= {f"flight {name}": text for name, text in flights.items()}
    for n, loaded in enumerate(campaigns, 1):
        parts[f"campaign {n}, {loaded.name}"] = [description_of(loaded), told(loaded.file)]
    out = {name: content_hash(content) for name, content in parts.items()} | {"code": code_hash()}
    files = [file for computer in computers_of(section) for file in computer.hashed_files.values()]
    return out | {f"{UNDER_TEST}: {file.hashed}": file.sha256 for file in files}


def part_alone(loaded: LoadedSuite, part: str, design: str, vehicle: str | None, kept: PartsOnDisk) -> LoadedSuite:
    """Return a suite fitted to its vehicle with one part alone (`LoadedSuite.only`). Raises ScenarioError."""
    along = flight_of(loaded.suite, design, vehicle)
    named(loaded, along).only(part)  # rejects an unknown name before the flight for the marks
    return fit(loaded, along, kept).only(part)


def flight_of(suite: Suite, design: str, vehicle: str | None) -> LoadedScenario:
    """Return the flight for the operating points and marks of a suite: its scenario with the scenario's own design.

    If there is no such design, or if its flight is lost, the flight with the design under test is returned.
    """
    own = load_scenario(suite.scenario, [f'vehicle="{vehicle}"'] if vehicle is not None else [])
    if own.design is not None and powered_flight(own)[1] is None:
        return own
    return load_scenario(suite.scenario, flown.design_changes(design, vehicle))


def flight_requirement(along: LoadedScenario) -> list[JudgedRequirement]:
    """Return a rejected requirement if the flight of the operating points is lost, and an empty list otherwise.

    No margin is known after the loss.
    """
    loss = powered_flight(along)[1]
    if loss is None:
        return []
    found = f"{loss_text(loss)}; no operating point after that"
    wanted, at = "control kept to the last burnout", f"{loss.time_s:.3f} s"
    return [JudgedRequirement("scenarios", "flight of the operating points", wanted, found, REJECTED, math.nan, at)]
