"""The requirements on loops that were measured in flight: certificates, and flight code without a linear model."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

from maxq.design.certificate.certificate import NodeCertificate
from maxq.design.certificate.in_flight import InFlightResponse
from maxq.design.certificate.measured_only import MeasuredNode
from maxq.design.quantities import MEASURED, LoopLimits
from maxq.design.verify.suite import ACCEPTED, REJECTED, UNDECIDED, JudgedRequirement, room_left

_MEASURED = "measured only"


def measured_requirements(nodes: Sequence[MeasuredNode], limits: LoopLimits) -> list[JudgedRequirement]:
    """Return the requirements on flight code without a linear model.

    The code must return the same commands for the same inputs, be stable at every frozen operating point, and meet the
    margin limits of a linear loop.
    """
    if not nodes:
        return []

    def where(n: MeasuredNode) -> str:
        return f"{n.time_s:g} s, {n.plane}"

    def judged(name: str, wanted: str, found: str, bad: Sequence[MeasuredNode]) -> JudgedRequirement:
        judgement, at = (REJECTED, where(bad[0])) if bad else (ACCEPTED, "")
        return JudgedRequirement(_MEASURED, name, wanted, found, judgement, math.nan, at)

    unlike = [n for n in nodes if n.differs]
    said = unlike[0].differs if unlike else f"{len(nodes)} of {len(nodes)} operating points"
    out = [judged("replay of inputs", "same commands", said, unlike)]
    shaky = [n for n in nodes if not n.stable]
    said = f"{len(nodes) - len(shaky)} of {len(nodes)} operating points"
    said += next((f": {n.ended}" for n in shaky if n.ended), "")
    out.append(judged("stable at every frozen point", "stable", said, shaky))
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
        out.append(
            JudgedRequirement(_MEASURED, name, f"{about.sense} {limit:g} {about.unit}", text, met, room, where(worst))
        )
    ends = [(c, n) for n in nodes for c in n.cycles if c.kind not in ("decays", "limit cycle")]
    said = ends[0][0].text if ends else "decays or ends in a limit cycle at every operating point"
    return [*out, judged("burst at slosh", "does not grow", said, [n for _, n in ends])]


def certificate_requirements(
    certificates: Sequence[NodeCertificate],
    through: Sequence[InFlightResponse],
    again: Callable[[NodeCertificate | InFlightResponse], str] = lambda node: "",
) -> list[JudgedRequirement]:
    """Return the requirements that flight and linear loop agree at every operating point.

    Each difference of an in-flight response must be explained. With adaptation, the measured gain margins must exceed
    the limits of the total gain. `again` returns the command that repeats a measurement.
    """
    out = []

    def add(name: str, found: str, bad: Sequence[NodeCertificate | InFlightResponse]) -> None:
        judgement, where = (REJECTED, f"{bad[0].time_s:g} s") if bad else (ACCEPTED, "")
        command, wanted = again(bad[0]) if bad else "", "every difference explained"
        out.append(JudgedRequirement("certificate", name, wanted, found, judgement, math.nan, where, again=command))

    for plane in dict.fromkeys(c.plane for c in certificates):
        mine = [c for c in certificates if c.plane == plane]
        bad = [c for c in mine if not c.agrees]
        why = f": {bad[0].unexplained[0]}" if bad else ""
        found = f"{len(mine) - len(bad)} of {len(mine)} operating points{why}"
        add(f"flight and linear loop agree, {plane}", found, bad)
    for end, what in enumerate(("gain_down", "gain_up")):
        adapted = [(c.total_gain_room_db(end), c) for c in certificates if c.total_gain_db[end] != 0.0]
        if adapted:
            room_db, worst = min(adapted, key=lambda each: each[0])
            limit_db, name = abs(worst.total_gain_db[end]), ("least", "most")[end]
            out.append(
                JudgedRequirement(
                    "certificate",
                    f"stable at the {name} total gain",
                    f"{what} > {limit_db:.2f} dB",
                    f"{room_db + limit_db:.2f} dB",
                    ACCEPTED if room_db > 0.0 else REJECTED,
                    room_db / limit_db,
                    f"{worst.time_s:g} s, {worst.plane}",
                    again="" if room_db > 0.0 else again(worst),
                )
            )
    for plane in dict.fromkeys(f.plane for f in through):
        flights = [f for f in through if f.plane == plane]
        count, open_ = sum(len(f.lines_hz) for f in flights), sum(f.reason.count("unexplained") for f in flights)
        off = [f for f in flights if "unexplained" in f.reason]
        add(f"in-flight response, {plane}", f"{count - open_} of {count} lines", off)
    return out
