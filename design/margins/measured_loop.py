"""The measured loop at an operating point, which provides the quantities of `design.quantities`."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

from maxq.design.laws.law import ANGLES, DRIFTS
from maxq.design.loop.loop import Loop
from maxq.design.margins.lobes import Lobe
from maxq.design.margins.measure import Margins, margins
from maxq.design.model.instruments import ACCELERATION
from maxq.design.model.node import Node, flown_point
from maxq.design.model.operating_point import OperatingPoint
from maxq.design.model.vehicle_at import StabilityDerivatives
from maxq.design.quantities import MEASURED, Convention, RigidBody


@dataclass(frozen=True)
class LoopAtPoint:
    """A loop with its margins and lobes. An unstable loop has no margins, but its lobes have peaks."""

    loop: Loop
    margins: Margins

    @property
    def lobes(self) -> tuple[Lobe, ...]:
        return self.margins.lobes

    @property
    def node(self) -> OperatingPoint:
        return self.loop.fixed.node

    @property
    def flown(self) -> Node:
        """Return the operating point with its vehicle. Raises ValueError for an operating point without a vehicle."""
        return flown_point(self.node)

    @property
    def time_s(self) -> float:
        return self.node.time_s

    @cached_property
    def derivatives(self) -> StabilityDerivatives | None:
        """Return the stability derivatives of the vehicle at the operating point, or None for a vehicle at rest."""
        try:
            return self.node.derivatives
        except ValueError:
            return None

    @cached_property
    def bending(self) -> dict[int, Lobe]:
        """Return the lobes of the bending modes within the frequency range of the loop, by mode number."""
        return {int(lobe.label.split()[1]): lobe for lobe in self.lobes if lobe.kind == "bending"}

    def mode_peak_db(self, first: int, last: int) -> float:
        """Return the largest peak of the bending modes `first` to `last` (`loop.own_part`), or -inf."""
        return max((lobe.peak_db for n, lobe in self.bending.items() if first <= n <= last), default=-math.inf)

    def mode_phase_deg(self, mode: int) -> float:
        """Return the least lag or lead margin over the crossings of 0 dB that belong to a mode.

        It is inf without a crossing, and NaN for an unstable loop.
        """
        if not self.margins.stable:
            return math.nan
        return self.bending[mode].phase_deg if mode in self.bending else math.inf

    def slosh_phase_deg(self, peak_db: float) -> float:
        """Return the least lag or lead margin of the slosh lobes with a peak above `peak_db`.

        It is inf without such a lobe, and NaN for an unstable loop.
        """
        if not self.margins.stable:
            return math.nan
        turns = (lobe.phase_deg for lobe in self.lobes if lobe.kind == "slosh" and lobe.peak_db > peak_db)
        return min(turns, default=math.inf)

    def rigid(self, body: RigidBody) -> tuple[float, float]:
        """Return the frequency (Hz) and damping ratio of the rigid body with the law's static gains.

        `body` is "paper" for eqs 35 and 36, or "aerodynamic" to include M_alpha and M_q (erratum 12). Both results are
        NaN for a vehicle at rest. Without stiffness, the frequency is 0 and the damping ratio NaN.
        """
        d = self.derivatives
        if d is None:
            return math.nan, math.nan
        m_alpha, m_q = (d.m_alpha_1ps2, d.m_q_1ps) if body == "aerodynamic" else (0.0, 0.0)
        law = self.loop.law
        square = d.m_delta_1ps2 * law.static_gain("angle_rad") - m_alpha
        if square <= 0.0:
            return 0.0, math.nan
        omega = math.sqrt(square)
        rates = [
            name for name in law.inputs if name not in (*ANGLES, *DRIFTS, ACCELERATION)
        ]  # includes all gyros of a blended rate
        damping = d.m_delta_1ps2 * sum(law.static_gain(name) for name in rates) - m_q
        return omega / (2.0 * math.pi), damping / (2.0 * omega)

    @property
    def integral_hz(self) -> float:
        """Return the corner frequency k_i / (2 pi k_p) of the law's integral, Hz, or 0 without an integral."""
        law = self.loop.law
        return law.static_gain("angle_integral_rads") / (2.0 * math.pi * law.static_gain("angle_rad"))

    def quantities(self, by: Convention) -> dict[str, float]:
        """Return all quantities of `MEASURED` by key."""
        return {key: float(about.value(self, by)) for key, about in MEASURED.items() if about.value is not None}


def measure_loop(loop: Loop) -> LoopAtPoint:
    """Measure the loop of a vehicle. The lobes have the names of its modes and tanks (see `margins`)."""
    return LoopAtPoint(loop, margins(loop, resonances=loop.fixed.resonances()))
