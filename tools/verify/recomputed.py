"""The results of a pack that can be computed again: flights, operating points, vehicles, responses and runs."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import Any

from maxq.design import operating_points
from maxq.design.certificate.certificate import NodeCertificate, certify_node
from maxq.design.certificate.in_flight import InFlightResponse, in_flight_response, in_flight_response_of_code
from maxq.design.certificate.measured_only import MeasuredNode, measure_node
from maxq.design.loop.fixed_path import fixed_path
from maxq.design.loop.loop import Loop, law_at
from maxq.design.model.instruments import Plane
from maxq.design.model.node import Node
from maxq.design.verify import flown, linear
from maxq.design.verify.memory import PartsOnDisk, text_of
from maxq.design.verify.names import node_name
from maxq.design.verify.parts import Parts, WorstPart
from maxq.design.verify.results import Results
from maxq.design.verify.verify import Prepared
from maxq.design.verify.worst import search_node
from maxq.sim.campaign.analysis import DataSet

Job = tuple[str, Any, Callable[[], Any]]
"""The name of a result, the known result, and a function that computes it again."""

Part = tuple[list[Node], str, list[list[Node]]]
"""The operating points of a plane and stage, the stage's name, and the operating points in dispersed flights."""

_SEARCHED = 1e-6  # tolerance of |1 + L|: compiled and exact loops differ by less


def jobs_of(prepared: Prepared, results: Results, job: Parts, data: Sequence[DataSet]) -> dict[str, list[Job]]:
    """Return all results that can be computed again, by kind. `data` contains the runs of the campaigns."""
    return {
        "flights": list(_flights(prepared, results)),
        "operating points": list(_points(job, results)),
        "dispersed vehicles": list(_vehicles(job, results)),
        "worst vehicles": list(_worst(job, results)),
        "searches": list(_searches(job, results)),
        "in-flight responses": list(_in_flight(job, results)),
        "other results": list(_others(job, results)),
        "runs": [
            (f"{run} of {one.campaign.name}", True, partial(flown.same_run, one, run))
            for one in data
            for run in one.runs.tolist()
        ],
    }


def _flights(prepared: Prepared, results: Results) -> Iterator[Job]:
    for wanted, (loaded, _), known in zip(prepared.loaded.suite.flight, prepared.flights, results.flights, strict=True):
        yield f"'{wanted.name}'", known, partial(flown.fly_alone, wanted, loaded, known.again)


def _points(job: Parts, results: Results) -> Iterator[Job]:
    """Yield the linear margins as designed, the certificates, and the measurements of flight code."""
    scenario, design, margins = job.scenario, job.design, job.suite.margins

    def node_at(time_s: float, plane: Plane) -> Node:
        return operating_points.nodes(job.along, [time_s], plane=plane)[0]

    def linear_point(time_s: float, plane: Plane) -> Any:
        assert margins is not None
        assert design is not None
        node = node_at(time_s, plane)
        return linear.measured(Loop(fixed_path(node), law_at(design, node)), margins.dispersed.slosh_peak_db)

    def certificate(c: NodeCertificate) -> NodeCertificate:
        return certify_node(scenario, node_at(c.time_s, c.plane))

    def code(n: MeasuredNode) -> MeasuredNode:
        return measure_node(scenario, node_at(n.time_s, n.plane))

    for study in results.margins:
        for time_s, known in zip(study.times_s, study.nominal.nodes, strict=True):
            plane: Plane = "pitch" if study.plane == "pitch" else "yaw"
            yield f"margins {time_s:g} s, {plane}", known, partial(linear_point, time_s, plane)
    for c in results.certificates:
        yield f"certificate {c.time_s:g} s, {c.plane}", c, partial(certificate, c)
    for n in results.measured:
        yield f"measured only {n.time_s:g} s, {n.plane}", n, partial(code, n)


def _vehicles(job: Parts, results: Results) -> Iterator[Job]:
    """Yield the corners and random vehicles of each plane and stage, each at all operating points."""
    wanted, design = job.suite.margins, job.design
    if wanted is None or design is None or not results.margins:
        return
    flights = job.trajectories if wanted.cases else []
    for known, (nodes, stage, _), mine in zip(
        results.margins, job.by_stage("", wanted), flights or itertools.repeat([]), strict=False
    ):

        def same(label: str, case: Callable[[], linear.MarginCase], part: Part = (nodes, stage, mine)) -> bool:
            alone = wanted.model_copy(update={"only": label})
            described, memory = job.described.at(part[0][0]), PartsOnDisk(None)
            again = linear.study(part[0], design, alone, described, memory, stage=part[1], trajectories=part[2])
            return text_of(next(iter(again.corners), None) or again.case(0)) == text_of(case())

        cases = [(corner.label, partial(_item, corner)) for corner in known.corners]
        cases += [(f"vehicle {known.first + k}", partial(known.case, k)) for k in range(len(known.random))]
        for label, case in cases:
            yield ", ".join(filter(None, (label, known.plane, known.stage))), True, partial(same, label, case)


def _item(corner: linear.MarginCase) -> linear.MarginCase:
    return corner


def _worst(job: Parts, results: Results) -> Iterator[Job]:
    for part, known in zip(job.worst_parts(), results.worst, strict=True):
        yield f"{known.plane} {known.stage}".rstrip(), known, partial(job.vehicle_of, part, known)


def _searches(job: Parts, results: Results) -> Iterator[Job]:
    """Yield a search at each operating point for a vehicle worse than the pack's worst vehicle. It must find none."""

    def none_worse(part: WorstPart, node: Node, modulus: float) -> bool:
        least, _, _ = search_node(node, part.design, part.described, part.worst, [0])
        return modulus <= max(least, 0.0) + _SEARCHED

    for part, known in zip(job.worst_parts(), results.worst, strict=True):
        for node in part.nodes:
            yield f"worst vehicle at {node_name(node)}", True, partial(none_worse, part, node, known.modulus)


def _in_flight(job: Parts, results: Results) -> Iterator[Job]:
    """Yield the in-flight responses of each plane, which come from the same ascents."""
    times_s, held = job.in_flight_times_s(results.certificates), job.held_responses(results.measured)

    def measure(plane: Plane) -> tuple[InFlightResponse, ...]:
        if job.design is None:
            return tuple(in_flight_response_of_code(job.scenario, held[plane], plane))
        return tuple(in_flight_response(job.scenario, times_s, plane))

    for plane in dict.fromkeys(response.plane for response in results.in_flight):
        known = tuple(response for response in results.in_flight if response.plane == plane)
        yield plane, known, partial(measure, plane)


def _others(job: Parts, results: Results) -> Iterator[Job]:
    yield "intervals not covered", results.uncovered, job.uncovered
    if results.authority:
        yield "control authority", results.authority, lambda: tuple(job.authority())
    if results.slosh:
        yield "slosh", results.slosh, lambda: tuple(job.slosh())
