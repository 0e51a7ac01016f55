"""The margin certificate of a design: linear, sampled and measured side by side, node by node and axis by axis."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np

from maxq.control.records import Array
from maxq.design import api
from maxq.design.certificate.breaking import WHATS, Broken, break_loop
from maxq.design.certificate.excitation import Band, band
from maxq.design.certificate.held_flight import HeldFlight, hold
from maxq.design.certificate.loudness import loudness
from maxq.design.certificate.measurement import Measured, measure
from maxq.design.loop.loop import Loop
from maxq.design.margins.measure import Margins, margins
from maxq.design.model.node import Node
from maxq.design.model.state_space import ComplexArray
from maxq.design.model.vehicle_at import Plane
from maxq.sim.scenario.loader import LoadedScenario

PLANES: tuple[Plane, ...] = ("pitch", "yaw")
BANDS = (
    band(0.05, 2.5, 26, 40.0, 40.0, 4),
    band(2.75, 12.0, 16, 40.0, 12.0, 2),
    band(12.5, 49.5, 12, 40.0, 12.0, 2),
)
"""Slow enough for the slowest line, loud enough for the highest: each band is limited by something else."""

COHERENT = 0.99
WITHIN_DB, WITHIN_DEG = 0.2, 1.5
MARGIN_WITHIN_DB, DELAY_WITHIN = 0.2, 0.02
NOISE_SIGMAS = 3.0


@dataclass(frozen=True)
class ResponseTable:
    """L at lines, (lines,): the paper's continuous loop, the exact sampled loop, and the loop in flight.

    `reason` names each difference above the tolerance: "" agreed, "incoherent" not judged, "converter noise" within
    three standard errors, "saturation", "flight ended", or "unexplained".
    """

    lines_hz: Array
    pade: ComplexArray
    sampled: ComplexArray
    measured: ComplexArray
    coherence: Array
    error: Array
    reason: tuple[str, ...]

    @property
    def difference_db(self) -> Array:
        return np.asarray(20.0 * np.log10(np.abs(self.measured / self.sampled)))

    @property
    def difference_deg(self) -> Array:
        return np.asarray(np.degrees(np.angle(self.measured / self.sampled)))

    @property
    def judged(self) -> int:
        return sum(r != "incoherent" for r in self.reason)


@dataclass(frozen=True)
class EdgeRow:
    """A margin by every way of knowing it, in `unit`: linear at the flown instant (continuous and sampled), linear
    where it is held, and measured there. `reason` as in ResponseTable."""

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


@dataclass(frozen=True)
class NodeCertificate:
    time_s: float
    plane: Plane
    stable: bool
    responses: ResponseTable
    edges: tuple[EdgeRow, ...]

    @property
    def unexplained(self) -> tuple[str, ...]:
        """What no reason was found for, in words; empty for a certificate that stands."""
        r = self.responses
        lines = [i for i, why in enumerate(r.reason) if why in ("unexplained", "saturation", "flight ended")]
        out = [
            f"L at {r.lines_hz[i]:.4g} Hz is {r.difference_db[i]:+.2f} dB and {r.difference_deg[i]:+.1f} deg off "
            f"({r.reason[i]})"
            for i in lines
        ]
        out += [
            f"{e.what} is {e.measured:.4g} {e.unit} in flight, {e.held:.4g} by the linear loop"
            for e in self.edges
            if e.reason == "unexplained"
        ]
        return tuple(out if self.stable else ["the linear loop is unstable", *out])

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
) -> list[NodeCertificate]:
    """Certificates of the scenario's design, planes within nodes, whatever the number of workers."""
    times = list(times_s)
    found = {plane: api.nodes(loaded, times, plane=plane) for plane in planes}
    jobs = [node for each in zip(*found.values(), strict=True) for node in each]

    def one(node: Node) -> NodeCertificate:
        done = certify_node(loaded, node)
        if watch is not None:
            watch(done)
        return done

    with ThreadPoolExecutor(max_workers=workers) as pool:
        return list(pool.map(one, jobs))


def certify_node(loaded: LoadedScenario, node: Node) -> NodeCertificate:
    """Certificate at one node, in its plane. Raises ValueError where the node cannot be held (held_flight.py)."""
    if loaded.design is None:
        raise ValueError(f"{loaded.label}: there is no design to certify")
    held = hold(loaded, node)
    loop, flown = (api.loops([n], loaded.design)[0] for n in (held.node, node))
    pade = api.loops([held.node, node], loaded.design, kind="pade")
    of_held, of_flown, of_pade = margins(loop), margins(flown), margins(pade[1])
    parts = [measured_band(held, loop, pade[0], lines) for lines in BANDS]
    edges = tuple(
        _edge(break_loop(held, loop, of_held, what), of_pade, of_flown) for what in WHATS
    )  # fmt: skip
    return NodeCertificate(node.time_s, node.plane, of_held.stable and of_flown.stable, _joined(parts), edges)


def measured_band(held: HeldFlight, loop: Loop, pade: Loop, lines: Band) -> ResponseTable:
    """One band measured and judged."""
    seen = measure(held, lines, loudness(held, loop, lines), loop.closed_poles())
    sampled = loop.response(seen.lines_hz)
    reasons = tuple(_reason(seen, i, complex(seen.response[i] / sampled[i])) for i in range(len(sampled)))
    return ResponseTable(
        seen.lines_hz, pade.response(seen.lines_hz), sampled, seen.response, seen.coherence, seen.error, reasons
    )


def _reason(seen: Measured, line: int, ratio: complex) -> str:
    if not math.isfinite(seen.error[line]):
        return "flight ended"
    if seen.coherence[line] < COHERENT:
        return "incoherent"
    db, deg = abs(20.0 * math.log10(abs(ratio))), abs(math.degrees(np.angle(ratio)))
    if db <= WITHIN_DB and deg <= WITHIN_DEG:
        return ""
    noise = NOISE_SIGMAS * float(seen.error[line])
    if abs(ratio - 1.0) <= noise:
        return "converter noise"
    return "saturation" if seen.saturated_s > 0.0 else "unexplained"


def _edge(broken: Broken, pade: Margins, flown: Margins) -> EdgeRow:
    within = MARGIN_WITHIN_DB if broken.unit == "dB" else DELAY_WITHIN * broken.linear
    reason = broken.reason
    if not reason and not abs(broken.difference) <= within:
        reason = "unexplained"
    return EdgeRow(
        broken.what, broken.unit, broken.frequency_hz,
        _bound(pade, broken.what), _bound(flown, broken.what), broken.linear, broken.measured, reason,
    )  # fmt: skip


def _bound(of: Margins, what: str) -> float:
    return {"gain_up": of.gain_up_db, "gain_down": of.gain_down_db, "delay": of.delay_s}[what].value


def _joined(parts: list[ResponseTable]) -> ResponseTable:
    values = {
        f.name: np.concatenate([getattr(p, f.name) for p in parts])
        for f in dataclasses.fields(ResponseTable)
        if f.name != "reason"
    }
    return ResponseTable(**values, reason=tuple(r for p in parts for r in p.reason))
