"""A held loop that drifts off: its slowest root grows because the axial load stands in for gravity.

A flight held still feels its axial load as gravity (held_flight.py), several times the real one. That moves the
slowest root, sometimes across the axis, although the loop at the flown instant is stable. Such a root takes minutes to
grow e-fold, so everything else about the loop can still be measured; and the root itself is, by its rate of growth:
a wrong sign or a wrong gravity in the slow motion shows there.
"""

from __future__ import annotations

from dataclasses import dataclass

from maxq.design.certificate.breaking import DRIFT_HZ, altered, kicked_growth, watch_at
from maxq.design.certificate.held_flight import HeldFlight
from maxq.design.loop.loop import Loop
from maxq.design.margins.measure import Margins, margins

SLOWEST_1PS = 1.0 / 160.0  # e-fold within the longest flight of a certificate
_STEP_DB = 0.1


@dataclass(frozen=True)
class Drift:
    """Growth of the slowest root in 1/s, by the linear loop and in flight, and what a decibel of gain does to it.

    `others`: margins of the held loop without that root.
    """

    linear_1ps: float
    measured_1ps: float
    per_db_1ps: float
    others: Margins


def drift(held: HeldFlight, loop: Loop, of_held: Margins) -> Drift | None:
    """Measure the drift of a held loop that is unstable by it alone, and slowly; None for every other loop."""
    if of_held.stable or of_held.growth_hz >= DRIFT_HZ or not 0.0 < of_held.growth_1ps <= SLOWEST_1PS:
        return None
    others = margins(loop, lowest_hz=DRIFT_HZ)
    if not others.stable:
        return None
    measured = kicked_growth(held, loop, watch_at(0.0), lambda packed: None)
    more, less = (altered(loop, "gain_up", db).closed_poles().real.max() for db in (_STEP_DB, -_STEP_DB))
    return Drift(of_held.growth_1ps, measured, float(abs(more - less) / (2.0 * _STEP_DB)), others)
