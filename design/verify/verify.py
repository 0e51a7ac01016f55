"""A design judged by a suite: flights, linear margins, certificate, campaigns; what each says, and the verdict.

found = verify("ksr3-robust", read_suite("standard"))
found.judgement, [r.reason for r in found.requirements if r.judgement == "rejected"]
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from maxq.design import api
from maxq.design.certificate.certificate import NodeCertificate, certify, certify_node
from maxq.design.certificate.held_flight import hold
from maxq.design.certificate.in_flight import InFlightResponse, in_flight_response
from maxq.design.model.node import Node
from maxq.design.verify.flown import (
    CampaignResult,
    FlownResult,
    campaign_requirements,
    flight_requirements,
    fly_campaign,
    fly_suite,
    load_wanted,
)
from maxq.design.verify.linear import (
    Authority,
    MarginStudy,
    authority,
    authority_requirement,
    margin_requirements,
    study,
)
from maxq.design.verify.memory import Memory, code_hash, content_hash
from maxq.design.verify.slosh import SloshAdvice, advise, confirm
from maxq.design.verify.suite import ACCEPTED, REJECTED, Judgement, LoadedSuite, Requirement, Suite, overall
from maxq.sim.run.record import versions
from maxq.sim.scenario.loader import LoadedScenario, load_scenario

Watch = Callable[[str, int, int], None]
"""Called with what is under way, how much of it is done, and of how much."""


@dataclass(frozen=True)
class Verification:
    """A design, what it was asked, and what became of it. Parts that the suite does not ask for are empty."""

    design: str  # as the person named it
    design_name: str
    vehicle: str
    suite: Suite
    scenario: LoadedScenario = field(repr=False)
    requirements: tuple[Requirement, ...]
    flights: tuple[FlownResult, ...] = field(repr=False)
    margins: tuple[MarginStudy, ...] = field(repr=False)
    certificates: tuple[NodeCertificate, ...] = field(repr=False)
    in_flight: tuple[InFlightResponse, ...] = field(repr=False)
    campaigns: tuple[CampaignResult, ...] = field(repr=False)
    authority: tuple[Authority, ...] = field(repr=False)
    slosh: tuple[SloshAdvice, ...] = field(repr=False)
    design_hash: str = ""
    vehicle_hash: str = ""
    code: str = ""
    versions: dict[str, str] = field(default_factory=dict)
    recalled: int = 0
    worked_out: int = 0
    wall_s: float = math.nan
    walls_s: dict[str, float] = field(default_factory=dict)
    cpus_s: dict[str, float] = field(default_factory=dict)  # of all threads

    @property
    def judgement(self) -> Judgement:
        return overall(self.requirements)

    @property
    def more_runs(self) -> int:
        """That would settle what is undecided, if none of them fails."""
        return max((r.more_runs for r in self.requirements), default=0)

    def of(self, judgement: Judgement) -> list[Requirement]:
        return [r for r in self.requirements if r.judgement == judgement]

    @property
    def merit(self) -> tuple[int, int, float]:
        """For ranking: fewer rejected, fewer undecided, then the tightest requirement with the most room."""
        rooms = [r.room for r in self.requirements if math.isfinite(r.room)]
        undecided = sum(r.judgement not in (ACCEPTED, REJECTED) for r in self.requirements)
        return (-len(self.of(REJECTED)), -undecided, min(rooms, default=math.nan))


def verify(
    design: str,
    loaded: LoadedSuite,
    *,
    vehicle: str | None = None,
    memory: Path | None = None,
    watch: Watch = lambda what, done, of: None,
    stop: Callable[[], bool] = lambda: False,
    workers: int = 2,
) -> Verification:
    """Judge a design by a suite. `design` as a scenario names it. `memory`: folder of parts, None for none.

    Raises ScenarioError before anything is flown where an input is wrong; KeyboardInterrupt soon after `stop` says
    True, what was worked out being kept.
    """
    begun = time.perf_counter()

    def watched(what: str, done: int, of: int) -> None:
        watch(what, done, of)
        if stop():
            raise KeyboardInterrupt

    suite, kept = loaded.suite, Memory(memory)
    changes = [f'design="{design}"'] + ([f'vehicle="{vehicle}"'] if vehicle is not None else [])
    scenario = load_scenario(suite.scenario, changes)
    assert scenario.design is not None
    along = _along_what(suite, scenario, changes[1:])
    for wanted in suite.campaign:
        load_wanted(loaded, wanted, design, vehicle)
    walls: dict[str, float] = {}
    cpus: dict[str, float] = {}

    def timed(what: str, since: tuple[float, float]) -> tuple[float, float]:
        now = time.perf_counter(), time.process_time()
        walls[what], cpus[what] = now[0] - since[0], now[1] - since[1]
        if stop():
            raise KeyboardInterrupt
        return now

    at = begun, time.process_time()
    flights = fly_suite(suite, design, vehicle, kept, lambda n, of: watched("scenarios", n, of), workers, loaded.label)
    at = timed("scenarios", at)
    margin = _margins(scenario, along, suite, kept, watched, workers)
    limits = authority(_every_second(along, suite), _command_limit_rad(scenario))
    slosh = _slosh(scenario, along, suite, kept)
    at = timed("linear margins", at)
    certificates, through = _certificates(scenario, along, suite, kept, watched, workers)
    at = timed("certificate", at)
    campaigns = []
    for k, asked in enumerate(suite.campaign):
        parts = memory if memory is not None else Path("runs")

        def show(progress: object, k: int = k) -> None:
            watch(f"campaign {k + 1}", getattr(progress, "done", 0), getattr(progress, "total", 1))

        campaigns.append(fly_campaign(loaded, asked, design, vehicle, parts, show, stop, memory is None))
    timed("campaigns", at)
    requirements = flight_requirements(flights)
    for found in margin:
        assert suite.margins is not None
        requirements += margin_requirements(found, suite.margins)
    if suite.wind_limit_mps is not None:
        requirements.append(authority_requirement(limits, suite.wind_limit_mps))
    requirements += certificate_requirements(certificates, through)
    for campaign in campaigns:
        requirements += campaign_requirements(campaign)
    return Verification(
        design=design, design_name=scenario.design.name, vehicle=scenario.vehicle.name, suite=suite, scenario=scenario,
        requirements=tuple(requirements), flights=tuple(flights), margins=tuple(margin),
        certificates=tuple(certificates), in_flight=tuple(through), campaigns=tuple(campaigns),
        authority=tuple(limits), slosh=tuple(slosh), design_hash=content_hash(repr(scenario.design))[:16],
        vehicle_hash=content_hash(scenario.as_flown)[:16], code=code_hash()[:16], versions=versions(),
        recalled=kept.recalled, worked_out=kept.worked_out, wall_s=time.perf_counter() - begun, walls_s=walls,
        cpus_s=cpus,
    )  # fmt: skip


def certificate_requirements(
    certificates: list[NodeCertificate], through: list[InFlightResponse]
) -> list[Requirement]:  # fmt: skip
    """That flight and linear loop agree at every node, and every difference of the in-flight response is explained."""
    out = []
    for plane in dict.fromkeys(c.plane for c in certificates):
        mine = [c for c in certificates if c.plane == plane]
        bad = [c for c in mine if not c.agrees]
        found = f"{len(mine) - len(bad)} of {len(mine)} nodes" + (f": {bad[0].unexplained[0]}" if bad else "")
        out.append(
            Requirement(
                "certificate", f"flight and linear loop agree, {plane}", "every difference explained", found,
                REJECTED if bad else ACCEPTED, math.nan, f"{bad[0].time_s:g} s" if bad else "",
            )
        )  # fmt: skip
    for plane in dict.fromkeys(f.plane for f in through):
        off = [f for f in through if f.plane == plane and "unexplained" in f.reason]
        count = sum(len(f.lines_hz) for f in through if f.plane == plane)
        lines = sum(f.reason.count("unexplained") for f in off)
        out.append(
            Requirement(
                "certificate", f"in-flight response, {plane}", "every difference explained",
                f"{count - lines} of {count} lines", REJECTED if off else ACCEPTED, math.nan,
                f"{off[0].time_s:g} s" if off else "",
            )
        )  # fmt: skip
    return out


def _along_what(suite: Suite, scenario: LoadedScenario, changes: list[str]) -> LoadedScenario:
    """Whose flight the nodes lie on: that of the suite's scenario with its own design, as for `simdesign analyse`.

    So all candidates are measured at the same speeds in the same air, and a changed gain leaves other nodes alone.
    """
    own = load_scenario(suite.scenario, changes)
    return scenario if own.design is None else own


def _margins(
    scenario: LoadedScenario, along: LoadedScenario, suite: Suite, memory: Memory, watch: Watch, workers: int
) -> list[MarginStudy]:  # fmt: skip
    if suite.margins is None:
        return []
    assert scenario.design is not None
    out = []
    for plane in suite.margins.planes:
        nodes = _nodes(along, suite.margins.times_s, plane, memory)
        out.append(
            study(
                nodes, scenario.design, suite.margins, memory,
                lambda n, of, plane=plane: watch(f"margins, {plane}", n, of), workers,  # type: ignore[misc]  # a default binds the loop's value
            )
        )  # fmt: skip
    return out


def _certificates(
    scenario: LoadedScenario, along: LoadedScenario, suite: Suite, memory: Memory, watch: Watch, workers: int
) -> tuple[list[NodeCertificate], list[InFlightResponse]]:
    wanted = suite.certificate
    if wanted is None:
        return [], []
    count, total = [0], len(wanted.times_s) * len(wanted.planes)

    def one(loaded: LoadedScenario, node: Node) -> NodeCertificate:
        held = hold(loaded, node)
        law = api.law_at(scenario.design, node) if scenario.design else None
        depends = (held.packed.parameters, held.packed.pool, held.packed.state, node, law)
        return memory.recall("node", depends, lambda: certify_node(loaded, node))

    def done(certificate: NodeCertificate) -> None:
        count[0] += 1
        watch("certificate", count[0], total)

    watch("certificate", 0, total)
    found = certify(scenario, wanted.times_s, wanted.planes, workers=workers, watch=done, one=one, along=along)
    through: list[InFlightResponse] = []
    if wanted.in_flight:
        stable = [c.time_s for c in found if c.stable and c.plane == wanted.planes[0]]
        for plane in wanted.planes if stable else ():
            depends = (scenario.as_flown, stable, plane)
            through += memory.recall("through", depends, lambda p=plane: in_flight_response(scenario, stable, p))  # type: ignore[misc]  # a default binds the loop's value
    return found, through


def _nodes(scenario: LoadedScenario, times_s: tuple[float, ...], plane: str, memory: Memory) -> list[Node]:
    """Nodes of a flight, which depend on all of it."""
    depends = (scenario.as_flown, times_s, plane)
    return memory.recall(
        "nodes", depends, lambda: api.nodes(scenario, times_s, plane="yaw" if plane == "yaw" else "pitch")
    )


def _every_second(along: LoadedScenario, suite: Suite) -> list[Node]:
    """Nodes every second between the first and the last that the suite names."""
    times = (
        *(suite.margins.times_s if suite.margins else ()),
        *(suite.certificate.times_s if suite.certificate else ()),
    )
    first, last = (min(times), max(times)) if times else (5.0, 55.0)
    return api.nodes(along, np.arange(first, last + 0.5, 1.0))


def _command_limit_rad(scenario: LoadedScenario) -> float:
    computer = scenario.vehicle.computer
    return math.inf if computer is None else math.radians(computer.command_limit_deg)


def _slosh(
    scenario: LoadedScenario, along: LoadedScenario, suite: Suite, memory: Memory
) -> list[SloshAdvice]:  # fmt: skip
    if suite.margins is None or not scenario.vehicle.stage[0].tank or not scenario.scenario.switches.slosh:
        return []
    assert scenario.design is not None
    design = scenario.design
    nodes = _nodes(along, suite.margins.times_s, "pitch", memory)
    depends = (scenario.as_flown, suite.margins.times_s)
    found = memory.recall("slosh", depends, lambda: advise(nodes, design))
    worst = max((a for a in found if 0.0 < a.needed < math.inf), key=lambda a: a.needed, default=None)
    if worst is None:
        return found
    node = next(n for n in nodes if n.time_s == worst.time_s)
    flown = memory.recall("slosh-flown", (*depends, worst), lambda: confirm(scenario, node, worst))
    return [flown if a is worst else a for a in found]
