"""What the gimbal can hold: the steady cross-wind that its angle can trim, over the flight.

In trim the moment of the deflected engine balances that of the incidence, delta = -(M_alpha / M_delta) alpha, and a
cross-wind W meets the vehicle at alpha = atan(W / U) before it has had time to drift along. So the gimbal's limit is
reached at a wind of U tan(delta_max |M_delta / M_alpha|). With |M_alpha / M_delta| above three, this comes before
any margin.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from maxq.design.model.node import Node
from maxq.design.model.vehicle_at import stability_derivatives
from maxq.design.verify.verdict import ACCEPTED, REJECTED, Requirement


@dataclass(frozen=True)
class Authority:
    """At a vehicle time: gimbal per incidence, the wind that takes all of the gimbal, and airspeed."""

    time_s: float
    airspeed_mps: float
    dynamic_pressure_Pa: float
    ratio: float  # |M_alpha / M_delta|
    gimbal_limit_deg: float
    wind_mps: float  # infinite where the gimbal is never used up


def authority(nodes: Sequence[Node], command_limit_rad: float) -> list[Authority]:
    """The envelope at the nodes; the limit is the smaller one of computer and actuator."""
    out = []
    for node in nodes:
        d = stability_derivatives(node.vehicle, node.condition)
        actuator = node.instruments.actuator
        limit = command_limit_rad if actuator.ideal else min(command_limit_rad, actuator.angle_limit_rad)
        ratio = abs(d.m_alpha_1ps2 / d.m_delta_1ps2)
        incidence = limit / ratio if ratio > 0.0 else math.inf
        wind = node.condition.airspeed_mps * math.tan(incidence) if incidence < 0.5 * math.pi else math.inf
        condition = node.condition
        out.append(
            Authority(
                node.time_s, condition.airspeed_mps, condition.dynamic_pressure_Pa, ratio, math.degrees(limit), wind
            )
        )
    return out


def authority_requirement(found: Sequence[Authority], wind_mps: float) -> Requirement:
    """That a steady cross-wind can be trimmed at every time."""
    worst = min(found, key=lambda a: a.wind_mps)
    return Requirement(
        "authority", "gimbal trims a steady cross-wind", f">= {wind_mps:g} m/s", f"{worst.wind_mps:.1f} m/s",
        ACCEPTED if worst.wind_mps >= wind_mps else REJECTED, worst.wind_mps / wind_mps - 1.0, f"{worst.time_s:g} s",
    )  # fmt: skip
