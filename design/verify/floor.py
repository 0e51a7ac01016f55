"""The floor of an acceptance: the evidence without which a verification is a screening, for any suite.

A suite defines its own levels, numbers and limits, and a single flight of one second could meet them all. The word
ACCEPTED therefore requires the evidence of `FLOOR`, which no suite can lower, and a suite that is not looser than its
baseline. A screening can reject a design. Its best outcome is PASSED SCREENING.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

from maxq.design.model.deviations import deviations_of
from maxq.design.model.instruments import Plane
from maxq.design.model.node import Node
from maxq.design.model.powered import Span
from maxq.design.verify.ledger import UNDER_TEST
from maxq.design.verify.memory import content_hash
from maxq.design.verify.names import stage_name
from maxq.design.verify.suite import CampaignWanted, CertificateWanted, LinearMargins, Suite
from maxq.sim.campaign.read import LoadedCampaign
from maxq.sim.campaign.schema import campaign_title
from maxq.sim.scenario.loader import LoadedScenario, told
from maxq.sim.scenario.schema_scenario import Scenario, Switches
from maxq.sim.scenario.schema_vehicle import ComputerSection, Vehicle


@dataclass(frozen=True)
class Floor:
    """The minimum evidence of an acceptance.

    `gap` is the largest permitted fraction of a stage's powered flight without an operating point.
    """

    success: float = 0.9973
    confidence: float = 0.90
    runs: int = 852  # smallest number for this success and confidence, by the fixed test without failure
    gap: float = 0.15
    planes: tuple[Plane, ...] = ("pitch", "yaw")
    limits: tuple[str, ...] = ("gain_up_db", "gain_down_db", "rigid_phase_deg", "delay_ms")


FLOOR = Floor()
"""The 3-sigma level of a normal quantity with a consumer's risk of 10 % (NASA/TP-2010-216447), over the whole burn."""

_WHOLE = {name: field.default for name, field in Switches.model_fields.items() if field.default is not False}
"""The switches of the complete model, without those that are off by default."""


@dataclass(frozen=True)
class Evidence:
    """The properties of a verification on which the floor depends.

    `points_s` are the operating points (s) by part ("margins", "certificate") and by stage, from 0. `campaigns` are
    those of the suite, in its order. `flights` are the scenarios of the flights whose failure rejects the design.
    `in_flight` are the planes measured in the ascent.
    """

    suite: Suite
    along: LoadedScenario
    spans: Sequence[Span]
    points_s: Mapping[str, Mapping[int, Sequence[float]]]
    vehicles: Sequence[tuple[LoadedCampaign, Node]]
    linear: bool  # False for flight code without a linear model
    flights: Sequence[Scenario]
    campaigns: Sequence[LoadedCampaign]
    in_flight: frozenset[str]
    guarded: bool = True  # True if flight code, if any, runs in a separate process
    judged: Scenario | None = None  # scenario whose design and flight code all flights and campaigns must have
    loosened: str = ""  # differences that loosen the suite, as text


def missing_evidence(e: Evidence) -> tuple[str, ...]:
    """Return a phrase for each piece of evidence that is missing for an acceptance.

    The result is empty if the floor is reached.
    """
    out = [e.loosened] if e.loosened else []
    out += [*_flights(e), *_control(e), *([] if e.guarded else ["flight code ran in the process that judges it"])]
    out += [] if e.campaigns else ["no dispersed flight flown"]
    for wanted, campaign in zip(e.suite.campaign, e.campaigns, strict=True):
        out += [f"{campaign_title(campaign.name)}: {text}" for text in _campaign(e, wanted, campaign)]
    margins, certificate = e.suite.margins, e.suite.certificate
    if margins is None or not margins.cases or not e.linear:
        out.append("no dispersed vehicle" if e.linear else "no dispersed vehicle: flight code has no linear model")
    if margins is not None and e.linear:
        out += [f"linear margins: {text}" for text in (*_margins(margins), *_points(e, "margins", margins))]
        out += [f"dispersed vehicles: {text}" for text in _vehicles(e)] if margins.cases else []
    if certificate is None:
        return (*out, "no certificate")
    out += [f"certificate: {text}" for text in _points(e, "certificate", certificate)]
    silent = [plane for plane in FLOOR.planes if plane not in e.in_flight]
    out += [f"certificate: no in-flight response in {' and '.join(silent)}"] if silent else []
    return tuple(out)


def _level(success: float, confidence: float, count: int, what: str) -> Iterator[str]:
    if success < FLOOR.success or confidence < FLOOR.confidence:
        asked = f"{100.0 * FLOOR.success:g} % with {100.0 * FLOOR.confidence:g} %"
        yield f"{100.0 * success:g} % with {100.0 * confidence:g} % confidence, not {asked}"
    if count < FLOOR.runs:
        yield f"{count} {what if count != 1 else what.removesuffix('s')}, not {FLOOR.runs}"


def _flights(e: Evidence) -> Iterator[str]:
    if not any(in_wind(flown) and not list(_short(e, flown)) for flown in e.flights):
        yield "no flight in wind from liftoff to the last burnout"
    for switch, count in Counter(s for flown in e.flights for s in switched_off(flown)).items():
        yield f"{switch} in {count} flight{'s' * (count != 1)}"
    yield from (f"{switch} in the flight of the operating points" for switch in switched_off(e.along.scenario))


def _control(e: Evidence) -> Iterator[str]:
    """Yield phrases for flights and campaigns with another design or flight code, and for code that no hash covers."""
    if e.judged is None:
        return
    judged = control_hash(e.judged)
    count = sum(control_hash(flown) != judged for flown in e.flights)
    if count:
        yield f"another design or flight code than the judged one in {count} flight{'s' * (count != 1)}"
    for campaign in e.campaigns:
        if campaign.base.vehicle.name != e.judged.vehicle.name:
            yield f"{campaign_title(campaign.name)}: another vehicle than the judged one"
        if control_hash(campaign.base.scenario) != judged:
            yield f"{campaign_title(campaign.name)}: another design or flight code than the judged one"
    if any(c.law == "external" and c.address for c in computers_of(e.judged)):
        yield "flight code at a socket, which no hash covers"
    if e.linear and any(c.sequences for c in computers_of(e.judged)):
        yield "gimbal angles not compared with the design: the code has its own guidance"


def computers_of(scenario: Scenario) -> list[ComputerSection]:
    """Return the computer of each stage that has one."""
    vehicle = scenario.vehicle
    return [c for n in range(len(vehicle.stage)) if (c := vehicle.computer_of(n)) is not None]


def control_hash(scenario: Scenario) -> str:
    """Return the SHA-256 of the design and of those keys of all computers that belong to the flight code."""
    computers = [told(computer) for computer in computers_of(scenario)]
    code = [{key: value for key, value in computer.items() if key in UNDER_TEST} for computer in computers]
    return content_hash(told(scenario.design) if scenario.design is not None else None, code)


def _short(e: Evidence, scenario: Scenario) -> Iterator[str]:
    """Yield phrases for the parts of the powered flight that a scenario does not cover."""
    begin_s, end_s = scenario.run.start_s, scenario.run.start_s + scenario.run.duration_s
    if e.spans and begin_s > e.spans[0].begin_s:
        yield f"flown from {begin_s:g} s, not from liftoff at {e.spans[0].begin_s:.4g} s"
    if not e.spans or end_s < e.spans[-1].end_s:
        burnout = f" at {e.spans[-1].end_s:.4g} s" if e.spans else ""
        yield f"flown to {end_s:g} s, not to the last burnout{burnout}"


def _campaign(e: Evidence, wanted: CampaignWanted, campaign: LoadedCampaign) -> Iterator[str]:
    scenario, asked = campaign.base.scenario, campaign.campaign
    if wanted.availability is not None:
        yield "judged by availability, not by each requirement"
    if not scenario.requirement:
        yield "no requirement, and so no verdict on all requirements together"
    yield from _level(asked.success, asked.confidence, asked.runs, "runs")
    yield from _short(e, scenario)
    if campaign.plan.wind is None and not in_wind(scenario):
        yield "no wind"
    yield from switched_off(scenario)
    wide = _wide(campaign)
    still = [text for n, text in _parts(scenario.vehicle) if not any(_deviates(n, text, key) for key in wide)]
    if still:
        yield f"no deviation of {', '.join(still)}" if wide else "no deviation"


def _wide(campaign: LoadedCampaign) -> list[str]:
    """Return the keys of all quantities that vary between runs."""
    boxes = campaign.boxes()
    draws = [d for d in campaign.plan.draws if d.name not in boxes or boxes[d.name][0] < boxes[d.name][1]]
    return [target.key for d in draws for target in d.targets]


def _deviates(stage: int, part: str, key: str) -> bool:
    words = key.replace("spatial_modes", "bending").split(".")
    return words[:3] == ["vehicle", "stage", str(stage)] and part.partition(" ")[0] in words


def _parts(vehicle: Vehicle) -> list[tuple[int, str]]:
    """Return the parts that a campaign can disperse, by key, each with its stage from 0."""
    out = []
    for n, stage in enumerate(vehicle.stage):
        has = {
            "engine": stage.engines,
            "mass": stage.mass,
            "aero": stage.aero,
            "bending": stage.bending or stage.spatial_modes,
            "tank": stage.tank,
            "actuator": stage.actuators,
        }
        of = f" of stage {n + 1}" if len(vehicle.stage) > 1 else ""
        out += [(n, f"{part}{of}") for part, found in has.items() if found]
    return out


def _margins(margins: LinearMargins) -> Iterator[str]:
    if margins.only:
        yield f"'{margins.only}' was judged alone"
    if margins.cases:
        yield from _level(margins.success, margins.confidence, margins.cases, "vehicles")
    every = {"as designed": margins.nominal} | ({"dispersed": margins.dispersed} if margins.cases else {})
    for name, limits in every.items():
        absent = [key for key in FLOOR.limits if getattr(limits, key) is None]
        if absent:
            yield f"no limit {name} on {', '.join(absent)}"


def _vehicles(e: Evidence) -> Iterator[str]:
    for campaign, node in e.vehicles:
        if not (deviations_of(campaign, node).places and _wide(campaign)):
            yield f"no deviation in {stage_name(e.along.vehicle, node.stage) or 'the stage'}"


def _points(e: Evidence, part: str, wanted: LinearMargins | CertificateWanted) -> Iterator[str]:
    absent = [plane for plane in FLOOR.planes if plane not in wanted.planes]
    if absent:
        yield f"not in {' and '.join(absent)}"
    stages = e.along.vehicle.stage
    for span in e.spans:
        if all(engine.gimbal == "fixed" for engine in stages[span.stage].engines):
            continue
        points_s = [t for t in e.points_s[part].get(span.stage, ()) if span.holds(t)]
        times = [span.begin_s, *points_s, span.end_s]
        begin, end = max(pairwise(times), key=lambda pair: pair[1] - pair[0])
        if end - begin > FLOOR.gap * (span.end_s - span.begin_s):
            of = stage_name(e.along.vehicle, span.stage)
            yield f"no operating point from {begin:.4g} to {end:.4g} s{' of ' + of if of else ''}"


def in_wind(scenario: Scenario) -> bool:
    """Return True for a scenario with a nonzero wind."""
    wind = scenario.wind
    if wind.factor == 0.0:
        return False
    if wind.profile is not None:
        return any(bool((column != 0.0).any()) for name, column in wind.profile.columns.items() if "mps" in name)
    return bool(wind.speed_mps)


def switched_off(scenario: Scenario) -> list[str]:
    """Return the keys that switch off, idealise or freeze parts of the model, as `key = value` each."""
    values = {name: getattr(scenario.switches, name) for name in _WHOLE}
    frozen_s = scenario.run.freeze_vehicle_at_s
    out = [] if frozen_s is None else [f"run.freeze_vehicle_at_s = {frozen_s:g}"]
    return [*out, *(f"switches.{name} = {str(x).lower()}" for name, x in values.items() if x != _WHOLE[name])]
