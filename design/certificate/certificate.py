"""The margin certificate of a design: linear, sampled and measured margins at each operating point, in each plane."""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass
from functools import partial

from maxq.design import operating_points
from maxq.design.certificate import measured_margins, response
from maxq.design.certificate.excitation import LineBand, below
from maxq.design.certificate.held_flight import (
    CodeDiffers,
    CodeLost,
    HeldFlight,
    PackedChange,
    hold,
    with_ideal_converters,
)
from maxq.design.certificate.measured_margins import MARGIN_NAMES, LimitCycle, MarginName, MeasuredMargin, bound_of
from maxq.design.certificate.response import BANDS, FAULTY, NOISE, UNEXPLAINED, ResponseTable, RingLine
from maxq.design.loop.loop import loops
from maxq.design.margins.measure import Margins, margins
from maxq.design.model.instruments import Plane
from maxq.design.model.node import Node
from maxq.design.model.node_times import MEASURED_EDGES, node_times
from maxq.sim.scenario.loader import LoadedScenario

PLANES: tuple[Plane, ...] = ("pitch", "yaw")
MARGIN_WITHIN_DB, DELAY_WITHIN = 0.2, 0.02
NOISE_WITHIN_DB, NOISE_WITHIN = 0.5, 0.05  # tolerances of rows that agree within those above without rounding
HELD_GRAVITY = "frozen-point gravity"


@dataclass(frozen=True)
class MarginRow:
    """A margin of the linear loop, at the flown instant and in the held flight, and its measurement.

    `unit` is the unit of all values. `pade` and `sampled` are those of the continuous and the sampled loop at the flown
    instant. `held` is that of the linear loop of the held flight, and `measured` that of the held flight itself.
    `reason` is "" if flight and linear loop agree. Any other text states the fault, except for these:

    - "frozen-point gravity": they agree, but the margin at the flown instant differs. The slowest root is affected by
      the axial load in the held flight, and by gravity in the ascent.
    - "longer than can be inserted": a delay margin of more samples than the computer's filter can hold. It is not
      measured.
    - "converter noise": they agree without rounding, and differ by less than 0.5 dB or 5 % with rounding.

    `what` is "gain_up", "gain_down", "delay" or "drift". A drift (1/s) is the growth rate of the slowest root of a loop
    that is stable at the flown instant and unstable in the held flight.
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
        """Return the measured minus the linear margin, both in the held flight."""
        return self.measured - self.held

    @property
    def agrees(self) -> bool:
        return self.reason in ("", HELD_GRAVITY, NOISE, *measured_margins.NOT_MEASURED)


@dataclass(frozen=True)
class NodeCertificate:
    """The certificate of an operating point at a total gain of 1.

    `stable` is True if the loop at the flown instant is stable. If the held loop is unstable by more than a drift,
    `cycle` describes the end of its flight. `total_gain_db` is the range of the adaptive total gain, downwards and
    upwards. `differs` is the message of external flight code that fails the replay check or loses control before the
    operating point, or "".
    """

    time_s: float
    plane: Plane
    stable: bool
    responses: ResponseTable
    margins: tuple[MarginRow, ...]
    cycle: LimitCycle | None = None
    total_gain_db: tuple[float, float] = (0.0, 0.0)
    rings: tuple[RingLine, ...] = ()
    differs: str = ""

    def total_gain_room_db(self, end: int) -> float:
        """Return the gain margin beyond the least (`end` 0) or the largest (1) total gain, dB.

        The margin is the measured one, or that of the linear loop if none was measured. It is minus infinity for a loop
        without margins.
        """
        row = next((m for m in self.margins if m.what == ("gain_down", "gain_up")[end]), None)
        if row is None:
            return -math.inf
        return (row.sampled if math.isnan(row.measured) else row.measured) - abs(self.total_gain_db[end])

    @property
    def unexplained(self) -> tuple[str, ...]:
        """Return a description of each difference without a reason; empty if flight and linear loop agree."""
        if self.differs:
            return (f"the flight code {self.differs}",)
        r = self.responses
        out = [
            f"L at {r.lines_hz[i]:.4g} Hz is {r.difference_db[i]:+.2f} dB and {r.difference_deg[i]:+.1f} deg off "
            f"({r.reason[i]})"
            for i in r.faulty
        ]
        out += [
            f"L at {e.line_hz:.4g} Hz with rings by their law is {e.difference_db:+.2f} dB and "
            f"{e.difference_deg:+.1f} deg off ({e.reason})"
            for e in self.rings
            if e.reason in FAULTY
        ]
        out += [
            f"{e.what} is {e.measured:.4g} {e.unit} in flight, {e.held:.4g} by the linear loop ({e.reason})"
            for e in self.margins
            if not e.agrees
        ]
        if self.cycle is not None or not self.stable:
            whose = "linear loop" if not self.stable else "loop of the frozen point, and not that of the flown instant,"
            in_flight = f"; in flight: {self.cycle.text}" if self.cycle else ""
            return (f"the {whose} is unstable{in_flight}", *out)
        return tuple(out)

    @property
    def agrees(self) -> bool:
        return not self.unexplained


def certify(
    loaded: LoadedScenario,
    times_s: Iterable[float] | None = None,
    planes: Iterable[Plane] = PLANES,
    *,
    workers: int = 2,
    one: Callable[[LoadedScenario, Node], NodeCertificate] | None = None,
    along: LoadedScenario | None = None,
) -> list[NodeCertificate]:
    """Return the certificates of the scenario's design, ordered by operating point, then plane.

    `times_s` are vehicle times; None selects times that suit the flight (`operating_points.nodes`). `workers` does not
    change the result. `one` certifies an operating point, by default `certify_node`. `along` is the scenario whose
    flight provides speed and air at the operating points, by default the same scenario.
    """
    times = node_times(along or loaded, edges=MEASURED_EDGES) if times_s is None else tuple(times_s)
    found = [operating_points.nodes(along or loaded, times, plane=plane) for plane in planes]
    with ThreadPoolExecutor(max_workers=workers) as pool:
        return list(pool.map(partial(one or certify_node, loaded), itertools.chain(*zip(*found, strict=True))))


def certify_node(
    loaded: LoadedScenario,
    node: Node,
    *,
    fault: PackedChange | None = None,
    bands: tuple[LineBand, ...] = BANDS,
    names: tuple[MarginName, ...] = MARGIN_NAMES,
) -> NodeCertificate:
    """Return the certificate at one operating point, in its plane.

    `fault` alters the flights but not the linear model, in order to test that the certificate detects the fault.
    `bands` and `names` select the responses and the margins to be measured. Raises ValueError if the point cannot be
    held (held_flight.py).
    """
    try:
        return _certified(loaded, node, fault, bands, names)
    except (CodeDiffers, CodeLost) as error:
        said = str(error) if isinstance(error, CodeDiffers) else f"does not reach the point: {error}"
        return NodeCertificate(node.time_s, node.plane, False, response.no_response(), (), differs=said)


def _certified(
    loaded: LoadedScenario,
    node: Node,
    fault: PackedChange | None,
    bands: tuple[LineBand, ...],
    names: tuple[MarginName, ...],
) -> NodeCertificate:
    if loaded.design is None:
        raise ValueError(f"{loaded.label}: there is no design to certify")
    adaptive = loaded.design.of_stage(node.stage).adaptive
    ends = (1.0, 1.0) if adaptive is None else (adaptive.least_gain, adaptive.most_gain)
    total_gain_db = (20.0 * math.log10(ends[0]), 20.0 * math.log10(ends[1]))
    held, flown = hold(loaded, node, fault), loops([node], loaded.design)[0]
    of_flown = margins(flown)
    loop = loops([held.node], loaded.design)[0]
    of_held, drifts, along_body = margins(loop), None, False
    if not of_held.stable:
        drifts = measured_margins.drift(held, loop, of_held)
        along_body = drifts is None and of_flown.stable
        if along_body:
            held = hold(loaded, node, fault, along_body=True)
            loop = loops([held.node], loaded.design)[0]
            of_held = margins(loop)
    bands = below(bands, loop.fixed.highest_hz)
    pade = loops([held.node, node], loaded.design, kind="pade")
    of_pade = margins(pade[1])
    if drifts is not None:
        of_held = drifts.others
    elif not of_held.stable:
        cycle = measured_margins.limit_cycle(held, of_held.growth_hz)
        nothing = response.measured_response(held, loop, pade[0], ())
        return NodeCertificate(node.time_s, node.plane, of_flown.stable, nothing, (), cycle, total_gain_db)

    def row_of(held: HeldFlight, name: MarginName) -> MarginRow:
        return _margin_row(measured_margins.measure_margin(held, loop, of_held, name), of_pade, of_flown)

    responses = response.measured_response(held, loop, pade[0], bands, at_half=fault is None)
    rows = [row_of(held, name) for name in names]
    open_rows = [k for k, row in enumerate(rows) if row.reason in (UNEXPLAINED, measured_margins.NOT_SETTLED)]
    if open_rows and loaded.scenario.switches.converter == "full":
        with suppress(CodeLost):  # code that needs the pulses of the gyro is lost without them: nothing is explained
            fine = hold(with_ideal_converters(loaded), node, fault, along_body=along_body)
            for k in open_rows:
                rows[k] = _with_noise(rows[k], row_of(fine, names[k]))
    if drifts is not None:
        rows.append(_drift_row(drifts, of_pade, of_flown))
    rings: tuple[RingLine, ...] = ()
    if bands and node.vehicle.pendulums.ring.any():
        rings = response.ring_lines(hold(loaded, node, fault, along_body=along_body, rings_by_law=True), loop)
    return NodeCertificate(node.time_s, node.plane, of_flown.stable, responses, tuple(rows), None, total_gain_db, rings)


def _with_noise(row: MarginRow, fine: MarginRow) -> MarginRow:
    """Return a row that disagrees, with converter noise as its reason if that explains the difference.

    `fine` is the same row without rounding. Near the stability boundary, converter counts sustain an oscillation, so
    that its growth rate is unreliable. Rounding is the cause if the row without rounding agrees and the row with
    rounding differs little.
    """
    near = abs(row.difference) <= (NOISE_WITHIN_DB if row.unit == "dB" else NOISE_WITHIN * row.held)
    return dataclasses.replace(row, reason=NOISE) if fine.agrees and near else row


def _margin_row(found: MeasuredMargin, pade: Margins, flown: Margins) -> MarginRow:
    within = MARGIN_WITHIN_DB if found.unit == "dB" else DELAY_WITHIN * found.linear
    reason, bound = found.reason, bound_of(flown, found.what)
    sampled = bound.value
    if reason == measured_margins.UNBOUNDED and bound.frequency_hz < measured_margins.DRIFT_HZ:
        reason = HELD_GRAVITY
    if not reason and not abs(found.difference) <= within:
        reason = UNEXPLAINED
    if not reason and not abs(found.linear - sampled) <= within:
        reason = HELD_GRAVITY
    continuous = bound_of(pade, found.what).value
    return MarginRow(
        found.what, found.unit, found.frequency_hz, continuous, sampled, found.linear, found.measured, reason
    )


def _drift_row(of: measured_margins.Drift, pade: Margins, flown: Margins) -> MarginRow:
    reason = HELD_GRAVITY if abs(of.measured_1ps - of.linear_1ps) <= of.per_db_1ps * MARGIN_WITHIN_DB else UNEXPLAINED
    return MarginRow("drift", "1/s", 0.0, pade.growth_1ps, flown.growth_1ps, of.linear_1ps, of.measured_1ps, reason)
