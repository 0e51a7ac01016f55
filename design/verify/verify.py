"""A design judged by a suite: flights, linear margins, certificate, campaigns; what each says, and the verdict.

found = verify("ksr3-robust", read_suite("standard"))
found.judgement, [r.reason for r in found.requirements if r.judgement == "rejected"]
"""

from __future__ import annotations

import itertools
import math
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from itertools import groupby
from operator import attrgetter
from pathlib import Path

import numpy as np

from maxq.design import api
from maxq.design.certificate.certificate import NodeCertificate, certify, certify_node
from maxq.design.certificate.held_flight import hold
from maxq.design.certificate.in_flight import InFlightResponse, fits, in_flight_response
from maxq.design.certificate.measured_only import MeasuredNode, measure_node
from maxq.design.model.deviations import told_of
from maxq.design.model.instruments import Plane
from maxq.design.model.node import EDGES, Node, loss_text, node_times, powered_flight, powered_spans
from maxq.design.quantities import MEASURED, LoopLimits
from maxq.design.verify import flown, linear
from maxq.design.verify.described import DescribedVehicles
from maxq.design.verify.fitted import fit
from maxq.design.verify.memory import Memory, code_hash, content_hash, counted
from maxq.design.verify.slosh import SloshAdvice, advise, confirm
from maxq.design.verify.suite import (
    ACCEPTED,
    AS_DESIGNED,
    CERTIFICATE,
    REJECTED,
    UNDECIDED,
    WORST,
    CertificateWanted,
    Judgement,
    LinearMargins,
    LoadedSuite,
    Requirement,
    Suite,
    WorstWanted,
    overall,
    room_left,
)
from maxq.design.verify.worst import WorstVehicle, search_plane, worst_requirements
from maxq.sim.campaign.read import LoadedCampaign, description_of
from maxq.sim.campaign.runner import Progress
from maxq.sim.run.record import versions
from maxq.sim.scenario.loader import LoadedScenario, load_scenario, told
from maxq.sim.scenario.schema_design import Design
from maxq.sim.scenario.schema_vehicle import Vehicle

Watch = Callable[[str, int, int], None]
"""Called with what is under way, how much of it is done, and of how much."""


@dataclass(frozen=True, repr=False)
class Verification:
    """A design, the requirements on it, and the results. Parts that the suite does not ask for are empty."""

    design: str  # as the user named it
    suite: Suite
    scenario: LoadedScenario = field(repr=False)
    requirements: tuple[Requirement, ...]
    flights: tuple[flown.FlownResult, ...] = field(repr=False)
    margins: tuple[linear.MarginStudy, ...] = field(repr=False)
    certificates: tuple[NodeCertificate, ...] = field(repr=False)
    in_flight: tuple[InFlightResponse, ...] = field(repr=False)
    campaigns: tuple[flown.CampaignResult, ...] = field(repr=False)
    authority: tuple[linear.Authority, ...] = field(repr=False)
    slosh: tuple[SloshAdvice, ...] = field(repr=False)
    worst: tuple[WorstVehicle, ...] = field(repr=False)
    measured: tuple[MeasuredNode, ...] = field(repr=False)  # of flight code without a linear model
    left_out: tuple[str, ...]  # of the suite, for what the vehicle does not have
    hashes: dict[str, str]  # of design, scenario (with its vehicle) and source code
    versions: dict[str, str]
    recalled: int
    worked_out: int
    wall_s: float
    walls_s: dict[str, float]
    cpus_s: dict[str, float]  # of all threads
    deviations: str = ""  # the description of the dispersed vehicles, for people

    def __repr__(self) -> str:
        counts = ", ".join(f"{len(found)} {j}" for j in (ACCEPTED, REJECTED, UNDECIDED) if (found := self.of(j)))
        return (
            f"<Verification of {self.design} by the suite {self.suite.name}: {self.judgement}; requirements: {counts}>"
        )

    @property
    def judgement(self) -> Judgement:
        return overall(self.requirements, self.suite)

    @property
    def more_runs(self) -> int:
        """Campaign runs that would settle what is undecided, if none of them fails."""
        return max((r.more_runs for r in self.requirements), default=0)

    def of(self, judgement: Judgement) -> list[Requirement]:
        return [r for r in self.requirements if r.judgement == judgement]

    @property
    def merit(self) -> tuple[int, int, float]:
        """For ranking: fewer rejected, fewer undecided, then more room at the tightest requirement."""
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

    Raises ScenarioError before anything is flown where an input is wrong; KeyboardInterrupt soon after `stop` returns
    True (results up to then are kept).
    """
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

    suite, kept = loaded.suite, Memory(memory)
    scenario = load_scenario(suite.scenario, flown.design_changes(design, vehicle))
    along = flight_of(suite, design, vehicle)
    loaded = fit(loaded, along, kept)
    suite = loaded.suite
    campaigns_loaded = [
        flown.load_wanted(loaded, wanted, design, vehicle) for wanted in suite.campaign or filter(None, [loaded.along])
    ]
    job = _Job(
        suite, scenario, scenario.design, along, kept, interruptible, workers, next(iter(campaigns_loaded), None),
        flown.design_changes(design, vehicle),
    )  # fmt: skip  # eight more lines otherwise
    with timed("scenarios"):
        flights = flown.fly_suite(loaded, design, vehicle, kept, partial(interruptible, "scenarios"), workers)
    with timed("linear margins"):  # nothing but what was asked for, where a part alone is repeated
        alone = suite.margins is not None and suite.margins.only == WORST
        margin, limits, slosh = ([], [], []) if alone else (job.margins(), job.authority(), job.slosh())
    with timed("worst vehicle"):
        worst = job.worst()
    with timed("certificate"):
        (certificates, through), measured = job.certificates(), job.measured()
    campaigns = []
    with timed("campaigns"):
        for k, asked in enumerate(suite.campaign):

            def show(progress: Progress, k: int = k) -> None:
                watch(f"campaign {k + 1}", progress.done, progress.total)

            parts, afresh = memory or Path("runs"), memory is None
            campaigns.append(flown.fly_campaign(loaded, asked, design, vehicle, parts, show, stop, afresh))
    requirements = [*flight_requirement(along), *flown.flight_requirements(flights)]

    def again(label: str) -> str:
        return loaded.command(design, vehicle, "--only", label)

    if suite.margins is not None:
        for found in margin:
            requirements += linear.margin_requirements(found, suite.margins, again)
        for vehicle_found in worst:
            requirements += worst_requirements(vehicle_found, suite.margins.worst or WorstWanted(), again(WORST))
    if suite.wind_limit_mps is not None:
        requirements.append(linear.authority_requirement(limits, suite.wind_limit_mps, again(AS_DESIGNED)))

    def at_node(c: NodeCertificate | InFlightResponse) -> str:
        changes = [f"certificate.times_s=[{c.time_s!r}]", f"certificate.planes=['{c.plane}']"]
        if isinstance(c, NodeCertificate):  # which may lie too near to the ends of thrust for the other
            changes.append("certificate.in_flight=false")
        return loaded.command(
            design, vehicle, *(x for change in changes for x in ("--set", change)), "--only", CERTIFICATE
        )

    requirements += certificate_requirements(certificates, through, at_node)
    requirements += measured_requirements(measured, suite.margins.nominal if suite.margins else LoopLimits())
    for campaign in campaigns:
        requirements += flown.campaign_requirements(campaign)
    hashed = content_hash(repr(scenario.design)), content_hash(scenario.as_flown), code_hash()
    hashes = {name: text[:16] for name, text in zip(("design", "scenario", "code"), hashed, strict=True)}
    return Verification(
        design, suite, scenario, tuple(requirements), tuple(flights), tuple(margin), tuple(certificates),
        tuple(through), tuple(campaigns), tuple(limits), tuple(slosh), tuple(worst),
        tuple(measured), loaded.left_out,
        hashes=hashes, versions=versions(), recalled=kept.recalled,
        worked_out=kept.worked_out, wall_s=time.perf_counter() - begun, walls_s=walls, cpus_s=cpus,
        deviations=job.deviations,
    )  # fmt: skip  # fourteen more lines otherwise


def flight_of(suite: Suite, design: str, vehicle: str | None) -> LoadedScenario:
    """Return the flight that the nodes and marks of a suite are on: its scenario with its own design, unless it has
    none or that flight is lost; then with the one that is judged.
    """
    own = load_scenario(suite.scenario, [f'vehicle="{vehicle}"'] if vehicle is not None else [])
    if own.design is not None and powered_flight(own)[1] is None:
        return own
    return load_scenario(suite.scenario, flown.design_changes(design, vehicle))


def flight_requirement(along: LoadedScenario) -> list[Requirement]:
    """Reject a design where the flight that gives the nodes is lost: no margin after the loss is known."""
    loss = powered_flight(along)[1]
    if loss is None:
        return []
    found = f"{loss_text(loss)}; no operating point after that"
    wanted, at = "held up to the last burnout", f"{loss.time_s:.3f} s"
    return [Requirement("scenarios", "flight of the nodes", wanted, found, REJECTED, math.nan, at)]


@dataclass(frozen=True)
class _Job:
    """What the linear parts and the certificate work on.

    `along`: the flight that the nodes lie on, that of the suite's scenario with its own design unless it is lost
    (`flight_of`). So all candidates are measured in the same conditions, and a changed gain leaves other nodes alone.
    """

    suite: Suite
    scenario: LoadedScenario
    design: Design | None  # None: flight code without a linear model
    along: LoadedScenario
    memory: Memory
    watch: Watch
    workers: int
    campaign: LoadedCampaign | None = None  # whose runs are random vehicles and their trajectories
    changes: Sequence[str] = ()  # of design and vehicle
    known: dict[Plane, list[Node]] = field(default_factory=dict)  # nodes by plane

    def times_s(self, part: LinearMargins | CertificateWanted) -> tuple[float, ...]:
        """Of a part's nodes: the suite's, or such as suit the flight."""
        if part.times_s is not None:
            return part.times_s
        edges = part.edges if isinstance(part, LinearMargins) else EDGES
        times = partial(node_times, self.along, part.nodes_per_stage, edges=edges)
        return self.memory.recall("times", (self.along.as_flown, part.nodes_per_stage, edges), times)

    def nodes(self, plane: Plane) -> list[Node]:
        """Return the nodes of the linear margins, which depend on all of the flight."""
        if plane not in self.known:
            self.known[plane] = self._nodes(plane)
        return self.known[plane]

    def _nodes(self, plane: Plane) -> list[Node]:
        wanted, design = self.suite.margins, self.design
        assert wanted is not None
        times_s = self.times_s(wanted)
        depends = (self.along.as_flown, times_s, plane)

        def along(at_s: Sequence[float]) -> list[Node]:
            return api.nodes(self.along, at_s, plane=plane)

        if design is not None and wanted.between_nodes == "hold":

            def between() -> tuple[float, ...]:
                """Of every stage: its nodes lie in one powered span."""
                spans = [[t for t in times_s if span.holds(t)] for span in powered_spans(self.along)]
                return tuple(t for mine in spans for t in linear.worst_instants(along, design, mine, wanted.nominal))

            limits = told(wanted.nominal)
            found = self.memory.recall("instants", (*depends, repr(design), limits), between)
            times_s = tuple(sorted({*times_s, *found}))
        return along(times_s)

    def margins(self) -> list[linear.MarginStudy]:
        """Of every stage that has nodes, plane by plane."""
        wanted, design = self.suite.margins, self.design
        if wanted is None or design is None:
            return []
        self.watch("nodes of the linear model", 0, 0)
        out, parts = [], list(self._by_stage("margins", wanted))
        flights = self._trajectories(wanted, [nodes for nodes, _, _ in parts] if wanted.cases else [])
        for (nodes, stage, watch), mine in zip(parts, flights or itertools.repeat([]), strict=False):
            run = partial(linear.study, nodes, design, wanted, self.memory, watch, self.workers, stage, mine)
            out.append(run(self.described.at(nodes[0])))
        return out

    @cached_property
    def described(self) -> DescribedVehicles:
        assert self.suite.margins is not None
        return DescribedVehicles(self.suite.margins, self.campaign, self.changes)

    @property
    def deviations(self) -> str:
        """State which description the dispersed vehicles have; "" where there are none."""
        wanted = self.suite.margins
        if wanted is None or self.design is None or not (wanted.cases or wanted.corner_sigmas or wanted.worst):
            return ""
        return self.described.text(self.nodes(wanted.planes[0]))

    def _trajectories(self, wanted: LinearMargins, parts: Sequence[Sequence[Node]]) -> list[list[list[Node]]]:
        """Return the nodes of each part as dispersed flights meet them, (parts, flights, nodes); empty without any."""
        every = [node for nodes in parts for node in nodes]
        if not (wanted.trajectories and every and self.campaign is not None):
            return []
        depends = (description_of(self.campaign), every, wanted.trajectories)
        fly = partial(linear.conditions_of, self.campaign, every, wanted.trajectories, self.workers)
        met = self.memory.recall("trajectories", depends, fly)
        flights = [
            [replace(node, condition=condition, trim=trim) for node, (condition, trim) in zip(every, each, strict=True)]
            for each in met
        ]
        ends = list(itertools.accumulate((len(nodes) for nodes in parts), initial=0))
        return [[flight[a:b] for flight in flights] for a, b in itertools.pairwise(ends)]

    def _by_stage(
        self, what: str, wanted: LinearMargins
    ) -> Iterator[tuple[list[Node], str, Callable[[int, int], None]]]:
        """Nodes of each plane and stage, the stage's name, and what is told of the progress with them."""
        stage_of = attrgetter("stage")
        for plane in wanted.planes:
            for number, nodes in groupby(sorted(self.nodes(plane), key=stage_of), stage_of):
                stage = stage_name(self.scenario.vehicle, number)
                yield list(nodes), stage, partial(self.watch, ", ".join(filter(None, (what, plane, stage))))

    def worst(self) -> list[WorstVehicle]:
        """In every plane and stage that has nodes, where the suite asks for it."""
        wanted, design, out = self.suite.margins, self.design, []
        if wanted is None or design is None or wanted.worst is None or wanted.only not in ("", WORST):
            return []
        base, spans = self.scenario.scenario, powered_spans(self.along)
        parts = list(self._by_stage("worst vehicle", wanted))
        flights = self._trajectories(wanted, [nodes for nodes, _, _ in parts])
        for (at, name, watch), flown_along in zip(parts, flights or itertools.repeat([]), strict=False):
            end_s = next(span.end_s for span in spans if span.holds(at[0].time_s))  # flown as far as that stage burns
            run = base.run.model_copy(update={"duration_s": round(end_s - base.run.start_s, 9)})
            loaded = replace(self.scenario, scenario=base.model_copy(update={"run": run}))
            between = partial(api.nodes, self.along, plane=at[0].plane) if wanted.between_nodes == "hold" else None
            described = self.described.at(at[0])
            depends = (
                loaded.as_flown, repr(design), at, told_of(described), told(wanted.worst), wanted.between_nodes,
                flown_along,
            )  # fmt: skip  # four more lines otherwise
            search = partial(
                search_plane, at, design, described, wanted.worst, loaded, name, watch, self.workers, between,
                flown_along,
            )  # fmt: skip  # five more lines otherwise
            out.append(self.memory.recall("worst", depends, search))
        return out

    def authority(self) -> list[linear.Authority]:
        """Every second between the first and the last time that the suite names in each stage."""
        asked = [part for part in (self.suite.margins, self.suite.certificate) if part is not None]
        named = {t for part in asked for t in self.times_s(part)} or set(node_times(self.along))
        times: list[float] = []
        for span in powered_spans(self.along):
            mine = [t for t in named if span.holds(t)]
            times += [t for t in np.arange(min(mine), max(mine) + 0.5, 1.0).tolist() if t <= max(mine)] if mine else []
        computers = [self.scenario.vehicle.computer_of(n) for n in range(len(self.scenario.vehicle.stage))]
        self.watch("control authority", 0, 0)
        limits_rad = [math.inf if c is None else math.radians(c.command_limit_deg) for c in computers]
        return linear.authority(api.nodes(self.along, times), limits_rad)

    def slosh(self) -> list[SloshAdvice]:
        """Damping needed at every node; the worst case is flown."""
        vehicle, wanted, design = self.scenario.vehicle, self.suite.margins, self.design
        tanks = any(stage.tank for stage in vehicle.stage)
        if wanted is None or design is None or not tanks or not self.scenario.scenario.switches.slosh:
            return []
        self.watch("slosh", 0, 0)
        nodes = self.nodes("pitch")
        depends = (self.scenario.as_flown, tuple(node.time_s for node in nodes))
        found = self.memory.recall("slosh", depends, lambda: advise(nodes, design))
        worst = max((a for a in found if 0.0 < a.needed < math.inf), key=lambda a: a.needed, default=None)
        if worst is None:
            return found
        node = next(n for n in nodes if n.time_s == worst.time_s)
        confirmed = self.memory.recall("slosh-flown", (*depends, worst), lambda: confirm(self.scenario, node, worst))
        return [confirmed if a is worst else a for a in found]

    def certificates(self) -> tuple[list[NodeCertificate], list[InFlightResponse]]:
        wanted, scenario, memory, design = self.suite.certificate, self.scenario, self.memory, self.design
        if wanted is None or design is None:
            return [], []
        times_s, planes = self.times_s(wanted), wanted.planes

        def one(loaded: LoadedScenario, node: Node) -> NodeCertificate:
            held = hold(loaded, node)
            law, computer = api.law_at(design, node), repr(loaded.vehicle.computer)
            depends = (held.packed.parameters, held.packed.pool, held.packed.state, node, law, computer)
            return memory.recall("node", depends, lambda: certify_node(loaded, node))

        one_told = counted(one, partial(self.watch, "certificate"), len(times_s) * len(planes))
        found = certify(scenario, times_s, planes, workers=self.workers, one=one_told, along=self.along)
        stable = [c.time_s for c in found if c.stable and c.plane == planes[0]]
        if wanted.times_s is None and wanted.in_flight:  # what the flight chooses may lie at the ends of thrust
            spans = powered_spans(scenario)
            stable = [t for t in stable if fits(t, spans)]
        through: list[InFlightResponse] = []
        for plane in planes if wanted.in_flight and stable else ():
            fly = partial(in_flight_response, scenario, stable, plane)
            through += memory.recall("through", (scenario.as_flown, stable, plane), fly)
        return found, through

    def measured(self) -> list[MeasuredNode]:
        """Of flight code without a linear model, at the nodes and in the planes of the certificate."""
        wanted = self.suite.certificate
        if wanted is None or self.design is not None:
            return []
        times_s = self.times_s(wanted)
        nodes = [node for plane in wanted.planes for node in api.nodes(self.along, times_s, plane=plane)]

        def one(node: Node) -> MeasuredNode:
            depends = (self.scenario.as_flown, node)
            return self.memory.recall("measured", depends, partial(measure_node, self.scenario, node))

        with ThreadPoolExecutor(max_workers=self.workers) as pool:
            return list(pool.map(counted(one, partial(self.watch, "measuring in flight"), len(nodes)), nodes))


def stage_name(vehicle: Vehicle, stage: int) -> str:
    """For people; "" of the only one."""
    if len(vehicle.stage) == 1:
        return ""
    name = vehicle.stage[stage].name
    return f"stage {stage + 1}" + (f" ({name})" if name and name != str(stage + 1) else "")


def tank_name(vehicle: Vehicle, stage: int, tank: int) -> str:
    """Of a slosh mode, for people; with its stage where there are several."""
    name = vehicle.stage[stage].pendulum_names[tank]
    return name if len(vehicle.stage) == 1 else f"{name}, stage {stage + 1}"


_MEASURED = "measured only"


def measured_requirements(nodes: Sequence[MeasuredNode], limits: LoopLimits) -> list[Requirement]:
    """Of flight code without a linear model: stable when held, and margins as they are limited for a linear loop."""
    if not nodes:
        return []

    def where(n: MeasuredNode) -> str:
        return f"{n.time_s:g} s, {n.plane}"

    def judged(name: str, wanted: str, found: str, bad: Sequence[MeasuredNode]) -> Requirement:
        judgement, at = (REJECTED, where(bad[0])) if bad else (ACCEPTED, "")
        return Requirement(_MEASURED, name, wanted, found, judgement, math.nan, at)

    shaky = [n for n in nodes if not n.stable]
    said = f"{len(nodes) - len(shaky)} of {len(nodes)} nodes"
    out = [judged("stable in held flight", "at every node", said, shaky)]
    quantities: dict[str, tuple[float, Callable[[MeasuredNode], float]]] = {
        "gain_up_db": (1.0, lambda n: n.margin("gain_up")),
        "gain_down_db": (1.0, lambda n: n.margin("gain_down")),
        "delay_ms": (1e3, lambda n: n.margin("delay")),
        "rigid_phase_deg": (1.0, lambda n: n.phase_deg),
    }
    for key, (factor, read) in quantities.items():
        stable, limit, about = [n for n in nodes if n.stable], getattr(limits, key), MEASURED[key]
        if limit is None or not stable:
            continue
        worst = min(stable, key=lambda n: (not math.isnan(read(n)), read(n)))
        value = factor * read(worst)
        met = ACCEPTED if value >= limit else UNDECIDED if math.isnan(value) else REJECTED
        text = f"{value:.2f} {about.unit}" if math.isfinite(value) else "no growth as far as was tried"
        room = room_left(value, limit, about.sense) if math.isfinite(value) else math.nan
        name = "phase margin between lines" if key == "rigid_phase_deg" else about.label
        out.append(Requirement(_MEASURED, name, f"{about.sense} {limit:g} {about.unit}", text, met, room, where(worst)))
    ends = [(c, n) for n in nodes for c in n.cycles if c.kind not in ("decays", "limit cycle")]
    said = ends[0][0].text if ends else "decays or ends in a limit cycle at every node"
    return [*out, judged("burst at slosh", "does not grow", said, [n for _, n in ends])]


def certificate_requirements(
    certificates: list[NodeCertificate],
    through: list[InFlightResponse],
    again: Callable[[NodeCertificate | InFlightResponse], str] = lambda node: "",
) -> list[Requirement]:
    """Flight and linear loop agree at every node, and every difference of the in-flight response is explained; with
    adaptation the gain margins measured reach beyond the limits of the total gain."""
    out = []

    def add(name: str, found: str, bad: Sequence[NodeCertificate | InFlightResponse]) -> None:
        judgement, where = (REJECTED, f"{bad[0].time_s:g} s") if bad else (ACCEPTED, "")
        command, wanted = again(bad[0]) if bad else "", "every difference explained"
        out.append(Requirement("certificate", name, wanted, found, judgement, math.nan, where, again=command))

    for plane in dict.fromkeys(c.plane for c in certificates):
        mine = [c for c in certificates if c.plane == plane]
        bad = [c for c in mine if not c.agrees]
        found = f"{len(mine) - len(bad)} of {len(mine)} nodes" + (f": {bad[0].unexplained[0]}" if bad else "")
        add(f"flight and linear loop agree, {plane}", found, bad)
    for end, what in enumerate(("gain_down", "gain_up")):
        adapted = [(c.total_gain_room_db(end), c) for c in certificates if c.total_gain_db[end] != 0.0]
        if adapted:
            room_db, worst = min(adapted, key=lambda each: each[0])
            limit_db, name = abs(worst.total_gain_db[end]), ("least", "most")[end]
            out.append(
                Requirement(
                    "certificate", f"stable at the {name} total gain", f"{what} > {limit_db:.2f} dB",
                    f"{room_db + limit_db:.2f} dB", ACCEPTED if room_db > 0.0 else REJECTED, room_db / limit_db,
                    f"{worst.time_s:g} s, {worst.plane}", again="" if room_db > 0.0 else again(worst),
                )
            )  # fmt: skip  # four more lines otherwise
    for plane in dict.fromkeys(f.plane for f in through):
        flights = [f for f in through if f.plane == plane]
        count, open_ = sum(len(f.lines_hz) for f in flights), sum(f.reason.count("unexplained") for f in flights)
        off = [f for f in flights if "unexplained" in f.reason]
        add(f"in-flight response, {plane}", f"{count - open_} of {count} lines", off)
    return out
