"""Auxiliary outputs of the derivative, which metrics, events and logs read."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, NamedTuple

from maxq.control.kernel.limits import MAX_PENDULUMS
from maxq.control.kernel.records import Array
from maxq.sim.vehicle.bending import GimbalBending
from maxq.sim.vehicle.engine import EngineOutputs
from maxq.sim.vehicle.environment import AirData
from maxq.sim.vehicle.tvc_load import TvcLoadOutputs


@dataclass
class Aux:
    """Auxiliary outputs of the derivative."""

    air: AirData
    engines: EngineOutputs
    tvc_loads: TvcLoadOutputs
    gimbal_bending: GimbalBending
    aero_force_B_N: Annotated[Array, (3,)]
    aero_moment_B_Nm: Annotated[Array, (3,)]  # about the core CG
    specific_force_B_mps2: Annotated[Array, (3,)]  # at the core CG: acceleration less gravitation
    alpha_BI_B_radps2: Annotated[Array, (3,)]  # angular acceleration
    gyro_bending_radps: Annotated[Array, (2,)]  # angular rate that bending adds at the gyro: pitch, yaw
    axial_load_mps2: float  # axial specific force that softens the modes and drives the pendulums
    tension_N: Annotated[Array, (MAX_PENDULUMS,)]  # of each pendulum's rod


class Evaluation(NamedTuple):
    """Arguments and results of one evaluation of the derivative."""

    properties: Array  # of the vehicle at this instant, see schedule.py
    y: Array
    dy: Array
    aux: Aux
