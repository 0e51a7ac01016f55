"""Phases of a flight, from its events: what a person would say it is doing."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from maxq.tools.plots.palette import BLUE, GREEN, GREY, ORANGE, PURPLE, RED, SKY
from maxq.tools.replay.flight import Channels, Moment

HELD, POWERED, COASTING, FALLING, LOST, TUMBLING, ENDED = (
    "held down", "powered", "coasting up", "falling", "control lost", "tumbling", "ended",
)  # fmt: skip
COLOURS = {
    HELD: GREY, POWERED: ORANGE, COASTING: SKY, FALLING: BLUE, LOST: RED, TUMBLING: PURPLE, ENDED: GREEN,
}  # fmt: skip
_BEGUN_BY = {
    "liftoff": POWERED,
    "burnout": COASTING,
    "apogee": FALLING,
    "control_lost": LOST,
    "tumble": TUMBLING,
    "impact": ENDED,
    "diverged": ENDED,
}
_WORSE = (LOST, TUMBLING)


@dataclass(frozen=True)
class Phase:
    name: str
    start_ns: int


def first_phase(channels: Channels, start_ns: int) -> Phase:
    """What a flight begins with, from its first sample."""

    def first(name: str) -> float:
        return float(channels[name][0]) if name in channels and len(channels[name]) else 0.0

    if first("on_pad") > 0.0:
        return Phase(HELD, start_ns)
    if first("thrust_N") > 0.0:
        return Phase(POWERED, start_ns)
    return Phase(COASTING if first("v_N_down_mps") < 0.0 else FALLING, start_ns)


def phases(first: Phase, moments: Iterable[Moment]) -> Sequence[Phase]:
    """Phases in order; once control is lost nothing milder is said but the end."""
    out = [first]
    for moment in sorted(moments, key=lambda m: m.time_ns):
        name = _BEGUN_BY.get(moment.name)
        if moment.name == "ignition" and out[-1].name != HELD:
            name = POWERED
        if name is None or name == out[-1].name or (out[-1].name in _WORSE and name not in (*_WORSE, ENDED)):
            continue
        out.append(Phase(name, moment.time_ns))
    return out
