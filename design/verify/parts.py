"""The parts of a verification at operating points: margins, authority, slosh, worst vehicle and certificate."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from itertools import groupby
from operator import attrgetter

import numpy as np

from maxq.design import operating_points
from maxq.design.certificate.certificate import NodeCertificate, certify, certify_node
from maxq.design.certificate.held_flight import hold
from maxq.design.certificate.in_flight import InFlightResponse, fits, in_flight_response, in_flight_response_of_code
from maxq.design.certificate.measured_only import MeasuredNode, measure_node
from maxq.design.loop.loop import law_at
from maxq.design.model.instruments import Plane
from maxq.design.model.node import Node
from maxq.design.model.node_times import MEASURED_EDGES, node_times
from maxq.design.model.powered import by_burn, powered_spans, step_at_ns
from maxq.design.model.state_space import ComplexArray
from maxq.design.verify import linear
from maxq.design.verify.described import DescribedVehicles
from maxq.design.verify.memory import PartsOnDisk, counted
from maxq.design.verify.names import node_name, stage_name
from maxq.design.verify.slosh import SloshAdvice, advise, confirm
from maxq.design.verify.suite import CERTIFICATE, WORST, CertificateWanted, LinearMargins, Suite, WorstWanted
from maxq.design.verify.uncovered import Uncovered, uncovered
from maxq.design.verify.worst import WorstVehicle, measure_worst, search_plane
from maxq.sim.campaign.read import LoadedCampaign, description_of
from maxq.sim.input.values import to_ns
from maxq.sim.scenario.loader import LoadedScenario, told
from maxq.sim.scenario.schema_design import Design

Watch = Callable[[str, int, int], None]
"""A function that is called with the present activity, the number of completed steps, and the total."""


@dataclass(frozen=True)
class WorstPart:
    """The inputs of the search for the worst vehicle in a plane and stage.

    `flights` are operating points (flights, nodes) along dispersed trajectories.
    """

    nodes: list[Node]
    stage: str
    watch: Callable[[int, int], None]
    wanted: LinearMargins
    worst: WorstWanted
    design: Design
    base: LoadedScenario
    described: LoadedCampaign
    flights: list[list[Node]]


@dataclass(frozen=True)
class Parts:
    """The inputs of the linear parts and of the certificate, with methods that return the results.

    `along` is the flight of the operating points: that of the suite's scenario with its own design, unless this flight
    is lost (`flight_of`). All candidates are thus measured under the same conditions, and a changed gain does not
    affect other operating points.
    """

    suite: Suite
    scenario: LoadedScenario
    along: LoadedScenario
    memory: PartsOnDisk
    watch: Watch
    workers: int
    campaign: LoadedCampaign | None = None  # campaign of the random vehicles and their trajectories
    changes: Sequence[str] = ()  # changes of design and vehicle
    known: dict[Plane, list[Node]] = field(default_factory=dict)  # operating points by plane

    @property
    def design(self) -> Design | None:
        """Return the design under test, or None for flight code without a linear model."""
        return self.scenario.design

    def times_s(self, part: LinearMargins | CertificateWanted) -> tuple[float, ...]:
        """Return the times of a part's operating points, from the suite or suited to the flight."""
        if part.times_s is not None:
            return part.times_s
        of, edges = ("margins", part.edges) if isinstance(part, LinearMargins) else ("certificate", MEASURED_EDGES)
        times = partial(node_times, self.along, part.nodes_per_stage, edges=edges)
        return self.memory.recall("times", (self.along.as_flown, part.nodes_per_stage, edges), times, f"of {of}")

    def nodes(self, plane: Plane) -> list[Node]:
        """Return the operating points of the linear margins, which depend on the whole flight."""
        if plane not in self.known:
            self.known[plane] = self._nodes(plane)
        return self.known[plane]

    def _nodes(self, plane: Plane) -> list[Node]:
        wanted, design = self.suite.margins, self.design
        assert wanted is not None
        self.watch("linearising at the operating points", len(self.known), len(wanted.planes))
        times_s = self.times_s(wanted)
        depends = (self.along.as_flown, times_s, plane)

        def along(at_s: Sequence[float]) -> list[Node]:
            return operating_points.nodes(self.along, at_s, plane=plane)

        if design is not None and wanted.between_nodes == "hold":

            def between() -> tuple[float, ...]:
                """Return the worst instants of every burn with operating points."""
                burns = by_burn(self.along, times_s)
                return tuple(t for mine in burns for t in linear.worst_instants(along, design, mine, wanted.nominal))

            limits = told(wanted.nominal)
            found = self.memory.recall("instants", (*depends, repr(design), limits), between, plane)
            times_s = tuple(sorted({*times_s, *found}))
        return along(times_s)

    def margins(self) -> list[linear.MarginStudy]:
        """Return the margins of every stage with operating points, plane by plane."""
        wanted, design = self.suite.margins, self.design
        if wanted is None or design is None:
            return []
        out, parts = [], list(self.by_stage("margins", wanted))
        flights = self.trajectories if wanted.cases else []
        for (nodes, stage, watch), mine in zip(parts, flights or itertools.repeat([]), strict=False):
            campaign = self.described.at(nodes[0])
            out.append(linear.study(nodes, design, wanted, campaign, self.memory, watch, self.workers, stage, mine))
        return out

    @cached_property
    def described(self) -> DescribedVehicles:
        assert self.suite.margins is not None
        return DescribedVehicles(self.suite.margins, self.scenario, self.campaign, self.changes)

    @property
    def deviations(self) -> str:
        """Return the description of the dispersed vehicles, or "" if there are none."""
        wanted = self.suite.margins
        if wanted is None or self.design is None or not (wanted.cases or wanted.corner_sigmas or wanted.worst):
            return ""
        if wanted.only == CERTIFICATE:
            return ""
        return self.described.text(self.nodes(wanted.planes[0]))

    def described_by_stage(self) -> list[tuple[LoadedCampaign, Node]]:
        """Return the campaign of the dispersed vehicles of each stage, with one of its operating points."""
        wanted = self.suite.margins
        if wanted is None or self.design is None or not wanted.cases or wanted.only:
            return []
        nodes = {node.stage: node for node in self.nodes(wanted.planes[0])}
        return [(self.described.at(node), node) for node in nodes.values()]

    @cached_property
    def trajectories(self) -> list[list[list[Node]]]:
        """Return the operating points of each plane and stage in dispersed flights, (parts, flights, nodes).

        The list is empty without dispersed trajectories.
        """
        wanted = self.suite.margins
        assert wanted is not None
        parts = [nodes for nodes, _, _ in self.by_stage("", wanted)]
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

    def by_stage(
        self, what: str, wanted: LinearMargins
    ) -> Iterator[tuple[list[Node], str, Callable[[int, int], None]]]:
        """Yield the operating points of each plane and stage, the name of the stage, and its progress callback."""
        stage_of = attrgetter("stage")
        for plane in wanted.planes:
            for number, nodes in groupby(sorted(self.nodes(plane), key=stage_of), stage_of):
                stage = stage_name(self.scenario.vehicle, number)
                yield list(nodes), stage, partial(self.watch, ", ".join(filter(None, (what, plane, stage))))

    def worst(self) -> list[WorstVehicle]:
        """Return the worst vehicle of every plane and stage with operating points, if the suite requires it."""
        out = []
        for part in self.worst_parts():
            held = part.wanted.between_nodes == "hold"
            between = partial(operating_points.nodes, self.along, plane=part.nodes[0].plane) if held else None
            depends = (
                part.base.as_flown,
                repr(part.design),
                part.nodes,
                description_of(part.described),
                told(part.worst),
                part.wanted.between_nodes,
                [[(node.condition, node.trim) for node in flight] for flight in part.flights],  # all else is in `nodes`
            )
            search = partial(
                search_plane,
                part.nodes,
                part.design,
                part.described,
                part.worst,
                part.base,
                part.stage,
                part.watch,
                self.workers,
                between,
                part.flights,
            )
            out.append(self.memory.recall("worst", depends, search, f"{part.nodes[0].plane} {part.stage}"))
        return out

    def worst_parts(self) -> list[WorstPart]:
        """Return the inputs of each search for the worst vehicle."""
        wanted, design, out = self.suite.margins, self.design, list[WorstPart]()
        if wanted is None or design is None or wanted.worst is None or wanted.only not in ("", WORST):
            return out
        base, spans = self.scenario.scenario, powered_spans(self.along)
        parts = self.by_stage("worst vehicle", wanted)
        for (nodes, name, watch), flights in zip(parts, self.trajectories or itertools.repeat([]), strict=False):
            end_s = max(span.end_s for span in spans if span.holds(nodes[-1].time_s))  # its last burn
            run = base.run.model_copy(update={"duration_s": round(end_s - base.run.start_s, 9)})
            loaded = replace(self.scenario, scenario=base.model_copy(update={"run": run}))
            described = self.described.at(nodes[0])
            out.append(WorstPart(nodes, name, watch, wanted, wanted.worst, design, loaded, described, flights))
        return out

    def vehicle_of(self, part: WorstPart, known: WorstVehicle) -> WorstVehicle:
        """Measure and fly the vehicle of a result again, at its operating point."""
        nodes = part.flights[known.trajectory - 1] if known.trajectory else ()
        node = next((node for node in nodes if node.time_s == known.time_s), None)
        if node is None:
            node = operating_points.nodes(self.along, [known.time_s], plane=part.nodes[0].plane)[0]
        given, counts = (part.design, part.described, part.worst, part.base, part.stage), (known.searches, known.loops)
        return measure_worst(node, *given, known.sigmas, counts, known.trajectory)

    def points_s(self, *parts: LinearMargins | CertificateWanted | None) -> dict[int, list[float]]:
        """Return the times of the operating points of parts of the suite, by stage; empty without parts."""
        times = sorted({t for part in parts if part is not None for t in self.times_s(part)})
        out: dict[int, list[float]] = {}
        for span in powered_spans(self.along) if times else ():
            out.setdefault(span.stage, []).extend(t for t in times if span.holds(t))
        return out

    def uncovered(self) -> tuple[Uncovered, ...]:
        """Return the intervals without operating points, or an empty result if the suite requires none."""
        margins = self.suite.margins if self.design is not None else None
        margins = None if margins is not None and margins.only == CERTIFICATE else margins
        points_s = self.points_s(margins, self.suite.certificate)
        if not points_s:
            return ()
        alone = () if margins is not None and margins.between_nodes == "hold" else tuple(points_s)
        return self.memory.recall(
            "uncovered", (self.along.as_flown, points_s, alone), lambda: uncovered(self.along, points_s, "pitch", alone)
        )

    def authority_times_s(self) -> list[float]:
        """Return times at intervals of 1 s between the first and the last operating point of each burn.

        They are those of the integrator's steps, at which operating points are.
        """
        step_ns = to_ns(self.along.scenario.run.step_s)
        named = self.points_s(self.suite.margins, self.suite.certificate).values() or [node_times(self.along)]
        times: list[float] = []
        for mine in by_burn(self.along, itertools.chain.from_iterable(named)):
            wanted = [t for t in np.arange(mine[0], mine[-1] + 0.5, 1.0).tolist() if t <= mine[-1]]
            times += [step_at_ns(t, step_ns) / 1e9 for t in wanted]
        return times

    def authority(self) -> list[linear.Authority]:
        """Return the gimbal authority at `authority_times_s`."""
        computers = [self.scenario.vehicle.computer_of(n) for n in range(len(self.scenario.vehicle.stage))]
        self.watch("control authority", 0, 0)
        limits_rad = [math.inf if c is None else math.radians(c.command_limit_deg) for c in computers]
        return linear.authority(operating_points.nodes(self.along, self.authority_times_s()), limits_rad)

    def slosh(self) -> list[SloshAdvice]:
        """Return the required slosh damping at every operating point. The worst case is confirmed in flight."""
        vehicle, wanted, design = self.scenario.vehicle, self.suite.margins, self.design
        tanks = any(stage.tank for stage in vehicle.stage)
        if wanted is None or design is None or not tanks or not self.scenario.scenario.switches.slosh:
            return []
        self.watch("slosh damping", 0, 0)
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
            law, computer = law_at(design, node), repr(loaded.vehicle.computer)
            flown = "" if held.tape is None else loaded.as_flown
            depends = (held.packed.parameters, held.packed.pool, held.packed.state, node, law, computer, flown)
            return memory.recall("node", depends, lambda: certify_node(loaded, node), node_name(node))

        one_told = counted(one, partial(self.watch, "certificate"), len(times_s) * len(planes))
        found = certify(scenario, times_s, planes, workers=self.workers, one=one_told, along=self.along)
        through: list[InFlightResponse] = []
        stable_s = self.in_flight_times_s(found)
        for plane in planes if stable_s else ():
            fly = partial(in_flight_response, scenario, stable_s, plane)
            through += memory.recall("through", (scenario.as_flown, stable_s, plane), fly, plane)
        return found, through

    def in_flight_times_s(self, found: Sequence[NodeCertificate]) -> list[float]:
        """Return the times of measurements in the ascent: certified as stable, with sufficient duration of thrust."""
        wanted = self.suite.certificate
        if wanted is None or not wanted.in_flight:
            return []
        stable = [c.time_s for c in found if c.stable and c.plane == wanted.planes[0]]
        if wanted.times_s is None:  # times chosen from the flight may be too close to the ends of thrust
            spans = powered_spans(self.scenario)
            stable = [t for t in stable if fits(t, spans)]
        return stable

    def measured(self) -> list[MeasuredNode]:
        """Return the measurements of flight code without a linear model, at the operating points of the certificate."""
        wanted = self.suite.certificate
        if wanted is None or self.design is not None:
            return []
        times_s = self.times_s(wanted)
        nodes = [node for plane in wanted.planes for node in operating_points.nodes(self.along, times_s, plane=plane)]

        def one(node: Node) -> MeasuredNode:
            depends = (self.scenario.as_flown, node)
            return self.memory.recall("measured", depends, partial(measure_node, self.scenario, node), node_name(node))

        with ThreadPoolExecutor(max_workers=self.workers) as pool:
            return list(pool.map(counted(one, partial(self.watch, "measuring in flight"), len(nodes)), nodes))

    def in_flight_of_code(self, measured: Sequence[MeasuredNode]) -> list[InFlightResponse]:
        """Return the measurements of flight code in its ascent, where it is stable and thrust lasts long enough."""
        scenario, through = self.scenario, list[InFlightResponse]()
        for plane, held in self.held_responses(measured).items():
            fly = partial(in_flight_response_of_code, scenario, held, plane)
            through += self.memory.recall("through", (scenario.as_flown, held, plane), fly, plane)
        return through

    def held_responses(self, measured: Sequence[MeasuredNode]) -> dict[Plane, dict[float, ComplexArray]]:
        """Return the responses in held flights, by plane and time, for comparison with the ascent of flight code."""
        wanted, out = self.suite.certificate, dict[Plane, dict[float, ComplexArray]]()
        for plane in wanted.planes if wanted is not None and wanted.in_flight else ():
            mine = [n for n in measured if n.plane == plane and n.stable and len(n.in_flight)]
            spans = powered_spans(self.scenario) if mine else ()
            if held := {n.time_s: n.in_flight for n in mine if fits(n.time_s, spans)}:
                out[plane] = held
        return out
