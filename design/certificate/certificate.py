"""The margin certificate of a design: linear, sampled and measured side by side, node by node and axis by axis."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

from maxq.design import api
from maxq.design.certificate.breaking import DRIFT_HZ, TOO_LONG, UNBOUNDED, WHATS, Broken, What, break_loop
from maxq.design.certificate.drift import Drift, drift
from maxq.design.certificate.excitation import Band
from maxq.design.certificate.held_flight import Change, hold
from maxq.design.certificate.limit_cycle import LimitCycle, limit_cycle
from maxq.design.certificate.response import BANDS, ResponseTable, measured_response
from maxq.design.margins.measure import Bound, Margins, margins
from maxq.design.model.node import Node
from maxq.design.model.vehicle_at import Plane
from maxq.sim.scenario.loader import LoadedScenario

PLANES: tuple[Plane, ...] = ("pitch", "yaw")
MARGIN_WITHIN_DB, DELAY_WITHIN = 0.2, 0.02
HELD_GRAVITY = "held gravity"
UNEXPLAINED = "unexplained"


@dataclass(frozen=True)
class EdgeRow:
    """A margin by every way of knowing it, in `unit`: linear at the flown instant (continuous and sampled), linear
    where it is held, and measured there.

    `reason` is "" where flight and linear loop agree; "held gravity" where they do, but the flown instant's margin is
    another, because the slowest root feels the axial load where it is held and gravity where it is flown; "longer than
    can be inserted" for a delay margin of more samples than the computer's filter has room for, which is not looked for
    in flight; otherwise what is wrong.

    `what` is "gain_up", "gain_down" or "delay", or "drift" (1/s, drift.py): how fast the slowest root grows in a loop
    that is stable at the flown instant and not where it is held.
    """

    what: str
    unit: str
    frequency_hz: float
    pade: float
    sampled: float
    held: float
    measured: float
    reason: str

    @property
    def difference(self) -> float:
        """Measured less linear, both held."""
        return self.measured - self.held

    @property
    def agrees(self) -> bool:
        return self.reason in ("", HELD_GRAVITY, TOO_LONG, UNBOUNDED)


@dataclass(frozen=True)
class NodeCertificate:
    """`stable` is the loop at the flown instant. `cycle` says what a loop that is unstable where it is held, and by
    more than a drift, does in flight."""

    time_s: float
    plane: Plane
    stable: bool
    responses: ResponseTable
    edges: tuple[EdgeRow, ...]
    cycle: LimitCycle | None = None

    @property
    def unexplained(self) -> tuple[str, ...]:
        """What no reason was found for, in words; empty for a certificate that stands."""
        r = self.responses
        out = [
            f"L at {r.lines_hz[i]:.4g} Hz is {r.difference_db[i]:+.2f} dB and {r.difference_deg[i]:+.1f} deg off "
            f"({r.reason[i]})"
            for i in r.faulty
        ]
        out += [
            f"{e.what} is {e.measured:.4g} {e.unit} in flight, {e.held:.4g} by the linear loop ({e.reason})"
            for e in self.edges
            if not e.agrees
        ]
        if self.cycle is not None or not self.stable:
            whose = "linear loop" if not self.stable else "loop held still, and not that of the flown instant,"
            in_flight = f"; in flight: {self.cycle.text}" if self.cycle else ""
            return (f"the {whose} is unstable{in_flight}", *out)
        return tuple(out)

    @property
    def stands(self) -> bool:
        return not self.unexplained


def certify(
    loaded: LoadedScenario,
    times_s: Iterable[float] = api.PAPER_TIMES_S,
    planes: Iterable[Plane] = PLANES,
    *,
    workers: int = 2,
    watch: Callable[[NodeCertificate], None] | None = None,
    one: Callable[[LoadedScenario, Node], NodeCertificate] | None = None,
    along: LoadedScenario | None = None,
) -> list[NodeCertificate]:
    """Certificates of the scenario's design, planes within nodes, whatever the number of workers.

    `one` certifies a node, by default `certify_node`: a place for a memory (design/verify/memory.py). `along`: whose
    flight gives the nodes their speed and air, by default the scenario itself.
    """
    times = list(times_s)
    found = {plane: api.nodes(along or loaded, times, plane=plane) for plane in planes}
    jobs = [node for each in zip(*found.values(), strict=True) for node in each]

    def done(node: Node) -> NodeCertificate:
        certificate = (one or certify_node)(loaded, node)
        if watch is not None:
            watch(certificate)
        return certificate

    with ThreadPoolExecutor(max_workers=workers) as pool:
        return list(pool.map(done, jobs))


def certify_node(
    loaded: LoadedScenario,
    node: Node,
    *,
    fault: Change | None = None,
    bands: tuple[Band, ...] = BANDS,
    broken: tuple[What, ...] = WHATS,
) -> NodeCertificate:
    """Certificate at one node, in its plane. Raises ValueError where the node cannot be held (held_flight.py).

    `fault` alters what flies and not what the linear loop is made of, to see whether the certificate sees it. `bands`
    and `broken`: what is measured, and which margins are broken.
    """
    if loaded.design is None:
        raise ValueError(f"{loaded.label}: there is no design to certify")
    held = hold(loaded, node, fault)
    loop, flown = (api.loops([n], loaded.design)[0] for n in (held.node, node))
    pade = api.loops([held.node, node], loaded.design, kind="pade")
    of_held, of_flown, of_pade = margins(loop), margins(flown), margins(pade[1])
    drifts = drift(held, loop, of_held)
    if drifts is not None:
        of_held = drifts.others
    elif not of_held.stable:
        cycle = limit_cycle(held, of_held.growth_hz)
        nothing = measured_response(held, loop, pade[0], ())
        return NodeCertificate(node.time_s, node.plane, of_flown.stable, nothing, (), cycle)
    responses = measured_response(held, loop, pade[0], bands, quiet=fault is None)
    edges = [_edge(break_loop(held, loop, of_held, what), of_pade, of_flown) for what in broken]
    if drifts is not None:
        edges.append(_drift_row(drifts, of_pade, of_flown))
    return NodeCertificate(node.time_s, node.plane, of_flown.stable, responses, tuple(edges))


def _edge(broken: Broken, pade: Margins, flown: Margins) -> EdgeRow:
    within = MARGIN_WITHIN_DB if broken.unit == "dB" else DELAY_WITHIN * broken.linear
    reason, bound = broken.reason, _bound(flown, broken.what)
    sampled = bound.value
    if reason == UNBOUNDED and bound.frequency_hz < DRIFT_HZ:
        reason = HELD_GRAVITY
    if not reason and not abs(broken.difference) <= within:
        reason = UNEXPLAINED
    if not reason and broken.frequency_hz < DRIFT_HZ and not abs(broken.measured - sampled) <= within:
        reason = HELD_GRAVITY
    return EdgeRow(
        broken.what, broken.unit, broken.frequency_hz, _bound(pade, broken.what).value, sampled, broken.linear,
        broken.measured, reason,
    )  # fmt: skip


def _drift_row(of: Drift, pade: Margins, flown: Margins) -> EdgeRow:
    reason = HELD_GRAVITY if abs(of.measured_1ps - of.linear_1ps) <= of.per_db_1ps * MARGIN_WITHIN_DB else UNEXPLAINED
    return EdgeRow("drift", "1/s", 0.0, pade.growth_1ps, flown.growth_1ps, of.linear_1ps, of.measured_1ps, reason)


def _bound(of: Margins, what: str) -> Bound:
    return {"gain_up": of.gain_up_db, "gain_down": of.gain_down_db, "delay": of.delay_s}[what]
